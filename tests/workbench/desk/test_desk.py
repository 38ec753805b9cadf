"""What the page keeps: the joint file's tables through the form, fits through every change."""

from __future__ import annotations

import contextlib
import json
import random
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette")

from identification.errors import InputError
from workbench.page.desk import home, tree
from workbench.page.input import change_tree, joint_form, set_joint
from workbench.page.live import Live
from workbench.page.session import FileEntry, State, StepEntry, Store

JOINT = """
[joint]
name = "elbow"
gear_ratio = -160.0
motor_constant = 0.0553
model = "hd1"
effects = ["viscous", "seal"]
virtual_work = false

[known]
link_inertia = { value = 1.5, source = "CAD" }

[columns]
time = { column = "t", unit = "ms" }

[laws.seal]
law = "a*tanh(v/b)"
on = ["motor"]
parameters = ["a=0..10 N.m", "b=0.01..1 rad/s"]

[fitted]
motor_viscous = { value = 2.0, stderr = 0.1 }
"""


@pytest.fixture
def live(tmp_path: Path) -> Live:
    return Live(Store(tmp_path).create())


def form(live: Live, **changed: Any) -> dict[str, Any]:
    shown = joint_form(live.state.joint_text)
    keys = ("name", "kind", "gear_ratio", "motor_constant", "model", "effects")
    return {k: shown.get(k) for k in keys} | changed


def test_the_form_keeps_every_table_it_does_not_show(live: Live) -> None:
    set_joint(live, {"text": JOINT})
    before = tomllib.loads(JOINT)
    set_joint(live, form(live, name="shoulder"))
    after = tomllib.loads(live.state.joint_text)
    assert after["joint"].pop("name") == "shoulder"
    before["joint"].pop("name")
    assert after.pop("joint") == {**before.pop("joint"), "kind": "rotary"}
    assert after == before
    # values fitted to another drive train are no values of this one; the rest stays
    set_joint(live, form(live, gear_ratio="-100"))
    again = tomllib.loads(live.state.joint_text)
    assert again["joint"]["gear_ratio"] == -100
    assert again == {k: v for k, v in after.items() if k != "fitted"} | {"joint": again["joint"]}


def test_a_parameter_that_the_new_model_lacks_takes_only_itself_out_of_known(live: Live) -> None:
    set_joint(live, {"text": JOINT.replace("[columns]", "motor_viscous = 2.0\n\n[columns]")})
    set_joint(live, form(live, effects=["seal"]))
    assert set(tomllib.loads(live.state.joint_text)["known"]) == {"link_inertia"}


def step(label: str | None, error: float, key: str = "") -> StepEntry:
    effects = ("viscous", label) if label else ("viscous",)
    held: Mapping[str, Any] = {"relative_error_percent": error}
    kind = "add" if label else "start"
    return StepEntry(kind, effects, {"x": error}, {}, held, label=label, id=key or f"{label}")


def record(name: str, role: str = "train", status: str = "ready") -> FileEntry:
    return FileEntry(name, f"{name}.csv", f"0-{name}.csv", role, status=status)


def paths(state: State) -> set[tuple[str, ...]]:
    every: tuple[Any, ...] = (state, *state.branches)
    return {tuple(s.id for s in (*b.steps, *b.undone)) for b in every} - {()}


START = State(files=(record("a"), record("b", "held_out")), joint_text=JOINT)


def test_twenty_clumsy_moves_lose_no_fit() -> None:
    """Every step that was ever made stays reachable, whatever is changed in between."""
    state = tree.continued(START, (step(None, 9.0),))
    made = {"None"}

    def add(label: str, error: float) -> None:
        nonlocal state
        state = tree.continued(state, (*state.steps, step(label, error)))
        made.add(label)

    def put(change: Any) -> None:
        nonlocal state
        state = tree.after_input(state, change(state))

    add("coulomb", 5.0)
    state = tree.with_found(state, diagnosis={"claim": None})
    state = tree.undone(state)
    assert state.diagnosis is None
    assert tree.redone(state).diagnosis == {"claim": None}
    add("stribeck", 4.0)  # what undo took back is left: it must stay in the tree
    add("gravity", 3.0)
    put(lambda s: replace(s, joint_text=JOINT.replace("elbow", "knee")))
    assert len(state.steps) == 3
    put(lambda s: replace(s, files=(*s.files, record("c", status="refused"))))
    assert len(state.steps) == 3
    put(lambda s: replace(s, files=(*s.files, record("d"))))
    assert state.steps == ()
    state = tree.continued(state, (step(None, 8.0, "other start"),))
    made.add("other start")
    put(lambda s: replace(s, files=(replace(s.files[0], role="held_out"), *s.files[1:])))
    put(lambda s: replace(s, files=s.files[1:]))
    assert {s for path in paths(state) for s in path} == made
    assert "0-a.csv" in tree.used_files(state)
    for _ in range(2):  # undo leads back over both inputs
        state = tree.undone(state)
    assert state.steps[-1].id == "gravity"
    for _ in range(4):
        state = tree.redone(state)
        assert {s for path in paths(state) for s in path} == made
        state = tree.undone(state)
    # an input that was there before takes its fits up again
    put(lambda s: replace(s, files=(replace(s.files[0], role="held_out"), *s.files[1:])))
    put(lambda s: replace(s, files=(replace(s.files[0], role="train"), *s.files[1:])))
    assert state.steps[-1].id == "gravity"
    assert State.from_json(state.as_json()) == state


def test_notes_and_names_stay_with_their_step_and_a_wrong_one_is_said(live: Live) -> None:
    live.change(lambda s: tree.continued(START, (step(None, 9.0), step("coulomb", 5.0))))
    change_tree(live, {"of": "coulomb", "name": " best ", "note": "smooth"})
    change_tree(live, {"open": live.state.branch, "step": "None"})
    assert live.state.steps[-1].id == "None"
    shown = tree.shown(live.state)[0]["steps"][1]
    assert shown["remark"] == {"name": "best", "note": "smooth"}
    assert shown["undone"]
    for body in ({"of": "nothing", "name": "x"}, {"open": "nowhere"}):
        with pytest.raises(InputError, match="no such"):
            change_tree(live, body)
    found = tree.compared(live.state, "None", "coulomb")
    assert found["only"] == [[], ["coulomb"]]
    assert found["values"] == [{"name": "x", "first": 9.0, "second": 5.0}]


def test_the_quota_refuses_an_upload_and_names_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    session = store.create()
    (session.files / "a.csv").write_bytes(bytes(900_000))
    monkeypatch.setenv("IRJ_QUOTA_GB", "0.001")
    home.refuse_over(store, "b.csv", 50_000)
    with pytest.raises(InputError, match=r"b\.csv: .* more than 1 MB; delete some"):
        home.refuse_over(store, "b.csv", 200_000)
    monkeypatch.setenv("IRJ_QUOTA_GB", "much")
    with pytest.raises(InputError, match="give a number of gigabytes"):
        home.quota()


def test_only_empty_sessions_that_are_old_are_swept(tmp_path: Path) -> None:
    store = Store(tmp_path)
    old, used, young = store.create(), store.create(), store.create()
    for session in (old, used):
        state = session.load()
        (session.folder / "state.json").write_text(
            json.dumps({**state.as_json(), "created": state.created - 2 * home.STALE})
        )
    (used.files / "a.csv").write_text("t\n")
    home.sweep_empty(store)
    left = {folder.name for folder in tmp_path.iterdir()}
    assert left >= {used.id, young.id}
    assert old.id not in left
    home.delete(store, used.id)
    assert not used.folder.exists()
    with pytest.raises(KeyError):
        home.delete(store, used.id)


@pytest.mark.parametrize("seed", range(20))
def test_random_moves_lose_no_fit_no_note_and_no_record(seed: int) -> None:
    draw = random.Random(seed)
    state, made, files = tree.continued(START, (step(None, 9.0, "s0"),)), {"s0"}, {"a", "b"}
    state = tree.remarked(state, "s0", "first", "kept")

    def add(s: State) -> State:
        name = f"s{len(made)}"
        made.add(name)
        new = step(name if s.steps else None, 9.0 / len(made), name)
        return tree.continued(s, (*s.steps, new))

    def again(s: State) -> State:  # Fit once more: the same values under a new identifier
        return tree.continued(s, (replace(s.steps[0], id="new"),)) if s.steps else s

    def role(s: State) -> State:
        k = draw.randrange(len(s.files))
        roles = ["train", "held_out"]
        changed = replace(s.files[k], role=draw.choice(roles))
        return tree.after_input(s, replace(s, files=(*s.files[:k], changed, *s.files[k + 1 :])))

    def upload(s: State) -> State:
        name = f"f{len(files)}"
        files.add(name)
        status = draw.choice(["ready", "refused", "checking"])
        return tree.after_input(s, replace(s, files=(*s.files, record(name, status=status))))

    def drop(s: State) -> State:
        return tree.after_input(s, replace(s, files=s.files[1:])) if len(s.files) > 1 else s

    def rename(s: State) -> State:
        text = JOINT.replace("elbow", f"joint{draw.randrange(9)}")
        return tree.after_input(s, replace(s, joint_text=text))

    def go(s: State) -> State:
        branch = draw.choice(tree.shown(s))
        steps = [t["id"] for t in branch["steps"]]
        return tree.opened(s, branch["id"], draw.choice(steps) if steps else "")

    moves = (add, add, again, role, upload, drop, rename, go, go, tree.undone, tree.redone)
    for _ in range(60):
        with contextlib.suppress(InputError):
            state = draw.choice(moves)(state)
        assert {s for path in paths(state) for s in path} == made
        assert state.remarks["s0"] == {"name": "first", "note": "kept"}
        every: tuple[Any, ...] = (state, *state.branches)
        fitted = {f.stored for b in every if b.steps for f in b.files if f.status == "ready"}
        assert fitted <= tree.used_files(state)
        assert len({b.id for b in state.branches} | {state.branch}) == len(state.branches) + 1
