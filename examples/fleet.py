"""One joint a hundred times, each with another stiffness: in fmpy one by one, and as a fleet.

    python examples/fleet.py

The fleet's results are held against fmpy's; the times of both are printed.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from fmpy import simulate_fmu

from identification.data.joint_file import load_joint
from irj_fmu.batch.case import Batch
from irj_fmu.batch.fleet import run_fleet
from irj_fmu.host.signals import Table
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant

HERE = Path(__file__).parent
COUNT = 100
STEP, STOP = 5e-3, 1.0


def figures(out: Path, count: int = COUNT) -> dict[str, float]:
    """Build the FMU in `out`, run it both ways, and what came out."""
    joint = load_joint(HERE / "elbow.toml")
    made = build_plant(plant_spec(joint, PlantOptions(name="elbow")), out / "elbow.fmu")
    values = np.linspace(0.5, 2.0, count) * joint.fitted["stiffness"]
    t = STEP * np.arange(round(STOP / STEP) + 1)
    current = 8.0 * np.sin(2 * np.pi * 1.3 * t)
    begin = time.perf_counter()
    fleet = run_fleet(
        Batch(
            made,
            [{"stiffness": float(v)} for v in values],
            ["link_torque"],
            {"i_m": Table(t, current, hold=True)},
            step=STEP,
            stop=STOP,
        )
    )
    fast = time.perf_counter() - begin
    held = np.array(
        list(zip(t, current, strict=True)), dtype=[("time", np.float64), ("i_m", np.float64)]
    )
    begin = time.perf_counter()
    single = np.array(
        [
            simulate_fmu(
                str(made),
                fmi_type="CoSimulation",
                stop_time=STOP,
                output_interval=STEP,
                start_values={"stiffness": float(v)},
                input=held,
                output=["link_torque"],
            )["link_torque"]
            for v in values
        ]
    )
    return {
        "simulations": float(count),
        "failed": float(len(fleet.errors)),
        "largest torque [N.m]": float(np.abs(single).max()),
        "spread over the stiffness [N.m]": float(np.ptp(single, axis=0).max()),
        "largest difference to fmpy [N.m]": float(
            np.abs(fleet.signals["link_torque"] - single).max()
        ),
        "fleet [s]": fast,
        "fmpy one by one [s]": time.perf_counter() - begin,
    }


def main() -> int:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as scratch:
        for text, value in figures(Path(scratch)).items():
            print(f"{text:35s} {value:.6g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
