"""Parquet files of others: numbers come out as they went in.

Files that are damaged or beyond the limits are refused in one line.
"""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from refusals import refusal

from vehest.data.limits import Limits, use_limits
from vehest.data.parquet import parquet_file, read_numbers
from vehest.data.parquet_pages import largest_page

N = 1000


def columns():
    generator = np.random.default_rng(0)
    return {
        "time": np.arange(N) / 100.0,
        "vx": generator.normal(20.0, 1.0, N),
        "gear": generator.integers(1, 6, N),
    }


def written(folder, content, **options):
    pq.write_table(pa.table(content), folder / "lap.parquet", **options)
    return folder / "lap.parquet"


def read(file, *names):
    with parquet_file(file) as table:
        return read_numbers(file, table, names or table.schema_arrow.names)


def refused(file):
    message = refusal(lambda: read(file))
    assert f"'{file}'" in message
    return message


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"row_group_size": 77, "compression": "none"},
        {"data_page_size": 100, "compression": "zstd", "write_page_checksum": True},
    ],
    ids=str,
)
def test_numbers_come_out_as_they_went_in(tmp_path, options):
    values = read(written(tmp_path, columns(), **options))
    for name, expected in columns().items():
        np.testing.assert_array_equal(values[name], expected)
        assert values[name].dtype == np.float64


def test_missing_values_are_nan_and_integers_of_any_width_are_read(tmp_path):
    content = {
        "a": pa.array([1, None, 3], pa.uint8()),
        "b": pa.array([1.5, 2.5, None], pa.float16()),
        "c": pa.array([None] * 3, pa.int64()),
    }
    values = read(written(tmp_path, content))
    np.testing.assert_array_equal(values["a"], [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(values["b"], [1.5, 2.5, np.nan])
    assert np.isnan(values["c"]).all()


@pytest.mark.parametrize(
    "odd",
    [pa.array([[1.0], [2.0]]), pa.array(["1", "2"]), pa.array([True, False])],
    ids=lambda odd: str(odd.type),
)
def test_a_column_of_something_else_than_numbers_is_named_with_its_type(tmp_path, odd):
    assert "column 'odd' is of type" in refused(written(tmp_path, {"odd": odd}))


def test_rows_memory_and_description_are_checked_before_anything_is_decoded(tmp_path):
    file = written(tmp_path, columns())
    with use_limits(Limits(samples=999)):
        assert (
            "holds 1000 rows, more than the limit of 999; if that is meant, raise it: "
            "limits.samples=NUMBER" in refused(file)
        )
    zeros = written(
        tmp_path, {name: np.zeros(100_000) for name in ("time", "vx", "ay")}, compression="zstd"
    )
    size = zeros.stat().st_size
    with parquet_file(zeros) as table, open(zeros, "rb") as stream:
        group = table.metadata.row_group(0)
        pages = sum(largest_page(stream, group.column(k)) for k in range(3))
    with use_limits(Limits(memory=2_400_000 + pages - 10 * size - 1)):
        assert f"unpacks to {2_400_000 + pages} bytes" in (message := refused(zeros))
        assert message.endswith("if that is meant, raise it: limits.memory=NUMBER")
        assert set(read(zeros, "time", "vx")) == {"time", "vx"}
    file = written(tmp_path, {f"c{k}": [1.0] for k in range(300)})
    with use_limits(Limits(text_bytes=10_000)):
        assert "holds a description of" in refused(file)


@pytest.mark.parametrize(
    "content",
    [
        lambda raw: b"",
        lambda raw: raw[:100],
        lambda raw: b"PAR1" + raw[-8:],
        lambda raw: raw[:-8] + b"\xff" * 4 + b"PAR1",
    ],
)
def test_a_file_that_is_cut_off_is_refused(tmp_path, content):
    file = written(tmp_path, columns())
    file.write_bytes(content(file.read_bytes()))
    refused(file)
