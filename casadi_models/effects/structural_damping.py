"""Structural damping of the transmission."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import amplitude
from ..signals import Expression, LocalSignals


@effect(
    "structural_damping",
    title="structural damping of the transmission",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        amplitude(
            "structural_damping", "N.m.s/rad", "damping in parallel to the stiffness", typical=60.0
        ),
    ),
    absence="the residual of the transmission follows the rate of the torsion",
    excitation="motion near the resonance, 5 to 15 Hz",
    source="Compliant Joint Toolbox (J. Malzahn, W. Roozing, N. Tsagarakis 2019)",
    dissipative=True,
    needs=("transmission_compliance",),
    confused_with=("channel_delay", "hysteresis"),
    separate_by="a chirp through the resonance",
)
def structural_damping(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque in proportion to the rate of the torsion."""
    return p.structural_damping * s.torsion_rate
