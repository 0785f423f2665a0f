"""Rows of a table whose bytes are no text, and ends of tables that were being written."""

import numpy as np
import pytest

from vehest.alignment.checks import checks_of_recording
from vehest.data.errors import DataError
from vehest.data.recording import joined
from vehest.sources import table_parts
from vehest.sources.base import open_source
from vehest.sources.surveys import survey
from vehest.sources.tables import TextLayout, cut_end, read_columns


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_a_row_of_damaged_bytes_is_an_error_without_a_traceback(tmp_path):
    file = tmp_path / "log.csv"
    rows = "".join(f"{0.05 * row},{row}\n" for row in range(50)).encode()
    file.write_bytes(b"time,vx\n" + rows + b"2.5,50,\xff\x00\x00,1\n" + rows)
    with pytest.raises(DataError, match="cannot be read as a table"):
        read_columns(file, ["time", "vx"], TextLayout())


ROWS = [f"{0.02 * row:.2f},{20.0 + 0.01 * (row % 50):.3f},{0.1:.3f}" for row in range(500)]
COMPLETE = "\r\n".join(["t,vx,yaw_rate", *ROWS, ""])
DATASET = {
    "name": "cut",
    "source": "tabular",
    "licence": "-",
    "citation": "-",
    "files": "*.csv",
    "time": {"column": "t", "unit": "s"},
    "channels": {
        "vx": {"column": "vx", "unit": "m/s"},
        "yaw_rate": {"column": "yaw_rate", "unit": "rad/s"},
    },
}
CUT_ENDS = {
    "statistics": (
        b"\r\nStatistics\r\nChannel,Min\r\nvx,20.0\r\nyaw_rate,0.1\r\n",
        "4 lines of text below the rows ('Statistics')",
    ),
    "comment": (
        b"# end of log, 500 records",
        "1 line of text below the rows ('# end of log, 500 records')",
    ),
    "comment and zeros": (
        "# Länge, 500 records\n\0\0".encode(),
        "1 line of text below the rows ('# Länge, 500 records') and 2 zero bytes at the end",
    ),
    "zeros": (b"\0" * 200_000, "200000 zero bytes at the end"),
    "row": (b"10.00,20.1", "a last row that is cut short ('10.00,20.1')"),
    "cell": (b"10.00,20.100,-", "a last row that is cut short ('10.00,20.100,-')"),
    "exponent": (b"10.00,20.100,1.e", "a last row that is cut short ('10.00,20.100,1.e')"),
    "row and zeros": (
        b"10.00,20.100,0.1\0\0",
        "a last row that is cut short ('10.00,20.100,0.1') and 2 zero bytes at the end",
    ),
}


@pytest.mark.parametrize("large", [0, 1 << 40], ids=["in parts", "as a whole"])
@pytest.mark.parametrize("end", CUT_ENDS)
def test_the_end_of_a_table_whose_logger_was_switched_off_is_left_out_and_named(
    tmp_path, monkeypatch, end, large
):
    monkeypatch.setattr(table_parts, "LARGE", large)
    written, text = CUT_ENDS[end]
    file = tmp_path / "lap.csv"
    file.write_bytes(COMPLETE.encode() + written)
    assert survey(file).skipped == (text,)
    source = open_source({**DATASET, "path": str(tmp_path)})
    recording = joined(list(source.file_parts(file)))
    assert len(recording) == len(ROWS)
    np.testing.assert_allclose(recording["vx"], [float(row.split(",")[1]) for row in ROWS])
    warnings = [
        found.message for found in checks_of_recording(recording) if found.check == "missing"
    ]
    assert warnings == [f"not read: {text}"]


@pytest.mark.parametrize(
    ("end", "missing"),
    [
        ("10.00,20.100,0.1", ()),  # a number, as far as anyone can say
        ("10.00,20.100,", ()),
        ("10.00,20.100,-", ("-",)),
        ("10.00,20.100,NaN", ()),
        ("end of log", ()),
        ("vx,20.0\n", ()),  # of a row or of statistics
        ("\nvx,20.0\n10.02,20.1", ()),
        ("\nMean,20.0,0.1", ()),
        ("", ()),
    ],
)
@pytest.mark.parametrize("encoding", ["utf8", "latin-1"])
def test_a_table_that_ends_without_a_line_break_is_complete(tmp_path, end, missing, encoding):
    file = tmp_path / "lap.csv"
    file.write_text(COMPLETE + end, encoding=encoding)
    assert cut_end(file, TextLayout(missing=missing, encoding=encoding)) is None
