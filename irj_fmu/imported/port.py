"""Where a correction torque acts on a user's FMU, where its position is read, and for how long the
torque may hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from identification.errors import InputError
from irj_fmu.host.run import FmuError
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.correction import CorrectionLaw, Port, steepest
from irj_fmu.imported.model import DRIVES, UserModel
from irj_fmu.imported.run import HOLD, RTOL, Runner, Window

POSITIONS: Final = ("motor_position", "link_position")
SHORTEST: Final = HOLD / 64
"""Shortest time for which a torque outside the FMU holds [s]: a run then takes 64 times as many
calls, and a law that asks for less is a step rather than a slope.
"""
STEADY: Final = 0.15
"""Share of an output's noise, both as RMS, that half the time between two readings of the law may
move the output by. The error falls with the square of that time, so that a fifth of the noise is
left of it at most: a twenty-fifth of what noise adds to the sum of squares.
"""
_PULSE: Final = 10
_TOO_STEEP: Final = "is so steep over velocity that its torque may hold for"
_PLACES: Final = 5
_SPEEDS: Final = 200
_SLOWEST: Final = 1e-5
"""Slowest velocity at which the slope of a law is looked for, as a share of the fastest."""


def port_of(model: UserModel) -> Port:
    """The torque input and the position output of a model.

    Raises
    ------
    InputError
        Where no drive channel or no position is mapped, or the motor constant is missing.
    """
    joint, name = model.joint, model.fmu.path.name
    drive = next(
        ((i, m) for c in DRIVES for i, m in enumerate(model.inputs) if m.channel == c), None
    )
    if drive is None:
        raise InputError(
            f"{name}: no drive channel is mapped to an input of the FMU; a correction torque "
            f"needs one of {', '.join(DRIVES)}"
        )
    channel = drive[1].channel
    per = {
        "motor_torque": joint.gear_ratio,
        "motor_current": joint.torque_per_current,
        "motor_voltage": joint.torque_per_voltage or 1.0,
    }[channel]
    if per is None:
        raise InputError(
            f"{joint.source or joint.name}: motor_current needs motor_constant (Nm/A on the "
            "motor shaft) or torque_per_current in [joint]"
        )
    place = next(
        ((i, m) for c in POSITIONS for i, m in enumerate(model.outputs) if m.channel == c), None
    )
    if place is None:
        raise InputError(
            f"{name}: no position is mapped to an output of the FMU; map motor_position or "
            "link_position"
        )
    motor = place[1].channel == "motor_position"
    side = joint.gear_ratio if motor else 1.0
    speed = next(
        (
            (i, m)
            for i, m in enumerate(model.outputs)
            if m.channel == ("motor_velocity" if motor else "link_velocity")
        ),
        None,
    )
    return Port(
        drive[0],
        place[0],
        per / drive[1].scale,
        1.0 / (side * place[1].scale),
        speed[0] if speed else None,
        1.0 / (side * speed[1].scale) if speed else 1.0,
    )


def feedback_of(model: UserModel, values: Mapping[str, float]) -> CorrectionLaw | None:
    """The correction of a model at values, as something that reads outputs and adds to inputs;
    None without one.
    """
    if model.correction is None:
        return None
    return CorrectionLaw(
        model.correction.with_values(values).model,
        port_of(model),
        len(model.inputs),
        hold_of(model),
    )


def hold_of(model: UserModel) -> float:
    """Longest time for which a torque outside the FMU holds [s]."""
    return HOLD if model.coupling is None else min(max(model.coupling, SHORTEST), HOLD)


def coupled(
    model: UserModel, windows: Sequence[Window], noise: FloatArray | None = None
) -> UserModel:
    """The model with the time for which the torque outside it may hold, at its present values.

    A torque T(w) that is read at a velocity and held for a time H is an explicit step of the
    velocity: it stays in phase up to H = J / max|dT/dw| and turns unstable at twice that. J is the
    inertia that the drive meets within such a time. H is halved from there until that no longer
    moves the outputs by more than a share of their noise (:data:`STEADY`): of what is left at half
    of it, a fit would make values of the parameters. Where the FMU's own step is longer a note says
    so.

    Parameters
    ----------
    model : UserModel
    windows : sequence of Window
        Where drive, position and velocity have been, and where the FMU starts.
    noise : (outputs,) array, optional
        Standard deviation of the noise of each output, in its unit; without it the slope alone
        decides.
    """
    if model.correction is None:
        return model
    found = replace(model, coupling=_by_slope(model, windows))
    return noted(found if noise is None else _steady(found, windows, noise))


def _by_slope(model: UserModel, windows: Sequence[Window]) -> float | None:
    """J / max|dT/dw| [s]; None where the torque has no slope over velocity, or nothing moves."""
    assert model.correction is not None
    port = port_of(model)
    drive = np.concatenate([w.inputs[:, port.input] for w in windows]) * port.torque
    place = np.concatenate([w.outputs[:, port.output] for w in windows]) * port.position
    fastest = max(_fastest(w, port) for w in windows)
    if not fastest > 0:
        return model.coupling
    speeds = fastest * np.geomspace(_SLOWEST, 1.0, _SPEEDS)
    speeds = np.concatenate([-speeds[::-1], [0.0], speeds])
    at = np.quantile(drive, [0.0, 0.5, 1.0]), np.quantile(place, np.linspace(0, 1, _PLACES))
    every = [x.ravel() for x in np.meshgrid(*at, speeds, indexing="ij")]
    slope = steepest(model.correction.model, every[0], every[1], every[2])
    inertia = _met(model, windows, port)
    return inertia / slope if slope > 0 and inertia is not None else None


def _steady(model: UserModel, windows: Sequence[Window], noise: FloatArray) -> UserModel:
    """The model with the longest of the halved times that leaves its outputs as they are."""
    runner, own = model.runner(), {p.name: p.value for p in model.parameters}
    runner.choose_substeps(windows[0], own)
    measured = np.concatenate([w.outputs for w in windows])
    limit = np.maximum(STEADY * noise, RTOL * np.ptp(measured, axis=0))

    def outputs(now: UserModel) -> FloatArray | None:
        law = feedback_of(now, now.values)
        try:
            return np.concatenate([runner.run(w, own, feedback=law) for w in windows])
        except (FmuError, InputError):  # held for too long the torque may throw it out of reach
            return None

    now, before = model, outputs(model)
    while hold_of(now) / 2 >= SHORTEST:
        half = replace(now, coupling=hold_of(now) / 2)
        after = outputs(half)
        if before is not None and after is not None:
            moved = np.sqrt(np.mean((after - before) ** 2, axis=0))
            if np.all(moved <= limit):
                break
        now, before = half, after
    return now


def noted(model: UserModel) -> UserModel:
    """The model with a note where the torque outside it cannot follow its own slope."""
    limit, grain = model.coupling or np.inf, model.fmu.grain(model.kind)
    shortest = max(SHORTEST, grain or 0.0)
    kept = tuple(n for n in model.notes if _TOO_STEEP not in n)
    if limit >= shortest * (1 - 1e-6):
        return replace(model, notes=kept)
    labels = ", ".join(model.correction.labels) if model.correction is not None else ""
    why = (
        f"its fixed step of {1e3 * grain:.3g} ms is longer; export it with a shorter step or for "
        "model exchange"
        if grain is not None and grain > SHORTEST
        else f"{1e3 * SHORTEST:.3g} ms is taken; give the law a wider smoothing velocity"
    )
    note = (
        f"{model.fmu.path.name}: {labels} outside it {_TOO_STEEP} {1e3 * limit:.2g} ms, and {why}"
    )
    return replace(model, notes=(*kept, note))


def _fastest(window: Window, port: Port) -> float:
    """Largest velocity of a window, link-referred [rad/s]."""
    if port.velocity is not None:
        return float(np.max(np.abs(window.outputs[:, port.velocity] * port.rate)))
    # over several samples: the noise of one difference of positions would stand above the motion
    step = min(_PULSE, len(window.time) - 1)
    q, t = window.outputs[:, port.output] * port.position, window.time
    return float(np.max(np.abs((q[step:] - q[:-step]) / (t[step:] - t[:-step]))))


def _met(model: UserModel, windows: Sequence[Window], port: Port) -> float | None:
    """Least inertia that the drive meets at the start of a few windows, within two steps of the
    coupling: behind a gear that gives way it is that of the motor [kg.m2].
    """
    runner, values = model.runner(), {p.name: p.value for p in model.parameters}
    size = float(np.max(np.abs([np.max(np.abs(w.inputs[:, port.input])) for w in windows])))
    step = max(HOLD, model.fmu.grain(model.kind) or 0.0)
    found = []
    for w in windows[:: max(1, len(windows) // _PLACES)]:
        first = slice(0, 3)
        short = Window(
            w.time[0] + step * np.arange(3), w.inputs[first], w.outputs[first], w.start, w.record
        )
        try:
            inertia = inertia_of(runner, short, values, port, size=size)
        except InputError:  # nothing moves from there: another start will tell
            continue
        found.append(abs(inertia * port.torque / port.position))
    return min(found, default=None)


def inertia_of(
    runner: Runner,
    window: Window,
    values: Mapping[str, float],
    port: Port,
    *,
    size: float | None = None,
) -> float:
    """Input per acceleration of the position, from the answer to a step at the start of a window.

    Parameters
    ----------
    size : float, optional
        Of the step; by default as large as the input of the window varies.

    Raises
    ------
    InputError
        Where the input does not move the position.
    """
    n = min(_PULSE, len(window.time))
    size = size or float(np.std(window.inputs[:, port.input])) or 1.0
    moved = window.inputs[:n].copy()
    moved[:, port.input] += size
    short = Window(window.time[:n], window.inputs[:n], window.outputs[:n], window.start)
    pushed = Window(window.time[:n], moved, window.outputs[:n], window.start)
    answer = (runner.run(pushed, values) - runner.run(short, values))[:, port.output]
    t = window.time[:n] - window.time[0]
    acceleration = float(answer @ (t**2 / 2) / np.sum((t**2 / 2) ** 2)) / size
    if not abs(acceleration) * size * float(t[-1]) ** 2 > 1e-12 * max(
        1.0, float(np.ptp(window.outputs[:, port.output]))
    ):
        raise InputError(
            f"{runner.fmu.path.name}: its drive input does not move its position; check the "
            "channels that are mapped"
        )
    return 1.0 / acceleration


__all__ = [
    "POSITIONS",
    "SHORTEST",
    "coupled",
    "feedback_of",
    "hold_of",
    "inertia_of",
    "noted",
    "port_of",
]
