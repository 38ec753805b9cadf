"""Residuals of the balances over several records: stacked rows, their noise floors and their
weights.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.balance.balances import Balances, balances_of
from identification.balance.calibration import bare, of_run, settled, values_on
from identification.balance.colour import ChannelNoise, is_slow, white
from identification.balance.dataset import Dataset
from identification.balance.drawn_noise import LONGEST, draws_of
from identification.balance.memory import Law, numbers_of
from identification.balance.slow_noise import (
    Drawn,
    SlowNoise,
    filtered_noise,
    slow_noise_of_rest,
)
from identification.balance.weak import INDEPENDENT_SHARE, WeakRecord, whole

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

TURN_KERNEL: Final = 0.02
"""Longest kernel of the velocity that still follows a turn with sticking friction [s]."""
TURN_SHARE: Final = 0.25
"""Share of what a kernel is longer than that by which the instant of a turn may be wrong,
either way.
"""

TURN_WIDTHS: Final = 3.0
"""Smoothing velocities up to which friction has not yet reached its level (to 1 %)."""

SCALED: Final = ("drive", "torque")
"""Measured signals whose scale a balance has: what is left of it has the same."""

FEW_SAMPLES: Final = 5
"""Samples under which a kernel of the velocity tells little more than a step from one sample to the
next."""

SURE_JUMP: Final = 3.0
"""Standard deviations of noise from which what alternates from sample to sample is a jump."""
NORMAL_MEDIAN: Final = 0.6745
"""Median of the absolute value of a normal variable of unit deviation."""
WEIGHINGS: Final = 12
"""Rounds in which the weights of the rows and their RMS are made to agree; more change nothing
in the third digit.
"""
NOTHING_SURE: Final = 1e100
"""What a row of which nothing is sure is unsure by at most [N.m]: a number with a square."""
STILL_KNOWN: Final = 0.1
"""Share of the most that a beginning gives a row, under which it is forgotten."""
MOST_OF_A_BEGINNING: Final = 0.05
"""Rows of a record, as a share, that its beginning may reach: what a twentieth leaves out lets no
law look better by more than its rows are worth."""
SURE_ERRORS: Final = 3.0
"""Standard errors by which a residual must lie under the noise level before that level counts
as too high.
"""
LEAST_MARGIN: Final = 0.5
"""Share of a noise level that a residual may fall to by chance, however few its rows."""
LEAST_DEVIATION: Final = 1e-12
"""Of a row without noise [N.m]: what rounding leaves of torques of 1 N.m."""


@final
@dataclass(frozen=True)
class Stacked:
    """Residual and Jacobian of several records, balance by balance."""

    residual: Mapping[str, FloatArray]
    jacobian: Mapping[str, FloatArray]
    block: IntArray
    taking: Mapping[str, npt.NDArray[np.bool_]]

    @property
    def shown(self) -> dict[str, FloatArray]:
        """Residuals for pictures: NaN in rows that take no part."""
        return {b: np.where(self.taking[b], r, np.nan) for b, r in self.residual.items()}

    def parts(self, count: int) -> list[Stacked]:
        """As many equal parts, one after the other."""
        size = len(self.block) // count

        def cut(rows: Mapping[str, Any], k: int) -> dict[str, Any]:
            return {b: x[k * size : (k + 1) * size] for b, x in rows.items()}

        return [
            Stacked(
                cut(self.residual, k),
                cut(self.jacobian, k),
                self.block[k * size : (k + 1) * size],
                cut(self.taking, k),
            )
            for k in range(count)
        ]


def stack(
    balances: Balances,
    records: Sequence[WeakRecord],
    values: Mapping[str, float],
    names: Sequence[str] | None = None,
) -> Stacked:
    """Evaluate the balances on records one after the other; rows that take no part are zero.

    `names` are the columns of the Jacobian, by default those of the balances; a calibration unknown
    of one run has zero in the rows of all others. A record without calibration values gets its own,
    fitted on itself.
    """
    model = balances.model
    values = settled(model, balances.sensing, records, values)
    wanted = balances.wrt if names is None else tuple(names)
    residual, jacobian = (
        {b: np.empty((sum(w.rows for w in records), *width)) for b in balances.balances}
        for width in ((), (len(wanted),))
    )
    taking = {b: taking_part(b, records) for b in balances.balances}
    first = 0
    for w in records:
        rows = slice(first, first + w.rows)
        for b, (r, columns) in balances.evaluate(w, values_on(model, w, values)).items():
            residual[b][rows] = r
            _fill(jacobian[b][rows], balances, w, columns, wanted)
        first += w.rows
    for b, taken in taking.items():
        residual[b][~taken] = 0.0
        jacobian[b][~taken] = 0.0
    return Stacked(residual, jacobian, np.concatenate([w.block for w in records]), taking)


def _fill(
    out: FloatArray,
    balances: Balances,
    record: WeakRecord,
    jacobian: FloatArray,
    names: Sequence[str],
) -> None:
    """Write the columns of the names (rows, names), those of other runs zero."""
    if tuple(names) == balances.wrt:
        out[:] = jacobian
        return
    for k, n in enumerate(names):
        (common,) = bare([n])
        own = n in (common, of_run(common, record))
        out[:, k] = jacobian[:, balances.wrt.index(common)] if own else 0.0


def taking_part(balance: str, records: Sequence[WeakRecord]) -> npt.NDArray[np.bool_]:
    """Which of the stacked rows of a balance take part: neither masked nor at rest."""
    return np.concatenate([w.taking(balance) for w in records])


def floors(model: JointModel, data: Dataset, values: Mapping[str, float]) -> dict[str, float]:
    """RMS that measurement noise alone would leave in each balance of the training records."""
    rows = floor_rows(model, data, values, data.train)
    return {b: rms(level[taking_part(b, data.train)]) for b, level in rows.items()}


def floor_rows(
    model: JointModel, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]
) -> dict[str, FloatArray]:
    """Standard deviation that measurement noise alone gives each row of the balances, record by
    record.

    Residual of the smoothed signals with drawn noise less that without it, at the given values:
    every channel counts through every law that it enters. Rows in which friction may act either way
    count less: their scatter has a weight of its own. A level above what the training records leave
    is a contradiction (the noise of a channel reads too much): it is lowered to that.
    """
    return together(*noise_rows(model, data, values, records), records)


def together(
    quick: Mapping[str, FloatArray], drift: Mapping[str, FloatArray], records: Sequence[WeakRecord]
) -> dict[str, FloatArray]:
    """The floors of both parts of :func:`noise_rows`."""
    return {b: np.hypot(level, _even(drift[b], b, records)) for b, level in quick.items()}


def noise_rows(
    model: JointModel, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """As :func:`floor_rows`, in two parts: what noise gives each row but for the drift of the
    measured torques, and what that gives it.
    """
    values = settled(model, data.sensing, [*data.train, *records], values)
    every = {id(w): w for w in (*data.train, *records)}
    known = {mark: drawn_floors(model, data, values, w) for mark, w in every.items()}
    kept = noise_believed(model, data, values, [known[id(w)] for w in data.train])
    drift = {b: kept[b] * x for b, x in drift_rows(model, data, values, records).items()}
    quick = {
        b: np.concatenate([np.full(w.rows, kept[b] * known[id(w)][b]) for w in records])
        if records
        else np.empty(0)
        for b in data.sensing.balances
    }
    return {b: _less(x, _even(drift[b], b, records)) for b, x in quick.items()}, drift


def _even(drift: FloatArray, balance: str, records: Sequence[WeakRecord]) -> FloatArray:
    """RMS of a drift in the rows of each record that take part, (rows,)."""
    out, first = np.zeros(len(drift)), 0
    for w in records:
        out[first : first + w.rows] = rms(drift[first : first + w.rows][w.taking(balance)])
        first += w.rows
    return out


def _less(whole: FloatArray, part: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(whole**2 - part**2, 0.0))


def drawn_floors(
    model: JointModel, data: Dataset, values: Mapping[str, float], record: WeakRecord
) -> Mapping[str, float]:
    """RMS of what noise changes in each balance of one record, whatever is left of it [N.m]: drawn,
    with the same draws for every model, and a drift of the torques beside them. A record holds one
    course of a drift, and the RMS of one is anything from a third to twice that of all.
    """
    balances = balances_of(model, data.sensing, wrt=())
    given = (tuple(sorted(values.items())), tuple(sorted(data.sources.items(), key=_first)))
    return numbers_of(
        record, (balances.law, *given), lambda: _drawn_floors(balances, data, values, record)
    )


def _first(item: tuple[str, ChannelNoise]) -> str:
    return item[0]


def _drawn_floors(
    balances: Balances, data: Dataset, values: Mapping[str, float], record: WeakRecord
) -> dict[str, float]:
    power = dict.fromkeys(balances.balances, 0.0)
    drawn = draws_of(record, {c: noise.without_drift for c, noise in data.sources.items()})
    seen = drawn.record
    either = unsure(balances, data, values, [seen])
    values = values_on(balances.model, record, values)
    calm = balances.evaluate(drawn.calm, values, remembered=seen)
    noisy = balances.evaluate(drawn.noisy, values)
    for b in power:
        rows = seen.taking(b)
        moved = (noisy[b][0].reshape(drawn.count, -1) - calm[b][0])[:, rows]
        power[b] = float(np.sum(_sure_rms_of_each(moved, either[b][rows]) ** 2))
    slow = _drifts(balances, data, values, record)
    return {
        b: math.hypot(
            math.sqrt(p / drawn.count), rms(slow[b][record.taking(b)]) if b in slow else 0.0
        )
        for b, p in power.items()
    }


def drift_rows(
    model: JointModel, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]
) -> dict[str, FloatArray]:
    """Standard deviation that a drift of the measured torques gives each row of the balances,
    (rows,) each.
    """
    balances = balances_of(model, data.sensing, wrt=())
    found = [_drifts(balances, data, values_on(model, w, values), w) for w in records]
    return {
        b: np.concatenate([f.get(b, np.zeros(w.rows)) for f, w in zip(found, records, strict=True)])
        if records
        else np.empty(0)
        for b in balances.balances
    }


def _drifts(
    balances: Balances, data: Dataset, values: Mapping[str, float], record: WeakRecord
) -> dict[str, FloatArray]:
    sizes = {
        c: noise.drift.size
        for c, noise in data.sources.items()
        if noise.drift is not None and c in SCALED
    }
    return _moved_by(balances, values, record, sizes) if sizes else {}


def _moved_by(
    balances: Balances,
    values: Mapping[str, float],
    record: WeakRecord,
    sizes: Mapping[str, float],
) -> dict[str, FloatArray]:
    """What offsets of measured torques make of each row of the balances, root of the sum of the
    squares, (rows,) each.
    """
    before = balances.evaluate(record, values)
    power = {b: np.zeros(record.rows) for b in before}
    for channel, size in sizes.items():
        if channel not in record.points:
            continue
        moved = replace(
            record,
            points=_higher(record.points, channel, size),
            smooth=_higher(record.smooth, channel, size),
            averaged=_higher(record.averaged, channel, size),
        )
        after = balances.evaluate(moved, values, remembered=record)
        for b in power:
            power[b] += (after[b][0] - before[b][0]) ** 2
    return {b: np.sqrt(squares) for b, squares in power.items()}


def innovations(
    residual: FloatArray,
    scatter: FloatArray,
    drift: FloatArray,
    *,
    memory: float,
    records: Sequence[WeakRecord],
) -> FloatArray:
    """Residuals of a balance over their deviation, each beside what the rows before it say of the
    drift: of unit RMS where drift and scatter are all that is left.

    Parameters
    ----------
    residual : (rows,) or (rows, k) array
        Or columns of it, as linear in the rows as a residual is.
    scatter, drift : (rows,) array
        Deviation of each row but for the drift (infinite: the row says nothing), and by it.
    memory : float
        Of the drift [s].
    records : sequence of WeakRecord
        Whose rows these are; each has a course of its own.
    """
    out = np.empty(residual.shape)
    first = 0
    for w in records:
        rows = slice(first, first + w.rows)
        first += w.rows
        given: Any = residual[rows]
        kept = np.exp(-np.diff(w.time, prepend=w.time[:1]) / memory)
        state, power, course = 0.0, 1.0, []
        for r, f, g, k in zip(
            given.tolist() if residual.ndim == 1 else given,
            (scatter[rows] ** 2).tolist(),
            drift[rows].tolist(),
            kept.tolist(),
            strict=True,
        ):
            state, power = k * state, 1.0 - k * k * (1.0 - power)
            spread = g * g * power + f
            error = r - g * state
            sure = 0.0 < spread < math.inf
            course.append(error / math.sqrt(spread) if sure else 0.0 * error)
            gain = power * g / spread if sure else 0.0
            state, power = state + gain * error, power * (1.0 - gain * g)
        out[rows] = course
    return out


def apart_from_drift(
    scatter: FloatArray, drift: FloatArray, quick: FloatArray | float = 0.0
) -> FloatArray:
    """Deviation (rows,) of the rows of a balance but for what a drift gives them (rows,), of the
    deviation with it (infinite: the row says nothing); no less than the `quick` part of their
    noise.
    """
    least = np.maximum(quick, LEAST_DEVIATION)
    return np.asarray(np.sqrt(np.maximum(scatter**2 - drift**2, least**2)))


def slow_noise_beside(
    model: JointModel, data: Dataset, values: Mapping[str, float]
) -> dict[str, SlowNoise]:
    """See :func:`identification.balance.slow_noise.slow_noise_of_rest`; of all records of the
    data.
    """
    balances = balances_of(model, data.sensing, wrt=())
    records = [*data.train, *data.held_out]
    values = settled(model, data.sensing, records, values)
    left = [
        {
            b: np.where(w.taking(b), r, np.nan)
            for b, (r, _) in balances.evaluate(w, values_on(model, w, values)).items()
        }
        for w in records
    ]
    each = [_rests_of(r) for r in left]
    rests = {key: [r[key] for r in each] for key in each[0]}
    drawn: dict[str, list[Drawn]] = {}
    levels = _uncoloured(data, records)
    if levels:
        sources = data.sources
        quiet = {c: white(0.0) if c in SCALED else own for c, own in sources.items()}
        whole_of, quiet_of = (
            [_drawn_rests(balances, model, values, w, s) for w in records] for s in (sources, quiet)
        )
        drawn = {
            key: [Drawn(a[key], b[key]) for a, b in zip(whole_of, quiet_of, strict=True)]
            for key in rests
        }
    found = {}
    if rests.keys() == {"both"}:
        told = filtered_noise(records, rests["both"], drawn["both"]) if drawn else None
        found = {c: SlowNoise((), (), told) for c in levels if told is not None}
    elif rests:
        found = slow_noise_of_rest(records, rests, {c: drawn[c] for c in levels if c in drawn})
    for c, slow in found.items():
        if slow.filtered is not None:
            part = replace(slow.filtered, size=levels[c] * slow.filtered.size)
            found[c] = replace(slow, filtered=part)
    return {c: x for c, x in found.items() if c in data.noise}


def _uncoloured(data: Dataset, records: Sequence[WeakRecord]) -> dict[str, float]:
    """Noise levels of the measured torques whose samples are too far apart to show its colour."""
    # of a longer record noise is drawn for pieces, which have no spectrum of the whole
    if not is_slow(records[0].grid.dt) or max(w.rows for w in records) > LONGEST:
        return {}
    return {
        c: own.level
        for c, own in data.sources.items()
        if c in SCALED and own.level > 0 and all(p.memory <= 0 for p in own.without_drift.parts)
    }


def _drawn_rests(
    balances: Balances,
    model: JointModel,
    values: Mapping[str, float],
    record: WeakRecord,
    sources: Mapping[str, ChannelNoise],
) -> dict[str, FloatArray]:
    """What drawn noise makes of the rests of :func:`slow_noise_beside`, (draws, rows) each."""
    own = values_on(model, record, values)
    draws = draws_of(record, sources)
    noisy, calm = (balances.evaluate(w, own) for w in (draws.noisy, draws.calm))
    shape = (draws.count, -1)
    return _rests_of({b: noisy[b][0].reshape(shape) - calm[b][0] for b in noisy})


def _rests_of(rows: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """What rows of balances leave of the transmitted torque (`torque`), of the drive's beside it
    (`both`) and of the drive's beside all motion (`drive`); those that they give.
    """
    if {"motor", "link"} <= set(rows):
        together = rows["motor"] + rows["link"]
        return {"torque": rows["link"], "both": rows["motor"], "drive": together}
    whole = next((b for b in ("sum", "axis") if b in rows), None)
    if whole is not None:
        return {"drive": rows[whole]}
    return {"both": rows["motor"]} if "motor" in rows else {}


def drift_memory(data: Dataset) -> float:
    """The longest memory of a drift of the measured torques [s]; zero where none drifts."""
    found = [n.drift.memory for c, n in data.sources.items() if n.drift is not None and c in SCALED]
    return max(found, default=0.0)


def _sure_rms(change: FloatArray, either: FloatArray) -> float:
    """RMS in which rows that may go either way count by how sure they are, beside that RMS
    itself: as in every fit.
    """
    return float(_sure_rms_of_each(change[None], either)[0])


def _sure_rms_of_each(change: FloatArray, either: FloatArray) -> FloatArray:
    """:func:`_sure_rms` of each of several changes (changes, rows)."""
    if not change.shape[1]:
        return np.zeros(len(change))
    out = np.median(np.abs(change), axis=1) / NORMAL_MEDIAN
    weighed = out > 0 if np.any(either) else np.zeros(len(out), dtype=np.bool_)
    out[~weighed] = [rms(c) for c in change[~weighed]]
    moving, either = np.flatnonzero(weighed), np.minimum(either, NOTHING_SURE)
    for _ in range(WEIGHINGS):
        if not len(moving):
            break
        # from the surest row: where a law ran away the square of each alone may be nothing
        unsure_by = np.hypot(out[moving, None], either)
        weight = unsure_by.min(axis=1, keepdims=True) / unsure_by
        weighted, before = change[moving] * weight, out[moving]
        squares = np.einsum("kn,kn->k", weighted, weighted)
        out[moving] = np.sqrt(squares / np.einsum("kn,kn->k", weight, weight))
        moving = moving[(out[moving] != before) & np.isfinite(out[moving])]
    return out


def sure_levels(model: JointModel, data: Dataset, values: Mapping[str, float]) -> dict[str, float]:
    """RMS of what each balance leaves on the training rows, in which rows that may go either way
    count by how sure they are.
    """
    balances = balances_of(model, data.sensing, wrt=())
    residual = stack(balances, data.train, values).residual
    either = unsure(balances, data, values, data.train)
    rows = {b: taking_part(b, data.train) for b in residual}
    return {b: _sure_rms(r[rows[b]], either[b][rows[b]]) for b, r in residual.items()}


def noise_believed(
    model: JointModel,
    data: Dataset,
    values: Mapping[str, float],
    levels: Sequence[Mapping[str, float]] | None = None,
) -> Mapping[str, float]:
    """Share of the levels of noise of the training records (as drawn, or `levels`) that what these
    records leave allows, by balance: 1 where there is no contradiction.
    """
    if levels is None:
        levels = [drawn_floors(model, data, values, w) for w in data.train]
    given = tuple(tuple(numbers.items()) for numbers in (values, *levels))
    law = Law("believed", model.structure, given)
    return numbers_of(data, law, lambda: _noise_believed(model, data, values, levels))


def _noise_believed(
    model: JointModel,
    data: Dataset,
    values: Mapping[str, float],
    levels: Sequence[Mapping[str, float]],
) -> dict[str, float]:
    residual = stack(balances_of(model, data.sensing, wrt=()), data.train, values).residual
    either = unsure(balances_of(model, data.sensing, wrt=()), data, values, data.train)
    drifts, memory = drift_rows(model, data, values, data.train), drift_memory(data)
    out = dict.fromkeys(residual, 1.0)
    for b, r in residual.items():
        rows = taking_part(b, data.train)
        level = np.concatenate(
            [np.full(w.rows, found[b]) for w, found in zip(data.train, levels, strict=True)]
        )
        if rows.any() and level[rows].min() > 0:
            spread = SURE_ERRORS / math.sqrt(2 * INDEPENDENT_SHARE * float(rows.sum()))
            if memory:
                quick = _less(level, _even(drifts[b], b, data.train))
                course = innovations(
                    r,
                    np.where(rows, np.hypot(quick, either[b]), math.inf),
                    drifts[b],
                    memory=memory,
                    records=data.train,
                )
                left = rms(course[rows])
            else:
                left = _sure_rms(r[rows] / level[rows], either[b][rows] / level[rows])
            out[b] = min(1.0, left / max(1 - spread, LEAST_MARGIN))
    return out


def references(data: Dataset, records: Sequence[WeakRecord]) -> dict[str, FloatArray]:
    """The measured torque of each balance, averaged: what the relative error refers to; where no
    torque is measured, the twist about its middle.
    """
    return {b: np.concatenate([measured(b, w) for w in records]) for b in data.sensing.balances}


def passed_on(
    model: JointModel, data: Dataset, values: Mapping[str, float]
) -> dict[str, FloatArray]:
    """What a standard deviation of the measured torques makes of each row of the balances, training
    and then held-out rows, (rows,) each.

    A law that takes a share of a measured torque scales the whole balance, noise and errors of the
    model with it: what is left is shorter and no smaller.
    """
    records = [*data.train, *data.held_out]
    balances = balances_of(model, data.sensing, wrt=())
    values = settled(model, data.sensing, records, values)
    sizes: dict[str, float] = {c: data.sources[c].level for c in SCALED if c in data.sources}
    found = [_moved_by(balances, values_on(model, w, values), w, sizes) for w in records]
    return {b: np.concatenate([f[b] for f in found]) for b in balances.balances}


def _higher(signals: Mapping[str, FloatArray], channel: str, size: float) -> dict[str, FloatArray]:
    """The signals with one of them higher by so much."""
    return {**signals, channel: signals[channel] + size}


def measured(balance: str, record: WeakRecord) -> FloatArray:
    """What :func:`references` says of one record."""
    if balance == "kinematic":
        twist = record.averaged["motor_position"] - record.averaged["link_position"]
        return np.asarray(twist - np.median(twist), dtype=np.float64)
    return record.averaged[{"link": "torque", "transmission": "torque"}.get(balance, "drive")]


def unsure(
    balances: Balances, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]
) -> dict[str, FloatArray]:
    """Scatter of each row from where exactly friction changes its sign, which may act either way
    or be spread over a turn, and from when exactly a torque jumped between two samples [N.m].
    """
    names = balances.model.named("smoothing")
    either = _either_way(balances.model, data, values, records)
    either = {
        b: np.hypot(x, jumps)
        for (b, x), jumps in zip(
            either.items(), _between_samples(balances, data, values, records), strict=True
        )
    }
    if data.sensing.kinematic:
        settled_values = settled(balances.model, data.sensing, records, values)
        flying = [balances.flight(w, values_on(balances.model, w, settled_values)) for w in records]
        either = {b: np.hypot(x, np.concatenate(flying)) for b, x in either.items()}
    if not names:
        return either
    bare = balances_of(balances.model, data.sensing, wrt=())
    here = stack(bare, records, values).residual
    there = stack(bare, records, {**values, **{n: 2 * values[n] for n in names}}).residual
    return {b: np.hypot((here[b] - there[b]) / 2, either[b]) for b in here}


def row_weights(
    balances: Balances,
    data: Dataset,
    values: Mapping[str, float],
    sigma: Mapping[str, float] | Mapping[str, FloatArray],
    records: Sequence[WeakRecord],
) -> dict[str, FloatArray]:
    """1/sigma of each row: rows that hang on where exactly friction changes its sign, or on what
    was before the record began, count less (`sigma`: of a balance, or of its rows).
    """
    either = unsure(balances, data, values, records)
    begun = beginnings(balances, data, values, records)
    support = support_of(records)
    return {b: support / np.sqrt(sigma[b] ** 2 + either[b] ** 2 + begun[b] ** 2) for b in either}


def beginnings(
    balances: Balances, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]
) -> dict[str, FloatArray]:
    """What each row of a balance hangs on the state in which a law with memory began, (rows,)
    [N.m]: bristles are bent and elements slipped before a segment of a record begins.

    Where more than a few rows do, the law remembers its beginning for good, as a spring does: that
    is no beginning, and the rows count as they are.
    """
    bare = balances_of(balances.model, data.sensing, wrt=())
    out: dict[str, list[FloatArray]] = {b: [] for b in bare.balances}
    for w in records:
        for b, rows in bare.begun(w, values_on(balances.model, w, values)).items():
            hanging = np.count_nonzero(rows > STILL_KNOWN * rows.max(initial=0.0))
            short = hanging <= MOST_OF_A_BEGINNING * w.rows
            out[b].append(rows if short else np.zeros(w.rows))
    return {b: np.concatenate(parts) if parts else np.empty(0) for b, parts in out.items()}


def support_of(records: Sequence[WeakRecord]) -> FloatArray:
    """Root of the share of its samples that each row has over that of all rows of its record,
    (rows,): one of which samples were lost averages fewer of them, and its variance grows with one
    over what is left. What the lost ones add to the rows of a record on the whole is in the noise
    that is drawn for it.
    """
    share = [np.ones(w.rows) if w.support is None else w.support for w in records]
    share = [x / max(float(x.mean()), 1e-300) for x in share]
    return np.asarray(np.sqrt(np.concatenate(share)), dtype=np.float64)


def _either_way(
    model: JointModel, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]
) -> dict[str, FloatArray]:
    """Friction torque that may act in either direction, at a standstill or a turn, averaged
    like a row [N.m].
    """
    zero = np.zeros(sum(w.rows for w in records))
    sources = data.sources
    out = dict.fromkeys(data.sensing.balances, zero)
    for place, balances in (
        ("motor", ("motor", "sum", "deflection", "axis")),
        ("link", ("link", "sum", "axis", "kinematic")),
    ):
        level = sticking_torque(model, values, place)
        source = f"{place}_position"
        if not level or source not in sources:
            continue
        shares = []
        for w in records:
            either = _either_direction(w, place, sources[source]).astype(float)
            average, *later = friction_rows(model, values, w, place)
            shares.append(sum((abs(part) @ either for part in later), average @ either))
        held = level * np.concatenate(shares)
        for b in balances:
            if b in out:
                out[b] = np.hypot(out[b], held)
    return out


def friction_rows(
    model: JointModel, values: Mapping[str, float], record: WeakRecord, place: str
) -> list[Any]:
    """Sparse (rows, points) arrays, of which the sum is what a friction torque of 1 on one side
    adds to the rows of a balance at each point: its average, and what a link that hangs unseen on
    a compliance passes on late.
    """
    rows = [record.averaging]
    if model.lagging_load and place == "motor":
        lag = model.swinging_inertia(values) * model.load_compliance(values)
        rows += [lag * record.curving] if lag else []
    late = model.load_relaxation(values)
    return [*rows, late * record.tilting] if late else rows


def _between_samples(
    balances: Balances, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]
) -> list[FloatArray]:
    """Scatter of the rows of each balance of the sensing from jumps of a measured torque between
    two samples [N.m].

    A jump at an instant that nobody knows, even over a sample, moves the average by ``weight *
    jump / sqrt(12)``; the samples with every other one turned round hold ``weight * jump / 2`` of
    it, and noise as strong as that of the average.
    """
    slopes = balances_of(balances.model, data.sensing, wrt=()).slopes(values)
    out = []
    for b in data.sensing.balances:
        parts = []
        for w in records:
            entering = [(slopes[b].get(c, 0.0), c) for c in w.between]
            told = sum((k * w.between[c] for k, c in entering), np.zeros(w.rows))
            noise = math.hypot(
                *(
                    k * data.sources[c].after(w.grid.alternating, w.grid.dt)
                    for k, c in entering
                    if c in data.sources
                )
            )
            parts.append(np.sqrt(np.maximum(told**2 - (SURE_JUMP * noise) ** 2, 0.0) / 3))
        out.append(np.concatenate(parts) if parts else np.empty(0))
    return out


def sticking_torque(model: JointModel, values: Mapping[str, float], place: str) -> float:
    """Torque that dry friction of a side may hold at a standstill, in either direction [N.m]."""
    return float(sum(abs(values[n]) for n in model.named("static", place)))


def _either_direction(record: WeakRecord, place: str, noise: ChannelNoise) -> npt.NDArray[np.bool_]:
    """Points at which the direction is not known: slower than the noise, nearer to a turn than
    its kernel tells when it was, or, where the kernel is no longer than a few samples, between a
    move one way and one the other: dry friction makes a corner of a turn, or holds the joint
    there, and a velocity across it says nothing.
    """
    grid, source = record.grid, f"{place}_position"
    velocity = record.points[f"{place}_velocity"]
    slow = np.abs(velocity) < 3 * grid.velocity_noise(source, noise)
    turns = np.diff(np.sign(velocity), append=np.sign(velocity[-1:])) != 0
    apart = grid.step * grid.dt
    reach = max(0, whole(TURN_SHARE * (grid.pointwise[source] - TURN_KERNEL) / apart))
    near = (
        np.convolve(turns, np.ones(2 * reach), "same") > 0
        if reach
        else np.zeros(len(velocity), dtype=bool)
    )
    if grid.pointwise[source] < FEW_SAMPLES * grid.dt:
        moved = np.diff(record.points[source])
        one_step = np.zeros(grid.step + 1)
        one_step[0], one_step[-1] = -1.0, 1.0
        sure = 3 * noise.after(one_step, grid.dt)
        way = np.sign(moved) * (np.abs(moved) > sure)
        before, after = np.append(way[:1], way), np.append(way, way[-1:])
        near |= (before != after) | (before == 0)
    return np.asarray(slow | near)


def rms(values: FloatArray) -> float:
    """Root mean square."""
    flat = values.ravel()
    return math.sqrt(float(flat @ flat) / flat.size) if flat.size else 0.0
