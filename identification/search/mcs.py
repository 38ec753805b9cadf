"""Multilevel coordinate search."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from identification.search.types import (
    FloatArray,
    MCSMinimum,
    MCSOptions,
    MCSOutcome,
    MCSProgress,
    MCSResult,
)

__all__ = ["MCSMinimum", "MCSOptions", "MCSOutcome", "MCSProgress", "MCSResult", "mcs"]


def mcs(
    fun: Callable[[FloatArray], Any],
    bounds: Any,
    target: float | None = None,
    max_evaluations: int | None = None,
    stall_sweeps: int | None = None,
    callback: Callable[[MCSProgress], object] | None = None,
    options: MCSOptions | None = None,
) -> MCSResult:
    """Find the global minimum of a function in a box by multilevel coordinate search.

    No derivatives are used. The same call gives the same result; random numbers, from a fixed seed,
    are drawn by `restarts` only.

    Parameters
    ----------
    fun : callable
        The objective, ``fun(x) -> float`` with `x` an array of shape (n,) inside the bounds. `x` is
        a new array at each call. The same point is never asked for twice, so the objective must not
        change during the search. A value that is nan or infinite (of either sign) marks a point as
        unusable: it is counted in ``not_finite``, stands in the search as worse than all finite
        values so far, and is never returned as the best.
    bounds : sequence of (low, high) pairs, shape (n, 2), or `scipy.optimize.Bounds`
        Finite, ``low < high``, each pair at least 1e-9 of its magnitude apart. There is no default:
        the search is global in the box it is given. Tighter bounds cost fewer evaluations; in a box
        of many decades give the coordinate on a logarithmic scale.
    target : float or None, optional
        Stop as soon as the objective is at most this value. Any number except nan; None (default)
        switches the rule off. With a known minimum ``f``, ``f + max(1e-4 * abs(f), 1e-10)`` is a
        usual choice.
    max_evaluations : int or None, optional
        Largest number of calls of `fun`, at least 1. Never exceeded. Default ``250 + 50 * n**2``. A
        larger number lets difficult functions (many local minima, narrow global valley) be searched
        longer.
    stall_sweeps : int or None, optional
        Stop after this many sweeps without a better point. At least 0; 0 switches the rule off and
        leaves the search to the other rules. Default ``3 * n``. Smaller saves evaluations (5 is
        enough for easy problems), larger lowers the risk to stop at a local minimum.
    callback : callable or None, optional
        ``callback(progress)`` with an `MCSProgress`, after the initial evaluations, each local
        search and each sweep. A true return value stops the search.
    options : MCSOptions or None, optional
        Settings that seldom need a change:

        ``start`` : "midpoint" (default), "inner", array of shape (n,), or one list per coordinate
            Where the initial evaluations are made, each list along one coordinate. "midpoint": both
            bounds and the middle. "inner": 1/6, 1/2 and 5/6 of the width, for objectives that are
            useless at the bounds. A point: the bounds and this point, for a known good guess.
            Lists: at least three ascending places each, the middle one is the start; more places
            cost more evaluations and find more structure.
        ``levels`` : int, more than ``n + 2``; default ``5 * n + 10``
            Number of levels of the box tree. A point becomes a candidate for a local search when
            its box reaches the last level. Fewer levels start local searches earlier (more local),
            more levels split finer first (more global).
        ``local_steps`` : int, at least 0; default 50
            Largest number of model steps of one local search. 0 makes no local search: the search
            is then purely global, its accuracy is that of the smallest boxes (raise `levels` to
            sharpen it), and the basket holds the raw candidates.
        ``precision`` : float, ``0 <= precision < 1``; default 2.2e-16
            A local search ends when the gain, predicted or made, falls below `precision` times the
            gain since the initial evaluations. 1e-8 or so saves evaluations where the result is
            polished by other means.
        ``hessian_pattern`` : symmetric matrix of bools, shape (n, n), or None (default: all True)
            False where the mixed second derivative is known to be zero: saves one evaluation per
            False pair and model.
        ``restarts`` : int, at least 0; default 0
            Runs of covariance matrix adaptation after the sweeps have stalled, the first from the
            best point, each with twice the population of the one before, a local search after
            each. For functions of four coordinates or more whose valleys lie across the
            coordinates; give `max_evaluations` too. A search that is not ended by target or limit
            then ends after the last of them.

    Returns
    -------
    MCSResult
        ``x``, ``fun``, ``nfev``, ``nit`` (sweeps), ``basket`` (the distinct local minima, the best
        point first), ``outcome`` (`MCSOutcome`; its value is a sentence), ``success``, ``message``;
        see `MCSResult` for the rest.

    Raises
    ------
    InputError
        Where bounds or options cannot be used, or `fun` does not return one real number.
    Exception
        An exception of `fun` or `callback` passes through unchanged in type; one of `fun` gets a
        note with the number of the evaluation and the point. Return nan instead where a failure
        should only mark a point as unusable.

    Notes
    -----
    The search [1]_ evaluates the objective along one coordinate after the other and splits the box
    at these points. Each box has a level, larger for smaller boxes, and a base point that was
    evaluated. One sweep goes once through all levels and splits the best box of each: large
    unexplored boxes and small promising ones get their turn in the same sweep. The coordinate and
    the place of a split come from parabolas through the box's own history, or, where a coordinate
    was split too seldom, from a ranking of the coordinates. Base points at the last level start a
    local search with a quadratic model in a trust region, unless the objective falls monotonically
    from there to a minimum already in the basket.

    This implementation departs from the paper where that has a known weakness. The trust region of
    a coordinate on a bound is never zero, so that the coordinate can leave the bound later. A local
    search ends only after a model from differences around the point itself, not after the coarse
    first one. A line search over a plateau goes on from the lowest sample. Minima whose local
    search ran out of steps (``converged`` False) do not turn away later candidates until a second
    search has been made from nearby. Model steps that come out as predicted are taken without a
    line search.

    The search is made for two to about ten coordinates and smooth objectives of any number of
    valleys. On kinks it works, but a local search can then use up its steps. Every evaluated point
    is kept: with the boxes around it 1 kB per evaluation, up to 10 kB in long runs.

    The default stopping rules do not prove a minimum to be global; no rule based on samples alone
    does, and ``success`` is True only where `target` was reached. The basket shows the rivals, but
    not every local minimum: a candidate from which the objective falls to a known minimum is not
    followed.

    See Also
    --------
    scipy.optimize.direct : needs no local search, typically more evaluations.
    scipy.optimize.least_squares : to polish the basket where the objective is a sum of squares.

    References
    ----------
    .. [1] W. Huyer and A. Neumaier, "Global optimization by multilevel coordinate search", Journal
       of Global Optimization 14 (1999) 331-355. doi:10.1023/A:1008382309369

    Examples
    --------
    The six-hump camel function has six local minima; two of them, at -1.0316, are global.

    >>> from identification.search.mcs import mcs
    >>> def camel(x):
    ...     a, b = x
    ...     return (4 - 2.1 * a**2 + a**4 / 3) * a**2 + a * b + (4 * b**2 - 4) * b**2
    >>> result = mcs(camel, [(-3, 3), (-2, 2)])
    >>> print(f"{result.fun:.6f} at {abs(result.x[0]):.4f}, {abs(result.x[1]):.4f}")
    -1.031628 at 0.0898, 0.7127
    >>> print(result.outcome)
    No better point was found during the allowed number of sweeps.

    With a known value to reach, the search stops as soon as it is reached:

    >>> result = mcs(camel, [(-3, 3), (-2, 2)], target=-1.0315)
    >>> result.nfev < 60, result.message
    (True, 'The target value was reached.')

    A longer search finds the other global minimum as well; each entry of the basket is a start for
    a polish:

    >>> result = mcs(camel, [(-3, 3), (-2, 2)], max_evaluations=2000, stall_sweeps=0)
    >>> [round(minimum.fun, 4) for minimum in result.basket]
    [-1.0316, -1.0316]
    """
    # the search itself is loaded where it is called: no verb of the package needs it
    from identification.search.problem import make_problem, real_number, whole_number
    from identification.search.search import Search

    problem = make_problem(bounds, options if options is not None else MCSOptions())
    n = len(problem.low)
    search = Search(
        fun,
        problem,
        target=-math.inf if target is None else real_number("target", target),
        max_evaluations=(
            250 + 50 * n * n
            if max_evaluations is None
            else whole_number("max_evaluations", max_evaluations, 1)
        ),
        stall_sweeps=3 * n
        if stall_sweeps is None
        else whole_number("stall_sweeps", stall_sweeps, 0),
        callback=callback,
    )
    return search.run()
