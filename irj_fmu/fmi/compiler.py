"""Find a C compiler and build one shared library per platform.

A system compiler builds for the machine it runs on; ``pip install ziglang`` brings a compiler that
builds for all of `TARGETS` and needs no system compiler.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from identification.errors import InputError
from identification.recursive.compiler import compiler_identity, kept
from identification.scratch import outer_folder
from irj_fmu.command_line import checkpoint


@final
@dataclass(frozen=True)
class Target:
    """One platform: its folder under ``binaries/`` and the suffix of a shared library there."""

    triple: str
    folder: str
    suffix: str
    zig: str


TARGETS = {
    target.triple: target
    for target in (
        Target("x86_64-linux-gnu", "linux64", ".so", "x86_64-linux-gnu.2.17"),
        Target("aarch64-linux-gnu", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
        Target("x86_64-windows-gnu", "win64", ".dll", "x86_64-windows-gnu"),
        Target("x86_64-macos", "darwin64", ".dylib", "x86_64-macos"),
        Target("aarch64-macos", "darwin64", ".dylib", "aarch64-macos"),
    )
}
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-shared", "-w")
_FULL = re.compile("No space left|File too large|File size limit|quota exceeded", re.IGNORECASE)
"""What compilers say where a disk, or a user's share of it, takes no more."""
_NO_COMPILER = (
    "no C compiler found for {target}: estimator FMUs still build, plant FMUs need "
    "one; run `pip install ziglang`, or install gcc and pass cc='gcc'"
)


def native_target() -> str:
    """Return the triple of the machine this runs on.

    Raises
    ------
    InputError
        On a platform outside `TARGETS`.
    """
    import platform

    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    system = {"linux": "linux-gnu", "win32": "windows-gnu", "darwin": "macos"}.get(
        sys.platform, sys.platform
    )
    triple = f"{machine}-{system}"
    if triple not in TARGETS:
        raise InputError(
            f"platform {triple} is not supported; name one of {', '.join(TARGETS)} as the target"
        )
    return triple


def has_zig() -> bool:
    """Say whether the ziglang package is installed."""
    return importlib.util.find_spec("ziglang") is not None


def find_compiler(target: str | None = None, cc: str | None = None) -> list[str]:
    """Return the command that compiles for `target`.

    Parameters
    ----------
    target : str, optional
        A key of `TARGETS`; by default the machine this runs on.
    cc : str, optional
        Compiler to use: a command for the native target, or ``"zig"`` for the ziglang package.

    Raises
    ------
    InputError
        Where there is none; the message says what works without and how to get one.
    """
    native = native_target()
    target = target or native
    if target not in TARGETS:
        raise InputError(f"target {target!r} is not known; name one of {', '.join(TARGETS)}")
    zig = [
        sys.executable,
        "-m",
        "ziglang",
        "cc",
        "-target",
        TARGETS[target].zig,
        "-fno-sanitize=all",
    ]
    if cc == "zig" or (cc is None and target != native):
        if has_zig():
            return zig
        raise InputError(_NO_COMPILER.format(target=target))
    if cc is not None and target != native:
        raise InputError(
            f"compiler {cc!r} builds for {native} only; leave `cc` out and run `pip install "
            "ziglang`"
        )
    for candidate in (
        (cc,) if cc is not None else (os.environ.get("CC") or "gcc", "gcc", "cc", "clang")
    ):
        words = (
            [candidate] if shutil.which(candidate) else candidate.split()
        )  # a path may hold spaces
        if words and shutil.which(words[0]):
            own = any(sign and sign in words[0] for sign in (os.sep, os.altsep))
            return [
                os.path.abspath(words[0]) if own else words[0],
                *words[1:],
            ]  # it is started in another folder
    if cc is None and has_zig():
        return zig
    raise InputError(_NO_COMPILER.format(target=target))


def header_folder() -> Path:
    """Return the folder of the FMI 2.0 headers, which the fmpy package ships.

    Raises
    ------
    InputError
        Where fmpy is not installed.
    """
    spec = importlib.util.find_spec("fmpy")
    for root in (spec.submodule_search_locations or []) if spec else []:
        folder = Path(root) / "c-code"
        if (folder / "fmi2Functions.h").is_file():
            return folder
    raise InputError("the FMI 2.0 headers are missing: run `pip install fmpy`, which ships them")


def compile_library(
    sources: Mapping[str, bytes],
    main: str,
    target: str,
    *,
    cc: str | None = None,
    libraries: Sequence[str] = (),
) -> bytes:
    """Compile one C file (others included from it) to a shared library and return its bytes.

    The same sources, compiler and flags are compiled once for each user.

    Parameters
    ----------
    sources : mapping
        File name to content; written to a temporary folder.
    main : str
        The file to compile.
    target : str
        A key of `TARGETS`.
    cc : str, optional
        See `find_compiler`.
    libraries : sequence of str
        System libraries, e.g. ``("m",)``; Linux only.

    Raises
    ------
    InputError
        Where there is no compiler or it refuses the source.
    """
    checkpoint()
    command = find_compiler(target, cc)
    place = TARGETS[target]
    flags = list(_FLAGS)
    if place.suffix == ".so":
        flags += ["-fPIC", "-Wl,--build-id=none", "-s", "-D_GNU_SOURCE"]
    if place.suffix == ".dll":
        flags += ["-s", "-Wl,--no-insert-timestamp"] if "ziglang" not in command else ["-s"]
    if place.suffix == ".dylib":
        flags += ["-s", "-g0", f"-Wl,-install_name,@rpath/model{place.suffix}"]
    links = [f"-l{name}" for name in libraries] if place.suffix == ".so" else []
    headers = header_folder()
    library = f"model{place.suffix}"
    words = [*command, *flags, f"-I{headers}", "-I.", main, "-o", library, *links]

    def made() -> bytes:
        return _compiled(sources, words, library, target)

    if "ziglang" in command:  # several programs, which no one file stands for
        return made()
    told = [part for name in sorted(sources) for part in (name, sources[name])]
    read = [part for h in sorted(headers.glob("fmi*.h")) for part in (h.name, h.read_bytes())]
    identity = [*compiler_identity(tuple(command)), *words[len(command) :], *read, *told]
    return kept("fmu", identity, made)


def _compiled(
    sources: Mapping[str, bytes], words: Sequence[str], library: str, target: str
) -> bytes:
    """What the command makes of the sources, in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="irj-build-") as folder:
        no_room = (
            f"compiler {words[0]!r} has no room for its files in {outer_folder()}; free some "
            "space there, or name another folder with TMPDIR"
        )
        try:
            for name, content in sources.items():
                (Path(folder) / name).write_bytes(content)
        except OSError:
            raise InputError(no_room) from None
        try:
            done = subprocess.run(
                words,
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
                env={**os.environ, "TMPDIR": folder},
            )
        except OSError as error:
            raise InputError(
                f"compiler {words[0]!r} cannot be started ({error.strerror}); check `cc`"
            ) from error
        made = Path(folder) / library
        if done.returncode != 0 or not made.is_file():
            if _FULL.search(done.stderr):
                raise InputError(no_room)
            first = next(
                (line for line in done.stderr.splitlines() if "error" in line),
                done.stderr.strip()[:200],
            )
            said = first or (
                f"it said nothing and ended with {done.returncode}"
                if done.returncode
                else "it made no library"
            )
            raise InputError(
                f"compiler {words[0]!r} failed for {target} ({said}); try it by itself, or give "
                "another one with --cc"
            )
        return made.read_bytes()


def model_code(name: str, functions: Sequence[Any]) -> bytes:
    """C code of CasADi functions, its inner names made of `name`.

    It is taken from memory: a file that CasADi writes on a full disk ends early without a word.
    """
    import casadi as ca

    generator = ca.CodeGenerator(name, {"with_header": False})
    for function in functions:
        generator.add(function)
    return str(generator.dump()).encode()


def universal_library(x86_64: bytes, aarch64: bytes) -> bytes:
    """Join two macOS libraries to one for both processors (Mach-O fat header, mach-o/fat.h)."""
    align = 14
    parts, offset = [], 1 << align
    for cpu, subtype, code in ((0x01000007, 3, x86_64), (0x0100000C, 0, aarch64)):
        parts.append((struct.pack(">5I", cpu, subtype, offset, len(code), align), offset, code))
        offset = (offset + len(code) + (1 << align) - 1) >> align << align
    image = bytearray(
        struct.pack(">2I", 0xCAFEBABE, len(parts)) + b"".join(head for head, _, _ in parts)
    )
    for _, start, code in parts:
        image.extend(bytes(start - len(image)))
        image.extend(code)
    return bytes(image)
