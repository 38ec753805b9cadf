"""What a check found: one line that says what, where and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from identification.data.record import Record

SEVERITIES: Final = ("refuse", "repair", "warn", "ok")


@final
@dataclass(frozen=True)
class Finding:
    """One result of the check gate.

    Attributes
    ----------
    severity : {"refuse", "repair", "warn", "ok"}
        ``refuse``: unusable as it is; ``repair``: a named rule of `repair` handles it; ``warn``:
        usable, with a doubt to settle; ``ok``: checked, nothing to do.
    code : str
        Short name of the check, the same for every record.
    message : str
        One line: what, where and what to do.
    channel : str or None
        The channel it is about.
    row : int or None
        First row it is about, counted from 0; messages count from 1.
    """

    severity: str
    code: str
    message: str
    channel: str | None = None
    row: int | None = None

    def __str__(self) -> str:
        return f"{self.severity}: {self.message}"


def at(record: Record, row: int) -> str:
    """Return ``row 12 (t = 0.022 s)``: rows are counted from 1 in messages."""
    return f"row {row + 1} (t = {record.time[row]:.6g} s)"


def rank(findings: list[Finding]) -> tuple[Finding, ...]:
    """Return the findings, worst first."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))
