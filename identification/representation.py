"""How a result looks in a notebook: the package that draws it says so, no result knows how.

A drawing package registers one function under the entry-point group :data:`GROUP`; it takes a
result and gives HTML, or None for a type that it does not draw.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import Any, Final

GROUP: Final = "irj.html"


@cache
def _drawers() -> tuple[Callable[[Any], str | None], ...]:
    return tuple(point.load() for point in entry_points(group=GROUP))


def html_of(result: object) -> str | None:
    """HTML of a result from the first package that draws it; None where none does."""
    return next((h for draw in _drawers() if (h := draw(result)) is not None), None)
