"""The gate that every verb has its records go through: checked and repaired once, refused in
one line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final
from weakref import WeakKeyDictionary

from identification.balance.sensing import DRIVES
from identification.data.check.checks import Finding, check, repair, require
from identification.data.joint_file import Joint
from identification.data.record import Checked, Record

_PASSED: Final[
    WeakKeyDictionary[Record, dict[tuple[object, ...], tuple[Record, tuple[Finding, ...]]]]
] = WeakKeyDictionary()
"""Records that passed, by what they were held against: one that is given to two verbs is the
same record in both.
"""


def needed(record: Record, joint: Joint | None) -> tuple[str, ...]:
    """Channels that this joint says are there: a motor constant goes with a current.

    A torque sensor carries balances of its own, with or without the drive; two positions show the
    twist.
    """
    torques = (*DRIVES, "link_torque")
    both = record.has("motor_position") and record.has("link_position")
    if (
        joint is None
        or joint.torque_per_current is None
        or both
        or any(record.has(c) for c in torques)
    ):
        return ()
    return ("motor_current",)


def inspected(record: Record, joint: Joint | None) -> tuple[Finding, ...]:
    """What the gate finds in a record that a joint is to be fitted to, worst first; nothing is
    changed or refused here.
    """
    if joint is None:
        return check(record)
    if record.kind != joint.kind:
        said = f"{record.name}: was read as a {record.kind} axis, the joint is {joint.kind}"
        advice = "read it with joint=joint, or correct kind in [joint]"
        return (Finding("refuse", "kind", f"{said}: {advice}"),)
    return check(record, joint.gear_ratio, needed(record, joint), joint.torque_per_current)


def passed(record: Record, joint: Joint | None) -> tuple[Record, tuple[Finding, ...]]:
    """A record through the gate, and what was found; one that went through with this joint is given
    back as it is.

    Parameters
    ----------
    record : Record
    joint : Joint or None
        Its gear ratio, torque per current and kind are held against the record.

    Returns
    -------
    record, findings
        Repaired, with what the gate said in its provenance; no findings for a record that carries
        its check.

    Raises
    ------
    InputError
        A record that cannot be used, in one line.
    """
    before, by = record.provenance.checked, _key(record, joint)
    if before is not None and before.by == by:
        return record, ()
    known = _PASSED.setdefault(record, {})
    if by not in known:
        findings = inspected(record, joint)
        require(findings)
        known[by] = stamped(record, joint, findings), findings
    return known[by]


def stamped(record: Record, joint: Joint | None, findings: Sequence[Finding]) -> Record:
    """The record repaired as its findings say, marked as checked with this joint (none of them
    may refuse it).
    """
    before = record.provenance.checked
    made = repair(record) if any(f.severity == "repair" for f in findings) else record
    repairs = (
        *(before.repairs if before else ()),
        *(f.message for f in findings if f.severity == "repair"),
    )
    doubts = tuple(f.message for f in findings if f.severity == "warn")
    mark = Checked(_key(record, joint), tuple(dict.fromkeys(repairs)), doubts)
    return replace(made, provenance=replace(made.provenance, checked=mark))


def gated(records: Sequence[Record], joint: Joint | None) -> list[Record]:
    """Records through the gate, checked and repaired where they were not yet (see `passed`)."""
    return [passed(record, joint)[0] for record in records]


def gate_warnings(records: Sequence[Record]) -> tuple[str, ...]:
    """What the gate had to say about records that went through it, each sentence once."""
    said = [text for r in records if r.provenance.checked for text in r.provenance.checked.warnings]
    return tuple(dict.fromkeys(said))


def _key(record: Record, joint: Joint | None) -> tuple[object, ...]:
    """What a check depends on beside the record."""
    if joint is None:
        return ()
    return (joint.kind, joint.gear_ratio, joint.torque_per_current, *needed(record, joint))
