"""What the page asks for: each view is a function of the session and the query, the answer is
JSON or a download.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from starlette.responses import FileResponse, Response

from casadi_models import EFFECTS
from casadi_models.effect import PLACE_SIDE
from casadi_models.transmission import MODELS
from identification.balance.dataset import HOLD_DELAY
from identification.balance.kinematic import residual_unit
from identification.data.channels import CHANNELS
from identification.data.joint_schema import OFFERED_EFFECTS, START_EFFECTS
from identification.diagnosis.lines import NORMAL_95
from identification.errors import InputError
from workbench.page import export as app_export
from workbench.page import plan as app_plan
from workbench.page import replay as app_replay
from workbench.page.charts.asked import CHART_VIEWS, along, run_starts, said, side_of, width_of
from workbench.page.charts.choices import known_fields
from workbench.page.charts.payload import payload_view
from workbench.page.desk import tree
from workbench.page.input import joint_form
from workbench.page.jobs.place import folder_of
from workbench.page.live import Live
from workbench.page.pattern import pattern
from workbench.page.records import MOST_RUNS, decimated, plot_time
from workbench.page.session import safe_name
from workbench.page.verbs import addable, wait_settled

Query = Mapping[str, Any]
MOST_POINTS: Final = 4000


def _config(live: Any, query: Query) -> dict[str, Any]:
    """What does not change: models, channels, effects, limits, what can be exported."""
    return {
        "max_upload": query["max_upload"],
        "hold": HOLD_DELAY,
        "sessions": query["sessions"],
        "channels": ["time", *CHANNELS],
        "places": list(PLACE_SIDE),
        "models": {name: list(own) for name, own in MODELS.items()},
        "effects": [
            {"key": e.key, "title": e.title, "family": e.family, "places": list(e.acts_on)}
            for e in EFFECTS.values()
        ],
        "start": {"effects": START_EFFECTS, "offered": OFFERED_EFFECTS},
        "words": said(),
        "report": app_export.report_available(),
        "fmu": app_export.fmu_available(),
    }


def _series(live: Live, query: Query) -> dict[str, Any]:
    """Channels of a record, decimated to the width of the plot."""
    made = _decimated(live, query)
    live.seen.set()
    return made


def _decimated(live: Live, query: Query) -> dict[str, Any]:
    record = live.record(str(query.get("file", "")))
    names = [n for n in str(query.get("channels", "")).split(",") if n] or list(record.channels)[:1]
    values = [record[n] for n in names]
    stamps, columns, full = decimated(plot_time(record), values, _points(query), _window(query))
    made = _drawn(stamps, names, [record.unit(n) for n in names], columns, full)
    for one in made["series"]:
        one["side"] = side_of(one["name"])
    return {**made, "runs": run_starts(record)}


def first_plot(live: Live, file: str, query: Query) -> dict[str, Any] | None:
    """What a page shows of a new record first, or None where the record cannot be looked at.

    Parameters
    ----------
    live : Live
    file : str
        Identifier of the record.
    query : mapping
        ``points``: width of the plot.
    """
    entry = next((f for f in live.state.files if f.id == file), None)
    if entry is None or entry.status not in ("ready", "checking"):
        return None
    return _decimated(
        live,
        {
            "file": file,
            "points": query.get("points", 600),
            "channels": entry.summary["channels"][0]["name"],
        },
    )


def _balance(live: Live, query: Query) -> dict[str, Any]:
    """Measured torque, model and residual of a balance, decimated."""
    analysis = live.analysis()
    time, measured, model, noise = analysis.balance_series(str(query.get("balance", "")))
    kept = NORMAL_95 * noise
    stamps, columns, full = decimated(
        time, [measured, model, measured - model, kept, -kept], _points(query), _window(query)
    )
    unit = residual_unit(str(query.get("balance", "")), analysis.joint.kind)
    names = ("measured", "model", "residual", "noise, upper", "noise, lower")
    drawn = _drawn(stamps, names, [unit] * len(names), columns, full)
    records, runs = analysis.laid_out()
    begins = {"records": records, "runs": runs if len(runs) < MOST_RUNS else []}
    return {**drawn, **begins, "along": along(analysis, stamps)}


def _drawn(
    stamps: Any, names: Sequence[str], units: Sequence[str], columns: Sequence[Any], full: bool
) -> dict[str, Any]:
    series = [
        {"name": n, "unit": u, "values": _numbers(c)}
        for n, u, c in zip(names, units, columns, strict=True)
    ]
    return {"time": _numbers(stamps), "series": series, "full": full}


def _points(query: Query) -> int:
    try:
        return min(max(int(query.get("points", 600)), 50), MOST_POINTS)
    except ValueError:
        raise InputError("points must be a whole number") from None


def _window(query: Query) -> tuple[float, float] | None:
    if "from" not in query or "to" not in query:
        return None
    try:
        low, high = float(query["from"]), float(query["to"])
    except ValueError:
        raise InputError("from and to must be numbers") from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError("from must be less than to")
    return low, high


def _numbers(values: Any) -> list[float | None]:
    """Seven digits are enough for a picture, and half the bytes."""
    return [float(f"{v:.7g}") if math.isfinite(v) else None for v in np.asarray(values).tolist()]


def _compare(live: Live, query: Query) -> dict[str, Any]:
    analysis = live.analysis()
    found = analysis.compare(width_of(query), width_of(query, "whole"))
    return {**found, "pattern": pattern(analysis, live.state.steps)}


def _runs(live: Live, action: str) -> bool:
    job = live.job
    return job is not None and job.action == action


def _replay(live: Live, query: Query) -> dict[str, Any]:
    return {
        "last": app_replay.shown(folder_of(live), following=_runs(live, "follow")),
        "sensors": app_replay.READINGS,
        "faults": app_replay.TRIED,
        "seconds": app_replay.MOST_SECONDS,
        "sources": live.sources,
    }


def _plan(live: Live, query: Query) -> dict[str, Any]:
    joint = live.joint_or_none()
    return {
        "last": app_plan.stored(folder_of(live)),
        "open": app_plan.open_questions(live.state, joint.kind if joint else "rotary"),
        "limits": app_plan.LIMITS,
    }


def _motion(live: Live, query: Query) -> Response:
    return _made(live, app_plan.MOTION)


def _parameters(live: Live, query: Query) -> dict[str, Any]:
    return live.analysis().parameters()


def _library(live: Live, query: Query) -> list[dict[str, Any]]:
    return addable(live)


def _tree(live: Live, query: Query) -> dict[str, Any]:
    return {"branches": tree.shown(live.state), "name": live.state.name}


def _fits(live: Live, query: Query) -> dict[str, Any]:
    return tree.compared(live.state, str(query.get("a", "")), str(query.get("b", "")))


def _joint(live: Live, query: Query) -> dict[str, Any]:
    return {
        "text": live.state.joint_text,
        "form": joint_form(live.state.joint_text),
        "known": known_fields(live),
    }


def _code(live: Live, query: Query) -> dict[str, Any]:
    return {"code": app_export.session_code(live.state)}


def _named(live: Live) -> str:
    form = joint_form(live.state.joint_text)
    return safe_name(str(form.get("name") or "joint")).replace(" ", "_")


def _download(content: str, name: str, kind: str) -> Response:
    headers = {
        "content-disposition": f"attachment; filename*=UTF-8''{quote(name)}",
        "cache-control": "no-store",
    }
    return Response(content, media_type=kind, headers=headers)


def _joint_file(live: Live, query: Query) -> Response:
    wait_settled(live)
    return _download(app_export.joint_file(live), f"{_named(live)}.toml", "application/toml")


def _script(live: Live, query: Query) -> Response:
    return _download(app_export.session_code(live.state), f"{_named(live)}.py", "text/x-python")


def _made(live: Live, name: str) -> Response:
    path = folder_of(live) / name
    if not path.is_file():
        raise InputError(f"no {name} yet; make it on its page first")
    stem = _named(live) + (f"_{path.stem}" if path.suffix in (".fmu", ".csv") else "")
    return FileResponse(
        path,
        filename=f"{stem}{path.suffix}",
        media_type="application/octet-stream",
        headers={"cache-control": "no-store"},
    )


def _report(live: Live, query: Query) -> Response:
    return _made(live, "report.html")


def _plant(live: Live, query: Query) -> Response:
    return _made(live, "plant.fmu")


def _estimator(live: Live, query: Query) -> Response:
    return _made(live, "estimator.fmu")


VIEWS: Final[Mapping[str, Callable[[Any, Query], Any]]] = {
    "config": _config,
    "series": _series,
    "balance": _balance,
    "compare": _compare,
    "parameters": _parameters,
    "library": _library,
    "tree": _tree,
    "fits": _fits,
    "joint": _joint,
    "code": _code,
    "joint.toml": _joint_file,
    "session.py": _script,
    "report.html": _report,
    "plant.fmu": _plant,
    "estimator.fmu": _estimator,
    "replay": _replay,
    "plan": _plan,
    "motion.csv": _motion,
    "payload": payload_view,
    **CHART_VIEWS,
}
