"""What a co-simulation reads and writes at each communication point, laid out once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from identification.errors import InputError
from irj_fmu.host.fmu import Block, Instance, Wiring
from irj_fmu.host.signals import FloatArray, Signal, Table


@final
@dataclass(frozen=True)
class _Feed:
    """One block of inputs: its samples by communication point, and the places in it that are
    known only then.
    """

    instance: Instance
    block: Block
    values: Any
    """The block's values as an array."""
    rows: Any
    live: tuple[tuple[int, str], ...]
    """Place in the block and full name of inputs with a connection or a fault."""


@final
class Plan:
    """The reads and writes of one co-simulation.

    Functions of time are sampled beforehand; connections and faults are worked out at each point.

    Parameters
    ----------
    instances : mapping
        Name to instance.
    wiring : Wiring
        What goes where.
    time : array, shape (n,)
        Communication points in s.

    Attributes
    ----------
    table : array, shape (n, names)
        The recorded variables.

    Raises
    ------
    InputError
        Where a name is unknown, an input is fed twice, or a fault lies on an input that nothing
        feeds.
    """

    def __init__(self, instances: Mapping[str, Instance], wiring: Wiring, time: FloatArray) -> None:
        both = wiring.connections.keys() & wiring.inputs.keys()
        if both:
            raise InputError(
                f"input {min(both)!r} has both a connection and a function of time; leave one out"
            )
        fed = [*wiring.connections, *wiring.inputs]
        for name in wiring.faults:
            if name not in fed:
                raise InputError(
                    f"fault on {name!r}: nothing feeds this input; faults act on inputs that are "
                    "fed"
                )
        for name in (*fed, *wiring.connections.values(), *wiring.record, *wiring.parameters):
            _split(name, instances)
        self.wiring = wiring
        self.times = time.tolist()
        self.values: dict[str, float] = {}
        self.reads = _blocks(instances, sorted({*wiring.connections.values()}))
        self.feeds = [self._feed(place, time) for place in _blocks(instances, fed)]
        self.table = np.empty((len(time), len(wiring.record)))
        where = {
            name: [i for i, n in enumerate(wiring.record) if n == name] for name in wiring.record
        }
        self.notes = [
            (instance, block, _array(block), *_columns(prefix, block, where))
            for prefix, instance, block in _blocks(instances, sorted({*wiring.record}))
        ]

    def _feed(self, place: _Place, time: FloatArray) -> _Feed:
        prefix, instance, block = place
        wiring, columns, live = self.wiring, [], []
        for i, name in enumerate(block.names):
            full = prefix + name
            if full in wiring.connections or full in wiring.faults:
                live.append((i, full))
            signal = wiring.inputs.get(full)
            columns.append(np.zeros(len(time)) if signal is None else _sampled(signal, time))
        rows = np.column_stack(columns)
        if not block.real:
            if not np.isfinite(rows).all():
                raise InputError(
                    f"{place[0]}{block.names[0]}: an input of type {block.type} is fed with NaN "
                    "or infinity; feed numbers"
                )
            rows = rows.astype(np.int64)
        return _Feed(instance, block, _array(block), rows, tuple(live))

    def exchange(self, point: int) -> None:
        """Read the connected outputs and set all inputs that are fed."""
        values, wiring = self.values, self.wiring
        for prefix, instance, block in self.reads:
            instance.read(block)
            for i, name in enumerate(block.names):
                values[prefix + name] = block.values[i]
        for feed in self.feeds:
            feed.values[:] = feed.rows[point]
            for i, name in feed.live:
                source = wiring.connections.get(name)
                value = feed.block.values[i] if source is None else values[source]
                fault = wiring.faults.get(name)
                if fault is not None:
                    value = fault(self.times[point], value)
                if not feed.block.real:
                    if not math.isfinite(value):
                        raise InputError(
                            f"{name}: an input of type {feed.block.type} is fed with {value}; "
                            "feed numbers"
                        )
                    value = int(value)
                feed.block.values[i] = value
            feed.instance.write(feed.block)

    def note(self, point: int) -> None:
        """Read the recorded variables into a row of the table."""
        for instance, block, values, places, columns in self.notes:
            instance.read(block)
            self.table[point, columns] = values[places]


_Place = tuple[str, "Instance", "Block"]


def _array(block: Block) -> Any:
    return np.ctypeslib.as_array(block.values)


def _sampled(signal: Signal, time: FloatArray) -> FloatArray:
    return (
        signal.sampled(time)
        if isinstance(signal, Table)
        else np.array([signal(t) for t in time.tolist()], dtype=np.float64)
    )


def _columns(prefix: str, block: Block, where: Mapping[str, list[int]]) -> tuple[Any, Any]:
    """Places in the block, and columns of the table they go to; slices where they are one after
    another.
    """
    pairs = [(i, column) for i, name in enumerate(block.names) for column in where[prefix + name]]
    places, columns = [p for p, _ in pairs], [c for _, c in pairs]
    if len(pairs) == len(block.names) and columns == list(
        range(columns[0], columns[0] + len(columns))
    ):
        return slice(None), slice(columns[0], columns[0] + len(columns))
    return np.array(places), np.array(columns)


def _split(name: str, instances: Mapping[str, Instance]) -> tuple[str, str]:
    owner, _, variable = name.partition(".")
    if owner not in instances or not variable:
        raise InputError(
            f"{name!r}: write instance.variable, with one of the instances {', '.join(instances)}"
        )
    instances[owner].variable(variable)
    return owner, variable


def _blocks(instances: Mapping[str, Instance], names: Sequence[str]) -> list[_Place]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        owner, variable = _split(name, instances)
        grouped.setdefault(owner, []).append(variable)
    return [
        (f"{owner}.", instances[owner], block)
        for owner, variables in grouped.items()
        for block in instances[owner].blocks(variables)
    ]
