"""What an installation is made of, and whether it can be made again.

``python release/supply.py sbom``      bill of materials of this environment, CycloneDX 1.5
``python release/supply.py sizes``     what an installation takes on the disk, and who brings it
``python release/supply.py pins``      versions of this environment as upper bounds for CI
``python release/supply.py build``     source archive and wheel twice, byte for byte the same
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from importlib.metadata import Distribution, PackageNotFoundError, distribution, distributions
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[1]
NAME: Final = "irj"
TOOLS: Final = ("pip", "setuptools", "wheel")
_REQUIREMENT: Final = re.compile(r"\s*([A-Za-z0-9][A-Za-z0-9._-]*)\s*(?:\[([^\]]*)\])?")
_EXTRA: Final = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


def plain(name: str) -> str:
    """A name as registries compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def needed(found: Distribution, extras: frozenset[str]) -> Iterator[tuple[str, frozenset[str]]]:
    """What a distribution requires, with the extras asked for; markers of other systems are left
    out where what they name is not installed.
    """
    for text in found.requires or ():
        requirement, _, marker = text.partition(";")
        wanted = set(_EXTRA.findall(marker))
        if wanted and not wanted & extras:
            continue
        match = _REQUIREMENT.match(requirement)
        if match is None:
            continue
        inner = frozenset(e.strip() for e in (match[2] or "").split(",") if e.strip())
        yield plain(match[1]), inner


def closure(name: str = NAME, extras: frozenset[str] = frozenset()) -> dict[str, set[str]]:
    """Installed distributions that one brings, each with those that require it."""
    found: dict[str, set[str]] = {}
    done: set[tuple[str, frozenset[str]]] = set()
    left = [(plain(name), extras, "")]
    while left:
        own, asked, by = left.pop()
        try:
            held = distribution(own)
        except PackageNotFoundError:
            continue  # for another system, or another Python
        found.setdefault(own, set()).add(by)
        if (own, asked) not in done:
            done.add((own, asked))
            left += [(other, inner, own) for other, inner in needed(held, asked)]
    return found


def size_of(found: Distribution) -> int:
    """Bytes of the files of a distribution."""
    paths = (Path(str(found.locate_file(f))) for f in found.files or ())
    return sum(p.stat().st_size for p in paths if p.is_file())


def licence(found: Distribution) -> str:
    """What a distribution says of its licence."""
    about = found.metadata
    if said := about.get("License-Expression"):
        return str(said)
    words = [
        c.rpartition(" :: ")[2] for c in about.get_all("Classifier") or () if "License ::" in c
    ]
    first = (about.get("License") or "").strip().splitlines()
    return "; ".join(words) or (first[0][:80] if first else "unknown")


def sbom(extras: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Bill of materials of the installed project (CycloneDX 1.5)."""
    brought = closure(extras=extras)
    reference = {n: f"pkg:pypi/{n}@{distribution(n).version}" for n in brought}

    def component(name: str) -> dict[str, Any]:
        held = distribution(name)
        return {
            "type": "application" if name == NAME else "library",
            "name": name,
            "version": held.version,
            "purl": reference[name],
            "bom-ref": reference[name],
            "licenses": [{"license": {"name": licence(held)}}],
        }

    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": component(NAME)},
        "components": [component(n) for n in sorted(brought) if n != NAME],
        "dependencies": [
            {
                "ref": reference[n],
                "dependsOn": sorted(reference[m] for m, by in brought.items() if n in by),
            }
            for n in sorted(brought)
        ],
    }


def sizes(extras: frozenset[str] = frozenset()) -> list[tuple[str, float, str]]:
    """Name, MB and who requires it, the largest first."""
    rows = [
        (n, size_of(distribution(n)) / 1e6, ", ".join(sorted(by - {""})))
        for n, by in closure(extras=extras).items()
    ]
    return sorted(rows, key=lambda r: -r[1])


def pins() -> str:
    """Versions of this environment as upper bounds.

    A bound and not one version, for a Python for which that version was not built takes the one
    before it; newer ones than those that were tried do not come in.
    """
    found = {plain(d.metadata["Name"]): d.version for d in distributions()}
    lines = [f"{n}<={v}" for n, v in sorted(found.items()) if n not in (NAME, *TOOLS)]
    return "\n".join(lines) + "\n"


def copied(tree: Path) -> None:
    """The files under version control, as they are now."""
    names = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True
    ).stdout.decode()
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, tree / name)


def built(files: Path, folder: Path) -> Mapping[str, str]:
    """SHA-256 of the source archive and of the wheels made from the tree and from the archive."""
    environment = {
        k: v for k, v in os.environ.items() if k not in ("SOURCE_DATE_EPOCH", "PYTHONPATH")
    }
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    tree = folder / "tree"
    shutil.copytree(files, tree, copy_function=shutil.copyfile)
    code = (
        "import sys; sys.path.insert(0, 'release'); import backend; "
        f"backend.build_sdist({str(folder)!r})"
    )
    maker = folder / "maker"
    subprocess.run([sys.executable, "-m", "venv", str(maker)], check=True)
    python = str(maker / "bin" / "python")
    subprocess.run(
        [python, "-m", "pip", "--disable-pip-version-check", "install", "-q", "setuptools>=77"],
        check=True,
    )
    subprocess.run([python, "-c", code], cwd=tree, env=environment, check=True, capture_output=True)
    (archive,) = folder.glob("*.tar.gz")
    out = {archive.name: archive.read_bytes()}
    for what, source in (("tree", tree), ("archive", archive)):
        target = folder / f"wheel-{what}"
        command = [*pip, "wheel", "-q", "--no-deps", "--no-cache-dir", "-w", str(target)]
        subprocess.run([*command, str(source)], env=environment, check=True)
        (wheel,) = target.glob("*.whl")
        out[f"{wheel.name} of the {what}"] = wheel.read_bytes()
    return {name: hashlib.sha256(content).hexdigest() for name, content in out.items()}


def build() -> int:
    """Build twice, at different times and in different folders; 1 where anything differs."""
    found = []
    with tempfile.TemporaryDirectory() as place:
        files = Path(place) / "files"
        copied(files)
        for mask in (0o022, 0o077):
            before = os.umask(mask)
            try:
                with tempfile.TemporaryDirectory() as folder:
                    found.append(built(files, Path(folder)))
            finally:
                os.umask(before)
    for name, digest in found[0].items():
        print(f"{digest} {name}{'' if found[1][name] == digest else ' DIFFERS'}")
    wheels = {digest for name, digest in found[0].items() if ".whl" in name}
    same = found[0] == found[1] and len(wheels) == 1
    print("the same twice" if same else "not reproducible")
    return 0 if same else 1


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(prog="python release/supply.py", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("what", choices=("sbom", "sizes", "pins", "build"))
    parser.add_argument("--extras", default="", help="extras of irj, as app,formats")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    extras = frozenset(e.strip() for e in arguments.extras.split(",") if e.strip())
    if arguments.what == "build":
        return build()
    if arguments.what == "sizes":
        rows = sizes(extras)
        text = "".join(f"{mb:8.1f} MB  {name:<24} {by}\n" for name, mb, by in rows)
        text += f"{sum(mb for _, mb, _ in rows):8.1f} MB  in all\n"
    elif arguments.what == "pins":
        text = pins()
    else:
        text = json.dumps(sbom(extras), indent=1) + "\n"
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")
    else:
        sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
