"""What was stated against what was so: shares, Brier scores, and the page that shows them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar, final

import numpy as np

from identification.fitting.trust import CLASSES

WANTED: Final = (93.0, 97.0)
"""Coverage of a 95 % interval that counts as right [%]: 2 points are what 450 intervals tell."""
TENTHS: Final = 10
"""Classes of the stated chance."""
QUANTILE: Final = 1.96
"""Of the normal law, for an interval of 95 %."""


@final
@dataclass(frozen=True)
class Seen:
    """One interval against the truth.

    Attributes
    ----------
    name, kind, motion : str
        Parameter, its class, and the motion it was fitted on.
    inside : bool
        The interval holds the truth.
    deviate : float
        Error over the stated standard error.
    """

    name: str
    kind: str
    motion: str
    inside: bool
    deviate: float


@final
@dataclass(frozen=True)
class Stated:
    """A name that `improve` claimed.

    Attributes
    ----------
    chance : float
        As it stated it.
    right : bool
    first, alone : bool
        It is the first of its set; the only one.
    """

    chance: float
    right: bool
    first: bool
    alone: bool


Outcome = TypeVar("Outcome", Seen, Stated)


@final
class Kept:
    """Outcomes by what they were run with; in a file of JSON lines, so that a long run can go on.

    Parameters
    ----------
    path : Path or None
        Is read, and every new outcome is added to it; None keeps nothing.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._rows: dict[str, Any] = {}
        if path is not None and path.exists():
            for text in path.read_text(encoding="utf-8").splitlines():
                row = json.loads(text)
                self._rows[_key(row["of"])] = row["found"]

    def found(
        self, of: Mapping[str, Any], kind: type[Outcome], run: Callable[[], list[Outcome]]
    ) -> list[Outcome]:
        """The outcome of one run: from the file, or made now."""
        key = _key(of)
        if key not in self._rows:
            self._rows[key] = [asdict(f) for f in run()]
            if self._path is not None:
                with self._path.open("a", encoding="utf-8") as out:
                    print(json.dumps({"of": dict(of), "found": self._rows[key]}), file=out)
        return [kind(**f) for f in self._rows[key]]


def _key(of: Mapping[str, Any]) -> str:
    return json.dumps(dict(of), sort_keys=True)


def wilson(right: int, count: int) -> tuple[float, float]:
    """95 % interval of a share [%], after Wilson (1927)."""
    if not count:
        return 0.0, 100.0
    z, share = QUANTILE, right / count
    centre = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z * math.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2) / (1 + z**2 / count)
    return 100 * (centre - half), 100 * (centre + half)


def brier(stated: Sequence[Stated]) -> float:
    """Mean square of the stated chance less 1 (right) or 0 (wrong), after Brier (1950)."""
    return float(np.mean([(s.chance - s.right) ** 2 for s in stated])) if stated else math.nan


def skill(stated: Sequence[Stated]) -> float:
    """Brier skill over a constant: 1 less the Brier score over that of the share that is right
    [%]; nan where all or none are right, which leaves nothing to tell apart."""
    share = float(np.mean([s.right for s in stated])) if stated else 0.0
    constant = share * (1 - share)
    return 100 * (1 - brier(stated) / constant) if constant > 0 else math.nan


def tenths(stated: Sequence[Stated]) -> Iterator[tuple[int, list[Stated]]]:
    """Lower end of each tenth of the stated chance that has names [%], and these names."""
    for k in range(TENTHS):
        own = [s for s in stated if min(int(s.chance * TENTHS), TENTHS - 1) == k]
        if own:
            yield 100 * k // TENTHS, own


def page(command: str, conditions: str, seen: Sequence[Seen], stated: Sequence[Stated]) -> str:
    """The reliability page, as Markdown.

    Parameters
    ----------
    command : str
        That prints it.
    conditions : str
        Joints, sizes and disturbances, one sentence or more.
    seen : sequence of Seen
    stated : sequence of Stated
    """
    lines = [
        "# Reliability: are the stated intervals and names true?",
        "",
        "Written by",
        "",
        "```sh",
        command,
        "```",
        "",
        conditions,
    ]
    for title, own in (
        ("One-name answers", [s for s in stated if s.alone]),
        ("First names of all claims", [s for s in stated if s.first]),
        ("All names of all claims", list(stated)),
    ):
        if own:
            lines += ["", f"## {title}", "", *_chances(own)]
    if seen:
        lines += ["", "## 95 % intervals", "", *_intervals(seen)]
    return "\n".join(lines) + "\n"


def _chances(stated: Sequence[Stated]) -> Iterator[str]:
    """Stated chance against frequency."""
    yield "| chance stated | names | mean stated | right | 95 % range of it |"
    yield "|---|---|---|---|---|"
    for low, own in tenths(stated):
        right = sum(s.right for s in own)
        span = wilson(right, len(own))
        mean = 100 * float(np.mean([s.chance for s in own]))
        yield (
            f"| {low} to {low + 100 // TENTHS} % | {len(own)} | {mean:.1f} % | "
            f"{100 * right / len(own):.0f} % | {span[0]:.0f} to {span[1]:.0f} % |"
        )
    right = sum(s.right for s in stated)
    gain = skill(stated)
    yield ""
    yield f"{right} of {len(stated)} are right. Brier score {brier(stated):.3f}; " + (
        "a constant has none to beat, all or none are right."
        if math.isnan(gain)
        else f"skill over a constant {gain:.0f} %."
    )


def _intervals(seen: Sequence[Seen]) -> Iterator[str]:
    """Coverage by class and by parameter."""
    yield (
        "| class or parameter | intervals | hold the truth | 95 % range of it "
        "| error over its standard error |"
    )
    yield "|---|---|---|---|---|"
    outside: list[str] = []
    for kind in CLASSES:
        own = [s for s in seen if s.kind == kind]
        if not own:
            continue
        yield _row(f"**{kind}**", own)
        inside = sum(s.inside for s in own)
        if not WANTED[0] <= 100 * inside / len(own) <= WANTED[1]:
            low, high = wilson(inside, len(own))
            told = low > WANTED[1] or high < WANTED[0]
            outside.append(f"{kind} ({'surely' if told else 'too few to be sure'})")
        for name in sorted({s.name for s in own}):
            yield _row(f"`{name}`", [s for s in own if s.name == name])
    yield ""
    yield (
        "The last column is mean and scatter; 0 and 1 in truth. "
        f"Classes outside {WANTED[0]:.0f} to {WANTED[1]:.0f} %: {', '.join(outside) or 'none'}."
    )


def _row(label: str, seen: Sequence[Seen]) -> str:
    inside = sum(s.inside for s in seen)
    low, high = wilson(inside, len(seen))
    off = np.array([s.deviate for s in seen])
    return (
        f"| {label} | {len(seen)} | {100 * inside / len(seen):.0f} % | {low:.0f} to {high:.0f} % | "
        f"{off.mean():+.2f} ± {off.std():.2f} |"
    )
