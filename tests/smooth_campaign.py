"""Random smooth laws that are in no library: is any of them given a name, and does a learned curve
do the law's work?

``python -m tests.smooth_campaign --laws 200 --start 0 --json OUT``

One seed is one law on one axis; OUT takes one line per law, and the same command goes on where it
stopped. Seeds from 100000 on are held back: nothing is tuned on them.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification import Joint, Record, improve
from identification.balance.balances import balances_of
from identification.balance.calibration import settled
from identification.balance.dataset import Dataset
from identification.balance.stacked import stack
from identification.balance.weak import WeakRecord
from identification.diagnosis.learned import with_curves
from identification.fitting.engine import Solution, load_dataset, prepared_model, solve
from tests.smooth_laws import COULOMB, FloatArray, Law, nothing, record

SIZES: Final = (0.2, 0.06)
"""RMS of the law outside viscous and Coulomb friction, as shares of the Coulomb friction."""
SECONDS: Final = (40.0, 20.0)
FAMILIES: Final = (
    ("velocity", ("saturating", "rational", "power", "bump", "knee", "wave")),
    ("even", ("saturating", "bump", "knee", "wave")),
    ("position", ("bumps", "step", "knee")),
    ("rubbing", ("bumps", "step", "knee")),
)


@final
@dataclass(frozen=True)
class Outcome:
    """What was said of one law.

    Attributes
    ----------
    seed, variable, family, size
        The law.
    named
        Unmarked claims of one name: every one is wrong.
    others
        Sets of names and names that are marked.
    learned
        Labels of learned curves.
    verdict
        As given.
    error
        Held-out RMS with the answer over that with the true law.
    seconds
        Processor time.
    inside
        As `error`, of the rows within the speeds and positions of the training record: nothing says
        how a curve goes on beyond them.
    """

    seed: int
    variable: str
    family: str
    size: float
    named: tuple[str, ...]
    others: tuple[str, ...]
    learned: tuple[str, ...]
    verdict: str
    error: float
    seconds: float
    inside: float = float("nan")


def _shape(rng: np.random.Generator, family: str, x: FloatArray) -> FloatArray:
    """A curve of a variable from 0 to 1 (speed) or -1 to 1 (position)."""
    reach = float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))
    place = float(rng.uniform(0.2, 0.7)) * float(rng.choice([-1.0, 1.0]) if x.min() < 0 else 1.0)
    if family == "saturating":
        return np.tanh(x / reach)
    if family == "rational":
        return x / (x + reach)
    if family == "power":
        return x ** float(rng.choice([rng.uniform(0.3, 0.7), rng.uniform(1.3, 1.7)]))
    if family == "bump":
        return np.exp(-(((x - place) / (0.5 * reach + 0.05)) ** 2))
    if family == "knee":
        return 0.05 * np.logaddexp(0.0, (x - place) / 0.05)
    if family == "wave":
        return np.sin(2 * np.pi * float(rng.uniform(0.7, 2.0)) * x + rng.uniform(0, 6.28))
    if family == "step":
        return np.tanh((x - place) / (0.3 * reach + 0.05))
    out = np.zeros_like(x)
    for _ in range(3):
        width = float(rng.uniform(0.06, 0.2))
        out += rng.normal() * np.exp(-(((x - rng.uniform(-0.8, 0.8)) / width) ** 2))
    return out


def draw(seed: int) -> tuple[str, str, float, Law]:
    """Variable, family, size and the law itself."""
    rng = np.random.default_rng([seed, 7])
    variable, families = FAMILIES[seed % len(FAMILIES)]
    family = str(rng.choice(families))
    size = float(SIZES[(seed // len(FAMILIES)) % len(SIZES)])
    # the scales come from the first record that is asked for, so that both records have one law
    known: dict[str, float] = {}

    def law(q: FloatArray, v: FloatArray) -> FloatArray:
        own = np.random.default_rng([seed, 8])
        if not known:
            known["v"], known["q"] = float(np.abs(v).max()), float(np.abs(q).max())
        x = np.abs(v) / known["v"] if variable in ("velocity", "even") else q / known["q"]
        torque = _shape(own, family, x)
        if variable in ("velocity", "rubbing"):
            torque = torque * np.sign(v)
        if "size" not in known:
            beside = np.column_stack([v, np.sign(v)])
            left = torque - beside @ np.linalg.lstsq(beside, torque, rcond=None)[0]
            known["size"] = size * COULOMB / max(float(np.sqrt(np.mean(left**2))), 1e-9)
        # a law that friction imitates to a hair is not blown up to a monster
        return np.asarray(min(known["size"], 2.0 * COULOMB) * torque)

    return variable, family, size, law


def _records(seed: int, law: Law) -> list[Record]:
    rng = np.random.default_rng([seed, 9])
    return [record(rng, s, law) for s in SECONDS]


def run(seed: int) -> Outcome:
    """Hide a law, ask, and compare with the axis whose law is known."""
    variable, family, size, law = draw(seed)
    joint = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=("viscous", "coulomb"))
    train, held = _records(seed, law)
    began = time.process_time()
    found = improve(train, joint, [held])
    seconds = time.process_time() - began
    end = with_curves(found.steps[-1].solution, found.learned)
    answer, truth = _left(end, found.data), _left(*without_law(seed, joint))
    inside = _within_training(found.data)
    named = [c for c in found.claims if len(c.effects) == 1 and not c.partial and not c.like]
    others = [c for c in found.claims if c not in named]
    return Outcome(
        seed,
        variable,
        family,
        size,
        tuple(c.effects[0] for c in named),
        tuple(c.like or "|".join(c.effects) + " in part" * c.partial for c in others),
        tuple(c.curve.label for c in found.learned),
        found.verdict,
        _rms(answer) / _rms(truth),
        seconds,
        _rms(answer[inside]) / _rms(truth[inside]),
    )


def without_law(seed: int, joint: Joint) -> tuple[Solution, Dataset]:
    """The axis whose law is known: the same records without it, the base fitted."""
    train, held = _records(seed, nothing)
    model = prepared_model(joint, train)
    data = load_dataset([train], [held], joint, model)
    return solve(model, data), data


def _left(solution: Solution, data: Dataset) -> FloatArray:
    """What a model leaves of the held-out rows."""
    model, records = solution.model, [*data.train, *data.held_out]
    values = settled(model, data.sensing, records, solution.values)
    rows = stack(balances_of(model, data.sensing, wrt=()), data.held_out, values).residual["axis"]
    return np.asarray(rows)


def _within_training(data: Dataset) -> npt.NDArray[np.bool_]:
    """Held-out rows within the speeds and positions of the training rows."""

    def rows(records: Sequence[WeakRecord], name: str) -> FloatArray:
        return np.concatenate([w.average(w.points[name]) for w in records])

    inside = np.ones(len(rows(data.held_out, "motor_velocity")), dtype=np.bool_)
    for name in ("motor_velocity", "motor_position"):
        known, asked = rows(data.train, name), rows(data.held_out, name)
        inside &= (asked >= known.min()) & (asked <= known.max())
    return inside


def _rms(rows: FloatArray) -> float:
    return float(np.sqrt(np.mean(rows**2)))


def load(path: Path | None) -> list[Outcome]:
    """Outcomes of a file."""
    if path is None or not path.exists():
        return []
    rows = [json.loads(x) for x in path.read_text(encoding="utf-8").splitlines()]
    return [
        _outcome({k: tuple(v) if isinstance(v, list) else v for k, v in r.items()}) for r in rows
    ]


def _outcome(fields: dict[str, Any]) -> Outcome:
    return Outcome(**fields)


def table(outcomes: Sequence[Outcome]) -> str:
    """Per variable and size."""
    lines = [
        "| laws | number | one wrong unmarked name | complete with one | marked or in a set "
        "| curve | nothing said | error over true law's, median, 90 %, worst with a curve "
        "| the same within the training record |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    marks = sorted({(o.variable, o.size) for o in outcomes}, key=str)
    groups = [("all", list(outcomes))]
    groups += [
        (f"{v}, {s:g}", [o for o in outcomes if (o.variable, o.size) == (v, s)]) for v, s in marks
    ]
    for name, part in groups:
        wrong = [o for o in part if o.named]
        curved = [o for o in part if o.learned]
        silent = [o for o in part if not (o.named or o.others or o.learned)]
        complete = sum(o.verdict == "complete" for o in wrong)
        others = sum(bool(o.others) for o in part)
        lines.append(
            f"| {name} | {len(part)} | {len(wrong)} | {complete} | {others} | {len(curved)} | "
            f"{len(silent)} | {_spread([o.error for o in curved])} "
            f"| {_spread([o.inside for o in curved])} |"
        )
    return "\n".join(lines) + "\n"


def _spread(errors: Sequence[float]) -> str:
    """Median, 90 % and worst."""
    if not errors:
        return "-"
    return ", ".join(f"{x:.3g}" for x in (*np.quantile(errors, [0.5, 0.9]), max(errors)))


def main(argv: list[str] | None = None) -> int:
    """Run the laws and print the table."""
    p = argparse.ArgumentParser(prog="python -m tests.smooth_campaign", description=__doc__)
    p.add_argument("--laws", type=int, default=200)
    p.add_argument("--start", type=int, default=0, help="first seed (100000 and more: held back)")
    p.add_argument("--json", type=Path)
    p.add_argument("--budget", type=float, default=0.0, help="stop before a new law after [s]")
    options = p.parse_args(argv)
    outcomes = load(options.json)
    done, began = {o.seed for o in outcomes}, time.perf_counter()
    for seed in range(options.start, options.start + options.laws):
        if seed in done:
            continue
        if options.budget and time.perf_counter() - began > options.budget:
            sys.stderr.write("time is up; start again with the same --json to go on\n")
            break
        found = run(seed)
        outcomes.append(found)
        sys.stderr.write(f"{asdict(found)}\n")
        if options.json:
            with options.json.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(found)) + "\n")
    sys.stdout.write(table(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
