"""Which number to trust, as a table."""

from __future__ import annotations

from typing import Final

from identification.data.formats import number, pretty_unit, words
from identification.fitting.trust import Trust, Trusted
from workbench.show.results import table, text

NOTE: Final = (
    "<p class='note'>95 % intervals; the standard errors behind them do not know of a wrong model. "
    "“By record”: the value that each training record alone gives. “Moves the prediction”: by how "
    "much over half the interval, all others adapted. <code>irj trust</code> refits "
    "shapes on either side.</p>"
)


def trusted_html(trust: Trust) -> str:
    """Every parameter: interval, value by record, what it trades with, verdict."""
    head = [
        "parameter",
        "value",
        "95 % interval",
        "unit",
        "by record",
        "moves the prediction",
        "verdict",
        "trades",
    ]
    rows = [_row(p) for p in trust.parameters]
    classes = ["" if p.verdict == "trust" else "flagged" for p in trust.parameters]
    marked = "; ".join(f"{mark} {said}" for mark, said in trust.marks.items())
    keys = f"<p class='note'>By record: {text(marked)}.</p>" if marked else ""
    return table(head, rows, "Which number to trust", classes=classes, wide=True) + keys + NOTE


def _row(p: Trusted) -> list[str]:
    n = p.digits
    band = "–" if p.low is None or p.high is None else f"{number(p.low, n)} to {number(p.high, n)}"
    return [
        text(words(p.name)),
        number(p.value, n),
        band,
        pretty_unit(p.unit) or "–",
        ", ".join(text(number(v, n) + p.mark(k)) for k, v in enumerate(p.records)) or "–",
        f"{number(p.prediction_percent, 2)} %",
        text(f"{p.verdict}{f': {p.why}' if p.why else ''}"),
        text(p.trade) or "–",
    ]
