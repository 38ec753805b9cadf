"""Results in a notebook: one function a type, found by `identification.representation`."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import final

from identification.data.formats import pretty_unit, value_range
from identification.data.record import Record
from identification.diagnosis.compare import Comparison
from identification.diagnosis.diagnose import Diagnosis
from identification.diagnosis.improvement import Improvement
from identification.errors import InputError
from identification.fitting.fit import Fit
from identification.linear.frequency import Bode
from identification.variants.exploration import Exploration
from workbench.show.bode import bode_html
from workbench.show.ceiling import ceiling_html
from workbench.show.front import exploration_html
from workbench.show.report import render_comparison, render_report
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


@final
@dataclass(frozen=True)
class Interactive:
    """A document with its plots at work, as the output of a cell.

    Attributes
    ----------
    document : str
        HTML with its scripts and styles.
    height : int
        Of the frame that it is shown in [px].
    """

    document: str
    height: int

    def _repr_html_(self) -> str:
        """A frame that runs the document's own scripts, and can reach nothing of the notebook."""
        return (
            f'<iframe srcdoc="{html.escape(self.document)}" sandbox="allow-scripts" '
            f'title="Joint report" style="width:100%;height:{self.height}px;border:0"></iframe>'
        )


def interactive(
    result: Improvement | Diagnosis | Comparison,
    records: Sequence[Record] = (),
    *,
    height: int = 720,
) -> Interactive:
    """A result inside a notebook as its document: of a loop or a diagnosis the report, whose plots
    in time zoom; of a comparison every place at which the model may fail.

    Parameters
    ----------
    result : Improvement, Diagnosis or Comparison
    records : sequence of Record
        For the plots of a report over frequency, and where its figures come from.
    height : int
        [px].

    Raises
    ------
    InputError
        A result of another type.
    """
    if isinstance(result, Comparison):
        return Interactive(render_comparison(result), height)
    found = result.found if isinstance(result, Diagnosis) else result
    if not isinstance(found, Improvement):
        raise InputError(
            "interactive takes what improve, diagnose and compare give, and not "
            f"{type(result).__name__}; display(result) shows any of them"
        )
    return Interactive(render_report(found, records=records), height)


__all__ = ["Interactive", "html_of", "interactive"]
