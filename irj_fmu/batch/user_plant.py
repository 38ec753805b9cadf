"""A joint file whose model is a user's FMU as a model of a study: what its channels feed, where it
starts, what it is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, final

from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.batch.checks import Value
from irj_fmu.batch.study import ModelEntry
from irj_fmu.host.signals import Table
from irj_fmu.imported.model import UserModel

BUILT: Final = ("add", "drop", "controller", "motion", "sensors")
"""Keys of [[model]] that go with an FMU that is built."""


@final
@dataclass(frozen=True)
class UserPlant:
    """A user's FMU with the mapping of its joint file.

    Attributes
    ----------
    model : UserModel
    fmu : Path
        What is run: the user's FMU, or with an effect outside the corrected one.
    """

    model: UserModel
    fmu: Path

    def start(self, record: Record | None, *, state: bool) -> dict[str, Value]:
        """Start values: fitted parameters, constants, and, where `state`, the record's first
        readings.
        """
        model = self.model
        own: dict[str, Value] = {p.name: p.value for p in model.parameters}
        found = {**own, **model.constants}
        if record is None or not state:
            return found
        (first, *_) = replace(model, window=None).windows([record])
        names = [m.variable for m in model.starts]
        return {**found, **dict(zip(names, first.start.tolist(), strict=True))}

    def fed(self, record: Record) -> dict[str, Table]:
        """Signals of the inputs."""
        time = record.time - record.time[0]
        return {
            m.variable: Table(time, m.scale * record[m.channel], hold=self.model.hold)
            for m in self.model.inputs
        }

    def measured(self, record: Record, names: tuple[str, ...]) -> dict[str, Table]:
        """Measured signals of the outputs among `names` that the record has."""
        time = record.time - record.time[0]
        return {
            m.variable: Table(time, m.scale * record[m.channel], hold=False)
            for m in self.model.outputs
            if m.variable in names and record.has(m.channel)
        }


def user_plant(entry: ModelEntry, out: Path) -> UserPlant:
    """The FMU of a joint file, ready to run.

    Parameters
    ----------
    entry : ModelEntry
    out : Path
        File of the corrected FMU, where an effect rides outside.

    Raises
    ------
    InputError
        A key that goes with an FMU that is built; an FMU that cannot be run.
    """
    from irj_fmu.imported.file import load_user_joint

    given = next((key for key in BUILT if getattr(entry, key)), None)
    given = 'kind = "estimator"' if entry.kind == "estimator" else given
    if given is not None:
        raise InputError(
            f"{entry.path}: its model is an FMU, which is run as it is; take {given} out"
        )
    model = load_user_joint(entry.path)
    model.fmu.kinds()  # says what is missing
    if model.correction is None:
        return UserPlant(model, model.fmu.path)
    from irj_fmu.corrected.build import export_corrected

    return UserPlant(model, export_corrected(model, out))


__all__ = ["UserPlant", "user_plant"]
