"""Simulation: convergence, analytic motions, sensor readings, internal states."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp

from casadi_models import JointModel
from casadi_models.functions import JointFunctions
from casadi_models.simulate import Trajectory, sampled_step, simulate

FloatArray = npt.NDArray[np.float64]
MASSES = {"motor_inertia": 4.447, "link_inertia": 10.277, "stiffness": 2.1513e4}


def smooth_joint() -> JointModel:
    model = JointModel.harmonic_drive(4).add("gravity").add("viscous").add("cubic_stiffness")
    return model.with_values(
        {
            **MASSES,
            "structural_damping": 20.0,
            "gravity_torque": -105.18,
            "motor_viscous": 23.6,
            "link_viscous": 9.7,
            "cubic_stiffness": 3.3543e8,
            "kinematic_error_sine": 2e-4,
            "kinematic_error_cosine_2": 1e-4,
        }
    )


def end_state(
    model: JointModel, substeps: int, *, samples: int = 41, dt: float = 5e-3
) -> FloatArray:
    start = np.zeros(4 + len(model.functions.memory_names))
    start[:4] = [0.402, 0.5, 0.4, 0.5]
    drive = 40 * np.sin(np.arange(samples) * 0.3)
    last: FloatArray = simulate(model, drive, dt, substeps=substeps, x0=start).states[-1]
    return last


def order_of(model: JointModel, coarse: int, reference: int) -> float:
    exact = end_state(model, reference)
    errors = [np.linalg.norm(end_state(model, n) - exact) for n in (coarse, 2 * coarse)]
    return math.log2(float(errors[0] / errors[1]))


def test_fourth_order_in_the_step() -> None:
    assert order_of(smooth_joint(), 8, 128) == pytest.approx(4.0, abs=0.15)


def test_second_order_with_an_oscillator() -> None:
    model = (
        smooth_joint()
        .add("flexible_mode@link")
        .with_values({"link_flexible_inertia": 1.5, "link_flexible_frequency": 11.0})
    )
    assert order_of(model, 8, 512) == pytest.approx(2.0, abs=0.2)


def test_against_another_integrator() -> None:
    model = smooth_joint()
    f, p = model.functions, model.value_vector()
    start = np.array([0.402, 0.5, 0.4, 0.5])
    u = np.array([60.0, 0.0, 0.0])
    run = simulate(model, np.full(201, 60.0), 2e-3, substeps=10, x0=start)
    other = solve_ivp(
        lambda t, x: np.array(f.dynamics(x, u, p)).ravel(),
        (0, 0.4),
        start,
        rtol=1e-11,
        atol=1e-13,
        method="DOP853",
    )
    assert run.states[-1] == pytest.approx(other.y[:, -1], rel=1e-7, abs=1e-8)


@pytest.mark.parametrize(
    ("label", "values", "tolerance"),
    [
        (
            "flexible_mode@link",
            {"link_flexible_inertia": 1.5, "link_flexible_frequency": 11.0},
            1e-6,
        ),
        ("lugre@motor", {"motor_presliding_torque": 10.0, "motor_presliding_distance": 1e-3}, 2e-3),
    ],
)
def test_step_form_and_continuous_form_move_alike(
    label: str, values: dict[str, float], tolerance: float
) -> None:
    model = smooth_joint().add(label)
    model = model.with_values(
        values | ({"motor_smoothing_velocity": 0.05} if "lugre" in label else {})
    )
    f, p = model.functions, model.value_vector()
    start = np.concatenate([[0.402, 0.5, 0.4, 0.5], np.zeros(len(f.memory_names))])
    run = simulate(model, np.full(201, 60.0), 1e-3, substeps=20, x0=start)
    other = solve_ivp(
        lambda t, x: np.array(f.dynamics(x, [60.0, 0, 0], p)).ravel(),
        (0, 0.2),
        start,
        rtol=1e-10,
        atol=1e-12,
        method="LSODA",
    )
    assert run.states[-1] == pytest.approx(other.y[:, -1], rel=tolerance, abs=tolerance)


def test_constant_drive_on_a_rigid_joint() -> None:
    model = JointModel(gear_ratio=-160.0).with_values({"motor_inertia": 4.0, "link_inertia": 6.0})
    run = simulate(model, np.full(101, 5.0), 0.01)
    assert run.states[-1] == pytest.approx([0.5 * 0.5, 0.5], rel=1e-12)
    assert run.readings[-1, 4] == pytest.approx(6.0 * 0.5, rel=1e-12)
    assert run.time[-1] == pytest.approx(1.0)


def test_viscous_decay() -> None:
    model = (
        JointModel(inertias=("inertia",))
        .add("viscous")
        .with_values({"inertia": 10.0, "motor_viscous": 20.0})
    )
    run = simulate(model, np.zeros(101), 0.01, x0=np.array([0.0, 1.0]))
    assert run.states[-1, 1] == pytest.approx(math.exp(-2.0), rel=1e-9)


def test_small_swing_of_a_hanging_link() -> None:
    """Tg < 0 hangs: small oscillation at sqrt(-Tg/J); Tg > 0 is upright and falls."""
    hanging = (
        JointModel(inertias=("inertia",))
        .add("gravity")
        .with_values({"inertia": 10.0, "gravity_torque": -40.0})
    )
    period = 2 * math.pi / 2.0
    run = simulate(hanging, np.zeros(101), period / 100, x0=np.array([1e-4, 0.0]))
    assert run.states[-1, 0] == pytest.approx(1e-4, rel=1e-6)
    upright = simulate(
        hanging.with_values({"gravity_torque": 40.0}), np.zeros(101), 0.01, x0=np.array([1e-4, 0.0])
    )
    assert upright.states[-1, 0] == pytest.approx(1e-4 * math.cosh(2.0), rel=1e-6)


def test_twist_under_static_load() -> None:
    """At rest under a balancing drive the twist is T/k and the sensor reads T."""
    model = (
        JointModel.harmonic_drive(3)
        .add("gravity")
        .with_values({**MASSES, "gravity_torque": -100.0})
    )
    q = 0.6
    torque = 100 * math.sin(q)
    start = np.array([q + torque / 2.1513e4, 0, q, 0])
    run = simulate(model, np.full(50, torque), 1e-3, x0=start)
    assert run.states[-1] == pytest.approx(start, abs=1e-12)
    assert run.readings[-1, 4] == pytest.approx(torque, rel=1e-9)


def test_temperature_reaches_the_friction() -> None:
    model = JointModel(inertias=("inertia",)).add("viscous").add("thermal_friction")
    model = model.with_values(
        {"inertia": 10.0, "motor_viscous": 20.0, "motor_thermal_viscous": -0.5}
    )
    warm = simulate(
        model, np.zeros(101), 0.01, x0=np.array([0.0, 1.0]), temperature=np.full(101, 20.0)
    )
    assert warm.states[-1, 1] == pytest.approx(math.exp(-1.0), rel=1e-9)


def test_input_is_held_and_sampled_step_repeats_it() -> None:
    model = smooth_joint()
    drive = np.array([10.0, -20.0, 30.0])
    run = simulate(model, drive, 1e-3, x0=np.array([0.4, 0, 0.4, 0]))
    x = np.array([0.4, 0, 0.4, 0])
    step = sampled_step(model, 1e-3)
    for k in range(2):
        x = np.array(step(x, [drive[k], 0, k * 1e-3], model.value_vector())).ravel()
        assert run.states[k + 1] == pytest.approx(x, rel=1e-14)


# --- sensors --------------------------------------------------------------------------------------


def driven(model: JointModel) -> Trajectory:
    return simulate(model, 60 * np.sin(np.arange(600) * 0.02), 1e-3, x0=np.zeros(4))


def test_torque_sensor_errors_are_in_the_readings_only() -> None:
    plain = smooth_joint()
    faulty = (
        plain.add("torque_sensor_gain")
        .add("torque_sensor_offset")
        .with_values({"torque_sensor_gain": 0.05, "torque_sensor_offset": 3.0})
    )
    true, shown = driven(plain), driven(faulty)
    assert shown.states == pytest.approx(true.states, rel=1e-12, abs=1e-15)
    assert shown.readings[:, :4] == pytest.approx(true.readings[:, :4], rel=1e-12, abs=1e-15)
    assert shown.readings[:, 4] == pytest.approx(
        1.05 * (true.readings[:, 4] + 3.0), rel=1e-9, abs=1e-9
    )


@pytest.mark.parametrize(("place", "column"), [("link_position_sensor", 2), ("torque_sensor", 4)])
def test_a_late_channel_is_late(place: str, column: int) -> None:
    """The reading is the true channel some samples earlier, to second order in the delay."""
    plain = smooth_joint().with_values(
        {"kinematic_error_sine": 0.0, "kinematic_error_cosine_2": 0.0}
    )
    late = plain.add(f"channel_delay@{place}").with_values({f"{place}_delay": 2e-3})
    true, shown = driven(plain).readings[:, column], driven(late).readings[:, column]
    error_late = np.abs(shown[100:] - true[98:-2]).max()
    error_plain = np.abs(shown[100:] - true[100:]).max()
    assert error_late < 0.15 * error_plain


def test_a_late_link_encoder_reads_what_was_true_a_moment_before() -> None:
    """Readings of a model whose clocks are calibrated: the true value less the skew times its
    rate, acceleration of the moment included.
    """
    late = 3e-4
    names = ("link_encoder_zero", "link_encoder_skew", "torque_sensor_skew")
    plain = JointModel.harmonic_drive("hd3")
    model = replace(plain, calibration=names)
    values = dict.fromkeys(plain.parameter_names, 1.0) | {"stiffness": 2e4}
    on_time = {**values, **dict.fromkeys(names, 0.0)}
    skewed = {**on_time, "link_encoder_skew": late}
    x, u = [0.3, 0.4, 0.299, 0.38], [5.0, 0.0, 0.0]

    def asked(function: str, chosen: dict[str, float]) -> np.ndarray:
        p = [chosen[n] for n in model.parameter_names]
        return np.array(getattr(model.functions, function)(x, u, p)).ravel()

    rates = asked("dynamics", skewed)
    assert np.array_equal(rates, asked("dynamics", on_time))  # states are true values
    true, read = asked("outputs", on_time), asked("outputs", skewed)
    assert read[2] == pytest.approx(true[2] - late * rates[2], abs=1e-12)
    assert read[3] == pytest.approx(true[3] - late * rates[3], abs=1e-12)
    assert np.array_equal(np.delete(read, [2, 3]), np.delete(true, [2, 3]))


@pytest.mark.parametrize("kind", ["hd1", "hd3"], ids=["rigid", "elastic"])
def test_a_torque_from_elsewhere_turns_the_link_its_own_way(kind: str) -> None:
    """By Newton: over the link's inertia, or over all of it where the joint is rigid."""
    plain = JointModel.harmonic_drive(kind)
    values = {n: MASSES.get(n, 0.0) for n in plain.parameter_names}
    functions = JointFunctions(plain, open_to_disturbances=True)
    state = np.zeros(4 if plain.is_elastic else 2)

    def rates(push: list[float]) -> FloatArray:
        given = [values[n] for n in plain.parameter_names]
        return np.array(functions.disturbed(state, [0.0, 0.0, 0.0], given, push)[0]).ravel()

    pushed = rates([0.0, 7.0]) - rates([0.0, 0.0])
    if plain.is_elastic:
        assert pushed == pytest.approx([0.0, 0.0, 0.0, 7.0 / MASSES["link_inertia"]])
        twisted = rates([7.0, 0.0]) - rates([0.0, 0.0])
        against = [0.0, -7.0 / MASSES["motor_inertia"], 0.0, 7.0 / MASSES["link_inertia"]]
        assert twisted == pytest.approx(against)
    else:
        whole = sum(v for n, v in values.items() if n.endswith("inertia"))
        assert pushed == pytest.approx([0.0, 7.0 / whole])
