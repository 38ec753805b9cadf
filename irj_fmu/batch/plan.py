"""From a study to batches: build the models, read the records, feed the inputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, final

import numpy as np

from identification.data.joint_file import Joint, load_joint, toml_text
from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.batch.checks import Value
from irj_fmu.batch.fleet import Batch
from irj_fmu.batch.fleet import check as check_batch
from irj_fmu.batch.study import ModelEntry, Study
from irj_fmu.batch.user_plant import UserPlant, user_plant
from irj_fmu.host.run import Fmu
from irj_fmu.host.signals import Table
from irj_fmu.imported.file_schema import fmu_of

CHANNELS: Final = {
    "i_m": "motor_current",
    "tau_m": "motor_torque",
    "q_m": "motor_position",
    "w_m": "motor_velocity",
    "q_l": "link_position",
    "w_l": "link_velocity",
    "tau_l": "link_torque",
}
"""Inputs of the project's FMUs and the channels that feed them; an input with a channel's name
is fed by that channel.
"""
CHUNKS: Final = 64
"""Portions that a study is cut into where it does not say how."""
_CHUNK_BYTES: Final = 64e6
Say = Callable[[str], object]


@final
@dataclass(frozen=True)
class Planned:
    """One model with one record and all cases; `record` is empty where there is none."""

    model: str
    record: str
    batch: Batch


@final
@dataclass(frozen=True)
class _Model:
    entry: ModelEntry
    fmu: Path
    joint: Joint | None
    user: UserPlant | None = None


def plan(study: Study, folder: Path, say: Say = lambda _text: None) -> list[Planned]:
    """Make everything ready to run.

    Parameters
    ----------
    study : Study
    folder : Path
        Where FMUs of joint files are built.
    say : callable
        Called with one sentence per doubt about a record.

    Returns
    -------
    list of Planned
        Every model with every record.

    Raises
    ------
    InputError
        A file that cannot be used, a name that an FMU or a record does not have.
    """
    models = [_made(entry, study, folder) for entry in study.models]
    for model in models:
        built = None if model.user is not None else model.joint
        if built is not None and not built.fitted and model.entry.kind == "plant":
            say(f"{model.entry.path}: has no fitted values; its plant starts from usual ones")
    runs: list[tuple[str, Record] | None] = [
        run for path in study.files for run in _read(path, study, models, say)
    ]
    planned = [_planned(model, run, study) for model in models for run in runs or [None]]
    for name in study.inputs:
        if not any(name in item.batch.inputs for item in planned):
            raise InputError(f"{study.source}: [inputs] {name}: no model has such an input")
    total = sum(len(p.batch.cases) for p in planned)
    found = []
    for item in planned:
        batch = replace(item.batch, chunk=study.chunk or _chunk(item.batch, total))
        try:
            check_batch(batch)
        except InputError as error:
            raise InputError(f"{study.source}: model {item.model!r}: {error}") from None
        found.append(replace(item, batch=batch))
    return found


def _chunk(batch: Batch, total: int) -> int:
    size = 8.0 * max(1, len(batch.record)) * (round(batch.stop / batch.step) // batch.every + 1)
    return max(1, min(20, math.ceil(total / CHUNKS), int(_CHUNK_BYTES / size)))


# --- models ---------------------------------------------------------------------------------------


def _made(entry: ModelEntry, study: Study, folder: Path) -> _Model:
    where = f"{study.source}: model {entry.name!r}"
    if entry.kind == "fmu":
        if not entry.path.is_file():
            raise InputError(
                f"{where}: there is no FMU {entry.path}; paths are relative to the study file"
            )
        return _Model(entry, entry.path, None)
    of_user = fmu_of(entry.path) is not None
    joint = None if of_user else _changed(load_joint(entry.path), entry, where)
    name = f"model-{study.models.index(entry) + 1}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be made ({error.strerror}); choose a writable folder with --out"
        ) from None
    try:
        if joint is None:
            found = user_plant(entry, folder / f"{name}.fmu")
            return _Model(entry, found.fmu, found.model.joint, found)
        return _Model(
            entry,
            _plant(joint, entry, folder / f"{name}.fmu")
            if entry.kind == "plant"
            else _estimator(joint, name, folder),
            joint,
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _changed(joint: Joint, entry: ModelEntry, where: str) -> Joint:
    """The joint with effects added and left out."""
    for label in entry.drop:
        kept = tuple(e for e in joint.effects if label not in (e, e.partition("@")[0]))
        if kept == joint.effects:
            raise InputError(
                f"{where}: drop {label!r}: the joint file has effects "
                f"{', '.join(joint.effects) or 'none'}"
            )
        joint = replace(joint, effects=kept)
    for label in entry.add:
        try:
            joint.model().add(label)
        except (KeyError, ValueError) as error:
            raise InputError(f"{where}: add {label!r}: {error.args[0]}") from None
        joint = replace(joint, effects=(*joint.effects, label))
    own = set(joint.model().parameter_names)
    return replace(joint, fitted={k: v for k, v in joint.fitted.items() if k in own})


def _plant(joint: Joint, entry: ModelEntry, out: Path) -> Path:
    from irj_fmu.plant.joint import PlantOptions, plant_spec
    from irj_fmu.plant.library import build_plant
    from irj_fmu.plant.reference import Motion

    motion = Motion() if entry.motion else None
    options = PlantOptions(
        controller=entry.controller or entry.motion,
        motion=motion,
        sensors=entry.sensors,
        name=out.stem.replace("-", "_"),
    )
    return build_plant(plant_spec(joint, options), out)


def _estimator(joint: Joint, name: str, folder: Path) -> Path:
    from irj_fmu.build import Request, build

    source = folder / f"{name}.toml"
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in joint.fitted.items()}
    source.write_text(toml_text(joint, values), encoding="utf-8")
    (made,) = build(
        "estimator", Request(replace(joint, name=name.replace("-", "_")), source, folder)
    )
    return made


# --- records --------------------------------------------------------------------------------------


def _read(path: Path, study: Study, models: Sequence[_Model], say: Say) -> list[tuple[str, Record]]:
    """The contiguous stretches of a record, through the check gate."""
    from identification.data.check.checks import gate
    from identification.data.read import read

    joint = next((model.joint for model in models if model.joint is not None), None)
    columns = (
        study.columns
        if study.columns is not None
        else (joint.columns if joint is not None else None)
    )
    record = read(path, columns=columns, kind=joint.kind if joint is not None else None)
    try:
        record, findings = gate(record, joint.gear_ratio if joint is not None else None)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(record.name + ': ')}") from None
    for finding in findings:
        if finding.severity in ("warn", "repair"):
            say(f"{path}: {finding.message.removeprefix(record.name + ': ')}")
    stretches = [record.take(rows) for rows in record.segments() if rows.stop - rows.start > 1]
    name = path.stem if sum(path.stem == other.stem for other in study.files) == 1 else str(path)
    if len(stretches) == 1:
        return [(name, stretches[0])]
    return [(f"{name}#{i}", stretch) for i, stretch in enumerate(stretches, 1)]


def _planned(model: _Model, run: tuple[str, Record] | None, study: Study) -> Planned:
    where = f"{study.source}: model {model.entry.name!r}"
    record = run[1] if run is not None else None
    with Fmu(model.fmu) as fmu:
        step = study.step or (
            record.dt
            if record is not None
            else float(getattr(fmu.description.defaultExperiment, "stepSize", None) or 1e-3)
        )
        names = study.record or tuple(
            v.name
            for v in fmu.variables.values()
            if v.causality == "output" and fmu.carries(v.name)
        )
        fixed: dict[str, Value] = {}
        inputs: dict[str, Table] = {}
        if model.user is not None:
            fixed |= model.user.start(record, state=study.start_state)
        elif record is not None:
            fixed |= _start_state(model, record, fmu) if study.start_state else {}
            if model.entry.kind == "estimator" and abs(step - 1e-3) > 1e-9:
                fixed["sample_time"] = step
        if model.user is not None and record is not None:
            inputs |= model.user.fed(record)
        for name, variable in fmu.variables.items():
            if variable.causality == "input":
                inputs |= _fed(name, study, record, where)
        if (
            record is not None
            and model.user is None
            and not model.entry.motion
            and not any(
                isinstance(study.inputs.get(n, ""), str) and not n.startswith("valid.")
                for n in inputs
            )
        ):
            raise InputError(
                f'{where}: no input is fed by the records; write [inputs] with input = "channel"'
            )
        measured = {} if record is None else _measured(names, study, record, fmu, where)
        if model.user is not None and record is not None:
            measured = {**model.user.measured(record, tuple(names)), **measured}
    if study.stop is None and record is None:
        raise InputError(f"{study.source}: [study] has no stop; give the length in s")
    stop = study.stop or float(record.time[-1] - record.time[0] if record is not None else 0.0)
    whole = round(stop / step)
    if study.stop is not None and abs(whole * step - stop) > 1e-3 * step:
        raise InputError(
            f"{study.source}: [study] stop = {stop:g} s is not a whole number of steps of "
            f"{step:g} s; change stop, or give step"
        )
    cases = [{**fixed, **model.entry.values, **case} for case in study.cases]
    batch = Batch(
        model.fmu,
        cases,
        record=names,
        inputs=inputs,
        step=step,
        stop=max(whole, 1) * step,
        chunk=1,
        every=study.every,
        measured=measured,
    )
    return Planned(model.entry.name, run[0] if run is not None else "", batch)


def _fed(name: str, study: Study, record: Record | None, where: str) -> dict[str, Table]:
    """What feeds an input: what the study says, or the channel that belongs to it."""
    said = study.inputs.get(name)
    if isinstance(said, Table):
        return {name: said}
    if record is None:
        if said is not None:
            raise InputError(
                f"{where}: input {name} is fed by channel {said}, but the study has no [records]"
            )
        return {}
    channel = said or CHANNELS.get(name, name)
    if record.has(channel):
        return {name: Table(record.time - record.time[0], record[channel])}
    if said is not None:
        raise InputError(
            f"{where}: record {record.name} has no channel {said}; it has "
            f"{', '.join(record.channels)}"
        )
    sensor = CHANNELS.get(name.removeprefix("valid."), "") if name.startswith("valid.") else ""
    if sensor and not record.has(sensor) and name.removeprefix("valid.") not in study.inputs:
        return {name: Table(np.zeros(1), np.zeros(1))}
    return {}


def _start_state(model: _Model, record: Record, fmu: Fmu) -> dict[str, Value]:
    """First readings as the state of a plant; states are link-referred, motor readings on the
    motor shaft.
    """
    if model.joint is None or model.entry.kind != "plant":
        return {}
    found: dict[str, Value] = {}
    for rate in ("position", "velocity"):
        values = {
            side: float(record[f"{side}_{rate}"][0])
            / (model.joint.gear_ratio if side == "motor" else 1.0)
            for side in ("motor", "link")
            if record.has(f"{side}_{rate}")
        }
        if not values:
            continue
        first = next(iter(values.values()))
        found |= {f"state.{side}_{rate}": values.get(side, first) for side in ("motor", "link")}
        found[f"state.{rate}"] = values.get("link", first)
    return {name: value for name, value in found.items() if name in fmu.variables}


def _measured(
    names: Sequence[str], study: Study, record: Record, fmu: Fmu, where: str
) -> dict[str, Table]:
    """Measured signals by output: what the study says, and channels with the name of an output."""
    pairs: Mapping[str, str] = {
        **{n: n for n in names if record.has(n) and fmu.variable(n).causality == "output"},
        **study.compare,
    }
    for name, channel in pairs.items():
        if name not in names:
            raise InputError(
                f"{where}: [compare] {name} is not recorded; add it to record in [study]"
            )
        if not record.has(channel):
            raise InputError(
                f"{where}: [compare] record {record.name} has no channel {channel}; it has "
                f"{', '.join(record.channels)}"
            )
    return {
        name: Table(record.time - record.time[0], record[channel], hold=False)
        for name, channel in pairs.items()
    }


__all__ = ["CHANNELS", "Planned", "plan"]
