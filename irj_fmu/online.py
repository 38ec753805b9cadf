"""The online estimator of a joint: balances, recursive least squares, checks, fault detection; no FMI in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.joint_file import Joint
from identification.recursive import RecursiveLeastSquares, Settings

from .first_window import least_range, least_squares
from .online_options import OnlineOptions, estimated_parameters, held_parameters, prepared
from .rows import SOURCES, RowMaker
from .state_bytes import pack, unpack
from .verdict import CONSTANT, FAULT_TEXT, MISSING, NONE, SCALED, implausible, plant_alarm, scale_limits, scores
from .watch import DRIVE, Q_L, Q_M, SAMPLED, TAU, W_L, W_M, Watch

if TYPE_CHECKING:
    from identification.fault import FaultDetector

FloatArray = npt.NDArray[np.float64]

_RESIDUAL_SECONDS: Final = 2.0
_PLAIN: Final = (
    "_end", "_since", "_rows", "_started", "_lost", "_last_good", "fault", "score", "readings", "plant_alarm", "events",
)  # fmt: skip
_ARRAYS: Final = ("_buffer", "theta", "sigma", "residual", "floor", "ratio", "_square", "_torque", "_scale")
"""What changes from sample to sample, besides rows, watch, recursion and detector."""


@final
class OnlineEstimator:
    """Estimates the linear parameters of a joint sample by sample.

    Parameters
    ----------
    joint : Joint
        The joint file; shapes of friction laws are held at its values.
    dt : float
        Sample time [s].
    options : OnlineOptions, optional
    detector_state : bytes, optional
        State of a calibrated :class:`identification.fault.FaultDetector` of this joint.

    Attributes
    ----------
    names, theta, sigma
        Estimated parameters, values and standard deviations, link-referred SI.
    residual, floor, ratio : (balances,) array
        Residual of the last row, floor, and root mean square of the last seconds over the floor.
    fault, score
        See :data:`FAULT_TEXT`; how far each reading's residuals are from their limits (1: at the limit).
    """

    def __init__(
        self, joint: Joint, dt: float, options: OnlineOptions | None = None, detector_state: bytes | None = None
    ) -> None:
        self.joint, self.dt = joint, dt
        self.options = options or OnlineOptions()
        self.model, self.sensing = prepared(joint, self.options)
        self.rows = RowMaker(self.model, self.sensing, dt, held_parameters(joint))
        self.names, self.balances = self.rows.names, self.rows.balances
        self._units = {p.name: p for p in self.model.parameters}
        has_link = self.options.has_link
        self.present = (True, True, True, has_link, has_link, self.options.has_torque)
        used: list[bool] = np.any(self.rows.uses, axis=0).tolist()
        self._needs = [False] * 6
        for k, reading in enumerate(SAMPLED):
            self._needs[reading] = used[k] and self.present[reading]
        self.watch = Watch(dt, self.present)
        self._detector_state, self._margin = detector_state, 1.0
        self.detector = self._make_detector() if self.options.detect else None
        self._collect = max(2 * len(self.names), round(self.options.warm_up / (self.rows.timing.stride * dt)))
        self._friction = [
            [self.names.index(p.name) for t in self.model.terms if t.place == place and t.effect.family == "friction"
             for p in t.parameters if p.unit == "N.m" and p.name in self.names]
            for place in ("motor", "link")
        ]  # fmt: skip
        self._feels = np.array([
            [place in b or b in ("sum", "axis") or (b == "deflection" and place == "motor") for place in ("motor", "link")]
            for b in self.balances
        ])  # fmt: skip
        self.reset()
        self._recursion(self.theta)  # its functions are made here and not inside a step

    def _make_detector(self) -> FaultDetector | None:
        if not (self.model.is_elastic and self.is_fitted):
            return None
        from identification.fault import FaultDetector

        made = FaultDetector(self.model, self.dt, has_torque=self.options.has_torque)
        if self._detector_state:
            made.restore(self._detector_state)
            made.reset()
        return made

    # --- life --------------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Before the first sample."""
        t, count, n = self.rows.timing, len(self.balances), len(self.names)
        self.rows.reset()
        self.watch.reset()
        if self.detector is not None:
            self.detector.reset()
        self._buffer = np.zeros((4 * t.window, len(SOURCES)))
        self._end = self._since = self._rows = 0
        self._started = False
        self._last_good = [0.0] * 6
        self._lost = [0] * len(SOURCES)
        self._collected: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self.estimator: RecursiveLeastSquares | None = None
        self._scale = np.ones(n)
        values = dict(zip(self.model.parameter_names, self.model.value_vector(), strict=True))
        self.theta = np.array([values[name] for name in self.names])
        self.sigma = np.zeros(n)
        self.residual, self.floor, self.ratio = np.zeros(count), np.zeros(count), np.zeros(count)
        self._square, self._torque = np.zeros(count), np.zeros(count)
        self.fault, self.score = NONE, [0.0] * 6
        self.plant_alarm = 0
        self.readings = [0.0] * 6
        self.events: list[str] = []

    @property
    def warming_up(self) -> bool:
        """True until the recursion has started."""
        return self.estimator is None

    @property
    def is_fitted(self) -> bool:
        """True where the joint file has a value for every estimated parameter."""
        return all(n in self.joint.fitted for n in self.names)

    @property
    def made(self) -> int:
        """Rows so far."""
        return self._rows

    def set_fault_margin(self, factor: float) -> None:
        """Multiply the fault detector's limits."""
        if self.detector is not None and factor != self._margin:
            scale_limits(self.detector, factor / self._margin)
            self._margin = factor

    def update(self, time: float, readings: Sequence[float], valid: Sequence[bool], *, enable: bool = True) -> bool:
        """Take one sample.

        Parameters
        ----------
        time : float
            [s]
        readings : sequence of float
            Drive torque, motor position and velocity, link position and velocity, torque; link-referred SI, finite.
        valid : sequence of bool
            False for a reading that is missing.
        enable : bool
            False: the estimate is held.

        Returns
        -------
        bool
            True where a row was made.
        """
        good = [bool(valid[i]) and self.present[i] for i in range(6)]
        looked = self.watch.add(list(readings), good)
        used = [float(readings[i]) if good[i] else self._last_good[i] for i in range(6)]
        self._last_good = used
        failed = self._detect(readings, good)
        self._push(failed, good)
        made = False
        self._since += 1
        if self._since >= self.rows.timing.stride:
            self._since = 0
            made = self._row(time, enable)
            self._judge(good)
        if looked:
            self._floors()
        return made

    def _detect(self, readings: Sequence[float], good: list[bool]) -> list[bool]:
        """Run the fault detector; readings with failed ones replaced go to `self.readings`."""
        detector = self.detector
        if detector is None:
            self.readings = list(self._last_good)
            if not good[Q_L]:
                self.readings[Q_L], self.readings[W_L] = self._link_from_motor()
            return [False] * 6
        row = [float(readings[i]) if good[i] else float("nan") for i in range(6)]
        self.readings = detector.update(row)
        return list(detector._rule.failed)

    def _link_from_motor(self) -> tuple[float, float]:
        """Link position and velocity from the motor, torsion taken off."""
        q = self._last_good
        if not self.model.is_elastic or not self.options.has_torque:
            return q[Q_M], q[W_M]
        stiffness = dict(zip(self.names, self.theta.tolist(), strict=True)).get("stiffness", 0.0)
        return (q[Q_M] - q[TAU] / stiffness if stiffness > 0 else q[Q_M]), q[W_M]

    def _push(self, failed: list[bool], good: list[bool]) -> None:
        t = self.rows.timing
        if self._end == len(self._buffer):
            keep = t.window
            self._buffer[:keep] = self._buffer[-keep:].copy()
            self._end = keep
        q = self.readings
        motor, link = q[Q_M], q[Q_L] if self.present[Q_L] else q[Q_M]
        new = (motor, link, q[TAU], q[DRIVE])
        if not self._started:
            self._started = True
            self._buffer[: t.window] = new
            self._end = t.window
        self._buffer[self._end] = new
        self._end += 1
        watch = self.watch
        for k, reading in enumerate(SAMPLED):
            bad = not good[reading] and self._needs[reading]
            if bad or failed[reading] or watch.constant[reading] or watch.scaled[reading]:
                self._lost[k] = t.window + t.stride
            elif self._lost[k]:
                self._lost[k] -= 1

    # --- rows --------------------------------------------------------------------------------------------------------

    def _row(self, time: float, enable: bool) -> bool:
        window = self._buffer[self._end - self.rows.timing.window : self._end]
        found = self.rows.make(window, time)
        if found is None:
            return False
        y, h = found
        self._rows += 1
        lost = np.array([count > 0 for count in self._lost])
        on = ~(self.rows.uses & lost).any(axis=1)
        if self.estimator is None:
            if enable and on.all():
                self._collected.append((y, h, self._shares()))
                if len(self._collected) >= self._collect:
                    self._begin()
            return True
        error = y - h @ self.theta
        self.residual = error
        period = self.rows.timing.stride * self.dt
        rate = period / _RESIDUAL_SECONDS
        signals, weight = self.rows.signals, self._weights()
        for b, balance in enumerate(self.balances):
            if on[b]:
                reference = signals[11] if balance in ("link", "transmission") else signals[1]
                self._square[b] += rate * ((weight[b] * error[b]) ** 2 - self._square[b])
                self._torque[b] += rate / 5 * (reference**2 - self._torque[b])
        self._ratios()
        if not enable or not on.any():
            return True
        for b in range(len(on)):
            self.estimator.enable(b, bool(on[b]))
        self.theta = self.estimator.update(y * weight, h * weight[:, None])
        noise = self.estimator._ready("noise").part("fast", "noise")
        np.maximum(noise, self._least() ** 2, out=noise)
        return True

    def _shares(self) -> FloatArray:
        """Share of the kernel in which motor and link stand still or turn round."""
        noise = self.watch.noise
        return np.array([self.rows.standstill("motor", noise[Q_M]), self.rows.standstill("link", noise[Q_L])])

    def _weights(self) -> FloatArray:
        """Rows at a reversal count less: there friction may take any value between its limits."""
        size = np.maximum(np.maximum(self.floor, np.sqrt(self._square)), 1e-12)
        found: FloatArray = self._weight_of(self._shares()[None], self.theta, size)[0]
        return found

    def _weight_of(self, shares: FloatArray, theta: FloatArray, size: FloatArray) -> FloatArray:
        """Weights (rows, balances) from the shares (rows, 2) and the size of the residuals (balances,)."""
        level = np.array([float(np.abs(theta[which]).sum()) if which else 0.0 for which in self._friction])
        doubt = (shares * level)[:, None, :] * self._feels
        found: FloatArray = 1.0 / np.sqrt(1.0 + np.sum(doubt**2, axis=2) / size**2)
        return found

    def _begin(self) -> None:
        """Start the recursion from the collected rows."""
        y = np.array([row[0] for row in self._collected])
        h = np.array([row[1] for row in self._collected])
        shares = np.array([row[2] for row in self._collected])
        weight = np.ones_like(y)
        for _ in range(3):
            first = least_squares(y * weight, h * weight[:, :, None])
            size = 1.5 * np.median(np.abs(y - h @ first), axis=0)
            weight = self._weight_of(shares, first, np.maximum(size, 1e-9 * float(np.max(np.abs(y)))))
        y, h = y * weight, h * weight[:, :, None]
        self._scale = np.maximum(np.maximum(np.abs(first), np.abs(self.theta)), least_range(h, y))
        self.estimator = self._recursion(self.theta)
        started = self.estimator.startup(y, h, limit=1e-6)
        self.estimator.release()
        if started.removed:
            self.events.append(f"not determined by the first window: {', '.join(started.removed)}")
        self.theta = self.estimator.theta
        self.sigma = self.estimator.deviation
        self._square = np.mean((y - h @ self.theta) ** 2, axis=0)
        signals = self.rows.signals
        self._torque[:] = [signals[11] ** 2 if b in ("link", "transmission") else signals[1] ** 2 for b in self.balances]
        self._collected = []
        self._floors()

    def _recursion(self, values: FloatArray) -> RecursiveLeastSquares:
        period = self.rows.timing.stride * self.dt
        settings = Settings(
            sample_time=period, drift=self.options.drift, alarm_drift=self.options.alarm_drift, window_seconds=2.0,
            rank_seconds=8.0,
        )  # fmt: skip
        return RecursiveLeastSquares(values, self._scale, outputs=len(self.balances), names=self.names, settings=settings)

    def retune(self, options: OnlineOptions) -> None:
        """Take up other forgetting bounds and floors while running; the estimate stays."""
        self.options = replace(self.options, drift=options.drift, alarm_drift=options.alarm_drift, floor_share=options.floor_share)
        if self.estimator is not None:
            fresh = self._recursion(self.theta)
            old, new = self.estimator._ready("retune"), fresh._ready("retune")
            new.fast[:], new.slow[:] = old.fast, old.slow
            new.theta[:] = old.theta
            self.estimator = fresh

    # --- judgement ---------------------------------------------------------------------------------------------------

    def _floors(self) -> None:
        if self.estimator is None:
            return
        noise = self.watch.noise[list(SAMPLED)]
        self.floor = self.rows.floor(self.theta.tolist(), noise)
        self.sigma = self.estimator.deviation
        self._ratios()

    def _ratios(self) -> None:
        self.ratio = np.sqrt(self._square) / self._least()

    def _least(self) -> FloatArray:
        """What counts as noise at least: the floor, and a share of the torque balanced [N.m]."""
        share = self.options.floor_share * np.sqrt(self._torque)
        found: FloatArray = np.maximum(np.maximum(self.floor, share), 1e-12)
        return found

    def _judge(self, good: list[bool]) -> None:
        """The most severe fault now, and the scores."""
        found, watch = NONE, self.watch
        for i in range(6):
            if not good[i] and (self._needs[i] or (self.detector is not None and self.present[i])):
                found = found or MISSING + 1 + i
        detector = self.detector
        if detector is not None:
            for i, failed in enumerate(detector._rule.failed):
                if failed and not found:
                    found = 1 + i
            self.plant_alarm = plant_alarm(detector, self.dt)
            self.score = scores(detector)
        for flags, code in ((watch.constant, CONSTANT), (watch.scaled, SCALED)):
            for i in range(6):
                if flags[i] and not found:
                    found = code + 1 + i
        if not found and self.estimator is not None and self.is_fitted:
            found = implausible(self.names, self.theta, self.sigma, self.joint.fitted)
        found = found or self.plant_alarm
        if found != self.fault and found:
            self.events.append(f"fault {found}")
        self.fault = found

    # --- state -------------------------------------------------------------------------------------------------------

    def state(self) -> bytes:
        """Everything the estimator will use again, as bytes."""
        plain = {name: getattr(self, name) for name in _PLAIN}
        arrays = {name: getattr(self, name) for name in _ARRAYS} | {"watch": self.watch.numbers()}
        if self._collected:
            arrays |= {key: np.array([row[i] for row in self._collected]) for i, key in enumerate(("y", "h", "shares"))}
        arrays.update({f"row{i}": values for i, values in enumerate(self.rows.numbers())})
        parts = {} if self.estimator is None else {"rls": self.estimator.state()}
        if self.detector is not None:
            parts["detector"] = self.detector.state()
        return pack(plain, arrays, parts)

    def restore(self, state: bytes) -> None:
        """Take up a state of an estimator of the same joint and options."""
        plain, arrays, parts = unpack(state)
        if arrays["theta"].shape != self.theta.shape or arrays["_buffer"].shape != self._buffer.shape:
            raise InputError("restore: the state is of another joint or sample time; give one of this estimator")
        for name in (*_PLAIN, *_ARRAYS):
            setattr(self, name, plain[name] if name in plain else arrays[name])
        self.watch.load(arrays["watch"])
        self._collected = list(zip(arrays["y"], arrays["h"], arrays["shares"], strict=True)) if "y" in arrays else []
        self.rows.load([arrays[f"row{i}"] for i in range(len(self.rows.numbers()))])
        self.estimator = self._recursion(self.theta) if "rls" in parts else None
        if self.estimator is not None:
            self.estimator.restore(parts["rls"])
        if self.detector is not None and "detector" in parts:
            self.detector.restore(parts["detector"])


__all__ = ["FAULT_TEXT", "OnlineEstimator", "OnlineOptions", "estimated_parameters", "held_parameters", "prepared"]
