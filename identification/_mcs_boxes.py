"""Boxes of the coordinate search: initialisation list, splitting, sweeps."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import final

from identification._mcs_evaluate import Evaluator, SearchStopped
from identification._mcs_numeric import GOLDEN, Vector, magnitude_limit, parabola_minimum, slope_and_curvature


@final
@dataclass(slots=True)
class Box:
    """One box, described by its base point (evaluated), the opposite corner and its own history.

    Attributes
    ----------
    level : int
        1 for the whole box, larger for smaller boxes; the last level is not split further.
    f : float
        Objective at the base point.
    x, y : lists, shape (n,)
        Base point and opposite corner.
    splits : list of int, shape (n,)
        How often each coordinate was split.
    near : list, shape (n,)
        Two samples per split coordinate as (place, offset, place, offset): the place on that coordinate and the
        offset of the objective from the base point; None where the coordinate was never split.
    hopeless : bool
        True where the model expected no gain at the last attempt.
    """

    level: int
    f: float
    x: Vector
    y: Vector
    splits: list[int]
    near: list[tuple[float, float, float, float] | None]
    hopeless: bool = False


@final
class BoxTree:
    """The boxes by level, and the points that left the tree as candidates for a local search.

    Parameters
    ----------
    evaluate : Evaluator
        The objective with its box.
    lists : lists of floats, one per coordinate
        At least three ascending places per coordinate inside the bounds.
    start : list of int
        Which place of each list is the start.
    last_level : int
        Boxes of this level are not split.
    """

    def __init__(self, evaluate: Evaluator, lists: list[Vector], start: list[int], last_level: int) -> None:
        self._evaluate = evaluate
        self._lists = lists
        self._start = start
        self._last = last_level
        self._n = len(lists)
        self._levels: list[list[tuple[float, int, Box]]] = [[] for _ in range(last_level)]
        self._serial = 0
        self._values: list[Vector] = []
        self._rank: list[int] = []
        self._gain: Vector = []
        self.finished: list[Box] = []
        self.candidates: list[tuple[float, Vector]] = []

    def leaves(self) -> list[Box]:
        """Return all boxes that were not split: together they cover the search box."""
        return [entry[2] for level in self._levels for entry in level] + self.finished

    def interval(self, box: Box, i: int) -> tuple[float, float]:
        """Return the extent of a box in coordinate `i`."""
        if box.splits[i]:
            return min(box.x[i], box.y[i]), max(box.x[i], box.y[i])
        return self._evaluate.low[i], self._evaluate.high[i]

    def initialise(self) -> None:
        """Evaluate along the lists and make the first boxes."""
        root_x = [places[s] for places, s in zip(self._lists, self._start, strict=True)]
        best = self._evaluate_lists(list(root_x))
        opposite = [
            lo if c - lo > hi - c else hi
            for c, lo, hi in zip(root_x, self._evaluate.low, self._evaluate.high, strict=True)
        ]
        box = Box(1, self._values[0][self._start[0]], root_x, opposite, [0] * self._n, [None] * self._n)
        spread = []
        for i in range(self._n):
            children = self._split_by_list(box, i, self._values[i])
            variability, left = self._model_of_list(i, best[i])
            spread.append(variability)
            heirs = [child for j, child in children if j == best[i]]
            heir = heirs[0] if left else heirs[-1]
            for _, child in children:
                if child is not heir or i == self._n - 1:
                    self._push(child)
            box = heir
        order = sorted(range(self._n), key=lambda i: -spread[i])
        self._rank = [order.index(i) for i in range(self._n)]

    def sweep(self) -> bool:
        """Go once through the levels with the best box of each; False where nothing is left to split."""
        if not any(self._levels):
            return False
        for level in range(1, self._last):
            if self._levels[level]:
                entry = heapq.heappop(self._levels[level])
                try:
                    self._process(entry[2])
                except SearchStopped:
                    heapq.heappush(self._levels[level], entry)
                    raise
        return True

    def _push(self, box: Box) -> None:
        """File a box under its level; at the last level its base point becomes a candidate instead."""
        if box.level >= self._last:
            self.finished.append(box)
            self.candidates.append((box.f, box.x))
            return
        self._serial += 1
        heapq.heappush(self._levels[box.level], (box.f, self._serial, box))

    def _evaluate_lists(self, x: Vector) -> list[int]:
        """Evaluate the lists one coordinate after the other around the best point; return the best indices."""
        f = self._evaluate(x)
        best = []
        for i, places in enumerate(self._lists):
            values = [0.0] * len(places)
            chosen = self._start[i]
            values[chosen] = f
            for j, place in enumerate(places):
                if j == self._start[i]:
                    continue
                x[i] = place
                values[j] = self._evaluate(x)
                if values[j] < values[chosen]:
                    chosen = j
            self._gain.append(values[chosen] - f)
            x[i], f = places[chosen], values[chosen]
            self._values.append(values)
            best.append(chosen)
        return best

    def _model_of_list(self, i: int, best: int) -> tuple[float, bool]:
        """Return the range of the parabolas through the list, and whether the best place lies right of the minimum."""
        places, values = self._lists[i], self._values[i]
        last = len(places) - 1
        middle = min(max(best, 1), last - 1)
        lowest, highest, left = float("inf"), float("-inf"), True
        for j in range(1, last):
            at = places[j]
            slope, curvature = slope_and_curvature(
                at, values[j], places[j - 1], values[j - 1], places[j + 1], values[j + 1]
            )
            lo = (self._evaluate.low[i] if j == 1 else places[j - 1]) - at
            hi = (self._evaluate.high[i] if j == last - 1 else places[j + 1]) - at
            place, down = parabola_minimum(slope, curvature, lo, hi)
            _, up = parabola_minimum(-slope, -curvature, lo, hi)
            lowest, highest = min(lowest, values[j] + down), max(highest, values[j] - up)
            if j == middle:
                left = at + place <= places[best]
        return highest - lowest, left

    def _child(
        self, box: Box, i: int, level: int, f: float, ends: tuple[float, float], samples: list[tuple[float, float]]
    ) -> Box:
        """Make a child of `box` cut in coordinate `i`, with base and opposite place `ends`."""
        x, y, splits, near = box.x[:], box.y[:], box.splits[:], box.near[:]
        base = ends[0]
        x[i], y[i] = ends
        splits[i] += 1
        own = near[i]
        if own is not None:
            samples = [samples[0], (own[0], box.f + own[1]), (own[2], box.f + own[3])]
        first: tuple[float, float] | None = None
        for sample in samples:
            if sample[0] == base:
                continue
            if first is None:
                first = sample
            elif sample[0] != first[0]:
                near[i] = (first[0], first[1] - f, sample[0], sample[1] - f)
                break
        return Box(level, f, x, y, splits, near)

    def _split_by_list(self, box: Box, i: int, values: Vector) -> list[tuple[int, Box]]:
        """Cut a box at the places of list `i`; return the children left to right with the index of their base."""
        places = self._lists[i]
        last = len(places) - 1
        low, high = self._evaluate.low[i], self._evaluate.high[i]
        samples = list(zip(places, values, strict=True))
        children: list[tuple[int, Box]] = []

        def add(j: int, opposite: float, deeper: int) -> None:
            side = 1 if opposite > places[j] else -1
            order = sorted((k for k in range(last + 1) if k != j), key=lambda k: (abs(k - j), (j - k) * side > 0))
            known = [samples[k] for k in order]
            children.append((j, self._child(box, i, box.level + deeper, values[j], (places[j], opposite), known)))

        if places[0] > low:
            add(0, low, 1)
        for j in range(last):
            left_better = values[j] <= values[j + 1]
            share = GOLDEN if left_better else 1.0 - GOLDEN
            cut = places[j] + share * (places[j + 1] - places[j])
            add(j, cut, 1 if left_better else 2)
            add(j + 1, cut, 2 if left_better else 1)
        if places[last] < high:
            add(last, high, 1)
        return children

    def _process(self, box: Box) -> None:
        """Split a box by rank or by expected gain, or lift it one level."""
        fewest = min(box.splits)
        if box.level > 2 * self._n * (fewest + 1):
            i = min((i for i in range(self._n) if box.splits[i] == fewest), key=lambda i: self._rank[i])
            place = box.x[i] + 2.0 / 3.0 * (magnitude_limit(box.x[i], box.y[i]) - box.x[i])
            if self._split(box, i, place):
                return
        elif not box.hopeless:
            i, place, gain = self._expected_gain(box)
            if box.f + gain < self._evaluate.best and self._split(box, i, place):
                return
            box.hopeless = True
        box.level += 1
        self._push(box)

    def _expected_gain(self, box: Box) -> tuple[int, float, float]:
        """Return coordinate, place and expected change of the most promising split."""
        best, at, gain = 0, box.x[0], float("inf")
        for i in range(self._n):
            near = box.near[i]
            place = x = box.x[i]
            if near is None:
                change = self._gain[i]
            else:
                far = magnitude_limit(x, box.y[i]) - x
                slope, curvature = slope_and_curvature(x, 0.0, near[0], near[1], near[2], near[3])
                step, change = parabola_minimum(slope, curvature, 0.1 * far, far)
                place = x + step
            if change < gain:
                best, at, gain = i, place, change
        return best, at, gain

    def _split(self, box: Box, i: int, place: float) -> bool:
        """Split a box in coordinate `i`; False where it is too thin for another floating-point number."""
        if box.splits[i] == 0:
            x = list(box.x)
            values = []
            for j, c in enumerate(self._lists[i]):
                x[i] = c
                values.append(box.f if j == self._start[i] else self._evaluate(x))
            for _, child in self._split_by_list(box, i, values):
                self._push(child)
            return True
        return self._split_at(box, i, place)

    def _split_at(self, box: Box, i: int, place: float) -> bool:
        """Split a box at one place: two children up to there, a third beyond it."""
        start, end = box.x[i], box.y[i]
        place = min(max(place, min(start, end)), max(start, end))
        if place == start or start + 0.1 * (place - start) == start:
            return False
        x = box.x[:]
        x[i] = place
        f = self._evaluate(x)
        here_better = box.f <= f
        part = GOLDEN if here_better else 1.0 - GOLDEN
        cut = start + part * (place - start)
        better, worse = box.level + 1, box.level + 2
        here, there = (better, worse) if here_better else (worse, better)
        old = [(start, box.f)]
        self._push(self._child(box, i, here, box.f, (start, cut), [(place, f)]))
        self._push(self._child(box, i, there, f, (place, cut), old))
        if place != end:
            wide = abs(end - place) > (1.0 - GOLDEN) * abs(place - start)
            self._push(self._child(box, i, better if wide else worse, f, (place, end), old))
        return True
