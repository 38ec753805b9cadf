"""From measurements of a joint to estimates: read, fit, compare, diagnose, improve, and the
online estimators.

A name is loaded with the module it lives in when it is first asked for: a verb brings the methods
it calls, and no other.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from identification.version import VERSION

if TYPE_CHECKING:
    from identification.data.joint_file import Joint, load_joint
    from identification.data.read import read
    from identification.data.record import Record
    from identification.diagnosis.changed import Changes, changed
    from identification.diagnosis.compare import Comparison, compare
    from identification.diagnosis.diagnose import Diagnosis, diagnose
    from identification.diagnosis.improve import Improvement, improve
    from identification.errors import InputError
    from identification.faults.detector import FaultDetector
    from identification.fitting.fit import Fit, fit
    from identification.fitting.trust import trust
    from identification.linear.subspace import moesp
    from identification.planning.next_run import next_run
    from identification.recursive.estimator import RecursiveLeastSquares
    from identification.search.mcs import mcs
    from identification.two_step.algorithm import TwoStep
    from identification.variants.exploration import Exploration
    from identification.variants.explore import explore

__version__ = VERSION

_HOMES: Final = {
    "Changes": "diagnosis.changed",
    "Comparison": "diagnosis.compare",
    "Diagnosis": "diagnosis.diagnose",
    "Exploration": "variants.exploration",
    "FaultDetector": "faults.detector",
    "Fit": "fitting.fit",
    "Improvement": "diagnosis.improve",
    "InputError": "errors",
    "Joint": "data.joint_file",
    "Record": "data.record",
    "RecursiveLeastSquares": "recursive.estimator",
    "TwoStep": "two_step.algorithm",
    "changed": "diagnosis.changed",
    "compare": "diagnosis.compare",
    "diagnose": "diagnosis.diagnose",
    "explore": "variants.explore",
    "fit": "fitting.fit",
    "improve": "diagnosis.improve",
    "load_joint": "data.joint_file",
    "mcs": "search.mcs",
    "moesp": "linear.subspace",
    "next_run": "planning.next_run",
    "read": "data.read",
    "trust": "fitting.trust",
}
"""Module of every public name, below this package."""

__all__ = [
    "Changes",
    "Comparison",
    "Diagnosis",
    "Exploration",
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
    "explore",
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
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = found  # asked once
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
