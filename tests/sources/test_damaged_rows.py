"""Rows of a table whose bytes are no text."""

import pytest

from vehest.data.errors import DataError
from vehest.sources.tables import TextLayout, read_columns


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_a_row_of_damaged_bytes_is_an_error_without_a_traceback(tmp_path):
    file = tmp_path / "log.csv"
    rows = "".join(f"{0.05 * row},{row}\n" for row in range(50)).encode()
    file.write_bytes(b"time,vx\n" + rows + b"2.5,50,\xff\x00\x00,1\n" + rows)
    with pytest.raises(DataError, match="cannot be read as a table"):
        read_columns(file, ["time", "vx"], TextLayout())
