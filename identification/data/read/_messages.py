"""Robot messages to signals: numeric fields by path, joint states by joint name, one stamp a
message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from identification.data.read._table import RATES, Signal, Table, merged
from identification.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

_ARRAY_LIMIT = 64  # longer arrays are images, point clouds and the like


@final
@dataclass
class Collector:
    """Collects the numeric fields of messages as they are read."""

    fields: dict[str, tuple[str, list[float], list[float]]] = field(default_factory=dict)
    odd_topics: set[str] = field(default_factory=set)

    def add(self, topic: str, logged: float, message: Any) -> None:
        """Take one message.

        Parameters
        ----------
        topic : str
            Its topic.
        logged : float
            Time at which it was logged [s]; used where it has no header stamp.
        message : object or mapping
            The decoded message.
        """
        stamp = _stamp(message)
        time = logged if stamp is None else stamp
        names = _get(message, "name")
        labels = [str(n) for n in names] if isinstance(names, (list, tuple)) else None
        found: dict[str, float] = {}
        _numbers("", message, labels, found)
        for path, value in found.items():
            _, stamps, values = self.fields.setdefault(topic + path, (topic, [], []))
            stamps.append(time)
            values.append(value)

    def table(self, reader: str, path: Path) -> Table:
        """Return the table of what was collected; stamps count from the first one in the file."""
        if not self.fields:
            odd = (
                f" (topics in an unknown encoding: {', '.join(sorted(self.odd_topics))})"
                if self.odd_topics
                else ""
            )
            raise InputError(
                f"{path}: holds no numeric message field{odd}: record joint states or plain numbers"
            )
        start = min(stamps[0] for _, stamps, _ in self.fields.values())
        signals = {
            name: Signal(
                np.array(stamps, dtype=np.float64) - start,
                np.array(values, dtype=np.float64),
                topic,
            )
            for name, (topic, stamps, values) in self.fields.items()
        }

        def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
            return merged(signals, [*numeric, *text], "time", str(path))

        notes = [f"time counts from the first stamp of the file, {start:.9f} s"]
        if len({signal.group for signal in signals.values()}) > 1:
            notes.append(RATES)
        if self.odd_topics:
            notes.append(
                f"topics in an unknown encoding left out: {', '.join(sorted(self.odd_topics))}"
            )
        return Table(reader, ("time", *signals), load, {"time": "s"}, tuple(notes))


def _get(message: Any, key: str) -> Any:
    return message.get(key) if isinstance(message, Mapping) else getattr(message, key, None)


def _stamp(message: Any) -> float | None:
    stamp = _get(_get(message, "header"), "stamp")
    seconds = _get(stamp, "sec")
    if seconds is None:
        return None
    total = float(seconds) + 1e-9 * float(_get(stamp, "nanosec") or _get(stamp, "nsec") or 0)
    return total or None


def _items(message: Any) -> list[tuple[str, Any]]:
    if isinstance(message, Mapping):
        return [(str(key), value) for key, value in message.items()]
    keys = getattr(message, "__dataclass_fields__", {})
    return [(key, getattr(message, key)) for key in keys if not key.startswith("_")]


def _numbers(path: str, value: Any, labels: list[str] | None, into: dict[str, float]) -> None:
    if isinstance(value, (bool, int, float, np.number)):
        into[path] = float(value)
    elif isinstance(value, (list, tuple, np.ndarray)):
        if len(value) > _ARRAY_LIMIT:
            return
        named = (
            labels
            if labels is not None and len(labels) == len(value)
            else [str(k) for k in range(len(value))]
        )
        for label, entry in zip(named, value, strict=True):
            _numbers(f"{path}[{label}]", entry, None, into)
    else:
        for key, entry in _items(value):
            if key not in {"header", "layout", "__msgtype__"}:
                _numbers(f"{path}/{key}", entry, labels, into)
