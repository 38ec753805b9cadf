"""Long work of the page in a process of its own: killed, cancelled, beside another session's, and
with nothing but its own session's laws.
"""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette")

from casadi_models import EFFECTS
from identification import Joint, improve
from tests.smooth_laws import record
from workbench.page import verbs
from workbench.page import views as app_views
from workbench.page.demo import demo_files
from workbench.page.input import set_joint, start_demo
from workbench.page.jobs import child, process
from workbench.page.jobs.child import Done
from workbench.page.jobs.doing import ledger
from workbench.page.live import Live
from workbench.page.session import Session, State, Store
from workbench.page.work import Task, Worker

ROOT = Path(__file__).parents[3]
LAW = {
    "law": "a*exp(-(v/b)^2)*tanh(v/c)",
    "on": "motor",
    "parameters": "a=0..50 N.m, b=0.01..3 rad/s, c=0.001..0.1 rad/s",
}
posix = pytest.mark.skipif(not hasattr(os, "killpg"), reason="signals and groups of processes")


def until(condition: Callable[[], Any], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.005)


def wait(live: Live) -> None:
    until(lambda: live.job is None, 120)


def run(live: Live, action: str, **body: Any) -> None:
    verbs.run(live, action, body)
    wait(live)
    assert live.error is None, live.error


def opened(folder: Path) -> Live:
    live = Live(Store(folder).create())
    with live.library():
        start_demo(live)
    return live


def begun(live: Live, action: str, says: str = "") -> int:
    """Start an action and wait until its process is at work; the number of that process."""
    verbs.run(live, action, {})
    until(lambda: live.job is None or (live.job.share > 0 and says in live.job.text))
    assert live.job is not None, live.error
    assert live.helper.pid is not None
    return live.helper.pid


def group(pid: int) -> list[str]:
    """Living processes of a group."""
    lines = subprocess.run(
        ["ps", "-eo", "pgid=,stat=,pid="], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    rows = [line.split() for line in lines]
    return [r[2] for r in rows if r[0] == str(pid) and not r[1].startswith("Z")]


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Live:
    """The demo with its start model fitted."""
    made = opened(tmp_path_factory.mktemp("sessions"))
    run(made, "fit")
    return made


@posix
def test_a_killed_process_is_one_sentence_and_every_fit_is_kept(live: Live) -> None:
    before = live.state
    pid = begun(live, "improve")
    os.kill(pid, signal.SIGKILL)
    wait(live)
    assert live.error is not None
    assert "improve: the process that did the work was ended (SIGKILL)" in live.error
    assert "every fit is kept" in live.error
    assert "\n" not in live.error
    assert live.state == before == Session(live.session.folder).load()
    assert live.session.running() is None
    run(live, "diagnose")
    assert live.helper.pid != pid
    assert live.state.steps == before.steps


def test_the_note_of_a_job_goes_before_the_job(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever sees that no job is left, finds no note of one in the folder."""
    left: list[bool] = []
    end = Session.end

    def watched(session: Session) -> None:
        left.append(live.job is None)
        end(session)

    monkeypatch.setattr(Session, "end", watched)
    run(live, "diagnose")
    assert left == [False]


def _ended_in_one_line(live: Live, before: Any) -> str:
    wait_for_end = time.monotonic() + 20
    while live.job is not None:
        assert time.monotonic() < wait_for_end, "the job never ended"
        time.sleep(0.005)
    assert live.error is not None
    assert "\n" not in live.error
    assert live.state == before
    assert live.session.running() is None
    return live.error


class _Exit:
    """Something that ends a thread where it is called."""

    def __call__(self, _: Any) -> Any:
        raise SystemExit(3)


def _no_number(state: Any) -> Any:
    return replace(state, left_open={"x": float("nan")})


def _broken(_: Any) -> Any:
    raise KeyError("lost")


def _memory(_: Any) -> Any:
    raise MemoryError


def _full(_: Any) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_no_number, "internal error (ValueError"),
        (_broken, "internal error (KeyError"),
        (_memory, "the memory ran out"),
        (_full, "free some space"),
        (_Exit(), "internal error (SystemExit: 3)"),
    ],
)
@pytest.mark.parametrize("when", ["in the work", "at its end"])
def test_whatever_dies_in_a_job_it_ends_in_one_line(
    live: Live, change: Any, says: str, when: str
) -> None:
    """In the thread of the session, while the change is made and while it is kept; a job that did
    not end would keep the page busy for ever.
    """
    before = live.state
    at_once = when == "in the work" and change is not _no_number
    live.start("own", "own", {}, here=(lambda p: change(None)) if at_once else (lambda p: change))
    assert says in _ended_in_one_line(live, before)
    live.start("own", "own", {}, here=lambda p: lambda s: s)
    wait(live)
    assert live.error is None, "the thread takes the next job"


@pytest.mark.parametrize(
    ("fails", "says"),
    [
        (OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)), os.strerror(errno.EAGAIN)),
        (EOFError(), "the system ended what starts it"),
    ],
    ids=["no process left", "the server of processes was killed"],
)
def test_where_no_process_can_be_started_the_job_says_so_and_the_next_one_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: Exception, says: str
) -> None:
    live = opened(tmp_path)
    before = live.state

    def refused(self: Any) -> None:
        raise fails

    with monkeypatch.context() as patched:
        patched.setattr(type(process._context().Process()), "start", refused)
        verbs.run(live, "fit", {})
        said = _ended_in_one_line(live, before)
    assert f"a process for the work cannot be started ({says})" in said
    assert "internal" not in said
    run(live, "fit")
    assert live.state.steps


def test_where_no_thread_can_be_started_the_job_ends(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = live.state

    def none_left(self: Any) -> None:
        raise RuntimeError("can't start new thread")

    live.worker = Worker("own")
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        live.start("own", "own", {}, here=lambda p: lambda s: s)
    assert "cannot be started (can't start new thread)" in _ended_in_one_line(live, before)
    live.start("own", "own", {}, here=lambda p: lambda s: s)
    wait(live)
    assert live.error is None


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (lambda: Done(lambda s: s, None, (), 0.0), "internal error ("),
        (lambda: _full(None), "own: the disk is full (No space left on device)"),
        (lambda: _memory(None), "own: the memory ran out"),
    ],
)
def test_an_answer_that_cannot_be_sent_or_made_is_a_refusal(
    answer: Callable[[], Done], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process of a session goes on: its prepared records are not lost with one answer."""
    here, there = multiprocessing.Pipe()
    monkeypatch.setattr(child, "_done", lambda *a: answer())
    serving = threading.Thread(target=_served, args=(there, tmp_path), daemon=True)
    monkeypatch.setattr(child.signal, "signal", lambda *a: None)
    monkeypatch.setattr(child.os, "setsid", lambda: None)
    monkeypatch.setattr(child, "FIRST_TO_GO", "x")  # refused: this process is the test's own
    serving.start()
    for _ in range(2):
        here.send(child.Ask("own", {}, State()))
        assert here.poll(20), "no answer"
        said = here.recv()
        assert isinstance(said, child.Refused)
        assert says in said.sentence
    here.close()
    serving.join(10)
    assert not serving.is_alive()


def _served(pipe: Any, folder: Path) -> None:
    child.main(pipe, folder, [])


@posix
def test_cancelling_a_build_ends_its_process_and_the_compiler(live: Live) -> None:
    before = live.state
    pid = begun(live, "plant", "building")
    until(lambda: len(group(pid)) > 1 or live.job is None)
    assert live.cancel()
    wait(live)
    assert live.error == "plant: cancelled; nothing was changed"
    until(lambda: not group(pid), 10)
    assert live.state == before
    assert not live.cancel()


def test_the_server_stands_on_the_very_model_that_the_process_fitted(live: Live) -> None:
    run(live, "fit")
    run(live, "diagnose")
    verbs.wait_settled(live)
    step, solution = live.state.steps[-1], live.analysis().solution
    assert solution is not None
    assert dict(solution.values) == dict(step.values)
    assert any(solution.stderr.values())
    assert live.analysis().stands_on(step)
    label = (live.state.diagnosis or {})["claim"]["label"]
    until(lambda: label in live.analysis().ahead)
    _, ahead = live.analysis().ahead[label]
    run(live, "add", label=label)
    assert live.analysis().current.values == ahead.values
    run(live, "undo")
    assert live.analysis().solution is solution


def test_work_that_fits_nothing_leaves_the_fitted_model_known(live: Live) -> None:
    """A server that prepared its records more slowly than the process diagnosed fitted again, and
    stood beside the step by some of its last digits.
    """
    run(live, "fit")
    run(live, "diagnose")
    live.forget()
    assert live.analysis().current.values == live.state.steps[-1].values


SERVING = """
import sys, time
from pathlib import Path
from workbench.page import verbs
from workbench.page.input import start_demo
from workbench.page.live import Live
from workbench.page.session import Store
if __name__ == '__main__':
    root, action, says = sys.argv[1:]
    live = Live(Store(Path(root)).create())
    start_demo(live)
    if action == 'plant':
        verbs.run(live, 'fit', {})
        while live.job: time.sleep(0.005)
    verbs.run(live, action, {})
    while not live.helper.pid or live.job.share <= 0.02 or says not in live.job.text:
        time.sleep(0.005)
    print(live.session.id, live.helper.pid, flush=True)
    sys.stdin.readline()
"""
"""Another program that serves a session; it ends by itself at a line of input."""


def serving(folder: Path, action: str, says: str) -> tuple[subprocess.Popen[str], str, int]:
    script = folder / "serving.py"
    script.write_text(SERVING)
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    process = subprocess.Popen(
        [sys.executable, str(script), str(folder / "sessions"), action, says],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    assert process.stdout is not None
    name, pid = process.stdout.readline().split()
    return process, name, int(pid)


@posix
def test_a_killed_server_takes_its_processes_with_it_and_finds_the_job_again(
    tmp_path: Path,
) -> None:
    server, name, pid = serving(tmp_path, "improve", "")
    server.kill()
    server.communicate()
    until(lambda: not group(pid), 20)
    again = Live(Store(tmp_path / "sessions").open(name))
    assert (again.session.running() or {})["action"] == "improve"
    assert not again.state.steps
    verbs.resume(again)
    assert again.job is not None
    assert (again.session.running() or {})["again"]
    assert again.cancel()
    wait(again)
    assert again.session.running() is None
    again.close()


@posix
def test_a_server_that_ends_in_the_middle_of_a_build_ends_the_build(tmp_path: Path) -> None:
    server, _, pid = serving(tmp_path, "plant", "building")
    until(lambda: len(group(pid)) > 1)
    server.communicate("end\n", timeout=60)
    assert server.returncode == 0
    until(lambda: not group(pid), 20)


@posix
@pytest.mark.parametrize(
    ("number", "answer"),
    [(signal.SIGINT, (130, "irj: interrupted\n")), (signal.SIGTERM, (143, ""))],
)
def test_a_stopped_app_says_at_most_one_line_and_leaves_nothing(
    tmp_path: Path, number: int, answer: tuple[int, str]
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    app = subprocess.Popen(
        [sys.executable, "-m", "workbench", "app", "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={
            **os.environ,
            "PYTHONPATH": paths,
            "TMPDIR": str(temporary),
            "IRJ_SESSIONS": str(tmp_path / "sessions"),
        },
    )
    assert app.stdout is not None
    address = app.stdout.readline().partition("#")[0]
    until(lambda: list(temporary.glob("irj-run-*/pymp-*")))  # other processes can be started
    time.sleep(0.5)
    new = urllib.request.Request(f"{address}api/session", method="POST", headers={"X-IRJ": "1"})
    with urllib.request.urlopen(new) as answered:
        session = json.load(answered)["id"]
    news = urllib.request.urlopen(f"{address}api/session/{session}/events")  # an open page
    assert news.readline().startswith(b"data: ")
    app.send_signal(number)
    _, said = app.communicate(timeout=60)
    news.close()
    assert (app.returncode, said) == answer
    assert list(temporary.iterdir()) == []


def test_a_law_of_one_session_is_in_no_other_and_two_work_at_once(
    live: Live, tmp_path: Path
) -> None:
    """The session beside one with a law of its own gives the answer of `irj improve` in a fresh
    process.
    """
    own, other = live, opened(tmp_path / "sessions")
    if len(own.state.steps) != 1:
        run(own, "fit")
    run(own, "law", **LAW)
    key = own.state.found[own.state.steps[-1].id]["laws"][0]["label"]
    verbs.run(own, "diagnose", {})
    verbs.run(other, "improve", {})
    assert own.job is not None
    assert other.job is not None
    wait(own)
    wait(other)
    assert own.error is None
    assert other.error is None
    with own.library():
        assert key in EFFECTS
        assert key in {r["label"] for r in app_views.VIEWS["library"](own, {})}
    assert key in json.dumps(dict(own.state.diagnosis or {}))
    with other.library():
        assert key not in EFFECTS
        assert key not in {r["label"] for r in app_views.VIEWS["library"](other, {})}
    assert key not in EFFECTS
    story = dict(other.state.improvement or {})
    assert key not in json.dumps(story)
    assert key not in other.state.joint_text
    for file, content in demo_files().items():
        (tmp_path / file).write_bytes(content)
    arguments = "improve --joint joint.toml --held-out held_out.npz --json out.json train.npz"
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    subprocess.run(
        [sys.executable, "-m", "workbench", *arguments.split()],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    fresh = json.loads((tmp_path / "out.json").read_text())
    assert {"verdict", "steps"} <= set(fresh)
    for part in set(fresh) & set(story):
        assert _numbers(story[part]) == _numbers(fresh[part]), part
    other.close()


def _numbers(data: Any) -> Any:
    """JSON with every number to nine digits: the file rounds none, the state is plain JSON."""
    if isinstance(data, dict):
        return {k: _numbers(v) for k, v in data.items()}
    if isinstance(data, list | tuple):
        return [_numbers(v) for v in data]
    return float(f"{data:.9g}") if isinstance(data, float) else data


def test_one_key_is_another_law_in_another_session(tmp_path: Path) -> None:
    """Two joint files may name their laws alike: each session computes with its own."""
    titles = []
    lives = []
    text = demo_files()["joint.toml"].decode()
    for law in ("a*tanh(v/b)", "a*sin(v/b)"):
        live = Live(Store(tmp_path).create())
        own = (
            f'{text}\n[laws]\nseal = {{ law = "{law}", on = ["motor"], '
            'parameters = ["a=0..10 N.m", "b=0.01..1 rad/s"] }\n'
        )
        with live.library():
            set_joint(live, {"text": own, "source": "joint.toml"})
        lives.append(live)
    for live in lives:
        with live.library():
            titles.append(EFFECTS["seal"].title)
    assert titles == ["typed law a*tanh(v/b)", "typed law a*sin(v/b)"]
    assert "seal" not in EFFECTS


def test_a_set_stays_a_set_on_the_ledger_of_the_whole_loop() -> None:
    """An offset and a friction that differs by direction: the step holds one of the two, and says
    both, with the run that tells them apart.
    """
    runs = [record(np.random.default_rng([3, k]), 20.0, lambda q, v: 4 + 0 * q) for k in (0, 1)]
    axis = Joint("axis", model_name="hd1", effects=("viscous", "coulomb"))
    found = improve(runs[0], axis, [runs[1]])
    start, added = ledger(found)
    assert set(added.names) == set(found.claims[0].effects)
    assert {"current_offset", "asymmetric_coulomb"} <= set(added.names)
    assert added.separate_by == found.claims[0].separate_by
    assert start.names == () and start.separate_by is None


def test_the_thread_of_a_session_that_is_closed_ends_with_its_last_task() -> None:
    """It waited ten minutes for a next one, and what it had in memory with it."""
    worker, began, go = Worker("closed"), threading.Event(), threading.Event()
    done: list[str] = []

    def thread() -> threading.Thread | None:
        return next((t for t in threading.enumerate() if t.name == "closed"), None)

    def work() -> None:
        began.set()
        go.wait(30)
        done.append("first")

    worker.submit(Task(work))
    assert began.wait(30)
    first = thread()
    assert first is not None
    worker.close()
    go.set()
    first.join(30)
    assert not first.is_alive()
    assert done == ["first"]
    worker.submit(Task(lambda: done.append("again")))
    worker.close()
    while (again := thread()) is not None:
        again.join(30)
    assert done == ["first", "again"], "what comes afterwards is done all the same"
