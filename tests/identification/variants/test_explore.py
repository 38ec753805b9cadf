"""`explore`: the true structure among all variants, and what the screen says against the fits."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification import Exploration, InputError, explore, load_joint, read
from identification.diagnosis.session import Session
from identification.diagnosis.trials import Trial, try_candidate
from identification.variants.choice import (
    Judged,
    exchanged,
    front_of,
    score_of,
    tied_with_best,
)
from identification.variants.exploration import sets_of_ties, table_of
from identification.variants.explore import Search
from identification.variants.ground import JointGround
from identification.variants.lattice import assembled, nodes_of, price_of, together
from identification.variants.refit import Weighting, held_of, refitted
from identification.variants.screen import Screen
from tests.hidden_effect.generator import generate_case
from tests.recorded_world.world import make_case, write_case
from workbench.cli.main import main
from workbench.show.front import exploration_picture, exploration_section

DEMO = Path(str(files("workbench"))) / "demo"
SHARE = 0.2
HIDDEN = "stribeck"
"""What the demo's records hide."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the results of one run of the command on the demo's records."""
    folder = tmp_path_factory.mktemp("explored")
    given = [str(DEMO / "train.npz"), "--held-out", str(DEMO / "held_out.npz")]
    with (folder / "out.txt").open("w") as out, pytest.MonkeyPatch.context() as patched:
        patched.setattr("sys.stdout", out)
        code = main(
            [
                *("explore", *given, "--joint", str(DEMO / "joint.toml")),
                *("--json", str(folder / "found.json"), "--out", str(folder / "all")),
                *("-o", str(folder / "better.toml"), "--report", str(folder / "report.html")),
            ]
        )
    assert code == 0
    return folder


@cache
def session() -> Session:
    joint = load_joint(DEMO / "joint.toml")
    return Session.opened(read(DEMO / "train.npz"), joint, [read(DEMO / "held_out.npz")])


def explored(hidden: Any, seed: int, folder: Path) -> Exploration:
    case = generate_case(hidden, seed, folder=folder)
    return explore(
        read(case / "train.csv"), load_joint(case / "joint.toml"), read(case / "test.csv")
    )


# --- the answer -----------------------------------------------------------------------------------


def test_what_the_demo_hides_is_recommended_alone_and_improve_agrees(demo: Path) -> None:
    found = json.loads((demo / "found.json").read_text())
    assert [label.partition("@")[0] for label in found["added"]] == [HIDDEN]
    assert found["ties"] == [found["recommended"]]
    assert found["recommended"] in found["pareto"]
    assert found["improve"]["labels"] == found["recommended"]
    assert "the same" in found["agreement"]
    assert found["screened"] > 1000
    best = found["variants"][0]
    assert best["labels"] == found["recommended"]
    assert best["tied"] and best["score"] == 0
    start = next(v for v in found["variants"] if not v["added"] and not v["dropped"])
    assert best["held_out"]["relative_error_percent"] < (
        0.5 * start["held_out"]["relative_error_percent"]
    )
    assert best["parameters"] == start["parameters"] + 3


def test_every_model_by_name_is_a_variant_or_said_to_be_none(demo: Path) -> None:
    found = json.loads((demo / "found.json").read_text())
    names = {v["name"] for v in found["variants"]} | {n["model"] for n in found["not_compared"]}
    assert {"hd1", "hd4", "irj1a", "irj1b", "irj2a", "irj2b", "irj_ts"} <= names
    rigid = next(v for v in found["variants"] if v["name"] == "hd1")
    assert rigid["held_out"]["of_start_percent"] > 300  # the demo's gear twists


def test_the_front_holds_what_has_every_effect_of_the_joint(demo: Path) -> None:
    """A variant without one of them has a parameter less for the same error, and no one asked."""
    found = json.loads((demo / "found.json").read_text())
    own = next(v for v in found["variants"] if not v["added"] and not v["dropped"])
    assert own["labels"] in found["pareto"]
    assert all(set(own["labels"]) <= set(labels) for labels in found["pareto"])


@pytest.mark.slow
def test_which_law_it_is_whole_fits_tell_and_not_the_price_of_its_parameters(
    tmp_path: Path,
) -> None:
    """Two knots and two steps take 8 % off what a soft wind-up with half the parameters leaves,
    and that for certain.
    """
    folder = write_case(make_case(81018, kind="single", size=1.0), tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    train, held = (read(folder / f"{name}.csv", joint=joint) for name in ("train", "test"))
    found = explore(train, joint, held)
    assert found.recommended.added == ("piecewise_stiffness",)
    assert found.variants[0] is found.recommended and found.recommended.score == 0
    (behind,) = [v for v in found.variants if v.added == ("soft_windup",) and not v.dropped]
    assert behind.score < 0 and not behind.tied and behind not in found.front
    assert "nats behind piecewise" in behind.behind
    assert behind.behind in "\n".join(table_of(found))


@pytest.mark.slow
def test_both_of_two_hidden_effects_are_recommended(tmp_path: Path) -> None:
    found = explored(("cubic_stiffness", "cyclic_friction"), 8101, tmp_path / "pair")
    assert {"cubic_stiffness", "cyclic_friction"} <= set(found.recommended.effects)
    assert found.recommended in found.front
    assert len(found.ties) <= 3


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Exploration:
    """Of records that hide nothing."""
    return explored(None, 8102, tmp_path_factory.mktemp("clean") / "none")


def test_where_nothing_is_hidden_the_joint_as_it_stands_is_recommended_or_tied(
    clean: Exploration,
) -> None:
    found = clean
    assert found.start.tied
    assert len(repr(found).splitlines()) <= 25
    assert max(len(line) for line in repr(found).splitlines()[:-2]) <= 100
    root = ET.fromstring(exploration_picture(found))
    words = " ".join(t.text or "" for t in root.iter("{http://www.w3.org/2000/svg}text"))
    assert "start model" in words


# --- the screen against other ways to the same number ---------------------------------------------


def test_a_screened_score_is_that_of_the_trial_of_a_diagnosis() -> None:
    """The same squares by another way: base and candidate solved together, fold by fold."""
    base = session().bench.base(session().start())
    nodes, _ = nodes_of(base.solution.model, base.data)
    own = [n for n in nodes if not n.beside and not n.candidate.shapes][:12]
    screen = Screen(base, own, {})
    compared = 0
    for k, option in enumerate(screen.options):
        node = screen.nodes[option.node]
        trial = try_candidate(node.candidate, base)
        if isinstance(trial, Trial):
            score = float(np.log(trial.rms).sum()) + node.price
            assert float(screen.scores([(k,)])[0]) == pytest.approx(score, abs=2e-3), node.label
            compared += 1
    assert compared >= 4


def test_a_variant_is_within_one_percent_of_its_converged_fit() -> None:
    solution = session().start()
    base = session().bench.base(solution)
    data = session().data
    nodes = [n for n in nodes_of(base.solution.model, data)[0] if n.candidate.place == "motor"]
    screen = Screen(base, nodes, {})
    weighting = Weighting.of(solution, data)
    ranked = [s for s in screen.search(2) if s.options][:4]
    for scored in ranked:
        model = assembled(solution.model, screen.parts(scored.options))
        assert model is not None
        start = (screen.start_of(scored.options),)
        few = refitted(model, data, start, weighting)
        many = refitted(model, data, start, weighting, steps=40)
        np.testing.assert_allclose(few.held.rms, many.held.rms, rtol=0.01)


def test_a_law_that_only_scales_a_balance_gains_nothing() -> None:
    """Friction that takes .8 of the load, and a fifth of all else, shorten the link balance."""
    data, start = session().data, session().start()
    model = start.model
    for label in ("load_dependent_friction@link", "load_dependent_presliding@link"):
        model = model.add(label)
    own = {n for t in start.model.terms if t.place == "link" for n in t.names}
    of_link = (own | {"link_inertia"}) - set(model.named("smoothing"))
    values = {
        **{p.name: p.start if p.is_shape else 0.0 for p in model.parameters},
        **start.values,
        **{n: SHARE * start.values[n] for n in of_link},
        "link_load_friction_difference": 1 - SHARE,
        "link_load_presliding_distance": 1e-6,
    }
    shorter = replace(start, model=model.with_values(values), values=values)
    weighting = Weighting.of(start, data)
    plain, found = (held_of(s, data, weighting) for s in (start, shorter))
    at, units = data.sensing.balances.index("link"), weighting.units(shorter, data)
    assert all(np.allclose(x, 1.0) for x in weighting.units(start, data).values())
    assert float(np.median(units["link"])) == pytest.approx(SHARE, rel=0.02)
    assert all(np.allclose(x, 1.0) for b, x in units.items() if b != "link")
    assert found.relative_error_percent < plain.relative_error_percent
    assert found.rms[at] > plain.rms[at]


def test_a_variant_in_a_worse_valley_is_fitted_again_from_the_best() -> None:
    """A gain that is none led the fit of two true parts out of their valley, and was recommended
    with them.
    """
    found, start = session(), session().start()
    ground = JointGround(found, read(DEMO / "train.npz"))
    search = Search(ground, start, lambda text, share: None)
    true = start.model.add(f"{HIDDEN}@motor")
    search._fit(start.model, start.values)
    search._fit(true, start.values)
    good = search._best()
    search._fit(true.add("cubic_viscous@motor"), good.solution.values)
    mark = search._mark(true)
    search.found[mark] = replace(good, cost=9 * good.cost, squares=9 * good.squares)
    assert search._best() is not search.found[mark]
    search._neighbours()
    assert search.found[mark].cost == pytest.approx(good.cost, rel=0.02)
    assert search._best() is search.found[mark]


def test_a_name_is_shown_in_the_valley_that_whole_fits_found() -> None:
    """They begin at every point of its grid; what was fitted before had stayed where it was."""
    found, start = session(), session().start()
    search = Search(JointGround(found, read(DEMO / "train.npz")), start, lambda text, share: None)
    true = start.model.add(f"{HIDDEN}@motor")
    search._fit(start.model, start.values)
    search._fit(true, start.values)
    mark = search._mark(true)
    good = search.found[mark]
    search.found[mark] = replace(good, cost=9 * good.cost)
    search._named()
    assert search.found[mark].cost == pytest.approx(good.cost, rel=0.02)


def test_what_may_be_told_as_a_tie_is_fitted_whatever_its_price() -> None:
    """A piecewise stiffness that takes 11 % off a balance was never fitted: its four parameters
    cost 25 %.
    """
    found, least = session(), 1e-4
    true = found.start().model.add(f"{HIDDEN}@motor")
    base = found.bench.base(found.bench.fitted(true, found.start().values))
    screen = Screen(base, [n for n in nodes_of(true, base.data)[0] if not n.beside], {})
    ranked = screen.search(1)
    nothing = next(s.score for s in ranked if not s.options)
    told = screen.lowering(ranked, least)
    assert told and min(s.score for s in told) > nothing  # by their price all of them are nothing
    for scored in told:
        (node,) = screen.parts(scored.options)
        assert nothing - (scored.score - node.price) >= least
        grid = screen.grid_of(scored)
        assert scored.options in grid
        assert {screen.parts(v)[0].label for v in grid} == {node.label}


def test_parts_that_do_not_go_together_are_never_in_one_variant() -> None:
    base = session().bench.base(session().start())
    nodes, _ = nodes_of(base.solution.model, base.data)
    late = next(n for n in nodes if n.beside)
    parent = next(n for n in nodes if n.label == late.beside)
    assert not together([late])
    assert together([parent, late])
    assert assembled(base.solution.model, [late]) is None
    assert assembled(base.solution.model, [late, parent]) is not None
    assert not together([parent, parent])


def test_front_holds_what_no_variant_with_as_few_parameters_beats() -> None:
    assert front_of([5, 6, 6, 7, 8], [10.0, 4.0, 3.0, 2.99, 1.0]) == [0, 2, 4]
    # as good with as many parameters: side by side
    assert front_of([5, 6, 6, 7], [10.0, 3.0, 3.01, 4.0]) == [0, 1, 2]


def test_a_tie_is_close_or_uncertain_and_never_another_tie_with_more_parts() -> None:
    score = np.array([1.0, 1.04, 1.3, 1.3, 1.02, 0.9])
    behind = np.array([0.0, 0.01, -0.1, 0.2, -0.1, -0.3])
    scores = Judged(0, score - 1.0, score, behind, np.zeros(6), (), most=np.ones(6))
    parts = [frozenset(p) for p in ("a", "b", "c", "d", "ae", "")]
    whole = [True] * 5 + [False]  # the last lacks an effect of the joint's own model
    assert tied_with_best(scores, whole, parts) == [True, True, True, False, False, False]
    # one with parameters fewer whose error is 13 % higher: only its price makes it look alike
    error = score - np.array([1.0, 0.9, 1.0, 1.0, 1.0, 1.0])
    cheaper = Judged(0, error, score, behind, np.zeros(6), (), most=np.ones(6))
    assert tied_with_best(cheaper, whole, parts) == [True, False, True, False, False, False]
    # whole fits leave d for the place of a: its price is no reason to prefer a
    sets = {"a": frozenset("ad")}
    assert tied_with_best(scores, whole, parts, sets) == [True, True, True, True, False, False]


def test_what_only_the_price_holds_back_is_a_tie() -> None:
    """Quadratic drag took 9.4 % off a balance, 33 nats, and nothing said that it may be there."""
    price = np.array([1.0, 1.1, 1.1, 1.1, 1.2, 1.2, 1.25, 1.2])
    error = np.array([0.0, -0.094, -0.03, -0.08, -0.1, -0.16, -0.17, -0.09])
    score = error + price
    most = np.array([0.0, -0.08, -0.02, 0.01, -0.08, -0.1, -0.1, -0.08])
    scores = Judged(0, error, score, score - score[0], np.zeros(8), (), most=most)
    parts = [frozenset(p) for p in ("a", "ab", "ac", "ad", "abe", "abf", "ag", "ah")]
    # c is too small, d is not certain, e brings hardly anything beside b; f does, and g alone; h
    # does no more than b, with more parameters
    wanted = [True, True, False, False, False, True, True, False]
    assert tied_with_best(scores, [True] * 8, parts) == wanted


def test_a_variant_is_in_the_sets_of_another_name_for_name() -> None:
    sets = {"a": frozenset("ac"), "b": frozenset("bd")}
    best = frozenset("abx")
    for other, yes in (
        ("cbx", True),
        ("adx", True),
        ("cdx", True),
        ("abx", False),  # itself
        ("ccx", False),  # two parts for three
        ("cax", False),  # c in the place of b
        ("abd", False),
        ("abxd", False),  # one part more
    ):
        assert exchanged(best, frozenset(other), sets) == yes, other


def test_every_record_and_part_of_them_has_its_best(demo: Path) -> None:
    found = json.loads((demo / "found.json").read_text())
    told = found["stability"]
    names = {v["name"] for v in found["variants"]}
    assert [r["record"] for r in told["records"]] == ["train", "held_out"]
    assert {r["best"] for r in told["records"]} | set(told["windows"]) <= names
    assert sum(v["chosen_percent"] for v in found["variants"]) == pytest.approx(100)


def test_an_effect_costs_ten_percent_of_one_balance_and_each_further_parameter_half_of_it() -> None:
    """A law with five parameters that takes 29 % off a balance was not recommended at ten percent
    for each.
    """
    assert price_of(1, 1) == pytest.approx(0.1)
    assert price_of(2, 6) == pytest.approx(price_of(1, 5) + price_of(1, 1)) == pytest.approx(0.4)
    rows = np.array([10.0, 10.0])
    plain = score_of(np.array([10.0, 10.0]), rows, np.array(price_of(3, 3)))
    better = score_of(np.array([10.0 * math.exp(-0.2), 10.0]), rows, np.array(price_of(4, 4)))
    assert float(better) == pytest.approx(float(plain))


# --- the command ----------------------------------------------------------------------------------


def test_table_fits_a_terminal_and_says_what_json_says(demo: Path) -> None:
    text = (demo / "out.txt").read_text()
    found = json.loads((demo / "found.json").read_text())
    rows = [line for line in text.splitlines() if line.startswith(("*", "=", " "))]
    assert rows and max(len(line) for line in rows) <= 100
    best = next(line for line in rows if line.startswith("*i"))
    assert f"{found['variants'][0]['held_out']['relative_error_percent']:.3f}" in best
    assert found["reason"] in text
    assert found["agreement"] in text


def test_parquet_holds_every_variant(demo: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(demo / "all" / "variants.parquet").to_pylist()
    found = json.loads((demo / "found.json").read_text())
    assert [r["labels"] for r in rows] == [v["labels"] for v in found["variants"]]
    assert [r["relative_error_percent"] for r in rows] == [
        v["held_out"]["relative_error_percent"] for v in found["variants"]
    ]


def test_picture_names_the_recommended_variant(demo: Path) -> None:
    root = ET.fromstring((demo / "all" / "explore.svg").read_text())
    words = " ".join(t.text or "" for t in root.iter("{http://www.w3.org/2000/svg}text"))
    assert HIDDEN in words
    assert "(recommended, improve)" in words


def test_the_report_has_a_section_of_the_variants(demo: Path) -> None:
    page = (demo / "report.html").read_text()
    section = page.split('<section id="variants"')[1].split("</section>")[0]
    found = json.loads((demo / "found.json").read_text())
    best = next(v for v in found["variants"] if v["labels"] == found["recommended"])
    assert f"<td>{best['parameters']}</td>" in section
    assert "recommended, improve" in section
    assert "<svg" in section
    assert "free parameters" in section


def test_joint_file_of_the_recommended_variant_is_a_joint_file(demo: Path) -> None:
    better = load_joint(demo / "better.toml")
    assert any(label.partition("@")[0] == HIDDEN for label in better.effects)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["no.npz", "--joint", "joint.toml"], "no.npz"),
        (["train.npz", "--joint", "no.toml"], "no.toml"),
        (["train.npz", "--held-out", "train.npz", "--joint", "joint.toml"], "one role only"),
        (["train.npz", "--joint", "joint.toml", "--out", "joint.toml"], "is a file"),
        (["train.npz", "--joint", "joint.toml", "--picture", "train.npz"], "input"),
        (["train.npz", "--joint", "joint.toml", "-o", "joint.toml"], "input"),
    ],
)
def test_unusable_input_is_one_line(
    arguments: list[str],
    says: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(DEMO)
    assert main(["explore", *arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and says in lines[0]


def test_records_that_cannot_carry_the_question_are_refused_in_a_sentence() -> None:
    record = read(DEMO / "train.npz")
    joint = load_joint(DEMO / "joint.toml")
    with pytest.raises(InputError):
        explore(record.window(0.0, 0.4), joint)


def test_ties_of_two_sets_are_told_as_sets() -> None:
    """Two places with two names each are four variants: a reader has two questions, not four
    models.
    """
    a, b, c, d, e = "stribeck@motor", "lugre@motor", "added_spring@link", "gravity", "backlash"
    four = {frozenset(x) for x in ((a, c), (a, d), (b, c), (b, d))}
    assert sets_of_ties((a, c), four) == ((a, b), (c, d))
    assert sets_of_ties((a, c), four | {frozenset({a})}) == ((a, b), (c, d))
    assert sets_of_ties((a, c), four - {frozenset({b, d})}) == ()  # not every choice
    assert sets_of_ties((a, c), {frozenset({a, c}), frozenset({b, c})}) == ()  # one question
    beside = {x | {e} for x in four}
    assert sets_of_ties((a, c, e), beside) == ((a, b), (c, d), (e,))


def test_the_sentence_of_two_sets_is_the_same_at_every_door(clean: Exploration) -> None:
    start = clean.start
    names = (("quadratic_drag@motor", "cubic_viscous@motor"), ("added_spring@link", "gravity"))
    made = [
        replace(start, added=(one, two), tied=True, name=f"+ {one} + {two}")
        for one in names[0]
        for two in names[1]
    ]
    told = replace(clean, recommended=made[0], ties=tuple(made), variants=(*made, start))
    said = "any other choice of one of (quadratic drag (motor), cubic viscous friction (motor))"
    assert (
        said in told.reason and " and one of (additional spring to ground (link), " in told.reason
    )
    assert told.reason.count("cubic viscous") == 1
    assert told.reason in "\n".join(table_of(told))
    assert told.as_json()["reason"] == told.reason
    assert f"Tied: {told.alike}" in exploration_section(told)
    alone = replace(told, ties=(made[0],))
    assert alone.alike == "" and "nothing else that was fitted ties" in alone.reason
    two = replace(told, ties=(made[0], made[2]))
    assert two.alike == "with cubic viscous friction (motor) and additional spring to ground (link)"
