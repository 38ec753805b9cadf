"""What a search asks of the model whose variants it holds against each other, beside its session: a
joint model and a user's FMU are two.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, final

from casadi_models import JointModel
from identification.balance.dataset import Dataset
from identification.data.record import Record
from identification.diagnosis.candidates import NotTestable
from identification.diagnosis.session import Session
from identification.diagnosis.trials import Base
from identification.fitting.engine import Solution
from identification.variants.lattice import Node, droppable, nodes_of
from identification.variants.refit import Refit, Weighting, refitted


class Ground(Protocol):
    """Fits and rows of variants."""

    session: Session
    ladder: Record | None
    """A record on which the models by name are variants; None where the model is none of them."""

    def nodes(self, model: JointModel) -> tuple[list[Node], tuple[NotTestable, ...]]:
        """Parts that may be added to a model, and what the records cannot show."""

    def droppable(self, model: JointModel) -> tuple[str, ...]:
        """Labels that can be taken out of a model."""

    def base(self, solution: Solution) -> Base:
        """Weighted rows of a fitted model."""

    def data_of(self, solution: Solution) -> Dataset:
        """The records as a fit has them."""

    def refitted(
        self,
        model: JointModel,
        starts: tuple[Mapping[str, float], ...],
        weighting: Weighting,
    ) -> Refit:
        """A variant, fitted on the weighting that all variants share."""


@final
class JointGround:
    """A joint model and its records.

    Parameters
    ----------
    session : Session
    record : Record
        See :class:`Ground`.
    """

    def __init__(self, session: Session, record: Record) -> None:
        self.session = session
        self.ladder: Record | None = record

    def nodes(self, model: JointModel) -> tuple[list[Node], tuple[NotTestable, ...]]:
        """See :func:`identification.variants.lattice.nodes_of`."""
        return nodes_of(model, self.session.data)

    def droppable(self, model: JointModel) -> tuple[str, ...]:
        """See :func:`identification.variants.lattice.droppable`."""
        return droppable(model)

    def base(self, solution: Solution) -> Base:
        """Rows of the model alone."""
        return self.session.bench.base(solution)

    def data_of(self, solution: Solution) -> Dataset:
        """The records of the session: nothing of them hangs on a fit."""
        return self.session.data

    def refitted(
        self,
        model: JointModel,
        starts: tuple[Mapping[str, float], ...],
        weighting: Weighting,
    ) -> Refit:
        """See :func:`identification.variants.refit.refitted`."""
        return refitted(model, self.session.data, starts, weighting)
