"""Records prepared for a fit, each channel at the time that the fit itself finds for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np

from casadi_models import JointModel
from identification.balance.calibration import names_of_runs, of_run, settled, within_limits
from identification.balance.clocks import (
    HALF_A_CYCLE,
    LOW_PASSED,
    MOST_SKEW,
    NEAR,
    PRICE,
    USUAL_HALF,
    carrier,
    places_of,
)
from identification.balance.dataset import Dataset, load_dataset
from identification.balance.excitation import noise_of_inertias
from identification.balance.sensing import Sensing
from identification.balance.weak import WeakRecord
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.fitting.assess import assess
from identification.fitting.engine import Solution, carried_over, solve
from identification.fitting.first_fit import first_fit

ROUNDS: Final = 4
"""Rounds in which clocks are set by the fit: of a lateness of `MOST_SKEW` samples the series in the
model misses a third, and of what is left a third again, down to :data:`NEAR`."""
CLOSER: Final = 2
"""Parabolas that lead to the share of a lateness that is a wait: what is left changes by a factor
ten over a sample, which is no parabola; the second is through points half as far.
"""
NOISY: Final = 0.5
"""Share of the squares of an acceleration that may be noise: what is taken off for it then is no
more than what is left, and noise that is known to a tenth leaves a tenth of the inertia open.
"""
LONGER: Final = (2.0, 4.0)
"""Lengths of longer rows: every factor of two takes noise off by thirty."""
MOST_KERNEL: Final = 0.25
"""Longest of them [s]: a sixth of the blocks of time that count as independent, whose edges take
that much of the rows."""
BETTER: Final = 0.1
"""Share by which what is left over the noise must fall with another reading of a drive: as much as
an effect must take off to be named. A fit that lacks an effect leans to whatever stands in for it.
"""


def dataset_of(
    train: Sequence[Record],
    held_out: Sequence[Record],
    joint: Joint,
    model: JointModel,
    *,
    kernel: float | None = None,
    like: Sensing | None = None,
    beside: tuple[Solution, Sequence[Mapping[str, float]]] | None = None,
    alone: bool = False,
) -> Dataset:
    """:func:`load_dataset`, with channels shifted by as much as the fit says that they are late.

    Before a fit, a record tells how late a channel is by its rate beside free curves of the motion.
    That can be hidden by noise, or taken for something else; the balances together, and what the
    other records say of the joint, tell it better. But the model has a lateness as a series, which
    holds for a part of a sample: so what the fit finds is taken off, and it is asked again. A
    drive's reading that is late may wait or come through a low-pass, which is made good by its
    rate and by no shift: the fit that leaves less of the training records tells.

    Parameters
    ----------
    train, held_out : sequence of Record
    joint : Joint
    model : JointModel
    kernel, like
        See :func:`load_dataset`.
    beside : (Solution, sequence of mapping), optional
        A fitted model that has more laws, and the shifts of the training and held-out records from
        which the clocks are asked again with it.
    alone : bool
        Whether how a drive is read is left as each record alone has it, beside free coefficients of
        all that it follows from.

    Raises
    ------
    InputError
        As by :func:`load_dataset`.
    """
    whole = partial(load_dataset, train, held_out, joint, model, like=like)
    read = whole(kernel=kernel) if beside is None else whole(kernel=kernel, late=beside[1])
    if kernel is None:
        read = _clear_of_noise(read, model, whole)
    kernel = read.kernel
    load = partial(whole, kernel=kernel)
    probe = partial(load_dataset, train, (), joint, model, kernel=kernel, like=like)
    if not places_of(model):
        return read

    def fitted(data: Dataset) -> Solution:
        if beside is None:
            return first_fit(model, data)
        return solve(beside[0].model, data, start=beside[0].values)

    try:
        data, fit = _in_time(read, load, fitted)
        for place in (p for p in places_of(model) if p in LOW_PASSED and not alone):
            late = _read(place, data, probe, fit)
            if late != shifts_of(data):
                data, fit = _in_time(load(late=late), load, fitted)
        return data
    except InputError:  # a fit that is refused is refused where it is asked for
        return read


def _clear_of_noise(data: Dataset, model: JointModel, load: Callable[..., Dataset]) -> Dataset:
    """The records in rows that are long enough for the inertias: as they are where noise is a small
    part of the averaged accelerations; else the shortest longer ones where it is, or those where it
    is least.

    Noise of a position, twice differentiated, falls by five powers of the length of a row, and an
    acceleration of slow motion hardly. Rows are no longer than they must be: longer ones hold less
    of what is quick.
    """
    found, least = data, noise_of_inertias(data, model)
    for factor in LONGER:
        if least <= NOISY or data.kernel * factor > MOST_KERNEL:
            break
        try:
            longer = load(kernel=data.kernel * factor)
        except InputError:  # a record is too short for it, or stands still but for a moment
            break
        share = noise_of_inertias(longer, model)
        if share < least:
            found, least = longer, share
    return found


def shifts_of(data: Dataset) -> list[dict[str, float]]:
    """Times by which the channels of all records are shifted [s], by place; the training records
    first.
    """
    return [dict(w.shifts) for w in _records(data)]


def _records(data: Dataset) -> tuple[WeakRecord, ...]:
    return (*data.train, *data.held_out)


def _in_time(
    data: Dataset, load: Callable[..., Dataset], fitted: Callable[[Dataset], Solution]
) -> tuple[Dataset, Solution]:
    """The records with the channels that wait shifted as the fit has them, and the fit to them."""
    fit = fitted(data)
    for _ in range(ROUNDS):
        model, records = fit.model, _records(data)
        found = settled(model, data.sensing, records, fit.values)
        if len(within_limits(model, records, found)) < len(names_of_runs(model, records)):
            # what is later than a clock may be is to be named: the other clocks make up for it
            break
        late = [_late(model, w, found) for w in records]
        if all(s == w.shifts for s, w in zip(late, records, strict=True)):
            break
        data = load(late=late)
        fit = fitted(data)
    return data, fit


def _late(model: JointModel, record: WeakRecord, values: Mapping[str, float]) -> dict[str, float]:
    """Times [s] by which the channels of a record are to be shifted: what stands within `NEAR`
    stays.
    """
    out, dt = dict(record.shifts), record.grid.dt
    for place in places_of(model):
        if place not in LOW_PASSED:
            late = _lateness(model, record, place, values)
            if abs(late - out.get(place, 0.0)) > NEAR * dt:
                out[place] = late
    return out


def _lateness(
    model: JointModel, record: WeakRecord, place: str, values: Mapping[str, float]
) -> float:
    """All of the lateness of a channel that the fit finds [s]: of a clock no more than a clock may
    have, of a delay that the model names all of it.
    """
    name, most = carrier(model, place), MOST_SKEW * record.grid.dt
    if name is None:
        return 0.0
    late = values.get(of_run(name, record), values[name])
    return float(np.clip(late, -most, most)) if name in model.calibration else float(late)


def _read(
    place: str, data: Dataset, probe: Callable[..., Dataset], fit: Solution
) -> list[dict[str, float]]:
    """Shifts of the records [s] with a reading shifted by a part of its lateness, or by a part of
    the cycle of its filter the other way: as the fit leaves least of the training records.
    """
    records = _records(data)
    found = settled(fit.model, data.sensing, records, fit.values)
    whole = [_lateness(fit.model, w, place, found) for w in records]
    dt, trained = records[0].grid.dt, len(data.train)
    if max(abs(k) for k in whole) <= NEAR * dt:
        return shifts_of(data)
    left: dict[tuple[float, ...], tuple[tuple[int, float], ...]] = {}

    def told(shifts: Sequence[float]) -> tuple[tuple[int, float], ...]:
        """Rows of each balance of the training records, and what is left of them over noise, with
        the reading of each record shifted so.
        """
        if tuple(shifts) not in left:
            late = [{**w.shifts, place: k} for w, k in zip(data.train, shifts, strict=False)]
            moved = data if late == shifts_of(data)[:trained] else probe(late=late, told=data)
            found = settled(fit.model, moved.sensing, moved.train, carried_over(fit, moved))
            error = assess(fit.model, moved, moved.train, found)
            left[tuple(shifts)] = tuple((len(e.residual), e.ratio) for e in error.balances.values())
        return left[tuple(shifts)]

    def least() -> tuple[float, ...]:
        return min(left, key=lambda shifts: _over(left[shifts]))

    def early(samples: float) -> Sequence[tuple[int, float]]:
        return told([-samples * dt] * len(records))

    stands = tuple(w.shifts.get(place, 0.0) for w in records)
    told(stands)
    steps = max(math.ceil(max(abs(k) for k in whole) / dt), 1)
    shares = {i / steps: told([i / steps * k for k in whole]) for i in range(steps + 1)}
    for _ in range(CLOSER):
        share = _lowest({x: _squares(y) for x, y in shares.items()})
        shares[share] = told([share * k for k in whole])
    if max(least()) <= 0.0 and min(whole) > NEAR * dt:
        early(_half_cycle(early))
    best = least()
    moves = max(abs(b - s) for b, s in zip(best, stands, strict=True))
    if moves <= NEAR * dt or _over(left[best]) >= (1 - BETTER) * _over(left[stands]):
        return shifts_of(data)
    return [{**w.shifts, place: k} for w, k in zip(records, best, strict=True)]


def _lowest(points: Mapping[float, float]) -> float:
    """Where the parabola through the lowest of these points and its neighbours is lowest; the point
    itself at either end.
    """
    order = sorted(points)
    at = order.index(min(order, key=lambda x: points[x]))
    if not 0 < at < len(order) - 1:
        return order[at]
    (a, b, c), (low, mid, high) = (
        order[at - 1 : at + 2],
        (points[x] for x in order[at - 1 : at + 2]),
    )
    left, right = (mid - low) / (b - a), (high - mid) / (c - b)
    bend = (right - left) / (c - a)
    return (a + b - left / bend) / 2 if bend > 0 else b


def _squares(left: Sequence[tuple[int, float]]) -> float:
    """Squares of what is left over noise, summed over the rows of all balances."""
    return sum(n * r**2 for n, r in left)


def _over(left: Sequence[tuple[int, float]]) -> float:
    """What is left over noise, in all balances. Levels of noise are known to a tenth or two, and no
    shift of a reading follows noise: a fall below them counts as any other.
    """
    return math.prod(ratio for _, ratio in left)


def _half_cycle(left: Callable[[float], Sequence[tuple[int, float]]]) -> float:
    """By how much a filtered reading is early beside its rate [samples].

    A low-pass of a computer weighs its last reading and the one before: its rate is that of half
    its cycle ago. What is left falls along a parabola over a shift; what drives usually have says
    the rest.
    """
    half = HALF_A_CYCLE / 2
    none, first, second = (_squares(left(k * half)) for k in range(3))
    bend, slope = (none + second - 2 * first) / 2, (4 * first - second - 3 * none) / 2
    if bend <= 0 or slope >= 0:
        return 0.0
    at = min(-slope / (2 * bend), 2.0)
    rows = sum(n for n, _ in left(0.0))
    # three points far from least are no parabola: one through them may fall below what noise leaves
    rest = max(none + slope * at + bend * at**2, min(none, float(rows)))
    told = (none - rest) / (rest / rows)
    early = at * half
    return early * told / (told + PRICE * (early / USUAL_HALF) ** 2)


__all__ = ["BETTER", "dataset_of", "shifts_of"]
