"""MOESP with the fast compression: the same factor as QR, on several records, in any portions;
QR where digits run out.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from identification.errors import InputError
from identification.linear.hankel_gram import HankelGram, TooFewDigits
from identification.linear.hankel_qr import HankelQR, Method
from identification.linear.subspace import MoespOptions, SubspaceOutcome, moesp

FloatArray = npt.NDArray[np.float64]
METHODS: tuple[Method, ...] = ("ordinary", "past_output")


def system(samples: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Two inputs, two outputs, three poles, a little noise."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((samples, 2))
    first = lfilter([0.0, 0.5, 0.2], [1.0, -1.5, 0.7], u[:, 0])
    second = lfilter([0.1, 0.3], [1.0, -0.8], u[:, 1]) + 0.3 * first
    return u, np.column_stack([first, second]) + 0.01 * rng.standard_normal((samples, 2))


@pytest.mark.parametrize("method", METHODS)
def test_the_factor_is_that_of_the_stored_hankel_matrix(method: Method) -> None:
    u, y = system(300, 1)
    qr = HankelQR(2, 2, 5, method, [1.0, 3.0])
    gram = HankelGram(qr)
    gram.add(u, y)
    data = np.hstack((u, y * [1.0, 3.0]))
    rows = len(data) - qr.window + 1
    stored = np.column_stack([data[lag : lag + rows, channel] for lag, channel in qr.column_order])
    triangle = gram.factor().triangle
    assert triangle.T @ triangle == pytest.approx(stored.T @ stored, rel=1e-10, abs=1e-9)
    assert np.array_equal(triangle, np.triu(triangle))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("portion", [1, 7, 64, 1000])
def test_portions_and_records_do_not_matter(method: Method, portion: int) -> None:
    qr = HankelQR(2, 2, 6, method)
    gram = HankelGram(qr)
    for samples, seed in ((400, 2), (20, 3), (5, 4), (300, 5)):
        u, y = system(samples, seed)
        for start in range(0, samples, portion):
            for one in (qr, gram):
                one.add(u[start : start + portion], y[start : start + portion])
        for one in (qr, gram):
            one.end_record()
    assert gram.rows == qr.rows
    expected, found = qr.factor().triangle, gram.factor().triangle
    assert np.abs(found) == pytest.approx(np.abs(expected), rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_moesp_finds_the_same_model(method: Method) -> None:
    u, y = system(4000, 6)
    by_qr = moesp(u, y, 12, None, method=method)
    fast = moesp(u, y, 12, None, method=method, options=MoespOptions(compression="fast"))
    assert (by_qr.compression, fast.compression) == ("qr", "fast")
    assert fast.order == by_qr.order == 3
    assert fast.outcome is SubspaceOutcome.ORDER_CHOSEN
    assert fast.singular_values == pytest.approx(by_qr.singular_values, rel=1e-8)
    assert np.sort_complex(np.linalg.eigvals(fast.system.A)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(by_qr.system.A)), abs=1e-8
    )


def test_smooth_inputs_fall_back_to_qr_and_say_so() -> None:
    """Position, velocity and acceleration of a slow motion: the correlations lose their digits."""
    t = np.arange(4000) * 1e-3
    q = np.sin(3 * t) + 0.4 * np.sin(7 * t + 1)
    u = np.column_stack([q, np.gradient(q, t), np.gradient(np.gradient(q, t), t)])
    y = lfilter([0.0, 0.1], [1.0, -0.9], q)[:, None] + 1e-6 * np.random.default_rng(
        7
    ).standard_normal((len(t), 1))
    found = moesp(u, y, 8, 1, options=MoespOptions(compression="fast"))
    assert found.compression == "qr"
    gram = HankelGram(HankelQR(3, 1, 8))
    gram.add(u, y)
    with pytest.raises(TooFewDigits):
        gram.factor()


def test_bad_input_is_refused_as_by_qr() -> None:
    u, y = system(300, 8)
    options = MoespOptions(compression="fast")
    with pytest.raises(InputError, match="y channel 1 holds nan at sample 40"):
        moesp(u, np.where(np.arange(600).reshape(300, 2) == 81, np.nan, y), 5, 2, options=options)
    with pytest.raises(InputError, match="u channel 0 is constant"):
        moesp(np.column_stack([np.ones(300), u[:, 1]]), y, 5, 2, options=options)
    with pytest.raises(InputError, match="Hankel rows"):
        moesp(u[:40], y[:40], 9, 2, options=options)
    with pytest.raises(InputError, match="'lq' is unknown"):
        moesp(u, y, 5, 2, options=MoespOptions(compression="lq"))  # type: ignore[arg-type]
