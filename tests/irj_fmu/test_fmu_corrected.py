"""A foreign FMU and the effect outside it as one FMU in C: the fitted pair, without Python."""

from __future__ import annotations

import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pytest

from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.online.estimator import OnlineOptions, estimated_parameters
from irj_fmu.corrected.build import export_corrected
from irj_fmu.estimator.native import NativeSpec
from irj_fmu.estimator.native_fmi3 import build_native_fmi3
from irj_fmu.fmi.compiler import find_compiler, header_folder
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.file import outside_correction
from irj_fmu.imported.library import UserFmu
from irj_fmu.imported.model import UserModel, load_user_model
from irj_fmu.imported.port import feedback_of
from irj_fmu.imported.run import Window
from irj_fmu.plant.reference import reference_joint
from tests.user_fmus.make import Make, build
from tests.user_fmus.plant import foreign

HERE: Final = Path(__file__).parents[1]
CS: Final = ("CoSimulation",)
SAME: Final = 1e-9
"""Of a fit's outputs, in their own units; what is asked for is 1e-6."""
LAWS: Final = {
    "quadratic_drag@motor": {"motor_quadratic_drag": 3.0},
    "stribeck@motor": {"motor_stribeck_extra": 2.0, "motor_stribeck_velocity": 0.1},
    "lugre@motor": {"motor_presliding_torque": 1.0, "motor_presliding_distance": 0.01},
    "torque_ripple": {"ripple_sine": 1.5, "ripple_cosine": 1.0, "ripple_order": 2.0},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("corrected")


def with_law(model: UserModel, *labels: str) -> UserModel:
    values = {PREFIX + k: v for label in labels for k, v in LAWS[label].items()}
    return replace(model, correction=outside_correction(list(labels), model.joint, values, "here"))


def axis(folder: Path, *labels: str, speed: bool = True, make: Make | None = None) -> UserModel:
    channels: dict[str, str | tuple[str, float]] = {
        "motor_torque": "torque",
        "motor_position": "angle",
    }
    model = load_user_model(
        build("Axis", folder, make or Make(2, CS, strict=True)),
        channels | ({"motor_velocity": "speed"} if speed else {}),
        ["inertia", "viscous"],
        start={"q": "motor_position", "w": "motor_velocity"},
        joint=Joint(name="user axis"),
    )
    model = model.with_values({"inertia": 2.5, "viscous": 0.7})
    return with_law(model, *labels) if labels else model


def exported(folder: Path, model: UserModel) -> Path:
    """The corrected FMU of an axis, built once for each law."""
    assert model.correction is not None
    path = folder / f"axis_{'_'.join(model.correction.labels)}_{len(model.outputs)}.fmu"
    return path if path.exists() else export_corrected(model, path)


def driven(model: UserModel, start: list[float], step: float, count: int = 400) -> Window:
    """The input of the C host, for the model's own run."""
    time = np.arange(count + 1) * step
    inputs = 8 * np.sin(5 * time)[:, None]
    return Window(time, inputs, np.empty((count + 1, len(model.outputs))), np.array(start))


def expected(model: UserModel, window: Window) -> npt.NDArray[np.float64]:
    values = {p.name: p.value for p in model.parameters}
    return model.runner().run(window, values, feedback=feedback_of(model, model.values))


def in_fmpy(path: Path, model: UserModel, window: Window, starts: dict[str, float]) -> Any:
    """Outputs of the model's channels at the samples, by fmpy's own loop."""
    from fmpy import simulate_fmu
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(path)) == []
    step, last = float(window.time[1]), float(window.time[-1])
    name = model.inputs[0].variable
    # the value at a sample holds until the next one: two points that are as near as numbers are
    time = np.column_stack([window.time, np.nextafter(np.append(window.time[1:], last + 1), 0)])
    table = np.zeros(time.size, dtype=[("time", float), (name, float)])
    table["time"], table[name] = time.ravel(), np.repeat(window.inputs[:, 0], 2)
    names = [m.variable for m in model.outputs]
    found = simulate_fmu(
        str(path),
        stop_time=last,
        output_interval=step,
        input=table,
        output=names,
        start_values=starts,
    )
    return np.column_stack([found[n] for n in names])


@pytest.mark.parametrize(
    ("labels", "speed"),
    [
        (("quadratic_drag@motor", "torque_ripple"), True),
        (("quadratic_drag@motor",), False),
        (("stribeck@motor",), True),
        (("lugre@motor",), True),
        (("lugre@motor",), False),
    ],
)
def test_the_corrected_fmu_gives_what_the_fit_gives(
    folder: Path, labels: tuple[str, ...], *, speed: bool
) -> None:
    model = axis(folder, *labels, speed=speed)
    path = exported(folder, model)
    for step in (1e-3, 4e-3):
        window = driven(model, [0.3, 0.1], step)
        found = in_fmpy(path, model, window, {"q": 0.3, "w": 0.1})
        wanted = expected(model, window)
        bare = expected(replace(model, correction=None), window)
        assert np.abs(wanted - bare).max() > 1e-3
        assert np.abs(found - wanted).max() < SAME


@pytest.mark.parametrize("label", ["quadratic_drag@motor", "lugre@motor"])
def test_fmi_3_gives_what_fmi_2_gives(folder: Path, label: str) -> None:
    """Two wrappers of one law, round the same model in two versions."""
    found = []
    for version in (2, 3):
        model = axis(folder, label, make=Make(version, CS, strict=True))
        path = export_corrected(model, folder / f"version{version}.fmu")
        assert f'fmiVersion="{version}.0"' in zipfile.ZipFile(path).read(
            "modelDescription.xml"
        ).decode("utf-8")
        window = driven(model, [0.3, 0.1], 4e-3)
        found.append(in_fmpy(path, model, window, {"q": 0.3, "w": 0.1}))
        assert np.abs(found[-1] - expected(model, window)).max() < SAME
    assert np.abs(found[0] - found[1]).max() < 1e-12


def test_arrays_and_other_types_of_fmi_3_go_through(folder: Path) -> None:
    """An estimator has whole numbers, flags, texts and arrays; the law beside it is zero."""
    from fmpy import read_model_description
    from fmpy.fmi3 import FMU3Slave

    joint = reference_joint("hd3")
    spec = NativeSpec(joint, "watch", OnlineOptions(optimise=False), None, 1e-3)
    bare = load_user_model(
        build_native_fmi3(spec, folder / "watch.fmu"),
        {"motor_current": "i_m", "motor_position": "q_l_hat"},
        joint=joint,
        kind="cs",
    )
    law = outside_correction(
        ["quadratic_drag@motor"], joint, {f"{PREFIX}motor_quadratic_drag": 0.0}, "here"
    )
    outer = export_corrected(replace(bare, correction=law), folder / "watched.fmu")
    found = []
    for path in (bare.fmu.path, outer):
        place = folder / f"{path.stem} apart"
        with zipfile.ZipFile(path) as archive:
            archive.extractall(place)
        about: Any = read_model_description(str(place))
        at = {v.name: v.valueReference for v in about.modelVariables}
        fmu = FMU3Slave(
            guid=about.guid,
            unzipDirectory=str(place),
            modelIdentifier=about.coSimulation.modelIdentifier,
            instanceName="one",
        )
        fmu.instantiate()
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        read = ["i_m", "q_m", "w_m", "q_l", "w_l", "tau_l"]
        for k in range(40):
            values = [np.sin(0.3 * k + j) for j in range(len(read))]
            fmu.setFloat64([at[n] for n in read], values)
            fmu.setBoolean([at["enable"], at["valid.q_l"]], [True, k % 2 == 0])
            fmu.doStep(k * 1e-3, 1e-3)
        # the drive is the wrapper's own, the arrays are the FMU's: one call for both
        count = 2 + 2 * len(estimated_parameters(joint))
        theta = fmu.getFloat64([at["i_m"], at["theta"], at["ratio.motor"], at["sigma"]], count)
        more = fmu.getInt32([at["n_samples"], at["n_rows"]]), fmu.getInt64([at["health"]])
        texts = fmu.getString([at["joint_file"]]), fmu.getBoolean([at["alarm"]])
        found.append((list(theta), *map(list, more), *map(list, texts)))
        assert len(found[-1][0]) == count
        with pytest.raises(Exception, match="getFloat64|GetFloat64"):
            fmu.getFloat64([at["i_m"], at["theta"]], 3)
        fmu.terminate()
        fmu.freeInstance()
    assert found[0] == found[1]
    assert found[0][1][0] == 40


def test_units_of_the_foreign_joint_are_those_of_its_ports(folder: Path) -> None:
    """A joint with gear, drive on the motor shaft, in two laws."""
    model = with_law(
        foreign(build("Elastic", folder, Make(2, CS, strict=True))),
        "stribeck@motor",
        "torque_ripple",
    )
    window = driven(model, [0.0, 0.0, 0.0, 0.0], 1e-3)
    window = replace(window, inputs=window.inputs / 8)
    found = in_fmpy(export_corrected(model, folder / "gear.fmu"), model, window, {})
    wanted = expected(model, window)
    span = np.ptp(wanted, axis=0)
    assert (np.abs(found - wanted).max(axis=0) < 1e-9 * span).all()


@pytest.fixture(scope="module")
def host(folder: Path) -> Path:
    out = folder / "host"
    command = [*find_compiler(), str(HERE / "fmu_run.c"), "-O1", f"-I{header_folder()}"]
    subprocess.run([*command, "-o", str(out), "-ldl", "-lm"], check=True)
    return out


def unpacked(path: Path, place: Path) -> tuple[Path, Any]:
    from fmpy import platform, read_model_description

    with zipfile.ZipFile(path) as archive:
        archive.extractall(place)
    description: Any = read_model_description(str(place))
    assert description.modelExchange is None
    called = description.coSimulation.modelIdentifier
    return place / "binaries" / platform / f"{called}.so", description


def run_host(
    host: Path, library: Path, about: Any, *more: str, guid: str | None = None
) -> subprocess.CompletedProcess[str]:
    at = {v.name: str(v.valueReference) for v in about.modelVariables}
    command = [str(host), str(library), guid or about.guid, "1e-3", "400"]
    command += [at["torque"], at["angle"], f"{at['q']}=0.3", f"{at['w']}=0.1", *more]
    return subprocess.run(command, env={}, cwd="/", capture_output=True, text=True, check=False)


@pytest.mark.parametrize("label", ["quadratic_drag@motor", "lugre@motor"])
def test_a_host_without_python_gets_the_same_in_any_folder(
    folder: Path, host: Path, label: str
) -> None:
    """Two instances, one of them reset half way, in a folder that needs encoding."""
    model = axis(folder, label)
    path = exported(folder, model)
    library, about = unpacked(path, folder / f"Größe 100% #1 {label}")
    linked = subprocess.run(["ldd", str(library)], capture_output=True, text=True, check=True)
    assert "python" not in linked.stdout
    done = run_host(host, library, about)
    assert (done.returncode, done.stderr) == (0, "")
    wanted = expected(model, driven(model, [0.3, 0.1], 1e-3))[1:, 0]
    assert np.abs(np.array(done.stdout.split(), dtype=float) - wanted).max() < SAME


def test_its_parameters_can_be_set_before_it_begins(folder: Path, host: Path) -> None:
    model = axis(folder, "quadratic_drag@motor")
    library, about = unpacked(exported(folder, model), folder / "set")
    at = {v.name: v for v in about.modelVariables}
    drag = at[f"{PREFIX}motor_quadratic_drag"]
    assert (float(drag.start), float(at["inertia"].start)) == (3.0, 2.5)
    done = run_host(host, library, about, f"{drag.valueReference}=0")
    bare = replace(model, correction=None)
    wanted = expected(bare, driven(bare, [0.3, 0.1], 1e-3))[1:, 0]
    assert np.abs(np.array(done.stdout.split(), dtype=float) - wanted).max() < SAME
    done = run_host(host, library, about, f"{drag.valueReference}=nan")
    assert done.returncode == 3
    assert "cannot be nan" in done.stderr


@pytest.mark.parametrize("status", [3, 4])
def test_an_inner_fmu_that_fails_is_an_error_with_a_line(
    folder: Path, host: Path, status: int
) -> None:
    model = axis(folder, "quadratic_drag@motor", make=Make(2, CS, fails=status))
    name = f"fails{status}"
    library, about = unpacked(export_corrected(model, folder / f"{name}.fmu"), folder / name)
    done = run_host(host, library, about)
    assert done.returncode == 4
    assert done.stderr.splitlines() == [
        "a 3 doStep: the inner FMU fails at t = 0.1 s",
        f"a 3 doStep: the inner FMU answers with status {status} (3 is an error)",
    ]


def test_what_is_wrong_or_missing_is_a_line_and_no_instance(folder: Path, host: Path) -> None:
    model = axis(folder, "quadratic_drag@motor")
    library, about = unpacked(exported(folder, model), folder / "go%ne")
    done = run_host(host, library, about, guid="{wrong}")
    assert (done.returncode, done.stderr.count("\n")) == (5, 1)
    assert "the GUID is not that of this library" in done.stderr
    inner = next((folder / "go%ne" / "resources" / "inner").rglob("*.so"))
    inner.write_bytes(b"no library")
    assert "cannot be loaded from resources/inner" in run_host(host, library, about).stderr
    inner.unlink()
    done = run_host(host, library, about)
    assert (done.returncode, done.stderr.count("\n")) == (5, 1)
    assert "go%ne/resources/inner/binaries" in done.stderr


def test_the_same_content_gives_the_same_bytes_and_another_guid_where_a_value_differs(
    folder: Path,
) -> None:
    from fmpy import read_model_description

    model = axis(folder, "quadratic_drag@motor")
    first = export_corrected(model, folder / "same.fmu").read_bytes()
    assert export_corrected(model, folder / "same.fmu").read_bytes() == first
    guids = {read_model_description(str(folder / "same.fmu")).guid}
    other = model.with_values({f"{PREFIX}motor_quadratic_drag": 2.0})
    guids.add(read_model_description(str(export_corrected(other, folder / "same.fmu"))).guid)
    assert len(guids) == 2


def test_what_cannot_be_corrected_in_c_is_said_in_one_line(folder: Path) -> None:
    bare = axis(folder)
    drag = axis(folder, "quadratic_drag@motor")
    exchange = UserFmu(build("Axis", folder, Make(2, ("ModelExchange",))))
    other = UserFmu(build("Axis", folder, Make(3, ("ModelExchange",))))
    sized = folder / "sized"
    with zipfile.ZipFile(build("Axis", folder, Make(3, CS))) as archive:
        archive.extractall(sized)
    about = (sized / "modelDescription.xml").read_text()
    more = (
        '<UInt64 name="size" valueReference="99" causality="structuralParameter" '
        'variability="fixed" start="2"/></ModelVariables>'
    )
    (sized / "modelDescription.xml").write_text(about.replace("</ModelVariables>", more))
    for model, target, line in (
        (bare, None, "no effect rides outside it"),
        (replace(drag, fmu=exchange), None, "needs it as co-simulation; export the pair"),
        (replace(drag, fmu=other), None, "needs it as co-simulation; export the pair"),
        (replace(drag, fmu=UserFmu(sized)), None, "size is a structural parameter, which"),
        (drag, "win64", "holds no library for win64, so nothing corrected can run there; it has "),
    ):
        with pytest.raises(InputError, match=line) as told:
            export_corrected(model, folder / "none.fmu", target=target)
        assert "\n" not in str(told.value)
    assert not (folder / "none.fmu").exists()


def test_valgrind_finds_nothing_in_a_run(folder: Path, host: Path) -> None:
    import shutil

    valgrind = shutil.which("valgrind")
    assert valgrind is not None, "install valgrind"
    model = axis(folder, "lugre@motor")
    library, about = unpacked(exported(folder, model), folder / "clean")
    at = {v.name: str(v.valueReference) for v in about.modelVariables}
    command = [valgrind, "--error-exitcode=9", "--leak-check=full", str(host), str(library)]
    command += [about.guid, "1e-3", "20", at["torque"], at["angle"]]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "ERROR SUMMARY: 0 errors" in done.stderr
