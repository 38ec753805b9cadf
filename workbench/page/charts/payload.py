"""Another payload on the link: what it does to the parameters of the fitted model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from casadi_models import JointModel
from casadi_models.term import LINK_INERTIA, TOTAL_INERTIA
from identification.data.units import base_unit
from identification.errors import InputError
from workbench.page.live import Live

STANDARD_GRAVITY: Final = base_unit("g0").factor
"""[m/s2]."""


def with_payload(
    model: JointModel, values: Mapping[str, float], mass: float, distance: float
) -> dict[str, float]:
    """Parameters that move when a point mass is put on the link, or taken off it.

    Its weight pulls where that of the link does, so that sine and cosine part of gravity grow
    alike; without gravity in the model only the inertia moves.

    Parameters
    ----------
    model : JointModel
    values : mapping of str to float
        Fitted values, link-referred SI.
    mass : float
        [kg]; negative: taken off.
    distance : float
        From the axis of the joint [m]; a linear axis has none.

    Raises
    ------
    InputError
        More is taken off than the link has.
    """
    linear = model.kind == "linear"
    name = LINK_INERTIA if LINK_INERTIA in model.inertias else TOTAL_INERTIA[0]
    out = {name: values[name] + mass * (1.0 if linear else distance**2)}
    if out[name] <= 0:
        raise InputError(
            f"payload: without {-mass:g} kg at {distance:g} m the link would have no inertia left"
        )
    if linear:
        return out
    now = math.hypot(*(values[n] for n in model.weights))
    if now > 0:
        share = 1.0 + mass * STANDARD_GRAVITY * distance / now
        out |= {n: share * values[n] for n in model.weights}
    return out


def payload_view(live: Live, query: Mapping[str, Any]) -> dict[str, Any]:
    """The values with another payload, for the sliders: ``mass`` [kg], ``distance`` [m].

    Raises
    ------
    InputError
        No number, or more than the link has is taken off.
    """
    numbers = {}
    for key, unit in (("mass", "kg"), ("distance", "m")):
        text = str(query.get(key, "")).strip().replace("\N{MINUS SIGN}", "-").replace(",", ".", 1)
        try:
            numbers[key] = float(text or 0.0)
        except ValueError:
            numbers[key] = math.nan
        if not math.isfinite(numbers[key]):
            raise InputError(f"payload: {key} is {text!r}; give a number in {unit}")
    now = live.analysis().current
    return {"values": with_payload(now.model, now.values, **numbers)}
