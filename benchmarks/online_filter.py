"""The joint filter: error and cost of a step with parameters free and fixed.

    python -m benchmarks.online_filter

A simulated elastic joint (the TS joint of the thesis with structural damping), the noise of good
encoders and of a torque sensor, start values wrong by 1.3. Printed: the largest error of the key
parameters after 40 s, its size in standard deviations, microseconds of processor time per sample.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final, final

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.faults.plant import DT, plant, reference
from identification.online.filter import JointFilter, Levels
from identification.planning.follow import Follower

__all__ = ["KEY", "Readings", "filter_from", "levels_of", "plant", "recorded"]
FloatArray = npt.NDArray[np.float64]

KEY: Final = (
    "motor_inertia",
    "link_inertia",
    "stiffness",
    "motor_viscous",
    "motor_coulomb",
    "link_viscous",
)
"""Parameters that every motion of the benchmark shows."""
NOISE: Final = (0.02, 2e-6, 1e-3, 6e-6, 1e-3, 0.05)
"""Standard deviations of the six readings, link-referred."""


@final
@dataclass(frozen=True)
class Readings:
    """Readings with noise (n, 6), true states (n, 4), stamps (n,)."""

    time: FloatArray
    rows: FloatArray
    states: FloatArray

    def at(self, samples: npt.NDArray[np.int_]) -> Readings:
        """Some samples; the drive is the mean of what was held up to the next one."""
        sums = np.concatenate([[0.0], np.cumsum(self.rows[:, 0])])
        after = np.append(samples[1:], len(self.rows))
        rows = self.rows[samples].copy()
        rows[:, 0] = (sums[after] - sums[samples]) / (after - samples)
        return Readings(self.time[samples], rows, self.states[samples])

    def every(self, step: int) -> Readings:
        """Each step-th sample."""
        return self.at(np.arange(0, len(self.rows), step))

    def uneven(self, rng: np.random.Generator) -> Readings:
        """Steps of one to three samples at random."""
        samples = np.cumsum(rng.integers(1, 4, size=len(self.rows)))
        return self.at(samples[samples < len(self.rows)])


@cache
def follower() -> Follower:
    """The joint under its controller."""
    return Follower(plant(), DT, substeps=10)


def recorded(seed: int, seconds: float, rest: tuple[float, float] | None = None) -> Readings:
    """Readings along a motion, at rest between two times."""
    path = reference(seed, seconds)
    if rest is not None:
        first, last = (round(t / DT) for t in rest)
        kept = last - first
        # slows down over half a second, so that it stands before the rest begins
        path = np.concatenate([path[:first], np.repeat(path[first : first + 1], kept, axis=0)])
        path[first:, 1:] = 0.0
        more = reference(seed, seconds)[first : first + round(seconds / DT) - last]
        path = np.concatenate([path, more])
    run = follower().run(path)
    clean = np.column_stack([run.drive, run.states, run.torque])
    rows = clean + np.random.default_rng(seed).normal(size=clean.shape) * NOISE
    return Readings(run.time, rows, run.states)


def levels_of(dt: float) -> Levels:
    """The noise of the benchmark; its joint has no disturbance."""
    sensors = (NOISE[1], NOISE[2], NOISE[3], NOISE[4], NOISE[5])
    return Levels(
        sensors, drive=NOISE[0] * DT**0.5 * max(1.0, dt / DT), disturbance=(0.05, 0.05, 0.05)
    )


def filter_from(factor: float, dt: float, seed: int, free: tuple[str, ...] = KEY) -> JointFilter:
    """A filter whose free parameters start at the true values times or over a factor."""
    rng = np.random.default_rng(seed)
    true = dict(zip(plant().parameter_names, plant().value_vector(), strict=True))
    wrong = {n: true[n] * factor ** rng.choice([-1, 1]) for n in free}
    return JointFilter(plant().with_values(wrong), dt, free)


def main() -> None:
    """Print the table."""
    true = dict(zip(plant().parameter_names, plant().value_vector(), strict=True))
    whole = recorded(21, 40.0)
    kinds = {
        "all readings, 1 ms": (whole, (1.0,) * 6, 1e-3),
        "positions and torque, 1 ms": (whole, (1.0, 1.0, 0.0, 1.0, 0.0, 1.0), 1e-3),
        "the same, 2 ms": (whole.every(2), (1.0, 1.0, 0.0, 1.0, 0.0, 1.0), 2e-3),
        "the same, 5 ms": (whole.every(5), (1.0, 1.0, 0.0, 1.0, 0.0, 1.0), 5e-3),
        "the same, 1 to 3 ms": (
            whole.uneven(np.random.default_rng(1)),
            (1.0, 1.0, 0.0, 1.0, 0.0, 1.0),
            2e-3,
        ),
    }
    linear = tuple(n for n in plant().linear_parameters if true[n])
    for names in ((), KEY, linear):
        print(f"{len(names)} free parameters")
        for label, (found, used, dt) in kinds.items():
            joint = filter_from(1.3, dt, 2, names)
            state = joint.start(0.0, found.rows[0], used, levels=levels_of(dt))
            table = np.broadcast_to(np.array(used), (1, *found.rows.shape))
            joint.run([state], found.time[:2], found.rows[:2], table[:, :2])
            begin = time.process_time()
            last = joint.run([state], found.time, found.rows, table, levels=levels_of(dt)).last[0]
            cost = 1e6 * (time.process_time() - begin) / len(found.rows)
            estimate = joint.estimate(replace(last))
            text = ""
            if names:
                off = {n: estimate[n][0] - true[n] for n in KEY}
                worst = max(KEY, key=lambda n: abs(off[n] / true[n]))
                text = (
                    f", worst {worst} {100 * abs(off[worst] / true[worst]):.2f} % "
                    f"({abs(off[worst]) / estimate[worst][1]:.1f} sigma)"
                )
            how = "compiled" if joint.is_compiled else "interpreted"
            print(f"  {label}: {cost:.2f} us per sample, {how}{text}")


if __name__ == "__main__":
    main()
