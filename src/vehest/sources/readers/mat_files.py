"""Channels of a MAT file, structs with values and times, by SciPy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.limits import check_limit
from vehest.sources.limited import Arrays


def read_channels(file: Path, columns: Sequence[str], time: str) -> tuple[Arrays, dict[str, Any]]:
    """Values and times of channels, structs with a field ``value`` and one of times; raises `DataError` where one is missing or ambiguous.

    Args:
        file: of version 5 to 7.
        columns: names, ``STRUCT.CHANNEL`` or ``CHANNEL`` where only one struct has it.
        time: name of the field of times.

    Returns:
        ``COLUMN.value`` and ``COLUMN.time``, and the name ``STRUCT.CHANNEL`` of each column.
    """
    try:
        content = loadmat(file, simplify_cells=True)
    except NotImplementedError:
        raise DataError(f"'{file}' is of version 7.3 (HDF5), which is not read; save it with -v7 in MATLAB, or set layout: csv") from None
    structs = {outer: fields for outer, fields in content.items() if isinstance(fields, dict)}
    inside = {f"{outer}.{inner}": field for outer, fields in structs.items() for inner, field in fields.items()}
    channels = {name: field for name, field in inside.items() if isinstance(field, dict) and time in field}
    arrays, names = Arrays(), {}
    for column in columns:
        found = [name for name in channels if column in (name, name.split(".", 1)[1])]
        if len(found) > 1:
            raise DataError(f"'{file}' has '{column}' more than once ({', '.join(found)}); name its struct too, as in '{found[0]}'")
        if not found:
            have = ", ".join(list(inside)[:12]) or "no structs"
            raise DataError(f"'{file}' has no channel '{column}' with a field '{time}' (it has {have}); correct the map in conf/dataset")
        names[column] = found[0]
        for part, key in (("value", "value"), ("time", time)):
            arrays[f"{column}.{part}"] = _numbers(channels[found[0]].get(key), f"'{file}': '{found[0]}.{key}'")
        counts = [len(arrays[f"{column}.{part}"]) for part in ("value", "time")]
        if counts[0] != counts[1]:
            raise DataError(f"'{file}': '{found[0]}' holds {counts[0]} values and {counts[1]} time stamps; fetch the file again")
    return arrays, {"names": names}


def _numbers(values: Any, where: str) -> FloatArray:
    """Real numbers in a row or column, shape (T,)."""
    numbers = np.atleast_1d(values)
    if numbers.ndim != 1 or numbers.dtype.kind not in "biuf":
        raise DataError(f"{where} is no row or column of real numbers")
    check_limit("samples", len(numbers), f"{where} holds {len(numbers)} numbers")
    return numbers.astype(np.float64)
