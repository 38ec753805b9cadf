"""`explore` with a user's FMU as the model: effects at its ports held against each other."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from identification.balance.dataset import with_effect
from identification.data.record import Record
from identification.variants.refit import Weighting
from irj_fmu.imported.diagnose import laid_open
from irj_fmu.imported.file import load_user_joint, user_joint_text
from irj_fmu.imported.verbs.explore import FmuGround, explore
from tests.irj_fmu.imported.test_user_fmu import FILE
from tests.irj_fmu.imported.test_user_fmu_hostile import refused
from tests.user_fmus.make import Make, build
from tests.user_fmus.makes import CS, MAKES, write_case, write_record
from tests.user_fmus.plant import HIDDEN, OWN, foreign, recorded
from tests.user_fmus.records import TRUTH, axis
from workbench.cli.main import main


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Co-simulation only, parameters fixed, no FMU state."""
    return build("Elastic", tmp_path_factory.mktemp("x"), Make(2, CS, strict=True))


def halves(hidden: str | None, seed: int) -> tuple[Record, Record]:
    record = recorded(hidden, 9.0, seed)
    return record.window(0, 6), record.window(6, 9)


@pytest.mark.slow
def test_what_is_hidden_is_recommended_and_on_the_front(path: Path, tmp_path: Path) -> None:
    """From the command line, with every file that it writes."""
    for name, part in zip(("train", "held"), halves("stribeck", 3), strict=True):
        write_record(part, tmp_path / f"{name}.npz")
    joint, data, better = (tmp_path / n for n in ("user.toml", "found.json", "better.toml"))
    joint.write_text(user_joint_text(foreign(path)))
    given = [str(tmp_path / "train.npz"), "--held-out", str(tmp_path / "held.npz")]
    picture, folder = tmp_path / "v.svg", tmp_path / "all"
    written = ["--json", data, "-o", better, "--picture", picture, "--out", folder]
    assert main(["explore", *given, "--joint", str(joint), *map(str, written)]) == 0
    found = json.loads(data.read_text())
    (label,) = found["added"]
    assert label == "stribeck@motor"
    assert found["ties"] == [found["recommended"]]
    assert found["recommended"] in found["pareto"]
    assert found["screened"] > 1000
    assert "the same" in found["agreement"]
    start = next(v for v in found["variants"] if not v["added"])
    assert start["parameters"] == len(OWN)  # the FMU's own
    assert found["variants"][0]["parameters"] == len(OWN) + 3
    assert not any(v["dropped"] for v in found["variants"])  # nothing can be taken out of an FMU
    # the file that it writes is a model whose values are those of the plant
    model = load_user_joint(better)
    assert model.correction is not None and model.correction.labels == ("stribeck@motor",)
    for name, value in OWN.items():
        assert model.values[name] == pytest.approx(value, rel=0.01), name
    assert {p.name for p in folder.iterdir()} == {"variants.parquet", "explore.json", "explore.svg"}
    assert "stribeck" in picture.read_text(encoding="utf-8").lower()


@pytest.mark.slow
def test_what_cannot_ride_outside_is_recommended_and_said(path: Path) -> None:
    """A gap of the gear: fitted by its outputs, the FMU has a spring that is far too soft."""
    found = explore(foreign(path), *halves("backlash", 3))
    assert found.found.recommended.added == ("backlash",) == found.aside
    assert found.found.recommended in found.found.front
    assert found.model.correction is None
    assert found.model.values["stiffness"] == pytest.approx(OWN["stiffness"], rel=0.01)
    assert max(len(line) for line in repr(found).splitlines()[:-2]) <= 100
    assert len(repr(found).splitlines()) <= 26


@pytest.mark.slow
def test_where_nothing_is_hidden_the_fmu_as_it_is_is_recommended(path: Path) -> None:
    found = explore(foreign(path), *halves(None, 4))
    assert found.found.recommended is found.found.start
    assert found.aside == () and found.model.correction is None


@pytest.mark.parametrize(
    "hidden", ["hysteresis", pytest.param("torque_sensor_gain", marks=pytest.mark.slow)]
)
def test_a_variant_is_as_near_as_its_whole_fit(path: Path, hidden: str) -> None:
    """The FMU's parameters follow a variant as far as that is linear: about the right values its
    error is that of the fit that runs the FMU again. The joint that is left and the FMU both have a
    `stiffness`: a start value of the one is no change of the other.
    """
    opened = laid_open(foreign(path).with_values(OWN), *halves(hidden, 5))
    bench, start = opened.bench, opened.session.start()
    label, values = HIDDEN[hidden]
    model = with_effect(start.model, label)
    whole = bench.fitted(model, {**start.values, **values})
    weighting = Weighting.of(whole, bench.data_of(whole))
    given = {**start.values, **values}
    assert {"stiffness", "motor_inertia"} <= given.keys() & OWN.keys()
    found = FmuGround(opened).refitted(model, (given,), weighting)
    truth = dict.fromkeys(OWN, 0.0)
    assert bench.changes(found.solution) == pytest.approx(truth, abs=0.02 * max(OWN.values()))
    step = bench.step(None, None, whole)
    assert found.held.relative_error_percent == pytest.approx(
        step.held_out.relative_error_percent, rel=0.02
    )


@pytest.mark.slow
def test_a_joint_of_one_side_is_explored(tmp_path: Path) -> None:
    """From the command line: one search gives the report, the data and the file."""
    build("Axis", tmp_path, Make(3, CS)).replace(tmp_path / "axis.fmu")
    joint = tmp_path / "user.toml"
    joint.write_text(FILE.format(fmu="axis.fmu"))
    record = axis(lambda _q, w: 0.15 * w * abs(w), seconds=10.0, h=4e-3)
    for name, part in (("a", record.window(0, 6)), ("b", record.window(6, 10))):
        write_record(part, tmp_path / f"{name}.npz")
    given = [str(tmp_path / "a.npz"), "--held-out", str(tmp_path / "b.npz")]
    report, data, better = (tmp_path / n for n in ("r.html", "found.json", "better.toml"))
    written = ["--report", str(report), "--json", str(data), "-o", str(better)]
    assert main(["explore", *given, "--joint", str(joint), *written]) == 0
    assert "quadratic drag" in report.read_text(encoding="utf-8").lower()
    found = json.loads(data.read_text())
    assert any("quadratic_drag" in "".join(labels) for labels in found["ties"])
    assert any("quadratic_drag" in "".join(labels) for labels in found["pareto"])
    model = load_user_joint(better)
    for name, value in TRUTH.items():
        assert model.values[name] == pytest.approx(value, rel=0.05), name


# --- what it refuses ------------------------------------------------------------------------------


def test_an_fmu_without_a_drive_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = next(c for n, c in MAKES.items() if "pol" in n.lower())
    joint, run = write_case(case, tmp_path, 3)
    said = refused(tmp_path, capsys, "explore", str(run), "--joint", str(joint))
    assert "drive" in said or "input" in said


def test_what_goes_with_a_joint_model_only_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], path: Path
) -> None:
    joint, run = tmp_path / "user.toml", tmp_path / "r.npz"
    joint.write_text(user_joint_text(foreign(path)))
    write_record(recorded(None, 2.0, 1), run)
    given = ["explore", str(run), "--joint", str(joint)]
    other = tmp_path / "o.npz"
    write_record(recorded(None, 2.0, 2), other)
    said = refused(tmp_path, capsys, *given, "--other-payload", str(other))
    assert "--other-payload" in said and "FMU" in said
    said = refused(tmp_path, capsys, *given, "-o", str(run))
    assert "r.npz" in said
    lame = tmp_path / "lame.npz"
    write_record(recorded(None, 2.0, 1).without("link_position"), lame)
    said = refused(tmp_path, capsys, "explore", str(lame), "--joint", str(joint))
    assert "has no link_position" in said
