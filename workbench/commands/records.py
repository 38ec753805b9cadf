"""check: is a record fit for use?"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence

from identification.check import Finding
from identification.gate import inspected
from identification.joint_file import Joint
from identification.read import read
from identification.record import Record
from workbench.commands.files import open_joint, write_json


def run_check(arguments: Namespace) -> int:
    """`irj check`: 1 where a record would be refused."""
    return checked(arguments, open_joint(arguments.joint) if arguments.joint else None)


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
