"""The integrator of the test generator: compiled from ``_sim.c``, with a numpy twin where there is
no compiler.

The scheme is Moreau's midpoint time stepping (J. J. Moreau, 1999): a leapfrog whose velocity step
contains set-valued Coulomb friction. It shares nothing with the integrators and models of the
project.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

SIDE = (
    "B",
    "B2",
    "B3",
    "BA",
    "TC",
    "TCA",
    "TS",
    "VS",
    "DS",
    "MU",
    "CYC",
    "CYC_P",
    "V0",
    "ZS",
    "SIN",
    "COS",
    "KA",
)
"""Parameters each side has: viscous, quadratic, cubic and even viscous; Coulomb, its asymmetry,
Stribeck extra torque, velocity and exponent; load factor; cyclic friction and phase; smoothing
velocity; bristle distance; torques of position."""

COMMON = (
    "JM",
    "JL",
    "TG",
    "K",
    "C",
    "N",
    "NKM",
    "KP",
    "KD",
    "KM",
    "K3",
    "PW_X1",
    "PW_X2",
    "PW_D1",
    "PW_D2",
    "HK1",
    "HK2",
    "HK3",
    "HS1",
    "HS2",
    "HS3",
    "GAP",
    "WIND",
    "WIND_X",
    "HEAT",
    "HEAT_TAU",
    "BUMP",
    "BUMP_X",
    "BUMP_W",
    "COG",
    "COG_O",
    "COG_P",
    "KE1",
    "KE1_O",
    "KE1_P",
    "KE2",
    "KE2_O",
    "KE2_P",
    "FLEX",
    "FLEX_F",
    "FLEX_Z",
    "STOP",
    "STOP_X",
    "LAG_I",
    "LAG_T",
    "CURVE",
)
"""Of joint, motor, drive and sensors. ``CURVE`` = 1: between its samples the reference is a cubic
and no line, so that the recorded current is that of its neighbourhood (the ripple of lines takes
.06 % off a motor inertia)."""
NAMES: tuple[str, ...] = (*COMMON, *(f"M_{s}" for s in SIDE), *(f"L_{s}" for s in SIDE))
INDEX: dict[str, int] = {name: i for i, name in enumerate(NAMES)}
STEP = 5e-5
PRE_ROLL = 0.5
NEUTRAL: dict[str, float] = {
    "KM": 1.0,
    "HEAT_TAU": 1.0,
    "BUMP_W": 1.0,
    "WIND_X": 1.0,
    "M_VS": 1.0,
    "L_VS": 1.0,
    "M_DS": 1.0,
    "L_DS": 1.0,
    "HS1": 1.0,
    "HS2": 1.0,
    "HS3": 1.0,
}


class GeneratorError(RuntimeError):
    """The generator could not make a record."""


def pack(values: dict[str, float]) -> FloatArray:
    """Parameter vector from names; what is not named is neutral (0, or 1 for divisors)."""
    vector = np.zeros(len(NAMES))
    for name, value in {**NEUTRAL, **values}.items():
        vector[INDEX[name]] = value
    return vector


def _source() -> str:
    lines = [
        f"#define P_{name} {i}" for name, i in INDEX.items() if not name.startswith(("M_", "L_"))
    ]
    lines += [f"#define P_M {INDEX['M_B']}", f"#define P_L {INDEX['L_B']}"]
    lines += [f"#define S_{name} {i}" for i, name in enumerate(SIDE)]
    return "\n".join(lines) + "\n" + (Path(__file__).parent / "_sim.c").read_text(encoding="utf-8")


@cache
def library() -> ctypes.CDLL | None:
    """The compiled integrator, or None where no C compiler is found (or ``IRJ_GENERATOR_NUMPY``
    is set).
    """
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None or os.name == "nt" or os.environ.get("IRJ_GENERATOR_NUMPY"):
        return None
    text = _source()
    folder = Path(tempfile.gettempdir())
    target = folder / f"joint-generator-{hashlib.sha256(text.encode()).hexdigest()[:16]}.so"
    if not target.exists():
        with tempfile.TemporaryDirectory() as work:
            source = Path(work) / "sim.c"
            source.write_text(text, encoding="utf-8")
            made = Path(work) / "sim.so"
            flags = ["-O2", "-ffp-contract=off", "-shared", "-fPIC"]
            subprocess.run(
                [compiler, *flags, "-o", str(made), str(source), "-lm"],
                check=True,
                capture_output=True,
            )
            part = folder / f"{target.name}.{os.getpid()}"
            shutil.copy(made, part)
            part.replace(target)
    lib = ctypes.CDLL(str(target))
    pointer = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
    lib.simulate.argtypes = [
        pointer,
        pointer,
        pointer,
        ctypes.c_int,
        ctypes.c_double,
        pointer,
        ctypes.c_double,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_int,
        pointer,
        ctypes.c_int,
        pointer,
    ]
    lib.write_table.argtypes = [
        ctypes.c_char_p,
        ctypes.c_char_p,
        pointer,
        ctypes.c_int,
        ctypes.c_int,
    ]
    return lib


def simulate(
    vectors: Sequence[FloatArray],
    references: Sequence[tuple[FloatArray, FloatArray]],
    states: Sequence[FloatArray],
    snags: Sequence[FloatArray],
    *,
    dt: float,
    pre_roll: float = PRE_ROLL,
    step: float = STEP,
) -> list[FloatArray]:
    """Simulate a list of records.

    Parameters
    ----------
    vectors
        One parameter vector (`pack`) per record.
    references
        Reference position [rad] and velocity [rad/s], one sample per output row.
    states
        Initial q, v (motor, link-referred) and theta, omega (link).
    snags
        Rows of start [s], length [s], torque [N.m], shape (n, 3); n may be 0.
    dt, pre_roll, step
        Output interval, time at rest before the record, integration step [s].

    Returns
    -------
    One array per record with time, current [A], q, v, theta, omega, torque [N.m] (rad, rad/s,
    link-referred).
    """
    lib = library()
    stride, before = round(dt / step), round(pre_roll / step)
    if lib is None:
        from tests.hidden_effect._engine_numpy import simulate_fleet

        return simulate_fleet(
            vectors, references, states, snags, step=step, stride=stride, before=before
        )
    results: list[FloatArray] = []
    for vector, (position, velocity), state, snag in zip(
        vectors, references, states, snags, strict=True
    ):
        out = np.zeros((len(position), 7))
        flat = np.ascontiguousarray(snag, dtype=np.float64).reshape(-1)
        code = lib.simulate(
            vector,
            np.ascontiguousarray(position),
            np.ascontiguousarray(velocity),
            len(position),
            dt,
            np.ascontiguousarray(state),
            step,
            stride,
            before,
            len(position),
            flat if flat.size else np.zeros(3),
            flat.size // 3,
            out,
        )
        if code:
            raise GeneratorError(f"the integrator stopped with code {code}: the joint ran away")
        results.append(out)
    return results


def write_csv(path: Path, header: str, table: FloatArray) -> None:
    """Write a table with nine significant digits."""
    lib = library()
    if lib is None:
        np.savetxt(path, table, fmt="%.9g", delimiter=",", header=header, comments="")
    elif lib.write_table(
        str(path).encode(), header.encode(), np.ascontiguousarray(table), *table.shape
    ):
        raise GeneratorError(f"cannot write {path}")
