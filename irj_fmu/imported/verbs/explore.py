"""Explore: variants of a user's FMU, as it is and with effects of the library at its ports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

from casadi_models import JointModel
from identification.balance.dataset import Dataset
from identification.data.record import Record
from identification.diagnosis.candidates import NotTestable
from identification.diagnosis.session import MAX_ADDITIONS, Session
from identification.diagnosis.trials import Base
from identification.errors import InputError
from identification.fitting.engine import Solution
from identification.variants.exploration import Exploration, Variant
from identification.variants.explore import Search, part_of
from identification.variants.lattice import Node, added_to, droppable, nodes_of
from identification.variants.refit import STEPS, Refit, Weighting, refit_of
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.diagnose import LaidOpen, laid_open, stays, with_outside
from irj_fmu.imported.fit import UserFit, fit
from irj_fmu.imported.model import UserModel, at_least_one

_PARTS: Final = (0.0, 0.2, 0.5, 0.6, 1.0)
"""Shares of the time of fit, decision of `improve`, restarts about it, and search."""


@final
@dataclass(frozen=True)
class UserExploration:
    """Variants of a user's FMU, held against each other on what its restarts leave.

    Attributes
    ----------
    model : UserModel
        The FMU as the recommended variant has it: its parameters beside the effects, and outside it
        those that can ride there.
    found : Exploration
        Variants as of a joint model; their labels are effects beside the FMU.
    aside : tuple of str
        Labels of the recommended variant that cannot ride outside the FMU: named, not added.
    why_followed : str
        See :class:`irj_fmu.imported.diagnose.UserDiagnosis`.
    """

    model: UserModel
    found: Exploration
    aside: tuple[str, ...] = ()
    why_followed: str = ""

    def as_json(self) -> dict[str, Any]:
        """The data of `explore --json`, with the FMU and its values in the recommended variant."""
        return {
            **self.found.as_json(),
            "fmu": self.model.fmu.path.name,
            "values": self.model.values,
            "named_only": list(self.aside),
        }

    def __repr__(self) -> str:
        return f"UserExploration({self.model.fmu.path.name!r})\n{self.found!r}"


@final
class FmuGround:
    """What an FMU leaves in records, as the model whose variants are held against each other.

    Parameters
    ----------
    opened : LaidOpen
    """

    def __init__(self, opened: LaidOpen) -> None:
        self.session: Session = opened.session
        self.ladder: Record | None = None
        self._bench = opened.bench

    def nodes(self, model: JointModel) -> tuple[list[Node], tuple[NotTestable, ...]]:
        """Effects that the FMU can lack."""
        return nodes_of(model, self._bench.data, self._bench.offered)

    def droppable(self, model: JointModel) -> tuple[str, ...]:
        """What was added: the spring and the damper that are balanced are the FMU's own."""
        added = added_to(self._bench.start().model, model)
        return tuple(label for label in droppable(model) if label in added)

    def base(self, solution: Solution) -> Base:
        """Rows of a fit with the FMU's parameters as nuisance."""
        return self._bench.base(solution)

    def data_of(self, solution: Solution) -> Dataset:
        """The records with the FMU's parameters where a fit has moved them."""
        return self._bench.data_of(solution)

    def refitted(
        self,
        model: JointModel,
        starts: tuple[Mapping[str, float], ...],
        weighting: Weighting,
    ) -> Refit:
        """A variant with the FMU's parameters moved along; a fold of the cross-validation finds
        them anew.
        """
        bench = self._bench
        solution, cost = min(
            (bench.stepped(model, s, weighting.like, iterations=STEPS) for s in starts),
            key=lambda f: f[1],
        )
        data = bench.data_of(solution)
        return refit_of(solution, cost, data, weighting, lambda s: bench.based(s, data))


def explore(
    model: UserModel | UserFit,
    records: Record | Sequence[Record],
    held_out: Record | Sequence[Record] = (),
    *,
    progress: Callable[[str, float], None] | None = None,
) -> UserExploration:
    """Score all variants of a user's FMU and fit the best of them.

    The FMU is fitted by its outputs and `improve` decides what is missing. About the values that
    this leaves the FMU is run once more for each of its parameters; in the variants these move as
    far as that is linear.

    Parameters
    ----------
    model : UserModel or UserFit
        With a drive channel mapped to an input and a position to an output.
    records, held_out : Record or sequence of Record
        Without held-out records blocks of the training records are held out.
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Unusable records or channels; records that cannot carry the question.
    FmuError
        Where the FMU refuses a call.
    """
    parts = [part_of(progress, a, b - a) for a, b in zip(_PARTS[:-1], _PARTS[1:], strict=True)]
    given = at_least_one(records)
    if not isinstance(model, UserFit) and model.parameters:
        model = fit(model, given, progress=parts[0])
    now = model.model if isinstance(model, UserFit) else model
    first = laid_open(now, given, held_out, progress=parts[1])
    improvement = first.session.run(first.session.start(), MAX_ADDITIONS)
    if improvement.ranking is None:
        raise InputError(improvement.reason)
    last = improvement.steps[-1].solution
    about = _moved(now, first.bench.changes(last))
    opened = laid_open(about, given, held_out, progress=parts[2])
    start = opened.session.start()
    found = Search(FmuGround(opened), start, parts[3]).result(improvement)
    return _told(about, opened, found)


def _moved(model: UserModel, changes: Mapping[str, float]) -> UserModel:
    """The model with its values changed by so much."""
    own = model.values
    return model.with_values({n: own[n] + x for n, x in changes.items()})


def _told(model: UserModel, opened: LaidOpen, found: Exploration) -> UserExploration:
    """The recommended variant as a model."""
    best = found.recommended
    now = _moved(model, opened.bench.changes(best.solution))
    joint, aside = best.solution.model, []
    for label in best.added:
        term = next(t for t in joint.terms if t.label == label)
        if stays(model, term.effect, term.place):
            aside.append(label)
        else:
            now = with_outside(now, joint, label, best.solution.values)
    # the bench does not count the FMU's own parameters, which every variant has
    own = len(model.parameters) + (0 if model.correction is None else len(_outside(model)))

    def counted(v: Variant) -> Variant:
        return replace(v, parameters=v.parameters + own)

    seen = {id(v): counted(v) for v in found.variants}
    told = replace(
        found,
        variants=tuple(seen[id(v)] for v in found.variants),
        front=tuple(seen[id(v)] for v in found.front),
        recommended=seen[id(best)],
        ties=tuple(seen[id(v)] for v in found.ties),
        improved=None if found.improved is None else seen[id(found.improved)],
    )
    return UserExploration(now, told, tuple(aside), why_followed=opened.why_followed)


def _outside(model: UserModel) -> list[str]:
    """Names of the free values of what rides outside already."""
    return [n for n in model.values if n.startswith(PREFIX)]


__all__ = ["FmuGround", "UserExploration", "explore"]
