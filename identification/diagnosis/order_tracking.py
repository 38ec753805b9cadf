"""Order tracking: lines of a residual that repeat with an angle or a position, over the full
bandwidth of the samples.

The samples are taken along the angle and not along time: every sample counts by the angle that it
covers, so that rest and turns count for nothing and a line at an order stays one line at every
speed. A line may lie above half the sampling rate, as long as nothing filters it away: the angle of
each sample is known.

A peak of the spectrum over orders is judged against its surroundings: over white noise the power at
one order is exponentially distributed, with the mean median / ln 2 (N. Wiener, B. Fisher:
periodogram ordinates of Gaussian noise).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.beside import between, orthonormal
from identification.fitting.covariance import follows

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ALPHA: Final = 0.01
"""Share of joints without a line on which noise may pass for one, in the scan and again on
held-out records.
"""
SURROUNDINGS: Final = 32
"""Independent orders on either side of a peak from which its background is taken: their median
is known to a fifth.
"""
MEDIAN_EFFICIENCY: Final = 0.48
"""Of the median against the mean, for the level of exponentially distributed powers: (ln 2)^2."""
FEWEST_SURROUNDINGS: Final = 4
"""Independent orders below a peak from which on they count as its left side."""
NEAREST: Final = 2
"""Independent orders next to a peak that its own main lobe covers: no background."""
FEWEST_CYCLES: Final = 2.0
"""Periods over the stroke from which on an order counts: what is slower is the trend over the
position (a cubic) that is taken out.
"""
FREE_CYCLES: Final = 4.0
"""Periods over the stroke from which on an order is looked for that nobody named."""
FINEST: Final = 8
"""Bins per period of the highest order: what a bin blurs is then under 3 %."""
FINER: Final = 4
"""Points of the scan per independent order: the peak between two of them is under 3 % higher."""
OUTLIER: Final = 4.0
"""Robust deviations at which a sample is cut: a burst in one place is no line."""
ORDER_ERROR: Final = math.sqrt(6.0) / (2 * math.pi)
"""Standard error of the order of a line in units of 2 pi / stroke, times the root of its power over
the background (Cramer-Rao bound of the frequency of a sine: 0.39)."""
NAMED_WITHIN: Final = 3.0
"""Standard errors within which a line lies at an order to carry its name."""
SURE: Final = 2.0
"""Standard errors beyond a factor :data:`ALIKE` at which a part contradicts the whole, or held-out
records the training ones; a true line is half its size away from that, too."""
PARTS: Final = 3
"""Parts of the stroke in which a line is looked at by itself, in each direction: a turn and what
lies at one end of the stroke are in one of them."""
ALIKE: Final = 2.0
"""Times that a line may be larger or smaller in a part than on the whole: half way, on a scale of
sizes, between a line that is everywhere and one that is in a quarter of the motion."""
SLOW: Final = 10.0
"""Frequency up to which what is left of a model may be slow [Hz]: noise with a memory and friction
about a turn lie under it."""
FEWEST_APART: Final = 0.1
"""Share of the weight of a line beside such samples from which on they tell of it."""
BLOCK: Final = 1.0
"""Length of the blocks of held-out rows that count as independent [s]."""
KNOTS: Final = 12
"""Knots of the curve over the velocity that is taken out before the scan."""


@final
@dataclass(frozen=True)
class Samples:
    """Samples of a residual along an angle.

    Attributes
    ----------
    angle : (n,) array
        Motor angle [rad], or position times 2 pi [m]: an order is then a number of periods per turn
        or per metre.
    residual : (n,) array
    weight : (n,) array
        What each sample counts: the angle that it covers.
    block : (n,) int array
        Number of the second that the sample belongs to.
    seen : callable
        What the smoothing of the residual, and the trend taken out of it, leave of a signal at the
        samples.
    """

    angle: FloatArray
    residual: FloatArray
    weight: FloatArray
    block: IntArray
    seen: Callable[[FloatArray], FloatArray] = np.asarray

    @property
    def stroke(self) -> float:
        """Angle over which the samples spread: that of samples spread evenly with the same
        deviation, so that orders 2 pi / stroke apart are independent however long the motion dwelt
        in the middle."""
        if not len(self.angle) or float(self.weight.sum()) <= 0:
            return 0.0
        middle = float(np.average(self.angle, weights=self.weight))
        return math.sqrt(12 * float(np.average((self.angle - middle) ** 2, weights=self.weight)))


@final
@dataclass(frozen=True)
class Peak:
    """A line in one residual.

    Attributes
    ----------
    order : float
    error : float
        Standard error of the order: that of a sine in noise, or from block to block where that is
        larger.
    sine, cosine : float
        Of order times angle, in the unit of the residual.
    prominence : float
        Power over the mean power of the background (z).
    apart : float
        2 pi / stroke: distance of orders that can be told apart.
    amplitude_error : float
        Standard error of the size: one part of it holds half the power of the background; from
        block to block where that is larger.
    """

    order: float
    error: float
    sine: float
    cosine: float
    prominence: float
    apart: float
    amplitude_error: float

    @property
    def amplitude(self) -> float:
        """Size of the line."""
        return math.hypot(self.sine, self.cosine)

    @property
    def certainty(self) -> float:
        """Power over that of its standard error: the prominence, or less where blocks disagree."""
        return 0.5 * (self.amplitude / max(self.amplitude_error, 1e-300)) ** 2

    def wave(self, samples: Samples) -> FloatArray:
        """The line as the samples show it."""
        return samples.seen(
            self.sine * np.sin(self.order * samples.angle)
            + self.cosine * np.cos(self.order * samples.angle)
        )

    def at(self, order: float) -> bool:
        """True where the line lies at an order within its error, and nearer to it than to the
        next one that can be told apart.
        """
        return abs(self.order - order) <= min(NAMED_WITHIN * self.error, self.apart / 2)


def trend(
    angle: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    knots: FloatArray,
    span: tuple[float, float],
) -> FloatArray:
    """Columns of what is no line: a curve over the velocity, a cubic over the position, the
    acceleration.

    Parameters
    ----------
    angle, velocity, acceleration : (n,) array
    knots : (k,) array
        Velocities at which the curve bends (see :func:`velocity_knots`).
    span : (low, high)
        Ends of the angle.

    Returns
    -------
    (n, k + 4) array
    """
    middle, half = (span[0] + span[1]) / 2, max((span[1] - span[0]) / 2, 1e-300)
    x = (angle - middle) / half
    left, share = between(velocity, knots)
    rows = np.arange(len(velocity))
    size = float(np.max(np.abs(acceleration), initial=1e-300))
    out = np.zeros((len(velocity), len(knots) + 4))
    out[rows, left], out[rows, left + 1] = 1.0 - share, share
    for column, values in zip(
        out.T[len(knots) :], (x, x**2, x**3, acceleration / size), strict=True
    ):
        column[:] = values
    return out


def velocity_knots(velocity: FloatArray) -> FloatArray:
    """Quantiles of the velocity, with a step of its own at zero, where friction changes its
    sign.
    """
    inner = np.quantile(velocity, np.linspace(0, 1, KNOTS))
    small = 0.01 * float(np.max(np.abs(velocity), initial=1e-300))
    return np.unique(np.concatenate([inner[np.abs(inner) > small], [-small, small]]))


def beside(columns: FloatArray, weight: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """What weighted least squares on the columns of a trend leave of a signal.

    The residual and the line that is looked for in it are both taken without the trend (R. Frisch,
    F. Waugh 1933): where the velocity goes with the position, as on moves between the same places,
    the trend takes a part of a line too, and a whole sine taken off what is left would write that
    part into it as a line of its own.

    Parameters
    ----------
    columns : (n, k) array
    weight : (n,) array
    """
    basis = orthonormal([columns], weight)

    def left(values: FloatArray) -> FloatArray:
        return np.asarray(values - basis @ ((weight * values) @ basis), dtype=np.float64)

    return left


def clipped(samples: Samples) -> Samples:
    """The samples with outliers cut."""
    spread = (
        1.4826 * float(np.median(np.abs(samples.residual[samples.weight > 0])))
        if np.any(samples.weight > 0)
        else 0.0
    )
    return replace(samples, residual=np.clip(samples.residual, -OUTLIER * spread, OUTLIER * spread))


def spectrum(samples: Samples, highest: float) -> tuple[FloatArray, FloatArray]:
    """Power of exp(i h angle) in the samples over orders h, from zero to `highest`.

    Returns
    -------
    orders, power : (m,) arrays
        :data:`FINER` or more points per independent order.
    """
    width = 2 * np.pi / highest / FINEST
    bins = ((samples.angle - float(samples.angle.min())) / width).astype(np.int64)
    size = int(bins.max()) + 1
    summed = np.bincount(bins, weights=samples.residual * samples.weight, minlength=size)
    length = 1 << int(math.ceil(math.log2(max(size, 2) * FINER)))
    power = np.abs(np.fft.rfft(summed, length)) ** 2
    orders = np.arange(len(power)) * 2 * np.pi / (length * width)
    keep = orders <= highest
    return np.asarray(orders[keep]), np.asarray(power[keep], dtype=np.float64)


def background(orders: FloatArray, power: FloatArray, stroke: float, lowest: float) -> FloatArray:
    """Mean power of the noise at every order: the larger one of the local medians to its left, to
    its right and on both sides.

    Where the noise falls with the order the median of both sides would stand under it on the left.
    """
    from scipy.ndimage import median_filter

    step = float(orders[1] - orders[0])
    one = 2 * np.pi / stroke / step
    near, far = round(NEAREST * one), round(SURROUNDINGS * one)
    first = int(np.searchsorted(orders, lowest))
    inside = power[first:]
    count = len(inside)
    width = far - near
    if count <= 2 * far:
        middle = float(np.median(inside)) if count else 0.0
        return np.full(len(power), middle / math.log(2))
    medians = median_filter(inside, size=width, mode="nearest")
    reach = (near + far) // 2
    left, right = np.zeros(count), np.zeros(count)
    left[far:] = medians[far - reach : count - reach]
    for k in range(near + round(FEWEST_SURROUNDINGS * one), far):
        left[k] = np.median(inside[: k - near])
    right[: count - far] = medians[reach : count - far + reach]
    out = np.zeros(len(power))
    out[first:] = np.maximum(left, right) / math.log(2)
    out[:first] = out[first] if count else 0.0
    return out


def threshold(alpha: float, orders: float) -> float:
    """Power over the background that noise passes with a chance of alpha in so many independent
    orders.

    -ln(alpha / orders) over a known background; the background is itself known from few orders only
    (beta-prime distribution of the ratio of two exponential levels).
    """
    known = 2 * (SURROUNDINGS - NEAREST) * MEDIAN_EFFICIENCY
    return float(known * ((max(orders, 1.0) / alpha) ** (1 / known) - 1))


def independent_orders(lowest: float, highest: float, stroke: float) -> float:
    """Orders between two that can be told apart over the stroke."""
    return max((highest - lowest) * stroke / (2 * np.pi), 1.0)


def phase_fit(order: float, samples: Samples) -> tuple[float, float]:
    """Sine and cosine of a line at an order, by weighted least squares."""
    root = np.sqrt(samples.weight)
    waves = [samples.seen(f(order * samples.angle)) for f in (np.sin, np.cos)]
    columns = np.column_stack([*waves, np.ones_like(samples.angle)])
    found = np.linalg.lstsq(columns * root[:, None], samples.residual * root, rcond=None)[0]
    return float(found[0]), float(found[1])


def refined(orders: FloatArray, power: FloatArray, k: int) -> float:
    """Peak between the points of a scan, by a parabola."""
    if k in (0, len(power) - 1):
        return float(orders[k])
    a, b, c = power[k - 1], power[k], power[k + 1]
    curve = a - 2 * b + c
    shift = 0.5 * (a - c) / curve if curve != 0 else 0.0
    return float(orders[k] + shift * (orders[1] - orders[0]))


def _polished(order: float, samples: Samples, width: float) -> float:
    """The order of the largest power near one, without the bins of the scan."""
    from scipy.optimize import minimize_scalar

    base = samples.residual * samples.weight

    def negative(h: float) -> float:
        return -float(np.abs(np.dot(base, np.exp(-1j * h * samples.angle))) ** 2)

    done = minimize_scalar(
        negative,
        bounds=(order - width, order + width),
        method="bounded",
        options={"xatol": 1e-3 * width},
    )
    return float(done.x)


def peaks(
    samples: Samples,
    highest: float,
    named: Sequence[float] = (),
    most: int = 4,
    lowest: float = 0.0,
    alpha: float = ALPHA,
) -> list[Peak]:
    """Lines that stand over their surroundings, the strongest first; each is taken out before the
    next is looked for.

    Parameters
    ----------
    samples : Samples
        Trend taken out.
    highest : float
        Highest order that is looked for without a name.
    named : sequence of float
        Orders that are known beforehand: a smaller number to look among, so a lower threshold.
    most : int
        At most so many.
    lowest : float
        Lowest order without a name; at least :data:`FREE_CYCLES` periods over the stroke.
    alpha : float
        Chance of a line in noise.

    Returns
    -------
    list of Peak
    """
    stroke = samples.stroke
    if stroke <= 0:
        return []
    apart = 2 * np.pi / stroke
    low = max(lowest, FREE_CYCLES * apart)
    known = [h for h in named if h >= FEWEST_CYCLES * apart]
    top = max([highest, *(1.1 * h + 2 * SURROUNDINGS * apart for h in known)])
    if top <= low:
        return []
    anywhere = (
        threshold(alpha, independent_orders(low, highest, stroke)) if highest > low else math.inf
    )
    by_name = threshold(alpha, len(known))
    left = samples
    out: list[Peak] = []
    for _ in range(most):
        orders, power = spectrum(left, top)
        level = np.maximum(background(orders, power, stroke, FEWEST_CYCLES * apart), 1e-300)
        ratio = power / level
        free = np.where((orders >= low) & (orders <= highest), ratio, 0.0)
        k = int(np.argmax(free))
        found, least = None, anywhere
        if free[k] > anywhere:
            found = _peak(refined(orders, power, k), left, float(free[k]), apart)
        else:
            near = [
                (h, float(np.interp(h, orders, ratio)))
                for h in known
                if not any(p.at(h) for p in out)
            ]
            best = max(near, key=lambda x: x[1], default=(0.0, 0.0))
            if best[1] > by_name:
                least = by_name
                found = _peak(best[0], left, best[1], apart)
        if found is None:
            break
        # a stretch of the motion that is loud by itself stands over the background, too
        if found.certainty > least:
            out.append(found)
        left = replace(left, residual=left.residual - found.wave(left))
    return out


def _peak(order: float, samples: Samples, prominence: float, apart: float) -> Peak:
    at = _polished(order, samples, apart / 2)
    sine, cosine = phase_fit(at, samples)
    size = math.hypot(sine, cosine) / math.sqrt(2 * prominence)
    found = Peak(
        at,
        ORDER_ERROR * apart / math.sqrt(prominence),
        sine=sine,
        cosine=cosine,
        prominence=prominence,
        apart=apart,
        amplitude_error=size,
    )
    far = samples.angle - np.average(samples.angle, weights=samples.weight)
    turned = replace(found, sine=-cosine, cosine=sine).wave(samples)
    unit = found.wave(samples) / max(found.amplitude, 1e-300)
    return replace(
        found,
        error=max(found.error, _block_error(far * turned, found, samples)),
        amplitude_error=max(size, _block_error(unit, found, samples)),
    )


def _block_error(slope: FloatArray, peak: Peak, samples: Samples) -> float:
    """Standard error of a parameter of the line from the scores of the blocks: what hangs on the
    speed moves it more than noise.

    Parameters
    ----------
    slope : (n,) array
        Derivative of the line with respect to the parameter.
    """
    _, inverse = np.unique(samples.block, return_inverse=True)
    scores = np.bincount(
        inverse, weights=samples.weight * slope * (samples.residual - peak.wave(samples))
    )
    return float(np.linalg.norm(scores) / max(float(np.sum(samples.weight * slope**2)), 1e-300))


def confirmed(peak: Peak, samples: Samples, candidates: int) -> bool:
    """True where held-out samples follow the line with its phase, one-sided t of the slope over
    blocks, alpha over the candidates; and with its size, as far as the blocks tell.

    A hum is at another order at another speed: of a line of its size next to nothing is left there,
    and next to nothing may still be certain.

    Parameters
    ----------
    peak : Peak
        From the training records.
    samples : Samples
        Of held-out records, trend taken out.
    candidates : int
        Lines that are put to this test.
    """
    wave = peak.wave(samples)
    names, inverse = np.unique(samples.block, return_inverse=True)
    scores, sizes = (
        np.asarray(
            np.bincount(inverse, weights=samples.weight * wave * x, minlength=len(names)),
            dtype=np.float64,
        )
        for x in (samples.residual, wave)
    )
    if not follows(scores, sizes, ALPHA / max(candidates, 1)):
        return False
    size, count = float(scores.sum() / sizes.sum()), len(names)
    spread = float(np.linalg.norm(scores - size * sizes)) * math.sqrt(count / (count - 1))
    error = SURE * spread / float(sizes.sum())
    # with less than half of the size they are worse off with the line than without
    return size >= 1 / ALIKE and size - error <= ALIKE


def apart_from_slow(peak: Peak, samples: Samples, dt: float, *, named: bool) -> bool:
    """True where a line is there beside the samples between which it makes whole periods.

    At such a speed an order above the sampling rate stands still in the samples: a drift, or what
    is left of friction, looks like it there, and a motion that keeps the speed makes it the
    largest.

    Parameters
    ----------
    peak : Peak
    samples : Samples
        Trend taken out.
    dt : float
        Between two samples [s].
    named : bool
        Whether its order is known beforehand: then it must only not be contradicted.
    """
    periods = peak.order * np.abs(np.gradient(samples.angle)) / (2 * math.pi)
    whole = np.rint(periods)
    still = (whole >= 1) & (np.abs(periods - whole) < SLOW * dt)
    wave = peak.wave(samples)
    _, inverse = np.unique(samples.block, return_inverse=True)
    weight = np.where(still, 0.0, samples.weight)
    scores, sizes = (
        np.bincount(inverse, weights=weight * wave * x) for x in (samples.residual, wave)
    )
    every = float(np.sum(samples.weight * wave**2))
    if not float(sizes.sum()) > FEWEST_APART * every:
        return named
    size = float(scores.sum() / sizes.sum())
    error = SURE * float(np.linalg.norm(scores - size * sizes) / sizes.sum())
    return size + error >= 1 / ALIKE and (named or size > error)


def everywhere(
    peak: Peak, others: Sequence[Peak], samples: Samples, named: Sequence[float] = ()
) -> bool:
    """True where a line has its size and its phase in every part of the stroke and in both
    directions, as far as the noise lets that be seen.

    What repeats with the angle does so wherever the joint is. A motion that turns at the same
    places each time, or a law that acts at one end, makes peaks over the orders too, and held-out
    records of the same motion confirm them.

    Parameters
    ----------
    peak : Peak
    others : sequence of Peak
        Further lines of the same residual, which over a part of the stroke are not independent of
        this one. Those too near to be told apart there are the side lobes of something local, if
        they are at no order that is known.
    samples : Samples
        Trend taken out.
    named : sequence of float
        Orders that are known beforehand.
    """
    beside = [
        p
        for p in others
        if abs(p.order - peak.order) > PARTS * peak.apart or any(p.at(h) for h in named)
    ]
    used = samples.weight > 0
    angle, weight, residual = samples.angle[used], samples.weight[used], samples.residual[used]
    waves = [p.wave(samples)[used] for p in (peak, *beside)]
    columns = np.column_stack([*waves, np.ones_like(angle)])
    ends = np.quantile(angle, np.arange(1, PARTS) / PARTS)
    forward = np.gradient(samples.angle)[used] > 0
    cells = 2 * np.digitize(angle, ends) + forward
    noise = float(np.sum(weight * waves[0] ** 2)) / (2 * max(peak.prominence, 1e-300))
    for cell in range(2 * PARTS):
        rows = cells == cell
        gram = (columns[rows] * weight[rows, None]).T @ columns[rows]
        inverse = np.linalg.pinv(gram, rcond=1e-9, hermitian=True)
        size = float((inverse @ (columns[rows] * weight[rows, None]).T @ residual[rows])[0])
        error = SURE * math.sqrt(max(noise * float(inverse[0, 0]), 0.0))
        told = float((inverse @ gram)[0, 0]) > 0.5
        if told and not (size + error >= 1 / ALIKE and size - error <= ALIKE):
            return False
    return True
