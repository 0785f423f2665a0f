"""Reading columns of numbers from Parquet files that nobody vouches for: looked at first, then row group by row group, within limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from vehest.data.errors import DataError, VehestError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit, check_unpacked
from vehest.data.text_files import first_line

DAMAGE = (pa.ArrowException, OSError, ValueError, TypeError, KeyError, MemoryError, OverflowError, RecursionError)
"""What pyarrow and NumPy raise where a file is not what it says; an ArrowInvalid is a ValueError, too."""

ROWS_AT_A_TIME = 1 << 17
LONGEST_PAGE_HEADER = 1 << 14  # bytes; statistics of numbers take a few dozen


@contextmanager
def parquet_file(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file for reading.

    Raises:
        MissingError: there is no such file.
        DataError: it is not a regular file, empty, damaged, encrypted, or its description is longer than the limit.
    """
    regular_file(path)
    try:
        with open(path, "rb") as stream:
            size = stream.seek(0, 2)
            if size == 0:
                raise DataError(f"'{path}' is empty; make it again")
            stream.seek(max(size - 8, 0))
            footer = int.from_bytes(stream.read(8)[:4], "little")
            if footer < size:
                check_limit("text_bytes", footer, f"'{path}' holds a description of {footer} bytes")
            with pq.ParquetFile(stream, page_checksum_verification=True) as file:
                yield file
    except VehestError:
        raise
    except DAMAGE as error:
        raise DataError(f"'{path}' is truncated or damaged ({first_line(error)}); make it again") from None


def read_numbers(path: Path, file: pq.ParquetFile, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Columns of numbers, float64 of shape (T,) each; what is missing is NaN.

    Neither the file's count of rows nor its sizes are believed: no more rows are taken than the limits allow, and what the pages
    unpack to is added up from their own headers, by which they are unpacked.

    Args:
        path: for messages.
        file: opened by `parquet_file`.
        names: of columns that are there once each.

    Raises:
        DataError: a column holds something else than numbers, the file holds or unpacks to more than the limits, or is damaged.
    """
    try:
        return _read_numbers(path, file, list(dict.fromkeys(names)))
    except VehestError:
        raise
    except DAMAGE as error:
        raise DataError(f"'{path}' is truncated or damaged ({first_line(error)}); make it again") from None


def _read_numbers(path: Path, file: pq.ParquetFile, names: list[str]) -> dict[str, NDArray[np.float64]]:
    for name in names:
        kind = file.schema_arrow.field(name).type
        if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
            raise DataError(f"'{path}': column '{name}' is of type {str(kind)[:60]}; numbers are needed")
    n_rows, size = file.metadata.num_rows, path.stat().st_size
    if n_rows < 0:
        raise DataError(f"'{path}' is damaged: it says that it holds {n_rows} rows; make it again")
    check_limit("samples", n_rows, f"'{path}' holds {n_rows} rows")
    check_limit("values", n_rows * len(names), f"'{path}' holds {n_rows} rows of {len(names)} columns, {n_rows * len(names)} values")
    check_unpacked(path, size, 8 * n_rows * len(names))
    check_unpacked(path, size, _bytes_of_pages(path, file, names))
    values = {name: np.empty(n_rows) for name in names}
    done = 0
    for batch in file.iter_batches(ROWS_AT_A_TIME, columns=names, use_threads=True):
        if done + batch.num_rows > n_rows:
            raise DataError(f"'{path}' is damaged: it says that it holds {n_rows} rows, and holds more; make it again")
        for name in names:
            column = batch.column(batch.schema.get_field_index(name))
            values[name][done : done + batch.num_rows] = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
        done += batch.num_rows
    if done != n_rows:
        raise DataError(f"'{path}' is truncated or damaged: it says that it holds {n_rows} rows, and holds {done}; make it again")
    return values


def _bytes_of_pages(path: Path, file: pq.ParquetFile, names: Sequence[str]) -> int:
    """What the pages of some columns unpack to by their own headers [bytes]."""
    metadata, wanted, total = file.metadata, set(names), 0
    with open(path, "rb") as stream:
        end = stream.seek(0, 2)
        for group in range(metadata.num_row_groups):
            for position in range(metadata.num_columns):
                chunk = metadata.row_group(group).column(position)
                if chunk.path_in_schema in wanted:
                    begins = [at for at in (chunk.dictionary_page_offset, chunk.data_page_offset) if at is not None and at > 0]
                    total += _bytes_of_chunk(path, stream, min(begins, default=0), chunk.total_compressed_size, end)
                    check_unpacked(path, end, total)
    return total


def _bytes_of_chunk(path: Path, stream: BinaryIO, begin: int, size: int, end: int) -> int:
    at, total = begin, 0
    if size < 0 or begin + size > end:
        raise DataError(f"'{path}' is truncated or damaged: a column ends behind the end of the file; make it again")
    while at < begin + size:
        stream.seek(at)
        length, unpacked, packed = _page_header(stream.read(LONGEST_PAGE_HEADER))
        if unpacked < 0 or packed < 0:
            raise ValueError("the size of a page is negative")
        total += unpacked
        at += length + packed
    return total


def _page_header(content: bytes) -> tuple[int, int, int]:
    """Length of a page's header, and the page's size unpacked and packed [bytes].

    Source: Apache Parquet, parquet.thrift, PageHeader; Apache Thrift's compact protocol.
    """
    reader = _Compact(content)
    fields = reader.struct(0)
    if not {2, 3} <= set(fields):
        raise ValueError("the header of a page names no size")
    return reader.at, int(fields[2]), int(fields[3])


class _Compact:
    """Thrift's compact protocol, as far as a page's header needs it."""

    def __init__(self, content: bytes) -> None:
        self._content, self.at = content, 0

    def struct(self, depth: int) -> dict[int, Any]:
        """Fields by their numbers."""
        if depth > 8:
            raise ValueError("the header of a page nests too deep")
        fields: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._whole()
            fields[number] = self._value(head & 15, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        if kind in (1, 2):  # truth values stand in the field's head
            return kind == 1
        if kind == 3:
            return self._byte()
        if kind in (4, 5, 6):
            return self._whole()
        if kind in (7, 8):
            return self._skip(8 if kind == 7 else self._varint())
        if kind in (9, 10):
            return self._list(depth)
        if kind == 12:
            return self.struct(depth + 1)
        raise ValueError(f"the header of a page holds a field of unknown type {kind}")

    def _list(self, depth: int) -> None:
        head = self._byte()
        count = head >> 4 if head >> 4 < 15 else self._varint()
        for _ in range(count):
            if head & 15 in (1, 2):
                self._byte()
            else:
                self._value(head & 15, depth + 1)

    def _skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self._content):
            raise ValueError("the header of a page is cut off")

    def _byte(self) -> int:
        if self.at >= len(self._content):
            raise ValueError("the header of a page is cut off")
        self.at += 1
        return self._content[self.at - 1]

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            part = self._byte()
            value |= (part & 127) << shift
            if part < 128:
                return value
        raise ValueError("the header of a page holds a number without end")

    def _whole(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
