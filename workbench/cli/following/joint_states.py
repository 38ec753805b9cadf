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
from workbench.cli.following.growing import FIRST_ROWS
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
        # heard from senders of either kind; nothing is dropped between two looks
        asked = qos.Qos(qos.Policy.Reliability.BestEffort, qos.Policy.History.KeepAll)
        try:
            node = found.domain.DomainParticipant(domain)
            self._reader = found.sub.DataReader(
                node, found.topic.Topic(node, PREFIX + topic, found.message), qos=asked
            )
        except found.core.DDSException as error:
            line = str(error).splitlines()[0]
            raise InputError(f"{address}: no DDS on this machine ({line})") from None
        super().__init__(address, joint)
        self._needed = _named(joint)
        self._begin: int | None = None
        self._columns: tuple[str, ...] = ()
        self._others = 0

    def __exit__(self, *error: object) -> None:
        self._reader = None  # the library ends its threads with it
        super().__exit__(*error)

    def arrived(self) -> Iterable[bytes]:
        """Rows of the messages that came since the last call, and a head before the first.

        A topic may have several senders, each with joints of its own: the first message that has
        what ``[columns]`` names says which columns there are, and those that lack one of them are
        left out.
        """
        out: list[bytes] = []
        for message in self._reader.take(N=AT_ONCE):
            if not message.sample_info.valid_data:
                continue
            cells = _cells(message, COLUMNS[self.joint.kind])
            if not self._columns and self._needed <= cells.keys():
                self._columns = tuple(cells)
                out.append(",".join(["time_s", *cells]).encode())
            if not self._columns or not cells.keys() >= set(self._columns):
                self._lacking(cells)
                continue
            stamp = message.header.stamp
            now = stamp.sec * 10**9 + stamp.nanosec or message.sample_info.source_timestamp
            self._begin = now if self._begin is None else self._begin
            values = [(now - self._begin) * 1e-9, *(cells[c] for c in self._columns)]
            out.append(",".join(map(repr, values)).encode())
        return out

    def _lacking(self, cells: Mapping[str, float]) -> None:
        """Say what is missing where no message has it."""
        self._others += 1
        if not self._columns and self._others >= FIRST_ROWS:
            lacks = ", ".join(sorted(self._needed - cells.keys()))
            has = ", ".join(cells) or "nothing"
            raise InputError(
                f"{self.name}: [columns] names {lacks}, which no message has; there is {has}"
            )


def _named(joint: Joint) -> frozenset[str]:
    """Columns that the column map of a joint file asks for by name."""
    entries = (joint.columns or {}).values()
    plain = (e.get("column") if isinstance(e, Mapping) else e for e in entries)
    return frozenset(c for c in plain if isinstance(c, str)) - {"time_s"}


def _cells(message: Any, kinds: Mapping[str, str]) -> dict[str, float]:
    """Columns and values of a message: a list that is empty, or shorter than the names, is none."""
    out = {}
    for kind, column in kinds.items():
        given = getattr(message, kind)
        if len(given) != len(message.name):
            continue
        for name, value in zip(message.name, given, strict=True):
            out[_plain(f"{name}_{column}")] = float(value) if math.isfinite(value) else math.nan
    return out


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
