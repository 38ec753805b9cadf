"""Inputs and outputs of linear models without physics, from records: which signals, how often, and
whether a controller closes the loop.

Velocities that are not recorded are central differences of the positions at the full rate; means
are taken off every stretch; then all signals are resampled alike to the rate that the response
needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.noise import EVEN
from identification.balance.sensing import DRIVES, drive_torque
from identification.data.channels import CHANNELS, channel_unit
from identification.data.joint_file import Joint
from identification.data.prepare import decimate
from identification.data.record import Record
from identification.errors import InputError
from identification.linear.spectra import TRUSTED_COHERENCE, Pair, measure

FloatArray = npt.NDArray[np.float64]

DRIVE, TORSION, REFERENCE = "drive", "torsion", "reference_position"
PER_PERIOD: Final = 5.0
"""Samples per period of the highest frequency that output and input share, as in the subspace model
of the Bode plots: more only crowd the poles together at 1.
"""
ENOUGH: Final = 2000
"""Samples that the thinning leaves: some ten for each row of the compressed Hankel matrix of one
input and two outputs with twenty block rows.
"""
UNSEEN: Final = 1e-3
"""Share of an output's variance that the thinning may take away: a tenth of a percent of VAF."""
SHORTEST: Final = 64
"""Samples of the shortest stretch used, at full rate."""
ALIKE: Final = 0.01
"""Relative difference of two sample times that are one rate."""
OWN_LAGS, OTHER_LAGS = 30, 10
"""Lags of the input and of the output in the test for feedback: a multisine of fifteen lines is
known from thirty lags of itself.
"""
SURE: Final = 4.0
"""Standard errors by which the output must help to predict the input: once in 30 000 records
without feedback.
"""
_FOLLOWS: Final = {"motor_velocity": "motor_position", "link_velocity": "link_position"}


@final
@dataclass(frozen=True)
class Part:
    """Inputs (n, m), outputs (n, p) and reference (n,) of one contiguous stretch, without means."""

    record: str
    u: FloatArray
    y: FloatArray
    reference: FloatArray | None

    def cut(self, first: int, last: int) -> Part:
        """Samples `first` to `last`."""
        kept = None if self.reference is None else self.reference[first:last]
        return Part(self.record, self.u[first:last], self.y[first:last], kept)


@final
@dataclass(frozen=True)
class Ports:
    """What is modelled from what.

    Attributes
    ----------
    inputs, outputs : tuple of (name, SI unit)
    dt : float
        Sampling time [s].
    every : int
        Every how manyth sample of the records is kept.
    link_referred : bool
        True where a joint file says the gear ratio: angles and torques are then those of the link.
    """

    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[tuple[str, str], ...]
    dt: float
    every: int
    link_referred: bool


def choose_ports(
    records: Sequence[Record],
    joint: Joint | None,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of inputs and outputs: those asked for, or the drive and what it moves.

    By default the input is the drive, the outputs are the velocity of the motor (of the link where
    the motor is not measured) and, where both positions and the gear ratio are known, the torsion
    q_m - q_l: seen from the positions themselves it is a thousandth of them. A velocity stands in
    for a position, since a position adds up every offset of the drive.

    Raises
    ------
    InputError
        A name that is no channel or not recorded; nothing to model.
    """
    known = set.intersection(*(_names(r, joint) for r in records))
    for name in (*inputs, *outputs):
        if name not in known:
            offered = ", ".join(sorted(known - {"run"}))
            need = " (the torsion needs --joint, both positions)" if name == TORSION else ""
            raise InputError(f"{name!r} is not in all the records{need}: choose among {offered}")
    driven = list(inputs) or [n for n in (DRIVE, *DRIVES) if n in known][:1]
    if not driven:
        raise InputError(
            "the records hold no motor_torque, motor_current or motor_voltage: name the input by "
            f"--from ({', '.join(sorted(known))})"
        )
    seen = list(outputs) or [n for n in _FOLLOWS if n in known][:1]
    if not outputs and TORSION in known:
        seen.append(TORSION)
    if not seen:
        raise InputError(
            f"the records hold no position: name the output by --to ({', '.join(sorted(known))})"
        )
    both = sorted(set(driven) & set(seen))
    if both:
        raise InputError(f"{both[0]!r} is input and output: leave it out of one")
    return tuple(dict.fromkeys(driven)), tuple(dict.fromkeys(seen))


def parts_of(
    records: Sequence[Record],
    joint: Joint | None,
    names: tuple[tuple[str, ...], tuple[str, ...]],
) -> tuple[list[Part], float]:
    """Contiguous stretches at full rate, and their sampling time [s].

    Raises
    ------
    InputError
        Records of unlike rates; none with a stretch of 64 samples.
    """
    found: list[Part] = []
    dt = 0.0
    for given in records:
        steps = given.steps()
        uneven = bool(steps.size) and float(np.ptp(steps)) > EVEN * given.dt
        record = given.resampled() if uneven else given
        if dt and abs(record.dt / dt - 1.0) > ALIKE:
            raise InputError(
                f"{record.name}: sampled every {record.dt:.6g} s, the other records every "
                f"{dt:.6g} s: resample them alike (irj resample) or leave it out"
            )
        dt = dt or record.dt
        signals = _signals(record, joint)
        for s in record.segments():
            if s.stop - s.start < SHORTEST:
                continue
            u, y = (
                np.column_stack([_centred(signals(n, s)) for n in some]).astype(np.float64)
                for some in names
            )
            kept = _centred(record[REFERENCE][s]) if record.has(REFERENCE) else None
            found.append(Part(given.name, u, y, kept))
    if not found:
        raise InputError(
            f"no stretch of the records has {SHORTEST} samples: record longer, or bridge the gaps "
            "(irj resample)"
        )
    return found, dt


def named_units(names: Sequence[str], joint: Joint | None) -> tuple[tuple[str, str], ...]:
    """Names with their SI units."""
    kind = joint.kind if joint is not None else "rotary"
    stand_in = {DRIVE: "motor_torque", TORSION: "motor_position"}
    return tuple((n, channel_unit(stand_in.get(n, n), kind)) for n in names)


def rate(parts: Sequence[Part], dt: float) -> int:
    """Every how manyth sample to keep: so many that the highest frequency at which an output
    answers an input has five. Where the coherence of the records is too low to tell, that of the
    outputs' own spectrum stands in, above which lies a thousandth of their variance.
    """
    highest = 0.0
    for i in range(parts[0].u.shape[1]):
        for k in range(parts[0].y.shape[1]):
            pairs = [Pair(p.u[:, i], p.y[:, k], None, dt, 0) for p in parts]
            seen = measure(pairs, "", "")
            if seen is not None:
                lost = seen.coherence < TRUSTED_COHERENCE
                ends = np.flatnonzero(lost[:-1] & lost[1:])  # one band alone may be a dip
                last = int(ends[0]) - 1 if len(ends) else len(lost) - 1
                highest = max(highest, float(seen.frequency[max(last, 0)]))
    highest = highest or max(_edge(p.y[:, k], dt) for p in parts for k in range(p.y.shape[1]))
    most = max(1, sum(len(p.u) for p in parts) // ENOUGH)
    return min(max(1, int(1.0 / (PER_PERIOD * highest * dt))), most) if highest else 1


def _edge(signal: FloatArray, dt: float) -> float:
    """Frequency [Hz] above which a thousandth of a signal's variance lies."""
    power = np.abs(np.fft.rfft(signal * np.hanning(len(signal)))) ** 2
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    return float(np.fft.rfftfreq(len(signal), dt)[int(np.searchsorted(share, 1.0 - UNSEEN))])


def thinned(parts: Sequence[Part], every: int) -> list[Part]:
    """Every `every`-th sample after a low-pass; stretches that get too short are left out.

    Raises
    ------
    InputError
        None is long enough.
    """
    if every == 1:
        return list(parts)
    found = []
    for p in parts:
        if len(p.u) < SHORTEST or len(p.u) // every < 2:
            continue
        kept = None if p.reference is None else decimate(p.reference, every)
        found.append(Part(p.record, decimate(p.u, every), decimate(p.y, every), kept))
    if parts and not found:
        raise InputError(
            f"{parts[0].record}: no stretch is long enough to keep every {every}th sample: give a "
            "smaller --every or record longer"
        )
    return found


def checked_motion(parts: Sequence[Part], names: Sequence[str]) -> None:
    """Refuse signals that do not move.

    Raises
    ------
    InputError
        Names the signal.
    """
    both = np.concatenate([np.hstack([p.u, p.y]) for p in parts])
    span = np.ptp(both, axis=0)
    for name, width in zip(names, span, strict=True):
        if not width > 0.0:
            raise InputError(
                f"{name} is constant in the records: a response needs one that moves; choose "
                "another by --from or --to"
            )


def feedback(parts: Sequence[Part]) -> bool:
    """Whether a controller closes the loop: past outputs help to predict the input.

    Least squares on thirty lags of the input, with and without ten lags of the outputs, from the
    first half of every stretch; the squared errors on the second halves are compared (Diebold and
    Mariano, J. Bus. Econ. Stat. 13 (1995) 253; the idea is Granger's, Econometrica 37 (1969) 424).
    """
    own, both, target, first = [], [], [], []
    for p in parts:
        if len(p.u) < 4 * OWN_LAGS:
            continue
        rows = len(p.u) - OWN_LAGS
        own.append(_lags(p.u, OWN_LAGS, rows))
        # what a controller holds is often the sum of what is seen: a position that of a velocity
        both.append(np.hstack([_lags(p.y, OTHER_LAGS, rows), _sums(p.y, rows)]))
        target.append(p.u[OWN_LAGS:, 0])
        first.append(np.arange(rows) < rows // 2)
    if not own:
        return False
    a, b, u = (np.concatenate(one) for one in (own, both, target))
    early = np.concatenate(first).astype(bool)
    errors = []
    for columns in (a, np.hstack([a, b])):
        size = np.maximum(columns[early].std(axis=0), 1e-300)
        solved = np.linalg.lstsq(columns[early] / size, u[early], rcond=1e-10)[0]
        errors.append(u[~early] - columns[~early] / size @ solved)
    gain = errors[0] ** 2 - errors[1] ** 2
    return bool(float(gain.mean()) > SURE * float(gain.std()) / np.sqrt(len(gain)))


def _lags(signals: FloatArray, count: int, rows: int) -> FloatArray:
    """Columns of the signals 1 to `count` samples back, for the last `rows` samples."""
    end = len(signals)
    return np.hstack([signals[end - rows - k : end - k] for k in range(1, count + 1)])


def _sums(signals: FloatArray, rows: int) -> FloatArray:
    """Sums of the signals up to one sample back, for the last `rows` samples."""
    end = len(signals)
    summed: FloatArray = np.cumsum(signals, axis=0)[end - rows - 1 : end - 1]
    return summed


def _names(record: Record, joint: Joint | None) -> set[str]:
    found = {c for c in CHANNELS if record.has(c)} - {"run"}
    found |= {v for v, q in _FOLLOWS.items() if record.has(q)}
    if joint is not None:
        if any(record.has(c) for c in DRIVES):
            found.add(DRIVE)
        if record.has("motor_position", "link_position"):
            found.add(TORSION)
    return found


@final
class _signals:
    """Signals of one record by name, link-referred where the joint is known."""

    def __init__(self, record: Record, joint: Joint | None) -> None:
        self._record, self._joint = record, joint
        self._ratio = 1.0 if joint is None else joint.gear_ratio

    def __call__(self, name: str, rows: slice) -> FloatArray:
        record = self._record
        if name == DRIVE and self._joint is not None:
            return drive_torque(record, self._joint)[rows]
        if name == TORSION:
            return self("motor_position", rows) - self("link_position", rows)
        if name in _FOLLOWS and not record.has(name):
            position = self(_FOLLOWS[name], rows)
            return np.asarray(np.gradient(position, record.dt), dtype=np.float64)
        values = np.asarray(record[name][rows], dtype=np.float64)
        scale = _SCALES.get(name, 0)
        return values * self._ratio**scale if scale else values


_SCALES: Final[Mapping[str, int]] = {
    "motor_torque": 1,
    "motor_position": -1,
    "motor_velocity": -1,
    "motor_acceleration": -1,
}
"""Power of the gear ratio that refers a channel to the link."""


def _centred(values: npt.ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    return np.asarray(array - array.mean(), dtype=np.float64)
