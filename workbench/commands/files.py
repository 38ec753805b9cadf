"""Reading records through the check gate, writing results in one piece."""

from __future__ import annotations

import json
import math
import os
import sys
import tomllib
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from identification.check import gate
from identification.errors import InputError
from identification.joint_file import Joint, load_joint
from identification.read import read
from identification.record import Record
from identification.sensing import DRIVES
from workbench.session import write_atomic


def open_joint(path: str) -> Joint:
    """A joint file."""
    return load_joint(path)


def open_records(paths: Sequence[str], joint: Joint | None) -> tuple[list[Record], list[str]]:
    """Records in SI through the check gate, and its warnings (also printed).

    Raises
    ------
    InputError
        A record that cannot be used: one line that starts with its path.
    """
    records, warnings = [], []
    for path in paths:
        record = read(path, columns=joint.columns if joint is not None else None, kind=joint.kind if joint is not None else None)
        try:
            given = (joint.gear_ratio, needed(record, joint), joint.torque_per_current) if joint is not None else (None, needed(record, joint))
            record, findings = gate(record, *given)
        except InputError as error:
            raise InputError(f"{path}: {str(error).removeprefix(record.name + ': ')}") from None
        warnings += [f"{path}: {f.message.removeprefix(record.name + ': ')}" for f in findings if f.severity in ("warn", "repair")]
        records.append(record)
    for text in warnings:
        print(f"irj: {text}", file=sys.stderr)
    return records, warnings


def needed(record: Record, joint: Joint | None) -> tuple[str, ...]:
    """Channels that this joint file says are there: a motor constant goes with a current."""
    if joint is None or joint.torque_per_current is None or any(record.has(c) for c in DRIVES):
        return ()
    return ("motor_current",)


OUTPUTS: Final = ("json", "output", "report", "truth", "picture")


def check_outputs(arguments: Namespace) -> None:
    """Refuse results that could not be written, or that would replace an input, before any work is done.

    The joint file may be written back in place by ``fit``, ``improve`` and ``add``.
    """
    inputs = [*_listed(arguments, "records"), *_listed(arguments, "held_out"), *_listed(arguments, "fit_records")]
    inputs += [*_listed(arguments, "healthy"), *_listed(arguments, "other_payload"), *_listed(arguments, "effects"), *_listed(arguments, "own_effects")]
    joint = getattr(arguments, "joint", None)
    inputs += _fmu_of(joint)
    named: dict[str, str] = {}
    for option in OUTPUTS:
        path = getattr(arguments, option, None)
        if not path:
            continue
        target = Path(path)
        if target.is_dir():
            raise InputError(f"{path}: is a folder; give the name of a file")
        if not target.parent.is_dir():
            raise InputError(f"{target.parent}: no such folder; make it first or write somewhere else")
        if not os.access(target if _special(target) else target.parent, os.W_OK):
            raise InputError(f"{path}: its folder is not writable; write somewhere else")
        in_place = option == "output" and arguments.verb in ("fit", "improve", "add")
        for other in inputs + ([joint] if joint and not in_place else []):
            if target.exists() and Path(other).exists() and target.samefile(other):
                raise InputError(f"{path}: is an input of this command and would be lost; write somewhere else")
        if str(target) in named and not _special(target):
            raise InputError(f"{path}: given for two results; give each a file of its own")
        named[str(target)] = option


def _fmu_of(joint: object) -> list[str]:
    """The FMU that a joint file names as its model."""
    try:
        table = tomllib.loads(Path(str(joint)).read_text(encoding="utf-8-sig"))
        return [str(Path(str(joint)).parent / str(table["model"]["fmu"]))]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def distinct(**groups: Sequence[str]) -> None:
    """Refuse a record that is given in two roles: what the fit must not see, it must not see under another name either."""
    seen: dict[tuple[int, int], tuple[str, str]] = {}
    for role, paths in groups.items():
        for path in paths:
            if not Path(path).exists():
                continue
            found = Path(path).stat()
            before = seen.setdefault((found.st_dev, found.st_ino), (role, path))
            if before[0] != role:
                said = " and as ".join(r.replace("_", " ") for r in (before[0], role))
                raise InputError(f"{path}: given as {said} record; a record can have one role only, leave it out of one")


def _listed(arguments: Namespace, name: str) -> list[str]:
    return list(getattr(arguments, name, None) or [])


def _special(path: Path) -> bool:
    """A device or a pipe: written straight, not replaced."""
    return path.exists() and not path.is_file()


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file in one piece: a reader sees the old one or the new one, never a part.

    Raises
    ------
    InputError
        The folder is missing or not writable; the disk is full.
    """
    target = Path(os.path.realpath(path))
    try:
        if _special(Path(path)):
            with Path(path).open("wb") as stream:
                stream.write(content)
        else:
            write_atomic(target, content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); check the folder, its permissions and the space on the disk") from None


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in one piece (see :func:`write_bytes`)."""
    write_bytes(path, text.encode())


def write_json(path: str | None, data: Any) -> None:
    """Write a result as JSON, if asked for; numbers that are not finite become null."""
    if path:
        write_text(path, json.dumps(_finite(data), indent=1) + "\n")


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {k: _finite(v) for k, v in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(v) for v in data]
    if hasattr(data, "item") and not isinstance(data, str):
        data = data.item()
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


def progress_bar(text: str, share: float) -> None:
    """A line on the terminal that replaces itself; silent elsewhere."""
    if sys.stderr.isatty():
        width = round(30 * min(max(share, 0.0), 1.0))
        end = "\n" if share >= 1 else ""
        print(f"\r[{'#' * width}{'.' * (30 - width)}] {text:<40}", end=end, file=sys.stderr, flush=True)
