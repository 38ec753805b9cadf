"""The generator of hidden-effect joints: its physics, its sensors, its files, and the scoring
of answers.
"""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.hidden_effect import campaign
from tests.hidden_effect._engine import STEP, library, pack, simulate, write_csv
from tests.hidden_effect._engine_numpy import simulate_fleet
from tests.hidden_effect._tables import Outcome, checks
from tests.hidden_effect.generator import (
    COLUMNS,
    DT,
    KM,
    NOISE,
    QUANTUM,
    draw_joint,
    generate_case,
    simulate_case,
)
from tests.hidden_effect.hidden import LIBRARY, OUTSIDE
from tests.hidden_effect.scoring import score

FloatArray = npt.NDArray[np.float64]
SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "hidden_effect"
pytestmark = pytest.mark.skipif(library() is None, reason="the numpy twin takes minutes per case")


def still(rows: int) -> tuple[FloatArray, FloatArray]:
    return np.zeros(rows), np.zeros(rows)


def free_run(changes: dict[str, float], state: list[float], step: float = STEP) -> FloatArray:
    joint = {"JM": 4.4, "JL": 10.3, "TG": -105.0, "K": 2.15e4, "N": 160.0, "NKM": 8.8, **changes}
    return simulate(
        [pack(joint)],
        [still(1000)],
        [np.array(state)],
        [np.zeros((0, 3))],
        dt=DT,
        pre_roll=0.0,
        step=step,
    )[0]


def energy(table: FloatArray, k3: float = 0.0) -> FloatArray:
    q, v, th, w = table[:, 2:6].T
    d = q - th
    kinetic = 0.5 * 4.4 * v**2 + 0.5 * 10.3 * w**2
    return np.asarray(kinetic + 0.5 * 2.15e4 * d**2 + 0.25 * k3 * d**4 - 105.0 * np.cos(th))


@pytest.mark.parametrize("k3", [0.0, 3.3e8])
def test_energy_is_kept_without_friction_and_input(k3: float) -> None:
    run = free_run({"K3": k3}, [0.302, 0.0, 0.3, 0.0])
    e = energy(run, k3)
    swing = np.ptp(0.5 * 2.15e4 * (run[:, 2] - run[:, 4]) ** 2)
    assert np.ptp(e) < 2e-5 * swing
    finer = energy(free_run({"K3": k3}, [0.302, 0.0, 0.3, 0.0], step=STEP / 2), k3)
    assert np.ptp(e) / np.ptp(finer) == pytest.approx(4.0, rel=0.05)  # second order


@pytest.mark.parametrize(
    "friction",
    [
        {"M_TC": 3.0},
        {"M_TC": 3.0, "M_V0": 0.005},
        {"M_B": 5.0},
        {"C": 30.0},
        {"M_TC": 3.0, "M_MU": 0.05},
        {"M_B2": 5.0, "M_B3": 5.0},
    ],
)
def test_friction_takes_energy(friction: dict[str, float]) -> None:
    e = energy(free_run(friction, [0.31, 0.0, 0.3, 0.0]))  # 1.08 J in the spring
    assert np.max(np.diff(e)) < 1e-4
    assert e[-1] < e[0] - 0.05


def test_set_valued_friction_holds_the_motor_still_exactly() -> None:
    torque = 20.0 * 0.3
    run = free_run({"TG": 0.0, "M_TC": torque * 1.001, "KP": 20.0}, [-0.3, 0.0, -0.3, 0.0])
    assert np.all(run[:, 3] == 0.0)
    moved = free_run({"TG": 0.0, "M_TC": torque * 0.98, "KP": 20.0}, [-0.3, 0.0, -0.3, 0.0])
    assert moved[-1, 2] > -0.3 + 1e-4


def test_numpy_twin_agrees_with_the_compiled_integrator() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(60) * DT
    motion = (0.2 * np.sin(20.0 * t) + 0.4, 4.0 * np.cos(20.0 * t))
    hidden: list[dict[str, float]] = [
        {},
        {"M_V0": 0.0, "L_V0": 0.0, "M_TCA": 3.0, "M_MU": 0.1},
        {"M_ZS": 2e-3, "M_TS": 9.0, "M_VS": 0.05, "CURVE": 1.0},
        {"HK1": 5e3, "HS1": 3e-4, "HK3": 900.0, "HS3": 1e-3, "GAP": 1e-4},
        {"WIND": 2e-4, "WIND_X": 4e-4, "LAG_T": 90.0},
        {
            "PW_X1": 7e-4,
            "PW_X2": 2e-3,
            "PW_D1": 9e3,
            "PW_D2": 5e3,
            "COG": 2.0,
            "COG_O": 4.0,
            "HEAT": 0.3,
        },
        {
            "FLEX": 0.2,
            "FLEX_F": 11.0,
            "FLEX_Z": 0.02,
            "STOP": 90.0,
            "STOP_X": 0.3,
            "BUMP": 8.0,
            "BUMP_X": 0.4,
        },
        {
            "KE1": 3e-4,
            "KE1_O": 2.0,
            "M_CYC": 3.0,
            "L_SIN": 4.0,
            "M_COS": 2.0,
            "M_KA": 50.0,
            "LAG_I": 33.0,
        },
    ]
    vectors = [pack(draw_joint(rng) | h) for h in hidden]
    n = len(vectors)
    states = [np.array([0.4, 0.0, 0.402, 0.0])] * n
    snags = [np.array([[0.02, 0.05, 9.0]])] * n
    one = simulate(vectors, [motion] * n, states, snags, dt=DT, pre_roll=0.01)
    two = simulate_fleet(vectors, [motion] * n, states, snags, step=STEP, stride=40, before=200)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_same_seed_same_case_bit_by_bit(tmp_path: Path) -> None:
    a = generate_case("stribeck", 5, folder=tmp_path / "a" / "x")
    b = generate_case("stribeck", 5, folder=tmp_path / "b" / "x")
    for name in ("train.csv", "train2.csv", "test.csv", "test2.csv", "joint.toml", "truth.json"):
        assert (a / name).read_bytes() == (b / name).read_bytes()
    other = simulate_case("stribeck", 6, records=("train",), span=1.0)
    same = simulate_case("stribeck", 5, records=("train",), span=1.0)
    assert not np.array_equal(other.measured["train"], same.measured["train"])


@pytest.mark.parametrize("effect", [*LIBRARY, *OUTSIDE])
def test_every_effect_changes_the_recording(effect: str) -> None:
    span = 10.0 if effect == "snags" else 6.0
    hidden = simulate_case(effect, 2, records=("train", "train2"), span=span)
    plain = simulate_case(effect, 2, size=0.0, records=("train", "train2"), span=span)
    change = np.concatenate([hidden.measured[r] - plain.measured[r] for r in ("train", "train2")])
    levels = np.array([NOISE.get(c, QUANTUM.get(c, np.inf)) for c in COLUMNS])
    assert np.max(np.sqrt(np.mean(change**2, axis=0)) / levels) > 3.0


@pytest.mark.parametrize(
    "effect",
    [
        "added_spring",
        "cyclic_torque",
        "current_offset",
        "torque_sensor_gain",
        "torque_sensor_offset",
        "kinematic_error",
        "cubic_stiffness",
        "torque_ripple",
        "cyclic_friction",
        "asymmetric_viscous",
    ],
)
def test_change_is_proportional_to_the_size(effect: str) -> None:
    smooth = {"M_V0": 0.005, "L_V0": 0.005}
    runs = [
        simulate_case(effect, 4, size=s, overrides=smooth, records=("train2",), span=5.0)
        for s in (0.0, 0.05, 0.1)
    ]
    base, half, full = (r.measured["train2"] for r in runs)
    column = COLUMNS.index(
        "link_torque_Nm" if effect.startswith("torque_sensor") else "motor_current_A"
    )
    ratio = np.linalg.norm((full - base)[:, column]) / np.linalg.norm((half - base)[:, column])
    assert ratio == pytest.approx(2.0, rel=0.1)


def test_sensor_noise_is_at_the_stated_level() -> None:
    case = simulate_case(None, 1, records=("train2",))
    exact, measured = case.exact["train2"], case.measured["train2"]
    error = measured - exact
    for name, level in NOISE.items():
        assert np.std(error[:, COLUMNS.index(name)]) == pytest.approx(level, rel=0.03)
    for name, share in (("motor_position_rad", 0.5), ("link_position_rad", 0.25)):
        i, step = COLUMNS.index(name), QUANTUM[name]
        steps = measured[:, i] / step
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
        assert np.std(error[:, i]) == pytest.approx(step * np.sqrt(share**2 + 1.0 / 12.0), rel=0.03)


def kernels(length: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """cos^4 window and what it makes of first and second derivatives."""
    x = np.linspace(-1.0, 1.0, length)
    a, h = np.pi / 2.0, 0.5 * (length - 1) * DT
    c, s = np.cos(a * x), np.sin(a * x)
    total = np.sum(c**4)
    return (
        c**4 / total,
        -4.0 * a * c**3 * s / h / total,
        (12.0 * a**2 * c**2 * s**2 - 4.0 * a**2 * c**4) / h**2 / total,
    )


def balance_ratios(table: FloatArray, ratio: float, truth: dict[str, float]) -> dict[str, float]:
    """Residual of the motor, link and transmission balance with the true parameters, over what
    the noise explains.
    """
    w, d, dd = kernels(31)
    _, i, qm, _, ql, _, t = table.T
    q = qm / ratio
    nq = QUANTUM["motor_position_rad"] * np.sqrt(1.0 / 3.0) / abs(ratio)
    nl = QUANTUM["link_position_rad"] * np.sqrt(1.0 / 16.0 + 1.0 / 12.0)
    nt, ni = NOISE["link_torque_Nm"], NOISE["motor_current_A"] * abs(ratio) * KM

    def f(y: FloatArray, k: FloatArray) -> FloatArray:
        return np.convolve(y, k, "valid")

    jm, jl, k = (
        truth["motor_inertia_kg_m2"],
        truth["link_inertia_kg_m2"],
        truth["stiffness_Nm_per_rad"],
    )
    bm, bl, c = (
        truth["motor_viscous_Nms_per_rad"],
        truth["link_viscous_Nms_per_rad"],
        truth["structural_damping_Nms_per_rad"],
    )
    v, vl = f(q, d), f(ql, d)
    # away from reversals, over the whole window, where the friction does not depend on its
    # smoothing
    away = (
        np.convolve(
            (np.abs(np.convolve(table[:, 5], np.ones(15) / 15, "same")) < 0.08),
            np.ones(31),
            "valid",
        )
        < 0.5
    )
    m = f(ratio * KM * i - t, w) - f(q, jm * dd + bm * d) - truth["motor_coulomb_Nm"] * np.sign(v)
    li = (
        f(t + truth["gravity_torque_Nm"] * np.sin(ql), w)
        - f(ql, jl * dd + bl * d)
        - truth["link_coulomb_Nm"] * np.sign(vl)
    )
    tr = f(t, w) - f(q - ql, k * w + c * d)
    norm = np.linalg.norm
    expected = {
        "motor": np.hypot(np.hypot(ni, nt) * norm(w), nq * norm(jm * dd + bm * d)),
        "link": np.hypot(nt * norm(w), nl * norm(jl * dd + bl * d)),
        "transmission": np.hypot(nt * norm(w), np.hypot(nq, nl) * norm(k * w + c * d)),
    }
    found = {"motor": m[away], "link": li[away], "transmission": tr[away]}
    return {name: float(np.sqrt(np.mean(r**2)) / expected[name]) for name, r in found.items()}


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_plain_case_keeps_its_balances_to_the_noise(seed: int) -> None:
    case = simulate_case(None, seed)
    truth = dict(case.truth["link_referred"])  # type: ignore[call-overload]
    for table in case.measured.values():
        for name, ratio in balance_ratios(table[50:], case.gear_ratio, truth).items():
            assert 0.85 < ratio < 1.15, name


def test_shared_recordings_pass_the_same_balances_and_have_like_ranges() -> None:
    if not SHARED.exists():
        assert not os.environ.get("CI"), f"missing {SHARED}"
        pytest.skip("shared recordings are not here")
    given = json.loads((SHARED / "none" / "truth.json").read_text(encoding="utf-8"))
    mine = simulate_case(None, 0).measured
    for name in ("train", "train2", "test", "test2"):
        theirs = np.loadtxt(SHARED / "none" / f"{name}.csv", delimiter=",", skiprows=1)
        for balance, ratio in balance_ratios(
            theirs[50:], given["gear_ratio"], given["link_referred"]
        ).items():
            assert 0.85 < ratio < 1.15, (name, balance)
        assert theirs.shape == mine[name].shape
    both = [
        np.concatenate(
            [np.loadtxt(SHARED / "none" / f"{n}.csv", delimiter=",", skiprows=1) for n in mine]
        ),
        np.concatenate(list(mine.values())),
    ]
    for column, name in list(enumerate(COLUMNS))[1:]:
        span = [np.sqrt(np.mean(table[:, column] ** 2)) for table in both]
        assert 0.5 < span[1] / span[0] < 2.0, name


def test_files_say_what_an_engineer_knows(tmp_path: Path) -> None:
    folder = generate_case(("stribeck", "kinematic_error"), 3, folder=tmp_path / "pair")
    joint = tomllib.loads((folder / "joint.toml").read_text(encoding="utf-8"))["joint"]
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    assert joint["gear_ratio"] == truth["gear_ratio"]
    assert abs(joint["gear_ratio"]) == 160.0
    assert (joint["motor_constant"], joint["model"]) == (KM, "hd3")
    assert joint["effects"] == ["viscous", "coulomb", "gravity"]
    assert truth["hidden_effect"] == ["stribeck", "kinematic_error"]
    lines = (folder / "train.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == ",".join(COLUMNS)
    assert len(lines) == 12001
    no_torque = generate_case("lugre", 3, torque_sensor=False, folder=tmp_path / "no_torque")
    assert (
        "link_torque_Nm" not in (no_torque / "test.csv").read_text(encoding="utf-8").splitlines()[0]
    )
    one = generate_case("lugre", 3, one_sided=True, folder=tmp_path / "one")
    assert (one / "test.csv").read_text(encoding="utf-8").splitlines()[0] == ",".join(COLUMNS[:4])
    with pytest.raises(ValueError, match="torque sensor"):
        simulate_case("torque_sensor_gain", 0, torque_sensor=False)
    with pytest.raises(ValueError, match="no such effect"):
        simulate_case("gremlins", 0)


def test_both_mountings_and_both_frictions_occur() -> None:
    joints = [draw_joint(np.random.default_rng(s)) for s in range(30)]
    assert {float(np.sign(j["NKM"])) for j in joints} == {-1.0, 1.0}
    assert {j["M_V0"] == 0.0 for j in joints} == {True, False}


def test_unloaded_is_the_same_joint_without_gravity() -> None:
    story = {"KM": 0.82}
    loaded = simulate_case("motor_constant_error", 1, overrides=story, records=("train",), span=3.0)
    free = simulate_case(
        "motor_constant_error", 1, overrides=story, unloaded=True, records=("train",), span=3.0
    )
    assert free.parameters["TG"] == 0.0
    assert free.truth["hidden"] == {"motor_constant_error": {"motor_constant_factor": 0.82}}
    assert {k for k in loaded.parameters if loaded.parameters[k] != free.parameters[k]} == {
        "TG",
        "JL",
    }
    # steady slow motion: the current carries friction only
    torque = free.exact["train"][:, 6]
    assert np.median(np.abs(torque)) < 0.1 * np.median(np.abs(loaded.exact["train"][500:, 6]))


def test_dirt_is_small_but_there() -> None:
    clean = simulate_case(None, 7, records=("train2",), span=8.0)
    dirty = simulate_case(None, 7, dirt=True, records=("train2",), span=8.0)
    change = (dirty.exact["train2"] - clean.exact["train2"])[:, 1] * 160.0 * KM
    assert 0.05 < np.sqrt(np.mean(change**2)) < 5.0


def test_written_table_reads_back(tmp_path: Path) -> None:
    table = np.random.default_rng(0).normal(size=(20, 3)) * np.array([1e-5, 1.0, 1e4])
    write_csv(tmp_path / "t.csv", "a,b,c", table)
    np.testing.assert_allclose(
        np.loadtxt(tmp_path / "t.csv", delimiter=",", skiprows=1), table, rtol=1e-8
    )


def answer(*claims: list[str], first: str | None = None, **more: Any) -> dict[str, Any]:
    step: dict[str, Any] = {
        "added": None,
        "effects": [],
        "parameters": {},
        "held_out": {
            "balances": {"motor": {"rms": 4.0, "unit": "N.m", "floor": 1.0, "ratio": 4.0}}
        },
    }
    last = {
        **step,
        "held_out": {
            "balances": {"motor": {"rms": 1.0, "unit": "N.m", "floor": 1.0, "ratio": 1.0}}
        },
    }
    found = [{"effects": c, "balance": "motor", "held_out_drop_percent": 50.0} for c in claims]
    ranking = [{"effect": first, "title": "", "balance": "motor"}] if first else []
    empty: dict[str, Any] = {
        "minor": [],
        "lines": [],
        "unexplained": [],
        "verdict": "complete",
        "not_testable": [],
    }
    return {"steps": [step, last], "claims": found, "ranking": ranking, **empty, **more}


def about(*names: str, **hidden: dict[str, float]) -> dict[str, Any]:
    return {
        "hidden_effect": list(names) or None,
        "gear_ratio": -160.0,
        "link_referred": {"stiffness_Nm_per_rad": 2e4},
        "balance": dict.fromkeys(names, "motor"),
        "hidden": hidden,
        "outside": [],
    }


def test_score_of_a_right_answer() -> None:
    parameters = {
        "stiffness": {"value": 2.1e4 / 160.0**2, "stderr": 1.0, "unit": "N.m/rad", "side": "motor"}
    }
    result = answer(["stribeck"], first="stribeck")
    result["steps"][-1]["parameters"] = parameters
    s = score(about("stribeck"), result)
    assert (s.in_set, s.one_name, s.one_name_right, s.extra, s.top1) == (1, 1, 1, 0, True)
    assert s.drop_percent == pytest.approx(75.0)
    assert s.parameter_errors["stiffness"] == pytest.approx(5.0)


def test_score_of_sets_classes_and_extras() -> None:
    s = score(
        about("backlash"), answer(["soft_windup"], ["stribeck", "lugre"], first="soft_windup")
    )
    assert (s.in_set, s.in_set_class, s.one_name_right, s.one_name_right_class) == (0, 1, 0, 1)
    assert (s.extra, s.extra_names, s.top1, s.top1_class) == (
        1,
        (("lugre", "stribeck"),),
        False,
        True,
    )
    sine = {"cyclic_sine_Nm": 5.0, "cyclic_cosine_Nm": 1.0}
    assert (
        score(about("cyclic_torque", cyclic_torque=sine), answer(["added_spring"])).in_set_class
        == 1
    )
    assert (
        score(about("cyclic_torque", cyclic_torque=sine), answer(["current_offset"])).in_set_class
        == 0
    )
    twice = score(about("stribeck"), answer(["stribeck"], ["stribeck", "lugre"]))
    assert (twice.in_set, twice.extra) == (1, 1)
    assert score(about(), answer(["lugre"])).extra == 1
    assert score(about(), answer()).extra == 0


def test_score_of_lines() -> None:
    truth = about("torque_ripple", torque_ripple={"ripple_order_per_motor_turn": 4.0})
    line = {
        "order": 4.0,
        "per": "motor turn",
        "tolerance": 0.02,
        "amplitude": 1.0,
        "unit": "N.m",
        "effects": ["torque_ripple"],
    }
    assert score(truth, answer(lines=[line])).in_set == 1
    wrong = score(truth, answer(lines=[{**line, "order": 3.0}]))
    assert (wrong.in_set, wrong.extra) == (0, 1)
    assert score(about(), answer(lines=[line])).extra == 1
    both = score(truth, answer(["torque_ripple"], lines=[{**line, "order": 3.0}]))
    assert (both.in_set, both.one_name_right, both.extra) == (0, 0, 1)


def test_score_of_what_no_name_covers() -> None:
    truth = about("local_bump", local_bump={"bump_low_rad": 0.2, "bump_high_rad": 0.4}) | {
        "outside": ["local_bump"]
    }
    seen = {
        "balance": "motor",
        "share_percent": 50,
        "axis": "link_position",
        "low": 0.35,
        "high": 0.6,
        "order": None,
        "frequency_hz": None,
    }
    good = score(truth, answer(verdict="unexplained", unexplained=[seen]))
    assert (good.balance_right, good.axis_right, good.extra) == (True, True, 0)
    off = score(
        truth, answer(verdict="unexplained", unexplained=[{**seen, "low": -0.6, "high": -0.2}])
    )
    assert (off.balance_right, off.axis_right) == (True, False)
    blind = score(truth, answer(["cyclic_friction"], verdict="complete"))
    assert (blind.balance_right, blind.extra, blind.downgraded) == (False, 1, 0)


def oracle(train: list[Path], held_out: list[Path], joint: Path) -> dict[str, Any]:
    """A tool that knows the answer, for the campaign's own test."""
    assert all(p.exists() for p in (*train, *held_out, joint))
    truth = json.loads((joint.parent / "truth.json").read_text(encoding="utf-8"))
    name = truth["hidden_effect"]
    if truth["outside"]:
        return answer(
            verdict="unexplained",
            unexplained=[{"balance": truth["balance"][name], "share_percent": 90}],
        )
    return answer(
        *([name],) if name else (),
        first=name or "stribeck",
        verdict="complete" if name else "nothing_missing",
    )


def test_campaign_counts_and_reports(tmp_path: Path) -> None:
    cache, entry = str(tmp_path / "cache"), f"{__name__}:oracle"
    options = [
        "--effects",
        "backlash,torque_sensor_offset",
        "--seeds",
        "1",
        "--none",
        "1",
        "--pairs",
        "0",
    ]
    options += ["--outside", "0", "--cache", cache, "--entry", entry]
    options += ["--out", str(tmp_path / "report.md"), "--json", str(tmp_path / "scores.json")]
    campaign.main(options)
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "| single: true name in a set, % | 100.00 | >= 95 | 2 | ok |" in report
    assert "| none: sets with a claim, % | 0.00 | <= 2 | 1 | ok |" in report
    assert str(tmp_path) not in report
    assert len(json.loads((tmp_path / "scores.json").read_text(encoding="utf-8"))) == 3


def test_campaign_counts_an_error_as_a_miss() -> None:
    right = Outcome(
        "single", "lugre", 1, False, 1.0, score(about("lugre"), answer(["lugre"], first="lugre"))
    )
    failed = Outcome("single", "lugre", 2, False, 1.0, None, "ValueError: no")
    found = {c.what: c for c in checks([right, failed], size=1.0, dirt=False)}
    assert found["single: true name in a set, %"].value == 50.0
    assert found["single: true name in a set, %"].passed is False
    assert found["cases that ended in an error"].passed is False
