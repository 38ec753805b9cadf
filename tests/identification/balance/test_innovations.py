"""What a drift that fades leaves new in each row, against the covariance of all rows at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from identification.balance.stacked import apart_from_drift, innovations
from identification.balance.weak import WeakRecord, prepare

FloatArray = npt.NDArray[np.float64]
MEMORY = 0.4


def at(stamps: FloatArray) -> WeakRecord:
    """A record with rows at these instants."""
    time = 1e-3 * np.arange(4000)
    made = prepare(time, {"motor_position": np.sin(time)}, (slice(0, len(time)),))
    return replace(made, time=stamps)


def rows(count: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Instants with gaps, residuals, scatter and drift of as many rows."""
    rng = np.random.default_rng(seed)
    stamps = 3.0 + np.cumsum(rng.exponential(0.2, count))
    scatter, drift = rng.uniform(0.1, 0.8, count), rng.uniform(0.2, 0.7, count)
    return stamps, rng.standard_normal(count), scatter, drift


def test_innovations_are_the_residuals_over_the_factor_of_their_covariance() -> None:
    """Rows of endless scatter say nothing of the drift, whatever they read, and no record says
    anything of that of another one.
    """
    records, parts, expected = [], [], []
    for seed, count in ((1, 30), (2, 20)):
        stamps, residual, scatter, drift = rows(count, seed)
        scatter[[0, 7, 8]] = np.inf
        kept = np.isfinite(scatter)
        apart = np.abs(stamps[:, None] - stamps)
        covariance = np.outer(drift, drift) * np.exp(-apart / MEMORY) + np.diag(scatter**2)
        lower = np.linalg.cholesky(covariance[np.ix_(kept, kept)])
        new = np.zeros(count)
        new[kept] = np.linalg.solve(lower, residual[kept])
        records.append(at(stamps))
        parts.append((residual, scatter, drift))
        expected.append(new)
    residual, scatter, drift = (np.concatenate(p) for p in zip(*parts, strict=True))
    found = innovations(residual, scatter, drift, memory=MEMORY, records=records)
    assert found == pytest.approx(np.concatenate(expected), abs=1e-12)


def test_a_row_without_any_deviation_is_left_out() -> None:
    stamps, residual, scatter, drift = rows(12, 3)
    scatter[5] = drift[5] = 0.0
    others = np.arange(12) != 5
    found = innovations(residual, scatter, drift, memory=MEMORY, records=[at(stamps)])
    alone = innovations(
        residual[others],
        scatter[others],
        drift[others],
        memory=MEMORY,
        records=[at(stamps[others])],
    )
    assert found[5] == 0.0
    assert found[others] == pytest.approx(alone, abs=1e-12)


def test_columns_are_each_taken_alone() -> None:
    stamps, residual, scatter, drift = rows(15, 4)
    scatter[3] = np.inf
    columns = np.column_stack([residual, residual**2, np.ones(15)])
    found = innovations(columns, scatter, drift, memory=MEMORY, records=[at(stamps)])
    for column, new in zip(columns.T, found.T, strict=True):
        alone = innovations(column, scatter, drift, memory=MEMORY, records=[at(stamps)])
        assert new == pytest.approx(alone, abs=1e-12)


def test_what_a_drift_gives_rows_is_taken_off_their_deviation() -> None:
    """But for the part of their noise that is none of it, however large the drift is said to be."""
    scatter, drift = np.array([0.5, 0.5, np.inf, 0.0]), np.array([0.3, 0.9, 0.3, 0.0])
    assert apart_from_drift(scatter, drift, 0.1) == pytest.approx([0.4, 0.1, np.inf, 0.1])
