"""A torque that pauses where a gap closes is the joint's, and a lost bit is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Joint, Record, load_joint, read
from identification.balance import dataset
from identification.fitting.engine import load_dataset, prepared_model
from tests.recorded_world._engine import library
from tests.recorded_world.world import make_case, write_case

pytestmark = pytest.mark.skipif(library() is None, reason="the generator needs a C compiler")


@pytest.fixture(scope="module")
def joint_and_record(tmp_path_factory: pytest.TempPathFactory) -> tuple[Joint, Record]:
    """A servo with a gap that follows steps at 250 Hz."""
    case = make_case(8807, without=("lost",), seconds=20.0, kind="none")
    folder = write_case(case, tmp_path_factory.mktemp("contacts") / "servo", "all")
    return load_joint(folder / "joint.toml"), read(folder / "train.csv")


def averaged(joint: Joint, record: Record) -> np.ndarray:
    """The torque of the link in the rows."""
    (rows,) = load_dataset([record], [], joint, prepared_model(joint, record)).train
    return np.asarray(rows.averaged["torque"])


def test_a_closing_gap_is_no_lost_bit(
    joint_and_record: tuple[Joint, Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    joint, record = joint_and_record
    found = averaged(joint, record)
    monkeypatch.setattr(dataset, "restored", lambda made, *_: made)
    mended = averaged(joint, replace(record, name="mended"))
    monkeypatch.setattr(dataset, "without_spikes", lambda values, *_: values)
    as_read = averaged(joint, replace(record, name="as read"))
    assert np.max(np.abs(mended - as_read)) > 0.05
    assert np.std(found - as_read) < 0.25 * np.std(mended - as_read)


def test_a_lost_bit_is_no_closing_gap(joint_and_record: tuple[Joint, Record]) -> None:
    joint, record = joint_and_record
    torque = record["link_torque"].copy()
    rng = np.random.default_rng(4)
    at = rng.choice(np.arange(50, len(torque) - 50, 11), 20, replace=False)
    torque[at] += 3.0 * rng.choice([-1.0, 1.0], 20)
    spoilt = replace(record, name="spoilt", channels={**record.channels, "link_torque": torque})
    change = averaged(joint, spoilt) - averaged(joint, record)
    assert np.max(np.abs(change)) < 0.05  # a bit alone moves a row by 0.3 N.m
