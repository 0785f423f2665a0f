"""Tables of text, Parquet and MAT-files: delimiter, decimal mark, encoding, lines before the names,
a row of units below them.

file -> its first lines -> the `Shape` that explains most of them -> pyarrow -> columns of numbers
and clock times -> `Log`
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.csv as pc

from vehest.constants import FloatArray
from vehest.data.errors import DataError, number_of, printable
from vehest.data.limits import check_limit
from vehest.data.parquet import (
    DAMAGE,
    has_time_unit,
    is_numeric,
    numbers_of,
    parquet_file,
    read_numbers,
)
from vehest.data.text_files import first_line
from vehest.sources.clock_times import past_midnight, seconds_of_text
from vehest.sources.matlab import MatContents, is_matlab, mat_contents, read_mat
from vehest.sources.not_measured import marks_not_measured
from vehest.sources.surveys.clocks import (
    MAX_APART,
    MIN_RATE_HZ,
    NAMED,
    RATES,
    SPELLINGS,
    STATED_UNITS,
    find_clock,
    may_be_times,
    mean_rate,
    pauses_of,
    plain_name,
    times_apart,
)
from vehest.sources.surveys.log import Log, RawColumn
from vehest.sources.surveys.unsuited import require_columns_of_numbers, require_columns_of_signals
from vehest.sources.tables import (
    ROW_OF_NUMBERS,
    TextLayout,
    cut_end,
    is_parquet,
    listed,
    names_of,
    parse_table,
    read_head,
    require_memory,
    table_stream,
    with_names,
)
from vehest.sources.text_log import CLOCK
from vehest.sources.unit_spellings import plain_unit

HEAD = 1 << 18  # bytes at the start of a file by which its layout is found
# characters of a line that are looked at, as many as csv allows in a cell
LONGEST_LINE = csv.field_size_limit()
MAX_ODD_CELLS = 3  # different texts in a column of numbers that count as missing samples
MAX_ODD_SHARE = 0.01  # such cells over the numbers of a column; with more it is a column of texts
MIN_REPEATED_ROWS = 0.1  # share of rows that repeat the one before, above which a table is refused
MIN_SHARE_OF_KIND = 0.1  # share of the texts of a column above which an error names their kind
MIN_UNITS_ABOVE = 0.7  # smallest share of cells that are units, for a row of units above the names
# largest number of lines of names, units, sources and the like, right above the numbers
MAX_HEADER_LINES = 4
# largest number of lines by which the layout is found, those before the names included
MOST_LINES = 600
DELIMITERS = (";", "\t", ",", "|", " ")  # delimiters that are tried
LEAST_NUMBERS = 0.5  # smallest share of cells that are numbers or empty in a row of data
# encoding -> bytes that texts in Windows-1252 hardly have, its letters, and their least share of
# all letters beyond ASCII: Chinese that is read as Korean has few other ones
ENCODINGS = {
    "cp1251": (rb"[\xc0-\xff]{4}", "[А-яЁё]", 0.95),  # Cyrillic
    "cp932": (rb"[\x80-\x9f]", "[ぁ-ヿ一-鿿]", 0.5),  # Shift-JIS as Windows writes it
    "cp949": (rb"[\xa1-\xfe]{4}", "[가-힣]", 0.95),  # EUC-KR
    "gb18030": (rb"[\xa1-\xfe]{4}", "[一-鿿]", 0.5),
}
# control characters that texts do not have; many of them say that a file is no table of text
CONTROLS = bytes([*range(0x09), 0x0B, *range(0x0E, 0x20)])
MOST_CONTROLS = 0.01  # largest share of these in the first bytes of a text
# matches a number with a decimal point
NUMBER = re.compile(r"\s*[+-]?((\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|nan|inf(inity)?)\s*", re.IGNORECASE)
# matches a name with a unit in brackets
BRACKETED = re.compile(r"^(?P<name>.*?)[\s_]*[\[(<{](?P<unit>[^\])>}]*)[\])>}]\s*$")
STATED_RATE = re.compile(
    r"((sampl\w{,6}|updat\w{,6}|logging|log|output|abtast|mess)[ _-]?(rate|freq\w{,8})|^\W*f_?s\b|"
    r"\b(échantillonnage|muestreo|campionamento))(\W*(?P<kilo_before>k)?hz)?\W+"
    r"(?P<hertz>(?!\d+,\d{3}\b)\d[\d.,]*)\W*((?P<kilo_behind>k)?hz\b|$)|"
    r"((sampl\w{,6}|updat\w{,6}|logging)[ _-]?(period|interval|time)|\bdt|abtast(zeit|intervall))"
    r"(\W*(?P<before>[mnuµ]?s))?\W+(?P<step>[\d.,]+)\W*((?P<behind>[mnuµ]?s(ec(onds?)?)?)\b|$)",
    re.IGNORECASE,
)
"""Matches what a line above the names states on the rate of the rows."""
# matches the places and directions in a name
PLACE = r"([_\s](x|y|lat\w*|lon\w*|[fr][lr]|front|rear|left|right))*"
VELOCITY = re.compile(
    rf"(.*[_\s])?(v|v[xy]|vlat|vlon|\w*(speed|spd|velo|geschw)[a-z]*){PLACE}[_\s]ms", re.IGNORECASE
)
"""Matches names of velocities that end in ms for metres a second, as those of delays and ages do
not.
"""
ACCELERATION = re.compile(rf"(.*[_\s])?(a[xyz]|\w*(acc|beschl)[a-z]*){PLACE}[_\s]g", re.IGNORECASE)
"""Matches names of accelerations that end in g."""
DISGUISED = {
    "a unit": r"^\s*[+-]?\d+([.,]\d+)?\s*[A-Za-zµ°%][\wµ°%/·²^-]*\s*$",
    "another minus sign": r"^\s*[−–]\d+([.,]\d+)?\s*$",
    "parentheses for a minus sign": r"^\s*\(\d+([.,]\d+)?\)\s*$",
    "brackets around several of them": (
        r"^\s*[\[(][-+.\d\s]+(e[-+]?\d+)?([\s,;]+[-+.\d]+(e[-+]?\d+)?)+\s*[\])]\s*$"
    ),
    "another mark of the exponent": r"^\s*[+-]?\d+([.,]\d+)?[dD][+-]?\d+\s*$",
    "a separator of thousands": (
        "^\\s*[+-]?\\d{1,3}([,.'\u00a0\u202f\u2009 ]\\d{3})+([.,]\\d+)?\\s*$"
    ),
    "the other decimal mark": r"^\s*[+-]?\d+[.,]\d+\s*$",
}
"""Kind of texts that are numbers for people -> pattern that matches them."""
# matches the message on a column of times that cannot be read
UNREAD_TIMES = re.compile(r"column '(t|time|zeit|timestamp)\b[^']*' holds numbers", re.IGNORECASE)
# abbreviation of a unit in a name -> unit
ABBREVIATED = {
    "radps": "rad/s",
    "degps": "deg/s",
    "degs": "deg/s",
    "rads": "rad/s",
    "ms2": "m/s2",
    "mss": "m/s2",
    "kmh": "km/h",
}


@dataclass(frozen=True)
class Shape:
    """A table of text as one delimiter and decimal mark explain it."""

    layout: TextLayout  # delimiter, decimal mark, encoding and rows above the numbers
    # names of the columns; empty where no line above the numbers has them
    names: tuple[str, ...] = ()
    # name of a column -> unit in the row below the names, if there is one
    units: Mapping[str, str] = field(default_factory=dict)
    # share of cells of numbers in rows of one length, and a hundredth for each column; 0 where
    # there is no such row
    score: float = 0.0
    rate_hz: float | None = None  # rate that a line above the names states [Hz]
    fault: str = ""  # text on what to do where there are no names


def survey_table(file: Path) -> Log:
    """Columns, clock and layout of a table of text, Parquet or a MAT-file.

    The source is ``text_log`` where ``tabular`` cannot read it: with rows below the names, marks of
    missing samples, or clock times.

    Raises
    ------
    DataError
        It is no table, has no names, holds no numbers or fewer than two rows of them, is in long
        format, or each of its channels has times of its own.
    """
    clocks: dict[str, FloatArray] = {}
    options: dict[str, Any] = {}
    skipped: list[str] = []
    repeated: tuple[int, ...] = ()
    rate_hz: float | None = None
    if is_parquet(file):
        with parquet_file(file) as table:
            units = {
                field.name: field.type.unit
                for field in table.schema_arrow
                if has_time_unit(field.type)
            }
            names = [
                field.name
                for field in table.schema_arrow
                if field.name in units or is_numeric(field.type)
            ]
            others = [field for field in table.schema_arrow if field.name not in names]
            require_columns_of_numbers(file, names, [field.name for field in others])
            skipped = [_unread_column(field) for field in others]
            check_limit("columns", len(names), f"'{file}' has {len(names)} columns")
            values = read_numbers(file, table, names)
    elif is_matlab(file):
        contents = mat_contents(file)
        names = [name for name, size in contents.lengths.items() if size == contents.n_rows]
        skipped = _of_other_lengths(contents)
        units = dict(contents.units)
        values = read_mat(file, names)
    else:
        shape = shape_of(file)
        table, skipped = _table(file, shape)
        cells, repeated, marks, texts = _without_texts(file, table, shape)
        skipped += texts
        values, clocks, odd_marks, unread = _columns(file, shape, cells)
        marks |= odd_marks
        skipped += unread
        units = dict(shape.units)
        rate_hz = shape.rate_hz
        usual = asdict(TextLayout(delimiter="", decimal=""))  # which are always stated
        options = {
            name: option for name, option in asdict(shape.layout).items() if option != usual[name]
        }
        options |= {"missing": sorted(marks)} if marks else {}
    unnamed_times = values.pop("", None)
    if not values:
        raise DataError(
            f"'{file}' holds no column of numbers{f' ({skipped[0]})' if skipped else ''}"
        )
    n_rows = len(next(iter(values.values())))
    if n_rows < 2:
        raise DataError(
            f"'{file}' has {n_rows or 'no'} row{'s' * (n_rows != 1)} of numbers below its names"
        )
    written = {name: units.get(name) or unit_in_name(name) for name in values}
    times_and_values = clocks | values
    units_of_times = written | dict.fromkeys(clocks, "s")
    if apart := times_apart(times_and_values, units_of_times):
        raise DataError(
            f"'{file}' has several columns of times, {listed(apart)}, which differ within a row by "
            f"more than {MAX_APART:g} s: its channels have clocks of their own; export it with one "
            "common column of times (resampled to one rate)"
        )
    stamps, seconds, runs, cuts = find_clock(times_and_values, units_of_times)
    if stamps is not None and stamps.column in clocks:
        stamps = replace(
            stamps,
            unit=CLOCK,
            evidence=stamps.evidence.replace("unit in the header", "times of a clock"),
            asked=False,
        )
    clock = None if stamps is None else stamps.column
    named = {
        name: times
        for name, times in values.items()
        if clock is None and NAMED.match(plain_name(name))
    }
    faults = [_fault(name, times) for name, times in (clocks | named).items() if name != clock]
    rate_source = "a line above the names"
    for name, times in named.items():
        _require_rows_once(file, name, times, values)
    if stamps is None and rate_hz is None:
        unread_times = [text for text in skipped if UNREAD_TIMES.match(text)]
        if unread_times:
            raise DataError(f"'{file}': {unread_times[0]}")
        if unnamed_times is not None:
            named |= {"": unnamed_times}
        rate_source = "the times of a column that is not read, on average"
        for name, times in named.items():
            rate_hz = mean_rate(name, times, written.get(name, ""))
            if rate_hz is None:
                continue
            if len(pauses := pauses_of(times)):
                skipped.append(
                    f"{number_of(len(pauses), 'pause')} of '{printable(name)}', the longest by "
                    f"{pauses.max():.4g}: the rows on both sides follow one another without it; "
                    "split the file there"
                )
            break
    if stamps is not None and stamps.repair.get("sort"):
        rows = np.argsort(times_and_values[stamps.column], kind="stable")
        values = {name: samples[rows] for name, samples in values.items()}
    options |= cuts
    beside = {clock, cuts.get("runs")}
    columns = [
        RawColumn(name, written[name], samples, {"column": name})
        for name, samples in values.items()
        if name not in beside
    ]
    is_text_log = {"rows_below_names", "missing"} & set(options) or clock in clocks
    return Log(
        file,
        "text_log" if is_text_log else "tabular",
        tuple(columns),
        options,
        stamps,
        seconds,
        runs,
        (*skipped, *faults),
        repeated,
        rate_hz,
        rate_source,
    )


def _unread_column(field: pa.Field) -> str:
    """Text on a column of Parquet that is not read, and the way out where it is nested."""
    text = f"column '{printable(field.name)}' holds {str(field.type)[:60]}"
    if pa.types.is_string(field.type) or pa.types.is_large_string(field.type):
        return f"{text}; if these are numbers, write them as such (in pandas: .astype(float))"
    if pa.types.is_struct(field.type):
        return f"{text}; make a column of each of its fields (in pyarrow: Table.flatten())"
    if pa.types.is_nested(field.type):
        return f"{text}; make a column of each of its elements (in pandas: .str[0], .str[1] …)"
    return text


def _of_other_lengths(contents: MatContents) -> list[str]:
    """Texts on what is not read of a MAT-file, columns that have another number of samples than
    most among it.
    """
    others: dict[int, list[str]] = {}
    for name, size in contents.lengths.items():
        if size != contents.n_rows:
            others.setdefault(size, []).append(name)
    return [
        *contents.skipped,
        *(
            f"{listed(names)}, of {size} samples instead of {contents.n_rows}; resample to one "
            "rate what is needed, for example in MATLAB by interp1"
            for size, names in others.items()
        ),
    ]


def _require_rows_once(
    file: Path, name: str, times: FloatArray, values: Mapping[str, FloatArray]
) -> None:
    """Refuse, by a `DataError`, a table that writes its rows several times, by whose distinct rows
    its times, (N,), are a clock.
    """
    rows = np.nan_to_num(np.stack([*values.values()]))
    is_new = np.append(True, (np.diff(rows) != 0.0).any(axis=0))
    n_repeats = int((~is_new).sum())
    if n_repeats < MIN_REPEATED_ROWS * len(times) or (np.diff(times[is_new]) <= 0.0).any():
        return
    raise DataError(
        f"'{file}' repeats {n_repeats} of its {len(times)} rows, the times '{printable(name)}' "
        f"included; remove the repeats, for example by pandas: read_csv('{file.name}')"
        f".drop_duplicates().to_csv('{file.stem}_once.csv', index=False)"
    )


def _fault(name: str, times: FloatArray) -> str:
    """Text on why no clock can be made of a column of times, or of one that is named so."""
    steps = np.diff(times)
    back = (steps < 0).sum()
    n_repeats = (steps == 0).sum()
    fault = f"repeats {n_repeats} times" if n_repeats else "does not grow evenly"
    if back:
        fault = f"goes backwards {back} times" + ("; sort the rows" if back > 1 else "")
    return f"column '{printable(name)}' as the time: it {fault}"


def unit_in_name(name: str) -> str:
    """The unit that a column's name ends in, as it is written there.

    It stands in brackets, ``Speed [km/h]``, unless they hold an index, ``xyz[2]``, or behind the
    last blank or underscore, ``ay_mps2``, where it is a known unit or abbreviation of two letters
    or more; ``ms`` of a velocity is m/s, ``g`` of an acceleration that of gravity.

    Returns
    -------
    str
        Empty where there is none.
    """
    bracketed = BRACKETED.match(name.strip())
    if bracketed:
        unit = bracketed["unit"].strip()
        return "" if unit.isdigit() else unit
    words = re.split(r"[_\s]+", name.strip())
    last = words[-1].lower() if len(words) > 1 else ""
    if last == "ms" and VELOCITY.fullmatch(name.strip()):
        return "m/s"
    if last == "g" and ACCELERATION.fullmatch(name.strip()):
        return "g"
    return ABBREVIATED.get(last) or (last if _is_unit(last) and len(last) > 1 else "")


def shape_of(file: Path) -> Shape:
    """Layout of a table of text, by its beginning: of all delimiters and decimal marks the pair by
    which most cells are numbers.

    Raises
    ------
    DataError
        The file is no table of text, has one column, no line of names or more columns than the
        limits allow, or its columns are not signals.
    """
    head = read_head(file, HEAD)
    is_whole = len(head) < HEAD
    encoding, text = _decoded(head.rstrip(b"\0") if is_whole else head, file)
    lines = [
        line[:LONGEST_LINE]
        for line in re.split(r"\r\n|\n|\r", text)[: None if is_whole else -1][:MOST_LINES]
    ]
    tables = {delimiter: _rows(lines, delimiter) for delimiter in DELIMITERS}
    require_columns_of_signals(file, lines, tables)
    shapes = [
        _shape(rows, delimiter, decimal, encoding)
        for delimiter, rows in tables.items()
        for decimal in (".", ",")
    ]
    best = max(shapes, key=lambda shape: shape.score)
    if not best.score:
        cells = [
            cell for row in [*tables[";"].values(), *tables[","].values()][-40:] for cell in row
        ]
        kind = _kind_of_text(pa.chunked_array([cells], pa.string()))
        advice = "is it a table of text, with names in a line above the numbers?"
        why = advice if kind == "text" else f"it holds {kind}"
        raise DataError(f"'{file}' holds no rows of two numbers or more; {why}")
    if not best.names:
        raise DataError(f"'{file}' has no line of names above its first numbers; {best.fault}")
    check_limit("columns", len(best.names), f"'{file}' has {len(best.names)} columns")
    return replace(best, rate_hz=_stated_rate(lines[: best.layout.skip_rows]))


def _stated_rate(lines: Sequence[str]) -> float | None:
    """Rate of the rows that a line above the names states [Hz], if it is one of a logger."""
    for stated in filter(None, map(STATED_RATE.search, lines)):
        with suppress(ValueError, ZeroDivisionError):
            number = float((stated["hertz"] or stated["step"]).strip(".,").replace(",", "."))
            unit = (stated["before"] or stated["behind"] or "s").lower()
            step = number * STATED_UNITS[SPELLINGS.get(unit[:2], "s")]
            factor = 1e3 if stated["kilo_before"] or stated["kilo_behind"] else 1.0
            rate_hz = factor * number if stated["hertz"] else 1.0 / step
            if MIN_RATE_HZ <= rate_hz <= RATES[1]:
                return rate_hz
    return None


def _rows(lines: Sequence[str], delimiter: str) -> dict[int, list[str]]:
    """Number of each line that holds something -> its cells."""
    split = [next(csv.reader([line], delimiter=delimiter), []) for line in lines]
    return {k: row for k, row in enumerate(split) if any(cell.strip() for cell in row)}


def _shape(rows: Mapping[int, list[str]], delimiter: str, decimal: str, encoding: str) -> Shape:
    """The table that a decimal mark makes of rows: names and units stand right above the first two
    rows of numbers.
    """
    lengths = [len(row) for row in rows.values()][len(rows) // 2 :]
    n_columns = max(set(lengths), key=lengths.count, default=0)
    shares = {k: _share(row, decimal) for k, row in rows.items() if len(row) == n_columns > 1}
    data = [k for k, share in shares.items() if share >= LEAST_NUMBERS]
    if not data:
        return Shape(TextLayout())
    first = next(k for k, after in pairwise([*data, data[-1] + 1]) if after - k == 1)
    score = sum(shares[k] for k in data) / len(rows) + 0.01 * min(n_columns, 20)
    first_row = rows[first]
    above = [
        k for k, row in rows.items() if k < first and len(names_of(row, first_row)) == n_columns
    ]
    if not above:
        is_short = len(rows.get(first - 1, ())) == n_columns - 1
        fault = (
            "the line there has one name less than the rows have cells: begin it with a name of "
            f"the first column, such as 'row{delimiter}'"
            if is_short
            else "write one there"
        )
        return Shape(TextLayout(), score=score, fault=fault)
    at = _names_at(rows, above)
    units_at = next((k for k in above if k > at and _are_units(rows[k])), None)
    if units_at is None and at - 1 in above and _are_units(rows[at - 1], MIN_UNITS_ABOVE):
        units_at = at - 1
    names = tuple(names_of(rows[at], first_row))
    cells = [] if units_at is None else rows[units_at]
    units = dict(zip(names, map(str.strip, cells), strict=False))
    layout = TextLayout(
        delimiter, decimal, encoding, skip_rows=at, rows_below_names=sum(k > at for k in above)
    )
    return Shape(layout, names, units, score)


def _names_at(rows: Mapping[int, list[str]], above: Sequence[int]) -> int:
    """Index of the line of the names among those above the numbers: of most names, over the units
    if any.
    """
    block = [k for k in above if k > above[-1] - MAX_HEADER_LINES]
    units_at = next((k for k in block[1:] if _are_units(rows[k])), None)
    block = [k for k in block if units_at is None or k < units_at]
    if units_at is None and len(block) > 2 and _are_units(rows[block[0]], MIN_UNITS_ABOVE):
        return block[1]  # over a row of descriptions
    n_names = {
        k: len({cell for cell in rows[k] if cell.strip() and not _is_unit(cell)}) for k in block
    }
    return max(block, key=lambda k: (n_names[k] > 0.9 * max(n_names.values()), k))


def _share(row: Sequence[str], decimal: str) -> float:
    """Share of cells that are numbers, without empty ones; 0 where there is none."""
    filled = [cell for cell in row if cell.strip()]
    others = [cell for cell in filled if not _is_number(cell, decimal)]
    n_marks = sum(map(marks_not_measured, others))
    n_numbers = len(filled) - len(others)
    return n_numbers / (len(filled) - n_marks) if n_numbers else 0.0


def _is_number(cell: str, decimal: str) -> bool:
    """Whether a cell, perhaps quoted, is a number; with a decimal comma, no point may be in it."""
    text = cell.strip().strip('"')
    return not (decimal == "," and "." in text) and bool(
        NUMBER.fullmatch(text.replace(decimal, "."))
    )


def _are_units(cells: Sequence[str], min_share: float = 0.3) -> bool:
    """Whether a row beside the names holds units: some that are known, or brackets, and no longer
    words.
    """
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() -")]
    if not filled:
        return any(cell.strip() for cell in cells)
    return sum(map(_is_unit, filled)) >= max(1, min_share * len(filled)) and all(
        len(cell) <= 12 for cell in filled
    )


def _is_unit(text: str) -> bool:
    """Whether a word is a known unit, of a channel or of time."""
    return plain_unit(text) is not None or text.lower() in SPELLINGS


def _decoded(head: bytes, file: Path) -> tuple[str, str]:
    """Encoding and text of the beginning of a file.

    UTF-16 by its mark, then UTF-8, then one of `ENCODINGS` if it makes words of its language, then
    Windows-1252; Latin-1 where none of them fits. `DataError` where control characters say that it
    is no text.
    """
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16", head.decode("utf-16", errors="replace")
    if head.startswith(b"\x1f\x8b"):
        raise DataError(f"'{file}' is compressed by gzip; let its name end in '.csv.gz'")
    n_controls = len(head) - len(head.translate(None, CONTROLS))
    if b"\0" in head or n_controls > MOST_CONTROLS * len(head):
        raise DataError(
            f"'{file}' is no table of text (it holds control characters); save its channels as CSV"
        )
    encodings = {"utf8": "utf-8-sig"}
    if not head.isascii():
        encodings |= {name: name for name, (rare, *_) in ENCODINGS.items() if re.search(rare, head)}
        encodings |= {"cp1252": "cp1252"} if re.search(rb"[\x80-\x9f]", head) else {}
    for name, encoding in encodings.items():
        with suppress(UnicodeDecodeError):
            text = codecs.getincrementaldecoder(encoding)().decode(head, final=len(head) < HEAD)
            if name not in ENCODINGS or _has_words(text, *ENCODINGS[name][1:]):
                return name, text
    return "latin-1", head.decode("latin-1")


def _has_words(text: str, letter: str, min_share: float) -> bool:
    """Whether two of some letters stand together, as accents in Windows-1252 hardly make them, and
    they have a share of all letters beyond ASCII.
    """
    n_letters = sum(not character.isascii() and character.isalpha() for character in text)
    is_language = len(re.findall(letter, text)) >= min_share * n_letters
    return is_language and bool(re.search(f"{letter}{{2}}", text))


def _without_texts(
    file: Path, table: pa.Table, shape: Shape
) -> tuple[pa.Table, tuple[int, ...], set[str], list[str]]:
    """Cells without rows of texts, as joined files have between their parts, or that begin with
    text above or below the numbers, as statistics do.

    Returns
    -------
    table : pa.Table
        The remaining rows.
    rows : tuple of int
        Numbers of the others, from 1.
    marks : set of str
        Their texts, which are no numbers.
    skipped : list of str
        Those of the rows that hold other texts than names and units.
    """
    named = zip(table.columns, shape.names, strict=False)
    texts = [(column, name) for column, name in named if name and pa.types.is_string(column.type)]
    if not texts:
        return table, (), set(), []
    is_text = np.zeros(table.num_rows, dtype=bool)
    is_text[_rows_without_numbers(table, shape)] = True
    column, name = texts[0]
    is_row = compute.match_substring_regex(column, ROW_OF_NUMBERS, ignore_case=True)
    numbered = np.flatnonzero(is_row.fill_null(True))
    first, below = (numbered[0], numbered[-1] + 1) if len(numbered) else (0, 0)
    if name != shape.names[0] or below - first < (1.0 - MAX_ODD_SHARE) * table.num_rows:
        first, below = 0, table.num_rows
    is_text[:first] = True
    is_text[below:] = True
    removed = table.filter(pa.array(is_text))
    cells_by_column = [column.cast(pa.string()).to_pylist() for column in removed.columns]
    rows = (np.flatnonzero(is_text) + 1).tolist()
    marks: set[str] = set()
    skipped = []
    for row, cells in zip(rows, zip(*cells_by_column, strict=True), strict=True):
        filled = {k: cell for k, cell in enumerate(cells) if cell and cell.strip()}
        marks |= {cell for cell in filled.values() if not _is_number(cell, shape.layout.decimal)}
        others = [cell for k, cell in filled.items() if cell.strip() not in _header(shape, k)]
        if not others or not first < row <= below:
            continue
        if set(map(str.strip, others)) & {*shape.names} or _are_units([*filled.values()]):
            raise DataError(
                f"'{file}': data row {row} holds other names or units than the lines above the "
                f"numbers, such as '{printable(others[0].strip())}'; save the rows from there on "
                "as a file of its own, and create a data set for each"
            )
        skipped.append(f"data row {row}, '{printable(others[0].strip())}'")
    return table.filter(pa.array(~is_text)), tuple(rows), marks, skipped


def _header(shape: Shape, k: int) -> tuple[str, str]:
    """Name and unit of a column by the lines above the numbers; empty where there is none."""
    name = shape.names[k] if k < len(shape.names) else ""
    return name, shape.units.get(name, "")


def _rows_without_numbers(table: pa.Table, shape: Shape) -> list[int]:
    """Rows in which nothing but names and units holds a digit, and a cell is more than a mark of a
    missing sample.
    """
    rows = np.arange(table.num_rows)
    for k, column in enumerate(table.columns):
        cells = column.take(pa.array(rows))
        if pa.types.is_string(cells.type):
            header = pa.array(_header(shape, k))
            is_header = compute.is_in(compute.utf8_trim_whitespace(cells), value_set=header)
            has_digit = compute.match_substring_regex(cells, r"\d").fill_null(False)
            rows = rows[np.asarray(compute.or_(is_header, compute.invert(has_digit)))]
        else:
            rows = rows[np.asarray(cells.is_null())]
    remaining = table.take(pa.array(rows))
    columns = (column.cast(pa.string()).to_pylist() for column in remaining.columns)
    return [
        row
        for row, *cells in zip(rows.tolist(), *columns, strict=True)
        if any(cell and cell.strip() and not marks_not_measured(cell) for cell in cells)
    ]


def _columns(
    file: Path, shape: Shape, table: pa.Table
) -> tuple[dict[str, FloatArray], dict[str, FloatArray], set[str], list[str]]:
    """Columns of a table, by what they hold.

    Returns
    -------
    values : dict
        Name -> numbers, NaN where a sample is missing, shape (N,); under an empty name those of the
        first column without one that may be times.
    clocks : dict
        Name -> times of a clock, shape (N,) [s].
    marks : set of str
        Texts that mark a missing sample.
    skipped : list of str
        What was not read, and why.
    """
    check_limit("samples", table.num_rows, f"'{file}' has {table.num_rows} rows")
    values: dict[str, FloatArray] = {}
    clocks: dict[str, FloatArray] = {}
    marks: set[str] = set()
    skipped = []
    for place, (name, column) in enumerate(zip(shape.names, table.columns, strict=False), start=1):
        if column.null_count == len(column):
            skipped += [f"column '{printable(name)}' is empty"] if name else []
        elif not name:
            skipped.append(f"column {place} has no name")
            numbers = _numbers(column, shape.layout.decimal)
            if numbers is not None and may_be_times(numbers[0]):
                skipped[-1] += " and grows as times do; name it 'time'"
                values.setdefault("", numbers[0])
        elif (numbers := _numbers(column, shape.layout.decimal)) is not None:
            values[name], column_marks, odd = numbers
            if NAMED.match(plain_name(name)) and _shows_a_clock(values[name]):
                digits = values.pop(name)
                minutes = digits // 100 % 100 + 60 * (digits // 10_000)
                clocks[name] = past_midnight(digits % 100 + 60 * minutes)
            elif _may_be_dates(column) and (dated := _seconds(column)) is not None:
                del values[name]
                clocks[name] = dated
            marks |= column_marks
            skipped += [
                f"'{printable(text)}' in data row {row} of column '{printable(name)}'"
                for text, row in odd.items()
            ]
        elif (seconds := _seconds(column)) is not None:
            clocks[name] = seconds
        else:
            skipped.append(f"column '{printable(name)}' holds {_kind_of_text(column)}")
    return values, clocks, marks, skipped


def _seconds(column: pa.ChunkedArray) -> FloatArray | None:
    """Times of a clock, shape (N,) [s]; None where a column holds anything else."""
    return seconds_of_text(column.cast(pa.string(), safe=False))


def _may_be_dates(column: pa.ChunkedArray) -> bool:
    """Whether numbers may be yyyymmddhhmmss of this century, perhaps with milliseconds."""
    first = column[0].as_py() if pa.types.is_integer(column.type) else None
    return first is not None and any(2.0 <= first / 10**zeros < 2.1 for zeros in (13, 16))


def _shows_a_clock(numbers: FloatArray) -> bool:
    """Whether numbers are times hhmmss.sss: 59 is followed by 100."""
    minutes, seconds = np.divmod(numbers, 100.0)
    is_time = (numbers >= 0.0) & (numbers < 240_000.0) & (minutes % 100.0 < 60.0) & (seconds < 60.0)
    return bool(is_time.all() and np.ptp(minutes) > 0.0 and np.ptp(seconds) > 50.0)


def _kind_of_text(column: pa.ChunkedArray) -> str:
    """Text on the cells of a column, and the way out where they are numbers in disguise."""
    texts = column.cast(pa.string(), safe=False).drop_null()
    for kind, pattern in DISGUISED.items():
        example = texts.filter(compute.match_substring_regex(texts, pattern))
        if len(example) > MIN_SHARE_OF_KIND * len(texts):
            text = printable(example[0].as_py().strip())
            return f"numbers with {kind}, such as '{text}'; export plain numbers"
    return "text"


def _table(file: Path, shape: Shape) -> tuple[pa.Table, list[str]]:
    """All cells: converted by pyarrow or, where some columns hold numbers first and text later, as
    they stand; lines that are none of its rows.
    """
    inferred = pc.ConvertOptions(decimal_point=shape.layout.decimal)
    text = pc.ConvertOptions(
        column_types=dict.fromkeys(shape.names, pa.string()), strings_can_be_null=True
    )
    require_memory(file, shape.layout)
    n_bytes, left_out = cut_end(file, shape.layout) or (None, "")
    opened = partial(table_stream, file, n_bytes)
    problem = None
    for convert in (inferred, text):
        lines: list[str] = []
        try:
            layout = with_names(file, shape.layout)
            table = parse_table(opened, layout, convert, lines)
            texts = [f"line '{printable(line.strip()[:60])}'" for line in lines]
            return table, [left_out, *texts] if left_out else texts
        except DAMAGE as error:
            problem = printable(first_line(error))
    raise DataError(
        f"'{file}' cannot be read as a table ({problem}); is it truncated, is a line of text or a "
        "second table below its rows, or are its columns aligned by blanks? A file needs one table "
        "alone, with a separator between its cells"
    )


def _numbers(
    column: pa.ChunkedArray, decimal: str
) -> tuple[FloatArray, set[str], dict[str, int]] | None:
    """A column as numbers, marks in it that stand for a missing sample, and odd cells -> their row.

    Few odd cells among numbers count as marks. None where the column holds anything else.
    """
    if not pa.types.is_string(column.type):
        return (numbers_of(column), set(), {}) if is_numeric(column.type) else None
    plain = compute.utf8_trim_whitespace(column)
    if decimal == ",":  # a point is then no part of a number
        plain = compute.replace_substring(compute.replace_substring(plain, ".", "?"), ",", ".")
    is_number = compute.match_substring_regex(plain, f"^({NUMBER.pattern})$", ignore_case=True)
    is_other = compute.fill_null(compute.invert(is_number), False)
    other_texts = compute.unique(column.filter(is_other)).to_pylist()
    odd = [text for text in other_texts if text.strip() and not marks_not_measured(text)]
    rows = {text: compute.index(column, text).as_py() + 1 for text in odd[:MAX_ODD_CELLS]}
    n_odd = compute.sum(compute.is_in(column, pa.array(odd, pa.string()))).as_py() or 0
    if len(odd) > MAX_ODD_CELLS or n_odd > MAX_ODD_SHARE * (compute.sum(is_number).as_py() or 0):
        return None
    column = compute.if_else(is_other, pa.scalar(None, pa.string()), plain)
    return numbers_of(column), {text for text in other_texts if text.strip()}, rows
