"""Plants as FMI 3.0: the same plant as the FMI 2.0 one, with derivatives that importers can
trust.
"""

from __future__ import annotations

import ctypes
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu

from irj_fmu.host.exchange import Stepper
from irj_fmu.imported.exact import Imported
from irj_fmu.imported.library import UserFmu, UserInstance
from irj_fmu.imported.model import load_user_model
from irj_fmu.plant.fmi3 import build_plant_fmi3
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import PlantSpec, build_plant
from irj_fmu.plant.reference import reference_joint


@pytest.fixture(scope="module")
def spec() -> PlantSpec:
    return plant_spec(reference_joint("hd3"), PlantOptions(name="hd3"))


@pytest.fixture(scope="module")
def both(spec: PlantSpec, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("plants")
    return build_plant(spec, folder / "two.fmu"), build_plant_fmi3(spec, folder / "three.fmu")


def test_it_is_valid_and_the_same_bytes_each_time(
    spec: PlantSpec, both: tuple[Path, Path], tmp_path: Path
) -> None:
    assert validate_fmu(str(both[1])) == []
    assert build_plant_fmi3(spec, tmp_path / "three.fmu").read_bytes() == both[1].read_bytes()


def test_it_moves_as_the_fmi_2_plant(spec: PlantSpec, both: tuple[Path, Path]) -> None:
    ends = []
    for path in both:
        with UserInstance(UserFmu(path), "me") as instance:
            drive, read = instance.block(["i_m"]), instance.block([v.name for v in spec.outputs])
            instance.begin(0.0, {"gravity_torque": 90.0})
            x = instance.ready()
            stepper = Stepper("hd3", instance.nominals(), 1e-9, 1e-11, instance.accept)
            for k in range(200):
                drive.array[:] = 5 * np.sin(0.05 * k)
                instance.write(drive)
                x = stepper.advance(instance.slope, 1e-3 * k, 1e-3 * (k + 1), x)
            ends.append(np.concatenate([x, instance.read(read)]))
    assert np.abs(ends[0]).max() > 1e-3
    np.testing.assert_array_equal(ends[0], ends[1])


def test_imported_derivatives_with_respect_to_states_and_all_parameters_are_exact(
    spec: PlantSpec, both: tuple[Path, Path]
) -> None:
    import casadi as ca

    imported = Imported(
        load_user_model(
            both[1],
            {"motor_current": "i_m", "motor_position": "motor_position"},
            [p.name for p in spec.parameters],
        )
    )
    assert imported.tunable == [p.name for p in spec.parameters]
    generator = np.random.default_rng(3)
    x = 0.1 * generator.standard_normal(len(spec.states))
    p = np.array([float(v.start) for v in spec.parameters]) * (
        1 + 0.1 * generator.standard_normal(len(spec.parameters))
    )
    u = np.array([0.7])
    symbols = [ca.SX.sym("x", len(x)), ca.SX.sym("u", 1), ca.SX.sym("p", len(p))]
    rate = spec.dynamics(*symbols)
    wanted = ca.Function(
        "wanted", symbols, [rate, ca.jacobian(rate, symbols[0]), ca.jacobian(rate, symbols[2])]
    )(x, u, p)
    found = [np.asarray(v) for v in imported._j(x, u, p)]
    for one, other in zip((found[0], found[2], found[3]), wanted, strict=True):
        np.testing.assert_allclose(one, np.asarray(ca.densify(other)), rtol=1e-9, atol=1e-9)
    moving = [
        i for i, v in enumerate(spec.parameters) if not v.name.endswith("_smoothing_velocity")
    ]
    assert np.all(np.abs(found[3][:, moving]).max(axis=0) > 0)


def test_state_is_kept_and_restored(both: tuple[Path, Path]) -> None:
    with UserInstance(UserFmu(both[1]), "me") as instance:
        instance.begin(0.0)
        instance.ready()
        library, component = instance._library, ctypes.c_void_p(instance._component)
        instance.slope(0.5, np.array([0.1, 0.2, 0.3, 0.4]))
        state, size = ctypes.c_void_p(), ctypes.c_size_t()
        assert library.fmi3GetFMUState(component, ctypes.byref(state)) == 0
        assert library.fmi3SerializedFMUStateSize(component, state, ctypes.byref(size)) == 0
        content = (ctypes.c_uint8 * size.value)()
        assert library.fmi3SerializeFMUState(component, state, content, size) == 0
        before = instance.read(instance.block(["der(state.motor_velocity)"])).copy()
        instance.slope(0.6, np.zeros(4))
        again = ctypes.c_void_p()
        assert library.fmi3DeserializeFMUState(component, content, size, ctypes.byref(again)) == 0
        assert library.fmi3SetFMUState(component, again) == 0
        np.testing.assert_array_equal(
            instance.read(instance.block(["der(state.motor_velocity)"])), before
        )
        for held in (state, again):
            assert library.fmi3FreeFMUState(component, ctypes.byref(held)) == 0


def co_simulated(path: Path, names: list[str]) -> np.ndarray:
    """Outputs of a plant after each step of a swinging current, (50, outputs)."""
    from fmpy import simulate_fmu

    time = 2e-3 * np.arange(51)
    drive = np.array(
        list(zip(time, 5 * np.sin(40 * time), strict=True)), dtype=[("time", float), ("i_m", float)]
    )
    found = simulate_fmu(
        str(path),
        fmi_type="CoSimulation",
        stop_time=0.1,
        output_interval=2e-3,
        input=drive,
        output=names,
    )
    return np.column_stack([found[n] for n in names])


@pytest.mark.parametrize("memory", [False, True])
def test_co_simulation_equals_that_of_fmi_2(memory: bool, tmp_path: Path) -> None:
    joint = reference_joint("hd3")
    if memory:
        joint = replace(joint, effects=(*joint.effects, "hysteresis"), fitted={})
    spec = plant_spec(joint, PlantOptions(name="same"))
    names = [v.name for v in (*spec.outputs, *spec.memory)]
    two = co_simulated(build_plant(spec, tmp_path / "2.fmu"), names)
    three = build_plant_fmi3(spec, tmp_path / "3.fmu")
    assert validate_fmu(str(three)) == []
    assert np.ptp(two, axis=0).max() > 0.1
    np.testing.assert_allclose(co_simulated(three, names), two, rtol=1e-12, atol=1e-15)


def test_adjoint_derivatives_are_the_transposed_directional_ones(both: tuple[Path, Path]) -> None:
    with UserInstance(UserFmu(both[1]), "me") as instance:
        instance.begin(0.0)
        instance.ready()
        instance.slope(0.0, np.array([0.1, 0.2, 0.3, 0.4]))
        library, component = instance._library, ctypes.c_void_p(instance._component)
        references = {v.name: v.valueReference for v in instance.fmu.description.modelVariables}
        unknown = [references[n] for n in ("der(state.motor_velocity)", "link_torque")]
        known = [references[n] for n in ("state.link_position", "i_m", "stiffness", "link_inertia")]
        u, k = (ctypes.c_uint32 * 2)(*unknown), (ctypes.c_uint32 * 4)(*known)
        matrix, two, four = np.empty((2, 4)), ctypes.c_size_t(2), ctypes.c_size_t(4)
        for j in range(4):
            seed, out = (ctypes.c_double * 4)(), (ctypes.c_double * 2)()
            seed[j] = 1.0
            arguments = (component, u, two, k, four, seed, four, out, two)
            assert library.fmi3GetDirectionalDerivative(*arguments) == 0
            matrix[:, j] = out[:]
        weights, found = (ctypes.c_double * 2)(0.3, -1.7), (ctypes.c_double * 4)()
        arguments = (component, u, two, k, four, weights, two, found, four)
        assert library.fmi3GetAdjointDerivative(*arguments) == 0
    assert np.count_nonzero(matrix) > 4
    np.testing.assert_allclose(found[:], np.array([0.3, -1.7]) @ matrix, rtol=1e-14)
