"""Places: bins, bands from blocks, branches per direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import welch
from scipy.stats import t as student_t

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.locate import _averaged_periodogram
from identification.diagnosis.places import (
    FEWEST_ROWS,
    Axis,
    Branch,
    Place,
    Rows,
    bin_edges,
    branch,
    gather,
    place,
    places,
    places_of,
    residuals,
    running_time,
    student,
)
from identification.fitting.engine import load_dataset, prepared_model, solve
from workbench.show.pictures import place_picture

FloatArray = npt.NDArray[np.float64]


def made_rows(seed: int = 0, blocks: int = 24, per_block: int = 100) -> Rows:
    """Rows of a joint that swings: velocity, position and time, cut into blocks."""
    rng = np.random.default_rng(seed)
    n = blocks * per_block
    time = np.arange(n) * 0.015
    velocity = np.sin(2 * np.pi * 0.31 * time) + 0.4 * np.sin(2 * np.pi * 0.11 * time + 1)
    position = np.cumsum(velocity) * 0.015 + 0.1 * rng.standard_normal(n)
    every = np.ones(n, dtype=np.bool_)
    axes = {
        "motor_velocity": Axis("motor_velocity", "velocity", "rad/s", velocity, every),
        "link_position": Axis("link_position", "link position", "rad", position, every),
        "time": Axis("time", "time", "s", time, every),
    }
    return Rows(axes, np.repeat(np.arange(blocks), per_block), velocity > 0, "N.m")


@pytest.mark.parametrize("freedom", [3, 4, 6, 10, 30, 1000])
def test_student_quantile_agrees_with_scipy(freedom: int) -> None:
    assert student(np.array([float(freedom)]))[0] == pytest.approx(
        student_t.ppf(0.975, freedom), rel=0.01
    )


def test_bins_hold_enough_rows_and_split_at_zero() -> None:
    values = made_rows().axes["motor_velocity"].values
    edges = bin_edges(values, through_zero=True)
    assert np.all(np.diff(edges) > 0)
    assert 0.0 in edges
    assert edges[0] <= values.min()
    assert edges[-1] >= values.max()
    assert np.histogram(values, edges)[0].min() >= FEWEST_ROWS // 2
    inner = np.diff(edges)[np.abs((edges[1:] + edges[:-1]) / 2) < 0.1]
    assert inner.max() < np.diff(edges).max() / 3, "bins are finer near zero velocity"


def test_bins_of_a_constant_signal() -> None:
    edges = bin_edges(np.full(50, 3.0))
    assert len(edges) == 2
    assert edges[1] > edges[0]


def test_mean_of_every_bin_is_the_mean_of_its_rows() -> None:
    rows = made_rows()
    values = rows.axes["link_position"].values
    residual = np.cos(values)
    b = branch("both", residual, values, rows.block, np.array([-10.0, 0.0, 10.0]))
    assert b.mean == pytest.approx([residual[values < 0].mean(), residual[values >= 0].mean()])
    assert b.rows.sum() == len(values)


def test_rows_across_blocks_do_not_count() -> None:
    values = np.linspace(0, 1, 100)
    block = np.where(values > 0.5, -1, np.arange(100) // 10)
    b = branch("both", np.where(values > 0.5, 1e6, 1.0), values, block, np.array([0.0, 1.0]))
    assert b.mean == pytest.approx([1.0])


def test_band_covers_the_truth_in_95_percent_of_cases() -> None:
    """Noise that is constant within a block: rows are far from independent, blocks are."""
    rows = made_rows()
    values = rows.axes["motor_velocity"].values
    edges = np.array([-2.0, 0.0, 2.0])
    rng = np.random.default_rng(3)
    hits, draws = 0, 600
    for _ in range(draws):
        noise = rng.standard_normal(rows.block.max() + 1)[rows.block]
        b = branch("both", noise, values, rows.block, edges)
        hits += int(np.sum((b.low <= 0) & (b.high >= 0)))
    assert 0.92 < hits / (2 * draws) < 0.98


def test_one_block_gives_no_band() -> None:
    values = np.linspace(0, 1, 50)
    b = branch("both", values, values, np.zeros(50, dtype=np.int64), np.array([0.0, 0.5, 1.0]))
    assert np.isnan(b.low).all()
    assert np.isfinite(b.mean).all()


def test_the_axis_on_which_the_residual_depends_comes_first() -> None:
    rows = made_rows()
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(rows.block))
    found = places_of(
        {"motor": np.tanh(rows.axes["motor_velocity"].values / 0.05) + noise, "link": noise}, rows
    )
    assert (found[0].balance, found[0].axis) == ("motor", "motor_velocity")
    assert found[0].share_percent > 95
    assert found[0].strength > 10
    quiet = [p for p in found if p.balance == "link"]
    assert max(p.share_percent for p in quiet) < 2


def test_a_residual_that_changes_sign_with_direction_gets_two_branches() -> None:
    rows = made_rows()
    position = rows.axes["link_position"].values
    residual = np.where(rows.forward, 1.0, -1.0) * np.cos(4 * position)
    p = place(rows, residual, "link", "link_position")
    assert [b.direction for b in p.branches] == ["forward", "backward"]
    plain = place(rows, np.cos(4 * position), "link", "link_position")
    assert [b.direction for b in plain.branches] == ["both"]


def test_after_takes_the_bins_and_branches_of_before() -> None:
    rows = made_rows()
    residual = np.where(rows.forward, 1.0, -1.0) * np.cos(4 * rows.axes["link_position"].values)
    before = place(rows, residual, "link", "link_position")
    after = place(rows, 0.01 * residual, "link", "link_position", like=before)
    assert np.array_equal(before.edges, after.edges)
    assert len(after.branches) == 2
    assert np.allclose(after.branches[0].mean, 0.01 * before.branches[0].mean)


def test_json_has_no_nan() -> None:
    rows = made_rows(blocks=1)
    data = place(rows, rows.axes["time"].values, "motor", "time").as_json()
    assert data["branches"][0]["low"][0] is None
    assert all(isinstance(v, float) for v in data["branches"][0]["mean"])


def swinging(kind: str, coulomb: float, ratio: float) -> Record:
    time = np.arange(0, 24, 0.002)
    q = 0.9 * np.sin(2 * np.pi * 0.23 * time) + 0.3 * np.sin(2 * np.pi * 0.71 * time + 0.4)
    v = np.gradient(q, time)
    a = np.gradient(v, time)
    rng = np.random.default_rng(5)
    force = 2.0 * a + 1.5 * v + coulomb * np.tanh(v / 0.01) + 0.02 * rng.standard_normal(len(time))
    channels = {"motor_torque": force / ratio, "motor_position": q * ratio}
    return Record.from_channels(time, channels, name="swing", kind=kind)


@pytest.mark.parametrize(("kind", "ratio"), [("rotary", 12.0), ("linear", 1.0)])
def test_axes_and_units_of_a_record(kind: str, ratio: float) -> None:
    record = swinging(kind, 1.0, ratio)
    joint = Joint(kind=kind, gear_ratio=ratio, effects=("viscous",))
    data = load_dataset([record], [], joint, prepared_model(joint, record))
    rows = gather(data)
    assert ("motor_angle" in rows.axes) == (kind == "rotary")
    assert rows.axes["motor_velocity"].unit == ("rad/s" if kind == "rotary" else "m/s")
    assert rows.residual_unit == ("N.m" if kind == "rotary" else "N")
    if kind == "rotary":
        angle = rows.axes["motor_angle"]
        assert angle.values.min() >= 0
        assert angle.values.max() <= 2 * np.pi
        speed = np.abs(rows.axes["motor_velocity"].values[angle.use]).max() * ratio
        assert speed * data.kernel <= 2 * np.pi
    solution = solve(prepared_model(joint, record), data)
    top = places(solution, data)[0]
    assert (top.balance, top.axis) == ("axis", "motor_velocity")
    largest = max(float(np.abs(b.mean).max()) for b in top.branches)
    assert 0.3 < largest < 1.0, "what viscous friction leaves of a Coulomb torque of 1 N m"
    assert np.array_equal(
        residuals(solution, data)["axis"], residuals(solution, data, data.train)["axis"]
    )


def test_time_runs_on_over_records() -> None:
    record = swinging("rotary", 1.0, 50.0)
    again = record.with_channel("motor_torque", 1.01 * record["motor_torque"])
    joint = Joint(gear_ratio=50.0, effects=("viscous",))
    data = load_dataset([record, again], [], joint, prepared_model(joint, record))
    time = running_time(data.train)
    assert np.all(np.diff(time) > 0)
    assert time[-1] == pytest.approx(2 * 24, abs=1.0)


def test_a_band_is_not_drawn_across_a_bin_without_one() -> None:
    x = np.arange(6.0)
    high = np.array([1.0, 1.0, np.nan, 1.0, 1.0, 1.0])
    gap = Branch("both", x, 0 * x, -high, high, np.full(6, 9))
    whole = replace(gap, low=0 * x - 1, high=0 * x + 1)
    place = Place(
        "motor", "motor_velocity", "velocity", "rad/s", "N.m", np.arange(7.0), (gap,), 0.0, 0.0
    )
    assert place_picture(place).count('class="s-before band"') == 2
    assert place_picture(replace(place, branches=(whole,))).count('class="s-before band"') == 1


@pytest.mark.parametrize("seed", range(5))
def test_noise_tells_nothing_and_a_dependence_tells(seed: int) -> None:
    rows = made_rows(seed)
    noise = np.random.default_rng(100 + seed).standard_normal(len(rows.block))
    velocity = rows.axes["motor_velocity"].values
    assert not any(place(rows, noise, "motor", axis).tells for axis in rows.axes)
    assert place(rows, noise + 2 * velocity, "motor", "motor_velocity").tells


@pytest.mark.parametrize("count", [64, 65, 255, 256, 1000, 3001])
def test_the_spectrum_of_what_is_left_is_that_of_welch(count: int) -> None:
    """To one factor, but for the two ends, which a one-sided density counts once."""
    values = np.random.default_rng(count).standard_normal(count).cumsum()
    length = min(256, count)
    _, density = welch(values, nperseg=length - length % 2)
    ratio = _averaged_periodogram(values, length)[1:-1] / density[1:-1]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
