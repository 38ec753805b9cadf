"""Properties that every effect of the library has, in every place it acts on."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import EFFECTS, JointModel, LocalSignals, Signals
from casadi_models.effect import Effect, Place, Registry
from casadi_models.parameter import Parameter
from casadi_models.quantities import side_power
from casadi_models.simulate import simulate
from casadi_models.text.effects_doc import main, page

FloatArray = npt.NDArray[np.float64]

SIZES = {
    "N.m": 3.0,
    "N.m.s/rad": 5.0,
    "N.m.s2/rad2": 4.0,
    "N.m.s3/rad3": 3.0,
    "N.m/rad": 60.0,
    "N.m/rad3": 2e8,
    "rad/(N.m)": 1e-5,
    "rad": 1e-4,
    "1": 0.07,
    "kg.m2": 1.5,
    "s": 2e-3,
    "N.m/K": 0.2,
    "N.m.s/(rad.K)": 0.3,
}
"""Realistic size of an amplitude by its unit; of another unit the typical size that its
declaration gives.
"""
NAMED = {
    "motor_inertia": 4.447,
    "link_inertia": 10.277,
    "inertia": 14.7,
    "stiffness": 2.1513e4,
    "gravity_torque": -105.18,
    "structural_damping": 25.0,
    "stiffness_step_1": 9e3,
    "stiffness_step_2": 7e3,
    "stiffness_knot_1": 3e-4,
    "stiffness_knot_2": 1e-3,
    "backlash": 4e-4,
    "backlash_stiffness_loss": 1.2e4,
    "soft_windup_width": 4e-4,
    "hysteresis_width": 3e-4,
    "hysteresis_spread": 3.0,
    "motor_smoothing_velocity": 0.02,
    "link_smoothing_velocity": 0.02,
    "kinematic_error_order": 2.0,
    "kinematic_error_sine": 5e-5,
    "kinematic_error_cosine": 3e-5,
}
GEAR_PLACES = ("transmission", "torsion")


def label_of(key: str, place: str) -> str:
    return f"{key}@{place}" if len(EFFECTS[key].acts_on) > 1 else key


PLACES = [(k, p) for k in sorted(EFFECTS) for p in EFFECTS[k].acts_on]
CASES = [pytest.param(k, p, True, id=f"{k}-{p}-elastic") for k, p in PLACES]
CASES += [pytest.param(k, p, False, id=f"{k}-{p}-rigid") for k, p in PLACES if p not in GEAR_PLACES]


def base(elastic: bool) -> JointModel:
    model = JointModel.harmonic_drive(3) if elastic else JointModel(gear_ratio=-160.0)
    return model.add("gravity").add("viscous").add("coulomb")


def with_effect(model: JointModel, key: str, place: str) -> JointModel:
    """The model with the effect and realistic values of everything."""
    label = label_of(key, place)
    if model.has_form_of(label):
        model = model.drop("gravity")
    found = model if label in model.effects else model.add(label)
    return found.with_values({p.name: size_of(p) for p in found.parameters})


def size_of(parameter: Parameter) -> float:
    bare = parameter.name.removeprefix("motor_").removeprefix("link_")
    for name in (parameter.name, bare):
        if name in NAMED:
            return NAMED[name]
    return (
        parameter.start
        if parameter.is_shape
        else SIZES.get(parameter.unit) or parameter.usual() or 1.0
    )


def random_state(model: JointModel, rng: np.random.Generator) -> FloatArray:
    """A state with a twist of the size that the joint can carry, away from zero velocity."""
    states = len(model.functions.memory_names)
    speed = rng.choice([-1, 1]) * rng.uniform(0.3, 0.9)
    q = rng.uniform(-1.2, 1.2)
    mechanical = (
        [q + rng.uniform(-2e-3, 2e-3), speed, q, speed * 0.97] if model.is_elastic else [q, speed]
    )
    return np.array([*mechanical, *rng.uniform(-0.8, 0.8, states)])


def random_input(rng: np.random.Generator) -> FloatArray:
    return np.array([rng.uniform(-120, 120), rng.uniform(0, 20), rng.uniform(0, 10)])


def accelerations(model: JointModel, dx: FloatArray) -> FloatArray:
    return dx[[1, 3]] if model.is_elastic else dx[[1]]


def as_reading(model: JointModel, x: FloatArray, a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """State and accelerations as sensors of the link show them: true = reading + delay times
    its rate, or reading / (1 + gain).
    """
    out, rates = x.copy(), a.copy()
    if model.is_elastic:
        delay, gain = (
            float(model.values.get(f"link_position_{n}", 0.0)) for n in ("sensor_delay", "gain")
        )
        out[3] = x[3] - delay * a[1]
        out[2] = x[2] - delay * out[3]
        out[2:] *= 1 + gain
        rates[1] *= 1 + gain
    return out, rates


ONE_READING = [
    c
    for c in CASES
    if c.id
    not in (
        "channel_delay-link_position_sensor-rigid",
        "link_position_gain-link_position_sensor-rigid",
    )
]
"""A link encoder that is late or off in scale on a rigid joint: motor and link readings differ,
one state cannot hold both.
"""


@pytest.mark.parametrize(("key", "place", "elastic"), ONE_READING)
def test_regressor_reproduces_inverse_dynamics(key: str, place: str, elastic: bool) -> None:
    model = with_effect(base(elastic), key, place)
    f, p = model.functions, model.value_vector()
    theta = np.array([p[model.parameter_names.index(n)] for n in model.linear_parameters])
    rng = np.random.default_rng(1)
    for _ in range(5):
        x, u = random_state(model, rng), random_input(rng)
        a = accelerations(model, np.array(f.dynamics(x, u, p)).ravel())
        y, rest = (np.array(v) for v in model.regressor(*as_reading(model, x, a), u, p))
        expected = np.array([u[0], 0.0]) if elastic else u[:1]
        assert np.abs(y @ theta + rest.ravel() - expected).max() <= 1e-9 * max(
            1.0, np.abs(rest).max(), np.abs(y).max()
        )


def test_regressor_of_a_rigid_joint_with_a_late_link_encoder() -> None:
    """The one state is then the reading of both sensors; the link laws see it corrected."""
    model = with_effect(base(False), "channel_delay", "link_position_sensor")
    p = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    x, a, delay = np.array([0.4, -0.6]), -3.0, p["link_position_sensor_delay"]
    y, rest = (np.array(v) for v in model.regressor(x, a, np.zeros(3), model.value_vector()))
    theta = np.array([p[n] for n in model.linear_parameters])
    link_q, link_v = x[0] + delay * x[1], x[1] + delay * a
    expected = (
        (p["motor_inertia"] + p["link_inertia"]) * a
        - p["gravity_torque"] * math.sin(link_q)
        - p["gravity_cosine"] * math.cos(link_q)
    )
    expected += p["motor_viscous"] * x[1] + p["link_viscous"] * link_v
    expected += p["motor_coulomb"] * math.tanh(x[1] / p["motor_smoothing_velocity"])
    expected += p["link_coulomb"] * math.tanh(link_v / p["link_smoothing_velocity"])
    assert (y @ theta + rest.ravel()).item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("key", "place", "elastic"), CASES)
def test_jacobian_against_differences(key: str, place: str, elastic: bool) -> None:
    model = with_effect(base(elastic), key, place)
    f, p = model.functions, np.array(model.value_vector())
    rng = np.random.default_rng(2)
    x, u = random_state(model, rng), random_input(rng)
    exact = [np.array(m) for m in f.jacobian(x, u, p)]
    scales = [
        np.where(np.arange(len(x)) % 2 == 0, 1e-6, 1e-5),
        np.full(3, 1e-2),
        1e-4 * np.maximum(np.abs(p), 1e-9),
    ]
    scales[0][len(f.state_names) :] = 1e-5
    for which, scale in enumerate(scales):
        for i, h in enumerate(scale):

            def moved(by: float, which: int = which, i: int = i) -> FloatArray:
                at = [x.copy(), u.copy(), p.copy()]
                at[which][i] += by
                return np.array(f.dynamics(*at)).ravel()

            slope = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
            noise = 1e-14 * np.abs(moved(0.0)) / h
            assert np.all(
                np.abs(slope - exact[which][:, i])
                <= 1e-6 * (1 + np.abs(exact[which][:, i])) + noise
            ), (
                which,
                i,
            )


@pytest.mark.parametrize(("key", "place", "elastic"), CASES)
def test_zero_amplitude_is_the_model_without(key: str, place: str, elastic: bool) -> None:
    without = base(elastic)
    if label_of(key, place) in without.effects:
        without = without.drop(label_of(key, place))
    if without.has_form_of(label_of(key, place)):
        without = without.drop("gravity")
    present = with_effect(without, key, place)
    effect = EFFECTS[key]
    names = dict(
        zip((p.name for p in effect.parameters), effect.parameter_names(place), strict=True)
    )  # type: ignore[arg-type]
    absent = present.with_values({names[p.name]: 0.0 for p in effect.amplitudes})
    values = {n: present.values[n] for n in without.parameter_names}
    without = without.with_values(values)
    rng = np.random.default_rng(3)
    x, u = random_state(present, rng), random_input(rng)
    size = len(without.functions.state_names)

    def rates(model: JointModel) -> FloatArray:
        keep = size + len(model.functions.memory_names)
        return np.array(model.dynamics(x[:keep], u, model.value_vector())).ravel()[:size]

    if not elastic or without.is_elastic:
        assert rates(absent) == pytest.approx(rates(without), rel=1e-13, abs=1e-13)
    readings = (
        [
            np.array(
                m.functions.outputs(x[: size + len(m.functions.memory_names)], u, m.value_vector())
            )
            for m in (absent, without)
        ]
        if not elastic or without.is_elastic
        else []
    )
    if readings:
        assert readings[0] == pytest.approx(readings[1], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(("key", "place", "elastic"), CASES)
def test_effect_moves_something(key: str, place: str, elastic: bool) -> None:
    """With a realistic amplitude the effect shows in the motion or in a reading."""
    present = with_effect(base(elastic), key, place)
    effect = EFFECTS[key]
    amplitudes = {
        n
        for p, n in zip(effect.parameters, effect.parameter_names(place), strict=True)
        if not p.is_shape
    }  # type: ignore[arg-type]
    rng = np.random.default_rng(4)
    x, u = random_state(present, rng), random_input(rng)
    p = ca.SX.sym("p", len(present.parameters))
    out = ca.vertcat(present.dynamics(x, u, p), present.functions.outputs(x, u, p))
    slopes = np.array(ca.Function("s", [p], [ca.jacobian(out, p)])(present.value_vector()))
    if key == "channel_delay" and place == "drive":
        e = present.equations
        slope = ca.jacobian(e.drive, e.parameters)
        shown = ca.depends_on(slope, e.signals.drive_rate)
        assert shown
        return
    still = [
        n for n in amplitudes if np.abs(slopes[:, present.parameter_names.index(n)]).max() == 0
    ]
    if (
        effect.table is not None
        # a control value of a table acts near its own knots: three reach the end of a range, four
        # any
        # other place
    ):
        assert len(still) <= len(amplitudes) - 3
        return
    assert still == []


# --- declarations ---------------------------------------------------------------------------------


@pytest.mark.parametrize("key", sorted(EFFECTS))
def test_declaration_is_complete(key: str) -> None:
    effect = EFFECTS[key]
    assert effect.title
    assert effect.absence
    assert effect.excitation
    assert effect.source
    assert effect.acts_on
    assert effect.amplitudes, "an effect needs an amplitude whose zero is its absence"
    assert all(p.meaning and p.start == 0.0 for p in effect.amplitudes)
    assert all(p.low < p.start <= p.high or p.low == 0.0 for p in effect.shapes)
    assert effect.law.__doc__
    for other in (*effect.confused_with, *effect.needs):
        assert other in EFFECTS
        assert other != key
    assert all(isinstance(side_power(p.unit), int) for p in effect.parameters)


def test_contract_keys_are_there() -> None:
    wanted = (
        "viscous cubic_viscous quadratic_drag coulomb asymmetric_coulomb asymmetric_viscous "
        "stribeck "
        "load_dependent_friction lugre thermal_friction cyclic_friction cyclic_torque gravity "
        "added_spring "
        "motor_constant_error current_offset torque_ripple cubic_stiffness piecewise_stiffness "
        "structural_damping "
        "hysteresis backlash soft_windup kinematic_error torque_sensor_compliance "
        "torque_sensor_gain "
        "torque_sensor_offset channel_delay extra_inertia flexible_mode transmission_losses "
        "transmission_compliance"
    )
    assert set(wanted.split()) <= set(EFFECTS)


def test_page_is_fresh(tmp_path: Path) -> None:
    written = Path(__file__).resolve().parents[2] / "docs" / "effects.md"
    assert written.read_text(encoding="utf-8") == page(), (
        "run python -m casadi_models.text.effects_doc --write docs/effects.md"
    )
    assert main(["--write", str(tmp_path / "effects.md")]) == 0
    assert (tmp_path / "effects.md").read_text(encoding="utf-8") == page()
    for effect in EFFECTS.values():
        assert f"| `{effect.key}` | {effect.title} |" in page()


# --- stored and lost energy -----------------------------------------------------------------------


def still(at: Any, ratio: float = -160.0) -> LocalSignals:
    """A joint at rest."""
    names = (
        "velocity",
        "acceleration",
        "direction",
        "torsion_rate",
        "torque",
        "load",
        "reading",
        "reading_rate",
        "time",
        "temperature",
    )
    return LocalSignals(
        position=at,
        torsion=at,
        motor_angle=at * ratio,
        memory=(),
        gear_ratio=ratio,
        **dict.fromkeys(names, 0.0),
    )


@pytest.mark.parametrize("key", [k for k in sorted(EFFECTS) if EFFECTS[k].potential is not None])
def test_law_is_the_slope_of_its_potential(key: str) -> None:
    effect = EFFECTS[key]
    q = ca.SX.sym("q")
    values = SimpleNamespace(**{p.name: size_of(p) for p in effect.parameters})
    assert effect.potential is not None
    stored = effect.potential(still(q), values)
    f = ca.Function("f", [q], [stored, ca.jacobian(stored, q), effect.law(still(q), values)])
    for at in (-1.3, -2.1e-3, -7e-4, -1e-4, 2e-5, 5e-4, 1.7e-3, 0.9):
        if effect.family == "transmission" and abs(at) > 0.1:
            continue
        _, slope, law = (float(v) for v in f(at))
        assert slope == pytest.approx(law, rel=1e-9, abs=1e-9)
    assert float(f(0.0)[0]) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("key", [k for k in sorted(EFFECTS) if EFFECTS[k].family == "torque"])
def test_position_torques_have_a_potential(key: str) -> None:
    assert EFFECTS[key].potential is not None


DISSIPATIVE = [(k, p) for k, p in PLACES if EFFECTS[k].dissipative]


@pytest.mark.parametrize(("key", "place"), [c for c in DISSIPATIVE if not EFFECTS[c[0]].states])
def test_dissipative_law_never_gives_energy(key: str, place: str) -> None:
    model = with_effect(base(True), key, place)
    label = label_of(key, place)
    alone = replace(
        model,
        terms=tuple(
            t for t in model.terms if t.label == label or t.effect.key == "transmission_compliance"
        ),
    )
    alone = alone.with_values({"stiffness": 0.0})
    e = alone.equations
    s = e.signals
    lost = e.motor_resistance * s.motor_velocity + e.link_resistance * s.link_velocity
    lost = lost + e.transmitted * (s.motor_velocity - s.link_velocity)
    power = ca.Function("power", [s.vector(), e.parameters], [lost])
    rng = np.random.default_rng(5)
    scale = np.array(
        [2.0 if n.endswith("velocity") else 50.0 if "torque" in n else 1.0 for n in Signals.names()]
    )
    points = rng.standard_normal((len(scale), 2000)) * scale[:, None]
    points[:, :1000] *= 0.01
    values = np.array(power(points, alone.value_vector())).ravel()
    assert values.min() >= 0.0
    assert values.max() > 0.0


@pytest.mark.parametrize(("key", "place"), DISSIPATIVE)
def test_energy_never_rises_above_start(key: str, place: str) -> None:
    model = JointModel.harmonic_drive(3).add("gravity")
    needs_load_path = key == "load_dependent_friction"
    model = with_effect(model, key, place)
    model = model.with_values(
        {"gravity_torque": -105.18}
        | ({} if key == "structural_damping" else {"structural_damping": 0.0})
    )
    start = np.zeros(4 + len(model.functions.memory_names))
    start[:3:2] = [0.5 + 1e-3, 0.5]
    run = simulate(model, np.zeros(800), 1e-3, substeps=8, x0=start)
    energy = np.array(model.energy.map(800)(run.states.T, model.value_vector())).ravel()
    assert (
        energy.max() <= energy[0] * (1 + 1e-7)
        if energy[0] > 0
        else energy.max() <= energy[0] + 1e-7 * abs(energy[0])
    )
    assert energy[-1] < energy[0] - 1e-6 * abs(energy[0])
    if not EFFECTS[key].states and not needs_load_path:
        assert np.diff(energy).max() <= 1e-7 * abs(energy[0])


# --- memory ---------------------------------------------------------------------------------------

WITH_MEMORY = [k for k in sorted(EFFECTS) if EFFECTS[k].memory is not None]


def memory_function(effect: Effect) -> tuple[Any, Any, Any]:
    """(z, step, clock) -> z after; (z, velocity) -> dz/dt, or None; (z, velocity) -> torque."""
    z, step, clock, v = (
        ca.SX.sym(n, k) for n, k in (("z", effect.states), ("step", 1), ("clock", 1), ("v", 1))
    )
    values = SimpleNamespace(**{p.name: size_of(p) for p in effect.parameters})
    states = tuple(ca.vertsplit(z))
    view = replace(still(0.0), clock=clock, velocity=v, memory=states, load=40.0)
    assert effect.memory is not None
    after = ca.Function(
        "after", [z, step, clock], [ca.vertcat(*effect.memory(states, step, view, values))]
    )
    rate = None
    if effect.rate is not None:
        rate = ca.Function("rate", [z, v], [ca.vertcat(*effect.rate(states, view, values))])
    return after, rate, ca.Function("law", [z, v], [effect.law(view, values)])


@pytest.mark.parametrize("key", [k for k in WITH_MEMORY if EFFECTS[k].rate is not None])
def test_step_form_and_rate_agree(key: str) -> None:
    after, rate, _ = memory_function(EFFECTS[key])
    rng = np.random.default_rng(6)
    for _ in range(20):
        z, v = rng.uniform(-0.8, 0.8, EFFECTS[key].states), rng.uniform(-1, 1)
        exact = np.array(rate(z, v)).ravel()
        errors = []
        for h in (2e-6, 1e-6):
            errors.append(
                np.abs((np.array(after(z, v * h, h)).ravel() - z) / h - exact).max()
                / np.abs(exact).max()
            )
        assert errors[1] < 2e-3
        assert errors[1] == pytest.approx(errors[0] / 2, rel=0.05, abs=1e-7)


@pytest.mark.parametrize("key", WITH_MEMORY)
def test_one_long_step_is_many_short_ones(key: str) -> None:
    """The step form is exact while the coordinate moves evenly, however long the step."""
    after, _, _ = memory_function(EFFECTS[key])
    z0 = np.array([2e-4, 0.3, -0.2][: EFFECTS[key].states])
    for step, time in ((3e-4, 0.3), (-2e-3, 0.02), (0.4, 2.0)):
        once = np.array(after(z0, step, time)).ravel()
        many = z0
        for _ in range(50):
            many = np.array(after(many, step / 50, time / 50)).ravel()
        assert many == pytest.approx(once, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("key", [k for k in WITH_MEMORY if k != "flexible_mode"])
def test_bristles_stay_bounded(key: str) -> None:
    after, _, _ = memory_function(EFFECTS[key])
    rng = np.random.default_rng(7)
    z = np.zeros(EFFECTS[key].states)
    for step in rng.standard_normal(300) * 10.0 ** rng.uniform(-6, 1, 300):
        z = np.array(after(z, step, 1e-3)).ravel()
        assert np.abs(z).max() <= 1.0
    turned = np.array(after(z, 10.0, 1e-3)).ravel()
    assert turned == pytest.approx(np.ones(len(z)), abs=1e-3)


def along(key: str, path: FloatArray, h: float) -> FloatArray:
    """Work [J] that an effect with memory has taken along a path of its coordinate, step by
    step.
    """
    after, _, law = memory_function(EFFECTS[key])
    z, step = ca.SX.sym("z", EFFECTS[key].states), ca.SX.sym("step")
    new = after(z, step, h)
    work = law((z + new) / 2, step / h) * step
    loop = ca.Function("one", [z, step], [new, work]).mapaccum("loop", len(path) - 1)
    return np.cumsum(
        np.array(loop(np.zeros(EFFECTS[key].states), np.diff(path)[None, :])[1]).ravel()
    )


@pytest.mark.parametrize("key", [k for k in WITH_MEMORY if EFFECTS[k].dissipative])
def test_memory_takes_energy_over_closed_cycles(key: str) -> None:
    amplitude, h = 2e-3, 1e-4
    for frequency in (3.0, 12.0, 40.0):
        t = np.arange(0, 12 / frequency, h)
        work = along(key, amplitude * (1 - np.cos(2 * math.pi * frequency * t)), h)
        assert work.min() >= -1e-6 * work.max(), "gives more than it was given"
        cycle = round(1 / frequency / h)
        assert work[-1] > work[-1 - 5 * cycle] > 0.0, "a closed cycle costs energy"


def test_hysteresis_loop_area() -> None:
    """Slow cycle far beyond slip: each stop element loses 4 T (A - w), T its torque, w its
    width.
    """
    torque, width, reach = SIZES["N.m"], NAMED["hysteresis_width"], 0.02
    turns = 40000
    work = along("hysteresis", reach * np.sin(2 * math.pi * np.arange(2 * turns + 1) / turns), 1.0)
    expected = sum(4 * torque * (reach - w * width) for w in (1, 3, 9))
    assert work[-1] - work[-1 - turns] == pytest.approx(expected, rel=1e-4)


# --- composition ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("key", "place"), PLACES)
def test_add_and_drop_round_trip(key: str, place: Place) -> None:
    bare = JointModel(gear_ratio=-160.0).add("transmission_compliance")
    label = label_of(key, place)
    if label in bare.effects:
        bare = JointModel(gear_ratio=-160.0)
    there = bare.add(label)
    assert there.has(key, place)
    assert there.effects == (*bare.effects, label)
    assert set(EFFECTS[key].parameter_names(place)) <= set(there.parameter_names)
    assert there.drop(label) == bare
    assert there.drop(key) == bare
    with pytest.raises(ValueError, match="already"):
        there.add(label)
    with pytest.raises(ValueError, match="not in the model"):
        bare.drop(label)


def test_user_effect_file_registers_and_simulates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "felt.py"
    source.write_text(
        "import casadi as ca\n"
        "from casadi_models import amplitude, effect, shape\n"
        "@effect('felt_pad', title='felt pad', family='friction', acts_on=('link',), source='my "
        "bench',\n"
        "        absence='drag in one sector', excitation='a slow turn', dissipative=True, "
        "parameters=(\n"
        "    amplitude('felt_torque', 'N.m', 'drag of the pad'),\n"
        "    shape('felt_angle', 'rad', 'half width', (0.1, 0.3), 'position', start=0.2, "
        "low=0.01, high=3.0)))\n"
        "def felt(s, p):\n"
        "    return p.felt_torque * ca.exp(-(s.position / p.felt_angle)**2) * s.direction\n"
    )
    monkeypatch.setattr(EFFECTS, "_effects", dict(EFFECTS._effects))
    assert EFFECTS.load(source) == ("felt_pad",)
    model = base(True).add("felt_pad")
    values = {p.name: size_of(p) for p in model.parameters}
    x0 = np.array([0.3, -0.8, 0.3, -0.8])
    ends = []
    for torque in (0.0, 20.0):
        run = simulate(
            model.with_values(values | {"felt_torque": torque}), np.zeros(200), 1e-3, x0=x0
        )
        ends.append(abs(run.states[-1, 3]))
    assert ends[1] < ends[0] - 0.05
    assert "felt_torque" in model.linear_parameters
    assert "felt_angle" not in model.linear_parameters
    other = tmp_path / "felt_of_a_colleague.py"
    other.write_text(source.read_text())
    with pytest.raises(ValueError, match="registered already"):
        EFFECTS.load(other)
    with pytest.raises(ValueError, match="not a Python file"):
        EFFECTS.load(tmp_path / "felt.txt")


def test_registry_names_what_it_knows() -> None:
    with pytest.raises(KeyError, match="stribeck"):
        EFFECTS["stribek"]
    assert len(Registry()) == 0


def test_states_and_memory_belong_together() -> None:
    good = EFFECTS["lugre"]
    with pytest.raises(ValueError, match="memory"):
        replace(good, states=0)
    with pytest.raises(ValueError, match="step form"):
        replace(EFFECTS["viscous"], rate=good.rate)


def test_a_wrong_scale_is_still_a_scale() -> None:
    """1 + error keeps its sign and stays a number: with none a fit of a twist that is all noise
    ended at an error of 1e144.
    """
    (scale,) = EFFECTS["link_position_gain"].parameters
    assert -1 < scale.low < 0 < scale.high < math.inf
    assert (1 + scale.low) * (1 + scale.high) == pytest.approx(1.0), "alike either way"
