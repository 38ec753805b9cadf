"""Results of other sessions, dates or joints beside one's own, as tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from identification.data.formats import number, percent, pretty_unit, ratio, with_error
from identification.data.plain_text import from_json
from identification.errors import InputError
from workbench.show.results import stairs_of, step_names, table, text
from workbench.show.words import headline, plain_name

APART: Final = 3.0
"""Standard errors of a difference from which on it is marked: chance passes them once in 370."""
NEEDED: Final = ("steps", "verdict", "records", "claims")


def read_result(path: str | Path) -> dict[str, Any]:
    """A file that `irj improve --json` wrote.

    Raises
    ------
    InputError
        No such file, or another one.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    data = from_json(raw, str(path))
    if not isinstance(data, dict) or any(k not in data for k in NEEDED):
        raise InputError(f"{path}: is no result of `irj improve --json`; give one of those")
    if not data["steps"]:
        raise InputError(f"{path}: no model was fitted in this result; nothing can stand beside it")
    try:  # a file changed by hand is refused here, by all that a table takes from it
        beside_html(data, {str(path): data})
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: is no whole result of `irj improve --json` ({type(error).__name__}: "
            f"{error}); write it again with that command"
        ) from None
    return data


def beside_html(own: Mapping[str, Any], others: Mapping[str, Mapping[str, Any]]) -> str:
    """Verdict, errors and parameters of results side by side, with what moved.

    Parameters
    ----------
    own : mapping
        `Improvement.as_json`.
    others : mapping of str to mapping
        Results from :func:`read_result`, by name.
    """
    if not own["steps"]:
        return ""
    return "".join(_one(own, name, other) for name, other in others.items())


def _one(own: Mapping[str, Any], name: str, other: Mapping[str, Any]) -> str:
    last, its = stairs_of(own)[-1], stairs_of(other)[-1]
    facts = [
        ["verdict", text(headline(own)), text(headline(other))],
        ["added", _added(own), _added(other)],
        [
            "error on held-out records",
            percent(last["held_out"]["relative_error_percent"]),
            percent(its["held_out"]["relative_error_percent"]),
        ],
    ]
    for balance in dict.fromkeys([*last["held_out"]["balances"], *its["held_out"]["balances"]]):
        facts.append(
            [f"{text(balance)} balance ÷ noise", _ratio(last, balance), _ratio(its, balance)]
        )
    shown = table(["what", "this result", text(name)], facts, f"Beside {text(name)}")
    rows, classes = [], []
    mine, theirs = last["parameters"], its["parameters"]
    for key in dict.fromkeys([*mine, *theirs]):
        a, b = mine.get(key), theirs.get(key)
        if (a or b or {}).get("nuisance"):
            continue
        apart = _apart(a, b)
        rows.append(
            [
                text(plain_name(key)),
                _value(a),
                _value(b),
                pretty_unit((a or b or {}).get("unit", "")) or "–",
                text((a or b or {}).get("side", "")),
                "–" if apart is None else f"{number(apart, 2)}",
            ]
        )
        classes.append("flagged" if apart is not None and abs(apart) > APART else "")
    head = [
        "parameter",
        "this result",
        text(name),
        "unit",
        "side",
        "difference ÷ its standard error",
    ]
    moved = sum(c == "flagged" for c in classes)
    said = f"{moved} of {len(rows)} parameters differ by more than {APART:g} standard errors."
    return shown + table(head, rows, said, classes=classes, wide=True)


def _added(result: Mapping[str, Any]) -> str:
    return text(", ".join(step_names(result)[1:])) or "nothing"


def _ratio(step: Mapping[str, Any], balance: str) -> str:
    found = step["held_out"]["balances"].get(balance)
    return ratio(found["ratio"]) if found else "–"


def _value(p: Mapping[str, Any] | None) -> str:
    return "–" if p is None else with_error(p["value"], p["stderr"])


def _apart(a: Mapping[str, Any] | None, b: Mapping[str, Any] | None) -> float | None:
    """Difference in units of its standard error; None where one is not known."""
    if a is None or b is None or a["stderr"] is None or b["stderr"] is None:
        return None
    spread = math.hypot(a["stderr"], b["stderr"])
    return (a["value"] - b["value"]) / spread if spread > 0 else None
