"""The official CSV files of Revs: lines about the drive, names, units, then a row a millisecond with blank heads of slow columns.

Only the lines above the rows hold anything but ASCII. They are read here, as Latin-1 or UTF-8 line by line, and pyarrow is handed the
rows as they are: transcoding all of it takes about as long as reading it.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.sources.tables import TextLayout, listed, read_columns, require_columns

LONGEST_LINE = 1 << 16  # bytes, of the lines above the rows
LONGEST_HEAD = 0.5  # of the rows: a column that begins later is not slow but broken


@dataclass(frozen=True)
class CsvHead:
    """What stands above the rows.

    Args:
        preamble: lines about the drive that hold something.
        names: of the columns.
        units: of the columns, as the file writes them.
        n_lines: lines above the first row.
    """

    preamble: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    n_lines: int

    def unit_of(self, column: str) -> str:
        """Unit of a column by the file's own row of units."""
        return self.units[self.names.index(column)]


def read_csv_head(file: Path, needed: Iterable[str], preamble_lines: int = 10) -> CsvHead:
    """Read what stands above the rows.

    Args:
        file: official CSV file.
        needed: columns that must be there, the one of time first.
        preamble_lines: lines about the drive, above the names.

    Raises:
        DataError: it is no text, has other lines, or lacks a column.
    """
    lines = _first_lines(file, preamble_lines + 2)
    needed = list(needed)
    if len(lines) < preamble_lines + 2:
        raise DataError(
            f"'{file}' ends after {len(lines)} lines; {preamble_lines} about the drive, names and units belong above the rows: "
            f"fetch it again, or correct preamble_lines"
        )
    cells = [[cell.strip() for cell in next(csv.reader([line]), [])] for line in lines]
    names, units = cells[preamble_lines], cells[preamble_lines + 1]
    if needed[0] not in names:
        elsewhere = [number for number, row in enumerate(cells, start=1) if needed[0] in row]
        hint = f"line {elsewhere[0]} has it: set preamble_lines: {elsewhere[0] - 1}" if elsewhere else "is it an official Revs file?"
        raise DataError(
            f"'{file}': line {preamble_lines + 1} should name the columns and has no '{needed[0]}' (it has {listed(names)}); {hint}"
        )
    require_columns(file, names, needed)
    if len(units) != len(names):
        raise DataError(
            f"'{file}': line {preamble_lines + 1} names {len(names)} columns, line {preamble_lines + 2} has {len(units)} units; "
            f"the header is damaged"
        )
    if any(map(_is_number, units)):
        raise DataError(f"'{file}': line {preamble_lines + 2} should hold units and holds numbers; was the row of units removed?")
    preamble = tuple(text for line in lines[:preamble_lines] if (text := line.strip().rstrip(",").strip()))
    return CsvHead(preamble, tuple(names), tuple(units), preamble_lines + 2)


def read_csv_columns(
    file: Path, head: CsvHead, time: str, columns: Iterable[str], gappy: Iterable[str] = ()
) -> tuple[dict[str, FloatArray], int]:
    """Columns from the first row on in which all of them hold a value.

    Args:
        file: official CSV file.
        head: of it.
        time: name of the column of time.
        columns: names of the others.
        gappy: columns in which a blank is no error and "not measured"; they wait for nothing.

    Returns:
        Columns, the one of time among them, shape (T,) in the units of the file; and how many rows were dropped at the head.

    Raises:
        DataError: a row or cell cannot be read, or a column is blank after its head.
    """
    names, gappy = list(dict.fromkeys([time, *columns])), set(gappy)
    values = read_columns(file, names, TextLayout(skip_rows=head.n_lines, names=head.names))
    n_rows, missing_stamps = len(values[time]), np.flatnonzero(np.isnan(values[time]))
    if len(missing_stamps):
        raise DataError(f"'{file}': column '{time}' is blank in line {head.n_lines + 1 + missing_stamps[0]}; time stamps are needed")
    blanks = {name for name in names if name not in gappy and np.isnan(values[name]).any()}
    first = 0
    for name in blanks:
        start = int(np.argmin(np.isnan(values[name])))
        if np.isnan(values[name][start]):
            raise DataError(f"'{file}': column '{name}' is blank throughout; leave its channel out of the map in conf/dataset")
        if start > LONGEST_HEAD * n_rows:
            raise DataError(
                f"'{file}': column '{name}' is blank until {values[time][start]:.12g} s, more than {100 * LONGEST_HEAD:g} % of the rows; "
                f"leave its channel out of the map in conf/dataset, or declare it in 'gappy'"
            )
        first = max(first, start)
    for name in blanks:
        missing = np.isnan(values[name][first:])
        if missing.any():
            row = first + int(np.argmax(missing))
            raise DataError(
                f"'{file}': column '{name}' is blank in {int(missing.sum())} rows after its head, first in line {head.n_lines + 1 + row} "
                f"({values[time][row]:.12g} s); cut the range out, or declare its channel in 'gappy' if a blank means 'not measured'"
            )
    return {name: samples[first:] for name, samples in values.items()}, first


def _first_lines(file: Path, n_lines: int) -> list[str]:
    """The first lines, each as UTF-8 or else Latin-1."""
    lines = []
    try:
        with open(file, "rb") as stream:
            for number in range(1, n_lines + 1):
                line = stream.readline(LONGEST_LINE)
                if not line:
                    break
                if b"\0" in line or b"\r" in line.rstrip(b"\r\n") or (len(line) == LONGEST_LINE and not line.endswith(b"\n")):
                    raise DataError(f"'{file}': line {number} is no line of text; is the file compressed, UTF-16 or of another format?")
                lines.append(_decoded(line.removeprefix(b"\xef\xbb\xbf") if number == 1 else line).rstrip("\r\n"))
    except OSError as error:
        raise DataError(f"'{file}' cannot be read ({error.strerror or error}); check the disk and its permissions") from None
    return lines


def _decoded(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
