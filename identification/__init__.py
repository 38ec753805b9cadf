"""From measurements of a joint to estimates: read, fit, compare, diagnose, improve, and the online estimators."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .compare import Comparison
from .compare import compare as compare
from .diagnose import Diagnosis
from .diagnose import diagnose as diagnose
from .errors import InputError
from .fit import Fit
from .fit import fit as fit
from .improve import Improvement
from .improve import improve as improve
from .joint_file import Joint, load_joint
from .mcs import mcs as mcs
from .read import read as read
from .record import Record

if TYPE_CHECKING:
    from .fault import FaultDetector
    from .recursive import RecursiveLeastSquares
    from .subspace import moesp
    from .two_step import TwoStep

__version__ = "0.1.0"

_LATE = {
    "moesp": "subspace",
    "RecursiveLeastSquares": "recursive",
    "TwoStep": "two_step",
    "FaultDetector": "fault",
}

__all__ = [
    "Comparison",
    "Diagnosis",
    "FaultDetector",
    "Fit",
    "Improvement",
    "InputError",
    "Joint",
    "Record",
    "RecursiveLeastSquares",
    "TwoStep",
    "compare",
    "diagnose",
    "fit",
    "improve",
    "load_joint",
    "mcs",
    "moesp",
    "read",
]


def __getattr__(name: str) -> Any:
    if name in _LATE:
        return getattr(import_module(f".{_LATE[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
