"""What is followed by its name: a file that is being written, or a stream by its address."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from workbench.cli.following import datagrams, joint_states
from workbench.cli.following.datagrams import Datagrams
from workbench.cli.following.growing import Growing
from workbench.cli.following.joint_states import JointStates

if TYPE_CHECKING:
    from identification.data.joint_file import Joint


def is_stream(name: object) -> bool:
    """Whether it is the address of a stream and no file."""
    return isinstance(name, str) and name.startswith((datagrams.SCHEME, joint_states.SCHEME))


def check_address(address: str) -> None:
    """See that the address of a stream is one.

    Raises
    ------
    InputError
        It is none.
    """
    if address.startswith(datagrams.SCHEME):
        datagrams.place_of(address)
    else:
        joint_states.topic_of(address)


def source(name: str, joint: Joint) -> Growing | Datagrams | JointStates:
    """What is followed: a file that is being written, or a stream by its address."""
    if name.startswith(datagrams.SCHEME):
        return Datagrams(name, joint)
    if name.startswith(joint_states.SCHEME):
        return JointStates(name, joint)
    return Growing(Path(name), joint)


__all__ = ["check_address", "is_stream", "source"]
