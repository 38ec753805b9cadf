"""Weak form: balances averaged with a smooth kernel, so that no measured signal is differentiated.

Row i of a balance is the integral of w(t - t_i) r(t) dt with the kernel w(t) = c cos^4(pi t / L).
Terms that are linear in the signals take their derivatives on the kernel (w', w''); laws that are
nonlinear are evaluated at the samples (velocities from a shorter kernel) and then averaged.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, Final, final
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt

from casadi_models.signals import one_line
from identification.balance.colour import ChannelNoise

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

POSITION_CHAINS: Final = {
    "motor_position": ("motor_position", "motor_velocity", "motor_acceleration", "motor_jerk"),
    "link_position": ("link_position", "link_velocity", "link_acceleration", "link_jerk"),
    "torque": ("torque", "torque_rate"),
    "drive": ("drive", "drive_rate"),
    "coupling_torque": ("coupling_torque",),
}
"""Measured signals and the signals that follow from them by derivatives."""

PAIR: Final = ("motor_position", "link_position")
"""Positions of which the difference is the torsion."""

TORQUES: Final = ("torque", "drive", "coupling_torque")
"""Measured signals that may jump between two samples."""

HIGHEST_DERIVATIVE: Final = 4
CLAIM_KERNEL: Final = 0.06
"""Length of the balances' kernel [s]."""
INDEPENDENT_SHARE: Final = 0.4
"""Share of the rows that count as independent: four rows to a kernel length."""
KERNEL_SAMPLES: Final = 8
"""Samples that a kernel has at least, however slow the logger."""

RESTING_SIDES: Final[Mapping[str, tuple[str, ...]]] = {
    "motor": ("motor",),
    "deflection": ("motor",),
    "link": ("link",),
    "sum": ("motor", "link"),
    "axis": ("motor", "link"),
    "kinematic": ("link",),
}
"""Sides whose dry friction acts in a balance. At rest it is any torque up to its limit: such a row
is an inequality, no equation. The transmission has no friction against the ground."""
HELD_READINGS: Final = "twist"
"""Key of the rests of both sides in which an encoder stands on a step: all rows of such a rest have
one error, of up to half a step, and it looks like play."""

LEAST_SUPPORT: Final = 0.5
"""Share of a row's kernel that must have been measured: with less, the row is more cubic than
record.
"""
REST_SHARE: Final = 0.01
"""Share of a row's kernel that may be at rest: a choice. At 1 % the unknown friction of the rest
weighs a hundredth of its limit in the row, which is what noise leaves of it elsewhere; the kernels
taper, so that only rows whose edge touches a rest are near it."""

HALF: Final = 1e-6
"""Samples by which the last digits of a clock may miss a half: 60 ms hold 7.5 times 4 samples of
2 ms, and a median step that is 1e-11 off would make 7 rows of 8.
"""


def whole(samples: float) -> int:
    """Nearest whole number of samples, halves upwards."""
    return math.floor(samples + 0.5 + HALF)


@lru_cache(256)
def kernel(length: float, dt: float, order: int = 0) -> FloatArray:
    """Samples of the cos^4 kernel or of a derivative of it, for correlation with a signal.

    Parameters
    ----------
    length : float
        Full width [s].
    dt : float
        Sample time [s].
    order : {0, 1, 2, 3}
        Derivative of the signal that the correlation gives.

    Returns
    -------
    (k,) array, k odd, not to be written to
        Weights that reproduce the derivative of polynomials up to `order` + 1 exactly.
    """
    half = max(1 if order == 1 else order + 2, whole(length / dt / 2))  # 1: central difference
    t = np.arange(-half, half + 1) * dt
    width = (2 * half + 2) * dt
    window = np.cos(np.pi * t / width) ** 4
    # least-squares polynomial weights under the window: exact for polynomials, the window keeps it
    # smooth
    degree = order + 1
    scale = half * dt
    basis = np.vander(t / scale, degree + 1, increasing=True)
    weighted = basis * window[:, None]
    coefficients = np.linalg.solve(basis.T @ weighted, np.eye(degree + 1)[order])
    weights: FloatArray = (
        weighted @ coefficients * float(np.prod(np.arange(1, order + 1))) / scale**order
    )
    weights.setflags(write=False)
    return weights


@lru_cache(256)
def differentiated_kernel(length: float, dt: float, order: int, step: int = 1) -> FloatArray:
    """Derivative of the cos^4 kernel itself, so that averages of a signal and of its derivative
    agree.

    Shapes and units as in :func:`kernel`; exact for polynomials of degree `order`. With a `step`
    the samples at every so many `dt` of the kernel that has all of them, so that an average of
    these samples and one of all agree, too.
    """
    half = max(order + 2, whole(length / dt / 2))
    width = (2 * half + 2) * dt
    half = max(order + 2, whole(length / (dt * step) / 2))
    t = np.arange(-half, half + 1) * (dt * step)
    phase = np.clip(np.pi * t / width, -np.pi / 2, np.pi / 2)
    c, s = np.cos(phase), np.sin(phase)
    # but for their sizes, which the moment of the order sets
    shapes = (
        c**4,
        c**3 * s,
        c**2 * (3 * s**2 - c**2),
        c * s * (3 * s**2 - 5 * c**2),
        3 * s**4 - 24 * c**2 * s**2 + 5 * c**4,
    )
    weights = np.asarray(shapes[order], dtype=float)
    unit = c**4 / np.sum(c**4)
    moments = [np.sum(weights * t**k) for k in range(order)]
    if order:
        powers = np.vander(t, order, increasing=True)
        gram = powers.T @ (powers * unit[:, None])
        weights = weights - (powers * unit[:, None]) @ np.linalg.solve(gram, np.array(moments))
    factorial = float(np.prod(np.arange(1, order + 1)))
    weights = np.asarray(weights * factorial / np.sum(weights * t**order), dtype=np.float64)
    weights.setflags(write=False)
    return weights


@final
@dataclass(frozen=True)
class Grid:
    """Where the rows of one record's balances stand.

    Attributes
    ----------
    length, dt : float
        Kernel length and sample time [s].
    stride, step : int
        Samples between rows; samples between the points at which nonlinear laws are evaluated.
    segments : tuple of slice
        Contiguous stretches that are long enough.
    half : int
        Samples left out at either end of a stretch.
    pointwise : mapping of str to float
        Kernel length of the derivatives inside nonlinear laws, by measured signal [s].
    torsion : float
        Kernel length of both positions where a memory operator follows their difference [s]; at 0
        each has its own.
    """

    length: float
    dt: float
    stride: int
    step: int
    segments: tuple[slice, ...]
    half: int
    pointwise: Mapping[str, float]
    torsion: float = 0.0

    @property
    def alternating(self) -> FloatArray:
        """The kernel with every other weight turned round: nothing is left of what the samples
        resolve, and half of the weight of a sample of what jumps between two of them.
        """
        weights = differentiated_kernel(self.length, self.dt, 0)
        return np.asarray(weights * (-1.0) ** np.arange(len(weights)), dtype=np.float64)

    def velocity_noise(self, source: str, noise: ChannelNoise) -> float:
        """Standard deviation of the pointwise velocity of that position under its noise [1/s]."""
        return noise.after(kernel(self.pointwise[source], self.dt, 1), self.dt)

    def has_points_of(self, other: Grid, source: str) -> bool:
        """Whether the points of a measured signal are those of another grid."""
        own, theirs = ((g.segments, g.dt, g.step, g.pointwise.get(source)) for g in (self, other))
        return own == theirs

    def correlate(self, values: FloatArray, weights: FloatArray) -> FloatArray:
        """Rows of a correlation of a full-rate signal with kernel weights."""
        return self.correlated(values, [weights])[0]

    def correlated(self, values: FloatArray, kernels: Sequence[FloatArray]) -> list[FloatArray]:
        """:meth:`correlate` of signals (..., samples) with several kernels, (..., rows) each."""
        values = np.asarray(values, dtype=np.float64)
        return _correlated(values, kernels, self.segments, self.half, self.stride)

    def pick(self, values: FloatArray) -> FloatArray:
        """Full-rate values at the rows."""
        return self.correlate(values, np.ones(1))


CANCELLED: Final = 1e-9
"""Share of their sizes below which the sum of weights is rounding: that of thousands of terms."""
ROUNDED: Final = 1e-14
"""The same of a derivative: weights of a kernel fall off, so that some tens of terms count."""


def _at(
    signals: FloatArray, kernels: Sequence[FloatArray], first: int, stride: int, count: int
) -> list[FloatArray]:
    """Correlations of signals (signals, samples) with kernels of one length, (signals, count) each:
    of the window that begins at sample `first`, and of every `stride`-th one from there.

    Kernels of a derivative see the differences of the samples: nothing at rest, where rounding of
    the whole position would give a velocity of either sign. Steps of an encoder that cancel leave
    rounding, too: it is zero.
    """
    derivative = [abs(float(w.sum())) < CANCELLED * float(np.abs(w).sum()) for w in kernels]
    out = [np.empty((0, 0))] * len(kernels)
    for rate in sorted({*derivative}):
        which = [i for i, d in enumerate(derivative) if d is rate]
        x = np.diff(signals) if rate else signals
        weights = np.array([-np.cumsum(kernels[i])[:-1] if rate else kernels[i] for i in which])
        found = _blockwise(x, weights, first, stride, count)
        reach = np.abs(x).max(axis=1, initial=0.0, keepdims=True) if rate else 0.0
        for i, w, own in zip(which, weights, found, strict=True):
            if rate:
                own[np.abs(own) <= ROUNDED * float(np.abs(w).sum()) * reach] = 0.0
            out[i] = own
    return out


def _blockwise(
    signals: FloatArray, weights: FloatArray, first: int, stride: int, count: int
) -> FloatArray:
    """Products of the windows of signals (signals, samples) with the weights (kernels, length),
    shape (kernels, signals, count).

    A signal is cut into blocks about as long as a window. The windows that begin in a block end in
    one of the next, and all of them are met at once: copies of windows, which overlap, would take
    longer than the products.
    """
    kernels, length = weights.shape
    held = max(1, round(length / stride))  # windows that begin in a block
    size, blocks = held * stride, -(-count // held)
    reached = -(-(length + size - stride) // size)
    placed = np.zeros((reached * size, kernels, held))
    for k in range(held):
        placed[k * stride : k * stride + length, :, k] = weights.T
    placed = placed.reshape(reached, size, kernels * held)
    padded = np.zeros((len(signals), (blocks + reached - 1) * size))
    seen = signals[:, first : first + padded.shape[1]]
    padded[:, : seen.shape[1]] = seen
    cut = padded.reshape(len(signals), -1, size)
    out = cut[:, :blocks] @ placed[0]
    for k in range(1, reached):
        out += cut[:, k : k + blocks] @ placed[k]
    by_kernel = out.reshape(len(signals), blocks, kernels, held).transpose(2, 0, 1, 3)
    return np.ascontiguousarray(by_kernel.reshape(kernels, len(signals), -1)[..., :count])


def _correlated(
    signals: FloatArray,
    kernels: Sequence[FloatArray],
    segments: tuple[slice, ...],
    half: int,
    stride: int,
) -> list[FloatArray]:
    """Correlations of signals (..., samples) with each kernel at the rows, (..., rows); those of
    one length at once.
    """
    flat = signals.reshape(-1, signals.shape[-1])
    found: list[list[FloatArray]] = [[] for _ in kernels]
    for length in {len(w): None for w in kernels}:
        which = [i for i, w in enumerate(kernels) if len(w) == length]
        for segment in segments:
            x = flat[:, segment]
            count = len(range(half, x.shape[1] - half, stride))
            rows = _at(x, [kernels[i] for i in which], half - length // 2, stride, count)
            for i, own in zip(which, rows, strict=True):
                found[i].append(own)
    return [_joined(parts, signals) for parts in found]


def _joined(parts: Sequence[FloatArray], like: FloatArray) -> FloatArray:
    """Parts (signals, some) one after the other, in the shape of signals (..., samples)."""
    whole = np.concatenate(parts, axis=1) if parts else np.empty((like[..., 0].size, 0))
    return whole.reshape(*like.shape[:-1], -1) if whole.size else np.empty((*like.shape[:-1], 0))


@final
@dataclass(frozen=True)
class Filter:
    """What the rows of a record say of a late reading: whether it waits or is low-passed.

    Attributes
    ----------
    late : float
        Time by which it is late [s].
    better : float
        Squares, in units of the variance, by which a low-pass meets the rows better than a delay.
    behind : float
        What is to be shifted beside the rate of a low-pass, zero or less [s].
    gain : float
        Squares by which that is better than no shift.
    """

    late: float
    better: float
    behind: float = 0.0
    gain: float = 0.0


@final
@dataclass(frozen=True)
class WeakRecord:
    """One record prepared for weak-form regression.

    Attributes
    ----------
    averaged : mapping of str to (rows,) array
        Kernel average of every signal, derivatives taken on the kernel.
    points : mapping of str to (points,) array
        Signals where nonlinear laws are evaluated.
    smooth : mapping of str to (points,) array
        The same, positions smoothed too: input of memory operators.
    paired : mapping of str to (points,) array
        Both positions smoothed by one kernel: input of memory operators of the torsion, which is
        small beside either. Empty where each has its own.
    doubts : tuple of mapping of str to (points,) array
        The same three times: smooth, and with drawn noise added to that and taken off it; what
        noise does to laws with memory of the torsion. Empty where that is not known.
    time : (rows,) array
        Centre of each row [s].
    block : (rows,) int array
        Block of each row; -1 for a row that touches another block's samples.
    starts : (segments + 1,) int array
        First point of each segment.
    masked : set of str
        Balances that these rows do not take part in: those of a link with another payload.
    curved : mapping of str to (rows,) array
        Second derivative of the average of every signal where it was asked for.
    rest : mapping of str to (rows,) array
        Kernel average of "this side stands still" (0 to 1), by side: motor, link, and
        :data:`HELD_READINGS`.
    between : mapping of str to (rows,) array
        What the average of a measured torque over every other sample differs by from that over the
        samples between them, halved.
    support : (rows,) array, optional
        Share of each row's kernel that was measured and not bridged; 1 everywhere where it is None.
    bridging : mapping of str to (samples,) array
        Standard deviation by which bridged samples of a signal may be off beside its noise, where
        some are.
    lost : (samples,) bool array, optional
        Which samples are bridged; none where it is None.
    name : str
        Tells the record from all others: its calibration unknowns go by it.
    shifts : mapping of str to float
        By the place of a late sensor, the samples that are taken off its readings already [s].
    filters : mapping of str to Filter
        By the place of a sensor that may be read through a low-pass, what the record says of it.
    copies : int
        So many times the stretches of the grid, one after the other: noise drawn so often.
    """

    grid: Grid
    averaged: Mapping[str, FloatArray]
    points: Mapping[str, FloatArray]
    smooth: Mapping[str, FloatArray]
    time: FloatArray
    block: IntArray
    starts: IntArray
    masked: frozenset[str] = frozenset()
    curved: Mapping[str, FloatArray] = field(default_factory=dict)
    rest: Mapping[str, FloatArray] = field(default_factory=dict)
    between: Mapping[str, FloatArray] = field(default_factory=dict)
    support: FloatArray | None = None
    name: str = ""
    shifts: Mapping[str, float] = field(default_factory=dict)
    paired: Mapping[str, FloatArray] = field(default_factory=dict)
    doubts: tuple[Mapping[str, FloatArray], ...] = ()
    bridging: Mapping[str, FloatArray] = field(default_factory=dict)
    lost: npt.NDArray[np.bool_] | None = None
    filters: Mapping[str, Filter] = field(default_factory=dict)
    copies: int = 1

    def __repr__(self) -> str:
        return one_line(self)

    def taking(self, balance: str) -> npt.NDArray[np.bool_]:
        """Rows that take part in a balance, shape (rows,): the one mask of every fit, error,
        line and picture.
        """
        if balance in self.masked:
            return np.zeros(self.rows, dtype=np.bool_)
        lost = self.support < LEAST_SUPPORT if self.support is not None else False
        return np.asarray(~(self.resting(balance) | lost))

    def resting(self, balance: str) -> npt.NDArray[np.bool_]:
        """Rows in which a side whose dry friction acts in the balance stands still, or the twist is
        that of two readings which stand, shape (rows,).
        """
        still = np.zeros(self.rows, dtype=np.bool_)
        held = (HELD_READINGS,) if balance == "transmission" else ()
        for side in RESTING_SIDES.get(balance, held):
            if side in self.rest:
                still |= self.rest[side] > REST_SHARE
        return still

    @cached_property
    def stretch(self) -> IntArray:
        """Number of the contiguous stretch of each row, shape (rows,)."""
        grid = self.grid
        counts = [
            len(range(grid.half, s.stop - s.start - grid.half, grid.stride)) for s in grid.segments
        ]
        return np.repeat(np.arange(len(counts)), counts)

    @property
    def begins(self) -> npt.NDArray[np.bool_]:
        """Rows that begin a stretch after another one, shape (rows,): no curve is drawn up to
        them.
        """
        return np.asarray(np.diff(self.stretch, prepend=0) != 0)

    def average(self, values: FloatArray) -> FloatArray:
        """Kernel average of values at the points, one row per row.

        Parameters
        ----------
        values : (points,) or (points, columns) array

        Returns
        -------
        (rows,) or (rows, columns) array
        """
        return self._each(self.averaging, values)

    def curve(self, values: FloatArray) -> FloatArray:
        """Second derivative of the kernel average of values at the points (shapes as in
        :meth:`average`).
        """
        return self._each(self.curving, values)

    def tilt(self, values: FloatArray) -> FloatArray:
        """Rate of the kernel average of values at the points (shapes as in :meth:`average`)."""
        return self._each(self.tilting, values)

    @cached_property
    def averaging(self) -> Any:
        """Sparse matrix (rows, points) of the kernel average, of one copy."""
        return self._sparse(0)

    @cached_property
    def curving(self) -> Any:
        """Sparse matrix (rows, points) of the second derivative of the kernel average."""
        return self._sparse(2)

    @cached_property
    def tilting(self) -> Any:
        """Sparse matrix (rows, points) of the rate of the kernel average."""
        return self._sparse(1)

    def table(self, names: tuple[str, ...]) -> tuple[FloatArray, ...]:
        """Signals at the points, (points,) each, in the order of `names`, zeros where one is not
        there; not to be written to. No copies: they are several for every sample.
        """
        nothing = np.broadcast_to(0.0, (int(self.starts[-1]),))
        return tuple(self.points.get(name, nothing) for name in names)

    def means(self, names: tuple[str, ...]) -> FloatArray:
        """Averages of the signals as columns in the order of `names`, zeros where one is not there;
        made once, not to be written to.
        """
        return self._table("averaged", names, self.averaged)

    def bends(self, names: tuple[str, ...]) -> FloatArray:
        """Second derivatives of these averages, as :meth:`means`."""
        return self._table("curved", names, self.curved)

    def tilts(self, names: tuple[str, ...]) -> FloatArray:
        """Rates of these averages, as :meth:`means`."""
        rates: dict[str, FloatArray] = {}
        for source, chain in POSITION_CHAINS.items():
            if source not in self.averaged:
                continue
            if len(chain) == 1:
                rates[source] = self.tilt(self.points[source])
                continue
            rates.update(zip(chain, (self.averaged[n] for n in chain[1:]), strict=False))
            if chain[-2] in self.curved:  # the rate of the last one
                rates[chain[-1]] = self.curved[chain[-2]]
        return self._table("tilted", names, rates)

    def _table(
        self, kind: str, names: tuple[str, ...], signals: Mapping[str, FloatArray]
    ) -> FloatArray:
        if (kind, names) not in self._tables:
            out = np.zeros((self.rows, len(names)))
            for i, name in enumerate(names):
                if name in signals:
                    out[:, i] = signals[name]
            self._tables[kind, names] = out
        return self._tables[kind, names]

    @cached_property
    def _tables(self) -> dict[tuple[str, tuple[str, ...]], FloatArray]:
        return {}

    def portions(self, most: int) -> list[slice]:
        """Points of so many copies at a time as have no more than `most` points; one at least."""
        size = int(self.starts[-1]) // self.copies
        some = max(1, most // max(size, 1))
        return [
            slice(first * size, min(first + some, self.copies) * size)
            for first in range(0, self.copies, some)
        ]

    @staticmethod
    def _each(matrix: Any, values: FloatArray) -> FloatArray:
        """Rows of a matrix of the grid, of every copy by itself."""
        copies = len(values) // matrix.shape[1]
        if copies == 1:
            return np.asarray(matrix @ values, dtype=np.float64)
        return np.concatenate([matrix @ part for part in np.split(values, copies)])

    def _sparse(self, order: int) -> Any:
        grid = self.grid
        half, stride = grid.half // grid.step, grid.stride // grid.step
        kernel_of = (grid.length, grid.dt, order, grid.step)
        starts = self.starts[: (len(self.starts) - 1) // self.copies + 1]
        return _averages(kernel_of, half, stride, tuple(starts.tolist()))

    @property
    def rows(self) -> int:
        """Number of rows of each balance."""
        return len(self.time)


def _averages(
    kernel_of: tuple[float, float, int, int], half: int, stride: int, starts: tuple[int, ...]
) -> Any:
    """Matrix (rows, points) of the kernel averages; one for all records of the same grid, as long
    as one of them lives: a record is made again for each shift of its clocks that is tried.
    """
    key = (kernel_of, half, stride, starts)
    found = _matrices.get(key)
    if found is None:
        from scipy.sparse import csr_array

        weights = differentiated_kernel(*kernel_of)
        own = len(weights) // 2
        centres = np.concatenate(
            [
                np.arange(half, last - first - half, stride) + first
                for first, last in zip(starts[:-1], starts[1:], strict=True)
            ]
        )
        columns = (centres[:, None] + np.arange(-own, own + 1)).ravel()
        pointers = len(weights) * np.arange(len(centres) + 1)
        found = _matrices[key] = csr_array(
            (np.tile(weights, len(centres)), columns, pointers),
            shape=(len(centres), starts[-1]),
        )
    return found


_matrices: Final[WeakValueDictionary[tuple[object, ...], Any]] = WeakValueDictionary()


def prepare(
    time: FloatArray,
    signals: Mapping[str, FloatArray],
    segments: tuple[slice, ...],
    *,
    length: float = 0.06,
    pointwise: float | Mapping[str, float] = 0.03,
    torsion: float = 0.0,
    block: float = 1.5,
    overlap: int = 4,
    first_block: int = 0,
    curved: bool = False,
    before: WeakRecord | None = None,
    same: Collection[str] = (),
    readings: Mapping[str, FloatArray] | None = None,
) -> WeakRecord:
    """Average a uniformly sampled record with the kernel.

    Parameters
    ----------
    time : (n,) array
        Uniform within each segment [s].
    signals : mapping
        Measured signals (keys of :data:`POSITION_CHAINS`, ``temperature``), full rate,
        link-referred.
    segments : tuple of slice
        Contiguous stretches.
    length : float
        Kernel of the balances [s].
    pointwise : float or mapping of str to float
        Kernel of the derivatives inside nonlinear laws, one for all or by measured signal [s].
    torsion : float
        As in :class:`Grid`.
    block : float
        Length of the blocks that count as independent [s].
    overlap : int
        Rows per kernel length.
    curved : bool
        Second derivatives of the averages too.
    before : WeakRecord, optional
        Made of the same record with some signals moved or at another kernel: where the rows are
        the same, those of the signals `same` are taken over, and where the points are the same,
        these.
    same : collection of str
        Signals that are as they were in `before`.
    readings : mapping, optional
        Torques as they were read, at their nearest samples, of those that `signals` has between
        two readings: an interpolation smooths the jump away that falls between them.

    Returns
    -------
    WeakRecord
    """
    dt = float(np.median(np.concatenate([np.diff(time[s]) for s in segments])))
    short = (
        dict.fromkeys(POSITION_CHAINS, pointwise)
        if isinstance(pointwise, int | float)
        else {**dict.fromkeys(POSITION_CHAINS, 0.03), **pointwise}
    )
    step = max(1, whole(0.002 / dt))
    stride = max(step, whole(length / dt / overlap / step) * step)
    half = step * (max(2, whole(length / (dt * step) / 2)) + 1)
    reach = max(half, whole(length / dt / 2) + 3, whole(max(short.values()) / dt / 2) + 5)
    half = step * int(np.ceil(reach / step))
    long_enough = tuple(s for s in segments if s.stop - s.start > 2 * half + stride)
    grid = Grid(
        length,
        dt,
        stride=stride,
        step=step,
        segments=long_enough,
        half=half,
        pointwise=short,
        torsion=torsion,
    )
    over = set(same) if before is not None and before.grid == grid else set[str]()
    known = {n for n in same if before is not None and before.grid.has_points_of(grid, n)}
    found = filtered(
        grid, {n: x for n, x in signals.items() if n not in over}, curved=curved, known=known
    )
    averaged, points, smooth, bent = found
    if before is not None:
        tables = (before.averaged, before.points, before.smooth, before.curved)
        for source in (over | known) & set(POSITION_CHAINS):
            taken = zip(found, tables, strict=True)
            for own, old in taken if source in over else list(taken)[1:3]:
                own.update({n: old[n] for n in POSITION_CHAINS[source] if n in old})
    for name, values in (("temperature", signals.get("temperature")), ("time", time)):
        if values is not None:
            averaged[name] = grid.correlate(values, differentiated_kernel(length, dt, 0))
            points[name] = smooth[name] = np.concatenate(
                [values[s][::step] for s in long_enough] or [np.empty(0)]
            )
    between = {
        n: before.between[n]
        if before is not None and n in over
        else grid.correlate((readings or {}).get(n, signals[n]), grid.alternating)
        for n in TORQUES
        if n in signals
    }
    stamps = grid.pick(time)
    numbers = np.concatenate(
        [
            np.full(len(range(half, s.stop - s.start - half, stride)), i)
            for i, s in enumerate(long_enough)
        ]
        or [np.empty(0)]
    )
    blocks, inside = _blocks(stamps, numbers.astype(np.int64), block, (half - 1) * dt)
    counts = [len(range(0, s.stop - s.start, step)) for s in long_enough]
    return WeakRecord(
        grid,
        averaged,
        points=points,
        smooth=smooth,
        time=stamps,
        block=np.where(inside, blocks + first_block, -1),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        curved=bent,
        between=between,
        paired=dict(before.paired)
        if before is not None and known >= set(PAIR) and before.grid.torsion == grid.torsion
        else paired(grid, signals),
    )


def paired(grid: Grid, signals: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Both positions as :class:`WeakRecord` has them for laws that follow the torsion; empty where
    there are not two of them or each has its own kernel.

    Two kernels would take two different shares off a turn of the motor, and what is left of it is
    no torsion.
    """
    if grid.torsion <= 0 or not set(PAIR) <= set(signals):
        return {}
    return {
        c: _pointwise(signals[c], grid.segments, grid.torsion, grid.dt, 1, grid.step)[1][0]
        for c in PAIR
    }


def filtered(
    grid: Grid,
    signals: Mapping[str, FloatArray],
    *,
    curved: bool = False,
    known: Collection[str] = (),
) -> tuple[
    dict[str, FloatArray], dict[str, FloatArray], dict[str, FloatArray], dict[str, FloatArray]
]:
    """Measured signals and their derivatives as the rows and the nonlinear laws of a grid see them.

    Parameters
    ----------
    grid : Grid
    signals : mapping of str to (..., samples) array
        Keys of :data:`POSITION_CHAINS`, full rate; other keys are left out.
    curved : bool
        Second derivatives of the averages too.
    known : collection of str
        Signals whose points are not wanted.

    Returns
    -------
    averaged, points, smooth, curved
        As in :class:`WeakRecord`.
    """
    averaged: dict[str, FloatArray] = {}
    points: dict[str, FloatArray] = {}
    smooth: dict[str, FloatArray] = {}
    bent: dict[str, FloatArray] = {}
    length, dt, short = grid.length, grid.dt, grid.pointwise
    for source, chain in POSITION_CHAINS.items():
        if source not in signals:
            continue
        signal, orders = signals[source], range(len(chain))
        further = [o + 2 for o in orders if curved and o + 2 <= HIGHEST_DERIVATIVE]
        kernels = [differentiated_kernel(length, dt, o) for o in (*orders, *further)]
        rows = grid.correlated(signal, kernels)
        averaged.update(zip(chain, rows, strict=False))
        bent.update(zip(chain, rows[len(chain) :], strict=False))
        if source not in known:
            raw, soft = _pointwise(signal, grid.segments, short[source], dt, len(chain), grid.step)
            points.update(zip(chain, raw, strict=True))
            smooth.update(zip(chain, soft, strict=True))
    return averaged, points, smooth, bent


def _pointwise(
    signals: FloatArray,
    segments: tuple[slice, ...],
    length: float,
    dt: float,
    orders: int,
    step: int,
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Signals (..., samples) and their first derivatives, as many as there are `orders`, at every
    `step`-th sample, (..., points) each: raw signals and smoothed derivatives, and all smoothed;
    ends by the nearest full window.
    """
    signals = np.asarray(signals, dtype=np.float64)
    flat = signals.reshape(-1, signals.shape[-1])
    kernels = [kernel(length, dt, order) for order in range(orders)]
    soft: list[list[FloatArray]] = [[] for _ in kernels]
    for width in {len(w): None for w in kernels}:
        which = [k for k, w in enumerate(kernels) if len(w) == width]
        own = [kernels[k] for k in which]
        for segment in segments:
            x = flat[:, segment]
            last = x.shape[1] - width
            starts = np.arange(0, x.shape[1], step) - width // 2
            inside = np.flatnonzero((starts >= 0) & (starts <= last))
            before = int(np.sum(starts < 0))
            after = len(starts) - before - len(inside)
            low, high = (_at(x, own, first, 1, 1) for first in (0, last))
            begin = int(starts[inside[0]]) if len(inside) else 0
            middle = _at(x, own, begin, step, len(inside))
            for k, *parts in zip(which, low, middle, high, strict=True):
                soft[k].append(np.repeat(parts[0], before, axis=1))
                soft[k] += [parts[1], np.repeat(parts[2], after, axis=1)]
    smooth = [_joined(parts, signals) for parts in soft]
    raw = _joined([flat[:, s][:, ::step] for s in segments], signals)
    return [raw, *smooth[1:]], smooth


def _blocks(
    time: FloatArray, segment: IntArray, length: float, reach: float
) -> tuple[IntArray, npt.NDArray[np.bool_]]:
    """Block number of each row and whether its kernel stays inside the block."""
    number = np.zeros(len(time), dtype=np.int64)
    inside = np.ones(len(time), dtype=np.bool_)
    offset = 0
    for s in np.unique(segment):
        here = segment == s
        t = time[here] - time[here][0]
        count = max(1, round((t[-1] + 1e-9) / length))
        width = (t[-1] + 1e-9) / count if t[-1] > 0 else 1.0
        index = np.minimum((t / width).astype(np.int64), count - 1)
        number[here] = index + offset
        into = t - index * width
        keep = ((into >= min(reach, width / 8)) | (index == 0)) & (
            (width - into >= min(reach, width / 8)) | (index == count - 1)
        )
        inside[here] = keep
        offset += count
    return number, inside
