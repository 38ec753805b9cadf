"""Subspace models and sensor failures by themselves (sections 4.1 and 4.2): figures 4.1 to 4.15.
And what the damping of configuration 1 (2.17) is in the project's terms.
"""

from __future__ import annotations

import math
import warnings
from functools import cache
from typing import Final, final

import numpy as np

from benchmarks.fault_campaign import plant, readings
from benchmarks.moesp_joint import initial_state
from benchmarks.thesis.draw import Curve, Panel, picture
from benchmarks.thesis.failure import bench, seen_motions
from benchmarks.thesis.page import Figure, Row, Section, Table
from benchmarks.thesis.record import DT, FloatArray, times
from casadi_models import thesis
from identification.faults.detector import Fault, FaultTrack, inject
from identification.faults.types import Verdict
from identification.linear.subspace import MoespOptions, Subspace, UnstableModelWarning, moesp
from identification.planning.follow import Follower
from identification.planning.trajectories import Motion, sinusoidal, triangular

ORDERS: Final = (1, 2, 3, 4, 5, 6)
BLOCK_ROWS: Final = 20
START: Final = 1.0
"""Part of a record from which the initial state is estimated; it does not count in the VAF [s]."""
NAMES: Final = MoespOptions(input_names=("qm", "vm", "am"), output_names=("ql", "vl"))
PRINTED: Final = {"position": 100.0, "velocity": 99.9898, "relative position": 95.2262}
"""VAF of (4.4) and under figure 4.6 [%]."""

CASES: Final[tuple[tuple[str, str, str, tuple[Fault, ...]], ...]] = (
    ("position", "4.7, 4.8", "triangle", (Fault("link_position", "noise", 5.0, 0.1),)),
    ("velocity", "4.9, 4.10", "triangle", (Fault("link_velocity", "noise", 6.0, 0.1),)),
    (
        "staggered",
        "4.11, 4.12",
        "sine",
        (
            Fault("link_position", "noise", 5.0, 0.1),
            Fault("link_velocity", "noise", 7.0, 0.1),
        ),
    ),
    (
        "simultaneous",
        "4.13",
        "sine",
        (
            Fault("link_position", "noise", 5.0, 0.1),
            Fault("link_velocity", "noise", 5.0, 0.1),
        ),
    ),
    (
        "temporary",
        "4.14, 4.15",
        "sine",
        (Fault("link_position", "noise", 5.0, 0.1, end=8.0),),
    ),
)
"""Name, figures, motion and faults of section 4.2.3; where the thesis prints no time, 5 s."""


def _motion(kind: str) -> Motion:
    d = math.radians
    if kind == "triangle":
        return triangular(d(25), limit=d(35), reversal=0.15, duration=15.0)
    return sinusoidal(d(25), 4.0, hold=1.0, duration=15.0)


@cache
def run(kind: str) -> FloatArray:
    """Readings of the joint along a motion of the thesis."""
    follower = Follower(plant(), DT)
    return readings(follower.run(_motion(kind).table), 800)


def io(seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inputs q_m, v_m, a_m and outputs q_l, v_l of readings."""
    rate = np.diff(seen[:, 2], prepend=seen[0, 2]) / DT
    return np.column_stack([seen[:, 1:3], rate]), seen[:, 3:5]


@cache
def model(order: int) -> Subspace:
    """MOESP of an order on the twelve motions."""
    inputs, outputs = seen_motions()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableModelWarning)
        return moesp(inputs, outputs, BLOCK_ROWS, order, DT, options=NAMES)


def simulated(found: Subspace, u: FloatArray, y: FloatArray) -> FloatArray:
    """Free simulation from an initial state estimated on the first second."""
    first = round(START / DT)
    state = initial_state(found, u[:first], y[:first])
    return found.simulate(u, state)


def vafs(found: Subspace, u: FloatArray, y: FloatArray) -> dict[str, float]:
    """VAF (4.2) of position, velocity and relative position after the first second [%]."""
    first = round(START / DT)
    got = simulated(found, u, y)
    errors = {
        "position": (y - got)[first:, 0],
        "velocity": (y - got)[first:, 1],
        "relative position": (y - got)[first:, 0],
    }
    signals = {
        "position": y[first:, 0],
        "velocity": y[first:, 1],
        "relative position": (u[:, 0] - y[:, 0])[first:],
    }
    return {n: 100.0 * (1.0 - float(np.var(errors[n]) / np.var(signals[n]))) for n in PRINTED}


def models() -> Section:
    """Section 4.1: figures 4.1 to 4.6."""
    page = Section("Figures 4.1 to 4.6: subspace models (section 4.1)")
    u, y = io(run("triangle"))
    page.add(
        "MOESP from motor position, velocity and acceleration to link position and velocity, "
        "identified on twelve motions; judged on the thesis's triangle of 25 deg/s by a free "
        "simulation of 15 s whose initial state comes from the first second. The thesis fits and "
        "judges on the same motions; here the triangle's readings are others.",
    )
    rows = []
    for order in ORDERS:
        found = model(order)
        stable = found.spectral_radius < 1.0
        vaf = vafs(found, u, y) if stable else dict.fromkeys(PRINTED, math.nan)
        rows.append(Row(f"order {order}", None, (found.spectral_radius, *vaf.values())))
    heads = ("spectral radius", "position [%]", "velocity [%]", "relative position [%]")
    page.add(Table(heads, tuple(rows), "model"))
    two = vafs(model(2), u, y)
    page.add(
        Table(
            ("found",),
            tuple(Row(f"VAF of the {n} [%]", PRINTED[n], (two[n],)) for n in PRINTED),
            "order 2",
        )
    )
    stable = [n for n in ORDERS if model(n).spectral_radius < 1.0]
    values = model(2).singular_values
    page.add(
        f"Stable without a Kalman gain: order {', '.join(str(n) for n in stable)} (the thesis: up "
        "to 2; its readings are those of a real joint). The singular values fall by "
        f"{values[0] / values[1]:.3g} after the first, {values[1] / values[2]:.3g} after the "
        f"second and {values[2] / values[3]:.3g} after the third.",
    )
    page.brief.append(
        (
            "figures 4.1 to 4.6",
            f"MOESP of order 2: VAF {two['position']:.3f}, {two['velocity']:.3f} and "
            f"{two['relative position']:.1f} % (printed 100, 99.9898 and 95.2 %); stable orders "
            f"{', '.join(str(n) for n in stable)} (printed: up to 2)",
        )
    )
    page.add(*_model_figures(u, y))
    return page


def _model_figures(u: FloatArray, y: FloatArray) -> list[Figure]:
    values = model(2).singular_values
    counted = np.arange(1, 13, dtype=np.float64)
    panel = Panel(
        "4.1: singular values, logarithm to base 10",
        "number",
        "",
        (Curve(counted, np.log10(values[:12]), "model", dots=True),),
    )
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    panels = [panel]
    for number, order in (("4.2", 2), ("4.3", 3)):
        poles = np.linalg.eigvals(np.asarray(model(order).system.A))
        circle = Curve(np.cos(turn), np.sin(turn), "limit")
        marks = tuple(
            Curve(np.full(2, p.real), np.array([p.imag - 0.04, p.imag + 0.04]), "measured")
            for p in poles
        )
        panels.append(
            Panel(
                f"{number}: poles of order {order}",
                "real",
                "imaginary",
                (circle, *marks),
                points=200,
            )
        )
    time, got = times(len(u)), simulated(model(2), u, y)
    pictures = [
        Figure(
            "subspace-order",
            "Figures 4.1, 4.2, 4.3",
            f"4.1: singular values; 4.2, 4.3: poles of orders 2 and 3, spectral radius "
            f"{model(2).spectral_radius:.5f} and {model(3).spectral_radius:.5f}.",
            picture(panels, "Order of the subspace model", columns=3),
        )
    ]
    inputs = [
        Panel(f"4.4: {n}", "time [s]", "", (Curve(time, u[:, k], "measured"),))
        for k, n in enumerate(
            ("motor position [rad]", "motor velocity [rad/s]", "motor acceleration [rad/s²]")
        )
    ]
    outputs = [
        Panel(
            f"4.5: {n}",
            "time [s]",
            "",
            (Curve(time, y[:, k], "measured"), Curve(time, got[:, k], "model")),
        )
        for k, n in enumerate(("link position [rad]", "link velocity [rad/s]"))
    ]
    twist = (u[:, 0] - y[:, 0], u[:, 0] - got[:, 0])
    rate = (u[:, 1] - y[:, 1], u[:, 1] - got[:, 1])
    relative = [
        Panel(
            f"4.6: relative {n}",
            "time [s]",
            "",
            (Curve(time, a, "measured"), Curve(time, b, "model")),
        )
        for n, (a, b) in (("position [rad]", twist), ("velocity [rad/s]", rate))
    ]
    pictures.append(
        Figure(
            "subspace-estimate",
            "Figures 4.4, 4.5, 4.6",
            "4.4: inputs; 4.5: outputs, measured and from the order-2 model; 4.6: relative "
            "position and velocity of motor and link.",
            picture(
                [*inputs, *outputs, *relative],
                "Inputs, outputs and relative motion",
                (("measured", "measured"), ("model", "MOESP, order 2")),
                columns=3,
            ),
        )
    )
    return pictures


@final
class Judged:
    """What a rule made of one case."""

    def __init__(self, track: FaultTrack, faults: tuple[Fault, ...], healthy: FloatArray) -> None:
        named = {s: e.sample * DT for e in reversed(track.events) if e.is_sensor for s in e.sensors}
        asked = {f.sensor: f for f in faults}
        self.wrong = tuple(sorted(set(named) - set(asked)))
        self.delay = max(
            (1e3 * (named.get(s, math.inf) - f.start) for s, f in asked.items()), default=0.0
        )
        back = [e.sample * DT for e in track.events if e.verdict is Verdict.RECOVERED]
        ends = [f.end for f in faults if math.isfinite(f.end)]
        self.returned = back[-1] - ends[0] if back and ends else math.nan
        self.errors = []
        for column in (3, 4):
            failed = track.failed[:, column]
            gap = np.abs(track.reconstructed[failed, column] - healthy[failed, column])
            self.errors.append(float(np.max(gap, initial=0.0)) if failed.any() else math.nan)
        self.track = track


def failures() -> Section:
    """Section 4.2: figures 4.7 to 4.15."""
    page = Section("Figures 4.7 to 4.15: sensor failures by themselves (section 4.2)")
    page.add(
        "The link's position, velocity or both become noise N(0, 0.1) on a triangle and on a sine "
        "of 25 deg/s; the thesis's rule (4.6) to (4.8) with the order-2 MOESP model beside the "
        "project's structured residuals. Named: after the failure; replaced: largest difference of "
        "the replaced reading from the healthy one, which holds the sensor's own noise; back: time "
        "until a sensor that works again is used again.",
    )
    rows, pictures, worst = [], [], {"thesis": 0.0, "structured": 0.0}
    wrong: set[str] = set()
    for stem, figures, kind, faults in CASES:
        healthy = run(kind)
        found = {}
        for rule, detector in bench().detectors.items():
            detector.reset()
            track = detector.run(inject(healthy, DT, list(faults), seed=3))
            found[rule] = judged = Judged(track, faults, healthy)
            worst[rule] = max(worst[rule], judged.delay)
            wrong.update(judged.wrong)
            words = "thesis's rule" if rule == "thesis" else "structured residuals"
            rows.append(
                Row(
                    f"{figures}: {stem}, {words}",
                    None,
                    (judged.delay, *judged.errors, judged.returned),
                )
            )
        pictures.append(_failure_figure(stem, figures, healthy, faults, found["thesis"]))
    heads = (
        "named after [ms]",
        "position replaced to [rad]",
        "velocity replaced to [rad/s]",
        "back after [s]",
    )
    page.add(Table(heads, tuple(rows), "figure and case"))
    page.add(f"Healthy sensors named: {', '.join(sorted(wrong)) or 'none'}.")
    page.brief.append(
        (
            "figures 4.7 to 4.15",
            "sensor failures by themselves: all named after at most "
            f"{worst['thesis']:.0f} ms (thesis's rule) and {worst['structured']:.0f} ms "
            "(structured residuals); the thesis: instantaneously",
        )
    )
    page.add(*pictures)
    return page


def _failure_figure(
    stem: str, figures: str, healthy: FloatArray, faults: tuple[Fault, ...], judged: Judged
) -> Figure:
    time = times(len(healthy))
    faulty = inject(healthy, DT, list(faults), seed=3)
    panels = []
    for column, name in ((3, "link position [rad]"), (4, "link velocity [rad/s]")):
        sensor = "link_position" if column == 3 else "link_velocity"
        if sensor not in {f.sensor for f in faults}:
            continue
        span = np.abs(healthy[:, column]).max() * 1.2
        for words, values in (
            ("reading", faulty[:, column]),
            ("after reconfiguration", judged.track.reconstructed[:, column]),
        ):
            curves = (
                Curve(time, values, "measured"),
                Curve(time, healthy[:, column], "limit"),
            )
            panels.append(
                Panel(f"{name}, {words}", "time [s]", "", curves, (-span, span), points=240)
            )
    named = f"named after {judged.delay:.0f} ms"
    back = "" if math.isnan(judged.returned) else f", back after {judged.returned:.2f} s"
    many = "Figures" if "," in figures else "Figure"
    return Figure(
        f"sensor-{stem}",
        f"{many} {figures}",
        f"The thesis's rule, {stem} failure: {named}{back}. Dashed: healthy reading.",
        picture(panels, f"Sensor failure: {stem}", columns=2),
    )


def configuration_one() -> Section:
    """Equation (2.17): what the damping of configuration 1 is."""
    page = Section("Equation 2.17: damping of configuration 1")
    ratio = 160.0
    whole = float(thesis.model_2b().values["motor_viscous"])
    each = whole / (ratio + 1.0) ** 2
    torsion, spin = each * ratio * (ratio + 1.0), each * (ratio + 1.0)
    seen = run("triangle")
    slip, speed = seen[:, 2] - seen[:, 4], seen[:, 2]
    direct = each * (ratio + 1.0) * ((ratio + 1.0) * seen[:, 2] - ratio * seen[:, 4])
    split = torsion * slip + spin * speed
    usual = whole * speed
    page.add(
        "Where the circular spline is the output (configuration 1), the input's damper sits "
        "between the shaft and the output: T = b (v_in - N v_out). With v_in = (N + 1) v_m, all "
        "referred to the link, the torque on the motor is b N (N + 1) (v_m - v_l) + b (N + 1) v_m: "
        "a damper of the torsion's rate, and viscous friction that is N + 1 times smaller than the "
        "same damper to the housing gives (configuration 2, (2.25)). The output feels the torque "
        "divided by N + 1 only, so the first part is not the structural damping of a transmission, "
        "which acts on both sides alike.",
        Table(
            ("found",),
            (
                Row("damper to the housing, configuration 2 [Nms/rad]", None, (whole,)),
                Row("configuration 1, on v_m - v_l [Nms/rad]", None, (torsion,)),
                Row("configuration 1, on v_m [Nms/rad]", None, (spin,)),
                Row("torque of configuration 2, RMS [Nm]", None, (_rms(usual),)),
                Row("torque of configuration 1, RMS [Nm]", None, (_rms(direct),)),
                Row(
                    "largest difference of (2.17) from its two parts [Nm]",
                    None,
                    (float(np.abs(direct - split).max()),),
                ),
            ),
            "triangle of 25 deg/s, b of table 4.3",
        ),
        "So a joint file for configuration 1 adds `viscous@motor` with the small coefficient. The "
        "first part, a damper of the torsion's rate that acts on the motor alone, is no effect of "
        "the library; `structural_damping`, which acts on both sides, stands nearest to it. The "
        "thesis identifies configuration 2 alone.",
    )
    page.brief.append(
        (
            "equation 2.17",
            f"damping of configuration 1: {spin:.3g} Nms/rad on the motor's velocity and "
            f"{torsion:.3g} Nms/rad on the torsion's rate where configuration 2 has {whole:.3g}",
        )
    )
    return page


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
