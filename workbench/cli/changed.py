"""changed: which parameters of a fitted joint moved."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.changed import Changes, changed
from workbench.cli.files import alike, open_joint, open_records, progress_bar, write_json


def run_changed(arguments: Namespace) -> int:
    """`irj changed`."""
    reference = open_joint(arguments.reference)
    records, warnings = open_records(arguments.records, reference)
    alike(arguments.records, records, reference)
    healthy, more = open_records(arguments.healthy, reference)
    warnings += more
    found = compared(reference, records, healthy)
    write_json(arguments.json, {**found.as_json(), "warnings": warnings})
    return 0


def compared(
    reference: Joint, records: Sequence[Record], healthy: Sequence[Record] = ()
) -> Changes:
    """What moved, printed."""
    found = changed(reference, records, healthy=healthy, progress=progress_bar)
    progress_bar("done", 1.0)
    print(found)
    return found
