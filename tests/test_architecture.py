"""Layers, lint, documentation and import cost of the packages."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from benchmarks import house

ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("casadi_models", "identification", "irj_fmu", "workbench")
LIBRARIES = LAYERS[:3]
HEAVY = (
    "control",
    "matplotlib",
    "scipy.signal",
    "fmpy",
    "h5py",
    "pyarrow",
    "asammdf",
    "pandas",
    "starlette",
    "uvicorn",
)


@cache
def trees() -> dict[Path, ast.Module]:
    return {
        f: ast.parse(f.read_text(encoding="utf-8"))
        for layer in LAYERS
        for f in sorted((ROOT / layer).rglob("*.py"))
    }


def layer_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0]


def imported(tree: ast.Module) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.lineno, node.module


def test_imports_point_downwards_also_inside_functions() -> None:
    wrong = []
    for path, tree in trees().items():
        allowed = LAYERS[: LAYERS.index(layer_of(path)) + 1]
        for line, name in imported(tree):
            top = name.partition(".")[0]
            if top in LAYERS and top not in allowed:
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {name}")
    assert wrong == []


def test_physics_imports_casadi_and_numpy_only() -> None:
    allowed = {"casadi", "numpy", "casadi_models", "control", *sys.stdlib_module_names}
    wrong = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for path, tree in trees().items()
        if layer_of(path) == "casadi_models"
        for line, name in imported(tree)
        if name.partition(".")[0] not in allowed
    ]
    assert wrong == []  # control: inside linearize, whose result is a control.StateSpace


def test_no_bare_except_star_import_print_or_mutable_default() -> None:
    wrong = []
    for path, tree in trees().items():
        for node in ast.walk(tree):
            bare = isinstance(node, ast.ExceptHandler) and node.type is None
            star = isinstance(node, ast.ImportFrom) and any(
                alias.name == "*" for alias in node.names
            )
            printed = (
                layer_of(path) in LIBRARIES
                and isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id == "print"
            )
            mutable = isinstance(node, ast.FunctionDef) and any(
                isinstance(d, ast.List | ast.Dict | ast.Set) for d in node.args.defaults
            )
            if bare or star or printed or mutable:
                wrong.append(f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}")
    assert wrong == []


def _strings(node: ast.AST) -> Iterator[str]:
    """String constants of an expression and of the tuples and sets inside it; what a call is
    asked by is no part of it.
    """
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif not isinstance(node, ast.Call):
        for inner in ast.iter_child_nodes(node):
            yield from _strings(inner)


def _tested(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Strings that decide something: compared, matched, members of a set, or asked of a name's
    ends.
    """
    for node in ast.walk(tree):
        found: list[ast.AST] = []
        if isinstance(node, ast.Compare):
            found = [
                side
                for side in (node.left, *node.comparators)
                if isinstance(side, ast.Constant | ast.Tuple | ast.List | ast.Set)
            ]
        elif isinstance(node, ast.MatchValue | ast.Set):
            found = [node]
        elif isinstance(node, ast.Call):
            name = (
                node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            )
            found = list(node.args) if name in ("frozenset", "set", "has") else []
        yield from ((node.lineno, word) for part in found for word in _strings(part))


def _cut(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Strings by which the end or the beginning of a name is told."""
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in ("endswith", "startswith", "removesuffix", "removeprefix")
        ):
            yield from ((node.lineno, word) for part in node.args for word in _strings(part))


def _above_physics() -> Iterator[tuple[Path, ast.Module]]:
    return ((path, tree) for path, tree in trees().items() if layer_of(path) != "casadi_models")


def test_no_effect_key_decides_anything_outside_the_declarations() -> None:
    from casadi_models import EFFECTS

    labels = {f"{k}@{p}" for k, e in EFFECTS.items() for p in e.acts_on} | set(EFFECTS)
    wrong = [
        f"{path.relative_to(ROOT)}:{line} {word!r}"
        for path, tree in _above_physics()
        for line, word in _tested(tree)
        if word in labels
    ]
    assert wrong == []


JS_TEST = re.compile(
    r"""(?:[=!]==?|\.(?:includes|has|indexOf|startsWith|endsWith)\(|\bcase|new Set\()"""
    r"""[\s(\[]*((?:["'`][^"'`]*["'`][\s,]*)+)|["'`]([^"'`]*)["'`]\s*[=!]==?"""
    r"""|\[((?:["'`][^"'`]*["'`][\s,]*)+)\]"""
)
"""Words by which a page decides: compared, asked for, or listed."""


def _decides_in_script(text: str) -> Iterator[tuple[int, str]]:
    for found in JS_TEST.finditer(text):
        line = text.count("\n", 0, found.start()) + 1
        whole = found[1] or found[3]
        words = re.findall(r"""["'`]([^"'`]*)["'`]""", whole) if whole else [found[2]]
        yield from ((line, word) for word in words)


def test_no_effect_key_decides_anything_in_the_scripts_of_the_page() -> None:
    """What a page does with an effect comes with its declaration, from the server."""
    from casadi_models import EFFECTS

    labels = {f"{k}@{p}" for k, e in EFFECTS.items() for p in e.acts_on} | set(EFFECTS)
    bad = 'if (e === "coulomb" || ["viscous", "gravity"].includes(k)) x.has("lugre")'
    assert {w for _, w in _decides_in_script(bad)} == {"coulomb", "viscous", "gravity", "lugre"}
    scripts = [p for f in ("web", "assets") for p in (ROOT / "workbench" / f).glob("*.js")]
    assert len(scripts) > 10
    wrong = [
        f"{path.relative_to(ROOT)}:{line} {word!r}"
        for path in scripts
        if ".min." not in path.name
        for line, word in _decides_in_script(path.read_text(encoding="utf-8"))
        if word in labels
    ]
    assert wrong == []


def test_no_parameter_name_or_ending_decides_anything_outside_the_declarations() -> None:
    from casadi_models import EFFECTS, Signals
    from casadi_models.term import HANGING, INERTIAS, smoothing

    own = {
        *INERTIAS,
        *HANGING,
        smoothing("motor").name,
        smoothing("link").name,
    }
    names = own | {n for e in EFFECTS.values() for p in e.acts_on for n in e.parameter_names(p)}
    wrong = [
        f"{path.relative_to(ROOT)}:{line} {word!r}"
        for path, tree in _above_physics()
        for line, word in _tested(tree)
        if word in names
    ]
    for path, tree in _above_physics():
        for line, word in _cut(tree):
            if any(x.endswith(word) or x.startswith(word) for x in Signals.names()):
                continue  # the end of a channel's name, which a parameter may share
            if len(word) > 3 and any(n.endswith(word) or n.startswith(word) for n in names):
                wrong.append(f"{path.relative_to(ROOT)}:{line} {word!r}")
    assert wrong == []


def test_those_checks_see_what_they_forbid() -> None:
    bad = """
LATE = frozenset({"flexible_mode"})
def f(t, n, model):
    if t.key == "coulomb" or t.key in ("stribeck", "lugre") or n.endswith("_smoothing_velocity"):
        return model.has("gravity")
    return "stiffness" in n
"""
    tree = ast.parse(bad)
    assert {w for _, w in _tested(tree)} == {
        "flexible_mode",
        "coulomb",
        "stribeck",
        "lugre",
        "gravity",
        "stiffness",
    }
    assert [w for _, w in _cut(tree)] == ["_smoothing_velocity"]


@pytest.mark.parametrize(
    "tool",
    [("ruff", "check", "--no-cache", "."), ("lint-imports", "--no-cache")],
    ids=["ruff", "import-linter"],
)
def test_lint(tool: tuple[str, ...]) -> None:
    program = Path(sys.executable).with_name(tool[0])
    if not program.exists():
        pytest.skip(f"{tool[0]} is not installed beside this Python; .ci/run installs it")
    done = subprocess.run(
        [program, *tool[1:]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def test_there_is_one_least_squares_solver_and_one_covariance() -> None:
    """No other bounded solver and no own covariance beside `least_squares` and `covariance`
    (searches without slopes may be scipy's).
    """
    wrong = []
    for path, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module == "scipy.optimize":
                wrong += [
                    f"{path.relative_to(ROOT)}: {a.name}"
                    for a in node.names
                    if a.name in ("least_squares", "lsq_linear", "leastsq", "curve_fit")
                ]
        text = path.read_text(encoding="utf-8")
        for quantile in ("stdtrit", "fdtr"):
            if path.name != "covariance.py" and quantile in text:
                wrong.append(f"{path.relative_to(ROOT)}: {quantile}")
    assert wrong == []


# --- documentation --------------------------------------------------------------------------------


def public(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    for node in tree.body:
        if isinstance(
            node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
        ) and not node.name.startswith("_"):
            yield node.name, node
            protocol = isinstance(node, ast.ClassDef) and "Protocol" in map(ast.unparse, node.bases)
            if isinstance(node, ast.ClassDef) and not protocol:  # said where it is done
                for inner in node.body:
                    overload = isinstance(inner, ast.FunctionDef) and any(
                        "overload" in ast.dump(d) for d in inner.decorator_list
                    )
                    if (
                        isinstance(inner, ast.FunctionDef)
                        and not inner.name.startswith("_")
                        and not overload
                    ):
                        yield f"{node.name}.{inner.name}", inner


def test_every_public_name_is_documented() -> None:
    missing = []
    for path, tree in trees().items():
        if not ast.get_docstring(tree):
            missing.append(str(path.relative_to(ROOT)))
        if path.name.startswith("_"):
            continue
        for name, node in public(tree):
            if not ast.get_docstring(node):  # type: ignore[arg-type]
                missing.append(f"{path.relative_to(ROOT)}: {name}")
    assert missing == []


CONTRACT = {
    "identification": (
        "read",
        "fit",
        "compare",
        "diagnose",
        "improve",
        "Record",
        "Fit",
        "mcs",
        "moesp",
        "RecursiveLeastSquares",
        "TwoStep",
        "FaultDetector",
    ),
    "casadi_models": ("JointModel", "Effect", "Parameter", "effect"),
}


@pytest.mark.parametrize(
    ("package", "name"), [(p, n) for p, names in CONTRACT.items() for n in names]
)
def test_every_argument_of_a_name_that_others_import_is_documented(package: str, name: str) -> None:
    thing = getattr(importlib.import_module(package), name)
    text = inspect.getdoc(thing) or ""
    if name == "effect":
        assert "see :class:`Effect`" in text
        text += inspect.getdoc(importlib.import_module(package).Effect) or ""
    missing = [a for a in inspect.signature(thing).parameters if not re.search(rf"\b{a}\b", text)]
    assert missing == []


# --- cost of importing ----------------------------------------------------------------------------


@pytest.mark.parametrize("module", ["identification", "casadi_models", "workbench.cli.main"])
def test_importing_does_not_pull_heavy_packages(module: str) -> None:
    code = (
        f"import sys, json, {module}; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    assert json.loads(done.stdout) == []


def test_no_method_is_loaded_that_the_verb_does_not_call() -> None:
    """After the import nothing but the table of names is there; after one `irj improve` no search,
    no two-step, no linear model, no recursion, no fault rule and no planning.
    """
    at_import, after = house.loaded(improve=True)
    assert [m for m in at_import if m.startswith(("identification.", "casadi_models"))] == [
        "identification.version"
    ]
    assert "identification.fitting.fit" in after
    assert "identification.diagnosis.improve" in after
    assert house.methods(after) == []


def test_every_public_name_is_found_where_the_table_says() -> None:
    import identification

    for name in identification.__all__:
        assert getattr(identification, name).__name__ == name
    assert set(identification.__all__) <= set(dir(identification))
    with pytest.raises(AttributeError, match="identification.*no_such_name"):
        identification.no_such_name  # noqa: B018


def _hidden(file: Path) -> bool:
    return any(
        part.startswith(".") or part == "__pycache__" for part in file.relative_to(ROOT).parts
    )


def test_package_data_is_declared() -> None:
    """What is not Python inside a package must be named in pyproject.toml, or an installed copy
    lacks it.
    """
    import tomllib

    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]
    missing = []
    for layer in LAYERS:
        globbed = {f for pattern in declared.get(layer, []) for f in (ROOT / layer).glob(pattern)}
        for file in (ROOT / layer).rglob("*"):
            if (
                file.is_file()
                and file.suffix not in (".py", ".pyc")
                and not _hidden(file)
                and file not in globbed
            ):
                missing.append(str(file.relative_to(ROOT)))
    assert missing == []


# --- the house ------------------------------------------------------------------------------------


def test_no_import_circles_late_and_type_only_imports_counted() -> None:
    assert house.circles() == []


def test_no_folder_is_crowded() -> None:
    assert house.crowded() == {}


def test_the_formatter_formats_everything() -> None:
    assert house.skips() == 0


def test_what_judges_records_and_claims_compares_with_no_number_without_a_name() -> None:
    rooms = ("identification/diagnosis/", "identification/data/check/", "identification/balance/")
    assert [where for where in house.literals() if where.startswith(rooms)] == []


def test_no_object_reads_a_private_member_of_another() -> None:
    assert house.private_access() == []


def test_no_call_has_more_than_six_positional_arguments() -> None:
    assert house.long_calls() == []


def test_a_circle_a_private_access_and_a_long_call_are_seen(tmp_path: Path) -> None:
    for layer in house.LAYERS:
        (tmp_path / layer).mkdir()
        (tmp_path / layer / "__init__.py").write_text("")
    (tmp_path / "identification" / "a.py").write_text(
        "def f():\n    from identification import b\n    return b\n"
    )
    (tmp_path / "identification" / "b.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from identification.a import f\n"
        "x = f._y\nz = f(1, 2, 3, 4, 5, 6, 7)\n"
    )
    assert house.circles(tmp_path) == [["identification.a", "identification.b"]]
    assert len(house.private_access(tmp_path)) == 1
    assert len(house.long_calls(tmp_path)) == 1
