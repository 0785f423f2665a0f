"""Reading YAML and JSON that somebody else may have written: bounded in length, depth and repetition, and one line if it is damaged."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from vehest.data.errors import DataError, VehestError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit, current_limits

_EVENTS: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_text(path: Path) -> str:
    """A text file, as UTF-8.

    Raises:
        MissingError: there is no such file.
        DataError: it is not a regular file, too long or not UTF-8.
    """
    file = regular_file(path)
    check_limit("text_bytes", file.stat().st_size, f"'{path}' is {file.stat().st_size} bytes long")
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"'{path}' is not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror}") from None


def read_yaml(path: Path) -> Any:
    """Plain values of a YAML file.

    Raises:
        MissingError: there is no such file.
        DataError: it is not YAML, nests too deep, or repeats itself into more values than the limit.
    """
    return parse_yaml(read_text(path), f"'{path}'")


def parse_yaml(text: str, where: str) -> Any:
    """Plain values of YAML.

    Raises:
        DataError: it is not YAML, nests too deep, or repeats itself into more values than the limit.
    """
    try:
        check_yaml(text, where)
        return yaml.load(text, _EVENTS)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"{where} cannot be read as YAML ({first_line(error)})") from None
    except (AttributeError, LookupError):  # PyYAML's own, of `!!timestamp soon` and `!!bool perhaps`
        raise DataError(f"{where} cannot be read as YAML (a value is not what its tag, such as !!timestamp, says)") from None


def check_yaml(text: str, where: str) -> None:
    """See that YAML stays within the limits, without building anything of it.

    Raises:
        DataError: it nests too deep, or holds more values than the limit, those that aliases repeat included.
        yaml.YAMLError: it is not YAML.
    """
    limits = current_limits()
    sizes: dict[str, int] = {}
    open_nodes: list[tuple[str | None, int]] = []  # anchor, values counted when it began
    count = 0
    for event in yaml.parse(text, Loader=_EVENTS):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in (anchor for anchor, _ in open_nodes):
                raise DataError(f"{where} repeats '{event.anchor}' inside itself; write it out")
            count += sizes.get(str(event.anchor), 1)
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if event.anchor:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            count += 1
            open_nodes.append((event.anchor, count))
            if len(open_nodes) > limits.depth:
                raise DataError(f"{where} nests deeper than {limits.depth} levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, begin = open_nodes.pop()
            if anchor:
                sizes[anchor] = count - begin + 1
        if count > limits.nodes:
            raise DataError(
                f"{where} holds more than {limits.nodes} values, what aliases repeat included; raise limits.nodes if that is meant"
            )


def read_json(path: Path) -> Any:
    """Plain values of a JSON file.

    Raises:
        MissingError: there is no such file.
        DataError: it is not JSON, or nests too deep.
    """
    return parse_json(read_text(path), f"'{path}'")


def parse_json(text: str | bytes, where: str) -> Any:
    """Plain values of JSON.

    Raises:
        DataError: it is not JSON, too long, or nests too deep.
    """
    check_limit("text_bytes", len(text), f"{where} holds a description of {len(text)} bytes")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:  # a UnicodeDecodeError is a ValueError
        raise DataError(f"{where} cannot be read as JSON ({first_line(error)})") from None
    if _deeper(content, current_limits().depth):
        raise DataError(f"{where} nests deeper than {current_limits().depth} levels")
    return content


def read_rows(path: Path, columns: Sequence[str] = ()) -> list[dict[str, str]]:
    """Rows of a CSV file whose first line names its columns, such as vehest writes them.

    Raises:
        MissingError: there is no such file.
        DataError: it is not CSV, lacks a column, or a row is of another length.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_text(path), newline=""), strict=True)
        rows, header = list(reader), list(reader.fieldnames or [])
    except (csv.Error, ValueError) as error:
        raise DataError(f"'{path}' cannot be read as CSV ({first_line(error)})") from None
    missing = [name for name in columns if name not in header]
    if missing:
        raise DataError(f"'{path}' has no column '{missing[0]}'")
    for number, row in enumerate(rows, start=1):
        if None in row or None in row.values():
            raise DataError(f"'{path}': data row {number} has not {len(header)} columns, as the first line has")
    return rows


def number_in(row: Mapping[str, str], column: str, path: Path, *, finite: bool = False) -> float:
    """A number in a row of `read_rows`.

    Raises:
        DataError: it is none, or not finite where it must be.
    """
    try:
        number = float(row[column])
    except ValueError:
        raise DataError(f"'{path}': column '{column}' holds {row[column][:40]!r}, which is no number") from None
    if finite and not math.isfinite(number):
        raise DataError(f"'{path}': column '{column}' holds {number}, which is not finite")
    return number


def first_line(error: BaseException) -> str:
    """What an error of a library says, short enough for a message."""
    if isinstance(error, VehestError):
        return str(error)
    if isinstance(error, RecursionError):
        return "it nests too deep"
    text = str(error).strip()
    return text.splitlines()[0][:160] if text else type(error).__name__


def _deeper(content: Any, depth: int) -> bool:
    """Whether lists and mappings nest deeper than ``depth`` levels."""
    level = [content]
    for _ in range(depth + 1):
        level = [
            inner for value in level if isinstance(value, dict | list) for inner in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return False
    return True
