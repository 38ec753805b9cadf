"""import: look at a measurement file, and write the joint file that reads it."""

from __future__ import annotations

import math
import shlex
from argparse import Namespace
from pathlib import Path
from typing import Any, Final

from identification.data.joint_file import parse_joint
from identification.data.joint_schema import START_EFFECTS
from identification.data.plain_text import tables_text
from identification.data.survey import Seen, Survey, survey
from identification.errors import InputError
from workbench.cli.files import write_json, write_text

BLOCKS: Final = "▁▂▃▄▅▆▇█"
WIDTH: Final = 16
"""Characters of a sparkline."""


def run_import(arguments: Namespace) -> int:
    """`irj import FILE -o joint.toml`."""
    path = Path(arguments.records[0])
    if not path.exists():
        raise InputError(f"{path}: there is no such file; check the path")
    ratio = arguments.gear_ratio
    if ratio is not None and (ratio == 0.0 or not math.isfinite(ratio)):
        raise InputError(f"--gear-ratio is {ratio:g}; give theta_motor / theta_link with its sign")
    if arguments.output:  # refuse the arguments before anything is said of the file
        parse_joint({"joint": _table(path.stem, "rotary", arguments)}, str(arguments.output))
    made = survey(
        path,
        kind=arguments.kind,
        number=arguments.joint_number,
        gear_ratio=ratio,
        name=str(path),
    )
    wanted = arguments.joint_number
    if wanted not in (None, -1) and wanted not in made.joints:
        joints = f"{made.joints[0]} to {made.joints[-1]}" if made.joints else "one joint"
        raise InputError(
            f"{path}: no joint {wanted}; its columns are those of {joints} (-1: all are one joint)"
        )
    for line in lines(made, path):
        print(line)
    joint = _joint(made, path, arguments)
    if arguments.output:
        if not made.proposed or made.problem:
            problem = made.problem.removeprefix(f"{path}: ")
            raise InputError(f"{path}: {problem or 'no column is recognised'}")
        parse_joint(joint, str(arguments.output))
        write_text(arguments.output, tables_text(joint))
        check = shlex.join(["irj", "check", str(path), "--joint", str(arguments.output)])
        print(f"{arguments.output}: written; next: {check}")
        if arguments.gear_ratio is None:
            print("gear_ratio = 1 stands in it: correct it where there is a gear")
        if "motor_current" in made.map and arguments.motor_constant is None:
            print("a current is recorded: add motor_constant or torque_per_current")
    write_json(arguments.json, made.as_json())
    return 0


def lines(made: Survey, path: Path) -> list[str]:
    """What the terminal says of a file: a line a column, then the questions."""
    channels = {g.column.column: g for g in made.proposed}
    width = max((len(c.name) for c in made.columns), default=0)
    out = [f"{path}: {made.rows} rows, {made.kind} axis ({made.reader})"]
    for column in made.columns:
        guess = channels.get(column.name)
        if guess is None:
            said = "not used"
        else:
            low, high, unit = made.spans.get(guess.column.channel, (0.0, 0.0, ""))
            si = f" = {low:.4g} .. {high:.4g} {unit}" if unit else ""
            said = f"{guess.column.channel} [{guess.column.unit}]{si} ({guess.reason})"
        out.append(f"  {column.name:<{width}} {spark(column)} {_range(column):>24}  {said}")
    out += [f"? {text}" for _, text in made.questions]
    out += [f"{f.severity}: {f.message}" for f in made.findings]
    return [*out, f"refuse: {made.problem}"] if made.problem else out


def spark(column: Seen) -> str:
    """The shape of a column in `WIDTH` characters."""
    if column.low is None or column.high is None or not column.spark:
        return " " * WIDTH
    span = (column.high - column.low) or 1.0
    places = [k * len(column.spark) // WIDTH for k in range(WIDTH)]
    middle = [sum(column.spark[k]) / 2.0 for k in places]
    return "".join(BLOCKS[min(7, int(8 * (v - column.low) / span))] for v in middle)


def _range(column: Seen) -> str:
    if column.low is None:
        return "text" if column.lost == 0.0 else "no number"
    return f"{column.low:.5g} .. {column.high:.5g}"


def _joint(made: Survey, path: Path, arguments: Namespace) -> dict[str, Any]:
    named = f"{path.stem}_{made.number}" if made.number in made.joints else path.stem
    return {"joint": _table(named, made.kind, arguments), "columns": made.map}


def _table(name: str, kind: str, arguments: Namespace) -> dict[str, Any]:
    table = {
        "name": arguments.name or name,
        "kind": kind,
        "gear_ratio": 1.0 if arguments.gear_ratio is None else arguments.gear_ratio,
        "motor_constant": arguments.motor_constant,
        "model": "hd1",
        "effects": list(START_EFFECTS),
    }
    return {k: v for k, v in table.items() if v is not None}
