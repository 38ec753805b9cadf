"""Long records on the page: the answer to an upload, the windows of the clicks, states of
memory laws kept, progress.
"""

from __future__ import annotations

import gc
import hashlib
import json
import socket
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette")

from identification.balance import memory as _memory_kept
from identification.balance.balances import Memory, balances_of
from identification.balance.dataset import load_dataset, prepared_model
from identification.balance.memory import states_of
from identification.data.joint_file import parse_joint
from identification.data.read import read
from identification.data.record import Record
from identification.diagnosis.claims import rank
from identification.diagnosis.trials import make_base
from identification.errors import InputError
from identification.fitting.engine import solve
from workbench.page import analysis as app_analysis
from workbench.page import views as app_views
from workbench.page.analysis import Analysis
from workbench.page.demo import demo_files
from workbench.page.jobs.doing import ACTIONS
from workbench.page.live import Live
from workbench.page.pattern import pattern
from workbench.page.report import improvement_of, records_of
from workbench.page.server import _listen
from workbench.page.session import Store

JOINT = parse_joint(tomllib.loads(demo_files()["joint.toml"].decode()), "joint.toml")


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Record]:
    """The demo's records."""
    folder = tmp_path_factory.mktemp("demo")
    for name, content in demo_files().items():
        (folder / name).write_bytes(content)
    return {path.stem: read(path) for path in sorted(folder.glob("*.npz"))}


@pytest.fixture(scope="module")
def pair(records: dict[str, Record]) -> tuple[Record, Record]:
    train = next(r for name, r in records.items() if "train" in name)
    return train, next(r for name, r in records.items() if "train" not in name)


# ---- reading and sending


@pytest.mark.parametrize("beside", [0, 1 << 40])
def test_the_digest_is_that_of_the_file(
    tmp_path: Path, beside: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules["identification.data.read"], "HASHED_BESIDE", beside)
    path = tmp_path / "a.npz"
    np.savez(path, time_s=np.arange(50) / 10, motor_current_A=np.ones(50))
    assert read(path).provenance.sha256 == (hashlib.sha256(path.read_bytes()).hexdigest(),)
    path.write_bytes(b"PK\x03\x04 not an archive")
    with pytest.raises(InputError, match="not a readable NPZ"):
        read(path)
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "none.npz")


def test_answers_leave_at_once() -> None:
    """asyncio turns Nagle's delay off only on sockets that say they are TCP."""
    listening = _listen(0)
    assert listening.proto == socket.IPPROTO_TCP
    listening.close()


# ---- windows


def test_records_of_few_samples_are_taken_whole(pair: tuple[Record, Record]) -> None:
    train, _ = pair
    slow = Record.from_channels(10 * train.time, dict(train.channels))
    assert slow.duration > 1.5 * 60
    assert app_analysis._share([slow], 60.0)[0] is slow
    many = Record.from_channels(np.arange(200_000) / 1000.0, {"motor_current": np.zeros(200_000)})
    assert len(app_analysis._share([many], 60.0)[0]) < 100_000


@pytest.mark.slow
def test_the_whole_loop_and_the_report_take_the_windows_until_confirmed(
    pair: tuple[Record, Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("QUICK_TRAIN", 8.0), ("QUICK_HELD_OUT", 5.0), ("USUAL_RATE", 1.0)):
        monkeypatch.setattr(app_analysis, name, value)
    analysis = Analysis(JOINT, [pair[0]], [pair[1]])
    assert not analysis.whole
    quick, whole = (sum(map(len, r[0])) for r in (analysis.quick, analysis.split))
    assert quick < 0.8 * whole
    live = Live(Store(tmp_path).create())
    live._analysis = analysis
    said: list[tuple[str, float]] = []
    change = ACTIONS["improve"](live, {}, lambda text, share: said.append((text, share)))
    steps = change(live.state).steps
    assert not any(s.exact for s in steps)
    assert len(steps) > 1
    assert records_of(analysis, steps) is analysis.quick
    shares = [share for _, share in said]
    assert len(said) > 40
    assert shares == sorted(shares)
    result = improvement_of(analysis, steps, lambda text, share: None)
    for step, entry in zip(result.steps, steps, strict=True):
        assert step.held_out.relative_error_percent == entry.held_out["relative_error_percent"]
    exact = analysis.confirm(steps[-1], lambda text, share: None)
    assert exact.exact
    assert records_of(analysis, (*steps[:-1], exact)) == analysis.split


# ---- progress


def test_fit_and_ranking_say_how_far_they_are(pair: tuple[Record, Record]) -> None:
    model = prepared_model(JOINT, pair[0])
    data = load_dataset([pair[0]], [pair[1]], JOINT, model)
    said: list[tuple[str, float]] = []
    solution = solve(model, data, progress=lambda text, share: said.append((text, share)))
    assert [t for t, _ in said] == ["start values", "first pass", "second pass", "standard errors"]
    said.clear()
    with_hook = rank(
        make_base(solution, data), progress=lambda text, share: said.append((text, share))
    )
    assert len(said) >= len(with_hook.everything)
    assert [s for _, s in said] == sorted(s for _, s in said)
    assert said[0][1] == 0.0
    assert said[-1][1] < 1.0
    assert [t.candidate.label for t in with_hook.trials] == [
        t.candidate.label for t in rank(make_base(solution, data)).trials
    ]


# ---- memory laws


class _Thing:
    """Something to hold weakly."""


def test_states_are_made_once_per_record_and_law(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def make(size: int = 10) -> np.ndarray:
        made.append(size)
        return np.full((1, size), float(len(made)))

    one, other = _Thing(), _Thing()
    first = states_of(one, "a", make)
    assert states_of(one, "a", make) is first
    assert not first.flags.writeable
    assert states_of(other, "a", make) is not first
    assert states_of(one, "b", make) is not first
    assert len(made) == 3
    monkeypatch.setattr(_memory_kept, "MOST", 25)
    states_of(other, "b", make)
    kept = _memory_kept.cache_of("states")
    assert sum(s.size for _, s, _ in kept.kept.values()) == kept.size <= 25
    assert len(states_of(one, "long", lambda: make(100))[0]) == 100
    assert not kept.kept
    assert kept.size == 0
    identifier = id(one)
    states_of(one, "a", make)
    del one
    gc.collect()
    assert kept.kept[(identifier, "a")][0]() is None


def test_a_memory_law_is_followed_again_only_where_its_own_values_change(
    pair: tuple[Record, Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = prepared_model(JOINT, pair[0]).add("hysteresis")
    data = load_dataset([pair[0]], [pair[1]], JOINT, model)
    values = {p.name: float(model.values.get(p.name, p.start)) or 1.0 for p in model.parameters}
    followed: list[int] = []
    along = Memory.along
    monkeypatch.setattr(
        Memory, "along", lambda self, *given: (followed.append(1), along(self, *given))[1]
    )
    balances, bare = balances_of(model, data.sensing), balances_of(model, data.sensing, wrt=())
    record = data.train[0]
    first = balances.evaluate(record, values)
    again = bare.evaluate(
        record,
        {**values, "hysteresis_torque_1": 2 * values["hysteresis_torque_1"], "motor_coulomb": 3.0},
    )
    assert len(followed) == 1
    assert not np.allclose(again["transmission"][0], first["transmission"][0])
    wider = bare.evaluate(record, {**values, "hysteresis_width": 1.5 * values["hysteresis_width"]})
    assert len(followed) == 2
    assert not np.allclose(wider["transmission"][0], first["transmission"][0])
    # with columns and without them the rows are summed in another order: the last digit may differ
    np.testing.assert_allclose(
        bare.evaluate(record, values)["transmission"][0], first["transmission"][0], rtol=1e-14
    )
    assert len(followed) == 2


# ---- wording


def test_a_unit_of_the_other_kind_of_axis_says_which_kind(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t_s,q_m\n" + "".join(f"{k},{k}\n" for k in range(5)), encoding="utf-8")
    columns = {
        "time": {"column": "t_s", "unit": "s"},
        "motor_position": {"column": "q_m", "unit": "m"},
    }
    with pytest.raises(InputError, match="for a linear axis give kind = 'linear'"):
        read(path, columns=columns)
    assert read(path, columns=columns, kind="linear")["motor_position"][3] == 3.0
    columns["motor_position"]["unit"] = "kg"
    with pytest.raises(InputError, match="a unit of the kind rad is wanted$"):
        read(path, columns=columns)


@pytest.mark.slow
def test_the_reading_of_the_drive_has_the_name_of_its_channel(pair: tuple[Record, Record]) -> None:
    def named(record: Record) -> Record:
        channels: dict[str, Any] = dict(record.channels)
        channels["motor_torque"] = channels.pop("motor_current") * 0.05
        return Record.from_channels(record.time, channels)

    for made, word in ((pair, "motor current"), (tuple(map(named, pair)), "motor torque")):
        analysis = Analysis(JOINT, [made[0]], [made[1]])
        step = analysis.fit_start()
        readings = [r["name"] for r in pattern(analysis, [step])["readings"]]
        assert word in readings
        assert len([r for r in readings if r in ("motor current", "motor torque")]) == 1
        json.dumps(readings)


def test_the_first_plot_is_none_where_there_is_nothing_to_draw(tmp_path: Path) -> None:
    live = Live(Store(tmp_path).create())
    assert app_views.first_plot(live, "none", {}) is None
