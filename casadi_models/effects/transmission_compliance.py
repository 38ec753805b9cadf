"""Compliance of the transmission."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import amplitude
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return p.stiffness * s.torsion**2 / 2


@effect(
    "transmission_compliance",
    title="compliance of the transmission",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        amplitude("stiffness", "N.m/rad", "torsional stiffness", role="stiffness", typical=2.2e4),
    ),
    stage="structure",
    absence="motor and link do not move together: the residual follows the torsion",
    excitation="torque in both directions",
    source="thesis eq. 2.41 (step from model 2 to model 3)",
    potential=_stored,
    confused_with=("lugre",),
)
def transmission_compliance(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of the linear spring."""
    return p.stiffness * s.torsion
