"""An improvement in one picture: the falling error beside the residual in its most telling
place.
"""

from __future__ import annotations

from identification.diagnosis.improve import Improvement
from identification.errors import InputError
from workbench.show.chart import AFTER, BEFORE, HEIGHT, INK, WIDTH, sheet
from workbench.show.pictures import place_picture, staircase_picture
from workbench.show.plots import report_plots
from workbench.show.results import effort_of, floor_percent, stairs_of

_HEAD = 26


def improvement_picture(improvement: Improvement) -> str:
    """A self-contained SVG: held-out error after each step; mean residual before and after, with 95
    % bands.

    Raises
    ------
    InputError
        Nothing was fitted, so there is nothing to draw.
    """
    plots = report_plots(improvement)
    if plots is None or not plots.places:
        raise InputError("no picture: nothing was fitted")
    result = improvement.as_json()
    steps = stairs_of(result)
    values = [float(s["held_out"]["relative_error_percent"]) for s in steps]
    labels = [f"+ {s['added']}" if s["added"] else "start" for s in steps]
    last = steps[-1]["held_out"]
    stairs = staircase_picture(values, floor_percent(last), labels, effort=effort_of(last))
    before, after = plots.places[0]
    telling = place_picture(before, after)
    legend = _word(WIDTH + 54, BEFORE, "◆ start model") + (
        _word(WIDTH + 154, AFTER, "■ with the additions") if after is not None else ""
    )
    title = _word(54, INK, "error on records the fit never saw")
    body = (
        f'{title}{legend}<g transform="translate(0 {_HEAD})">{stairs}</g>'
        f'<g transform="translate({WIDTH} {_HEAD})">{telling}</g>'
    )
    return sheet(body, 2 * WIDTH, HEIGHT + _HEAD)


def _word(x: float, colour: str, text: str, anchor: str = "start") -> str:
    return (
        f'<text x="{x:g}" y="18" font-size="12" fill="{colour}" '
        f'text-anchor="{anchor}">{text}</text>'
    )
