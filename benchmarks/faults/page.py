"""The fault campaign's figures as text, as a page of the documentation, and as a picture."""

from __future__ import annotations

import html
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.faults.plant import DT, FACTORS, SIZES
from identification.data.formats import number
from identification.faults.detector import ABRUPT, KINDS, SENSORS
from workbench.show.chart import sheet

Results = dict[str, Any]
UNITS = {
    "current": "N.m",
    "motor_position": "rad",
    "motor_velocity": "rad/s",
    "link_position": "rad",
    "link_velocity": "rad/s",
    "torque": "N.m",
}
COMMAND = "python -m benchmarks.fault_campaign --out docs/faults.md"
WHAT = {
    "noise": "the reading is replaced by noise of this standard deviation",
    "stuck": "the reading stays at its last value",
    "zero": "the reading is 0",
    "dropout": "the reading is missing (NaN)",
    "spike": "single wrong samples of this height, ten per second",
    "bias": "this value is added",
    "gain": "the reading is multiplied by 1 + size",
    "drift": "this value per second is added",
    "delay": "the reading is late by this time",
}
RESIDUALS = {
    "r1": "torque reading less spring torque of the two positions",
    "r2": "link velocity over a window less the integral of link acceleration",
    "r3": "link position over a window less the integral of link velocity (no parameter of the "
    "joint)",
    "r4": "motor position over a window less the integral of motor velocity (no parameter of the "
    "joint)",
    "r5": "motor velocity over a window less the integral of motor acceleration",
}
COLOURS = {
    "noise": "#0072b2",
    "spike": "#d55e00",
    "bias": "#009e73",
    "gain": "#cc79a7",
    "drift": "#e69f00",
    "delay": "#56b4e9",
}
"""Colours that people with colour-blindness can tell apart."""


def unit_of(sensor: str, kind: str) -> str:
    """Unit of a fault's size."""
    if kind == "gain":
        return "share"
    if kind == "delay":
        return "s"
    return UNITS[sensor] + ("/s" if kind == "drift" else "")


def milliseconds(values: Sequence[float]) -> str:
    """Median in ms."""
    return f"{1e3 * float(np.median(values)):.0f}" if values else "–"


def summary(results: Results) -> list[tuple[str, str, str]]:
    """What, figure, and what issue it answers: rows of the table at the top."""
    rows: list[tuple[str, str, str]] = []
    if "healthy" in results:
        found = results["healthy"]
        hours = sum(c["samples"] for c in found) * DT / 3600
        rows.append(("healthy data", f"{hours:.2f} h on {len(found)} unseen trajectories", ""))
        rows.append(
            ("sensor alarms in it", f"{sum(c['alarms'] for c in found)}", "at most 1 per hour")
        )
        others = Counter(
            e[1]
            for c in found
            for e in c["events"]
            if e[1] not in ("SENSOR", "DROPOUT", "RECOVERED")
        )
        rows.append(
            ("other reports in it", ", ".join(f"{n} {k}" for k, n in others.items()) or "0", "")
        )
        rows.append(
            ("sensor alarms of the thesis's rule in it", f"{sum(c['thesis'] for c in found)}", "")
        )
    if "faults" in results:
        cases = results["faults"]
        right = [c for c in cases if c["right"]]
        abrupt = [c["delay"] for c in right if c["kind"] in ABRUPT]
        rows.append(("fault cases", f"{len(cases)}", "at least 450"))
        rows.append(("detected", f"{sum(c['detected'] for c in cases)}", "all"))
        rows.append(
            (
                "every failed sensor and no other named",
                f"{len(right)} ({100 * len(right) / len(cases):.1f} %)",
                "at least 95 %",
            )
        )
        rows.append(
            (
                "abrupt faults, median time to the named sensor",
                f"{milliseconds(abrupt)} ms",
                "at most 20 ms",
            )
        )
        rows.append(
            (
                "abrupt faults, median time to the first residual",
                f"{milliseconds([c['first'] for c in right if c['kind'] in ABRUPT])} ms",
                "",
            )
        )
        thesis = [c["thesis"] for c in cases if "thesis" in c]
        rows.append(
            (
                "the thesis's rule on the link sensors",
                f"{len(thesis)} cases, {sum(c['detected'] for c in thesis)} detected, "
                f"{sum(c['right'] for c in thesis)} right",
                "",
            )
        )
    if "plant" in results:
        changes = results["plant"]
        rows.append(
            (
                "changes of the joint called a sensor fault",
                f"{sum(c['sensor'] for c in changes)} of {len(changes)}",
                "at most 1 %",
            )
        )
    if "replace" in results:
        worst = max(c["error"] for c in results["replace"])
        rows.append(
            (
                "error of the replaced link position over 40 s",
                f"{worst:.1e} rad at most",
                "at most 2e-4 rad",
            )
        )
    if "identify" in results:
        errors = [
            (abs(v), n) for r in results["identify"] if r["failed"] for n, v in r["errors"].items()
        ]
        springs = [abs(r["errors"]["ka"]) for r in results["identify"] if r["failed"]]
        rows.append(
            (
                "parameters with failed sensors, worst",
                f"{max(errors)[0]:.1f} % ({max(errors)[1]})",
                "at most 10.5 %",
            )
        )
        rows.append(
            ("added spring with failed sensors, worst", f"{max(springs):.2f} %", "at most 1 %")
        )
    return rows


def delays(results: Results) -> list[list[str]]:
    """Median delay [ms] per sensor and kind."""
    found: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    for c in results.get("faults", []):
        if c["right"] and c["kind"] != "pair":
            found[c["sensors"][0], c["kind"]].append(c["delay"])
    return [[s, *(milliseconds(found[s, k]) for k in KINDS)] for s in SENSORS]


def shares(results: Results) -> dict[tuple[str, str], list[tuple[float, float]]]:
    """For each sensor and kind, percent detected and percent rightly named at each factor."""
    found: defaultdict[tuple[str, str, float], list[tuple[bool, bool]]] = defaultdict(list)
    for c in results.get("sizes", []):
        found[c["sensor"], c["kind"], c["factor"]].append((c["detected"], c["right"]))
    out = {}
    for sensor in SENSORS:
        for kind in SIZES[sensor]:
            cells = [found[sensor, kind, f] for f in FACTORS]
            out[sensor, kind] = [
                (100 * float(np.mean([d for d, _ in c])), 100 * float(np.mean([r for _, r in c])))
                for c in cells
                if c
            ]
    return out


def printed(results: Results) -> str:
    """Everything as text."""
    out = [
        f"{what}: {figure}" + (f" (wanted: {wanted})" if wanted else "")
        for what, figure, wanted in summary(results)
    ]
    if "faults" in results:
        out += [
            "median delay to the named sensor [ms]:",
            f"{'':16}" + "".join(f"{k:>9}" for k in KINDS),
        ]
        out += [f"{row[0]:16}" + "".join(f"{v:>9}" for v in row[1:]) for row in delays(results)]
        out += [
            f"   not right: seed {c['seed']} {'+'.join(c['sensors'])} {c['kind']}: {c['said']}"
            for c in results["faults"]
            if not c["right"]
        ]
    if "sizes" in results:
        out.append(
            "right sensor named, percent, at sizes "
            + ", ".join(f"{f:g} x" for f in FACTORS)
            + " the stated one:"
        )
        out += [
            f"   {s:16}{k:8}{SIZES[s][k]:8g} {unit_of(s, k):8}"
            + "".join(f"{r:6.0f}" for _, r in row)
            for (s, k), row in shares(results).items()
        ]
    return "\n".join(out)


# --- the page -------------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    return "\n".join(lines + [f"| {' | '.join(r)} |" for r in rows]) + "\n"


def _plain(sensor: str) -> str:
    return sensor.replace("_", " ")


def _kinds(results: Results) -> str:
    """Each kind of fault with what detects it and how soon."""
    rows = []
    for kind in KINDS:
        cases = [c for c in results["faults"] if c["kind"] == kind]
        right = [c for c in cases if c["right"]]
        seen = Counter(r for c in right for r in {name.split()[0] for name in c["residuals"]})
        by = (
            "the missing value itself"
            if kind == "dropout"
            else ", ".join(f"{r} ({100 * n / len(right):.0f} %)" for r, n in sorted(seen.items()))
        )
        times = [c["delay"] for c in right]
        spread = f"{milliseconds(times)} ({1e3 * min(times):.0f} to {1e3 * max(times):.0f})"
        rows.append([kind, WHAT[kind], by, f"{len(right)} of {len(cases)}", spread])
    head = [
        "kind",
        "what happens",
        "residuals over their limit when the sensor is named (share of the cases)",
        "named rightly",
        "median delay [ms] (range)",
    ]
    return table(head, rows)


def _sizes(results: Results) -> str:
    rows = []
    for (sensor, kind), cells in shares(results).items():
        size = SIZES[sensor][kind]
        rights = [r for _, r in cells]
        sure = next((f for i, f in enumerate(FACTORS) if all(r == 100 for r in rights[i:])), None)
        smallest = f"{number(size * sure, 2)} {unit_of(sensor, kind)}" if sure is not None else "–"
        shown = [f"{r:.0f}" if r == d else f"{r:.0f} ({d:.0f})" for d, r in cells]
        rows.append(
            [_plain(sensor), kind, f"{number(size, 3)} {unit_of(sensor, kind)}", *shown, smallest]
        )
    return table(
        ["sensor", "kind", "stated size", *(f"{f:g} ×" for f in FACTORS), "from here on always"],
        rows,
    )


def _plant(results: Results) -> str:
    rows = []
    for change in dict.fromkeys(c["change"] for c in results["plant"]):
        said = Counter(c["said"] for c in results["plant"] if c["change"] == change)
        rows.append(
            [
                change,
                "; ".join(
                    f"{text.replace('_', ' ').lower()}: {n}" for text, n in said.most_common()
                ),
            ]
        )
    return table(["change of the joint", "what is said (of 12 trajectories)"], rows)


def _replace(results: Results) -> str:
    rows = []
    for kind in dict.fromkeys(c["kind"] for c in results["replace"]):
        alone, both = (
            next(c for c in results["replace"] if c["kind"] == kind and c["both"] is flag)
            for flag in (False, True)
        )
        rows.append([kind, f"{alone['error']:.1e}", f"{both['error']:.1e}"])
    return table(
        ["link position fails by", "largest error [rad]", "with link velocity lost too [rad]"], rows
    )


def _identify(results: Results) -> str:
    names = list(results["identify"][0]["errors"])
    rows = [
        [
            _together(r["failed"]) or "nothing",
            str(r["alternative"]),
            *(f"{r['errors'][n]:+.2f}" for n in names),
            f"{abs(r['errors'][r['worst']]):.1f}",
        ]
        for r in results["identify"]
    ]
    return table(["failed from 20 s on", "alternative", *names, "worst"], rows)


def _together(sensors: Sequence[str]) -> str:
    return " and ".join(_plain(s) for s in sensors)


def _said(event: Sequence[Any]) -> str:
    return f"{1e3 * event[0]:.0f} ms {event[1].replace('_', ' ').lower()} ({_together(event[2:])})"


def _wrong(results: Results) -> str:
    wrong = [c for c in results["faults"] if not c["right"]]
    if not wrong:
        return "All cases are right.\n"
    rows = [
        [_together(c["sensors"]), c["kind"], "; ".join(_said(e) for e in c["said"])] for c in wrong
    ]
    return "The cases that are not right:\n\n" + table(
        ["sensor", "kind", "what was said, after the fault"], rows
    )


def write_page(results: Results, path: Path) -> None:
    """Write the page, and the picture of the detection-size curves in a folder of the page's
    name.
    """
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    (folder / "sizes.svg").write_text(curves_picture(shares(results)), encoding="utf-8")
    sensors = "\n".join(f"- {name}: {text}" for name, text in RESIDUALS.items())
    trajectories = len(results["sizes"]) // (len(FACTORS) * sum(map(len, SIZES.values())))
    page = f"""# Sensor faults: what is found, how soon, from which size on

This is the detector of the estimator FMUs and of `irj track --follow`, which takes milliseconds. Recordings are judged by the bank
of [fault_bank.md](fault_bank.md), which takes a second and errs less often on joints of another make.

Every figure on this page is printed by

    {COMMAND}

The readings are simulated: the TS joint of the thesis (tables 4.1, 4.3, 4.6) with structural damping, the noise of
table B.1, 1 kHz. The detector's model is wrong by what an identification leaves (`ERRORS` in
`benchmarks/faults/plant.py`), and no trajectory of the test was used to set a limit. A fault counts as named rightly
where every sensor that failed is named and no other. The current sensor and a change of the motor's friction cannot be
told apart from these readings; the detector names the pair, and that counts as right for the current sensor.

{table(["what", "figure", "wanted"], [list(r) for r in summary(results)])}
{_wrong(results)}
## The residuals

{sensors}

Each of r2 to r5 is taken over four windows, from 3 ms to 2 s. "At once" is the shortest one.

## Kinds of fault

All sensors together, at the sizes stated below.

{_kinds(results)}
Median delay to the named sensor in ms:

{table(["sensor", *KINDS], [[_plain(r[0]), *r[1:]] for r in delays(results)])}
## Detection against size

Percent of {trajectories} trajectories on which the sensor is named rightly within 6 s, at parts and multiples of the
stated size. In brackets: percent in which something was reported, where that differs. The last column is the size from
which on every trajectory of this test was right. Stuck, zero and dropout have no size. Curves that coincide are drawn side
by side.

![Percent named rightly against size](faults/sizes.svg)

{_sizes(results)}
What limits it:

- A wrong torque reading (gain, delay) looks like another payload as long as the motion is slow: something is always
  reported, but on slow trajectories as a change of the link. Fast motion, or a step of load, tells the two apart.
- A spiking sensor is taken back when half a second passes without a spike. If the next spike comes within milliseconds,
  before the parities have their past again, it can be put down to the torque sensor for a moment: the case then counts
  as wrong, although the first naming was right.

## Changes of the joint

The detector must say that the joint changed, not that a sensor failed. A change of friction alone shows in the
parameters, so "nothing" is a right answer there.

{_plant(results)}
## Replacement

Largest error of the reconstructed link position over 40 s after the failure.

{_replace(results)}
## Identification while sensors have failed

Section 4.4 of the thesis: errors in percent of the healthy off-line value, at 60 s. Alternative 1 raises the measurement
covariance while a sensor is replaced; alternative 2 also holds the stiffness where a position failed.

{_identify(results)}"""
    path.write_text(page, encoding="utf-8")


# --- the picture ----------------------------------------------------------------------------------


def curves_picture(found: dict[tuple[str, str], list[tuple[float, float]]]) -> str:
    """Percent named rightly against the share of the stated size: one panel per sensor, one
    curve per kind.
    """
    width, height, gap = 244, 150, 54
    body = []
    for i, sensor in enumerate(SENSORS):
        left, top = 46 + (i % 3) * (width + gap), 64 + (i // 3) * (height + 70)
        body.append(_panel(sensor, found, left, top, width, height))
    legend = "".join(
        f'<path stroke="{c}" stroke-width="2.4" d="M{60 + 130 * j} 18h22"/><text '
        f'x="{88 + 130 * j}" y="22" font-size="12" fill="#333">{k}</text>'
        for j, (k, c) in enumerate(COLOURS.items())
    )
    whole = 46 + 3 * (width + gap)
    label = "Percent of faults named rightly against their size, per sensor and kind"
    return sheet(
        legend + "".join(body),
        whole,
        60 + 2 * (height + 70),
        f' role="img" aria-label="{label}"',
    )


def _panel(
    sensor: str,
    found: dict[tuple[str, str], list[tuple[float, float]]],
    left: int,
    top: int,
    width: int,
    height: int,
) -> str:
    low, high = math.log10(FACTORS[0]), math.log10(FACTORS[-1])

    def across(factor: float) -> float:
        return left + (math.log10(factor) - low) / (high - low) * width

    out = [
        f'<text x="{left}" y="{top - 15}" font-size="13" font-weight="600" '
        f'fill="#222">{html.escape(_plain(sensor))}</text>'
    ]
    for percent in (0, 50, 100):
        y = top + height * (1 - percent / 100)
        out.append(f'<path stroke="#ccc" d="M{left} {y}h{width}"/>')
        out.append(
            f'<text x="{left - 6}" y="{y + 4}" font-size="11" text-anchor="end" '
            f'fill="#555">{percent} %</text>'
        )
    for factor in FACTORS:
        out.append(
            f'<text x="{across(factor):.1f}" y="{top + height + 21}" font-size="11" '
            f'text-anchor="middle" fill="#555">{factor:g} ×</text>'
        )
    kinds = [k for k in COLOURS if (sensor, k) in found]
    for j, kind in enumerate(kinds):
        shift = 2.2 * (j - (len(kinds) - 1) / 2)  # curves that coincide stay visible side by side
        points = [
            (across(f), top + height * (1 - right / 100) + shift)
            for f, (_, right) in zip(FACTORS, found[sensor, kind], strict=True)
        ]
        line = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
        dots = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{COLOURS[kind]}"/>' for x, y in points
        )
        out.append(
            f'<path fill="none" stroke="{COLOURS[kind]}" stroke-width="1.8" '
            f'd="M{line}"><title>{kind}</title></path>{dots}'
        )
    return "".join(out)
