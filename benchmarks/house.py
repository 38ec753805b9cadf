"""How the project is laid out, in numbers: ``python -m benchmarks.house [FOLDER]``.

Each figure is measured from the code's own text; the tests in tests/test_architecture.py hold the
ones that have a limit. With a folder, another checkout is measured, so that before and after stand
side by side.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import os
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
LAYERS: Final = ("casadi_models", "identification", "irj_fmu", "workbench")
MOST_FILES: Final = 20
"""Modules of one folder that a reader still overlooks; a folder of declarations is a list."""
MOST_POSITIONAL: Final = 6
LISTS: Final = ("casadi_models/effects",)
"""Folders with one file per entry of a list: their length is the length of the list."""


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Every module of the packages by its dotted name."""
    found = {}
    for layer in LAYERS:
        for file in sorted((root / layer).rglob("*.py")):
            parts = file.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


@cache
def tree_of(file: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(file.read_text(encoding="utf-8"))


def arrows(root: Path = ROOT) -> dict[str, dict[str, int]]:
    """Imports between modules, late and type-only ones too: module to module, with the line."""
    known = modules(root)
    out: dict[str, dict[str, int]] = {}
    for name, file in known.items():
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        mine = out.setdefault(name, {})
        for node in ast.walk(tree_of(file)):
            for target in _targets(node, package, known):
                if target in known and target != name:
                    mine.setdefault(target, getattr(node, "lineno", 0))
    return out


def _targets(node: ast.AST, package: str, known: dict[str, Path]) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            parts = package.split(".")
            parts = parts[: len(parts) - (node.level - 1)]
            base = ".".join([*parts, *([node.module] if node.module else [])])
        for alias in node.names:
            inner = f"{base}.{alias.name}"
            yield inner if inner in known else base


def circles(root: Path = ROOT) -> list[list[str]]:
    """Groups of modules that import each other (Tarjan's strongly connected components)."""
    graph = arrows(root)
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    out = []

    def visit(start: str) -> None:
        work = [(start, iter(graph.get(start, {})))]
        index[start] = low[start] = len(index)
        stack.append(start)
        while work:
            at, following = work[-1]
            for other in following:
                if other not in index:
                    index[other] = low[other] = len(index)
                    stack.append(other)
                    work.append((other, iter(graph.get(other, {}))))
                    break
                if other in stack:
                    low[at] = min(low[at], index[other])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[at])
                if low[at] == index[at]:
                    group = []
                    while not group or group[-1] != at:
                        group.append(stack.pop())
                    if len(group) > 1:
                        out.append(sorted(group))

    for name in graph:
        if name not in index:
            visit(name)
    return sorted(out, key=len, reverse=True)


def crowded(root: Path = ROOT) -> dict[str, int]:
    """Folders with more than :data:`MOST_FILES` Python files, tests and benchmarks too."""
    count = Counter(
        file.parent.relative_to(root).as_posix()
        for layer in (*LAYERS, "tests", "benchmarks")
        for file in (root / layer).rglob("*.py")
    )
    return {k: n for k, n in count.items() if n > MOST_FILES and k not in LISTS}


def private_access(root: Path = ROOT) -> list[str]:
    """Places where one object reads a private member of another."""
    out = []
    for file in modules(root).values():
        for node in ast.walk(tree_of(file)):
            if not isinstance(node, ast.Attribute) or not node.attr.startswith("_"):
                continue
            own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls", "os")
            if not own and not node.attr.startswith("__"):
                out.append(f"{file.relative_to(root)}:{node.lineno} {ast.unparse(node)}")
    return out


def long_calls(root: Path = ROOT) -> list[str]:
    """Calls with more than :data:`MOST_POSITIONAL` positional arguments."""
    return [
        f"{file.relative_to(root)}:{node.lineno} {ast.unparse(node.func)}"
        for file in modules(root).values()
        for node in ast.walk(tree_of(file))
        if isinstance(node, ast.Call) and len(node.args) > MOST_POSITIONAL
    ]


def effect_keys(root: Path = ROOT) -> list[str]:
    """Conditions on a key of the effect library outside casadi_models."""
    folder = root / "casadi_models" / "effects"
    keys = {file.stem for file in folder.glob("*.py")} - {"__init__"}
    out = []
    for name, file in modules(root).items():
        if name.startswith("casadi_models"):
            continue
        for node in ast.walk(tree_of(file)):
            test = node.test if isinstance(node, ast.If | ast.IfExp) else node
            if isinstance(node, ast.If | ast.IfExp | ast.Compare) and any(
                isinstance(c, ast.Constant) and c.value in keys for c in ast.walk(test)
            ):
                out.append(f"{file.relative_to(root)}:{node.lineno}")
    return sorted(set(out))


PLAIN: Final = (0.0, 0.5, 1.0, 2.0)
"""Numbers that need no reason where they are compared: signs, halves, wholes and twices."""
ROUNDING: Final = 1e-8
"""Numbers below this keep rounding apart from zero and decide nothing."""


def literals(root: Path = ROOT) -> list[str]:
    """Comparisons of identification with a number that has no name, and so no reason."""
    out = []
    for name, file in modules(root).items():
        if not name.startswith("identification"):
            continue
        for node in ast.walk(tree_of(file)):
            if isinstance(node, ast.Compare) and any(
                isinstance(c, ast.Constant)
                and isinstance(c.value, float)
                and c.value not in PLAIN
                and abs(c.value) > ROUNDING
                for side in (node.left, *node.comparators)
                for c in ast.walk(side)
            ):
                out.append(f"{file.relative_to(root)}:{node.lineno} {ast.unparse(node)}")
    return out


def skips(root: Path = ROOT) -> int:
    """Lines that the formatter is told to leave alone."""
    mark = "# fmt: " + "skip"
    files = [f for part in (*LAYERS, "tests", "benchmarks") for f in (root / part).rglob("*.py")]
    return sum(f.read_text(encoding="utf-8").count(mark) for f in files)


def lines(root: Path, parts: tuple[str, ...]) -> tuple[int, int]:
    """Lines of Python, C and web files, and lines with a comment in the Python files."""
    total = comments = 0
    for part in parts:
        for file in sorted((root / part).rglob("*")):
            if (
                file.suffix not in (".py", ".c", ".h", ".js", ".css", ".html")
                or "uPlot" in file.name
            ):
                continue
            text = file.read_text(encoding="utf-8")
            total += text.count("\n")
            if file.suffix == ".py":
                tokens = tokenize.generate_tokens(io.StringIO(text).readline)
                comments += sum(t.type == tokenize.COMMENT for t in tokens)
    return total, comments


MARKS: Final = {
    "Runge-Kutta steps of 4th order": r"\(k1 \+ 2(\.0)? ?\* ?k2 \+ 2(\.0)? ?\* ?k3 \+ k4\)",
    "readers of TOML": r"(?<!\w)tomllib\.loads?\b",
    "chart frames": r"<svg [^>]*(viewBox|aria-label)",
    "position controllers": r"bandwidth ?\*\* ?2",
    "bounded least-squares solvers": (
        r"optimize import [^\n]*(least_squares|lsq_linear)|^def least_squares\(\s*problem"
    ),
}
"""Ideas of which one is enough, each by a text that whoever builds it must write."""


def built(root: Path = ROOT) -> dict[str, list[str]]:
    """Modules in which each idea of :data:`MARKS` is built, tests and generated code apart."""
    out: dict[str, list[str]] = {name: [] for name in MARKS}
    for file in modules(root).values():
        text = file.read_text(encoding="utf-8")
        for name, mark in MARKS.items():
            if re.search(mark, text, re.MULTILINE):
                out[name].append(str(file.relative_to(root)))
    return out


METHODS: Final = ("search", "two_step", "linear", "recursive", "faults", "planning", "online")
"""Rooms of identification that hold methods of their own, which no verb of the loop needs."""
_LOADED: Final = """
import contextlib, io, json, sys
def mine():
    return sorted(m for m in sys.modules if m.partition(".")[0] in LAYERS)
import identification
states = [mine()]
if IMPROVE:
    from workbench.entry import main
    demo = ROOT + "/workbench/demo/"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        code = main(["improve", demo + "train.npz", "--held-out", demo + "held_out.npz",
                     "--joint", demo + "joint.toml"])
    assert code == 0, code
    states.append(mine())
print(json.dumps(states))
"""


def loaded(root: Path = ROOT, *, improve: bool = False) -> list[list[str]]:
    """Modules of the packages that `import identification` loads and, where asked for, those that
    are loaded after one `irj improve` on the demo's records.
    """
    code = f"LAYERS, ROOT, IMPROVE = {LAYERS!r}, {str(root)!r}, {improve!r}\n{_LOADED}"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(root)},
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    found: list[list[str]] = json.loads(done.stdout)
    return found


def methods(loaded_modules: list[str]) -> list[str]:
    """Those of the modules that belong to a method of its own (:data:`METHODS`)."""
    rooms = tuple(f"identification.{room}" for room in METHODS)
    return [m for m in loaded_modules if m.startswith(rooms)]


_COUNT: Final = """
import io, sys, collections, contextlib, tempfile, os
calls, answers = collections.Counter(), {}
import importlib
def counted(module, name):
    home = importlib.import_module(module)
    inner = getattr(home, name)
    def outer(*args, **kwargs):
        calls[name] += 1
        found = inner(*args, **kwargs)
        answers[name, id(found)] = found
        return found
    for other in list(sys.modules.values()):
        if other is not None and getattr(other, name, None) is inner:
            setattr(other, name, outer)
import identification
for module, name in MODULES:
    counted(module, name)
from workbench.entry import main
folder = tempfile.mkdtemp(); os.chdir(folder)
with contextlib.redirect_stdout(io.StringIO()):
    try:
        main(["demo"])
    except SystemExit:
        pass
print(calls["sense"], sum(n == "sense" for n, _ in answers), calls["noise_level"])
"""


def demo_calls(root: Path = ROOT) -> tuple[int, int, int]:
    """How often one `irj demo` asks `sense`, how often that is worked out and not looked up, and
    how often it runs `noise_level`.
    """
    homes = {
        name: m for m in modules(root) for name in ("sensing", "noise") if m.endswith(f".{name}")
    }
    pairs = [(homes["sensing"], "sense"), (homes["noise"], "noise_level")]
    code = _COUNT.replace("MODULES", repr(pairs))
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(root)},
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    asked, sensed, noise = map(int, done.stdout.split()[-3:])
    return asked, sensed, noise


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT, help="another checkout")
    root = parser.parse_args().folder.resolve()
    if not modules(root):
        parser.error(f"{root} holds none of {', '.join(LAYERS)}: give the folder of a checkout")
    found = circles(root)
    library, comments = lines(root, LAYERS)
    tests, _ = lines(root, ("tests",))
    asked, sensed, noise = demo_calls(root)
    at_import, after = loaded(root, improve=True)
    rows = [
        ("import circles (late and type-only imports too)", f"{len(found)}"),
        ("largest circle, modules", f"{max(map(len, found), default=0)}"),
        (f"folders over {MOST_FILES} files", str(crowded(root) or 0)),
        ("lines the formatter is told to skip", str(skips(root))),
        ("accesses to private members of another object", str(len(private_access(root)))),
        (
            f"calls with more than {MOST_POSITIONAL} positional arguments",
            str(len(long_calls(root))),
        ),
        ("conditions on effect keys outside casadi_models", str(len(effect_keys(root)))),
        ("literals in comparisons of identification", str(len(literals(root)))),
        ("modules that `import identification` loads", str(len(at_import))),
        (
            "modules loaded after one `irj improve` / of methods that it does not call",
            f"{len(after)} / {len(methods(after))}",
        ),
        (
            "`irj demo`: sense worked out (asked) / noise_level, two records",
            f"{sensed} ({asked}) / {noise}",
        ),
        ("library lines (Python, C, web)", str(library)),
        ("comments per 100 library lines", f"{100 * comments / library:.2f}"),
        ("test lines : library lines", f"{tests / library:.2f}"),
    ]
    rows[-3:-3] = [(f"modules with {name}", str(len(at))) for name, at in built(root).items()]
    print("| what | figure |\n|---|---|")
    for name, value in rows:
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    main()
