"""Fit the parameters of a user's FMU by the error of its outputs.

Damped Gauss-Newton steps; the start values of each window are eliminated by a QR decomposition of their own columns,
and bounds are kept by a bounded least-squares problem for the step (Stark & Parker 1995, as in scipy's lsq_linear).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from identification.errors import InputError
from identification.noise import noise_level
from identification.record import Record

from .host import FmuError
from .signals import FloatArray
from .user_compare import UserComparison, comparison_of
from .user_exact import Exact, NotExact
from .user_model import UserModel, listed, start_values
from .user_run import Window
from .user_sensitivity import BlackBox, Simulator, scale_of, start_scale

if TYPE_CHECKING:
    from .user_diagnose import UserDiagnosis

Progress = Callable[[str, float], None]
_MOVED: Final = 1e-9
"""A column smaller than this share of the output's own size moves nothing."""
_ENOUGH: Final = 1e-5
_BLOCK: Final = 1.5
"""Length of the blocks whose scores give the standard errors [s]."""
_FEW_BLOCKS: Final = 10
"""With fewer blocks the residual counts as a process of first order instead."""


@final
@dataclass(frozen=True)
class UserFit:
    """A fitted FMU.

    Attributes
    ----------
    model : UserModel
        With the fitted values.
    stderr : mapping of str to float or None
        From the spread of the scores of time blocks; None where the data do not show the parameter.
    unmoved, at_bound : tuple of str
        Parameters that move no output (left at their start), and those that stopped at a bound.
    correlation : mapping
        Largest correlation with another parameter: (name, value).
    method : str
        How derivatives were made, and why not exactly.
    train : UserComparison
    """

    model: UserModel
    stderr: Mapping[str, float | None]
    unmoved: tuple[str, ...]
    at_bound: tuple[str, ...]
    correlation: Mapping[str, tuple[str, float]]
    method: str
    iterations: int
    train: UserComparison
    records: tuple[Record, ...]

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by name."""
        return self.model.values

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Value, standard error, unit and flags of each parameter."""
        found = {}
        for name, value in self.values.items():
            own = name in self.model.fmu.variables
            partner = self.correlation.get(name)
            unit = (self.model.fmu.variable(name).unit or "") if own else self.model.correction.unit(name) if self.model.correction else ""
            found[name] = {
                "value": value, "stderr": self.stderr.get(name), "unit": unit, "at_bound": name in self.at_bound,
                "identifiable": name not in self.unmoved and self.stderr.get(name) is not None, "of": "fmu" if own else "correction",
                "correlation": {"with": partner[0], "value": partner[1]} if partner else None,
            }  # fmt: skip
        return found

    def as_json(self) -> dict[str, Any]:
        """Values, errors and flags as data."""
        return {
            "fmu": self.model.fmu.path.name, "method": self.method, "iterations": self.iterations, "parameters": self.parameters,
            "train": self.train.as_json(), "notes": list(self.model.notes),
        }  # fmt: skip

    def compare(self, records: Record | Sequence[Record]) -> UserComparison:
        """Compare with records that the fit may never have seen."""
        return self.model.compare(records)

    def diagnose(self, held_out: Record | Sequence[Record] = (), progress: Callable[[str, float], None] | None = None) -> UserDiagnosis:
        """Name what is missing."""
        return self.model.diagnose(self.records, held_out, progress)


def fit(model: UserModel, records: Record | Sequence[Record], *, iterations: int = 25, exact: bool = True, progress: Progress | None = None) -> UserFit:
    """Fit the parameters of a user's FMU to records.

    Parameters
    ----------
    model : UserModel
    records : Record or sequence of Record
    iterations : int
        Gauss-Newton steps at most.
    exact : bool
        False: difference quotients even where exact derivatives are to be had.
    progress : callable, optional
        ``progress(text, share)``; how many steps are needed shows only at the end, so the share is a guess.

    Raises
    ------
    InputError
        Unusable records, or nothing to fit.
    FmuError
        Where the FMU fails at the start values.
    """
    given = listed(records)
    if not model.values:
        raise InputError(f"{model.fmu.path.name}: no parameter to fit; name those that may move")
    say = progress or (lambda _text, _share: None)
    windows = model.windows(given)
    say(f"taking up {model.fmu.path.name}", 0.02)
    simulator, method = simulator_of(model, windows, exact)
    solver = Solver(model, windows, simulator, noise_of(model, given))
    used = solver.solve(iterations, say)
    say("standard errors", 0.95)
    fitted = model.with_values(solver.values)
    stderr, correlation = solver.errors()
    bounds = model.bounds()
    at_bound = tuple(n for n in solver.names if any(abs(solver.values[n] - b) <= 1e-9 * max(abs(b), 1e-300) for b in bounds[n] if math.isfinite(b)))
    stderr = {n: None if n in at_bound else e for n, e in stderr.items()}
    say("done", 1.0)
    return UserFit(
        fitted, stderr, tuple(n for n in model.values if n not in solver.names), at_bound, correlation, method, used,
        comparison_of(fitted, given, windows, solver.predicted), tuple(given),
    )  # fmt: skip


def simulator_of(model: UserModel, windows: Sequence[Window], exact: bool = True) -> tuple[Simulator, str]:
    """The best simulator that the FMU allows, and a sentence on it."""
    if not exact:
        return BlackBox(model, windows), "black box: difference quotients over whole runs"
    try:
        return Exact(model, windows), "exact derivatives through CasADi's import, checked against difference quotients"
    except (NotExact, FmuError) as error:
        return BlackBox(model, windows), f"black box: {error}"


def noise_of(model: UserModel, records: Sequence[Record]) -> FloatArray:
    """White noise of the measured outputs, in the units of the FMU."""
    levels = [[abs(m.scale) * noise_level(r[m.channel], tuple(r.segments())) for m in model.outputs] for r in records]
    found: FloatArray = np.median(np.array(levels), axis=0)
    return found


@final
class Solver:
    """Where the iteration stands.

    Attributes
    ----------
    values : dict
        Of the moving parameters and of those that move no output.
    names : list of str
        Parameters that move an output.
    starts : (windows, starts) array
    """

    def __init__(self, model: UserModel, windows: Sequence[Window], simulator: Simulator, noise: FloatArray, frozen: bool = False) -> None:
        self.model, self.windows, self.simulator = model, tuple(windows), simulator
        self.values = dict(model.values)
        self.names: list[str] = []
        self._frozen = frozen
        self.bounds = model.bounds()
        self.starts = start_values(self.windows)
        self.spread = start_scale(model, windows)
        measured = np.concatenate([w.outputs for w in self.windows])
        self.size = np.maximum(np.std(measured, axis=0), 1e-300)
        self.noise = np.maximum(noise, 1e-9 * self.size)
        self.sigma = self.size.copy()
        self.damping = 1e-4
        self._kept: tuple[list[FloatArray], list[FloatArray]] = ([], [])
        self.predicted = simulator.simulate(self.values, self.starts)
        self._drop_unmoved()

    def _drop_unmoved(self) -> None:
        """Leave out parameters that move no output here; a shape does so while its amplitude is 0."""
        if self._frozen:
            return
        self.names = list(self.values)
        self._kept = ([], [])
        _, jacobian = self._sensitivities()
        for i, name in reversed(list(enumerate(self.names))):
            moved = max(float(np.max(np.abs(j[:, :, i]) / self.size)) for j in jacobian)
            if moved * scale_of(self.values[name], self.bounds[name]) <= _MOVED:
                del self.names[i]
                self._kept = (self._kept[0], [np.delete(j, i, axis=2) for j in self._kept[1]])

    def _sensitivities(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Outputs and derivatives where the iteration stands, made once."""
        if not self._kept[0]:
            self._kept = self.simulator.sensitivities(self.values, self.starts, self.names)
        return self._kept

    def cost(self, predicted: Sequence[FloatArray] | None = None) -> float:
        """Sum of squares of the weighted errors."""
        pairs = zip(self.windows, self.predicted if predicted is None else predicted, strict=True)
        return sum(float(np.sum(((w.outputs - y) / self.sigma) ** 2)) for w, y in pairs)

    def solve(self, iterations: int, say: Progress = lambda _text, _share: None) -> int:
        """Iterate to the end; the number of steps."""
        used = 0
        for last in (False, True):
            residual = np.concatenate([w.outputs - y for w, y in zip(self.windows, self.predicted, strict=True)])
            self.sigma = np.maximum(self.noise, np.sqrt(np.mean(residual**2, axis=0)))
            self.damping = 1e-4
            if last and len(self.names) < len(self.values):
                self._drop_unmoved()
            for _ in range(max(1, iterations - used) if last else iterations):
                used += 1
                say(f"fitting, step {used}", 0.95 - 0.9 * 0.85**used)
                if self._step() < _ENOUGH:
                    break
        return used

    def _step(self) -> float:
        """One accepted step; the relative fall of the cost."""
        before = self.cost()
        reduced, right, blocks = self._reduced()
        for _ in range(10):
            delta = self._bounded(reduced, right)
            values = {**self.values, **{n: self._inside(n, self.values[n] + d) for n, d in zip(self.names, delta, strict=True)}}
            applied = np.array([values[n] - self.values[n] for n in self.names])
            starts = self.starts + np.array([self._start_step(*b, applied) for b in blocks]).reshape(self.starts.shape)
            try:
                predicted = self.simulator.simulate(values, starts)
                after = self.cost(predicted)
            except (FmuError, InputError):
                after = math.inf
            if after < before:
                self.values, self.starts, self.predicted = values, starts, predicted
                self._kept = ([], [])
                self.damping = max(self.damping / 10, 1e-12)
                return (before - after) / before
            self.damping *= 10
        return 0.0

    def _inside(self, name: str, value: float) -> float:
        low, high = self.bounds[name]
        return float(min(max(value, low), high))

    def _reduced(self) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, FloatArray, FloatArray]]]:
        """Rows without the start values, stacked and compressed; and what gives the start values back."""
        predicted, jacobian = self._sensitivities()
        n = len(self.names)
        rows, blocks = [], []
        for w, y, j in zip(self.windows, predicted, jacobian, strict=True):
            r = ((w.outputs - y) / self.sigma).ravel()
            full = (j / self.sigma[:, None]).reshape(len(r), -1)
            theta, x = full[:, :n], full[:, n:] * self.spread
            q, upper = np.linalg.qr(x) if x.shape[1] else (np.empty((len(r), 0)), np.empty((0, 0)))
            outside = np.column_stack([theta, r]) - q @ (q.T @ np.column_stack([theta, r]))
            rows.append(np.asarray(np.linalg.qr(outside, mode="r")))
            blocks.append((upper, q.T @ theta, q.T @ r))
        small: FloatArray = np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))
        return small[:, :n], small[:, n], blocks

    def _bounded(self, reduced: FloatArray, right: FloatArray) -> FloatArray:
        from scipy.optimize import lsq_linear

        if not self.names:
            return np.empty(0)
        scale = np.maximum(np.linalg.norm(reduced, axis=0), 1e-300)
        low = np.array([(self.bounds[n][0] - self.values[n]) * s for n, s in zip(self.names, scale, strict=True)])
        high = np.array([(self.bounds[n][1] - self.values[n]) * s for n, s in zip(self.names, scale, strict=True)])
        room = np.where(high - low > 0, 0.0, 1e-300)
        a = np.vstack([reduced / scale, math.sqrt(self.damping) * np.eye(len(scale))])
        b = np.concatenate([right, np.zeros(len(scale))])
        found = lsq_linear(a, b, (low - 1e-300, high + room + 1e-300), method="bvls", max_iter=200)
        return np.asarray(found.x / scale, dtype=np.float64)

    def _start_step(self, upper: FloatArray, theta: FloatArray, right: FloatArray, delta: FloatArray) -> FloatArray:
        if not len(right):
            return np.empty(0)
        n = upper.shape[1]
        a = np.vstack([upper, math.sqrt(self.damping) * np.eye(n)])
        step = np.linalg.lstsq(a, np.concatenate([right - theta @ delta, np.zeros(n)]), rcond=1e-12)[0]
        return np.asarray(step * self.spread, dtype=np.float64)

    def _inflation(self) -> float:
        """Rows per independent row, from the autocorrelation of the residual one sample later (first-order process)."""
        top = bottom = 0.0
        for w, y in zip(self.windows, self.predicted, strict=True):
            r = (w.outputs - y) / self.sigma
            top += float(np.sum(r[1:] * r[:-1]))
            bottom += float(np.sum(r**2))
        rho = min(max(top / bottom if bottom > 0 else 0.0, 0.0), 0.999)
        return (1 + rho) / (1 - rho)

    def errors(self) -> tuple[dict[str, float | None], dict[str, tuple[str, float]]]:
        """Standard errors by the block sandwich, and correlations."""
        n = len(self.names)
        stderr: dict[str, float | None] = dict.fromkeys(self.values)
        if not n:
            return stderr, {}
        predicted, jacobian = self._sensitivities()
        gram, scores = np.zeros((n, n)), []
        for w, y, j in zip(self.windows, predicted, jacobian, strict=True):
            r = ((w.outputs - y) / self.sigma).ravel()
            full = (j / self.sigma[:, None]).reshape(len(r), -1)
            q = np.linalg.qr(full[:, n:] * self.spread)[0] if full.shape[1] > n else np.empty((len(r), 0))
            theta = full[:, :n] - q @ (q.T @ full[:, :n])
            gram += theta.T @ theta
            block = np.repeat(np.floor((w.time - w.time[0]) / _BLOCK + 1e-9), w.outputs.shape[1])
            scores += [theta[block == k].T @ r[block == k] for k in np.unique(block)]
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-12)
        s = np.array(scores) / scale
        total = inverse @ (s.T @ s) @ inverse * len(s) / max(len(s) - 1, 1)
        if len(s) < max(_FEW_BLOCKS, 3 * n):
            rows = sum(w.outputs.size for w in self.windows)
            total = inverse * self.cost() / max(rows - n, 1) * self._inflation()
        spread = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
        together = inverse / np.outer(spread, spread)
        np.fill_diagonal(together, 0.0)
        correlation = {}
        for i, name in enumerate(self.names):
            error = math.sqrt(max(float(total[i, i]), 0.0)) / float(scale[i])
            stderr[name] = error if spread[i] < 1e5 and math.isfinite(error) else None
            if n > 1:
                other = int(np.argmax(np.abs(together[i])))
                correlation[name] = (self.names[other], float(together[i, other]))
        return stderr, correlation


__all__ = ["Solver", "UserFit", "fit", "noise_of", "simulator_of"]
