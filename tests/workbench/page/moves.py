"""Hostile and clumsy moves on a session that has fits, in Debian's Chromium on a server of its own:
``python -m tests.workbench.page.moves [--moves 60] [--seed 0]``.

After every move each fit that was ever seen in the session must still be in its file, with its
held-out error; and no page may have thrown. Each kind of move is made once before one is made
again.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, final

from tests.workbench.chromium import context_of, launched
from tests.workbench.served import Server

ROOT: Final = Path(__file__).resolve().parents[3]
LONGEST: Final = 120_000
"""What one wait may take at most [ms]."""
DRAWN: Final = (
    "() => app.state && !app.state.job && !busy() && !app.doing.length && !app.asking && "
    "app.state.steps.every((s) => s.settled) && "
    "document.querySelector('#main').dataset.revision === String(app.state.revision)"
)


@final
class Desk:
    """A session with fits, and a hand on it."""

    def __init__(self, server: Server, context: Any, folder: Path) -> None:
        self.server, self.context, self.folder = server, context, folder
        self.fits: dict[str, str] = {}
        self.thrown: list[str] = []
        context.on("weberror", lambda e: self.thrown.append(str(e.error)))
        self.page = context.new_page()
        self.page.goto(server.address)
        self.page.click("#demo", timeout=LONGEST)
        self.page.click("#fit", timeout=LONGEST)
        self.page.wait_for_function("() => app.state && app.state.steps.length", timeout=LONGEST)
        self.idle()
        self.id = str(self.page.evaluate("app.id"))
        self.add("stribeck@motor")
        self.keep()

    def idle(self, page: Any = None) -> None:
        (page or self.page).wait_for_function(DRAWN, timeout=LONGEST)

    def go(self, view: str) -> None:
        self.page.click(f"#nav-{view}", timeout=LONGEST)
        self.page.wait_for_function(
            "v => document.querySelector('#main').dataset.view === v", arg=view, timeout=LONGEST
        )

    def run(self, action: str, body: Mapping[str, Any] | None = None) -> None:
        """Begin an action and wait for its end."""
        self.page.evaluate("([a, b]) => run(a, b)", [action, dict(body or {})])
        self.idle()

    def add(self, label: str) -> None:
        inside = self.page.evaluate("app.state.steps.at(-1).effects")
        self.run("remove" if label in inside else "add", {"label": label})

    def again(self) -> None:
        """Open the session anew, as after a restart."""
        self.page.goto("about:blank")
        self.page.goto(f"{self.server.address}#session={self.id}")
        self.idle()
        if not self.page.evaluate("app.state.steps.length"):
            self.run("fit")

    def error(self) -> str:
        self.page.wait_for_selector("#error:not([hidden])", timeout=LONGEST)
        return str(self.page.inner_text("#error-text"))

    def stored(self) -> dict[str, str]:
        """Every whole fit in the session's file: its identifier, and what it is."""
        text = (self.server.root / self.id / "state.json").read_text(encoding="utf-8")
        state = json.loads(text)
        places = [state, *state["branches"]]
        steps = [s for p in places for k in ("steps", "undone") for s in p[k]]
        named = {s["id"] for s in steps} | {state["branch"], *(b["id"] for b in state["branches"])}
        assert set(state["remarks"]) <= named, "a note without its fit"
        whole = [s for s in steps if s["settled"]]
        return {s["id"]: json.dumps([s["effects"], s["values"], s["held_out"]]) for s in whole}

    def keep(self) -> None:
        """Nothing that was seen is gone or another one; what is new counts from now on. Of two
        equal fits one may go.
        """
        found = self.stored()
        there = set(found.values())
        lost = [k for k, v in self.fits.items() if found.get(k, v) != v or v not in there]
        assert lost == []
        assert self.thrown == []
        self.fits |= found


# --- moves ----------------------------------------------------------------------------------------


def refused_upload(desk: Desk) -> None:
    desk.go("load")
    path = desk.folder / "junk.csv"
    path.write_bytes(b"\x00\x01not a table")
    desk.page.set_input_files("#files", [path])
    assert "junk.csv" in desk.error()


def refused_joint(desk: Desk) -> None:
    desk.go("load")
    path = desk.folder / "junk.toml"
    path.write_text("[joint]\ngear_ratio = 'many'\n", encoding="utf-8")
    desk.page.set_input_files("#files", [path])
    assert "gear_ratio" in desk.error()


def renamed_joint(desk: Desk) -> None:
    desk.go("model")
    desk.page.fill("#name", f"joint {random.random():.6f}")
    desk.page.click("#save")
    desk.idle()
    assert desk.page.evaluate("app.state.steps.length"), "a name is no input of the fit"


def other_role_and_back(desk: Desk) -> None:
    desk.go("load")
    select = "select[aria-label='Role of held_out.npz']"
    desk.page.select_option(select, "train")
    desk.page.wait_for_function("() => !app.state.steps.length", timeout=LONGEST)
    desk.idle()
    desk.keep()
    desk.page.select_option(select, "held_out")
    desk.page.wait_for_function("() => app.state.steps.length", timeout=LONGEST)


def record_removed_and_given_again(desk: Desk) -> None:
    desk.go("load")
    desk.page.click("button[aria-label='Remove held_out.npz']")
    desk.page.wait_for_function("() => app.state.files.length === 1", timeout=LONGEST)
    desk.keep()
    desk.page.set_input_files("#files", [ROOT / "workbench" / "demo" / "held_out.npz"])
    desk.page.wait_for_function(
        "() => app.state.files.length === 2 && app.state.files.every((f) => f.status === 'ready')",
        timeout=LONGEST,
    )
    desk.idle()
    desk.run("fit")


def reloaded(desk: Desk) -> None:
    desk.page.reload()
    desk.idle()


def reloaded_at_work(desk: Desk) -> None:
    desk.page.evaluate("run('add', { label: 'cubic_viscous@motor' })")
    desk.page.reload()
    desk.idle()


def back_and_forward(desk: Desk) -> None:
    for view in ("compare", "ledger", "load"):
        desk.go(view)
    for move in (desk.page.go_back, desk.page.go_back, desk.page.go_forward):
        move()
        desk.idle()


def back_at_work(desk: Desk) -> None:
    desk.go("ledger")
    desk.page.evaluate("run('diagnose', {}, 'diagnose')")
    desk.page.go_back()
    desk.idle()


def undone_and_another(desk: Desk) -> None:
    desk.run("undo") if desk.page.is_enabled("#undo") else None
    desk.add("cubic_viscous@motor")


def undone_and_redone(desk: Desk) -> None:
    if desk.page.is_enabled("#undo"):
        desk.page.click("#undo")
        desk.idle()
        desk.page.click("#redo")


def fifty_clicks(desk: Desk) -> None:
    desk.go("ledger")
    desk.page.evaluate(
        "() => { const b = document.querySelector('#add-by-hand'); "
        "for (let k = 0; k < 50; k++) b.click(); }"
    )


def second_tab_adds(desk: Desk) -> None:
    other = desk.context.new_page()
    other.goto(f"{desk.server.address}#session={desk.id}")
    desk.idle(other)
    steps = desk.page.evaluate("app.state.revision")
    other.evaluate("run('undo')") if other.is_enabled("#undo") else None
    desk.idle(other)
    other.evaluate("run('add', { label: 'quadratic_drag@motor' })")
    desk.page.wait_for_function("n => app.state.revision > n", arg=steps, timeout=LONGEST)
    desk.idle(other)
    other.close()


def two_tabs_at_once(desk: Desk) -> None:
    other = desk.context.new_page()
    other.goto(f"{desk.server.address}#session={desk.id}")
    desk.idle(other)
    for page in (desk.page, other):
        page.evaluate("() => { run('diagnose', {}, 'diagnose'); }")
    desk.idle(other)
    other.close()


def cancelled(desk: Desk) -> None:
    desk.page.evaluate("() => { run('improve', {}, 'ledger'); }")
    desk.page.wait_for_selector("#job:not([hidden])", timeout=LONGEST)
    desk.page.click("#cancel")
    assert "cancelled; nothing was changed" in desk.error()


def input_changed_at_work(desk: Desk) -> None:
    desk.page.evaluate("() => { run('diagnose', {}, 'diagnose'); }")
    desk.page.wait_for_function("() => app.state.job", timeout=LONGEST)
    told = desk.page.evaluate(
        "() => post(`/file/${app.state.files[0].id}`, { role: 'held_out' })"
        ".then(() => '', (e) => e.message)"
    )
    assert "busy" in told


def held_and_released(desk: Desk) -> None:
    desk.go("parameters")
    for _ in range(2):
        before = desk.page.evaluate("app.state.joint_text")
        desk.page.click("#hold-motor_coulomb", timeout=LONGEST)
        desk.page.wait_for_function(
            "was => app.state.joint_text !== was", arg=before, timeout=LONGEST
        )
        desk.idle()


def noted(desk: Desk) -> None:
    step = desk.page.evaluate("app.state.steps[0].id")
    note = {"of": step, "name": "<b>mine</b>", "note": "'; drop table\n\x00" + "x" * 9000}
    desk.page.evaluate("b => post('/tree', b).then(refresh)", note)


def no_law(desk: Desk) -> None:
    body = {"law": "__import__('os')", "on": "motor", "parameters": ""}
    desk.page.evaluate("b => { run('law', b); }", body)
    assert desk.error()


def another_fit_opened(desk: Desk) -> None:
    branches = desk.page.evaluate("get('/view/tree').then((t) => t.branches)")
    fitted = [b for b in branches if b["steps"]]
    branch = random.choice(fitted)
    step = random.choice(branch["steps"])
    body = {"open": branch["id"], "step": step["id"]}
    desk.page.evaluate("b => post('/tree', b).then(refresh)", body)


def killed_at_a_diagnosis(desk: Desk) -> None:
    """What was running when the server was killed is taken up again."""
    desk.page.evaluate("() => { run('diagnose', {}, 'diagnose'); }")
    desk.page.wait_for_function("() => app.state.job && app.state.job.share > 0", timeout=LONGEST)
    desk.server.kill()
    desk.server.start()
    desk.page.goto("about:blank")
    desk.page.goto(f"{desk.server.address}#session={desk.id}")
    desk.page.wait_for_function(
        "() => app.state && (app.state.job ? app.state.job.action === 'diagnose' "
        ": Boolean(app.state.diagnosis))",
        timeout=LONGEST,
    )
    desk.page.wait_for_function("() => app.state.diagnosis", timeout=LONGEST)


def killed_while_adding(desk: Desk) -> None:
    desk.page.evaluate("() => { run('add', { label: 'hysteresis' }); }")
    desk.server.kill()
    desk.server.start()
    desk.again()


def dead_server(desk: Desk) -> None:
    """Clicks on a page whose server has gone are answered by a sentence."""
    desk.go("ledger")
    desk.server.kill()
    desk.page.click("#diagnose")
    assert "the server does not answer; is it still running?" in desk.error()
    desk.server.start()
    desk.again()


def worker_killed(desk: Desk) -> None:
    """The process of the session, not the server."""
    desk.page.evaluate("() => { run('improve', {}, 'ledger'); }")
    desk.page.wait_for_function("() => app.state.job && app.state.job.share > 0", timeout=LONGEST)
    rows = subprocess.run(
        ["ps", "-eo", "pid=,ppid=,pgid="], capture_output=True, text=True, check=True
    ).stdout.split("\n")
    table = [[int(v) for v in row.split()] for row in rows if row.strip()]
    family = {desk.server.process.pid}
    for _ in range(4):
        family |= {pid for pid, parent, _ in table if parent in family}
    for pid, _, group in table:
        if pid in family and pid == group and pid != desk.server.process.pid:
            os.kill(pid, signal.SIGKILL)
    assert "every fit is kept" in desk.error()


def full_disk(desk: Desk) -> None:
    desk.go("load")
    path = desk.folder / "more.csv"
    path.write_text("time_s,motor_position_rad\n0,1\n" * 2000, encoding="utf-8")
    with desk.server.full_disk():
        desk.page.set_input_files("#files", [path])
        assert desk.error()
        desk.page.evaluate("() => { run('add', { label: 'cubic_viscous@motor' }); }")
        desk.page.wait_for_function(
            "() => !app.state.job && !app.doing.length && !$('error').hidden", timeout=LONGEST
        )
    desk.again()


def colours_and_width(desk: Desk) -> None:
    desk.page.click("#theme")
    desk.page.set_viewport_size({"width": 375, "height": 700})
    desk.idle()
    desk.page.set_viewport_size({"width": 1280, "height": 860})


def wrong_session(desk: Desk) -> None:
    desk.page.goto("about:blank")
    desk.page.goto(f"{desk.server.address}#session={'0' * 32}")
    assert "session" in desk.error()
    desk.again()


def tab_closed_at_work(desk: Desk) -> None:
    desk.page.evaluate("() => { run('diagnose', {}, 'diagnose'); }")
    desk.page.close()
    desk.page = desk.context.new_page()
    desk.again()


def wrong_files_at_once(desk: Desk) -> None:
    """What a clumsy hand drops: another program's file, an empty one, half of one, a huge name."""
    desk.go("load")
    half = (ROOT / "workbench" / "demo" / "held_out.npz").read_bytes()[:9000]
    files = {"manual.mat": b"%PDF-1.4" * 99, "empty.csv": b"", "half.npz": half}
    files |= {"n" * 300 + ".mat": b"x", "größe 测量.toml": b"[joint"}
    given = [{"name": n, "mimeType": "a/b", "buffer": b} for n, b in files.items()]
    desk.page.set_input_files("#files", given)
    assert desk.error()
    desk.idle()
    assert len(desk.page.evaluate("app.state.files")) == 2


def renamed_at_work(desk: Desk) -> None:
    """The new name waits for the end of the work."""
    desk.go("model")
    desk.page.evaluate("() => { run('diagnose', {}); }")
    desk.page.fill("#name", 'während 😀 "x" \\ \u202e')
    desk.page.click("#save")
    desk.idle()
    assert "während" in desk.page.evaluate("app.state.joint_text")
    assert desk.page.evaluate("app.state.steps.length")


def undone_over_a_branch_by_keys(desk: Desk) -> None:
    desk.go("load")
    before = desk.page.evaluate("app.state.steps.map((s) => s.id)")
    desk.page.select_option("select[aria-label='Role of held_out.npz']", "train")
    desk.page.wait_for_function("() => !app.state.steps.length", timeout=LONGEST)
    desk.idle()
    desk.page.click("h1")
    desk.page.keyboard.press("Control+z")
    desk.page.wait_for_function("() => app.state.steps.length", timeout=LONGEST)
    desk.idle()
    assert desk.page.evaluate("app.state.steps.map((s) => s.id)") == before


def folder_moved_away_and_back(desk: Desk) -> None:
    folder = desk.server.root / desk.id
    away = folder.with_name("elsewhere")
    folder.rename(away)
    desk.add("cubic_viscous@motor")
    assert "put it back where it was" in desk.error()
    away.rename(folder)
    desk.again()


def begun_and_left_for_another_session(desk: Desk) -> None:
    """The work goes on, and Back leads to it."""
    desk.go("ledger")
    desk.page.evaluate("() => { run('diagnose', {}, 'diagnose'); }")
    desk.page.click("#fresh")
    desk.page.wait_for_function("() => app.state && !app.state.files.length", timeout=LONGEST)
    desk.page.go_back()
    desk.page.wait_for_function("id => app.state && app.id === id", arg=desk.id, timeout=LONGEST)
    desk.page.wait_for_function("() => app.state.diagnosis", timeout=LONGEST)


MOVES: Final[tuple[Callable[[Desk], None], ...]] = (
    refused_upload,
    refused_joint,
    renamed_joint,
    other_role_and_back,
    killed_at_a_diagnosis,
    reloaded,
    back_and_forward,
    undone_and_redone,
    fifty_clicks,
    full_disk,
    cancelled,
    input_changed_at_work,
    dead_server,
    second_tab_adds,
    noted,
    no_law,
    another_fit_opened,
    wrong_session,
    record_removed_and_given_again,
    reloaded_at_work,
    back_at_work,
    undone_and_another,
    two_tabs_at_once,
    held_and_released,
    killed_while_adding,
    worker_killed,
    colours_and_width,
    tab_closed_at_work,
    wrong_files_at_once,
    renamed_at_work,
    undone_over_a_branch_by_keys,
    folder_moved_away_and_back,
    begun_and_left_for_another_session,
)


def made(root: Path, moves: list[Callable[[Desk], None]], say: Callable[[str], None]) -> int:
    """Make the moves on a new session; the number of fits that stand at the end."""
    (root / "sessions").mkdir()
    server = Server(root / "sessions")
    try:
        with launched() as chromium:
            context = context_of(chromium, viewport={"width": 1280, "height": 860})
            desk = Desk(server, context, root)
            for move in moves:
                began = time.perf_counter()
                desk.page.evaluate("() => clearError()")
                move(desk)
                desk.idle()
                if not desk.page.evaluate("app.state.steps.length"):
                    desk.run("fit")
                desk.keep()
                took, count = time.perf_counter() - began, len(set(desk.fits.values()))
                say(f"{move.__name__}: {count} fits ({took:.1f} s)")
            return len(set(desk.fits.values()))
    finally:
        server.kill()


def main() -> int:
    """As many moves as asked for, each kind once before one comes again."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--moves", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], help="these moves, in this order")
    given = parser.parse_args()
    random.seed(given.seed)
    known = [m for m in MOVES if not given.only or m.__name__ in given.only]
    moves = [m for name in given.only for m in known if m.__name__ == name]
    while len(moves) < given.moves and not given.only:
        moves += random.sample(known, len(known))
    moves = moves if given.only else moves[: given.moves]
    with tempfile.TemporaryDirectory() as place:
        kept = made(Path(place), moves, lambda text: print(text, flush=True))
    print(f"{len(moves)} moves: no fit lost, {kept} stand")
    return 0


if __name__ == "__main__":
    sys.exit(main())
