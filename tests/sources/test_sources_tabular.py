"""Tables of any make: what pandas reads, in SI units and ISO 8855 signs.

And one clear line for what cannot be used.
"""

import bz2
import gzip
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from refusals import refusal

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.limits import Limits, use_limits
from vehest.data.recording import Recording
from vehest.data.store import write_recording
from vehest.sources.base import open_source
from vehest.sources.tabular import TabularSource

TIME = {"column": "time", "unit": "s"}
HEADER = "time,vx,ay\n"
N = 200


def table():
    """Two seconds of noise at 100 Hz."""
    generator = np.random.default_rng(0)
    channels = {name: generator.normal(0.0, 3.0, N) for name in ("vx", "yaw_rate", "ay")}
    return pd.DataFrame({"time": np.round(5.0 + np.arange(N) / 100.0, 2), **channels})


def rows(count, start=0):
    return "".join(f"{k / 100:.2f},{k},{2 * k}\n" for k in range(start, start + count))


def source(folder, **options):
    return TabularSource(
        {
            "name": "mine",
            "source": "tabular",
            "path": str(folder),
            "files": "*",
            "time": TIME,
            **options,
        }
    )


def read(file, **options):
    return source(file.parent, **options).read(file.stem)


def written(folder, content, name="lap.csv"):
    file = folder / name
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


def assert_reads_as(recording, frame):
    pd.testing.assert_frame_equal(
        pd.DataFrame(dict(recording.channels)),
        frame.drop(columns="time"),
        check_exact=True,
        check_like=True,
    )


def test_csv_and_parquet_files_read_as_pandas_reads_them(tmp_path):
    table().to_csv(tmp_path / "lap.csv", index=False)
    recording = read(tmp_path / "lap.csv", vehicle="kart", kind="real", citation="me")
    assert_reads_as(recording, pd.read_csv(tmp_path / "lap.csv"))
    assert (
        recording.id,
        recording.vehicle,
        recording.rate_hz,
        recording.start_time,
        recording.kind,
    ) == ("lap", "kart", 100.0, 5.0, "real")
    assert dict(recording.provenance) == {"dataset": "mine", "source": "tabular", "file": "lap.csv"}
    (tmp_path / "lap.csv").unlink()
    table().astype({"ay": "float32"}).to_parquet(tmp_path / "lap.pq")
    assert_reads_as(
        read(tmp_path / "lap.pq"), pd.read_parquet(tmp_path / "lap.pq").astype("float64")
    )


def test_decimal_commas_delimiters_skipped_rows_and_latin_1_are_read(tmp_path):
    body = "\n".join(f"{k / 100:.2f};{k * 0.5:.1f}" for k in range(20)).replace(".", ",")
    content = f"Messung vom 3. März\n\nZeit [s];Querbeschl. [m/s²]\n{body}\n".encode("latin-1")
    file = written(tmp_path, content)
    options = {"delimiter": ";", "decimal": ",", "encoding": "latin-1", "skip_rows": 2}
    columns = {"ay": {"column": "Querbeschl. [m/s²]", "unit": "m/s²"}}
    recording = read(file, channels=columns, time={"column": "Zeit [s]", "unit": "s"}, **options)
    frame = pd.read_csv(file, sep=";", decimal=",", encoding="latin-1", skiprows=2)
    np.testing.assert_array_equal(recording["ay"], frame["Querbeschl. [m/s²]"].to_numpy())
    assert (recording.rate_hz, recording.start_time) == (100.0, 0.0)


def test_without_a_time_column_the_rate_is_given(tmp_path):
    table().drop(columns="time").to_csv(tmp_path / "lap.csv", index=False)
    recording = read(tmp_path / "lap.csv", time=None, rate_hz=125)
    assert (recording.rate_hz, recording.start_time, len(recording)) == (125.0, 0.0, N)


def test_a_stored_recording_is_read_as_what_it_is(tmp_path):
    stored = Recording(
        "lap", "kart", 20.0, 450.0, {"ay": np.arange(4.0)}, "simulated", provenance={"seed": 3}
    )
    write_recording(stored, tmp_path / "lap.parquet")
    recording = read(tmp_path / "lap.parquet")
    assert recording["ay"].tolist() == stored["ay"].tolist()
    assert (recording.rate_hz, recording.start_time, recording.kind) == (20.0, 450.0, "simulated")


def test_recordings_are_the_stems_in_order(tmp_path):
    for name in ("b.csv", "a.csv", "a.txt"):
        written(tmp_path, HEADER + rows(3), name)
    csv_source = source(tmp_path, files="*.csv")
    assert (csv_source.ids(), list(csv_source.inputs())) == (["a", "b"], ["a.csv", "b.csv"])
    assert [recording.id for recording in csv_source.recordings()] == ["a", "b"]
    assert "has no recording 'c' (it has a, b)" in refusal(
        lambda: csv_source.read("c"), MissingError
    )
    assert "two files are called 'a'" in refusal(source(tmp_path).ids)


BAD_TABLES = {
    "header only": (HEADER, ["has a header and no rows"]),
    "no such column": ("time,vx\n0,1\n0.01,2\n", ["no column 'ay'", "it has time, vx"]),
    "column twice": (
        "time,vx,ay,ay\n" + "0,1,2,3\n0.01,1,2,3\n",
        ["2 columns called 'ay'", "rename or remove"],
    ),
    "text": (
        HEADER + rows(4) + "0.04,abc,1\n" + rows(3, 5),
        ["column 'vx'", "'abc'", "data row 5", "numbers are needed"],
    ),
    "short row": (
        HEADER + rows(4) + "0.04,1\n",
        ["cannot be read as a table", "Row #6", "Expected 3 columns, got 2"],
    ),
    "other encoding": (b"time,vx,ay\xb2\n0,1,2\n", ["no column 'ay' (it has time, vx, ay\\xb2)"]),
    "endless line": (HEADER + "a" * 3_000_000, ["a line is longer than 1048576 bytes"]),
    "columns": (
        "time,vx" + "," * 20_000 + "\n",
        ["has 20002 columns, more than the limit of 10000"],
    ),
    "escape": (HEADER + '0,"1\x1b[2J",2\n0.1,1,2\n', ["holds the text '1\\x1b[2J' in data row 1"]),
    "quote": (HEADER + rows(3) + '0.03,"' + "x,\n" * 10, []),
}


@pytest.mark.parametrize("fault", BAD_TABLES)
def test_a_table_that_cannot_be_used_is_refused_in_one_line_that_says_where(tmp_path, fault):
    content, message_part = BAD_TABLES[fault]
    file = written(tmp_path, content)
    columns = {"vx": {"column": "vx", "unit": "m/s"}, "ay": {"column": "ay", "unit": "m/s²"}}
    message = refusal(lambda: read(file, channels=columns))
    assert [words for words in (f"'{file}'", *message_part) if words not in message] == []


def test_a_misspelt_data_set_is_refused_before_any_file_is_read(tmp_path):
    for options, message_part in (
        ({"time": None}, "rate_hz must be given"),
        ({"gappy": ["ay"], "channels": {"vx": {"column": "a", "unit": "m/s"}}}, "gappy names 'ay'"),
        ({"encoding": "latin-x"}, "dataset.encoding: 'latin-x' is not known"),
        ({"files": "/data/*.csv"}, "files must be a pattern inside path"),
        ({"files": "a**b"}, "files must be a pattern inside path"),
        ({"files": "."}, "files must be a pattern inside path"),
        ({"rate_hz": "100"}, "dataset.rate_hz must be a number, not '100'"),
        ({"clock": 3}, "dataset.clock '3' is not one of: strict, interpolate"),
        ({"kind": "dreamt"}, "dataset.kind 'dreamt' is not one of: real, simulated"),
        ({"channels": {"vx": 3}}, "channel 'vx': it must be a group of options, not 3"),
        ({"channels": {"vx": {"column": "v"}}}, "channel 'vx': unit is missing"),
        ({"name": "../evil"}, "must be made of letters"),
    ):
        message = refusal(lambda options=options: source(tmp_path, **options), ConfigurationError)
        assert message_part in message
        assert message.startswith("data set" if "name" in options else "data set 'mine'")


def runs_csv(tmp_path, runs):
    """A row a run number, 100 Hz, vx counting the rows."""
    lines = [f"{row / 100:.2f},{row},{run}" for row, run in enumerate(runs)]
    written(tmp_path, "time,vx,run_id\n" + "\n".join(lines) + "\n")
    return source(tmp_path, files="*.csv", runs="run_id")


def test_each_run_is_a_recording_with_its_start_and_ambiguous_runs_are_refused(
    tmp_path,
):
    runs_source = runs_csv(tmp_path, [7] * 20 + [3] * 30 + [4] * 10)
    assert runs_source.ids() == ["lap_run_7", "lap_run_3", "lap_run_4"]
    recordings = list(runs_source.recordings())
    assert [recording.start_time for recording in recordings] == [0.0, 0.2, 0.5]
    np.testing.assert_array_equal(
        np.concatenate([recording["vx"] for recording in recordings]), np.arange(60)
    )
    assert recordings[1].provenance["run"] == 3
    for runs, message_part in (
        ([1, 1, 2, 2, 1, 1], "run 1 begins again in data row 5"),
        (
            [1, 1, 1.5, 1.5],
            "column 'run_id' holds 1.5 in data row 3; runs are counted in whole numbers",
        ),
    ):
        assert f"'{tmp_path / 'lap.csv'}': {message_part}" in refusal(runs_csv(tmp_path, runs).ids)
    assert len(runs_csv(tmp_path, [4] * 9).read_file(tmp_path / "lap.csv")) == 9
    message = refusal(lambda: runs_csv(tmp_path, [4] * 9 + [5] * 9).read_file(tmp_path / "lap.csv"))
    assert "holds 2 runs (4, 5); name one by +dataset.run=4" in message


def test_a_packed_table_is_read_and_unpacks_to_no_more_than_it_may(tmp_path):
    assert (
        len(read(written(tmp_path, gzip.compress((HEADER + rows(50)).encode()), "lap.csv.gz")))
        == 50
    )
    bomb = written(
        tmp_path,
        gzip.compress(HEADER.encode() + (b"0,1,1" + b" " * 995 + b"\n") * 80_000, 9),
        "bomb.csv.gz",
    )
    with use_limits(Limits(memory=10_000_000)):
        assert "limits.memory=NUMBER" in refusal(lambda: read(bomb))
    torn = written(tmp_path, bomb.read_bytes()[:-100], "torn.csv.gz")
    assert "cannot be read" in refusal(lambda: read(torn))


def packed_rows(folder, name, row, size):
    """A table of one repeated row, ``size`` bytes of it, packed."""
    head = b"time,vx,ay\n"
    content = head + row * (size // len(row))
    packed = bz2.compress(content) if name.endswith(".bz2") else gzip.compress(content, 6)
    return written(folder, packed, name)


PEAKS = """
import resource, sys
from pathlib import Path
from vehest.data.errors import DataError
from vehest.data.limits import Limits, use_limits
from vehest.sources.surveys.tables import survey_table
from vehest.sources.tables import TextLayout, read_columns

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

before = peak()
for name in sys.argv[2:]:
    for read in (survey_table, lambda file: read_columns(file, ["time"], TextLayout())):
        try:
            with use_limits(Limits(memory=int(sys.argv[1]))):
                read(Path(name))
        except DataError as error:
            print("limits.memory" in str(error))
print(peak() - before)
"""


def test_packed_tables_that_unpack_to_too_much_are_refused_within_the_limit_on_memory(tmp_path):
    limit = 30_000_000
    rows_of = (
        b"1,1,1\n",
        b"1,1,1\n" + 9 * b"\n",
        b"1,,\n",
        b"some text,1,1\n",
        b"1" * 5000 + b",1,1\n",
    )
    files = [
        packed_rows(tmp_path, f"{k}.csv{'.bz2' if k == 1 else '.gz'}", row, 3 * limit // 2)
        for k, row in enumerate(rows_of)
    ]
    order = [sys.executable, "-c", PEAKS, str(limit), *map(str, files)]
    child = subprocess.run(order, capture_output=True, text=True, check=True)
    *refused, peak = child.stdout.split()
    assert refused == ["True"] * 2 * len(files)
    assert int(peak) < limit


def test_an_honest_packed_table_is_read_within_the_limit_and_cells_count_beside_the_text(tmp_path):
    rows_of = b"".join(b"%.2f,5.25,0.125\n" % (k / 100) for k in range(2000))
    file = written(tmp_path, gzip.compress(b"time,vx,ay\n" + rows_of), "lap.csv.gz")
    needed_bytes = len(rows_of) + len(b"time,vx,ay\n") + 16 * 3 * 2001
    beyond_limit = needed_bytes - 10 * file.stat().st_size
    with use_limits(Limits(memory=beyond_limit)):
        assert len(read(file)) == 2000
    with use_limits(Limits(memory=beyond_limit - 1)):
        assert f"unpacks to {needed_bytes} bytes" in refusal(lambda: read(file))


def test_missing_samples_are_bridged_or_end_a_recording_by_max_gap(tmp_path):
    time = np.arange(1000) / 100.0
    speed = np.where((time >= 2.0) & (time < 2.05) | (time >= 5.0) & (time < 5.5), np.nan, time)
    turn = 2.0 * time
    rows = [f"{t:.2f},{v},{r}" for t, v, r in zip(time, speed, turn, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t,v,r", *rows]).replace("nan", ""))
    declared = {"name": "mine", "source": "tabular", "path": str(tmp_path)}
    declared |= {"time": {"column": "t", "unit": "s"}}
    declared["channels"] = {
        "vx": {"column": "v", "unit": "m/s"},
        "yaw_rate": {"column": "r", "unit": "rad/s"},
    }
    assert "max_gap of the data set ends a recording there" in (
        refusal(lambda: list(open_source(declared).recordings()))
    )
    before, after = open_source(declared | {"max_gap": 0.1}).recordings()
    assert (before.start_time, len(before), after.start_time, len(after)) == (0.0, 500, 5.5, 450)
    for part in (before, after):
        np.testing.assert_allclose(part["vx"], part.time, rtol=0, atol=1e-12)
        np.testing.assert_allclose(part["yaw_rate"], 2.0 * part.time, rtol=0, atol=1e-12)
    gappy = open_source(declared | {"max_gap": 0.1, "gappy": ["vx", "yaw_rate"]}).recordings()
    assert [int(np.isnan(part["vx"]).sum()) for part in gappy] == [55]
