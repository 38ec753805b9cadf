"""How far the outputs of a user's FMU are from records."""

from __future__ import annotations

from collections.abc import Sequence

from identification.data.record import Record
from irj_fmu.imported.fit import Solver, UserFit, simulator_of
from irj_fmu.imported.model import UserModel, at_least_one
from irj_fmu.imported.outputs import UserComparison, comparison_of, noise_of
from irj_fmu.imported.port import coupled


def compare(model: UserModel | UserFit, records: Record | Sequence[Record]) -> UserComparison:
    """Compare a user's FMU with records; start values that come from channels are estimated,
    parameters are not.

    Parameters
    ----------
    model : UserModel or UserFit
        A fit is compared at its fitted values.
    records : Record or sequence of Record

    Raises
    ------
    InputError
        Unusable records.
    FmuError
        Where the FMU refuses a call.
    """
    model = model.model if isinstance(model, UserFit) else model
    given = at_least_one(records)
    windows = model.windows(given)
    noise = noise_of(model, given)
    model = model if model.coupling is not None else coupled(model, windows, noise)
    simulator, _ = simulator_of(model, windows, noise)
    solver = Solver(model, windows, simulator, noise, frozen=True)
    if model.starts:
        solver.solve(8)
    return comparison_of(model, given, windows, solver.predicted)


__all__ = ["compare"]
