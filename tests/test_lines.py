"""Lines at orders that nobody names beforehand."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from identification import Record, load_joint, read
from identification.engine import load_dataset, prepared_model, solve
from identification.joint_file import Joint
from identification.lines import Line, find_lines
from identification.order_tracking import Samples, spectrum

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "hidden_effect" / "none"


def test_scan_peaks_at_the_order() -> None:
    rng = np.random.default_rng(3)
    angle = np.cumsum(rng.uniform(0, 0.2, 5000))
    residual = 0.3 * np.sin(3.37 * angle + 1) + rng.standard_normal(5000)
    orders, power = spectrum(Samples(angle, residual, np.ones(5000), np.zeros(5000, dtype=np.int64)), 14.0)
    assert orders[np.argmax(power)] == pytest.approx(3.37, abs=2 * np.pi / np.ptp(angle))


def found(joint: Joint, train: list[Record], held: list[Record]) -> list[Line]:
    model = prepared_model(joint, train[0])
    data = load_dataset(train, held, joint, model)
    solution = solve(model, data)
    return find_lines(solution, data, train, held)


@pytest.mark.parametrize(("order", "twist"), [(0.85, 2.6e-6), (3.05, 3.4e-6), (7.2, 3.4e-6), (None, 0.0)])
def test_line_of_a_few_percent_is_found_at_its_order(order: float | None, twist: float) -> None:
    if not SHARED.exists() and not os.environ.get("CI"):
        pytest.skip("../shared/hidden_effect is not there")
    joint = load_joint(SHARED / "joint.toml")

    def with_line(record: Record) -> Record:
        if order is None:
            return record
        return record.with_channel("link_position", record["link_position"] + twist * np.sin(order * record["motor_position"] + 1))

    train, held = ([with_line(read(SHARED / f"{n}{i}.csv")) for i in ("", "2")] for n in ("train", "test"))
    lines = found(joint, train, held)
    if order is None:
        assert lines == []
    else:
        assert lines[0].balance == "transmission"
        assert lines[0].order == pytest.approx(order, abs=lines[0].tolerance)
