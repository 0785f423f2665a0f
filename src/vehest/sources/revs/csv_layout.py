"""The official CSV files of Revs: lines about the drive, names, units, then a row a millisecond with blank heads of slow columns.

Only the lines above the rows hold anything but ASCII. They are read here, as Latin-1 or UTF-8 line by line, and pyarrow is handed the
rows as they are: transcoding all of it takes about as long as reading it.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.parquet import DAMAGE
from vehest.sources.text_tables import check_size, table_stream

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
        raise DataError(f"'{file}': line {preamble_lines + 1} should name the columns and has no '{needed[0]}' ({_listed(names)}); {hint}")
    for name in needed:
        if names.count(name) > 1:
            raise DataError(f"'{file}' has {names.count(name)} columns called '{name}'; rename or remove all but one")
        if name not in names:
            raise DataError(f"'{file}' has no column '{name}' ({_listed(names)}); correct the map in conf/dataset")
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
    check_size(file, len(names))
    table = _read_rows(file, head, names)
    if not table.num_rows:
        raise DataError(f"'{file}' has a header and no rows; the copy is incomplete")
    if table.column(time).null_count:
        row = int(np.argmax(np.isnan(table.column(time).to_numpy())))
        raise DataError(f"'{file}': column '{time}' is blank in line {head.n_lines + 1 + row}; time stamps are needed")
    parts = {name: table.column(name) for name in names}
    n_rows, blanks = table.num_rows, {name for name in names if table.column(name).null_count and name not in gappy}
    del table
    values = {name: parts.pop(name).to_numpy() for name in names}  # the parts go as their copies come
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


def _read_rows(file: Path, head: CsvHead, names: list[str]) -> pa.Table:
    try:
        return _read_table(file, head, names, threads=True)
    except DAMAGE:
        pass
    try:
        return _read_table(file, head, names, threads=False)  # only here errors name their row
    except DAMAGE as error:
        raise _unreadable(file, head, str(error)) from None


def _read_table(file: Path, head: CsvHead, names: list[str], *, threads: bool) -> pa.Table:
    with table_stream(file) as stream:
        return pc.read_csv(
            stream,
            pc.ReadOptions(use_threads=threads, skip_rows=head.n_lines, column_names=list(head.names)),
            convert_options=pc.ConvertOptions(include_columns=names, column_types=dict.fromkeys(names, pa.float64())),
        )


def _unreadable(file: Path, head: CsvHead, said: str) -> DataError:
    said = said or "it cannot be held in memory"
    text = re.search(r"CSV column #(\d+): Row #(\d+): .*invalid value '(.*)'", said, re.DOTALL)
    if text:
        name, line, value = head.names[int(text[1])], text[2], ascii(text[3][:40])[1:-1]
        return DataError(f"'{file}': column '{name}' holds the text '{value}' in line {line}; numbers are needed")
    cells = re.search(r"Row #(\d+): Expected (\d+) columns, got (\d+)", said)
    if cells:
        return DataError(
            f"'{file}': line {cells[1]} has {cells[3]} cells where the header names {cells[2]} columns; "
            f"the copy is truncated or damaged, fetch it again"
        )
    if "Could not skip initial" in said:
        return DataError(f"'{file}' has a header and no rows; the copy is incomplete")
    return DataError(
        f"'{file}' cannot be read as a table ({ascii(said.splitlines()[0][:160])[1:-1]}); is it truncated or of another format?"
    )


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


def _listed(names: Sequence[str]) -> str:
    return "it has " + (", ".join(filter(None, names[:12])) + (", …" if len(names) > 12 else "") or "nothing")
