"""A torque on the link that is known from elsewhere: taken away by its channel, with its noise
in the floor.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import pytest

from casadi_models import JointModel
from casadi_models.equations import inverse_dynamics
from identification import Joint, Record, fit
from identification.balance.balances import balances_of, residual_expressions
from identification.balance.sensing import sense
from identification.errors import InputError
from identification.fitting.engine import floors, stack
from identification.planning.follow import Controller, Follower

RATIO, DT = 100.0, 2e-3
EFFECTS = ("viscous", "coulomb", "gravity")
TRUE = {
    "motor_inertia": 3.0,
    "link_inertia": 5.0,
    "stiffness": 2e4,
    "structural_damping": 40.0,
    "motor_viscous": 9.0,
    "link_viscous": 2.0,
    "motor_coulomb": 12.0,
    "link_coulomb": 1.5,
    "gravity_torque": 60.0,
    "motor_smoothing_velocity": 0.005,
    "link_smoothing_velocity": 0.005,
}
ELASTIC = Joint(name="arm", gear_ratio=RATIO, model_name="hd3", effects=EFFECTS)
RIGID = Joint(name="arm", gear_ratio=RATIO, model_name="hd1", effects=EFFECTS)


def channels() -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Time, readings of a joint on which nothing acts, and a coupling torque such as other axes
    cause.
    """
    rng = np.random.default_rng(3)
    t = np.arange(round(16.0 / DT)) * DT
    w, a = 2 * np.pi * np.array([0.13, 0.41, 0.9]), np.array([0.5, 0.2, 0.05])
    angle = w[:, None] * t + rng.uniform(0, 2 * np.pi, 3)[:, None]
    path = np.column_stack(
        [a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)]
    )
    model = JointModel.by_name("hd3", RATIO, effects=EFFECTS).with_values(TRUE)
    run = Follower(model, DT, controller=Controller(25.0, 0.9), substeps=8).run(path)
    noise = {
        "motor_position": 1e-6 * RATIO,
        "link_position": 1e-6,
        "link_torque": 0.02,
        "motor_torque": 0.05 / RATIO,
    }
    out = {
        "motor_position": run.states[:, 0] * RATIO,
        "link_position": run.states[:, 2],
        "link_torque": run.torque,
        "motor_torque": run.drive / RATIO,
    }
    out = {c: v + rng.normal(0, noise[c], len(t)) for c, v in out.items()}
    return t, out, 15.0 * np.sin(2.2 * t) + 6.0 * np.sin(7.0 * t + 1.0)


def parameters(joint: Joint, time: np.ndarray, table: Mapping[str, np.ndarray]) -> dict[str, float]:
    fitted = fit(joint, Record.from_channels(time, dict(table), name="run"))
    return {n: p["value"] for n, p in fitted.parameters.items() if not p["nuisance"]}


def test_on_the_link_balance_the_channel_takes_it_away() -> None:
    """The motion is the same where the gear carries what the coupling does not: torque sensor
    and drive read that much less.
    """
    t, table, coupling = channels()
    loaded = {
        **table,
        "link_torque": table["link_torque"] - coupling,
        "motor_torque": table["motor_torque"] - coupling / RATIO,
    }
    only = ("link_position", "link_torque", "motor_torque")
    plain = parameters(RIGID, t, {c: table[c] for c in only})
    assert plain["gravity_torque"] == pytest.approx(TRUE["gravity_torque"], rel=0.01)
    told = {**{c: loaded[c] for c in only}, "coupling_torque": coupling}
    known = parameters(RIGID, t, told)
    lost = parameters(RIGID, t, {c: loaded[c] for c in only})
    # at the same values both leave the same in every row; a clock that is off shifts what the
    # sensor reads and not what is told, so the clocks stand at zero
    whole = fit(RIGID, Record.from_channels(t, {c: table[c] for c in only}, name="run"))
    apart = fit(RIGID, Record.from_channels(t, told, name="run"))
    clocks = {n: 0.0 for n in whole.solution.values if "skew" in n}
    at = {**whole.solution.values, **clocks}
    left = [
        stack(balances_of(f.model, f.data.sensing, wrt=()), f.data.train, at)
        for f in (whole, apart)
    ]
    for balance, rows in left[0].residual.items():
        np.testing.assert_allclose(left[1].residual[balance], rows, rtol=0, atol=1e-9)
    # the column of the sensor's clock is the rate of what it reads, another one in each: what is
    # fitted to it is noise, and moves the rest within its bands
    for name, value in plain.items():
        stderr = whole.solution.stderr[name]
        assert stderr is not None
        assert abs(known[name] - value) < 0.5 * stderr, name
    assert abs(lost["link_inertia"] - plain["link_inertia"]) > 0.02 * plain["link_inertia"]


def test_on_the_balance_of_an_axis_the_channel_takes_it_away() -> None:
    t, table, coupling = channels()
    one = {c: table[c] for c in ("motor_position", "motor_torque")}
    axis = Joint(name="axis", gear_ratio=1.0, model_name="hd1", effects=EFFECTS)
    one = {
        "motor_position": one["motor_position"] / RATIO,
        "motor_torque": one["motor_torque"] * RATIO,
    }
    fitted = fit(axis, Record.from_channels(t, one, name="run"))
    plain = parameters(axis, t, one)
    known = parameters(
        axis,
        t,
        {**one, "motor_torque": one["motor_torque"] - coupling, "coupling_torque": coupling},
    )
    for name, value in plain.items():
        stderr = fitted.solution.stderr[name]
        assert stderr is not None
        # the level of noise is that of what the sensor reads, as above
        assert abs(known[name] - value) < 0.01 * stderr, name


@pytest.mark.parametrize("name", ["hd1", "hd3"])
def test_every_balance_of_the_link_holds_it_with_its_sign(name: str) -> None:
    """d residual / d coupling torque: 1 where the link's torques are balanced, 0 elsewhere."""
    t, table, coupling = channels()
    model = JointModel.by_name(name, RATIO, effects=EFFECTS)
    expected = {
        "motor": 0.0,
        "link": 1.0,
        "transmission": 0.0,
        "sum": 1.0,
        "deflection": 0.0,
        "axis": 1.0,
    }
    for left_out in ((), ("link_torque",)):
        record = Record.from_channels(
            t, {c: v for c, v in table.items() if c not in left_out}, name="run"
        )
        for balance, residual in residual_expressions(model, sense(record, model)).items():
            slope = ca.jacobian(residual, model.equations.signals.coupling_torque)
            assert float(ca.DM(ca.simplify(slope))) == expected[balance]


@pytest.mark.parametrize(
    "model",
    [
        JointModel.by_name("hd1", RATIO, effects=EFFECTS),
        JointModel.by_name("hd3", RATIO, effects=EFFECTS),
    ],
)
def test_regressor_and_dynamics_agree_and_a_simulation_feels_none(model: JointModel) -> None:
    """The coupling torque drives the link: its slope in the inverse dynamics is -1 in the row
    of the link.
    """
    slope = ca.jacobian(inverse_dynamics(model), model.equations.signals.coupling_torque)
    assert np.array(ca.DM(slope)).ravel()[-1] == -1.0
    functions = model.functions
    rng = np.random.default_rng(1)
    values = np.array([TRUE.get(p.name, 0.7) for p in model.parameters])
    x = rng.normal(0, 0.1, len(functions.state_names))
    u = np.array([20.0, 0.0, 0.0])
    rates = np.array(functions.dynamics(x, u, values)).ravel()
    matrix, rest = functions.regressor(x, rates[1::2], u, values)
    linear = [values[model.parameter_names.index(n)] for n in model.linear_parameters]
    found = (np.array(matrix) @ linear + np.array(rest).ravel()).ravel()
    assert found == pytest.approx([20.0, 0.0][: len(found)], abs=1e-9)


def test_its_noise_is_in_the_floor() -> None:
    t, table, coupling = channels()
    rng = np.random.default_rng(8)
    only = {c: table[c] for c in ("link_position", "link_torque", "motor_torque")}
    levels = []
    for noise in (0.0, 1.0):
        record = Record.from_channels(
            t, {**only, "coupling_torque": coupling + rng.normal(0, noise, len(t))}, name="run"
        )
        fitted = fit(RIGID, record)
        levels.append(floors(fitted.model, fitted.data, fitted.solution.values)["link"])
    # white noise averaged by the balance's kernel, beside what was there
    kernel = fitted.data.train[0].grid
    from identification.balance.weak import differentiated_kernel

    expected = float(np.linalg.norm(differentiated_kernel(kernel.length, kernel.dt, 0)))
    assert np.sqrt(levels[1] ** 2 - levels[0] ** 2) == pytest.approx(expected, rel=0.1)


def test_records_of_one_fit_all_have_it_or_none() -> None:
    t, table, coupling = channels()
    only = {c: table[c] for c in ("link_position", "link_torque", "motor_torque")}
    first = Record.from_channels(t, {**only, "coupling_torque": coupling}, name="first")
    other = Record.from_channels(
        t, {**only, "link_torque": only["link_torque"] + 1e-3}, name="other"
    )
    with pytest.raises(InputError, match="coupling_torque"):
        fit(RIGID, [first, other])
