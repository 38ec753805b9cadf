"""Sensor faults of a joint: found, isolated, told from plant changes, replaced (thesis 4.2,
4.4).
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Literal, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.errors import InputError
from identification.faults.core import ABSURD, NOISE, SENSORS, ObserverCore
from identification.faults.injector import ABRUPT, KINDS, Fault, inject
from identification.faults.reconfigure import Reconfiguration
from identification.faults.residuals import PARITY_SENSORS
from identification.faults.structured import MOVED, StructuredRule
from identification.faults.tables import DetectorTables
from identification.faults.thesis_rule import Predictor, ThesisRule, ThesisSettings
from identification.faults.types import FaultEvent, FaultSettings, FaultTrack, Verdict

__all__ = [
    "ABRUPT",
    "ABSURD",
    "KINDS",
    "MOVED",
    "NOISE",
    "PARITY_SENSORS",
    "SENSORS",
    "DetectorTables",
    "Fault",
    "FaultDetector",
    "FaultEvent",
    "FaultSettings",
    "FaultTrack",
    "Reconfiguration",
    "ThesisSettings",
    "Verdict",
    "inject",
]
FloatArray = npt.NDArray[np.float64]

_MAGIC: Final = b"FAULTD01"
_HEAD: Final = struct.Struct("<8sIII")
_MOTION: Final = 50.0
"""Standard deviations of its noise by which a position must move in a calibration."""


@final
class FaultDetector:
    """Watches the readings of an elastic joint, sample by sample.

    The readings are those of :data:`SENSORS`: current (n Km I, the drive torque referred to the
    link [N.m]), motor position and velocity, link position and velocity (link-referred [rad,
    rad/s]), torque [N.m].

    Parameters
    ----------
    model : JointModel
        The identified joint, elastic.
    dt : float
        Sample time [s].
    method
        "structured" (default): residuals that each hold some of the sensors only; the set of
        residuals over their limits tells the sensor. "thesis": rule (4.6) to (4.8) for link
        position and velocity.
    noise : mapping, optional
        Standard deviation of each reading; :data:`NOISE` by default.
    has_torque : bool
        False where there is no torque sensor; its reading is ignored.
    settings : FaultSettings or ThesisSettings, optional
    predictor : control.StateSpace or (A, B, C, D), optional
        Thesis rule: discrete model from motor position, velocity (and acceleration) to link
        position and velocity, as MOESP gives it. The observer without link sensors where it is
        missing.

    Notes
    -----
    Give a healthy record to :meth:`calibrate` first: the limits come from it. Without it they are
    guesses. The step at which a sensor fails may design the gains of the remaining ones, which
    takes some milliseconds once.
    """

    def __init__(
        self,
        model: JointModel,
        dt: float,
        method: Literal["structured", "thesis"] = "structured",
        *,
        noise: Mapping[str, float] | None = None,
        has_torque: bool = True,
        settings: FaultSettings | ThesisSettings | None = None,
        predictor: object | None = None,
    ) -> None:
        if not (np.isfinite(dt) and dt > 0):
            raise InputError(
                f"FaultDetector: the sample time is {dt!r}; give a positive number of seconds"
            )
        levels = {**NOISE, **(noise or {})}
        unknown = set(levels) - set(SENSORS)
        if unknown or not all(v > 0 for v in levels.values()):
            raise InputError(
                f"FaultDetector: noise needs positive values for {', '.join(SENSORS)} only"
            )
        core = ObserverCore(model, dt, levels, has_torque=has_torque)
        self.dt, self.method = dt, method
        self._rule: StructuredRule | ThesisRule
        if method == "structured":
            if settings is not None and not isinstance(settings, FaultSettings):
                raise InputError("FaultDetector: the structured rule takes FaultSettings")
            self._rule = StructuredRule(core, settings or FaultSettings())
        elif method == "thesis":
            if settings is not None and not isinstance(settings, ThesisSettings):
                raise InputError("FaultDetector: the thesis rule takes ThesisSettings")
            source = None if predictor is None else Predictor.of(predictor)
            self._rule = ThesisRule(core, settings or ThesisSettings(), source)
        else:
            raise InputError(
                f"FaultDetector: unknown method {method!r}; use 'structured' or 'thesis'"
            )
        self._reported = 0
        self.on_event: Callable[[FaultEvent], object] | None = None

    def compile(self) -> bool:
        """Load the compiled form of a sample now, building it where needed; the numbers stay the
        same bit by bit.

        Returns
        -------
        bool
            False where it stays interpreted: without a C compiler, and for the thesis rule.
        """
        return isinstance(self._rule, StructuredRule) and not self._rule.residuals.compile()

    def calibrate(self, readings: npt.ArrayLike | Sequence[FloatArray]) -> None:
        """Take the limits from healthy readings (n, 6), several representative motions, a minute or
        more.

        A list of tables is one of recordings that do not follow each other: the detector starts
        anew with each.
        """
        several = isinstance(readings, list | tuple) and all(
            isinstance(r, np.ndarray) and r.ndim == 2 for r in readings
        )
        pieces = [_table(r, "calibrate") for r in (readings if several else [readings])]  # type: ignore[union-attr]
        found = np.concatenate(pieces)
        core = self._rule.core
        for i, name in enumerate(SENSORS):
            least = _MOTION * float(core.noise[i]) if name.endswith("position") else 0.0
            if (
                len(found) >= 4 * self._rule.arm
                and np.ptp(found[:, i]) <= least
                and (name != "torque" or core.has_torque)
            ):
                raise InputError(
                    f"calibrate: {name} does not move; give a healthy record in which the joint "
                    "moves and every sensor works"
                )
        self._rule.calibrate(pieces)
        self._reported = 0

    def update(self, readings: Sequence[float]) -> list[float]:
        """One sample: six readings in the order of :data:`SENSORS`; gives them with failed ones
        replaced.

        A NaN is a missing reading.
        """
        if len(readings) != 6:
            raise InputError(
                f"FaultDetector.update: {len(readings)} readings; give the six of "
                f"{', '.join(SENSORS)}"
            )
        found = self._rule.update(
            readings if isinstance(readings, list) else [float(v) for v in readings]
        )
        events = self._rule.events
        while self._reported < len(events):
            self._reported += 1
            if self.on_event is not None:
                self.on_event(events[self._reported - 1])
        return found

    def run(self, readings: npt.ArrayLike) -> FaultTrack:
        """A whole record (n, 6), from the present state on."""
        table = _table(readings, "run")
        out, failed = np.empty_like(table), np.zeros(table.shape, dtype=bool)
        rule, count = self._rule, len(self._rule.events)
        for k, row in enumerate(table.tolist()):
            out[k] = self.update(row)
            failed[k] = rule.failed
        return FaultTrack(out, failed, tuple(rule.events[count:]))

    @property
    def failed(self) -> tuple[str, ...]:
        """Sensors that are replaced now."""
        return tuple(n for n, f in zip(SENSORS, self._rule.failed, strict=True) if f)

    @property
    def replaced(self) -> tuple[bool, ...]:
        """For each of :data:`SENSORS`, whether its reading is replaced now."""
        return tuple(self._rule.failed)

    @property
    def events(self) -> tuple[FaultEvent, ...]:
        """All events so far."""
        return tuple(self._rule.events)

    @property
    def last_event(self) -> FaultEvent | None:
        """The newest event; None before the first one."""
        events = self._rule.events
        return events[-1] if events else None

    @property
    def sample(self) -> int:
        """Number of the newest sample, from 0 on; -1 before the first one."""
        return self._rule.k

    def scores(self) -> list[float]:
        """For each sensor, the largest residual that holds it over its limit; at least 1 where it
        has failed.

        Zeros with the thesis rule.
        """
        return (
            self._rule.scores() if isinstance(self._rule, StructuredRule) else [0.0] * len(SENSORS)
        )

    def scale_limits(self, factor: float) -> None:
        """Multiply the limits of the residuals; nothing with the thesis rule."""
        if isinstance(self._rule, StructuredRule):
            residuals = self._rule.residuals
            residuals.limits = [limit * factor for limit in residuals.limits]

    def tables(self) -> DetectorTables:
        """What a copy of the detector in another language is made of.

        Raises
        ------
        InputError
            With the thesis rule.
        """
        if not isinstance(self._rule, StructuredRule):
            raise InputError(
                "FaultDetector.tables: only the structured rule has tables; use method='structured'"
            )
        return DetectorTables.of(self._rule)

    @property
    def armed(self) -> bool:
        """False during the start-up transient."""
        return self._rule.k >= self._rule.arm

    def reset(self) -> None:
        """Before the first sample; limits from the calibration stay."""
        self._rule.reset()
        self._reported = 0

    def state(self) -> bytes:
        """Everything the detector will use again, limits and events included, as bytes."""
        events = [
            [e.sample, e.first, e.verdict.name, e.sensors, e.residuals] for e in self._rule.events
        ]
        text = json.dumps({"method": self.method, "events": events}).encode()
        body = np.array(self._rule.numbers(), dtype="<f8").tobytes()
        return _HEAD.pack(_MAGIC, len(text), len(body), zlib.crc32(text + body)) + text + body

    def restore(self, state: bytes) -> None:
        """Take up a state of a detector of the same joint and settings; it goes on bit by bit.

        Raises
        ------
        InputError
            The bytes are damaged or of another detector.
        """
        if len(state) < _HEAD.size or state[:8] != _MAGIC:
            raise InputError(
                "restore: these bytes are no state of a fault detector; give what state() returned"
            )
        _, text_size, body_size, crc = _HEAD.unpack_from(state)
        rest = bytes(state[_HEAD.size :])
        if len(rest) != text_size + body_size or zlib.crc32(rest) != crc:
            raise InputError("restore: the state is damaged; give the bytes that state() returned")
        described = json.loads(rest[:text_size])
        numbers = np.frombuffer(rest[text_size:], dtype="<f8").tolist()
        if described["method"] != self.method or len(numbers) != len(self._rule.numbers()):
            raise InputError(
                "restore: the state is of a detector with another model, method or settings"
            )
        self._rule.load(numbers)
        self._rule.events = [
            FaultEvent(s, f, Verdict[v], tuple(sensors), tuple(r))
            for s, f, v, sensors, r in described["events"]
        ]
        self._reported = len(self._rule.events)


def _table(readings: npt.ArrayLike, asked: str) -> FloatArray:
    found = np.asarray(readings, dtype=np.float64)
    if found.ndim != 2 or found.shape[1] != len(SENSORS) or not len(found):
        raise InputError(
            f"FaultDetector.{asked}: readings have shape {found.shape}; give (n, {len(SENSORS)})"
        )
    return found
