"""What a session decides, on axes whose hidden laws are known."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from identification import Improvement, Record, improve
from identification.data.joint_file import Joint
from identification.diagnosis.claims import MAJOR_DROP
from identification.diagnosis.improvement import held_drop
from identification.diagnosis.session import (
    LEAST_ADDED_DROP,
    MAX_ADDITIONS,
    Session,
    refuse_unlike,
    with_held_out,
)
from identification.errors import InputError
from tests.recorded_world.world import make_case, write_case
from tests.smooth_laws import (
    COULOMB,
    INERTIA,
    LAWS,
    VISCOUS,
    Law,
    at_one_speed,
    nothing,
    record,
)
from workbench.cli.main import improve_json

FloatArray = npt.NDArray[np.float64]
JOINT = Joint(model_name="hd1", effects=("viscous", "coulomb"))


def wave(q: FloatArray, v: FloatArray) -> FloatArray:
    """`gravity` of the library, of any zero."""
    return 6 * np.sin(q + 0.7)


def drag(q: FloatArray, v: FloatArray) -> FloatArray:
    """`quadratic_drag` of the library."""
    return 15 * v * np.abs(v)


def both(q: FloatArray, v: FloatArray) -> FloatArray:
    return wave(q, v) + drag(q, v)


@cache
def runs(law: Law) -> tuple[Record, Record]:
    train, held = (record(np.random.default_rng([7, k]), 10.0, law) for k in (0, 1))
    return train.renamed("train"), held.renamed("held")


@cache
def improved(law: Law, most: int = MAX_ADDITIONS) -> Improvement:
    train, held = runs(law)
    return improve(train, JOINT, [held], max_additions=most)


def test_a_motion_of_few_lines_limits_the_effects_of_each_balance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of one balance no more than it can tell, however many are asked for; and that is said."""
    monkeypatch.setattr("identification.diagnosis.session.claim_limit", lambda _: 1)
    train, held = runs(both)
    found = improve(train, JOINT, [held])
    assert found.claims[0].effects == improved(both, 1).claims[0].effects
    assert len(found.claims) == 1
    assert "Stopped at the limit of additions (1)" in found.reason
    assert "would be the next" in found.reason


@pytest.mark.slow
def test_each_balance_has_a_limit_of_its_own(tmp_path: Path) -> None:
    """Constant speeds, a line and a half, and three effects in three balances: one of motor, link
    and transmission each.
    """
    write_case(make_case(310004, kind="triple", size=1.0), tmp_path, "all")
    train, held = ([tmp_path / f"{name}.csv"] for name in ("train", "test"))
    found = improve_json(train, held, tmp_path / "joint.toml")
    assert [c["balance"] for c in found["claims"]] == ["motor", "link", "transmission"]
    names = [{e.partition("@")[0] for e in c["effects"]} for c in found["claims"]]
    hidden = ("channel_delay", "asymmetric_viscous", "backlash")
    assert all(n in held for n, held in zip(hidden, names, strict=True))
    assert found["verdict"] == "complete"


def little_drag(q: FloatArray, v: FloatArray) -> FloatArray:
    return 5 * v * np.abs(v)


@pytest.mark.parametrize("law", [little_drag, nothing])
def test_what_other_motion_falls_by_is_claimed_where_the_training_motion_hardly_shows_it(
    law: Law,
) -> None:
    """Drag at one speed is nearly Coulomb friction: little of what is left, however certain; of the
    held-out record it is most.
    """
    found = improve(at_one_speed(np.random.default_rng(3), law), JOINT, [runs(law)[1]])
    first = found.ranking.everything[0]
    assert first.cv_drop_percent < MAJOR_DROP, "the training blocks alone do not carry a claim"
    if law is nothing:
        assert found.claims == ()
        assert found.verdict == "nothing_missing"
        return
    (claim,) = found.claims
    assert "quadratic_drag" in claim.effects
    errors = [s.held_out.relative_error_percent for s in found.steps]
    assert errors[-1] < 0.5 * errors[0]
    assert found.verdict == "complete", "one speed leaves open what drag there is and what friction"
    (noted,) = [w for w in found.warnings if "leave open" in w]
    assert "motor_quadratic_drag" in noted


def test_what_a_fit_leaves_open_excuses_no_law_that_is_missing() -> None:
    """A fit to one speed leaves viscous and Coulomb friction open, and nothing over the place."""
    found = improve(at_one_speed(np.random.default_rng(3), nothing), JOINT, [runs(wave)[1]])
    assert found.verdict == "unexplained"
    assert found.final_ratios["axis"].ratio > 2
    assert not [w for w in found.warnings if "leave open" in w]


def test_two_hidden_laws_are_both_named_and_the_error_falls_with_each() -> None:
    found = improved(both)
    assert sorted(c.effects[0] for c in found.claims) == ["gravity", "quadratic_drag"]
    assert found.verdict == "complete"
    assert len(found.steps) == 1 + len(found.claims) == 3
    assert [s.added for s in found.steps] == [None, *(c.effects[0] for c in found.claims)]
    errors = [s.held_out.relative_error_percent for s in found.steps]
    assert errors == sorted(errors, reverse=True)
    for before, after, claim in zip(found.steps, found.steps[1:], found.claims, strict=False):
        drop = held_drop(before.held_out, after.held_out, claim.balance)
        assert drop == pytest.approx(claim.held_out_drop_percent)
        assert drop > LEAST_ADDED_DROP
    assert not any(c.partial for c in found.claims)
    values = found.steps[-1].solution.values
    assert values["inertia"] == pytest.approx(INERTIA, rel=0.02)
    assert values["motor_viscous"] == pytest.approx(VISCOUS, rel=0.1)
    assert values["motor_coulomb"] == pytest.approx(COULOMB, rel=0.05)
    assert all(e.ratio < 1.5 for e in found.final_ratios.values())
    assert found.unexplained == ()
    assert found.learned == ()


def test_no_more_is_added_than_asked_for_and_that_is_said() -> None:
    one = improved(both, 1)
    assert len(one.claims) == 1
    assert one.claims[0].effects[0] == improved(both).claims[0].effects[0]
    assert one.verdict == "unexplained"
    assert "Stopped at the limit of additions (1)" in one.reason
    assert "would be the next" in one.reason
    none = improved(both, 0)
    assert none.claims == ()
    assert len(none.steps) == 1
    assert none.verdict == "unexplained"
    assert "Stopped at the limit of additions (0)" in none.reason
    assert none.learned == ()


def test_nothing_is_named_where_nothing_is_hidden() -> None:
    found = improved(nothing)
    assert found.claims == ()
    assert found.minor == ()
    assert found.verdict == "nothing_missing"
    assert len(found.steps) == 1
    assert found.ranking is not None
    tried = {t.key for t in found.ranking.trials}
    assert tried <= {r.effect for r in found.refused}, "each is refused with its reason"
    assert all(r.why for r in found.refused)
    assert tried.isdisjoint(n.effect for n in found.not_testable)


def test_a_law_without_a_name_is_no_claim_but_a_curve() -> None:
    found = improved(LAWS["bump"][1])
    assert found.verdict == "unexplained"
    assert all(c.partial for c in found.claims) or not found.claims
    assert found.unexplained
    assert found.unexplained[0].axis is not None
    assert found.unexplained[0].axis.endswith("position")


def test_a_diagnosis_is_the_first_decision_of_the_loop() -> None:
    train, held = runs(both)
    session = Session.opened(train, JOINT, held)
    found = session.diagnose(session.start())
    whole = improved(both)
    assert len(found.claims) == 1
    assert found.claims[0].effects[0] == whole.decided[0].effects[0]
    assert found.claims[0].held_out_drop_percent == pytest.approx(
        whole.decided[0].held_out_drop_percent
    )
    assert found.minor == (), "what comes after is not looked for"


def test_progress_goes_from_its_start_to_its_end() -> None:
    told: list[tuple[str, float]] = []
    train, held = runs(wave)
    improve(train, JOINT, [held], progress=lambda text, share: told.append((text, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares), "it never goes back"
    assert min(shares) == shares[0] == 0.05
    assert max(shares) <= 1.0
    texts = [text for text, _ in told]
    for word in ("fitting the start model", "ranking the library", "adding gravity"):
        assert word in texts
    assert texts[-1] == "looking at what is left"
    tries = [share for text, share in told if text.startswith("trying ")]
    again = shares[texts.index("adding gravity") + 1 : -2]
    assert again == pytest.approx([0.2 + 0.6 / MAX_ADDITIONS] * len(again)), "one addition of all"
    assert min(tries) == 0.15
    assert shares[-1] == 0.85


def test_without_held_out_records_a_part_of_each_is_held_out() -> None:
    train, held = runs(wave)
    first, apart, note = with_held_out([train, held], [])
    assert "the last 30 %" in note
    for whole, a, b in zip((train, held), first, apart, strict=True):
        assert len(a) + len(b) == len(whole)
        assert len(a) == pytest.approx(0.7 * len(whole), rel=0.01)
        assert a.time[-1] < b.time[0]
    assert with_held_out([train], [held]) == ([train], [held], "")
    found = improve(train, JOINT)
    assert found.data.note == note
    assert [c.effects[0] for c in found.claims] == ["gravity"]


def test_a_session_needs_a_record() -> None:
    with pytest.raises(InputError, match="no training record"):
        Session.opened([], JOINT)


def test_records_in_unlike_units_are_refused_only_where_the_model_fails() -> None:
    train, held = runs(nothing)
    turned = held.with_channel("motor_position", np.rad2deg(held["motor_position"]))
    session = Session.opened(train, JOINT, turned)
    for error in (50.0, 51.0, float("nan")):
        with pytest.raises(InputError):
            refuse_unlike(session.data, error)
    refuse_unlike(session.data, 49.9)
    refuse_unlike(Session.opened(train, JOINT, held).data, 90.0)
    with pytest.raises(InputError):
        session.run(session.start())
