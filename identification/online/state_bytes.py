"""A state as bytes and back, bit by bit: named arrays, named byte strings, and one JSON object."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]
_MAGIC: Final = b"IRJSTATE"
_HEAD: Final = struct.Struct("<8sII")


def pack(
    plain: Mapping[str, Any], arrays: Mapping[str, FloatArray], parts: Mapping[str, bytes]
) -> bytes:
    """Bytes of a state. Floats in `plain` keep every bit too (JSON writes their shortest exact
    form).
    """
    held = {name: np.ascontiguousarray(values, dtype="<f8") for name, values in arrays.items()}
    about = {
        "plain": dict(plain),
        "arrays": {k: list(v.shape) for k, v in held.items()},
        "parts": {k: len(v) for k, v in parts.items()},
    }
    head = json.dumps(about).encode()
    body = head + b"".join(v.tobytes() for v in held.values()) + b"".join(parts.values())
    return _HEAD.pack(_MAGIC, len(head), zlib.crc32(body)) + body


def unpack(state: bytes) -> tuple[dict[str, Any], dict[str, FloatArray], dict[str, bytes]]:
    """What :func:`pack` packed.

    Raises
    ------
    InputError
        The bytes are damaged or no state.
    """
    if len(state) < _HEAD.size or state[:8] != _MAGIC:
        raise InputError(
            "restore: these bytes are no state of an estimator; give what its state gave"
        )
    _, size, crc = _HEAD.unpack_from(state)
    body = bytes(state[_HEAD.size :])
    if zlib.crc32(body) != crc:
        raise InputError("restore: the state is damaged; give the bytes that were saved")
    about, at = json.loads(body[:size]), size
    arrays: dict[str, FloatArray] = {}
    for name, shape in about["arrays"].items():
        length = 8 * int(np.prod(shape))
        arrays[name] = np.frombuffer(body[at : at + length], dtype="<f8").reshape(shape).copy()
        at += length
    parts: dict[str, bytes] = {}
    for name, length in about["parts"].items():
        parts[name] = body[at : at + length]
        at += length
    return about["plain"], arrays, parts
