"""The tables of vehicle parameters that come with Revs: a line of names, one of units, then values, a column a parameter."""

from __future__ import annotations

import csv
from itertools import zip_longest
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError, printable
from vehest.sources.revs.csv_layout import decoded, number
from vehest.sources.tables import read_head


def read_vehicle_parameters(file: Path) -> dict[str, dict[str, Any]]:
    """Parameters by their names: ``{"mass": {"value": 982.0, "unit": "kg"}}``.

    A parameter with several values (a curve, such as road-wheel angles over the angle of the steering wheel) has a list of them.
    Cells below a column's last value are blank; text is kept as text.

    Raises:
        DataError: it is no such table.
    """
    content = read_head(file)
    if b"\0" in content:
        raise DataError(f"'{file}' is no table of vehicle parameters; is it compressed or of another format?")
    try:
        cells = [[cell.strip() for cell in row] for row in csv.reader(decoded(content).splitlines(), strict=True)]
    except csv.Error as error:
        raise DataError(f"'{file}' cannot be read as a table ({error}); the copy is damaged") from None
    rows = [row for row in cells if any(row)]
    if len(rows) < 3:
        raise DataError(f"'{file}' has {len(rows)} lines; a table of vehicle parameters has one of names, one of units and values below")
    found: dict[str, dict[str, Any]] = {}
    for name, unit, *values in filter(any, zip_longest(*rows, fillvalue="")):
        if not name or name in found:
            raise DataError(f"'{file}': line 1 should name every column once, column {len(found) + 1} is called '{printable(name[:40])}'")
        if number(unit) is not None:
            raise DataError(f"'{file}': line 2 should hold units and holds numbers; was the line of units removed?")
        found[name] = {"value": _value(values, f"'{file}': parameter '{printable(name[:40])}'"), "unit": unit}
    return found


def _value(cells: list[str], where: str) -> Any:
    """A column's value, or its values."""
    while cells and not cells[-1]:
        cells.pop()
    if len(cells) == 1:
        return cells[0] if number(cells[0]) is None else number(cells[0])
    numbers = [number(cell) for cell in cells]
    if None in numbers:
        raise DataError(
            f"{where} holds '{printable(cells[numbers.index(None)][:40])}' in line {numbers.index(None) + 3}; numbers are needed"
        )
    return numbers or None
