"""The state of the online estimator: what changes from sample to sample, and from row to row; and
any state as bytes and back, bit by bit.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final, TypeVar, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.online.verdict import NONE

FloatArray = npt.NDArray[np.float64]
Part = TypeVar("Part", "Sample", "State")
_MAGIC: Final = b"IRJSTATE"
_HEAD: Final = struct.Struct("<8sII")


@final
@dataclass(frozen=True, slots=True)
class Sample:
    """What a sample leaves behind; a part of its own, as it changes a thousand times a second.

    Attributes
    ----------
    since : int
        Samples since the last row.
    last_good : list of float
        The last good value of each reading.
    readings : list of float
        The readings, failed ones replaced.
    """

    since: int
    last_good: list[float]
    readings: list[float]

    @classmethod
    def first(cls) -> Sample:
        """Before the first sample."""
        return cls(0, [0.0] * 6, [0.0] * 6)


@final
@dataclass(frozen=True, slots=True)
class State:
    """What a row leaves behind, besides the parts that keep their own state (samples, rows, watch,
    recursion, guard, detector, search).

    Attributes
    ----------
    rows : int
        Rows so far.
    strained : int
        Rows in a row whose residual is over its limit.
    fault, plant_alarm : int
        Codes; see :mod:`identification.online.verdict`.
    score : list of float
        How far each reading's residuals are from their limits (1: at the limit).
    events : tuple of str
        What was told.
    theta, sigma, scale : (parameters,) array
        Estimate, its standard deviation, and the scale of the recursion.
    residual, floor, ratio, level : (balances,) array
        Of the last row; noise; root mean square of the last seconds over the floor; size of the
        residual after the first window.
    square, torque : (balances,) array
        Mean squares of the last seconds, of the residual and of what it refers to.
    """

    rows: int
    strained: int
    fault: int
    plant_alarm: int
    score: list[float]
    events: tuple[str, ...]
    theta: FloatArray
    sigma: FloatArray
    scale: FloatArray
    residual: FloatArray
    floor: FloatArray
    ratio: FloatArray
    level: FloatArray
    square: FloatArray
    torque: FloatArray

    @classmethod
    def first(cls, theta: FloatArray, balances: int) -> State:
        """Before the first sample.

        Parameters
        ----------
        theta : (parameters,) array
            Values of the joint file.
        balances : int
        """
        return cls(
            rows=0,
            strained=0,
            fault=NONE,
            plant_alarm=NONE,
            score=[0.0] * 6,
            events=(),
            theta=theta,
            sigma=np.zeros(len(theta)),
            scale=np.ones(len(theta)),
            residual=np.zeros(balances),
            floor=np.zeros(balances),
            ratio=np.zeros(balances),
            level=np.zeros(balances),
            square=np.zeros(balances),
            torque=np.zeros(balances),
        )


def parted(*parts: Sample | State) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Plain values and arrays of states, by the names of their fields."""
    values = {f.name: getattr(part, f.name) for part in parts for f in fields(part)}
    arrays = {n: v for n, v in values.items() if isinstance(v, np.ndarray)}
    return {n: v for n, v in values.items() if n not in arrays}, arrays


def joined(kind: type[Part], plain: Mapping[str, Any], arrays: Mapping[str, FloatArray]) -> Part:
    """A state from what :func:`parted` gave (JSON makes tuples lists)."""
    values: dict[str, Any] = {
        f.name: plain[f.name] if f.name in plain else arrays[f.name] for f in fields(kind)
    }
    if "events" in values:
        values["events"] = tuple(values["events"])
    return kind(**values)


# --- bytes ----------------------------------------------------------------------------------------


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


__all__ = ["Sample", "State", "joined", "pack", "parted", "unpack"]
