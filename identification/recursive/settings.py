"""Settings, forgetting methods and memory layout of the recursive least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from statistics import NormalDist
from typing import final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

METHODS = ("random_walk", "bell", "polynomial", "schedule", "constant")
POLYNOMIAL_DEGREE = 17
FORGETTING_LOW = 0.95
FORGETTING_HIGH = 1.0
MAX_PARAMETERS = 64


@final
@dataclass(frozen=True)
class Settings:
    """Tuning of `RecursiveLeastSquares`; every default is a working one.

    Attributes
    ----------
    sample_time
        Time between two samples, s.
    drift
        Random walk: drift of a parameter in 1 s, as a share of its scale (0.003: 0.3 % per
        sqrt(s)).
    alarm_drift
        The drift while an alarm lasts, share of the scale per sqrt(s).
    alarm_seconds
        How long an alarm raises the drift, s. The next alarm can come one `alarm_pause` later.
    alarm_pause
        Time after an alarm in which no new one starts, s.
    alarm_samples
        Number of samples over which the normalised innovation is averaged.
    alarm_probability
        Chance that the average of a correct model passes the chi-square limit, per independent
        average.
    forgetting
        Method "constant": the forgetting factor, 0.95 to 1.
    forgetting_low
        Methods "bell" and "polynomial": the smallest forgetting factor, 0.95 to 1 (thesis 3.5).
    bell_width
        Method "bell": relative error at which the factor has fallen half way.
    polynomial_width
        Method "polynomial": relative error at which the factor has fallen to 1/e of its way.
    schedule_rate, schedule_start
        Method "schedule": lambda0 and lambda(0) of (3.50).
    reset_seconds
        P returns to its start value when the forgetting factor stays in the lowest fifth of its way
        for this long, s ("bell" and "polynomial").
    output_floor
        The y_min of the relative error |e| / max(|y|, y_min), one value or one per output, units of
        y. None: a tenth of the running root mean square of that output.
    covariance_limit
        Bound on diag(P), as a multiple of scale^2 (also the limit after a reset).
    freeze
        Freeze parameters and outputs whose sliding information matrix has lost rank.
    window_seconds
        Window in which a loss of motion is seen, s. Half a window later at most everything lost is
        frozen.
    lost_share
        A regressor is lost when its mean square in that window falls under this share of its best
        one so far, and an output when that holds for the variance of half of its regressors or more
        ...
    clear_amplitude
        ... unless its part in y, its parameter moved by one scale, is over this many noise standard
        deviations.
    rank_seconds
        Window of the information matrix whose rank is watched, s.
    rank_share
        The weakest parameter is frozen when what the matrix tells of it beside the others falls
        under this share of its best so far; it moves again at four times this share.
    noise_seconds
        Time constant of the estimate of R2 (used where R2 is not given), s.
    inflation
        Variance of a mean of samples over that of as many independent ones, >= 1, where R2 is not
        given: 1 for white noise, 2 for kernel averages that share half of their samples. None:
        measured from the innovations.
    huber
        Standard deviations beyond which a single innovation moves the estimate no further (Huber);
        2.5 touches 1 of 80 normal ones. Where the neighbours are as far off it counts in full. 0:
        every innovation counts in full.
    shown_over
        An entry of H counts where its mean square is over so many times the variance of its own
        noise (`RecursiveLeastSquares.set_entry_noise`): noise in an entry takes the estimate down
        by its share, here by 3 % of what such a row says at most.
    shown_seconds
        Time constant of that mean square, s: some rows, and no longer than a joint speeds up.
    """

    sample_time: float = 1e-3
    drift: float = 3e-3
    alarm_drift: float = 2.0
    alarm_seconds: float = 0.15
    alarm_pause: float = 1.0
    alarm_samples: int = 20
    alarm_probability: float = 1e-6
    forgetting: float = 0.999
    forgetting_low: float = FORGETTING_LOW
    bell_width: float = 0.5
    polynomial_width: float = 0.2
    schedule_rate: float = 0.99
    schedule_start: float = 0.95
    reset_seconds: float = 0.5
    output_floor: float | tuple[float, ...] | None = None
    covariance_limit: float = 1.0
    freeze: bool = True
    window_seconds: float = 0.3
    lost_share: float = 1e-3
    clear_amplitude: float = 10.0
    rank_seconds: float = 4.0
    rank_share: float = 1e-4
    noise_seconds: float = 5.0
    inflation: float | None = None
    huber: float = 2.5
    shown_over: float = 30.0
    shown_seconds: float = 0.25

    @property
    def shown_rate(self) -> float:
        """Share by which a sample moves the mean squares of the entries of H."""
        return min(1.0, self.sample_time / self.shown_seconds)

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        for field in fields(self):
            if field.name in ("output_floor", "freeze") or (
                field.name == "inflation" and self.inflation is None
            ):
                continue
            value = getattr(self, field.name)
            if not isinstance(value, (int, float)) or not math.isfinite(value) or value < 0:
                raise InputError(
                    f"RecursiveLeastSquares: {field.name} must be a finite number >= 0, not "
                    f"{value!r}"
                )
        for name in (
            "sample_time",
            "alarm_samples",
            "bell_width",
            "polynomial_width",
            "covariance_limit",
            "window_seconds",
            "rank_seconds",
            "noise_seconds",
            "shown_seconds",
        ):
            if getattr(self, name) <= 0:
                raise InputError(
                    f"RecursiveLeastSquares: {name} must be positive, not {getattr(self, name)!r}"
                )
        for name in ("forgetting", "forgetting_low", "schedule_start", "schedule_rate"):
            if not FORGETTING_LOW <= getattr(self, name) <= FORGETTING_HIGH:
                raise InputError(
                    f"RecursiveLeastSquares: {name} must lie in [0.95, 1], not "
                    f"{getattr(self, name)!r}"
                )
        if self.inflation is not None and self.inflation < 1:
            raise InputError(
                "RecursiveLeastSquares: inflation must be at least 1 (or None), not "
                f"{self.inflation!r}"
            )
        if not 0 < self.alarm_probability < 0.5:
            raise InputError("RecursiveLeastSquares: alarm_probability must lie between 0 and 0.5")
        if self.output_floor is not None and not np.all(np.asarray(self.output_floor) > 0):
            raise InputError("RecursiveLeastSquares: output_floor must be positive (or None)")


@lru_cache(maxsize=8)
def polynomial_coefficients(width: float, low: float) -> tuple[tuple[float, ...], float]:
    """Coefficients of the "polynomial" forgetting method and the relative error where it ends.

    The thesis (3.5) uses a 17th degree polynomial in the relative error and prints its picture
    (figure 3.5) but not its coefficients. These are a fit to the described shape: an exponential
    decay from 1 that ends in a constant, low. Chebyshev basis on [0, end]; beyond the end the
    factor is low.
    """
    end = 10.0 * width
    nodes = 0.5 * (1.0 - np.cos(np.pi * (np.arange(400) + 0.5) / 400))
    target = low + (1.0 - low) * np.exp(-nodes * end / width)
    fit = np.polynomial.chebyshev.chebfit(2.0 * nodes - 1.0, target, POLYNOMIAL_DEGREE)
    return tuple(float(c) for c in fit), end


def forgetting_curve(
    method: str, relative_error: npt.ArrayLike, settings: Settings | None = None
) -> FloatArray:
    """Forgetting factor of a relative error, for drawing figures 3.5 and 3.6 of the thesis.

    Parameters
    ----------
    method
        "bell" or "polynomial".
    relative_error
        |e| / max(|y|, y_min), any shape.
    settings
        Widths and lower bound; the defaults where omitted.
    """
    chosen = settings or Settings()
    error = np.abs(np.asarray(relative_error, dtype=np.float64))
    if method == "bell":
        beta = math.log(2.0) / chosen.bell_width**2
        factor = chosen.forgetting_low + (1.0 - chosen.forgetting_low) * np.exp(-beta * error**2)
    elif method == "polynomial":
        coefficients, end = polynomial_coefficients(chosen.polynomial_width, chosen.forgetting_low)
        at = 2.0 * np.minimum(error, end) / end - 1.0
        factor = np.polynomial.chebyshev.chebval(at, np.array(coefficients))
    else:
        raise InputError(
            f"forgetting_curve: method {method!r} has no curve; use 'bell' or 'polynomial'"
        )
    clipped: FloatArray = np.clip(factor, chosen.forgetting_low, 1.0)
    return clipped


@final
class Block:
    """A flat vector of doubles cut into named parts."""

    def __init__(self, parts: list[tuple[str, int]]) -> None:
        self.parts: dict[str, slice] = {}
        at = 0
        for name, size in parts:
            self.parts[name] = slice(at, at + size)
            at += size
        self.size = at

    def __getitem__(self, name: str) -> slice:
        return self.parts[name]


@final
class Layout:
    """Where each quantity of an estimator with n parameters and m outputs lies in memory.

    `fast` changes with every sample, `slow` at the checks of the information matrix, `config` by
    the user. Counters are doubles as well, so that the whole state is one vector.
    """

    def __init__(self, n: int, m: int) -> None:
        triangle = n * (n - 1) // 2
        self.n, self.m = n, m
        self.fast = Block(
            [
                ("theta", n),
                ("d", n),
                ("u", triangle),
                ("noise", m),
                ("innovation", m),
                ("power", m),
                ("error", m),
                ("sum", m),
                ("squares", m),
                ("forgetting", 1),
                ("samples", 1),
                ("skipped", 1),
                ("learned", 1),
                ("alarm", 1),
                ("pause", 1),
                ("alarms", 1),
                ("low", 1),
                ("resets", 1),
                ("since_check", 1),
                ("due", 1),
                ("info", triangle),
                ("energy", m * n),
                ("mean", m * n),
                ("size", m * n),
            ]
        )
        self.slow = Block(
            [
                ("excited", n),
                ("live", m),
                ("inflation", m),
                ("kept", n),
                ("whole", m),
                ("parts", m),
                ("sum_before", m),
                ("energy", 2 * m * n),
                ("energy_before", 2 * m * n),
                ("energy_best", m * n),
                ("swing_best", m * n),
                ("in_block", 1),
                ("length_before", 1),
                ("info", triangle + n),
                ("info_before", triangle + n),
                ("info_best", n),
                ("in_rank", 1),
                ("rank_before", 1),
            ]
        )
        self.config = Block(
            [
                ("scale", n),
                ("theta0", n),
                ("schedule_start", 1),
                ("free", n),
                ("walk", n),
                ("walk_alarm", n),
                ("start", n),
                ("limit", n),
                ("enabled", m),
                ("noise_given", m),
                ("noise_known", m),
                ("noise_rate", 1),
                ("floor", m),
                ("floor_share", 1),
                ("alarm_freedom", 1),
                ("alarm_normal", 1),
                ("alarm_rate", 1),
                ("alarm_length", 1),
                ("pause_length", 1),
                ("low", 1),
                ("beta", 1),
                ("rate", 1),
                ("forgetting", 1),
                ("end", 1),
                ("poly", POLYNOMIAL_DEGREE + 1),
                ("reset_under", 1),
                ("reset_length", 1),
                ("check_length", 1),
                ("block_length", 1),
                ("rank_length", 1),
                ("lost_share", 1),
                ("rank_share", 1),
                ("clear_info", 1),
                ("decay", 1),
                ("inflation", 1),
                ("huber", 1),
                ("hides", m * n),
                ("shown_rate", 1),
            ]
        )


def fill_config(
    layout: Layout,
    method: str,
    theta0: FloatArray,
    scale: FloatArray,
    settings: Settings,
    walk: FloatArray | None,
    noise: FloatArray | None,
) -> FloatArray:
    """The `config` vector: `walk` (R1) and `noise` (R2) are per-sample variances in user units,
    or None.
    """
    config, at = np.zeros(layout.config.size), layout.config
    step = settings.sample_time
    config[at["scale"]], config[at["free"]], config[at["enabled"]] = scale, 1.0, 1.0
    config[at["theta0"]], config[at["schedule_start"]] = theta0, settings.schedule_start
    config[at["start"]], config[at["limit"]] = (
        min(1.0, settings.covariance_limit),
        settings.covariance_limit,
    )
    if walk is not None:
        config[at["walk"]] = walk / scale**2
    elif method == "random_walk":
        config[at["walk"]] = settings.drift**2 * step
    raised = settings.alarm_drift**2 * step if method == "random_walk" else 0.0
    config[at["walk_alarm"]] = np.maximum(config[at["walk"]], raised)
    if noise is not None:
        config[at["noise_given"]], config[at["noise_known"]] = noise, 1.0
    config[at["noise_rate"]] = min(0.05, step / settings.noise_seconds)
    floor = settings.output_floor
    config[at["floor"]] = 1e-12 if floor is None else _per_output(floor, layout.m)
    config[at["floor_share"]] = 0.1 if floor is None else 0.0
    rate = 2.0 / (settings.alarm_samples + 1.0)
    config[at["alarm_rate"]] = rate
    config[at["alarm_freedom"]] = (2.0 - rate) / rate
    config[at["alarm_normal"]] = NormalDist().inv_cdf(1.0 - settings.alarm_probability)
    config[at["alarm_length"]] = math.ceil(settings.alarm_seconds / step)
    config[at["pause_length"]] = math.ceil((settings.alarm_seconds + settings.alarm_pause) / step)
    config[at["low"]] = settings.forgetting_low
    config[at["beta"]] = math.log(2.0) / settings.bell_width**2
    config[at["rate"]], config[at["forgetting"]] = settings.schedule_rate, settings.forgetting
    coefficients, end = polynomial_coefficients(settings.polynomial_width, settings.forgetting_low)
    config[at["end"]], config[at["poly"]] = end, coefficients
    config[at["reset_under"]] = settings.forgetting_low + 0.2 * (1.0 - settings.forgetting_low)
    config[at["reset_length"]] = max(1.0, math.ceil(settings.reset_seconds / step))
    block = max(10.0, math.ceil(0.5 * settings.window_seconds / step))
    config[at["block_length"]], config[at["check_length"]] = (
        block,
        max(2.0, math.floor(block / 6.0)),
    )
    config[at["rank_length"]] = max(2.0 * layout.n, math.ceil(0.5 * settings.rank_seconds / step))
    config[at["lost_share"]], config[at["rank_share"]] = settings.lost_share, settings.rank_share
    config[at["clear_info"]] = settings.clear_amplitude**2
    config[at["inflation"]] = settings.inflation or 0.0
    config[at["huber"]] = settings.huber or 1e30
    config[at["shown_rate"]] = settings.shown_rate
    config[at["decay"]] = math.exp(-config[at["check_length"]][0] / (1000.0 * block))
    return config


def start_state(
    layout: Layout, theta: FloatArray, config: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The `fast` and `slow` vectors before the first sample."""
    fast, slow, at = np.zeros(layout.fast.size), np.zeros(layout.slow.size), layout.config
    fast[layout.fast["theta"]] = theta / config[at["scale"]]
    fast[layout.fast["d"]] = config[at["start"]]
    fast[layout.fast["noise"]] = config[at["noise_given"]]
    fast[layout.fast["innovation"]] = 1.0
    fast[layout.fast["forgetting"]] = config[at["schedule_start"]]
    slow[layout.slow["excited"]] = 1.0
    slow[layout.slow["live"]] = 1.0
    slow[layout.slow["kept"]] = 1.0
    for name in ("inflation", "whole", "parts"):
        slow[layout.slow[name]] = 1.0
    slow[layout.slow["inflation"]] = np.maximum(1.0, config[at["inflation"]])
    return fast, slow


def _per_output(value: float | tuple[float, ...], m: int) -> FloatArray:
    """One value per output."""
    given = np.asarray(value, dtype=np.float64)
    if given.shape not in ((), (1,), (m,)):
        raise InputError(
            f"RecursiveLeastSquares: output_floor has {given.size} values for {m} outputs; give "
            f"1 or {m}"
        )
    return np.broadcast_to(given, (m,)).copy()
