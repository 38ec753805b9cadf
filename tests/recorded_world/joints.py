"""Five makes of joint, drawn: what stands in their data sheets and what their motions may ask
of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.random import Generator


@final
@dataclass(frozen=True)
class Make:
    """One make of joint; ranges are low and high of a uniform draw, link-referred, SI (m and N
    where linear).

    Attributes
    ----------
    ratio
        Motor turns per turn of the link; 2 pi / pitch for a screw.
    motor_inertia, link_inertia, gravity, stiffness, viscous, coulomb, link_viscous, link_coulomb
        Of the plain joint; gravity is the torque at a quarter turn from upright.
    per_current
        Torque per ampere on the link's side.
    speed, stroke
        Highest speed of the motions, and half the travel.
    half_gap
        Backlash that the joint file lists (0, 0: none).
    """

    name: str
    ratio: float
    motor_inertia: tuple[float, float]
    link_inertia: tuple[float, float]
    gravity: tuple[float, float]
    stiffness: tuple[float, float]
    viscous: tuple[float, float]
    coulomb: tuple[float, float]
    link_viscous: tuple[float, float]
    link_coulomb: tuple[float, float]
    per_current: float
    speed: float
    stroke: float
    half_gap: tuple[float, float] = (0.0, 0.0)
    linear: bool = False


MAKES: Final[Mapping[str, Make]] = {
    m.name: m
    for m in (
        Make(
            name="harmonic160",
            ratio=160.0,
            motor_inertia=(3.9, 5.1),
            link_inertia=(9.0, 11.8),
            gravity=(85.0, 120.0),
            stiffness=(1.8e4, 2.5e4),
            viscous=(9.0, 13.0),
            coulomb=(18.0, 26.0),
            link_viscous=(1.5, 3.5),
            link_coulomb=(0.3, 0.6),
            per_current=8.85,
            speed=1.0,
            stroke=1.1,
        ),
        Make(
            name="cobot100",
            ratio=100.0,
            motor_inertia=(0.6, 1.5),
            link_inertia=(0.8, 4.0),
            gravity=(10.0, 60.0),
            stiffness=(1.0e4, 3.0e4),
            viscous=(5.0, 12.0),
            coulomb=(5.0, 12.0),
            link_viscous=(0.4, 1.5),
            link_coulomb=(0.2, 0.6),
            per_current=9.0,
            speed=1.8,
            stroke=1.3,
        ),
        Make(
            name="servo50",
            ratio=50.0,
            motor_inertia=(0.015, 0.04),
            link_inertia=(0.01, 0.05),
            gravity=(0.4, 2.0),
            stiffness=(120.0, 350.0),
            viscous=(0.04, 0.12),
            coulomb=(0.12, 0.35),
            link_viscous=(0.004, 0.015),
            link_coulomb=(0.01, 0.03),
            per_current=1.0,
            speed=4.0,
            stroke=1.2,
            half_gap=(5e-4, 2e-3),
        ),
        Make(
            name="belt9",
            ratio=9.0,
            motor_inertia=(0.01, 0.03),
            link_inertia=(0.04, 0.3),
            gravity=(0.0, 6.0),
            stiffness=(200.0, 900.0),
            viscous=(0.05, 0.25),
            coulomb=(0.2, 0.7),
            link_viscous=(0.01, 0.06),
            link_coulomb=(0.02, 0.08),
            per_current=0.9,
            speed=6.0,
            stroke=1.5,
        ),
        Make(
            name="screw",
            ratio=2.0 * np.pi / 0.01,
            motor_inertia=(20.0, 60.0),
            link_inertia=(40.0, 160.0),
            gravity=(0.0, 0.0),
            stiffness=(2e6, 8e6),
            viscous=(100.0, 400.0),
            coulomb=(15.0, 60.0),
            link_viscous=(10.0, 40.0),
            link_coulomb=(3.0, 10.0),
            per_current=150.0,
            speed=0.3,
            stroke=0.12,
            linear=True,
        ),
    )
}
SPAN_OF_SCALE: Final = 20e-3
"""Travel that counts as one turn of a linear scale: period of a coarse linear encoder [m]."""
DRIVE: Final = 2.5
"""Torque limit of the drive over what the motions ask for."""


@final
@dataclass(frozen=True)
class Plain:
    """A joint with nothing hidden in it.

    Attributes
    ----------
    make
        Its make.
    sign
        +1 or -1: sign of the gear ratio.
    values
        Parameters of the integrator.
    friction, load
        Torque of friction at half speed, and the highest torque of motion and gravity: scales of
        what is hidden.
    zero
        Where the reading is zero, measured from upright [rad].
    """

    make: Make
    sign: float
    values: Mapping[str, float]
    friction: float
    load: float
    zero: float

    @property
    def gear_ratio(self) -> float:
        """As the joint file has it: theta_motor / theta_link; 1 where the drive counts in
        metres of travel.
        """
        return 1.0 if self.make.linear else self.sign * self.make.ratio

    @property
    def acceleration(self) -> float:
        """Highest acceleration of the motions: a fifth of a second to full speed."""
        return self.make.speed / 0.2


def draw(rng: Generator, make: Make, *, any_zero: bool = True, sticks: bool = True) -> Plain:
    """Draw one joint of a make.

    ``any_zero`` False puts the zero upright; ``sticks`` False smooths dry friction, which two
    joints in five have set-valued.
    """

    def pick(pair: tuple[float, float]) -> float:
        return float(rng.uniform(*pair))

    jm, jl, tg = pick(make.motor_inertia), pick(make.link_inertia), pick(make.gravity)
    k, b, tc = pick(make.stiffness), pick(make.viscous), pick(make.coulomb)
    bl, tl, gap = pick(make.link_viscous), pick(make.link_coulomb), pick(make.half_gap)
    damping, smooth = pick((0.02, 0.05)), pick((0.002, 0.006)) * make.speed
    set_valued = rng.random() < 0.4 and sticks
    sign = -1.0 if rng.random() < 0.5 and not make.linear else 1.0
    zero = pick((-np.pi, np.pi))
    # the loop of a position drive stays below the swing of its load, and under 10 Hz
    swing = min(0.6 * np.sqrt(k / jl), 60.0)
    reduced = jm * jl / (jm + jl)
    values = {
        "JM": jm,
        "JL": jl,
        "TG": tg,
        "TG_P": zero if any_zero and tg else 0.0,
        "K": k,
        "C": 2.0 * damping * float(np.sqrt(k * reduced)),
        "N": make.ratio,
        "GAP": gap,
        "M_B": b,
        "M_TC": tc,
        "L_B": bl,
        "L_TC": tl,
        "M_V0": 0.0 if set_valued else smooth,
        "L_V0": 0.0 if set_valued else smooth,
        "KP": (jm + jl) * swing**2,
        "KD": 1.4 * (jm + jl) * swing,
        "KI": 0.3 * (jm + jl) * swing**3,
    }
    load = tg + jl * make.speed / 0.2
    values["LIMIT"] = DRIVE * (load + tc + jm * make.speed / 0.2)
    return Plain(make, sign, values, tc + 0.5 * b * make.speed, load, values["TG_P"])
