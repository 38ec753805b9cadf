"""The run that separates: which recording would tell names apart that tie, and what it will say."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS
from identification.balance.balances import balances_of
from identification.balance.calibration import names_of_runs
from identification.balance.dataset import Dataset, without
from identification.balance.stacked import row_weights
from identification.balance.weak import WeakRecord
from identification.data.formats import words
from identification.diagnosis.claims import Claim
from identification.diagnosis.improvement import Improvement
from identification.fitting.covariance import correlations
from identification.fitting.engine import Solution, solve
from identification.fitting.information import form_of, information, white_errors
from identification.naming.contest import FEWEST, Contest, from_every_valley, rivals_of
from identification.naming.odds import unmodelled_by
from identification.planning.motion import Motion
from identification.planning.rivals import Foreseen, enough, power
from identification.planning.runs import (
    SIMULATED,
    Plant,
    Run,
    Workspace,
    candidate_runs,
    possible_loads,
    predicted,
    refuse_clamped,
    sigma_on,
    workspace_of,
)
from identification.planning.trajectories import Limits

FloatArray = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]

LENGTHS: Final = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0)
"""Lengths that are proposed [s]: the shortest that is enough, else the longest."""
KNOWN: Final = 0.1
"""Standard error over value from which a parameter counts as identified, as in `irj plan`."""
STOOD_IN: Final = 10.0
"""Standard error in units of the one with all others known from which others stand in for a
parameter."""
LITTLE: Final = 0.1
"""Log-likelihood below which a run says nothing about a name, however little it is [nats]."""
SHOWN: Final = 3
"""Runs that are shown for each set."""


@final
@dataclass(frozen=True)
class Proposal:
    """A run for one set of names.

    Attributes
    ----------
    separates : tuple of str
        Names of the set that still tie.
    run : Run
    seconds : float
        Its price.
    before, nats : float
        Smallest log-likelihood between two of these names on the records so far, and the one
        expected from the run.
    power : float
        Chance that the right name comes out ahead of its closest rival.
    means : mapping of str to str
        What a result says, by name.
    """

    separates: tuple[str, ...]
    run: Run
    seconds: float
    before: float
    nats: float
    power: float
    means: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        """The shape of `next --json`."""
        return {
            "separates": list(self.separates),
            "motion": self.run.family,
            "centre": self.run.centre,
            "half_travel": self.run.half,
            "speed": self.run.speed,
            "payload": self.run.payload,
            "seconds": self.seconds,
            "nats_before": self.before,
            "nats": self.nats,
            "power": self.power,
            "means": dict(self.means),
        }


@final
@dataclass(frozen=True)
class Sharpened:
    """A run for parameters that are not identifiable.

    Attributes
    ----------
    run : Run
    seconds : float
    errors : mapping of str to (float, float)
        Standard error over value now, and expected after the run.
    """

    run: Run
    seconds: float
    errors: Mapping[str, tuple[float, float]]

    def as_json(self) -> dict[str, Any]:
        """The shape of `next --json`."""
        return {
            "parameters": {
                n: {"relative_error": a, "after": b} for n, (a, b) in self.errors.items()
            },
            "motion": self.run.family,
            "centre": self.run.centre,
            "half_travel": self.run.half,
            "speed": self.run.speed,
            "payload": self.run.payload,
            "seconds": self.seconds,
        }


@final
@dataclass(frozen=True)
class NextRun:
    """What to record next.

    Attributes
    ----------
    proposals : tuple of Proposal
        Best first, at most `SHOWN` for each set.
    sharpened : Sharpened or None
        A run for the parameters that are not identifiable.
    told_apart : tuple of str
        Names of a set that the whole fits tell apart on the records so far, a sentence each.
    cannot : tuple of str
        What no motion separates, and what does.
    space : Workspace
    dt : float
        Sample time of the motion [s].
    unit : str
        Of positions: rad or m.
    """

    proposals: tuple[Proposal, ...]
    sharpened: Sharpened | None
    told_apart: tuple[str, ...]
    cannot: tuple[str, ...]
    space: Workspace
    dt: float
    unit: str

    @property
    def motion(self) -> Motion | None:
        """The first proposal as a reference to follow; None where no run is worth its time."""
        if self.proposals:
            first = self.proposals[0]
            return first.run.motion(first.seconds, self.dt)
        if self.sharpened is not None:
            return self.sharpened.run.motion(self.sharpened.seconds, self.dt)
        return None

    def as_json(self) -> dict[str, Any]:
        """The shape of `next --json`."""
        sets = dict.fromkeys(p.separates for p in self.proposals)
        return {
            "separates": [list(s) for s in sets],
            "runs": [p.as_json() for p in self.proposals],
            "parameters": self.sharpened.as_json() if self.sharpened else None,
            "told_apart": list(self.told_apart),
            "cannot": list(self.cannot),
            "limits": {
                "low": self.space.centre - self.space.half,
                "high": self.space.centre + self.space.half,
                "unit": self.unit,
                "torque": self.space.limits.torque,
                "source": self.space.source,
            },
        }

    def __str__(self) -> str:
        lines = []
        last: tuple[str, ...] = ()
        for p in self.proposals:
            if p.separates != last:
                lines.append(f"to tell apart: {', '.join(p.separates)}")
                lines.append(
                    f"  on the records so far the closest two are {p.before:.3g} nats apart"
                )
                best = True
            lines.append(
                f"  {'record' if best else 'or    '} {self._words(p.run, p.seconds)}: "
                f"{p.nats:.3g} nats expected between the closest two, right with "
                f"{100 * p.power:.0f} %"
            )
            if best:
                lines += [f"    {text}" for text in p.means.values()]
            last, best = p.separates, False
        if self.sharpened is not None:
            s = self.sharpened
            told = self._words(s.run, s.seconds)
            lines.append(f"for parameters that are not identifiable: {told}")
            lines += [
                f"    {n}: standard error {_percent(a)} of the value now, {_percent(b)} after"
                for n, (a, b) in s.errors.items()
            ]
        lines += [f"told apart already: {text}" for text in self.told_apart]
        lines += [f"no motion separates: {text}" for text in self.cannot]
        if not lines:
            lines.append("no names tie and every parameter is identifiable: no run is needed")
        return "\n".join(lines)

    def _words(self, run: Run, seconds: float) -> str:
        low, high = run.centre - run.half, run.centre + run.half
        return (
            f"{seconds:.0f} s of {run.family}, {low:.3g} to {high:.3g} {self.unit}, up to "
            f"{run.speed:.3g} {self.unit}/s, load {run.payload}"
        )

    def __repr__(self) -> str:
        return f"NextRun({len(self.proposals)} proposals, {len(self.cannot)} without a motion)"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if math.isfinite(share) else "unknown"


def next_run(
    found: Improvement,
    *,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> NextRun:
    """The run that would tell the names apart that tie, and sharpen what is not identifiable.

    Parameters
    ----------
    found : Improvement
        What `improve` said on the records so far.
    limits : Limits, optional
        What the joint may do; where nothing is said, what the records did.
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Records of a clamped link.
    """
    tell = progress or (lambda text, share: None)
    data = found.data
    refuse_clamped(data.sensing, data.train_names[0])
    space = workspace_of(data, limits)
    last = found.steps[-1].solution
    simulated = _Simulated(last, data, space)
    proposals: list[Proposal] = []
    told: list[str] = []
    cannot: list[str] = []
    sets = [c for c in found.claims if len(c.effects) > 1]
    for number, claim in enumerate(sets):
        tell(f"telling {words(claim.effects[0])} apart", 0.1 + 0.7 * number / len(sets))
        made, ready, never = _for_set(claim, last, data, simulated)
        proposals += made
        told += ready
        cannot += never
    tell("parameters that are not identifiable", 0.85)
    sharpened, lost = _for_parameters(last, data, simulated)
    return NextRun(
        tuple(proposals),
        sharpened,
        tuple(told),
        (*cannot, *lost),
        space=space,
        dt=data.train[0].grid.dt,
        unit="rad" if data.joint.kind == "rotary" else "m",
    )


@final
class _Simulated:
    """Candidate runs and their rows, simulated once by the model that all names have in common."""

    def __init__(self, solution: Solution, data: Dataset, space: Workspace) -> None:
        self._solution, self._data, self._space = solution, data, space
        self._rows: list[tuple[Run, WeakRecord]] | None = None

    def rows(self) -> list[tuple[Run, WeakRecord]]:
        """Runs that keep the limits, with the rows that they would give."""
        if self._rows is None:
            plant = Plant(self._solution.model, self._data.train[0].grid.dt)
            self._rows = []
            for run in candidate_runs(
                self._space, possible_loads(self._solution.model, self._data)
            ):
                followed = plant.run(run)
                if followed is not None and not self._space.broken(followed):
                    self._rows.append((run, predicted(followed, run, self._data)))
        return self._rows


def _for_set(
    claim: Claim, last: Solution, data: Dataset, simulated: _Simulated
) -> tuple[list[Proposal], list[str], list[str]]:
    """Proposals for one set, what is told apart already, what no motion separates."""
    start = solve(without(last.model, claim.label), data, start=last.values)
    rivals = rivals_of(claim.effects, claim.balance, start, data)
    if len(rivals) < 2:
        return [], [], []
    contest = Contest(from_every_valley(rivals, start, data), data)
    allowance = unmodelled_by(contest, claim.balance)
    alive = contest.alive(allowance)
    told = [
        f"{contest.leader.name} fits better than {rival.name} by {nats:.3g} nats over blocks "
        f"(deviate {deviate:.2g})"
        for rival, (nats, deviate) in zip(contest.rivals, contest.ahead, strict=True)
        if rival not in alive
    ]
    if len(alive) < 2:
        return [], told, []
    runs = simulated.rows()
    if not runs:
        listed = " / ".join(r.name for r in alive)
        return [], told, [f"{listed}: no motion keeps the limits; widen them"]
    contest = Contest(alive, data)
    foreseen = Foreseen(contest)
    apart = [foreseen.distances(rows) for _, rows in runs]
    simple, same = _one_law(contest, _most(apart))
    told += same
    kept = [k for k, r in enumerate(contest.rivals) if r.name in simple]
    if len(kept) < 2:
        return [], told, []
    behind = contest.ahead[kept, 0]
    apart = [a[np.ix_(kept, kept)] for a in apart]
    names = tuple(contest.rivals[k].name for k in kept)
    most = _most(apart)
    never = _stuck(names, most)
    # what no motion separates is no reason to choose one
    counted = [np.where(most < FEWEST, math.inf, a) for a in apart]
    scored = [(c, run, a) for c, (run, _), a in zip(counted, runs, apart, strict=True)]
    scored = sorted((s for s in scored if np.isfinite(s[0]).any()), key=lambda s: -worth(s[0]))
    before = min(abs(float(behind[i] - behind[j])) for i in range(len(kept)) for j in range(i))
    return [_proposal(names, one, before, most) for one in scored[:SHOWN]], told, never


def _most(apart: Sequence[FloatArray]) -> FloatArray:
    """The best that any run could do for each pair in the longest time, whichever name is true."""
    return np.asarray(np.max([np.minimum(a, a.T) for a in apart], axis=0) * LENGTHS[-1] / SIMULATED)


def _one_law(contest: Contest, most: FloatArray) -> tuple[set[str], list[str]]:
    """Names without those that, as fitted, are a simpler one on every motion: parameters that
    change nothing are no name.
    """
    kept, told = {r.name for r in contest.rivals}, []
    counts = [len(contest.free(r)) for r in contest.rivals]
    for i, rival in enumerate(contest.rivals):
        for j, simpler in enumerate(contest.rivals):
            if counts[j] < counts[i] and most[i, j] < FEWEST and rival.name in kept:
                kept.discard(rival.name)
                told.append(
                    f"{rival.name} as fitted is {simpler.name} on every motion that was tried; the "
                    "name with fewer parameters stands"
                )
    return kept, told


def worth(apart: FloatArray) -> float:
    """What a run is chosen by: mean over the names, each taken to be true, of the logarithm of how
    far the closest other comes out behind.

    The smallest difference alone would choose a run that tells little whichever name is true over
    one that tells a hundred times as much of all names but one.

    Parameters
    ----------
    apart : (names, names) array
        Expected log-likelihood differences, infinite for pairs that do not count [nats].
    """
    closest = apart.min(axis=1)
    counted = closest[np.isfinite(closest)]
    return float(np.mean(np.log(np.maximum(counted, LITTLE)))) if len(counted) else -math.inf


def _proposal(
    names: tuple[str, ...],
    scored: tuple[FloatArray, Run, FloatArray],
    before: float,
    most: FloatArray,
) -> Proposal:
    counted, run, apart = scored
    least = float(counted.min())
    seconds = next((t for t in LENGTHS if least * t / SIMULATED >= enough()), LENGTHS[-1])
    scale = seconds / SIMULATED
    return Proposal(
        names,
        run,
        seconds,
        before,
        nats=least * scale,
        power=power(least * scale),
        means=MappingProxyType(_meanings(names, np.where(most < FEWEST, math.inf, apart) * scale)),
    )


def _stuck(names: Sequence[str], most: FloatArray) -> list[str]:
    """Pairs that no run within the longest time separates, and what does."""
    out = []
    for i in range(len(names)):
        for j in range(i):
            if most[i, j] < FEWEST:
                hints = [EFFECTS[names[k]].told_by for k in (j, i)]
                hint = next((h for h in hints if h), "a value known beforehand for one of them")
                out.append(f"{names[j]} from {names[i]}; what does: {hint}")
    return out


def _meanings(names: Sequence[str], apart: FloatArray) -> dict[str, str]:
    """What each result would mean."""
    out = {}
    for i, name in enumerate(names):
        j = int(np.argmin(apart[i]))
        if not math.isfinite(apart[i, j]):
            continue
        more = ", and of the others by more" if len(names) > 2 else ""
        out[name] = (
            f"where {words(name)} is true, its fit comes out ahead of {words(names[j])} by about "
            f"{apart[i, j]:.2g} nats{more}"
        )
    return out


def _for_parameters(
    solution: Solution, data: Dataset, simulated: _Simulated
) -> tuple[Sharpened | None, list[str]]:
    """A run for the parameters of the final model that these records do not identify."""
    nuisance = set(solution.model.named("smoothing")) | {
        p.name for p in solution.model.parameters if p.name in solution.model.calibration
    }
    free = tuple(n for n in solution.free if n not in solution.at_bound)
    form = form_of(solution, data, free, solution.weights)
    old = information(form, len(free), measured=True)
    spread = dict(zip(free, correlations(old)[0], strict=True))
    # an amplitude near zero is known to be near zero: only what others stand in for is to plan
    # for, and what a joint has for certain
    certain = solution.model.named("inertia")
    wanted = [
        n
        for n in solution.unidentified
        if n in free and n not in nuisance and (spread[n] > STOOD_IN or n in certain)
    ]
    if not wanted:
        return None, []
    now = _relative(old, free, solution.values)
    for n in wanted:  # windows of time know more than rows of known noise
        error = solution.stderr.get(n)
        if error is not None and solution.values[n]:
            now[n] = max(now[n], error / abs(solution.values[n]))
    best: tuple[float, Run, dict[str, float], float] | None = None
    for run, rows in simulated.rows():
        new = replace(data, train=(rows,), held_out=())
        values = {**solution.values, **dict.fromkeys(names_of_runs(solution.model, [rows]), 0.0)}
        balances = balances_of(solution.model, new.sensing, wrt=())
        sigma = sigma_on(rows, solution, data, values)
        weights = row_weights(balances, new, values, sigma, [rows])
        planned = form_of(solution, new, free, weights, values)
        more = information(planned, len(free), measured=True)
        for seconds in LENGTHS:
            after = _relative(old + more * seconds / SIMULATED, free, solution.values)
            worst = max(after[n] for n in wanted)
            if worst <= KNOWN or seconds == LENGTHS[-1]:
                break
        rank = (max(worst, KNOWN), seconds, worst)
        if best is None or rank < (max(best[0], KNOWN), best[3], best[0]):
            best = (worst, run, after, seconds)
    if best is None:
        return None, [f"{', '.join(wanted)}: no motion keeps the limits; widen them"]
    worst, run, after, seconds = best
    lost = [
        f"{n} stays at {_percent(after[n])} of its value after the best motion; give it a known "
        "value"
        for n in wanted
        if after[n] > 1.0
    ]
    left = {n: (now[n], after[n]) for n in wanted if after[n] <= 1.0}
    return (Sharpened(run, seconds, MappingProxyType(left)) if left else None), lost


def _relative(
    gram: FloatArray, free: Sequence[str], values: Mapping[str, float]
) -> dict[str, float]:
    """Standard error over value; infinite where nothing is known."""
    return {
        n: float(error / abs(values[n])) if values[n] else math.inf
        for n, error in zip(free, white_errors(gram), strict=True)
    }
