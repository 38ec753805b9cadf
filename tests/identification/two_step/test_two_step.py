"""Two-step identification: friction of table 4.6, sign condition, bound, joint models, the
on-line algorithm.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from casadi_models.thesis import model_ts
from identification.errors import InputError
from identification.two_step.algorithm import (
    JOINT_CHANNELS,
    Coefficient,
    Mode,
    OnlineSettings,
    SeparableModel,
    Shape,
    TwoStep,
    TwoStepOutcome,
    TwoStepSettings,
    from_casadi,
    from_joint,
    smooth_friction,
)
from identification.two_step.online import PortionedTask, Window
from identification.two_step.varpro_search import Method

FloatArray = npt.NDArray[np.float64]

T = np.arange(2000) * 0.01
SINE = 0.262 * np.sin(2 * np.pi * T / 1.9)
TRUE = {"b": 9.0, "C1": 29.0, "C2": 480.0, "w1": 0.0595, "wS": 0.0251}


def friction(
    w: FloatArray, c2: float = 480.0, linear: float = 1.0, shape: float = 1.0
) -> FloatArray:
    """Table 4.6, linear and shape parameters multiplied."""
    return linear * (
        9 * w + 29 * np.tanh(w / (0.0595 * shape)) + c2 * w * np.exp(-np.abs(w) / (0.0251 * shape))
    )


def noisy(seed: int, w: FloatArray = SINE, c2: float = 480.0, noise: float = 0.01) -> FloatArray:
    clean = friction(w, c2)
    return clean + noise * np.abs(clean).max() * np.random.default_rng(seed).standard_normal(len(w))


def numpy_model() -> SeparableModel:
    """The same friction without CasADi: derivative by differences."""
    return SeparableModel(
        columns=lambda s, e: np.column_stack(
            [s[:, 0], np.tanh(s[:, 0] / e[0]), s[:, 0] * np.exp(-np.abs(s[:, 0]) / e[1])]
        ),
        coefficients=(
            Coefficient("b", "", True),
            Coefficient("C1", "", True),
            Coefficient("C2", "", True),
        ),
        shapes=(Shape("w1", 0.005, 0.5, 0.05), Shape("wS", 0.002, 0.2, 0.02)),
    )


def test_clean_data_give_the_parameters_of_table_4_6() -> None:
    found = TwoStep(smooth_friction(SINE)).fit(friction(SINE), SINE)
    assert found.values == pytest.approx(TRUE, rel=1e-4)
    assert found.outcome is TwoStepOutcome.FITTED
    assert found.frozen == found.negative == ()


def test_a_numpy_model_gives_the_same_as_a_casadi_one() -> None:
    y = noisy(1)
    boxes = {"w1": (0.005, 0.5), "wS": (0.002, 0.2)}
    one = TwoStep(smooth_friction(SINE).with_boxes(boxes)).fit(y, SINE)
    other = TwoStep(numpy_model()).fit(y, SINE)
    assert other.values == pytest.approx(one.values, rel=1e-3)
    assert other.sum_of_squares == pytest.approx(one.sum_of_squares, rel=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_variable_projection_beats_the_alternating_form_and_agrees_with_direct(seed: int) -> None:
    from scipy.optimize import direct

    from identification.two_step.varpro import Projection

    y, model = noisy(seed), smooth_friction(SINE)
    best = TwoStep(model).fit(y, SINE)
    thesis = TwoStep(model, "alternating", settings=TwoStepSettings(passes=8)).fit(y, SINE)
    assert best.sum_of_squares < thesis.sum_of_squares
    assert best.evaluations <= 600
    assert thesis.evaluations > best.evaluations
    problem = Projection(model, y[:, None], SINE[:, None], np.ones(1), 10**6)
    box = list(zip(problem.low, problem.high, strict=True))
    check = direct(problem.objective, box, locally_biased=True, maxfun=400)
    assert best.sum_of_squares <= 2 * check.fun * (1 + 1e-9)


def test_evaluations_are_counted_and_kept_to_the_budget() -> None:
    calls = []
    plain = numpy_model()

    def columns(s: FloatArray, e: FloatArray) -> FloatArray:
        calls.append(1)
        return plain.columns(s, e)

    def slope(s: FloatArray, e: FloatArray, theta: FloatArray) -> FloatArray:
        calls.append(1)
        return plain.gradient(s, e, theta)

    model = SeparableModel(columns, plain.coefficients, plain.shapes, sensitivity=slope)
    settings = TwoStepSettings(max_evaluations=120)
    found = TwoStep(model, settings=settings).fit(noisy(0), SINE)
    assert found.evaluations <= 120 + 4  # four more for the bound at the end
    assert found.evaluations == len(calls)


def test_the_same_data_give_the_same_fit() -> None:
    y = noisy(3)
    one, other = (TwoStep(smooth_friction(SINE, exponent=True)).fit(y, SINE) for _ in range(2))
    assert one.values == other.values
    assert one.evaluations == other.evaluations


def test_a_negative_coefficient_is_reported_and_the_fit_repeated() -> None:
    y = noisy(0, c2=-150.0)
    free = TwoStep(
        smooth_friction(SINE), settings=TwoStepSettings(non_negative=False, freeze=False)
    ).fit(y, SINE)
    held = TwoStep(smooth_friction(SINE), settings=TwoStepSettings(freeze=False)).fit(y, SINE)
    assert free.linear["C2"] < 0
    assert "C2" in held.negative
    assert held.outcome is TwoStepOutcome.NON_NEGATIVE
    assert min(held.linear.values()) >= 0
    assert held.sum_of_squares >= free.sum_of_squares
    assert held.evaluations <= 604


def test_the_bound_is_the_spread_of_repeated_fits() -> None:
    model = smooth_friction(SINE)
    start = {"w1": 0.0595, "wS": 0.0251}
    fits = [TwoStep(model).fit(noisy(s, noise=0.001), SINE, start=start) for s in range(60)]
    for name in TRUE:
        spread = float(np.std([f.values[name] for f in fits], ddof=1))
        stated = float(np.median([f.deviation[name] for f in fits]))
        assert 0.7 < spread / stated < 1.4, name


def test_the_bound_has_its_known_size() -> None:
    """Relative deviations of b, C1, C2, w1, wS at 1 % noise: 0.03, 0.002, 0.10, 0.13, 0.20
    (rounded).
    """
    clean = friction(SINE)
    found = TwoStep(smooth_friction(SINE)).fit(
        clean + 0.01 * clean.max() * np.sqrt(2) * np.sin(np.arange(2000)), SINE
    )
    relative = {n: found.deviation[n] / v for n, v in found.values.items()}
    known = {"b": 0.03, "C1": 0.002, "C2": 0.10, "w1": 0.13, "wS": 0.20}
    for name, value in known.items():
        assert relative[name] == pytest.approx(value, rel=0.3), name


def test_shapes_that_constant_speed_cannot_show_are_flagged_and_frozen() -> None:
    w = 0.785 * np.sign(np.sin(2 * np.pi * T / 4))
    model = smooth_friction(SINE).with_boxes({"w1": (0.005, 0.5), "wS": (0.002, 0.2)})
    y = noisy(0, w)
    found = TwoStep(model).fit(y, w)
    assert set(found.unidentifiable) == {"w1", "wS"}
    assert set(found.frozen) == {"w1", "wS"}
    assert found.outcome in (TwoStepOutcome.FROZEN, TwoStepOutcome.RANK_DEFICIENT)
    nominal = dict(zip(model.shape_names, model.nominal.tolist(), strict=True))
    assert found.nonlinear == pytest.approx(nominal)


def test_a_shape_is_not_frozen_where_that_makes_the_fit_worse() -> None:
    y = noisy(2)
    model = smooth_friction(SINE)
    strict = TwoStep(model, settings=TwoStepSettings(unidentifiable=1e-6)).fit(y, SINE)
    assert strict.unidentifiable
    free = TwoStep(model, settings=TwoStepSettings(freeze=False)).fit(y, SINE)
    assert strict.sum_of_squares <= free.sum_of_squares * (1 + 20 / len(y))


def test_rows_with_nan_are_left_out() -> None:
    y = friction(SINE)
    y[10:30] = np.nan
    found = TwoStep(smooth_friction(SINE)).fit(y, SINE)
    assert (found.samples, found.dropped) == (1980, 20)
    assert found.values == pytest.approx(TRUE, rel=1e-4)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda: TwoStep(smooth_friction(SINE), "simplex"), "unknown method"),
        (
            lambda: TwoStep(smooth_friction(SINE)).fit(friction(SINE)[:3], SINE[:3]),
            "usable samples",
        ),
        (lambda: TwoStep(smooth_friction(SINE)).fit(friction(SINE), SINE[:5]), "shape"),
        (lambda: TwoStep(smooth_friction(SINE), weights=[-1.0]), "weights"),
        (lambda: smooth_friction(np.zeros(10)), "does not move"),
        (lambda: Shape("w", 0.0, np.inf, 1.0), "finite"),
        (lambda: smooth_friction(SINE).with_boxes({"w9": (1, 2)}), "w9"),
        (lambda: TwoStepSettings(max_evaluations=1), "max_evaluations"),
        (lambda: OnlineSettings(search="later"), "search"),  # type: ignore[arg-type]
    ],
)
def test_bad_input_is_one_line(action: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        action()
    assert "\n" not in str(caught.value)


def test_from_joint_reproduces_the_inverse_dynamics() -> None:
    model = model_ts()
    rng = np.random.default_rng(0)
    signals = rng.normal(size=(20, len(JOINT_CHANNELS))) * [0.5, 0.3, 2.0, 0.5, 0.3, 2.0]
    signals[:, 3] = signals[:, 0] + 1e-3 * rng.normal(size=20)
    separable = from_joint(model, signals)
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    eta = np.array([values[n] for n in separable.shape_names])
    theta = np.array([values[n] for n in separable.names])
    got = separable.matrix(signals, eta) @ theta + separable.remainder(signals, eta)
    for row, y in zip(signals, got, strict=True):
        matrix, rest = model.regressor(
            row[[0, 1, 3, 4]], row[[2, 5]], np.zeros(3), model.value_vector()
        )
        linear = np.array([values[n] for n in model.linear_parameters])
        expected = (np.array(matrix) @ linear) + np.array(rest).ravel()
        assert y == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert all(s.low > 0 for s in separable.shapes if "velocity" in s.name)


def test_the_derivative_of_a_casadi_model_is_that_of_differences() -> None:
    model = smooth_friction(SINE, exponent=True)
    eta, theta = np.array([0.06, 0.025, 1.2]), np.array([9.0, 29.0, 480.0])
    signals = SINE[:300, None]
    plain = SeparableModel(model.columns, model.coefficients, model.shapes)
    assert model.gradient(signals, eta, theta) == pytest.approx(
        plain.gradient(signals, eta, theta), rel=1e-4, abs=1e-5
    )


# --- on line --------------------------------------------------------------------------------------

DT = 4e-3
ONLINE = OnlineSettings(
    sample_time=DT, collect_seconds=4.0, confirm_seconds=2.0, evaluations_per_step=5
)


def online_data(
    seconds: float, linear: float, shape: float, at: float
) -> tuple[FloatArray, FloatArray]:
    t = np.arange(round(seconds / DT)) * DT
    w = 0.2 * np.sin(2 * np.pi * t / 1.9) + 0.1 * np.sin(2 * np.pi * t / 0.61)
    y = np.where(t < at, friction(w), friction(w, linear=linear, shape=shape))
    return y + 0.05 * np.random.default_rng(0).standard_normal(len(t)), w


def run(two: TwoStep, y: FloatArray, w: FloatArray) -> FloatArray:
    return np.array([two.update([a], [b]) for a, b in zip(y, w, strict=True)])


def test_a_linear_step_is_followed_without_a_search() -> None:
    y, w = online_data(14.0, 1.3, 1.0, 7.0)
    two = TwoStep(smooth_friction(w), online=ONLINE)
    path = run(two, y, w)
    assert two.searches == 0
    assert two.mode is Mode.RECURSIVE
    assert path[round(8.5 / DT) :, 1] == pytest.approx(1.3 * 29.0, rel=0.05)


def test_a_change_of_the_shapes_is_found_after_one_search() -> None:
    y, w = online_data(14.0, 1.0, 1.2, 7.0)
    two = TwoStep(smooth_friction(w), online=ONLINE)
    run(two, y, w)
    assert two.searches == 1
    assert two.values["w1"] == pytest.approx(1.2 * 0.0595, rel=0.05)
    assert two.values["wS"] == pytest.approx(1.2 * 0.0251, rel=0.08)


def test_state_and_restore_go_on_bit_by_bit_also_in_a_search() -> None:
    y, w = online_data(14.0, 1.0, 1.2, 7.0)
    slow = OnlineSettings(
        sample_time=DT, collect_seconds=4.0, confirm_seconds=2.0, evaluations_per_step=1
    )
    two = TwoStep(smooth_friction(w), online=slow)
    at = 0
    while two.mode is not Mode.REOPTIMISING:
        two.update([y[at]], [w[at]])
        at += 1
    for _ in range(7):
        two.update([y[at]], [w[at]])
        at += 1
    assert two.mode is Mode.REOPTIMISING
    other = TwoStep(smooth_friction(w), online=slow)
    other.restore(two.state())
    assert np.array_equal(run(two, y[at:], w[at:]), run(other, y[at:], w[at:]))
    assert np.array_equal(two.nonlinear, other.nonlinear)
    assert [e.sample for e in two.events] == [e.sample for e in other.events]
    assert two.state() == other.state()


@pytest.mark.parametrize("search", ["blocking", "background"])
def test_other_ways_to_search_end_at_the_same_shapes(search: str) -> None:
    y, w = online_data(5.0, 1.0, 1.0, 9.0)
    settings = OnlineSettings(sample_time=DT, collect_seconds=4.0, search=search)  # type: ignore[arg-type]
    two = TwoStep(smooth_friction(w), online=settings)
    run(two, y, w)
    give_up = time.monotonic() + 20
    while two.mode is Mode.STARTING and time.monotonic() < give_up:
        time.sleep(0.01)
        two.update([y[-1]], [w[-1]])
    assert two.mode is Mode.RECURSIVE
    assert two.values["w1"] == pytest.approx(0.0595, rel=0.05)


def test_nan_and_standstill_leave_a_finite_state() -> None:
    y, w = online_data(6.0, 1.0, 1.0, 9.0)
    two = TwoStep(smooth_friction(w), online=ONLINE)
    y[100:120] = np.nan
    run(two, y, w)
    still = run(two, np.full(500, 0.0), np.zeros(500))
    assert np.isfinite(still).all()
    assert np.isfinite(two.update([np.nan], [np.inf])).all()


def _spoiled(kind: str) -> SeparableModel:
    """The friction with columns that cannot be used."""

    def columns(signals: FloatArray, eta: FloatArray) -> FloatArray:
        if kind == "raises":
            raise ZeroDivisionError("no torque")
        good = numpy_model().columns(signals, eta)
        return (
            good[:, :2]
            if kind == "shape"
            else np.where(eta[0] < 0.02, np.nan, good)
            if kind == "partly"
            else good * np.nan
        )

    return replace(numpy_model(), columns=columns)


@pytest.mark.parametrize("method", ["variable_projection", "alternating"])
@pytest.mark.parametrize(
    ("kind", "error", "words"),
    [
        ("raises", ZeroDivisionError, "no torque"),
        ("nan", InputError, "phi is not finite at"),
        ("partly", InputError, "phi is not finite at"),
        ("shape", InputError, r"phi has shape \(2000, 1, 2\); give \(2000, 1, 3\)"),
    ],
)
def test_a_model_that_raises_or_gives_nan_says_where(
    method: Method, kind: str, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words) as caught:
        TwoStep(_spoiled(kind), method).fit(friction(SINE), SINE)
    assert "\n" not in str(caught.value)
    if kind == "raises" and method == "variable_projection":
        assert caught.value.__notes__[0].startswith("mcs: raised by the objective at evaluation 1")


def test_a_model_that_gives_nan_on_line_is_one_line() -> None:
    y, w = online_data(6.0, 1.0, 1.0, 9.0)
    two = TwoStep(_spoiled("nan"), online=ONLINE)
    with pytest.raises(InputError, match=r"phi is not finite on the first window; check the model"):
        run(two, y, w)


@pytest.mark.parametrize(
    "box", [(0.005, np.inf), (-np.inf, 0.5), (np.nan, 0.5), (0.5, 0.5), (0.1, 0.5)]
)
def test_boxes_of_shapes_are_finite_and_hold_the_nominal_value(box: tuple[float, float]) -> None:
    with pytest.raises(
        InputError,
        match=r"shape parameter w1: box .* give finite low < high with the nominal value inside",
    ):
        Shape("w1", *box, 0.05)


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_a_constant_channel_is_a_named_outcome(level: float) -> None:
    found = TwoStep(numpy_model()).fit(np.full(500, 3.0 * level), np.full(500, level))
    assert found.outcome is TwoStepOutcome.RANK_DEFICIENT
    assert found.unidentifiable == ("w1", "wS")
    assert np.isfinite(list(found.values.values())).all()


def test_a_start_that_is_nan_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"TwoStep\.fit: the start value of w1 is nan; give a finite number"
    ):
        TwoStep(numpy_model()).fit(friction(SINE), SINE, start={"w1": np.nan, "wS": 0.02})


def test_a_window_without_rank_is_extended_and_named() -> None:
    y, w = online_data(5.0, 1.0, 1.0, 9.0)
    two = TwoStep(smooth_friction(w), online=ONLINE)
    run(two, np.zeros(1200), np.zeros(1200))
    assert two.mode is Mode.COLLECTING
    assert any("C1" in e.why for e in two.events)
    run(two, y, w)
    assert two.mode is Mode.RECURSIVE


def test_reset_forgets() -> None:
    y, w = online_data(5.0, 1.0, 1.0, 9.0)
    two = TwoStep(smooth_friction(w), online=ONLINE)
    fresh = two.state()
    first = run(two, y, w)
    two.reset()
    assert two.state() == fresh
    assert np.array_equal(run(two, y, w), first)


@pytest.mark.parametrize(
    "change", [lambda s: s[:-1], lambda s: b"x" * len(s), lambda s: s[:40] + b"?" + s[41:]]
)
def test_damaged_states_are_refused(change: Callable[[bytes], bytes]) -> None:
    two = TwoStep(smooth_friction(SINE))
    with pytest.raises(InputError, match="restore"):
        two.restore(change(two.state()))


def test_an_effect_that_the_model_lacks_ends_in_a_note_not_in_a_loop() -> None:
    y, w = online_data(20.0, 1.0, 1.0, 9.0)
    y[2000:] += 3.0 * np.sin(2 * np.pi * 9.0 * np.arange(len(y) - 2000) * DT)
    two = TwoStep(smooth_friction(w), online=ONLINE)
    run(two, y, w)
    assert 1 <= two.searches <= 4
    assert any("may lack an effect" in e.why for e in two.events)


def test_a_portioned_task_makes_as_many_steps_as_granted() -> None:
    done: list[int] = []

    def work(tick: Callable[[], None]) -> int:
        for i in range(5):
            tick()
            done.append(i)
        return len(done)

    before = threading.active_count()
    task = PortionedTask(work, free=False)
    assert not task.advance(2)
    assert done == [0, 1]
    assert task.advance(10)
    assert task.result() == 5
    other = PortionedTask(work, free=False)
    other.cancel()
    assert threading.active_count() == before


def test_the_window_holds_the_last_samples_in_order() -> None:
    window = Window(4, 1, 1)
    for i in range(11):
        window.add(np.array([float(i)]), np.array([10.0 * i]))
    y, s = window.last(3)
    assert y.ravel().tolist() == [8.0, 9.0, 10.0]
    assert s.ravel().tolist() == [80.0, 90.0, 100.0]


def test_two_outputs_that_share_parameters_are_weighted_by_their_noise() -> None:
    s, eta = ca.SX.sym("s", 1), ca.SX.sym("eta", 1)
    phi = ca.vertcat(ca.horzcat(ca.tanh(s / eta), s), ca.horzcat(ca.tanh(s / eta), 0))
    model = from_casadi(
        ca.Function("two", [s, eta], [phi]),
        [Coefficient("a"), Coefficient("b")],
        [Shape("w", 0.01, 1.0, 0.1)],
    )
    rng = np.random.default_rng(0)
    y = model.matrix(SINE[:, None], np.array([0.06])) @ np.array([5.0, 3.0])
    y += rng.normal(size=y.shape) * [0.01, 1.0]
    found = TwoStep(model).fit(y, SINE)
    assert found.linear["a"] == pytest.approx(5.0, abs=4 * found.deviation["a"])
    assert found.residual_deviation == pytest.approx([0.01, 1.0], rel=0.1)
    assert found.deviation["a"] < 0.01
