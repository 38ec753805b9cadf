"""The online estimator of a joint: balances, recursive least squares, checks, fault detection;
no FMI in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple, final

import numpy as np
import numpy.typing as npt

from casadi_models.hold import CLOCKS, UNKNOWNS
from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.faults.detector import ABSURD
from identification.linear.triangle import single_thread
from identification.online.calibration import ROUNDS, Calibration
from identification.online.first_window import (
    fast_recursion,
    first_estimate,
    prior_range,
    told_beside_noise,
)
from identification.online.grid import Grid
from identification.online.guard import Guard
from identification.online.options import (
    OnlineOptions,
    estimated_parameters,
    held_parameters,
    prepared,
    searched_parameters,
)
from identification.online.pulse import GAP, Pulse
from identification.online.row_check import LEAST, RowCheck
from identification.online.rows import SOURCES, RowMaker
from identification.online.samples import Samples
from identification.online.shapes.two_step import Reoptimiser, make_two_step
from identification.online.state import Sample, State, joined, pack, parted, unpack
from identification.online.timing import Alignment
from identification.online.verdict import (
    FAULT_TEXT,
    HELD,
    NONE,
    implausible,
    make_detector,
    plant_alarm,
    worst,
)
from identification.online.watch import DRIVE, Q_L, Q_M, SAMPLED, TAU, W_L, W_M, Twist, Watch
from identification.recursive.estimator import RecursiveLeastSquares, Settings
from identification.recursive.prior_start import PriorStart
from identification.two_step.algorithm import OnlineSettings

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_RESIDUAL_SECONDS: Final = 2.0
_STRAIN: Final = OnlineSettings()
"""When residuals ask for another search of the nonlinear parameters."""
_ALL: Final = [True] * 6
_NONE_FAILED: Final = (False,) * 6


_PREFIX: Final = "two_step."
_GUARD: Final = "guard."


def _own(arrays: dict[str, FloatArray], prefix: str) -> dict[str, FloatArray]:
    """Arrays of a part, by their own names."""
    return {
        name.removeprefix(prefix): values
        for name, values in arrays.items()
        if name.startswith(prefix)
    }


class _Start(NamedTuple):
    """A recursion that may be gone on with, and the weighted rows that it began with."""

    recursion: RecursiveLeastSquares
    found: PriorStart
    y: FloatArray
    h: FloatArray
    least: FloatArray
    torque: FloatArray


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
        State of a calibrated :class:`identification.faults.detector.FaultDetector` of this joint.

    Attributes
    ----------
    names, theta, sigma
        Estimated parameters, values and standard deviations, link-referred SI.
    residual, floor, ratio : (balances,) array
        Residual of the last row, floor, and root mean square of the last seconds over the floor.
    unusable : tuple of int
        Readings of the last sample that were no number or beyond
        :data:`identification.faults.detector.ABSURD`; they count as missing.
    fault, score
        See :data:`FAULT_TEXT`; how far each reading's residuals are from their limits (1: at the
        limit).
    """

    def __init__(
        self,
        joint: Joint,
        dt: float,
        options: OnlineOptions | None = None,
        detector_state: bytes | None = None,
    ) -> None:
        self.joint, self.dt = joint, dt
        self.options = options or OnlineOptions()
        self.model, self.sensing = prepared(joint, self.options)
        self.rows = RowMaker(self.model, self.sensing, dt, held_parameters(joint))
        self.names, self.balances = self.rows.names, self.rows.balances
        self.guard = Guard(self.names, self.balances, self.rows.timing.stride * dt)
        self._plain_rows, self.two_step = self.rows, make_two_step(joint, self.rows, self.options)
        has_link = self.options.has_link
        self.present = (True, True, True, has_link, has_link, self.options.has_torque)
        self._all, self._whole = list(self.present), all(self.present)
        used: list[bool] = np.any(self.rows.uses, axis=0).tolist()
        self.needs = [False] * len(self.present)
        for k, reading in enumerate(SAMPLED):
            self.needs[reading] = used[k] and self.present[reading]
        self.calibration = Calibration(self.model, self.names, dt)
        self.samples = Samples(self.rows.timing, self.needs, self._alignment())
        self.watch = Watch(dt, self.present, Twist.of(self.model))
        self.grid = Grid(dt, max(GAP * self.rows.timing.length, 1.5 * dt))
        self.pulse = Pulse(dt, self.rows.timing.length, self.present)
        own = {p.name: (p.low, p.high) for p in self.model.parameters}
        start = dict(zip(self.model.parameter_names, self.model.value_vector(), strict=True))
        self.held_stiffness = start.get(self.model.stiffness_name or "", 0.0)
        own |= dict.fromkeys(CLOCKS, (-self.calibration.most, self.calibration.most))
        self.low = np.array([min(own[n][0], start[n]) for n in self.names])
        self.high = np.array([max(own[n][1], start[n]) for n in self.names])
        self._margin = 1.0
        self.detector = (
            make_detector(self.model, dt, self.options, detector_state)
            if self.options.detect and self.is_fitted
            else None
        )
        self.confirm = replace(_STRAIN, sample_time=self.rows.timing.stride * dt).samples(
            _STRAIN.confirm_seconds
        )
        self.collect = max(
            2 * len(self.names), round(self.options.warm_up / (self.rows.timing.stride * dt))
        )
        self.from_link = [b in ("link", "transmission") for b in self.balances]
        torques = [
            [
                p.name
                for t in self.model.terms
                if t.place == place and t.effect.family == "friction"
                for p in t.parameters
                if p.unit == "N.m"
            ]
            for place in ("motor", "link")
        ]
        self.friction = [[self.names.index(n) for n in t if n in self.names] for t in torques]
        known = [sum(abs(start[n]) for n in t if n not in self.names) for t in torques]
        self.feels = np.array(
            [
                [
                    place in b or b in ("sum", "axis") or (b == "deflection" and place == "motor")
                    for place in ("motor", "link")
                ]
                for b in self.balances
            ]
        )
        rate = self.rows.timing.stride * dt / _RESIDUAL_SECONDS
        self.check = RowCheck(
            len(self.balances),
            len(self.names),
            self.friction,
            known,
            self.feels,
            rate=rate,
            limit=_STRAIN.error_limit,
        )
        self.reference = [11 if from_link else 1 for from_link in self.from_link]
        self.reset()
        self.recursion(self.theta)  # its functions are made here and not inside a step

    # --- life -------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Before the first sample."""
        self.rows = self._plain_rows
        self.rows.reset()
        self.calibration.reset()
        self.watch.reset()
        self.pulse.reset()
        self.grid.reset()
        self.guard.reset()
        if self.two_step is not None:
            self.two_step.reset()
        if self.detector is not None:
            self.detector.reset()
        self.samples.reset()
        self._align()
        self._collected: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._heard: list[tuple[float, float, float, float]] = []
        self._told_rows: list[tuple[BoolArray, bool]] = []
        self.estimator: RecursiveLeastSquares | None = None
        values = dict(zip(self.model.parameter_names, self.model.value_vector(), strict=True))
        theta = np.array([values[name] for name in self.names])
        self._sampled, self._now = Sample.first(), State.first(theta, len(self.balances))

    def _alignment(self) -> Alignment:
        found = self.calibration.late if self.calibration.skews else None
        return Alignment.of(self.model, SOURCES, self.dt, found)

    def _align(self) -> None:
        """Free the readings to come of what is found of their sensors."""
        self.samples.align(self._alignment(), self.calibration.zero)
        for rows in (self._plain_rows, *(() if self.two_step is None else (self.two_step.rows,))):
            rows.off[:] = self.calibration.off

    def _set(self, **changes: Any) -> None:
        """Go on to the next state."""
        self._now = replace(self._now, **changes)

    def _tell(self, text: str) -> None:
        self._set(events=(*self._now.events, text))

    @property
    def theta(self) -> FloatArray:
        """Estimated parameters, (parameters,)."""
        return self._now.theta

    @property
    def sigma(self) -> FloatArray:
        """Their standard deviations, (parameters,)."""
        return self._now.sigma

    @property
    def residual(self) -> FloatArray:
        """Residual of the last row, (balances,) [N.m]."""
        return self._now.residual

    @property
    def floor(self) -> FloatArray:
        """What noise alone would leave, (balances,) [N.m]."""
        return self._now.floor

    @property
    def ratio(self) -> FloatArray:
        """Root mean square of the last seconds over the floor, (balances,)."""
        return self._now.ratio

    @property
    def level(self) -> FloatArray:
        """Size of the residual after the first window, (balances,) [N.m]."""
        return self._now.level

    @property
    def fault(self) -> int:
        """Code of the most severe fault now."""
        return self._now.fault

    @property
    def plant_alarm(self) -> int:
        """Code of a change of the joint itself."""
        return self._now.plant_alarm

    @property
    def score(self) -> list[float]:
        """How far each reading's residuals are from their limits (1: at the limit)."""
        return self._now.score

    @property
    def readings(self) -> list[float]:
        """The readings, failed ones replaced."""
        return self._sampled.readings

    @property
    def events(self) -> list[str]:
        """What was told so far."""
        return list(self._now.events)

    @property
    def warming_up(self) -> bool:
        """True until the recursion has started."""
        return self.estimator is None

    @property
    def is_fitted(self) -> bool:
        """True where the joint file has a value for every estimated parameter."""
        return all(n in self.joint.fitted or n in UNKNOWNS for n in self.names)

    @property
    def has_values(self) -> bool:
        """True where the joint file has a value for every parameter of the model."""
        return not self.joint.lacks(self.model)

    @property
    def held(self) -> bool:
        """True while the estimate shown is one from before: the readings stand still, or what
        they say is not believed.
        """
        return self.estimator is not None and (self.pulse.failed or self.guard.on_probation)

    @property
    def least(self) -> FloatArray:
        """What counts as noise of each balance at least [N.m], (balances,)."""
        share = self.options.floor_share * np.sqrt(self._now.torque)
        found: FloatArray = np.maximum(np.maximum(self.floor, share), LEAST)
        return found

    @property
    def made(self) -> int:
        """Rows so far."""
        return self._now.rows

    @property
    def wanted(self) -> bool:
        """True where the residuals stay over their limit although the linear parameters follow."""
        return self._now.strained >= self.confirm

    def reoptimise(self) -> bool:
        """Search the shapes as soon as there are rows enough; False where there are none."""
        if self.two_step is None:
            return False
        self.two_step.ask()
        return True

    def set_fault_margin(self, factor: float) -> None:
        """Multiply the fault detector's limits."""
        if self.detector is not None and factor != self._margin:
            self.detector.scale_limits(factor / self._margin)
            self._margin = factor

    def update(
        self, time: float, readings: Sequence[float], valid: Sequence[bool], *, enable: bool = True
    ) -> bool:
        """Take one sample; it need not lie on the grid of the sample time.

        Parameters
        ----------
        time : float
            [s]
        readings : sequence of float
            Drive torque, motor position and velocity, link position and velocity, torque;
            link-referred SI.
        valid : sequence of bool
            False for a reading that is missing.
        enable : bool
            False: the estimate is held.

        Returns
        -------
        bool
            True where a row was made.
        """
        values = list(map(float, readings))
        a, b, c, d, e, f = values
        top = ABSURD
        self.unusable: tuple[int, ...] = ()
        if not (
            -top < a < top
            and -top < b < top
            and -top < c < top
            and -top < d < top
            and -top < e < top
            and -top < f < top
        ):
            self.unusable = tuple(i for i, v in enumerate(values) if not -top < v < top)
            values = [0.0 if i in self.unusable else v for i, v in enumerate(values)]
            valid = [flag and i not in self.unusable for i, flag in enumerate(valid)]
        made = False
        for at, row, flags in self.grid.due(time, values, valid):
            made |= self._sample(at, row, flags, enable=enable)
        return made

    def _sample(
        self, time: float, values: list[float], valid: Sequence[bool], *, enable: bool
    ) -> bool:
        """Take a sample on the grid; True where a row was made."""
        good = (
            self._all if valid == _ALL else [bool(valid[i]) and self.present[i] for i in range(6)]
        )
        given, failed_before = good, self.pulse.failed
        counts = self.pulse.add(time, values)
        if failed_before and not self.pulse.failed and self.detector is not None:
            self.detector.reset()  # its observers have followed readings that were none
        if self.pulse.failed or self.pulse.jumped:
            good = [False] * 6
        looked = self.watch.add(values, good)
        used = (
            values
            if good is self._all and self._whole
            else [
                v if g else held
                for v, g, held in zip(values, good, self._sampled.last_good, strict=True)
            ]
        )
        failed, shown = self._detect(values, good, used)
        since = self._sampled.since + 1
        self._sampled = Sample(since % self.rows.timing.stride, used, shown)
        q = used
        sample = (q[Q_M], q[Q_L] if self.present[Q_L] else q[Q_M], q[TAU], q[DRIVE])
        self.samples.add(sample)
        self._hear(sample)
        self.samples.mark(
            good if counts else [False] * 6, failed, self.watch, whole=counts and good is self._all
        )
        made = False
        if since >= self.rows.timing.stride:
            made = self._row(time, enable)
            self._judge(given if not self.pulse.jumped else good)
        if looked:
            self._floors()
        if self.two_step is not None and self.two_step.searching and enable:
            self._advance(self.two_step)
        return made

    def room_of(self, rows: int) -> int:
        """Samples to keep where a first window has so many rows: a quarter may be missing."""
        return self.rows.timing.stride * (rows + rows // 4 + self.rows.rows_before_ready)

    def _hear(self, sample: tuple[float, float, float, float]) -> None:
        """Keep the readings of the first window, as far as there is room: to make its rows again
        where the sensors are off.
        """
        given_up = self._now.rows > 0 and not self._heard
        if self.estimator is not None or given_up or not self.calibration:
            return
        self._heard.append(sample)
        if len(self._heard) > self.room_of(self.collect):
            self._heard, self._told_rows = [], []

    def _detect(
        self, readings: list[float], good: list[bool], used: list[float]
    ) -> tuple[Sequence[bool], list[float]]:
        """Run the fault detector: which readings failed, and the readings with these replaced."""
        detector = self.detector
        if detector is None:
            shown = list(used)
            if not good[Q_L]:
                shown[Q_L], shown[W_L] = self._link_from_motor(used)
            return _NONE_FAILED, shown
        row = (
            readings
            if good is self._all and self._whole
            else [v if g else math.nan for v, g in zip(readings, good, strict=True)]
        )
        shown = detector.update(row)
        return detector.replaced, shown

    def _link_from_motor(self, q: list[float]) -> tuple[float, float]:
        """Link position and velocity from the motor, torsion taken off."""
        name, stiffness = self.model.stiffness_name, 0.0
        if self.options.has_torque and name in self.names:
            stiffness = float(self.theta[self.names.index(name)])
        elif self.options.has_torque:
            stiffness = self.held_stiffness
        return (q[Q_M] - q[TAU] / stiffness if stiffness > 0 else q[Q_M]), q[W_M]

    # --- rows -------------------------------------------------------------------------------------

    def _row(self, time: float, enable: bool) -> bool:
        found = self.rows.make(self.samples.window, time - self.samples.lag)
        on: BoolArray = ~np.any(self.rows.uses & self.samples.lost, axis=1)
        told = on, enable and bool(on.all())
        if self._heard:
            self._told_rows.append(told)
        if found is None:
            return False
        y, h = found
        rows = self._now.rows + 1
        if self.estimator is None:
            self._set(rows=rows)
            self._collect(y, h, told)
            if told[1] and len(self._collected) >= self.collect:
                self._begin(time)
            return True
        shares = self._shares()
        if self.two_step is not None:
            self.two_step.keep(self.rows.new_points, self.rows.signals, shares, on)
        check = self.check
        check(
            *(
                y,
                h,
                self.theta,
                *self.guard.fast,
                self.estimator.engine_for("check").fast,
                self.guard.scale,
                shares,
                on,
                self.floor,
                self.level,
                self.rows.signals[self.reference],
                self._now.square,
                self._now.torque,
                self.options.floor_share,
            ),
        )
        believed = enable and bool(on.any())
        strained = self._now.strained + 1 if check.over.any() else 0
        self._set(
            rows=rows,
            residual=check.error.copy(),
            ratio=check.ratio.copy(),
            square=check.square.copy(),
            torque=check.torque.copy(),
            strained=strained if believed else self._now.strained,
        )
        if not enable:
            return True
        if not believed:
            self._set(theta=self._within(self.guard.blind(self.estimator)))
            return True
        for b, use in enumerate(on.tolist()):
            self.estimator.enable(b, use)
        theta = self.estimator.update(check.y, check.h)
        noise = self.estimator.engine_for("noise").part("fast", "noise")
        np.maximum(noise, check.least**2, out=noise)
        shown = self._guarded(self.guard, theta, check, on)
        self._set(theta=self._within(shown))
        if (
            self.two_step is not None
            and self.two_step.due(self._now.strained)
            and not self.guard.several
        ):
            self._launch(self.two_step)
        return True

    def _within(self, theta: FloatArray) -> FloatArray:
        """The estimate to show: never outside what the parameters can be."""
        found: FloatArray = np.clip(theta, self.low, self.high)
        return found

    def _shares(self) -> FloatArray:
        """Share of the kernel in which motor and link stand still or turn round."""
        noise = self.watch.noise
        return self.rows.standstill(float(noise[Q_M]), float(noise[Q_L]))

    def _size(self) -> FloatArray:
        """Size of the residuals now."""
        found: FloatArray = np.maximum(np.maximum(self.floor, np.sqrt(self._now.square)), LEAST)
        return found

    def _weight_of(self, shares: FloatArray, theta: FloatArray, size: FloatArray) -> FloatArray:
        """Weights (rows, balances) from the shares (rows, 2) and the size of the residuals
        (balances,).
        """
        return self.check.weights(shares, theta, size)

    def _begin(self, time: float) -> None:
        """Start the recursion from the collected rows."""
        with single_thread():
            started = self._started()
            for held in (True, False) if self._heard else ():
                if held and not (self.calibration.zeros and self.has_values):
                    continue
                for _ in range(ROUNDS):
                    if not self._takes(started, held=held):
                        break
                    self._make_again(time)
                    started = self._started()
            self._take_up(started)

    def _started(self) -> _Start:
        """A recursion from the collected rows."""
        y, h, shares = (np.array([row[i] for row in self._collected]) for i in range(3))
        torque, period = self._now.torque / len(y), self.rows.timing.stride * self.dt
        noise = self._entry_noise()
        y, h, entries = told_beside_noise(y, h, self.theta, noise, period)
        least = np.maximum(self.options.floor_share * np.sqrt(torque), LEAST)
        first, weight = first_estimate(
            y, h, least, self.rows.like, partial(self._weight_of, shares)
        )
        least = np.maximum(least, self.rows.floor(first.tolist(), self.watch.noise[list(SAMPLED)]))
        y, h = y * weight, h * weight[:, :, None]
        self._set(scale=prior_range(first, self.theta, h, y, self.rows.usual, self.rows.like))
        recursion = self.recursion(self.theta)
        found = recursion.begin(y, h, least, overlap=self.rows.timing.overlap)
        recursion.set_entry_noise(noise, entries)
        return _Start(recursion, found, y, h, least, torque)

    def _takes(self, start: _Start, *, held: bool) -> bool:
        """Take what the window tells of the sensors off their readings; False where that is too
        little.
        """
        own, told = self.calibration, (start.recursion.theta, start.recursion.deviation)
        if held:
            noise = self.rows.timing.overlap * start.found.noise
            told = own.held(start.y, start.h, self.theta, noise, self.rows.usual)
        return own.take(*told, own.small(start.h, start.least))

    def _make_again(self, time: float) -> None:
        """Make the collected rows again, the readings freed of what the sensors are off by."""
        self._align()
        self.rows.reset()
        if self.two_step is not None:
            self.two_step.reset()
        self._collected = []
        self._set(torque=np.zeros(len(self.balances)))
        stride, last = self.rows.timing.stride, len(self._heard) - 1
        for k, sample in enumerate(self._heard):
            self.samples.add(sample)
            if k % stride == stride - 1:
                at = time - (last - k) * self.dt - self.samples.lag
                found = self.rows.make(self.samples.window, at)
                if found is not None:
                    self._collect(*found, self._told_rows[k // stride])

    def _collect(self, y: FloatArray, h: FloatArray, told: tuple[BoolArray, bool]) -> None:
        """Keep a row of the first window, where it counts."""
        shares, (on, counts) = self._shares(), told
        if self.two_step is not None:
            self.two_step.keep(self.rows.new_points, self.rows.signals, shares, on)
        if counts:
            self._collected.append((y, h, shares))
            self._set(torque=self._now.torque + self.rows.signals[self.reference] ** 2)

    def _take_up(self, start: _Start) -> None:
        """Go on with a recursion."""
        self.estimator = start.recursion
        off = ", ".join(
            f"{self.names[i]} {value:.3g}" for i, value in enumerate(self.calibration.off) if value
        )
        if off:
            self._tell(f"taken off the readings: {off}")
        if start.found.undetermined:
            names = ", ".join(self.names[i] for i in start.found.undetermined)
            self._tell(f"not determined by the first window: {names}")
        theta = self._within(start.recursion.theta)
        square = np.mean((start.y - start.h @ theta) ** 2, axis=0)
        self._set(theta=theta, sigma=start.recursion.deviation, square=square, torque=start.torque)
        self._collected, self._heard, self._told_rows = [], [], []
        self._floors()
        self._set(level=np.sqrt(square))
        self.guard.start(start.recursion)
        if self.two_step is not None and not self.two_step.known:
            self._launch(self.two_step, first=True)

    def _entry_noise(self) -> FloatArray:
        """Variance of the noise in the entries of a row now, (balances, parameters)."""
        return self.rows.entry_noise(self.watch.noise[list(SAMPLED)])

    def _factory(self) -> Callable[[FloatArray, FloatArray], RecursiveLeastSquares]:
        """(values, scale) -> recursive least squares with the present options."""
        settings = Settings(
            sample_time=self.rows.timing.stride * self.dt,
            drift=self.options.drift,
            alarm_drift=self.options.alarm_drift,
            window_seconds=2.0,
            rank_seconds=8.0,
            inflation=self.rows.timing.overlap,
        )
        return partial(fast_recursion, len(self.balances), self.names, self.rows.like, settings)

    def recursion(self, values: FloatArray) -> RecursiveLeastSquares:
        """A fresh recursion that begins at the given values, shape (parameters,)."""
        return self._factory()(values, self._now.scale)

    def retune(self, options: OnlineOptions) -> None:
        """Take up other forgetting bounds and floors while running; the estimate stays."""
        self.options = replace(
            self.options,
            drift=options.drift,
            alarm_drift=options.alarm_drift,
            floor_share=options.floor_share,
        )
        if self.estimator is not None:
            fresh = self.recursion(self.theta)
            old, new = self.estimator.engine_for("retune"), fresh.engine_for("retune")
            new.fast[:], new.slow[:] = old.fast, old.slow
            new.theta[:] = old.theta
            new.part("config", "hides")[:] = old.part("config", "hides")
            self.estimator = fresh
            self.guard.start(fresh)

    # --- judgement --------------------------------------------------------------------------------

    def _floors(self) -> None:
        if self.estimator is None:
            return
        noise = self.watch.noise[list(SAMPLED)]
        floor = self.rows.floor(self.theta.tolist(), noise)
        self.estimator.set_entry_noise(self._entry_noise())
        self._set(floor=floor, sigma=self.estimator.deviation)
        self._set(ratio=np.sqrt(self._now.square) / self.least)

    def _judge(self, good: list[bool]) -> None:
        """The most severe fault now, and the scores."""
        detector = self.detector
        alarm, score = self.plant_alarm, self.score
        if detector is not None:
            alarm, score = plant_alarm(detector, self.dt), detector.scores()
        missing = [
            not g and (self.needs[i] or (detector is not None and self.present[i]))
            for i, g in enumerate(good)
        ]
        found = (
            HELD
            if self.pulse.failed and self.estimator is not None
            else worst(missing, detector, self.watch)
        )
        if not found and self.estimator is not None and self.is_fitted:
            found = implausible(self.names, self.theta, self.sigma, self.joint.fitted)
        found = found or alarm or (HELD if self.guard.on_probation else NONE)
        if found != self.fault and found:
            self._tell(f"fault {found}")
        self._set(fault=found, plant_alarm=alarm, score=score)

    # --- state ------------------------------------------------------------------------------------

    def state(self) -> bytes:
        """Everything the estimator will use again, as bytes; of a running search what it
        started from and how far it is.
        """
        plain, arrays = parted(self._sampled, self._now)
        arrays["watch"] = self.watch.numbers()
        arrays["off"] = self.calibration.off
        if self._heard:
            arrays["heard"] = np.array(self._heard)
            arrays["told"] = np.array(
                [[*on, counts] for on, counts in self._told_rows], dtype=float
            )
        plain["samples"], arrays["samples"] = self.samples.state()
        if self._collected:
            arrays |= {
                key: np.array([row[i] for row in self._collected])
                for i, key in enumerate(("y", "h", "shares"))
            }
        arrays.update({f"row{i}": values for i, values in enumerate(self.rows.numbers())})
        if self.two_step is not None:
            plain["two_step"], more = self.two_step.state()
            arrays |= {_PREFIX + name: values for name, values in more.items()}
        parts = {} if self.estimator is None else {"rls": self.estimator.state()}
        plain["guard"], more, kept = self.guard.state()
        arrays |= {_GUARD + name: values for name, values in more.items()} | {
            "pulse": np.array(self.pulse.numbers()),
            "grid": np.array(self.grid.numbers()),
        }
        parts |= kept
        if self.detector is not None:
            parts["detector"] = self.detector.state()
        return pack(plain, arrays, parts)

    def restore(self, saved: bytes) -> None:
        """Take up a state of an estimator of the same joint and options; a running search is
        repeated up to where it was.

        Raises
        ------
        InputError
            The bytes are damaged, or of another joint, sample time or options.
        """
        plain, arrays, parts = unpack(saved)
        fits = (
            arrays["theta"].shape == self.theta.shape
            and arrays["samples"].shape == self.samples.state()[1].shape
        )
        if not fits or ("two_step" in plain) != (self.two_step is not None):
            raise InputError(
                "restore: the state is of another joint, sample time or options; give one of this "
                "estimator"
            )
        self._sampled, self._now = joined(Sample, plain, arrays), joined(State, plain, arrays)
        self.watch.load(arrays["watch"])
        self.calibration.off = arrays["off"].copy()
        self._align()
        heard, told = (arrays.get(n, np.zeros((0, 1))) for n in ("heard", "told"))
        self._heard = list(map(tuple, heard.tolist()))
        self._told_rows = [(row[:-1] > 0, bool(row[-1])) for row in told]
        self.samples.restore(plain["samples"], arrays["samples"])
        self._collected = (
            list(zip(arrays["y"], arrays["h"], arrays["shares"], strict=True))
            if "y" in arrays
            else []
        )
        self.rows = self._plain_rows
        if self.two_step is not None:
            self.two_step.restore(plain["two_step"], _own(arrays, _PREFIX), self._factory())
            if self.two_step.active:
                self.rows = self.two_step.rows
        self.rows.load([arrays[f"row{i}"] for i in range(len(self.rows.numbers()))])
        self.estimator = self.recursion(self.theta) if "rls" in parts else None
        if self.estimator is not None:
            self.estimator.restore(parts["rls"])
        self.guard.restore(plain["guard"], _own(arrays, _GUARD), parts)
        self.pulse.load(arrays["pulse"].tolist())
        self.grid.load(arrays["grid"].tolist())
        if self.detector is not None and "detector" in parts:
            self.detector.restore(parts["detector"])

    # --- supervision of the recursion -------------------------------------------------------------

    def _guarded(
        self,
        guard: Guard,
        theta: FloatArray,
        check: RowCheck,
        on: BoolArray,
    ) -> FloatArray:
        """The estimate to show after a row; a recursion that follows a failed sensor is held."""
        if self.estimator is None:
            return self.theta
        level = np.maximum(check.least, self.level)
        told = guard.step(self.estimator, theta, check.weighted_error, level, on, check.signals)
        if told:
            self._tell(f"estimate {told}")
        if told == "back":
            self._set(square=self.level**2, strained=0)
            if self.two_step is not None:
                self.two_step.forget(guard.held_for)
        return guard.theta

    def _launch(self, two: Reoptimiser, *, first: bool = False) -> None:
        """Begin a search for the shapes on the rows kept."""
        window = two.window()
        weight = self._weight_of(window.shares, self.theta, self._size()) * window.on
        two.launch(
            weight,
            self.theta,
            level=self.level,
            least=self.least,
            noise=self._entry_noise(),
            recursion=self._factory(),
            first=first,
        )
        self._tell(str(two.mode))

    def _advance(self, two: Reoptimiser) -> None:
        """Do the portions of a sample, and take up what the search has found."""
        found, guard = two.advance(), self.guard
        if found is None:
            return
        self._tell(found.text)
        self._set(strained=0)
        if found.eta is None:
            return
        trusted = found.good and found.estimator is not None and guard.plausible
        if guard.on_probation and not trusted:
            return
        self.rows = two.reshaped(found.eta, found.deviation, self.rows)
        if found.estimator is not None:
            self.estimator = found.estimator
            self._set(
                scale=found.scale,
                theta=found.estimator.theta,
                sigma=found.estimator.deviation,
                square=found.level**2,
                level=found.level,
            )
        if self.estimator is not None:
            guard.start(self.estimator)
        self._floors()


__all__ = [
    "FAULT_TEXT",
    "OnlineEstimator",
    "OnlineOptions",
    "estimated_parameters",
    "held_parameters",
    "prepared",
    "searched_parameters",
]
