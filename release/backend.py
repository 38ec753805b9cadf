"""Setuptools, with a source archive and a wheel that are the same on every machine and at every
time: those of setuptools hold the owner, the rights and the moment of every file.
"""

from __future__ import annotations

import gzip
import io
import os
import tarfile
import time
import zipfile
from pathlib import Path
from typing import Any

from setuptools.build_meta import *  # noqa: F403  (every hook but the two below)
from setuptools.build_meta import build_sdist as _build_sdist
from setuptools.build_meta import build_wheel as _build_wheel

EPOCH = 1_577_836_800
"""2020-01-01 in seconds: the moment of every file, unless SOURCE_DATE_EPOCH gives another."""


def moment() -> int:
    """The moment that every file of an archive gets."""
    return int(os.environ.get("SOURCE_DATE_EPOCH", EPOCH))


def normalised(archive: bytes) -> bytes:
    """A .tar.gz with its files in order, without owner, rights and moment."""
    out = io.BytesIO()
    with (
        tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as source,
        gzip.GzipFile(fileobj=out, mode="wb", filename="", mtime=moment()) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as target,
    ):
        for entry in sorted(source.getmembers(), key=lambda e: e.name):
            entry.uid = entry.gid = 0
            entry.uname = entry.gname = ""
            entry.mtime = moment()
            entry.pax_headers = {}
            entry.mode = 0o755 if entry.isdir() or entry.mode & 0o100 else 0o644
            target.addfile(entry, source.extractfile(entry) if entry.isfile() else None)
    return out.getvalue()


def normalised_wheel(archive: bytes) -> bytes:
    """A wheel with its files in order, without rights and moment."""
    out = io.BytesIO()
    when = time.gmtime(max(moment(), 315_532_800))[:6]  # a zip file begins in 1980
    with (
        zipfile.ZipFile(io.BytesIO(archive)) as source,
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for name in sorted(source.namelist()):
            entry = zipfile.ZipInfo(name, when)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = 0o100644 << 16
            target.writestr(entry, source.read(name))
    return out.getvalue()


def build_sdist(sdist_directory: str, config_settings: Any = None) -> str:
    """As setuptools does, then in order."""
    name = _build_sdist(sdist_directory, config_settings)
    path = Path(sdist_directory) / name
    path.write_bytes(normalised(path.read_bytes()))
    return name


def build_wheel(
    wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None
) -> str:
    """As setuptools does, then in order."""
    name = _build_wheel(wheel_directory, config_settings, metadata_directory)
    path = Path(wheel_directory) / name
    path.write_bytes(normalised_wheel(path.read_bytes()))
    return name
