"""Residuals of the balances, from the declared physics, as numbers on prepared records."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import JointModel, Signals
from casadi_models.affine import AffineParts
from casadi_models.equations import swept
from casadi_models.vectorised import CHUNK, Vectorised
from identification.balance.kinematic import kinematic_law
from identification.balance.memory import Law, residuals_of, states_of
from identification.balance.sensing import Sensing
from identification.balance.weak import PAIR, WeakRecord

FloatArray = npt.NDArray[np.float64]
Expression = Any

_NAMES: Final = Signals.names()

UNROLLED: Final = 200
"""Steps of a memory law in one compiled stretch."""


def residual_expressions(
    model: JointModel, sensing: Sensing, transmitted: Expression | None = None
) -> dict[str, Expression]:
    """Symbolic residual of every balance: what drives minus what the model explains [N.m]; without
    any torque, what the twist is over what the model explains [rad]; `transmitted` in place of the
    laws of the transmission.
    """
    e = model.equations
    if transmitted is not None:
        e = replace(e, transmitted=transmitted)
    motor_inertia = e.inertia.get("motor_inertia", ca.SX(0))
    link_inertia = e.inertia.get("link_inertia", ca.SX(0))
    motor = motor_inertia * e.motor_acceleration + e.motor_resistance
    link = link_inertia * e.link_acceleration + e.link_resistance
    out: dict[str, Expression] = {}
    # in the units of the reading: a gain error must not shrink the residual with the signal
    drive_gain = ca.jacobian(e.drive, e.signals.drive)
    torque_gain = ca.jacobian(e.torque, e.signals.torque)
    coupling = e.signals.coupling_torque
    for balance in sensing.balances:
        if balance == "kinematic":
            out[balance] = kinematic_law(model).residual
        elif balance == "motor":
            out[balance] = (e.drive - e.torque * e.motor_lever - motor) / drive_gain
        elif balance == "link":
            out[balance] = (e.torque * e.link_lever + coupling - link) / torque_gain
        elif balance == "transmission":
            resist = e.motor_resistance + e.link_resistance if sensing.clamped_link else 0
            out[balance] = (e.torque - e.transmitted - resist) / torque_gain
        elif balance == "sum":
            out[balance] = (
                e.drive + coupling - motor - link + e.transmitted * (e.link_lever - e.motor_lever)
            ) / drive_gain
        elif balance == "deflection":
            out[balance] = (e.drive - motor - e.transmitted * e.motor_lever) / drive_gain
        else:
            total: Expression = sum(e.inertia.values(), ca.SX(0))
            resist = e.motor_resistance + e.link_resistance + e.transmitted
            out[balance] = (e.drive + coupling - total * e.motor_acceleration - resist) / drive_gain
    return out


def swept_expressions(
    model: JointModel, sensing: Sensing
) -> tuple[dict[str, Expression], dict[str, Expression]]:
    """Residual of every balance in two parts, still [N.m] and swept [N.m.s]: the residual is the
    first plus the rate of the second (:func:`casadi_models.equations.swept`).

    Where the torque of the transmission enters with a lever that moves, all is in the first part.
    """
    e = model.equations
    whole = residual_expressions(model, sensing)
    if sensing.kinematic:
        return whole, dict.fromkeys(whole, ca.SX(0))
    still, moved = swept(model, model.symbols)
    if moved.is_zero():
        return whole, dict.fromkeys(whole, ca.SX(0))
    torque = ca.SX.sym("transmitted")
    varying = ca.vertcat(e.signals.vector(), e.memory, torque)
    parts, rates = dict(whole), dict.fromkeys(whole, ca.SX(0))
    for b, r in residual_expressions(model, sensing, torque).items():
        share = ca.jacobian(r, torque)
        if not ca.depends_on(share, varying):
            (parts[b],) = ca.substitute([r], [torque], [still])
            rates[b] = share * moved
    return parts, rates


def curved_expressions(model: JointModel, sensing: Sensing) -> dict[str, Expression]:
    """What enters the balances by its second derivative in time [N.m.s2]: the lag of a load
    that is not recorded.
    """
    if not model.lagging_load:
        return {}
    e = model.equations
    lag = e.load_lag / ca.jacobian(e.drive, e.signals.drive)
    return {b: lag if b == "axis" else ca.SX(0) for b in sensing.balances}


def tilted_expressions(model: JointModel, sensing: Sensing) -> dict[str, Expression]:
    """What enters the balances by its rate [N.m.s]: a damped twist follows the torque late, and so
    does all that a rigid link would leave.
    """
    if not model.lagging_load:
        return {}
    late = model.load_relaxation(model.symbols.parameters)
    rigid = residual_expressions(model, sensing)
    return {b: late * rigid[b] if b == "axis" else ca.SX(0) for b in sensing.balances}


@final
class _Part:
    """Expressions with their Jacobian, split into what is linear in the signals and the rest.

    Parameters
    ----------
    model : JointModel
    expressions : mapping of str to expression
    columns : sequence of int
        Parameters whose Jacobian columns are wanted, by their place in the vector.
    columns_only : bool
        The expressions themselves are not wanted and read zero.
    """

    def __init__(
        self,
        model: JointModel,
        expressions: Mapping[str, Expression],
        columns: Sequence[int],
        *,
        columns_only: bool,
    ) -> None:
        e = model.equations
        signals: Any = e.signals.vector()
        parameters = e.parameters
        stacked: list[Expression] = []
        for r in expressions.values():
            stacked += [
                ca.SX(1, 1) if columns_only else r,
                *(ca.vertsplit(ca.jacobian(r, parameters)[:, columns].T) if columns else []),
            ]
        out: Any = ca.vertcat(*stacked)
        self._width = 1 + len(columns)
        parts = AffineParts(signals, e.memory)
        slopes = ca.SX(out.shape[0], len(_NAMES))
        zeroed: list[Expression] = []
        for i in range(out.shape[0]):
            line, left = parts.split(out[i])
            zeroed.append(left)
            for j, slope in line.items():
                slopes[i, j] = slope
        self._linear = ca.Function("linear", [parameters], [ca.densify(slopes)])
        self._slopes: tuple[tuple[float, ...], FloatArray] = ((), np.empty(0))
        self.needed = [i for i, part in enumerate(zeroed) if not part.is_zero()]
        self._bent = {
            i: [n for n, d in zip(_NAMES, ca.which_depends(zeroed[i], signals), strict=True) if d]
            for i in self.needed
        }
        rest = ca.vertcat(*(zeroed[i] for i in self.needed)) if self.needed else ca.SX(0, 1)
        self._rest = Vectorised(
            ca.Function("rest", [signals, e.memory, parameters], [ca.cse(ca.densify(rest))])
        )
        self.remembers = bool(e.memory_terms) and ca.jacobian_sparsity(rest, e.memory).nnz() > 0

    def rows(
        self,
        averaged: FloatArray,
        average: Callable[[FloatArray], FloatArray],
        data: WeakRecord,
        memory: FloatArray,
        p: Sequence[float],
    ) -> FloatArray:
        """Averages (rows, expressions and columns) with the internal states given at the points;
        `averaged` are those of the signals, (rows, signals).
        """
        slopes = self._slopes_at(p)
        full: FloatArray = averaged @ slopes
        if self._width > 1:  # to the last digit the same as without columns
            full[:, :: self._width] = averaged @ np.ascontiguousarray(slopes[:, :: self._width])
        if self.needed:
            bent = self._averages(average, data, memory, p)
            if len(self.needed) == full.shape[1]:
                full += bent
            else:
                full[:, self.needed] += bent
        return full

    def _averages(
        self,
        average: Callable[[FloatArray], FloatArray],
        data: WeakRecord,
        memory: FloatArray,
        p: Sequence[float],
    ) -> FloatArray:
        """What is no straight line, averaged (rows, needed): some copies of a drawn record at a
        time, so that what is averaged is still in the cache.
        """
        signals, found = data.table(_NAMES), []
        for part in data.portions(CHUNK):
            own = tuple(row[part] for row in signals)
            rest = self._rest.by_point(part.stop - part.start, own, memory[:, part], p)
            found.append(average(rest))
        return found[0] if len(found) == 1 else np.concatenate(found)

    def _slopes_at(self, p: Sequence[float]) -> FloatArray:
        """What each signal is multiplied by, (signals, expressions and columns); not to be written
        to. Draws of one record, and its balances, ask for the same values one after the other.
        """
        given = tuple(p)
        known, slopes = self._slopes
        if known != given or not slopes.size:
            slopes = np.ascontiguousarray(np.array(self._linear(p)).T)
            self._slopes = (given, slopes)
        return slopes

    def slopes(self, balances: Sequence[str], p: Sequence[float]) -> dict[str, dict[str, float]]:
        """By balance, the signals that enter it linearly and how strongly."""
        linear = self._slopes_at(p)
        return {
            b: {
                n: float(linear[j, i * self._width])
                for j, n in enumerate(_NAMES)
                if linear[j, i * self._width]
            }
            for i, b in enumerate(balances)
        }

    def bent(self, number: int) -> frozenset[str]:
        """Signals that enter a balance, by its number, in another way than on a straight line."""
        return frozenset(self._bent.get(number * self._width, ()))


@final
class Balances:
    """Residuals and their Jacobian of one model with one set of channels.

    Parameters
    ----------
    model : JointModel
        Already adapted to the channels.
    sensing : Sensing
    wrt : sequence of str, optional
        Parameters whose Jacobian columns are wanted; all by default.
    columns_only : bool
        The residual itself is not wanted and reads zero.

    Attributes
    ----------
    law : Law
        What the residuals depend on beside the record and the values.
    """

    def __init__(
        self,
        model: JointModel,
        sensing: Sensing,
        wrt: Sequence[str] | None = None,
        *,
        columns_only: bool = False,
    ) -> None:
        self.model = model
        self.sensing = sensing
        self.names: tuple[str, ...] = model.parameter_names
        self.wrt: tuple[str, ...] = tuple(wrt) if wrt is not None else self.names
        expressions = residual_expressions(model, sensing)
        columns = [self.names.index(n) for n in self.wrt]
        self.balances = tuple(expressions)
        curved = curved_expressions(model, sensing)
        self._plain = _Part(model, expressions, columns, columns_only=columns_only)
        self._curved = _Part(model, curved, columns, columns_only=columns_only) if curved else None
        tilted = tilted_expressions(model, sensing)
        self._tilted = _Part(model, tilted, columns, columns_only=columns_only) if tilted else None
        self._memory = Memory(model) if self._plain.remembers else None
        self._flight = Flight(model) if sensing.kinematic else None
        self._columns_only = columns_only
        self._law = Law(model.structure)
        self.law = Law(model.structure, sensing, columns_only)

    @cached_property
    def holding(self) -> frozenset[str]:
        """Parameters that stand in a balance: what stands in none moves nothing, whatever its
        value.
        """
        expressions = residual_expressions(self.model, self.sensing)
        entries = ca.jacobian_sparsity(
            ca.vertcat(*expressions.values()), self.model.equations.parameters
        ).get_triplet()[1]
        return frozenset(self.names[i] for i in set(entries))

    def memory_values(self, data: WeakRecord, values: Mapping[str, float]) -> FloatArray:
        """Internal states of displacement-memory effects at the points, (states, points); not
        to be written to.
        """
        memory = self._memory
        count = len(data.points["motor_position"])
        if memory is None:
            return np.zeros((self.model.equations.memory.shape[0], count))
        p = np.array([float(values[n]) for n in self.names])
        law = (self._law, tuple(p[memory.depends].tolist()))
        return states_of(data, law, lambda: memory.along(data, p))

    def evaluate(
        self, data: WeakRecord, values: Mapping[str, float], remembered: WeakRecord | None = None
    ) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Residual (rows,) and Jacobian (rows, wrt) of every balance at the given parameter values.

        `remembered` is a record with the same smoothed positions, whose internal states may be
        known already.
        """
        p = tuple(float(values[n]) for n in self.names)

        def rows() -> FloatArray:
            return self._rows(data, self.memory_values(remembered or data, values), p)

        width, law = 1 + len(self.wrt), (self.law, p)
        if self.wrt:
            full = rows()
            if not self._columns_only:  # the residuals alone are asked for next
                residuals_of(data, law, lambda: full[:, ::width].copy())
        else:
            full = residuals_of(data, law, rows)
        return {
            b: (full[:, i * width], full[:, i * width + 1 : (i + 1) * width])
            for i, b in enumerate(self.balances)
        }

    def _rows(self, data: WeakRecord, memory: FloatArray, p: tuple[float, ...]) -> FloatArray:
        """Rows with the internal states given at the points, (rows, expressions and columns)."""
        full = self._plain.rows(data.means(_NAMES), data.average, data, memory, p)
        if self._curved is not None:
            full += self._curved.rows(data.bends(_NAMES), data.curve, data, memory, p)
        if self._tilted is not None:
            full += self._tilted.rows(data.tilts(_NAMES), data.tilt, data, memory, p)
        return full

    def begun(self, data: WeakRecord, values: Mapping[str, float]) -> dict[str, FloatArray]:
        """How much each row of every balance, (rows,), hangs on the state in which its segment
        began, which nothing tells: that of rest against the largest of the record.
        """
        memory = self._memory
        if memory is None:
            return {b: np.zeros(data.rows) for b in self.balances}
        p = tuple(float(values[n]) for n in self.names)

        def rows() -> FloatArray:
            rest = self.memory_values(data, values)
            most = np.abs(rest).max(axis=1, initial=0.0)
            law = ("begun", self._law, tuple(p[i] for i in memory.depends))
            moved = states_of(data, law, lambda: memory.along(data, np.array(p), most))
            return self._rows(data, moved, p) - self._rows(data, rest, p)

        full = np.abs(residuals_of(data, ("begun", self.law, self.wrt, p), rows))
        return {b: full[:, i * (1 + len(self.wrt))] for i, b in enumerate(self.balances)}

    @property
    def has_gap(self) -> bool:
        """True where the link may fly free between the sides of a gap."""
        return self._flight is not None and self._flight.anywhere

    def flight(self, data: WeakRecord, values: Mapping[str, float]) -> FloatArray:
        """Angle by which each row may be off where the link flies free in a gap, (rows,) [rad]."""
        if self._flight is None:
            return np.zeros(data.rows)
        return self._flight.rows(data, [float(values[n]) for n in self.names])

    def slopes(self, values: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """By balance, the signals that enter it linearly and how strongly."""
        return self._plain.slopes(self.balances, [float(values[n]) for n in self.names])

    def entering(self, values: Mapping[str, float]) -> dict[str, frozenset[str]]:
        """By balance, the signals that its residual depends on at the given parameter values."""
        slopes = self.slopes(values)
        return {b: frozenset(slopes[b]) | self._plain.bent(i) for i, b in enumerate(self.balances)}


@final
class Flight:
    """Where the two sides of a gap do not touch: the twist is then anywhere in it, and a row is an
    inequality, no equation.
    """

    def __init__(self, model: JointModel) -> None:
        e, law = model.equations, kinematic_law(model)
        self._gap = Vectorised(
            ca.Function(
                "gap",
                [e.signals.vector(), e.memory, e.parameters],
                [ca.densify(law.free * law.gap)],
            )
        )
        self.anywhere = not law.free.is_zero()
        self._states = int(e.memory.shape[0])

    def rows(self, data: WeakRecord, p: Sequence[float]) -> FloatArray:
        """Half the gap times the share of a row's kernel without touch, (rows,) [rad]."""
        if not self.anywhere:
            return np.zeros(data.rows)
        count = len(data.points["motor_position"])
        memory = np.zeros((self._states, count))
        return data.average(self._gap.by_point(count, data.table(_NAMES), memory, p))[:, 0]


_KEPT: Final = 512
"""Compiled balances that a thread keeps: a decision between four rivals asks for some 150, each
several times; 512 take a few MB.
"""

_kept = threading.local()


def balances_of(
    model: JointModel,
    sensing: Sensing,
    wrt: Sequence[str] | None = None,
    *,
    columns_only: bool = False,
) -> Balances:
    """:class:`Balances` of a model whatever its values, built once per thread and structure."""
    key = (model.structure, sensing, None if wrt is None else tuple(wrt), columns_only)
    cache: OrderedDict[object, Balances] = _kept.__dict__.setdefault("balances", OrderedDict())
    if key in cache:
        cache.move_to_end(key)
        return cache[key]
    made = cache[key] = Balances(model, sensing, wrt, columns_only=columns_only)
    while len(cache) > _KEPT:
        cache.popitem(last=False)
    return made


@final
class Memory:
    """Internal states along a record, from the step form of the memory laws.

    Steps are unrolled into one SX function of :data:`UNROLLED` steps, so that the virtual machine
    is entered once per stretch and not once per sample.
    """

    def __init__(self, model: JointModel) -> None:
        e = model.equations
        signals = e.signals.vector()
        coordinates = [t[1] for t in e.memory_terms]
        steps = ca.SX.sym("steps", len(coordinates))
        moved: list[Expression] = []
        for i, (term, _, z, view, values) in enumerate(e.memory_terms):
            if term.effect.memory is not None:
                moved.extend(term.effect.memory(z, steps[i], view, values))
        after = ca.vertcat(*moved)
        self.depends = sorted(
            set(
                ca.jacobian_sparsity(ca.vertcat(*coordinates, after), e.parameters).get_triplet()[1]
            )
        )
        self._states = int(e.memory.shape[0])
        self._used = sorted(set(ca.jacobian_sparsity(after, signals).get_triplet()[1]))
        of_torsion = [
            {_NAMES[k] for k in ca.jacobian_sparsity(x, signals).get_triplet()[1]} >= set(PAIR)
            for x in coordinates
        ]
        self._of_torsion = np.flatnonzero(of_torsion)
        kept = ca.vertcat(*(signals[i] for i in self._used)) if self._used else ca.SX(0, 1)
        one: Any = ca.Function("one", [e.memory, steps, kept, e.parameters, e.clock], [after])
        self.coordinates = Vectorised(
            ca.Function("where", [signals, e.parameters], [ca.densify(ca.vertcat(*coordinates))])
        )
        z0: Any = ca.SX.sym("z0", self._states)
        many = ca.SX.sym("many", len(coordinates), UNROLLED)
        aside = ca.SX.sym("aside", len(self._used), UNROLLED)
        p = ca.SX.sym("p", e.parameters.shape[0])
        clock = ca.SX.sym("clock")
        state: Any = z0
        trail: list[Any] = []
        for k in range(UNROLLED):
            state = one(state, many[:, k], aside[:, k], p, clock)
            trail.append(state)
        self._stretch = ca.Function(
            "stretch", [z0, many, aside, p, clock], [ca.densify(ca.horzcat(*trail))]
        )

    def along(self, data: WeakRecord, p: FloatArray, begin: FloatArray | None = None) -> FloatArray:
        """States (states, points) at the points of a record; every segment begins at rest, or in
        the states (states,) `begin`.
        """
        count = len(data.points["motor_position"])
        matrix = np.zeros((len(_NAMES), count))
        for i, name in enumerate(_NAMES):
            if name in data.smooth:
                matrix[i] = data.smooth[name]
        where = self.coordinates(count, matrix, p)
        if data.paired and len(self._of_torsion):
            both = matrix.copy()
            for name, values in data.paired.items():
                both[_NAMES.index(name)] = values
            where = where.copy()
            where[self._of_torsion] = self.coordinates(count, both, p)[self._of_torsion]
        out = self._followed(data, where, matrix, p, begin)
        if not data.doubts or not len(self._of_torsion):
            return out

        def along(track: Mapping[str, FloatArray]) -> FloatArray:
            both, there = matrix.copy(), where.copy()
            for name, values in track.items():
                both[_NAMES.index(name)] = values
            there[self._of_torsion] = self.coordinates(count, both, p)[self._of_torsion]
            return self._followed(data, there, matrix, p, begin)

        calm, *shaken = data.doubts
        return out + along(calm) - sum(along(track) for track in shaken) / len(shaken)

    def _followed(
        self,
        data: WeakRecord,
        where: FloatArray,
        matrix: FloatArray,
        p: FloatArray,
        begin: FloatArray | None,
    ) -> FloatArray:
        """States along coordinates (coordinates, points), every segment by itself."""
        out = np.zeros((self._states, where.shape[1]))
        for first, last in zip(data.starts[:-1], data.starts[1:], strict=True):
            out[:, first:last] = self.follow(
                where[:, first:last],
                matrix[:, first:last],
                p,
                data.grid.dt * data.grid.step,
                begin,
            )
        return out

    def follow(
        self,
        where: FloatArray,
        signals: FloatArray,
        p: FloatArray,
        step: float,
        begin: FloatArray | None = None,
    ) -> FloatArray:
        """States (states, points) along coordinates (coordinates, points) `step` seconds apart,
        from rest at zero or from the states (states,) `begin`.
        """
        count = where.shape[1]
        out = np.zeros((self._states, count))
        steps = np.diff(where, axis=1, prepend=where[:, :1])
        # CasADi's own buffers: the conversion of every stretch would cost as much as the law
        z, trail = np.zeros((1, self._states)), np.zeros((UNROLLED, self._states))
        if begin is not None:
            z[0] = begin
        many, aside = np.zeros((UNROLLED, where.shape[0])), np.zeros((UNROLLED, len(self._used)))
        given, run = self._stretch.buffer()
        for i, array in enumerate(
            (z, many, aside, np.ascontiguousarray(p, dtype=np.float64), np.array([step]))
        ):
            given.set_arg(i, array.data)
        given.set_res(0, trail.data)
        for first in range(0, count, UNROLLED):
            last = min(first + UNROLLED, count)
            many[: last - first] = steps[:, first:last].T
            many[last - first :] = 0.0
            aside[: last - first] = signals[self._used, first:last].T
            aside[last - first :] = 0.0
            run()
            out[:, first:last] = trail[: last - first].T
            z[0] = trail[last - first - 1]
        return out
