"""What a coordinate search takes and gives back: options, progress, minima, outcome, result."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@final
class MCSOutcome(enum.Enum):
    """Why a search ended; the value is the sentence to show."""

    TARGET = "The target value was reached."
    STALLED = "No better point was found during the allowed number of sweeps."
    EVALUATIONS = "The allowed number of evaluations is used up."
    EXHAUSTED = "Every box was split down to the last level."
    CALLBACK = "The callback asked to stop."
    NOWHERE_FINITE = (
        "The objective was not finite at any point tried; check the objective and the bounds."
    )

    def __str__(self) -> str:
        """Return the sentence."""
        return self.value


@final
@dataclass(frozen=True)
class MCSOptions:
    """Settings of `mcs` that seldom need a change. `mcs` documents each of them."""

    start: (
        Literal["midpoint", "inner"] | Sequence[float] | Sequence[Sequence[float]] | FloatArray
    ) = "midpoint"
    levels: int | None = None
    local_steps: int = 50
    precision: float = 2.220446049250313e-16
    hessian_pattern: npt.ArrayLike | None = None
    restarts: int = 0


@final
@dataclass(frozen=True)
class MCSProgress:
    """Where a running search stands: what the callback is given.

    Attributes
    ----------
    x : array, shape (n,)
        Best point so far (a copy).
    fun : float
        Objective there.
    nfev : int
        Calls of the objective so far.
    nit : int
        Number of the current sweep; 0 after the initial evaluations.
    """

    x: FloatArray
    fun: float
    nfev: int
    nit: int


@final
@dataclass(frozen=True)
class MCSMinimum:
    """One local minimum of the basket.

    Attributes
    ----------
    x : array, shape (n,)
        The point.
    fun : float
        Objective there.
    converged : bool
        False where the local search ran out of steps, was stopped, or none was made
        (``local_steps=0``).
    """

    x: FloatArray
    fun: float
    converged: bool


@final
@dataclass(frozen=True)
class MCSResult:
    """Result of `mcs`.

    Attributes
    ----------
    x : array, shape (n,)
        Best point found.
    fun : float
        Objective there; ``inf`` where the objective was finite nowhere.
    nfev : int
        Number of calls of the objective.
    nit : int
        Number of sweeps begun.
    nfev_local : int
        Calls made by local searches, included in `nfev`.
    local_searches : int
        Number of local searches begun.
    not_finite : int
        Number of calls that returned nan or an infinity.
    basket : tuple of MCSMinimum
        The distinct local minima found, the lowest first: starts for a polish, and the rivals of
        the best point. The first entry is the best point itself, also where the search was stopped
        before it settled (``converged`` False then); empty only where the objective was finite
        nowhere.
    outcome : MCSOutcome
        Why the search ended.
    """

    x: FloatArray
    fun: float
    nfev: int
    nit: int
    nfev_local: int
    local_searches: int
    not_finite: int
    basket: tuple[MCSMinimum, ...]
    outcome: MCSOutcome

    @property
    def success(self) -> bool:
        """True where the target was reached: the one rule that proves something. A search that
        stalled or split every box has found a minimum, perhaps not the lowest.
        """
        return self.outcome is MCSOutcome.TARGET

    @property
    def message(self) -> str:
        """The outcome as a sentence."""
        return self.outcome.value
