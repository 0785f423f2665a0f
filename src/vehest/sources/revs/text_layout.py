"""The re-laid Revs files: a folder a recording, a text file a channel, a number a line (Leanza, Reina & Blanco-Claraco 2021)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.text_files import first_line
from vehest.sources.text_tables import check_size

LONGEST_LINE = 1 << 12  # bytes


def text_file(folder: Path, column: str) -> Path:
    """Where a column stands."""
    return folder / f"{column}.txt"


def read_text_columns(folder: Path, columns: Iterable[str], time: str) -> dict[str, FloatArray]:
    """Columns of a recording, shape (T,) each, in the units of the files; the column of time among them.

    Raises:
        DataError: a file holds something else than one number a line, or not as many as the file of time.
    """
    values = {time: _read_numbers(text_file(folder, time))}
    for column in columns:
        if column in values:
            continue
        values[column] = _read_numbers(text_file(folder, column))
        if len(values[column]) != len(values[time]):
            raise DataError(
                f"'{text_file(folder, column)}' holds {len(values[column])} samples, the time file {len(values[time])}; "
                f"the copy is incomplete"
            )
    return values


def _read_numbers(file: Path) -> FloatArray:
    """One number a line."""
    check_size(file, 1, LONGEST_LINE)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there are no numbers is said below
            values = np.loadtxt(file, dtype=np.float64, ndmin=1, encoding="utf-8-sig")
    except OSError as error:
        raise DataError(f"'{file}' cannot be read ({error.strerror or error}); check the disk and its permissions") from None
    except (ValueError, OverflowError, MemoryError) as error:
        raise DataError(f"'{file}' holds something that is not a number ({first_line(error)}); repair or remove the line") from None
    if values.size == 0:
        raise DataError(f"'{file}' holds no numbers; the copy is incomplete")
    if values.ndim != 1:
        raise DataError(f"'{file}' holds {values.shape[1]} numbers a line; one is expected")
    return values
