"""The official CSV files of Revs: lines about the drive, names, units, then a row a millisecond
with blank heads of slow columns.

Tables of vehicle parameters have a line of names, one of units, then values, a column a parameter.

Only the lines above the rows hold anything but ASCII. They alone are decoded here: transcoding the
rows takes as long as reading them.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError, printable
from vehest.sources.tables import TextLayout, listed, read_columns, read_head, require_columns

# largest share of rows before a column begins; one that begins later is not slow but broken
LONGEST_HEAD = 0.5


def read_csv(
    file: Path, columns: Sequence[str], gappy: Collection[str], preamble_lines: int
) -> tuple[dict[str, FloatArray], dict[str, str], dict[str, Any]]:
    """Columns of an official file.

    Rows at the head are left out until all columns but the gappy ones hold a value: slow columns
    begin with blank cells.

    Parameters
    ----------
    file : Path
        The table.
    columns : sequence of str
        Wanted columns, the one of time first.
    gappy : collection of str
        Columns that may be blank anywhere.
    preamble_lines : int
        Lines about the drive above the names.

    Returns
    -------
    values : dict
        Column -> samples in the file's unit, shape (T,).
    units : dict
        Unit of every column of the file, as it is written there.
    about : dict
        Provenance: the file's name, its lines about the drive, and the rows dropped at the head.

    Raises
    ------
    DataError
        A line or column is not where it belongs, a cell is no number, or a column is blank for more
        than half of the rows.
    """
    time = columns[0]
    head = read_head(file).split(b"\n")[: preamble_lines + 2]
    lines = [_decoded(line).strip() for line in (*head, *[b""] * (preamble_lines + 2))]
    names, units = (
        [cell.strip() for cell in next(csv.reader(line.splitlines()), [])]
        for line in lines[preamble_lines : preamble_lines + 2]
    )
    if time not in names:
        raise DataError(
            f"'{file}': line {preamble_lines + 1} should name the columns and has no '{time}' (it "
            f"has {listed(names)}); correct preamble_lines, or is it no official Revs file?"
        )
    require_columns(file, names, columns)
    if len(units) != len(names) or any(_number(unit) is not None for unit in units):
        raise DataError(
            f"'{file}': line {preamble_lines + 2} should hold units of the {len(names)} columns; "
            "was it removed?"
        )
    values = read_columns(
        file, columns, TextLayout(skip_rows=preamble_lines + 2, names=tuple(names))
    )
    starts = {
        name: int(np.argmin(np.isnan(values[name]))) for name in columns[1:] if name not in gappy
    }
    slowest = max(starts, key=lambda name: starts[name], default=time)
    first = starts.get(slowest, 0)
    if first > LONGEST_HEAD * len(values[time]):
        raise DataError(
            f"'{file}': column '{slowest}' is blank until {values[time][first]:.12g} s, more than "
            f"{100 * LONGEST_HEAD:g} % of the rows; leave its channel out of the map in "
            "conf/dataset, or declare it in 'gappy'"
        )
    preamble = [text for line in lines[:preamble_lines] if (text := line.rstrip(",").strip())]
    about = {"file": file.name, "preamble": preamble, "rows_dropped_at_the_head": first}
    return (
        {name: samples[first:] for name, samples in values.items()},
        dict(zip(names, units, strict=True)),
        about,
    )


def read_vehicle_parameters(file: Path) -> dict[str, dict[str, Any]]:
    """Parameters of a vehicle by their names.

    Parameters
    ----------
    file : Path
        A line of names, one of units, then values, a column a parameter; cells below a column's
        last value are blank.

    Returns
    -------
    dict
        ``{"mass": {"value": 982.0, "unit": "kg"}}``. A parameter with several values (a curve, such
        as road-wheel angles over the angle of the steering wheel) has a list of them, one without
        any has None. A single text is kept as text.

    Raises
    ------
    DataError
        It is no such table, or one of several values is no number.
    """
    text = _decoded(read_head(file))
    try:
        rows = [
            row
            for line in csv.reader(text.splitlines(), strict=True)
            if any(row := [cell.strip() for cell in line])
        ]
    except csv.Error as error:
        raise DataError(
            f"'{file}' cannot be read as a table ({error}); the copy is damaged"
        ) from None
    if len(rows) < 3 or "\0" in text:
        raise DataError(
            f"'{file}' is no table of vehicle parameters: a line of names, one of units, and "
            "values below"
        )
    parameters: dict[str, dict[str, Any]] = {}
    for name, unit, *values in filter(any, zip_longest(*rows, fillvalue="")):
        if not name or name in parameters:
            raise DataError(
                f"'{file}': line 1 should name every column once, column {len(parameters) + 1} is "
                f"called '{printable(name[:40])}'"
            )
        if _number(unit) is not None:
            raise DataError(
                f"'{file}': line 2 should hold units and holds numbers; was the line of units "
                "removed?"
            )
        parameters[name] = {
            "value": _value(values, f"'{file}': parameter '{printable(name[:40])}'"),
            "unit": unit,
        }
    return parameters


def _value(cells: list[str], location: str) -> Any:
    """The number, text or list of numbers of a column's cells; None where all are blank."""
    while cells and not cells[-1]:
        cells.pop()
    if len(cells) == 1:
        return cells[0] if _number(cells[0]) is None else _number(cells[0])
    numbers = [_number(cell) for cell in cells]
    for line, (cell, number) in enumerate(zip(cells, numbers, strict=True), start=3):
        if number is None:
            raise DataError(
                f"{location} holds '{printable(cell[:40])}' in line {line}; numbers are needed"
            )
    return numbers or None


def _decoded(content: bytes) -> str:
    """Text of UTF-8, with or without a byte order mark, or else of Latin-1."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _number(text: str) -> float | None:
    """A finite number from text; None for any other text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
