"""Identification while sensors fail (section 4.4): figures 4.33 to 4.47."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal, final

import numpy as np

from benchmarks.fault_campaign import (
    MODEL_NAMES,
    NAMES,
    SCALE,
    detector_model,
    least_squares,
    plant,
    readings,
    reference,
    regression,
)
from benchmarks.thesis.draw import Curve, Panel, picture
from benchmarks.thesis.friction import UNITS
from benchmarks.thesis.page import Figure, Row, Section, Table, percent
from benchmarks.thesis.record import DT, FloatArray, motions, times
from identification.faults.detector import (
    Fault,
    FaultDetector,
    FaultTrack,
    Reconfiguration,
    ThesisSettings,
    inject,
)
from identification.linear.subspace import MoespOptions, Subspace, moesp
from identification.planning.follow import Follower
from identification.planning.trajectories import sinusoidal, triangular
from identification.recursive.estimator import RecursiveLeastSquares, Settings

SECONDS: Final = 60.0
FAILS: Final = 20.0
SEED: Final = 500
LATE: Final = 5.0
"""The last seconds, whose mean is compared."""

Alternative = Literal[1, 2]
Rule = Literal["structured", "thesis"]

CASES: Final[tuple[tuple[str, str, tuple[str, ...], Alternative], ...]] = (
    ("velocity", "Figures 4.33, 4.34, 4.35", ("link_velocity",), 1),
    ("position", "Figures 4.36, 4.37, 4.38", ("link_position",), 1),
    ("position-frozen", "Figures 4.39, 4.40, 4.41", ("link_position",), 2),
    ("both", "Figures 4.42, 4.43, 4.44", ("link_position", "link_velocity"), 1),
    ("both-frozen", "Figures 4.45, 4.46, 4.47", ("link_position", "link_velocity"), 2),
)
GROUPS: Final = {
    "velocity": (
        ("4.33", ("b_out",)),
        ("4.34", ("k1", "k2", "ka", "C1")),
        ("4.35", ("C2", "b_in")),
    ),
    "position": (
        ("4.36", ("k1", "k2", "ka", "C1")),
        ("4.37", ("C2", "b_in")),
        ("4.38", ("b_out",)),
    ),
    "position-frozen": (
        ("4.39", ("k1", "k2", "ka", "C1")),
        ("4.40", ("C2", "b_in")),
        ("4.41", ("b_out",)),
    ),
    "both": (("4.42", ("k1", "k2", "ka", "C1")), ("4.43", ("C2", "b_in")), ("4.44", ("b_out",))),
    "both-frozen": (
        ("4.45", ("k1", "k2", "ka", "C1")),
        ("4.46", ("C2", "b_in")),
        ("4.47", ("b_out",)),
    ),
}


@final
@dataclass(frozen=True)
class Tracked:
    """Courses of the nine parameters from the start-up on, and what the detector did.

    Attributes
    ----------
    path : (n, 9) array
    named : float
        When the last of the failed sensors was named [s]; infinite where one was not.
    wrong : tuple of str
        Healthy sensors that were replaced.
    position : float
        Largest error of the replaced link position [rad]; 0 where it did not fail.
    """

    path: FloatArray
    named: float
    wrong: tuple[str, ...]
    position: float

    def deviations(self, offline: FloatArray) -> dict[str, float]:
        """Mean of the last seconds against the off-line values [%]; the cyclic torque by its
        amplitude.
        """
        final = self.path[-round(LATE / DT) :].mean(axis=0)
        found = {
            n: percent(float(f), float(o))
            for n, f, o in zip(NAMES, final, offline, strict=True)
            if n not in ("A1", "A2")
        }
        found["A"] = percent(float(np.hypot(*final[-2:])), float(np.hypot(*offline[-2:])))
        return found


@cache
def seen_motions() -> tuple[list[FloatArray], list[FloatArray]]:
    """Inputs q_m, v_m, a_m and outputs q_l, v_l along the twelve motions of 4.1.4."""
    d = np.radians
    more = [
        triangular(float(d(v)), limit=float(d(60)), reversal=0.2, duration=15.0)
        for v in (20, 30, 35)
    ]
    more += [
        sinusoidal(float(d(v)), t, hold=h, duration=15.0)
        for v, t, h in ((20, 1.9, 0.0), (30, 3.0, 1.0), (45, 6.0, 0.0))
    ]
    follower = Follower(plant(), DT)
    inputs, outputs = [], []
    for seed, motion in enumerate([*motions(), *more]):
        seen = readings(follower.run(motion.table), 700 + seed)
        rate = np.diff(seen[:, 2], prepend=seen[0, 2]) / DT
        inputs.append(np.column_stack([seen[:, 1:3], rate]))
        outputs.append(seen[:, 3:5])
    return inputs, outputs


@cache
def subspace() -> Subspace:
    """Order 2 from motor position, velocity, acceleration to link position, velocity, on twelve
    motions (4.1.4).
    """
    inputs, outputs = seen_motions()
    names = MoespOptions(input_names=("qm", "vm", "am"), output_names=("ql", "vl"))
    return moesp(inputs, outputs, block_rows=20, order=2, dt=DT, options=names)


@final
class Bench:
    """Record, off-line value and both detectors."""

    def __init__(self) -> None:
        self.joint = plant()
        follower = Follower(self.joint, DT)
        self.run = follower.run(reference(SEED, SECONDS))
        self.record = readings(self.run, SEED)
        settled = slice(round(2 / DT), None)
        y, h = regression(self.record, self.joint)
        self.offline = least_squares(y[settled], h[settled])
        healthy = readings(follower.run(reference(1, 120.0)), 1)
        known = least_squares(*(part[settled] for part in regression(healthy, self.joint)))
        model = detector_model(self.joint).with_values(
            dict(zip(MODEL_NAMES, known.tolist(), strict=True))
        )
        thesis = FaultDetector(
            model, DT, "thesis", settings=ThesisSettings(samples=1), predictor=subspace().system
        )
        self.detectors: dict[Rule, FaultDetector] = {
            "structured": FaultDetector(model, DT),
            "thesis": thesis,
        }
        for detector in self.detectors.values():
            detector.calibrate(healthy)
        self._watched: dict[tuple[Rule, tuple[str, ...]], FaultTrack] = {}

    def watched(self, rule: Rule, failed: tuple[str, ...]) -> FaultTrack:
        """The record with failed sensors replaced by noise N(0, 0.1) at 20 s, as the detector
        passes it on.
        """
        if (rule, failed) not in self._watched:
            detector = self.detectors[rule]
            detector.reset()
            faulty = inject(
                self.record, DT, [Fault(s, "noise", FAILS, 0.1) for s in failed], seed=3
            )
            self._watched[rule, failed] = detector.run(faulty)
        return self._watched[rule, failed]

    def track(self, rule: Rule, failed: tuple[str, ...], alternative: Alternative) -> Tracked:
        """Recursive least squares on what the detector passes on, reconfigured by its events."""
        found = self.watched(rule, failed)
        y, h = regression(found.reconstructed, self.joint)
        window, at = slice(round(2 / DT), round(9 / DT)), round(9 / DT)
        # the joint does not change: little drift of the parameters is allowed, also after an alarm
        estimator = RecursiveLeastSquares(
            np.zeros(len(NAMES)),
            1.0 / SCALE,
            outputs=2,
            names=NAMES,
            settings=Settings(sample_time=DT, window_seconds=2.0, drift=1e-4, alarm_drift=1e-4),
        )
        start = estimator.startup(y[window], h[window])
        estimator.set_measurement_covariance(start.residual_variance)
        answer = Reconfiguration(estimator, alternative, stiffness=("k1", "k2"))
        parts = []
        for event in (*found.events, None):
            end = len(y) if event is None else max(event.sample, at)
            if end > at:
                parts.append(estimator.run(y[at:end], h[at:end]).theta)
                at = end
            if event is not None:
                answer(event)
        return Tracked(np.concatenate(parts), *self._seen(found, failed))

    def _seen(
        self, found: FaultTrack, failed: tuple[str, ...]
    ) -> tuple[float, tuple[str, ...], float]:
        named: dict[str, float] = {}
        for e in found.events:
            if e.is_sensor:
                for sensor in e.sensors:
                    named.setdefault(sensor, e.sample * DT)
        when = max((named.get(s, np.inf) for s in failed), default=0.0)
        replaced = (
            found.failed[:, 3]
            if "link_position" in failed
            else np.zeros(len(self.record), dtype=bool)
        )
        gap = np.abs(found.reconstructed[replaced, 3] - self.run.states[replaced, 2])
        return float(when), tuple(sorted(set(named) - set(failed))), float(np.max(gap, initial=0.0))


@cache
def bench() -> Bench:
    """One for all sections."""
    return Bench()


def under_failure() -> Section:
    """Section 4.4."""
    made = bench()
    page = Section("Figures 4.33 to 4.47: identification while sensors fail (section 4.4)")
    page.add(
        f"TS model as above, {SECONDS:g} s; at {FAILS:g} s the reading of the link's velocity, "
        "position or both becomes noise N(0, 0.1). Two "
        "ways to find and replace it: structured residuals with the joint's model and the "
        "remaining sensors (the project's default), and the "
        "thesis's rule (4.6) to (4.8) with an order-2 MOESP model from motor to link, identified "
        "on twelve other motions. Alternative 1 raises R2; "
        "alternative 2 also freezes k1 and k2 where a position failed. Deviations are those of "
        "the mean of the last 5 s from the healthy "
        "off-line value; A is the amplitude of the cyclic torque. Printed: 0.5 % (ka) to 10.5 % "
        "(C2).",
    )
    rows, pictures, wrong = [], [], set[str]()
    for stem, figures, failed, alternative in (("healthy", "", (), 1), *CASES):
        tracks: dict[Rule, Tracked] = {
            rule: made.track(rule, failed, alternative) for rule in ("structured", "thesis")
        }
        for rule, tracked in tracks.items():
            wrong.update(tracked.wrong)
            rows.append(
                _row(
                    f"{' and '.join(failed).replace('_', ' ') or 'nothing'}, alternative "
                    f"{alternative}, {_WORDS[rule]}",
                    tracked,
                    made.offline,
                )
            )
        if failed:
            pictures.append(_figure(stem, figures, tracks, made.offline))
    heads = (
        *(f"{n.replace('_', ' ')} [%]" for n in (*NAMES[:7], "A")),
        "position replaced to [rad]",
        "named after [ms]",
    )
    page.add(Table(heads, tuple(rows), "failed, answer"))
    model = subspace()
    page.add(
        f"MOESP model: spectral radius {model.spectral_radius:.4f}, VAF "
        f"{model.vaf_percent[0]:.3f} % (position) and {model.vaf_percent[1]:.3f} % "
        "(velocity) "
        "on its own motions; printed 100 % and 99.9898 %.",
    )
    page.add(
        "Healthy sensors that were taken for failed: "
        f"{', '.join(sorted(wrong)).replace('_', ' ') or 'none'}."
    )
    judged: tuple[Rule, ...] = ("structured", "thesis")
    for rule in judged:
        for which in (1, 2):
            part = [r for r in rows[2:] if r.what.endswith(f"alternative {which}, {_WORDS[rule]}")]
            size, name, what = max(
                (abs(v), n, r.what.partition(",")[0])
                for r in part
                for n, v in zip((*NAMES[:7], "A"), r.found, strict=False)
            )
            spring = max(abs(r.found[2]) for r in part)
            numbers = (
                f"worst {size:.1f} % ({name.replace('_', ' ')}; {what.replace('_', ' ')} "
                f"failed), added spring {spring:.2f} %"
            )
            page.brief.append(
                (
                    "figures 4.33 to 4.47",
                    f"sensors failed, {_WORDS[rule]}, alternative {which}: {numbers} (printed "
                    "10.5 and 0.5 %)",
                )
            )
            page.add(f"{_WORDS[rule].capitalize()}, alternative {which}: {numbers}.")
    places = {
        rule: [
            r.found[8] for r in rows if r.what.endswith(_WORDS[rule]) and np.isfinite(r.found[8])
        ]
        for rule in judged
    }
    ratios = [b / a for a, b in zip(places["structured"], places["thesis"], strict=True)]
    page.add(
        "With the thesis's own rule and alternative 1 its 10.5 % come out, its 0.5 % for the "
        "added spring do not. A single "
        "sample must suffice for the decision: three samples of the noise spoil the springs, "
        "which live on torsions of some "
        "mrad. With alternative 2 the frozen springs meet a torsion that the MOESP model gives "
        "too large or too small, and "
        "added spring and cyclic torque take up the difference; here the thesis prints the same "
        "0.5 to 10.5 %, and this could "
        "not be reproduced. With structured residuals the replaced position is "
        f"{min(ratios):.0f} to {max(ratios):.0f} times "
        "better, and both alternatives hold.",
    )
    page.add(*pictures)
    return page


_WORDS: Final[Mapping[str, str]] = {
    "structured": "structured residuals",
    "thesis": "thesis rule and subspace model",
}


def _row(what: str, tracked: Tracked, offline: FloatArray) -> Row:
    named = 1e3 * (tracked.named - FAILS) if tracked.named else float("nan")
    return Row(
        what, None, (*tracked.deviations(offline).values(), tracked.position or float("nan"), named)
    )


def _figure(stem: str, figures: str, tracks: dict[Rule, Tracked], offline: FloatArray) -> Figure:
    panels = []
    for number, group in GROUPS[stem]:
        for n in group:
            i = NAMES.index(n)
            time = times(len(tracks["structured"].path), 9.0)
            curves = [Curve(time[[0, -1]], np.full(2, offline[i]), "limit")]
            curves += [
                Curve(time, t.path[:, i], kind)
                for t, kind in ((tracks["thesis"], "measured"), (tracks["structured"], "model"))
            ]
            panels.append(
                Panel(
                    f"{number}: {n.replace('_', ' ')} [{UNITS[n]}]",
                    "time [s]",
                    "",
                    tuple(curves),
                    points=60,
                )
            )
    words = []
    for rule, tracked in tracks.items():
        size = tracked.deviations(offline)
        worst = max(size, key=lambda n: abs(size[n]))
        words.append(
            f"{_WORDS[rule]} {worst.replace('_', ' ')} {size[worst]:+.1f} %, ka {size['ka']:+.2f} %"
        )
    numbers = "; ".join(
        f"{number}: {', '.join(n.replace('_', ' ') for n in group)}"
        for number, group in GROUPS[stem]
    )
    return Figure(
        f"failure-{stem}",
        figures,
        f"{numbers}. Failure at {FAILS:g} s; dashed: healthy off-line value. Worst at the end: "
        f"{'; '.join(words)}.",
        picture(
            panels,
            f"Parameters while {stem} fails",
            (("model", "structured"), ("measured", "MOESP"), ("limit", "off line")),
            columns=4,
        ),
    )
