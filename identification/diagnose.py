"""Diagnose: which physical effect is missing from a fitted model, ranked, with sets and reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

from identification.claims import Claim, Ranking, make_claim, rank
from identification.engine import Dataset, load_dataset, prepared_model, solve
from identification.fit import Fit
from identification.improve import excitation_warnings, ranked_json, with_held_out
from identification.record import Record
from identification.trials import make_base


@final
@dataclass(frozen=True)
class Diagnosis:
    """What is missing, as far as the records can tell.

    Attributes
    ----------
    ranking : Ranking
    claims : tuple of Claim
        The first claim (empty: nothing significant); add it and diagnose again for the next.
    """

    ranking: Ranking
    claims: tuple[Claim, ...]
    data: Dataset
    warnings: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Ranking, claims and what is not testable as data."""
        return {
            "claims": [c.as_json() for c in self.claims],
            "ranking": [ranked_json(t, t.candidate.label in self.ranking.significant) for t in self.ranking.trials],
            "not_testable": [{"effect": n.effect, "why": n.why} for n in self.ranking.not_testable],
            "warnings": list(self.warnings),
        }  # fmt: skip

    def next_experiment(self) -> str | None:
        """The run that would separate the names of the claim, if any."""
        return self.claims[0].separate_by if self.claims else None

    def __str__(self) -> str:
        if not self.claims:
            return "nothing significant is missing"
        lines = []
        for i, t in enumerate(self.ranking.trials[:5], 1):
            mark = "" if t.candidate.label in self.ranking.significant else "  (not significant)"
            lines.append(f"{i}. {t.candidate.effect.title}  {-t.held_out_drop_percent:+.0f} % in the {t.balance} balance{mark}")
        if len(self.claims[0].effects) > 1:
            lines.append(f"cannot be told apart here: {', '.join(self.claims[0].effects)}; separate by {self.claims[0].separate_by}")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from identification.html import diagnosis_html

        return diagnosis_html(self)


def diagnose(fitted: Fit, held_out: Record | Sequence[Record] = ()) -> Diagnosis:
    """Rank the effect library on what a fitted model leaves unexplained.

    Parameters
    ----------
    fitted : Fit
    held_out : Record or sequence of Record
        Records the fit did not see; without them blocks of the fit's records are held out.

    Returns
    -------
    Diagnosis
    """
    held = [held_out] if isinstance(held_out, Record) else list(held_out)
    train, held, _ = with_held_out(list(fitted.records), held)
    model = prepared_model(fitted.joint, train[0])
    data = load_dataset(train, held, fitted.joint, model, kernel=fitted.data.kernel)
    solution = solve(model, data, start=fitted.solution.values)
    base = make_base(solution, data)
    ranking = rank(base)
    best = ranking.best()
    claims = (make_claim(best, ranking, base),) if best is not None else ()
    return Diagnosis(ranking, claims, data, excitation_warnings(data))
