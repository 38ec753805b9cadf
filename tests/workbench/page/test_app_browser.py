"""The whole loop in Debian's Chromium, by clicks, from an empty page to the falling error and
the files taken home.
"""

from __future__ import annotations

import os
import re
import tomllib
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.workbench.chromium import CI, context_of, launched, needs_chromium
from tests.workbench.served import Served, serving

SHARED = Path(__file__).resolve().parents[3].parent / "shared"
AXE = os.environ.get("IRJ_AXE", "")

pytestmark = needs_chromium


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with serving(tmp_path / "sessions") as there:
        yield there


@dataclass
class Browser:
    """A page, with what went wrong in it, the clicks made and the pictures taken."""

    page: Any
    shots: Path | None
    problems: list[str]
    context: Any
    clicks: int = 0

    def click(self, selector: str) -> None:
        self.page.click(selector, timeout=60_000)
        self.clicks += 1

    def idle(self, view: str) -> None:
        """The view is there, no work runs, and the last step is the whole fit."""
        self.page.wait_for_function(
            "v => document.querySelector('#main').dataset.view === v && "
            "document.querySelector('#job').hidden && !app.sent"
            " && app.state.steps.every((s) => s.settled) && "
            "document.querySelector('#main').dataset.revision === "
            "String(app.state.revision)",
            arg=view,
            timeout=120_000,
        )
        self.page.wait_for_timeout(150)

    def shot(self, name: str) -> None:
        """A picture to look at, where pictures are asked for."""
        if self.shots is None:
            return
        self.page.wait_for_timeout(250)
        self.page.screenshot(path=str(self.shots / f"{name}.png"), full_page=True)

    def error(self) -> float:
        return float(self.page.inner_text("#headline strong").split()[0])


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """One browser for the file: what a test leaves is in a context of its own."""
    with launched() as running:
        yield running


@pytest.fixture
def browser(chromium: Any) -> Iterator[Browser]:
    named = os.environ.get("IRJ_SCREENSHOTS")
    shots = Path(named) if named else None
    if shots is not None:
        shots.mkdir(parents=True, exist_ok=True)
    context = context_of(chromium, viewport={"width": 1280, "height": 860}, accept_downloads=True)
    problems: list[str] = []
    context.on("weberror", lambda e: problems.append(str(e.error)))
    context.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
    context.on(
        "request",
        lambda r: (
            problems.append(f"network: {r.url}")
            if not re.match(r"(http://127\.0\.0\.1:|data:|blob:)", r.url)
            else None
        ),
    )
    yield Browser(context.new_page(), shots, problems, context)
    context.close()
    assert problems == []


def need(path: Path) -> Path:
    if not path.exists():
        if CI:
            pytest.fail(f"{path} is missing")
        pytest.skip(f"{path} is not beside the checkout")
    return path


def test_a_new_user_sees_the_error_fall_within_five_clicks(
    served: Served, browser: Browser
) -> None:
    browser.page.goto(served.address)
    browser.page.wait_for_selector("#demo")
    browser.shot("01-empty")
    browser.click("#demo")
    browser.page.wait_for_selector("#fit", timeout=60_000)
    browser.page.wait_for_selector(".uplot")
    browser.shot("02-demo-loaded")
    browser.click("#fit")
    browser.idle("compare")
    start = browser.error()
    browser.page.wait_for_selector(".uplot")
    browser.shot("03-compare")
    browser.click("#diagnose")
    browser.idle("diagnose")
    assert "Stribeck" in browser.page.inner_text("#claim")
    browser.shot("04-diagnose")
    browser.click("button.primary:has-text('Add')")
    browser.idle("ledger")
    assert browser.clicks <= 5
    assert browser.error() < 0.5 * start
    browser.shot("05-falling")


def take_home(browser: Browser, tmp_path: Path) -> None:
    """Report and joint file, and the FMU where it can be built, downloaded and valid."""
    page = browser.page
    browser.click("#nav-export")
    browser.idle("export")
    with page.expect_download() as joint:
        page.click("#get-joint-toml")
    joint.value.save_as(tmp_path / "joint.toml")
    assert tomllib.loads((tmp_path / "joint.toml").read_text())["fitted"]
    with page.expect_download(timeout=120_000) as report:
        page.click("#make-report")
    report.value.save_as(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert text.lower().startswith("<!doctype html>")
    assert not re.search(r"""(src|href)=["']https?://""", text)
    browser.idle("export")
    if page.locator("#make-plant").count():
        with page.expect_download(timeout=300_000) as fmu:
            page.click("#make-plant")
        fmu.value.save_as(tmp_path / "joint.fmu")
        with zipfile.ZipFile(tmp_path / "joint.fmu") as archive:
            assert "modelDescription.xml" in archive.namelist()
        import fmpy.validation

        assert fmpy.validation.validate_fmu(str(tmp_path / "joint.fmu")) == []
        browser.idle("export")
    browser.shot("export")


@pytest.mark.slow
def test_the_loop_on_stribeck(served: Served, browser: Browser, tmp_path: Path) -> None:
    folder = need(SHARED / "hidden_effect" / "stribeck")
    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#files")
    page.set_input_files(
        "#files",
        [folder / f for f in ("joint.toml", "train.csv", "train2.csv", "test.csv", "test2.csv")],
    )
    page.wait_for_function(
        "() => app.state.files.length === 4 && !app.state.job && document.querySelector('#fit')",
        timeout=60_000,
    )
    browser.shot("stribeck-1-load")
    browser.click("#fit")
    browser.idle("compare")
    start = browser.error()
    assert "velocity" in page.inner_text("figure.place >> nth=0")
    browser.click("#diagnose")
    browser.idle("diagnose")
    browser.shot("stribeck-2-diagnose")
    assert page.inner_text("#claim") == "Stribeck effect"
    browser.click("#add-stribeck-motor")
    browser.idle("ledger")
    after = browser.error()
    assert after < 0.5 * start
    browser.shot("stribeck-3-ledger")
    browser.click("#undo")
    browser.idle("ledger")
    assert browser.error() == pytest.approx(start, rel=1e-3)
    browser.click("#redo")
    browser.idle("ledger")
    assert browser.error() == pytest.approx(after, rel=1e-3)
    browser.click("#nav-parameters")
    browser.idle("parameters")
    assert "stribeck extra" in page.inner_text("table")
    browser.shot("stribeck-4-parameters")
    take_home(browser, tmp_path)
    page.reload()
    browser.idle("export")
    assert browser.error() == pytest.approx(after, rel=1e-3)


@pytest.mark.slow
def test_the_loop_on_emps(served: Served, browser: Browser, tmp_path: Path) -> None:
    """A file without recognised headers: the guess is shown, corrected and confirmed, and the
    loop follows.
    """
    folder = need(SHARED / "measurements" / "emps")
    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#files")
    page.set_input_files("#files", [folder / "train.csv", folder / "test_pulses.csv"])
    page.wait_for_function("() => app.state.files.length === 2 && !app.state.job", timeout=60_000)
    page.wait_for_selector(".map-table")
    browser.shot("emps-1-columns")
    with page.expect_response("**/look/*"):
        page.locator("select[aria-label='Kind of the axis']").first.select_option("linear")
    browser.clicks += 1
    browser.click("button:has-text('Use for all 2 files')")
    browser.idle("load")
    assert page.locator(".import").count() == 0, "the columns of both files are confirmed"
    browser.shot("emps-2-load")
    browser.click("#to-model")
    browser.idle("model")
    assert page.is_checked("#kind-linear"), "what was said at the columns is not asked again"
    page.fill("#name", "emps")
    page.fill("#gear_ratio", "1")
    page.fill("#torque_per_voltage", "35.15065188")
    browser.click("input[value=coulomb]")  # not in the start model: to be found
    browser.shot("emps-3-model")
    browser.click("#save-fit")
    browser.idle("compare")
    start = browser.error()
    browser.shot("emps-4-compare")
    browser.click("#diagnose")
    browser.idle("diagnose")
    browser.shot("emps-5-diagnose")
    assert "Coulomb" in page.inner_text("#claim")
    browser.click("button.primary:has-text('Add')")
    browser.idle("ledger")
    assert browser.error() < 0.8 * start
    assert browser.clicks <= 8, "ticks and choices counted"
    browser.shot("emps-6-ledger")
    take_home(browser, tmp_path)


def test_every_view_fits_a_phone_and_passes_axe(served: Served, browser: Browser) -> None:
    """In light and in dark: the page follows the system while it is open."""
    page, wrong = browser.page, []

    def in_both(name: str, *, shot: bool = True) -> None:
        for colours in ("light", "dark"):
            page.emulate_media(color_scheme=colours)
            page.wait_for_function("s => document.documentElement.dataset.theme === s", arg=colours)
            if shot:
                browser.shot(f"{colours}-{name}")
            rules = ["cat.color"] if colours == "dark" else []  # colours change nothing else
            wrong.extend(axe(page, f"{name}, {colours}", rules))

    page.goto(served.address)
    page.wait_for_selector("#demo")
    in_both("empty", shot=False)
    demo_with_the_effect(served, browser)
    beside = (
        ("replay", ("#replay-kind", "bias"), "#replay", "#timeline"),
        ("plan", ("#plan-label", "quadratic_drag@motor"), "#plan", "#best-motion"),
    )
    for view, select, button, made in beside:
        page.click(f"#nav-{view}")
        browser.idle(view)
        in_both(f"{view}, empty", shot=False)
        page.select_option(*select)
        page.click(button)
        page.wait_for_selector(made, timeout=120_000)
        browser.idle(view)
    for width in (1280, 375):
        page.set_viewport_size({"width": width, "height": 812})
        for view in (
            "load",
            "model",
            "compare",
            "ledger",
            "parameters",
            "replay",
            "plan",
            "export",
        ):
            page.click(f"#nav-{view}")
            browser.idle(view)
            in_both(f"{width}-{view}")
            assert page.evaluate("document.documentElement.scrollWidth") <= width, (
                f"{view} is wider than {width} pixels"
            )
            if view == "parameters":
                page.evaluate(WIDEST_VALUES)
            assert cut_or_tiny(page) == [], f"{view} at {width} pixels"
    page.click("#nav-ledger")
    browser.idle("ledger")
    page.set_viewport_size({"width": 812, "height": 375})
    page.wait_for_function("() => Math.abs(app.drawn - 742) < 20")
    page.set_viewport_size({"width": 375, "height": 812})
    page.wait_for_function("() => app.drawn < 320")
    browser.idle("ledger")
    assert cut_or_tiny(page) == [], "a phone that was turned has pictures of its own width"
    page.click("#diagnose")
    browser.idle("diagnose")
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    in_both("375-diagnose")
    assert wrong == []


WIDEST_VALUES = """document.querySelectorAll('.slide input:not([type])').forEach((f) => {
  f.value = '-0.000619076'; })"""
"""The last digit of a fit, and the width of its field with it, differ from machine to machine."""
LOWEST = 9
"""Height of a letter's line under which a label is not read on a phone [px]."""


def cut_or_tiny(page: Any) -> list[str]:
    """Labels of pictures and plots that are cut or too small, and fields too narrow for theirs."""
    found = page.evaluate(
        """(lowest) => {
          const out = [], seen = (e) => e.getClientRects().length;
          for (const t of document.querySelectorAll('#main svg text')) {
            if (!seen(t) || !t.textContent) continue;
            const a = t.getBoundingClientRect(), b = t.ownerSVGElement.getBoundingClientRect();
            if (a.height < lowest) out.push(`tiny: ${t.textContent}`);
            if (a.left < b.left - 1 || a.right > b.right + 1 || a.top < b.top - 1
              || a.bottom > b.bottom + 1) out.push(`cut: ${t.textContent}`);
          }
          const drawn = app.plots.flatMap((p) => p.plots || []);
          const axes = drawn.flatMap((p) => p.axes.map((a) => [p, a]));
          for (const [plot, axis] of axes) {
            if (!axis.label) continue;
            plot.ctx.font = axis.labelFont[0];
            const room = axis.side % 2 ? plot.ctx.canvas.height : plot.ctx.canvas.width;
            if (plot.ctx.measureText(axis.label).width > room) out.push(`cut: ${axis.label}`);
          }
          for (const f of document.querySelectorAll('#main input:not([type])'))
            if (seen(f) && f.scrollWidth > f.clientWidth + 1) out.push(`narrow: ${f.value}`);
          return out;
        }""",
        LOWEST,
    )
    assert isinstance(found, list)
    return found


def axe(page: Any, where: str, tags: list[str]) -> list[str]:
    """Findings of axe-core of any level, where IRJ_AXE names its file (npm package axe-core), by
    its rules with these tags, or by all.
    """
    if not AXE:
        assert not CI or os.environ.get("IRJ_NO_AXE"), (
            "IRJ_AXE must name axe.min.js of the npm package axe-core"
        )
        return []
    if not page.evaluate("() => 'axe' in window"):  # it stays until the page is loaded anew
        page.evaluate(Path(AXE).read_text(encoding="utf-8"))
    found = page.evaluate(
        "tags => axe.run(document, { resultTypes: ['violations'],"
        " ...(tags.length ? { runOnly: tags } : {}) })",
        tags,
    )
    return [
        f"{where}: {v['id']}: {n['html'][:120]} {n.get('failureSummary', '')[:200]}"
        for v in found["violations"]
        for n in v["nodes"][:3]
    ]


def test_the_keyboard_alone_reaches_the_falling_error(served: Served, browser: Browser) -> None:
    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#demo")

    def press(selector: str) -> None:
        for _ in range(60):
            page.keyboard.press("Tab")
            if page.evaluate("s => document.activeElement.matches(s)", selector):
                page.keyboard.press("Enter")
                return
        pytest.fail(f"{selector} is not reached by the Tab key")

    press("#demo")
    page.wait_for_selector("#fit", timeout=60_000)
    press("#fit")
    browser.idle("compare")
    start = browser.error()
    press("#diagnose")
    browser.idle("diagnose")
    press(".candidate button.primary")
    browser.idle("ledger")
    assert browser.error() < 0.5 * start


def test_a_key_pressed_while_work_runs_or_a_view_is_drawn_anew_is_not_lost(
    served: Served, browser: Browser
) -> None:
    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#demo")
    page.click("#demo")
    page.wait_for_selector("#fit", timeout=60_000)
    browser.idle("load")
    page.focus("#fit")
    page.evaluate("app.sent = true; surround(); render(false)")  # as while an answer is awaited
    page.wait_for_timeout(200)
    assert page.evaluate("document.activeElement.id") == "fit"
    page.keyboard.press("Enter")
    assert page.evaluate("Boolean(app.waiting)")
    page.evaluate("app.sent = false; adopt(app.state)")
    browser.idle("compare")
    assert browser.error() > 0


# --- the views beside the loop --------------------------------------------------------------------


def demo_with_the_effect(served: Served, browser: Browser) -> None:
    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#demo")
    page.click("#demo")
    page.wait_for_selector("#fit", timeout=60_000)
    page.click("#fit")
    browser.idle("compare")
    page.click("#diagnose")
    browser.idle("diagnose")
    page.click("button.primary:has-text('Add')")
    browser.idle("ledger")


@pytest.mark.slow
def test_pattern_replay_and_plan_by_clicks(
    served: Served, browser: Browser, tmp_path: Path
) -> None:
    page = browser.page
    demo_with_the_effect(served, browser)
    browser.click("#nav-compare")
    browser.idle("compare")
    assert "No balance stands over the noise" in page.inner_text("#pattern")
    assert page.locator("#pattern svg circle.s-was").count() == 1, (
        "the motor balance moved, the others did not"
    )
    browser.click("#nav-replay")
    browser.idle("replay")
    page.select_option("#replay-kind", "stuck")
    page.select_option("#replay-sensor", "torque")
    page.fill("#replay-at", "9")
    browser.click("#replay")
    page.wait_for_selector("#timeline", timeout=60_000)
    browser.idle("replay")
    assert "torque: a sensor failed" in page.inner_text("#timeline").lower()
    assert page.locator("#timeline svg rect.s-fail").count() == 1
    assert page.locator("#timeline details.save, .spark details.save").count() == (
        1 + page.locator(".spark").count()
    )
    assert page.locator(".spark >> nth=0").locator("svg path.s-grid").count() > 0, "a y axis"
    with page.expect_download() as lanes:
        page.evaluate("document.querySelector('#timeline details.save').open = true")
        page.click("#timeline details.save button:text-is('CSV')")
    lanes.value.save_as(tmp_path / "timeline.csv")
    assert "torque" in (tmp_path / "timeline.csv").read_text().splitlines()[-1]
    assert page.locator(".spark").count() == len(
        page.evaluate("() => get('/view/replay').then((r) => Object.keys(r.last.parameters))")
    )
    browser.click("#nav-plan")
    browser.idle("plan")
    assert (
        "not be told" in page.inner_text("main").lower()
        or "cannot be shown" in page.inner_text("main").lower()
    )
    browser.click("#plan")
    page.wait_for_selector("#best-motion", timeout=120_000)
    browser.idle("plan")
    with page.expect_download() as motion:
        page.click("#get-motion")
    motion.value.save_as(tmp_path / "motion.csv")
    assert (tmp_path / "motion.csv").read_text().startswith("time_s,reference_position_rad")
    page.reload()
    browser.idle("plan")
    assert page.locator("#best-motion").count() == 1


def test_zoom_shows_every_row_and_where_it_is_in_the_record(
    served: Served, browser: Browser
) -> None:
    page = browser.page
    demo_with_the_effect(served, browser)
    browser.click("#nav-load")
    browser.idle("load")
    page.wait_for_selector(".plot .uplot")
    points = int(page.get_attribute(".plot", "data-points"))
    assert points < 8000
    assert page.locator(".strip:visible").count() == 0
    for _ in range(5):
        drawn = page.evaluate(
            "() => [app.plots[0].plot.root.dataset.seen = '1', app.plots[0].range && "
            "app.plots[0].range[0]][1]"
        )
        page.click("button:has-text('Zoom in')")
        page.wait_for_function(
            "was => !app.plots[0].plot.root.dataset.seen && app.plots[0].range && "
            "app.plots[0].range[0] !== was",
            arg=drawn,
        )
    page.wait_for_selector(".strip .u-select")
    shown = page.evaluate(
        "() => [app.plots[0].range, app.plots[0].host.dataset.points, "
        "app.plots[0].plot.root.getAttribute('aria-label')]"
    )
    assert int(shown[1]) == pytest.approx((shown[0][1] - shown[0][0]) / 0.0025, abs=4), (
        "every sample of the window, 2.5 ms apart"
    )
    assert "every sample" in shown[2]
    page.locator(".strip .u-over").scroll_into_view_if_needed()
    box = page.locator(".strip .u-over").bounding_box()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 20, steps=4)
    page.mouse.up()
    page.wait_for_function("() => app.plots[0].range[0] < 12.3 && app.plots[0].range[0] > 11.7")
    low, high = page.evaluate("() => app.plots[0].range")
    assert low == pytest.approx(12.0, abs=0.3)
    assert high == pytest.approx(16.0, abs=0.3)
    page.click("button:has-text('Whole record')")
    page.wait_for_function("() => app.plots[0].range === null")
    page.wait_for_selector(".strip", state="hidden")


@pytest.mark.parametrize("kind", ["npz", "squeezed.npz", "csv"])
def test_a_preview_is_drawn_while_the_server_takes_the_file_in(
    served: Served, browser: Browser, tmp_path: Path, kind: str
) -> None:
    import numpy as np

    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#files")
    t = np.arange(60_000) * 1e-3
    columns = {
        "time_s": t,
        "motor_position_rad": np.sin(t),
        "motor_current_A": np.where(t == t[33_333], 7.0, np.cos(t)).astype(np.float32),
    }
    path = tmp_path / f"run.{kind}"
    if kind == "csv":
        np.savetxt(
            path,
            np.column_stack(list(columns.values())),
            delimiter=",",
            header=",".join(columns),
            comments="",
            fmt="%.6g",
        )
    else:
        (np.savez_compressed if "squeezed" in kind else np.savez)(path, **columns)
    held: list[Any] = []
    page.route("**/files/*", lambda route: held.append(route))
    page.set_input_files("#files", [path])
    page.wait_for_selector("#preview .uplot", timeout=20_000)
    browser.shot(f"preview-{kind}")
    drawn = page.evaluate("() => app.preview.data.series[0].values")
    stamps = page.evaluate("() => app.preview.data.time")
    assert page.evaluate("() => app.preview.data.name") == "motor_position_rad"
    np.testing.assert_allclose(max(drawn), 1.0, atol=1e-3)
    assert all(a < b for a, b in zip(stamps[:-1], stamps[1:], strict=True))
    near = np.abs(np.asarray(drawn) - np.sin(stamps))
    assert near.max() < 0.2
    held[0].continue_()
    page.wait_for_selector("#series-file", timeout=20_000)
    page.wait_for_selector("#preview", state="detached")


def test_an_upload_can_be_cancelled(served: Served, browser: Browser, tmp_path: Path) -> None:
    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#files")
    (tmp_path / "run.csv").write_text(
        "time_s,motor_position_rad\n" + "".join(f"{k / 100},{k}\n" for k in range(500))
    )
    page.route("**/files/*", lambda route: None)
    page.set_input_files("#files", [tmp_path / "run.csv"])
    page.wait_for_selector("#job:not([hidden])")
    page.click("#cancel")
    page.wait_for_selector("#error:not([hidden])")
    assert "run.csv: cancelled; nothing was changed" in page.inner_text("#error-text")
    page.wait_for_selector("#job", state="hidden")
    assert page.evaluate("() => app.state.files.length") == 0
    page.unroute("**/files/*")
    browser.problems.clear()


# --- what people do to a page ---------------------------------------------------------------------


@pytest.mark.slow
def test_fifty_quick_clicks_and_two_tabs(served: Served, browser: Browser) -> None:
    page = browser.page
    page.goto(served.address)
    page.click("#demo")
    page.wait_for_selector("#fit:enabled", timeout=60_000)
    page.evaluate(
        "() => { const b = document.querySelector('#fit'); for (let k = 0; k < 50; k++) "
        "b.click(); }"
    )
    browser.idle("compare")
    assert page.evaluate("() => app.state.steps.length") == 1
    assert page.is_hidden("#error")
    other = page.context.new_page()
    other.goto(served.address + f"#session={page.evaluate('() => app.id')}")
    other.wait_for_selector("#headline strong")
    page.click("#nav-ledger")
    browser.idle("ledger")
    page.select_option("#add-label", "cubic_viscous@motor")
    page.click("#add-by-hand")
    other.wait_for_function(
        "() => app.state.steps.length === 2 && app.state.steps[1].settled", timeout=60_000
    )
    browser.idle("ledger")
    other.wait_for_function(
        "text => document.querySelector('#headline strong').innerText === text",
        arg=page.inner_text("#headline strong"),
    )
    other.click("#undo")
    page.wait_for_function("() => app.state.steps.length === 1", timeout=60_000)
    other.close()


def test_a_tab_closed_in_the_middle_loses_nothing_and_a_stopped_server_is_said(
    served: Served, browser: Browser
) -> None:
    page = browser.page
    page.goto(served.address)
    page.click("#demo")
    page.wait_for_selector("#fit", timeout=60_000)
    page.click("#fit")
    browser.idle("compare")
    page.click("#diagnose")
    page.wait_for_selector("#job:not([hidden])")
    address = served.address + f"#session={page.evaluate('() => app.id')}&view=ledger"
    page.close()
    again = browser.page = browser.context.new_page()
    again.goto(address)
    again.wait_for_function(
        "() => app.state && app.state.diagnosis && !app.state.job", timeout=60_000
    )
    served.server.should_exit = True
    while served.thread.is_alive():
        again.wait_for_timeout(100)
    again.click("#add-by-hand")
    again.wait_for_selector("#error:not([hidden])")
    assert (
        "the server does not answer; is it still running? What was done is kept"
        in again.inner_text("#error-text")
    )
    browser.problems.clear()


def test_two_gigabytes_are_refused_before_they_are_sent(
    served: Served, browser: Browser, tmp_path: Path
) -> None:
    path = tmp_path / "big.csv"
    with path.open("wb") as stream:
        stream.truncate(2 << 30)
    page = browser.page
    page.goto(served.address)
    page.wait_for_selector("#files")
    page.set_input_files("#files", [path])
    page.wait_for_selector("#error:not([hidden])")
    assert "big.csv: 2147 MB is over the limit of 1074 MB" in page.inner_text("#error-text")
    assert page.evaluate("() => app.state.files.length") == 0
