"""Totals of a campaign, the acceptance figures they are held against, and the Markdown that
shows both.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from statistics import fmean, median
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from tests.hidden_effect.scoring import Score

RECORDED_SECONDS = 96.0


@final
@dataclass(frozen=True)
class Outcome:
    """One case of a campaign: what it was, how it scored or how it failed, how long it took and
    how long its records are [s].
    """

    group: str
    label: str
    seed: int
    stiction: bool
    seconds: float
    score: Score | None
    error: str = ""
    recorded: float = RECORDED_SECONDS


@final
@dataclass(frozen=True)
class Check:
    """One acceptance figure: what, the figure, its limit, whether at least or at most."""

    what: str
    value: float | None
    limit: float
    at_least: bool
    cases: int

    @property
    def passed(self) -> bool | None:
        """Whether the figure keeps its limit (None without cases)."""
        if self.value is None:
            return None
        return self.value >= self.limit - 1e-9 if self.at_least else self.value <= self.limit + 1e-9


def _share(part: float, whole: float) -> float | None:
    return None if whole == 0 else 100.0 * part / whole


def _scores(outcomes: Iterable[Outcome], group: str) -> list[Score]:
    return [o.score for o in outcomes if o.group == group and o.score is not None]


def _single_checks(
    singles: list[Outcome], size: float, dirt: bool, torque_sensor: bool, one_sided: bool
) -> list[Check]:
    s = [o.score for o in singles if o.score is not None]
    n = len(singles)  # a case that failed counts as not found
    one = sum(x.one_name for x in s)
    small = size <= 0.1
    set_limit = 80.0 if one_sided else 90.0 if not torque_sensor else 75.0 if small else 95.0
    claims = sum(len(x.set_sizes) + x.extra for x in s)
    drops = [x.drop_percent for x in s if x.drop_percent is not None]
    checks = [
        Check(
            "single: true name in a set, %", _share(sum(x.in_set for x in s), n), set_limit, True, n
        ),
        Check(
            "single: one-name answers right, %",
            _share(sum(x.one_name_right for x in s), one),
            95.0,
            True,
            one,
        ),
        Check(
            "single: top of the ranking, by class, %",
            _share(sum(bool(x.top1_class) for x in s), n),
            90.0,
            True,
            n,
        ),
        Check(
            "single: top of the ranking, strict, %",
            _share(sum(bool(x.top1) for x in s), n),
            75.0 if dirt else 90.0,
            True,
            n,
        ),
        Check(
            "single: extra claims per set",
            sum(x.extra for x in s) / n if n else None,
            0.1,
            False,
            n,
        ),
        Check(
            "single: median held-out drop, %",
            median(drops) if drops else None,
            50.0,
            True,
            len(drops),
        ),
    ]
    if small:
        right = claims - sum(x.extra for x in s)
        checks.append(
            Check(
                "single, small: precision of claims, %", _share(right, claims), 95.0, True, claims
            )
        )
    return checks


def checks(
    outcomes: Sequence[Outcome],
    *,
    size: float,
    dirt: bool,
    torque_sensor: bool = True,
    one_sided: bool = False,
) -> list[Check]:
    """Figures of a campaign against the acceptance limits (diagnosis, 4.4 and the end of
    section 6).
    """
    singles = [o for o in outcomes if o.group == "single"]
    none, pairs, triples, outside = (
        _scores(outcomes, g) for g in ("none", "pair", "triple", "outside")
    )
    rows = _single_checks(singles, size, dirt, torque_sensor, one_sided) if singles else []
    if none:
        false = _share(sum(x.extra > 0 for x in none), len(none))
        rows.append(
            Check("none: sets with a claim, %", false, 10.0 if dirt else 2.0, False, len(none))
        )
        rows.append(
            Check("none: sets with a claim (foreign data), %", false, 5.0, False, len(none))
        )
        for name in sorted(none[0].ratios):
            middle = median(x.ratios[name] for x in none if name in x.ratios)
            if not dirt:
                rows.append(
                    Check(
                        f"none: floor of {name}, residual/floor, low", middle, 0.85, True, len(none)
                    )
                )
                rows.append(
                    Check(
                        f"none: floor of {name}, residual/floor, high",
                        middle,
                        1.15,
                        False,
                        len(none),
                    )
                )
    if pairs:
        hidden = sum(len(x.hidden) for x in pairs)
        recall = _share(sum(x.in_set_class for x in pairs), hidden)
        rows.append(Check("pair: recall by class, %", recall, 65.0 if dirt else 85.0, True, hidden))
        extra = sum(x.extra for x in pairs) / len(pairs)
        rows.append(
            Check("pair: extra claims per set", extra, 0.4 if dirt else 0.15, False, len(pairs))
        )
    if triples:
        hidden = sum(len(x.hidden) for x in triples)
        recall = _share(sum(x.in_set_class for x in triples), hidden)
        rows.append(Check("triple: recall by class, %", recall, 90.0, True, hidden))
        exact = sum(x.in_set_class == len(x.hidden) and not x.extra for x in triples)
        rows.append(
            Check(
                "triple: all three and nothing else, %",
                _share(exact, len(triples)),
                60.0,
                True,
                len(triples),
            )
        )
    if outside:
        n = len(outside)
        clear = sum(x.extra == x.downgraded for x in outside)
        rows.append(Check("outside: no undowngraded claim, %", _share(clear, n), 90.0, True, n))
        rows.append(
            Check(
                "outside: flagged in the right balance, %",
                _share(sum(bool(x.balance_right) for x in outside), n),
                90.0,
                True,
                n,
            )
        )
        rows.append(
            Check(
                "outside: right axis, order or frequency, %",
                _share(sum(bool(x.axis_right) for x in outside), n),
                75.0,
                True,
                n,
            )
        )
    times = [o.seconds * 80.0 / o.recorded for o in outcomes if o.score is not None]
    if times:
        rows.append(Check("median seconds per 80 s of data", median(times), 5.0, False, len(times)))
    failed = sum(o.score is None for o in outcomes)
    rows.append(Check("cases that ended in an error", float(failed), 0.0, False, len(outcomes)))
    return rows


def _cells(values: Iterable[object]) -> str:
    return "| " + " | ".join(str(v) for v in values) + " |"


def _row(label: str, group: Sequence[Outcome]) -> str:
    s = [o.score for o in group if o.score is not None]
    hidden = sum(len(x.hidden) for x in s)
    sizes = [n for x in s for n in x.set_sizes]
    drops = [x.drop_percent for x in s if x.drop_percent is not None]

    def of(pick: Callable[[Score], float]) -> str:
        return f"{sum(pick(x) for x in s):g}"

    extra = sorted({"{" + ", ".join(n) + "}" for x in s for n in x.extra_names})
    return _cells(
        [
            label,
            len(group),
            f"{of(lambda x: x.in_set)}/{hidden}",
            of(lambda x: x.in_set_class),
            of(lambda x: x.in_minor),
            f"{of(lambda x: x.one_name_right)}/{of(lambda x: x.one_name)}",
            of(lambda x: float(bool(x.top1))),
            of(lambda x: float(bool(x.top1_class))),
            f"{fmean(sizes):.1f}" if sizes else "",
            of(lambda x: x.extra) + (" " + " ".join(extra) if extra else ""),
            f"{median(drops):.0f}" if drops else "",
            f"{fmean([o.seconds for o in group]):.1f}",
            sum(o.score is None for o in group) or "",
        ]
    )


def markdown(title: str, command: str, outcomes: Sequence[Outcome], found: Sequence[Check]) -> str:
    """The report of a campaign: totals against limits, one row per effect, every case that is
    not as it should be.
    """
    lines = [f"# {title}", "", f"Printed by `{command}`.", ""]
    lines += ["| figure | value | limit | cases | |", "|---|---|---|---|---|"]
    for c in found:
        value = "" if c.value is None else f"{c.value:.2f}"
        verdict = "" if c.passed is None else "ok" if c.passed else "**short**"
        lines.append(
            _cells([c.what, value, f"{'>=' if c.at_least else '<='} {c.limit:g}", c.cases, verdict])
        )
    head = [
        "hidden",
        "n",
        "in set",
        "by class",
        "minor",
        "one name right",
        "top 1",
        "by class",
        "names per set",
        "extra claims",
        "drop %",
        "seconds",
        "errors",
    ]
    lines += ["", _cells(head), "|" + "---|" * len(head)]
    grouped: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for o in outcomes:
        grouped[o.group, o.label].append(o)
    lines += [_row(label, group) for (_, label), group in grouped.items()]
    for text, stiction in (
        ("singles with set-valued friction", True),
        ("singles with smooth friction", False),
    ):
        part = [o for o in outcomes if o.group == "single" and o.stiction == stiction]
        if part:
            lines.append(_row(text, part))
    errors: dict[str, list[float]] = defaultdict(list)
    for o in outcomes:
        if o.score is not None and o.group in {"single", "none"}:
            for name, error in o.score.parameter_errors.items():
                errors[name].append(abs(error))
    if errors:
        lines += ["", "| parameter | median error % | largest % |", "|---|---|---|"]
        lines += [_cells([n, f"{median(v):.2f}", f"{max(v):.1f}"]) for n, v in errors.items()]
    lines += ["", *_remarks(outcomes)]
    return "\n".join(lines).rstrip() + "\n"


def _remarks(outcomes: Sequence[Outcome]) -> list[str]:
    remarks = []
    for o in outcomes:
        if o.score is None:
            remarks.append(f"- {o.label}, seed {o.seed}: error: {o.error}")
            continue
        s = o.score
        missed = o.group in {"single", "pair", "triple"} and s.in_set < len(s.hidden)
        if missed or s.extra or (o.group == "outside" and not (s.balance_right and s.axis_right)):
            words = (
                [f"in set {s.in_set}/{len(s.hidden)}"]
                if o.group in {"single", "pair", "triple"}
                else []
            )
            words += (
                [f"extra {' '.join('{' + ', '.join(n) + '}' for n in s.extra_names)}"]
                if s.extra
                else []
            )
            if o.group == "outside":
                words.append(f"balance {s.balance_right}, place {s.axis_right}")
            remarks.append(f"- {o.label}, seed {o.seed} ({s.verdict}): {'; '.join(words)}")
    return remarks
