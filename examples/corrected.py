"""An FMU that came from elsewhere, corrected by an effect that it lacks: one FMU, in C.

    python examples/corrected.py --out parts

``foreign.fmu`` stands for somebody else's model of the elbow, without the drag of its grease. Its
corrected FMU holds it as it is, and a law of the library that takes the drag off its drive. Both
are driven alike in one system, beside a plant that has the drag in its own equations.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from fmpy.ssp.simulation import simulate_ssp

from identification.data.joint_file import load_joint
from irj_fmu.corrected.build import export_corrected
from irj_fmu.fmi.ssp import System, multisine_source, write_ssp
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.file import outside_correction
from irj_fmu.imported.model import load_user_model
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant

HERE = Path(__file__).parent
STEP = 1e-3
STOP = 4.0
EFFECT = "quadratic_drag@motor"
DRAG = 6.0
"""What the foreign model lacks, link-referred [N.m.s2/rad2]."""
PARTS = ("foreign", "corrected", "true")
TONES = ((5.0, 2.0, 0.6), (0.3, 0.9, 2.1), (0.0, 1.0, 2.0))
"""Amplitudes [A], frequencies [Hz] and phases [rad] of the current."""


def build(out: Path) -> Path:
    """Write the FMUs and the system into a folder."""
    joint = load_joint(HERE / "elbow.toml")
    more = replace(
        joint,
        effects=(*joint.effects, EFFECT),
        fitted={**joint.fitted, "motor_quadratic_drag": DRAG},
    )
    for name, which in (("foreign", joint), ("true", more)):
        build_plant(plant_spec(which, PlantOptions(name=name)), out / f"{name}.fmu")
    model = load_user_model(
        out / "foreign.fmu",
        {
            "motor_current": "i_m",
            "motor_position": "motor_position",
            "motor_velocity": "motor_velocity",
        },
        joint=joint,
        kind="cs",
    )
    law = outside_correction([EFFECT], joint, {f"{PREFIX}motor_quadratic_drag": DRAG}, "example")
    export_corrected(replace(model, correction=law), out / "corrected.fmu")
    build_plant(multisine_source(*TONES), out / "source.fmu")
    system = System(
        {name: out / f"{name}.fmu" for name in ("source", *PARTS)},
        {f"{name}.i_m": "source.signal" for name in PARTS},
        name="corrected_elbow",
        step=STEP,
        stop=STOP,
    )
    return write_ssp(system, out / "corrected_elbow.ssp")


def run(path: Path, stop: float = STOP) -> Any:
    """Run the system in fmpy.ssp; one row per step."""
    return simulate_ssp(str(path), stop_time=stop - STEP / 2, step_size=STEP)


def figures(out: Path) -> dict[str, float]:
    """What the correction brings, in the link's position."""
    found = run(build(out))
    true = found["true.link_position"]
    return {
        "swing of the true joint [rad]": float(np.ptp(true)),
        "foreign less true [rad]": float(np.abs(found["foreign.link_position"] - true).max()),
        "corrected less true [rad]": float(np.abs(found["corrected.link_position"] - true).max()),
    }


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        out = given.out or Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        for text, value in figures(out).items():
            print(f"{text:35s} {value:.6g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
