"""The first error after a click: a few damped Gauss-Newton steps from where the model stands,
on every row of the fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from casadi_models import JointModel
from casadi_models.term import HANGING, LOAD_COMPLIANCE
from identification.balance.balances import balances_of
from identification.balance.calibration import bare, is_of_run, names_of_runs, usual
from identification.balance.sensing import idle_shapes
from identification.fitting.engine import Dataset, Solution
from identification.fitting.start_values import bounds_of, starts
from identification.fitting.weak_form import WeakForm

STEPS: Final = 2
STEPS_MEMORY: Final = 1
"""Steps where a law remembers: each needs its internal states along every sample again."""


def first_look(
    model: JointModel, data: Dataset, now: Solution, start: Mapping[str, float]
) -> Solution:
    """A model near one that is fitted already, moved to where its linear part leads.

    Shapes that `now` does not have stay at their start values: those of a diagnosis are near the
    best ones. Weights are those of `now`; there are no standard errors yet.

    Parameters
    ----------
    model : JointModel
    data : Dataset
    now : Solution
        Of a model that differs by an effect.
    start : mapping
        Values to start from.
    """
    known = data.joint.known
    values = starts(model, data)
    values.update({k: float(v) for k, v in start.items() if k in values})
    fixed = {n: k.value for n, k in known.items() if k.value is not None}
    fixed |= idle_shapes(model, data.sensing)
    values.update({n: v for n, v in fixed.items() if n in values})
    limits = bounds_of(model, known, data)
    shapes = {p.name for p in model.parameters if p.is_shape} - set(now.free)
    apart = {*fixed, *shapes, *model.calibration}
    tied = now.values.get(LOAD_COMPLIANCE.name) == 0.0
    apart |= {n for n in HANGING if tied or n not in now.free}
    free = [n for n in model.parameter_names if n not in apart]
    free += names_of_runs(model, data.train)
    for n in free:
        values[n] = min(max(values[n], limits[n][0]), limits[n][1])
    balances = balances_of(model, data.sensing, wrt=bare(free))
    steps = STEPS_MEMORY if model.equations.memory_terms else STEPS
    before = usual(model, data.train, torque=data.sensing.has_torque)
    problem = WeakForm(balances, data, values, tuple(free), now.weights, before)
    values, used = problem.fitted(limits, steps)
    kept = {k: float(v) for k, v in values.items()}
    own = {k: v for k, v in kept.items() if not is_of_run(k)}
    return Solution(
        replace(model, values=own),
        kept,
        dict.fromkeys(kept),
        tuple(n for n in free if not is_of_run(n)),
        now.weights,
        now.sigma,
        iterations=used,
    )


__all__ = ["first_look"]
