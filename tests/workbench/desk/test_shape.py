"""A learned curve as a law in one line: the form it was drawn from, with units that the parser of
typed laws takes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette")

from casadi_models.text.typed_law import TypedLaw, derived_key, register
from identification.errors import InputError
from workbench.page.desk.shape import nearest

SPEED = np.linspace(0.01, 2.0, 60)
ANGLE = np.linspace(-1.5, 1.0, 60)
TWIST = np.linspace(-0.01, 0.012, 60)
LOAD = np.linspace(1.0, 90.0, 60)

CURVES: dict[str, tuple[str, str, np.ndarray, np.ndarray, str]] = {
    "viscous": ("learned_velocity@motor", "rad/s", SPEED, 7 * SPEED, "c*v"),
    "drag": ("learned_velocity@link", "rad/s", SPEED, 3 * SPEED**2, "c*v*abs(v)"),
    "saturation": (
        "learned_velocity@motor",
        "m/s",
        SPEED,
        40 * np.tanh(SPEED / 0.3),
        "c*tanh(v/w)",
    ),
    "low speed": (
        "learned_velocity@motor",
        "rad/s",
        SPEED,
        50 * SPEED * np.exp(-SPEED / 0.2),
        "c*v*exp(-abs(v)/w)",
    ),
    "even": ("learned_velocity_even@motor", "rad/s", SPEED, 2 * SPEED**2, "c*v^2"),
    "spring": ("learned_position@link", "rad", ANGLE, 3 + 5 * ANGLE, "c + d*q"),
    "bump": (
        "learned_position_friction@motor",
        "rad",
        ANGLE,
        8 * np.exp(-(((ANGLE - 0.3) / 0.2) ** 2)),
        "(c*exp(-((q - m)/w)^2))*direction",
    ),
    "twist": (
        "learned_torsion#1",
        "rad",
        TWIST,
        2e4 * TWIST + 4e8 * TWIST**3,
        "c*twist + d*twist^3",
    ),
    "load": ("learned_load_friction@motor", "N.m", LOAD, 0.05 * LOAD, "(c*abs(load))*direction"),
}


def claim(label: str, unit: str, x: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    of = {"unit": unit, "y_unit": "N" if unit.startswith("m") else "N.m"}
    return {"label": label, "curve": {**of, "x": x.tolist(), "learned": y.tolist()}}


@pytest.mark.parametrize("name", CURVES)
def test_the_law_is_the_one_that_the_curve_was_drawn_from(name: str) -> None:
    label, unit, x, y, law = CURVES[name]
    noise = 0.01 * np.max(np.abs(y)) * np.random.default_rng(3).standard_normal(len(y))
    made = nearest(claim(label, unit, x, y + noise))
    assert made["law"] == law
    assert made["share"] > 98
    parameters = tuple(made["parameters"].split(", "))
    kind = "linear" if unit.startswith("m") else "rotary"
    key = derived_key(law, (made["on"],), parameters)
    register(TypedLaw(key, law, (made["on"],), parameters, kind))


def test_a_curve_without_points_or_forms_is_said() -> None:
    for label, y in (("learned_velocity@motor", 0 * SPEED), ("learned_nothing", SPEED)):
        with pytest.raises(InputError, match="no form in one line"):
            nearest(claim(label, "rad/s", SPEED, y))
