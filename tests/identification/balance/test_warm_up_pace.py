"""How fast a joint warms up is found where no temperature is recorded, and is no question where one
is.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from smooth_laws import COULOMB, FloatArray, record

from casadi_models import EFFECTS
from casadi_models.signals import LocalSignals
from identification import Record, improve
from identification.balance.dataset import load_dataset, prepared_model
from identification.balance.sensing import idle_shapes
from identification.data.joint_file import Joint, Known, parse_joint
from identification.diagnosis.candidates import offered, shape_grid
from identification.diagnosis.improvement import Improvement
from identification.fitting.engine import solve
from identification.fitting.parameters import parameter_table
from identification.online.options import searched_parameters

SECONDS = 40.0
PACE = "motor_thermal_pace"
FALL = 0.3 * COULOMB
DECLARED = EFFECTS["thermal_friction"]
BARE = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=("viscous", "coulomb"))
WARM = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=("viscous", "coulomb", DECLARED.key))


def warming(constant: float, q: FloatArray, v: FloatArray) -> FloatArray:
    """Dry friction that falls by less than a third, as a first-order warm-up does."""
    age = np.arange(len(q)) * 1e-3
    return -FALL * (1 - np.exp(-age / constant)) * np.tanh(v / 2e-3)


def runs(constant: float, seed: int = 61) -> list[Record]:
    rng = np.random.default_rng(seed)
    return [record(rng, SECONDS, partial(warming, constant)) for _ in range(2)]


def with_temperature(one: Record) -> Record:
    age = one.time - one.time[0]
    return one.with_channel("temperature", 293.0 + 20.0 * (1 - np.exp(-age / 5.0)))


@pytest.fixture(scope="module", params=[4.0, 80.0], ids=["faster", "a straight line"])
def named(request: pytest.FixtureRequest) -> tuple[float, Improvement]:
    constant = float(request.param)
    train, held = runs(constant)
    return constant, improve([train], BARE, [held])


def test_friction_that_warms_at_another_pace_is_named_alone(
    named: tuple[float, Improvement],
) -> None:
    _, found = named
    assert [c.effects for c in found.claims] == [("thermal_friction",)]
    assert found.verdict == "complete"
    assert not found.lines
    assert found.final_ratios["axis"].ratio < 1.1


def test_its_pace_and_size_are_found(named: tuple[float, Improvement]) -> None:
    constant, found = named
    solution = found.steps[-1].solution
    for name, truth in (
        (PACE, SECONDS / (3 * constant)),
        ("motor_thermal_coulomb", -FALL),
        ("motor_coulomb", COULOMB),
    ):
        assert abs(solution.values[name] - truth) < 3 * solution.stderr[name], name
    assert solution.stderr[PACE] < 0.3 * solution.values[PACE]


def test_the_error_falls_to_what_the_true_course_leaves(named: tuple[float, Improvement]) -> None:
    """Beside a course that is set, friction at another pace is left in the rows."""
    constant, found = named
    train, held = runs(constant)
    set_to_one = replace(WARM, known={PACE: Known(value=1.0)})
    beside = improve([train], set_to_one, [held])
    least = found.steps[-1].held_out.balances["axis"].ratio
    assert least < 0.97 * beside.steps[0].held_out.balances["axis"].ratio


def test_where_a_temperature_is_recorded_there_is_no_pace() -> None:
    train, held = (with_temperature(r) for r in runs(5.0))
    model = prepared_model(WARM, train)
    data = load_dataset([train], [held], WARM, model)
    assert idle_shapes(model, data.sensing) == {PACE: 1.0}
    typed = model.with_values({PACE: 2.0})
    for one in (model, typed):  # whatever a fit without temperature has left in the joint file
        solution = solve(one, data)
        assert PACE not in solution.free
        assert solution.values[PACE] == 1.0
        assert solution.values["motor_thermal_coulomb"] == pytest.approx(-FALL / 20.0, rel=0.02)
        assert PACE not in parameter_table(solution, data)
    bare = prepared_model(BARE, train)
    candidates, _ = offered(bare, data)
    (mine,) = [c for c in candidates if c.effect is DECLARED]
    assert mine.shapes == ()
    assert shape_grid(mine, data) == [{}]


def test_a_joint_file_without_a_pace_is_what_it_was() -> None:
    old = {"motor_thermal_coulomb": -6.0, "motor_thermal_viscous": 0.5}
    fitted = {n: {"value": v} for n, v in old.items()}
    table = {"gear_ratio": 1.0, "model": "hd1", "effects": list(WARM.effects)}
    model = parse_joint({"joint": table, "fitted": fitted}).model()
    assert dict(zip(model.parameter_names, model.value_vector(), strict=True))[PACE] == 1.0
    law = ca.Function("law", *_law())
    for temperature in (-5.0, 0.0, 0.3, 0.95, 1.0, 1.7, 20.0):
        found = float(law(temperature, 1.0))
        assert found == (-6.0 * 1.0 + 0.5 * 0.7) * temperature


def test_the_law_and_its_slopes_are_finite_on_either_side_of_warm() -> None:
    (temperature, pace), (value,) = _law()
    slopes = ca.Function(
        "slopes",
        [temperature, pace],
        [value, ca.jacobian(value, temperature), ca.jacobian(value, pace)],
    )
    for t in (-3.0, 0.0, 0.2, 0.9, 1.0, 1.5, 20.0):
        for k in (0.1, 0.3, 1.0, 2.5, 10.0):
            assert all(np.isfinite(float(x)) for x in slopes(t, k))
            if t == 1.0:
                continue
            step = 1e-6
            by_temperature, by_pace = (
                (
                    float(slopes(t + a * step, k + b * step)[0])
                    - float(slopes(t - a * step, k - b * step)[0])
                )
                / (2 * step)
                for a, b in ((1, 0), (0, 1))
            )
            assert float(slopes(t, k)[1]) == pytest.approx(by_temperature, rel=1e-5, abs=1e-7)
            assert float(slopes(t, k)[2]) == pytest.approx(by_pace, rel=1e-5, abs=1e-7)


def test_a_pace_of_k_is_a_warm_up_k_times_as_fast() -> None:
    law = ca.Function("law", *_law())
    age = np.linspace(0.0, 1.0, 21)
    for k in (0.2, 1.0, 4.0):
        course = [float(law(1 - np.exp(-3 * a), k)) for a in age]
        full = -6.0 + 0.5 * 0.7
        np.testing.assert_allclose(course, full * (1 - np.exp(-3 * k * age)), rtol=1e-9, atol=1e-12)


def test_an_estimator_reads_no_temperature_and_looks_for_no_pace() -> None:
    assert not [n for n in searched_parameters(WARM) if "pace" in n]


def _law() -> tuple[list[ca.SX], list[ca.SX]]:
    """Temperature and pace; the torque at fixed sizes, going forwards at .7 rad/s."""
    temperature, pace = ca.SX.sym("temperature"), ca.SX.sym("pace")
    signals = {f.name: 0.0 for f in fields(LocalSignals)}
    signals |= {"temperature": temperature, "direction": 1.0, "velocity": 0.7, "memory": ()}
    values = SimpleNamespace(thermal_coulomb=-6.0, thermal_viscous=0.5, thermal_pace=pace)
    return [temperature, pace], [DECLARED.law(LocalSignals(**signals), values)]
