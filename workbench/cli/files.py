"""Reading records through the check gate, writing results in one piece."""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from identification.balance.sensing import Sensing, check_alike
from identification.data.check.gate import needed, passed
from identification.data.joint_edit import with_effects
from identification.data.joint_file import Joint, load_joint, toml_text
from identification.data.read import read
from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.command_line import check_output, is_special, progress_bar, replace_file, write_json
from irj_fmu.imported.file_schema import fmu_of


def open_joint(path: str) -> Joint:
    """A joint file."""
    return load_joint(path)


def enlarged(joint: Joint, label: str) -> str:
    """The joint's own file with one more effect; what else stands in it stays."""
    larger = replace(joint, effects=(*joint.effects, label))
    path = Path(joint.source)
    if is_special(path):  # a pipe is read once
        return toml_text(larger)
    return with_effects(path.read_text(encoding="utf-8-sig"), larger)


def open_records(paths: Sequence[str], joint: Joint | None) -> tuple[list[Record], list[str]]:
    """Records in SI through the check gate, and its warnings (also printed).

    Raises
    ------
    InputError
        A record that cannot be used: one line that starts with its path.
    """
    records, warnings = [], []
    for path in paths:
        record = read(
            path,
            columns=joint.columns if joint is not None else None,
            kind=joint.kind if joint is not None else None,
        )
        try:
            record, findings = passed(record, joint)
        except InputError as error:
            raise named(error, path, record) from None
        warnings += [
            f"{path}: {f.message.removeprefix(record.name + ': ')}"
            for f in findings
            if f.severity in ("warn", "repair")
        ]
        records.append(record)
    for text in warnings:
        print(f"irj: {text}", file=sys.stderr)
    return records, warnings


def alike(
    paths: Sequence[str], records: Sequence[Record], joint: Joint, *, once: bool = True
) -> Sensing:
    """What records show; those that do not let one see the same, or one run given twice, are
    refused in one line that starts with the path.
    """
    return check_alike(records, joint.model(), paths, once=once)


def named(error: InputError, path: str, record: Record) -> InputError:
    """The error with the path of its record in place of the record's name."""
    return InputError(f"{path}: {str(error).removeprefix(record.name + ': ')}")


OUTPUTS: Final = ("json", "output", "report", "truth", "picture")
RASTERS: Final = (".png", ".jpg", ".jpeg", ".gif", ".webp", ".tif", ".tiff", ".bmp", ".pdf", ".eps")
"""Endings of pictures that programs open as what they are named."""
READ: Final = [
    "records",
    "held_out",
    "fit_records",
    "healthy",
    "other_payload",
    "effects",
    "own_effects",
    "reference",
    "beside",
    "up",
    "down",
    "horizontal",
    "record",
    "like",
    "fmu",
    "planned",
]
"""Options whose files are read, whatever the verb."""


def check_outputs(arguments: Namespace) -> None:
    """Refuse results that could not be written, or that would replace an input, before any work is
    done.

    The joint file may be written back in place by ``fit``, ``improve`` and ``add``.
    """
    inputs = [path for name in READ for path in _listed(arguments, name)]
    joint = getattr(arguments, "joint", None)
    fmu = fmu_of(joint) if joint else None
    inputs += [] if fmu is None else [str(fmu)]
    named: dict[str, str] = {}
    for option in OUTPUTS:
        path = getattr(arguments, option, None)
        if path is None:
            continue
        in_place = option == "output" and arguments.verb in ("fit", "improve", "add")
        check_output(path, inputs + ([joint] if joint and not in_place else []))
        target = Path(os.path.realpath(path))
        if str(target) in named and not is_special(target):
            raise InputError(f"{path}: given for two results; give each a file of its own")
        named[str(target)] = option
        if option == "picture" and target.suffix.lower() in RASTERS:
            raise InputError(f"{path}: a picture is written as SVG; name it {target.stem}.svg")


def distinct(**groups: Sequence[str]) -> None:
    """Refuse a record that is given in two roles: what the fit must not see, it must not see
    under another name either.
    """
    seen: dict[tuple[int, int], tuple[str, str]] = {}
    for role, paths in groups.items():
        for path in paths:
            if not Path(path).exists():
                continue
            found = Path(path).stat()
            before = seen.setdefault((found.st_dev, found.st_ino), (role, path))
            if before[0] != role:
                said = " and as ".join(r.replace("_", " ") for r in (before[0], role))
                raise InputError(
                    f"{path}: given as {said} record; a record can have one role only, leave it "
                    "out of one"
                )


def _listed(arguments: Namespace, name: str) -> list[str]:
    given = getattr(arguments, name, None) or []
    return [given] if isinstance(given, str) else list(given)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file in one piece: a reader sees the old one or the new one, never a part.

    Raises
    ------
    InputError
        The folder is missing or not writable; the disk is full.
    """
    replace_file(path, lambda stream: stream.write(content))


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in one piece (see :func:`write_bytes`); a byte of a file name that is
    no UTF-8 becomes a question mark.
    """
    write_bytes(path, text.encode("utf-8", "replace"))


__all__ = [
    "OUTPUTS",
    "alike",
    "check_outputs",
    "distinct",
    "enlarged",
    "named",
    "needed",
    "open_joint",
    "open_records",
    "progress_bar",
    "write_bytes",
    "write_json",
    "write_text",
]
