"""Effects hidden in a plant whose model is somebody else's FMU: named or not, and how well.

``python -m benchmarks.foreign [--seeds 2] [--only backlash,nothing] [--no-fit]``

The plant is a joint with motor, gear and link; its foreign model is an FMU of the same equations
less what is hidden, in C, without model exchange, without FMU state, its parameters fixed. Training
and held-out records are of different motions. The FMU is fitted by its outputs first (``--no-fit``:
it starts at the true values less what is hidden), then effects are looked for until nothing is left
to name. Printed for each run: how the hidden effect is named, the largest residual over its noise
floor before and after on held-out records, how many parameters of the FMU are within 95 % of the
truth after the last whole fit of the outputs, the processor time and what is named.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from identification.diagnosis.improvement import Improvement
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.diagnose import diagnose
from irj_fmu.imported.fit import UserFit, fit
from irj_fmu.imported.improve import improve
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
                _run(path, hidden, seed, fitted=not given.no_fit)
    return 0


def _run(path: Path, hidden: str, seed: int, *, fitted: bool) -> None:
    key = None if hidden == NOTHING else hidden
    train, held = recorded(key, TRAIN, seed), recorded(key, HELD_OUT, seed + 1000)
    begun = time.process_time()
    inside = ""
    if fitted:
        improved = improve(foreign(path), train, held, max_additions=MOST)
        found = improved.found
        inside = _inside(fit(improved.model, train))
    else:
        found = diagnose(foreign(path), train, held, most=MOST).diagnosis.found
    ratios = [
        max(e.ratio for e in s.held_out.balances.values())
        for s in (found.steps[0], found.steps[-1])
    ]
    claims = "; ".join("/".join(c.effects) for c in found.claims) or found.verdict
    print(
        f"{hidden:<20}{seed:>5}  {judged(found, hidden):<14}{ratios[0]:>8.3g}{ratios[1]:>8.3g}"
        f"{inside:>9}{time.process_time() - begun:>6.0f}  {claims}",
        flush=True,
    )


def _inside(found: UserFit) -> str:
    """Parameters of the FMU that are within 95 % of the truth, of those that have an error."""
    errors = {n: e for n, e in found.stderr.items() if e and not n.startswith(PREFIX)}
    near = [abs(found.values[n] - OWN[n]) <= SURE * e for n, e in errors.items()]
    return f"{sum(near)}/{len(near)}"


if __name__ == "__main__":
    sys.exit(main())
