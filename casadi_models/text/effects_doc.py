"""The effect library as a page: ``python -m casadi_models.text.effects_doc --write docs/effects.md``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ..effect import EFFECTS, Effect
from ..parameter import Parameter

HEADER: Final = """# The effect library

Generated from the declarations in `casadi_models/effects/` by
`python -m casadi_models.text.effects_doc --write docs/effects.md`. Do not edit it by hand.

All torques, angles and inertias are referred to the link and in SI units. An amplitude (plain) enters
the law linearly, 0 means that the effect is absent. A shape parameter (*in italics*) enters nonlinearly and
is searched on a grid first. Where an effect may act in several places, its parameters carry the place in front:
`motor_viscous`, `link_viscous`. Add an effect by `key` (its first place) or `key@place`. "Needs" names
effects that must be in the model first. "Confused with" names effects that data often cannot tell apart from it.

"Thesis" is A. R. da Silva, INPE-8981-TDI/812/B.
"""
COLUMNS: Final = (
    "key",
    "title",
    "places",
    "parameters",
    "how its absence looks",
    "excitation",
    "confused with",
    "needs",
    "source",
)


def page() -> str:
    """The whole page in Markdown."""
    families: dict[str, list[Effect]] = {}
    for key in sorted(EFFECTS):
        families.setdefault(EFFECTS[key].family, []).append(EFFECTS[key])
    parts = [HEADER]
    for family in sorted(families):
        parts.append(f"## {family.capitalize()}\n")
        parts.append(
            "\n".join([_line(COLUMNS), _line(["---"] * len(COLUMNS)), *map(row, families[family])])
            + "\n"
        )
    return "\n".join(parts)


def row(effect: Effect) -> str:
    """One effect as a row of the table."""
    return _line(
        [
            f"`{effect.key}`",
            effect.title,
            ", ".join(p.replace("_", " ") for p in effect.acts_on),
            "<br>".join(map(_parameter, effect.parameters)),
            effect.absence,
            effect.excitation
            + (f". To tell it apart: {effect.separate_by}" if effect.separate_by else ""),
            _keys(effect.confused_with),
            _keys(effect.needs),
            effect.source,
        ]
    )


def _parameter(parameter: Parameter) -> str:
    name = f"*{parameter.name}*" if parameter.is_shape else parameter.name
    return f"{name} [{parameter.unit}]: {parameter.meaning}"


def _keys(keys: Sequence[str]) -> str:
    return ", ".join(f"`{k}`" for k in keys) or "-"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page to a file, or to standard output."""
    parser = argparse.ArgumentParser(description="The effect library as a Markdown page.")
    parser.add_argument(
        "--write", type=Path, metavar="FILE", help="file to write; standard output by default"
    )
    target: Path | None = parser.parse_args(arguments).write
    if target is None:
        sys.stdout.write(page())
    else:
        target.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
