"""The joint as a whole: energy, linear set, sensors, load, linearisation."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import JointModel, Parameter, Signals, amplitude, shape, signed
from casadi_models.equations import time_derivative
from casadi_models.joint import inverse_dynamics
from casadi_models.simulate import simulate
from casadi_models.thesis import model_2b, model_ts

FloatArray = npt.NDArray[np.float64]

TABLE_4_3 = {"motor_inertia": 4.447, "link_inertia": 10.277, "stiffness": 2.1513e4}
SPRINGS: dict[str, dict[str, float]] = {
    "gravity": {"gravity_torque": 105.18, "gravity_cosine": -30.0},
    "gravity_upright": {"gravity_torque": -105.18},
    "cubic_stiffness": {"cubic_stiffness": 3.3543e8},
    "soft_windup": {"soft_windup_torque": 4.0, "soft_windup_width": 4e-4},
    "added_spring@motor": {"motor_added_spring": 86.2},
    "added_spring@link": {"link_added_spring": 86.2},
    "cyclic_torque@link": {"link_cyclic_torque_sine": 3.7, "link_cyclic_torque_cosine": -1.2},
    "cyclic_torque@motor": {"motor_cyclic_torque_sine": 3.7, "motor_cyclic_torque_cosine": -1.2},
    "torque_ripple": {"ripple_sine": 2.0, "ripple_cosine": 1.0, "ripple_order": 2.0},
    "torque_sensor_compliance": {"sensor_compliance": 2e-5},
    "extra_inertia@link": {"link_extra_inertia": 2.0},
    "extra_inertia@motor": {"motor_extra_inertia": 1.0},
}
KINKED: dict[str, dict[str, float]] = {
    "piecewise_stiffness": {
        "stiffness_step_1": 9e3,
        "stiffness_step_2": 7e3,
        "stiffness_knot_1": 5e-4,
        "stiffness_knot_2": 1e-3,
    },
    "backlash": {"backlash": 4e-4, "backlash_stiffness_loss": 2.1513e4},
}
ERRORS = {
    "kinematic_error_sine": 2e-4,
    "kinematic_error_cosine": 5e-5,
    "kinematic_error_sine_2": 1e-4,
    "kinematic_error_cosine_2": -5e-5,
    "kinematic_error_sine_3": 3e-5,
    "kinematic_error_cosine_3": 2e-5,
}


def conservative(number: int, *labels: str, values: dict[str, float]) -> JointModel:
    model = JointModel.harmonic_drive(number)
    for label in labels:
        model = model.add(label)
    return model.with_values({**TABLE_4_3, **(ERRORS if number == 4 else {}), **values})


def drift(model: JointModel, *, samples: int = 400, substeps: int = 20) -> float:
    """Largest change of the energy on a free motion, relative to the energy that is exchanged."""
    start = np.array([0.4 + 2.5e-3, 0.3, 0.4, -0.2])
    run = simulate(model, np.zeros(samples), 2e-3, substeps=substeps, x0=start)
    p = model.value_vector()
    energy = np.array(model.energy.map(samples)(run.states.T, p)).ravel()
    kinetic = 0.5 * (
        run.states[:, [1, 3]] ** 2
        @ np.array([TABLE_4_3["motor_inertia"], TABLE_4_3["link_inertia"]])
    )
    assert np.ptp(kinetic) > 0.05
    return float(np.ptp(energy) / np.ptp(kinetic))


# --- energy ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [3, 4])
@pytest.mark.parametrize("label", list(SPRINGS))
def test_energy_is_kept_without_friction_and_drive(number: int, label: str) -> None:
    assert drift(conservative(number, label, values=SPRINGS[label])) < 1e-7


@pytest.mark.parametrize("label", list(KINKED))
def test_energy_is_kept_across_kinks(label: str) -> None:
    """At a kink the integrator falls to a lower order: its tolerance is wider, and falls with
    the step.
    """
    model = conservative(3, label, values=KINKED[label])
    coarse, fine = drift(model, substeps=20), drift(model, substeps=160)
    assert coarse < 1e-4
    assert fine < 2e-6


def test_energy_is_kept_with_everything_at_once() -> None:
    labels = [k for k in SPRINGS if k not in ("gravity_upright", "torque_sensor_compliance")]
    values = {k: v for label in labels for k, v in SPRINGS[label].items()}
    assert drift(conservative(4, *labels, values=values)) < 1e-7


def test_thesis_approximation_does_not_keep_energy() -> None:
    model = conservative(4, "gravity", values=SPRINGS["gravity"])
    assert drift(model) < 1e-7
    assert drift(replace(model, virtual_work=False)) > 1e-3


def test_power_balance_with_drive() -> None:
    """dE/dt = drive power less friction power, on random states of model 2b."""
    model = model_2b()
    f, p = model.functions, model.value_vector()
    x = ca.SX.sym("x", 4)
    slope = ca.Function("slope", [x], [ca.jacobian(model.energy(x, p), x)])
    v = dict(zip(model.parameter_names, p, strict=True))
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(-1, 1)
        at = np.array([q + rng.uniform(-2e-3, 2e-3), rng.uniform(-1, 1), q, rng.uniform(-1, 1)])
        drive = rng.uniform(-100, 100)
        rate = float(
            np.array(slope(at)).ravel() @ np.array(f.dynamics(at, [drive, 0, 0], p)).ravel()
        )
        lost = v["motor_viscous"] * at[1] ** 2 + v["link_viscous"] * at[3] ** 2
        lost += v["motor_coulomb"] * at[1] * math.tanh(at[1] / v["motor_smoothing_velocity"])
        lost += v["link_coulomb"] * at[3] * math.tanh(at[3] / v["link_smoothing_velocity"])
        assert rate == pytest.approx(drive * at[1] - lost, rel=1e-9, abs=1e-8)


def test_energy_of_a_law_without_potential_is_its_integral(monkeypatch: pytest.MonkeyPatch) -> None:
    model = conservative(3, "cubic_stiffness", values=SPRINGS["cubic_stiffness"])
    bare = replace(
        model,
        terms=tuple(replace(t, effect=replace(t.effect, potential=None)) for t in model.terms),
    )
    state = np.array([0.4 + 2e-3, 0.3, 0.4, -0.2])
    assert float(bare.energy(state, bare.value_vector())) == pytest.approx(
        float(model.energy(state, model.value_vector())), rel=1e-12
    )


# --- linear set -----------------------------------------------------------------------------------


def test_linear_set_takes_amplitudes_and_leaves_shapes() -> None:
    model = JointModel.harmonic_drive(3).add("gravity").add("coulomb").add("stribeck")
    linear = set(model.linear_parameters)
    assert {
        "motor_stribeck_extra",
        "motor_coulomb",
        "link_coulomb",
        "stiffness",
        "structural_damping",
    } <= linear
    assert {"motor_inertia", "link_inertia", "gravity_torque"} <= linear
    assert (
        not {"motor_stribeck_velocity", "motor_stribeck_exponent", "motor_smoothing_velocity"}
        & linear
    )


def test_product_of_parameters_is_not_jointly_linear() -> None:
    """The stiffness times the amplitude of the kinematic error: each alone is linear, both are
    not.
    """
    model = JointModel.harmonic_drive(3).add("kinematic_error")
    linear = set(model.linear_parameters)
    assert not {"stiffness", "kinematic_error_sine"} <= linear
    assert linear & {"stiffness", "kinematic_error_sine"}
    assert "kinematic_error_order" not in linear


def test_linear_set_of_the_ts_model_is_that_of_the_thesis() -> None:
    """Theta of eq. 4.21 besides inertias and gravity; w1, wS and dS are left to the optimiser."""
    model = model_ts()
    linear = set(model.linear_parameters) - {"motor_inertia", "link_inertia", "gravity_torque"}
    assert linear == {
        "stiffness",
        "cubic_stiffness",
        "motor_added_spring",
        "motor_coulomb",
        "motor_smooth_stribeck",
        "motor_viscous",
        "link_viscous",
        "link_cyclic_torque_sine",
        "link_cyclic_torque_cosine",
    }


@pytest.mark.parametrize("number", [3, 4])
def test_second_derivatives_of_the_linear_set_vanish(number: int) -> None:
    model = (
        JointModel.harmonic_drive(number)
        .add("gravity")
        .add("coulomb")
        .add("stribeck")
        .add("cubic_stiffness")
    )
    p = model.equations.parameters
    chosen = ca.vertcat(*(p[model.parameter_names.index(n)] for n in model.linear_parameters))
    for row in ca.vertsplit(inverse_dynamics(model)):
        assert ca.hessian(row, chosen)[0].nnz() == 0


# --- composition ----------------------------------------------------------------------------------


def test_second_instance_has_its_own_parameters() -> None:
    model = JointModel.harmonic_drive(3).add("kinematic_error").add("kinematic_error#2")
    assert "kinematic_error#2" in model.effects
    assert {"kinematic_error_sine", "kinematic_error_sine_2", "kinematic_error_order_2"} <= set(
        model.parameter_names
    )
    model = model.with_values(
        {
            "kinematic_error_order": 1.0,
            "kinematic_error_order_2": 4.0,
            "kinematic_error_sine": 1e-4,
            "kinematic_error_sine_2": 3e-5,
        }
    )
    e = model.equations
    torsion = ca.Function("d", [e.signals.vector(), e.parameters], [e.torsion])
    at = np.zeros(len(Signals.names()))
    at[Signals.names().index("motor_position")] = at[Signals.names().index("link_position")] = (
        0.0123
    )
    angle = -160.0 * 0.0123
    expected = -(1e-4 * math.sin(angle) + 3e-5 * math.sin(4 * angle))
    assert float(torsion(at, model.value_vector())) == pytest.approx(expected, rel=1e-12)
    assert (
        model.drop("kinematic_error#2").effects
        == JointModel.harmonic_drive(3).add("kinematic_error").effects
    )
    assert model.drop("kinematic_error").effects == JointModel.harmonic_drive(3).effects


def test_model_is_immutable_and_says_what_is_wrong() -> None:
    model = JointModel.harmonic_drive(3)
    model.add("stribeck")
    assert not model.has("stribeck")
    with pytest.raises(KeyError, match="unknown effect"):
        model.add("stribek")
    with pytest.raises(ValueError, match="acts on"):
        model.add("gravity@motor")
    with pytest.raises(ValueError, match="no parameter"):
        model.with_values({"stiffnes": 1.0})
    with pytest.raises(TypeError):
        model.values["stiffness"] = 1.0  # type: ignore[index]


def test_viscous_and_coulomb_go_to_both_sides_of_a_joint_and_to_one_of_an_axis() -> None:
    assert {"viscous@motor", "viscous@link"} <= set(
        JointModel.harmonic_drive(3).add("viscous").effects
    )
    axis = JointModel(inertias=("inertia",)).add("viscous")
    assert axis.effects == ("viscous@motor",)


def test_units_of_a_linear_axis() -> None:
    model = JointModel(inertias=("inertia",), kind="linear").add("viscous").add("coulomb")
    units = {p.name: p.unit for p in model.parameters}
    assert units["inertia"] == "kg"
    assert units["motor_viscous"] == "N.s/m"
    assert units["motor_coulomb"] == "N"


def test_parameters_say_their_side() -> None:
    model = model_ts()
    sides = {p.name: p.side for p in model.parameters}
    # the side a value is referred to: everything but a sensor's own error is link-referred
    assert set(sides.values()) == {"link"}
    assert {p.side for p in model_ts().add("torque_sensor_gain").parameters} == {"link", "sensor"}
    assert all(p.meaning and p.unit for p in model.parameters)


def test_parameter_constructors() -> None:
    assert amplitude("a", "N.m", "x").low == 0.0
    assert signed("a", "N.m", "x").low == -math.inf
    assert shape("a", "rad", "x", (0.1,), "torsion", start=1.0, low=0.0, high=2.0).is_shape
    with pytest.raises(ValueError, match="outside"):
        Parameter("a", "N.m", -1.0, 0.0, 1.0, "x")


# --- load and implicit torque ---------------------------------------------------------------------


def test_load_of_an_elastic_joint_is_the_carried_torque() -> None:
    model = JointModel.harmonic_drive(3).add("load_dependent_friction@motor")
    model = model.with_values(
        {**TABLE_4_3, "motor_load_friction": 0.1, "motor_smoothing_velocity": 1e-3}
    )
    state = np.array([2e-3, 0.5, 0.0, 0.5])
    rate = np.array(model.dynamics(state, np.zeros(3), model.value_vector())).ravel()
    torque = TABLE_4_3["stiffness"] * 2e-3
    assert rate[3] == pytest.approx(torque / 10.277, rel=1e-9)
    assert rate[1] == pytest.approx(-1.1 * torque / 4.447, rel=1e-6)


def test_load_of_a_rigid_joint_solves_with_the_acceleration() -> None:
    """Gravity and the inertia of the link press the teeth: J a = drive - mu |T|, T = Jl a +
    gravity.
    """
    model = JointModel(gear_ratio=-160.0).add("gravity").add("load_dependent_friction@motor")
    values = {
        "motor_inertia": 4.447,
        "link_inertia": 10.277,
        "gravity_torque": -105.18,
        "motor_load_friction": 0.1,
        "motor_smoothing_velocity": 1e-3,
    }
    model = model.with_values(values)
    for drive in (0.0, 150.0, -150.0):
        a = float(model.dynamics([0.7, 0.5], [drive, 0, 0], model.value_vector())[1])
        gravity = 105.18 * math.sin(0.7)
        torque = 10.277 * a + gravity
        assert 14.724 * a == pytest.approx(
            drive - gravity - 0.1 * math.sqrt(torque**2 + 1e-6), abs=1e-9
        )


def test_load_from_gravity_needs_no_torque() -> None:
    model = replace(
        JointModel.harmonic_drive(3).add("gravity").add("load_dependent_friction@motor"),
        load_from="gravity",
    )
    model = model.with_values({**TABLE_4_3, "gravity_torque": -100.0, "motor_load_friction": 0.1})
    rate = np.array(model.dynamics([0.3, 0.5, 0.3, 0.5], np.zeros(3), model.value_vector())).ravel()
    assert rate[1] == pytest.approx(-0.1 * 100 * math.sin(0.3) / 4.447, rel=1e-6)


def test_load_from_the_motion_of_the_link_is_what_a_twisting_gear_carries() -> None:
    """The link swings against the motor: what it asks for is the torque of the spring, with its
    own friction, and no torque of the motor's acceleration.
    """
    values = {
        **TABLE_4_3,
        "gravity_torque": -105.18,
        "link_viscous": 12.0,
        "link_coulomb": 3.0,
        "motor_load_friction": 0.1,
        "motor_smoothing_velocity": 1e-3,
        "link_smoothing_velocity": 1e-3,
    }
    model = JointModel.harmonic_drive(3).add("gravity").add("viscous@link").add("coulomb@link")
    model = model.add("load_dependent_friction@motor").with_values(values)
    seen = replace(model, load_from="motion")
    assert seen.knows_load
    assert not replace(seen, lagging_load=True).drop("gravity").knows_load
    state = {"motor_position": 0.305, "motor_velocity": 0.5}
    state |= {"link_position": 0.3, "link_velocity": 0.4}
    rate = model.dynamics(list(state.values()), np.zeros(3), model.value_vector())
    signals = dict.fromkeys(Signals.names(), 0.0) | state
    signals |= {"motor_acceleration": float(rate[1]), "link_acceleration": float(rate[3])}
    equations = seen.equations
    law = ca.Function(
        "law", [equations.signals.vector(), equations.parameters], [equations.motor_resistance]
    )
    carried = TABLE_4_3["stiffness"] * 5e-3
    assert float(law(list(signals.values()), seen.value_vector())) == pytest.approx(
        0.1 * carried, rel=1e-6
    )


@pytest.mark.parametrize("place", ["motor", "link"])
def test_a_joint_moves_by_the_torque_of_its_gear_whatever_its_records_show(place: str) -> None:
    """Two encoders show the load by the motion of the link; by that the motion cannot be told."""
    model = JointModel.harmonic_drive(3).add("gravity").add(f"load_dependent_friction@{place}")
    model = model.with_values(
        {**TABLE_4_3, "gravity_torque": -100.0, f"{place}_load_friction": 0.1}
    )
    seen, x = replace(model, load_from="motion"), [0.305, 0.5, 0.3, 0.4]
    given = (x, np.zeros(3), model.value_vector())
    both = zip(
        (model.dynamics(*given), *model.jacobian(*given)),
        (seen.dynamics(*given), *seen.jacobian(*given)),
        strict=True,
    )
    for one, other in both:
        np.testing.assert_array_equal(np.array(one), np.array(other))


@pytest.mark.parametrize("cubic", [0.0, 1.174e9])
def test_sensor_compliance_is_a_spring_in_series(cubic: float) -> None:
    model = JointModel.harmonic_drive(3).add("cubic_stiffness").add("torque_sensor_compliance")
    model = model.with_values({**TABLE_4_3, "cubic_stiffness": cubic, "sensor_compliance": 1 / 4e4})
    for twist in (-4e-3, 1e-4, 3e-3):
        torque = float(
            model.functions.outputs([twist, 0, 0, 0], np.zeros(3), model.value_vector())[4]
        )
        d = twist - torque / 4e4
        assert torque == pytest.approx(2.1513e4 * d + cubic * d**3, rel=1e-12)
        if not cubic:
            assert torque == pytest.approx(twist / (1 / 2.1513e4 + 1 / 4e4), rel=1e-12)


INVERTED: dict[str, JointModel] = {
    "elastic, load on both sides": JointModel.harmonic_drive(3)
    .add("gravity")
    .add("load_dependent_friction@motor")
    .add("load_dependent_friction@link")
    .with_values(
        {
            **TABLE_4_3,
            "gravity_torque": -105.18,
            "motor_load_friction": 0.1,
            "link_load_friction": 0.07,
        }
    ),
    "rigid, load at the motor": JointModel(gear_ratio=-160.0)
    .add("gravity")
    .add("load_dependent_friction@motor")
    .with_values({"motor_inertia": 4.447, "link_inertia": 10.277, "gravity_torque": -105.18})
    .with_values({"motor_load_friction": 0.1, "motor_smoothing_velocity": 0.02}),
    "rigid, what the teeth carry is lost in them": JointModel(gear_ratio=-160.0)
    .add("gravity")
    .add("viscous@link")
    .add("load_dependent_friction@link")
    .with_values({"motor_inertia": 4.447, "link_inertia": 10.277, "gravity_torque": -105.18})
    .with_values({"link_load_friction": 0.08, "link_smoothing_velocity": 0.02, "link_viscous": 9}),
    "one inertia": JointModel(inertias=("inertia",))
    .add("gravity")
    .add("load_dependent_friction@motor")
    .with_values({"inertia": 12.0, "gravity_torque": -105.18, "motor_load_friction": 0.1}),
    "internal states": model_2b().add("hysteresis"),
}


@pytest.mark.parametrize("which", sorted(INVERTED))
def test_the_regressor_at_the_motion_of_the_dynamics_gives_the_drive_back(which: str) -> None:
    """Y theta + rest of the accelerations that a drive makes is that drive, and nothing is left of
    the link's equation.
    """
    model = INVERTED[which]
    p, names = model.value_vector(), model.parameter_names
    theta = np.array([p[names.index(n)] for n in model.linear_parameters])
    mechanical, memory = len(model.functions.state_names), len(model.functions.memory_names)
    assert model.regressor.size1_in(1) == mechanical // 2, "an acceleration per degree of freedom"
    rng = np.random.default_rng(4)
    for drive in (-120.0, 0.0, 35.0):
        x = np.array([0.4 + 2e-3, 0.5, 0.4, -0.3] if mechanical == 4 else [0.7, -0.4])
        x = np.concatenate([x, rng.uniform(-0.5, 0.5, memory)])
        u = [drive, 0.0, 0.0]
        rates = np.array(model.dynamics(x, u, p)).ravel()
        matrix, rest = (np.array(m) for m in model.regressor(x, rates[1:mechanical:2], u, p))
        given = np.array([drive, 0.0])[: len(rest)]
        assert (matrix @ theta + rest.ravel()) == pytest.approx(given, rel=1e-8, abs=1e-8)


# --- linearisation --------------------------------------------------------------------------------


def poles_in_hertz(model: JointModel) -> FloatArray:
    system = model.linearize()
    poles = np.asarray(system.poles())
    return np.sort(np.abs(poles.imag[poles.imag > 1e-6]) / (2 * math.pi))


def test_free_resonance_of_two_masses() -> None:
    model = JointModel.harmonic_drive(3).with_values(TABLE_4_3)
    expected = math.sqrt(2.1513e4 * (1 / 4.447 + 1 / 10.277)) / (2 * math.pi)
    assert poles_in_hertz(model) == pytest.approx([expected], rel=1e-9)
    assert expected == pytest.approx(13.2, abs=0.06)


def test_locked_motor_resonance() -> None:
    model = JointModel.harmonic_drive(3).with_values({**TABLE_4_3, "motor_inertia": 1e12})
    expected = math.sqrt(2.1513e4 / 10.277) / (2 * math.pi)
    assert poles_in_hertz(model) == pytest.approx([expected], rel=1e-6)
    assert expected == pytest.approx(7.3, abs=0.05)


def test_poles_of_damped_masses() -> None:
    """Structural damping c: poles of s^2 + (c s + k)(1/Jm + 1/Jl)."""
    model = JointModel.harmonic_drive(3).with_values({**TABLE_4_3, "structural_damping": 40.0})
    mobility = 1 / 4.447 + 1 / 10.277
    expected = np.roots([1.0, 40.0 * mobility, 2.1513e4 * mobility])
    poles = np.asarray(model.linearize().poles())
    oscillating = poles[np.abs(poles) > 1.0]
    assert np.sort_complex(oscillating) == pytest.approx(np.sort_complex(expected), rel=1e-9)


def test_linear_model_has_names_and_gain() -> None:
    system = (
        JointModel(gear_ratio=-160.0)
        .add("viscous@motor")
        .with_values({"motor_inertia": 4.0, "link_inertia": 6.0, "motor_viscous": 5.0})
        .linearize()
    )
    assert system.state_labels == ["position", "velocity"]
    assert system.input_labels == ["drive"]
    response = complex(np.asarray(system(2j))[1, 0])
    assert response == pytest.approx(1 / (10 * 2j + 5), rel=1e-9)


@pytest.mark.parametrize("place", ["link", "motor"])
def test_flexible_mode_is_a_third_mass(place: str) -> None:
    """Poles of the linear model are those of three masses on two springs."""
    frequency, extra, damping = 11.0, 1.5, 1e-4
    model = (
        JointModel.harmonic_drive(3)
        .add(f"flexible_mode@{place}")
        .with_values(
            {
                **TABLE_4_3,
                f"{place}_flexible_inertia": extra,
                f"{place}_flexible_frequency": frequency,
                f"{place}_flexible_damping": damping,
            }
        )
    )
    spring = extra * (2 * math.pi * frequency) ** 2
    k = TABLE_4_3["stiffness"] * np.array([[1, -1, 0], [-1, 1, 0], [0, 0, 0]], dtype=float)
    side = 1 if place == "link" else 0
    k[np.ix_([side, 2], [side, 2])] += spring * np.array([[1, -1], [-1, 1]])
    squares = np.linalg.eigvals(np.diag([1 / 4.447, 1 / 10.277, 1 / extra]) @ k).real
    expected = np.sort(np.sqrt(np.abs(squares)))[1:] / (2 * math.pi)
    assert poles_in_hertz(model) == pytest.approx(expected, rel=1e-6)


# --- sensors --------------------------------------------------------------------------------------


def corrected(model: JointModel, **signals: float) -> dict[str, float]:
    e = model.equations
    at = [signals.get(n, 0.0) for n in Signals.names()]
    out = {
        "torque": e.torque,
        "drive": e.drive,
        "motor": e.true_motor_position,
        "link": e.true_link_position,
        "link_rate": time_derivative(e.true_link_position, e.signals),
    }
    f = ca.Function("f", [e.signals.vector(), e.parameters], list(out.values()))
    return {n: float(v) for n, v in zip(out, f(at, model.value_vector()), strict=True)}


def test_sensor_effects_leave_the_motion_alone() -> None:
    """What a sensor adds is in its reading, not in the dynamics."""
    plain = (
        JointModel.harmonic_drive(3)
        .add("gravity")
        .with_values({**TABLE_4_3, "gravity_torque": -105.18})
    )
    faulty = (
        plain.add("torque_sensor_gain")
        .add("torque_sensor_offset")
        .add("channel_delay@link_position_sensor")
    )
    faulty = faulty.add("channel_delay@torque_sensor").with_values(
        {
            "torque_sensor_gain": 0.2,
            "torque_sensor_offset": 5.0,
            "link_position_sensor_delay": 4e-3,
            "torque_sensor_delay": 3e-3,
        }
    )
    x, u = np.array([0.402, 0.3, 0.4, -0.2]), np.array([30.0, 0, 0])
    same = [np.array(m.dynamics(x, u, m.value_vector())).ravel() for m in (plain, faulty)]
    assert same[0] == pytest.approx(same[1], rel=1e-15)


def test_gain_and_offset_are_in_the_reading_and_come_off() -> None:
    model = (
        JointModel.harmonic_drive(3)
        .with_values(TABLE_4_3)
        .add("torque_sensor_gain")
        .add("torque_sensor_offset")
    )
    model = model.with_values({"torque_sensor_gain": 0.07, "torque_sensor_offset": 2.5})
    true = 2.1513e4 * 2e-3
    reading = float(model.functions.outputs([2e-3, 0, 0, 0], np.zeros(3), model.value_vector())[4])
    assert reading == pytest.approx((true - (-2.5)) * 1.07, rel=1e-12)
    assert corrected(model, torque=reading)["torque"] == pytest.approx(true, rel=1e-12)


def test_drive_effects_act_on_the_motion() -> None:
    model = JointModel(gear_ratio=-160.0).add("motor_constant_error").add("current_offset")
    model = model.with_values(
        {
            "motor_inertia": 4.0,
            "link_inertia": 6.0,
            "motor_constant_error": 0.18,
            "current_offset": -2.0,
        }
    )
    assert float(model.dynamics([0, 0], [50.0, 0, 0], model.value_vector())[1]) == pytest.approx(
        (1.18 * 50 - 2) / 10
    )
    assert corrected(model, drive=50.0)["drive"] == pytest.approx(1.18 * 50 - 2)


def test_delayed_reading_is_corrected_with_its_rate() -> None:
    """A ramp read late by h shows true - h rate; the correction gives the ramp back without
    error.
    """
    model = (
        JointModel.harmonic_drive(3)
        .with_values(TABLE_4_3)
        .add("channel_delay@link_position_sensor")
    )
    model = model.with_values({"link_position_sensor_delay": 4e-3})
    shown = np.array(
        model.functions.outputs([0.5, 0.8, 0.5, 0.8], np.zeros(3), model.value_vector())
    ).ravel()
    assert shown[2] == pytest.approx(0.5 - 4e-3 * 0.8, rel=1e-12)
    found = corrected(model, link_position=shown[2], link_velocity=0.8)
    assert found["link"] == pytest.approx(0.5, rel=1e-12)
    assert found["link_rate"] == pytest.approx(0.8, rel=1e-12)


def test_a_late_sensor_with_a_gain_shows_what_its_correction_gives_back() -> None:
    """A torque that winds up steadily: the reading rises by the gain faster than the torque."""
    gain, rate = 0.25, 2.1513e4 * 0.3
    model = JointModel.harmonic_drive(3).with_values({**TABLE_4_3, "structural_damping": 0.0})
    for effect in ("torque_sensor_gain", "torque_sensor_offset", "channel_delay@torque_sensor"):
        model = model.add(effect)
    model = model.with_values(
        {
            "torque_sensor_gain": gain,
            "torque_sensor_offset": 2.5,
            "torque_sensor_delay": 4e-3,
        }
    )
    shown = np.array(
        model.functions.outputs([2e-3, 0.8, 0.0, 0.5], np.zeros(3), model.value_vector())
    ).ravel()
    found = corrected(model, torque=shown[4], torque_rate=(1 + gain) * rate)
    assert found["torque"] == pytest.approx(2.1513e4 * 2e-3, rel=1e-12)


def test_time_derivative_follows_the_chain_rule() -> None:
    s: Any = Signals.symbols()
    rate = time_derivative(ca.sin(s.motor_position) * s.torque, s)
    f = ca.Function("f", [s.vector()], [rate])
    values = dict.fromkeys(Signals.names(), 0.0) | {
        "motor_position": 0.3,
        "motor_velocity": 2.0,
        "torque": 5.0,
        "torque_rate": 7.0,
    }
    expected = math.cos(0.3) * 2 * 5 + math.sin(0.3) * 7
    assert float(f(list(values.values()))) == pytest.approx(expected, rel=1e-14)


def test_elements_of_a_hysteresis_fill_at_the_rate_of_the_torsion() -> None:
    """Over one, three and nine widths, in rates, in a step and in the linear model."""
    model = model_2b().add("hysteresis")
    width = 0.01
    model = model.with_values(
        {**{f"hysteresis_torque_{k}": 2.0 for k in (1, 2, 3)}, "hysteresis_width": width}
    )
    f, p = model.functions, model.value_vector()
    state, stops = np.array([2e-3, 0.5, 0.0, 0.2]), np.array([0.1, -0.2, 0.3])
    at = np.concatenate([state, stops])
    rates = np.array(f.dynamics(at, np.zeros(3), p)).ravel()
    known = 0.3 / (width * np.array([1.0, 3.0, 9.0]))
    assert rates[4:] == pytest.approx(known, rel=1e-6)
    h = 1e-6
    after = state + h * rates[:4]
    moved = np.array(f.memory_step(after, state, stops, np.zeros(3), p, h)).ravel()
    assert (moved - stops) / h == pytest.approx(known, rel=1e-4)
    # a turn empties them from where they stand, and a full one stays full
    back = np.array(f.memory_step(state, after, stops, np.zeros(3), p, h)).ravel()
    assert (back - stops) / h == pytest.approx(-known, rel=1e-4)
    full = np.array(f.memory_step(state + [0.5, 0, 0, 0], state, stops, np.zeros(3), p, h))
    assert full.ravel() == pytest.approx(1.0, rel=1e-3)
    system = f.linearize()
    assert system.A.shape == (7, 7)
    assert system.A[4, 1] == pytest.approx(1 / width, rel=1e-6)
    assert system.A[4, 3] == pytest.approx(-1 / width, rel=1e-6)
    assert np.array_equal(system.C, np.eye(4, 7))
