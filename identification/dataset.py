"""Records prepared for the balances: kernels, blocks, scales and noise."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.calibration import unknowns_of
from identification.errors import InputError
from identification.joint_file import Joint
from identification.noise import noise_level
from identification.record import Record
from identification.sensing import Sensing, adapt, check_alike, sense, signals_of
from identification.weak import POSITION_CHAINS, WeakRecord, kernel, prepare

FloatArray = npt.NDArray[np.float64]

HOLD_DELAY: Final = "channel_delay@drive#0"
"""In every model with a commanded drive: the hold of the logged command is not an effect, but a nuisance of at most a sample."""
HOLD_NAME: Final = "drive_delay_0"
_DRIVE_DELAY: Final = "channel_delay@drive"
CLAIM_KERNEL: Final = 0.06
ONE_SIDED_KERNEL: Final = 0.2
LINK_BALANCES: Final = frozenset({"link", "sum", "axis"})
POINTWISE_KERNELS: Final = (0.01, 0.014, 0.02, 0.03)
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
        99 % range of velocity [rad/s], torsion [rad], position [rad] and the duration [s]: scales of shape grids.
    noise : mapping of str to float
        White-noise level of each measured signal.
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

    @property
    def kernel(self) -> float:
        """Kernel length of the balances [s]."""
        return self.train[0].grid.length

    @property
    def blocks(self) -> int:
        """Number of training blocks."""
        return 1 + max(int(w.block.max(initial=-1)) for w in self.train)


def load_dataset(
    train: Sequence[Record], held_out: Sequence[Record], joint: Joint, model: JointModel, *, kernel: float | None = None,
    like: Sensing | None = None,
) -> Dataset:  # fmt: skip
    """Prepare records for the balances that their common channels allow (`like`: temperature counts as in the records of a fit).

    Raises
    ------
    InputError
        Too short; channels that do not fit the model; a record of training and held-out data without a common channel set.
    """
    sensing = check_alike([*train, *held_out], model)
    if like is not None:
        sensing = replace(sensing, temperature_origin=like.temperature_origin, longest_run=like.longest_run)
    alone = seen_from_the_motor(sensing, joint)
    length = kernel or (ONE_SIDED_KERNEL if alone else CLAIM_KERNEL)
    prepared: list[WeakRecord] = []
    first = 0
    for record in (*train, *held_out):
        made = weak_record(record, joint, sensing, length, first, curved=model.lagging_load)
        made = replace(made, name=run_name(record))
        if record.payload != train[0].payload:
            made = replace(made, masked=_of_the_link(record, sensing))
        first = max(first, 1 + int(made.block.max(initial=first - 1)))
        prepared.append(made)
    count = len(train)
    for balance in sensing.balances:
        if held_out and all(balance in made.masked for made in prepared[count:]):
            raise InputError(
                f"{held_out[0].name}: every held-out record has another payload than {train[0].name}, so none shows the {balance} balance; "
                "give a held-out record with the same payload"
            )
    signals = [signals_of(r, joint, sensing) for r in train]
    names = {c for s in signals for c in s if c in POSITION_CHAINS}
    noise = {c: float(np.median([noise_level(s[c], tuple(r.segments()), r.time) for s, r in zip(signals, train, strict=True)])) for c in names}
    return Dataset(
        joint, sensing, tuple(prepared[:count]), tuple(prepared[count:]), _ranges(prepared[:count], model.clamped_link), noise,
        tuple(r.name for r in train), tuple(r.name for r in held_out),
    )  # fmt: skip


def run_name(record: Record) -> str:
    """Name of a record with a mark of its samples: another run under the same name is another run."""
    position = next(record[c] for c in ("link_position", "motor_position") if record.has(c))
    return f"{record.name}:{zlib.crc32(np.ascontiguousarray(position).tobytes()):08x}"


def _of_the_link(record: Record, sensing: Sensing) -> frozenset[str]:
    """Balances with parameters of the link, which a record with another payload does not share."""
    masked = frozenset(sensing.balances) & LINK_BALANCES
    if masked == frozenset(sensing.balances):
        raise InputError(f"{record.name}: a record with another payload needs link_torque or both positions, else every balance holds the link")
    return masked


def seen_from_the_motor(sensing: Sensing, joint: Joint) -> bool:
    """True for a geared joint of which only the drive side is recorded: the load hangs on a compliance nobody measures."""
    return sensing.balances == ("axis",) and not sensing.both_positions and abs(joint.gear_ratio) != 1.0


def weak_record(record: Record, joint: Joint, sensing: Sensing, length: float, first_block: int = 0, *, curved: bool = False) -> WeakRecord:
    """One record, resampled to uniform time where needed, averaged with the kernel."""
    steps = np.diff(record.time)
    inside = np.diff(record.segment) == 0
    signals, segments = signals_of(record, joint, sensing), tuple(record.segments())
    noise = {c: noise_level(x, segments, record.time) for c, x in signals.items() if c in POSITION_CHAINS}
    if inside.any() and np.ptp(steps[inside]) > 0.02 * float(np.median(steps[inside])):
        record = record.resampled()
        signals, segments = signals_of(record, joint, sensing), tuple(record.segments())
    length = max(length, 8 * record.dt)
    longest = length / 2 if length <= CLAIM_KERNEL else 0.06
    made = prepare(
        record.time, signals, segments, length=length, first_block=first_block,
        pointwise={c: pointwise_kernel(signals[c], segments, record.dt, longest, level) for c, level in noise.items()},
        curved=curved,
    )  # fmt: skip
    if made.rows < 8:
        raise InputError(f"{record.name}: {len(record)} samples in {record.duration:.3g} s are too few for a kernel of {length:.3g} s; give a longer record")
    return made


def pointwise_kernel(position: FloatArray, segments: tuple[slice, ...], dt: float, longest: float, noise: float) -> float:
    """Shortest kernel whose velocity noise does not matter beside the velocities of the record [s].

    A long kernel rounds off reversals, and the laws of friction at low speed then fit the rounding.
    """
    lag = max(1, round(POINTWISE_KERNELS[-1] / dt))
    change = np.concatenate([np.abs(position[s][lag:] - position[s][:-lag]) for s in segments if s.stop - s.start > lag] or [np.zeros(1)])
    fast = float(np.quantile(change, 0.99)) / (lag * dt)
    for length in POINTWISE_KERNELS:
        if 6 * dt <= length < longest and noise * float(np.linalg.norm(kernel(length, dt, 1))) <= VELOCITY_NOISE * fast:
            return length
    return max(longest, 6 * dt)


def _ranges(data: Sequence[WeakRecord], clamped: bool) -> dict[str, float]:
    def span(values: FloatArray) -> float:
        return float(np.quantile(np.abs(values), 0.99)) or 1e-12

    speed = np.concatenate([w.smooth["motor_velocity"] for w in data])
    q = np.concatenate([w.smooth["motor_position"] for w in data])
    twist = q if clamped else np.concatenate([w.smooth["motor_position"] - w.smooth["link_position"] for w in data])
    duration = sum(float(np.ptp(w.time)) for w in data)
    return {"velocity": span(speed), "torsion": span(twist), "position": span(q - np.median(q)), "duration": duration, "absolute": 1.0}


def with_effect(model: JointModel, label: str) -> JointModel:
    """The model with one more effect; a delay of the drive, of any length, takes the place of the nuisance."""
    return (model.drop(HOLD_DELAY) if label == _DRIVE_DELAY and HOLD_DELAY in model.effects else model).add(label)


def without(model: JointModel, label: str) -> JointModel:
    """The model without an effect; where a delay of the drive goes, the hold is a nuisance again."""
    smaller = model.drop(label)
    return smaller.add(HOLD_DELAY) if label == _DRIVE_DELAY else smaller


def prepared_model(joint: Joint, record: Record) -> JointModel:
    """The joint's model in the form that the record's channels can carry."""
    model = joint.model()
    sensing = sense(record, model)
    adapted = adapt(model, sensing, joint.known)
    if sensing.has_drive and not record.has("motor_torque") and not adapted.has("channel_delay", "drive"):
        adapted = adapted.add(HOLD_DELAY)
    lagging = seen_from_the_motor(sensing, joint) and sensing.has_drive
    return replace(adapted, lagging_load=lagging, calibration=unknowns_of(adapted, sensing))
