"""Levels of the fault bank: the likeliest ones, wherever the search starts and whatever is hidden
when; friction of a side that creeps.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from casadi_models import JointModel
from identification.faults import bank_levels
from identification.faults.bank_levels import Piece, first_levels, likeliest
from identification.faults.bank_statistics import statistics
from identification.online.filter import AT_A_TURN, LINK, TRANSMISSION, Course, JointFilter, Levels
from identification.online.filter_step import CREEP
from tests.hidden_effect.generator import DT, KM, simulate_case

THERE = (True, True, False, True, False, True)
SEED = 1024
"""A joint on which a search by one level at a time ended elsewhere from each start."""
LONG, SPAN = 120.0, 8.0
"""Length of the motions, and of what is kept of them [s]."""
RATTLE = 3e-4
"""Of the link encoder: five of its steps [rad]."""


@cache
def joint() -> tuple[JointFilter, tuple[Piece, ...]]:
    """A joint with all that its equations say, and 8 s of two records with what they do not: a
    bump, a kinematic error, a stiff mode of the link.
    """
    case = simulate_case("cubic_stiffness", SEED, dirt=True, records=("train", "test"), span=LONG)
    p = case.parameters
    effects = ("viscous", "coulomb", "gravity", "cubic_stiffness")
    model = JointModel.by_name("hd3", case.gear_ratio, effects=effects)
    model = model.with_values(
        {
            "motor_inertia": p["JM"],
            "link_inertia": p["JL"],
            "gravity_torque": p["TG"],
            "stiffness": p["K"],
            "structural_damping": p["C"],
            "cubic_stiffness": p["K3"],
            "motor_viscous": p["M_B"],
            "motor_coulomb": p["M_TC"],
            "link_viscous": p["L_B"],
            "link_coulomb": p["L_TC"],
            "motor_smoothing_velocity": p["M_V0"],
            "link_smoothing_velocity": p["L_V0"],
        }
    )
    scale = {1: case.gear_ratio * KM, 2: 1.0 / case.gear_ratio}
    pieces = []
    for table in case.measured.values():
        table = table[: round(SPAN / DT)]
        rows = np.zeros((len(table), 6))
        for to, column in ((0, 1), (1, 2), (3, 4), (5, 6)):
            rows[:, to] = table[:, column] * scale.get(column, 1.0)
        pieces.append(Piece(table[:, 0], rows))
    return JointFilter(model, DT), tuple(pieces)


def test_friction_of_a_side_that_creeps_is_no_sign_of_a_fault() -> None:
    """The motor's disturbance is half its dry friction throughout; it creeps for a while."""
    made, _ = joint()
    dry, count, creeps = made.dry[0] / AT_A_TURN, 1000, slice(200, 500)
    states = np.ones((1, count, 4))
    states[0, creeps, 1] = 0.1 * made.slow[0]
    lacks = np.full((1, count, 3), 0.5 * dry)
    none = np.zeros((1, count, 5))
    course = Course(none, none + 1, lacks, np.zeros((1, count, 3)), states, True, last=())
    motor, transmission, link = statistics(course, 0, made, Levels())[:, -3:].T
    late = round(CREEP / DT)
    assert np.all(motor[200 : 500 + late - 1] == 0)
    assert motor[[*range(200), *range(500 + late, count)]] == pytest.approx(0.5 * dry)
    assert transmission == pytest.approx(0.5 * dry)
    assert link == pytest.approx(0.5 * dry)


@pytest.mark.parametrize("known", [1.0, 0.3])
def test_what_was_put_down_to_friction_fades_as_the_filter_forgets_it(known: float) -> None:
    """A disturbance of the link that the filter opened while the link crept, and that fades as that
    of a steady filter does: by its time constant, and faster where it is known better than that.
    """
    made, _ = joint()
    level, lasting, count, end = 0.01, 0.4, 2000, 200
    levels = Levels(disturbance=(level, level, level), lasting=(lasting, lasting, lasting))
    states = np.ones((1, count, 4))
    states[0, :end, 3] = 0.1 * made.slow[1]
    late = end - 1 + round(CREEP / DT) - 1  # the last sample that counts as creeping
    rate = (2 / known**2 - 1) / lasting
    lacks = np.zeros((1, count, 3))
    lacks[0, :, LINK] = 0.5 * made.dry[1] / AT_A_TURN
    lacks[0, late:, LINK] *= np.exp(-rate * DT * np.arange(count - late))
    none, deviation = np.zeros((1, count, 5)), np.full((1, count, 3), known * level)
    course = Course(none, none + 1, lacks, deviation, states, True, last=())
    beyond = statistics(course, 0, made, levels)[:, -1]
    assert lacks[0, late + 10, LINK] > 5 * level, "there is something to tell"
    assert beyond == pytest.approx(0.0, abs=1e-9)
    # what comes after that does not pass for it
    lacks[0, late + 100 :, LINK] += 2 * level
    again = statistics(course, 0, made, levels)[:, -1]
    assert again[late + 100 :] == pytest.approx(max(2 - 3 * known, 0.0) * level, abs=1e-9)


@pytest.mark.slow
def test_the_likeliest_levels_do_not_depend_on_the_start() -> None:
    """Sizes and time constants of what the model lacks lie in valleys, and there are two of them:
    torques of the transmission, or faster and larger ones of the link.
    """
    made, pieces = joint()
    first = first_levels(pieces, DT, THERE)
    other = replace(first, disturbance=(0.3, 0.3, 0.03), lasting=(0.03, 0.03, 0.03))
    one, two = (likeliest(made, pieces, THERE, start) for start in (first, other))
    for a, b in ((one.disturbance, two.disturbance), (one.lasting, two.lasting)):
        assert a[TRANSMISSION] == pytest.approx(b[TRANSMISSION], rel=0.2)
    assert max(one.disturbance[LINK], two.disturbance[LINK]) < 0.1


def test_what_is_hidden_late_in_a_record_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A link encoder that rattles in the second half only, where a quarter is enough."""
    made, pieces = joint()
    whole = pieces[0]
    monkeypatch.setattr(bank_levels, "ENOUGH", len(whole.time) // 4)
    monkeypatch.setattr(bank_levels, "STRETCH", 2.0, raising=False)
    monkeypatch.setattr(bank_levels, "SETTLE", 0.5)
    monkeypatch.setattr(bank_levels, "STEPS", (2.0,))
    rows, half = whole.rows.copy(), len(whole.rows) // 2
    rows[half:, 3] += RATTLE * np.random.default_rng(1).standard_normal(len(rows) - half)
    first = first_levels([whole], DT, THERE)
    found = likeliest(made, [Piece(whole.time, rows)], THERE, first)
    assert found.readings[2] > 2 * first.readings[2]
