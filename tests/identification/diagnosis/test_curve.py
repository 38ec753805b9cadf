"""Curve first: a law that no name fits is located, drawn with a band that covers it, and
predicts as well as the law itself.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from smooth_laws import COULOMB, LAWS, VISCOUS, FloatArray, Law, Run, nothing, run

from casadi_models.table import KNOTS, Table, bump, heaped
from identification.diagnosis.curve import Located, curves_on, gain, steadily_moving
from identification.diagnosis.trials import make_base


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    return {name: run(71 + k, law) for k, (name, (_, law)) in enumerate(LAWS.items())}


def whole(found: Located, law: Law) -> FloatArray:
    """The true torque over the variable of the first curve."""
    curve, zero = found.curves[0], np.zeros(len(found.curves[0].x))
    speed = curve.axis == "motor_velocity"
    known = (COULOMB + (VISCOUS * curve.x if speed else 0.0)) if curve.by_direction else 0.0
    return np.asarray(known + (law(zero, curve.x) if speed else law(curve.x, zero + 1)))


@pytest.mark.parametrize("name", LAWS)
def test_the_variable_of_a_hidden_law_is_found(name: str, runs: dict[str, Run]) -> None:
    found = runs[name].found
    assert [c.label for c in found.curves][:1] == [LAWS[name][0] + "@motor"]
    assert all(c.gain.fall >= 0.02 and c.gain.t >= 3 for c in found.curves)


def test_the_band_covers_the_true_curves(runs: dict[str, Run]) -> None:
    inside, width = [], []
    for name, (_, law) in LAWS.items():
        curve, true = runs[name].found.curves[0], whole(runs[name].found, law)
        inside.append(np.mean((curve.low <= true) & (true <= curve.high)))
        width.append(np.median(curve.high - curve.low) / np.ptp(law(curve.x, curve.x)))
    assert np.mean(inside) >= 0.9
    assert max(width) < 0.15, "a band that covers by being wide says nothing"


@pytest.mark.parametrize("name", LAWS)
def test_it_predicts_like_the_true_law(name: str, runs: dict[str, Run]) -> None:
    """The same noise without the law, fitted with the model that made it, leaves what the true
    law would leave.
    """
    without = run(71 + list(LAWS).index(name), nothing)
    before, after = runs[name].found.held_out_rms
    assert after <= 1.2 * without.found.held_out_rms[0]
    assert after < 0.7 * before


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_found_where_nothing_is_hidden(seed: int) -> None:
    assert run(900 + seed, nothing).found.curves == ()


def test_a_gain_needs_more_than_one_block() -> None:
    before = np.ones(40)
    one = before.copy()
    one[3] = 0.0
    assert not gain(before, one).is_certain
    assert gain(before, 0.9 * before + 1e-3 * np.arange(40) % 3).is_certain


# --- the table itself -----------------------------------------------------------------------------


def test_bumps_are_a_smooth_partition_of_one() -> None:
    t = np.linspace(-3, 3, 601)
    b = np.array([float(bump(x)) for x in t])
    assert sum(float(bump(0.3 + k)) for k in range(-4, 5)) == pytest.approx(1.0, abs=1e-14)
    assert np.max(np.abs(np.gradient(np.array([float(heaped(x)) for x in t]), t) - b)) < 1e-3
    assert np.all(b[np.abs(t) >= 2] == 0)


def test_a_table_over_speed_goes_on_as_a_line() -> None:
    table = Table("velocity", "s", of_speed=True, odd=True)
    x = ca.SX.sym("x")
    rng = np.random.default_rng(0)
    p = SimpleNamespace(
        **dict(zip(table.controls, rng.standard_normal(KNOTS).tolist(), strict=True)), s_reach=2.0
    )
    f = ca.Function("f", [x], [table.value(x, p)])
    y = np.array(f(np.array([[1.0, 2.0, 3.0, 4.0]]))).ravel()
    assert y[2] - y[1] == pytest.approx(y[1] - y[0]) == pytest.approx(y[3] - y[2])


def test_a_joint_that_never_moves_steadily_has_no_curve(runs: dict[str, Run]) -> None:
    found = runs["bump"]
    moving = steadily_moving(make_base(found.solution, found.data))
    still = replace(moving, block=np.full_like(moving.block, -1))
    told = curves_on(still, "axis", most=1, certain=False)
    assert told.curves == ()
    assert len(told.before) == len(told.after) == 0


def test_a_number_that_no_row_tells_stays_and_does_not_disturb(runs: dict[str, Run]) -> None:
    found = runs["bump"]
    moving = steadily_moving(make_base(found.solution, found.data))
    values = {**moving.solution.values, "gravity_torque": 5.0}
    untold = replace(
        moving,
        jacobian=np.column_stack([moving.jacobian, np.zeros(len(moving.residual))]),
        held_jacobian=np.column_stack([moving.held_jacobian, np.zeros(len(moving.held_residual))]),
        names=(*moving.names, "gravity_torque"),
        norms=np.append(moving.norms, 1.0),
        solution=replace(moving.solution, values=values),
    )
    (plain,), beside = curves_on(moving, "axis").curves, curves_on(untold, "axis")
    assert beside.base_values["gravity_torque"] == 5.0
    np.testing.assert_allclose(beside.curves[0].y, plain.y, atol=1e-6)
    assert np.all(np.isfinite(beside.curves[0].high))
