"""A fitted joint as the text of a joint file, with standard errors and provenance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from identification.balance.calibration import Found, calibration_found, nuisances
from identification.balance.dataset import HOLD_DELAY, Dataset
from identification.data.joint_file import Joint, Standing, toml_text
from identification.fitting.assess import BalanceError, assess
from identification.fitting.engine import Solution
from identification.fitting.information import resting
from identification.fitting.parameters import parameter_table
from identification.version import VERSION


def calibration_of(solution: Solution, data: Dataset) -> tuple[Found, ...]:
    """What the sensors of the training records are off by, as found in a fit."""
    return calibration_found(solution.model, data.train, solution.values, solution.stderr)


def standing_of(
    solution: Solution, data: Dataset, left: Mapping[str, BalanceError] | None = None
) -> dict[str, Standing]:
    """What a fit leaves of each balance, and which values rest on it.

    Parameters
    ----------
    solution : Solution
    data : Dataset
        The records of the fit.
    left : mapping of str to BalanceError, optional
        What is left of the training records, as the verdict counts it; by default as a fit does.
        A balance without a noise floor has no ratio and is left out.
    """
    if left is None:
        left = assess(solution.model, data, data.train, solution.values).balances
    nuisance = nuisances(solution.model)
    on = resting(solution, data)
    return {
        b: Standing(e.ratio, tuple(n for n in on.get(b, ()) if n not in nuisance))
        for b, e in left.items()
        if math.isfinite(e.ratio)
    }


def joint_text(
    joint: Joint,
    solution: Solution,
    data: Dataset,
    left: Mapping[str, BalanceError] | None = None,
) -> str:
    """A joint file with fitted values, standard errors, what is left of the balances (see
    :func:`standing_of`) and provenance.
    """
    labels = tuple(label for label in solution.model.effects if label != HOLD_DELAY)
    fitted = {n: p for n, p in parameter_table(solution, data).items() if n in solution.values}
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
    return toml_text(
        whole,
        fitted,
        origin,
        calibration,
        correlation=solution.together,
        standing=standing_of(solution, data, left),
    )
