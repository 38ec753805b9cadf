"""Import a folder of packages under a private name, so that two FMUs and their host never share a
module.

The packages' own absolute imports of each other are bent to the private name while they are
compiled, so an import inside a function finds the FMU's module too, at any later time. All sources
are read at once: the FMU may be extracted again elsewhere, or its first folder removed, while the
process lives.

This file is also the text of an FMU's start script; it uses the standard library only.
"""

from __future__ import annotations

import ast
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import shutil
import site
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import CodeType, ModuleType

_CALLS = frozenset({"import_module", "find_spec", "files", "get_data"})


class Bender(ast.NodeTransformer):
    """Put a prefix before every absolute import of the named packages."""

    def __init__(self, prefix: str, roots: frozenset[str]) -> None:
        self.prefix = prefix
        self.roots = roots

    def _is_ours(self, name: str) -> bool:
        return name.partition(".")[0] in self.roots

    def visit_Import(self, node: ast.Import) -> list[ast.stmt]:  # noqa: N802
        """``import a.b`` binds ``a``, ``import a.b as c`` binds ``c``."""
        out: list[ast.stmt] = []
        for item in node.names:
            if not self._is_ours(item.name):
                out.append(ast.Import([item]))
                continue
            private = f"{self.prefix}.{item.name}"
            out.append(ast.Import([ast.alias(private, item.asname)]))
            if item.asname is None:
                root = item.name.partition(".")[0]
                out.append(ast.ImportFrom(self.prefix, [ast.alias(root)], 0))
        return [ast.copy_location(new, node) for new in out]

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.ImportFrom:  # noqa: N802
        """``from a.b import c``."""
        if node.level == 0 and node.module is not None and self._is_ours(node.module):
            node.module = f"{self.prefix}.{node.module}"
        return node

    def visit_Call(self, node: ast.Call) -> ast.Call:  # noqa: N802
        """``import_module("a.b")`` and its kin with a written name."""
        self.generic_visit(node)
        name = (
            node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        )
        first = node.args[0] if node.args and name in _CALLS else None
        text = first.values[0] if isinstance(first, ast.JoinedStr) and first.values else first
        if (
            isinstance(text, ast.Constant)
            and isinstance(text.value, str)
            and self._is_ours(text.value)
        ):
            text.value = f"{self.prefix}.{text.value}"
        return node


class Bundle(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Finder and loader of every module below ``root``, as ``prefix.<module>``.

    Parameters
    ----------
    prefix : str
        A name no other bundle has.
    root : Path
        Folder that holds the packages and single modules.
    """

    def __init__(self, prefix: str, root: Path) -> None:
        self.prefix = prefix
        self.root = root
        paths = sorted(root.rglob("*.py"))
        self.sources = {
            self._name(path): (path, path.read_text(encoding="utf-8")) for path in paths
        }
        self.roots = frozenset(name.partition(".")[0] for name in self.sources)

    def _name(self, path: Path) -> str:
        parts = path.relative_to(self.root).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Answer for the prefix and what lies below it."""
        if fullname != self.prefix and not fullname.startswith(self.prefix + "."):
            return None
        inner = fullname[len(self.prefix) + 1 :]
        folder = self.root.joinpath(*inner.split(".")) if inner else self.root
        if inner in self.sources:
            origin = self.sources[inner][0]
            is_package = origin.name == "__init__.py"
        elif not inner or any(name.startswith(inner + ".") for name in self.sources):
            origin, is_package = None, True
        else:
            return None
        spec = importlib.machinery.ModuleSpec(
            fullname, self, origin=str(origin or folder), is_package=is_package
        )
        spec.has_location = origin is not None
        if is_package:
            spec.submodule_search_locations = [str(folder)]
        return spec

    def is_package(self, fullname: str) -> bool:
        """Say whether the module is a package."""
        spec = self.find_spec(fullname)
        return spec is not None and spec.submodule_search_locations is not None

    def get_source(self, fullname: str) -> str:
        """Return the text of a module, empty for a folder without ``__init__.py``."""
        entry = self.sources.get(fullname[len(self.prefix) + 1 :])
        return entry[1] if entry else ""

    def get_code(self, fullname: str) -> CodeType:
        """Compile a module with its imports bent."""
        entry = self.sources.get(fullname[len(self.prefix) + 1 :])
        where = str(entry[0]) if entry else fullname
        tree = Bender(self.prefix, self.roots).visit(ast.parse(self.get_source(fullname), where))
        return compile(ast.fix_missing_locations(tree), where, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        """Run a module's code."""
        exec(self.get_code(module.__name__), module.__dict__)


def load_class(prefix: str, root: Path, module: str, name: str) -> type:
    """Import ``module`` from the bundle and return its class ``name``."""
    if not any(isinstance(finder, Bundle) and finder.prefix == prefix for finder in sys.meta_path):
        sys.meta_path.insert(0, Bundle(prefix, root))
    found: type = getattr(importlib.import_module(f"{prefix}.{module}"), name)
    return found


_ASK = (
    "import json, sys; print(json.dumps([list(sys.version_info[:2]), [p for p in sys.path if "
    "p.endswith('-packages')]]))"
)
_PATIENCE = 60.0
"""Time an interpreter has to say where its packages are [s]; one that starts from a slow disk
needs seconds.
"""


def add_site_packages(modules: Sequence[str], resources: Path) -> None:
    """Add package folders where one of the modules is missing.

    ``IRJ_SITE_PACKAGES`` (separated like PATH) comes first, then the packages of the interpreters
    that ``IRJ_PYTHON``, the file ``python.txt`` beside this one, and PATH name, where they are of
    this version of Python.

    Raises
    ------
    ImportError
        One line that says what is missing and what to set.
    """
    for folders in _places(resources):
        if not missing_of(modules):
            return
        for folder in filter(os.path.isdir, folders):
            site.addsitedir(folder)
        importlib.invalidate_caches()
    missing = missing_of(modules)
    if missing:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise ImportError(
            f"No module named {', '.join(map(repr, missing))} for this Python {version}; set "
            "IRJ_PYTHON to the path of a "
            f"Python {version} that has it, or write that path into resources/python.txt of this "
            "FMU"
        )


def missing_of(modules: Iterable[str]) -> list[str]:
    """The modules that cannot be found."""
    return [name for name in modules if importlib.util.find_spec(name) is None]


def _places(resources: Path) -> Iterator[list[str]]:
    """Package folders of one place after the other; an interpreter is asked only when its turn
    comes.
    """
    yield []
    yield [folder for folder in os.environ.get("IRJ_SITE_PACKAGES", "").split(os.pathsep) if folder]
    note = resources / "python.txt"
    named = [
        os.environ.get("IRJ_PYTHON", ""),
        note.read_text(encoding="utf-8-sig").strip() if note.is_file() else "",
    ]
    on_path = [
        shutil.which(name)
        for name in (
            "python3",
            "python",
            f"python{sys.version_info.major}.{sys.version_info.minor}",
        )
    ]
    for python in dict.fromkeys(filter(None, (*named, *on_path))):
        yield packages_of(python)


def packages_of(python: str) -> list[str]:
    """Package folders of an interpreter of this version; none where it is another, or does not
    answer.
    """
    try:
        done = subprocess.run(
            [python, "-P", "-c", _ASK],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )
        version, folders = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return []
    return [str(folder) for folder in folders] if version == list(sys.version_info[:2]) else []
