"""Reads columns of numbers from tables: text (CSV), Parquet and MAT-files.

file -> names of its columns -> pyarrow or scipy -> columns of float64
"""

from __future__ import annotations

import codecs
import csv
import io
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.csv as pc

from vehest.constants import FloatArray
from vehest.data.errors import DataError, first_of, number_of, printable
from vehest.data.files import regular_file
from vehest.data.limits import check_limit, check_unpacked, current_limits
from vehest.data.parquet import DAMAGE, number_batches, numbers_of, parquet_file, read_numbers
from vehest.data.text_files import first_line
from vehest.sources.clock_times import seconds_of_text
from vehest.sources.matlab import is_matlab, mat_contents, read_mat

BLOCK = 1 << 20  # largest length of a line that pyarrow reads [bytes]
TAIL = 1 << 16  # bytes at the end of the rows that hold the last ones
# memory of a cell [bytes]: a double, and as much again while text becomes numbers
BYTES_PER_CELL = 16
# matches a row with a cell that is a number, or whose first one is missing
ROW_OF_NUMBERS = r'(^|[,;|\t])\s*"?([-+]?[.,]?\d|(nan|na|n/a|null|none|inf)\b)|^[\s-]*$'
# matches the start of a row of numbers
BEGINS_AS_ROW = re.compile(
    r'\s*"?([-+]?[.,]?\d|[,;|\t]|(nan|na|n/a|null|none|inf)\b)', re.IGNORECASE
)
COMMENT = re.compile(r"\s*(#|%|//)\s")  # matches the start of a comment
# matches a number that is cut short
UNFINISHED = re.compile(r"[-+]|[-+]?\.|[-+]?[\d.]+e[-+]?", re.IGNORECASE)
# ending of a packed table -> its compression
PACKED = {".gz": "gzip", ".bz2": "bz2", ".zst": "zstd", ".lz4": "lz4"}


@dataclass(frozen=True)
class TextLayout:
    """Layout of a table of text."""

    delimiter: str = ","  # character between cells
    decimal: str = "."  # decimal mark
    encoding: str = "utf8"  # encoding of the text, by Python's name
    skip_rows: int = 0  # number of lines above the names; above the rows where names are given
    rows_below_names: int = 0  # number of lines between the names and the rows
    missing: tuple[str, ...] = ()  # cells without a sample, besides empty ones, NaN, NA and null
    names: tuple[str, ...] | None = None  # names of the columns where the file has no line of them
    clock: str | None = None  # column of times that are written as a clock's, which become seconds
    n_bytes: int | None = None  # number of bytes of the file that are read; None: all of them


def is_parquet(file: Path) -> bool:
    """Whether a file is Parquet by its ending."""
    return file.suffix.lower() in {".parquet", ".pq"}


def is_text(file: Path) -> bool:
    """Whether a table is text, perhaps packed: neither Parquet nor a MAT-file."""
    return not (is_parquet(file) or is_matlab(file))


def column_names(file: Path, layout: TextLayout = TextLayout()) -> list[str]:
    """Names of a table's columns, in order.

    Those that ``layout`` states count before the file's own; see `names_of` for names that occur
    twice.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It cannot be read, or has more columns than the limits allow.
    """
    if layout.names is not None:
        names = list(layout.names)
    elif is_parquet(file):
        with parquet_file(file) as table:
            names = list(table.schema_arrow.names)
    elif is_matlab(file):
        names = list(mat_contents(file).lengths)
    else:
        names = names_of(*_first_rows(file, layout))
    check_limit("columns", len(names), f"'{file}' has {len(names)} columns")
    return names


def _first_rows(file: Path, layout: TextLayout) -> tuple[list[str], list[str]]:
    """Cells of the line of names, and of the first row of numbers."""
    decoder = codecs.getincrementaldecoder(layout.encoding)(errors="backslashreplace")
    try:
        text = decoder.decode(read_head(file)).removeprefix("\ufeff")
        # StringIO ends lines as re.split(r"\r\n|\n|\r") would, one at a time
        lines = islice(io.StringIO(text, newline=None), layout.skip_rows, None)
        filled = filter(None, (line.removesuffix("\n") for line in lines))
        rows = csv.reader(filled, delimiter=layout.delimiter)
        header = next(rows, [])
        with suppress(csv.Error):  # of an endless line, which the reader of the rows reports
            return header, next(islice(rows, layout.rows_below_names, None), [])
        return header, []
    except (ValueError, csv.Error) as error:
        raise _unreadable(file, error) from None


def names_of(header: Sequence[str], first_row: Sequence[str]) -> list[str]:
    """Names of a table's columns, one for each cell of its rows, each once.

    Parameters
    ----------
    header : sequence of str
        Cells of the line of names; it may end in more delimiters than the rows.
    first_row : sequence of str
        Cells of the first row; rows may end in delimiters, which make nameless columns.

    Returns
    -------
    list of str
        A name that occurs several times has the number of its column behind it each time: ``speed
        #3``.
    """
    n_cells = len(first_row)
    names = [*header, *[""] * (n_cells - len(header))]
    if any(map(str.strip, (*first_row[len(header) :], *header[n_cells:]))):
        names = list(header)
    elif first_row:
        names = names[:n_cells]
    return [
        f"{name} #{place}" if name and names.count(name) > 1 else name
        for place, name in enumerate(names, 1)
    ]


def with_names(file: Path, layout: TextLayout) -> TextLayout:
    """A layout with the names of the columns, where the file's line of names is not as read."""
    if layout.names is not None or not is_text(file):
        return layout
    names = column_names(file, layout)
    if names == _first_rows(file, layout)[0]:
        return layout
    below = layout.rows_below_names + 1  # the line of names itself
    return replace(layout, names=tuple(names), rows_below_names=below)


def read_head(file: Path, size: int = BLOCK) -> bytes:
    """First bytes of a table, unpacked; fewer than ``size`` where the table is shorter.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It cannot be read.
    """
    try:
        with table_stream(file) as stream:
            return bytes(stream.read(size))
    except DAMAGE as error:
        raise _unreadable(file, error) from None


def require_columns(file: Path, names: Sequence[str], selected: Iterable[str]) -> None:
    """Raise an error unless a table has every wanted column once.

    Parameters
    ----------
    file : Path
        For messages.
    names : sequence of str
        Columns of the table, as `column_names` gives them.
    selected : iterable of str
        Wanted columns.

    Raises
    ------
    DataError
        One is missing, or occurs several times.
    """
    for name in selected:
        count = names.count(name)
        if count > 1:
            raise DataError(
                f"'{file}' has {count} columns called '{printable(name)}'; rename or remove all "
                "but one"
            )
        if count:
            continue
        numbered = [column for column in names if re.fullmatch(rf"{re.escape(name)} #\d+", column)]
        if numbered:
            raise DataError(
                f"'{file}' has {len(numbered)} columns called '{printable(name)}'; rename or "
                f"remove all but one, or declare one of them: {listed(numbered)}"
            )
        raise DataError(
            f"'{file}' has no column '{name}' (it has {listed(names)}); correct the map in "
            "conf/dataset"
        )


def read_columns(
    file: Path,
    selected: Sequence[str],
    layout: TextLayout = TextLayout(),
    text: bytes | None = None,
) -> dict[str, FloatArray]:
    """Columns of numbers.

    Parameters
    ----------
    file : Path
        Table of text, perhaps packed, Parquet or MAT-file.
    selected : sequence of str
        Names of the wanted columns; others are not converted.
    layout : TextLayout
        Layout of a table of text. Its column of clock times becomes seconds.
    text : bytes or None
        Text of the table where it is not the file's own.

    Returns
    -------
    dict
        Name -> float64, shape (T,), NaN where a sample is missing.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It cannot be read, lacks a column, holds text where numbers belong, no rows, or more than
        the limits allow.
    """
    require_columns(file, column_names(file, layout), selected)
    if is_parquet(file):
        with parquet_file(file) as parquet:
            return read_numbers(file, parquet, selected)
    if is_matlab(file):
        return read_mat(file, selected)
    opened = partial(pa.BufferReader, text)
    if text is None:
        opened = partial(table_stream, file, layout.n_bytes)
        require_memory(file, layout)
    layout = with_names(file, layout)
    convert = _conversion(selected, layout)
    try:
        table = parse_table(opened, layout, convert, [])
    except DAMAGE:
        try:  # errors without threads state the row
            table = parse_table(opened, layout, convert, [], threads=False)
        except DAMAGE as error:
            raise _unreadable(file, error, layout) from None
    if not table.num_rows:
        raise DataError(f"'{file}' has {'a header and ' if layout.names is None else ''}no rows")
    check_limit("samples", table.num_rows, f"'{file}' has {table.num_rows} rows")
    columns = {name: table.column(name) for name in selected}
    del table  # so that a column is dropped as soon as it is converted
    return {
        name: _seconds(file, name, columns.pop(name))
        if name == layout.clock
        else numbers_of(columns.pop(name))
        for name in selected
    }


def column_parts(
    file: Path, selected: Sequence[str], layout: TextLayout, lengths: Iterable[int]
) -> Iterator[dict[str, FloatArray]]:
    """Columns as `read_columns` gives them, so many rows at a time.

    Parameters
    ----------
    file : Path
        Table of text, perhaps packed, or Parquet.
    selected : sequence of str
        Names of the wanted columns, none of them of clock times.
    layout : TextLayout
        Layout of a table of text.
    lengths : iterable of int
        Rows of each part.

    Yields
    ------
    dict
        Name -> float64, shape (length,), read-only; shorter, or empty, where the table has no more
        rows.

    Raises
    ------
    MissingError, DataError
        As `read_columns` does.
    """
    require_columns(file, column_names(file, layout), selected)
    try:
        with ExitStack() as opened:
            if is_parquet(file):
                batches = number_batches(file, opened.enter_context(parquet_file(file)), selected)
            else:
                layout = with_names(file, layout)
                options = _options(layout, _conversion(selected, layout), [])
                stream = opened.enter_context(table_stream(file, layout.n_bytes))
                opened.enter_context(decoding_failures_ignored())
                batches = iter(pc.open_csv(stream, **options))
            first = next(batches, None)
            pending = (
                pa.table({name: [] for name in selected})
                if first is None
                else pa.Table.from_batches([first])
            )
            for length in lengths:
                while pending.num_rows < length and (batch := next(batches, None)) is not None:
                    pending = pa.concat_tables([pending, pa.Table.from_batches([batch])])
                part = pending.slice(0, length)
                pending = pending.slice(length)
                values = {name: numbers_of(part.column(name)) for name in selected}
                for column in values.values():
                    column.flags.writeable = False  # so that a recording shares it
                yield values
    except DAMAGE:
        read_columns(file, selected, layout)  # whose errors state the row
        raise


def parse_table(
    opened: Callable[[], pa.NativeFile],
    layout: TextLayout,
    convert: pc.ConvertOptions,
    lines_of_text: list[str],
    *,
    threads: bool = True,
) -> pa.Table:
    """Table of text as pyarrow converts it; raises what pyarrow raises.

    Parameters
    ----------
    opened : callable
        Opens the text; called once.
    layout : TextLayout
        Its layout.
    convert : pyarrow.csv.ConvertOptions
        Types of the columns, and which are read.
    lines_of_text : list of str
        Takes the lines of text between or below the rows, which are left out of the table.
    threads : bool
        Whether pyarrow may use several threads; errors state the row only without.
    """
    with opened() as stream, decoding_failures_ignored():
        return pc.read_csv(stream, **_options(layout, convert, lines_of_text, threads=threads))


def _options(
    layout: TextLayout,
    convert: pc.ConvertOptions,
    lines_of_text: list[str],
    *,
    threads: bool = True,
) -> dict[str, Any]:
    """Arguments of pyarrow's reader for a layout.

    A row of the wrong length is an error where it holds a number or lacks its first cell; any other
    is a line of text, which is left out and appended to ``lines_of_text``.
    """

    def handle(row: pc.InvalidRow) -> Literal["skip", "error"]:
        if re.search(ROW_OF_NUMBERS, row.text, re.IGNORECASE):
            return "error"
        lines_of_text.append(row.text)
        return "skip"

    return {
        "read_options": pc.ReadOptions(
            use_threads=threads,
            block_size=BLOCK,
            encoding=layout.encoding,
            skip_rows=layout.skip_rows,
            skip_rows_after_names=layout.rows_below_names,
            column_names=layout.names,
        ),
        "parse_options": pc.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=handle),
        "convert_options": convert,
    }


@contextmanager
def decoding_failures_ignored() -> Iterator[None]:
    """Context in which a row of damaged bytes is pyarrow's error alone: before that, pyarrow fails
    to decode the row for the handler, which Python would print with a traceback.
    """
    hook = sys.unraisablehook

    def without_decoding(problem: sys.UnraisableHookArgs) -> None:
        if not isinstance(problem.exc_value, UnicodeDecodeError):
            hook(problem)

    sys.unraisablehook = without_decoding
    try:
        yield
    finally:
        sys.unraisablehook = hook


def _conversion(selected: Sequence[str], layout: TextLayout) -> pc.ConvertOptions:
    """Types of the wanted columns, float64 or the text of a clock, and texts that count as
    missing.
    """
    return pc.ConvertOptions(
        column_types={
            name: pa.string() if name == layout.clock else pa.float64() for name in selected
        },
        include_columns=list(selected),
        decimal_point=layout.decimal,
        null_values=[*pc.ConvertOptions().null_values, *layout.missing],
    )


def table_stream(file: Path, n_bytes: int | None = None) -> pa.NativeFile:
    """Text of a table, or its first bytes, unpacked as it is read if it ends in ``.gz``, ``.bz2``,
    ``.zst`` or ``.lz4``.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It is a pipe or a folder.
    OSError
        It cannot be opened.
    """
    if n_bytes is not None:
        return table_stream(file).get_stream(0, n_bytes)
    packed = PACKED.get(regular_file(file).suffix.lower())
    # pyarrow opens no name that is not UTF-8
    return pa.input_stream(open(file, "rb"), compression=packed)


def cut_end(file: Path, layout: TextLayout) -> tuple[int, str] | None:
    """Number of bytes before the end of a table that is none of its rows, and the text of this end.

    Of a logger that was switched off while it wrote, it is zero bytes, a last row without an end
    that has fewer cells than the row above or ends within a number, or both; else a `_footer`.
    None where the table is complete, packed or in UTF-16.
    """
    if not is_text(file) or file.suffix.lower() in PACKED or layout.encoding.startswith("utf-16"):
        return None
    with open(regular_file(file), "rb") as stream:
        size = end = stream.seek(0, os.SEEK_END)
        tail = b""
        while end and not tail:
            start = max(end - TAIL, 0)
            stream.seek(start)
            tail = stream.read(end - start).rstrip(b"\0")
            end = start + len(tail)
    *above, last = re.split(r"\r\n|\n|\r", tail.decode(layout.encoding, errors="replace"))
    has_zeros = end < size
    footer = _footer(tail, layout)
    cells, full = (
        next(csv.reader([line], delimiter=layout.delimiter), [])
        for line in (last, above[-1] if above else "")
    )
    is_row = all(re.search(ROW_OF_NUMBERS, line, re.IGNORECASE) for line in (last, *above[-1:]))
    is_unfinished = bool(cells) and UNFINISHED.fullmatch(cells[-1].replace(layout.decimal, "."))
    is_cut = (
        len(cells) < len(full) or has_zeros or (is_unfinished and cells[-1] not in layout.missing)
    )
    if footer or not (last.strip() and is_row and is_cut and len(cells) <= len(full)):
        last = ""
    texts = [f"a last row that is cut short ('{printable(last[-40:])}')"] if last else []
    texts += [f"{number_of(size - end, 'zero byte')} at the end"] if has_zeros else []
    n_bytes = end - len(last.encode(layout.encoding, errors="replace"))
    if footer:
        n_bytes = end - sum(map(len, footer))
        lines = [line.decode(layout.encoding, errors="replace").strip() for line in footer]
        filled = [line for line in lines if line]
        number = number_of(len(filled), "line")
        texts = [f"{number} of text below the rows ('{printable(filled[0][:40])}')", *texts]
    return (n_bytes, " and ".join(texts)) if texts else None


def _footer(tail: bytes, layout: TextLayout) -> list[bytes]:
    """Lines of text with numbers below the rows, such as statistics or a count of records.

    They begin with an empty line, a comment or text alone, and none has the first cell or the
    number of cells of a row; empty where there are none, or where the reader leaves them out as
    they hold no numbers.
    """
    lines = tail.splitlines(keepends=True)
    texts = [line.decode(layout.encoding, errors="replace").strip("\r\n") for line in lines]
    first = max((k + 1 for k, text in enumerate(texts) if BEGINS_AS_ROW.match(text)), default=0)
    filled = [text for text in texts[first:] if text.strip()]
    if not (first and filled):
        return []
    cells = [next(csv.reader([text], delimiter=layout.delimiter)) for text in texts[first - 1 :]]
    has_numbers = [
        bool(re.search(ROW_OF_NUMBERS, text, re.IGNORECASE)) and len(row) > 1
        for text, row in zip(texts[first:], cells[1:], strict=True)
    ]
    begins = not has_numbers[0] or COMMENT.match(texts[first])
    is_apart = all(len(row) != len(cells[0]) for row in cells[1:])
    return lines[first:] if begins and any(has_numbers) and is_apart else []


def require_memory(file: Path, layout: TextLayout) -> None:
    """Refuse a table that would take more memory as a whole than the limits allow.

    Weighed are its unpacked text and `BYTES_PER_CELL` for each delimiter and each end of a line,
    counted block by block without keeping any. Text that is not packed and too short to exceed the
    limit with every byte a cell is not looked through.

    Raises
    ------
    DataError
        It would take more, or cannot be unpacked.
    """
    size = regular_file(file).stat().st_size
    packed = file.suffix.lower() in PACKED
    if not packed and (1 + BYTES_PER_CELL) * size <= current_limits().memory:
        return
    delimiter = layout.delimiter.encode("utf8")
    n_bytes = 0
    try:
        with table_stream(file) as stream:
            while block := stream.read(BLOCK):
                n_cells = block.count(delimiter) + max(block.count(b"\n"), block.count(b"\r"))
                n_bytes += len(block) + BYTES_PER_CELL * n_cells
                check_unpacked(file, size, n_bytes)
    except DAMAGE as error:
        raise _unreadable(file, error) from None


def listed(names: Sequence[str]) -> str:
    """Names for a message: the first twelve, printable and at most 60 characters each."""
    return first_of([printable(name[:60]) for name in names], 12)


def _seconds(file: Path, name: str, cells: pa.ChunkedArray) -> FloatArray:
    """Clock times of a column, shape (N,) [s]; `DataError` for other text."""
    seconds = seconds_of_text(cells)
    if seconds is None:
        raise DataError(
            f"'{file}': column '{name}' holds other text than times such as 10:59:30.25 or "
            "2024-05-03T10:59:30.25"
        )
    return seconds


def _unreadable(file: Path, error: Exception, layout: TextLayout | None = None) -> DataError:
    """The error of pyarrow in one line; with a layout, a cell of text by its column's name."""
    cell = re.search(
        r"CSV column #(\d+): Row #(\d+): .*invalid value '(.*)'", str(error), re.DOTALL
    )
    if cell is not None and layout is not None:
        name = column_names(file, layout)[int(cell[1])]
        above = layout.skip_rows + layout.rows_below_names + (layout.names is None)
        return DataError(
            f"'{file}': column '{name}' holds the text '{printable(cell[3][:40])}' in data row "
            f"{int(cell[2]) - above}; numbers are needed"
        )
    problem = (
        f"a line is longer than {BLOCK} bytes"
        if "straddl" in str(error)
        else printable(first_line(error))
    )
    return DataError(
        f"'{file}' cannot be read as a table ({problem}); is it truncated, or of another format "
        "or encoding?"
    )
