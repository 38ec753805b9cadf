"""FMUs of other makes, each with a record of its plant and the joint file of a user."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np

from identification.data.channels import channel_unit
from identification.data.record import Record
from tests.user_fmus.make import Make, build, build_state_space
from tests.user_fmus.plant import GEAR, OWN, recorded
from tests.user_fmus.records import (
    MATRICES,
    TRUTH,
    axis,
    dahlquist,
    state_space,
    van_der_pol,
)

ME: Final = ("ModelExchange",)
CS: Final = ("CoSimulation",)
BOTH: Final = (*ME, *CS)


@final
@dataclass(frozen=True)
class Case:
    """An FMU with what a user knows of it.

    Attributes
    ----------
    made : callable
        The FMU, in a folder.
    record : callable
        Of the plant, by the seed of its noise.
    text : str
        The joint file but for the FMU's name.
    truth : mapping
        Of the parameters that are fitted.
    """

    made: Callable[[Path], Path]
    record: Callable[[int], Record]
    text: str
    truth: Mapping[str, float]


VAN_DER_POL: Final = """kind = "{kind}"
[model.channels]
motor_position = "y0"
motor_velocity = "y1"
[model.parameters]
mu = {{ low = 0.1, high = 5.0 }}
"""
DAHLQUIST: Final = """kind = "{kind}"
[model.channels]
motor_position = "y"
[model.parameters]
k = {{ low = 0.1, high = 5.0 }}
"""
STATE_SPACE: Final = """kind = "{kind}"
[model.channels]
motor_torque = "u[1]"
motor_position = "y[1]"
motor_velocity = "y[2]"
[model.parameters]
"A[2,1]" = {{}}
"A[2,2]" = {{}}
"B[2,1]" = {{}}
"""
SERVO: Final = """window = 0.5
[model.channels]
motor_torque = "torque"
motor_position = { variable = "angle", scale = 57.29577951308232 }
[model.parameters]
inertia = { low = 0.5, high = 10.0 }
viscous = { low = 0.0 }
coulomb = {}
gravity = {}
[model.start]
angle_0 = "motor_position"
speed_0 = "motor_velocity"
"""
ELASTIC: Final = """window = 0.5
[model.channels]
motor_torque = "torque"
motor_position = "motor_angle"
link_position = "link_angle"
link_torque = "gear_torque"
[model.parameters]
motor_inertia = { low = 1e-4, high = 1e-3 }
link_inertia = { low = 3.0, high = 30.0 }
stiffness = { low = 5e3, high = 5e4 }
damping = { low = 5.0, high = 80.0 }
viscous = { low = 1e-3, high = 1e-2 }
coulomb = { low = 0.05, high = 0.5 }
gravity = { low = 20.0, high = 150.0 }
[model.start]
qm = "motor_position"
wm = "motor_velocity"
ql = "link_position"
wl = "link_velocity"
"""


STOCK: Final = """[model.channels]
motor_torque = "tau"
motor_position = "q"
[model.parameters]
m = { low = 0.1, high = 10.0 }
d = { low = 0.0, high = 10.0 }
"""
MASS: Final = {"m": 1.4, "d": 0.8}


def _stock(folder: Path) -> Path:
    """A slave as pythonfmu's own command packs it."""
    out = folder / "StockSlave.fmu"
    if not out.exists():
        slave = Path(__file__).parent / "stock_slave.py"
        command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(slave), "-d", str(folder)]
        subprocess.run(command, check=True, capture_output=True)
    return out


def _mass(seed: int) -> Record:
    """Its mass, by the slave's own steps."""
    h = 0.01
    t = h * np.arange(600)
    u = 2.0 * np.sin(1.7 * t) + np.sin(5.3 * t)
    q, v = np.zeros(len(t)), 0.0
    for k in range(len(t) - 1):
        v += h * (u[k] - MASS["d"] * v) / MASS["m"]
        q[k + 1] = q[k] + h * v
    read = q + 1e-4 * np.random.default_rng(seed).standard_normal(len(t))
    return Record.from_channels(t, {"motor_position": read, "motor_torque": u}, name="mass")


def _own(name: str, make: Make) -> Callable[[Path], Path]:
    return lambda folder: build(name, folder, make)


def _cases() -> dict[str, Case]:
    out = {}
    for version in (2, 3):
        for kinds in (ME, CS):
            kind = "me" if kinds == ME else "cs"
            make = Make(version, kinds, strict=True, derivatives=False)
            tag = f"FMI {version} {kind}"
            out[f"VanDerPol, {tag}"] = Case(
                _own("VanDerPol", make),
                lambda seed: van_der_pol(2.3, seed=seed),
                VAN_DER_POL.format(kind=kind),
                {"mu": 2.3},
            )
            out[f"Dahlquist, {tag}"] = Case(
                _own("Dahlquist", make),
                lambda seed: dahlquist(0.8, seed=seed),
                DAHLQUIST.format(kind=kind),
                {"k": 0.8},
            )
    for kind in ("me", "cs"):
        out[f"StateSpace, FMI 3 {kind}"] = Case(
            lambda folder: build_state_space(folder, BOTH),
            state_space,
            STATE_SPACE.format(kind=kind),
            MATRICES,
        )
    out["Simulink style: fixed step, degrees, once per process"] = Case(
        _own("Servo", Make(2, CS, step=1e-3, once=True)),
        lambda seed: axis(seconds=6.0, seed=seed),
        SERVO,
        TRUTH,
    )
    out["Dymola style: co-simulation, fixed parameters"] = Case(
        _own("Elastic", Make(2, CS, strict=True)),
        lambda seed: recorded(None, 8.0, seed),
        ELASTIC,
        OWN,
    )
    out["stock pythonfmu"] = Case(_stock, _mass, STOCK, MASS)
    return out


MAKES: Final = _cases()
BOUNCING: Final = """{more}[model.channels]
motor_position = "height"
motor_velocity = "speed"
[model.parameters]
g = {{ low = 5.0, high = 15.0 }}
"""


def bouncing_ball(folder: Path, version: int, kinds: tuple[str, ...]) -> Path:
    """A ball whose bounce is a state event."""
    return build("BouncingBall", folder, Make(version, kinds, events=1))


def write_case(case: Case, folder: Path, seed: int, name: str = "user") -> tuple[Path, Path]:
    """The joint file and the record of a case, beside its FMU."""
    fmu = case.made(folder)
    joint, run = folder / f"{name}.toml", folder / f"{name}_{seed}.npz"
    gear = GEAR if "link_position" in case.text else 1.0
    joint.write_text(
        f'[joint]\nname = "{name}"\ngear_ratio = {gear}\n[model]\nfmu = "{fmu.name}"\n{case.text}',
        encoding="utf-8",
    )
    write_record(case.record(seed), run)
    return joint, run


def write_record(record: Record, path: Path) -> None:
    """A record as a file whose columns have units."""
    columns = {f"{c}_{channel_unit(c)}": record[c] for c in record.channels}
    np.savez(path, **{"time_s": record.time, **columns})


__all__ = ["BOUNCING", "MAKES", "Case", "bouncing_ball", "write_case", "write_record"]
