"""What changed: which parameters of a fitted joint moved, by how much, and with what certainty.

The structure of the reference is fitted to new records with the reference's own values and standard
errors as what is known beforehand.  A parameter is let go only where that lowers the error on
blocks of time that its fit did not see, so that the fewest changes that explain the records are
named.  Rates of false discovery after Benjamini and Hochberg (1995).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from statistics import NormalDist
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, JointModel
from casadi_models.term import LINK_INERTIA, LOAD_COMPLIANCE, TOTAL_INERTIA
from identification.balance.balances import balances_of
from identification.balance.calibration import names_of_runs, of_run
from identification.balance.dataset import HOLD_NAME, Dataset, prepared_model
from identification.balance.noise import effective_share
from identification.balance.stacked import stack, taking_part
from identification.balance.weak import WeakRecord
from identification.data.joint_file import Joint
from identification.data.prepare import STANDARD_GRAVITY
from identification.data.record import Record, listed
from identification.diagnosis.candidates import observable
from identification.diagnosis.claims import FALSE_DISCOVERY, GAIN, LARGEST_SET
from identification.errors import InputError
from identification.fitting.assess import RATIO_LIMIT, Error, assess
from identification.fitting.covariance import (
    BLOCK,
    FEWEST_BLOCKS,
    cores,
    errors_of_windows,
    independent,
    inverse,
    windows_over,
)
from identification.fitting.dataset import dataset_of
from identification.fitting.engine import Solution, solve
from identification.fitting.errors_in_variables.equations import unbiased
from identification.fitting.errors_in_variables.products import noise_products, whole_without
from identification.fitting.start_values import bounds_of
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Progress = Callable[[str, float], None]

LEAST_FALL: Final = 1.0
"""Fall of the RMS of some balance on blocks that the fit did not see that a change must bring [%]:
under it the records can be explained as well without the change, whatever its standard error
says."""
CERTAIN: Final = 2.0
"""Standard errors of the mean difference between blocks up to which two explanations do equally
well: a 95 % band.
"""
TIED: Final = 0.15
"""Share of the gain that another name for a change may lose and still stand beside it: what the
sets of `improve` allow.
"""
LEAST_SHARE: Final = 0.5
"""Share of the gain below which a name does not stand beside another one, however much blocks
differ: it misses half of it.
"""
FOLDS: Final = 8
"""Parts of the blocks that are left out in turn: each leaves most of the motion in the fit."""
HELD: Final = 1e-6
"""Standard error of a reference value that was held, as a share of its size: known as far as a
file's figures go.
"""
LEAST_TOLD: Final = 0.05
"""Share of a value from which the smallest change that could be seen is printed, and from which a
change between two records of the same motion is named: the viscous friction of EMPS differs by as
much between its two recordings, and what warmth does is certain there and no fault.
"""
LEAST_ALIKE: Final = 0.5
"""Share of a stretch for which a healthy one must last, at a lag, to be asked whether its motion is
the same: less of it is alike by chance, as any start and stop is.
"""
CLOSER: Final = 20
"""Parts of the distance of two rows at which the lag of a motion alike is looked for: what is left
of it is a few hundredths of the kernel.
"""
STEPS: Final = 12
"""Steps of one refit at most: it starts next to its end."""


@final
@dataclass(frozen=True)
class Change:
    """One parameter that moved.

    Attributes
    ----------
    parameter, unit : str
    before, after : float
        Value of the reference, and on the new records [unit].
    stderr : float
        Standard error of the difference: of the new value, of the reference's, and of what ties it
        to the others.
    q : float
        Rate of false discovery at which this change is just named.
    tied : tuple of str
        Other parameters that explain the records as well in its place.
    drop_percent : float
        Rise of the RMS of the balance it shows in most, on blocks not seen, if this change were
        left out, in % of that RMS.
    """

    parameter: str
    before: float
    after: float
    stderr: float
    unit: str
    q: float
    tied: tuple[str, ...] = ()
    drop_percent: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """The shape of `changed --json`."""
        return {
            "parameter": self.parameter,
            "from": self.before,
            "to": self.after,
            "stderr": self.stderr,
            "unit": self.unit,
            "q": self.q,
            "tied_with": list(self.tied),
            "drop_percent": self.drop_percent,
        }


@final
@dataclass(frozen=True)
class Payload:
    """A load that was added (or taken off, negative).

    Attributes
    ----------
    mass, stderr : float
        [kg]
    distance, distance_stderr : float or None
        Of its centre from the axis of rotation [m]; None on a linear axis.
    """

    mass: float
    stderr: float
    distance: float | None
    distance_stderr: float | None

    def as_json(self) -> dict[str, Any]:
        """The shape of `changed --json`."""
        return {
            "mass": self.mass,
            "stderr": self.stderr,
            "distance": self.distance,
            "distance_stderr": self.distance_stderr,
        }


@final
@dataclass(frozen=True)
class Changes:
    """What moved between a reference and new records.

    Attributes
    ----------
    joint : Joint
        The reference.
    model : JointModel
        With the values that hold on the new records.
    changes : tuple of Change
        The largest gain first.
    payload : Payload or None
    unchanged, untestable : tuple of str
        Parameters of the reference that stayed, and those that the new records do not show.
    before, after : Error
        Of the reference, and after the changes, on the new records.
    refitted : Error
        With every parameter fitted anew: what no change of a parameter can explain.
    minor : tuple of Change
        A shift that is certain, but smaller than the model's own error: another motion may do as
        much to a model that is not exact.
    least : mapping of str to float
        Of each parameter that stayed, gain and offset of the sensors with them: about the smallest
        change that would have been named, either way, in its unit. A smaller one may be there.
    alike : tuple of str
        Healthy records whose motion was the same: what the model leaves in both was no change.
    """

    joint: Joint
    model: JointModel
    changes: tuple[Change, ...]
    payload: Payload | None
    unchanged: tuple[str, ...]
    untestable: tuple[str, ...]
    before: Error
    after: Error
    refitted: Error
    records: tuple[str, ...] = ()
    payload_note: str = ""
    minor: tuple[Change, ...] = ()
    least: Mapping[str, float] = field(default_factory=dict)
    alike: tuple[str, ...] = ()

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Balances in which more than noise is left with every parameter fitted anew: something
        that is no parameter.
        """
        return tuple(b for b, e in self.refitted.balances.items() if e.ratio > RATIO_LIMIT)

    def as_json(self) -> dict[str, Any]:
        """The shape of `changed --json`."""
        return {
            "changed": [c.as_json() for c in self.changes],
            "payload": self.payload.as_json() if self.payload else None,
            "minor": [c.as_json() for c in self.minor],
            "least": dict(self.least),
            "unchanged": list(self.unchanged),
            "untestable": list(self.untestable),
            "records": list(self.records),
            "alike": list(self.alike),
            "before": self.before.as_json(),
            "after": self.after.as_json(),
            "refitted": self.refitted.as_json(),
            "unexplained": list(self.unexplained),
            "payload_note": self.payload_note,
        }

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterable[str]:
        if self.alike:
            yield (
                f"the motion is that of {', '.join(self.alike)}: what the model leaves there, too, "
                "is taken off"
            )
        for word, group in (("changed", self.changes), ("small but certain", self.minor)):
            for c in group:
                share = f" ({100 * (c.after / c.before - 1):+.1f} %)" if c.before else ""
                yield (
                    f"{word}: {c.parameter} {c.before:.6g} -> {c.after:.6g} +- {c.stderr:.2g} "
                    f"{c.unit}{share}, q = {c.q:.2g}"
                )
                if c.tied:
                    yield f"  or {' or '.join(c.tied)}: these cannot be told apart on these records"
        if not self.changes:
            yield (
                "nothing changed: no parameter moved by more than its band and the error of "
                "the model itself"
            )
        yield from self._hidden()
        if self.payload is not None:
            at = (
                f" at {self.payload.distance:.3g} +- {self.payload.distance_stderr:.2g} m"
                if self.payload.distance is not None
                else ""
            )
            yield f"payload: {self.payload.mass:.3g} +- {self.payload.stderr:.2g} kg{at}"
        elif self.payload_note:
            yield f"payload: {self.payload_note}"
        if self.untestable:
            yield f"not shown by these records: {', '.join(self.untestable)}"
        yield (
            f"relative error {self.before.relative_error_percent:.2f} % with the reference, "
            f"{self.after.relative_error_percent:.2f} % after the changes"
        )
        for b in self.unexplained:
            e = self.after.balances[b]
            yield (
                f"not explained by any parameter: {b} balance, {e.rms:.3g} {e.unit} left, "
                f"{e.ratio:.2g} times its noise; see irj improve"
            )

    def _hidden(self) -> Iterable[str]:
        """What may have moved unseen, where that is more than a small share of the value."""
        told = []
        for p in self.model.parameters:
            least, value = self.least.get(p.name), abs(self.joint.fitted.get(p.name, 0.0))
            if least is not None and least > LEAST_TOLD * value:
                share = f" ({100 * least / value:.0f} %)" if value and least < 10 * value else ""
                size = f"{100 * least:.2g} %" if p.unit == "1" else f"{least:.2g} {p.unit}"
                told.append(f"{p.name} by less than {size}{share}")
        if told:
            yield f"too small to be seen on these records: {', '.join(told)}"


def changed(
    reference: Joint,
    records: Record | Sequence[Record],
    *,
    healthy: Record | Sequence[Record] = (),
    progress: Progress | None = None,
) -> Changes:
    """Name the parameters of a fitted joint that moved.

    Parameters
    ----------
    reference : Joint
        A joint file written by a fit, with its values and standard errors.
    records : Record or sequence of Record
        New records, with the channels of those of the fit.
    healthy : Record or sequence of Record, optional
        Records of the joint as it was fitted. Where one moves as the new ones do, what the model
        leaves in it is taken off what it leaves in them: the errors of a model are the same on the
        same motion, and smaller changes are seen beside them.
    progress : callable, optional
        ``progress(text, share)``.

    Returns
    -------
    Changes

    Raises
    ------
    InputError
        No fitted values; a parameter of these records that the reference has no value of; records
        too short.

    Examples
    --------
    >>> print(changed(load_joint("healthy.toml"), read("today.csv")))   # doctest: +SKIP
    """
    given = listed(records)
    tell = progress or (lambda text, share: None)
    search = _prepared(reference, given, tell, listed(healthy))
    moved = search.chosen(tell)
    tell("sizes and bands", 0.9)
    return _result(search, moved, tuple(r.name for r in given))


def _prepared(
    reference: Joint,
    records: Sequence[Record],
    tell: Progress,
    healthy: Sequence[Record] = (),
) -> _Search:
    """The structure of the reference on the new records, with the calibration of its sensors as
    what may have changed too.
    """
    where = reference.source or reference.name
    if not reference.fitted:
        raise InputError(
            f"{where}: has no [fitted] values to compare with; write it with irj fit REC... "
            f"--joint {where} -o FILE"
        )
    if not records:
        raise InputError("no record to compare with the reference; give at least one")
    plain = prepared_model(replace(reference, known={}), records[0])
    if lacking := reference.lacks(plain):
        raise InputError(
            f"{where}: has no fitted value of {', '.join(lacking)}, which these records ask for; "
            "fit the reference on records with the same channels"
        )
    free = replace(reference, known={})
    stands = {n: k.value for n, k in reference.held().known.items() if k.value is not None}
    rigid = stands.get(LOAD_COMPLIANCE.name) == 0.0
    if rigid and not any(t.effect.needs_load for t in plain.terms):
        # no link swung unseen in the reference: what hangs on one is nothing that changed
        plain = replace(plain, lagging_load=False, load_from=reference.model().load_from)
    plain = plain.with_values({n: v for n, v in stands.items() if n in plain.parameter_names})
    data = dataset_of(records, [], free, plain)
    if data.blocks < FEWEST_BLOCKS:
        raise InputError(
            f"{records[0].name}: too short to tell a change from chance; give at least "
            f"{1.5 * FEWEST_BLOCKS:g} s of motion"
        )
    tell("refitting the reference", 0.1)
    refit = solve(plain, data, start=dict(plain.values))
    model = plain
    for label in _calibrations(plain, data):
        model = model.add(label)
    values = {**{p.name: p.start for p in model.parameters}, **plain.values}
    of_runs = names_of_runs(plain, data.train)
    values.update({n: refit.values[n] for n in (*_nuisances(plain), *of_runs)})
    names = tuple(model.parameter_names)
    balances = balances_of(model, data.sensing, wrt=names)
    error = assess(refit.model, data, data.train, refit.values)
    weights, squares, shares = _shared(refit, data)
    form = WeakForm(balances, data, values, names, weights)
    ratios = np.array([error.balances[b].ratio for b in balances.balances])
    noise = squares / np.maximum(ratios, 1.0) ** 2
    inexact = np.maximum(_squares(_left(form, refit)) - noise, 0.0)
    alike = None
    if healthy:
        tell("looking for the same motion", 0.15)
        then = dataset_of(healthy, [], free, plain, kernel=data.kernel, like=data.sensing)
        alike = _alike(form, then.train, then.train_names)
    if alike is not None and (beside := _beside(form, alike, refit, shares)) is not None:
        share = np.array([np.mean(told) for told in alike.told.values()])
        # both recordings have their own noise
        noise *= 2 * share * beside[1] / shares
        form, shares = beside
        inexact = np.maximum(_squares(_left(form, refit)) - noise, 0.0)
    else:
        alike = None
    return _Search(
        reference,
        model,
        data=data,
        refit=refit,
        form=form,
        spread=_prior(reference, model, values),
        unsure=_unsure(refit, data, names),
        tied=_tied_errors(reference, names, max(float(ratios.max()), 1.0) ** -2),
        inexact=inexact,
        shares=shares,
        refitted=error,
        alike=alike,
    )


def _calibrations(model: JointModel, data: Dataset) -> list[str]:
    """Gain and offset of the drive and of the torque sensor, which the file holds as figures
    and not as parameters of the model.
    """
    out = []
    for effect in EFFECTS.values():
        if effect.family != "sensor" or effect.shapes or effect.is_delay or not effect.candidate:
            continue
        out += [
            effect.key
            for place in effect.acts_on
            if len(effect.acts_on) == 1
            and observable(place, data.sensing)
            and not model.has(effect.key)
        ]
    return out


def _shared(refit: Solution, data: Dataset) -> tuple[dict[str, FloatArray], FloatArray, FloatArray]:
    """Weights of the refit, each row counted as the share of an independent one, and what it
    leaves.

    Returns
    -------
    weights : dict of (rows,) array
    squares : (balances,) array
    shares : (balances,) array
    """
    balances = balances_of(refit.model, data.sensing, wrt=())
    stacked = stack(balances, data.train, refit.values)
    weights, squares, shares = {}, [], []
    for b in balances.balances:
        rows = (stacked.residual[b] * refit.weights[b])[stacked.taking[b]]
        shares.append(effective_share(rows) if len(rows) else 1.0)
        weights[b] = np.asarray(refit.weights[b] * math.sqrt(shares[-1]), dtype=np.float64)
        squares.append(shares[-1] * float(rows @ rows))
    return weights, np.array(squares), np.array(shares)


def _squares(rows: Mapping[str, FloatArray]) -> FloatArray:
    """Sum of squares of each balance."""
    return np.array([float(r @ r) for r in rows.values()])


def _left(form: WeakForm, refit: Solution) -> dict[str, FloatArray]:
    """Weighted rows that are left of each balance with every parameter fitted anew, gain and offset
    of the sensors among them: they may have changed too, and a change is no error of the model.

    One linear step from the refit, which has no sensor's gain and offset: they enter nearly so.
    A gain is a mixture of the others where it scales all of them; the step is the shortest.
    """
    x = np.array([refit.values.get(n, form.values[n]) for n in form.free])
    # a value at its bound stays there
    moves = [n not in refit.values or refit.stderr.get(n) is not None for n in form.free]
    stacked = form.stacked(x)
    columns, rows, sizes = [], [], []
    for b in form.balances.balances:
        weight = np.asarray(form.weights[b])
        taking = stacked.taking[b] & (weight > 0)
        columns.append((stacked.jacobian[b] * weight[:, None])[taking][:, moves])
        rows.append((stacked.residual[b] * weight)[taking])
        sizes.append(len(rows[-1]))
    jacobian, residual = np.vstack(columns), np.concatenate(rows)
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    step = np.linalg.lstsq(jacobian / scale, -residual, rcond=1e-9)[0]
    after = np.split(residual + jacobian / scale @ step, np.cumsum(sizes)[:-1])
    return dict(zip(form.balances.balances, after, strict=True))


@final
@dataclass(frozen=True)
class _Alike:
    """What healthy records leave where they moved as the new ones do, row by row of these.

    Attributes
    ----------
    left : mapping of str to (rows,) array
        Residual of each balance at the values of the reference; zero where there is none.
    columns : mapping of str to (rows, p) array
        Derivatives of that by the parameters.
    told : mapping of str to (rows,) bool array
        Rows for which there is one.
    records : tuple of str
        Names of these healthy records.
    """

    left: Mapping[str, FloatArray]
    columns: Mapping[str, FloatArray]
    told: Mapping[str, npt.NDArray[np.bool_]]
    records: tuple[str, ...]


def _alike(form: WeakForm, then: Sequence[WeakRecord], records: Sequence[str]) -> _Alike | None:
    """For each stretch of the new records the healthy stretch, and the lag, at which the joint
    moved most like it; None where none lasts long enough. `records`: names of the healthy ones.
    """
    there = stack(form.balances, then, form.values, form.free)
    now = form.data.train
    taking = {b: taking_part(b, now) for b in form.balances.balances}
    left = {b: np.zeros(form.rows) for b in taking}
    columns = {b: np.zeros((form.rows, len(form.free))) for b in taking}
    told = {b: np.zeros(form.rows, dtype=np.bool_) for b in taking}
    names: dict[str, None] = {}
    theirs = [(n, s) for n, each in zip(records, _stretches(then), strict=True) for s in each]
    for own in (s for stretches in _stretches(now) for s in stretches):
        fits = [(*found, name, s) for name, s in theirs if (found := _lag(own, s)) is not None]
        if not fits:
            continue
        _, lag, name, other = min(fits, key=lambda f: f[0])
        names.setdefault(name)
        place = np.searchsorted(other.time, own.time - lag) - 1
        inside = (place >= 0) & (place + 1 < len(other.time))
        place = np.clip(place, 0, len(other.time) - 2)
        part = (own.time - lag - other.time[place]) / np.diff(other.time)[place]
        low, high = other.rows[place], other.rows[place + 1]
        for b in taking:
            sure = inside & taking[b][own.rows] & there.taking[b][low] & there.taking[b][high]
            told[b][own.rows] = sure
            for out, of in ((left[b], there.residual[b]), (columns[b], there.jacobian[b])):
                p = part.reshape(-1, *[1] * (of.ndim - 1))
                whole = of[low] * (1 - p) + of[high] * p
                out[own.rows] = np.where(sure.reshape(p.shape), whole, 0.0)
    return _Alike(left, columns, told, tuple(names)) if names else None


@final
@dataclass(frozen=True)
class _Stretch:
    """A course without a gap: its rows among all, their times [s], and the motion in units of its
    RMS in the record, (rows, 2).
    """

    rows: IntArray
    time: FloatArray
    motion: FloatArray


def _stretches(records: Sequence[WeakRecord]) -> list[list[_Stretch]]:
    """The stretches of each record that are longer than a block."""
    out, first = [], 0
    for w in records:
        side = "motor" if "motor_position" in w.averaged else "link"
        motion = np.column_stack([w.averaged[f"{side}_{s}"] for s in ("position", "velocity")])
        parts = [np.flatnonzero(w.stretch == k) for k in range(int(w.stretch.max()) + 1)]
        out.append(
            [
                _Stretch(first + p, w.time[p], motion[p])
                for p in parts
                if len(p) and w.time[p[-1]] - w.time[p[0]] > BLOCK
            ]
        )
        first += w.rows
    return out


def _lag(now: _Stretch, then: _Stretch) -> tuple[float, float] | None:
    """How unlike the motions of two stretches are at the best lag, and that lag [s]: mean square of
    their difference in units of the motion's own variance; None where they overlap too little.
    """
    from scipy.signal import correlate

    step = float(np.median(np.diff(now.time)))
    size = np.maximum(np.std(now.motion, axis=0), 1e-300)
    middle = now.motion.mean(axis=0)
    one = (now.motion - middle) / size
    grid = np.arange(then.time[0], then.time[-1], step)

    def there(times: FloatArray) -> FloatArray:
        return np.column_stack(
            [np.interp(times, then.time, x) for x in ((then.motion - middle) / size).T]
        )

    two = there(grid)
    ones = np.ones(len(one)), np.ones(len(two))
    rows = np.round(correlate(*ones))
    squares = correlate((one**2).sum(axis=1), ones[1]) + correlate(ones[0], (two**2).sum(axis=1))
    crossed = sum(correlate(a, b) for a, b in zip(one.T, two.T, strict=True))
    unlike = np.where(
        rows >= LEAST_ALIKE * len(one), (squares - 2 * crossed) / np.maximum(rows, 1.0), np.inf
    )
    best = int(np.argmin(unlike))
    if not np.isfinite(unlike[best]):
        return None
    coarse = now.time[0] - grid[0] + (best - (len(two) - 1)) * step

    def at(lag: float) -> tuple[float, float]:
        times = now.time - lag
        inside = (times >= then.time[0]) & (times <= then.time[-1])
        return float(np.mean((one[inside] - there(times[inside])) ** 2)), lag

    return min(at(coarse + step * k / CLOSER) for k in range(-CLOSER, CLOSER + 1))


def _beside(
    form: WeakForm, alike: _Alike, refit: Solution, shares: FloatArray
) -> tuple[WeakForm, FloatArray] | None:
    """The rows less what healthy records leave on the same motion, and the share of them that count
    as independent; None where they leave more, with every parameter fitted anew, than without:
    then the motion is another one, and so are the errors of the model.
    """
    names = form.balances.balances
    weights = {b: np.asarray(form.weights[b]) * alike.told[b] for b in names}
    plain = replace(form, weights=weights)
    less = replace(plain, left=alike.left)
    rest = _left(less, refit)
    few = min(len(r) for r in rest.values()) <= len(form.free)
    if few or _squares(rest).sum() >= _squares(_left(plain, refit)).sum():
        return None
    own = np.array([effective_share(r) for r in rest.values()])
    scale = np.sqrt(own / shares)
    return replace(
        less, weights={b: weights[b] * k for b, k in zip(names, scale, strict=True)}
    ), own


def _nuisances(model: JointModel) -> tuple[str, ...]:
    """What says nothing of the joint, calibration of single records included: it is taken as the
    refit has it.
    """
    told = (*model.named("smoothing"), *model.calibration, HOLD_NAME)
    return tuple(n for n in model.parameter_names if n in told)


def _prior(reference: Joint, model: JointModel, values: dict[str, float]) -> FloatArray:
    """Standard error of each reference value; that of a nuisance is not asked for."""
    nuisances = _nuisances(model)
    out = []
    for p in model.parameters:
        size = reference.errors.get(p.name, 0.0)
        out.append(
            math.nan if p.name in nuisances else max(size, HELD * max(abs(values[p.name]), HELD))
        )
    return np.array(out)


def _unsure(refit: Solution, data: Dataset, names: Sequence[str]) -> FloatArray:
    """Standard error of what is taken as the refit has it, (p,); not a number where it has none.

    An unknown of single runs stands in one column for all of them: its error is that of their mean.
    """
    out = []
    for name in names:
        runs = [of_run(name, w) for w in data.train] if name in refit.model.calibration else [name]
        found = [e for e in (refit.stderr.get(n) for n in runs) if e is not None]
        out.append(float(np.linalg.norm(found)) / len(found) if found else math.nan)
    return np.array(out)


def _tied_errors(reference: Joint, names: Sequence[str], noise: float) -> FloatArray:
    """Correlations of the errors of the reference, (p, p); those that its file does not tell, and
    those of what is taken from the refit, are none.

    `noise`: share of the squares that the model leaves which is noise. What else it leaves is
    error of the model, which makes others on another motion: there nothing cancels.
    """
    told = reference.correlation.matrix(names)
    return np.asarray(np.where(np.eye(len(names), dtype=bool), 1.0, noise * told))


@final
@dataclass(frozen=True)
class _Search:
    """Rows of the new records and what the reference says beforehand.

    Attributes
    ----------
    form : WeakForm
        Every parameter in the order of the model, weighted so that its rows count as independent.
    spread : (p,) array
        Standard error of each reference value; not a number for a nuisance.
    unsure : (p,) array
        Standard error of each value of the refit, not a number where it has none.
    tied : (p, p) array
        Correlations of the errors of the reference.
    inexact : (balances,) array
        Squares that the model leaves over the noise with every parameter fitted anew.
    shares : (balances,) array
        Share of the rows that count as independent.
    refitted : Error
        Of that fit.
    alike : _Alike or None
        What healthy records leave on the same motion; it is taken off the rows of the form.
    """

    reference: Joint
    model: JointModel
    data: Dataset
    refit: Solution
    form: WeakForm
    spread: FloatArray
    unsure: FloatArray
    tied: FloatArray
    inexact: FloatArray
    shares: FloatArray
    refitted: Error
    alike: _Alike | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return self.form.free

    @cached_property
    def start(self) -> FloatArray:
        """Values of the reference, (p,)."""
        return np.array([self.form.values[n] for n in self.names])

    @cached_property
    def held_errors(self) -> FloatArray:
        """Standard errors of what is held, (p,): of the reference, or of the refit for what is
        taken from there; not a number where neither has one.
        """
        return np.where(np.isfinite(self.spread), self.spread, self.unsure)

    @cached_property
    def windows(self) -> Any:
        """Windows of time over the rows of a balance, from which errors are stated."""
        windows = windows_over([w.time for w in self.data.train])
        told = np.any([np.asarray(w) > 0 for w in self.form.weights.values()], axis=0)
        return windows.multiply(told[None, :]).tocsr()

    @cached_property
    def independent(self) -> float:
        """Number of independent windows that these count as."""
        return independent(self.windows)

    @cached_property
    def usual(self) -> FloatArray:
        """What each parameter differs by from one record to the next, (p,): asked for where the
        errors of the model do not hide it.
        """
        units = [p.unit for p in self.model.parameters]
        size = np.where((self.start == 0) & np.equal(units, "1"), 1.0, np.abs(self.start))
        return np.asarray(LEAST_TOLD * size * (self.alike is not None))

    @cached_property
    def _limits(self) -> dict[str, tuple[float, float]]:
        """Bounds, wide enough for the reference itself."""
        limits = bounds_of(self.model, {}, self.data)
        return {
            n: (min(limits[n][0], v), max(limits[n][1], v))
            for n, v in zip(self.names, self.start.tolist(), strict=True)
        }

    @cached_property
    def shown(self) -> npt.NDArray[np.bool_]:
        """Parameters that move the rows and that the reference knows, (p,)."""
        size = np.linalg.norm(self.form.jacobian(self.start), axis=0)
        return np.asarray((size > 1e-9 * size.max()) & np.isfinite(self.spread))

    def free(self, moved: Sequence[int]) -> list[int]:
        """Places of what is fitted when the parameters of `moved` are let go."""
        return sorted(moved)

    def fitted(self, moved: Sequence[int], start: FloatArray) -> _Point:
        """The refit with the parameters of `moved` let go; all others stay at the reference."""
        free = self.free(moved)
        x = np.where(np.isin(np.arange(len(start)), free), start, self.start)
        if free:
            names = tuple(self.names[i] for i in free)
            form = replace(self.form, values=self.form.at(x), free=names)
            values, _ = form.fitted(self._limits, STEPS)
            # the reference was fitted so too: noise left in on one side only would be a change
            values = dict(unbiased(replace(form, values=values), self._limits).values)
            x = np.array([values[n] for n in self.names])
        return _Point.at(self, x, tuple(moved))

    def groups(self) -> list[tuple[int, ...]]:
        """What may be let go in one step: each parameter, and inertia with gravity, which a
        payload changes together.
        """
        out: list[tuple[int, ...]] = [(int(i),) for i in np.flatnonzero(self.shown)]
        together = tuple(i for i in (*self.inertia, *self.gravity) if self.shown[i])
        return [*out, together] if len(together) > 1 else out

    @property
    def inertia(self) -> tuple[int, ...]:
        """Place of the inertia that a payload adds to."""
        return tuple(i for i, n in enumerate(self.names) if n in (LINK_INERTIA, *TOTAL_INERTIA))

    @property
    def gravity(self) -> tuple[int, ...]:
        """Places of the gravity torques."""
        return tuple(i for i, n in enumerate(self.names) if n in self.model.weights)

    def trials(self, point: _Point) -> dict[tuple[int, ...], _Gain]:
        """What each group that is still held would bring, with its rate of false discovery
        among all of them.
        """
        groups = [g for g in self.groups() if not set(g) <= set(point.moved)]
        gains = [point.gain(g) for g in groups]
        rates = discovery_rates([g.p_value for g in gains])
        return {g: replace(gain, q=q) for g, gain, q in zip(groups, gains, rates, strict=True)}

    def chosen(self, tell: Progress) -> _Point:
        """Forward selection of what moved, each addition followed by leaving out what it made
        needless.
        """
        point = self.fitted((), self.start)
        refused: set[tuple[int, ...]] = set()
        for number in range(2 * len(self.names)):
            tell("looking for what changed", 0.2 + 0.6 * min(1.0, number / 8))
            worth = {g: t for g, t in self.trials(point).items() if t.worth and g not in refused}
            if not worth:
                break
            group = max(worth, key=lambda g: worth[g].nats)
            bigger = self._without_needless(
                self.fitted(tuple(sorted({*point.moved, *group})), point.x)
            )
            if bigger.score > point.score:
                point = bigger
            else:
                refused.add(group)
        return point

    def _without_needless(self, point: _Point) -> _Point:
        """The fit without those changes that the others make needless, one after the other."""
        while len(point.moved) > 1:
            smaller = {
                i: self.fitted(tuple(j for j in point.moved if j != i), point.x)
                for i in point.moved
            }
            needless = [
                s for i, s in smaller.items() if not (self.shown[i] and self.trials(s)[(i,)].worth)
            ]
            if not needless:
                return point
            point = max(needless, key=lambda s: s.score)
        return point


@final
@dataclass(frozen=True)
class _Gain:
    """What letting one or more parameters go brings on blocks that the fit did not see.

    Attributes
    ----------
    nats : float
        Log-likelihood over all balances.
    block : (blocks,) array
        The same by block, on common variances.
    fall_percent : float
        Largest fall of a balance's RMS.
    beyond : bool
        True where it takes more out of a balance than the model's own error leaves in it, and is
        more than a joint differs by from one record to the next.
    p_value, q : float
        Chance of a change of this size, the smallest of the parameters'; rate of false discovery
        among all that were tried.
    """

    nats: float
    block: FloatArray
    fall_percent: float
    beyond: bool
    p_value: float
    q: float = 1.0

    @property
    def worth(self) -> bool:
        """True where the records ask for it."""
        return self.beyond and self.certain

    @property
    def certain(self) -> bool:
        """True where chance is no explanation."""
        return self.nats > GAIN and self.fall_percent >= LEAST_FALL and self.q <= FALSE_DISCOVERY


@final
@dataclass(frozen=True)
class _Point:
    """A refit with its normal equations: by block and balance, from which gains are told, and over
    windows of time, from which errors are.

    Attributes
    ----------
    x : (p,) array
    moved : tuple of int
        Places of the parameters that are let go.
    columns : mapping of str to (rows, p + 1) array
        Weighted columns of each balance and, last, the residual; zero where a row takes no part.
    added : mapping of str to (p + 1, p + 1) array
        What noise adds to their products, beyond what it adds to the squares that the reference
        leaves.
    block : (rows,) int array
        -1 for rows that touch two blocks.
    """

    search: _Search
    x: FloatArray
    moved: tuple[int, ...]
    columns: Mapping[str, FloatArray]
    added: Mapping[str, FloatArray]
    block: IntArray

    @classmethod
    def at(cls, search: _Search, x: FloatArray, moved: tuple[int, ...]) -> _Point:
        """The point with its rows."""
        form = search.form
        stacked = form.stacked(x)
        columns, added = {}, {}
        drawn, back = noise_products(form.moved(x)), search.start - x
        for b in form.balances.balances:
            score, gram = drawn.score[b], drawn.gram[b]
            own = -back @ (2 * score + gram @ back)
            added[b] = np.block([[gram, score[:, None]], [score[None, :], np.full((1, 1), own)]])
            weight = np.asarray(form.weights[b]) * stacked.taking[b]
            columns[b] = (
                np.column_stack([stacked.jacobian[b], stacked.residual[b]]) * weight[:, None]
            )
        return cls(search, x, moved, columns, added, stacked.block)

    def _noise_share(self, balance: str) -> FloatArray:
        """Share of what noise adds that falls to each row of a balance, (rows,)."""
        power = np.asarray(self.search.form.weights[balance]) ** 2
        power = power * taking_part(balance, self.search.data.train)
        return np.asarray(power / max(float(power.sum()), 1e-300))

    @cached_property
    def _by_block(self) -> tuple[FloatArray, FloatArray]:
        """Products of the columns, and what noise adds to them, (blocks, balances, p + 1, p + 1)
        each.
        """
        count, size = int(self.block.max()) + 1, len(self.x) + 1
        grams = np.zeros((count, len(self.columns), size, size))
        noise = np.zeros_like(grams)
        for k, (b, full) in enumerate(self.columns.items()):
            share = self._noise_share(b)
            for block in range(count):
                here = self.block == block
                grams[block, k] = full[here].T @ full[here]
                noise[block, k] = self.added[b] * float(share[here].sum())
        return grams, noise

    @property
    def grams(self) -> FloatArray:
        """Products of the columns within each block and balance."""
        return self._by_block[0]

    @property
    def noise(self) -> FloatArray:
        """What noise adds to them."""
        return self._by_block[1]

    @cached_property
    def _by_window(self) -> tuple[FloatArray, FloatArray]:
        """Products of the columns within the core of each window, and over the window by its
        weights, (windows, p + 1, p + 1) each, less what noise adds.
        """
        windows = self.search.windows
        size = len(self.x) + 1
        core, whole = (np.zeros((windows.shape[0], size, size)) for _ in range(2))
        for b, full in self.columns.items():
            share = self._noise_share(b)
            for out, weights in ((core, cores(windows)), (whole, windows)):
                for k, (first, end) in enumerate(pairwise(weights.indptr.tolist())):
                    rows, weight = weights.indices[first:end], weights.data[first:end]
                    out[k] += (full[rows] * weight[:, None]).T @ full[rows]
                    out[k] -= self.added[b] * float(weight @ share[rows])
        return core, whole

    @property
    def away(self) -> FloatArray:
        """How far each parameter is from the reference, (p,)."""
        return self.x - self.search.start

    @staticmethod
    def _normal(total: FloatArray, noise: FloatArray, free: Sequence[int]) -> FloatArray:
        """Normal matrix of what is free without what noise adds to it, (free, free)."""
        raw, added = (x[np.ix_(free, free)] for x in (total, noise))
        size = np.sqrt(np.maximum(np.diag(raw), 1e-300))
        unit = np.outer(size, size)
        return np.asarray(whole_without(raw / unit, added / unit) * unit)

    @classmethod
    def _step(cls, total: FloatArray, noise: FloatArray, free: Sequence[int]) -> FloatArray:
        """Step to the minimum of rows with these normal equations and this noise in them, the
        others held; (p,).
        """
        step = np.zeros(len(total) - 1)
        if len(free):
            score = (total - noise)[list(free), -1]
            step[list(free)] = -inverse(cls._normal(total, noise, free)) @ score
        return step

    @cached_property
    def _total(self) -> tuple[FloatArray, FloatArray]:
        """Normal equations over all rows of all balances, and the noise in them."""
        full = np.concatenate(list(self.columns.values()))
        return full.T @ full, np.asarray(np.sum(list(self.added.values()), axis=0))

    @cached_property
    def _crossed(self) -> FloatArray:
        """Products of the columns with those of the healthy rows on the same motion, (p, p): what
        the calibration of these took is their own.
        """
        alike, form = self.search.alike, self.search.form
        out = np.zeros((len(self.x), len(self.x)))
        if alike is None:
            return out
        for b, full in self.columns.items():
            out += full[:, :-1].T @ (alike.columns[b] * np.asarray(form.weights[b])[:, None])
        return np.where(np.isfinite(self.search.spread), out, 0.0)

    def squares(self, moved: Sequence[int]) -> FloatArray:
        """Sum of squares of each block and balance under the step that the other folds give,
        (blocks, balances).
        """
        free = self.search.free(moved)
        total, noise = self.grams.sum(axis=(0, 1)), self.noise.sum(axis=(0, 1))
        count = len(self.grams)
        folds = min(FOLDS, count)
        out = np.zeros(self.grams.shape[:2])
        for k in range(folds):
            test = np.arange(count) % folds == k
            seen = total - self.grams[test].sum(axis=(0, 1))
            added = noise - self.noise[test].sum(axis=(0, 1))
            whole = np.append(self._step(seen, added, free), 1.0)
            out[test] = np.einsum("i,bkij,j->bk", whole, (self.grams - self.noise)[test], whole)
        return out

    @cached_property
    def own(self) -> FloatArray:
        """Sum of squares of each block and balance, not seen by the fit."""
        return self.squares(self.moved)

    @property
    def score(self) -> float:
        """Log-likelihood on blocks not seen [nats], rows counted as independent ones."""
        return -float(np.sum(self._counts / 2 * np.log(np.maximum(self.own.sum(axis=0), 1e-300))))

    @property
    def _counts(self) -> FloatArray:
        """Independent rows of each balance, of those that belong to a block."""
        inside = self.block >= 0
        train, weights = self.search.data.train, self.search.form.weights
        rows = [
            float(np.sum(taking_part(b, train) & inside & (np.asarray(weights[b]) > 0)))
            for b in self.columns
        ]
        return np.array(rows) * self.search.shares

    def gain(self, group: Sequence[int]) -> _Gain:
        """What letting a group go brings."""
        moved = tuple(sorted({*self.moved, *group}))
        after = self.squares(moved)
        before, left = self.own.sum(axis=0), np.maximum(after.sum(axis=0), 1e-300)
        counts = self._counts
        variance = left / np.maximum(counts, 1.0)
        block = ((self.own - after) / (2 * variance)).sum(axis=1)
        nats = float(np.sum(counts / 2 * np.log(np.maximum(before, 1e-300) / left)))
        fall = 100 * (1 - float(np.sqrt(np.min(left / np.maximum(before, 1e-300)))))
        errors, sizes = self.errors(moved), self.sizes(moved)
        new = [i for i in group if i not in self.moved]
        p = min(_two_sided(sizes[i] / errors[i]) for i in new) if new else 1.0
        beyond = bool(np.any(before - after.sum(axis=0) > self.search.inexact))
        beyond &= not new or any(abs(sizes[i]) >= self.search.usual[i] for i in new)
        return _Gain(nats, block, fall, beyond, p)

    def least(self, place: int) -> float:
        """Smallest change of a parameter that would be named beside those that moved, either way
        (see :class:`_Gain`): certain among all that are tried, with a fall of the RMS on what is
        left, and more squares than the model's own error.
        """
        moved = tuple(sorted({*self.moved, place}))
        free = self.search.free(moved)
        count = max(int(np.sum(self.search.shown)), 1)
        sure = -NormalDist().inv_cdf(FALSE_DISCOVERY / count / 2) * self.errors(moved)[place]
        per = self._per_square(place, free)
        left = np.maximum(self.own.sum(axis=0), 1e-300)
        fall = (1 - LEAST_FALL / 100) ** -2 - 1
        nats = float(np.sum(per * self._counts / left)) / 2
        shows = per > 0.0
        if not shows.any():
            return math.inf
        beyond, falls = (
            math.sqrt(float(np.min(most[shows] / per[shows])))
            for most in (self.search.inexact, fall * left)
        )
        usual = float(self.search.usual[place])
        return float(max(sure, beyond, falls, usual, math.sqrt(GAIN / nats)))

    def _per_square(self, place: int, free: Sequence[int]) -> FloatArray:
        """Squares in each balance that a change of one unit makes, after all else that is free has
        followed it, (balances,).
        """
        others = [i for i in free if i != place]
        total, noise = self._total
        whole = np.zeros(len(self.x))
        whole[place] = 1.0
        if others:
            crossed = (total - noise)[np.ix_(others, [place])][:, 0]
            whole[others] = -inverse(self._normal(total, noise, others)) @ crossed
        squares = (self.grams - self.noise).sum(axis=0)[:, :-1, :-1]  # rows that gains are told by
        made: FloatArray = np.einsum("i,bij,j->b", whole, squares, whole)
        return np.maximum(made, 0.0)

    def sizes(self, moved: Sequence[int]) -> FloatArray:
        """Change of each parameter with those of `moved` let go, (p,)."""
        return self.away + self._step(*self._total, self.search.free(moved))

    def free_errors(self, moved: Sequence[int], turned: FloatArray | None = None) -> FloatArray:
        """Standard errors of the changes of all that is free, in their order (see
        :meth:`_Search.free`).

        Three parts: the scatter between windows of time; the standard error of the reference value;
        and those of the values that are held, as far as an error there would have moved this one.
        The last two belong together: a friction that the reference's fit took for viscous was
        missing in its dry one, and on a motion alike both errors cancel.  In other coordinates,
        x = `turned` @ new, where these are given.
        """
        free = self.search.free(moved)
        if not free:
            return np.zeros(0)
        errors = self.search.held_errors
        held = [i for i in range(len(self.x)) if i not in free and np.isfinite(errors[i])]
        total, noise = self._total
        step = self._step(total, noise, free)
        core, whole = self._by_window
        scores = (whole[:, :-1, -1] + whole[:, :-1, :-1] @ step)[:, free]
        grams = core[:, :-1, :-1]
        normal = self._normal(total, noise, free)
        known = [*free, *held]
        pulled = inverse(normal) @ (total - noise)[np.ix_(free, held)]
        moves = np.hstack([np.eye(len(free)), pulled])
        if self.search.alike is not None:
            # an error of the reference is in the rows of the healthy records, too
            moves -= inverse(normal) @ self._crossed[np.ix_(free, known)]
        reference = moves * errors[known]
        tied = self.search.tied[np.ix_(known, known)]
        grams = grams[:, free][:, :, free]
        if turned is not None:
            back = np.linalg.inv(turned)
            grams, scores = np.einsum("ia,bij,jc->bac", turned, grams, turned), scores @ turned
            reference, normal = back @ reference, turned.T @ normal @ turned
        windows = errors_of_windows(grams, scores, normal, self.search.independent)
        found = np.zeros(len(free)) if windows is None else windows
        before = np.maximum(np.einsum("ia,ab,ib->i", reference, tied, reference), 0.0)
        return np.asarray(np.sqrt(found**2 + before))

    def errors(self, moved: Sequence[int]) -> FloatArray:
        """Standard errors of the changes by place, (p,); infinite for what is held."""
        out = np.full(len(self.x), np.inf)
        out[self.search.free(moved)] = self.free_errors(moved)
        return out


def _two_sided(z: float) -> float:
    """Chance of so many standard errors either way."""
    return math.erfc(abs(z) / math.sqrt(2.0))


def discovery_rates(p_values: Sequence[float]) -> list[float]:
    """Benjamini-Hochberg rates of false discovery (q) of p-values, in their order."""
    order = np.argsort(p_values)
    out = np.ones(len(p_values))
    least = 1.0
    for rank in range(len(order), 0, -1):
        place = order[rank - 1]
        least = min(least, p_values[place] * len(order) / rank)
        out[place] = least
    return [float(q) for q in out]


def _result(search: _Search, point: _Point, records: tuple[str, ...]) -> Changes:
    """Sizes, bands, rates, sets and the payload of a selection."""
    names, parameters = search.names, {p.name: p for p in search.model.parameters}
    tested = [int(i) for i in np.flatnonzero(search.shown)]
    errors = point.errors(point.moved)
    p_values = []
    for i in tested:
        moved = tuple(sorted({*point.moved, i}))
        here = (
            (errors, point.away) if i in point.moved else (point.errors(moved), point.sizes(moved))
        )
        p_values.append(_two_sided(here[1][i] / here[0][i]))
    rates = dict(zip(tested, discovery_rates(p_values), strict=True))
    found = []
    for i in point.moved:
        less = search.fitted(tuple(j for j in point.moved if j != i), point.x)
        gain = less.gain((i,))
        found.append(
            (
                gain.nats,
                Change(
                    names[i],
                    float(search.start[i]),
                    after=float(point.x[i]),
                    stderr=float(errors[i]),
                    unit=parameters[names[i]].unit,
                    q=rates[i],
                    tied=_tied(search, less, i, gain),
                    drop_percent=gain.fall_percent,
                ),
            )
        )
    changes = tuple(c for _, c in sorted(found, key=lambda f: -f[0]))
    values = dict(zip(names, map(float, point.x), strict=True))
    payload, note = _payload(search, point)
    data = search.data
    model = search.model.with_values(values)
    still = {names[i] for i in tested} - {names[i] for i in point.moved}
    least = {names[i]: point.least(i) for i in tested if names[i] in still}
    reference = [
        n
        for n in names
        if n in search.reference.fitted and n != HOLD_NAME and parameters[n].role != "smoothing"
    ]
    return Changes(
        search.reference,
        model,
        changes=changes,
        payload=payload,
        unchanged=tuple(n for n in reference if n in still),
        untestable=tuple(n for n in reference if not search.shown[names.index(n)]),
        before=assess(
            search.model, data, data.train, dict(zip(names, map(float, search.start), strict=True))
        ),
        after=assess(model, data, data.train, values),
        refitted=search.refitted,
        records=records,
        payload_note=note,
        minor=_minor(search, point, rates),
        least={n: v for n, v in least.items() if math.isfinite(v)},
        alike=search.alike.records if search.alike is not None else (),
    )


def _minor(search: _Search, point: _Point, rates: Mapping[int, float]) -> tuple[Change, ...]:
    """What would be let go next if it were larger than the model's own error."""
    trials = [(t, g[0]) for g, t in search.trials(point).items() if len(g) == 1 and t.certain]
    if not trials:
        return ()
    gain, i = max(trials, key=lambda t: t[0].nats)
    moved = (*point.moved, i)
    unit = search.model.parameters[i].unit
    after = float(search.start[i] + point.sizes(moved)[i])
    tied = _tied(search, point, i, gain)
    return (
        Change(
            search.names[i],
            float(search.start[i]),
            after=after,
            stderr=float(point.errors(moved)[i]),
            unit=unit,
            q=rates[i],
            tied=tied,
            drop_percent=gain.fall_percent,
        ),
    )


def _tied(search: _Search, less: _Point, i: int, gain: _Gain) -> tuple[str, ...]:
    """Parameters that explain the records as well as this one in its place."""
    out = []
    for j in map(int, np.flatnonzero(search.shown)):
        if j == i or j in less.moved:
            continue
        other = less.gain((j,))
        difference = gain.block - other.block
        spread = float(np.std(difference, ddof=1)) * math.sqrt(len(difference))
        lost = float(difference.sum())
        near = other.nats >= (1 - TIED) * gain.nats
        if near or (lost <= CERTAIN * spread and other.nats >= LEAST_SHARE * gain.nats):
            out.append((other.nats, search.names[j]))
    return tuple(n for _, n in sorted(out, reverse=True)[: LARGEST_SET - 1])


def _payload(search: _Search, point: _Point) -> tuple[Payload | None, str]:
    """Mass and distance from the changes of inertia and of gravity torque: dJ = m r^2, dT = m g
    r.
    """
    inertia = [i for i in search.inertia if i in point.moved]
    gravity = [i for i in search.gravity if i in point.moved]
    errors = point.errors(point.moved)
    if search.model.kind == "linear":
        return (
            (Payload(float(point.away[inertia[0]]), float(errors[inertia[0]]), None, None), "")
            if inertia
            else (None, "")
        )
    if not gravity:
        return None, ""
    torque = float(np.linalg.norm(point.away[gravity]))
    moment = torque / STANDARD_GRAVITY
    if not inertia:
        return (
            None,
            f"mass times distance changed by {moment:.3g} kg.m; the change of inertia is too "
            "small to tell them apart",
        )
    added = float(point.away[inertia[0]])
    mass, distance = moment**2 / added, added / moment
    slopes = np.zeros((2, len(point.x)))
    along = point.away[gravity] / torque
    slopes[0, inertia[0]], slopes[1, inertia[0]] = -mass / added, 1 / moment
    slopes[0, gravity] = 2 * moment / added / STANDARD_GRAVITY * along
    slopes[1, gravity] = -distance / torque * along
    spread = [_functional_error(point, row, inertia[0]) for row in slopes]
    return Payload(mass, spread[0], abs(distance), spread[1]), ""


def _functional_error(point: _Point, slopes: FloatArray, place: int) -> float:
    """Standard error of a linear function of the changes: the same covariance in coordinates of
    which it is one.
    """
    free = point.search.free(point.moved)
    turned = np.eye(len(free))
    own = free.index(place)
    turned[own] = -slopes[free] / slopes[place]
    turned[own, own] = 1 / slopes[place]
    return float(point.free_errors(point.moved, turned)[own])
