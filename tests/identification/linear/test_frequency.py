"""Frequency responses: measured against known systems, models against the measurement, plots
against what they show.
"""

from __future__ import annotations

import html
import math
import re
from html.parser import HTMLParser

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from casadi_models import JointModel
from casadi_models.thesis import GEAR_RATIO
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.fitting.engine import Dataset
from identification.fitting.fit import Fit, fit
from identification.linear.frequency import PHYSICAL, SUBSPACE, Bode, bode, linear_along
from identification.linear.spectra import ACROSS, THROUGH, Pair, measure
from identification.planning.follow import Follower
from workbench.show.bode import bode_html, bode_picture, frequency_ticks, sentences

FloatArray = npt.NDArray[np.float64]

DT = 2e-3
TRUTH = {
    "motor_inertia": 4.447,
    "link_inertia": 10.277,
    "stiffness": 2.1513e4,
    "structural_damping": 60.0,
    "motor_viscous": 60.0,
    "link_viscous": 9.7,
}
JOINT = Joint(
    name="joint",
    gear_ratio=GEAR_RATIO,
    torque_per_current=1.0,
    model_name="hd3",
    effects=("viscous",),
)


def multisine(seconds: float, seed: int, top: float = 28.0) -> FloatArray:
    """Random-phase sines with falling amplitude: position, velocity, acceleration, (n, 3)."""
    t = np.arange(round(seconds / DT)) * DT
    frequencies = np.arange(0.25, top, 0.25)
    phases = np.random.default_rng(seed).uniform(0, 2 * math.pi, len(frequencies))
    out = np.zeros((len(t), 3))
    for f, p in zip(frequencies, phases, strict=True):
        w = 2 * math.pi * f
        size = 0.05 / (f + 1.0) ** 1.5
        out += size * np.column_stack(
            [np.sin(w * t + p), w * np.cos(w * t + p), -(w**2) * np.sin(w * t + p)]
        )
    return out


@pytest.fixture(scope="module")
def record() -> Record:
    """A linear elastic joint in a control loop, with sensor noise."""
    model = JointModel.harmonic_drive(3, gear_ratio=GEAR_RATIO).add("viscous").with_values(TRUTH)
    reference = multisine(40.0, 1)
    run = Follower(model, DT).run(reference)
    noise = np.random.default_rng(2).standard_normal((3, len(run.time)))
    channels = {
        "motor_current": run.drive,
        "motor_position": GEAR_RATIO * (run.states[:, 0] + 5e-6 * noise[0]),
        "link_position": run.states[:, 2] + 2e-5 * noise[1],
        "link_torque": run.torque + 0.05 * noise[2],
        "reference_position": reference[:, 0],
    }
    return Record.from_channels(run.time, channels, name="sim <b>")


@pytest.fixture(scope="module")
def fitted(record: Record) -> Fit:
    return fit(JOINT, record)


@pytest.fixture(scope="module")
def shown(fitted: Fit) -> Bode:
    found = bode(fitted)
    assert found is not None
    return found


# --- measured -------------------------------------------------------------------------------------


def plant(frequency: FloatArray, dt: float) -> npt.NDArray[np.complex128]:
    z = np.exp(2j * math.pi * frequency * dt)
    return np.asarray(0.1 / (z - 0.9))


def loop(samples: int, dt: float, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """y = 0.1 / (z - 0.9) u + noise, u = 5 (r - y): reference, input, output. The reference has
    no power above 5 Hz.
    """
    rng = np.random.default_rng(seed)
    slow = 1 - math.exp(-2 * math.pi * 1.5 * dt)
    r = rng.standard_normal(samples)
    for _ in range(4):
        r = np.asarray(lfilter([slow], [1, slow - 1], r))
    r /= r.std()
    noise = 0.05 * rng.standard_normal(samples)
    u, y = np.zeros(samples), np.zeros(samples)
    x = 0.0
    for k in range(samples):
        y[k] = x + noise[k]
        u[k] = 5.0 * (r[k] - y[k])
        x = 0.9 * x + 0.1 * u[k]
    return r, u, y


def test_the_instrument_measures_the_plant_and_not_the_controller() -> None:
    dt = 0.01
    r, u, y = loop(30_000, dt, 3)
    found = measure([Pair(u, y, r, dt, 0)], "u to y", "1")
    assert found is not None
    assert found.instrument
    good = found.trusted
    error = np.abs(found.response[good] / plant(found.frequency[good], dt) - 1)
    assert np.all(error < 5 * found.deviation[good] + 0.02)
    # without it the high frequencies show -1/C = -0.2, and with high coherence
    naive = measure([Pair(u, y, None, dt, 0)], "u to y", "1")
    assert naive is not None
    high = naive.frequency > 20.0
    assert np.median(np.abs(naive.response[high] + 0.2)) < 0.05
    assert np.median(naive.coherence[high]) > 0.8
    assert not found.trusted[found.frequency > 20.0].any()


def test_coherence_is_the_share_of_the_output_that_the_input_explains() -> None:
    rng = np.random.default_rng(4)
    u = rng.standard_normal(60_000)
    found = measure([Pair(u, u + 0.5 * rng.standard_normal(len(u)), None, 0.01, 0)], "u to y", "1")
    assert found is not None
    wide = found.frequency > 2.0
    assert found.coherence[wide] == pytest.approx(1 / 1.25, abs=0.05)
    assert found.coherence[wide].mean() == pytest.approx(1 / 1.25, abs=0.01)
    assert np.abs(found.response[wide] - 1).max() < 5 * found.deviation[wide].max()
    scatter = np.abs(found.response[wide] - 1) / found.deviation[wide]
    assert (
        0.7 < math.sqrt(float(np.mean(scatter**2)) / 2) < 1.4
    )  # real and imaginary part each have that deviation


def test_records_too_short_or_too_poor_have_no_response() -> None:
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((2, 4000))
    assert measure([Pair(noise[0, :100], noise[0, :100], None, 0.01, 0)], "u to y", "1") is None
    assert measure([Pair(noise[0], noise[1], None, 0.01, 0)], "u to y", "1") is None


def test_several_stretches_count_as_one_measurement() -> None:
    rng = np.random.default_rng(6)
    u = rng.standard_normal(30_000)
    y = lfilter([0.0, 0.1], [1.0, -0.9], u)
    parts = [Pair(u[k : k + 10_000], y[k : k + 10_000], None, 0.01, 0) for k in (0, 10_000, 20_000)]
    found = measure([*parts, Pair(u[:50], y[:50], None, 0.01, 0)], "u to y", "1")
    assert found is not None
    assert np.abs(found.response / plant(found.frequency, 0.01) - 1).max() < 0.05


# --- physical model -------------------------------------------------------------------------------


def test_a_linear_joint_has_the_same_linear_form_everywhere(fitted: Fit) -> None:
    along, at_rest = linear_along(fitted.model, fitted.data), fitted.model.linearize()
    assert np.asarray(along.A) == pytest.approx(np.asarray(at_rest.A), rel=1e-9, abs=1e-9)
    assert np.asarray(along.B) == pytest.approx(np.asarray(at_rest.B), rel=1e-12)
    assert list(along.state_labels) == list(at_rest.state_labels)


def sine_fit(*effects: str) -> tuple[Fit, float]:
    """An axis with Coulomb friction under a sinusoid, and the amplitude of its velocity."""
    t = np.arange(0, 20, DT)
    w = 2 * math.pi * 0.5
    speed = 0.8 * w
    v, a = speed * np.cos(w * t), -speed * w * np.sin(w * t)
    torque = (
        2.0 * a
        + 1.5 * v
        + 3.0 * np.sign(v)
        + 0.01 * np.random.default_rng(7).standard_normal(len(t))
    )
    return fit(
        Joint(name="axis", effects=effects),
        Record.from_channels(t, {"motor_torque": torque, "motor_position": 0.8 * np.sin(w * t)}),
    ), speed


def test_coulomb_friction_becomes_its_describing_function() -> None:
    """4 C / (pi V) for a sinusoidal velocity; a linearisation at rest gives C over the
    smoothing velocity.
    """
    fitted, speed = sine_fit("viscous", "coulomb")
    values = fitted.solution.values
    along = np.asarray(linear_along(fitted.model, fitted.data).A)
    expected = (
        -(values["motor_viscous"] + 4 * values["motor_coulomb"] / (math.pi * speed))
        / values["inertia"]
    )
    assert along[1, 1] == pytest.approx(expected, rel=0.02)
    assert np.asarray(fitted.model.linearize().A)[1, 1] < 3 * expected


def test_effects_with_internal_states_are_left_out_with_a_reason(fitted: Fit) -> None:
    from identification.linear.frequency import bode_of

    found = bode_of(fitted.model.add("hysteresis"), fitted.data, fitted.records)
    assert found is not None
    assert all(c.name == SUBSPACE for r in found.responses for c in r.curves)
    assert any("internal states" in n for n in found.notes)


# --- over each other ------------------------------------------------------------------------------


def test_three_ways_agree_on_the_transmission(shown: Bode) -> None:
    across = next(r for r in shown.responses if r.title == ACROSS)
    assert {c.name for c in across.curves} == {SUBSPACE, PHYSICAL}
    locked = math.sqrt(TRUTH["stiffness"] / TRUTH["link_inertia"]) / (2 * math.pi)
    damping = (TRUTH["structural_damping"] + TRUTH["link_viscous"]) / (
        2 * math.sqrt(TRUTH["stiffness"] * TRUTH["link_inertia"])
    )
    for curve in across.curves:
        assert curve.gap_db < 0.1
        assert curve.gap_degrees < 1.0
        assert curve.resonances[0].frequency == pytest.approx(locked, rel=0.02)
        assert curve.resonances[0].damping == pytest.approx(damping, rel=0.15)


def test_three_ways_agree_on_the_whole_joint(shown: Bode) -> None:
    through = next(r for r in shown.responses if r.title == THROUGH)
    assert through.instrument
    assert through.unit == "rad/s per N.m"
    physical = next(c for c in through.curves if c.name == PHYSICAL)
    assert physical.gap_db < 0.3
    assert physical.gap_degrees < 3.0
    free = math.sqrt(
        TRUTH["stiffness"] * (1 / TRUTH["link_inertia"] + 1 / TRUTH["motor_inertia"])
    ) / (2 * math.pi)
    assert any(r.frequency == pytest.approx(free, rel=0.05) for r in physical.resonances)


def test_a_wrong_stiffness_is_seen(fitted: Fit) -> None:
    from identification.linear.frequency import bode_of

    found = bode_of(
        fitted.model.with_values({"stiffness": 0.7 * TRUTH["stiffness"]}),
        fitted.data,
        fitted.records,
    )
    assert found is not None
    physical = next(c for c in found.responses[0].curves if c.name == PHYSICAL)
    subspace = next(c for c in found.responses[0].curves if c.name == SUBSPACE)
    assert physical.gap_db > 10 * subspace.gap_db
    assert physical.gap_db > 0.5


def test_without_a_reference_the_drive_is_left_out_and_the_note_says_why(
    fitted: Fit, record: Record
) -> None:
    found = bode(fitted, record.without("reference_position"))
    assert found is not None
    assert [r.title for r in found.responses] == [ACROSS]
    assert any("reference_position" in n for n in found.notes)


def test_one_sided_records_without_a_reference_have_no_plot() -> None:
    assert bode(sine_fit("viscous")[0]) is None


# --- picture --------------------------------------------------------------------------------------


class _Balance(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_fragment_is_balanced_named_and_has_the_values(shown: Bode) -> None:
    page = bode_html(shown)
    assert page == shown._repr_html_()
    parser = _Balance()
    parser.feed(page)
    assert parser.open == []
    assert page.count('role="img"') == page.count("aria-label=") == len(shown.responses)
    assert "style=" not in page
    assert page.count("<table") == len(shown.responses)
    assert "nan" not in page.lower()
    labels = [html.unescape(x) for x in re.findall(r'aria-label="([^"]*)"', page)]
    assert all("from the measurement" in x and "resonates at" in x for x in labels)
    assert "0 dB is 1 rad/s per N·m" in page


def test_the_three_are_told_apart_without_colour(shown: Bode) -> None:
    picture = bode_picture(shown.responses[0])
    assert picture.count("<circle") >= 16  # dots of the measurement, in magnitude and phase
    dashed = [p for p in re.findall(r"<path[^>]*>", picture) if 'class="s-before"' in p]
    full = [p for p in re.findall(r"<path[^>]*>", picture) if 'class="s-after"' in p]
    assert len(dashed) == len(full) == 2
    assert all("stroke-dasharray" in p for p in dashed)
    assert not any("stroke-dasharray" in p for p in full)


def test_everything_drawn_lies_inside_the_picture(shown: Bode) -> None:
    for one in shown.responses:
        picture = bode_picture(one)
        points = [tuple(map(float, p)) for p in re.findall(r"[ML](\d+\.\d) (-?\d+\.\d)", picture)]
        assert points
        assert all(0 <= x <= 360 and 0 <= y <= 376 for x, y in points)


@pytest.mark.parametrize(
    ("low", "high", "expected"), [(0.3, 18.0, [0.5, 1, 2, 5, 10]), (0.1, 100.0, [0.1, 1, 10, 100])]
)
def test_frequency_ticks(low: float, high: float, expected: list[float]) -> None:
    assert frequency_ticks(low, high) == pytest.approx(expected)


def test_a_response_without_models_is_drawn_too(fitted: Fit, record: Record) -> None:
    u = np.random.default_rng(8).standard_normal(20_000)
    found = measure([Pair(u, u, None, 0.01, 0)], "u to y", "1")
    assert found is not None
    assert sentences(found) == []
    assert "<svg" in bode_picture(found)


def test_data_of_a_fit_is_what_linear_along_takes(fitted: Fit) -> None:
    assert isinstance(fitted.data, Dataset)
    with pytest.raises(ValueError, match="internal states"):
        linear_along(fitted.model.add("hysteresis"), fitted.data)


def test_the_report_has_the_section_where_there_is_something_to_show(shown: Bode) -> None:
    from workbench.show.fragments import frequency_html
    from workbench.show.plots import ReportPlots

    assert "<svg" in frequency_html(ReportPlots((), (), (), True, None, shown))
    assert frequency_html(ReportPlots((), (), (), True)) == ""


def test_records_with_another_payload_are_left_out(fitted: Fit, record: Record) -> None:
    from dataclasses import replace

    found = bode(fitted, [record, replace(record, payload="5 kg")])
    alone = bode(fitted, record)
    assert found is not None
    assert alone is not None
    assert found.responses[0].windows == alone.responses[0].windows
    assert any("payload" in n for n in found.notes)
