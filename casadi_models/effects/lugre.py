"""Presliding (bristle) friction."""

from types import SimpleNamespace

from .. import bristle
from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


def _bristle(
    z: tuple[Expression, ...], step: Expression, s: LocalSignals, p: SimpleNamespace
) -> tuple[Expression, ...]:
    return (bristle.after(z[0], step / p.presliding_distance),)


def _rate(z: tuple[Expression, ...], s: LocalSignals, p: SimpleNamespace) -> tuple[Expression, ...]:
    return (bristle.rate(z[0], s.velocity / p.presliding_distance),)


@effect(
    "lugre",
    title="presliding (bristle) friction",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        amplitude(
            "presliding_torque",
            "N.m",
            "part of the Coulomb torque that builds up over the presliding distance",
            typical=18.0,
        ),
        shape(
            "presliding_distance",
            "rad",
            "distance over which the friction turns round after a reversal",
            (0.0003, 0.001, 0.003, 0.01, 0.03),
            "position",
            start=1e-3,
            low=1e-9,
            high=10.0,
            typical=3e-3,
        ),
    ),
    contains=("coulomb",),
    several_valleys=True,
    absence="after a reversal the residual is a loop against distance, not against speed",
    excitation="small slow reversals",
    source="P. Dahl 1968; C. Canudas de Wit et al. 1995",
    memory=_bristle,
    rate=_rate,
    states=1,
    needs=("coulomb",),
    confused_with=("stribeck", "backlash", "hysteresis"),
    separate_by="small slow reversals at two speeds",
)
def lugre(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Bristle torque in place of part of the Coulomb torque."""
    return p.presliding_torque * (s.memory[0] - s.direction)
