"""The words that results are told in: outcomes with their next step, and the glossary.

The page, the report, the notebook and the command line take them from here, so that one word means
one thing: what `irj improve` prints of a result stands on the page line by line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from casadi_models import EFFECTS
from identification.balance.dataset import HOLD_NAME
from identification.data.formats import words
from identification.diagnosis.improve import Improvement
from identification.diagnosis.learned import LEARNED
from identification.diagnosis.locate import Unexplained


@final
@dataclass(frozen=True)
class Outcome:
    """One of the answers of :data:`identification.diagnosis.outcome.OUTCOMES`.

    Attributes
    ----------
    headline : str
        In a few words.
    next_step : str
        What to do now: one sentence.
    """

    headline: str
    next_step: str


OUTCOME_WORDS: Final[Mapping[str, Outcome]] = {
    "found": Outcome(
        "Found what was missing",
        "Take the effect into the model, and check the joint file on a record of another motion, "
        "payload or temperature.",
    ),
    "set": Outcome(
        "Found what was missing, as one of several names",
        "These records cannot tell the names apart: make the run that separates them, and take "
        "none of them as physics until then.",
    ),
    "complete": Outcome(
        "Nothing is missing",
        "Use the model as it is, and check it on a record of another motion, payload or "
        "temperature.",
    ),
    "unexplained": Outcome(
        "Something is left that the library cannot explain",
        "Look at the place where it is left: repeat the motion there, slower and faster, or write "
        "a law of your own for it.",
    ),
    "not_identifiable": Outcome(
        "These records cannot answer the question",
        "Record a motion that excites the joint; the reason says what is missing.",
    ),
}
PART: Final = "Found a part of what is missing; something is left"
"""Headline where effects were named and structure is left beside them."""
CURVES: Final = "learned curves"
"""What the step behind the names is called."""

GLOSSARY: Final[Mapping[str, str]] = {
    "balance": "sum of the torques that must be zero on one side of the gear: at the motor, at the "
    "link, or through the gear. What a balance leaves over is the residual.",
    "residual": "measured torque minus the torque that the model gives, referred to the link.",
    "held-out record": "a record that the fit never saw; the error on it cannot fall by fitting "
    "noise.",
    "noise floor": "the residual that measurement noise alone would leave in a complete model.",
    "÷ noise": "residual over the noise floor of its balance, row by row; 1 × cannot be improved. "
    "What the instant of a turn, a drift or a value that stays open may add counts as noise here "
    "and not in the floor, so it may be smaller than the quotient of the two.",
    "fit": "100 % less the share of the torque's variation about its mean that is not explained.",
    "VAF": "variance accounted for: 100 % less the share of the torque's variance that is not "
    "explained.",
    "set": "names that these records cannot tell apart: one of them is missing, and a named run "
    "would say which.",
    "in part": "explains some of what is missing in its balance; structure is left there that is "
    "not in the library.",
    "place": "the mean residual against one measured signal, with a band of 95 %.",
    "referred to the link": "a motor's angle divided by the gear ratio, its torque multiplied by "
    "it, so that both sides of the gear can stand in one equation.",
    "learned curve": "the missing torque as a free curve over one signal, where no law of the "
    "library is as good.",
}
"""Every term that a reader may not know, by the word that stands on the page."""


def kind_of(result: Mapping[str, Any]) -> str:
    """Which of the outcomes the whole of an `improve --json` result is, for its colour and its next
    step: what is left unexplained weighs more than what was found.
    """
    if result["verdict"] in ("unexplained", "not_identifiable"):
        return str(result["verdict"])
    named = [c for c in result["claims"] if "curve" not in c]
    if any(len(c["effects"]) > 1 for c in named):
        return "set"
    return "found" if named else "complete"


def run_that_shows(key: str, kind: str) -> str:
    """The motion that an effect needs; empty where no motion of this kind of axis shows it."""
    effect = EFFECTS.get(key)
    return "" if effect is None or (effect.angular and kind == "linear") else effect.excitation


def headline(result: Mapping[str, Any]) -> str:
    """The verdict of an `improve --json` result in a few words."""
    if result["verdict"] == "unexplained" and any("curve" not in c for c in result["claims"]):
        return PART
    return OUTCOME_WORDS[kind_of(result)].headline


def title_of(label: str) -> str:
    """Title of the effect that a key or a label names, with its place and without internal marks:
    ``stribeck@motor`` is "Stribeck effect (motor)".
    """
    key, _, place = label.partition("#")[0].partition("@")
    title = EFFECTS[key].title if key in EFFECTS else words(key)
    return f"{title} ({words(place)})" if place else title


def plain_name(name: str) -> str:
    """A parameter's name for a reader: underscores as spaces, no mark of an instance."""
    return words(name.partition("#")[0])


def name_in_formula(name: str) -> str:
    """A symbol of the equations for a reader: parameters and signals as words, rates and states of
    a memory as what they are.
    """
    if name == HOLD_NAME:
        return "hold of the drive"
    if (rate := re.fullmatch(r"(\w+)_rate", name)) is not None:
        return f"rate of {words(rate[1])}"
    if (state := re.fullmatch(r"(\w+)_(\d+)", name)) is not None and any(
        e.memory is not None and state[1].startswith(e.key) for e in EFFECTS.values()
    ):
        return f"state {int(state[2]) + 1} of {words(state[1])}"
    return plain_name(name)


# --- a result, line by line -----------------------------------------------------------------------


def printed(found: Improvement) -> str:
    """A result as `irj improve` prints it."""
    lines = (found.reason, *step_lines(found), *finding_lines(found))
    return "\n".join([*lines, *untested_lines(found.not_testable)])


def step_lines(found: Improvement) -> list[str]:
    """The note on the records, and the falling error as a table."""
    lines = [f"note: {found.data.note}"] if found.data.note else []
    lines.append(f"{'step':<32} {'train %':>8} {'held-out %':>10}   residual over noise floor")
    for step in found.stairs:
        ratios = "  ".join(f"{b} {e.ratio:.3g}" for b, e in step.held_out.balances.items())
        what = CURVES if step.added == LEARNED else step.added
        name = f"+ {what}" if what else "start model"
        lines.append(
            f"{name:<32} {step.train.relative_error_percent:8.3f} "
            f"{step.held_out.relative_error_percent:10.3f}   {ratios}"
        )
    return lines


def finding_lines(found: Improvement) -> list[str]:
    """What was named, with its numbers; what repeats, what is left, what was learned, and what the
    sensors are off by.
    """
    lines = []
    for claim in found.claims:
        names = (
            claim.effects[0] if len(claim.effects) == 1 else "{" + ", ".join(claim.effects) + "}"
        )
        if claim.like:
            names = claim.like
        said, rest = (
            ("in part", "; structure is left that is not in the library")
            if claim.partial
            else ("missing", "")
        )
        lines.append(
            f"{said}: {names}, {claim.balance} balance, held-out RMS falls by "
            f"{claim.held_out_drop_percent:.1f} %"
            + (f" of rows of {claim.kernel:.2g} s" if claim.kernel is not None else "")
            + rest
        )
        if claim.confidence:
            lines.append(f"  by the likelihoods of whole fits: {claim.surety}")
        if claim.separate_by:
            lines.append(
                f"  these cannot be told apart on these records; {claim.separate_by} would "
                "separate them"
            )
    lines += [
        f"minor, small but certain: {', '.join(claim.effects)} ({claim.balance} balance, "
        f"{claim.held_out_drop_percent:.1f} %)"
        for claim in found.minor
    ]
    for line in found.lines:
        named = f", {' or '.join(line.effects)}" if line.effects else ", function of position"
        lines.append(
            f"line: order {line.order:.3f} +- {line.tolerance:.3f} per {line.per}, "
            f"{line.amplitude:.3g} {line.unit} ({line.balance}{named})"
        )
    lines += place_lines(found.unexplained)
    lines += [f"learned: {learned.sentence}" for learned in found.learned]
    for c in found.calibration:
        if c.bounded:
            would = (
                "a motion that changes faster would"
                if found.data.sensing.has_torque
                else "a torque sensor would"
            )
            lines.append(
                f"calibration bounded: {c.what} of {c.sensor} in {found.data.train_names[c.run]} "
                f"within {2 * (c.stderr or 0.0):.2g} {c.unit} of {c.value:.4g} {c.unit}; these "
                f"records cannot tell it from viscous friction, {would}"
            )
        elif c.stderr is not None and abs(c.value) > 2 * c.stderr:
            name = found.data.train_names[c.run]
            lines.append(
                f"calibration found: {c.what} of {c.sensor} in {name} {c.value:.4g} +- "
                f"{2 * c.stderr:.2g} {c.unit}{filtered(c.as_json())} (taken off, no physics)"
            )
    return lines


def filtered(found: Mapping[str, Any]) -> str:
    """Which part of a lateness is that of a filter; `found` as in the data of a result."""
    waits = found["waits"]
    if waits is None:
        return ""
    rest = f"it waits {waits:.3g} {found['unit']}, the rest is" if waits else "that of"
    return f": {rest} a filter"


def place_lines(places: Sequence[Unexplained]) -> list[str]:
    """Where structure is left that no effect explains."""
    lines = []
    for place in places:
        where = "no measured variable"
        if place.axis and place.low is not None and place.high is not None:
            where = f"{place.axis} from {place.low:.3g} to {place.high:.3g} {place.unit}"
        extra = (
            f", order {place.order:.2f}"
            if place.order
            else (f", near {place.frequency_hz:.1f} Hz" if place.frequency_hz else "")
        )
        lines.append(
            f"unexplained: {place.balance} balance, depends on {where} "
            f"({place.share_percent:.0f} % of it){extra}"
        )
    return lines


def untested_lines(items: Sequence[Any], *, verbose: bool = False) -> list[str]:
    """What these records cannot show, in one line; `verbose`: each effect with the reason."""
    if verbose:
        return [f"not testable: {item.effect}: {item.why}" for item in items]
    return [f"not testable ({len(items)}): -v lists them with the reason"] if items else []


def left_behind(found: Improvement) -> str:
    """What the joint file of a loop is without, behind its name; empty where it has all."""
    left = len(found.learned) - len(found.carried)
    return f"without {left} of the learned curves: they raise the held-out error" if left else ""
