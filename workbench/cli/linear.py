"""linear: what a linear model without physics makes of the records."""

from __future__ import annotations

from argparse import Namespace

import numpy as np

from identification.linear.models import LinearModel, LinearModels, linear_models, responses
from identification.linear.poles import Pole
from workbench.cli.files import (
    distinct,
    open_joint,
    open_records,
    progress_bar,
    write_json,
    write_text,
)
from workbench.show.linear import linear_picture


def run_linear(arguments: Namespace) -> int:
    """`irj linear REC...`."""
    distinct(training=arguments.records, held_out=arguments.held_out)
    joint = open_joint(arguments.joint) if arguments.joint else None
    records, warnings = open_records(arguments.records, joint)
    held, more = open_records(arguments.held_out, joint)
    asked = {"families": arguments.family} if arguments.family else {}
    found = linear_models(
        records,
        held,
        joint,
        inputs=arguments.inputs,
        outputs=arguments.outputs,
        max_order=arguments.max_order,
        every=arguments.every,
        progress=progress_bar,
        **asked,
    )
    progress_bar("done", 1.0)
    print_models(found)
    if arguments.picture:
        write_text(arguments.picture, linear_picture(found, responses(found, records, joint)))
        print(f"picture: {arguments.picture}")
    write_json(arguments.json, {**found.as_json(), "warnings": [*warnings, *more]})
    return 0


def print_models(found: LinearModels) -> None:
    """Ports, table of the families, poles of the best one, notes."""
    ports = found.ports
    side = ", link-referred" if ports.link_referred else ""
    print(f"from {_named(ports.inputs)} to {_named(ports.outputs)}{side}")
    print(
        f"every {_th(ports.every)}sample ({1.0 / ports.dt:.4g} Hz), {found.fit_samples} samples "
        f"fitted; held out: {found.held_out} ({found.held_out_samples} samples)"
    )
    for note in found.notes:
        print(f"note: {note}")
    outputs = [name for name, _ in ports.outputs]
    width = max(14, *(len(name) for name in outputs))
    heads = " ".join(f"{name:>{width}}" for name in outputs)
    print(f"{'held-out VAF [%]':<16} {heads}    radius  one sample ahead")
    for one in found.models:
        print(_row(one, width))
    best = found.best
    for k, poles in enumerate(best.poles):
        if not poles:
            continue
        of = f" to {outputs[k]}" if len(best.poles) == len(outputs) > 1 else ""
        print(f"poles of {best.name}{of}:")
        for p in poles:
            print(f"  {pole_text(p)}")


def _named(ports: tuple[tuple[str, str], ...]) -> str:
    return ", ".join(f"{name} [{unit}]" for name, unit in ports)


def _th(number: int) -> str:
    return "" if number == 1 else f"{number}th " if number > 3 else ("2nd ", "3rd ")[number - 2]


def _row(one: LinearModel, width: int) -> str:
    if one.family == "arma":  # it has no input to be simulated from
        cells = " ".join(f"{'-':>{width}}" for _ in one.vaf_percent)
    else:
        cells = " ".join(
            f"{v:>{width}.2f}" if np.isfinite(v) else f"{'unstable':>{width}}"
            for v in one.vaf_percent
        )
    ahead = " ".join(f"{v:.3f}" for v in one.prediction_vaf_percent if np.isfinite(v)) or "-"
    pieces = one.pieces_vaf_percent
    said = "" if pieces is None else f"  (short pieces: {' '.join(f'{v:.2f}' for v in pieces)})"
    return f"{one.name:<16} {cells} {one.spectral_radius:9.6f}  {ahead}{said}"


def pole_text(one: Pole) -> str:
    """Frequency and damping of a pole, or its decay, with standard deviations."""
    known = np.isfinite(one.frequency_deviation)
    spread = f" +- {one.frequency_deviation:.2g}" if known else ""
    if not one.is_pair:
        z = f" +- {one.deviation:.2g}" if np.isfinite(one.deviation) else ""
        return f"real, z = {one.value.real:.6g}{z}"
    less = f" +- {one.damping_deviation:.2g}" if known else ""
    return f"{one.frequency:.4g}{spread} Hz, damping {one.damping:.3g}{less}"
