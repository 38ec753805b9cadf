"""The search itself: initial evaluations, sweeps, local searches, stopping."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np

from identification.search.basket import Basket
from identification.search.boxes import BoxTree
from identification.search.evaluate import Evaluator, SearchStopped
from identification.search.evolution import evolve
from identification.search.local import LocalSearch
from identification.search.problem import Problem
from identification.search.types import FloatArray, MCSMinimum, MCSOutcome, MCSProgress, MCSResult


@final
class Search:
    """One run of the coordinate search.

    Parameters
    ----------
    fun : callable
        The objective.
    problem : Problem
        Box, lists and settings, checked.
    target : float
        Value at which to stop.
    max_evaluations, stall_sweeps : int
        Limits; a stall limit of 0 switches that rule off.
    callback : callable or None
        Told the progress; a true answer stops the search.
    """

    def __init__(
        self,
        fun: Callable[[FloatArray], Any],
        problem: Problem,
        target: float,
        max_evaluations: int,
        stall_sweeps: int,
        callback: Callable[[MCSProgress], object] | None,
    ) -> None:
        self._stall = stall_sweeps
        self._callback = callback
        self.evaluate = Evaluator(fun, problem.low, problem.high, target, max_evaluations)
        self.tree = BoxTree(self.evaluate, problem.lists, problem.start, problem.levels)
        self._local = None
        if problem.local_steps:
            self._local = LocalSearch(
                self.evaluate, problem.pattern, problem.local_steps, problem.precision
            )
        self.basket = Basket(self.evaluate, self._local)
        self._restarts = problem.restarts

    def run(self) -> MCSResult:
        """Search until a stopping rule holds."""
        try:
            outcome = self._sweeps()
            self._restart()
        except SearchStopped as stopped:
            outcome = stopped.outcome
        evaluate = self.evaluate
        if evaluate.not_finite == evaluate.count and outcome is not MCSOutcome.CALLBACK:
            outcome = MCSOutcome.NOWHERE_FINITE
        return MCSResult(
            x=np.array(evaluate.best_x),
            fun=evaluate.best,
            nfev=evaluate.count,
            nit=evaluate.sweep,
            nfev_local=self.basket.calls,
            local_searches=self.basket.searches,
            not_finite=evaluate.not_finite,
            basket=tuple(MCSMinimum(np.array(m.x), m.f, m.converged) for m in self.basket.close()),
            outcome=outcome,
        )

    def _sweeps(self) -> MCSOutcome:
        evaluate, tree = self.evaluate, self.tree
        tree.initialise()
        if self._local is not None and evaluate.not_finite < evaluate.count:
            self._local.reference = evaluate.best
        self._report()
        while True:
            evaluate.sweep += 1
            if not tree.sweep():
                evaluate.sweep -= 1
                return MCSOutcome.EXHAUSTED
            found, tree.candidates = sorted(tree.candidates), []
            for f, x in found:
                if self.basket.offer(f, x):
                    self._report()
            self._report()
            if self._stall and evaluate.sweep - evaluate.best_sweep >= self._stall:
                return MCSOutcome.STALLED

    def _restart(self) -> None:
        """Runs across the coordinates, each followed by a local search where one is made."""
        evaluate = self.evaluate
        if evaluate.not_finite == evaluate.count:
            return
        for run in range(self._restarts):
            evaluate.sweep += 1
            value, x = evolve(evaluate, run, np.array(evaluate.best_x) if run == 0 else None)
            self.basket.offer(value, tuple(x.tolist()))
            self._report()

    def _report(self) -> None:
        if self._callback is None:
            return
        evaluate = self.evaluate
        progress = MCSProgress(
            np.array(evaluate.best_x), evaluate.best, evaluate.count, evaluate.sweep
        )
        if self._callback(progress):
            raise SearchStopped(MCSOutcome.CALLBACK)
