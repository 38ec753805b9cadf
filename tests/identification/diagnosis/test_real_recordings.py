"""Recordings by other people: what is claimed, and how far the error on unseen data falls."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from casadi_models import EFFECTS
from identification import Improvement, Record, improve, read
from identification.balance.dataset import visible_labels
from identification.data.joint_file import Joint, parse_joint
from identification.data.plain_text import from_toml
from identification.diagnosis.learned import with_curves
from identification.fitting.assess import relative_error_percent
from workbench.show.words import left_behind

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "measurements"
VELOCITY_LAWS = {
    "viscous",
    "cubic_viscous",
    "quadratic_drag",
    "coulomb",
    "asymmetric_coulomb",
    "asymmetric_viscous",
    "stribeck",
}

if not SHARED.exists() and not os.environ.get("CI"):
    pytest.skip("../shared/measurements is not there", allow_module_level=True)


def joint(**values: object) -> Joint:
    return parse_joint({"joint": {"gear_ratio": 1.0, **values}})


@cache
def emps() -> Improvement:
    columns = {
        "time": {"column": "t_s", "unit": "s"},
        "motor_position": {"column": "q_m", "unit": "m"},
        "motor_torque": {"column": "u_V", "scale": 35.15065188, "unit": "N"},
    }
    records = [
        read(SHARED / "emps" / f, columns=columns, kind="linear")
        for f in ("train.csv", "test_pulses.csv")
    ]
    return improve(records[0], joint(kind="linear", model="hd1", effects=["viscous"]), [records[1]])


def test_emps_names_coulomb_and_asymmetric_viscous_friction() -> None:
    found = emps()
    named = [c.effects[0] for c in found.claims]
    assert named[0] == "coulomb"
    assert "asymmetric_viscous" in named
    assert not any("stribeck" in c.effects for c in found.claims)


def test_emps_error_on_the_pulses_record_falls_under_six_percent() -> None:
    errors = [s.held_out.relative_error_percent for s in emps().steps]
    assert 17.0 < errors[0] < 19.5
    assert errors[-1] <= 6.0


def test_the_joint_file_of_emps_is_no_worse_on_held_out_records_than_the_loop_says() -> None:
    """What is written is what was judged: learned curves that only fit the training rows stay
    out.
    """
    found = emps()
    written = parse_joint(from_toml(found.to_joint_file(), "emps"), "emps")
    solution = with_curves(found.steps[-1].solution, found.carried)
    assert sorted(written.effects) == sorted(visible_labels(solution.model))
    error = relative_error_percent(solution.model, found.data, found.data.held_out, solution.values)
    assert error <= 1.001 * found.steps[-1].held_out.relative_error_percent
    left = len(found.learned) - len(found.carried)
    assert left_behind(found).startswith(f"without {left} " if left else "")
    assert bool(left_behind(found)) == bool(left)


def test_emps_parameters_agree_with_the_published_ones() -> None:
    values = emps().steps[-1].solution.values
    assert values["inertia"] == pytest.approx(95.1089, rel=0.02)
    assert values["motor_coulomb"] == pytest.approx(20.3935, rel=0.05)


@cache
def quanser() -> Improvement:
    data = np.genfromtxt(SHARED / "quanser_2dsfl" / "ctu_lqr.csv", delimiter=",", names=True)
    degree = np.pi / 180
    # the gauge reads positive where the link leads: a positive current, which throws the link
    # back, makes it negative (r = -0.73)
    record = Record.from_channels(
        data["t_s"],
        {
            "motor_current": data["i1_A"],
            "motor_position": data["q1_deg"] * degree,
            "link_position": (data["q1_deg"] + data["defl1_deg"]) * degree,
        },
        name="quanser",
    )
    half = len(record) // 2
    return improve(
        record.take(slice(0, half)),
        joint(model="hd1", effects=["viscous"], torque_per_current=8.925),
        [record.take(slice(half, None))],
    )


def test_quanser_is_elastic_with_coulomb_friction_and_not_explained() -> None:
    found = quanser()
    assert found.claims[0].effects == ("coulomb",)
    # ten seconds do not tell it from seven others, which are named with it
    assert "cannot be named" in found.reason
    assert EFFECTS["transmission_compliance"].title in found.reason
    errors = [s.held_out.relative_error_percent for s in found.steps]
    assert 37.0 < errors[0] < 41.0
    assert errors[-1] <= 8.0, "half of the rows are at rest: scored, they read 18 %"
    assert found.verdict == "unexplained"


@cache
def brfd(channel: str) -> Improvement:
    import pyarrow.parquet as parquet

    table = parquet.read_table(SHARED / "brfd_friction_backlash" / "brfd.parquet").to_pydict()
    run = np.array(table["run"])
    arrays = {n: np.array(table[n], dtype=float) for n in ("t_s", "x_in", "F_kip")}

    def record(name: str, *keys: str) -> Record:
        chosen = np.array(["36lb" in r and any(k in r for k in keys) for r in run])
        return Record.from_channels(
            arrays["t_s"][chosen],
            {
                "motor_position": arrays["x_in"][chosen] * 0.0254,
                channel: arrays["F_kip"][chosen] * 4448.2216,
                "run": np.unique(run[chosen], return_inverse=True)[1].astype(float),
            },
            name=name,
            kind="linear",
        )

    train = record("train", "0.5Hz36lbtension1.5amp", "0.5Hz36lbtension0.5amp")
    test = record("test", "0.5Hz36lbtension1amp", "1Hz36lbtension1amp")
    return improve(train, joint(kind="linear", model="hd1", effects=["viscous"]), [test])


@pytest.mark.parametrize(
    ("channel", "low", "high"), [("motor_torque", 70.0, 77.0), ("link_torque", 52.0, 57.0)]
)
def test_friction_device_with_backlash_is_a_displacement_memory(
    channel: str, low: float, high: float
) -> None:
    """A torque sensor before a clamped link shows a transmission: its spring takes a part of the
    memory already.
    """
    found = brfd(channel)
    assert found.ranking is not None
    order = [t.key for t in found.ranking.trials]
    memory = min(order.index(k) for k in ("hysteresis", "lugre", "backlash") if k in order)
    assert all(order.index(k) > memory for k in VELOCITY_LAWS if k in order)
    errors = [s.held_out.relative_error_percent for s in found.steps]
    assert low < errors[0] < high
    assert errors[-1] <= 20.0


def test_pendulum_bench_with_sixteen_irregular_runs() -> None:
    rows = np.genfromtxt(
        SHARED / "bam_xl330" / "xl330.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    assert len(np.unique(rows["run"])) == 16
    rows = rows[np.array([str(v) == "True" for v in rows["torque_enable"]])]
    gain = (4096 / 2 / np.pi) / (128 * 885)
    voltage = (
        np.clip(gain * rows["kp"] * (rows["q_ref_rad"] - rows["q_rad"]), -1, 1) * rows["vin_V"]
    )
    number = np.unique(rows["run"], return_inverse=True)[1].astype(float)

    def record(name: str, *gains: int) -> Record:
        chosen = np.isin(rows["kp"], gains)
        return Record.from_channels(
            rows["t_s"][chosen],
            {
                "motor_voltage": voltage[chosen],
                "motor_position": rows["q_rad"][chosen],
                "run": number[chosen],
            },
            name=name,
        )

    train = record("train", 100, 400)
    assert np.ptp(train.steps()) > 0.0005
    found = improve(train, joint(model="hd1", effects=["viscous"]), [record("test", 200, 800)])
    named = [c.effects[0] for c in found.claims]
    assert "gravity" in named
    assert "coulomb" in named
    assert not any("stribeck" in c.effects for c in found.claims)
    assert found.steps[-1].held_out.relative_error_percent < 30.0
