"""FMU archives: the same bytes from the same content, and never half a file."""

from __future__ import annotations

import os
import tempfile
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path

from identification.errors import InputError

_DATE = (1980, 1, 1, 0, 0, 0)
_NAMESPACE = uuid.UUID("2f1f5fd4-6d0b-5d0c-9c0e-6c2b7a1d9e35")


def content_guid(content: Mapping[str, bytes]) -> str:
    """Return the version 5 UUID of names and bytes, in the order of the names."""
    parts = [f"{name}\0{len(content[name])}\0".encode() + content[name] for name in sorted(content)]
    return str(uuid.uuid5(_NAMESPACE, b"".join(parts).hex()))


def write_archive(out: Path, content: Mapping[str, bytes], suffix: str = ".fmu") -> Path:
    """Write a zip with fixed dates and sorted names beside `out`, then rename it into place.

    Parameters
    ----------
    out : Path
        File to write; its folder is made where it is missing.
    content : mapping
        Name inside the archive to bytes.
    suffix : str
        Suffix the file must have.

    Returns
    -------
    Path
        The absolute path of the file.

    Raises
    ------
    InputError
        Where the suffix is wrong or the folder cannot be written.
    """
    out = Path(out).absolute()
    if out.suffix != suffix:
        raise InputError(f"{out}: the file name must end in {suffix}")
    temporary: str | None = None
    made = [folder for folder in out.parents if not folder.exists()]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{out.stem}-", suffix=".part", dir=out.parent)
        with (
            os.fdopen(handle, "wb") as stream,
            zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name in sorted(content, key=lambda name: (name != "modelDescription.xml", name)):
                entry = zipfile.ZipInfo(name, _DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.create_system = 3
                entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
                archive.writestr(entry, content[name])
        Path(temporary).chmod(0o666 & ~_umask())
        Path(temporary).replace(out)
        temporary, made = None, []
    except OSError as error:
        raise InputError(
            f"{out}: cannot write there ({error.strerror}); choose a writable folder with space "
            "on its disk"
        ) from error
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        for folder in made:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
    return out


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
