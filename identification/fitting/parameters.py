"""Fitted parameters as a table: value, standard error, unit, side, flags; derived amplitudes
and phases.
"""

from __future__ import annotations

import math
from typing import Any

from identification.balance.dataset import HOLD_NAME
from identification.balance.sensing import idle_shapes
from identification.fitting.engine import Dataset, Solution


def parameter_table(solution: Solution, data: Dataset) -> dict[str, dict[str, Any]]:
    """Every parameter of the fitted model by name.

    Returns
    -------
    dict
        ``{name: {value, stderr, unit, side, meaning, at_bound, identifiable, correlation}}``; sine
        and cosine pairs also as amplitude and phase; stderr None where it does not apply.
    """
    out: dict[str, dict[str, Any]] = {}
    apart = {HOLD_NAME, *solution.model.calibration, *idle_shapes(solution.model, data.sensing)}
    for p in solution.model.parameters:
        if p.name in apart:
            continue
        nuisance = p.role == "smoothing"
        partner = solution.correlation.get(p.name)
        out[p.name] = {
            "value": float(solution.values[p.name]),
            "stderr": None if nuisance else _finite(solution.stderr.get(p.name)),
            "unit": p.unit,
            "side": p.side,
            "meaning": p.meaning,
            "at_bound": p.name in solution.at_bound,
            "identifiable": p.name not in solution.unidentified,
            "nuisance": nuisance,
            "correlation": {"with": partner[0], "value": partner[1]} if partner else None,
        }
    for term in solution.model.terms:
        named = dict(zip((p.name for p in term.effect.parameters), term.names, strict=True))
        for name, sine, cosine in term.effect.pairs:
            out.update(_polar(*term.affixes(name), out[named[sine]], out[named[cosine]]))
    return out


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _polar(
    name: str, tail: str, sine: dict[str, Any], cosine: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    size = math.hypot(sine["value"], cosine["value"])
    errors = [e for e in (sine["stderr"], cosine["stderr"]) if e is not None]
    spread = max(errors) if errors else None
    common = {
        "side": sine["side"],
        "at_bound": False,
        "identifiable": True,
        "nuisance": False,
        "correlation": None,
    }
    return {
        f"{name}_amplitude{tail}": {
            "value": size,
            "stderr": spread,
            "unit": sine["unit"],
            "meaning": "amplitude",
            **common,
        },
        f"{name}_phase{tail}": {
            "value": math.atan2(cosine["value"], sine["value"]),
            "stderr": spread / size if spread is not None and size > 0 else None,
            "unit": "rad",
            "meaning": "phase",
            **common,
        },
    }
