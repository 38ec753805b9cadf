"""MCAP files: JSON messages, and ROS 1 and ROS 2 messages where rosbags is there to decode them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from identification.data.read._messages import Collector
from identification.data.read._table import Table, missing_package
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def open_mcap(path: Path) -> Table:
    """Open an MCAP file: columns are ``/topic/field``, time [s] is ``time``.

    Raises
    ------
    InputError
        If mcap is missing, the file is damaged or holds no numeric field in a known encoding.
    """
    try:
        from mcap.reader import make_reader
    except ImportError:
        raise missing_package("mcap", "ros", "MCAP files", str(path)) from None
    collector = Collector()
    decoders: dict[int, Callable[[bytes], Any] | None] = {}
    try:
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(schema, channel.message_encoding, path)
                decode = decoders[channel.id]
                if decode is None:
                    collector.odd_topics.add(f"{channel.topic} ({channel.message_encoding})")
                    continue
                collector.add(channel.topic, message.log_time * 1e-9, decode(message.data))
    except (InputError, MemoryError):
        raise
    except (
        Exception
    ) as error:  # mcap and the message decoders raise errors of their own on damaged files
        raise InputError(
            f"{path}: is not a readable MCAP file ({type(error).__name__}): record it again"
        ) from None
    return collector.table("MCAP", path)


def _decoder(schema: Any, encoding: str, path: Path) -> Callable[[bytes], Any] | None:
    if encoding == "json":
        return json.loads
    if (
        encoding not in {"cdr", "ros1"}
        or schema is None
        or schema.encoding not in {"ros2msg", "ros1msg"}
    ):
        return None
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise missing_package("rosbags", "ros", "ROS messages in MCAP files", str(path)) from None
    store = get_typestore(Stores.EMPTY)
    name = schema.name if schema.name.count("/") == 2 else schema.name.replace("/", "/msg/", 1)
    store.register(get_types_from_msg(schema.data.decode(), name))
    if encoding == "cdr":
        return lambda data: store.deserialize_cdr(data, name)
    return lambda data: store.deserialize_ros1(data, name)
