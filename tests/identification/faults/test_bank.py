"""The fault bank where no velocity is measured: each sensor named, none that is not there."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.faults.plant import DT, reference
from benchmarks.online_filter import NOISE, Readings, follower, plant, recorded
from casadi_models import JointModel
from identification.errors import InputError
from identification.faults.bank import BankTrack, FaultBank
from identification.faults.bank_levels import Piece
from identification.faults.injector import Fault, Kind, inject
from identification.faults.types import Verdict

THERE = (True, True, False, True, False, True)
BEGIN = 6.0


@pytest.fixture(scope="module")
def bank() -> FaultBank:
    made = FaultBank(plant(), DT, THERE)
    made.calibrate([Piece(r.time, r.rows) for r in (recorded(s, 20.0) for s in (31, 32))])
    return made


@pytest.fixture(scope="module")
def unseen() -> Readings:
    return recorded(33, 14.0)


def run(bank: FaultBank, record: Readings, *faults: Fault) -> BankTrack:
    return bank.run(record.time, inject(record.rows, DT, faults, seed=1))


def test_nothing_is_said_about_a_healthy_joint(bank: FaultBank, unseen: Readings) -> None:
    track = run(bank, unseen)
    assert track.events == ()
    assert not track.failed.any()
    # limits are no wall: what is healthy stays well inside them
    assert 0.2 < track.scores[2000:].max() < 0.9


def test_missing_readings_in_healthy_records_cost_nothing_but_their_samples(
    bank: FaultBank, unseen: Readings
) -> None:
    """Numbers that are none, or absurd, in some samples, and a gap: limits stay what they are."""
    rng, pieces = np.random.default_rng(8), []
    for seed in (31, 32):
        whole = recorded(seed, 20.0)
        rows, kept = whole.rows.copy(), np.ones(len(whole.time), dtype=bool)
        for sensor, value in ((0, np.nan), (3, np.nan), (5, np.inf), (1, 1e30)):
            rows[rng.integers(0, len(rows), 20), sensor] = value
        kept[9000:9200] = False
        pieces.append(Piece(whole.time[kept], rows[kept]))
    made = FaultBank(plant(), DT, THERE)
    tuning = made.calibrate(pieces)
    # of the innovations of both positions and the torque; no torque is lacking, and any small level
    # says so
    share = (tuning.limits[0, :-3] / bank.tuned.limits[0, :-3]).reshape(-1, 5)[:, [0, 2, 4]]
    assert 1 / 1.5 < share.min() < share.max() < 1.5
    assert run(made, unseen).events == ()
    fault = run(made, unseen, Fault("link_position", "bias", BEGIN, 0.01))
    assert [e.sensors for e in fault.events] == [("link_position",)]


@pytest.mark.parametrize(
    ("sensor", "kind", "size"),
    [
        ("current", "bias", 15.0),
        ("motor_position", "bias", 0.01),
        ("link_position", "drift", 0.005),
        ("torque", "gain", 0.3),
        ("link_position", "stuck", 0.0),
        ("motor_position", "spike", 0.01),
        ("torque", "dropout", 0.0),
    ],
)
def test_the_failed_sensor_is_named_and_no_other(
    bank: FaultBank, unseen: Readings, sensor: str, kind: Kind, size: float
) -> None:
    track = run(bank, unseen, Fault(sensor, kind, BEGIN, size))
    said = [e for e in track.events if e.verdict is not Verdict.RECOVERED]
    assert {n for e in said for n in e.sensors} == {sensor}
    assert {e.verdict for e in said} <= {
        Verdict.SENSOR,
        Verdict.DROPOUT,
        Verdict.CURRENT_OR_FRICTION,
    }
    assert unseen.time[said[0].first] >= BEGIN - DT / 2
    assert track.failed[:, :].any(axis=0).sum() == 1


def test_a_sensor_that_works_again_is_read_again(bank: FaultBank, unseen: Readings) -> None:
    track = run(bank, unseen, Fault("link_position", "bias", BEGIN, 0.01, BEGIN + 3.0))
    assert [e.verdict for e in track.events] == [Verdict.SENSOR, Verdict.RECOVERED]
    assert BEGIN + 3.0 < unseen.time[track.events[1].sample] < BEGIN + 6.0


def test_a_payload_is_no_sensor(bank: FaultBank) -> None:
    """The recordings' joint carries a third more than the model of the bank says."""
    true = dict(zip(plant().parameter_names, plant().value_vector(), strict=True))
    light = plant().with_values({n: true[n] / 1.3 for n in ("link_inertia", "gravity_torque")})
    record = recorded(34, 12.0)
    found = FaultBank(light, DT, THERE, bank.tuning).run(record.time, record.rows)
    assert {e.verdict for e in found.events} == {Verdict.PLANT}


@pytest.mark.parametrize("seed", [41, 42])
def test_a_stiffness_that_changes_is_no_position_sensor(bank: FaultBank, seed: int) -> None:
    """The joint gets a fifth softer while it moves."""
    path = reference(seed, 9.0)
    course = np.full(len(path), bank.joint.values["stiffness"])
    course[round(BEGIN / DT) :] *= 0.8
    found = follower().run(path, {"stiffness": course})
    clean = np.column_stack([found.drive, found.states, found.torque])
    noise = np.random.default_rng(seed).normal(size=clean.shape) * NOISE
    events = bank.run(found.time, clean + noise).events
    assert [(e.verdict, e.sensors) for e in events] == [(Verdict.PLANT, ("stiffness",))]
    assert BEGIN <= found.time[events[0].first] < BEGIN + 0.1


@pytest.mark.parametrize("rests", [True, False])
def test_at_rest_an_offset_and_a_stiffness_look_alike(bank: FaultBank, rests: bool) -> None:
    """A link encoder that is off by 0.1 mrad; a torque that changes tells which it is."""
    record = recorded(36, 8.0, rest=(4.0, 7.0) if rests else None)
    begin, end = round(5.5 / DT), round(6.6 / DT)
    rows = record.rows.copy()
    rows[begin:, 3] += 1e-4
    states, at = bank.begun(record.time, rows, bank.tuned.levels)
    before = bank.joint.run(
        states[:1],
        record.time[at:begin],
        rows[at:begin],
        bank.flags(begin - at)[:1],
        levels=bank.tuned.levels,
    )
    assert bank.explained(before.last[0], record.time[begin:end], rows[begin:end]) == (True, rests)


def test_without_a_torque_sensor_it_is_never_named(unseen: Readings) -> None:
    few = FaultBank(plant(), DT, (True, True, False, True, False, False))
    few.calibrate([Piece(r.time, r.rows) for r in (recorded(s, 12.0) for s in (31, 32))])
    for sensor, size in (("link_position", 0.01), ("motor_position", 0.01), ("current", 30.0)):
        track = run(few, unseen, Fault(sensor, "bias", BEGIN, size))
        assert track.events
        assert all(
            n in ("current", "motor_position", "link_position")
            for e in track.events
            for n in e.sensors
        )


@pytest.mark.parametrize("value", ["held", "zero"])
def test_all_readings_dead_at_once_is_no_sensor(
    bank: FaultBank, unseen: Readings, value: str
) -> None:
    rows = unseen.rows.copy()
    rows[6000:8000] = rows[6000] if value == "held" else 0.0
    events = bank.run(unseen.time, rows).events
    assert [e.verdict for e in events] == [Verdict.DEAD]
    assert 0 <= unseen.time[events[0].sample] - unseen.time[6000] < 0.01


def test_what_it_cannot_work_with_is_said() -> None:
    with pytest.raises(InputError, match="rigid"):
        FaultBank(JointModel.by_name("hd1", -160.0), DT, THERE)
    slack = plant().with_values({"stiffness": 0.0})
    with pytest.raises(InputError, match="stiffness is 0"):
        FaultBank(slack, DT, THERE)
    with pytest.raises(InputError, match="positions of motor and link"):
        FaultBank(plant(), DT, (True, True, False, False, False, True))
    made = FaultBank(plant(), DT, THERE)
    with pytest.raises(InputError, match="longer than 3 s"):
        made.calibrate([Piece(np.arange(100) * DT, np.zeros((100, 6)))])
    with pytest.raises(InputError, match="calibrate"):
        made.run(np.arange(100) * DT, np.zeros((100, 6)))
