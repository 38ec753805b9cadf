"""A gain for every set of sensors: the observer goes on with whatever reading is left."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from casadi_models import JointModel
from identification.faults import core as observer
from identification.faults.core import NOISE, ObserverCore, doubled, steady_covariance

SETS = [rows for rows in itertools.product((True, False), repeat=5) if any(rows)]


@pytest.mark.parametrize("dt", [1e-3, 4e-3, 1e-2])
def test_every_set_of_sensors_has_a_stable_gain(dt: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A light joint on a soft belt, without friction: positions that nothing shows stand beside
    torques that are known to a part in a million."""
    model = JointModel.by_name("hd3", 9.0).with_values(
        {"motor_inertia": 0.0179, "link_inertia": 0.0314, "stiffness": 307.0}
    )
    errors = []
    solve = observer.steady_covariance

    def watched(*given: np.ndarray) -> np.ndarray:
        found = solve(*given)
        errors.append(observer._off(found, *given))  # infinite where the filter is not stable
        return found

    monkeypatch.setattr(observer, "steady_covariance", watched)
    core = ObserverCore(model, dt, NOISE, has_torque=True)
    errors.clear()
    for rows in SETS:
        assert np.isfinite(core._design(rows)).all(), rows
    assert len(errors) == len(SETS)
    assert max(errors) < 0.05


def test_both_ways_agree_with_samples_one_by_one() -> None:
    rng = np.random.default_rng(3)
    a, c = 0.9 * np.eye(4) + 0.05 * rng.normal(size=(4, 4)), rng.normal(size=(2, 4))
    q, r = np.array([1e-8, 1.0, 1e-3, 10.0]), np.array([1e-4, 5.0])
    p = np.diag(q)
    for _ in range(5000):
        gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.diag(r))
        p = a @ (p - gain @ c @ p) @ a.T + np.diag(q)
    for found in (steady_covariance(a, c, q, r), doubled(a, c, q, r)):
        assert found == pytest.approx(p, rel=1e-8)
