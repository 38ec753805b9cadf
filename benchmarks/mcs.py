"""Evaluations and overhead of the multilevel coordinate search on the test set of Jones et al.
(1993).

    python benchmarks/mcs.py                      everything, about 10 s
    python benchmarks/mcs.py --seeds 10           250 shifted boxes per function instead of 25

A function counts as solved at a relative error of 1e-4. Set OMP_NUM_THREADS=1 for times that
compare. The functions are those of D. R. Jones, C. D. Perttunen and B. E. Stuckman, J. Optim.
Theory Appl. 79 (1993) 157-181.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt
from scipy.optimize import direct

from identification.search.mcs import MCSResult, mcs

FloatArray = npt.NDArray[np.float64]
Box = list[tuple[float, float]]

_SHEKEL_PLACES = np.array(
    [
        [4, 4, 4, 4],
        [1, 1, 1, 1],
        [8, 8, 8, 8],
        [6, 6, 6, 6],
        [3, 7, 3, 7],
        [2, 9, 2, 9],
        [5, 5, 3, 3],
        [8, 1, 8, 1],
        [6, 2, 6, 2],
        [7, 3.6, 7, 3.6],
    ]
)
_SHEKEL_WIDTHS = np.array([0.1, 0.2, 0.2, 0.4, 0.4, 0.6, 0.3, 0.7, 0.5, 0.5])
_HARTMAN_WEIGHTS = np.array([1.0, 1.2, 3.0, 3.2])
_HARTMAN3 = np.array([[3, 10, 30], [0.1, 10, 35], [3, 10, 30], [0.1, 10, 35]])
_HARTMAN3_PLACES = 1e-4 * np.array(
    [[3689, 1170, 2673], [4699, 4387, 7470], [1091, 8732, 5547], [381.5, 5743, 8828]]
)
_HARTMAN6 = np.array(
    [
        [10, 3, 17, 3.5, 1.7, 8],
        [0.05, 10, 17, 0.1, 8, 14],
        [3, 3.5, 1.7, 10, 17, 8],
        [17, 8, 0.05, 10, 0.1, 14],
    ]
)
_HARTMAN6_PLACES = 1e-4 * np.array(
    [
        [1312, 1696, 5569, 124, 8283, 5886],
        [2329, 4135, 8307, 3736, 1004, 9991],
        [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ]
)


def shekel(terms: int) -> Callable[[FloatArray], float]:
    """Shekel's function with 5, 7 or 10 terms, n = 4."""
    places, widths = _SHEKEL_PLACES[:terms], _SHEKEL_WIDTHS[:terms]
    return lambda x: -float(np.sum(1.0 / (((x - places) ** 2).sum(axis=1) + widths)))


def hartman(shape: FloatArray, places: FloatArray) -> Callable[[FloatArray], float]:
    """Hartman's function, n = 3 or 6."""
    return lambda x: -float(_HARTMAN_WEIGHTS @ np.exp(-(shape * (x - places) ** 2).sum(axis=1)))


def goldstein_price(x: FloatArray) -> float:
    """Goldstein and Price's function, n = 2."""
    a, b = x.tolist()
    first = 1 + (a + b + 1) ** 2 * (19 - 14 * a + 3 * a * a - 14 * b + 6 * a * b + 3 * b * b)
    second = 30 + (2 * a - 3 * b) ** 2 * (
        18 - 32 * a + 12 * a * a + 48 * b - 36 * a * b + 27 * b * b
    )
    return float(first * second)


def branin(x: FloatArray) -> float:
    """Branin's function, n = 2, three global minima."""
    a, b = x.tolist()
    ellipse = b - 5.1 / (4 * math.pi**2) * a * a + 5 / math.pi * a - 6
    return float(ellipse**2 + 10 * (1 - 1 / (8 * math.pi)) * math.cos(a) + 10)


def six_hump_camel(x: FloatArray) -> float:
    """Six-hump camel function, n = 2, two global minima."""
    a, b = x.tolist()
    return float((4 - 2.1 * a * a + a**4 / 3) * a * a + a * b + (4 * b * b - 4) * b * b)


def shubert(x: FloatArray) -> float:
    """Shubert's function in two coordinates: 760 local minima, 18 of them global."""
    a, b = x.tolist()
    return sum(j * math.cos((j + 1) * a + j) for j in range(1, 6)) * sum(
        j * math.cos((j + 1) * b + j) for j in range(1, 6)
    )


@final
@dataclass(frozen=True)
class Case:
    """A test function with its default box, known minimum, and figures to hold.

    `paper` is the count of Huyer and Neumaier (1999), Table II; `band` and `median` are the largest
    acceptable counts in the default box and as the median over shifted boxes.
    """

    name: str
    fun: Callable[[FloatArray], float]
    box: Box
    minimum: float
    minimisers: tuple[tuple[float, ...], ...]
    paper: int
    band: int
    median: int

    @property
    def target(self) -> float:
        """Value at which the function counts as solved."""
        return self.minimum + 1e-4 * abs(self.minimum)

    def shifted_boxes(self, seed: int, count: int = 25) -> Iterator[Box]:
        """Yield default boxes shifted by up to half their width that keep a global minimiser
        inside.
        """
        rng = np.random.default_rng(seed)
        low, high = np.array(self.box, dtype=float).T
        width = high - low
        while count:
            shift = rng.uniform(-0.5, 0.5, len(width)) * width
            lo, hi = low + shift, high + shift
            margin = 0.01 * width
            if any(bool(np.all((lo + margin < m) & (hi - margin > m))) for m in self.minimisers):
                count -= 1
                yield list(zip(lo.tolist(), hi.tolist(), strict=True))


_SHUBERT_PAIRS = [(a, b) for a in (-7.0835, -0.8003, 5.4829) for b in (-7.7083, -1.4251, 4.8581)]
_H3_AT = (0.114614, 0.555649, 0.852547)
_H6_AT = (0.201690, 0.150011, 0.476874, 0.275332, 0.311652, 0.657300)
_BRANIN_AT = ((-math.pi, 12.275), (math.pi, 2.275), (9.424778, 2.475))
_CAMEL_AT = ((0.089842, -0.712656), (-0.089842, 0.712656))
_SHUBERT_AT = tuple(_SHUBERT_PAIRS + [(b, a) for a, b in _SHUBERT_PAIRS])
_FOUR = ((4.0, 4.0, 4.0, 4.0),)

JONES = (
    Case("S5", shekel(5), [(0, 10)] * 4, -10.153199679, _FOUR, 83, 250, 900),
    Case("S7", shekel(7), [(0, 10)] * 4, -10.402940567, _FOUR, 129, 250, 900),
    Case("S10", shekel(10), [(0, 10)] * 4, -10.536409817, _FOUR, 103, 250, 900),
    Case(
        "H3",
        hartman(_HARTMAN3, _HARTMAN3_PLACES),
        [(0, 1)] * 3,
        -3.862782148,
        (_H3_AT,),
        79,
        250,
        250,
    ),
    Case(
        "H6",
        hartman(_HARTMAN6, _HARTMAN6_PLACES),
        [(0, 1)] * 6,
        -3.322368011,
        (_H6_AT,),
        111,
        200,
        250,
    ),
    Case("GP", goldstein_price, [(-2, 2)] * 2, 3.0, ((0.0, -1.0),), 81, 150, 120),
    Case("BR", branin, [(-5, 10), (0, 15)], 0.397887357730, _BRANIN_AT, 41, 80, 60),
    Case("C6", six_hump_camel, [(-3, 3), (-2, 2)], -1.031628453490, _CAMEL_AT, 42, 80, 60),
    Case("SHU", shubert, [(-10, 10)] * 2, -186.730908831, _SHUBERT_AT, 69, 500, 400),
)

SUM_BAND = 1000
"""Largest acceptable sum over the nine default boxes; the paper's is 738."""


def solve(case: Case, box: Box) -> MCSResult:
    """Search until the function is solved, with up to 12000 evaluations."""
    return mcs(case.fun, box, target=case.target, max_evaluations=12000, stall_sweeps=0)


def count_direct(case: Case, *, locally_biased: bool, cap: int = 20000) -> int | None:
    """Return the evaluations scipy's DIRECT needs for the same accuracy; None where `cap` is
    not enough.
    """
    values: list[float] = []

    def fun(x: FloatArray) -> float:
        values.append(case.fun(x))
        return values[-1]

    direct(
        fun,
        case.box,
        maxfun=cap,
        maxiter=cap,
        locally_biased=locally_biased,
        f_min=case.minimum,
        f_min_rtol=1e-4,
        vol_tol=0.0,
        len_tol=0.0,
    )
    hits = [k for k, value in enumerate(values[:cap]) if value <= case.target]
    return hits[0] + 1 if hits else None


def default_boxes() -> None:
    """Print evaluations in the default boxes beside the paper and DIRECT."""
    print("Default boxes: evaluations to a relative error of 1e-4")
    print(f"{'':6}{'mcs':>8}{'paper':>8}{'band':>8}{'DIRECT':>10}{'DIRECT_L':>10}")
    total = 0
    for case in JONES:
        result = solve(case, case.box)
        total += result.nfev
        hit = "" if result.fun <= case.target else " not solved"
        plain, biased = (
            count_direct(case, locally_biased=flag) or ">20000" for flag in (False, True)
        )
        print(
            f"{case.name:6}{result.nfev:8}{case.paper:8}{case.band:8}{plain:>10}{biased:>10}{hit}"
        )
    print(f"{'sum':6}{total:8}{sum(case.paper for case in JONES):8}{SUM_BAND:8}\n")


def shifted_boxes(seeds: int) -> None:
    """Print solved count and evaluations over shifted boxes."""
    print(f"{25 * seeds} shifted boxes per function, up to 12000 evaluations each")
    print(f"{'':6}{'solved':>8}{'median':>8}{'band':>8}{'mean':>8}{'largest':>8}")
    solved = 0
    for case in JONES:
        results = [solve(case, box) for seed in range(seeds) for box in case.shifted_boxes(seed)]
        counts = [result.nfev for result in results]
        hits = sum(result.fun <= case.target for result in results)
        solved += hits
        print(
            f"{case.name:6}{hits:8}{statistics.median(counts):8.0f}{case.median:8}"
            f"{statistics.mean(counts):8.0f}{max(counts):8}"
        )
    print(f"{'sum':6}{solved:8} of {25 * seeds * len(JONES)}\n")


def overhead() -> None:
    """Print the time of the search itself per evaluation, for default stopping rules and for a
    long search.
    """
    print("Processor time per evaluation outside the objective in us, least of 7 runs")
    print(f"{'':6}{'n':>4}{'evaluations':>14}{'default rules':>16}{'3000 evaluations':>18}")
    for case in JONES:
        usual = [measure_overhead(case, None, None) for _ in range(7)]
        long = [measure_overhead(case, 3000, 0) for _ in range(7)]
        print(
            f"{case.name:6}{len(case.box):4}{usual[0][1]:14}{min(usual)[0]:16.0f}"
            f"{min(long)[0]:18.0f}"
        )


def measure_overhead(
    case: Case, max_evaluations: int | None, stall_sweeps: int | None
) -> tuple[float, int]:
    """Return microseconds per evaluation that are not spent in the objective, and the number of
    evaluations.
    """
    points: list[FloatArray] = []

    def kept(x: FloatArray) -> float:
        points.append(x)
        return case.fun(x)

    begin = time.process_time()
    mcs(kept, case.box, max_evaluations=max_evaluations, stall_sweeps=stall_sweeps)
    searched = time.process_time() - begin
    begin = time.process_time()
    for point in points:
        case.fun(point)
    return 1e6 * (searched - (time.process_time() - begin)) / len(points), len(points)


def main() -> None:
    """Run all parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, default=1, help="seeds of 25 shifted boxes each (default 1)"
    )
    seeds = parser.parse_args().seeds
    default_boxes()
    shifted_boxes(seeds)
    overhead()


if __name__ == "__main__":
    main()
