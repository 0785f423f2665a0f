"""Which rows of a table count, and which of them are one uninterrupted run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.sources.columns import Column, Positive

RANGE = re.compile(r"([1-9]\d*)(?:-(\d*))?")


@dataclass(frozen=True)
class TimeColumn(Column):
    """Declaration of a table's column of times."""

    wraps_at: Positive | None = None  # count, in the column's unit, at which it begins anew
    sort: bool = False  # whether rows are brought into the order of their times

    def in_order(self, values: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Columns of a table, (T,) each, with times that go on where they wrapped, sorted."""
        times = values[self.column]
        if self.wraps_at is not None:
            times = unwrapped(times, self.wraps_at)
        ordered = {**values, self.column: times}
        if self.sort:
            rows = np.argsort(times, kind="stable")
            ordered = {name: samples[rows] for name, samples in ordered.items()}
        return ordered


def unwrapped(times: FloatArray, wraps_at: float) -> FloatArray:
    """Times, (T,), of a counter that begins anew at a count, going on there."""
    wraps = np.cumsum(np.diff(times, prepend=times[:1]) < -0.5 * wraps_at)
    return np.asarray(times + wraps_at * wraps, dtype=np.float64)


def dropped_rows_from_config(
    entries: Mapping[str, Iterable[int | str]], where: str
) -> dict[str, list[slice]]:
    """Rows that a data set leaves out, by their file's stem: numbers from 1 below the header, or ranges; raises `ConfigurationError`."""
    return {
        str(stem): [_rows(row, f"{where}: drop_rows of '{stem}'") for row in rows]
        for stem, rows in entries.items()
    }


def _rows(row: int | str, where: str) -> slice:
    found = RANGE.fullmatch(str(row).strip())
    first, last = found.groups(default=found[1]) if found else ("", "")
    if not first or (last and int(last) < int(first)):
        raise ConfigurationError(
            f'{where}: \'{row}\' is neither a data row, counted from 1, nor a range such as "700-750" or "700-"'
        )
    return slice(int(first) - 1, int(last) if last else None)


def kept_rows(n_rows: int, dropped: Iterable[slice], file: Path) -> NDArray[np.bool_]:
    """Which rows count, shape (n_rows,); raises `DataError` where the table has no such row."""
    kept = np.ones(n_rows, dtype=np.bool_)
    for rows in dropped:
        last = rows.stop or rows.start + 1
        if last > n_rows:
            raise DataError(
                f"'{file}' has {n_rows} data rows, and drop_rows names row {last}; is it another version of the file?"
            )
        kept[rows] = False
    return kept


def counted_runs(numbers: FloatArray, column: str, file: Path) -> dict[int | None, slice]:
    """Rows of each run that a column of whole numbers counts; raises `DataError` where a number is none, or a run begins again."""
    odd = np.flatnonzero(~(np.isfinite(numbers) & (numbers == np.rint(numbers))))
    if len(odd):
        where = f"column '{column}' holds {numbers[odd[0]]} in data row {odd[0] + 1}"
        raise DataError(f"'{file}': {where}; runs are counted in whole numbers")
    runs: dict[int | None, slice] = {}
    for rows in stretches(np.diff(numbers) != 0, len(numbers)):
        run = int(numbers[rows.start])
        if run in runs:
            raise DataError(
                f"'{file}': run {run} begins again in data row {rows.start + 1}; a run is uninterrupted, sort the rows"
            )
        runs[run] = rows
    return runs


def timed_runs(
    times: FloatArray, max_gap: float | None, *, restarts: bool
) -> dict[int | None, slice]:
    """Rows of each run, which begins where times [s], (N,), go backwards, if ``restarts``, or leave a gap longer than ``max_gap`` [s].

    Pieces between gaps that last less than ``max_gap`` are left out.
    """
    steps = np.diff(times)
    begins = (steps < 0) & restarts
    if max_gap is None:
        return {**dict(enumerate(stretches(begins, len(times))))}
    runs = stretches(begins | (steps > max_gap), len(times))
    return {
        **dict(
            enumerate(rows for rows in runs if times[rows.stop - 1] - times[rows.start] >= max_gap)
        )
    }


def stretches(begins: NDArray[np.bool_], n_rows: int) -> list[slice]:
    """Rows of uninterrupted runs in their order, of whether a run begins with the next row, (N - 1,)."""
    edges = np.concatenate([[0], np.flatnonzero(begins) + 1, [n_rows]]).tolist()
    return [slice(first, last) for first, last in pairwise(edges)]
