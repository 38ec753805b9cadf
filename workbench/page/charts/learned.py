"""What the learned curves of a result take off the residual, drawn through it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.balance.balances import balances_of
from identification.diagnosis.places import AXIS_TITLES, Axis, Place, Rows, place
from identification.fitting.engine import stack
from workbench.page.analysis import Analysis
from workbench.show.chart import Chart
from workbench.show.pictures import place_chart
from workbench.show.plots import explained

FloatArray = npt.NDArray[np.float64]


def shown_residual(
    analysis: Analysis, model: JointModel, values: Mapping[str, float]
) -> dict[str, FloatArray]:
    """Residual on the held-out rows by balance; NaN where a record takes no part."""
    balances = balances_of(model, analysis.data.sensing, wrt=())
    return stack(balances, analysis.data.held_out, values).shown


def curve_chart(
    analysis: Analysis, story: Mapping[str, Any], claim: Mapping[str, Any]
) -> tuple[Chart, bool]:
    """The residual of the model as it stands over the variable of a learned curve, and what the
    learned curves of its balance take off it together: beside one another they share the work, and
    only their sum can be told. With it whether that is drawn.
    """
    balance, axis = str(claim["balance"]), str(claim["curve"]["axis"])
    now = analysis.current
    model = now.model
    for curve in story["learned"]:
        if curve["balance"] == balance:
            model = model.add(curve["label"])
    start = {p.name: p.start for p in model.parameters}
    values = {**start, **now.values, **story["learned_values"]}
    before = shown_residual(analysis, now.model, now.values)[balance]
    after = shown_residual(analysis, model, values)[balance]
    rows = _over(analysis, axis, str(claim["curve"]["unit"]))
    first = place(rows, before, balance, axis)
    law = explained(first, place(rows, after, balance, axis, like=first))
    shown = law if law is not None and _helps(first, law) else None
    return place_chart(first, law=shown), shown is not None


def _helps(residual: Place, law: Place) -> bool:
    """Whether a line takes squares off what it is drawn through. Curves and laws of one variable
    that undo one another fit the steady rows together; on rows beyond those either is alone.
    """
    pairs = list(zip(residual.branches, law.branches, strict=True))
    left = sum(float(np.nansum((r.mean - w.mean) ** 2)) for r, w in pairs)
    return left < sum(float(np.nansum(r.mean**2)) for r, _ in pairs)


def _over(analysis: Analysis, axis: str, unit: str) -> Rows:
    """The held-out rows with the variable of a curve, which need not be one of the places."""
    rows = analysis.rows
    if axis in rows.axes:
        return rows
    values = np.concatenate([w.averaged[axis] for w in analysis.data.held_out])
    title = AXIS_TITLES.get(axis, axis.replace("_", " "))
    own = Axis(axis, title, unit, values, np.ones(len(values), dtype=np.bool_))
    return replace(rows, axes={**rows.axes, axis: own})
