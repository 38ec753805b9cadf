"""Windows run by compiled C are those of CasADi's virtual machine; long records take the
compiled way where there is one."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from identification.fitting import window_run as _window_run
from identification.fitting.window_run import LONG, WindowRun


def pendulum() -> ca.Function:
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    after = ca.vertcat(
        x[0] + 0.01 * x[1], x[1] + 0.01 * (u - p[0] * ca.sin(x[0]) - p[1] * ca.tanh(x[1]))
    )
    return ca.Function("sample", [x, u, p], [after, ca.vertcat(x[0], x[1] * p[1], u)])


def test_compiled_windows_are_those_of_the_virtual_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    start, inputs, p = (
        rng.standard_normal((7, 2)),
        rng.standard_normal((7 * 40, 1)),
        np.array([9.81, 0.3]),
    )
    compiled = WindowRun(pendulum(), 40, LONG)
    monkeypatch.setenv("IDENTIFICATION_CC", "none")
    plain = WindowRun(pendulum(), 40, LONG)
    found = compiled(start, inputs, p)
    assert found.shape == (7, 40, 3)
    np.testing.assert_allclose(found, plain(start, inputs, p), rtol=1e-12, atol=1e-14)
    # each window begins at its own start and takes its own inputs
    np.testing.assert_allclose(
        found[3:4], plain(start[3:4], inputs[120:160], p), rtol=1e-12, atol=1e-14
    )


def test_short_records_are_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_window_run, "_compiled", lambda sample: pytest.fail("compiled"))
    WindowRun(pendulum(), 40, LONG - 1)
