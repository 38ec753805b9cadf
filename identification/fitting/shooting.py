"""Windows of a record and a joint simulated over them, sensitivities riding along."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.solve import runge_kutta
from identification.balance.noise import EVEN, noise_level
from identification.balance.sensing import Sensing, signals_of
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.fitting.window_run import WindowRun

FloatArray = npt.NDArray[np.float64]

OUTPUT_ROWS: Final = {"motor_position": 0, "link_position": 2, "torque": 4}
"""Measured outputs and their row in ``JointFunctions.outputs``."""
RECORD_CHANNELS: Final = {
    "motor_position": "motor_position",
    "link_position": "link_position",
    "torque": "link_torque",
}
OFF_GRID: Final = 0.02
"""Part of a step by which a difference of quantised values may miss a whole number of steps: the
smallest step is a quantile, itself exact to the digits of the file.
"""
ON_GRID: Final = 0.95
"""Share of the differences on whole steps that makes a channel quantised: of values that are not, a
25th part falls within OFF_GRID by chance.
"""
STEPS_TOLD: Final = 1e6
"""Steps between neighbours beyond which OFF_GRID of one step is below the digits of a file."""
STABLE: Final = 1.5
"""Largest |eigenvalue| times step of the Runge-Kutta steps (their limit is 2.78)."""
MOST_SUBSTEPS: Final = 40
INLINED: Final = 4


@final
@dataclass(frozen=True)
class Windows:
    """A record cut into windows of one length.

    Attributes
    ----------
    channels : tuple of str
        Measured outputs, keys of :data:`OUTPUT_ROWS`.
    measured : (windows, channels, length) array
    inputs : (6, windows * length) array
        Drive and its rate at the start and at the end of each step, temperature, time.
    noise : (channels,) array
        Noise level of each channel.
    dt : float
        Sample time [s].
    """

    channels: tuple[str, ...]
    measured: FloatArray
    inputs: FloatArray
    noise: FloatArray
    dt: float

    @property
    def count(self) -> int:
        """Number of windows."""
        return int(self.measured.shape[0])

    @property
    def length(self) -> int:
        """Samples in a window."""
        return int(self.measured.shape[2])

    def every(self, stride: int) -> Windows:
        """One window in `stride`."""
        count, length = self.count, self.length
        inputs = self.inputs.reshape(len(self.inputs), count, length)[:, ::stride].reshape(
            len(self.inputs), -1
        )
        return Windows(
            self.channels,
            self.measured[::stride],
            np.ascontiguousarray(inputs),
            self.noise,
            self.dt,
        )

    def start_states(self, elastic: bool) -> FloatArray:
        """Position and velocity at the start of each window from a parabola through its first
        samples, (windows, states).
        """
        size = min(self.length, max(5, round(0.03 / self.dt)))
        t = np.arange(size) * self.dt
        inverse = np.linalg.pinv(np.vander(t, 3, increasing=True))[:2]
        found = {
            c: self.measured[:, i, :size] @ inverse.T
            for i, c in enumerate(self.channels)
            if c != "torque"
        }
        one = next(iter(found.values()))
        motor, link = found.get("motor_position", one), found.get("link_position", one)
        return np.concatenate([motor, link], axis=1) if elastic else motor


def cut_windows(
    records: Sequence[Record], joint: Joint, sensing: Sensing, window: float
) -> Windows:
    """Cut records into windows; what is left at the end of a stretch is not used.

    Raises
    ------
    InputError
        No stretch as long as a window; records of different sample time.
    """
    steps = [r.dt for r in records]
    dt = float(np.median(steps))
    length = round(window / dt)
    if length < 8:
        raise InputError(
            f"{records[0].name}: a window of {window:g} s has {length} samples; give at least "
            f"{8 * dt:g} s"
        )
    channels = tuple(c for c, name in RECORD_CHANNELS.items() if all(r.has(name) for r in records))
    measured: list[FloatArray] = []
    inputs: list[FloatArray] = []
    noise: list[list[float]] = []
    for record in records:
        if abs(record.dt - dt) > EVEN * dt:
            raise InputError(
                f"{record.name}: sample time {record.dt:.3g} s, other records {dt:.3g} s; refine "
                "them one by one"
            )
        inside = np.diff(record.segment) == 0
        if inside.any() and float(np.ptp(np.diff(record.time)[inside])) > EVEN * dt:
            record = record.resampled(dt)
        signals = signals_of(record, joint, sensing)
        segments = tuple(record.segments())
        noise.append(
            [
                max(noise_level(signals[c], segments), _grain(signals[c]) / math.sqrt(12), 1e-12)
                for c in channels
            ]
        )
        for s in segments:
            whole = (s.stop - s.start - 1) // length
            if whole < 1:
                continue
            at = np.arange(s.start, s.start + whole * length)
            measured.append(
                np.stack([signals[c][at].reshape(whole, length) for c in channels], axis=1)
            )
            drive = signals["drive"]
            rate = np.gradient(drive[s], dt)
            warm = signals["temperature"][at] if "temperature" in signals else np.zeros(len(at))
            local = at - s.start
            inputs.append(
                np.stack(
                    [drive[at], rate[local], drive[at + 1], rate[local + 1], warm, record.time[at]]
                )
            )
    if not measured:
        raise InputError(
            f"{records[0].name}: no stretch is as long as a window of {window:g} s; give a "
            "longer record or a shorter window"
        )
    return Windows(
        channels,
        np.concatenate(measured),
        np.concatenate(inputs, axis=1),
        np.median(np.array(noise), axis=0),
        dt,
    )


def _grain(values: FloatArray) -> float:
    """Step of a quantised channel; 0 where the smallest difference is no step."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-14 * max(float(np.abs(values).max(initial=0.0)), 1e-300)]
    if len(steps) < 8:
        return 0.0
    smallest = float(np.quantile(steps, 0.01))
    ratio = steps / smallest
    return (
        smallest
        if float(np.mean(np.abs(ratio - np.round(ratio)) < OFF_GRID)) > ON_GRID
        and ratio.max() < STEPS_TOLD
        else 0.0
    )


def substeps_for(model: JointModel, values: Mapping[str, float], data: Windows) -> int:
    """Runge-Kutta steps per sample that keep the fastest motion of the model stable and accurate.

    Raises
    ------
    InputError
        More than 40 steps a sample: the friction smoothing is too sharp for the sample time.
    """
    p = np.array([values[n] for n in model.parameter_names])
    states = data.start_states(model.is_elastic)[:: max(1, data.count // 20)]
    still = states.copy()
    still[:, 1::2] = 0.0
    fastest = 0.0
    for x in np.concatenate([states, still]):
        found = np.array(model.functions.jacobian(x, np.zeros(3), p)[0])
        if np.isfinite(found).all():
            fastest = max(fastest, float(np.abs(np.linalg.eigvals(found)).max()))
    count = max(1, math.ceil(fastest * data.dt / STABLE))
    if count > MOST_SUBSTEPS:
        speed = f"the model moves at {fastest:.3g} 1/s, too fast for samples of {data.dt:.3g} s"
        raise InputError(
            f"output-error refinement: {speed}; record faster or use the weak-form fit"
        )
    return count


@final
class Shooting:
    """A joint model simulated over all windows.

    Parameters
    ----------
    model : JointModel
        Without internal states.
    free : sequence of str
        Parameters whose sensitivities ride along.
    data : Windows
    substeps : int
        Runge-Kutta steps per sample.
    """

    def __init__(
        self, model: JointModel, free: Sequence[str], data: Windows, substeps: int
    ) -> None:
        self.free = tuple(free)
        parameters = {p.name: p for p in model.parameters}
        self.logarithmic = np.array(
            [parameters[n].is_shape and parameters[n].scale != "absolute" for n in free], dtype=bool
        )
        self.states = 4 if model.is_elastic else 2
        self._names = model.parameter_names
        self.data = data
        rows = [OUTPUT_ROWS[c] for c in data.channels]
        samples = data.count * data.length
        self._plain = WindowRun(_sample(model, None, rows, data.dt, substeps), data.length, samples)
        self._full = WindowRun(
            _sample(model, self.free, rows, data.dt, substeps), data.length, samples
        )

    def every(self, stride: int) -> Shooting:
        """The same simulation over one window in `stride`."""
        out = copy(self)
        out.data = self.data.every(stride)
        return out

    def errors(self, values: Mapping[str, float], x0: FloatArray) -> FloatArray:
        """Simulated less measured outputs, (windows, channels, length); not finite where the
        simulation diverges.
        """
        found = self._plain(x0, self.data.inputs.T, self._vector(values))
        out: FloatArray = found.transpose(0, 2, 1) - self.data.measured
        return out

    def columns(self, values: Mapping[str, float], x0: FloatArray) -> FloatArray:
        """Slopes along initial states and free parameters, and the errors, (windows, columns +
        1, channels, length).
        """
        data, channels, wide = self.data, len(self.data.channels), self.states + len(self.free)
        start = np.zeros((data.count, self.states * (1 + wide)))
        start[:, : self.states] = x0
        for i in range(self.states):
            start[:, self.states * (1 + i) + i] = 1.0
        found = self._full(start, data.inputs.T, self._vector(values)).transpose(0, 2, 1)
        found = found.reshape(data.count, 1 + wide, channels, data.length)
        out = np.empty_like(found)
        out[:, :-1], out[:, -1] = found[:, 1:], found[:, 0] - data.measured
        return out

    def _vector(self, values: Mapping[str, float]) -> FloatArray:
        return np.array([values[n] for n in self._names])


def _sample(
    model: JointModel, free: Sequence[str] | None, rows: Sequence[int], dt: float, substeps: int
) -> Any:
    """CasADi function (state and sensitivities, inputs, p) -> (the same one sample later, outputs
    and their slopes).

    Without `free` the state alone.
    """
    functions, names = model.functions, model.parameter_names
    n = 4 if model.is_elastic else 2
    k = 0 if free is None else n + len(free)
    chosen = [names.index(f) for f in free or ()]
    delays = [names.index(name) for name in model.named("delay", "drive")]
    x, u, p = ca.SX.sym("x", n), ca.SX.sym("u", 6), ca.SX.sym("p", len(names))
    slopes, share = ca.SX.sym("S", n, k), ca.SX.sym("share")

    def applied(c: Any) -> Any:
        """Inputs of the dynamics at the share c of the sample."""
        late = sum(p[i] for i in delays) * (u[1] + c * (u[3] - u[1]))
        return ca.vertcat(u[0] + c * (u[2] - u[0]) + late, u[4], u[5] + c * dt)

    def with_slopes(expression: Any) -> Any:
        """An expression of (x, p) with its slopes along the columns."""
        if not k:
            return expression
        own = ca.horzcat(ca.SX.zeros(expression.size1(), n), ca.jacobian(expression, p)[:, chosen])
        return ca.vertcat(expression, ca.vec(ca.jacobian(expression, x) @ slopes + own))

    h = dt / substeps
    inputs = {at: applied(share + at / substeps) for at in (0.0, 0.5, 1.0)}
    new = runge_kutta(lambda at, state: functions.dynamics(state, inputs[at], p), x, h)
    whole = ca.vertcat(x, ca.vec(slopes)) if k else x
    step = ca.Function("step", [whole, u, p, share], ca.cse([with_slopes(new)]))
    y = functions.outputs(x, applied(ca.SX(0)), p)[list(rows)]
    read = ca.Function("read", [whole, u, p], ca.cse([ca.densify(with_slopes(y))]))
    kind = ca.SX if substeps <= INLINED else ca.MX
    a, b, c = kind.sym("a", n * (1 + k)), kind.sym("b", 6), kind.sym("c", len(names))
    now = a
    for i in range(substeps):
        now = step(now, b, c, i / substeps)
    return ca.Function("sample", [a, b, c], [ca.densify(now), read(a, b, c)])
