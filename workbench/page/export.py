"""What the user takes home: joint file, report, FMU, and Python that does the session again."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from identification.data.joint_file import column_lines
from identification.data.plain_text import from_toml
from identification.diagnosis.improve import HOLD_DELAY
from identification.errors import InputError
from workbench.page.analysis import Progress
from workbench.page.desk.curves import story_of
from workbench.page.jobs.place import Place, confirmed_map, folder_of
from workbench.page.report import improvement_of, records_of
from workbench.page.session import FileEntry, State, StepEntry, write_atomic


def session_code(state: State) -> str:
    """The session as a Python script: the same records, joint and steps, and the same errors."""
    ready = [f for f in state.files if f.status == "ready"]
    linear = 'kind = "linear"' in state.joint_text
    lines = [
        '"""The session of the workbench as a script. Run it in the folder of the measurement '
        'files."""',
        "import tomllib",
        "",
        "from identification import fit, read",
        "from identification.data.check.checks import repair",
        "from identification.diagnosis.improve import with_held_out",
        "from identification.data.joint_file import parse_joint",
        "",
        f"joint = parse_joint(tomllib.loads({_literal(state.joint_text)}))",
        "",
    ]
    for role in ("train", "held_out"):
        lines += [f"{role} = ["]
        lines += [f"    repair({_read_call(f, linear)})," for f in ready if f.role == role]
        lines += ["]"]
    lines += ["train, held_out, note = with_held_out(train, held_out)", ""]
    if not state.steps:
        return "\n".join(lines)
    lines += [
        "fitted = fit(joint, train, held_out=held_out)",
        'print("start", fitted.held_out.relative_error_percent)',
    ]
    for before, step in zip(state.steps[:-1], state.steps[1:], strict=True):
        lines += _step_lines(
            before.effects,
            step.effects,
            step.label or "",
            step.virtual_work != before.virtual_work,
            step.virtual_work,
        )
    lines += [
        "",
        'with open("fitted.toml", "w", encoding="utf-8") as stream:',
        "    stream.write(fitted.to_joint_file())",
    ]
    return "\n".join(lines) + "\n"


def _literal(text: str) -> str:
    """A text as Python: readable where it can stand between triple quotes, which a joint file
    must not be able to end.
    """
    plain = text.strip().replace("\r", "")
    return repr(plain) if '"""' in plain or "\\" in plain else f'"""\n{plain}\n"""'


def _step_lines(
    before: tuple[str, ...], after: tuple[str, ...], label: str, changed: bool, virtual_work: bool
) -> list[str]:
    lines = ["model = fitted.model"]
    lines += [
        f"model = model.drop({name!r})"
        for name in before
        if name not in after and name != HOLD_DELAY
    ]
    lines += [
        f"model = model.add({name!r})"
        for name in after
        if name not in before and name != HOLD_DELAY
    ]
    if changed:
        lines += [
            "from dataclasses import replace",
            f"model = replace(model, virtual_work={virtual_work})",
        ]
    lines += [
        "fitted = fit(model, train, joint=joint, held_out=held_out)",
        f"print({label!r}, fitted.held_out.relative_error_percent)",
    ]
    return lines


def _read_call(entry: FileEntry, linear: bool) -> str:
    kind = ', kind="linear"' if linear else ""
    columns = f", columns={_plain(entry.columns)!r}" if entry.columns else ", columns=joint.columns"
    return f"read({entry.name!r}{columns}{kind})"


def _plain(columns: Mapping[str, Any]) -> dict[str, Any]:
    return {k: dict(v) if isinstance(v, Mapping) else v for k, v in columns.items()}


def joint_file(live: Place) -> str:
    """The fitted joint, or the joint as it was given where nothing is fitted yet; with the column
    map that was confirmed for its records, so that the command line reads them with it.
    """
    state = live.state
    if not state.steps:
        return _given(state)
    story = story_of(state)
    if story.get("joint_text"):
        return str(story["joint_text"])  # with the curves that the loop has learned
    return live.analysis().to_joint_file()


def _given(state: State) -> str:
    """The joint file as it was typed, and the map behind it where it has none."""
    columns = confirmed_map(state)
    if not columns or not state.joint_text:
        return state.joint_text
    if "columns" in from_toml(state.joint_text, state.joint_source or "joint"):
        return state.joint_text
    return "\n".join([state.joint_text.rstrip("\n"), "", *column_lines(columns), ""])


def report_available() -> bool:
    """Whether the report writer is there."""
    return importlib.util.find_spec("workbench.show.report") is not None


def fmu_available() -> bool:
    """Whether the FMU builder is there."""
    return importlib.util.find_spec("irj_fmu.build") is not None


def report(
    live: Place,
    steps: Sequence[StepEntry],
    progress: Progress,
    *,
    author: str = "",
    notes: str = "",
) -> Path:
    """Write the HTML report of the session into its folder.

    Parameters
    ----------
    live : Place
    steps : sequence of StepEntry
        The ledger.
    progress : callable
    author, notes : str
        For the first page, as of ``irj report``.
    """
    from workbench.show.report import write_report

    analysis = live.analysis()
    result = improvement_of(analysis, steps, progress)
    progress("writing the report", 0.95)
    train, held = records_of(analysis, steps)
    path = folder_of(live) / "report.html"
    return write_report(result, path, records=(*train, *held), author=author, notes=notes)


def fmu(live: Place, folder: Path, progress: Progress, kind: str = "plant") -> Path:
    """Build the FMU of the fitted joint (``plant``) or of its online estimator (``estimator``) into
    a folder.

    The build has a process of its own, beside the one that waits for it: ended together.
    """
    source = folder / f"{kind}.toml"
    write_atomic(source, joint_file(live).encode())
    sensing = live.analysis().data.sensing
    arguments = [kind, "--joint", str(source), "--out", str(folder / kind)]
    arguments += [] if sensing.both_positions else ["--no-link"]
    arguments += [] if sensing.has_torque else ["--no-torque"]
    progress(f"building and trying the {kind} FMU", 0.3)
    _apart(
        "from irj_fmu.build import main; import sys; raise SystemExit(main(sys.argv[1:]))",
        arguments,
        folder,
    )
    target = folder / f"{kind}.fmu"
    made = sorted((folder / kind).glob("*.fmu"), key=lambda path: path.stat().st_mtime)
    if not made:
        raise InputError(f"{kind}: nothing was built; run: irj export {kind} --joint FILE")
    made[-1].replace(target)
    return target


def _apart(code: str, arguments: Sequence[str], folder: Path) -> None:
    """Run Python code in a process of its own; it is of this process's group, and ends with that.

    Raises
    ------
    InputError
        The last line it wrote, where it failed.
    """
    root = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    with tempfile.TemporaryFile(dir=folder) as said:
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            env={**os.environ, "PYTHONPATH": paths},
        )
        try:
            while process.poll() is None:
                time.sleep(0.05)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        if process.returncode:
            said.seek(0)
            lines = said.read().decode(errors="replace").strip().splitlines()
            raise InputError(lines[-1] if lines else f"the build ended with {process.returncode}")
