"""Who is significant, who cannot be told apart, what is minor: the rules on trials with known
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from casadi_models import EFFECTS
from identification import Record, diagnose, fit
from identification.balance.dataset import HOLD_DELAY, HOLD_NAME
from identification.data.joint_file import Joint
from identification.diagnosis.candidates import Candidate, NotTestable, offered
from identification.diagnosis.claims import (
    COMMON_DROP,
    Ranking,
    _discoveries,
    _major,
    confusion_set,
    make_claim,
    minor_claims,
    nearly,
    rank,
    shortened,
    simplest,
)
from identification.diagnosis.improvement import Improvement
from identification.diagnosis.outcome import weak
from identification.diagnosis.trials import Base, Trial, make_base
from identification.fitting.engine import load_dataset, prepared_model, solve
from tests.smooth_laws import LAWS, record

BLOCKS = 40


@pytest.fixture(scope="module")
def base() -> Base:
    """A motor axis whose torque has a bump over the position that its model lacks."""
    joint = Joint(model_name="hd1", effects=("viscous", "coulomb"))
    runs = [record(np.random.default_rng(k), 12.0, LAWS["bump"][1]) for k in (0, 1)]
    data = load_dataset(runs[:1], runs[1:], joint, prepared_model(joint, runs[0]))
    return make_base(solve(prepared_model(joint, runs[0]), data), data)


@pytest.fixture(scope="module")
def blocks(base: Base) -> int:
    return base.blocks


def trial(
    base: Base,
    key: str,
    score: float = 100.0,
    *,
    label: str = "",
    place: str = "motor",
    gain: float = 50.0,
    drop: float = 40.0,
    held: float = math.nan,
    p: float = 1e-6,
    values: Mapping[str, float] | None = None,
    blocks: np.ndarray | None = None,
    rms: tuple[float, ...] = (1.0,),
) -> Trial:
    """A tried candidate with given numbers."""
    amplitudes = tuple(values or {key: 1.0})
    effect = EFFECTS[key]
    candidate = Candidate(label or key, effect, place, base.solution.model, amplitudes, ())  # type: ignore[arg-type]
    scores = np.full(base.blocks, score / base.blocks) if blocks is None else blocks
    return Trial(
        candidate,
        dict(values or {key: 1.0}),
        balance="motor",
        gain=gain,
        cv_drop_percent=drop,
        held_out_drop_percent=held,
        p_value=p,
        block_score=scores,
        rms=np.array(rms),
        outside=1.0,
        contribution=2.5,
        score=score,
    )


def ranking(*trials: Trial, significant: tuple[str, ...] = ()) -> Ranking:
    return Ranking(trials, frozenset(significant), (), trials)


def test_an_error_that_rises_is_not_said_to_be_lowered_by_less_than_nothing(base: Base) -> None:
    def said(drop: float, held: float) -> str:
        return weak(trial(base, "coulomb", drop=drop, held=held, p=0.5))

    tail = " on held-out records (p = 0.5): too little, or not to be told from chance"
    on = " the motor balance by 0.2 % on blocks it was not fitted to and "
    assert said(0.2, 0.1) == f"lowers{on}by 0.1 %{tail}"
    assert said(0.2, -0.1) == f"lowers{on}raises it by 0.1 %{tail}"
    assert said(-0.2, 0.1) == f"raises{on}lowers it by 0.1 %{tail}"
    assert said(-0.2, -0.1) == f"raises{on}by 0.1 %{tail}"


def test_what_only_a_longer_record_would_tell_says_so(base: Base) -> None:
    """A fall that is large enough, over blocks that are too few or hang together too long."""
    values = {"sine": 1.0, "cosine": 1.0}
    short = trial(base, "gravity", values=values, blocks=np.full(3, 9.0), p=1.0)
    assert "3 blocks of time do not tell it from chance where 4 are asked" in weak(short)
    slow = trial(base, "gravity", values=values, gain=2.0)
    assert "that this is 2 nats, and 3 are asked; record for longer" in weak(slow)
    against = replace(slow, own_gain=9.0)
    assert weak(against).endswith("the other balances lose what this one gains")
    little = trial(base, "gravity", values=values, gain=2.0, drop=COMMON_DROP / 2)
    assert weak(little).endswith("too little, or not to be told from chance")


AXIS = Joint(name="axis", model_name="hd1", effects=("viscous", "coulomb"))


def swings(seed: int, spring: float = 0.0) -> Record:
    """40 s of an axis that swings about its middle at three rates; `spring` [N.m] RMS."""
    rng, dt = np.random.default_rng(seed), 4e-3
    t = np.arange(0.0, 40.0, dt)
    size, rate = np.array([0.5, 0.3, 0.2]), np.array([1.9, 4.7, 0.6])
    angle = np.outer(t, rate) + np.array([0.0, 1.0, 0.0])
    velocity, bend = np.sin(angle) @ size, np.cos(angle) @ (size * rate)
    position = -np.cos(angle) @ (size / rate)
    torque = 8 * bend + 30 * velocity + 40 * np.tanh(velocity / 2e-3)
    torque += spring * position / np.std(position) + 4.0 * rng.standard_normal(len(t))
    noise = 1e-6 * rng.standard_normal(len(t))
    channels = {"motor_torque": torque, "motor_position": position + noise}
    return Record.from_channels(t, channels, name=f"swings {seed}")


def test_nothing_missing_has_a_size() -> None:
    """What is told as the least that would be seen: one and a half times as much is named, and half
    of it is not, and is said to be possible.
    """

    def found(spring: float) -> Improvement:
        return diagnose(fit(AXIS, swings(1, spring)), swings(2, spring)).found

    plain = found(0.0)
    (told,) = (r for r in plain.refused if r.effect == "added_spring")
    assert plain.verdict == "nothing_missing"
    assert told.least is not None
    assert told.unit == "N.m"
    assert told.as_json()["least"] == told.least
    named = [e for c in found(1.5 * told.least).claims for e in c.effects]
    assert "added_spring" in named
    half = found(0.5 * told.least)
    assert not half.claims
    assert "N.m RMS of it would not be seen." in half.why("added_spring")
    # a delay has another kind of size
    assert all(r.least is None for r in plain.refused if EFFECTS[r.effect].is_delay)


# --- how many discoveries -------------------------------------------------------------------------


def test_discoveries_are_those_of_benjamini_and_hochberg(base: Base) -> None:
    """Fifteen p-values of their paper (1995, section 4): at 5 % the first four are discoveries."""
    published = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344] + [
        0.0459,
        0.3240,
        0.4262,
        0.5719,
        0.6528,
        0.7590,
        1.0,
    ]
    trials = [trial(base, "stribeck", label=f"stribeck#{k}", p=p) for k, p in enumerate(published)]
    assert _discoveries(trials[::-1]) == {f"stribeck#{k}" for k in range(4)}
    assert _discoveries(trials[9:]) == set()
    assert _discoveries(trials[:1]) == {"stribeck#0"}
    assert _discoveries([]) == set()
    limits = [trial(base, "stribeck", label=f"stribeck#{k}", p=0.05 * k / 4) for k in (1, 2, 3, 4)]
    assert len(_discoveries(limits)) == 4
    over = [replace(t, p_value=t.p_value * 1.001) for t in limits]
    assert _discoveries(over) == set()
    assert _discoveries([*over[:1], limits[1], *over[2:]]) == {"stribeck#1", "stribeck#2"}


def test_a_later_discovery_takes_the_earlier_ones_with_it(base: Base) -> None:
    trials = [
        trial(base, "stribeck", label=f"stribeck#{k}", p=p) for k, p in enumerate((0.03, 0.04))
    ]
    assert _discoveries(trials) == {"stribeck#0", "stribeck#1"}


# --- what is large enough -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "least", "least_held"),
    [("stribeck", 10.0, 5.0), ("coulomb", 4.0, 2.0)],
)
def test_the_fall_that_is_asked_for(key: str, least: float, least_held: float, base: Base) -> None:
    assert _major(trial(base, key, drop=least), base)
    assert not _major(trial(base, key, drop=least * 0.999), base)
    assert _major(trial(base, key, drop=least, held=least_held), base)
    assert not _major(trial(base, key, drop=90.0, held=least_held * 0.999), base)
    assert not _major(trial(base, key, drop=90.0, gain=3.0), base), "odds of 20 to 1, in nats"
    assert _major(trial(base, key, drop=least, gain=3.001), base)


def test_an_effect_with_dynamics_of_its_own_must_take_more(base: Base) -> None:
    assert EFFECTS["flexible_mode"].stage == "late"
    assert _major(trial(base, "flexible_mode", drop=30.0), base)
    assert _major(trial(base, "flexible_mode", drop=30.0, held=30.0), base)
    assert not _major(trial(base, "flexible_mode", drop=30.0 - 0.1), base)
    assert not _major(trial(base, "flexible_mode", drop=90.0, held=30.0 - 0.1), base)


def test_a_delay_must_be_longer_than_half_a_sample(base: Base) -> None:
    dt = base.data.train[0].grid.dt
    for place in ("torque_sensor", "drive"):
        for sign in (1.0, -1.0):
            for share, expected in ((0.49, False), (0.51, True)):
                late = trial(
                    base, "channel_delay", place=place, values={"delay": sign * share * dt}
                )
                assert _major(late, base) == expected


def test_a_delay_of_the_drive_counts_from_the_hold_that_is_there(base: Base) -> None:
    dt = base.data.train[0].grid.dt
    model = base.solution.model.add(HOLD_DELAY)
    values = {**base.solution.values, HOLD_NAME: 0.3 * dt}
    held = replace(base, solution=replace(base.solution, model=model, values=values))
    for delay, place, expected in (
        (0.25, "drive", True),
        (-0.25, "drive", False),
        (0.25, "torque_sensor", False),
    ):
        late = trial(base, "channel_delay", place=place, values={"delay": delay * dt})
        assert _major(late, held) == expected


def test_an_unseen_link_asks_for_more(base: Base) -> None:
    model = replace(base.solution.model, lagging_load=True)
    values = {**base.solution.values, **{p.name: 1e-4 for p in model.parameters}}
    if model.load_compliance(values) <= 0:
        pytest.fail("a link on a compliance has none")
    seen = replace(base, solution=replace(base.solution, model=model, values=values))
    assert not _major(trial(base, "stribeck", drop=20.0 - 0.1), seen)
    assert _major(trial(base, "stribeck", drop=20.0), seen)
    assert _major(trial(base, "stribeck", drop=20.0 - 0.1), base)
    assert _major(trial(base, "coulomb", drop=4.0), seen)


# --- which goes first -----------------------------------------------------------------------------


def test_the_order_in_which_effects_are_added(base: Base) -> None:
    twist = trial(base, "transmission_compliance", 10.0)
    plain = trial(base, "coulomb", 60.0)
    rich = trial(base, "stribeck", 100.0)
    every = ("transmission_compliance", "coulomb", "stribeck")
    found = ranking(rich, plain, twist, significant=every)
    assert found.best() is twist, "a visible torsion is seen, not inferred"
    assert found.best(frozenset(["transmission_compliance"])) is plain
    assert found.best(frozenset(every[:2])) is rich
    assert found.best(frozenset(every)) is None
    assert ranking(rich, plain, twist, significant=every[1:]).best() is plain
    assert ranking(rich, plain, significant=("stribeck",)).best() is rich
    weak = trial(base, "coulomb", 49.0)
    assert ranking(rich, weak, significant=every).best() is rich, "it gains more than twice"
    even = trial(base, "coulomb", 50.0)
    assert ranking(rich, even, significant=every).best() is even
    assert ranking().best() is None


def test_those_that_only_their_held_out_falls_keep_back(base: Base) -> None:
    good = trial(base, "stribeck", p=1e-5, held=1.0)
    assert nearly(ranking(good), base, frozenset()) == [good]
    assert nearly(ranking(good), base, frozenset(["stribeck"])) == []
    next_best = trial(base, "cubic_viscous", p=1e-5, held=-200.0)
    assert nearly(ranking(next_best, good), base, frozenset()) == [next_best, good]
    other = trial(base, "cyclic_torque")
    assert nearly(ranking(other, good, significant=("cyclic_torque",)), base, frozenset()) == []
    small = trial(base, "stribeck", p=1e-5, held=1.0, drop=10.0 - 1)
    assert nearly(ranking(small), base, frozenset()) == []
    unsure = trial(base, "stribeck", p=0.05 / 2 + 1e-6, held=1.0)
    assert nearly(ranking(unsure, trial(base, "viscous", p=1.0)), base, frozenset()) == []
    sure = trial(base, "stribeck", p=0.05 / 2, held=1.0)
    assert nearly(ranking(sure, trial(base, "viscous", p=1.0)), base, frozenset()) == [sure]
    without = trial(base, "stribeck", p=1e-5)
    assert nearly(ranking(without), base, frozenset()) == [], "nothing was held out"


# --- sets -----------------------------------------------------------------------------------------


def scores(base: Base, mean: float, spread: float = 0.0) -> np.ndarray:
    """Scores of blocks with a mean and a standard deviation."""
    used = np.unique(base.block[base.block >= 0])
    out = np.zeros(base.blocks)
    noise = np.resize([1.0, -1.0], len(used))
    noise -= noise.mean()
    out[used] = mean + spread * noise / np.std(noise, ddof=1)
    return out


def test_a_set_holds_what_explains_as_much(base: Base) -> None:
    count = len(np.unique(base.block[base.block >= 0]))
    best = trial(base, "stribeck", 100.0, blocks=scores(base, 10.0))

    def named(
        score: float, mean: float, spread: float = 0.0, *, rms: float = 1.0, **more: float
    ) -> bool:
        other = trial(
            base, "cyclic_torque", score, blocks=scores(base, mean, spread), rms=(rms,), **more
        )
        return confusion_set(best, [best, other], base) == ("stribeck", "cyclic_torque")

    assert named(100.0, 10.0)
    assert named(100 * (1 - 0.15) + 0.1, 9.0, 1e-3), "it loses little"
    assert not named(100 * (1 - 0.15) - 0.1, 9.0, 1e-3), "it loses more, in every block"
    sure = math.sqrt(count) / 2.0  # the spread at which a difference of 1 has t = 2
    assert named(50.0, 9.0, sure * 1.02), "the blocks do not agree which is better"
    assert not named(50.0, 9.0, sure * 0.98)
    assert not named(0.0, 10.0)
    assert not named(100.0, 10.0, rms=1.5 * 1.01)
    assert named(100.0, 10.0, rms=1.5)
    assert not named(100.0, 10.0, drop=19.9)
    assert named(100.0, 10.0, drop=20.0)
    held = replace(best, held_out_drop_percent=30.0)
    for fall, inside in ((15.0, True), (14.9, False), (math.nan, True)):
        other = trial(base, "cyclic_torque", blocks=scores(base, 10.0), held=fall)
        assert (len(confusion_set(held, [held, other], base)) == 2) == inside


@pytest.mark.parametrize(("count", "apart"), [(1, False), (2, True), (3, True)])
def test_blocks_that_agree_tell_names_apart_from_two_on(
    count: int, apart: bool, base: Base
) -> None:
    """One block says nothing of how much they scatter."""
    few = replace(base, block=np.where(base.block >= 0, base.block % count, -1))
    agree = np.linspace(10.0, 10.1, count)
    best = trial(few, "stribeck", 100.0, blocks=agree)
    other = trial(few, "cyclic_torque", 50.0, blocks=agree / 2)
    assert (len(confusion_set(best, [best, other], few)) == 1) == apart


def test_who_never_stands_in_a_set(base: Base) -> None:
    best = trial(base, "viscous", 100.0, blocks=scores(base, 10.0))
    richer = trial(base, "cubic_viscous", 100.0, blocks=scores(base, 10.0))
    assert "viscous" in EFFECTS["cubic_viscous"].contains
    assert confusion_set(best, [best, richer], base) == ("viscous",)
    assert confusion_set(richer, [richer, best], base) == ("cubic_viscous", "viscous")
    again = trial(base, "viscous", 90.0, place="link", blocks=scores(base, 10.0))
    assert confusion_set(best, [best, again], base) == ("viscous",), "a name counts once"
    twist = trial(base, "transmission_compliance", blocks=scores(base, 10.0))
    other = trial(base, "stribeck", blocks=scores(base, 10.0))
    both = replace(
        base, data=replace(base.data, sensing=replace(base.data.sensing, both_positions=True))
    )
    assert confusion_set(twist, [twist, other], both) == ("transmission_compliance",)
    assert len(confusion_set(twist, [twist, other], base)) == 2, "here the torsion is not seen"


def test_a_balance_that_the_best_leaves_empty_does_not_count(base: Base) -> None:
    best = trial(base, "stribeck", blocks=scores(base, 10.0), rms=(1.0, 0.0))
    other = trial(base, "cyclic_torque", blocks=scores(base, 10.0), rms=(1.0, 5.0))
    assert len(confusion_set(best, [other], base)) == 2


def test_a_long_set_keeps_the_significant_names_in_their_order(base: Base) -> None:
    keys = ("stribeck", "cyclic_torque", "added_spring", "torque_ripple", "hysteresis", "lugre")
    trials = tuple(trial(base, k) for k in keys)
    few = ranking(*trials, significant=keys[4:])
    assert shortened(keys, few) == ("stribeck", "cyclic_torque", "hysteresis", "lugre")
    assert len(shortened(keys, few)) == 4
    assert shortened(keys, ranking(*trials, significant=keys)) == keys
    assert shortened(keys[:3], ranking(*trials)) == keys[:3]


def test_the_simplest_of_a_set(base: Base) -> None:
    two = trial(base, "stribeck", 100.0, values={"a": 1.0, "b": 2.0})
    one = trial(base, "cyclic_torque", 90.0)
    better = trial(base, "added_spring", 95.0)
    common = trial(base, "gravity", 80.0, values={"a": 1.0, "b": 2.0, "c": 3.0})
    keys = ("stribeck", "cyclic_torque", "added_spring", "gravity")
    every = ranking(two, one, better, common, significant=keys)
    assert simplest(two, keys, every) is common
    assert simplest(two, keys[:3], every) is better
    assert simplest(two, keys[:2], every) is one
    assert simplest(two, keys[:1], every) is two
    assert simplest(two, keys[:2], every, frozenset(["cyclic_torque"])) is two
    assert simplest(two, keys, ranking(two, one)) is two


def test_what_a_claim_says(base: Base) -> None:
    best = trial(base, "stribeck", blocks=scores(base, 10.0), drop=44.0)
    other = trial(base, "cyclic_torque", blocks=scores(base, 10.0), drop=44.0)
    alone = make_claim(best, ranking(best), base)
    assert (alone.effects, alone.separate_by, alone.balance) == (("stribeck",), None, "motor")
    assert alone.held_out_drop_percent == 44.0
    assert alone.contribution == 2.5
    pair = make_claim(best, ranking(best, other), base)
    assert pair.effects == ("stribeck", "cyclic_torque")
    assert pair.separate_by == EFFECTS["stribeck"].separate_by
    given = make_claim(best, ranking(best, other), base, ("cyclic_torque", "stribeck"))
    assert given.effects == ("stribeck", "cyclic_torque"), "the one that is added stands first"
    held = make_claim(replace(best, held_out_drop_percent=31.0), ranking(best), base)
    assert held.held_out_drop_percent == 31.0
    assert "partial" not in held.as_json()
    assert replace(held, partial=True).as_json()["partial"] is True


def test_minor_claims_are_small_and_certain(base: Base) -> None:
    certain = {"score": 100.0, "drop": 2.5, "held": 2.0, "p": 0.01}
    good = trial(base, "stribeck", **certain)
    assert minor_claims(ranking(good), base) == [good]
    for key, worse in (("score", 99.9), ("drop", 2.49), ("held", 1.99), ("p", 0.0101)):
        assert minor_claims(ranking(trial(base, "stribeck", **{**certain, key: worse})), base) == []
    assert minor_claims(ranking(good, significant=("stribeck",)), base) == []
    for key in ("channel_delay", "flexible_mode"):
        assert minor_claims(ranking(trial(base, key, **certain)), base) == []
    unheld = trial(base, "stribeck", **{**certain, "held": math.nan})
    assert minor_claims(ranking(unheld), base) == []
    three = [trial(base, k, **certain) for k in ("stribeck", "cyclic_torque", "added_spring")]
    assert minor_claims(ranking(*three), base) == three[:2]


# --- the whole library ----------------------------------------------------------------------------


def test_the_ranking_of_a_bump_over_the_position(base: Base) -> None:
    told: list[tuple[str, float]] = []
    found = rank(base, progress=lambda text, share: told.append((text, share)))
    assert [t.key for t in found.trials] == list(dict.fromkeys(t.key for t in found.trials))
    assert {t.key for t in found.trials}.isdisjoint(n.effect for n in found.not_testable)
    assert all(isinstance(n, NotTestable) and n.why for n in found.not_testable)
    assert all(
        a.score >= b.score for a, b in zip(found.everything, found.everything[1:], strict=False)
    )
    assert {t.key for t in found.trials} == {t.key for t in found.everything}
    rows = [(t.candidate.label in found.significant, t.score) for t in found.trials]
    assert rows == sorted(rows, reverse=True), "the significant ones first, then by score"
    for t in found.trials:
        whole = [other for other in found.everything if other.key == t.key]
        assert t.score == max(other.score for other in whole)
    assert found.significant == {
        t.candidate.label
        for t in found.everything
        if t.candidate.label in _discoveries(found.everything) and _major(t, base)
    }
    shares = [share for _, share in told]
    assert shares[0] == 0.0
    assert np.allclose(np.diff(shares), 1 / len(shares))
    assert told[-1][0].endswith(f"({len(told)} of {len(told)})")
    assert found.trials[0].effect.family == "torque", "a law of the position comes first"


def test_a_name_that_is_not_significant_stands_behind_those_that_are(
    base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However much it gains: here all pass the tests, and the fall of the best is not believed."""
    best = rank(base).everything[0].candidate.label
    place = "identification.diagnosis.claims"
    monkeypatch.setattr(f"{place}._discoveries", lambda ts: {t.candidate.label for t in ts})
    monkeypatch.setattr(f"{place}._major", lambda t, _base: t.candidate.label != best)
    found = rank(base)
    assert found.everything[0].candidate.label == best, "what was tried goes by its score alone"
    sure = [t.candidate.label in found.significant for t in found.trials]
    assert sure == [True] * (len(sure) - 1) + [False]
    assert found.trials[-1].candidate.label == best


def test_a_name_stands_with_the_best_of_its_candidates(
    base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In whichever order they are tried: each counts as it was tried, and the best for the name."""
    offers = offered(base.solution.model, base.data)[0]
    twins = [replace(c, label=f"{c.label}#2") for c in offers]
    scores = np.random.default_rng(0).permutation(2 * len(offers)) + 1.0
    given = dict(zip((c.label for c in (*offers, *twins)), scores.tolist(), strict=True))
    monkeypatch.setattr(
        "identification.diagnosis.claims.try_candidate",
        lambda c, based: trial(based, c.effect.key, given[c.label], label=c.label),
    )
    found = rank(base, twins)
    assert {t.candidate.label: t.score for t in found.everything} == given
    for t in found.trials:
        own = [c.label for c in (*offers, *twins) if c.effect.key == t.key]
        assert t.score == max(given[label] for label in own)
