"""The noise of one channel: how much of it, how fast it forgets itself, and the hum of the mains.

Fourth differences over m samples hold next to nothing of a motion and all of a noise: of white
noise the same for every m, of noise through a filter the more the longer they reach. The course
over m tells white noise from noise with a memory; from there the noise is continued to the slower
rows of the balances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

REACH: Final = 0.0202
"""Longest spacing of the fourth differences [s], four samples at 200 Hz and one in a hundred more
for its clock: they hold frequencies above 25 Hz, where a motion has little but the few samples
around a turn.
"""
CALM_REACH: Final = 2 * REACH
"""The same where the joint is calm: what its acceleration holds there is slower than 12 Hz."""
SPACINGS: Final = (1, 2, 3, 4, 6, 8, 12, 16)
"""Samples between the five that make a fourth difference."""
MEMORIES: Final = tuple(float(x) for x in np.geomspace(0.5, 40.0, 23))
"""Time constants of noise with a memory, in samples: steps of a fifth, which the readings just
resolve, up to the noise of which 16 ms show a tenth.
"""
SCATTER: Final = 0.03
"""Relative error of the power of such differences over :data:`SAMPLES` samples of white noise."""
SAMPLES: Final = 12_000
STEEP: Final = 4.0
"""Power of the spacing with which the part of a motion rises at least: a jump of the acceleration
between samples gives the fifth, smooth motion the eighth; noise with a memory at most the first.
"""
CLEARLY: Final = 4.0
"""Standard errors of the readings by which such noise must explain them better than a motion."""
SETTLED: Final = 3.0
"""Memories of two low-passes in a row that the longest spacing must hold, so that the readings
show their whole power: before that they rise as steeply as a motion.
"""
WARM: Final = 10.0
"""Memories after which a drawn course has forgotten its beginning."""
COLOURED: Final = 1.2
"""Power of the longer differences over that of the shortest from which noise is not white: the
readings of white noise scatter by 3 %, and the motion adds up to 10 % to the longest.
"""
STANDS_OUT: Final = 40.0
"""Power of a line over the median around it: noise reaches it once in 1e12 frequencies."""
AROUND: Final = 40
"""Frequencies, in those that the record resolves, on either side that make this median."""
WIDTH: Final = 3
"""Half the width of a line after the window, in the same."""
PURE: Final = 0.9
"""Share of the power around a line that it must hold itself: that of a vibration of the joint
wanders with its motion."""
LOWEST_LINE: Final = 33.0
"""Lowest frequency of a hum [Hz]: two periods to a kernel of the claims; the joint's own modes are
slower."""
CLEAN: Final = 0.1
"""Share of a reading that must be no hum: the amplitude of a line is known within 5 %."""
MOST_LINES: Final = 4
"""Lines of one channel: mains and three harmonics."""
MOST_TAKEN: Final = 3 * MOST_LINES
"""Frequencies at most that are taken off one after the other: twice as many of a vibration, which
is none, as of lines."""
LEAKING: Final = 1e-4
"""Power of a line under which one near it is what it leaves of itself: its windowed course is
followed to a hundredth."""
FEWEST_SPACINGS: Final = 4
"""Spacings from which on: one more than white noise beside one with a memory needs."""
SLOWEST_COLOUR: Final = 1.0
"""Memory of a noise from which on it is a drift [s]: twenty times the longest that neighbouring
samples show."""
HIDING: Final = 0.5
"""Noise, in steps, from which on readings toggle between three and more of them, and what the
steps leave is white.
"""
LEVEL_ERROR: Final = 0.3
"""Share by which the squares of a noise level may be off, a choice: heavy tails, steps of an
encoder and a colour that is not white make it."""
FEWEST: Final = 400
"""Samples from which a colour is read: the power of a difference is known to a sixth then, and the
tests of the readings count with that."""


@final
@dataclass(frozen=True)
class Part:
    """White noise through a low-pass.

    Attributes
    ----------
    size : float
        Standard deviation, in the channel's unit.
    memory : float
        Time constant of the low-pass [s]; 0 for white noise.
    stages : int
        Low-passes in a row.
    """

    size: float
    memory: float = 0.0
    stages: int = 1

    def covariance(self, apart: FloatArray) -> FloatArray:
        """Of two samples so far apart [s], the shape of `apart`."""
        if self.memory <= 0:
            return np.asarray(self.size**2 * (apart == 0))
        lags = np.abs(apart) / self.memory
        return np.asarray(self.size**2 * np.exp(-lags) * (1 + (lags if self.stages > 1 else 0.0)))

    def spectrum(self, frequency: FloatArray, dt: float) -> FloatArray:
        """Power at these frequencies [Hz] over that of white noise of unit deviation, the shape of
        `frequency`, of a noise through one low-pass or none at steps of `dt` seconds.
        """
        pole = math.exp(-dt / self.memory) if self.memory > 0 else 0.0
        away = np.abs(1 - pole * np.exp(-2j * np.pi * frequency * dt)) ** 2
        return np.asarray(self.size**2 * (1 - pole**2) / away, dtype=np.float64)

    def draw(self, rng: np.random.Generator, count: int, dt: float) -> FloatArray:
        """A course of this noise, shape (count,), at steps of `dt` seconds."""
        if self.memory <= 0:
            return np.asarray(self.size * rng.standard_normal(count))
        warm = math.ceil(WARM * self.memory / dt)
        pole = math.exp(-dt / self.memory)
        # of one pole and of two: the sums of the squares of r^k and of (k + 1) r^k
        power = 1 / (1 - pole**2) if self.stages == 1 else (1 + pole**2) / (1 - pole**2) ** 3
        course = rng.standard_normal(count + warm)
        for _ in range(self.stages):
            course = _low_passed(course, pole)
        return np.asarray(self.size / math.sqrt(power) * course[warm:])


def _low_passed(course: FloatArray, pole: float) -> FloatArray:
    """The course y with y[k] = pole y[k - 1] + x[k], of the shape of x."""
    # a triangular solve: scipy.signal has this too, and loads scipy.stats and scipy.optimize
    from scipy.linalg.blas import dtbsv

    band = np.empty((2, len(course)), order="F")
    band[0], band[1] = 1.0, -pole
    return np.asarray(dtbsv(1, band, course, lower=1, diag=1))


@final
@dataclass(frozen=True)
class ChannelNoise:
    """Noise of a channel.

    Attributes
    ----------
    level : float
        Deviation of the white noise that has the same fourth differences, in the channel's unit.
    parts : tuple of Part
        Independent of each other.
    lines : tuple of (float, float)
        Amplitude of each line and its frequency [Hz].
    step : float
        Of the reading, where it hides what noise there is beside it: what a step takes off a slow
        motion follows the motion. 0 where noise moves the readings by steps of their own.
    """

    level: float
    parts: tuple[Part, ...]
    lines: tuple[tuple[float, float], ...] = ()
    step: float = 0.0

    @property
    def drift(self) -> Part | None:
        """The parts that no row averages away, as one; None where there are none."""
        slow = [part for part in self.parts if part.memory > SLOWEST_COLOUR]
        if not slow:
            return None
        return Part(math.hypot(*(p.size for p in slow)), max(p.memory for p in slow))

    @property
    def hum(self) -> tuple[tuple[float, float], ...]:
        """The lines that no difference of neighbours shows."""
        return tuple(line for line in self.lines if line[1] < LOWEST_LINE)

    @property
    def without_drift(self) -> ChannelNoise:
        """The same noise less its drift."""
        if self.drift is None:
            return self
        return replace(self, parts=tuple(p for p in self.parts if p.memory <= SLOWEST_COLOUR))

    @property
    def without_hum(self) -> ChannelNoise:
        """The same noise less its hum."""
        return replace(self, lines=tuple(line for line in self.lines if line[1] >= LOWEST_LINE))

    def scaled(self, level: float) -> ChannelNoise:
        """The same colour at another level."""
        if level == self.level:
            return self
        if self.level <= 0:
            return white(level)
        factor = level / self.level
        return replace(
            self,
            level=level,
            parts=tuple(replace(part, size=factor * part.size) for part in self.parts),
            lines=tuple((factor * size, frequency) for size, frequency in self.lines),
        )

    def read_in(self, step: float) -> ChannelNoise:
        """The same noise of readings in steps, in the channel's unit; 0: not in steps."""
        return replace(self, step=step) if self.beside(step) < HIDING * step else self

    def beside(self, step: float) -> float:
        """Deviation of the noise beside what a step leaves of a quick motion."""
        return math.sqrt(max(self.level**2 - step**2 / 12, 0.0))

    def rounding(self, rng: np.random.Generator, course: FloatArray) -> FloatArray:
        """What the step of the reading takes off a course (n,), with the noise beside it; the
        encoder's own zero is drawn.
        """
        step, phase = self.step, rng.uniform(0.0, self.step)
        seen = course + self.beside(step) * rng.standard_normal(len(course))
        return np.asarray(np.rint((seen - phase) / step) * step + phase - course)

    def after(self, weights: FloatArray, dt: float) -> float:
        """Standard deviation of what a filter with these weights (k,), at steps of `dt` seconds,
        makes of this noise.
        """
        if not self.lines and all(part.memory <= 0 for part in self.parts):
            return math.hypot(*(p.size for p in self.parts)) * float(np.linalg.norm(weights))
        apart = np.asarray(dt * np.arange(len(weights)), dtype=np.float64)
        alike = sum((part.covariance(apart) for part in self.parts), np.zeros(len(weights)))
        for size, frequency in self.lines:
            alike = alike + size**2 / 2 * np.cos(2 * np.pi * frequency * apart)
        pairs = np.correlate(weights, weights, "full")[len(weights) - 1 :]
        power = float(pairs[0] * alike[0] + 2 * (pairs[1:] @ alike[1:]))
        return math.sqrt(max(power, 0.0))

    def draw(self, rng: np.random.Generator, count: int, dt: float) -> FloatArray:
        """A course of this noise, shape (count,), at steps of `dt` seconds."""
        out = np.zeros(count)
        for part in self.parts:
            out += part.draw(rng, count, dt)
        for size, frequency in self.lines:
            phase = rng.uniform(0.0, 2 * np.pi)
            out += size * np.sin(2 * np.pi * frequency * dt * np.arange(count) + phase)
        return out


def white(level: float) -> ChannelNoise:
    """White noise of this deviation."""
    return ChannelNoise(level, (Part(level),))


def spacings_of(dt: float, *, calm: bool = False) -> list[int]:
    """Spacings of the fourth differences that tell the colour of a channel, in samples of `dt`
    seconds; too few to tell it where the logger is slow. They reach farther where the joint is
    `calm`.
    """
    return [m for m in SPACINGS if m == 1 or m * dt <= (CALM_REACH if calm else REACH)]


def is_slow(dt: float) -> bool:
    """Whether a logger of that step [s] is too slow for the colour of a noise to be read from its
    samples.
    """
    return len(spacings_of(dt)) < FEWEST_SPACINGS


def filtered_parts(dt: float) -> list[Part]:
    """Noises through one low-pass that have the fourth differences of white noise of unit deviation
    at steps of `dt` seconds, of growing memory, up to that of a drift.
    """
    return [
        Part(1.0 / math.sqrt(float(_seen(x, 1, [1])[0])), dt * x)
        for x in MEMORIES
        if dt * x <= SLOWEST_COLOUR
    ]


def coloured(
    values: FloatArray,
    part: slice,
    dt: float,
    levels: Sequence[float],
    samples: float,
    *,
    calm: bool = False,
) -> ChannelNoise:
    """Noise of a channel from its fourth differences.

    Parameters
    ----------
    values : (n,) array
        At even steps.
    part : slice
        The longest contiguous stretch: lines are looked for there.
    dt : float
        Step [s].
    levels : sequence of float
        Deviations of white noise with the same fourth differences over each of
        :func:`spacings_of`; zeros where that is not known.
    samples : float
        Number of those that count, in all stretches together.
    calm : bool
        Whether these are those at which the joint is calm.
    """
    spacings, level = spacings_of(dt, calm=calm), levels[0]
    if level <= 0 or len(spacings) < FEWEST_SPACINGS or samples < FEWEST:
        return white(level)
    count = sum(1 for x in levels if x > 0)
    if count < FEWEST_SPACINGS:
        return white(level)
    spacings, power = spacings[:count], np.square(levels[:count])
    lines = _lines(values, part, dt)
    hum = sum(
        (
            size**2 / 2 * (2 * np.sin(np.pi * f * dt * np.array(spacings))) ** 8 / 70
            for size, f in lines
        ),
        np.zeros(len(spacings)),
    )
    heard = hum > (COLOURED - 1) * power
    lines = lines if heard.any() else ()
    rest = power - hum if lines else power
    use = rest > CLEAN * power
    if use.sum() < FEWEST_SPACINGS or not use[0]:
        return ChannelNoise(level, (Part(level),), lines)
    # readings next to a line's own frequency are mostly that line
    spacings, rest = [m for m, u in zip(spacings, use, strict=True) if u], rest[use]
    if float(np.median(rest[1:])) < COLOURED * rest[0]:
        return ChannelNoise(level, (Part(math.sqrt(rest[0])),), lines)
    found = _with_memory(rest, spacings, dt, SCATTER * float(np.sqrt(SAMPLES / samples)))
    return ChannelNoise(level, found, lines)


def _with_memory(
    power: FloatArray, spacings: Sequence[int], dt: float, scatter: float
) -> tuple[Part, ...]:
    """White noise, beside noise of one memory where the readings need it: the shortest one within
    one standard error of them, since what a motion adds looks like a longer one.
    """
    m = np.array(spacings, dtype=float)
    error, flat = scatter * power, np.ones(len(m))

    def misfit(second: FloatArray) -> tuple[float, FloatArray]:
        return _two_shares(np.column_stack([flat, second]) / error[:, None], power / error)

    def of_memory(stages: int, longest: float) -> tuple[float, tuple[Part, ...]]:
        fits = [(x, *misfit(_seen(x, stages, spacings))) for x in MEMORIES if x <= longest]
        best = min((left for _, left, _ in fits), default=np.inf)
        for tau, left, share in fits:
            if left <= best + 1:
                parts = (Part(math.sqrt(share[0])), Part(math.sqrt(share[1]), dt * tau, stages))
                return best, tuple(p for p in parts if p.size > 0)
        return best, ()

    moving, _ = misfit((m / m[-1]) ** STEEP)
    found = [of_memory(1, np.inf), of_memory(2, m[-1] / SETTLED)]
    left, parts = found[1] if found[1][0] < found[0][0] - CLEARLY**2 else found[0]
    return parts if moving - left >= CLEARLY**2 else (Part(math.sqrt(power[0])),)


def _two_shares(columns: FloatArray, power: FloatArray) -> tuple[float, FloatArray]:
    """Least squares with two shares that are not negative: the sum of squares left, and the shares.

    The columns (n, 2) are not negative and not of one direction, the power (n,) is positive.
    """
    both: FloatArray = np.asarray(np.linalg.lstsq(columns, power)[0], dtype=np.float64)
    if both.min() < 0:
        # the least on the border: one column alone, the one that leaves less
        alone = (columns.T @ power) / np.sum(columns**2, axis=0)
        tried = [np.array([alone[0], 0.0]), np.array([0.0, alone[1]])]
        both = min(tried, key=lambda share: float(np.sum((columns @ share - power) ** 2)))
    return float(np.sum((columns @ both - power) ** 2)), both


def _seen(memory: float, stages: int, spacings: Sequence[int]) -> FloatArray:
    """Share of the power of noise with that memory, in samples, in fourth differences over these
    spacings.
    """
    pole, m = math.exp(-1 / memory), np.array(spacings, dtype=float)
    slope = (1 - pole**2) / (1 + pole**2) if stages > 1 else 0.0
    r = [pole ** (k * m) * (1 + slope * k * m) for k in range(5)]
    return np.asarray((70 * r[0] - 112 * r[1] + 56 * r[2] - 16 * r[3] + 2 * r[4]) / 70)


def _lines(values: FloatArray, part: slice, dt: float) -> tuple[tuple[float, float], ...]:
    """Amplitude and frequency of the lines that stand out of the longest stretch."""
    # differences take the slow motion out, which the window would not keep apart
    found = [
        (size / (2 * np.sin(np.pi * frequency * dt)) ** 2, frequency)
        for size, frequency in lines_in(np.diff(values[part], 2), dt, LOWEST_LINE)
    ]
    # more of them are a comb, as pulses of the motion make one
    return tuple(sorted(found, reverse=True)) if len(found) <= MOST_LINES else ()


def lines_in(
    course: FloatArray, dt: float, lowest: float, kept: BoolArray | None = None
) -> list[tuple[float, float]]:
    """Amplitude and frequency [Hz] of the lines that stand out of a course (n,) at steps of `dt`
    seconds, from a lowest frequency on: pure ones, which hold one frequency from end to end.

    One after the other is taken off, the highest first: two readings of one mains beat a few
    frequencies apart, and neither is pure while the other stands beside it.

    Parameters
    ----------
    course : (n,) array
    dt, lowest : float
    kept : (n,) array of bool, optional
        The samples that count. A line that is looked for in what gaps leave of it is spread over
        frequencies around it.
    """
    count = len(course)
    if not count:
        return []
    kept = np.ones(count, dtype=np.bool_) if kept is None else kept
    window = np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 4
    first = max(int(np.searchsorted(np.fft.rfftfreq(count, dt), lowest)), AROUND)

    def spectrum(values: FloatArray) -> FloatArray:
        return np.asarray(np.abs(np.fft.rfft(values * window)) ** 2)

    seen = kept * window
    rest = np.where(kept, course - np.mean(course, where=kept), 0.0) if kept.any() else course * 0.0
    taken: list[_Line] = []
    for _ in range(MOST_TAKEN):
        power = spectrum(rest)
        place = _highest(power, first)
        if place is None:
            break
        at = _peak(power, place)
        line = _line_of(rest, seen, at)
        taken.append(_Line(place, at / (count * dt), line, float(spectrum(line).sum())))
        rest = rest - line
    lines = [x for x in taken if not any(y.hides(x) for y in taken)]
    while True:
        # what is no line of its own is rest beside the others
        power = spectrum(rest + sum(x.course for x in taken if x not in lines))
        pure = [x for x in lines if x.is_pure_in(power)]
        if len(pure) == len(lines):
            break
        lines = pure
    return [
        (math.sqrt(2.0 * float(np.average(x.course**2, weights=seen**2))), x.frequency)
        for x in lines
    ]


@final
@dataclass(frozen=True, eq=False)
class _Line:
    """A line as it was taken off a course.

    Attributes
    ----------
    place : int
        Of its peak in the spectrum.
    frequency : float
        [Hz].
    course : (n,) array
    power : float
        Sum of its windowed spectrum.
    """

    place: int
    frequency: float
    course: FloatArray
    power: float

    def hides(self, other: _Line) -> bool:
        """Whether the other is a part of this one: nearer than the window resolves, or what was
        left of it."""
        apart = abs(self.place - other.place)
        return self.power > other.power and (
            (apart <= 2 * WIDTH and self is not other)
            or (apart <= AROUND and other.power < LEAKING * self.power)
        )

    def is_pure_in(self, rest: FloatArray) -> bool:
        """Whether it holds the power around it, beside the spectrum of what is left."""
        near = rest[self.place - AROUND : self.place + AROUND + 1]
        usual = float(np.median(near)) / math.log(2)
        # noise alone is over its mean by one in e of it
        over = float(np.maximum(near - usual, 0.0).sum()) - len(near) * usual / math.e
        return self.power >= PURE * (self.power + max(over, 0.0))


def _highest(power: FloatArray, first: int) -> int | None:
    """The highest frequency of a spectrum that stands out of all and of what is around it."""
    inner = power[first:-AROUND]
    if not len(inner):
        return None
    high = np.flatnonzero(inner > STANDS_OUT * float(np.median(power[first:]))) + first
    for k in high[np.argsort(-power[high])]:
        near = power[k - AROUND : k + AROUND + 1]
        if power[k] >= max(float(near.max()), STANDS_OUT * float(np.median(near))):
            return int(k)
    return None


def _peak(power: FloatArray, place: int) -> float:
    """Where a line lies whose windowed spectrum peaks at that place, by a parabola through the
    logarithms: right within a hundredth of a place for this window, a tenth where gaps spread it.
    """
    low, top, high = np.log(np.maximum(power[place - 1 : place + 2], 1e-300))
    bend = low - 2 * top + high
    return place + (0.5 * float((low - high) / bend) if bend < 0 else 0.0)


def _line_of(values: FloatArray, window: FloatArray, at: float) -> FloatArray:
    """The part (n,) of windowed values that turns `at` times over the course, to within one turn;
    zero where the window is.
    """
    once = 2j * np.pi / len(values) * np.arange(len(values))
    wave, turn = np.exp(at * once), np.exp(once)
    waves = [wave * turn.conj(), wave, wave * turn]
    columns = np.stack([part for x in waves for part in (x.real, x.imag)])
    seen = columns * window
    amplitudes = np.linalg.lstsq(seen @ seen.T, seen @ (window * values), rcond=None)[0]
    return np.asarray((amplitudes @ columns) * (window != 0))


__all__ = ["MOST_LINES", "ChannelNoise", "Part", "coloured", "lines_in", "spacings_of", "white"]
