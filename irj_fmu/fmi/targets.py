"""Platforms by the names of their folders in an FMU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from identification.errors import InputError
from irj_fmu.fmi.compiler import TARGETS, native_target, universal_library

SHORT_TARGETS: Final = {
    "linux64": ("x86_64-linux-gnu",),
    "win64": ("x86_64-windows-gnu",),
    "darwin64": ("x86_64-macos", "aarch64-macos"),
    "aarch64-linux": ("aarch64-linux-gnu",),
}
"""Names of folders below ``binaries/`` to the targets whose libraries lie there."""

FMI3_FOLDERS: Final = {
    "x86_64-linux-gnu": "x86_64-linux",
    "aarch64-linux-gnu": "aarch64-linux",
    "x86_64-windows-gnu": "x86_64-windows",
    "x86_64-macos": "x86_64-darwin",
    "aarch64-macos": "aarch64-darwin",
}
"""Folders below ``binaries/`` in FMI 3.0, by target."""


def native_targets(target: str | Sequence[str] | None) -> tuple[str, ...]:
    """Targets by their names, short ones included.

    Raises
    ------
    InputError
        A name that is neither in `irj_fmu.fmi.compiler.TARGETS` nor in :data:`SHORT_TARGETS`.
    """
    if target is None:
        return (native_target(),)
    names = (target,) if isinstance(target, str) else tuple(target)
    found: list[str] = []
    for name in names:
        if name == "all":
            found += list(TARGETS)
        elif name in SHORT_TARGETS:
            found += SHORT_TARGETS[name]
        elif name in TARGETS:
            found.append(name)
        else:
            raise InputError(
                f"target {name!r} is not known; name one of "
                f"{', '.join((*SHORT_TARGETS, *TARGETS))}, or all"
            )
    return tuple(dict.fromkeys(found))


def binaries(built: Mapping[str, bytes], name: str, *, version: int = 2) -> dict[str, bytes]:
    """Libraries by their paths in an FMU.

    Parameters
    ----------
    built : mapping of str to bytes
        Library of each target.
    name : str
        Model identifier.
    version : int
        Of FMI: in 2 both macOS targets together are one library for both processors.
    """
    libraries = dict(built)
    both = SHORT_TARGETS["darwin64"]
    if version == 2 and all(triple in libraries for triple in both):
        libraries[both[0]] = universal_library(libraries[both[0]], libraries.pop(both[1]))
    folders = FMI3_FOLDERS if version == 3 else {t: TARGETS[t].folder for t in libraries}
    return {
        f"binaries/{folders[triple]}/{name}{TARGETS[triple].suffix}": library
        for triple, library in libraries.items()
    }


__all__ = ["FMI3_FOLDERS", "SHORT_TARGETS", "binaries", "native_targets"]
