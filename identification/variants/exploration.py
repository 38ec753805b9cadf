"""Explore: which variants of a joint's model the records speak for, and which tie."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, final

from casadi_models import EFFECTS, JointModel
from identification.balance.dataset import Dataset
from identification.data.formats import words
from identification.data.joint_file import Joint
from identification.diagnosis.candidates import NotTestable
from identification.diagnosis.improvement import Improvement
from identification.fitting.engine import Solution
from identification.fitting.joint_text import joint_text
from identification.fitting.parameters import parameter_table
from identification.representation import html_of
from identification.variants.lattice import PER_EFFECT, PER_FURTHER, added_to

NAME: Final = 57
"""Letters of a variant's name in the table; its lines have 100."""
PRINTED: Final = 14
"""Rows of the printed table."""
IN_SHORT: Final = 6
"""Rows of the table in a session."""
ALTERNATIVES: Final = 3
"""Alternatives that are printed in one line."""


@final
@dataclass(frozen=True)
class Variant:
    """A fitted variant of the joint's model.

    Attributes
    ----------
    name : str
        What it has beyond the joint's own model, or lacks, or the model's name.
    labels : tuple of str
        Effects in their places.
    added, dropped : tuple of str
        Labels beyond those of the joint's own model, and those of it that it lacks.
    parameters : int
        Free parameters, without nuisances; of a learned curve its effective number, rounded up.
    relative_error_percent : float
        On held-out records, as `compare` gives it.
    error_percent : float
        RMS on held-out records in percent of that of the joint's own model, mean of the balances'
        logarithms.
    score : float
        On blocks that its fit did not see, those of the held-out records among them (see
        :func:`identification.variants.lattice.price_of`), less that of the recommended one;
        below 0 for one that lacks an effect of the joint's own model, and for one that whole fits
        rule out; NaN for one with learned
        curves, which are chosen by a cross-validation of their own.
    tied : bool
        Recommended, or not to be told from it with every effect of the joint's own model in it.
    chosen_percent : float
        Share of resampled records on which it is the best.
    solution : Solution
        Its fit, without standard errors.
    behind : str
        Why whole fits of its names rule it out, whatever its score; empty where they do not.
    """

    name: str
    labels: tuple[str, ...]
    added: tuple[str, ...]
    dropped: tuple[str, ...]
    parameters: int
    relative_error_percent: float
    error_percent: float
    score: float
    tied: bool
    chosen_percent: float
    solution: Solution
    behind: str = ""

    def __repr__(self) -> str:
        return (
            f"Variant({self.name!r}, {self.parameters} parameters, "
            f"{self.relative_error_percent:.3g} % held out)"
        )

    @property
    def effects(self) -> tuple[str, ...]:
        """Keys of its effects, each once."""
        return tuple(
            dict.fromkeys(label.partition("@")[0].partition("#")[0] for label in self.labels)
        )

    def as_json(self) -> dict[str, Any]:
        """The shape of `explore --json`."""
        return {
            "name": self.name,
            "effects": list(self.effects),
            "labels": list(self.labels),
            "added": list(self.added),
            "dropped": list(self.dropped),
            "parameters": self.parameters,
            "held_out": {
                "relative_error_percent": self.relative_error_percent,
                "of_start_percent": self.error_percent,
            },
            "score": self.score,
            "tied": self.tied,
            "chosen_percent": self.chosen_percent,
            "behind": self.behind,
        }


@final
@dataclass(frozen=True)
class StandIn:
    """An effect of the recommended variant, and another one that can take its place.

    Attributes
    ----------
    effect, by : str
        Labels.
    lost_percent : float
        Rise of the cross-validated RMS, all balances together, by the exchange.
    tied : bool
        The records do not tell the two variants apart.
    """

    effect: str
    by: str
    lost_percent: float
    tied: bool

    def as_json(self) -> dict[str, Any]:
        """The shape of `explore --json`."""
        return {
            "effect": self.effect,
            "by": self.by,
            "lost_percent": self.lost_percent,
            "tied": self.tied,
        }


@final
@dataclass(frozen=True)
class Exploration:
    """Variants of a joint's model, held against each other.

    Attributes
    ----------
    joint : Joint
    data : Dataset
    variants : tuple of Variant
        Those that were fitted: with every effect of the joint's own model the best first, those
        of them that whole fits rule out, then those that lack one.
    screened : int
        Variants that were scored to choose them.
    front : tuple of Variant
        Of held-out error against parameters, the fewest parameters first, of those that may be
        recommended.
    recommended : Variant
    ties : tuple of Variant
        Not to be told from it on these records, the best first.
    windows : tuple of str
        Name of the best variant in each part of the records, one after the other.
    by_record : tuple of (str, str)
        Each record, and the name of the variant that is the best on it alone.
    stand_ins : tuple of StandIn
    improvement : Improvement
        What `improve` decides on the same records.
    improved : Variant or None
        Its last model among the variants.
    agreement : str
        A sentence: whether both agree.
    not_testable : tuple of NotTestable
    apart : mapping of str to str
        Models by name that cannot be held against the joint's own on these records, and why.
    spare : tuple of str
        Effects of the joint's own model that do not earn their parameters on these records.
    """

    joint: Joint
    data: Dataset
    variants: tuple[Variant, ...]
    screened: int
    front: tuple[Variant, ...]
    recommended: Variant
    ties: tuple[Variant, ...]
    windows: tuple[str, ...]
    by_record: tuple[tuple[str, str], ...]
    stand_ins: tuple[StandIn, ...]
    improvement: Improvement
    improved: Variant | None
    agreement: str
    not_testable: tuple[NotTestable, ...] = ()
    apart: Mapping[str, str] = field(default_factory=dict)
    spare: tuple[str, ...] = ()

    @property
    def start(self) -> Variant:
        """The joint's own model."""
        return next(v for v in self.variants if not v.added and not v.dropped)

    @property
    def reason(self) -> str:
        """One sentence: what is recommended, and what ties with it."""
        return _reason(self)

    @property
    def alike(self) -> str:
        """What ties with the recommended variant, in words; empty where nothing does."""
        return _alike(self)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to doubt about records and start model."""
        return self.improvement.warnings

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameters of the recommended variant (see
        :func:`identification.fitting.parameters.parameter_table`).
        """
        return parameter_table(self.recommended.solution, self.data)

    def to_joint_file(self) -> str:
        """The joint with the recommended variant, as the text of a joint file."""
        return joint_text(self.joint, self.recommended.solution, self.data)

    def __repr__(self) -> str:
        return "\n".join(table_of(self, IN_SHORT)[:25])

    def _repr_html_(self) -> str | None:
        return html_of(self)

    def as_json(self) -> dict[str, Any]:
        """The result as data."""
        return {
            "records": {
                "train": list(self.data.train_names),
                "held_out": list(self.data.held_out_names),
                "note": self.data.note,
            },
            "screened": self.screened,
            "variants": [v.as_json() for v in self.variants],
            "pareto": [list(v.labels) for v in self.front],
            "recommended": list(self.recommended.labels),
            "added": list(self.recommended.added),
            "ties": [list(v.labels) for v in self.ties],
            "stability": {
                "windows": list(self.windows),
                "records": [{"record": r, "best": name} for r, name in self.by_record],
                "resampled_percent": self.recommended.chosen_percent,
            },
            "stand_ins": [s.as_json() for s in self.stand_ins],
            "improve": {
                "added": list(self.improvement.added),
                "labels": None if self.improved is None else list(self.improved.labels),
                "sets": [list(c.effects) for c in self.improvement.claims],
                "verdict": self.improvement.verdict,
            },
            "spare": list(self.spare),
            "agreement": self.agreement,
            "reason": self.reason,
            "per_effect": PER_EFFECT,
            "per_further_parameter": PER_FURTHER,
            "not_testable": [{"effect": n.effect, "why": n.why} for n in self.not_testable],
            "not_compared": [{"model": n, "why": why} for n, why in self.apart.items()],
            "warnings": list(self.warnings),
        }


# --- sentences ------------------------------------------------------------------------------------


def _listed(labels: Sequence[str]) -> str:
    """Effects in a sentence."""
    titles = [title_of(label) for label in labels]
    return " and ".join([", ".join(titles[:-1]), titles[-1]]) if len(titles) > 1 else titles[0]


def title_of(label: str) -> str:
    """Title of an effect, with its place where it may act in several."""
    bare, _, number = label.partition("#")
    key, _, place = bare.partition("@")
    title = EFFECTS[key].title
    where = f" ({words(place)})" if place else ""
    return f"{title}{where}" + (f", number {number}" if number else "")


def _difference(v: Variant) -> str:
    """What a variant changes, in a sentence."""
    said = []
    if v.added:
        said.append(f"with {_listed(v.added)}")
    if v.dropped:
        said.append(f"without {_listed(v.dropped)}")
    return " and ".join(said) or "as it stands"


def _beside(best: Variant, tie: Variant) -> str:
    """A tie in words: what it changes, or what only its price keeps out of the best one."""
    more = [label for label in tie.added if label not in best.added]
    if tie.dropped or not set(best.added) < set(tie.added):
        return _difference(tie)
    return f"the same with {_listed(more)} as well, which lowers the error by less than is asked"


def _reason(found: Exploration) -> str:
    best = found.recommended
    said = f"Recommended: the joint's model {_difference(best)}"
    if not found.alike:
        return f"{said}; nothing else that was fitted ties with it."
    return f"{said}. These records do not tell it from: {found.alike}."


def sets_of_ties(
    best: Sequence[str], ties: Collection[frozenset[str]]
) -> tuple[tuple[str, ...], ...]:
    """Sets of labels, one for each label of the best variant, so that every choice of one of each
    is a tie; empty where fewer than two of them leave a choice.

    Two places with two names each make four variants that tie: one name of each set is what a
    reader has to settle, not which of four models it is.

    Parameters
    ----------
    best : sequence of str
        Labels that the recommended variant adds.
    ties : collection of frozenset of str
        Labels that each variant adds which ties, the best one among them.
    """
    whole = frozenset(best)
    sets = [
        (
            label,
            *sorted(
                other
                for tie in ties
                if len(tie) == len(whole) and whole - tie == {label}
                for other in tie - whole
            ),
        )
        for label in best
    ]
    if sum(len(s) > 1 for s in sets) < 2:
        return ()
    known = set(ties)
    made = {frozenset(chosen) for chosen in itertools.product(*sets)}
    return tuple(sets) if made <= known else ()


def _alike(found: Exploration) -> str:
    """What ties with the recommended variant, in words."""
    best = found.recommended
    ties = [v for v in found.ties if not v.dropped]
    sets = sets_of_ties(best.added, [frozenset(v.added) for v in ties])
    made = {frozenset(chosen) for chosen in itertools.product(*sets)} if sets else set()
    others = [
        v for v in found.ties if v is not best and (v.dropped or frozenset(v.added) not in made)
    ]
    said = []
    if sets:
        choices = [f"one of ({', '.join(map(title_of, s))})" for s in sets if len(s) > 1]
        sure = [s[0] for s in sets if len(s) == 1]
        beside = f" beside {_listed(sure)}" if sure else ""
        said.append(f"any other choice of {' and '.join(choices)}{beside}")
    most = ALTERNATIVES - len(said)
    said += [_beside(best, v) for v in others[:most]]
    more = len(others) - most
    return "; ".join(said) + (f"; and {more} more" if more > 0 else "")


def agreement_of(
    found: Improvement, improved: Variant | None, recommended: Variant, start: JointModel
) -> str:
    """Whether `improve` and the exploration agree, in a sentence."""
    added = added_to(start, found.model)
    named = f"`improve` adds {_listed(added)}" if added else "`improve` adds nothing"
    gone = [label for label in added if improved is None or label not in improved.labels]
    if gone:
        named += f", of which {_listed(gone)} comes out with no size"
    if improved is None:
        return f"{named}."
    if improved is recommended:
        return f"{named}: the same."
    keys = {label.partition("@")[0].partition("#")[0] for label in recommended.added}
    sets = [set(c.effects) for c in found.claims]
    if (
        not recommended.dropped
        and len(sets) == len(keys)
        and all(any(k in s for k in keys) for s in sets)
        and all(any(k in s for s in sets) for k in keys)
    ):
        return f"{named}, in a set with what is recommended here: no contradiction."
    if improved.tied:
        return f"{named}, which ties with what is recommended here."
    rise = 100 * (improved.error_percent / recommended.error_percent - 1)
    return (
        f"{named}; the variant recommended here is preferred by {improved.score:.2g} in the score, "
        f"and that of `improve` has a held-out error {abs(rise):.2g} % "
        f"{'higher' if rise > 0 else 'lower'} with {improved.parameters} parameters in place of "
        f"{recommended.parameters}."
    )


def _score(v: Variant) -> str:
    return "-" if math.isnan(v.score) else f"{v.score:.2f}"


def table_of(found: Exploration, most: int = PRINTED) -> list[str]:
    """The result as lines: a table 100 characters wide, then sentences.

    Parameters
    ----------
    found : Exploration
    most : int
        Variants of the table, beside the start model and the choice of `improve`.
    """
    chosen = list(found.variants[:most])
    curves = [v for v in found.variants if math.isnan(v.score)]
    chosen += [
        v for v in (found.improved, found.start, *curves) if v is not None and v not in chosen
    ]
    lines = [
        f"{'':3}{'variant':<{NAME}}{'par.':>5}{'held-out %':>11}{'of start':>9}"
        f"{'score':>7}{'best in':>8}"
    ]
    for v in sorted(chosen, key=found.variants.index):
        mark = "*" if v is found.recommended else "=" if v.tied else " "
        mark += "i" if v is found.improved else " "
        name, *more = textwrap.wrap(v.name, NAME - 1, break_on_hyphens=False)
        lines.append(
            f"{mark:<3}{name:<{NAME}}{v.parameters:>5}{v.relative_error_percent:>11.3f}"
            f"{v.error_percent:>7.1f} %{_score(v):>7}{v.chosen_percent:>6.0f} %"
        )
        lines += [f"{'':5}{line}" for line in more]
    lines += [
        f"{found.screened} variants scored, {len(found.variants)} fitted. * recommended, = tied, "
        "i improve.",
        found.reason,
        found.agreement,
    ]
    lines += [
        f"Not {v.name}, whose score is lower by {-v.score:.2g}: {v.behind}."
        for v in found.variants
        if v.behind and v.score < 0
    ][:ALTERNATIVES]
    if found.spare:
        lines.append(
            f"On these records the joint's own {_listed(found.spare)} could as well be left out: "
            "less than 10 % off a balance for each."
        )
    return lines
