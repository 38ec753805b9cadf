"""A user's FMU as the model of a joint: which of its variables are which channels, and what is
to be fitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from identification.data.channels import channel_unit
from identification.data.joint_file import Joint
from identification.data.record import Record, listed
from identification.data.units import base_unit, same_dimension
from identification.errors import InputError
from irj_fmu.host.run import Number
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.correction import Correction
from irj_fmu.imported.library import Kind, UserFmu
from irj_fmu.imported.run import Runner, Window

Bounds = tuple[float | None, float | None]
"""Lower and upper bound of a parameter; None: that of the FMU."""
DRIVES: Final = ("motor_current", "motor_torque", "motor_voltage")
_SLOPE_OF: Final = {"motor_velocity": "motor_position", "link_velocity": "link_position"}
_SLOPE_TIME: Final = 0.02
"""Half width of the stretch from which a start velocity is read [s]."""
_SHORT: Final = 8


@final
@dataclass(frozen=True)
class Mapped:
    """A channel of the record and the variable of the FMU that goes with it: variable = scale *
    channel in SI.
    """

    channel: str
    variable: str
    scale: float = 1.0


@final
@dataclass(frozen=True)
class UserParameter:
    """A parameter that a fit may move.

    Attributes
    ----------
    value : float
        Start value, in the unit of the FMU's variable.
    low, high : float
        Bounds.
    """

    name: str
    value: float
    low: float = -math.inf
    high: float = math.inf


@final
@dataclass(frozen=True)
class UserModel:
    """A user's FMU as a model; made by :func:`load_user_model`.

    Attributes
    ----------
    inputs, outputs, starts : tuple of Mapped
        Channels that drive the FMU, that it answers with, and that start it.
    constants : mapping
        Values of further variables, set before each run.
    window : float or None
        Length of the stretches that are simulated from their own start values [s]; None simulates
        each segment whole.
    hold : bool
        True: an input holds from sample to sample (a commanded current). False: the mean of two
        samples stands between them (an input that moves in between).
    kind : {"me", "cs"}
    correction : Correction or None
        An effect of the library that rides outside the FMU.
    coupling : float or None
        Longest time for which the slope of its torque lets it hold [s]
        (:func:`irj_fmu.imported.port.coupled`); None where that is not known.
    notes : tuple of str
        What was assumed.
    """

    fmu: UserFmu
    joint: Joint
    inputs: tuple[Mapped, ...]
    outputs: tuple[Mapped, ...]
    parameters: tuple[UserParameter, ...] = ()
    starts: tuple[Mapped, ...] = ()
    constants: Mapping[str, Number] = field(default_factory=dict)
    window: float | None = None
    hold: bool = True
    kind: Kind = "me"
    correction: Correction | None = None
    coupling: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """Values of the parameters by name, those of the correction included."""
        own = {p.name: p.value for p in self.parameters}
        return own if self.correction is None else {**own, **self.correction.free_values()}

    def with_values(self, values: Mapping[str, float]) -> UserModel:
        """The model with other parameter values."""
        moved = tuple(replace(p, value=float(values.get(p.name, p.value))) for p in self.parameters)
        correction = self.correction.with_values(values) if self.correction is not None else None
        return replace(self, parameters=moved, correction=correction)

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds of the parameters by name, those of the correction included."""
        own = {p.name: (p.low, p.high) for p in self.parameters}
        return own if self.correction is None else {**own, **self.correction.bounds()}

    def windows(self, records: Sequence[Record]) -> list[Window]:
        """Records cut into stretches, in the units of the FMU.

        Raises
        ------
        InputError
            A channel that is missing, a record that is too short.
        """
        found: list[Window] = []
        for number, record in enumerate(records):
            if record.kind != self.joint.kind:
                raise InputError(
                    f"{record.name}: is a {record.kind} record, the joint file says kind = "
                    f'"{self.joint.kind}"'
                )
            for part in record.segments():
                count = part.stop - part.start
                size = count if self.window is None else max(_SHORT, round(self.window / record.dt))
                for first in range(part.start, part.stop - _SHORT + 1, size):
                    found.append(
                        self._window(
                            record,
                            slice(first, min(first + size + (self.window is not None), part.stop)),
                            part,
                            number,
                        )
                    )
        if not found:
            raise InputError(
                f"{', '.join(r.name for r in records)}: too short; at least {_SHORT} samples in "
                "a row are needed"
            )
        return found

    def _window(self, record: Record, rows: slice, part: slice, number: int) -> Window:
        inputs = [m.scale * record[m.channel][rows] for m in self.inputs]
        if not self.hold:
            inputs = [np.append((x[:-1] + x[1:]) / 2, x[-1]) for x in inputs]
        count = rows.stop - rows.start
        return Window(
            time=np.asarray(record.time[rows], dtype=float),
            inputs=np.column_stack(inputs) if inputs else np.empty((count, 0)),
            outputs=np.column_stack([m.scale * record[m.channel][rows] for m in self.outputs]),
            start=np.array(
                [m.scale * _first(record, m.channel, rows.start, part) for m in self.starts]
            ),
            record=number,
        )

    def runner(self) -> Runner:
        """A fresh instance for runs."""
        return Runner(
            self.fmu,
            self.kind,
            inputs=[m.variable for m in self.inputs],
            outputs=[m.variable for m in self.outputs],
            starts=[m.variable for m in self.starts],
            settings=self.constants,
        )


def at_least_one(records: Record | Sequence[Record]) -> list[Record]:
    """One record or several as a list."""
    found = listed(records)
    if not found:
        raise InputError("no record; give at least one")
    return found


def _first(record: Record, channel: str, row: int, part: slice) -> float:
    """Value of a channel at a row; a velocity that is not measured is the slope of a parabola
    through the positions.
    """
    if record.has(channel) or channel not in _SLOPE_OF:
        return float(record[channel][row])
    half = max(3, round(_SLOPE_TIME / record.dt))
    near = slice(max(part.start, row - half), min(part.stop, row + half + 1))
    time = record.time[near] - record.time[row]
    return float(np.polyfit(time, record[_SLOPE_OF[channel]][near], 2)[1])


def load_user_model(
    path: str | Path,
    columns: Mapping[str, str | tuple[str, float]],
    parameters: Sequence[str] | Mapping[str, Bounds] = (),
    *,
    start: Mapping[str, str | tuple[str, float] | Number] | None = None,
    joint: Joint | None = None,
    window: float | None = None,
    hold: bool = True,
    kind: Kind | None = None,
) -> UserModel:
    """Take a user's FMU as a model.

    Parameters
    ----------
    path : str or Path
        FMI 2.0 or 3.0, model exchange or co-simulation.
    columns : mapping
        Record channel to variable, or to ``(variable, scale)`` where variable = scale * channel in
        SI. Inputs of the FMU are driven by their channel, other variables are compared with it.
    parameters : sequence of str, or mapping of str to (low, high)
        Parameters that a fit may move, with bounds. A bound that is left out, or None, is that of
        the FMU.
    start : mapping, optional
        Variable to the channel (or ``(channel, scale)``) whose first sample starts it, or to a
        number. Start values from channels are estimated with the parameters, as measurements have
        noise.
    joint : Joint, optional
        Kind of the axis, gear ratio and motor constant; needed by a diagnosis.
    window : float, optional
        Simulate stretches of this length [s], each from its own start; by default each segment
        whole.
    hold : bool
        See :class:`UserModel`.
    kind : {"me", "cs"}, optional
        By default model exchange where the FMU has it and no state events.

    Raises
    ------
    InputError
        Unreadable FMU, unknown variable, a unit that does not fit the channel, no output to
        compare.

    Examples
    --------
    >>> model = load_user_model("axis.fmu", {"motor_torque": "tau", "motor_position": "phi"},
    ["inertia"])  # doctest: +SKIP
    >>> fitted = fit(model, read("run.csv"))
    # doctest: +SKIP
    """
    fmu = UserFmu(Path(path))
    joint = joint or Joint(name=fmu.path.stem)
    notes: list[str] = []
    mapped = [_mapped(fmu, channel, entry, joint.kind, notes) for channel, entry in columns.items()]
    inputs = tuple(m for m in mapped if fmu.real(m.variable).causality == "input")
    outputs = tuple(m for m in mapped if m not in inputs)
    if not outputs:
        raise InputError(
            f"{fmu.path.name}: no channel is mapped to an output of the FMU; give at least one"
        )
    ways = fmu.kinds()
    if kind is not None and kind not in ways:
        events = kind == "me" and fmu.description.modelExchange is not None
        why = (
            " (its model exchange has state events, which runs here do not follow)"
            if events
            else ""
        )
        raise InputError(
            f"{fmu.path.name}: kind = {kind!r} is not possible{why}; it has {', '.join(ways)}"
        )
    starts, constants = _starts(fmu, start or {}, mapped, notes)
    notes += _idle(fmu, inputs, {*constants, *(m.variable for m in starts)})
    return UserModel(
        fmu,
        joint,
        inputs,
        outputs,
        _parameters(fmu, parameters),
        starts,
        constants=constants,
        window=window,
        hold=hold,
        kind=kind or ways[0],
        notes=tuple(notes),
    )


def _mapped(
    fmu: UserFmu, channel: str, entry: str | tuple[str, float], kind: str, notes: list[str]
) -> Mapped:
    wanted = channel_unit(channel, kind)
    variable, scale = (entry, None) if isinstance(entry, str) else (entry[0], float(entry[1]))
    unit = fmu.real(variable).unit
    if scale is not None or not unit:
        return Mapped(channel, variable, 1.0 if scale is None else scale)
    try:
        given, own = base_unit(unit), base_unit(wanted)
    except InputError:
        notes.append(f"{variable}: unit {unit!r} is not known; taken as {wanted}")
        return Mapped(channel, variable)
    if not same_dimension(given, own):
        raise InputError(
            f"{fmu.path.name}: {variable} is in {unit}, channel {channel} in {wanted}; map another "
            f'variable, or convert: {channel} = {{ variable = "{variable}", scale = S }} with S in '
            f"{unit} per {wanted}"
        )
    factor = own.factor / given.factor
    if factor != 1.0:
        notes.append(f"{variable}: {unit} from {wanted} of {channel}, times {factor:.9g}")
    return Mapped(channel, variable, factor)


def _idle(fmu: UserFmu, inputs: Sequence[Mapped], given: set[str]) -> list[str]:
    """Inputs of the FMU that nothing drives, as notes."""
    driven = {m.variable for m in inputs} | given
    left = [v for v in fmu.variables.values() if v.causality == "input" and v.name not in driven]
    return [
        f"{fmu.path.name}: no channel drives its input {v.name}, which stays at "
        f"{v.start if v.start is not None else 'its start value'}; "
        "map it in [model.channels], or give it a number in [model.start]"
        for v in left
    ]


def _starts(
    fmu: UserFmu,
    start: Mapping[str, str | tuple[str, float] | Number],
    mapped: Sequence[Mapped],
    notes: list[str],
) -> tuple[tuple[Mapped, ...], dict[str, Number]]:
    starts: list[Mapped] = []
    constants: dict[str, Number] = {}
    scales = {m.channel: m.scale for m in mapped}
    for variable, entry in start.items():
        fmu.variable(variable)
        if isinstance(entry, bool | int | float):
            constants[variable] = entry
            continue
        fmu.real(variable)
        channel, scale = (entry, None) if isinstance(entry, str) else (entry[0], float(entry[1]))
        channel_unit(channel)
        if scale is None:
            scale = scales.get(channel, scales.get(_SLOPE_OF.get(channel, ""), 1.0))
            if scale != 1.0:
                notes.append(
                    f"{variable}: starts at {channel} times {scale:.9g}, as the channel is mapped"
                )
        starts.append(Mapped(channel, variable, scale))
    return tuple(starts), constants


def _parameters(
    fmu: UserFmu, parameters: Sequence[str] | Mapping[str, Bounds]
) -> tuple[UserParameter, ...]:
    found = []
    for name in parameters:
        variable = fmu.real(name)
        if variable.causality not in ("parameter", "local") or variable.start is None:
            raise InputError(
                f"{fmu.path.name}: {name!r} is no parameter that can be set ({variable.causality})"
            )
        given = parameters[name] if isinstance(parameters, Mapping) else (None, None)
        low, high = (
            theirs if mine is None else mine
            for mine, theirs in zip(given, own_bounds(variable), strict=True)
        )
        value = float(variable.start)
        if not low < high:
            raise InputError(
                f"{fmu.path.name}: {name} has bounds {low:g} to {high:g}; the first must be the "
                "smaller one"
            )
        found.append(UserParameter(name, min(max(value, low), high), float(low), float(high)))
    return tuple(found)


def own_bounds(variable: Any) -> tuple[float, float]:
    """The bounds that an FMU states for a variable; infinite ones where it states none."""
    low, high = variable.min, variable.max
    return -math.inf if low is None else float(low), math.inf if high is None else float(high)


def start_values(windows: Sequence[Window]) -> FloatArray:
    """Start values of all windows, (windows, starts)."""
    return np.array([w.start for w in windows])


__all__ = [
    "Bounds",
    "Mapped",
    "UserModel",
    "UserParameter",
    "at_least_one",
    "load_user_model",
    "own_bounds",
    "start_values",
]
