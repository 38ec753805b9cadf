"""A library of identified joints: joint files with where their values come from, side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, final

from casadi_models.term import MOTOR_INERTIA
from identification.data.joint_file import Joint, load_joint, parse_joint
from identification.data.plain_text import from_json, from_toml
from identification.data.schema import meant
from identification.errors import InputError

PUBLISHED: Final = (
    "M. Duclusaud et al., ICRA 2025, arXiv 2410.08650 (github.com/Rhoban/bam, Apache-2.0)"
)
TABLE: Final = "params.json"
"""Their table, as it is published."""
LAW_OF: Final = MappingProxyType(
    {
        "friction_viscous": ("viscous@motor", "motor_viscous"),
        "friction_base": ("coulomb@motor", "motor_coulomb"),
        "friction_stribeck": ("stribeck@motor", "motor_stribeck_extra"),
        "load_friction_base": ("load_dependent_friction@motor", "motor_load_friction"),
    }
)
"""Amplitudes of the published friction models M1 to M6 with a law of the library: the effect and
its parameter."""
SHAPES: Final = MappingProxyType(
    {"dtheta_stribeck": "motor_stribeck_velocity", "alpha": "motor_stribeck_exponent"}
)
"""Shapes of these laws."""
NOT_FRICTION: Final = frozenset({"kt", "R", "armature", "q_offset", "model", "actuator"})


@final
@dataclass(frozen=True)
class Entry:
    """One identified joint.

    Attributes
    ----------
    name : str
        File name without its ending, or key of a table.
    joint : Joint
    values, errors : mapping of str to float
        Identified values and standard errors, SI.
    units : mapping of str to str
    provenance : mapping of str to str
        Where the values come from.
    left_out : tuple of str
        Values of the source that no law of the library takes.
    """

    name: str
    joint: Joint
    values: Mapping[str, float]
    errors: Mapping[str, float]
    units: Mapping[str, str]
    provenance: Mapping[str, str] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    @property
    def type(self) -> str:
        """What kind of unit it is: those of one type are worth comparing."""
        return self.provenance.get("type", self.name)

    def as_json(self) -> dict[str, Any]:
        """The shape of `joints --json`."""
        return {
            "name": self.name,
            "type": self.type,
            "kind": self.joint.kind,
            "gear_ratio": self.joint.gear_ratio,
            "model": self.joint.model_name,
            "effects": list(self.joint.effects),
            "values": {
                n: {"value": v, "stderr": self.errors.get(n), "unit": self.units.get(n, "")}
                for n, v in self.values.items()
            },
            "provenance": dict(self.provenance),
            "left_out": list(self.left_out),
        }


def packaged() -> list[Entry]:
    """The joints that come with the package."""
    folder = files("identification") / "data" / "joints"
    out = []
    for file in sorted(folder.iterdir(), key=lambda f: f.name):
        if file.name.endswith(".toml"):
            out.append(_entry(file.read_text(encoding="utf-8"), file.name))
    return out


def entries(paths: Sequence[str | Path]) -> list[Entry]:
    """Joints of files and folders: joint files, folders of them, tables of published parameters.

    Parameters
    ----------
    paths : sequence of str or Path
        ``.toml``: a joint file; ``.json``: a table of published parameters; a folder: all joint
        files in it, and the table of published parameters.

    Raises
    ------
    InputError
        A path that is none of these, in one line.
    """
    out: list[Entry] = []
    for path in map(Path, paths):
        if path.is_dir():
            found, table = sorted(path.glob("*.toml")), path / TABLE
            if not found and not table.is_file():
                raise InputError(f"{path}: no joint file (.toml) and no {TABLE} in this folder")
            out += [_of_file(p) for p in found]
            out += published(table) if table.is_file() else []
        elif path.suffix == ".json":
            out += published(path)
        else:
            out.append(_of_file(path))
    return out


def chosen(names: Sequence[str], among: Sequence[Entry]) -> list[Entry]:
    """Joints by name, or all of a type.

    Raises
    ------
    InputError
        No joint of that name, in one line.
    """
    out: list[Entry] = []
    for name in names:
        found = [e for e in among if name in (e.name, e.type)]
        if not found and Path(name).exists():
            found = entries([name])
        if not found:
            raise InputError(
                f"no joint {name!r} in the library; `irj joints list` has "
                f"{', '.join(e.name for e in among[:8])}{', ...' if len(among) > 8 else ''}"
                f"{meant(name, (e.name for e in among))}"
            )
        out += [e for e in found if e not in out]
    return out


def _of_file(path: Path) -> Entry:
    load_joint(path)  # what is wrong with the file is said there
    return _entry(path.read_text(encoding="utf-8-sig"), str(path))


def _entry(text: str, source: str) -> Entry:
    table = from_toml(text, source)
    joint = parse_joint(table, source)
    fitted = table.get("fitted", {})
    known = {n: k.value for n, k in joint.known.items() if k.value is not None}
    return Entry(
        Path(source).stem,
        joint,
        {**known, **{n: float(v["value"]) for n, v in fitted.items()}},
        dict(joint.errors),
        {n: str(v.get("unit", "")) for n, v in fitted.items()},
        {k: str(v) for k, v in table.get("provenance", {}).items()},
    )


def published(path: Path) -> list[Entry]:
    """Joints of a table of the published friction models M1 to M6 of geared servo modules.

    Values are those of the joint side.  Where the name of a module says its ratio, it is the gear
    ratio; else 1, everything being referred to one side.

    Parameters
    ----------
    path : Path
        ``params.json``: rows of numbers by "module/model".

    Raises
    ------
    InputError
        No such table, in one line.
    """
    try:
        table = from_json(path.read_text(encoding="utf-8"), str(path))
        rows = {str(n): dict(row) for n, row in table.items()}
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give a table of published parameters"
        ) from None
    except (ValueError, TypeError, AttributeError):
        raise InputError(
            f"{path}: not a table of published parameters; give rows of numbers by name"
        ) from None
    return [_published(name, row, path) for name, row in rows.items()]


def _published(name: str, row: Mapping[str, Any], path: Path) -> Entry:
    try:
        numbers = {n: float(v) for n, v in row.items() if not isinstance(v, str)}
        torque, inertia = numbers["kt"], numbers["armature"]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {name} has no usable {error.args[0]}") from None
    if not all(map(math.isfinite, numbers.values())):
        raise InputError(f"{path}: {name} holds a value that is no finite number")
    module = name.partition("/")[0]
    digits = module.rpartition("_")[2]
    effects, values = [], {MOTOR_INERTIA: inertia}
    for key, (label, parameter) in LAW_OF.items():
        if key in numbers:
            effects.append(label)
            values[parameter] = numbers[key]
    left = [n for n in numbers if n not in NOT_FRICTION | set(LAW_OF) | set(SHAPES)]
    joint = Joint(
        name=name.replace("/", "_"),
        gear_ratio=float(digits) if digits.isdigit() else 1.0,
        torque_per_current=torque,
        effects=tuple(effects),
    )
    parameters = {p.name: p for p in joint.model().parameters}
    for key, parameter in SHAPES.items():
        if key in numbers and parameter in parameters:
            p = parameters[parameter]
            values[parameter] = min(max(numbers[key], p.low), p.high)
            if values[parameter] != numbers[key]:
                left.append(f"{key} ({numbers[key]:.3g} is outside the law's bounds)")
    return Entry(
        name,
        joint,
        values,
        errors={},
        units={n: parameters[n].unit for n in values},
        provenance={"type": module, "source": PUBLISHED, "referred to": "joint side"},
        left_out=tuple(left),
    )


def side_by_side(joints: Sequence[Entry]) -> list[dict[str, Any]]:
    """Values of several joints, one row per parameter, with the spread where two or more have it.

    Returns
    -------
    list of dict
        ``{parameter, unit, values: [..., None where a joint has none], spread_percent}``; the
        spread is the standard deviation over the mean size.
    """
    names = list(dict.fromkeys(n for e in joints for n in e.values))
    rows = []
    for name in names:
        values = [e.values.get(name) for e in joints]
        there = [v for v in values if v is not None]
        spread = None
        if len(there) > 1:
            mean = sum(there) / len(there)
            size = sum(abs(v) for v in there) / len(there)
            deviation = math.sqrt(sum((v - mean) ** 2 for v in there) / (len(there) - 1))
            spread = 100 * deviation / size if size > 0 else None
        unit = next((e.units[name] for e in joints if name in e.units), "")
        rows.append({"parameter": name, "unit": unit, "values": values, "spread_percent": spread})
    return rows
