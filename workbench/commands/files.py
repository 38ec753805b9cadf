"""Reading records through the check gate, writing results in one piece."""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from identification.check import gate
from identification.errors import InputError
from identification.joint_file import Joint, load_joint
from identification.read import read
from identification.record import Record


def open_joint(path: str) -> Joint:
    """A joint file."""
    return load_joint(path)


def open_records(paths: Sequence[str], joint: Joint | None) -> tuple[list[Record], list[str]]:
    """Records in SI through the check gate, and its warnings (also printed)."""
    records, warnings = [], []
    for path in paths:
        columns = joint.columns if joint is not None else None
        record = read(path, columns=columns, kind=joint.kind if joint is not None else None)
        try:
            record, findings = gate(record, joint.gear_ratio if joint is not None else None)
        except InputError as error:
            text = str(error)
            raise InputError(text if str(path) in text or Path(path).name in text else f"{path}: {text}") from None
        for finding in findings:
            if finding.severity in ("warn", "repair"):
                warnings.append(f"{Path(path).name}: {finding.message}")
        records.append(record)
    for text in warnings:
        print(f"irj: {text}", file=sys.stderr)
    return records, warnings


def write_text(path: str | Path, text: str) -> None:
    """Write a file in one piece: a reader sees the old one or the new one."""
    target = Path(path)
    if not target.parent.is_dir():
        raise InputError(f"{target.parent}: no such folder; make it first or write somewhere else")
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        Path(name).chmod(0o644)
        Path(name).replace(target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


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
