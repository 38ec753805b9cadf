"""Learned curves: a missing torque for which the library has no name, as a table over one
variable.
"""

from types import SimpleNamespace
from typing import Final

import casadi as ca

from ..effect import effect
from ..signals import Expression, LocalSignals
from ..table import NARROW, Table

_SOURCE: Final = "penalised B-splines: P. H. C. Eilers, B. D. Marx 1996"
_ABSENCE: Final = "structure over one variable that no law of the library follows"

SPEED: Final = Table("velocity", "learned_velocity", of_speed=True, odd=True)
SPEED_EVEN: Final = Table("velocity", "learned_velocity_even", of_speed=True)
POSITION: Final = Table("position", "learned_position", knots=NARROW)
POSITION_FRICTION: Final = Table("position", "learned_position_friction", odd=True, knots=NARROW)
LOAD_FRICTION: Final = Table("load", "learned_load_friction", odd=True)
TORSION: Final = Table("torsion", "learned_torsion")


@effect(
    "learned_velocity",
    title="learned friction over velocity",
    family="friction",
    acts_on=("motor", "link"),
    parameters=SPEED.parameters("rad/s", "velocity", 1.0, (0.0, 1.0, 5.0, 3.0)),
    absence=_ABSENCE,
    excitation="all speeds in both directions",
    source=_SOURCE,
    candidate=False,
    table=SPEED,
)
def learned_velocity(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """A free curve over the size of the velocity; it changes sign with the direction."""
    return SPEED.value(ca.fabs(s.velocity), p) * SPEED.turned(s.velocity, p)


@effect(
    "learned_velocity_even",
    title="learned torque over speed",
    family="friction",
    acts_on=("motor", "link"),
    parameters=SPEED_EVEN.parameters("rad/s", "velocity", 1.0, (0.0, 1.0, 5.0, 3.0)),
    absence=_ABSENCE,
    excitation="all speeds in both directions",
    source=_SOURCE,
    candidate=False,
    table=SPEED_EVEN,
)
def learned_velocity_even(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """A free curve over the size of the velocity, the same in both directions."""
    return SPEED_EVEN.value(ca.fabs(s.velocity), p)


def _position_energy(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return POSITION.stored(s.position, p)


@effect(
    "learned_position",
    title="learned torque over position",
    family="torque",
    acts_on=("motor", "link"),
    parameters=POSITION.parameters("rad", "position", 1.0, (0.0, 4.0, -3.0, 0.0)),
    absence=_ABSENCE,
    excitation="slow strokes over the whole range",
    source=_SOURCE,
    potential=_position_energy,
    candidate=False,
    table=POSITION,
)
def learned_position(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """A free curve over the position; beyond its range the last value."""
    return POSITION.value(s.position, p)


@effect(
    "learned_position_friction",
    title="learned friction over position",
    family="friction",
    acts_on=("motor", "link"),
    parameters=POSITION_FRICTION.parameters("rad", "position", 1.0, (0.0, 4.0, 1.0, 0.0)),
    absence=_ABSENCE,
    excitation="slow strokes over the whole range, both directions",
    source=_SOURCE,
    candidate=False,
    table=POSITION_FRICTION,
)
def learned_position_friction(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """A free curve over the position that changes sign with the direction."""
    return POSITION_FRICTION.value(s.position, p) * s.direction


@effect(
    "learned_load_friction",
    title="learned friction over load",
    family="friction",
    acts_on=("motor", "link"),
    parameters=LOAD_FRICTION.parameters("N.m", "absolute", 100.0, (4.0, 1.0, 0.0, 2.0, 6.0)),
    absence=_ABSENCE,
    excitation="two payloads, or a long swing through gravity",
    source=_SOURCE,
    needs_load=True,
    candidate=False,
    table=LOAD_FRICTION,
)
def learned_load_friction(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """A free curve over the load of the gear that changes sign with the direction."""
    return LOAD_FRICTION.value(s.load, p) * s.direction


def _torsion_energy(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return TORSION.stored(s.torsion, p)


@effect(
    "learned_torsion",
    title="learned torque over twist",
    family="transmission",
    acts_on=("transmission",),
    parameters=TORSION.parameters("rad", "torsion", 0.005, (-40.0, -8.0, 0.0, 8.0, 40.0)),
    absence=_ABSENCE,
    excitation="high torque in both directions",
    source=_SOURCE,
    potential=_torsion_energy,
    needs=("transmission_compliance",),
    candidate=False,
    table=TORSION,
)
def learned_torsion(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """A free curve over the twist of the gear; beyond its range the last value."""
    return TORSION.value(s.torsion, p)
