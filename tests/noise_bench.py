"""What the kind of the sensors' noise does to an answer: a table over kinds, with nothing hidden
and with hidden effects.

``python -m tests.noise_bench --effects 11 --seeds 2``
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification import Joint, Record, improve
from tests.hidden_effect.generator import COLUMNS, DT, KM, NOISE, QUANTUM, Case, simulate_case

FloatArray = npt.NDArray[np.float64]

EFFECTS: Final = (
    *("stribeck", "asymmetric_coulomb", "asymmetric_viscous", "load_dependent_friction"),
    *("cyclic_torque", "added_spring", "torque_ripple", "hysteresis"),
    *("cubic_stiffness", "backlash", "kinematic_error"),
)
"""Effects of every balance; those of the sensors' own gains and offsets are not among them."""
TUNED, FRESH = 9700, 31_400
"""First seeds of the joints that the noise model was made on, and of those it never saw."""
CHANNELS: Final = {
    "motor_current": "motor_current_A",
    "motor_position": "motor_position_rad",
    "link_position": "link_position_rad",
    "link_torque": "link_torque_Nm",
}
DITHER: Final = {"motor_position_rad": 0.5, "link_position_rad": 0.25}
"""Noise of an encoder before it is rounded, in its steps."""
ANALOG: Final = ("motor_current_A", "link_torque_Nm")
LOUD: Final = 20.0
"""Deviation of current and torque in those of the generator: as much as the encoders leave in the
balances, so that the kind of every channel's noise counts.
"""
STEP: Final = 4.0
"""Step of a coarse converter, in deviations of the noise that the same channel has else."""


def white(rng: np.random.Generator, rows: int) -> FloatArray:
    """White noise; like all of these of unit deviation, shape (rows,)."""
    return np.asarray(rng.standard_normal(rows))


def filtered(corner: float) -> Callable[[np.random.Generator, int], FloatArray]:
    """White noise through a first-order low-pass with this corner [Hz]."""

    def noise(rng: np.random.Generator, rows: int) -> FloatArray:
        from scipy.signal import lfilter

        pole = float(np.exp(-2 * np.pi * corner * DT))
        warm = rng.standard_normal(rows + 1000)
        return np.asarray(lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], warm)[1000:])

    return noise


def hum(rng: np.random.Generator, rows: int) -> FloatArray:
    """Half of the power is a line of the mains."""
    line = np.sin(2 * np.pi * 50.0 * np.arange(rows) * DT + rng.uniform(0, 2 * np.pi))
    return np.asarray(np.sqrt(0.5) * rng.standard_normal(rows) + line)


def heavy(rng: np.random.Generator, rows: int) -> FloatArray:
    """Student's t of three degrees."""
    return np.asarray(rng.standard_t(3.0, rows) / np.sqrt(3.0))


def drift(rng: np.random.Generator, rows: int) -> FloatArray:
    """White noise on a walk of the same deviation over the record."""
    walk = np.cumsum(rng.standard_normal(rows))
    walk -= walk.mean()
    return np.asarray(np.sqrt(0.5) * (rng.standard_normal(rows) + walk / walk.std()))


def outliers(rng: np.random.Generator, rows: int) -> FloatArray:
    """White noise; one sample in two hundred is off by ten to thirty deviations."""
    noise = rng.standard_normal(rows)
    hit = rng.random(rows) < 0.005
    size = rng.uniform(10, 30, rows) * rng.choice([-1.0, 1.0], rows)
    return np.asarray(noise + hit * size)


@final
@dataclass(frozen=True)
class Kind:
    """Noise of a set of sensors.

    Attributes
    ----------
    noise : callable
        Of unit deviation.
    everywhere : bool
        On the encoders too, else on current and torque alone.
    step : float
        Step to which current and torque are rounded, in deviations; 0 for none.
    """

    noise: Callable[[np.random.Generator, int], FloatArray]
    everywhere: bool = False
    step: float = 0.0


KINDS: Final[Mapping[str, Kind]] = {
    "white": Kind(white),
    "filtered": Kind(filtered(0.1 / DT), everywhere=True),
    "slow filter": Kind(filtered(8.0), everywhere=True),
    "hum": Kind(hum),
    "heavy": Kind(heavy, everywhere=True),
    "quantised": Kind(white, step=STEP),
    "drift": Kind(drift),
    "outliers": Kind(outliers),
}
"""Filtered: at a tenth of the sample rate, and at 8 Hz (a pole of 0.9 at 500 Hz)."""


def sensed(case: Case, kind: Kind, seed: int) -> dict[str, Record]:
    """Records of a case through sensors with this noise."""
    out = {}
    for number, (name, table) in enumerate(case.exact.items()):
        rng = np.random.default_rng([seed, number])
        channels = {}
        for channel, column in CHANNELS.items():
            x = table[:, COLUMNS.index(column)]
            make = kind.noise if kind.everywhere or column in ANALOG else white
            if column in ANALOG:
                level = LOUD * NOISE[column]
                x = x + level * make(rng, len(x))
                step = kind.step * level
            else:
                step = QUANTUM[column]
                x = x + step * DITHER[column] * make(rng, len(x))
            channels[channel] = step * np.round(x / step) if step else x
        out[name] = Record.from_channels(np.arange(len(table)) * DT, channels, name=name)
    return out


def joint_of(case: Case) -> Joint:
    """The plain joint: what is hidden is not in it."""
    return Joint(
        name="joint",
        gear_ratio=case.gear_ratio,
        torque_per_current=case.gear_ratio * KM,
        model_name="hd3",
        effects=("viscous", "coulomb", "gravity"),
    )


@final
@dataclass
class Tally:
    """What one kind of noise gave."""

    clean: int = 0
    nothing: int = 0
    complete: int = 0
    named: int = 0
    in_set: int = 0
    hidden: int = 0
    extra: list[str] = field(default_factory=list)
    ratios: dict[str, list[float]] = field(default_factory=dict)
    seconds: float = 0.0

    def row(self, kind: str) -> str:
        """A line of the table."""
        shown = ", ".join(
            f"{b} {np.median(r):.2f} ({min(r):.2f} to {max(r):.2f})" for b, r in self.ratios.items()
        )
        return (
            f"| {kind} | {shown} | {self.clean} of {self.nothing} | {self.complete} | {self.named} "
            f"| {self.in_set} of {self.hidden} | {', '.join(self.extra)} | {self.seconds:.0f} |\n"
        )


def judge(tally: Tally, effect: str | None, seed: int, kind: Kind) -> str:
    """One joint under one kind of noise; what was said of it."""
    case = simulate_case(effect, seed)
    records = sensed(case, kind, seed)
    began = time.perf_counter()
    found = improve(
        [records["train"], records["train2"]], joint_of(case), [records["test"], records["test2"]]
    )
    tally.seconds += time.perf_counter() - began
    claims = [c.effects for c in found.claims]
    ratios = {b: e.ratio for b, e in found.final_ratios.items()}
    if effect is None:
        tally.nothing += 1
        tally.clean += found.verdict == "nothing_missing"
    else:
        tally.hidden += 1
        tally.complete += found.verdict == "complete"
        tally.named += (effect,) in claims
        tally.in_set += any(effect in c for c in claims)
    extra = ["/".join(c) for c in claims if effect not in c]
    tally.extra += extra
    if not extra and (effect is None or any(effect in c for c in claims)):
        for b, r in ratios.items():
            tally.ratios.setdefault(b, []).append(r)
    shown = ", ".join(f"{b} {r:.2f}" for b, r in ratios.items())
    return f"{effect} {seed}: {found.verdict} {['/'.join(c) for c in claims]} {shown}\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table: ratios are those of the right model, median and range."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--kinds", help="comma-separated (default: all)")
    parser.add_argument("--effects", type=int, default=len(EFFECTS), help="hidden ones, of eleven")
    parser.add_argument("--seeds", type=int, default=1, help="joints per effect")
    parser.add_argument("--none", type=int, default=2, help="joints with nothing hidden")
    parser.add_argument("--start", type=int, default=0, help="counted from the first seed")
    parser.add_argument("--sets", default="tuned,fresh", help="seeds: tuned, fresh or both")
    parser.add_argument("--each", action="store_true", help="print every joint")
    options = parser.parse_args(argv)
    write = sys.stdout.write
    for which in options.sets.split(","):
        first = {"tuned": TUNED, "fresh": FRESH}[which] + options.start
        write(
            f"\n{which} seeds from {first}\n\n| noise | residual over floor | nothing missing | "
            "complete | named | in set | extra claims | seconds |\n" + 8 * "|---" + "|\n"
        )
        for kind in options.kinds.split(",") if options.kinds else KINDS:
            tally = Tally()
            jobs: list[tuple[str | None, int]] = [(None, first + k) for k in range(options.none)]
            jobs += [
                (e, first + k) for e in EFFECTS[: options.effects] for k in range(options.seeds)
            ]
            for effect, seed in jobs:
                said = judge(tally, effect, seed, KINDS[kind])
                write(said if options.each else "")
                sys.stdout.flush()
            write(tally.row(kind))
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
