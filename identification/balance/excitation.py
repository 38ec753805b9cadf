"""Whether records can carry the question at all, and what they are too poor to show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, JointModel
from identification.balance.colour import LOWEST_LINE
from identification.balance.dataset import Dataset
from identification.balance.slow_noise import SlowNoise
from identification.balance.weak import REST_SHARE, WeakRecord, differentiated_kernel

FloatArray = npt.NDArray[np.float64]

ATTENUATION: Final = 0.02
"""Pull of a parameter towards zero that is worth a word."""
HIDDEN: Final = 90.0
"""Per cent of it from which on what is left is no more than the error of the noise, which a minute
of rows knows within a tenth."""

FEWEST_REVERSALS: Final = 4
"""Reversals of the motor below which the training records say little about friction."""

SLOW_SHARE: Final = 0.02
"""Share of the top speed below which a direction is not told."""

ONE_SPEED: Final = 0.75
"""Share of the samples within a tenth of the top speed from which a motion is said to run at one
speed: a triangle spends nearly all its time there, a sine less than a third.
"""

HELD: Final = 0.02
"""Change of the speed within a kernel, as a share of it, up to which a speed counts as held."""

FEW_LINES: Final = 1.75
"""Lines below which the motion limits what may be claimed: between a single speed back and
forth (1.5) and two sines (2).
"""

DEGREES_LIKE: Final = 2.0
"""Factor around 180/pi within which two records' motions look like one in degrees and one in
radians.
"""


READ: Final[Mapping[str, str]] = {"drive": "the drive's torque", "torque": "the link's torque"}
"""Readings that drift and hum."""

FEWEST_BLOCKS: Final = 6
"""Blocks of time from which on all but the widest laws of the library, of up to four amplitudes,
can be told from chance by their scatter (:func:`identification.diagnosis.trials.enough_blocks`).
"""

REST_WORTH: Final = 0.05
"""Share of rows at rest that is worth a word: joints that stick for a moment at each turn stay
below.
"""


def rest_note(share: float) -> str:
    """What is said about rows at rest; empty where they are too few."""
    return (
        f"{100 * share:.0f} % of the rows are at rest and left out" if share >= REST_WORTH else ""
    )


def not_identifiable(data: Dataset) -> str:
    """Why the training records cannot show what is missing; empty where they can."""
    speed = np.concatenate([w.smooth["motor_velocity"] for w in data.train])
    top = float(np.quantile(np.abs(speed), 0.99))
    grid = data.train[0].grid
    source = "motor_position"
    noise = data.sources.get(source)
    still = 5 * grid.velocity_noise(source, noise) if noise is not None else 0.0
    if top <= still:
        return (
            "The joint does not move in the training records: record a motion with reversals "
            "at several speeds."
        )
    moving = np.sign(speed[np.abs(speed) > SLOW_SHARE * top])
    if not np.any(moving > 0) or not np.any(moving < 0):
        return (
            "The motor never reverses in the training records: friction cannot be told from "
            "offsets; record reversals."
        )
    return ""


def excitation_warnings(data: Dataset) -> tuple[str, ...]:
    """What the training records are too poor to show, said before the diagnosis."""
    out = []
    speed = np.concatenate([w.smooth["motor_velocity"] for w in data.train])
    top = float(np.quantile(np.abs(speed), 0.99)) or 1e-12
    unlike = unlike_units(data)
    if unlike:
        out.append(unlike)
    still = rest_note(data.at_rest())
    if still:
        out.append(still)
    blocks = blocks_of(data)
    if blocks < FEWEST_BLOCKS:
        out.append(
            f"the training motion fills {blocks} blocks of time, by whose scatter an effect is "
            f"told from chance; {FEWEST_BLOCKS} do for nearly all: record for longer"
        )
    few = few_reversals(data)
    if few:
        out.append(
            f"{few}: friction and laws with memory cannot be told from offsets; record more "
            "reversals"
        )
    elif turns_within_runs(data) < FEWEST_REVERSALS:
        out.append(
            "no run has reversals of its own: friction shows, laws with memory (hysteresis, "
            "presliding, backlash) hardly; add a run with reversals"
        )
    lines = independent_lines(data)
    if lines < FEW_LINES:
        limit = claim_limit(data)
        out.append(
            f"the training motion is worth {lines:.1f} lines of a spectrum, as a single sine or "
            f"speed is: at most {limit} effects of each "
            "balance can be told from it; add a multisine record"
        )
    levels = np.histogram(np.abs(speed) / top, bins=10, range=(0, 1))[0] / max(len(speed), 1)
    if float(levels.max()) > ONE_SPEED and int(np.argmax(levels)) > 2:
        out.append(
            "the training records run at one speed nearly all the time (triangle only): add a "
            "multisine record before trusting small claims"
        )
    if data.lengthened:
        out.append(
            f"noise of the positions asks for rows of {data.kernel:.2g} s: what is much quicker "
            "than that is averaged away; finer encoders or quicker motion give shorter ones"
        )
    pulled = {
        name: 100 * min(share, 1.0)
        for name, share in attenuation(data).items()
        if share > ATTENUATION
    }
    hidden = [name for name, percent in pulled.items() if percent >= HIDDEN]
    if hidden:
        whole = " and the ".join(hidden)
        out.append(
            f"noise of the positions hides the {whole}: these accelerations tell next to nothing "
            "of it; move faster, or read finer encoders"
        )
    worst = ", ".join(
        f"{name} by about {percent:.2g} %" for name, percent in pulled.items() if name not in hidden
    )
    if worst:
        out.append(
            f"noise of the positions would lower the {worst}: the fit takes that off as far as the "
            "noise is white, finer encoders avoid it"
        )
    return (*out, *slow_noise_notes(data))


def blocks_of(data: Dataset) -> int:
    """Blocks of time of the training records with rows that take part."""
    taking = [
        np.unique(w.block[(w.block >= 0) & np.any([w.taking(b) for b in data.sensing.balances], 0)])
        for w in data.train
    ]
    return sum(len(x) for x in taking)


def slow_noise_notes(data: Dataset) -> list[str]:
    """What is said of a torque's reading that drifts or hums slowly."""
    out = []
    for signal in READ:
        noise = data.sources.get(signal)
        if noise is None:
            continue
        drift = noise.drift.size if noise.drift is not None else 0.0
        out += _slow_noise_note(data, signal, drift, noise.lines)
    return out


def readings_notes(data: Dataset, slow: Mapping[str, SlowNoise]) -> list[str]:
    """The same of what a fitted model leaves of the readings."""
    out = []
    for signal, told in slow.items():
        drift = max((part.size for part in told.parts), default=0.0)
        out += _slow_noise_note(data, signal, drift, told.lines)
        if told.filtered is not None:
            out.append(
                f"the noise of {READ[signal]} is that of a low-pass of "
                f"{1000 * told.filtered.memory:.2g} ms, which samples of "
                f"{1000 * data.train[0].grid.dt:.3g} ms show only beside the model: it counts so"
            )
    return out


def _slow_noise_note(
    data: Dataset, signal: str, drift: float, lines: Sequence[tuple[float, float]] = ()
) -> list[str]:
    unit = "N" if data.joint.kind == "linear" else "N.m"
    said = [f"drifts by about {drift:.2g} {unit}"] if drift > 0 else []
    said += [
        f"hums with {size:.2g} {unit} at {frequency:.3g} Hz"
        for size, frequency in lines
        if frequency < LOWEST_LINE
    ]
    if not said:
        return []
    return [
        f"the reading of {READ[signal]} {' and '.join(said)}: that counts as noise, and what is "
        "as slow and no larger is not told from it; check the amplifier, and whether another axis "
        "pulls"
    ]


def unlike_units(data: Dataset) -> str:
    """Whether one record moves about 57 times as far and as fast as another: degrees read as
    radians leave no other trace.
    """
    moved = []
    for name, record in zip(
        (*data.train_names, *data.held_out_names), (*data.train, *data.held_out), strict=False
    ):
        velocity, position = (
            record.smooth["motor_velocity"],
            record.smooth.get("motor_position", np.zeros(1)),
        )
        moved.append((float(np.ptp(position)), float(np.quantile(np.abs(velocity), 0.99)), name))
    if not moved:
        return ""
    small, large = min(moved), max(moved)
    ways = (large[0] / max(small[0], 1e-300), large[1] / max(small[1], 1e-300))
    if all(1 / DEGREES_LIKE < way * math.radians(1.0) < DEGREES_LIKE for way in ways):
        moves = (
            f"{large[2]} moves {ways[0]:.3g} times as far and {ways[1]:.3g} times as fast as "
            f"{small[2]}"
        )
        return f"{moves}: are its positions in degrees? Set their unit in [columns]"
    return ""


def few_reversals(data: Dataset) -> str:
    """Why the training records are too poor for any law with a sign or a memory, else empty: one
    rule for all of them.

    A law with a sign (friction) needs passes in both directions, within a run or in runs of their
    own, as a friction map has them; a law with memory needs the turn itself, which those have not,
    and says so by its own columns.
    """
    turns, forth, back = _passes(data)
    told = min(2 * min(forth, back), forth + back - 1)
    if max(turns, told) >= FEWEST_REVERSALS:
        return ""
    return (
        "the motor reverses "
        f"{('not once', 'once only', 'twice only')[turns] if turns < 3 else f'{turns} times only'}"
    )


def _passes(data: Dataset) -> tuple[int, int, int]:
    """Reversals of the motor within the runs of the training records, and passes in either
    direction.
    """
    turns, forth, back = 0, 0, 0
    top = (
        float(
            np.quantile(
                np.abs(np.concatenate([w.smooth["motor_velocity"] for w in data.train])), 0.99
            )
        )
        or 1e-12
    )
    for w in data.train:
        for first, last in zip(w.starts[:-1], w.starts[1:], strict=True):
            v = w.smooth["motor_velocity"][first:last]
            signs = np.sign(v[np.abs(v) > SLOW_SHARE * top])
            if not len(signs):
                continue
            begins = signs[np.concatenate([[True], np.diff(signs) != 0])]
            turns += len(begins) - 1
            forth += int(np.sum(begins > 0))
            back += int(np.sum(begins < 0))
    return turns, forth, back


def turns_within_runs(data: Dataset) -> int:
    """Reversals of the motor within the runs of the training records."""
    return _passes(data)[0]


def independent_lines(data: Dataset) -> float:
    """How many lines of a spectrum the training motion is worth: 1 for a sine, 1.5 for one speed
    back and forth, 10 for ten alike.

    Participation ratio of the power of the velocity over frequency (up to what the kernel passes),
    in that of sines seen through the same windows. Runs at constant speeds, whose power is all at
    zero frequency, count by their speeds.
    """
    parts = [
        (w.smooth["motor_velocity"][a:b], w.grid.step * w.grid.dt)
        for w in data.train
        for a, b in zip(w.starts[:-1], w.starts[1:], strict=True)
    ]
    apart = 0.5 / max(len(v) * step for v, step in parts)
    count = max(8, int(1.0 / data.kernel / apart))

    def ratio(signals: Sequence[FloatArray]) -> float:
        power = np.zeros(count)
        for v, (_, step) in zip(signals, parts, strict=True):
            size = max(len(v), round(1.0 / (apart * step)))
            found = np.abs(np.fft.rfft(v * np.hanning(len(v)), size)) ** 2
            power[: len(found)] += found[:count]
        return float(np.sum(power) ** 2 / max(float(np.sum(power**2)), 1e-300))

    sines = [
        float(np.std(v)) * np.sin(np.pi * count * apart * step * np.arange(len(v)))
        for v, step in parts
    ]
    return max(ratio([v for v, _ in parts]) / max(ratio(sines), 1e-300), float(_speeds(data)), 1.0)


def _speeds(data: Dataset) -> int:
    """Speeds that are held, a twentieth of the fastest apart at least; 0 where the joint holds
    none for most of its motion.
    """
    speed = [np.abs(w.averaged["motor_velocity"]) for w in data.train]
    change = [np.abs(w.averaged["motor_acceleration"]) * w.grid.length for w in data.train]
    v, dv = np.concatenate(speed), np.concatenate(change)
    top = float(np.quantile(v, 0.99)) or 1e-12
    moving = v > SLOW_SHARE * top
    held = moving & (dv < HELD * v)
    if held.sum() < moving.sum() / 2:
        return 0
    level = np.bincount(np.minimum((v[held] / top * 20).astype(np.int64), 20))
    there = np.concatenate([[False], level > held.sum() / 100])
    return int(np.sum(there[1:] & ~there[:-1]))


def claim_limit(data: Dataset) -> int:
    """Effects of one balance that a motion of few lines can carry: two for every line, its
    amplitude and its phase; else as many as there are.
    """
    lines = independent_lines(data)
    return int(2.0 * lines + 1e-6) if lines < FEW_LINES else len(EFFECTS)


def attenuation(data: Dataset) -> dict[str, float]:
    """Share by which noise of the positions pulls a parameter towards zero.

    Noise power over power of the averaged signal, noise included, that the parameter multiplies
    (errors in variables).
    """
    grid, out, sources = data.train[0].grid, dict[str, float](), data.sources
    if (
        {"motor_position", "link_position"} <= set(sources)
        and data.sensing.both_positions
        and not data.sensing.clamped_link
    ):
        torsion = np.concatenate(
            [w.averaged["motor_position"] - w.averaged["link_position"] for w in data.train]
        )
        average = differentiated_kernel(grid.length, grid.dt, 0)
        positions = [sources[f"{side}_position"] for side in ("motor", "link")]
        noise = sum(x.after(average, grid.dt) ** 2 for x in positions)
        out["stiffness"] = noise / max(float(np.var(torsion)), 1e-300)
    for side in ("motor", "link"):
        if f"{side}_position" in sources:
            bend = differentiated_kernel(grid.length, grid.dt, 2)
            noise = sources[f"{side}_position"].after(bend, grid.dt) ** 2
            power = float(np.var(np.concatenate([_moving(w, side) for w in data.train])))
            out[f"{side} inertia"] = noise / max(power, 1e-300)
    return out


def noise_of_inertias(data: Dataset, model: JointModel) -> float:
    """Largest of these shares of an inertia that the model has and the balances show."""
    shown = attenuation(data)
    if data.sensing.kinematic or data.sensing.clamped_link:
        return 0.0
    names = model.named("inertia")
    both = {"motor inertia", "link inertia"}
    sides = {n.replace("_", " ") for n in names} & both or both
    return max((x for n, x in shown.items() if n in sides), default=0.0)


def _moving(record: WeakRecord, side: str) -> FloatArray:
    """Averaged acceleration of a side in the rows in which it does not stand still; one zero
    where it never moves.
    """
    values = record.averaged[f"{side}_acceleration"]
    moving = values[record.rest[side] <= REST_SHARE] if side in record.rest else values
    return moving if len(moving) else np.zeros(1)
