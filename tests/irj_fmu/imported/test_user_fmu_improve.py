"""`irj improve` with a user's FMU as the model: hidden, added outside, gone; and never an
all-clear over the floor.
"""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from identification.data.record import Record
from identification.diagnosis.improve import RATIO_LIMIT
from irj_fmu.imported.compare import compare
from irj_fmu.imported.diagnose import diagnose
from irj_fmu.imported.file import load_user_joint
from irj_fmu.imported.fit import fit
from irj_fmu.imported.improve import improve
from tests.irj_fmu.imported.test_user_fmu import DRAG, FILE
from tests.user_fmus.make import Make, build
from tests.user_fmus.plant import OWN, foreign, recorded
from tests.user_fmus.records import axis
from workbench.cli.main import main

SCHEMA = Path(__file__).parents[2] / "data" / "improve.schema.json"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Joint file and FMU."""
    folder = tmp_path_factory.mktemp("improve")
    build("Axis", folder, Make(2, ("CoSimulation",))).replace(folder / "axis.fmu")
    (folder / "user.toml").write_text(FILE.format(fmu="axis.fmu"))
    return folder


@pytest.fixture(scope="module")
def plain() -> Record:
    return axis(seconds=10.0, h=4e-3)


def test_nothing_is_added_where_nothing_is_hidden(place: Path, plain: Record) -> None:
    found = improve(load_user_joint(place / "user.toml"), plain.window(0, 6), plain.window(6, 10))
    assert found.found.added == ()
    assert found.outcome == "complete"
    assert found.outputs[-1].outputs["motor_position"].ratio < RATIO_LIMIT


def test_no_all_clear_where_an_output_stands_above_its_floor(place: Path, plain: Record) -> None:
    """An error of the encoder cannot ride outside as a torque: it is not named, and not kept
    quiet.
    """
    q = plain["motor_position"]
    wrong = plain.with_channel("motor_position", q + 1e-3 * np.sin(20 * q))
    train, held = wrong.window(0, 6), wrong.window(6, 10)
    fitted = fit(load_user_joint(place / "user.toml"), train)
    compared, diagnosed = compare(fitted, held), diagnose(fitted, train, held)
    assert compared.outputs["motor_position"].ratio > RATIO_LIMIT
    assert diagnosed.diagnosis.outcome == "unexplained"
    found = improve(fitted.model, train, held, max_additions=1)
    for result in (fitted.model, fitted, compared, diagnosed, found):  # they print on a screen
        assert max(len(f(result).splitlines()) for f in (str, repr)) <= 25, type(result)
    assert found.outcome == "unexplained"
    assert found.found.verdict == "unexplained"


def test_a_hidden_effect_is_named_and_explained_on_the_command_line(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = axis(lambda _q, w: DRAG * w * abs(w), seconds=10.0, h=4e-3)
    for name, part in (("train", record.window(0, 6)), ("held", record.window(6, 10))):
        columns = {
            "time_s": part.time,
            "motor_position_rad": part["motor_position"],
            "motor_torque_N.m": part["motor_torque"],
        }
        np.savez(place / f"{name}.npz", **columns)
    train, held, joint, better, data, report = (
        str(place / n)
        for n in ("train.npz", "held.npz", "user.toml", "better.toml", "i.json", "r.html")
    )
    assert (
        main(
            [
                "improve",
                train,
                "--held-out",
                held,
                "--joint",
                joint,
                "-o",
                better,
                "--json",
                data,
                "--report",
                report,
            ]
        )
        == 0
    )
    found = json.loads(Path(data).read_text())
    jsonschema.validate(found, json.loads(SCHEMA.read_text()))
    assert "quadratic_drag" in found["claims"][0]["effects"]
    assert len(found["steps"]) == len(found["outputs"]) == 2
    before, after = (o["motor_position"]["ratio"] for o in found["outputs"])
    assert before > 5
    assert after < RATIO_LIMIT
    assert found["verdict"] == "complete"
    assert "quadratic drag" in Path(report).read_text(encoding="utf-8").lower()
    assert load_user_joint(better).correction is not None
    assert "outputs on held-out data" in capsys.readouterr().out


@pytest.fixture(scope="module")
def elastic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Co-simulation only, parameters fixed, no FMU state."""
    return build(
        "Elastic", tmp_path_factory.mktemp("elastic"), Make(2, ("CoSimulation",), strict=True)
    )


@pytest.mark.slow
def test_what_cannot_ride_outside_is_in_the_values_all_the_same(elastic: Path) -> None:
    """A spring at the link: fitted by its outputs without it, the FMU makes up for it with half of
    its gravity more, 200 standard errors from the truth.
    """
    train, held = (recorded("added_spring", t, seed) for t, seed in ((8.0, 1), (4.0, 1001)))
    found = improve(foreign(elastic), train, held, max_additions=1)
    assert [c.effects for c in found.found.claims] == [("added_spring",)]
    for name, value in OWN.items():
        error = found.stderr[name]
        assert error is not None, name
        assert found.model.values[name] == pytest.approx(value, abs=3.5 * error), name
        assert error < 0.05 * value, name
    table = found.parameters["gravity"]
    assert table["stderr"] == found.stderr["gravity"]
    # the spring is known no better than gravity, which may stand in for it
    last = found.found.steps[-1].solution
    error = last.stderr["link_added_spring"]
    assert error is not None
    assert last.values["link_added_spring"] == pytest.approx(30.0, abs=3.5 * error)
    assert error > 0.2 * (found.stderr["gravity"] or 0.0)
