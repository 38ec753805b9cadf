"""The structured rule: residuals, arming, isolation by signature, replacement, recovery."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.faults.calibrate import (
    WITHOUT_SECONDS,
    default_limits,
    default_recovery,
    energy_peak,
    floors,
    last_rows,
)
from identification.faults.core import (
    ABSURD,
    LINK_POSITION,
    LINK_VELOCITY,
    MOTOR_POSITION,
    MOTOR_VELOCITY,
    SENSORS,
    TORQUE,
    ObserverCore,
)
from identification.faults.residuals import (
    BIT_NAMES,
    COUNT,
    ENERGY_RESIDUALS,
    LINK,
    LINK_JUMP,
    LINK_PARITY,
    MOTOR,
    MOTOR_JUMP,
    MOTOR_PARITY,
    PARITY_SENSORS,
    TORSION,
    Residuals,
)
from identification.faults.types import FaultEvent, FaultSettings, Verdict

FloatArray = npt.NDArray[np.float64]

_BITS: Final = tuple(BIT_NAMES)
_PLACE: Final = {bit: i for i, bit in enumerate(_BITS)}
_PLACES: Final = [
    tuple(i for i, bit in enumerate(_BITS) if bits & bit) for bits in range(1 << len(_BITS))
]
"""Places of the bits that are set, for each set of bits."""
LARGEST: Final = 1e6
"""A reading beyond this is no place to start an estimate from."""
WIDER: Final = 1.5
"""Factor on the limits for every further reading that is replaced: estimates lean on fewer."""
SHORT_PEAK: Final = 1.5
SHORT: Final = (2, 10, 20)
"""A torque sensor that failed for a moment: peak of r1 over its limit; samples for which it is back
(from, to) and since it began (below)."""
FRESH: Final = 5
"""Samples within which a residual must have been over its limit to count for a verdict."""
SHOWS: Final = 2.0
"""Times the limit of r1 at which a position error would have shown there."""
OTHERS: Final = (
    (MOTOR_POSITION, LINK_POSITION),
    (LINK_POSITION, MOTOR_POSITION),
    (MOTOR_VELOCITY, LINK_VELOCITY),
    (LINK_VELOCITY, MOTOR_VELOCITY),
)
MOVED: Final = (20.0, 2e-3, 2e-2, 2e-3, 2e-2, 10.0)
"""A sensor is taken back only after its estimate has moved by this much, so that a stuck one is
not taken back.
"""


@final
class StructuredRule:
    """State of the structured rule; see :class:`identification.faults.detector.FaultDetector`."""

    def __init__(self, core: ObserverCore, settings: FaultSettings) -> None:
        self.core, self.settings = core, settings
        dt = core.dt
        self.residuals = Residuals(core, settings)
        self.arm = max(2, round(settings.arm_seconds / dt))
        self.waits = {
            name: max(1, round(getattr(settings, name) / dt))
            for name in (
                "link_wait",
                "torque_wait",
                "pair_wait",
                "plant_wait",
                "quiet_seconds",
                "recover_seconds",
                "settle_seconds",
                "plant_rest_seconds",
            )
        }
        self.waits["unlock"] = self.waits["settle_seconds"]
        self.recover_limits = default_recovery(core)
        self.widening = [[2.0] * 5 for _ in range(6)]
        self.calibrating = False
        self.residuals.limits = default_limits(core, settings)
        self.reset()

    def reset(self) -> None:
        """Before the first sample; limits stay."""
        self.k = -1
        self.failed = [False] * 6
        self.events: list[FaultEvent] = []
        self.residuals.clear()
        self.first = [-1] * len(_BITS)
        self.latest = [-1] * len(_BITS)
        self.latched = 0
        self.opened = -1
        self.peak = 0.0
        self.plant_rest = -1
        self.muted = 0
        self.good = [0] * 6
        self.low, self.high = [math.inf] * 6, [-math.inf] * 6
        self.lost, self.there = [False] * 6, 0
        self.gate_until, self.cut = -1, 0
        self._use((True,) * 5 + (self.core.has_torque,))

    def _use(self, used: tuple[bool, ...]) -> None:
        self.core.set_used(used)
        self.gates: list[float] = [
            g if u else math.inf for g, u in zip(self.core.gate.tolist(), used[1:], strict=True)
        ]
        self.residuals.judged[:] = self.gates

    def scores(self) -> list[float]:
        """For each reading, the largest residual that holds it over its limit; at least 1 where
        it has failed.
        """
        return [
            max(1.0, share) if failed else share
            for share, failed in zip(self.residuals.shares, self.failed, strict=True)
        ]

    def calibrate(self, pieces: Sequence[FloatArray]) -> None:
        """Limits, noise of r1 and recovery limits from healthy readings, tables (n, 6) that need
        not follow each other.
        """
        core, settings, res = self.core, self.settings, self.residuals
        if not all(np.isfinite(p).all() for p in pieces):
            raise InputError("calibrate: the readings hold NaN or infinity; give a healthy record")
        pieces = [p for p in pieces if len(p) >= 2 * self.arm] or list(pieces[:1])
        count = sum(map(len, pieces))
        if count < 4 * self.arm:
            raise InputError(
                f"calibrate: {count} samples; give at least {4 * self.arm} healthy ones"
            )
        seen = self.watch(pieces)
        if core.has_torque:
            core.tune(max(float(np.sqrt(np.mean(seen[:, 16] ** 2))), float(core.noise[TORQUE])))
            seen = self.watch(pieces)
        low = floors(core, settings)
        top = np.max(np.abs(seen[:, :COUNT]), axis=0)
        res.limits = [max(f, settings.margin * float(t)) for f, t in zip(low, top, strict=True)]
        res.inverse = [
            1.0 / max(float(np.mean(seen[:, at] ** 2)), (low[at] / 8.0) ** 2)
            for at in ENERGY_RESIDUALS
        ]
        peaks = [
            energy_peak(seen[:, at], inverse, settings.energy_drift)
            for at, inverse in zip(ENERGY_RESIDUALS, res.inverse, strict=True)
        ]
        res.energy_limits = [max(60.0, settings.energy_margin * peak) for peak in peaks]
        longest = max(round(WITHOUT_SECONDS / core.dt), 2 * self.arm)
        for sensor in range(6):
            if sensor != TORQUE or core.has_torque:
                self._without(sensor, last_rows(pieces, longest))
        self.reset()

    def watch(self, pieces: Sequence[FloatArray], without: int | None = None) -> FloatArray:
        """Values of all residuals over healthy readings after the start-up of each piece, and one
        column more.

        With a sensor left out, the last column is how far its reading lies from the estimate.
        """
        res = self.residuals
        kept = (res.limits, res.inverse, res.energy_limits)
        res.limits, res.inverse = [math.inf] * COUNT, [0.0] * len(res.inverse)
        self.calibrating = True
        seen = []
        for readings in pieces:
            self.reset()
            if without is not None:
                self.failed[without] = True
                self.exchange([without])
            out = np.zeros((len(readings), COUNT + 1))
            for k, row in enumerate(readings):
                used = self.update(row.tolist())
                out[k, :COUNT] = res.values
                if without is not None:
                    out[k, COUNT] = used[without] - row[without]
            seen.append(out[self.arm :])
        self.calibrating = False
        res.limits, res.inverse, res.energy_limits = kept
        return np.concatenate(seen)

    def _without(self, sensor: int, pieces: Sequence[FloatArray]) -> None:
        """What healthy readings give while one of them is replaced: recovery limit, and wider
        residual limits.
        """
        seen = np.max(np.abs(self.watch(pieces, sensor)), axis=0)
        limits, margin = self.residuals.limits, self.settings.margin
        self.recover_limits[sensor] = max(
            margin * float(seen[COUNT]), 6.0 * float(self.core.noise[sensor])
        )
        for i in range(5):
            rows = range(4 * i, 4 * i + 4) if i < 4 else range(16, COUNT)
            self.widening[sensor][i] = max(
                1.0, *(margin * float(seen[j]) / limits[j] for j in rows)
            )

    # --- one sample -------------------------------------------------------------------------------

    def update(self, reading: list[float]) -> list[float]:
        """One sample; gives the six readings with failed ones replaced."""
        a, b, c, d, e, f = reading
        top = ABSURD  # NaN and infinity are beyond it too
        missing = not (
            -top < a < top
            and -top < b < top
            and -top < c < top
            and -top < d < top
            and -top < e < top
            and -top < f < top
        )
        if missing and self.k < 0 and not any(-top < value < top for value in reading):
            return [0.0] * 6  # nothing has been read yet
        self.k = k = self.k + 1
        if missing or True in self.lost:
            reading = self._fill(reading)
        if k == 0:
            self.core.start(np.array(reading))
        a, b, c, d, e, f, over, locked, total = self.residuals.step(k, reading)
        if total - total != 0.0:  # NaN or infinity
            return self.begin_anew(reading)
        if k == self.gate_until:
            self.core.open_gates(False)
            self.gate_until = -1
        elif self.gate_until < 0 and not self.latched:
            self._unlock(locked=locked != 0.0)
        used = [a, b, c, d, e, f]
        if k <= self.arm:
            if k < self.arm:
                return used
            self.events.append(FaultEvent(k, k, Verdict.ARMED, (), ()))
        if over or self.latched:
            bits = int(over)
            self._suspect(bits & ~self.muted, bits)
        is_failed = True in self.failed
        if is_failed and not self.calibrating:
            self._watch_recovery(reading, used)
        if self.latched or is_failed:
            return self._replaced(used, locked=locked != 0.0)
        return used

    def _replaced(self, used: list[float], *, locked: bool) -> list[float]:
        """Readings to go on with: estimates for failed sensors, and for doubtful ones while a
        suspicion is open.
        """
        out, n, gate = self.core.out, self.core.size, self.gates
        doubt = self.latched and locked
        for s in range(1, 6):
            if self.failed[s] or (doubt and not -gate[s - 1] <= out[n + 5 + s] <= gate[s - 1]):
                used[s] = float(out[n + 13 + s])
        return used

    def _unlock(self, *, locked: bool) -> None:
        """Cut innovations must not hold the estimate off for long without a suspicion."""
        self.cut = self.cut + 1 if locked else 0
        if self.cut > self.waits["unlock"]:
            self.open_gates()

    def open_gates(self) -> None:
        """Let the observer take readings however far they lie."""
        self.core.open_gates(True)
        self.gate_until = self.k + self.waits["settle_seconds"]
        self.cut = 0

    def _fill(self, reading: list[float]) -> list[float]:
        """Missing readings: the sensor fails at once."""
        gone = [i for i, v in enumerate(reading) if not -ABSURD < v < ABSURD]
        fresh = [
            i for i in gone if not self.failed[i] and not (i == TORQUE and not self.core.has_torque)
        ]
        if fresh:
            self._fail(fresh, Verdict.DROPOUT, self.k)
        for i in gone:
            self.good[i] = 0
        if True in self.lost:
            self.take_back(reading, gone)
        return [0.0 if i in gone else v for i, v in enumerate(reading)]

    # --- isolation --------------------------------------------------------------------------------

    def _suspect(self, bits: int, raw: int) -> None:
        k = self.k
        if self.muted and not raw & self.muted and k > self.plant_rest:
            self.muted = 0
        if bits:
            if not self.latched:
                self.opened = k
                self.peak = 0.0
            for i in _PLACES[bits]:
                self.latest[i] = k
            for i in _PLACES[bits & ~self.latched]:
                self.first[i] = k
            self.latched |= bits
        if bits & TORSION:
            self.peak = max(self.peak, self.residuals.torsion)
        if self.latched:
            self._decide()

    def _age(self, bit: int) -> int:
        """Samples since a residual first passed its limit in this suspicion; -1 if it did not."""
        return self.k - self.first[_PLACE[bit]] if self.latched & bit else -1

    def _since(self, bit: int) -> int:
        return self.k - self.latest[_PLACE[bit]]

    def _decide(self) -> None:
        waits, latched = self.waits, self.latched
        found = self._side(LINK_PARITY, LINK_JUMP, LINK_POSITION, LINK_VELOCITY)
        found += self._side(MOTOR_PARITY, MOTOR_JUMP, MOTOR_POSITION, MOTOR_VELOCITY)
        parity = latched & (LINK_PARITY | MOTOR_PARITY)
        torsion = latched & TORSION
        if not found and not parity and torsion and not self.failed[TORQUE]:
            moving = latched & (LINK | MOTOR | LINK_JUMP | MOTOR_JUMP)
            age = min(
                (self._age(b) for b in (LINK, MOTOR, LINK_JUMP, MOTOR_JUMP) if latched & b),
                default=-1,
            )
            back, longest, young = SHORT
            gone = (
                self.peak > SHORT_PEAK
                and back <= self._since(TORSION) <= longest
                and self._age(TORSION) < young
            )
            if (
                moving
                and age >= waits["torque_wait"]
                and self._age(TORSION) >= waits["torque_wait"]
            ) or gone:
                found = [TORQUE]
        if found:
            self._fail(found, Verdict.SENSOR, self.opened)
            return
        if (
            parity
            and self.k - max([self.latest[i] for i in _PLACES[parity]]) <= waits["quiet_seconds"]
        ):
            return
        self._decide_plant()

    def _side(self, parity: int, jump: int, position: int, velocity: int) -> list[int]:
        """Position, velocity or both of one side."""
        latched, wait = self.latched, self.waits["link_wait"]
        if not latched & (parity | jump):
            return []
        torsion = (
            bool(latched & TORSION)
            if self.core.has_torque
            else bool(latched & LINK and latched & MOTOR)
        )
        jumped = bool(latched & jump) and not self.failed[velocity] and self._age(jump) >= wait
        if latched & parity and self._age(parity) >= wait:
            if self.failed[velocity]:
                return [position] if torsion and not self.failed[position] else []
            if self.failed[position]:
                return [velocity]
            if self.muted & TORSION:
                return [self._worse(position, velocity)]
            if torsion:
                return [position, velocity] if jumped and jump == LINK_JUMP else [position]
            if jumped or self._would_show(parity) or self._age(parity) >= self.waits["plant_wait"]:
                return [velocity]
            return []
        if jumped and jump == LINK_JUMP and not latched & TORSION:
            return [velocity]
        return []

    def _would_show(self, parity: int) -> bool:
        """True where a position error of the parity's size would have passed the limit of r1."""
        res = self.residuals
        at = 0 if parity == LINK_PARITY else 4
        size = max(abs(v) for v in res.values[at : at + 4]) * self.core.stiffness
        return (
            size > SHOWS * res.limits[16]
            if self.core.has_torque
            else self._age(parity) >= self.waits["pair_wait"]
        )

    def _worse(self, position: int, velocity: int) -> int:
        """The sensor further from the observer, where r1 cannot decide."""
        out, at = self.core.out, self.core.size + 5
        noise = self.core.noise
        shares = [abs(float(out[at + s])) / float(noise[s]) for s in (position, velocity)]
        return position if shares[0] > shares[1] else velocity

    def _decide_plant(self) -> None:
        """What none of the sensors explains."""
        waits, latched, k = self.waits, self.latched, self.k
        recent = max([self.latest[i] for i in _PLACES[latched]])
        if k - recent > waits["quiet_seconds"]:
            self.close()
            return
        motor_only = latched & (MOTOR | MOTOR_JUMP) and not latched & ~(MOTOR | MOTOR_JUMP)
        if motor_only:
            if self._age(MOTOR) >= waits["pair_wait"] and self._since(MOTOR) < FRESH:
                self._report(Verdict.CURRENT_OR_FRICTION, ("current", "motor friction"))
            return
        if k - self.opened >= waits["plant_wait"]:
            parts = []
            if latched & TORSION:
                parts.append("stiffness")
            if latched & LINK:
                parts.append("link")
            if latched & MOTOR and not latched & TORSION:
                parts.append("motor")
            self._report(Verdict.PLANT, tuple(parts))

    def _report(self, verdict: Verdict, parts: tuple[str, ...]) -> None:
        """An event that is no sensor failure; its residuals are not looked at while they stay
        over the limit.
        """
        self.events.append(FaultEvent(self.k, self.opened, verdict, parts, self._names()))
        self.muted |= self.latched & (TORSION | LINK | MOTOR | LINK_JUMP | MOTOR_JUMP)
        self.plant_rest = self.k + self.waits["plant_rest_seconds"]
        self.close()

    def _names(self) -> tuple[str, ...]:
        return tuple(name for bit, name in BIT_NAMES.items() if self.latched & bit)

    def close(self) -> None:
        """Forget the suspicion that was open."""
        self.latched, self.opened = 0, -1

    # --- replacement and recovery -----------------------------------------------------------------

    def _fail(self, sensors: list[int], verdict: Verdict, first: int) -> None:
        names = tuple(SENSORS[s] for s in sensors)
        self.events.append(FaultEvent(self.k, max(first, 0), verdict, names, self._names()))
        for s in sensors:
            self.failed[s] = True
            self.lost[s] = verdict is Verdict.DROPOUT
            self.good[s] = 0
            self.low[s], self.high[s] = math.inf, -math.inf
        self.exchange(sensors)

    def exchange(self, sensors: list[int]) -> None:
        """The readings in use have changed."""
        used = tuple(
            not f and (i != TORQUE or self.core.has_torque) for i, f in enumerate(self.failed)
        )
        self._use(used)
        for i, involved in enumerate(PARITY_SENSORS):
            if any(s in involved for s in sensors) or not self.core.has_torque:
                self.residuals.invalidate(i, self.k + 1 + self.waits["settle_seconds"])
            wide = [self.widening[s][i] for s in range(6) if self.failed[s]]
            self.residuals.scale[i] = 1.0 / (max(wide) * WIDER ** (len(wide) - 1)) if wide else 1.0
        if any(self.failed[s] for s in PARITY_SENSORS[4]):
            self.residuals.scale[4] = 0.0  # r1 compares the estimate with itself
        self.open_gates()
        self.close()

    def _watch_recovery(self, reading: list[float], used: list[float]) -> None:
        """A failed sensor that agrees with the estimate over a moving stretch is used again."""
        back = []
        for s in range(6):
            if not self.failed[s]:
                continue
            estimate = used[s]
            if abs(reading[s] - estimate) <= self.recover_limits[s] and reading[s] != 0.0:
                self.good[s] += 1
                self.low[s], self.high[s] = min(self.low[s], estimate), max(self.high[s], estimate)
                if (
                    self.good[s] >= self.waits["recover_seconds"]
                    and self.high[s] - self.low[s] > MOVED[s]
                ):
                    back.append(s)
            else:
                self.good[s] = 0
                self.low[s], self.high[s] = math.inf, -math.inf
        if back:
            for s in back:
                self.failed[s] = self.lost[s] = False
            names = tuple(SENSORS[s] for s in back)
            self.events.append(FaultEvent(self.k, self.k, Verdict.RECOVERED, names, ()))
            self.exchange(back)

    # --- state ------------------------------------------------------------------------------------

    def numbers(self) -> list[float]:
        """Everything that changes, limits included, as floats."""
        counters = [
            self.k,
            self.latched,
            self.opened,
            self.plant_rest,
            self.muted,
            self.gate_until,
            self.cut,
            self.there,
        ]
        res = self.residuals
        return [
            *map(float, counters),
            self.peak,
            self.core.torque_deviation,
            *map(float, self.failed),
            *map(float, self.lost),
            *map(float, self.first),
            *map(float, self.latest),
            *map(float, self.good),
            *self.low,
            *self.high,
            *self.recover_limits,
            *(v for row in self.widening for v in row),
            *res.limits,
            *res.inverse,
            *res.energy_limits,
            *self.core.state.tolist(),
            *res.numbers(max(self.k, 0)),
        ]

    def load(self, numbers: list[float]) -> None:
        """Take up what :meth:`numbers` gave."""
        at = 0

        def take(count: int) -> list[float]:
            nonlocal at
            at += count
            return numbers[at - count : at]

        self.residuals.clear()
        counters = [int(v) for v in take(8)]
        (
            self.k,
            self.latched,
            self.opened,
            self.plant_rest,
            self.muted,
            self.gate_until,
            self.cut,
            self.there,
        ) = counters
        self.peak, deviation = take(2)
        self.failed, self.lost = [v != 0.0 for v in take(6)], [v != 0.0 for v in take(6)]
        self.first, self.latest = (
            [int(v) for v in take(len(_BITS))],
            [int(v) for v in take(len(_BITS))],
        )
        self.good = [int(v) for v in take(6)]
        self.low, self.high, self.recover_limits = take(6), take(6), take(6)
        self.widening = [take(5) for _ in range(6)]
        res = self.residuals
        res.limits, res.inverse = take(COUNT), take(len(res.inverse))
        res.energy_limits = take(len(res.energy_limits))
        state = take(self.core.size)
        res.load(max(self.k, 0), numbers[at:])
        self.core.tune(deviation)
        self._use(
            tuple(
                not f and (i != TORQUE or self.core.has_torque) for i, f in enumerate(self.failed)
            )
        )
        if self.gate_until >= 0:
            self.core.open_gates(True)
        self.core.state[:] = state

    # --- fresh starts -----------------------------------------------------------------------------

    def begin_anew(self, reading: list[float]) -> list[float]:
        """Absurd readings have driven the estimate out of all bounds: start it and the residuals
        again.
        """
        usable = [value if -LARGEST < value < LARGEST else 0.0 for value in reading]
        self._start(usable)
        self.open_gates()
        self.close()
        return [
            u if failed else r for u, r, failed in zip(usable, reading, self.failed, strict=True)
        ]

    def take_back(self, reading: list[float], gone: Sequence[int]) -> None:
        """Use readings again that were missing, where no position is in use.

        Without a position the estimate drifts and can judge none. A reading that was missing is as
        good as at the first sample once it is there, so the estimate starts anew from it. Sensors
        that failed otherwise stay out.
        """
        failed, lost = self.failed, self.lost
        here = any(lost[s] and s not in gone for s in (MOTOR_POSITION, LINK_POSITION))
        if not (here and failed[MOTOR_POSITION] and failed[LINK_POSITION]):
            self.there = 0
            return
        self.there += 1
        if self.there < self.waits["settle_seconds"]:
            return
        back = [s for s in range(6) if lost[s] and s not in gone]
        for s in back:
            failed[s] = lost[s] = False
        start = [value if -LARGEST < value < LARGEST else 0.0 for value in reading]
        usable = [0.0 if failed[s] else start[s] for s in range(6)]
        for own, other in OTHERS:
            if failed[own]:
                start[own] = usable[other]
        self._start(start)
        self.events.append(
            FaultEvent(self.k, self.k, Verdict.RECOVERED, tuple(SENSORS[s] for s in back), ())
        )
        self.there = 0
        self.exchange(back)

    def _start(self, reading: list[float]) -> None:
        """Observer at the readings, residuals without a past; their scales stay."""
        residuals = self.residuals
        self.core.start(np.array(reading))
        scale = residuals.scale.copy()
        residuals.clear()
        residuals.scale[:] = scale
        for parity in range(len(PARITY_SENSORS)):
            residuals.invalidate(parity, self.k + 1 + self.waits["settle_seconds"])
