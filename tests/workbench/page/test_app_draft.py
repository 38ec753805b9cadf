"""What is edited on the Model page and not saved yet, in Debian's Chromium: nothing that happens in
another tab takes it away, and it is saved over nobody's work without a word.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.workbench.chromium import context_of, launched, needs_chromium
from tests.workbench.page.test_app_clumsy import another_program
from tests.workbench.served import serving

AXE = os.environ.get("IRJ_AXE", "")

pytestmark = needs_chromium


@dataclass
class Tabs:
    """Two tabs on one session, both on the Model page."""

    mine: Any
    other: Any
    text: str


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tabs]:
    with serving(tmp_path_factory.mktemp("sessions")) as there, launched() as chromium:
        context = context_of(chromium, viewport={"width": 1280, "height": 860})
        mine, other = context.new_page(), context.new_page()
        mine.goto(there.address)
        mine.click("#demo")
        mine.wait_for_selector("#fit", timeout=60_000)
        session = mine.evaluate("app.id")
        other.goto(f"{there.address}#session={session}&view=model")
        yield Tabs(mine, other, mine.evaluate("app.state.joint_text"))


@pytest.fixture
def tabs(opened: Tabs) -> Tabs:
    """Both as a user opens them, with the joint of the demo."""
    opened.other.evaluate("text => post('/joint', { text }).then(refresh)", opened.text)
    for page in (opened.mine, opened.other):
        page.wait_for_function("() => app.state")
        page.evaluate("() => refresh()")
        page.evaluate("() => { delete app.drafts.joint; app.view = null; open('model'); }")
        drawn(page)
        if page.is_visible("#error"):
            page.click("#error-close")
    return opened


def drawn(page: Any) -> None:
    """The Model page as the state has it; nothing is asked for and nothing runs."""
    page.wait_for_function(
        "() => document.querySelector('#main').dataset.view === 'model' && !busy() && !app.asking"
        " && document.querySelector('#main').dataset.revision === String(app.state.revision)",
        timeout=120_000,
    )


def joint(page: Any) -> dict[str, Any]:
    """The joint as the server has it."""
    return tomllib.loads(page.evaluate("get('/view/joint')")["text"])["joint"]


def unfold(page: Any) -> None:
    page.evaluate("document.querySelector('#joint-text').closest('details').open = true")


def saved(page: Any, **fields: str) -> None:
    """Change fields and save them."""
    for name, value in fields.items():
        page.fill(f"#{name}", value)
    page.click("#save")
    page.wait_for_function("() => !app.drafts.joint || !app.drafts.joint.saving")
    drawn(page)


def findings(page: Any) -> list[str]:
    """Findings of axe-core, where IRJ_AXE names its file."""
    if not AXE:
        return []
    page.evaluate(Path(AXE).read_text(encoding="utf-8"))
    return [v["id"] for v in page.evaluate("() => axe.run(document)")["violations"]]


def test_a_draft_of_the_joint_file_stays_where_another_tab_saves(tabs: Tabs) -> None:
    mine, other = tabs.mine, tabs.other
    unfold(mine)
    draft = mine.input_value("#joint-text") + "\n# half of a thought"
    mine.fill("#joint-text", draft)
    mine.evaluate("document.querySelector('#joint-text').setSelectionRange(3, 7)")
    saved(other, name="of the other tab")
    mine.wait_for_selector("#joint-moved")
    assert mine.input_value("#joint-text") == draft
    assert mine.is_visible("#joint-text")
    at = "[document.activeElement.id, document.activeElement.selectionStart]"
    assert mine.evaluate(at) == ["joint-text", 3]
    assert "changed elsewhere" in mine.inner_text("#joint-moved")
    assert "of the other tab" in mine.text_content("#joint-moved pre")
    assert findings(mine) == []

    mine.click("#save")
    mine.wait_for_selector("#error:not([hidden])")
    assert "the joint was changed elsewhere" in mine.inner_text("#error-text")
    assert joint(mine)["name"] == "of the other tab", "nothing is saved over it before a choice"
    assert mine.input_value("#joint-text") == draft

    mine.click("#joint-keep")
    mine.wait_for_selector("#joint-moved", state="detached")
    assert mine.input_value("#joint-text") == draft
    saved(mine)
    assert mine.evaluate("get('/view/joint')")["text"] == draft
    assert mine.locator("#joint-moved").count() == 0, "what was saved here was changed here"


def test_the_joint_of_the_other_tab_is_taken_where_that_is_chosen(tabs: Tabs) -> None:
    mine, other = tabs.mine, tabs.other
    mine.fill("#name", "mine")
    mine.select_option("#known-pick", "stiffness")
    mine.click("#known-add")
    saved(other, name="theirs")
    mine.wait_for_selector("#joint-moved")
    assert mine.input_value("#name") == "mine"
    assert mine.is_visible("#known-stiffness-value")
    mine.click("#joint-take")
    mine.wait_for_selector("#joint-moved", state="detached")
    assert mine.input_value("#name") == "theirs"
    assert mine.locator("#known-stiffness-value").count() == 0
    assert joint(mine)["name"] == "theirs"


def test_fields_that_are_kept_go_with_those_of_the_other_tab(tabs: Tabs) -> None:
    mine, other = tabs.mine, tabs.other
    mine.fill("#name", "both")
    saved(other, gear_ratio="-123")
    mine.wait_for_selector("#joint-moved")
    mine.click("#joint-keep")
    mine.wait_for_selector("#joint-moved", state="detached")
    saved(mine)
    assert (joint(mine)["name"], joint(mine)["gear_ratio"]) == ("both", -123.0)


@pytest.mark.parametrize("kept", ["fields", "text"])
def test_of_fields_and_text_that_were_both_edited_the_user_says_which_is_saved(
    tabs: Tabs, kept: str
) -> None:
    """Each is the whole joint: the text was saved and the fields went, without a word."""
    mine = tabs.mine
    mine.fill("#name", "of the fields")
    unfold(mine)
    assert mine.is_hidden("#joint-both"), "one of them is no question"
    text = mine.input_value("#joint-text")
    mine.fill("#joint-text", text.replace("-160", "-161") + "\n# of the text")
    mine.wait_for_selector("#joint-both")
    assert findings(mine) == []

    mine.click("#save")
    mine.wait_for_selector("#error:not([hidden])")
    assert "both edited" in mine.inner_text("#error-text")
    assert mine.evaluate("get('/view/joint')")["text"] == tabs.text, "nothing is saved before"
    assert mine.input_value("#name") == "of the fields"
    assert mine.input_value("#joint-text").endswith("# of the text")

    mine.click(f"#both-{kept}")
    mine.wait_for_selector("#joint-both", state="hidden")
    saved(mine)
    found = joint(mine)
    if kept == "fields":
        assert (found["name"], found["gear_ratio"]) == ("of the fields", -160.0)
    else:
        assert (found["name"], found["gear_ratio"]) == ("demo joint", -161.0)
        assert mine.evaluate("get('/view/joint')")["text"].endswith("# of the text")
    assert mine.input_value("#name") == found["name"]


def test_text_that_is_as_it_was_again_is_no_edit(tabs: Tabs) -> None:
    mine = tabs.mine
    unfold(mine)
    text = mine.input_value("#joint-text")
    mine.fill("#joint-text", text + "\n# a thought")
    mine.fill("#name", "of the fields")
    mine.wait_for_selector("#joint-both")
    mine.fill("#joint-text", text)
    mine.wait_for_selector("#joint-both", state="hidden")
    saved(mine)
    assert joint(mine)["name"] == "of the fields"


def test_a_tab_that_has_not_heard_of_it_yet_saves_over_nothing(tabs: Tabs) -> None:
    mine, other = tabs.mine, tabs.other
    mine.evaluate("() => { app.source.close(); app.source = null; }")
    mine.fill("#name", "unaware")
    saved(other, name="first")
    assert mine.locator("#joint-moved").count() == 0
    mine.click("#save")
    mine.wait_for_selector("#joint-moved")
    assert joint(mine)["name"] == "first"
    assert mine.input_value("#name") == "unaware"
    mine.evaluate("listen()")


@pytest.mark.slow
def test_a_draft_stays_where_the_work_of_another_tab_ends(tabs: Tabs) -> None:
    """A fit changes the state, and the view is drawn again; the joint is the one that it was."""
    mine, other = tabs.mine, tabs.other
    unfold(mine)
    draft = mine.input_value("#joint-text") + "\n# while it fits"
    mine.fill("#joint-text", draft)
    before = mine.evaluate("app.state.revision")
    other.evaluate("() => { run('fit', {}); }")
    mine.wait_for_function(
        "r => app.state.revision > r && !app.state.job && app.state.steps.length",
        arg=before,
        timeout=60_000,
    )
    drawn(mine)
    assert mine.input_value("#joint-text") == draft
    assert mine.is_visible("#joint-text")
    assert mine.locator("#joint-moved").count() == 0


def test_what_is_typed_while_it_is_saved_is_no_part_of_it_and_stays(tabs: Tabs) -> None:
    """The news of the own change come before the answer: they are no change elsewhere."""
    mine = tabs.mine
    mine.evaluate(
        """() => { const fetched = window.fetch; window.fetch = async (path, options) => {
          const answer = await fetched(path, options);
          if (path.endsWith('/joint') && options.method === 'POST')
            await new Promise((go) => { window.go = go; });
          return answer; }; }"""
    )
    revision = mine.evaluate("app.state.revision")
    mine.fill("#name", "saved")
    mine.click("#save")
    mine.wait_for_function("r => window.go && app.state.revision > r", arg=revision)
    mine.wait_for_function(
        "() => document.querySelector('#main').dataset.revision === String(app.state.revision)"
    )
    assert mine.locator("#joint-moved").count() == 0
    mine.fill("#gear_ratio", "-77")
    mine.evaluate("() => window.go()")
    mine.wait_for_function("() => !app.drafts.joint.saving")
    drawn(mine)
    assert joint(mine)["name"] == "saved"
    assert mine.input_value("#gear_ratio") == "-77"
    assert mine.locator("#joint-moved").count() == 0
    mine.reload()


def test_a_draft_stays_while_another_program_answers_for_the_server(
    opened: Tabs, tmp_path: Path
) -> None:
    """The session comes back where its server does, and with it what was being edited."""
    page = opened.mine.context.browser.new_context().new_page()
    with serving(tmp_path) as there:
        port = there.port
        page.goto(there.address)
        page.click("#demo")
        page.wait_for_selector("#fit", timeout=60_000)
        page.click("#nav-model")
        drawn(page)
        page.fill("#name", "half a name")
    with another_program(port):
        page.wait_for_selector("#gone-again", timeout=30_000)
    with serving(tmp_path, port):
        page.click("#gone-again")
        page.wait_for_function("() => app.state && !busy()")
        page.click("#nav-model")
        drawn(page)
        assert page.input_value("#name") == "half a name"
        page.click("#fresh")
        page.wait_for_selector("#demo")
        page.click("#nav-model")
        drawn(page)
        assert page.input_value("#name") == "joint", "another session begins without it"
    page.context.close()


def test_a_note_and_a_value_that_are_typed_stay_where_another_tab_works(tabs: Tabs) -> None:
    """On the tree of fits, and where the diagnosis asks for what is known."""
    mine, other = tabs.mine, tabs.other
    mine.evaluate("() => { run('fit', {}, () => run('diagnose', {}, 'ledger')); }")
    mine.wait_for_function("() => app.state.diagnosis && !busy()", timeout=120_000)
    step = mine.evaluate("app.state.steps[0].id")
    mine.evaluate("open('ledger')")
    mine.click(f"#fit-{step}-note")
    mine.fill(f"#fit-{step}-text", "half of a note")
    redrawn(mine, other)
    assert mine.input_value(f"#fit-{step}-text") == "half of a note"
    mine.fill(f"#fit-{step}-name", "first")
    mine.press(f"#fit-{step}-name", "Enter")
    mine.wait_for_selector(f"#fit-{step}-name", state="detached")
    assert mine.evaluate("app.state.remarks") == {step: {"name": "first", "note": "half of a note"}}

    mine.evaluate("open('diagnose')")
    field = "#ask-extra_inertia-motor_inertia-value"
    mine.wait_for_selector(field, state="attached")
    unfolded = "document.querySelectorAll('details').forEach((d) => { d.open = true; })"
    mine.evaluate(unfolded)
    mine.fill(field, "4.5")
    redrawn(mine, other)
    mine.evaluate(unfolded)
    assert mine.input_value(field) == "4.5"


def redrawn(mine: Any, other: Any) -> None:
    """The other tab gives the session another name: a view of this one is drawn anew."""
    before = mine.evaluate("app.state.revision")
    other.evaluate("n => post('/tree', { session: `session ${n}` })", before)
    mine.wait_for_function(
        "r => app.state.revision > r && !busy() && !app.asking && "
        "document.querySelector('#main').dataset.revision === String(app.state.revision)",
        arg=before,
    )
    mine.wait_for_function("() => !document.querySelector('.tree:empty')")
