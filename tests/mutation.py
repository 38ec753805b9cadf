"""Small faults put into a module, and whether its tests see them.

``python -m tests.mutation --module identification.diagnosis.claims --count 20 --seed 0``

A mutant is the module with one fault: a comparison turned round, another number, `and` for `or`,
another sign, ``not`` left out, a function that returns at once. Each is tried in a copy of the
project in a temporary folder, against the tests that judge the module (`TARGETS`, the fast ones
first). Printed is the line of each mutant, and whether it was killed. A survivor is either a fault
that no test sees, or no fault at all; it must be looked at.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

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
_DIAGNOSIS: Final = "tests/identification/diagnosis"
_LOOP: Final = (
    f"{_DIAGNOSIS}/test_verdict.py",
    "tests/test_metamorphic.py",
    f"{_DIAGNOSIS}/test_hidden_effect_shared.py",
    f"{_DIAGNOSIS}/test_partial_claims.py",
    f"{_DIAGNOSIS}/test_real_recordings.py",
    f"{_DIAGNOSIS}/test_other_payload.py",
)
TARGETS: Final[Mapping[str, tuple[str, ...]]] = {
    "identification.diagnosis.claims": (f"{_DIAGNOSIS}/test_claims.py", *_LOOP),
    "identification.diagnosis.trials": (f"{_DIAGNOSIS}/test_trials.py", *_LOOP),
    "identification.diagnosis.session": (f"{_DIAGNOSIS}/test_session.py", *_LOOP),
    "identification.diagnosis.lines": (f"{_DIAGNOSIS}/test_lines.py",),
    "identification.naming.contest": (
        "tests/identification/naming/test_odds.py",
        f"{_DIAGNOSIS}/test_other_payload.py",
    ),
    "identification.naming.odds": ("tests/identification/naming/test_odds.py",),
    "identification.fitting.weak_form": (
        "tests/identification/balance/test_weak.py",
        "tests/test_metamorphic.py",
        "tests/identification/fitting/test_signed_fit.py",
    ),
    "identification.balance.weak": (
        "tests/identification/balance/test_weak.py",
        "tests/identification/balance/test_bench.py",
        "tests/test_metamorphic.py",
        "tests/identification/balance/test_floors.py",
    ),
    "casadi_models.functions": (
        "tests/casadi_models/test_casadi_models.py",
        "tests/casadi_models/test_simulate.py",
        "tests/casadi_models/test_transmission.py",
    ),
    "identification.online.estimator": (
        "tests/identification/online/test_common_mode.py",
        "tests/identification/online/test_faulty_files.py",
        "tests/irj_fmu/test_estimator_rows.py",
    ),
    "identification.recursive.ud_step": (
        "tests/identification/recursive/test_recursive.py",
        "tests/identification/recursive/test_prior_start.py",
    ),
}
"""Tests that judge a module, those that take least first."""
SLOWER: Final = 3.0
"""Times the tests of the module as it is that those of a mutant may take: a loop may not end."""


@final
@dataclass(frozen=True)
class Mutant:
    """A fault: where, what stood there and what stands there now."""

    line: int
    start: int
    stop: int
    before: str
    after: str
    kind: str

    def applied(self, source: bytes) -> bytes:
        """The module with the fault."""
        return source[: self.start] + self.after.encode() + source[self.stop :]


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


def mutants(source: bytes) -> list[Mutant]:
    """Every fault that can be put into a module."""
    tree = ast.parse(source)
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
        found.append(Mutant(node.lineno, start, stop, source[start:stop].decode(), after, kind))
    return found


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


def killed(project: Path, tests: Sequence[str], limit: float) -> str:
    """Which tests see a fault, or nothing."""
    environment = {**os.environ, "PYTHONPATH": str(project), "PYTHONDONTWRITEBYTECODE": "1"}
    for test in tests:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", test]
        try:
            done = subprocess.run(
                command,
                cwd=project,
                env=environment,
                capture_output=True,
                timeout=limit,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"{test} (no end)"
        if done.returncode not in (0, 5):
            return test
    return ""


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutation", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--module", required=True)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--line", type=int, nargs="*", help="only mutants of these lines")
    parser.add_argument("--tests", nargs="+", help="in place of those of the module")
    parser.add_argument("--list", action="store_true", help="print the mutants, run nothing")
    arguments = parser.parse_args()
    path = Path(*arguments.module.split(".")).with_suffix(".py")
    source = (ROOT / path).read_bytes()
    every = [m for m in mutants(source) if not arguments.line or m.line in arguments.line]
    chosen = random.Random(arguments.seed).sample(every, min(arguments.count, len(every)))
    if arguments.list:
        for m in sorted(chosen, key=lambda m: m.line):
            print(f"{path}:{m.line} {m.kind}: {' '.join(m.before.split())} -> {m.after}")
        return 0
    wanted = arguments.tests or TARGETS.get(arguments.module)
    if not wanted:
        parser.error(f"no tests are known for {arguments.module}; name them with --tests")
    tests = [t for t in wanted if (ROOT / t.partition("::")[0]).exists()]
    dead = 0
    with tempfile.TemporaryDirectory(prefix="irj-mutation-") as place:
        project = copied(Path(place))
        start = time.perf_counter()
        if by := killed(project, tests, 1800.0):
            print(f"{by} fails on the module as it is")
            return 2
        limit = SLOWER * (time.perf_counter() - start) + 30.0
        print(
            f"{len(every)} mutants of {path}, {len(chosen)} drawn; limit {limit:.0f} s", flush=True
        )
        for m in chosen:
            (project / path).write_bytes(m.applied(source))
            start = time.perf_counter()
            by = killed(project, tests, limit)
            dead += bool(by)
            print(
                f"{'killed  ' if by else 'SURVIVED'} {path}:{m.line} {m.kind}: "
                f"{' '.join(m.before.split())[:70]} -> {m.after[:70]} "
                f"({time.perf_counter() - start:.0f} s{', ' + by if by else ''})",
                flush=True,
            )
    print(f"{arguments.module}: {dead} of {len(chosen)} killed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
