"""The on-line two-step algorithm inside the estimator: when to search the shapes, a portion per
sample (thesis 3.7).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.linear.triangle import single_thread
from identification.online.options import OnlineOptions, held_parameters
from identification.online.rows import RowMaker
from identification.online.shapes.rows import RowWindow, ShapedBalances, shape_parameters
from identification.online.shapes.search import Found, Recursion, Task, nothing, search
from identification.two_step.algorithm import Mode, OnlineSettings, TwoStepSettings
from identification.two_step.online import PortionedTask

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_WINDOW: Final = 32.0
"""Rows kept for a search [s]; a search on fewer is refined once there are half and all of so
many.
"""
_TUNING: Final = TwoStepSettings(max_evaluations=400)
_PLAIN: Final = ("_rows", "_quiet_until", "_failures", "searches", "_asked", "_since", "_refine_at")
_ARRAYS: Final = ("_signals", "_shares", "_on", "_points", "eta", "deviation")
_TASK: Final = ("weight", "eta", "theta", "level", "least", "noise")


@final
class Reoptimiser:
    """Keeps the rows of the last seconds, watches the residuals, and searches the shapes when they
    ask for it.

    Parameters
    ----------
    rows : RowMaker
        With shapes, of the same joint as the one in use.
    portions : int
        Portions of a search per sample.
    known : bool
        The shapes have values that a fit has found: the first window starts no search.

    Attributes
    ----------
    mode : Mode
    eta, deviation : (shapes,) array
        Shapes and their standard deviations, 0 before a search.
    searches : int
        Searches begun so far.
    """

    _task: PortionedTask[Found] | None = None

    def __init__(self, rows: RowMaker, portions: int, *, known: bool) -> None:
        import scipy.optimize  # noqa: F401  imported here and not inside a step

        self.rows, self.portions, self.known = rows, portions, known
        self.balances = ShapedBalances(rows)
        period = rows.timing.stride * rows.timing.dt
        self.settings = OnlineSettings(sample_time=period)
        self._limit = self.settings.samples(_WINDOW)
        self._confirm = self.settings.samples(self.settings.confirm_seconds)
        self._start = rows.shape_values.copy()
        self.job: Task | None = None
        self.reset()

    def reset(self) -> None:
        """Before the first sample; a running search ends."""
        self._cancel()
        count, new = len(self.rows.balances), self.rows.timing.stride // self.rows.timing.step
        self._signals, self._shares = (
            np.zeros((2 * self._limit, len(self.rows.signals))),
            np.zeros((2 * self._limit, 2)),
        )
        self._on, self._points = (
            np.zeros((2 * self._limit, count)),
            np.zeros((2 * self._limit, new, len(self.balances.used))),
        )
        self._used = list(self.balances.used)
        self._rows = self._held = 0
        self.mode = Mode.COLLECTING
        self.eta = self._start.copy()
        self.deviation = np.zeros(len(self.eta))
        self.searches = self._quiet_until = self._failures = 0
        self._asked = self.active = False
        self._since, self._refine_at = 0, -1

    @property
    def searching(self) -> bool:
        """True while a search runs."""
        return self._task is not None

    def ask(self) -> None:
        """Search as soon as there are rows enough, whatever the residuals say."""
        self._asked = True

    # --- rows -------------------------------------------------------------------------------------

    def keep(
        self, points: FloatArray, signals: FloatArray, shares: FloatArray, on: BoolArray
    ) -> None:
        """Store a row."""
        if self._held == len(self._signals):
            for ring in (self._signals, self._shares, self._on, self._points):
                ring[: self._limit] = ring[self._limit :].copy()
            self._held = self._limit
        at = self._held
        self._signals[at], self._shares[at], self._on[at], self._points[at] = (
            signals,
            shares,
            on,
            points[:, self._used],
        )
        self._held, self._rows = at + 1, self._rows + 1

    def forget(self, count: int) -> None:
        """Leave the last rows out of every search, and end one that runs: a sensor had failed."""
        if self._task is not None:
            self._cancel()
            self.mode = Mode.RECURSIVE
        whole = count + self.settings.samples(2.0)
        self._on[max(0, self._held - whole) : self._held] = 0.0

    def window(self) -> RowWindow:
        """Copies of the rows kept, as far back as the present shapes may hold."""
        count = min(self._limit, self._held, max(self._rows - self._since, self._confirm))
        part = slice(self._held - count, self._held)
        return RowWindow(
            self._signals[part].copy(),
            self._shares[part].copy(),
            self._on[part] > 0,
            self._points[part].copy(),
        )

    def reshaped(self, eta: FloatArray, deviation: FloatArray, before: RowMaker) -> RowMaker:
        """The rows to go on with: those of the shapes `eta`, where the rows `before` stand."""
        part = self._points[max(0, self._held - self.balances.lead) : self._held].reshape(
            -1, len(self._used)
        )
        points = np.zeros((len(part), len(self.rows.signals)))
        points[:, self._used] = part
        self.eta, self.deviation, self.active = eta, deviation, True
        self.rows.set_shapes(eta)
        self.rows.take_over(before, points)
        return self.rows

    def due(self, strained: int) -> bool:
        """True where a search should begin now; `strained` rows in a row have been over the
        limit.
        """
        if strained == self._confirm:
            self._since, self._refine_at = self._rows - self._confirm, -1
        if (
            self._task is not None
            or self._rows < self._confirm
            or self._on[self._held - 1].min() == 0.0
        ):
            return False
        if 0 <= self._refine_at <= self._rows:
            self._asked = True
        return self._asked or (strained >= self._confirm and self._rows >= self._quiet_until)

    # --- search -----------------------------------------------------------------------------------

    def launch(
        self,
        weight: FloatArray,
        theta: FloatArray,
        *,
        level: FloatArray,
        least: FloatArray,
        noise: FloatArray,
        recursion: Recursion,
        first: bool = False,
    ) -> None:
        """Begin a search on the rows kept; `weight` as in :class:`Task`, for the rows of
        :meth:`window`.
        """
        self.job = Task(
            self.window(),
            weight[self.balances.lead :],
            eta=self.eta.copy(),
            theta=theta.copy(),
            level=level.copy(),
            least=least.copy(),
            noise=noise,
            first=first,
            forced=self._asked,
            local=self._failures >= self.settings.passes,
        )
        self._asked = False
        kept = len(self.job.window.signals)
        wanted = next((n for n in (self._limit // 2, self._limit) if kept < n), -1)
        self._refine_at = self._since + wanted if wanted > 0 and not self.job.local else -1
        self.searches += 1
        self.mode = Mode.STARTING if first else Mode.REOPTIMISING
        self._begin(recursion)

    def _begin(self, recursion: Recursion) -> None:
        if self.job is None:
            return
        work = partial(
            search, *(self.job, self.balances, self.rows.model, self.settings, _TUNING, recursion)
        )
        self._task = PortionedTask(work, free=False)

    def advance(self) -> Found | None:
        """Do the portions of a sample; the result where the search has ended."""
        task = self._task
        if task is None:
            return None
        with single_thread():
            if not task.advance(self.portions):
                return None
        job, self._task, self.job = self.job, None, None
        self.mode = Mode.RECURSIVE
        try:
            found = task.result()
        except (InputError, ArithmeticError, np.linalg.LinAlgError) as error:
            if job is None:
                return None
            found = nothing(job, f"the search failed: {error}", good=False)
        self._failures = 0 if found.good else self._failures + 1
        self._quiet_until = self._rows + self.settings.samples(
            self.settings.rest_seconds
        ) * 2 ** min(self._failures, 6)
        return found

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()
        self._task = self.job = None

    def __del__(self) -> None:
        self._cancel()

    # --- state ------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, Any], dict[str, FloatArray]]:
        """Everything that changes; of a running search what it started from and how far it is."""
        plain: dict[str, Any] = {name: getattr(self, name) for name in _PLAIN} | {
            "mode": self.mode.name,
            "active": self.active,
        }
        arrays: dict[str, FloatArray] = {name: getattr(self, name) for name in _ARRAYS}
        for name in ("_signals", "_shares", "_on", "_points"):
            arrays[name] = arrays[name][max(0, self._held - self._limit) : self._held]
        if self.job is not None and self._task is not None:
            job = self.job
            plain["job"] = [job.first, job.forced, job.local, self._task.granted]
            window = job.window
            arrays |= {
                "job_signals": window.signals,
                "job_shares": window.shares,
                "job_on": window.on.astype(float),
                "job_points": window.points,
            }
            arrays |= {f"job_{name}": getattr(job, name) for name in _TASK}
        return plain, arrays

    def restore(
        self, plain: Mapping[str, Any], arrays: Mapping[str, FloatArray], recursion: Recursion
    ) -> None:
        """Take up what :meth:`state` gave; a search is repeated up to where it was."""
        self.reset()
        for name in _PLAIN:
            setattr(self, name, plain[name])
        self.mode, self.active = Mode[plain["mode"]], bool(plain["active"])
        rows = len(arrays["_signals"])
        for name in ("_signals", "_shares", "_on", "_points"):
            getattr(self, name)[:rows] = arrays[name]
        self._held = rows
        self.eta, self.deviation = arrays["eta"], arrays["deviation"]
        self.rows.set_shapes(self.eta)
        if "job" not in plain:
            return
        first, forced, local, granted = plain["job"]
        window = RowWindow(
            arrays["job_signals"], arrays["job_shares"], arrays["job_on"] > 0, arrays["job_points"]
        )
        weight, eta, theta, level, least, noise = (arrays[f"job_{n}"] for n in _TASK)
        self.job = Task(
            window,
            weight,
            eta=eta,
            theta=theta,
            level=level,
            least=least,
            noise=noise,
            first=bool(first),
            forced=bool(forced),
            local=bool(local),
        )
        self._begin(recursion)
        if self._task is not None and granted:
            with single_thread():
                self._task.advance(int(granted))


def make_two_step(joint: Joint, rows: RowMaker, options: OnlineOptions) -> Reoptimiser | None:
    """The on-line two-step algorithm of a joint; None where it is switched off or there are no
    shapes to search.
    """
    if not options.optimise:
        return None
    held = held_parameters(joint)
    shapes = shape_parameters(rows.model, rows.sensing, rows.names, held)
    if not shapes:
        return None
    known = all(n in joint.fitted for n in shapes)
    return Reoptimiser(
        RowMaker(rows.model, rows.sensing, rows.timing.dt, held, shapes),
        options.portions,
        known=known,
    )
