"""Which number of a fit to trust: interval, windows, what it trades with, what it does to the
prediction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.parameter import Parameter
from identification.balance.balances import balances_of
from identification.balance.calibration import bare, nuisances
from identification.balance.dataset import Dataset
from identification.balance.stacked import references, taking_part
from identification.balance.weak import INDEPENDENT_SHARE
from identification.data.formats import number, words
from identification.data.joint_file import Correlation, Joint, Standing
from identification.errors import InputError
from identification.fitting.assess import RATIO_LIMIT, BalanceError
from identification.fitting.covariance import NORMAL, correlations
from identification.fitting.engine import Solution
from identification.fitting.errors_in_variables.instruments import instruments_of
from identification.fitting.errors_in_variables.products import noise_products
from identification.fitting.information import eliminated, form_of, white_errors
from identification.fitting.joint_text import standing_of
from identification.fitting.start_values import bounds_of
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]

KNOWN: Final = 0.1
"""Standard error over value up to which a parameter stands by itself, as in `irj plan`."""
TIED: Final = 0.8
"""Correlation from which two parameters are told together: one explains 64 % of the other's
variance."""
WORTH_SAYING: Final = 0.5
"""Correlation from which a partner is named at all: a quarter of the variance."""
APART: Final = 3.0
"""Standard errors of their difference from which the value of one record is another one than that
of all: one in 370 by chance, and a fit of ten parameters to two records has twenty."""
WINDOWS: Final = 4
"""Windows of equal time over all training rows."""
PROFILE_STEPS: Final = 4
"""Refits on each side of a shape: its interval is wanted to some percent of its width."""
NEAR_END: Final = 0.03
"""Relative distance of a refit from the end of the interval at which it is the end: those percent.
"""
REFITS: Final = 4
"""Gauss-Newton steps of the others in such a refit."""
DIGITS: Final = 5
"""Of a printed value at least: more than any wide interval needs."""
MOST_DIGITS: Final = 12
"""The same at most: beyond them stands rounding."""
MARKS: Final = {
    "*": "outside the interval, within the error of that record alone",
    "!": "another value than that of all records, by more than noise explains",
}
"""What stands behind the value of a record outside the interval, and what it means."""
CLASSES: Final = ("inertia", "stiffness", "friction", "shape", "other")


@final
@dataclass(frozen=True)
class Trusted:
    """What is known about one parameter.

    Attributes
    ----------
    name, unit, kind : str
        `kind` is one of `CLASSES`.
    value : float
    stderr : float or None
        As the fit states it, from windows of time.
    low, high : float or None
        95 % interval, from that error; for shapes from a profile.
    records, windows : tuple of (float or None)
        Value on each training record and in each of `WINDOWS` windows, where these tell it.
    apart : tuple of int
        Numbers of the records, from 0, whose value differs from that of all by more than noise
        explains.
    partner : str or None
        The parameter it trades with.
    trade : str
        How, in words; empty without a partner.
    prediction_percent : float or None
        Change of the predicted torque over half the interval, in percent of the measured one, all
        others adapted; None without records.
    verdict : {"trust", "only in combination", "not"}
    why : str
    """

    name: str
    unit: str
    kind: str
    value: float
    stderr: float | None
    low: float | None
    high: float | None
    records: tuple[float | None, ...]
    windows: tuple[float | None, ...]
    partner: str | None
    trade: str
    prediction_percent: float | None
    verdict: str
    why: str
    apart: tuple[int, ...] = ()

    @property
    def outside(self) -> tuple[int, ...]:
        """Numbers of the records whose value lies outside the interval."""
        if self.low is None or self.high is None:
            return ()
        low, high = self.low, self.high
        return tuple(
            k for k, v in enumerate(self.records) if v is not None and not low <= v <= high
        )

    def mark(self, record: int) -> str:
        """What stands behind the value of a record: a key of :data:`MARKS`, or nothing."""
        return "!" if record in self.apart else "*" if record in self.outside else ""

    @property
    def parts(self) -> str:
        """Value by record and by window and the effect on the prediction, in a line; empty where
        the records are not there. A value outside the interval has one of `MARKS`.
        """
        if not self.records:
            return ""
        told = [_value(v, self.digits) + self.mark(k) for k, v in enumerate(self.records)]
        windows = [_value(v, self.digits) for v in self.windows]
        moves = self.prediction_percent
        return f"by record {', '.join(told)}; by window {', '.join(windows)}" + (
            f"; moves the prediction by {moves:.2g} %" if moves is not None else ""
        )

    @property
    def digits(self) -> int:
        """Significant digits that tell the two ends of the interval apart."""
        if self.low is None or self.high is None:
            return DIGITS
        size, half = max(abs(self.low), abs(self.high)), (self.high - self.low) / 2
        if not 0 < half < size < math.inf:
            return DIGITS
        return min(max(DIGITS, math.ceil(math.log10(size / half)) + 1), MOST_DIGITS)

    def as_json(self) -> dict[str, Any]:
        """The shape of `trust --json`."""
        return {
            "name": self.name,
            "unit": self.unit,
            "class": self.kind,
            "value": self.value,
            "stderr": self.stderr,
            "interval": None if self.low is None or self.high is None else [self.low, self.high],
            "by_record": list(self.records),
            "by_window": list(self.windows),
            "trades_with": self.partner,
            "trade": self.trade,
            "prediction_percent": self.prediction_percent,
            "verdict": self.verdict,
            "why": self.why,
            "records_apart": list(self.apart),
        }


@final
@dataclass(frozen=True)
class Trust:
    """Every parameter of a fit, judged.

    Attributes
    ----------
    parameters : tuple of Trusted
    """

    parameters: tuple[Trusted, ...]

    def as_json(self) -> list[dict[str, Any]]:
        """The shape of `trust --json`."""
        return [p.as_json() for p in self.parameters]

    def __str__(self) -> str:
        lines = []
        for p in self.parameters:
            n = p.digits
            band = (
                f"{p.low:.{n}g} to {p.high:.{n}g}"
                if p.low is not None and p.high is not None
                else "no interval"
            )
            lines.append(
                f"{p.name:<28} {p.value:.{n}g} {p.unit} ({band}): {p.verdict}"
                + (f"; {p.why}" if p.why else "")
            )
            lines += [f"    {text}" for text in (p.parts, p.trade) if text]
        lines += [f"{mark} {said}" for mark, said in self.marks.items()]
        return "\n".join(lines)

    @property
    def marks(self) -> dict[str, str]:
        """Those of `MARKS` that a value by record has."""
        used = {p.mark(k) for p in self.parameters for k in range(len(p.records))}
        return {mark: said for mark, said in MARKS.items() if mark in used}

    def __repr__(self) -> str:
        trusted = sum(p.verdict == "trust" for p in self.parameters)
        return f"Trust({trusted} of {len(self.parameters)} parameters stand by themselves)"


def kind_of(model: JointModel, parameter: Parameter) -> str:
    """Class of a parameter (one of `CLASSES`), from its declaration."""
    if parameter.name in model.inertias:
        return "inertia"
    if parameter.name == model.stiffness_name:
        return "stiffness"
    if parameter.is_shape:
        return "shape"
    friction = any(parameter.name in t.names and t.effect.family == "friction" for t in model.terms)
    return "friction" if friction else "other"


def trust(
    solution: Solution,
    data: Dataset,
    *,
    profiles: bool = True,
    left: Mapping[str, BalanceError] | None = None,
) -> Trust:
    """Judge every free parameter of a fit.

    Parameters
    ----------
    solution : Solution
    data : Dataset
        The records of the fit.
    profiles : bool
        Intervals of shapes from refits on either side; without, from standard errors.
    left : mapping of str to BalanceError, optional
        What is left of the training records, as the verdict counts it; by default as a fit does.
        A value that rests on a balance over `RATIO_LIMIT` is none to trust.
    """
    if set(solution.free) <= set(solution.at_bound):  # all is known: no value was found here
        return Trust(())
    found = _Judge(solution, data).all(profiles=profiles)
    return _doubted(found, standing_of(solution, data, left))


@final
class _Judge:
    """Rows, information and covariance of one fit."""

    def __init__(self, solution: Solution, data: Dataset) -> None:
        self.solution, self.data = solution, data
        self.model = solution.model
        self.moving = tuple(n for n in solution.free if n not in solution.at_bound)
        self.form = form_of(solution, data, self.moving, solution.weights)
        x = np.array([self.form.values[n] for n in self.form.free])
        stacked = self.form.stacked(x)
        names = self.form.balances.balances
        weights = solution.weights
        turns = self.form.turns
        self.j = turns.without(
            np.concatenate([stacked.jacobian[b] * weights[b][:, None] for b in names])
        )
        self.r = turns.without(np.concatenate([stacked.residual[b] * weights[b] for b in names]))
        self.plain = np.concatenate([stacked.jacobian[b] for b in names])
        self.block = np.tile(stacked.block, len(names))
        self.record = np.tile(
            np.repeat(np.arange(len(data.train)), [w.rows for w in data.train]), len(names)
        )
        self.measured = float(
            np.linalg.norm(np.concatenate(list(references(data, data.train).values())))
        )
        count = len(self.moving)
        self.noise, self.by = None, self.j
        if solution.noise_off or solution.met:
            self.noise = noise_products(self.form, solution.met)
        if solution.met:
            beside = instruments_of(self.form, solution.met)
            own = np.concatenate([stacked.jacobian[b] * weights[b][:, None] for b in names])
            self.by = turns.without(beside.beside(own, self.form))
        power = {b: weights[b] ** 2 * taking_part(b, data.train) for b in names}
        self.power = np.concatenate([p / max(float(p.sum()), 1e-300) for p in power.values()])
        gram, self.step = self._step(np.ones(len(self.r), dtype=np.bool_))
        self.gram = eliminated(gram, count)
        self.white = white_errors(self.gram)
        self.together = solution.together
        if not self.together.names:  # too few windows for errors: the file says none of them either
            spread = correlations(self.gram)[1]
            sizes = np.where(np.isfinite(self.white), self.white, 0.0)
            self.together = Correlation.of(self.moving, spread, sizes)
        self.nuisance = nuisances(self.model)
        self.limits = bounds_of(self.model, data.joint.known, data)

    def all(self, *, profiles: bool) -> Trust:
        """Every free parameter that is no nuisance."""
        by_record = [self._on(self.record == k) for k in range(len(self.data.train))]
        parts = self._windows()
        by_window = [self._on(parts == k) for k in range(WINDOWS)]
        out = []
        for p in self.model.parameters:
            if p.name in self.nuisance or p.name not in self.solution.free:
                continue
            out.append(self._judged(p, by_record, by_window, profiles=profiles))
        return Trust(tuple(out))

    def _windows(self) -> npt.NDArray[np.int64]:
        """Number of the window of each row, -1 for rows of no block."""
        last = max(int(self.block.max(initial=0)) + 1, 1)
        return np.where(self.block >= 0, self.block * WINDOWS // last, -1)

    def _on(self, rows: npt.NDArray[np.bool_]) -> dict[str, tuple[float, float] | None]:
        """Values that some of the rows alone give, one Gauss-Newton step, and their errors if the
        noise were white; None where these do not tell a parameter to `KNOWN`.

        What is known beforehand of the sensors is in no row: a step of all rows is taken off.
        """
        gram, step = self._step(rows)
        step = step - self.step
        errors = white_errors(eliminated(gram, len(self.moving)))
        out: dict[str, tuple[float, float] | None] = {}
        for k, n in enumerate(self.moving):
            value = self.solution.values[n]
            known = math.isfinite(errors[k]) and errors[k] < KNOWN * abs(value)
            out[n] = (value + float(step[k]), float(errors[k])) if known else None
        return out

    def _step(self, rows: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Normal matrix of some of the rows, and the step that they ask for."""
        j, r = self.j[rows], self.r[rows]
        gram, score = j.T @ j, j.T @ r
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        scaled = gram / np.outer(size, size)
        if self.noise is not None:  # what noise adds to the products falls to rows by their weights
            by = self.by[rows]
            power = np.split(self.power * rows, len(self.noise.gram))
            share = [float(x.sum()) for x in power]
            parts = [*zip(share, self.noise.gram.values(), self.noise.score.values(), strict=True)]
            score = by.T @ r - np.sum([s * x for s, _, x in parts], axis=0)
            added = np.sum([s * g for s, g, _ in parts], axis=0)
            seen = np.diag(gram) > 0  # no unknown of another run
            score = np.where(seen, score, 0.0)
            scaled = np.where(np.outer(seen, seen), by.T @ j - added, 0.0) / np.outer(size, size)
        back = np.linalg.pinv(scaled, rcond=1e-9)
        return gram, -back @ (score / size) / size

    def _apart(
        self, k: int, wider: float, by_record: Sequence[Mapping[str, tuple[float, float] | None]]
    ) -> tuple[int, ...]:
        """Records whose value is another one than that of all.

        All rows hold those of the record: the variance of the difference is the record's less that
        of all (Hausman 1978, Econometrica 46:1251), widened as the stated error is.
        """
        name, out = self.moving[k], []
        for number_, found in enumerate(by_record):
            told = found[name]
            if told is None:
                continue
            value, own = told
            size = wider * math.sqrt(max(own**2 - float(self.white[k]) ** 2, 0.0))
            if len(by_record) > 1 and abs(value - self.solution.values[name]) > APART * size > 0:
                out.append(number_)
        return tuple(out)

    def _judged(
        self,
        p: Parameter,
        by_record: Sequence[Mapping[str, tuple[float, float] | None]],
        by_window: Sequence[Mapping[str, tuple[float, float] | None]],
        *,
        profiles: bool,
    ) -> Trusted:
        value = float(self.solution.values[p.name])
        bare_one = _unknown(p, self.model, value)
        if p.name not in self.moving:
            return replace(bare_one, why="at its bound")
        k = self.moving.index(p.name)
        from_windows = self.solution.stderr.get(p.name)
        white = float(self.white[k])
        if not math.isfinite(white):
            return replace(bare_one, why="flat: no value of it is worse than another")
        error = white if from_windows is None else from_windows
        low, high = value - NORMAL * error, value + NORMAL * error
        if p.is_shape and profiles and error < abs(value):
            low, high = self._profiled(p.name, error, error / white)
        bound = self.limits[p.name]
        low, high = max(low, bound[0]), min(high, bound[1])
        partner, rho = self._partner(k)
        share = error / abs(value) if value else math.inf
        verdict, why = self._verdict(p, value, share, rho)
        return replace(
            bare_one,
            stderr=error,
            low=low,
            high=high,
            records=tuple(told[0] if (told := v[p.name]) else None for v in by_record),
            windows=tuple(told[0] if (told := v[p.name]) else None for v in by_window),
            apart=self._apart(k, error / white, by_record),
            partner=partner,
            trade=self._trade(p.name, partner, error, rho) if partner else "",
            prediction_percent=self._prediction(k, NORMAL * error),
            verdict=verdict,
            why=why,
        )

    def _partner(self, k: int) -> tuple[str | None, float]:
        """The parameter with the largest correlation, and that correlation."""
        own = self.moving[k]
        names = [n for n in self.moving if n not in self.nuisance and n != own]
        beside = self.together.matrix([own, *names])[0, 1:]
        return _partner_of(dict(zip(names, beside.tolist(), strict=True)))

    def _trade(self, name: str, partner: str, error: float, rho: float) -> str:
        """One standard error up, and what its partner does then."""
        moves = self.together.moves(name, partner, error, {})
        values = self.solution.values
        return _traded((name, values[name], error), (partner, values[partner], moves), rho)

    def _prediction(self, k: int, shift: float) -> float:
        """Change of the prediction where one parameter moves and all others adapt."""
        gram = self.j.T @ self.j
        others = [i for i in range(gram.shape[0]) if i != k]
        size = np.sqrt(np.maximum(np.diag(gram)[others], 1e-300))
        inside = gram[np.ix_(others, others)] / np.outer(size, size)
        follow = -np.linalg.pinv(inside, rcond=1e-12, hermitian=True) @ (gram[others, k] / size)
        direction = np.zeros(gram.shape[0])
        direction[k] = 1.0
        direction[others] = follow / size
        moved = self.plain @ (direction * shift)
        return 100 * float(np.linalg.norm(moved)) / max(self.measured, 1e-300)

    def _verdict(self, p: Parameter, value: float, share: float, rho: float) -> tuple[str, str]:
        if p.is_shape and p.scale != "absolute":
            low, high = (g * self.data.ranges[p.scale] for g in (p.grid[0], p.grid[-1]))
            if not low / 2 <= value <= 2 * high:
                return "not", f"extrapolated: the motion's {p.scale} does not reach it"
        return _by_error(share, rho, identified=p.name not in self.solution.unidentified)

    def _profiled(self, name: str, error: float, wider: float) -> tuple[float, float]:
        """Ends of the 95 % interval by refits of all others: where the sum of squares, in units of
        its scatter over blocks, has risen by the square of the normal bound."""
        value = float(self.solution.values[name])
        zero = self._refitted(name, value)
        ends = []
        for sign in (-1.0, 1.0):
            # a shape is a scale: on a logarithm its profile is nearly a parabola
            reach = NORMAL * error / abs(value)
            inside, outside = 0.0, math.inf
            for _ in range(PROFILE_STEPS):
                at = value * math.exp(sign * reach)
                low, high = self.limits[name]
                clipped = min(max(at, low), high)
                rise = INDEPENDENT_SHARE * (self._refitted(name, clipped) - zero)
                root = math.sqrt(max(rise, 0.0)) / max(wider, 1e-300)
                if root >= NORMAL:
                    outside = min(outside, reach)
                else:
                    inside = max(inside, reach)
                if clipped != at and root < NORMAL:
                    break
                guess = reach * NORMAL / root if root > 0 else 2 * reach
                if math.isfinite(outside):
                    middle = (inside + outside) / 2
                    reach = guess if inside < guess < outside else middle
                else:
                    reach = min(max(guess, 1.2 * reach), 3 * reach)
                if abs(root / NORMAL - 1) < NEAR_END:
                    break
            ends.append(value * math.exp(sign * reach))
        return ends[0], ends[1]

    def _refitted(self, name: str, value: float) -> float:
        """Weighted sum of squares with one parameter held and all others fitted."""
        free = tuple(n for n in self.form.free if n != name)
        form = WeakForm(
            balances_of(self.model, self.data.sensing, wrt=bare(free)),
            self.data,
            {**self.form.values, name: value},
            free,
            self.solution.weights,
        )
        fitted, _ = form.fitted(self.limits, REFITS)
        left = form.residual(np.array([fitted[n] for n in free]))
        return float(left @ left)


def trusted_file(joint: Joint) -> Trust:
    """Judge every fitted value of a joint file by what stands in the file: its standard errors and
    how they go together. Windows, profiles and the prediction need the records.

    Parameters
    ----------
    joint : Joint

    Raises
    ------
    InputError
        A file without fitted values that have standard errors.
    """
    model = joint.model()
    if not joint.errors:
        raise InputError(
            f"{joint.source or joint.name}: has no fitted values with standard errors; give the "
            "records too, or fit it first (irj fit -o)"
        )
    nuisance = nuisances(model)
    told = [p for p in model.parameters if p.name in joint.fitted and p.name not in nuisance]
    names = [p.name for p in told]
    together = joint.correlation.matrix(names)
    known = {p.name: p for p in told}
    out = []
    for k, p in enumerate(told):
        value, error = float(joint.fitted[p.name]), joint.errors.get(p.name)
        bare_one = replace(_unknown(p, model, value), prediction_percent=None)
        if error is None:
            out.append(replace(bare_one, why="the file has no standard error of it"))
            continue
        others = {n: float(together[k, i]) for i, n in enumerate(names) if i != k}
        partner, rho = _partner_of(others)
        share = error / abs(value) if value else math.inf
        verdict, why = _by_error(share, rho, identified=True)
        trade = ""
        if partner is not None:
            moves = joint.correlation.moves(p.name, partner, error, joint.errors)
            trade = _traded((p.name, value, error), (partner, joint.fitted[partner], moves), rho)
        low, high = known[p.name].low, known[p.name].high
        out.append(
            replace(
                bare_one,
                stderr=error,
                low=max(value - NORMAL * error, low),
                high=min(value + NORMAL * error, high),
                partner=partner,
                trade=trade,
                verdict=verdict,
                why=why,
            )
        )
    return _doubted(Trust(tuple(out)), joint.standing)


def _doubted(found: Trust, standing: Mapping[str, Standing]) -> Trust:
    """Values that rest on a balance far over its noise are none to trust, however narrow their
    intervals: these are intervals of this model, and say nothing of the law that it lacks.
    """
    over = {b: s for b, s in standing.items() if s.ratio > RATIO_LIMIT}
    out = []
    for p in found.parameters:
        sure = {b: number(s.ratio, 2) for b, s in over.items() if p.name in s.parameters}
        on = [f"{b} balance ({ratio}" for b, ratio in sure.items()]
        if on:
            said = f"the model lacks a law in the {' and the '.join(on)} times its noise floor)"
            p = replace(p, verdict="not", why=f"{p.why}; {said}" if p.why else said)
        out.append(p)
    return Trust(tuple(out))


def _value(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _partner_of(others: Mapping[str, float]) -> tuple[str | None, float]:
    """Of correlations with others the largest, with its name where it is worth saying."""
    if not others:
        return None, 0.0
    name = max(others, key=lambda n: abs(others[n]))
    rho = others[name]
    return (name, rho) if abs(rho) >= WORTH_SAYING else (None, rho)


def _traded(one: tuple[str, float, float], other: tuple[str, float, float], rho: float) -> str:
    """What a partner does where a parameter goes up by its standard error, in words; name, value
    and change of each.
    """
    (name, value, error), (partner, beside, moves) = one, other
    if not value or not beside:
        return f"{words(name)} trades with {words(partner)} (correlation {rho:.2f})"
    up = (moves > 0) == (beside > 0)
    return (
        f"{words(name)} goes up {100 * error / abs(value):.2g} % where {words(partner)} goes "
        f"{'up' if up else 'down'} {100 * abs(moves / beside):.2g} %"
    )


def _by_error(share: float, rho: float, *, identified: bool) -> tuple[str, str]:
    """Verdict and reason by standard error over value and the largest correlation."""
    if share * NORMAL >= 1:
        tied = "only in combination" if abs(rho) >= TIED else "not"
        return tied, "its interval contains zero"
    if not identified:
        return "only in combination", "not identifiable by itself"
    if share > KNOWN and abs(rho) >= TIED:
        return "only in combination", "known no better than to 10 % and tied to another"
    return "trust", ""


def _unknown(p: Parameter, model: JointModel, value: float) -> Trusted:
    """A parameter of which nothing is known but its value."""
    return Trusted(
        p.name,
        p.unit,
        kind_of(model, p),
        value,
        stderr=None,
        low=None,
        high=None,
        records=(),
        windows=(),
        partner=None,
        trade="",
        prediction_percent=0.0,
        verdict="not",
        why="",
    )


__all__ = ["CLASSES", "Trust", "Trusted", "kind_of", "trust", "trusted_file"]
