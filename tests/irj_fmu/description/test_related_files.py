"""Joint file, report and held-out record inside a plant FMU, by the layered standard FMI-LS-REF."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from irj_fmu.build import main
from irj_fmu.fmi.related import FOLDER, MANIFEST
from tests.user_fmus.plant import GEAR, TRUTH, recorded

SECONDS = 2.0
KEY = "{http://fmi-standard.org/fmi-ls-manifest}fmi-ls-name"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A joint file, a report, and a record of that joint."""
    out = tmp_path_factory.mktemp("related")
    values = "\n".join(f"{n} = {{ value = {x!r} }}" for n, x in TRUTH.items())
    (out / "joint.toml").write_text(
        f'[joint]\nname = "axis"\ngear_ratio = {GEAR}\nmodel = "hd3"\n'
        f'effects = ["viscous@motor", "coulomb@motor", "gravity"]\n[fitted]\n{values}\n'
        '[provenance]\nrecords = "run 1"\n'
    )
    (out / "report.html").write_text("<p>What the fit says: ä</p>\n", encoding="utf-8")
    record = recorded(None, SECONDS, 4)
    units = {
        "motor_torque": "Nm",
        "motor_position": "rad",
        "link_position": "rad",
        "link_torque": "Nm",
    }
    table = np.column_stack([record.time, *(record[n] for n in units)])
    head = ",".join(["time_s", *(f"{n}_{unit}" for n, unit in units.items())])
    np.savetxt(out / "run.csv", table, delimiter=",", header=head, comments="")
    return out


def built(folder: Path, fmi: int) -> dict[str, bytes]:
    line = ["plant", "--joint", str(folder / "joint.toml"), "--fmi", str(fmi)]
    line += ["--out", str(folder / f"out{fmi}"), "--report", str(folder / "report.html")]
    assert main([*line, "--held-out", str(folder / "run.csv")]) == 0
    with zipfile.ZipFile(folder / f"out{fmi}" / "axis_plant.fmu") as archive:
        return {n: archive.read(n) for n in archive.namelist()}


@pytest.mark.parametrize("fmi", [2, 3])
def test_what_the_manifest_lists_is_there(folder: Path, fmi: int) -> None:
    content = built(folder, fmi)
    root = ElementTree.fromstring(content[f"{FOLDER}/{MANIFEST}"])
    assert (root.tag, root.attrib[KEY]) == ("fmiReferences", "org.fmi-standard.fmi-ls-ref")
    roles = {r.attrib["source"]: r.attrib["role"] for r in root}
    assert {f"{FOLDER}/{name}" for name in (*roles, MANIFEST)} == {
        n for n in content if n.startswith("extra/")
    }
    assert roles["held_out_experiment.xml"] == "experiment/validation"
    assert roles["held_out_ref.csv"] == "result"
    assert content[f"{FOLDER}/joint.toml"] == (folder / "joint.toml").read_bytes()
    assert content[f"{FOLDER}/report.html"] == (folder / "report.html").read_bytes()
    assert not [n for n, text in content.items() if str(folder).encode() in text]


def test_the_experiment_is_that_of_the_record(folder: Path) -> None:
    """Started and driven as it says, the plant goes where the record went, for a while."""
    from fmpy import simulate_fmu

    content = built(folder, 2)

    def part(name: str) -> bytes:
        return content[f"{FOLDER}/{name}"]

    about = ElementTree.fromstring(part("held_out_experiment.xml"))[0]
    assert float(about.attrib["stopTime"]) == pytest.approx(SECONDS - 1e-3)
    sources = [node.attrib["source"] for node in about]
    starts = {
        node.attrib["name"]: float(node[0].attrib["value"])
        for node in ElementTree.fromstring(part(sources[0])).iter()
        if node.tag.endswith("}Parameter")
    }
    table, wanted = (
        np.genfromtxt(io.BytesIO(part(name)), delimiter=",", names=True, encoding="utf-8")
        for name in sources[1:]
    )
    assert set(wanted.dtype.names or ()) == {
        "time",
        "motor_position",
        "link_position",
        "link_torque",
    }
    found = simulate_fmu(
        str(folder / "out2" / "axis_plant.fmu"),
        fmi_type="CoSimulation",
        stop_time=0.3,
        output_interval=float(about.attrib["stepSize"]),
        input=table,
        start_values=starts,
        output=["motor_position", "link_position"],
    )
    n = len(found)
    for name, ratio in (("motor_position", GEAR), ("link_position", 1.0)):
        moved = np.ptp(wanted[name][:n]) / ratio
        assert moved > 0.01
        assert np.abs(found[name] - wanted[name][:n]).max() / ratio < 0.05 * moved, name


def test_a_record_that_does_not_drive_the_plant_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (folder / "run.csv").read_text().replace("motor_torque_Nm", "elsewhere_1", 1)
    (tmp_path / "bare.csv").write_text(text)
    joint = ["--joint", str(folder / "joint.toml"), "--out", str(tmp_path / "out")]
    for more, told in (
        (["plant", "--held-out", str(tmp_path / "bare.csv")], "motor_torque"),
        (["plant", "--report", str(tmp_path / "none.html")], "none.html: cannot be read"),
        (["estimator", "--report", str(folder / "report.html")], "goes with plant"),
    ):
        assert main([*more, *joint]) == 2
        said = capsys.readouterr().err
        assert told in said
        assert said.count("\n") == 1
