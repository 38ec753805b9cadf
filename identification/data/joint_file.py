"""Joint file (TOML): what is known about a joint and its model; written back by a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, final

from casadi_models import JointModel
from casadi_models.term import INERTIAS
from casadi_models.text.typed_law import TypedLaw
from casadi_models.transmission import MODELS
from identification.data.own_effects import TABLE, load_remembered, remembered
from identification.data.plain_text import from_toml, toml_key, toml_string, toml_value
from identification.data.typed_laws import LAWS, hold_laws, law_lines, read_laws
from identification.data.units import base_unit, same_dimension
from identification.errors import InputError

_JOINT_KEYS: Final = frozenset(
    (
        "name",
        "kind",
        "gear_ratio",
        "motor_constant",
        "torque_per_current",
        "torque_per_voltage",
        "model",
        "effects",
        "virtual_work",
    )
)
LARGEST_RATIO: Final = 1e75
"""Its fourth power, that of cubic friction between motor side and link, is still a number."""
_KNOWN_KEYS: Final = ("value", "low", "high", "unit", "side", "source", "note")
_TABLES: Final = ("joint", "known", "columns", "fitted", "calibration", "provenance", TABLE, LAWS)


@final
@dataclass(frozen=True)
class Known:
    """What is known about one parameter: a fixed value, or bounds (link-referred, SI)."""

    value: float | None = None
    low: float | None = None
    high: float | None = None


@final
@dataclass(frozen=True)
class Joint:
    """A joint file in memory.

    Attributes
    ----------
    name, kind : str
    gear_ratio : float
        theta_motor / theta_link, signed.
    torque_per_current, torque_per_voltage : float or None
        Link-side torque per ampere or volt.
    model_name : str
    effects : tuple of str
        Labels beyond the model's own.
    known, fitted : mapping
        By parameter name; fitted values come from a fit written back.
    errors : mapping
        Standard errors of fitted values, where the file has them.
    columns : mapping or None
        Column map of the record files.
    orders : tuple of float
        Orders at which a line has a name beside those of the motor turn, such as meshing orders:
        per motor turn, or per metre.
    pitch : float or None
        Travel of a linear axis per turn of its motor [m].
    laws : mapping of str to TypedLaw
        Laws typed as text, by the key of their effect.
    """

    name: str = "joint"
    kind: str = "rotary"
    gear_ratio: float = 1.0
    torque_per_current: float | None = None
    torque_per_voltage: float | None = None
    model_name: str = "hd1"
    effects: tuple[str, ...] = ()
    known: Mapping[str, Known] = field(default_factory=dict)
    fitted: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    columns: Mapping[str, Any] | None = None
    virtual_work: bool = True
    source: str = ""
    orders: tuple[float, ...] = ()
    pitch: float | None = None
    laws: Mapping[str, TypedLaw] = field(default_factory=dict)

    def model(self) -> JointModel:
        """The joint model with its effects (values of a fit written back included).

        Raises
        ------
        InputError
            An effect that is not in the library.
        """
        hold_laws(
            self.laws, self.source or self.name
        )  # another joint's law may have had the key since
        try:
            model = replace(
                JointModel.by_name(
                    self.model_name, self.gear_ratio, kind=self.kind, effects=self.effects
                ),
                name=self.name,
                virtual_work=self.virtual_work,
            )
        except (KeyError, ValueError) as error:
            raise InputError(f"{self.source or self.name}: {error.args[0]}") from None
        names = set(model.parameter_names)
        return model.with_values({k: v for k, v in self.fitted.items() if k in names})


def load_joint(path: str | Path) -> Joint:
    """Read a joint file.

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
            f"{path}: cannot be read ({error.strerror}); give the path of a joint file"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; a joint file is TOML") from None
    return parse_joint(from_toml(text, str(path)), str(path))


def parse_joint(data: Mapping[str, Any], source: str = "joint") -> Joint:
    """A joint from the tables of a joint file (see :func:`load_joint`)."""
    for key, value in data.items():
        if key not in _TABLES:
            raise InputError(
                f"{source}: unknown table [{key}]; a joint file has [{'], ['.join(_TABLES)}]"
            )
        if not isinstance(value, Mapping):
            raise InputError(f"{source}: {key} must be a table, as [{key}] on a line of its own")
    table = data.get("joint")
    if not isinstance(table, Mapping):
        raise InputError(f"{source}: no [joint] table; it needs at least gear_ratio and model")
    for key in table:
        if key not in _JOINT_KEYS:
            raise InputError(
                f"{source}: [joint] has an unknown key {key!r}; known: "
                f"{', '.join(sorted(_JOINT_KEYS))}"
            )
    kind = str(table.get("kind", "rotary"))
    if kind not in ("rotary", "linear"):
        raise InputError(f"{source}: kind = {kind!r}; use 'rotary' or 'linear'")
    ratio = _number(table, "gear_ratio", source, 1.0)
    if ratio is None or ratio == 0:
        raise InputError(f"{source}: gear_ratio is 0; give theta_motor / theta_link with its sign")
    if not 1 / LARGEST_RATIO < abs(ratio) < LARGEST_RATIO:
        raise InputError(
            f"{source}: gear_ratio = {ratio:g} is out of what can be computed with; give "
            "theta_motor / theta_link"
        )
    constant = _number(table, "motor_constant", source, None)
    per_current = _number(table, "torque_per_current", source, None)
    per_voltage = _number(table, "torque_per_voltage", source, None)
    for key, value, per in (
        ("motor_constant", constant, "ampere"),
        ("torque_per_current", per_current, "ampere"),
        ("torque_per_voltage", per_voltage, "volt"),
    ):
        if value == 0:
            raise InputError(f"{source}: {key} is 0; give the torque per {per}")
    if constant is not None and per_current is not None:
        raise InputError(
            f"{source}: motor_constant and torque_per_current are both given; keep one of them"
        )
    name = str(table.get("model", "hd1"))
    if name not in MODELS:
        raise InputError(f"{source}: model = {name!r} is not known; use one of {', '.join(MODELS)}")
    if isinstance(table.get("name"), Mapping | list):
        raise InputError(f'{source}: name must be a text, as name = "axis 3"')
    effects = table.get("effects", [])
    if not isinstance(effects, list) or not all(isinstance(e, str) for e in effects):
        raise InputError(
            f'{source}: effects must be a list of names, as effects = ["viscous", "coulomb"]'
        )
    if nought := next((e for e in effects if e.partition("#")[2] == "0"), None):
        raise InputError(f"{source}: effect {nought!r} is not understood; the first is #1")
    if constant is not None and not 0 < abs(ratio * constant) < math.inf:
        raise InputError(
            f"{source}: gear_ratio times motor_constant is {ratio * constant:g}; correct one of "
            "them"
        )
    joint = Joint(
        name=str(table.get("name", Path(source).stem)),
        kind=kind,
        gear_ratio=ratio,
        torque_per_current=ratio * constant if constant is not None else per_current,
        torque_per_voltage=per_voltage,
        model_name=name,
        effects=tuple(effects),
        columns=data.get("columns"),
        virtual_work=_flag(table, "virtual_work", source),
        source=source,
        fitted={k: _fitted(k, v, source) for k, v in data.get("fitted", {}).items()},
        errors={
            k: _stderr(v, f"{source}: [fitted] {k}")
            for k, v in data.get("fitted", {}).items()
            if "stderr" in v
        },
        laws=read_laws(data.get(LAWS, {}), kind, source),
    )
    load_remembered(data.get(TABLE, {}), source)
    model = joint.model()
    table = dict(data.get("known", {}))
    orders, pitch = (
        _orders(table.pop("orders", []), source),
        _pitch(table.pop("pitch", None), kind, source),
    )
    known = {k: _known(k, v, model, source) for k, v in table.items()}
    joint = replace(joint, fitted={**joint.fitted, **_added(joint.fitted, model)})
    for p in model.parameters:
        if p.name in joint.fitted and not p.low - 1e-9 <= joint.fitted[p.name] <= p.high + 1e-9:
            bounds = f"{p.low:g} to {p.high:g} {p.unit}"
            raise InputError(
                f"{source}: [fitted] {p.name} = {joint.fitted[p.name]:g} lies outside its "
                f"physical bounds {bounds}; correct it or fit again"
            )
    return replace(joint, known=known, orders=orders, pitch=pitch)


def _added(fitted: Mapping[str, float], model: JointModel) -> dict[str, float]:
    """Values of the parameters that an effect did not have when a file's values were fitted."""
    return {
        p.name: p.start
        for term in model.terms
        if any(n in fitted for n in term.names)
        for p in term.parameters
        if p.added and p.name not in fitted
    }


def _orders(entry: Any, source: str) -> tuple[float, ...]:
    """Orders of lines that are known beforehand."""
    if not isinstance(entry, list) or any(
        isinstance(h, bool) or not isinstance(h, int | float) or not 0 < h < math.inf for h in entry
    ):
        raise InputError(
            f"{source}: [known] orders must be a list of positive numbers, as orders = [12.0, 36.0]"
        )
    return tuple(float(h) for h in entry)


def _pitch(entry: Any, kind: str, source: str) -> float | None:
    """Travel per turn of the motor [m], from a number or a table with value and unit."""
    if entry is None:
        return None
    if kind != "linear":
        raise InputError(
            f'{source}: [known] pitch belongs to kind = "linear"; a rotary joint has its orders '
            "per motor turn"
        )
    table = entry if isinstance(entry, Mapping) else {"value": entry}
    where = f"{source}: [known] pitch"
    if "value" not in table or not set(table) <= {"value", "unit"}:
        raise InputError(
            f"{where} must be a number of metres, or a table, as pitch = {{ value = 10.0, unit = "
            f'"mm" }}'
        )
    given = base_unit(str(table.get("unit", "m")))
    if not same_dimension(given, base_unit("m")):
        raise InputError(f"{where} has unit {table['unit']!r}; it must be one like m")
    found = _entry_number(table, "value", where) * given.factor
    if not 0 < found < math.inf:
        raise InputError(f"{where} = {found:g} m must be positive and finite")
    return found


def _number(table: Mapping[str, Any], key: str, source: str, default: float | None) -> float | None:
    value = table.get(key, default)
    if value is None:
        return None
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or value != value
        or abs(value) == float("inf")
    ):
        raise InputError(f"{source}: {key} = {value!r} is not a finite number")
    return float(value)


def _known(name: str, entry: Any, model: JointModel, source: str) -> Known:
    parameters = {p.name: p for p in model.parameters}
    extra = {n: p.for_kind(model.kind).unit for n, p in INERTIAS.items()}
    if name not in parameters and name not in extra:
        raise InputError(
            f"{source}: [known] {name}: the model has no such parameter; it has "
            f"{', '.join(sorted(parameters))}"
        )
    if isinstance(entry, int | float):
        entry = {"value": entry}
    if not isinstance(entry, Mapping):
        raise InputError(
            f"{source}: [known] {name} must be a number or a table with value, or low and high"
        )
    unit = parameters[name].unit if name in parameters else extra[name]
    scale = 1.0
    if "unit" in entry:
        try:
            given, wanted = base_unit(str(entry["unit"])), base_unit(unit)
        except InputError as error:
            raise InputError(f"{source}: [known] {name}: {error}") from None
        if not same_dimension(given, wanted):
            raise InputError(
                f"{source}: [known] {name} has unit {entry['unit']!r}; it must be one like {unit}"
            )
        scale = given.factor / wanted.factor
    if entry.get("side") == "motor":
        scale *= _on_link(name, model, source)
    for key in entry:
        if key not in _KNOWN_KEYS:
            raise InputError(
                f"{source}: [known] {name} has an unknown key {key!r}; known: "
                f"{', '.join(_KNOWN_KEYS)}"
            )
    if entry.get("side", "link") not in ("motor", "link", "gear", "sensor", "none"):
        raise InputError(
            f"{source}: [known] {name} has side = {entry['side']!r}; use 'motor' or 'link'"
        )
    values = {
        k: _entry_number(entry, k, f"{source}: [known] {name}") * scale
        for k in ("value", "low", "high")
        if k in entry
    }
    if not values:
        raise InputError(f"{source}: [known] {name} has neither value nor low nor high")
    if not all(map(math.isfinite, values.values())):
        raise InputError(
            f"{source}: [known] {name} is no finite number once it is in {unit} on the link "
            "side; correct value, unit or side"
        )
    if scale < 0:  # the link is counted against the motor shaft
        values = {{"low": "high", "high": "low"}.get(k, k): v for k, v in values.items()}
    if values.get("low", -math.inf) > values.get("high", math.inf):
        raise InputError(f"{source}: [known] {name} has low above high; exchange them")
    if "value" in values and not values.get("low", -math.inf) <= values["value"] <= values.get(
        "high", math.inf
    ):
        raise InputError(
            f"{source}: [known] {name} has a value outside its own low and high; correct one of "
            "them"
        )
    if name in parameters:
        p = parameters[name]
        if not all(p.low <= v <= p.high for k, v in values.items() if k == "value"):
            raise InputError(
                f"{source}: [known] {name} = {values['value']:g} lies outside its physical "
                f"bounds {p.low:g} to {p.high:g} {unit}"
            )
    return Known(**values)


def _on_link(name: str, model: JointModel, source: str) -> float:
    """What refers a motor-side value to the link."""
    term = next((t for t in model.terms if name in t.names), None)
    if term is not None and term.effect.table is not None and model.gear_ratio < 0:
        raise InputError(
            f"{source}: [known] {name} is one knot of a curve, and with a negative gear ratio "
            "the curve of the motor side runs the other way: give its values on the link side"
        )
    return model.side_factor(name)


def _entry_number(entry: Mapping[str, Any], key: str, where: str) -> float:
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: {key} = {value!r} is not a finite number")
    return float(value)


def _fitted(name: str, entry: Any, source: str) -> float:
    if not isinstance(entry, Mapping) or "value" not in entry:
        raise InputError(
            f"{source}: [fitted] {name} must be a table with value, as {name} = {{ value = 1.0 }}"
        )
    return _entry_number(entry, "value", f"{source}: [fitted] {name}")


def _stderr(entry: Mapping[str, Any], where: str) -> float:
    found = _entry_number(entry, "stderr", where)
    if found < 0:
        raise InputError(f"{where}: stderr = {found:g} is below zero; correct it or leave it out")
    return found


def _flag(table: Mapping[str, Any], key: str, source: str) -> bool:
    value = table.get(key, True)
    if not isinstance(value, bool):
        raise InputError(f"{source}: {key} = {value!r}; use true or false")
    return value


def toml_text(
    joint: Joint,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    provenance: Mapping[str, str] | None = None,
    calibration: Mapping[str, Mapping[str, Any]] | None = None,
    outside: Sequence[str] = (),
) -> str:
    """The joint as the text of a joint file, with fitted values, standard errors, what the sensors
    were off by, and provenance.

    The calibration is a note: another record has its own. Labels of effects `outside` of a user's
    FMU have their files remembered too.
    """
    lines = [
        "[joint]",
        f"name = {toml_string(joint.name)}",
        f'kind = "{joint.kind}"',
        f"gear_ratio = {joint.gear_ratio!r}",
    ]
    if joint.torque_per_current is not None:
        lines.append(f"torque_per_current = {joint.torque_per_current!r}")
    if joint.torque_per_voltage is not None:
        lines.append(f"torque_per_voltage = {joint.torque_per_voltage!r}")
    lines += [f'model = "{joint.model_name}"', f"effects = {toml_value(joint.effects)}"]
    if not joint.virtual_work:
        lines.append("virtual_work = false")
    lines += law_lines(joint.laws)
    lines += remembered((*joint.effects, *outside))
    if joint.known or joint.orders or joint.pitch is not None:
        lines += ["", "[known]"]
        if joint.orders:
            lines.append(f"orders = [{', '.join(repr(h) for h in joint.orders)}]")
        if joint.pitch is not None:
            lines.append(f"pitch = {joint.pitch!r}")
        for name, known in joint.known.items():
            parts = [
                f"{k} = {getattr(known, k)!r}"
                for k in ("value", "low", "high")
                if getattr(known, k) is not None
            ]
            lines.append(f"{name} = {{ {', '.join(parts)} }}")
    if joint.columns:
        lines += ["", "[columns]"]
        for channel, entry in joint.columns.items():
            lines.append(f"{toml_key(channel)} = {toml_value(entry)}")
    if parameters:
        lines += ["", "[fitted]"]
        for name, p in parameters.items():
            error = f", stderr = {p['stderr']:.6g}" if p.get("stderr") is not None else ""
            lines.append(
                f'{name} = {{ value = {p["value"]:.10g}{error}, unit = "{p["unit"]}", side = '
                f'"{p["side"]}" }}'
            )
    if calibration:
        lines += ["", "[calibration]"]
        for name, c in calibration.items():
            error = f", stderr = {c['stderr']:.6g}" if c.get("stderr") is not None else ""
            lines.append(
                f"{toml_string(name)} = {{ value = {c['value']:.10g}{error}, "
                f'unit = "{c["unit"]}" }}'
            )
    if provenance:
        lines += [
            "",
            "[provenance]",
            *(f"{toml_key(k)} = {toml_string(v)}" for k, v in provenance.items()),
        ]
    text = "\n".join(lines) + "\n"
    from_toml(
        text, f"{joint.source or joint.name}, as it would be written"
    )  # it may replace the file it came from
    return text
