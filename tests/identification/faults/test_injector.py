"""Faults put into readings: at their time, whatever the stamps."""

from __future__ import annotations

import numpy as np
import pytest

from identification.faults.core import SENSORS
from identification.faults.injector import KINDS, Fault, Kind, inject

DT = 1e-3
RNG = np.random.default_rng(11)
ROWS = RNG.normal(size=(3000, 6)).cumsum(axis=0)
TIME = 7.0 + DT * np.arange(3000)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("start", [0.0, 0.5, 1.0], ids=["first", "middle", "later"])
def test_even_stamps_are_as_none(kind: Kind, start: float) -> None:
    fault = Fault("torque", kind, start, 0.013, start + 0.7)
    plain = inject(ROWS, DT, [fault], seed=5)
    np.testing.assert_allclose(inject(ROWS, DT, [fault], seed=5, time=TIME), plain, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_begins_and_ends_at_its_time_where_samples_are_lost(kind: Kind) -> None:
    kept = np.flatnonzero(RNG.random(3000) > 0.2)
    fault = Fault("link_position", kind, 1.0, 0.013, 2.0)
    found = inject(ROWS[kept], DT, [fault], seed=5, time=TIME[kept])
    changed = np.flatnonzero(~np.isclose(found, ROWS[kept], rtol=0, atol=1e-12).all(axis=1))
    since = TIME[kept][changed] - TIME[0]
    assert 1.0 - DT / 2 <= since.min() < 1.0 + 5 * DT
    assert since.max() <= 2.0
    other = [i for i, name in enumerate(SENSORS) if name != "link_position"]
    np.testing.assert_array_equal(found[:, other], ROWS[kept][:, other])


def test_a_drift_and_a_delay_go_by_time_and_not_by_samples() -> None:
    kept = np.flatnonzero(RNG.random(3000) > 0.3)
    time, rows = TIME[kept], np.tile((TIME[kept] - 7.0)[:, None], (1, 6))
    drift = inject(rows, DT, [Fault("current", "drift", 1.0, 0.5)], time=time)
    late = inject(rows, DT, [Fault("current", "delay", 1.0, 0.05)], time=time)
    at = int(np.searchsorted(time, 9.5))
    assert drift[at, 0] - rows[at, 0] == pytest.approx(0.5 * 1.5, abs=3e-3)
    assert rows[at, 0] - late[at, 0] == pytest.approx(0.05, abs=5e-3)
