"""Channels of a MAT file, structs with values and times, by SciPy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.limits import check_limit
from vehest.sources.limited import Arrays


def read_channels(file: Path, columns: Sequence[str], value: str, time: str) -> tuple[Arrays, dict[str, Any]]:
    """Values and times of channels.

    Args:
        file: of version 5 to 7.
        columns: names, ``STRUCT.CHANNEL`` or ``CHANNEL`` where only one struct with times has it.
        value: name of the field of values.
        time: name of the field of times.

    Returns:
        ``COLUMN.value`` and ``COLUMN.time``, and the name ``STRUCT.CHANNEL`` of each column.

    Raises:
        DataError: it is of another format, or a channel is not there, ambiguous, or no row or column of real numbers.
    """
    try:
        content = loadmat(file, simplify_cells=True)
    except NotImplementedError:
        raise DataError(
            f"'{file}' is a MAT file of version 7.3 (HDF5), which is not read; save it with -v7 in MATLAB, or set layout: csv"
        ) from None
    inside = {f"{outer}.{inner}": field for outer, fields in content.items() if isinstance(fields, dict) for inner, field in fields.items()}
    arrays, names = Arrays(), {}
    for column in columns:
        name, fields = _found(file, inside, column, time)
        names[column] = name
        for part in (value, time):
            if part not in fields:
                have = ", ".join(fields) or "none: it is no struct"
                raise DataError(f"'{file}': '{name}' has no field '{part}' (it has {have}); correct the map in conf/dataset")
            arrays[f"{column}.{part}"] = _numbers(fields[part], f"'{file}': '{name}.{part}'")
        if len(arrays[f"{column}.{value}"]) != len(arrays[f"{column}.{time}"]):
            counts = f"{len(arrays[f'{column}.{value}'])} values and {len(arrays[f'{column}.{time}'])} time stamps"
            raise DataError(f"'{file}': '{name}' holds {counts}; fetch the file again")
    return arrays, {"names": names}


def _found(file: Path, inside: dict[str, Any], column: str, time: str) -> tuple[str, dict[str, Any]]:
    """A column's name with its struct, and its fields; parameters of the same name, which have no time, do not count."""
    found = dict(_matching(inside, column))
    timed = {name: fields for name, fields in found.items() if time in fields} or found
    if len(timed) > 1:
        raise DataError(f"'{file}' has '{column}' more than once ({', '.join(timed)}); name its struct too, as in '{next(iter(timed))}'")
    if not timed:
        have = ", ".join(list(inside)[:12]) + (", …" if len(inside) > 12 else "") if inside else "no structs"
        raise DataError(f"'{file}' has no channel '{column}' (it has {have}); correct the map in conf/dataset")
    return next(iter(timed.items()))


def _matching(inside: dict[str, Any], column: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, field in inside.items():
        if column in (name, name.split(".", 1)[1]):
            yield name, field if isinstance(field, dict) else {}


def _numbers(values: Any, where: str) -> FloatArray:
    """Real numbers in a row or column, shape (T,)."""
    numbers = np.atleast_1d(values)
    if numbers.ndim != 1 or numbers.dtype.kind not in "biuf":
        raise DataError(f"{where} is no row or column of real numbers")
    check_limit("samples", len(numbers), f"{where} holds {len(numbers)} numbers")
    return numbers.astype(np.float64)
