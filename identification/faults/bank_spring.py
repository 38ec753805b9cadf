"""Whether a position that is off or a stiffness that changed explains what a bank's filters see.

A stiffness that changed leaves motor and link in order, each with the torque, and moves the two
positions against each other in proportion to the torque. A position that is off by some
hundredths of a degree leaves them nearly in order, too, so a filter without that position agrees
with either. Filters that read all sensors tell the two apart: one whose encoders' zero may have
jumped, one whose stiffness may, one with both. A stiffness that explains all readings to their
noise, where no offset does, leaves no sensor to blame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.faults.bank_statistics import statistics
from identification.online.filter import TWIST, Doubts, FilterState, JointFilter, Levels
from identification.online.filter_step import BALANCES

FloatArray = npt.NDArray[np.float64]

OPENED: Final = 0.1 * TWIST
"""Standard deviation of an encoders' zero that is found anew [rad]: ten times what the first half
second of a record leaves wrong, and a larger offset than a gear twists by."""
OPENED_SPEED: Final = 0.02
"""The same of a velocity [rad/s]: such an offset in half a second."""
CHANGED: Final = 0.5
"""Standard deviation of the compliance of a spring that may have changed, as a share of what it
was: a stiffness of two thirds to twice of that in two of three cases."""
PASSES: Final = 2
"""Times that the filters go along the readings, the second time linearised at what the first one
found: a filter that is linearised at a wrong stiffness is too sure of what it finds."""
LINK_STATE: Final = 2
"""The link position in the joint's state."""
STIFFNESS: Final = "stiffness"
"""The part of the joint, as a verdict has it."""


def opened(joint: JointFilter, state: FilterState, levels: Levels, zero: float) -> FilterState:
    """A filter whose disturbances are unsure again, and whose encoders' zero, the first of its free
    parameters, and so the link, by a standard deviation [rad].
    """
    at = joint.states
    own = slice(at, at + BALANCES)
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[own] = 0.0
    covariance[own, :] = covariance[:, own] = 0.0
    covariance[own, own] = np.diag(np.square(levels.disturbance))
    way = np.zeros(joint.size)
    way[at + BALANCES], way[LINK_STATE] = zero, -zero
    return replace(state, mean=mean, covariance=covariance + np.outer(way, way))


@final
class SpringFilters:
    """Filters of an elastic joint that read all sensors, with a zero or a stiffness that moved.

    Parameters
    ----------
    model : JointModel
    dt : float
        Usual sample time [s].
    calibration : sequence of str
        The encoders' zero.
    doubts : Doubts
        Of the bank's filters.
    """

    def __init__(
        self, model: JointModel, dt: float, calibration: Sequence[str], doubts: Doubts
    ) -> None:
        name = [] if model.stiffness_name is None else [model.stiffness_name]
        others = doubts.without(model.stiffness_name)
        self.joint = JointFilter(model, dt, (*calibration, *name), name, others)
        self.given = (*calibration, *doubts.names)

    def explain(
        self,
        state: FilterState,
        time: FloatArray,
        rows: FloatArray,
        *,
        measured: Sequence[bool],
        levels: Levels,
        limits: FloatArray,
    ) -> tuple[bool, bool]:
        """Whether an offset of the positions explains the readings, and whether the stiffness does.

        Parameters
        ----------
        state : FilterState
            Of the filter that reads all sensors, before the alarm.
        time, rows : (n,) and (n, 6) arrays
            Samples after it.
        measured : sequence of 6 bools
        levels : Levels
        limits : (statistics,) array
            Of that filter.
        """
        wide = self._with_stiffness(state)
        states = []
        for zero, spring in ((OPENED, 0.0), (0.0, CHANGED), (OPENED, CHANGED)):
            one = opened(self.joint, wide, levels, zero)
            at = self._at_stiffness
            one.covariance[at, at] = (spring * one.mean[at]) ** 2
            states.append(self._at_readings(one))
        used = np.tile(np.array(measured, dtype=np.float64), (len(states), len(time), 1))
        course = self.joint.run(states, time, rows, used, levels=levels)
        for _ in range(PASSES - 1):
            states = [self._at(a, b) for a, b in zip(states, course.last, strict=True)]
            course = self.joint.run(states, time, rows, used, levels=levels)
        with np.errstate(over="ignore", invalid="ignore"):  # wrong hypotheses may diverge
            shares = [
                statistics(course, k, self.joint, levels) / limits for k in range(len(states))
            ]
        worst = [np.nan_to_num(share, nan=np.inf).max() for share in shares]
        offset, spring, both = (bool(w < 1) for w in worst)
        return offset, spring or (both and not offset)

    def _at_readings(self, state: FilterState) -> FilterState:
        """A state whose motion the next readings tell: a stiffness that had changed before the
        alarm has bent it.
        """
        more = np.zeros(len(state.mean))
        motion = self.joint.states_of_motion
        more[0:motion:2], more[1:motion:2] = OPENED**2, OPENED_SPEED**2
        return replace(state, covariance=state.covariance + np.diag(more))

    def _at(self, state: FilterState, found: FilterState) -> FilterState:
        """A state before the readings, linearised at the zero and the stiffness found with them."""
        mean, zero = state.mean.copy(), self.joint.states + BALANCES
        if not np.isfinite(found.mean).all():
            return state
        mean[LINK_STATE] -= found.mean[zero] - mean[zero]
        free = slice(zero, zero + self.joint.free)
        mean[free] = found.mean[free]
        return replace(state, mean=mean)

    def _with_stiffness(self, state: FilterState) -> FilterState:
        """The state with the compliance of the model, known. For a torque that is read the twist is
        linear in the compliance; in the stiffness or its logarithm the filter would follow a
        curve, and take that for knowledge.
        """
        first, at = self.joint.states + BALANCES, self._at_stiffness
        own = list(range(first + len(self.given)))
        kept = own[:first] + [
            first + self.given.index(n)
            for n in self.joint.names
            if first + self.joint.names.index(n) != at
        ]
        places = [k for k in range(self.joint.size) if k != at]
        mean, covariance = np.zeros(self.joint.size), np.zeros((self.joint.size,) * 2)
        mean[places], mean[at] = (
            state.mean[kept],
            1 / self.joint.values[self.joint.names[at - first]],
        )
        covariance[np.ix_(places, places)] = state.covariance[np.ix_(kept, kept)]
        return replace(state, mean=mean, covariance=covariance)

    @property
    def _at_stiffness(self) -> int:
        """Its place in the state: the last one of the free parameters."""
        return self.joint.states + BALANCES + self.joint.free - 1
