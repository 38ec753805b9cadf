"""Late stamps, lost samples, several runs in one file: the answer gets worse steadily, never by
jumps.
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from identification import Joint, Record, fit, load_joint, read
from identification.balance.calibration import is_of_run
from identification.balance.stamps import bridge_errors, bridged, evened, longest_hole, slots_of
from identification.data.check.checks import check, gate, repair
from identification.diagnosis.places import running_time
from tests.hidden_effect.generator import generate_case
from tests.stamps_bench import DAMAGES, lost, queued
from workbench.cli.main import main

DT = 2e-3
N = 6000


def motion(t: np.ndarray) -> np.ndarray:
    return np.sin(2 * t) + 0.3 * np.sin(7 * t + 1)


def even_record(seed: int = 0) -> Record:
    t = DT * np.arange(N)
    noise = 1e-5 * np.random.default_rng(seed).standard_normal((2, N))
    return Record.from_channels(
        t,
        {"motor_position": motion(t) + noise[0], "motor_torque": np.cos(2 * t) + noise[1]},
        name="even",
    )


@pytest.mark.parametrize("damage", [d for d in DAMAGES if d != "none"])
def test_every_sample_finds_its_slot(damage: str) -> None:
    """Whatever happened to stamps and frames, what was measured is kept as it was, in its place
    on the logger's clock.
    """
    whole = even_record()
    again = evened(DAMAGES[damage](whole, 5))
    assert len(again) == pytest.approx(N, abs=2)
    assert len(again.segments()) == 1
    assert again.dt == pytest.approx(DT, rel=1e-4)
    measured = np.ones(len(again), dtype=bool) if again.measured is None else again.measured
    places = np.round((again.time - again.time[0]) / DT).astype(int)
    known = {v: i for i, v in enumerate(whole["motor_position"])}
    rows = np.array([known[v] for v in again["motor_position"][measured]])
    shift = int(np.median(rows - places[measured]))
    assert np.mean(rows - places[measured] == shift) > 0.999
    np.testing.assert_allclose(again["motor_position"], motion(DT * (places + shift)), atol=2e-4)


def test_samples_taken_unevenly_are_read_between_their_stamps() -> None:
    rng = np.random.default_rng(1)
    t = DT * (np.arange(N) + rng.uniform(-0.3, 0.3, N))
    slots = slots_of(Record.from_channels(t, {"motor_position": motion(t)}))
    assert slots is not None
    assert not slots.in_slots
    again = evened(Record.from_channels(t, {"motor_position": motion(t)}))
    np.testing.assert_allclose(again["motor_position"], motion(again.time), atol=1e-7)


def test_short_holes_are_bridged_and_long_ones_cut() -> None:
    most = longest_hole(DT)
    assert most * DT == pytest.approx(0.03, abs=DT)
    for missing, pieces in ((most, 1), (most + 1, 2)):
        keep = np.ones(N, dtype=bool)
        keep[3000 : 3000 + missing] = False
        whole = even_record()
        rows = np.flatnonzero(keep)
        again = evened(
            Record.from_channels(whole.time[rows], {c: v[rows] for c, v in whole.channels.items()})
        )
        assert len(again.segments()) == pieces
        if pieces == 1:
            assert again.measured is not None
            assert np.flatnonzero(~again.measured).tolist() == list(range(3000, 3000 + missing))
            bridge = again["motor_position"][~again.measured] - motion(again.time[~again.measured])
            assert np.abs(bridge).max() < 2e-4


def test_flags_of_bridged_samples_go_where_the_samples_go() -> None:
    again = evened(lost(0.1)(even_record(), 2))
    assert again.measured is not None
    part = again.take(slice(100, 900))
    assert part.measured is not None
    np.testing.assert_array_equal(part.measured, again.measured[100:900])
    first, second = again.split(0.7)
    assert first.measured is not None and second.measured is not None
    assert len(first.measured) + len(second.measured) == len(again)
    assert evened(again) is again


@pytest.fixture(scope="module")
def joint_and_records(tmp_path_factory: pytest.TempPathFactory) -> tuple[Joint, list[Record]]:
    if shutil.which("gcc") is None:
        pytest.skip("the generator's C integrator needs gcc")
    folder = generate_case(None, 9310, folder=tmp_path_factory.mktemp("stamps"))
    return load_joint(folder / "joint.toml"), [
        read(folder / f"{n}.csv") for n in ("train", "train2")
    ]


def test_the_fit_gets_worse_steadily_with_the_share_lost(
    joint_and_records: tuple[Joint, list[Record]],
) -> None:
    joint, records = joint_and_records

    def answer(share: float) -> tuple[float, float, list[str]]:
        damaged = [lost(share)(r, 11) if share else r for r in records]
        checked = [
            gate(r, joint.gear_ratio, torque_per_current=joint.torque_per_current) for r in damaged
        ]
        fitted = fit(joint, [r for r, _ in checked])
        codes = [f.code for _, found in checked for f in found if f.severity in ("warn", "refuse")]
        return fitted.solution.values["link_inertia"], fitted.train.balances["link"].ratio, codes

    whole, ratio, codes = answer(0.0)
    for share, worst in ((0.01, 1e-4), (0.05, 3e-4), (0.2, 1.5e-3)):
        found, now, said = answer(share)
        assert abs(found / whole - 1) < worst, share
        assert 0.95 * ratio < now < 1.1 * ratio, (
            "bridged rows must not pass for structure, nor be finer than noise"
        )
        assert said == codes, "no false lag, no refusal"


def test_a_queue_of_stamps_is_one_record_and_not_thousands(
    joint_and_records: tuple[Joint, list[Record]],
) -> None:
    joint, records = joint_and_records
    damaged = queued(0.3)(records[0], 3)
    findings = check(damaged, joint.gear_ratio)
    assert [f.code for f in findings if f.severity == "repair"] in (
        ["jitter"],
        ["time_repeated", "jitter"],
        ["jitter", "time_repeated"],
    )
    assert len(repair(damaged).segments()) == 1


def test_runs_in_one_file_are_cut_where_time_starts_again() -> None:
    t = np.tile(DT * np.arange(2000), 3)
    record = Record.from_channels(t, {"motor_position": motion(t)})
    assert record.segments() == [slice(0, 2000), slice(2000, 4000), slice(4000, 6000)]
    assert not [f for f in check(record) if f.code == "time_decreases"]
    back = t.copy()
    back[1500:2000] -= 0.5
    assert [
        f
        for f in check(Record.from_channels(back, {"motor_position": motion(t)}))
        if f.code == "time_decreases"
    ]


def test_resample_writes_an_even_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = even_record()
    damaged = lost(0.05)(whole, 4)
    source, target = tmp_path / "log.npz", tmp_path / "even.csv"
    np.savez(
        source,
        time_s=damaged.time,
        motor_position_rad=damaged["motor_position"],
        motor_torque_Nm=damaged["motor_torque"],
    )
    assert main(["resample", str(source), "-o", str(target)]) == 0
    assert "bridged" in capsys.readouterr().out
    again = read(target)
    assert slots_of(again) is None
    np.testing.assert_allclose(again["motor_position"], whole["motor_position"], atol=1e-3)
    assert main(["resample", str(source), "-o", str(tmp_path / "even.txt")]) == 2


def test_runs_are_laid_end_to_end_and_no_curve_joins_them(
    joint_and_records: tuple[Joint, list[Record]],
) -> None:
    """Two runs in one file, each from zero: no row, block or curve reaches from one into the
    other.
    """
    joint, records = joint_and_records
    parts = [r.take(slice(0, 5000)) for r in records]
    both = Record.from_channels(
        np.concatenate([p.time for p in parts]),
        {c: np.concatenate([p[c] for p in parts]) for c in parts[0].channels},
        name="both",
    )
    assert len(both.segments()) == 2
    joined, apart = fit(joint, [both]), fit(joint, parts)
    for name, value in apart.solution.values.items():
        if is_of_run(name) or name in apart.model.calibration:
            continue  # a file has its own
        # the noise level of a file is one, and so are its clocks
        error = (apart.solution.stderr[name] or 0.0) / 10
        assert joined.solution.values[name] == pytest.approx(value, rel=0.01, abs=error), name
    # a file has one set of calibration unknowns; both parts were logged with the same sensors
    for unknown in apart.model.calibration:
        found = [n for n in apart.solution.values if n.startswith(f"{unknown}[")]
        one = [n for n in joined.solution.values if n.startswith(f"{unknown}[")]
        assert len(found) == len(parts)
        assert len(one) == 1
        errors = [apart.solution.stderr[n] for n in found] + [joined.solution.stderr[one[0]]]
        spread = math.hypot(*(e for e in errors if e is not None))
        for n in found:
            off = joined.solution.values[one[0]] - apart.solution.values[n]
            assert abs(off) < 3 * spread
    w = joined.data.train[0]
    assert sorted(w.block[w.stretch == 0].tolist())[-1] < min(
        b for b in w.block[w.stretch == 1].tolist() if b >= 0
    )
    time = running_time([w])
    assert (np.diff(time) > 0).all()
    assert np.flatnonzero(w.begins).tolist() == [int(np.argmax(w.stretch == 1))]


@pytest.mark.parametrize("seed", range(4))
def test_what_a_bridge_is_off_by_is_known_where_it_is_more_than_noise(seed: int) -> None:
    """A motion with corners, a fifth of its samples lost: the stated deviation is the size of the
    error; of a smooth motion hardly any bridge is off.
    """
    rng = np.random.default_rng(seed)
    n, dt, level = 6000, 5e-3, 2e-5
    t = np.arange(n) * dt
    corners = np.abs((t / 0.31) % 2 - 1)
    corners = np.convolve(corners, np.hanning(9) / np.hanning(9).sum(), "same")
    there = rng.random(n) > 0.2
    there[[0, -1]] = True
    for motion, sharp in ((corners, True), (np.sin(2 * np.pi * 0.4 * t), False)):
        noise = level * rng.standard_normal(n)
        own = np.flatnonzero(there)
        where = np.where(there, np.cumsum(there) - 1, -1)
        filled = bridged(t[own], (motion + noise)[own, None], t, where)[:, 0]
        off = np.where(there, 0.0, filled - motion)
        told = bridge_errors(filled, there, (slice(20, n - 20),), level)
        inside = slice(20, n - 20)
        assert np.all(told[there] == 0)
        if sharp:
            size = np.sqrt(np.mean(off[inside] ** 2) / np.mean(told[inside] ** 2))
            assert 0.6 < size < 1.5
        else:
            assert np.mean(told[~there] > 0) < 0.03
