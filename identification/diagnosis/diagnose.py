"""Diagnose: which physical effect is missing from a fitted model, ranked, with sets and reasons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from identification.balance.dataset import Dataset
from identification.data.record import Record
from identification.diagnosis.bench import Progress
from identification.diagnosis.claims import Claim, Ranking
from identification.diagnosis.improvement import Improvement, ranked_json
from identification.diagnosis.locate import Unexplained
from identification.diagnosis.outcome import Refusal
from identification.diagnosis.session import Session
from identification.fitting.assess import BalanceError
from identification.fitting.fit import Fit
from identification.representation import html_of

SHOWN: Final = 5
"""Rows of the ranking that are printed."""


@final
@dataclass(frozen=True)
class Diagnosis:
    """What is missing, as far as the records can tell: the first decision of `improve` on the same
    records.

    Attributes
    ----------
    found : Improvement
        The start model and, where something is named, the model with it.
    """

    found: Improvement

    @property
    def ranking(self) -> Ranking:
        """Candidates, best first; none where the records cannot carry the question."""
        return self.found.ranking or Ranking((), frozenset(), ())

    @property
    def claims(self) -> tuple[Claim, ...]:
        """The first claim; add it and diagnose again for the next."""
        return self.found.claims

    @property
    def data(self) -> Dataset:
        """The prepared records."""
        return self.found.data

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to doubt about records and start model."""
        return self.found.warnings

    @property
    def outcome(self) -> str:
        """``found``, ``set``, ``complete``, ``unexplained``, or ``not_identifiable`` where the
        records cannot tell.
        """
        return self.found.outcome

    @property
    def verdict(self) -> str:
        """As of `improve`, after the first addition."""
        return self.found.verdict

    @property
    def reason(self) -> str:
        """One sentence that a reader understands."""
        return self.found.reason

    @property
    def refused(self) -> tuple[Refusal, ...]:
        """Every candidate that was tried and not named, with the reason."""
        return self.found.refused

    @property
    def unexplained(self) -> tuple[Unexplained, ...]:
        """Where structure is left that no effect explains."""
        return self.found.unexplained

    @property
    def ratios(self) -> Mapping[str, BalanceError]:
        """Residual over floor of each balance that the verdict rests on."""
        return self.found.final_ratios

    def why(self, key: str) -> str:
        """Why an effect is named, or why it is not: one sentence.

        Raises
        ------
        InputError
            No effect of that key.
        """
        return self.found.why(key)

    def as_json(self) -> dict[str, Any]:
        """Outcome, claims, ranking, refusals and what is not testable as data."""
        significant = self.ranking.significant
        return {
            "outcome": self.outcome,
            "verdict": self.verdict,
            "reason": self.reason,
            "claims": [c.as_json() for c in self.claims],
            "ranking": [
                ranked_json(t, t.candidate.label in significant) for t in self.ranking.trials
            ],
            "refused": [r.as_json() for r in self.refused],
            "not_testable": [{"effect": n.effect, "why": n.why} for n in self.ranking.not_testable],
            "unexplained": [u.as_json() for u in self.unexplained],
            "floor_ratio": {b: e.as_json() for b, e in self.ratios.items()},
            "note": self.data.note,
            "warnings": list(self.warnings),
        }

    def next_experiment(self) -> str | None:
        """The run that would separate the names of the claim, if any."""
        return self.claims[0].separate_by if self.claims else None

    def __str__(self) -> str:
        lines = []
        for i, t in enumerate(self.ranking.trials[:SHOWN] if self.claims else (), 1):
            mark = "" if t.candidate.label in self.ranking.significant else "  (not significant)"
            lines.append(
                f"{i}. {t.candidate.effect.title}  {-t.held_out_drop_percent:+.0f} % in the "
                f"{t.balance} balance{mark}"
            )
        if self.claims and len(self.claims[0].effects) > 1:
            lines.append(
                f"cannot be told apart here: {', '.join(self.claims[0].effects)}; separate by "
                f"{self.claims[0].separate_by}"
            )
        return "\n".join([self.reason, *lines])

    def __repr__(self) -> str:
        names = [list(c.effects) for c in self.claims]
        return (
            f"Diagnosis({self.outcome}, claims: {names}, {len(self.ranking.trials)} "
            "candidates tried)"
        )

    def _repr_html_(self) -> str | None:
        return html_of(self)


def diagnose(
    fitted: Fit, held_out: Record | Sequence[Record] = (), *, progress: Progress | None = None
) -> Diagnosis:
    """Rank the effect library on what a fitted model leaves unexplained, and decide as `improve`
    decides first.

    Parameters
    ----------
    fitted : Fit
    held_out : Record or sequence of Record
        Records the fit did not see; without them blocks of the fit's records are held out.
    progress : callable, optional
        ``progress(text, share)``.

    Returns
    -------
    Diagnosis

    Raises
    ------
    InputError
        Unusable records, in one line.
    """
    session = Session.opened(fitted.records, fitted.joint, held_out, progress=progress)
    return Diagnosis(session.diagnose(session.start()))
