"""Bill of materials, upper bounds of versions, and a source archive that is always the same."""

from __future__ import annotations

import gzip
import importlib.util
import io
import re
import subprocess
import sys
import tarfile
import tomllib
from importlib.metadata import distribution
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


def loaded(name: str) -> ModuleType:
    """A module of the folder release, which is no package."""
    spec = importlib.util.spec_from_file_location(
        f"release_{name}", ROOT / "release" / f"{name}.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SUPPLY = loaded("supply")


def requirements(extra: str | None = None) -> set[str]:
    """Names that pyproject.toml asks for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = project["optional-dependencies"][extra] if extra else project["dependencies"]
    return {SUPPLY.plain(re.split(r"[\[<>=~ ]", t)[0]) for t in texts}


def test_the_bill_of_materials_holds_what_is_required_and_what_that_requires() -> None:
    bill = SUPPLY.sbom(frozenset(["app"]))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")
    found = {c["name"]: c for c in bill["components"]}
    assert requirements() | requirements("app") <= set(found)
    assert "matplotlib" in found, "brought by python-control"
    assert "pytest" not in found
    references = {c["bom-ref"] for c in [*found.values(), bill["metadata"]["component"]]}
    edges = {d["ref"]: d["dependsOn"] for d in bill["dependencies"]}
    assert set(edges) == references
    assert all(set(to) <= references for to in edges.values())
    assert found["numpy"]["version"] == distribution("numpy").version
    assert found["numpy"]["bom-ref"] in edges[found["scipy"]["bom-ref"]]
    (project,) = {r for r in references if r.startswith("pkg:pypi/irj@")}
    direct = {r.partition("/")[2].partition("@")[0] for r in edges[project]}
    assert direct == requirements() | requirements("app")


def test_sizes_are_those_of_the_files() -> None:
    rows = {name: (mb, by) for name, mb, by in SUPPLY.sizes()}
    assert rows["casadi"][0] > 50
    assert rows["casadi"][1] == "irj"
    assert "control" in rows["matplotlib"][1]


def test_every_dependency_has_an_upper_bound() -> None:
    """The bounds must let in what pyproject.toml asks for."""
    from packaging.requirements import Requirement

    lines = (ROOT / "release" / "constraints.txt").read_text().splitlines()
    bounds = dict(line.split("<=") for line in lines)
    assert len(bounds) == len(lines)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = project["dependencies"] + project["optional-dependencies"]["test"]
    for text in (t for t in asked if not t.startswith("irj[")):
        wanted = Requirement(text)
        assert wanted.specifier.contains(bounds[SUPPLY.plain(wanted.name)]), text


def test_a_source_archive_does_not_depend_on_who_made_it_when(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    backend = pytest.importorskip("setuptools") and loaded("backend")

    def made(order: int, owner: str, moment: int, mode: int) -> bytes:
        raw = io.BytesIO()
        with tarfile.open(fileobj=raw, mode="w") as archive:
            for name in ["p/a.py", "p/b.py", "p/run.sh"][::order]:
                entry = tarfile.TarInfo(name)
                entry.size, entry.mtime, entry.uname, entry.uid = 4, moment, owner, moment % 1000
                entry.mode = 0o755 if name.endswith(".sh") else mode
                archive.addfile(entry, io.BytesIO(name[-4:].encode()))
        return backend.normalised(gzip.compress(raw.getvalue(), mtime=moment))

    one, other = made(1, "a", 1_700_000_000, 0o644), made(-1, "b", 1_600_000_123, 0o600)
    assert one == other
    with tarfile.open(fileobj=io.BytesIO(one)) as archive:
        assert archive.getnames() == ["p/a.py", "p/b.py", "p/run.sh"]
        held = archive.extractfile("p/b.py")
        assert held is not None
        assert held.read() == b"b.py"
        assert archive.getmember("p/run.sh").mode == 0o755
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1234567890")
    assert made(1, "a", 0, 0o644) != one


def test_the_command_prints_what_it_is_asked_for(tmp_path: Path) -> None:
    target = tmp_path / "bom.json"
    command = [sys.executable, str(ROOT / "release" / "supply.py"), "sbom", "-o", str(target)]
    assert subprocess.run(command, check=True, capture_output=True).stdout == b""
    assert '"CycloneDX"' in target.read_text()
