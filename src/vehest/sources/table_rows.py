"""Which rows of a table count, and which of them are one uninterrupted run."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.sources.clocks import bridged
from vehest.sources.columns import Column, Positive

Runs = Mapping[int | None, slice]
"""Number of each run -> its rows; None where runs are not distinguished."""
RANGE = re.compile(r"([1-9]\d*)(?:-(\d*))?")  # matches the number of a row, or a range of them


@dataclass(frozen=True)
class TimeColumn(Column):
    """Declaration of a table's column of times."""

    wraps_at: Positive | None = None  # count, in the column's unit, at which it begins anew
    sort: bool = False  # whether rows are brought into the order of their times

    def in_order(self, values: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Columns of a table with times that go on where they wrapped, sorted if declared so.

        Parameters
        ----------
        values : mapping
            Name -> column in the file's unit, shape (T,); it must hold the column of times.

        Returns
        -------
        dict
            Columns, shape (T,) each; rows of equal times keep their order.
        """
        times = values[self.column]
        if self.wraps_at is not None:
            times = unwrapped(times, self.wraps_at)
        ordered = {**values, self.column: times}
        if self.sort:
            rows = np.argsort(times, kind="stable")
            ordered = {name: samples[rows] for name, samples in ordered.items()}
        return ordered


def unwrapped(times: FloatArray, wraps_at: float) -> FloatArray:
    """Times of a counter that begins anew at a count, going on there.

    Parameters
    ----------
    times : FloatArray
        Counts, shape (T,).
    wraps_at : float
        The count at which it begins anew, in the same unit; a step back by more than half of it is
        taken as such.

    Returns
    -------
    FloatArray
        Counts that go on, shape (T,).
    """
    wraps = np.cumsum(np.diff(times, prepend=times[:1]) < -0.5 * wraps_at)
    return times + wraps_at * wraps


def dropped_rows_from_config(
    entries: Mapping[str, Iterable[int | str]], location: str
) -> dict[str, list[slice]]:
    """Rows that a data set leaves out.

    Parameters
    ----------
    entries : mapping
        Stem of a file -> numbers of rows, from 1 below the header, or ranges such as ``700-750``
        and ``700-``, both ends included.
    location : str
        The data set, for messages.

    Returns
    -------
    dict
        Stem -> rows, from 0.

    Raises
    ------
    ConfigurationError
        An entry is neither.
    """
    return {
        str(stem): [_rows(row, f"{location}: drop_rows of '{stem}'") for row in rows]
        for stem, rows in entries.items()
    }


def _rows(row: int | str, location: str) -> slice:
    """Rows, from 0, of a number or range, from 1; raises `ConfigurationError` for any other
    text.
    """
    match = RANGE.fullmatch(str(row).strip())
    first, last = match.groups(default=match[1]) if match else ("", "")
    if not first or (last and int(last) < int(first)):
        raise ConfigurationError(
            f"{location}: '{row}' is neither a data row, counted from 1, nor a range such as "
            '"700-750" or "700-"'
        )
    return slice(int(first) - 1, int(last) if last else None)


def remaining_files(
    files: Sequence[Path], exclude: Collection[str], dropped: Iterable[str], location: str
) -> list[Path]:
    """Files that a data set does not exclude.

    Parameters
    ----------
    files : sequence of Path
        Files of the data set.
    exclude : collection of str
        Patterns over the files' stems, which distinguish upper and lower case.
    dropped : iterable of str
        Stems of files of which rows are left out.
    location : str
        The data set, for messages.

    Raises
    ------
    MissingError
        A pattern, or a stem of ``dropped``, matches no file, or none remains.
    """
    for option, names in (("exclude", exclude), ("drop_rows", dropped)):
        for name in names:
            if not any(name == file.stem or fnmatchcase(file.stem, name) for file in files):
                raise MissingError(f"{location}: {option} names '{name}', which no file is called")
    remaining = [
        file for file in files if not any(fnmatchcase(file.stem, pattern) for pattern in exclude)
    ]
    if not remaining:
        raise MissingError(f"{location}: exclude leaves none of its files")
    return remaining


def remaining_rows(n_rows: int, dropped: Iterable[slice], file: Path) -> NDArray[np.bool_]:
    """Whether each row of a table counts.

    Parameters
    ----------
    n_rows : int
        Number of its rows.
    dropped : iterable of slice
        Rows that are left out, from 0.
    file : Path
        For messages.

    Returns
    -------
    ndarray of bool
        Shape (n_rows,).

    Raises
    ------
    DataError
        The table has no such row.
    """
    is_remaining = np.ones(n_rows, dtype=np.bool_)
    for rows in dropped:
        last = rows.stop or rows.start + 1
        if last > n_rows:
            raise DataError(
                f"'{file}' has {n_rows} data rows, and drop_rows names row {last}; is it another "
                "version of the file?"
            )
        is_remaining[rows] = False
    return is_remaining


def counted_runs(numbers: FloatArray, column: str, file: Path) -> Runs:
    """Rows of each run that a column of whole numbers counts.

    Parameters
    ----------
    numbers : FloatArray
        The column, shape (N,).
    column : str
        Its name, for messages.
    file : Path
        For messages.

    Returns
    -------
    dict
        Number of each run -> its rows, in the order of the file.

    Raises
    ------
    DataError
        A number is none or not whole, or a run begins again after another.
    """
    odd = np.flatnonzero(~(np.isfinite(numbers) & (numbers == np.rint(numbers))))
    if len(odd):
        raise DataError(
            f"'{file}': column '{column}' holds {numbers[odd[0]]} in data row {odd[0] + 1}; runs "
            "are counted in whole numbers"
        )
    runs: dict[int | None, slice] = {}
    for rows in stretches(np.diff(numbers) != 0, len(numbers)):
        run = int(numbers[rows.start])
        if run in runs:
            raise DataError(
                f"'{file}': run {run} begins again in data row {rows.start + 1}; a run is "
                "uninterrupted, sort the rows"
            )
        runs[run] = rows
    return runs


def timed_runs(
    times: FloatArray,
    max_gap: float | None,
    *,
    restarts: bool,
    columns: Iterable[FloatArray] = (),
) -> Runs:
    """Rows of each run of a table.

    Parameters
    ----------
    times : FloatArray
        Times of the rows [s], shape (N,).
    max_gap : float or None
        Longest time without a row, or without a sample of a column, within a run [s]; runs that
        last less are left out.
    restarts : bool
        Whether a run begins where times go backwards; a single row is none.
    columns : iterable of FloatArray
        Columns that must have samples throughout, NaN where there is none, shape (N,) each.
    """
    if max_gap is None:
        runs = stretches((np.diff(times) < 0) & restarts, len(times))
        return {**dict(enumerate(run for run in runs if run.stop - run.start > 1))}
    measured = np.ones(len(times), dtype=np.bool_)
    for column in columns:
        measured &= np.isfinite(bridged(column, times, max_gap))
    rows = np.flatnonzero(measured)
    steps = np.diff(times[rows])
    runs = [
        slice(int(rows[run.start]), int(rows[run.stop - 1]) + 1)
        for run in stretches(((steps < 0) & restarts) | (steps > max_gap), len(rows))
        if run.stop > run.start
    ]
    lasting = [run for run in runs if times[run.stop - 1] - times[run.start] >= max_gap]
    return {**dict(enumerate(lasting))}


def stretches(begins: NDArray[np.bool_], n_rows: int) -> list[slice]:
    """Rows of uninterrupted runs in their order.

    Parameters
    ----------
    begins : ndarray of bool
        Whether a run begins with the next row, shape (N - 1,).
    n_rows : int
        Number of rows, N.

    Returns
    -------
    list of slice
        One at least, even where there are no rows.
    """
    edges = np.concatenate([[0], np.flatnonzero(begins) + 1, [n_rows]]).tolist()
    return [slice(first, last) for first, last in pairwise(edges)]
