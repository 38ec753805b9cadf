"""Every set of sensors with a balance of its own is fitted and diagnosed; what it cannot show is
said.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import numpy as np
import pytest

from identification import Joint, Record, diagnose, fit, improve
from identification.errors import InputError
from tests.recorded_world import sensors, world
from workbench.show.words import printed

CHANNELS: Final = {
    "current": "motor_current",
    "motor": "motor_position",
    "link": "link_position",
    "torque": "link_torque",
}
SETS: Final[dict[tuple[str, ...], str]] = {
    ("current", "motor"): "both",
    ("current", "link"): "both",
    ("current", "motor", "link"): "both",
    ("current", "motor", "torque"): "motor",
    ("current", "link", "torque"): "both",
    ("motor", "link", "torque"): "link",
    ("link", "torque"): "link",
    ("current", "motor", "link", "torque"): "both",
}
"""Sets of sensors, and the side whose friction they show."""
BLIND: Final = [("current", "torque"), ("current",), ("motor",)]
"""Sets without a balance: no position, or no torque and one position."""


@cache
def case(hidden: tuple[str, ...], seconds: float = 12.0) -> world.Case:
    """One joint, recorded without any trouble."""
    return world.make_case(
        11,
        without=world.TROUBLES,
        seconds=seconds,
        names=hidden,
        kind="single" if hidden else "none",
        size=1.0,
        make="cobot100",
        motion="multisine",
    )


def records(given: tuple[str, ...], hidden: tuple[str, ...], seconds: float = 12.0) -> list[Record]:
    made = case(hidden, seconds)
    return [
        Record.from_channels(
            made.time[name],
            {
                CHANNELS[s]: made.measured[name][:, sensors.CHANNELS.index(CHANNELS[s])]
                for s in given
            },
            name=name,
        )
        for name in world.RECORDS
    ]


def joint(given: tuple[str, ...], effects: tuple[str, ...]) -> Joint:
    plain = case(()).joint
    return Joint(
        name="bench",
        gear_ratio=plain.gear_ratio,
        torque_per_current=plain.make.per_current * plain.sign,
        model_name="hd3" if {"motor", "link"} <= set(given) else "hd1",
        effects=effects,
    )


@pytest.mark.parametrize("given", SETS, ids="+".join)
def test_nothing_is_named_where_nothing_is_hidden(given: tuple[str, ...]) -> None:
    train, held = records(given, ())
    found = improve(train, joint(given, ("viscous", "coulomb", "gravity")), [held])
    assert found.claims == ()
    # without the motor's position its twist against the link is structure that nobody sees
    hidden_twist = "motor" not in given and "current" in given
    assert found.verdict == ("unexplained" if hidden_twist else "nothing_missing")


@pytest.mark.parametrize("given", SETS, ids="+".join)
def test_coulomb_friction_is_named(given: tuple[str, ...]) -> None:
    """The joint file lacks it on both sides; the motor has next to all of it."""
    train, held = records(given, ("coulomb",))
    found = improve(train, joint(given, ("viscous", "gravity")), [held])
    assert found.claims
    assert {c.effects for c in found.claims if len(c.effects) == 1} == {("coulomb",)}


@pytest.mark.parametrize("hidden", [(), pytest.param(("quadratic_drag",), marks=pytest.mark.slow)])
def test_what_a_coarse_encoder_hides_is_seen_in_longer_rows(hidden: tuple[str, ...]) -> None:
    """With the encoder the answer was that nothing is missing, and without it the law was found."""
    given, step = ("current", "motor", "link"), 2 * math.pi / 2**12
    train, held = (
        r.with_channel("link_position", np.round(r["link_position"] / step) * step)
        for r in records(given, hidden, 24.0)
    )
    model = joint(given, ("viscous", "coulomb", "gravity"))
    found = improve(train, model, [held])
    if not hidden:
        assert (found.claims, found.verdict) == ((), "nothing_missing")
        return
    (claim,) = found.claims
    assert hidden[0] in claim.effects
    assert claim.kernel in (0.12, 0.24), "the short rows show nothing"
    assert claim.as_json()["kernel_s"] == claim.kernel
    assert f"in rows of {claim.kernel:g} s" in found.reason
    assert f"of rows of {claim.kernel:g} s" in printed(found)
    assert diagnose(fit(model, [train]), [held]).claims[0].kernel == claim.kernel


def test_what_stands_in_no_balance_keeps_its_value_and_is_said() -> None:
    given = ("current", "motor", "torque")
    train, held = records(given, ())
    found = improve(train, joint(given, ("viscous", "coulomb", "gravity")), [held])
    table = found.as_json()["steps"][-1]["parameters"]
    assert not table["link_inertia"]["identifiable"]
    assert table["link_inertia"]["value"] == 1.0
    assert table["motor_inertia"]["identifiable"]
    true = case(()).joint.values["JM"]
    assert table["motor_inertia"]["value"] == pytest.approx(true, rel=0.02)
    assert any(w.startswith("link_inertia, ") and "keep" in w for w in found.warnings)


@pytest.mark.parametrize("given", BLIND, ids="+".join)
def test_a_set_without_a_balance_is_refused_with_what_is_missing(given: tuple[str, ...]) -> None:
    train, held = records(given, ())
    with pytest.raises(InputError, match=r"record one|measure it|add one|needs one"):
        improve(train, joint(given, ("viscous",)), [held])


def test_two_positions_alone_have_a_balance_of_angles_and_claim_nothing() -> None:
    train, held = records(("motor", "link"), ())
    found = improve(train, joint(("motor", "link"), ("viscous", "coulomb", "gravity")), [held])
    assert list(found.final_ratios) == ["kinematic"]
    assert found.claims == ()
