"""Somebody else's FMU as the model: FMI 2.0 and 3.0, model exchange and co-simulation, black
box and exact derivatives.
"""

from __future__ import annotations

import importlib
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import EFFECTS
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.improve import RATIO_LIMIT
from identification.errors import InputError
from irj_fmu.host.exchange import Stepper
from irj_fmu.host.run import Fmu, FmuError, Instance, Wiring, simulate_cs
from irj_fmu.host.signals import Table
from irj_fmu.imported.compare import compare
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.diagnose import diagnose, laid_open
from irj_fmu.imported.exact import Imported, NotExact, patched_copy
from irj_fmu.imported.export import export_pair, export_system
from irj_fmu.imported.file import (
    is_user_joint,
    load_user_joint,
    outside_correction,
    user_joint_text,
)
from irj_fmu.imported.fit import fit
from irj_fmu.imported.library import UserFmu, UserInstance
from irj_fmu.imported.model import UserModel, load_user_model, start_values
from irj_fmu.imported.outputs import noise_of
from irj_fmu.imported.port import feedback_of
from irj_fmu.imported.sensitivity import BlackBox
from tests.user_fmus.make import MODELS, Make, build, check
from tests.user_fmus.plant import foreign, recorded
from tests.user_fmus.records import TRUTH, axis, dahlquist, van_der_pol

FloatArray = npt.NDArray[np.float64]
ME, CS = ("ModelExchange",), ("CoSimulation",)
EVERY = [(version, kinds) for version in (2, 3) for kinds in (ME, CS)]
DRAG = 0.15


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("user")


def fmu(folder: Path, name: str, make: Make | None = None) -> Path:
    return build(name, folder, make)


CHANNELS = {"motor_torque": "torque", "motor_position": "angle"}
START = {"q": "motor_position", "w": "motor_velocity"}
PARAMETERS = ["inertia", "viscous", "coulomb", "gravity"]


def axis_model(
    path: Path,
    parameters: list[str] | dict[str, tuple[float, float]] | None = None,
    **options: object,
) -> UserModel:
    given = {"start": START, "window": 0.5, "joint": Joint(name="user axis")} | options
    return load_user_model(path, CHANNELS, parameters or PARAMETERS, **given)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def plain() -> Record:
    return axis()


@pytest.fixture(scope="module")
def dragged() -> Record:
    return axis(lambda _q, w: DRAG * w * abs(w), seconds=12.0, h=4e-3)


# --- parameters from data -------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("version", [2, 3])
def test_the_test_fmus_are_valid(folder: Path, name: str, version: int) -> None:
    assert check(fmu(folder, name, Make(version))) == []


@pytest.mark.parametrize(("version", "kinds"), EVERY)
def test_parameters_of_strict_fmus_are_recovered_through_the_black_box(
    folder: Path, version: int, kinds: tuple[str, ...]
) -> None:
    make = Make(version, kinds, strict=True)
    model = load_user_model(
        fmu(folder, "VanDerPol", make),
        {"motor_position": "y0", "motor_velocity": "y1"},
        {"mu": (0.1, 5.0)},
    )
    found = fit(model, van_der_pol(2.3))
    assert found.method.startswith("black box")
    assert found.values["mu"] == pytest.approx(2.3, rel=1e-4)
    assert abs(found.values["mu"] - 2.3) < 5 * (found.stderr["mu"] or 0.0)
    assert all(0.9 < e.ratio < 1.1 for e in found.train.outputs.values())
    model = load_user_model(fmu(folder, "Dahlquist", make), {"motor_position": "y"}, ["k"])
    decayed = fit(model, dahlquist(0.8))
    assert decayed.method.startswith("black box")
    assert decayed.values["k"] == pytest.approx(0.8, rel=1e-3)
    assert abs(decayed.values["k"] - 0.8) < 5 * (decayed.stderr["k"] or 0.0)


@pytest.mark.parametrize("version", [2, 3])
def test_exact_derivatives_give_the_fit_of_the_black_box(folder: Path, version: int) -> None:
    model = load_user_model(
        fmu(folder, "VanDerPol", Make(version)),
        {"motor_position": "y0", "motor_velocity": "y1"},
        {"mu": (0.1, 5.0)},
    )
    record = van_der_pol(2.3)
    exact, differences = fit(model, record), fit(model, record, exact=False)
    assert exact.method.startswith("exact")
    assert differences.method.startswith("black box")
    assert exact.values["mu"] == pytest.approx(differences.values["mu"], rel=1e-6)
    assert exact.stderr["mu"] == pytest.approx(differences.stderr["mu"], rel=0.02)


@pytest.mark.parametrize(("version", "kinds"), [(2, ME), (3, CS)])
def test_an_axis_with_noisy_starts_that_are_estimated(
    folder: Path, plain: Record, version: int, kinds: tuple[str, ...]
) -> None:
    model = axis_model(fmu(folder, "Axis", Make(version, kinds)), [*PARAMETERS, "idle"])
    found = fit(model, plain.window(0, 3))
    assert found.method.startswith("exact" if kinds == ME else "black box")
    for name, value in TRUTH.items():
        assert abs(found.values[name] - value) < 5 * (found.stderr[name] or 0.0), name
        assert found.values[name] == pytest.approx(value, rel=2e-3)
    assert found.unmoved == ("idle",)
    assert found.stderr["idle"] is None
    assert not found.parameters["idle"]["identifiable"]
    assert 0.85 < found.train.outputs["motor_position"].ratio < 1.15


def test_start_values_at_a_turn_of_dry_friction_have_slopes(folder: Path) -> None:
    """A ten-thousandth of the range throws such a window to the other side of the turn."""
    path = fmu(folder, "Elastic", Make(2, CS, strict=True))
    model, record = foreign(path), recorded(None, 2.0, 1)
    windows = model.windows([record])
    starts = start_values(windows)
    box = BlackBox(model, windows, noise_of(model, [record]))
    _, found = box.sensitivities(model.values, starts, [])
    size = np.concatenate([w.outputs for w in windows]).std(axis=0)
    for i in range(starts.shape[1]):
        step, sides = 1e-8 * np.ptp(starts[:, i]), []
        for sign in (1, -1):
            moved = starts.copy()
            moved[:, i] += sign * step
            sides.append(box.simulate(model.values, moved))
        for slope, up, down in zip(found, *sides, strict=True):
            true = (up - down) / (2 * step) / size
            off = np.abs(slope[:, :, i] / size - true).max(axis=0)
            assert (off < 0.05 * np.abs(true).max(axis=0)).all(), model.starts[i]


def test_a_value_that_ends_at_its_bound_is_said(folder: Path, plain: Record) -> None:
    path = fmu(folder, "Axis", Make(2, CS))
    bounds = dict.fromkeys(PARAMETERS, (-math.inf, math.inf)) | {"gravity": (0.0, 5.5)}
    found = fit(axis_model(path, bounds), plain.window(0, 3))
    assert found.at_bound == ("gravity",)
    assert found.stderr["gravity"] is None
    assert found.parameters["gravity"]["at_bound"]


def test_compare_tells_the_true_values_from_wrong_ones(folder: Path, plain: Record) -> None:
    model = axis_model(fmu(folder, "Axis", Make(3, CS))).with_values(TRUTH)
    right = compare(model, plain.window(5, 8)).outputs["motor_position"]
    wrong = compare(model.with_values({"viscous": 1.2}), plain.window(5, 8)).outputs[
        "motor_position"
    ]
    assert 0.8 < right.ratio < 1.15
    assert wrong.ratio > 10
    assert wrong.fit_percent < right.fit_percent


# --- exact derivatives, and where they do not check out -------------------------------------------


def derivatives(p: FloatArray, x: FloatArray, u: float) -> tuple[FloatArray, FloatArray]:
    """Of the axis's acceleration with respect to states and parameters."""
    j, d, c, g, _ = p
    t = math.tanh(x[1] / 0.01)
    acceleration = (u - d * x[1] - c * t - g * math.sin(x[0])) / j
    states = [-g * math.cos(x[0]) / j, -(d + c * (1 - t * t) / 0.01) / j]
    return np.array(states), np.array(
        [-acceleration / j, -x[1] / j, -t / j, -math.sin(x[0]) / j, 0.0]
    )


@pytest.mark.parametrize("version", [2, 3])
def test_imported_derivatives_are_those_of_the_equations(folder: Path, version: int) -> None:
    imported = Imported(axis_model(fmu(folder, "Axis", Make(version, ME))))
    x, p, u = np.array([0.3, 0.004]), np.array([2.0, 1.0, 1.5, 5.0, 1.0]), 2.0
    found = [np.asarray(v) for v in imported._j(x, [u], p)]
    states, parameters = derivatives(p, x, u)
    np.testing.assert_allclose(found[2][1], states, rtol=1e-12)
    np.testing.assert_allclose(found[3][1], parameters, rtol=1e-12, atol=1e-15)


def test_dependencies_without_parameters_give_wrong_derivatives_unless_rewritten(
    folder: Path, plain: Record, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The trap of FMI 3.0: `dependencies` lists states and inputs, and the importer then knows
    no parameters.
    """
    model = axis_model(fmu(folder, "Axis", Make(3, ME)))
    windows = model.windows([plain.window(0, 2)])
    Imported(model).check(windows)

    def untouched(user: UserFmu) -> Path:
        import shutil

        return Path(shutil.copytree(user.folder, tmp_path / "raw"))

    monkeypatch.setattr("irj_fmu.imported.exact.patched_copy", untouched)
    trapped = Imported(model)
    x, p, u = np.array([0.3, 0.004]), np.array([2.0, 1.0, 1.5, 5.0, 1.0]), 2.0
    assert not np.any(np.asarray(trapped._j(x, [u], p)[3]))
    with pytest.raises(NotExact, match="differ from difference quotients"):
        trapped.check(windows)
    copy = patched_copy(model.fmu)
    text = (copy / "modelDescription.xml").read_text()
    shutil.rmtree(copy)
    assert 'dependencies="1 2 21 31 32 33 34 35"' in text


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (Make(2, ME, wrong=True), "differ from difference quotients"),
        (Make(2, ME, strict=True, says="tunable"), "refuses"),
        (Make(2, ME, strict=True), "before initialization only"),
        (Make(2, ME, derivatives=False), "promises no directional derivatives"),
        (Make(2, CS), "co-simulation"),
    ],
    ids=["wrong", "refuses", "fixed", "none", "cs"],
)
def test_an_fmu_without_usable_derivatives_is_a_black_box_and_it_is_said(
    folder: Path, plain: Record, make: Make, why: str
) -> None:
    model = axis_model(fmu(folder, "Axis", make), ["inertia"]).with_values(TRUTH)
    model = replace(model, constants={k: v for k, v in TRUTH.items() if k != "inertia"})
    found = fit(model, plain.window(0, 1))
    assert found.method.startswith("black box: ")
    assert why in found.method
    assert found.values["inertia"] == pytest.approx(TRUTH["inertia"], rel=2e-3)


def test_model_exchange_follows_scipy(folder: Path) -> None:
    from scipy.integrate import solve_ivp

    exact = solve_ivp(
        lambda _t, x: [x[1], 1.0 * (1 - x[0] ** 2) * x[1] - x[0]],
        (0, 5),
        [2, 0],
        "DOP853",
        rtol=1e-12,
        atol=1e-13,
    ).y[:, -1]
    for version in (2, 3):
        accepted: list[float] = []
        with UserInstance(UserFmu(fmu(folder, "VanDerPol", Make(version))), "me") as instance:
            instance.begin(0.0)
            x = instance.ready()
            stepper = Stepper(
                "VanDerPol",
                instance.nominals(),
                1e-10,
                1e-12,
                lambda t, _x, seen=accepted: seen.append(t),
            )
            x = stepper.advance(instance.slope, 0.0, 5.0, x)
        np.testing.assert_allclose(x, exact, atol=1e-7)
        assert accepted == sorted(accepted)
        assert accepted[-1] == pytest.approx(5.0)


# --- what is missing ------------------------------------------------------------------------------


def test_nothing_is_missing_from_the_true_model(folder: Path, plain: Record) -> None:
    model = axis_model(fmu(folder, "Axis", Make(2, CS))).with_values(TRUTH)
    found = diagnose(model, plain)
    assert found.claims == ()
    assert 0.8 < found.error.balances["axis"].ratio < 1.2
    with pytest.raises(InputError, match="nothing significant"):
        found.add()


@pytest.mark.slow
@pytest.mark.parametrize(("version", "kinds"), [(2, CS), (3, CS)])
def test_a_hidden_effect_is_named_added_outside_and_explains_the_rest(
    folder: Path, dragged: Record, version: int, kinds: tuple[str, ...]
) -> None:
    train, held = dragged.window(0, 7), dragged.window(7, 12)
    model = fit(axis_model(fmu(folder, "Axis", Make(version, kinds))), train).model
    before = compare(model, held).outputs["motor_position"]
    found = diagnose(model, train, held)
    assert found.claims[0].effects[0] == "quadratic_drag"
    assert found.error.balances["axis"].ratio > RATIO_LIMIT
    larger = found.refit()
    assert larger.model.correction is not None
    assert larger.values[f"{PREFIX}motor_quadratic_drag"] == pytest.approx(DRAG, rel=0.05)
    for name, value in TRUTH.items():
        assert larger.values[name] == pytest.approx(value, rel=0.02)
    after = compare(larger, held).outputs["motor_position"]
    assert before.ratio > 5
    assert after.ratio < 2
    assert diagnose(larger.model, train, held).claims == ()


def test_a_wrong_name_may_lead_nowhere(folder: Path, dragged: Record) -> None:
    """Losses of the transmission hold the viscous friction that the FMU has itself: along what the
    two leave a fit ran off to where the FMU does not move, and took the diagnosis with it.
    """
    train, held = dragged.window(0, 7), dragged.window(7, 12)
    model = fit(axis_model(fmu(folder, "Axis", Make(2, CS))), train).model
    bench = laid_open(model, train, held).bench
    bare = bench.start()
    wrong = bench.fitted(bare.model.add("transmission_losses@motor"), bare.values)
    before, after = (bench.step(None, None, s).train for s in (bare, wrong))
    assert after.relative_error_percent < before.relative_error_percent
    change = bench.changes(wrong)["inertia"]
    assert abs(change) < 0.1 * TRUTH["inertia"]


# --- export ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair(folder: Path) -> UserModel:
    channels = {**CHANNELS, "motor_velocity": "speed"}
    model = load_user_model(
        fmu(folder, "Axis", Make(2, CS)),
        channels,
        ["inertia", "viscous"],
        start=START,
        joint=Joint(name="user axis"),
    )
    model = replace(
        model,
        correction=outside_correction(
            ["quadratic_drag@motor"], model.joint, {f"{PREFIX}motor_quadratic_drag": DRAG}, "test"
        ),
    )
    return model.with_values({"inertia": 2.5, "viscous": 0.7})


def outside_run(model: UserModel, record: Record) -> FloatArray:
    window = model.windows([record])[0]
    values = {p.name: p.value for p in model.parameters}
    assert model.correction is not None
    return model.runner().run(window, values, feedback=feedback_of(model, model.values))


@pytest.mark.parametrize(
    ("version", "kinds"), [(2, CS), pytest.param(3, ME, marks=pytest.mark.slow)]
)
def test_the_pair_as_one_fmu_is_the_pair_in_memory(
    folder: Path, pair: UserModel, plain: Record, version: int, kinds: tuple[str, ...]
) -> None:
    from fmpy.validation import validate_fmu

    inner = UserFmu(fmu(folder, "Axis", Make(version, kinds)))
    model = replace(pair, fmu=inner, kind="me" if kinds == ME else "cs")
    record = plain.window(0, 1).with_channel(
        "motor_velocity", np.gradient(plain.window(0, 1)["motor_position"], 2e-3)
    )
    expected = outside_run(model, record)
    bare = model.runner().run(
        model.windows([record])[0], {p.name: p.value for p in model.parameters}
    )
    path = export_pair(model, folder / f"pair{version}.fmu")
    assert validate_fmu(str(path)) == []
    start = model.windows([record])[0].start
    for step in (2e-3, 1e-3):
        with Fmu(path) as built, Instance(built, name="pair") as instance:
            wiring = Wiring(
                inputs={"pair.torque": Table(record.time, record["motor_torque"])},
                record=["pair.angle", "pair.health"],
                parameters={
                    "pair.q": float(start[0]),
                    "pair.w": float(start[1]),
                    "pair.sample_time": step,
                },
            )
            found = simulate_cs(instance, wiring, step=2e-3, stop=float(record.time[-1]))
        assert found["pair.health"].max() == 0
        error = np.abs(found["pair.angle"] - expected[:, 0]).max()
        assert error < (1e-9 if step == 1e-3 else 0.05 * np.abs(expected - bare).max())


def test_what_fits_no_single_window_is_refused_before_all_of_them(folder: Path) -> None:
    """The speed is said to run backwards."""
    path = fmu(folder, "Axis", Make(2, CS))
    model = load_user_model(
        path,
        {"motor_torque": "torque", "motor_position": "angle", "motor_velocity": "speed"},
        ["inertia", "viscous"],
        start=START,
        window=0.5,
    )
    angle, speed = model.outputs
    wrong = replace(model, outputs=(angle, replace(speed, scale=-1.0)))
    record = axis(seconds=4.0)
    record = record.with_channel(
        "motor_velocity", np.gradient(record["motor_position"], record.time)
    )
    texts: list[str] = []
    with pytest.raises(InputError, match=r"bring motor_velocity nearer .* than standing still"):
        fit(wrong, record, progress=lambda text, _: texts.append(text))
    assert any(text.startswith("fitting one of 8 windows") for text in texts)
    assert not any("step" in text for text in texts)


def test_the_pair_of_fmi_3_is_that_of_fmi_2(folder: Path, pair: UserModel) -> None:
    from fmpy.validation import validate_fmu

    time = np.arange(201) / 500
    found = []
    for fmi in (2, 3):
        path = export_pair(pair, folder / f"pair of fmi {fmi}.fmu", fmi=fmi)
        assert validate_fmu(str(path)) == []
        with Fmu(path) as built, Instance(built, name="pair") as instance:
            assert built.version == fmi
            wiring = Wiring(
                inputs={"pair.torque": Table(time, 5 * np.sin(40 * time))},
                record=["pair.angle", "pair.health", "pair.n_samples"],
                parameters={"pair.q": 0.1, "pair.viscous": 0.8},
            )
            for _ in range(2):  # a second run after a reset
                run = simulate_cs(instance, wiring, step=2e-3, stop=0.4)
            found.append(np.column_stack([run[n] for n in wiring.record]))
    assert np.ptp(found[0], axis=0).tolist()[1] == 0 and np.ptp(found[0][:, 0]) > 1e-3
    np.testing.assert_allclose(found[1], found[0], rtol=1e-12, atol=0)


def test_the_pair_as_a_system_opens_in_fmpy(folder: Path, pair: UserModel) -> None:
    from fmpy.ssp.ssd import read_ssd

    path = export_system(pair, folder / "pair.ssp", shim=False)
    found = read_ssd(str(path))
    assert {e.name for e in found.system.elements} == {"outside", "fmu"}
    ends = {
        (c.startElement, c.startConnector, c.endElement, c.endConnector)
        for c in found.system.connections
    }
    assert ends == {
        ("outside", "corrected", "fmu", "torque"),
        ("fmu", "angle", "outside", "position"),
        ("fmu", "speed", "outside", "velocity"),
    }
    with pytest.raises(InputError, match="export the pair as one FMU"):
        export_system(
            replace(pair, fmu=UserFmu(fmu(folder, "Axis", Make(3)))), folder / "other.ssp"
        )


# --- files and commands ---------------------------------------------------------------------------

FILE = """[joint]
name = "user axis"
[model]
fmu = "{fmu}"
window = 0.5
[model.channels]
motor_torque = "torque"
motor_position = "angle"
[model.parameters]
inertia = {{ low = 0.5, high = 10.0 }}
viscous = {{ low = 0.0 }}
coulomb = {{}}
gravity = {{}}
[model.start]
q = "motor_position"
w = "motor_velocity"
"""


def irj(*arguments: str) -> int:
    """`irj`, with the module that the joint file asks for."""
    from workbench.cli.main import parser as made
    from workbench.cli.user_fmu import module_of

    parser = made()
    given, rest = parser.parse_known_args(arguments)
    if given.verb == "diagnose" and rest[:1] == ["-o"]:
        given.output, rest = rest[1], rest[2:]
    given.rest = rest
    given.command = "irj"
    module = importlib.import_module(f"workbench.cli.{module_of(given)}")
    return int(getattr(module, f"run_{given.verb}")(given))


def test_commands_with_an_fmu_as_the_model(
    folder: Path, dragged: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = fmu(folder, "Axis", Make(2, CS))
    joint = tmp_path / "user.toml"
    joint.write_text(FILE.format(fmu=path))
    for name, window in (("train", (0, 6)), ("held", (6, 12))):
        part = dragged.window(*window)
        np.savez(
            tmp_path / f"{name}.npz",
            **{
                "time_s": part.time,
                "motor_position_rad": part["motor_position"],
                "motor_torque_N.m": part["motor_torque"],
            },
        )
    train, held = str(tmp_path / "train.npz"), str(tmp_path / "held.npz")
    fitted, larger, final = (str(tmp_path / f"{n}.toml") for n in ("fitted", "larger", "final"))
    assert irj("fit", train, "--joint", str(joint), "-o", fitted) == 0
    assert irj("add", "quadratic_drag@motor", "--joint", fitted, "-o", larger) == 0
    assert load_user_joint(larger).values["inertia"] == load_user_joint(fitted).values["inertia"]
    assert load_user_joint(larger).values[f"{PREFIX}motor_quadratic_drag"] == 0.0
    assert (
        irj(
            "diagnose",
            train,
            "--held-out",
            held,
            "--joint",
            fitted,
            "--json",
            str(tmp_path / "d.json"),
            "-o",
            larger,
        )
        == 0
    )
    assert "1. quadratic drag" in capsys.readouterr().out
    assert (
        json.loads((tmp_path / "d.json").read_text())["claims"][0]["effects"][0] == "quadratic_drag"
    )
    assert load_user_joint(larger).values[f"{PREFIX}motor_quadratic_drag"] == pytest.approx(
        DRAG, rel=0.2
    )
    assert irj("fit", train, "--joint", larger, "-o", final) == 0
    assert load_user_joint(final).values[f"{PREFIX}motor_quadratic_drag"] == pytest.approx(
        DRAG, rel=0.05
    )
    assert irj("compare", held, "--joint", final, "--json", str(tmp_path / "c.json")) == 0
    assert json.loads((tmp_path / "c.json").read_text())["outputs"]["motor_position"]["ratio"] < 2
    assert irj("export", "pair", "--joint", final, "--out", str(tmp_path)) == 0
    assert (tmp_path / "user_axis_pair.fmu").is_file()
    assert irj("export", "corrected", "--joint", final, "--out", str(tmp_path)) == 0
    assert (tmp_path / "user_axis_corrected.fmu").is_file()
    for words, line in (
        (("pair", "--target", "win64"), "--target: goes with corrected, not with pair"),
        (("corrected", "--target", "win64"), "holds no library for win64"),
        (("corrected", "--target", "vax"), "target 'vax' is not known"),
    ):
        with pytest.raises(InputError, match=line):
            irj("export", *words, "--joint", final, "--out", str(tmp_path))
    with pytest.raises(InputError, match="--inject"):
        irj("track", train, "--joint", final, "--inject", "bias:motor_position:0.1:1")


def test_a_typed_law_rides_outside_an_fmu(folder: Path, dragged: Record, tmp_path: Path) -> None:
    """The drag typed as text is fitted like the library's."""
    joint, larger, final = (tmp_path / f"{n}.toml" for n in ("user", "larger", "final"))
    joint.write_text(FILE.format(fmu=fmu(folder, "Axis", Make(2, CS))))
    part = dragged.window(0, 3)
    np.savez(
        tmp_path / "r.npz",
        **{
            "time_s": part.time,
            "motor_position_rad": part["motor_position"],
            "motor_torque_N.m": part["motor_torque"],
        },
    )
    words = (
        "--law",
        "c*v*abs(v)",
        "--on",
        "motor",
        "--parameter",
        "c=-1e3..1e3 N.m.s2/rad2",
        "--key",
        "typed_drag",
    )
    try:
        assert irj("add", *words, "--joint", str(joint), "-o", str(larger)) == 0
        assert load_user_joint(larger).joint.laws["typed_drag"].text == "c*v*abs(v)"
        assert irj("fit", str(tmp_path / "r.npz"), "--joint", str(larger), "-o", str(final)) == 0
        assert load_user_joint(final).values[f"{PREFIX}typed_drag_c"] == pytest.approx(
            DRAG, rel=0.05
        )
    finally:
        EFFECTS.forget("typed_drag")


def test_an_fmu_that_fails_is_unusable_input(folder: Path, plain: Record, tmp_path: Path) -> None:
    """Its library knows another GUID than its description."""
    import zipfile

    good, bad = fmu(folder, "Axis", Make(2, CS)), tmp_path / "bad.fmu"
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            target.writestr(
                name,
                content.replace(b'guid="Axis', b'guid="axis') if name.endswith(".xml") else content,
            )
    (tmp_path / "user.toml").write_text(FILE.format(fmu=bad))
    part = plain.window(0, 1)
    np.savez(
        tmp_path / "r.npz",
        **{
            "time_s": part.time,
            "motor_position_rad": part["motor_position"],
            "motor_torque_N.m": part["motor_torque"],
        },
    )
    with pytest.raises(InputError, match="cannot be instantiated"):
        irj("fit", str(tmp_path / "r.npz"), "--joint", str(tmp_path / "user.toml"))


def test_a_joint_file_with_an_fmu_is_written_as_it_was_read(folder: Path, tmp_path: Path) -> None:
    path = fmu(folder, "Axis", Make(2))
    joint = tmp_path / "user.toml"
    joint.write_text(FILE.format(fmu=path))
    assert is_user_joint(joint)
    model = load_user_joint(joint).with_values({"inertia": 3.25})
    again = tmp_path / "again.toml"
    again.write_text(user_joint_text(model))
    read = load_user_joint(again)
    assert (read.inputs, read.outputs, read.starts, read.window, read.kind, read.hold) == (
        model.inputs,
        model.outputs,
        model.starts,
        model.window,
        model.kind,
        model.hold,
    )
    assert read.parameters == model.parameters
    assert read.values["inertia"] == 3.25


# --- what cannot be used --------------------------------------------------------------------------


def test_units_are_converted_and_said_or_refused(folder: Path) -> None:
    make = Make(2, CS, units=(("angle", "deg"), ("torque", "A")))
    path = fmu(folder, "Axis", make)
    model = load_user_model(
        path, {"motor_position": "angle", "motor_current": "torque"}, ["inertia"]
    )
    assert model.outputs[0].scale == pytest.approx(180 / math.pi)
    assert any("deg" in note for note in model.notes)
    with pytest.raises(InputError, match="torque is in A, channel motor_torque in N.m"):
        load_user_model(path, {"motor_position": "angle", "motor_torque": "torque"}, ["inertia"])
    assert (
        load_user_model(path, {"motor_position": "angle", "motor_torque": ("torque", 0.1)})
        .inputs[0]
        .scale
        == 0.1
    )


def test_each_thing_that_cannot_be_used_is_said_in_one_line(
    folder: Path, plain: Record, tmp_path: Path
) -> None:
    path = fmu(folder, "Axis", Make(2, CS))
    text = tmp_path / "no.fmu"
    text.write_text("no archive")
    events = fmu(folder, "Dahlquist", Make(2, ME, events=1))

    def line(call: Callable[[], object]) -> str:
        with pytest.raises((InputError, FmuError)) as caught:
            call()
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "there is no such FMU" in line(lambda: load_user_model(tmp_path / "none.fmu", {}))
    assert "not a readable FMU" in line(lambda: load_user_model(text, {}))
    assert "did you mean: torque" in line(lambda: load_user_model(path, {"motor_torque": "torqu"}))
    assert "channel 'motor_angle' is not known" in line(
        lambda: load_user_model(path, {"motor_angle": "angle"})
    )
    assert "no channel is mapped to an output" in line(
        lambda: load_user_model(path, {"motor_torque": "torque"})
    )
    assert "no parameter that can be set" in line(
        lambda: load_user_model(path, CHANNELS, ["angle"])
    )
    assert "state events" in line(lambda: load_user_model(events, {"motor_position": "y"}))
    assert "kind = 'me' is not possible" in line(lambda: load_user_model(path, CHANNELS, kind="me"))
    assert "no parameter to fit" in line(lambda: fit(load_user_model(path, CHANNELS), plain))
    assert "has no channel motor_torque" in line(
        lambda: fit(axis_model(path), plain.without("motor_torque"))
    )
    free = load_user_model(path, {"motor_position": "angle"}, ["inertia"])
    assert "no drive channel" in line(lambda: diagnose(free, plain))
    assert "too short" in line(lambda: fit(axis_model(path), plain.take(slice(0, 5))))
    assert "cannot ride outside" in line(
        lambda: outside_correction(["cubic_stiffness"], Joint(), {}, "file")
    )


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("fmu = ", "fnu = "), "unknown key 'fnu'"),
        (('"torque"', "3"), "give the name of a variable"),
        (("window = 0.5", "window = -1"), "must be above 0"),
        (("low = 0.5", "lower = 0.5"), "must be a table with low and high"),
        (('q = "motor_position"', 'z = "motor_position"'), "there is no variable 'z'"),
    ],
)
def test_a_wrong_joint_file_is_refused_with_its_name(
    folder: Path, tmp_path: Path, change: tuple[str, str], why: str
) -> None:
    joint = tmp_path / "user.toml"
    joint.write_text(FILE.format(fmu=fmu(folder, "Axis", Make(2))).replace(*change))
    with pytest.raises(InputError, match=why) as caught:
        load_user_joint(joint)
    assert str(caught.value).startswith(str(joint))
