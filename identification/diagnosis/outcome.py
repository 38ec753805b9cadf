"""What a decision about a model can say: four outcomes, and why a candidate was not named."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from casadi_models import EFFECTS
from identification.balance.kinematic import residual_unit
from identification.data.formats import number, words
from identification.data.schema import meant
from identification.diagnosis.candidates import NotTestable
from identification.diagnosis.claims import GAIN, Claim, Ranking, usual_drop
from identification.diagnosis.trials import Trial, enough_blocks
from identification.errors import InputError

OUTCOMES: Final = ("found", "set", "complete", "unexplained", "not_identifiable")
"""The four answers, and the one that says that the records cannot carry the question; unusable
input is an `InputError`.
"""


@final
@dataclass(frozen=True)
class Refusal:
    """A candidate that was tried and not named.

    Attributes
    ----------
    effect : str
        Its key.
    why : str
        One clause, as "falls by 2 % after the whole fit (5 % asked)".
    least : float or None
        About the smallest RMS of its torque that these records would name [unit]; a smaller one may
        be there. None where its trial does not tell.
    unit : str
    """

    effect: str
    why: str
    least: float | None = None
    unit: str = ""

    @property
    def unseen(self) -> str:
        """A clause on what may be there unseen; empty where that is not told."""
        if self.least is None:
            return ""
        return f"; less than about {number(self.least, 2)} {self.unit} RMS of it would not be seen"

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        told = {} if self.least is None else {"least": self.least, "unit": self.unit}
        return {"effect": self.effect, "why": self.why, **told}


def outcome_of(verdict: str, claims: Sequence[Claim]) -> str:
    """Which of `OUTCOMES` a verdict with these claims is; a claim in part names nothing."""
    whole = next((c for c in claims if not c.partial), None)
    if whole is not None:
        return "found" if len(whole.effects) == 1 else "set"
    return "complete" if verdict in ("complete", "nothing_missing") else verdict


def key_of(label: str) -> str:
    """Key of the effect that a label names, without place and number."""
    return label.partition("@")[0].partition("#")[0]


def weak(trial: Trial) -> str:
    """Why a candidate that the blocks or the held-out records do not support is no claim."""
    least = usual_drop(trial)
    first, then = trial.cv_drop_percent, trial.held_out_drop_percent
    way, other = ("lowers", "raises") if first >= 0 else ("raises", "lowers")
    found = (
        f"{way} the {trial.balance} balance by {abs(first):.2g} % on blocks it was not fitted to"
    )
    if not math.isnan(then):
        same = (then >= 0) == (first >= 0)
        found += f" and {'' if same else f'{other} it '}by {abs(then):.2g} % on held-out records"
    amplitudes, blocks = len(trial.candidate.amplitudes), len(trial.block_score)
    if first >= least and not enough_blocks(blocks, amplitudes):
        return (
            f"{found}: {blocks} blocks of time do not tell it from chance where "
            f"{amplitudes + 2} are asked; record for longer"
        )
    if first >= least and trial.gain <= GAIN < trial.own_gain:
        return f"{found} (p = {trial.p_value:.2g}): the other balances lose what this one gains"
    if first >= least and trial.gain <= GAIN:
        return (
            f"{found} (p = {trial.p_value:.2g}): what is left hangs together over so long that "
            f"this is {max(trial.gain, 0.0):.2g} nats, and {GAIN:g} are asked; record for longer"
        )
    return f"{found} (p = {trial.p_value:.2g}): too little, or not to be told from chance"


def refusals(
    ranking: Ranking | None,
    recorded: Mapping[str, str],
    claims: Sequence[Claim],
    offered: Sequence[str] = (),
    kind: str = "rotary",
) -> tuple[Refusal, ...]:
    """Every candidate that was tried and not named, with the reason, each key once.

    Parameters
    ----------
    ranking : Ranking or None
        The first one.
    recorded : mapping of label to str
        Reasons that a decision gave.
    claims : sequence of Claim
    offered : sequence of str
        Keys that were tried; those without a trial helped in no physical direction.
    kind : str
        Of the joint.
    """
    named = {key for claim in claims for key in claim.effects}
    out = {key_of(label): why for label, why in recorded.items()}
    told: dict[str, tuple[float, str]] = {}
    for trial in ranking.trials if ranking else ():
        if trial.key in out:
            continue
        if ranking is not None and trial.candidate.label in ranking.significant:
            added = " and ".join(EFFECTS[c.effects[0]].title for c in claims)
            out[trial.key] = (
                f"with {added} in the model it is not needed"
                if added
                else "no whole fit of it was made"
            )
        else:
            out[trial.key] = weak(trial)
            if ranking is not None and trial.key in ranking.least:
                told[trial.key] = ranking.least[trial.key], residual_unit(trial.balance, kind)
    untestable = {n.effect for n in ranking.not_testable} if ranking else set()
    for key in offered:
        if key not in untestable:
            out.setdefault(key, "lowers no error with any physical value")
    return tuple(
        Refusal(key, why, *told.get(key, ())) for key, why in out.items() if key not in named
    )


def known_key(key: str) -> str:
    """The key of an effect of the library.

    Raises
    ------
    InputError
        No effect of that key.
    """
    wanted = key_of(key)
    if wanted not in EFFECTS:
        raise InputError(
            f"unknown effect {key!r}; `irj effects` lists the library{meant(wanted, EFFECTS)}"
        )
    return wanted


def why_not(
    key: str,
    claims: Sequence[Claim],
    refused: Sequence[Refusal],
    not_testable: Sequence[NotTestable],
    inside: Sequence[str],
) -> str:
    """One sentence: why an effect is named, or why it is not.

    Parameters
    ----------
    key : str
        Of the library.
    claims, refused, not_testable
        Of a decision.
    inside : sequence of str
        Keys in the model that was judged.

    Raises
    ------
    InputError
        No effect of that key.
    """
    wanted = known_key(key)
    title = EFFECTS[wanted].title
    for claim in claims:
        if wanted == claim.effects[0]:
            where = (
                f"lowers the {claim.balance} balance by {claim.held_out_drop_percent:.3g} % "
                "on held-out records"
            )
            return f"{title} is {'named in part' if claim.partial else 'named'}: it {where}."
        if wanted in claim.effects:
            how = f"; {claim.separate_by} would separate them" if claim.separate_by else ""
            return (
                f"{title} is in a set: these records cannot tell it from {claim.effects[0]}{how}."
            )
    for refusal in refused:
        if refusal.effect == wanted:
            whole = refusal.why.startswith(("with ", "the "))
            return f"{title} is not named: {'' if whole else 'it '}{refusal.why}{refusal.unseen}."
    for item in not_testable:
        if item.effect == wanted:
            return f"{title} is not testable with these records: {item.why}."
    if wanted in inside:
        return f"{title} is in the model already."
    needs = [n for n in EFFECTS[wanted].needs if n not in inside]
    if needs:
        return (
            f"{title} was not tried: it goes with {', '.join(words(n) for n in needs)}, which "
            "the model has not."
        )
    return (
        f"{title} was not tried on this model, or no value of it that is physical lowers an error."
    )
