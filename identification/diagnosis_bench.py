"""What a session asks of a model and its records: fits, trials and what is left, behind one interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol, final

from casadi_models import JointModel
from identification.assess import VERDICT_KERNELS, BalanceError, Error, assess
from identification.claims import Ranking, rank
from identification.engine import Dataset, Solution, load_dataset, prepared_model, solve
from identification.improvement import Step, visible_keys
from identification.joint_file import Joint
from identification.lines import Line, find_lines
from identification.locate import Unexplained, locate
from identification.record import Record
from identification.trials import Base, Trial, make_base, try_candidate

Progress = Callable[[str, float], None]

LINE_KERNEL_ROWS: Final = 8
"""Samples of the shortest kernel that resolves a line: what a second derivative by a kernel needs."""
LINE_KERNELS: Final = (0.012, 0.03)
"""Shortest kernel of the search for lines, and one between it and that of the claims [s]."""
CLEARLY_SHORTER: Final = 0.7
"""Share of the claims' kernel from which another one shows no other lines."""


class Bench(Protocol):
    """A model with its prepared records; a joint model and a user's FMU are two."""

    joint: Joint
    data: Dataset

    def start(self) -> Solution:
        """The fit of the model that is judged."""

    def fitted(self, model: JointModel, start: Mapping[str, float], *, again: bool = False) -> Solution:
        """The whole fit of a model."""

    def step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        """A fitted model with its errors."""

    def added(self, trial: Trial, now: Step) -> Step:
        """The model of a step with a tried candidate, as far as it can be fitted."""

    def base(self, solution: Solution) -> Base:
        """Rows of a fitted model for the trials."""

    def ranking(self, base: Base, *, late: bool = False, progress: Progress | None = None) -> Ranking:
        """The library tried on a base."""

    def ratios(self, step: Step) -> dict[str, BalanceError]:
        """Residual over floor of every balance on held-out records, as the verdict counts it."""

    def lines(self, step: Step) -> list[Line]:
        """Lines in what is left."""

    def places(self, step: Step, error: Error, lines: Sequence[Line], limit: float) -> list[Unexplained]:
        """Where what is left sits, for every balance over `limit` times its floor."""

    def same_sign(self, trial: Trial, solution: Solution) -> bool:
        """Whether a small effect has the same sign at half and at double kernel."""


@final
class JointBench:
    """A joint model and its records.

    Parameters
    ----------
    joint : Joint
    data : Dataset
        Made from `train` and `held`.
    train, held : sequence of Record
    """

    def __init__(self, joint: Joint, data: Dataset, train: Sequence[Record], held: Sequence[Record]) -> None:
        self.joint, self.data = joint, data
        self._train, self._held = list(train), list(held)
        self._solved: dict[tuple[object, ...], Solution] = {}
        self._kernels: dict[float, Dataset] = {round(data.kernel, 9): data}

    def start(self) -> Solution:
        """The fit of the joint's own model."""
        return solve(prepared_model(self.joint, self._train[0]), self.data)

    def fitted(self, model: JointModel, start: Mapping[str, float], *, again: bool = False) -> Solution:
        """A fit made once per model, unless `again`: a confirmed candidate is not fitted anew when it is added."""
        if again:
            return solve(model, self.data, start=start)
        if model.structure not in self._solved:
            self._solved[model.structure] = solve(model, self.data, start=start)
        return self._solved[model.structure]

    def step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        """A fitted model with its errors on training and held-out records."""
        train = assess(solution.model, self.data, self.data.train, solution.values)
        held = assess(solution.model, self.data, self.data.held_out, solution.values)
        return Step(key, visible_keys(solution.model), train, held, solution, label)

    def added(self, trial: Trial, now: Step) -> Step:
        """The whole fit of the model with a candidate."""
        solution = self.fitted(trial.candidate.model, {**now.solution.values, **trial.values})
        return self.step(trial.key, trial.candidate.label, solution)

    def base(self, solution: Solution) -> Base:
        """See :func:`identification.trials.make_base`."""
        return make_base(solution, self.data)

    def ranking(self, base: Base, *, late: bool = False, progress: Progress | None = None) -> Ranking:
        """See :func:`identification.claims.rank`."""
        return rank(base, late=late, progress=progress)

    def ratios(self, step: Step) -> dict[str, BalanceError]:
        """Residual over floor, each balance at its own kernel, on held-out records."""
        out: dict[str, BalanceError] = {}
        solution = step.solution
        for length in sorted({VERDICT_KERNELS[b] for b in self.data.sensing.balances}):
            data = self._at_kernel(length)
            error = assess(solution.model, data, data.held_out, solution.values)
            out.update({b: e for b, e in error.balances.items() if VERDICT_KERNELS[b] == length})
        return {b: out[b] for b in self.data.sensing.balances}

    def lines(self, step: Step) -> list[Line]:
        """Lines at two shorter kernels and that of the claims."""
        shortest = max(LINE_KERNEL_ROWS * self.data.train[0].grid.dt, LINE_KERNELS[0])
        kernels = [k for k in (shortest, LINE_KERNELS[1]) if k < CLEARLY_SHORTER * self.data.kernel]
        return find_lines(step.solution, [*(self._at_kernel(k) for k in kernels), self.data])

    def places(self, step: Step, error: Error, lines: Sequence[Line], limit: float) -> list[Unexplained]:
        """See :func:`identification.locate.locate`."""
        return locate(step.solution, self.data, error, lines, limit)

    def same_sign(self, trial: Trial, solution: Solution) -> bool:
        """A minor effect must have the same sign at half and at double kernel."""
        for factor in (0.5, 2.0):
            data = self._at_kernel(self.data.kernel * factor)
            other = solve(solution.model, data, start=solution.values)
            found = try_candidate(trial.candidate, make_base(other, data))
            if not isinstance(found, Trial):
                return False
            name = max(trial.candidate.amplitudes, key=lambda n: abs(trial.values[n]))
            if trial.values[name] * found.values[name] <= 0:
                return False
        return True

    def _at_kernel(self, length: float) -> Dataset:
        """The same records with another kernel, prepared once."""
        mark = round(length, 9)
        if mark not in self._kernels:
            model = prepared_model(self.joint, self._train[0])
            self._kernels[mark] = load_dataset(self._train, self._held, self.joint, model, kernel=length)
        return self._kernels[mark]
