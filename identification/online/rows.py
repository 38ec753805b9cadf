"""Rows of the balances while they happen: the weak form of :mod:`identification.balance.weak` on
the last samples.

Every `stride` samples a row is the kernel average of each balance, written as y = H theta with the
parameters that enter all balances linearly; the others are held. Kernels, points and laws are those
of the off-line fit, so that both estimate the same. A row belongs to the instant `delay` before it
is made.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import JointModel, Signals
from casadi_models.affine import AffineParts, settled
from casadi_models.hold import CLOCKS
from identification.balance.balances import residual_expressions, swept_expressions
from identification.balance.clocks import USUAL_SKEW
from identification.balance.sensing import Sensing
from identification.balance.weak import POSITION_CHAINS, differentiated_kernel, kernel
from identification.online.timing import Alignment, Timing

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

SOURCES: Final = ("motor_position", "link_position", "torque", "drive")
"""Signals that are sampled; the others follow from them on the kernel."""
_NAMES: Final = Signals.names()
SHARP: Final = 2e-3
"""A smoothing velocity above this is a law of its own, below it only stands for a jump [rad/s]."""

SEEN: Final = 3.0
"""Standard deviations by which a velocity must stand out of the noise to count as motion."""


def linear_parameters(
    model: JointModel, sensing: Sensing, held: Container[str] = ()
) -> tuple[str, ...]:
    """Largest set of parameters, `held` left out, that enter all balances jointly linearly.

    The greedy set of :func:`casadi_models.equations.linear_set`, on the residuals of the balances;
    behind it the calibration unknowns, which enter by their derivative.
    """
    p = model.equations.parameters
    stacked = ca.vertcat(*residual_expressions(model, sensing).values())
    names, own = model.parameter_names, model.calibration
    edges: dict[int, set[int]] = {i: set() for i in range(len(names))}
    for row in ca.vertsplit(stacked):
        # a comparison has a derivative that is zero everywhere: no edge
        for i, j in zip(*ca.sparsify(ca.hessian(row, p)[0]).sparsity().get_triplet(), strict=True):
            edges[i].add(j)
    present = set(ca.jacobian(stacked, p).sparsity().get_triplet()[1])
    beside = {i for i in present if names[i] in own and names[i] not in held}
    chosen = {i for i in present - beside if i not in edges[i] and names[i] not in held}
    while True:
        degree = {i: len(edges[i] & chosen) for i in chosen}
        worst = max(degree, key=lambda i: (degree[i], i), default=None)
        if worst is None or degree[worst] == 0:
            return tuple(names[i] for i in (*sorted(chosen), *sorted(beside)))
        chosen.discard(worst)


@final
class RowMaker:
    """Rows y = H theta of one model with one set of channels.

    Parameters
    ----------
    model : JointModel
        Adapted to the channels; its values hold the parameters that are not estimated.
    sensing : Sensing
    dt : float
        Sample time [s].
    held : container of str
        Parameters that are known and not estimated.
    shapes : sequence of str
        Parameters that :meth:`set_shapes` may change; they start at the model's values.

    Attributes
    ----------
    names : tuple of str
        Parameters that are estimated.
    balances, shapes : tuple of str
    off : (parameters,) array
        What the readings are freed of already (:mod:`identification.online.calibration`).
    usual : (parameters,) array
        Prior range of parameters that have one whatever the joint: skews of clocks; 0 for others.
    like : (parameters,) int array
        Number of the first parameter that is of the same size: control values of one curve; its own
        for others.
    alignment : Alignment
        What :class:`identification.online.samples.Samples` does to late channels; :attr:`model` has
        only what it leaves of their delays.
    needed, averaged : list of int, int
        Entries of a row, balance by balance, to which the laws at the points add; by the average of
        so many laws, by the rate of the average of those after them.
    weights, rate_weights : (points,) array
        Kernel of the average, and of its rate [1/s].
    uses : (balances, sources) bool array
        Which sampled signals enter which balance.
    entry_gain : (balances, parameters, sources) array
        Variance of an entry of H over that of a signal's noise.
    """

    def __init__(
        self,
        model: JointModel,
        sensing: Sensing,
        dt: float,
        held: Container[str] = (),
        shapes: Sequence[str] = (),
    ) -> None:
        self.sensing, self.timing = sensing, Timing.of(dt)
        self.alignment = Alignment.of(model, SOURCES, dt)
        self.model = model = model.with_values(self.alignment.left)
        self.shapes = tuple(shapes)
        self.eta = ca.SX.sym("eta", len(self.shapes))
        self.shape_values = np.array([self._value(n) for n in self.shapes])
        self.names = linear_parameters(model, sensing, held)
        self.off = np.zeros(len(self.names))
        self.usual = np.array([USUAL_SKEW * dt if n in CLOCKS else 0.0 for n in self.names])
        self.like = _alike(model, self.names)
        expressions = residual_expressions(model, sensing)
        self.balances = tuple(expressions)
        e = model.equations
        signals, p = e.signals.vector(), e.parameters
        columns = [model.parameter_names.index(n) for n in self.names]
        fixed, near, beside = self._values(), self._values(at_zero=False), model.calibration

        # every estimated term is there, whatever its size
        there = [
            1.0 if n in self.names else v
            for n, v in zip(model.parameter_names, model.value_vector(), strict=True)
        ]

        def entries(parts: Mapping[str, Any]) -> Any:
            stacked: list[Any] = []
            for whole in parts.values():
                r = settled(whole, p, there)
                (free,) = ca.substitute([r], [p], [fixed])
                slopes = ca.jacobian(r, p)[:, columns]
                (straight,) = ca.substitute([slopes], [p], [fixed])
                (tangent,) = ca.substitute([slopes], [p], [near])
                found = [
                    (tangent if n in beside else straight)[i] for i, n in enumerate(self.names)
                ]
                stacked += [free, *found]
            return ca.vertcat(*stacked)

        self.width = 1 + len(self.names)
        still, swept = swept_expressions(model, sensing)
        self._split(entries(still), entries(swept), signals, e.memory, fixed)
        self.uses = self._dependence(ca.vertcat(*expressions.values()), signals)
        self._kernels()
        self.slopes = self._slope_function(expressions, signals, p)
        self.reset()

    def _value(self, name: str) -> float:
        return float(self.model.value_vector()[self.model.parameter_names.index(name)])

    def _values(self, *, at_zero: bool = True) -> Any:
        """Parameter vector with the estimated ones at zero or as in the model, and symbols for
        the shapes. In a model without values the stiffness is a usual one.
        """
        at: dict[str, Any] = {n: self.eta[i] for i, n in enumerate(self.shapes)}
        stiffness = self.model.stiffness_name
        if at_zero:
            at |= dict.fromkeys(self.names, 0.0)
        elif stiffness is not None and self._value(stiffness) == 0.0:
            at[stiffness] = self.model.usual_values()[stiffness]
        pairs = zip(self.model.parameter_names, self.model.value_vector(), strict=True)
        values = [at.get(n, v) for n, v in pairs]
        return ca.vertcat(*values) if self.shapes else ca.DM(values)

    def _split(self, out: Any, swept: Any, signals: Any, memory: Any, fixed: Any) -> None:
        """Part that is linear in the signals, and the laws to be evaluated at points: those that
        are averaged, then those whose rate is.
        """
        # a comparison has a derivative that is zero everywhere, and is no line
        slopes = ca.sparsify(ca.jacobian(out, signals))
        linear = np.zeros(slopes.shape, dtype=bool)
        for row, column in zip(*slopes.sparsity().get_triplet(), strict=True):
            entry = slopes[row, column]
            linear[row, column] = not (
                ca.depends_on(entry, signals) or (memory.shape[0] and ca.depends_on(entry, memory))
            )
        self.linear_of = ca.Function(
            "linear", [self.eta], [ca.densify(slopes * ca.DM(linear.astype(float)))]
        )
        self.linear: FloatArray = np.array(self.linear_of(self.shape_values))
        rest: list[Any] = []
        self.needed: list[int] = []
        for i in range(out.shape[0]):
            gone = [signals[j] for j in range(len(_NAMES)) if linear[i, j]]
            (left,) = ca.substitute([out[i]], gone, [ca.SX(0)] * len(gone)) if gone else [out[i]]
            if not ca.simplify(left).is_zero():
                self.needed.append(i)
                rest.append(left)
        self.averaged = len(rest)
        moving = [i for i in range(swept.shape[0]) if not ca.simplify(swept[i]).is_zero()]
        self.needed += moving
        rest += [swept[i] for i in moving]
        self.laws = ca.vertcat(*rest) if rest else ca.SX(0, 1)
        self.point = self._point_function(self.laws, signals, memory, fixed)

    def _point_function(self, rest: Any, signals: Any, memory: Any, fixed: Any) -> Any:
        """(signals, smooth signals, coordinates before, memory before) -> laws, coordinates,
        memory, for the new points.

        With shapes they are the last input.
        """
        e = self.model.equations
        coordinates = ca.vertcat(*(t[1] for t in e.memory_terms)) if e.memory_terms else ca.SX(0, 1)
        count = coordinates.shape[0]
        steps = ca.SX.sym("steps", count)
        moved: list[Any] = []
        straight: list[bool] = []
        for i, (term, _, z, view, values) in enumerate(e.memory_terms):
            if term.effect.memory is not None:
                own = term.effect.memory(z, steps[i], view, values)
                affine = AffineParts(ca.vertcat(*z, steps[i]), signals)
                straight.append(all(affine.split(new)[1].is_zero() for new in own))
                moved.extend(own)
        after = ca.vertcat(*moved) if moved else ca.SX(0, 1)
        p = e.parameters
        shapes = [self.eta] if self.shapes else []
        one = ca.Function("one", [signals, memory, p, *shapes], [ca.densify(rest)])
        where = ca.Function("where", [signals, p], [ca.densify(coordinates)])
        move = ca.Function("move", [memory, steps, signals, p, e.clock], [ca.densify(after)])
        new = self.timing.stride // self.timing.step
        raw, smooth = ca.SX.sym("raw", len(_NAMES), new), ca.SX.sym("smooth", len(_NAMES), new)
        before, held, started = (
            ca.SX.sym("before", count),
            ca.SX.sym("held", memory.shape[0]),
            ca.SX.sym("started"),
        )
        at, z, rows = before, held, []
        for k in range(new):
            # smoothed, because a bent law rectifies noise; a straight one averages it as the kernel
            # does and needs the whole motion
            here, plain = where(smooth[:, k], fixed), where(raw[:, k], fixed)
            here = ca.vertcat(*(plain[i] if yes else here[i] for i, yes in enumerate(straight)))
            step = (here - at) * (started if k == 0 else 1)
            z = move(z, step, smooth[:, k], fixed, self.timing.dt * self.timing.step)
            at = here
            rows.append(one(raw[:, k], z, fixed, *shapes))
        return ca.Function(
            "points", [raw, smooth, before, held, started, *shapes], [ca.horzcat(*rows), at, z]
        )

    def _dependence(self, stacked: Any, signals: Any) -> BoolArray:
        used = ca.jacobian_sparsity(stacked, signals)
        found = np.zeros((len(self.balances), len(SOURCES)), dtype=bool)
        for row, column in zip(*used.get_triplet(), strict=True):
            for k, source in enumerate(SOURCES):
                if _NAMES[column] in POSITION_CHAINS[source]:
                    found[row, k] = True
        return found

    def _kernels(self) -> None:
        t = self.timing
        self._orders = max(len(c) for c in POSITION_CHAINS.values())
        size = t.window
        centre = size - 1 - t.reach
        self.averaging = np.zeros((self._orders, size))
        new = t.stride // t.step
        self.smoothing = np.zeros((self._orders, new, size))
        for order in range(self._orders):
            w = differentiated_kernel(t.length, t.dt, order)
            own = len(w) // 2
            self.averaging[order, centre - own : centre + own + 1] = w
            w = kernel(t.pointwise, t.dt, order)
            own = len(w) // 2
            for k in range(new):
                at = centre + (t.point_half - (new - 1 - k)) * t.step
                self.smoothing[order, k, at - own : at + own + 1] = w
        self.raw_at = [centre + (t.point_half - (new - 1 - k)) * t.step for k in range(new)]
        self.weights = differentiated_kernel(t.length, t.dt, 0, t.step)
        self.rate_weights = differentiated_kernel(t.length, t.dt, 1, t.step)
        self.place: list[tuple[int, int, int]] = [
            (_NAMES.index(name), order, k)
            for k, source in enumerate(SOURCES)
            for order, name in enumerate(POSITION_CHAINS[source])
        ]
        columns = np.array(self.place).T
        self._own_gain()
        self._index, self._flat = columns[0], columns[1] * len(SOURCES) + columns[2]
        points = np.arange(new)[:, None]
        self._to = (points * len(_NAMES) + columns[0]).ravel()
        self._from = ((columns[1] * new + points) * len(SOURCES) + columns[2]).ravel()
        sampled = [i for i, (_, order, _) in enumerate(self.place) if order == 0]
        self._raw_to = (points * len(_NAMES) + columns[0][sampled]).ravel()
        self._raw_from = (
            np.array(self.raw_at)[:, None] * len(SOURCES) + columns[2][sampled]
        ).ravel()
        self.speeds = [_NAMES.index("motor_velocity"), _NAMES.index("link_velocity")]
        self._sharpen()
        self.velocity_gain = float(np.linalg.norm(kernel(t.pointwise, t.dt, 1)))
        self._middle = centre
        self._flat_smoothing = self.smoothing.reshape(-1, size)
        self._smooth_sum, self._average_sum = (
            np.where(np.arange(len(table)) < plain, table.sum(axis=1), 0.0)[:, None]
            for table, plain in ((self._flat_smoothing, new), (self.averaging, 1))
        )
        self.still = _standstill(self.weights, self.velocity_gain)

    def _sharpen(self) -> None:
        """Velocities below which a side counts as standing still.

        A smoothing velocity that only stands for a jump says nothing of where friction turns over:
        rows at rest, which would tell, take no part in the fit of a joint file.
        """
        self.sharp = [
            2 * SHARP if self.model.named("smoothing", side) else 0.0 for side in ("motor", "link")
        ]

    def _slope_function(self, expressions: Mapping[str, Any], signals: Any, p: Any) -> Any:
        own = ca.vertcat(*expressions.values())
        sources = ca.vertcat(*(signals[_NAMES.index(n)] for n in SOURCES[:3]))
        memory = self.model.equations.memory
        return ca.Function("slopes", [signals, memory, p], [ca.densify(ca.jacobian(own, sources))])

    # --- running ----------------------------------------------------------------------------------

    def reset(self) -> None:
        """Before the first sample."""
        t = self.timing
        length = 2 * t.point_half + 1
        self._ring, self.speed = np.zeros((length, len(self.needed))), np.zeros((length, 2))
        new = t.stride // t.step
        count, states = self.point.size1_in(2), self.point.size1_in(3)
        self._in: list[FloatArray] = [
            np.zeros((new, len(_NAMES))),
            np.zeros((new, len(_NAMES))),
            np.zeros(count),
            np.zeros(states),
            np.zeros(1),
        ]
        self._out: list[FloatArray] = [
            np.zeros((new, len(self.needed))),
            np.zeros(count),
            np.zeros(states),
        ]
        buffer, self._trigger = self.point.buffer()
        for i, item in enumerate([*self._in, *([self.shape_values] if self.shapes else [])]):
            buffer.set_arg(i, memoryview(item))  # type: ignore[arg-type, unused-ignore]
        for i, item in enumerate(self._out):
            buffer.set_res(i, memoryview(item))  # type: ignore[arg-type, unused-ignore]
        self._buffer = buffer
        self._noise, self._sharp_now, self._share = np.zeros(2), np.zeros(2), np.zeros(2)
        still, self._find_still = self.still.buffer()
        for i, item in enumerate((self.speed, self._noise, self._sharp_now)):
            still.set_arg(i, memoryview(item))  # type: ignore[arg-type, unused-ignore]
        still.set_res(0, memoryview(self._share))  # type: ignore[arg-type, unused-ignore]
        self._still_buffer = still
        self.rows_before_ready = -(-length // new)
        self.made = 0
        self.signals = np.zeros(len(_NAMES))

    def make(self, window: FloatArray, time: float) -> tuple[FloatArray, FloatArray] | None:
        """A row from the last samples.

        Parameters
        ----------
        window : (timing.window, sources) array
            Oldest first, in the order of :data:`SOURCES`.
        time : float
            Time of the last sample [s].

        Returns
        -------
        (balances,) and (balances, parameters) array, or None until the kernel is filled.
        """
        raw, smooth, before, held, started = self._in
        middle = window[self._middle]
        apart = (
            window - middle
        )  # derivatives of a signal that stands still are zero then, and not rounding
        if self.needed:
            found = self._flat_smoothing @ apart
            found += self._smooth_sum * middle
            smooth.ravel()[self._to] = found.ravel()[self._from]
            raw[:] = smooth
            raw.ravel()[self._raw_to] = window.ravel()[self._raw_from]
            self._trigger()
            out, at, z = self._out
            before[:], held[:], started[0] = at, z, 1.0
            new = len(raw)
            self._ring[:-new] = self._ring[new:].copy()
            self._ring[-new:] = out
            self.speed[:-new] = self.speed[new:].copy()
            self.speed[-new:] = raw[:, self.speeds]
        self.made += 1
        averaged = self.averaging @ apart
        averaged += self._average_sum * middle
        self.signals[self._index] = averaged.ravel()[self._flat]
        self.signals[0] = time - self.timing.delay
        full = self.linear @ self.signals
        if self.needed:
            many = self.averaged
            full[self.needed[:many]] += self.weights @ self._ring[:, :many]
            if many < len(self.needed):
                full[self.needed[many:]] += self.rate_weights @ self._ring[:, many:]
        if self.made <= self.rows_before_ready:
            return None
        table = full.reshape(len(self.balances), self.width)
        h = -table[:, 1:]
        return table[:, 0] + h @ self.off, h

    @property
    def new_points(self) -> FloatArray:
        """Signals at the points that the last row has added, (points, signals); they stay as
        they are until the next row.
        """
        return self._in[0]

    def set_shapes(self, values: FloatArray) -> None:
        """Take other values for the shapes."""
        self.shape_values[:] = values
        self.linear = np.array(self.linear_of(self.shape_values))
        self._own_gain()
        self.model = self.model.with_values(
            dict(zip(self.shapes, self.shape_values.tolist(), strict=True))
        )
        self._sharpen()

    def take_over(self, other: RowMaker, points: FloatArray) -> None:
        """Go on where another maker of the same joint stands, with the laws of this one's shapes at
        the last points.

        Parameters
        ----------
        other : RowMaker
            Without internal states.
        points : (n, signals) array
            Signals at the last points, newest last; those that the kernel holds are enough.
        """
        self.made, self.signals = other.made, other.signals.copy()
        self.off[:] = other.off
        self.speed[:] = other.speed
        raw = self._in[0]
        new = len(raw)
        for at in range(len(points) % new, len(points), new):
            raw[:] = points[at : at + new]
            self._trigger()
            self._ring[:-new] = self._ring[new:].copy()
            self._ring[-new:] = self._out[0]

    def standstill(self, motor_noise: float, link_noise: float) -> FloatArray:
        """Share of the kernel in which motor and link stand still or turn round, as far as
        their noise lets one see, (2,).
        """
        if not self.needed:
            return np.zeros(2)
        self._noise[:], self._sharp_now[:] = (motor_noise, link_noise), self.sharp
        self._find_still()
        return self._share.copy()

    # --- noise ------------------------------------------------------------------------------------

    def _own_gain(self) -> None:
        """How the noise of each sampled signal gets into the entries of a row: of those that follow
        from the signals without a law, as accelerations do; a law sees smoothed signals.
        """
        table = self.linear.reshape(len(self.balances), self.width, len(_NAMES))[:, 1:]
        self.entry_gain = np.zeros((*table.shape[:2], len(SOURCES)))
        for k, source in enumerate(SOURCES):
            combined = sum(
                table[:, :, _NAMES.index(name), None] * self.averaging[order]
                for order, name in enumerate(POSITION_CHAINS[source])
            )
            self.entry_gain[:, :, k] = np.sum(combined**2, axis=2)

    def entry_noise(self, noise: FloatArray) -> FloatArray:
        """Variance that sensor noise gives each entry of H, (balances, parameters).

        Parameters
        ----------
        noise : (sources,) array
            Standard deviation of each sampled signal.
        """
        found: FloatArray = self.entry_gain @ noise**2
        return found

    def floor(self, theta: Sequence[float], noise: FloatArray) -> FloatArray:
        """RMS that sensor noise alone leaves in each balance, as
        :func:`identification.fitting.engine.floors`.

        Parameters
        ----------
        theta : sequence of float
            Estimated parameters.
        noise : (sources,) array
            Standard deviation of each sampled signal.
        """
        table = self.linear.reshape(len(self.balances), self.width, len(_NAMES))
        entering = table[:, 0] + np.einsum(
            "bks,k->bs", table[:, 1:], np.asarray(theta, dtype=np.float64)
        )
        estimated = dict(zip(self.names, theta, strict=True))
        values = [
            float(estimated.get(n, v))
            for n, v in zip(self.model.parameter_names, self.model.value_vector(), strict=True)
        ]
        slopes = np.array(self.slopes(self.signals, self._in[3], values))
        variance = np.zeros(len(self.balances))
        for k, source in enumerate(SOURCES):
            combined = np.zeros((len(self.balances), self.averaging.shape[1]))
            for order, name in enumerate(POSITION_CHAINS[source]):
                coefficient = entering[:, _NAMES.index(name)]
                if order == 0 and k < 3:
                    coefficient = np.where(coefficient == 0, slopes[:, k], coefficient)
                combined += coefficient[:, None] * self.averaging[order]
            variance += noise[k] ** 2 * np.sum(combined**2, axis=1)
        found: FloatArray = np.sqrt(variance)
        return found

    def numbers(self) -> list[FloatArray]:
        """Everything that changes."""
        return [
            self._ring,
            self.speed,
            self._in[2],
            self._in[3],
            self._in[4],
            self.signals,
            np.array([float(self.made)]),
        ]

    def load(self, arrays: Sequence[FloatArray]) -> None:
        """Take up what :meth:`numbers` gave."""
        for target, values in zip(self.numbers()[:-1], arrays, strict=False):
            target[:] = values.reshape(target.shape)
        self.made = int(arrays[-1][0])


def _standstill(weights: FloatArray, gain: float) -> Any:
    """(velocities at the points, (2, points), noise of the positions, velocities that count as none
    without noise) -> share of the kernel at rest or turning, (2,).
    """
    speed = ca.SX.sym("speed", 2, len(weights))
    noise, sharp = ca.SX.sym("noise", 2), ca.SX.sym("sharp", 2)
    slow = ca.fmax(SEEN * gain * noise, sharp)
    shares = []
    for side in range(2):
        share = ca.SX(0)
        for k, weight in enumerate(weights.tolist()):
            now = speed[side, k]
            still = ca.fabs(now) < slow[side]
            share += weight * (ca.logic_or(still, now * speed[side, k - 1] < 0) if k else still)
        shares.append(share)
    return ca.Function("still", [speed, noise, sharp], [ca.vertcat(*shares)])


def _alike(model: JointModel, names: Sequence[str]) -> IntArray:
    curves = [set(t.names) for t in model.terms if t.effect.table is not None]
    first = {
        n: next(i for i, m in enumerate(names) if n == m or any({n, m} <= c for c in curves))
        for n in names
    }
    return np.array([first[n] for n in names], dtype=np.int64)
