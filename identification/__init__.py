"""From measurements of a joint to estimates: read, fit, compare, diagnose, improve, and the
online estimators.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from identification.data.joint_file import Joint, load_joint
from identification.data.read import read as read
from identification.data.record import Record
from identification.diagnosis.changed import Changes
from identification.diagnosis.changed import changed as changed
from identification.diagnosis.compare import Comparison
from identification.diagnosis.compare import compare as compare
from identification.diagnosis.diagnose import Diagnosis
from identification.diagnosis.diagnose import diagnose as diagnose
from identification.diagnosis.improve import Improvement
from identification.diagnosis.improve import improve as improve
from identification.errors import InputError
from identification.fitting.fit import Fit
from identification.fitting.fit import fit as fit
from identification.search.mcs import mcs as mcs
from identification.version import VERSION

if TYPE_CHECKING:
    from identification.faults.detector import FaultDetector
    from identification.fitting.trust import trust
    from identification.linear.subspace import moesp
    from identification.planning.next_run import next_run
    from identification.recursive.estimator import RecursiveLeastSquares
    from identification.two_step.algorithm import TwoStep

__version__ = VERSION

_LATE = {
    "moesp": "linear.subspace",
    "next_run": "planning.next_run",
    "trust": "fitting.trust",
    "RecursiveLeastSquares": "recursive.estimator",
    "TwoStep": "two_step.algorithm",
    "FaultDetector": "faults.detector",
}

__all__ = [
    "Changes",
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
    "changed",
    "compare",
    "diagnose",
    "fit",
    "improve",
    "load_joint",
    "mcs",
    "moesp",
    "next_run",
    "read",
    "trust",
]


def __getattr__(name: str) -> Any:
    if name in _LATE:
        return getattr(import_module(f".{_LATE[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
