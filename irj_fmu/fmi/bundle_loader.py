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
import os
import site
import sys
from collections.abc import Iterable, Sequence
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


def add_site_packages(modules: Iterable[str], recorded: Iterable[str], version: str) -> None:
    """Add package folders where one of the modules is missing.

    ``IRJ_SITE_PACKAGES`` (separated like PATH) comes first, then the recorded folders where this
    Python is of the recorded version.
    """
    named = [
        folder for folder in os.environ.get("IRJ_SITE_PACKAGES", "").split(os.pathsep) if folder
    ]
    same = version == f"{sys.version_info.major}.{sys.version_info.minor}"
    for folder in (*named, *(recorded if same else ())):
        if all(importlib.util.find_spec(name) is not None for name in modules):
            return
        if Path(folder).is_dir():
            site.addsitedir(folder)
            importlib.invalidate_caches()
