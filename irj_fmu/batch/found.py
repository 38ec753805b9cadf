"""What a task of a study that fits hands back, whatever the model is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from identification.variants.exploration import Exploration

Found = tuple[dict[str, Any], Mapping[str, Any], str, dict[str, Any]]
"""Figures, parameters, text of the joint file, the whole as `--json` gives it."""


def explored(found: Exploration) -> dict[str, Any]:
    """Figures of an exploration."""
    best = found.recommended
    return {
        "start_error_percent": found.start.relative_error_percent,
        "end_error_percent": best.relative_error_percent,
        "recommended": " ".join(best.added),
        "ties": len(found.ties),
        "improve": " ".join(found.improvement.added),
        "chosen_percent": best.chosen_percent,
    }


__all__ = ["Found", "explored"]
