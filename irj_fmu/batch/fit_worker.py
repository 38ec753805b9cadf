"""What a worker does with one job of a study that fits; everything here can be pickled."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, final

from casadi_models import EFFECTS
from identification.data.joint_file import Joint, load_joint
from identification.data.read import read
from identification.data.record import Record
from identification.diagnosis.improve import improve
from identification.errors import InputError
from identification.fitting.fit import fit
from identification.variants.explore import explore
from irj_fmu.batch.found import Found, explored
from irj_fmu.command_line import finite
from irj_fmu.host.fmu import FmuError

File = tuple[str, bytes]


@final
@dataclass(frozen=True)
class Parcel:
    """A job with the content of its files.

    Attributes
    ----------
    task : {"fit", "improve", "explore"}
    name : str
    joint : (str, bytes)
        Name and content.
    records, held_out, own_effects : tuple of (str, bytes)
    fmu : (str, bytes) or None
        Whole path and content of the FMU that the joint file names as its model.
    """

    task: str
    name: str
    joint: File
    records: tuple[File, ...]
    held_out: tuple[File, ...] = ()
    own_effects: tuple[File, ...] = ()
    fmu: File | None = None


@final
@dataclass(frozen=True)
class Answer:
    """What a job gave.

    Attributes
    ----------
    reason : str
        Why there is no result; empty where there is one.
    seconds : float
    figures : mapping
        For the summary.
    parameters : mapping
        The parameter table.
    joint : str
        Text of the joint file.
    result : mapping
        The whole, as `--json` gives it.
    """

    reason: str = ""
    seconds: float = 0.0
    figures: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    joint: str = ""
    result: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """All of it as data."""
        return {
            "reason": self.reason,
            "seconds": self.seconds,
            "figures": dict(self.figures),
            "parameters": dict(self.parameters),
            "joint": self.joint,
            "result": dict(self.result),
        }


def answered(parcel: Parcel) -> Answer:
    """Do one job; whatever goes wrong in it is its answer and ends no other."""
    begin = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory(prefix="irj-fit-") as folder:
            found = _done(parcel, Path(folder))
    except (InputError, FmuError) as error:
        return Answer(reason=" ".join(str(error).split()), seconds=time.perf_counter() - begin)
    except Exception as error:  # one job's failure, whatever it is, must not end the others
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Answer(reason=text, seconds=time.perf_counter() - begin)
    figures, parameters, text, result = found
    return Answer(
        "",
        time.perf_counter() - begin,
        figures=finite(figures),
        parameters=finite(parameters),
        joint=text,
        result=finite(result),
    )


def _done(parcel: Parcel, folder: Path) -> Found:
    """The task of a parcel, its files in a folder."""
    there = {f.code for f in EFFECTS.files}
    for name, code in parcel.own_effects:
        if code not in there:
            EFFECTS.load_code(folder / name, code, tried=True)
    place = folder / parcel.joint[0]
    place.write_bytes(parcel.joint[1])
    task: Callable[[list[Record], list[Record]], Found]
    if parcel.fmu is None:
        joint = load_joint(place)
        task = partial(_TASKS[parcel.task], joint)
    else:
        from irj_fmu.batch.user_tasks import user_task

        joint, task = user_task(parcel.task, place, parcel.fmu)

    def opened(files: Sequence[File], part: str) -> list[Record]:
        out = []
        for number, (name, content) in enumerate(files):
            path = folder / f"{part}{number}" / name
            path.parent.mkdir()
            path.write_bytes(content)
            try:
                out.append(read(path, columns=joint.columns, kind=joint.kind))
            except InputError as error:
                raise InputError(str(error).replace(f"{path.parent}/", "")) from None
        return out

    return task(opened(parcel.records, "train"), opened(parcel.held_out, "held"))


def _fit(joint: Joint, train: list[Record], held: list[Record]) -> Found:
    found = fit(joint, train, held_out=held)
    figures = {
        "relative_error_percent": found.train.relative_error_percent,
        "held_out_error_percent": found.held_out.relative_error_percent if found.held_out else None,
    }
    return figures, found.parameters, found.to_joint_file(), found.as_json()


def _improve(joint: Joint, train: list[Record], held: list[Record]) -> Found:
    found = improve(train, joint, held)
    result = found.as_json()
    figures = {
        "start_error_percent": found.steps[0].held_out.relative_error_percent,
        "end_error_percent": found.steps[-1].held_out.relative_error_percent,
        "added": " ".join(found.added),
        "verdict": found.verdict,
    }
    return figures, result["steps"][-1]["parameters"], found.to_joint_file(), result


def _explore(joint: Joint, train: list[Record], held: list[Record]) -> Found:
    found = explore(train, joint, held)
    return explored(found), found.parameters, found.to_joint_file(), found.as_json()


_TASKS: Final[Mapping[str, Callable[[Joint, list[Record], list[Record]], Found]]] = {
    "fit": _fit,
    "improve": _improve,
    "explore": _explore,
}
