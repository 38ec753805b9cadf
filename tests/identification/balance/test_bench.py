"""The bench: every law with every set of sensors.

Jacobian against differences of the rows, floor against noise.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import EFFECTS, JointModel
from casadi_models.term import HANGING
from identification import fit, load_joint, read
from identification.balance.balances import balances_of
from identification.balance.dataset import Dataset
from identification.balance.sensing import Sensing, adapt, sense, signals_of
from identification.balance.stacked import floors, rms, row_weights, stack
from identification.balance.weak import WeakRecord, prepare
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.fitting.weak_form import memory_shapes_of
from tests.hidden_effect.generator import generate_case

FloatArray = npt.NDArray[np.float64]

RATIO: Final = 100.0
STIFFNESS: Final = 2.0e4
SETS: Final = {
    "all": ("motor_torque", "motor_position", "link_position", "link_torque"),
    "both encoders": ("motor_torque", "motor_position", "link_position"),
    "motor side": ("motor_torque", "motor_position"),
    "positions alone": ("motor_position", "link_position"),
    "torque against twist": ("motor_position", "link_torque"),
    "link side": ("link_position", "link_torque"),
}
NOISE: Final = {
    "motor_torque": 0.2,
    "motor_position": 2e-6,
    "link_position": 2e-6,
    "link_torque": 0.05,
}
"""White noise of the channels, link-referred [N.m, rad]."""


@dataclass(frozen=True)
class Case:
    """A law on one set of sensors with records at generic operating points."""

    model: JointModel
    sensing: Sensing
    joint: Joint
    record: Record
    values: dict[str, float]


def motion(sensors: tuple[str, ...], seconds: float = 8.0) -> Record:
    """Smooth motion over every operating point that a law may know; no dynamics are needed for
    a derivative.
    """
    t = np.arange(round(seconds * 500)) * 2e-3
    link = 0.7 * np.sin(1.1 * t) + 0.25 * np.sin(2.9 * t + 0.4) + 0.06 * np.sin(8.3 * t + 1.0)
    torque = 40 * np.sin(1.7 * t + 0.3) + 15 * np.sin(5.3 * t)
    twist = torque / STIFFNESS
    motor = twist if sensors == SETS["torque against twist"] else RATIO * (link + twist)
    drive = (torque + 30 * np.sin(1.1 * t + 0.2) + 8 * np.tanh(np.gradient(link, t) / 0.01)) / RATIO
    whole = {
        "motor_torque": drive,
        "motor_position": motor,
        "link_position": link,
        "link_torque": torque,
    }
    return Record.from_channels(t, {c: whole[c] for c in sensors}, name="bench")


def case_of(key: str, place: str, sensors: str) -> Case | None:
    """The law in that place beside friction and, where they are seen, stiffness and gravity;
    None where the sensors do not show it.
    """
    channels = SETS[sensors]
    elastic = {"motor_position", "link_position"} <= set(
        channels
    ) or sensors == "torque against twist"
    model = JointModel(gear_ratio=1.0 if sensors == "torque against twist" else RATIO)
    labels = [] if sensors == "torque against twist" else ["viscous", "coulomb", "gravity"]
    labels += ["transmission_compliance", "structural_damping"] if elastic else []
    for label in (f"{key}@{place}", *labels, *EFFECTS[key].needs):
        model = (
            model
            if model.has(label.partition("@")[0]) and "@" not in label or model.has_form_of(label)
            else model.add(label)
        )
    record = motion(channels)
    try:
        sensing = sense(record, model)
    except InputError:
        return None
    model = adapt(model, sensing)
    if not model.has(key, place):
        return None
    joint = Joint(name="bench", gear_ratio=model.gear_ratio)
    return Case(model, sensing, joint, record, generic(model))


def generic(model: JointModel) -> dict[str, float]:
    """Values inside the bounds at which every law acts; twists of the size of the record's."""
    out = {}
    for k, p in enumerate(model.parameters):
        if p.name.endswith("_smoothing_velocity"):
            out[p.name] = 1e-3 if model.clamped_link else 0.02
        elif p.is_shape:
            size = {
                "torsion": 1.5e-3,
                "velocity": 0.8,
                "position": 0.7,
                "duration": 8.0,
                "absolute": 1.0,
            }[p.scale]
            out[p.name] = p.grid[len(p.grid) // 2] * size
        else:
            unit = {
                "N.m/rad": STIFFNESS,
                "N.m": 3.0,
                "N.m/rad3": 1e9,
                "rad": 1e-4,
                "s": 1e-3,
                "1": 0.05,
            }.get(p.unit, 0.7)
            out[p.name] = unit * (1 + 0.07 * k)
    if "stiffness" in out:
        out["stiffness"] = STIFFNESS
    return {p.name: min(max(out[p.name], p.low), p.high) for p in model.parameters}


def prepared(case: Case, record: Record | None = None) -> WeakRecord:
    """Rows of the record, or of another one with the same stamps, at one kernel."""
    record = record or case.record
    return prepare(
        record.time,
        signals_of(record, case.joint, case.sensing),
        tuple(record.segments()),
        length=0.06,
        pointwise=0.03,
    )


LAWS: Final = [(e.key, place) for e in EFFECTS.values() for place in e.acts_on]


@pytest.mark.parametrize("sensors", SETS)
@pytest.mark.parametrize(("key", "place"), LAWS, ids=lambda x: str(x))
def test_jacobian_is_the_derivative_of_the_rows(key: str, place: str, sensors: str) -> None:
    case = case_of(key, place, sensors)
    if case is None:
        pytest.skip("these sensors do not show the law")
    data = prepared(case)
    through_memory = set(memory_shapes_of(case.model, case.model.parameter_names))
    term = next(t for t in case.model.terms if t.effect.key == key and t.place == place)
    # the ends of a table's range stay where they are in every fit: no derivative of them is used
    apart = through_memory | set(case.model.named("range"))
    names = [
        n
        for n in (*term.names, "stiffness", "motor_coulomb")
        if n in case.model.parameter_names and n not in apart
    ]
    balances = balances_of(case.model, case.sensing)
    bare = balances_of(case.model, case.sensing, wrt=())
    jacobian = stack(balances, [data], case.values).jacobian
    for name in names:
        # read backwards, a law has the kinks of its knots at samples: none may lie inside the step
        step = (1e-5 if case.sensing.kinematic else 1e-4) * (abs(case.values[name]) or 1.0)
        sides = [
            stack(bare, [data], {**case.values, name: case.values[name] + s * step}).residual
            for s in (1, -1)
        ]
        for balance in balances.balances:
            expected = (sides[0][balance] - sides[1][balance]) / (2 * step)
            found = jacobian[balance][:, balances.wrt.index(name)]
            scale = float(np.linalg.norm(expected))
            assert np.linalg.norm(found - expected) <= 2e-3 * scale + 1e-9, (name, balance)


def dataset(case: Case, record: Record) -> Dataset:
    """A training record of the case, with the true levels of noise."""
    position = NOISE["link_position"]
    noise = {
        "drive": NOISE["motor_torque"],
        "torque": NOISE["link_torque"],
        "motor_position": position,
        "link_position": position,
    }
    seen = signals_of(record, case.joint, case.sensing)
    return Dataset(
        case.joint,
        case.sensing,
        (prepared(case, record),),
        (),
        {},
        {c: x for c, x in noise.items() if c in seen},
    )


def noisy(case: Case, rng: np.random.Generator) -> Record:
    """The record with noise on every channel."""
    ratio = abs(case.joint.gear_ratio)
    scale = {"motor_torque": 1 / ratio, "motor_position": ratio}
    channels = {
        c: x + NOISE[c] * scale.get(c, 1.0) * rng.standard_normal(len(x))
        for c, x in case.record.channels.items()
        if c in NOISE
    }
    return Record.from_channels(case.record.time, channels, name="noisy")


@pytest.mark.parametrize("sensors", SETS)
@pytest.mark.parametrize(
    ("key", "place"), [(e.key, e.acts_on[0]) for e in EFFECTS.values()], ids=lambda x: str(x)
)
def test_floor_is_what_noise_leaves(key: str, place: str, sensors: str) -> None:
    case = case_of(key, place, sensors)
    if case is None:
        pytest.skip("these sensors do not show the law")
    if case.sensing.clamped_link and any(t.effect.family == "friction" for t in case.model.terms):
        pytest.skip(
            "friction of the twist alone: the few rows at its turns decide, too few to compare "
            "two draws within 12 %"
        )
    if case.sensing.kinematic and any(p.scale == "torsion" for p in case.model.parameters):
        pytest.skip(
            "a twist that jumps with the load: the few rows at its turns decide; test_kinematic.py "
            "has them on motion that obeys the law"
        )
    rng = np.random.default_rng(5)
    data = dataset(case, noisy(case, rng))
    bare = balances_of(case.model, case.sensing, wrt=())
    clean = stack(bare, [prepared(case)], case.values).residual
    found = floors(case.model, data, case.values)
    dirty = stack(bare, [prepared(case, noisy(case, rng)) for _ in range(3)], case.values).residual
    for balance, level in found.items():
        left = dirty[balance] - np.tile(clean[balance], 3)
        # rows at a turn have a scatter of their own and count less, as in every fit
        weight = np.tile(row_weights(bare, data, case.values, found, data.train)[balance], 3)
        assert level == pytest.approx(rms(left * weight) / rms(weight), rel=0.12), balance


@pytest.mark.parametrize(
    "name",
    [
        "load_compliance",
        "load_damping",
        "stiffness",
        "structural_damping",
        "backlash",
        "gravity_torque",
        "motor_smoothing_velocity",
    ],
)
def test_floor_moves_smoothly_with_every_parameter(name: str) -> None:
    """From a millionth to a thousand times a parameter, and to zero: no signal drops out of the
    floor at any value.
    """
    case = (
        case_of("backlash", "transmission", "both encoders")
        if name not in HANGING
        else case_of("gravity", "link", "motor side")
    )
    assert case is not None
    curved = name in HANGING
    if curved:
        hanging = {"load_compliance": 1e-5, "swinging_share": 0.6, "load_damping": 20.0}
        case = replace(
            case,
            model=replace(case.model, lagging_load=True),
            values={**case.values, **hanging},
        )
    made = prepare(
        case.record.time,
        signals_of(case.record, case.joint, case.sensing),
        tuple(case.record.segments()),
        curved=curved,
    )
    data = replace(dataset(case, case.record), train=(made,))
    # the floor at values far from the record's must not be cut to the record's: what is left there
    # is large
    values = {**case.values, "inertia": 5.0} if curved else {**case.values, "motor_inertia": 30.0}
    steps = np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 28)])
    found = [
        floors(case.model, data, {**values, name: float(case.values[name] * k)}) for k in steps
    ]
    for balance in found[0]:
        levels = np.array([f[balance] for f in found])
        assert np.all(levels > 0)
        assert levels[1] == pytest.approx(levels[0], rel=1e-3)
        # a step of a factor 2.15 in a parameter that enters at most by its square
        assert np.all(np.abs(np.diff(np.log(levels))) < 2 * np.log(2.16)), balance


@pytest.mark.skipif(shutil.which("gcc") is None, reason="the generator's C integrator needs gcc")
@pytest.mark.parametrize("torque_sensor", [True, False])
@pytest.mark.parametrize("factor", [1 / 3, 3.0])
def test_a_gap_that_is_wrong_at_the_start_is_found(
    factor: float, torque_sensor: bool, tmp_path: Path
) -> None:
    # little damping: what the other simulator's gap does not carry of it is no part of the law
    folder = generate_case(
        "backlash", 21, folder=tmp_path, torque_sensor=torque_sensor, overrides={"C": 3.0}
    )
    half = json.loads((folder / "truth.json").read_text())["hidden"]["backlash"]["half_gap_rad"]
    joint = load_joint(folder / "joint.toml")
    joint = replace(joint, effects=(*joint.effects, "backlash"), fitted={"backlash": factor * half})
    values = fit(joint, [read(folder / "train.csv")]).solution.values
    assert values["backlash"] == pytest.approx(half, rel=0.1)
    assert values["backlash_stiffness_loss"] == pytest.approx(values["stiffness"], rel=0.1)
