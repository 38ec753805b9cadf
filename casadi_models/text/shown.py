"""The equations of a joint for a reader: balances, laws, values, as text, LaTeX or sympy code.

Each equation is a sum of parts, one per effect, taken from the model's own CasADi expressions
(:func:`casadi_models.equations.placed_laws`) and written by :mod:`casadi_models.text.written`.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from types import MappingProxyType
from typing import Any, Final, final

import casadi as ca

from ..equations import PlacedLaw, Solvable, bare_twist, placed_laws, time_derivative
from ..quantities import linear_unit
from ..signals import SIGNAL_UNITS, Expression, Signals
from .abbreviated import READABLE, Abbreviation, abbreviated
from .written import Language, identifier, latex_name, written

LATEX_SIGNALS: Final[Mapping[str, str]] = {
    "time": "t",
    "drive": "T_d",
    "drive_rate": r"\dot T_d",
    "motor_position": "q_m",
    "motor_velocity": r"\dot q_m",
    "motor_acceleration": r"\ddot q_m",
    "motor_jerk": r"\dddot q_m",
    "link_position": "q_l",
    "link_velocity": r"\dot q_l",
    "link_acceleration": r"\ddot q_l",
    "link_jerk": r"\dddot q_l",
    "torque": "T",
    "torque_rate": r"\dot T",
    "temperature": r"\vartheta",
    "torsion": r"\delta",
    "torsion_rate": r"\dot\delta",
    "motor_lever": r"\lambda_m",
    "link_lever": r"\lambda_l",
    "torque_reading": "T_r",
    "motor_position_reading": "q_{m,r}",
    "link_position_reading": "q_{l,r}",
    "step": r"\Delta",
    "clock": "h",
}
_SENSED: Final[Mapping[str, str]] = {
    "motor_position_sensor": "motor_position",
    "link_position_sensor": "link_position",
    "torque_sensor": "torque",
}
_WIDTH: Final = 60
"""Column at which the text says which effect a part is."""
_LINE: Final = 96
"""Letters of a line into which a long part is broken."""


@final
@dataclass(frozen=True)
class ShownEquation:
    """``left = sum of parts``.

    Attributes
    ----------
    key, title : str
        Identifier and heading.
    left : expression
        A symbol or a sum of few.
    parts : tuple of (str, expression)
        What each part comes from, and the part.
    unit : str
    """

    key: str
    title: str
    left: Expression
    parts: tuple[tuple[str, Expression], ...]
    unit: str

    @property
    def right(self) -> Expression:
        """Sum of the parts."""
        total: Expression = ca.SX(0)
        for _, part in self.parts:
            total = total + part
        return total


def shown_equations(model: Solvable) -> tuple[ShownEquation, ...]:
    """The equations of a joint, on the symbols of ``model.true_equations``.

    The symbols ``torsion`` and ``torsion_rate`` stand for what two of the equations define;
    ``motor_torque`` for the drive with what its effects add; ``_reading`` marks what a sensor
    shows.
    """
    symbols = model.symbols
    torsion, rate = ca.SX.sym("torsion"), ca.SX.sym("torsion_rate")
    laws = placed_laws(model, symbols, torsion, rate)
    found = _mechanics(model, laws, torsion, rate)
    found += _sensors(laws, symbols.signals)
    found += _memories(laws)
    return tuple(_converted(e, model.kind) for e in found)


@final
@dataclass(frozen=True)
class ReadableEquation:
    """An equation whose long parts are written with abbreviations.

    Attributes
    ----------
    equation : ShownEquation
    of_part : tuple of tuples of (symbol, definition)
        The abbreviations of each part; each uses only those before it.
    """

    equation: ShownEquation
    of_part: tuple[tuple[Abbreviation, ...], ...]

    @property
    def where(self) -> tuple[Abbreviation, ...]:
        """Those of all parts."""
        return tuple(pair for pairs in self.of_part for pair in pairs)


def readable(equations: Sequence[ShownEquation]) -> tuple[ReadableEquation, ...]:
    """Equations for the eye; no two abbreviations have one name."""
    numbers, out = count(1), []
    for e in equations:
        found = [(source, *abbreviated(part, numbers)) for source, part in e.parts]
        parts = tuple((source, short) for source, short, _ in found)
        out.append(ReadableEquation(replace(e, parts=parts), tuple(x for *_, x in found)))
    return tuple(out)


def _of(
    laws: Sequence[PlacedLaw], place: str, factor: float = 1.0
) -> tuple[tuple[str, Expression], ...]:
    return tuple(
        (x.term.label, x.law if factor == 1.0 else factor * x.law)
        for x in laws
        if x.term.place == place
    )


def _mechanics(
    model: Solvable, laws: Sequence[PlacedLaw], torsion: Expression, rate: Expression
) -> list[ShownEquation]:
    """Balances of motor, link and transmission."""
    e, s = model.true_equations, model.symbols.signals
    found = []
    total, driving = s.drive, _of(laws, "drive")
    if driving:
        total = ca.SX.sym("motor_torque")
        found.append(
            ShownEquation(
                "drive", "torque of the motor", total, (("drive", s.drive), *driving), "N.m"
            )
        )
    if not model.is_elastic:
        inertia: Expression = sum(e.inertia.values())
        parts = (
            ("inertia", inertia * s.motor_acceleration),
            *_of(laws, "motor"),
            *_of(laws, "link"),
        )
        found.append(
            ShownEquation(
                "joint",
                "balance of the rigid joint (link_position = motor_position)",
                total,
                parts,
                "N.m",
            )
        )
        if "link_inertia" in e.inertia:
            carried = (
                ("inertia", e.inertia["link_inertia"] * s.link_acceleration),
                *_of(laws, "link"),
            )
            found.append(ShownEquation("link", "torque into the link", s.torque, carried, "N.m"))
        return found
    motor = (("inertia", e.inertia["motor_inertia"] * s.motor_acceleration), *_of(laws, "motor"))
    motor_lever, link_lever = _lever("motor", e.motor_lever), _lever("link", e.link_lever)
    passed = ("transmitted", s.torque * motor_lever)
    found.append(ShownEquation("motor", "motor balance", total, (*motor, passed), "N.m"))
    gear = _of(laws, "transmission")
    found.append(ShownEquation("transmission", "torque of the transmission", s.torque, gear, "N.m"))
    errors = _of(laws, "torsion", -1.0)
    twist = (("positions", bare_twist(model, s)), *errors)
    found.append(ShownEquation("torsion", "torsion", torsion, twist, "rad"))
    turned = e.torsion if model.virtual_work else bare_twist(model, s)
    found.append(
        ShownEquation(
            "torsion_rate",
            "rate of the torsion",
            rate,
            (("velocities", time_derivative(turned, s)),),
            "rad/s",
        )
    )
    link = (("inertia", e.inertia["link_inertia"] * s.link_acceleration), *_of(laws, "link"))
    found.append(ShownEquation("link", "link balance", s.torque * link_lever, link, "N.m"))
    for lever, value in ((motor_lever, e.motor_lever), (link_lever, e.link_lever)):
        if not lever.is_constant():
            title = "share of the torque that a side feels through the kinematic error"
            found.append(ShownEquation(lever.name(), title, lever, (("virtual work", value),), "1"))
    return found


def _lever(side: str, value: Expression) -> Expression:
    """A symbol for a lever that is no number."""
    return value if value.is_constant() else ca.SX.sym(f"{side}_lever")


def _sensors(laws: Sequence[PlacedLaw], signals: Signals) -> list[ShownEquation]:
    """True values from readings; the laws see the reading where the balances see the true value."""
    found = []
    for place, channel in _SENSED.items():
        own = _of(laws, place)
        if own:
            true, reading = getattr(signals, channel), ca.SX.sym(f"{channel}_reading")
            parts = zip(
                (n for n, _ in own),
                ca.substitute([x for _, x in own], [true], [reading]),
                strict=True,
            )
            title = f"{channel.replace('_', ' ')} from its reading"
            found.append(
                ShownEquation(
                    f"{channel}_from_reading",
                    title,
                    true,
                    (("reading", reading), *parts),
                    SIGNAL_UNITS[channel],
                )
            )
    return found


def _memories(laws: Sequence[PlacedLaw]) -> list[ShownEquation]:
    """States after their coordinate has moved by ``step``."""
    found = []
    for x in laws:
        for i, after in enumerate(x.moved):
            name = f"{identifier(x.term.label)}_{i}"
            title = (
                f"{x.term.label}: its state {i} after the position (of a transmission: the "
                "torsion) has moved by step"
            )
            found.append(
                ShownEquation(
                    f"{name}_next", title, ca.SX.sym(f"{name}_next"), ((x.term.label, after),), "1"
                )
            )
    return found


def _converted(e: ShownEquation, kind: str) -> ShownEquation:
    return (
        e
        if kind == "rotary"
        else ShownEquation(e.key, e.title, e.left, e.parts, linear_unit(e.unit))
    )


# --- as text, LaTeX, sympy ------------------------------------------------------------------------


def shown(
    model: Solvable,
    language: Language = "text",
    errors: Mapping[str, float] = MappingProxyType({}),
    *,
    fitted: Collection[str] | None = None,
    trades: Sequence[str] = (),
) -> str:
    """The joint's equations and values.

    Parameters
    ----------
    model : Solvable
    language : {"text", "latex", "sympy"}
    errors : mapping
        Standard errors of the values, by parameter name.
    fitted : collection of str, optional
        Parameters that a fit has found: the others are said to have start values. By default
        nothing is said of where the values come from.
    trades : sequence of str
        Which of them go together, a sentence each; below the values of a text.
    """
    equations = readable(shown_equations(model))
    values = values_of(model, errors, fitted)
    if language == "latex":
        return _latex(equations, values, _heading(values))
    if language == "sympy":
        return _sympy(equations, model, values)
    return _text(equations, model, values, trades)


def values_of(
    model: Solvable, errors: Mapping[str, float], fitted: Collection[str] | None = None
) -> list[dict[str, Any]]:
    """Name, value, standard error (None where there is none), unit, side and meaning of every
    parameter, and whether it was fitted (None where `fitted` does not say).
    """
    return [
        {
            "name": p.name,
            "value": v,
            "stderr": errors.get(p.name),
            "fitted": None if fitted is None else p.name in fitted,
            "unit": p.unit,
            "side": p.side,
            "meaning": p.meaning,
        }
        for p, v in zip(model.parameters, model.value_vector(), strict=True)
    ]


def _heading(values: Sequence[Mapping[str, Any]]) -> str:
    """What the values are."""
    if values and all(v["fitted"] is False for v in values):
        return "start values: nothing is fitted yet"
    told = any(v["stderr"] is not None for v in values)
    return "values +- standard error" if told else "values"


def _text(
    equations: Sequence[ReadableEquation],
    model: Solvable,
    values: Sequence[Mapping[str, Any]],
    trades: Sequence[str],
) -> str:
    lines = [
        f"{model.name}: gear ratio {model.gear_ratio:g}; all quantities are referred to the "
        "link, in SI units"
    ]
    for e, where in ((r.equation, r.where) for r in equations):
        lines += ["", f"{e.title} [{e.unit}]", f"  {written(e.left)} ="]
        for i, (source, part) in enumerate(e.parts):
            body = written(part)
            minus = i > 0 and body.startswith("-") and " + " not in body and " - " not in body
            head = "-" if minus else "+" if i else " "
            body = body[1:] if minus else body
            lines += _broken(f"    {head} {body}", source)
        for symbol, definition in where:
            lines += _broken(f"    with {written(symbol)} = {written(definition)}", "")
    heading = _heading(values)
    lines += ["", heading]
    for v in values:
        error = f" +- {v['stderr']:.2g}" if v["stderr"] is not None else ""
        start = " (start value)" if v["fitted"] is False and not heading.startswith("start") else ""
        lines.append(
            f"  {v['name']} = {v['value']:.6g}{error} {v['unit']}{start}".ljust(_WIDTH)
            + f"  # {v['meaning']}"
        )
    if trades:
        lines += ["", "errors that go together", *(f"  {text}" for text in trades)]
    return "\n".join(lines) + "\n"


def _broken(line: str, source: str) -> list[str]:
    """A line of an equation; a long one is broken before its operators."""
    said = f"  # {source}" if source else ""
    if len(line) <= READABLE:
        return [line.ljust(_WIDTH) + said if said else line]
    head, _, body = line.strip().partition(" ")
    lines = [f"    {head}".ljust(_WIDTH) + said if said else f"    {head}"]
    for summand in _summands(body):
        lines += textwrap.wrap(
            summand,
            _LINE,
            initial_indent="        ",
            subsequent_indent="            ",
            break_long_words=False,
            break_on_hyphens=False,
        )
    return lines


def _summands(text: str) -> list[str]:
    """A written sum, cut before the signs of its outermost level that has any."""
    depth, signs = 0, []
    for i, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if text[i : i + 3] in (" + ", " - "):
            signs.append((depth, i))
    least = min((d for d, _ in signs), default=0)
    cuts = [0, *(i + 1 for d, i in signs if d == least), len(text)]
    return [text[i:j].rstrip() for i, j in zip(cuts, cuts[1:], strict=False)]


def _latex(
    equations: Sequence[ReadableEquation], values: Sequence[Mapping[str, Any]], heading: str
) -> str:
    rows = []
    for e, where in ((r.equation, r.where) for r in equations):
        left = written(e.left, "latex", LATEX_SIGNALS)
        for i, (_, part) in enumerate(e.parts):
            body = written(part, "latex", LATEX_SIGNALS)
            join = f"{left} &= " if i == 0 else "&\\quad " if body.startswith("-") else "&\\quad + "
            rows.append(f"  {join}{body}")
        for symbol, definition in where:
            name, body = (written(x, "latex", LATEX_SIGNALS) for x in (symbol, definition))
            rows.append(f"  {name} &= {body}")
    table = [
        rf"  {latex_name(v['name'])} &= {_latex_number(v['value'])}"
        + (rf" \pm {_latex_number(v['stderr'], 2)}" if v["stderr"] is not None else "")
        + (rf"\;{_latex_unit(v['unit'])}" if v["unit"] != "1" else "")
        for v in values
    ]
    if heading.startswith("start"):
        table.insert(0, rf"  &\text{{{heading}}}")
    blocks = [
        r"\begin{aligned}" + "\n" + " \\\\\n".join(part) + "\n" + r"\end{aligned}"
        for part in (rows, table)
    ]
    return "\n".join(f"\\[\n{block}\n\\]" for block in blocks) + "\n"


def _latex_number(value: float, digits: int = 6) -> str:
    head, found, power = f"{value:.{digits}g}".partition("e")
    return rf"{head} \cdot 10^{{{int(power)}}}" if found else head.replace("inf", r"\infty")


def _latex_unit(unit: str) -> str:
    return r"\mathrm{" + re.sub(r"(\d+)", r"^{\1}", unit).replace(".", r"\,") + "}"


def _sympy(
    equations: Sequence[ReadableEquation], model: Solvable, values: Sequence[Mapping[str, Any]]
) -> str:
    """Python code that defines the symbols, one ``Eq`` for each equation, ``values`` and
    ``errors``.
    """
    names: dict[str, None] = {}
    short = {identifier(symbol.name()) for r in equations for symbol, _ in r.where}
    for r in equations:
        all_parts = (*(x for _, x in r.where), *(part for _, part in r.equation.parts))
        for x in ca.symvar(ca.vertcat(r.equation.left, *all_parts)):
            if identifier(x.name()) not in short:
                names[identifier(x.name())] = None
    names.update(dict.fromkeys(model.parameter_names))
    lines = [
        f"# {model.name!r}: gear ratio {model.gear_ratio!r}; link-referred, SI units",
        "from sympy import *",
        "",
    ]
    lines += [f'{n} = Symbol("{n}", real=True)' for n in names]
    lines.append("equations = {}")
    for e, where in ((r.equation, r.where) for r in equations):
        lines += [f"{written(symbol, 'sympy')} = {written(x, 'sympy')}" for symbol, x in where]
        right = " + ".join(f"({written(part, 'sympy')})" for _, part in e.parts)
        lines += [
            f"# {e.title} [{e.unit}]",
            f'equations["{e.key}"] = Eq('
            f"{written(e.left, 'sympy')}, {right or '0'}, evaluate=False)",
        ]
    lines += [f"# {_heading(values)}", "values = {"]
    for v in values:
        lines.append(f"    {v['name']}: {v['value']!r},  # {v['unit']}")
    lines += [
        "}",
        "errors = {",
        *(f"    {v['name']}: {v['stderr']!r}," for v in values if v["stderr"] is not None),
        "}",
    ]
    return "\n".join(lines) + "\n"
