"""export, cosim, batch: the doors to FMI, C and CasADi; arguments go through to the modules that do the work."""

from __future__ import annotations

import argparse
import importlib
import tempfile
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from identification.errors import InputError
from workbench.commands.files import open_joint, write_bytes, write_json

CODE_KINDS: Final = ("c", "casadi")
FUNCTIONS: Final = ("dynamics", "regressor", "jacobian", "energy")


def run_export(arguments: Namespace) -> int:
    """`irj export [KIND] --joint J`: FMUs by irj_fmu.build, `c` and `casadi` here; `plant` without a kind."""
    from irj_fmu.build import KINDS, main

    rest = list(arguments.rest)
    if rest and rest[0] in CODE_KINDS:
        return _export_code(rest)
    asks = {"-h", "--help"} & set(rest)
    if not asks and (not rest or rest[0].startswith("-")):
        rest = ["plant", *rest]
    elif not asks and rest[0] not in KINDS:
        raise InputError(f"export: {rest[0]!r} cannot be built; choose one of {', '.join((*KINDS, *CODE_KINDS))}")
    return int(main(rest))


def _export_code(rest: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog=f"irj export {rest[0]}", description="Dynamics, regressor, Jacobian and energy of a joint as code.")
    parser.add_argument("kind", choices=CODE_KINDS)
    parser.add_argument("--joint", required=True)
    parser.add_argument("--out", default="dist", help="folder of the results (default: dist)")
    parser.add_argument("--json", metavar="FILE")
    given = parser.parse_args(rest)
    files = export_code(given.kind, given.joint, Path(given.out))
    for path in files:
        print(path)
    write_json(given.json, {"built": [str(p) for p in files]})
    return 0


def export_code(kind: str, joint_path: str, folder: Path) -> list[Path]:
    """Write the joint's functions as C source (``c``) or as CasADi files (``casadi``, loaded by ``casadi.Function.load``).

    Arguments are those of :class:`casadi_models.functions.JointFunctions`; the parameter vector is written beside them as
    ``parameters.json`` with names, units and values.
    """
    import casadi as ca

    model = open_joint(joint_path).model()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); choose a writable folder with --out") from None
    functions = [getattr(model, name) for name in FUNCTIONS]
    done = []
    with tempfile.TemporaryDirectory() as temporary:
        if kind == "c":
            code = ca.CodeGenerator("joint.c", {"with_header": True})
            for function in functions:
                code.add(function)
            code.generate(temporary + "/")
        else:
            for name, function in zip(FUNCTIONS, functions, strict=True):
                function.save(str(Path(temporary) / f"{name}.casadi"))
        for made in sorted(Path(temporary).iterdir()):
            write_bytes(folder / made.name, made.read_bytes())
            done.append(folder / made.name)
    write_json(str(folder / "parameters.json"), [
        {"name": p.name, "value": v, "unit": p.unit, "side": p.side} for p, v in zip(model.parameters, model.value_vector(), strict=True)
    ])  # fmt: skip
    return [*done, folder / "parameters.json"]


def run_cosim(arguments: Namespace) -> int:
    """`irj cosim`."""
    return _passed("cosim", arguments)


def run_batch(arguments: Namespace) -> int:
    """`irj batch`."""
    return _passed("batch", arguments)


def _passed(verb: str, arguments: Namespace) -> int:
    name = f"irj_fmu.{verb}"
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or name
        raise InputError(f"{verb} needs the module {missing}, which is not in this installation; from Python, irj_fmu.fleet.run_fleet does the work") from None
    return int(module.main(arguments.rest))
