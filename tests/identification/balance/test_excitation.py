"""What a motion can carry: lines, speeds, passes and turns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from casadi_models import EFFECTS
from identification import Joint, Record, improve
from identification.balance.dataset import Dataset, load_dataset, prepared_model
from identification.balance.excitation import (
    FEW_LINES,
    claim_limit,
    excitation_warnings,
    few_reversals,
    independent_lines,
    turns_within_runs,
)

T = 0.002 * np.arange(8000)
JOINT = Joint("one", "rotary", model_name="hd1", effects=("viscous",))


def record(position: np.ndarray, torque: np.ndarray | None = None, name: str = "run") -> Record:
    noise = 1e-5 * np.random.default_rng(len(name)).standard_normal(len(position))
    return Record.from_channels(
        T,
        {
            "motor_position": position + noise,
            "motor_torque": np.cos(T) if torque is None else torque,
        },
        name=name,
    )


def dataset(records: Sequence[Record]) -> Dataset:
    return load_dataset(records, [], JOINT, prepared_model(JOINT, records[0]))


def sines(*frequencies: float) -> np.ndarray:
    """Sines whose speeds are alike."""
    return np.sum([np.sin(2 * np.pi * f * T + f) / f for f in frequencies], axis=0)


@pytest.mark.parametrize("count", [1, 2, 4, 8])
def test_lines_of_a_multisine_are_counted(count: int) -> None:
    data = dataset([record(sines(*(0.3 + 0.31 * np.arange(count))))])
    assert independent_lines(data) == pytest.approx(count, rel=0.1)


def test_two_runs_of_a_sine_each_are_two_lines() -> None:
    runs = [record(sines(0.4), name="a"), record(sines(1.3), name="other")]
    assert independent_lines(dataset(runs)) == pytest.approx(2, rel=0.1)
    assert independent_lines(dataset([runs[0], record(sines(0.4), name="again")])) == pytest.approx(
        1, rel=0.1
    )


def test_one_speed_back_and_forth_is_a_line_and_a_half() -> None:
    """Its harmonics fall with the order: 1, 1/9, 1/25 of the power."""
    power = 1.0 / np.arange(1, 200, 2) ** 2.0
    worth = power.sum() ** 2 / np.sum(power**2)
    data = dataset([record(np.arcsin(np.sin(2 * T)))])
    assert independent_lines(data) == pytest.approx(worth, rel=0.05)
    assert claim_limit(data) <= 3
    assert any("lines of a spectrum" in w for w in excitation_warnings(data))


def test_few_lines_limit_the_claims_and_many_do_not() -> None:
    assert claim_limit(dataset([record(sines(0.4))])) == 2
    rich = dataset([record(sines(0.3, 0.7, 1.1, 1.9))])
    assert claim_limit(rich) == len(EFFECTS)
    assert independent_lines(rich) > FEW_LINES
    assert not any("lines of a spectrum" in w for w in excitation_warnings(rich))


def test_a_single_sine_gets_no_more_claims_than_it_can_carry() -> None:
    """A torque that no sum of laws holds exactly: on a single sine every addition helps a
    little.
    """
    q, v, a = np.sin(2 * T), 2 * np.cos(2 * T), -4 * np.sin(2 * T)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((2, len(T)))
    torque = (
        a
        + 3 * np.tanh(v / 0.1)
        + 0.4 * v**3
        + 2 * np.sin(q + 0.4)
        + np.cos(5 * q)
        + 0.3 * np.sign(v) * q
    )
    train, held = record(q, torque + noise[0], "train"), record(q, torque + noise[1], "held out")
    assert len(improve([train], JOINT, [held]).claims) <= 2


def test_a_friction_map_has_reversals_enough_though_no_run_has_one() -> None:
    """Constant speeds in both directions, a run each, are what tells a friction curve; memory
    is another thing.
    """
    runs = [
        record(sign * speed * T, name=f"{sign} {speed}")
        for speed in (0.1, 0.2, 0.5, 1.0)
        for sign in (1, -1)
    ]
    data = dataset(runs)
    assert turns_within_runs(data) == 0
    assert few_reversals(data) == ""
    assert any("laws with memory" in w for w in excitation_warnings(data))
    assert independent_lines(data) >= 3
    one_way = dataset([record(speed * T, name=f"{speed}") for speed in (0.1, 0.2, 0.5)])
    assert few_reversals(one_way) == "the motor reverses not once"
