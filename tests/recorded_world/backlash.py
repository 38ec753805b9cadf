"""A gap that the joint file lists three times too wide, and one further effect hidden: is the gap
found, and is no law of the stiffness claimed in its place?

``python -m tests.recorded_world.backlash --seeds 2 --start 0 --json OUT``

One line per effect below. OUT takes one line per answer; the bench goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from tests.recorded_world import hidden
from tests.recorded_world.campaign import ENTRY, Job, load_entry, time_limit
from tests.recorded_world.scoring import score
from tests.recorded_world.world import TROUBLES, asked, truth, write_case

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

MAKE: Final = "servo50"
"""The make of joint whose file lists a gap."""
STIFFNESS: Final = frozenset(
    {"cubic_stiffness", "piecewise_stiffness", "soft_windup", "hysteresis", "windup"}
)
"""Laws of the transmission that a gap left too wide is taken for."""
WITHIN: Final = 0.10
"""Share of the gap that its estimate may be off."""


@final
@dataclass(frozen=True)
class Seen:
    """One answer: the gap found over the true one, whether the hidden effect is named, which false
    laws of the stiffness and which other wrong names stand unmarked.
    """

    seed: int
    effect: str
    sensors: str
    gap: float
    share: float
    found: bool
    false_stiffness: tuple[str, ...]
    wrong: tuple[str, ...]
    verdict: str
    seconds: float
    error: str = ""

    @property
    def good(self) -> bool:
        """Whether the gap is within its tolerance."""
        return abs(self.share - 1.0) <= WITHIN


def effects() -> tuple[str, ...]:
    """What may be hidden beside a listed gap; the empty name hides nothing."""
    return ("", *(n for n in hidden.LIBRARY if n not in ("backlash", "coulomb", "gravity")))


def _gap(result: Mapping[str, Any]) -> float:
    """The gap of the last model [rad]; not a number where the model has none."""
    values = result["steps"][-1]["parameters"]
    return next(
        (float(p["value"]) for n, p in values.items() if n.partition("@")[0] == "backlash"),
        math.nan,
    )


def ask(seed: int, effect: str, given: str, limit: float) -> Seen | None:
    """Make the case, ask, judge; None where these sensors are not asked to show the effect."""
    job = Job(
        seed,
        given,
        without=TROUBLES,
        names=(effect,) if effect else (),
        kind=None if effect else "none",
        size=1.0,
        make=MAKE,
    )
    case = job.case()
    if not asked(case, given) or (effect and not hidden.fits(effect, case.joint)):
        return None
    true, said = float(case.joint.values["GAP"]), truth(case, given)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        here = write_case(case, Path(folder), given)
        try:
            with time_limit(limit):
                result = load_entry(ENTRY)(
                    [here / "train.csv"], [here / "test.csv"], here / "joint.toml"
                )
        except Exception as error:  # a refusal is the result of its case
            return Seen(
                seed,
                effect,
                given,
                gap=true,
                share=math.nan,
                found=False,
                false_stiffness=(),
                wrong=(),
                verdict="refused",
                seconds=time.process_time() - began,
                error=str(error).splitlines()[0],
            )
    answer = score(said, result)
    unmarked = answer.wrong
    false = tuple(w for w in unmarked if set(w.split("|")) & STIFFNESS)
    return Seen(
        seed,
        effect,
        given,
        gap=true,
        share=_gap(result) / true,
        found=set(answer.hidden) <= set(answer.found),
        false_stiffness=false,
        wrong=tuple(w for w in unmarked if w not in false),
        verdict=answer.verdict,
        seconds=time.process_time() - began,
    )


def table(seen: Iterable[Seen]) -> str:
    """Markdown per effect, with the sums below."""
    rows = list(seen)
    out = [
        "| hidden | answers | gap within 10 % | gap found / true | named | false stiffness law "
        "| other wrong names |",
        "|---|---|---|---|---|---|---|",
    ]
    for effect in dict.fromkeys(s.effect for s in rows):
        own = [s for s in rows if s.effect == effect]
        shares = ", ".join(f"{s.share:.2f}" for s in own)
        false, wrong = (
            "; ".join(x.replace("|", " or ") for s in own for x in getattr(s, field)) or "-"
            for field in ("false_stiffness", "wrong")
        )
        out.append(
            f"| {effect or 'nothing'} | {len(own)} | {sum(s.good for s in own)} | {shares} "
            f"| {sum(s.found for s in own)} | {false} | {wrong} |"
        )
    none = sum(not s.false_stiffness for s in rows)
    out += [
        "",
        f"gap within 10 %: {sum(s.good for s in rows)} of {len(rows)}; no false stiffness law: "
        f"{none} of {len(rows)}; named: {sum(s.found for s in rows)} of {len(rows)}; with another "
        f"wrong name: {sum(bool(s.wrong) for s in rows)}",
    ]
    return "\n".join(out) + "\n"


def load(path: Path | None) -> list[Seen]:
    """Answers of a file, one line each."""
    if path is None or not path.exists():
        return []
    lines = [json.loads(x) for x in path.read_text(encoding="utf-8").splitlines() if x.strip()]
    return [_seen({k: tuple(v) if isinstance(v, list) else v for k, v in x.items()}) for x in lines]


def _seen(fields: dict[str, Any]) -> Seen:
    return Seen(**fields)


def main(argv: list[str] | None = None) -> int:
    """Ask and print."""
    p = argparse.ArgumentParser(prog="python -m tests.recorded_world.backlash", description=__doc__)
    p.add_argument("--seeds", type=int, default=1, help="joints per effect")
    p.add_argument("--start", type=int, default=0, help="first seed")
    p.add_argument("--sensors", nargs="+", choices=("all", "encoders"), default=["all"])
    p.add_argument("--effects", nargs="+", choices=effects(), default=effects())
    p.add_argument("--limit", type=float, default=120.0, help="processor seconds for one answer")
    p.add_argument("--json", type=Path, help="one line per answer; goes on where this file ends")
    options = p.parse_args(argv)
    answers = load(options.json)
    done = {(s.seed, s.effect, s.sensors) for s in answers}
    for seed in range(options.start, options.start + options.seeds):
        for effect in options.effects:
            for given in options.sensors:
                if (seed, effect, given) in done:
                    continue
                seen = ask(seed, effect, given, options.limit)
                if seen is None:
                    continue
                answers.append(seen)
                sys.stderr.write(f"{seen}\n")
                if options.json:
                    with options.json.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(asdict(seen)) + "\n")
    sys.stdout.write(table(answers))
    return 0


if __name__ == "__main__":
    sys.exit(main())
