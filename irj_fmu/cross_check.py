"""The folder that the FMI Cross-Check rules ask of a tool that exports FMUs: for each interface and
platform the FMU with inputs, a reference solution and how it was computed.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from identification.errors import InputError
from identification.version import VERSION
from irj_fmu.command_line import replace_files
from irj_fmu.fmi.related import csv_text
from irj_fmu.host.exchange import Exchange, simulate_me
from irj_fmu.host.fmu import Fmu, Instance
from irj_fmu.host.run import Trajectory, Wiring, simulate_cs
from irj_fmu.host.signals import FloatArray, Signal, Table, constant

TOOL: Final = "irj"
STOP: Final = 4.0
"""Length of the run [s]: the slowest tone of a drive has a period of 5 s, and 400 rows of ten
variables stay below the megabyte that a file may have."""
EVERY: Final = 0.01
"""Time between two rows [s]; inputs run in straight lines between them."""
MOST: Final = 10
"""Variables of a reference solution, as the rules recommend."""
EXACT: Final = 1e-10
"""Relative tolerance of the reference in model exchange."""
SHOWN: Final = 1e-4
"""Relative tolerance that a comparison is asked for."""


def write_cross_check(fmu: Path, out: Path, drives: Mapping[str, Signal]) -> list[Path]:
    """Write the folder of an FMU of FMI 2.0, for each of its interfaces and platforms.

    The reference of model exchange is integrated by the host of this package, that of co-simulation
    by the FMU, both on this machine; they are the same on every platform.

    Parameters
    ----------
    fmu : Path
        With a library for this machine.
    out : Path
        ``fmus/2.0/{cs,me}/{platform}/irj/{version}/{model}`` is made below it.
    drives : mapping of str to callable
        Inputs as functions of time [s]; the others stay at their start values.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        Another version of FMI; a folder that cannot be written.
    FmuError
        Where the FMU refuses a call.
    """
    with Fmu(fmu, (2,)) as opened:
        about, name = opened.description, Path(fmu).stem
        platforms = sorted(
            {n.split("/")[1] for n in zipfile.ZipFile(fmu).namelist() if n.startswith("binaries/")}
        )
        reals = [v for v in about.modelVariables if v.type == "Real"]
        # hosts read an output before or after they set the next input: one that an input moves at
        # once tells the host from another, not the FMU
        direct = {
            u.variable.name
            for u in about.outputs
            if any(v.causality == "input" for v in u.dependencies or ())
        }
        outputs = [v.name for v in reals if v.causality == "output" and v.name not in direct][:MOST]
        time = _rows()
        given = {
            v.name: drives.get(v.name, constant(_start(v.start)))
            for v in reals
            if v.causality == "input"
        }
        inputs = {
            n: Table(time, np.array([signal(t) for t in time.tolist()]), hold=False)
            for n, signal in given.items()
        }
        step = float(about.defaultExperiment.stepSize)
        done: list[Path] = []
        for kind in _kinds(opened):
            found = _run(opened, kind, inputs, outputs, step)
            content = {
                f"{name}.fmu": Path(fmu).read_bytes(),
                f"{name}_ref.csv": csv_text(found.time, {n: found[n] for n in outputs}),
                f"{name}_ref.opt": _options(kind, step),
                "README.md": _readme(name, kind, step, bool(inputs)),
            }
            if inputs:
                content[f"{name}_in.csv"] = csv_text(time, {n: t.values for n, t in inputs.items()})
            for platform in platforms:
                place = Path(out) / "fmus" / "2.0" / kind / platform / TOOL / VERSION / name
                done += replace_files(place, content)
    return done


def _rows() -> FloatArray:
    return EVERY * np.arange(round(STOP / EVERY) + 1, dtype=np.float64)


def _start(value: str | None) -> float:
    """Start value of an input; 0 where it has none."""
    return float(value) if value is not None else 0.0


def _kinds(fmu: Fmu) -> list[str]:
    about = fmu.description
    found = [
        kind
        for kind, part in (("cs", about.coSimulation), ("me", about.modelExchange))
        if part is not None
    ]
    if not found:
        raise InputError(f"{fmu.path.name}: has neither co-simulation nor model exchange")
    return found


def _run(
    fmu: Fmu, kind: str, inputs: Mapping[str, Table], outputs: list[str], step: float
) -> Trajectory:
    """The reference solution, every :data:`EVERY` seconds."""
    rows = _rows()
    if kind == "me":
        options = Exchange(inputs=inputs, record=outputs, rtol=EXACT, atol=EXACT)
        with Instance(fmu, "me") as instance:
            return simulate_me(instance, rows, options)
    wiring = Wiring(
        inputs={f"fmu.{n}": table for n, table in inputs.items()},
        record=[f"fmu.{n}" for n in outputs],
    )
    with Instance(fmu, "cs") as instance:
        found = simulate_cs(instance, wiring, step=step, stop=STOP)
    each = round(EVERY / step)
    return Trajectory(rows, {n: found[f"fmu.{n}"][::each] for n in outputs})


def _options(kind: str, step: float) -> bytes:
    rows = [
        ("StartTime", 0.0),
        ("StopTime", STOP),
        ("StepSize", step if kind == "cs" else 0.0),
        ("RelTol", SHOWN),
        ("OutputIntervalLength", EVERY),
    ]
    return "".join(f"{key}, {value!r}\n" for key, value in rows).encode()


def _readme(name: str, kind: str, step: float, driven: bool) -> bytes:
    how = (
        f"Co-simulation with a communication step of {step:g} s; the FMU has its own integrator of "
        "controlled step length. Inputs are set at the beginning of each step"
        if kind == "cs"
        else "Model exchange, integrated by Dormand-Prince steps at a relative tolerance of "
        f"{EXACT:g}, inputs at the times of its stages"
    )
    lines = [
        f"# {name}",
        "",
        f"Exported by {TOOL} {VERSION} from a joint file. {how}.",
        "",
        f"- `{name}_ref.csv`: reference solution, a row every {EVERY:g} s.",
        f"- `{name}_ref.opt`: times, step and tolerance.",
    ]
    if driven:
        lines.append(f"- `{name}_in.csv`: inputs, straight lines between the rows.")
    lines += ["", "The FMU needs no licence, no Python and no file beside it.", ""]
    return "\n".join(lines).encode()


__all__ = ["TOOL", "write_cross_check"]
