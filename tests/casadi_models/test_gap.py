"""A gap is in series with the rest of the transmission: inside it nothing touches."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_models import JointModel
from casadi_models.energy import total_energy

K, C, K3, GAP = 2.0e4, 40.0, 3.0e8, 1.0e-3


def transmitted(model: JointModel, twist: float, rate: float) -> float:
    """Torque that the transmission carries [N.m]."""
    e = model.true_equations
    s = e.signals
    names = [s.motor_position, s.motor_velocity, s.link_position, s.link_velocity]
    found = ca.Function("t", [*names, e.parameters], [e.transmitted])
    return float(found(0.3 + twist, 0.1 + rate, 0.3, 0.1, model.value_vector()))


def joint(loss: float) -> JointModel:
    model = JointModel.harmonic_drive(3).add("backlash").add("cubic_stiffness")
    return model.with_values(
        {
            "stiffness": K,
            "structural_damping": C,
            "cubic_stiffness": K3,
            "backlash": GAP,
            "backlash_stiffness_loss": loss,
        }
    )


@pytest.mark.parametrize("rate", [0.0, 0.02, -0.02])
@pytest.mark.parametrize("twist", [-2.5e-3, -0.9e-3, 0.0, 0.4e-3, 1.7e-3])
def test_beyond_the_gap_spring_and_damper_act_and_inside_nothing_does(
    twist: float, rate: float
) -> None:
    beyond = twist - float(np.clip(twist, -GAP, GAP))
    carried = K * beyond + K3 * beyond**3 + (C * rate if beyond else 0.0)
    assert transmitted(joint(K), twist, rate) == pytest.approx(carried, abs=1e-9)


def test_a_gap_that_is_absent_takes_up_nothing() -> None:
    carried = K * 4e-4 + K3 * 4e-4**3 + C * 0.02
    assert transmitted(joint(0.0), 4e-4, 0.02) == pytest.approx(carried, rel=1e-12)


def test_stiffness_damping_and_loss_still_enter_linearly() -> None:
    found = joint(K).linear_parameters
    assert {"stiffness", "structural_damping", "backlash_stiffness_loss"} <= set(found)


@pytest.mark.parametrize("start", [0.4e-3, 2.2e-3])
def test_energy_is_kept_without_damping(start: float) -> None:
    """Power into the spring beyond the gap is what its energy rises by."""
    model = joint(K).with_values({"structural_damping": 0.0})
    e = model.true_equations
    s = e.signals
    energy = ca.Function("e", [s.motor_position, s.link_position, e.parameters], [e_of(model)])
    step = 1e-7
    rise = (
        float(energy(0.3 + start + step, 0.3, model.value_vector()))
        - float(energy(0.3 + start - step, 0.3, model.value_vector()))
    ) / (2 * step)
    assert rise == pytest.approx(transmitted(model, start, 0.0), rel=1e-5, abs=1e-6)


def e_of(model: JointModel) -> ca.SX:
    """Energy at rest."""
    s = model.true_equations.signals
    still = [s.motor_velocity, s.link_velocity]
    return ca.substitute([total_energy(model)], still, [ca.SX(0)] * 2)[0]
