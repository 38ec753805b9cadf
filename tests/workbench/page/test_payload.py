"""What another payload does to the parameters of a model."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("starlette")

from casadi_models.term import TOTAL_INERTIA
from identification.data.joint_file import parse_joint
from identification.errors import InputError
from workbench.page.charts.payload import with_payload


def test_a_point_mass_adds_its_inertia_and_its_weight_where_the_link_hangs() -> None:
    """The torque of the sum at any angle is that of the link plus m g r along the same vertical."""
    joint = parse_joint(
        {"joint": {"gear_ratio": -100.0, "model": "hd3", "effects": ["gravity"]}}, "j"
    )
    model = joint.model()
    values = {**dict.fromkeys(model.parameter_names, 1.0), "link_inertia": 10.0}
    values |= {"gravity_torque": -30.0, "gravity_cosine": 40.0}
    moved = with_payload(model, values, 2.0, 0.5)
    assert moved["link_inertia"] == pytest.approx(10.5)
    angle = np.linspace(-3.0, 3.0, 7)
    torque = [
        v["gravity_torque"] * np.sin(angle) + v["gravity_cosine"] * np.cos(angle)
        for v in (values, moved)
    ]
    level = math.atan2(
        -30.0, 40.0
    )  # where the link lies level, and the weight pulls with all of it
    np.testing.assert_allclose(
        torque[1] - torque[0], 2.0 * 9.80665 * 0.5 * np.cos(angle - level), rtol=1e-12, atol=1e-12
    )
    assert "motor_inertia" not in moved
    back = with_payload(model, {**values, **moved}, -2.0, 0.5)
    assert {n: values[n] for n in back} == pytest.approx(back)
    with pytest.raises(InputError, match="no inertia left"):
        with_payload(model, values, -50.0, 0.5)


def test_a_linear_axis_carries_the_mass_itself() -> None:
    table = {"gear_ratio": 1.0, "kind": "linear", "model": "hd1"}
    model = parse_joint({"joint": table}, "j").model()
    name = "link_inertia" if "link_inertia" in model.inertias else TOTAL_INERTIA[0]
    values = dict.fromkeys((*model.parameter_names, name), 3.0)
    assert with_payload(model, values, 2.0, 0.0) == {name: 5.0}
