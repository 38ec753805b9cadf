"""Clocks as the fit has them, where a record alone reads them wrong."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from casadi_models import JointModel
from identification import Improvement, Joint, Record, compare, fit, improve, load_joint, read
from identification.balance.clocks import HALF_A_CYCLE
from identification.balance.dataset import Dataset, load_dataset, prepared_model
from identification.balance.weak import WeakRecord
from identification.data.check.gate import passed
from identification.diagnosis import bench
from identification.diagnosis.claims import Ranking
from identification.diagnosis.session import Session
from identification.diagnosis.trials import Base
from identification.errors import InputError
from identification.fitting.assess import assess
from identification.fitting.dataset import _half_cycle, dataset_of
from identification.fitting.first_fit import first_fit
from tests.recorded_world.world import make_case, write_case

DEMO = Path(str(files("workbench"))) / "demo"


def recorded(
    seed: int, kind: str, folder: Path, sensors: str = "all"
) -> tuple[Joint, Record, Record]:
    """A joint of the recorded world, its training and its held-out record."""
    case = make_case(seed, kind=kind, size=None if kind == "none" else 1.0)
    written = write_case(case, folder, sensors)
    joint = load_joint(written / "joint.toml")
    train, test = (
        passed(read(written / f"{n}.csv", joint=joint), joint)[0] for n in ("train", "test")
    )
    return joint, train, test


def both(folder: Path, seed: int, kind: str) -> tuple[JointModel, Dataset, Dataset]:
    """A joint of the recorded world: its model, its records as read, and as the fit has them."""
    joint, train, test = recorded(seed, kind, folder)
    model = prepared_model(joint, train)
    return (
        model,
        load_dataset([train], [test], joint, model),
        dataset_of([train], [test], joint, model),
    )


def late(record: WeakRecord, place: str) -> float:
    """Shift of a place's reading [samples]."""
    return record.shifts.get(place, 0.0) / record.grid.dt


@pytest.mark.parametrize(
    ("seed", "true"), [pytest.param(193004, 2.479, marks=pytest.mark.slow), (181014, 2.427)]
)
def test_a_torque_sensor_is_as_late_as_the_balances_together_have_it(
    seed: int, true: float, tmp_path: Path
) -> None:
    """One record of two read it wrong by two samples; the start model left 10 to 30 times the
    noise of the link, and a gain of the torque sensor was the answer.
    """
    _, read_so, fitted = both(tmp_path, seed, "single")
    assert max(abs(late(w, "torque_sensor") - true) for w in read_so.train) > 1.5
    for w in (*fitted.train, *fitted.held_out):
        assert late(w, "torque_sensor") == pytest.approx(true, abs=0.1)


@pytest.mark.parametrize("seed", [197008, pytest.param(197009, marks=pytest.mark.slow)])
def test_a_filtered_drive_is_told_from_one_that_waits_by_what_the_fit_leaves(
    seed: int, tmp_path: Path
) -> None:
    """Nothing is hidden: shifted by what its low-pass delays it, or by half its cycle, the drive of
    these two left two to five times the noise.
    """
    model, read_so, fitted = both(tmp_path, seed, "none")

    def ratios(data: Dataset) -> list[float]:
        solution = first_fit(model, data)
        return [
            assess(solution.model, data, part, solution.values).balances["motor"].ratio
            for part in (data.train, data.held_out)
        ]

    assert max(ratios(read_so)) > 2.4
    assert max(ratios(fitted)) < 1.2
    assert all(-0.3 < late(w, "drive") <= 0 for w in (*fitted.train, *fitted.held_out))


def test_a_drive_that_waits_and_is_filtered_is_shifted_by_its_wait(tmp_path: Path) -> None:
    """It is late by 2.8 samples in all. By all of them or by none, 1.8 and 4 times the noise of the
    motor was left, and both encoders alone had a torque that is periodic in the position.
    """
    model, _, fitted = both(tmp_path, 201001, "single")
    solution = first_fit(model, fitted)
    left = assess(solution.model, fitted, fitted.held_out, solution.values).balances["motor"]
    assert left.ratio < 1.2
    for w in (*fitted.train, *fitted.held_out):
        assert late(w, "drive") == pytest.approx(1.458, abs=0.15)


@cache
def improved(seed: int, sensors: str) -> tuple[Improvement, Record, Record]:
    """A joint of the recorded world as the loop leaves it, and its records."""
    with TemporaryDirectory() as folder:
        joint, train, test = recorded(seed, "single", Path(folder), sensors)
    return improve([train], joint, [test]), train, test


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "sensors", "name"),
    [
        pytest.param(201006, "encoders", "cyclic_friction", marks=pytest.mark.slow),
        (200002, "all", "kinematic_error"),
    ],
)
def test_clocks_are_asked_again_beside_what_is_missing(seed: int, sensors: str, name: str) -> None:
    """The start model lacks a law of fifty and of a hundred and fifty times the noise, and its
    clocks lean to it: a second name, and 38 times the noise, came of that.
    """
    found, *_ = improved(seed, sensors)
    assert [c.effects for c in found.claims] == [(name,)]
    assert found.verdict == "complete"


@pytest.mark.slow
def test_a_comparison_has_the_clocks_that_the_loop_has() -> None:
    """They are asked again beside what is missing there, too."""
    found, train, test = improved(200002, "all")
    compared = compare(fit(found.joint, [train]), [test], linear=False)
    assert found.steps[0].held_out.relative_error_percent == pytest.approx(
        compared.error.relative_error_percent, rel=1e-2
    )


@pytest.mark.parametrize(
    ("seed", "kind", "waits"),
    [
        pytest.param(435003, "single", 3.65, marks=pytest.mark.slow),
        pytest.param(431007, "pair", 1.02, marks=pytest.mark.slow),
    ],
)
def test_a_drive_later_than_a_clock_waits_for_a_part_and_is_filtered_for_the_rest(
    seed: int, kind: str, waits: float, tmp_path: Path
) -> None:
    """They are late by 6.4 and 3.8 samples in all. Shifted by all of that, the motor stood at 8.7
    and 3.8 times its noise with the delay in the model, and on the first a periodic torque and a
    gain imitated what was left.
    """
    joint, train, test = recorded(seed, kind, tmp_path)
    session = Session.opened([train], joint, [test])
    for w in (*session.data.train, *session.data.held_out):
        assert late(w, "drive") == pytest.approx(waits, abs=0.5)
    if kind == "single":
        found = session.run(session.start())
        assert [c.effects for c in found.claims] == [("channel_delay",)]
        assert found.verdict == "complete"


def test_records_are_prepared_where_the_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """What no fit takes is refused by the verb that fits, and shown as it was read elsewhere."""

    def refused(*_: object) -> None:
        raise InputError("no fit")

    monkeypatch.setattr("identification.fitting.dataset.first_fit", refused)
    joint, run = load_joint(DEMO / "joint.toml"), read(DEMO / "train.npz")
    model = prepared_model(joint, run)
    made, read_so = (f([run], [], joint, model) for f in (dataset_of, load_dataset))
    assert [w.shifts for w in made.train] == [w.shifts for w in read_so.train]


@pytest.mark.slow
def test_the_library_is_tried_once_on_the_start_model(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The first decision is made before the clocks are asked again; where they stay it holds."""
    bases: list[Base] = []
    whole = bench.rank

    def counted(base: Base, **options: object) -> Ranking:
        bases.append(base)
        return whole(base, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(bench, "rank", counted)
    joint, train, test = recorded(193000, "single", tmp_path)
    session = Session.opened([train], joint, [test])
    before = len(bases)
    found = session.run(session.start())
    assert [c.effects for c in found.claims] == [("cyclic_friction",)]
    structure = found.steps[0].solution.model.structure
    assert any(b.solution.model.structure == structure for b in bases[:before])
    assert not any(b.solution.model.structure == structure for b in bases[before:])


@pytest.mark.parametrize("ratios", [(5.27, 6.27, 20.5), (1.0, 1.0, 1.0), (5.0, 2.0, 5.0)])
def test_half_a_cycle_is_a_number_where_three_points_are_no_parabola(
    ratios: tuple[float, float, float],
) -> None:
    """The first made an internal error of an answer: a parabola fell below nothing."""
    half = HALF_A_CYCLE / 2
    early = _half_cycle(lambda samples: [(1932, ratios[round(samples / half)])])
    assert 0.0 <= early <= 2 * half


@pytest.mark.parametrize("seed", [pytest.param(173007, marks=pytest.mark.slow), 173017])
def test_a_stick_shorter_than_a_kernel_is_no_structure(seed: int, tmp_path: Path) -> None:
    """Light joints at 1 kHz, nothing hidden: they stand for a millisecond at each turn, and a tenth
    of the rows then held nine tenths of what was left, 4.3 and 5.4 times the noise.
    """
    joint, train, test = recorded(seed, "none", tmp_path)
    made = Session.opened([train], joint, [test]).bench
    assert max(e.ratio for e in made.ratios(made.step(None, None, made.start())).values()) < 1.5


@pytest.mark.slow
def test_a_missing_scale_bends_no_clock(tmp_path: Path) -> None:
    """A drive through a low-pass, and a motor constant that is off: half of the lateness as a wait
    fits best where the scale is missing, and beside that no name was found.
    """
    joint, train, test = recorded(220009, "single", tmp_path, "motor_torque")
    found = improve([train], joint, [test])
    assert found.verdict == "complete"
    assert "motor_constant_error" in {e.partition("@")[0] for c in found.claims for e in c.effects}
