"""Reads columns of numbers from Parquet files, within limits that its metadata is checked against
first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from vehest.data.errors import DataError, VehestError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit, check_unpacked
from vehest.data.parquet_pages import largest_page
from vehest.data.text_files import first_line

DAMAGE = (
    pa.ArrowException,
    OSError,
    ValueError,
    TypeError,
    KeyError,
    MemoryError,
    OverflowError,
    RecursionError,
)
"""Exceptions of pyarrow and NumPy for a damaged file; an ArrowInvalid is a ValueError, too."""

ROWS_AT_A_TIME = 1 << 15  # rows of a batch at most
BUFFER = 1 << 17  # bytes of a column that are read at a time; pyarrow else reads all of it


@contextmanager
def parquet_file(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file for reading; checksums of its pages, where it has any, are verified.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It is damaged, or its description is longer than the limits allow. What pyarrow raises while
        the file is read, within the ``with`` statement, becomes such an error, too.
    """
    size = regular_file(path).stat().st_size
    try:
        with open(path, "rb") as stream:
            stream.seek(max(size - 8, 0))
            footer = int.from_bytes(stream.read(4), "little")
            if footer < size:
                check_limit("text_bytes", footer, f"'{path}' holds a description of {footer} bytes")
            with pq.ParquetFile(
                stream, page_checksum_verification=True, pre_buffer=False, buffer_size=BUFFER
            ) as file:
                yield file
    except VehestError:
        raise
    except DAMAGE as error:
        raise DataError(
            f"'{path}' is truncated or damaged ({first_line(error)}); make it again"
        ) from None


def number_batches(
    path: Path, file: pq.ParquetFile, names: Sequence[str]
) -> Iterator[pa.RecordBatch]:
    """Columns of numbers or dates, some rows at a time.

    Parameters
    ----------
    path : Path
        The file, for messages and its size.
    file : pyarrow.parquet.ParquetFile
        The same, opened.
    names : sequence of str
        Columns that are there once each. Dates with times count from 1970 in the file's unit,
        ``unit`` of their type.

    Yields
    ------
    pyarrow.RecordBatch
        At most `ROWS_AT_A_TIME` rows; all batches together have as many as the file says.

    Raises
    ------
    DataError
        A column is of another type, the file has fewer or more rows than it says, or unpacks to
        more than the limits allow.
    """
    for name in names:
        kind = file.schema_arrow.field(name).type
        if not (is_numeric(kind) or has_time_unit(kind)):
            raise DataError(
                f"'{path}': column '{name}' is of type {str(kind)[:60]}; numbers are needed"
            )
    n_rows = file.metadata.num_rows
    done = 0
    check_limit("samples", n_rows, f"'{path}' holds {n_rows} rows")
    n_bytes = 8 * n_rows * len(names) + _bytes_of_pages(path, file, names)
    check_unpacked(path, path.stat().st_size, n_bytes)
    for batch in file.iter_batches(ROWS_AT_A_TIME, columns=list(names), use_threads=False):
        done += batch.num_rows
        yield batch
    if done != n_rows:
        raise DataError(
            f"'{path}' is truncated or damaged: it says that it holds {n_rows} rows, and holds "
            f"{done}; make it again"
        )


def _bytes_of_pages(path: Path, file: pq.ParquetFile, names: Sequence[str]) -> int:
    """Memory that one page of each column takes at a time [bytes]: the largest, unpacked."""
    largest = dict.fromkeys(names, 0)
    metadata = file.metadata
    with open(path, "rb") as stream:
        for group in map(metadata.row_group, range(metadata.num_row_groups)):
            for column in map(group.column, range(group.num_columns)):
                name = column.path_in_schema
                if name in largest:
                    largest[name] = max(largest[name], largest_page(stream, column))
    return sum(largest.values())


def read_numbers(
    path: Path, file: pq.ParquetFile, names: Sequence[str]
) -> dict[str, NDArray[np.float64]]:
    """Columns of `number_batches`, float64 of shape (T,), missing values NaN.

    Raises
    ------
    DataError
        As `number_batches` does.
    """
    values = {name: np.empty(0) for name in names}
    done = 0
    for batch in number_batches(path, file, names):
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if not done:
                values[name] = np.empty(file.metadata.num_rows)
            values[name][done : done + len(column)] = numbers_of(column)
        done += batch.num_rows
    return values


def is_numeric(kind: pa.DataType) -> bool:
    """Whether a column holds numbers."""
    return bool(
        pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
    )


def has_time_unit(kind: pa.DataType) -> bool:
    """Whether a column counts time in a unit of its own: as a time stamp or a duration."""
    return bool(pa.types.is_timestamp(kind) or pa.types.is_duration(kind))


def numbers_of(column: pa.Array | pa.ChunkedArray) -> NDArray[np.float64]:
    """Numbers of a column, (T,), NaN where one is missing.

    Not by ``to_numpy``, which imports pandas.
    """
    chunks = [np.empty(0)]
    for chunk in column.chunks if isinstance(column, pa.ChunkedArray) else [column]:
        counted = chunk.cast(pa.int64()) if has_time_unit(chunk.type) else chunk
        numbers = (
            counted if counted.type == pa.float64() else counted.cast(pa.float64(), safe=False)
        )
        values = (
            np.frombuffer(numbers.buffers()[1], np.float64, len(numbers), 8 * numbers.offset)
            if len(numbers)
            else np.empty(0)
        )
        chunks.append(
            np.where(np.from_dlpack(numbers.is_null().cast(pa.int8())), math.nan, values)
            if numbers.null_count
            else values
        )
    return np.concatenate(chunks)
