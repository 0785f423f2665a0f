"""The official CSV files of Revs: lines about the drive, names, units, then a row a millisecond with blank heads of slow columns.

Only the lines above the rows hold anything but ASCII. They alone are decoded here: transcoding the rows takes as long as reading them.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.sources.tables import TextLayout, listed, read_columns, read_head, require_columns

LONGEST_HEAD = 0.5  # of the rows: a column that begins later is not slow but broken


def read_csv(
    file: Path, columns: Sequence[str], gappy: Collection[str], preamble_lines: int
) -> tuple[dict[str, FloatArray], dict[str, str], dict[str, Any]]:
    """Columns from the first row on in which all of them hold a value.

    Args:
        file: official CSV file.
        columns: names of columns, the one of time first.
        gappy: columns that wait for nothing.
        preamble_lines: lines about the drive, above the names.

    Returns:
        Columns, shape (T,) in the units of the file; those units; and the provenance: lines about the drive, rows dropped at the head.

    Raises:
        DataError: it has other lines, lacks a column, a cell cannot be read, or a column begins after half of the rows.
    """
    time, head = columns[0], read_head(file).split(b"\n")[: preamble_lines + 2]
    lines = [decoded(line).strip() for line in (*head, b"", b"")]
    names, units = (
        [cell.strip() for cell in next(csv.reader(line.splitlines()), [])] for line in lines[preamble_lines : preamble_lines + 2]
    )
    if time not in names:
        problem = f"line {preamble_lines + 1} should name the columns and has no '{time}' (it has {listed(names)})"
        raise DataError(f"'{file}': {problem}; correct preamble_lines, or is it no official Revs file?")
    require_columns(file, names, columns)
    if len(units) != len(names) or any(number(unit) is not None for unit in units):
        raise DataError(f"'{file}': line {preamble_lines + 2} should hold units of the {len(names)} columns; was it removed?")
    values = read_columns(file, columns, TextLayout(skip_rows=preamble_lines + 2, names=tuple(names)))
    starts = {name: int(np.argmin(np.isnan(values[name]))) for name in columns[1:] if name not in gappy}
    slowest = max(starts, key=lambda name: starts[name], default=time)
    first = starts.get(slowest, 0)
    if first > LONGEST_HEAD * len(values[time]):
        what = f"column '{slowest}' is blank until {values[time][first]:.12g} s, more than {100 * LONGEST_HEAD:g} % of the rows"
        raise DataError(f"'{file}': {what}; leave its channel out of the map in conf/dataset, or declare it in 'gappy'")
    preamble = [text for line in lines[:preamble_lines] if (text := line.rstrip(",").strip())]
    about = {"file": file.name, "preamble": preamble, "rows_dropped_at_the_head": first}
    return {name: samples[first:] for name, samples in values.items()}, dict(zip(names, units, strict=True)), about


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
