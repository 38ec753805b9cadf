"""MOESP on simulated joints: what it explains on trajectories that had no part in the
identification.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks import moesp_joint as BENCH
from identification.linear.subspace import HankelQR, MoespOptions, moesp
from identification.planning.follow import Follower

JOINTS = ("table_4_3", "table_4_6")


@pytest.fixture(scope="module")
def recorded() -> dict[str, tuple[list[Any], list[Any]]]:
    """Readings of both joints along the seen and the unseen trajectories."""
    found = {}
    for name in JOINTS:
        follower = Follower(BENCH.joints()[name](), BENCH.DT)
        seen = [BENCH.run(follower, m, k) for k, m in enumerate(BENCH.motions("seen", 12.0))]
        found[name] = (
            seen,
            [BENCH.run(follower, m, 100 + k) for k, m in enumerate(BENCH.motions("unseen", 12.0))],
        )
    return found


@pytest.mark.parametrize("joint", JOINTS)
def test_unseen_trajectories_are_explained(
    joint: str, recorded: dict[str, tuple[list[Any], list[Any]]]
) -> None:
    seen, unseen = recorded[joint]
    model = BENCH.best_stable(seen, "ordinary")
    assert model.spectral_radius < 1.0
    vaf = BENCH.unseen_vaf(model, unseen)
    assert vaf["position"] >= 99.99
    assert vaf["velocity"] >= 99.4
    assert vaf["relative position"] >= 96.0


def test_no_trajectory_is_both_seen_and_unseen() -> None:
    assert not set(BENCH.SPEEDS["seen"]) & set(BENCH.SPEEDS["unseen"])
    assert not set(BENCH.PERIODS["seen"]) & set(BENCH.PERIODS["unseen"])


def test_the_vaf_is_that_of_a_free_simulation(
    recorded: dict[str, tuple[list[Any], list[Any]]],
) -> None:
    """The model sees the link for one second only: what it gives does not change with the link
    readings after that.
    """
    seen, unseen = recorded[JOINTS[0]]
    model = BENCH.identify(seen[:4], "ordinary", 3)
    first = round(BENCH.START / BENCH.DT)
    run = unseen[0]
    state = BENCH.initial_state(model, run.inputs[:first], run.outputs[:first])
    simulated = model.simulate(run.inputs, state)
    x = state
    a, b, c, d = model.system.A, model.system.B, model.system.C, model.system.D
    for k in range(200):
        assert c @ x + d @ run.inputs[k] == pytest.approx(simulated[k], rel=1e-6, abs=1e-9)
        x = a @ x + b @ run.inputs[k]


def test_input_matrices_of_the_shift_equation_collapse_on_smooth_inputs(
    recorded: dict[str, tuple[list[Any], list[Any]]],
) -> None:
    """Position, velocity and acceleration are nearly dependent: eq. 3.46 divides by what is
    left of them.
    """
    seen, _ = recorded[JOINTS[0]]
    u, y = [r.inputs for r in seen], [r.outputs for r in seen]
    by_shift = moesp(
        u,
        y,
        20,
        4,
        BENCH.DT,
        options=MoespOptions(output_weights=BENCH.WEIGHTS, input_matrices="shift"),
    )
    by_response = moesp(u, y, 20, 4, BENCH.DT, options=MoespOptions(output_weights=BENCH.WEIGHTS))
    assert by_response.vaf_percent.min() > 96.0
    assert by_shift.vaf_percent.min() < 0.0


def test_accumulators_of_single_trajectories_merge_to_the_whole(
    recorded: dict[str, tuple[list[Any], list[Any]]],
) -> None:
    seen, _ = recorded[JOINTS[1]]
    whole = HankelQR(3, 2, 10, "past_output", BENCH.WEIGHTS)
    merged = HankelQR(3, 2, 10, "past_output", BENCH.WEIGHTS)
    for run in seen[:4]:
        one = HankelQR(3, 2, 10, "past_output", BENCH.WEIGHTS)
        for accumulator in (whole, one):
            accumulator.add(run.inputs, run.outputs)
            accumulator.end_record()
        merged.merge(one)
    expected, found = whole.factor().directions()[1], merged.factor().directions()[1]
    assert found[:3] == pytest.approx(expected[:3], rel=1e-6)
    assert np.all(np.diff(found) <= 0)
