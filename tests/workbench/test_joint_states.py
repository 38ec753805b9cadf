"""Joint states of ROS 2 followed as they come, sent by a real DDS writer on loopback."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification import Joint, Record, load_joint, read
from identification.errors import InputError
from workbench.cli.following import joint_states
from workbench.cli.following.growing import follow
from workbench.cli.following.joint_states import JointStates
from workbench.cli.following.source import is_stream, source
from workbench.cli.main import main

pytest.importorskip("cyclonedds")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic

from workbench.cli.following.ros_types import Header, JointState, Time

DEMO = Path(str(files("workbench"))) / "demo"
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/>"
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address='localhost'/></Peers>"
    "</Discovery></Domain></CycloneDDS>"
)
SECONDS = 4.0
"""Of the demo's held-out record that are sent."""
CHANNELS = (
    "motor_current",
    "motor_position",
    "motor_velocity",
    "link_position",
    "link_velocity",
    "link_torque",
)
CURRENT = {"motor_current": {"column": "motor_torque_Nm", "unit": "A"}}
"""This drive states its current as effort."""


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch, worker_id: str) -> int:
    """A domain of this process' own, as other tests run beside it."""
    number = 60 + int(worker_id.removeprefix("gw") if worker_id != "master" else 0)
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    return number


@pytest.fixture
def write(domain: int) -> Any:
    """A node that states joints."""
    node = DomainParticipant(domain)
    qos = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(10_000))
    return DataWriter(node, Topic(node, "rt/arm/joint_states", JointState), qos=qos)


def heard(write: Any) -> None:
    """Wait until the writer has found its reader."""
    end = time.monotonic() + 20
    while not write.get_matched_subscriptions():
        assert time.monotonic() < end, "the reader was not found"
        time.sleep(0.02)


def all_of(topic: JointStates) -> None:
    """Listen for five seconds."""
    for _ in range(100):
        list(topic.arrived())
        time.sleep(0.05)


def state(t: float, names: Sequence[str], *given: Sequence[float]) -> JointState:
    whole = int(t)
    return JointState(
        Header(Time(whole, round((t - whole) * 1e9)), ""), list(names), *map(list, given)
    )


def messages(record: Record, begin: float) -> list[JointState]:
    """A record as the messages of two joints, motor and link; stamps count from 1970."""
    columns = [record.channels[c] for c in CHANNELS]
    current, q_m, w_m, q_l, w_l, torque = columns
    return [
        state(
            begin + t,
            ("motor", "link"),
            (q_m[k], q_l[k]),
            (w_m[k], w_l[k]),
            (current[k], torque[k]),
        )
        for k, t in enumerate(record.time.tolist())
    ]


def test_a_topic_gives_what_the_file_gives(write: Any) -> None:
    joint = load_joint(DEMO / "joint.toml")
    record = read(DEMO / "held_out.npz", joint=joint)
    record = record.take(record.time < record.time[0] + SECONDS)
    mapped = replace(joint, columns=CURRENT)
    with source("ros2://arm/joint_states", mapped) as topic:
        assert isinstance(topic, JointStates)
        heard(write)
        for message in messages(record, 1.7e9):
            write.write(message)
        parts, end = [], time.monotonic() + 20
        while sum(map(len, parts)) < len(record) and time.monotonic() < end:
            parts += [p for p in [topic.new()] if p is not None]
    assert sum(map(len, parts)) == len(record)
    for channel in ("time", *CHANNELS):
        came = np.concatenate([p.time if channel == "time" else p.channels[channel] for p in parts])
        sent = record.time - record.time[0] if channel == "time" else record.channels[channel]
        np.testing.assert_allclose(came, sent, rtol=0, atol=1e-6 if channel == "time" else 0)


def of_column(name: str) -> Joint:
    """The demo's joint with the motor's position in a column of that name [rad]."""
    columns = {"motor_position": {"column": name, "unit": "rad"}}
    return replace(load_joint(DEMO / "joint.toml"), columns=columns)


def arrived(topic: JointStates, count: int) -> list[bytes]:
    """The rows of a topic, so many of them or those of 10 s."""
    rows, end = list(topic.arrived()), time.monotonic() + 10
    while len(rows) < count and time.monotonic() < end:
        rows += topic.arrived()
    return rows


def test_what_a_message_leaves_out_is_no_column(write: Any) -> None:
    """Effort that is empty; no stamp: the time of sending counts; an infinite reading is none."""
    joint = of_column("a_b_position_rad")
    with JointStates("ros2:///arm/joint_states/", joint) as topic:
        heard(write)
        for k in range(300):
            write.write(state(0.0, ("a,b",), (0.1 * k,), (np.inf if k == 150 else 1.0,), ()))
            time.sleep(0.002)
        rows = arrived(topic, 301)
    assert rows[0] == b"time_s,a_b_position_rad,a_b_velocity_rad_s"
    cells = np.array([[float(x) for x in r.split(b",")] for r in rows[1:]])
    assert len(cells) == 300
    assert cells[0, 0] == 0.0
    assert 0.002 <= np.median(np.diff(cells[:, 0])) < 0.02
    assert np.isnan(cells[:, 2]).nonzero()[0].tolist() == [150]


def test_another_sender_on_the_topic_is_left_out(write: Any) -> None:
    """Two nodes state joints of their own on one topic; and one states its joints in any order."""
    joint = of_column("elbow_position_rad")
    with JointStates("ros2://arm/joint_states", joint) as topic:
        heard(write)
        for k in range(90):
            write.write(state(k * 1e-3, ("gripper",), (7.0,), (), ()))
            names, places = ("elbow", "wrist"), (float(k), -1.0)
            way = slice(None, None, -1 if k % 2 else 1)
            write.write(state(k * 1e-3, names[way], places[way], (), ()))
        rows = arrived(topic, 91)
        assert rows[0] == b"time_s,elbow_position_rad,wrist_position_rad"
        cells = np.array([[float(x) for x in r.split(b",")] for r in rows[1:]])
        np.testing.assert_array_equal(cells[:, 1], np.arange(90))
        np.testing.assert_array_equal(cells[:, 2], -1.0)
    with JointStates("ros2://arm/joint_states", joint) as topic:
        heard(write)
        for k in range(100):
            write.write(state(k * 1e-3, ("gripper",), (7.0,), (), ()))
        with pytest.raises(InputError, match=r"elbow_position_rad, which no message has; there is"):
            all_of(topic)


def test_a_topic_that_cannot_be_is_said_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = str(DEMO / "joint.toml")
    assert is_stream("ros2://joint_states")
    for address, number, says in (
        ("ros2://", "0", "give the topic as ros2://TOPIC"),
        ("ros2://joint states", "0", "give the topic as ros2://TOPIC"),
        ("ros2://joint_states", "many", "ROS_DOMAIN_ID is 'many'"),
        ("ros2://joint_states", "233", "it is a number from 0 to 232"),
        ("ros2://nobody", "61", "fewer than 100 lines came"),
    ):
        monkeypatch.setenv("ROS_DOMAIN_ID", number)
        assert main(["track", address, "--joint", joint, "--follow", "0.3"]) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert says in said[-1]
    assert main(["track", "ros2://joint_states", "--joint", joint]) == 2
    assert "a stream has no end" in capsys.readouterr().err


def test_a_topic_is_followed_to_the_end(write: Any) -> None:
    """The estimator works on what comes, as on any stream."""
    joint = load_joint(DEMO / "joint.toml")
    record = read(DEMO / "held_out.npz", joint=joint)
    sent = messages(record.take(record.time < record.time[0] + SECONDS), 5.0)
    with source("ros2://arm/joint_states", replace(joint, columns=CURRENT)) as topic:
        heard(write)

        def stop() -> bool:
            now, sent[:] = sent[:500], sent[500:]
            for message in now:
                write.write(message)
            return not now

        replays = list(follow(topic, joint, stop=stop))
    assert len(replays) > 1
    assert replays[-1].record.time[-1] == pytest.approx(SECONDS, abs=0.01)


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    joint_states._library.cache_clear()
    monkeypatch.delattr("workbench.cli.following.ros_types", raising=False)
    monkeypatch.setitem(sys.modules, "workbench.cli.following.ros_types", None)
    with pytest.raises(InputError, match=r"pip install 'irj\[ros2\]'"):
        JointStates("ros2://joint_states", load_joint(DEMO / "joint.toml"))
    joint_states._library.cache_clear()
