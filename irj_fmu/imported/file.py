"""A joint file whose model is a user's FMU: ``[model] fmu = "axis.fmu"`` beside ``[joint]``; its
tables are declared in :mod:`irj_fmu.imported.file_schema`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from casadi_models import JointModel
from casadi_models.term import TOTAL_INERTIA
from identification.data.joint_file import Joint, parse_joint, toml_text
from identification.data.own_effects import TABLE
from identification.data.plain_text import from_toml, toml_key, toml_string, toml_value
from identification.data.schema import finite, meant
from identification.data.typed_laws import LAWS
from identification.errors import InputError
from irj_fmu.imported.correction import PREFIX, Correction, correction_of
from irj_fmu.imported.file_schema import BOUNDS, CHANNEL, MODEL, START
from irj_fmu.imported.model import Bounds, Mapped, UserModel, load_user_model
from irj_fmu.imported.port import noted

_TABLES: Final = ("joint", "model", "columns", "fitted", "provenance", TABLE, LAWS)
_ENTRY: Final = {"channels": ("variable", CHANNEL), "start": ("channel", START)}


def is_user_joint(path: str | Path) -> bool:
    """True where a file is TOML with a table ``[model]``; a file that cannot be read is left to
    others to refuse.
    """
    try:
        return "model" in from_toml(Path(path).read_text(encoding="utf-8-sig"), str(path))
    except (OSError, ValueError):
        return False


def load_user_joint(path: str | Path, fmu: str | Path | None = None) -> UserModel:
    """Read a joint file whose model is a user's FMU.

    Parameters
    ----------
    path : str or Path
    fmu : str or Path, optional
        Where the FMU lies, in place of what the file says.

    Raises
    ------
    InputError
        One line: what is wrong, where, and what to write instead.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(
            f"{path}: cannot be read as a joint file ({why}); give the path of a TOML file"
        ) from None
    data = from_toml(text, str(path))
    for key, value in data.items():
        if key not in _TABLES:
            raise InputError(
                f"{path}: unknown table [{key}]; with an FMU as the model there are "
                f"[{'], ['.join(_TABLES)}]{meant(key, _TABLES)}"
            )
        if not isinstance(value, Mapping):
            raise InputError(f"{path}: {key} must be a table, as [{key}] on a line of its own")
    table = data.get("model")
    if not isinstance(table, Mapping):
        raise InputError(f'{path}: no [model] table; write [model] with fmu = "file.fmu"')
    MODEL.check(table, f"{path}: [model]")
    if "fmu" not in table:
        raise InputError(f'{path}: [model] has no fmu; write fmu = "file.fmu"')
    named = table["fmu"]
    if not isinstance(named, str) or not named.strip() or "\0" in named:
        raise InputError(
            f"{path}: [model] fmu = {_shown(named)} is not the name of an FMU; write fmu "
            '= "file.fmu"'
        )
    rest = {k: v for k, v in data.items() if k in ("joint", "columns", TABLE, LAWS)}
    joint = parse_joint({**rest, "joint": {**rest.get("joint", {}), "model": "hd1"}}, str(path))
    place = path.parent / named if fmu is None else Path(fmu)
    fitted = {str(k): _value(v, f"{path}: [fitted] {k}") for k, v in data.get("fitted", {}).items()}
    channels, bounds, start = (
        _pairs(table, "channels", path),
        _bounds(table, path),
        _pairs(table, "start", path),
    )
    window, hold = (
        _number(table.get("window"), f"{path}: [model] window"),
        MODEL["hold"].read(table, f"{path}: [model]"),
    )
    try:
        model = load_user_model(
            place,
            channels,
            bounds,
            start=start,
            joint=joint,
            window=window,
            hold=hold,
            kind=table.get("kind"),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    outside = _outside(table.get("outside", []), joint, fitted, path)
    coupling = _number(table.get("coupling"), f"{path}: [model] coupling")
    made = noted(replace(model, correction=outside, coupling=coupling))
    strangers = [k for k in fitted if k not in made.values and not k.startswith(PREFIX)]
    note = (
        f"{path}: [fitted] {', '.join(strangers)}: [model.parameters] has no such name; the "
        "value is left out"
    )
    return replace(made, notes=(*made.notes, note) if strangers else made.notes).with_values(fitted)


def _value(entry: Any, where: str) -> float:
    return finite(entry.get("value") if isinstance(entry, Mapping) else entry, where)


def _number(value: Any, where: str) -> float | None:
    if value is None:
        return None
    found = finite(value, where)
    if found <= 0:
        raise InputError(f"{where} = {found:g} must be above 0")
    return found


def _scale(value: Any, where: str) -> float:
    found = finite(value, where)
    if found == 0:
        raise InputError(
            f"{where} = 0 would leave nothing of it; give variable / channel, or leave the scale "
            "out"
        )
    return found


def _shown(value: Any) -> str:
    """A value as it stands in a joint file."""
    return toml_value(value)


def _pairs(table: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    """Entries as names, (name, scale) or numbers."""
    found: dict[str, Any] = {}
    word, schema = _ENTRY[name]
    for key, entry in _table(table, name, path).items():
        where = f"{path}: [model.{name}] {key}"
        if isinstance(entry, Mapping):
            other = entry.get(word)
            if not isinstance(other, str) or set(entry) - set(schema.names):
                raise InputError(
                    f"{where} must be a name or a table with {' and '.join(schema.names)}"
                )
            found[key] = (
                (other, _scale(entry["scale"], f"{where} scale")) if "scale" in entry else other
            )
        elif isinstance(entry, str) or (name == "start" and isinstance(entry, bool)):
            found[key] = entry
        elif name == "start" and isinstance(entry, int | float):
            finite(entry, where)
            found[key] = entry
        else:
            raise InputError(f"{where} = {entry!r}; give the name of a {word}")
    return found


def _table(table: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    found = table.get(name, {})
    if not isinstance(found, Mapping):
        raise InputError(
            f"{path}: [model] {name} must be a table, as [model.{name}] on a line of its own"
        )
    return found


def _bounds(table: Mapping[str, Any], path: Path) -> dict[str, Bounds]:
    found: dict[str, Bounds] = {}
    for name, entry in _table(table, "parameters", path).items():
        where = f"{path}: [model.parameters] {name}"
        if not isinstance(entry, Mapping) or set(entry) - set(BOUNDS.names):
            raise InputError(f"{where} must be a table with low and high, or {{}}")
        low, high = (
            finite(entry[k], f"{where} {k}") if k in entry else None for k in ("low", "high")
        )
        found[name] = (low, high)
    return found


def _outside(
    labels: Any, joint: Joint, fitted: Mapping[str, float], path: Path
) -> Correction | None:
    """Effects outside the FMU, with their values."""
    if not isinstance(labels, list) or not all(isinstance(e, str) for e in labels):
        raise InputError(
            f'{path}: [model] outside must be a list of effects, as outside = ["stribeck@motor"]'
        )
    return outside_correction(labels, joint, fitted, str(path)) if labels else None


def outside_correction(
    labels: list[str], joint: Joint, values: Mapping[str, float], source: str
) -> Correction:
    """A correction from labels of effects and values under outside names.

    Raises
    ------
    InputError
        An effect that is not in the library or cannot ride outside.
    """
    model = JointModel(
        gear_ratio=joint.gear_ratio, inertias=TOTAL_INERTIA, kind=joint.kind, load_from="gravity"
    )
    try:
        for label in labels:
            model = model.add(label)
    except (KeyError, ValueError) as error:
        raise InputError(f"{source}: {error.args[0]}") from None
    wrong = [t.label for t in model.terms if t.effect.family not in ("friction", "torque")]
    if wrong:
        raise InputError(
            f"{source}: {', '.join(wrong)} cannot ride outside an FMU; only friction and torques "
            "can"
        )
    own = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    own |= {
        k.removeprefix(PREFIX): v
        for k, v in values.items()
        if k.startswith(PREFIX) and k.removeprefix(PREFIX) in own
    }
    made = correction_of(model, tuple(t.label for t in model.terms), own)
    # the shapes of a file are no trial's; a smoothing velocity stays bounded, as with a step for a
    # slope the torque would have to be read at ever shorter times
    smooth = made.model.named("smoothing")
    return replace(made, shapes={n: x for n, x in made.shapes.items() if n in smooth})


def fmu_named(path: Path, folder: Path | None) -> str:
    """What a joint file in a folder calls an FMU: beside it its name, so that both may move."""
    beside = folder is not None and path.parent == folder.resolve()
    return path.name if beside else str(path)


def user_joint_text(
    model: UserModel,
    stderr: Mapping[str, float | None] = MappingProxyType({}),
    folder: Path | None = None,
    *,
    named: str = "",
) -> str:
    """The model as the text of a joint file, with fitted values and standard errors.

    Parameters
    ----------
    model : UserModel
    stderr : mapping of str to float or None, optional
        Standard errors that are written beside the values, in the same units.
    folder : Path, optional
        Where the file goes, see :func:`fmu_named`.
    named : str, optional
        What the file calls the FMU, where that is not where it lies.
    """
    head = toml_text(
        replace(model.joint, model_name="hd1", known={}, fitted={}),
        outside=model.correction.labels if model.correction else (),
    )
    body = "\n".join(line for line in head.splitlines() if not line.startswith("model = "))
    name = named or fmu_named(model.fmu.path, folder)
    lines = [
        "[model]",
        f"fmu = {toml_string(name)}",
        f'kind = "{model.kind}"',
        f"hold = {str(model.hold).lower()}",
    ]
    if model.window is not None:
        lines.append(f"window = {model.window!r}")
    if model.correction is not None:
        lines.append("outside = [" + ", ".join(f'"{e}"' for e in model.correction.labels) + "]")
        if model.coupling is not None:
            lines.append(f"coupling = {model.coupling!r}")
    lines += [
        "",
        "[model.channels]",
        *(_mapped(m.channel, "variable", m.variable, m) for m in (*model.inputs, *model.outputs)),
    ]
    lines += ["", "[model.parameters]"]
    for p in model.parameters:
        parts = [f"{k} = {v!r}" for k, v in (("low", p.low), ("high", p.high)) if math.isfinite(v)]
        lines.append(f"{toml_key(p.name)} = {{ {', '.join(parts)} }}")
    lines += [
        "",
        "[model.start]",
        *(_mapped(m.variable, "channel", m.channel, m) for m in model.starts),
    ]
    lines += [f"{toml_key(k)} = {toml_value(v)}" for k, v in model.constants.items()]
    lines += ["", "[fitted]"]
    shown: dict[str, float] = dict(model.values)
    if model.correction is not None:
        every = zip(
            model.correction.model.parameter_names,
            model.correction.model.value_vector(),
            strict=True,
        )
        shown |= {PREFIX + n: v for n, v in every if n not in TOTAL_INERTIA}
    for key, value in shown.items():
        error = stderr.get(key)
        lines.append(
            f"{toml_key(key)} = {{ value = "
            f"{value:.12g}{f', stderr = {error:.6g}' if error is not None else ''} }}"
        )
    return body + "\n\n" + "\n".join(lines) + "\n"


def _mapped(key: str, word: str, other: str, mapped: Mapped) -> str:
    return f"{toml_key(key)} = {{ {word} = {toml_string(other)}, scale = {mapped.scale!r} }}"


__all__ = ["fmu_named", "is_user_joint", "load_user_joint", "outside_correction", "user_joint_text"]
