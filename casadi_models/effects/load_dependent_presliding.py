"""Directional load-dependent friction with presliding."""

from types import SimpleNamespace

import casadi as ca

from .. import bristle
from ..effect import effect
from ..parameter import shape, signed
from ..signals import Expression, LocalSignals


def _bristle(
    z: tuple[Expression, ...], step: Expression, s: LocalSignals, p: SimpleNamespace
) -> tuple[Expression, ...]:
    return (bristle.after(z[0], step / p.load_presliding_distance),)


def _rate(z: tuple[Expression, ...], s: LocalSignals, p: SimpleNamespace) -> tuple[Expression, ...]:
    return (bristle.rate(z[0], s.velocity / p.load_presliding_distance),)


@effect(
    "load_dependent_presliding",
    title="directional load-dependent friction with presliding",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "load_friction_mean", "1", "share of the load that resists the motion", typical=0.08
        ),
        signed(
            "load_friction_difference",
            "1",
            "share of the load lost when driving more than when back-driven",
            typical=0.03,
        ),
        shape(
            "load_presliding_distance",
            "rad",
            "distance over which the friction turns round",
            (0.0003, 0.001, 0.003, 0.01),
            "position",
            start=1e-3,
            low=1e-9,
            high=10.0,
        ),
    ),
    several_valleys=True,
    absence="the residual is a loop against distance; its width follows the load and differs "
    "when back-driven",
    excitation="small reversals under two or more payloads",
    source="MuJoCo issue 3528 (torque-proportional loss of strain-wave gears), 2026",
    memory=_bristle,
    rate=_rate,
    states=1,
    needs_load=True,
    needs=("coulomb", "load_dependent_friction"),
    confused_with=("load_dependent_friction", "lugre", "motor_constant_error"),
    separate_by="runs with another payload and small reversals",
)
def load_dependent_presliding(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Friction in proportion to the load, turned round over a distance."""
    return (
        p.load_friction_mean * ca.sqrt(s.load**2 + 1e-6) * s.memory[0]
        + p.load_friction_difference * s.load * s.memory[0] ** 2
    )
