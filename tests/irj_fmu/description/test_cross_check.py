"""The folder of the FMI Cross-Check: its rules, and that another host gets its reference."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from identification.version import VERSION
from irj_fmu.build import main

JOINT = Path(__file__).parents[3] / "examples" / "shoulder.toml"
MODEL = "shoulder_plant"
MEGABYTE = 1_000_000


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check") / "Größe 1"
    line = ["plant", "--joint", str(JOINT), "--out", str(folder), "--cross-check"]
    assert main([*line, "--json", str(folder.parent / "built.json")]) == 0
    built = json.loads((folder.parent / "built.json").read_text())["built"]
    assert {str(p) for p in folder.rglob("*") if p.is_file()} == set(built)
    return folder


def place(out: Path, kind: str) -> Path:
    return out / "fmus" / "2.0" / kind / "linux64" / "irj" / VERSION / MODEL


def table(path: Path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", names=True, deletechars="", encoding="utf-8")


def options(folder: Path) -> dict[str, float]:
    lines = (folder / f"{MODEL}_ref.opt").read_text().splitlines()
    return {k: float(v) for k, v in (line.split(", ") for line in lines)}


@pytest.mark.parametrize("kind", ["cs", "me"])
def test_the_files_are_those_that_the_rules_ask_for(out: Path, kind: str) -> None:
    from fmpy import read_model_description

    folder = place(out, kind)
    names = {f"{MODEL}{end}" for end in (".fmu", "_ref.csv", "_ref.opt", "_in.csv")}
    assert {p.name for p in folder.iterdir()} == names | {"README.md"}
    about = read_model_description(str(folder / f"{MODEL}.fmu"))
    causality = {v.name: v.causality for v in about.modelVariables}
    told = options(folder)
    for end, wanted in (("_ref", "output"), ("_in", "input")):
        path = folder / f"{MODEL}{end}.csv"
        assert path.stat().st_size < MEGABYTE
        first = path.read_text().splitlines()[0]
        assert all(n.startswith('"') and n.endswith('"') for n in first.split(","))
        found = table(path)
        columns = [n.strip('"') for n in found.dtype.names or ()]
        assert columns[0] == "time"
        assert {causality[n] for n in columns[1:]} == {wanted}
        time = found[list(found.dtype.names or ())[0]]
        assert (time[0], time[-1]) == (told["StartTime"], told["StopTime"])
        assert np.allclose(np.diff(time), told["OutputIntervalLength"], rtol=0, atol=1e-12)


def test_another_host_gets_the_reference(out: Path) -> None:
    """fmpy, from the files alone."""
    from fmpy import simulate_fmu
    from fmpy.util import read_csv

    folder = place(out, "cs")
    told, wanted = options(folder), read_csv(str(folder / f"{MODEL}_ref.csv"))
    names = list(wanted.dtype.names[1:])
    found = simulate_fmu(
        str(folder / f"{MODEL}.fmu"),
        fmi_type="CoSimulation",
        start_time=told["StartTime"],
        stop_time=told["StopTime"],
        output_interval=told["StepSize"],
        input=read_csv(str(folder / f"{MODEL}_in.csv")),
        output=names,
    )
    each = round(told["OutputIntervalLength"] / told["StepSize"])
    for name in names:
        size = np.abs(wanted[name]).max()
        assert np.abs(found[name][::each] - wanted[name]).max() < told["RelTol"] * size, name


def test_both_interfaces_are_one_joint(out: Path) -> None:
    """Co-simulation holds its inputs for a step of a millisecond, model exchange does not."""
    one, two = (table(place(out, kind) / f"{MODEL}_ref.csv") for kind in ("cs", "me"))
    for name in list(one.dtype.names or ())[1:]:
        size = np.abs(two[name]).max()
        assert size > 0.1, name
        assert np.abs(one[name] - two[name]).max() < 1e-2 * size, name


def test_what_it_is_not_for_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more, told in (
        (["plant", "--fmi", "3"], "its rules are for FMI 2.0"),
        (["estimator"], "goes with plant, not with estimator"),
    ):
        line = ["--joint", str(JOINT), "--out", str(tmp_path / "no"), "--cross-check"]
        assert main([*more, *line]) == 2
        said = capsys.readouterr().err
        assert told in said
        assert said.count("\n") == 1
    assert not (tmp_path / "no").exists()
