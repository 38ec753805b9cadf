"""check: is a record fit for use? resample: the record on an even grid."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from identification.balance.dataset import load_dataset, prepared_model
from identification.data.check.checks import Finding, check, repair
from identification.data.check.gate import inspected, passed
from identification.data.joint_file import Joint
from identification.data.read import read
from identification.data.record import Record
from identification.errors import InputError
from workbench.cli.files import open_joint, write_json
from workbench.cli.virtual import write_table


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
    if Path(arguments.output).suffix not in (".csv", ".npz"):
        raise InputError(f"{arguments.output}: give a name that ends in .csv or .npz")
    record = read(
        path, columns=joint.columns if joint else None, kind=joint.kind if joint else None
    )
    stamps = [f for f in check(record) if f.channel == "time"]
    refused = next((f for f in stamps if f.severity == "refuse"), None)
    if refused is not None:
        raise InputError(refused.message)
    for finding in stamps:
        print(f"{finding.severity}: {finding.message}")
    even = repair(record)
    table = {"time_s": np.asarray(even.time)} | {
        f"{c}{_suffix(even.unit(c))}": np.asarray(v) for c, v in even.channels.items() if c != "run"
    }
    if len(even.segments()) > 1:
        table["run"] = even.segment.astype(np.float64)
    write_table(Path(arguments.output), table)
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
        for finding in findings:
            print(f"  {finding.severity}: {finding.message}")
        refused |= any(f.severity == "refuse" for f in findings)
        out[str(path)] = [
            {"severity": f.severity, "code": f.code, "message": f.message} for f in findings
        ]
    write_json(arguments.json, out)
    return 1 if refused else 0
