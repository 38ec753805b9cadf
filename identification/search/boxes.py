"""Boxes of the coordinate search: initialisation list, splitting, sweeps."""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush, heapreplace
from typing import TypeAlias, final

from identification.search.evaluate import Evaluator, SearchStopped
from identification.search.numeric import (
    GOLDEN,
    Vector,
    magnitude_limit,
    parabola_minimum,
    slope_and_curvature,
)

Point: TypeAlias = tuple[float, ...]
Leaf: TypeAlias = tuple[float, ...]
"""A box in the tree, flat: f, serial number, level up to which its coordinate is chosen by the
expected gain, hopeless; then x, y, splits (n each) and the samples of `near` (4 n; zeros where the
coordinate was never split). The first two order the boxes of a level. A long search makes a hundred
thousand boxes: flat tuples of numbers are quick to compare and to copy, and the garbage collector
does not look at them twice."""
_HEAD = 4

_LOWEST = 0.5 + 1e-6
"""Times slope squared over curvature: how far a parabola falls, with room for rounding."""

_THIN = 0.1
"""Part of a split that must still move its start: a box of fewer floating-point numbers is thin."""


@final
@dataclass(frozen=True, slots=True)
class Box:
    """One box, described by its base point (evaluated), the opposite corner and its own history.

    Attributes
    ----------
    level : int
        1 for the whole box, larger for smaller boxes; the last level is not split further.
    f : float
        Objective at the base point.
    x, y : tuples, shape (n,)
        Base point and opposite corner.
    splits : tuple of int, shape (n,)
        How often each coordinate was split.
    near : tuple, shape (n,)
        Two samples per split coordinate as (place, offset, place, offset): the place on that
        coordinate and the offset of the objective from the base point; None where the coordinate
        was never split.
    hopeless : bool
        True where the model expected no gain at the last attempt.
    """

    level: int
    f: float
    x: Point
    y: Point
    splits: tuple[int, ...]
    near: tuple[tuple[float, ...] | None, ...]
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

    def __init__(
        self, evaluate: Evaluator, lists: list[Vector], start: list[int], last_level: int
    ) -> None:
        self._evaluate = evaluate
        self._known = evaluate.known
        self._lists = lists
        self._start = start
        self._last = last_level
        self._n = n = len(lists)
        self._step = 2 * n  # levels per complete round of splits after which a box is split by rank
        self._y, self._splits, self._near = _HEAD + n, _HEAD + 2 * n, _HEAD + 3 * n
        # two levels beyond the last one: what falls there is collected after each sweep
        self._levels: list[list[Leaf]] = [[] for _ in range(last_level + 2)]
        self._finished: list[tuple[int, Leaf]] = []
        self._serial = 0
        self._values: list[Vector] = []
        self._ranking: list[int] = []
        self._gain: Vector = []
        self.candidates: list[tuple[float, Point]] = []

    def leaves(self) -> list[Box]:
        """Return all boxes that were not split: together they cover the search box."""
        waiting = [(level, leaf) for level, leaves in enumerate(self._levels) for leaf in leaves]
        return [self._box(level, leaf) for level, leaf in waiting + self._finished]

    def finished(self) -> list[Box]:
        """Return the boxes of the last level."""
        return [self._box(level, leaf) for level, leaf in self._finished]

    def _box(self, level: int, leaf: Leaf) -> Box:
        x, y, counts = (leaf[first : first + self._n] for first in (_HEAD, self._y, self._splits))
        splits = tuple(int(c) for c in counts)
        near = tuple(
            leaf[self._near + 4 * i : self._near + 4 * i + 4] if c else None
            for i, c in enumerate(splits)
        )
        return Box(level, leaf[0], x=x, y=y, splits=splits, near=near, hopeless=bool(leaf[3]))

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
        box: Leaf = (
            self._values[0][self._start[0]],
            0,
            self._step,
            False,
            *root_x,
            *opposite,
            *[0] * (5 * self._n),
        )
        level = 1
        spread = []
        for i in range(self._n):
            children = self._split_by_list(box, i, level, self._values[i])
            variability, left = self._model_of_list(i, best[i])
            spread.append(variability)
            heirs = [(deeper, child) for j, deeper, child in children if j == best[i]]
            heir = heirs[0] if left else heirs[-1]
            for _, deeper, child in children:
                if child is not heir[1] or i == self._n - 1:
                    self._file(deeper, child)
            level, box = heir
        self._ranking = sorted(range(self._n), key=lambda i: -spread[i])

    def sweep(self) -> bool:
        """Go once through the levels with the best box of each; False where nothing is left to
        split.
        """
        levels, last = self._levels, self._last
        if not any(levels[:last]):
            return False
        lifted: Leaf | None = None
        box: Leaf = ()
        level = 0
        try:
            for level in range(1, last):
                waiting = levels[level]
                if lifted is None:
                    if not waiting:
                        continue
                    box = heappop(waiting)
                elif waiting and waiting[0][0] <= lifted[0]:
                    box = heapreplace(waiting, self._renumbered(lifted))
                else:
                    box = lifted
                lifted = box if box[3] and level <= box[2] else self._process(box, level)
            if lifted is not None:
                levels[last].append(lifted)
        except SearchStopped:
            heappush(levels[level], box)
            raise
        finally:
            self._collect()
        return True

    def _collect(self) -> None:
        """Make candidates of the boxes that reached the last level."""
        for level in (self._last, self._last + 1):
            leaves, self._levels[level] = self._levels[level], []
            for leaf in leaves:
                self._file(level, leaf)

    def _renumbered(self, leaf: Leaf) -> Leaf:
        """The same box, filed last among its equals."""
        self._serial += 1
        return leaf[0], self._serial, *leaf[2:]

    def _file(self, level: int, leaf: Leaf) -> None:
        """File a box under its level; at the last level its base point becomes a candidate
        instead.
        """
        if level < self._last:
            heappush(self._levels[level], leaf)
        else:
            self._finished.append((level, leaf))
            self.candidates.append((leaf[0], leaf[_HEAD : self._y]))

    def _evaluate_lists(self, x: Vector) -> list[int]:
        """Evaluate the lists one coordinate after the other around the best point; return the
        best indices.
        """
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
        """Return the range of the parabolas through the list, and whether the best place lies
        right of the minimum.
        """
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
        self,
        box: Leaf,
        i: int,
        f: float,
        ends: tuple[float, float],
        samples: list[tuple[float, float]],
    ) -> Leaf:
        """Make a child of `box` cut at the list of coordinate `i`, with base and opposite place
        `ends`.

        `samples` are the other samples of the list, the two to keep first.
        """
        (first, f_first), (second, f_second) = samples[:2]
        child, splits, near = list(box), self._splits, self._near + 4 * i
        self._serial += 1
        child[_HEAD + i], child[self._y + i] = ends
        child[splits + i] += 1
        child[:_HEAD] = (
            f,
            self._serial,
            self._step * (min(child[splits : splits + self._n]) + 1),
            False,
        )
        child[near : near + 4] = first, f_first - f, second, f_second - f
        return tuple(child)

    def _split_by_list(
        self, box: Leaf, i: int, level: int, values: Vector
    ) -> list[tuple[int, int, Leaf]]:
        """Cut a box at the places of list `i`; return index of the base, level and child, left
        to right.
        """
        places = self._lists[i]
        last = len(places) - 1
        low, high = self._evaluate.low[i], self._evaluate.high[i]
        samples = list(zip(places, values, strict=True))
        children: list[tuple[int, int, Leaf]] = []

        def add(j: int, opposite: float, deeper: int) -> None:
            side = 1 if opposite > places[j] else -1
            order = sorted(
                (k for k in range(last + 1) if k != j),
                key=lambda k: (abs(k - j), (j - k) * side > 0),
            )
            known = [samples[k] for k in order]
            children.append(
                (j, level + deeper, self._child(box, i, values[j], (places[j], opposite), known))
            )

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

    def _process(self, box: Leaf, level: int) -> Leaf | None:
        """Split a box by rank or by expected gain; return it where it is to be lifted one level
        instead.
        """
        if level > box[2]:
            fewest, i = box[2] / self._step - 1, 0
            for i in self._ranking:
                if box[self._splits + i] == fewest:
                    break
            x = box[_HEAD + i]
            place = x + 2.0 / 3.0 * (magnitude_limit(x, box[self._y + i]) - x)
            return None if self._split(box, i, level, place) else box
        i, place, gain = self._expected_gain(box)
        if box[0] + gain < self._evaluate.best and self._split(box, i, level, place):
            return None
        return *box[:3], True, *box[_HEAD:]

    def _expected_gain(self, box: Leaf) -> tuple[int, float, float]:
        """Return coordinate, place and expected change of the most promising split.

        Coordinates whose parabola nowhere falls below the best value so far are passed over.
        """
        best, at, gain = 0, box[_HEAD], float("inf")
        f, wanted, near = box[0], self._evaluate.best, self._near
        for i in range(self._n):
            place = x = box[_HEAD + i]
            if not box[self._splits + i]:
                change = self._gain[i]
            else:
                first, d_first, second, d_second = box[near + 4 * i : near + 4 * i + 4]
                slope, curvature = slope_and_curvature(x, 0.0, first, d_first, second, d_second)
                if curvature > 0.0 and f - _LOWEST * slope * slope / curvature >= wanted:
                    continue
                far = magnitude_limit(x, box[self._y + i]) - x
                step, change = parabola_minimum(slope, curvature, 0.1 * far, far)
                place = x + step
            if change < gain:
                best, at, gain = i, place, change
        return best, at, gain

    def _split(self, box: Leaf, i: int, level: int, place: float) -> bool:
        """Split a box in coordinate `i` at one place; False where it is too thin for another
        floating-point number.

        Two children up to the place, a third beyond it. A coordinate never split before is split at
        its whole list.
        """
        at_x, at_y, at_splits, near = _HEAD + i, self._y + i, self._splits + i, self._near + 4 * i
        if not box[at_splits]:
            self._split_at_list(box, i, level)
            return True
        start, end = box[at_x], box[at_y]
        if start < end:
            place = start if place < start else end if place > end else place
        else:
            place = end if place < end else start if place > start else place
        if place == start or start + _THIN * (place - start) == start:
            return False
        point = box[_HEAD:at_x] + (place,) + box[at_x + 1 : self._y]
        f, found = box[0], self._known.get(point)
        if found is None:
            found = self._evaluate.inside(point)
        here_better = f <= found
        part = GOLDEN if here_better else 1.0 - GOLDEN
        cut = start + part * (place - start)
        better, worse = level + 1, level + 2
        here, there = (better, worse) if here_better else (worse, better)
        first, d_first, second, d_second = box[near : near + 4]
        known, value = (first, f + d_first) if first != place else (second, f + d_second)
        child, levels, serial = list(box), self._levels, self._serial
        self._serial = serial + 3
        child[1], child[3], child[at_y] = serial + 1, False, cut
        child[at_splits] += 1
        if (
            box[2] == self._step * child[at_splits]
            and box[at_splits] not in child[self._splits : self._near]
        ):
            child[2] += self._step
        child[near : near + 4] = place, found - f, known, value - f
        heappush(levels[here], tuple(child))
        child[0], child[1], child[at_x] = found, serial + 2, place
        child[near : near + 4] = start, f - found, known, value - found
        heappush(levels[there], tuple(child))
        if place != end:
            wide = abs(end - place) > (1.0 - GOLDEN) * abs(place - start)
            child[1], child[at_y] = serial + 3, end
            heappush(levels[better if wide else worse], tuple(child))
        return True

    def _split_at_list(self, box: Leaf, i: int, level: int) -> None:
        """Evaluate the list of coordinate `i` through the base of a box, and split it there."""
        x = list(box[_HEAD : self._y])
        values = []
        for j, c in enumerate(self._lists[i]):
            x[i] = c
            values.append(box[0] if j == self._start[i] else self._evaluate.inside(tuple(x)))
        for _, deeper, child in self._split_by_list(box, i, level, values):
            heappush(self._levels[deeper], child)
