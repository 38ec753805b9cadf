"""The workbench at a million samples: first plot, click to new error, size of the page, memory of the server.

Run: ``python benchmarks/app.py [--samples 1000000] [--json FILE]``.  Needs Chromium (``IRJ_CHROMIUM``, by default
/usr/bin/chromium) and playwright.  The record is simulated once and kept in the temporary folder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from workbench.app_demo import GEAR_RATIO, HIDDEN, JOINT, MOTOR_CONSTANT, VALUES

CHROMIUM = os.environ.get("IRJ_CHROMIUM", "/usr/bin/chromium")
DT = 1e-3


def record(samples: int) -> Path:
    """A closed-loop record of the demo's joint, as NPZ."""
    from casadi_models.transmission import build
    from identification._excite_follow import Controller, Follower

    path = Path(tempfile.gettempdir()) / f"irj-bench-{samples}.npz"
    if path.exists():
        return path
    model = build("hd3", GEAR_RATIO, effects=("viscous", "coulomb", "gravity", HIDDEN)).with_values(dict(VALUES))
    t = np.arange(samples) * DT
    f, a, phase = np.array([0.11, 0.29, 0.63]), np.array([0.5, 0.22, 0.08]), np.array([0.3, 1.9, 4.0])
    w = 2 * np.pi * f
    angle = w[:, None] * t + phase[:, None]
    reference = np.column_stack([a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)])
    run = Follower(model, DT, controller=Controller(25.0, 0.9), substeps=4).run(reference)
    rng = np.random.default_rng(1)
    step_motor, step_link = 2 * np.pi / 9000, 2 * np.pi / 100_000
    np.savez(
        path, time_s=t, motor_current_A=run.drive / (GEAR_RATIO * MOTOR_CONSTANT) + rng.normal(0, 0.002, samples),
        motor_position_rad=np.round(run.states[:, 0] * GEAR_RATIO / step_motor) * step_motor,
        link_position_rad=np.round(run.states[:, 2] / step_link) * step_link,
        link_torque_Nm=run.torque + rng.normal(0, 0.08, samples),
    )  # fmt: skip
    return path


def memory(process: int) -> dict[str, float]:
    """Resident memory of a process now and at its highest [MB]."""
    text = Path(f"/proc/{process}/status").read_text()
    rows = dict(line.split(":", 1) for line in text.splitlines())
    return {"rss_mb": int(rows["VmRSS"].split()[0]) / 1024, "peak_mb": int(rows["VmHWM"].split()[0]) / 1024}


def headline(page: Any) -> str:
    return str(page.inner_text("#headline strong"))


def measure(samples: int) -> dict[str, Any]:
    """One session in a browser, timed from the clicks."""
    from playwright.sync_api import sync_playwright

    data = record(samples)
    out: dict[str, Any] = {"samples": samples}
    with tempfile.TemporaryDirectory() as folder:
        joint = Path(folder) / "joint.toml"
        joint.write_text(JOINT)
        code = f"from pathlib import Path\nfrom workbench.app import serve\nserve([], 0, False, root=Path({str(Path(folder) / 'sessions')!r}))"
        server = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        try:
            with sync_playwright() as play:
                chromium = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
                page = chromium.new_page(viewport={"width": 1280, "height": 860})
                sizes: list[int] = []
                page.on("response", lambda r: sizes.append(int(r.headers.get("content-length", 0))))
                began = time.perf_counter()
                page.goto(address)
                page.wait_for_selector("#files")
                out["empty_page_s"] = time.perf_counter() - began
                out["page_kb"] = sum(sizes) / 1000
                page.set_input_files("#files", [joint])
                page.wait_for_function("() => app.state.joint_text && !app.state.job")
                began = time.perf_counter()
                page.set_input_files("#files", [data])
                page.wait_for_selector(".uplot canvas", timeout=120_000)
                out["upload_to_first_plot_s"] = time.perf_counter() - began
                page.click("#nav-model")
                page.wait_for_selector("#gear_ratio")
                began = time.perf_counter()
                page.click("#nav-load")
                page.wait_for_selector(".uplot canvas")
                out["click_to_plot_s"] = time.perf_counter() - began
                out["after_load"] = memory(server.pid)
                for name, button, view in (("fit", "#fit", "compare"), ("diagnose", "#diagnose", "diagnose")):
                    began = time.perf_counter()
                    page.click(button)
                    page.wait_for_function("v => document.querySelector('#main').dataset.view === v", arg=view, timeout=600_000)
                    out[f"{name}_s"] = time.perf_counter() - began
                page.wait_for_timeout(float(os.environ.get("IRJ_LOOK_S", "5")) * 1000)
                out.update(clicks(page))
                out["after_loop"] = memory(server.pid)
                chromium.close()
        finally:
            server.kill()
            server.wait()
            server.stdout.close()
    return out


def clicks(page: Any) -> dict[str, Any]:
    """Time from a click to the new error on the page: the proposed effect, undo, and an effect nobody prepared."""
    out: dict[str, Any] = {"start_error": headline(page)}
    steps = [("proposed", ".candidate button.primary"), ("undo", "#undo"), ("redo", "#redo"), ("unprepared", "#add-by-hand")]
    for name, selector in steps:
        if name == "unprepared":
            page.click("#nav-ledger")
            page.wait_for_selector("#add-label")
            page.select_option("#add-label", "cubic_viscous@motor")
        count = page.evaluate("() => app.state.steps.length")
        began = time.perf_counter()
        page.click(selector)
        page.wait_for_function("n => app.state.steps.length !== n && !app.state.job", arg=count, timeout=120_000)
        page.wait_for_function(
            "() => document.querySelector('#headline').dataset.text.startsWith(digits(app.state.steps.at(-1).held_out.relative_error_percent))"
        )
        out[f"click_{name}_s"] = time.perf_counter() - began
        out[f"error_{name}"] = headline(page)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    result = measure(given.samples)
    for key, value in result.items():
        print(f"{key:26} {value if not isinstance(value, float) else round(value, 3)}")
    if given.json:
        given.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
