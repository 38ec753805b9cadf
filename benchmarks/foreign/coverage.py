"""How often 95 % intervals hold the truth where a law rides outside a foreign FMU.

``python -m benchmarks.foreign coverage [--seeds 100] [--first 1] [--only torque_ripple]
[--seconds 8]``

The plant holds a law that its FMU lacks: the law rides outside, and its parameters and all of the
FMU's are fitted together to one record. Every seed is another motion, other noise and another start
of the fit, up to a twentieth from the truth. Printed for each fit: the steps, the time for which
the torque outside is held, the largest error of an output over its noise floor, the processor time
and how far each value is from the truth in its standard errors; at the end, for each law and each
parameter, the share inside 95 % with its own standard error (by seeds: the values of a fit lean on
each other) and the RMS of these distances. Ctrl-C ends it early with what there is.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.file import outside_correction
from irj_fmu.imported.fit import fit
from irj_fmu.imported.port import hold_of
from tests.user_fmus.make import Make, build
from tests.user_fmus.plant import HIDDEN, OWN, TRUTH, foreign, recorded

LAWS: Final = ("quadratic_drag", "torque_ripple", "stribeck")
"""What can ride outside: a torque at the drive."""
SURE: Final = 1.96
OFF: Final = 1.05
"""Largest factor by which a fit starts from the truth: `irj improve` begins with what the restarts
say, a hundredth off."""
OFF_ORDER: Final = 1.001
"""The same of a ripple's order, whose phase at the end of a stroke is the order times 100 rad: with
more than half a turn there a fit ends in another valley, tens of times over the floor. A spectrum
tells it so well."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit every seed, print what is inside."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--only", default="")
    parser.add_argument("--seconds", type=float, default=8.0, help="length of a record")
    given = parser.parse_args(arguments)
    wanted = given.only.split(",") if given.only else LAWS
    found: dict[str, list[dict[str, float]]] = {law: [] for law in wanted}
    with tempfile.TemporaryDirectory() as folder:
        path = build("Elastic", Path(folder), Make(2, ("CoSimulation",), strict=True))
        try:
            for law in wanted:
                for seed in range(given.first, given.first + given.seeds):
                    found[law].append(_fitted(path, law, seed, given.seconds))
        except KeyboardInterrupt:
            print("ended early:")
    found = {law: seeds for law, seeds in found.items() if seeds}
    for law, seeds in found.items():
        _summed(law, seeds)
    _summed("all", [s for seeds in found.values() for s in seeds], short=True)
    return 0


def _fitted(path: Path, law: str, seed: int, seconds: float) -> dict[str, float]:
    """Distances from the truth in standard errors; infinite where a value has none."""
    label, values = HIDDEN[law]
    model = foreign(path)
    truth = {**OWN, **{PREFIX + n: x for n, x in values.items()}}
    width = f"{PREFIX}motor_smoothing_velocity"
    correction = outside_correction([label], model.joint, truth, "here")
    if width in correction.free_values():
        truth[width] = TRUTH[width.removeprefix(PREFIX)]
    rng = np.random.default_rng([seed, 1])
    start = {
        n: x * (OFF_ORDER if n.endswith("_order") else OFF) ** rng.uniform(-1, 1)
        for n, x in truth.items()
    }
    # shapes stay near the values that the law begins with
    correction = outside_correction([label], model.joint, start, "here")
    begun = time.process_time()
    model = replace(model, correction=correction).with_values(start)
    found = fit(model, recorded(law, seconds, seed))
    off = {n: (found.values[n] - truth[n]) / e if (e := found.stderr[n]) else np.inf for n in truth}
    over = max(e.ratio for e in found.train.outputs.values())
    unsettled = "" if found.settled else "!"
    seconds = time.process_time() - begun
    print(
        f"{law:<15}{seed:>4}{found.iterations:>4} steps{unsettled}  "
        f"{1e3 * hold_of(found.model):.3g} ms  {over:.1f} x  {seconds:>4.0f} s  "
        + "  ".join(f"{n.removeprefix(PREFIX)} {x:+.1f}" for n, x in off.items()),
        flush=True,
    )
    return off


def _summed(law: str, seeds: Sequence[Mapping[str, float]], *, short: bool = False) -> None:
    """Share inside, with its error, and RMS, of all values and of each."""

    def line(name: str, each: Sequence[Sequence[float]]) -> str:
        shares = np.array([np.mean(np.abs(x) <= SURE) for x in each])
        known = np.array([x for xs in each for x in xs if np.isfinite(x)])
        error = np.std(shares, ddof=1) / np.sqrt(len(shares)) if len(shares) > 1 else np.nan
        count = sum(abs(x) <= SURE for xs in each for x in xs)
        return (
            f"{law:<15}{name:<28}{count:>5} of {sum(map(len, each)):<5}{100 * shares.mean():>6.1f} "
            f"% +- {100 * error:.1f} %   RMS {np.sqrt(np.mean(known**2)):.2f}"
        )

    print(line(f"{len(seeds)} fits", [list(s.values()) for s in seeds]))
    if not short:
        for name in seeds[0]:
            print(line(name.removeprefix(PREFIX), [[s[name]] for s in seeds]))
