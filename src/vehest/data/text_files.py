"""Reads YAML, JSON and CSV that describe something, within limits on length, nesting and
repetition.

Damage is one line.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from vehest.data.errors import DataError, VehestError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit
from vehest.data.schema import MAX_DEPTH

# largest number of values of a YAML text, each counted as often as aliases repeat it
MAX_YAML_VALUES = 500_000
# YAML loader that builds plain values only
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_text(path: Path) -> str:
    """A regular text file within the limits, as UTF-8; else `MissingError` or `DataError`."""
    size = regular_file(path).stat().st_size
    check_limit("text_bytes", size, f"'{path}' is {size} bytes long")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(
            f"'{path}' is not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from None
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror}") from None


def read_yaml(path: Path) -> Any:
    """Plain values of a YAML file; raises what `read_text` and `parse_yaml` do."""
    return parse_yaml(read_text(path), f"'{path}'")


def parse_yaml(text: str, subject: str) -> Any:
    """Plain values of YAML.

    Raises
    ------
    DataError
        It is not YAML, nests too deep, or repeats itself into too many values.
    """
    check_yaml_size(text, subject)
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{subject} cannot be read as YAML ({first_line(error)})") from None
    except (
        AttributeError,
        LookupError,
    ):  # PyYAML's own, of `!!timestamp soon` and `!!bool perhaps`
        raise DataError(
            f"{subject} cannot be read as YAML (a value is not what its tag, such as !!timestamp, "
            "says)"
        ) from None


def check_yaml_size(text: str, subject: str, max_values: int = MAX_YAML_VALUES) -> None:
    """Refuse YAML that nests too deep or grows too large by its aliases, before anything is built.

    Parameters
    ----------
    text : str
        The YAML.
    subject : str
        The file, for messages.
    max_values : int
        Values that it may hold, those that aliases repeat counted each time.

    Raises
    ------
    DataError
        It holds more, nests deeper than `MAX_DEPTH` levels, or is no YAML.
    """
    try:
        try:
            is_larger = _is_larger(text, max_values, _Loader)
        except (
            yaml.YAMLError
        ):  # libyaml refuses names that are not UTF-8, which are written as surrogates
            is_larger = _is_larger(text, max_values, yaml.SafeLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise DataError(f"{subject} cannot be read as YAML ({first_line(error)})") from None
    if is_larger:
        raise DataError(
            f"{subject} nests deeper than {MAX_DEPTH} levels or holds more than {max_values} "
            "values, "
            "repeated ones included"
        )


def _is_larger(text: str, max_values: int, loader: Any) -> bool:
    """Whether YAML nests deeper than `MAX_DEPTH` or holds more values, each counted as often as
    aliases repeat it.
    """
    sizes: dict[str | None, int] = {}  # of anchored collections
    begun: list[tuple[str | None, int]] = []
    count = 0
    for event in yaml.parse(text, Loader=loader):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = begun.pop()
            sizes[anchor] = count - before
        elif isinstance(event, yaml.NodeEvent):
            count += sizes.get(event.anchor, 1) if isinstance(event, yaml.AliasEvent) else 1
            if isinstance(event, yaml.CollectionStartEvent):
                begun.append((event.anchor, count))
                sizes[event.anchor] = max_values  # until its end: it cannot hold itself
        if count > max_values or len(begun) > MAX_DEPTH:
            return True
    return False


def read_json(path: Path) -> Any:
    """Plain values of a JSON file; raises what `read_text` and `parse_json` do."""
    return parse_json(read_text(path), f"'{path}'")


def parse_json(text: str | bytes, subject: str) -> Any:
    """Plain values of JSON.

    Raises
    ------
    DataError
        It is not JSON, too long, or nests too deep.
    """
    check_limit("text_bytes", len(text), f"{subject} holds a description of {len(text)} bytes")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # a UnicodeDecodeError is a ValueError
        raise DataError(f"{subject} cannot be read as JSON ({first_line(error)})") from None


def write_json(path: Path, content: Any) -> None:
    """Write plain values as JSON; bytes of names that are not UTF-8 become escapes."""
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    path.write_text(text, encoding="utf-8", errors="backslashreplace")


def read_rows(path: Path, columns: Sequence[str] = ()) -> list[dict[str, str]]:
    """Rows of a CSV file whose first line names its columns, such as vehest writes them.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str
        Columns that it must have, beside any others.

    Returns
    -------
    list of dict
        Column -> text of the cell.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It is no CSV, a column is missing, or a row has more or fewer cells than the first line.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_text(path), newline=""), strict=True)
        rows = list(reader)
        header = list(reader.fieldnames or [])
    except (csv.Error, ValueError) as error:
        raise DataError(f"'{path}' cannot be read as CSV ({first_line(error)})") from None
    for name in columns:
        if name not in header:
            raise DataError(f"'{path}' has no column '{name}'")
    for number, row in enumerate(rows, start=1):
        if None in row or None in row.values():
            raise DataError(
                f"'{path}': data row {number} has not {len(header)} columns, as the first line has"
            )
    return rows


def number_in(row: Mapping[str, str], column: str, path: Path) -> float:
    """A number in a row of `read_rows`; infinities and NaN are numbers, too.

    Raises
    ------
    DataError
        The cell is none.
    """
    try:
        return float(row[column])
    except ValueError:
        raise DataError(
            f"'{path}': column '{column}' holds {row[column][:40]!r}, which is no number"
        ) from None


def first_line(error: BaseException) -> str:
    """First line of a library's error, short enough for a message."""
    if isinstance(error, VehestError):
        return str(error)
    if isinstance(error, RecursionError):
        return "it nests too deep"
    text = str(error).strip()
    return text.splitlines()[0][:160] if text else type(error).__name__
