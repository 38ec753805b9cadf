"""The linear ceiling as a table with a sentence."""

from __future__ import annotations

from identification.data.formats import number
from identification.linear.ceiling import BalanceCeiling, Ceiling
from workbench.show.results import table, text


def ceiling_html(found: Ceiling) -> str:
    """The ceiling as a table with a sentence."""

    def cells(name: str, one: Ceiling | BalanceCeiling, which: str) -> list[str]:
        shares = (100.0 - one.physical_vaf_percent, 100.0 - one.vaf_percent, one.noise_percent)
        return [name, *(f"{number(max(v, 0.0), 3)} %" for v in shares), which]

    rows = [cells(f"{text(b)} balance", c, text(c.model)) for b, c in found.balances.items()]
    rows.append(cells("all", found, "–"))
    of = f"{found.rows} of {found.all_rows}" if found.rows < found.all_rows else str(found.rows)
    head = [
        "balance",
        "variance this model leaves",
        "variance the best linear model leaves",
        "variance noise alone leaves",
        "best linear model",
    ]
    caption = (
        "Share of the variance of the measured torque left unexplained (the square of a relative "
        "error), "
        f"{'unseen' if found.unseen else 'training'} records, {of} rows; {found.tried} linear "
        f"models fitted to {found.fit_rows} training rows"
    )
    return f"<p>{text(found.meaning)}</p>{table(head, rows, caption)}"
