"""A joint in model exchange: the FMU gives derivatives, the solver is that of the host.

    python examples/exchange.py

The host is twenty lines of fmpy's bare FMI calls and scipy's Radau, which gets the exact Jacobian
from the FMU's directional derivatives. FMI 2.0 and FMI 3.0 are compared, and both with the FMU's
own integrator in co-simulation.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import extract, instantiate_fmu, read_model_description, simulate_fmu
from scipy.integrate import solve_ivp

from identification.data.joint_file import load_joint
from irj_fmu.plant.fmi3 import build_plant_fmi3
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant

HERE = Path(__file__).parent
CURRENT = 6.0
"""A step of the motor's current [A], from the start on."""
STOP = 0.5


def solved(path: Path) -> tuple[np.ndarray, int]:
    """States at :data:`STOP` and how often the derivatives were asked for."""
    folder = extract(str(path))
    described = read_model_description(str(path))
    fmu: Any = instantiate_fmu(folder, described, "ModelExchange")
    three = described.fmiVersion.startswith("3")
    references = {v.name: v.valueReference for v in described.modelVariables}
    states = [d.variable.derivative.valueReference for d in described.derivatives]
    rates = [d.variable.valueReference for d in described.derivatives]
    write = fmu.setFloat64 if three else fmu.setReal
    read = fmu.getFloat64 if three else fmu.getReal
    if not three:
        fmu.setupExperiment(startTime=0.0)
    write([references["i_m"]], [CURRENT])
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    fmu.updateDiscreteStates() if three else fmu.newDiscreteStates()
    fmu.enterContinuousTimeMode()

    def slope(time: float, x: np.ndarray) -> np.ndarray:
        fmu.setTime(time)
        write(states, x.tolist())
        return np.array(read(rates))

    def jacobian(time: float, x: np.ndarray) -> np.ndarray:
        slope(time, x)
        return np.column_stack([fmu.getDirectionalDerivative(rates, [s], [1.0]) for s in states])

    start = np.array(read(states))
    found = solve_ivp(
        slope, (0.0, STOP), start, method="Radau", jac=jacobian, rtol=1e-10, atol=1e-12
    )
    fmu.terminate()
    fmu.freeInstance()
    shutil.rmtree(folder)
    return found.y[:, -1], found.nfev


def figures(out: Path) -> dict[str, float]:
    """Build the FMUs in `out`, solve both, and what came out."""
    spec = plant_spec(load_joint(HERE / "elbow.toml"), PlantOptions(name="elbow"))
    two = build_plant(spec, out / "elbow.fmu")
    three = build_plant_fmi3(spec, out / "elbow_fmi3.fmu")
    states, calls = solved(two)
    again, _ = solved(three)
    names = [v.name for v in spec.states]
    own = simulate_fmu(
        str(two),
        fmi_type="CoSimulation",
        stop_time=STOP,
        output_interval=STOP / 100,
        start_values={"i_m": CURRENT},
        output=names,
    )[-1]
    return {
        "link position [rad]": float(states[2]),
        "derivatives asked for": float(calls),
        "FMI 3.0 less FMI 2.0, largest state": float(np.abs(again - states).max()),
        "own integrator less Radau, largest state": float(
            np.abs([own[n] - x for n, x in zip(names, states, strict=True)]).max()
        ),
    }


def main() -> int:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as scratch:
        for text, value in figures(Path(scratch)).items():
            print(f"{text:45s} {value:.6g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
