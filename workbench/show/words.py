"""The words that results are told in: outcomes with their next step, and the glossary.

The page, the report and the notebook take them from here, so that one word means one thing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

from casadi_models import EFFECTS
from identification.data.formats import words


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

GLOSSARY: Final[Mapping[str, str]] = {
    "balance": "sum of the torques that must be zero on one side of the gear: at the motor, at the "
    "link, or through the gear. What a balance leaves over is the residual.",
    "residual": "measured torque minus the torque that the model gives, referred to the link.",
    "held-out record": "a record that the fit never saw; the error on it cannot fall by fitting "
    "noise.",
    "noise floor": "the residual that measurement noise alone would leave in a complete model.",
    "÷ noise": "residual over the noise floor of its balance; 1 × cannot be improved.",
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
