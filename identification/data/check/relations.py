"""Checks between channels: motion and reversal, velocity against position, gear ratio, delay."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from identification.balance.noise import noise_level
from identification.balance.sensing import CLAMPED_TRAVEL
from identification.balance.weak import CLAIM_KERNEL, kernel
from identification.data.check.channels import GUESSED_RATIO, span
from identification.data.check.finding import Finding, at
from identification.data.check.quanta import quantum

if TYPE_CHECKING:
    import numpy.typing as npt

    from identification.data.record import FloatArray, Record

_BLOCKS: Final = 200
"""Pieces of time over which velocity and position are compared."""
_CORRELATION: Final = 0.9
"""Correlation of the two positions below which they are not of one joint: their difference is the
wind-up, a few hundredths of the motion in a joint that works.
"""
_RATIO_TOLERANCE: Final = 0.02
"""Difference of the gear ratio up to which it is the given one: the wind-up moves the slope of the
positions by less; what is finer is told with the torsion taken off (:data:`_RATIO_DOUBT`).
"""
_RATIO_DOUBT: Final = 0.003
"""Difference of the gear ratio, torsion taken off, from which a word is said: a harmonic drive
with a tooth more differs by 0.6 %.
"""
_WRAP: Final = 0.8
"""Share of a position's range from which one step counts as far."""
_FAR_IN_TURN: Final = 0.5
"""The same where the range is one turn: more than half a turn back is less than half a turn on."""
_ONE_TURN: Final = (0.9, 1.0 + 1e-6)
"""Range, in turns, of an angle that an encoder wraps: it comes near to the turn on both ends, and
never over it but for rounding.
"""
_QUICK: Final = (0.9, 0.2)
"""Quantile of the steps, and the share of the range, from which the joint itself moves in such
steps: a few wraps are rare.
"""
_AGAINST: Final = 0.3
"""Share of the far steps that must run against the motion around them: that of a wrap logged
slowly is near a half.
"""
_NEAR, _MOVING = 5, 3e-4
"""Steps on either side of a jump, and the share of the range that they must cover in all for a
motion.
"""
_OWN: Final = 0.03
"""Share of the link's motion that must be left beside what twists the joint for the two to be told
apart.
"""
_FEW_VALUES: Final = 8
"""Values of a position that may stand still: a locked link whose encoder toggles."""
_VELOCITY_TOLERANCE: Final = 0.05
"""Difference between a velocity and the change of its position up to which its unit is right:
filters of drives take off a few hundredths, a wrong unit is far away.
"""
_FACTOR_TOLERANCE: Final = 0.03
"""Distance from a known factor within which it is named: the factors lie further apart."""
_SIGN_TOLERANCE: Final = 0.1
"""Distance from minus one within which it is the sign alone that is wrong."""
_REVERSAL: Final = (0.02, 5.0)
"""Way back that counts as a reversal, as a share of the whole way and in steps of the encoder:
overshoot and creep at the end of a one-way move are smaller.
"""
_PEAK: Final = 0.98
"""Share of the highest correlation from which a peak is one of several alike: periodic motions
repeat their peak, and the one nearest zero counts.
"""
_SKEWED: Final = 0.3
"""Lag from which on clocks are not in step [samples]: a sampling at once is within half of one, of
which a parabola through three samples of a correlation finds the place to a tenth.
"""
_LONGEST: Final = 1 << 18
_STILL: Final = 12.0
"""Span of a position, in noise levels, below which it stands still."""

_FACTORS: Final = (
    (
        180.0 / math.pi,
        "degrees were taken for radians in the position, or radians for degrees in the velocity",
    ),
    (
        math.pi / 180.0,
        "degrees were taken for radians in the velocity, or radians for degrees in the position",
    ),
    (math.pi / 30.0, "the velocity is in rpm and was taken for rad/s"),
    (30.0 / math.pi, "the velocity is in rad/s and was taken for rpm"),
    (1.0 / 6.0, "the velocity is in deg/s and was taken for rpm, or the reverse"),
    (6.0, "the velocity is in rpm and was taken for deg/s"),
    (2.0 * math.pi, "the velocity is in turns per second and was taken for rad/s"),
    (0.5 / math.pi, "the position is in turns and was taken for rad"),
    (1e3, "a factor 1000 in the unit of position, velocity or time"),
    (1e-3, "a factor 1000 in the unit of position, velocity or time"),
)
_LINEAR_FACTORS: Final = _FACTORS[-2:]


def check_wrapped(record: Record) -> list[Finding]:
    """Refuse a position that jumps by its whole range: an encoder that wraps."""
    findings = []
    for channel in ("motor_position", "link_position"):
        whole = span(record[channel]) if record.has(channel) else 0.0
        if whole == 0.0:
            continue
        steps = np.where(np.diff(record.segment) == 0, np.diff(record[channel]), 0.0)
        size = np.abs(steps[np.isfinite(steps)])
        turn = record.kind == "rotary" and _ONE_TURN[0] < whole / (2.0 * math.pi) <= _ONE_TURN[1]
        far = np.flatnonzero(
            np.abs(np.nan_to_num(steps)) > (_FAR_IN_TURN if turn else _WRAP) * whole
        )
        if (
            not far.size
            or (not turn and float(np.quantile(size, _QUICK[0])) > _QUICK[1] * whole)
            or np.unique(record[channel]).size < _FEW_VALUES
        ):
            continue
        if float(np.mean(_against(np.nan_to_num(steps), far, whole))) < _AGAINST:
            continue
        row = int(np.argmax(np.abs(np.nan_to_num(steps))))
        limit = "2 pi" if turn else f"about {whole:.3g} {record.unit(channel)}"
        message = (
            f"{record.name}: {channel} jumps by its whole range {far.size} time(s), as after "
            f"{at(record, row)}: the encoder wraps "
            f"at {limit}: unwrap it (numpy.unwrap) before the export"
        )
        findings.append(Finding("refuse", "wrapped", message, channel, row))
    return findings


def _against(steps: FloatArray, far: npt.NDArray[np.intp], whole: float) -> npt.NDArray[np.bool_]:
    """Which of the far steps run against the motion around them, as a wrap does; a quick move
    between two rests does not.
    """
    around = np.zeros(far.size)
    small = np.where(np.isin(np.arange(steps.size), far), 0.0, steps)
    padded = np.pad(small, _NEAR)
    for shift in range(2 * _NEAR + 1):
        around += padded[far + shift]
    return np.asarray(around * np.sign(steps[far]) < -_MOVING * whole)


def check_motion(record: Record) -> list[Finding]:
    """Refuse a record without motion, warn where the motor never reverses."""
    channel = next((c for c in ("motor_position", "link_position") if record.has(c)), None)
    if channel is not None:
        position = record[channel]
    else:
        channel = next((c for c in ("motor_velocity", "link_velocity") if record.has(c)), None)
        if channel is None:
            message = (
                f"{record.name}: has neither position nor velocity: record one or name its "
                "column in [columns]"
            )
            return [Finding("refuse", "no_motion", message)]
        position = _integral(record, record[channel])
    side = channel.partition("_")[0]
    whole = span(position)
    still = max(
        _STILL * noise_level(position, tuple(record.segments())), 3.0 * (quantum(position) or 0.0)
    )
    if whole <= still or not math.isfinite(whole):
        return [
            Finding(
                "refuse",
                "no_motion",
                f"{record.name}: {channel} does not move: record a motion with reversals",
                channel,
            )
        ]
    forth = back = 0.0
    for part in record.segments():
        piece = position[part]
        piece = piece[np.isfinite(piece)]
        if piece.size:
            forth = max(forth, float(np.max(piece - np.minimum.accumulate(piece))))
            back = max(back, float(np.max(np.maximum.accumulate(piece) - piece)))
    if min(forth, back) < max(_REVERSAL[0] * whole, _REVERSAL[1] * (quantum(position) or 0.0)):
        message = (
            f"{record.name}: the {side} never reverses: friction cannot be told from "
            "gravity and offset; record a motion in both directions"
        )
        return [Finding("warn", "no_reversal", message, channel)]
    return [
        Finding("ok", "reversal", f"{record.name}: the {side} moves in both directions", channel)
    ]


def _integral(record: Record, velocity: FloatArray) -> FloatArray:
    """Trapezoidal integral; a step across a segment border counts as zero."""
    steps = np.where(np.diff(record.segment) == 0, np.diff(record.time), 0.0)
    area = np.nan_to_num(0.5 * (velocity[1:] + velocity[:-1]) * steps)
    return np.concatenate([[0.0], np.cumsum(area)])


def _slope(record: Record, position: FloatArray, velocity: FloatArray) -> tuple[float, float]:
    """Factor and correlation between displacements and integrated velocity over blocks of time."""
    integral = _integral(record, velocity)
    moves: list[FloatArray] = []
    areas: list[FloatArray] = []
    for part in record.segments():
        count = part.stop - part.start
        pieces = max(2, min(_BLOCKS, count // 4, round(_BLOCKS * count / len(record)) + 1))
        edges = np.unique(np.linspace(part.start, part.stop - 1, pieces + 1).astype(np.int64))
        moves.append(np.diff(position[edges]))
        areas.append(np.diff(integral[edges]))
    y, x = np.concatenate(moves), np.concatenate(areas)
    keep = np.isfinite(y) & np.isfinite(x)
    y, x = y[keep] - y[keep].mean(), x[keep] - x[keep].mean()
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    if xx == 0.0 or yy == 0.0:
        return float("nan"), 0.0
    return (xy / xx if xy != 0.0 else 0.0), xy / math.sqrt(xx * yy)


def _explain(factor: float, kind: str, gear_ratio: float | None) -> str:
    size = abs(factor)
    for value, sentence in _FACTORS if kind == "rotary" else _LINEAR_FACTORS:
        if abs(size / value - 1.0) < _FACTOR_TOLERANCE:
            return sentence
    if gear_ratio is not None and abs(gear_ratio) > 1.0:
        for value in (abs(gear_ratio), 1.0 / abs(gear_ratio)):
            if abs(size / value - 1.0) < _FACTOR_TOLERANCE:
                return "one of them is on the other side of the gear"
    return (
        "the sign of one is reversed"
        if abs(size - 1.0) < _SIGN_TOLERANCE and factor < 0.0
        else "a unit or scale is wrong"
    )


def check_velocity(record: Record, gear_ratio: float | None) -> list[Finding]:
    """Compare each velocity channel with the change of its position: unit, sign and scale."""
    findings = []
    for side in ("motor", "link"):
        names = (f"{side}_position", f"{side}_velocity")
        if not record.has(*names) or span(record[names[0]]) == 0.0 or span(record[names[1]]) == 0.0:
            continue
        factor, correlation = _slope(record, record[names[0]], record[names[1]])
        if not math.isfinite(factor):
            continue
        if abs(correlation) < _CORRELATION:
            message = (
                f"{record.name}: {names[1]} does not follow the change of {names[0]} "
                f"(correlation {correlation:.2f}): "
                f"check that both columns are of the same axis"
            )
            findings.append(Finding("warn", "velocity_position", message, names[1]))
        elif abs(factor - 1.0) > _VELOCITY_TOLERANCE:
            why = _explain(factor, record.kind, gear_ratio)
            message = (
                f"{record.name}: {names[0]} changes {factor:.4g} times as fast as "
                f"{names[1]} says ({why}): correct unit, sign or scale in [columns]"
            )
            severity = "refuse" if abs(factor - 1.0) > 2.0 * _VELOCITY_TOLERANCE else "warn"
            findings.append(Finding(severity, "velocity_position", message, names[1]))
        else:
            message = (
                f"{record.name}: {names[1]} agrees with the change of {names[0]} (factor "
                f"{factor:.4f})"
            )
            findings.append(Finding("ok", "velocity_position", message, names[1]))
    return findings


def measured_ratio(record: Record) -> tuple[float, float] | None:
    """Gear ratio the positions of both sides show.

    Returns
    -------
    (ratio, correlation) or None
        Slope of motor position on link position about each segment's mean; None where a side does
        not move or is not measured.
    """
    if not record.has("motor_position", "link_position"):
        return None
    motor, link = record["motor_position"].copy(), record["link_position"].copy()
    good = np.isfinite(motor) & np.isfinite(link)
    for part in record.segments():
        inside = good[part]
        if inside.any():
            motor[part] -= motor[part][inside].mean()
            link[part] -= link[part][inside].mean()
    motor, link = motor[good], link[good]
    ll, mm, ml = float(link @ link), float(motor @ motor), float(motor @ link)
    if ll == 0.0 or mm == 0.0 or ml == 0.0:
        return None
    return ml / ll, ml / math.sqrt(ll * mm)


def _beside_torsion(
    record: Record, rigid: tuple[float, float, float], gear_ratio: float
) -> Finding:
    """What the gear ratio is with the torsion taken off: fine, or so far off that its own
    uncertainty does not explain it.
    """
    ratio, doubt, _ = rigid
    said = (
        f"{record.name}: with the torsion taken off the positions show a gear ratio of "
        f"{ratio:.5g}, {gear_ratio:g} is given"
    )
    if abs(ratio / gear_ratio - 1.0) <= max(_RATIO_DOUBT, doubt):
        return Finding("ok", "gear_ratio", said, "link_position")
    advice = (
        "check gear_ratio and the scale of both positions, a wrong one looks like a missing effect"
    )
    return Finding("warn", "gear_ratio", f"{said}: {advice}", "link_position")


def _twisting(record: Record) -> FloatArray | None:
    """What the twist of the joint follows, (samples,): the torque of its sensor, or without one
    the acceleration of the link; None where neither is there.
    """
    if record.has("link_torque"):
        return record["link_torque"]
    weights = kernel(CLAIM_KERNEL, record.dt, 2)
    link, half = record["link_position"], len(weights) // 2
    found = np.full(len(record), np.nan)
    for part in record.segments():
        if part.stop - part.start >= len(weights):
            inside = slice(part.start + half, part.stop - half)
            found[inside] = np.correlate(link[part], weights, "valid")
    return found if np.isfinite(found).any() else None


def _rigid_ratio(record: Record) -> tuple[float, float, float] | None:
    """Slope of the motor position on the link position beside what twists the joint; None where
    they cannot be told apart.

    Returns
    -------
    ratio, doubt, correlation
        Doubt: what is left over the motion that counts, as a share of the ratio; correlation of the
        fit with the motor position.
    """
    twisting = _twisting(record)
    if twisting is None:
        return None
    columns = np.column_stack([record["link_position"], twisting, np.ones(len(record))])
    good = np.isfinite(columns).all(axis=1) & np.isfinite(record["motor_position"])
    sizes = np.linalg.norm(columns[good], axis=0)
    if not sizes.all() or span(twisting) == 0.0:
        return None
    scaled, motor = columns[good] / sizes, record["motor_position"][good]
    found, _, rank, _ = np.linalg.lstsq(scaled, motor, rcond=1e-6)
    others = scaled[:, 1:]
    alone = scaled[:, 0] - others @ np.linalg.lstsq(others, scaled[:, 0], rcond=1e-9)[0]
    own = float(np.linalg.norm(alone))
    if rank < 3 or own < _OWN or found[0] == 0.0 or motor.std() == 0.0:
        return None
    left = float(np.linalg.norm(motor - scaled @ found))
    correlation = math.sqrt(max(1.0 - (left / (motor.std() * math.sqrt(motor.size))) ** 2, 0.0))
    doubt = left / (abs(float(found[0])) * own)
    if not record.has("link_torque"):
        doubt = max(doubt, _RATIO_TOLERANCE)  # gravity twists the joint as well
    return float(found[0] / sizes[0]), doubt, correlation


def shown_ratio(record: Record) -> tuple[float, bool] | None:
    """Gear ratio that the positions of both sides show.

    Returns
    -------
    (ratio, torsion taken off) or None
        The torsion is taken off where it can be told from the motion: it moves the slope of the
        positions by up to a percent. None where a side does not move or is not measured.
    """
    found = measured_ratio(record)
    if found is None:
        return None
    rigid = _rigid_ratio(record)
    if rigid is not None and rigid[2] >= _CORRELATION:
        return rigid[0], True
    return found[0], False


def check_ratio(record: Record, gear_ratio: float | None) -> list[Finding]:
    """Compare the gear ratio of the joint with the one the two positions show."""
    found = measured_ratio(record)
    if found is None:
        return []
    ratio, correlation = found
    if np.unique(record["link_position"]).size < _FEW_VALUES and span(
        record["motor_position"]
    ) < CLAMPED_TRAVEL * abs(gear_ratio or GUESSED_RATIO):
        return [
            Finding(
                "warn",
                "gear_ratio",
                f"{record.name}: link_position hardly moves: fine if the link is locked, else "
                "check its sensor",
                "link_position",
            )
        ]
    rigid = _rigid_ratio(record)
    if (
        gear_ratio is not None
        and rigid is not None
        and rigid[2] >= _CORRELATION
        and abs(rigid[0] / gear_ratio - 1.0) <= _RATIO_TOLERANCE
    ):
        return [_beside_torsion(record, rigid, gear_ratio)]
    if abs(correlation) < _CORRELATION:
        message = (
            f"{record.name}: motor_position and link_position do not move together (correlation "
            f"{correlation:.2f}, "
            f"at least {_CORRELATION} is expected): check that both columns are of the same joint"
        )
        return [Finding("refuse", "gear_ratio", message, "link_position")]
    if gear_ratio is None:
        message = f"{record.name}: the positions show a gear ratio of {ratio:.5g}"
        return [Finding("ok", "gear_ratio", message, "link_position")]
    share = ratio / gear_ratio
    if abs(share - 1.0) <= _RATIO_TOLERANCE:
        message = (
            f"{record.name}: the positions show a gear ratio of {ratio:.5g}, "
            f"{gear_ratio:g} is given"
        )
        return [Finding("ok", "gear_ratio", message, "link_position")]
    doubt = ""
    if abs(share + 1.0) <= _RATIO_TOLERANCE:
        doubt = " (the sign is reversed)"
    elif (
        record.kind == "rotary"
        and min(abs(abs(share) * f - 1.0) for f in (180 / math.pi, math.pi / 180))
        < _FACTOR_TOLERANCE
    ):
        doubt = " (57.3 apart: one position is in degrees)"
    elif (
        record.kind == "rotary"
        and min(abs(abs(share) * f - 1.0) for f in (2 * math.pi, 0.5 / math.pi)) < _FACTOR_TOLERANCE
    ):
        doubt = " (2 pi apart: one position is in turns)"
    elif abs(ratio - 1.0) < _RATIO_TOLERANCE:
        doubt = " (both positions are on one side of the gear: gear_ratio = 1.0)"
    message = (
        f"{record.name}: the positions show a gear ratio of {ratio:.5g}, {gear_ratio:g} is "
        f"given{doubt}: correct gear_ratio, or sign and unit in [columns]"
    )
    return [Finding("refuse", "gear_ratio", message, "link_position")]


def delay(first: FloatArray, second: FloatArray, longest: int = 200) -> tuple[float, float]:
    """Samples by which the second signal lags the first, from the peak of their cross-correlation.

    The correlation coefficient is taken over the same samples of the second signal at every lag, so
    that the finite length of the record does not pull the peak towards zero.

    Parameters
    ----------
    first, second : (n,) ndarray
        Uniformly sampled signals of the same shape over time; scale and sign are free.
    longest : int
        Largest lag looked for, in samples; at most n/4.

    Returns
    -------
    lag, correlation : float
        Lag with the fraction of a sample from a parabola through the peak, and the peak's height.
        Of peaks alike (a periodic motion) the one nearest zero counts.  NaN where a signal is
        constant or the peak lies beyond `longest`.
    """
    reach = min(longest, first.size // 4)
    inner = second[reach : second.size - reach]
    b = inner - inner.mean()
    a = first - first.mean()
    energy = float(b @ b)
    if reach < 1 or energy == 0.0 or not a.any():
        return float("nan"), 0.0
    size = 1 << (a.size + b.size).bit_length()
    product = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)[
        : 2 * reach + 1
    ]
    shift = np.arange(2 * reach + 1)
    sums = np.concatenate([[0.0], np.cumsum(a)])
    squares = np.concatenate([[0.0], np.cumsum(a * a)])
    varied = (
        squares[shift + b.size]
        - squares[shift]
        - (sums[shift + b.size] - sums[shift]) ** 2 / b.size
    )
    coefficient = product / np.sqrt(np.maximum(varied, 1e-12 * squares[-1]) * energy)
    coefficient = np.abs(coefficient)
    inside = coefficient[1:-1]
    tops = (
        (inside >= coefficient[:-2])
        & (inside >= coefficient[2:])
        & (inside > _PEAK * coefficient.max())
    )
    if not tops.any():
        return float("nan"), float(coefficient.max())
    places = np.flatnonzero(tops) + 1
    peak = int(places[np.argmin(np.abs(places - reach))])
    left, middle, right = coefficient[peak - 1 : peak + 2]
    bend = left - 2.0 * middle + right
    return float(reach - peak - (0.5 * (left - right) / bend if bend < 0.0 else 0.0)), float(middle)


def _smoothed(values: FloatArray, width: int) -> FloatArray:
    sums = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    result: FloatArray = (sums[width:] - sums[:-width]) / width
    return result


def check_delay(record: Record, gear_ratio: float | None = None) -> list[Finding]:
    """Warn where a channel lags another by more than the sampling explains, by cross-correlation of
    velocities.

    Velocities are averaged over 0.2 s, so that the resonance of the joint and quantisation do not
    count. Where the torque of the link is measured, the wind-up under it is no lag of the link's
    encoder.
    """
    parts = record.segments()
    part = max(parts, key=lambda s: s.stop - s.start)
    part = slice(part.start, min(part.stop, part.start + _LONGEST))
    stamps = record.time[part]
    if stamps.size < 50 or not np.isfinite(stamps).all() or not (np.diff(stamps) > 0.0).all():
        return []
    grid = np.linspace(stamps[0], stamps[-1], stamps.size)
    dt = float(grid[1] - grid[0])
    width = max(1, min(round(0.2 / dt), stamps.size // 20))

    def even(channel: str) -> FloatArray:
        return np.asarray(np.interp(grid, stamps, record[channel][part]), dtype=np.float64)

    def rate(channel: str) -> FloatArray:
        values = even(channel)
        result: FloatArray = np.gradient(values, dt) if channel.endswith("_position") else values
        return _smoothed(result, width)

    findings = []
    for first, second in (
        ("motor_position", "link_position"),
        ("motor_position", "motor_velocity"),
        ("link_position", "link_velocity"),
    ):
        if (
            not record.has(first, second)
            or not np.isfinite(record[first][part] + record[second][part]).all()
        ):
            continue
        lag, correlation = delay(rate(first), rate(second))
        if not math.isfinite(lag) or correlation < _CORRELATION:
            continue
        if (
            second == "link_position"
            and gear_ratio is not None
            and record.has("link_torque")
            and np.isfinite(record["link_torque"][part]).all()
        ):
            moved = np.interp(grid + lag * dt, grid, even("link_position"))
            inner = slice(int(max(-lag, 0)) + 1, len(grid) - int(max(lag, 0)) - 1)
            twist = (even("motor_position") / gear_ratio - moved)[inner]
            lag += _behind(twist, even("link_torque")[inner], moved[inner], width)
        said = (
            f"{record.name}: {second} lags {first} by {1e3 * lag * dt:.3g} ms ({lag:.2f} samples)"
        )
        if abs(lag) > _SKEWED:
            advice = "check the logger's clocks and filters, or shift the channel (shift_channel)"
            if second == "link_position":
                advice += "; a fit of both positions takes up to 3.5 samples off by itself"
            findings.append(Finding("warn", "delay", f"{said}: {advice}", second))
        else:
            findings.append(Finding("ok", "delay", said, second))
    return findings


def _behind(twist: FloatArray, torque: FloatArray, position: FloatArray, width: int) -> float:
    """Samples by which the link's encoder is behind: slope of the twist over the
    velocity, the wind-up under the torque and its rate aside.
    """
    load, velocity = _smoothed(torque, width), np.gradient(_smoothed(position, width))
    columns = np.column_stack([velocity, load, np.gradient(load), np.ones(len(load))])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    slopes = np.linalg.lstsq(columns / size, _smoothed(twist, width), rcond=1e-9)[0] / size
    return float(slopes[0])
