"""Joint files written before an effect had all the parameters it has now."""

from __future__ import annotations

from identification.data.joint_file import parse_joint

OLD = {
    "joint": {"gear_ratio": -160.0, "model": "hd1", "effects": ["viscous", "gravity"]},
    "fitted": {
        "total_inertia": {"value": 14.0},
        "gravity_torque": {"value": 105.0},
    },
}


def test_a_coefficient_the_file_could_not_have_is_zero() -> None:
    """Gravity was a sine alone: the model that the values belong to has no cosine."""
    joint = parse_joint(OLD)
    assert joint.fitted["gravity_cosine"] == 0.0
    assert "motor_viscous" not in joint.fitted, "a value that was not fitted stays unknown"


def test_it_is_no_value_where_the_effect_was_not_fitted_or_has_one() -> None:
    bare = parse_joint({"joint": OLD["joint"]})
    assert bare.fitted == {}
    given = {**OLD["fitted"], "gravity_cosine": {"value": -3.0}}
    assert parse_joint({**OLD, "fitted": given}).fitted["gravity_cosine"] == -3.0


def test_the_elements_of_an_older_hysteresis_stand_as_they_did() -> None:
    """Their widths were 1, 3 and 9 times the first: a fit of that time is still all known."""
    effects = ["structural_damping", "hysteresis"]
    fitted = {f"hysteresis_torque_{k}": {"value": 2.0} for k in (1, 2, 3)}
    fitted["hysteresis_width"] = {"value": 1e-4}
    joint = parse_joint(
        {"joint": {**OLD["joint"], "model": "hd3", "effects": effects}, "fitted": fitted}
    )
    assert joint.fitted["hysteresis_spread"] == 3.0
