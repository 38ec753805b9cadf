"""FMUs of other makes from the command line: fitted within their errors, or refused in a line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from irj_fmu.imported.fit import fit
from tests.user_fmus.make import Make, build, check
from tests.user_fmus.makes import (
    BOTH,
    BOUNCING,
    CS,
    MAKES,
    ME,
    bouncing_ball,
    write_case,
    write_record,
)
from tests.user_fmus.plant import OWN, foreign, recorded
from tests.user_fmus.records import GRAVITY, ball
from workbench.cli.main import main


@pytest.mark.parametrize("name", MAKES)
def test_a_fit_is_within_its_errors(tmp_path: Path, name: str) -> None:
    case = MAKES[name]
    joint, run = write_case(case, tmp_path, 3)
    out = tmp_path / "fit.json"
    assert main(["fit", str(run), "--joint", str(joint), "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    assert found["settled"]
    for parameter, value in case.truth.items():
        row = found["parameters"][parameter]
        assert abs(row["value"] - value) < 3 * row["stderr"], parameter
        assert row["stderr"] < 0.02 * abs(value), parameter
    assert all(e["ratio"] < 1.2 for e in found["train"]["outputs"].values())


@pytest.mark.parametrize("version", [2, 3])
def test_model_exchange_with_state_events_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], version: int
) -> None:
    """A ball that bounces: without its events it falls through the floor, for ever faster."""
    write_record(ball(), tmp_path / "ball.npz")
    joint = tmp_path / "user.toml"
    for kinds, more, why in (
        (ME, "", "state events only, which runs here do not follow; export it for co-simulation"),
        (BOTH, 'kind = "me"\n', "kind = 'me' is not possible (its model exchange has state events"),
    ):
        fmu = bouncing_ball(tmp_path, version, kinds)
        assert check(fmu) == []
        joint.write_text(f'[joint]\n[model]\nfmu = "{fmu.name}"\n{BOUNCING.format(more=more)}')
        for verb in ("fit", "compare", "diagnose", "improve"):
            assert main([verb, str(tmp_path / "ball.npz"), "--joint", str(joint)]) == 2
            out, err = capsys.readouterr()
            assert out == ""
            assert err.count("\n") == 1
            assert why in err
            assert fmu.name in err


@pytest.mark.parametrize("version", [2, 3])
def test_a_co_simulation_finds_its_events_itself(tmp_path: Path, version: int) -> None:
    write_record(ball(), tmp_path / "ball.npz")
    joint, out = tmp_path / "user.toml", tmp_path / "fit.json"
    for kinds in (BOTH, CS):
        fmu = bouncing_ball(tmp_path, version, kinds)
        joint.write_text(f'[joint]\n[model]\nfmu = "{fmu.name}"\n{BOUNCING.format(more="")}')
        given = ["fit", str(tmp_path / "ball.npz"), "--joint", str(joint), "--json", str(out)]
        assert main(given) == 0
        row = json.loads(out.read_text())["parameters"]["g"]
        assert abs(row["value"] - GRAVITY) < 2 * row["stderr"]
        assert row["stderr"] < 2e-3 * GRAVITY


def test_a_fixed_step_that_does_not_divide_the_sample_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = build("Servo", tmp_path, Make(2, CS, step=1.5e-3))
    case = MAKES["Simulink style: fixed step, degrees, once per process"]
    joint, run = write_case(replace(case, made=lambda _folder: fmu), tmp_path, 3)
    capsys.readouterr()
    assert main(["fit", str(run), "--joint", str(joint)]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"{fmu.name}: its fixed step of 1.5 ms does not divide the time between samples" in said
    assert "export it with a step that does, or resample the record" in said


def test_an_array_is_named_by_its_elements(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint, run = write_case(MAKES["StateSpace, FMI 3 cs"], tmp_path, 3)
    joint.write_text(joint.read_text().replace('"u[1]"', '"u"'))
    assert main(["fit", str(run), "--joint", str(joint)]) == 2
    assert "variable 'u' is an array; name one element of it, u[1]" in capsys.readouterr().err
    joint.write_text(joint.read_text().replace('"y[2]"', '"y"').replace('"u"', '"u[1]"'))
    assert main(["fit", str(run), "--joint", str(joint)]) == 2
    assert "name one element of it, y[1] to y[2]" in capsys.readouterr().err


@pytest.mark.slow
def test_a_fit_ends_where_it_ends_from_anywhere(tmp_path: Path) -> None:
    """From three tenths below every value it stopped 1.6 standard errors short, as its steps were
    used up on the weights of the residual that it began with.
    """
    model = foreign(build("Elastic", tmp_path, Make(2, CS, strict=True)))
    record = recorded(None, 4.0, 3)
    near = fit(model, record)
    far = fit(model.with_values({n: 0.7 * x for n, x in OWN.items()}), record)
    assert near.settled
    assert far.settled
    for name in OWN:
        error = near.stderr[name]
        assert error is not None
        assert abs(far.values[name] - near.values[name]) < 0.1 * error, name


def test_a_fit_that_did_not_come_to_rest_says_so(tmp_path: Path) -> None:
    model = foreign(build("Elastic", tmp_path, Make(2, CS, strict=True)))
    far = model.with_values({n: 0.7 * x for n, x in OWN.items()})
    found = fit(far, recorded(None, 2.0, 3), iterations=3)
    assert not found.settled
    said = [n for n in found.model.notes if "3 steps were used up before the fit came to rest" in n]
    assert len(said) == 1
    again = fit(found.model, recorded(None, 2.0, 3))
    assert again.settled
    assert "used up" not in " ".join(again.model.notes)
