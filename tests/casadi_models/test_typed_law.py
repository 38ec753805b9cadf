"""A law typed in one line is an effect like that of the library; what is no law is refused in
one line.
"""

from __future__ import annotations

import json
import pickle
import time
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from casadi_models import EFFECTS, JointModel, LocalSignals
from casadi_models.text.typed_law import LawError, TypedLaw, effect_of, register
from identification import load_joint
from identification.data.own_effects import files_of
from identification.errors import InputError
from workbench.cli.main import main

DEMO = Path(__file__).resolve().parents[2] / "workbench" / "demo"

LIBRARY: dict[str, tuple[str, dict[str, str]]] = {
    "added_spring": ("k*q + m", {"k": "-100..100 N.m/rad", "m": "-100..100 N.m"}),
    "added_spring_at_zero": ("k*q", {"k": "-100..100 N.m/rad"}),
    "asymmetric_coulomb": ("c*abs(direction)", {"c": "-10..10 N.m"}),
    "asymmetric_viscous": ("c*abs(v)", {"c": "-9..9 N.m.s/rad"}),
    "backlash": ("-c*min(max(twist, -b), b)", {"c": "0..3e4 N.m/rad", "b": "1e-5..1e-2 rad"}),
    "channel_delay": ("d*reading_rate", {"d": "-1..1 s"}),
    "coulomb": ("c*sign(v)", {"c": "0..50 N.m"}),
    "cubic_stiffness": ("k*twist^3", {"k": "-1e9..1e9 N.m/rad3"}),
    "cubic_viscous": ("c*velocity**3", {"c": "-9..9 N.m.s3/rad3"}),
    "current_offset": ("o", {"o": "-9..9 N.m"}),
    "cyclic_friction": ("(s*sin(q) + c*cos(q))*direction", {"s": "-9..9 N.m", "c": "-9..9 N.m"}),
    "cyclic_torque": ("s*sin(q) + c*cos(q)", {"s": "-9..9 N.m", "c": "-9..9 N.m"}),
    "extra_inertia": ("J*a", {"J": "-9..9 kg.m2"}),
    "gravity": ("-g*sin(q) - h*cos(position)", {"g": "-200..200 N.m", "h": "-200..200 N.m"}),
    "gravity_upright": ("-g*sin(q)", {"g": "-200..200 N.m"}),
    "kinematic_error": (
        "s*sin(n*motor_angle) + c*cos(n*motor_angle)",
        {"s": "-1e-3..1e-3 rad", "c": "-1e-3..1e-3 rad", "n": "1..4"},
    ),
    "link_position_gain": ("-reading*g/(1 + g)", {"g": "-0.1..0.1"}),
    "load_dependent_friction": (
        "m*sqrt(load**2 + e**2)*direction",
        {"m": "0..1", "e": "1e-4..1e-2 N.m"},
    ),
    "motor_constant_error": ("e*reading", {"e": "-1..1"}),
    "piecewise_stiffness": (
        "k*(twist - min(max(twist, -x), x)) + l*(twist - min(max(twist, -y), y))",
        {
            "k": "-1e4..1e4 N.m/rad",
            "l": "-1e4..1e4 N.m/rad",
            "x": "1e-5..1e-3 rad",
            "y": "1e-4..1e-2 rad",
        },
    ),
    "quadratic_drag": ("c*v*abs(v)", {"c": "-9..9 N.m.s2/rad2"}),
    "smooth_stribeck": (
        "c*v*exp(-((v**2/b**2 + 1e-12)**(n/2)))",
        {"c": "0..900 N.m.s/rad", "b": "0.01..1 rad/s", "n": "1..2"},
    ),
    "soft_windup": ("-c*tanh(twist/w)", {"c": "0..20 N.m", "w": "1e-5..1e-2 rad"}),
    "stribeck": (
        "c*direction*exp(-((v**2/b**2 + 1e-12)**(n/2)))",
        {"c": "0..50 N.m", "b": "0.01..1 rad/s", "n": "1..2"},
    ),
    "structural_damping": ("d*twist_rate", {"d": "0..90 N.m.s/rad"}),
    "thermal_friction": (
        "(c*direction + d*v)*(temperature + (u - temperature)"
        "*(1 - exp((k - 1)*log(max(abs(1 - temperature/u), 1e-12)))))",
        {"c": "-1..1 N.m/K", "d": "-1..1 N.m.s/(rad.K)", "k": "0.1..10", "u": "0.1..10 K"},
    ),
    "torque_ripple": (
        "s*sin(n*motor_angle) + c*cos(n*motor_angle)",
        {"s": "-9..9 N.m", "c": "-9..9 N.m", "n": "1..6"},
    ),
    "torque_sensor_compliance": ("c*T", {"c": "0..1e-3 rad/(N.m)"}),
    "torque_sensor_gain": ("-reading*g/(1 + g)", {"g": "-0.1..0.1"}),
    "torque_sensor_offset": ("-o", {"o": "-9..9 N.m"}),
    "torque_sensor_ripple": (
        "-s*sin(n*motor_angle) - c*cos(n*motor_angle)",
        {"s": "-9..9 N.m", "c": "-9..9 N.m", "n": "1..4"},
    ),
    "transmission_compliance": ("k*twist", {"k": "0..9e4 N.m/rad"}),
    "transmission_losses": (
        "(k + s*sin(q) + c*cos(q))*sign(v) + d*v + f*v**3",
        {
            "k": "-9..9 N.m",
            "d": "-9..9 N.m.s/rad",
            "f": "-9..9 N.m.s3/rad3",
            "s": "-9..9 N.m",
            "c": "-9..9 N.m",
        },
    ),
    "viscous": ("c*v", {"c": "0..90 N.m.s/rad"}),
}
"""Each memoryless law of the library as one would type it; parameters in the order of the
declaration.
"""
STATED = {"load_dependent_friction": {"e": 1e-3}, "thermal_friction": {"u": 1.0}}
"""Numbers with a unit inside a law of the library: a parameter of the typed one."""


def forget() -> None:
    """As in a new process."""
    for found in EFFECTS.typed:
        for key in found.keys:
            EFFECTS.forget(key)


def typed(key: str) -> TypedLaw:
    text, parameters = LIBRARY[key]
    return TypedLaw(
        f"my_{key}", text, EFFECTS[key].acts_on, tuple(f"{n}={r}" for n, r in parameters.items())
    )


def test_all_laws_without_memory_are_typed() -> None:
    plain = {k for k, e in EFFECTS.items() if not e.states and not e.table}  # a table is no formula
    assert set(LIBRARY) == plain
    assert len(LIBRARY) >= 30


@pytest.mark.parametrize("key", sorted(LIBRARY))
def test_a_law_of_the_library_typed_is_the_same_effect(key: str) -> None:
    mine, theirs = effect_of(typed(key)), EFFECTS[key]
    extra = [f"my_{key}_{n}" for n in STATED.get(key, {})]
    kept = [p for p in mine.parameters if p.name not in extra]
    assert [p.is_shape for p in kept] == [p.is_shape for p in theirs.parameters]
    assert [p.unit for p in kept] == [p.unit for p in theirs.parameters]
    assert (mine.family, mine.needs_load) == (theirs.family, theirs.needs_load)
    names = [f.name for f in fields(LocalSignals) if f.name != "memory"]
    rng = np.random.default_rng(3)
    for _ in range(20):
        s = LocalSignals(memory=(), **dict(zip(names, rng.uniform(-2, 2, len(names)), strict=True)))
        if "sign(" in LIBRARY[key][0]:
            assert "direction" in mine.reads
        values = [float(rng.uniform(0.1, 0.9)) for _ in kept]
        own = dict(zip((p.name for p in kept), values, strict=True))
        own |= {f"my_{key}_{n}": v for n, v in STATED.get(key, {}).items()}
        lib = dict(zip((p.name for p in theirs.parameters), values, strict=True))
        found, exact = (
            float(ca.DM(e.law(s, SimpleNamespace(**v)))) for e, v in ((mine, own), (theirs, lib))
        )
        assert found == pytest.approx(exact, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("key", sorted(LIBRARY))
def test_a_law_of_the_library_typed_has_the_same_regressor(key: str) -> None:
    register(typed(key))
    place = EFFECTS[key].acts_on[0]
    base = JointModel.harmonic_drive(3).add("gravity").add("coulomb")
    base = base.drop("gravity") if base.has_form_of(key) else base
    if EFFECTS[key].takes_up:  # a typed law is a torque; it takes no twist from the damping
        base = base.drop("structural_damping")
    many = len(EFFECTS[key].acts_on) > 1
    label = f"{key}@{place}" if many else key
    theirs = base.add(f"{label}#2" if label in base.effects else label)
    mine = base.add(f"my_{key}@{place}" if many else f"my_{key}")
    fixed = {
        f"{place}_my_{key}_{n}" if many else f"my_{key}_{n}": v
        for n, v in STATED.get(key, {}).items()
    }
    shared = [n for n in theirs.parameter_names if n in mine.parameter_names]
    new = (
        [n for n in m.parameter_names if n not in shared and n not in fixed] for m in (theirs, mine)
    )
    pairs = dict(zip(*new, strict=True))
    rng = np.random.default_rng(4)
    values = {n: float(rng.uniform(0.2, 0.8)) for n in theirs.parameter_names}
    theirs = theirs.with_values(values)
    mine = mine.with_values({**{pairs.get(n, n): v for n, v in values.items()}, **fixed})
    assert [pairs.get(n, n) for n in theirs.linear_parameters if n in shared] == [
        n for n in mine.linear_parameters if n in shared
    ]
    order = [mine.linear_parameters.index(pairs.get(n, n)) for n in theirs.linear_parameters]
    for _ in range(5):
        x, a, u = rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 3)
        y, rest = (np.array(v) for v in theirs.regressor(x, a, u, theirs.value_vector()))
        my_y, my_rest = (np.array(v) for v in mine.regressor(x, a, u, mine.value_vector()))
        assert my_y.shape == y.shape
        scale = 1 + np.abs(y).max() + np.abs(rest).max()
        assert np.abs(my_y[:, order] - y).max() <= 1e-9 * scale
        assert np.abs(my_rest - rest).max() <= 1e-9 * scale
        dx, my_dx = (np.array(m.dynamics(x, u, m.value_vector())) for m in (theirs, mine))
        assert np.abs(my_dx - dx).max() <= 1e-9 * (1 + np.abs(dx).max())


# --- what is refused ------------------------------------------------------------------------------

C, B = "c=1..10 N.m", "b=0.01..1 rad/s"
REFUSED: list[tuple[str, tuple[str, ...]]] = [
    (text, (C, B))
    for text in (
        "",
        " ",
        "\t",
        "\n",
        "c*tanh(v/b",
        "c*tanh v/b)",
        "c*tanh(v/b))",
        "(",
        ")",
        "()",
        "c*",
        "*c",
        "c**",
        "/",
        "c+/b",
        "c v",
        "2c",
        "c2 2",
        "c*tanh()",
        "c*tanh(v/b,)",
        "c*tanh(v/b, b)",
        "min(c)",
        "max(c, c, c)*v/b",
        "c*tanh(,v/b)",
        "c,b",
        ",",
        "c*v/b;",
        "c*v/b#x",
        "c=v",
        "c==v",
        "c<v",
        "c if v else b",
        "lambda: c",
        "c and b",
        "not c",
        "c or b",
        "[c]",
        "{c}",
        "c[0]",
        "c.real",
        "c.__class__",
        "c.__class__.__mro__",
        "__import__('os')",
        "__import__",
        "__builtins__",
        "__name__*c",
        "().__class__",
        "''",
        '"c"',
        "'c'*v/b",
        "f'{c}'",
        "b'c'",
        "eval(c)",
        "exec(c)",
        "open(c)",
        "print(c)",
        "getattr(c, b)",
        "import os",
        "os.system(c)",
        "c; import os",
        "c\nimport os",
        "c\x00",
        "c\\",
        "c@b",
        "c!",
        "c?",
        "c$b",
        "c%b",
        "c&b",
        "c|b",
        "~c",
        "c//b",
        "c<<b",
        "c:=b",
        "c->b",
        "`c`",
        "c'",
        "c*tanh(v\u2215b)",
        "c\u00d7v",
        "\u03c9*c",
        "c\u2212c",
        "\uff43*tanh(v/b)",
        "c*tanh(\u200bv/b)",
        "c*\u0660",
        "\U0001f600",
        "c\u00b2",
        "v\u0307*c",
        "\u202ec*v/b",
        "c*tanh(v/b)\ufeff",
        "1e999*c*v/b",
        "c*9**9**9**9",
        "c*9**99999",
        "c*10**400",
        "c*(v/b)**1e9",
        "c*(v/b)**17",
        "c*(v/b)**-17",
        "c*1e308*1e308*tanh(v/b)",
        "c*(1/0)*v/b",
        "c*0/0*v/b",
        "c*log(0)*v/b",
        "c*sqrt(0-1)*v/b",
        "c*log(v/b)",
        "c*sqrt(v/b)",
        "c*b/v",
        "c/(v/b)",
        "c*exp(v/b)*exp(v/b)",
        "c*tan(v/b)/0",
        "c*v/b/(v-v)",
        "(" * 500,
        "(" * 41 + "c" + ")" * 41,
        "-" * 300 + "c",
        "+" * 300 + "c",
        "sin(" * 60 + "v" + ")" * 60,
        "c" * 501,
        "c*" * 300 + "v",
        "c" + "**2" * 100,
        "c" + "+c" * 300,
        "((((((((((" * 20,
        "tanh(" * 99,
        "c*v",
        "c*q",
        "c + b",
        "c*tanh(v)",
        "c*tanh(v*b)",
        "c*exp(v)",
        "c*exp(q)",
        "c*log(q)",
        "c*sin(v)",
        "c*cos(T)",
        "c*tan(t)",
        "c*(v/b)**v",
        "c**v/b",
        "v**b",
        "c**(1/2)*v/b",
        "c*v/b + 1",
        "1 + c*v/b",
        "c + v/b",
        "c - q",
        "min(c, v)*v/b",
        "max(c, b)",
        "c*sqrt(v)",
        "c*abs(v)",
        "c*sign(v)*b",
        "c*tanh(v/b)*T",
        "T*tanh(v/b)",
        "T + c*v/b",
        "c*c*v/b",
        "tanh(c*v/b)",
        "b*v",
        "v/b",
        "c*(v/b)*kg",
        "c*tanh(w/b)",
        "c*tanh(V/b)",
        "C*tanh(v/b)",
        "c*tanh(vel/b)",
        "c*Tanh(v/b)",
        "c*arctan(v/b)",
        "c*sinh(v/b)",
        "c*pow(v, b)",
        "c*tanh(reading/b)",
        "c*tanh(v/b)*reading",
        "c*tanh(v/b)*memory",
        "c*tanh(v/b)*z",
        "c*tanh(v/b)*clock",
        "c*tanh(v/b)*gear_ratio",
        "c*tanh(v/b)*a*a",
        "c*tanh(v/b)+0*x",
        "e*v/b",
        "inf*c*v/b",
        "nan*c*v/b",
        "c*1_000*v/b",
        "0x10*c*v/b",
        "c*1.2.3*v/b",
        "c*.*v/b",
        "c*1e*v/b",
        "c*1e+*v/b",
        "True*c*v/b",
        "None",
        "c*v/b*j",
        "c*1j*v/b",
        "tanh",
        "tanh*c*v/b",
        "v(c)/b",
        "c(v/b)",
        "c*(v/b)(2)",
        "pi",
        "0",
        "1",
        "c*0*v/b",
        "c*v*b/b",
        "c*tanh((v-v)/b)",
        "q*c*v/b",
        "a*c/b",
        "c*v/b*t",
    )
]
REFUSED += [
    ("c*tanh(v/b)", parameters)
    for parameters in (
        (),
        (C,),
        (B,),
        (C, B, "d=1..2"),
        (C, C, B),
        ("c", B),
        ("c=", B),
        ("c=1", B),
        ("c=1 N.m", B),
        ("c=10..1 N.m", B),
        ("c=1..1 N.m", B),
        ("c=1..inf N.m", B),
        ("c=nan..1 N.m", B),
        ("c=1..1e999 N.m", B),
        ("c=1..10 Nmm/", B),
        ("c=1..10 furlong", B),
        ("c=1..10 N.m/rad", B),
        ("c=1..10", B),
        ("c=1..10 N.m N.m", B),
        ("c=1...10 N.m", B),
        ("c==1..10 N.m", B),
        ("=1..10 N.m", B),
        ("1=1..10 N.m", B),
        ("c.d=1..10 N.m", B),
        ("__c=1..2", B),
        ("tanh=1..10 N.m", B),
        ("velocity=1..10 N.m", B),
        (C, "b=0..1 rad/s"),
        (C, "b=-1..1 rad/s"),
        (C, "b=0.1..1 degC"),
        (C, "b=0.01..1 K"),
        ("c=1..10 N.m; import os", B),
        ("c=1..10 \u00b5Nm\u00b2", B),
        ("c=" + "9" * 600 + "..1", B),
        ("c=__import__('os')..1", B),
    )
]


def test_what_is_no_law_is_refused_in_one_line_and_at_once() -> None:
    assert len(REFUSED) >= 200
    assert len({(t, p) for t, p in REFUSED}) == len(REFUSED)
    began, accepted, bad = time.perf_counter(), [], []
    for text, parameters in REFUSED:
        try:
            effect_of(TypedLaw("mine", text, ("motor",), parameters))
            accepted.append((text, parameters))
        except LawError as error:
            line = str(error)
            if "\n" in line or not line.isprintable() or len(line) > 400 or len(line) < 10:
                bad.append((text, line))
    assert accepted == []
    assert bad == []
    assert time.perf_counter() - began < 5.0


@pytest.mark.parametrize(
    ("text", "place", "parameters", "said"),
    [
        (
            "c*tanh(v)",
            "motor",
            [C],
            r"argument 'v' \[rad/s\] of tanh must have no unit; divide it by a parameter in rad/s",
        ),
        ("c*v", "motor", [C], r"the law 'c\*v' \[N\.m\.rad/s\] must be in N\.m on motor"),
        (
            "c*sin(q) + v",
            "motor",
            [C],
            r"sum or difference of 'c\*sin\(q\)' \[N\.m\] and 'v' \[rad/s\]",
        ),
        ("c*tanh(w)", "motor", [C], r"column 8: 'w' is no signal and no parameter"),
        ("c*reading", "motor", ["c=0..1"], r"'reading' is not there on motor"),
        ("c*reading**2", "torque_sensor", ["c=0..1 1/(N.m)"], "must be linear in reading"),
        ("c*v*a", "drive", [C], "'a' is not there on drive"),
        ("c*tanh(v/b)", "elbow", [C, B], "place 'elbow' is not known"),
        ("c*sqrt(v**2/b**2)", "motor", [C, B], "no finite slope at rest"),
        ("tanh(q/b)*T", "motor", ["b=0.1..1 rad"], "no parameter of the law is an amplitude"),
        ("c*v/b + T*tanh(v/b)", "motor", [C, B], "the law is not 0 where c are 0"),
    ],
)
def test_a_refusal_names_the_part(text: str, place: str, parameters: list[str], said: str) -> None:
    with pytest.raises(LawError, match=said):
        effect_of(TypedLaw("mine", text, (place,), tuple(parameters)))


def test_precedence_is_that_of_mathematics() -> None:
    cases = {
        "2-3-4": -5.0,
        "2**3**2": 512.0,
        "-2**2": -4.0,
        "2**-1": 0.5,
        "8/4/2": 1.0,
        "2+3*4": 14.0,
        "(2+3)*4": 20.0,
        "-2*-3": 6.0,
        "2^3": 8.0,
    }
    for text, value in cases.items():
        law = effect_of(TypedLaw("mine", f"c*({text})", ("motor",), (C,)))
        names = [f.name for f in fields(LocalSignals) if f.name != "memory"]
        found = law.law(
            LocalSignals(memory=(), **dict.fromkeys(names, 0.5)), SimpleNamespace(mine_c=1.0)
        )
        assert float(ca.DM(found)) == value


def test_units_that_are_not_si_are_converted() -> None:
    law = effect_of(
        TypedLaw("mine", "c*tanh(v/b)", ("motor",), ("c=100..2000 N.mm", "b=1..60 rpm"))
    )
    assert law.parameters[0].high == pytest.approx(2.0)
    assert law.parameters[1].low == pytest.approx(2 * np.pi / 60)


def test_a_linear_axis_takes_units_of_length() -> None:
    law = TypedLaw("mine", "c*tanh(v/b)", ("motor",), ("c=1..10 N", "b=0.01..1 m/s"), "linear")
    model = JointModel(kind="linear")
    register(law)
    assert [p.unit for p in model.add("mine").parameters if p.name.startswith("mine")] == [
        "N",
        "m/s",
    ]
    with pytest.raises(LawError, match="must be in N on motor"):
        effect_of(TypedLaw("mine", "c*v", ("motor",), ("c=1..10 N",), "linear"))


def test_a_key_that_would_hide_another_parameter_is_refused() -> None:
    for key, name in (
        ("motor", "viscous"),
        ("stiffness", "knot_1"),
        ("link", "inertia"),
        ("motor", "smoothing_velocity"),
    ):
        with pytest.raises(LawError, match="choose another key"):
            register(TypedLaw(key, f"{name}*v", ("motor",), (f"{name}=1..10 N.m.s/rad",)))
        assert key not in EFFECTS


def test_the_declaration_travels_as_source_and_between_processes() -> None:
    """What an FMU carries declares the same effect; workers of a batch take the effect itself."""
    law = typed("stribeck")
    found = register(law)
    (own,) = files_of(["my_stribeck@motor"])
    forget()
    assert "my_stribeck" not in EFFECTS
    exec(compile(own.code, "own", "exec"), {})
    assert EFFECTS["my_stribeck"] == found
    assert pickle.loads(pickle.dumps(found)) == found


# --- through the doors ----------------------------------------------------------------------------


def added(tmp_path: Path, *words: str) -> Path:
    target = tmp_path / "joint.toml"
    assert main(["add", *words, "--joint", str(DEMO / "joint.toml"), "-o", str(target)]) == 0
    return target


STRIBECK = (
    "--law",
    LIBRARY["stribeck"][0],
    "--on",
    "motor",
    "--parameter",
    "c=1..50 N.m",
    "--parameter",
    B,
    "--parameter",
    "n=1..2",
)


def test_a_joint_file_keeps_the_law(tmp_path: Path) -> None:
    path = added(tmp_path, *STRIBECK, "--key", "my_stribeck")
    joint = load_joint(path)
    assert joint.laws["my_stribeck"].text == STRIBECK[1]
    assert "my_stribeck" in joint.model().effects
    again = tmp_path / "again.toml"
    assert main(["add", "cubic_viscous", "--joint", str(path), "-o", str(again)]) == 0
    assert load_joint(again).laws == joint.laws


def test_a_law_without_a_key_has_one_derived(tmp_path: Path) -> None:
    first = load_joint(added(tmp_path, *STRIBECK)).effects[-1]
    assert first == load_joint(added(tmp_path, *STRIBECK)).effects[-1]
    assert first.startswith("law_")


def test_two_joints_with_one_key_keep_their_own_laws(tmp_path: Path) -> None:
    paths = []
    for i, text in enumerate(("c*tanh(v/b)", "c*v/b")):
        folder = tmp_path / str(i)
        folder.mkdir()
        words = [
            "--law",
            text,
            "--on",
            "motor",
            "--parameter",
            C,
            "--parameter",
            B,
            "--key",
            "mine",
        ]
        paths.append(added(folder, *words))
    joints = [load_joint(p) for p in paths]
    for joint, text in zip(joints, ("c*tanh(v/b)", "c*v/b"), strict=True):
        assert joint.model().terms[-1].effect.title == f"typed law {text}"


def test_a_fit_is_that_of_the_library(tmp_path: Path) -> None:
    found = {}
    library = tmp_path / "library.toml"
    assert (
        main(["add", "stribeck@motor", "--joint", str(DEMO / "joint.toml"), "-o", str(library)])
        == 0
    )
    words = [*STRIBECK[:7], "b=0.01..0.3 rad/s", *STRIBECK[8:]]
    for name, path in (("library", library), ("typed", added(tmp_path, *words, "--key", "mine"))):
        out = tmp_path / f"{name}.json"
        assert main(["fit", str(DEMO / "train.npz"), "--joint", str(path), "--json", str(out)]) == 0
        found[name] = json.loads(out.read_text())["parameters"]
    value = {k: {n: p["value"] for n, p in v.items()} for k, v in found.items()}
    assert value["typed"]["mine_c"] == pytest.approx(
        value["library"]["motor_stribeck_extra"], rel=2e-2
    )
    assert value["typed"]["motor_inertia"] == pytest.approx(
        value["library"]["motor_inertia"], rel=1e-3
    )


def test_a_fit_of_amplitudes_is_that_of_the_library_to_rounding(tmp_path: Path) -> None:
    words = [
        "--law",
        "c*v**3",
        "--on",
        "motor",
        "--parameter",
        "c=-1e6..1e6 N.m.s3/rad3",
        "--key",
        "mine",
    ]
    library = tmp_path / "library.toml"
    assert (
        main(
            ["add", "cubic_viscous@motor", "--joint", str(DEMO / "joint.toml"), "-o", str(library)]
        )
        == 0
    )
    value = []
    for path in (library, added(tmp_path, *words)):
        out = tmp_path / "out.json"
        assert main(["fit", str(DEMO / "train.npz"), "--joint", str(path), "--json", str(out)]) == 0
        value.append({n: p["value"] for n, p in json.loads(out.read_text())["parameters"].items()})
    value[1]["motor_cubic_viscous"] = value[1].pop("mine_c")
    assert value[1] == pytest.approx(value[0], rel=1e-9)


def test_a_law_in_the_file_alone_is_tried_like_a_candidate(tmp_path: Path) -> None:
    """The demo hides the Stribeck effect: the law typed for it and the library's own tie."""
    path, better = added(tmp_path, *STRIBECK, "--key", "my_stribeck"), tmp_path / "better.toml"
    path.write_text(path.read_text().replace(', "my_stribeck"]', "]"))
    records = [
        str(DEMO / "train.npz"),
        "--held-out",
        str(DEMO / "held_out.npz"),
        "--joint",
        str(path),
    ]
    out = tmp_path / "out.json"
    assert (
        main(["improve", *records, "--max-steps", "1", "--json", str(out), "-o", str(better)]) == 0
    )
    assert set(json.loads(out.read_text())["claims"][0]["effects"]) == {"stribeck", "my_stribeck"}
    assert load_joint(better).laws == load_joint(path).laws


def test_it_simulates_and_exports(tmp_path: Path) -> None:
    path = added(tmp_path, *STRIBECK, "--key", "my_stribeck")
    record = str(tmp_path / "r.npz")
    assert main(["simulate", "--joint", str(path), "--seconds", "2", "-o", record]) == 0
    assert main(["export", "casadi", "--joint", str(path), "--out", str(tmp_path / "code")]) == 0
    names = [p["name"] for p in json.loads((tmp_path / "code" / "parameters.json").read_text())]
    assert "my_stribeck_b" in names


@pytest.mark.parametrize(
    "words",
    [
        ["--law", "c*v", "--on", "motor", "--parameter", C],
        ["--law", "c*__import__", "--on", "motor", "--parameter", C],
        ["--law", "c*tanh(v/b)", "--parameter", C, "--parameter", B],
        ["--law", "c", "--on", "drive", "--parameter", C, "--key", "stribeck"],
        ["stribeck", "--on", "motor"],
        [],
    ],
)
def test_the_command_refuses_in_one_line(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert (
        main(["add", *words, "--joint", str(DEMO / "joint.toml"), "-o", str(tmp_path / "j.toml")])
        == 2
    )
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "j.toml").exists()


@pytest.mark.parametrize(
    "table",
    [
        "mine = 3",
        'mine = { law = "c" }',
        'mine = { law = "c*v", on = ["motor"], parameters = ["c=1..2 N.m"] }',
        'mine = { law = 3, on = ["motor"], parameters = [] }',
        '"m y" = { law = "c", on = ["motor"], parameters = ["c=1..2 N.m"] }',
    ],
)
def test_a_table_that_is_none_is_refused(table: str, tmp_path: Path) -> None:
    path = tmp_path / "joint.toml"
    path.write_text(f"[joint]\ngear_ratio = 2.0\n[laws]\n{table}\n")
    with pytest.raises(InputError, match=r"\[laws\]"):
        load_joint(path)
