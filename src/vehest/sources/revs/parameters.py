"""The tables of vehicle parameters that come with Revs: a line of names, one of units, then values, a column a parameter."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError
from vehest.data.files import regular_file

LARGEST_TABLE = 1 << 20  # bytes


def read_vehicle_parameters(file: Path) -> dict[str, dict[str, Any]]:
    """Parameters by their names: ``{"mass": {"value": 982.0, "unit": "kg"}}``.

    A parameter with several values (a curve, such as road-wheel angles over the angle of the steering wheel) has a list of them.
    Cells below a column's last value are blank; text is kept as text.

    Raises:
        DataError: it is no such table.
    """
    rows = _rows(file)
    if len(rows) < 3:
        raise DataError(f"'{file}' has {len(rows)} lines; a table of vehicle parameters has one of names, one of units and values below")
    width = max(column + 1 for row in rows for column, cell in enumerate(row) if cell)
    names, units, *values = [[*row, *[""] * width][:width] for row in rows]
    for column, name in enumerate(names):
        if not name or names.index(name) != column:
            raise DataError(f"'{file}': line 1 should name every column once, column {column + 1} is called '{name}'")
    if any(_number(unit) is not None for unit in units):
        raise DataError(f"'{file}': line 2 should hold units and holds numbers; was the line of units removed?")
    columns = zip(names, units, *values, strict=True)
    return {name: {"value": _values(file, name, cells), "unit": unit} for name, unit, *cells in columns}


def _values(file: Path, name: str, cells: list[str]) -> Any:
    """A column's value, or its values."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    numbers = [_number(cell) for cell in cells]
    wrong = next((row for row, number in enumerate(numbers) if number is None), None)
    if wrong is not None and not (len(cells) == 1 and cells[0]):
        what = f"holds the text '{cells[wrong][:40]}'" if cells[wrong] else "is blank"
        raise DataError(f"'{file}': parameter '{name}' {what} in line {wrong + 3}, between its values; numbers are needed")
    found = numbers if wrong is None else cells
    return found[0] if len(found) == 1 else (found or None)


def _rows(file: Path) -> list[list[str]]:
    try:
        if regular_file(file).stat().st_size > LARGEST_TABLE:
            raise DataError(f"'{file}' is no table of vehicle parameters, it has more than {LARGEST_TABLE} bytes; is it a recording?")
        content = file.read_bytes()
    except OSError as error:
        raise DataError(f"'{file}' cannot be read ({error.strerror or error}); check the disk and its permissions") from None
    if b"\0" in content:
        raise DataError(f"'{file}' is no table of vehicle parameters; is it compressed or of another format?")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), strict=True)]
    except csv.Error as error:
        raise DataError(f"'{file}' cannot be read as a table ({error}); the copy is damaged") from None
    return [row for row in rows if any(row)]


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
