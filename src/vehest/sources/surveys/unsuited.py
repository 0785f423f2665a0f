"""Files of text that hold no table with a column a signal: JSON, long format, raw frames, quoted
rows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path

from vehest.data.errors import DataError, printable

# matches a line of candump
_CANDUMP = re.compile(r"\s*\([\d.: -]+\)\s+\w+\s+[0-9A-Fa-f]{3,8}(#|\s+\[)")
# matches cells that are aligned by blanks
_ALIGNED = re.compile(r"[^\s;,]+([ ]+[^\s;,]+)*[ ]{2,}[^\s;,]+([ ]+[^\s;,]+)*")
# matches names of columns that name a quantity
_NAMES_SIGNAL = re.compile(
    r"(signal|channel|sensor|(mess)?kanal|parameter|variable|telemetry|quantity|measurement|metric|"
    r"field|topic|tag|key|pid|messgr(ö|oe)(ß|ss)e|bezeichnung)(_?(name|id))?|\w*_name|name",
    re.IGNORECASE,
)
# matches names of columns of values
_NAMES_VALUE = re.compile(r"(\w*_)?(value|val|(mess)?wert|reading|data)", re.IGNORECASE)
# matches a line of InfluxDB's line protocol
_LINE_PROTOCOL = re.compile(r"[^\s,]+(,[^\s=]+=\S+)? [^\s=]+=\S+( \d{10,19})?")
# matches a number, or nothing
_NUMBER = re.compile(r"\s*[-+]?(\d+([.,]\d*)?|[.,]\d+)(e[-+]?\d+)?\s*|", re.IGNORECASE)
_JSON = re.compile(r"(\d+(\.\d+)?: *)?(\{\s*(\"|$)|\[\s*(\{|\[|$)).*")  # matches the start of JSON
# matches a message of a GNSS receiver
_RECEIVER_MESSAGE = re.compile(r"[#$%][A-Z]\w{3,},.*\*[0-9A-Fa-f]{2,8}")
# matches names of columns of identifiers of frames
_NAMES_FRAME = re.compile(
    r"((can|arb(itration)?|frame|msg|message)?[_ ]?id(entifier)?(_?hex)?)", re.IGNORECASE
)
# matches names of columns of bytes of frames
_NAMES_BYTES = re.compile(
    r"data([_ ]?(bytes|hex|field))?|payload|(data|byte|d|b)[_ ]?[07]|dlc", re.IGNORECASE
)
# matches bytes in hexadecimal digits
_BYTES = re.compile(r"(0x)?[0-9A-Fa-f]{2}([ _:-]?[0-9A-Fa-f]{2})*")
MIN_ROWS_OF_SIGNAL = 5  # smallest mean number of rows of each quantity in long format
# largest number of columns of a table in long format, where its beginning does not show several
# quantities
MAX_COLUMNS = 8


def require_columns_of_signals(
    file: Path, lines: Sequence[str], tables: Mapping[str, Mapping[int, list[str]]]
) -> None:
    """Refuse a text whose columns are not signals, with the way out.

    Parameters
    ----------
    file : Path
        For messages.
    lines : sequence of str
        First lines of the file.
    tables : mapping
        Delimiter -> number of each line that holds something -> its cells.

    Raises
    ------
    DataError
        It holds JSON, messages of a satellite receiver, raw frames of a bus, InfluxDB's line
        protocol, columns that are aligned by blanks, a row for each signal, rows in one pair of
        quotes, or a value a row (long format).
    """
    filled = [line.strip() for line in lines if line.strip()]
    if filled and _JSON.fullmatch(filled[0]):
        raise DataError(
            f"'{file}' is JSON; save a table with a row for each time and a column of each "
            "quantity, for example by pandas: json_normalize(…).to_csv('wide.csv')"
        )
    kinds_of_lines = {
        _RECEIVER_MESSAGE.fullmatch: (
            "holds messages of a satellite receiver (NMEA or NovAtel's ASCII); convert "
            "them to a table with a column of each quantity, by the receiver's software"
        ),
        _CANDUMP.match: (
            "holds raw frames of a CAN bus as candump writes them; name the DBC file of "
            f"the bus behind it, as in: vehest new my_car {file.stem}.log car.dbc"
        ),
        _LINE_PROTOCOL.fullmatch: (
            "is in InfluxDB's line protocol; export a table with a column of each field, "
            "for example by a query that ends in pivot()"
        ),
    }
    for matches, text in kinds_of_lines.items():
        if filled and all(map(matches, filled[:20])):
            raise DataError(f"'{file}' {text}")
    if filled and sum(map(bool, map(_ALIGNED.fullmatch, filled))) > 0.9 * len(filled):
        raise DataError(
            f"'{file}' has columns that are aligned by blanks; put one mark between them, "
            f"for example by: sed -E 's/^ +//; s/ +/;/g' {file.name} > {file.stem}.csv"
        )
    for delimiter, rows in tables.items():
        _require_rows_of_times(file, [*rows.values()])
        table = [row for row in rows.values() if len(row) > 1]
        if table:
            _require_no_frames(file, table)
            _require_wide_format(file, table)
        quoted = [row for row in rows.values() if len(row) == 1 and row[0].count(delimiter) > 1]
        if delimiter in ";\t," and len(quoted) > 0.9 * len(rows) and filled[-1].startswith('"'):
            raise DataError(
                f"'{file}' has each row in one pair of quotes; "
                f"remove them, for example by: sed -i 's/^\"//; s/\"$//' {file.name}"
            )


def _require_rows_of_times(file: Path, rows: Sequence[Sequence[str]]) -> None:
    """Refuse, by a `DataError`, a table with a row for each signal: a name, and all its numbers."""
    longest = max(map(len, rows), default=0)
    is_wide = 1 < len(rows) < longest / MIN_ROWS_OF_SIGNAL
    if is_wide and all(
        _NUMBER.fullmatch(row[0]) is None and all(map(_NUMBER.fullmatch, row[1:])) for row in rows
    ):
        raise DataError(
            f"'{file}' has a row for each signal; transpose it, for example by pandas: "
            f"read_csv('{file.name}', header=None, index_col=0).T.to_csv('columns.csv', "
            "index=False)"
        )


def _require_no_frames(file: Path, table: Sequence[Sequence[str]]) -> None:
    """Refuse, by a `DataError`, a table whose names are those of an identifier and of bytes, with
    bytes or whole numbers below them.
    """
    for header, row in pairwise(table[:21]):
        cells = dict(zip(map(str.strip, header), map(str.strip, row), strict=False))
        has_id = any(map(_NAMES_FRAME.fullmatch, cells))
        in_bytes = [cell for name, cell in cells.items() if _NAMES_BYTES.fullmatch(name)]
        if (
            has_id
            and in_bytes
            and any(_BYTES.fullmatch(cell) or cell.isdigit() for cell in in_bytes)
        ):
            raise DataError(
                f"'{file}' holds raw frames of a CAN bus; decode them by the bus's DBC, or save "
                "them as .asc, .blf or candump's .log for: vehest new my_car lap.asc car.dbc"
            )


def _require_wide_format(file: Path, table: Sequence[Sequence[str]]) -> None:
    """Refuse, by a `DataError`, a table in which one column names a quantity and another has its
    value.

    The names must be texts that repeat, each in `MIN_ROWS_OF_SIGNAL` rows on average.
    """
    for at, header in enumerate(table[:20]):
        rows = [row for row in table[at + 1 :] if len(row) == len(header)]
        for k, value in product(*_places_in_long_format(header)):
            names = [row[k] for row in rows]
            n_names = len(set(names))
            is_text = not any(name.strip().lstrip("+-")[:1].isdigit() for name in names)
            has_few_names = 1 <= n_names <= len(rows) / MIN_ROWS_OF_SIGNAL
            is_certain = n_names > 1 or len(header) <= MAX_COLUMNS or header[k] == "_field"
            if is_text and has_few_names and is_certain:
                raise _in_long_format(file, header[k], header[value])


def require_columns_of_numbers(file: Path, numbers: Sequence[str], texts: Sequence[str]) -> None:
    """Refuse columns of numbers and texts in long format, with the way out.

    Parameters
    ----------
    file : Path
        For messages.
    numbers, texts : sequence of str
        Names of the columns that hold numbers, and of the others.

    Raises
    ------
    DataError
        One of the texts is named as a quantity's name is, and one of the numbers as its value, in a
        table of at most `MAX_COLUMNS` columns.
    """
    signals, _ = _places_in_long_format(texts)
    _, values = _places_in_long_format(numbers)
    if signals and values and len(numbers) + len(texts) <= MAX_COLUMNS:
        raise _in_long_format(file, texts[signals[0]], numbers[values[0]])


def _places_in_long_format(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Indices of columns that may name a quantity, and of those that may hold its value."""
    plain = [name.strip(" _") for name in names]
    signals = [k for k, name in enumerate(plain) if _NAMES_SIGNAL.fullmatch(name)]
    return signals, [k for k, name in enumerate(plain) if _NAMES_VALUE.fullmatch(name)]


def _in_long_format(file: Path, signal: str, value: str) -> DataError:
    """The error for a table in long format, by its columns of names and values."""
    signal, value = printable(signal.strip()), printable(value.strip())
    return DataError(
        f"'{file}' is in long format, one value a row: '{signal}' names the quantity, "
        f"'{value}' holds it; make a column of each, for example by pandas: "
        f"table.pivot_table(index='TIME', columns='{signal}', values='{value}')"
        ".interpolate().to_csv('wide.csv'), with the name of the column of times"
    )
