"""Plant FMUs: a two-mass elastic joint written in CasADi, against scipy and against itself."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from identification.errors import InputError
from irj_fmu.fmi.compiler import has_zig
from irj_fmu.fmi.variables import Variable
from irj_fmu.plant.library import PlantSpec, build_plant

FloatArray = npt.NDArray[np.float64]

STATES = (
    Variable("q_m", "rad", 0.1, display_unit="deg"),
    Variable("w_m", "rad/s"),
    Variable("q_l", "rad", display_unit="deg"),
    Variable("w_l", "rad/s"),
)
INPUTS = (Variable("tau_m", "N.m"), Variable("tau_e", "N.m"))
PARAMETERS = (
    Variable("J_m", "kg.m2", 0.6, minimum=1e-6),
    Variable("J_l", "kg.m2", 1.3, minimum=1e-6),
    Variable("k", "N.m/rad", 5000.0, variability="tunable"),
    Variable("d", "N.m.s/rad", 2.0, variability="tunable"),
    Variable("k3", "N.m/rad3", 1e5, variability="tunable"),
    Variable("f_v", "N.m.s/rad", 0.7, variability="tunable"),
    Variable("f_c", "N.m", 1.1, variability="tunable"),
    Variable("m_g_l", "N.m", 9.0, variability="tunable"),
)
OUTPUTS = (Variable("position", "rad"), Variable("spring", "N.m"), Variable("energy", "J"))
START = np.array([float(v.start) for v in PARAMETERS])


def joint(name: str = "two_mass", **options: object) -> PlantSpec:
    """Two inertias, a cubic spring with damper, viscous and smooth Coulomb friction, gravity on
    the link.
    """
    x, u, p = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("p", 8)
    twist, rate = x[0] - x[2], x[1] - x[3]
    spring = p[2] * twist + p[4] * twist**3
    torque = spring + p[3] * rate
    friction = p[5] * x[1] + p[6] * ca.tanh(x[1] / 0.05)
    dx = ca.vertcat(
        x[1], (u[0] - torque - friction) / p[0], x[3], (torque + u[1] - p[7] * ca.sin(x[2])) / p[1]
    )
    stored = p[0] * x[1] ** 2 / 2 + p[1] * x[3] ** 2 / 2 + p[2] * twist**2 / 2 + p[4] * twist**4 / 4
    y = ca.vertcat(x[2] + 1e-3 * u[1], torque, stored - p[7] * ca.cos(x[2]))
    return PlantSpec(
        name=name,
        dynamics=ca.Function("f", [x, u, p], [dx]),
        output=ca.Function("y", [x, u, p], [y]),
        states=STATES,
        inputs=INPUTS,
        parameters=PARAMETERS,
        outputs=OUTPUTS,
        description="Two masses and a spring.",
        **options,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_plant(joint(), tmp_path_factory.mktemp("plant") / "two_mass.fmu")


@pytest.fixture(scope="module")
def unzipped(fmu: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unzipped")
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(folder)
    return folder


def slave(
    unzipped: Path, *, exchange: bool = False, tolerance: float | None = None, init: bool = True
):  # type: ignore[no-untyped-def]  # noqa: ANN201
    from fmpy import read_model_description
    from fmpy.fmi2 import FMU2Model, FMU2Slave

    description = read_model_description(str(unzipped))
    part = description.modelExchange if exchange else description.coSimulation
    made = (FMU2Model if exchange else FMU2Slave)(
        guid=description.guid,
        unzipDirectory=str(unzipped),
        modelIdentifier=part.modelIdentifier,
        instanceName="plant",
    )
    made.instantiate()
    made.setupExperiment(startTime=0.0, tolerance=tolerance)
    made.enterInitializationMode()
    if init:
        made.exitInitializationMode()
    made.vr = {v.name: v.valueReference for v in description.modelVariables}
    return made


def reference(inputs: FloatArray, step: float) -> FloatArray:
    """Solve the joint with the input held over each step, written again in numpy, DOP853 at
    1e-13.
    """
    from scipy.integrate import solve_ivp

    j_m, j_l, k, d, k3, f_v, f_c, mgl = START

    def slope(_: float, x: FloatArray, u: FloatArray) -> list[float]:
        twist = x[0] - x[2]
        torque = k * twist + k3 * twist**3 + d * (x[1] - x[3])
        friction = f_v * x[1] + f_c * np.tanh(x[1] / 0.05)
        return [
            x[1],
            (u[0] - torque - friction) / j_m,
            x[3],
            (torque + u[1] - mgl * np.sin(x[2])) / j_l,
        ]

    x = np.array([0.1, 0.0, 0.0, 0.0])
    rows = [x]
    for u in inputs:
        x = solve_ivp(slope, (0.0, step), x, "DOP853", rtol=1e-12, atol=1e-14, args=(u,)).y[:, -1]
        rows.append(x)
    return np.array(rows)


def excitation(count: int, step: float) -> FloatArray:
    t = np.arange(count) * step
    return np.column_stack([12 * np.sin(7 * t) + 5 * np.sin(41 * t + 1), 3 * np.cos(5 * t)])


def test_validates_clean(fmu: Path) -> None:
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(fmu)) == []


def test_fmutool_check_is_clean(fmu: Path, tmp_path: Path) -> None:
    tool = Path(sys.executable).with_name("fmutool")
    done = subprocess.run(
        [tool, "-input", str(fmu), "-check"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0
    assert "compliant with FMI-2" in done.stdout + done.stderr
    assert "No semantic error" in done.stdout + done.stderr


def test_casadi_imports_it_with_exact_jacobians(unzipped: Path) -> None:
    """DaeBuilder reads the model exchange back; its Jacobians are those of the symbolic plant,
    parameters included.
    """
    spec = joint()
    tunable = [i for i, v in enumerate(PARAMETERS) if v.variability == "tunable"]
    builder = ca.DaeBuilder("two_mass", str(unzipped))
    assert builder.p() == [PARAMETERS[i].name for i in tunable]
    model = builder.create("model", ["x", "u", "p"], ["ode", "y"])
    x, u = np.array([0.1, 0.2, 0.05, -0.1]), np.array([1.0, 2.0])
    found = [block.full() for block in model.jacobian()(x, u, START[tunable], 0, 0)]
    for row, function in enumerate((spec.dynamics, spec.output)):
        expected = [block.full() for block in function.jacobian()(x, u, START, 0)]
        expected[2] = expected[2][:, tunable]
        for one, other in zip(found[3 * row : 3 * row + 3], expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_co_simulation_follows_scipy(unzipped: Path) -> None:
    step, count = 1e-3, 500
    inputs = excitation(count, step)
    expected = reference(inputs, step)
    plant = slave(unzipped)
    states = [plant.vr[v.name] for v in STATES]
    rows = [plant.getReal(states)]
    for i, u in enumerate(inputs):
        plant.setReal([plant.vr["tau_m"], plant.vr["tau_e"]], list(u))
        plant.doStep(i * step, step)
        rows.append(plant.getReal(states))
    plant.terminate()
    plant.freeInstance()
    error = np.abs(np.array(rows) - expected).max(axis=0)
    assert max(error[0], error[2]) <= 1e-8
    assert max(error[1], error[3]) <= 1e-6


def test_host_tolerance_is_used(unzipped: Path) -> None:
    inputs = excitation(200, 1e-3)
    expected = reference(inputs, 1e-3)[-1, 2]
    errors = []
    for tolerance in (1e-3, 1e-11):
        plant = slave(unzipped, tolerance=tolerance)
        for i, u in enumerate(inputs):
            plant.setReal([plant.vr["tau_m"], plant.vr["tau_e"]], list(u))
            plant.doStep(i * 1e-3, 1e-3)
        errors.append(abs(plant.getReal([plant.vr["q_l"]])[0] - expected))
        plant.freeInstance()
    assert errors[1] < 1e-11
    assert 10 * errors[1] < errors[0] < 1e-3


def test_input_derivatives_make_a_ramp(unzipped: Path) -> None:
    """One step with du/dt set equals the limit of many held steps."""
    fine, coarse = slave(unzipped), slave(unzipped)
    vr = fine.vr["tau_m"]
    count = 2000
    for i in range(count):
        fine.setReal([vr], [50.0 * (i + 0.5) * 0.1 / count])
        fine.doStep(i * 0.1 / count, 0.1 / count)
    coarse.setRealInputDerivatives([vr], [1], [50.0])
    coarse.doStep(0.0, 0.1)
    position = fine.vr["q_l"]
    assert coarse.getReal([position])[0] == pytest.approx(fine.getReal([position])[0], abs=1e-8)
    assert coarse.getReal([vr])[0] == pytest.approx(5.0)
    fine.freeInstance()
    coarse.freeInstance()


@pytest.mark.parametrize("exchange", [False, True])
def test_directional_derivatives(unzipped: Path, exchange: bool) -> None:
    """Against central differences of the numpy-independent CasADi functions, for each state,
    input and parameter.
    """
    spec = joint()
    rng = np.random.default_rng(3)
    x, u = rng.normal(0, 0.1, 4), rng.normal(0, 2, 2)
    point = [x, u, START]
    plant = slave(unzipped, exchange=exchange, init=False)
    plant.setReal([plant.vr[v.name] for v in (*STATES, *INPUTS)], [*x, *u])
    plant.exitInitializationMode()
    unknown = [plant.vr[f"der({v.name})"] for v in STATES] + [plant.vr[v.name] for v in OUTPUTS]
    for group, variables in enumerate((STATES, INPUTS, PARAMETERS)):
        for i, variable in enumerate(variables):
            h = 1e-6 * max(1.0, abs(point[group][i])) if group < 2 else 1e-5 * abs(point[group][i])
            sides = []
            for sign in (1, -1):
                moved = [v.copy() for v in point]
                moved[group][i] += sign * h
                sides.append(
                    np.concatenate([f(*moved).full().ravel() for f in (spec.dynamics, spec.output)])
                )
            expected = (sides[0] - sides[1]) / (2 * h)
            found = np.array(
                plant.getDirectionalDerivative(unknown, [plant.vr[variable.name]], [1.0])
            )
            np.testing.assert_allclose(
                found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max()
            )
    plant.freeInstance()


def test_energy_is_kept(unzipped: Path) -> None:
    plant = slave(unzipped, tolerance=1e-11)
    plant.setReal([plant.vr[name] for name in ("d", "f_v", "f_c")], [0.0, 0.0, 0.0])
    before = plant.getReal([plant.vr["energy"]])[0]
    for i in range(2000):
        plant.doStep(i * 1e-3, 1e-3)
    assert plant.getReal([plant.vr["energy"]])[0] == pytest.approx(before, rel=1e-8)
    plant.freeInstance()


def test_state_rolls_back_and_survives_serialisation(unzipped: Path) -> None:
    plant, other = slave(unzipped), slave(unzipped)
    states = [plant.vr[v.name] for v in STATES]
    for i in range(20):
        plant.setReal([plant.vr["tau_m"]], [float(i)])
        plant.doStep(i * 1e-3, 1e-3)
    saved = plant.getFMUState()
    data = plant.serializeFMUState(saved)
    plant.doStep(0.02, 5e-3)
    first = plant.getReal(states)
    plant.setFMUState(saved)
    plant.doStep(0.02, 5e-3)
    assert plant.getReal(states) == first
    restored = other.deserializeFMUState(data)
    other.setFMUState(restored)
    other.doStep(0.02, 5e-3)
    assert other.getReal(states) == first
    for instance, state in ((plant, saved), (other, restored)):
        instance.freeFMUState(state)
        instance.freeInstance()


def test_fixed_and_tunable(unzipped: Path) -> None:
    plant = slave(unzipped, init=False)
    plant.setReal([plant.vr["J_m"]], [0.5])
    plant.exitInitializationMode()
    plant.setReal([plant.vr["k"]], [4000.0])
    for name in ("J_m", "position", "der(q_m)", "q_m"):
        with pytest.raises(Exception, match="fmi2SetReal"):
            plant.setReal([plant.vr[name]], [0.4])
    assert plant.getReal([plant.vr["J_m"], plant.vr["k"]]) == [0.5, 4000.0]
    plant.freeInstance()


def test_not_finite_input_is_an_error_and_keeps_the_state(unzipped: Path) -> None:
    plant = slave(unzipped)
    states = [plant.vr[v.name] for v in STATES]
    plant.doStep(0.0, 1e-3)
    before = plant.getReal(states)
    plant.setReal([plant.vr["tau_m"]], [float("nan")])
    with pytest.raises(Exception, match="fmi2DoStep"):
        plant.doStep(1e-3, 1e-3)
    assert plant.getReal(states) == before
    plant.freeInstance()


def hysteretic() -> PlantSpec:
    """A mass on an elasto-plastic (Jenkin) element: z is its force, limited at 2 N."""
    x, z, u, p, old = (
        ca.SX.sym("x", 2),
        ca.SX.sym("z"),
        ca.SX.sym("u"),
        ca.SX.sym("p", 2),
        ca.SX.sym("o", 2),
    )
    force = ca.fmin(ca.fmax(z + p[0] * (x[0] - old[0]), -2.0), 2.0)
    return PlantSpec(
        name="jenkin",
        dynamics=ca.Function("f", [x, u, p, z], [ca.vertcat(x[1], (u - z) / p[1])]),
        output=ca.Function("y", [x, u, p, z], [z]),
        states=(Variable("x", "m"), Variable("v", "m/s", 0.5)),
        inputs=(Variable("u", "N"),),
        parameters=(Variable("k", "N/m", 100.0), Variable("m", "kg", 1.0)),
        outputs=(Variable("force", "N"),),
        update=ca.Function("z", [x, z, u, p, old], [force]),
        memory=(Variable("z", "N"),),
    )


def test_memory_follows_the_analytic_hysteresis(tmp_path: Path) -> None:
    """Elastic quarter wave up to the limit, sliding at constant force, elastic return: closed
    form.
    """
    from fmpy import extract, read_model_description
    from fmpy.validation import validate_fmu

    path = build_plant(hysteretic(), tmp_path / "jenkin.fmu")
    assert validate_fmu(str(path)) == []
    folder = tmp_path / "open"
    extract(str(path), str(folder))
    assert read_model_description(str(folder)).modelExchange is None
    plant = slave(folder)
    names = [plant.vr[name] for name in ("x", "v", "force")]
    t_limit = np.arcsin(2.0 / 100.0 / 0.05) / 10.0
    v_limit = 0.5 * np.cos(10 * t_limit)
    t_stop = t_limit + v_limit / 2.0
    x_stop = 0.02 + v_limit**2 / 4.0
    for i in range(400):
        plant.doStep(i * 1e-3, 1e-3)
        t = (i + 1) * 1e-3
        x, _, force = plant.getReal(names)
        if t < t_limit:
            expected = 0.05 * np.sin(10 * t)
        elif t < t_stop:
            expected = 0.02 + v_limit * (t - t_limit) - (t - t_limit) ** 2
            assert force == pytest.approx(2.0)
        else:
            expected = x_stop - 0.02 * (1 - np.cos(10 * (t - t_stop)))
        assert x == pytest.approx(expected, abs=2e-7)
    plant.freeInstance()


def test_same_bytes_again(fmu: Path, tmp_path: Path) -> None:
    assert build_plant(joint(), tmp_path / "again.fmu").read_bytes() == fmu.read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(not has_zig(), reason="ziglang is not installed")
def test_cross_compiles_for_all_platforms(tmp_path: Path) -> None:
    path = build_plant(joint(), tmp_path / "all.fmu", cc="zig", target="all")
    magic = {
        "binaries/linux64/two_mass.so": b"\x7fELF",
        "binaries/aarch64-linux/two_mass.so": b"\x7fELF",
        "binaries/win64/two_mass.dll": b"MZ",
        "binaries/darwin64/two_mass.dylib": b"\xca\xfe\xba\xbe",
    }
    with zipfile.ZipFile(path) as archive:
        assert {name: archive.read(name)[: len(code)] for name, code in magic.items()} == magic
    again = build_plant(joint(), tmp_path / "again.fmu", cc="zig", target="all")
    assert again.read_bytes() == path.read_bytes()


def test_says_what_is_missing_without_a_compiler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("irj_fmu.fmi.compiler.shutil.which", lambda _: None)
    monkeypatch.setattr("irj_fmu.fmi.compiler.has_zig", lambda: False)
    with pytest.raises(InputError, match="estimator FMUs still build.*pip install ziglang"):
        build_plant(joint(), tmp_path / "a.fmu")
    assert list(tmp_path.iterdir()) == []


def test_refuses_an_unusable_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        build_plant(joint(), tmp_path / "file" / "a.fmu")
    with pytest.raises(InputError, match=r"\.fmu"):
        build_plant(joint(), tmp_path / "a.zip")


@pytest.mark.parametrize(
    ("cc", "said"), [("false", "said nothing and ended with 1"), ("true", "it made no library")]
)
def test_refuses_a_failing_compiler_without_leaving_a_file(
    tmp_path: Path, cc: str, said: str
) -> None:
    with pytest.raises(InputError, match=f"compiler '{cc}' failed for .*{said}"):
        build_plant(joint(), tmp_path / "a.fmu", cc=cc)
    assert list(tmp_path.iterdir()) == []


def test_refuses_functions_that_do_not_fit() -> None:
    from dataclasses import replace

    spec = joint()
    with pytest.raises(InputError, match="dynamics takes vectors"):
        build_plant(replace(spec, states=STATES[:3]), Path("a.fmu"))
    with pytest.raises(InputError, match="C identifier"):
        build_plant(replace(spec, name="two mass"), Path("a.fmu"))
    with pytest.raises(InputError, match="declared twice"):
        build_plant(replace(spec, inputs=(INPUTS[0], INPUTS[0])), Path("a.fmu"))
