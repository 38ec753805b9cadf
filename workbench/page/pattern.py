"""Physics or sensor: which balances stand over the noise, and which reading they share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from identification.balance.balances import balances_of
from identification.balance.sensing import DRIVES
from identification.balance.weak import POSITION_CHAINS
from identification.diagnosis.improve import RATIO_LIMIT
from workbench.page.analysis import Analysis
from workbench.page.session import StepEntry
from workbench.show.fragments import pattern_of
from workbench.show.results import BALANCES

READINGS: Final = {
    "drive": "motor current",
    "motor_position": "motor position",
    "torque": "torque sensor",
    "link_position": "link position",
}
SOURCE: Final = {name: source for source, chain in POSITION_CHAINS.items() for name in chain}


def pattern(analysis: Analysis, steps: Sequence[StepEntry]) -> dict[str, Any]:
    """The pattern over the balances, at the start and now.

    Returns
    -------
    dict
        ``sentence``; ``limit``; ``balances`` (name, what it compares, residual over noise at the
        start and now); ``readings`` (name, balances it enters, whether it is the one that all and
        only the failing balances share).
    """
    start, now = _ratios(steps[0]), _ratios(steps[-1])
    hit, meaning = pattern_of(now)
    enters = _entering(analysis)
    titles = {**READINGS, "drive": _drive(analysis)}
    rows: list[dict[str, Any]] = [
        {"name": title, "balances": sorted(enters[source])}
        for source, title in titles.items()
        if enters.get(source)
    ]
    for row in rows:
        row["shared"] = len(hit) > 1 and set(row["balances"]) == hit
    return {
        "sentence": f"{meaning}.",
        "limit": RATIO_LIMIT,
        "hit": sorted(hit),
        "kernel_ms": 1e3 * analysis.data.kernel,
        "readings": rows,
        "balances": [
            {"name": b, "compares": BALANCES.get(b, ""), "start": start.get(b), "now": r}
            for b, r in now.items()
        ],
    }


def _drive(analysis: Analysis) -> str:
    """What the records have of the drive: its torque, its current or its voltage."""
    first = analysis.split[0][0]
    return next((c.replace("_", " ") for c in DRIVES if first.has(c)), READINGS["drive"])


def _ratios(step: StepEntry) -> dict[str, float]:
    return {
        b: float(e["ratio"]) for b, e in step.held_out["balances"].items() if e["ratio"] is not None
    }


def _entering(analysis: Analysis) -> Mapping[str, set[str]]:
    """For each measured signal, the balances that it enters, from the declared physics."""
    found: dict[str, set[str]] = {}
    solution = analysis.solution
    if solution is None:
        return found
    balances = balances_of(solution.model, analysis.data.sensing, wrt=())
    for balance, names in balances.entering(solution.values).items():
        for name in names:
            found.setdefault(SOURCE[name], set()).add(balance)
    return found


__all__ = ["pattern"]
