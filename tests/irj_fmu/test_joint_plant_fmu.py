"""Plant FMUs of joint models: against equations written again by hand, and against the model's
own functions.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import JointModel, thesis
from casadi_models.simulate import simulate
from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.online.watch import Q_L
from irj_fmu.effect_table import joint_with, readings_of
from irj_fmu.host.exchange import Exchange, simulate_me
from irj_fmu.host.run import Fmu, Instance, Trajectory, Wiring, simulate_cs
from irj_fmu.host.signals import Table
from irj_fmu.plant.joint import BANDWIDTH, PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant
from irj_fmu.plant.reference import Motion, reference_joint

FloatArray = npt.NDArray[np.float64]
STEP = 1e-3
TS = reference_joint("irj_ts")


def built(folder: Path, joint: Joint | JointModel, **options: object) -> Path:
    spec = plant_spec(joint, PlantOptions(**options))  # type: ignore[arg-type]
    return build_plant(spec, folder / f"{spec.name}.fmu")


@pytest.fixture(scope="module")
def ts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("ts"), TS)


def current(count: int) -> FloatArray:
    t = STEP * np.arange(count)
    return np.asarray(
        15 * np.sin(2 * np.pi * 1.3 * t) + 5 * np.sin(2 * np.pi * 7 * t), dtype=np.float64
    )


def by_hand(i_m: FloatArray) -> FloatArray:
    """Eq. 4.18 to 4.21 of the thesis with a held current, DOP853 at 1e-12; rows q_m, w_m, q_l,
    w_l, link-referred.
    """
    from scipy.integrate import solve_ivp

    v = TS.fitted

    def slope(_: float, x: FloatArray, i: float) -> list[float]:
        q, w, link, rate = x
        torque = v["stiffness"] * (q - link) + v["cubic_stiffness"] * (q - link) ** 3
        decay = math.exp(-math.sqrt((w / v["motor_smooth_stribeck_velocity"]) ** 2 + 1e-12))
        motor = (
            v["motor_added_spring"] * q
            + (v["motor_viscous"] + v["motor_smooth_stribeck"] * decay) * w
        )
        motor += v["motor_coulomb"] * math.tanh(w / v["motor_smoothing_velocity"])
        load = v["link_viscous"] * rate + (
            v["link_cyclic_torque_sine"] - v["gravity_torque"]
        ) * math.sin(link)
        load += v["link_cyclic_torque_cosine"] * math.cos(link)
        drive = (TS.torque_per_current or 0.0) * i
        return [
            w,
            (drive - torque - motor) / v["motor_inertia"],
            rate,
            (torque - load) / v["link_inertia"],
        ]

    rows = [np.zeros(4)]
    for i in i_m:
        rows.append(
            solve_ivp(slope, (0.0, STEP), rows[-1], "DOP853", rtol=1e-12, atol=1e-14, args=(i,)).y[
                :, -1
            ]
        )
    return np.array(rows)


def run(path: Path, record: list[str], count: int = 300, **wiring: object) -> Trajectory:
    with Fmu(path) as fmu, Instance(fmu, name="p") as instance:
        made = Wiring(record=[f"p.{n}" for n in record], **wiring)  # type: ignore[arg-type]
        return simulate_cs(instance, made, step=STEP, stop=count * STEP)


def held(values: FloatArray) -> Table:
    return Table(STEP * np.arange(len(values)), values, hold=True)


def test_cosimulation_equals_the_equations(ts: Path) -> None:
    """1e-8 rad against the reference, motor side on the motor shaft."""
    expected = by_hand(current(500))
    found = run(
        ts,
        ["link_position", "motor_position", "motor_velocity"],
        500,
        inputs={"p.i_m": held(current(501))},
    )
    assert np.ptp(expected[:, 2]) > 0.1
    assert np.abs(found["p.link_position"] - expected[:, 2]).max() < 1e-8
    assert np.abs(found["p.motor_position"] / TS.gear_ratio - expected[:, 0]).max() < 1e-8
    assert np.abs(found["p.motor_velocity"] / TS.gear_ratio - expected[:, 1]).max() < 1e-6


def test_model_exchange_equals_the_equations(ts: Path) -> None:
    expected = by_hand(current(100))
    with Fmu(ts) as fmu, Instance(fmu, "me") as instance:
        options = Exchange(inputs={"i_m": held(current(101))}, record=["link_position"])
        found = simulate_me(instance, STEP * np.arange(101), options)
    assert np.abs(found["link_position"] - expected[:, 2]).max() < 1e-6


def test_directional_derivatives(ts: Path) -> None:
    """Derivatives of dx and outputs with respect to every state, input and parameter, against
    central differences.
    """
    with Fmu(ts) as fmu, Instance(fmu, "me") as instance:
        instance.begin(0.0)
        instance.ready()
        instance.call("newDiscreteStates")
        instance.call("enterContinuousTimeMode")
        names = {v.name: v for v in fmu.description.modelVariables}
        unknown = [
            v.valueReference
            for n, v in names.items()
            if n.startswith("der(") or v.causality == "output"
        ]
        known = [
            n
            for n, v in names.items()
            if n.startswith("state.") or v.causality in ("input", "parameter")
        ]
        start = {
            "state.motor_position": 0.31,
            "state.motor_velocity": 0.04,
            "state.link_position": 0.3,
            "i_m": 3.0,
        }
        for n, value in start.items():
            instance.call("setReal", [names[n].valueReference], [value])
        assert len(known) == 4 + 1 + 17
        for n in known:
            reference = [names[n].valueReference]
            value = instance.call("getReal", reference)[0]
            step = 1e-6 * max(abs(value), 0.1)
            sides = []
            for sign in (1, -1):
                instance.call("setReal", reference, [value + sign * step])
                sides.append(np.array(instance.call("getReal", unknown)))
            instance.call("setReal", reference, [value])
            expected = (sides[0] - sides[1]) / (2 * step)
            slopes = np.array(instance.call("getDirectionalDerivative", unknown, reference, [1.0]))
            assert slopes == pytest.approx(
                expected, rel=1e-6, abs=1e-6 * max(1.0, np.abs(expected).max())
            ), n


def test_energy_is_kept(tmp_path: Path) -> None:
    """Model 3 without damping and friction: kinetic plus stored energy stays."""
    model = (
        JointModel.harmonic_drive(3)
        .add("gravity")
        .with_values({"stiffness": 2e4, "gravity_torque": -50.0})
    )
    path = built(tmp_path, model, name="free")
    states = [
        f"state.{n}" for n in ("motor_position", "motor_velocity", "link_position", "link_velocity")
    ]
    start = {"p.state.motor_position": 0.5, "p.state.link_position": 0.501}
    found = run(path, states, 2000, parameters=start)
    x = np.array([found[f"p.{n}"] for n in states])
    energy = np.array(model.energy.map(x.shape[1])(x, model.value_vector())).ravel()
    assert np.ptp(x[2]) > 0.3
    assert np.ptp(energy) < 1e-7 * 50.0


@pytest.mark.parametrize("configuration", ["1", "2", "IRJ"])
@pytest.mark.parametrize("name", ["hd1", "hd2", "hd3", "hd4"])
def test_harmonic_drives_follow_their_own_model(
    name: str, configuration: str, tmp_path: Path
) -> None:
    """The FMU against the model's Runge-Kutta loop, in each configuration; the file validates."""
    from fmpy.validation import validate_fmu

    joint = reference_joint(name, configuration)
    path = built(tmp_path, joint)
    assert validate_fmu(str(path)) == []
    i_m = current(200) / 2
    expected = simulate(
        joint.model(), i_m * (joint.torque_per_current or 0.0), STEP, substeps=60
    ).readings
    found = run(
        path, ["link_position", "motor_position", "link_torque"], 199, inputs={"p.i_m": held(i_m)}
    )
    assert found["p.link_position"] == pytest.approx(expected[:, 2], abs=1e-8)
    assert found["p.motor_position"] == pytest.approx(expected[:, 0] * joint.gear_ratio, abs=2e-6)
    assert found["p.link_torque"][1:] == pytest.approx(expected[1:, 4], abs=1e-2)


def test_memory_of_a_displacement(tmp_path: Path) -> None:
    """Hysteresis moves step by step: co-simulation only, equal to the model's loop to the order
    of its step.
    """
    model = (
        thesis.model_2b()
        .add("hysteresis")
        .with_values({"hysteresis_torque_1": 20.0, "hysteresis_torque_2": 10.0})
    )
    path = built(tmp_path, model, name="loop")
    drive = 120 * np.sin(2 * np.pi * 2 * STEP * np.arange(500))
    expected = simulate(model, drive, STEP, substeps=20).readings
    found = run(path, ["link_position"], 499, inputs={"p.tau_m": held(drive / model.gear_ratio)})
    without = simulate(
        model.with_values({"hysteresis_torque_1": 0.0, "hysteresis_torque_2": 0.0}), drive, STEP
    ).readings
    visible = np.abs(without[:, 2] - expected[:, 2]).max()
    assert visible > 5e-4
    assert np.abs(found["p.link_position"] - expected[:, 2]).max() < 1e-2 * visible
    with Fmu(path) as fmu:
        assert fmu.description.modelExchange is None


def test_bristles_are_states(tmp_path: Path) -> None:
    """Where a memory has a rate it is integrated: no limit on the step, model exchange too."""
    model = thesis.model_2b().add("lugre").with_values({"motor_presliding_torque": 9.0})
    path = built(tmp_path, model, name="bristle")
    drive = 120 * np.sin(2 * np.pi * 2 * STEP * np.arange(300))
    expected = simulate(model, drive, STEP, substeps=200).readings
    found = run(
        path,
        ["link_position", "state.lugre_motor_0"],
        299,
        inputs={"p.tau_m": held(drive / model.gear_ratio)},
    )
    assert np.abs(found["p.link_position"] - expected[:, 2]).max() < 1e-6
    assert 0.9 < np.abs(found["p.state.lugre_motor_0"]).max() <= 1.0 + 1e-9
    with Fmu(path) as fmu:
        assert fmu.description.modelExchange is not None


def test_controller_follows_its_motion(tmp_path: Path) -> None:
    path = built(tmp_path, reference_joint("hd3"), controller=True, motion=Motion(), name="led")
    q, v = Motion().start()
    start = {
        f"p.state.{s}_{n}": x
        for s in ("motor", "link")
        for n, x in (("position", q), ("velocity", v))
    }
    found = run(path, ["state.motor_position", "link_position"], 3000, parameters=start)
    expected = np.array([float(Motion().expressions(t)[0]) for t in found.time[::50]])
    assert np.ptp(expected) > 0.5
    assert found["p.state.motor_position"][::50] == pytest.approx(expected, abs=0.01)
    still = run(path, ["link_position"], 100, parameters={"p.motion.scale": 0.0})
    assert np.abs(still["p.link_position"]).max() < 1e-12


LOADS = {"gravity_torque": 60.0, "gravity_cosine": -35.0, "current_offset": 4.0}
HELD = {
    "sine and cosine": ("hd1", "rotary", ("gravity",)),
    "of an elastic joint": ("hd3", "rotary", ("gravity",)),
    "a linear axis that stands upright": ("hd1", "linear", ("viscous", "current_offset")),
    "everything": ("hd1", "rotary", ("gravity", "current_offset")),
}


@pytest.mark.parametrize("case", HELD)
def test_the_controller_holds_the_joint_where_it_stands(case: str, tmp_path: Path) -> None:
    """Wherever its zero is: a tenth of the load that is not fed forward would move it by more."""
    import fmpy

    model_name, kind, effects = HELD[case]
    joint = Joint(
        name="held",
        kind=kind,
        gear_ratio=100.0 if kind == "rotary" else 1.0,
        model_name=model_name,
        effects=effects,
        fitted={"motor_inertia": 0.5, "link_inertia": 0.5}
        | ({"stiffness": 1e6} if model_name == "hd3" else {}),
    )
    names = joint.model().parameter_names
    values = {n: v for n, v in LOADS.items() if n in names}
    joint = replace(joint, fitted={**joint.fitted, **values})
    path = built(tmp_path, joint, controller=True)
    stiff = BANDWIDTH**2 * (0.5 + 0.5)
    states = ("state.motor_position", "state.link_position")
    for place in (0.0, 0.8):
        with Fmu(path) as fmu:
            start = {n: place for n in (*states, "state.position") if n in fmu.variables}
        found = fmpy.simulate_fmu(
            str(path),
            fmi_type="CoSimulation",
            stop_time=2.0,
            output_interval=0.01,
            start_values={**start, "reference_position": place},
            output=["motor_position"],
        )
        moved = found["motor_position"] / joint.gear_ratio - place
        assert np.abs(moved).max() < 0.1 * min(map(abs, values.values())) / stiff


def test_a_payload_has_both_parts(tmp_path: Path) -> None:
    """Its weight adds to the link's parts, one by one: the payload that undoes the link's weight
    leaves it where it is.
    """
    joint = Joint(name="pay", model_name="hd1", gear_ratio=1.0, effects=("gravity",))
    values = {"motor_inertia": 0.5, "link_inertia": 0.5, "gravity_torque": 7.0}
    joint = replace(joint, fitted={**values, "gravity_cosine": -3.0})
    path = built(tmp_path, joint, payload=True)
    weight = {"p.payload_weight": -7.0, "p.payload_weight_cosine": 3.0}
    still = run(path, ["link_position"], 300, parameters={**weight, "p.state.position": 0.4})
    assert np.abs(still["p.link_position"] - 0.4).max() < 1e-9
    falling = run(path, ["link_position"], 300, parameters={"p.state.position": 0.4})
    assert np.ptp(falling["p.link_position"]) > 1e-3


def test_sensors(tmp_path: Path) -> None:
    """Noise of the deviation asked for, quanta, a bias in its time, a dropout; the same again
    at each run.
    """
    path = built(tmp_path, reference_joint("hd1"), sensors=True, name="seen")
    parameters = {
        "p.link_torque.noise": 0.5,
        "p.link_velocity.noise": 0.2,
        "p.motor_position.quantum": 0.01,
        "p.link_position.fault_start": 1.0,
        "p.link_position.fault_stop": 2.0,
        "p.link_position.fault_bias": 0.3,
        "p.motor_velocity.dropout_start": 3.0,
    }
    outputs = ["link_torque", "link_velocity", "link_position", "motor_position", "motor_velocity"]
    found = run(path, outputs, 5000, parameters=parameters)
    torque, velocity = found["p.link_torque"], found["p.link_velocity"]
    assert torque.std() == pytest.approx(0.5, rel=0.05)
    assert abs(torque.mean()) < 4 * 0.5 / math.sqrt(5000)
    assert np.mean(np.abs(torque) > 0.98) == pytest.approx(0.05, abs=0.01)
    for series in (torque, velocity):
        assert abs(np.corrcoef(series[1:], series[:-1])[0, 1]) < 0.06
    assert abs(np.corrcoef(torque, velocity)[0, 1]) < 0.06
    assert np.abs(found["p.link_position"][1000:2000] - 0.3).max() < 1e-9
    assert np.abs(found["p.link_position"][2001:]).max() < 1e-9
    assert np.abs(np.remainder(found["p.motor_position"] + 0.005, 0.01) - 0.005).max() < 1e-9
    assert np.isnan(found["p.motor_velocity"][3000:]).all()
    assert np.isfinite(found["p.motor_velocity"][:3000]).all()
    again = run(path, outputs[:1], 100, parameters=parameters)
    assert np.array_equal(again["p.link_torque"], torque[:101])
    other = run(path, outputs[:1], 100, parameters={**parameters, "p.sensor.seed": 2.0})
    assert abs(np.corrcoef(other["p.link_torque"], torque[:101])[0, 1]) < 0.4


def test_fitted_joint_with_added_effects(tmp_path: Path) -> None:
    """Start values are the fitted ones; names, units, bounds are the model's; backlash and
    temperature work.
    """
    joint = replace(
        TS,
        name="axis 3",
        model_name="irj2b",
        effects=("backlash", "thermal_friction"),
        fitted={"stiffness": 1.234e4},
    )
    path = built(tmp_path, joint)
    assert path.name == "axis_3.fmu"
    with Fmu(path) as fmu:
        variables = fmu.variables
        assert float(variables["stiffness"].start) == 1.234e4
        for p in joint.model().parameters:
            assert variables[p.name].unit == (None if p.unit == "1" else p.unit)
            assert (
                (float(variables[p.name].min) == p.low)
                if math.isfinite(p.low)
                else (variables[p.name].min is None)
            )
        assert "temperature" in variables
        assert variables["motor_position"].unit == "rad"
    assert np.isfinite(
        run(path, ["link_position"], 50, parameters={"p.i_m": 5.0})["p.link_position"]
    ).all()


def test_a_joint_with_a_long_name_has_an_fmu(tmp_path: Path) -> None:
    """The name is a file's, too; a long one was refused as a full disk."""
    joint = replace(reference_joint("hd1"), name="Achse, " * 60)
    path = built(tmp_path, joint)
    assert path.name.startswith("Achse_Achse")
    assert path.stat().st_size > 0


def test_linear_axis_has_linear_units(tmp_path: Path) -> None:
    path = built(
        tmp_path, Joint(name="slide", kind="linear", model_name="hd1", effects=("viscous",))
    )
    with Fmu(path) as fmu:
        assert fmu.variables["link_position"].unit == "m"
        assert fmu.variables["tau_m"].unit == "N"


def test_current_needs_a_motor_constant() -> None:
    with pytest.raises(InputError, match="motor_constant"):
        plant_spec(Joint(name="bare"), PlantOptions(drive="current"))


def test_a_late_link_encoder_reads_what_was() -> None:
    """Six samples late: the position of six samples ago, to a tenth of the second order of the
    delay, which the stiffness would make a torque of.
    """
    late = joint_with("channel_delay@link_position_sensor")
    samples = round(late.fitted["link_position_sensor_delay"] / STEP)
    timely = replace(late, fitted={**late.fitted, "link_position_sensor_delay": 0.0})
    read, true = (readings_of(j, stop=2.0)[:, Q_L] for j in (late, timely))
    error = np.abs(read[samples:] - true[:-samples]).max()
    bend = np.abs(np.diff(true, 2)).max() * samples**2 / 2
    assert error < bend / 10
