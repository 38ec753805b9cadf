"""ROS 1 bags and ROS 2 bags (SQLite or MCAP storage), by rosbags; no ROS installation is needed."""

from __future__ import annotations

from pathlib import Path

from identification.data.read._messages import Collector
from identification.data.read._table import Table, missing_package
from identification.errors import InputError


def open_rosbag(path: Path) -> Table:
    """Open a bag: columns are ``/topic/field``, joint states ``/topic/position[joint]``, time [s]
    is ``time``.

    Parameters
    ----------
    path : Path
        A ``.bag`` file, a ROS 2 bag folder, or the ``.db3`` file inside it.

    Raises
    ------
    InputError
        If rosbags is missing, the bag is damaged or holds no numeric field.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_package("rosbags", "ros", "ROS bags", str(path)) from None
    place = path
    if path.is_file() and path.suffix.lower() == ".db3":
        place = path.parent
        if not (place / "metadata.yaml").is_file():
            raise InputError(
                f"{path}: metadata.yaml is missing beside it: give the whole ROS 2 bag folder"
            )
    collector = Collector()
    try:
        with AnyReader([place], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, stamp, raw in reader.messages():
                collector.add(
                    connection.topic, stamp * 1e-9, reader.deserialize(raw, connection.msgtype)
                )
    except MemoryError:
        raise
    except Exception as error:  # rosbags raises its own and its parsers' errors on a damaged bag
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{path}: is not a readable ROS bag ({detail}): record it again or reindex it"
        ) from None
    return collector.table("ROS bag", path)
