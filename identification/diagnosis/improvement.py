"""What the improve loop gives back: steps, claims, verdict, and their shape as data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from casadi_models import JointModel
from identification.balance.calibration import Found, calibration_found
from identification.balance.dataset import HOLD_DELAY, Dataset, visible_labels
from identification.data.joint_file import Joint
from identification.diagnosis.candidates import NotTestable
from identification.diagnosis.claims import Claim, Ranking
from identification.diagnosis.learned import LearnedClaim
from identification.diagnosis.lines import Line
from identification.diagnosis.locate import Unexplained
from identification.diagnosis.outcome import Refusal, outcome_of, why_not
from identification.diagnosis.trials import Trial
from identification.fitting.assess import RATIO_LIMIT, BalanceError, Error
from identification.fitting.engine import Solution
from identification.fitting.joint_text import joint_text
from identification.fitting.parameters import parameter_table
from identification.representation import html_of

SPOILT_RISE: Final = 1.2
"""Rise of a balance's RMS by which an addition spoils it."""
SPOILT_RATIO: Final = 1.3
"""Ratio to the floor up to which a balance that has risen is still noise: floors hold within
some 10 to 20 %.
"""
MOST_DRIFT: Final = 0.5
"""Share of the noise's squares from which on its RMS over a record is that of one course of drift,
anything from a third to twice what is expected."""
RISE_LIMIT: Final = 1.02
"""Rise of the relative held-out error that an addition may cause."""


@final
@dataclass(frozen=True)
class Step:
    """One step of the loop: the model after an addition and its errors.

    Attributes
    ----------
    added : str or None
        Key of the effect that was added (None for the start model);
        :data:`~identification.diagnosis.learned.LEARNED` for curves.
    effects : tuple of str
        Keys in the model.
    train, held_out : Error
    solution : Solution
    """

    added: str | None
    effects: tuple[str, ...]
    train: Error
    held_out: Error
    solution: Solution
    label: str | None = None

    def as_json(self, data: Dataset) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {
            "added": self.added,
            "effects": list(self.effects),
            "labels": list(visible_labels(self.solution.model)),
            "train": self.train.as_json(),
            "held_out": self.held_out.as_json(),
            "parameters": parameter_table(self.solution, data),
        }


@final
@dataclass(frozen=True)
class Improvement:
    """Result of the loop (see contract: `improve --json`).

    Attributes
    ----------
    steps : tuple of Step
        The start model and one per addition.
    claims, minor : tuple of Claim
    ranking : Ranking
        The one before the first addition.
    lines : tuple of Line
    unexplained : tuple of Unexplained
    verdict : {"complete", "nothing_missing", "unexplained", "not_identifiable"}
    reason : str
        One sentence that a reader understands.
    refused : tuple of Refusal
        Every candidate that was tried and not named, with the reason.
    decided : tuple of Claim
        The claims as they were decided, one after the other; `claims` are what later ones left of
        them.
    learned : tuple of LearnedClaim
        Where the verdict is ``unexplained``: curves over one variable of what is left.
    carried : tuple of LearnedClaim
        Those that the joint file has: with the others the error of held-out records would rise.
    curved : Step or None
        The last model with these curves, behind the steps that names made.
    """

    joint: Joint
    data: Dataset
    steps: tuple[Step, ...]
    claims: tuple[Claim, ...]
    minor: tuple[Claim, ...]
    ranking: Ranking | None
    lines: tuple[Line, ...]
    unexplained: tuple[Unexplained, ...]
    verdict: str
    reason: str
    final_ratios: Mapping[str, BalanceError]
    not_testable: tuple[NotTestable, ...] = ()
    warnings: tuple[str, ...] = ()
    refused: tuple[Refusal, ...] = ()
    decided: tuple[Claim, ...] = ()
    learned: tuple[LearnedClaim, ...] = ()
    carried: tuple[LearnedClaim, ...] = ()
    curved: Step | None = None

    @property
    def outcome(self) -> str:
        """One of :data:`identification.diagnosis.outcome.OUTCOMES`."""
        return outcome_of(self.verdict, self.claims)

    def why(self, key: str) -> str:
        """Why an effect is named, or why it is not: one sentence.

        Raises
        ------
        InputError
            No effect of that key.
        """
        return why_not(key, self.claims, self.refused, self.not_testable, self.steps[0].effects)

    @property
    def added(self) -> tuple[str, ...]:
        """Keys added, in order."""
        return tuple(s.added for s in self.steps if s.added)

    @property
    def calibration(self) -> tuple[Found, ...]:
        """What the sensors of the training records are off by, on the final model: no physics,
        and never claimed.
        """
        if not self.steps:
            return ()
        last = self.steps[-1].solution
        return calibration_found(last.model, self.data.train, last.values, last.stderr)

    @property
    def model(self) -> JointModel:
        """The final model with its values."""
        return self.steps[-1].solution.model

    def to_joint_file(self) -> str:
        """The joint with all that was added, learned curves that lower the error of held-out
        records included, as the text of a joint file.
        """
        last = self.stairs[-1]
        return joint_text(self.joint, last.solution, self.data, last.train.balances)

    @property
    def stairs(self) -> tuple[Step, ...]:
        """The falling error: start model, a step for each name, one for learned curves."""
        return self.steps if self.curved is None else (*self.steps, self.curved)

    def __str__(self) -> str:
        lines = [self.reason]
        for step in self.stairs:
            ratios = "  ".join(f"{b} {e.ratio:.3g}" for b, e in step.held_out.balances.items())
            name = f"+ {step.added}" if step.added else "start model"
            lines.append(
                f"{name:<28} {step.held_out.relative_error_percent:8.3f} % held-out; over noise "
                f"floor: {ratios}"
            )
        for claim in self.claims:
            names = " or ".join(claim.effects)
            apart = (
                f"; separate by {claim.separate_by}"
                if len(claim.effects) > 1 and claim.separate_by
                else ""
            )
            lines.append(
                f"{'in part' if claim.partial else 'missing'}: {names} ({claim.balance} "
                f"balance){f'; {claim.surety}' if claim.confidence else ''}{apart}"
            )
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Improvement({self.verdict}, added: {list(self.added)}, {len(self.steps)} steps)"

    def _repr_html_(self) -> str | None:
        return html_of(self)

    def as_json(self) -> dict[str, Any]:
        """The loop as data; held to improve.schema.json by a test."""
        significant = self.ranking.significant if self.ranking else frozenset()
        best = self.ranking.everything[0] if self.ranking and self.ranking.everything else None
        return {
            "records": {
                "train": list(self.data.train_names),
                "held_out": list(self.data.held_out_names),
                "note": self.data.note,
            },
            "steps": [s.as_json(self.data) for s in self.steps],
            "with_curves": self.curved.as_json(self.data) if self.curved else None,
            "added": list(self.added),
            "claims": [
                *(c.as_json() for c in self.claims),
                *(c.as_json() for c in self.learned),
            ],
            "minor": [c.as_json() for c in self.minor],
            "lines": [line.as_json() for line in self.lines],
            "ranking": [
                ranked_json(t, t.candidate.label in significant) for t in self.ranking.trials
            ]
            if self.ranking
            else [],
            "not_testable": [{"effect": n.effect, "why": n.why} for n in self.not_testable],
            "verdict": self.verdict,
            "outcome": self.outcome,
            "reason": self.reason,
            "refused": [r.as_json() for r in self.refused],
            "unexplained": [u.as_json() for u in self.unexplained],
            "floor_ratio": {b: e.as_json() for b, e in self.final_ratios.items()},
            "calibration": [c.as_json() for c in self.calibration],
            "warnings": list(self.warnings),
            "best_candidate": best.key if best else None,
        }


def ranked_json(trial: Trial, significant: bool) -> dict[str, Any]:
    """One row of the ranking."""
    drop = (
        trial.held_out_drop_percent
        if not math.isnan(trial.held_out_drop_percent)
        else trial.cv_drop_percent
    )
    return {
        "effect": trial.key,
        "title": trial.candidate.effect.title,
        "balance": trial.balance,
        "held_out_drop_percent": drop,
        "significant": significant,
        "confusable_with": list(trial.candidate.effect.confused_with),
        "place": trial.candidate.place,
        "cv_drop_percent": trial.cv_drop_percent,
        "gain_nats": trial.gain,
        "p_value": trial.p_value,
    }


def visible_keys(model: JointModel) -> tuple[str, ...]:
    """Keys of the effects in the model, each once."""
    return tuple(dict.fromkeys(t.effect.key for t in model.terms if t.label != HOLD_DELAY))


def made_worse(before: Error, after: Error) -> str:
    """Why an addition is refused on held-out records: a balance that it spoils, or the error as a
    whole; empty where it is not.

    The error is that of all balances, each on one weighting, as where they are judged one by one:
    at a turn that falls between two samples, a row without weight holds more than a law of a few
    percent moves in all others. A rise to no more than noise leaves is none: beside the law that is
    missing, noise can be taken off the rows, and an inertia that is right passes more of it on.
    """
    why = spoilt(before, after)
    if why:
        return why
    pairs = [common_rms(before, after, b) for b in after.balances]
    pairs = [
        (old, min(old, new) if _is_noise(before, after, b) else new)
        for b, (old, new) in zip(after.balances, pairs, strict=True)
    ]
    counts = [max(len(e.residual), 1) for e in after.balances.values()]
    old, new = np.sqrt(np.average(np.square(pairs), axis=0, weights=counts))
    if new > RISE_LIMIT * old:
        return f"the held-out error rises by {100 * (new / old - 1):.3g} % in all"
    return ""


def spoilt(before: Error, after: Error) -> str:
    """Which balance an addition spoils on held-out records; empty where it spoils none.

    Balances are compared by their RMS on one weighting, common to both models. A floor alone
    refuses nothing: a balance is spoilt where its own RMS rises, and above what noise explains
    under the larger of both floors; and where it was noise and is none any more. A law that takes
    over what a stiffness carries leaves less of the encoders' noise, and structure in it. Noise
    that the records do not hold once the law is there was none before: a ripple in a current reads
    as noise of it until it is one.
    """
    for b, e in after.balances.items():
        first = before.balances[b]
        was = first.ratio * max(first.believed / max(e.believed, 1e-300), 1.0)
        if was <= SPOILT_RATIO and e.ratio > RATIO_LIMIT:
            return (
                f"what was noise in the {b} balance on held-out records ({was:.3g} times its "
                f"floor) is {e.ratio:.3g} times what noise leaves with it"
            )
        old, new = common_rms(before, after, b)
        if new > SPOILT_RISE * old and not _is_noise(before, after, b):
            return (
                f"the RMS of the {b} balance rises by {100 * (new / old - 1):.3g} % on "
                "held-out records"
            )
    return ""


def _is_noise(before: Error, after: Error, balance: str) -> bool:
    """Whether what is left of a balance after an addition is no more than noise leaves under the
    larger of both floors.
    """
    floor = max(before.balances[balance].floor, after.balances[balance].floor)
    return after.balances[balance].rms <= SPOILT_RATIO * floor


def common_rms(before: Error, after: Error, balance: str) -> tuple[float, float]:
    """RMS of a balance before and after, each row weighted by the larger of the two scatters
    that noise allows it.
    """
    one, two = before.balances[balance], after.balances[balance]
    if len(one.residual) != len(two.residual) or not len(one.residual):
        return one.rms, two.rms
    weight = np.minimum(one.weight, two.weight)
    size = max(float(np.sqrt(np.mean(weight**2))), 1e-300)
    old, new = (float(np.sqrt(np.mean((e.residual * weight) ** 2))) / size for e in (one, two))
    return old, new


def judged_drop(before: Error, after: Error, balance: str) -> float:
    """Fall of a balance's RMS in percent, on one weighting: what an addition is judged by.

    In a balance that is noise before and after it is in units of the noise that each model passes
    on: a gain that stands for an inertia takes the noise of an encoder away and explains nothing.
    A floor that is lower because the records leave less than such noise is no unit: then structure
    was read as noise, as a fast ripple is, and the addition takes it off. Where most of the noise
    is a drift, a record holds one course of it, which any law may follow a little: then what the
    drift does not foretell must fall as well.
    """
    old, new = common_rms(before, after, balance)
    one, two = before.balances[balance], after.balances[balance]
    passed = one.floor / max(one.believed, 1e-300), two.floor / max(two.believed, 1e-300)
    noise = max(one.ratio, two.ratio) <= RATIO_LIMIT
    unit = passed[1] / passed[0] if noise and 0 < passed[1] < passed[0] else 1.0
    fall = 1 - new / (old * unit) if old > 0 else 0.0
    if noise and one.drifting > MOST_DRIFT:
        fall = min(fall, 1 - two.ratio / max(one.ratio, 1e-300))
    return 100 * fall


def held_drop(before: Error, after: Error, balance: str) -> float:
    """Fall of a balance's RMS in percent, each as it is reported."""
    old = before.balances[balance].rms
    return 100 * (1 - after.balances[balance].rms / old) if old > 0 else 0.0
