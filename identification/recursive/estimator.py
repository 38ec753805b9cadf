"""Recursive least squares with a U-D factor: on-line estimation of parameters (thesis 3.2, 3.5,
4.3.3).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.recursive.engine import Engine, RunOutcome, Trajectory
from identification.recursive.inputs import doubles, positions, spread, variances, vector
from identification.recursive.prior_start import PriorStart, solve_with_prior
from identification.recursive.settings import MAX_PARAMETERS, METHODS, Settings, forgetting_curve
from identification.recursive.startup import Startup, StartupOutcome, solve_window

__all__ = [
    "METHODS",
    "RecursiveLeastSquares",
    "RunOutcome",
    "Settings",
    "Startup",
    "StartupOutcome",
    "Trajectory",
    "forgetting_curve",
]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_MAGIC = b"RLSUD\x00\x00\x01"
_HEADER = struct.Struct("<8sIIIIII")


@final
class RecursiveLeastSquares:
    """Estimates theta in y = H theta + noise, sample by sample.

    P is kept as U D U' (Bierman), so it stays symmetric and positive whatever the number of
    updates. Each parameter is scaled by its prior range. Several outputs share the parameters: one
    scalar update each.

    Parameters
    ----------
    theta0
        Start values, shape (parameters,), user units.
    scale
        Prior ranges: how far each parameter may lie from theta0, shape (parameters,) or one value
        for all, user units, positive. P starts as diag(scale^2).
    method
        How old samples are forgotten:

        - "random_walk" (default): each parameter drifts by `Settings.drift` of its scale per
          sqrt(s); more for a limited time after a chi-square alarm of the normalised innovation.
        - "bell": lambda falls with the relative error as a Gauss function (thesis 3.51).
        - "polynomial": 17th degree polynomial of the relative error. The thesis does not print its
          coefficients; these are fitted to the shape of its figure 3.5.
        - "schedule": lambda grows to 1 (thesis 3.50), lambda0 = 0.99, lambda(0) = 0.95.
        - "constant": one lambda (`Settings.forgetting`).
    outputs
        Number of outputs; None: taken from the first sample.
    names
        Names of the parameters for reports; None: theta[0], theta[1], ...
    R1
        Model covariance: variance each parameter gains per sample, shape (parameters,) or a
        diagonal matrix, user units squared. None: from `Settings.drift` for "random_walk", else
        zero.
    R2
        Measurement covariance: variance of each output's noise, shape (outputs,), one value, or a
        diagonal matrix. None: estimated from the innovations.
    settings
        A `Settings`.
    alike
        A number for each parameter; those of one number are control values of one curve, of which
        a motion shows a few at a time. None: each stands for itself.

    Raises
    ------
    InputError
        On shapes that do not fit, a scale that is not positive, an unknown method.

    Notes
    -----
    A sample with NaN or infinity in y or H of an enabled output is skipped and counted in
    `skipped`. Parameters that the sliding information matrix no longer carries are held
    (`excited`), and so is an output that has lost more than half of its parameters (`live`).
    diag(P) never passes `Settings.covariance_limit` times scale^2.

    Examples
    --------
    >>> estimator = RecursiveLeastSquares([0.0, 0.0], [10.0, 10.0])
    >>> for k in range(200):
    ...     h = [1.0, float(k % 7)]
    ...     theta = estimator.update(2.0 * h[0] - 3.0 * h[1], h)
    >>> [round(float(item), 3) for item in theta]
    [2.0, -3.0]
    """

    def __init__(
        self,
        theta0: npt.ArrayLike,
        scale: npt.ArrayLike,
        method: str = "random_walk",
        *,
        outputs: int | None = None,
        names: Sequence[str] | None = None,
        R1: npt.ArrayLike | None = None,
        R2: npt.ArrayLike | None = None,
        settings: Settings | None = None,
        alike: Sequence[int] | None = None,
    ) -> None:
        self._theta0 = vector(theta0, "theta0")
        n = self._theta0.size
        if not 1 <= n <= MAX_PARAMETERS:
            raise InputError(
                f"RecursiveLeastSquares: theta0 has {n} values; give 1 to {MAX_PARAMETERS} "
                "parameters"
            )
        self._scale = spread(vector(scale, "scale"), n, "scale", "parameters")
        if not np.all(self._scale > 0):
            raise InputError(
                "RecursiveLeastSquares: scale must be positive; give each parameter's prior range"
            )
        if method not in METHODS:
            raise InputError(
                f"RecursiveLeastSquares: unknown method {method!r}; use one of {', '.join(METHODS)}"
            )
        self._names = tuple(names) if names is not None else tuple(f"theta[{i}]" for i in range(n))
        if len(self._names) != n or len(set(self._names)) != n:
            raise InputError(
                f"RecursiveLeastSquares: names must be {n} different names, one per parameter"
            )
        self._method = method
        self._settings = settings or Settings()
        self._alike = None if alike is None else tuple(int(group) for group in alike)
        self._walk = None if R1 is None else variances(R1, n, "R1", "parameters", zero=True)
        self._noise = None if R2 is None else variances(R2, None, "R2", "outputs", zero=False)
        self._engine: Engine | None = None
        if outputs is None and self._noise is not None and self._noise.size > 1:
            outputs = self._noise.size
        if outputs is not None:
            if not isinstance(outputs, int) or outputs < 1:
                raise InputError(
                    f"RecursiveLeastSquares: outputs must be a whole number >= 1, not {outputs!r}"
                )
            self._build(outputs)

    # Estimation

    def update(self, y: npt.ArrayLike, H: npt.ArrayLike) -> FloatArray:
        """One sample: y (outputs,) and H (outputs, parameters); gives theta (parameters,), user
        units.

        With one output a number and a vector (parameters,) do as well.
        """
        engine = self._engine
        if (
            engine is None
            or type(y) is not np.ndarray
            or type(H) is not np.ndarray
            or y.shape != engine.y.shape
            or H.shape != engine.h.shape
            or y.dtype.kind != "f"
            or H.dtype.kind != "f"
        ):
            engine, y, H = self._arranged(y, H)
        engine.y[:] = y
        engine.h[:] = H
        engine.advance()
        theta: FloatArray = engine.theta.copy()
        return theta

    def run(
        self, Y: npt.ArrayLike, H: npt.ArrayLike, *, stride: int = 1, compiled: bool | None = None
    ) -> Trajectory:
        """A whole record, from the present state on; equal to `update` for each sample, bit by bit.

        Parameters
        ----------
        Y
            Outputs, shape (samples, outputs).
        H
            Regressors, shape (samples, outputs, parameters). With one output (samples,) and
            (samples, parameters).
        stride
            Keep the trajectory of every stride-th sample.
        compiled
            True: compiled C; False: interpreted; None: compiled for long records. Without a C
            compiler the run is interpreted and the trajectory's `outcome` says so.
        """
        if not isinstance(stride, int) or stride < 1:
            raise InputError(f"run: stride must be a whole number >= 1, not {stride!r}")
        engine, y, h = self._record(Y, H, "run")
        return engine.replay(y, h, stride, compiled)

    def compile(self) -> RunOutcome:
        """Build and load the compiled step now: `update` then costs a third. The numbers stay
        the same bit by bit.
        """
        return self.engine_for("compile").compile()[0]

    def startup(self, Y: npt.ArrayLike, H: npt.ArrayLike, *, limit: float = 1e-9) -> Startup:
        """Start values from a window of samples by SVD, (3.47) to (3.49).

        Parameters that the window cannot carry are removed: held at theta0 until `release`. The
        thesis takes 7 s of samples.

        Parameters
        ----------
        Y, H
            As in `run`.
        limit
            Singular-value limit, relative to the largest one of the scaled regressor.
        """
        if not 0 <= limit < 1:
            raise InputError(f"startup: limit must lie in [0, 1), not {limit!r}")
        engine, y, h = self._record(Y, H, "startup")
        noise = (
            engine.part("config", "noise_given")
            if engine.part("config", "noise_known").all()
            else None
        )
        found = solve_window(y, h, self._theta0, self._scale, self._names, limit=limit, noise=noise)
        engine.start(found.theta, found.covariance)
        engine.part("config", "free")[:] = 1.0
        engine.part("config", "free")[list(found.removed_index)] = 0.0
        if noise is None:
            engine.part("fast", "noise")[:] = found.residual_variance
            engine.part("fast", "learned")[:] = float(found.samples)
        return found

    def begin(
        self, Y: npt.ArrayLike, H: npt.ArrayLike, least: npt.ArrayLike, *, overlap: float = 1.0
    ) -> PriorStart:
        """Start from a window and the prior theta0 +- scale; no parameter is removed.

        Parameters
        ----------
        Y, H
            As in `run`.
        least
            Standard deviation of each output's noise at least, shape (outputs,), units of y.
        overlap
            Variance of a mean of rows over that of as many independent ones, >= 1.
        """
        if not overlap >= 1:
            raise InputError(f"begin: overlap must be a number >= 1, not {overlap!r}")
        engine, y, h = self._record(Y, H, "begin")
        floor = spread(vector(least, "least"), engine.y.size, "least", "outputs")
        found = solve_with_prior(y, h, self._theta0, self._scale, floor, overlap)
        engine.start(found.theta, found.covariance)
        engine.part("config", "free")[:] = 1.0
        engine.part("fast", "noise")[:] = found.noise
        engine.part("fast", "learned")[:] = float(found.rows)
        return found

    def reset(self) -> None:
        """Back to theta0, P0 and zero counters; enabled outputs, held parameters and R2 stay."""
        self.engine_for("reset").start(self._theta0, None)

    # What a supervisor switches

    def enable(self, output: int, on: bool = True) -> None:
        """Use (or leave out) an output; values of an output left out are not looked at."""
        engine = self.engine_for("enable")
        if not 0 <= output < engine.y.size:
            raise InputError(
                f"enable: there is no output {output}; outputs are 0 to {engine.y.size - 1}"
            )
        engine.part("config", "enabled")[output] = float(on)

    def hold(self, parameters: Iterable[int | str]) -> None:
        """Freeze parameters, by name or position, until `release`."""
        self.engine_for("hold").part("config", "free")[
            positions(self._names, parameters, "hold")
        ] = 0.0

    def release(self, parameters: Iterable[int | str] | None = None) -> None:
        """Let held parameters move again; None: all of them."""
        where = range(self._theta0.size) if parameters is None else parameters
        self.engine_for("release").part("config", "free")[
            positions(self._names, where, "release")
        ] = 1.0

    def set_measurement_covariance(self, R2: npt.ArrayLike | None) -> None:
        """New R2 from now on (raised when a sensor is suspected); None: estimate it from the
        innovations.
        """
        engine = self.engine_for("set_measurement_covariance")
        if R2 is None:
            engine.part("config", "noise_known")[:] = 0.0
            return
        engine.part("config", "noise_given")[:] = variances(
            R2, engine.y.size, "R2", "outputs", zero=False
        )
        engine.part("config", "noise_known")[:] = 1.0

    def set_entry_noise(self, variance: npt.ArrayLike, square: npt.ArrayLike | None = None) -> None:
        """New variances of the noise that entries of H themselves have, shape (outputs,
        parameters), user units squared; zero, as at the start, where an entry is exact.

        What stands in its noise says nothing of its parameter, and would take it down towards zero.
        Such an entry counts as it is in the residual, and moves nothing
        (`Settings.shown_over`).

        Parameters
        ----------
        variance
            See above.
        square
            Mean square of the entries up to now, same shape; None: goes on as it stands.
        """
        engine = self.engine_for("set_entry_noise")
        shape = (engine.y.size, self._theta0.size)
        given = np.asarray(variance, dtype=np.float64)
        if given.shape != shape or not np.isfinite(given).all() or (given < 0).any():
            raise InputError(
                f"set_entry_noise: the variances must be {shape[0]} x {shape[1]} finite numbers "
                ">= 0, one for each entry of H"
            )
        scaled = engine.part("config", "scale") ** 2
        engine.part("config", "hides")[:] = (self._settings.shown_over * given * scaled).ravel()
        if square is not None:
            engine.part("fast", "size")[:] = (np.asarray(square) * scaled).ravel()

    # State

    def state(self) -> bytes:
        """Everything the estimator will ever use again, as bytes; `restore` brings it back bit
        by bit.
        """
        engine = self.engine_for("state")
        body = engine.fast.tobytes() + engine.slow.tobytes() + engine.config.tobytes()
        head = _HEADER.pack(
            *(
                _MAGIC,
                self._theta0.size,
                engine.y.size,
                METHODS.index(self._method),
                int(engine.freeze),
                int(engine.walking),
                zlib.crc32(body),
            ),
        )
        return head + body

    def restore(self, state: bytes) -> None:
        """Take up a state of an estimator with the same parameters, outputs and method.

        Raises
        ------
        InputError
            The bytes are damaged or belong to another estimator.
        """
        if len(state) < _HEADER.size:
            raise InputError(
                "restore: the state is too short; give the bytes that state() returned"
            )
        magic, n, m, method, freeze, walking, crc = _HEADER.unpack_from(state)
        if magic != _MAGIC:
            raise InputError(
                "restore: these bytes are no state of a RecursiveLeastSquares; give what state() "
                "returned"
            )
        body = bytes(state[_HEADER.size :])
        if zlib.crc32(body) != crc:
            raise InputError("restore: the state is damaged; give the bytes that state() returned")
        if n != self._theta0.size or method >= len(METHODS) or METHODS[method] != self._method:
            raise InputError(
                f"restore: the state is of {n} parameters and method "
                f"{METHODS[method % len(METHODS)]!r}; "
                f"this estimator has {self._theta0.size} and {self._method!r}"
            )
        engine = self._engine or self._build(m)
        if (m, freeze, walking) != (engine.y.size, int(engine.freeze), int(engine.walking)):
            raise InputError(
                f"restore: the state is of {m} outputs or other settings; this estimator has "
                f"{engine.y.size} outputs"
            )
        engine.load(np.frombuffer(body, dtype=np.float64))
        self._theta0, self._scale = (
            engine.part("config", "theta0").copy(),
            engine.part("config", "scale").copy(),
        )

    def __getstate__(self) -> dict[str, object]:
        """For pickle and copy: the functions are rebuilt, the numbers travel as `state()`."""
        kept = {key: value for key, value in self.__dict__.items() if key != "_engine"}
        return {**kept, "_saved": None if self._engine is None else self.state()}

    def __setstate__(self, kept: dict[str, object]) -> None:
        """Rebuild after pickle or copy."""
        saved = kept.pop("_saved")
        self.__dict__.update(kept)
        self._engine = None
        if isinstance(saved, bytes):
            self.restore(saved)

    # What can be read

    @property
    def method(self) -> str:
        """Name of the forgetting method."""
        return self._method

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self._names

    @property
    def theta(self) -> FloatArray:
        """Estimate, shape (parameters,), user units."""
        if self._engine is None:
            return self._theta0.copy()
        found: FloatArray = self._engine.part("fast", "theta") * self._scale
        return found

    @property
    def covariance(self) -> FloatArray:
        """P, shape (parameters, parameters), user units."""
        scaled = np.eye(self._theta0.size) if self._engine is None else self._engine.covariance()
        found: FloatArray = scaled * np.outer(self._scale, self._scale)
        return found

    @property
    def deviation(self) -> FloatArray:
        """Standard deviations of the estimate, shape (parameters,), user units."""
        found: FloatArray = np.sqrt(np.diag(self.covariance))
        return found

    @property
    def error(self) -> FloatArray:
        """A priori error of the last sample, shape (outputs,); zero where it was skipped."""
        return self.engine_for("error").part("fast", "error").copy()

    @property
    def measurement_covariance(self) -> FloatArray:
        """R2 in use, given or estimated, shape (outputs,)."""
        engine = self.engine_for("measurement_covariance")
        return np.where(
            engine.part("config", "noise_known") > 0,
            engine.part("config", "noise_given"),
            engine.part("fast", "noise"),
        )

    @property
    def forgetting(self) -> float:
        """Forgetting factor: the last one used; "schedule": the next one."""
        return self._number("forgetting")

    @property
    def alarm(self) -> bool:
        """True while a chi-square alarm lasts."""
        return self._number("alarm") > 0

    @property
    def alarms(self) -> int:
        """Number of alarms so far."""
        return int(self._number("alarms"))

    @property
    def resets(self) -> int:
        """Number of resets of P so far."""
        return int(self._number("resets"))

    @property
    def samples(self) -> int:
        """Number of samples so far, with the skipped ones."""
        return int(self._number("samples"))

    @property
    def skipped(self) -> int:
        """Number of samples skipped for NaN, infinity or absurd size."""
        return int(self._number("skipped"))

    @property
    def excited(self) -> BoolArray:
        """Which parameters move: neither held nor without excitation, shape (parameters,)."""
        engine = self.engine_for("excited")
        found: BoolArray = (engine.part("slow", "excited") > 0) & (
            engine.part("config", "free") > 0
        )
        return found

    @property
    def live(self) -> BoolArray:
        """Which outputs still carry at least half of their parameters, shape (outputs,)."""
        found: BoolArray = self.engine_for("live").part("slow", "live") > 0
        return found

    # Inside

    def _number(self, name: str) -> float:
        return 0.0 if self._engine is None else float(self._engine.part("fast", name)[0])

    def engine_for(self, asked: str) -> Engine:
        """The memory of the recursion; `asked` names the call that needs it.

        Raises
        ------
        InputError
            Before the number of outputs is known.
        """
        if self._engine is None:
            raise InputError(
                f"{asked}: the number of outputs is not known yet; pass outputs= or give a "
                "sample first"
            )
        return self._engine

    def _build(self, outputs: int) -> Engine:
        noise = None if self._noise is None else spread(self._noise, outputs, "R2", "outputs")
        self._engine = Engine(
            self._theta0,
            self._scale,
            outputs=outputs,
            method=self._method,
            settings=self._settings,
            walk=self._walk,
            noise=noise,
            alike=self._alike,
        )
        return self._engine

    def _arranged(
        self, y: npt.ArrayLike, H: npt.ArrayLike
    ) -> tuple[Engine, FloatArray, FloatArray]:
        """One sample in full shape: (outputs,) and (outputs, parameters)."""
        values, rows = doubles(y, "update", "y"), doubles(H, "update", "H")
        values = values.reshape(1) if values.ndim == 0 else values
        rows = rows.reshape(1, -1) if rows.ndim == 1 and values.size == 1 else rows
        engine = self._engine
        m = values.size if engine is None else engine.y.size
        n = self._theta0.size
        if values.shape != (m,) or rows.shape != (m, n) or m == 0:
            raise InputError(
                f"update: y has shape {np.shape(y)} and H {np.shape(H)}; give ({m},) and ({m}, {n})"
            )
        return engine or self._build(m), values, rows

    def _record(
        self, Y: npt.ArrayLike, H: npt.ArrayLike, asked: str
    ) -> tuple[Engine, FloatArray, FloatArray]:
        """A record in full shape: (samples, outputs) and (samples, outputs, parameters)."""
        y, h = doubles(Y, asked, "Y"), doubles(H, asked, "H")
        y = y.reshape(-1, 1) if y.ndim == 1 else y
        h = h[:, None, :] if h.ndim == 2 and y.ndim == 2 and y.shape[1] == 1 else h
        n = self._theta0.size
        fits = y.ndim == 2 and y.shape[1] > 0 and h.shape == (*y.shape, n)
        if not fits or (self._engine is not None and y.shape[1] != self._engine.y.size):
            m = "outputs" if self._engine is None else str(self._engine.y.size)
            raise InputError(
                f"{asked}: Y has shape {np.shape(Y)} and H {np.shape(H)}; give (samples, {m}) "
                f"and (samples, {m}, {n})"
            )
        return self._engine or self._build(y.shape[1]), y, h
