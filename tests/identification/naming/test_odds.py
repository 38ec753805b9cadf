"""Whole fits of names of one effect: the one that was put in leads, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import norm, wilcoxon

from casadi_models import EFFECTS, JointModel
from identification import improve
from identification.balance.dataset import Dataset
from identification.data.formats import chances
from identification.data.joint_file import Joint, load_joint
from identification.data.read import read
from identification.diagnosis.claims import Ranking, rank
from identification.diagnosis.trials import make_base
from identification.fitting.engine import Solution, load_dataset, prepared_model, solve
from identification.naming import contest as contest_module
from identification.naming.contest import (
    FEWEST,
    Contest,
    Rival,
    _believable,
    _by_block,
    _entitled,
    _left,
    _signed_ranks,
    _unlikely,
    from_every_valley,
    rivals_of,
)
from identification.naming.odds import Odds, contenders, contest_of, odds_of, unmodelled
from tests.recorded_world.world import make_case, write_case
from tests.smooth_laws import Law, record

FloatArray = npt.NDArray[np.float64]
JOINT = Joint("axis", model_name="hd1", effects=("viscous", "coulomb"))
NAMES = ("cubic_viscous", "quadratic_drag")
WIDTH = 0.1
Valley = tuple[tuple[Rival, Rival], Solution, Dataset]


def drag(q: FloatArray, v: FloatArray) -> FloatArray:
    """`quadratic_drag` of the library, weak beside the viscous friction."""
    return 3 * v * np.abs(v)


def level(q: FloatArray, v: FloatArray) -> FloatArray:
    """A constant: an offset of the current, or a Coulomb friction that differs by direction."""
    return 4.0 + 0 * q


def falling(q: FloatArray, v: FloatArray) -> FloatArray:
    """`stribeck` of the library."""
    return 15 * np.exp(-np.abs(v) / WIDTH) * np.sign(v)


def contest(law: Law, names: tuple[str, ...], seed: int = 3) -> Contest:
    runs = [record(np.random.default_rng([seed, k]), 20.0, law) for k in (0, 1)]
    model = prepared_model(JOINT, runs[0])
    data = load_dataset(runs[:1], runs[1:], JOINT, model)
    bare = solve(model, data)
    first = rivals_of(names[:1], "axis", bare, data)[0]
    return contest_of(names, "axis", first, bare, data)


@pytest.fixture(scope="module")
def drags() -> Contest:
    """Led by the name that is not the hidden one."""
    return contest(drag, NAMES)


def bumped(q: FloatArray, v: FloatArray) -> FloatArray:
    """Beside the drag something that no name has."""
    return drag(q, v) + 5 * np.exp(-(((q - 0.3) / 0.15) ** 2))


@pytest.fixture(scope="module")
def imitated() -> Contest:
    return contest(bumped, NAMES)


def left_by(found: Contest) -> Ranking:
    return rank(make_base(found.leader.solution, found.data))


def test_the_hidden_name_leads_and_the_chances_add_up(drags: Contest) -> None:
    assert drags.leader.name == "quadratic_drag"
    assert [r.name for r in drags.rivals] == [*NAMES, ""], "nothing at all is a rival too"
    for allowance in (0.0, 30.0):
        share = drags.probability(allowance)
        assert share.sum() == pytest.approx(1.0)
        assert int(np.argmax(share)) == 1
    # both names have one amplitude: their odds are those of the likelihoods alone, as far as the
    # blocks agree about them
    share, nats = drags.probability(), drags.likelihood
    ahead, deviate = drags.ahead[0]
    assert np.log(share[1] / share[0]) == pytest.approx(min(ahead, 2 * deviate**2))
    assert nats[2] < min(nats[:2]), "a law that imitates is better than none"


def test_a_name_falls_out_by_more_than_what_is_unmodelled(drags: Contest) -> None:
    nats, deviate = drags.ahead[0]
    assert nats > FEWEST
    assert deviate > 2
    names = {allow: {r.name for r in drags.alive(allow)} for allow in (0.0, 1.01 * nats)}
    assert names[0.0] == {"quadratic_drag"}
    assert names[1.01 * nats] == set(NAMES) | ({""} if drags.ahead[2, 0] <= 1.01 * nats else set())
    unsure = drags.probability(2 * nats)[1]
    assert 0.5 < unsure < 0.9, "what is unmodelled makes a name less sure"


def test_a_parameter_costs_half_the_logarithm_of_the_rows_that_count(drags: Contest) -> None:
    """Four of ten of those that stand in a block and do not rest."""
    (w,) = drags.data.train
    still = w.time < 8.0
    resting = replace(w, rest={"motor": still.astype(float)})
    found = Contest(drags.rivals, replace(drags.data, train=[resting]))
    rows = int(np.sum(~still & (w.block >= 0)))
    assert 100 < rows < 0.7 * np.sum(w.block >= 0)
    sizes = [len(r.solution.free) for r in found.rivals]
    assert sizes == [5, 5, 4], "nothing has no amplitude"
    for allowance, tempering in ((0.0, 1.0), (2 * FEWEST, 2.0)):
        share = np.log(found.probability(allowance))
        lost = [min(nats / tempering, 2 * max(z, 0.0) ** 2) for nats, z in found.ahead]
        price = 0.5 * math.log(0.4 * rows / tempering)
        assert share[2] - share[1] == pytest.approx(lost[1] - lost[2] + price)
        assert share[0] - share[1] == pytest.approx(lost[1] - lost[0])


def test_the_lead_by_plain_sums_over_blocks(drags: Contest) -> None:
    """Student's t of the blocks' differences, or that of their signs; rows of a block count each
    four tenths, those at a turn by none of two laws that say nothing of it.
    """
    leader = drags.rivals.index(drags.leader)
    assert drags.ahead[leader].tolist() == [0.0, 0.0], "nobody is ahead of itself"
    (w,) = drags.data.train
    (counted,) = drags._calm(drags.leader, drags.rivals[1 - leader])
    assert 0 < np.sum(~counted) < 0.1 * len(counted)
    best = drags._old[leader][0]
    for k, (left, _, _) in enumerate(drags._old[:2]):
        if k == leader:
            continue
        rows = np.where(counted, 0.2 * (left**2 - best**2), 0.0)
        by = np.array([rows[w.block == b].sum() for b in range(w.block.max() + 1)])
        t = by.mean() / (by.std(ddof=1) / math.sqrt(len(by)))
        signs = (np.sum(by > 0) - np.sum(by < 0)) / math.sqrt(len(by))
        # neither has a clock or a zero that would cost anything beforehand
        assert drags.ahead[k] == pytest.approx([by.sum(), max(t, signs)])


def test_large_differences_of_one_sign_are_sure_beside_small_ones_of_the_other() -> None:
    """As scipy ranks them; their mean stands at 1.5 of its scatter, their signs at .6."""
    small = [-28.6, -12.4, -8.8, -11.3, -12.0, -10.5, -12.5, -8.7, -12.8, -8.4]
    large = [27.5, 22.8, 49.5, 39.7, 41.7, 1.3, 38.5, 62.1, 67.1, 39.0, 2.7, 151.9, 151.0, 27.9]
    values = np.array([*small, *large, 1161.0])
    sure = _signed_ranks(values)
    said = wilcoxon(values, method="asymptotic", correction=False).pvalue
    assert 2 * norm.sf(sure) == pytest.approx(said, rel=1e-9)
    assert sure > 2.0 > max(values.sum() / (values.std(ddof=1) * 5), np.sign(values).sum() / 5)
    assert _signed_ranks(-values) == -sure


def test_squares_are_summed_over_the_rows_of_each_block_and_no_others() -> None:
    left, block = np.array([1.0, 2.0, 3.0, 4.0, 5.0]), np.array([0, 0, 2, -1, 2])
    assert _by_block(left, block).tolist() == [5.0, 0.0, 34.0]


def test_rows_at_a_turn_count_where_either_law_says_what_happens_there(drags: Contest) -> None:
    first, second, _ = drags.rivals
    turns = replace(first, name="lugre")
    (whole,) = drags._calm(turns, replace(second, name="hysteresis"))
    (fewer,) = drags._calm(first, second)
    assert whole.all()
    assert not fewer.all()
    for pair in ((turns, second), (second, turns)):
        assert np.array_equal(drags._calm(*pair)[0], whole)


def test_what_the_true_law_leaves_holds_no_other(drags: Contest) -> None:
    allowance = unmodelled(left_by(drags), "axis")
    assert allowance < 0.05 * drags.ahead[0, 0]
    odds = odds_of(drags, allowance)
    assert odds.names == ("quadratic_drag",)
    assert odds.probability["quadratic_drag"] > 0.99
    assert list(odds.behind) == ["cubic_viscous@motor"], "neither the leader nor nothing at all"
    assert "nats behind" in odds.behind["cubic_viscous@motor"]


@pytest.mark.parametrize(
    ("behind", "nothing", "unmodelled", "names"),
    [
        (137.0, 142.6, 22.6, {"quadratic_drag"}),
        (137.0, 142.6, 0.0, {*NAMES}),
        (110.0, 142.6, 22.6, {*NAMES}),
        (8.0, 10.0, 22.6, {*NAMES}),
        (8.0, 2.0, 0.0, {*NAMES}),
    ],
    ids=["does nothing", "does a little", "does its part", "neither", "worse than nothing"],
)
def test_a_name_that_does_nothing_is_no_second_explanation(
    behind: float, nothing: float, unmodelled: float, names: set[str], drags: Contest
) -> None:
    """Few blocks tell nothing apart, however far a name is behind; but where one name explains
    what is missing, another one that gains no more than laws which are not missing does not.
    """
    found = Contest(drags.rivals, drags.data)
    assert found.leader is found.rivals[1]
    found.__dict__["ahead"] = np.array([[behind, 1.9], [0.0, 0.0], [nothing, 1.8]])
    assert len(found.alive(unmodelled)) == 3
    odds = odds_of(found, unmodelled)
    assert {*odds.names} == names
    assert {*odds.probability} == names
    told = odds.behind.get("cubic_viscous@motor", "over nothing")
    assert ("cubic_viscous" in names) == ("cubic_viscous@motor" not in odds.behind)
    assert "over nothing" in told


def test_who_has_no_other_valley_stays_as_it_was_fitted(drags: Contest) -> None:
    """Names without shapes, and one behind that is not on offer beside the model any more."""
    first, second, nothing = drags.rivals
    assert drags.ahead[0, 0] > FEWEST
    for behind in (first, replace(first, label="gone@motor")):
        again = from_every_valley([behind, second], nothing.solution, drags.data)
        assert [x is y for x, y in zip(again, (behind, second), strict=True)] == [True, True]


@pytest.fixture(scope="module")
def another_valley() -> Valley:
    """Extra friction that falls over 0.1 rad/s: its name with another width, and a name that does
    better than that; the model without either.
    """
    runs = [record(np.random.default_rng([3, k]), 4.0, falling) for k in (0, 1)]
    model = prepared_model(JOINT, runs[0])
    data = load_dataset(runs[:1], runs[1:], JOINT, model)
    bare = solve(model, data)
    own, other = rivals_of(("stribeck", "quadratic_drag"), "axis", bare, data)
    values = {**own.solution.values, "motor_stribeck_velocity": 3 * WIDTH}
    wrong = replace(own, solution=replace(own.solution, values=values))
    return (wrong, other), bare, data


def test_a_name_that_is_behind_in_another_valley_is_fitted_from_every_point_of_its_grid(
    another_valley: Valley,
) -> None:
    """Then it leads; the one that was ahead of it stays as it was fitted."""
    rivals, bare, data = another_valley
    before = Contest(rivals, data)
    assert before.leader is rivals[1]
    assert before.ahead[0, 0] > FEWEST
    again = from_every_valley(rivals, bare, data)
    assert again[1] is rivals[1]
    after = Contest(again, data)
    assert after.leader is again[0]
    assert after.ahead[1, 0] > FEWEST
    assert again[0].name == "stribeck"
    assert again[0].solution.values["motor_stribeck_velocity"] == pytest.approx(WIDTH, rel=0.15)


def test_every_point_of_a_grid_begins_where_the_leader_has_ended(another_valley: Valley) -> None:
    """In what the two laws share: how the model without them was fitted says nothing."""
    rivals, bare, data = another_valley
    elsewhere = replace(bare, values={n: 3 * x for n, x in bare.values.items()})
    one, other = (from_every_valley(rivals, start, data)[0] for start in (bare, elsewhere))
    assert one.solution.values == other.solution.values


def test_a_bump_that_no_name_has_is_an_allowance(imitated: Contest, drags: Contest) -> None:
    noise = unmodelled(left_by(drags), "axis")
    assert unmodelled(left_by(imitated), "axis") > 10 * max(FEWEST, noise)


def test_a_balance_in_which_no_law_gains_has_no_allowance(drags: Contest) -> None:
    """Of another balance or of no trial at all."""
    found = left_by(drags)
    assert {t.balance for t in found.everything} == {"axis"}
    assert unmodelled(found, "link") == 0.0
    assert unmodelled(replace(found, everything=()), "axis") == 0.0


@pytest.mark.parametrize("which", ["drags", "imitated"])
def test_what_the_leader_leaves_counts_by_its_own_scatter(
    which: str, request: pytest.FixtureRequest
) -> None:
    """Noise, or noise and what is not modelled: over it the rows have a mean square of one, and
    so they have in the comparison.
    """
    found: Contest = request.getfixturevalue(which)
    entitled = _entitled(found.rivals, found.data)
    best = found.rivals.index(found.leader)
    left = [_left(r, found.data)["axis"] * w["axis"] for r, w in zip(found.rivals, entitled)]
    assert float(np.mean(left[best] ** 2)) == pytest.approx(1.0, abs=0.05)
    for own, (rows, _, _) in zip(left, found._old, strict=True):
        # one factor for all rivals: the weights of the leader's own fit
        scale = found.leader.solution.weights["axis"] / entitled[best]["axis"]
        assert rows == pytest.approx(own * scale, rel=1e-6, abs=1e-9)
    # log-likelihood of four tenths of the rows, but for what is the same for all
    known = [0.4 * norm.logpdf(rows).sum() for rows, _, _ in found._old]
    assert found.likelihood - found.likelihood[0] == pytest.approx(np.array(known) - known[0])


@pytest.mark.parametrize("loud", NAMES)
def test_a_law_is_not_entitled_to_noise_that_its_rows_do_not_show(
    loud: str, drags: Contest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slope that runs away where hardly a row is makes a level of noise of some draws: such a
    law was a hundred million nats ahead.  It may leave what the others may.
    """

    def drawn(model: JointModel, *given: Any) -> dict[str, float]:
        return {b: x * (500 if model.has(loud) else 1) for b, x in quiet(model, *given).items()}

    quiet = contest_module.drawn_floors
    monkeypatch.setattr(contest_module, "drawn_floors", drawn)
    found = Contest(drags.rivals, drags.data)
    assert found.leader is drags.leader
    assert found.ahead == pytest.approx(drags.ahead, rel=1e-2, abs=1e-2)


@pytest.mark.parametrize(
    ("drawn", "believed", "level"),
    [
        ((5.0, 5.3, 1.0), (0.74, 1.0, 1.0), 3.7),
        ((1000.0, 5.3, 1.0), (0.006, 1.0, 1.0), 5.3),
        ((1000.0, 1.1, 1.0), (0.006, 1.0, 1.0), 1.1),
        ((5.0, 5.3, 1.0), (0.95, 1.0, 1.0), 5.0),
    ],
    ids=["noise is a third less", "a slope that runs away", "beside calm ones", "as drawn"],
)
def test_a_law_that_leaves_less_than_its_noise_is_entitled_to_what_it_leaves(
    drawn: tuple[float, ...],
    believed: tuple[float, ...],
    level: float,
    drags: Contest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As far as others may leave it. A model without gravity had an inertia of a fifth and a fifth
    of the noise; held to that, the right law lost 600 nats to one that left twice as much.
    """
    levels, shares = iter(drawn), iter(believed)
    monkeypatch.setattr(contest_module, "drawn_floors", lambda *_: {"axis": next(levels)})
    monkeypatch.setattr(contest_module, "noise_believed", lambda *_: {"axis": next(shares)})
    found = _believable(drags.rivals, drags.data)
    assert [float(x["axis"][0]) for x in found] == pytest.approx([level, *drawn[1:]])


@pytest.mark.parametrize(("deviates", "leads"), [(3.0, True), (-15.0, True), (30.0, False)])
def test_what_a_name_needs_of_clocks_and_zeros_counts_against_it(
    deviates: float, leads: bool, drags: Contest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the density of a normal value that far from its mean; the unlikely leads no more."""
    name = "motor_quadratic_drag"
    value = drags.leader.solution.values[name]
    known = {name: (value - deviates * 0.01, 0.01), "elsewhere": (0.0, 1.0)}
    monkeypatch.setattr("identification.naming.contest.usual", lambda *_, **__: known)
    found = Contest(drags.rivals, drags.data)
    cost = float(norm.logpdf(0.0) - norm.logpdf(deviates))
    assert [_unlikely(r, found.data) for r in found.rivals] == pytest.approx([0.0, cost, 0.0])
    assert (cost < drags.ahead[0, 0]) == leads
    assert found.leader is found.rivals[1 if leads else 0]
    if leads:
        assert found.ahead[:, 0] == pytest.approx(drags.ahead[:, 0] - [cost, 0.0, cost])
        assert found.likelihood == pytest.approx(drags.likelihood - [0.0, cost, 0.0])
    else:
        assert found.ahead[1, 0] > 0


def test_names_that_are_one_column_share_the_chance() -> None:
    """But for the rows of the turns, which lean to the true one by less than noise moves them: the
    chances of several draws are shared, of each draw both names stay.
    """
    shares = []
    for seed in (3, 4, 5, 6):
        odds = odds_of(contest(level, ("current_offset", "asymmetric_coulomb"), seed), 0.0)
        assert set(odds.names) == {"current_offset", "asymmetric_coulomb"}
        shares.append(odds.probability["current_offset"])
    assert float(np.mean(shares)) == pytest.approx(0.5, abs=0.1)


def test_who_is_worth_a_whole_fit() -> None:
    near = {"cyclic_torque": 5.9, "added_spring": 6.1, "cubic_viscous": 0.0, "stribeck": 1.0}
    assert contenders(("quadratic_drag",), near, 0.0) == (
        "quadratic_drag",
        "cubic_viscous",
        "stribeck",
        "cyclic_torque",
    )
    assert "added_spring" in contenders(("quadratic_drag",), near, 3.1)
    assert "cubic_viscous" not in contenders(("viscous",), near, 0.0), "it holds the other"
    twins = {"current_offset": 120.0, "torque_sensor_offset": 120.0, "added_spring": 124.0}
    assert contenders(("asymmetric_coulomb", "current_offset"), twins, 0.0) == (
        "asymmetric_coulomb",
        "current_offset",
        "torque_sensor_offset",
    ), "where one offset may be the name, another one of the same column may be"
    many = tuple("abcdefgh")
    assert contenders(many, near, 0.0) == many


def test_improve_takes_the_name_that_fits_best_and_says_how_sure_it_is() -> None:
    runs = [
        record(np.random.default_rng([3, k]), 20.0, lambda q, v: 5 * drag(q, v)) for k in (0, 1)
    ]
    found = improve(runs[0], JOINT, runs[1])
    assert [c.effects for c in found.claims] == [("quadratic_drag",)]
    claim = found.claims[0]
    assert claim.confidence["quadratic_drag"] > 0.99
    assert claim.as_json()["confidence"] == dict(claim.confidence)
    assert claim.separate_by is None
    assert "over 99 % quadratic_drag" in str(found)


def test_chances_are_told_without_false_certainty() -> None:
    assert chances({"a": 0.9999, "b": 1e-5}) == "over 99 % a, under 1 % b"
    assert chances({"a": 0.967, "b": 0.033}) == "97 % a, 3 % b"


def test_a_name_stands_for_its_set_unless_another_counts_as_better(drags: Contest) -> None:
    first, second, nothing = drags.rivals
    even = math.exp(-FEWEST)
    for behind, holds in ((1.01 * even, True), (0.99 * even, False)):
        odds = Odds((first, second), {first.name: 1.0, second.name: behind}, {})
        assert odds.holds(first.name)
        assert odds.holds(second.name) == holds
        assert not odds.holds("gravity"), "no rival at all"
    assert not Odds((), {}, {}).holds(first.name)


def test_names_that_are_less_probable_than_nothing_are_no_claim(drags: Contest) -> None:
    first, second, _ = drags.rivals
    for nothing, empty in ((0.49, False), (0.51, True)):
        share = {first.name: 0.6 * (1 - nothing), second.name: 0.4 * (1 - nothing)}
        assert Odds((first, second), share, {}, nothing).empty == empty
    assert not Odds((first,), {first.name: 0.3}, {}).empty, "nothing was not asked"
    sure = odds_of(drags, 0.0)
    assert not sure.empty
    assert sum(sure.probability.values()) + sure.nothing <= 1 + 1e-12
    # so much is gained by laws that are not missing that the names' own gain says nothing
    doubted = odds_of(drags, 1e9)
    assert doubted.nothing == pytest.approx(1 / 3, abs=0.01)
    assert doubted.nothing > sure.nothing


@pytest.mark.slow
def test_a_drift_does_not_decide_between_two_names(tmp_path: Path) -> None:
    """A torque that is periodic in the position takes a part of one course of a drift, and rows in
    which it did were as many witnesses against the motor constant that is off.
    """
    folder = write_case(make_case(230005, kind="single", size=1.0), tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    train, held = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
    found = improve(train, joint, [held])
    (claim,) = found.claims
    assert {"motor_constant_error", "torque_sensor_gain", "cyclic_torque"} <= set(claim.effects)
    assert not {n for m in found.minor for n in m.effects} & set(claim.effects)
    assert found.verdict == "complete"


@pytest.mark.slow
def test_a_name_that_takes_the_gear_for_the_motor_is_not_what_is_missing(tmp_path: Path) -> None:
    """Encoders of 12 bits, and a stiffness that rises with the twist: a torque of the motor that
    turns with it leaves a third of the RMS, as it takes the load and the noise off the gear, and
    still more than its noise. What is left at its noise wins, though no trial showed it: with
    inertias that pass little noise on, the other balance was against it.
    """
    folder = write_case(make_case(245003, kind="triple", size=1.0), tmp_path, "encoders")
    joint = load_joint(folder / "joint.toml")
    train, held = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
    found = improve(train, joint, [held])
    assert found.verdict == "complete"
    names = [set(c.effects) for c in found.claims]
    assert {"coulomb"} in names
    assert {"asymmetric_viscous"} in names
    (gear,) = (c for c in found.claims if c.balance == "deflection")
    assert all(EFFECTS[n].reads == {"torsion"} for n in gear.effects)
    assert all(e.ratio < 1.2 for e in found.steps[-1].held_out.balances.values())
