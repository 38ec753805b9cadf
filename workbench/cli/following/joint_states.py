"""A record that comes as a topic of ROS 2: joint states, read from DDS, which is what carries them,
so that no ROS has to be installed here.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, Final, final

from identification.errors import InputError
from workbench.cli.following.lines import Lines

if TYPE_CHECKING:
    from identification.data.joint_file import Joint

SCHEME: Final = "ros2://"
COLUMNS: Final = {
    "rotary": {"position": "position_rad", "velocity": "velocity_rad_s", "effort": "torque_Nm"},
    "linear": {"position": "position_m", "velocity": "velocity_m_s", "effort": "torque_N"},
}
"""Readings of a joint in a message, and its columns here by the kind of the axis: ROS 2 has SI."""
AT_ONCE: Final = 10_000
"""Messages taken in one go: ten seconds of a fast controller."""
PREFIX: Final = "rt/"
"""What ROS 2 puts before the name of a topic in DDS."""
TOPIC: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
DOMAINS: Final = 232
"""Largest number of a DDS domain whose ports exist."""


@final
class JointStates(Lines):
    """Messages ``sensor_msgs/msg/JointState`` of a topic, a row each.

    Columns are ``time_s``, and ``NAME_position_rad``, ``NAME_velocity_rad_s`` and
    ``NAME_torque_Nm`` (the effort) for each joint of the message that has them; joints that are
    called ``motor`` and ``link`` need no ``[columns]``. Time is that of the message's stamp, or of
    its sending where the stamp is zero, from the first message on. The domain is that of the
    variable ``ROS_DOMAIN_ID``.

    Parameters
    ----------
    address : str
        ``ros2://TOPIC``, as ``ros2://joint_states``.
    joint : Joint
        Column map and kind of the axis.

    Raises
    ------
    InputError
        No such address, or the library that reads DDS is not installed.
    """

    def __init__(self, address: str, joint: Joint) -> None:
        topic, domain = topic_of(address), _domain()
        found = _library()
        qos = found.qos
        try:
            self._participant = found.domain.DomainParticipant(domain)
        except found.core.DDSException as error:
            line = str(error).splitlines()[0]
            raise InputError(f"{address}: no DDS on this machine ({line})") from None
        super().__init__(address, joint)
        self._reader = found.sub.DataReader(
            self._participant,
            found.topic.Topic(self._participant, PREFIX + topic, found.message),
            # heard from senders of either kind; nothing is dropped between two looks
            qos=qos.Qos(qos.Policy.Reliability.BestEffort, qos.Policy.History.KeepAll),
        )
        self._begin: int | None = None
        self._columns: tuple[str, ...] = ()

    def arrived(self) -> Iterable[bytes]:
        """Rows of the messages that came since the last call, and a head before the first."""
        out: list[bytes] = []
        for message in self._reader.take(N=AT_ONCE):
            if not message.sample_info.valid_data:
                continue
            columns, values = _cells(message, COLUMNS[self.joint.kind])
            if columns != self._columns:
                self._columns = columns
                out.append(",".join(["time_s", *columns]).encode())
            stamp = message.header.stamp
            now = stamp.sec * 10**9 + stamp.nanosec or message.sample_info.source_timestamp
            self._begin = now if self._begin is None else self._begin
            seconds = (now - self._begin) * 1e-9
            out.append(",".join([f"{seconds:.9f}", *map(repr, values)]).encode())
        return out


def _cells(message: Any, kinds: Mapping[str, str]) -> tuple[tuple[str, ...], list[float]]:
    """Columns and values of a message: a list that is empty, or shorter than the names, is none."""
    columns, values = [], []
    for kind, column in kinds.items():
        given = getattr(message, kind)
        if len(given) != len(message.name):
            continue
        for name, value in zip(message.name, given, strict=True):
            columns.append(_plain(f"{name}_{column}"))
            values.append(float(value) if math.isfinite(value) else math.nan)
    return tuple(columns), values


def _plain(name: str) -> str:
    """A name that is one cell of a head."""
    return re.sub(r"[,;\s\"]+", "_", name)


def topic_of(address: str) -> str:
    """Name of the topic.

    Raises
    ------
    InputError
        It is no name of one.
    """
    topic = address.removeprefix(SCHEME).strip("/")
    if not TOPIC.fullmatch(topic):
        raise InputError(f"{address}: give the topic as {SCHEME}TOPIC, as {SCHEME}joint_states")
    return topic


def _domain() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isascii() or not text.isdigit() or int(text) > DOMAINS:
        raise InputError(f"ROS_DOMAIN_ID is {text!r}; it is a number from 0 to {DOMAINS}")
    return int(text)


@cache
def _library() -> Any:
    """The modules that read DDS, and the message's type among them.

    Raises
    ------
    InputError
        Not installed.
    """
    try:
        from workbench.cli.following import ros_types
    except ImportError as error:
        raise InputError(
            f"reading a topic of ROS 2 needs cyclonedds ({error}); "
            "install it with: pip install 'irj[ros2]'"
        ) from None
    return ros_types


__all__ = ["SCHEME", "JointStates", "topic_of"]
