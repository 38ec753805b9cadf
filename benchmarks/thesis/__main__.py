"""Re-enact the thesis's tables and figures on simulated data and write the page.

python -m benchmarks.thesis --out docs/thesis.md     everything: the page and its pictures (some
minutes) python -m benchmarks.thesis --quick                  the sections with tables 4.2 to 4.6,
on the terminal (some 20 s) python -m benchmarks.thesis --only subspace          one module's
sections
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from benchmarks.thesis import failure, friction, offline, online, selection, subspace
from benchmarks.thesis.page import Section

Experiment = Callable[[], Section]

QUICK: Final[tuple[Experiment, ...]] = (
    offline.rigid,
    offline.stiffness,
    offline.excitation,
    friction.time_variant,
)
"""The fast part: tables 4.2 to 4.6."""
WHOLE: Final[tuple[Experiment, ...]] = (
    selection.triangular_section,
    selection.sinusoidal_section,
    subspace.configuration_one,
    subspace.models,
    subspace.failures,
    offline.rigid,
    offline.stiffness,
    offline.excitation,
    online.recursive,
    friction.low_velocity,
    friction.two_step,
    friction.time_variant,
    failure.under_failure,
)
"""All experiments in the order of the thesis."""

HEAD: Final = """# The thesis once more

Tables 4.2 to 4.6 and figures 3.12 to 3.16 and 4.1 to 4.47 of the thesis (A. R. da Silva, INPE-8981-TDI/812/B), re-enacted
with its parameters by

    python -m benchmarks.thesis --out docs/thesis.md

in about five minutes; `--quick` prints the sections with the tables alone. The thesis measured on a test bed, and its data are
not public. **Simulated data stand in for all of them**: joints with the parameters of its tables, motions of its section 3.8,
readings with the noise of its table B.1. So agreement means that the algorithms find what the thesis found where its model
holds; what the real joint did beyond the model cannot come back. "Printed" is the thesis's number; parameters are referred to
the link.
"""

TAIL: Final = """## What could not be reproduced, and why

- **Unstable subspace models of order 3 and more (figure 4.3).** On the simulated joint all orders up to 6 are stable: the thesis's
  order 3 has to follow what a linear model of a real joint lacks.
- **Both link sensors failed at once, thesis's rule (figure 4.13).** At 5 s this sine stands at its end, and (4.6) forms no error under
  its lower bound, here 0.05 rad/s: the velocity sensor is named 1 ms after the joint moves that fast again. The structured residuals
  name both in 7 ms.
- **VAF and error norms of table 4.3 and section 4.3.3.** The thesis's 99.4 to 99.5 % are the real joint's unmodelled part; a joint
  simulated with the model leaves noise only.
- **The good look of model 2a (figures 4.19, 4.20).** The stiffness-only k1 comes out near the printed one, but the fit does not look
  good here: on a motion with clean constant speeds the friction shows.
- **Reading of the tables.** The values called singular values are column norms, see there; so they do not warn of the parallel columns
  of Coulomb and viscous friction on a triangle, which the true singular values show.
- **Table 4.6 from full readings.** In the thesis's own test, a friction torque without the rest of the joint, all five parameters come
  back. From the noisy readings of the whole joint the friction torque comes back, but not always the set of parameters: it has a twin.
- **Alternative 2 with the MOESP model (figures 4.39 to 4.41, 4.45 to 4.47).** Freezing the springs does not help where the torsion
  comes from the order-2 model. With the replacement by model and remaining sensors it holds.
- **Times.** The thesis prints no computing times for these experiments, and the pictures' axes cannot be read to the second; the times
  given here are those of the simulated records.
"""


def page(experiments: Sequence[Experiment], folder: Path | None) -> str:
    """The page's text; pictures are written to `folder`."""
    texts, brief = [], ["| thesis | here |", "|---|---|"]
    for run in experiments:
        start = time.perf_counter()
        section = run()
        name = "thesis" if folder is None else folder.name
        texts.append(section.markdown(name))
        brief += [f"| {what} | {result} |" for what, result in section.brief]
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            for figure in section.figures:
                (folder / f"{figure.stem}.svg").write_text(figure.svg, encoding="utf-8")
        print(f"{section.title}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    return "\n".join(["## In short\n", *brief, "", *texts])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.thesis",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="the page; its pictures go into a folder of the same name beside it",
    )
    parser.add_argument(
        "--quick", action="store_true", help="tables 4.2 to 4.6 only, on the terminal"
    )
    parser.add_argument(
        "--only",
        metavar="WORD",
        help="print the sections whose name holds this word, such as models; with --out FILE "
        "their pictures are written beside it, and FILE is not",
    )
    asked = parser.parse_args(arguments)
    if asked.only:
        chosen = [e for e in WHOLE if asked.only in f"{e.__module__}.{e.__name__}"]
        print(page(chosen, None if asked.out is None else asked.out.with_suffix("")))
        return 0
    if asked.quick:
        print(page(QUICK, None))
        return 0
    if asked.out is None:
        parser.error("give --out FILE or --quick")
    asked.out.write_text(
        f"{HEAD}\n{page(WHOLE, asked.out.with_suffix(''))}\n{TAIL}", encoding="utf-8"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
