"""The official CSV files of Revs: lines about the drive, names, units, then a row a millisecond with blank heads of slow columns.

Only the lines above the rows hold anything but ASCII. They alone are decoded here: transcoding the rows takes as long as reading them.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.sources.tables import TextLayout, listed, read_columns, read_head, require_columns

LONGEST_HEAD = 0.5  # of the rows: a column that begins later is not slow but broken


@dataclass(frozen=True)
class CsvHead:
    """Lines above the rows.

    Args:
        preamble: lines about the drive that hold something.
        units: name of each column -> its unit, as the file writes it.
        n_lines: lines above the first row.
    """

    preamble: list[str]
    units: dict[str, str]
    n_lines: int


def read_csv_head(file: Path, needed: Sequence[str], preamble_lines: int) -> CsvHead:
    """Read the lines above the rows.

    Args:
        file: official CSV file.
        needed: columns that must be there, the one of time first.
        preamble_lines: lines about the drive, above the names.

    Raises:
        DataError: it is no text, has other lines, or lacks a column.
    """
    lines = [decoded(line) for line in read_head(file).split(b"\n")[: preamble_lines + 2]]
    names, units = (
        [cell.strip() for cell in next(csv.reader(line.splitlines()[:1]), [])]
        for line in (*lines, "", "")[preamble_lines : preamble_lines + 2]
    )
    if needed[0] not in names:
        problem = f"line {preamble_lines + 1} should name the columns and has no '{needed[0]}' (it has {listed(names)})"
        raise DataError(f"'{file}': {problem}; correct preamble_lines, or is it no official Revs file?")
    require_columns(file, names, needed)
    if len(units) != len(names) or any(number(unit) is not None for unit in units):
        raise DataError(f"'{file}': line {preamble_lines + 2} should hold units of the {len(names)} columns; was it removed?")
    preamble = [text for line in lines[:preamble_lines] if (text := line.strip().rstrip(",").strip())]
    return CsvHead(preamble, dict(zip(names, units, strict=True)), preamble_lines + 2)


def read_csv_columns(file: Path, head: CsvHead, columns: Sequence[str], gappy: Collection[str] = ()) -> tuple[dict[str, FloatArray], int]:
    """Columns from the first row on in which all of them hold a value.

    Args:
        file: official CSV file.
        head: of it.
        columns: names of columns, the one of time first.
        gappy: columns that wait for nothing.

    Returns:
        Columns, shape (T,) in the units of the file; and how many rows were dropped at the head.

    Raises:
        DataError: a row or cell cannot be read, or a column begins after half of the rows.
    """
    values = read_columns(file, columns, TextLayout(skip_rows=head.n_lines, names=tuple(head.units)))
    starts = {name: int(np.argmin(np.isnan(values[name]))) for name in columns[1:] if name not in gappy}
    slowest = max(starts, key=lambda name: starts[name], default=columns[0])
    first = starts.get(slowest, 0)
    if first > LONGEST_HEAD * len(values[slowest]):
        what = f"column '{slowest}' is blank until {values[columns[0]][first]:.12g} s, more than {100 * LONGEST_HEAD:g} % of the rows"
        raise DataError(f"'{file}': {what}; leave its channel out of the map in conf/dataset, or declare it in 'gappy'")
    return {name: samples[first:] for name, samples in values.items()}, first


def decoded(content: bytes) -> str:
    """Text in UTF-8 or else Latin-1."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def number(text: str) -> float | None:
    """A finite number; None of other text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
