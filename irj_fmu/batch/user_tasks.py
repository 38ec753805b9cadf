"""What a job of a study that fits does where the joint file's model is a user's FMU."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from identification.data.check.gate import gated
from identification.data.joint_file import Joint
from identification.data.record import Record
from irj_fmu.batch.found import Found, explored
from irj_fmu.imported.compare import compare
from irj_fmu.imported.file import load_user_joint, user_joint_text
from irj_fmu.imported.fit import fit, parameter_table
from irj_fmu.imported.improve import improve
from irj_fmu.imported.model import UserModel
from irj_fmu.imported.outputs import UserComparison
from irj_fmu.imported.verbs.explore import explore

Task = Callable[[UserModel, Sequence[Record], Sequence[Record], str], Found]


def _fit(model: UserModel, train: Sequence[Record], held: Sequence[Record], known: str) -> Found:
    found = fit(model, gated(list(train), model.joint))
    apart = compare(found, gated(list(held), model.joint)) if held else None
    figures = {
        "relative_error_percent": _error(found.train),
        "held_out_error_percent": None if apart is None else _error(apart),
    }
    text = user_joint_text(found.model, found.stderr, named=known)
    return figures, _with_side(found.parameters), text, found.as_json()


def _improve(
    model: UserModel, train: Sequence[Record], held: Sequence[Record], known: str
) -> Found:
    found = improve(model, train, held)
    steps = found.found.steps
    figures = {
        "start_error_percent": steps[0].held_out.relative_error_percent,
        "end_error_percent": steps[-1].held_out.relative_error_percent,
        "added": " ".join(found.found.added),
        "verdict": found.found.verdict,
    }
    text = user_joint_text(found.model, found.stderr, named=known)
    return figures, _with_side(found.parameters), text, found.as_json()


def _explore(
    model: UserModel, train: Sequence[Record], held: Sequence[Record], known: str
) -> Found:
    told = explore(model, train, held)
    table = parameter_table(told.model, {})
    return (
        explored(told.found),
        _with_side(table),
        user_joint_text(told.model, named=known),
        told.as_json(),
    )


def _error(outputs: UserComparison) -> float:
    """Relative error of the outputs, RMS over them [%]."""
    return float(np.sqrt(np.mean([e.relative_error_percent**2 for e in outputs.outputs.values()])))


def _with_side(table: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """A parameter table with the side that an FMU does not tell."""
    return {name: {**row, "side": ""} for name, row in table.items()}


_TASKS: Final[Mapping[str, Task]] = {"fit": _fit, "improve": _improve, "explore": _explore}


def user_task(
    name: str, joint: Path, fmu: tuple[str, bytes]
) -> tuple[Joint, Callable[[list[Record], list[Record]], Found]]:
    """The joint of a file whose model is an FMU, and what is done with its records.

    Parameters
    ----------
    name : {"fit", "improve", "explore"}
    joint : Path
        The joint file.
    fmu : (str, bytes)
        Whole path of the FMU, which the joint file that is written names, and its content.
    """
    known, content = fmu
    place = joint.parent / "model" / Path(known).name
    place.parent.mkdir()
    place.write_bytes(content)
    model = load_user_joint(joint, place)

    def done(train: list[Record], held: list[Record]) -> Found:
        return _TASKS[name](model, train, held, known)

    return model.joint, done


__all__ = ["user_task"]
