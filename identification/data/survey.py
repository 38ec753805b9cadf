"""What a file holds before it is used: each column with its range and its shape, which channel it
may be and why, and what would be odd about the joint if that were so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from identification.data.check.finding import Finding
from identification.data.check.gate import inspected
from identification.data.column import Guess
from identification.data.columns import NAMES, parse_map, recognise_quietly
from identification.data.guess import guess_columns, numbered, of_joint
from identification.data.read import open_table, read
from identification.data.read._table import Table
from identification.data.record import Record
from identification.data.units import base_unit, same_dimension
from identification.errors import InputError

BUCKETS: Final = 48
"""Pieces of a sparkline."""
MOST_TURNS: Final = 5.0
"""Turns of a link from which its unit is asked: axes of industrial arms stay within two turns to
either side; the unit that is mistaken most, degrees for radians, is a factor of 57.
"""
_MAGNITUDE: Final = 0.02
"""Share of its largest value within which the smallest value of a magnitude comes to zero."""


@final
@dataclass(frozen=True)
class Seen:
    """A column as it stands in the file.

    Attributes
    ----------
    name, unit : str
        Unit where the file gives one, else empty.
    low, high : float or None
        Smallest and largest value, in the file's unit; None for a text.
    lost : float
        Share of the rows without a number.
    whole : bool
        Every value is a whole number.
    spark : tuple of (low, high)
        Smallest and largest value of each piece of the column.
    """

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    lost: float = 0.0
    whole: bool = False
    spark: tuple[tuple[float, float], ...] = ()


@final
@dataclass(frozen=True)
class Survey:
    """What a file holds and how it may be used.

    Attributes
    ----------
    reader : str
    rows : int
    columns : tuple of Seen
    kind : {"rotary", "linear"}
        As given, else as the columns look.
    proposed : tuple of Guess
        The map, with the reason for each entry.
    spans : mapping of str to (low, high, unit)
        Range of each channel in SI.
    joints : tuple of int
        Numbers of the joints whose columns stand side by side; empty where it is one joint.
    number : int or None
        Joint that the map is of.
    questions : tuple of (channel, text)
        What would be odd about the joint; the channel is empty where it is the whole record.
    findings : tuple of Finding
        What the check gate would say, but for what is in order.
    problem : str
        Why the map cannot be used, empty where it can.
    """

    reader: str
    rows: int
    columns: tuple[Seen, ...]
    kind: str
    proposed: tuple[Guess, ...]
    spans: Mapping[str, tuple[float, float, str]] = field(default_factory=dict)
    joints: tuple[int, ...] = ()
    number: int | None = None
    questions: tuple[tuple[str, str], ...] = ()
    findings: tuple[Finding, ...] = ()
    problem: str = ""

    @property
    def map(self) -> dict[str, dict[str, Any]]:
        """The proposed map, as [columns] of a joint file."""
        return {g.column.channel: g.column.entry() for g in self.proposed}

    def as_json(self) -> dict[str, Any]:
        """As plain data: for the page, and for ``irj import --json``."""
        return {
            "reader": self.reader,
            "rows": self.rows,
            "kind": self.kind,
            "joints": list(self.joints),
            "number": self.number,
            "problem": self.problem,
            "columns": [asdict(c) for c in self.columns],
            "proposed": [
                {
                    "channel": g.column.channel,
                    **g.column.entry(),
                    "reason": g.reason,
                    "si": self.spans.get(g.column.channel),
                }
                for g in self.proposed
            ],
            "questions": [{"channel": c, "text": t} for c, t in self.questions],
            "findings": [
                {"severity": f.severity, "code": f.code, "message": f.message, "channel": f.channel}
                for f in self.findings
            ],
        }


def survey(
    path: str | Path,
    *,
    kind: str | None = None,
    columns: Mapping[str, Any] | None = None,
    number: int | None = None,
    gear_ratio: float | None = None,
    name: str | None = None,
) -> Survey:
    """Look at a file before it is used.

    Parameters
    ----------
    path : str or Path
    kind : {"rotary", "linear"}, optional
        Kind of the axis; without it a position in metres makes it linear.
    columns : mapping, optional
        A column map to look at in place of the guess.
    number : int, optional
        Which of several joints (see `numbered`); the first where it is left out, and every column
        as of one joint where the file has no such number.
    gear_ratio : float, optional
        Refers a motor's angle to the link.
    name : str, optional
        Name of the file in messages.

    Raises
    ------
    InputError
        The file cannot be opened, or the map does not fit it.
    """
    table = open_table(Path(path))
    axis = kind or _kind(table.names, table.units, number)
    joints = numbered(table.names)
    if number is None and joints and columns is None:
        number = min(joints)
    if columns is None:
        proposed = _proposed(table.names, table.units, axis, number)
    else:
        entries = parse_map(columns, table.names, table.units, axis)
        chosen = {c.channel: Guess(c, "as it was chosen") for c in entries}
        own = _recognised(table.names, table.units, axis)
        used = {c.column for c in entries if c.formula is None}
        more = {k: g for k, g in own.items() if k not in chosen and g.column.column not in used}
        proposed = tuple({**chosen, **more}.values())
        if number is None and joints:
            number = _of_map(proposed, joints)
    seen, rows = _seen(table)
    made = Survey(table.reader, rows, seen, axis, proposed, joints=tuple(joints), number=number)
    said = _looked(made, Path(path), gear_ratio, name or Path(path).name)
    if kind is None and axis == "linear":
        linear = ("", "a position is a length: a linear axis")
        said = replace(said, questions=(linear, *said.questions))
    return said


def _looked(made: Survey, path: Path, ratio: float | None, name: str) -> Survey:
    """With the record that the map would give: its ranges, questions and findings."""
    try:
        record = read(path, columns=made.map, kind=made.kind, name=Path(name).stem)
    except InputError as error:
        problem = str(error).partition("; check this guess")[0].replace(str(path), name)
        return replace(made, problem=problem)
    spans = _spans(record)
    findings = inspected(record, None)
    said = tuple(f for f in findings if f.severity != "ok")
    reverses = any(f.code == "reversal" for f in findings)
    questions = _questions(made, record, spans, ratio, reverses=reverses)
    return replace(made, spans=spans, findings=said, questions=questions)


def _spans(record: Record) -> dict[str, tuple[float, float, str]]:
    """Range of each channel, and its unit."""
    return {
        c: (float(np.nanmin(v)), float(np.nanmax(v)), record.unit(c))
        for c, v in (("time", record.time), *record.channels.items())
        if c != "run" and np.isfinite(v).any()
    }


def questions_of(
    record: Record, path: str | Path, findings: Sequence[Finding], gear_ratio: float | None = None
) -> tuple[str, ...]:
    """What would be odd about the joint of a record whose headers said everything: nobody was asked
    what its columns are.

    Parameters
    ----------
    record : Record
        As it was read, without a map.
    path : str or Path
        Its file.
    findings : sequence of Finding
        What the check gate said of it.
    gear_ratio : float, optional
        Without it the turns of a motor say nothing of the link.
    """
    table = open_table(Path(path))
    proposed = tuple(_recognised(table.names, table.units, record.kind).values())
    joints = numbered(table.names)
    number = _of_map(proposed, joints) if joints else None
    made = Survey(
        table.reader, len(record), (), record.kind, proposed, joints=tuple(joints), number=number
    )
    reverses = any(f.code == "reversal" for f in findings)
    asked = _questions(made, record, _spans(record), gear_ratio, reverses=reverses)
    unknown = "motor_position" if gear_ratio is None else None
    return tuple(text for channel, text in asked if channel != unknown)


def _of_map(proposed: Sequence[Guess], joints: Mapping[int, tuple[str, ...]]) -> int:
    """The joint that a map takes its columns from; -1 where it takes them from several."""
    used = {g.column.column for g in proposed}
    found = [k for k, own in joints.items() if used & set(own)]
    return found[0] if len(found) == 1 else -1


def _kind(names: tuple[str, ...], units: Mapping[str, str], number: int | None) -> str:
    """Linear where a position is a length."""
    metre = base_unit("m")
    for guess in guess_columns(names, units, "rotary", number):
        if guess.column.channel.endswith("_position"):
            try:
                if same_dimension(base_unit(guess.column.unit, 1.0), metre):
                    return "linear"
            except InputError:
                continue
    return "rotary"


def _proposed(
    names: tuple[str, ...], units: Mapping[str, str], kind: str, number: int | None
) -> tuple[Guess, ...]:
    """Columns whose header says what they are, then the guess for the other channels."""
    taken = _recognised(of_joint(names, number), units, kind)
    used = {g.column.column for g in taken.values()}
    for guess in guess_columns(names, units, kind, number):
        if guess.column.channel not in taken and guess.column.column not in used:
            taken[guess.column.channel] = guess
    return tuple(sorted(taken.values(), key=lambda g: NAMES.index(g.column.channel)))


def _recognised(names: tuple[str, ...], units: Mapping[str, str], kind: str) -> dict[str, Guess]:
    """Channels whose headers say channel and unit: they are read without a map."""
    taken: dict[str, Guess] = {}
    for column in names:
        found = recognise_quietly(column, kind, units.get(column))
        if found is not None:
            taken.setdefault(found.channel, Guess(found, "its header says so"))
    return taken


def _seen(table: Table) -> tuple[tuple[Seen, ...], int]:
    try:
        loaded = dict(table.load(list(table.names), []))
    except (InputError, ValueError, TypeError):  # a column of text: each by itself
        loaded = {}
        for name in table.names:
            try:
                loaded[name] = table.load([name], [])[name]
            except (InputError, ValueError, TypeError):
                continue
    rows = max((len(v) for v in loaded.values()), default=0)
    return tuple(_column(n, table.units.get(n, ""), loaded.get(n)) for n in table.names), rows


def _column(name: str, unit: str, values: Any) -> Seen:
    try:
        numbers = np.asarray([] if values is None else values, dtype=np.float64)
    except (TypeError, ValueError):
        return Seen(name, unit)
    finite = numbers[np.isfinite(numbers)]
    if not finite.size:
        return Seen(name, unit, lost=1.0)
    pieces = np.array_split(finite, min(BUCKETS, finite.size))
    return Seen(
        name,
        unit,
        low=float(finite.min()),
        high=float(finite.max()),
        lost=1.0 - finite.size / numbers.size,
        whole=bool(np.all(finite == np.round(finite))),
        spark=tuple((float(p.min()), float(p.max())) for p in pieces),
    )


def _questions(
    made: Survey,
    record: Record,
    spans: Mapping[str, tuple[float, float, str]],
    ratio: float | None,
    *,
    reverses: bool,
) -> tuple[tuple[str, str], ...]:
    """What would be odd about the joint, in its own words."""
    out: list[tuple[str, str]] = []
    if len(made.joints) > 1:
        first, last = made.joints[0], made.joints[-1]
        which = f"joint {made.number}" if made.number in made.joints else "all of them as one joint"
        out.append(
            ("", f"columns of {len(made.joints)} joints, {first} to {last}: this is {which}")
        )
    out += _of_time(record)
    entries = {g.column.channel: g.column for g in made.proposed}
    seen = {c.name: c for c in made.columns}
    for channel, (low, high, _) in spans.items():
        column = entries.get(channel)
        raw = seen.get(column.column) if column is not None else None
        swings = channel == "link_position" or (
            channel == "motor_position" and "link_position" not in spans
        )
        if swings and made.kind == "rotary":
            out += _of_swing(channel, high - low, ratio, raw)
        never = low * high > 0.0 or (low == 0.0) != (high == 0.0)
        if channel.endswith("_voltage") and reverses and never:
            said = f"{channel} never changes sign while the joint turns back: a supply voltage?"
            out.append((channel, said))
        quantity = channel.rpartition("_")[2]
        touches = min(abs(low), abs(high)) <= _MAGNITUDE * max(abs(low), abs(high))
        if quantity in ("current", "torque") and reverses and never and touches:
            said = f"{channel} comes to zero and never changes sign: a magnitude without its sign?"
            out.append((channel, said))
    return tuple(out)


def _of_swing(
    channel: str, span: float, ratio: float | None, raw: Seen | None
) -> list[tuple[str, str]]:
    turns = span / (2.0 * math.pi)
    if channel == "motor_position":
        turns /= abs(ratio or 1.0)
    if turns <= MOST_TURNS:
        return []
    if raw is not None and raw.whole and raw.high is not None and raw.low is not None:
        guess = "encoder counts?"
    elif turns / math.degrees(1.0) <= MOST_TURNS:
        guess = "degrees?"
    else:
        guess = "degrees or counts?"
    if channel == "motor_position" and ratio is None:
        guess = f"{guess[:-1]}, or the motor's angle before a gear?"
    return [(channel, f"the link would swing {turns:,.0f} turns: {guess}")]


def _of_time(record: Record) -> list[tuple[str, str]]:
    out = []
    again = int(np.sum(np.diff(record.time) < 0.0)) if not record.has("run") else 0
    if again:
        often = "once" if again == 1 else f"{again} times"
        out.append(("time", f"the time starts again {often}: {again + 1} runs"))
    return out


__all__ = ["Seen", "Survey", "questions_of", "survey"]
