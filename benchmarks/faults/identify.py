"""Identification while sensors have failed (thesis 4.4): recursive estimates against the
healthy off-line value.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from benchmarks.faults.plant import DT, detector_model, readings, reference
from casadi_models import JointModel
from identification.faults.detector import Fault, FaultDetector, Reconfiguration, inject
from identification.planning.follow import Follower
from identification.recursive.estimator import RecursiveLeastSquares, Settings

FloatArray = npt.NDArray[np.float64]

NAMES = ("k1", "k2", "ka", "b_in", "C1", "C2", "b_out", "A1", "A2")
SCALE = 1.0 / np.array([2e4, 3e8, 80.0, 10.0, 30.0, 500.0, 10.0, 4.0, 4.0])


MODEL_NAMES = (
    "stiffness",
    "cubic_stiffness",
    "motor_added_spring",
    "motor_viscous",
    "motor_coulomb",
    "motor_smooth_stribeck",
    "link_viscous",
    "link_cyclic_torque_sine",
    "link_cyclic_torque_cosine",
)


def least_squares(y: FloatArray, h: FloatArray) -> FloatArray:
    """Off-line estimate of the parameters in NAMES."""
    scaled = h.reshape(-1, len(NAMES)) / SCALE
    return np.asarray(np.linalg.lstsq(scaled, y.reshape(-1), rcond=None)[0]) / SCALE


def regression(record: FloatArray, joint: JointModel) -> tuple[FloatArray, FloatArray]:
    """Both sides of the TS model (4.20), prefiltered alike (Butterworth 15 Hz): y (n, 2), H (n,
    2, 9).
    """
    from scipy.signal import bilinear_zpk, butter, sosfilt, zpk2sos

    v = joint.values
    drive, qm, vm, ql, vl, _ = record.T
    pole = butter(4, 2 * np.pi * 15.0, analog=True, output="zpk")
    low = zpk2sos(*bilinear_zpk(*pole, 1 / DT))
    steep = zpk2sos(*bilinear_zpk([0.0], pole[1], pole[2], 1 / DT))  # s times the same filter

    def smooth(x: FloatArray) -> FloatArray:
        return np.asarray(sosfilt(low, x))

    def rate(x: FloatArray) -> FloatArray:
        return np.asarray(sosfilt(steep, x))

    d = qm - ql
    direction = np.tanh(vm / v["motor_smoothing_velocity"])
    decay = vm * np.exp(-np.abs(vm) / v["motor_smooth_stribeck_velocity"])
    zero = np.zeros_like(d)
    damping = smooth(v["structural_damping"] * (vm - vl))
    y1 = smooth(drive) - v["motor_inertia"] * rate(vm) - damping
    y2 = v["link_inertia"] * rate(vl) - smooth(v["gravity_torque"] * np.sin(ql)) - damping
    rows = [
        [smooth(c) for c in (d, d**3, qm, vm, direction, decay, zero, zero, zero)],
        [smooth(c) for c in (d, d**3, zero, zero, zero, zero, -vl, -np.sin(ql), -np.cos(ql))],
    ]
    return np.column_stack([y1, y2]), np.stack([np.column_stack(r) for r in rows], axis=1)


def identify(
    joint: JointModel, follower: Follower, known_record: FloatArray
) -> list[dict[str, object]]:
    """Section 4.4: which sensors failed, the alternative, and the error of every parameter in
    percent.
    """
    record = readings(follower.run(reference(500, 60.0)), 500)
    y, h = regression(record, joint)
    settled = slice(round(2 / DT), None)
    offline = least_squares(y[settled], h[settled])
    known = least_squares(*(part[settled] for part in regression(known_record, joint)))
    detector = FaultDetector(
        detector_model(joint).with_values(dict(zip(MODEL_NAMES, known.tolist(), strict=True))), DT
    )
    detector.calibrate(known_record)
    rows: list[dict[str, object]] = []
    for failed in ((), ("link_velocity",), ("link_position",), ("link_position", "link_velocity")):
        for alternative in (1, 2):
            error = _errors(detector, record, joint, offline, failed, alternative)
            worst = max(error, key=lambda n: abs(error[n]))
            rows.append(
                {
                    "failed": list(failed),
                    "alternative": alternative,
                    "worst": worst,
                    "errors": error,
                }
            )
            print(
                f"   {' and '.join(failed) or 'nothing'} failed at 20 s, alternative "
                f"{alternative}: worst {worst} {error[worst]:+.2f} %, "
                f"ka {error['ka']:+.3f} %",
                flush=True,
            )
    return rows


def _errors(
    detector: FaultDetector,
    record: FloatArray,
    joint: JointModel,
    offline: FloatArray,
    failed: tuple[str, ...],
    alternative: int,
) -> dict[str, float]:
    detector.reset()
    faults = [Fault(s, "noise", 20.0, 0.1) for s in failed]
    track = detector.run(inject(record, DT, faults, seed=3))
    y, h = regression(track.reconstructed, joint)
    window = slice(round(2 / DT), round(9 / DT))
    # motor friction excited by reversals only: little drift of the parameters is allowed
    estimator = RecursiveLeastSquares(
        np.zeros(len(NAMES)),
        1.0 / SCALE,
        outputs=2,
        names=NAMES,
        settings=Settings(sample_time=DT, window_seconds=2.0, drift=1e-4, alarm_drift=1e-4),
    )
    found = estimator.startup(y[window], h[window])
    estimator.set_measurement_covariance(found.residual_variance)
    answer = Reconfiguration(estimator, alternative, stiffness=("k1", "k2"))  # type: ignore[arg-type]
    path, at = [], round(9 / DT)
    for event in (*track.events, None):
        end = len(y) if event is None else max(event.sample, at)
        if end > at:
            path.append(estimator.run(y[at:end], h[at:end]).theta)
            at = end
        if event is not None:
            answer(event)
    final = np.concatenate(path)[-round(5 / DT) :].mean(axis=0)
    error = {
        n: 100 * (f / o - 1)
        for n, f, o in zip(NAMES, final, offline, strict=True)
        if n not in ("A1", "A2")
    }
    error["A"] = 100 * (np.hypot(*final[-2:]) / np.hypot(*offline[-2:]) - 1)
    return {n: float(e) for n, e in error.items()}
