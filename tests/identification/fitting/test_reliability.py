"""The reliability page tells stated chances and intervals that are true from those that are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.trust.reliability import Kept, Seen, Stated, brier, page, skill, tenths


def stated(honest: bool, count: int = 4000) -> list[Stated]:
    """Names whose chance is what was stated, or is one half whatever was stated."""
    rng = np.random.default_rng(3)
    chance = rng.uniform(0, 1, count)
    right = rng.uniform(0, 1, count) < (chance if honest else 0.5)
    return [
        Stated(float(c), bool(r), first=True, alone=True)
        for c, r in zip(chance, right, strict=True)
    ]


def seen(cover: float, count: int = 1000) -> list[Seen]:
    return [
        Seen("stiffness", "stiffness", "turning", k >= (1 - cover) * count, 0.0)
        for k in range(count)
    ]


def test_scores_of_a_known_law() -> None:
    # chance uniform in 0..1: an honest one scores E[c (1 - c)] = 1/6, a third better than the 1/4
    # of a constant; an unfounded one scores 1/4 + 1/12, a third worse
    assert brier(stated(True)) == pytest.approx(1 / 6, abs=0.01)
    assert skill(stated(True)) == pytest.approx(100 / 3, abs=4)
    assert brier(stated(False)) == pytest.approx(1 / 3, abs=0.01)
    assert skill(stated(False)) == pytest.approx(-100 / 3, abs=4)
    assert np.isnan(skill([Stated(1.0, right=True, first=True, alone=True)]))


def test_every_name_is_in_one_tenth() -> None:
    edges = [Stated(c, right=True, first=True, alone=True) for c in (0.0, 0.1, 0.95, 1.0)]
    assert [(low, len(own)) for low, own in tenths(edges)] == [(0, 1), (10, 1), (90, 2)]


def test_page_says_which_class_is_not_covered() -> None:
    bad = page("python -m benchmarks.trust", "Joints.", seen(0.80), stated(True, 50))
    good = page("python -m benchmarks.trust", "Joints.", seen(0.95), [])
    assert "outside 93 to 97 %: stiffness (surely)." in bad
    assert "outside 93 to 97 %: none." in good
    assert "One-name answers" in bad
    assert "One-name answers" not in good


def test_kept_outcomes_are_not_run_again(tmp_path: Path) -> None:
    runs = 0

    def run() -> list[Seen]:
        nonlocal runs
        runs += 1
        return seen(0.5, 2)

    for _ in range(2):
        kept = Kept(tmp_path / "kept.jsonl")
        assert kept.found({"seed": 1}, Seen, run) == seen(0.5, 2)
    assert runs == 1
    Kept(tmp_path / "kept.jsonl").found({"seed": 2}, Seen, run)
    assert runs == 2
