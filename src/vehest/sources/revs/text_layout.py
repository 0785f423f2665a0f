"""The re-laid Revs files: a folder a recording, a text file a channel, a number a line (Leanza, Reina & Blanco-Claraco 2021)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.sources.tables import TextLayout, read_columns


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
    return read_columns(file, ["number"], TextLayout(names=("number",)))["number"]
