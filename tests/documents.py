"""Documents as scripts: the blocks of a Markdown page, run in order in one folder.

A page holds fenced blocks of ``sh``, ``python``, ``toml`` and ``text``. A comment of HTML before a
block, which no reader of the page sees, says what the block is beyond its language:

- ``<!-- file: NAME -->``: the block is the file of this name.
- ``<!-- part of: NAME -->``: tables that go into the joint file or study of this name, and are read
  there.
- ``<!-- in: NAME -->``: lines that stand in a file that was made.
- ``<!-- not run: REASON -->``: it needs a person, a browser, another machine or a long time.
- ``<!-- given: NAME ... -->``: files that the reader of the page has.

A block of ``text`` is what the block before it prints: its lines stand in the output in this order,
with the same words, and figures that agree to the digits shown.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from identification.data.joint_file import parse_joint
from identification.data.plain_text import from_toml, toml_key, toml_value
from irj_fmu.batch.study import load_study
from workbench.cli.main import main

LANGUAGES: Final = ("sh", "python", "toml", "text")
_NOTE: Final = re.compile(r"<!-- (file|part of|in|not run|given): (.*?) -->")
_NUMBER: Final = re.compile(r"(?<![\w.])[-+]?\d+(?:\.(\d+))?(?:e([-+]?\d+))?(?![\w])")
_ANY: Final = "..."
"""Stands for anything in a line of output, such as the digits of a hash."""


@dataclass(frozen=True)
class Block:
    """One fenced block, with the notes before it."""

    page: str
    line: int
    language: str
    text: str
    notes: Mapping[str, str]

    @property
    def place(self) -> str:
        """Where it stands, for a message."""
        return f"{self.page}:{self.line}"


def blocks(path: Path) -> list[Block]:
    """The fenced blocks of a page in their order.

    A page without fences around what it shows is no script: indented code is refused.
    """
    found: list[Block] = []
    notes: dict[str, str] = {}
    inside: list[str] | None = None
    language, first = "", 0
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if line.startswith("```"):
            if inside is None:
                inside, language, first = [], line[3:].strip(), number
                assert language in LANGUAGES, f"{path.name}:{number}: a block of {language!r}"
            else:
                text = "\n".join(inside) + "\n"
                found.append(Block(path.name, first, language, text, notes))
                inside, notes = None, {}
        elif inside is not None:
            inside.append(line)
        else:
            assert not line.startswith("    "), f"{path.name}:{number}: code without a fence"
            said = _NOTE.findall(line)
            assert bool(said) == ("<!--" in line), f"{path.name}:{number}: an unknown note"
            notes |= dict(said)
    assert inside is None, f"{path.name}: a block is not closed"
    return found


def not_run(path: Path) -> list[str]:
    """Why blocks of a page are not run, one reason a block."""
    return [b.notes["not run"] for b in blocks(path) if "not run" in b.notes]


def given(path: Path) -> list[str]:
    """Files that the reader of a page has."""
    return [name for b in blocks(path) for name in b.notes.get("given", "").split()]


def run(path: Path, folder: Path) -> None:
    """Run a page in a folder.

    Raises
    ------
    AssertionError
        The first block that fails, or shows what is not so; the message names its line.
    """
    space: dict[str, Any] = {"__name__": "__main__"}
    printed, before = "", ""
    with contextlib.chdir(folder):
        for block in blocks(path):
            if "not run" in block.notes:
                printed, before = "", "not run"
            elif block.language == "text":
                if before != "not run":
                    assert printed, f"{block.place}: the block before it prints nothing"
                    missing = not_shown(block.text, printed)
                    assert missing is None, (
                        f"{block.place}: shows {missing!r}, printed is\n{printed}"
                    )
            else:
                printed, before = _RUN[block.language](block, space), block.language


def not_shown(shown: str, printed: str) -> str | None:
    """The first line that is shown and not printed after the one before it, None where all are."""
    lines: Iterator[str] = iter(printed.splitlines())
    for line in shown.splitlines():
        if line.strip() in ("", _ANY):
            continue
        if not any(same(line, other) for other in lines):
            return line
    return None


def same(shown: str, printed: str) -> bool:
    """Equal words, and figures that agree to the last digit shown: another machine's linear
    algebra moves it by one.
    """
    words = [_NUMBER.sub("#", text).split() for text in (shown, printed)]
    pattern = ".*".join(re.escape(part) for part in " ".join(words[0]).split(_ANY))
    if not re.fullmatch(pattern, " ".join(words[1])):
        return False
    if _ANY in shown:
        return True
    pairs = zip(_NUMBER.finditer(shown), _NUMBER.finditer(printed), strict=True)
    return all(_agree(a, b) for a, b in pairs)


def _agree(shown: re.Match[str], printed: re.Match[str]) -> bool:
    unit = 10.0 ** (int(shown[2] or 0) - len(shown[1] or ""))
    return abs(float(shown[0]) - float(printed[0])) <= 1.001 * unit


def _shell(block: Block, space: Mapping[str, Any]) -> str:
    out = io.StringIO()
    for line in block.text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        if words[0] == "irj":
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
                try:
                    code = main(words[1:])
                except SystemExit as ended:  # what argparse refuses
                    code = int(ended.code or 0)
        else:
            assert words[:2] == ["python", "-m"], f"{block.place}: {line!r} is no command of ours"
            done = subprocess.run(
                [sys.executable, *words[1:]], capture_output=True, text=True, check=False
            )
            out.write(done.stdout + done.stderr)
            code = done.returncode
        assert code == 0, f"{block.place}: {line!r} ends with {code}\n{out.getvalue()}"
    return out.getvalue()


def _python(block: Block, space: dict[str, Any]) -> str:
    out = io.StringIO()
    if "file" in block.notes:
        Path(block.notes["file"]).write_text(block.text, encoding="utf-8")
        return ""
    with contextlib.redirect_stdout(out):
        exec(compile(block.text, block.place, "exec"), space)  # the project's own page
    return out.getvalue()


def _toml(block: Block, space: Mapping[str, Any]) -> str:
    tables = from_toml(block.text, block.place)
    if "file" in block.notes:
        Path(block.notes["file"]).write_text(block.text, encoding="utf-8")
    elif "part of" in block.notes:
        name = block.notes["part of"]
        whole = from_toml(Path(name).read_text(encoding="utf-8"), name)
        if "study" in whole:
            head = {key: value for key, value in whole.items() if key not in tables}
            Path("part.toml").write_text(_study(head) + block.text, encoding="utf-8")
            load_study("part.toml")
        else:
            for key, table in tables.items():
                whole[key] = {**whole.get(key, {}), **table}
            parse_joint(whole, block.place)
    else:
        assert "in" in block.notes, f"{block.place}: which file is it?"
        text = Path(block.notes["in"]).read_text(encoding="utf-8")
        missing = not_shown(block.text, text)
        assert missing is None, f"{block.place}: shows {missing!r}, the file is\n{text}"
    return ""


def _study(tables: Mapping[str, Any]) -> str:
    """Tables of a study file as text again."""
    lines = []
    for name, table in tables.items():
        for one in table if isinstance(table, list) else [table]:
            lines.append(f"[[{name}]]" if isinstance(table, list) else f"[{name}]")
            lines += [f"{toml_key(key)} = {toml_value(value)}" for key, value in one.items()]
    return "\n".join(lines) + "\n"


_RUN: Final = {"sh": _shell, "python": _python, "toml": _toml}
