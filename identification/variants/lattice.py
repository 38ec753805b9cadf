"""The lattice of variants: what may be added to a joint's model, and what goes with what."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

from casadi_models import EFFECTS, JointModel
from identification.balance.dataset import Dataset, visible_labels, with_effect
from identification.diagnosis.candidates import Candidate, NotTestable, offered

Offer = Callable[[JointModel], tuple[list[Candidate], list[NotTestable]]]

PER_EFFECT: Final = 0.10
"""Fall of the summed logarithms of the RMS that an effect must bring: the 10 % off one balance that
a claim asks for (:data:`identification.diagnosis.claims.MAJOR_DROP`)."""
PER_FURTHER: Final = 0.5 * PER_EFFECT
"""The same for each of its parameters beyond the first: the 5 % of a balance below which one effect
counts as good as two (:data:`identification.diagnosis.session.SAME_WITH_ONE_LESS`).  As much as for
the first gave fewer right variants on simulated joints, a quarter as many as a half."""


def price_of(effects: int, parameters: int) -> float:
    """What so many effects with so many free parameters must bring, in the logarithm of the RMS."""
    return PER_EFFECT * effects + PER_FURTHER * (parameters - effects)


@final
@dataclass(frozen=True)
class Node:
    """An effect in a place, as a part of variants.

    Attributes
    ----------
    candidate : Candidate
        As a diagnosis tries it.
    beside : str
        Label of another part that must be in the variant; empty for none.
    """

    candidate: Candidate
    beside: str = ""

    @property
    def label(self) -> str:
        """Label in a model."""
        return self.candidate.label

    @property
    def form(self) -> bool | None:
        """Form of the torsion's reaction on the motor that the part asks for; None for any."""
        return self.candidate.model.virtual_work if self.candidate.place == "torsion" else None

    @property
    def parameters(self) -> int:
        """Free parameters that the part adds."""
        return len(self.candidate.amplitudes) + len(self.candidate.shapes)

    @property
    def price(self) -> float:
        """What the part must bring."""
        return price_of(1, self.parameters)


def nodes_of(
    model: JointModel, data: Dataset, offer: Offer | None = None
) -> tuple[list[Node], tuple[NotTestable, ...]]:
    """All parts that the records can show beside a model, and what they cannot show.

    Beside what a diagnosis would try on the model itself there is what it would try once another
    part is in it: laws that refine a law, and a second line beside a first one.

    Parameters
    ----------
    model : JointModel
    data : Dataset
    offer : callable, optional
        What a diagnosis would try on a model, and what the records cannot show; by default
        :func:`identification.diagnosis.candidates.offered` on `data`.
    """
    offer = offer or (lambda bigger: offered(bigger, data))
    parents = {n for e in EFFECTS.values() for n in e.needs}
    first, refused = offer(model)
    found = [Node(c) for c in first]
    seen = {(n.label, n.form) for n in found}
    waiting = list(found)
    while waiting:
        node = waiting.pop(0)
        opens = node.candidate.effect.key in parents
        # one further line beside each: a third is looked for once the second is in the model
        again = node.candidate.effect.periodic and not node.beside
        if not (opens or again):
            continue
        for candidate in offer(node.candidate.model)[0]:
            new = Node(candidate, node.label)
            if (new.label, new.form) in seen:
                continue
            refines = node.candidate.effect.key in candidate.effect.needs
            if refines or candidate.effect.key == node.candidate.effect.key:
                seen.add((new.label, new.form))
                found.append(new)
                waiting.append(new)
    return found, tuple(refused)


def together(nodes: Sequence[Node]) -> bool:
    """Whether parts go with each other in one model."""
    labels = {n.label for n in nodes}
    if len(labels) < len(nodes):
        return False
    if len({n.form for n in nodes if n.form is not None}) > 1:
        return False
    if any(n.beside and n.beside not in labels for n in nodes):
        return False
    keys = {n.candidate.effect.key for n in nodes}
    return not any(keys & set(n.candidate.effect.parts) for n in nodes)


def assembled(model: JointModel, nodes: Sequence[Node]) -> JointModel | None:
    """The model with these parts; None where two of them are forms of the same law."""
    left = list(nodes)
    while left:
        there = set(model.effects)
        node = next((n for n in left if not n.beside or n.beside in there), None)
        if node is None:
            return None
        left.remove(node)
        try:
            model = with_effect(model, node.label)
        except ValueError:
            return None
        if node.form is not None:
            model = replace(model, virtual_work=node.form)
    return model


def added_to(model: JointModel, bigger: JointModel) -> tuple[str, ...]:
    """Labels that a model has beyond another one."""
    own = set(visible_labels(model))
    return tuple(label for label in visible_labels(bigger) if label not in own)


def missing_from(model: JointModel, other: JointModel) -> tuple[str, ...]:
    """Labels of a model that another one lacks."""
    return added_to(other, model)


def droppable(model: JointModel) -> tuple[str, ...]:
    """Labels that can be taken out of a model: those that no other part needs, without what makes
    the joint elastic.
    """
    terms = {t.label: t for t in model.terms}
    needed = {(n, t.place) for t in model.terms for n in t.effect.needs}
    return tuple(
        label
        for label in visible_labels(model)
        if terms[label].effect.stage != "structure"
        and (terms[label].effect.key, terms[label].place) not in needed
    )
