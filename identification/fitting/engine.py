"""Weighted least squares over the balances of several records: the numbers behind fit, compare
and diagnose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.hold import CLOCKS
from casadi_models.term import HANGING, LOAD_COMPLIANCE, LOAD_DAMPING
from identification.balance.balances import Balances, balances_of
from identification.balance.calibration import (
    bare,
    is_of_run,
    names_of_runs,
    nuisances,
    usual,
)
from identification.balance.dataset import (
    HOLD_NAME,
    Dataset,
    load_dataset,
    prepared_model,
    weak_record,
)
from identification.balance.kinematic import held_scale
from identification.balance.memory import Law, solution_of
from identification.balance.noise import effective_share
from identification.balance.sensing import idle_shapes
from identification.balance.stacked import (
    Stacked,
    drawn_floors,
    floor_rows,
    floors,
    references,
    rms,
    row_weights,
    stack,
    sure_levels,
    taking_part,
)
from identification.balance.weak import INDEPENDENT_SHARE
from identification.data.joint_file import Correlation
from identification.errors import InputError
from identification.fitting.covariance import correlations
from identification.fitting.errors_in_variables.bands import Bands
from identification.fitting.errors_in_variables.equations import unbiased
from identification.fitting.errors_in_variables.products import Unbiased
from identification.fitting.start_values import bounds_of, starts
from identification.fitting.weak_form import WeakForm

__all__ = [
    "Dataset",
    "Solution",
    "Stacked",
    "floor_rows",
    "floors",
    "load_dataset",
    "posed",
    "prepared_model",
    "references",
    "reweighed",
    "rms",
    "row_weights",
    "solve",
    "solved_once",
    "stack",
    "stepped",
    "taking_part",
    "weak_record",
]
FloatArray = npt.NDArray[np.float64]


def _items(values: Mapping[str, float | None]) -> tuple[tuple[str, float | None], ...]:
    return tuple(values.items())


@final
@dataclass(frozen=True)
class Solution:
    """A fitted model in the terms of the balances.

    Attributes
    ----------
    model : JointModel
        With the fitted values.
    values, stderr : mapping
        Every parameter; standard errors from windows of time (None for fixed, nuisance or
        unidentifiable ones).
    free : tuple of str
    weights : mapping of str to (rows,) array
        1/sigma of each training row.
    sigma : mapping of str to float
    at_bound, unidentified : tuple of str
    correlation : mapping
        Largest correlation of each parameter with another one: (name, value).
    together : Correlation
        Of all that have a standard error, nuisances and what belongs to one run left out.
    noise_off : bool
        Whether what noise adds to the products of the columns was taken off them.
    met : frozenset of str
        Balances whose columns were met by those of the other sensors, which have other noise.
    """

    model: JointModel
    values: Mapping[str, float]
    stderr: Mapping[str, float | None]
    free: tuple[str, ...]
    weights: Mapping[str, FloatArray]
    sigma: Mapping[str, float]
    at_bound: tuple[str, ...] = ()
    unidentified: tuple[str, ...] = ()
    correlation: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    iterations: int = 0
    together: Correlation = Correlation()
    noise_off: bool = False
    met: frozenset[str] = frozenset()

    @property
    def law(self) -> Law:
        """What tells it from other fits to the same data."""
        return Law(
            self.model.structure,
            *(_items(x) for x in (self.values, self.stderr, self.sigma)),
            (self.free, self.at_bound, self.unidentified),
            tuple((b, w.tobytes()) for b, w in self.weights.items()),
        )

    def __repr__(self) -> str:
        return (
            f"Solution({len(self.free)} free parameters, at bound: {list(self.at_bound)}, not "
            f"identifiable: {list(self.unidentified)})"
        )


LEAST_SWING: Final = 0.05
"""Fall of the RMS by which a link that swings unseen must show itself; else the joint is taken
as rigid.
"""
HIGHEST_SWING: Final = 4.0
"""Highest frequency of such a link in units of 1/kernel (the kernel's -3 dB point is 0.93):
faster ones are rigid to these rows.
"""
LARGEST_DAMPING: Final = 0.2
"""Damping ratio of such a link above which its damper is none: rubber couplings, the softest parts
of drives, have relative dampings of .8 to 1.2 (DIN 740), ratios of .06 to .1, gears and belts
less. What looks like a stronger one is a late reading or a friction.
"""
COLLINEAR: Final = 1e4
"""Growth of a parameter's error by the others from which it is not identified: all but one part in
1e8 of its column's power is theirs.
"""
AT_BOUND: Final = 1e-9
"""Relative distance from a bound within which a parameter stands at it: rounding of the step."""


def solve(
    model: JointModel,
    data: Dataset,
    *,
    iterations: int = 15,
    start: Mapping[str, float] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Solution:
    """Fit a model to the training rows by Levenberg-Marquardt steps on the weak form.

    Parameters
    ----------
    model : JointModel
    data : Dataset
    iterations : int
        At most so many in each of the two passes.
    start : mapping of str to float, optional
        Values to start from.
    progress : callable, optional
        ``progress(text, share)`` before each stage.

    Raises
    ------
    InputError
        An inertia or a stiffness that the channels would show, but not this motion.
    """
    if not model.lagging_load or LOAD_COMPLIANCE.name in data.joint.known:
        return _fitted(model, data, iterations, start or {}, progress)
    tied = {**(start or {}), LOAD_COMPLIANCE.name: 0.0}
    # what hangs on the link loads the gear, however stiff it is
    loaded = any(t.effect.needs_load for t in model.terms)
    held = frozenset((LOAD_COMPLIANCE.name, LOAD_DAMPING.name) if loaded else HANGING)
    rigid = _fitted(model, data, iterations, tied, progress, held)
    swinging = _swings(rigid, data)
    if swinging is None:
        return rigid

    def fitted(start: Mapping[str, float], held: frozenset[str] = frozenset()) -> Solution:
        found = _fitted(model, data, iterations, start, progress, held)
        # a start far from the scale of the torques can end in no fit at all: then the rigid fit is
        # where to begin
        left = [_left(model, s.values, data) for s in (found, rigid)]
        if left[0] < left[1]:
            return found
        return _fitted(model, data, iterations, swinging, progress, held)

    found = fitted(start or {})
    lag = model.swinging_inertia(found.values) * model.load_compliance(found.values)
    strong = model.load_relaxation(found.values) > 2 * LARGEST_DAMPING * math.sqrt(lag)
    # a drive that is read later than its hold explains looks like a damper
    late = HOLD_NAME in found.at_bound and found.values[HOLD_NAME] > 0
    if not strong and not late:
        return found
    return fitted({**(start or {}), LOAD_DAMPING.name: 0.0}, frozenset((LOAD_DAMPING.name,)))


def solved_once(model: JointModel, data: Dataset, start: Mapping[str, float]) -> Solution:
    """:func:`solve`, from memory where the same model was fitted to the same data from the same
    values.

    Names of a set are fitted again whenever another claim asks which of them it is.

    Parameters
    ----------
    model : JointModel
    data : Dataset
        Known by identity.
    start : mapping
        Values to start from; the model's own where absent.
    """
    law = Law(model.structure, _items(model.values), _items(start))
    return solution_of(data, law, lambda: solve(model, data, start=start))


def _left(model: JointModel, values: Mapping[str, float], data: Dataset) -> float:
    """RMS of what these values leave on the training rows of the one balance of an axis."""
    return rms(stack(balances_of(model, data.sensing, wrt=()), data.train, values).residual["axis"])


def _noise(model: JointModel, values: Mapping[str, float], data: Dataset) -> float:
    """RMS of what noise makes of them."""
    levels = [drawn_floors(model, data, values, w)["axis"] for w in data.train]
    return rms(np.repeat(levels, [w.rows for w in data.train]))


def _swings(rigid: Solution, data: Dataset) -> dict[str, float] | None:
    """Values with a link that swings unseen, where it shows itself in the rows of a model that
    was fitted as rigid; else None. A damper alone is no swing.
    """
    model = rigid.model
    free = [*rigid.free, *(n for n in HANGING if n != LOAD_DAMPING.name)]
    free = [n for n in model.parameter_names if n in free]
    balances = balances_of(model, data.sensing, wrt=free)
    limits = bounds_of(model, data.joint.known, data)
    values, _ = WeakForm(balances, data, rigid.values, tuple(free), rigid.weights).fitted(limits, 6)
    sizes = [_left(model, v, data) for v in (rigid.values, values)]
    # the load's lag takes noise of the torque off the rows: that alone is no swing
    noise = [_noise(model, v, data) for v in (rigid.values, values)]
    sizes[1] = math.sqrt(sizes[1] ** 2 + max(noise[0] ** 2 - noise[1] ** 2, 0.0))
    lag = model.swinging_inertia(values) * values[LOAD_COMPLIANCE.name]
    slow = lag * (2 * math.pi * HIGHEST_SWING / data.kernel) ** 2 > 1
    return values if slow and sizes[1] < (1 - LEAST_SWING) * sizes[0] else None


def _fitted(
    model: JointModel,
    data: Dataset,
    iterations: int,
    start: Mapping[str, float],
    progress: Callable[[str, float], None] | None,
    held: frozenset[str] = frozenset(),
) -> Solution:
    """The fit itself; the parameters `held` keep their start values."""
    values, free, limits, unseen = posed(model, data, start, held)
    shapes = {p.name for p in model.parameters if p.is_shape}
    softening = model.named("softening")
    known_before = usual(model, data.train, torque=data.sensing.has_torque)
    balances = balances_of(model, data.sensing, wrt=bare(free))
    tell = progress or (lambda text, share: None)
    tell("start values", 0.0)
    # first pass without shapes: linear amplitudes from any start
    linear_only = [n for n in free if n not in shapes and not is_of_run(n)]
    # the load of a first guess says nothing about when it turns: first without gap
    soft = {n: values[n] for n in softening} if data.sensing.kinematic else {}
    linear = WeakForm(
        balances,
        data,
        {**values, **dict.fromkeys(soft, 0.0)},
        tuple(linear_only),
        dict.fromkeys(balances.balances, 1.0),
    )
    _check_moves(linear)
    values = {**linear.fitted(limits, 3)[0], **soft}
    values = _best_start(balances, data, values, free, limits)
    for number in range(GAP_PASSES if balances.has_gap else 2):
        tell("first pass" if number == 0 else "second pass", 0.2 + 0.35 * min(number, 1))
        began = values
        sigma = _sigmas(model, data, values)
        weights = row_weights(balances, data, values, sigma, data.train)
        before = _beside(known_before, _independent(balances, data, values))
        values, used = WeakForm(balances, data, values, tuple(free), weights, before).fitted(
            limits, iterations
        )
        gaps = [n for n in free if n in shapes and values[n]]
        if number and all(abs(values[n] / began[n] - 1) < SETTLED_GAP for n in gaps):
            break
    sigma = _sigmas(model, data, values)
    weights = row_weights(balances, data, values, sigma, data.train)
    tell("standard errors", 0.9)
    share = _independent(balances, data, values)
    before = _beside(known_before, share)
    problem = WeakForm(balances, data, values, tuple(free), weights, before)
    without = unbiased(problem, limits, share)
    problem = replace(problem, values=without.values)
    found = _with_errors(problem, limits, sigma, used, without=without, share=share)
    return replace(found, unidentified=(*found.unidentified, *unseen))


def carried_over(solution: Solution, data: Dataset) -> dict[str, float]:
    """Values of a fitted model on rows that differ little from those of its fit: its linear part is
    followed from there, and no other valley is looked for.

    Parameters
    ----------
    solution : Solution
    data : Dataset
    """
    model, tied = solution.model, solution.values.get(LOAD_COMPLIANCE.name) == 0.0
    held = frozenset(n for n in HANGING if tied or n not in solution.free)
    values, free, limits, _ = posed(model, data, solution.values, held)
    balances = balances_of(model, data.sensing, wrt=bare(free))
    weights = row_weights(balances, data, values, _sigmas(model, data, values), data.train)
    before = usual(model, data.train, torque=data.sensing.has_torque)
    return WeakForm(balances, data, values, tuple(free), weights, before).fitted(limits, NEARBY)[0]


def unseen_by(model: JointModel, data: Dataset) -> tuple[str, ...]:
    """Inertias, stiffness and amplitudes that stand in no balance of these channels: they keep
    their values.

    The inertia of the link is one where motor and torque sensor are recorded and the link is not.
    """
    holding = balances_of(model, data.sensing, wrt=()).holding
    if model.lagging_load:  # the swing of an unseen link enters by its second derivative
        return ()
    return tuple(
        p.name
        for p in model.parameters
        if not p.is_shape and p.name not in holding and p.name not in model.calibration
    )


def posed(
    model: JointModel, data: Dataset, start: Mapping[str, float], held: frozenset[str]
) -> tuple[dict[str, float], list[str], dict[str, tuple[float, float]], list[str]]:
    """Start values inside their bounds, the parameters that are free, the bounds, and those that
    no balance holds.
    """
    known = data.joint.known
    values = starts(model, data)
    values.update({k: v for k, v in start.items() if k in values})
    fixed = {n: k.value for n, k in known.items() if k.value is not None and n in values}
    fixed.update(held_scale(model, data.sensing, known))
    fixed.update(idle_shapes(model, data.sensing))
    values.update({n: v for n, v in fixed.items() if v is not None})
    limits = bounds_of(model, known, data)
    unseen = [n for n in unseen_by(model, data) if n not in fixed]
    apart = {*fixed, *held, *unseen, *model.calibration, *model.named("range")}
    free = [
        *(n for n in model.parameter_names if n not in apart),
        *names_of_runs(model, data.train),
    ]
    for n in free:
        low, high = limits[n]
        values[n] = min(max(values[n], low), high)
    return values, free, limits, unseen


def stepped(
    model: JointModel,
    data: Dataset,
    start: Mapping[str, float],
    like: Solution,
    *,
    iterations: int,
) -> tuple[Solution, float]:
    """A few steps of a fit, on the weighting of another one: models that are held against each
    other need one weighting. From memory as :func:`solved_once`.

    Parameters
    ----------
    model : JointModel
    data : Dataset
    start : mapping of str to float
        Values to start from.
    like : Solution
        Whose weights count.
    iterations : int

    Returns
    -------
    (Solution, float)
        Without standard errors; and the weighted sum of squares.
    """
    law = Law("stepped", model.structure, _items(model.values), _items(start), like.law, iterations)
    return solution_of(data, law, lambda: _stepped(model, data, start, like, iterations))


def _stepped(
    model: JointModel,
    data: Dataset,
    start: Mapping[str, float],
    like: Solution,
    iterations: int,
) -> tuple[Solution, float]:
    held = frozenset(n for n in HANGING if n in like.values and n not in like.free)
    values, free, limits, _ = posed(model, data, start, held)
    balances = balances_of(model, data.sensing, wrt=bare(free))
    known_before = usual(model, data.train, torque=data.sensing.has_torque)
    theirs = balances_of(like.model, data.sensing, wrt=())
    before = _beside(known_before, _independent(theirs, data, like.values))
    problem = WeakForm(balances, data, values, tuple(free), like.weights, before)
    values, used = problem.fitted(limits, iterations)
    rows = problem.residual(np.array([values[n] for n in free]))
    own = {n: x for n, x in values.items() if not is_of_run(n)}
    for n in model.calibration:
        own[n] = float(np.mean([values[k] for k in free if is_of_run(k) and bare([k]) == (n,)]))
    found = Solution(
        replace(model, values=own),
        {**values, **own},
        stderr=dict.fromkeys(values),
        free=tuple(n for n in free if not is_of_run(n)),
        weights=like.weights,
        sigma=like.sigma,
        at_bound=_at_bound(model, values, free, limits),
        iterations=used,
    )
    return found, float(rows @ rows)


def reweighed(solution: Solution, data: Dataset) -> Solution:
    """A fit with the weights that belong to its own values; from memory as :func:`solved_once`."""
    return solution_of(data, Law("reweighed", solution.law), lambda: _reweighed(solution, data))


def _reweighed(solution: Solution, data: Dataset) -> Solution:
    sigma = _sigmas(solution.model, data, solution.values)
    balances = balances_of(solution.model, data.sensing, wrt=())
    weights = row_weights(balances, data, solution.values, sigma, data.train)
    return replace(solution, weights=weights, sigma=sigma)


def _at_bound(
    model: JointModel,
    values: Mapping[str, float],
    free: Sequence[str],
    limits: Mapping[str, tuple[float, float]],
) -> tuple[str, ...]:
    """Free parameters that stand at a bound; a smoothing velocity is none of them."""
    smoothing = model.named("smoothing")
    return tuple(
        n
        for n in free
        if any(
            math.isfinite(limit) and abs(values[n] - limit) <= AT_BOUND * max(abs(limit), 1e-300)
            for limit in limits[n]
        )
        and n not in smoothing
    )


def _independent(balances: Balances, data: Dataset, values: Mapping[str, float]) -> float:
    """Share of the rows that count as independent beside what is known beforehand: a residual with
    structure repeats itself from row to row.
    """
    bare_ones = balances_of(balances.model, data.sensing, wrt=())
    residual = stack(bare_ones, data.train, values).residual
    return min(effective_share(r[taking_part(b, data.train)]) for b, r in residual.items())


def _beside(
    known: Mapping[str, tuple[float, float]], share: float
) -> dict[str, tuple[float, float]]:
    """What is known beforehand, as heavy as that share of the rows makes it."""
    return {n: (middle, size * math.sqrt(share)) for n, (middle, size) in known.items()}


def _sigmas(model: JointModel, data: Dataset, values: Mapping[str, float]) -> dict[str, float]:
    """RMS of each balance on the training rows, at least its floor."""
    floor = floors(model, data, values)
    if data.sensing.kinematic:
        # rows in a gap are no equations: what they leave is no measure of the others
        level = sure_levels(model, data, values)
        return {b: max(level[b], floor[b], 1e-12) for b in level}
    residual = stack(balances_of(model, data.sensing, wrt=()), data.train, values).residual
    return {
        b: max(rms(r[taking_part(b, data.train)]), floor[b], 1e-12) for b, r in residual.items()
    }


def _best_start(
    balances: Balances,
    data: Dataset,
    values: dict[str, float],
    free: Sequence[str],
    limits: Mapping[str, tuple[float, float]],
) -> dict[str, float]:
    """Laws with a shape near zero velocity or zero torque have several valleys: the best of a few
    smoothing velocities and exponents, and of a few sizes of a gap. So has a smoothing velocity
    that went to nothing while another law was missing: rows no longer tell its size.
    """
    shaped = [t for t in balances.model.terms if t.effect.several_valleys]
    flat = [
        n
        for n in balances.model.named("smoothing")
        if n in free and values[n] < FLAT * data.ranges["velocity"]
    ]
    if not shaped and not flat:
        return values
    smooth = [n for t in shaped for n in balances.model.named("smoothing", t.place)]
    smooth = list(dict.fromkeys([*smooth, *flat]))
    exponents = [
        n
        for n in balances.model.named("exponent")
        if any(n in t.names for t in shaped) and n in free
    ]
    gaps = [
        n
        for t in shaped
        for n, p in zip(t.names, t.effect.parameters, strict=True)
        if p.is_shape and p.scale == "torsion" and n in free
    ]
    trials = [dict(values)]
    for factor in GAP_FACTORS if gaps else ():
        trials.append({**values, **{n: factor * values[n] for n in gaps}})
    if data.sensing.kinematic:
        trials += [
            {**values, **dict.fromkeys(gaps, share * data.ranges["torsion"])}
            for share in GAP_SHARES
        ]
    for share in SMOOTHING_SHARES if smooth else ():
        for power in (1.0, 2.0) if exponents else (1.0,):
            moved = {
                n: min(max(share * data.ranges["velocity"], limits[n][0]), limits[n][1])
                for n in smooth
                if n in free
            }
            trials.append({**values, **moved, **dict.fromkeys(exponents, power)})
    floor = floors(balances.model, data, values)
    sigma = {b: max(floor[b], 1e-12) for b in floor}
    reference = trials[-1]
    weights = row_weights(balances, data, reference, sigma, data.train)
    if data.sensing.kinematic:
        # which rows lie inside a gap is not known before the gap is
        weights = {b: np.ones(len(row)) for b, row in weights.items()}
        free = [n for n in free if bare([n])[0] not in CLOCKS and n not in smooth]
    # an exponent that is free from the first step on trades with the velocity beside it, and both
    # run off: a start keeps it where it is tried
    free = [n for n in free if n not in exponents]
    bare_ones = balances_of(balances.model, data.sensing, wrt=())
    best: tuple[float, dict[str, float]] | None = None
    for trial in trials:
        fitted, _ = WeakForm(balances, data, trial, tuple(free), weights).fitted(limits, 6)
        residual = stack(bare_ones, data.train, fitted).residual
        cost = sum(float(np.sum((residual[b] * weights[b]) ** 2)) for b in residual)
        if best is None or cost < best[0]:
            best = (cost, fitted)
    return best[1] if best is not None else values


SMOOTHING_SHARES: Final = (0.003, 0.01)
"""Smoothing velocities from which laws of low speed are fitted, as shares of the record's speed."""
FLAT: Final = 1e-3
"""Smoothing velocity, in the same, under which no row tells its size: a turn is over between two of
the points at which friction is evaluated.
"""
GAP_FACTORS: Final = (0.1, 0.3, 3.0)
"""Sizes from which a gap of the transmission is fitted beside its start value: inside a gap that is
too wide nothing is carried, its stiffness goes to its bound, and the gap then moves nothing. A
catalogue is wrong by a factor 3, a start by guess by 10."""


NEARBY: Final = 6
"""Steps of a fit that is carried over to rows nearly the same: as many as each start of a whole fit
has, and it begins nearer.
"""
GAP_PASSES: Final = 8
"""Passes of a fit in which rows inside a gap count less: which rows these are follows from the gap,
and each pass takes most of what is wrong of it away."""
SETTLED_GAP: Final = 2e-3
"""Relative change of a gap from one pass to the next at which these end: a tenth of its error."""
GAP_SHARES: Final = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7)
"""Shares of the twist from which a gap is fitted where no torque is recorded: what the link's load
leaves of the twist may be next to all of it."""


def _check_moves(problem: WeakForm) -> None:
    values = problem.values
    jacobian = problem.stacked(np.array([values[n] for n in problem.free])).jacobian
    dead = [
        n
        for i, n in enumerate(problem.free)
        if max(float(np.abs(j[:, i]).max(initial=0.0)) for j in jacobian.values()) == 0.0
        and values[n] != 0.0
    ]
    model = problem.balances.model
    truly = [n for n in dead if n in (*model.inertias, model.stiffness_name)]
    if truly:
        raise InputError(
            f"parameter {', '.join(truly)} moves no output of these records; give it a known "
            "value or add the channel that shows it"
        )


def _with_errors(
    problem: WeakForm,
    limits: Mapping[str, tuple[float, float]],
    sigma: Mapping[str, float],
    used: int,
    *,
    without: Unbiased,
    share: float,
) -> Solution:
    """Standard errors from windows of time, without what noise adds to the columns; what cannot be
    identified is said.
    """
    balances, values, free = problem.balances, problem.values, problem.free
    weights = {b: np.asarray(w, dtype=np.float64) for b, w in problem.weights.items()}
    bands = Bands(problem, without, problem.turns, share)
    norms = bands.norms
    smoothing = balances.model.named("smoothing")
    at_bound = _at_bound(balances.model, values, free, limits)
    usable = np.array([norm > 0 and n not in at_bound for n, norm in zip(free, norms, strict=True)])
    stderr: dict[str, float | None] = dict.fromkeys(values)
    correlation: dict[str, tuple[str, float]] = {}
    unidentified = [
        n for n, norm in zip(free, norms, strict=True) if norm <= 0 and n not in smoothing
    ]
    # without stiffness the link would fall off: the twist follows no torque of these records
    unidentified += [n for n in balances.model.named("stiffness") if n in at_bound]
    index = np.flatnonzero(usable)
    together = Correlation()
    if len(index):
        part = bands.of(index)
        size = None if part.errors is None else part.errors / norms[index]
        held = [
            k
            for k, n in enumerate(free)
            if n in at_bound and norms[k] > 0 and not problem.clocks[k]
        ]
        high = [values[free[k]] >= limits[free[k]][1] for k in held]
        wider = np.zeros(len(index)) if size is None else bands.beside(index, held, high)
        wider = np.hypot(wider / norms[index], without.left[index])
        spread, corr = correlations(part.gram)
        corr[:, [is_of_run(free[i]) for i in index.tolist()]] = 0.0
        for k, i in enumerate(index.tolist()):
            stderr[free[i]] = None if size is None else math.hypot(float(size[k]), float(wider[k]))
            other = int(np.argmax(np.abs(corr[k])))
            correlation[free[i]] = (free[int(index[other])], float(corr[k, other]))
            error = stderr[free[i]]
            weak = error is not None and values[free[i]] != 0 and error > abs(values[free[i]])
            if (
                (spread[k] > COLLINEAR or weak)
                and free[i] not in smoothing
                and not is_of_run(free[i])
            ):
                unidentified.append(free[i])
        if size is not None:
            apart = nuisances(balances.model)
            told = [k for k, i in enumerate(index.tolist()) if bare([free[i]])[0] not in apart]
            names = [free[index[k]] for k in told]
            alone = spread / np.sqrt(np.maximum(np.diag(part.gram), 1e-300)) / norms[index]
            together = Correlation.of(
                names, corr[np.ix_(told, told)], alone[told] / math.sqrt(INDEPENDENT_SHARE)
            )
    kept = dict(values)
    model = balances.model
    for n in model.calibration:
        kept[n] = float(np.mean([kept[k] for k in free if is_of_run(k) and k.startswith(f"{n}[")]))
    own = {n: x for n, x in kept.items() if not is_of_run(n)}
    return Solution(
        replace(model, values=own),
        kept,
        stderr=stderr,
        free=tuple(n for n in free if not is_of_run(n)),
        weights=weights,
        sigma=sigma,
        at_bound=at_bound,
        unidentified=tuple(unidentified),
        correlation=correlation,
        iterations=used,
        together=together,
        noise_off=without.instruments is None and bool(np.any(without.noise.whole[0])),
        met=frozenset() if without.instruments is None else without.instruments.met,
    )
