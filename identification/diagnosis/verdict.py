"""The verdict of the loop, the sentence that a reader gets, and warnings about the model it
started from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from casadi_models import EFFECTS
from identification.balance.dataset import Dataset
from identification.data.formats import number
from identification.diagnosis.candidates import turns_unseen
from identification.diagnosis.claims import Claim
from identification.diagnosis.improvement import Step
from identification.diagnosis.locate import Unexplained
from identification.fitting.assess import BalanceError
from identification.fitting.engine import Solution

HARDLY: Final = 90.0
"""Relative error of the start model from which units and signs are doubted [%]."""


def _remainder(claim: Claim, unit: str) -> str:
    """A set of more names than help anybody."""
    hint = (
        f" {claim.separate_by[0].upper()}{claim.separate_by[1:]} would help."
        if claim.separate_by
        else ""
    )
    size = f"{number(claim.contribution, 2)} {unit} remain that cannot be named"
    titles = ", ".join(EFFECTS[e].title for e in claim.effects)
    return f"In the {claim.balance} balance {size}: any of {titles} explains it alike.{hint}"


def _names(claims: Sequence[Claim]) -> str:
    # names that share one curve are told in one sentence
    return " and ".join(
        dict.fromkeys(
            (c.like or EFFECTS[c.effects[0]].title)
            if len(c.effects) == 1
            else "one of (" + ", ".join(EFFECTS[e].title for e in c.effects) + ")"
            for c in claims
        )
    )


def verdict_of(
    claims: Sequence[Claim],
    where: Sequence[Unexplained],
    ratios: Mapping[str, BalanceError],
    steps: Sequence[Step],
    following: str | None,
    few: str,
    unnamed: Claim | None = None,
) -> tuple[str, str]:
    """Verdict and its sentence.

    `following`: what would come next, where the additions stopped at a limit; `few`: the motor
    reverses too seldom, which no library makes up for; `unnamed`: a set too large to be a name.
    """
    names, parts = (
        _names([c for c in claims if not c.partial]),
        _names([c for c in claims if c.partial]),
    )
    was, now = (step.held_out.relative_error_percent for step in (steps[0], steps[-1]))
    fall = (
        f"the error on held-out data {'falls' if now < was else 'goes'} from {was:.3g} % to "
        f"{now:.3g} %"
    )
    slow = dict.fromkeys(
        f"in rows of {c.kernel:.2g} s, whose noise is lower, the {c.balance} balance falls by "
        f"{c.held_out_drop_percent:.2g} %"
        for c in claims
        if c.kernel is not None
    )
    fall = "; ".join([fall, *slow])
    if where:
        left = ", ".join(
            f"{u.balance} ({number(ratios[u.balance].ratio, 2)} times its noise floor)"
            for u in where
        )
        found = (
            f"Missing: {names}; {fall}. "
            if names
            else f"{fall[0].upper()}{fall[1:]}. "
            if parts
            else ""
        )
        found += f"Only part of the structure is explained by: {parts}. " if parts else ""
        if following is not None:
            return "unexplained", f"{found}{following} Left over: {left}."
        if unnamed is not None:
            return (
                "unexplained",
                f"{found}{_remainder(unnamed, ratios[unnamed.balance].unit)} Left over: {left}.",
            )
        if few:
            seldom = "too seldom to name friction or a law with memory: record more reversals."
            return "unexplained", f"{found}Left over: {left}. {few[0].upper()}{few[1:]}, {seldom}"
        if claims:
            return "unexplained", f"{found}Structure that is not in the library is left in: {left}."
        return "unexplained", f"No effect of the library explains what is left in: {left}."
    if unnamed is not None:
        return "unexplained", (f"Missing: {names}; {fall}. " if claims else "") + _remainder(
            unnamed, ratios[unnamed.balance].unit
        )
    if claims:
        found = f"Missing: {names}; with it {fall}" if names else f"{fall[0].upper()}{fall[1:]}"
        only = f" Only part of what such rows show is explained by: {parts}." if parts else ""
        return "complete", f"{found}, and what is left looks like measurement noise.{only}"
    return (
        "nothing_missing",
        "The model explains the records down to their measurement noise: nothing is missing that "
        "these records could show.",
    )


def curves_told(last: Step, curved: Step, count: int) -> str:
    """How far the error falls with learned curves behind the last name."""
    was, now = (step.held_out.relative_error_percent for step in (last, curved))
    what = f"{count} learned curves" if count > 1 else "the learned curve"
    return f"With {what} in the model it falls from {was:.3g} % to {now:.3g} %."


def hardly_a_model(start: Step) -> tuple[str, ...]:
    """A start model that explains next to nothing, or has no stiffness: what is claimed on top
    of it hangs in the air.
    """
    error, out = start.train.relative_error_percent, []
    if error >= HARDLY:
        doubt = "check units and signs in [columns], the motor constant and gear_ratio"
        out.append(
            f"the start model leaves {error:.3g} % of the measured torque unexplained: {doubt}"
        )
    if start.solution.model.stiffness_name in start.solution.at_bound:
        doubt = "check gear_ratio, the scale and the zero of both positions"
        out.append(
            "the stiffness went to zero: the difference of the two positions does not follow "
            f"the torque: {doubt}"
        )
    return tuple(out)


def open_notes(left_open: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """What held-out records leave over the noise because the fit leaves parameters open."""
    return tuple(
        f"in the {balance} balance the held-out records stand over the noise by no more than "
        f"the training records leave open of {', '.join(names)}: train on motion like theirs, too"
        for balance, names in left_open.items()
    )


def unseen(solution: Solution) -> tuple[str, ...]:
    """Parameters of the model that no channel of the records shows."""
    kept = [n for n in solution.unidentified if n not in solution.free]
    if not kept:
        return ()
    many = len(kept) > 1
    return (
        f"{', '.join(kept)}: no channel of these records shows {'them' if many else 'it'}; "
        f"{'they keep their values' if many else 'it keeps its value'}",
    )


def without_motor(data: Dataset) -> tuple[str, ...]:
    """What is hidden where the link alone is recorded behind a gear."""
    if not turns_unseen(data) or not data.sensing.has_drive:
        return ()
    return (
        "the motor position is not recorded: the link stands in for it; the twist between them and "
        "the instant at which the motor turns leave a rest over the noise",
    )


def without_link(solution: Solution) -> tuple[str, ...]:
    """What stands in for the link position where it is not recorded."""
    if not solution.model.load_compliance(solution.values):
        return ()
    swing = 1 / (
        2
        * math.pi
        * math.sqrt(
            solution.model.swinging_inertia(solution.values)
            * solution.model.load_compliance(solution.values)
        )
    )
    return (
        "the link position is not recorded: the compliance between motor and link is fitted along; "
        f"with the motor held the link would swing at {swing:.3g} Hz; its friction counts as the "
        "motor's",
    )


def longer_rows(over: Mapping[str, tuple[float, float]]) -> tuple[str, ...]:
    """What longer rows still show over their floor that no name explains: the rows of the verdict
    do not show it.

    `over`: length of the rows [s] and ratio to their floor, by balance.
    """
    return tuple(
        f"in rows of {kernel:.2g} s, whose noise is lower, the {balance} balance still stands at "
        f"{number(ratio, 2)} times its noise floor, and no name explains it: a small effect, or "
        "slow errors of a sensor"
        for balance, (kernel, ratio) in over.items()
    )
