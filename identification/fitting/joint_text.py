"""A fitted joint as the text of a joint file, with standard errors and provenance."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from identification.balance.calibration import Found, calibration_found
from identification.balance.dataset import HOLD_DELAY, Dataset
from identification.data.joint_file import Joint, toml_text
from identification.fitting.engine import Solution
from identification.fitting.parameters import parameter_table
from identification.version import VERSION

DIGITS: Final = 6
"""Decimals of a correlation: two errors that all but cancel are then still known to a hundredth of
either, as `stderr` is to six digits."""


def calibration_of(solution: Solution, data: Dataset) -> tuple[Found, ...]:
    """What the sensors of the training records are off by, as found in a fit."""
    return calibration_found(solution.model, data.train, solution.values, solution.stderr)


def joint_text(joint: Joint, solution: Solution, data: Dataset) -> str:
    """A joint file with fitted values, standard errors and provenance."""
    labels = tuple(label for label in solution.model.effects if label != HOLD_DELAY)
    table = parameter_table(solution, data)
    fitted = {n: p for n, p in table.items() if n in solution.values}
    told = {n for n, p in fitted.items() if p["stderr"] is not None}
    for n in told & set(solution.tied):
        pairs = {m: round(x, DIGITS) for m, x in solution.tied[n].items() if m in told}
        fitted[n] = {**fitted[n], "correlations": pairs or None}
    whole = replace(joint, effects=labels, virtual_work=solution.model.virtual_work)
    calibration = {
        f"{c.what} of {c.sensor} in {data.train_names[c.run]}": c.as_json()
        for c in calibration_of(solution, data)
    }
    origin = {
        "records": ", ".join(data.train_names),
        "sample_time": min(w.grid.dt for w in data.train),
        "version": VERSION,
    }
    return toml_text(whole, fitted, origin, calibration)
