"""FMUs that fail on the way, give no numbers, have other units or other steps: a command says in
one line what, where and what to do, and leaves nothing behind.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from irj_fmu.imported.file import load_user_joint
from tests.irj_fmu.imported.test_user_fmu import FILE, START
from tests.user_fmus.make import Make, build
from tests.user_fmus.makes import CS, write_record
from tests.user_fmus.records import axis
from workbench.cli.main import main

BROKEN = {
    "discard": (Make(2, CS, fails=2), "doStep failed with status 2 (discard) at t = 0.1 s"),
    "error": (Make(2, CS, fails=3), "doStep failed with status 3 (error) at t = 0.1 s"),
    "no number": (Make(2, CS, breaks=0.05), "output 'angle' is not finite from t = 0.056 s on"),
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a space, umlauts and a percent sign, and records in it."""
    folder = tmp_path_factory.mktemp("Prüf stand%20ä")
    record = axis(seconds=3.0, h=4e-3)
    write_record(record.window(0, 2), folder / "lauf 1.npz")
    write_record(record.window(2, 3), folder / "lauf 2.npz")
    return folder


def placed(place: Path, make: Make, change: tuple[str, str] = ("", "")) -> Path:
    """The joint file of an axis of that make, FMU and file with umlauts in their names."""
    build("Axis", place, make).replace(place / "achse ö.fmu")
    joint = place / "gelenk ü.toml"
    joint.write_text(FILE.format(fmu="achse ö.fmu").replace(*change), encoding="utf-8")
    return joint


def refused(place: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The last line of a command that must refuse; no file is changed or left."""
    before = {p: p.read_bytes() for p in place.iterdir() if p.is_file()}
    capsys.readouterr()
    assert main(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert {p: p.read_bytes() for p in place.iterdir() if p.is_file()} == before
    assert "Warning" not in err
    return err.splitlines()[-1]


@pytest.mark.parametrize("case", BROKEN)
@pytest.mark.parametrize(
    "verb", ["fit", "compare", "diagnose", "improve", "report", "explore", "track"]
)
def test_an_fmu_that_breaks_on_the_way(
    place: Path, capsys: pytest.CaptureFixture[str], case: str, verb: str
) -> None:
    make, why = BROKEN[case]
    joint = placed(place, make)
    words = [
        verb,
        str(place / "lauf 1.npz"),
        "--joint",
        str(joint),
        "--json",
        str(place / "j.json"),
    ]
    if verb in ("diagnose", "improve", "report", "explore"):
        words += ["--held-out", str(place / "lauf 2.npz")]
    if verb == "improve":
        words += ["--report", str(place / "r.html"), "--picture", str(place / "p.svg")]
    if verb not in ("compare", "track"):
        words += ["-o", str(place / ("r.html" if verb == "report" else "o.toml"))]
    said = refused(place, capsys, *words)
    assert said.startswith(f"irj: achse ö.fmu: {why}")
    assert "check start values, parameters and their bounds" in said


@pytest.mark.parametrize("verb", ["trust", "next", "twostep"])
def test_what_does_not_take_an_fmu_says_what_does(
    place: Path, capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    joint = placed(place, Make(2, CS))
    said = refused(place, capsys, verb, str(place / "lauf 1.npz"), "--joint", str(joint))
    assert f"its model is an FMU; `irj {verb}` does not take one, only check, fit" in said


def test_a_batch_is_a_study_and_says_so(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joint = placed(place, Make(2, CS))
    said = refused(place, capsys, "batch", str(place / "lauf 1.npz"), "--joint", str(joint))
    assert "takes a study file" in said and "[[joint]]" in said


def test_the_one_that_cannot_be_set_is_named(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = placed(place, Make(2, CS), ('q = "motor_position"', 'angle = "motor_position"'))
    said = refused(place, capsys, "fit", str(place / "lauf 1.npz"), "--joint", str(joint))
    assert "refuses to take angle (output of variability continuous); a start, a parameter" in said
    assert "inertia" not in said


@pytest.mark.parametrize(
    ("units", "why"),
    [
        (
            (("angle", "m"),),
            'motor_position = { variable = "angle", scale = S } with S in m per rad',
        ),
        (
            (("torque", "A"),),
            'motor_torque = { variable = "torque", scale = S } with S in A per N.m',
        ),
    ],
)
def test_another_quantity_is_refused_with_what_to_write(
    place: Path,
    capsys: pytest.CaptureFixture[str],
    units: tuple[tuple[str, str], ...],
    why: str,
) -> None:
    joint = placed(place, Make(2, CS, units=units))
    assert why in refused(place, capsys, "fit", str(place / "lauf 1.npz"), "--joint", str(joint))


def first(place: Path, make: Make, name: str = "Axis") -> str:
    """What `irj joint new` writes for an FMU."""
    fmu, out = build(name, place, make), place / "erste ü.toml"
    words = ["joint", "new", str(fmu), "--record", str(place / "lauf 1.npz"), "-o", str(out)]
    assert main(words) == 0
    return out.read_text(encoding="utf-8")


def test_a_first_file_maps_no_other_quantity_and_asks_where_no_unit_tells(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = build("Axis", place, Make(2, CS, units=(("angle", "m"),)))
    words = ["joint", "new", str(fmu), "--record", str(place / "lauf 1.npz")]
    said = refused(place, capsys, *words, "-o", str(place / "erste.toml"))
    assert "no output goes with a channel of lauf 1 (outputs: angle in m, speed;" in said
    text = first(place, Make(2, CS, units=(("angle", "furlong"),)))
    assert "CHECK the scale: its unit 'furlong' is not known, taken as rad" in text
    text = first(place, Make(2, CS, units=(("angle", "deg"),)))
    assert "scale = 57.29577951308232 }" in text
    assert text.count("CHECK: the FMU states no unit") == 1  # of the torque
    text = first(place, Make(2, CS, step=1e-3, once=True), "Servo")
    assert "taken as rad; 57.29577951 where it has degrees" in text


def test_starts_of_an_fmu_of_fixed_step_are_found_at_its_step(place: Path) -> None:
    first(place, Make(2, CS, step=2e-3))
    model = load_user_joint(place / "erste ü.toml")
    assert {m.variable: m.channel for m in model.starts} == START
    assert all(m.scale == pytest.approx(1.0) for m in model.starts)
