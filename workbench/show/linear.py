"""The best linear model in one picture: Bode plots over the measured response, and its poles."""

from __future__ import annotations

from collections.abc import Sequence

from identification.linear.models import LinearModels
from identification.linear.spectra import Response
from workbench.show.bode import HEIGHT as BODE_HEIGHT
from workbench.show.bode import bode_picture
from workbench.show.chart import BEFORE, HEIGHT, INK, WIDTH, sheet
from workbench.show.pictures import pole_picture

_HEAD = 24


def linear_picture(found: LinearModels, responses: Sequence[Response]) -> str:
    """A self-contained SVG: one Bode plot for each output, and the poles of the best model.

    Parameters
    ----------
    found : LinearModels
    responses : sequence of Response
        Measured, with the curve of the best model; none where too narrow a band is excited.
    """
    best = found.best
    panels = [(f"Bode plot, {one.title}", bode_picture(one), BODE_HEIGHT) for one in responses]
    outputs = [name for name, _ in found.ports.outputs]
    for k, poles in enumerate(best.poles):
        if not poles:
            continue
        of = f" to {outputs[k]}" if len(best.poles) == len(outputs) > 1 else ""
        title = f"poles of {best.name}{of}".replace("_", " ")
        panels.append((title, pole_picture(poles, title), HEIGHT))
    columns = min(2, max(len(panels), 1))
    body = []
    top = 0
    for first in range(0, len(panels), columns):
        row = panels[first : first + columns]
        for k, (title, inner, _) in enumerate(row):
            body.append(
                f'<g transform="translate({k * WIDTH} {top})"><text x="{WIDTH / 2:g}" y="17" '
                f'font-size="12" text-anchor="middle" fill="{INK}">{title}</text>'
                f'<g transform="translate(0 {_HEAD})">{inner}</g></g>'
            )
        top += _HEAD + max(tall for _, _, tall in row)
    legend = (
        f'<text x="8" y="{top + 16}" font-size="11" fill="{INK}">● measured '
        f'<tspan fill="{BEFORE}">- - model {best.name}</tspan> × pole, shaded: two standard '
        "deviations</text>"
    )
    return sheet("".join(body) + legend, columns * WIDTH, top + _HEAD)
