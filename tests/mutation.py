"""Small faults put into the modules that decide, and whether their tests see them.

``python -m tests.mutation --count 200 --seed 0``

A mutant is a module with one fault: a comparison turned round, another number, `and` for `or`,
another sign, ``not`` left out, a function that returns at once. They are drawn over all modules of
`TARGETS` (``--module`` keeps one), and each is tried in a copy of the project in a temporary
folder: first against the tests that take seconds, those first that call its function; then, if none
of them sees it, against those that take minutes (``--fast`` leaves these out, so what it prints is
a lower bound). The first test that fails ends the matter. A fault that compiles to the same code is
none and is not drawn.

Printed is the line of each mutant, and whether it was killed. A survivor is either a fault that no
test sees, or no fault at all; it must be looked at. ``--again FILE`` tries the survivors that an
earlier output holds once more.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final, final

import pytest

ROOT: Final = Path(__file__).resolve().parents[1]
COPIED: Final = (
    "casadi_models",
    "identification",
    "irj_fmu",
    "workbench",
    "tests",
    "benchmarks",
    "docs",
    "pyproject.toml",
    "README.md",
)
LOADED: Final = ("numpy", "casadi", "scipy.optimize", "scipy.signal", "scipy.sparse.linalg", "h5py")
"""What the project stands on, loaded once for all mutants."""
_DIAGNOSIS: Final = "tests/identification/diagnosis"
_ONLINE: Final = "tests/identification/online"
_BALANCE: Final = "tests/identification/balance"
_MODELS: Final = "tests/casadi_models"
_RECURSIVE: Final = "tests/identification/recursive"
_TRACKING: Final = "tests/identification/lines/test_order_tracking.py"
_ODDS: Final = "tests/identification/naming/test_odds.py"
_LOOP: Final = (f"{_DIAGNOSIS}/test_session.py", _ODDS)
"""The whole loop on records of seconds."""
_LONG: Final = (
    f"{_DIAGNOSIS}/test_verdict.py",
    "tests/test_metamorphic.py",
    f"{_DIAGNOSIS}/test_partial_claims.py",
    f"{_DIAGNOSIS}/test_hidden_effect_shared.py",
    f"{_DIAGNOSIS}/test_other_payload.py",
    f"{_DIAGNOSIS}/test_real_recordings.py",
)
"""The whole loop on long records and on recordings."""


@final
@dataclass(frozen=True)
class Judges:
    """Tests that judge a module: those that take seconds, then those that take minutes."""

    fast: tuple[str, ...]
    slow: tuple[str, ...] = ()


_UPDATES: Final = Judges(
    (
        f"{_ONLINE}/test_common_mode.py",
        f"{_ONLINE}/test_exact_rows.py",
        f"{_ONLINE}/test_filter.py",
        f"{_ONLINE}/test_online_clocks.py",
        f"{_ONLINE}/test_state.py",
    ),
    (f"{_ONLINE}/test_faulty_files.py", "tests/irj_fmu/test_estimator_rows.py"),
)
_ROWS: Final = Judges(
    (
        f"{_BALANCE}/test_weak.py",
        f"{_BALANCE}/test_innovations.py",
        "tests/identification/fitting/test_signed_fit.py",
        f"{_BALANCE}/test_floors.py",
        f"{_BALANCE}/test_stacked.py",
        *_LOOP[:1],
    ),
    (*_LOOP[1:], f"{_BALANCE}/test_bench.py", *_LONG[:2]),
)
TARGETS: Final[Mapping[str, Judges]] = {
    "identification.diagnosis.claims": Judges((f"{_DIAGNOSIS}/test_claims.py", *_LOOP), _LONG),
    "identification.diagnosis.trials": Judges(
        (f"{_DIAGNOSIS}/test_trials.py", f"{_DIAGNOSIS}/test_claims.py", *_LOOP), _LONG
    ),
    "identification.diagnosis.session": Judges(
        ("tests/identification/naming/test_session_parts.py", *_LOOP), _LONG
    ),
    "identification.diagnosis.lines": Judges(
        (_TRACKING, f"{_DIAGNOSIS}/test_lines.py"), (f"{_DIAGNOSIS}/test_lines_everywhere.py",)
    ),
    "identification.diagnosis.order_tracking": Judges(
        (_TRACKING, f"{_DIAGNOSIS}/test_lines.py"), (f"{_DIAGNOSIS}/test_lines_everywhere.py",)
    ),
    "identification.naming.contest": Judges((_ODDS, *_LOOP[:1]), _LONG),
    "identification.naming.odds": Judges((_ODDS, *_LOOP[:1]), _LONG),
    "identification.fitting.weak_form": _ROWS,
    "identification.balance.weak": _ROWS,
    "identification.balance.stacked": _ROWS,
    "casadi_models.functions": Judges(
        (
            f"{_MODELS}/test_casadi_models.py",
            f"{_MODELS}/test_simulate.py",
            f"{_MODELS}/test_transmission.py",
        )
    ),
    "identification.online.estimator": _UPDATES,
    "identification.online.filter_step": _UPDATES,
    "identification.recursive.ud_step": Judges(
        (
            f"{_RECURSIVE}/test_recursive.py",
            f"{_RECURSIVE}/test_prior_start.py",
            f"{_RECURSIVE}/test_recursive_scenarios.py",
        )
    ),
}
"""Modules that decide, and what judges them."""
SLOWER: Final = 3.0
"""Times the tests of the module as it is that those of a mutant may take: a loop may not end."""
SHORT: Final = 1.0
"""Seconds that a test of another file may take to be asked, too."""
MOST_ELSEWHERE: Final = 20.0
"""Seconds that all of them may take."""
HOUR: Final = 3600.0
"""Seconds for tests of which it is not known how long they take."""
SLACK: Final = 15.0
"""Seconds more, for a machine that does something else meanwhile."""


@final
@dataclass(frozen=True)
class Mutant:
    """A fault: where, what stood there and what stands there now."""

    path: Path
    line: int
    start: int
    stop: int
    before: str
    after: str
    kind: str
    function: int

    def applied(self, source: bytes) -> bytes:
        """The module with the fault."""
        return source[: self.start] + self.after.encode() + source[self.stop :]

    def __str__(self) -> str:
        """One line, by which `--again` knows it."""
        before, after = (" ".join(text.split())[:70] for text in (self.before, self.after))
        return f"{self.path}:{self.line} {self.kind}: {before} -> {after}"


TURNED: Final[Mapping[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
}
SIGNS: Final[Mapping[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}


GUARD: Final = 1e-100
"""Numbers below this keep a division from zero by zero; another one does the same."""


def mutants(path: Path) -> list[Mutant]:
    """Every fault that can be put into a module and changes the code that it compiles to."""
    source = (ROOT / path).read_bytes()
    tree = ast.parse(source)
    own = _instructions(compile(source, "", "exec"))
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def place(node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return (
            starts[node.lineno - 1] + node.col_offset,
            starts[node.end_lineno - 1] + node.end_col_offset,
        )

    found = []
    for node, kind, other in _faults(tree):
        start, stop = place(node)
        after = ast.unparse(other)
        after = (
            f"({after})"
            if isinstance(other, ast.expr) and not isinstance(other, ast.Constant)
            else after
        )
        before, own_def = source[start:stop].decode(), _function(tree, node.lineno)
        fault = Mutant(path, node.lineno, start, stop, before, after, kind, own_def)
        if _instructions(compile(fault.applied(source), "", "exec")) != own:
            found.append(fault)
    return found


def _function(tree: ast.Module, line: int) -> int:
    """First line of the innermost function around a line; 0 where there is none."""
    around = [
        min(n.lineno, *(d.lineno for d in n.decorator_list), n.lineno)
        for n in ast.walk(tree)
        if isinstance(n, ast.FunctionDef) and n.lineno <= line <= (n.end_lineno or 0)
    ]
    return max(around, default=0)


def _instructions(code: CodeType) -> tuple[object, ...]:
    """What a module does, without its line numbers."""
    constants = tuple(
        _instructions(c) if isinstance(c, CodeType) else (type(c), repr(c)) for c in code.co_consts
    )
    return code.co_code, code.co_names, constants


def _faults(tree: ast.Module) -> Iterator[tuple[ast.expr | ast.stmt, str, ast.AST]]:
    """Nodes that run, and what may stand in their place."""
    for node in _running(tree):
        if isinstance(node, ast.Compare) and type(node.ops[0]) in TURNED:
            other = copy.deepcopy(node)
            other.ops[0] = TURNED[type(node.ops[0])]()
            yield node, "comparison", other
        elif isinstance(node, ast.BoolOp):
            switched = copy.deepcopy(node)
            switched.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield node, "and/or", switched
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
            yield node, "sign", node.operand
        elif isinstance(node, ast.BinOp) and type(node.op) in SIGNS:
            signed = copy.deepcopy(node)
            signed.op = SIGNS[type(node.op)]()
            yield node, "sign", signed
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, int | float)
            and not isinstance(node.value, bool)
            and not 0 < abs(node.value) < GUARD
        ):
            yield node, "number", ast.Constant(node.value * 2 if node.value else 1)
        elif isinstance(node, ast.FunctionDef) and len(node.body) > 1:
            first = next((s for s in node.body if not _text(s)), node.body[-1])
            if not isinstance(first, ast.Return):
                yield first, "returns early", ast.Return(ast.Constant(None))


def _text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _running(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes but types, decorators, texts and what only prints."""
    if isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Raise):
        return
    if isinstance(node, ast.FunctionDef) and node.name in ("__repr__", "__str__"):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _running(child)


def copied(folder: Path) -> Path:
    """The project as it is, in a folder of its own, beside what it shares."""
    project = folder / "project"
    project.mkdir()
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(
                source, project / name, ignore=shutil.ignore_patterns("__pycache__", "*.png")
            )
        elif source.exists():
            shutil.copy(source, project / name)
    if (shared := ROOT.parent / "shared").exists():
        (folder / "shared").symlink_to(shared.resolve())
    return project


class _Watch:
    """A pytest plugin that notes how long each test takes, which functions of the modules that
    decide it calls, and which test failed first.
    """

    def __init__(self, watched: Mapping[str, str]) -> None:
        self.tests: dict[str, tuple[float, list[str]]] = {}
        self.failed = ""
        self._watched, self._called = watched, set[str]()

    def _call(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename in self._watched:
            self._called.add(f"{self._watched[code.co_filename]}:{code.co_firstlineno}")

    def pytest_runtest_setup(self) -> None:
        if self._watched:
            sys.settrace(self._call)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid
        before = self.tests.get(report.nodeid, (0.0, []))[0]
        self.tests[report.nodeid] = (before + report.duration, sorted(self._called))
        if report.when == "teardown":
            sys.settrace(None)
            self._called = set()


def run(
    project: Path, tests: Sequence[str], limit: float, watched: Mapping[str, str] | None = None
) -> tuple[str, dict[str, tuple[float, list[str]]]]:
    """The first test that fails, or nothing; and what :class:`_Watch` saw.

    The tests run in a fork of this process, which has loaded what the project stands on already.
    """
    told = project.parent / "told.json"
    told.unlink(missing_ok=True)
    child = os.fork()
    if not child:
        _run_here(project, tests, told, watched or {})
    end = time.monotonic() + limit
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "no end", {}
        time.sleep(0.05)
    code = os.waitstatus_to_exitcode(ended[1])
    if not told.exists():
        return f"exit code {code}", {}
    first, seen = json.loads(told.read_text())
    return ("" if code in (0, 5) else first or f"exit code {code}"), seen


def _run_here(project: Path, tests: Sequence[str], told: Path, watched: Mapping[str, str]) -> None:
    """Run the tests in this process and end it."""
    code = 70
    try:
        os.setsid()
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        os.chdir(project)
        os.environ["PYTHONPATH"] = str(project)
        for name in [n for n in sys.modules if n.partition(".")[0] in COPIED]:
            del sys.modules[name]
        sys.path[:] = [str(project), *(p for p in sys.path if p not in ("", str(ROOT)))]
        sys.dont_write_bytecode = not watched
        watch = _Watch(watched)
        code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests], plugins=[watch]))
        told.write_text(json.dumps([watch.failed, watch.tests]))
    finally:
        os._exit(code)


class _Bench:
    """A copy of the project, and what its tests see of the modules that decide."""

    def __init__(self, project: Path, kept: Path | None) -> None:
        self.project = project
        self._limits: dict[tuple[str, ...], float] = {}
        known = kept is not None and kept.exists()
        self._seen = json.loads(kept.read_text()) if kept is not None and known else {}
        since = kept.stat().st_mtime if kept is not None and known else 0.0
        files = list(dict.fromkeys(t for j in TARGETS.values() for t in j.fast))
        files = [f for f in files if (ROOT / f).stat().st_mtime > since]
        if not files:
            return
        paths = [str(Path(*m.split(".")).with_suffix(".py")) for m in TARGETS]
        by, found = run(project, files, HOUR, {str(project / p): p for p in paths})
        if by:
            sys.exit(f"{by} fails on the project as it is")
        old = {t: x for t, x in self._seen.items() if t.partition("::")[0] not in files}
        self._seen = {**old, **found}
        if kept is not None:
            kept.write_text(json.dumps(self._seen))

    def nearest(self, mutant: Mutant, own: Sequence[str]) -> tuple[list[str], float]:
        """Tests of seconds for a mutant, and how long they take: of the module's own files those
        that call the function of the mutant, shortest first, and then the others of these files;
        then short ones elsewhere that call it.
        """
        call = f"{mutant.path}:{mutant.function}"
        calling = sorted(
            (took, test) for test, (took, called) in self._seen.items() if call in called
        )
        first = [t for _, t in calling if t.partition("::")[0] in own]
        # what one test has worked out the others of its file may have kept
        files = {t.partition("::")[0] for t in first} or {*own}
        rest = [t for t in self._seen if t.partition("::")[0] in files and t not in first]
        elsewhere, total = [], 0.0
        for took, test in calling:
            total += took
            if test not in first and took < SHORT and total < MOST_ELSEWHERE:
                elsewhere.append(test)
        chosen = [*first, *rest, *elsewhere]
        return chosen, sum(self._seen[t][0] for t in chosen)

    def judged(self, mutant: Mutant, judges: Judges, tests: Sequence[str], fast: bool) -> str:
        """The test that kills a mutant, or nothing."""
        near, took = (list(tests), HOUR) if tests else self.nearest(mutant, judges.fast)
        place = self.project / mutant.path
        source = place.read_bytes()
        try:
            place.write_bytes(mutant.applied(source))
            by = run(self.project, near, SLOWER * took + SLACK)[0]
            if by or fast or tests or not judges.slow:
                return by
            place.write_bytes(source)
            limit = self._limit(judges.slow)
            place.write_bytes(mutant.applied(source))
            return run(self.project, judges.slow, limit)[0]
        finally:
            place.write_bytes(source)

    def _limit(self, tests: tuple[str, ...]) -> float:
        """Seconds that the tests may take; they must pass on the project as it is."""
        if tests not in self._limits:
            start = time.monotonic()
            if by := run(self.project, tests, HOUR)[0]:
                sys.exit(f"{by} fails on the project as it is")
            self._limits[tests] = SLOWER * (time.monotonic() - start) + SLACK
        return self._limits[tests]


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutation", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--module", nargs="+", default=list(TARGETS), help="all that decide")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--line", type=int, nargs="*", help="only mutants of these lines")
    parser.add_argument("--tests", nargs="+", help="in place of those of the module")
    parser.add_argument("--fast", action="store_true", help="leave out the tests of minutes")
    parser.add_argument("--kept", type=Path, help="file that keeps which test calls what")
    parser.add_argument("--begin", type=int, default=0, help="leave out so many of those drawn")
    parser.add_argument("--again", type=Path, help="only the survivors of this earlier output")
    parser.add_argument("--list", action="store_true", help="print the mutants, run nothing")
    arguments = parser.parse_args()
    judges: dict[Path, Judges] = {}
    for module in arguments.module:
        if module not in TARGETS and not arguments.tests:
            parser.error(f"no tests are known for {module}; name them with --tests")
        judges[Path(*module.split(".")).with_suffix(".py")] = TARGETS.get(module, Judges(()))
    every = [m for path in judges for m in mutants(path)]
    if arguments.line:
        every = [m for m in every if m.line in arguments.line]
    chosen = random.Random(arguments.seed).sample(every, min(arguments.count, len(every)))
    chosen = chosen[arguments.begin :]
    if arguments.again:
        lines = arguments.again.read_text(encoding="utf-8").splitlines()
        said = {
            t.rpartition(" (")[0].removeprefix("SURVIVED ")
            for t in lines
            if t.startswith("SURVIVED ")
        }
        chosen = [m for m in chosen if str(m) in said]
    if arguments.list:
        for m in sorted(chosen, key=lambda m: (m.path, m.line)):
            print(m)
        return 0
    tally = {path: [0, 0] for path in judges}
    print(f"{len(every)} mutants, {len(chosen)} drawn with seed {arguments.seed}", flush=True)
    for name in LOADED:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory(prefix="irj-mutation-") as place:
        project = copied(Path(place))
        bench = _Bench(project, arguments.kept)
        for m in chosen:
            start = time.perf_counter()
            by = bench.judged(m, judges[m.path], arguments.tests or (), arguments.fast)
            tally[m.path][0] += bool(by)
            tally[m.path][1] += 1
            print(
                f"{'killed  ' if by else 'SURVIVED'} {m} "
                f"({time.perf_counter() - start:.0f} s{', ' + by if by else ''})",
                flush=True,
            )
    for path, (dead, tried) in tally.items():
        if tried:
            print(f"{path}: {dead} of {tried} killed")
    print(f"{sum(d for d, _ in tally.values())} of {len(chosen)} killed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
