"""Which rows of a table count, and which of them are one uninterrupted run."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError

RANGE = re.compile(r"(\d+)-(\d*)")


def dropped_rows_from_config(entries: Any, where: str) -> dict[str, tuple[tuple[int, float], ...]]:
    """Rows that a data set leaves out, by the stem of their file: first and last of each range, counted from 1 below the header.

    Raises:
        ConfigurationError: a row is neither a number nor a range such as ``"700-750"`` or ``"8143-"``, the rest of the file.
    """
    return {str(stem): tuple(_rows(row, f"{where}: drop_rows of '{stem}'") for row in rows) for stem, rows in entries.items()}


def _rows(entry: Any, where: str) -> tuple[int, float]:
    if isinstance(entry, int) and not isinstance(entry, bool) and entry >= 1:
        return entry, entry
    found = RANGE.fullmatch(str(entry).strip())
    if found is None or isinstance(entry, float | bool):
        raise ConfigurationError(f'{where}: \'{entry}\' is neither a data row, counted from 1, nor a range such as "700-750" or "700-"')
    first, last = int(found[1]), math.inf if not found[2] else int(found[2])
    if not 1 <= first <= last:
        raise ConfigurationError(f"{where}: '{entry}' is no range of data rows, which are counted from 1")
    return first, last


def kept_rows(n_rows: int, dropped: tuple[tuple[int, float], ...], file: Path) -> NDArray[np.bool_]:
    """Which rows count, shape (n_rows,).

    Raises:
        DataError: the table has no such row.
    """
    number = np.arange(1, n_rows + 1)
    kept = np.ones(n_rows, dtype=np.bool_)
    for first, last in dropped:
        if first > n_rows or (math.isfinite(last) and last > n_rows):
            what = first if first > n_rows else last
            raise DataError(f"'{file}' has {n_rows} data rows, and drop_rows names row {what:g}; is it another version of the file?")
        kept &= ~((number >= first) & (number <= last))
    return kept


def counted_runs(numbers: FloatArray, column: str, file: Path) -> dict[int, slice]:
    """Rows of each run that a column of whole numbers counts.

    Raises:
        DataError: a number is none, or a run begins again.
    """
    odd = np.flatnonzero(~(np.isfinite(numbers) & (numbers == np.rint(numbers))))
    if len(odd):
        where = f"column '{column}' holds {numbers[odd[0]]} in data row {odd[0] + 1}"
        raise DataError(f"'{file}': {where}; runs are counted in whole numbers")
    runs: dict[int, slice] = {}
    for start, stop in _stretches(np.diff(numbers) != 0, len(numbers)):
        run = int(numbers[start])
        if run in runs:
            raise DataError(f"'{file}': run {run} begins again in data row {start + 1}; a run is uninterrupted, sort the rows")
        runs[run] = slice(start, stop)
    return runs


def restarted_runs(stamps: FloatArray) -> dict[int, slice]:
    """Rows of each run, counted from 0, where a new one begins as time goes backwards."""
    return {run: slice(*edges) for run, edges in enumerate(_stretches(np.diff(stamps) < 0, len(stamps)))}


def _stretches(begins: NDArray[np.bool_], n_rows: int) -> list[tuple[int, int]]:
    edges = np.concatenate([[0], np.flatnonzero(begins) + 1, [n_rows]]).tolist()
    return list(pairwise(edges))
