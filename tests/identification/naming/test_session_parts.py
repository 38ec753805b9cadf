"""What a session decides where it is known what every model leaves and what every trial says.

A :class:`World` has parts of a missing torque, each with its power, and names that explain a share
of each. What is left after whole fits follows from these by sums of squares, and so does what the
session must end with.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from casadi_models import EFFECTS, JointModel
from identification.data.joint_file import Joint
from identification.diagnosis.bench import Progress
from identification.diagnosis.candidates import NotTestable, offered
from identification.diagnosis.claims import LARGEST_SET, Claim, Ranking, outvoted
from identification.diagnosis.curve import Curve
from identification.diagnosis.improvement import Improvement, Step, made_worse
from identification.diagnosis.learned import Doubt, Equivalence
from identification.diagnosis.locate import Unexplained
from identification.diagnosis.outcome import key_of
from identification.diagnosis.session import Session, _behind, _Standing
from identification.diagnosis.trials import Base, Trial, make_base
from identification.fitting.assess import RATIO_LIMIT, BalanceError, Error
from identification.fitting.engine import Solution, load_dataset, prepared_model, solve
from identification.naming.contest import Rival
from identification.naming.odds import Odds
from tests.smooth_laws import nothing, record

Shares = Mapping[str, float]
"""Share of each part of the missing torque that a name explains."""
JOINT = Joint(model_name="hd1", effects=("viscous", "coulomb"))


@pytest.fixture(scope="module")
def base() -> Base:
    runs = [record(np.random.default_rng(k), 4.0, nothing) for k in (0, 1)]
    model = prepared_model(JOINT, runs[0])
    data = load_dataset(runs[:1], runs[1:], JOINT, model)
    return make_base(solve(model, data), data)


@dataclass
class World:
    """A bench that knows the truth.

    Attributes
    ----------
    hidden : mapping of str to float
        Mean square of each part of the missing torque, noise is 1; "part@link" is one in the
        balance of the link.
    explains : mapping of str to mapping
        What whole fits of each name explain.
    first : mapping of str to mapping
        What its trial on the start model seems to explain, where that is something else.
    early : mapping of str to mapping
        The same beside one claim.
    late_seen : mapping of str to mapping
        The same beside more.
    falls : mapping of str to float
        Fall on held-out records that its linear trial seems to bring [%].
    unit : float
        Torque of the noise [N.m].
    rows : float
        Independent ones.
    late : set of str
        Names that cannot be tested on the start model.
    curves, doubts : tuple
        What is learned of what is left; why parameters cannot be those of their laws.
    steady : bool
        Whether small effects have one sign at every kernel.
    turned : set of str
        Names whose candidates come with the law of the motion turned round.
    without : str
        Label of the start model that it lacks here.
    located : float
        Share of what is left that one variable holds [%].
    wrong : mapping of str to Equivalence
        Labels that a curve is held against.
    undone : mapping of set to float
        Share of what these names leave that curves beside them cannot explain.
    chances : callable
        Odds of the names of a claim.
    longer : mapping of float to World
        What rows of so many times the length show.
    form : bool, optional
        Whether a kinematic error does virtual work, as the rows have it beside all that is missing.
    """

    based: Base
    hidden: Mapping[str, float]
    explains: Mapping[str, Shares]
    first: Mapping[str, Shares] = field(default_factory=dict)
    early: Mapping[str, Shares] = field(default_factory=dict)
    late_seen: Mapping[str, Shares] = field(default_factory=dict)
    falls: Mapping[str, float] = field(default_factory=dict)
    unit: float = 1.0
    rows: float = 100.0
    late: frozenset[str] = frozenset()
    curves: tuple[Any, ...] = ()
    doubts: tuple[Doubt, ...] = ()
    steady: bool = True
    turned: frozenset[str] = frozenset()
    without: str = ""
    located: float = 0.0
    wrong: Mapping[str, Equivalence] = field(default_factory=dict)
    undone: Mapping[frozenset[str], float] = field(default_factory=dict)
    chances: Callable[[Claim, Step], Odds | None] = lambda claim, now: None
    longer: Mapping[float, World] = field(default_factory=dict)
    form: bool | None = None
    asked: list[tuple[frozenset[str], bool]] = field(default_factory=list)
    fitted_whole: list[str] = field(default_factory=list)
    doubted: list[tuple[int, tuple[Curve, ...], int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        data = self.based.data
        self.joint = data.joint
        self.data = replace(data, sensing=replace(data.sensing, balances=tuple(self.rms())))
        if self.without:
            solution = self.based.solution
            smaller = replace(solution, model=solution.model.drop(self.without))
            self.based = replace(self.based, solution=smaller)

    def names(self, model: JointModel) -> frozenset[str]:
        """Keys that the model has beside those of the start model."""
        own = self.based.solution.model.effects
        return frozenset(key_of(label) for label in model.effects if label not in own)

    def rms(self, *laws: Shares) -> dict[str, float]:
        """What noise and the parts leave of each balance beside these laws, the best of them for
        each part.
        """
        square = {"axis": 1.0} | {p.partition("@")[2] or "axis": 1.0 for p in self.hidden}
        for part, power in self.hidden.items():
            share = max((law.get(part, 0.0) for law in laws), default=0.0)
            square[part.partition("@")[2] or "axis"] += power * (1 - share)
        return {b: self.unit * math.sqrt(x) for b, x in square.items()}

    def start(self) -> Solution:
        return self.based.solution

    def fitted(
        self, model: JointModel, start: Mapping[str, float], *, again: bool = False
    ) -> Solution:
        values = {p.name: start.get(p.name, p.start) for p in model.parameters}
        return replace(self.based.solution, model=model, values=values)

    def step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        there = self.names(solution.model)
        rms = self.rms(*(self.explains[n] for n in there))
        left = {b: BalanceError(x, self.unit, x / self.unit, "N.m") for b, x in rms.items()}
        error = Error(sum(e.ratio for e in left.values()), 0.0, 0.0, left)
        return Step(key, tuple(sorted(there)), error, error, solution, label)

    def added(self, trial: Trial, now: Step) -> Step:
        self.fitted_whole.append(trial.key)
        solution = self.fitted(trial.candidate.model, {**now.solution.values, **trial.values})
        return self.step(trial.key, trial.candidate.label, solution)

    def base(self, solution: Solution) -> Base:
        return replace(self.based, solution=solution)

    def ranking(
        self, base: Base, *, late: bool = False, progress: Progress | None = None
    ) -> Ranking:
        model = base.solution.model
        there = self.names(model)
        self.asked.append((there, late))
        for share in (0.0, 1.0) if progress else ():
            assert progress is not None
            progress("trying", share)
        trials = []
        inside = [self.explains[n] for n in there]
        every = {c.effect.key: c for c in reversed(offered(model, self.data, late=late)[0])}
        for key, c in every.items():
            if key not in self.explains or (key in self.late and not there):
                continue
            seems = (self.first, self.early, self.late_seen)[min(len(there), 2)]
            law = seems.get(key, self.explains[key])
            before, after = self.rms(*inside), self.rms(*inside, law)
            balance = max(before, key=lambda b: before[b] / after[b])
            score = self.rows * sum(math.log(before[b] / after[b]) for b in before)
            fall = 100 * (1 - after[balance] / before[balance])
            if key in self.turned:
                c = replace(c, model=replace(c.model, virtual_work=False))
            trials.append(
                Trial(
                    c,
                    dict.fromkeys((*c.amplitudes, *c.shapes), 1.0),
                    balance=balance,
                    gain=score,
                    cv_drop_percent=fall,
                    held_out_drop_percent=fall if there else self.falls.get(key, fall),
                    p_value=math.exp(-3 * score),
                    block_score=np.full(self.based.blocks, score / self.based.blocks),
                    rms=np.array([*after.values()]) / self.unit,
                    outside=1.0,
                    contribution=1.0,
                    score=score,
                )
            )
        trials.sort(key=lambda t: -t.score)
        significant = frozenset(
            t.candidate.label
            for t in trials
            if t.cv_drop_percent >= 10 and t.held_out_drop_percent >= 5
        )
        order = sorted(trials, key=lambda t: (t.candidate.label not in significant, -t.score))
        unseen = () if there else tuple(NotTestable(n, "not yet") for n in sorted(self.late))
        return Ranking(tuple(order), significant, unseen, tuple(trials))

    def tried(self, solution: Solution) -> list[str]:
        return list(self.explains)

    def ratios(self, step: Step) -> dict[str, BalanceError]:
        return dict(step.held_out.balances)

    def shown(self, step: Step) -> Step:
        return step

    def places(self, step: Step, error: Error, *_: object) -> list[Unexplained]:
        over = [b for b, e in error.balances.items() if e.ratio > RATIO_LIMIT]
        return [Unexplained(b, self.located, axis="motor_position") for b in over]

    def odds(self, claim: Claim, near: Shares, now: Step, last: Ranking) -> Odds | None:
        return self.chances(claim, now)

    def held_against(self, claims: Sequence[Claim], step: Step) -> Mapping[str, Equivalence]:
        return {c.label: self.wrong[c.label] for c in claims if c.label in self.wrong}

    def listen(self, step: Step) -> None: ...

    def lines(self, step: Step) -> list[Any]:
        return [f"line beside {len(step.effects)}"]

    def learned(self, step: Step, error: Error) -> tuple[Any, ...]:
        return self.curves

    def ratios_with(self, step: Step, learned: Sequence[Any]) -> dict[str, BalanceError]:
        left = self.ratios(step)
        if not learned:
            return left
        share = self.undone.get(self.names(step.solution.model), 0.0)
        part = {b: e.ratio**2 - 1 for b, e in left.items()}
        return {b: replace(e, ratio=math.sqrt(1 + share * part[b])) for b, e in left.items()}

    def curved(self, step: Step, learned: Sequence[Any]) -> tuple[tuple[Any, ...], None]:
        return tuple(learned), None

    def artefacts(self, step: Step, curves: Sequence[Curve], start: Step) -> tuple[Doubt, ...]:
        self.doubted.append((len(step.effects), tuple(curves), len(start.effects)))
        return self.doubts

    def same_sign(self, trial: Trial, solution: Solution) -> bool:
        return self.steady

    def slower(self, factor: float) -> World | None:
        return self.longer.get(factor)

    def slow_noise(self, step: Step) -> dict[str, Any]:
        return {}

    def beside(self, step: Step, slow: Mapping[str, Any]) -> Error:
        return step.held_out

    def left_open(self, step: Step) -> dict[str, Any]:
        return {}

    def other_form(self, step: Step) -> Step | None:
        model = step.solution.model
        # which form it is shows beside a second name only
        if self.form is None or self.form == model.virtual_work or len(step.effects) < 2:
            return None
        turned = replace(step.solution, model=replace(model, virtual_work=self.form))
        return self.step(step.added, step.label, turned)


def ended(world: World, most: int = 6) -> Improvement:
    return Session(world).run(world.start(), most)


def named(found: Improvement) -> list[str]:
    """The first name of each claim; each has its step."""
    assert [s.added for s in found.steps[1:]] == [c.effects[0] for c in found.claims]
    for before, after, claim in zip(found.steps, found.steps[1:], found.claims, strict=False):
        old, new = (s.held_out.balances[claim.balance].rms for s in (before, after))
        assert claim.held_out_drop_percent == pytest.approx(100 * (1 - new / old))
    return [c.effects[0] for c in found.claims]


# --- sets that are no answer ----------------------------------------------------------------------

MANY = ("asymmetric_coulomb", "current_offset", "cyclic_friction", "stribeck", "lugre")
"""Laws of which here each explains the same."""


def test_names_of_which_there_are_too_many_are_set_aside_and_others_are_not(base: Base) -> None:
    alike = dict.fromkeys(MANY, {"p": 1.0})
    assert len(alike) > LARGEST_SET
    world = World(
        base,
        {"p": 24.0, "q@link": 8.0},
        {**alike, "quadratic_drag": {"q@link": 1.0}, "gravity": {}},
    )
    found = ended(world)
    assert named(found) == ["quadratic_drag"]
    assert found.verdict == "unexplained"
    assert all(EFFECTS[name].title in found.reason for name in MANY)
    assert "cannot be named" in found.reason
    for name in MANY:
        assert "one of 5 names that explain the same" in found.why(name)
    assert "one of" not in found.why("gravity")


@pytest.mark.parametrize("left", [2, len(MANY)])
def test_whole_fits_are_asked_before_names_are_set_aside(left: int, base: Base) -> None:
    chances = dict.fromkeys(MANY[-left:], 1.0 / left)
    odds = lambda claim, now: told(now, chances, {"lugre@motor": "is far behind"})  # noqa: E731
    world = World(base, {"p": 24.0}, dict.fromkeys(MANY, {"p": 1.0}), chances=odds)
    found = ended(world)
    if left == 2:
        (claim,) = found.claims
        assert {*claim.effects} == {*chances}
    else:
        assert not found.claims
        assert "cannot be named" in found.reason


def test_a_claim_of_which_whole_fits_leave_too_many_names_is_none(base: Base) -> None:
    """However few its trials had left; what another balance holds is claimed beside it."""
    crowd = {"cubic_viscous": 0.4, "cyclic_torque": 0.3, **dict.fromkeys(MANY[:3], 0.1)}
    odds = lambda claim, now: told(now, crowd, {}) if claim.balance == "axis" else None  # noqa: E731
    laws = {"cubic_viscous": {"p": 1.0}, "quadratic_drag": {"q@link": 1.0}}
    found = ended(World(base, {"p": 24.0, "q@link": 8.0}, laws, chances=odds))
    assert named(found) == ["quadratic_drag"]
    assert found.verdict == "unexplained"
    assert "cannot be named" in found.reason
    assert all(EFFECTS[name].title in found.reason for name in crowd)
    assert "one of 5 names that explain the same" in found.why("cubic_viscous")


def test_names_may_be_many_where_a_claim_needs_the_first(base: Base) -> None:
    crowd = {"coulomb": 0.4, "cyclic_torque": 0.3, **dict.fromkeys(MANY[:3], 0.1)}
    odds = lambda claim, now: (  # noqa: E731
        told(now, crowd, {}) if claim.effects[0] == "coulomb" else None
    )
    laws = {"coulomb": {"p": 0.9}, "stribeck": {"p": 1.0, "q": 1.0}}
    world = World(base, {"p": 24.0, "q": 8.0}, laws, chances=odds, without="coulomb@motor")
    assert named(ended(world)) == ["coulomb", "stribeck"]


def test_a_set_of_too_many_is_forgotten_where_a_later_law_takes_its_work_along(base: Base) -> None:
    alike = dict.fromkeys(MANY, {"p": 1.0})
    world = World(
        base,
        {"p": 24.0, "q@link": 8.0},
        {**alike, "quadratic_drag": {"p": 1.0, "q@link": 1.0}},
        first={"quadratic_drag": {"q@link": 1.0}},
    )
    for found in (ended(world), Session(world).diagnose(world.start())):
        assert named(found) == ["quadratic_drag"]
        assert found.verdict == "complete"
        assert "cannot be named" not in found.reason


# --- rows of a longer kernel ----------------------------------------------------------------------

NOTHING: dict[str, Shares] = {"quadratic_drag": {}, "gravity": {}}
HIDDEN_BY_NOISE = 0.1
"""Power of a part that stands in the noise of short rows: they fall by 5 %."""


@pytest.mark.parametrize(
    ("short", "shown"),
    [
        ({}, True),
        ({"q@link": 8.0}, True),
        ({"q": 8.0}, False),
    ],
    ids=["nothing beside it", "structure elsewhere", "structure beside it"],
)
def test_longer_rows_tell_what_the_noise_of_short_ones_hides(
    short: Shares, shown: bool, base: Base
) -> None:
    """Where short rows stand over their floor themselves it is no noise that hides a name."""
    laws: dict[str, Shares] = {"quadratic_drag": {"p": 1.0}}
    length, quiet = 0.24, World(base, {"p": HIDDEN_BY_NOISE}, laws)
    long = World(base, {"p": 8.0, **short}, laws)
    (w,) = long.data.train
    long.data = replace(long.data, train=(replace(w, grid=replace(w.grid, length=length)),))
    world = World(base, {"p": HIDDEN_BY_NOISE, **short}, laws, longer={2.0: quiet, 4.0: long})
    found = ended(world)
    if not shown:
        assert not found.claims
        assert not long.asked, "a search that nothing asks for costs its time"
        return
    (claim,) = found.claims
    assert claim.effects == ("quadratic_drag",)
    assert claim.kernel == length
    assert found.verdict == ("unexplained" if short else "complete")


@pytest.mark.parametrize(
    ("longest", "names", "length"),
    [
        ({"quadratic_drag": {"p": 1.0}, "gravity": {"p": 0.5}}, {"quadratic_drag"}, 0.24),
        ({**NOTHING, "stribeck": {"p": 1.0}}, {"quadratic_drag", "gravity"}, 0.12),
        (NOTHING, {"quadratic_drag", "gravity"}, 0.12),
    ],
    ids=["told apart there", "another name there", "no name there"],
)
def test_a_set_of_longer_rows_is_asked_on_still_longer_ones(
    longest: dict[str, Shares], names: set[str], length: float, base: Base
) -> None:
    alike: dict[str, Shares] = {"quadratic_drag": {"p": 1.0}, "gravity": {"p": 1.0}}
    laws = {"stribeck": {}, **alike}
    worlds = {}
    for factor, there in ((2.0, laws), (4.0, longest)):
        long = worlds[factor] = World(base, {"p": 8.0}, there)
        (w,) = long.data.train
        long.data = replace(
            long.data, train=(replace(w, grid=replace(w.grid, length=0.06 * factor)),)
        )
    found = ended(World(base, {"p": HIDDEN_BY_NOISE}, laws, longer=worlds))
    claim = found.claims[0]
    assert set(claim.effects) == names
    assert claim.kernel == length


@pytest.mark.parametrize(("beside", "partial"), [(0.0, False), (5.0, False), (30.0, True)])
def test_a_name_is_one_in_part_where_longer_rows_show_more_than_it_explains(
    beside: float, partial: bool, base: Base
) -> None:
    """Short rows have noise in the place of both, and nothing in them says so."""
    laws: dict[str, Shares] = {"quadratic_drag": {"p": 1.0}}
    hidden = {"p": HIDDEN_BY_NOISE, "q": beside / 40}
    quiet, shown = (World(base, h, laws) for h in (hidden, {"p": 8.0, "q": beside}))
    longer = {2.0: quiet, 4.0: shown}
    found = ended(World(base, hidden, laws, longer=longer))
    (claim,) = found.claims
    assert claim.partial == partial
    assert found.verdict == "complete"
    assert ("Missing: quadratic drag" in found.reason) != partial
    assert (
        "Only part of what such rows show is explained by: quadratic" in found.reason
    ) == partial
    assert found.outcome == ("complete" if partial else "found")


def test_a_name_of_longer_rows_that_the_fit_leaves_at_zero_is_none(
    base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    laws: dict[str, Shares] = {"quadratic_drag": {"p": 1.0}}
    quiet, shown = (World(base, {"p": p}, laws) for p in (HIDDEN_BY_NOISE, 8.0))
    world = replace(quiet, longer={2.0: quiet, 4.0: shown})
    plain = world.fitted

    def fitted(model: JointModel, start: Mapping[str, float], *, again: bool = False) -> Solution:
        whole = plain(model, start, again=again)
        return replace(whole, values={n: 0.0 if "drag" in n else x for n, x in start.items()})

    assert [c.effects for c in ended(world).claims] == [("quadratic_drag",)]
    monkeypatch.setattr(world, "fitted", fitted)
    found = ended(world)
    assert not found.claims
    assert "is zero in the rows of the fit" in found.why("quadratic_drag")


def test_what_a_name_does_to_longer_rows_stays_where_the_steps_are_made_again(base: Base) -> None:
    laws: dict[str, Shares] = {"quadratic_drag": {"p": 1.0}}
    short = World(base, {"p": HIDDEN_BY_NOISE}, laws)
    session = Session(short)
    start = short.step(None, None, short.start())
    claim = Claim(("quadratic_drag",), "quadratic_drag@motor", "axis", 66.0, kernel=0.12)
    again = session._replay([claim], _Standing((start,), ()))
    assert [c.held_out_drop_percent for c in again.claims] == [66.0]
    shorter = session._replay([replace(claim, kernel=None)], _Standing((start,), ()))
    assert shorter.claims[0].held_out_drop_percent == pytest.approx(4.7, abs=0.1)


@pytest.mark.parametrize("named_there", [True, False])
def test_what_longer_rows_leave_over_their_floor_is_said(named_there: bool, base: Base) -> None:
    """Whether or not they name a part of it: the verdict is about shorter ones."""
    laws: dict[str, Shares] = {"quadratic_drag": {"p": 1.0}} if named_there else {"gravity": {}}
    long = World(base, {"p": 8.0, "q": 3.0}, laws)
    (w,) = long.data.train
    long.data = replace(long.data, train=(replace(w, grid=replace(w.grid, length=0.12)),))
    short = {"p": HIDDEN_BY_NOISE, "q": HIDDEN_BY_NOISE}
    found = ended(World(base, short, laws, longer={2.0: long, 4.0: World(base, short, laws)}))
    assert found.verdict == ("complete" if named_there else "nothing_missing")
    ratio = math.sqrt(1 + 3.0 + (0 if named_there else 8.0))
    (said,) = (x for x in found.warnings if "rows" in x)
    assert said.startswith("in rows of 0.12 s")
    assert f"the axis balance still stands at {ratio:.2g} times its noise floor" in said


def test_what_longer_rows_leave_is_said_in_the_order_of_the_balances(base: Base) -> None:
    parts = ("p", "p@motor", "p@link", "p@sum", "p@deflection", "p@transmission")
    long = World(base, dict.fromkeys(parts, 8.0), {"gravity": {}})
    short = dict.fromkeys(parts, HIDDEN_BY_NOISE)
    found = ended(World(base, short, {"gravity": {}}, longer={2.0: long, 4.0: long}))
    said = [x.partition(" balance")[0].rpartition(" ")[2] for x in found.warnings if "rows" in x]
    assert said == list(long.rms())


# --- the number of additions and what is looked for -----------------------------------------------


@pytest.mark.parametrize("lean", [True, False])
@pytest.mark.parametrize("more", [True, False])
def test_progress_goes_forward_to_its_end(lean: bool, more: bool, base: Base) -> None:
    laws = {"cyclic_torque": {"p": 1.0}, "quadratic_drag": {"q": 1.0}}
    world, told = World(base, {"p": 24.0} | ({"q": 8.0} if more else {}), laws), list[float]()
    session = Session(world, lambda text, share: told.append(share))
    found = (session.diagnose if lean else session.run)(world.start())
    assert named(found) == ["cyclic_torque", "quadratic_drag"][: 1 if lean else 1 + more]
    assert told == sorted(told)
    assert max(told) <= 1.0
    assert ("quadratic drag would be the next" in found.reason) == (lean and more)
    # nobody has set a limit
    assert ("One effect is added at a time" in found.reason) == (lean and more)
    assert "Stopped at the limit" not in found.reason


def test_a_name_that_is_claimed_is_not_said_to_be_untestable(base: Base) -> None:
    laws = {"cyclic_torque": {"p": 1.0}, "quadratic_drag": {"q": 1.0}, "stribeck": {}}
    late = frozenset({"quadratic_drag", "stribeck"})
    found = ended(World(base, {"p": 24.0, "q": 8.0}, laws, late=late))
    assert named(found) == ["cyclic_torque", "quadratic_drag"]
    assert [n.effect for n in found.not_testable] == ["stribeck"]


def test_costly_laws_are_asked_once_and_only_where_no_other_helps(base: Base) -> None:
    laws = {"flexible_mode": {"m@link": 0.8}, "cyclic_torque": {"p": 1.0}}
    world = World(base, {"p": 24.0, "m@link": 20.0}, laws)
    assert named(ended(world)) == ["cyclic_torque", "flexible_mode"]
    first = [late for _, late in world.asked].index(True)
    assert world.asked[first][0] == {"cyclic_torque"}
    assert sum(late for _, late in world.asked) == 1
    quiet = World(base, {"p": 24.0, "m@link": 1.2}, laws)
    assert named(ended(quiet)) == ["cyclic_torque"], "what is left is at the floor"
    assert not any(late for _, late in quiet.asked)


# --- held-out records -----------------------------------------------------------------------------


def test_a_fall_that_only_the_linear_form_misses_is_believed_from_the_whole_fit(
    base: Base,
) -> None:
    """And what that form says against the others of the balance is not held against them."""
    laws = {"cyclic_torque": {"p": 1.0}, "added_spring": {"p": 0.99}, "quadratic_drag": {"p": 0.98}}
    world = World(
        base,
        {"p": 24.0},
        laws,
        falls={"cyclic_torque": 1.0, "added_spring": -5.0, "quadratic_drag": 0.5},
    )
    (claim,) = ended(world).claims
    assert claim.effects == ("cyclic_torque", "added_spring")
    assert claim.held_out_drop_percent == pytest.approx(80.0)


def test_a_fall_that_the_whole_fit_misses_too_is_none(base: Base) -> None:
    world = World(
        base,
        {"p": 24.0},
        {"cyclic_torque": {"p": 0.05}},
        first={"cyclic_torque": {"p": 1.0}},
        falls={"cyclic_torque": 1.0},
    )
    found = ended(world)
    assert found.claims == ()
    assert "after the whole fit" in found.why("cyclic_torque")
    assert "cyclic_torque" in world.fitted_whole


def test_a_law_that_training_hardly_shows_is_fitted_whole_only_over_the_floor(base: Base) -> None:
    for power, names in ((24.0, ["quadratic_drag"]), (1.2, [])):
        world = World(
            base,
            {"p": power},
            {"quadratic_drag": {"p": 1.0}, "cyclic_torque": {"p": 0.1}},
            first={"quadratic_drag": {"p": 0.12}, "cyclic_torque": {"p": 0.11}},
        )
        found = ended(world)
        assert named(found) == names
        assert [c.effects[0] for c in found.decided] == names, "nothing else on the way"
        assert bool(world.fitted_whole) == bool(names)
        if names:
            assert {*world.fitted_whole} == {"quadratic_drag", "cyclic_torque"}


def test_an_addition_that_brings_little_or_spoils_another_balance_is_refused(base: Base) -> None:
    """Whatever its trial says; the next name is taken."""
    spoils = {"p": 0.9, "q@link": -1.0}
    for whole, why in (({"p": 0.01}, "2 % asked"), (spoils, "the link balance rises by")):
        world = World(
            base,
            {"p": 24.0, "q@link": 8.0},
            {"cyclic_torque": whole, "quadratic_drag": {"p": 0.9}},
            first={"cyclic_torque": {"p": 0.95}, "quadratic_drag": {"p": 0.3}},
            chances=lambda claim, now: told(now, {claim.effects[0]: 1.0}, {}),
        )
        found = ended(world)
        assert named(found) == ["quadratic_drag"]
        assert why in found.why("cyclic_torque")


# --- a name and its relatives ---------------------------------------------------------------------


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
def test_whole_fits_decide_between_relatives_in_any_unit(unit: float, base: Base) -> None:
    """The trial of the wrong name does better; a relative far behind it is fitted whole, too."""
    laws = {"cyclic_torque": {"p": 0.6}, "added_spring": {"p": 0.9}, "quadratic_drag": {"p": 0.95}}
    first = {
        "cyclic_torque": {"p": 0.95},
        "added_spring": {"p": 0.7},
        "quadratic_drag": {"p": 0.2},
    }
    world = World(base, {"p": 24.0}, laws, first, unit=unit)
    found = ended(world, 1)
    assert named(found) == ["added_spring"]
    assert "quadratic_drag" not in world.fitted_whole[:2], "no relative, and far behind"
    left = math.sqrt((1 + 24 * 0.4) / (1 + 24 * 0.1))
    assert f"{100 * (left - 1):.3g} % more than" in found.why("cyclic_torque")


@pytest.mark.parametrize(("other", "beside"), [("added_spring", True), ("quadratic_drag", False)])
def test_names_of_one_column_but_for_what_is_held_stand_together(
    other: str, beside: bool, base: Base
) -> None:
    """The trial of one is far behind; its whole fit is as good. Only what is declared as confused
    joins a set so late: others are told apart by their trials.
    """
    laws = {"cyclic_torque": {"p": 0.95}, other: {"p": 0.95}}
    first = {"cyclic_torque": {"p": 0.95}, other: {"p": 0.8}}
    assert (other in EFFECTS["cyclic_torque"].confused_with) == beside
    found = ended(World(base, {"p": 24.0}, laws, first), 1)
    (claim,) = found.claims
    assert claim.effects == (("cyclic_torque", other) if beside else ("cyclic_torque",))


@pytest.mark.parametrize(
    ("key", "seemed", "asked"),
    [
        ("added_spring", 0.56, True),
        ("added_spring", 0.52, False),
        ("asymmetric_coulomb", 0.56, True),
        ("quadratic_drag", 0.75, True),
        ("quadratic_drag", 0.7, False),
    ],
)
def test_how_near_a_name_must_come_to_be_fitted_whole(
    key: str, seemed: float, asked: bool, base: Base
) -> None:
    """Of the log-likelihood of the best trial a relative gains three tenths, any other the half."""
    laws = {"cyclic_torque": {"p": 0.6}, key: {"p": 0.95}}
    first = {"cyclic_torque": {"p": 0.95}, key: {"p": seemed}}
    nats = math.log(25 / (25 - 24 * seemed)) / math.log(25 / (25 - 24 * 0.95))
    relative = (
        key in EFFECTS["cyclic_torque"].confused_with
        or "cyclic_torque" in EFFECTS[key].confused_with
    )
    assert (nats >= (0.3 if relative else 0.5)) == asked
    found = ended(World(base, {"p": 24.0}, laws, first), 1)
    assert named(found) == [key if asked else "cyclic_torque"]


def test_what_is_alike_after_whole_fits_is_the_set(base: Base) -> None:
    laws = {
        "cyclic_torque": {"p": 0.6},
        "asymmetric_viscous": {"p": 0.95},
        "quadratic_drag": {"p": 0.945},
        "stribeck": {"p": 0.93},
    }
    first = {"cyclic_torque": {"p": 0.95}, **{n: {"p": 0.8} for n in list(laws)[1:]}}
    found = ended(World(base, {"p": 24.0}, laws, first), 1)
    assert found.claims[0].effects == ("asymmetric_viscous", "quadratic_drag")
    laws["gravity"] = {"p": 0.945}
    usual = ended(World(base, {"p": 24.0}, laws, {**first, "gravity": {"p": 0.8}}), 1)
    assert named(usual) == ["gravity"], "hardly a joint is without it"


@pytest.mark.parametrize("backwards", [True, False])
def test_a_set_loses_a_name_that_leaves_half_as_much_again_where_laws_are_read_backwards(
    backwards: bool, base: Base
) -> None:
    """Only there names of one set are fitted whole against each other; no name stands twice."""
    laws = {"cyclic_torque": 0.95, "added_spring": 0.88, "stribeck": 0.86, "lugre": 0.8}
    left = {n: math.sqrt((25 - 24 * x) / (25 - 24 * 0.95)) for n, x in laws.items()}
    first = {n: {"p": 0.95} for n in laws}
    world = World(base, {"p": 24.0}, {n: {"p": x} for n, x in laws.items()}, first)
    now, ranking = world.step(None, None, world.start()), world.ranking(base)
    best = next(t for t in ranking.trials if t.key == "cyclic_torque")
    if backwards:
        world.data = replace(
            world.data, sensing=replace(world.data.sensing, balances=("kinematic",))
        )
    session = Session(world)
    found, names = session._by_whole_fit(best, tuple(laws), ranking, now, ())
    assert found.key == "cyclic_torque"
    assert names == tuple(n for n in laws if not backwards or left[n] <= 1.5)
    assert 1 < sum(x <= 1.5 for x in left.values()) < len(left)


# --- what becomes of earlier claims ---------------------------------------------------------------


def test_a_name_of_a_set_that_does_better_alone_takes_its_place(base: Base) -> None:
    first = {"cyclic_torque": {"p": 0.95}}
    laws = {"added_spring": {"p": 1.0}, "cyclic_torque": {"p": 0.9998, "q": 1.0}}
    found = ended(World(base, {"p": 24.0, "q": 8.0}, laws, first))
    assert named(found) == ["cyclic_torque"]
    assert "explains less than" in found.why("added_spring")


def test_both_names_of_a_set_stay_where_either_alone_leaves_what_both_explain(base: Base) -> None:
    first = {"cyclic_torque": {"p": 0.95}}
    laws = {"added_spring": {"p": 1.0}, "cyclic_torque": {"p": 0.97, "q": 1.0}}
    found = ended(World(base, {"p": 24.0, "q": 8.0}, laws, first))
    assert named(found) == ["added_spring", "cyclic_torque"]


def test_a_name_of_a_set_that_does_worse_alone_is_added_beside_it(base: Base) -> None:
    first = {"cyclic_torque": {"p": 0.95}}
    laws = {"added_spring": {"p": 1.0}, "cyclic_torque": {"p": 0.5, "q": 1.0}}
    found = ended(World(base, {"p": 24.0, "q": 8.0}, laws, first))
    assert named(found) == ["added_spring", "cyclic_torque"]


def test_a_name_of_a_set_that_is_no_better_alone_leaves_the_set_its_place(base: Base) -> None:
    """However little both explain beyond it: by its trial each is missing beside the other."""
    first = {"added_spring": {"p": 0.98}}
    laws = {"quadratic_drag": {"p": 1.0}, "added_spring": {"p": 0.98, "q": 0.1}}
    early = {"quadratic_drag": {"p": 1.0, "q": 0.6}, "added_spring": {"q": 1.0}}
    found = ended(World(base, {"p": 24.0, "q": 8.0}, laws, first, early))
    assert found.decided[0].effects == ("quadratic_drag", "added_spring")
    assert named(found) == ["quadratic_drag", "added_spring"]


@pytest.mark.parametrize(("share", "alone"), [(0.99, True), (0.98, False)])
def test_one_name_that_does_the_work_of_two_takes_their_place(
    share: float, alone: bool, base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As good to 5 % of what is left: what lacks 1 % of a power of 8 is, what lacks 2 % is not.
    Rows may have done so by chance: the name that gave its place is fitted whole beside it.
    """
    laws = {
        "added_spring": {"p": 1.0},
        "cyclic_torque": {"p": 1.0, "q": share},
        "asymmetric_coulomb": {"q": 1.0},
    }
    assert "cyclic_torque" in EFFECTS["asymmetric_coulomb"].confused_with
    first = {"cyclic_torque": {"p": 0.99}}
    world, near = World(base, {"p": 24.0, "q": 8.0}, laws, first), dict[str, Shares]()

    def odds(claim: Claim, beside: Shares, now: Step, last: Ranking) -> None:
        near[claim.effects[0]] = beside

    monkeypatch.setattr(world, "odds", odds)
    found = ended(world)
    if alone:
        assert named(found) == ["cyclic_torque"]
        assert "beside it to explain" in found.why("added_spring")
        assert near["cyclic_torque"]["added_spring"] == 0.0
    else:
        assert named(found) == ["added_spring", "asymmetric_coulomb"]


def test_a_law_of_another_kind_beside_a_set_leaves_it(base: Base) -> None:
    laws = {
        "added_spring": {"p": 1.0},
        "cyclic_torque": {"p": 1.0, "q": 1.0},
        "quadratic_drag": {"q": 1.0, "r": 1.0},
    }
    first = {"cyclic_torque": {"p": 0.99}}
    found = ended(World(base, {"p": 24.0, "q": 8.0, "r": 0.05}, laws, first))
    assert named(found) == ["added_spring", "quadratic_drag"]


def test_a_relative_in_another_balance_leaves_a_set(base: Base) -> None:
    laws = {
        "added_spring": {"p": 1.0},
        "cyclic_torque": {"p": 0.999},
        "asymmetric_coulomb": {"q@link": 1.0},
    }
    found = ended(World(base, {"p": 24.0, "q@link": 8.0}, laws))
    assert found.decided[0].effects == ("added_spring", "cyclic_torque")
    assert named(found) == ["added_spring", "asymmetric_coulomb"]


def test_a_claim_whose_work_a_later_one_does_is_dropped(base: Base) -> None:
    laws = {"added_spring": {"p": 0.9}, "quadratic_drag": {"p": 1.0, "q": 1.0}}
    first = {"quadratic_drag": {"q": 1.0}}
    found = ended(World(base, {"p": 24.0, "q": 8.0}, laws, first))
    assert named(found) == ["quadratic_drag"]
    assert "not needed any more" in found.why("added_spring")


def test_every_claim_but_the_last_is_judged_again(base: Base) -> None:
    laws = {
        "added_spring": {"p": 1.0},
        "cyclic_friction": {"q": 0.9},
        "quadratic_drag": {"q": 1.0, "r": 1.0},
    }
    # beside the spring alone, too, the drag seems to do little of what it does in the end
    found = ended(
        World(
            base,
            {"p": 200.0, "q": 40.0, "r": 12.0},
            laws,
            first={"quadratic_drag": {}},
            early={"quadratic_drag": {"r": 1.0}},
        )
    )
    assert [c.effects[0] for c in found.decided] == [
        "added_spring",
        "cyclic_friction",
        "quadratic_drag",
    ]
    assert named(found) == ["added_spring", "quadratic_drag"]


@pytest.mark.parametrize(
    ("rows", "names", "why"),
    [
        (4.0, ["quadratic_drag", "stribeck"], "not needed any more"),
        (100.0, ["stribeck", "quadratic_drag"], "explains less than"),
    ],
)
def test_a_name_that_gains_next_to_nothing_takes_no_place(
    rows: float, names: list[str], why: str, base: Base
) -> None:
    """A claim whose work is done is dropped; another law of its balance that is sure takes its
    place.
    """
    laws = {
        "added_spring": {"p": 0.9},
        "quadratic_drag": {"p": 1.0, "q": 1.0},
        "stribeck": {"r": 1.0},
    }
    first = {"quadratic_drag": {"q": 1.0}}
    found = ended(World(base, {"p": 24.0, "q": 8.0, "r": 3.0}, laws, first, rows=rows))
    assert named(found) == names
    assert why in found.why("added_spring")


def test_a_claim_stays_where_it_is_needed_however_few_the_rows(base: Base) -> None:
    laws = {"cyclic_torque": {"p": 1.0}, "quadratic_drag": {"q": 1.0}}
    for rows in (4.0, 100.0):
        world = World(base, {"p": 24.0, "q": 8.0}, laws, rows=rows)
        assert named(ended(world)) == ["cyclic_torque", "quadratic_drag"]


def test_a_law_that_another_one_needs_stays(base: Base) -> None:
    laws = {"coulomb": {"p": 0.9}, "stribeck": {"p": 1.0, "q": 1.0}}
    assert "coulomb" in EFFECTS["stribeck"].needs
    world = World(base, {"p": 24.0, "q": 8.0}, laws, without="coulomb@motor")
    assert named(ended(world)) == ["coulomb", "stribeck"]


@pytest.fixture
def swapping(base: Base) -> World:
    """`stribeck` is what is missing beside the drag; before that is in, another name does its
    work better.
    """
    laws = {"added_spring": {"p": 0.9}, "stribeck": {"p": 1.0}, "quadratic_drag": {"q": 1.0}}
    first = {"stribeck": {"p": 0.3}}
    return World(base, {"p": 100.0, "q": 30.0}, laws, first, turned=frozenset({"quadratic_drag"}))


def test_a_better_name_takes_the_place_of_an_earlier_one(swapping: World) -> None:
    found = ended(swapping)
    assert found.decided[0].effects == ("added_spring",)
    assert named(found) == ["stribeck", "quadratic_drag"]
    assert "explains less than" in found.why("added_spring")
    assert found.verdict == "complete"
    # each step keeps the form of the law in which it was accepted
    assert [s.solution.model.virtual_work for s in found.steps] == [True, True, False]


def test_a_name_that_gave_its_place_is_fitted_whole_beside_the_one_that_took_it(
    swapping: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It gave it by a linear trial, with the shapes of a model that lacks it."""
    asked: dict[str, Shares] = {}

    def odds(claim: Claim, near: Shares, now: Step, last: Ranking) -> Odds | None:
        asked[claim.effects[0]] = near
        return None

    monkeypatch.setattr(swapping, "odds", odds)
    assert named(ended(swapping)) == ["stribeck", "quadratic_drag"]
    assert asked["stribeck"]["added_spring"] == 0.0


@pytest.mark.parametrize("form", [True, False])
def test_the_form_of_a_law_is_asked_again_beside_the_rest(base: Base, form: bool) -> None:
    laws = {"added_spring": {"p": 1.0}, "quadratic_drag": {"q": 1.0}}
    world = World(base, {"p": 100.0, "q": 30.0}, laws, turned=frozenset({"added_spring"}))
    found = ended(replace(world, form=form))
    assert named(found) == ["added_spring", "quadratic_drag"]
    # the first name was accepted without virtual work; its step is that of the form that stays
    assert [s.solution.model.virtual_work for s in found.steps[1:]] == [form, form]


def test_the_form_of_a_kinematic_error_of_the_joint_file_stays(base: Base) -> None:
    model = base.solution.model.add("kinematic_error")
    based = replace(base, solution=replace(base.solution, model=model))
    laws = {"added_spring": {"p": 1.0}, "quadratic_drag": {"q": 1.0}}
    found = ended(World(based, {"p": 100.0, "q": 30.0}, laws, form=not model.virtual_work))
    assert named(found) == ["added_spring", "quadratic_drag"]
    assert {s.solution.model.virtual_work for s in found.steps} == {model.virtual_work}


def test_a_name_gives_its_place_to_no_set_that_is_no_answer(base: Base) -> None:
    laws = {
        "added_spring": {"p": 0.9},
        "quadratic_drag": {"q": 1.0},
        **dict.fromkeys(MANY, {"p": 1.0}),
    }
    first = dict.fromkeys(MANY, {"p": 0.3})
    found = ended(World(base, {"p": 100.0, "q": 30.0}, laws, first))
    assert named(found) == ["added_spring", "quadratic_drag"]


@pytest.mark.parametrize(
    ("share", "seemed", "names"),
    [
        (0.3, 0.99, ("added_spring",)),
        (0.99, 0.3, ("added_spring", "cyclic_torque")),
        (0.9985, 0.3, ("added_spring", "cyclic_torque")),
    ],
)
def test_the_set_of_an_earlier_claim_is_that_of_the_last_model(
    share: float, seemed: float, names: tuple[str, ...], base: Base
) -> None:
    laws = {
        "added_spring": {"p": 0.998},
        "cyclic_torque": {"p": share},
        "quadratic_drag": {"q": 1.0},
    }
    world = World(base, {"p": 60.0, "q": 30.0}, laws, {"cyclic_torque": {"p": seemed}})
    found = ended(world)
    assert named(found) == ["added_spring", "quadratic_drag"]
    assert found.decided[0].effects == (
        ("added_spring", "cyclic_torque") if seemed > share else ("added_spring",)
    )
    assert found.claims[0].effects == names
    hint = EFFECTS["added_spring"].separate_by if len(names) > 1 else None
    assert found.claims[0].separate_by == hint


# --- whole fits of the names of a claim -----------------------------------------------------------

TWO: Mapping[str, Shares] = {
    "cubic_viscous": {"p": 1.0},
    "cyclic_torque": {"p": 1.0},
    "quadratic_drag": {"q": 1.0},
}


def told(now: Step, chances: Shares, behind: Mapping[str, str], rest: float = 0.0) -> Odds:
    """Odds of names, the most probable first."""
    rivals = tuple(
        Rival(n, "gravity" if n == "gravity" else f"{n}@motor", now.solution)
        for n in sorted(chances, key=lambda n: -chances[n])
    )
    return Odds(rivals, chances, behind, rest)


@pytest.mark.parametrize(
    ("chances", "behind", "effects"),
    [
        ({"cubic_viscous": 0.4, "cyclic_torque": 0.6}, {}, ("cubic_viscous", "cyclic_torque")),
        ({"cubic_viscous": 1.0}, {}, ("cubic_viscous",)),
        ({"cubic_viscous": 0.001, "cyclic_torque": 0.999}, {}, ("cyclic_torque", "cubic_viscous")),
        ({"cyclic_torque": 1.0}, {"cubic_viscous@motor": "is far behind"}, ("cyclic_torque",)),
    ],
)
def test_a_claim_has_the_names_that_whole_fits_leave(
    chances: Shares, behind: Mapping[str, str], effects: tuple[str, ...], base: Base
) -> None:
    """Its own first, unless another is so much more probable that it counts as better."""
    odds = lambda claim, now: told(now, chances, behind)  # noqa: E731
    found = ended(World(base, {"p": 24.0}, TWO, chances=odds))
    assert named(found) == [effects[0]]
    (claim,) = found.claims
    assert claim.effects == effects
    assert claim.confidence == chances
    assert claim.label == f"{effects[0]}@motor"
    assert claim.separate_by == (EFFECTS[effects[0]].separate_by if len(effects) > 1 else None)
    if behind:
        assert "is far behind" in found.why("cubic_viscous")


@pytest.mark.parametrize("beside", [True, False])
def test_a_name_that_spoils_held_out_records_takes_no_place(beside: bool, base: Base) -> None:
    """However much more probable the training records make it: it has learned their noise."""
    chances = {"cyclic_torque": 0.996} | ({"cubic_viscous": 0.003} if beside else {})
    laws = {"cubic_viscous": {"p": 1.0}, "cyclic_torque": {"p": -0.5}}
    found = ended(World(base, {"p": 24.0}, laws, chances=lambda _, now: told(now, chances, {})))
    (claim,) = found.claims
    assert claim.effects == ("cubic_viscous",)
    assert claim.confidence == pytest.approx({"cubic_viscous": 0.75} if beside else {})
    assert "held-out" in found.why("cyclic_torque")


@pytest.mark.parametrize("all_of_it", [True, False])
def test_what_was_claimed_beside_a_name_that_gave_way_is_asked_again(
    all_of_it: bool, base: Base
) -> None:
    """A law that whole fits put in the place of another does the work of what came after it; what
    it does not do stays.
    """
    whole = {"p": 1.0, "q": 1.0} | ({"r": 1.0} if all_of_it else {})
    laws = {
        "cubic_viscous": {"p": 1.0},
        "quadratic_drag": {"q": 1.0},
        "asymmetric_coulomb": {"r": 1.0},
        "cyclic_torque": whole,
    }

    def odds(claim: Claim, now: Step) -> Odds:
        first = claim.effects[0]
        if first == "cubic_viscous":
            return told(now, {"cyclic_torque": 1.0}, {"cubic_viscous@motor": "is far behind"})
        return told(now, {first: 1.0}, {})

    hidden = {"p": 60.0, "q": 12.0, "r": 6.0}
    unseen = {"cyclic_torque": {"p": 0.01}}
    world = World(base, hidden, laws, first=unseen, early=unseen, late_seen=unseen, chances=odds)
    found = ended(world)
    kept = [] if all_of_it else ["asymmetric_coulomb"]
    assert named(found) == ["cyclic_torque", *kept]
    assert "is not needed with" in found.why("quadratic_drag")


@pytest.mark.parametrize(
    ("own_gain", "gain", "cv_drop", "held_drop", "asked"),
    [
        (20.0, -90.0, 12.0, 22.0, True),
        (20.0, 10.0, 12.0, 22.0, False),  # nothing is against it
        (2.0, -90.0, 12.0, 22.0, False),  # its own balance is not sure of it
        (20.0, -90.0, 8.0, 22.0, False),
        (20.0, -90.0, 12.0, 4.0, False),
        (20.0, -90.0, 12.0, math.nan, False),
    ],
)
def test_only_laws_that_another_balance_is_against_are_outvoted(
    own_gain: float, gain: float, cv_drop: float, held_drop: float, asked: bool, base: Base
) -> None:
    ranking = World(base, {"p": 24.0}, TWO).ranking(base)
    (trial, *_) = ranking.everything
    trial = replace(
        trial,
        own_gain=own_gain,
        gain=gain,
        cv_drop_percent=cv_drop,
        held_out_drop_percent=held_drop,
        p_value=1e-9,
    )
    ranking = replace(ranking, everything=(trial,), significant=frozenset())
    assert outvoted(ranking, base, frozenset()) == ([trial] if asked else [])
    assert outvoted(ranking, base, frozenset({trial.candidate.label})) == []


def test_a_claim_that_is_less_probable_than_nothing_goes_and_the_others_stay(base: Base) -> None:
    asked = []

    def odds(claim: Claim, now: Step) -> Odds:
        asked.append(claim.effects[0])
        sure = claim.effects[0] == "quadratic_drag"
        return told(now, {claim.effects[0]: 1.0 if sure else 0.1}, {}, 0.0 if sure else 0.9)

    found = ended(World(base, {"p": 24.0, "q": 8.0}, TWO, chances=odds))
    assert named(found) == ["quadratic_drag"]
    assert found.claims[0].confidence == {"quadratic_drag": 1.0}
    assert asked == ["cubic_viscous", "quadratic_drag"], "each once"
    assert "nothing is 90% probable" in found.why("cubic_viscous")


def test_a_law_that_another_one_needs_is_not_less_than_nothing(base: Base) -> None:
    laws = {"coulomb": {"p": 1.0}, "stribeck": {"q": 1.0}}
    odds = lambda claim, now: told(now, {claim.effects[0]: 0.1}, {}, 0.9)  # noqa: E731
    world = World(base, {"p": 24.0, "q": 8.0}, laws, without="coulomb@motor", chances=odds)
    assert named(ended(world)) == ["coulomb"], "and what needs it goes"


@pytest.mark.parametrize("beside", [True, False])
def test_a_name_that_has_a_place_takes_no_other(beside: bool, base: Base) -> None:
    """Even where it is by far the most probable; the other one stays, as sure as it is."""
    chances = {"cubic_viscous": 0.999} | ({"quadratic_drag": 0.001} if beside else {})

    def odds(claim: Claim, now: Step) -> Odds | None:
        return told(now, chances, {}) if claim.effects[0] == "quadratic_drag" else None

    laws = {k: v for k, v in TWO.items() if k != "cyclic_torque"}
    found = ended(World(base, {"p": 24.0, "q": 8.0}, laws, chances=odds))
    assert named(found) == ["cubic_viscous", "quadratic_drag"]
    last = found.claims[1]
    assert last.effects == (("quadratic_drag", "cubic_viscous") if beside else ("quadratic_drag",))
    assert last.confidence == (chances if beside else {})


# --- names that a curve shows to be wrong ---------------------------------------------------------

WRONG = Equivalence(0.3, 0.01, "another law of the position", cast(Curve, object()))


def test_after_a_wrong_name_only_laws_of_its_variable_are_taken_up(base: Base) -> None:
    laws = {
        "cyclic_torque": {"p": 1.0},
        "added_spring": {"p": 0.7},
        "quadratic_drag": {"p": 0.8},
        "asymmetric_viscous": {"q@link": 1.0},
    }
    wrong = {"cyclic_torque@motor": WRONG}
    assert WRONG.is_wrong
    found = ended(World(base, {"p": 24.0, "q@link": 5.0}, laws, wrong=wrong))
    assert sorted(named(found)) == ["added_spring", "asymmetric_viscous"]


@pytest.mark.parametrize("beside", [True, False])
def test_a_law_that_another_one_needs_is_not_held_against_its_curve(
    beside: bool, base: Base
) -> None:
    """Both share the work of one variable: only alone does it miss what a curve explains."""
    hidden = {"p": 24.0} | ({"q": 8.0} if beside else {})
    laws = {"coulomb": {"p": 1.0}, "stribeck": {"q": 1.0}}
    world = World(base, hidden, laws, wrong={"coulomb@motor": WRONG}, without="coulomb@motor")
    assert named(ended(world)) == (["coulomb", "stribeck"] if beside else [])


def test_a_diagnosis_holds_a_name_against_its_curve_only_where_nothing_else_is_left(
    base: Base,
) -> None:
    laws = {"cyclic_torque": {"p": 1.0}, "quadratic_drag": {"q": 1.0}}
    for hidden, names in (({"p": 24.0}, []), ({"p": 24.0, "q": 8.0}, ["cyclic_torque"])):
        world = World(base, hidden, laws, wrong={"cyclic_torque@motor": WRONG})
        found = Session(world).diagnose(world.start())
        assert named(found) == names
        assert names or "another law of the position" in found.why("cyclic_torque")
        assert named(ended(world)) == names[:0] + ["quadratic_drag"] * ("q" in hidden)


# --- what is named in part ------------------------------------------------------------------------


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
@pytest.mark.parametrize(("share", "partial"), [(0.48, True), (0.52, False)])
def test_a_claim_of_less_than_half_of_what_is_missing_is_one_in_part(
    unit: float, share: float, partial: bool, base: Base
) -> None:
    """Of the squares over the noise, in whatever unit the torque is."""
    found = ended(World(base, {"p": 24.0}, {"cyclic_torque": {"p": share}}, unit=unit))
    assert [c.partial for c in found.claims] == [partial]
    assert found.unexplained
    whole = ended(World(base, {"p": 2.0}, {"cyclic_torque": {"p": share}}, unit=unit))
    assert whole.unexplained == ()
    assert [c.partial for c in whole.claims] == [False], "what is left is at the floor"


def test_each_claim_is_held_against_what_is_left_in_its_own_balance(base: Base) -> None:
    laws = {
        "cyclic_torque": {"p": 0.9},
        "asymmetric_viscous": {"q": 1.0},
        "quadratic_drag": {"r@link": 0.4},
    }
    found = ended(World(base, {"p": 60.0, "q": 3.0, "r@link": 24.0}, laws))
    parts = {c.effects[0]: c.partial for c in found.claims}
    # of the 60 and 3 of the axis 54 are explained by the first, 3 by the second, 6 are left
    assert parts == {"cyclic_torque": False, "asymmetric_viscous": True, "quadratic_drag": True}


@pytest.mark.parametrize(
    ("key", "share", "located", "partial"),
    [
        ("cyclic_torque", 0.6, 60.0, True),
        ("cyclic_torque", 0.6, 50.0, True),
        ("cyclic_torque", 0.6, 40.0, False),
        ("gravity", 0.6, 60.0, False),
        ("gravity", 0.4, 60.0, True),
    ],
)
def test_a_table_that_does_the_work_as_well_leaves_no_name_whole(
    key: str,
    share: float,
    located: float,
    partial: bool,
    base: Base,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """But one that hardly a joint is without."""
    monkeypatch.setattr("identification.diagnosis.session.is_absorbed", lambda *_: True)
    found = ended(World(base, {"p": 24.0}, {key: {"p": share}}, located=located))
    assert [c.partial for c in found.claims] == [partial]


def test_a_claim_in_part_stays_one_where_a_table_does_less(
    base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("identification.diagnosis.session.is_absorbed", lambda *_: False)
    for share, partial in ((0.4, True), (0.6, False)):
        found = ended(World(base, {"p": 24.0}, {"cyclic_torque": {"p": share}}, located=60.0))
        assert [c.partial for c in found.claims] == [partial]


def test_what_is_left_around_a_mode_has_the_frequency_from_before_it(
    base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    laws = {"cyclic_torque": {"p": 1.0}, "flexible_mode": {"m@link": 0.6}}
    world = World(base, {"p": 60.0, "m@link": 24.0}, laws)
    found = ended(world)
    assert named(found) == ["cyclic_torque", "flexible_mode"]
    law, mode = found.claims
    assert (law.partial, mode.partial) == (False, True)
    asked = []

    def peak(solution: Solution, data: object, balance: str) -> float:
        asked.append((world.names(solution.model), balance))
        return 7.0

    monkeypatch.setattr("identification.diagnosis.session.spectral_peak", peak)
    nowhere = Unexplained("link", 0.0)
    others = [
        replace(nowhere, axis="motor_position"),
        replace(nowhere, order=2.0),
        replace(nowhere, frequency_hz=3.0),
        replace(nowhere, balance="axis"),
    ]
    told = Session(world)._with_frequency([*others, nowhere], [law, mode], found.steps)
    assert told == [*others, replace(nowhere, frequency_hz=7.0)]
    assert asked == [({"cyclic_torque"}, "link")]
    for claims in ([law], [law, replace(mode, partial=False)], [replace(law, partial=True)]):
        assert Session(world)._with_frequency([nowhere], claims, found.steps) == [nowhere]


# --- what is told beside the claims ---------------------------------------------------------------


def test_a_doubt_about_a_parameter_forbids_that_all_is_well(base: Base) -> None:
    laws, doubts = {"cyclic_torque": {"p": 1.0}}, (Doubt("motor", "a mass is below nothing"),)
    sure = ended(World(base, {"p": 24.0}, laws))
    assert sure.verdict == "complete"
    found = ended(World(base, {"p": 24.0}, laws, doubts=doubts))
    assert found.verdict == "unexplained"
    assert found.reason == f"{sure.reason} But a mass is below nothing."
    quiet = ended(World(base, {}, laws, doubts=doubts))
    assert quiet.verdict == "unexplained"
    assert "But a mass" in quiet.reason
    left = ended(World(base, {"p": 24.0, "q": 8.0}, laws, doubts=doubts))
    assert left.verdict == "unexplained"
    assert "But" not in left.reason, "it is told what is left"


def test_a_curve_is_the_answer_where_something_is_left_and_no_name_is_next(base: Base) -> None:
    laws = {"cyclic_torque": {"p": 1.0}, "quadratic_drag": {"q": 1.0}}
    own, other = cast(Curve, object()), cast(Curve, object())
    curves = (SimpleNamespace(curve=own),)
    beside = {
        "cyclic_torque@motor": Equivalence(0.03, 0.01, "like it", other),
        "quadratic_drag@motor": Equivalence(0.0, 0.001, "it", None),
    }
    for hidden, most, learned in (
        ({"p": 24.0, "q": 8.0}, 6, False),
        ({"p": 24.0, "q": 8.0}, 1, False),
        ({"p": 24.0, "q": 8.0, "r": 5.0}, 6, True),
        ({"p": 24.0, "q": 8.0, "r": 5.0}, 1, False),
    ):
        world = World(base, hidden, laws, curves=curves, wrong=beside)
        found = ended(world, most)
        assert len(found.claims) == min(most, 2)
        assert bool(found.learned) == learned
        # the parameters are looked at with every curve beside them, and as the start model has them
        assert world.doubted == [(min(most, 2), (other, own) if learned else (other,), 0)]


def test_lines_are_looked_for_where_something_is_left_or_minor_effects_are(base: Base) -> None:
    laws = {"cyclic_torque": {"p": 1.0}}
    for hidden, lean, lines in (
        ({"p": 24.0}, True, ()),
        ({"p": 24.0}, False, ("line beside 1",)),
        ({"p": 24.0, "q": 8.0}, True, ("line beside 1",)),
    ):
        world = World(base, hidden, laws)
        session = Session(world)
        found = (session.diagnose if lean else session.run)(world.start())
        assert found.lines == lines


def test_a_small_effect_is_told_where_its_sign_is_sure_and_not_by_a_diagnosis(base: Base) -> None:
    laws = {"cyclic_torque": {"p": 1.0}, "quadratic_drag": {"q": 0.8}}
    for steady, lean in ((True, False), (False, False), (True, True)):
        world = World(base, {"p": 24.0, "q": 0.1}, laws, rows=1e4, steady=steady)
        session = Session(world)
        found = (session.diagnose if lean else session.run)(world.start())
        assert named(found) == ["cyclic_torque"]
        assert [c.effects for c in found.minor] == [("quadratic_drag",)] * (steady and not lean)


def test_records_that_cannot_carry_the_question_get_their_reason_and_no_claim(
    base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    why = "the motor never turns"
    monkeypatch.setattr("identification.diagnosis.session.not_identifiable", lambda data: why)
    world = World(base, {"p": 24.0}, {"cyclic_torque": {"p": 1.0}})
    found = ended(world)
    assert (found.verdict, found.reason, found.claims) == ("not_identifiable", why, ())
    assert [s.added for s in found.steps] == [None]
    assert found.final_ratios["axis"].ratio == 5.0
    assert world.asked == []


def test_what_a_warm_joint_is_judged_by_is_said_only_where_a_claim_is_about_it(base: Base) -> None:
    world = World(base, {}, {})
    said = Session(world)._about_temperature
    warm, cold = (Claim((n,), n, "axis", 50.0) for n in ("thermal_friction", "quadratic_drag"))
    assert said([cold]) == said([]) == ()
    (note,) = said([cold, warm])
    assert "no temperature was recorded" in note
    sensing = replace(world.data.sensing, has_temperature=True, temperature_origin=301.5)
    world.data = replace(world.data, sensing=sensing)
    (note,) = said([warm])
    assert "301.5 K" in note


# --- what comes near a name -----------------------------------------------------------------------


def test_names_that_come_near_one_are_the_others_that_help_in_its_balance(base: Base) -> None:
    laws = {
        "cyclic_torque": {"p": 1.0},
        "added_spring": {"p": 0.5},
        "stribeck": {"p": 0.01},
        "quadratic_drag": {"q@link": 1.0},
        "gravity": {},
    }
    world = World(base, {"p": 24.0, "q@link": 8.0}, laws)
    ranking = world.ranking(base)
    best = ranking.everything[0]
    near = {
        "added_spring": 100 * math.log(math.sqrt(13)),
        "stribeck": 100 * math.log(math.sqrt(24.76)),
    }
    assert 0 < 100 * math.log(5 / math.sqrt(24.76)) < 1
    assert _behind(best, ranking) == pytest.approx(near)
    spring = next(t for t in ranking.everything if t.key == "added_spring")
    worse = replace(
        spring, candidate=replace(spring.candidate, label="elsewhere"), score=spring.score - 9
    )
    both = replace(ranking, everything=(*ranking.everything, worse))
    assert _behind(best, both) == pytest.approx(near), "of several places the best counts"


# --- curves in the place of names -----------------------------------------------------------------

BOTH = frozenset({"quadratic_drag", "stribeck"})
"""Two names that each explain a part of a law that they are not."""


def in_parts(base: Base, **other: Any) -> World:
    """What is hidden is explained in parts by two names, and whole by curves without them."""
    explains = {"quadratic_drag": {"p": 0.9}, "stribeck": {"q": 0.9}}
    made: dict[str, Any] = {
        "curves": (SimpleNamespace(curve=None, balance="axis"),),
        "undone": {BOTH: 1.0},
    }
    return World(base, {"p": 80.0, "q": 40.0}, explains, **(made | other))


def test_names_that_explain_parts_give_way_to_a_curve_that_explains_all(base: Base) -> None:
    found = ended(in_parts(base))
    assert found.claims == ()
    assert found.learned
    assert found.verdict == "unexplained"
    for name in BOTH:
        assert "a curve over one variable explains" in found.why(name)


@pytest.mark.parametrize(
    "other",
    [
        {"undone": {BOTH: 1.0, frozenset(): 1.0}},  # curves do no better
        {"undone": {}},  # curves explain what the names leave
        {"curves": ()},
        # each is as good as the curve of its own variable
        {"wrong": {f"{n}@motor": Equivalence(0.0, 0.001, n) for n in BOTH}},
    ],
    ids=["no better", "beside them", "no curve", "names"],
)
def test_they_stay_where_curves_do_no_better(base: Base, other: dict[str, Any]) -> None:
    assert {*named(ended(in_parts(base, **other)))} == BOTH


@pytest.mark.parametrize(
    ("was", "now", "refused"), [(1.1, 1.9, True), (1.1, 1.2, False), (5.0, 1.9, False)]
)
def test_noise_that_becomes_structure_refuses_an_addition(
    was: float, now: float, refused: bool
) -> None:
    """However far the RMS falls: it does so because the noise counts less."""
    before, after = (
        Error(5.0, 95.0, 99.0, {"deflection": BalanceError(rms, rms / ratio, ratio, "N.m")})
        for rms, ratio in ((1.4, was), (0.14, now))
    )
    assert bool(made_worse(before, after)) == refused
