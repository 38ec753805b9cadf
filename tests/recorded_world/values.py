"""Are the bands of a fit worth what they say? Joints with nothing hidden, of which every value is
known.

``python -m tests.recorded_world.values --joints 30 --start 9100`` prints, for each parameter, how
far it is off and in how many joints its band of 95 % holds the truth; ``--only TROUBLE`` and
``--without TROUBLE ...`` as the campaign has them. With ``--online`` they are the values at the end
of the second record that `irj track` follows with what was fitted to the first.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import numpy as np

from tests.recorded_world.sensors import SETS
from tests.recorded_world.world import TROUBLES, make_case, write_case

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

TRUTH: Final = {
    "motor_inertia": "JM",
    "link_inertia": "JL",
    "stiffness": "K",
    "structural_damping": "C",
    "motor_viscous": "M_B",
    "link_viscous": "L_B",
    "motor_coulomb": "M_TC",
    "link_coulomb": "L_TC",
    "gravity_torque": "TG",
}
"""Parameters of a fit by those of the world's own integrator."""
GRAVITY: Final = ("gravity_torque", "gravity_cosine")
"""Both parts of the torque of gravity."""
BAND: Final = 2.0
"""Standard errors of a band of 95 %."""
FAR: Final = 5.0
"""Bands off from which a value is wrong and says that it is right."""


@final
@dataclass(frozen=True)
class Value:
    """One parameter of one joint, with its standard error."""

    seed: int
    name: str
    true: float
    found: float
    error: float

    @property
    def bands(self) -> float:
        """How far it is off, in half widths of its band."""
        return abs(self.found - self.true) / max(BAND * self.error, 1e-300)


def values_of(
    seed: int, given: str = "all", *, without: Collection[str] = (), online: bool = False
) -> list[Value]:
    """Fit the model of the joint file to a joint with nothing hidden, as the sensors `given` see
    it; with `online`, follow its second record.
    """
    case = make_case(seed, kind="none", without=without)
    with tempfile.TemporaryDirectory() as top:
        folder = write_case(case, Path(top), given)
        values, errors = followed(folder) if online else fitted(folder)
    out = []
    for name, key in TRUTH.items():
        error = errors.get(name)
        if name == "gravity_torque":
            continue
        if error is not None and case.joint.values.get(key):
            out.append(Value(seed, name, case.joint.values[key], values[name], float(error)))
    gravity = _gravity(values, errors)
    if gravity is not None and case.joint.values["TG"]:
        out.append(Value(seed, "gravity_torque", case.joint.values["TG"], *gravity))
    return out


def fitted(folder: Path) -> tuple[Mapping[str, float], Mapping[str, float | None]]:
    """Values and standard errors of a fit to train.csv."""
    from identification import fit, load_joint, read

    joint = load_joint(folder / "joint.toml")
    solution = fit(joint, read(folder / "train.csv", joint=joint)).solution
    return solution.values, solution.stderr


def followed(folder: Path) -> tuple[dict[str, float], dict[str, float | None]]:
    """Values and standard deviations at the end of test.csv, as the commands give them."""

    def irj(*words: str) -> None:
        # 1: something was found, which here is a false alarm and no matter
        done = subprocess.run(
            [sys.executable, "-m", "workbench", *words], cwd=folder, capture_output=True, text=True
        )
        if done.returncode not in (0, 1):
            raise RuntimeError(done.stderr)

    irj("fit", "train.csv", "--joint", "joint.toml", "-o", "fitted.toml")
    irj("track", "test.csv", "--joint", "fitted.toml", "--healthy", "train.csv", "--json", "out")
    (record,) = json.loads((folder / "out").read_text(encoding="utf-8"))["records"]
    own = record["parameters"]
    return {n: p["value"] for n, p in own.items()}, {n: p["sigma"] for n, p in own.items()}


def _gravity(
    values: Mapping[str, float], errors: Mapping[str, float | None]
) -> tuple[float, float] | None:
    """Size of the gravity torque, whatever its zero, with its standard error."""
    parts = [(values[n], errors.get(n)) for n in GRAVITY if n in values]
    size = math.hypot(*(v for v, _ in parts))
    known = [v * e for v, e in parts if e is not None]
    return (size, math.hypot(*known) / size) if size and len(known) == len(parts) else None


def table(found: Iterable[Value]) -> str:
    """A row for each parameter."""
    lines = [
        "| parameter | joints | band holds the truth % | more than five bands off % | median off % "
        "| median band % |",
        "|---|---|---|---|---|---|",
    ]
    found = list(found)
    for name in TRUTH:
        own = [v for v in found if v.name == name]
        if not own:
            continue
        bands = np.array([v.bands for v in own])
        off = np.array([abs(v.found / v.true - 1) for v in own])
        size = np.array([BAND * v.error / v.true for v in own])
        lines.append(
            f"| {name} | {len(own)} | {100 * np.mean(bands <= 1):.0f} | "
            f"{100 * np.mean(bands > FAR):.0f} | {100 * np.median(off):.2g} | "
            f"{100 * np.median(size):.2g} |"
        )
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.recorded_world.values",
        description=(__doc__ or "").partition("\n\n")[0],
    )
    parser.add_argument("--joints", type=int, default=20)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--without", nargs="*", choices=TROUBLES, default=[])
    parser.add_argument("--only", choices=TROUBLES)
    parser.add_argument("--sensors", choices=SETS, default="all")
    parser.add_argument("--online", action="store_true", help="follow the second record")
    parser.add_argument("--each", action="store_true", help="a line for each value, too")
    options = parser.parse_args(argv)
    without = [t for t in TROUBLES if t != options.only] if options.only else options.without
    found = []
    for seed in range(options.start, options.start + options.joints):
        own = values_of(seed, options.sensors, without=without, online=options.online)
        found += own
        for v in own if options.each else ():
            sys.stdout.write(
                f"{v.seed} {v.name}: {v.found:.5g} +- {v.error:.2g}, true {v.true:.5g}, "
                f"{v.bands:.1f} bands off\n"
            )
        sys.stdout.flush()
    sys.stdout.write(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
