"""Residuals of the structured rule: what any two measurements must agree on, one CasADi call per
sample.

========  ==========================================================
====================================== r1        torque reading less spring torque of the positions
torque, motor and link position r2        link velocity over a window less integral of acceleration
link velocity, torque r3        link position over a window less integral of velocity       link
position, link velocity r4        motor position over a window less integral of velocity      motor
position, motor velocity r5        motor velocity over a window less integral of acceleration  motor
velocity, torque, current ========  ==========================================================
======================================

r3 and r4 hold no parameter of the plant, so they tell a sensor from a plant change. r1 is the
model's position residual, r2 its velocity residual: a link position from the model is motor
position less torsion, a link velocity is the integral of torque over inertia. Without a torque
sensor, r1 is missing and r2, r5 take the spring torque.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from functools import partial
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.faults.core import (
    CURRENT,
    LINK_POSITION,
    LINK_VELOCITY,
    MOTOR_POSITION,
    MOTOR_VELOCITY,
    TORQUE,
    ObserverCore,
)
from identification.faults.types import FaultSettings
from identification.recursive.compiler import NoCompilerError, build

FloatArray = npt.NDArray[np.float64]

LINK_PARITY, MOTOR_PARITY, TORSION, LINK_JUMP, MOTOR_JUMP, LINK, MOTOR = (1 << i for i in range(7))
BIT_NAMES: Final = {
    LINK_PARITY: "r3",
    MOTOR_PARITY: "r4",
    TORSION: "r1",
    LINK_JUMP: "r2 at once",
    MOTOR_JUMP: "r5 at once",
    LINK: "r2",
    MOTOR: "r5",
}
PARITIES: Final = ("r3", "r4", "r2", "r5")
COUNT: Final = 19
"""Four parities at four lags, then r1 itself and its mean over the second and the third lag."""
_RING: Final = 4096
_MASK: Final = _RING - 1
_BITS: Final = (
    LINK_PARITY,
    LINK_PARITY,
    LINK_PARITY,
    LINK_PARITY,
    MOTOR_PARITY,
    MOTOR_PARITY,
    MOTOR_PARITY,
    MOTOR_PARITY,
    LINK_JUMP,
    LINK,
    LINK,
    LINK,
    MOTOR_JUMP,
    MOTOR,
    MOTOR,
    MOTOR,
    TORSION,
    TORSION,
    TORSION,
)
_ENERGY: Final = ((0, LINK_PARITY), (4, MOTOR_PARITY), (16, TORSION))
ENERGY_RESIDUALS: Final = tuple(at for at, _ in _ENERGY)
_SUMS, _LAST, _CUSUM = slice(0, 5), slice(5, 10), slice(10, 13)
_SCALE, _LIMITS, _INVERSE, _MOST = slice(0, 5), slice(5, 5 + COUNT), slice(24, 27), slice(27, 30)
_NEVER: Final = 1 << 62
ENERGY_LEFT: Final = 0.5
ENERGY_TOP: Final = 1e9
"""What is left of an energy over its limit once it has been told, as a share of the limit; the most
that one grows to."""
PARITY_SENSORS: Final = (
    (LINK_POSITION, LINK_VELOCITY),
    (MOTOR_POSITION, MOTOR_VELOCITY),
    (LINK_VELOCITY, TORQUE),
    (MOTOR_VELOCITY, TORQUE, CURRENT),
    (TORQUE, MOTOR_POSITION, LINK_POSITION),
)
"""Sensors that the four parities and r1 hold."""
_ENTRY: Final = """
#ifdef _WIN32
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
void fault_sample(const double **arg, double **res, long long int *iw, double *w) {
    watched(arg, res, iw, w, 0);
}
"""


@final
class Residuals:
    """Observer, rings, integrals, limits and CUSUMs of a sample in one compiled call.

    Parameters
    ----------
    core : ObserverCore
        Its state, gain and gates are those of the call.
    settings : FaultSettings

    Attributes
    ----------
    valid : list of int
        Sample from which on the past of each parity counts.
    scale : (5,) array
        Factor on each residual before it is compared with its limits.
    """

    def __init__(self, core: ObserverCore, settings: FaultSettings) -> None:
        dt = core.dt
        self.core = core
        self.lags = [min(max(1, round(lag / dt)), _RING - 2) for lag in settings.lags]
        self.half = 0.5 * dt
        self.mean1, self.mean2 = 1.0 / (self.lags[1] * dt), 1.0 / (self.lags[2] * dt)
        self.drift, self.has_torque = settings.energy_drift, core.has_torque
        self.judged, self._memory, self._weights = np.full(5, np.inf), np.zeros(13), np.zeros(30)
        self._past, self._old, self._ring = np.zeros(20), np.zeros(20), np.zeros(5 * _RING)
        self.scale = self._weights[_SCALE]
        self._found, self._following, self._remembered = (
            np.zeros(9),
            np.zeros(core.size),
            np.zeros(13),
        )
        self._now, self._values, self._shares = np.zeros(5), np.zeros(COUNT), np.zeros(6)
        self._connect()
        self.limits, self.inverse, self.energy_limits = [np.inf] * COUNT, [0.0] * 3, [np.inf] * 3
        self.clear()

    def _function(self) -> Any:
        """Observer and residuals as one function; the arithmetic in the order of
        :mod:`irj_fmu`'s native twin.
        """
        import casadi as ca

        core = self.core
        n = core.size
        given = [
            ca.SX.sym(name, *core.function.size_in(i))
            for i, name in enumerate(("x", "y", "used", "gain", "gate"))
        ]
        judged, memory, weights = (
            ca.SX.sym("judged", 5),
            ca.SX.sym("memory", 13),
            ca.SX.sym("weights", 30),
        )
        past, old = ca.SX.sym("past", 5, 4), ca.SX.sym("old", 5, 4)
        out = core.function(*given)
        _, qm, vm, ql, vl, torque = ca.vertsplit(out[n : n + 6])
        motor, link, sprung = ca.vertsplit(out[n + 11 : n + 14])
        rates = ca.vertcat(vl, vm, link, motor, torque - sprung if self.has_torque else 0)
        sums = memory[_SUMS] + self.half * (rates + memory[_LAST])
        now = ca.vertcat(ca.vertcat(ql, qm, vl, vm) - sums[:4], sums[4])
        gone = [ca.if_else(old[:, j], now - past[:, j], 0) for j in range(4)]
        values = ca.vertcat(
            *(gone[j][i] for i in range(4) for j in range(4)),
            rates[4],
            gone[1][4] * self.mean1,
            gone[2][4] * self.mean2,
        )
        scale, limits = weights[_SCALE], weights[_LIMITS]
        over: dict[int, Any] = {}

        def note(bit: int, flag: Any) -> None:
            over[bit] = ca.logic_or(over[bit], flag) if bit in over else flag

        for at in range(COUNT if self.has_torque else 16):
            note(_BITS[at], _outside(values[at] * scale[min(at // 4, 4)], limits[at]))
        energies = []
        for i, (at, bit) in enumerate(_ENERGY):
            grown = memory[_CUSUM][i] + values[at] * values[at] * weights[_INVERSE][i] - self.drift
            most = weights[_MOST][i]
            passed = ca.logic_and(grown > 0, grown > most)
            energies.append(
                ca.if_else(passed, ENERGY_LEFT * most, ca.fmax(0, ca.fmin(grown, ENERGY_TOP)))
            )
            note(bit, passed)
        innovation = out[n + 6 : n + 11]
        locked = _any([_outside(innovation[i], judged[i]) for i in range(5)])
        bits = sum(bit * flag for bit, flag in over.items())
        head = ca.vertcat(out[n : n + 6], bits, locked, ca.sum1(out))
        results = [
            head,
            out[:n],
            ca.vertcat(sums, rates, *energies),
            now,
            values,
            _shares(values, limits),
            out,
        ]
        return ca.Function(
            "watched",
            [*given, judged, memory, weights, past, old],
            ca.cse([ca.densify(r) for r in results]),
        )

    def _connect(self) -> None:
        """Tie the function to its arrays, once: a call then copies nothing."""
        core = self.core
        self._whole = self._function()
        self._given = (
            core.state,
            core.readings,
            core.used,
            core.gain,
            core.gate,
            self.judged,
            self._memory,
            self._weights,
            self._past,
            self._old,
        )
        self._results = (
            self._found,
            self._following,
            self._remembered,
            self._now,
            self._values,
            self._shares,
            core.out,
        )
        self._buffer, self._trigger = self._whole.buffer()
        for i, item in enumerate(self._given):
            self._buffer.set_arg(i, item.data)
        for i, item in enumerate(self._results):
            self._buffer.set_res(i, item.data)
        self._moves = (
            (core.state.data, self._following.data),
            (self._memory.data, self._remembered.data),
        )
        self._views = self._past.data, self._ring.data, self._now.data
        self._pack = partial(struct.Struct("6d").pack_into, core.readings.data, 0)
        self._unpack = partial(struct.Struct("9d").unpack_from, self._found.data)

    def compile(self) -> str:
        """Load the call in compiled form, building it where needed; gives the reason where there is
        none.

        The numbers are the same without.
        """
        import casadi as ca

        whole = self._whole
        generator = ca.CodeGenerator("fault", {"with_header": False, "casadi_int": "long long int"})
        generator.add(whole)
        try:
            made = build(str(generator.dump()) + _ENTRY, "fault").fault_sample
        except NoCompilerError as error:
            return str(error)
        made.restype, made.argtypes = None, [ctypes.c_void_p] * 4
        sizes = (whole.sz_arg(), whole.sz_res())
        arg, res = (
            (ctypes.c_void_p * size)(*(a.ctypes.data for a in arrays))
            for size, arrays in zip(sizes, (self._given, self._results), strict=True)
        )
        self._room = (
            arg,
            res,
            np.zeros(1 + whole.sz_iw(), dtype=np.int64),
            np.zeros(1 + whole.sz_w()),
        )
        places = (
            ctypes.addressof(arg),
            ctypes.addressof(res),
            self._room[2].ctypes.data,
            self._room[3].ctypes.data,
        )
        self._trigger = partial(made, *map(ctypes.c_void_p, places))
        return ""

    def clear(self) -> None:
        """Empty the rings."""
        for array in (self._ring, self._memory, self._values, self._shares):
            array[:] = 0.0
        self.valid = [0] * 5
        self.scale[:] = 1.0
        self._change = -1

    def invalidate(self, parity: int, sample: int) -> None:
        """Forget the past of a parity: one of its readings has just been exchanged."""
        self.valid[parity] = sample
        self._memory[_CUSUM] = 0.0
        self._change = -1

    def step(self, k: int, reading: list[float]) -> tuple[float, ...]:
        """One sample; observer, integrals and rings move on where the result is finite.

        Parameters
        ----------
        k : int
            Sample number.
        reading : list of float
            Six finite readings.

        Returns
        -------
        tuple
            The six readings, failed ones replaced; bits of the residuals over their limits; 1 where
            an innovation in use lies beyond its gate; a sum that is finite where all is.
        """
        past, ring, now = self._views
        if k >= self._change:
            self._age(k)
        a, b, c, d = self.lags
        a, b, c, d = (
            5 * ((k - a) & _MASK),
            5 * ((k - b) & _MASK),
            5 * ((k - c) & _MASK),
            5 * ((k - d) & _MASK),
        )
        past[0:5], past[5:10], past[10:15], past[15:20] = (
            ring[a : a + 5],
            ring[b : b + 5],
            ring[c : c + 5],
            ring[d : d + 5],
        )
        self._pack(*reading)
        self._trigger()
        found = self._unpack()
        total = found[8]
        if total - total == 0.0:
            a = 5 * (k & _MASK)
            ring[a : a + 5] = now
            (state, following), (memory, remembered) = self._moves
            state[:], memory[:] = following, remembered
        return found

    def _age(self, k: int) -> None:
        """Note which parities are old enough for which lag, and when that changes next."""
        due = [valid + lag for lag in self.lags for valid in self.valid]
        self._old[:] = [float(k >= sample) for sample in due]
        self._change = min((sample for sample in due if sample > k), default=_NEVER)

    # --- numbers ----------------------------------------------------------------------------------

    @property
    def values(self) -> list[float]:
        """The residuals of the last sample."""
        found: list[float] = self._values.tolist()
        return found

    @property
    def shares(self) -> list[float]:
        """For each sensor, the largest residual of the last sample that holds it, over its
        limit.
        """
        found: list[float] = self._shares.tolist()
        return found

    @property
    def torsion(self) -> float:
        """Size of r1 over its limit."""
        return abs(float(self._values[16])) / float(self._weights[_LIMITS.start + 16])

    @property
    def sums(self) -> list[float]:
        """Integrals of the rates, and of r1."""
        found: list[float] = self._memory[_SUMS].tolist()
        return found

    @property
    def limits(self) -> list[float]:
        """Largest size of each residual that passes."""
        found: list[float] = self._weights[_LIMITS].tolist()
        return found

    @limits.setter
    def limits(self, values: Sequence[float]) -> None:
        """Limit of each residual."""
        self._weights[_LIMITS] = values

    @property
    def inverse(self) -> list[float]:
        """Inverse mean squares of the residuals with a CUSUM."""
        found: list[float] = self._weights[_INVERSE].tolist()
        return found

    @inverse.setter
    def inverse(self, values: Sequence[float]) -> None:
        """One over the mean square of each residual that is summed up as energy."""
        self._weights[_INVERSE] = values

    @property
    def energy_limits(self) -> list[float]:
        """Largest CUSUM that passes."""
        found: list[float] = self._weights[_MOST].tolist()
        return found

    @energy_limits.setter
    def energy_limits(self, values: Sequence[float]) -> None:
        """Limit of the CUSUM of each energy."""
        self._weights[_MOST] = values

    def numbers(self, k: int) -> list[float]:
        """Everything that changes, as floats; only the part of the rings that is still used."""
        rows = (k - np.arange(self.lags[-1] + 1)) & _MASK
        rings = self._ring.reshape(_RING, 5)[rows].T.ravel()
        memory = self._memory.tolist()
        return [
            *rings.tolist(),
            *memory[:10],
            *map(float, self.valid),
            *memory[10:],
            *self.values,
            *self.scale.tolist(),
        ]

    def load(self, k: int, numbers: list[float]) -> None:
        """Take up what :meth:`numbers` gave."""
        longest = self.lags[-1] + 1
        rows = (k - np.arange(longest)) & _MASK
        self._ring.reshape(_RING, 5)[rows] = np.reshape(numbers[: 5 * longest], (5, longest)).T
        rest = numbers[5 * longest :]
        self._memory[:] = [*rest[:10], *rest[15:18]]
        self.valid = [int(v) for v in rest[10:15]]
        self._values[:], self.scale[:] = rest[18 : 18 + COUNT], rest[18 + COUNT :]
        self._change = -1


def _outside(value: Any, limit: Any) -> Any:
    """1 where a value is not between minus and plus its limit; NaN is outside."""
    import casadi as ca

    return ca.logic_not(ca.logic_and(-limit <= value, value <= limit))


def _any(flags: Sequence[Any]) -> Any:
    import casadi as ca

    found = flags[0]
    for flag in flags[1:]:
        found = ca.logic_or(found, flag)
    return found


def _shares(values: Any, limits: Any) -> Any:
    """For each sensor, the largest residual that holds it, over its limit."""
    import casadi as ca

    over = [ca.if_else(limits[i] > 0, ca.fabs(values[i]) / limits[i], 0) for i in range(COUNT)]
    parts = [slice(4 * i, 4 * i + 4 if i < 4 else COUNT) for i in range(5)]
    worst = [ca.mmax(ca.vertcat(*over[part])) for part in parts]
    return ca.vertcat(
        *(
            ca.mmax(
                ca.vertcat(*(w for w, held in zip(worst, PARITY_SENSORS, strict=True) if s in held))
            )
            for s in range(6)
        )
    )
