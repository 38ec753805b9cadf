"""Records prepared for the balances: kernels, blocks, scales and noise."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, final
from weakref import WeakKeyDictionary, WeakValueDictionary

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel, hold
from casadi_models.term import LOAD_COMPLIANCE, SIDE_INERTIAS
from identification.balance.calibration import named_late, of_run, start_values, unknowns_of
from identification.balance.clocks import (
    SIGNAL,
    as_told,
    in_time,
    link_hidden,
    places_of,
    shifted,
)
from identification.balance.colour import ChannelNoise, Part, white
from identification.balance.contacts import TOLD_BY, restored
from identification.balance.drawn_noise import doubts_of
from identification.balance.memory import cache_of
from identification.balance.noise import noise_of
from identification.balance.sensing import Sensing, adapt, check_alike, sense, signals_of
from identification.balance.slow_noise import SlowNoise, drifts_of, power_of, slow_noise_of
from identification.balance.spikes import without_spikes
from identification.balance.stamps import bridge_errors, evened
from identification.balance.weak import (
    CLAIM_KERNEL,
    HELD_READINGS,
    KERNEL_SAMPLES,
    PAIR,
    POSITION_CHAINS,
    WeakRecord,
    differentiated_kernel,
    kernel,
    prepare,
    whole,
)
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

HOLD_DELAY: Final = hold.HOLD_DELAY
HOLD_NAME: Final = hold.HOLD_NAME
ONE_SIDED_KERNEL: Final = 0.2
OF_TORQUE: Final = "torque_sensor"
"""Place of the reading that is late beside the motor alone."""
LINK_BALANCES: Final = frozenset({"link", "sum", "axis"})
POINTWISE_KERNELS: Final = (0.01, 0.014, 0.02, 0.03)
SHORT_KERNELS: Final = (2, 4)
"""Kernels in samples: a fine encoder needs no longer one, and every kernel rounds off the turn at
which friction changes its sign within a sample."""
SHORT_NOISE: Final = 2e-4
"""Noise of the velocity by such a kernel, as a share of the record's speed: friction changes its
sign over a hundredth of that speed and less, and rest is told from motion there."""
STILL: Final = 3.0
"""Pointwise speed of a side at rest, in standard deviations of its noise: 0.3 % of samples at
rest lie above.
"""
NANOSECOND: Final = 1e-9
"""What two shifts may differ by and be the same [s]: no stamp is finer."""
DIGITS: Final = 9
"""Of a shift in samples: those that a time in seconds gives again."""
PREPARED: Final = 16_000_000
"""Values of prepared records that a thread keeps (128 MB): two records of 40 s at 1 kHz at every
kernel of the verdict.
"""
TWIST_NOISE: Final = 5e-4
"""Noise of the torsion that a law with memory may follow, as a share of the torsion's size: a tenth
of the narrowest width that is tried for such a law."""
VELOCITY_NOISE: Final = 2e-3
"""Noise of a pointwise velocity, as a share of the record's speed, that is small enough."""


@final
@dataclass(frozen=True)
class Dataset:
    """Records prepared for the balances: training rows and rows the fit never sees.

    Attributes
    ----------
    joint, sensing : what is known and what is measured
    train, held_out : tuple of WeakRecord
    ranges : mapping of str to float
        99 % range of velocity [rad/s], torsion [rad], position [rad] and the duration [s]: scales
        of shape grids.
    noise : mapping of str to float
        White-noise level of each measured signal.
    orders : mapping of str to tuple of float
        By effect, orders per motor turn at which a line carries its name: start values of its
        shape.
    other_orders : tuple of float
        Orders per motor turn of lines without a name: what stands there is no named effect.
    colours : mapping of str to ChannelNoise
        Noise of each measured signal that is not white, in the proportions of its parts.
    """

    joint: Joint
    sensing: Sensing
    train: tuple[WeakRecord, ...]
    held_out: tuple[WeakRecord, ...]
    ranges: Mapping[str, float]
    noise: Mapping[str, float]
    train_names: tuple[str, ...] = ()
    held_out_names: tuple[str, ...] = ()
    note: str = ""
    orders: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    other_orders: tuple[float, ...] = ()
    colours: Mapping[str, ChannelNoise] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"Dataset({self.joint.name!r}, train: {list(self.train_names)}, held out: "
            f"{list(self.held_out_names)}, balances: {self.sensing.balances})"
        )

    @property
    def sources(self) -> dict[str, ChannelNoise]:
        """Noise of each measured signal, as it is drawn."""
        return {
            c: self.colours[c].scaled(level) if c in self.colours else white(level)
            for c, level in self.noise.items()
        }

    def with_slow_noise(self, slow: Mapping[str, SlowNoise]) -> Dataset:
        """The same records, the readings of some signals drifting and humming by as much at
        least.
        """
        colours, sources = dict(self.colours), self.sources
        for signal, told in slow.items():
            noise = sources[signal]
            for part in told.parts:
                if noise.drift is None or noise.drift.size < part.size:
                    calm = noise.without_drift
                    noise = replace(calm, parts=(*calm.parts, part))
            if told.filtered is not None:
                kept = noise.drift
                noise = replace(noise, parts=(told.filtered, *([kept] if kept else [])))
            if power_of(noise.hum) < power_of(told.lines):
                calm = noise.without_hum
                noise = replace(calm, lines=(*calm.lines, *told.lines))
            colours[signal] = noise
        return replace(self, colours=colours)

    @property
    def kernel(self) -> float:
        """Kernel length of the balances [s]."""
        return self.train[0].grid.length

    def at_rest(self, records: Sequence[WeakRecord] | None = None) -> float:
        """Share of the rows (of all records by default) that are at rest in some balance and
        left out of it.
        """
        chosen = (*self.train, *self.held_out) if records is None else tuple(records)
        left = sum(
            int(
                np.any(
                    [w.resting(b) for b in self.sensing.balances if b not in w.masked], axis=0
                ).sum()
            )
            for w in chosen
        )
        return left / max(sum(w.rows for w in chosen), 1)

    @property
    def lengthened(self) -> bool:
        """Whether rows are longer than usual, as noise or who asks for a kernel wants them."""
        usual = max(usual_kernel(self.sensing, self.joint), KERNEL_SAMPLES * self.train[0].grid.dt)
        return self.kernel > math.sqrt(2) * usual

    @property
    def blocks(self) -> int:
        """Number of training blocks."""
        return 1 + max(int(w.block.max(initial=-1)) for w in self.train)


def usual_kernel(sensing: Sensing, joint: Joint) -> float:
    """Length of a row where noise asks for no longer one [s]."""
    geared = abs(joint.gear_ratio) != 1.0
    return ONE_SIDED_KERNEL if geared and seen_from_the_motor(sensing, joint) else CLAIM_KERNEL


FEWEST_ROWS: Final = 40
"""Rows of each balance that the training and the held-out records must have: four to a kernel
length, ten of them that are independent."""


def load_dataset(
    train: Sequence[Record],
    held_out: Sequence[Record],
    joint: Joint,
    model: JointModel,
    *,
    kernel: float | None = None,
    like: Sensing | None = None,
    told: Dataset | None = None,
    late: Sequence[Mapping[str, float]] | None = None,
) -> Dataset:
    """Prepare records for the balances that their common channels allow (`like`: temperature counts
    as in the records of a fit; `told`: the same records at the kernel that has told how late their
    channels are and what their sensors' noise is, neither of which hangs on a kernel; `late`: of
    each record, by how much its channels are to be shifted [s], where that is known).

    Raises
    ------
    InputError
        Too short; channels that do not fit the model; a record of training and held-out data
        without a common channel set.
    """
    sensing = check_alike([*train, *held_out], model)
    if like is not None:
        sensing = replace(
            sensing, temperature_origin=like.temperature_origin, longest_run=like.longest_run
        )
    length = kernel or usual_kernel(sensing, joint)
    prepared: list[WeakRecord] = []
    first, count = 0, len(train)
    again: list[Callable[..., WeakRecord]] = []
    if late is None and told is not None:
        late = [w.shifts for w in (*told.train, *told.held_out)]

    for number, record in enumerate((*train, *held_out)):
        way = partial(_once, curved=model.lagging_load, late=places_of(model))
        again.append(partial(way, record, joint, sensing, length, first))
        prepared.append(
            again[-1](
                known=None if late is None else late[number],
                before=None if told is None else (*told.train, *told.held_out)[number],
            )
        )
        first = max(first, 1 + int(prepared[-1].block.max(initial=first - 1)))
    for number, (record, made) in enumerate(zip((*train, *held_out), prepared, strict=True)):
        seen = {p: [w.filters[p] for w in prepared[:count] if p in w.filters] for p in made.filters}
        agreed = {p: as_told(seen[p], f) for p, f in made.filters.items() if seen[p]}
        if not made.shifts.get(OF_TORQUE, 0.0) and late is None:
            # a record that tells nothing of it has the torque sensor of the others
            others = [w.shifts[OF_TORQUE] for w in prepared[:count] if w.shifts.get(OF_TORQUE, 0.0)]
            hidden = sensing.both_positions and others and link_hidden(made)
            if others and (sensing.motor_and_torque or hidden):
                agreed |= {OF_TORQUE: float(np.median(others))}
        if any(abs(made.shifts.get(p, 0.0) - x) > NANOSECOND for p, x in agreed.items()):
            made = replace(again[number](known={**made.shifts, **agreed}), filters=made.filters)
        if record.payload != train[0].payload:
            made = replace(made, masked=_of_the_link(record, sensing))
        prepared[number] = made
    fewest = FEWEST_ROWS if told is None else 1  # another kernel has fewer of the same motion
    for balance in sensing.balances:
        if held_out and all(balance in made.masked for made in prepared[count:]):
            raise InputError(
                f"{held_out[0].name}: every held-out record has another payload than "
                f"{train[0].name}, so none shows the {balance} balance; "
                "give a held-out record with the same payload"
            )
        for records, kind in ((prepared[:count], "training"), (prepared[count:], "held-out")):
            moving = [int(w.taking(balance).sum()) for w in records if balance not in w.masked]
            if moving and sum(moving) < fewest:
                name = (train if kind == "training" else held_out)[0].name
                seconds = FEWEST_ROWS / 4 * length
                raise InputError(
                    f"{name}: the joint stands still in every {kind} record"
                    + (", but for a moment" if any(moving) else "")
                    + f"; give one in which it moves for at least {seconds:.2g} s"
                )
    noise, colours = (
        _noise_of_all(train, prepared, joint, sensing)
        if told is None
        else (told.noise, told.colours)
    )
    return Dataset(
        joint,
        sensing,
        train=tuple(prepared[:count]),
        held_out=tuple(prepared[count:]),
        ranges=_ranges(prepared[:count], model, torque=sensing.has_torque),
        noise=noise,
        train_names=tuple(r.name for r in train),
        held_out_names=tuple(r.name for r in held_out),
        colours=colours,
    )


def _noise_of_all(
    train: Sequence[Record], prepared: Sequence[WeakRecord], joint: Joint, sensing: Sensing
) -> tuple[Mapping[str, float], Mapping[str, ChannelNoise]]:
    """Level and colour of the noise of each measured signal; `prepared` are the training records
    and then the held-out ones, whose sensors are the same.
    """
    trained, others = prepared[: len(train)], prepared[len(train) :]
    slow = _of_one_make([*map(slow_noise_of, trained), *map(drifts_of, others)])
    found = [
        _with_slow(measured_sources(r, joint, sensing), own)
        for r, own in zip(train, slow, strict=False)
    ]
    noise = {c: float(np.median([one[c].level for one in found])) for c in found[0]}
    # colours are those of the record in the middle
    colours = {c: sorted((one[c] for one in found), key=_loudness)[len(found) // 2] for c in noise}
    return noise, {c: x for c, x in colours.items() if x != white(x.level)}


def _once(
    record: Record,
    joint: Joint,
    sensing: Sensing,
    length: float,
    first_block: int,
    *,
    curved: bool,
    late: Sequence[str],
    known: Mapping[str, float] | None,
    before: WeakRecord | None = None,
) -> WeakRecord:
    """:func:`weak_record` by its name, prepared once for the verbs that follow each other on a
    record.
    """

    def make() -> tuple[WeakRecord, int]:
        made = weak_record(
            record,
            joint,
            sensing,
            length,
            first_block,
            curved=curved,
            late=late,
            known=known,
            before=before,
        )
        tables = (made.averaged, made.points, made.smooth, made.curved, made.paired, *made.doubts)
        return replace(made, name=run_name(record)), sum(
            x.size for table in tables for x in table.values()
        )

    scales = (joint.gear_ratio, joint.torque_per_current, joint.torque_per_voltage)
    told = None if known is None else tuple(sorted(known.items()))
    law = (scales, sensing, length, first_block, curved, tuple(late), told)
    living = _LIVING.setdefault(record, WeakValueDictionary())
    found: WeakRecord = living.get(law) or cache_of("prepared").get(record, law, make, PREPARED)
    living[law] = found
    return found


_LIVING: Final[WeakKeyDictionary[Record, WeakValueDictionary[Hashable, WeakRecord]]] = (
    WeakKeyDictionary()
)
"""Prepared records that somebody holds, however long: to give them again costs nothing."""


def run_name(record: Record) -> str:
    """Name of a record with a mark of its samples: another run under the same name is another
    run.
    """
    position = next(record[c] for c in ("link_position", "motor_position") if record.has(c))
    return f"{record.name}:{zlib.crc32(np.ascontiguousarray(position).tobytes()):08x}"


def _of_the_link(record: Record, sensing: Sensing) -> frozenset[str]:
    """Balances with parameters of the link, which a record with another payload does not share."""
    masked = frozenset(sensing.balances) & LINK_BALANCES
    if masked == frozenset(sensing.balances):
        raise InputError(
            f"{record.name}: a record with another payload needs link_torque or both positions, "
            "else every balance holds the link"
        )
    return masked


def seen_from_the_motor(sensing: Sensing, joint: Joint) -> bool:
    """True for a joint with a transmission of which only the drive side is recorded: the load hangs
    on a compliance nobody measures. A linear axis has its screw or belt, whatever its ratio says;
    one whose fitted values know of none was fitted as rigid, and is.
    """
    linear = joint.kind == "linear" and (not joint.fitted or LOAD_COMPLIANCE.name in joint.fitted)
    return (
        sensing.balances == ("axis",)
        and sensing.moving == "motor_position"
        and not sensing.both_positions
        and (abs(joint.gear_ratio) != 1.0 or linear)
    )


def weak_record(
    record: Record,
    joint: Joint,
    sensing: Sensing,
    length: float,
    first_block: int = 0,
    *,
    curved: bool = False,
    late: Sequence[str] = (),
    known: Mapping[str, float] | None = None,
    before: WeakRecord | None = None,
) -> WeakRecord:
    """One record, resampled to uniform time where needed, averaged with the kernel; the channels
    of the places `late` are shifted where they are late (`known`: by these times [s]). `before` is
    the same record at another kernel: its points are taken over where they are the same.
    """
    noise = measured_sources(record, joint, sensing)
    record = evened(record)
    segments = tuple(record.segments())
    read = signals_of(record, joint, sensing)
    signals = {
        c: without_spikes(x, segments, noise[c].level) if c in noise else x for c, x in read.items()
    }
    shortest = KERNEL_SAMPLES * record.dt
    length = max(length, shortest)
    longest = length / 2 if length <= CLAIM_KERNEL else 0.06
    pointwise = {
        c: pointwise_kernel(signals[c], segments, record.dt, longest, own)
        for c, own in noise.items()
    }
    torsion = torsion_kernel(signals, segments, record.dt, pointwise, noise)

    mended = {c: signals[c] for c in TOLD_BY if c in signals and signals[c] is not read[c]}
    last = [] if before is None else [before]

    def made_with(shifts: Mapping[str, float]) -> WeakRecord:
        # found here in samples or told again in seconds: the same shift is the same number
        shifts = {p: round(k, DIGITS) for p, k in shifts.items()}
        moved, parts = shifted(signals, segments, shifts)
        times = {p: k * record.dt for p, k in shifts.items()}
        before = last.pop() if last else None
        was = {} if before is None else before.shifts
        changed = {SIGNAL[p] for p in {*times, *was} if times.get(p, 0.0) != was.get(p, 0.0)}
        # a torque that was mended is another one in every round of that
        changed |= set(mended)
        made = prepare(
            record.time,
            moved,
            parts,
            length=length,
            first_block=first_block,
            pointwise=pointwise,
            torsion=torsion,
            curved=curved,
            before=before,
            same=set(signals) - changed,
            readings={SIGNAL[p]: np.roll(signals[SIGNAL[p]], -round(k)) for p, k in shifts.items()},
        )
        if made.rows < 8:
            parted = f" in {len(segments)} stretches" if len(segments) > 1 else ""
            raise InputError(
                f"{record.name}: {len(record)} samples in {record.duration:.3g} s{parted} are too "
                f"few for a kernel of {length:.3g} s; give a longer record"
                f"{' with fewer gaps' if parted else ''}"
            )
        made = replace(
            made,
            shifts=times,
            doubts=doubts_of(made.grid, moved, noise),
        )
        last.append(made)
        return made

    def spread(heard: WeakRecord, length: float, place: str, lateness: float) -> float:
        plain, rate = (differentiated_kernel(length, record.dt, order) for order in (0, 1))
        own = _with_slow(noise, slow_noise_of(heard))[SIGNAL[place]]
        return own.after(plain + lateness * rate, record.dt) ** 2

    if known is not None:
        made = made_with({p: k / record.dt for p, k in known.items()})
    else:
        made = (
            in_time(
                made_with,
                late,
                spread,
                torque=sensing.has_torque,
                motor_alone=sensing.motor_and_torque,
                both_encoders=sensing.both_positions,
            )
            if late
            else made_with({})
        )
    if mended:
        shifts = {p: k / record.dt for p, k in made.shifts.items()}

        def remade(torques: Mapping[str, FloatArray]) -> WeakRecord:
            signals.update(torques)
            last.clear()
            return made_with(shifts)

        late_by = {SIGNAL[p]: k for p, k in shifts.items()}
        made = replace(restored(made, mended, read, late_by, remade), filters=made.filters)
    made = _with_rests(made, noise)
    if record.measured is not None and not record.measured.all():
        made = replace(
            made,
            support=made.grid.correlate(
                record.measured.astype(float),
                differentiated_kernel(made.grid.length, made.grid.dt, 0),
            ),
            bridging={
                c: bridge_errors(signals[c], record.measured, segments, _loudness(own))
                for c, own in noise.items()
                if c in signals
            },
            lost=~record.measured,
        )
    return made


def _with_rests(made: WeakRecord, noise: Mapping[str, ChannelNoise]) -> WeakRecord:
    """The record with the kernel average, for each row, of the flag "this side stands still".

    A side stands still where its pointwise speed stays within its noise for at least one kernel of
    that speed: a reversal is shorter, and is kept, because it shows friction at low speed. Laws
    with memory follow a straight line through a rest: the noise of a position that stands still
    would wear their state down, since they count every step, whatever its sign. Where both sides
    stand still and an encoder reads in steps, the rows have one reading in all of the twist.
    """
    out: dict[str, FloatArray] = {}
    stills: list[FloatArray] = []
    smooth, paired = dict(made.smooth), dict(made.paired)
    doubts = tuple(dict(d) for d in made.doubts)
    for side in ("motor", "link"):
        source = f"{side}_position"
        if source not in noise:
            continue
        still_speed = STILL * made.grid.velocity_noise(source, noise[source])
        slow = np.abs(made.points[f"{side}_velocity"]) <= still_speed
        shortest = max(1, whole(made.grid.pointwise[source] / (made.grid.step * made.grid.dt)))
        still = np.zeros(len(slow))
        tables = [t for t in (smooth, paired, *doubts) if source in t]
        for t in tables:
            t[source] = t[source].copy()
        for first, last in zip(made.starts[:-1], made.starts[1:], strict=True):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], slow[first:last], [False]])))
            for begin, end in edges.reshape(-1, 2):
                if end - begin >= shortest:
                    rows = slice(first + begin, first + end)
                    still[rows] = 1.0
                    for t in tables:
                        held = t[source]
                        held[rows] = np.linspace(held[rows.start], held[rows.stop - 1], end - begin)
        out[side] = made.average(still) if still.any() else np.zeros(made.rows)
        stills.append(still)
    if len(stills) == 2:
        both = stills[0] * stills[1]
        if both.any() and any(noise[c].step > 0 for c in PAIR):
            out[HELD_READINGS] = made.average(both)
    return replace(made, rest=out, smooth=smooth, paired=paired, doubts=doubts)


def _loudness(noise: ChannelNoise) -> float:
    """Deviation of all parts of a noise, which is what a slow row sees most of."""
    return sum(part.size**2 for part in noise.parts)


def _with_slow(
    sources: Mapping[str, ChannelNoise], slow: Mapping[str, SlowNoise]
) -> dict[str, ChannelNoise]:
    """The noise of each signal with that which no difference of neighbours shows."""
    return {
        c: replace(own, parts=(*own.parts, *slow[c].parts), lines=(*own.lines, *slow[c].lines))
        if c in slow
        else own
        for c, own in sources.items()
    }


def _of_one_make(found: Sequence[Mapping[str, SlowNoise]]) -> list[dict[str, SlowNoise]]:
    """The same sensors walked in all records: each has the mean of their walks, as one course of a
    walk tells its rate badly.
    """
    out = [dict(slow) for slow in found]
    for c in {c for slow in found for c in slow}:
        parts = [slow[c].parts for slow in found if c in slow]
        walking = [part for own in parts for part in own]
        if not walking:
            continue
        rate = sum(part.size**2 / part.memory for part in walking) / len(parts)
        memory = max(part.memory for part in walking)
        mean = (Part(math.sqrt(rate * memory), memory),)
        for slow in out:
            if c in slow:
                slow[c] = replace(slow[c], parts=mean)
    return out


def measured_sources(record: Record, joint: Joint, sensing: Sensing) -> dict[str, ChannelNoise]:
    """Noise of each measured signal, from samples that were measured: bridges are smoother than a
    reading.
    """
    signals = signals_of(record, joint, sensing)
    return {
        c: noise_of(
            record,
            c,
            x,
            joint.gear_ratio,
            None if c.endswith("position") else signals.get("motor_position"),
        )
        for c, x in signals.items()
        if c in POSITION_CHAINS
    }


def pointwise_kernel(
    position: FloatArray,
    segments: tuple[slice, ...],
    dt: float,
    longest: float,
    noise: ChannelNoise,
) -> float:
    """Shortest kernel whose velocity noise does not matter beside the velocities of the record [s].

    A long kernel rounds off reversals, and the laws of friction at low speed then fit the rounding.
    """
    lag = max(1, whole(POINTWISE_KERNELS[-1] / dt))
    change = np.concatenate(
        [np.abs(position[s][lag:] - position[s][:-lag]) for s in segments if s.stop - s.start > lag]
        or [np.zeros(1)]
    )
    fast = float(np.quantile(change, 0.99)) / (lag * dt)
    short = [(n * dt, SHORT_NOISE) for n in SHORT_KERNELS]
    for length, share in (*short, *((x, VELOCITY_NOISE) for x in POINTWISE_KERNELS if x >= 6 * dt)):
        if length < longest and noise.after(kernel(length, dt, 1), dt) <= share * fast:
            return length
    return max(longest, 6 * dt)


def torsion_kernel(
    signals: Mapping[str, FloatArray],
    segments: tuple[slice, ...],
    dt: float,
    pointwise: Mapping[str, float],
    noise: Mapping[str, ChannelNoise],
) -> float:
    """Kernel of both positions for laws that follow their difference [s]: the shortest one whose
    noise does not matter beside the widths of such laws, no longer than those of the velocities;
    0 where there are not two positions.

    A law with memory counts every turn of the torsion, and a longer kernel takes its corners off.
    """
    if not set(PAIR) <= set(noise):
        return 0.0
    motor, link = (np.concatenate([signals[c][s] for s in segments]) for c in PAIR)
    twist = motor - link
    span = float(np.quantile(np.abs(twist - np.median(twist)), 0.99))
    longest = max(pointwise[c] for c in PAIR)
    for length in (*(n * dt for n in SHORT_KERNELS), *POINTWISE_KERNELS):
        if length >= longest:
            break
        weights = kernel(length, dt, 0)
        if math.hypot(*(noise[c].after(weights, dt) for c in PAIR)) <= TWIST_NOISE * span:
            return length
    return longest


def _ranges(data: Sequence[WeakRecord], model: JointModel, *, torque: bool) -> dict[str, float]:
    """See :class:`Dataset`. A torsion counts from where the twist begins, and not from where its
    encoders read the same: a kink of the stiffness that is looked for up to an encoder's zero is
    looked for where no twist is.
    """

    def span(values: FloatArray) -> float:
        return float(np.quantile(np.abs(values), 0.99)) or 1e-12

    speed = np.concatenate([w.smooth["motor_velocity"] for w in data])
    q = np.concatenate([w.smooth["motor_position"] for w in data])
    zeros = start_values(model, data, torque=torque)
    twist = (
        q
        if model.clamped_link
        else np.concatenate(
            [
                w.smooth["motor_position"]
                - w.smooth["link_position"]
                + zeros.get(of_run("link_encoder_zero", w), 0.0)
                for w in data
            ]
        )
    )
    duration = sum(float(np.ptp(w.time)) for w in data)
    return {
        "velocity": span(speed),
        "torsion": span(twist),
        "position": span(q - np.median(q)),
        "duration": duration,
        "absolute": 1.0,
    }


def with_effect(model: JointModel, label: str) -> JointModel:
    """The model with one more effect; a delay of a channel, of any length, takes the place of the
    skew of its clock.
    """
    if label == hold.DRIVE_DELAY and HOLD_DELAY in model.effects:
        model = model.drop(HOLD_DELAY)
    return named_late(model.add(label))


def without(model: JointModel, label: str) -> JointModel:
    """The model without an effect; where a delay of a channel goes, the skew of its clock is
    unknown again.
    """
    late = next((t.place for t in model.terms if t.label == label and t.effect.is_delay), None)
    smaller = model.drop(label)
    if label == hold.DRIVE_DELAY:
        smaller = smaller.add(HOLD_DELAY)
    clocks = tuple(
        n for n, u in hold.CLOCKS.items() if u.place == late and n not in smaller.calibration
    )
    there = smaller.calibration
    return replace(smaller, calibration=there + clocks) if there else smaller


def visible_labels(model: JointModel) -> tuple[str, ...]:
    """Labels of the effects, without the nuisance delay of the drive."""
    return tuple(label for label in model.effects if label != HOLD_DELAY)


def prepared_model(joint: Joint, record: Record) -> JointModel:
    """The joint's model in the form that the record's channels can carry."""
    model = joint.model()
    sensing = sense(record, model)
    adapted = adapt(model, sensing, joint.known)
    if sensing.has_drive and not record.has("motor_torque") and not adapted.named("delay", "drive"):
        adapted = adapted.add(HOLD_DELAY)
    lagging = seen_from_the_motor(sensing, joint) and sensing.has_drive
    # the link's own motion loads the gear, where its inertia has a name
    moved = lagging or (sensing.both_positions and adapted.inertias == SIDE_INERTIAS)
    load = "motion" if moved and not sensing.has_torque else adapted.load_from
    return replace(
        adapted,
        lagging_load=lagging,
        load_from=load,
        calibration=unknowns_of(adapted, sensing),
    )
