"""Fit the parameters of a user's FMU by the error of its outputs.

The outputs of the windows are a problem of the one least-squares solver; the start values of each
window are its own unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np

from identification.data.record import Record
from identification.errors import InputError
from identification.fitting.covariance import (
    correlations,
    process_errors,
    window_errors,
    windows_over,
)
from identification.fitting.engine import AT_BOUND
from identification.fitting.least_squares import least_squares, triangle_of
from irj_fmu.host.run import FmuError
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.exact import Exact, NotExact
from irj_fmu.imported.model import UserModel, at_least_one, start_values
from irj_fmu.imported.outputs import UserComparison, comparison_of, noise_of
from irj_fmu.imported.port import coupled, hold_of
from irj_fmu.imported.run import Window
from irj_fmu.imported.sensitivity import BlackBox, Simulator, scale_of

Progress = Callable[[str, float], None]
_MOVED: Final = 1e-9
"""A column smaller than this share of the output's own size moves nothing."""
ENOUGH: Final = 0.02
"""Fall of the sum of squares, in units of one sample's noise, that is not worth a step: it moves no
parameter by more than a seventh (its root) of what white noise makes of it.
"""
ROUGH: Final = 0.1
"""Relative fall of the sum of squares that is not worth a step with the weights of the residual
that a fit began with: they are off by as much as it falls, and new ones tell more.
"""
LIKE: Final = 0.1
"""Change of the logarithm of a weight within which it is the same: it moves a value by less than a
tenth of its error.
"""
_SPREAD: Final = 1e5
"""Standard deviation, in units of what a column alone would have, beyond which a parameter
cannot be told from others.
"""

_USED_UP: Final = (
    "steps were used up before the fit came to rest: values and errors are those on the way; begin "
    "nearer to them, or leave parameters out that the record hardly shows"
)
_COUPLINGS: Final = 3
"""Times the fit begins anew with a shorter coupling, as the law outside the FMU got steeper."""
_FINER: Final = 0.7
"""A shorter coupling than this share of the one in use is taken up: within it the law still acts
at less than one and a half times the slope that its coupling was chosen for.
"""


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
    iterations : int
        Steps taken.
    settled : bool
        False where these were used up before the fit came to rest.
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
    settled: bool = True

    def __repr__(self) -> str:
        fmu = self.model.fmu.path.name
        return f"UserFit({fmu!r}, {len(self.values)} parameters, {self.iterations} steps)"

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by name."""
        return self.model.values

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Value, standard error, unit and flags of each parameter."""
        found = parameter_table(self.model, self.stderr)
        for name, row in found.items():
            partner = self.correlation.get(name)
            row["correlation"] = {"with": partner[0], "value": partner[1]} if partner else None
        return found

    def as_json(self) -> dict[str, Any]:
        """Values, errors and flags as data."""
        return {
            "fmu": self.model.fmu.path.name,
            "method": self.method,
            "iterations": self.iterations,
            "settled": self.settled,
            "parameters": self.parameters,
            "train": self.train.as_json(),
            "notes": list(self.model.notes),
        }


def at_bounds(values: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]) -> set[str]:
    """Names of the values that stand at a bound."""
    return {
        n
        for n, x in values.items()
        if any(abs(x - b) <= AT_BOUND * max(abs(b), 1e-300) for b in bounds[n] if math.isfinite(b))
    }


def parameter_table(
    model: UserModel, stderr: Mapping[str, float | None]
) -> dict[str, dict[str, Any]]:
    """Value, standard error, unit and flags of each parameter of a model.

    Parameters
    ----------
    model : UserModel
    stderr : mapping of str to float or None
        In the units of the values; None where the records do not show the parameter.
    """
    found = {}
    edge = at_bounds(model.values, model.bounds())
    for name, value in model.values.items():
        own = name in model.fmu.variables
        unit = (
            (model.fmu.variable(name).unit or "")
            if own
            else model.correction.unit(name)
            if model.correction
            else ""
        )
        found[name] = {
            "value": value,
            "stderr": stderr.get(name),
            "unit": unit,
            "at_bound": name in edge,
            "identifiable": stderr.get(name) is not None,
            "of": "fmu" if own else "correction",
            "correlation": None,
        }
    return found


def fit(
    model: UserModel,
    records: Record | Sequence[Record],
    *,
    iterations: int = 40,
    exact: bool = True,
    progress: Progress | None = None,
) -> UserFit:
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
        ``progress(text, share)``; how many steps are needed shows only at the end, so the share is
        a guess.

    Raises
    ------
    InputError
        Unusable records, or nothing to fit.
    FmuError
        Where the FMU fails at the start values.
    """
    given = at_least_one(records)
    if not model.values:
        raise InputError(f"{model.fmu.path.name}: no parameter to fit; name those that may move")
    tell = progress or (lambda _text, _share: None)
    at: list[tuple[str, float]] = []

    def say(text: str, share: float) -> None:
        at[:] = [(text, share)]
        tell(text, share)

    def column(number: int, count: int) -> None:
        tell(f"{at[0][0]}, derivative {number} of {count}", at[0][1])

    windows = model.windows(given)
    say(f"taking up {model.fmu.path.name}", 0.02)
    noise = noise_of(model, given)
    model, used = coupled(model, windows, noise), 0
    for _ in range(_COUPLINGS):
        simulator, method = simulator_of(model, windows, noise, exact)
        if isinstance(simulator, BlackBox):
            simulator.say = column
        solver = Solver(model, windows, simulator, noise)
        if not used and np.any(solver.relative_errors() >= 1.0):
            _try_one_window(solver, noise, exact, iterations, say)
            say("fitting all windows", 0.05)
        used += solver.solve(iterations, say)
        fitted = model.with_values(solver.values)
        finer = coupled(fitted, windows, noise)
        if hold_of(finer) > _FINER * hold_of(model):
            break
        model = finer
    say("standard errors", 0.95)
    stderr, correlation = solver.errors()
    edge = at_bounds(solver.values, model.bounds())
    at_bound = tuple(n for n in solver.names if n in edge)
    stderr = {n: None if n in at_bound else e for n, e in stderr.items()}
    kept = tuple(n for n in fitted.notes if _USED_UP not in n)
    if not solver.settled:
        kept = (*kept, f"{model.fmu.path.name}: its {used} {_USED_UP}")
    fitted = replace(fitted, notes=kept)
    say("done", 1.0)
    return UserFit(
        fitted,
        stderr,
        unmoved=tuple(n for n in model.values if n not in solver.names),
        at_bound=at_bound,
        correlation=correlation,
        method=method,
        iterations=used,
        train=comparison_of(fitted, given, windows, solver.predicted),
        records=tuple(given),
        settled=solver.settled,
    )


def _try_one_window(
    solver: Solver, noise: FloatArray, exact: bool, iterations: int, say: Progress
) -> None:
    """Fit the window that moves most alone: what no values fit to one window they fit to no record,
    and all windows take as many times as long.

    Raises
    ------
    InputError
        Where a position or velocity that moves in the window is further off in the end than if it
        stood still; another output may have an offset that the FMU does not know.
    """
    model, windows = solver.model, solver.windows
    if len(windows) < 2:
        return
    moves = np.array([np.std(w.outputs, axis=0) for w in windows]) / solver.size
    one = int(np.argmax(moves.sum(axis=1)))
    judged = moves[one] >= moves.mean(axis=0)
    judged &= [m.channel.endswith(("_position", "_velocity")) for m in model.outputs]
    simulator = simulator_of(model, [windows[one]], noise, exact)[0]
    alone = Solver(model, [windows[one]], simulator, noise)
    say(f"fitting one of {len(windows)} windows", 0.04)
    off, last = np.where(judged, alone.relative_errors(), 0.0), math.inf
    for _ in range(iterations):
        if off.max() < 1.0:
            return
        size = float(np.sum(np.log(alone.relative_errors())))
        if size > last - ROUGH:  # together they fall by less than is worth a step
            break
        last = size
        alone.solve(1)
        off = np.where(judged, alone.relative_errors(), 0.0)
    worst = int(np.argmax(off))
    if off[worst] >= 1.0:
        time = windows[one].time
        raise InputError(
            f"{model.fmu.path.name}: no values of its parameters bring "
            f"{model.outputs[worst].channel} nearer to the record than standing still, not even "
            f"over one window of {time[-1] - time[0]:.2g} s alone (off by {off[worst]:.2g} times "
            "its motion): check gear_ratio, and its scale and sign in [model.channels] and "
            "[model.start]"
        )


def simulator_of(
    model: UserModel, windows: Sequence[Window], noise: FloatArray, exact: bool = True
) -> tuple[Simulator, str]:
    """The best simulator that the FMU allows, and a sentence on it; `noise` as in
    :class:`irj_fmu.imported.sensitivity.BlackBox`.
    """
    if not exact:
        return BlackBox(model, windows, noise), "black box: difference quotients over whole runs"
    try:
        return Exact(
            model, windows
        ), "exact derivatives through CasADi's import, checked against difference quotients"
    except (NotExact, FmuError) as error:
        return BlackBox(model, windows, noise), f"black box: {error}"


@final
class Outputs:
    """Errors of the outputs of an FMU, window by window; a
    :class:`identification.fitting.least_squares.LocalProblem`.

    Parameters
    ----------
    values : mapping of str to float
        Of every parameter; those not in `names` stay.
    names : sequence of str
        The parameters that move.
    sigma : (outputs,) array
        What the errors of each output are divided by.
    say : callable, optional
        Called with the number of the step before its derivatives are made.
    """

    def __init__(
        self,
        windows: Sequence[Window],
        simulator: Simulator,
        values: Mapping[str, float],
        names: Sequence[str],
        sigma: FloatArray,
        say: Callable[[int], None] | None = None,
    ) -> None:
        self.windows, self.simulator, self.values, self.names, self.sigma = (
            windows,
            simulator,
            dict(values),
            tuple(names),
            sigma,
        )
        self.steps = 0
        self._say = say

    def at(self, x: FloatArray) -> dict[str, float]:
        """Values of every parameter."""
        return {**self.values, **dict(zip(self.names, map(float, x), strict=True))}

    def costs(self, x: FloatArray, local: FloatArray) -> FloatArray:
        """Sum of squares of each window; infinite where the FMU fails."""
        try:
            predicted = self.simulator.simulate(self.at(x), local)
        except (FmuError, InputError):
            return np.full(len(self.windows), np.inf)
        return np.array(
            [
                float(np.sum(((y - w.outputs) / self.sigma) ** 2))
                for w, y in zip(self.windows, predicted, strict=True)
            ]
        )

    def rows(self, x: FloatArray, local: FloatArray) -> list[FloatArray]:
        """Columns of each window (samples x outputs, k): start values, parameters, error."""
        predicted, jacobian = self.simulator.sensitivities(self.at(x), local, self.names)
        count, out = len(self.names), []
        for w, y, j in zip(self.windows, predicted, jacobian, strict=True):
            whole = (
                np.concatenate(
                    [j[:, :, count:], j[:, :, :count], (y - w.outputs)[:, :, None]], axis=2
                )
                / self.sigma[:, None]
            )
            out.append(whole.reshape(-1, whole.shape[2]))
        return out

    def triangles(self, x: FloatArray, local: FloatArray) -> FloatArray:
        """Triangle of each window."""
        self.steps += 1
        if self._say is not None:
            self._say(self.steps)
        return np.array([triangle_of(rows) for rows in self.rows(x, local)])


@final
class Solver:
    """The fit of an FMU: which parameters move, their values, the start values of the windows.

    Attributes
    ----------
    values : dict
        Of the moving parameters and of those that move no output.
    names : list of str
        Parameters that move an output.
    starts : (windows, starts) array
    predicted : list of (n, outputs) array
    settled : bool
        The steps came to rest; False where they were used up before.
    """

    def __init__(
        self,
        model: UserModel,
        windows: Sequence[Window],
        simulator: Simulator,
        noise: FloatArray,
        frozen: bool = False,
    ) -> None:
        self.model, self.windows, self.simulator = model, tuple(windows), simulator
        self.values = dict(model.values)
        self._frozen = frozen
        self.bounds = model.bounds()
        self.starts = start_values(self.windows)
        measured = np.concatenate([w.outputs for w in self.windows])
        self.size = np.maximum(np.std(measured, axis=0), 1e-300)
        self.noise = np.maximum(noise, 1e-9 * self.size)
        self.sigma = self.size.copy()
        self.predicted = simulator.simulate(self.values, self.starts)
        self.settled = False
        self._names: list[str] | None = None

    @property
    def names(self) -> list[str]:
        """Found when they are asked for: that takes a run of every window for each parameter."""
        if self._names is None:
            self._names = self._moving()
        return self._names

    def _moving(self) -> list[str]:
        """Parameters that move an output here; a shape does not while its amplitude is 0."""
        if self._frozen:
            return []
        names = list(self.values)
        _, jacobian = self.simulator.sensitivities(self.values, self.starts, names)
        moved = {
            n: max(float(np.max(np.abs(j[:, :, i]) / self.size)) for j in jacobian)
            for i, n in enumerate(names)
        }
        return [n for n in names if moved[n] * scale_of(self.values[n], self.bounds[n]) > _MOVED]

    def relative_errors(self) -> FloatArray:
        """RMS error of each output, in what it would be of one that stays where each window begins:
        a model that begins there as well must be nearer to the record.
        """
        still = np.concatenate([w.outputs - w.outputs[:1] for w in self.windows])
        residual = np.concatenate(
            [w.outputs - y for w, y in zip(self.windows, self.predicted, strict=True)]
        )
        found: FloatArray = np.sqrt(
            np.mean(residual**2, axis=0) / np.maximum(np.mean(still**2, axis=0), 1e-300)
        )
        return found

    def _problem(self, say: Callable[[int], None] | None = None) -> Outputs:
        return Outputs(self.windows, self.simulator, self.values, self.names, self.sigma, say)

    def _x(self) -> FloatArray:
        return np.array([self.values[n] for n in self.names])

    def solve(self, iterations: int, say: Progress = lambda _text, _share: None) -> int:
        """Iterate to the end; the number of steps.

        Each output counts by its residual or, where that is less, by its noise. As long as these
        weights fall with the fit its minimum is that of other weights, and steps towards it would
        be steps elsewhere.
        """
        used, fine = 0, False
        before: FloatArray | None = None
        while used < iterations:
            residual = np.concatenate(
                [w.outputs - y for w, y in zip(self.windows, self.predicted, strict=True)]
            )
            sigma = np.maximum(self.noise, np.sqrt(np.mean(residual**2, axis=0)))
            kept = before is not None and bool(np.all(np.abs(np.log(sigma / before)) < LIKE))
            if kept and fine:
                self.settled = True
                break
            fine, self.sigma, before = kept, sigma, sigma
            if fine and len(self.names) < len(self.values):
                self._names = self._moving()
            begun = used

            def tell(step: int, begun: int = begun) -> None:
                say(f"fitting, step {begun + step}", 0.95 - 0.9 * 0.85 ** (begun + step))

            problem = self._problem(tell)
            box = [self.bounds[n][0] for n in self.names], [self.bounds[n][1] for n in self.names]
            found = least_squares(
                problem,
                self._x(),
                box,
                local=self.starts,
                iterations=iterations - used,
                tolerance=ENOUGH / residual.size if fine else ROUGH,
            )
            used += found.iterations
            self.values, self.starts = problem.at(found.x), found.local
            self.predicted = self.simulator.simulate(self.values, self.starts)
        return used

    def errors(self) -> tuple[dict[str, float | None], dict[str, tuple[str, float]]]:
        """Standard errors from windows of time, and correlations."""
        n = len(self.names)
        stderr: dict[str, float | None] = dict.fromkeys(self.values)
        if not n:
            return stderr, {}
        parts, times = [], []
        for w, rows in zip(self.windows, self._problem().rows(self._x(), self.starts), strict=True):
            starts = rows.shape[1] - n - 1
            norms = np.linalg.norm(rows[:, :starts], axis=0)
            q = np.linalg.qr(rows[:, :starts] / np.where(norms > 0, norms, 1.0))[0]
            parts.append(rows[:, starts:] - q @ (q.T @ rows[:, starts:]))
            times.append(np.repeat(w.time, w.outputs.shape[1]))
        rows = np.concatenate(parts)
        theta, r = rows[:, :n], rows[:, n]
        spread, together = correlations(theta.T @ theta)
        found = window_errors(theta, r, windows_over(times))
        if found is None:
            left = [
                (w.outputs - y) / self.sigma
                for w, y in zip(self.windows, self.predicted, strict=True)
            ]
            found = process_errors(theta, r, left)
        correlation = {}
        for i, name in enumerate(self.names):
            error = float(found[i])
            stderr[name] = error if spread[i] < _SPREAD and math.isfinite(error) else None
            if n > 1:
                other = int(np.argmax(np.abs(together[i])))
                correlation[name] = (self.names[other], float(together[i, other]))
        return stderr, correlation


__all__ = ["Outputs", "Solver", "UserFit", "fit", "parameter_table", "simulator_of"]
