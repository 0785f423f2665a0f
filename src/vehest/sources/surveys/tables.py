"""Tables of text and Parquet: delimiter, decimal mark, encoding, lines before the names, a row of units below them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.csv as pc

from vehest.constants import FloatArray
from vehest.data.errors import DataError, printable
from vehest.data.limits import check_limit
from vehest.data.parquet import DAMAGE, parquet_file, read_numbers
from vehest.data.text_files import first_line
from vehest.sources.clock_times import seconds_of_text
from vehest.sources.surveys.clocks import NAMED, SPELLINGS, find_clock, plain_name
from vehest.sources.surveys.log import Log, RawColumn, Stamps
from vehest.sources.tables import TextLayout, is_parquet, parse_table, table_stream
from vehest.sources.text_log import CLOCK
from vehest.sources.unit_spellings import plain_unit

HEAD = 1 << 18  # bytes that are looked at
MOST_LINES = 400
MOST_BEFORE = 200  # lines before the names
DELIMITERS = (";", "\t", ",", "|", " ")
LEAST_NUMBERS = 0.5  # share of a row's cells that are numbers or empty
MOST_CONTROLS = 0.01
MARKS = frozenset({"-", "--", "---", "----", "–", "—", "*", "?", "n.a.", "none", "missing", "invalid", "inv", "void", "#value!", "#div/0!"})
"""What loggers and spreadsheets write where there is no sample, in lower case."""
BRACKETED = re.compile(r"^(?P<name>.*?)[\s_]*[\[(<{](?P<unit>[^\])>}]*)[\])>}]\s*$")


@dataclass(frozen=True)
class Shape:
    """How a table of text is laid out.

    Args:
        encoding: of the text.
        delimiter: between cells.
        decimal: mark.
        skip_rows: lines before the names.
        names: of the columns.
        units: below the names; empty where there is no such row.
    """

    encoding: str
    delimiter: str
    decimal: str
    skip_rows: int
    names: tuple[str, ...]
    units: tuple[str, ...] = ()

    @property
    def layout(self) -> TextLayout:
        """The same for reading."""
        return TextLayout(self.delimiter, self.decimal, self.encoding, self.skip_rows, rows_below_names=1 if self.units else 0)


def survey_table(file: Path) -> Log:
    """What a table holds.

    Raises:
        DataError: it is no table, has no names, or holds no numbers.
    """
    if is_parquet(file):
        with parquet_file(file) as table:
            schema = table.schema_arrow
            names = [name for name in schema.names if pa.types.is_integer(kind := schema.field(name).type) or pa.types.is_floating(kind)]
            check_limit("columns", len(names), f"'{file}' has {len(names)} columns")
            values = read_numbers(file, table, names)
        return _log(file, Read(values), {}, {})
    shape = shape_of(file)
    check_limit("columns", len(shape.names), f"'{file}' has {len(shape.names)} columns")
    read = _values(file, shape)
    units = {name: unit for name, unit in zip(shape.names, shape.units, strict=True) if unit} if shape.units else {}
    options: dict[str, object] = {"delimiter": shape.delimiter, "decimal": shape.decimal}
    options |= {"encoding": shape.encoding} if shape.encoding != "utf8" else {}
    options |= {"skip_rows": shape.skip_rows} if shape.skip_rows else {}
    options |= {"rows_below_names": 1} if shape.units else {}
    options |= {"missing": list(read.marks)} if read.marks else {}
    return _log(file, read, units, options)


@dataclass(frozen=True)
class Read:
    """What a table's columns hold.

    Args:
        values: name -> numbers, (N,).
        clocks: name -> times that are written as a clock's [s], (N,).
        marks: cells of columns of numbers that stand for a missing sample.
        skipped: what was not read, and why.
    """

    values: dict[str, FloatArray]
    clocks: dict[str, FloatArray] = field(default_factory=dict)
    marks: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()


def _log(file: Path, read: Read, units: dict[str, str], options: dict[str, object]) -> Log:
    values, skipped = read.values, read.skipped
    if not values:
        raise DataError(f"'{file}' holds no column of numbers{f' ({skipped[0]})' if skipped else ''}")
    n_rows = len(next(iter(values.values())))
    if n_rows < 2:
        raise DataError(f"'{file}' has {n_rows or 'no'} row{'s' * (n_rows != 1)} of numbers below its names")
    written = {name: units.get(name) or unit_in_name(name) for name in values}
    found = find_clock({**read.clocks, **values}, {**written, **dict.fromkeys(read.clocks, "s")})
    stamps = found.stamps
    if stamps is not None and stamps.column in read.clocks:
        stamps = replace(stamps, unit=CLOCK, evidence=stamps.evidence.replace("unit in the header", "times of a clock"), asked=False)
    skipped = (*skipped, *_no_clocks(values, read.clocks, stamps))
    if len(found.runs) > 1:
        options = {**options, "runs": found.counted_by} if found.counted_by else {**options, "time_restarts": True}
    columns = [
        RawColumn(name, written[name], samples, {"column": name})
        for name, samples in values.items()
        if (stamps is None or name != stamps.column) and (name != found.counted_by or not name)
    ]
    plain = not {"rows_below_names", "missing"} & set(options) and (stamps is None or stamps.unit != CLOCK)
    return Log(file, "tabular" if plain else "text_log", tuple(columns), options, stamps, found.seconds, found.runs, skipped)


def _no_clocks(values: dict[str, FloatArray], clocks: dict[str, FloatArray], stamps: Stamps | None) -> list[str]:
    """Columns of times, or named so, that no clock can be made of."""
    why = []
    for name, times in {
        **clocks,
        **{name: own for name, own in values.items() if stamps is None and NAMED.match(plain_name(name))},
    }.items():
        if stamps is not None and stamps.column == name:
            continue
        steps = np.diff(times)
        back, same = int((steps < 0).sum()), int((steps == 0).sum())
        what = f"goes backwards {back} times" if back else f"repeats {same} times" if same else "does not grow evenly"
        why.append(f"column '{printable(name)}' as the time: it {what}" + ("; sort the rows" if back > 1 else ""))
    return why


def unit_in_name(name: str) -> str:
    """The unit that a column's name ends in, as it is written there: ``Speed [km/h]``, ``ay_mps2``; empty where there is none."""
    bracketed = BRACKETED.match(name.strip())
    if bracketed:
        return bracketed["unit"].strip()
    words = re.split(r"[_\s]+", name.strip())
    last = words[-1].lower() if len(words) > 1 else ""
    short = {"radps": "rad/s", "degps": "deg/s", "degs": "deg/s", "rads": "rad/s", "ms2": "m/s2", "mss": "m/s2", "kmh": "km/h"}
    if last in short:
        return short[last]
    known = plain_unit(last) is not None or last in SPELLINGS
    return last if known and len(last) > 1 else ""


def shape_of(file: Path) -> Shape:
    """How a table of text is laid out, from its beginning.

    Raises:
        DataError: it is no table of text, has one column only, or no line of names.
    """
    head = _head(file)
    encoding, text = _decoded(head, file)
    lines = re.split(r"\r\n|\n|\r", text)
    lines = lines[: -1 if len(head) >= HEAD else None][: MOST_BEFORE + MOST_LINES]
    if not any(line.strip() for line in lines):
        raise DataError(f"'{file}' holds nothing but empty lines")
    best = max((_layout(lines, delimiter) for delimiter in DELIMITERS), key=lambda layout: layout.score)
    if best.score <= 0.0:
        if _layout(lines, "\n").score > 0.0:
            raise DataError(f"'{file}' has one column only; time and a motion are two at least")
        raise DataError(f"'{file}' holds no rows of numbers; is it a table of text, with names in its first line and numbers below?")
    if best.names is None:
        row = lines[best.first][:60]
        raise DataError(f"'{file}' has no line of names above its first numbers ({printable(row)}); write one there")
    doubled = sorted({name for name in best.names if name and best.names.count(name) > 1})
    if doubled:
        raise DataError(f"'{file}' has {best.names.count(doubled[0])} columns called '{printable(doubled[0])}'; rename all but one")
    return Shape(encoding, best.delimiter, best.decimal, best.header, best.names, best.units)


@dataclass(frozen=True)
class _Layout:
    """How well a delimiter explains the lines: cells of numbers in rows of the same length."""

    delimiter: str
    score: float
    decimal: str = "."
    header: int = 0
    first: int = 0
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] = ()


def _layout(lines: Sequence[str], delimiter: str) -> _Layout:
    rows = [_cells(line, delimiter) for line in lines]
    filled = [k for k, row in enumerate(rows) if any(cell.strip() for cell in row)]
    if not filled:
        return _Layout(delimiter, 0.0)
    tail = [len(rows[k]) for k in filled[len(filled) // 2 :]]
    n_columns = max(set(tail), key=tail.count)
    if n_columns < 2 and delimiter != "\n":
        return _Layout(delimiter, 0.0)
    decimals = [mark for mark in (".", ",") if mark != delimiter]
    shares = {mark: [_share(rows[k], mark) for k in filled] for mark in decimals}
    decimal = max(decimals, key=lambda mark: sum(shares[mark]))
    data = [k for k, share in zip(filled, shares[decimal], strict=True) if share >= LEAST_NUMBERS and len(rows[k]) == n_columns]
    if not data:
        return _Layout(delimiter, 0.0)
    first = next((k for k, after in pairwise([*data, len(lines)]) if after - k == 1 or k == data[-1]), data[0])
    score = sum(shares[decimal][filled.index(k)] for k in data) / len(filled) + 0.01 * min(n_columns, 20)
    above = [k for k in filled if k < first and len(rows[k]) == n_columns]
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] = ()
    header = above[-1] if above else 0
    if above:
        names = tuple(rows[above[-1]])
        if len(above) > 1 and above[-2] == above[-1] - 1 and _are_units(names):
            units, header = tuple(cell.strip() for cell in names), above[-2]
            names = tuple(rows[header])
    return _Layout(delimiter, score, decimal, header, first, names, units)


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == "\n":
        return [line]
    return next(csv.reader(io.StringIO(line), delimiter=delimiter), [])


def _share(row: Sequence[str], decimal: str) -> float:
    """Share of cells that are numbers, empty ones left out; 0 where there is none."""
    filled = [cell for cell in row if cell.strip() and cell.strip().lower() not in MARKS]
    return sum(_is_number(cell, decimal) for cell in filled) / len(filled) if filled else 0.0


def _is_number(cell: str, decimal: str) -> bool:
    text = cell.strip().strip('"')
    if decimal == ",":
        if "." in text:
            return False
        text = text.replace(",", ".")
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def _are_units(cells: Sequence[str]) -> bool:
    """Whether a row below the names holds units: some that are known, or brackets, and no longer words."""
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() -")]
    if not filled:
        return any(cell.strip() for cell in cells)
    known = sum(plain_unit(cell) is not None or cell.lower() in SPELLINGS for cell in filled)
    return known >= max(1, 0.3 * len(filled)) and all(len(cell) <= 12 for cell in filled)


def _head(file: Path) -> bytes:
    try:
        with table_stream(file) as stream:
            return bytes(stream.read(HEAD))
    except (OSError, pa.ArrowException, MemoryError) as error:
        raise DataError(f"'{file}' cannot be read ({first_line(error)})") from None


def _decoded(head: bytes, file: Path) -> tuple[str, str]:
    """Encoding and text."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16", head[: len(head) // 2 * 2].decode("utf-16", errors="replace")
    controls = sum(head.count(bytes([code])) for code in range(32) if code not in (9, 10, 12, 13))
    if b"\0" in head or controls > MOST_CONTROLS * max(len(head), 1):
        raise DataError(f"'{file}' is no table of text (it holds control characters); is it of another format? its ending says which")
    try:
        return "utf8", head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if error.start >= len(head) - 4 and len(head) >= HEAD:
            return "utf8", head[: error.start].decode("utf-8-sig")
    western = any(0x80 <= byte < 0xA0 for byte in head)
    return ("cp1252", head.decode("cp1252", errors="replace")) if western else ("latin-1", head.decode("latin-1"))


def _values(file: Path, shape: Shape) -> Read:
    layout, opened = shape.layout, partial(table_stream, file)
    try:
        table = parse_table(opened, layout, pc.ConvertOptions(decimal_point=shape.decimal))
    except DAMAGE:
        table = _as_text(file, shape)
    check_limit("samples", table.num_rows, f"'{file}' has {table.num_rows} rows")
    values, clocks, skipped = {}, {}, []
    marks: set[str] = set()
    for place, name in enumerate(shape.names):
        column = table.column(name) if name in table.column_names else None
        if column is None or column.null_count == len(column):
            skipped += [f"column '{printable(name)}' is empty"] if name else []
            continue
        samples, own = _numbers(column, shape.decimal)
        seconds = _clock_of(column) if samples is None else None
        if not name:
            skipped.append(f"column {place + 1} has no name")
        elif samples is not None:
            values[name] = samples
            marks |= own
        elif seconds is not None:
            clocks[name] = seconds
        else:
            skipped.append(f"column '{printable(name)}' holds text")
    return Read(values, clocks, tuple(sorted(marks)), tuple(skipped))


def _clock_of(column: pa.ChunkedArray) -> FloatArray | None:
    """Times that are written as a clock's [s], (N,); None of other text."""
    kind = column.type
    if not (pa.types.is_string(kind) or pa.types.is_timestamp(kind) or pa.types.is_time(kind)):
        return None
    return seconds_of_text(column if pa.types.is_string(kind) else column.cast(pa.string()))


def _as_text(file: Path, shape: Shape) -> pa.Table:
    """All cells as they stand, where some columns hold numbers first and text later."""
    kinds = pc.ConvertOptions(column_types=dict.fromkeys(shape.names, pa.string()), strings_can_be_null=True)
    try:
        return parse_table(partial(table_stream, file), shape.layout, kinds)
    except DAMAGE as error:
        remedy = (
            "its columns are aligned by blanks; write one delimiter between cells"
            if shape.delimiter == " "
            else "remove that row, or what lies behind it if the file is truncated"
        )
        raise DataError(f"'{file}' cannot be read as a table ({printable(first_line(error))}); {remedy}") from None


def _numbers(column: pa.ChunkedArray, decimal: str) -> tuple[FloatArray | None, set[str]]:
    """A column as numbers, None where it holds anything else, and the marks in it that stand for a missing sample."""
    kind = column.type
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64), set()
    if not pa.types.is_string(kind):
        return None, set()
    marks = {cell for cell in compute.unique(column).to_pylist() if cell is not None and cell.strip().lower() in MARKS}
    try:
        if marks:
            column = compute.if_else(compute.is_in(column, pa.array(sorted(marks))), pa.scalar(None, pa.string()), column)
        plain = compute.replace_substring(compute.utf8_trim_whitespace(column), decimal, ".")
        return np.asarray(compute.cast(plain, pa.float64()).to_numpy(), dtype=np.float64), marks
    except pa.ArrowException:
        return None, set()
