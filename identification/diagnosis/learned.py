"""Names held against the curve of their own variable, and the curve as the answer where no name
does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, Effect, JointModel
from casadi_models.table import Table
from identification.balance.dataset import Dataset
from identification.balance.stacked import TURN_WIDTHS, references, sticking_torque
from identification.data.joint_file import Correlation
from identification.diagnosis.candidates import Candidate
from identification.diagnosis.claims import Claim
from identification.diagnosis.curve import (
    LEAST_FALL,
    LEAST_T,
    Curve,
    Gain,
    curves_on,
    find_curves,
    gain,
    lacking,
    one_term_squares,
    squares_left,
    steadily_moving,
)
from identification.diagnosis.places import AXIS_TITLES, Branch, Place
from identification.diagnosis.trials import Base, make_base
from identification.fitting.assess import Error, relative_error_percent
from identification.fitting.covariance import window_errors, windows_over
from identification.fitting.engine import Solution

FloatArray = npt.NDArray[np.float64]

LEARNED: Final = "learned"
"""What stands in the place of an effect's key for curves without a name."""
EQUIVALENT: Final = 0.01
"""Share of what a curve explains that a name may miss: true names miss .6 % at most, the best wrong
name on a law outside the library 18 % in the median and 5 % in one of twenty."""
ONE_SIDED: Final = 1.645
"""The normal distribution's one-sided bound of 95 %."""
LEAST_ERROR: Final = 3.0
"""Fewest independent rows' worth of squares by which a missed share is uncertain."""
OVERLAP: Final = 2.5
"""Rows that count as one: four of them overlap in a kernel that tapers."""
ALIKE: Final = 0.05
"""Share missed up to which a law is still said to be like the name."""
FEWER: Final = 0.4
"""Numbers that names of one variable may have together, as a share of the curve's freedom: with
more, a sum of laws imitates the curve."""
SMOOTHING_TRIED: Final = (3e-4, 0.1)
SMOOTHING_STEPS: Final = 14
"""Velocities over which dry friction changes its sign, as shares of the largest speed: steps of a
half, from where no row tells it from a sudden one to where it is a law of its own."""
HALF: Final = 0.5
"""Share missed from which a curve over any variable, and not the name, is what is missing."""
OUTSIDE: Final = 3.0
"""Standard errors by which a parameter must want to pass its bound, or dry friction lie beside the
curve: of ten that may stand at a bound, one in 75 joints would by chance."""
BAND: Final = 1.96
"""Standard errors on either side of a curve that are its band of 95 %."""
BY_CHANCE: Final = 0.05
"""Share of joints on which an amplitude that was there before the additions may come to its bound
by noise alone: with an error e and a true value anywhere from 0 to a, e / (a sqrt(2 pi)) of them.
"""


# --- a curve as a claim ---------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class LearnedClaim:
    """A missing torque without a name: a function of a variable, this one.

    Attributes
    ----------
    curve : Curve
    held_out_drop_percent : float
        Fall of the balance's RMS, on held-out rows that move steadily, by all curves of the
        balance.
    """

    curve: Curve
    held_out_drop_percent: float

    @property
    def balance(self) -> str:
        """The balance in which it is missing."""
        return self.curve.balance

    @property
    def place(self) -> Place:
        """The whole curve with its band, as a picture shows it."""
        c = self.curve
        branch = Branch("both", c.x, c.y, c.low, c.high, np.zeros(len(c.x), dtype=np.int64))
        title = AXIS_TITLES.get(c.axis, c.axis.replace("_", " "))
        half = np.maximum((c.high - c.low) / 2, 1e-300)
        return Place(
            c.balance,
            c.axis,
            title=title,
            unit=c.unit,
            residual_unit=c.y_unit,
            edges=c.x,
            branches=(branch,),
            share_percent=100 * c.gain.fall,
            strength=float(np.max(np.abs(c.y) / half)),
        )

    @property
    def sentence(self) -> str:
        """What a reader is told."""
        variable = self.curve.axis.replace("_", " ")
        sign = ", with the sign of the direction of motion" if self.curve.by_direction else ""
        low, high = self.curve.x[0], self.curve.x[-1]
        return (
            f"What is missing in the {self.balance} balance is a function of {variable}{sign}, "
            "known from "
            f"{low:.3g} to {high:.3g} {self.curve.unit}; no name of the library is as good "
            f"({self.curve.label})."
        )

    def as_json(self) -> dict[str, Any]:
        """The shape of a claim in `improve --json`."""
        drop = self.held_out_drop_percent
        return {
            "effects": [LEARNED],
            "balance": self.balance,
            "label": self.curve.label,
            "held_out_drop_percent": drop if np.isfinite(drop) else 100 * self.curve.gain.fall,
            "separate_by": None,
            "curve": self.curve.as_json(),
            "sentence": self.sentence,
        }


def learned_claims(
    solution: Solution, data: Dataset, error: Error, threshold: float
) -> tuple[LearnedClaim, ...]:
    """The curves of every balance that stays over its floor, where they lower its error on held-out
    rows: what does not hold on data that the fit never saw is not what is missing.

    Parameters
    ----------
    solution : Solution
        The last model.
    data : Dataset
    error : Error
        Its error on held-out records.
    threshold : float
        Ratio to the floor up to which a balance counts as explained.
    """
    failing = [b for b in data.sensing.balances if error.balances[b].ratio > threshold]
    if not failing:
        return ()
    base = make_base(solution, data)
    out: list[LearnedClaim] = []
    for balance in failing:
        found = find_curves(base, balance)
        drop = found.held_out_drop_percent
        if drop <= 0:  # none is told where no held-out row moves steadily
            continue
        seen = {c.curve.label for c in out}  # a side that two balances show is told once
        out += [LearnedClaim(c, drop) for c in found.curves if c.label not in seen]
    smoothing = _smoothing_beside(solution, data, out)
    return tuple(
        replace(c, curve=replace(c.curve, beside={**c.curve.beside, **smoothing})) for c in out
    )


def _smoothing_beside(
    solution: Solution, data: Dataset, learned: Sequence[LearnedClaim]
) -> dict[str, float]:
    """Velocities over which dry friction changes its sign, as all training rows have them beside
    the curves: those of the fit may have done a part of the curve's work, and the curve was drawn
    on rows that tell nothing of them.
    """
    found = with_curves(solution, learned)
    values = dict(found.values)
    names = [n for n in found.model.named("smoothing") if n in solution.free] if learned else []
    speed = data.ranges["velocity"]
    for name in names:
        tried = [values[name], *np.geomspace(*SMOOTHING_TRIED, SMOOTHING_STEPS) * speed]
        errors = [
            relative_error_percent(found.model, data, data.train, {**values, name: v})
            for v in tried
        ]
        values[name] = float(tried[int(np.argmin(errors))])
    return {n: values[n] for n in names}


def with_curves(solution: Solution, learned: Sequence[LearnedClaim]) -> Solution:
    """A fit with the learned curves in its model, at the values of their penalised fit.

    The parameters beside them are those of that fit too: only the sum of both is identifiable.
    """
    model, values = solution.model, dict(solution.values)
    for claim in learned:
        model = model.add(claim.curve.label)
        values |= _inside(model, claim.curve.beside) | dict(claim.curve.values)
    for p in model.parameters:
        values.setdefault(p.name, p.start)
    if not learned:
        return solution
    return replace(
        solution,
        model=model.with_values(values),
        values=values,
        stderr=dict.fromkeys(values),
        correlation={},
        together=Correlation(),
        unidentified=(),
    )


def carried(
    solution: Solution, learned: Sequence[LearnedClaim], data: Dataset
) -> tuple[LearnedClaim, ...]:
    """The learned curves that a model takes along: the last ones stay out until the error of the
    held-out records (of the training records where there are none) is no higher than without any.

    Each curve is drawn on the steady rows of one variable; a few together may swing far between
    the rows that they were drawn on, where only their sum is known.
    """
    records = data.held_out or data.train

    def error(count: int) -> float:
        found = with_curves(solution, learned[:count])
        return relative_error_percent(found.model, data, records, found.values)

    most = error(0) if learned else 0.0
    count = next(n for n in range(len(learned), -1, -1) if n == 0 or error(n) <= most)
    return tuple(learned[:count])


def _inside(model: JointModel, values: Mapping[str, float]) -> dict[str, float]:
    """Values within the physical bounds of their parameters."""
    limits = {p.name: (p.low, p.high) for p in model.parameters}
    return {n: min(max(v, limits[n][0]), limits[n][1]) for n, v in values.items() if n in limits}


# --- a name against the curve of its own variable -------------------------------------------------


@final
@dataclass(frozen=True)
class Equivalence:
    """How much of what a curve over its own variable explains a name misses.

    Attributes
    ----------
    share_missed, stderr : float
        Share of the explained squares.
    sentence : str
        "NAME"; "like NAME, which explains 97 %"; or that it is not the name.
    curve : Curve or None
        The curve beside the name, where it certainly gains.
    own : bool
        False where the law is no curve over one variable: the best curve of any may then show
        something else that is missing beside it.
    beaten : bool
        True where a law of one term does the work of the names as well, a curve beside them is
        better, or more than one name of one variable share the work of a curve that is simpler.
    """

    share_missed: float
    stderr: float
    sentence: str
    curve: Curve | None = None
    beaten: bool = False
    own: bool = True

    @property
    def is_name(self) -> bool:
        """True where the name is shown to be as good as the curve, and nothing shows that it is
        not.
        """
        if not self.own:
            return not self.is_wrong
        small = self.share_missed + ONE_SIDED * self.stderr < EQUIVALENT
        return small and not self.beaten and self.curve is None

    @property
    def is_wrong(self) -> bool:
        """True where the curve shows that the law is another one."""
        return self.curve is not None and self.share_missed > (ALIKE if self.own else HALF)

    def as_json(self) -> dict[str, Any]:
        """As data."""
        return {"share_missed": self.share_missed, "stderr": self.stderr, "sentence": self.sentence}


def equivalence(claim: Claim, solution: Solution, data: Dataset) -> Equivalence | None:
    """The name of a claim against the best curve over the variables that its law reads; None where
    the effect is not in the model, or no curve can be held against it.
    """
    return equivalences([claim], solution, data).get(claim.label)


def equivalences(
    claims: Sequence[Claim], solution: Solution, data: Dataset
) -> dict[str, Equivalence]:
    """The names of claims against the best curves over the variables that their laws read.

    A test that merely fails to reject a name has no power: the share that the name misses, with its
    error, must be shown to be small. Names of one variable are held against its curve together: a
    sum of laws must also need far fewer numbers than the curve.

    Parameters
    ----------
    claims : sequence of Claim
        Those whose effect hardly a joint is without, or that is not in the model, are left out.
    solution : Solution
        Fit of the model with all of them.
    data : Dataset

    Returns
    -------
    dict of label to Equivalence
    """
    places = {t.label: t.place for t in solution.model.terms}
    groups: dict[tuple[str, str, str], list[Claim]] = {}
    for c in claims:
        if c.label in places and c.effect.stage == "law" and not c.effect.common:
            over = variable_of(c.effect)
            mark = (places[c.label], over or c.label, c.balance)
            groups.setdefault(mark, []).append(c)
    if not groups:
        return {}
    base = make_base(solution, data)
    named, moving = steadily_moving(base), None
    out: dict[str, Equivalence] = {}
    for (place, _, balance), group in groups.items():
        found = _held_against(group, place, balance, named)
        if found is not None and not found.is_name:
            # a joint that settles has less friction than its level, whatever the law: what such
            # rows alone say against a name says nothing
            moving = moving or steadily_moving(base, creeping=False)
            faster = _held_against(group, place, balance, moving)
            found = faster if faster is not None and (faster.is_name or found.is_wrong) else found
        if found is not None:
            out |= {c.label: found for c in group}
    for (place, _, balance), group in groups.items():
        said = out.get(group[0].label)
        if said is not None and said.own and not said.is_name:
            beside = [
                c
                for c in claims
                if c.balance == balance and c.label in places and c not in group
                if not c.effect.common and (c.label not in out or out[c.label].is_name)
            ]
            out |= _parts_of_it(group, beside, (place, balance), named)
    return out


def _parts_of_it(
    group: Sequence[Claim], beside: Sequence[Claim], where: tuple[str, str], named: Base
) -> dict[str, Equivalence]:
    """Names that are asked for beside others which are no more than like a law, and not beside the
    curve of the variable of these: both may be parts of that law.
    """
    balance, labels = where[1], {c.label for c in group}
    own = _own(group, *where)
    out: dict[str, Equivalence] = {}
    for c in beside:
        with_it = curves_on(lacking(named, labels), balance, own, most=1, certain=False)
        without = curves_on(lacking(named, labels | {c.label}), balance, own, most=1, certain=False)
        found = gain(without.after, with_it.after)
        if with_it.curves and found.t < LEAST_T:
            over = variable_of(group[0].effect).replace("_", " ")
            said = f"{c.effect.title} or a part of one law of the {over}"
            out[c.label] = Equivalence(1 - found.fall, 0.0, said, beaten=True)
    return out


def _own(group: Sequence[Claim], place: str, balance: str) -> Callable[[Candidate], bool]:
    """Which tables are over the variable of names, or over any where they have none."""
    over = variable_of(group[0].effect)
    one_balance = balance in ("axis", "sum")

    def own(candidate: Candidate) -> bool:
        table = candidate.effect.table
        if table is None or not (one_balance or candidate.place == place):
            return False
        return not over or table.over == over

    return own


def variable_of(effect: Effect) -> str:
    """The variable over which a law is a curve; empty where it is none of one variable: friction
    that changes with temperature follows no curve over velocity.
    """
    if effect.memory is not None:
        return ""
    read = effect.reads - {"direction"}
    if len(read) == 1 and read <= {t.over for t in _tables()}:
        return next(iter(read))
    return "velocity" if effect.reads == {"direction"} else ""


def _tables() -> list[Table]:
    return [e.table for e in EFFECTS.values() if e.table is not None]


def _held_against(
    group: Sequence[Claim], place: str, balance: str, named: Base
) -> Equivalence | None:
    over, own = variable_of(group[0].effect), _own(group, place, balance)
    beside = curves_on(named, balance, own, most=1, certain=False)
    if not beside.curves:
        return None
    bare = lacking(named, {c.label for c in group})
    title = " and ".join(c.effect.title for c in group)
    before, rows = squares_left(bare, balance), _rows(named, balance)
    found = replace(_missed(before, beside.before, beside.after, title, rows), own=bool(over))
    if beside.gain.is_certain:
        said = found.sentence if found.share_missed > ALIKE else _like(title, found.share_missed)
        found = replace(found, curve=beside.curves[0], sentence=said)
    if len(group) > 1 and over:
        alone = curves_on(bare, balance, own, most=1, certain=False).curves[0]
        labels = {c.label for c in group}
        names = {n for t in named.solution.model.terms if t.label in labels for n in t.names}
        if len(names & set(named.names)) > FEWER * alone.freedom:
            found = replace(found, beaten=True, sentence=_like(title, found.share_missed))
    if over and found.is_name and beside.gain.fall >= LEAST_FALL and beside.gain.t > ONE_SIDED:
        found = replace(found, beaten=True, sentence=_like(title, found.share_missed))
    if over and found.is_name:
        rival = one_term_squares(bare, balance, own)
        if rival is not None and _as_good(rival, beside.before, alone=len(group) == 1):
            found = replace(found, beaten=True, sentence=f"{title} or a law like it")
    return found


def _as_good(rival: FloatArray, name: FloatArray, *, alone: bool) -> bool:
    """Whether a law of one term takes the place of names: of one where it is better, of a sum of
    them where the sum is not certainly better, as a sum imitates any curve.
    """
    if alone:
        return gain(name, rival).t > ONE_SIDED
    return gain(rival, name).t < LEAST_T


def _rows(base: Base, balance: str) -> int:
    where = base.balances.index(balance)
    return int(np.count_nonzero((base.block >= 0) & (base.balance == where)))


def _missed(
    before: FloatArray, name: FloatArray, curve: FloatArray, title: str, rows: int
) -> Equivalence:
    """From cross-validated squares of the blocks: of the base, with the name, and with the
    curve beside it.
    """
    explained = max(float(before.sum() - min(curve.sum(), name.sum())), 1e-300)
    share = min(max(float(name.sum() - curve.sum()), 0.0) / explained, 1.0)
    found: Gain = gain(name, curve)
    least = LEAST_ERROR * float(name.sum()) / (rows / OVERLAP) / explained
    stderr = max(share / found.t if found.t > 0 else 0.0, least)
    sentence = _like(title, share)
    if share + ONE_SIDED * stderr < EQUIVALENT:
        sentence = title
    elif share - ONE_SIDED * stderr < EQUIVALENT:
        sentence = f"{title} or a law like it"
    elif share - ONE_SIDED * stderr > ALIKE:
        sentence = (
            f"not {title}, which explains {100 * (1 - share):.3g} % of what a curve over its own "
            "variable does"
        )
    return Equivalence(share, stderr, sentence)


def _like(title: str, share: float) -> str:
    return f"like {title}, which explains {100 * (1 - share):.3g} %"


# --- what forbids "complete" ----------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Doubt:
    """A parameter that cannot be that of its law.

    Attributes
    ----------
    place : str
        Where its law acts; empty where it is no law's.
    sentence : str
    """

    place: str
    sentence: str


def artefacts(
    solution: Solution,
    data: Dataset,
    curves: Sequence[Curve] = (),
    start: Solution | None = None,
) -> tuple[Doubt, ...]:
    """Reasons why the parameters of a model cannot be those of its laws: any of them forbids
    ``complete``.

    Parameters
    ----------
    solution : Solution
    data : Dataset
    curves : sequence of Curve
        From :func:`identification.diagnosis.curve.find_curves` on the same model.
    start : Solution, optional
        Fit of the model before anything was added.

    Returns
    -------
    tuple of Doubt
        An amplitude that its bound holds back by more than `OUTSIDE` errors, or that was there by
        as much before the additions and has gone to its bound with them, which chance does to
        `BY_CHANCE` of those so large; dry friction that lies `OUTSIDE` errors from a curve over
        velocity at zero speed. A bare sign does not tell: the fit without the true law gives a
        positive Coulomb torque where there is none.
    """
    stands = at_bounds(solution, data)
    gone = _gone(solution, stands, start)
    named = {d.sentence.partition(" ")[0] for d in gone}
    held = [d for d in _held_back(solution, stands) if d.sentence.partition(" ")[0] not in named]
    return (*gone, *held, *_no_dry_friction(solution, curves))


@final
@dataclass(frozen=True)
class AtBound:
    """What the training rows say of an amplitude that stands at its bound.

    Attributes
    ----------
    wanted : float
        By how much it would move into its range if it had no bound; negative: out of it.
    error : float
    room : float
        Amplitude at which its law has all the torque that was measured: farther out a step means
        nothing, and a linear model of the rows holds nothing.
    """

    wanted: float
    error: float
    room: float

    @property
    def beyond(self) -> float:
        """Standard errors by which the rows would gain outside the bound, no farther than
        `room`.
        """
        out = min(max(-self.wanted, 0.0), self.room)
        return float(np.sqrt(max(out * (-2.0 * self.wanted - out), 0.0)) / self.error)

    def suspicious(self, before: float) -> bool:
        """Whether an amplitude that lies anywhere up to `before` inside its range would hardly
        come to stand at its bound by chance.
        """
        lost = before * (before - 2.0 * max(self.wanted, -self.room))
        return bool(lost > (self.error / (np.sqrt(2.0 * np.pi) * BY_CHANCE)) ** 2)


def at_bounds(solution: Solution, data: Dataset) -> dict[str, AtBound]:
    """What the training rows say of each amplitude that stands at its bound, by name; nothing where
    there are too few of them for an error.
    """
    from scipy.sparse import hstack

    base = make_base(solution, data)
    count = base.inward.shape[1]
    if not count:
        return {}
    both = np.column_stack([base.jacobian, base.inward])
    windows = windows_over([w.time for w in data.train])
    errors = window_errors(both, base.residual, hstack([windows] * len(base.balances), "csr"))
    if errors is None:
        return {}
    step = np.linalg.lstsq(both, -base.residual, rcond=None)[0]
    loads = references(data, data.train)
    load = np.concatenate([loads[b] for b in base.balances]) * base.weight
    rooms = [float(np.linalg.norm(load[column != 0.0])) for column in base.inward.T]
    return {
        n: AtBound(float(d) / size, float(e) / size, room / size)
        for n, d, e, room, size in zip(
            base.inward_names,
            step[-count:],
            errors[-count:],
            rooms,
            np.abs(base.inward_norms),
            strict=True,
        )
    }


def _gone(solution: Solution, stands: Mapping[str, AtBound], start: Solution | None) -> list[Doubt]:
    out = []
    for name in solution.at_bound if start is not None else ():
        if start is None or _is_shape(solution, name) or name not in solution.free:
            continue
        before, error = start.values.get(name), start.stderr.get(name)
        if before is None or error is None or abs(before) <= OUTSIDE * error:
            continue
        # the value before held a part of what was missing: the true one may be any smaller one
        here = stands.get(name)
        if here is not None and not here.suspicious(abs(before - solution.values[name])):
            continue
        # it stands there by the noise that is taken off, and not by what the rows say
        if here is not None and here.wanted > here.error:
            continue
        out.append(
            Doubt(
                _place(solution, name),
                f"{name} was {before:.3g} before the additions and ends at its bound "
                f"({solution.values[name]:.3g}): they do its work, or another law does theirs",
            )
        )
    return out


def _held_back(solution: Solution, stands: Mapping[str, AtBound]) -> list[Doubt]:
    return [
        Doubt(
            _place(solution, name),
            f"{name} stands at its bound ({solution.values[name]:.3g}) and would pass it "
            f"by {here.beyond:.2g} standard errors: another law does its work",
        )
        for name, here in stands.items()
        if here.beyond > OUTSIDE
    ]


def _is_shape(solution: Solution, name: str) -> bool:
    return any(p.name == name and p.is_shape for p in solution.model.parameters)


def _place(solution: Solution, name: str) -> str:
    return next((t.place for t in solution.model.terms if name in t.names), "")


def _no_dry_friction(solution: Solution, curves: Sequence[Curve]) -> list[Doubt]:
    """Where dry friction is certainly not that of a curve over velocity, carried back to zero
    speed from where friction has reached its level: slower, the curve shows how it changes its
    sign.
    """
    out = {}
    for c in curves:
        table = EFFECTS[c.label.partition("@")[0]].table
        place = c.label.partition("@")[2]
        if table is None or not (table.of_speed and table.odd):
            continue
        torque = sticking_torque(solution.model, solution.values, place)
        widths = [solution.values[n] for n in solution.model.named("smoothing", place)]
        start = _start(c, TURN_WIDTHS * max(widths, default=0.0))
        if not torque or start is None:
            continue
        low, high = start
        if abs(torque - (low + high) / 2) > OUTSIDE / BAND * (high - low) / 2:
            out[place] = Doubt(
                place,
                f"the dry friction of the {place} side, {torque:.3g} {c.y_unit}, is an artefact: "
                f"the curve over velocity starts between {low:.3g} and {high:.3g} {c.y_unit}",
            )
    return list(out.values())


def _start(curve: Curve, slowest: float) -> tuple[float, float] | None:
    """Band of a curve over velocity at zero speed, carried on in a straight line from its first
    knot above `slowest` and one at twice that speed: neighbours hardly show a slope. Errors so far
    apart count as independent. None where the curve does not reach so far.
    """
    first = int(np.searchsorted(curve.x, slowest, side="right"))
    second = int(np.searchsorted(curve.x, 2.0 * curve.x[first])) if first < len(curve.x) else first
    if second >= len(curve.x) or second == first:
        return None
    near, far = curve.x[first], curve.x[second]
    share = near / (far - near)
    start = (1 + share) * curve.y[first] - share * curve.y[second]
    off = math.hypot(
        (1 + share) * (curve.high[first] - curve.low[first]) / 2,
        share * (curve.high[second] - curve.low[second]) / 2,
    )
    return float(start - off), float(start + off)


def marked(
    claim: Claim,
    solution: Solution,
    found: Equivalence | None,
    doubts: Sequence[Doubt],
) -> Claim:
    """The claim with what a curve over its own variable says of its name, and the parameters beside
    it.

    A friction law beside a base whose own friction has become impossible does the work of another
    one.
    """
    if len(claim.effects) > 1 or found is None:
        return claim
    if not found.is_name:
        return replace(claim, like=found.sentence)
    place = next((t.place for t in solution.model.terms if t.label == claim.label), "")
    if claim.effect.family == "friction" and any(d.place == place for d in doubts):
        return replace(claim, like=_like(claim.effect.title, found.share_missed))
    return claim
