"""Rank of the sliding information matrix: which parameters and outputs are still excited, in
CasADi.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from identification.recursive.settings import Layout
from identification.recursive.ud_factor import SX, Factor, Parts, select, total, where

_SHARE_LOW = 1e-10  # regularisation of the information matrix scaled to unit diagonal
_RETURN = 4.0  # times the share at which it was held that lets a parameter move: no flicker


def check_function(layout: Layout, freeze: bool, walking: bool, alike: Sequence[int]) -> Any:
    """Every few samples: process noise R1, and what the sliding information matrix still
    carries. Parameters of one number in `alike` are control values of one curve.
    """
    symbols = [
        ca.SX.sym("fast", layout.fast.size),
        ca.SX.sym("slow", layout.slow.size),
        ca.SX.sym("config", layout.config.size),
    ]
    fast, slow = Parts(symbols[0], layout.fast), Parts(symbols[1], layout.slow)
    config = Parts(symbols[2], layout.config)
    new_fast, new_slow = Parts(symbols[0], layout.fast), Parts(symbols[1], layout.slow)
    _inflation(layout, fast, slow, config, new_fast, new_slow)
    if freeze:
        _excitation(layout, fast, slow, config, new_fast, new_slow=new_slow, alike=alike)
    if walking:
        _walk(layout, fast, config, new_slow["excited"], new_fast)
    new_fast.values.update(since_check=[ca.SX(0)], due=[ca.SX(0)])
    return ca.Function(
        "rls_check",
        symbols,
        [new_fast.joined(), new_slow.joined()],
        ["fast", "slow", "config"],
        ["fast_next", "slow_next"],
    )


def _walk(layout: Layout, fast: Parts, config: Parts, excited: list[SX], new_fast: Parts) -> None:
    """Process noise of the samples since the last check, never past the bound on diag(P)."""
    factor = Factor(fast["d"], fast["u"])
    raised, samples = fast["alarm"][0] > 0, fast["since_check"][0]
    variances = factor.diagonal()
    weights = []
    for i in range(layout.n):
        wanted = samples * select(raised, config["walk_alarm"][i], config["walk"][i])
        room = ca.fmax(0.0, config["limit"][i] - variances[i])
        weights.append(excited[i] * config["free"][i] * ca.fmin(wanted, room))
    factor.add_diagonal(weights)
    new_fast.values.update(d=factor.d, u=factor.packed())


def _inflation(
    layout: Layout, fast: Parts, slow: Parts, config: Parts, new_fast: Parts, new_slow: Parts
) -> None:
    """Variance of a sum of innovations over the sum of their variances: 1 for white noise, more for
    filtered one.

    From differences of neighbouring sums: what the estimate lags behind a slow drift is in both of
    them and is no noise. For the same reason the product of the two comes off the estimate of R2.
    """
    whole, parts, inflation, noises = [], [], [], []
    given = config["inflation"][0]
    for o in range(layout.m):
        enough = fast["squares"][o] > 0
        count = fast["samples"][0] - fast["skipped"][0]
        rate = enough * ca.fmin(
            0.5, fast["since_check"][0] * ca.fmax(config["noise_rate"][0], 1.0 / (200.0 + count))
        )
        apart = fast["sum"][o] - slow["sum_before"][o]
        whole.append(slow["whole"][o] + rate * (0.5 * apart**2 - slow["whole"][o]))
        parts.append(slow["parts"][o] + rate * (fast["squares"][o] - slow["parts"][o]))
        inflation.append(select(given > 0, given, ca.fmax(1.0, whole[o] / ca.fmax(parts[o], 1e-6))))
        lag = fast["sum"][o] * slow["sum_before"][o] / ca.fmax(1.0, fast["since_check"][0]) ** 2
        noises.append(fast["noise"][o] * (1.0 - ca.fmax(-0.5, ca.fmin(rate * lag, 0.5))))
    new_slow.values.update(whole=whole, parts=parts, inflation=inflation, sum_before=fast["sum"])
    zero = [ca.SX(0)] * layout.m
    new_fast.values.update(sum=zero, squares=zero, noise=noises)


def _excitation(
    layout: Layout,
    fast: Parts,
    slow: Parts,
    config: Parts,
    new_fast: Parts,
    new_slow: Parts,
    alike: Sequence[int],
) -> None:
    """Which parameters and outputs are excited; moves the sums since the last check into the
    windows.
    """
    n, m = layout.n, layout.m
    samples = fast["since_check"][0]
    sums, length = _window(
        "energy", [*fast["energy"], *fast["mean"]], samples, slow, config, new_slow
    )
    given = [
        select(config["noise_known"][o], 1.0 / ca.fmax(config["noise_given"][o], 1e-30), 1.0)
        for o in range(m)
    ]
    energy = sums[: m * n]
    # Standstill under load leaves constant regressors: they tell one direction only, known since
    # long.
    swing = [
        ca.fmax(0.0, energy[k] - given[k // n] * sums[m * n + k] ** 2 / length - 1e-12 * energy[k])
        for k in range(m * n)
    ]
    decay = select(total(slow["live"]) > 0, config["decay"][0], 1.0)
    energy_best = [
        ca.fmax(decay * old, now / length)
        for old, now in zip(slow["energy_best"], energy, strict=True)
    ]
    swing_best = [
        ca.fmax(decay * old, now / length)
        for old, now in zip(slow["swing_best"], swing, strict=True)
    ]
    share, free = config["lost_share"][0], config["free"]
    live, moves = [], [ca.SX(0)] * n
    for o in range(m):
        noise = select(config["noise_known"][o], 1.0, fast["noise"][o])
        clear = length * config["clear_info"][0] * noise
        places = range(o * n, o * n + n)
        known = [(swing_best[k] > 0) * free[k - o * n] for k in places]
        swings = [
            known[k - o * n]
            * ca.logic_or(swing[k] >= length * share * swing_best[k], swing[k] >= clear)
            for k in places
        ]
        moves = [
            moves[k - o * n]
            + (energy_best[k] > 0)
            * ca.logic_or(energy[k] >= length * share * energy_best[k], energy[k] >= clear)
            for k in places
        ]
        # a curve swings where any of its control values does
        curves = [[i for i in range(n) if alike[i] == group] for group in dict.fromkeys(alike)]
        swinging, there = (
            total([ca.fmin(1, total([flags[i] for i in curve])) for curve in curves])
            for flags in (swings, known)
        )
        live.append(ca.logic_or(2.0 * swinging > there, there <= 0))
    diagonal = [total([fast["energy"][o * n + i] for o in range(m)]) for i in range(n)]
    # Standstill tells nothing of the rank: then the matrix waits.
    weight = total(live) > 0
    info, span = _window(
        "info",
        [weight * item for item in [*fast["info"], *diagonal]],
        weight * samples,
        slow,
        config,
        new_slow,
    )
    kept, info_best = _rank(layout, info, span, slow, config, decay)
    unseen = [total([energy_best[o * n + i] for o in range(m)]) <= 0 for i in range(n)]
    excited = [ca.logic_or(kept[i] * (moves[i] > 0), unseen[i]) for i in range(n)]
    new_slow.values.update(
        live=live,
        excited=excited,
        kept=kept,
        energy_best=energy_best,
        swing_best=swing_best,
        info_best=info_best,
    )
    zero = [ca.SX(0)]
    new_fast.values.update(
        info=zero * len(fast["info"]), energy=zero * (m * n), mean=zero * (m * n)
    )


def _window(
    name: str, new: list[SX], samples: SX, slow: Parts, config: Parts, new_slow: Parts
) -> tuple[list[SX], SX]:
    """Adds sums to a window of two blocks, moves on where the second is full; the window's sums
    and its length.
    """
    inside, before, full = (
        ("in_block", "length_before", "block_length")
        if name == "energy"
        else ("in_rank", "rank_before", "rank_length")
    )
    block = [a + b for a, b in zip(slow[name], new, strict=True)]
    length = slow[inside][0] + samples
    sums = [a + b for a, b in zip(block, slow[f"{name}_before"], strict=True)]
    moves = length >= config[full][0]
    stays = ca.logic_not(moves)
    new_slow.values[name] = [where(stays, item) for item in block]
    new_slow.values[f"{name}_before"] = [
        select(moves, now, old) for now, old in zip(block, slow[f"{name}_before"], strict=True)
    ]
    new_slow.values[inside] = [where(stays, length)]
    new_slow.values[before] = [select(moves, length, slow[before][0])]
    return sums, ca.fmax(1.0, length + slow[before][0])


def _rank(
    layout: Layout, info: list[SX], span: SX, slow: Parts, config: Parts, decay: SX
) -> tuple[list[SX], list[SX]]:
    """Which parameters the information matrix can tell apart, and the best information so far.

    One parameter leaves per check, the one that has lost most: the others are then judged without
    it. What is left of a parameter beside the kept ones is its Schur complement, from one Cholesky
    factor of the kept ones.
    """
    n = layout.n
    kept = [slow["kept"][i] * config["free"][i] for i in range(n)]
    diagonal = info[n * (n - 1) // 2 :]
    root = [where(item > 0, 1.0 / ca.sqrt(ca.fmax(item, 1e-300))) for item in diagonal]
    scaled = {
        (i, j): info[j * (j - 1) // 2 + i] * root[i] * root[j] for j in range(n) for i in range(j)
    }
    lower: dict[tuple[int, int], SX] = {}
    for j in range(n):
        lower[j, j] = ca.sqrt(
            ca.fmax(1.0 + _SHARE_LOW - total([lower[j, k] ** 2 for k in range(j)]), 1e-14)
        )
        for i in range(j + 1, n):
            entry = kept[i] * kept[j] * scaled[j, i] - total(
                [lower[i, k] * lower[j, k] for k in range(j)]
            )
            lower[i, j] = entry / lower[j, j]
    inside = _inverse_diagonal(n, lower)
    now = []
    for i in range(n):
        column: list[SX] = []
        for j in range(n):
            entry = kept[j] * scaled[min(i, j), max(i, j)] if i != j else ca.SX(0)
            column.append(
                (entry - total([lower[j, k] * column[k] for k in range(j)])) / lower[j, j]
            )
        outside = ca.fmax(0.0, 1.0 - total([item**2 for item in column]))
        now.append(diagonal[i] / span * select(kept[i], 1.0 / inside[i], outside))
    best = [ca.fmax(decay * old, item) for old, item in zip(slow["info_best"], now, strict=True)]
    share = [item / ca.fmax(top, 1e-300) for item, top in zip(now, best, strict=True)]
    lowest = ca.SX(2)
    for i in range(n):
        lowest = ca.fmin(lowest, select(kept[i] * (best[i] > 0), share[i], 2.0))
    limit = config["rank_share"][0]
    after = [
        select(
            kept[i],
            ca.logic_not((share[i] <= lowest) * (share[i] < limit) * (best[i] > 0)),
            config["free"][i] * (share[i] >= _RETURN * limit),
        )
        for i in range(n)
    ]
    # A parameter held by the user counts as kept, so that it moves at once when it is released.
    return [ca.logic_or(after[i], ca.logic_not(config["free"][i])) for i in range(n)], best


def _inverse_diagonal(n: int, lower: dict[tuple[int, int], SX]) -> list[SX]:
    """diag(inverse(L L'))."""
    found = [ca.SX(0)] * n
    for j in range(n):
        column: dict[int, SX] = {j: 1.0 / lower[j, j]}
        for i in range(j + 1, n):
            column[i] = -total([lower[i, k] * column[k] for k in range(j, i)]) / lower[i, i]
        found[j] = total([item**2 for item in column.values()])
    return found
