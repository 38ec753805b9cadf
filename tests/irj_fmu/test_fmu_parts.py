"""Small parts of the FMU packages: units, names, the private importer, archives."""

from __future__ import annotations

import ast
import importlib
import math
import sys
from pathlib import Path
from xml.etree.ElementTree import Element

import pytest

from identification.errors import InputError
from irj_fmu.fmi.archive import content_guid, write_archive
from irj_fmu.fmi.bundle_loader import Bender, Bundle, add_site_packages
from irj_fmu.fmi.unit_definitions import add_unit_definitions, base_unit
from irj_fmu.fmi.variables import Variable


@pytest.mark.parametrize(
    ("text", "factor", "exponents"),
    [
        ("N.m", 1.0, {"kg": 1, "m": 2, "s": -2}),
        ("N.m.s/rad", 1.0, {"kg": 1, "m": 2, "s": -1, "rad": -1}),
        ("kg.m2", 1.0, {"kg": 1, "m": 2}),
        ("N.m/(A.rad)", 1.0, {"kg": 1, "m": 2, "s": -2, "A": -1, "rad": -1}),
        ("rad/s/s", 1.0, {"rad": 1, "s": -2}),
        ("mA", 1e-3, {"A": 1}),
        ("deg", math.pi / 180, {"rad": 1}),
        ("rpm", 2 * math.pi / 60, {"rad": 1, "s": -1}),
        ("1/s", 1.0, {"s": -1}),
        ("N.m/rad3", 1.0, {"kg": 1, "m": 2, "s": -2, "rad": -3}),
    ],
)
def test_units(text: str, factor: float, exponents: dict[str, int]) -> None:
    found = base_unit(text)
    assert found is not None
    assert found.factor == pytest.approx(factor, rel=1e-15)
    assert found.named_exponents == exponents


def test_unknown_and_wrong_units() -> None:
    assert base_unit("furlong") is None
    root = Element("root")
    add_unit_definitions(root, [("rad", "deg"), ("furlong", None), ("", None)])
    assert [unit.get("name") for unit in root.iter("Unit")] == ["furlong", "rad"]
    shown = next(root.iter("DisplayUnit"))
    assert float(shown.get("factor", "")) == pytest.approx(180 / math.pi)
    with pytest.raises(InputError, match="does not measure"):
        add_unit_definitions(Element("root"), [("rad", "mA")])


@pytest.mark.parametrize("name", ["a b", "3x", "", "a..b", "der(x", "x[a]", "ä"])
def test_names_that_are_not_structured(name: str) -> None:
    with pytest.raises(InputError, match="structured"):
        Variable(name)


@pytest.mark.parametrize("name", ["x", "theta[3]", "motor.position", "a.b[1,2].c", "der(q_m)"])
def test_names_that_are(name: str) -> None:
    assert Variable(name).name == name


def test_start_lies_within_the_bounds() -> None:
    with pytest.raises(InputError, match="outside"):
        Variable("k", start=2.0, maximum=1.0)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("import ours", "import P.ours\nfrom P import ours"),
        ("import ours.sub", "import P.ours.sub\nfrom P import ours"),
        ("import ours.sub as s", "import P.ours.sub as s"),
        ("from ours.sub import a as b", "from P.ours.sub import a as b"),
        ("from .sub import a", "from .sub import a"),
        ("import numpy, ours", "import numpy\nimport P.ours\nfrom P import ours"),
        ("import_module('ours.x')", "import_module('P.ours.x')"),
        ("importlib.import_module(f'ours.{x}')", "importlib.import_module(f'P.ours.{x}')"),
        ("def f():\n    from ours import x", "def f():\n    from P.ours import x"),
        ("print('ours.x')", "print('ours.x')"),
    ],
)
def test_imports_are_bent(before: str, after: str) -> None:
    tree = Bender("P", frozenset({"ours"})).visit(ast.parse(before))
    assert ast.unparse(ast.fix_missing_locations(tree)) == after


def test_a_bundle_is_private(tmp_path: Path) -> None:
    """Sub-packages, relative and late imports, data beside the code, discovery by pkgutil."""
    package = tmp_path / "ours"
    (package / "deep").mkdir(parents=True)
    (package / "__init__.py").write_text(
        "import importlib, pkgutil\nfrom . import deep\n"
        "FOUND = [importlib.import_module(f'{__name__}.{m.name}').NAME for m in "
        "pkgutil.iter_modules(__path__)\n"
        "         if m.name != 'deep']\n"
    )
    (package / "deep" / "__init__.py").write_text(
        "def late():\n    import ours.other\n    return ours.other.NAME\n"
    )
    (package / "other.py").write_text("NAME = 'other'\n")
    finder = Bundle("_private_test", tmp_path)
    sys.meta_path.insert(0, finder)
    try:
        module = importlib.import_module("_private_test.ours")
        assert module.FOUND == ["other"]
        assert module.deep.late() == "other"
        assert "ours" not in sys.modules
        with pytest.raises(ModuleNotFoundError):
            importlib.import_module("_private_test.ours.none")
    finally:
        sys.meta_path.remove(finder)
        for name in [name for name in sys.modules if name.startswith("_private_test")]:
            del sys.modules[name]


def test_site_packages_are_added_where_a_module_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "only_there_irj.py").write_text("")
    monkeypatch.setenv("IRJ_SITE_PACKAGES", str(tmp_path))
    add_site_packages(["json"], tmp_path)
    assert str(tmp_path) not in sys.path
    add_site_packages(["only_there_irj"], tmp_path)
    assert str(tmp_path) in sys.path


def test_archives_depend_on_content_alone(tmp_path: Path) -> None:
    one, two = {"b": b"2", "a": b"1"}, {"a": b"1", "b": b"2"}
    assert content_guid(one) == content_guid(two) != content_guid({"a": b"12", "b": b""})
    first = write_archive(tmp_path / "1.fmu", one).read_bytes()
    assert first == write_archive(tmp_path / "2.fmu", two).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.fmu", "2.fmu"]
