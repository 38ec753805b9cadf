"""next: the run that would tell names apart, or what a planned run cannot show."""

from __future__ import annotations

import math
from argparse import Namespace
from typing import Any, Final

from identification.diagnosis.improve import improve
from identification.errors import InputError
from identification.planning.blind import blind_spots
from identification.planning.motion import Motion
from identification.planning.next_run import next_run
from identification.planning.runs import Run, refuse_clamped
from identification.planning.trajectories import Limits
from workbench.cli.files import (
    alike,
    distinct,
    open_joint,
    open_records,
    progress_bar,
    write_json,
    write_text,
)
from workbench.cli.loop import print_warnings, training

UNPLANNED: Final = Run("multisine", 0.0, math.radians(60.0), math.radians(60.0))
"""The motion that is judged where no file is given and nothing has been recorded [rad, rad/s]."""
UNPLANNED_SECONDS: Final = 20.0


def run_next(arguments: Namespace) -> int:
    """`irj next [REC...] --joint J`."""
    rotary = open_joint(arguments.joint).kind == "rotary"
    limits = Limits(
        *(
            _limit(arguments, name, rotary and name != "max_torque")
            for name in ("max_position", "max_speed", "max_torque")
        )
    )
    data = _before(arguments, limits) if not arguments.records else _after(arguments, limits)
    write_json(arguments.json, data)
    return 0


def _limit(arguments: Namespace, option: str, degrees: bool) -> float:
    value = getattr(arguments, option)
    if value is None:
        return math.inf
    if not value > 0:
        raise InputError(f"--{option.replace('_', '-')} {value:g}: give a limit above 0")
    return math.radians(value) if degrees else float(value)


def _before(arguments: Namespace, limits: Limits) -> dict[str, Any]:
    """What a planned run cannot show."""
    joint = open_joint(arguments.joint)
    if arguments.planned:
        motion = Motion.load(arguments.planned)
    else:
        half = min(UNPLANNED.half, limits.position)
        speed = min(UNPLANNED.speed, limits.speed)
        motion = Run("multisine", 0.0, half, speed).motion(UNPLANNED_SECONDS, 2e-3)
    found = blind_spots(joint, motion)
    unit = "rad" if joint.kind == "rotary" else "m"
    low, high = float(motion.position.min()), float(motion.position.max())
    print(
        f"planned: {motion.family}, {low:.3g} to {high:.3g} {unit}, up to "
        f"{float(abs(motion.velocity).max()):.3g} {unit}/s"
    )
    print(found)
    if arguments.output:
        write_text(arguments.output, motion.text)
        print(f"motion: {arguments.output}")
    return found.as_json()


def _after(arguments: Namespace, limits: Limits) -> dict[str, Any]:
    """The run that separates what ties on the records."""
    if arguments.planned:
        raise InputError("--motion goes without records: it says what a planned run cannot show")
    distinct(
        training=arguments.records,
        other_payload=arguments.other_payload,
        held_out=arguments.held_out,
    )
    joint = open_joint(arguments.joint)
    records, _ = training(arguments.records, arguments.other_payload, joint)
    held, _ = open_records(arguments.held_out, joint)
    paths = [*arguments.records, *arguments.other_payload, *arguments.held_out]
    refuse_clamped(alike(paths, [*records, *held], joint), records[0].name)
    improved = improve(records, joint, held, progress=lambda text, s: progress_bar(text, 0.7 * s))
    found = next_run(
        improved, limits=limits, progress=lambda text, s: progress_bar(text, 0.7 + 0.3 * s)
    )
    progress_bar("done", 1.0)
    print_warnings(improved.warnings, [*records, *held])
    for claim in improved.claims:
        print(f"claim: {' or '.join(claim.effects)} ({claim.balance} balance)")
    print(found)
    motion = found.motion
    if motion is not None:
        print(f"limits: {found.space.source}")
    if arguments.output and motion is not None:
        write_text(arguments.output, motion.text)
        print(f"motion: {arguments.output}")
    elif arguments.output:
        print(f"no run is proposed: {arguments.output} is not written")
    file = arguments.output if motion is not None else None
    return {**found.as_json(), "file": file, "warnings": list(improved.warnings)}
