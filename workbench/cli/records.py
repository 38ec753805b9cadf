"""check: is a record fit for use? resample: the record on an even grid. prefilter: low-pass and
derivatives. accelerometer: its calibration at rest. linear: models without physics.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from identification.balance.dataset import load_dataset, prepared_model
from identification.data.check.channels import LARGEST
from identification.data.check.checks import Finding, check, repair
from identification.data.check.gate import inspected, passed
from identification.data.check.stamps import MINIMUM_SAMPLES
from identification.data.joint_file import Joint
from identification.data.prepare import (
    STANDARD_GRAVITY,
    calibrate_accelerometer,
    decimated,
    filtered,
    trimmed,
    with_derivatives,
)
from identification.data.read import open_table, read
from identification.data.record import Record
from identification.errors import InputError
from workbench.cli.files import (
    distinct,
    named,
    open_joint,
    open_records,
    progress_bar,
    write_json,
    write_text,
)
from workbench.cli.virtual import write_table

if TYPE_CHECKING:
    from identification.linear.models import LinearModel, LinearModels
    from identification.linear.poles import Pole


def run_check(arguments: Namespace) -> int:
    """`irj check`: 1 where a record would be refused."""
    if not arguments.joint:
        return checked(arguments, None)
    joint = open_joint(arguments.joint)
    return checked(arguments, joint, lambda record: _unfit(record, joint))


def _unfit(record: Record, joint: Joint) -> list[Finding]:
    """Why a verb would refuse a record that passes the gate: channels that the model needs, too
    few samples.
    """
    if any(f.severity == "refuse" for f in inspected(record, joint)):
        return []
    whole = passed(record, joint)[0]
    try:
        load_dataset([whole], [], joint, prepared_model(joint, whole))
    except InputError as error:
        return [Finding("refuse", "unfit", str(error))]
    return []


def run_resample(arguments: Namespace) -> int:
    """`irj resample`: the record with its stamps put right, short holes bridged, cut at the longer
    ones.

    Raises
    ------
    InputError
        Stamps that no rule repairs.
    """
    joint = open_joint(arguments.joint) if arguments.joint else None
    path = arguments.records[0]
    _table_name(arguments.output)
    record = read(
        path, columns=joint.columns if joint else None, kind=joint.kind if joint else None
    )
    stamps = [f for f in check(record) if f.channel == "time"]
    refused = next((f for f in stamps if f.severity == "refuse"), None)
    if refused is not None:
        raise InputError(refused.message)
    even = repair(record)
    _write_record(Path(arguments.output), even)
    for finding in stamps:
        print(f"{finding.severity}: {finding.message}")
    lost = 0 if even.measured is None else int(np.sum(~even.measured))
    print(
        f"{arguments.output}: {len(even)} samples in {len(even.segments())} run(s), step "
        f"{even.dt:.6g} s, {lost} of them bridged"
    )
    out = {
        "samples": len(even),
        "runs": len(even.segments()),
        "step_s": even.dt,
        "bridged": lost,
        "notes": list(even.provenance.notes),
    }
    write_json(arguments.json, out)
    return 0


def run_prefilter(arguments: Namespace) -> int:
    """`irj prefilter`: every channel through the same low-pass, forward and backward."""
    joint = open_joint(arguments.joint) if arguments.joint else None
    _table_name(arguments.output)
    (record,), _ = open_records(arguments.records, joint)
    try:
        smooth = filtered(record.resampled(), arguments.cutoff, arguments.order)
    except InputError as error:
        raise named(error, arguments.records[0], record) from None
    if arguments.derivatives:
        smooth = with_derivatives(smooth)
    if arguments.trim:
        smooth = trimmed(smooth, arguments.trim)
    if arguments.every != 1:
        smooth = decimated(smooth, arguments.every)
    if len(smooth) < MINIMUM_SAMPLES:
        raise InputError(
            f"{arguments.records[0]}: {len(smooth)} samples are left, fewer than the "
            f"{MINIMUM_SAMPLES} of a record; give a smaller --trim or --every, or record longer"
        )
    _write_record(Path(arguments.output), smooth)
    for note in smooth.provenance.notes:
        print(note)
    print(
        f"{arguments.output}: {len(smooth)} samples, step {smooth.dt:.6g} s, channels "
        f"{', '.join(c for c in smooth.channels if c != 'run')}"
    )
    write_json(
        arguments.json,
        {
            "samples": len(smooth),
            "step_s": smooth.dt,
            "cutoff_hz": arguments.cutoff,
            "order": arguments.order,
            "notes": list(smooth.provenance.notes),
        },
    )
    return 0


def run_accelerometer(arguments: Namespace) -> int:
    """`irj accelerometer`: the static calibration of annex A."""
    up, down = (_volts(path, arguments.column) for path in (arguments.up, arguments.down))
    level = [_volts(path, arguments.column) for path in arguments.horizontal]
    found = calibrate_accelerometer(up, down, np.concatenate(level) if level else None)
    print(f"offset {found.offset:.6g} V, {found.volts_per_g:.6g} V per g")
    noise = float(np.std(up)) / abs(found.volts_per_g) * STANDARD_GRAVITY
    print(f"acceleration = (volts - {found.offset:.6g}) / {found.volts_per_g:.6g} * 9.80665 m/s2")
    print(f"noise at rest {noise:.2g} m/s2")
    write_json(
        arguments.json,
        {
            "offset_v": found.offset,
            "volts_per_g": found.volts_per_g,
            "noise_m_s2": noise,
            "samples": [len(up), len(down), *(len(v) for v in level)],
        },
    )
    return 0


def _volts(path: str, column: str | None) -> npt.NDArray[np.float64]:
    """The column of an accelerometer in a file."""
    table = open_table(Path(path))
    names = [n for n in table.names if n not in ("time", "time_s", "t")]
    chosen = column if column is not None else names[0] if len(names) == 1 else None
    if chosen is None or chosen not in table.names:
        said = "no column is named" if chosen is None else f"no column {chosen!r}"
        raise InputError(f"{path}: {said}; give --column with one of {', '.join(names)}")
    values = np.asarray(table.load([chosen], [])[chosen], dtype=np.float64)
    if not values.size or not np.isfinite(values).all():
        raise InputError(f"{path}: column {chosen} holds no number in some rows; cut them out")
    if float(np.abs(values).max()) > LARGEST:
        raise InputError(f"{path}: column {chosen}: no sensor reads that, export it again")
    return values


def _table_name(output: str) -> None:
    if Path(output).suffix not in (".csv", ".npz"):
        raise InputError(f"{output}: give a name that ends in .csv or .npz")


def _write_record(path: Path, record: Record) -> None:
    """A record as a table with units in the heads."""
    table = {"time_s": np.asarray(record.time)} | {
        f"{c}{_suffix(record.unit(c))}": np.asarray(v)
        for c, v in record.channels.items()
        if c != "run"
    }
    if len(record.segments()) > 1:
        table["run"] = record.segment.astype(np.float64)
    write_table(path, table)


def _suffix(unit: str) -> str:
    """Unit at the end of a column's name, as the readers take it."""
    return f"_{unit.replace('.', '').replace('/', '_')}" if unit else ""


def checked(
    arguments: Namespace,
    joint: Joint | None,
    more: Callable[[Record], Sequence[Finding]] = lambda record: (),
) -> int:
    """Print what the check gate, and `more` checks, find in each record; 1 where one would be
    refused.
    """
    refused = False
    out = {}
    for path in arguments.records:
        record = read(
            path, columns=joint.columns if joint else None, kind=joint.kind if joint else None
        )
        findings = [*inspected(record, joint), *more(record)]
        print(
            f"{path}: {len(record)} samples, {record.duration:.3g} s, channels "
            f"{', '.join(record.channels)}"
        )
        for note in record.provenance.notes:
            print(f"  note: {note}")
        for finding in findings:
            print(f"  {finding.severity}: {finding.message}")
        refused |= any(f.severity == "refuse" for f in findings)
        out[str(path)] = [
            {"severity": f.severity, "code": f.code, "message": f.message} for f in findings
        ]
    write_json(arguments.json, out)
    return 1 if refused else 0


def run_linear(arguments: Namespace) -> int:
    """`irj linear REC...`: what a linear model without physics makes of the records."""
    # the models are loaded where they are fitted: no other verb of records needs them
    from identification.linear.models import linear_models, responses
    from workbench.show.linear import linear_picture

    distinct(training=arguments.records, held_out=arguments.held_out)
    joint = open_joint(arguments.joint) if arguments.joint else None
    records, warnings = open_records(arguments.records, joint)
    held, more = open_records(arguments.held_out, joint)
    asked = {"families": list(dict.fromkeys(arguments.family))} if arguments.family else {}
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
