"""Harmonic-drive models 1 to 4 in configurations 1, 2 and IRJ, and the ladder of models by name."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from casadi_models import JointModel, Signals
from casadi_models.transmission import (
    MODELS,
    port_angles,
    port_torques,
    signed_ratio,
)

N = 160.0


@pytest.mark.parametrize(
    ("configuration", "ratio"), [("1", N + 1), ("2", -N), ("IRJ", -N), (1, N + 1), (2, -N)]
)
def test_ratio_follows_from_the_ports(configuration: str | int, ratio: float) -> None:
    """theta_wg over the output angle with one spline held (2.29)."""
    out = 0.37
    held_fs = port_angles(theta_cs=out, theta_fs=0.0, reduction=N) / out
    held_cs = port_angles(theta_cs=0.0, theta_fs=out, reduction=N) / out
    assert signed_ratio(configuration, N) == pytest.approx(
        held_fs if str(configuration) == "1" else held_cs
    )
    assert signed_ratio(configuration, N) == ratio
    with pytest.raises(ValueError, match="1, 2 or IRJ"):
        signed_ratio("3", N)


def test_all_ports_turn_together() -> None:
    """With both splines locked to each other the gear turns as one block."""
    assert port_angles(0.8, 0.8, N) == pytest.approx(0.8)


def test_ports_keep_power_and_torque() -> None:
    """T_wg = T_cs/(N+1) = T_fs/N (2.31); the ideal gear loses no power and its torques balance."""
    torque = 0.7
    cs, fs = port_torques(torque, N)
    assert torque == pytest.approx(cs / (N + 1))
    assert torque == pytest.approx(fs / N)
    assert torque + fs - cs == pytest.approx(0.0, abs=1e-12)
    rng = np.random.default_rng(0)
    for w_cs, w_fs in rng.uniform(-3, 3, (20, 2)):
        w_wg = port_angles(w_cs, w_fs, N)
        assert torque * w_wg - cs * w_cs + fs * w_fs == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("configuration", ["1", "2", "IRJ"])
@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_every_model_in_every_configuration(number: int, configuration: str) -> None:
    model = JointModel.harmonic_drive(number, configuration=configuration)
    assert model.gear_ratio == (N + 1 if configuration == "1" else -N)
    assert model.is_elastic == (number >= 3)
    values = {"motor_inertia": 4.447, "link_inertia": 10.277} | (
        {"stiffness": 2e4} if number >= 3 else {}
    )
    model = model.with_values(values)
    states = 4 if number >= 3 else 2
    rate = np.array(model.dynamics(np.zeros(states), [10.0, 0, 0], model.value_vector())).ravel()
    expected = 10.0 / 4.447 if number >= 3 else 10.0 / (4.447 + 10.277)
    assert rate[1] == pytest.approx(expected, rel=1e-9)


def test_each_model_contains_what_the_step_adds() -> None:
    assert JointModel.harmonic_drive(1).effects == ()
    assert JointModel.harmonic_drive(2).has("transmission_losses")
    assert JointModel.harmonic_drive(3).has("transmission_compliance")
    four = JointModel.harmonic_drive(4)
    assert sum(t.effect.key == "kinematic_error" for t in four.terms) == 3
    orders = [
        four.values[n]
        for n in ("kinematic_error_order", "kinematic_error_order_2", "kinematic_error_order_3")
    ]
    assert orders == [1.0, 2.0, 4.0]
    with pytest.raises(ValueError, match="1, 2, 3 or 4"):
        JointModel.harmonic_drive(5)


def test_model_2_loses_power_as_equation_2_36_says() -> None:
    model = JointModel.harmonic_drive(2).with_values(
        {
            "motor_inertia": 4.0,
            "link_inertia": 6.0,
            "motor_loss_constant": 5.0,
            "motor_loss_viscous": 7.0,
            "motor_loss_cubic": 0.5,
            "motor_loss_sine": 2.0,
            "motor_loss_cosine": 1.0,
        }
    )
    q, v = 0.4, -0.8
    a = float(model.dynamics([q, v], np.zeros(3), model.value_vector())[1])
    resisting = -(5 + 2 * np.sin(q) + np.cos(q)) + 7 * v + 0.5 * v**3
    assert a == pytest.approx(-resisting / 10, rel=1e-9)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_ladder_by_name(name: str) -> None:
    model = JointModel.by_name(name, -N)
    keys = {label.partition("#")[0].partition("@")[0] for label in MODELS[name]}
    assert keys == {t.effect.key for t in model.terms}
    assert np.isfinite(model.value_vector()).all()
    x = np.zeros(4 if model.is_elastic else 2)
    assert np.isfinite(np.array(model.dynamics(x, np.zeros(3), model.value_vector()))).all()


def test_ladder_grows() -> None:
    sets = {n: set(JointModel.by_name(n, -N).effects) for n in MODELS}
    assert sets["irj1a"] < sets["irj1b"] < sets["irj2b"]
    assert sets["irj2a"] < sets["irj2b"]
    assert sets["hd3"] < sets["hd4"]
    assert not JointModel.by_name("irj1b", -N).is_elastic
    assert JointModel.by_name("irj2a", -N).is_elastic


def test_build_adds_further_effects_once() -> None:
    effects = ("viscous", "stribeck", "transmission_compliance")
    model = JointModel.by_name("hd3", -N, effects=effects)
    assert model.effects.count("transmission_compliance") == 1
    assert {"viscous@motor", "viscous@link", "stribeck@motor"} <= set(model.effects)
    with pytest.raises(KeyError, match="unknown model"):
        JointModel.by_name("hd9", -N)


def test_model_4_exact_and_approximate() -> None:
    """Exact: the motor also feels -T d(err)/d(q_m); approximate (2.58): it does not."""
    values = {
        "motor_inertia": 4.447,
        "link_inertia": 10.277,
        "stiffness": 2e4,
        "kinematic_error_sine": 1e-4,
    }
    exact = JointModel.harmonic_drive(4).with_values(values)
    approximate = replace(exact, virtual_work=False)
    q, twist = 0.3, 1.5e-3
    x = np.array([q + twist, 0.0, q, 0.0])
    angle = -N * x[0]
    torque = 2e4 * (twist - 1e-4 * np.sin(angle))
    slope = 1e-4 * -N * np.cos(angle)
    rates = [
        np.array(m.dynamics(x, np.zeros(3), m.value_vector())).ravel() for m in (exact, approximate)
    ]
    assert rates[0][1] == pytest.approx(-torque * (1 - slope) / 4.447, rel=1e-9)
    assert rates[1][1] == pytest.approx(-torque / 4.447, rel=1e-9)
    assert rates[0][3] == pytest.approx(rates[1][3], rel=1e-12)
    assert rates[0][3] == pytest.approx(torque / 10.277, rel=1e-9)


def test_kinematic_error_is_periodic_in_the_motor_angle() -> None:
    model = JointModel.harmonic_drive(4).with_values(
        {"kinematic_error_sine": 1e-4, "kinematic_error_cosine_3": 4e-5}
    )
    e = model.equations
    f = ca.Function("d", [e.signals.vector(), e.parameters], [e.torsion])

    def torsion(q: float) -> float:
        at = dict.fromkeys(Signals.names(), 0.0) | {"motor_position": q, "link_position": q}
        return float(f(list(at.values()), model.value_vector()))

    turn = 2 * np.pi / N
    assert torsion(0.1) == pytest.approx(torsion(0.1 + turn), abs=1e-15)
    assert abs(torsion(0.1) - torsion(0.1 + turn / 3)) > 1e-5
