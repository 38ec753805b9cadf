"""Rows of the balances while they happen: the weak form of :mod:`identification.weak` on the last samples.

Every `stride` samples a row is the kernel average of each balance, written as y = H theta with the parameters that
enter all balances linearly; the others are held. Kernels, points and laws are those of the off-line fit, so that both
estimate the same. A row belongs to the instant `delay` before it is made.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import JointModel, Signals
from identification.balances import residual_expressions
from identification.sensing import Sensing
from identification.weak import POSITION_CHAINS, differentiated_kernel, kernel

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

SOURCES: Final = ("motor_position", "link_position", "torque", "drive")
"""Signals that are sampled; the others follow from them on the kernel."""
_NAMES: Final = Signals.names()
_SHARP: Final = 2e-3
"""A smoothing velocity above this is a law of its own, below it only stands for a jump [rad/s]."""
_LENGTH, _OVERLAP, _POINT_STEP = 0.06, 4, 0.002


def linear_parameters(model: JointModel, sensing: Sensing, held: Container[str] = ()) -> tuple[str, ...]:
    """Largest set of parameters, `held` left out, that enter all balances jointly linearly.

    The greedy set of :func:`casadi_models.equations.linear_set`, on the residuals of the balances.
    """
    p = model.equations.parameters
    stacked = ca.vertcat(*residual_expressions(model, sensing).values())
    names = model.parameter_names
    edges: dict[int, set[int]] = {i: set() for i in range(len(names))}
    for row in ca.vertsplit(stacked):
        for i, j in zip(*ca.hessian(row, p)[0].sparsity().get_triplet(), strict=True):
            edges[i].add(j)
    present = set(ca.jacobian(stacked, p).sparsity().get_triplet()[1])
    chosen = {i for i in present if i not in edges[i] and names[i] not in held}
    while True:
        degree = {i: len(edges[i] & chosen) for i in chosen}
        worst = max(degree, key=lambda i: (degree[i], i), default=None)
        if worst is None or degree[worst] == 0:
            return tuple(names[i] for i in sorted(chosen))
        chosen.discard(worst)


@final
@dataclass(frozen=True)
class Timing:
    """Kernel lengths in samples.

    Attributes
    ----------
    dt : float
        Sample time [s].
    length, pointwise : float
        Kernel of the balances, and of the velocities inside nonlinear laws [s].
    step, stride : int
        Samples between points, and between rows.
    half, reach, point_half : int
        Half the kernel in samples; samples a row lies back; half the kernel in points.
    window : int
        Samples that a row needs.
    """

    dt: float
    length: float
    pointwise: float
    step: int
    stride: int
    half: int
    reach: int
    point_half: int
    window: int

    @staticmethod
    def of(dt: float) -> Timing:
        """The lengths that the off-line fit uses at this sample time."""
        length = max(_LENGTH, 8 * dt)
        pointwise = max(length / 2 if length <= _LENGTH else 0.06, 6 * dt)
        step = max(1, round(_POINT_STEP / dt))
        stride = max(step, round(length / dt / _OVERLAP / step) * step)
        half = len(differentiated_kernel(length, dt, 3)) // 2
        point_half = len(differentiated_kernel(length, dt * step, 0)) // 2
        own = len(kernel(pointwise, dt, 3)) // 2
        reach = max(half, point_half * step + own)
        window = reach + max(half, point_half * step + own) + 1
        return Timing(dt, length, pointwise, step, stride, half, reach, point_half, window)

    @property
    def delay(self) -> float:
        """Time between a row's instant and the sample at which it is made [s]."""
        return self.reach * self.dt


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

    Attributes
    ----------
    names : tuple of str
        Parameters that are estimated.
    balances : tuple of str
    uses : (balances, sources) bool array
        Which sampled signals enter which balance.
    """

    def __init__(self, model: JointModel, sensing: Sensing, dt: float, held: Container[str] = ()) -> None:
        self.model, self.sensing, self.timing = model, sensing, Timing.of(dt)
        self.names = linear_parameters(model, sensing, held)
        expressions = residual_expressions(model, sensing)
        self.balances = tuple(expressions)
        e = model.equations
        signals, p = e.signals.vector(), e.parameters
        columns = [model.parameter_names.index(n) for n in self.names]
        fixed = self._values()
        stacked: list[Any] = []
        for r in expressions.values():
            (free,) = ca.substitute([r], [p], [fixed])
            slopes = ca.jacobian(r, p)[:, columns]
            (slopes,) = ca.substitute([slopes], [p], [fixed])
            stacked += [free, *ca.vertsplit(slopes.T)]
        self.width = 1 + len(self.names)
        self._split(ca.vertcat(*stacked), signals, e.memory, fixed)
        self.uses = self._dependence(ca.vertcat(*expressions.values()), signals)
        self._kernels()
        self._slopes = self._slope_function(expressions, signals, p)
        self.reset()

    def _values(self) -> Any:
        """Parameter vector with the estimated ones at zero."""
        return ca.DM([
            0.0 if n in self.names else v
            for n, v in zip(self.model.parameter_names, self.model.value_vector(), strict=True)
        ])  # fmt: skip

    def _split(self, out: Any, signals: Any, memory: Any, fixed: Any) -> None:
        """Part that is linear in the signals, and the laws to be evaluated at points."""
        slopes = ca.jacobian(out, signals)
        linear = np.zeros(slopes.shape, dtype=bool)
        for row, column in zip(*slopes.sparsity().get_triplet(), strict=True):
            entry = slopes[row, column]
            linear[row, column] = not (ca.depends_on(entry, signals) or (memory.shape[0] and ca.depends_on(entry, memory)))
        self.linear: FloatArray = np.array(
            ca.Function("linear", [], [ca.densify(slopes * ca.DM(linear.astype(float)))])()["o0"]
        )  # fmt: skip
        rest: list[Any] = []
        self.needed: list[int] = []
        for i in range(out.shape[0]):
            gone = [signals[j] for j in range(len(_NAMES)) if linear[i, j]]
            (left,) = ca.substitute([out[i]], gone, [ca.SX(0)] * len(gone)) if gone else [out[i]]
            if not ca.simplify(left).is_zero():
                self.needed.append(i)
                rest.append(left)
        self._point = self._point_function(ca.vertcat(*rest) if rest else ca.SX(0, 1), signals, memory, fixed)

    def _point_function(self, rest: Any, signals: Any, memory: Any, fixed: Any) -> Any:
        """(signals, smooth signals, coordinates before, memory before) -> laws, coordinates, memory, for the new points."""
        e = self.model.equations
        coordinates = ca.vertcat(*(t[1] for t in e.memory_terms)) if e.memory_terms else ca.SX(0, 1)
        count = coordinates.shape[0]
        steps = ca.SX.sym("steps", count)
        moved: list[Any] = []
        for i, (term, _, z, view, values) in enumerate(e.memory_terms):
            if term.effect.memory is not None:
                moved.extend(term.effect.memory(z, steps[i], view, values))
        after = ca.vertcat(*moved) if moved else ca.SX(0, 1)
        p = e.parameters
        one = ca.Function("one", [signals, memory, p], [ca.densify(rest)])
        where = ca.Function("where", [signals, p], [ca.densify(coordinates)])
        move = ca.Function("move", [memory, steps, signals, p, e.clock], [ca.densify(after)])
        new = self.timing.stride // self.timing.step
        raw, smooth = ca.SX.sym("raw", len(_NAMES), new), ca.SX.sym("smooth", len(_NAMES), new)
        before, held, started = ca.SX.sym("before", count), ca.SX.sym("held", memory.shape[0]), ca.SX.sym("started")
        at, z, rows = before, held, []
        for k in range(new):
            here = where(smooth[:, k], fixed)
            step = (here - at) * (started if k == 0 else 1)
            z = move(z, step, smooth[:, k], fixed, self.timing.dt * self.timing.step)
            at = here
            rows.append(one(raw[:, k], z, fixed))
        return ca.Function("points", [raw, smooth, before, held, started], [ca.horzcat(*rows), at, z])

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
        self._smoothing = np.zeros((self._orders, new, size))
        for order in range(self._orders):
            w = differentiated_kernel(t.length, t.dt, order)
            own = len(w) // 2
            self.averaging[order, centre - own : centre + own + 1] = w
            w = kernel(t.pointwise, t.dt, order)
            own = len(w) // 2
            for k in range(new):
                at = centre + (t.point_half - (new - 1 - k)) * t.step
                self._smoothing[order, k, at - own : at + own + 1] = w
        self._raw_at = [centre + (t.point_half - (new - 1 - k)) * t.step for k in range(new)]
        self._weights = differentiated_kernel(t.length, t.dt * t.step, 0)
        self._place: list[tuple[int, int, int]] = [
            (_NAMES.index(name), order, k)
            for k, source in enumerate(SOURCES) for order, name in enumerate(POSITION_CHAINS[source])
        ]  # fmt: skip
        columns = np.array(self._place).T
        self._index, self._flat = columns[0], columns[1] * len(SOURCES) + columns[2]
        self._speeds = [_NAMES.index("motor_velocity"), _NAMES.index("link_velocity")]
        smooth = dict(zip(self.model.parameter_names, self.model.value_vector(), strict=True))
        self._sharp = [2 * min(smooth.get(f"{place}_smoothing_velocity", 0.0), _SHARP) for place in ("motor", "link")]
        self._velocity_gain = float(np.linalg.norm(kernel(t.pointwise, t.dt, 1)))

    def _slope_function(self, expressions: Mapping[str, Any], signals: Any, p: Any) -> Any:
        own = ca.vertcat(*expressions.values())
        sources = ca.vertcat(*(signals[_NAMES.index(n)] for n in SOURCES[:3]))
        memory = self.model.equations.memory
        return ca.Function("slopes", [signals, memory, p], [ca.densify(ca.jacobian(own, sources))])

    # --- running -----------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Before the first sample."""
        t = self.timing
        length = 2 * t.point_half + 1
        self._ring, self._speed = np.zeros((length, len(self.needed))), np.zeros((length, 2))
        new = t.stride // t.step
        count, states = self._point.size1_in(2), self._point.size1_in(3)
        self._in: list[FloatArray] = [np.zeros((new, len(_NAMES))), np.zeros((new, len(_NAMES))), np.zeros(count), np.zeros(states), np.zeros(1)]
        self._out: list[FloatArray] = [np.zeros((new, len(self.needed))), np.zeros(count), np.zeros(states)]
        buffer, self._trigger = self._point.buffer()
        for i, item in enumerate(self._in):
            buffer.set_arg(i, memoryview(item))  # type: ignore[arg-type, unused-ignore]
        for i, item in enumerate(self._out):
            buffer.set_res(i, memoryview(item))  # type: ignore[arg-type, unused-ignore]
        self._buffer = buffer
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
        if self.needed:
            found = (self._smoothing.reshape(-1, len(window)) @ window).reshape(self._orders, len(raw), len(SOURCES))
            flat = found.transpose(1, 0, 2).reshape(len(raw), -1)
            smooth[:, self._index] = flat[:, self._flat]
            raw[:] = smooth
            raw[:, self._index[[0, 4, 8, 10]]] = window[self._raw_at]
            self._trigger()
            out, at, z = self._out
            before[:], held[:], started[0] = at, z, 1.0
            new = len(raw)
            self._ring[:-new] = self._ring[new:].copy()
            self._ring[-new:] = out
            self._speed[:-new] = self._speed[new:].copy()
            self._speed[-new:] = raw[:, self._speeds]
        self.made += 1
        averaged = (self.averaging @ window).ravel()
        self.signals[self._index] = averaged[self._flat]
        self.signals[0] = time - self.timing.delay
        full = self.linear @ self.signals
        if self.needed:
            full[self.needed] += self._weights @ self._ring
        if self.made <= self.rows_before_ready:
            return None
        table = full.reshape(len(self.balances), self.width)
        return table[:, 0].copy(), -table[:, 1:]

    def standstill(self, place: str, noise: float) -> float:
        """Share of the kernel in which a side stands still or turns round, as far as its noise lets one see."""
        if not self.needed:
            return 0.0
        side = 0 if place == "motor" else 1
        slow, speed = max(3 * noise * self._velocity_gain, self._sharp[side]), self._speed[:, side]
        still = np.abs(speed) < slow
        still[1:] |= speed[1:] * speed[:-1] < 0
        return float(self._weights @ still)

    # --- noise -------------------------------------------------------------------------------------------------------

    def floor(self, theta: Sequence[float], noise: FloatArray) -> FloatArray:
        """RMS that sensor noise alone leaves in each balance, as :func:`identification.engine.floors`.

        Parameters
        ----------
        theta : sequence of float
            Estimated parameters.
        noise : (sources,) array
            Standard deviation of each sampled signal.
        """
        table = self.linear.reshape(len(self.balances), self.width, len(_NAMES))
        entering = table[:, 0] + np.einsum("bks,k->bs", table[:, 1:], np.asarray(theta, dtype=np.float64))
        estimated = dict(zip(self.names, theta, strict=True))
        values = [float(estimated.get(n, v)) for n, v in zip(self.model.parameter_names, self.model.value_vector(), strict=True)]
        slopes = np.array(self._slopes(self.signals, self._in[3], values))
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
        return [self._ring, self._speed, self._in[2], self._in[3], self._in[4], self.signals, np.array([float(self.made)])]

    def load(self, arrays: Sequence[FloatArray]) -> None:
        """Take up what :meth:`numbers` gave."""
        for target, values in zip(self.numbers()[:-1], arrays, strict=False):
            target[:] = values.reshape(target.shape)
        self.made = int(arrays[-1][0])
