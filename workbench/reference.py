"""The reference page, from the declarations: ``python -m workbench.reference --out docs/reference.md``.

Channels, tables of files, units, models, CasADi functions and options are declared where they are
used; this module writes them down and adds nothing of its own but the headings.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from casadi_models import JointModel, Parameter
from casadi_models.functions import INPUTS
from casadi_models.quantities import ALIASES, BASE_NAMES, COUNTS, PREFIXED, PREFIXES, TABLE
from casadi_models.term import (
    INERTIAS,
    LOAD_COMPLIANCE,
    LOAD_DAMPING,
    SWINGING_SHARE,
    TOTAL_INERTIA,
)
from casadi_models.transmission import MODELS
from identification.data import joint_schema
from identification.data.channels import DECLARED, TIME
from identification.data.plain_text import toml_value
from identification.data.schema import KINDS, Key, Schema
from irj_fmu.batch import run as batch_run
from irj_fmu.batch import study_schema
from irj_fmu.build import parser as build_parser
from irj_fmu.command_line import OneLineParser
from irj_fmu.cosim import parser as cosim_parser
from irj_fmu.imported import file_schema
from workbench.cli.fmi import code_parser
from workbench.cli.main import parser as irj_parser
from workbench.cli.user_fmu import export_parser

RATIO: Final = -160.0
"""Gear ratio of the models that are built to be listed; names and shapes do not depend on it."""

HEADER: Final = """# Reference

Generated from the declarations in the code by `python -m workbench.reference --out docs/reference.md`. Do not edit it by
hand. The laws of the effects and their parameters stand in [effects.md](effects.md).

[Channels](#channels) · [Joint file](#joint-file) · [An FMU as the model](#an-fmu-as-the-model) · [Study file](#study-file) ·
[Units](#units) · [Models](#models) · [CasADi functions](#casadi-functions) · [Commands](#commands)
"""

CHANNELS: Final = """## Channels

One column of a record is one channel. A header `<channel>_<unit>`, such as `motor_current_mA` or `link_velocity_deg_s`
(underscores stand for `/` and `.`), or `<channel> [unit]` is recognised; any other column needs an entry in [columns].
In memory every channel is in SI units: those of the table.
"""

JOINT: Final = """## Joint file

A TOML file with these tables. Any other table or key is refused.
"""

FMU: Final = """## An FMU as the model

The same file with a table [model]; [known] and [calibration] do not go with it.
"""

STUDY: Final = """## Study file

What `irj batch` runs ([batch.md](batch.md)).
"""

UNITS: Final = """## Units

A unit is made of the names below, joined by `.` or `*`, divided by `/`, each with an optional power: `N.m/rad`, `kg.m2`,
`rad/s2`, `Nm/A`, `N*m*s/rad`, `m^2`, `s-1`. After a `/` a product needs brackets: `N.m/(rad.s)`. A value in SI units is
factor * value + offset.
"""

MODEL: Final = """## Models

`model` in [joint] names where to start; `effects` adds to it. In Python the same names are taken:
`JointModel.by_name("irj2b", gear_ratio=-160.0)`, and `JointModel.harmonic_drive("hd3")` or `harmonic_drive(3)` for the
harmonic-drive models. All parameters are referred to the link, whatever the side on which they act; a fit takes starts and bounds that are not known from the data.
"""

FUNCTIONS: Final = """## CasADi functions

A `JointModel` has these CasADi functions. Values are numbers, arrays or CasADi expressions; SI units, all link-referred.
`irj export casadi` and `irj export c` write dynamics, jacobian, regressor and energy to files, with `parameters.json`:
names, units and values in the order of p.
"""

COMMANDS: Final = """## Commands

`irj VERB ...`. These go with every verb: `--help`; `--effects FILE.py`, which registers your own effects
([extending.md](extending.md)) and may be given several times; `--json FILE`, the result as JSON. `irj --version` prints the
version. Exit codes: 0 done, 1 a check that you asked for failed, 2 unusable input, 3 an error of the program, 130
interrupted.
"""

EXAMPLE: Final = """\
import numpy as np
from casadi_models import JointModel

model = JointModel.harmonic_drive("hd3", gear_ratio=-160.0).add("coulomb@motor")
model = model.with_values(
    {
        "motor_inertia": 4.4,
        "link_inertia": 10.0,
        "stiffness": 2e4,
        "structural_damping": 40.0,
        "motor_coulomb": 20.0,
    }
)
p = model.value_vector()  # in the order of model.parameter_names
x = [0.011, 0.30, 0.010, 0.29]  # motor position, motor velocity, link position, link velocity
u = [60.0, 0.0, 0.0]  # drive N.m, temperature K, time s

dx = np.array(model.dynamics(x, u, p)).ravel()
print("dx/dt    ", dx.round(3))

a = dx[[1, 3]]  # accelerations of motor and link
Y, rest = (np.array(m) for m in model.regressor(x, a, u, p))
theta = [p[model.parameter_names.index(n)] for n in model.linear_parameters]
print("columns  ", *model.linear_parameters)
print(Y.round(3))
print("Y theta  ", (Y @ theta + rest.ravel()).round(9))  # the drive, and 0 on the link

dx_x, dx_u, dx_p = (np.array(m) for m in model.jacobian(x, u, p))
print("shapes   ", dx_x.shape, dx_u.shape, dx_p.shape)
print("energy   ", round(float(model.energy(x, p)), 4), "J")
"""
"""The worked example; the page shows what it prints."""

_INPUT_UNITS: Final = {"drive": "N.m", "temperature": "K", "time": "s"}


# --- Markdown -------------------------------------------------------------------------------------


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(" ".join(c.split()).replace("|", "\\|") for c in cells) + " |"


def _table(head: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    return "\n".join([_line(head), _line(["---"] * len(head)), *map(_line, rows)]) + "\n"


def _code(names: Iterable[str]) -> str:
    return ", ".join(f"`{n}`" for n in names) or "-"


# --- chapters -------------------------------------------------------------------------------------


def channels() -> str:
    """Every channel: side, units, what it is."""
    rows = [
        (f"`{c.name}`", c.side, c.rotary, c.linear, c.meaning) for c in (TIME, *DECLARED.values())
    ]
    return CHANNELS + "\n" + _table(("channel", "side", "rotary", "linear", "what it is"), rows)


def schema(found: Schema) -> str:
    """One table of a file."""
    head = f"### `{found.place}`\n\n{found.meaning}\n"
    if not found.keys:
        return head
    columns = ("key", "value", "unit", "where it is left out", "meaning")
    return head + "\n" + _table(columns, map(_key, found.keys))


def _key(key: Key) -> tuple[str, ...]:
    kind = ", ".join(f'`"{c}"`' for c in key.choices) or key.form or KINDS[key.kind]
    if key.required:
        left_out = "required"
    elif key.absent:
        left_out = key.absent
    else:
        left_out = "-" if key.default in (None, ()) else f"`{toml_value(key.default)}`"
    return f"`{key.name}`", kind, key.unit, left_out, key.meaning


def files() -> str:
    """The tables of joint files and study files."""
    parts = [JOINT, *map(schema, joint_schema.PAGES), FMU, *map(schema, file_schema.PAGES)]
    return "\n".join([*parts, STUDY, *map(schema, study_schema.PAGES)])


def units() -> str:
    """Every unit that is read."""
    rows = [
        (
            f"`{name}`",
            f"{unit.factor:.10g}",
            f"{unit.offset:.10g}" if unit.offset else "",
            _base(unit.named_exponents),
            _code(a for a, own in ALIASES.items() if own == name),
        )
        for name, unit in TABLE.items()
    ]
    prefixes = ", ".join(f"`{p}` {f:g}" for p, f in PREFIXES.items())
    taking = _code(n for n in TABLE if n in PREFIXED)
    return (
        UNITS
        + "\n"
        + _table(("unit", "factor", "offset", "in SI", "also written"), rows)
        + f"\nPrefixes: {prefixes}. They go with {taking}; `µ` is read as `u`.\n"
        + f"\nCounts of an encoder: {_code(sorted(COUNTS))}, with `counts_per_turn`.\n"
    )


def _base(exponents: Mapping[str, int]) -> str:
    above, below = (
        [n if (e := sign * exponents[n]) == 1 else f"{n}{e}" for n in names]
        for sign, names in (
            (1, [n for n in BASE_NAMES if exponents.get(n, 0) > 0]),
            (-1, [n for n in BASE_NAMES if exponents.get(n, 0) < 0]),
        )
    )
    divisor = ".".join(below) if len(below) < 2 else f"({'.'.join(below)})"
    return (".".join(above) or "1") + (f"/{divisor}" if below else "")


def models() -> str:
    """Effects and parameters of every model that a joint file may name."""
    made = {name: JointModel.by_name(name, RATIO) for name in MODELS}
    rows = [
        (f"`{name}`", "elastic" if m.is_elastic else "rigid", _code(m.effects))
        for name, m in made.items()
    ]
    found: dict[str, tuple[Parameter, Parameter, list[str]]] = {}
    for name, model in made.items():
        linear = {p.name: p for p in JointModel.by_name(name, RATIO, kind="linear").parameters}
        for p in model.parameters:
            found.setdefault(p.name, (p, linear[p.name], []))[2].append(name)
    parameters = [
        (
            f"`{p.name}`",
            p.unit,
            q.unit,
            f"{p.low:g} to {p.high:g}",
            f"{JointModel.by_name(where[0], RATIO).value_vector()[_index(where[0], p.name)]:g}",
            p.meaning,
            ", ".join(where) if len(where) < len(MODELS) else "all",
        )
        for p, q, where in found.values()
    ]
    parameters += [
        (
            f"`{p.name}`",
            p.unit,
            p.for_kind("linear").unit,
            f"{p.low:g} to {p.high:g}",
            f"{p.start:g}",
            p.meaning,
            "an axis measured on one side",
        )
        for p in (
            *(INERTIAS[n] for n in TOTAL_INERTIA),
            LOAD_COMPLIANCE,
            SWINGING_SHARE,
            LOAD_DAMPING,
        )
    ]
    columns = ("parameter", "rotary", "linear", "bounds", "start", "meaning", "models")
    return (
        MODEL
        + "\n"
        + _table(("model", "kind", "effects"), rows)
        + "\n"
        + _table(columns, parameters)
    )


def _index(model: str, name: str) -> int:
    return JointModel.by_name(model, RATIO).parameter_names.index(name)


def functions() -> str:
    """Arguments, results, orders and shapes of the CasADi functions."""
    u = ", ".join(f"{n} [{_INPUT_UNITS[n]}]" for n in INPUTS)
    arguments = [
        (
            "`x`",
            "n_x",
            "elastic: motor_position [rad], motor_velocity [rad/s], link_position [rad], "
            "link_velocity [rad/s]; rigid: position [rad], velocity [rad/s]; then the internal "
            "states of effects with memory, `model.functions.memory_names`",
        ),
        ("`u`", str(len(INPUTS)), u),
        ("`p`", "n_p", "`model.parameter_names`, values by `model.value_vector()`"),
        ("`a`", "n_a", "accelerations [rad/s2]: of motor and link, or of the rigid joint"),
        ("`h`", "1", "step [s]"),
    ]
    results = [
        ("`model.dynamics(x, u, p)`", "dx/dt", "(n_x, 1)"),
        (
            "`model.jacobian(x, u, p)`",
            "derivatives of dx/dt by x, by u and by p; rows as x, columns as x, u, p",
            "(n_x, n_x), (n_x, 3), (n_x, n_p)",
        ),
        (
            "`model.regressor(x, a, u, p)`",
            "Y and rest: Y theta + rest is the drive [N.m] in the motor's row and 0 in the link's. "
            "Columns of Y are `model.linear_parameters`, theta their values; the parameters that "
            "enter otherwise are taken from p. A column has the unit N.m per unit of its parameter",
            "(n_a, n_Y), (n_a, 1)",
        ),
        ("`model.energy(x, p)`", "kinetic and potential energy [J]", "(1, 1)"),
        ("`model.functions.step(x, u, p, h)`", "x after a step of time h", "(n_x, 1)"),
        (
            "`model.functions.outputs(x, u, p)`",
            "readings, with the errors of the sensors: position and velocity of the motor, of the "
            "link, torque into the link",
            "(5, 1)",
        ),
    ]
    shapes = []
    for name in MODELS:
        model = JointModel.by_name(name, RATIO)
        x, a, _, p = (model.regressor.size1_in(i) for i in range(4))
        rest = [n for n in model.parameter_names if n not in model.linear_parameters]
        shapes.append(
            (
                f"`{name}`",
                str(x),
                str(a),
                str(p),
                str(model.regressor.size2_out(0)),
                _code(model.parameter_names),
                _code(rest),
            )
        )
    columns = ("model", "n_x", "n_a", "n_p", "n_Y", "order of p", "of these not in Y")
    printed = run_example()
    return "\n".join(
        [
            FUNCTIONS,
            _table(("argument", "length", "order and units"), arguments),
            _table(("function", "result", "shape"), results),
            "Columns of Y have the order of p, without the names in the last column.\n",
            _table(columns, shapes),
            "A linear axis has m, m/s, m/s2 and N in place of rad, rad/s, rad/s2 and N.m. "
            "`model.linearize()` is a `control.StateSpace` about rest.\n",
            "A worked example:\n",
            f"```python\n{EXAMPLE}```\n",
            f"It prints\n\n```text\n{printed}```\n",
        ]
    )


def run_example() -> str:
    """What the worked example prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(EXAMPLE, "reference example", "exec"), {})
    return out.getvalue()


def parsers() -> list[tuple[str, OneLineParser]]:
    """Every command with its arguments, in the order of ``irj --help``."""
    own = {
        "export": [
            ("irj export [KIND]", build_parser("irj export")),
            ("irj export c, irj export casadi", code_parser("irj export")),
            ("irj export corrected, pair or ssp (an FMU as the model)", export_parser()),
        ],
        "cosim": [("irj cosim", cosim_parser())],
        "batch": [("irj batch", batch_run.parser())],
    }
    found: list[tuple[str, OneLineParser]] = []
    for name, sub in irj_parser().verbs.items():
        found += own.get(name, [(f"irj {name}", sub)])
    return found


def commands() -> str:
    """Every option of every command."""
    parts = [COMMANDS]
    for title, parser in parsers():
        parts.append(f"### `{title}`\n\n{_sentence(parser.description or '')}\n")
        rows = [row for action in parser.arguments if (row := _option(action))]
        if rows:
            parts.append(_table(("argument", "value", "meaning"), rows))
    return "\n".join(parts)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _option(action: argparse.Action) -> tuple[str, ...] | None:
    """One argument as a row; None for what goes with every verb."""
    if {"--help", "--json"} & set(action.option_strings):
        return None
    metavar = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    value = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    if action.choices is not None:
        value = ", ".join(map(str, action.choices))
    elif action.nargs in ("+", "*"):
        value += " ..."
    name = ", ".join(action.option_strings) or action.dest
    meaning = str(action.help or "")
    if "default" not in meaning and action.default not in (None, False, []):
        meaning += f" (default {action.default})"
    if action.required and action.option_strings:
        meaning += " (required)"
    return f"`{name}`", f"`{value}`" if value else "", meaning


def page() -> str:
    """The whole page in Markdown."""
    return "\n".join([HEADER, channels(), files(), units(), models(), functions(), commands()])


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page to a file, or to standard output."""
    parser = OneLineParser(description="The reference page, from the declarations.")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="file to write; standard output by default"
    )
    target: Path | None = parser.parse_args(arguments).out
    if target is None:
        sys.stdout.write(page())
    else:
        target.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
