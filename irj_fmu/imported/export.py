"""Export of a user's FMU with the effect that rides outside it: one FMU, or a system of two."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

from identification.data.own_effects import files_of
from identification.errors import InputError
from irj_fmu.fmi.package import SlaveSpec, package_slave
from irj_fmu.fmi.ssp import System, write_ssp
from irj_fmu.imported.file import user_joint_text
from irj_fmu.imported.library import UserFmu
from irj_fmu.imported.model import UserModel
from irj_fmu.imported.port import port_of
from irj_fmu.imported.slave import PAIR_FILE
from irj_fmu.plant.joint import identifier

KINDS: Final = ("corrected", "pair", "ssp")
"""What a user's FMU with an effect goes out as; the first in C, by :mod:`irj_fmu.corrected`."""
_INNER: Final = "inner.fmu"


def export_pair(
    model: UserModel, out: Path, *, cc: str | None = None, shim: bool = True, fmi: int = 2
) -> Path:
    """Write FMU and correction as one co-simulation FMU.

    It holds the user's FMU as it is, whatever its version and interface, the fitted values and the
    effect. It needs Python in the host, as the estimator does.

    Parameters
    ----------
    model : UserModel
    out : Path
        File to write, ending in ``.fmu``.
    cc : str, optional
        Compiler of the shim for C hosts.
    shim : bool
        False leaves the shim out.
    fmi : {2, 3}
        Version of FMI, whatever that of the FMU; FMI 3.0 needs a compiler.

    Raises
    ------
    InputError
        Where the FMU cannot be packed or the folder cannot be written.
    """
    return _package(model, out, "Pair", cc=cc, shim=shim, inner=True, fmi=fmi)


def export_system(model: UserModel, out: Path, *, cc: str | None = None, shim: bool = True) -> Path:
    """Write FMU and correction as an SSP: the effect's FMU feeds the drive input of the user's.

    The drive of the whole is ``outside.drive``. Between the two lies one communication step of the
    host.

    Raises
    ------
    InputError
        Where there is no correction, or the user's FMU is not FMI 2.0 co-simulation.
    """
    if model.correction is None:
        raise InputError(
            f"{model.fmu.path.name}: no effect rides outside it; diagnose and add one first"
        )
    if model.fmu.version != 2 or model.fmu.description.coSimulation is None:
        raise InputError(
            f"{model.fmu.path.name}: a system needs it as FMI 2.0 co-simulation; export the pair "
            "as one FMU instead"
        )
    port = port_of(model)
    with tempfile.TemporaryDirectory(prefix="irj-pair-") as folder:
        outside = _package(
            model,
            Path(folder) / f"{identifier(model.joint.name)}_outside.fmu",
            "Outside",
            cc=cc,
            shim=shim,
            inner=False,
        )
        inner = _archive(model.fmu, Path(folder) / _INNER)
        connections = {
            f"fmu.{model.inputs[port.input].variable}": "outside.corrected",
            "outside.position": f"fmu.{model.outputs[port.output].variable}",
        }
        if port.velocity is not None:
            connections["outside.velocity"] = f"fmu.{model.outputs[port.velocity].variable}"
        parameters = {f"fmu.{p.name}": p.value for p in model.parameters}
        parameters |= {
            f"outside.{name}": value for name, value in model.correction.free_values().items()
        }
        system = System(
            {"outside": outside, "fmu": inner},
            connections,
            parameters,
            name=identifier(model.joint.name),
        )
        return write_ssp(system, out)


def _package(
    model: UserModel,
    out: Path,
    what: str,
    *,
    cc: str | None,
    shim: bool,
    inner: bool,
    fmi: int = 2,
) -> Path:
    name = identifier(Path(out).stem)
    with tempfile.TemporaryDirectory(prefix="irj-pair-") as temporary:
        folder = Path(temporary)
        # the description of the FMU is needed in both cases: it says which variables there are
        files = {_INNER: _archive(model.fmu, folder / _INNER)}
        if not inner:
            files[_INNER] = _without_binaries(files[_INNER], folder / "bare.fmu")
        moved = replace(model, fmu=UserFmu(files[_INNER]))
        text = user_joint_text(moved, folder=folder).replace(files[_INNER].name, _INNER)
        (folder / PAIR_FILE).write_text(text, encoding="utf-8")
        files[PAIR_FILE] = folder / PAIR_FILE
        packages = tuple(_folder(p) for p in ("casadi_models", "identification", "irj_fmu"))
        own = files_of(model.correction.labels if model.correction is not None else ())
        return package_slave(
            SlaveSpec(name, "irj_fmu.imported.slave", what, packages, files, effects=own),
            out,
            cc=cc,
            shim=shim,
            fmi=fmi,
        ).path


def _archive(fmu: UserFmu, out: Path) -> Path:
    """The user's FMU as one file, as it came."""
    if fmu.path.is_file():
        shutil.copyfile(fmu.path, out)
        return out
    made = shutil.make_archive(str(out.with_suffix("")), "zip", fmu.path)
    return Path(shutil.move(made, out))


def _without_binaries(fmu: Path, out: Path) -> Path:
    import zipfile

    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr(
            zipfile.ZipInfo("modelDescription.xml", (1980, 1, 1, 0, 0, 0)),
            source.read("modelDescription.xml"),
        )
    return out


def _folder(name: str) -> Path:
    found = importlib.util.find_spec(name)
    for place in (found.submodule_search_locations or []) if found else []:
        return Path(place)
    raise InputError(f"package {name} is missing; install the project again")


__all__ = ["KINDS", "export_pair", "export_system"]
