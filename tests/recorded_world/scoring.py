"""What an answer of ``irj improve --json`` is worth on a case of the recorded world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

Json = dict[str, Any]

SAME: Final[Mapping[str, frozenset[str]]] = {
    "gravity": frozenset({"gravity_phase"}),
    "stribeck": frozenset({"smooth_stribeck"}),
    "warm_up": frozenset({"thermal_friction"}),
}
"""Names that say the same of a hidden law: one coefficient more, another form, the law by its
true cause.
"""
LEARNED: Final = "learned"
DELAYED: Final = "motor_current"
"""Channel that a hidden delay makes late."""
ORDER_SLACK: Final = 0.05
"""Orders nearer than this are one line, where the answer states no wider tolerance."""
CLEAN: Final = frozenset({"nothing_missing", "complete"})


@final
@dataclass(frozen=True)
class Answer:
    """One scored answer.

    Attributes
    ----------
    seed, sensors, make, motion, kind, size, rate, noise, lost, hidden, strength
        The case; strength is the share of the signals' rms that the hidden laws make [%].
    found
        Hidden names that stand in a claim's set, in a line of their order, or in the calibration.
    single, right
        Unmarked claims of one name (names true of the joint without being hidden left out), and
        those that are right.
    wrong
        Unmarked claims and lines in which nothing is true, names joined by ``|``.
    marked
        Such claims that the answer itself marks as partial.
    verdict, verdict_right, held_out, ratio
        As given; error on held-out records [%]; largest residual over floor after the last step.
    seconds, error
        Time of the answer; the line of refusal where there is none.
    """

    seed: int
    sensors: str
    make: str
    motion: str
    kind: str
    size: float
    rate: float
    noise: str
    lost: float
    hidden: tuple[str, ...]
    strength: float = float("nan")
    found: tuple[str, ...] = ()
    single: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    wrong: tuple[str, ...] = ()
    marked: tuple[str, ...] = ()
    verdict: str = ""
    verdict_right: bool = False
    held_out: float = float("nan")
    ratio: float = float("nan")
    seconds: float = 0.0
    error: str = ""

    @property
    def all_right(self) -> bool:
        """Everything hidden found, nothing wrong beside it, and the verdict says so."""
        return not self.error and not self.wrong and self.verdict_right


def _names(entry: Json) -> frozenset[str]:
    return frozenset(str(e).partition("@")[0] for e in entry["effects"])


def _marked(entry: Json) -> bool:
    return bool(entry.get("partial") or entry.get("like"))


def _is_order(line: Json, order: float, truth: Mapping[str, Any]) -> bool:
    """Whether a line is the given order per motor turn, in whatever unit it is told."""
    per, turns, told = (
        line.get("per", "motor turn"),
        float(truth["motor_turns"]),
        float(line["order"]),
    )
    pitch_turns = turns / (2.0 * np.pi)  # turns of a screw per metre
    known = {
        "motor turn": [order],
        "link turn": [order * turns],
        "metre": [order * pitch_turns, order * turns],
    }
    slack = max(ORDER_SLACK / max(order, 1.0), float(line.get("tolerance", 0.0)) / max(told, 1e-9))
    return any(abs(told - o) <= slack * o for o in known.get(per, []))


def taken_up(truth: Mapping[str, Any], calibration: Iterable[Json]) -> set[str]:
    """Hidden laws that a model has under another name: a delay as a skew of the same channel, and
    once per turn of a link that hangs in gravity, whose zero is free.

    Parameters
    ----------
    truth : mapping
        The truth file.
    calibration : iterable of mapping
        What was found of the sensors, each as in ``improve.schema.json``.
    """
    found = set()
    law = truth["laws"].get("channel_delay")
    if law is not None:
        delay = float(law["current_delay_s"])
        skews = [c for c in calibration if c["what"] == "skew" and c["sensor"] == DELAYED]
        # the drive of a joint is filtered besides: what it waits is the delay
        late = [abs(float(c["value"])) for c in skews]
        late += [float(c["waits"]) for c in skews if c.get("waits") is not None]
        if any(abs(x - delay) < 0.5 * delay for x in late):
            found.add("channel_delay")
    hangs = float(truth["values"].get("TG", 0.0)) > 0.0 and "gravity" not in truth["laws"]
    if hangs and truth["places"].get("cyclic_torque") == "link":
        found.add("cyclic_torque")
    return found


def score(truth: Mapping[str, Any], result: Json) -> Answer:
    """Score one result (``improve.schema.json``) against a truth file."""
    hidden = tuple(str(n) for n in truth["hidden"])
    accepted = {n: frozenset({n}) | SAME.get(n, frozenset()) for n in hidden}
    hidden_names: frozenset[str] = frozenset().union(*accepted.values())
    true_names = hidden_names | frozenset(truth["neutral"])
    orders = dict(truth["orders"])
    lines: list[Json] = list(result.get("lines", []))
    true_orders = [*orders.values(), float(truth["values"].get("KE2_O", 0.0))]
    stray = [x for x in lines if not any(o and _is_order(x, o, truth) for o in true_orders)]
    # a periodic effect that only lines of another order name is not found
    missed = {
        n
        for n in orders
        if any(n in x["effects"] for x in stray)
        and not any(_is_order(x, orders[n], truth) for x in lines)
    }
    claims = [(_names(c) - missed, c) for c in result["claims"]]
    as_other = taken_up(truth, result.get("calibration", []))
    found = set(as_other)
    found |= {n for n, order in orders.items() if any(_is_order(x, order, truth) for x in lines)}
    found |= {n for n in hidden if any(names & accepted[n] for names, _ in claims)}
    outside = truth["kind"] == "outside"
    single = [
        names
        for names, c in claims
        if len(c["effects"]) == 1 and not _marked(c) and LEARNED not in names
    ]
    counted = [
        next(iter(names), "")
        for names in single
        if not names & frozenset(truth["neutral"]) - hidden_names
    ]
    empty = [(names, c) for names, c in claims if not names & true_names and LEARNED not in names]
    wrong = ["|".join(sorted(map(str, c["effects"]))) for _, c in empty if not _marked(c)]
    lined = {str(e) for x in stray for e in x["effects"]}
    wrong += [
        f"line {float(x['order']):g} per {x.get('per', 'motor turn')}"
        for x in stray
        if not lined & set(wrong)
    ]
    learned = any(LEARNED in names for names, _ in claims)
    verdict = str(result["verdict"])
    left = {"unexplained"} if truth["dirty"] else set()
    if not hidden:
        good = verdict in CLEAN | left
    elif outside:
        good = verdict == "unexplained" or learned or bool(found)
    else:
        # what the model took up leaves nothing to be claimed
        claimed = set(hidden) - as_other
        good = verdict in ({"complete"} if claimed else CLEAN) | left and set(hidden) <= found
    last = result["steps"][-1]["held_out"]
    sensors = truth["sensors"]
    return Answer(
        seed=int(truth["seed"]),
        sensors=str(truth["sensor_set"]),
        make=str(truth["make"]),
        motion=str(truth["motion"]),
        kind=str(truth["kind"]),
        size=float(truth["size"]),
        rate=float(sensors["rate"]),
        noise=str(sensors["noise"]),
        lost=float(sensors["lost"]),
        hidden=hidden,
        strength=float(truth.get("strength_percent", "nan")),
        found=tuple(sorted(found)),
        single=tuple(counted),
        right=tuple(n for n in counted if n in hidden_names),
        wrong=tuple(wrong),
        marked=tuple("|".join(sorted(names)) for names, c in empty if _marked(c)),
        verdict=verdict,
        verdict_right=good,
        held_out=float(last["relative_error_percent"]),
        ratio=max((float(b["ratio"]) for b in last["balances"].values()), default=float("nan")),
    )


def refused(truth: Mapping[str, Any], error: str) -> Answer:
    """The answer of a case that ended in an error."""
    sensors = truth["sensors"]
    return Answer(
        seed=int(truth["seed"]),
        sensors=str(truth["sensor_set"]),
        make=str(truth["make"]),
        motion=str(truth["motion"]),
        kind=str(truth["kind"]),
        size=float(truth["size"]),
        rate=float(sensors["rate"]),
        noise=str(sensors["noise"]),
        lost=float(sensors["lost"]),
        hidden=tuple(truth["hidden"]),
        strength=float(truth.get("strength_percent", "nan")),
        error=error,
    )


def _share(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.0f} ({part}/{whole})" if whole else "-"


HEADER: Final = (
    "| {} | cases | in set % | one name right % | cases with wrong unmarked names % | with "
    "nothing hidden % "
    "| verdict right % | all right % | refused | held-out % | seconds |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|"
)


def row(label: str, answers: Iterable[Answer]) -> str:
    """One line of a table."""
    every = list(answers)
    told = [a for a in every if not a.error]
    library = [a for a in every if a.kind not in ("none", "outside")]
    names = sum(len(a.hidden) for a in library)
    nothing = [a for a in told if a.kind == "none"]
    held = [a.held_out for a in told]
    cells = [
        label,
        str(len(every)),
        _share(sum(len(a.found) for a in library), names),
        _share(sum(len(a.right) for a in every), sum(len(a.single) for a in every)),
        _share(sum(bool(a.wrong) for a in told), len(told)),
        _share(sum(bool(a.wrong) for a in nothing), len(nothing)),
        _share(sum(a.verdict_right for a in every), len(every)),
        _share(sum(a.all_right for a in every), len(every)),
        str(len(every) - len(told)),
        f"{np.median(held):.1f}" if held else "-",
        f"{np.median([a.seconds for a in every]):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _sized(a: Answer) -> str:
    return "nothing hidden" if a.kind == "none" else f"{a.kind}, size {a.size:g}"


def _banded(a: Answer) -> str:
    """How much of the signals the hidden laws make: below a percent hardly any record shows it."""
    if not a.hidden or a.strength != a.strength:
        return "-"
    low = next(x for x in (30, 10, 3, 1, 0) if a.strength >= x)
    return f"{low:02d} % and more"


def tables(answers: list[Answer]) -> str:
    """Markdown: all, then one table per condition."""
    if not answers:
        return "no cases\n"
    conditions: dict[str, Callable[[Answer], str]] = {
        "sensors": lambda a: a.sensors,
        "sensors and size": lambda a: f"{a.sensors}: {_sized(a)}",
        "strength": _banded,
        "hidden": _sized,
        "make": lambda a: a.make,
        "motion": lambda a: a.motion,
        "rate": lambda a: f"{a.rate:g} Hz",
        "noise": lambda a: a.noise,
        "lost": lambda a: f"{100 * a.lost:g} %",
        "name": lambda a: "+".join(a.hidden) or "nothing",
    }
    text = [HEADER.format("all"), row("all", answers), ""]
    for title, key in conditions.items():
        text.append(HEADER.format(title))
        for label in sorted({key(a) for a in answers}):
            text.append(row(label, [a for a in answers if key(a) == label]))
        text.append("")
    return "\n".join(text) + "\n"
