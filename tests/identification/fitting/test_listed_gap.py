"""A gap that the joint file lists three times too wide is found, and is not taken for a law of the
stiffness, with a further effect of the transmission hidden beside it.
"""

from __future__ import annotations

import pytest

from tests.recorded_world import backlash


@pytest.mark.parametrize("effect", ["", pytest.param("hysteresis", marks=pytest.mark.slow)])
def test_a_gap_listed_three_times_too_wide(effect: str) -> None:
    seen = backlash.ask(9003, effect, "all", 0.0)
    assert seen is not None
    assert not seen.error
    assert seen.good, seen.share
    assert seen.false_stiffness == ()
    assert seen.found
