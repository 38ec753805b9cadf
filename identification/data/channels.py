"""The channels a record can hold and their SI units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

KINDS: Final = ("rotary", "linear")

_UNITS: Final[Mapping[str, tuple[str, str]]] = {
    "motor_current": ("A", "A"),
    "motor_torque": ("N.m", "N"),
    "motor_voltage": ("V", "V"),
    "motor_position": ("rad", "m"),
    "motor_velocity": ("rad/s", "m/s"),
    "motor_acceleration": ("rad/s2", "m/s2"),
    "link_position": ("rad", "m"),
    "link_velocity": ("rad/s", "m/s"),
    "link_acceleration": ("rad/s2", "m/s2"),
    "link_torque": ("N.m", "N"),
    "coupling_torque": ("N.m", "N"),
    "temperature": ("K", "K"),
    "reference_position": ("rad", "m"),
    "run": ("1", "1"),
}
CHANNELS: Final = tuple(_UNITS)


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
    if channel == "time":
        return "s"
    if channel not in _UNITS:
        raise InputError(
            f"channel {channel!r} is not known: it is one of time, {', '.join(CHANNELS)}"
        )
    return _UNITS[channel][KINDS.index(kind)]
