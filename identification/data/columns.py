"""Which column of a file is which channel: column maps, recognised headers, and a guess that is
only ever shown.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from identification.data.channels import CHANNELS, channel_unit
from identification.data.column import Column, header_unit, shown, split_unit
from identification.data.formula import Formula, parse_formula
from identification.data.guess import fragment, guess_columns
from identification.data.joint_schema import COLUMN
from identification.data.plain_text import from_toml, toml_string
from identification.data.units import check_unit
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

NAMES: Final = ("time", *CHANNELS)


def channel_of(name: str) -> str | None:
    """Return the channel a column name begins with, if any."""
    plain = split_unit(name)[0]
    return next(
        (
            c
            for c in sorted(NAMES, key=len, reverse=True)
            if plain == c or plain.startswith(f"{c}_")
        ),
        None,
    )


def recognise(name: str, kind: str = "rotary", unit: str | None = None) -> Column | None:
    """Read a header that says channel and unit, ``motor_current_A`` or ``motor_current [A]``.

    Parameters
    ----------
    name : str
        Column name.
    kind : {"rotary", "linear"}
        Kind of the axis.
    unit : str, optional
        Unit the file itself gives for the column (a units row, an attribute).

    Returns
    -------
    Column or None
        None where the name is not that of a channel.

    Raises
    ------
    InputError
        If the name begins with a channel's name but its unit is missing, unknown or of another
        dimension.
    """
    plain, bracket = split_unit(name)
    channel = channel_of(plain)
    if channel is None:
        return None
    if channel == "run":
        return Column("run", name, "1") if plain == "run" else None
    wanted = channel_unit(channel, kind)
    tail = plain[len(channel) + 1 :]
    if tail and bracket is None:
        found = header_unit(tail, wanted)
        if found is None:
            raise InputError(_unfit(name, channel, tail, kind))
        return Column(channel, name, found, counts_per_turn=None)
    given = bracket or unit
    if tail or given is None:
        raise InputError(
            f"column {name!r} does not say its unit: name it "
            f"{channel}_{wanted.replace('/', '_').replace('.', '')} "
            f"or give [columns] {channel} = {{ column = {toml_string(name)}, unit = "
            f"{toml_string(wanted)} }}"
        )
    try:
        check_unit(given, wanted, 1.0, channel)
    except InputError:
        raise InputError(_unfit(name, channel, given, kind)) from None
    return Column(channel, name, given)


def _unfit(name: str, channel: str, unit: str, kind: str) -> str:
    other = "linear" if kind == "rotary" else "rotary"
    other_unit = channel_unit(channel, other)
    hint = (
        f"; for a {other} axis give kind = {other!r}"
        if header_unit(unit.replace("/", "_"), other_unit)
        else ""
    )
    return (
        f"column {name!r}: {unit!r} is not a unit of {channel} "
        f"({channel_unit(channel, kind)}){hint}: "
        f"correct the header or give [columns] {channel} = {{ column = {toml_string(name)}, unit "
        f"= ... }}"
    )


def load_map(
    columns: Mapping[str, Any] | str | Path | None,
) -> tuple[Mapping[str, Any], str | None]:
    """Get the raw column map and, from a joint file, the kind of the axis.

    Parameters
    ----------
    columns : mapping, path or None
        ``{channel: {column, unit, scale, sign, counts_per_turn}}``, or a TOML file with a
        ``[columns]`` table.

    Returns
    -------
    map, kind
        The kind is None where the file does not say it.
    """
    if columns is None:
        return {}, None
    if not isinstance(columns, (str, Path)):
        return columns, None
    path = Path(columns)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(
            f"column map {path}: cannot be read ({error.strerror}): check the path"
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(f"column map {path}: not valid TOML ({error}): correct it") from None
    table = from_toml(text, f"column map {path}")
    joint = table.get("joint")
    kind = joint.get("kind") if isinstance(joint, dict) else None
    found = table.get("columns")
    if found is None:
        found = {} if joint is not None else table
    if not isinstance(found, dict):
        raise InputError(
            f"column map {path}: [columns] must be a table of channel = {{ column = ..., unit = "
            f"... }}"
        )
    return found, kind if isinstance(kind, str) else None


def parse_map(
    raw: Mapping[str, Any], names: Sequence[str], units: Mapping[str, str], kind: str
) -> tuple[Column, ...]:
    """Check a column map against the columns of a file.

    Parameters
    ----------
    raw : mapping
        Channel to ``{column, unit, ...}`` or to the bare column name.
    names : sequence of str
        Columns of the file.
    units : mapping of str to str
        Units the file gives, by column.
    kind : {"rotary", "linear"}
        Kind of the axis.

    Raises
    ------
    InputError
        If a channel, key, column or unit is unknown, or a value is of the wrong type.
    """
    return tuple(_entry(channel, spec, names, units, kind) for channel, spec in raw.items())


def _entry(
    channel: str, spec: Any, names: Sequence[str], units: Mapping[str, str], kind: str
) -> Column:
    where = f"[columns] {channel}"
    wanted = channel_unit(channel, kind)
    table: dict[str, Any] = (
        {"column": spec} if isinstance(spec, str) else dict(spec) if hasattr(spec, "keys") else {}
    )
    if not table:
        raise InputError(
            f"{where}: {spec!r} is not a table: write {{ column = ... or formula = ..., unit = "
            f"..., scale, sign, counts_per_turn }}"
        )
    given = COLUMN.read(table, where)
    step, sign, scale, counts, unit = (
        given[k] for k in ("step", "sign", "scale", "counts_per_turn", "unit")
    )
    if step is not None:
        if channel != "time" or step <= 0.0:
            raise InputError(
                f"{where}: step {step!r} is for time only, and positive: give the sampling step"
            )
        return Column(
            "time", "", _fitting("s" if unit is None else unit, wanted, None, channel), step=step
        )
    formula = _formula(given, names, channel, where)
    column = given["column"] if formula is None else ""
    if formula is None and column not in names:
        raise InputError(f"{where}: no column {column!r} in the file: it has {shown(names)}")
    if sign not in (1.0, -1.0):
        raise InputError(f"{where}: sign is {sign!r}: it is 1 or -1")
    if scale == 0.0:
        raise InputError(f"{where}: scale is 0: give a number that is not zero")
    if unit is None and formula is None:
        own = recognise_quietly(column, kind, units.get(column))
        unit = (
            units.get(column)
            or split_unit(column)[1]
            or (own.unit if own and own.channel == channel else None)
        )
    if channel == "run":
        return Column("run", column, "1")
    if unit is None:
        said = f"column {column!r}" if formula is None else f"formula {formula.text!r}"
        raise InputError(
            f"{where}: {said} has no unit: add unit = {toml_string(wanted)}, or what it is in"
        )
    fitting = _fitting(unit, wanted, counts, channel)
    return Column(
        channel,
        column,
        fitting,
        scale,
        int(sign),
        counts,
        formula=formula,
    )


def _formula(
    table: Mapping[str, Any], names: Sequence[str], channel: str, where: str
) -> Formula | None:
    """The formula of an entry, None where it names a column."""
    text = table["formula"]
    if text is None:
        return None
    if table["column"] is not None:
        raise InputError(f'{where}: give either column = "..." or formula = "...", each a text')
    if channel == "run":
        raise InputError(f"{where}: runs are told by a column, not by a formula")
    try:
        return parse_formula(text, tuple(names))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _fitting(unit: str, wanted: str, counts: float | None, channel: str) -> str:
    try:
        check_unit(unit, wanted, counts, channel)
    except InputError as error:
        raise InputError(f"[columns] {error}{_other_kind(unit, wanted, channel)}") from None
    return unit


def _other_kind(unit: str, wanted: str, channel: str) -> str:
    """A hint where the unit is that of the channel of the other kind of axis."""
    other = "linear" if channel_unit(channel, "rotary") == wanted else "rotary"
    return (
        f"; for a {other} axis give kind = {other!r} in [joint] first"
        if header_unit(unit.replace("/", "_"), channel_unit(channel, other))
        else ""
    )


def recognise_quietly(name: str, kind: str, unit: str | None = None) -> Column | None:
    """As `recognise`, with None in place of an error."""
    try:
        return recognise(name, kind, unit)
    except InputError:
        return None


def choose(
    raw: Mapping[str, Any], names: Sequence[str], units: Mapping[str, str], kind: str, where: str
) -> tuple[tuple[Column, ...], tuple[str, ...]]:
    """Settle which columns are used: the map first, recognised headers for the other channels.

    Parameters
    ----------
    raw, names, units, kind
        As in `parse_map`.
    where : str
        The file, for messages.

    Returns
    -------
    columns, notes
        One `Column` a channel, time first; the notes name the columns that are not used.

    Raises
    ------
    InputError
        If time or every channel is missing; the message shows the guess as a TOML fragment in one
        line.
    """
    try:
        chosen = {entry.channel: entry for entry in parse_map(raw, names, units, kind)}
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    problems: dict[str, str] = {}
    mapped = {
        entry.column for entry in chosen.values() if entry.formula is None
    }  # a column of a formula may be a channel too
    for name in names:
        if name in mapped:
            continue
        try:
            found = recognise(name, kind, units.get(name))
        except InputError as error:
            problems[channel_of(name) or name] = str(error)
            continue
        if found is None or found.channel in raw:
            continue
        if found.channel in chosen:
            both = f"{chosen[found.channel].column!r} and {name!r}"
            raise InputError(
                f"{where}: columns {both} are both {found.channel}: choose one in [columns]"
            )
        chosen[found.channel] = found
    open_problems = [text for channel, text in problems.items() if channel not in chosen]
    missing = "time" if "time" not in chosen else "a channel"
    if "time" not in chosen or not set(chosen) - {"time", "run"} or (open_problems and not raw):
        said = open_problems[0] if open_problems else f"no column is recognised as {missing}"
        guesses = [g for g in guess_columns(names, units, kind) if g.column.channel not in chosen]
        raise InputError(f"{where}: {said}; {fragment(guesses, names, kind)}")
    used = {name for entry in chosen.values() for name in entry.sources}
    unused = [name for name in names if name not in used]
    notes = (f"columns not used: {shown(unused)}",) if unused else ()
    order = {name: place for place, name in enumerate(NAMES)}
    return tuple(sorted(chosen.values(), key=lambda entry: order[entry.channel])), notes
