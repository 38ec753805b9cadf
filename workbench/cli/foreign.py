"""explore and track where the joint file's model is a user's FMU."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from identification.data.formats import words
from identification.errors import InputError
from workbench.cli.explore import begun, delivered, print_exploration
from workbench.cli.files import progress_bar, write_json
from workbench.cli.loop import print_warnings
from workbench.cli.user_fmu import new_notes, one_line, open_mapped, open_model

if TYPE_CHECKING:
    from irj_fmu.imported.model import UserModel
    from irj_fmu.imported.verbs.track import UserTrack


@one_line
def run_explore(arguments: Namespace) -> int:
    """`irj explore REC --joint J` with an FMU as the model: effects at its ports."""
    from irj_fmu.imported.file import user_joint_text
    from irj_fmu.imported.verbs.explore import explore

    begun(arguments)
    model, records, _ = open_model(arguments)
    held, _ = open_mapped(arguments.held_out, model)
    found = explore(model, records, held, progress=progress_bar)
    progress_bar("done", 1.0)
    new_notes(model, found.model)
    print_warnings(found.found.warnings, [*records, *held])
    if found.why_followed:
        print(f"irj: seen at the drive alone: {found.why_followed}", file=sys.stderr)
    print_exploration(found.found)
    for label in found.aside:
        print(
            f"irj: {label} cannot ride outside the FMU as a torque at its drive: it is named, not "
            "added",
            file=sys.stderr,
        )

    def text() -> str:
        return user_joint_text(found.model, folder=Path(arguments.output).resolve().parent)

    delivered(arguments, found.found, found.as_json(), [*records, *held], text)
    if arguments.output:
        print(f"fit it next: irj fit REC... --joint {arguments.output}")
    return 0


@one_line
def run_track(arguments: Namespace) -> int:
    """`irj track REC --joint J` with an FMU as the model: 1 where ``--fail-on-fault`` was given and
    something is wrong.
    """
    from irj_fmu.imported.verbs.track import Watch

    for option, instead in (
        ("inject", "write the fault into a copy of the record"),
        ("follow", "track the record when it is complete"),
        ("report", "--json holds the course of the residuals"),
    ):
        given = getattr(arguments, option, None)
        if given is not None and given != []:
            raise InputError(
                f"{arguments.joint}: its model is an FMU, whose outputs are followed window by "
                f"window; --{option} goes with a joint model, leave it out: {instead}"
            )
    model, records, warnings = open_model(arguments)
    healthy, more = open_mapped(arguments.healthy, model)
    watch = Watch(model, healthy, progress=progress_bar)
    found = [watch.run(r) for r in records]
    for path, track in zip(arguments.records, found, strict=True):
        _print_track(path, track, model)
    data = [t.as_json() for t in found]
    write_json(arguments.json, {"records": data, "warnings": [*warnings, *more]})
    return 1 if arguments.fail_on_fault and any(t.alarms for t in found) else 0


def _print_track(path: str, track: UserTrack, model: UserModel) -> None:
    print(f"{path}: parameters of {model.fmu.path.name} as in the joint file, outputs followed")
    ratios = (f"{words(c)} {r:.3g}" for c, r in track.ratios.items())
    print(f"  residual over noise: {', '.join(ratios)}")
    for alarm in track.alarms:
        print(f"  {alarm.first:.3f} s to {alarm.last:.3f} s: {alarm.text}")
    if not track.calibrated:
        print("  limits are guesses: give records of the healthy joint with --healthy")
    if not track.alarms:
        print("  nothing is wrong")


__all__ = ["run_explore", "run_track"]
