"""Parquet tables, by pyarrow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from identification.data.read._table import Table, missing_package
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


def open_parquet(path: Path) -> Table:
    """Open a Parquet file; columns are loaded when asked for, units come from a field's ``unit``
    metadata.

    Raises
    ------
    InputError
        If pyarrow is missing or the file is damaged.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise missing_package("pyarrow", "parquet", "Parquet files", str(path)) from None
    try:
        schema = pq.read_schema(path)
    except MemoryError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(
            f"{path}: is not a readable Parquet file ({_line(error)}): save it again"
        ) from None

    def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        try:
            table = pq.read_table(path, columns=[*numeric, *text], use_threads=False)
        except MemoryError:
            raise
        except (pa.ArrowException, OSError, ValueError) as error:
            raise InputError(f"{path}: is damaged ({_line(error)}): save it again") from None
        result = {name: _array(table.column(name), path, name) for name in numeric}
        result.update(
            {name: np.array([str(v) for v in table.column(name).to_pylist()]) for name in text}
        )
        return result

    def _array(column: Any, where: Path, name: str) -> npt.NDArray[np.float64]:
        kind = column.type
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            nanoseconds = column.cast(
                pa.timestamp("ns") if pa.types.is_timestamp(kind) else pa.duration("ns")
            )
            stamps = nanoseconds.cast(pa.int64()).to_numpy()
            return np.asarray((stamps - stamps[:1]) * 1e-9, dtype=np.float64)
        try:
            return np.asarray(column.cast(pa.float64()).to_numpy(), dtype=np.float64)
        except pa.ArrowException:
            raise InputError(
                f"{where}: column {name!r} is of type {kind}, not numeric: choose another"
            ) from None

    units: dict[str, str] = {}
    for field in schema:
        for key in (b"unit", b"units"):
            if field.metadata and key in field.metadata:
                units[field.name] = field.metadata[key].decode("utf-8", "replace")
        if pa.types.is_timestamp(field.type) or pa.types.is_duration(field.type):
            units[field.name] = "s"
    return Table("Parquet", tuple(schema.names), load, units)


def _line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
