"""What the documents show runs as it stands, and what they say is printed is printed today."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import EFFECTS
from tests.documents import blocks, given, not_run, not_shown, run, same
from tests.irj_fmu.imported.test_user_fmu import DRAG
from tests.user_fmus.make import Make, build
from tests.user_fmus.records import axis
from workbench.cli.main import parser

ROOT: Final = Path(__file__).resolve().parents[1]
DEMO: Final = Path(str(files("workbench"))) / "demo"
PAGES: Final = {  # blocks that are not run
    "README.md": 2,
    "docs/guide.md": 5,
    "docs/explore.md": 1,
    "docs/linear.md": 0,
    "docs/extending.md": 0,
    "docs/batch.md": 1,
    "docs/user-fmu.md": 2,
    "docs/workbench.md": 1,
}


def as_csv(source: Path, target: Path) -> None:
    """A record as text, every figure whole."""
    with np.load(source) as archive:
        table = {name: archive[name] for name in archive.files}
    rows = np.column_stack(list(table.values()))
    np.savetxt(target, rows, fmt="%.17g", delimiter=",", header=",".join(table), comments="")


def own_joint(folder: Path) -> None:
    """Two recordings of a joint, and its file."""
    for name in ("run1.csv", "train.csv"):
        as_csv(DEMO / "train.npz", folder / name)
    for name in ("run2.csv", "test.csv"):
        as_csv(DEMO / "held_out.npz", folder / name)
    for name in ("train.npz", "held_out.npz", "joint.toml"):
        shutil.copy(DEMO / name, folder / name)
    for number in (1, 2, 3):
        shutil.copy(DEMO / "joint.toml", folder / f"axis{number}.toml")
    for name in ("axis1/run1.csv", "axis1/test.csv", "axis2/run1.csv"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(folder / ("run2.csv" if "test" in name else "run1.csv"), folder / name)


def multisine(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Eight lines, from rest [rad]."""
    turns = 0.2 * np.array([2, 3, 5, 7, 8, 9, 11, 13])
    phases = np.pi * np.arange(8) ** 2 / 8  # Schroeder: a low crest
    waves = np.sin(2 * np.pi * np.outer(t, turns) + phases) - np.sin(phases)
    return np.asarray(0.15 * waves.sum(axis=1))


def own_fmu(folder: Path) -> None:
    """Somebody's FMU of an axis, and recordings in which the axis has a drag that it lacks."""
    build("Axis", folder, Make(2, ("CoSimulation",))).replace(folder / "axis3.fmu")
    record = axis(lambda _q, w: DRAG * w * abs(w), seconds=9.0, h=5e-3, motion=multisine)
    for name, part in (("train", record.window(0, 5)), ("held_out", record.window(5, 9))):
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack([part.time, part["motor_position"], part["motor_torque"]]),
            fmt="%.17g",
            delimiter=",",
            header="time_s,motor_position_rad,motor_torque_Nm",
            comments="",
        )


READERS: Final[dict[str, Callable[[Path], None]]] = {"docs/user-fmu.md": own_fmu}
"""Who the reader of a page is, where it is not the owner of a joint with two recordings."""


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[Callable[[Path], None], Path]:
    """A folder with what each kind of reader has, made once."""
    made = {}
    for make in {own_joint, *READERS.values()}:
        made[make] = tmp_path_factory.mktemp(make.__name__)
        make(made[make])
    return made


@pytest.fixture
def library() -> Iterator[None]:
    """Effects that a page registers are taken out again."""
    before = {n: dict(entries) for n, entries in vars(EFFECTS).items() if isinstance(entries, dict)}
    with EFFECTS.scoped():
        yield
    for name, entries in before.items():
        getattr(EFFECTS, name).clear()
        getattr(EFFECTS, name).update(entries)


def shown(page: str) -> bool:
    """Whether a page shows what is printed."""
    return any(b.language == "text" and "not run" not in b.notes for b in blocks(ROOT / page))


def marks_of(page: str) -> list[pytest.MarkDecorator]:
    """What is left out where; the commands of the longest pages stand in tests of their own, too:
    test_user_fmu.py, test_chains.py, test_batch.py, test_explore.py and those of the page.
    """
    if page == "docs/explore.md":
        return [pytest.mark.slow]
    if shown(page):
        return []
    return [pytest.mark.no_figures, pytest.mark.slow]


@pytest.mark.parametrize("page", [pytest.param(p, marks=marks_of(p)) for p in PAGES])
def test_a_page_runs_as_it_stands(
    page: str,
    readers: dict[Callable[[Path], None], Path],
    library: None,
    tmp_path: Path,
) -> None:
    for name in given(ROOT / page):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(readers[READERS.get(page, own_joint)] / name, tmp_path / name)
    run(ROOT / page, tmp_path)
    if page == "README.md":
        same_picture(ROOT / "docs" / "demo.svg", tmp_path / "demo.svg")


def same_picture(kept: Path, drawn: Path) -> None:
    """The picture in docs/ has the words of the one that the command draws."""
    texts = [p.read_text(encoding="utf-8") for p in (kept, drawn)]
    words = [re.findall(r"<text[^>]*>([^<]*)</text>", text) for text in texts]
    number = re.compile(r"-?\d+\.?\d*")
    assert [number.sub("#", w) for w in words[0]] == [number.sub("#", w) for w in words[1]]
    assert len(texts[0]) < 40_000


@pytest.mark.parametrize("page", PAGES)
def test_what_is_not_run_says_why(page: str) -> None:
    """A block that needs a person, a browser or another machine says so; no other is left out."""
    reasons = not_run(ROOT / page)
    assert len(reasons) == PAGES[page]
    assert all(len(reason.split()) >= 3 for reason in reasons)
    assert len(blocks(ROOT / page)) > len(reasons)


def test_the_runner_sees_what_is_wrong(tmp_path: Path) -> None:
    printed = "one  1.228 [N.m]\ntwo 96.0 %\nhash 5f1c end\n"
    assert not_shown("one 1.229 [N.m]\n...\nhash ... end\n", printed) is None
    assert not_shown("two 96.2 %\n", printed) == "two 96.2 %"
    assert not_shown("two 96.0 %\none 1.228 [N.m]\n", printed) == "one 1.228 [N.m]"
    assert not same("one 1.228 N.m", "one 1.228 [N.m]")
    assert same("4.5e-05 s", "4.6e-05 s")
    assert not same("4.5e-05 s", "4.7e-05 s")
    assert not same("hd3", "hd4")
    page = tmp_path / "page.md"
    for body, said in (
        ("```sh\nirj effects no_such_effect\n```\n", "ends with 2"),
        ("```sh\nirj effects --json\n```\n", "ends with 2"),
        ("```sh\nrm x\n```\n", "no command of ours"),
        ("```sh\nirj effects coulomb\n```\n\n```text\nviscous\n```\n", "shows 'viscous'"),
        ("```toml\n[joint]\n```\n", "which file"),
        ("    irj effects\n", "without a fence"),
        ("<!-- nor run: x y z -->\n", "unknown note"),
        ("```sh\n", "not closed"),
    ):
        page.write_text(body, encoding="utf-8")
        with pytest.raises(AssertionError, match=said):
            run(page, tmp_path)


@pytest.mark.parametrize(
    "page", ["README.md", *sorted(f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md"))]
)
def test_every_verb_that_a_text_names_is_one(page: str) -> None:
    named = re.findall(r"`irj ([a-z]\w*)", (ROOT / page).read_text(encoding="utf-8"))
    assert [verb for verb in named if verb not in parser().verbs] == []


def test_python_example_of_the_readme_is_short() -> None:
    (code,) = (b.text for b in blocks(ROOT / "README.md") if b.language == "python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 9


@pytest.mark.parametrize(
    "page", sorted(p.name for p in (ROOT / "docs").glob("*.md")) + ["../README.md"]
)
def test_links_and_pictures_are_there(page: str) -> None:
    path = ROOT / "docs" / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), target
