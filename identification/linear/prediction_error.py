"""Prediction-error minimisation for one output: residual, its derivatives, start values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.fitting.least_squares import Outcome, least_squares

FloatArray = npt.NDArray[np.float64]
Records = list[tuple[FloatArray, FloatArray]]

FREE: Final[Mapping[str, tuple[str, ...]]] = {
    "fir": (),
    "arx": ("a",),
    "arma": ("a", "c"),
    "armax": ("a", "c"),
    "ararx": ("a", "d"),
    "ararmax": ("a", "c", "d"),
    "oe": ("f",),
    "bj": ("f", "c", "d"),
}
"""The monic polynomials that each structure estimates besides B (Ljung 1999, table 4.1); ``arma``
has no B.
"""
_LINEAR: Final = ("fir", "arx")
"""Structures whose prediction error is linear in the coefficients."""
_STEPS = 60
# relative fall of the prediction error that ends a search
_ENOUGH = 1e-8
# modulus to which unstable start values are drawn back
_MARGIN = 0.995


@final
@dataclass(frozen=True)
class Orders:
    """Structure of a model with one output: which polynomials are free and how long they are."""

    structure: str
    order: int
    delay: int
    inputs: int

    @property
    def free(self) -> tuple[str, ...]:
        """The monic polynomials that are estimated besides B."""
        return FREE[self.structure]

    @property
    def poles(self) -> int:
        """Coefficients of the denominator from u to y."""
        return self.order if {"a", "f"} & set(self.free) else 0

    @property
    def initial(self) -> int:
        """Initial conditions of a record: what happened before it, seen through the poles and
        the delay.
        """
        return self.order + self.delay


@final
@dataclass(frozen=True)
class Polynomials:
    """Coefficients in rising powers of the backward shift: ``A y = B/F u + C/D e``.

    Attributes
    ----------
    a, c, d, f : ndarray
        Monic.
    b : ndarray, shape (inputs, coefficients)
        Leading zeros hold the delay.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    f: FloatArray

    @property
    def denominator(self) -> FloatArray:
        """A times F."""
        product: FloatArray = np.convolve(self.a, self.f)
        return product

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of the poles from u to y."""
        return radius(self.denominator)


def rows_needed(orders: Orders) -> int:
    """Fewest samples of a record: three per unknown, and the delay."""
    return (
        3 * (orders.order * (len(orders.free) + 1) + orders.inputs * (orders.order + 1))
        + orders.delay
    )


def radius(polynomial: FloatArray) -> float:
    """Largest modulus of the roots of a polynomial in the backward shift."""
    roots = np.roots(polynomial)
    return float(np.abs(roots).max()) if len(roots) else 0.0


def prediction_error_fit(records: Records, orders: Orders) -> tuple[Polynomials, bool]:
    """Fit one output; `records` hold u of shape (samples, inputs) and y of shape (samples,).

    ARX is one least-squares problem. The others start from ARX, instrumental
    variables and Steiglitz-McBride iterations, and minimise the prediction error by
    Levenberg-Marquardt steps with exact derivatives; steps to unstable predictors are
    refused. Unknown initial conditions enter as an impulse at the first sample
    of every record. Returns the polynomials and whether a minimum was reached.
    """
    start = _arx(records, orders)
    if orders.structure in _LINEAR:
        return start, True
    problem = _Problem(records, orders)
    begin = min((problem.pack(one) for one in _starts(records, orders, start)), key=problem.cost)
    solved = least_squares(problem, begin, iterations=_STEPS, tolerance=_ENOUGH)
    return problem.unpack(solved.x)[0], solved.outcome in (Outcome.SETTLED, Outcome.EXACT)


@final
@dataclass(frozen=True)
class Spread:
    """How well the coefficients of a model are known.

    Attributes
    ----------
    denominator : ndarray, shape (order, order)
        Covariance of the coefficients of A or F after the leading one.
    noise_variance : float
        Of the prediction error.
    """

    denominator: FloatArray
    noise_variance: float


def coefficient_spread(records: Records, orders: Orders, model: Polynomials) -> Spread:
    """Covariance of a fitted model: noise variance times the inverse of J'J (Ljung 1999, eq. 9.17).

    It holds where the structure holds the plant; what a model lacks shows as a larger noise
    variance only.
    """
    problem = _Problem(records, orders)
    x = problem.settled(model)
    residual, jacobian = problem.residual(x), problem.jacobian(x)
    scales = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    triangle = np.linalg.qr(jacobian / scales, mode="r")
    inverse = np.linalg.pinv(triangle) / scales[:, None]
    spare = max(len(residual) - len(x), 1)
    variance = float(residual @ residual) / spare
    covariance = variance * (inverse @ inverse.T)
    first = orders.inputs * (orders.order + 1)
    own = slice(first, first + orders.poles)
    total = sum(float(y @ y) for _, y in records)
    return Spread(covariance[own, own], variance * total)


def prediction_error(u: FloatArray, y: FloatArray, model: Polynomials) -> FloatArray:
    """One-step prediction error with the initial conditions fitted and the mean removed."""
    forced = _filter(model.a, np.ones(1), y)
    for channel in range(len(model.b)):
        forced = forced - _filter(model.b[channel], model.f, u[:, channel])
    error = _filter(model.d, model.c, forced)
    lags = len(model.denominator) + len(model.d) + model.b.shape[1] - 2
    basis = _filter(np.ones(1), np.convolve(model.c, model.f), _delayed(_impulse(len(y)), 0, lags))
    if basis.shape[1]:
        error = error - basis @ np.linalg.lstsq(basis, error, rcond=None)[0]
    centred: FloatArray = error - error.mean()
    return centred


def held_out_error(u: FloatArray, y: FloatArray, model: Polynomials) -> FloatArray:
    """Simulation error with the initial conditions fitted and the mean removed."""
    error = y - _response(u, model)
    free = _delayed(_impulse(len(y)), 0, max(len(model.denominator), model.b.shape[1]) - 1)
    if free.shape[1]:
        basis = _filter(np.ones(1), model.denominator, free)
        error = error - basis @ np.linalg.lstsq(basis, error, rcond=None)[0]
    centred: FloatArray = error - error.mean()
    return centred


@final
class _Problem:
    """Residual and Jacobian of the prediction error as functions of one parameter vector."""

    def __init__(self, records: Records, orders: Orders) -> None:
        self._records = records
        self._orders = orders
        self._coefficients = orders.order + 1
        self._scale = 1.0 / np.sqrt(sum(float(y @ y) for _, y in records))
        self._cache: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def pack(self, model: Polynomials) -> FloatArray:
        """Parameter vector of a model: B, the free polynomials, zero initial conditions."""
        monic = [getattr(model, name)[1:] for name in self._orders.free]
        initial = np.zeros(self._orders.initial * len(self._records))
        return np.concatenate((model.b[:, self._orders.delay :].ravel(), *monic, initial))

    def settled(self, model: Polynomials) -> FloatArray:
        """Parameter vector of a model with its initial conditions fitted."""
        x = self.pack(model)
        own = x.size - self._orders.initial * len(self._records)
        if own < x.size:
            slopes = self.jacobian(x)[:, own:]
            x[own:] = -np.linalg.lstsq(slopes, self.residual(x), rcond=None)[0]
        return x

    def unpack(self, x: FloatArray) -> tuple[Polynomials, FloatArray]:
        """Model and initial conditions, shape (records, initial), of a parameter vector."""
        n, m = self._orders.order, self._orders.inputs
        place = m * self._coefficients
        b = np.hstack((np.zeros((m, self._orders.delay)), x[:place].reshape(m, self._coefficients)))
        parts = {name: np.ones(1) for name in "acdf"}
        for name in self._orders.free:
            parts[name] = np.concatenate((np.ones(1), x[place : place + n]))
            place += n
        return Polynomials(b=b, **parts), x[place:].reshape(
            len(self._records), self._orders.initial
        )

    def cost(self, x: FloatArray) -> float:
        """Sum of squares at `x`."""
        residual = self.residual(x)
        return float(residual @ residual)

    def residual(self, x: FloatArray) -> FloatArray:
        """Scaled one-step prediction error; infinite where the predictor is unstable."""
        return self._evaluate(x)[1]

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Its derivative with respect to the parameters."""
        return self._evaluate(x, derivative=True)[2]

    def _evaluate(
        self, x: FloatArray, derivative: bool = False
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        cached = self._cache
        if (
            cached is not None
            and np.array_equal(cached[0], x)
            and (len(cached[2]) or not derivative)
        ):
            return cached
        model, initial = self.unpack(x)
        total = sum(len(y) for _, y in self._records)
        if max(radius(model.f), radius(model.c)) >= 1.0:
            return x.copy(), np.full(total, np.inf), np.empty((0, len(x)))
        errors, slopes = [], []
        for index, (u, y) in enumerate(self._records):
            error, slope = self._record(index, (u, y), (model, initial[index]), derivative)
            errors.append(error)
            slopes.append(slope)
        self._cache = (
            x.copy(),
            self._scale * np.concatenate(errors),
            self._scale * np.vstack(slopes) if derivative else np.empty((0, len(x))),
        )
        return self._cache

    def _record(
        self,
        index: int,
        data: tuple[FloatArray, FloatArray],
        at: tuple[Polynomials, FloatArray],
        derivative: bool,
    ) -> tuple[FloatArray, FloatArray]:
        (u, y), (model, initial) = data, at
        n, free, count = self._orders.order, self._orders.initial, len(y)
        one = np.ones(1)
        impulse = _delayed(_impulse(count), 0, free)
        driven = impulse @ initial
        for channel in range(len(model.b)):
            driven += _filter(model.b[channel], one, u[:, channel])
        driven = _filter(one, model.f, driven)
        disturbance = _filter(model.a, one, y) - driven
        error = _filter(model.d, model.c, disturbance)
        if not derivative:
            return error, np.empty((0, 0))
        through = np.convolve(model.c, model.f)
        blocks = []
        for channel in range(len(model.b)):
            filtered = _filter(-model.d, through, u[:, channel])
            blocks.append(_delayed(filtered, self._orders.delay, self._coefficients))
        for name in self._orders.free:
            source = {
                "a": lambda: _filter(model.d, model.c, y),
                "f": lambda: _filter(model.d, through, driven),
                "c": lambda: _filter(-one, model.c, error),
                "d": lambda: _filter(one, model.c, disturbance),
            }[name]()
            blocks.append(_delayed(source, 1, n))
        start = np.zeros((count, free * len(self._records)))
        start[:, index * free : (index + 1) * free] = _filter(-model.d, through, impulse)
        return error, np.hstack((*blocks, start))


def _arx(records: Records, orders: Orders, prefilter: FloatArray | None = None) -> Polynomials:
    """ARX by least squares, on data filtered by 1 / `prefilter` where given."""
    rows, targets = zip(*(_arx_rows(u, y, orders, prefilter) for u, y in records), strict=True)
    return _from_linear(
        np.linalg.lstsq(np.vstack(rows), np.concatenate(targets), rcond=None)[0], orders
    )


def _arx_rows(
    u: FloatArray, y: FloatArray, orders: Orders, prefilter: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    if prefilter is not None:
        u, y = _filter(np.ones(1), prefilter, u), _filter(np.ones(1), prefilter, y)
    skip = orders.order + orders.delay
    columns = [_delayed(-y, 1, orders.poles)]
    columns += [
        _delayed(u[:, channel], orders.delay, orders.order + 1) for channel in range(orders.inputs)
    ]
    return np.hstack(columns)[skip:], y[skip:]


def _from_linear(theta: FloatArray, orders: Orders) -> Polynomials:
    n, one = orders.poles, np.ones(1)
    poles = np.concatenate((one, theta[:n]))
    b = np.hstack(
        (
            np.zeros((orders.inputs, orders.delay)),
            theta[n:].reshape(orders.inputs, orders.order + 1),
        )
    )
    on_noise = "f" not in orders.free
    return Polynomials(
        a=poles if on_noise else one, b=b, c=one, d=one, f=one if on_noise else poles
    )


def _starts(records: Records, orders: Orders, arx: Polynomials) -> list[Polynomials]:
    """Start values for the search: ARX, instrumental variables, Steiglitz-McBride."""
    models = [arx]
    poles = _stable(arx.denominator)
    if orders.inputs:  # the simulated output is no instrument where nothing drives it
        models.append(
            _instrumental(
                records, orders, Polynomials(np.ones(1), arx.b, np.ones(1), np.ones(1), poles)
            )
        )
    for _ in range(10):
        models.append(_arx(records, orders, _stable(models[-1].denominator)))
    return [_padded(model, orders) for model in models]


def _instrumental(records: Records, orders: Orders, simulated: Polynomials) -> Polynomials:
    """Instrumental variables with the simulated output as instrument (Ljung, section 7.6)."""
    left: FloatArray | float = 0.0
    right: FloatArray | float = 0.0
    for u, y in records:
        rows, target = _arx_rows(u, y, orders, None)
        instruments = _arx_rows(u, _response(u, simulated), orders, None)[0]
        left = left + instruments.T @ rows
        right = right + instruments.T @ target
    return _from_linear(np.linalg.lstsq(np.asarray(left), np.asarray(right), rcond=None)[0], orders)


def _padded(model: Polynomials, orders: Orders) -> Polynomials:
    """The model with stable poles and with C and D as long as the structure asks."""
    tail = np.concatenate((np.ones(1), np.zeros(orders.order)))
    return Polynomials(
        a=_stable(model.a),
        b=model.b,
        c=tail if "c" in orders.free else model.c,
        d=tail if "d" in orders.free else model.d,
        f=_stable(model.f),
    )


def _stable(polynomial: FloatArray) -> FloatArray:
    """The polynomial with roots outside the unit circle mirrored into it."""
    roots = np.roots(polynomial)
    size = np.abs(roots)
    if len(roots) == 0 or size.max() < 1.0:
        return polynomial
    outside = size >= 1.0
    roots[outside] *= np.minimum(1.0 / size[outside], _MARGIN) / size[outside]
    mirrored: FloatArray = np.real(np.poly(roots))
    return np.concatenate((mirrored, np.zeros(len(polynomial) - len(mirrored))))


def _response(u: FloatArray, model: Polynomials) -> FloatArray:
    response = np.zeros(len(u))
    for channel in range(len(model.b)):
        response += _filter(model.b[channel], model.denominator, u[:, channel])
    return response


def _filter(numerator: FloatArray, denominator: FloatArray, signal: FloatArray) -> FloatArray:
    from scipy.signal import lfilter

    filtered: FloatArray = lfilter(numerator, denominator, signal, axis=0)
    return filtered


def _delayed(signal: FloatArray, first: int, count: int) -> FloatArray:
    """Columns: the signal delayed by `first`, `first` + 1, ... samples, zeros before."""
    columns = np.zeros((len(signal), count))
    for k in range(count):
        lag = first + k
        columns[lag:, k] = signal[: len(signal) - lag]
    return columns


def _impulse(count: int) -> FloatArray:
    signal = np.zeros(count)
    signal[0] = 1.0
    return signal
