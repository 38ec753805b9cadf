"""Two-step fit of recorded files: prefilter, derivatives, inverse dynamics of the joint's model.

The balances of `fit` need no derivatives and are the better estimate where all shapes have good
starts; this is the thesis's own way (sections 3.7 and 4.3): every signal through the same low-pass,
derivatives by differences, the shapes searched over their boxes, the rest linear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from casadi_models.term import LINK_INERTIA
from identification.balance.sensing import drive_torque, sense
from identification.data.joint_file import Joint, parse_joint, toml_text
from identification.data.plain_text import from_toml
from identification.data.prepare import THESIS_CUTOFF, filtered, trimmed, with_derivatives
from identification.data.record import Record
from identification.errors import InputError
from identification.two_step.algorithm import JOINT_CHANNELS, TwoStep, TwoStepFit, from_joint
from identification.two_step.varpro_search import Method
from identification.version import VERSION

PER_PERIOD: Final = 10.0
"""Samples kept per period of the filter's cut-off: those between are a line through them."""
DROPPED_PERIODS: Final = 1.0
"""Periods of the cut-off dropped at each end of a stretch, where the filter has no data."""


def fit_records(
    records: Sequence[Record],
    joint: Joint,
    *,
    method: Method = "variable_projection",
    cutoff: float = THESIS_CUTOFF,
) -> TwoStepFit:
    """Fit the joint's model to records by the two-step algorithm.

    Parameters
    ----------
    records : sequence of Record
        With a drive and the positions that the model needs.
    joint : Joint
        With known link inertia where the model is elastic: it fixes the scale of the link's
        equation.
    method : {"variable_projection", "alternating"}
        The second is the thesis's own: least squares and coordinate search in turn.
    cutoff : float
        Of the low-pass [Hz].

    Returns
    -------
    TwoStepFit

    Raises
    ------
    InputError
        Channels that are missing; an elastic model without a link inertia.
    """
    model = joint.model()
    given_values = {n: k.value for n, k in joint.known.items() if k.value is not None}
    names = set(model.parameter_names)
    model = model.with_values({n: v for n, v in given_values.items() if n in names})
    if model.is_elastic and LINK_INERTIA not in model.values:
        raise InputError(
            f"{joint.source or joint.name}: the two-step fit of an elastic joint needs the link "
            "inertia, which sets the scale of the link's equation: give link_inertia in [known]"
        )
    drives, rows = [], []
    for given in records:
        sensing = sense(given, model)
        if not sensing.has_drive:
            raise InputError(f"{given.name}: no drive; the two-step fit needs a current or torque")
        even = given.resampled()
        smooth = with_derivatives(filtered(even, cutoff))
        record = trimmed(smooth, round(DROPPED_PERIODS / (cutoff * even.dt)))
        sides = {
            side: [
                record[f"{side}_{q}"] / (joint.gear_ratio if side == "motor" else 1.0)
                for q in ("position", "velocity", "acceleration")
            ]
            for side in ("motor", "link")
            if record.has(f"{side}_position")
        }
        motor = sides.get("motor", sides.get("link", []))
        table = np.column_stack([*motor, *sides.get("link", motor)])
        kept = slice(None, None, max(1, int(1.0 / (PER_PERIOD * cutoff * even.dt))))
        rows.append(table[kept])
        drives.append(drive_torque(record, joint)[kept])
    signals, drive = np.concatenate(rows), np.concatenate(drives)
    assert signals.shape[1] == len(JOINT_CHANNELS)
    y = np.column_stack([drive, np.zeros(len(drive))]) if model.is_elastic else drive[:, None]
    return TwoStep(from_joint(model, signals), method).fit(y, signals)


def two_step_text(found: TwoStepFit, records: Sequence[Record], joint: Joint) -> str:
    """The joint with the values of a two-step fit, as the text of a joint file.

    Parameters
    ----------
    found : TwoStepFit
    records : sequence of Record
    joint : Joint
        Whose model was fitted.

    Raises
    ------
    InputError
        A value outside its physical bounds: no file could be read back.
    """
    fitted = {}
    for p in joint.model().parameters:
        if p.name in found.values:
            error = found.deviation[p.name]
            sure = math.isfinite(error) and error > 0  # nothing is known of a shape that is held
            fitted[p.name] = {
                "value": float(found.values[p.name]),
                "stderr": float(error) if sure else None,
                "unit": p.unit,
                "side": p.side,
            }
    origin = {
        "records": ", ".join(r.name for r in records),
        "sample_time": min(r.dt for r in records),
        "version": VERSION,
    }
    text = toml_text(joint, fitted, origin)
    parse_joint(from_toml(text, joint.source or joint.name), joint.source or joint.name)
    return text
