"""Slave FMUs: a Python slave, the project packages it needs and its files in one
co-simulation archive of FMI 2.0 or 3.0.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final, final
from xml.etree import ElementTree

from casadi_models.effect import EffectFile
from identification.errors import InputError
from irj_fmu.command_line import checkpoint
from irj_fmu.fmi.archive import content_guid, write_archive
from irj_fmu.fmi.compiler import compile_library, find_compiler, header_folder
from irj_fmu.fmi.description_fmi3 import said_in_fmi3, time_reference
from irj_fmu.fmi.documentation import Note, beside, licence_of
from irj_fmu.fmi.targets import FMI3_FOLDERS

_HERE = Path(__file__).parent
_MINIMUM = ("slave_base.py", "variables.py", "unit_definitions.py", "model_description.py")
_ALONE = ("identification.errors", "identification.version", "casadi_models.quantities")
"""Modules of other packages that those need; each imports nothing of the project."""
_SHIM_TARGET = "x86_64-linux-gnu"
_SHIM_PARTS = ("slave_shim.c", "living.c", "fmi3_common.c", "fmi3_log.c")
_NO_SHIM = (
    "built with pythonfmu's own library: runs in Python hosts; C hosts need libpython preloaded "
    "and a path without "
    "special characters. For the full FMU run `pip install ziglang` or install gcc, and build "
    "again ({reason})"
)


@final
@dataclass(frozen=True)
class SlaveSpec:
    """A slave to be packaged.

    Parameters
    ----------
    identifier : str
        A C identifier; names the model and its library.
    module : str
        Module that holds the class, as the packages import it, e.g. ``irj_fmu.estimator.slave``.
    class_name : str
        A concrete subclass of `irj_fmu.fmi.slave_base.TableSlave`.
    packages : tuple of Path
        Package folders and single modules to bundle. What the base class needs is added.
    files : mapping of str to Path
        Name in the FMU's resources folder to file, e.g. the joint file. The slave finds them below
        ``self.resources``.
    effects : tuple of EffectFile
        Users' own effects that the model uses: they join the library of the bundled packages.
        Elsewhere the environment variables IRJ_LIBPYTHON and IRJ_SITE_PACKAGES say where they are.
    notes : tuple of Note
        Sections of the FMU's documentation.
    """

    identifier: str
    module: str
    class_name: str
    packages: tuple[Path, ...]
    files: Mapping[str, Path] = field(default_factory=dict)
    effects: tuple[EffectFile, ...] = ()
    notes: tuple[Note, ...] = ()


@final
@dataclass(frozen=True)
class Packaged:
    """The written FMU, whether it holds the shim, and one sentence on what that means."""

    path: Path
    has_shim: bool
    message: str


def package_slave(
    spec: SlaveSpec, out: Path, *, cc: str | None = None, shim: bool = True, fmi: int = 2
) -> Packaged:
    """Write the FMU of a slave.

    Parameters
    ----------
    spec : SlaveSpec
        The slave.
    out : Path
        File to write, ending in ``.fmu``; renamed into place when complete.
    cc : str, optional
        Compiler of the shim, see `irj_fmu.fmi.compiler.find_compiler`.
    shim : bool
        False leaves the shim out even where there is a compiler.
    fmi : {2, 3}
        Version of FMI. In FMI 3.0 the shim is the library, so there is no FMU without it.

    Returns
    -------
    Packaged
        The same content gives the same bytes.

    Raises
    ------
    InputError
        Where a file is missing, the slave cannot be imported from the bundle alone, or the folder
        cannot be written.

    Notes
    -----
    The slave is imported in a fresh process from the bundle to write modelDescription.xml, so a
    package that was forgotten shows here and not at the user's.
    """
    if not re.fullmatch(r"[A-Za-z_]\w*", spec.identifier, re.ASCII):
        raise InputError(
            f"FMU identifier {spec.identifier!r} is not a C identifier; use letters, digits and '_'"
        )
    bundle = _bundle(spec)
    resources = _resources(spec, bundle)
    version = {} if fmi == 2 else {"fmi": b"3"}
    guid = content_guid(resources | {"identifier": spec.identifier.encode(), **version})
    content = {f"resources/{name}": code for name, code in resources.items()}
    described = _describe(spec, resources, guid)
    content["modelDescription.xml"] = described if fmi == 2 else said_in_fmi3(described)
    content |= beside(
        content["modelDescription.xml"], spec.notes, {"pythonfmu": licence_of("pythonfmu")}
    )
    inner = _pythonfmu_binaries()
    note = "holds the shim: runs in Python hosts and C hosts"
    library: bytes | None = None
    if fmi == 3:
        library = _compile_shim(spec, described, _third_party(bundle), cc, "slave_fmi3.c")
        place = f"binaries/{FMI3_FOLDERS[_SHIM_TARGET]}"
        content[f"{place}/{spec.identifier}.so"] = library
        (code,) = (code for name, code in inner.items() if name.startswith("linux64/"))
        content[f"{place}/{_inner_name(spec)}"] = code
        return Packaged(write_archive(out, content), True, f"{note}, on Linux")
    if shim:
        try:
            find_compiler(_SHIM_TARGET, cc)
            header_folder()
        except InputError as error:
            note = _NO_SHIM.format(reason=str(error).split(":")[0])
        else:
            library = _compile_shim(spec, described, _third_party(bundle), cc)
    else:
        note = _NO_SHIM.format(reason="left out on request")
    for name, code in inner.items():
        folder, suffix = name.split("/")[0], Path(name).suffix
        if library is not None and folder == "linux64":
            content[f"binaries/linux64/{spec.identifier}.so"] = library
            content[f"binaries/linux64/{_inner_name(spec)}"] = code
        else:
            content[f"binaries/{folder}/{spec.identifier}{suffix}"] = code
    return Packaged(write_archive(out, content), library is not None, note)


def _inner_name(spec: SlaveSpec) -> str:
    return f"lib{spec.identifier}_pythonfmu.so"


def _pythonfmu_folder() -> Path:
    found = importlib.util.find_spec("pythonfmu")
    if found is None or not found.submodule_search_locations:
        raise InputError("pythonfmu is missing: run `pip install pythonfmu`")
    return Path(next(iter(found.submodule_search_locations)))


def _pythonfmu_binaries() -> dict[str, bytes]:
    folder = _pythonfmu_folder() / "resources" / "binaries"
    paths = sorted(path for path in folder.rglob("*") if path.suffix in (".so", ".dll", ".dylib"))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _files(root: Path) -> dict[str, bytes]:
    """Return a package folder or a single module as relative name to bytes, without caches and
    C sources.
    """
    if root.is_file():
        return {root.name: root.read_bytes()}
    if not root.is_dir():
        raise InputError(f"{root}: there is no such package or module to bundle; check `packages`")
    kept: dict[str, bytes] = {}
    for path in sorted(root.rglob("*")):
        parts = path.relative_to(root).parts
        hidden = any(part.startswith(".") or part == "__pycache__" for part in parts)
        if path.is_file() and not hidden and path.suffix not in (".pyc", ".c", ".h"):
            kept["/".join((root.name, *parts))] = path.read_bytes()
    return kept


def _bundle(spec: SlaveSpec) -> dict[str, bytes]:
    bundle: dict[str, bytes] = {}
    for root in spec.packages:
        bundle |= _files(Path(root).resolve())
    for number, own in enumerate(spec.effects, 1):
        bundle[f"casadi_models/effects/own_{number}.py"] = own.code
    for name in _MINIMUM:
        bundle.setdefault(f"irj_fmu/fmi/{name}", (_HERE / name).read_bytes())
    for module in _ALONE:
        found = importlib.util.find_spec(module)
        if found is not None and found.origin is not None:
            bundle.setdefault(f"{module.replace('.', '/')}.py", Path(found.origin).read_bytes())
    for path in sorted(_pythonfmu_folder().glob("*.py")):
        bundle[f"pythonfmu/{path.name}"] = path.read_bytes()
    module = spec.module.replace(".", "/")
    if f"{module}.py" not in bundle and f"{module}/__init__.py" not in bundle:
        raise InputError(
            f"module {spec.module} is not among the bundled packages; add it to `packages`"
        )
    return bundle


@cache  # the packages of one process are bundled for many FMUs
def _imported(text: bytes) -> frozenset[str]:
    """Return the top names that a module imports when it starts."""
    names: set[str] = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.Import):
            names |= {item.name.partition(".")[0] for item in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return frozenset(names)


def _third_party(bundle: Mapping[str, bytes]) -> list[str]:
    """Return the modules that the bundle imports when it starts and neither holds nor finds in the
    standard library.

    What a function imports when it is called, such as the reader of a file format, may be missing
    where the FMU runs.
    """
    names: set[str] = set()
    for name, text in bundle.items():
        if not name.endswith(".py") or name.startswith("pythonfmu/"):
            continue
        names |= _imported(text)
    own = {name.partition("/")[0].removesuffix(".py") for name in bundle}
    return sorted(names - own - set(sys.stdlib_module_names))


def _resources(spec: SlaveSpec, bundle: Mapping[str, bytes]) -> dict[str, bytes]:
    digest = hashlib.sha256()
    for name in sorted(bundle):
        digest.update(f"{name}\0{len(bundle[name])}\0".encode() + bundle[name])
    digest.update(f"{spec.module}:{spec.class_name}".encode())
    mark = digest.hexdigest()[:16]
    script = f"{spec.identifier}_{mark}"
    start = _start_script(spec, f"_fmu_{mark}", _third_party(bundle))
    resources = {f"bundle/{name}": code for name, code in bundle.items()}
    resources[f"{script}.py"] = start.encode()
    resources["slavemodule.txt"] = script.encode()
    for name, path in spec.files.items():
        if not Path(path).is_file():
            raise InputError(f"{path}: there is no such file to put into the FMU; check `files`")
        resources[name] = Path(path).read_bytes()
    return resources


def _start_script(spec: SlaveSpec, prefix: str, needed: Iterable[str]) -> str:
    """Return the text of the script pythonfmu's library runs: the loader and a tail that names the
    class.

    The library runs the text twice, the second time with separate locals, looks for the class in
    those, and gives back one reference to the module's dictionary too many at each instantiation;
    the last line makes up for it.
    """
    tail = f"""

def _start() -> type:
    add_site_packages({json.dumps(list(needed))}, Path(__file__).resolve().parent)
    folder = Path(__file__).resolve().parent / "bundle"
    return load_class({json.dumps(prefix)}, folder, {json.dumps(spec.module)},
                      {json.dumps(spec.class_name)})


_CLASS = globals().get("_CLASS") or _start()
{spec.class_name} = _CLASS
globals().setdefault("_KEPT", []).append(globals())
"""
    return (_HERE / "bundle_loader.py").read_text(encoding="utf-8") + tail


_DESCRIBE = """
import importlib, pathlib, sys
folder, out, script, name, guid, identifier = sys.argv[1:]
sys.path.insert(0, folder)
made = getattr(importlib.import_module(script), name)(instance_name="description", resources=folder)
base = next(kind for kind in type(made).__mro__ if kind.__name__ == "TableSlave")
home = base.__module__.rpartition(".")[0]
to_bytes = importlib.import_module(home + ".model_description").to_bytes
pathlib.Path(out).write_bytes(to_bytes(made.to_xml({"guid": guid, "identifier": identifier})))
"""


_described: Final[dict[str, bytes]] = {}
"""By GUID, descriptions that this process has had written: `irj export all` packages the same
estimator for itself and for the system, and a GUID stands for all that a slave is made of.
"""
_MOST_DESCRIBED: Final = 64


def _describe(spec: SlaveSpec, resources: Mapping[str, bytes], guid: str) -> bytes:
    """Instantiate the slave in a fresh process, from the bundle alone, and return its
    modelDescription.xml; the same bundle is tried once.
    """
    if guid not in _described:
        made = _instantiated(spec, resources, guid)
        while len(_described) >= _MOST_DESCRIBED:
            _described.pop(next(iter(_described)))
        _described[guid] = made
    return _described[guid]


def _instantiated(spec: SlaveSpec, resources: Mapping[str, bytes], guid: str) -> bytes:
    """What a fresh process writes of the slave."""
    with tempfile.TemporaryDirectory(prefix="irj-slave-") as temporary:
        folder = Path(temporary) / "resources"
        for name, code in resources.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(code)
        checkpoint()
        script = resources["slavemodule.txt"].decode()
        out = Path(temporary) / "out.xml"
        done = subprocess.run(
            [
                sys.executable,
                "-I",
                "-c",
                _DESCRIBE,
                str(folder),
                str(out),
                script,
                spec.class_name,
                guid,
                spec.identifier,
            ],
            cwd=temporary,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0 or not out.is_file():
            lines = done.stderr.strip().splitlines() or ["no message"]
            why, missing, _ = lines[-1].partition("; set IRJ_PYTHON")
            cure = "; install it, or add it to `packages`" if missing else ""
            raise InputError(
                f"slave {spec.module}.{spec.class_name} does not start from its bundle: {why}{cure}"
            )
        return out.read_bytes()


def _libpython_candidates() -> list[str]:
    """Names that the loader of the host looks for; none of them is a path of this machine."""
    current = f"libpython{sys.version_info.major}.{sys.version_info.minor}.so.1.0"
    return list(dict.fromkeys([current, *(f"libpython3.{minor}.so.1.0" for minor in (13, 12, 11))]))


def _kinds(description: ElementTree.Element) -> str:
    """The first letter of the type of each value reference; a blank where there is none."""
    letters = {"Real": "R", "Integer": "I", "Enumeration": "I", "Boolean": "B", "String": "S"}
    found = {
        int(v.attrib["valueReference"]): letters[t.tag]
        for v in description.iter("ScalarVariable")
        for t in v
        if t.tag in letters
    }
    return "".join(found.get(i, " ") for i in range(max(found, default=-1) + 1))


def _compile_shim(
    spec: SlaveSpec,
    description: bytes,
    needed: Iterable[str],
    cc: str | None,
    main: str = "slave_shim.c",
) -> bytes:
    root = ElementTree.fromstring(description)
    quoted = ", ".join(json.dumps(path, ensure_ascii=False) for path in _libpython_candidates())
    defined = {
        "INNER_LIBRARY": json.dumps(_inner_name(spec)),
        "GUID": json.dumps(root.attrib["guid"]),
        "KINDS": json.dumps(_kinds(root)),
        "MODULES": json.dumps(" ".join(needed)),
        "LIBPYTHON_CANDIDATES": quoted,
        "VR_TIME": f"{time_reference(root)}u",
    }
    config = "".join(f"#define {name} {text}\n" for name, text in defined.items())
    sources = {name: (_HERE.parent / "c" / name).read_bytes() for name in (main, *_SHIM_PARTS)} | {
        "shim_config.h": config.encode()
    }
    return compile_library(sources, main, _SHIM_TARGET, cc=cc, libraries=("dl", "pthread"))
