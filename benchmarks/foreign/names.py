"""Effects hidden in a plant whose model is somebody else's FMU: named or not, and how well.

``python -m benchmarks.foreign [names] [--seeds 2] [--only backlash,nothing] [--no-fit] [--values]``

The plant is a joint with motor, gear and link; its foreign model is an FMU of the same equations
less what is hidden, in C, without model exchange, without FMU state, its parameters fixed. Training
and held-out records are of different motions. The FMU is fitted by its outputs first (``--no-fit``:
it starts at the true values less what is hidden), then effects are looked for until nothing is left
to name. Printed for each run: how the hidden effect is named, the largest residual over its noise
floor before and after on held-out records, how many parameters of the FMU are within 95 % of the
truth in what the loop hands back, the processor time and what is named; ``--values`` adds how far
each parameter is from the truth, in its standard errors.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from identification.diagnosis.improvement import Improvement
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.diagnose import diagnose
from irj_fmu.imported.improve import UserImprovement, improve
from tests.user_fmus.make import Make, build
from tests.user_fmus.plant import HIDDEN, OWN, foreign, recorded

NOTHING: Final = "nothing"
TRAIN: Final = 16.0
HELD_OUT: Final = 8.0
MOST: Final = 3
SURE: Final = 1.96


def judged(found: Improvement, hidden: str) -> str:
    """How a hidden effect was named."""
    names = [c.effects for c in found.claims]
    if hidden == NOTHING:
        return "clean" if not names else "FALSE"
    right = [n for n in names if hidden in n]
    if not right:
        return "missed" if not names else "WRONG"
    beside = "" if len(names) == 1 else f" + {len(names) - 1}"
    return ("alone" if len(right[0]) == 1 else "in a set") + beside


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--only", default="")
    parser.add_argument("--no-fit", action="store_true")
    parser.add_argument("--values", action="store_true", help="errors in standard errors")
    given = parser.parse_args(arguments)
    wanted = given.only.split(",") if given.only else [NOTHING, *HIDDEN]
    print(
        f"{'hidden':<20}{'seed':>5}  {'named':<14}{'before':>8}{'after':>8}{'in 95 %':>9}{'s':>6}  "
        "claims"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = build("Elastic", Path(folder), Make(2, ("CoSimulation",), strict=True))
        for seed in range(given.first, given.first + given.seeds):
            for hidden in wanted:
                _run(path, hidden, seed, fitted=not given.no_fit, values=given.values)
    return 0


def _run(path: Path, hidden: str, seed: int, *, fitted: bool, values: bool) -> None:
    key = None if hidden == NOTHING else hidden
    train, held = recorded(key, TRAIN, seed), recorded(key, HELD_OUT, seed + 1000)
    begun = time.process_time()
    off: dict[str, float] = {}
    if fitted:
        improved = improve(foreign(path), train, held, max_additions=MOST)
        found = improved.found
        off = _off(improved)
    else:
        found = diagnose(foreign(path), train, held, most=MOST).diagnosis.found
    ratios = [
        max(e.ratio for e in s.held_out.balances.values())
        for s in (found.steps[0], found.steps[-1])
    ]
    claims = "; ".join("/".join(c.effects) for c in found.claims) or found.verdict
    inside = f"{sum(abs(x) <= SURE for x in off.values())}/{len(off)}" if fitted else ""
    print(
        f"{hidden:<20}{seed:>5}  {judged(found, hidden):<14}{ratios[0]:>8.3g}{ratios[1]:>8.3g}"
        f"{inside:>9}{time.process_time() - begun:>6.0f}  {claims}",
        flush=True,
    )
    if values:
        print("    " + "  ".join(f"{n} {x:+.1f}" for n, x in off.items()), flush=True)


def _off(found: UserImprovement) -> dict[str, float]:
    """Errors of the FMU's parameters that have a standard error, in units of it."""
    errors = {n: e for n, e in found.stderr.items() if e and not n.startswith(PREFIX)}
    return {n: (found.model.values[n] - OWN[n]) / e for n, e in errors.items()}
