"""demo, fit, compare, diagnose, improve, report: the main job."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from types import MappingProxyType
from typing import Any

from identification.data.check.gate import gate_warnings
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.improve import Improvement, improve
from identification.diagnosis.outcome import known_key
from identification.errors import InputError
from identification.fitting.engine import prepared_model
from identification.fitting.fit import Fit, fit
from identification.fitting.trust import Trust, trust
from workbench.cli.files import (
    alike,
    distinct,
    enlarged,
    open_joint,
    open_records,
    progress_bar,
    write_json,
    write_text,
)
from workbench.cli.first.help import bold
from workbench.show.words import (
    finding_lines,
    left_behind,
    place_lines,
    step_lines,
    untested_lines,
)


def improve_files(
    train: Sequence[str],
    held_out: Sequence[str],
    joint_path: str,
    *,
    other_payload: Sequence[str] = (),
    max_additions: int = 6,
    reference: str | None = None,
) -> tuple[dict[str, Any], Improvement, list[Record]]:
    """The loop on files: its JSON, the result and the records; with a `reference`, first what
    changed since.
    """
    distinct(training=train, other_payload=other_payload, held_out=held_out)
    joint = open_joint(joint_path)
    records, _ = training(train, other_payload, joint)
    held, _ = open_records(held_out, joint)
    alike([*train, *other_payload, *held_out], [*records, *held], joint)
    since = None
    if reference:
        from workbench.cli.changed import compared

        since = compared(open_joint(reference), [r for r in records if r.payload != "other"])
        # what has moved is not known any more
        gone = {n for c in since.changes for n in (c.parameter, *c.tied)}
        joint = replace(joint, known={n: k for n, k in joint.known.items() if n not in gone})
    found = improve(records, joint, held, max_additions=max_additions, progress=progress_bar)
    progress_bar("done", 1.0)
    print_warnings(found.warnings, [*records, *held])
    data = found.as_json() if since is None else {**found.as_json(), "changed": since.as_json()}
    judged = trusted(found)
    data["trust"] = judged.as_json() if judged is not None else []
    return data, found, [*records, *held]


def trusted(found: Improvement) -> Trust | None:
    """Which number of the last step to trust; None where nothing was fitted."""
    if not found.steps:
        return None
    last = found.steps[-1]
    return trust(last.solution, found.data, profiles=False, left=last.train.balances)


def print_warnings(warnings: Sequence[str], records: Sequence[Record]) -> None:
    """Warnings on stderr, without those that were printed when the records were opened."""
    said = gate_warnings(records)
    for text in warnings:
        if text not in said:
            print(f"irj: {text}", file=sys.stderr)


def training(
    paths: Sequence[str], other_payload: Sequence[str], joint: Joint
) -> tuple[list[Record], list[str]]:
    """Training records, those with another payload marked, and the warnings."""
    records, warnings = open_records(paths, joint)
    marked, more = open_records(other_payload, joint)
    return [*records, *(replace(r, payload="other") for r in marked)], [*warnings, *more]


def run_improve(arguments: Namespace) -> int:
    """`irj improve`."""
    for option in ("author", "notes", "beside"):
        if getattr(arguments, option) and not arguments.report:
            raise InputError(f"improve: --{option} is for the report; give --report, too")
    beside = results_beside(arguments.beside)
    data, found, records = improve_files(
        arguments.records,
        arguments.held_out,
        arguments.joint,
        other_payload=arguments.other_payload,
        max_additions=arguments.max_steps,
        reference=arguments.reference,
    )
    print_improvement(found, verbose=arguments.verbose)
    write_json(arguments.json, data)
    if arguments.output:
        write_text(arguments.output, found.to_joint_file())
        print(", ".join(filter(None, (f"joint file: {arguments.output}", left_behind(found)))))
    write_picture(found, arguments.picture)
    _write_report(
        found,
        records,
        arguments.report,
        arguments.command,
        author=arguments.author or "",
        notes=arguments.notes or "",
        beside=beside,
    )
    return 0


def run_report(arguments: Namespace) -> int:
    """`irj report`."""
    beside = results_beside(arguments.beside)
    data, found, records = improve_files(
        arguments.records,
        arguments.held_out,
        arguments.joint,
        other_payload=arguments.other_payload,
    )
    print(found.reason)
    write_json(arguments.json, data)
    _write_report(
        found,
        records,
        arguments.output,
        arguments.command,
        author=arguments.author or "",
        notes=arguments.notes or "",
        beside=beside,
    )
    return 0


def run_demo(arguments: Namespace) -> int:
    """`irj demo`."""
    with as_file(files("workbench") / "demo") as folder:
        names = {n: str(folder / n) for n in ("joint.toml", "train.npz", "held_out.npz")}
        print(
            "A simulated harmonic-drive joint with one effect that its model lacks; the answer "
            "is not in these files."
        )
        data, found, records = improve_files(
            [names["train.npz"]], [names["held_out.npz"]], names["joint.toml"]
        )
    print_improvement(found, verbose=arguments.verbose)
    write_json(arguments.json, data)
    write_picture(found, arguments.picture)
    _write_report(found, records, arguments.report, arguments.command)
    return 0


def results_beside(paths: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Results of other runs by the names of their files, by their paths where two have one name;
    read before anything is fitted.
    """
    if not paths:
        return {}
    from workbench.show.beside import read_result

    names = [Path(p).name for p in paths]
    return {
        p if names.count(name) > 1 else name: read_result(p)
        for p, name in zip(paths, names, strict=True)
    }


def _write_report(
    found: Improvement,
    records: Sequence[Record],
    report: str | None,
    command: str,
    *,
    author: str = "",
    notes: str = "",
    beside: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> None:
    """The report comes last: what it is drawn from stands on the disk before it is drawn."""
    if report:
        from workbench.show.report import write_report

        made = write_report(
            found,
            report,
            records=records,
            command=command,
            trust=trusted(found),
            author=author,
            notes=notes,
            beside=beside,
        )
        print(f"report: {made}")


def write_picture(found: Improvement, path: str | None) -> None:
    """Draw the falling error, where a file is wanted."""
    if path:
        from workbench.show.picture import improvement_picture

        write_text(path, improvement_picture(found))
        print(f"picture: {path}")


def print_improvement(found: Improvement, *, verbose: bool = False) -> None:
    """The verdict, then steps, claims and what is left, for a reader; `verbose`: why effects could
    not be tested.
    """
    print(bold(found.reason))
    untested = untested_lines(found.not_testable, verbose=verbose)
    for line in (*step_lines(found), *finding_lines(found), *untested):
        print(line)


def run_fit(arguments: Namespace) -> int:
    """`irj fit`."""
    distinct(training=arguments.records, other_payload=arguments.other_payload)
    joint = open_joint(arguments.joint)
    records, warnings = training(arguments.records, arguments.other_payload, joint)
    alike([*arguments.records, *arguments.other_payload], records, joint)
    fitted = fit(joint, records)
    if arguments.refine:
        fitted = _refined(fitted)
    print(
        f"relative error {fitted.train.relative_error_percent:.3f} %, fit "
        f"{fitted.train.fit_percent:.2f} %"
    )
    if fitted.scale:
        print(f"note: {fitted.scale}")
    _print_parameters(fitted.parameters)
    if arguments.output:
        write_text(arguments.output, fitted.to_joint_file())
    write_json(arguments.json, {**fitted.as_json(), "warnings": warnings})
    return 0


def run_twostep(arguments: Namespace) -> int:
    """`irj twostep`."""
    from identification.two_step.offline import fit_records, two_step_text

    joint = open_joint(arguments.joint)
    records, warnings = open_records(arguments.records, joint)
    found = fit_records(records, joint, method=arguments.method, cutoff=arguments.cutoff)
    units = {p.name: p.unit for p in joint.model().parameters}
    print(found.outcome)
    print(f"{found.samples} samples, {found.evaluations} evaluations of the search")
    for name, value in found.values.items():
        notes = [
            text
            for text, names in (
                ("not identifiable", found.unidentifiable),
                ("held", found.frozen),
                ("at its bound", found.at_bound),
            )
            if name in names
        ]
        said = f" ({', '.join(notes)})" if notes else ""
        print(f"  {name:<28} {value:.6g} +- {found.deviation[name]:.2g} {units[name]}{said}")
    if arguments.output:
        write_text(arguments.output, two_step_text(found, records, joint))
    write_json(
        arguments.json,
        {
            "method": arguments.method,
            "outcome": found.outcome.value,
            "parameters": {
                n: {"value": v, "deviation": found.deviation[n], "unit": units[n]}
                for n, v in found.values.items()
            },
            "shapes": list(found.nonlinear),
            "unidentifiable": list(found.unidentifiable),
            "frozen": list(found.frozen),
            "at_bound": list(found.at_bound),
            "residual_deviation": found.residual_deviation.tolist(),
            "evaluations": found.evaluations,
            "samples": found.samples,
            "warnings": warnings,
        },
    )
    return 0


def _refined(fitted: Fit) -> Fit:
    """The fit refined by the error of its simulated outputs, and what that gained."""
    from identification.fitting.output_error import refine

    found = refine(fitted)
    falls = ", ".join(f"{n} {found.before[n]:.3g} -> {found.after[n]:.3g}" for n in found.before)
    print(f"output error in {found.windows} windows, RMS: {falls}")
    return found.fit


def _print_parameters(parameters: Mapping[str, Mapping[str, Any]]) -> None:
    print("  value +- standard error, in brackets the side it is referred to")
    for name, p in parameters.items():
        if p["nuisance"]:
            continue
        error = f" +- {p['stderr']:.2g}" if p["stderr"] is not None else ""
        flags = "".join(
            [" at its bound" * bool(p["at_bound"]), " not identifiable" * (not p["identifiable"])]
        )
        print(f"  {name:<28} {p['value']:.6g}{error} {p['unit']} ({p['side']} side){flags}")


def run_compare(arguments: Namespace) -> int:
    """`irj compare`."""
    from identification.diagnosis.compare import compare

    joint = open_joint(arguments.joint)
    records, _ = open_records(arguments.records, joint)
    basis = open_records(arguments.fit_records, joint)[0] if arguments.fit_records else records
    alike(arguments.records, records, joint)
    alike(
        [*(arguments.fit_records or arguments.records), *arguments.records],
        [*basis, *records],
        joint,
        once=False,
    )
    # what a fit has written is judged as it stands, not fitted to what it is judged on
    stands = not arguments.fit_records and not joint.lacks(prepared_model(joint, records[0]))
    fitted = fit(joint.held() if stands else joint, basis)
    comparison = compare(fitted, records, linear=not arguments.no_linear)
    print(comparison)
    if not comparison.fitted_to:
        print(f"  with the values of {arguments.joint} as they stand")
    elif not arguments.fit_records:
        print(
            "  fitted to these very records; --fit REC... fits to others, for an error on records "
            "that the fit has not seen"
        )
    for place in [p for p in comparison.places if p.tells][:5]:
        print(
            f"  {place.balance} balance against {place.title}: explains "
            f"{place.share_percent:.0f} % of what is left there"
        )
    judged = trust(fitted.solution, fitted.data, profiles=False)
    write_json(arguments.json, {**comparison.as_json(), "trust": judged.as_json()})
    return 0


def run_diagnose(arguments: Namespace) -> int:
    """`irj diagnose`."""
    from identification.diagnosis.diagnose import diagnose

    distinct(
        training=arguments.records,
        other_payload=arguments.other_payload,
        held_out=arguments.held_out,
    )
    joint = open_joint(arguments.joint)
    for key in arguments.why:
        known_key(key)
    records, _ = training(arguments.records, arguments.other_payload, joint)
    held, _ = open_records(arguments.held_out, joint)
    alike(
        [*arguments.records, *arguments.other_payload, *arguments.held_out],
        [*records, *held],
        joint,
    )
    found = diagnose(fit(joint, records), held, progress=progress_bar)
    progress_bar("done", 1.0)
    print_warnings(found.warnings, [*records, *held])
    if found.data.note:
        print(f"note: {found.data.note}")
    answer, _, ranked = str(found).partition("\n")
    print(bold(answer))
    if ranked:
        print(ranked)
    untested = untested_lines(found.ranking.not_testable, verbose=arguments.verbose)
    for line in (*place_lines(found.unexplained), *untested):
        print(line)
    for key in arguments.why:
        print(found.why(key))
    if arguments.output and found.claims:
        write_text(arguments.output, enlarged(joint, found.claims[0].label))
        print(f"joint file with {found.claims[0].label}: {arguments.output}")
    elif arguments.output:
        print(f"nothing is named: {arguments.output} is not written")
    write_json(arguments.json, found.as_json())
    return 0
