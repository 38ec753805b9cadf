"""Variants of somebody else's FMU: is the one with what is hidden recommended, or on the front?

``python -m benchmarks.foreign variants [--seeds 1] [--first 1] [--only backlash,nothing]``

Plant, FMU and records are those of ``names``. Printed for each run: whether the variant with the
hidden effect and nothing else is recommended, tied or on the front of error against parameters, its
held-out error and that of the FMU as it is, how many variants were scored, the processor time and
what is recommended.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.foreign.names import HELD_OUT, NOTHING, TRAIN
from irj_fmu.imported.verbs.explore import explore
from tests.user_fmus.make import Make, build
from tests.user_fmus.plant import HIDDEN, foreign, recorded


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--only", default="")
    given = parser.parse_args(arguments)
    wanted = given.only.split(",") if given.only else [NOTHING, *HIDDEN]
    print(
        f"{'hidden':<20}{'seed':>5}  {'its variant is':<14}{'start %':>8}{'its %':>8}{'scored':>8}"
        f"{'s':>6}  recommended"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = build("Elastic", Path(folder), Make(2, ("CoSimulation",), strict=True))
        for seed in range(given.first, given.first + given.seeds):
            for hidden in wanted:
                _run(path, hidden, seed)
    return 0


def _run(path: Path, hidden: str, seed: int) -> None:
    key = None if hidden == NOTHING else hidden
    train, held = recorded(key, TRAIN, seed), recorded(key, HELD_OUT, seed + 1000)
    begun = time.process_time()
    found = explore(foreign(path), train, held).found
    label = HIDDEN[key][0] if key else ""
    added = (label,) if label else ()
    mine = next((v for v in found.variants if v.added == added), None)
    place = (
        "recommended"
        if mine is found.recommended
        else "tied"
        if mine is not None and mine.tied
        else "on the front"
        if mine in found.front
        else "NOT THERE"
    )
    error = "" if mine is None else f"{mine.relative_error_percent:.3g}"
    print(
        f"{hidden:<20}{seed:>5}  {place:<14}{found.start.relative_error_percent:>8.3g}{error:>8}"
        f"{found.screened:>8}{time.process_time() - begun:>6.0f}  {found.recommended.name}",
        flush=True,
    )
