"""The same loop as a NiceGUI page, for comparison: load a record, plot it, fit, add an effect, see
the new error.

Run by ``benchmarks/app.py``; by itself: ``python benchmarks/peer/page.py --port 8100``.  It needs
``pip install nicegui`` (extra ``bench``), which is no dependency of the project.  It is what one
writes with the framework's own elements: an upload, a chart with the smallest and the largest value
per pixel, buttons, and the library's verbs in a thread.

``--engine verbs`` (default) fits every sample with `identification.fitting.fit`; ``--engine
windows`` uses the same windows of the record and the same solver as the workbench, so that only the
page around it differs.
"""

from __future__ import annotations

import argparse
import tempfile
import tomllib
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import run, ui

from identification import fit, read
from identification.data.joint_file import Joint, parse_joint
from identification.data.record import Record

JOINT = parse_joint(
    tomllib.loads((files("workbench") / "demo" / "joint.toml").read_text(encoding="utf-8"))
)
EFFECTS = (
    "stribeck@motor",
    "cubic_viscous@motor",
    "load_dependent_friction@motor",
    "kinematic_error",
)
PIXELS = 1200


class Verbs:
    """Every sample, by the library's verbs."""

    def __init__(self, joint: Joint, record: Record) -> None:
        self.joint = joint
        self.train, self.held = record.split(0.7)
        self.fitted: Any = None

    def fit(self) -> float:
        self.fitted = fit(self.joint, self.train, held_out=[self.held])
        return float(self.fitted.held_out.relative_error_percent)

    def add(self, label: str) -> float:
        self.fitted = fit(
            self.fitted.model.add(label), self.train, joint=self.joint, held_out=[self.held]
        )
        return float(self.fitted.held_out.relative_error_percent)


class Windows:
    """The windows and the solver of the workbench, without what it prepares ahead and without
    its first look.
    """

    def __init__(self, joint: Joint, record: Record) -> None:
        from workbench.page.analysis import Analysis

        self.analysis = Analysis(joint, [record], [])

    def fit(self) -> float:
        return float(self.analysis.fit_start().held_out["relative_error_percent"])

    def add(self, label: str) -> float:
        self.analysis.prepare(label)
        return float(self.analysis.add(label).held_out["relative_error_percent"])


def smallest_and_largest(record: Record, channel: str) -> list[list[float]]:
    """Points of a line that loses no spike."""
    values, time = record[channel], record.time
    edges = np.linspace(0, len(values), PIXELS + 1).astype(np.int64)[:-1]
    low, high = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
    return np.column_stack(
        [np.repeat(time[edges], 2), np.column_stack([low, high]).ravel()]
    ).tolist()


def page(engine: Callable[[Joint, Record], Any]) -> None:
    """The page of one visitor."""
    held: dict[str, Any] = {}
    ui.label("Peer page").classes("text-h5")
    chart = ui.echart(
        {"xAxis": {"type": "value"}, "yAxis": {"type": "value"}, "animation": False, "series": []}
    ).classes("w-full h-80")
    error = ui.label("").props("id=error")

    async def loaded(event: Any) -> None:
        path = Path(tempfile.mkdtemp()) / event.file.name
        await event.file.save(path)
        record = await run.io_bound(read, path)
        held["record"] = record
        channel = next(iter(record.channels))
        points = await run.io_bound(smallest_and_largest, record, channel)
        chart.options["series"] = [
            {"type": "line", "name": channel, "showSymbol": False, "data": points}
        ]
        chart.update()

    def prepared() -> Any:
        if "engine" not in held:
            held["engine"] = engine(JOINT, held["record"])
        return held["engine"]

    async def start() -> None:
        error.set_text("…")
        error.set_text(f"start: {await run.io_bound(lambda: prepared().fit()):.4f} %")

    async def add() -> None:
        label = str(choice.value)
        error.set_text("…")
        error.set_text(f"{label}: {await run.io_bound(lambda: prepared().add(label)):.4f} %")

    ui.upload(on_upload=loaded, auto_upload=True, label="Record")
    ui.button("Fit", on_click=start).props("id=fit")
    choice = ui.select(list(EFFECTS), value=EFFECTS[0])
    ui.button("Add", on_click=add).props("id=add")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=8100)
    parser.add_argument("--engine", choices=("verbs", "windows"), default="verbs")
    given = parser.parse_args()
    engine = Verbs if given.engine == "verbs" else Windows
    ui.run(
        lambda: page(engine),
        host="127.0.0.1",
        port=given.port,
        show=False,
        reload=False,
        show_welcome_message=False,
    )


if __name__ in ("__main__", "__mp_main__"):
    main()
