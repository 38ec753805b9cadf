"""Two-step identification: linear parameters by least squares, nonlinear ones by a global
search (thesis 3.6, 3.7).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.recursive.estimator import RecursiveLeastSquares, Settings
from identification.two_step.online import (
    Event,
    Mode,
    OnlineSettings,
    PortionedTask,
    Window,
    pack,
    unpack,
)
from identification.two_step.varpro_fit import TwoStepFit, TwoStepOutcome, fit
from identification.two_step.varpro_model import (
    JOINT_CHANNELS,
    Coefficient,
    SeparableModel,
    Shape,
    from_casadi,
    from_joint,
    joint_shape,
    smooth_friction,
    velocity_box,
)
from identification.two_step.varpro_search import Method, TwoStepSettings
from identification.two_step.varpro_window import linear_fit, reweighted, search_window, simplex_fit

__all__ = [
    "JOINT_CHANNELS",
    "Coefficient",
    "Event",
    "Mode",
    "OnlineSettings",
    "SeparableModel",
    "Shape",
    "TwoStep",
    "TwoStepFit",
    "TwoStepOutcome",
    "TwoStepSettings",
    "from_casadi",
    "from_joint",
    "joint_shape",
    "smooth_friction",
    "velocity_box",
]
FloatArray = npt.NDArray[np.float64]


@final
class TwoStep:
    """Two-step identification, off line (:meth:`fit`) and on line (:meth:`update`).

    Parameters
    ----------
    model : SeparableModel
        See :func:`from_joint`, :func:`from_casadi`, :func:`smooth_friction`.
    method
        "variable_projection" (default): the coefficients are eliminated inside the objective 1/2
        ||e||^2. "alternating": the thesis's form, linear least squares and MCS in turn until the
        parameters rest.
    weights
        1 / noise deviation of each output, shape (outputs,); None: from the
        residuals of a first fit.
    settings : TwoStepSettings, optional
    online : OnlineSettings, optional
    recursive : identification.recursive.estimator.Settings, optional
        Of the recursive least squares used on line.

    Examples
    --------
    >>> import numpy as np
    >>> velocity = 0.26 * np.sin(2 * np.pi * np.arange(0, 20, 0.01) / 1.9)
    >>> torque = 9 * velocity + 29 * np.tanh(velocity / 0.0595) + 480 * velocity *
    np.exp(-abs(velocity) / 0.0251)
    >>> found = TwoStep(smooth_friction(velocity)).fit(torque, velocity)
    >>> {name: round(value, 4) for name, value in found.nonlinear.items()}
    {'w1': 0.0595, 'wS': 0.0251}
    """

    def __init__(
        self,
        model: SeparableModel,
        method: Method = "variable_projection",
        *,
        weights: npt.ArrayLike | None = None,
        settings: TwoStepSettings | None = None,
        online: OnlineSettings | None = None,
        recursive: Settings | None = None,
    ) -> None:
        if method not in ("variable_projection", "alternating"):
            raise InputError(
                f"TwoStep: unknown method {method!r}; use 'variable_projection' or 'alternating'"
            )
        self.model, self.method = model, method
        self.settings = settings or TwoStepSettings()
        self.online = online or OnlineSettings()
        self._recursive = recursive or Settings(
            sample_time=self.online.sample_time, window_seconds=2.0
        )
        self._weights = None if weights is None else _weights(weights, model.outputs)
        self._task: PortionedTask[TwoStepFit] | None = None
        self.reset()

    # --- off line ---------------------------------------------------------------------------------

    def fit(
        self, y: npt.ArrayLike, signals: npt.ArrayLike, *, start: Mapping[str, float] | None = None
    ) -> TwoStepFit:
        """Fit a whole record.

        Parameters
        ----------
        y : (n,) or (n, outputs) array
        signals : (n,) or (n, channels) array
        start : mapping, optional
            Shape parameters to start from: a local search from there, without the global one.

        Raises
        ------
        InputError
            Shapes that do not fit, or fewer usable samples than parameters. Rows with NaN are left
            out.
        """
        values, rows = _table(y, "y"), _table(signals, "signals")
        if len(values) != len(rows) or values.shape[1] != self.model.outputs:
            raise InputError(
                f"TwoStep.fit: y has shape {values.shape} and signals {rows.shape}; give (n, "
                f"{self.model.outputs}) and (n, channels)"
            )
        for name, value in (start or {}).items():
            if not np.isfinite(value):
                raise InputError(
                    f"TwoStep.fit: the start value of {name} is {value!r}; give a finite number"
                )
        weights = self._weights if self._weights is not None else _spread(values)
        again = self._weights is None and self.model.outputs > 1
        first = replace(self.settings, freeze=False) if again else self.settings
        found = fit(
            self.model, values, rows, weights, method=self.method, settings=first, start=start
        )
        if again:
            found = reweighted(
                self.model, values, rows, found, method=self.method, settings=self.settings
            )
        return found

    # --- on line ----------------------------------------------------------------------------------

    def reset(self) -> None:
        """Back to the first window; nothing is kept."""
        self._cancel()
        self.mode = Mode.COLLECTING
        self.events: list[Event] = []
        self.nonlinear: FloatArray = self.model.nominal
        self.searches = 0
        self.error_norm = 0.0
        self._window: Window | None = None
        self._estimator: RecursiveLeastSquares | None = None
        self._noise = np.ones(self.model.outputs)
        self._samples = self._since = self._quiet_until = self._failures = 0
        self._task_arrays: tuple[FloatArray, FloatArray] = (np.zeros((0, 0)), np.zeros((0, 0)))
        self._task_warm = False
        self._start: tuple[FloatArray, FloatArray] = (np.zeros(0), np.zeros(0))

    @property
    def theta(self) -> FloatArray:
        """Coefficients now, shape (coefficients,); zero before the first fit."""
        return (
            np.zeros(len(self.model.coefficients))
            if self._estimator is None
            else self._estimator.theta
        )

    @property
    def values(self) -> dict[str, float]:
        """All parameters now, by name."""
        linear = dict(zip(self.model.names, self.theta.tolist(), strict=True))
        return {**linear, **dict(zip(self.model.shape_names, self.nonlinear.tolist(), strict=True))}

    @property
    def estimator(self) -> RecursiveLeastSquares | None:
        """The recursive least squares in use (to hold parameters, raise R2); None before the
        first fit.
        """
        return self._estimator

    def update(self, y: npt.ArrayLike, signals: npt.ArrayLike) -> FloatArray:
        """One sample: y (outputs,), signals (channels,); gives the coefficients (coefficients,).

        A sample with NaN is not kept, and the recursion skips it.
        """
        value = np.atleast_1d(np.asarray(y, dtype=np.float64))
        row = np.atleast_1d(np.asarray(signals, dtype=np.float64))
        if self._window is None:
            length = self.online.samples(
                max(self.online.collect_seconds, self.online.confirm_seconds)
            )
            self._window = Window(length, self.model.outputs, row.size)
        if (
            value.shape != (self.model.outputs,)
            or row.size != self._window.rows.shape[1] - self.model.outputs
        ):
            raise InputError(
                f"TwoStep.update: y has shape {value.shape} and signals {row.shape}; keep them "
                "the same"
            )
        self._samples += 1
        if np.isfinite(value).all() and np.isfinite(row).all():
            self._window.add(value, row)
            if self._estimator is not None:
                self._recurse(value, row)
        if self.mode is Mode.COLLECTING:
            self._collect()
        elif self.mode is Mode.RECURSIVE:
            if self.error_norm > self.online.error_limit and self._samples >= self._quiet_until:
                self._since = self._samples
                self._enter(
                    Mode.CONFIRMING,
                    f"error norm {self.error_norm:.2f}, limit {self.online.error_limit:g}",
                )
        elif self.mode is Mode.CONFIRMING:
            if self._samples - self._since >= self.online.samples(self.online.confirm_seconds):
                self._confirm()
        else:
            self._search()
        return self.theta

    def _enter(self, mode: Mode, why: str) -> None:
        self.mode = mode
        self.events.append(Event(self._samples, mode, why))

    def _recurse(self, value: FloatArray, row: FloatArray) -> None:
        estimator = self._estimator
        if estimator is None:
            return
        signals = row[None, :]
        phi = self.model.matrix(signals, self.nonlinear)[0]
        left = (
            value - self.model.remainder(signals, self.nonlinear)[0] if self.model.rest else value
        )
        estimator.update(left, phi)
        error = estimator.error / self._noise
        rate = self.online.sample_time / self.online.error_seconds
        square = self.error_norm**2
        self.error_norm = float(
            np.sqrt(square + rate * (min(float(np.mean(error**2)), 1e6) - square))
        )

    def _collect(self) -> None:
        """Steps 1 to 4 of 3.7: wait for the window and its rank."""
        window, online = self._window, self.online
        if window is None or window.count < online.samples(online.collect_seconds):
            return
        if self._samples % online.samples(0.25 * online.collect_seconds):
            return
        y, signals = window.last(window.count)
        try:
            lost = linear_fit(
                self.model, y, signals, self.nonlinear, _spread(y), limit=online.rank_limit
            ).lost
        except np.linalg.LinAlgError:
            raise InputError(
                "TwoStep.update: phi is not finite on the first window; check the model at these "
                "signals"
            ) from None
        if lost and self._samples < online.samples(online.collect_limit_seconds):
            self.events.append(Event(self._samples, self.mode, f"no rank yet: {', '.join(lost)}"))
            return
        self._noise = 1.0 / (self._weights if self._weights is not None else _spread(y))
        self._start_search(window.count, warm=False, mode=Mode.STARTING, why="the window is full")

    def _confirm(self) -> None:
        """Step 10: do linear parameters explain the samples since the alarm?"""
        window = self._window
        count = self._samples - self._since
        if window is None:
            return
        y, signals = window.last(count)
        found = linear_fit(
            self.model, y, signals, self.nonlinear, 1.0 / self._noise, limit=self.online.rank_limit
        )
        ratio = found.ratio
        if ratio <= self.online.confirm_limit:
            self._quiet_until = self._samples + self.online.samples(self.online.rest_seconds)
            self._enter(Mode.RECURSIVE, f"linear parameters explain it: {ratio:.2f} of the noise")
            return
        why = f"linear parameters leave {ratio:.2f} of the noise"
        self._start_search(count, warm=True, mode=Mode.REOPTIMISING, why=why)

    def _start_search(self, count: int, *, warm: bool, mode: Mode, why: str) -> None:
        """Begin the search on the last samples (steps 6 and 11)."""
        if self._window is None:
            return
        self.searches += mode is Mode.REOPTIMISING
        y, signals = self._window.last(count)
        self._task_arrays = (y, signals)
        self._task_warm = warm
        self._enter(mode, why)
        self._launch()

    def _launch(self) -> None:
        step = max(1, -(-len(self._task_arrays[0]) // self.online.window_samples))
        y, signals = (a[::step] for a in self._task_arrays)
        weights = 1.0 / self._noise
        start = (
            dict(zip(self.model.shape_names, self.nonlinear.tolist(), strict=True))
            if self._task_warm
            else None
        )
        fall_back = self._failures >= self.online.passes
        settings = self.settings
        reweigh = not self._task_warm and self._weights is None and self.model.outputs > 1
        first = replace(settings, freeze=settings.freeze and not self._task_warm and not reweigh)

        def work(tick: Any) -> TwoStepFit:
            if fall_back:
                return simplex_fit(
                    self.model,
                    y,
                    signals=signals,
                    weights=weights,
                    method=self.method,
                    settings=first,
                    start=start or {},
                    tick=tick,
                )
            found = search_window(
                self.model,
                y,
                signals=signals,
                weights=weights,
                method=self.method,
                settings=first,
                start=start,
                limit=self.online.confirm_limit,
                tick=tick,
            )
            if reweigh:
                found = reweighted(
                    self.model, y, signals, found, method=self.method, settings=settings, tick=tick
                )
            return found

        self._task = PortionedTask(work, free=self.online.search != "budget")
        if self.online.search == "blocking":
            self._task.result()
        self._search(begun=True)

    def _search(self, *, begun: bool = False) -> None:
        task = self._task
        if task is None:
            return
        if self.online.search == "budget" and not begun:
            task.advance(self.online.evaluations_per_step)
        if not task.finished():
            return
        self._task = None
        self._adopt(task.result())

    def _adopt(self, found: TwoStepFit) -> None:
        """Steps 7 to 9: take up the search's result and start the recursion from it."""
        first = self.mode is Mode.STARTING
        ratio = float(np.sqrt(np.mean((found.residual_deviation / self._noise) ** 2)))
        if first and self._weights is None:
            self._noise = np.maximum(found.residual_deviation, 1e-12)
        self.nonlinear = np.array([found.nonlinear[n] for n in self.model.shape_names])
        y, signals = self._task_arrays
        theta = found.theta
        spread = [
            d if np.isfinite(d) else 1.0 for d in (found.deviation[n] for n in self.model.names)
        ]
        self._estimator = self._built(theta, np.maximum(np.maximum(np.abs(theta), spread), 1e-9))
        left = y - self.model.remainder(signals, self.nonlinear)
        self._estimator.startup(
            left, self.model.matrix(signals, self.nonlinear), limit=self.online.rank_limit
        )
        good = first or ratio <= self.online.confirm_limit
        self._failures = 0 if good else self._failures + 1
        self.error_norm = 1.0
        self._quiet_until = self._samples + self.online.samples(
            self.online.rest_seconds
        ) * 2 ** min(self._failures, 6)
        note = "" if good else f"; {ratio:.2f} of the noise is left, the model may lack an effect"
        self._enter(Mode.RECURSIVE, f"{found.evaluations} evaluations: {found.outcome.value}{note}")

    def _built(self, theta: FloatArray, scale: FloatArray) -> RecursiveLeastSquares:
        self._start = (theta, scale)
        return RecursiveLeastSquares(
            theta,
            scale,
            outputs=self.model.outputs,
            names=self.model.names,
            R2=self._noise**2,
            settings=self._recursive,
        )

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()
            self._task = None

    # --- state ------------------------------------------------------------------------------------

    def state(self) -> bytes:
        """Everything the on-line algorithm will use again, as bytes.

        A search that runs in portions is repeated by :meth:`restore` up to the same evaluation, so
        the run goes on bit by bit; a background search begins anew.
        """
        searching = self._task is not None
        rows = np.zeros((0, 0)) if self._window is None else self._window.all_rows()
        task = self._task_arrays if searching else (np.zeros((0, 0)), np.zeros((0, 0)))
        numbers = {
            "mode": self.mode.name,
            "samples": self._samples,
            "since": self._since,
            "quiet": self._quiet_until,
            "failures": self._failures,
            "searches": self.searches,
            "window": self._window is not None,
            "searching": searching,
            "warm": bool(searching and self._task_warm),
            "granted": self._task.granted if self._task is not None else 0,
            "events": [[e.sample, e.mode.name, e.why] for e in self.events],
            "model": [*self.model.names, *self.model.shape_names],
        }
        arrays = {
            "nonlinear": self.nonlinear,
            "noise": self._noise,
            "error_norm": np.array([self.error_norm]),
            "rows": rows,
            "task_y": task[0],
            "task_signals": task[1],
            "theta0": self._start[0],
            "scale": self._start[1],
        }
        inner = b"" if self._estimator is None else self._estimator.state()
        return pack(numbers, arrays, {"estimator": inner})

    def restore(self, state: bytes) -> None:
        """Take up a state of an estimator with the same model and settings.

        Raises
        ------
        InputError
            The bytes are damaged or of another model.
        """
        numbers, arrays, parts = unpack(state)
        if numbers["model"] != [*self.model.names, *self.model.shape_names]:
            raise InputError("restore: the state is of another model; build the same model first")
        self.reset()
        self.mode = Mode[numbers["mode"]]
        self.events = [Event(s, Mode[m], w) for s, m, w in numbers["events"]]
        self.searches, self._samples, self._since = (
            numbers["searches"],
            numbers["samples"],
            numbers["since"],
        )
        self._quiet_until, self._failures = numbers["quiet"], numbers["failures"]
        self.nonlinear, self._noise = arrays["nonlinear"], arrays["noise"]
        self.error_norm = float(arrays["error_norm"][0])
        if numbers["window"]:
            length = self.online.samples(
                max(self.online.collect_seconds, self.online.confirm_seconds)
            )
            rows = arrays["rows"]
            self._window = Window(length, self.model.outputs, rows.shape[1] - self.model.outputs)
            self._window.load(rows)
        if parts["estimator"]:
            self._estimator = self._built(arrays["theta0"], arrays["scale"])
            self._estimator.restore(parts["estimator"])
        if numbers["searching"]:
            self._task_arrays, self._task_warm = (
                (arrays["task_y"], arrays["task_signals"]),
                numbers["warm"],
            )
            self._launch()
            if self._task is not None and numbers["granted"]:
                self._task.advance(numbers["granted"])


def _table(values: npt.ArrayLike, name: str) -> FloatArray:
    found = np.asarray(values, dtype=np.float64)
    found = found[:, None] if found.ndim == 1 else found
    if found.ndim != 2 or not len(found):
        raise InputError(f"TwoStep: {name} has shape {found.shape}; give one row per sample")
    return found


def _weights(values: npt.ArrayLike, outputs: int) -> FloatArray:
    found = np.broadcast_to(np.atleast_1d(np.asarray(values, dtype=np.float64)), (outputs,)).copy()
    if not (np.isfinite(found).all() and (found > 0).all()):
        raise InputError("TwoStep: weights must be positive and finite, one per output")
    return found


def _spread(y: FloatArray) -> FloatArray:
    """Weights that make the outputs alike in size; 1 for one output."""
    if y.shape[1] == 1:
        return np.ones(1)
    level = np.nanstd(y, axis=0)
    return 1.0 / np.where(level > 0, level, 1.0)
