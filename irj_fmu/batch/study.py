"""Study files: which models run with which records and parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from identification.data.plain_text import from_toml
from identification.data.schema import finite, refuse_unknown
from identification.errors import InputError
from irj_fmu.batch.checks import Value, flag, names, table, value
from irj_fmu.batch.sampling import cases_of
from irj_fmu.batch.study_schema import FORMATS, INPUT, KINDS, MODEL, RECORDS, STUDY, TABLES
from irj_fmu.host.signals import Table


@final
@dataclass(frozen=True)
class ModelEntry:
    """One ``[[model]]``.

    Attributes
    ----------
    name : str
    path : Path
        FMU or joint file.
    kind : {"fmu", "plant", "estimator"}
        What `path` is, or what is built of it.
    add, drop : tuple of str
        Effects added to the joint file's and left out of them.
    values : mapping
        Parameters of all its runs.
    controller, motion, sensors : bool
        See `irj_fmu.plant.joint.PlantOptions`.
    """

    name: str
    path: Path
    kind: str
    add: tuple[str, ...] = ()
    drop: tuple[str, ...] = ()
    values: Mapping[str, Value] = field(default_factory=dict)
    controller: bool = False
    motion: bool = False
    sensors: bool = False


@final
@dataclass(frozen=True)
class Study:
    """A study file in memory; `cases` are the parameters of the runs of each model with each
    record.

    Attributes
    ----------
    source : Path
    name : str
    models : tuple of ModelEntry
    cases : tuple of mapping
    files : tuple of Path
        Records.
    columns : Path or None
        Column map of the records.
    start_state : bool
        Plants of joint files start where the record starts.
    inputs : mapping
        By input: a channel's name, a constant, or a table.
    compare : mapping
        Output to the channel it is compared with.
    step, stop : float or None
        [s]; None: as the record has it.
    record : tuple of str
        Variables; empty: all outputs.
    every, chunk : int
        Keep each n-th sample; runs in one portion, 0 for a choice by the number of runs.
    format : {"npz", "csv", "none"}
        Of the time series.
    """

    source: Path
    name: str
    models: tuple[ModelEntry, ...]
    cases: tuple[Mapping[str, Value], ...]
    files: tuple[Path, ...] = ()
    columns: Path | None = None
    start_state: bool = True
    inputs: Mapping[str, str | Table] = field(default_factory=dict)
    compare: Mapping[str, str] = field(default_factory=dict)
    step: float | None = None
    stop: float | None = None
    record: tuple[str, ...] = ()
    every: int = 1
    chunk: int = 0
    format: str = "npz"


def load_study(path: str | Path) -> Study:
    """Read a study file; paths in it are relative to its folder.

    Raises
    ------
    InputError
        One line: what is wrong, where, and what to write instead.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the path of a study file"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; a study file is TOML") from None
    data = from_toml(text, str(path))
    where = str(path)
    refuse_unknown(data, TABLES, where)
    study = table(data, "study", where)
    records = table(data, "records", where)
    given = STUDY.read(study, f"{where}: [study]")
    of_records = RECORDS.read(records, f"{where}: [records]")
    columns = of_records["columns"]
    return Study(
        source=path,
        name=" ".join((path.stem if given["name"] is None else given["name"]).split()),
        models=_models(data, path),
        cases=tuple(cases_of(data, where)),
        files=_files(records, path),
        columns=None if columns is None else path.parent / columns,
        start_state=of_records["start_state"],
        inputs={
            name: _input(name, entry, where) for name, entry in table(data, "inputs", where).items()
        },
        compare={
            name: _text(channel, f"{where}: [compare] {name}")
            for name, channel in table(data, "compare", where).items()
        },
        step=_positive(given["step"], f"{where}: [study] step"),
        stop=_positive(given["stop"], f"{where}: [study] stop"),
        record=names(study, "record", f"{where}: [study]"),
        every=_whole(study, "every", where, 1),
        chunk=_whole(study, "chunk", where, 0),
        format=given["format"],
    )


def _models(data: Mapping[str, Any], path: Path) -> tuple[ModelEntry, ...]:
    entries = data.get("model")
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f'{path}: no model; write [[model]] and below it fmu = "..." or joint = "..."'
        )
    found = [_model(entry, i, path) for i, entry in enumerate(entries, 1)]
    twice = {m.name for m in found if sum(m.name == other.name for other in found) > 1}
    if twice:
        raise InputError(
            f"{path}: two models are called {min(twice)!r}; give each a name of its own"
        )
    return tuple(found)


def _model(entry: Any, number: int, path: Path) -> ModelEntry:
    where = f"{path}: [[model]] {number}"
    if not isinstance(entry, Mapping):
        raise InputError(f"{where}: must be a table; write [[model]] on a line of its own")
    given = MODEL.read(entry, where)
    if ("fmu" in entry) == ("joint" in entry):
        raise InputError(f"{where}: give either fmu or joint")
    is_fmu = "fmu" in entry
    place = path.parent / _text(
        entry["fmu" if is_fmu else "joint"], f"{where}: {'fmu' if is_fmu else 'joint'}"
    )
    if is_fmu:
        for key in ("kind", "add", "drop", "controller", "motion", "sensors"):
            if key in entry:
                raise InputError(f"{where}: {key} goes with a joint file; an FMU is taken as it is")
    values = table(entry, "set", where)
    return ModelEntry(
        name=place.stem if given["name"] is None else given["name"],
        path=place,
        kind="fmu" if is_fmu else given["kind"],
        add=names(entry, "add", where),
        drop=names(entry, "drop", where),
        values={n: value(v, f"{where}: set {n}") for n, v in values.items()},
        **{key: given[key] for key in ("controller", "motion", "sensors")},
    )


def _files(records: Mapping[str, Any], path: Path) -> tuple[Path, ...]:
    """The records; a pattern stands for all files it fits, in the order of their names."""
    found: list[Path] = []
    for name in names(records, "files", f"{path}: [records]"):
        if any(sign in name for sign in "*?["):
            place = path.parent / name
            fits = sorted(
                Path(place.anchor or ".").glob(
                    str(place.relative_to(place.anchor)) if place.anchor else str(place)
                )
            )
            if not fits:
                raise InputError(f"{path}: [records] files: nothing fits {name!r}")
            found += fits
        elif not (path.parent / name).is_file():
            raise InputError(
                f"{path}: [records] files: there is no {name!r}; paths are relative to the study "
                "file"
            )
        else:
            found.append(path.parent / name)
    if records and not found:
        raise InputError(f'{path}: [records] has no files; write files = ["run1.csv"]')
    return tuple(found)


def _input(name: str, entry: Any, where: str) -> str | Table:
    """A channel's name, or a signal."""
    import numpy as np

    where = f"{where}: [inputs] {name}"
    if isinstance(entry, str):
        return entry
    if not isinstance(entry, Mapping):
        return Table(np.zeros(1), np.array([finite(entry, where)]))
    INPUT.check(entry, where)
    columns = [entry.get(key) for key in ("time", "value")]
    if not all(isinstance(column, list) for column in columns):
        raise InputError(
            f"{where}: give a channel's name, a number, or {{ time = [...], value = [...] }}"
        )
    arrays = [np.array([finite(v, where) for v in column or []]) for column in columns]
    try:
        return Table(arrays[0], arrays[1], flag(entry, "hold", where, True))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _text(entry: Any, where: str) -> str:
    if not isinstance(entry, str) or not entry:
        raise InputError(f"{where}: {entry!r} is not a text; write it in quotes")
    return entry


def _positive(value: float | None, where: str) -> float | None:
    if value is not None and value <= 0:
        raise InputError(f"{where} = {value:g} is not positive")
    return value


def _whole(entry: Mapping[str, Any], key: str, where: str, default: int) -> int:
    found = entry.get(key, default)
    if (
        isinstance(found, bool)
        or not isinstance(found, int)
        or found < min(default, 1)
        or (key in entry and found < 1)
    ):
        raise InputError(f"{where}: [study] {key} = {found!r} is not a whole number of at least 1")
    return found


__all__: Sequence[str] = ("FORMATS", "KINDS", "ModelEntry", "Study", "Value", "load_study")
