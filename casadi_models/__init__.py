"""Declared physics of geared joints: effects, harmonic-drive models 1 to 4, CasADi functions."""

from .effect import EFFECTS, Effect, effect, load_library
from .joint import JointModel, Term
from .parameter import Parameter, amplitude, shape, signed
from .signals import LocalSignals, Signals

load_library()

__all__ = [
    "EFFECTS",
    "Effect",
    "JointModel",
    "LocalSignals",
    "Parameter",
    "Signals",
    "Term",
    "amplitude",
    "effect",
    "load_library",
    "shape",
    "signed",
]
