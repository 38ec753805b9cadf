"""Does the proposed run tell names apart?  ``python -m benchmarks.next_run --joints 3``.

Joints of the independent generator (tests/hidden_effect) with one short, narrow and slow record, on
which the names of a set tie.  The run that `irj next` proposes and a random feasible one of the
same length are recorded on the same joint; every name is fitted again to both records together.
Printed: who is the one right name before and after, and how the expected log-likelihood difference
follows the one that came out.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification import Joint, Record, improve
from identification.balance.dataset import Dataset
from identification.data.joint_file import Known
from identification.fitting.engine import load_dataset, prepared_model, solve
from identification.naming.contest import Contest, Rival, from_every_valley, rivals_of
from identification.naming.odds import unmodelled_by
from identification.planning.next_run import worth
from identification.planning.rivals import Foreseen, enough
from identification.planning.runs import (
    SIMULATED,
    Plant,
    Run,
    candidate_runs,
    possible_loads,
    predicted,
    workspace_of,
)
from identification.planning.trajectories import Limits
from tests.hidden_effect.generator import COLUMNS, DT, KM, simulate_case

FloatArray = npt.NDArray[np.float64]

SETS: Final[Mapping[str, tuple[str, tuple[str, ...], float]]] = MappingProxyType(
    {
        "gain": (
            "motor",
            ("motor_constant_error", "cyclic_torque", "added_spring", "torque_sensor_gain"),
            2.0,
        ),
        "viscous": ("motor", ("quadratic_drag", "cubic_viscous"), 0.0),
        "gap": ("transmission", ("backlash", "piecewise_stiffness", "soft_windup"), 1.0),
        "load": ("motor", ("load_dependent_friction", "cyclic_friction"), 0.0),
    }
)
"""Names that often tie: the balance in which they show, the names, and the noise of drive and
torque sensor beyond the generator's [N.m].  With its fine sensors any record tells a gain or the
laws of a gap apart."""
OLD: Final = Run("multisine", 0.6, 0.3, 0.35)
"""The record on which they tie: narrow and slow, on one side of upright."""
CROSSING: Final = Run("multisine", 0.0, 0.3, 0.35)
"""The same about upright, for laws that act where the torque goes through zero: on the other record
nothing of them is seen, and their fits say nothing."""
SPAN: Final = 10.0
"""Its length [s]."""
SECONDS: Final = 15.0
"""Length of the proposed run and of the random one [s]."""
MOST_DRAWN: Final = 4
"""Joints that are drawn at most for each one whose names tie."""
MAY: Final = Limits(position=float(np.radians(70.0)), speed=float(np.radians(60.0)), torque=250.0)
"""What the joints may do [rad, rad/s, N.m]: the reach and the torque of the generator's records."""


@final
@dataclass(frozen=True)
class Outcome:
    """What one run gave.

    Attributes
    ----------
    expected, found : float
        Log-likelihood of the truth over its closest rival, on both records [nats].
    one : bool
        The truth is the one name left.
    in_set : bool
        It is among the names left.
    """

    expected: float
    found: float
    one: bool
    in_set: bool


def record_of(
    table: FloatArray, name: str, payload: str, *, noise: float = 0.0, per_ampere: float = 1.0
) -> Record:
    """A record of the generator's columns, with more noise of the torques on request."""
    rng = np.random.default_rng(len(name))
    count = len(table)
    column = dict(zip(COLUMNS, table.T, strict=True))
    channels = {
        "motor_current": column["motor_current_A"]
        + noise / abs(per_ampere) * rng.standard_normal(count),
        "motor_position": column["motor_position_rad"],
        "link_position": column["link_position_rad"],
        "link_torque": column["link_torque_Nm"] + noise * rng.standard_normal(count),
    }
    made = Record.from_channels(column["time_s"] - column["time_s"][0], channels, name=name)
    return replace(made, payload=payload)


def fitted(names: Sequence[str], balance: str, model: JointModel, data: Dataset) -> Contest | None:
    """Names of a set fitted whole, as `irj next` does; None where no name helps."""
    bare = solve(model, data)
    rivals = rivals_of(names, balance, bare, data)
    return Contest(from_every_valley(rivals, bare, data), data) if rivals else None


def alive(contest: Contest | None, balance: str) -> tuple[Rival, ...]:
    """Names that `improve` would leave."""
    if contest is None:
        return ()
    return contest.alive(unmodelled_by(contest, balance))


def judged(contest: Contest | None, balance: str, truth: str) -> tuple[float, bool, bool]:
    """Log-likelihood of the truth over its closest rival; whether it is the one name left; whether
    it is left."""
    names = [r.name for r in contest.rivals] if contest else []
    likelihood = dict(zip(names, contest.likelihood, strict=True)) if contest else {}
    if truth not in likelihood:
        return -np.inf, False, False
    # a name that does not help at all on both records has no fit: the truth is alone
    others = [v for n, v in likelihood.items() if n != truth]
    found = likelihood[truth] - max(others, default=-np.inf)
    left = [r.name for r in alive(contest, balance)]
    return float(found), left == [truth], truth in left


def one_joint(
    which: str, truth: str, seed: int, size: float = 1.0
) -> list[tuple[str, Outcome, Run]]:
    """Before, after the proposed run, after a random one; empty where no names tie."""
    balance, names, noise = SETS[which]
    narrow = (CROSSING if balance == "transmission" else OLD).motion(SPAN, DT)
    given = {"old": (narrow.position, narrow.velocity)}
    case = simulate_case(truth, seed, size=size, references=given)
    joint = Joint(
        name=truth,
        gear_ratio=case.gear_ratio,
        torque_per_current=case.gear_ratio * KM,
        model_name="hd3",
        effects=("viscous", "coulomb", "gravity"),
        # of the catalogue: else motor constant and torque-sensor gain are one column
        known={"motor_inertia": Known(case.parameters["JM"])},
    )
    more = {"noise": noise, "per_ampere": case.gear_ratio * KM}
    old = record_of(case.measured["old"], "old", "same", **more)
    model = prepared_model(joint, old)
    data = load_dataset([old], [], joint, model)
    rivals = list(alive(fitted(names, balance, model, data), balance))
    if len(rivals) < 2 or truth not in {r.name for r in rivals}:
        return []
    contest = Contest(rivals, data)
    foreseen = Foreseen(contest)
    space = workspace_of(data, MAY)
    plant = Plant(contest.leader.solution.model, DT)
    scored = []
    for run in candidate_runs(space, possible_loads(model, data)):
        followed = plant.run(run)
        if followed is not None and not space.broken(followed):
            apart = foreseen.distances(predicted(followed, run, data)) * SECONDS / SIMULATED
            scored.append((worth(apart), run, apart))
    scored.sort(key=lambda s: -s[0])
    found, one, within = judged(contest, balance, truth)
    out = [("before", Outcome(found, found, one, within), scored[0][1])]
    other = np.random.default_rng(seed).integers(1, len(scored))
    for kind, (_, run, apart) in (("proposed", scored[0]), ("random", scored[int(other)])):
        motion = run.motion(SECONDS, DT)
        loaded = (
            {"TG": run.load * case.parameters["TG"]}
            | {"JL": max(run.load, 0.5) * case.parameters["JL"]}
            if run.load < 1
            else {}
        )
        new = simulate_case(
            truth,
            seed,
            size=size,
            overrides=loaded,
            references={kind: (motion.position, motion.velocity)},
        )
        fresh = record_of(new.measured[kind], kind, "same" if run.load == 1 else "none", **more)
        both = load_dataset([old, fresh], [], joint, model)
        tied = [r.name for r in rivals]
        left = rivals_of(tied, balance, solve(model, both), both)
        after, one, within = (
            judged(Contest(left, both), balance, truth) if left else (-np.inf, False, False)
        )
        expected = _expected(contest, truth, apart)
        out.append((kind, Outcome(expected, after, one, within), run))
    return out


def _expected(contest: Contest, truth: str, apart: FloatArray) -> float:
    """Old difference and new one, of the truth over its closest rival."""
    names = [r.name for r in contest.rivals]
    if truth not in names:
        return float("nan")
    i = names.index(truth)
    gains = contest.likelihood[i] - contest.likelihood + apart[i]
    return float(np.delete(gains, i).min())


def rank_correlation(one: Sequence[float], other: Sequence[float]) -> float:
    """Spearman's."""
    first, second = (np.argsort(np.argsort(values)) for values in (one, other))
    return float(np.corrcoef(first, second)[0, 1])


def sets_of_improve(count: int, start: int, *, dirt: bool) -> None:
    """Sets that the trials of `improve` make, and what its whole fits leave of them."""
    effects = tuple(dict.fromkeys(n for _, names, _ in SETS.values() for n in names))
    before = after = kept = sets = 0
    for k in range(count):
        truth = effects[k % len(effects)]
        case = simulate_case(truth, start + k, dirt=dirt)
        records = [record_of(table, name, "same") for name, table in case.measured.items()]
        joint = Joint(
            name=truth,
            gear_ratio=case.gear_ratio,
            torque_per_current=case.gear_ratio * KM,
            model_name="hd3",
            effects=("viscous", "coulomb", "gravity"),
        )
        found = improve(records[:2], joint, records[2:])
        for claim in found.claims:
            first = next((c for c in found.decided if claim.effects[0] in c.effects), claim)
            if len(first.effects) < 2:
                continue
            sets, before, after = sets + 1, before + len(first.effects), after + len(claim.effects)
            kept += truth in claim.effects
            print(
                f"{truth:<25} {', '.join(first.effects)} -> {', '.join(claim.effects)}", flush=True
            )
    print(
        f"{sets} sets on {count} joints: {before} names, {after} after whole fits, truth left in "
        f"{kept}"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table and the rank correlation."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--joints", type=int, default=3, help="joints of each set")
    parser.add_argument("--start", type=int, default=8000, help="first seed")
    parser.add_argument("--size", type=float, default=1.0, help="factor on the hidden effects")
    parser.add_argument("--sets", nargs="*", choices=list(SETS), default=list(SETS))
    parser.add_argument(
        "--claims", type=int, default=0, help="instead: joints on which `improve` claims sets"
    )
    parser.add_argument("--dirt", action="store_true", help="with --claims: small disturbances")
    given = parser.parse_args(argv)
    if given.claims:
        sets_of_improve(given.claims, given.start, dirt=given.dirt)
        return 0
    print("set       truth                     run       expected     found  one right name")
    expected: list[float] = []
    found: list[float] = []
    counts = dict.fromkeys(("before", "proposed", "random"), 0)
    inside = dict.fromkeys(counts, 0)
    better, joints = 0, 0
    for which in given.sets:
        names = SETS[which][1]
        drawn = done = 0
        while done < given.joints and drawn < MOST_DRAWN * given.joints:
            truth = names[drawn % len(names)]
            results = one_joint(which, truth, given.start + drawn, given.size)
            drawn += 1
            if not results:
                continue
            done += 1
            joints += 1
            for kind, outcome, run in results:
                counts[kind] += outcome.one
                inside[kind] += outcome.in_set
                if kind != "before":
                    expected.append(outcome.expected)
                    found.append(outcome.found)
                where = f"{run.family}, load {run.load:g}" if kind != "before" else ""
                print(
                    f"{which:<9} {truth:<25} {kind:<9} {outcome.expected:9.1f} "
                    f"{outcome.found:9.1f}  {'yes' if outcome.one else 'no':<4} {where}",
                    flush=True,
                )
            better += results[1][1].found > results[2][1].found
        print(f"{which}: {done} of {drawn} joints tie on the short record")
    print(
        f"one right name: before {counts['before']}, proposed {counts['proposed']}, random "
        f"{counts['random']} of {joints}; truth left: {inside['before']}, {inside['proposed']}, "
        f"{inside['random']}"
    )
    print(f"proposed better than random in {better} of {joints}")
    kept = np.isfinite(expected) & np.isfinite(found)
    rank = rank_correlation(np.array(expected)[kept].tolist(), np.array(found)[kept].tolist())
    print(
        f"expected against found: rank correlation {rank:.2f} over {int(kept.sum())} runs; enough: "
        f"{enough():.1f} nats"
    )
    return 0
