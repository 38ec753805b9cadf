"""Every view to look at: ``python -m tests.workbench.page.look FOLDER [--axe axe.min.js]``.

The demo goes through the whole loop in Debian's Chromium. Each view is taken as a picture in
light and dark colours, 1280 and 375 pixels wide, with everything unfolded that can be folded; and
what axe-core finds there of any level is counted, where its file is given (else ``$IRJ_AXE``).
Returns 1 where a view has a finding, is wider than the window, or threw.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from tests.workbench.chromium import context_of, launched
from tests.workbench.served import serving

LONGEST: Final = 120_000
"""What one wait may take at most [ms]."""
DRAWN: Final = (
    "v => document.querySelector('#main').dataset.view === v && !busy() && !app.doing.length && "
    "!app.asking && !app.waiting && !app.then && app.state.steps.every((s) => s.settled) && "
    "document.querySelector('#main').dataset.revision === String(app.state.revision)"
)
UNFOLDED: Final = "document.querySelectorAll('#main details').forEach((d) => { d.open = true; })"
STILL: Final = (
    "() => app.plots.every((p) => !p.plots || p.data) && "
    "![...document.querySelectorAll('[role=status]')].some((n) => / …$/.test(n.textContent))"
)
WIDTHS: Final = (1280, 375)


def idle(page: Any, view: str) -> None:
    """The view is drawn as the state has it, and no work runs."""
    page.wait_for_function(DRAWN, arg=view, timeout=LONGEST)


def go(page: Any, view: str) -> None:
    page.click(f"#nav-{view}", timeout=LONGEST)
    idle(page, view)


def rig(path: Path) -> Path:
    """A file that raises questions: two joints side by side, degrees that say nothing of it, a
    supply voltage, and time that starts again.
    """
    t = np.tile(np.arange(2000) * 0.002, 2)
    columns = {"t": t, "vbus_V": 48.0 + 0.1 * np.sin(50.0 * t)}
    for k, turns in ((1, 80.0), (2, 35.0)):
        columns[f"q{k}"] = turns * np.sin((1.0 + k) * t)
        columns[f"iq{k}_A"] = np.cos((1.0 + k) * t)
    file = path / "rig.csv"
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return file


def views(page: Any, address: str, folder: Path) -> Iterator[str]:
    """Goes from view to view; at each the page stands as a user has it."""
    page.goto(address)
    page.wait_for_selector("#demo")
    yield "empty"
    page.set_input_files("#files", [rig(folder)])
    page.wait_for_selector(".import .odd", timeout=LONGEST)
    yield "import"
    page.click("#fresh")
    page.wait_for_function("() => app.state && !app.state.files.length && !busy()")
    page.click("#demo", timeout=LONGEST)
    page.wait_for_selector("#fit", timeout=LONGEST)
    page.click("#fit")
    idle(page, "compare")
    yield "compare-start"
    page.click("#diagnose")
    idle(page, "diagnose")
    yield "diagnose"
    page.click("button.primary:has-text('Add')")
    idle(page, "ledger")
    page.click("#diagnose")
    idle(page, "diagnose")
    yield "diagnose-again"
    go(page, "ledger")
    page.click("#improve")
    page.wait_for_selector("#printed", state="attached", timeout=LONGEST)
    idle(page, "ledger")
    yield "ledger"
    for view in ("load", "model", "compare", "parameters", "export"):
        go(page, view)
        yield view
    go(page, "parameters")
    page.evaluate(
        "() => { const i = document.querySelector('#slide-motor_coulomb');"
        " i.value = String(Number(i.value) * 1.1); i.dispatchEvent(new Event('input')); }"
    )
    page.wait_for_selector("#sliders svg")
    yield "slid"
    go(page, "replay")
    yield "replay-empty"
    page.select_option("#replay-kind", "bias")
    page.click("#replay")
    page.wait_for_selector("#timeline", timeout=LONGEST)
    idle(page, "replay")
    yield "replay"
    go(page, "plan")
    yield "plan-empty"
    page.click("#plan")
    page.wait_for_selector("#best-motion", timeout=LONGEST)
    idle(page, "plan")
    yield "plan"
    page.click("#home")
    page.wait_for_selector("#need-key")
    yield "home-key"
    from workbench.page.desk import home
    from workbench.page.session import Store

    page.goto(f"{address}#home={home.key_of(Store(folder / 'sessions'))}")
    page.wait_for_selector(".session")
    yield "home"


@final
class Look:
    """Pictures and findings of a page."""

    def __init__(self, page: Any, folder: Path, axe: str) -> None:
        self.page, self.folder, self.axe = page, folder, axe

    def at(self, name: str) -> list[str]:
        """Both colours, both widths; what is wrong there."""
        page, wrong = self.page, []
        view = page.evaluate("app.view")
        for colours in ("light", "dark"):
            for width in WIDTHS:
                page.set_viewport_size({"width": width, "height": 860})
                page.evaluate(UNFOLDED)
                page.evaluate("c => { theme(c); render(false); }", colours)
                page.wait_for_function(
                    "v => document.querySelector('#main').dataset.view === v",
                    arg=view,
                    timeout=LONGEST,
                )
                page.wait_for_function(STILL, timeout=LONGEST)
                page.wait_for_timeout(300)  # a picture for the new width is drawn after 200 ms
                page.evaluate(UNFOLDED)
                page.wait_for_function(STILL, timeout=LONGEST)
                where = f"{name}-{colours}-{width}"
                page.screenshot(path=str(self.folder / f"{where}.png"), full_page=True)
                if page.evaluate("document.documentElement.scrollWidth") > width:
                    wrong.append(f"{where}: wider than the window")
                wrong += [f"{where}: {said}" for said in self.findings()]
        page.set_viewport_size({"width": WIDTHS[0], "height": 860})
        page.evaluate("theme('light')")
        page.wait_for_timeout(300)
        return wrong

    def findings(self) -> list[str]:
        if not self.axe:
            return []
        self.page.evaluate(self.axe)
        found = self.page.evaluate("() => axe.run(document)")["violations"]
        return [f"{v['id']} ({v['impact']}): {n['html'][:160]}" for v in found for n in v["nodes"]]


def main() -> int:
    """Pictures of every view into a folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="takes the pictures")
    parser.add_argument("--axe", type=Path, default=os.environ.get("IRJ_AXE"))
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    axe = Path(given.axe).read_text(encoding="utf-8") if given.axe else ""
    thrown: list[str] = []
    wrong: list[str] = []
    count = 0
    with tempfile.TemporaryDirectory() as place, launched() as chromium:
        folder = Path(place)
        with serving(folder / "sessions") as there:
            context = context_of(chromium, viewport={"width": WIDTHS[0], "height": 860})
            context.on("weberror", lambda e: thrown.append(str(e.error)))
            context.on("console", lambda m: thrown.append(m.text) if m.type == "error" else None)
            page = context.new_page()
            look = Look(page, given.folder, axe)
            for name in views(page, there.address, folder):
                said = look.at(name)
                print(f"{name}: {len(said)} findings", *said, sep="\n  ", flush=True)
                wrong += said
                count += 1
            context.close()
    rules = "axe-core of any level" if axe else "no axe-core"
    print(
        f"{count} views in {2 * len(WIDTHS)} looks each ({rules}): {len(wrong)} findings, ", end=""
    )
    print(f"{len(thrown)} errors thrown", *thrown, sep="\n  ")
    return 1 if wrong or thrown else 0


if __name__ == "__main__":
    sys.exit(main())
