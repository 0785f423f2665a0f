"""How large a table of text is, before any of it is parsed: rows, longest line, bytes, columns of its header."""

from __future__ import annotations

import codecs
import os
import re
from pathlib import Path

import pyarrow as pa

from vehest.data.errors import DataError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit, check_unpacked

BLOCK = 1 << 20  # bytes; pyarrow takes no longer line either


def table_stream(file: Path) -> pa.NativeFile:
    """The bytes of a table, unpacked where its name ends in ``.gz``, ``.bz2``, ``.zst`` or ``.lz4``.

    Raises:
        OSError: it cannot be opened.
    """
    name = os.fspath(file)
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:  # pyarrow opens such names only by what Python has opened
        return pa.input_stream(open(file, "rb"), compression=_packed_as(file))
    return pa.input_stream(name, compression=_packed_as(file))


def check_size(file: Path, n_columns: int, longest_line: int = BLOCK) -> None:
    """See that a table of text stays within the limits, by counting its lines.

    Args:
        file: the table.
        n_columns: columns that are to be read.
        longest_line: that may stand in it [bytes].

    Raises:
        MissingError: there is no such file.
        DataError: it has more rows or values, unpacks to more bytes or has longer lines than it may, or cannot be read.
    """
    packed = regular_file(file).stat().st_size
    lines = n_bytes = since = 0
    last = b""
    try:
        with table_stream(file) as stream:
            while block := stream.read(BLOCK):
                first = _end_of_line(block, False)
                if since + (first if first >= 0 else len(block)) > longest_line:
                    raise DataError(f"'{file}': line {lines + 1} is longer than {longest_line} bytes; is it a table of text?")
                since = since + len(block) if first < 0 else len(block) - 1 - _end_of_line(block, True)
                lines += block.count(b"\n") + block.count(b"\r") - block.count(b"\r\n") - (last == b"\r" and block[:1] == b"\n")
                last, n_bytes = block[-1:], n_bytes + len(block)
                if n_bytes > packed:
                    check_unpacked(file, packed, n_bytes)
                check_limit("samples", lines, f"'{file}' has {lines} rows or more")
                check_limit("memory", 8 * lines * n_columns, f"'{file}' has {lines} rows or more, {lines * n_columns} values")
    except (OSError, pa.ArrowException, MemoryError) as error:
        raise DataError(f"'{file}' cannot be read ({str(error).splitlines()[0][:160] or type(error).__name__})") from None


def check_header(file: Path, delimiter: str, encoding: str, skip_rows: int) -> None:
    """See that a table's header does not name more columns than the limit.

    Raises:
        MissingError: there is no such file.
        DataError: it does, or the file cannot be read.
    """
    regular_file(file)
    try:
        with table_stream(file) as stream:
            begin = codecs.getincrementaldecoder(encoding)(errors="replace").decode(stream.read(BLOCK))
    except (OSError, pa.ArrowException, MemoryError, ValueError) as error:
        raise DataError(f"'{file}' cannot be read ({str(error).splitlines()[0][:160]}); is it of another format or encoding?") from None
    lines = [line for line in re.split(r"\r\n|\n|\r", begin)[skip_rows:] if line]
    if lines:
        check_limit("columns", lines[0].count(delimiter) + 1, f"'{file}' has {lines[0].count(delimiter) + 1} columns")


def _end_of_line(block: bytes, last: bool) -> int:
    """Where the first, or last, line in a block ends; -1 where none does."""
    found = [block.rfind(end) if last else block.find(end) for end in (b"\n", b"\r")]
    return max(found) if last else min((at for at in found if at >= 0), default=-1)


def _packed_as(file: Path) -> str | None:
    return {".gz": "gzip", ".bz2": "bz2", ".zst": "zstd", ".lz4": "lz4"}.get(file.suffix.lower())
