"""Results in a notebook: what `_repr_html_` gives is whole, safe, readable without styles, and
shown by Jupyter and marimo.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification import compare, diagnose, fit, load_joint, read
from identification.diagnosis.improve import Improvement
from identification.errors import InputError
from identification.frames import frames
from tests.workbench.chromium import context_of, launched, needs_chromium
from workbench.show.notebook import interactive

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "workbench" / "demo"
VOID = {"br", "img", "hr", "col", "input", "meta", "link"}
FORBIDDEN = {"script", "style", "link", "iframe", "object", "form", "html", "body", "head"}
CELLS = (
    f"import sys\nsys.path.insert(0, {str(ROOT)!r})\nfrom identification import compare, "
    "diagnose, fit, load_joint, read",
    f"train = read({str(DEMO / 'train.npz')!r})\ntrain",
    f"first = fit(load_joint({str(DEMO / 'joint.toml')!r}), train)\nfirst",
    f"held_out = read({str(DEMO / 'held_out.npz')!r})\ncompare(first, held_out)",
    "diagnose(first, held_out)",
)
SHOWS = ("link_torque", "motor inertia", "worst window", "stribeck effect")


class Fragment(HTMLParser):
    """Tags, texts and attributes of a fragment; open tags that nobody closes."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another tag"

    def handle_data(self, data: str) -> None:
        self.text += data + " "


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    """Every kind of result, on the demo; its names hold what HTML must not take for a tag."""
    train, held = (
        read(DEMO / "train.npz").renamed("<b>train</b>"),
        read(DEMO / "held_out.npz").renamed("<script>alert(1)</script>"),
    )
    first = fit(load_joint(DEMO / "joint.toml"), train)
    return {
        "record": train,
        "fit": first,
        "comparison": compare(first, held),
        "diagnosis": diagnose(first, held),
    }


@pytest.mark.parametrize("kind", ["record", "fit", "comparison", "diagnosis"])
def test_a_result_is_a_whole_and_harmless_fragment(results: dict[str, Any], kind: str) -> None:
    html = results[kind]._repr_html_()
    found = Fragment(html)
    assert found.open == []
    assert not FORBIDDEN & set(found.tags)
    assert not [a for a, _ in found.attributes if a.startswith("on") or a == "id"], (
        "scripts, and ids that two outputs would share"
    )
    assert not [v for a, v in found.attributes if a in ("src", "href", "xlink:href")], (
        "nothing is fetched"
    )
    assert "<script>" not in html
    assert "<b>" not in html
    assert "NaN" not in found.text


@pytest.mark.parametrize(
    ("kind", "shows"),
    [
        ("record", ("<b>train</b>", "8000 samples", "link_torque")),
        ("fit", ("motor inertia", "kg·m²", "noise")),
        ("comparison", ("<script>alert(1)</script>", "Worst window", "velocity")),
        ("diagnosis", ("Stribeck effect", "held-out", "Not testable")),
    ],
)
def test_a_result_says_what_a_reader_looks_for(
    results: dict[str, Any], kind: str, shows: tuple[str, ...]
) -> None:
    text = " ".join(Fragment(results[kind]._repr_html_()).text.split())
    for word in shows:
        assert word in text


def test_tables_have_headers_and_pictures_have_names(results: dict[str, Any]) -> None:
    for kind, result in results.items():
        found = Fragment(result._repr_html_())
        assert found.tags.count("th") >= 3, kind
        assert found.tags.count("caption") == found.tags.count("table"), kind
        labels = [v for a, v in found.attributes if a == "aria-label"]
        assert found.tags.count("svg") <= len(labels), kind
        assert all(labels), kind
    assert "svg" in Fragment(results["comparison"]._repr_html_()).tags


def test_the_whole_loop_has_a_picture_too() -> None:
    assert callable(Improvement._repr_html_)


def test_frames_hold_what_the_results_say(results: dict[str, Any]) -> None:
    """Each figure stands at its name, and the rows in their order; a result without a table and a
    stranger are told apart.
    """
    pytest.importorskip("pandas")
    train, first, found = (results[k] for k in ("record", "fit", "diagnosis"))
    channels = frames(train)["channels"]
    assert list(channels.columns) == list(train.channels)
    np.testing.assert_array_equal(channels.index, train.time)
    np.testing.assert_array_equal(channels["link_torque"], train["link_torque"])
    parameters = frames(first)["parameters"]
    assert {n: parameters.loc[n, "value"] for n in first.parameters} == {
        n: p["value"] for n, p in first.parameters.items()
    }
    tables, data = frames(found), found.as_json()
    assert list(tables["ranking"]["effect"]) == [r["effect"] for r in data["ranking"]]
    for name, row in data["floor_ratio"].items():
        assert tables["floor_ratio"].loc[name, "ratio"] == row["ratio"]
    steps = frames(found.found)["steps"]
    assert list(steps["held_out relative_error_percent"]) == [
        s.held_out.relative_error_percent for s in found.found.steps
    ]
    with pytest.raises(InputError, match="int is no result"):
        frames(3)


def test_a_comparison_stands_in_a_cell_as_a_document(results: dict[str, Any]) -> None:
    """With every place, where the cell shows the first ones; names from files stay text."""
    found = results["comparison"]
    shown = interactive(found).document
    assert shown.count('class="picture"') == len(found.places) > 4
    assert "<script>alert" not in shown and "Worst window" in shown


@needs_chromium
def test_the_report_works_inside_a_cell(results: dict[str, Any]) -> None:
    """Its plots are drawn and zoom; names from files stay text; it cannot reach the notebook."""
    cell = interactive(results["diagnosis"].found, [results["record"]])
    with launched() as chromium:
        page = context_of(chromium, viewport={"width": 1280, "height": 860}).new_page()
        problems: list[str] = []
        page.on("pageerror", lambda e: problems.append(str(e)))
        page.on("dialog", lambda d: (problems.append("dialog"), d.dismiss()))
        page.set_content(f"<p id=cell></p>{cell._repr_html_()}")
        inside = page.frame_locator("iframe")
        inside.locator(".uplot").first.wait_for(timeout=60_000)
        assert "Stribeck" in inside.locator("body").inner_text()
        frame = page.frames[1]
        reach = "() => { try { return parent.document.title; } catch (e) { return e.name; } }"
        assert frame.evaluate(reach) == "SecurityError"
        assert problems == []


def html_of(outputs: list[Any]) -> str:
    """The HTML among the outputs of a cell, as a front end picks it."""
    return "".join("".join(o.get("data", {}).get("text/html", "")) for o in outputs)


@pytest.mark.slow
@pytest.mark.skipif(
    not all(importlib.util.find_spec(m) for m in ("nbformat", "nbclient", "ipykernel")),
    reason="needs nbclient and ipykernel",
)
@pytest.mark.filterwarnings("ignore")
def test_jupyter_shows_every_result() -> None:
    import nbclient
    import nbformat

    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(c) for c in CELLS])
    nbclient.NotebookClient(book, timeout=300).execute()
    for cell, word in zip(book.cells[1:], SHOWS, strict=True):
        assert word in html_of(cell.outputs).lower()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("marimo") is None, reason="needs marimo")
def test_marimo_shows_every_result(tmp_path: Path) -> None:
    ports = (
        ("", "compare, diagnose, fit, load_joint, read"),
        ("read", "train"),
        ("fit, load_joint, train", "first"),
        ("compare, first, read", "held_out"),
        ("diagnose, first, held_out", ""),
    )
    whole = "import marimo\n\napp = marimo.App()\n"
    for cell, (takes, gives) in zip(CELLS, ports, strict=True):
        body = "\n".join(f"    {line}" for line in cell.splitlines())
        whole += (
            f"\n@app.cell\ndef _({takes}):\n{body}\n    return {f'({gives},)' if gives else ''}\n"
        )
    (tmp_path / "book.py").write_text(whole, encoding="utf-8")
    command = [sys.executable, "-m", "marimo", "export", "html", "book.py", "-o", "book.html"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "book.html").read_text(encoding="utf-8").lower()
    assert page.count('"text/html"') >= len(SHOWS)
    for word in SHOWS:
        assert word in page
