"""Fault campaign: healthy hours, fault cases, plant changes, replacement, identification under failure.

    python benchmarks/fault_campaign.py [healthy] [faults] [plant] [replace] [identify] [sizes]

Without names, everything (some minutes). Simulated IRJ-like joints with the noise of table B.1; the detector's model
differs from the plant (see ERRORS), and the trajectories of the test are none of those of the calibration.
"""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casadi_models import JointModel
from casadi_models.thesis import model_ts
from identification._excite_follow import Followed, Follower
from identification.fault import (
    ABRUPT,
    KINDS,
    NOISE,
    SENSORS,
    Fault,
    FaultDetector,
    FaultEvent,
    Reconfiguration,
    Verdict,
    inject,
)
from identification.recursive import RecursiveLeastSquares, Settings

FloatArray = npt.NDArray[np.float64]

DT = 1e-3
ERRORS = {
    "stiffness": 0.01, "cubic_stiffness": 0.05, "motor_inertia": 0.01, "link_inertia": 0.01, "gravity_torque": 0.005,
    "motor_added_spring": 0.03, "motor_viscous": 0.05, "motor_coulomb": 0.05, "motor_smooth_stribeck": 0.1,
    "link_viscous": 0.05, "structural_damping": 0.3,
}  # fmt: skip
"""Relative error of the detector's parameters, either sign."""
SIZES = {
    "motor_position": {"noise": 0.1, "spike": 0.01, "bias": 2e-3, "gain": 0.05, "drift": 2e-3, "delay": 0.02},
    "motor_velocity": {"noise": 0.1, "spike": 0.2, "bias": 0.05, "gain": 0.2, "drift": 0.05, "delay": 0.02},
    "link_position": {"noise": 0.1, "spike": 0.01, "bias": 2e-3, "gain": 0.05, "drift": 2e-3, "delay": 0.02},
    "link_velocity": {"noise": 0.1, "spike": 0.2, "bias": 0.05, "gain": 0.2, "drift": 0.05, "delay": 0.02},
    "torque": {"noise": 0.1, "spike": 60.0, "bias": 10.0, "gain": 0.3, "drift": 5.0, "delay": 0.05},
    "current": {"noise": 50.0, "bias": 20.0, "gain": 0.4, "drift": 10.0},
}  # fmt: skip
"""Stated sizes in rad, rad/s, N.m (per second for drift, share for gain, s for delay)."""
START = 5.0


def plant() -> JointModel:
    """The simulated joint: TS model of the thesis (tables 4.1, 4.3, 4.6), with structural damping."""
    return model_ts().add("structural_damping").with_values(
        {"structural_damping": 30.0, "link_smoothing_velocity": 5e-3}
    )  # fmt: skip


def detector_model(joint: JointModel) -> JointModel:
    """The joint with the errors an identification leaves."""
    rng = np.random.default_rng(7)
    values = dict(joint.values)
    return joint.with_values(
        {n: values[n] * (1 + e * rng.choice([-1.0, 1.0])) for n, e in ERRORS.items() if n in values}
    )


def reference(seed: int, seconds: float) -> FloatArray:
    """Random triangles and sines of 3.8 in turn, 10 s each, smoothed: (n, 3) position, velocity, acceleration."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    raw = np.zeros(n)
    for first in range(0, n, round(10 / DT)):
        t = np.arange(min(round(10 / DT), n - first)) * DT
        speed = np.radians(rng.uniform(15, 45))
        if rng.random() < 0.5:
            amplitude = rng.uniform(0.2, 1.0)
            period = 4 * amplitude / speed
            shape = 2 * np.abs(2 * ((t / period + 0.25) % 1.0) - 1) - 1
            raw[first : first + len(t)] = -amplitude * shape
        else:
            period = rng.uniform(0.8, 6.0)
            raw[first : first + len(t)] = rng.uniform(-0.5, 0.5) + speed * period / (2 * np.pi) * np.sin(
                2 * np.pi * t / period
            )
    from scipy.signal import lfilter

    w = 8.0
    a = np.exp(-w * DT)
    out = raw
    for _ in range(4):
        out = np.asarray(lfilter([1 - a], [1, -a], out), dtype=np.float64)
    velocity: FloatArray = np.gradient(out, DT)
    return np.column_stack([out, velocity, np.gradient(velocity, DT)])


def readings(run: Followed, seed: int) -> FloatArray:
    """Six readings with noise, (n, 6)."""
    clean = clean_readings(run)
    levels = np.array([NOISE[s] for s in SENSORS])
    return clean + np.random.default_rng(seed).normal(size=clean.shape) * levels


def clean_readings(run: Followed) -> FloatArray:
    """Six readings without noise, (n, 6)."""
    return np.column_stack([run.drive, run.states, run.torque])


class Campaign:
    """Plant, detector and the counts."""

    def __init__(self) -> None:
        self.joint = plant()
        self.follower = Follower(self.joint, DT)
        self.detector = FaultDetector(detector_model(self.joint), DT)
        record = readings(self.follower.run(reference(1, 120.0)), 1)
        self.record = record
        start = time.perf_counter()
        self.detector.calibrate(record)
        self.thesis = FaultDetector(detector_model(self.joint), DT, "thesis")
        self.thesis.calibrate(record)
        print(f"calibration on 120 s: {time.perf_counter() - start:.1f} s")

    def healthy(self) -> None:
        """One hour of healthy data on unseen trajectories."""
        counts: Counter[str] = Counter()
        spent, samples, thesis = 0.0, 0, 0
        for seed in range(100, 120):
            record = readings(self.follower.run(reference(seed, 182.0)), seed)
            self.detector.reset()
            start = time.perf_counter()
            track = self.detector.run(record)
            spent += time.perf_counter() - start
            samples += len(record)
            counts.update(e.verdict.name for e in track.events if e.verdict is not Verdict.ARMED)
            for e in track.events:
                if e.verdict is not Verdict.ARMED:
                    print("   healthy alarm:", seed, e.sample * DT, e.verdict.name, e.sensors, e.residuals)
            self.thesis.reset()
            thesis += sum(e.is_sensor for e in self.thesis.run(record).events)
        alarms = sum(counts[v] for v in ("SENSOR", "DROPOUT"))
        print(f"healthy: {samples * DT / 3600:.2f} h, sensor alarms {alarms}, other reports {dict(counts)}, "
              f"{spent / samples * 1e6:.1f} us per sample; thesis rule: {thesis} sensor alarms")  # fmt: skip

    def _after(self, detector: FaultDetector, record: FloatArray, faults: list[Fault], state: bytes, seed: int,
               seconds: float = 6.0) -> list[FaultEvent]:  # fmt: skip
        """Events after the fault, from the state just before it."""
        first = round(START / DT)
        faulty = inject(record, DT, faults, seed=seed)[first : first + round(seconds / DT)]
        detector.restore(state)
        return [e for e in detector.run(faulty).events if e.verdict is not Verdict.ARMED]

    def _prepared(self, detector: FaultDetector, record: FloatArray) -> bytes:
        detector.reset()
        detector.run(record[: round(START / DT)])
        return detector.state()

    def faults(self, seeds: int = 9) -> None:
        """Single faults of every sensor and kind, then pairs: detected, right sensor, delays."""
        delays: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
        first_delays: list[float] = []
        abrupt: list[float] = []
        totals: Counter[str] = Counter()
        thesis: Counter[str] = Counter()
        for seed in range(200, 200 + seeds):
            record = readings(self.follower.run(reference(seed, 14.0)), seed)
            state, thesis_state = (self._prepared(d, record) for d in (self.detector, self.thesis))
            for sensor in SENSORS:
                for kind in KINDS:
                    if kind not in SIZES[sensor] and kind not in ("stuck", "zero", "dropout"):
                        continue
                    fault = Fault(sensor, kind, START, SIZES[sensor].get(kind, 0.0))
                    events = self._after(self.detector, record, [fault], state, seed)
                    totals["cases"] += 1
                    verdict = self._judge(events, {sensor}, totals)
                    if verdict is not None:
                        delays[(sensor, kind)].append(verdict[0])
                        if kind in ABRUPT:
                            abrupt.append(verdict[0])
                            first_delays.append(verdict[1])
                    else:
                        print("   not right:", seed, sensor, kind, [(round(e.sample * DT - START, 3), e.verdict.name,
                              e.sensors) for e in events][:3])  # fmt: skip
                    if sensor.startswith("link"):
                        thesis["cases"] += 1
                        self._judge(self._after(self.thesis, record, [fault], thesis_state, seed), {sensor}, thesis)
            for faults in _pairs():
                totals["cases"] += 1
                events = self._after(self.detector, record, faults, state, seed, 8.0)
                if self._judge(events, {f.sensor for f in faults}, totals) is None:
                    print("   not right:", seed, [(f.sensor, f.kind, f.start) for f in faults],
                          [(round(e.sample * DT - START, 3), e.verdict.name, e.sensors) for e in events][:4])  # fmt: skip
        cases = totals["cases"]
        print(f"faults: {cases} cases, detected {totals['detected']}, right sensor {totals['right']} "
              f"({100 * totals['right'] / cases:.1f} %), abrupt: median {1e3 * np.median(abrupt):.0f} ms to the named "
              f"sensor, {1e3 * np.median(first_delays):.0f} ms to the first residual")  # fmt: skip
        print(f"thesis rule on link sensors: {thesis['cases']} cases, detected {thesis['detected']}, right {thesis['right']}")
        print("median delay to the named sensor [ms]:")
        print(f"{'':16}" + "".join(f"{k:>9}" for k in KINDS))
        for sensor in SENSORS:
            row = [f"{1e3 * np.median(delays[(sensor, k)]):9.0f}" if delays[(sensor, k)] else f"{'-':>9}" for k in KINDS]
            print(f"{sensor:16}" + "".join(row))

    @staticmethod
    def _judge(events: list[FaultEvent], sensors: set[str], totals: Counter[str]) -> tuple[float, float] | None:
        """Count a case; delays to the right name and to the first residual where every sensor and no other is named."""
        named: set[str] = set()
        time_named = first = float("nan")
        for e in events:
            if e.is_sensor:
                named.update(e.sensors)
            elif e.verdict is Verdict.CURRENT_OR_FRICTION:
                named.add("current")
            else:
                continue
            if np.isnan(time_named):
                time_named, first = e.sample * DT - START, e.first * DT - START
        totals["detected"] += bool(named or any(e.verdict is Verdict.PLANT for e in events))
        if named != sensors:
            return None
        totals["right"] += 1
        return time_named, max(first, 0.0)

    def plant_changes(self, seeds: int = 12) -> None:
        """Changes of the plant: how many are called a sensor fault."""
        changes = {
            "stiffness -20 %": {"stiffness": 0.8, "cubic_stiffness": 0.8}, "motor Coulomb +50 %": {"motor_coulomb": 1.5},
            "payload +20 %": {"link_inertia": 1.2, "gravity_torque": 1.2}, "link viscous x 3": {"link_viscous": 3.0},
        }  # fmt: skip
        cases = wrong = 0
        for name, factors in changes.items():
            seen: Counter[str] = Counter()
            for seed in range(300, 300 + seeds):
                path = reference(seed, 15.0)
                after = np.arange(len(path)) * DT >= START
                courses = {n: np.where(after, f, 1.0) * self.joint.values[n] for n, f in factors.items()}
                record = readings(self.follower.run(path, courses), seed)
                self.detector.reset()
                events = [e for e in self.detector.run(record).events if e.verdict is not Verdict.ARMED]
                cases += 1
                wrong += any(e.is_sensor for e in events)
                seen.update({"; ".join(sorted({f"{e.verdict.name} {'+'.join(e.sensors)}" for e in events})) or "nothing": 1})
            print(f"plant change {name}: {dict(seen)}")
        print(f"plant changes: {cases} cases, called a sensor fault {wrong}")

    def replace(self) -> None:
        """Error of the replaced link position over 40 s."""
        worst = []
        for i, kind in enumerate(("noise", "stuck", "zero", "dropout", "bias", "gain")):
            run = self.follower.run(reference(400 + i, START + 41.0))
            record = readings(run, 400 + i)
            for also in ((), ("link_velocity",)):
                size = SIZES["link_position"].get(kind, 0.0)
                faults = [Fault("link_position", kind, START, size)]  # type: ignore[arg-type]
                faults += [Fault(s, "noise", START + 2.0, 0.1) for s in also]
                self.detector.reset()
                track = self.detector.run(inject(record, DT, faults, seed=i))
                rows = track.failed[:, 3]
                error = float(np.max(np.abs(track.reconstructed[rows, 3] - run.states[rows, 2])))
                worst.append(error)
                others = [e.sensors for e in track.events if e.is_sensor]
                print(f"   position {kind}{' and velocity noise' if also else ''}: {error:.2e} rad over {rows.sum() * DT:.1f} s,"
                      f" named {others}")  # fmt: skip
        print(f"replacement: worst link position error {max(worst):.2e} rad over 40 s")

    def identify(self) -> None:
        """Section 4.4: recursive estimates with failed sensors against the healthy off-line value."""
        run = self.follower.run(reference(500, 60.0))
        record = readings(run, 500)
        y, h = regression(record, self.joint)
        settled = slice(round(2 / DT), None)
        offline = least_squares(y[settled], h[settled])
        print("healthy off line:", {n: float(f"{v:.5g}") for n, v in zip(NAMES, offline, strict=True)})
        known = least_squares(*(part[settled] for part in regression(self.record, self.joint)))
        identified = detector_model(self.joint).with_values(dict(zip(MODEL_NAMES, known.tolist(), strict=True)))
        detector = FaultDetector(identified, DT)
        detector.calibrate(self.record)
        for failed in ((), ("link_velocity",), ("link_position",), ("link_position", "link_velocity")):
            for alternative in (1, 2):
                self._identify_case(detector, record, offline, failed, alternative)

    def _identify_case(
        self, detector: FaultDetector, record: FloatArray, offline: FloatArray, failed: tuple[str, ...], alternative: int
    ) -> None:
        detector.reset()
        faults = [Fault(s, "noise", 20.0, 0.1) for s in failed]
        track = detector.run(inject(record, DT, faults, seed=3))
        y, h = regression(track.reconstructed, self.joint)
        window = slice(round(2 / DT), round(9 / DT))
        # motor friction excited by reversals only: little drift of the parameters is allowed
        estimator = RecursiveLeastSquares(
            np.zeros(len(NAMES)), 1.0 / SCALE, outputs=2, names=NAMES,
            settings=Settings(sample_time=DT, window_seconds=2.0, drift=1e-4, alarm_drift=1e-4),
        )  # fmt: skip
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
        error = {n: 100 * (f / o - 1) for n, f, o in zip(NAMES, final, offline, strict=True) if n not in ("A1", "A2")}
        error["A"] = 100 * (np.hypot(*final[-2:]) / np.hypot(*offline[-2:]) - 1)
        worst = max(error, key=lambda n: abs(error[n]))
        print(f"   {' and '.join(failed) or 'nothing'} failed at 20 s, alternative {alternative}: worst {worst} "
              f"{error[worst]:+.2f} %, ka {error['ka']:+.3f} %   " + " ".join(f"{n} {e:+.2f}" for n, e in error.items()))

    def sizes(self) -> None:
        """Detection against size: share of eight trajectories, by sensor and kind."""
        factors = (0.03, 0.1, 0.3, 1.0, 3.0)
        prepared = []
        for seed in range(600, 604):
            record = readings(self.follower.run(reference(seed, 14.0)), seed)
            prepared.append((seed, record, self._prepared(self.detector, record)))
        print("right sensor named, percent, at sizes " + ", ".join(f"{f:g} x" for f in factors) + " the stated one:")
        for sensor in SENSORS:
            for kind, size in SIZES[sensor].items():
                shares = []
                for factor in factors:
                    right: Counter[str] = Counter()
                    for seed, record, state in prepared:
                        fault = Fault(sensor, kind, START, size * factor)  # type: ignore[arg-type]
                        self._judge(self._after(self.detector, record, [fault], state, seed), {sensor}, right)
                    shares.append(100 * right["right"] / len(prepared))
                print(f"   {sensor:16}{kind:8}{size:8g}  " + "".join(f"{s:6.0f}" for s in shares), flush=True)


NAMES = ("k1", "k2", "ka", "b_in", "C1", "C2", "b_out", "A1", "A2")
SCALE = 1.0 / np.array([2e4, 3e8, 80.0, 10.0, 30.0, 500.0, 10.0, 4.0, 4.0])


MODEL_NAMES = (
    "stiffness", "cubic_stiffness", "motor_added_spring", "motor_viscous", "motor_coulomb", "motor_smooth_stribeck",
    "link_viscous", "link_cyclic_torque_sine", "link_cyclic_torque_cosine",
)  # fmt: skip


def least_squares(y: FloatArray, h: FloatArray) -> FloatArray:
    """Off-line estimate of the parameters in NAMES."""
    scaled = h.reshape(-1, len(NAMES)) / SCALE
    return np.asarray(np.linalg.lstsq(scaled, y.reshape(-1), rcond=None)[0]) / SCALE


def regression(record: FloatArray, joint: JointModel) -> tuple[FloatArray, FloatArray]:
    """Both sides of the TS model (4.20), prefiltered alike (Butterworth 15 Hz): y (n, 2), H (n, 2, 9)."""
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
    ]  # fmt: skip
    return np.column_stack([y1, y2]), np.stack([np.column_stack(r) for r in rows], axis=1)


def _pairs() -> list[list[Fault]]:
    """Staggered, simultaneous and temporary faults of the link sensors, and one across the joint."""
    def noisy(sensor: str, start: float, end: float = float("inf")) -> Fault:
        return Fault(sensor, "noise", start, 0.1, end)

    return [
        [noisy("link_position", START), noisy("link_velocity", START + 2.0)],
        [noisy("link_velocity", START), noisy("link_position", START + 2.0)],
        [noisy("link_position", START), noisy("link_velocity", START)],
        [noisy("link_position", START, START + 2.0)],
        [noisy("link_velocity", START, START + 2.0)],
        [noisy("motor_velocity", START), Fault("link_position", "stuck", START + 2.0)],
    ]  # fmt: skip


def main() -> None:
    """Run the named parts, or all."""
    parts = sys.argv[1:] or ["healthy", "faults", "plant", "replace", "identify", "sizes"]
    campaign = Campaign()
    actions = {
        "healthy": campaign.healthy, "faults": campaign.faults, "plant": campaign.plant_changes,
        "replace": campaign.replace, "identify": campaign.identify, "sizes": campaign.sizes,
    }  # fmt: skip
    for part in parts:
        start = time.perf_counter()
        actions[part]()
        print(f"[{part}: {time.perf_counter() - start:.0f} s]", flush=True)


if __name__ == "__main__":
    main()
