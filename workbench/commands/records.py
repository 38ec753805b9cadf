"""check: is a record fit for use?"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence

from identification.check import Finding
from identification.dataset import load_dataset, prepared_model
from identification.errors import InputError
from identification.gate import inspected, passed
from identification.joint_file import Joint
from identification.read import read
from identification.record import Record
from workbench.commands.files import open_joint, write_json


def run_check(arguments: Namespace) -> int:
    """`irj check`: 1 where a record would be refused."""
    if not arguments.joint:
        return checked(arguments, None)
    joint = open_joint(arguments.joint)
    return checked(arguments, joint, lambda record: _unfit(record, joint))


def _unfit(record: Record, joint: Joint) -> list[Finding]:
    """Why a verb would refuse a record that passes the gate: channels that the model needs, too few samples."""
    if any(f.severity == "refuse" for f in inspected(record, joint)):
        return []
    whole = passed(record, joint)[0]
    try:
        load_dataset([whole], [], joint, prepared_model(joint, whole))
    except InputError as error:
        return [Finding("refuse", "unfit", str(error))]
    return []


def checked(arguments: Namespace, joint: Joint | None, more: Callable[[Record], Sequence[Finding]] = lambda record: ()) -> int:
    """Print what the check gate, and `more` checks, find in each record; 1 where one would be refused."""
    refused = False
    out = {}
    for path in arguments.records:
        record = read(path, columns=joint.columns if joint else None, kind=joint.kind if joint else None)
        findings = [*inspected(record, joint), *more(record)]
        print(f"{path}: {len(record)} samples, {record.duration:.3g} s, channels {', '.join(record.channels)}")
        for finding in findings:
            print(f"  {finding.severity}: {finding.message}")
        refused |= any(f.severity == "refuse" for f in findings)
        out[str(path)] = [{"severity": f.severity, "code": f.code, "message": f.message} for f in findings]
    write_json(arguments.json, out)
    return 1 if refused else 0
