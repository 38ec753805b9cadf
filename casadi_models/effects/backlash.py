"""Backlash."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


def _inside(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return ca.fmin(ca.fmax(s.torsion, -p.backlash), p.backlash)


def _taken(s: LocalSignals, p: SimpleNamespace) -> Expression:
    # in the gap nothing touches: neither damping nor a stiffening spring feels it
    return _inside(s, p) * (p.backlash_stiffness_loss > 0)


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    inside = _inside(s, p)
    return -p.backlash_stiffness_loss * (inside * s.torsion - inside**2 / 2)


@effect(
    "backlash",
    title="backlash",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        amplitude(
            "backlash_stiffness_loss",
            "N.m/rad",
            "stiffness that is missing inside the gap",
            role="softening",
            typical=1.5e4,
        ),
        shape(
            "backlash",
            "rad",
            "half the gap",
            (0.02, 0.05, 0.1, 0.2, 0.4),
            "torsion",
            start=1e-4,
            low=1e-12,
            high=10.0,
            typical=3e-4,
        ),
    ),
    of_displacement=True,
    several_valleys=True,
    takes_up=_taken,
    absence="the transmission carries nothing near zero torque; knocks when it is crossed",
    excitation="torque reversals at low load",
    source="field knowledge",
    potential=_stored,
    confused_with=("soft_windup", "piecewise_stiffness"),
    needs=("transmission_compliance",),
    separate_by="slow crossings of zero torque",
)
def backlash(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """What the stiffness carries too much inside the gap."""
    return -p.backlash_stiffness_loss * _inside(s, p)
