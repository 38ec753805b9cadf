"""U-D factor of a covariance in CasADi scalars: the pieces the step of the recursive least squares
is made of.

Sources: Bierman, Factorization Methods for Discrete Sequential Estimation (1977): measurement
update; Agee and Turner (1972): rank-one update.
"""

from __future__ import annotations

from typing import Any, final

import casadi as ca

from identification.recursive.settings import Block

SX = Any  # CasADi has no type stubs.

_VARIANCE_LOW = 1e-200


def where(condition: SX, value: SX) -> SX:
    """Value where the condition holds, else 0; never passes on a NaN of the branch not taken."""
    return ca.SX.binary(ca.OP_IF_ELSE_ZERO, condition, value)


def select(condition: SX, yes: SX, no: SX) -> SX:
    """One of two expressions by a condition."""
    return where(condition, yes) + where(ca.logic_not(condition), no)


def every(conditions: list[SX]) -> SX:
    """True where all conditions hold."""
    result = conditions[0]
    for condition in conditions[1:]:
        result = ca.logic_and(result, condition)
    return result


def total(terms: list[SX]) -> SX:
    """Sum of the terms, 0 without any."""
    result = ca.SX(0)
    for term in terms:
        result = result + term
    return result


def dot(left: list[SX], right: list[SX]) -> SX:
    """Scalar product."""
    return total([a * b for a, b in zip(left, right, strict=True)])


@final
class Parts:
    """Scalars of a flat symbol by name."""

    def __init__(self, symbol: SX, block: Block) -> None:
        self.values = {
            name: ca.vertsplit(symbol[where]) if where.stop > where.start else []
            for name, where in block.parts.items()
        }

    def __getitem__(self, name: str) -> list[SX]:
        found: list[SX] = self.values[name]
        return found

    def joined(self) -> SX:
        """All parts stacked to one column."""
        return ca.vertcat(*(item for part in self.values.values() for item in part))


@final
class Factor:
    """P = U diag(d) U', U unit upper triangular, in scaled parameters."""

    def __init__(self, d: list[SX], u: list[SX]) -> None:
        self.d, self.n = list(d), len(d)
        self.u = {(i, j): u[j * (j - 1) // 2 + i] for j in range(self.n) for i in range(j)}

    def packed(self) -> list[SX]:
        """Entries of U over its diagonal, column by column."""
        return [self.u[i, j] for j in range(self.n) for i in range(j)]

    def transposed_times(self, vector: list[SX]) -> list[SX]:
        """U' v."""
        return [
            vector[j] + total([self.u[i, j] * vector[i] for i in range(j)]) for j in range(self.n)
        ]

    def diagonal(self) -> list[SX]:
        """diag(P)."""
        return [
            self.d[i] + total([self.u[i, j] ** 2 * self.d[j] for j in range(i + 1, self.n)])
            for i in range(self.n)
        ]

    def uncorrelated(self) -> list[SX]:
        """1 for each parameter whose row of P is zero beside the diagonal."""
        zero = {pair: value == 0 for pair, value in self.u.items()}
        return [
            every([ca.SX(1), *(item for pair, item in zero.items() if i in pair)])
            for i in range(self.n)
        ]

    def grow(self, growth: SX, which: list[SX], keep: SX) -> None:
        """P := T P T with T = sqrt(growth) where `which` is 1, else 1; without its off-diagonal
        where keep is 0.
        """
        root = ca.sqrt(growth)
        factors = [1.0 + item * (root - 1.0) for item in which]
        inverse = [1.0 + item * (1.0 / root - 1.0) for item in which]
        kept = [keep * item for item in factors]
        for (i, j), value in self.u.items():
            self.u[i, j] = value * (kept[i] * inverse[j])
        self.d = [d * (1.0 + item * (growth - 1.0)) for d, item in zip(self.d, which, strict=True)]

    def add_diagonal(self, weights: list[SX]) -> None:
        """P := P + diag(weights), weights >= 0, one rank-one update (Agee and Turner) for each
        parameter.
        """
        for place, weight in enumerate(weights):
            v: list[SX] = [ca.SX(0)] * place + [ca.SX(1)]
            for j in range(place, 0, -1):
                raised = ca.fmax(self.d[j] + weight * v[j] * v[j], _VARIANCE_LOW)
                gain = weight * v[j] / raised
                for i in range(j):
                    v[i] = v[i] - v[j] * self.u[i, j]
                    self.u[i, j] = self.u[i, j] + gain * v[i]
                weight = weight * (self.d[j] / raised)
                self.d[j] = raised
            self.d[0] = self.d[0] + weight * v[0] * v[0]

    def variance(self, h: list[SX]) -> SX:
        """h' P h."""
        f = self.transposed_times(h)
        return total([d * item * item for d, item in zip(self.d, f, strict=True)])

    def measure(self, h: list[SX], variance: SX) -> tuple[list[SX], SX]:
        """Measurement update by one scalar (Bierman); gives P h and h' P h + variance."""
        f = self.transposed_times(h)
        g = [d * item for d, item in zip(self.d, f, strict=True)]
        gain: list[SX] = []
        before = variance
        for j in range(self.n):
            after = before + f[j] * g[j]
            self.d[j] = self.d[j] * (before / after)
            slope = -f[j] / before
            for i in range(j):
                old = self.u[i, j]
                self.u[i, j] = old + slope * gain[i]
                gain[i] = gain[i] + g[j] * old
            gain.append(g[j])
            before = after
        return gain, before
