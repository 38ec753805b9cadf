"""Messages of ROS 2 as DDS carries them (sensor_msgs/msg/JointState, std_msgs/msg/Header,
builtin_interfaces/msg/Time), and the library that reads them.
"""

from dataclasses import dataclass

from cyclonedds import core, domain, qos, sub, topic
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl.types import float64, int32, sequence, uint32


# the library reads the annotations as objects, so they are not postponed here
@dataclass
@annotate.final
@annotate.autoid("sequential")
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Seconds and nanoseconds."""

    sec: int32
    nanosec: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """When, and in which frame."""

    stamp: Time
    frame_id: str


@dataclass
@annotate.final
@annotate.autoid("sequential")
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """Readings of joints: rad or m, rad/s or m/s, N.m or N."""

    header: Header
    name: sequence[str]  # type: ignore[type-arg]
    position: sequence[float64]  # type: ignore[type-arg]
    velocity: sequence[float64]  # type: ignore[type-arg]
    effort: sequence[float64]  # type: ignore[type-arg]


message = JointState

__all__ = ["Header", "JointState", "Time", "core", "domain", "message", "qos", "sub", "topic"]
