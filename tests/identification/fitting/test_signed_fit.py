"""Normal equations with signs: least squares where the rows speak, nothing where they do not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import lsq_linear

from identification.fitting.signed_fit import signed_fit

Array = npt.NDArray[np.float64]

FREE = np.array([])


def rows(seed: int, n: int = 200, unknowns: int = 5) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, unknowns)), rng.normal(size=n)


@pytest.mark.parametrize("scales", [(1, 1, 1, 1, 1), (1e-5, 1, 1e4, 1e-3, 1)])
def test_is_least_squares(scales: tuple[float, ...]) -> None:
    a, b = rows(0)
    a *= scales
    np.testing.assert_allclose(
        signed_fit(a.T @ a, a.T @ b, FREE, 5) * scales,
        np.linalg.lstsq(a, b, rcond=None)[0] * scales,
        rtol=1e-8,
    )


@pytest.mark.parametrize("seed", range(8))
def test_one_amplitude_that_may_not_be_negative(seed: int) -> None:
    a, b = rows(seed)
    bounds = ([-np.inf] * 4 + [0.0], [np.inf] * 5)
    np.testing.assert_allclose(
        signed_fit(a.T @ a, a.T @ b, np.zeros(1), 4),
        lsq_linear(a, b, bounds, tol=1e-14).x,
        atol=1e-7,
    )


def test_a_column_without_rows_stays_at_zero() -> None:
    a, b = rows(1)
    a[:, 2] = 0.0
    found = signed_fit(a.T @ a, a.T @ b, FREE, 5)
    assert found[2] == 0.0
    rest = [0, 1, 3, 4]
    np.testing.assert_allclose(
        found[rest], np.linalg.lstsq(a[:, rest], b, rcond=None)[0], rtol=1e-9
    )


def test_a_part_of_the_rows_says_nothing_about_what_only_the_others_hold() -> None:
    """The difference of two normal matrices leaves rounding where a column ends: it must not
    become an estimate.
    """
    a, b = rows(2)
    a /= np.linalg.norm(a, axis=0)
    a[20:, 3] = 1e-9 * a[20:, 3]
    whole, left_out = a.T @ a, a[:20].T @ a[:20]
    part, right = whole - left_out, a[20:].T @ b[20:]
    found = signed_fit(part, right, FREE, 5, whole)
    rest = [0, 1, 2, 4]
    np.testing.assert_allclose(
        found[rest], np.linalg.lstsq(a[20:][:, rest], b[20:], rcond=None)[0], rtol=0.02
    )
    assert abs(found[3]) < np.abs(found[rest]).max()


def test_a_sum_that_only_the_others_tell_apart_is_not_told_apart() -> None:
    a, b = rows(3)
    a[20:, 4] = a[20:, 3]
    part = a[20:]
    found = signed_fit(part.T @ part, part.T @ b[20:], FREE, 5, a.T @ a)
    fitted = part @ np.linalg.lstsq(part, b[20:], rcond=None)[0]
    np.testing.assert_allclose(part @ found, fitted, atol=0.05 * np.abs(fitted).max())
    assert np.abs(found).max() < 1.0
