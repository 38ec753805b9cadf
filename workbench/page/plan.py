"""Planning the next experiment: what the records leave open, and the motion that makes the
parameters identifiable.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from casadi_models import EFFECTS, JointModel
from identification.diagnosis.candidates import shown_by_parts
from identification.errors import InputError
from workbench.page.analysis import Progress, clean
from workbench.page.jobs.place import Place
from workbench.page.records import decimated
from workbench.page.session import State, write_atomic
from workbench.show.words import run_that_shows, title_of

if TYPE_CHECKING:
    from identification.planning.trajectories import Excitation

LIMITS: Final = {"position": 80.0, "speed": 60.0, "torque": 400.0}
"""Limits where none are given [deg, deg/s, N.m], as in `irj plan`."""
GOOD: Final = 0.1
"""Relative standard deviation up to which a parameter counts as identifiable."""
STRIDE: Final = 20
FILE: Final = "plan.json"
MOTION: Final = "motion.csv"


@final
@dataclass(frozen=True)
class Request:
    """What is to be planned.

    Attributes
    ----------
    position, speed, torque : float
        What the joint may do: half of its range [deg], [deg/s], on the link side [N.m].
    label : str
        An effect that the motion must show too; empty for none.
    """

    position: float
    speed: float
    torque: float
    label: str = ""


def request_of(body: Mapping[str, Any]) -> Request:
    """The request in the body of a call.

    Raises
    ------
    InputError
        A limit that is no positive number.
    """
    numbers = {}
    for key, usual in LIMITS.items():
        given, word = body.get(key), {"position": "range", "torque": "drive torque"}.get(key, key)
        try:
            numbers[key] = usual if given in (None, "") else float(given)
        except (TypeError, ValueError):
            raise InputError(f"plan: the {word} is {given!r}; give a number") from None
        if not (math.isfinite(numbers[key]) and numbers[key] > 0):
            raise InputError(f"plan: the {word} is {numbers[key]:g}; give a positive number")
    return Request(**numbers, label=str(body.get("label") or ""))


def open_questions(state: State, kind: str) -> list[dict[str, Any]]:
    """What the last diagnosis could not answer, and the run that would on this kind of axis."""
    left = state.left_open
    out = [
        {"kind": "warning", "title": "The records themselves", "text": text, "run": ""}
        for text in left.get("warnings", [])
    ]
    claim = (state.diagnosis or {}).get("claim")
    if claim and len(claim["effects"]) > 1:
        names = " or ".join(EFFECTS[e].title for e in claim["effects"])
        out.append(
            {
                "kind": "set",
                "title": names,
                "text": "cannot be told apart on these records",
                "run": claim.get("separate_by") or "",
            }
        )
    for step in state.steps:
        if len(step.names) > 1:
            names = " or ".join(EFFECTS[e].title for e in step.names if e in EFFECTS)
            out.append(
                {
                    "kind": "set",
                    "title": names,
                    "text": "one of these was added; the records cannot say which",
                    "run": step.separate_by or "",
                }
            )
    inside = (
        {label.partition("@")[0] for label in state.steps[-1].effects} if state.steps else set()
    )
    for n in left.get("not_testable", []):
        if n["effect"] in inside or shown_by_parts(n["why"]):
            continue
        out.append(
            {
                "kind": "untested",
                "title": n["title"],
                "text": n["why"],
                "run": run_that_shows(n["effect"], kind),
            }
        )
    return out


def plan(live: Place, asked: Request, folder: Path, progress: Progress) -> Path:
    """Try the motions of the thesis on the fitted joint in simulation; the best one is a file in
    `folder`.

    Raises
    ------
    InputError
        A rigid or linear joint; no motion keeps the limits.
    """
    from identification.planning.trajectories import (
        Experiment,
        Limits,
        sinusoidal_grid,
        triangular_grid,
    )

    model, note = _model(live, asked.label)
    reach = math.radians(asked.position)
    limits = Limits(reach, math.radians(asked.speed), asked.torque)
    speeds, periods = np.radians(np.linspace(15.0, 45.0, 5)), np.linspace(0.5, 6.0, 6)
    motions = [
        *triangular_grid(speeds.tolist(), limit=min(reach * 0.95, math.radians(80))),
        *sinusoidal_grid(speeds.tolist(), periods.tolist()),
    ]
    experiment = Experiment(model, stride=STRIDE)
    tried = []
    for k, motion in enumerate(motions):
        progress(f"trying motion {k + 1} of {len(motions)}", 0.95 * k / len(motions))
        tried.append(experiment.evaluate(motion, limits=limits))
    allowed = [t for t in tried if not t.broken]
    if not allowed:
        broken = ", ".join(sorted({b for t in tried for b in t.broken}))
        raise InputError(f"plan: no motion keeps the limits ({broken}); widen them")
    best = min(allowed, key=_order)
    _write_motion(folder / MOTION, best)
    found = clean(
        {
            **_shown(best, model),
            "tried": [_row(t, t is best) for t in tried],
            "note": note,
            "label": asked.label,
            "limits": {"position": asked.position, "speed": asked.speed, "torque": asked.torque},
        }
    )
    path = folder / FILE
    write_atomic(path, json.dumps(found, allow_nan=False).encode())
    return path


def _model(live: Place, label: str) -> tuple[JointModel, str]:
    """The joint to simulate, and what was left out of it or assumed."""
    from identification.data.typical import true_values

    joint = live.joint()
    solution = live.analysis().solution if live.state.steps else None
    model = solution.model if solution is not None else joint.model()
    if joint.kind != "rotary" or not model.is_elastic:
        raise InputError(
            "plan: simulates a rotary elastic joint; choose a model such as hd3 (a rigid one is "
            "excited by any motion that reverses)"
        )
    notes = (
        []
        if solution is not None
        else [
            "Nothing is fitted yet: typical values were taken, so read the figures as orders of "
            "magnitude."
        ]
    )
    for term in model.terms:
        if term.effect.is_delay:
            model = model.drop(term.label)
    if label and label not in model.effects:
        try:
            model = model.add(label)
        except (KeyError, ValueError) as error:
            raise InputError(f"plan: {title_of(label)}: {error.args[0]}") from None
    remembering = {t.label for t in model.terms if t.effect.memory is not None}
    for name in sorted(remembering):
        model = model.drop(name)
    if remembering:
        titles = ", ".join(EFFECTS[n.partition("@")[0]].title for n in sorted(remembering))
        notes.append(f"Left out, because it has internal states: {titles}.")
    known = {k: float(v) for k, v in (solution.values if solution is not None else {}).items()}
    values = {
        **true_values(model, joint),
        **{k: v for k, v in known.items() if k in model.parameter_names},
    }
    return model.with_values(values), " ".join(notes)


def _order(found: Excitation) -> tuple[int, float]:
    """The best motion first: fewest parameters that stay unknown, then the smallest worst
    deviation.
    """
    finite = [d for d in found.relative_deviation.values() if math.isfinite(d)]
    return len(found.relative_deviation) - len(finite), max(finite, default=math.inf)


def _row(tried: Excitation, best: bool) -> dict[str, Any]:
    known, worst = _order(tried)
    speed = tried.motion.parameters.get("speed")
    return {
        "family": tried.motion.family,
        "speed": math.degrees(speed) if speed is not None else None,
        "period": tried.motion.parameters.get("period"),
        "worst": 100 * worst,
        "unknown": known,
        "broken": list(tried.broken),
        "best": best,
        "known": sum(tried.identifiable(GOOD).values()),
        "of": len(tried.parameters),
    }


def _shown(best: Excitation, model: JointModel) -> dict[str, Any]:
    motion = best.motion
    columns: Sequence[Any] = [np.degrees(motion.position), np.degrees(motion.velocity)]
    stamps, drawn, full = decimated(motion.time, columns, 600)
    named = zip(("position", "velocity"), ("deg", "deg/s"), drawn, strict=True)
    series = [{"name": n, "unit": u, "values": [float(f"{v:.6g}") for v in c]} for n, u, c in named]
    units = {p.name: p for p in model.parameters}
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    return {
        "family": motion.family,
        "parameters": dict(motion.parameters),
        "duration": float(motion.time[-1]),
        "condition": best.condition,
        "motion": {"time": [float(f"{t:.6g}") for t in stamps], "series": series, "full": full},
        "deviations": [
            {
                "name": n,
                "meaning": units[n].meaning,
                "value": values[n],
                "unit": units[n].unit,
                "percent": 100 * d,
                "good": d <= GOOD,
            }
            for n, d in best.relative_deviation.items()
        ],
        "by_effect": {k: bool(v) for k, v in best.by_effect(model, GOOD).items()},
    }


def _write_motion(path: Path, best: Excitation) -> None:
    from identification.planning.trajectories import COLUMNS

    text = io.StringIO()
    np.savetxt(
        text,
        np.column_stack([best.motion.time, best.motion.table]),
        delimiter=",",
        header=",".join(COLUMNS),
        comments="",
        fmt="%.9g",
    )
    write_atomic(path, text.getvalue().encode())


def stored(folder: Path) -> dict[str, Any]:
    """The last plan, or ``{}``."""
    try:
        found: dict[str, Any] = json.loads((folder / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found


__all__ = ["LIMITS", "MOTION", "Request", "open_questions", "plan", "request_of", "stored"]
