"""The loop in memory: records prepared once, then each click adds or removes an effect and fits
again.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, JointModel
from identification.balance.balances import Balances
from identification.balance.dataset import with_effect, without
from identification.data.check.gate import gate_warnings, gated
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.bench import JointBench
from identification.diagnosis.diagnose import Diagnosis
from identification.diagnosis.improve import HOLD_DELAY, ranked_json
from identification.diagnosis.outcome import key_of
from identification.diagnosis.places import Rows, gather, places_of, worst_window
from identification.diagnosis.session import Session, timed_bench, with_held_out
from identification.diagnosis.trials import Trial
from identification.errors import InputError
from identification.fitting.assess import Error, assess, over_noise
from identification.fitting.dataset import dataset_of
from identification.fitting.engine import (
    Dataset,
    Solution,
    prepared_model,
    references,
    solve,
    stack,
    taking_part,
)
from identification.fitting.joint_text import joint_text
from identification.fitting.parameters import parameter_table
from workbench.page.desk.curves import kept_curves
from workbench.page.first import first_look
from workbench.page.records import thinned
from workbench.page.session import StepEntry
from workbench.show.chart import WIDTH
from workbench.show.pictures import place_chart
from workbench.show.words import headline, title_of

FloatArray = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]

QUICK_TRAIN: Final = 60.0
QUICK_HELD_OUT: Final = 30.0
"""Seconds of record that a click fits and judges at once; longer records are taken in windows
[s].
"""
SHOWN_WINDOW: Final = 2.0
"""Length of the window that the time plot opens with [s]."""
USUAL_RATE: Final = 1000.0
"""Records of fewer samples than the seconds above have at this rate are short, however long
they last [1/s].
"""


def clean(value: Any) -> Any:
    """Data for JSON: NaN and infinity become None, arrays become lists."""
    if isinstance(value, Mapping):
        return {str(k): clean(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, frozenset, set)):
        return [clean(v) for v in value]
    if isinstance(value, np.ndarray):
        return clean(value.tolist())
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


@final
@dataclass(frozen=True)
class Fitted:
    """A fitted model as another process can take it: without the symbols of its equations.

    Attributes
    ----------
    solution : mapping
        Attributes of the `Solution`, all but the model.
    own : mapping
        Values of the model.
    """

    solution: Mapping[str, Any]
    own: Mapping[str, float]


@final
class Analysis:
    """Records and joint of a session, prepared; holds the current solution and the tried
    candidates.

    Parameters
    ----------
    joint : Joint
    train, held_out : sequence of Record
        Without held-out records the last part of each training record is held out.

    Raises
    ------
    InputError
        Records that do not carry the model.
    """

    def __init__(self, joint: Joint, train: Sequence[Record], held_out: Sequence[Record]) -> None:
        if not train:
            raise InputError("no record to fit: load one, or set the role of one to fit")
        self.joint = joint
        whole, held, self.note = with_held_out(gated(train, joint), gated(held_out, joint))
        self.records = (*whole, *held)
        self._train, self._held = whole, held
        quick_train, quick_held = _share(whole, QUICK_TRAIN), _share(held, QUICK_HELD_OUT)
        self._quick = quick_train, quick_held
        self.whole = quick_train is whole and quick_held is held
        if not self.whole:
            seconds = sum(r.duration for r in (*quick_train, *quick_held))
            total = sum(r.duration for r in self.records)
            part = (
                f"fitted and judged on {seconds:.0f} s of the {total:.0f} s of record, in "
                "windows spread over it; Confirm takes every sample"
            )
            self.note = f"{self.note}; {part}" if self.note else part
        self.start_model = prepared_model(joint, whole[0])
        self.bench = timed_bench(joint, quick_train, quick_held)
        self.data = self.bench.data
        self.solution: Solution | None = None
        self.trials: dict[str, Trial] = {}
        self._rows: Rows | None = None
        self._assessed: tuple[Solution, Dataset, Error] | None = None
        self._solved: dict[str, Solution] = {}
        self._prepared: dict[str, tuple[Solution, Solution, StepEntry]] = {}

    @property
    def split(self) -> tuple[list[Record], list[Record]]:
        """Records of the fit and held-out records, every sample of them."""
        return self._train, self._held

    @property
    def quick(self) -> tuple[list[Record], list[Record]]:
        """Records of the fit and held-out records as the clicks take them: windows of long ones."""
        return self._quick

    # --- models -----------------------------------------------------------------------------------

    def model_of(self, effects: Sequence[str], virtual_work: bool) -> JointModel:
        """The model with these labels, in the form that the records carry."""
        labels = tuple(label for label in effects if label != HOLD_DELAY)
        return prepared_model(
            replace(self.joint, model_name="hd1", effects=labels, virtual_work=virtual_work),
            self._train[0],
        )

    def restore(self, step: StepEntry) -> None:
        """Make the solution of a step of the ledger current again."""
        self.solution, self.trials = self.solution_of(step), {}

    def solution_of(self, step: StepEntry) -> Solution:
        """The fitted model of a step of the ledger."""
        known = self._solved.get(_mark(step))
        if known is None:
            model = self.model_of(step.effects, step.virtual_work)
            known = solve(model, self.data, start=step.values, iterations=1)
            self._solved[_mark(step)] = known
        return known

    def begin(self) -> None:
        """Stand before any fit."""
        self.solution, self.trials = None, {}

    def stands_on(self, step: StepEntry) -> bool:
        """Whether the current solution is that of a step of the ledger."""
        return self.solution is not None and self._solved.get(_mark(step)) is self.solution

    def fitted(self, solution: Solution) -> Fitted:
        """A solution for another process."""
        kept = {f.name: getattr(solution, f.name) for f in fields(solution) if f.name != "model"}
        return Fitted(kept, dict(solution.model.values))

    def known(self, step: StepEntry, fitted: Fitted) -> Solution:
        """The solution of a step that was fitted in another process, on the same records; where it
        is here already that one, on which candidates may have been fitted ahead.
        """
        there = self._solved.get(_mark(step))
        if there is not None and dict(there.values) == dict(fitted.solution["values"]):
            return there
        model = replace(self.model_of(step.effects, step.virtual_work), values=dict(fitted.own))
        made = self._solved[_mark(step)] = Solution(model, **fitted.solution)
        return made

    @property
    def ahead(self) -> Mapping[str, tuple[StepEntry, Solution]]:
        """Candidates that were fitted ahead of the click, beside the current model."""
        now = self.solution
        return {k: (v[2], v[1]) for k, v in self._prepared.items() if v[0] is now}

    def prepared_elsewhere(self, label: str, step: StepEntry, fitted: Fitted) -> None:
        """Take a candidate that another process fitted beside the current model."""
        now = self.current
        made = self.known(step, fitted)
        kept = {k: v for k, v in self._prepared.items() if v[0] is now}
        self._prepared = {**kept, label: (now, made, step)}

    def with_candidate(self, label: str, hint: Mapping[str, Any] | None = None) -> Solution:
        """The current model with an effect beside it: the fit that was made ahead, else a first
        look. Nothing here changes.

        Raises
        ------
        InputError
            The effect is in the model already, or cannot be there.
        """
        now = self.current
        ready = self._prepared.get(label)
        if ready is not None and ready[0] is now:
            return ready[1]
        model, start = self._with(label, hint)
        return first_look(model, self.data, now, start)

    # --- verbs ------------------------------------------------------------------------------------

    def fit_start(self, progress: Progress | None = None) -> StepEntry:
        """Fit the start model."""
        began = time.perf_counter()
        self.solution = solve(self.start_model, self.data, progress=progress)
        self.trials = {}
        return self._entry("start", None, self.data, began)

    def add(self, label: str, hint: Mapping[str, Any] | None = None) -> StepEntry:
        """Add an effect: the whole fit where it was made ahead, else a first look that `settle`
        follows.

        Parameters
        ----------
        label : str
            Label of a candidate, or key of an effect.
        hint : mapping, optional
            Start values and form from a diagnosis: ``{"values", "virtual_work"}``.

        Raises
        ------
        InputError
            The effect is in the model already, or cannot be there.
        """
        began = time.perf_counter()
        now = self.current
        ready = self._prepared.get(label)
        if ready is not None and ready[0] is now:
            self.solution, self.trials = ready[1], {}
            return replace(ready[2], seconds=round(time.perf_counter() - began, 3))
        model, start = self._with(label, hint)
        return self._looked("add", label, model, start, began)

    def prepare(
        self,
        label: str,
        hint: Mapping[str, Any] | None = None,
        progress: Progress | None = None,
    ) -> None:
        """Fit a candidate ahead of the click, so that `add` has it at once."""
        began, now = time.perf_counter(), self.current
        if label in self.ahead:  # as after an undo
            return
        model, start = self._with(label, hint)
        made = solve(model, self.data, start=start, progress=progress)
        entry = self._entry("add", label, self.data, began, made)
        self._prepared = {
            **{k: v for k, v in self._prepared.items() if v[0] is now},
            label: (now, made, entry),
        }

    def trial_of(self, label: str) -> StepEntry:
        """The step that adding an effect would make; it is at hand for `add` then.

        Raises
        ------
        InputError
            The effect is in the model already, or cannot be there.
        """
        self.prepare(label)
        return self._prepared[label][2]

    def settle(self, step: StepEntry, progress: Progress | None = None) -> StepEntry:
        """The whole fit of a step that was only looked at."""
        began, now = time.perf_counter(), self.current
        made = solve(now.model, self.data, start=now.values, progress=progress)
        entry = self._entry(step.action, step.label, self.data, began, made)
        self.solution = made
        return replace(entry, names=step.names, separate_by=step.separate_by, id=step.id)

    def remove(self, label: str) -> StepEntry:
        """Take an effect out of the model: a first look, as `add`."""
        began = time.perf_counter()
        now = self.current
        if label == HOLD_DELAY:
            raise InputError("the delay of the drive is found in each record, and cannot go")
        try:
            model = without(now.model, label)
        except (KeyError, ValueError) as error:
            raise InputError(f"{title_of(label)}: {error.args[0]}") from None
        return self._looked("remove", label, model, now.values, began)

    def _with(
        self, label: str, hint: Mapping[str, Any] | None
    ) -> tuple[JointModel, dict[str, float]]:
        """The model with an effect, and the values to start from."""
        now = self.current
        trial = self.trials.get(label)
        values = {**now.values, **(trial.values if trial else (hint or {}).get("values", {}))}
        try:
            model = trial.candidate.model if trial else with_effect(now.model, label)
        except (KeyError, ValueError) as error:
            raise InputError(f"{title_of(label)}: {error.args[0]}") from None
        if not trial and hint and "virtual_work" in hint:
            model = replace(model, virtual_work=bool(hint["virtual_work"]))
        return model, values

    def _looked(
        self, action: str, label: str, model: JointModel, start: Mapping[str, float], began: float
    ) -> StepEntry:
        made = first_look(model, self.data, self.current, start)
        entry = self._entry(action, label, self.data, began, made, whole=False)
        self.solution, self.trials = made, {}
        return entry

    def diagnose(self, progress: Progress) -> dict[str, Any]:
        """What is missing from the current model: the first decision of the loop, as every door
        gives it.

        Raises
        ------
        InputError
            Records in unlike units.
        """
        now = self.current
        session = Session(self.bench, progress, gate_warnings(self.records))
        found = Diagnosis(session.diagnose(now))
        ranking, claim = found.ranking, None
        if found.claims:
            claim = found.claims[0].as_json() | {"label": found.claims[0].label}
        self.trials = {t.candidate.label: t for t in ranking.everything}
        rows = []
        for trial in ranking.trials:
            e = trial.candidate.effect
            rows.append(
                ranked_json(trial, trial.candidate.label in ranking.significant)
                | {
                    "label": trial.candidate.label,
                    "values": dict(trial.values),
                    "virtual_work": trial.candidate.model.virtual_work,
                    "absence": e.absence,
                    "excitation": e.excitation,
                    "source": e.source,
                    "separate_by": e.separate_by,
                    "family": e.family,
                    "contribution": trial.contribution,
                    "score": trial.score,
                }
            )
        unit = "N" if self.joint.kind == "linear" else "N.m"
        story = found.as_json()
        out: dict[str, Any] = clean(
            {
                **{
                    key: story[key]
                    for key in (
                        "outcome",
                        "verdict",
                        "reason",
                        "refused",
                        "unexplained",
                        "floor_ratio",
                        "warnings",
                    )
                },
                "headline": headline(story),
                # after an addition they belong to the model with it
                **({} if found.claims else kept_curves(found.found)),
                "ranking": rows,
                "claim": claim,
                "unit": unit,
                "not_testable": [
                    {
                        "effect": n.effect,
                        "title": EFFECTS[n.effect].title,
                        "why": n.why,
                        "asks": list(n.asks),
                    }
                    for n in ranking.not_testable
                ],
            }
        )
        return out

    def every_sample(self, step: StepEntry) -> Dataset:
        """Every sample of the records, the clocks set beside the laws of a step."""
        if self.whole:
            return self.data
        model = self.model_of(step.effects, step.virtual_work)
        return dataset_of(self._train, self._held, self.joint, model)

    def confirm(self, step: StepEntry, progress: Progress) -> StepEntry:
        """Fit the current model to every sample, and judge it on every held-out sample."""
        began = time.perf_counter()
        progress("preparing every sample", 0.1)
        data = self.every_sample(step)
        progress("fitting every sample", 0.4)
        now = self.current
        self.solution = solve(
            now.model,
            data,
            start=now.values,
            iterations=4,
            progress=lambda text, share: progress(
                f"fitting every sample, {text}", 0.4 + 0.5 * share
            ),
        )
        made = self._entry(step.action, step.label, data, began)
        self.restore(made)
        said = replace(made, names=step.names, separate_by=step.separate_by)
        return replace(said, exact=True, id=step.id)

    # --- views ------------------------------------------------------------------------------------

    def compare(self, width: int = WIDTH, whole: int = WIDTH) -> dict[str, Any]:
        """Error, and places with the most telling first, on the held-out records.

        Parameters
        ----------
        width, whole : int
            Of a picture of a place, and of one that has a row of the page to itself.
        """
        now = self.current
        rows = self.rows
        residual = self.residuals()
        found = places_of(residual, rows)
        assessed = self.assessed()
        error = self.bench.judged(now, assessed)
        alone = sum(p.tells for p in found) <= 1
        wide = [whole if alone and k == 0 else width for k in range(len(found))]
        out: dict[str, Any] = clean(
            {
                "error": error.as_json(),
                "places": [
                    p.as_json()
                    | {"tells": p.tells, "chart": replace(place_chart(p), width=w).as_json()}
                    for p, w in zip(found, wide, strict=True)
                ],
                "worst": self._worst(rows),
                "records": list(self.data.held_out_names),
                "note": self.note,
            }
        )
        return out

    def assessed(self) -> Error:
        """Error of the current model on the held-out records, before the verdict is heard."""
        now = self.current
        kept = self._assessed
        if kept is None or kept[0] is not now or kept[1] is not self.data:
            found = assess(now.model, self.data, self.data.held_out, now.values)
            kept = self._assessed = (now, self.data, found)
        return kept[2]

    def noise(self) -> dict[str, FloatArray]:
        """Scatter that noise alone allows each held-out row of every balance; NaN in rows that take
        no part.
        """
        out = {}
        for balance, error in self.assessed().balances.items():
            rows = taking_part(balance, self.data.held_out)
            out[balance] = np.full(len(rows), np.nan)
            out[balance][rows] = 1.0 / np.maximum(error.weight, 1e-300)
        return out

    def balance_series(self, balance: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Time, measured torque, what the model explains of it, and the scatter that noise alone
        allows what it leaves, on the held-out records.

        Raises
        ------
        InputError
            The records have no such balance.
        """
        residual = self.residuals()
        if balance not in residual:
            raise InputError(
                f"no {balance} balance in these records; they have {', '.join(residual)}"
            )
        # a curve breaks where a new stretch begins
        breaks = np.concatenate([np.where(w.begins, np.nan, 0.0) for w in self.data.held_out])
        measured = references(self.data, self.data.held_out)[balance] + breaks
        time = self.rows.axes["time"].values
        return time, measured, measured - residual[balance], self.noise()[balance] + breaks

    def laid_out(self) -> tuple[list[tuple[float, str]], list[float]]:
        """Where each held-out record begins in the plot over time, with its name, and where each
        further run of one does.
        """
        time, at = self.rows.axes["time"].values, 0
        records, runs = [], []
        for k, w in enumerate(self.data.held_out):
            named = k < len(self.data.held_out_names)
            records.append((float(time[at]), self.data.held_out_names[k] if named else ""))
            starts = np.flatnonzero(w.begins)
            runs += [float(time[at + int(i)]) for i in starts if i > 0]
            at += len(w.begins)
        return records, runs

    def parameters(self) -> dict[str, Any]:
        """Table of the parameters of the current model."""
        table = parameter_table(self.current, self.data)
        limits = {p.name: (p.low, p.high) for p in self.current.model.parameters}
        out: dict[str, Any] = clean(
            {
                n: {
                    **row,
                    "low": limits.get(n, (None, None))[0],
                    "high": limits.get(n, (None, None))[1],
                    "held": n in self.joint.known and self.joint.known[n].value is not None,
                }
                for n, row in table.items()
            }
        )
        return out

    def to_joint_file(self) -> str:
        """The fitted joint as the text of a joint file."""
        now = self.current
        own = set(self.start_model.effects) - set(self.joint.effects)
        kept = (
            self.joint if own <= set(now.model.effects) else replace(self.joint, model_name="hd1")
        )
        seen = assess(now.model, self.data, self.data.train, now.values)
        left = self.bench.judged(now, seen, held_out=False).balances
        return joint_text(kept, now, self.data, left)

    # --- inside -----------------------------------------------------------------------------------

    @property
    def current(self) -> Solution:
        """The fitted model.

        Raises
        ------
        InputError
            Nothing is fitted yet.
        """
        if self.solution is None:
            raise InputError("no fit yet: press Fit first")
        return self.solution

    @property
    def rows(self) -> Rows:
        """The held-out rows with their signals."""
        if self._rows is None:
            self._rows = gather(self.data, self.data.held_out)
        return self._rows

    def residuals(self) -> dict[str, FloatArray]:
        """Residual of every balance on the held-out rows; NaN in rows that take no part."""
        now = self.current
        return dict(
            stack(
                Balances(now.model, self.data.sensing, wrt=()), self.data.held_out, now.values
            ).shown
        )

    def _worst(self, rows: Rows) -> dict[str, Any]:
        """The window in which the residual stands highest over what noise allows its rows: by one
        floor for all, a reversal would be the worst of every record.
        """
        stamps, held = rows.axes["time"].values, self.data.held_out
        power = {b: x**2 for b, x in over_noise(self.assessed(), held).items()}
        low, high = worst_window(stamps, np.asarray(sum(power.values())), SHOWN_WINDOW)
        inside = (stamps >= low) & (stamps <= high)
        return {
            "low": low,
            "high": high,
            "balance": max(power, key=lambda b: power[b][inside].sum()),
        }

    def _entry(
        self,
        action: str,
        label: str | None,
        data: Dataset,
        began: float,
        made: Solution | None = None,
        *,
        whole: bool = True,
    ) -> StepEntry:
        """A step of the ledger; without `whole` a first look, judged on the held-out records
        only.
        """
        now = made or self.current
        bench = (
            self.bench
            if data is self.data
            else JointBench(self.joint, data, self._train, self._held)
        )
        train: dict[str, Any] = {}
        if whole:
            seen = assess(now.model, data, data.train, now.values)
            train = clean(bench.judged(now, seen, held_out=False).as_json())
        held = bench.judged(now, assess(now.model, data, data.held_out, now.values))
        key = key_of(label) if label else None
        entry = StepEntry(
            action,
            tuple(now.model.effects),
            values={k: float(v) for k, v in now.values.items()},
            train=train,
            held_out=clean(held.as_json()),
            key=key,
            label=label,
            title=EFFECTS[key].title if key is not None and key in EFFECTS else None,
            virtual_work=now.model.virtual_work,
            exact=self.whole,
            seconds=round(time.perf_counter() - began, 3),
            settled=whole,
            id=secrets.token_hex(4),
        )
        if data is self.data:
            self._solved[_mark(entry)] = now
        return entry


def _mark(step: StepEntry) -> str:
    """What tells one fitted model from another."""
    return repr((step.effects, step.virtual_work, sorted(step.values.items())))


def _share(records: list[Record], seconds: float) -> list[Record]:
    """Records thinned to `seconds` in all; the same list where they are short enough."""
    total = sum(r.duration for r in records)
    if total <= 1.5 * seconds or sum(map(len, records)) <= 1.5 * seconds * USUAL_RATE:
        return records
    return [thinned(r, seconds * r.duration / total) for r in records]
