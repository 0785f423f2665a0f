"""Rows of a table whose bytes are no text."""

import gzip

import numpy as np
import pytest

from vehest.data.errors import DataError
from vehest.sources.surveys.tables import survey_table
from vehest.sources.tables import TextLayout, read_columns


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_a_row_of_damaged_bytes_is_an_error_without_a_traceback(tmp_path):
    file = tmp_path / "log.csv"
    rows = "".join(f"{0.05 * row},{row}\n" for row in range(50)).encode()
    file.write_bytes(b"time,vx\n" + rows + b"2.5,50,\xff\x00\x00,1\n" + rows)
    with pytest.raises(DataError, match="cannot be read as a table"):
        read_columns(file, ["time", "vx"], TextLayout())


ROWS = [f"{0.05 * row:.2f},{10.0 + 0.001 * row:.3f},{0.01 * row:.4f}" for row in range(50)]


@pytest.mark.parametrize("cut", [1, 3, 7, 9, 14, 17])
@pytest.mark.parametrize("ending", [".csv", ".csv.gz"])
def test_a_last_row_that_is_cut_short_is_left_out(tmp_path, cut, ending):
    file = tmp_path / f"log{ending}"
    text = "time,vx,ay\n" + "\n".join(ROWS)[:-cut]
    file.write_bytes(gzip.compress(text.encode()) if ending.endswith("gz") else text.encode())
    columns = read_columns(file, ["time", "vx", "ay"], TextLayout())
    np.testing.assert_allclose(columns["ay"], 0.01 * np.arange(49), atol=1e-9)
    np.testing.assert_allclose(columns["vx"], 10.0 + 0.001 * np.arange(49), atol=1e-9)
    (notice,) = survey_table(file).skipped
    assert ROWS[-1][:-cut] in notice


@pytest.mark.parametrize("encoding", ["utf-16", "utf8"])
def test_a_complete_last_row_without_a_line_end_counts(tmp_path, encoding):
    file = tmp_path / "log.csv"
    for rows, n_rows in ((ROWS, 50), ([*ROWS[:-1], ROWS[-1][:-3]], 49)):
        file.write_bytes(("time,vx,ay\n" + "\n".join(rows)).encode(encoding))
        columns = read_columns(file, ["ay"], TextLayout(encoding=encoding))
        assert len(columns["ay"]) == n_rows
