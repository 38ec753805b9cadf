"""joints, joint: the library of identified joints; a first joint file for somebody else's FMU."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

from identification.data.joint_library import Entry, chosen, entries, packaged, side_by_side
from identification.errors import InputError
from workbench.cli.files import open_joint, open_records, progress_bar, write_json, write_text


def run_joints(arguments: Namespace) -> int:
    """`irj joints list|show|compare`."""
    paths, names = _apart(arguments.library)
    arguments.names = [*arguments.names, *names]
    among = [*packaged(), *entries(paths)]
    work = {"list": _listed, "show": _shown, "compare": _compared}[arguments.what]
    work(arguments, among)
    return 0


def _apart(given: list[list[str]]) -> tuple[list[str], list[str]]:
    """Paths of libraries, and names of joints that were written behind one: the first word of each
    `--library` is a path, and so are others that lie there.
    """
    paths: list[str] = []
    names: list[str] = []
    for first, *more in given:
        paths.append(first)
        for word in more:
            (paths if Path(word).exists() else names).append(word)
    return paths, names


def _listed(arguments: Namespace, among: list[Entry]) -> None:
    given = chosen(arguments.names, among) if arguments.names else among
    for entry in given:
        effects = ", ".join(entry.joint.effects) or "those of the model"
        print(
            f"{entry.name:<20} {entry.type:<20} {entry.joint.model_name}, {effects}: "
            f"{len(entry.values)} values"
        )
    write_json(arguments.json, [e.as_json() for e in given])


def _shown(arguments: Namespace, among: list[Entry]) -> None:
    if not arguments.names:
        raise InputError("joints show: name a joint; `irj joints list` has them")
    given = chosen(arguments.names, among)
    for entry in given:
        joint = entry.joint
        print(f"{entry.name}: {joint.kind}, gear ratio {joint.gear_ratio:g}, {joint.model_name}")
        print(f"  effects: {', '.join(joint.effects) or 'those of the model'}")
        for key, text in entry.provenance.items():
            print(f"  {key}: {text}")
        for name, value in entry.values.items():
            error = f" +- {entry.errors[name]:.2g}" if name in entry.errors else ""
            print(f"  {name:<32} {value:.6g}{error} {entry.units.get(name, '')}".rstrip())
        if entry.left_out:
            print(f"  no law of the library takes: {', '.join(entry.left_out)}")
    write_json(arguments.json, [e.as_json() for e in given])


def _compared(arguments: Namespace, among: list[Entry]) -> None:
    given = chosen(arguments.names, among)
    if len(given) < 2:
        raise InputError(
            "joints compare: name two joints or more, or a type that has several; "
            "`irj joints list` has them"
        )
    if len({e.joint.kind for e in given}) > 1:
        raise InputError("joints compare: a rotary and a linear axis have no unit in common")
    rows = side_by_side(given)
    width = max(12, *(len(e.name) + 2 for e in given))
    labels = [f"{row['parameter']} [{row['unit']}]" for row in rows]
    first = max(map(len, labels)) + 2
    print(f"{'parameter':<{first}}{''.join(f'{e.name:>{width}}' for e in given)}    spread")
    for label, row in zip(labels, rows, strict=True):
        cells = "".join(f"{'-' if v is None else f'{v:.5g}':>{width}}" for v in row["values"])
        spread = row["spread_percent"]
        print(f"{label:<{first}}{cells}    {'' if spread is None else f'{spread:.3g} %'}".rstrip())
    write_json(arguments.json, {"joints": [e.as_json() for e in given], "rows": rows})


def run_joint(arguments: Namespace) -> int:
    """`irj joint new MODEL.fmu --record REC`."""
    from irj_fmu.first_joint import first_joint
    from irj_fmu.host.fmu import FmuError
    from irj_fmu.imported.file import is_user_joint, load_user_joint

    like = arguments.like
    known = None
    if like:
        known = load_user_joint(like).joint if is_user_joint(like) else open_joint(like)
    records, _ = open_records([arguments.record], known)
    try:
        folder = Path(arguments.output).parent if arguments.output else None
        text = first_joint(arguments.fmu, records[0], known, folder=folder, progress=progress_bar)
    except FmuError as error:
        raise InputError(str(error)) from error
    guesses = [line for line in text.splitlines() if "#" in line]
    if arguments.output:
        write_text(arguments.output, text)
        print("\n".join(guesses))
        print(f"joint file: {arguments.output}")
    else:
        sys.stdout.write(text)
    write_json(arguments.json, {"file": arguments.output, "guesses": guesses})
    return 0
