"""Parquet files whose pages unpack to more than their metadata say; for tests."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

N = 40_000
STRUCT_OF_A_DATA_PAGE = 0x2C


def varint(number):
    """A number in the variable length of Thrift."""
    content = bytearray()
    while number >= 0x80:
        content.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*content, number])


def page_header(n_bytes_unpacked, n_bytes_packed, n_values):
    """A header of a data page of plain values, in Thrift's compact protocol, which counts numbers
    in zigzag.
    """
    sizes = [(0x15, 0), (0x15, n_bytes_unpacked), (0x15, n_bytes_packed)]
    page = [(STRUCT_OF_A_DATA_PAGE, None), (0x15, n_values), (0x15, 0), (0x15, 3), (0x15, 3)]
    fields = [
        bytes([head]) + (b"" if value is None else varint(2 * value))
        for head, value in (*sizes, *page)
    ]
    return b"".join(fields) + b"\0\0"


def bomb(file, n_bytes, names=("vx", "ay")):
    """A file whose columns have one page of zeros each, of ``n_bytes``, behind metadata that say
    nothing of it.
    """
    rng = np.random.default_rng(0)
    schema = pa.schema([pa.field(name, pa.float64(), nullable=False) for name in names])
    table = pa.table({name: rng.normal(size=N) for name in names}, schema=schema)
    pq.write_table(
        table,
        file,
        compression="zstd",
        use_dictionary=False,
        write_statistics=False,
        store_schema=False,
    )
    content = bytearray(file.read_bytes())
    packed = pa.Codec("zstd").compress(bytes(n_bytes), asbytes=True)
    page = page_header(n_bytes, len(packed), N) + packed
    group = pq.read_metadata(file).row_group(0)
    for column in map(group.column, range(len(names))):
        assert len(page) <= column.total_compressed_size
        content[column.data_page_offset : column.data_page_offset + len(page)] = page
    file.write_bytes(content)
    return file
