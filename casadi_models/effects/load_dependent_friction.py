"""Load-dependent friction."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude
from ..signals import Expression, LocalSignals


@effect(
    "load_dependent_friction",
    title="load-dependent friction",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        amplitude(
            "load_friction",
            "1",
            "share of the load that comes back as friction",
            high=1.0,
            typical=0.08,
        ),
    ),
    absence="the friction band widens with the load",
    excitation="two payloads, or a long swing through gravity",
    source="A. C. Bittencourt et al. 2010; M. Duclusaud et al. 2025",
    dissipative=True,
    confused_with=("cyclic_friction", "coulomb", "gravity"),
    needs_load=True,
    needs=("coulomb",),
    separate_by="a run with another payload",
)
def load_dependent_friction(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Friction in proportion to the size of the load."""
    return p.load_friction * ca.sqrt(s.load**2 + 1e-6) * s.direction
