"""One answer through every door: Python, command line, page and report say the same about the
same records.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette")

from casadi_models import EFFECTS
from identification import Record, compare, diagnose, fit, improve, load_joint, read
from identification.data.check.checks import Finding
from identification.data.check.gate import inspected
from identification.diagnosis.improve import RATIO_LIMIT, Improvement
from identification.diagnosis.outcome import OUTCOMES
from identification.errors import InputError
from workbench.cli.main import main
from workbench.page.analysis import Analysis
from workbench.page.report import improvement_of

DEMO = Path(str(files("workbench") / "demo"))
SHARED = Path(__file__).resolve().parents[3] / "shared" / "hidden_effect"
HEADERS = {
    "motor_current": "motor_current_A",
    "motor_position": "motor_position_rad",
    "motor_velocity": "motor_velocity_rad_s",
    "link_position": "link_position_rad",
    "link_velocity": "link_velocity_rad_s",
    "link_torque": "link_torque_Nm",
}
ANGLES = ("motor_position", "motor_velocity", "link_position", "link_velocity")
OWN = """
import casadi as ca
from casadi_models import effect, shape, signed

def declared(key, law, where="motor"):
    effect(key, title=key, family="friction", acts_on=(where,), parameters=(
        signed(key, "N.m", "size"),
        shape(key + "_velocity", "rad/s", "where it bends", (0.05, 0.2, 0.6), "velocity",
              start=0.1, low=1e-6, high=100.0)),
        absence="friction is left", excitation="slow and fast motion", source="a test")(law)

def gauss(s, p):
    x = s.velocity / p.own_gauss_velocity
    return p.own_gauss * ca.tanh(20 * x) * ca.exp(-x**2)

def knee(s, p):
    return p.own_knee * s.velocity / ca.sqrt(1 + (s.velocity / p.own_knee_velocity) ** 2)

def slope(s, p):
    return p.own_slope * s.velocity * ca.exp(-ca.fabs(s.velocity) / p.own_slope_velocity)

declared("own_gauss", gauss)
declared("own_knee", knee, "link")
declared("own_slope", slope, "link")
"""


@dataclass(frozen=True)
class Answer:
    """What a door says."""

    outcome: str
    verdict: str
    claims: tuple[tuple[str, ...], ...]
    refused: frozenset[str]
    ratios: tuple[tuple[str, float], ...]
    warnings: tuple[str, ...]
    reason: str


def answer(data: dict[str, Any]) -> Answer:
    claims = data["claims"] if "claims" in data else ([data["claim"]] if data["claim"] else [])
    ratios = tuple(
        (b, round(float("inf") if e["ratio"] is None else e["ratio"], 9))
        for b, e in data["floor_ratio"].items()
    )
    refused = frozenset(r["effect"] for r in data["refused"])
    return Answer(
        data["outcome"],
        data["verdict"],
        tuple(tuple(c["effects"]) for c in claims),
        refused,
        ratios,
        tuple(data["warnings"]),
        data["reason"],
    )


def written(folder: Path, record: Record) -> Path:
    path = folder / f"{record.name}.npz"
    np.savez(
        path, time_s=record.time, **{HEADERS[c]: values for c, values in record.channels.items()}
    )
    return path


def command(folder: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> Answer | str:
    target = folder / "out.json"
    target.unlink(missing_ok=True)
    capsys.readouterr()
    code = main([*arguments, "--json", str(target)])
    if code == 2:
        lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
        return lines[-1].removeprefix("irj: ").replace(f"{folder}/", "").replace(".npz", "")
    assert code == 0
    return answer(json.loads(target.read_text()))


def said(work: Callable[[], dict[str, Any]]) -> Answer | str:
    try:
        return answer(json.loads(json.dumps(work())))
    except InputError as error:
        return str(error)


def doors(
    train: Record, held: Record, folder: Path, capsys: pytest.CaptureFixture[str]
) -> Answer | str:
    """The one answer of all doors; a refusal is its sentence."""
    joint = load_joint(DEMO / "joint.toml")
    paths = [str(written(folder, r)) for r in (train, held)]
    given = ["--held-out", paths[1], "--joint", str(DEMO / "joint.toml")]
    improved: list[Improvement] = []

    def whole() -> dict[str, Any]:
        improved.append(improve(train, joint, [held], max_additions=1))
        return improved[0].as_json()

    first = said(whole)
    printed: list[str] = []

    def python() -> dict[str, Any]:
        found = diagnose(fit(joint, train), held)
        printed.append(str(found))
        return found.as_json()

    answers = {
        "diagnose": said(python),
        "irj diagnose": command(folder, capsys, "diagnose", paths[0], *given),
        "irj improve": command(folder, capsys, "improve", paths[0], *given, "--max-steps", "1"),
    }

    analyses: list[Analysis] = []

    def page() -> dict[str, Any]:
        analyses.append(Analysis(joint, [train], [held]))
        analyses[0].fit_start()
        return analyses[0].diagnose(quiet)

    answers["page"] = said(page)
    for door, found in answers.items():
        assert found == first, door
    if isinstance(first, Answer):
        assert first.outcome in OUTCOMES
        if first.outcome == "complete" or first.verdict in ("complete", "nothing_missing"):
            assert all(r <= RATIO_LIMIT for _, r in first.ratios)
        assert first.reason in printed[0]
        if first.verdict != "nothing_missing":
            assert "nothing is missing" not in printed[0]
            assert "nothing significant is missing" not in printed[0]
        start = improved[0].steps[0].held_out.as_json()
        compared = compare(fit(joint, train), held, linear=False).error.as_json()
        for shown in (compared, analyses[0].compare()["error"]):
            assert figures(shown) == pytest.approx(figures(start), rel=1e-9)
        assert reported(analyses[0], first) == (first.verdict, first.claims)
    return first


def figures(error: dict[str, Any]) -> dict[str, float]:
    """The error of a state on held-out records, as every door prints it."""
    ratios = {f"{b} ratio": float(e["ratio"]) for b, e in error["balances"].items()}
    return {"percent": float(error["relative_error_percent"]), **ratios}


def quiet(_text: str, _share: float) -> None:
    """Progress that nobody sees."""


def reported(analysis: Analysis, first: Answer) -> tuple[str, tuple[tuple[str, ...], ...]]:
    """Verdict and claims of the page's report, the claim added by hand."""
    wanted = first.claims[0][0] if first.claims else ""
    label = next((name for name, t in analysis.trials.items() if t.key == wanted), None)
    entries = [analysis.fit_start()]
    if label is not None:
        added = analysis.settle(analysis.add(label))
        entries.append(replace(added, names=first.claims[0]))
    found = improvement_of(analysis, entries, quiet)
    return found.verdict, tuple(c.effects for c in found.claims)


def continuous(record: Record, rows: Any) -> Record:
    """Some rows of a record as a record of its own, one segment."""
    channels = {c: v[rows] for c, v in record.channels.items()}
    return Record.from_channels(record.time[rows], channels, name=record.name)


def changed(record: Record, **channels: Any) -> Record:
    for channel, values in channels.items():
        record = record.with_channel(channel, values)
    return record


def one_way(record: Record) -> Record:
    """The longest stretch in which the motor does not turn back."""
    speed = np.convolve(
        np.gradient(record["motor_position"], record.time), np.ones(41) / 41, "same"
    )
    sign = np.sign(np.where(np.abs(speed) > 0.05 * np.max(np.abs(speed)), speed, 0.0))
    cuts = np.flatnonzero(np.diff(sign)) + 1
    pieces = [p for p in np.split(np.arange(len(speed)), cuts) if sign[p[0]] != 0]
    return continuous(record, max(pieces, key=len))


@pytest.fixture
def own_effects(tmp_path: Path) -> Iterator[tuple[str, ...]]:
    """Three user effects in the library, taken out again: one that is hardly told from Stribeck,
    two where nothing is hidden.
    """
    path = tmp_path / "own.py"
    path.write_text(OWN)
    keys = EFFECTS.load(path)
    assert len(keys) == 3
    yield keys
    path.write_text("")
    EFFECTS.load(path)
    assert not any(k in EFFECTS for k in keys)


def test_a_hidden_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train, held = (
        continuous(r, slice(0, None, 2))
        for r in (read(DEMO / "train.npz"), read(DEMO / "held_out.npz"))
    )
    found = doors(train, held, tmp_path, capsys)
    assert isinstance(found, Answer)
    assert found.claims[0][0] == "stribeck"
    assert found.outcome in ("found", "set")


def test_a_motor_that_never_reverses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train, held = read(DEMO / "train.npz"), read(DEMO / "held_out.npz")
    found = doors(one_way(train), continuous(held, slice(0, None, 2)), tmp_path, capsys)
    text = found if isinstance(found, str) else found.reason
    assert "revers" in text
    if isinstance(found, Answer):
        assert found.outcome == "not_identifiable"
        assert found.claims == ()


def test_records_in_unlike_units(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train, held = (
        continuous(r, slice(0, None, 2))
        for r in (read(DEMO / "train.npz"), read(DEMO / "held_out.npz"))
    )
    degrees = changed(held, **{c: np.rad2deg(held[c]) for c in ANGLES})
    found = doors(train, degrees, tmp_path, capsys)
    assert isinstance(found, str)
    assert "are its positions in degrees?" in found
    with pytest.raises(InputError, match="are its positions in degrees"):
        compare(fit(load_joint(DEMO / "joint.toml"), train), degrees)


def test_repaired_records_and_refused_ones_with_three_effects_of_the_user(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], own_effects: tuple[str, ...]
) -> None:
    train, held = (
        continuous(r, slice(0, None, 8))
        for r in (read(DEMO / "train.npz"), read(DEMO / "held_out.npz"))
    )
    current = train["motor_current"].copy()
    current[[150, 151, 450, 451, 452, 453, 454]] = np.nan
    gone = np.ones(len(train), dtype=bool)
    gone[600:675] = False
    holed = continuous(changed(train, motor_current=current), gone)
    found = doors(holed, held, tmp_path, capsys)
    assert isinstance(found, Answer)
    assert sum("not a number" in w or "gap(s)" in w for w in found.warnings) == 2
    named = {key for names in found.claims for key in names}
    assert set(own_effects) <= named | found.refused, "each is named or refused with a reason"
    assert set(own_effects) & named and set(own_effects) & found.refused, "both occur"
    backwards = Record.from_channels(train.time[::-1], dict(train.channels), name=train.name)
    refused = doors(backwards, held, tmp_path, capsys)
    assert isinstance(refused, str)
    joint = load_joint(DEMO / "joint.toml")
    for record, code in ((holed, 0), (backwards, 1)):
        assert (
            main(["check", str(written(tmp_path, record)), "--joint", str(DEMO / "joint.toml")])
            == code
        )
    for verb in (lambda: fit(joint, backwards), lambda: compare(fit(joint, train), backwards)):
        with pytest.raises(InputError) as caught:
            verb()
        assert "\n" not in str(caught.value)


def test_a_record_is_checked_once_and_anew_where_it_was_changed() -> None:
    joint = load_joint(DEMO / "joint.toml")
    record = read(DEMO / "train.npz", joint=joint)
    mark = record.provenance.checked
    assert mark is not None
    assert record.window(1.0, 3.0).provenance.checked is mark
    assert fit(joint, record).records[0] is record
    assert record.with_channel("motor_current", -record["motor_current"]).provenance.checked is None
    other = replace(joint, gear_ratio=150.0)
    with pytest.raises(InputError, match="gear ratio"):
        fit(other, record)
    linear = replace(joint, kind="linear")
    assert inspected(record, linear)[0] == Finding(
        "refuse", "kind", inspected(record, linear)[0].message
    )
    with pytest.raises(InputError, match=r"^train: was read as a rotary axis, the joint is linear"):
        improve(record, linear)


def test_every_effect_has_an_answer_to_why_and_results_print_on_a_screen() -> None:
    joint, train, held = (
        load_joint(DEMO / "joint.toml"),
        read(DEMO / "train.npz"),
        read(DEMO / "held_out.npz"),
    )
    first = fit(joint, train)
    found = diagnose(first, held)
    named = {k for c in found.claims for k in c.effects}
    for key, effect in EFFECTS.items():
        sentence = found.why(key)
        assert sentence.startswith(effect.title), key
        assert sentence.endswith("."), key
        assert (" is named" in sentence or " is in a set" in sentence) == (key in named), key
    assert not named & {r.effect for r in found.refused}
    assert all(r.why for r in found.refused)
    with pytest.raises(InputError, match="unknown effect"):
        found.why("no_such_thing")
    results = (
        first,
        found,
        found.found,
        first.model,
        compare(first, held, linear=False),
        first.data,
        first.solution,
        found.ranking,
        found.ranking.trials[0],
        train,
    )
    for result in results:
        assert len(str(result).splitlines()) <= 25, type(result)
        assert len(repr(result)) < 1000, type(result)
    assert found.reason in str(found)


def test_records_that_do_not_show_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train, held = (
        continuous(r, slice(0, None, 4))
        for r in (read(DEMO / "train.npz"), read(DEMO / "held_out.npz"))
    )
    found = doors(train, held.without("link_torque"), tmp_path, capsys)
    assert isinstance(found, str)
    assert "held_out: has no link_torque, which train has" in found


@pytest.mark.slow
def test_one_speed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A triangle: some laws cannot be told apart, and every door says which."""
    joint = load_joint(DEMO / "joint.toml")
    for name in ("train", "held_out"):
        arguments = ["--motion", "triangle", "--hide", "stribeck", "--seed", str(len(name))]
        path = tmp_path / f"{name}_.csv"
        assert (
            main(["simulate", "--joint", str(DEMO / "joint.toml"), *arguments, "-o", str(path)])
            == 0
        )
    train, held = (
        replace(read(tmp_path / f"{name}_.csv", joint=joint), name=name)
        for name in ("train", "held_out")
    )
    known = [c for c in HEADERS if train.has(c)]
    train, held = (
        Record.from_channels(r.time, {c: r[c] for c in known}, name=r.name) for r in (train, held)
    )
    found = doors(train, held, tmp_path, capsys)
    assert isinstance(found, Answer)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared recordings")
@pytest.mark.parametrize("case", ["none", "stribeck", "cubic_stiffness", "kinematic_error"])
def test_the_recorded_joints(case: str) -> None:
    joint = load_joint(SHARED / case / "joint.toml")
    train = [read(SHARED / case / f"train{i}.csv", joint=joint) for i in ("", "2")]
    held = [read(SHARED / case / f"test{i}.csv", joint=joint) for i in ("", "2")]
    loop = improve(train, joint, held)
    found = diagnose(fit(joint, train), held)
    assert [c.effects for c in found.claims] == [c.effects for c in loop.decided[:1]]
    assert found.warnings == loop.warnings
    analysis = Analysis(joint, train, held)
    analysis.fit_start()
    shown = analysis.diagnose(quiet)
    if analysis.whole:
        assert answer(shown) == answer(found.as_json())
    assert found.outcome == shown["outcome"] == ("complete" if case == "none" else "found")
