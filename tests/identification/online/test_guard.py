"""The guard judges a residual by all that was to be expected of it: noise, and how unsure the
estimate was of the row.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from identification.online.guard import Guard
from identification.online.row_check import RowCheck
from identification.recursive.estimator import RecursiveLeastSquares, Settings

FloatArray = npt.NDArray[np.float64]
PERIOD, NOISE = 0.016, 0.05
NAMES = ("motor_inertia", "motor_viscous", "motor_coulomb", "link_inertia", "link_viscous")
TRUE = np.array([4.0, 20.0, 20.0, 10.0, 9.0])
Told = list[tuple[int, str]]


def regressor(time: float) -> FloatArray:
    """Rows of the balances of motor and link while the joint swings in two frequencies."""
    swings = ((1.0, np.pi, 0.0), (0.5, 2.6 * np.pi, 1.0))
    v = sum(size * np.sin(w * time + phase) for size, w, phase in swings)
    a = sum(size * w * np.cos(w * time + phase) for size, w, phase in swings)
    h = np.zeros((2, len(NAMES)))
    h[0, :3], h[1, 3:] = (a, v, np.tanh(v / 0.02)), (a, v)
    return h


def followed(failure: str, first: int, last: int, rows: int) -> tuple[Told, FloatArray]:
    """What is told from a start that knows nothing, with the drive's reading wrong in the rows
    from `first` to `last`; the estimate shown after each row.
    """
    rng = np.random.default_rng(2)
    settings = Settings(sample_time=PERIOD, drift=3e-3, alarm_drift=1.0)
    recursion = RecursiveLeastSquares(
        np.zeros_like(TRUE), TRUE, outputs=2, names=NAMES, settings=settings
    )
    engine = recursion.engine_for("test")
    noise = engine.part("fast", "noise")
    noise[:] = NOISE**2
    guard = Guard(NAMES, ("motor", "link"), PERIOD)
    guard.start(recursion)
    feels = np.array([[True, False], [False, True]])
    check = RowCheck(2, len(NAMES), ((2,), ()), (0.0, 0.0), feels, PERIOD / 2, 3.0)
    level, on, theta, stuck = np.full(2, NOISE), np.ones(2, dtype=bool), recursion.theta, 0.0
    square, torque = level**2, np.full(2, 100.0)
    told, shown = [], []
    for k in range(rows):
        h = regressor(k * PERIOD)
        y = h @ TRUE + NOISE * rng.normal(size=2)
        stuck = y[0] if k <= first else stuck
        if first <= k < last:
            y[0] = stuck if failure == "stuck" else 1.3 * y[0]
        kept = (*guard.fast, engine.fast, guard.scale)
        check(y, h, theta, *kept, np.zeros(2), on, level, level, y, square, torque, 1e-3)
        square, torque = check.square.copy(), check.torque.copy()
        new = recursion.update(check.y, check.h)
        np.maximum(noise, check.least**2, out=noise)
        event = guard.step(recursion, new, check.weighted_error, level, on, check.signals)
        told += [(k, event)] if event else []
        theta = guard.theta
        shown.append(theta)
    return told, np.array(shown)


def test_a_first_motion_is_no_failure() -> None:
    """The estimate from before knows nothing of any row of the first second, and says so."""
    told, shown = followed("", 0, 0, 200)
    assert told == []
    assert shown[-1] == pytest.approx(TRUE, rel=0.01)


@pytest.mark.parametrize("first", [20, 100], ids=["a third of a second", "1.6 s"])
@pytest.mark.parametrize("failure", ["stuck", "scaled"])
def test_a_failure_soon_after_the_first_motion_is_held_off(failure: str, first: int) -> None:
    """The older estimate still knows nothing and forgives all; the rows since do not. What they
    told is shown during the failure, and goes on after it.
    """
    last = first + 60
    told, shown = followed(failure, first, last, last + 150)
    assert [event for _, event in told] == ["held", "back"]
    assert first <= told[0][0] <= first + 10
    assert told[1][0] >= last
    assert shown[told[0][0] : last] == pytest.approx(
        np.tile(TRUE, (last - told[0][0], 1)), rel=0.02
    )
    assert shown[-1] == pytest.approx(TRUE, rel=0.01)
