"""A name is held against the curve of its own variable; where none does, the curve is the
answer and an effect like any other.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from smooth_laws import (
    COULOMB,
    LAWS,
    FloatArray,
    Law,
    Run,
    at_one_speed,
    nothing,
    record,
    run,
    settling,
)

from casadi_models import EFFECTS
from identification.data.joint_file import Joint, load_joint
from identification.data.read import read
from identification.diagnosis.candidates import Candidate
from identification.diagnosis.claims import Claim
from identification.diagnosis.curve import curves_on, lacking, squares_left, steadily_moving
from identification.diagnosis.improve import RATIO_LIMIT, Improvement, improve
from identification.diagnosis.learned import (
    BY_CHANCE,
    AtBound,
    Equivalence,
    artefacts,
    equivalence,
    equivalences,
    learned_claims,
    variable_of,
    with_curves,
)
from identification.diagnosis.trials import make_base
from identification.fitting.assess import assess
from identification.fitting.engine import load_dataset, prepared_model, solve
from tests.recorded_world.world import make_case, write_case
from tests.smooth_campaign import run as answer_to
from workbench.cli.main import main

NAMES: dict[str, Law] = {
    "stribeck": lambda q, v: 8 * np.exp(-((v / 0.1) ** 2)) * np.sign(v),
    "quadratic_drag": lambda q, v: 3 * v * np.abs(v),
    "added_spring": lambda q, v: 10 * q,
}
WRONG = {"quadratic_drag": "tanh", "added_spring": "bump", "cubic_viscous": "root"}


def held_against(key: str, law: Law, seed: int) -> Equivalence:
    found = run(seed, law, ("viscous", "coulomb", f"{key}@motor"))
    answer = equivalence(Claim((key,), f"{key}@motor", "axis", 0.0), found.solution, found.data)
    assert answer is not None
    return answer


@pytest.mark.parametrize("key", NAMES)
def test_a_true_name_misses_nothing(key: str) -> None:
    answer = held_against(key, NAMES[key], 31)
    assert answer.is_name
    assert "like" not in answer.sentence
    assert answer.share_missed < 0.006


@pytest.mark.parametrize("key", WRONG)
def test_a_wrong_name_misses_more_than_it_may(key: str) -> None:
    answer = held_against(key, LAWS[WRONG[key]][1], 32)
    assert not answer.is_name
    assert answer.share_missed > 0.05
    assert answer.sentence.startswith(("not ", "like "))
    assert set(answer.as_json()) == {"share_missed", "stderr", "sentence"}


# where friction grows with a power of the speed, or saturates, beside viscous and dry friction
IMITATED: dict[str, tuple[Law, tuple[str, ...]]] = {
    "power": (lambda q, v: 8 * np.abs(v) ** 1.44 * np.sign(v), ("stribeck",)),
    "saturating": (lambda q, v: 6 * np.tanh(v), ("quadratic_drag", "cubic_viscous")),
}


@pytest.mark.parametrize("law", IMITATED)
def test_names_are_no_more_than_alike_where_a_law_of_one_term_does_as_well(law: str) -> None:
    """Names with three numbers, and sums of names, imitate them to .3 % of what they explain."""
    torque, keys = IMITATED[law]
    labels = tuple(f"{k}@motor" for k in keys)
    found = run(39, torque, ("viscous", "coulomb", *labels))
    claims = [Claim((k,), f"{k}@motor", "axis", 0.0) for k in keys]
    answers = equivalences(claims, found.solution, found.data)
    assert set(answers) == set(labels)
    for a in answers.values():
        assert a.share_missed < 0.01
        assert a.beaten
        assert not a.is_name
        assert "like" in a.sentence


def test_a_name_is_no_more_than_alike_where_the_curve_of_its_own_variable_is_better() -> None:
    """A knee at 0.9 rad/s: Stribeck friction misses .3 % of it, by 2.7 errors. That is less than
    what a curve must gain among a dozen variables, and more than what chance does to one.
    """
    rng = np.random.default_rng([100344, 9])

    def knee(q: FloatArray, v: FloatArray) -> FloatArray:
        return 2.4 * np.logaddexp(0.0, (np.abs(v) - 0.9) / 0.2) * np.sign(v)

    train, held = record(rng, 40, knee), record(rng, 20, knee)
    effects = ("viscous", "coulomb", "stribeck@motor")
    joint = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=effects)
    model = prepared_model(joint, train)
    data = load_dataset([train], [held], joint, model)
    claim = Claim(("stribeck",), "stribeck@motor", "axis", 0.0)
    answer = equivalence(claim, solve(model, data), data)
    assert answer is not None
    assert answer.share_missed < 0.01
    assert answer.curve is None
    assert not answer.is_name
    assert answer.sentence.startswith("like Stribeck effect")


def test_a_sum_that_no_single_term_replaces_keeps_its_names() -> None:
    both = ("stribeck", "cubic_viscous")
    found = run(
        40,
        lambda q, v: 8 * np.exp(-((v / 0.1) ** 2)) * np.sign(v) + v**3,
        ("viscous", "coulomb", *(f"{k}@motor" for k in both)),
    )
    claims = [Claim((k,), f"{k}@motor", "axis", 0.0) for k in both]
    assert all(a.is_name for a in equivalences(claims, found.solution, found.data).values())


def test_dry_friction_that_a_name_pushed_away_is_not_what_the_name_explains() -> None:
    """Without the name dry friction comes back; else a name that takes its place explains nearly
    everything, whatever the law is.
    """
    found = run(39, IMITATED["power"][0], ("viscous", "coulomb", "stribeck@motor"))
    assert "motor_coulomb" in found.solution.at_bound
    named = steadily_moving(make_base(found.solution, found.data))
    bare = lacking(named, {"stribeck@motor"})
    assert "motor_coulomb" in bare.names
    plain = run(39, IMITATED["power"][0])
    alone = steadily_moving(make_base(plain.solution, plain.data))
    left = [squares_left(b, "axis").sum() / np.median(b.weight) ** 2 for b in (bare, alone)]
    assert left[0] == pytest.approx(left[1], rel=0.25)


@pytest.fixture(scope="module")
def snag() -> Run:
    return run(33, LAWS["snag"][1])


def test_dry_friction_outside_the_curve_is_an_artefact() -> None:
    """tanh(v/0.15) beside Coulomb friction: the fit without it puts half of it into Coulomb
    friction.
    """
    found = run(34, LAWS["tanh"][1])
    reasons = artefacts(found.solution, found.data, found.found.curves)
    assert len(reasons) == 1
    assert reasons[0].place == "motor"
    assert "artefact" in reasons[0].sentence


def test_an_amplitude_held_at_its_bound_is_told() -> None:
    found = run(35, lambda q, v: 9 * np.tanh(v / 0.15), ("viscous", "coulomb", "stribeck@motor"))
    reasons = artefacts(found.solution, found.data)
    assert any("stands at its bound" in r.sentence for r in reasons)


def test_a_bound_that_is_hardly_come_to_by_chance_is_suspicious() -> None:
    """True values anywhere from 0 to 1, told with an error of .1 and of .2: how many of them come
    to their bound at 0 is what the rule is about.
    """
    rng = np.random.default_rng(8)
    told = rng.uniform(0, 1, 100_000) + np.array([[0.1], [0.2]]) * rng.standard_normal(100_000)
    few, many = np.mean(told < 0, axis=1)
    assert few < BY_CHANCE < many
    assert AtBound(wanted=0.0, error=0.1, room=5.0).suspicious(1.0)
    assert not AtBound(wanted=0.0, error=0.2, room=5.0).suspicious(1.0)


def test_a_step_past_a_bound_counts_as_far_as_there_is_torque() -> None:
    assert AtBound(wanted=-4.0, error=1.0, room=5.0).beyond == pytest.approx(4.0)
    assert AtBound(wanted=0.5, error=1.0, room=5.0).beyond == 0.0
    # 12 of 16 squares are gained up to half the way
    assert AtBound(wanted=-4.0, error=1.0, room=2.0).beyond ** 2 == pytest.approx(12.0)
    assert AtBound(wanted=-400.0, error=100.0, room=2.0).beyond < 1.0


def without_coulomb(q: FloatArray, v: FloatArray) -> FloatArray:
    """Stribeck friction that ends in nothing: viscous friction is all there is at speed."""
    return 15 * np.exp(-((v / 0.5) ** 2)) * np.sign(v) - COULOMB * np.tanh(v / 2e-3)


def test_at_one_speed_an_addition_may_send_dry_friction_to_its_bound() -> None:
    """Before it, Coulomb friction does its work; after it, nothing tells how much there is."""
    ended = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        train, held = (at_one_speed(rng, without_coulomb) for _ in range(2))
        fits = []
        for effects in (("viscous", "coulomb"), ("viscous", "coulomb", "stribeck@motor")):
            joint = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=effects)
            model = prepared_model(joint, train)
            data = load_dataset([train], [held], joint, model)
            fits.append((solve(model, data), data))
        (before, _), (after, data) = fits
        assert before.values["motor_coulomb"] > 10
        ended.append("motor_coulomb" in after.at_bound)
        assert artefacts(after, data, start=before) == ()
    assert any(ended)


def test_a_joint_that_settles_does_not_take_its_name_off_a_law() -> None:
    """Rows that creep have less friction than its level; a curve whose friction changes its sign at
    once followed them, and found that the law explains 87 % of what it does.
    """
    rng = np.random.default_rng(3)
    train, held = (settling(rng, lambda q, v: 3 * np.abs(v)) for _ in range(2))
    joint = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=("viscous", "coulomb"))
    answer = improve([train.renamed("first")], joint, [held])
    assert answer.added == ("asymmetric_viscous",)
    assert not answer.claims[0].like and answer.outcome == "found"


@pytest.mark.parametrize("seed", [36, 37])
def test_nothing_forbids_complete_where_the_model_is_right(seed: int) -> None:
    found = run(seed, nothing)
    assert artefacts(found.solution, found.data, found.found.curves) == ()


@pytest.mark.parametrize("width", [0.02, 0.04])
def test_dry_friction_that_changes_its_sign_over_a_few_knots_is_none(width: float) -> None:
    """Its curve has not reached the Coulomb torque at the first knots, and starts from zero."""

    def law(q: FloatArray, v: FloatArray) -> FloatArray:
        return 20 * (np.tanh(v / width) - np.tanh(v / 2e-3)) + 8 * v * np.abs(v)

    found = run(38, law, ("viscous", "coulomb", "quadratic_drag@motor"))

    def own(candidate: Candidate) -> bool:
        return candidate.effect.key == "learned_velocity"

    moving = steadily_moving(make_base(found.solution, found.data))
    (curve,) = curves_on(moving, "axis", own, most=1, certain=False).curves
    assert curve.x[0] < 3 * width
    assert artefacts(found.solution, found.data, [curve]) == ()


@pytest.mark.parametrize("off", [0.0, 2.0])
def test_dry_friction_is_that_of_a_curve_where_friction_has_reached_its_level(off: float) -> None:
    """Knots below that are of how it changes its sign, and two neighbours show no slope: of a joint
    that warmed, with knots at a third of the smoothing velocity, 24 N.m of dry friction were called
    an artefact of 7.
    """
    found = run(39, nothing)
    (curve,) = curves_on(
        steadily_moving(make_base(found.solution, found.data)),
        "axis",
        lambda c: c.effect.key == "learned_velocity",
        most=1,
        certain=False,
    ).curves
    width = found.solution.values["motor_smoothing_velocity"]
    x = width * np.geomspace(0.4, 200.0, 40)
    values = found.solution.values
    y = values["motor_coulomb"] + off + values["motor_viscous"] * x
    y = y * np.tanh((x / width) ** 2) + 0.1 * (-1.0) ** np.arange(len(x))
    curve = replace(curve, x=x, y=y, low=y - 0.2, high=y + 0.2)
    assert bool(artefacts(found.solution, found.data, [curve])) == (off > 0)


def asked(seed: int, law: Law) -> Improvement:
    rng = np.random.default_rng(seed)
    train, held = record(rng, 40, law), record(rng, 20, law)
    joint = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=("viscous", "coulomb"))
    return improve(train, joint, [held])


@pytest.mark.parametrize("key", ["stribeck", "quadratic_drag"])
def test_the_loop_leaves_a_true_name_plain(key: str) -> None:
    found = asked(38, NAMES[key])
    assert [(c.effects, c.like) for c in found.claims] == [((key,), "")]
    assert found.verdict == "complete"


@pytest.mark.parametrize(
    ("key", "over"),
    [
        ("quadratic_drag", "velocity"),
        ("stribeck", "velocity"),
        ("cyclic_friction", "position"),
        ("load_dependent_friction", "load"),
        ("thermal_friction", ""),  # of velocity and temperature: no curve over velocity says it
        ("lugre", ""),
    ],
)
def test_a_law_is_held_against_the_curve_of_its_one_variable(key: str, over: str) -> None:
    assert variable_of(EFFECTS[key]) == over


def test_a_spring_rests_where_it_rests() -> None:
    """Not at the joint's zero, and nothing stands in for the torque that it has there."""
    found = asked(51, lambda q, v: 20 * (q - 0.3))
    assert [(c.effects, c.like) for c in found.claims] == [(("added_spring",), "")]
    assert found.verdict == "complete"
    values = found.steps[-1].solution.values
    rest = -values["motor_added_spring_preload"] / values["motor_added_spring"]
    assert rest == pytest.approx(0.3, abs=0.005)


@pytest.mark.parametrize(
    "law",
    [
        lambda q, v: 8 * v / (np.abs(v) + 0.15),  # quadratic and Stribeck together imitate it
        pytest.param(
            lambda q, v: 25 * np.logaddexp(0.0, (np.abs(v) - 1.2) / 0.1) * 0.1 * np.sign(v),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["rational", "knee"],
)
def test_the_loop_marks_names_that_imitate_another_law(law: Law) -> None:
    found = asked(39, law)
    assert all("like" in c.like or c.partial for c in found.claims)
    assert found.claims or found.learned
    assert found.verdict == "unexplained"
    assert all("like" in c.as_json() for c in found.claims)


@pytest.mark.slow
def test_what_only_a_name_like_a_law_asks_for_is_a_part_of_that_law() -> None:
    """A knee over the position is a spring, gravity and a gap together; beside a curve over the
    position no gap is asked for. It is marked so where it is one name; with a soft wind-up, which
    fits as well, it stands in a set.
    """
    found = answer_to(100342)
    assert found.named == ()
    said = {"backlash or a part of one law of the position", "backlash|soft_windup"}
    assert said & {*found.others}


@pytest.mark.slow
def test_what_slow_rows_alone_say_against_a_name_says_nothing(tmp_path: Path) -> None:
    """Of a joint that creeps at its turns: dry friction under its level bends the curve there."""
    folder = write_case(make_case(13312, names=("stribeck",), size=1.0), tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    train, held = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
    found = improve(train, joint, [held])
    assert found.added == ("stribeck",)
    errors = [s.held_out.relative_error_percent for s in found.steps]
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize("seed", [220011, pytest.param(221007, marks=pytest.mark.slow)])
def test_what_only_longer_rows_show_is_held_against_their_curve(seed: int, tmp_path: Path) -> None:
    """In short rows a reading that hums hides the law, and what is a curve there is the hum. With a
    gap and slow rows, noise that was taken off the second's fit left eight times that noise.
    """
    folder = write_case(make_case(seed, kind="single", size=1.0), tmp_path, "encoders")
    joint = load_joint(folder / "joint.toml")
    train, held = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
    found = improve(train, joint, [held])
    (claim,) = found.claims
    assert claim.kernel is not None
    assert "asymmetric_coulomb" in claim.effects
    assert found.verdict == "complete"


def test_where_a_balance_fails_the_curve_is_a_claim(snag: Run) -> None:
    error = assess(snag.solution.model, snag.data, snag.data.held_out, snag.solution.values)
    (claim,) = learned_claims(snag.solution, snag.data, error, RATIO_LIMIT)
    shown = json.loads(json.dumps(claim.as_json(), allow_nan=False))
    assert shown["effects"] == ["learned"]
    assert shown["balance"] == "axis"
    curve = shown["curve"]
    assert (curve["axis"], curve["unit"], curve["y_unit"]) == ("motor_position", "rad", "N.m")
    assert len(curve["x"]) == len(curve["y"]) == len(curve["low"]) == len(curve["high"])
    assert np.all(np.array(curve["low"]) <= curve["y"])
    assert abs(curve["x"][int(np.argmax(curve["y"]))] + 0.2) < 0.05
    fine = {b: 10 * e.ratio for b, e in error.balances.items()}
    assert learned_claims(snag.solution, snag.data, error, max(fine.values())) == ()


def test_it_goes_into_the_model_at_the_values_of_its_fit(snag: Run) -> None:
    before = assess(snag.solution.model, snag.data, snag.data.held_out, snag.solution.values)
    solution = with_curves(
        snag.solution, learned_claims(snag.solution, snag.data, before, RATIO_LIMIT)
    )
    after = assess(solution.model, snag.data, snag.data.held_out, solution.values)
    assert after.balances["axis"].ratio < 0.2 * before.balances["axis"].ratio
    assert after.balances["axis"].ratio < 1.3


def test_dry_friction_turns_as_the_rows_have_it_beside_a_curve() -> None:
    """Without the law the fit lets dry friction change its sign over 6 % of the speed, where a
    curve over velocity is not drawn: the error stays at reversals.
    """
    found = run(41, lambda q, v: 40 * v / (np.abs(v) + 0.3))
    assert found.solution.values["motor_smoothing_velocity"] > 0.03
    error = assess(found.solution.model, found.data, found.data.held_out, found.solution.values)
    learned = learned_claims(found.solution, found.data, error, RATIO_LIMIT)
    whole = with_curves(found.solution, learned)
    name = "motor_smoothing_velocity"
    assert whole.values[name] < 0.4 * found.solution.values[name]

    def left(values: Mapping[str, float]) -> float:
        return assess(whole.model, found.data, found.data.held_out, values).balances["axis"].ratio

    assert left(whole.values) < 1.2
    as_fitted = {**whole.values, name: found.solution.values[name]}
    assert left(as_fitted) > 1.3 * left(whole.values)


@pytest.mark.slow
def test_a_step_over_the_position_is_a_curve_and_no_sum_of_backlash_and_offsets() -> None:
    """Gravity of any zero stays: hardly a joint is without."""
    found = asked(43, lambda q, v: 5 * np.tanh((q + 0.1) / 0.2))
    assert [c.curve.label for c in found.learned] == ["learned_position@motor"]
    assert {n for c in found.claims for n in c.effects} <= {"gravity", "cyclic_torque"}
    whole = with_curves(found.steps[-1].solution, found.learned)
    left = assess(whole.model, found.data, found.data.held_out, whole.values).balances["axis"]
    assert left.ratio < 1.2


def test_improve_writes_a_joint_file_that_every_door_takes(
    snag: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = []
    for name, given in zip(("train", "held"), snag.records, strict=True):
        names.append(str(tmp_path / f"{name}.csv"))
        columns = np.column_stack([given.time, given["motor_torque"], given["motor_position"]])
        np.savetxt(
            names[-1],
            columns,
            delimiter=",",
            header="time_s,motor_torque_Nm,motor_position_rad",
            comments="",
            fmt="%.9g",
        )
    joint, better, report = (
        str(tmp_path / n) for n in ("joint.toml", "better.toml", "report.html")
    )
    Path(joint).write_text(
        '[joint]\ngear_ratio = 1.0\nmodel = "hd1"\neffects = ["viscous@motor", "coulomb@motor"]\n'
    )
    command = [
        "improve",
        names[0],
        "--held-out",
        names[1],
        "--joint",
        joint,
        "--json",
        str(tmp_path / "out.json"),
    ]
    assert main([*command, "-o", better, "--report", report]) == 0
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["verdict"] == "unexplained"
    assert [c["effects"] for c in result["claims"]] == [["learned"]]
    assert "The curve in the place of a name" in Path(report).read_text()
    label = "learned_position_friction@motor"
    assert label in load_joint(better).effects
    said = capsys.readouterr().out
    assert f"({label})" in said
    first, last = (s["held_out"] for s in (result["steps"][-1], result["with_curves"]))
    fall = [s["relative_error_percent"] for s in (first, last)]
    assert fall[1] < 0.5 * fall[0]
    assert f"it falls from {fall[0]:.3g} % to {fall[1]:.3g} %." in result["reason"]
    assert "\n+ learned curves " in said
    assert Path(report).read_text().count("+ learned curves") >= 2, "staircase and ledger"
    compared = str(tmp_path / "compared.json")
    assert main(["compare", names[1], "--joint", better, "--json", compared]) == 0
    shown = json.loads(Path(compared).read_text())["relative_error_percent"]
    assert shown == pytest.approx(fall[1], rel=0.05)  # its kernel is that of this record alone
    assert main(["fit", names[0], "--joint", better, "--json", str(tmp_path / "fit.json")]) == 0
    fitted = json.loads((tmp_path / "fit.json").read_text())["parameters"]
    half = load_joint(better).fitted["motor_learned_position_friction_half_range"]
    assert fitted["motor_learned_position_friction_half_range"]["value"] == pytest.approx(half), (
        "the range of a table stays"
    )
    assert (
        main(["simulate", "--joint", better, "--seconds", "2", "-o", str(tmp_path / "again.csv")])
        == 0
    )
    assert main(["export", "casadi", "--joint", better, "--out", str(tmp_path / "code")]) == 0
    assert any(
        "learned" in p["name"]
        for p in json.loads((tmp_path / "code" / "parameters.json").read_text())
    )
