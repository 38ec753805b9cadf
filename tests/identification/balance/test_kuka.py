"""A real six-axis robot with second encoders: zeros and skews of axes 1 to 3 beside physics that
hardly shows the stiffness (`kuka_kr300/README.md` has the values of its owners).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from identification import Improvement, Joint, Record, improve

FOLDER = Path(__file__).resolve().parents[4] / "shared" / "measurements" / "kuka_kr300"
RATIOS = {1: 256.857142857, 2: 267.428571429, 3: 252.333333333}
SKEWS = {1: 2.9e-3, 2: 2.7e-3, 3: 2.7e-3}
ZEROS = {1: -1.4e-3, 2: -0.7e-3}
"""Reading of the link encoder less that of the motor; the README counts the twist. That of axis 3
hangs on its stiffness: the owners' is less than half of that under which the README has it."""

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="shared recordings are not there")


def run(name: str, axis: int) -> Record:
    table = np.genfromtxt(FOLDER / f"{name}.csv", delimiter=",", names=True)
    column = {
        c: table[f"axis{axis}_{c}"]
        for c in ("motor_torque_Nm", "motor_position_link_referred_deg", "link_encoder_deg")
    }
    motor = np.radians(column["motor_position_link_referred_deg"]) * RATIOS[axis]
    return Record.from_channels(
        np.arange(len(table)) * 4e-3,
        {
            "motor_torque": column["motor_torque_Nm"],
            "motor_position": motor,
            "link_position": np.radians(column["link_encoder_deg"]),
        },
        name=name,
    )


@cache
def improved(axis: int) -> Improvement:
    joint = Joint(
        name=f"axis {axis}", gear_ratio=RATIOS[axis], model_name="hd3", effects=("viscous",)
    )
    return improve([run("A", axis), run("B", axis)], joint, [run("C", axis)])


@pytest.mark.parametrize("axis", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_zeros_and_skews_are_those_of_the_owners(axis: int) -> None:
    found = improved(axis).calibration
    for skew in (c for c in found if c.what == "skew"):
        assert skew.value == pytest.approx(SKEWS[axis], abs=0.5e-3)
    for zero in (c for c in found if c.what == "zero"):
        assert axis not in ZEROS or zero.value == pytest.approx(ZEROS[axis], abs=0.3e-3)


@pytest.mark.parametrize(
    ("axis", "owners"),
    [
        (1, 4.5778e6),
        pytest.param(2, 7.5189e6, marks=pytest.mark.slow),
        pytest.param(3, 4.0999e6, marks=pytest.mark.slow),
    ],
)
def test_stiffness_is_of_the_right_order_or_said_not_to_be_told(axis: int, owners: float) -> None:
    solution = improved(axis).steps[-1].solution
    if "stiffness" in solution.unidentified:
        return
    error = solution.stderr["stiffness"]
    assert error is not None
    assert 1 / 3 < solution.values["stiffness"] / owners < 3
    assert error < 0.5 * solution.values["stiffness"]


@pytest.mark.slow
def test_gravity_is_named_on_axes_two_and_three_and_coulomb_friction_on_one() -> None:
    assert improved(1).claims[0].effects[0] == "coulomb"
    for axis in (2, 3):
        assert improved(axis).claims[0].effects[0] == "gravity"
        assert ("coulomb",) in [c.effects for c in improved(axis).claims]
