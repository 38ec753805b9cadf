"""Slow noise of a torque's reading, which no difference of neighbours shows: drift and hum.

An amplifier or a strain gauge warms, an offset creeps; a slip of the mains beats. Over a record of
40 s that is no larger than the noise from sample to sample, but a row averages hundreds of samples,
and it is all that a row has left: held against white noise alone it looks like physics that the
model does not have.

It is read before any model, beside everything that a torque may follow from: motion, and a free
curve over velocity and position. What follows from the state of the joint has the frequencies of
its motion. A drift has more power the slower, with the square of the frequency; two balances must
say so, whose other unknowns differ, as motor side and whole joint for a current; one alone only
where it is surer. A hum holds one frequency from end to end, which the motion does not
have.

What a fitted model leaves is asked again: there both are seen far better.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from identification.balance.beside import (
    BIWEIGHT,
    DEVIATION,
    Basis,
    any_curve,
    curve_nodes,
    motion_of,
    rest_beside,
)
from identification.balance.colour import (
    LEVEL_ERROR,
    MOST_LINES,
    Part,
    filtered_parts,
    lines_in,
)
from identification.balance.memory import cache_of
from identification.balance.weak import INDEPENDENT_SHARE, WeakRecord, differentiated_kernel

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Lines = tuple[tuple[float, float], ...]
"""Amplitude and frequency [Hz] of each."""

ROUNDS: Final = 4
"""Rounds of reweighting: the rest is known within a hundredth then, its spectrum by far no better.
"""
HIGHEST: Final = 4.0
"""Frequency below which a kernel passes all of a torque [Hz]."""
CROSSINGS: Final = 60
"""Frequencies at which a walk may fall to the level of other noise, evenly in their logarithm."""
LOG_SCATTER: Final = math.pi**2 / 6.0
"""Variance of the logarithm of a spectrum's ordinate."""
LOG_BIAS: Final = 0.5772156649
"""What the mean of that logarithm lies under the logarithm of the power: Euler's constant. A mean
of logarithms hardly sees the lines that a periodic motion puts into few ordinates."""
CERTAIN: Final = 16.0
"""Fall of chi-square from which power that falls with frequency is no chance: four deviations."""
AGREED: Final = 1.960
"""Deviations that a fall must have over what is left per octave, so that a spectrum of any other
shape is none of a walk, where two balances say so: 5 %, two-sided."""
ALONE: Final = 2.576
"""The same at 1 %, where the balance of the motor tells alone: it has the fewest unknowns."""
BEYOND_DOUBT: Final = 3.291
"""The same at 0.1 %, where no other balance could have told."""
LOWEST_HUM: Final = 5.0
"""Frequency from which a line may be a hum [Hz]: what a joint is moved with is slower."""
SAME: Final = 3.0
"""Frequencies that a record resolves by which two lines of it may lie apart and be one: the width
of a line after the window."""
RECORDS: Final = 200
"""Spectra that a thread keeps."""
BASES: Final = 20_000_000
"""Values of bases that a thread keeps (160 MB): both of a million samples."""
FEWEST_PASSES: Final = 4.0
"""Passes over a place in one direction from which a friction over it is no course in time: as many
as reversals are asked for. A curve of a place that is passed once follows any drift.
"""
PASSES_EACH: Final = 2.0
"""Passes in one direction that a piece of the course of a friction has: a drift, which does not
turn with the motion, goes through four times with changing sign and leaves next to nothing in it.
"""
MOST_PIECES: Final = 6
"""Of such a course over a record: a gear that warms has a quarter of its record to do it in."""
BANDS: Final = 8
"""Bands, of one width, in which the power of a filtered noise is held against that of the rows: one
memory must meet all of them.
"""
PARTS: Final = 3
"""Parts of the speeds, and of the places, in which what is left is compared."""
TOP: Final = 1.2
"""Highest frequency of the bands in units of 1/kernel: the kernel passes three tenths of the power
there; above it the noise of the positions and the clocks' shifts make the most.
"""
OCTAVES: Final = 5
"""Octaves from which a course of the power is told: three more than it has unknowns."""


@final
@dataclass(frozen=True)
class SlowNoise:
    """Slow noise of a reading: its drift; amplitude and frequency [Hz] of the lines of a hum; all
    of its other noise as noise through a low-pass, where the logger is too slow to show that.
    """

    parts: tuple[Part, ...]
    lines: Lines
    filtered: Part | None = None


@final
@dataclass(frozen=True)
class Drawn:
    """What drawn noise makes of the rest of a record, each (draws, rows): all of it, and that of
    the positions alone.
    """

    whole: FloatArray
    quiet: FloatArray


def slow_noise_of(record: WeakRecord) -> dict[str, SlowNoise]:
    """Slow noise of the measured torques of a record, by signal; only what is certainly there.

    A drift is given a memory of a third of the longest stretch: it varies then about zero as much
    as a walk about its mean.
    """

    def make() -> tuple[dict[str, SlowNoise], int]:
        rests = {key: _calm(rest) for key, rest in rests_of(record).items()}
        length = _longest(record)[1]
        lines = _lines(record, rests)
        walks = _walks(record, rests)
        return {
            signal: SlowNoise(
                (_drift(walks[signal], length / 3.0),) if signal in walks else (),
                lines.get(signal, ()),
            )
            for signal in rests
            if signal != "both"
        }, len(rests)

    found: dict[str, SlowNoise] = cache_of("slow noise").get(record, None, make, RECORDS)
    return found


def drifts_of(record: WeakRecord) -> dict[str, SlowNoise]:
    """As :func:`slow_noise_of`, of a record whose hum nobody asks for: where both torques are
    measured every drift needs the drive beside the transmitted one to agree, and so nothing else
    is asked where that certainly stands.
    """
    if "both" not in _keys(record):
        return slow_noise_of(record)

    def make() -> tuple[bool, int]:
        rows, length = _longest(record)
        witness = _walk(_calm(_rest_of(record, "both"))[rows], length)
        return witness is not None and not witness.is_sure(AGREED), 1

    if not cache_of("no drift").get(record, None, make, RECORDS):
        return slow_noise_of(record)
    return {key: SlowNoise((), ()) for key in _keys(record) if key != "both"}


def rests_of(record: WeakRecord) -> dict[str, FloatArray]:
    """What is left, (rows,), of the drive's torque beside all motion (`drive`), of the same beside
    the transmitted torque, too (`both`), and of that beside its side's motion (`torque`); where
    they are measured. Each beside its own rate as well: clocks and low-passes are no noise.
    """
    return {key: _rest_of(record, key) for key in _keys(record)}


def _keys(record: WeakRecord) -> list[str]:
    """Names of the rests that there are."""
    measured = [signal for signal in ("drive", "torque") if signal in record.averaged]
    return measured if len(measured) < len(("drive", "torque")) else ["drive", "both", "torque"]


def _rest_of(record: WeakRecord, key: str) -> FloatArray:
    """One of :func:`rests_of`, (rows,)."""
    a = record.averaged
    every = np.ones(record.rows, dtype=np.bool_)
    sides = [s for s in ("motor", "link") if f"{s}_position" in a]
    signal, own = ("torque", sides[-1]) if key == "torque" else ("drive", sides[0])
    state = [
        column for side in ([own] if key == "torque" else sides) for column in motion_of(a, side)
    ]
    state += [*_curves(record, own, every), *_warming(record, own, every), a[f"{signal}_rate"]]
    if key == "both":
        state += [a["torque"], a["torque_rate"]]
    return rest_beside(a[signal], state, ROUNDS)


def _calm(rest: FloatArray) -> FloatArray:
    """The rest without rows that agree with nothing."""
    limit = BIWEIGHT * DEVIATION * float(np.median(np.abs(rest))) if len(rest) else 0.0
    return np.where(np.abs(rest) < limit, rest, 0.0)


def _walks(record: WeakRecord, rests: Mapping[str, FloatArray]) -> dict[str, float]:
    """Variance by which each torque's reading certainly walks in a second, by signal: over the
    longest stretch alone. Before any model every run holds what a curve leaves of its friction, and
    sixteen runs of a pendulum bench together were sure of a drift that was none.
    """
    rows, length = _longest(record)
    found = {key: _walk(rest[rows], length) for key, rest in rests.items()}
    return _agreed({key: walk for key, walk in found.items() if walk is not None})


def _lines(record: WeakRecord, rests: Mapping[str, FloatArray]) -> dict[str, Lines]:
    """Lines of each torque's reading: amplitude and frequency [Hz]. Rows of a rest that are zero
    agree with nothing or take no part: they are left out.
    """
    rows, length = _longest(record)
    count = int(rows.sum())
    if not count:
        return {}
    step = length / count
    weights = differentiated_kernel(record.grid.length, record.grid.dt, 0)
    time = record.grid.dt * np.arange(len(weights))
    moving = [
        f
        for name in ("motor_velocity", "link_velocity")
        if name in record.averaged
        for _, f in lines_in(record.averaged[name][rows], step, LOWEST_HUM)
    ]
    found = {}
    for key, rest in rests.items():
        found[key] = [
            (size / abs(np.sum(weights * np.exp(2j * np.pi * f * time))), f)
            for size, f in lines_in(rest[rows], step, LOWEST_HUM, rest[rows] != 0)
            if all(abs(f - other) > SAME / length for other in moving)
        ]
    # beside the other torque a line of either is left
    for size, f in found.pop("both", []):
        if all(abs(f - other) > SAME / length for own in found.values() for _, other in own):
            found["drive"].append((size, f))
    return {
        signal: tuple((float(size), f) for size, f in lines)
        for signal, lines in found.items()
        if len(lines) <= MOST_LINES
    }


def _curves(
    record: WeakRecord,
    side: str,
    kept: BoolArray,
    like: Sequence[WeakRecord] = (),
) -> list[FloatArray]:
    """Free curves of what a torque follows from: speed, place, and a friction that changes with the
    place. `like`: records that have these laws in common.
    """
    position, velocity = f"{side}_position", f"{side}_velocity"
    nodes = {signal: curve_nodes(like or [record], signal) for signal in (position, velocity)}
    curves = [any_curve(record, s, kept, nodes[s]) for s in (velocity, position)]
    if _passes(like or [record], position) >= FEWEST_PASSES:
        curves.append(any_curve(record, position, kept, nodes[position], velocity))
    return curves


def _warming(record: WeakRecord, side: str, kept: BoolArray) -> list[FloatArray]:
    """Courses of a friction that changes while a record runs, as where a gear warms: power that
    falls from octave to octave, but it turns with the motion, and no reading does.
    """
    pieces = min(MOST_PIECES, int(_passes([record], f"{side}_position") / PASSES_EACH))
    if pieces < PASSES_EACH:
        return []
    time = record.points["time"]
    nodes = np.linspace(float(time[0]), float(time[-1]), pieces + 1)
    return [any_curve(record, "time", kept, nodes, f"{side}_velocity")]


def _passes(records: Sequence[WeakRecord], position: str) -> float:
    """How often the records pass a place in one direction, on average."""
    points = [w.points[position] for w in records]
    way = sum(float(np.sum(np.abs(np.diff(x)))) for x in points)
    reach = max(float(x.max()) for x in points) - min(float(x.min()) for x in points)
    return way / (2.0 * reach) if reach > 0 else 0.0


def _agreed(walks: Mapping[str, _Walk]) -> dict[str, float]:
    """Variance by which each torque's reading walks in a second, by signal, where it is certain:
    the lesser of its own and that of the drive beside the transmitted torque (`both`), where these
    agree; what the latter alone is surer of is a walk of the drive.
    """
    found: dict[str, float] = {}
    witness = walks.get("both")
    for signal, own in walks.items():
        if signal == "both":
            continue
        if witness is None:
            sure = own.is_sure(BEYOND_DOUBT)
        else:
            sure = own.is_sure(AGREED) and witness.is_sure(AGREED)
        if sure:
            found[signal] = min(own.rate, witness.rate) if witness is not None else own.rate
        elif signal == "drive" and witness is not None and witness.is_sure(ALONE):
            found[signal] = witness.rate
    return found


def _longest(record: WeakRecord) -> tuple[BoolArray, float]:
    """Rows of the longest stretch, and its length [s]."""
    return max(_stretches(record), key=lambda s: s[1])


def _stretches(record: WeakRecord) -> list[tuple[BoolArray, float]]:
    """Rows of each stretch, and its length [s]."""
    stretch = record.stretch
    number = np.bincount(stretch) if len(stretch) else np.zeros(1, dtype=np.int64)
    step = record.grid.stride * record.grid.dt
    return [(stretch == k, float(n) * step) for k, n in enumerate(number)]


def _telling(record: WeakRecord) -> list[tuple[BoolArray, float]]:
    """Stretches in which a walk is looked for: all that are long enough for it, so that runs of one
    file tell what they tell as files; the longest in any case.
    """
    longest = _longest(record)[1]
    enough = min(longest, 2 ** (OCTAVES - 1) / HIGHEST)
    return [(rows, length) for rows, length in _stretches(record) if length >= enough]


@final
@dataclass(frozen=True)
class _Walk:
    """How well a walk beside white noise meets the spectrum of a course.

    Attributes
    ----------
    rate : float
        Variance by which it walks in a second.
    fall : float
        Of chi-square, against white noise alone.
    left : float
        What is left of it.
    degrees : int
        Octaves beyond the two unknowns.
    """

    rate: float
    fall: float
    left: float
    degrees: int

    def is_sure(self, deviations: float) -> bool:
        """Whether chance makes a spectrum fall so less often than it brings a normal value so many
        deviations off: Student's t by its series in one over the degrees (Cornish, Fisher 1938).
        """
        z, n = deviations, self.degrees
        t = z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        t += (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
        return self.fall >= CERTAIN and self.fall * n >= t**2 * self.left


def _walk(course: FloatArray, length: float) -> _Walk | None:
    """The walk that meets the spectrum of a course (n,) of that length [s] best; None where there
    are too few octaves.
    """
    frequency = np.arange(1, math.ceil(min(HIGHEST * length, len(course) / 2)))
    octave = np.floor(np.log2(frequency)).astype(np.int64)
    if not np.any(course) or not len(octave) or octave[-1] + 1 < OCTAVES:
        return None
    power = np.abs(np.fft.rfft(course)[frequency]) ** 2 * length / len(course) ** 2
    number = np.bincount(octave)
    level = np.bincount(octave, np.log(np.maximum(power, 1e-300))) / number + LOG_BIAS

    def left(crossing: float) -> tuple[float, float, float]:
        course = np.bincount(octave, np.log1p((crossing / frequency) ** 2)) / number
        base = float(number @ (level - course)) / float(number.sum())
        return float(number @ (level - course - base) ** 2) / LOG_SCATTER, base, crossing

    flat, _, _ = left(0.0)
    tried = np.geomspace(1.0, float(frequency[-1]), CROSSINGS)
    walking, base, crossing = min(left(float(x)) for x in tried)
    rate = math.exp(base) * (2 * math.pi * crossing / length) ** 2
    return _Walk(rate, flat - walking, walking, len(number) - 2)


def _together(walks: Sequence[_Walk | None]) -> _Walk | None:
    """What several courses say of one walk; None where none of them can say anything."""
    told = [x for x in walks if x is not None]
    if not told:
        return None
    return _Walk(
        float(np.mean([x.rate for x in told])),
        sum(x.fall for x in told),
        sum(x.left for x in told),
        sum(x.degrees for x in told),
    )


def slow_noise_of_rest(
    records: Sequence[WeakRecord],
    rests: Mapping[str, Sequence[FloatArray]],
    drawn: Mapping[str, Sequence[Drawn]] | None = None,
) -> dict[str, SlowNoise]:
    """Slow noise of the readings of torques in what a fitted model leaves, by signal.

    Beside a model a drift is seen far better than beside all motion; but what the model lacks is
    there, too. A law of the place or the speed is taken off as free curves of these, which all
    records have in common; others have the frequencies of the motion, not power that falls from
    octave to octave: all records together must say so, and the balances agree as in
    :func:`slow_noise_of`. A hum is that of the record that has less of it than half of them: its
    frequency slips from one to the next.

    Parameters
    ----------
    records : sequence of WeakRecord
    rests : mapping of str to sequence of (rows,) array
        For each record, what is left of the transmitted torque (`torque`), of the drive's beside it
        (`both`) and of the drive's beside all motion (`drive`); those that the balances give. No
        number where a row takes no part: a walk goes on over what is left out, and what is left
        over is a walk.
    drawn : mapping of str to sequence of Drawn, optional
        By signal whose samples do not show the colour of its noise: what is drawn of white noise in
        the rest of each record. What is found counts for a white noise of one.
    """
    left = _beside_laws(records, rests)
    walks: dict[str, _Walk] = {}
    for key, courses in left.items():
        own = [
            _together(
                [
                    _walk(_calm(course[rows & np.isfinite(course)]), length)
                    for rows, length in _telling(w)
                ]
            )
            for w, course in zip(records, courses, strict=True)
        ]
        whole = None if None in own else _together(own)
        if whole is not None:
            walks[key] = whole
    drifts = _agreed(walks) if walks.keys() == left.keys() else {}
    hums = [
        _lines(w, {key: _with_zeros(courses[k]) for key, courses in left.items()})
        for k, w in enumerate(records)
    ]
    memory = max(_longest(w)[1] for w in records) / 3.0
    found = {}
    for signal in left:
        hum = sorted((own.get(signal, ()) for own in hums), key=power_of)[(len(hums) - 1) // 2]
        parts = (_drift(drifts[signal], memory),) if signal in drifts else ()
        filtered = None
        if drawn is not None and signal in drawn:
            filtered = filtered_noise(records, left[signal], drawn[signal])
        if parts or hum or filtered:
            found[signal] = SlowNoise(parts, hum, filtered)
    return found


def filtered_noise(
    records: Sequence[WeakRecord], courses: Sequence[FloatArray], drawn: Sequence[Drawn]
) -> Part | None:
    """The noise through a low-pass that has the fourth differences of white noise of unit deviation
    and, in place of the white noise that is drawn, meets the spectrum of the courses in all bands;
    None where none does, or white noise does about as well.

    What a model lacks has the frequencies of the motion and what a law makes of them: none falls
    from the lowest band to the highest as a filter does, at the power that the samples ask of it.
    And it knows of the motion: noise is as large at one speed and place as at another.
    """
    dt, top = records[0].grid.dt, TOP / records[0].grid.length
    tried = [Part(1.0), *filtered_parts(dt)]
    number = np.zeros(BANDS)
    power = np.zeros(BANDS)
    foreseen = np.zeros((len(tried), BANDS))
    for w, course, noise in zip(records, courses, drawn, strict=True):
        rows, length = _longest(w)
        kept = rows & np.isfinite(course)
        count = int(kept.sum())
        step = length / max(int(rows.sum()), 1)
        frequency = np.arange(1, count // 2) / max(count * step, 1e-300)
        frequency = frequency[frequency < top]
        if not len(frequency):
            return None
        inside = slice(1, 1 + len(frequency))
        band = (frequency / top * BANDS).astype(np.int64)

        def of(course: FloatArray, inside: slice = inside) -> FloatArray:
            return np.asarray(np.abs(np.fft.rfft(course, axis=-1)[..., inside]) ** 2)

        own = of(_calm(course[kept]))
        quiet = of(noise.quiet[:, kept]).mean(axis=0)
        white = np.maximum(of(noise.whole[:, kept]).mean(axis=0) - quiet, 0.0)
        number += np.bincount(band, minlength=BANDS)
        power += np.bincount(band, np.log(np.maximum(own, 1e-300)) + LOG_BIAS, BANDS)
        for k, part in enumerate(tried):
            passed = np.bincount(band, quiet + white * part.spectrum(frequency, dt), BANDS)
            ordinates = np.maximum(np.bincount(band, minlength=BANDS), 1)
            foreseen[k] += ordinates * np.log(np.maximum(passed / ordinates, 1e-300))
    use = number > 0
    scatter = (LOG_SCATTER + 1.0 / min(len(d.whole) for d in drawn)) / number[use]
    off = ((power - foreseen)[:, use] / number[use]) ** 2 / (scatter + LEVEL_ERROR**2)
    left = off.sum(axis=1)
    best = int(np.argmin(left))
    degrees = int(use.sum()) - 1
    met = left[best] <= degrees + ALONE * math.sqrt(2.0 * degrees)
    if not best or not met or left[0] - left[best] < CERTAIN or _knows_motion(records, courses):
        return None
    return tried[best]


def _knows_motion(records: Sequence[WeakRecord], courses: Sequence[FloatArray]) -> bool:
    """Whether what is left is certainly larger at some speeds or places than at others."""
    squares = np.concatenate(courses) ** 2
    kept = np.isfinite(squares)
    squares = squares[kept]
    sides = [s for s in ("motor", "link") if all(f"{s}_position" in w.averaged for w in records)]
    for signal in (f"{sides[0]}_velocity", f"{sides[0]}_position"):
        where = np.concatenate([w.averaged[signal] for w in records])[kept]
        where = np.abs(where) if signal.endswith("velocity") else where
        order = np.array_split(np.argsort(where), PARTS)
        power = np.array([float(np.median(squares[rows])) for rows in order])
        error = 2.0 / (INDEPENDENT_SHARE * len(order[0])) + LEVEL_ERROR**2
        if math.log(power.max() / power.min()) > ALONE * math.sqrt(2.0 * error):
            return True
    return False


def _with_zeros(course: FloatArray) -> FloatArray:
    """A course without rows that agree with nothing, zero where a row takes no part."""
    kept = np.isfinite(course)
    out = np.zeros(len(course))
    out[kept] = _calm(course[kept])
    return out


def _beside_laws(
    records: Sequence[WeakRecord], rests: Mapping[str, Sequence[FloatArray]]
) -> dict[str, list[FloatArray]]:
    """What is left of each record, (rows,), beside a mean of its own in each of its stretches and
    free curves of speed and place that all have in common: a law is the same in every record, a
    drift is not, and over the few speeds of a sweep a curve of its own would follow it. No number
    outside the stretches, and where a row takes no part.
    """
    telling = [np.any([rows for rows, _ in _telling(w)], axis=0) for w in records]
    sides = [s for s in ("motor", "link") if all(f"{s}_position" in w.points for w in records)]
    out: dict[str, list[FloatArray]] = {}
    for side in dict.fromkeys((sides[0], sides[-1])):
        own = {
            key: [np.where(t, course, np.nan) for t, course in zip(telling, courses, strict=True)]
            for key, courses in rests.items()
            if side == (sides[-1] if key == "torque" else sides[0])
        }
        # one basis for all of them: a row that one of them lacks counts for nothing in it
        kept = [np.any(np.isfinite(each), axis=0) for each in zip(*own.values(), strict=True)]
        if not any(k.any() for k in kept):
            out |= own
            continue
        laws = _laws(records, side, kept)
        for courses in own.values():
            values = np.concatenate([course[k] for course, k in zip(courses, kept, strict=True)])
            counting = np.isfinite(values)
            if counting.any():
                rest = laws.rest(np.where(counting, values, 0.0), ROUNDS, counting=counting)
                values = np.where(counting, rest, np.nan)
            ends = np.cumsum([np.count_nonzero(k) for k in kept])
            for course, k, rest in zip(courses, kept, np.split(values, ends[:-1]), strict=True):
                course[k] = rest
        out |= own
    return {key: out[key] for key in rests}


def _laws(records: Sequence[WeakRecord], side: str, kept: Sequence[BoolArray]) -> Basis:
    """What the kept rows of all records are laid beside; the same for every model."""

    def make() -> tuple[tuple[Basis, Sequence[WeakRecord]], int]:
        inside = [[rows[k] for rows, _ in _telling(w)] for w, k in zip(records, kept, strict=True)]
        columns = [block_diag(*(np.stack(own, axis=1).astype(np.float64) for own in inside))]
        curves = [_curves(w, side, k, records) for w, k in zip(records, kept, strict=True)]
        columns += [np.concatenate(parts) for parts in zip(*curves, strict=True)]
        warming = [_warming(w, side, k) for w, k in zip(records, kept, strict=True)]
        if all(warming):
            columns.append(block_diag(*(parts[0] for parts in warming)))
        made = Basis.of(columns)
        # the other records are kept with it: the identity of none is given to another one
        return (made, records[:-1]), made.columns.size

    law = (side, tuple(map(id, records[:-1])), tuple(k.tobytes() for k in kept))
    found: Basis = cache_of("laws").get(records[-1], law, make, BASES)[0]
    return found


def _drift(rate: float, memory: float) -> Part:
    """A walk that forgets itself, of that variance in a second."""
    return Part(math.sqrt(rate * memory / 2.0), memory)


def power_of(lines: Lines) -> float:
    """Mean square of what a few lines make together."""
    return sum(size**2 for size, _ in lines) / 2.0


__all__ = [
    "Drawn",
    "SlowNoise",
    "drifts_of",
    "filtered_noise",
    "power_of",
    "slow_noise_of",
    "slow_noise_of_rest",
]
