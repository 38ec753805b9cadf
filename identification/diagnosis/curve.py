"""Curve first: the missing torque of a balance as a free curve over one variable, before any name.

Each table of the effect library (:class:`casadi_models.table.Table`) is tried beside the fitted
base, whose own parameters stay free and unpenalised. A penalty on the second derivative keeps the
curve smooth; how smooth, and over which variable, is chosen by cross-validation over blocks of
time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, Effect
from casadi_models.effect import Place
from casadi_models.quantities import linear_unit
from casadi_models.signals import LocalSignals
from casadi_models.table import SHARP, SLOW
from casadi_models.term import Term
from identification.balance.balances import balances_of
from identification.balance.clocks import CREEP, FAST
from identification.balance.colour import ChannelNoise
from identification.balance.dataset import Dataset
from identification.balance.noise import effective_share
from identification.balance.stacked import TURN_WIDTHS, stack
from identification.balance.weak import WeakRecord
from identification.diagnosis.candidates import OBSERVED_BY, Candidate
from identification.diagnosis.places import student
from identification.diagnosis.trials import Base, columns, make_base, span_of
from identification.fitting.covariance import NORMAL

FloatArray = npt.NDArray[np.float64]

LEAST_FALL: Final = 0.02
"""Share by which a curve must lower the cross-validated squares: less is what the best of a dozen
variables reaches by chance on some joints where nothing is hidden."""
LEAST_T: Final = 3.0
"""Log-ratio of the cross-validated squares in units of its jackknife error: one in 700 by chance,
for each of a dozen variables."""
ALIKE: Final = 1.0
"""Standard errors by which a curve must be worse than the best to be out: a constant is a curve
over every variable, and belongs to the one over which it is the simplest."""
MOST_CURVES: Final = 3
"""Curves of one balance; a fourth says that the variable is not among those tried."""
SMOOTHNESS: Final = np.logspace(-10, 4, 29)
"""Weights of the penalty that are tried, in units of the information on the curve: from none to a
straight line."""
RIDGE: Final = 1e-9
"""Share of its own information by which each column is held, so that what the curve shares with the
base (a constant, a slope) has a solution."""
TINY: Final = 1e-200
"""Information on a number, of columns scaled to one, under which it has none."""
POINTS: Final = 61
"""Points at which a curve is given."""
INSIDE: Final = (0.005, 0.995)
"""Quantiles of the variable between which a curve is given: beyond, too few rows tell of it."""
ENDS: Final = (0.0005, 0.9995)
"""Quantiles of the variable at which the knots end, so that no outlier stretches them."""
RESOLUTION: Final = 1 / 384
"""Largest error of a cubic spline between even knots, in units of the fourth difference of the
curve (de Boor, A Practical Guide to Splines, ch. V)."""
CLEAR: Final = 4.0
"""Speed, in standard deviations of its noise, from which the direction of motion is beyond
doubt.
"""
ONE_TERM: Final[Mapping[str, Callable[[FloatArray, float], FloatArray]]] = {
    "power": lambda x, p: x**p,
    "tanh": lambda x, s: np.tanh(x / s),
    "rational": lambda x, s: x / (x + s),
    "exponential": lambda x, s: 1 - np.exp(-x / s),
    "knee": lambda x, s: np.maximum(x - s, 0.0),
}
"""Laws of a speed, 0 to 1 over its range, with one number of shape: what friction without a name
looks like."""
SHAPES: Final[Mapping[str, FloatArray]] = {
    "power": np.concatenate([np.linspace(0.05, 0.95, 19), np.linspace(1.05, 3.5, 26)]),
    "tanh": np.geomspace(0.02, 1.5, 24),
    "rational": np.geomspace(0.02, 1.5, 24),
    "exponential": np.geomspace(0.02, 1.5, 24),
    "knee": np.linspace(0.05, 0.9, 18),
}
"""Their shapes: steps of a fifth, or a twentieth of the range; from as steep as the densest knots
to nearly straight, which viscous friction is."""
WHOLE: Final = 0.999
"""Share of a row's kernel that must move clearly in one direction: beside a reversal the torque
hangs on where exactly friction changes its sign, which bends every curve over velocity."""


# --- what a table is, as numbers ------------------------------------------------------------------


def _law(effect: Effect, shapes: Mapping[str, float]) -> tuple[Any, Any, Any]:
    """Symbols of variable and controls, and the curve of a table with its range as numbers."""
    table = effect.table
    if table is None:
        raise ValueError(f"effect {effect.key!r} has no table")
    x, c = ca.SX.sym("x"), ca.SX.sym("c", len(table.controls))
    bound = {n: c[i] for i, n in enumerate(table.controls)} | dict(shapes)
    return x, c, table.value(x, SimpleNamespace(**bound))


def basis(effect: Effect, shapes: Mapping[str, float], x: FloatArray, order: int = 0) -> FloatArray:
    """Derivatives of a table's curve with respect to its control values.

    Parameters
    ----------
    effect : Effect
        With a table.
    shapes : mapping
        Range of the table, by the names of the effect's own parameters.
    x : (n,) array
        The variable; a speed where the table is over one.
    order : {0, 1, 2}
        Derivative with respect to the variable.

    Returns
    -------
    (n, controls) array
    """
    at, c, value = _law(effect, shapes)
    for _ in range(order):
        value = ca.jacobian(value, at)
    row = ca.Function("row", [at], [ca.densify(ca.jacobian(value, c))])
    return (
        np.array(row.map(len(x))(x[None, :])).reshape(len(x), -1)
        if len(x)
        else np.empty((0, c.shape[0]))
    )


def penalty(effect: Effect, shapes: Mapping[str, float]) -> FloatArray:
    """Integral of the squared second derivative over the range, per control values (k, k)."""
    low, high = _range(effect, shapes)
    steps = np.linspace(0.0, 1.0, 601)
    # squared steps toward a speed of zero, where the knots are dense
    x = low + (high - low) * (steps**3 if _table(effect).of_speed else steps)
    second = basis(effect, shapes, x, 2) * (high - low) ** 2
    weight = np.gradient(x) / (high - low)
    return np.asarray(second.T @ (second * weight[:, None]))


def _table(effect: Effect) -> Any:
    return effect.table


def _range(effect: Effect, shapes: Mapping[str, float]) -> tuple[float, float]:
    table = _table(effect)
    values = [shapes[n] for n in table.range_names]
    return (0.0, values[0]) if table.of_speed else (values[0] - values[1], values[0] + values[1])


# --- which rows tell of a curve -------------------------------------------------------------------


def _clear(
    w: WeakRecord, noise: Mapping[str, ChannelNoise], turning: Mapping[str, float]
) -> FloatArray:
    """Direction of motion at the points of a record: 1, -1, or 0 where it is not beyond doubt, or
    a side is slower than it turns.
    """
    out = np.ones(int(w.starts[-1]))
    for side in ("motor", "link"):
        source, name = f"{side}_position", f"{side}_velocity"
        if source not in noise or name not in w.points:
            continue
        v = w.points[name]
        doubtful = CLEAR * w.grid.velocity_noise(source, noise[source])
        clear = np.abs(v) > max(doubtful, turning.get(side, 0.0))
        out = np.where(clear & (out != 0), np.sign(v), 0.0)
    return out


def steadily_moving(base: Base, *, creeping: bool = True) -> Base:
    """The base on the rows in which no side turns or hardly moves, friction changing its sign at
    once.

    Parameters
    ----------
    base : Base
    creeping : bool
        Whether rows count in which a side is slower than it turns.

    Notes
    -----
    A smoothing velocity fitted to a wrong law is part of that law: here the curve has to show it.
    But a joint that creeps under it, as one that settles does, has friction of less than its level
    whatever the law: a name is not held against such rows, which a curve is drawn through.
    """
    model, data = base.solution.model, base.data
    sharp: dict[str, float] = {}
    turning: dict[str, float] = {}
    for side in ("motor", "link"):
        names = model.named("smoothing", side)
        own = any(t.effect.shapes_reversal and t.place == side for t in model.terms)
        speeds = _speeds(data, side)
        if names and not own and len(speeds):
            sharp |= dict.fromkeys(names, SHARP * float(np.quantile(speeds, ENDS[1])))
            if not creeping:
                width = TURN_WIDTHS * max(base.solution.values[n] for n in names)
                turning[side] = min(width, CREEP * float(np.quantile(speeds, FAST)))
    solution = replace(
        base.solution,
        values={**base.solution.values, **sharp},
        free=tuple(n for n in base.solution.free if n not in sharp),
    )
    moved = _refitted(make_base(solution, data))
    count = len(base.balances)
    clear = np.tile(_steady(data.train, data.sources, turning), count)
    held = np.tile(_steady(data.held_out, data.sources, turning), count)
    return replace(
        moved,
        block=np.where(clear, moved.block, -1),
        held_weight=moved.held_weight * held,
        held_residual=moved.held_residual * held,
        held_jacobian=moved.held_jacobian * held[:, None],
        held_inward=moved.held_inward * held[:, None],
    )


def _refitted(base: Base) -> Base:
    """The base with the values that belong to its residual, from which its own columns are
    taken out.
    """
    solution, data = base.solution, base.data
    rows = stack(
        balances_of(solution.model, data.sensing, wrt=()), data.train, solution.values
    ).residual
    raw = np.concatenate([rows[b] for b in base.balances]) * base.weight
    delta = np.linalg.lstsq(base.jacobian, base.residual - raw, rcond=None)[0]
    moved = {
        n: solution.values[n] + d
        for n, d in zip(base.names, (delta / base.norms).tolist(), strict=True)
    }
    return replace(
        base,
        solution=replace(solution, values={**solution.values, **moved}),
        held_residual=base.held_residual + base.held_jacobian @ delta,
        noise=None,
    )


def _speeds(data: Dataset, side: str) -> FloatArray:
    name = f"{side}_velocity"
    return np.concatenate(
        [np.abs(w.points[name]) for w in data.train if name in w.points] or [np.empty(0)]
    )


def _steady(
    records: Sequence[WeakRecord],
    noise: Mapping[str, ChannelNoise],
    turning: Mapping[str, float] | None = None,
) -> npt.NDArray[np.bool_]:
    """Rows whose whole kernel moves clearly in one direction, faster than each side turns."""
    parts = [np.abs(w.average(_clear(w, noise, turning or {}))) >= WHOLE for w in records]
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.bool_)


# --- which curves there are -----------------------------------------------------------------------


@final
@dataclass(frozen=True)
class _Tried:
    """A table on the rows of a base.

    Attributes
    ----------
    candidate : Candidate
    shapes : mapping
        Range of the table, by the effect's own names.
    added : (n, k) array
        Weighted columns of the control values.
    smooth : (k, k) array
        Penalty at weight 1.
    """

    candidate: Candidate
    shapes: Mapping[str, float]
    added: FloatArray
    smooth: FloatArray
    weight: float = 0.0

    @property
    def named(self) -> dict[str, float]:
        """The range under the names of the model."""
        term = self.term
        own = dict(zip((p.name for p in term.effect.parameters), term.names, strict=True))
        return {own[n]: v for n, v in self.shapes.items()}

    @property
    def term(self) -> Term:
        """The table in its place."""
        return next(t for t in self.candidate.model.terms if t.label == self.candidate.label)


def _candidates(base: Base, balance: str) -> list[Candidate]:
    """The tables that show in a balance and whose variable is recorded."""
    model, sensing = base.solution.model, base.data.sensing
    out = []
    for effect in EFFECTS.values():
        if effect.table is None or (effect.needs_load and not sensing.has_torque):
            continue
        if any(not model.has(n) for n in effect.needs):
            continue
        places = [p for p in effect.acts_on if balance in OBSERVED_BY[p].get(balance, ())]
        if len(places) > 1:  # one balance of both sides: they move as one, or nearly so
            places = places[:1]
        for place in places:
            if model.has(effect.key, place) or not _signal(effect, place, base.data.train):
                continue
            label = f"{effect.key}@{place}" if len(effect.acts_on) > 1 else effect.key
            bigger = model.add(label)
            term = next(t for t in bigger.terms if t.label == label)
            pairs = list(zip(term.names, effect.parameters, strict=True))
            amplitudes = tuple(n for n, p in pairs if not p.is_shape)
            shapes = tuple(n for n, p in pairs if p.is_shape)
            out.append(Candidate(label, effect, place, bigger, amplitudes, shapes))
    return out


def _signal(effect: Effect, place: Place, records: Sequence[WeakRecord]) -> tuple[FloatArray, ...]:
    """The variable of a table at the points of each record; empty where it is not recorded."""
    over = _table(effect).over
    out = []
    for w in records:
        if over == "torsion":
            if not {"motor_position", "link_position"} <= set(w.smooth):
                return ()
            out.append(w.smooth["motor_position"] - w.smooth["link_position"])
            continue
        name = "torque" if over == "load" else f"{place}_{over}"
        if name not in w.points:
            return ()
        out.append(np.abs(w.points[name]) if _table(effect).of_speed else w.points[name])
    return tuple(out)


def _tried(candidate: Candidate, base: Base, solver: _Evaluator) -> _Tried | None:
    effect = candidate.effect
    x = np.concatenate(_signal(effect, candidate.place, base.data.train))
    low, high = (float(v) for v in np.quantile(x, ENDS))
    if not high > low:
        return None
    ends = (high,) if _table(effect).of_speed else ((low + high) / 2, (high - low) / 2)
    shapes = dict(zip(_table(effect).range_names, ends, strict=True))
    made = _Tried(candidate, shapes, np.empty((0, 0)), penalty(effect, shapes))
    added = solver(made, base.data.train) * base.weight[:, None]
    if not np.all(np.isfinite(added)) or not np.any(added):
        return None
    return replace(made, added=added)


_Evaluator = Callable[[_Tried, Sequence[WeakRecord]], FloatArray]


def _unweighted(base: Base) -> _Evaluator:
    """Columns of a table on any records."""

    def evaluate(tried: _Tried, records: Sequence[WeakRecord]) -> FloatArray:
        candidate = tried.candidate
        rows = balances_of(
            candidate.model, base.data.sensing, wrt=candidate.amplitudes, columns_only=True
        )
        return columns(candidate, base, tried.named, records, rows)

    return evaluate


# --- penalised least squares ----------------------------------------------------------------------


@final
@dataclass(frozen=True)
class _System:
    """Normal equations of base and curves, block by block.

    Attributes
    ----------
    grams : (blocks, balances, q + 1, q + 1) array
        Products of the columns and, last, of the residual.
    smooth : (q, q) array
        Penalty, weights included.
    base : Base
    where : int
        Number of the balance that is judged.
    """

    grams: FloatArray
    smooth: FloatArray
    base: Base
    where: int

    @cached_property
    def blocks(self) -> FloatArray:
        """Products of each block over all balances."""
        return np.asarray(self.grams.sum(axis=1))

    @cached_property
    def total(self) -> FloatArray:
        """Products of all blocks."""
        return np.asarray(self.blocks.sum(axis=0))

    def solved(self, total: FloatArray) -> FloatArray:
        """Change of the parameters that lowers the squares most."""
        a, size = self._scaled(total)
        return np.asarray(np.linalg.solve(a, -total[:-1, -1] / size) / size)

    def inverse(self) -> FloatArray:
        """Inverse of the penalised normal matrix."""
        a, size = self._scaled(self.total)
        return np.asarray(np.linalg.inv(a) / np.outer(size, size))

    def freedom(self, last: int) -> float:
        """Effective number of parameters of the last columns."""
        return float(np.sum(np.diag(self.inverse() @ self.total[:-1, :-1])[-last:]))

    def _scaled(self, total: FloatArray) -> tuple[FloatArray, FloatArray]:
        a = total[:-1, :-1] + self.smooth
        # a column that shows on none of the rows has no size, and its number stays
        size = np.sqrt(np.where(np.diag(a) > TINY, np.diag(a), 1.0))
        return a / np.outer(size, size) + RIDGE * np.eye(len(a)), size

    @cached_property
    def crossed(self) -> FloatArray:
        """Squares left of each block of the judged balance, fitted without its fold; (blocks,)."""
        out = np.zeros(len(self.grams))
        for test in self.base.held_out_folds():
            alone = self.base.folds == 1
            left = self.total if alone else self.total - self.blocks[test].sum(axis=0)
            x = np.append(self.solved(left), 1.0)
            out[test] = np.einsum("bij,i,j->b", self.grams[test, self.where], x, x)
        return np.maximum(out, 0.0)


def _system(base: Base, curves: Sequence[_Tried], where: int) -> _System:
    whole = np.column_stack([base.jacobian, *(t.added for t in curves), base.residual])[base.order]
    p, q = base.jacobian.shape[1], whole.shape[1] - 1
    smooth = np.zeros((q, q))
    first = p
    for t in curves:
        k = t.added.shape[1]
        smooth[first : first + k, first : first + k] = t.weight * t.smooth
        first += k
    return _System(base.grouped(whole, whole), smooth, base, where)


def _smoothed(
    base: Base, chosen: Sequence[_Tried], new: _Tried, where: int
) -> tuple[_Tried, _System]:
    """The new curve with the smoothness that predicts best, and its system."""
    bare = _system(base, [*chosen, new], where)
    k = new.added.shape[1]
    unit = float(np.trace(bare.total[-1 - k : -1, -1 - k : -1])) / float(np.trace(new.smooth))
    best: tuple[float, _Tried, _System] | None = None
    for share in SMOOTHNESS:
        smooth = bare.smooth.copy()
        smooth[-k:, -k:] = share * unit * new.smooth
        system = replace(bare, smooth=smooth)
        left = float(system.crossed.sum())
        if best is None or left < best[0]:
            best = (left, replace(new, weight=float(share * unit)), system)
    assert best is not None
    return best[1], best[2]


@final
@dataclass(frozen=True)
class Gain:
    """What a model leaves less than another, on blocks that neither was fitted to.

    Attributes
    ----------
    fall : float
        Share by which the squares fall.
    t : float
        Log-ratio of the squares in units of its delete-one-block jackknife error.
    """

    fall: float
    t: float

    @property
    def is_certain(self) -> bool:
        """True where both are large enough."""
        return self.fall >= LEAST_FALL and self.t >= LEAST_T


def gain(before: FloatArray, after: FloatArray) -> Gain:
    """Fall of cross-validated squares.

    Parameters
    ----------
    before, after : (blocks,) array
        Squares left of each block. A paired test of the differences has no power where only some
        blocks show the law: the jackknife of the log-ratio is used.
    """
    a, b = float(before.sum()), float(after.sum())
    if a <= 0 or b <= 0 or len(before) < 2:
        return Gain(0.0, 0.0)
    without = np.log(np.maximum(a - before, 1e-300) / np.maximum(b - after, 1e-300))
    count = len(before)
    error = math.sqrt((count - 1) / count * float(np.sum((without - without.mean()) ** 2)))
    return Gain(1 - b / a, math.log(a / b) / error if error > 0 else 0.0)


# --- the result -----------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Curve:
    """A torque as a free curve over one variable, with a pointwise 95 % band.

    Attributes
    ----------
    label : str
        Label of the learned effect in a model.
    balance, axis, unit, y_unit : str
    by_direction : bool
        True where the curve changes sign with the direction of motion.
    x : (n,) array
        The variable; a speed for curves over velocity.
    y, low, high : (n,) array
        The whole torque over this variable: that of the base's own laws of it and the learned part.
        Their sum is identifiable, the split is not.
    learned : (n,) array
        The learned part alone.
    values : mapping of str to float
        Control values and range, by the parameters' names in a model.
    gain : Gain
        Of this curve beside all the others.
    freedom : float
        Effective number of parameters.
    beside : mapping of str to float
        Parameters of the base, refitted with all curves of the balance.
    """

    label: str
    balance: str
    axis: str
    unit: str
    y_unit: str
    by_direction: bool
    x: FloatArray
    y: FloatArray
    low: FloatArray
    high: FloatArray
    learned: FloatArray
    values: Mapping[str, float]
    gain: Gain
    freedom: float
    beside: Mapping[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """The shape of a claim's ``curve``."""
        return {
            "axis": self.axis,
            "unit": self.unit,
            "by_direction": self.by_direction,
            "y_unit": self.y_unit,
            "x": self.x.tolist(),
            "y": self.y.tolist(),
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "learned": self.learned.tolist(),
            "label": self.label,
            "values": dict(self.values),
        }


@final
@dataclass(frozen=True)
class Located:
    """The curves that a balance asks for, the most telling first.

    Attributes
    ----------
    balance : str
    curves : tuple of Curve
    before, after : (blocks,) array
        Cross-validated squares of the balance without and with them.
    held_out_rms : (float, float)
        RMS of the balance on held-out rows that move steadily, without and with them; NaN without
        such rows.
    base_values : mapping of str to float
        Parameters of the base, refitted beside the curves.
    """

    balance: str
    curves: tuple[Curve, ...]
    before: FloatArray
    after: FloatArray
    held_out_rms: tuple[float, float] = (math.nan, math.nan)
    base_values: Mapping[str, float] = field(default_factory=dict)

    @property
    def gain(self) -> Gain:
        """Of all curves together."""
        return gain(self.before, self.after)

    @property
    def held_out_drop_percent(self) -> float:
        """Fall of the RMS on held-out rows."""
        return 100 * (1 - self.held_out_rms[1] / self.held_out_rms[0])


def find_curves(
    base: Base,
    balance: str,
    only: Callable[[Candidate], bool] | None = None,
    *,
    most: int = MOST_CURVES,
    certain: bool = True,
) -> Located:
    """Free curves of a balance: forward choice by cross-validation, then those that no longer help
    are dropped.

    Parameters
    ----------
    base : Base
        The fitted base on its rows.
    balance : str
        The balance that is judged; the fit takes the rows of all.
    only : callable, optional
        ``only(candidate)`` leaves out variables.
    most : int
        Curves at most.
    certain : bool
        False: the best curves are given even where they gain little.
    """
    return curves_on(steadily_moving(base), balance, only, most=most, certain=certain)


def curves_on(
    base: Base,
    balance: str,
    only: Callable[[Candidate], bool] | None = None,
    *,
    most: int = MOST_CURVES,
    certain: bool = True,
) -> Located:
    """As `find_curves`, on a base from `steadily_moving`; none where no row moves steadily."""
    where = base.balances.index(balance)
    if not np.any((base.block >= 0) & (base.balance == where)):
        return Located(balance, (), before=np.zeros(0), after=np.zeros(0))
    evaluate = _unweighted(base)
    candidates = [c for c in _candidates(base, balance) if only is None or only(c)]
    open_ = [t for t in (_tried(c, base, evaluate) for c in candidates) if t is not None]
    bare = _system(base, (), where)
    chosen: list[_Tried] = []
    now = bare
    while open_ and len(chosen) < most:
        new, system = _simplest([_smoothed(base, chosen, t, where) for t in open_])
        if certain and not gain(now.crossed, system.crossed).is_certain:
            break
        chosen, now = [*chosen, new], system
        open_ = [t for t in open_ if t.candidate.label != new.candidate.label]
    gains = [gain(bare.crossed, now.crossed)]
    if len(chosen) > 1 and certain:
        gains = [_alone(base, chosen, t, now) for t in chosen]
        kept = [t for t, g in zip(chosen, gains, strict=True) if g.is_certain]
        if len(kept) < len(chosen):
            chosen, now = kept, _system(base, kept, where)
            gains = [_alone(base, chosen, t, now) for t in chosen]
    return _located(base, balance, chosen, gains, (bare, now))


def squares_left(base: Base, balance: str) -> FloatArray:
    """Cross-validated squares of each block of a balance without any curve, (blocks,)."""
    return _system(base, (), base.balances.index(balance)).crossed


def one_term_squares(
    base: Base, balance: str, only: Callable[[Candidate], bool]
) -> FloatArray | None:
    """Cross-validated squares of each block of a balance with the best law of one term.

    Parameters
    ----------
    base : Base
        From `steadily_moving`, without the names that are judged.
    balance : str
    only : callable
        ``only(candidate)`` leaves out variables.

    Returns
    -------
    (blocks,) array or None
        Of the law in `ONE_TERM` that leaves the least; None where no table over a speed is left.

    Notes
    -----
    A law of one term is written in the control values of the table, whose products with the rows
    are made once; the shape of each is the one that explains most of all rows.
    """
    where, evaluate = base.balances.index(balance), _unweighted(base)
    best: FloatArray | None = None
    for candidate in _candidates(base, balance):
        t = _tried(candidate, base, evaluate) if only(candidate) else None
        if t is None or not _table(candidate.effect).of_speed:
            continue
        system, first = _system(base, (t,), where), base.jacobian.shape[1]
        reach = _range(candidate.effect, t.shapes)[1]
        x = SLOW * np.sinh(np.linspace(0.0, math.asinh(1 / SLOW), 4 * POINTS))
        onto = np.linalg.pinv(basis(candidate.effect, t.shapes, reach * x))
        beside = np.linalg.pinv(system.total[:first, :first], RIDGE, hermitian=True)
        over = system.total[first:, :first]
        outside = system.total[first:, first:] - over @ beside @ over.T
        for family, law in ONE_TERM.items():
            tried = onto @ np.column_stack([law(x, float(s)) for s in SHAPES[family]])
            size = np.einsum("ik,ij,jk->k", tried, outside[:-1, :-1], tried)
            explained = (outside[-1, :-1] @ tried) ** 2 / np.maximum(size, TINY)
            mix = np.zeros((first + len(onto) + 1, first + 2))
            mix[:first, :first] = np.eye(first)
            mix[first:-1, first] = tried[:, int(np.argmax(explained))]
            mix[-1, -1] = 1.0
            grams = mix.T @ system.grams @ mix
            left = _System(grams, np.zeros((first + 1, first + 1)), base, where).crossed
            if best is None or left.sum() < best.sum():
                best = left
    return best


def lacking(base: Base, labels: Collection[str]) -> Base:
    """The base without some terms of its model: the rest is fitted anew by whoever solves it.

    What stands at its bound is fitted with the rest: a law that did the work of dry friction, say,
    has pushed it there, and its absence is not what the law explains.
    """
    solution, data = base.solution, base.data
    terms = [t for t in solution.model.terms if t.label in labels]
    gone = {n for t in terms for n in t.names}
    absent = {
        n: 0.0
        for t in terms
        for n, p in zip(t.names, t.effect.parameters, strict=True)
        if not p.is_shape
    }
    balances = balances_of(solution.model, data.sensing, wrt=())
    values = solution.values
    # not from the base's residual: where a step of the refit is large, laws are not linear in it
    rows = stack(balances, data.train, {**values, **absent}).residual
    left = np.concatenate([rows[b] for b in base.balances]) * base.weight
    kept = [i for i, n in enumerate(base.names) if n not in gone]
    freed = [i for i, n in enumerate(base.inward_names) if n not in gone]
    jacobian = np.column_stack([base.jacobian[:, kept], base.inward[:, freed]])
    return replace(
        base,
        residual=left,
        jacobian=jacobian,
        orthonormal=span_of(jacobian),
        names=tuple(base.names[i] for i in kept) + tuple(base.inward_names[i] for i in freed),
        norms=np.concatenate([base.norms[kept], base.inward_norms[freed]]),
        held_jacobian=np.column_stack([base.held_jacobian[:, kept], base.held_inward[:, freed]]),
        noise=None,
    )


def _simplest(trials: Sequence[tuple[_Tried, _System]]) -> tuple[_Tried, _System]:
    """Of the curves that are not certainly worse than the best, the one with the least freedom."""
    best = min(trials, key=lambda s: float(s[1].crossed.sum()))[1].crossed
    alike = [s for s in trials if gain(s[1].crossed, best).t < ALIKE]
    return min(alike, key=lambda s: s[1].freedom(s[0].added.shape[1]))


def _alone(base: Base, chosen: Sequence[_Tried], one: _Tried, now: _System) -> Gain:
    """What one curve gains beside all the others."""
    rest = _system(base, [t for t in chosen if t is not one], now.where)
    return gain(rest.crossed, now.crossed)


def _located(
    base: Base,
    balance: str,
    chosen: Sequence[_Tried],
    gains: Sequence[Gain],
    systems: tuple[_System, _System],
) -> Located:
    bare, system = systems
    delta = system.solved(system.total)
    covariance, edf = _covariances(base, chosen, system, delta)
    p = base.jacobian.shape[1]
    first, curves = p, []
    for t, g in zip(chosen, gains, strict=False):
        k = t.added.shape[1]
        curves.append(
            _curve(
                base,
                balance,
                t,
                (delta, covariance, slice(first, first + k)),
                (g, edf[first : first + k]),
            )
        )
        first += k
    moved = zip(base.names, (delta[:p] / base.norms).tolist(), strict=True)
    values = {n: base.solution.values[n] + d for n, d in moved}
    curves = [replace(c, beside=values) for c in curves]
    return Located(
        balance,
        tuple(curves),
        bare.crossed,
        system.crossed,
        (_held_out(base, (), bare), _held_out(base, chosen, system)),
        values,
    )


def _held_out(base: Base, chosen: Sequence[_Tried], system: _System) -> float:
    """RMS of the judged balance on steadily moving rows that the fit never saw."""
    here = (base.held_balance == system.where) & (base.held_weight > 0)
    if not here.any():
        return math.nan
    evaluate = _unweighted(base)
    delta = system.solved(system.total)
    first = base.jacobian.shape[1]
    left = base.held_residual + base.held_jacobian @ delta[:first]
    for t in chosen:
        k = t.added.shape[1]
        left = left + base.held_weight * (
            evaluate(t, base.data.held_out) @ delta[first : first + k]
        )
        first += k
    return float(np.sqrt(np.mean((left[here] / base.held_weight[here]) ** 2)))


def _covariances(
    base: Base, chosen: Sequence[_Tried], system: _System, delta: FloatArray
) -> tuple[tuple[FloatArray, FloatArray], FloatArray]:
    """Two covariances of the parameters, and the freedom of each.

    The first is that of the penalised fit, taken as a posterior (Nychka 1988), times how many rows
    count as one; the second the sandwich of the blocks' scores.
    """
    inverse = system.inverse()
    edf = np.diag(inverse @ system.total[:-1, :-1])
    columns_ = np.column_stack([base.jacobian, *(t.added for t in chosen)])
    left = base.residual + columns_ @ delta
    use = base.block >= 0
    level = float(np.sum(left[use] ** 2)) / max(int(use.sum()) - float(edf.sum()), 1.0)
    shares = [
        effective_share(left[use & (base.balance == k)])
        for k in range(len(base.balances))
        if np.any(use & (base.balance == k))
    ]
    posterior = inverse * level / min(shares)
    scores = np.einsum("bij,j->bi", system.blocks[:, :-1], np.append(delta, 1.0))
    count = int(np.count_nonzero(np.any(scores, axis=1)))
    wider = (float(student(np.array([max(count - 1.0, 1.0)]))[0]) / NORMAL) ** 2
    sandwich = inverse @ (scores.T @ scores) @ inverse * count / max(count - 1, 1) * wider
    return (posterior, sandwich), edf


def _curve(
    base: Base,
    balance: str,
    t: _Tried,
    fit: tuple[FloatArray, tuple[FloatArray, FloatArray], slice],
    judged: tuple[Gain, FloatArray],
) -> Curve:
    delta, covariances, own = fit
    effect, place = t.candidate.effect, t.candidate.place
    x = _points(effect, place, base.data, t.shapes)
    rows = np.zeros((len(x), len(delta)))
    rows[:, own] = basis(effect, t.shapes, x)
    if _table(effect).of_speed and _table(effect).odd:
        rows[:, own] *= np.tanh(x / (SHARP * _range(effect, t.shapes)[1]))[:, None]
    learned = rows[:, own] @ delta[own]
    whole, slopes = _of_base(base, effect, place, x)
    rows[:, : slopes.shape[1]] = slopes
    y = whole + rows @ delta
    size = np.sqrt(np.max([np.einsum("ij,jk,ik->i", rows, c, rows) for c in covariances], axis=0))
    size = np.hypot(size, _unresolved(effect, t.shapes, delta[own], x))
    linear = base.data.joint.kind == "linear"
    unit = next(p.unit for p in effect.parameters if p.name == _table(effect).range_names[0])
    over = _table(effect).over
    return Curve(
        label=t.candidate.label,
        balance=balance,
        axis=over if over in ("torsion", "load") else f"{place}_{over}",
        unit=linear_unit(unit) if linear else unit,
        y_unit="N" if linear else "N.m",
        by_direction=_table(effect).odd,
        x=x,
        y=y,
        low=y - NORMAL * size,
        high=y + NORMAL * size,
        learned=learned,
        gain=judged[0],
        freedom=float(judged[1].sum()),
        values={**dict(zip(t.candidate.amplitudes, delta[own].tolist(), strict=True)), **t.named},
    )


def _unresolved(
    effect: Effect, shapes: Mapping[str, float], controls: FloatArray, x: FloatArray
) -> FloatArray:
    """What the knots are too far apart to show, from the fourth differences of the control
    values.
    """
    fourth = np.abs(np.diff(controls, 4))
    nearby = np.max([np.pad(fourth, (k, 4 - k), mode="edge") for k in range(5)], axis=0)
    return np.asarray(RESOLUTION * (basis(effect, shapes, x) @ nearby))


def _points(effect: Effect, place: Place, data: Dataset, shapes: Mapping[str, float]) -> FloatArray:
    """Where a curve is given: evenly over its range, denser at low speed."""
    rows = np.concatenate(
        [
            np.abs(w.average(v)) if _table(effect).of_speed else w.average(v)
            for w, v in zip(data.train, _signal(effect, place, data.train), strict=True)
        ]
    )
    x = rows[_steady(data.train, data.sources)]
    low, high = (float(v) for v in np.quantile(x, INSIDE))
    if _table(effect).of_speed:
        bend = SLOW * _range(effect, shapes)[1]
        return np.asarray(
            bend * np.sinh(np.linspace(np.arcsinh(low / bend), np.arcsinh(high / bend), POINTS))
        )
    return np.linspace(low, high, POINTS)


def _of_base(
    base: Base, effect: Effect, place: Place, x: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What the base's own laws of the same variable add, and its slopes over the columns of the
    base.
    """
    over = _table(effect).over
    odd = _table(effect).odd
    total, slopes = np.zeros(len(x)), np.zeros((len(x), base.jacobian.shape[1]))
    names = list(base.names)
    values = base.solution.values
    smoothing = base.solution.model.named("smoothing", place)
    for term in base.solution.model.terms:
        law = term.effect
        if (
            term.place != place
            or law.states
            or not law.reads
            or not law.reads <= {over, "direction"}
        ):
            continue
        known = (*term.names, *smoothing)
        at, p = ca.SX.sym("x"), ca.SX.sym("p", len(known))
        bound = SimpleNamespace(**{q.name: p[i] for i, q in enumerate(law.parameters)})
        sides = []
        for sign in (1, -1):
            given = {f: 0.0 for f in LocalSignals.__dataclass_fields__ if f != "memory"}
            given |= {over: sign * at if _table(effect).of_speed else at, "direction": sign}
            if _table(effect).of_speed and smoothing:
                given["direction"] = ca.tanh(sign * at / p[len(term.names)])
            sides.append(law.law(LocalSignals(memory=(), **given), bound))
        value = ca.SX((sides[0] - sides[1]) / 2 if odd else (sides[0] + sides[1]) / 2)
        f = ca.Function("f", [at, p], [value, ca.densify(ca.jacobian(value, p))])
        numbers = np.array([values[n] for n in known])
        found = f.map(len(x))(x[None, :], np.tile(numbers[:, None], len(x)))
        total += np.array(found[0]).ravel()
        own = np.array(found[1]).reshape(len(x), -1)
        for i, n in enumerate(known):
            if n in names:
                slopes[:, names.index(n)] += own[:, i] / base.norms[names.index(n)]
    return total, slopes


__all__ = [
    "Curve",
    "Gain",
    "Located",
    "basis",
    "curves_on",
    "find_curves",
    "gain",
    "lacking",
    "one_term_squares",
    "penalty",
    "squares_left",
    "steadily_moving",
]
