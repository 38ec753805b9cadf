"""Outputs of somebody else's FMU watched: healthy records silent, wrong sensors named.

``python -m benchmarks.foreign watch [--seeds 5] [--first 1]``

Plant and FMU are those of ``names``, the FMU at its true values; limits come from one healthy
record. For each channel an offset of ten standard deviations of its noise (of the motor's encoder
twenty, of the drive's torque 2 % of its largest) begins in the middle of a record of 8 s. Printed
for each case: how many records gave an alarm that names the channel alone, one that names others
too, none or an alarm about something else, and the median time from the offset to the alarm.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from irj_fmu.imported.verbs.track import Watch
from tests.user_fmus.make import Make, build
from tests.user_fmus.plant import NOISE, OWN, foreign, recorded

SECONDS: Final = 8.0
SIZES: Final = {
    "motor_position": 20 * NOISE["motor_position"],
    "link_position": 10 * NOISE["link_position"],
    "link_torque": 10 * NOISE["link_torque"],
    "motor_torque": None,
}
SHARE: Final = 0.02
"""Of the largest torque of the drive."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    given = parser.parse_args(arguments)
    counts: dict[str, list[tuple[str, float]]] = {"healthy": [], **{c: [] for c in SIZES}}
    with tempfile.TemporaryDirectory() as folder:
        path = build("Elastic", Path(folder), Make(2, ("CoSimulation",), strict=True))
        watch = Watch(foreign(path).with_values(OWN), recorded(None, 12.0, 7000))
        for seed in range(given.first, given.first + given.seeds):
            record = recorded(None, SECONDS, seed)
            for case, found in counts.items():
                if case == "healthy":
                    alarms = watch.run(record).alarms
                    found.append(("FALSE" if alarms else "silent", 0.0))
                    continue
                size = SIZES[case] or SHARE * float(np.max(np.abs(record[case])))
                wrong = record[case] + size * (record.time >= SECONDS / 2)
                alarms = watch.run(record.with_channel(case, wrong)).alarms
                if not alarms:
                    found.append(("missed", 0.0))
                    continue
                names = alarms[0].sensors
                said = "alone" if names == (case,) else "in a set" if case in names else "WRONG"
                found.append((said, alarms[0].first - SECONDS / 2))
    print(f"{'what is wrong':<16}{'records':>8}  {'after':>9}  said")
    for case, found in counts.items():
        words = [w for w, _ in found]
        after = f"{np.median([t for _, t in found]):.3f} s" if case != "healthy" else ""
        told = ", ".join(f"{w} {words.count(w)}" for w in dict.fromkeys(words))
        print(f"{case:<16}{len(found):>8}  {after:>9}  {told}")
    return 0
