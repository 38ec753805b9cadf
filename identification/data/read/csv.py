"""Text files: CSV, TSV and the like, with numpy's C reader; a slow path names the bad cell."""

from __future__ import annotations

import codecs
import csv as _csv
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.read._table import Table
from identification.data.units import base_unit
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import TextIO

FloatColumn = npt.NDArray[np.float64]

MOSTLY: Final = 0.9
"""Share of the high bytes that are 0 in a table of numbers as UTF-16; the rest are letters of other
scripts in the header.
"""
_MARKS: Final = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
_HEAD_BYTES: Final = 1 << 17
_HEAD_LINES: Final = 100
MOST_COLUMNS: Final = 10_000
"""Columns of a text file: ten times those of the largest logs; more are the samples of a table that
lies on its side.
"""
_CLOCK: Final = re.compile(r"\d{4}-\d\d?-\d\d?|\d\d?:\d\d|\d\d?[./]\d\d?[./]\d{2,4}")
_MISSING: Final = frozenset({"", "nan", "na", "n/a", "null", "none", "-nan", "#n/a"})
_NUMBER: Final = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?\s*$")
_COMMA_NUMBER: Final = re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$")
_COMMENT: Final = ("#", "%", "//")


@final
@dataclass(frozen=True)
class _Layout:
    """How a text file is laid out."""

    path: Path
    encoding: str
    delimiter: str | None
    comma: bool
    names: tuple[str, ...]
    units: Mapping[str, str]
    skip: int
    notes: tuple[str, ...]

    @property
    def wide(self) -> bool:
        """Whether a character takes two bytes."""
        return self.encoding.startswith("utf-16")

    def open(self) -> TextIO:
        return self.path.open(encoding=self.encoding, errors="replace", newline="")


def open_csv(path: Path) -> Table:
    """Look at a text file: delimiter, decimal comma, header, units row, comments, byte order mark.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    InputError
        If it is empty or no table is found in it.
    """
    layout = _layout(path)
    return Table(
        reader="text",
        names=tuple(name for name in layout.names if name),
        load=lambda numeric, text: _load(layout, numeric, text),
        units=layout.units,
        notes=layout.notes,
        first_row=layout.skip + 1,
    )


def head_of(path: Path) -> int:
    """Number of lines before the first row of numbers.

    Raises
    ------
    InputError
        No table of numbers.
    """
    return _layout(path).skip


def _decode(path: Path) -> tuple[str, list[str], bool]:
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    whole = len(head) < _HEAD_BYTES
    if wide := wide_encoding(head):
        encoding = "utf-16" if head.startswith(tuple(_MARKS)) else wide
        head = head[: len(head) // 2 * 2]
    elif b"\x00" in head:
        raise InputError(
            f"{path}: is not a text file nor a known binary format: export CSV, MAT, NPZ, HDF5 "
            "or Parquet"
        )
    else:
        encoding = "utf-8-sig"
    try:
        text = _text_of(head, encoding, whole=whole)
    except UnicodeDecodeError:
        encoding = "latin-1"
        text = _text_of(head, encoding, whole=whole)
    if not text.strip():
        raise InputError(f"{path}: is empty: record again or give another file")
    return encoding, text.splitlines(), whole


def _text_of(head: bytes, encoding: str, *, whole: bool) -> str:
    """The whole lines of a file's head, which may end in the middle of a letter."""
    text = codecs.getincrementaldecoder(encoding)().decode(head, final=whole)
    return text if whole else text[: text.rfind("\n") + 1] or text


def wide_encoding(head: bytes) -> str | None:
    """Which UTF-16 the first bytes of a text file are: that of its mark; without one, of text in a
    table nearly every other byte is 0, of a binary file hardly. None where a character is a byte.
    """
    if marked := _MARKS.get(head[:2]):
        return marked
    for encoding, high, low in (
        ("utf-16-le", head[1::2], head[::2]),
        ("utf-16-be", head[::2], head[1::2]),
    ):
        if len(head) > 2 and high.count(0) > MOSTLY * len(high) and low.count(0) == 0:
            return encoding
    return None


def _delimiter(line: str) -> str | None:
    for mark in (";", "\t", ",", "|"):
        if mark in line:
            spaced = line.split() if mark == "," else []
            if len(spaced) > 1 and all(_numeric(cell, True) for cell in spaced):
                return None  # decimal commas, and spaces between the columns
            return mark
    return None


def _cells(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(_csv.reader([line], delimiter=delimiter), [])]
    except _csv.Error:
        return [line]


def _numeric(cell: str, comma: bool) -> bool:
    if _NUMBER.match(cell) or cell.strip().lower() in _MISSING - {""} | {"inf", "-inf"}:
        return True
    return comma and bool(_COMMA_NUMBER.match(cell))


def _is_data(line: str, delimiter: str | None) -> bool:
    return any(_numeric(cell, delimiter != ",") for cell in _cells(line, delimiter))


def _layout(path: Path) -> _Layout:
    encoding, lines, whole = _decode(path)
    body = [
        (number, line)
        for number, line in enumerate(lines[:_HEAD_LINES])
        if line.strip() and not line.lstrip().startswith(_COMMENT)
    ]
    first = None
    delimiter: str | None = None
    for place, (_, line) in enumerate(body):
        delimiter = _delimiter(line)
        count = len(_cells(line, delimiter))
        following = body[place + 1][1] if place + 1 < len(body) else None
        if _is_data(line, delimiter) and (
            following is None or len(_cells(following, delimiter)) == count
        ):
            first = place
            break
    if first is None:
        if whole and body:
            raise InputError(
                f"{path}: has a header but no row of numbers: record again or give another file"
            )
        raise InputError(
            f"{path}: no table of numbers found in its first {_HEAD_LINES} lines: export it as CSV"
        )
    number, line = body[first]
    cells = _cells(line, delimiter)
    if len(cells) > MOST_COLUMNS:
        raise InputError(
            f"{path}: has more than {MOST_COLUMNS} columns; a record has a row for each sample: "
            "exchange rows and columns, or leave columns out"
        )
    comma = delimiter != "," and _decimal_comma(lines[number:], delimiter, path)
    names, units, used = _header([text for _, text in body[:first]], delimiter, len(cells), path)
    notes: list[str] = []
    if not names:
        names = tuple(f"column{k + 1}" for k in range(len(cells)))
        notes.append("no header: columns are named column1, column2, ...")
    if first > used:
        notes.append(f"{first - used} line(s) before the header skipped")
    if comma:
        notes.append("decimal comma")
    return _Layout(
        path,
        encoding,
        delimiter=delimiter,
        comma=comma,
        names=names,
        units=units,
        skip=number,
        notes=tuple(notes),
    )


def _decimal_comma(lines: Sequence[str], delimiter: str | None, path: Path) -> bool:
    """Whether numbers are written 1,5: judged by all rows of the file's head, for the first ones
    may be whole numbers.

    Raises
    ------
    InputError
        Commas and points: one of them must part thousands, and nothing says which.
    """
    found = [
        cell
        for line in lines
        if "," in line
        for cell in _cells(line, delimiter)
        if _COMMA_NUMBER.match(cell)
    ]
    if not found:
        return False
    for line in lines:
        for cell in _cells(line, delimiter) if "." in line else ():
            if "." in cell and _NUMBER.match(cell):
                raise InputError(
                    f"{path}: has both decimal commas ({found[0].strip()}) and decimal points "
                    f"({cell.strip()}): write one of them"
                )
    return True


def _header(
    lines: list[str], delimiter: str | None, width: int, path: Path
) -> tuple[tuple[str, ...], Mapping[str, str], int]:
    """Find names and units in the lines before the first row of numbers; the count is of lines
    used.
    """
    rows = [_cells(line, delimiter) for line in lines]
    if not rows:
        return (), {}, 0
    units: dict[int, str] = {}
    used = 1
    names = rows[-1]
    if len(rows) > 1 and len(rows[-2]) == len(rows[-1]) and (found := _unit_row(rows[-1])):
        units, names, used = found, rows[-2], 2
    if len(names) not in {width, width - 1} and not (len(names) > width and not any(names[width:])):
        raise InputError(
            f"{path}: the header has {len(names)} columns, the first data row {width}: make them "
            "agree"
        )
    names = [name.strip() for name in names[:width]]
    doubled = sorted(name for name, count in Counter(names).items() if name and count > 1)
    if doubled:
        raise InputError(
            f"{path}: column name {doubled[0]!r} stands more than once in the header: rename one"
        )
    return tuple(names), {names[k]: unit for k, unit in units.items() if names[k]}, used


def _unit_row(cells: list[str]) -> dict[int, str] | None:
    units: dict[int, str] = {}
    for place, cell in enumerate(cells):
        text = cell.strip().strip("[]()").strip()
        if text in {"", "-", "--"}:
            continue
        try:
            base_unit(text, 1.0)
        except InputError:
            return None
        units[place] = text
    return units or None


def _load(
    layout: _Layout, numeric: Sequence[str], text: Sequence[str]
) -> Mapping[str, npt.NDArray[Any]]:
    result: dict[str, npt.NDArray[Any]] = {}
    places = [layout.names.index(name) for name in numeric]
    columns = _fast(layout, places)
    if columns is None:
        columns = _slow(layout, places)
    result.update(zip(numeric, columns, strict=True))
    for name in text:
        result[name] = _text(layout, layout.names.index(name))
    return result


def _lines(layout: _Layout) -> Iterator[str]:
    with layout.open() as stream:
        for number, line in enumerate(stream):
            if number >= layout.skip:
                yield line.replace(",", ".") if layout.comma else line


def _fast(layout: _Layout, places: Sequence[int]) -> list[FloatColumn] | None:
    """Read with numpy's C reader; None where it meets something it cannot read."""
    if not places:
        return []
    packed = layout.path.suffix.lower() in {".gz", ".bz2", ".xz"}
    plain = not layout.wide and not layout.comma and not packed
    whole = list(places) == list(range(len(layout.names)))
    try:
        if not whole and not _regular(layout):
            return None
        table = np.loadtxt(
            str(layout.path) if plain else _lines(layout),
            delimiter=layout.delimiter,
            skiprows=layout.skip if plain else 0,
            usecols=None if whole else places,
            ndmin=2,
            comments="#",
            quotechar='"',
            encoding=layout.encoding if plain else None,
        )
    except (ValueError, UnicodeDecodeError):
        return None
    if table.shape[1] != len(places):
        return None
    return [np.ascontiguousarray(table[:, k]) for k in range(table.shape[1])]


def _regular(layout: _Layout) -> bool:
    """Whether every line has the same number of delimiters, so that no row has shifted cells."""
    if layout.delimiter is None:
        return True
    if layout.wide:
        return False  # the rows are read one by one
    mark = ord(layout.delimiter)
    with layout.path.open("rb") as stream:
        for _ in range(layout.skip):
            stream.readline()
        rest = b""
        wanted: int | None = None
        while block := stream.read(1 << 22):
            whole, newline, rest = (rest + block).rpartition(b"\n")
            counts = _marks_per_line(whole + newline, mark)
            if counts.size:
                wanted = int(counts[0]) if wanted is None else wanted
                if (counts != wanted).any():
                    return False
        counts = _marks_per_line(rest + b"\n", mark)
    return not counts.size or wanted is None or bool((counts == wanted).all())


def _marks_per_line(block: bytes, mark: int) -> npt.NDArray[np.int64]:
    """Number of marks in every line that is not blank."""
    characters = np.frombuffer(block, dtype=np.uint8)
    ends = np.flatnonzero(characters == 10)
    counts = np.diff(np.searchsorted(np.flatnonzero(characters == mark), ends), prepend=0)
    lengths = np.diff(ends, prepend=-1) - 1
    blank = (lengths == 0) | ((lengths == 1) & (characters[ends - 1] == 13))
    result: npt.NDArray[np.int64] = counts[~blank].astype(np.int64)
    return result


def _rows(layout: _Layout) -> Iterator[tuple[int, list[str]]]:
    with layout.open() as stream:
        for number, line in enumerate(stream, start=1):
            if number <= layout.skip or not line.strip() or line.lstrip().startswith(_COMMENT):
                continue
            yield (
                number,
                _cells(
                    line.split("#")[0] if "#" in line and '"' not in line else line,
                    layout.delimiter,
                ),
            )


def _slow(layout: _Layout, places: Sequence[int]) -> list[FloatColumn]:
    """Read cell by cell: empty cells become NaN, anything else that is no number is an error
    with its place.
    """
    columns: list[list[float]] = [[] for _ in places]
    width = len(layout.names)
    for number, cells in _rows(layout):
        if len(cells) > width and not any(cells[width:]):
            cells = cells[:width]
        if len(cells) != width and not (len(cells) == width - 1 and not layout.names[-1]):
            raise InputError(
                f"{layout.path}, line {number}: {len(cells)} cells where the header has {width}: "
                "correct the line or cut the file there"
            )
        for values, place in zip(columns, places, strict=True):
            values.append(_number(cells[place], layout, number, place))
    return [np.array(values, dtype=np.float64) for values in columns]


def _number(cell: str, layout: _Layout, number: int, place: int) -> float:
    text = cell.strip()
    try:
        if (
            "_" in text or not text.isascii()
        ):  # Python takes 1_000 and the digits of other scripts, a table means something else
            raise ValueError(text)
        return float(text.replace(",", ".") if layout.comma else text)
    except ValueError:
        if text.lower() in _MISSING:
            return float("nan")
        advice = (
            "a date or a time of day: write seconds from the start of the record"
            if _CLOCK.search(text)
            else "correct the cell or leave it empty"
        )
        raise InputError(
            f"{layout.path}, line {number}, column {layout.names[place]!r}: {text[:40]!r} is not "
            f"a number: {advice}"
        ) from None


def _text(layout: _Layout, place: int) -> npt.NDArray[Any]:
    if not layout.wide and _regular(layout):
        try:
            return np.loadtxt(
                str(layout.path),
                delimiter=layout.delimiter,
                skiprows=layout.skip,
                usecols=[place],
                ndmin=1,
                dtype=str,
                comments="#",
                quotechar='"',
                encoding=layout.encoding,
            )
        except (ValueError, OSError):
            pass  # the rows are read one by one
    return np.array([cells[place] for _, cells in _rows(layout)])
