"""Sensor faults: injection, residuals, isolation, plant or sensor, replacement, recovery, state."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import JointModel
from casadi_models.thesis import model_ts
from identification.errors import InputError
from identification.faults.detector import (
    KINDS,
    NOISE,
    SENSORS,
    Fault,
    FaultDetector,
    FaultEvent,
    FaultSettings,
    FaultTrack,
    Reconfiguration,
    ThesisSettings,
    Verdict,
    inject,
)
from identification.planning.follow import Follower
from identification.planning.trajectories import sinusoidal, triangular
from identification.recursive.estimator import RecursiveLeastSquares
from irj_fmu.plant.reference import NAMES, reference_joint

FloatArray = npt.NDArray[np.float64]
DT = 1e-3
START = 3.0


@pytest.fixture(scope="module")
def plant() -> JointModel:
    return model_ts().add("structural_damping").with_values({"structural_damping": 30.0})


@pytest.fixture(scope="module")
def follower(plant: JointModel) -> Follower:
    return Follower(plant, DT)


def readings(clean: FloatArray, seed: int) -> FloatArray:
    return clean + np.random.default_rng(seed).normal(size=clean.shape) * [
        NOISE[s] for s in SENSORS
    ]


def clean(
    follower: Follower, motion: FloatArray, changes: dict[str, FloatArray] | None = None
) -> FloatArray:
    run = follower.run(motion, changes)
    return np.column_stack([run.drive, run.states, run.torque])


@pytest.fixture(scope="module")
def unseen(follower: Follower) -> FloatArray:
    """A motion that the calibration has not seen, without noise."""
    return clean(follower, sinusoidal(0.6, 2.3, duration=8.0).table)


def identified(plant: JointModel) -> JointModel:
    values = dict(plant.values)
    return plant.with_values(
        {"stiffness": 1.01 * values["stiffness"], "motor_coulomb": 0.95 * values["motor_coulomb"]}
    )


@pytest.fixture(scope="module")
def calibrated(plant: JointModel, follower: Follower) -> FaultDetector:
    detector = FaultDetector(identified(plant), DT)
    slow = sinusoidal(0.4, 3.1, duration=10.0).table
    fast = triangular(0.75, limit=0.6, reversal=0.2, duration=10.0, start=slow[-1, 0]).table
    fast[:300] = (
        slow[-1]
        + (fast[:300] - slow[-1]) * 0.5 * (1 - np.cos(np.pi * np.arange(300) / 300))[:, None]
    )
    detector.calibrate(readings(clean(follower, np.vstack([slow, fast])), 0))
    return detector


@pytest.fixture
def detector(calibrated: FaultDetector) -> FaultDetector:
    calibrated.reset()
    return calibrated


def alarms(track: FaultTrack) -> list[FaultEvent]:
    return [e for e in track.events if e.verdict is not Verdict.ARMED]


# --- injector -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_does_what_it_says(kind: str, unseen: FloatArray) -> None:
    column = SENSORS.index("link_position")
    fault = Fault("link_position", kind, START, 0.05, START + 1.0)  # type: ignore[arg-type]
    got = inject(unseen, DT, [fault], seed=1)
    inside = slice(round(START / DT), round((START + 1) / DT))
    rows = np.ones(len(unseen), dtype=bool)
    rows[inside] = False
    assert np.array_equal(got[rows], unseen[rows])
    others = np.delete(got, column, axis=1)
    assert np.array_equal(others, np.delete(unseen, column, axis=1))
    healthy, faulty = unseen[inside, column], got[inside, column]
    k = np.arange(1, len(healthy) + 1)
    checks = {
        "noise": lambda: abs(float(np.std(faulty)) - 0.05) < 0.005,
        "stuck": lambda: np.all(faulty == unseen[inside.start - 1, column]),
        "zero": lambda: np.all(faulty == 0),
        "dropout": lambda: np.all(np.isnan(faulty)),
        "spike": lambda: (
            set(np.round(np.abs(faulty - healthy), 12)) == {0.0, 0.05} and faulty[0] != healthy[0]
        ),
        "bias": lambda: np.allclose(faulty - healthy, 0.05),
        "gain": lambda: np.allclose(faulty, 1.05 * healthy),
        "drift": lambda: np.allclose(faulty - healthy, 0.05 * DT * k),
        "delay": lambda: np.array_equal(
            faulty, unseen[inside.start - 50 : inside.stop - 50, column]
        ),
    }
    assert checks[kind]()


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda: Fault("camera", "bias", 1.0), "unknown sensor"),
        (lambda: Fault("torque", "rust", 1.0), "unknown kind"),  # type: ignore[arg-type]
        (lambda: Fault("torque", "bias", 2.0, end=1.0), "start < end"),
        (lambda: inject(np.zeros((5, 3)), DT, []), "shape"),
        (lambda: FaultDetector(JointModel(inertias=("inertia",)), DT), "rigid"),
        (lambda: FaultDetector(model_ts(), 0.0), "sample time"),
        (lambda: FaultDetector(model_ts(), DT, "guess"), "unknown method"),  # type: ignore[arg-type]
        (lambda: FaultDetector(model_ts(), DT, noise={"camera": 1.0}), "noise"),
        (lambda: FaultDetector(model_ts(), DT, settings=ThesisSettings()), "FaultSettings"),
        (lambda: FaultDetector(model_ts(), DT).calibrate(np.zeros((10, 6))), "at least"),
        (
            lambda: FaultDetector(model_ts(), DT).calibrate(np.full((9000, 6), np.nan)),
            "healthy record",
        ),
        (lambda: FaultDetector(model_ts(), DT).update([0.0]), "six"),
        (lambda: FaultDetector(model_ts(), DT, "thesis", predictor=(1.0, 2.0)), "StateSpace"),
        (lambda: FaultSettings(margin=0.5), "margin"),
    ],
)
def test_bad_input_is_one_line(action: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        action()
    assert "\n" not in str(caught.value)


# --- structured rule ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
def test_healthy_readings_on_an_unseen_motion_give_no_alarm(
    detector: FaultDetector, unseen: FloatArray, seed: int
) -> None:
    track = detector.run(readings(unseen, seed))
    assert alarms(track) == []
    assert [e.verdict for e in track.events] == [Verdict.ARMED]
    assert np.array_equal(track.reconstructed, readings(unseen, seed))


CASES = [
    ("motor_position", "noise", 0.1, 0.02),
    ("motor_position", "bias", 2e-3, 0.02),
    ("motor_velocity", "noise", 0.1, 0.05),
    ("motor_velocity", "bias", 0.05, 0.2),
    ("link_position", "noise", 0.1, 0.02),
    ("link_position", "stuck", 0.0, 0.1),
    ("link_position", "zero", 0.0, 0.1),
    ("link_position", "dropout", 0.0, 0.001),
    ("link_position", "spike", 0.01, 0.02),
    ("link_position", "bias", 2e-3, 0.02),
    ("link_position", "gain", 0.05, 0.5),
    ("link_position", "drift", 2e-3, 0.8),
    ("link_position", "delay", 0.02, 0.3),
    ("link_velocity", "noise", 0.1, 0.02),
    ("link_velocity", "stuck", 0.0, 0.5),
    ("link_velocity", "zero", 0.0, 0.5),
    ("link_velocity", "bias", 0.05, 0.02),
    ("link_velocity", "drift", 0.05, 1.0),
    ("torque", "noise", 0.1, 0.1),
    ("torque", "spike", 60.0, 0.02),
    ("torque", "bias", 10.0, 0.3),
]


@pytest.mark.parametrize(("sensor", "kind", "size", "within"), CASES)
def test_the_failed_sensor_is_named(
    detector: FaultDetector, unseen: FloatArray, sensor: str, kind: str, size: float, within: float
) -> None:
    fault = Fault(sensor, kind, START, size)  # type: ignore[arg-type]
    track = detector.run(inject(readings(unseen, 3), DT, [fault], seed=4)[:6000])
    named = [e for e in alarms(track) if e.is_sensor]
    assert named
    assert {s for e in named for s in e.sensors} == {sensor}
    assert 0 <= named[0].sample * DT - START <= within


def test_current_and_motor_friction_are_reported_as_a_pair(
    detector: FaultDetector, follower: Follower, plant: JointModel, unseen: FloatArray
) -> None:
    faulty = inject(readings(unseen, 3), DT, [Fault("current", "bias", START, 20.0)])
    first = alarms(detector.run(faulty))
    detector.reset()
    motion = sinusoidal(0.6, 2.3, duration=8.0).table
    course = np.where(np.arange(len(motion)) * DT < START, 1.0, 1.8) * plant.values["motor_coulomb"]
    second = alarms(detector.run(readings(clean(follower, motion, {"motor_coulomb": course}), 3)))
    for events in (first, second):
        assert {e.verdict for e in events} == {Verdict.CURRENT_OR_FRICTION}
        assert events[0].sensors == ("current", "motor friction")


@pytest.mark.parametrize(
    ("kind", "size", "within"),
    [
        ("noise", 50.0, 0.2),
        ("stuck", 0.0, 1.0),
        ("zero", 0.0, 0.2),
        ("spike", 300.0, 2.0),
        ("gain", 0.4, 0.5),
        ("drift", 10.0, 1.5),
        ("delay", 0.05, 1.5),
    ],
)
def test_every_kind_of_current_fault_is_reported(
    detector: FaultDetector, unseen: FloatArray, kind: str, size: float, within: float
) -> None:
    fault = Fault("current", kind, START, size)  # type: ignore[arg-type]
    events = alarms(detector.run(inject(readings(unseen, 3), DT, [fault], seed=4)[:6000]))
    assert events
    assert {e.verdict for e in events} == {Verdict.CURRENT_OR_FRICTION}
    assert 0 <= events[0].sample * DT - START <= within


def test_missing_current_is_replaced_at_once(detector: FaultDetector, unseen: FloatArray) -> None:
    events = alarms(
        detector.run(inject(readings(unseen, 3), DT, [Fault("current", "dropout", START)])[:4000])
    )
    assert [(e.verdict, e.sensors, e.sample) for e in events] == [
        (Verdict.DROPOUT, ("current",), round(START / DT))
    ]


def test_page_of_the_campaign_holds_what_is_wanted() -> None:
    """The figures in docs/faults.md, against the limits beside them; every sensor and kind has
    its curve.
    """
    root = Path(__file__).resolve().parents[3]
    page = (root / "docs" / "faults.md").read_text(encoding="utf-8")
    figures = {
        what.strip(): figure
        for what, figure in re.findall(r"^\| ([^|]+) \| ([^|]+) \|", page, re.MULTILINE)
    }

    def leading(what: str) -> float:
        return float(figures[what].split()[0])

    assert leading("healthy data") >= 1.0
    assert leading("sensor alarms in it") <= leading("healthy data")
    assert leading("detected") == leading("fault cases") >= 450
    assert leading("every failed sensor and no other named") >= 0.95 * leading("fault cases")
    assert leading("abrupt faults, median time to the named sensor") <= 20
    assert leading("changes of the joint called a sensor fault") == 0
    assert leading("error of the replaced link position over 40 s") <= 2e-4
    assert leading("parameters with failed sensors, worst") <= 10.5
    assert leading("added spring with failed sensors, worst") <= 1.0
    for sensor in SENSORS:
        for kind in set(KINDS) - {"stuck", "zero", "dropout"}:
            assert re.search(rf"^\| {sensor.replace('_', ' ')} \| {kind} \|", page, re.MULTILINE), (
                sensor,
                kind,
            )
    assert (root / "docs" / "faults" / "sizes.svg").read_text(encoding="utf-8").count(
        "<title>"
    ) == len(SENSORS) * (len(KINDS) - 3)


@pytest.mark.parametrize(
    ("factors", "part"),
    [
        ({"stiffness": 0.8, "cubic_stiffness": 0.8}, "stiffness"),
        ({"link_inertia": 1.2, "gravity_torque": 1.2}, "link"),
    ],
)
def test_a_plant_change_is_no_sensor_fault(
    detector: FaultDetector,
    follower: Follower,
    plant: JointModel,
    factors: dict[str, float],
    part: str,
) -> None:
    motion = sinusoidal(0.6, 2.3, duration=8.0).table
    after = np.arange(len(motion)) * DT >= START
    changes = {n: np.where(after, f, 1.0) * plant.values[n] for n, f in factors.items()}
    events = alarms(detector.run(readings(clean(follower, motion, changes), 5)))
    assert events
    assert not any(e.is_sensor for e in events)
    assert events[0].verdict is Verdict.PLANT
    assert part in events[0].sensors


def test_the_replaced_position_follows_the_true_one(
    detector: FaultDetector, follower: Follower
) -> None:
    true = clean(follower, sinusoidal(0.6, 2.3, duration=15.0).table)
    faults = [
        Fault("link_position", "noise", START, 0.1),
        Fault("link_velocity", "noise", START + 2.0, 0.1),
    ]
    track = detector.run(inject(readings(true, 6), DT, faults, seed=7))
    assert {s for e in alarms(track) for s in e.sensors} == {"link_position", "link_velocity"}
    rows = track.failed[:, 3]
    assert rows.sum() > 11.9 / DT
    assert np.max(np.abs(track.reconstructed[rows, 3] - true[rows, 3])) < 2e-4


def test_no_faulty_value_gets_through_before_the_decision(
    detector: FaultDetector, unseen: FloatArray
) -> None:
    track = detector.run(
        inject(readings(unseen, 6), DT, [Fault("link_position", "noise", START, 0.1)], seed=7)
    )
    assert np.max(np.abs(track.reconstructed[:, 3] - unseen[:, 3])) < 2e-3


def test_a_temporary_fault_ends_and_the_sensor_is_used_again(
    detector: FaultDetector, unseen: FloatArray
) -> None:
    record = readings(unseen, 8)
    track = detector.run(
        inject(record, DT, [Fault("link_position", "noise", START, 0.1, START + 1.0)], seed=1)
    )
    assert [e.verdict for e in alarms(track)] == [Verdict.SENSOR, Verdict.RECOVERED]
    back = alarms(track)[1].sample * DT
    assert START + 1.49 <= back <= START + 2.5  # the last noise samples may agree by chance
    assert detector.failed == ()
    assert np.array_equal(track.reconstructed[-1], record[-1])


def test_a_stuck_sensor_is_not_taken_back_where_the_motion_crosses_it(
    detector: FaultDetector, unseen: FloatArray
) -> None:
    track = detector.run(inject(readings(unseen, 8), DT, [Fault("link_position", "stuck", START)]))
    assert [e.verdict for e in alarms(track)] == [Verdict.SENSOR]
    assert detector.failed == ("link_position",)


def test_nothing_is_declared_before_the_detector_is_armed(
    detector: FaultDetector, unseen: FloatArray
) -> None:
    track = detector.run(
        inject(readings(unseen, 9), DT, [Fault("link_velocity", "bias", 0.2, 0.05, 0.7)])[:1400]
    )
    assert track.events == ()
    assert not detector.armed


def test_any_nonsense_leaves_finite_outputs(detector: FaultDetector, unseen: FloatArray) -> None:
    record = readings(unseen, 9)[:3000]
    record[1700:1710] = np.nan
    record[1720, 2] = np.inf
    record[1800:1900, 1] = 1e30
    track = detector.run(record)
    assert np.isfinite(track.reconstructed).all()
    assert np.isfinite(detector._rule.core.state).all()
    assert any(e.verdict is Verdict.DROPOUT for e in track.events)


def test_absurd_readings_start_the_estimate_again(
    detector: FaultDetector, unseen: FloatArray
) -> None:
    """Positions of 1e8 rad drive the cubic spring out of the range of numbers; no output and no
    state ever is NaN.
    """
    record = readings(unseen, 9)[:4000]
    record[1700:1900] = 1e8
    for k, row in enumerate(record.tolist()):
        assert np.isfinite(detector.update(row)).all(), k
        assert np.isfinite(detector._rule.core.state).all(), k
    assert not np.isnan(detector._rule.numbers()).any()
    assert np.isfinite(np.array(detector._rule.residuals.sums)).all()


@pytest.mark.parametrize("columns", [range(6), range(1, 6), (1, 2, 3, 4), (1, 3)])
@pytest.mark.parametrize("count", [1, 50, 1000])
def test_readings_are_taken_back_after_an_outage(
    detector: FaultDetector, unseen: FloatArray, columns: Sequence[int], count: int
) -> None:
    """Without any position the estimate drifts and can judge none: readings that were missing
    start it anew, 0.1 s after they are back.
    """
    healthy = readings(unseen, 9)[: 3500 + count]
    record = healthy.copy()
    record[2000 : 2000 + count, list(columns)] = np.nan
    track = detector.run(record)
    back = 2000 + count + 100
    assert track.failed[2000 : back - 1, list(columns)].all()
    assert not track.failed[back:].any()
    np.testing.assert_array_equal(track.reconstructed[back:], healthy[back:])
    assert [e.verdict for e in alarms(track)] == [Verdict.DROPOUT, Verdict.RECOVERED]


def test_a_sensor_that_failed_otherwise_stays_out_after_an_outage(
    detector: FaultDetector, unseen: FloatArray
) -> None:
    """Noise on the link velocity before all readings are missing: only the others are taken
    back.
    """
    record = inject(readings(unseen, 9), DT, [Fault("link_velocity", "noise", 1.7, 0.5)])[:4000]
    record[2500:2550] = np.nan
    track = detector.run(record)
    assert track.failed[2700:, 4].all()
    assert not track.failed[2700:, [0, 1, 2, 3, 5]].any()
    assert np.abs(track.reconstructed[2700:, 3] - unseen[2700:4000, 3]).max() < 1e-3


def test_the_compiled_sample_has_the_same_bits(plant: JointModel, unseen: FloatArray) -> None:
    """With a compiler and without: the same readings, events and state, through faults, an
    outage and absurd values.
    """
    record = inject(
        readings(unseen, 9),
        DT,
        [Fault("link_position", "noise", 1.8, 0.1, 2.2), Fault("torque", "bias", 3.0, 30.0)],
    )[:4500]
    record[2600:2640] = np.nan
    record[3700:3720, 2] = 1e8
    plain, fast = (FaultDetector(identified(plant), DT) for _ in range(2))
    if not fast.compile():
        pytest.skip("no C compiler")
    first, second = plain.run(record), fast.run(record)
    np.testing.assert_array_equal(first.reconstructed, second.reconstructed)
    assert first.events == second.events
    assert plain.state() == fast.state()


def test_nothing_begins_before_the_first_reading(
    detector: FaultDetector, unseen: FloatArray
) -> None:
    record = readings(unseen, 9)[:2000]
    late = detector.run(np.vstack([np.full((5, 6), np.nan), record]))
    assert [e.verdict for e in late.events] == [Verdict.ARMED]
    assert np.array_equal(late.reconstructed[5:], record)


@pytest.mark.parametrize("sensor", range(6))
def test_calibration_with_a_dead_sensor_is_refused(
    plant: JointModel, unseen: FloatArray, sensor: int
) -> None:
    record = np.tile(readings(unseen, 9), (2, 1))
    record[:, sensor] = 0.3
    with pytest.raises(
        InputError, match=rf"calibrate: {SENSORS[sensor]} does not move; give a healthy record"
    ):
        FaultDetector(identified(plant), DT).calibrate(record)


def test_calibration_at_standstill_is_refused(plant: JointModel) -> None:
    noise = np.random.default_rng(1).normal(size=(8000, 6)) * [NOISE[s] for s in SENSORS]
    with pytest.raises(InputError, match=r"calibrate: motor_position does not move"):
        FaultDetector(identified(plant), DT).calibrate(noise)


def test_replaced_flags_are_those_of_the_names(detector: FaultDetector, unseen: FloatArray) -> None:
    detector.run(inject(readings(unseen, 8), DT, [Fault("link_position", "zero", START)])[:4000])
    assert (
        detector.failed
        == tuple(s for s, r in zip(SENSORS, detector.replaced, strict=True) if r)
        == ("link_position",)
    )


def test_state_and_restore_go_on_bit_by_bit(
    calibrated: FaultDetector, plant: JointModel, unseen: FloatArray
) -> None:
    faults = [
        Fault("link_position", "drift", START, 2e-3),
        Fault("link_velocity", "noise", 4.0, 0.1, 5.0),
    ]
    record = inject(readings(unseen, 10), DT, faults, seed=2)
    other = FaultDetector(identified(plant), DT)
    for cut in (800, 3100, 3400, 4010, 5300):
        calibrated.reset()
        calibrated.run(record[:cut])
        other.restore(calibrated.state())
        one, two = calibrated.run(record[cut:]), other.run(record[cut:])
        assert np.array_equal(one.reconstructed, two.reconstructed)
        assert one.events == two.events
        assert calibrated.state() == other.state()


def test_damaged_or_foreign_states_are_refused(detector: FaultDetector, plant: JointModel) -> None:
    state = detector.state()
    for wrong in (state[:-1], b"y" * len(state), state[:60] + bytes([state[60] ^ 1]) + state[61:]):
        with pytest.raises(InputError, match="restore"):
            detector.restore(wrong)
    with pytest.raises(InputError, match="another"):
        FaultDetector(plant, DT, "thesis").restore(state)


def test_without_a_torque_sensor_positions_and_velocities_are_still_told_apart(
    plant: JointModel, follower: Follower, unseen: FloatArray
) -> None:
    detector = FaultDetector(identified(plant), DT, has_torque=False)
    healthy = readings(clean(follower, sinusoidal(0.6, 3.0, duration=10.0).table), 0)
    healthy[:, 5] = np.nan
    detector.calibrate(np.nan_to_num(healthy))
    for sensor in ("link_position", "link_velocity", "motor_velocity"):
        detector.reset()
        record = inject(readings(unseen, 11), DT, [Fault(sensor, "noise", START, 0.1)], seed=3)
        record[:, 5] = np.nan
        named = [e for e in alarms(detector.run(record[:4500])) if e.is_sensor]
        assert {s for e in named for s in e.sensors} == {sensor}


def test_events_are_handed_on(detector: FaultDetector, unseen: FloatArray) -> None:
    heard: list[FaultEvent] = []
    detector.on_event = heard.append
    detector.run(inject(readings(unseen, 3), DT, [Fault("torque", "dropout", START)])[:3200])
    detector.on_event = None
    assert tuple(heard) == detector.events


# --- thesis rule ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def thesis(plant: JointModel, follower: Follower) -> FaultDetector:
    detector = FaultDetector(identified(plant), DT, "thesis")
    detector.calibrate(readings(clean(follower, sinusoidal(0.6, 3.0, duration=10.0).table), 0))
    return detector


@pytest.mark.parametrize("sensor", ["link_position", "link_velocity"])
def test_the_thesis_rule_finds_noise_and_takes_the_sensor_back(
    thesis: FaultDetector, unseen: FloatArray, sensor: str
) -> None:
    thesis.reset()
    track = thesis.run(
        inject(readings(unseen, 3), DT, [Fault(sensor, "noise", START, 0.5, START + 1.5)], seed=1)
    )
    kinds = [(e.verdict, e.sensors) for e in alarms(track) if e.verdict is not Verdict.PLANT]
    assert kinds[0] == (Verdict.SENSOR, (sensor,))
    assert kinds[-1] == (Verdict.RECOVERED, (sensor,))


def test_the_thesis_rule_takes_a_state_space_model(plant: JointModel, unseen: FloatArray) -> None:
    """Motor passes to link (rigid): A = 0.5 does nothing, D is the identity."""
    matrices = (np.array([[0.5]]), np.zeros((1, 2)), np.zeros((2, 1)), np.eye(2))
    settings = ThesisSettings(tolerance=(20.0, 40.0), input_output=(0.2, 0.4))
    detector = FaultDetector(plant, DT, "thesis", predictor=matrices, settings=settings)
    assert alarms(detector.run(readings(unseen, 1))) == []
    detector.reset()
    track = detector.run(inject(readings(unseen, 1), DT, [Fault("link_position", "zero", START)]))
    assert alarms(track)[0].sensors == ("link_position",)
    rows = track.failed[:, 3]
    assert np.max(np.abs(track.reconstructed[rows, 3] - unseen[rows, 1])) < 1e-3
    other = FaultDetector(plant, DT, "thesis", predictor=matrices, settings=settings)
    other.restore(detector.state())
    assert other.state() == detector.state()


# --- reconfiguration ------------------------------------------------------------------------------


@pytest.mark.parametrize("alternative", [1, 2])
def test_reconfiguration_raises_r2_and_holds_the_stiffness(alternative: int) -> None:
    estimator = RecursiveLeastSquares(
        [1.0, 2.0, 3.0], 1.0, outputs=1, names=("k1", "k2", "b"), R2=[0.04]
    )
    answer = Reconfiguration(estimator, alternative)  # type: ignore[arg-type]
    failure = FaultEvent(10, 9, Verdict.SENSOR, ("link_position",), ())
    answer(failure)
    assert estimator.measurement_covariance == pytest.approx([4.0])
    assert estimator.excited.tolist() == ([True] * 3 if alternative == 1 else [False, False, True])
    answer(replace(failure, verdict=Verdict.RECOVERED))
    assert estimator.measurement_covariance == pytest.approx([0.04])
    assert estimator.excited.all()


def test_a_velocity_failure_does_not_hold_the_stiffness() -> None:
    estimator = RecursiveLeastSquares([1.0, 2.0], 1.0, outputs=1, names=("k1", "k2"), R2=[1.0])
    Reconfiguration(estimator, 2)(FaultEvent(1, 1, Verdict.SENSOR, ("link_velocity",), ()))
    assert estimator.excited.all()
    with pytest.raises(InputError, match="alternative"):
        Reconfiguration(estimator, 3)  # type: ignore[arg-type]


def test_limits_do_not_fall_below_the_noise(calibrated: FaultDetector) -> None:
    from identification.faults.calibrate import floors

    rule = calibrated._rule
    low = floors(rule.core, rule.settings)  # type: ignore[arg-type]
    assert all(a >= b and math.isfinite(a) for a, b in zip(rule.residuals.limits, low, strict=True))  # type: ignore[union-attr]


@pytest.mark.parametrize("name", NAMES)
def test_every_joint_has_a_gain_for_every_set_of_sensors(name: str) -> None:
    """A joint without friction, too, of which the torque alone is left."""
    model = reference_joint(name).model()
    if not model.is_elastic:
        pytest.skip("a detector needs an elastic joint")
    for has_torque in (True, False):
        gains = FaultDetector(model, DT, has_torque=has_torque).tables().gains
        assert np.isfinite(gains).all()
        assert not gains[0].any()
        assert gains[1:].any(axis=1).tolist() == [n < 16 or has_torque for n in range(1, 32)]
