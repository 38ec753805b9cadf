"""Memory of a recursive estimator and the two ways to run its step: interpreted and compiled."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache, partial
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.recursive.compiler import NoCompilerError, build
from identification.recursive.settings import FloatArray, Settings, fill_config, start_state
from identification.recursive.ud_codegen import Formulas, formulas, replay_source

_LONG_RECORD = 100_000  # samples; under this the interpreter is done before a compiler would be
LONGEST_SOURCE: Final = 4_000_000
"""Characters of C up to which a step is compiled: 0.3 million take seconds, the 9.7 million of a
joint with a learned curve took five minutes, in which the interpreted step has done a record."""
_CHUNK = 5_000_000  # samples per call of the compiled replay, so that an interrupt is seen


class RunOutcome(Enum):
    """How a record was run; the value is the sentence a user reads."""

    COMPILED = "Replayed by compiled C."
    INTERPRETED = "Run by the interpreter, as asked or because the record is short."
    NO_COMPILER = "Run by the interpreter, about ten times slower: no C compiler worked."


@final
@dataclass(frozen=True)
class Trajectory:
    """What a run did, one row per kept sample.

    Attributes
    ----------
    theta
        Estimates after the sample, shape (rows, parameters), user units.
    error
        A priori errors, shape (rows, outputs), units of y; zero where the sample was skipped.
    forgetting
        Forgetting factor, shape (rows,).
    skipped, alarm, frozen
        Sample skipped; alarm active; any parameter or every output without excitation; shape
        (rows,).
    outcome
        A `RunOutcome`.
    note
        Why no compiler worked, else empty.
    """

    theta: FloatArray
    error: FloatArray
    forgetting: FloatArray
    skipped: npt.NDArray[np.bool_]
    alarm: npt.NDArray[np.bool_]
    frozen: npt.NDArray[np.bool_]
    outcome: RunOutcome
    note: str = ""


@lru_cache(maxsize=32)
def _library(formula: Formulas) -> tuple[Any, str]:
    """The compiled replay, or None and the reason; one attempt per process."""
    source = replay_source(formula)
    if len(source) > LONGEST_SOURCE:
        n = formula.layout.n
        return None, f"{n} parameters make a step that takes minutes to compile"
    try:
        replay = build(source, "rls").rls_replay
    except NoCompilerError as error:
        return None, str(error)
    pointer = ctypes.c_void_p
    replay.argtypes = [ctypes.c_longlong, ctypes.c_longlong, *([pointer] * 8)]
    replay.restype = None
    return replay, ""


def _trigger(
    function: Any, arguments: list[FloatArray], results: list[FloatArray]
) -> Callable[[], None]:
    """A CasADi function bound to fixed memory."""
    buffer, trigger = function.buffer()
    for i, item in enumerate(arguments):
        buffer.set_arg(i, item.data)
    for i, item in enumerate(results):
        buffer.set_res(i, item.data)

    def call(
        _keep: tuple[Any, ...] = (buffer, arguments, results), run: Callable[[], None] = trigger
    ) -> None:
        run()

    return call


@final
class Engine:
    """State, configuration and functions of one estimator."""

    def __init__(
        self,
        theta0: FloatArray,
        scale: FloatArray,
        outputs: int,
        method: str,
        settings: Settings,
        walk: FloatArray | None,
        noise: FloatArray | None,
        alike: tuple[int, ...] | None = None,
    ) -> None:
        n = theta0.size
        self.freeze, self.walking = settings.freeze, walk is not None or method == "random_walk"
        self.formulas = formulas(n, outputs, method, self.freeze, self.walking, alike)
        layout = self.layout = self.formulas.layout
        self.config = fill_config(
            layout, method, theta0=theta0, scale=scale, settings=settings, walk=walk, noise=noise
        )
        self.fast, self.slow = np.zeros(layout.fast.size), np.zeros(layout.slow.size)
        self._fast_next, self._slow_next = np.zeros_like(self.fast), np.zeros_like(self.slow)
        self.y, self.h = np.zeros(outputs), np.zeros((outputs, n))
        self.theta, self._error, self._status = np.zeros(n), np.zeros(outputs), np.zeros(2)
        flags = self.slow[: n + 2 * outputs]
        out = [self.theta, self._error, self._status]
        rows = self.h.reshape(-1)
        self._step = _trigger(
            self.formulas.step,
            [self.fast, flags, self.config, self.y, rows],
            [self._fast_next, *out],
        )
        self._check = _trigger(
            self.formulas.check,
            [self._fast_next, self.slow, self.config],
            [self.fast, self._slow_next],
        )
        self._native: Any = None
        self._native_step: Callable[[], None] | None = None
        self._due = int(layout.fast["due"].start)
        self.start(theta0, None)

    def start(self, theta: FloatArray, covariance: FloatArray | None) -> None:
        """Before the first sample: theta and its covariance (None: P0), user units."""
        layout, scale = self.layout, self.part("config", "scale")
        self.fast[:], self.slow[:] = start_state(layout, theta, self.config)
        self.theta[:] = theta
        if covariance is None:
            return
        scaled = covariance / np.outer(scale, scale) * self.part("config", "start")[0]
        upper = np.linalg.cholesky(scaled[::-1, ::-1])[::-1, ::-1]
        diagonal = np.diag(upper)
        unit = upper / diagonal
        self.part("fast", "d")[:] = diagonal**2
        self.part("fast", "u")[:] = [unit[i, j] for j in range(layout.n) for i in range(j)]

    def part(self, block: str, name: str) -> FloatArray:
        """View of a named part of "fast", "slow" or "config"."""
        memory: FloatArray = {"fast": self.fast, "slow": self.slow, "config": self.config}[block]
        where: slice = getattr(self.layout, block)[name]
        return memory[where]

    def covariance(self) -> FloatArray:
        """P in scaled parameters."""
        n = self.layout.n
        unit = np.eye(n)
        packed = iter(self.part("fast", "u"))
        for j in range(n):
            for i in range(j):
                unit[i, j] = next(packed)
        found: FloatArray = (unit * self.part("fast", "d")) @ unit.T
        return found

    def load(self, values: FloatArray) -> None:
        """Take over fast, slow and config, one after the other."""
        first, second = self.fast.size, self.fast.size + self.slow.size
        self.fast[:], self.slow[:], self.config[:] = (
            values[:first],
            values[first:second],
            values[second:],
        )
        self.theta[:] = self.part("fast", "theta") * self.part("config", "scale")

    def advance(self) -> None:
        """One step on the sample in `y` and `h`."""
        if self._native_step is not None:
            self._native_step()
            return
        self._step()
        if self._fast_next[self._due]:
            self._check()
            self.slow[:] = self._slow_next
        else:
            self.fast[:] = self._fast_next

    def compile(self) -> tuple[RunOutcome, str]:
        """Load the compiled step, building it where needed; without a compiler all stays
        interpreted.
        """
        self._native, note = _library(self.formulas)
        if self._native is None:
            return RunOutcome.NO_COMPILER, note
        memory = (
            self.y,
            self.h,
            self.fast,
            self.slow,
            self.config,
            self.theta,
            self._error,
            self._status,
        )
        one = ctypes.c_longlong(1)
        self._native_step = partial(
            self._native, one, one, *(ctypes.c_void_p(item.ctypes.data) for item in memory)
        )
        return RunOutcome.COMPILED, ""

    def replay(
        self, y: FloatArray, h: FloatArray, stride: int, compiled: bool | None
    ) -> Trajectory:
        """All samples of a record; `compiled` as in `RecursiveLeastSquares.run`."""
        rows = y.shape[0] // stride
        theta, error, status = (
            np.empty((rows, self.theta.size)),
            np.empty((rows, self.y.size)),
            np.empty((rows, 2)),
        )
        outcome, note = RunOutcome.INTERPRETED, ""
        if compiled is not False and (
            compiled or self._native is not None or y.shape[0] >= _LONG_RECORD
        ):
            outcome, note = self.compile()
        if outcome is RunOutcome.COMPILED:
            chunk = stride * max(1, _CHUNK // stride)
            for first in range(0, y.shape[0], chunk):
                row = first // stride
                part = slice(first, min(first + chunk, y.shape[0]))
                self._native(
                    part.stop - first,
                    stride,
                    *(
                        item.ctypes.data
                        for item in (
                            y[part],
                            h[part],
                            self.fast,
                            self.slow,
                            self.config,
                            theta[row:],
                            error[row:],
                            status[row:],
                        )
                    ),
                )
            self.theta[:] = self.part("fast", "theta") * self.part("config", "scale")
        else:
            self._interpret(y, h, stride, theta, error, status)
        code = status[:, 1].astype(np.int64)
        return Trajectory(
            theta,
            error,
            forgetting=status[:, 0].copy(),
            skipped=(code & 1) > 0,
            alarm=(code & 2) > 0,
            frozen=(code & 4) > 0,
            outcome=outcome,
            note=note,
        )

    def _interpret(
        self,
        y: FloatArray,
        h: FloatArray,
        stride: int,
        theta: FloatArray,
        error: FloatArray,
        status: FloatArray,
    ) -> None:
        native, self._native_step = self._native_step, None
        for k in range(y.shape[0]):
            self.y[:] = y[k]
            self.h[:] = h[k]
            self.advance()
            if (k + 1) % stride == 0:
                row = k // stride
                theta[row], error[row], status[row] = self.theta, self._error, self._status
        self._native_step = native
