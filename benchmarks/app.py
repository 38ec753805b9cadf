"""The workbench at a million samples: first plot, click to new error, size of the page, memory of
the server, and a peer page.

Run: ``python benchmarks/app.py [--samples 1000000] [--repeats 2] [--peer verbs|windows|both|none]
[--json FILE]``. ``--cancel`` measures how long Cancel takes instead; ``--pictures docs`` draws the
pictures of docs/workbench.md instead. Needs Chromium (``IRJ_CHROMIUM``, by default
/usr/bin/chromium) and playwright; the peer page needs ``pip install nicegui`` (extra ``bench``).
The record is simulated once and kept in the temporary folder.  Pages take turns on the same
machine; each time is the smallest of the repeats.  The workbench's first plot is the browser's own
preview of the file; the plot of the record as the server read it is timed too.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

CHROMIUM = os.environ.get("IRJ_CHROMIUM", "/usr/bin/chromium")
ROOT = Path(__file__).resolve().parents[1]
DT = 1e-3
GEAR_RATIO, MOTOR_CONSTANT, HIDDEN = -160.0, 0.0553, "stribeck@motor"
VALUES = {
    "motor_inertia": 4.6,
    "link_inertia": 10.5,
    "stiffness": 21000.0,
    "structural_damping": 60.0,
    "motor_viscous": 10.0,
    "link_viscous": 2.0,
    "motor_coulomb": 19.0,
    "link_coulomb": 0.5,
    "gravity_torque": 95.0,
    "motor_stribeck_extra": 11.0,
    "motor_stribeck_velocity": 0.06,
}
"""Of the size of the joint in the thesis's table 4.1; link-referred SI."""
JOINT = files("workbench") / "demo" / "joint.toml"
LIMITS = {
    "first plot [s]": 1.0,
    "click to new error [s]": 0.3,
    "hover to law drawn [s]": 0.05,
    "slider to new error [s]": 0.1,
    "page [kB]": 1000.0,
    "server [MB]": 500.0,
}


def record(samples: int) -> Path:
    """A closed-loop record of a joint like the demo's, as NPZ."""
    from casadi_models import JointModel
    from identification.planning.follow import Controller, Follower

    path = Path(tempfile.gettempdir()) / f"irj-bench-{samples}.npz"
    if path.exists():
        return path
    model = JointModel.by_name(
        "hd3", GEAR_RATIO, effects=("viscous", "coulomb", "gravity", HIDDEN)
    ).with_values(dict(VALUES))
    t = np.arange(samples) * DT
    f, a, phase = (
        np.array([0.11, 0.29, 0.63]),
        np.array([0.5, 0.22, 0.08]),
        np.array([0.3, 1.9, 4.0]),
    )
    w = 2 * np.pi * f
    angle = w[:, None] * t + phase[:, None]
    reference = np.column_stack(
        [a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)]
    )
    run = Follower(model, DT, controller=Controller(25.0, 0.9), substeps=4).run(reference)
    rng = np.random.default_rng(1)
    step_motor, step_link = 2 * np.pi / 9000, 2 * np.pi / 100_000
    np.savez(
        path,
        time_s=t,
        motor_current_A=run.drive / (GEAR_RATIO * MOTOR_CONSTANT) + rng.normal(0, 0.002, samples),
        motor_position_rad=np.round(run.states[:, 0] * GEAR_RATIO / step_motor) * step_motor,
        link_position_rad=np.round(run.states[:, 2] / step_link) * step_link,
        link_torque_Nm=run.torque + rng.normal(0, 0.08, samples),
    )
    return path


def memory(process: int) -> float:
    """Highest resident memory of a process [MB]."""
    rows = dict(
        line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines()
    )
    return int(rows["VmHWM"].split()[0]) / 1024


@contextmanager
def served(command: list[str], address: str | None = None) -> Iterator[tuple[str, int]]:
    """A server in its own process: its address (from its first line where none is given) and
    process number.
    """
    server = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths()}
    )
    assert server.stdout is not None
    try:
        if address is None:
            address = server.stdout.readline().strip()
        wait_for(address)
        time.sleep(2.0)
        yield address, server.pid
    finally:
        server.kill()
        server.wait()
        server.stdout.close()


def paths() -> str:
    return os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])


def wait_for(address: str) -> None:
    port = int(address.partition("#")[0].rstrip("/").rsplit(":", 1)[1])
    for _ in range(300):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        except OSError:
            time.sleep(0.1)
    raise SystemExit(f"{address} does not answer")


@contextmanager
def browser() -> Iterator[Any]:
    """A page in a fresh browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = chromium.new_page(viewport={"width": 1280, "height": 860})
        yield page
        chromium.close()


def weight(page: Any) -> float:
    """What the page loaded over the wire so far [kB]."""
    kinds = (
        "[...performance.getEntriesByType('navigation'), "
        "...performance.getEntriesByType('resource')]"
    )
    return float(page.evaluate(f"() => {kinds}.reduce((sum, e) => sum + e.transferSize, 0)")) / 1000


def timed(work: Callable[[], Any], until: Callable[[], Any]) -> float:
    began = time.perf_counter()
    work()
    until()
    return time.perf_counter() - began


PAINTED = """(where) => {
  const canvas = [...document.querySelectorAll(where)].pop();
  if (!canvas || !canvas.width) return false;
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  let painted = 0;
  for (let i = 3; i < data.length; i += 4) painted += data[i] > 0;
  return painted > 4000;
}"""
"""Whether the last canvas there shows more than an empty chart: the same question to both pages."""


def drawn(page: Any, where: str) -> None:
    """Wait for a plot, looked for at every frame of the browser."""
    page.wait_for_function(PAINTED, arg=where, timeout=120_000)


def error_of(page: Any) -> str:
    return str(page.inner_text("#headline strong"))


def ours(data: Path) -> dict[str, Any]:
    """One session of the workbench, timed from the clicks."""
    out: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        code = (
            "from pathlib import Path\nfrom workbench.page.server import serve\nserve([], 0, "
            f"False, root=Path({str(Path(folder) / 'sessions')!r}))"
        )
        with served([sys.executable, "-c", code]) as (address, process), browser() as page:
            out["empty page [s]"] = timed(
                lambda: page.goto(address), lambda: page.wait_for_selector("#files")
            )
            out["page [kB]"] = weight(page)
            page.set_input_files(
                "#files",
                [{"name": "joint.toml", "mimeType": "text/plain", "buffer": JOINT.read_bytes()}],
            )
            page.wait_for_function("() => app.state.joint_text && !app.state.job")
            began = time.perf_counter()
            page.set_input_files("#files", [data])
            drawn(page, ".uplot canvas")
            out["first plot [s]"] = time.perf_counter() - began
            drawn(page, "section:has(#series-file) .uplot canvas")
            out["plot of the record as read [s]"] = time.perf_counter() - began
            page.wait_for_function("() => app.state.files[0].status === 'ready'")
            out["checked [s]"] = time.perf_counter() - began
            for name, button, view in (
                ("fit [s]", "#fit", "compare"),
                ("diagnose [s]", "#diagnose", "diagnose"),
            ):
                begun = "v => document.querySelector('#main').dataset.view === v && !app.state.job"
                out[name] = timed(
                    lambda b=button: page.click(b),
                    lambda v=view, f=begun: page.wait_for_function(f, arg=v, timeout=600_000),
                )
            page.wait_for_timeout(float(os.environ.get("IRJ_LOOK_S", "4")) * 1000)
            out.update(moves(page))
            out.update(clicks(page))
            out["server [MB]"] = memory(process)
    return out


HOVERS, SLIDES = 9, 9
"""Times of which the median is given: the hand moves often, the machine has other work, too."""
HOVER = """async (labels) => {
  const frame = () => new Promise((go) => requestAnimationFrame(go)), took = [];
  for (const label of labels) {
    const row = document.querySelector(`li.candidate[data-label="${label}"]`);
    const began = performance.now();
    row.dispatchEvent(new PointerEvent('pointerenter'));
    while (document.querySelector('#law-panel').dataset.label !== label)
      await new Promise((go) => setTimeout(go));
    await frame();
    took.push(performance.now() - began);
  }
  return took;
}"""
SLIDE = """async (times) => {
  const figure = document.querySelector('#slider-error'), took = [];
  const slider = document.querySelector('#sliders input[type=range]');
  for (let k = 1; k <= times; k++) {
    const span = Number(slider.max) - Number(slider.min);
    delete figure.dataset.milliseconds;
    const began = performance.now();
    slider.value = String(Number(slider.min) + span * k / (times + 1));
    slider.dispatchEvent(new Event('input', { bubbles: true }));
    while (!figure.dataset.milliseconds) await new Promise((go) => setTimeout(go));
    took.push(performance.now() - began);
  }
  return took;
}"""


def moves(page: Any) -> dict[str, Any]:
    """Median time from pointing at a candidate to its law on the screen, and from a moved slider
    to the new held-out error.
    """
    labels = page.evaluate(
        "() => [...document.querySelectorAll('.ranking li.candidate')].map((c) => c.dataset.label)"
    )
    for label in labels:  # as the page itself does ahead of the hand
        page.evaluate("l => get(`/view/law?label=${encodeURIComponent(l)}`)", label)
    page.wait_for_function("() => document.querySelector('#law-panel').dataset.label")
    row = [labels[k % len(labels)] for k in range(HOVERS + 1)]
    page.evaluate(HOVER, row)  # each once: what is fetched is kept
    hover = page.evaluate(HOVER, row)
    page.click("#nav-parameters")
    page.wait_for_selector("#sliders input[type=range]")
    slide = page.evaluate(SLIDE, SLIDES)
    page.click("#slider-reset")
    page.click("#nav-diagnose")
    page.wait_for_selector(".candidate button.primary")
    return {
        "hover to law drawn [s]": float(np.median(hover)) / 1e3,
        "slider to new error [s]": float(np.median(slide)) / 1e3,
        "slider, longest of nine [s]": float(max(slide)) / 1e3,
    }


CLICKS = (
    ("prepared", ".candidate button.primary", None),
    ("undo", "#undo", None),
    ("redo", "#redo", None),
    ("undo again", "#undo", None),
    ("by hand, after an undo", "#add-by-hand", HIDDEN),
    ("and another", "#add-by-hand", "cubic_viscous@motor"),
    ("costly memory law", "#add-by-hand", "hysteresis"),
    ("remove", "li button[aria-label^='Remove ']:enabled >> nth=-1", None),
)


def clicks(page: Any) -> dict[str, Any]:
    """Time from a click to the new error on the page, and the error that follows when the whole
    fit is there.
    """
    out: dict[str, Any] = {}
    for name, selector, label in CLICKS:
        if label or name == "remove":
            page.click("#nav-ledger")
            page.wait_for_selector("#add-label")
        if label:
            page.select_option("#add-label", label)
        mark = page.evaluate("() => app.state.revision")
        shown = (
            "() => document.querySelector('#headline').dataset.text.startsWith("
            "digits(app.state.steps.at(-1).held_out.relative_error_percent))"
        )

        def seen(mark: int = mark, shown: str = shown) -> None:
            page.wait_for_function(
                "n => app.state.revision !== n && !app.state.job", arg=mark, timeout=120_000
            )
            page.wait_for_function(shown)

        out[f"click: {name} [s]"] = timed(lambda s=selector: page.click(s), seen)
        first = error_of(page)
        whole = timed(
            lambda: None,
            lambda: page.wait_for_function("() => app.state.steps.at(-1).settled", timeout=120_000),
        )
        page.wait_for_function(shown)
        out[f"error: {name}"] = f"{first}, whole fit {error_of(page)} after {whole:.2f} s"
    adding = [
        v
        for k, v in out.items()
        if k.startswith("click") and not any(w in k for w in ("undo", "redo"))
    ]
    out["click to new error [s]"] = max(adding)
    return out


def peer(data: Path, engine: str) -> dict[str, Any]:
    """The same loop on the peer page."""
    out: dict[str, Any] = {}
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / "peer" / "page.py"),
        "--port",
        str(port),
        "--engine",
        engine,
    ]
    with served(command, f"http://127.0.0.1:{port}") as (address, process), browser() as page:
        out["empty page [s]"] = timed(
            lambda: page.goto(address), lambda: page.wait_for_selector("#fit")
        )
        page.wait_for_timeout(2000)
        out["page [kB]"] = weight(page)
        assert not page.evaluate(PAINTED, "canvas"), "the empty chart counts as drawn"
        out["first plot [s]"] = timed(
            lambda: page.set_input_files("input[type=file]", [data]), lambda: drawn(page, "canvas")
        )

        def shows(word: str) -> None:
            page.wait_for_function(
                "w => document.querySelector('#error').textContent.startsWith(w + ':')",
                arg=word,
                timeout=600_000,
            )

        out["fit [s]"] = timed(lambda: page.click("#fit"), lambda: shows("start"))
        out["error: start"] = page.inner_text("#error")
        out["click to new error [s]"] = timed(lambda: page.click("#add"), lambda: shows(HIDDEN))
        out["error: added"] = page.inner_text("#error")
        out["server [MB]"] = memory(process)
    return out


def cancels(data: Path) -> dict[str, Any]:
    """Longest wait from Cancel until the session is free again, for every long action,
    cancelled at several moments.
    """
    import shutil

    from workbench.page import verbs as app_verbs
    from workbench.page.input import add_upload, set_joint
    from workbench.page.live import Live
    from workbench.page.session import Store

    out: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        live = Live(Store(Path(folder)).create())
        set_joint(live, {"text": JOINT.read_text(encoding="utf-8")})
        shutil.copyfile(data, live.session.files / "long.npz")
        add_upload(live, "long.npz", "long.npz", data.stat().st_size)

        def ended(seconds: float) -> bool:
            end = time.perf_counter() + seconds
            while live.job is not None and time.perf_counter() < end:
                time.sleep(0.001)
            return live.job is None

        app_verbs.run(live, "fit", {})
        ended(600)
        file = live.state.files[0].id
        for action in (
            "diagnose",
            "confirm",
            "improve",
            "report",
            "replay",
            "plan",
            "plant",
            "estimator",
        ):
            waits = []
            for after in (0.05, 0.3, 0.8, 1.6, 3.0, 6.0):
                app_verbs.run(live, action, {"file": file})
                if ended(after):
                    break
                began = time.perf_counter()
                live.cancel()
                ended(60)
                waits.append(time.perf_counter() - began)
                live.worker.give_up()
            out[f"cancel {action} [s]"] = max(waits, default=float("nan"))
    return out


def pictures(folder: Path) -> None:
    """The pictures of docs/workbench.md: the demo's start model, and a replay in which a sensor
    fails.
    """
    with tempfile.TemporaryDirectory() as sessions:
        code = (
            "from pathlib import Path\nfrom workbench.page.server import serve\nserve([], 0, "
            f"False, root=Path({sessions!r}))"
        )
        with served([sys.executable, "-c", code]) as (address, _), browser() as page:
            page.set_viewport_size({"width": 1440, "height": 1240})
            page.emulate_media(color_scheme="light", reduced_motion="reduce")
            page.goto(address)

            def step(selector: str, view: str) -> None:
                page.click(selector)
                done = (
                    "v => document.querySelector('#main').dataset.view === v && "
                    "!app.state.job && app.state.steps.every((s) => s.settled)"
                )
                page.wait_for_function(done, arg=view, timeout=120_000)
                page.wait_for_timeout(600)

            page.click("#demo")
            page.wait_for_selector("#fit:enabled", timeout=60_000)
            step("#fit", "compare")
            step("#diagnose", "diagnose")
            step("#nav-compare", "compare")
            page.wait_for_selector("#law-panel svg")
            page.wait_for_timeout(1000)
            page.screenshot(path=str(folder / "page-compare.png"))
            page.set_viewport_size({"width": 1000, "height": 1400})
            step("#nav-diagnose", "diagnose")
            step("button.primary:has-text('Add')", "ledger")
            step("#nav-replay", "replay")
            page.select_option("#replay-kind", "bias")
            page.fill("#replay-at", "9")
            step("#replay", "replay")
            page.wait_for_selector("#timeline")
            page.locator("#timeline").screenshot(path=str(folder / "page-replay.png"))


def smallest(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Times at their best, sizes at their worst."""
    out = dict(runs[-1])
    for key in out:
        values = [r[key] for r in runs]
        if key.endswith("[s]"):
            out[key] = min(values)
        elif key.endswith(("[MB]", "[kB]")):
            out[key] = max(values)
    return out


def shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--peer", choices=("verbs", "windows", "both", "none"), default="both")
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--cancel", action="store_true", help="measure how long Cancel takes instead"
    )
    parser.add_argument(
        "--pictures",
        type=Path,
        metavar="FOLDER",
        help="draw the pictures of the documentation there, and measure nothing",
    )
    given = parser.parse_args()
    if given.cancel:
        for key, value in cancels(record(given.samples)).items():
            print(f"  {key:32} {shown(value)}")
        return
    if given.pictures:
        pictures(given.pictures)
        return
    engines = {"both": ["verbs", "windows"], "none": []}.get(given.peer, [given.peer])
    if engines and importlib.util.find_spec("nicegui") is None:
        print("no peer page: it needs  pip install nicegui")
        engines = []
    data = record(given.samples)
    runs: dict[str, list[dict[str, Any]]] = {"workbench": [], **{f"peer, {e}": [] for e in engines}}
    for _ in range(given.repeats):
        runs["workbench"].append(ours(data))
        for engine in engines:
            runs[f"peer, {engine}"].append(peer(data, engine))
    found = {name: smallest(made) for name, made in runs.items()}
    for name, values in found.items():
        print(f"\n{name}, {given.samples} samples")
        for key, value in values.items():
            limit = f"   limit {LIMITS[key]:g}" if name == "workbench" and key in LIMITS else ""
            print(f"  {key:32} {shown(value)}{limit}")
    for engine in engines:
        print(f"\ntimes faster than the peer ({engine}):")
        for key in ("empty page [s]", "first plot [s]", "fit [s]", "click to new error [s]"):
            print(f"  {key:32} {found[f'peer, {engine}'][key] / found['workbench'][key]:.2f}")
        as_read = "plot of the record as read [s]"
        print(
            f"  {as_read:32} "
            f"{found[f'peer, {engine}']['first plot [s]'] / found['workbench'][as_read]:.2f}"
        )
    if given.json:
        given.json.write_text(json.dumps({"samples": given.samples, **found}, indent=1))


if __name__ == "__main__":
    main()
