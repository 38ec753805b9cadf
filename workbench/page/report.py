"""From the ledger of a session to the result that the report is written from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from casadi_models import EFFECTS
from identification.data.check.gate import gate_warnings
from identification.data.record import Record
from identification.diagnosis.bench import JointBench
from identification.diagnosis.claims import Claim, Ranking, rank
from identification.diagnosis.improve import HOLD_DELAY, Improvement, Step, held_drop, visible_keys
from identification.diagnosis.outcome import key_of
from identification.diagnosis.session import Session
from identification.diagnosis.trials import make_base
from identification.fitting.assess import BalanceError, Error, assess
from identification.fitting.engine import Dataset, Solution, solve
from workbench.page.analysis import Analysis, Progress
from workbench.page.session import StepEntry


def improvement_of(
    analysis: Analysis, entries: Sequence[StepEntry], progress: Progress
) -> Improvement:
    """The session's steps as the result of a loop: with rankings, what is left, and a verdict.

    On the samples that the ledger's last step stands on: windows of long records until it was
    confirmed.

    Parameters
    ----------
    analysis : Analysis
    entries : sequence of StepEntry
        The ledger; a removed effect is left out of the path.
    progress : callable
    """
    train, held = records_of(analysis, entries)
    data = analysis.data if train is analysis.quick[0] else analysis.every_sample(entries[-1])
    data = replace(data, note=analysis.note)
    progress("fitting the steps", 0.1)
    steps = _steps(analysis, data, entries, judged_here=data.train is analysis.data.train)
    progress("ranking the library on the start model", 0.25)
    base = make_base(steps[0].solution, data)
    first = last = rank(
        base, progress=lambda text, share: progress(f"{text}, start model", 0.25 + 0.25 * share)
    )
    if len(steps) > 1:
        progress("ranking the library on the final model", 0.5)
        base = make_base(steps[-1].solution, data)
        last = rank(
            base, progress=lambda text, share: progress(f"{text}, final model", 0.5 + 0.3 * share)
        )
    named = {e.label: e for e in entries if e.action == "add"}
    claims = [
        _claim(before, after, first, named.get(after.label))
        for before, after in zip(steps[:-1], steps[1:], strict=True)
    ]
    session = Session(
        JointBench(analysis.joint, data, train, held), progress, gate_warnings(analysis.records)
    )
    progress("what is missing now", 0.8)
    now = session.diagnose(steps[-1].solution)
    further = next((c for c in now.claims if not c.partial), None)
    following = f"Not added yet: {EFFECTS[further.effects[0]].title}." if further else None
    return session.finish(first, (last, base), steps, claims, following=following)


def records_of(
    analysis: Analysis, entries: Sequence[StepEntry]
) -> tuple[list[Record], list[Record]]:
    """Records of the fit and held-out records that the last step of the ledger stands on."""
    return analysis.split if entries[-1].exact else analysis.quick


def _steps(
    analysis: Analysis, data: Dataset, entries: Sequence[StepEntry], *, judged_here: bool
) -> list[Step]:
    """The entries as steps; errors that were judged on these samples are kept as the page shows
    them.
    """
    if all(e.action != "remove" for e in entries):
        made = [_solved(analysis, data, e.effects, e.virtual_work, e.values) for e in entries]
        return [
            _step(s, data, e.label, e if (e.exact or judged_here) and e.train else None)
            for s, e in zip(made, entries, strict=True)
        ]
    final = entries[-1]
    start = [label for label in entries[0].effects if label in final.effects]
    added = [label for label in final.effects if label not in entries[0].effects]
    known = {k: v for e in entries for k, v in e.values.items()}
    out = []
    for count in range(len(added) + 1):
        solution = _solved(
            analysis, data, (*start, *added[:count]), final.virtual_work, known, iterations=15
        )
        out.append(_step(solution, data, added[count - 1] if count else None, None))
    return out


def _solved(
    analysis: Analysis,
    data: Dataset,
    effects: Sequence[str],
    virtual_work: bool,
    values: Mapping[str, float],
    iterations: int = 2,
) -> Solution:
    model = analysis.model_of([label for label in effects if label != HOLD_DELAY], virtual_work)
    return solve(model, data, start=values, iterations=iterations)


def _step(solution: Solution, data: Dataset, label: str | None, entry: StepEntry | None) -> Step:
    key = key_of(label) if label else None
    train = (
        _error(entry.train) if entry else assess(solution.model, data, data.train, solution.values)
    )
    held = (
        _error(entry.held_out)
        if entry
        else assess(solution.model, data, data.held_out, solution.values)
    )
    return Step(key, visible_keys(solution.model), train, held, solution, label)


def _error(data: Mapping[str, Any]) -> Error:
    balances = {
        b: BalanceError(
            float(e["rms"]),
            float(e["floor"]),
            math.inf if e["ratio"] is None else float(e["ratio"]),
            str(e["unit"]),
        )
        for b, e in data["balances"].items()
    }
    return Error(
        float(data["relative_error_percent"]),
        float(data["fit_percent"]),
        float(data["vaf_percent"]),
        balances,
    )


def _claim(before: Step, after: Step, first: Ranking, entry: StepEntry | None) -> Claim:
    label = after.label or ""
    trial = next((t for t in first.everything if t.candidate.label == label), None)
    drops = {b: held_drop(before.held_out, after.held_out, b) for b in after.held_out.balances}
    balance = trial.balance if trial else max(drops, key=lambda b: drops[b])
    names = entry.names if entry and entry.names else (after.added or label,)
    return Claim(names, label, balance, drops[balance], entry.separate_by if entry else None)
