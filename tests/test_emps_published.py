"""The certified case: the published EMPS parameters and errors, by plain least squares on prepared
data.

Janot, Gautier, Brunot, "Data set and reference models of EMPS", nonlinearbenchmark.org, 2019.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from identification.data.prepare import decimate, drop_ends, filtered, with_derivatives
from identification.data.read import read

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "measurements" / "emps"
FORCE_PER_VOLT = 35.15065188
COLUMNS = {
    "time": {"column": "t_s", "unit": "s"},
    "motor_position": {"column": "q_m", "unit": "m"},
    "motor_torque": {"column": "u_V", "scale": FORCE_PER_VOLT, "unit": "N"},
}

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir() and not os.environ.get("CI"),
    reason="the measurements are not beside the checkout",
)

Array = npt.NDArray[np.float64]


def balance(name: str, asymmetric: bool) -> tuple[Array, Array]:
    """Regressor and force: filter the position, differentiate, decimate both sides alike."""
    record = read(FOLDER / name, columns=COLUMNS, kind="linear")
    record = with_derivatives(filtered(record, cutoff=100.0, order=4, channels=["motor_position"]))
    velocity, acceleration = record["motor_velocity"], record["motor_acceleration"]
    if asymmetric:
        forth = (velocity > 0.0).astype(float)
        columns = [acceleration, velocity * forth, forth, velocity * (1.0 - forth), forth - 1.0]
    else:
        columns = [acceleration, velocity, np.sign(velocity), np.ones(len(record))]
    regressor = decimate(drop_ends(np.column_stack(columns)))
    return regressor, decimate(drop_ends(record["motor_torque"]))


def relative_error(regressor: Array, force: Array, parameters: Array) -> float:
    return 100.0 * float(np.linalg.norm(force - regressor @ parameters) / np.linalg.norm(force))


def estimate(regressor: Array, force: Array) -> Array:
    return np.asarray(np.linalg.lstsq(regressor, force, rcond=None)[0], dtype=np.float64)


def test_symmetric_friction() -> None:
    regressor, force = balance("train.csv", asymmetric=False)
    parameters = estimate(regressor, force)
    np.testing.assert_allclose(parameters, [95.1089, 203.5034, 20.3935, -3.1648], rtol=0.01)
    assert relative_error(regressor, force, parameters) == pytest.approx(4.0834, abs=0.1)


def test_symmetric_friction_on_the_record_with_pulses() -> None:
    parameters = estimate(*balance("train.csv", asymmetric=False))
    assert relative_error(
        *balance("test_pulses.csv", asymmetric=False), parameters
    ) == pytest.approx(5.9824, abs=0.1)


def test_asymmetric_friction() -> None:
    regressor, force = balance("train.csv", asymmetric=True)
    parameters = estimate(regressor, force)
    np.testing.assert_allclose(
        parameters, [95.1540, 166.7061, 20.1440, 240.4236, 20.6277], rtol=0.01
    )
    assert relative_error(regressor, force, parameters) == pytest.approx(3.1117, abs=0.1)
