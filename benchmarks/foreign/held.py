"""A torque that holds from sample to sample, read as one that is measured: what it does to a fit.

``python -m benchmarks.foreign held [--seeds 2]``

The plant of ``names`` as a joint of the library, with a torque sensor. Its drive holds between
samples. It is given as it was commanded, as the mean of two neighbours (its middle at the stamp),
and as a current, whose half sample the fit finds by itself. Printed: how far damping and motor
inertia are from the truth, and the skew of the torque sensor, which is none.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from identification import Joint, Record, fit
from identification.fitting.joint_text import calibration_of
from tests.user_fmus.plant import GEAR, TRUTH, recorded

JOINT = Joint(
    name="elastic",
    gear_ratio=GEAR,
    model_name="hd3",
    effects=("viscous@motor", "coulomb@motor", "gravity", "structural_damping"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    given = parser.parse_args(arguments)
    print(f"{'seed':>4}  {'drive given as':<16}{'damping':>9}{'motor inertia':>15}{'skew':>10}")
    for seed in range(1, given.seeds + 1):
        record = recorded(None, 8.0, seed)
        held = record["motor_torque"]
        middle = np.append(held[0], (held[1:] + held[:-1]) / 2)
        others = {n: record[n] for n in record.channels if n not in ("time", "motor_torque")}
        current = Record.from_channels(record.time, {**others, "motor_current": held}, name="run")
        _row(seed, "held torque", record, JOINT)
        _row(seed, "its middle", record.with_channel("motor_torque", middle), JOINT)
        _row(seed, "current", current, replace(JOINT, torque_per_current=GEAR))
    return 0


def _row(seed: int, word: str, record: Record, joint: Joint) -> None:
    found = fit(joint, record)
    values = found.solution.values
    damping, inertia = (
        100 * (values[n] / TRUTH[n] - 1) for n in ("structural_damping", "motor_inertia")
    )
    skews = [
        c.value
        for c in calibration_of(found.solution, found.data)
        if c.what == "skew" and c.sensor == "link_torque"
    ]
    skew = f"{1e6 * skews[0]:.1f} us" if skews else ""
    print(f"{seed:>4}  {word:<16}{damping:>+7.2f} %{inertia:>+13.3f} %{skew:>10}", flush=True)
