"""show: the equations of a joint, and its friction as a table."""

from __future__ import annotations

import sys
from argparse import Namespace
from typing import Final

import casadi as ca
import numpy as np

from casadi_models import JointModel
from casadi_models.text.compensation import friction_compensation
from casadi_models.text.shown import shown, shown_equations, values_of
from casadi_models.text.written import LANGUAGES, written
from identification.errors import InputError
from identification.fitting.trust import trusted_file
from workbench.cli.files import open_joint, write_json, write_text

SPEEDS: Final = 40
"""Speeds of the table in each direction, in a geometric row: friction bends most near rest."""
SLOWEST: Final = 1e-3
"""Slowest speed of the table as a share of the fastest."""
POSITIONS: Final = 73
"""Positions of the table where friction depends on them: every 5 degrees of a turn, or over 1 m
to either side.
"""


def run_show(arguments: Namespace) -> int:
    """`irj show --joint J [--format text|latex|sympy] [-o FILE]`."""
    joint = open_joint(arguments.joint)
    model = joint.model()
    if arguments.compensation:
        return _compensation(model, arguments)
    told = trusted_file(joint).parameters if joint.errors else ()
    # of a pair each says the same the other way round
    pairs = {frozenset((p.name, p.partner or "")): p.trade for p in reversed(told) if p.trade}
    text = shown(
        model,
        arguments.format,
        joint.errors,
        fitted=joint.fitted,
        trades=tuple(reversed(pairs.values())),
    )
    if arguments.output:
        write_text(arguments.output, text)
        print(arguments.output)
    else:
        print(text, end="")
    if arguments.json:
        equations = [
            {
                "key": e.key,
                "title": e.title,
                "unit": e.unit,
                "symbols": sorted({x.name() for x in ca.symvar(ca.vertcat(e.left, e.right))}),
                **{
                    n: {"left": written(e.left, n), "right": written(e.right, n)} for n in LANGUAGES
                },
            }
            for e in shown_equations(model)
        ]
        write_json(
            arguments.json,
            {
                "joint": joint.name,
                "equations": equations,
                "values": values_of(model, joint.errors, joint.fitted),
                "trades": [
                    {"name": p.name, "with": p.partner, "trade": p.trade} for p in told if p.trade
                ],
            },
        )
    return 0


def _compensation(model: JointModel, arguments: Namespace) -> int:
    """The friction as a table over velocity, and over position where it depends on it; without
    load, at temperature 0.
    """
    if arguments.format != "text":
        raise InputError("show: --compensation is a table; leave --format out")
    rotary = model.kind == "rotary"
    fastest = np.radians(arguments.max_speed) if rotary else arguments.max_speed
    if not 0.0 < SLOWEST * fastest < np.inf:
        raise InputError(
            f"show: --max-speed {arguments.max_speed:g} must be positive, and a number that can be "
            "computed with"
        )
    try:
        function = friction_compensation(model)
    except ValueError as error:
        raise InputError(f"{arguments.joint}: {error}; there is nothing to compensate") from None
    speeds = np.geomspace(SLOWEST * fastest, fastest, SPEEDS)
    speeds = np.concatenate((-speeds[::-1], [0.0], speeds))
    given = function.sx_in()
    follows = {
        n: ca.depends_on(function(*given), x)
        for n, x in zip(function.name_in(), given, strict=True)
    }
    reach = np.pi if rotary else 1.0
    positions = np.linspace(-reach, reach, POSITIONS) if follows["position"] else np.zeros(1)
    p = model.value_vector()
    rows = [(v, q, float(function(q, v, 0.0, 0.0, p))) for q in positions for v in speeds]
    if not any(row[2] for row in rows):
        raise InputError(
            f"{arguments.joint}: its friction has the values 0; fit it to records first (irj fit "
            "-o)"
        )
    unit, torque = ("rad", "Nm") if rotary else ("m", "N")
    columns = [f"link_velocity_{unit}_s", f"link_position_{unit}", f"friction_torque_{torque}"]
    kept = [0, 1, 2] if follows["position"] else [0, 2]
    lines = [
        ",".join(columns[i] for i in kept),
        *(",".join(f"{row[i]:.9g}" for i in kept) for row in rows),
    ]
    text = "\n".join(lines) + "\n"
    if arguments.output:
        write_text(arguments.output, text)
        print(f"{arguments.output}: {len(rows)} rows")
    else:
        print(text, end="")
    for name, word in (("load", "without load"), ("temperature", "at the temperature's origin")):
        if follows[name]:
            print(
                f"irj: friction follows the {name} too; the table holds it {word}, `irj export "
                "c` has the function",
                file=sys.stderr,
            )
    write_json(
        arguments.json, {c: [row[i] for row in rows] for i, c in enumerate(columns) if i in kept}
    )
    return 0
