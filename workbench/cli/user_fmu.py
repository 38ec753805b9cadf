"""check, fit, compare, diagnose, improve, report, add and export where the joint file's model
is a user's FMU (``[model] fmu = "..."``).
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from identification.data.check.checks import Finding
from identification.data.check.gate import gate_warnings
from identification.data.record import Record
from identification.data.schema import meant
from identification.errors import InputError
from irj_fmu.command_line import OneLineParser, check_output, keep_inputs
from workbench.cli.files import distinct, open_records, progress_bar, write_json, write_text
from workbench.cli.library import with_law
from workbench.cli.records import checked
from workbench.show.words import untested_lines

if TYPE_CHECKING:
    from irj_fmu.imported.diagnose import UserDiagnosis
    from irj_fmu.imported.improve import UserImprovement
    from irj_fmu.imported.model import UserModel
    from irj_fmu.imported.outputs import UserComparison

VERBS: Final = {
    **dict.fromkeys(
        ("check", "fit", "compare", "diagnose", "improve", "report", "add", "export"), "user_fmu"
    ),
    **dict.fromkeys(("explore", "track"), "foreign"),
}
"""Verbs that take an FMU as the model, and the module that runs each then."""


def module_of(arguments: Namespace) -> str:
    """The module that runs a verb: another one where the joint file's model is an FMU.

    Raises
    ------
    InputError
        A verb that does not work with an FMU as the model.
    """
    path = getattr(arguments, "joint", None)
    rest = list(getattr(arguments, "rest", ()))
    for i, word in enumerate(rest):
        path = (
            rest[i + 1]
            if word == "--joint" and i + 1 < len(rest)
            else word.removeprefix("--joint=")
            if word.startswith("--joint=")
            else path
        )
    if not isinstance(path, str) or not _has_model(path):
        return str(arguments.module)
    if arguments.verb == "batch":
        raise InputError(
            f"{path}: `irj batch` takes a study file: write [[joint]] and below it joint = "
            '"FILE" and records = ["FILE"], and run irj batch STUDY.toml (docs/batch.md)'
        )
    if arguments.verb not in VERBS:
        raise InputError(
            f"{path}: its model is an FMU; `irj {arguments.verb}` does not take one, only "
            f"{', '.join(VERBS)} do"
        )
    return VERBS[arguments.verb]


def _has_model(path: str) -> bool:
    """Cheap: most joint files hold no such line, and are not read twice."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return False
    return any(
        line.strip().replace(" ", "").startswith(("[model]", "[model."))
        for line in text.splitlines()
    )


def one_line(run: Callable[[Namespace], int]) -> Callable[[Namespace], int]:
    """What an FMU refuses is unusable input: one line, exit 2."""

    @wraps(run)
    def guarded(arguments: Namespace) -> int:
        from irj_fmu.host.run import FmuError

        try:
            return run(arguments)
        except FmuError as error:
            raise InputError(str(error)) from error

    return guarded


def open_model(arguments: Namespace) -> tuple[UserModel, list[Record], list[str]]:
    """The model of `--joint`, its notes printed; records that hold what it maps, and warnings.

    Raises
    ------
    InputError
        An option that does not work with an FMU, a file or a record that cannot be used.
    """
    from irj_fmu.imported.file import load_user_joint

    for option in ("other_payload", "refine"):
        if getattr(arguments, option, None):
            raise InputError(
                f"{arguments.joint}: its model is an FMU, which --{option.replace('_', '-')} "
                "does not work with; leave it out"
            )
    model = load_user_joint(arguments.joint)
    for note in model.notes:
        print(f"irj: {note}", file=sys.stderr)
    records, warnings = open_mapped(arguments.records, model)
    return model, records, warnings


def open_mapped(paths: Sequence[str], model: UserModel) -> tuple[list[Record], list[str]]:
    """Records that hold every channel which the joint file maps."""
    records, warnings = open_records(paths, model.joint)
    for path, record in zip(paths, records, strict=True):
        for missing in _unmapped(record, model):
            raise InputError(f"{path}: {missing}")
    return records, warnings


def _unmapped(record: Record, model: UserModel) -> list[str]:
    """What is wrong where a record lacks a channel that the joint file maps."""
    has = ", ".join(record.channels)
    lacking = [m for m in (*model.inputs, *model.outputs) if not record.has(m.channel)]
    return [
        f"has no {m.channel}, which [model.channels] maps to {m.variable} (it has {has}); map "
        "what is there"
        for m in lacking
    ]


def new_notes(before: UserModel, after: UserModel) -> None:
    """Say what came to be known on the way from one model to another."""
    for note in after.notes:
        if note not in before.notes:
            print(f"irj: {note}", file=sys.stderr)


@one_line
def run_check(arguments: Namespace) -> int:
    """`irj check REC --joint J` with an FMU as the model: the gate, and whether the mapped
    channels are there.
    """
    from irj_fmu.imported.file import load_user_joint

    model = load_user_joint(arguments.joint)
    return checked(
        arguments,
        model.joint,
        lambda r: [
            Finding("refuse", "unmapped", f"{r.name}: {text}") for text in _unmapped(r, model)
        ],
    )


@one_line
def run_fit(arguments: Namespace) -> int:
    """`irj fit REC --joint J` with an FMU as the model."""
    from irj_fmu.imported.file import user_joint_text
    from irj_fmu.imported.fit import fit

    model, records, warnings = open_model(arguments)
    fitted = fit(model, records, progress=progress_bar)
    new_notes(model, fitted.model)
    print(fitted.method)
    _print_outputs(fitted.train)
    _print_parameters(fitted.parameters)
    if fitted.unmoved:
        print(
            f"irj: {', '.join(fitted.unmoved)}: moves no output of these records and keeps its "
            "value",
            file=sys.stderr,
        )
    if arguments.output:
        write_text(
            arguments.output,
            user_joint_text(fitted.model, fitted.stderr, Path(arguments.output).resolve().parent),
        )
        print(f"joint file: {arguments.output}")
    write_json(arguments.json, {**fitted.as_json(), "warnings": warnings})
    return 0


@one_line
def run_compare(arguments: Namespace) -> int:
    """`irj compare REC --joint J` with an FMU as the model: as it is, or fitted to other
    records first.
    """
    from irj_fmu.imported.compare import compare
    from irj_fmu.imported.fit import fit

    model, records, warnings = open_model(arguments)
    if arguments.fit_records:
        before = model
        model = fit(
            model, open_mapped(arguments.fit_records, model)[0], progress=progress_bar
        ).model
        new_notes(before, model)
    found = compare(model, records)
    _print_outputs(found)
    print(f"  fails most from {found.worst_window[0]:.4g} s to {found.worst_window[1]:.4g} s")
    write_json(arguments.json, {**found.as_json(), "warnings": warnings})
    return 0


@one_line
def run_diagnose(arguments: Namespace) -> int:
    """`irj diagnose REC --joint J` with an FMU as the model."""
    from irj_fmu.imported.diagnose import diagnose
    from irj_fmu.imported.fit import fit

    distinct(training=arguments.records, held_out=arguments.held_out)
    model, records, _ = open_model(arguments)
    held, _ = open_mapped(arguments.held_out, model)
    if model.parameters:
        before = model
        model = fit(model, records, progress=progress_bar).model
        new_notes(before, model)
    found = diagnose(model, records, held, progress=progress_bar)
    said = gate_warnings([*records, *held])
    for text in found.diagnosis.warnings:
        if text not in said:
            print(f"irj: {text}", file=sys.stderr)
    if found.data.note:
        print(f"note: {found.data.note}")
    if found.why_followed:
        print(f"irj: seen at the drive alone: {found.why_followed}", file=sys.stderr)
    for name, balance in found.error.balances.items():
        where = "" if name == "axis" else f" in the {name} balance"
        print(
            f"torque that the FMU leaves unexplained{where}: {balance.rms:.3g} {balance.unit} on "
            f"held-out data, noise {balance.floor:.3g} {balance.unit}"
        )
    print(found)
    for line in untested_lines(found.ranking.not_testable, verbose=arguments.verbose):
        print(line)
    if found.claims:
        joint = found.diagnosis.found.steps[-1].solution.model
        label = found.claims[0].label
        place = next(t.place for t in joint.terms if t.label == label)
        why = found.stays(found.claims[0].effect, place)
        if why:
            print(f"{label} {why}: it is named, not added")
        else:
            _offer(found, arguments)
    for key in arguments.why:
        print(found.diagnosis.why(key))
    write_json(arguments.json, found.as_json())
    return 0


def _improved(arguments: Namespace, report: str | None, most: int) -> UserImprovement:
    """The loop on files, its report written where one is wanted."""
    from irj_fmu.imported.improve import improve
    from workbench.cli.loop import results_beside

    distinct(training=arguments.records, held_out=arguments.held_out)
    beside = results_beside(getattr(arguments, "beside", []))
    model, records, _ = open_model(arguments)
    held, _ = open_mapped(arguments.held_out, model)
    found = improve(model, records, held, max_additions=most, progress=progress_bar)
    new_notes(model, found.model)
    said = gate_warnings([*records, *held])
    for text in found.found.warnings:
        if text not in said:
            print(f"irj: {text}", file=sys.stderr)
    if report:
        from workbench.show.report import write_report

        every = [*records, *held]
        made = write_report(
            found.found,
            report,
            records=every,
            command=arguments.command,
            author=getattr(arguments, "author", None) or "",
            notes=getattr(arguments, "notes", None) or "",
            beside=beside,
        )
        print(f"report: {made}")
    return found


@one_line
def run_improve(arguments: Namespace) -> int:
    """`irj improve REC --joint J` with an FMU as the model: effects are added outside it."""
    from irj_fmu.imported.file import user_joint_text
    from workbench.cli.loop import print_improvement, write_picture

    found = _improved(arguments, arguments.report, arguments.max_steps)
    followed = found.diagnoses[0].why_followed
    if followed:
        print(f"irj: seen at the drive alone: {followed}", file=sys.stderr)
    print("balance at the drive:" if followed else "balances:")
    print_improvement(found.found, verbose=arguments.verbose)
    print("outputs on held-out data:")
    for step, outputs in zip(found.found.steps, found.outputs, strict=True):
        print(f"{'+ ' + step.added if step.added else 'start model'}")
        _print_outputs(outputs)
    _print_parameters(found.parameters)
    if arguments.output:
        write_text(
            arguments.output,
            user_joint_text(found.model, found.stderr, Path(arguments.output).resolve().parent),
        )
        print(f"joint file: {arguments.output}")
    write_picture(found.found, arguments.picture)
    write_json(arguments.json, found.as_json())
    return 0


@one_line
def run_report(arguments: Namespace) -> int:
    """`irj report REC --joint J` with an FMU as the model."""
    from identification.diagnosis.session import MAX_ADDITIONS

    found = _improved(arguments, arguments.output, MAX_ADDITIONS)
    print(found.found.reason)
    write_json(arguments.json, found.as_json())
    return 0


def _offer(found: UserDiagnosis, arguments: Namespace) -> None:
    """Write the model with the first claim outside, at the values of its trial, or say how."""
    from irj_fmu.imported.file import user_joint_text

    output = getattr(arguments, "output", None)
    if not output:
        print(
            f"add it: irj add {found.claims[0].label} --joint {arguments.joint} -o FILE, or -o "
            "FILE here to start at its values; then irj fit"
        )
        return
    write_text(output, user_joint_text(found.add(), folder=Path(output).resolve().parent))
    print(f"joint file: {output}, with {found.claims[0].label} outside; fit it next")


@one_line
def run_add(arguments: Namespace) -> int:
    """`irj add KEY --joint J -o J2`: the effect rides outside the FMU."""
    from irj_fmu.imported.correction import PREFIX
    from irj_fmu.imported.file import load_user_joint, outside_correction, user_joint_text

    model = load_user_joint(arguments.joint)
    key, before = arguments.key, model.correction
    if key is None or arguments.law is not None:
        joint, key = with_law(model.joint, arguments)
        model = replace(model, joint=joint)
    labels = [*(before.labels if before else ()), key]
    values = (
        {}
        if before is None
        else {
            PREFIX + n: v
            for n, v in zip(before.model.parameter_names, before.model.value_vector(), strict=True)
        }
    )
    larger = replace(
        model, correction=outside_correction(labels, model.joint, values, arguments.joint)
    )
    write_text(
        arguments.output, user_joint_text(larger, folder=Path(arguments.output).resolve().parent)
    )
    outside = larger.correction.labels if larger.correction else ()
    print(f"{arguments.output}: {', '.join(outside)} outside {model.fmu.path.name}")
    write_json(arguments.json, {"outside": list(outside), "file": arguments.output})
    return 0


def export_parser() -> OneLineParser:
    """Arguments of ``irj export`` where the joint file's model is an FMU."""
    from irj_fmu.imported.export import KINDS

    made = OneLineParser(
        prog="irj export", description="A user's FMU with the effect that rides outside it."
    )
    made.add_argument(
        "kind",
        nargs="?",
        default="pair",
        help=f"{', '.join(KINDS[:-1])} or {KINDS[-1]} (default: pair); corrected needs no Python",
    )
    made.add_argument("--joint", required=True, metavar="J", help="joint file (TOML)")
    made.add_argument(
        "--out",
        default=Path("dist"),
        type=Path,
        metavar="FOLDER",
        help="folder of the results (default: dist)",
    )
    made.add_argument("--cc", help="C compiler")
    made.add_argument(
        "--target",
        help="corrected: platform, as linux64 or win64, or all that the FMU has (default: this "
        "machine)",
    )
    made.add_argument("--fmi", type=int, choices=(2, 3), help="pair: version of FMI (default: 2)")
    made.add_argument("--json", metavar="FILE", help="write what was built as JSON")
    return made


@one_line
def run_export(arguments: Namespace) -> int:
    """`irj export [corrected|pair|ssp] --joint J`: FMU and correction as one FMU, in C or with
    Python, or as a system.
    """
    from irj_fmu.corrected.build import export_corrected
    from irj_fmu.fmi.compiler import find_compiler
    from irj_fmu.imported.export import KINDS, export_pair, export_system
    from irj_fmu.imported.file import load_user_joint
    from irj_fmu.plant.joint import identifier

    given = export_parser().parse_args(arguments.rest)
    if given.kind not in KINDS:
        raise InputError(
            f"export {given.kind}: the model of {given.joint} is an FMU, which goes out as "
            f"{', '.join(KINDS[:-1])} or {KINDS[-1]}; write one of them"
            f"{meant(given.kind, KINDS)}"
        )
    if given.target is not None and given.kind != "corrected":
        raise InputError(f"--target: goes with corrected, not with {given.kind}; leave it out")
    if given.fmi is not None and given.kind != "pair":
        why = "has the version of the FMU" if given.kind == "corrected" else "is of FMI 2.0"
        raise InputError(f"--fmi: goes with pair, {given.kind} {why}; leave it out")
    model = load_user_joint(given.joint)
    name = identifier(model.joint.name)
    target = given.out / (f"{name}.ssp" if given.kind == "ssp" else f"{name}_{given.kind}.fmu")
    inputs = [given.joint, model.fmu.path]
    keep_inputs([target], inputs)
    if given.json is not None:
        check_output(given.json, inputs)
        if Path(given.json).absolute() == target.absolute():
            raise InputError(f"{given.json}: given for two results; give each a file of its own")
    if given.cc is not None:
        find_compiler(None, given.cc)
    if given.kind == "corrected":
        path = export_corrected(model, target, cc=given.cc, target=given.target)
    elif given.kind == "pair":
        path = export_pair(model, target, cc=given.cc, fmi=given.fmi or 2)
    else:
        path = export_system(model, target, cc=given.cc)
    print(path)
    write_json(given.json, {"built": [str(path)]})
    return 0


def _print_outputs(found: UserComparison) -> None:
    print(f"{'channel':<18} {'variable':<20} {'fit %':>9} {'error':>10} {'floor':>10} {'ratio':>8}")
    for e in found.outputs.values():
        print(
            f"{e.channel:<18} {e.variable:<20} {e.fit_percent:9.3f} {e.rms:10.3g} "
            f"{e.floor:10.3g} {e.ratio:8.3g} {e.unit}"
        )


def _print_parameters(parameters: Mapping[str, Mapping[str, Any]]) -> None:
    print("  value +- standard error, in the unit of the FMU's variable")
    for name, p in parameters.items():
        error = f" +- {p['stderr']:.2g}" if p["stderr"] is not None else ""
        flags = "".join(
            [
                " at its bound" * bool(p["at_bound"]),
                " not identifiable" * (not p["identifiable"] and not p["at_bound"]),
            ]
        )
        print(f"  {name:<36} {p['value']:.6g}{error} {p['unit']}{flags}")


__all__ = [
    "VERBS",
    "module_of",
    "run_add",
    "run_check",
    "run_compare",
    "run_diagnose",
    "run_export",
    "run_fit",
    "run_improve",
    "run_report",
]
