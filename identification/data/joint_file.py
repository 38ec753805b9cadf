"""Joint file (TOML): what is known about a joint and its model; written back by a fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel, hold
from casadi_models.term import INERTIAS
from casadi_models.text.typed_law import TypedLaw
from identification.data.joint_schema import (
    BALANCES,
    CALIBRATION,
    CORRELATION,
    FITTED,
    JOINT,
    KNOWN,
    KNOWN_LINES,
    PITCH,
    PROVENANCE,
)
from identification.data.own_effects import TABLE, load_remembered, remembered
from identification.data.plain_text import from_toml, toml_key, toml_value
from identification.data.schema import Schema, finite, meant
from identification.data.typed_laws import LAWS, hold_laws, law_lines, read_laws
from identification.data.units import base_unit, same_dimension
from identification.errors import InputError

LARGEST_RATIO: Final = 1e75
"""Its fourth power, that of cubic friction between motor side and link, is still a number."""
LARGEST_VALUE: Final = 1e75
"""Of a parameter: times a signal that is as large, and squared, it is still a number."""
_TABLES: Final = (
    *("joint", "known", "columns", "fitted", "correlation", "balances"),
    *("calibration", "provenance", TABLE, LAWS),
)
DECIMALS: Final = 9
"""Of a correlation in a file: two parameters that are told apart at all
(:data:`identification.fitting.engine.COLLINEAR`) stay so, and a file of twenty parameters holds
3 kB of them."""
ERROR_DIGITS: Final = 6
"""Of a standard error in a file."""


@final
@dataclass(frozen=True)
class Known:
    """What is known about one parameter: a fixed value, or bounds (link-referred, SI)."""

    value: float | None = None
    low: float | None = None
    high: float | None = None


@final
@dataclass(frozen=True)
class Correlation:
    """How the standard errors of fitted values go together.

    Attributes
    ----------
    names : tuple of str
        Parameters; others are independent of all.
    triangle : tuple of tuple of float
        Row k: correlations of parameter k + 1 with those before it.
    errors : tuple of float
        Of each parameter if the noise were white: with the correlations these are one covariance.
        Stated errors come from windows of time, each by itself, and are another one's. Empty in a
        file of an earlier version.
    """

    names: tuple[str, ...] = ()
    triangle: tuple[tuple[float, ...], ...] = ()
    errors: tuple[float, ...] = ()

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        matrix: npt.NDArray[np.float64],
        errors: npt.NDArray[np.float64],
    ) -> Correlation:
        """From a matrix (p, p), whose diagonal is not looked at, and the errors that belong to it,
        as a file holds them."""
        rows = np.round(np.clip(matrix, -1.0, 1.0), DECIMALS).tolist()
        # a correlation of less than a file holds has no sign
        triangle = tuple(tuple(x + 0.0 for x in rows[k][:k]) for k in range(1, len(names)))
        told = tuple(float(f"{x:.{ERROR_DIGITS}g}") for x in errors.tolist())
        return cls(tuple(names), triangle, told)

    @classmethod
    def read(cls, table: Mapping[str, Any], fitted: Collection[str], source: str) -> Correlation:
        """From the table of a joint file.

        Raises
        ------
        InputError
            A parameter without a fitted value or twice, a triangle of another shape, a number that
            is no correlation.
        """
        if not table:
            return cls()
        where = f"{source}: [correlation]"
        given = CORRELATION.read(table, where)
        names, rows = given["parameters"], given["triangle"]
        for name in names:
            if name not in fitted or names.count(name) > 1:
                why = "is there twice" if name in fitted else "has no value in [fitted]"
                raise InputError(f"{where}: {name} {why}; take the table out or fit again")
        shapes = isinstance(rows, list) and all(isinstance(row, list) for row in rows)
        if not shapes or [len(row) for row in rows] != list(range(1, max(len(names), 1))):
            raise InputError(
                f"{where}: triangle must have {max(len(names) - 1, 0)} rows of 1, 2, ... numbers; "
                "take the table out or fit again"
            )
        found = tuple(tuple(finite(x, f"{where} triangle") for x in row) for row in rows)
        wrong = next((x for row in found for x in row if abs(x) > 1), None)
        if wrong is not None:
            raise InputError(
                f"{where}: {wrong:g} is no correlation; take the table out or fit again"
            )
        errors = given["errors"] or []
        if not isinstance(errors, list) or len(errors) not in (0, len(names)):
            raise InputError(
                f"{where}: errors must be {len(names)} numbers, one for each of the parameters; "
                "take the table out or fit again"
            )
        sizes = tuple(finite(x, f"{where} errors") for x in errors)
        if any(x <= 0 for x in sizes):
            raise InputError(
                f"{where}: {min(sizes):g} is no standard error; take the table out or fit again"
            )
        return cls(names, found, sizes)

    def moves(self, name: str, partner: str, error: float, stated: Mapping[str, float]) -> float:
        """Where one parameter goes up by so much, how far another one goes in a fit that holds it.

        Parameters
        ----------
        name, partner : str
        error : float
            Change of the first.
        stated : mapping of str to float
            Standard errors for a file that has none of its own beside the correlations.
        """
        rho = float(self.matrix([name, partner])[0, 1])
        sizes = dict(zip(self.names, self.errors, strict=True)) if self.errors else stated
        if name not in sizes or partner not in sizes:
            return 0.0
        return rho * sizes[partner] * error / sizes[name]

    def lines(self) -> list[str]:
        """The table of a joint file; nothing where fewer than two parameters are told."""
        if len(self.names) < 2:
            return []
        rows = [f"    {toml_value(row)}," for row in self.triangle]
        head = CORRELATION["parameters"].text(self.names)
        sizes = [CORRELATION["errors"].text(self.errors)] if self.errors else []
        return ["[correlation]", head, *sizes, "triangle = [", *rows, "]"]

    def matrix(self, names: Sequence[str]) -> npt.NDArray[np.float64]:
        """Correlations of some parameters, (p, p): 1 on the diagonal, 0 for what is not told."""
        own = {n: k for k, n in enumerate(self.names)}
        out = np.eye(len(names))
        for i, a in enumerate(names):
            for j, b in enumerate(names[:i]):
                if a in own and b in own:
                    low, high = sorted((own[a], own[b]))
                    out[i, j] = out[j, i] = self.triangle[high - 1][low]
        return out


@final
@dataclass(frozen=True)
class Standing:
    """What a fit left of one balance.

    Attributes
    ----------
    ratio : float
        Over its noise floor.
    parameters : tuple of str
        Those whose values rest on its rows.
    """

    ratio: float
    parameters: tuple[str, ...] = ()

    @classmethod
    def read(cls, table: Mapping[str, Any], source: str) -> dict[str, Standing]:
        """From the table of a joint file, by balance.

        Raises
        ------
        InputError
            A balance without its ratio, or with one below zero.
        """
        out = {}
        for balance, entry in table.items():
            where = f"{source}: [balances] {balance}"
            if not isinstance(entry, Mapping) or "ratio" not in entry:
                raise InputError(
                    f"{where} must be a table with ratio, as {balance} = {{ ratio = 1.0 }}"
                )
            given = BALANCES.read(entry, where)
            if given["ratio"] < 0:
                raise InputError(
                    f"{where}: ratio = {given['ratio']:g} is below zero; take the table out or "
                    "fit again"
                )
            out[balance] = cls(given["ratio"], given["parameters"])
        return out


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
    correlation : Correlation
        How these go together; empty where the file does not say.
    standing : mapping of str to Standing
        What the fit that wrote the file left of each balance; empty where the file does not say.
    columns : mapping or None
        Column map of the record files.
    orders : tuple of float
        Orders at which a line has a name beside those of the motor turn, such as meshing orders:
        per motor turn, or per metre.
    pitch : float or None
        Travel of a linear axis per turn of its motor [m].
    sample_time : float or None
        Of the records of the fit that wrote the file [s].
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
    sample_time: float | None = None
    laws: Mapping[str, TypedLaw] = field(default_factory=dict)
    correlation: Correlation = Correlation()
    standing: Mapping[str, Standing] = field(default_factory=dict)

    @property
    def turns_per_unit(self) -> float:
        """Motor turns per unit of an order: one per turn; one over the pitch per metre; 0 where
        nothing says how far a linear axis moves per turn.
        """
        if self.kind != "linear":
            return 1.0
        if self.pitch is not None:
            return 1.0 / self.pitch
        return abs(self.gear_ratio) / (2 * math.pi) if abs(self.gear_ratio) != 1.0 else 0.0

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

    def lacks(self, model: JointModel) -> list[str]:
        """Parameters of a model of which the file has no value, fitted or known; the calibration of
        a run is its own.
        """
        there = {*self.held().known, hold.HOLD_NAME, *model.calibration}
        return [n for n in model.parameter_names if n not in there]

    def held(self) -> Joint:
        """The joint with its fitted values taken as known: a fit finds the calibration of each run
        and nothing else.
        """
        given = {n: k for n, k in self.known.items() if k.value is not None}
        return replace(self, known={**{n: Known(v) for n, v in self.fitted.items()}, **given})


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
    except ValueError:  # a zero character, which a study may spell
        raise InputError(f"{str(path)!r}: not the name of a file; give that of a joint") from None
    return parse_joint(from_toml(text, str(path)), str(path))


def parse_joint(data: Mapping[str, Any], source: str = "joint") -> Joint:
    """A joint from the tables of a joint file (see :func:`load_joint`)."""
    for key, value in data.items():
        if key not in _TABLES:
            raise InputError(
                f"{source}: unknown table [{key}]; a joint file has [{'], ['.join(_TABLES)}]"
                f"{meant(key, _TABLES)}"
            )
        if not isinstance(value, Mapping):
            raise InputError(f"{source}: {key} must be a table, as [{key}] on a line of its own")
    table = data.get("joint")
    if not isinstance(table, Mapping):
        raise InputError(f"{source}: no [joint] table; it needs at least gear_ratio and model")
    given = JOINT.read(table, f"{source}: [joint]")
    kind, ratio, constant, per_current = (
        given[k] for k in ("kind", "gear_ratio", "motor_constant", "torque_per_current")
    )
    if ratio == 0:
        raise InputError(f"{source}: gear_ratio is 0; give theta_motor / theta_link with its sign")
    if not 1 / LARGEST_RATIO < abs(ratio) < LARGEST_RATIO:
        raise InputError(
            f"{source}: gear_ratio = {ratio:g} is out of what can be computed with; give "
            "theta_motor / theta_link"
        )
    for key, per in (
        ("motor_constant", "ampere"),
        ("torque_per_current", "ampere"),
        ("torque_per_voltage", "volt"),
    ):
        if given[key] == 0:
            raise InputError(f"{source}: {key} is 0; give the torque per {per}")
    if constant is not None and per_current is not None:
        raise InputError(
            f"{source}: motor_constant and torque_per_current are both given; keep one of them"
        )
    if nought := next((e for e in given["effects"] if e.partition("#")[2] == "0"), None):
        raise InputError(f"{source}: effect {nought!r} is not understood; the first is #1")
    if constant is not None and not 0 < abs(ratio * constant) < math.inf:
        raise InputError(
            f"{source}: gear_ratio times motor_constant is {ratio * constant:g}; correct one of "
            "them"
        )
    fitted = {k: _fitted(k, v, source) for k, v in data.get("fitted", {}).items()}
    joint = Joint(
        name=Path(source).stem if given["name"] is None else given["name"],
        kind=kind,
        gear_ratio=ratio,
        torque_per_current=ratio * constant if constant is not None else per_current,
        torque_per_voltage=given["torque_per_voltage"],
        model_name=given["model"],
        effects=given["effects"],
        columns=data.get("columns"),
        virtual_work=given["virtual_work"],
        source=source,
        fitted={k: v["value"] for k, v in fitted.items()},
        errors={k: v["stderr"] for k, v in fitted.items() if v["stderr"] is not None},
        laws=read_laws(data.get(LAWS, {}), kind, source),
        correlation=Correlation.read(data.get("correlation", {}), fitted, source),
        standing=Standing.read(data.get("balances", {}), source),
    )
    load_remembered(data.get(TABLE, {}), source)
    model = joint.model()
    table = data.get("known", {})
    lines = KNOWN_LINES.names
    orders, pitch = (
        _orders(table.get("orders", []), source),
        _pitch(table.get("pitch"), kind, source),
    )
    known = {k: _known(k, v, model, source) for k, v in table.items() if k not in lines}
    joint = replace(joint, fitted={**joint.fitted, **_added(joint.fitted, model)})
    for p in model.parameters:
        if p.name in joint.fitted and not p.low - 1e-9 <= joint.fitted[p.name] <= p.high + 1e-9:
            bounds = f"{p.low:g} to {p.high:g} {p.unit}"
            raise InputError(
                f"{source}: [fitted] {p.name} = {joint.fitted[p.name]:g} lies outside its "
                f"physical bounds {bounds}; correct it or fit again"
            )
    step = _sample_time(data.get("provenance", {}), source)
    return replace(joint, known=known, orders=orders, pitch=pitch, sample_time=step)


def _sample_time(table: Mapping[str, Any], source: str) -> float | None:
    """Sample time of the records of the fit; other notes are for the reader."""
    found: float | None = PROVENANCE["sample_time"].read(table, f"{source}: [provenance]")
    if found is not None and not found > 0:
        raise InputError(
            f"{source}: [provenance]: sample_time = {found:g} s; give the time between two samples"
        )
    return found


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
    if "value" not in table or not set(table) <= set(PITCH.names):
        raise InputError(
            f"{where} must be a number of metres, or a table, as pitch = {{ value = 10.0, unit = "
            f'"mm" }}'
        )
    read = PITCH.read(table, where)
    given = base_unit(read["unit"])
    if not same_dimension(given, base_unit("m")):
        raise InputError(f"{where} has unit {read['unit']!r}; it must be one like m")
    found = float(read["value"] * given.factor)
    if not 0 < found < math.inf:
        raise InputError(f"{where} = {found:g} m must be positive and finite")
    return found


def _known(name: str, entry: Any, model: JointModel, source: str) -> Known:
    parameters = {p.name: p for p in model.parameters}
    extra = {n: p.for_kind(model.kind).unit for n, p in INERTIAS.items()}
    if name not in parameters and name not in extra:
        raise InputError(
            f"{source}: [known] {name}: the model has no such parameter; it has "
            f"{', '.join(sorted(parameters))}{meant(name, (*parameters, *extra))}"
        )
    if isinstance(entry, int | float):
        entry = {"value": entry}
    if not isinstance(entry, Mapping):
        raise InputError(
            f"{source}: [known] {name} must be a number or a table with value, or low and high"
        )
    given = KNOWN.read(entry, f"{source}: [known] {name}")
    unit = parameters[name].unit if name in parameters else extra[name]
    scale = 1.0
    if given["unit"] is not None:
        try:
            own, wanted = base_unit(given["unit"]), base_unit(unit)
        except InputError as error:
            raise InputError(f"{source}: [known] {name}: {error}") from None
        if not same_dimension(own, wanted):
            raise InputError(
                f"{source}: [known] {name} has unit {given['unit']!r}; it must be one like {unit}"
            )
        scale = own.factor / wanted.factor
    if given["side"] == "motor":
        scale *= _on_link(name, model, source)
    values = {k: given[k] * scale for k in ("value", "low", "high") if given[k] is not None}
    if not values:
        raise InputError(f"{source}: [known] {name} has neither value nor low nor high")
    if not all(map(math.isfinite, values.values())):
        raise InputError(
            f"{source}: [known] {name} is no finite number once it is in {unit} on the link "
            "side; correct value, unit or side"
        )
    _check_size(max(map(abs, values.values())), f"{source}: [known] {name}")
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


def _fitted(name: str, entry: Any, source: str) -> dict[str, Any]:
    if not isinstance(entry, Mapping) or "value" not in entry:
        raise InputError(
            f"{source}: [fitted] {name} must be a table with value, as {name} = {{ value = 1.0 }}"
        )
    given = FITTED.read(entry, f"{source}: [fitted] {name}")
    if given["stderr"] is not None and given["stderr"] < 0:
        raise InputError(
            f"{source}: [fitted] {name}: stderr = {given['stderr']:g} is below zero; correct it or "
            "leave it out"
        )
    _check_size(abs(given["value"]), f"{source}: [fitted] {name}")
    return given


def _check_size(value: float, where: str) -> None:
    if value > LARGEST_VALUE:
        raise InputError(
            f"{where}: {value:g} is out of what can be computed with; correct it or fit again"
        )


def toml_text(
    joint: Joint,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    provenance: Mapping[str, Any] | None = None,
    calibration: Mapping[str, Mapping[str, Any]] | None = None,
    outside: Sequence[str] = (),
    *,
    correlation: Correlation | None = None,
    standing: Mapping[str, Standing] | None = None,
) -> str:
    """The joint as the text of a joint file, with fitted values, standard errors, what the sensors
    were off by, and provenance.

    The calibration is a note: another record has its own. Labels of effects `outside` of a user's
    FMU have their files remembered too. The correlation is that of the standard errors, the
    standing that of the balances.
    """
    head = {
        "name": joint.name,
        "kind": joint.kind,
        "gear_ratio": joint.gear_ratio,
        "torque_per_current": joint.torque_per_current,
        "torque_per_voltage": joint.torque_per_voltage,
        "model": joint.model_name,
        "effects": joint.effects,
        "virtual_work": None if joint.virtual_work else False,
    }
    lines = ["[joint]", *JOINT.lines(head)]
    lines += law_lines(joint.laws)
    lines += remembered((*joint.effects, *outside))
    if joint.known or joint.orders or joint.pitch is not None:
        lines += ["", "[known]"]
        lines += KNOWN_LINES.lines({"orders": joint.orders or None, "pitch": joint.pitch})
        for name, known in joint.known.items():
            values = {"value": known.value, "low": known.low, "high": known.high}
            lines.append(f"{name} = {KNOWN.inline(values)}")
    if joint.columns:
        lines += ["", *column_lines(joint.columns)]
    if parameters:
        lines += ["", "[fitted]", *_entries(FITTED, parameters)]
    if parameters and correlation is not None and (told := correlation.lines()):
        lines += ["", *told]
    if parameters and standing:
        left = {b: {"ratio": s.ratio, "parameters": s.parameters} for b, s in standing.items()}
        lines += ["", "[balances]", *_entries(BALANCES, left)]
    if calibration:
        lines += ["", "[calibration]", *_entries(CALIBRATION, calibration)]
    origin = {"sample_time": joint.sample_time, **(provenance or {})}
    if any(value is not None for value in origin.values()):
        lines += ["", "[provenance]", *PROVENANCE.lines(origin)]
    text = "\n".join(lines) + "\n"
    from_toml(
        text, f"{joint.source or joint.name}, as it would be written"
    )  # it may replace the file it came from
    return text


def column_lines(columns: Mapping[str, Any]) -> list[str]:
    """A column map as the table [columns] of a joint file."""
    return ["[columns]", *(f"{toml_key(c)} = {toml_value(e)}" for c, e in columns.items())]


def _entries(schema: Schema, entries: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One line for each name of a table; what the table has no key for is left out."""
    return [
        f"{toml_key(name)} = {schema.inline({k: v for k, v in e.items() if k in schema.names})}"
        for name, e in entries.items()
    ]
