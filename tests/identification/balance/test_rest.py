"""Rows at rest take no part in anything: dry friction at a standstill is an inequality, not an
equation.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import Record, compare, fit, improve, load_joint, read
from identification.balance.dataset import weak_record
from identification.balance.excitation import excitation_warnings
from identification.balance.rest import rest_check, rest_warnings
from identification.balance.sensing import sense
from identification.balance.weak import HELD_READINGS, REST_SHARE, prepare
from identification.data.joint_file import Joint
from identification.errors import InputError
from tests.hidden_effect.generator import QUANTUM, generate_case

DT = 0.002


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("gcc") is None:
        pytest.skip("the generator's C integrator needs gcc")
    return generate_case("stribeck", 9200, folder=tmp_path_factory.mktemp("rests"), rests=0.4)


def standing(record: Record) -> np.ndarray:
    """Samples inside a standstill: the link stays within two steps of its encoder for 0.3 s
    around them.
    """
    position = record["link_position"]
    width = round(0.15 / DT)
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(position, width, mode="edge"), 2 * width + 1
    )
    return np.ptp(around, axis=1) < 2.5 * QUANTUM["link_position_rad"]


def test_what_a_standing_joint_reads_changes_nothing(folder: Path) -> None:
    """Sticking friction may hold any torque: the current of a standstill must not reach fit,
    error, verdict or picture.
    """
    joint = load_joint(folder / "joint.toml")
    train, held = read(folder / "train.csv"), read(folder / "test2.csv")
    first = fit(joint, [train], held_out=[held])

    def disturbed(record: Record) -> Record:
        still = standing(record)
        assert 0.2 < still.mean() < 0.6
        size = 0.3 * float(np.std(record["motor_current"]))
        return record.with_channel("motor_current", record["motor_current"] + size * still)

    second = fit(joint, [disturbed(train)], held_out=[disturbed(held)])
    for name, value in first.solution.values.items():
        assert second.solution.values[name] == pytest.approx(value, rel=1e-3, abs=1e-9), name
    assert first.held_out is not None and second.held_out is not None
    assert second.held_out.relative_error_percent == pytest.approx(
        first.held_out.relative_error_percent, rel=1e-3
    )
    one, other = compare(first, held, linear=False), compare(first, disturbed(held), linear=False)
    assert other.error.balances["motor"].ratio == pytest.approx(
        one.error.balances["motor"].ratio, rel=1e-3
    )
    assert [p.share_percent for p in other.places] == pytest.approx(
        [p.share_percent for p in one.places], rel=0.02, abs=0.05
    )
    assert "% of the rows are at rest and left out" in str(one)
    assert 0.3 < one.at_rest < 0.6
    assert any("at rest" in w for w in excitation_warnings(first.data))


def test_reversals_stay_and_the_transmission_keeps_what_noise_averages(folder: Path) -> None:
    """Encoders that stand on a step have one reading of the twist for all rows of a rest; those
    that toggle by their noise have as many as rows.
    """
    joint, record = load_joint(folder / "joint.toml"), read(folder / "train.csv")
    w = fit(joint, [record]).data.train[0]
    both = np.minimum(w.rest["motor"], w.rest["link"]) > 0.5
    assert both.mean() > 0.25 and not w.taking("transmission")[both].any()
    assert w.taking("transmission").mean() > 0.4
    rng = np.random.default_rng(1)
    toggling = record
    for channel in ("motor_position", "link_position"):
        step = QUANTUM[f"{channel}_rad"]
        noise = np.rint(rng.standard_normal(len(record))) * step
        toggling = toggling.with_channel(channel, toggling[channel] + noise)
    assert fit(joint, [toggling]).data.train[0].taking("transmission").all()
    assert 0.3 < w.resting("motor").mean() < 0.6
    edges = np.flatnonzero(np.diff(w.resting("motor").astype(int)))
    assert len(edges) < 40, "stretches at rest, not scattered rows"


def test_a_moving_record_has_no_row_at_rest() -> None:
    """Sine, triangle: reversals are shorter than a kernel of the speed."""
    t = np.arange(6000) * DT
    rng = np.random.default_rng(3)
    for position in (np.sin(2 * t), 2 / np.pi * np.arcsin(np.sin(2 * t))):
        noisy = position + 1e-5 * rng.standard_normal(len(t))
        record = Record.from_channels(t, {"motor_position": noisy, "motor_torque": np.cos(2 * t)})
        joint = Joint("one", 1.0, model_name="hd1")
        w = weak_record(record, joint, sense(record, joint.model()), 0.06)
        assert w.taking("axis").all()


def test_a_mask_is_the_union_of_its_sides() -> None:
    t = np.arange(2000) * DT
    signals = {
        "motor_position": np.sin(t),
        "link_position": np.sin(t),
        "torque": np.sin(t),
        "drive": np.sin(t),
    }
    w = prepare(t, signals, (slice(0, 2000),))
    half = np.arange(w.rows) < w.rows // 2
    w = replace(w, rest={"motor": 2 * REST_SHARE * half, "link": 2 * REST_SHARE * ~half})
    assert np.array_equal(w.taking("motor"), ~half)
    assert np.array_equal(w.taking("link"), half)
    assert not w.taking("sum").any()
    assert w.taking("transmission").all()
    on_steps = replace(w, rest={**w.rest, HELD_READINGS: 2 * REST_SHARE * half})
    assert np.array_equal(on_steps.taking("transmission"), ~half)
    assert not replace(w, masked=frozenset({"transmission"})).taking("transmission").any()


def test_rest_rows_check_the_model_as_an_inequality(tmp_path: Path) -> None:
    """Nothing hidden: sticking friction holds what is left at rest.

    A torque that a rest must carry and the model has not: it does not.
    """
    if shutil.which("gcc") is None:
        pytest.skip("the generator's C integrator needs gcc")
    held = {}
    for effect in (None, "added_spring"):
        folder = generate_case(effect, 9100, folder=tmp_path / str(effect), rests=0.4)
        fitted = fit(
            load_joint(folder / "joint.toml"),
            [read(folder / "train.csv"), read(folder / "train2.csv")],
        )
        held[effect] = rest_check(
            fitted.model, fitted.data, fitted.data.train, fitted.solution.values
        )
    assert all(c.rows > 500 and c.holds for c in held[None].values())
    assert "transmission" not in held[None]
    assert not held["added_spring"]["motor"].holds
    assert len(rest_warnings(held["added_spring"], "N.m")) == 1
    assert rest_warnings(held[None], "N.m") == ()


@pytest.mark.parametrize("of", ["training", "held-out"])
def test_a_motion_of_a_moment_is_no_record(of: str) -> None:
    """A handful of rows carries no fit and no verdict: one line says for how long to move."""
    rng, t = np.random.default_rng(3), np.arange(0.0, 6.0, DT)

    def arm(name: str, seconds: float) -> Record:
        angle = np.clip(2 * np.pi * (t - 2.0) / 0.6, 0.0, 2 * np.pi * seconds / 0.6)
        position = 0.5 * np.sin(angle)
        noise = rng.standard_normal((2, len(t)))
        bend = np.gradient(np.gradient(position, t), t)
        channels = {
            "link_position": position + 1e-5 * noise[0],
            "link_torque": 3.0 * bend + 0.1 * noise[1],
        }
        return Record.from_channels(t, channels, name=name)

    joint = Joint(model_name="hd1", effects=("viscous@link",))
    short, long = arm("short", 0.3), arm("long", 3.0)
    train, held = (short, long) if of == "training" else (long, short)
    with pytest.raises(InputError) as said:
        improve([train], joint, [held])
    assert str(said.value) == (
        f"short: the joint stands still in every {of} record, but for a moment; give one in which "
        "it moves for at least 0.6 s"
    )
