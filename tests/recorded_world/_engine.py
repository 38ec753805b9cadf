"""The integrator of the recorded world: compiled once from ``_joint.c`` and kept in the
temporary folder.
"""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from collections.abc import Mapping

FloatArray = npt.NDArray[np.float64]

SIDE: Final = (
    *("B", "B2", "B3", "BA", "O1", "V1", "O2", "V2", "O3", "V3", "TC", "TCA", "TS", "VS", "DS"),
    *("MU", "CYC", "CYC_P", "V0", "ZS", "SIN", "COS", "KA", "KA_Q", "BUMP", "BUMP_X", "BUMP_W"),
    "ONE",
)
"""What each side has: viscous, quadratic, cubic and even viscous; three tanh terms with their
velocities; Coulomb, its asymmetry, Stribeck torque, velocity, exponent; load factor; cyclic
friction; smoothing velocity; bristle distance; torques of the link position; spring and where it
rests; a rub at one place, in one direction where ONE is +1 or -1."""
COMMON: Final = (
    *(
        "STEP",
        "JM",
        "JL",
        "TG",
        "TG_P",
        "K",
        "C",
        "N",
        "KM",
        "SAT",
        "LIMIT",
        "KP",
        "KD",
        "KI",
        "K3",
    ),
    *("X1", "X2", "D1", "D2", "HK1", "HK2", "HK3", "HS1", "HS2", "HS3", "GAP", "WIND", "WIND_X"),
    *("HEAT", "HEAT_T", "COG", "COG_O", "COG_P", "KE1", "KE1_O", "KE1_P", "KE2", "KE2_O", "KE2_P"),
)
NAMES: Final = (*COMMON, *(f"M_{s}" for s in SIDE), *(f"L_{s}" for s in SIDE))
INDEX: Final = {name: i for i, name in enumerate(NAMES)}
STEP: Final = 1e-4
ROWS_PER_SECOND: Final = 2000
"""The fine grid of the exact motion; sensors read between its rows."""
SETTLE: Final = 0.6
"""Seconds held at the first reference before a record begins."""
_ONES: Final = (
    *("KM", "HEAT_T", "WIND_X", "HS1", "HS2", "HS3"),
    *(f"{s}_{n}" for s in "ML" for n in ("VS", "DS", "V1", "V2", "V3", "BUMP_W")),
)
COLUMNS: Final = ("drive", "q", "v", "theta", "omega", "torque", "energy")


class WorldError(RuntimeError):
    """A recording could not be made."""


def pack(values: Mapping[str, float]) -> FloatArray:
    """Parameter vector; what is not named is absent."""
    vector = np.zeros(len(NAMES))
    vector[INDEX["STEP"]] = STEP
    vector[INDEX["LIMIT"]] = 1e9
    for name in _ONES:
        vector[INDEX[name]] = 1.0
    for name, value in values.items():
        vector[INDEX[name]] = value
    return vector


@cache
def library() -> ctypes.CDLL | None:
    """The compiled integrator, or None where there is no C compiler."""
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        return None
    defines = [f"#define P_{n} {i}" for n, i in INDEX.items() if n in COMMON]
    defines += [f"#define P_M {INDEX['M_B']}", f"#define P_L {INDEX['L_B']}"]
    defines += [f"#define F_{n} {i}" for i, n in enumerate(SIDE)]
    body = (Path(__file__).parent / "_joint.c").read_text(encoding="utf-8")
    text = "#define _GNU_SOURCE\n" + "\n".join(defines) + "\n" + body
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    target = Path(tempfile.gettempdir()) / f"recorded-world-{key}.so"
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=target.parent) as work:
            source, made = Path(work) / "joint.c", Path(work) / "joint.so"
            source.write_text(text, encoding="utf-8")
            flags = ["-O2", "-ffp-contract=off", "-shared", "-fPIC"]
            command = [compiler, *flags, "-o", str(made), str(source), "-lm"]
            subprocess.run(command, check=True, capture_output=True)
            made.replace(target)
    lib = ctypes.CDLL(str(target))
    reals = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
    counts = np.ctypeslib.ndpointer(dtype=np.int64, flags="C_CONTIGUOUS")
    lib.simulate.argtypes = [reals, reals, reals, counts, reals, reals]
    lib.write_table.argtypes = [ctypes.c_char_p, ctypes.c_char_p, reals, counts]
    return lib


def simulate(
    values: Mapping[str, float],
    reference: FloatArray,
    start: FloatArray,
    pushes: FloatArray | None = None,
    *,
    settle: float = SETTLE,
) -> FloatArray:
    """Follow a reference.

    Parameters
    ----------
    values
        Parameters by name (`NAMES`), link-referred, SI.
    reference
        Position and velocity, shape (rows, 2), ``ROWS_PER_SECOND`` rows a second.
    start
        q, v, theta, omega at the beginning, shape (4,).
    pushes
        Torques from outside: start [s], length [s], torque [N.m], side (0 motor, 1 link), shape (n,
        4).
    settle
        Time held at the first reference before the first row [s].

    Returns
    -------
    Rows of drive torque [N.m], q, v, theta, omega, torque of the transmission [N.m], energy [J]:
    `COLUMNS`.

    Raises
    ------
    WorldError
        No compiler, or the axis ran away.
    """
    lib = library()
    if lib is None:
        raise WorldError("no C compiler (cc, gcc or clang) to build the integrator with")
    step = float(values.get("STEP", STEP))
    stride = round(1.0 / (ROWS_PER_SECOND * step))
    given = np.zeros((0, 4)) if pushes is None else pushes
    count = np.array([len(reference), stride, round(settle / step), len(given)], dtype=np.int64)
    flat = np.ascontiguousarray(given, dtype=np.float64) if len(given) else np.zeros((1, 4))
    out = np.zeros((len(reference), len(COLUMNS)))
    path = np.ascontiguousarray(reference, dtype=np.float64)
    if lib.simulate(pack(values), np.ascontiguousarray(start), path, count, flat, out):
        raise WorldError("the axis ran away: its parameters do not make a stable loop")
    return out


def write_csv(path: Path, header: str, table: FloatArray) -> None:
    """Write a table with nine significant digits."""
    lib = library()
    shape = np.array(table.shape, dtype=np.int64)
    full = np.ascontiguousarray(table)
    if lib is None or lib.write_table(str(path).encode(), header.encode(), full, shape):
        raise WorldError(f"cannot write {path}")
