"""Reading in a process of its own: what comes back, and one line naming the file however it
ends.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from vehest.data.errors import DataError, MissingError, VehestError
from vehest.data.limits import Limits, use_limits
from vehest.sources.limited import read_limited

VALUES = np.array([0.1, np.nan, -np.inf, 1e-310])


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    VALUES.tofile(tmp_path / "lap.bin")
    return tmp_path / "lap.bin"


def test_arrays_and_summary_come_back_and_limits_go_along(file):
    with use_limits(Limits(samples=77, memory=1_000_000_000)):
        reading = read_limited("limited_readers:answers", file, factor=2.0)
    np.testing.assert_array_equal(reading.arrays["vx"], 2.0 * VALUES)
    np.testing.assert_array_equal(reading.arrays["n"], [0, 1, 2])
    assert reading.summary == {"limit": 77}


@pytest.mark.skipif(
    sys.platform == "win32", reason="Windows limits neither memory nor processor time"
)
@pytest.mark.parametrize(
    ("function", "kind", "message_part"),
    [
        ("hangs", DataError, "takes more than 1 s to read, too long for its size"),
        (
            "takes_memory",
            DataError,
            "MB of memory; if that is meant, raise it: limits.memory=NUMBER",
        ),
        ("crashes", DataError, "is damaged: reading it ends with status -6"),
        ("writes", DataError, "is damaged"),
        ("misses", MissingError, "needs another one"),
        ("fails", DataError, "make it again"),
    ],
)
def test_however_reading_ends_it_is_one_line_and_nothing_is_written(
    file, monkeypatch, function, kind, message_part
):
    monkeypatch.setattr("vehest.sources.limited.SECONDS", 1.0)
    with use_limits(Limits(memory=600_000_000)), pytest.raises(VehestError) as error:
        read_limited(f"limited_readers:{function}", file)
    assert type(error.value) is kind
    message = str(error.value)
    assert message.startswith(f"'{file}'")
    assert message_part in message
    assert message.isprintable()
    assert file.read_bytes() == VALUES.tobytes()
    assert [
        path.name for path in file.parent.iterdir() if path.stat().st_size and path != file
    ] == []


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not limit memory")
def test_of_what_was_unpacked_the_packed_size_counts_towards_memory(file, tmp_path):
    unpacked = tmp_path / "unpacked.bin"
    with open(unpacked, "wb") as stream:
        stream.truncate(300_000_000)  # ten times as much would be enough for the reader
    reader = "limited_readers:takes_memory"
    with use_limits(Limits(memory=600_000_000)):
        assert len(read_limited(reader, unpacked).arrays["vx"]) == 100_000_000
        with pytest.raises(DataError, match="takes more than 600 MB of memory"):
            read_limited(reader, unpacked, packed=file)
