"""A first joint file for somebody else's FMU, from its model description, a record and a few short
runs; every guess is written beside what it decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from casadi_models import EFFECTS
from identification.data.channels import channel_unit
from identification.data.check.checks import shown_ratio
from identification.data.guess import guess_columns
from identification.data.joint_file import Joint
from identification.data.plain_text import toml_key, toml_string
from identification.data.record import Record
from identification.data.units import base_unit, same_dimension
from identification.errors import InputError
from irj_fmu.host.fmu import FmuError
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.file import fmu_named
from irj_fmu.imported.library import Kind, UserFmu
from irj_fmu.imported.model import DRIVES, own_bounds
from irj_fmu.imported.run import Runner, Window

SIDES: Final = ("motor", "link")
WINDOW: Final = 0.5
"""Stretches that are simulated from their own starts [s]: the small error of a start grows no
further."""
SHORT: Final = 1e-3
"""Sample time of the runs that tell what a variable does [s]; an FMU of fixed step has its own."""
PUSHES: Final = (1e-3, 1e-1, 10.0, 1000.0)
"""What is added to a variable to see what it does, in its unit, the smallest that tells: dry
friction stops a velocity that is too small within a sample."""
ALIKE: Final = 0.05
"""Share by which two samples may differ from twice one where a start is a velocity: what drives the
joint would give three to four times."""
REACH: Final = 10.0
"""Factor below and above its start value within which a fit looks for a parameter that says no
bounds."""
WHOLE: Final = 3e-3
"""Share by which a gear ratio read from two encoders may miss a whole number: what a load twists a
gear adds to it."""


@final
@dataclass
class _Draft:
    """What is found, with the reasons."""

    channels: dict[str, tuple[str, float, str]] = field(default_factory=dict)
    starts: dict[str, tuple[str, float, str]] = field(default_factory=dict)
    parameters: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def first_joint(
    path: str | Path,
    record: Record,
    joint: Joint | None = None,
    *,
    folder: Path | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> str:
    """The text of a joint file whose model is an FMU.

    Parameters
    ----------
    path : str or Path
        The FMU.
    record : Record
        Only its channels are mapped; both positions give the gear ratio.
    joint : Joint, optional
        Gear ratio and motor constant where they are known.
    folder : Path, optional
        Where the file goes, see :func:`irj_fmu.imported.file.fmu_named`.
    progress : callable, optional
        ``progress(text, share)`` before each variable of the FMU is moved, for which it runs.

    Raises
    ------
    InputError
        An FMU that cannot be read, or none of whose outputs goes with a channel of the record.
    FmuError
        An FMU that does not run on this machine.
    """
    fmu = UserFmu(Path(path))
    kind = fmu.kinds()[0]
    draft = _Draft()
    ratio, why = _ratio(record, joint)
    known = joint or Joint(name=fmu.path.stem, kind=record.kind, gear_ratio=ratio)
    named = {
        c: [
            v
            for v in fmu.variables.values()
            if v.causality == c and v.type in ("Real", "Float64") and not v.shape
        ]
        for c in ("input", "output", "local", "parameter")
    }
    _channels(draft, named["input"], record, known, ratio, driving=True)
    _channels(draft, named["output"] or named["local"], record, known, ratio, driving=False)
    inputs = {v.name for v in named["input"]}
    outputs = {c: m for c, m in draft.channels.items() if m[0] not in inputs}
    if not outputs:
        there = ", ".join(f"{v.name} in {v.unit}" if v.unit else v.name for v in named["output"])
        raise InputError(
            f"{fmu.path.name}: no output goes with a channel of {record.name} (outputs: "
            f"{there or 'none'}; channels: {', '.join(record.channels)}); write "
            "[model.channels] by hand"
        )
    _run(fmu, kind, [m[0] for m in outputs.values()])
    moved = [*named["local"], *named["parameter"]]
    _starts(draft, fmu, kind, outputs, _each_told(moved, progress or (lambda text, share: None)))
    _parameters(draft, named["parameter"])
    return _text(draft, fmu_named(fmu.path, folder), kind, known, why)


def _ratio(record: Record, joint: Joint | None) -> tuple[float, str]:
    """The gear ratio and where it comes from."""
    if joint is not None:
        return joint.gear_ratio, "as given"
    shown = shown_ratio(record)
    if shown is None:
        both = record.has("motor_position") and record.has("link_position")
        one = "one side does not move" if both else "one side is recorded"
        return 1.0, f"CHECK: {one}; 1 where the FMU and the record are of one side"
    slope, bare = shown
    near = round(slope)
    found = float(near) if near and abs(slope / near - 1) < WHOLE else slope
    how = f" ({slope:.6g}, taken as a whole number: CHECK)" if found != slope else ""
    off = ", torsion taken off" if bare else ""
    return found, f"theta_motor / theta_link, from the two encoders of the record{off}{how}"


def _channels(
    draft: _Draft,
    variables: Sequence[Any],
    record: Record,
    joint: Joint,
    ratio: float,
    *,
    driving: bool,
) -> None:
    """Map variables to channels of the record, by name and unit."""
    taken: dict[str, str] = {}
    left = {v.name: v for v in variables}
    while left:
        units = {n: v.unit for n, v in left.items() if v.unit}
        guesses = guess_columns(list(left), units, record.kind)
        if not guesses:
            break
        for guess in guesses:
            variable = left.pop(guess.column.column)
            wanted = guess.column.channel
            if driving and wanted.startswith("link_") and "no side" in guess.reason:
                wanted = wanted.replace("link_", "motor_")
            reason = guess.reason
            if wanted != guess.column.channel:
                reason = reason.replace("link side", "motor side")
            found = _through(wanted, record, joint, ratio, driving=driving)
            if found is None:
                draft.notes.append(f"{variable.name}: looks like {wanted}, which is not recorded")
                continue
            channel, scale, how = found
            if channel in taken or channel in draft.channels:
                other = taken.get(channel) or draft.channels[channel][0]
                draft.notes.append(f"{variable.name}: could be {channel} in place of {other}")
                continue
            factor, said = _units(variable.unit, channel_unit(wanted, record.kind))
            if factor is None:
                draft.notes.append(f"{variable.name}: looks like {channel}, but {said}")
                continue
            scale *= factor
            taken[channel] = variable.name
            reason = "; ".join(filter(None, (reason, how, said)))
            draft.channels[channel] = (variable.name, scale, reason)
    draft.notes += [f"{n}: says nothing that tells its channel" for n in left]


def _through(
    wanted: str, record: Record, joint: Joint, ratio: float, *, driving: bool
) -> tuple[str, float, str] | None:
    """The recorded channel that goes with a wanted one: itself, the current of a torque, or the
    other side through the gear ratio; with the factor and how.
    """
    if record.has(wanted):
        return wanted, 1.0, ""
    if driving and wanted == "motor_torque" and record.has("motor_current"):
        constant = joint.torque_per_current
        if constant is None:
            return "motor_current", 1.0, "CHECK the scale: torque of the input per ampere"
        return "motor_current", constant / joint.gear_ratio, "motor constant of the joint"
    side, _, quantity = wanted.partition("_")
    if driving or side not in SIDES or quantity not in ("position", "velocity"):
        return None
    other = SIDES[1 - SIDES.index(side)]
    channel = f"{other}_{quantity}"
    if not record.has(channel):
        return None
    return channel, ratio if side == "motor" else 1 / ratio, "the other side, by the gear ratio"


def _units(unit: str | None, wanted: str) -> tuple[float | None, str]:
    """Variable / channel by their units and what is unsure of it; 1 where the FMU states none, None
    where it states one of another quantity.
    """
    if not unit:
        degrees = f"; {math.degrees(1):.10g} where it has degrees" if wanted == "rad" else ""
        return 1.0, f"CHECK: the FMU states no unit, taken as {wanted}{degrees}"
    try:
        given, own = base_unit(unit), base_unit(wanted)
    except InputError:
        return 1.0, f"CHECK the scale: its unit {unit!r} is not known, taken as {wanted}"
    if not same_dimension(given, own):
        return None, f"it is in {unit} and the channel in {wanted}; map it with a scale if it is"
    return own.factor / given.factor, ""


def _each_told(variables: Sequence[Any], progress: Callable[[str, float], None]) -> Iterator[Any]:
    """The variables, each told before it is moved."""
    for k, v in enumerate(variables):
        progress(f"what {v.name} starts"[:40], k / len(variables))
        yield v
    progress("done", 1.0)


def _starts(
    draft: _Draft,
    fmu: UserFmu,
    kind: Kind,
    outputs: Mapping[str, tuple[str, float, str]],
    variables: Iterable[Any],
) -> None:
    """Find the start values of positions and velocities by what they do: each is moved, and the
    FMU runs for two samples.
    """
    places = {c: m for c, m in outputs.items() if c.endswith("_position")}
    if not places:
        return
    names = [m[0] for m in places.values()]
    for v in variables:
        if v.start is None:
            continue
        for push in PUSHES:
            try:
                change = _change(fmu, kind, v.name, (float(v.start), push), names)
            except (FmuError, InputError):
                break  # it cannot be set: no start value
            told = _told(change, push, fmu.grain(kind) or SHORT)
            if told is None:
                continue
            number, slope, steady = told
            channel, (_, scale, _) = list(places.items())[number]
            kept, how = scale / slope, "moves that position at once"
            if steady:
                channel, how = (
                    channel.replace("position", "velocity"),
                    "moves that position steadily",
                )
            if channel not in [c for c, _, _ in draft.starts.values()]:
                draft.starts[v.name] = (channel, kept, how)
            break
    # a velocity is the rate of the position that is started, in its unit
    positions = {c: k for c, k, _ in draft.starts.values()}
    for name, (channel, scale, how) in draft.starts.items():
        whole = positions.get(channel.replace("velocity", "position"), scale)
        if abs(scale / whole - 1) < 2 * ALIKE:
            draft.starts[name] = (channel, whole, how)


def _told(change: FloatArray, push: float, step: float) -> tuple[int, float, bool] | None:
    """Which position a push moves, by how much for each unit of it (or in each second), and whether
    steadily; None where it is no start value.
    """
    size = np.abs(change).max(axis=0)
    number = int(np.argmax(size))
    at, most = change[:, number], float(size[number])
    if not most > 0:
        return None
    if abs(at[0]) > (1 - ALIKE) * most:
        return number, round(float(at[0]) / push, 9), False
    straight = abs(at[2] - 2 * at[1]) < ALIKE * abs(at[2])
    if abs(at[0]) < ALIKE * abs(at[1]) and straight:
        return number, float(at[1]) / (push * step), True
    return None


def _change(
    fmu: UserFmu, kind: Kind, name: str, given: tuple[float, float], outputs: Sequence[str]
) -> FloatArray:
    """What a push (value, push) of a variable changes in outputs over two samples, (3, outputs)."""
    value, push = given
    runs = [_run(fmu, kind, outputs, {name: value + more}) for more in (0.0, push)]
    return np.asarray(runs[1] - runs[0])


def _run(
    fmu: UserFmu, kind: Kind, outputs: Sequence[str], starts: Mapping[str, float] | None = None
) -> FloatArray:
    """Outputs over two samples, (3, outputs)."""
    own = starts or {}
    runner = Runner(fmu, kind, inputs=(), outputs=outputs, starts=tuple(own), settings={})
    time = (fmu.grain(kind) or SHORT) * np.arange(3.0)
    none = np.empty((3, 0))
    return runner.run(Window(time, none, none, np.array(list(own.values()))), {})


def _parameters(draft: _Draft, variables: Sequence[Any]) -> None:
    """Parameters that a fit may move, with bounds."""
    for v in variables:
        if v.name in draft.starts or v.start is None:
            continue
        own = own_bounds(v)
        if own[0] < own[1] and all(map(math.isfinite, own)):
            draft.parameters[v.name] = "{}  # bounds of the FMU"
            continue
        value = float(v.start)
        ends = sorted((value / REACH, value * REACH))
        low, high = max(ends[0], own[0]), min(ends[1], own[1])
        if not (low < high and math.isfinite(low) and math.isfinite(high)):
            said = (
                f"bounds {own[0]:g} to {own[1]:g}" if any(map(math.isfinite, own)) else "no bounds"
            )
            draft.notes.append(f"{v.name}: starts at {value:g} and says {said}; add it with bounds")
            continue
        cut = ", within the FMU's own bound" if [low, high] != ends else ""
        draft.parameters[v.name] = (
            f"{{ low = {low:.6g}, high = {high:.6g} }}  # start value {value:g}, a factor "
            f"of {REACH:g} either way{cut}"
        )


def _text(draft: _Draft, fmu: str, kind: Kind, joint: Joint, why: str) -> str:
    effects = [
        key for key in EFFECTS if any(key in n.lower().split(".")[-1] for n in draft.parameters)
    ]
    lines = [
        "# Guesses from the FMU's model description and a record: check every line.",
        "[joint]",
        f"name = {toml_string(joint.name)}",
        f'kind = "{joint.kind}"',
        f"gear_ratio = {joint.gear_ratio!r}  # {why}",
    ]
    if joint.torque_per_current is not None:
        lines.append(f"torque_per_current = {joint.torque_per_current!r}")
    lines.append(
        f"effects = [{', '.join(toml_string(e) for e in effects)}]  # what the FMU holds, by the "
        "names of its parameters; a diagnosis does not propose it"
    )
    lines += [
        "",
        "[model]",
        f"fmu = {toml_string(fmu)}",
        f'kind = "{kind}"',
        f"window = {WINDOW!r}" if draft.starts else "# window: nothing was found that starts it",
        "",
        "[model.channels]",
    ]
    for channel, (name, scale, reason) in draft.channels.items():
        entry = f"{{ variable = {toml_string(name)}, scale = {scale!r} }}"
        lines.append(f"{channel} = {entry}  # {reason}")
    if not any(c in DRIVES for c in draft.channels):
        lines.append("# CHECK: no input goes with a recorded drive; a diagnosis needs one")
    lines += ["", "[model.parameters]"]
    lines += [f"{toml_key(n)} = {entry}" for n, entry in draft.parameters.items()]
    lines += ["", "[model.start]"]
    for name, (channel, scale, reason) in draft.starts.items():
        entry = f"{{ channel = {toml_string(channel)}, scale = {scale!r} }}"
        lines.append(f"{toml_key(name)} = {entry}  # {reason}")
    lines += ["", *(f"# {note}" for note in draft.notes)] if draft.notes else []
    return "\n".join(map(_one_line, lines)) + "\n"


def _one_line(line: str) -> str:
    """A line of the file; names and units in its comment may hold line breaks, which would end
    it."""
    return " ".join(line.splitlines())


__all__ = ["first_joint"]
