"""Candidates for what is missing: every effect of the library in every place, as regression
columns.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from casadi_models import EFFECTS, Effect, JointModel
from casadi_models.effect import ANYTHING_KNOWN, SECOND_BALANCE, TORQUE_SENSOR, Place
from identification.balance.dataset import HOLD_DELAY, Dataset, with_effect
from identification.balance.sensing import Sensing, idle_shapes

WARM_UP: Final = 15.0
"""Shortest run in which a warm-up is looked for without a temperature channel [s]."""

UNSEEN_TURN: Final = (
    "counts from where the motor turns, and the twist of the gear hides that; record motor_position"
)


@final
@dataclass(frozen=True)
class NotTestable:
    """An effect that these records cannot show, and why.

    Attributes
    ----------
    effect : str
    why : str
        What is said.
    asks : tuple of str
        Parameters, one of which must be known for it.
    """

    effect: str
    why: str
    asks: tuple[str, ...] = ()


@final
@dataclass(frozen=True)
class Candidate:
    """An effect in a place, ready to be tried.

    Attributes
    ----------
    label : str
        Label in a model (``key`` or ``key@place``).
    model : JointModel
        The base model with the effect.
    amplitudes, shapes : tuple of str
        Names of its parameters in that model.
    """

    label: str
    effect: Effect
    place: Place
    model: JointModel
    amplitudes: tuple[str, ...]
    shapes: tuple[str, ...]


OBSERVED_BY: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "motor": {
        "motor": ("motor",),
        "link": (),
        "transmission": (),
        "sum": ("sum",),
        "deflection": ("deflection",),
        "axis": ("axis",),
    },
    "link": {
        "link": ("link",),
        "sum": ("sum",),
        "axis": ("axis",),
        "kinematic": ("kinematic",),
    },
    "transmission": {
        "transmission": ("transmission",),
        "deflection": ("deflection",),
        "axis": ("axis",),
        "kinematic": ("kinematic",),
    },
    "torsion": {
        "transmission": ("transmission",),
        "deflection": ("deflection",),
        "kinematic": ("kinematic",),
    },
    "drive": {
        "motor": ("motor",),
        "sum": ("sum",),
        "deflection": ("deflection",),
        "axis": ("axis",),
    },
    "torque_sensor": {"motor": ("motor",), "link": ("link",), "transmission": ("transmission",)},
    "motor_position_sensor": {},
    "link_position_sensor": {
        "link": ("link",),
        "transmission": ("transmission",),
        "deflection": ("deflection",),
        "sum": ("sum",),
        "kinematic": ("kinematic",),
    },
}
"""Balances in which an effect of a place can be seen."""


def observable(place: str, sensing: Sensing) -> bool:
    """True where an effect in that place shows in one of the balances."""
    return any(OBSERVED_BY[place].get(b) for b in sensing.balances)


def offered(
    model: JointModel, data: Dataset, *, late: bool = False
) -> tuple[list[Candidate], list[NotTestable]]:
    """All candidates that these records can show beside the model, and the others with the
    reason.
    """
    out: list[Candidate] = []
    refused: list[NotTestable] = []
    sensing = data.sensing
    one_sided = sensing.one_sided
    direct = one_sided and not sensing.both_positions and abs(data.joint.gear_ratio) == 1.0
    for effect in EFFECTS.values():
        if (
            not effect.candidate
            or (effect.stage == "late" and not late)
            or (effect.stage == "structure" and model.lagging_load)
        ):
            continue
        why = _why_not(effect, model, data)
        if why:
            refused.append(NotTestable(effect.key, why, _asked(effect, model, data, why)))
            continue
        places = [
            p
            for p in effect.acts_on
            if observable(p, sensing) or (sensing.clamped_link and p in ("motor", "link"))
        ]
        if one_sided and "motor" in places and "link" in places:
            places.remove("link")
        if sensing.clamped_link:  # the twist is what is recorded; its error cannot be told from it
            places = [p for p in places if p != "torsion"]
        elif one_sided and not sensing.both_positions:
            kept = ("transmission",) if direct and effect.of_displacement else ()
            places = [p for p in places if p in kept or p not in ("transmission", "torsion")]
        if effect.angular and data.joint.kind == "linear":
            refused.append(NotTestable(effect.key, "is a law of an angle; this axis is linear"))
            continue
        if (
            effect.periodic
            and effect.key not in data.orders
            and (data.joint.kind == "linear" or _turns(data) < 2)
        ):
            refused.append(NotTestable(effect.key, _no_line(data)))
            continue
        if effect.memory is not None and "motor" in places and turns_unseen(data):
            places.remove("motor")
            if not places:
                refused.append(NotTestable(effect.key, UNSEEN_TURN))
                continue
        if not places:
            refused.append(
                NotTestable(
                    effect.key,
                    f"needs a channel that shows the {_shown(effect.acts_on[0])}; these records "
                    "have none",
                )
            )
            continue
        parents = [n for n in effect.needs if EFFECTS[n].stage != "structure"]
        for place in places:
            if any(not model.has(n) for n in effect.needs) and not (
                direct and place == "transmission"
            ):
                continue
            if (
                effect.family == "friction"
                and any(not model.has(n, place) for n in parents)
                and not one_sided
                and place != "transmission"
            ):
                continue
            out.extend(_placed(effect, place, model, sensing))
    return out, refused


def _no_line(data: Dataset) -> str:
    """Why what repeats with the position is no candidate on these records."""
    if not data.joint.turns_per_unit:
        return (
            "its order is one of the motor turn, and nothing says how far the axis moves per turn; "
            "give [known] pitch in the joint file"
        )
    if data.joint.kind == "linear":
        return "no line of its order stands out of what the model leaves over the position"
    return "needs two turns of the motor, or a line of its order in what the model leaves"


def turns_unseen(data: Dataset) -> bool:
    """Whether the motor turns where nobody sees it: behind a gear, the link alone recorded."""
    return data.sensing.moving == "link_position" and abs(data.joint.gear_ratio) != 1.0


def _shortest(data: Dataset) -> float:
    """Length of the shortest training record [s]."""
    return min(float(np.ptp(w.time)) for w in data.train)


def _turns(data: Dataset) -> float:
    """Turns of the motor over the travel of the records."""
    return 2 * data.ranges["position"] * abs(data.joint.gear_ratio) / (2 * math.pi)


def _shown(place: str) -> str:
    return {
        "transmission": "torsion (both positions, or a torque-against-torsion test)",
        "torsion": "torsion (both positions)",
        "torque_sensor": "torque sensor (link_torque)",
        "drive": "drive (motor_current or motor_torque)",
        "link": "link",
        "motor": "motor",
        "link_position_sensor": "link position beside the motor position",
        "motor_position_sensor": "motor position twice",
    }[place]


BY_PARTS: Final = "are tried one by one"
"""End of the reason of an effect that stands for several: no run shows it, and none is needed."""


def shown_by_parts(why: str) -> bool:
    """Whether an effect is not testable for its parts, which are candidates themselves."""
    return why.endswith(BY_PARTS)


def _why_not(effect: Effect, model: JointModel, data: Dataset) -> str:
    if effect.parts and (model.is_elastic or any(model.has(n) for n in effect.parts)):
        return f"its parts ({', '.join(EFFECTS[n].title for n in effect.parts)}) {BY_PARTS}"
    if effect.warms and not data.sensing.has_temperature and _shortest(data) < WARM_UP:
        return (
            f"no temperature channel that changes, and a run shorter than {WARM_UP:g} s; "
            "record the temperature over a warm-up"
        )
    if effect.needs_load and not data.sensing.has_torque and not model.knows_load:
        return (
            "no torque sensor, no second encoder, and no gravity or other torque of the position "
            "in the model: the load is not known"
        )
    there = _conditions(data)
    return next((r.why for r in effect.requires if not r.met(there)), "")


def _asked(effect: Effect, model: JointModel, data: Dataset, why: str) -> tuple[str, ...]:
    """Parameters, one of which must be known so that this reason goes."""
    there = _conditions(data)
    unmet = next((r for r in effect.requires if not r.met(there)), None)
    if unmet is None or unmet.why != why:
        return ()
    wanted = tuple(c for c in unmet.any_of if c not in (TORQUE_SENSOR, SECOND_BALANCE))
    return model.inertias if wanted == (ANYTHING_KNOWN,) else wanted


def _conditions(data: Dataset) -> frozenset[str]:
    """What is known and recorded, in the words of :class:`casadi_models.effect.Requirement`."""
    recorded = {
        TORQUE_SENSOR: data.sensing.has_torque,
        SECOND_BALANCE: data.sensing.balances != ("axis",),
        ANYTHING_KNOWN: bool(data.joint.known),
    }
    return frozenset(data.joint.known) | {name for name, there in recorded.items() if there}


def _placed(effect: Effect, place: Place, model: JointModel, sensing: Sensing) -> list[Candidate]:
    label = f"{effect.key}@{place}" if len(effect.acts_on) > 1 else effect.key
    there = sum(
        t.effect.key == effect.key and t.place == place and t.label != HOLD_DELAY
        for t in model.terms
    )
    if model.has_form_of(label):
        return []
    if there:
        if not effect.periodic:
            return []
        label += f"#{1 + there}"
    variants = [model]
    if place == "torsion" and not any(t.place == "torsion" for t in model.terms):
        variants = [replace(model, virtual_work=True), replace(model, virtual_work=False)]
    out = []
    for variant in variants:
        bigger = with_effect(variant, label)
        term = next(t for t in bigger.terms if t.label == label)
        kept = idle_shapes(bigger, sensing)
        pairs = [
            (n, p) for n, p in zip(term.names, effect.parameters, strict=True) if n not in kept
        ]
        out.append(
            Candidate(
                label,
                effect,
                place,
                bigger,
                tuple(n for n, p in pairs if not p.is_shape),
                tuple(n for n, p in pairs if p.is_shape),
            )
        )
    return out


def shape_grid(candidate: Candidate, data: Dataset) -> list[dict[str, float]]:
    """All combinations of the candidate's shape grids, in SI units; for a line, the orders at
    which one was found too.
    """
    parameters = {p.name: p for p in candidate.model.parameters}
    found = data.orders.get(candidate.effect.key, ()) if candidate.effect.periodic else ()
    axes = [
        [(n, g * data.ranges[parameters[n].scale]) for g in parameters[n].grid]
        + [(n, h) for h in found]
        for n in candidate.shapes
    ]
    return [dict(point) for point in itertools.product(*axes)]
