"""Residuals of the structured rule: what any two measurements must agree on, computed in plain floats.

========  ==========================================================  ======================================
r1        torque reading less spring torque of the positions          torque, motor and link position
r2        link velocity over a window less integral of acceleration   link velocity, torque
r3        link position over a window less integral of velocity       link position, link velocity
r4        motor position over a window less integral of velocity      motor position, motor velocity
r5        motor velocity over a window less integral of acceleration  motor velocity, torque, current
========  ==========================================================  ======================================

r3 and r4 hold no parameter of the plant, so they tell a sensor from a plant change. r1 is the model's position
residual, r2 its velocity residual: a link position from the model is motor position less torsion, a link velocity
is the integral of torque over inertia. Without a torque sensor, r1 is missing and r2, r5 take the spring torque.
"""

from __future__ import annotations

from typing import Final, final

from identification._fault_types import FaultSettings

LINK_PARITY, MOTOR_PARITY, TORSION, LINK_JUMP, MOTOR_JUMP, LINK, MOTOR = (1 << i for i in range(7))
BIT_NAMES: Final = {
    LINK_PARITY: "r3", MOTOR_PARITY: "r4", TORSION: "r1", LINK_JUMP: "r2 at once", MOTOR_JUMP: "r5 at once",
    LINK: "r2", MOTOR: "r5",
}  # fmt: skip
PARITIES: Final = ("r3", "r4", "r2", "r5")
COUNT: Final = 19
"""Four parities at four lags, then r1 itself and its mean over the second and the third lag."""
_RING: Final = 4096
_MASK: Final = _RING - 1
_BITS: Final = (
    LINK_PARITY, LINK_PARITY, LINK_PARITY, LINK_PARITY, MOTOR_PARITY, MOTOR_PARITY, MOTOR_PARITY, MOTOR_PARITY,
    LINK_JUMP, LINK, LINK, LINK, MOTOR_JUMP, MOTOR, MOTOR, MOTOR, TORSION, TORSION, TORSION,
)  # fmt: skip
_ENERGY: Final = ((0, LINK_PARITY), (4, MOTOR_PARITY), (16, TORSION))


@final
class Residuals:
    """Rings, integrals, limits and CUSUMs."""

    def __init__(self, dt: float, settings: FaultSettings, *, has_torque: bool) -> None:
        longest = round(settings.lags[-1] / dt)
        self.lags = [max(1, round(lag / dt)) for lag in settings.lags]
        if longest > _RING - 2:
            self.lags = [min(lag, _RING - 2) for lag in self.lags]
        self.half = 0.5 * dt
        self.mean1, self.mean2 = 1.0 / (self.lags[1] * dt), 1.0 / (self.lags[2] * dt)
        self.drift, self.has_torque = settings.energy_drift, has_torque
        self.limits = [float("inf")] * COUNT
        self.inverse = [0.0] * len(_ENERGY)
        self.energy_limits = [float("inf")] * len(_ENERGY)
        self.clear()

    def clear(self) -> None:
        """Empty the rings."""
        self.rings = [[0.0] * _RING for _ in range(5)]
        self.sums = [0.0] * 5
        self.last = [0.0] * 5
        self.valid = [0] * 5
        self.energy = [0.0] * len(_ENERGY)
        self.values = [0.0] * COUNT
        self.scale = [1.0] * 5

    def invalidate(self, parity: int, sample: int) -> None:
        """Forget the past of a parity: one of its readings has just been exchanged."""
        self.valid[parity] = sample
        self.energy = [0.0] * len(_ENERGY)

    def step(
        self, k: int, positions: tuple[float, float, float, float], rates: tuple[float, float, float, float], torsion: float
    ) -> int:
        """One sample.

        Parameters
        ----------
        k : int
            Sample number.
        positions : tuple
            Link position, motor position, link velocity, motor velocity.
        rates : tuple
            What each of them is the integral of.
        torsion : float
            r1 [N.m].

        Returns
        -------
        int
            Bits of the residuals over their limits.
        """
        half, values, limits, sums, last = self.half, self.values, self.limits, self.sums, self.last
        lag0, lag1, lag2, lag3 = self.lags
        scale = self.scale
        bits, at = 0, 0
        for i in range(4):
            rate = rates[i]
            sums[i] = total = sums[i] + half * (rate + last[i])
            last[i] = rate
            ring = self.rings[i]
            now = positions[i] - total
            ring[k & _MASK] = now
            age = k - self.valid[i]
            if age >= lag3:
                values[at] = a = now - ring[(k - lag0) & _MASK]
                values[at + 1] = b = now - ring[(k - lag1) & _MASK]
                values[at + 2] = c = now - ring[(k - lag2) & _MASK]
                values[at + 3] = d = now - ring[(k - lag3) & _MASK]
                weight = scale[i]
                if not -limits[at] <= a * weight <= limits[at]:
                    bits |= _BITS[at]
                if not (
                    -limits[at + 1] <= b * weight <= limits[at + 1]
                    and -limits[at + 2] <= c * weight <= limits[at + 2]
                    and -limits[at + 3] <= d * weight <= limits[at + 3]
                ):
                    bits |= _BITS[at + 1]
            else:
                for j in range(4):
                    lag = self.lags[j]
                    value = now - ring[(k - lag) & _MASK] if age >= lag else 0.0
                    values[at + j] = value
                    if not -limits[at + j] <= value * scale[i] <= limits[at + j]:
                        bits |= _BITS[at + j]
            at += 4
        if self.has_torque:
            values[16] = torsion
            sums[4] = now = sums[4] + half * (torsion + last[4])
            last[4] = torsion
            ring = self.rings[4]
            ring[k & _MASK] = now
            age = k - self.valid[4]
            values[17] = a = (now - ring[(k - lag1) & _MASK]) * self.mean1 if age >= lag1 else 0.0
            values[18] = b = (now - ring[(k - lag2) & _MASK]) * self.mean2 if age >= lag2 else 0.0
            weight = scale[4]
            if not (
                -limits[16] <= torsion * weight <= limits[16]
                and -limits[17] <= a * weight <= limits[17]
                and -limits[18] <= b * weight <= limits[18]
            ):
                bits |= TORSION
        energy, inverse = self.energy, self.inverse
        for i, (at, bit) in enumerate(_ENERGY):
            grown = energy[i] + values[at] * values[at] * inverse[i] - self.drift
            if grown <= 0.0:
                energy[i] = 0.0
            else:
                energy[i] = min(grown, 1e9)
                if grown > self.energy_limits[i]:
                    bits |= bit
                    energy[i] = 0.5 * self.energy_limits[i]
        return bits

    def numbers(self, k: int) -> list[float]:
        """Everything that changes, as floats; only the part of the rings that is still used."""
        longest = self.lags[-1] + 1
        out: list[float] = []
        for ring in self.rings:
            out.extend(ring[(k - j) & _MASK] for j in range(longest))
        return [*out, *self.sums, *self.last, *map(float, self.valid), *self.energy, *self.values, *self.scale]

    def load(self, k: int, numbers: list[float]) -> None:
        """Take up what :meth:`numbers` gave."""
        longest = self.lags[-1] + 1
        at = 0
        for ring in self.rings:
            for j in range(longest):
                ring[(k - j) & _MASK] = numbers[at + j]
            at += longest

        def take(count: int) -> list[float]:
            nonlocal at
            found = numbers[at : at + count]
            at += count
            return found

        self.sums, self.last = take(5), take(5)
        self.valid = [int(v) for v in take(5)]
        self.energy, self.values, self.scale = take(len(_ENERGY)), take(COUNT), take(5)


ENERGY_RESIDUALS: Final = tuple(at for at, _ in _ENERGY)
