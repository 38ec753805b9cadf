"""What a task of a study that fits hands back, whatever the model is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Found = tuple[dict[str, Any], Mapping[str, Any], str, dict[str, Any]]
"""Figures, parameters, text of the joint file, the whole as `--json` gives it."""

__all__ = ["Found"]
