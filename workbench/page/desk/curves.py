"""What a session keeps of the learned curves of a result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from identification.diagnosis.improve import Improvement
from workbench.page.session import State


def kept_curves(found: Improvement) -> dict[str, Any]:
    """The learned curves of a result, and the values of the last model with all of them in it, as
    their penalised fit gave them: a law beside a curve may stand out of its bounds there, since
    only the sum of both is told, and a drawing needs the sum.
    """
    values: dict[str, float] = {}
    for claim in found.learned:
        values |= {n: float(v) for n, v in {**claim.curve.beside, **claim.curve.values}.items()}
    return {"learned": [c.as_json() for c in found.learned], "learned_values": values}


def story_of(state: State) -> Mapping[str, Any]:
    """What the whole loop found, where the last step of the ledger is its last; else nothing."""
    story = state.improvement or {}
    current = bool(state.steps) and story.get("exact") == state.steps[-1].exact
    return story if current else {}


def learned_of(story: Mapping[str, Any] | None, label: str) -> Mapping[str, Any] | None:
    """The learned curve of a label in what `kept_curves` gave; None where there is none."""
    curves = (story or {}).get("learned", ())
    found: Mapping[str, Any] | None = next((c for c in curves if c["label"] == label), None)
    return found
