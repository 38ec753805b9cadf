"""Online rows of laws that are fast beside the kernel, held against a simulated joint: with the
true values nothing is left.
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from casadi_models.affine import settled
from casadi_models.simulate import simulate
from identification.balance.weak import differentiated_kernel
from identification.online.options import OnlineOptions, held_parameters, prepared
from identification.online.rows import RowMaker
from irj_fmu.effect_table import joint_with

DT = 1e-3
SECONDS = 3.0


def _share_left(label: str) -> dict[str, float]:
    """By balance, what the true values leave of the torque."""
    joint = replace(joint_with(label), torque_per_current=None)
    true = joint.model()
    t = np.arange(round(SECONDS / DT)) * DT
    drive = 90.0 * np.sin(2 * np.pi * 0.7 * t) + 40.0 * np.sin(2 * np.pi * 3.1 * t)
    q_m, _, q_l, _, torque = simulate(true, drive, DT).readings.T
    model, sensing = prepared(joint, OnlineOptions())
    rows = RowMaker(model, sensing, DT, held_parameters(joint))
    table = np.column_stack([q_m, q_l, torque, drive])
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    theta = np.array([values[n] for n in rows.names])
    size, stride = rows.timing.window, rows.timing.stride
    table = np.vstack([np.repeat(table[:1], size, axis=0), table])  # at rest before
    left, whole = [], []
    for k in range(stride, len(t), stride):
        made = rows.make(table[k : k + size], t[k - 1])
        if made is not None and t[k] > 0.5:
            left.append(made[0] - made[1] @ theta)
            whole.append(made[0])
    share = np.sqrt(np.mean(np.square(left), axis=0) / np.mean(np.square(whole), axis=0))
    return dict(zip(rows.balances, share.tolist(), strict=True))


@pytest.mark.parametrize(
    ("label", "balance", "limit"),
    [
        # line of up to 70 Hz in the twist, and its damping
        ("kinematic_error@torsion", "transmission", 1e-5),
        # knocks in the gap; the stiffness jumps between samples
        ("backlash@transmission", "transmission", 5e-4),
        # its own 12 Hz, which a 30 ms smoothing would take 4 % off
        ("flexible_mode@link", "link", 1e-3),
        # the sensor twists with the torque: first order in 0.5 ms times the frequency
        ("torque_sensor_compliance@torsion", "transmission", 1e-3),
    ],
)
def test_true_values_leave_nothing(label: str, balance: str, limit: float) -> None:
    assert _share_left(label)[balance] < limit


@pytest.mark.parametrize(("dt", "step"), [(1e-3, 2), (5e-4, 4), (7e-4, 3), (2e-3, 1)])
@pytest.mark.parametrize("order", [0, 1])
def test_kernel_of_every_so_many_samples_is_the_same_kernel(
    dt: float, step: int, order: int
) -> None:
    fine = differentiated_kernel(0.06, dt, order)
    coarse = differentiated_kernel(0.06, dt, order, step)

    def of(weights: np.ndarray, period: float, omega: float) -> float:
        at = (np.arange(len(weights)) - len(weights) // 2) * period
        return float(weights @ (np.sin(omega * at) if order else np.cos(omega * at)))

    for omega in (10.0, 60.0, 150.0, 250.0):
        assert of(coarse, dt * step, omega) == pytest.approx(
            of(fine, dt, omega), abs=1e-3 * (omega if order else 1.0)
        )


def test_comparisons_of_parameters_are_settled_and_those_of_signals_are_not() -> None:
    p, x = ca.SX.sym("p", 2), ca.SX.sym("x")
    law = ca.vertcat(p[0] * x * (p[1] > 0), ca.sin(x) * (x > p[1]), ca.SX(0), p[1] ** 2 / p[0])
    for values in ([3.0, 2.0], [3.0, -2.0]):
        found = settled(law, p, values)
        here = ca.Function("here", [p, x], [found])
        there = ca.Function("there", [p, x], [law])
        for at in (-5.0, 0.5, 5.0):
            np.testing.assert_allclose(np.array(here(values, at)), np.array(there(values, at)))
    zero = ca.Function("zero", [p, x], [settled(law, p, [1.0, 1.0])])([2.0, 0.0], 3.0)
    assert float(zero[0]) == pytest.approx(6.0)  # decided above zero, whatever is put in later
    assert float(zero[1]) == pytest.approx(np.sin(3.0))
