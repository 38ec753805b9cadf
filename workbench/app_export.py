"""What the user takes home: joint file, report, FMU, and Python that does the session again."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from identification.improve import HOLD_DELAY
from workbench.app_analysis import Progress
from workbench.app_live import Live
from workbench.app_report import improvement_of
from workbench.session import FileEntry, State, write_atomic


def session_code(state: State) -> str:
    """The session as a Python script: the same records, joint and steps, and the same errors."""
    ready = [f for f in state.files if f.status == "ready"]
    linear = 'kind = "linear"' in state.joint_text
    lines = [
        '"""The session of the workbench as a script. Run it in the folder of the measurement files."""',
        "import tomllib",
        "",
        "from identification import fit, read",
        "from identification.check import repair",
        "from identification.improve import with_held_out",
        "from identification.joint_file import parse_joint",
        "",
        f'joint = parse_joint(tomllib.loads("""\n{state.joint_text.strip()}\n""".replace("\\r", "")))',
        "",
    ]
    for role in ("train", "held_out"):
        lines += [f"{role} = ["]
        lines += [f"    repair({_read_call(f, linear)})," for f in ready if f.role == role]
        lines += ["]"]
    lines += ["train, held_out, note = with_held_out(train, held_out)", ""]
    if not state.steps:
        return "\n".join(lines)
    lines += ["fitted = fit(joint, train, held_out=held_out)", 'print("start", fitted.held_out.relative_error_percent)']
    for before, step in zip(state.steps[:-1], state.steps[1:], strict=True):
        lines += _step_lines(before.effects, step.effects, step.label or "", step.virtual_work != before.virtual_work, step.virtual_work)
    lines += ["", 'with open("fitted.toml", "w", encoding="utf-8") as stream:', "    stream.write(fitted.to_joint_file())"]
    return "\n".join(lines) + "\n"


def _step_lines(before: tuple[str, ...], after: tuple[str, ...], label: str, changed: bool, virtual_work: bool) -> list[str]:
    lines = ["model = fitted.model"]
    lines += [f"model = model.drop({name!r})" for name in before if name not in after and name != HOLD_DELAY]
    lines += [f"model = model.add({name!r})" for name in after if name not in before and name != HOLD_DELAY]
    if changed:
        lines += ["from dataclasses import replace", f"model = replace(model, virtual_work={virtual_work})"]
    lines += ["fitted = fit(model, train, joint=joint, held_out=held_out)", f"print({label!r}, fitted.held_out.relative_error_percent)"]
    return lines


def _read_call(entry: FileEntry, linear: bool) -> str:
    kind = ', kind="linear"' if linear else ""
    columns = f", columns={_plain(entry.columns)!r}" if entry.columns else ", columns=joint.columns"
    return f"read({entry.name!r}{columns}{kind})"


def _plain(columns: Mapping[str, Any]) -> dict[str, Any]:
    return {k: dict(v) if isinstance(v, Mapping) else v for k, v in columns.items()}


def joint_file(live: Live) -> str:
    """The fitted joint, or the joint as it was given where nothing is fitted yet."""
    return live.analysis().to_joint_file() if live.state.steps else live.state.joint_text


def report_available() -> bool:
    """Whether the report writer is there."""
    return importlib.util.find_spec("workbench.report") is not None


def fmu_available() -> bool:
    """Whether the FMU builder is there."""
    return importlib.util.find_spec("irj_fmu.build") is not None


def report(live: Live, folder: Path, progress: Progress) -> Path:
    """Write the HTML report of the session into a folder."""
    from workbench.report import write_report

    analysis = live.analysis()
    result = improvement_of(analysis, live.state.steps, progress)
    progress("writing the report", 0.95)
    return write_report(result, folder / "report.html", records=analysis.records)


def fmu(live: Live, folder: Path, progress: Progress, kind: str = "plant") -> Path:
    """Build the FMU of the fitted joint (``plant``) or of its online estimator (``estimator``) into a folder."""
    from identification.joint_file import load_joint
    from irj_fmu.build import Request, build

    source = folder / f"{kind}.toml"
    write_atomic(source, joint_file(live).encode())
    sensing = live.analysis().data.sensing
    request = Request(joint=load_joint(source), source=source, out=folder / kind, has_link=sensing.both_positions, has_torque=sensing.has_torque)
    progress(f"building and trying the {kind} FMU", 0.3)
    made = build(kind, request)
    target = folder / f"{kind}.fmu"
    next(path for path in made if path.suffix == ".fmu").replace(target)
    return target
