"""The integrator of ``_sim.c`` in numpy, vectorised over the records: slow, for machines without a
C compiler.

It is also the check on the C code: both follow the same equations and agree to rounding.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tests.hidden_effect._engine import INDEX, SIDE, GeneratorError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

Values = dict[str, "FloatArray"]


def _level(
    p: Values, v: FloatArray, direction: float, fixed: FloatArray, heat: FloatArray
) -> FloatArray:
    extra = p["TS"] * np.exp(-((np.abs(v) / p["VS"]) ** p["DS"]))
    return np.maximum(fixed + heat * p["TC"] + direction * p["TCA"] + extra, 0.0)


def _kick(
    p: Values,
    j: FloatArray,
    v: FloatArray,
    force: FloatArray,
    vm: FloatArray,
    fixed: FloatArray,
    heat: FloatArray,
    z: FloatArray,
    h: float,
) -> tuple[FloatArray, FloatArray]:
    """New velocity and bristle deflection of one body; see ``kick`` in ``_sim.c``."""
    a = np.abs(vm)
    f = force - heat * p["B"] * vm - p["B2"] * vm * a - p["B3"] * vm**3 - p["BA"] * a
    up, down = _level(p, vm, 1.0, fixed, heat), _level(p, vm, -1.0, fixed, heat)
    need = f + j * v / h
    rough = np.where(
        need > up, v + h / j * (f - up), np.where(need < -down, v + h / j * (f + down), 0.0)
    )
    s = np.tanh(vm / np.where(p["V0"] > 0.0, p["V0"], 1.0))
    smooth = v + h / j * (f - np.where(s >= 0.0, up, down) * s)
    distance = np.where(p["ZS"] > 0.0, p["ZS"], 1.0)
    z_new = np.where(p["ZS"] > 0.0, (z + h * vm) / (1.0 + h * a / distance), z)
    zm = 0.5 * (z + z_new) / distance
    bristle = v + h / j * (f - np.where(zm >= 0.0, up, down) * zm)
    return np.where(p["ZS"] > 0.0, bristle, np.where(p["V0"] > 0.0, smooth, rough)), z_new


def _spring(p: Values, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    y = x - np.clip(x, -p["GAP"], p["GAP"])
    contact = np.where((p["GAP"] > 0.0) & (y == 0.0), 0.0, 1.0)
    y = y - p["WIND"] * np.tanh(y / p["WIND_X"])
    a = np.abs(y)
    extra = p["PW_D1"] * np.maximum(a - p["PW_X1"], 0.0) + p["PW_D2"] * np.maximum(
        a - p["PW_X2"], 0.0
    )
    return p["K"] * y + p["K3"] * y**3 + np.sign(y) * extra, contact


def _position_torque(p: Values, own: FloatArray, link: FloatArray) -> FloatArray:
    return np.asarray(p["KA"] * own + p["SIN"] * np.sin(link) + p["COS"] * np.cos(link))


def _snag(rows: Sequence[FloatArray], t: float) -> FloatArray:
    total = np.zeros(len(rows))
    for i, table in enumerate(rows):
        for start, length, torque in table:
            y = (t - start) / length
            if 0.0 < y < 1.0:
                total[i] += torque * np.sin(np.pi * y)
    return total


def _reference(table: FloatArray, t: float, dt: float) -> FloatArray:
    at = t / dt
    k = min(int(at), table.shape[1] - 2)
    return np.asarray(table[:, k] + (at - k) * (table[:, k + 1] - table[:, k]))


def _bulge(table: FloatArray, t: float, dt: float) -> FloatArray:
    """What the cubic through two samples, with slopes from their neighbours, has over the line."""
    at = t / dt
    last = table.shape[1] - 2
    k = min(int(at), last)
    f, rise = at - k, table[:, k + 1] - table[:, k]
    begin = 0.5 * (table[:, k + 1] - table[:, k - 1]) - rise if k > 0 else 0.0 * rise
    end = 0.5 * (table[:, k + 2] - table[:, k]) - rise if k < last else 0.0 * rise
    return np.asarray(f * (1.0 - f) * ((1.0 - f) * begin - f * end))


class _Fleet:
    """State and parameters of all records, one column each."""

    def __init__(self, vectors: Sequence[FloatArray], states: Sequence[FloatArray]) -> None:
        table = np.array(vectors)
        self.p: Values = {name: table[:, i] for name, i in INDEX.items()}
        self.sides: dict[str, Values] = {s: {n: self.p[f"{s}_{n}"] for n in SIDE} for s in "ML"}
        state = np.array(states)
        self.q, self.v, self.th, self.w = (state[:, i].copy() for i in range(4))
        self.x, self.u = self.th.copy(), self.w.copy()
        self.zm, self.zl = np.zeros(len(table)), np.zeros(len(table))
        self.zh = np.zeros((3, len(table)))
        self.stretch = self.q - self.th
        self.j_tip = self.p["JL"] * self.p["FLEX"]
        self.j_link = self.p["JL"] - self.j_tip

    def step(
        self, t: float, h: float, r: FloatArray, dr: FloatArray, snag: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Advance by h; returns current and transmission torque at the midpoint."""
        p, m, li = self.p, self.sides["M"], self.sides["L"]
        heat = 1.0 - p["HEAT"] * (1.0 - np.exp(-max(t, 0.0) / p["HEAT_TAU"]))
        one = np.ones_like(heat)
        qm, tm, xm = (
            self.q + 0.5 * h * self.v,
            self.th + 0.5 * h * self.w,
            self.x + 0.5 * h * self.u,
        )
        error = sum(p[k] * np.sin(p[f"{k}_O"] * p["N"] * qm + p[f"{k}_P"]) for k in ("KE1", "KE2"))
        static, contact = _spring(p, qm - tm + error)
        for i in range(3):
            limit = p[f"HS{i + 1}"]
            self.zh[i] = np.clip(self.zh[i] + (qm - tm) - self.stretch, -limit, limit)
            static = static + p[f"HK{i + 1}"] * self.zh[i]
        self.stretch = qm - tm
        ripple = p["COG"] * np.sin(p["COG_O"] * p["N"] * qm + p["COG_P"])
        on_motor = _position_torque(m, qm, tm) + ripple
        on_link = (
            _position_torque(li, tm, tm)
            + p["STOP"] * np.maximum(tm - p["STOP_X"], 0.0)
            - p["TG"] * np.sin(tm)
        )
        bump = p["BUMP"] / (1.0 + ((tm - p["BUMP_X"]) / p["BUMP_W"]) ** 8)
        rub_m = m["CYC"] * np.sin(tm + m["CYC_P"]) + bump + snag
        rub_l = li["CYC"] * np.sin(tm + li["CYC_P"])
        wf = 2.0 * np.pi * p["FLEX_F"]
        vm, wm, um = self.v, self.w, self.u
        drive = torque = one
        vn, wn, un, zm, zl = self.v, self.w, self.u, self.zm, self.zl
        for _ in range(3):
            drive = p["KP"] * (r - qm) + p["KD"] * (dr - vm)
            torque = static + contact * p["C"] * (vm - wm)
            pull = wf * wf * (xm - tm) + 2.0 * p["FLEX_Z"] * wf * (um - wm)
            un = self.u - h * pull
            vn, zm = _kick(
                m,
                p["JM"],
                self.v,
                p["KM"] * drive - torque - on_motor,
                vm,
                rub_m + m["MU"] * np.abs(torque),
                heat,
                self.zm,
                h,
            )
            wn, zl = _kick(
                li,
                self.j_link,
                self.w,
                torque + self.j_tip * pull - on_link,
                wm,
                rub_l + li["MU"] * np.abs(torque),
                one,
                self.zl,
                h,
            )
            vm, wm, um = 0.5 * (self.v + vn), 0.5 * (self.w + wn), 0.5 * (self.u + un)
        tip = self.j_tip > 0.0
        self.v, self.w, self.zm, self.zl = vn, wn, zm, zl
        self.q, self.th = qm + 0.5 * h * vn, tm + 0.5 * h * wn
        self.u = np.where(tip, un, wn)
        self.x = np.where(tip, xm + 0.5 * h * un, self.th)
        return drive / p["NKM"], torque


def simulate_fleet(
    vectors: Sequence[FloatArray],
    references: Sequence[tuple[FloatArray, FloatArray]],
    states: Sequence[FloatArray],
    snags: Sequence[FloatArray],
    *,
    step: float,
    stride: int,
    before: int,
) -> list[FloatArray]:
    """Same meaning and result as the C integrator; all records must have the same number of
    rows.
    """
    rows = len(references[0][0])
    if any(len(r[0]) != rows for r in references):
        raise GeneratorError("records of different lengths: simulate them in separate calls")
    fleet = _Fleet(vectors, states)
    position, velocity = (np.array([r[i] for r in references]) for i in (0, 1))
    count = len(vectors)
    current, torque = np.empty((0, count)), np.empty((0, count))
    lag_i, lag_t = (fleet.p[k].astype(int) for k in ("LAG_I", "LAG_T"))
    total = before + (rows - 1) * stride + 1
    current, torque = np.zeros((total, count)), np.zeros((total, count))
    out = np.zeros((count, rows, 7))
    for i in range(total):
        start = (i - before) * step
        t = start + 0.5 * step
        k, rest = divmod(i - before, stride)
        if rest == 0 and k >= 0:
            out[:, k, 0] = start
            out[:, k, 2:6] = np.stack([fleet.q, fleet.v, fleet.th, fleet.w], axis=1)
        moving = t > 0.0
        r = _reference(position, t, step * stride) if moving else position[:, 0]
        dr = _reference(velocity, t, step * stride) if moving else np.zeros(count)
        if moving and np.any(fleet.p["CURVE"]):
            r = r + fleet.p["CURVE"] * _bulge(position, t, step * stride)
            dr = dr + fleet.p["CURVE"] * _bulge(velocity, t, step * stride)
        current[i], torque[i] = fleet.step(t, step, r, dr, _snag(snags, t))
    at = before + stride * np.arange(rows)[:, None]
    column = np.arange(count)
    for slot, series, lag in ((1, current, lag_i), (6, torque, lag_t)):
        here = np.maximum(at - lag, 0)
        out[:, :, slot] = 0.5 * (series[here, column] + series[np.maximum(here - 1, 0), column]).T
    if not np.all(np.abs(out[:, :, 2]) < 1e3):
        raise GeneratorError("the joint ran away")
    return list(out)
