"""Is the true structure among the variants, on the front, and recommended?

``python -m benchmarks.explore --joints 20 --start 81000``: joints of the recorded world
(tests/recorded_world) with one, two or three hidden effects in turn, all sensors, its usual
troubles.  A variant is right where every hidden effect is in it, or in the model under the name of
what takes it up, and nothing else that is not true of the joint.

``python -m benchmarks.explore --planted emps``: effects planted one at a time on recordings of a
real axis (tests/recorded_world/planted.py).  Beside a planted effect what is recommended on the
plain recordings is no mistake.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, final

from identification import InputError, explore, load_joint, read
from identification.balance.calibration import calibration_found
from identification.balance.dataset import Dataset
from identification.variants.exploration import Exploration, Variant
from tests.recorded_world.planted import FILES, NEW, RIGS, plant, write
from tests.recorded_world.scoring import SAME, taken_up
from tests.recorded_world.world import asked, make_case, truth, write_case

SENSORS: Final = "all"
KINDS: Final = ("single", "pair", "triple")
"""Of the joints, in turn."""
MOST_TIED: Final = 3
"""Variants, the recommended one among them, up to which a tie says something."""
ORDER_SLACK: Final = 0.05
"""Share by which the order of a periodic effect may be off and be the same line."""
MOST_DRAWN: Final = 3
"""Joints that are drawn at most for each one that these sensors are asked to show."""


@final
@dataclass(frozen=True)
class Found:
    """What the variants of one joint were.

    Attributes
    ----------
    seed : int
    case : str
        Make, motion, hidden effects and their size.
    hidden : int
        Number of hidden effects.
    fitted, front, tied, recommended : bool
        A right variant is among those that were fitted, on the front, in the tie, recommended.
    ties : int
        Variants in the tie, the recommended one among them.
    recalled : int
        Hidden effects in the recommended variant.
    improve : bool
        What `improve` ends with is right.
    told : str
        How `explore` and `improve` stand to each other, in one word: same, set, tied, said.
    added : str
        What the recommended variant adds.
    agreement : str
        The sentence about `improve`.
    seconds : float
        Processor time.
    """

    seed: int
    case: str
    hidden: int
    fitted: bool = False
    front: bool = False
    tied: bool = False
    recommended: bool = False
    ties: int = 0
    recalled: int = 0
    improve: bool = False
    told: str = ""
    added: str = ""
    agreement: str = ""
    seconds: float = 0.0


def hidden_in(variant: Variant, said: Mapping[str, Any]) -> set[str]:
    """Hidden effects that a variant has; one with another period is another effect."""
    keys = _keys(variant, said)
    return {n for n in said["hidden"] if keys & ({n} | SAME.get(n, frozenset()))}


def right(variant: Variant, said: Mapping[str, Any], data: Dataset) -> bool:
    """Whether a variant, fitted to some records, is the true structure."""
    elsewhere = _elsewhere(variant, said, data)
    true = set(said["neutral"]) | elsewhere
    for n in said["hidden"]:
        true |= {n} | SAME.get(n, frozenset())
    missing = set(said["hidden"]) - hidden_in(variant, said) - elsewhere
    return not missing and not variant.dropped and _keys(variant, said) <= true


def _elsewhere(variant: Variant, said: Mapping[str, Any], data: Dataset) -> set[str]:
    """Hidden laws that a variant has under another name."""
    fit = variant.solution
    found = calibration_found(fit.model, data.train, fit.values, fit.stderr)
    return taken_up(said, [c.as_json() for c in found])


def _keys(variant: Variant, said: Mapping[str, Any]) -> set[str]:
    """Keys of what a variant adds; a periodic effect of another order is marked as such."""
    model, values = variant.solution.model, variant.solution.values
    found = set()
    for term in model.terms:
        if term.label not in variant.added:
            continue
        key, order = term.effect.key, said["orders"].get(term.effect.key)
        shapes = [values[n] for n in term.names if "order" in n]
        other = order and shapes and not any(abs(x - order) <= ORDER_SLACK * order for x in shapes)
        found.add(f"{key} of another order" if other else key)
    return found


def one_joint(seed: int, kind: str, size: float) -> Found | None:
    """Explore one joint; None where these sensors are not asked to show what is hidden."""
    case = make_case(seed, kind=kind, size=size)
    if not asked(case, SENSORS):
        return None
    said: dict[str, Any] = dict(truth(case, SENSORS))
    name = f"{said['make']} {said['motion']}: {'+'.join(said['hidden'])} x {size:g}"
    with tempfile.TemporaryDirectory() as top:
        folder = write_case(case, Path(top), SENSORS)
        joint = load_joint(folder / "joint.toml")
        train, held = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
        began = time.process_time()
        try:
            found = explore(train, joint, held)
        except InputError as error:
            return Found(seed, name, len(said["hidden"]), agreement=f"REFUSED {error}")
    return judged(found, said, name, time.process_time() - began)


def judged(found: Exploration, said: Mapping[str, Any], name: str, seconds: float) -> Found:
    """Hold an exploration against the truth."""
    best, improved = found.recommended, found.improved
    is_right = partial(right, said=said, data=found.data)
    has = hidden_in(best, said) | _elsewhere(best, said, found.data) & set(said["hidden"])
    return Found(
        seed=int(said["seed"]),
        case=name,
        hidden=len(said["hidden"]),
        fitted=any(map(is_right, found.variants)),
        front=any(map(is_right, found.front)),
        tied=any(map(is_right, found.ties)),
        recommended=is_right(best),
        ties=len(found.ties),
        recalled=len(has),
        improve=improved is not None and is_right(improved),
        told=_told(found.agreement),
        added=" ".join(best.added) or "nothing",
        agreement=found.agreement,
        seconds=seconds,
    )


def _told(sentence: str) -> str:
    """The sentence about `improve` in one word."""
    ends = {": the same.": "same", "no contradiction.": "set", "recommended here.": "tied"}
    return next((word for end, word in ends.items() if sentence.endswith(end)), "said")


def on_rig(name: str, told: Callable[[str], None]) -> list[Found]:
    """Explore recordings of a real axis, each time with one effect planted."""
    rig, file = RIGS[name], FILES / f"{name}.toml"
    joint = load_joint(file)
    usual: frozenset[str] = frozenset()
    out: list[Found] = []
    for effect in ("", *(e for e in NEW if not NEW[e][1] & set(joint.effects))):
        law, right_names = NEW[effect] if effect else (None, frozenset[str]())
        with tempfile.TemporaryDirectory() as top:
            records = []
            for tables, role in zip(rig.load(), ("train", "held"), strict=True):
                made = [plant(rig, t, law, 1.0) for t in tables] if law else tables
                paths = write(made, Path(top), role)
                records.append([read(path, joint=joint) for path in paths])
            began = time.process_time()
            found = explore(records[0], joint, records[1])
        if not effect:
            usual = frozenset(_bare(found.recommended))
            told(f"{name} as recorded: {' '.join(found.recommended.added) or 'nothing'}")
            continue
        is_right = partial(_right_on_rig, right_names=right_names, usual=usual)
        best, improved = found.recommended, found.improved
        out.append(
            Found(
                seed=len(out),
                case=f"{name}: {effect}",
                hidden=1,
                fitted=any(map(is_right, found.variants)),
                front=any(map(is_right, found.front)),
                tied=any(map(is_right, found.ties)),
                recommended=is_right(best),
                ties=len(found.ties),
                recalled=int(bool(_bare(best) & right_names)),
                improve=improved is not None and is_right(improved),
                told=_told(found.agreement),
                added=" ".join(best.added) or "nothing",
                agreement=found.agreement,
                seconds=time.process_time() - began,
            )
        )
        told(line(out[-1]))
    return out


def _bare(variant: Variant) -> set[str]:
    """Keys of what a variant adds."""
    terms = variant.solution.model.terms
    return {t.effect.key for t in terms if t.label in variant.added}


def _right_on_rig(variant: Variant, right_names: frozenset[str], usual: frozenset[str]) -> bool:
    keys = _bare(variant)
    return bool(keys & right_names) and keys <= right_names | usual and not variant.dropped


def line(found: Found) -> str:
    """One joint, for the progress."""
    marks = {
        "fitted": found.fitted,
        "front": found.front,
        "tie": found.tied,
        "recommended": found.recommended,
        "improve": found.improve,
    }
    true = ", ".join(n for n, yes in marks.items() if yes) or "nothing"
    return (
        f"{found.seed} {found.case}: right: {true}; {found.ties} tied; {found.added}; "
        f"{found.agreement} ({found.seconds:.0f} s)"
    )


def structures(
    joints: int, start: int, size: float, keep: Path | None, told: Callable[[str], None]
) -> list[Found]:
    """All joints; what stands in `keep` already is not run again."""
    done: dict[int, dict[str, Any] | None] = {}
    if keep is not None and keep.exists():
        rows = [json.loads(x) for x in keep.read_text(encoding="utf-8").splitlines()]
        done = {r["seed"]: r["found"] for r in rows}
    out: list[Found] = []
    for seed in range(start, start + MOST_DRAWN * joints):
        if len(out) == joints:
            break
        if seed not in done:
            found = one_joint(seed, KINDS[len(out) % len(KINDS)], size)
            done[seed] = None if found is None else asdict(found)
            if keep is not None:
                with keep.open("a", encoding="utf-8") as file:
                    print(json.dumps({"seed": seed, "found": done[seed]}), file=file)
        row = done[seed]
        if row is not None:
            out.append(Found(**row))
            told(line(out[-1]))
    return out


def table(found: Sequence[Found]) -> str:
    """All joints, and those of each number of hidden effects, as Markdown."""
    head = [
        "joints",
        "right one fitted",
        "on the front",
        "recommended",
        f"recommended or in a tie of at most {MOST_TIED}",
        "hidden effects in the recommended one",
        "`improve` right",
        "`improve`: same / in a set / tied / difference said",
        "largest tie",
        "seconds",
    ]
    rows = [f"| {' | '.join(head)} |", "|---" * len(head) + "|", _row("all", found)]
    for number, kind in enumerate(KINDS, 1):
        own = [f for f in found if f.hidden == number]
        if own:
            rows.append(_row(kind, own))
    return "\n".join(rows)


def _row(label: str, found: Sequence[Found]) -> str:
    def share(yes: Iterable[bool]) -> str:
        return f"{sum(yes)} of {len(found)}"

    words = [f.told for f in found]
    cells = [
        f"{label}: {len(found)}",
        share(f.fitted for f in found),
        share(f.front for f in found),
        share(f.recommended for f in found),
        share(f.recommended or (f.tied and f.ties <= MOST_TIED) for f in found),
        f"{sum(f.recalled for f in found)} of {sum(f.hidden for f in found)}",
        share(f.improve for f in found),
        " / ".join(str(words.count(w)) for w in ("same", "set", "tied", "said")),
        str(max(f.ties for f in found)),
        f"{sum(f.seconds for f in found) / len(found):.0f}",
    ]
    return f"| {' | '.join(cells)} |"
