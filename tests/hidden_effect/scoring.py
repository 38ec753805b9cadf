"""Compare what ``irj improve --json`` says with what was hidden.

A claim is matched to at most one hidden name, and a hidden name takes at most one claim; what is
left over is extra. Names of one equivalence class (declared here, before any run) count for each
other only in the figures called "class". Minor claims are reported apart. A line (position-periodic
torque) counts as a claim; a line of the hidden order is never extra, whatever balance it stands in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

Json = dict[str, Any]

CLASSES: tuple[frozenset[str], ...] = (
    frozenset({"backlash", "soft_windup"}),
    frozenset({"quadratic_drag", "cubic_viscous"}),
    frozenset(
        {"current_offset", "asymmetric_coulomb"}
    ),  # with cyclic_torque where its cosine part leads
    frozenset(
        {"motor_constant_error", "added_spring"}
    ),  # with cyclic_torque where its sine part leads
)
ORDERED = {
    "kinematic_error": "kinematic_error_order",
    "torque_ripple": "ripple_order_per_motor_turn",
}
ORDER_SLACK = 0.05
SEEN_IN: dict[str, frozenset[str]] = {
    "motor": frozenset({"motor", "sum", "deflection", "axis"}),
    "link": frozenset({"link", "sum", "axis"}),
    "transmission": frozenset({"transmission", "deflection"}),
    "sensor": frozenset({"motor", "link", "transmission", "sensor"}),
}
"""Balances in which a place shows, with all sensors or with fewer."""
_PARAMETERS = {
    "motor_inertia": ("motor_inertia_kg_m2", 2),
    "link_inertia": ("link_inertia_kg_m2", 0),
    "gravity_torque": ("gravity_torque_Nm", 0),
    "stiffness": ("stiffness_Nm_per_rad", 2),
    "structural_damping": ("structural_damping_Nms_per_rad", 2),
    "motor_viscous": ("motor_viscous_Nms_per_rad", 2),
    "motor_coulomb": ("motor_coulomb_Nm", 1),
    "link_viscous": ("link_viscous_Nms_per_rad", 0),
    "link_coulomb": ("link_coulomb_Nm", 0),
}
"""Parameter in the JSON, name in the truth file, power of the gear ratio where it is given on
the motor side.
"""


@final
@dataclass(frozen=True)
class Score:
    """What one case gave.

    Attributes
    ----------
    hidden
        Names hidden in the case.
    in_set, in_set_class
        Hidden names found in a claim (or a line) of their own; the second also through their class.
    in_minor
        Hidden names that only a minor claim holds.
    one_name, one_name_right, one_name_right_class
        Claims with a single name, and how many of them are right.
    extra, extra_names
        Claims that no hidden name takes, and their names.
    downgraded
        Extra claims that are marked as partial.
    minor_extra
        Minor claims without a hidden name.
    top1, top1_class
        Whether the first of the ranking is hidden (None without a ranking).
    set_sizes
        Names per matched claim.
    verdict
        As given.
    balance_right, axis_right
        For kinds outside the library: the unexplained part is in the right balance, and at the
        right place.
    drop_percent
        Drop of the held-out RMS in the hidden effect's balance from the first to the last step.
    ratios
        Residual over floor on held-out records: first step for a case with nothing hidden, else
        last step.
    parameter_errors
        Relative errors of the joint's parameters after the last step, in per cent.
    """

    hidden: tuple[str, ...]
    in_set: int
    in_set_class: int
    in_minor: int
    one_name: int
    one_name_right: int
    one_name_right_class: int
    extra: int
    extra_names: tuple[tuple[str, ...], ...]
    downgraded: int
    minor_extra: int
    top1: bool | None
    top1_class: bool | None
    set_sizes: tuple[int, ...]
    verdict: str
    balance_right: bool | None
    axis_right: bool | None
    drop_percent: float | None
    ratios: Mapping[str, float]
    parameter_errors: Mapping[str, float]


def hidden_names(truth: Mapping[str, Any]) -> tuple[str, ...]:
    """Names in ``hidden_effect`` of a truth file, always a tuple."""
    value = truth.get("hidden_effect")
    return () if value is None else (value,) if isinstance(value, str) else tuple(value)


def equivalents(name: str, truth: Mapping[str, Any]) -> frozenset[str]:
    """Names that count for ``name`` in the class figures (itself among them)."""
    if name == "cyclic_torque":
        values = truth.get("hidden", {}).get(name, {})
        cosine_leads = abs(values.get("cyclic_cosine_Nm", 0.0)) > abs(
            values.get("cyclic_sine_Nm", 1.0)
        )
        return frozenset({name}) | CLASSES[2 if cosine_leads else 3]
    found = {name}
    for group in CLASSES:
        if name in group:
            found |= group
            if group in CLASSES[2:]:
                found.add("cyclic_torque")
    if name == "link_mode":
        found.add("flexible_mode")
    return frozenset(found)


def _true_orders(truth: Mapping[str, Any]) -> dict[str, float]:
    hidden = truth.get("hidden", {})
    orders = {n: float(hidden[n][key]) for n, key in ORDERED.items() if n in hidden}
    # truth files of older fleets have no "hidden" part and order 2
    if "kinematic_error" in hidden_names(truth) and "kinematic_error" not in orders:
        orders["kinematic_error"] = 2.0
    if "odd_order" in hidden:
        orders["odd_order"] = float(hidden["odd_order"]["order_per_motor_turn"])
    return orders


def _order_near(line: Mapping[str, Any], order: float) -> bool:
    per_motor = line.get("per", "motor turn") == "motor turn"
    return per_motor and abs(float(line["order"]) - order) <= max(
        ORDER_SLACK, float(line.get("tolerance", 0.0))
    )


def _match(
    claims: Sequence[frozenset[str]], accepted: Mapping[str, frozenset[str]]
) -> tuple[dict[str, int], dict[str, int]]:
    """One claim per hidden name: first those that hold the name itself, then those that hold
    its class.
    """
    strict: dict[str, int] = {}
    for name in accepted:
        own = [i for i, c in enumerate(claims) if name in c and i not in strict.values()]
        if own:
            strict[name] = min(own, key=lambda i: len(claims[i]))
    both = dict(strict)
    for name, names in accepted.items():
        if name not in both:
            near = [i for i, c in enumerate(claims) if c & names and i not in both.values()]
            if near:
                both[name] = min(near, key=lambda i: len(claims[i]))
    return strict, both


def _claims(
    result: Json, orders: Mapping[str, float]
) -> tuple[list[frozenset[str]], list[Json], set[str]]:
    """Names by which each claim can be right, the entries they come from, and hidden names of right
    lines.

    A periodic effect that only lines of a wrong order name is not found: its name is struck from
    every claim.
    """
    entries = [c for c in result["claims"] if "curve" not in c]  # a learned curve is no name
    lines = result.get("lines", [])
    periodic = frozenset(ORDERED)
    missed = {
        n
        for n, order in orders.items()
        if any(n in x["effects"] for x in lines) and not any(_order_near(x, order) for x in lines)
    }
    claims = [frozenset(c["effects"]) - missed for c in entries]
    lined: set[str] = set()
    right_lines = []
    for line in lines:
        owners = [n for n, order in orders.items() if _order_near(line, order)]
        if owners:
            right_lines.append(line)
            lined |= {n for n in owners if n in line["effects"] or n == "odd_order"}
        elif line["effects"] and not any(
            set(line["effects"]) <= set(c["effects"]) for c in result["claims"]
        ):
            entries.append(line)
            claims.append(frozenset(line["effects"]) - periodic)
    if (
        "odd_order" in orders and right_lines
    ):  # "kinematic error of order 3.37" is true: not a claim against us
        kept = [
            (c, e)
            for c, e in zip(claims, entries, strict=True)
            if not set(e["effects"]) <= periodic
        ]
        claims, entries = [c for c, _ in kept], [e for _, e in kept]
    return claims, entries, lined


def _overlaps(entry: Mapping[str, Any], low: float, high: float) -> bool:
    a, b = entry.get("low"), entry.get("high")
    return (
        "link_position" in str(entry.get("axis"))
        and a is not None
        and b is not None
        and a < high
        and b > low
    )


def _axis_right(kind: str, values: Mapping[str, Any], result: Json) -> bool:
    found: list[Json] = result["unexplained"]
    if kind == "local_bump":
        return any(_overlaps(u, values["bump_low_rad"], values["bump_high_rad"]) for u in found)
    if kind == "soft_stop":
        return any(_overlaps(u, values["stop_begins_rad"], 1.4) for u in found)
    if kind == "odd_order":
        order = values["order_per_motor_turn"]
        near = [
            u
            for u in found
            if u.get("order") is not None and abs(u["order"] - order) <= ORDER_SLACK
        ]
        return bool(near) or any(_order_near(line, order) for line in result.get("lines", []))
    if kind == "link_mode":
        low, high = 0.85 * values["mode_frequency_hz"], 1.15 * values["mode_frequency_free_hz"]
        return any(
            u.get("frequency_hz") is not None and low <= u["frequency_hz"] <= high for u in found
        )
    return all(
        u.get("axis") is None and u.get("order") is None and u.get("frequency_hz") is None
        for u in found
    )


def _outside(truth: Mapping[str, Any], result: Json) -> tuple[bool | None, bool | None]:
    kinds = truth.get("outside") or []
    if not kinds:
        return None, None
    kind = kinds[0]
    place = truth["balance"][kind]
    flagged = {str(u["balance"]) for u in result["unexplained"]}
    balance = result["verdict"] == "unexplained" and bool(flagged & SEEN_IN[place])
    if kind == "odd_order" and not balance:
        balance = any(
            _order_near(x, _true_orders(truth)["odd_order"]) for x in result.get("lines", [])
        )
    return balance, _axis_right(kind, truth["hidden"][kind], result)


def _ratios(step: Json) -> dict[str, float]:
    return {name: float(b["ratio"]) for name, b in step["held_out"]["balances"].items()}


def _drop(places: Iterable[str], steps: Sequence[Json]) -> float | None:
    first, last = steps[0]["held_out"]["balances"], steps[-1]["held_out"]["balances"]
    drops = [
        100.0 * (1.0 - last[b]["rms"] / first[b]["rms"])
        for place in places
        for b in first
        if b in SEEN_IN[place] and b in last and first[b]["rms"] > 0.0
    ]
    return max(drops) if drops else None


def parameter_errors(truth: Mapping[str, Any], parameters: Mapping[str, Any]) -> dict[str, float]:
    """Relative errors [%] of the joint's own parameters; values given on the motor side are
    reflected first.
    """
    ratio = abs(float(truth["gear_ratio"]))
    errors: dict[str, float] = {}
    for name, (key, power) in _PARAMETERS.items():
        true, found = truth["link_referred"].get(key), parameters.get(name)
        if found is None or not true:
            continue
        value = float(found["value"]) * (ratio**power if found["side"] == "motor" else 1.0)
        errors[name] = 100.0 * (value / true - 1.0)
    return errors


def _told_as_skew(truth: Mapping[str, Any], result: Json) -> set[str]:
    """A hidden delay of up to a few samples is the skew of a clock: right where the calibration
    has it, within a tenth.
    """
    hidden = truth.get("hidden", {}).get("channel_delay")
    if hidden is None or "delay_s" not in hidden:
        return set()
    late = [
        float(c["value"])
        for c in result.get("calibration", [])
        if c["what"] == "skew" and c["sensor"] == hidden["delayed_channel"]
    ]
    delay = float(hidden["delay_s"])
    near = bool(late) and all(abs(x - delay) < 0.1 * delay for x in late)
    return {"channel_delay"} if near else set()


def score(truth: Mapping[str, Any], result: Json) -> Score:
    """Score one result.

    Parameters
    ----------
    truth
        Content of ``truth.json``.
    result
        What ``irj improve --json`` writes (``improve.schema.json``).
    """
    names = hidden_names(truth)
    skewed = _told_as_skew(truth, result) & set(names)
    orders = _true_orders(truth)
    claims, entries, lined = _claims(result, orders)
    accepted = {n: equivalents(n, truth) for n in names}
    strict, both = _match(claims, accepted)
    in_set = set(strict) | (lined & set(names)) | skewed
    in_class = set(both) | in_set
    taken = set(both.values())
    single = [i for i, e in enumerate(entries) if len(e["effects"]) == 1]
    everything: frozenset[str] = frozenset().union(*accepted.values()) if accepted else frozenset()
    left = [i for i in range(len(claims)) if i not in taken]
    minor = [frozenset(m["effects"]) for m in result.get("minor", [])]
    ranking = result["ranking"]
    first = ranking[0]["effect"] if ranking else None
    balance, axis = _outside(truth, result)
    steps = result["steps"]
    return Score(
        hidden=names,
        in_set=len(in_set),
        in_set_class=len(in_class),
        in_minor=sum(1 for n in names if n not in in_set and any(n in m for m in minor)),
        one_name=len(single),
        one_name_right=sum(1 for i in single if claims[i] & set(names)),
        one_name_right_class=sum(1 for i in single if claims[i] & everything),
        extra=len(left),
        extra_names=tuple(tuple(sorted(entries[i]["effects"])) for i in left),
        downgraded=sum(1 for i in left if entries[i].get("partial")),
        minor_extra=sum(1 for m in minor if not m & everything),
        top1=None if first is None or not names else first in names,
        top1_class=None if first is None or not names else first in everything,
        set_sizes=tuple(len(entries[i]["effects"]) for i in both.values()),
        verdict=str(result["verdict"]),
        balance_right=balance,
        axis_right=axis,
        drop_percent=_drop([str(p) for p in truth.get("balance", {}).values()], steps)
        if names
        else None,
        ratios=_ratios(steps[-1] if names else steps[0]),
        parameter_errors=parameter_errors(truth, steps[-1]["parameters"]),
    )
