"""Rank of the sliding information matrix: which parameters and outputs are still excited, in CasADi."""

from __future__ import annotations

from typing import Any

import casadi as ca

from identification._recursive_settings import Layout
from identification._ud_factor import SX, Factor, Parts, every, select, some, total, where

_SHARE_LOW = 1e-10  # regularisation of the information matrix scaled to unit diagonal


def _information_left(layout: Layout, info: list[SX], energy: list[SX], free: list[SX]) -> list[SX]:
    """Information of each parameter that the others cannot explain: 1 / diag(inverse of the matrix)."""
    n = layout.n
    matrix = {(i, j): info[j * (j - 1) // 2 + i] for j in range(n) for i in range(j)}
    matrix |= {(i, i): total([energy[o * n + i] for o in range(layout.m)]) for i in range(n)}
    inverse = [where(every([matrix[i, i] > 0, free[i] > 0]), 1.0 / ca.sqrt(ca.fmax(matrix[i, i], 1e-300)))
               for i in range(n)]
    lower: dict[tuple[int, int], SX] = {}
    for j in range(n):
        left = 1.0 + _SHARE_LOW - total([lower[j, k] ** 2 for k in range(j)])
        lower[j, j] = ca.sqrt(ca.fmax(left, 1e-14))
        for i in range(j + 1, n):
            entry = matrix[j, i] * inverse[i] * inverse[j] - total([lower[i, k] * lower[j, k] for k in range(j)])
            lower[i, j] = entry / lower[j, j]
    squares = [ca.SX(0)] * n
    for j in range(n):  # column j of the inverse of the triangle
        column: dict[int, SX] = {j: 1.0 / lower[j, j]}
        for i in range(j + 1, n):
            column[i] = -total([lower[i, k] * column[k] for k in range(j, i)]) / lower[i, i]
        squares[j] = total([item**2 for item in column.values()])
    return [matrix[i, i] / squares[i] for i in range(n)]


def check_function(layout: Layout, freeze: bool, walking: bool) -> Any:
    """Every few samples: process noise R1, and what the sliding information matrix still carries."""
    symbols = [ca.SX.sym("fast", layout.fast.size), ca.SX.sym("slow", layout.slow.size),
               ca.SX.sym("config", layout.config.size)]
    fast, slow = Parts(symbols[0], layout.fast), Parts(symbols[1], layout.slow)
    config = Parts(symbols[2], layout.config)
    new_fast, new_slow = Parts(symbols[0], layout.fast), Parts(symbols[1], layout.slow)
    if freeze:
        _excitation(layout, fast, slow, config, new_fast, new_slow)
    if walking:
        _walk(layout, fast, config, new_slow["excited"], new_fast)
    new_fast.values.update(since_check=[ca.SX(0)], due=[ca.SX(0)])
    return ca.Function("rls_check", symbols, [new_fast.joined(), new_slow.joined()],
                       ["fast", "slow", "config"], ["fast_next", "slow_next"])


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


def _excitation(layout: Layout, fast: Parts, slow: Parts, config: Parts, new_fast: Parts, new_slow: Parts) -> None:
    """Which parameters and outputs are excited, by the window of the last two blocks."""
    n, m = layout.n, layout.m
    info = [a + b for a, b in zip(fast["info"], slow["info"], strict=True)]
    energy = [a + b for a, b in zip(fast["energy"], slow["energy"], strict=True)]
    block, inside = config["block_length"][0], fast["in_block"][0]
    clear = config["clear_info"][0] * (inside + where(slow["blocks"][0] > 0, block))
    share, free = config["lost_share"][0], config["free"]
    decay = select(some([item > 0 for item in slow["live"]]), config["decay"][0], 1.0)
    left = _information_left(layout, info, energy, free)
    best = [ca.fmax(decay * old, now) for old, now in zip(slow["info_best"], left, strict=True)]
    energy_best = [ca.fmax(decay * old, now) for old, now in zip(slow["energy_best"], energy, strict=True)]
    new_slow.values["excited"] = [ca.logic_or(now >= share * top, now >= clear)
                                  for now, top in zip(left, best, strict=True)]
    live = []
    for o in range(m):
        known = [ca.logic_and(energy_best[o * n + i] > 0, free[i] > 0) for i in range(n)]
        active = [every([known[i], ca.logic_or(energy[o * n + i] >= share * energy_best[o * n + i],
                                              energy[o * n + i] >= clear)]) for i in range(n)]
        live.append(2.0 * total(active) >= total(known))
    full = inside >= block
    new_slow.values.update(
        live=live, info_best=best, energy_best=energy_best, blocks=[slow["blocks"][0] + full],
        info=[select(full, now, old) for now, old in zip(fast["info"], slow["info"], strict=True)],
        energy=[select(full, now, old) for now, old in zip(fast["energy"], slow["energy"], strict=True)])
    keep = ca.logic_not(full)
    new_fast.values.update(
        info=[where(keep, item) for item in fast["info"]], energy=[where(keep, item) for item in fast["energy"]],
        in_block=[where(keep, inside)])
