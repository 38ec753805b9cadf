"""Small dense numerics of the coordinate search: parabolas, real roots, a quadratic over a box.

Everything works on plain Python floats and lists: with two to ten unknowns a numpy call costs more
than the arithmetic.
"""

from __future__ import annotations

import math

import numpy as np

Vector = list[float]
Matrix = list[list[float]]

EPS = 2.220446049250313e-16
"""Spacing of floating-point numbers at one."""

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""The larger part of a golden section."""


ORDERS = 1000.0
"""Factor that counts as orders of magnitude (W. Huyer, A. Neumaier 1999, subint)."""


def magnitude_limit(x: float, y: float) -> float:
    """Return the point on the way from `x` to `y` that is not orders of magnitude away from `x`."""
    if ORDERS * abs(x) < 1.0:
        return math.copysign(1.0, y) if abs(y) > ORDERS else y
    return math.copysign(10.0 * abs(x), y) if abs(y) > ORDERS * abs(x) else y


def slope_and_curvature(
    p0: float, f0: float, p1: float, f1: float, p2: float, f2: float
) -> tuple[float, float]:
    """Return first and second derivative at `p0` of the parabola through three distinct samples."""
    f01 = (f1 - f0) / (p1 - p0)
    f02 = (f2 - f0) / (p2 - p0)
    f12 = (f2 - f1) / (p2 - p1)
    return f01 + f02 - f12, 2.0 * (f02 - f12) / (p0 - p1)


def parabola_minimum(
    slope: float, curvature: float, low: float, high: float
) -> tuple[float, float]:
    """Minimise ``slope t + curvature t**2 / 2`` over ``[low, high]``; return the place and the
    value.
    """
    value_low = low * (slope + 0.5 * curvature * low)
    value_high = high * (slope + 0.5 * curvature * high)
    place, value = (low, value_low) if value_low <= value_high else (high, value_high)
    if curvature > 0.0:
        t = -slope / curvature
        if min(low, high) < t < max(low, high):
            inside = 0.5 * slope * t
            if inside < value:
                return t, inside
    return place, value


def divided_differences(points: Vector, values: Vector) -> Vector:
    """Return the Newton coefficients of the polynomial through the samples."""
    table = list(values)
    count = len(points)
    for order in range(1, count):
        for j in range(count - 1, order - 1, -1):
            table[j] = (table[j] - table[j - 1]) / (points[j] - points[j - order])
    return table


def newton_to_power(points: Vector, coefficients: Vector) -> Vector:
    """Convert Newton coefficients to power coefficients, the constant first."""
    power = [coefficients[-1]]
    for j in range(len(coefficients) - 2, -1, -1):
        shifted = [0.0, *power]
        for k, c in enumerate(power):
            shifted[k] -= points[j] * c
        shifted[0] += coefficients[j]
        power = shifted
    return power


def cubic_roots(c0: float, c1: float, c2: float, c3: float) -> Vector:
    """Return the distinct real roots of ``c0 + c1 t + c2 t**2 + c3 t**3``, ascending."""
    largest = max(abs(c0), abs(c1), abs(c2), abs(c3))
    if not math.isfinite(largest) or largest == 0.0:
        return []
    if abs(c3) < 1e-14 * largest:
        return quadratic_roots(c0, c1, c2)
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    shift = a / 3.0
    p = b - a * shift
    q = c + shift * (2.0 * shift * shift - b)
    if not math.isfinite(p * p * p) or not math.isfinite(q * q):
        return []
    disc = 0.25 * q * q + p * p * p / 27.0
    if disc > 0.0:
        big = -0.5 * q - math.copysign(math.sqrt(disc), q)
        u = math.copysign(abs(big) ** (1.0 / 3.0), big)
        return [u - (p / (3.0 * u) if u != 0.0 else 0.0) - shift]
    radius = 2.0 * math.sqrt(max(-p / 3.0, 0.0))
    if radius * abs(p) == 0.0:
        return [-shift]
    phase = math.acos(max(-1.0, min(1.0, 3.0 * q / (p * radius)))) / 3.0
    return sorted(radius * math.cos(phase - 2.0 * math.pi * k / 3.0) - shift for k in range(3))


def quadratic_roots(c0: float, c1: float, c2: float) -> Vector:
    """Return the real roots of ``c0 + c1 t + c2 t**2``, ascending."""
    if c2 == 0.0:
        return [-c0 / c1] if c1 != 0.0 else []
    disc = c1 * c1 - 4.0 * c2 * c0
    if not disc >= 0.0:
        return []
    t = -0.5 * (c1 + math.copysign(math.sqrt(disc), c1))
    return sorted({t / c2, c0 / t}) if t != 0.0 else [0.0]


def _cholesky_solve(matrix: Matrix, right: Vector) -> Vector | None:
    """Solve a symmetric positive definite system; None where the matrix is not clearly positive
    definite.
    """
    n = len(right)
    low: Matrix = []
    y: Vector = []
    for i in range(n):
        row: Vector = []
        source = matrix[i]
        for j in range(i):
            other = low[j]
            total = source[j]
            for k in range(j):
                total -= row[k] * other[k]
            row.append(total / other[j])
        pivot = source[i] - sum(r * r for r in row)
        if not pivot > 1e-14 * abs(source[i]):
            return None
        root = math.sqrt(pivot)
        y.append((right[i] - sum(r * v for r, v in zip(row, y, strict=True))) / root)
        row.append(root)
        low.append(row)
    for i in range(n - 1, -1, -1):
        total = y[i]
        for k in range(i + 1, n):
            total -= low[k][i] * y[k]
        y[i] = total / low[i][i]
    return y


def _coordinate_passes(h: Vector, grad: Vector, hessian: Matrix, low: Vector, high: Vector) -> None:
    """Minimise along one coordinate after the other until the set of active bounds settles (in
    place).
    """
    n = len(h)
    for _ in range(n + 3):
        changed = False
        for i in range(n):
            lo, hi, now = low[i], high[i], h[i]
            if hi <= lo:
                continue
            g, c = grad[i], hessian[i][i]
            if g == 0.0 and c >= 0.0:
                continue
            place, value = parabola_minimum(g, c, lo - now, hi - now)
            if not value < 0.0:
                continue
            new = min(max(now + place, lo), hi)
            changed = (
                changed
                or (new in (lo, hi)) != (now in (lo, hi))
                or (new != now and new in (lo, hi))
            )
            step = new - now
            h[i] = new
            row = hessian[i]
            for k in range(n):
                grad[k] += row[k] * step
        if not changed:
            return


def _free_direction(free: list[int], grad: Vector, hessian: Matrix) -> Vector:
    """Newton direction on the free coordinates, or the direction of most negative curvature."""
    block = [[hessian[i][k] for k in free] for i in free]
    newton = _cholesky_solve(block, [-grad[i] for i in free])
    if newton is not None:
        return newton
    try:
        values, vectors = np.linalg.eigh(np.array(block))
    except np.linalg.LinAlgError:
        return [-grad[i] for i in free]
    direction: Vector = vectors[:, int(np.argmin(values))].tolist()
    uphill = sum(grad[i] * c for i, c in zip(free, direction, strict=True)) > 0.0
    return [-c for c in direction] if uphill else direction


def minimise_quadratic(gradient: Vector, hessian: Matrix, low: Vector, high: Vector) -> Vector:
    """Find a local minimiser of ``g h + h G h / 2`` over a box that contains the origin.

    Parameters
    ----------
    gradient, hessian : lists, shapes (n,) and (n, n)
        The model; the matrix is symmetric and may be indefinite.
    low, high : lists, shape (n,)
        The box, ``low <= 0 <= high``.

    Returns
    -------
    list, shape (n,)
        A point of the box that is not worse than the origin.
    """
    n = len(gradient)
    h = [0.0] * n
    grad = list(gradient)
    if not all(map(math.isfinite, gradient)) or not all(
        all(map(math.isfinite, row)) for row in hessian
    ):
        return h
    for _ in range(3 * n + 3):
        _coordinate_passes(h, grad, hessian, low, high)
        free = [i for i in range(n) if low[i] < h[i] < high[i]]
        if not free:
            break
        direction = _free_direction(free, grad, hessian)
        reach = math.inf
        for i, c in zip(free, direction, strict=True):
            if c > 0.0:
                reach = min(reach, (high[i] - h[i]) / c)
            elif c < 0.0:
                reach = min(reach, (low[i] - h[i]) / c)
        if not 0.0 < reach < math.inf:
            break
        full = [0.0] * n
        for i, c in zip(free, direction, strict=True):
            full[i] = c
        image = [sum(a * c for a, c in zip(row, full, strict=True)) for row in hessian]
        slope = sum(a * c for a, c in zip(grad, full, strict=True))
        curvature = sum(a * c for a, c in zip(image, full, strict=True))
        length = min(-slope / curvature, reach) if curvature > 0.0 else reach
        change = length * (slope + 0.5 * curvature * length)
        scale = sum(abs(a * c) for a, c in zip(gradient, h, strict=True))
        if not change < -1e-14 * scale:
            break
        for i in free:
            h[i] = min(max(h[i] + length * full[i], low[i]), high[i])
        for i in range(n):
            grad[i] += length * image[i]
    return h
