"""export, cosim, batch: the doors to FMI, C and CasADi; arguments go through to the modules
that do the work.
"""

from __future__ import annotations

import contextlib
import importlib
import tempfile
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from identification.data.plain_text import from_toml
from identification.data.schema import meant
from identification.errors import InputError
from irj_fmu.command_line import OneLineParser, check_output, keep_inputs, replace_files
from workbench.cli.files import open_joint, write_json

CODE_KINDS: Final = ("c", "casadi")
TAKES: Final = (
    *("--joint", "--out", "--cc", "--target", "--sample-time", "--json", "--held-out", "--report"),
)
"""Options that take one word."""
FUNCTIONS: Final = ("dynamics", "regressor", "jacobian", "energy")


def run_export(arguments: Namespace) -> int:
    """`irj export [KIND] --joint J`: FMUs by irj_fmu.build, `c` and `casadi` here; `plant`
    without a kind.
    """
    from irj_fmu.build import KINDS, main, parser
    from irj_fmu.imported.export import KINDS as OF_FMU

    every = (*KINDS, *CODE_KINDS, *OF_FMU)
    kind, rest = _kind(list(arguments.rest), every)
    if kind in CODE_KINDS:
        return _export_code([kind, *rest])
    if kind in OF_FMU and kind not in KINDS:
        for i, word in enumerate(rest):
            if word == "--joint" and i + 1 < len(rest):
                open_joint(rest[i + 1])  # a file that cannot be read says so itself
        raise InputError(
            f"export {kind}: goes with a joint file whose model is an FMU; give one with --joint "
            "(docs/user-fmu.md), or export plant"
        )
    if kind is not None and kind not in KINDS:
        raise InputError(
            f"export: {kind!r} cannot be built; choose one of "
            f"{', '.join((*KINDS, *CODE_KINDS))}"
            f"{meant(kind, every) or '; plant is the joint as an FMU'}"
        )
    if not kind and {"-h", "--help"} & set(rest):
        made = parser("irj export")
        made.epilog = (
            f"Of a joint also {' and '.join(CODE_KINDS)}: its functions as code. Of a joint file "
            f"whose model is an FMU: {', '.join(OF_FMU[:-1])} or {OF_FMU[-1]} "
            "(docs/user-fmu.md)."
        )
        made.parse_args(rest)  # prints it and ends
    return int(main([kind or "plant", *rest], prog="irj export"))


def _kind(rest: list[str], known: Sequence[str]) -> tuple[str | None, list[str]]:
    """What is to be built, which may stand behind options, and the other words."""
    if rest and not rest[0].startswith("-"):
        return rest[0], rest[1:]
    for i, word in enumerate(rest):
        takes = i > 0 and rest[i - 1] in TAKES
        if word in known and not takes:
            return word, [*rest[:i], *rest[i + 1 :]]
    return None, rest


def code_parser(prog: str) -> OneLineParser:
    """Arguments of ``irj export c`` and ``irj export casadi``."""
    made = OneLineParser(
        prog=prog,
        description="Dynamics, regressor, Jacobian, energy and friction compensation of a joint "
        "as code.",
    )
    made.add_argument("kind", choices=CODE_KINDS, help="what is written")
    made.add_argument("--joint", required=True, metavar="J", help="joint file (TOML)")
    made.add_argument(
        "--out", default="dist", metavar="FOLDER", help="folder of the results (default: dist)"
    )
    made.add_argument("--json", metavar="FILE", help="write what was built as JSON")
    return made


def _export_code(rest: Sequence[str]) -> int:
    given = code_parser(f"irj export {rest[0]}").parse_args(rest)
    if given.json is not None:
        check_output(given.json, [given.joint])
    files = export_code(given.kind, given.joint, Path(given.out))
    for path in files:
        print(path)
    write_json(given.json, {"built": [str(p) for p in files]})
    return 0


def export_code(kind: str, joint_path: str, folder: Path) -> list[Path]:
    """Write the joint's functions as C source (``c``) or as CasADi files (``casadi``, loaded by
    ``casadi.Function.load``).

    Arguments are those of :class:`casadi_models.functions.JointFunctions`; the parameter vector is
    written beside them as ``parameters.json`` with names, units and values.
    """
    import casadi as ca

    from casadi_models.text.compensation import friction_compensation

    model = open_joint(joint_path).model()
    functions = [getattr(model, name) for name in FUNCTIONS]
    with contextlib.suppress(ValueError):  # a joint without friction has none to compensate
        functions.append(friction_compensation(model))
    values = [
        {"name": p.name, "value": v, "unit": p.unit, "side": p.side}
        for p, v in zip(model.parameters, model.value_vector(), strict=True)
    ]
    with tempfile.TemporaryDirectory() as temporary:
        if kind == "c":
            code = ca.CodeGenerator("joint.c", {"with_header": True})
            for function in functions:
                code.add(function)
            code.generate(temporary + "/")
        else:
            for function in functions:
                function.save(str(Path(temporary) / f"{function.name()}.casadi"))
        write_json(Path(temporary) / "parameters.json", values)
        made = {path.name: path.read_bytes() for path in sorted(Path(temporary).iterdir())}
    keep_inputs([folder / name for name in made], [joint_path])
    return replace_files(folder, made)


def run_cosim(arguments: Namespace) -> int:
    """`irj cosim`."""
    return _passed("irj_fmu.cosim", arguments)


def run_batch(arguments: Namespace) -> int:
    """`irj batch`."""
    for word in arguments.rest[:1]:  # what follows may be a result
        if word.endswith(".toml") and _is_joint(Path(word)):
            raise InputError(
                f"{word}: unknown key 'joint': this is a joint file; a study has [study] "
                "(docs/batch.md)"
            )
    return _passed("irj_fmu.batch.run", arguments)


def _is_joint(path: Path) -> bool:
    """Whether a file has what a joint has, and nothing of a study; one that cannot be read is
    none.
    """
    try:
        tables = from_toml(path.read_text(encoding="utf-8-sig"), str(path))
    except (OSError, ValueError):
        return False
    return isinstance(tables.get("joint"), dict) and not {"study", "model"} & set(tables)


def _passed(name: str, arguments: Namespace) -> int:
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or name
        raise InputError(
            f"{arguments.verb} needs the module {missing}, which is not in this installation; "
            "from Python, "
            "irj_fmu.batch.fleet.run_fleet does the work"
        ) from None
    return int(module.main(arguments.rest))
