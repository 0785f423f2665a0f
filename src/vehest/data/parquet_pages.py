"""Sizes of the pages of a Parquet file, which stand in the pages' headers alone.

pyarrow unpacks a page as a whole, of up to 2 GiB, whatever the metadata at the end of the file
says.
"""

from __future__ import annotations

from typing import Any, BinaryIO

HEADER_BYTES = 1 << 9  # bytes of a header that are read at a time; it is some dozens of bytes long
MAX_HEADER_BYTES = 1 << 24  # largest length of a header, as in pyarrow
MAX_DEPTH = 8  # largest nesting of structures in a header
PADDING = 100  # bytes; what old writers left out of a column's size (PARQUET-816)
STOP, TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, _, STRUCT = range(13)
FIXED_BYTES = {BYTE: 1, DOUBLE: 8}  # type of a field -> its length, where that is fixed
# numbers of the fields of a page's header that hold that of a data page, of version 1 or 2
DATA_PAGE_FIELDS = (5, 8)


def largest_page(stream: BinaryIO, column: Any) -> int:
    """Size of the largest page of one column of a row group, unpacked.

    Parameters
    ----------
    stream : binary file
        The Parquet file; its position is moved.
    column : pyarrow.parquet.ColumnChunkMetaData
        The column, whose pages are visited as pyarrow visits them: until they hold its values.

    Returns
    -------
    int
        Bytes; 0 where the column is not packed, or has no pages.

    Raises
    ------
    ValueError
        A page has no header where one should be.

    Source: Apache Parquet, parquet.thrift, PageHeader; Apache Thrift, compact protocol.
    """
    if column.compression == "UNCOMPRESSED":
        return 0
    begin = column.data_page_offset
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < begin:
        begin = column.dictionary_page_offset
    end = begin + column.total_compressed_size + PADDING
    largest = n_values = 0
    while n_values < column.num_values and begin < end:
        header, n_bytes = _page_header(stream, begin, end)
        unpacked = header.get(2, -1)
        packed = header.get(3, -1)
        if (
            not isinstance(unpacked, int)
            or not isinstance(packed, int)
            or min(packed, unpacked) < 0
        ):
            raise ValueError("a page has no size")
        largest = max(largest, unpacked)
        for field in DATA_PAGE_FIELDS:
            described = header.get(field, {})
            n_values += max(int(described.get(1, 0)), 0) if isinstance(described, dict) else 0
        begin += n_bytes + packed
    return largest


def _page_header(stream: BinaryIO, begin: int, end: int) -> tuple[dict[int, Any], int]:
    """Fields of the header that begins at a place of the file, and its length [bytes]."""
    length = HEADER_BYTES
    while True:
        stream.seek(begin)
        content = stream.read(min(length, end - begin))
        try:
            return _struct(content, 0, 0)
        except IndexError:
            if len(content) < length or length >= MAX_HEADER_BYTES:
                raise ValueError("a page has no header") from None
            length = MAX_HEADER_BYTES


def _struct(content: bytes, at: int, depth: int) -> tuple[dict[int, Any], int]:
    """Fields of a structure, number -> value, and the index of the byte after it.

    `IndexError` beyond the content.
    """
    if depth > MAX_DEPTH:
        raise ValueError("a page's header nests too deep")
    fields: dict[int, Any] = {}
    number = 0
    while True:
        head = content[at]
        at += 1
        kind = head & 0x0F
        if kind == STOP:
            return fields, at
        if head >> 4:
            number += head >> 4
        else:
            number, at = _integer(content, at)
        fields[number], at = _value(content, at, kind, depth)


def _value(content: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    """Value of a field and the index of the byte after it."""
    if kind in (TRUE, FALSE):
        return kind == TRUE, at
    if kind in (I16, I32, I64):
        return _integer(content, at)
    if kind in FIXED_BYTES:
        n_bytes = FIXED_BYTES[kind]
    elif kind == BINARY:
        n_bytes, at = _unsigned(content, at)
    elif kind == STRUCT:
        return _struct(content, at, depth + 1)
    else:
        raise ValueError("a page's header holds something else than numbers and bytes")
    if at + n_bytes > len(content):
        raise IndexError
    return content[at : at + n_bytes], at + n_bytes


def _integer(content: bytes, at: int) -> tuple[int, int]:
    """A signed number (zigzag) and the index of the byte after it."""
    number, at = _unsigned(content, at)
    return (number >> 1) ^ -(number & 1), at


def _unsigned(content: bytes, at: int) -> tuple[int, int]:
    """An unsigned number, seven bits a byte, the lowest first, and the index of the byte after
    it.
    """
    number = 0
    for shift in range(0, 70, 7):
        byte = content[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
    raise ValueError("a page's header holds a number of more than 64 bits")
