"""An effect put in its place, and the parameters that a joint has besides its effects."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Final, final

from .effect import Effect, Place
from .parameter import Parameter
from .signals import Expression

INERTIAS: Final = {
    "motor_inertia": Parameter(
        "motor_inertia",
        "kg.m2",
        start=1.0,
        low=1e-12,
        high=math.inf,
        meaning="inertia of rotor and wave generator, times the ratio squared",
        side="link",
        role="inertia",
        typical=4.447,
    ),
    "link_inertia": Parameter(
        "link_inertia",
        "kg.m2",
        start=1.0,
        low=1e-12,
        high=math.inf,
        meaning="inertia of the link with its payload",
        side="link",
        role="inertia",
        typical=10.277,
    ),
    "inertia": Parameter(
        "inertia",
        "kg.m2",
        start=1.0,
        low=1e-12,
        high=math.inf,
        meaning="inertia of motor and link together",
        side="link",
        role="inertia",
        typical=14.7,
    ),
}
"""Inertias by name, all link-referred; typical sizes as in tables 4.1 and 4.2 of the thesis."""
MOTOR_INERTIA: Final = "motor_inertia"
LINK_INERTIA: Final = "link_inertia"
SIDE_INERTIAS: Final = (MOTOR_INERTIA, LINK_INERTIA)
"""Inertias of a joint measured on both sides."""
TOTAL_INERTIA: Final = ("inertia",)
"""Inertia of an axis measured on one side."""

LOAD_COMPLIANCE: Final = Parameter(
    "load_compliance",
    "rad/(N.m)",
    start=0.0,
    low=0.0,
    high=math.inf,
    meaning="compliance between motor and link where the link position is not recorded",
    side="link",
    role="compliance",
)
SWINGING_SHARE: Final = Parameter(
    "swinging_share",
    "1",
    start=0.5,
    low=0.02,
    high=1.0,
    meaning="share of the inertia that hangs on that compliance",
    side="link",
)
LOAD_DAMPING: Final = Parameter(
    "load_damping",
    "N.m.s/rad",
    start=0.0,
    low=0.0,
    high=math.inf,
    meaning="damping beside that compliance",
    side="link",
)
HANGING: Final = (LOAD_COMPLIANCE.name, SWINGING_SHARE.name, LOAD_DAMPING.name)
"""Parameters of a link that is not recorded."""


@final
@dataclass(frozen=True)
class Term:
    """One effect in one place."""

    effect: Effect
    place: Place
    instance: int = 1

    @property
    def label(self) -> str:
        """``key``, ``key@place`` where the effect may act on several places, ``#2`` for a
        second one.
        """
        label = (
            f"{self.effect.key}@{self.place}" if len(self.effect.acts_on) > 1 else self.effect.key
        )
        return label if self.instance == 1 else f"{label}#{self.instance}"

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names in the model, in the order of the effect's parameters."""
        tail = "" if self.instance == 1 else f"_{self.instance}"
        return tuple(n + tail for n in self.effect.parameter_names(self.place))

    def affixes(self, name: str) -> tuple[str, str]:
        """A name of the effect's own with the place before it, and the tail of a second term."""
        prefix = f"{self.place}_" if len(self.effect.acts_on) > 1 else ""
        return prefix + name, "" if self.instance == 1 else f"_{self.instance}"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters with the names they have in the model; the typical size is that of the
        first term.
        """
        named = (
            p.renamed(n, p.side)
            for p, n in zip(self.effect.placed(self.place), self.names, strict=True)
        )
        return tuple(p if self.instance == 1 else replace(p, typical=None) for p in named)

    def bound(self, values: Mapping[str, Expression]) -> SimpleNamespace:
        """Values of the model's parameters under the names that the law of this term uses."""
        pairs = zip(self.effect.parameters, self.names, strict=True)
        return SimpleNamespace(**{p.name: values[n] for p, n in pairs})


@final
@dataclass(frozen=True)
class Unknown:
    """What a sensor is off by: no physics of the joint, and another value in each record.

    Attributes
    ----------
    what : {"zero", "skew", "offset"}
    sensor : str
        Channel of the record.
    place : str
        Place of the effects that act on that sensor.
    parameter : Parameter
    """

    what: str
    sensor: str
    place: Place
    parameter: Parameter


def _late(name: str, meaning: str) -> Parameter:
    """A time by which a reading is behind the clock of the record."""
    return Parameter(
        name, "s", start=0.0, low=-math.inf, high=math.inf, meaning=meaning, side="sensor"
    )


CALIBRATION: Final = {
    u.parameter.name: u
    for u in (
        Unknown(
            "zero",
            "link_position",
            "link_position_sensor",
            Parameter(
                "link_encoder_zero",
                "rad",
                start=0.0,
                low=-math.inf,
                high=math.inf,
                meaning="reading of the link encoder less that of the motor encoder, without twist",
                side="sensor",
            ),
        ),
        Unknown(
            "skew",
            "link_position",
            "link_position_sensor",
            _late("link_encoder_skew", "time by which the link encoder is behind the motor's"),
        ),
        Unknown(
            "skew",
            "link_torque",
            "torque_sensor",
            _late("torque_sensor_skew", "time by which the torque sensor is behind the encoder"),
        ),
    )
}
"""Calibration unknowns by the name of their parameter."""


def smoothing(place: str) -> Parameter:
    """Velocity over which sign(v) is smoothed to tanh(v/v0): a nuisance of every friction law."""
    return Parameter(
        f"{place}_smoothing_velocity",
        "rad/s",
        start=1e-3,
        low=1e-9,
        high=math.inf,
        meaning=f"velocity over which {place}-side friction changes its sign (nuisance)",
        side="link",
        grid=(0.0003, 0.001, 0.003, 0.01, 0.03),
        scale="velocity",
        role="smoothing",
        typical=0.005,
    )
