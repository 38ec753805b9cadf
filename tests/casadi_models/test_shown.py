"""What `irj show` writes is the model: text, LaTeX and sympy give the values of the CasADi
functions.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from casadi_models import EFFECTS, JointModel
from casadi_models.text.abbreviated import READABLE
from casadi_models.text.shown import readable, shown, shown_equations
from casadi_models.text.written import LANGUAGES, identifier, written
from workbench.cli.main import main

DEMO = Path(__file__).resolve().parents[2] / "workbench" / "demo"
PLACES = [(k, p) for k in sorted(EFFECTS) for p in EFFECTS[k].acts_on]
sympy = pytest.importorskip("sympy")
mpmath = pytest.importorskip("mpmath")


def model_with(key: str, place: str) -> JointModel:
    model = JointModel.harmonic_drive(3).add("coulomb")
    if not model.add("gravity").has_form_of(key):  # another form of gravity stands for it
        model = model.add("gravity")
    label = f"{key}@{place}" if len(EFFECTS[key].acts_on) > 1 else key
    return model if label in model.effects else model.add(label)


def points(symbols: list[Any], rng: np.random.Generator) -> dict[str, float]:
    """Sizes of the order of 1, inside the bounds of every shape."""
    return {
        x.name(): float(rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.5))
        if "_" not in x.name()
        else float(rng.uniform(0.3, 0.9))
        for x in symbols
    }


def by_casadi(expression: Any, symbols: list[Any], at: dict[str, float]) -> float:
    return float(ca.Function("f", symbols, [expression])(*(at[x.name()] for x in symbols)))


def by_sympy(text: str, at: dict[str, float]) -> float:
    with mpmath.workdps(30):
        return float(parsed(text, tuple(identifier(n) for n in at))(*map(mpmath.mpf, at.values())))


@cache  # a learned curve is a long text, and its values are asked for more than once
def parsed(text: str, names: tuple[str, ...]) -> Any:
    """A text as sympy reads it, as a function of its symbols that mpmath evaluates."""
    symbols = {n: sympy.Symbol(n, real=True) for n in names}
    found = sympy.sympify(text, locals=symbols)
    return sympy.lambdify(list(symbols.values()), found, "mpmath", cse=True)


@pytest.mark.parametrize(("key", "place"), PLACES)
def test_sympy_gives_the_value_of_the_function(key: str, place: str) -> None:
    rng = np.random.default_rng(5)
    for e in shown_equations(model_with(key, place)):
        for _, part in e.parts:
            if ca.SX(part).is_constant():
                continue
            symbols = ca.symvar(part)
            for _ in range(2):
                at = points(symbols, rng)
                exact = by_casadi(part, symbols, at)
                assert by_sympy(written(part, "sympy"), at) == pytest.approx(
                    exact, rel=1e-12, abs=1e-12
                )


@pytest.mark.parametrize(("key", "place"), PLACES)
def test_the_equations_shown_are_those_of_the_model(key: str, place: str) -> None:
    """Torsion and levers put in, the balances are those that the simulation integrates."""
    model = model_with(key, place)
    e, found = model.true_equations, {x.key: x for x in shown_equations(model)}
    torsion, rate = found["torsion"], found["torsion_rate"]
    levers = [found[n] for n in ("motor_lever", "link_lever") if n in found]
    motor = found["motor"].right - e.inertia["motor_inertia"] * e.motor_acceleration
    pairs = [
        (motor, e.motor_resistance + e.signals.torque * e.motor_lever),
        (found["transmission"].right, e.transmitted),
        (found["link"].right, e.inertia["link_inertia"] * e.link_acceleration + e.link_resistance),
        (found["link"].left, e.signals.torque * e.link_lever),
        (torsion.right, e.torsion),
        (found["drive"].right if "drive" in found else e.signals.drive, e.drive),
    ]
    old = [torsion.left, rate.left, *(x.left for x in levers)]
    new = [torsion.right, rate.right, *(x.right for x in levers)]
    rng = np.random.default_rng(6)
    for one, other in pairs:
        for _ in range(2):
            (put,) = ca.substitute([ca.SX(one)], old, new)
            difference = put - other
            symbols = ca.symvar(ca.vertcat(put, other))
            at = points(symbols, rng)
            scale = abs(by_casadi(other, symbols, at))
            assert abs(by_casadi(difference, symbols, at)) <= 1e-11 * (1 + scale)


@pytest.mark.parametrize(("key", "place"), PLACES)
def test_a_long_law_is_read_by_abbreviations_that_give_it_back(key: str, place: str) -> None:
    model, rng = model_with(key, place), np.random.default_rng(7)
    equations, seen = shown_equations(model), set()
    for exact, e in zip(equations, readable(equations), strict=True):
        names = [symbol.name() for symbol, _ in e.where]
        assert not seen & set(names), "one name stands for one thing"
        seen |= set(names)
        for (_, whole), (_, short) in zip(exact.parts, e.equation.parts, strict=True):
            assert len(written(short)) <= max(READABLE, 0.6 * len(written(whole)))
            back = ca.SX(short)
            for symbol, definition in reversed(e.where):
                (back,) = ca.substitute([back], [symbol], [definition])
            symbols = ca.symvar(ca.SX(whole))
            assert {x.name() for x in ca.symvar(back)} == {x.name() for x in symbols}
            at = points(symbols, rng)
            assert by_casadi(back, ca.symvar(back), at) == by_casadi(whole, symbols, at)


def test_a_learned_curve_is_shown_in_lines_and_its_code_runs() -> None:
    model = model_with("learned_velocity", "motor")
    text, space = shown(model), {}
    assert max(map(len, text.splitlines())) < 250
    assert len(text) < 12_000
    exec(compile(shown(model, "sympy"), "code.py", "exec"), space)
    at = {x: sympy.Rational(3, 10) for x in space["equations"]["motor"].free_symbols}
    (exact,) = (e.right for e in shown_equations(model) if e.key == "motor")
    names = {x.name(): 0.3 for x in ca.symvar(exact)}
    assert float(space["equations"]["motor"].rhs.evalf(20, subs=at)) == pytest.approx(
        by_casadi(exact, ca.symvar(exact), names), rel=1e-12
    )


@pytest.mark.parametrize(("key", "place"), PLACES)
def test_latex_is_balanced_and_names_every_symbol(key: str, place: str) -> None:
    model = model_with(key, place)
    text = shown(model, "latex")
    assert text.count("{") == text.count("}")
    assert text.count(r"\left") - text.count(r"\left|") - text.count(r"\leftarrow") == text.count(
        r"\right"
    ) - text.count(r"\right|")
    assert text.count(r"\left|") == text.count(r"\right|")
    depth = 0
    for c in text:
        depth += (c == "{") - (c == "}")
        assert depth >= 0
    assert all(re.escape(p.name).replace("_", r"\_") in text for p in model.parameters)
    assert "$" not in text


def test_every_operation_of_casadi_is_written() -> None:
    """Each operation that an expression of scalars can hold, in sympy against CasADi."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    made = [
        x + y,
        x - y,
        -x,
        x * y,
        x / y,
        -(x - y) * -y,
        x - (y - x),
        x / (y / x),
        x / (y * x),
        (x / y) ** 2,
        x**3,
        ca.fabs(x) ** y,
        2**x,
        x + x,
        1 / x,
        ca.exp(x),
        ca.log(ca.fabs(x)),
        ca.sqrt(x * x),
        ca.sin(x),
        ca.cos(x),
        ca.tan(x),
        ca.asin(x / 3),
        ca.acos(x / 3),
        ca.atan(x),
        ca.floor(x),
        ca.ceil(x),
        ca.fabs(x),
        ca.sign(x),
        ca.sinh(x),
        ca.cosh(x),
        ca.tanh(x),
        ca.asinh(x),
        ca.acosh(1 + x * x),
        ca.atanh(x / 3),
        ca.erf(x),
        ca.log1p(x * x),
        ca.expm1(x),
        ca.fmin(x, y),
        ca.fmax(x, y),
        ca.atan2(x, y),
        ca.hypot(x, y),
        ca.fmod(x, y),
        ca.remainder(x, y),
        ca.copysign(x, y),
        x < y,
        x <= y,
        ca.eq(x, y),
        ca.ne(x, y),
        ca.logic_and(x < y, y > 0),
        ca.logic_or(x < y, y),
        ca.logic_not(x < y),
        ca.logic_not(x),
        ca.if_else(x < y, ca.sin(x), x - y),
        ca.if_else(x, y, 1e-12 * y),
        x * 1e22 - 3.5e-7 * y,
        -(x**2),
        (-x) ** 2,
        x - -y,
    ]
    rng = np.random.default_rng(8)
    for expression in made:
        for _ in range(3):
            at = {"x": float(rng.uniform(-2, 2)), "y": float(rng.uniform(-2, 2))}
            exact = by_casadi(expression, [x, y], at)
            assert by_sympy(written(expression, "sympy"), at) == pytest.approx(
                exact, rel=1e-12, abs=1e-12
            ), written(expression)
        assert all(written(expression, language) for language in LANGUAGES)


def test_the_inverse_error_function_is_written() -> None:
    """CasADi's own is good to 1e-7 only, so it has a bound of its own."""
    x = ca.SX.sym("x")
    exact = by_casadi(ca.erfinv(x), [x], {"x": 0.6})
    assert by_sympy(written(ca.erfinv(x), "sympy"), {"x": 0.6}) == pytest.approx(exact, rel=1e-6)


def test_text_reads_as_python_and_gives_the_value() -> None:
    """The text form has Python's precedence."""
    import math

    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    for e in (
        x - (y - x) * -y / (x + y) ** 2,
        -ca.exp(-(x**2) / y) * ca.fmin(x, -y),
        -((-x - -y) ** 2),
        2 ** -(x / y),
    ):
        text = written(e)
        found = eval(text, {"x": 0.7, "y": 1.3, "exp": math.exp, "min": min})
        assert found == pytest.approx(by_casadi(e, [x, y], {"x": 0.7, "y": 1.3}), rel=1e-14)


def test_what_is_no_scalar_is_refused() -> None:
    with pytest.raises(ValueError, match="2 elements|elements cannot"):
        written(ca.SX.sym("x", 2))


@pytest.mark.parametrize("name", ["irj2b", "hd4"])
def test_the_command_writes_code_that_runs(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = tmp_path / "joint.toml"
    joint.write_text(
        '[joint]\nname = "axis \\"3\\""\ngear_ratio = -160.0\nmotor_constant = 0.05\nmodel = '
        f'"{name}"\neffects = ["lugre@motor"]\n'
        '[fitted]\nmotor_inertia = { value = 4.4, stderr = 0.02, unit = "kg.m2", side = "link" }\n'
    )
    assert main(["show", "--joint", str(joint), "--json", str(tmp_path / "o.json")]) == 0
    text = capsys.readouterr().out
    assert "motor_inertia*motor_acceleration" in text
    assert "motor_inertia = 4.4 +- 0.02 kg.m2" in text
    data = json.loads((tmp_path / "o.json").read_text())
    assert {e["key"] for e in data["equations"]} >= {"motor", "transmission", "link", "torsion"}
    target = tmp_path / "code.py"
    assert main(["show", "--joint", str(joint), "--format", "sympy", "-o", str(target)]) == 0
    space: dict[str, Any] = {}
    exec(compile(target.read_text(), "code.py", "exec"), space)
    assert space["values"][space["motor_inertia"]] == 4.4
    assert space["errors"] == {space["motor_inertia"]: 0.02}
    assert set(space["equations"]) == {e["key"] for e in data["equations"]}


def test_a_linear_axis_has_units_of_length() -> None:
    text = shown(JointModel(kind="linear").add("coulomb@motor"))
    assert "[N]" in text
    assert "N.m" not in text


def test_a_notebook_gets_latex() -> None:
    assert r"\begin{aligned}" in JointModel.harmonic_drive(3)._repr_latex_()
