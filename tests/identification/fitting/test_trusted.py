"""Which number to trust: intervals against known values, trades, bounds, flat directions."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import workbench
from benchmarks.next_run import record_of
from benchmarks.trust import PLAIN, joint_of
from identification import Fit, Joint, fit, load_joint, read
from identification.balance.dataset import Dataset
from identification.data.joint_file import Known
from identification.fitting.engine import Solution, load_dataset, prepared_model, solve
from identification.fitting.information import white_errors
from identification.fitting.trust import Trust, Trusted, _by_error, trust
from tests.hidden_effect import generator
from tests.hidden_effect.generator import Case, generate_case, simulate_case
from workbench.cli.main import main


@cache
def case() -> Case:
    return simulate_case("stribeck", 9106, records=("train", "train2"), overrides={"CURVE": 1.0})


def fitted(
    joint: Joint, seconds: float = 24.0, start: Mapping[str, float] | None = None
) -> tuple[Solution, Dataset]:
    records = [
        record_of(table[: round(seconds / 2e-3)], name, "same")
        for name, table in case().measured.items()
    ]
    model = prepared_model(joint, records[0])
    data = load_dataset(records, [], joint, model)
    return solve(model, data, start=start), data


@cache
def judged() -> dict[str, Trusted]:
    solution, data = fitted(joint_of(case(), ("stribeck@motor",)))
    return {p.name: p for p in trust(solution, data).parameters}


def test_an_exponent_does_not_run_off_from_a_fine_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smoothing velocity of 25 times the truth and a Stribeck torque of 14 times it fit each
    other; every start ended there, its exponent free from the first step on.
    """
    steps = {name: 0.05 * step for name, step in generator.QUANTUM.items()}
    monkeypatch.setattr(generator, "QUANTUM", steps)
    sharp = {"CURVE": 1.0, "M_V0": 0.0, "L_V0": 0.0}
    found = simulate_case("stribeck", 73005, records=("train", "train2"), overrides=sharp)
    joint = joint_of(found, ("stribeck@motor",))
    records = [record_of(table, name, "same") for name, table in found.measured.items()]
    model = prepared_model(joint, records[0])
    values = solve(model, load_dataset(records, [], joint, model)).values
    assert values["motor_stribeck_extra"] == pytest.approx(found.parameters["M_TS"], rel=0.02)
    assert values["motor_stribeck_velocity"] == pytest.approx(found.parameters["M_VS"], rel=0.02)


def test_a_law_that_few_reversals_show_does_not_run_off_where_noise_is_taken_off() -> None:
    """Its torque went to fifty times the truth, its velocity to a thirtieth of it."""
    found = simulate_case("stribeck", 7000, records=("train",))
    joint = joint_of(found, ("stribeck@motor",))
    records = [record_of(table, name, "same") for name, table in found.measured.items()]
    model = prepared_model(joint, records[0])
    solution = solve(model, load_dataset(records, [], joint, model))
    for name, key in (("motor_stribeck_extra", "M_TS"), ("motor_stribeck_velocity", "M_VS")):
        true, error = found.parameters[key], solution.stderr[name]
        assert error is not None
        assert abs(solution.values[name] - true) < min(2 * error, 0.2 * true)


def test_most_intervals_hold_the_truth_and_none_is_far_off() -> None:
    truth = {**PLAIN, "motor_stribeck_extra": "M_TS", "motor_stribeck_velocity": "M_VS"}
    inside = []
    for name, key in truth.items():
        p, true = judged()[name], case().parameters[key]
        assert p.low is not None
        assert p.high is not None
        assert p.low < p.value < p.high
        inside.append(p.low <= true <= p.high)
        # three times the interval's half width
        assert abs(p.value - true) < 3 * max(p.high - p.value, p.value - p.low)
    assert sum(inside) >= len(inside) - 2


def test_classes_come_from_the_declarations() -> None:
    kinds = {n: judged()[n].kind for n in ("motor_inertia", "stiffness", "motor_coulomb")}
    assert kinds == {
        "motor_inertia": "inertia",
        "stiffness": "stiffness",
        "motor_coulomb": "friction",
    }
    assert judged()["motor_stribeck_velocity"].kind == "shape"
    assert judged()["gravity_torque"].kind == "other"


def test_a_trade_is_what_the_fit_does_when_one_of_the_two_is_held() -> None:
    p = judged()["motor_viscous"]
    assert p.partner is not None
    assert p.stderr is not None
    joint = joint_of(case(), ("stribeck@motor",))
    solution, _ = fitted(joint)
    moved = p.value + 10 * p.stderr
    held = replace(joint, known={p.name: Known(moved)})
    other, _ = fitted(held, start=solution.values)  # in the same valley of its shapes
    change = other.values[p.partner] / solution.values[p.partner] - 1
    assert (change < 0) == ("goes down" in p.trade)
    up, down = (float(text.split()[1]) for text in p.trade.split("goes ")[1:])
    # the same proportion as in the words, which have two digits
    assert abs(change) / (moved / p.value - 1) == pytest.approx(down / up, rel=0.1)


def test_values_by_record_and_window_lie_around_the_whole() -> None:
    for name in ("motor_inertia", "stiffness", "gravity_torque"):
        p = judged()[name]
        assert len(p.records) == 2
        assert len(p.windows) == 4
        known = [v for v in (*p.records, *p.windows) if v is not None]
        assert len(known) >= 4
        np.testing.assert_allclose(known, p.value, rtol=0.05)


def test_what_the_motion_does_not_tell_is_not_trusted() -> None:
    joint = joint_of(case(), ("stribeck@motor", "current_offset", "asymmetric_coulomb@motor"))
    solution, data = fitted(joint, 12.0)
    found = {p.name: p for p in trust(solution, data, profiles=False).parameters}
    # one column on every motion
    for name in ("current_offset", "motor_asymmetric_coulomb"):
        assert found[name].verdict != "trust"
    assert {found["current_offset"].partner, found["motor_asymmetric_coulomb"].partner} == {
        "current_offset",
        "motor_asymmetric_coulomb",
    }
    assert found["motor_inertia"].verdict == "trust"


def test_what_is_not_there_is_not_trusted_and_what_it_does_to_the_prediction() -> None:
    joint = joint_of(case(), ("stribeck@motor", "added_spring@link"))
    solution, data = fitted(joint, 12.0)
    found = {p.name: p for p in trust(solution, data, profiles=False).parameters}
    spring = found["link_added_spring"]
    assert spring.verdict != "trust"  # gravity stands in for it, and there is none
    for p in judged().values():
        assert 0.0 <= p.prediction_percent < 5.0


def test_white_errors_are_those_of_the_normal_equations() -> None:
    rng = np.random.default_rng(1)
    j = rng.standard_normal((400, 3)) @ np.diag([1.0, 1e3, 1e-3])
    expected = np.sqrt(np.diag(np.linalg.inv(j.T @ j)) / 0.4)
    np.testing.assert_allclose(white_errors(j.T @ j), expected, rtol=1e-6)
    twice = np.column_stack([j, j[:, 0]])
    errors = white_errors(twice.T @ twice)
    assert np.isinf(errors[[0, 3]]).all()
    np.testing.assert_allclose(errors[1:3], expected[1:], rtol=1e-3)


def test_the_verb_prints_a_line_for_every_parameter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = generate_case(None, 9107, folder=tmp_path / "case")
    out = tmp_path / "trust.json"
    words = [str(folder / "train.csv"), "--joint", str(folder / "joint.toml")]
    assert main(["trust", *words, "--json", str(out)]) == 0
    found = json.loads(out.read_text())["trust"]
    printed, doubts = capsys.readouterr()
    assert "make up for what is missing" not in doubts  # nothing is hidden in these records
    for p in found:
        assert f"{p['name']} " in printed
        assert p["verdict"] in ("trust", "only in combination", "not")
        if p["interval"] is not None:
            assert p["interval"][0] <= p["value"] <= p["interval"][1]
            # "10.277 (10.28 to 10.28)" says nothing of the interval, and excludes its own value
            shown = re.search(rf"^{p['name']} +(\S+) \S+ \((\S+) to (\S+)\)", printed, re.M)
            assert shown is not None
            value, low, high = map(float, shown.groups())
            assert low < value < high


def test_values_of_a_model_that_lacks_something_are_doubted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = Path(workbench.__file__).parent / "demo"
    words = [str(folder / "train.npz"), "--joint", str(folder / "joint.toml")]
    assert main(["trust", *words]) == 0
    doubts = capsys.readouterr().err
    assert "motor" in doubts
    assert "may make up for what is missing" in doubts


@cache
def lacking() -> Fit:
    """The package's demo, whose motor lacks a law, fitted to both of its records."""
    folder = Path(workbench.__file__).parent / "demo"
    given = load_joint(folder / "joint.toml")
    return fit(given, [read(folder / f"{r}.npz", joint=given) for r in ("train", "held_out")])


@cache
def lacking_judged() -> Trust:
    return trust(lacking().solution, lacking().data, profiles=False)


def test_what_rests_on_a_balance_over_its_noise_is_not_trusted_by_records_or_by_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Motor Coulomb friction was 16 % off, its interval 5 % wide, and the verdict `trust`."""
    written, told = tmp_path / "fitted.toml", tmp_path / "trust.json"
    written.write_text(lacking().to_joint_file(), encoding="utf-8")
    assert main(["trust", "--joint", str(written), "--json", str(told)]) == 0
    assert "the model lacks a law in the motor balance" in capsys.readouterr().out
    found = [lacking_judged().as_json(), json.loads(told.read_text())["trust"]]
    by_name = [{p["name"]: p for p in one} for one in found]
    for one in by_name:
        assert one["motor_coulomb"]["verdict"] == "not"
        assert "lacks a law in the motor balance" in one["motor_coulomb"]["why"]
        assert one["link_inertia"]["verdict"] == "trust"
        assert one["stiffness"]["verdict"] == "trust"  # the twist alone tells it
    both = [{n: [p[k] for k in ("trade", "verdict", "why")] for n, p in q.items()} for q in by_name]
    assert both[0] == both[1]
    assert sum(bool(trade) for trade, *_ in both[0].values()) >= 2


def test_the_text_has_what_the_data_has() -> None:
    lines = str(lacking_judged()).splitlines()
    after = lines[[x.startswith("link_inertia") for x in lines].index(True) + 1]
    assert re.search(r"by record \S+, \S+; by window .*; moves the prediction by \S+ %$", after)


def test_noise_in_the_columns_moves_no_value_by_record() -> None:
    """Both lay below that of all records: what noise adds to the columns was taken off these
    only.
    """
    p = {p.name: p for p in lacking_judged().parameters}["link_inertia"]
    assert p.apart == ()
    low, high = sorted(v for v in p.records if v is not None)
    assert low < p.value < high


def test_a_record_of_another_joint_is_told_from_noise() -> None:
    p = replace(judged()["link_inertia"], records=(9.0, 9.5, None), low=8.9, high=9.1, apart=(1,))
    assert p.parts.startswith("by record 9, 9.5!, -; by window")
    assert replace(p, apart=()).parts.startswith("by record 9, 9.5*, -;")
    assert "within the error of that record alone" in str(Trust((replace(p, apart=()),)))
    assert "by more than noise explains" in str(Trust((p,)))


def test_an_error_over_ten_percent_is_called_one() -> None:
    """It said "known to less than 10 %", which is the contrary."""
    p = judged()["motor_viscous"]
    weak = _by_error(0.2, 0.9, identified=True)
    assert p.verdict == "trust" and weak[0] == "only in combination"
    assert "no better than to 10 %" in weak[1]
