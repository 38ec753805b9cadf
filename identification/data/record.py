"""One measurement: time and channels in SI, cut into contiguous stretches, with where it came
from.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.channels import CHANNELS, KINDS, channel_unit
from identification.errors import InputError
from identification.representation import html_of

__all__ = [
    "CHANNELS",
    "KINDS",
    "Checked",
    "Provenance",
    "Record",
    "channel_unit",
    "concat",
    "listed",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@final
@dataclass(frozen=True)
class Checked:
    """That a record went through the check gate.

    Attributes
    ----------
    by : tuple
        What it was held against: kind, gear ratio, torque per current, needed channels.
    repairs, doubts : tuple of str
        What the gate repaired and what it warns of, one line each.
    """

    by: tuple[object, ...] = ()
    repairs: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Repairs first, as the gate ranks them."""
        return (*self.repairs, *self.doubts)


@final
@dataclass(frozen=True)
class Provenance:
    """Where a record came from and what was done to it.

    Attributes
    ----------
    paths, sha256 : tuple of str
        Source files and their digests.
    reader : str
        Name of the format's reader.
    columns : tuple of str
        The column map used, one sentence a channel.
    notes : tuple of str
        Repairs and conversions, in the order they were made.
    lost : tuple of (channel, why)
        Channels that the source names and does not give.
    checked : Checked, optional
        Set by the gate, taken off where values change; a part of a checked record is checked.
    """

    paths: tuple[str, ...] = ()
    sha256: tuple[str, ...] = ()
    reader: str = "memory"
    columns: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    checked: Checked | None = None
    lost: tuple[tuple[str, str], ...] = ()

    def noted(self, *notes: str) -> Provenance:
        """Return the same provenance with notes added."""
        return replace(self, notes=self.notes + notes)


def _readonly(values: FloatArray) -> FloatArray:
    view = values.view()
    view.flags.writeable = False
    return view


NEAR_START: Final = 10
"""Median steps within which a run must begin where the one before began, for a stamp that goes
back to mean a new run.
"""


def _restarts(time: FloatArray) -> IntArray:
    """Number of the run of each sample: a run begins where time goes back to where the run
    before began.
    """
    out = np.zeros(time.shape, dtype=np.int64)
    if time.ndim != 1 or time.size < 2:
        return out
    with np.errstate(invalid="ignore"):  # stamps that are infinite
        steps = np.diff(time)
    back = np.flatnonzero(steps < 0.0) + 1
    if not back.size:
        return out
    near = NEAR_START * float(np.nanmedian(np.abs(steps)))
    start = 0
    for row in back.tolist():
        if abs(time[row] - time[start]) <= near and row - start > NEAR_START:
            out[row:] += 1
            start = row
    return out


def _renumbered(segment: IntArray) -> IntArray:
    if segment.size == 0:
        return segment
    return np.concatenate([[0], np.cumsum(np.diff(segment) != 0)]).astype(np.int64)


@final
@dataclass(frozen=True, eq=False)
class Record:
    """One measurement in SI units.

    Attributes
    ----------
    name : str
        Short name, usually of the file.
    kind : {"rotary", "linear"}
        With ``"linear"`` m, m/s and N stand in place of rad, rad/s and N.m.
    time : (n,) ndarray
        Time stamps [s]; may be irregular.  Several runs may each start at their own time.
    channels : mapping of str to (n,) ndarray
        SI values by channel name (`CHANNELS`); read-only arrays.
    segment : (n,) ndarray of int
        Number of the contiguous stretch a sample belongs to: never differentiate or integrate
        across a change.
    provenance : Provenance
        Source and repairs.
    payload : str
        What the link carries. Records with another payload than the first one share the motor's and
        the transmission's parameters, not the link's.
    age : (n,) ndarray, optional
        Time since the run of each sample began [s], for a record that was cut off a longer one (see
        `run_age`).
    measured : (n,) ndarray of bool, optional
        False for a sample that was lost and bridged from its neighbours.
    quanta : mapping of str to float
        Step in which a channel was read whose values are no longer whole steps, in its unit.

    Raises
    ------
    InputError
        If lengths differ, a channel is unknown or the kind is neither of the two.
    """

    name: str
    kind: str
    time: FloatArray
    channels: Mapping[str, FloatArray]
    segment: IntArray
    provenance: Provenance = field(default_factory=Provenance)
    payload: str = ""
    age: FloatArray | None = None
    measured: npt.NDArray[np.bool_] | None = None
    quanta: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        time = np.ascontiguousarray(self.time, dtype=np.float64)
        segment = np.ascontiguousarray(self.segment, dtype=np.int64)
        if time.ndim != 1 or segment.shape != time.shape:
            raise InputError(
                f"record {self.name!r}: time and segment must be vectors of one length"
            )
        channels: dict[str, FloatArray] = {}
        for key, values in self.channels.items():
            channel_unit(key, self.kind)
            array = np.ascontiguousarray(values, dtype=np.float64)
            if key == "time" or array.shape != time.shape:
                raise InputError(
                    f"record {self.name!r}: channel {key} has shape {array.shape}, time has "
                    f"{time.shape}"
                )
            channels[key] = _readonly(array)
        channel_unit("time", self.kind)
        if self.age is not None and self.age.shape != time.shape:
            raise InputError(
                f"record {self.name!r}: age has shape {self.age.shape}, time has {time.shape}"
            )
        if self.measured is not None and self.measured.shape != time.shape:
            raise InputError(
                f"record {self.name!r}: measured has shape {self.measured.shape}, time has "
                f"{time.shape}"
            )
        object.__setattr__(self, "time", _readonly(time))
        object.__setattr__(self, "segment", segment)
        object.__setattr__(self, "channels", MappingProxyType(channels))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by value: records travel to worker processes."""
        return Record, (
            self.name,
            self.kind,
            self.time,
            dict(self.channels),
            self.segment,
            self.provenance,
            self.payload,
            self.age,
            self.measured,
            dict(self.quanta),
        )

    @classmethod
    def from_channels(
        cls,
        time: npt.ArrayLike,
        channels: Mapping[str, npt.ArrayLike],
        *,
        name: str = "record",
        kind: str = "rotary",
        provenance: Provenance | None = None,
    ) -> Record:
        """Make a record from arrays in SI; a ``run`` channel, and time that starts again, cut it
        into segments.

        Parameters
        ----------
        time : (n,) array_like
            Time stamps [s].
        channels : mapping of str to (n,) array_like
            SI values by channel name.
        name, kind, provenance
            As in the class.
        """
        stamps = np.asarray(time, dtype=np.float64)
        arrays = {key: np.asarray(values, dtype=np.float64) for key, values in channels.items()}
        segment = np.zeros(stamps.shape, dtype=np.int64)
        run = arrays.get("run")
        if run is not None and run.size > 1 and run.shape == stamps.shape:
            segment[1:] = np.cumsum(np.diff(run) != 0.0)
        segment = segment + _restarts(stamps)
        return cls(name, kind, stamps, arrays, segment, provenance or Provenance())

    def __len__(self) -> int:
        return int(self.time.size)

    def __getitem__(self, channel: str) -> FloatArray:
        """Values of a channel, or ``"time"``; an `InputError` says which channel is missing."""
        if channel == "time":
            return self.time
        if channel not in self.channels:
            channel_unit(channel, self.kind)
            raise InputError(
                f"record {self.name!r} has no channel {channel} (it has "
                f"{', '.join(self.channels)}): measure it or name its column in [columns]"
            )
        return self.channels[channel]

    def has(self, *channels: str) -> bool:
        """Whether all the channels are there."""
        return all(channel in self.channels for channel in channels)

    def unit(self, channel: str) -> str:
        """SI unit of a channel in this record."""
        return channel_unit(channel, self.kind)

    def segments(self) -> list[slice]:
        """Contiguous stretches, one slice each, in order."""
        return list(self._segments)

    @cached_property
    def _segments(self) -> tuple[slice, ...]:
        if len(self) == 0:
            return ()
        cuts = np.flatnonzero(np.diff(self.segment)) + 1
        edges = [0, *cuts.tolist(), len(self)]
        return tuple(slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True))

    def steps(self) -> FloatArray:
        """Time steps within segments [s], concatenated; at most n - 1."""
        inside = np.diff(self.segment) == 0
        result: FloatArray = np.diff(self.time)[inside]
        return result

    @cached_property
    def dt(self) -> float:
        """Median time step within segments [s]; NaN where there is none."""
        steps = self.steps()
        steps = steps[np.isfinite(steps)]
        return float(np.median(steps)) if steps.size else float("nan")

    @property
    def duration(self) -> float:
        """Measured time [s]: the sum over segments of last stamp minus first."""
        with np.errstate(invalid="ignore"):  # stamps that are infinite
            return float(sum(self.time[s.stop - 1] - self.time[s.start] for s in self.segments()))

    def take(self, rows: slice | npt.NDArray[np.bool_] | IntArray, *notes: str) -> Record:
        """Return the record of some rows; a stretch interrupted by left-out rows becomes several
        segments.

        Parameters
        ----------
        rows : slice, mask or index array
            Rows to keep, in increasing order.
        notes : str
            Noted in the provenance.
        """
        index = np.arange(len(self), dtype=np.int64)[rows]
        segment = self.segment[index]
        if index.size > 1:
            cut = (np.diff(segment) != 0) | (np.diff(index) != 1)
            segment = np.concatenate([[0], np.cumsum(cut)]).astype(np.int64)
        else:
            segment = np.zeros(index.size, dtype=np.int64)
        selector = rows if isinstance(rows, slice) else index
        return replace(
            self,
            time=self.time[selector],
            channels={key: values[selector] for key, values in self.channels.items()},
            segment=segment,
            age=None if self.age is None else self.age[selector],
            measured=None if self.measured is None else self.measured[selector],
            provenance=self.provenance.noted(*notes),
        )

    def window(self, t0: float, t1: float) -> Record:
        """Return the samples with t0 <= time <= t1 [s]."""
        keep = (self.time >= t0) & (self.time <= t1)
        if not keep.any():
            raise InputError(
                f"record {self.name!r}: no sample between {t0:g} and {t1:g} s: choose another "
                "window"
            )
        return self.take(keep, f"window {t0:g} to {t1:g} s")

    def split(self, fraction: float = 0.7, blocks: int = 1) -> tuple[Record, Record]:
        """Split by time: the first part of every block, and the rest.

        Every segment is cut into `blocks` blocks of equal duration; of each block the first
        `fraction` of the time goes to the first record, the rest to the second.

        Parameters
        ----------
        fraction : float
            Between 0 and 1.
        blocks : int
            Blocks a segment; more blocks let both parts see the whole range of a trajectory that
            changes with time.

        Returns
        -------
        first, second : Record

        Raises
        ------
        InputError
            If the fraction is not between 0 and 1, or a part would be empty.
        """
        if not (0.0 < fraction < 1.0 and blocks >= 1):
            raise InputError(
                f"split: fraction must lie between 0 and 1 (is {fraction!r}), blocks be at least 1"
            )
        first = np.zeros(len(self), dtype=np.bool_)
        for part in self.segments():
            stamps = self.time[part]
            span = float(stamps[-1] - stamps[0])
            place = (stamps - stamps[0]) / span * blocks if span > 0.0 else np.zeros(stamps.size)
            inside = place - np.minimum(np.floor(place), blocks - 1)
            first[part] = inside < fraction
        if first.all() or not first.any():
            raise InputError(
                f"record {self.name!r}: too short to split at {fraction:g}: give a longer record"
            )
        label = f"{100 * fraction:g} % of the time" + (
            f" in each of {blocks} blocks" if blocks > 1 else ""
        )
        whole = replace(self, age=self.run_age())
        return whole.take(first, f"split: first {label}"), whole.take(
            ~first, f"split: all but the first {label}"
        )

    def run_age(self) -> FloatArray:
        """Time since the run of each sample began [s], shape (n,); a run begins with the record
        and where the stamps go back.
        """
        if self.age is not None:
            return self.age
        restart = np.concatenate([[0], np.flatnonzero(np.diff(self.time) < 0) + 1])
        starts = np.repeat(self.time[restart], np.diff(np.append(restart, len(self.time))))
        return np.asarray(self.time - starts, dtype=np.float64)

    def with_channel(self, channel: str, values: npt.ArrayLike, note: str | None = None) -> Record:
        """Return the record with a channel added or replaced (SI values, shape (n,))."""
        channels = {**self.channels, channel: np.asarray(values, dtype=np.float64)}
        provenance = self.provenance.noted(note) if note else self.provenance
        return replace(self, channels=channels, provenance=replace(provenance, checked=None))

    def without(self, *channels: str) -> Record:
        """Return the record without some channels."""
        kept = {key: v for key, v in self.channels.items() if key not in channels}
        return replace(self, channels=kept, provenance=replace(self.provenance, checked=None))

    def renamed(self, name: str) -> Record:
        """Return the record under another name."""
        return replace(self, name=name)

    def resampled(self, dt: float | None = None) -> Record:
        """Return the record on a uniform time grid, by linear interpolation within each segment.

        Parameters
        ----------
        dt : float, optional
            Time step [s]; the median step where it is left out.

        Raises
        ------
        InputError
            If dt is not positive, or time does not increase within a segment.
        """
        step = self.dt if dt is None else float(dt)
        if not (np.isfinite(step) and step > 0.0):
            raise InputError(
                f"record {self.name!r}: time step {step!r} cannot be used: give a positive dt in "
                "seconds"
            )
        steps = self.steps()
        if not (np.isfinite(self.time).all() and (steps > 0.0).all()):
            raise InputError(
                f"record {self.name!r}: time does not increase everywhere: repair the record first"
            )
        times, segments = [], []
        for number, part in enumerate(self.segments()):
            stamps = self.time[part]
            count = int(np.floor((stamps[-1] - stamps[0]) / step * (1.0 + 1e-12) + 1e-9)) + 1
            times.append(stamps[0] + step * np.arange(count))
            segments.append(np.full(count, number, dtype=np.int64))
        channels: dict[str, FloatArray] = {}
        for key, values in self.channels.items():
            pieces = [
                np.interp(t, self.time[p], values[p])
                for t, p in zip(times, self.segments(), strict=True)
            ]
            channels[key] = np.concatenate(pieces)
        note = (
            f"resampled by linear interpolation to dt = {step:.9g} s (median step was "
            f"{self.dt:.9g} s)"
        )
        return replace(
            self,
            time=np.concatenate(times),
            channels=channels,
            segment=np.concatenate(segments),
            age=None
            if self.age is None
            else np.concatenate(
                [
                    np.interp(t, self.time[p], self.age[p])
                    for t, p in zip(times, self.segments(), strict=True)
                ]
            ),
            measured=self._resampled_flags(times),
            provenance=self.provenance.noted(note),
        )

    def _resampled_flags(self, times: Sequence[FloatArray]) -> npt.NDArray[np.bool_] | None:
        """Which of the new samples lie between samples that were measured."""
        if self.measured is None:
            return None
        flags = self.measured.astype(np.float64)
        return (
            np.concatenate(
                [
                    np.interp(t, self.time[p], flags[p])
                    for t, p in zip(times, self.segments(), strict=True)
                ]
            )
            > 0.5
        )

    def _repr_html_(self) -> str | None:
        return html_of(self)

    def __repr__(self) -> str:
        return (
            f"Record({self.name!r}, {self.kind}, {len(self)} samples, {self.duration:.6g} s, "
            f"{len(self.segments())} segment(s), channels: {', '.join(self.channels)})"
        )


def concat(records: Sequence[Record], name: str | None = None) -> Record:
    """Join records end to end; every one keeps its own segments and time stamps.

    Parameters
    ----------
    records : sequence of Record
        Of one kind.  Channels that are not in all of them are left out, and that is noted.
    name : str, optional
        Name of the result; the names joined by `` + `` where it is left out.

    Raises
    ------
    InputError
        If there is no record, the kinds differ, or no channel is common.
    """
    if not records:
        raise InputError("no record to join: give at least one")
    kinds = {record.kind for record in records}
    if len(kinds) > 1:
        raise InputError(
            f"records of different kinds ({', '.join(sorted(kinds))}) cannot be joined: fit them "
            "apart"
        )
    common = [key for key in records[0].channels if all(record.has(key) for record in records)]
    if not common:
        raise InputError("the records have no channel in common: check their column maps")
    dropped = sorted({key for record in records for key in record.channels} - set(common))
    segments: list[IntArray] = []
    offset = 0
    for record in records:
        numbers = _renumbered(record.segment) + offset
        segments.append(numbers)
        offset = int(numbers[-1]) + 1 if numbers.size else offset
    channels = {key: np.concatenate([record.channels[key] for record in records]) for key in common}
    if "run" in channels:
        channels["run"] = np.concatenate(segments).astype(np.float64)
    notes = [f"{record.name}: {note}" for record in records for note in record.provenance.notes]
    if dropped:
        notes.append(f"joined; channels not in every record left out: {', '.join(dropped)}")
    return Record(
        name or " + ".join(record.name for record in records),
        records[0].kind,
        np.concatenate([record.time for record in records]),
        channels,
        np.concatenate(segments),
        Provenance(
            tuple(path for record in records for path in record.provenance.paths),
            tuple(digest for record in records for digest in record.provenance.sha256),
            " + ".join(dict.fromkeys(record.provenance.reader for record in records)),
            tuple(dict.fromkeys(line for record in records for line in record.provenance.columns)),
            tuple(notes),
            lost=tuple(dict.fromkeys(one for record in records for one in record.provenance.lost)),
        ),
        age=None
        if all(record.age is None for record in records)
        else np.concatenate([record.run_age() for record in records]),
        measured=None
        if all(record.measured is None for record in records)
        else np.concatenate(
            [
                np.ones(len(record), dtype=np.bool_) if record.measured is None else record.measured
                for record in records
            ]
        ),
    )


def listed(records: Record | Sequence[Record]) -> list[Record]:
    """One record, or several, as a list.

    Raises
    ------
    InputError
        Something else.
    """
    found = [records] if isinstance(records, Record) else records
    kinds = (str, bytes, Mapping)
    several = isinstance(found, Iterable) and not isinstance(found, kinds)
    strange = [x for x in (found if several else [found]) if not isinstance(x, Record)]
    if strange:
        raise InputError(
            f"a record, or a list of them, is needed, and not {type(strange[0]).__name__}: "
            "read(FILE) gives one"
        )
    return list(found)
