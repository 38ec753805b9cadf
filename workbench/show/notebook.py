"""Results in a notebook: one function a type, found by `identification.representation`."""

from __future__ import annotations

import html
from functools import singledispatch

from identification.data.formats import pretty_unit, value_range
from identification.data.record import Record
from identification.diagnosis.compare import Comparison
from identification.diagnosis.diagnose import Diagnosis
from identification.diagnosis.improvement import Improvement
from identification.fitting.fit import Fit
from identification.linear.frequency import Bode
from identification.variants.exploration import Exploration
from workbench.show.bode import bode_html
from workbench.show.ceiling import ceiling_html
from workbench.show.front import exploration_html
from workbench.show.results import (
    comparison_html,
    diagnosis_html,
    fit_html,
    improvement_html,
    spaced,
)


@singledispatch
def html_of(result: object) -> str | None:
    """HTML of a result without scripts, styles or ids; None for a type that is not drawn."""
    return None


@html_of.register
def _(result: Record) -> str | None:
    rows = "".join(
        f"<tr><td>{key}</td><td>{pretty_unit(result.unit(key))}</td><td>{value_range(values)}"
        "</td></tr>"
        for key, values in result.channels.items()
    )
    size = f"{len(result)} samples, {result.duration:.6g} s, {len(result.segments())} segment(s)"
    return spaced(
        f"<table><caption>{html.escape(result.name)}: "
        f"{size}</caption><tr><th>channel</th><th>unit</th><th>range</th></tr>{rows}</table>"
    )


@html_of.register
def _(result: Fit) -> str | None:
    return fit_html(result)


@html_of.register
def _(result: Comparison) -> str | None:
    linear = spaced(f"<div>{ceiling_html(result.linear)}</div>") if result.linear else ""
    return comparison_html(result) + linear


@html_of.register
def _(result: Diagnosis) -> str | None:
    return diagnosis_html(result)


@html_of.register
def _(result: Improvement) -> str | None:
    return improvement_html(result)


@html_of.register
def _(result: Bode) -> str | None:
    return bode_html(result)


@html_of.register
def _(result: Exploration) -> str | None:
    return exploration_html(result)
