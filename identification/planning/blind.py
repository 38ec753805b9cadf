"""What a planned run cannot show, said before it is recorded."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS
from identification.balance.balances import balances_of
from identification.balance.dataset import load_dataset, prepared_model
from identification.balance.weak import INDEPENDENT_SHARE
from identification.data.formats import words
from identification.data.joint_file import Joint
from identification.data.typical import true_values
from identification.diagnosis.candidates import Candidate, offered, shape_grid
from identification.diagnosis.trials import COLLINEAR, Base, columns, make_base, span_of
from identification.errors import InputError
from identification.fitting.engine import solve
from identification.naming.contest import FEWEST
from identification.planning.motion import Motion
from identification.planning.rivals import enough
from identification.planning.runs import Plant, recorded

FloatArray = npt.NDArray[np.float64]

SENSORS: Final = MappingProxyType(
    {
        "drive": 0.035,
        "motor_position": 5e-6,
        "link_position": 2e-5,
        "torque": 0.05,
    }
)
"""Noise of the sensors before any record is there: the thesis's table B.1, link-referred
[N.m, rad; N, m]."""

ABSORBED: Final = 0.5
"""Share of an effect's squares that another must take before the two are called alike: a small
effect is not like every other one."""


@final
@dataclass(frozen=True)
class Unseen:
    """An effect that a planned run does not show, and why."""

    effect: str
    why: str

    def as_json(self) -> dict[str, str]:
        """The shape of `next --json`."""
        return {"effect": self.effect, "why": self.why}


@final
@dataclass(frozen=True)
class Blind:
    """What a planned run shows of the library.

    Attributes
    ----------
    unseen : tuple of Unseen
        Effects whose columns vanish or lie in those of the model.
    ties : tuple of (str, str)
        Effects that show, but like each other.
    seen : mapping of str to float
        The others, with the log-likelihood of one of typical size [nats].
    seconds : float
    """

    unseen: tuple[Unseen, ...]
    ties: tuple[tuple[str, str], ...]
    seen: MappingProxyType[str, float]
    seconds: float

    @property
    def sentences(self) -> tuple[str, ...]:
        """What cannot be shown, a sentence each."""
        return (
            *(f"{EFFECTS[u.effect].title} will not be visible: {u.why}" for u in self.unseen),
            *(
                f"{EFFECTS[a].title} and {EFFECTS[b].title} will look alike{_hint(a, b)}"
                for a, b in self.ties
            ),
        )

    def as_json(self) -> dict[str, Any]:
        """The shape of `next --json` without records."""
        return {
            "separates": [],
            "runs": [],
            "cannot": list(self.sentences),
            "not_visible": [u.as_json() for u in self.unseen],
            "alike": [list(pair) for pair in self.ties],
            "visible": dict(self.seen),
            "seconds": self.seconds,
        }

    def __str__(self) -> str:
        lines = [
            f"a run of {self.seconds:.0f} s along this motion shows {len(self.seen)} effects of "
            "the library at their typical size: " + ", ".join(words(n) for n in self.seen)
        ]
        return "\n".join([*lines, *self.sentences])


def _hint(one: str, other: str) -> str:
    told = [EFFECTS[n].told_by for n in (one, other)] + [
        EFFECTS[n].separate_by for n in (one, other)
    ]
    hint = next((text for text in told if text), "")
    return f"; {hint} would separate them" if hint else ""


def blind_spots(joint: Joint, motion: Motion) -> Blind:
    """Which effects a planned run cannot show, at the values of the joint file or typical ones.

    The motion is simulated on the joint's own model; each effect of the library enters as columns.

    Parameters
    ----------
    joint : Joint
    motion : Motion

    Raises
    ------
    InputError
        The joint's model diverges along the motion.
    """
    model = joint.model()
    model = model.with_values(true_values(model, joint))
    followed = Plant(model, motion.dt).follow(motion)
    if followed is None:
        raise InputError(
            f"{joint.source or joint.name}: the simulation diverges along this motion; check the "
            "values in the joint file"
        )
    record = recorded(followed, joint, SENSORS, elastic=model.is_elastic)
    prepared = prepared_model(joint, record)
    data = load_dataset([record], [], joint, prepared)
    base = make_base(solve(prepared, data), data)
    candidates, refused = offered(prepared, data)
    unseen = {n.effect: Unseen(n.effect, n.why) for n in refused}
    shown: dict[str, tuple[FloatArray, list[FloatArray]]] = {}
    for candidate in candidates:
        key = candidate.effect.key
        found = _columns(candidate, base)
        if found is None:
            continue
        span, outside, signal = found
        share = float(np.linalg.norm(outside)) / max(float(np.linalg.norm(signal)), 1e-300)
        nats = 0.5 * INDEPENDENT_SHARE * float(outside @ outside)
        if share < COLLINEAR or nats < FEWEST:
            unseen.setdefault(key, Unseen(key, _why(candidate, share, nats)))
        elif key not in shown or nats > 0.5 * INDEPENDENT_SHARE * float(
            shown[key][0] @ shown[key][0]
        ):
            shown[key] = (outside, span)
    ties = _alike(shown)
    return Blind(
        tuple(u for k, u in unseen.items() if k not in shown),
        ties,
        MappingProxyType(
            {k: 0.5 * INDEPENDENT_SHARE * float(s[0] @ s[0]) for k, s in shown.items()}
        ),
        float(motion.time[-1] + motion.dt),
    )


def _columns(
    candidate: Candidate, base: Base
) -> tuple[list[FloatArray], FloatArray, FloatArray] | None:
    """Span of the candidate's columns outside the base at each of its shapes, what one of typical
    size adds outside the base, and altogether; None where it has no column at all."""
    data = base.data
    balances = balances_of(
        candidate.model, data.sensing, wrt=candidate.amplitudes, columns_only=True
    )
    usual = candidate.model.usual_values()
    sizes = np.array([usual[n] for n in candidate.amplitudes])
    if not sizes.any():
        return None
    typical = {n: usual[n] for n in candidate.shapes}
    signal = columns(candidate, base, typical, data.train, balances) @ sizes * base.weight
    if not np.any(signal) or not np.isfinite(signal).all():
        return None
    spans = [
        columns(candidate, base, shapes, data.train, balances) * base.weight[:, None]
        for shapes in shape_grid(candidate, data)
    ]
    q = base.orthonormal
    return [span_of(_apart(c, q)) for c in spans], _apart(signal, q), signal


def _apart(values: FloatArray, q: FloatArray) -> FloatArray:
    return np.asarray(values - q @ (q.T @ values))


def _why(candidate: Candidate, share: float, nats: float) -> str:
    effect = candidate.effect
    others = ", ".join(words(n) for n in effect.confused_with)
    if share < COLLINEAR:
        what = f"its columns lie in those of the model{f' and of {others}' if others else ''}"
    else:
        what = (
            f"one of typical size is worth {nats:.2g} nats beside the rest of the model, and "
            f"{FEWEST:g} are asked"
        )
    return f"{what}{f'; {effect.separate_by} would show it' if effect.separate_by else ''}"


def _alike(shown: dict[str, tuple[FloatArray, list[FloatArray]]]) -> tuple[tuple[str, str], ...]:
    """Pairs of which each, at its typical size, could be taken for the other."""
    names = list(shown)
    out = []
    for k, one in enumerate(names):
        for other in names[:k]:
            if any(_taken(shown[a], shown[b]) for a, b in ((one, other), (other, one))):
                out.append((other, one))
    return tuple(out)


def _taken(
    one: tuple[FloatArray, list[FloatArray]], other: tuple[FloatArray, list[FloatArray]]
) -> bool:
    """Whether one effect of typical size could be taken for another of some shape."""
    left = min(float(np.sum(_apart(one[0], span) ** 2)) for span in other[1])
    whole = float(one[0] @ one[0])
    return 0.5 * INDEPENDENT_SHARE * left < enough() and left < (1 - ABSORBED) * whole
