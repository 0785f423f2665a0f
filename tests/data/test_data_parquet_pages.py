"""Sizes of pages in Parquet files: as pyarrow writes them, and of pages that unpack to more than a
file says and may take.
"""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from refusals import refusal

from parquet_bomb import N, bomb
from vehest.data.limits import Limits, use_limits
from vehest.data.parquet import parquet_file, read_numbers
from vehest.data.parquet_pages import largest_page

N_IN_A_PAGE = 20_000


def read(file):
    with parquet_file(file) as table:
        return read_numbers(file, table, table.schema_arrow.names)


@pytest.mark.parametrize("compression", ["snappy", "gzip", "brotli", "zstd", "lz4"])
@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("use_dictionary", [False, True])
def test_page_sizes_match_the_metadata_less_the_header(
    tmp_path, compression, version, use_dictionary
):
    values = pa.array([None, *np.random.default_rng(1).integers(0, 9, N_IN_A_PAGE)], pa.float64())
    pq.write_table(
        pa.table({"gear": values}),
        tmp_path / "lap.parquet",
        compression=compression,
        data_page_version=version,
        use_dictionary=use_dictionary,
        write_page_checksum=True,
    )
    column = pq.read_metadata(tmp_path / "lap.parquet").row_group(0).column(0)
    with open(tmp_path / "lap.parquet", "rb") as stream:
        largest = largest_page(stream, column)
    dictionary = 9 * 8 if use_dictionary else 0  # a page of its own
    assert dictionary + 10 < column.total_uncompressed_size - largest < dictionary + 200


def test_the_largest_of_many_pages_counts(tmp_path):
    values = np.random.default_rng(1).normal(size=N)
    pq.write_table(
        pa.table({"vx": values}),
        tmp_path / "lap.parquet",
        data_page_size=8_000,
        use_dictionary=False,
        compression="zstd",
    )
    column = pq.read_metadata(tmp_path / "lap.parquet").row_group(0).column(0)
    with open(tmp_path / "lap.parquet", "rb") as stream:
        assert 8_000 <= largest_page(stream, column) < 17_000 < column.total_uncompressed_size


def test_pages_count_towards_the_memory_that_reading_a_file_may_take(tmp_path):
    file = bomb(tmp_path / "lap.parquet", 40_000_000)
    with use_limits(Limits(memory=70_000_000)):
        message = refusal(lambda: read(file))
    assert f"'{file}' unpacks to {2 * (40_000_000 + 8 * N)} bytes" in message
    assert message.endswith("limits.memory=NUMBER")
    assert np.array_equal(read(file)["ay"], np.zeros(N))


def test_page_without_a_header_is_refused_in_a_single_line(tmp_path):
    file = bomb(tmp_path / "lap.parquet", 40_000_000)
    column = pq.read_metadata(file).row_group(0).column(1)
    content = bytearray(file.read_bytes())
    for junk in (b"\xff" * 200, b"\x19\x00", b"\x15" + b"\xff" * 12, b"\x1c" * 40, b"\x00"):
        content[column.data_page_offset : column.data_page_offset + len(junk)] = junk
        file.write_bytes(content)
        assert f"'{file}' is truncated or damaged" in refusal(lambda: read(file))


PEAK = """
import resource, sys
from pathlib import Path
from vehest.data.errors import DataError
from vehest.data.limits import Limits, use_limits
from vehest.data.parquet import parquet_file, read_numbers

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

before = peak()
file = Path(sys.argv[1])
try:
    with use_limits(Limits(memory=100_000_000)), parquet_file(file) as table:
        read_numbers(file, table, table.schema_arrow.names)
except DataError as error:
    print(peak() - before)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not tell the peak")
def test_a_page_beyond_the_limit_is_never_unpacked(tmp_path):
    file = bomb(tmp_path / "lap.parquet", 500_000_000)
    order = [sys.executable, "-c", PEAK, str(file)]
    peak = subprocess.run(order, check=True, capture_output=True, text=True).stdout
    assert int(peak) < 100_000_000
