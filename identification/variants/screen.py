"""All variants scored at once: one factorisation of the library beside a fitted base.

Every candidate gives columns at every point of the grid of its shapes, at amplitude zero. The
products of all columns, of the base and of the residual are formed once per fold and balance, and
the base is eliminated once per fold. A variant is then a small system of its own amplitudes: its
cross-validated squares need no row of the records again.

The score of a variant is ``sum over balances of ln RMS`` and the price of its parts
(:func:`identification.variants.lattice.price_of`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import Balances, balances_of
from identification.diagnosis.candidates import shape_grid
from identification.diagnosis.trials import COLLINEAR, Base, columns
from identification.fitting.signed_fit import part_inverse
from identification.variants.lattice import Node, together

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

BEAM: Final = 60
"""Variants of one size that are carried on to the next: a third effect that helps only beside the
sixty-first pair has never been best on the simulated joints."""
LARGEST: Final = 4
"""Effects that a variant adds at most in one expansion."""
EARNED: Final = 0.5
"""Share of its price, or of what is told, that a part must bring in the screen to be fitted: to
first order a good part loses up to half of its gain."""
SWEEPS: Final = 2
"""Rounds over the shapes of a variant; a third one changes nothing on grids of two to twelve
points."""
RIDGE: Final = 1e-9
"""Share of its own information by which each amplitude is held, so that twins have a solution."""
LEAST: Final = 1e-3
"""Share of the whole information on an amplitude that a fold's training part must hold to say
anything about it."""
AT_ONCE: Final = 4096
"""Variants of one batch: 4096 systems of a dozen unknowns fit the processor's cache."""


@final
@dataclass(frozen=True)
class Option:
    """A part at one point of the grid of its shapes.

    Attributes
    ----------
    node : int
        Number of the part.
    shapes : mapping of str to float
    columns : tuple of int
        Columns of its amplitudes.
    """

    node: int
    shapes: Mapping[str, float]
    columns: tuple[int, ...]


@final
@dataclass(frozen=True)
class Scored:
    """A variant as the screen sees it.

    Attributes
    ----------
    options : tuple of int
        Of its parts, in the order of the parts.
    score : float
        To first order about the base; lower is better.
    """

    options: tuple[int, ...]
    score: float


@final
class Screen:
    """The library beside a base, factorised.

    Parameters
    ----------
    base : Base
        A fitted model with its weighted rows.
    nodes : sequence of Node
        Parts that may be added.
    more : mapping of (str, str) to float
        Shapes beside those of the grids, by label of the part: where a refined fit found them.
    laws : dict of (str, bool or None) to Balances, optional
        Laws of the parts, compiled once for several screens; filled here.
    progress : callable, optional
        ``progress(text, share)``.
    """

    def __init__(
        self,
        base: Base,
        nodes: Sequence[Node],
        more: Mapping[str, Mapping[str, float]],
        *,
        laws: dict[tuple[str, bool | None], Balances] | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> None:
        self.base = base
        told = progress or (lambda text, share: None)
        kept: list[Node] = []
        options: list[Option] = []
        made: list[FloatArray] = []
        lows: list[float] = [0.0] * base.inward.shape[1]
        width = len(lows)
        for number, node in enumerate(nodes):
            told(f"columns of {node.candidate.effect.title.lower()}", number / len(nodes))
            points = list(shape_grid(node.candidate, base.data))
            if node.label in more:
                points.append(dict(more[node.label]))
            law = _law(node, base, {} if laws is None else laws)
            found = [(p, c) for p in points if (c := _columns(node, base, p, law)) is not None]
            if not found:
                continue
            low = {p.name: p.low for p in node.candidate.model.parameters}
            for shapes, block in found:
                options.append(
                    Option(len(kept), shapes, tuple(range(width, width + block.shape[1])))
                )
                made.append(block)
                lows += [low[n] for n in node.candidate.amplitudes]
                width += block.shape[1]
            kept.append(node)
        self.nodes, self.options = tuple(kept), tuple(options)
        self._lows = np.array([*lows, 0.0])
        self._scale = _factorise(base, made)
        self.tried = 0
        self._of = [[k for k, o in enumerate(options) if o.node == n] for n in range(len(kept))]

    # --- one batch of variants --------------------------------------------------------------------

    def _systems(self, variants: Sequence[Sequence[int]]) -> IntArray:
        """Columns of each variant, padded with an empty one."""
        own = tuple(range(self.base.inward.shape[1]))
        picked = [(*own, *(c for k in v for c in self.options[k].columns)) for v in variants]
        most = max((len(p) for p in picked), default=0)
        empty = len(self._lows) - 1
        return np.array([[*p, *[empty] * (most - len(p))] for p in picked], dtype=np.int64)

    def scores(self, variants: Sequence[Sequence[int]]) -> FloatArray:
        """Score of each variant, given as options; lower is better."""
        out = np.empty(len(variants))
        for first in range(0, len(variants), AT_ONCE):
            part = variants[first : first + AT_ONCE]
            price = [sum(self.nodes[self.options[k].node].price for k in v) for v in part]
            out[first : first + len(part)] = self._errors(self._systems(part)) + np.array(price)
        self.tried += len(variants)
        return out

    def _errors(self, index: IntArray) -> FloatArray:
        """Sum over balances of the logarithm of the cross-validated RMS."""
        found = self._scale
        squares = np.zeros((len(index), found.tests.shape[1]))
        rest = len(self._lows)
        for fold, train in enumerate(found.trains):
            least = LEAST * np.diag(found.whole) * (1.0 if len(found.trains) > 1 else 0.0)
            a = _signed(train, index, self._lows, np.diag(train) >= least)
            full = np.column_stack([index, np.full(len(index), rest)])
            vector = np.column_stack([a, np.ones(len(a))])
            for b in range(squares.shape[1]):
                test = found.tests[fold, b]
                gram = test[full[:, :, None], full[:, None, :]]
                squares[:, b] += np.einsum("vij,vi,vj->v", gram, vector, vector)
        rows = found.rows
        used = rows > 0
        mean = np.maximum(squares[:, used], 1e-300) / rows[used]
        return np.asarray(0.5 * np.log(mean).sum(axis=1), dtype=np.float64)

    def amplitudes(self, variant: Sequence[int]) -> FloatArray:
        """Fitted amplitudes of a variant, those that return from a bound first; in the units of
        the columns.
        """
        index = self._systems([variant])
        known = np.ones(len(self._lows), dtype=bool)
        return np.asarray(_signed(self._scale.whole, index, self._lows, known)[0])

    def start_of(self, variant: Sequence[int]) -> dict[str, float]:
        """Values from which a fit of a variant starts: the base moved along, shapes from the grid,
        amplitudes to first order. Of what the base has beside the values of its model, as the
        parameters of a user's FMU, it is the change.
        """
        base, found = self.base, self._scale
        own = base.inward.shape[1]
        a = self.amplitudes(variant)
        index = self._systems([variant])[0]
        moved = found.back[:, index] @ a + found.back[:, -1]
        values = dict(base.solution.values)
        for n, d in zip(base.names, (moved / base.norms).tolist(), strict=True):
            values[n] = values.get(n, 0.0) + d
        at = own
        for k in variant:
            option = self.options[k]
            candidate = self.nodes[option.node].candidate
            for n, c in zip(candidate.amplitudes, option.columns, strict=True):
                values[n] = float(a[at] / found.sizes[c - own])
                at += 1
            values |= option.shapes
        return values

    def parts(self, variant: Sequence[int]) -> tuple[Node, ...]:
        """The parts of a variant."""
        return tuple(self.nodes[self.options[k].node] for k in variant)

    def real(self, variant: Sequence[int]) -> bool:
        """Whether every part of a variant has an amplitude that is not zero: a sign that the data
        do not want takes a part out.
        """
        a = self.amplitudes(variant)
        at = self.base.inward.shape[1]
        for k in variant:
            width = len(self.options[k].columns)
            if not np.any(a[at : at + width]):
                return False
            at += width
        return True

    # --- the search -------------------------------------------------------------------------------

    def search(self, largest: int = LARGEST) -> list[Scored]:
        """All single effects and pairs, and beams for larger variants; best first."""
        nothing = Scored((), float(self.scores([()])[0]))
        out = [nothing]
        singles = [(k,) for k in range(len(self.options))]
        value = self.scores(singles)
        best = [
            min(own, key=lambda k: value[k]) for own in self._of
        ]  # shape of each part where it is best alone
        alone = [
            Scored((k,), float(value[k])) for n, k in enumerate(best) if not self.nodes[n].beside
        ]
        out += alone
        grown = [s.options for s in alone] + [
            (k,) for n, k in enumerate(best) if self.nodes[n].beside
        ]
        for _ in range(2, largest + 1):
            wider = self._wider(grown, best)
            if not wider:
                break
            found = self._shaped(wider)
            out += [s for s in found if together(self.parts(s.options))]
            # a part that needs another one waits for it in the beam
            grown = [s.options for s in sorted(found, key=lambda s: s.score)[:BEAM]]
        return sorted(out, key=lambda s: s.score)

    def _wider(
        self, grown: Iterable[tuple[int, ...]], best: Sequence[int]
    ) -> list[tuple[int, ...]]:
        """Variants with one part more, each once."""
        out: dict[tuple[int, ...], tuple[int, ...]] = {}
        for variant in grown:
            there = {self.options[k].node for k in variant}
            for n, k in enumerate(best):
                if n in there:
                    continue
                new = tuple(sorted((*variant, k), key=lambda i: self.options[i].node))
                mark = tuple(self.options[i].node for i in new)
                if mark not in out and self._may(new):
                    out[mark] = new
        return list(out.values())

    def _may(self, variant: Sequence[int]) -> bool:
        """Whether the parts go together, or would with what one of them still waits for."""
        parts = self.parts(variant)
        labels = {p.label for p in parts}
        waiting = {p.beside for p in parts if p.beside} - labels
        if len(waiting) > 1 or (waiting and len(parts) >= LARGEST):
            return False
        lent = [n for n in self.nodes if n.label in waiting]
        return together(parts) or any(together((*parts, n)) for n in lent)

    def _shaped(self, variants: Sequence[tuple[int, ...]]) -> list[Scored]:
        """Variants at the best points of their grids, one part at a time."""
        now = [list(v) for v in variants]
        value = self.scores(now)
        for _ in range(SWEEPS):
            changed = False
            for position in range(max(len(v) for v in now)):
                tries: list[tuple[int, list[int]]] = []
                for i, v in enumerate(now):
                    if position >= len(v):
                        continue
                    for k in self._of[self.options[v[position]].node]:
                        if k != v[position]:
                            tries.append((i, [*v[:position], k, *v[position + 1 :]]))
                found = self.scores([t for _, t in tries]) if tries else np.empty(0)
                for (i, t), s in zip(tries, found.tolist(), strict=True):
                    if s < value[i]:
                        value[i], now[i], changed = s, t, True
            if not changed:
                break
        return [Scored(tuple(v), float(s)) for v, s in zip(now, value.tolist(), strict=True)]

    def worth(self, ranked: Sequence[Scored]) -> Iterator[Scored]:
        """Of scored variants, best first, those worth a fit: every part has an amplitude and earns
        a fair share of its price beside the others.
        """
        marks = [frozenset(self.options[k].node for k in s.options) for s in ranked]
        known = dict(zip(marks, (s.score for s in ranked), strict=True))
        for scored, mark in zip(ranked, marks, strict=True):
            earns = all(
                known[mark - {n}] - scored.score >= (EARNED - 1) * self.nodes[n].price
                for n in mark
                if mark - {n} in known
            )
            if earns and self.real(scored.options):
                yield scored

    def lowering(self, ranked: Sequence[Scored], least: float) -> list[Scored]:
        """Of scored variants those with one part that lowers the error, its price left out, by so
        much at least; best first.
        """
        price = {s.options: sum(p.price for p in self.parts(s.options)) for s in ranked}
        base = next(s.score for s in ranked if not s.options)
        return [
            s
            for s in ranked
            if len(s.options) == 1
            and base - (s.score - price[s.options]) >= least
            and self.real(s.options)
        ]

    def grid_of(self, single: Scored) -> list[tuple[int, ...]]:
        """A variant with one part, at every point of the grid of its shapes."""
        (option,) = single.options
        return [(k,) for k in self._of[self.options[option].node]]

    def swapped(self, variant: Sequence[int]) -> list[Scored]:
        """A variant with one of its parts exchanged, or left out; best first."""
        out: list[Scored] = []
        for position in range(len(variant)):
            rest = [*variant[:position], *variant[position + 1 :]]
            others = [
                tuple(sorted((*rest, k), key=lambda i: self.options[i].node))
                for k in range(len(self.options))
                if self.options[k].node not in {self.options[i].node for i in variant}
            ]
            others = [v for v in others if together(self.parts(v))]
            best: dict[tuple[int, ...], Scored] = {}
            for v, s in zip(others, self.scores(others).tolist() if others else [], strict=True):
                mark = tuple(self.options[i].node for i in v)
                if mark not in best or s < best[mark].score:
                    best[mark] = Scored(v, s)
            out += best.values()
        for size in range(1, len(variant)):
            for part in itertools.combinations(variant, size):
                if together(self.parts(part)):
                    out.append(Scored(part, float(self.scores([part])[0])))
        return sorted(out, key=lambda s: s.score)


def _law(node: Node, base: Base, laws: dict[tuple[str, bool | None], Balances]) -> Balances:
    """Balances of the model with a part, with columns of its amplitudes."""
    mark = node.label, node.form
    if mark not in laws:
        candidate = node.candidate
        laws[mark] = balances_of(
            candidate.model, base.data.sensing, wrt=candidate.amplitudes, columns_only=True
        )
    return laws[mark]


def _columns(
    node: Node, base: Base, shapes: Mapping[str, float], balances: Balances
) -> FloatArray | None:
    """Weighted columns of a part at one point of its grid; None where nothing of them lies outside
    the base.
    """
    candidate = node.candidate
    raw = columns(candidate, base, shapes, base.data.train, balances) * base.weight[:, None]
    size = np.linalg.norm(raw, axis=0)
    if not np.all(np.isfinite(raw)) or size.max(initial=0.0) <= 0:
        return None
    unit = raw / np.where(size > 0, size, 1.0)
    outside = unit - base.orthonormal @ (base.orthonormal.T @ unit)
    return raw if np.linalg.norm(outside, axis=0).max() >= COLLINEAR else None


@final
@dataclass(frozen=True)
class _Factors:
    """Systems of the amplitudes with the base eliminated, an empty column and the residual last.

    Attributes
    ----------
    trains : (folds, c, c) array
        Normal matrices without each fold.
    whole : (c, c) array
    tests : (folds, balances, c, c) array
        Squares of each fold with the base of its training part.
    back : (p, c) array
        How the base moves along, on all rows.
    sizes : (columns,) array
        What each column was divided by.
    rows : (balances,) array
    """

    trains: FloatArray
    whole: FloatArray
    tests: FloatArray
    back: FloatArray
    sizes: FloatArray
    rows: FloatArray


def _factorise(base: Base, made: Sequence[FloatArray]) -> _Factors:
    p = base.jacobian.shape[1]
    order = base.order
    added = np.column_stack([m[order] for m in made]) if made else np.empty((len(order), 0))
    sizes = np.linalg.norm(added, axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    added /= sizes
    plain = base.plain
    rows = np.column_stack([plain[:, :-1], added, np.zeros(len(order)), plain[:, -1]])
    count, width = len(base.balances), rows.shape[1]
    fold = np.arange(base.blocks) % base.folds
    grams = np.zeros((base.folds, count, width, width))
    ends = np.append(base.firsts[1:], len(order))
    at = order[base.firsts]
    for first, end, block, balance in zip(
        base.firsts.tolist(),
        ends.tolist(),
        base.block[at].tolist(),
        base.balance[at].tolist(),
        strict=True,
    ):
        part = rows[first:end]
        grams[fold[block], balance] += part.T @ part
    total = grams.sum(axis=(0, 1))
    trains, tests = [], []
    for k in range(base.folds):
        train = total - grams[k].sum(axis=0) if base.folds > 1 else total
        back, small = _eliminated(train, total, p)
        whole = np.vstack([back, np.eye(width - p)])
        trains.append(small)
        tests.append([whole.T @ g @ whole for g in grams[k]])
    back, small = _eliminated(total, total, p)
    return _Factors(
        np.array(trains),
        small,
        np.array(tests),
        back,
        sizes,
        base.numbers.sum(axis=0).astype(np.float64),
    )


def _eliminated(train: FloatArray, total: FloatArray, p: int) -> tuple[FloatArray, FloatArray]:
    """How the base follows the other columns, and their normal matrix without it."""
    back = -part_inverse(train[:p, :p], total[:p, :p]) @ train[:p, p:]
    small = train[p:, p:] + train[p:, :p] @ back
    return back, small


def _signed(
    normal: FloatArray, index: IntArray, lows: FloatArray, told: npt.NDArray[np.bool_]
) -> FloatArray:
    """Amplitudes of many variants; those of a wrong sign, and those of which nothing is told, stay
    at zero.

    Parameters
    ----------
    normal : (c, c) array
        The residual last.
    index : (v, k) int array
        Columns of each variant.
    lows : (c - 1,) array
        Lower bounds: 0 for an amplitude of one sign.
    told : (c,) bool array
        Whether these rows say anything about a column.
    """
    own = np.diag(normal)[index]
    active = (own > 0) & told[index]
    signed = lows[index] == 0.0
    scale = 1 / np.sqrt(np.where(active, own, 1.0))
    out = np.zeros(index.shape)
    todo = np.arange(len(index))
    rest = len(normal) - 1
    eye = np.eye(index.shape[1])
    for _ in range(index.shape[1] + 1):
        if not len(todo) or not index.shape[1]:
            break
        here, on, s = index[todo], active[todo], scale[todo]
        gram = normal[here[:, :, None], here[:, None, :]] * s[:, :, None] * s[:, None, :]
        gram = np.where(on[:, :, None] & on[:, None, :], gram, 0.0) + eye * (
            RIDGE + ~on[:, None, :]
        )
        right = -normal[here, rest] * s * on
        found = np.linalg.solve(gram, right[:, :, None])[:, :, 0] * s
        out[todo] = np.where(on, found, 0.0)
        wrong = on & signed[todo] & (found < 0)
        active[todo] &= ~wrong
        todo = todo[wrong.any(axis=1)]
    return np.where(active, out, 0.0)
