"""The channels a record can hold and their SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

from identification.data.schema import meant
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from casadi_models.parameter import Side

KINDS: Final = ("rotary", "linear")


@final
@dataclass(frozen=True)
class Channel:
    """One channel of a record.

    Attributes
    ----------
    name : str
    rotary, linear : str
        SI unit on a rotary joint and on a linear axis.
    side : {"motor", "gear", "link", "none"}
        Where it is measured.
    meaning : str
        A clause for the reader of the reference page.
    """

    name: str
    rotary: str
    linear: str
    side: Side
    meaning: str

    def unit(self, kind: str) -> str:
        """SI unit on an axis of this kind, ``"rotary"`` or ``"linear"``."""
        return self.linear if kind == "linear" else self.rotary


TIME: Final = Channel("time", "s", "s", "none", "time stamp of the row; required, may be uneven")
_DECLARED: Final = (
    Channel("motor_current", "A", "A", "motor", "current of the motor, torque-producing part"),
    Channel("motor_torque", "N.m", "N", "motor", "torque on the motor shaft, in place of current"),
    Channel("motor_voltage", "V", "V", "motor", "voltage of the drive, in place of a current"),
    Channel("motor_position", "rad", "m", "motor", "reading of the motor's encoder"),
    Channel("motor_velocity", "rad/s", "m/s", "motor", "velocity, where it is recorded"),
    Channel("motor_acceleration", "rad/s2", "m/s2", "motor", "acceleration, where it is recorded"),
    Channel("link_position", "rad", "m", "link", "reading of the link's encoder"),
    Channel("link_velocity", "rad/s", "m/s", "link", "velocity, where it is recorded"),
    Channel("link_acceleration", "rad/s2", "m/s2", "link", "acceleration, where it is recorded"),
    Channel("link_torque", "N.m", "N", "link", "torque that the gear puts into the link"),
    Channel(
        "coupling_torque",
        "N.m",
        "N",
        "link",
        "torque on the link that is known from elsewhere (other axes), positive where it drives",
    ),
    Channel("temperature", "K", "K", "none", "temperature of the gear or its oil"),
    Channel("reference_position", "rad", "m", "link", "what the controller wants the link to do"),
    Channel("run", "1", "1", "none", "number of the run, where one file holds several"),
)
DECLARED: Final[Mapping[str, Channel]] = {c.name: c for c in _DECLARED}
"""Every channel but time, by name."""
CHANNELS: Final = tuple(DECLARED)


def channel_unit(channel: str, kind: str = "rotary") -> str:
    """SI unit of a channel.

    Parameters
    ----------
    channel : str
        A name in `CHANNELS`, or ``"time"``.
    kind : {"rotary", "linear"}
        Kind of the axis; a linear one has m, m/s, N in place of rad, rad/s, N.m.

    Raises
    ------
    InputError
        If the channel or the kind is unknown.
    """
    if kind not in KINDS:
        raise InputError(f"kind is {kind!r}: it is 'rotary' or 'linear'")
    if channel == TIME.name:
        return TIME.unit(kind)
    if channel not in DECLARED:
        raise InputError(
            f"channel {channel!r} is not known: it is one of time, {', '.join(CHANNELS)}"
            f"{meant(channel, (TIME.name, *CHANNELS))}"
        )
    return DECLARED[channel].unit(kind)
