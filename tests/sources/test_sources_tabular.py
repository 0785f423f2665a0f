"""Tables of any make: what pandas reads, in SI units and ISO 8855 signs; and one clear line for what cannot be used."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from place import run_vehest
from vehest import api
from vehest.alignment.checks import checks_of_recording
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.limits import Limits, use_limits
from vehest.data.recording import Recording
from vehest.data.store import write_recording
from vehest.sources import text_tables
from vehest.sources.held import between_samples, with_repeats
from vehest.sources.tabular import TabularSource
from vehest.sources.text_tables import check_size

TIME = {"column": "time", "unit": "s"}
HEADER = "time,vx,ay\n"
N = 200


def table() -> pd.DataFrame:
    """Two seconds of noise at 100 Hz."""
    generator = np.random.default_rng(0)
    channels = {name: generator.normal(0.0, 3.0, N) for name in ("vx", "yaw_rate", "ay")}
    return pd.DataFrame({"time": np.round(5.0 + np.arange(N) / 100.0, 2), **channels})


def rows(count: int, start: int = 0) -> str:
    return "".join(f"{k / 100:.2f},{k},{2 * k}\n" for k in range(start, start + count))


def source(folder: Path, **options: object) -> TabularSource:
    return TabularSource({"name": "mine", "source": "tabular", "path": str(folder), "files": "*", "time": TIME, **options})


def read(file: Path, **options: object) -> Recording:
    return source(file.parent, **options).read(file.stem)


def written(folder: Path, content: str | bytes, name: str = "lap.csv") -> Path:
    file = folder / name
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


def refusal(act: Callable[[], object], kind: type[VehestError] = DataError) -> str:
    with pytest.raises(kind) as error:
        act()
    assert type(error.value) is kind
    message = str(error.value)
    assert "\n" not in message
    return message


def assert_reads_as(recording: Recording, frame: pd.DataFrame) -> None:
    assert sorted(recording.channels) == sorted(name for name in frame.columns if name != "time")
    for name, samples in recording.channels.items():
        np.testing.assert_array_equal(samples, frame[name].to_numpy())


# --- what a data set derives -------------------------------------------------------------------------------------------------------


def test_a_log_with_wheel_speeds_and_a_sideslip_angle_gets_the_channels_that_it_lacks(tmp_path: Path) -> None:
    """A steady left turn: the angle was measured 2 m ahead of the centre of gravity, where v is larger by 2·r."""
    speed, yaw_rate, vy, ahead = 20.0, 0.4, -0.5, 2.0
    shown = np.degrees(np.arctan2(vy + ahead * yaw_rate, speed))
    frame = pd.DataFrame({"time": np.arange(N) / 100.0, "RL": np.full(N, speed / 0.3), "RR": np.full(N, speed / 0.3)})
    frame["yaw"], frame["slip"], frame["wheel"] = yaw_rate, shown, 32.0
    frame.to_csv(tmp_path / "lap.csv", index=False)
    columns = {
        "wheel_speed_rl": {"column": "RL", "unit": "rad/s"},
        "wheel_speed_rr": {"column": "RR", "unit": "rad/s"},
        "yaw_rate": {"column": "yaw", "unit": "rad/s"},
        "handwheel": {"column": "wheel", "unit": "deg"},
        "sideslip_ref": {"column": "slip", "unit": "deg"},
    }
    transforms = [
        {"name": "speed_from_wheels", "wheel_radius": 0.3},
        {"name": "acceleration_from_speed"},
        {"name": "steering_ratio", "ratio": 16},
        {"name": "velocity_from_sideslip"},
    ]
    point = {"x": ahead, "y": 0.0}
    recording = read(tmp_path / "lap.csv", channels=columns, transforms=transforms, reference_point=point, imu_point="unknown")
    np.testing.assert_allclose(recording["vx"], speed)
    np.testing.assert_allclose(recording["ax"], 0.0, atol=1e-12)
    np.testing.assert_allclose(recording["steer"], np.deg2rad(2.0))
    np.testing.assert_allclose(recording["vy_ref"], vy)
    np.testing.assert_allclose(recording["sideslip_ref"], np.arctan2(vy, speed))
    told = recording.provenance["derived"]
    assert (told["reference_point"], told["imu_point"], told["moved_to_centre_of_gravity"]) == (point, "unknown", True)
    assert [entry["name"] for entry in told["transforms"]] == [entry["name"] for entry in transforms]


def test_a_stored_recording_is_not_derived_twice(tmp_path: Path) -> None:
    table().assign(vy_ref=0.1).to_csv(tmp_path / "lap.csv", index=False)
    once = read(tmp_path / "lap.csv", reference_point={"x": 1.0})
    write_recording(once, tmp_path / "stored.parquet")
    again = source(tmp_path, reference_point={"x": 1.0}).read_file(tmp_path / "stored.parquet")
    np.testing.assert_array_equal(again["vy_ref"], once["vy_ref"])
    np.testing.assert_allclose(once["vy_ref"], 0.1 - table()["yaw_rate"])


def test_a_new_drive_needs_no_reference_to_be_read_as_its_data_set_says(tmp_path: Path) -> None:
    table().to_csv(tmp_path / "lap.csv", index=False)
    options = [
        "dataset.accept=[impossible]",
        "+dataset.reference_point={x: 2.0}",
        "+dataset.transforms=[{name: velocity_from_sideslip}, {name: acceleration_from_speed}]",
    ]
    recording = api.read_recording(tmp_path / "lap.csv", options)
    assert "ax" in recording
    assert "vy_ref" not in recording


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"transforms": [{"name": "spam"}]}, "data set 'mine': transform 'spam' is not one of"),
        ({"transforms": {"name": "steering_ratio"}}, "dataset.transforms"),
        ({"reference_point": {"x": "far"}}, "dataset.reference_point"),
        ({"reference_point": "somewhere"}, "dataset.reference_point"),
        ({"imu_point": {"z": 1}}, "dataset.imu_point"),
    ],
    ids=str,
)
def test_a_wrong_declaration_is_one_line_that_names_the_option(tmp_path: Path, options: dict[str, object], what: str) -> None:
    assert what in refusal(lambda: source(tmp_path, **options), ConfigurationError)


# --- what can be read --------------------------------------------------------------------------------------------------------------


def test_a_csv_file_reads_as_pandas_reads_it(tmp_path: Path) -> None:
    table().to_csv(tmp_path / "lap.csv", index=False)
    recording = read(tmp_path / "lap.csv", vehicle="kart", kind="real", citation="me")
    assert_reads_as(recording, pd.read_csv(tmp_path / "lap.csv"))
    assert (recording.id, recording.vehicle, recording.rate_hz, recording.start_time, recording.kind) == ("lap", "kart", 100.0, 5.0, "real")
    assert dict(recording.provenance) == {"dataset": "mine", "source": "tabular", "file": "lap.csv"}


@pytest.mark.parametrize("name", ["lap.parquet", "lap.pq"])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_parquet_file_reads_as_pandas_reads_it(tmp_path: Path, name: str, dtype: str) -> None:
    frame = table().astype({"vx": dtype, "ay": dtype})
    frame.to_parquet(tmp_path / name)
    recording = read(tmp_path / name)
    assert_reads_as(recording, pd.read_parquet(tmp_path / name).astype("float64"))
    assert recording.rate_hz == 100.0


def test_whole_numbers_and_missing_ones_of_parquet_are_read_as_such(tmp_path: Path) -> None:
    frame = pd.DataFrame({"time": np.arange(5) / 10, "vx": pd.array([1, 2, None, 4, 5], dtype="Int64")})
    frame.to_parquet(tmp_path / "lap.parquet")
    np.testing.assert_array_equal(read(tmp_path / "lap.parquet", gappy=["vx"])["vx"], [1, 2, np.nan, 4, 5])


def test_columns_units_and_signs_come_from_the_map(tmp_path: Path) -> None:
    frame = pd.DataFrame({"stamp": np.arange(50) * 10, "Speed": np.arange(50.0), "AccY": np.linspace(-1, 1, 50), "Gyro": np.full(50, 9.0)})
    frame.to_csv(tmp_path / "lap.csv", index=False)
    columns = {
        "vx": {"column": "Speed", "unit": "km/h"},
        "vx_ref": {"column": "Speed", "unit": "mph"},
        "ay": {"column": "AccY", "unit": "g", "sign": -1},
        "yaw_rate": {"column": "Gyro", "unit": "deg/s"},
    }
    recording = read(tmp_path / "lap.csv", channels=columns, time={"column": "stamp", "unit": "ms"})
    assert recording.rate_hz == 100.0
    np.testing.assert_allclose(recording["vx"], frame["Speed"] / 3.6)
    np.testing.assert_allclose(recording["vx_ref"], frame["Speed"] * 0.44704)
    np.testing.assert_allclose(recording["ay"], -9.80665 * frame["AccY"])
    np.testing.assert_allclose(recording["yaw_rate"], np.deg2rad(9.0))


def test_decimal_commas_delimiters_skipped_rows_and_latin_1_are_read(tmp_path: Path) -> None:
    body = "\n".join(f"{k / 100:.2f};{k * 0.5:.1f}" for k in range(20)).replace(".", ",")
    content = f"Messung vom 3. März\n\nZeit [s];Querbeschl. [m/s²]\n{body}\n".encode("latin-1")
    file = written(tmp_path, content)
    options = {"delimiter": ";", "decimal": ",", "encoding": "latin-1", "skip_rows": 2}
    columns = {"ay": {"column": "Querbeschl. [m/s²]", "unit": "m/s²"}}
    recording = read(file, channels=columns, time={"column": "Zeit [s]", "unit": "s"}, **options)
    frame = pd.read_csv(file, sep=";", decimal=",", encoding="latin-1", skiprows=2)
    np.testing.assert_array_equal(recording["ay"], frame["Querbeschl. [m/s²]"].to_numpy())
    assert (recording.rate_hz, recording.start_time) == (100.0, 0.0)


def test_without_a_time_column_the_rate_is_given(tmp_path: Path) -> None:
    table().drop(columns="time").to_csv(tmp_path / "lap.csv", index=False)
    recording = read(tmp_path / "lap.csv", time=None, rate_hz=125)
    assert (recording.rate_hz, recording.start_time, len(recording)) == (125.0, 0.0, N)


def test_a_jittering_clock_is_interpolated_where_that_is_asked_for(tmp_path: Path) -> None:
    stamps = np.arange(N) / 100.0 + 2e-3 * np.random.default_rng(2).uniform(-1, 1, N)
    pd.DataFrame({"time": stamps, "vx": 3.0 * stamps}).to_csv(tmp_path / "lap.csv", index=False)
    assert "set clock: interpolate" in refusal(lambda: read(tmp_path / "lap.csv"))
    recording = read(tmp_path / "lap.csv", clock="interpolate")
    assert recording.rate_hz == 100.0
    np.testing.assert_allclose(recording["vx"], 3.0 * recording.time, atol=1e-9)


def test_measurements_of_a_slow_channel_survive_interpolation(tmp_path: Path) -> None:
    stamps = np.arange(N) / 100.0 + 1e-3 * np.random.default_rng(2).uniform(-1, 1, N)
    slow = np.where(np.arange(N) % 10 == 0, 7.0, np.nan)
    pd.DataFrame({"time": stamps, "vx": np.ones(N), "vy_ref": slow}).to_csv(tmp_path / "lap.csv", index=False)
    assert np.isfinite(read(tmp_path / "lap.csv", clock="interpolate", gappy=["vy_ref"])["vy_ref"]).sum() == N / 10


@pytest.mark.parametrize("form", ["nanoseconds", "float32", "text of six digits"])
def test_unix_and_coarse_time_stamps_give_the_rate_that_was_meant(tmp_path: Path, form: str) -> None:
    start = 1_700_000_000 * 10**9
    if form == "nanoseconds":
        pq.write_table(pa.table({"time": start + 10_000_000 * np.arange(N) + 1, "vx": np.ones(N)}), tmp_path / "lap.parquet")
        recording = read(tmp_path / "lap.parquet", time={"column": "time", "unit": "ns"})
        assert recording.start_time == 1_700_000_000.0
    elif form == "float32":
        pq.write_table(pa.table({"time": (500 + np.arange(N) / 100).astype(np.float32), "vx": np.ones(N)}), tmp_path / "lap.parquet")
        recording = read(tmp_path / "lap.parquet")
    else:
        file = written(tmp_path, "time,vx\n" + "".join(f"{1_700_000_000 + k / 100:.6f},1\n" for k in range(N)))
        recording = read(file)
    assert recording.rate_hz == 100.0
    assert len(recording) == N


@pytest.mark.parametrize(
    "content",
    [
        "\ufeff" + HEADER + rows(9),
        (HEADER + rows(9)).replace("\n", "\r\n"),
        HEADER + rows(9) + "\n\n",
        HEADER + rows(9).rstrip("\n"),
        '"time","vx","ay"\n' + "".join(f'"{k / 100:.2f}","{k}","{2 * k}"\n' for k in range(9)),
        HEADER + rows(9).replace(",", ", "),
        HEADER + "".join(f"{k / 100:.2e},{k:+d},{2 * k:.3E}\n" for k in range(9)),
    ],
    ids=["byte order mark", "CRLF", "blank lines at the end", "no newline at the end", "quotes", "blanks", "exponents"],
)
def test_common_ways_of_writing_csv_read_alike(tmp_path: Path, content: str) -> None:
    recording = read(written(tmp_path, content))
    assert recording["vx"].tolist() == list(range(9))
    assert recording["ay"].tolist() == list(range(0, 18, 2))
    assert recording.rate_hz == 100.0


def test_a_stored_recording_is_read_as_what_it_is(tmp_path: Path) -> None:
    kept = Recording("lap", "kart", 20.0, 450.0, {"ay": np.arange(4.0)}, "simulated", provenance={"seed": 3})
    write_recording(kept, tmp_path / "lap.parquet")
    recording = read(tmp_path / "lap.parquet")
    assert recording["ay"].tolist() == kept["ay"].tolist()
    assert (recording.rate_hz, recording.start_time, recording.kind) == (20.0, 450.0, "simulated")


def test_recordings_are_the_stems_in_order(tmp_path: Path) -> None:
    for name in ("b.csv", "a.csv", "notes.txt"):
        written(tmp_path, HEADER + rows(3), name)
    found = source(tmp_path, files="*.csv")
    assert found.ids() == ["a", "b"]
    assert list(found.inputs()) == ["a.csv", "b.csv"]
    assert [recording.id for recording in found.recordings()] == ["a", "b"]
    assert "has no recording 'c' (it has a, b)" in refusal(lambda: found.read("c"), MissingError)


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=2, max_size=30))
def test_every_double_survives_its_shortest_text(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    folder = tmp_path_factory.mktemp("doubles")
    file = written(folder, "vx\n" + "".join(f"{value!r}\n" for value in values))
    samples = read(file, time=None, rate_hz=10)["vx"]
    assert samples.view(np.uint64).tolist() == np.array(values).view(np.uint64).tolist()


# --- what cannot -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("root", [None, "", "None", "null", "None/revs"])
def test_a_missing_root_says_how_to_give_one(root: str | None) -> None:
    found = TabularSource({"name": "mine", "source": "tabular", "path": root, "time": TIME})
    message = refusal(found.ids, MissingError)
    assert "data set 'mine'" in message
    assert "VEHEST_DATA" in message


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    message = refusal(source(tmp_path / "nowhere").ids, MissingError)
    assert str(tmp_path / "nowhere") in message
    assert "VEHEST_DATA" in message


def test_a_pattern_that_matches_nothing_is_named(tmp_path: Path) -> None:
    assert f"no file in '{tmp_path}' matches '*.csv'" in refusal(source(tmp_path, files="*.csv").ids, MissingError)


def test_two_files_of_one_stem_are_refused(tmp_path: Path) -> None:
    for name in ("lap.csv", "lap.txt"):
        written(tmp_path, HEADER + rows(3), name)
    assert "two files are called 'lap'" in refusal(source(tmp_path).ids)


def test_an_empty_file_is_called_empty(tmp_path: Path) -> None:
    assert "lap.csv' is empty" in refusal(lambda: read(written(tmp_path, "")), MissingError)


def test_a_missing_file_is_missing(tmp_path: Path) -> None:
    assert "there is no file" in refusal(lambda: source(tmp_path).read_file(tmp_path / "none.csv"), MissingError)


def cut_off(folder: Path) -> Path:
    table().to_parquet(folder / "lap.parquet")
    return written(folder, (folder / "lap.parquet").read_bytes()[:-20], "lap.parquet")


BAD_TABLES = {
    "header only": (HEADER, ["has a header and no rows"]),
    "blank lines only": ("\n\n", ["cannot be read as a table"]),
    "no such column": ("time,vx\n0,1\n0.01,2\n", ["no column 'ay'", "it has time, vx", "conf/dataset/mine.yaml"]),
    "column twice": ("time,vx,ay,ay\n" + "0,1,2,3\n0.01,1,2,3\n", ["2 columns called 'ay'", "rename or remove"]),
    "text": (HEADER + rows(4) + "0.04,abc,1\n" + rows(3, 5), ["column 'vx'", "'abc'", "data row 5", "numbers are needed"]),
    "text with underscore": (HEADER + rows(4) + "0.04,1_0,1\n", ["column 'vx'", "'1_0'", "data row 5"]),
    "row of units": (HEADER + "s,m/s,g\n" + rows(4), ["'m/s'", "data row 1"]),
    "decimal commas undeclared": ('time,vx,ay\n0,"1,5",2\n0.01,"1,6",2\n', ["'1,5'", "data row 1"]),
    "short row": (HEADER + rows(4) + "0.04,1\n", ["cannot be read as a table", "Row #6", "Expected 3 columns, got 2"]),
    "nan": (HEADER + rows(4) + "0.04,nan,1\n" + rows(3, 5), ["channel 'vx' holds 1 NaN between 0.04 s and 0.04 s", "gappy"]),
    "missing value": (HEADER + rows(4) + "0.04,,1\n" + rows(3, 5), ["channel 'vx' holds 1 NaN", "cut the range out"]),
    "infinite": (HEADER + rows(4) + "0.04,-inf,1\n" + rows(3, 5), ["channel 'vx' holds 1 infinite"]),
    "time missing": (HEADER + rows(4) + ",1,1\n" + rows(3, 5), ["time stamp of sample 4 is not a number"]),
    "time repeated": (HEADER + rows(4) + rows(4, 3), ["time repeats 1 times, first at sample 4 (0.03 s)", "remove"]),
    "time backwards": (HEADER + rows(8) + rows(4, 2), ["time goes backwards 1 times, first at sample 8 (0.02 s)", "sort"]),
    "gap": (HEADER + rows(8) + rows(8, 50), ["1 gaps", "0.43 s after 0.07 s", "clock: interpolate"]),
    "one row": (HEADER + rows(1), ["fewer than two time stamps"]),
    "other encoding": (b"time,vx,ay\xb2\n0,1,2\n", ["cannot be read as a table", "encoding"]),
    "no table at all": (bytes(range(256)), ["cannot be read as a table"]),
}


@pytest.fixture(params=[1, 4])
def processors(request: pytest.FixtureRequest) -> Iterator[int]:
    before = pa.cpu_count()
    pa.set_cpu_count(request.param)
    yield request.param
    pa.set_cpu_count(before)


@pytest.mark.parametrize("fault", BAD_TABLES)
def test_a_table_that_cannot_be_used_is_refused_in_one_line_that_says_where(tmp_path: Path, fault: str, processors: int) -> None:
    content, said = BAD_TABLES[fault]
    file = written(tmp_path, content)
    columns = {"vx": {"column": "vx", "unit": "m/s"}, "ay": {"column": "ay", "unit": "m/s²"}}
    message = refusal(lambda: read(file, channels=columns))
    assert f"'{file}'" in message
    for words in said:
        assert words in message


def test_a_truncated_parquet_file_is_refused(tmp_path: Path) -> None:
    message = refusal(lambda: read(cut_off(tmp_path)))
    assert "lap.parquet' is truncated or damaged" in message
    assert "truncated" in message


@pytest.mark.parametrize(
    ("column", "said"),
    [
        (pa.array(["a"] * 5), "column 'vx' is of type string"),
        (pa.array([None] * 5), "column 'vx' is of type null"),
        (pa.array([True] * 5), "column 'vx' is of type bool"),
    ],
)
def test_a_parquet_column_that_holds_no_numbers_is_refused(tmp_path: Path, column: pa.Array, said: str) -> None:
    pq.write_table(pa.table({"time": np.arange(5) / 10, "vx": column}), tmp_path / "lap.parquet")
    message = refusal(lambda: read(tmp_path / "lap.parquet"))
    assert said in message
    assert "numbers are needed" in message


def test_a_parquet_column_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    columns = [pa.array(np.arange(5) / 10), pa.array(np.ones(5)), pa.array(np.zeros(5))]
    pq.write_table(pa.Table.from_arrays(columns, names=["time", "vx", "vx"]), tmp_path / "lap.parquet")
    assert "2 columns called 'vx'" in refusal(lambda: read(tmp_path / "lap.parquet"))


def test_a_table_without_any_known_column_lists_what_it_has(tmp_path: Path) -> None:
    file = written(tmp_path, "time,Speed\n0,1\n0.01,2\n")
    message = refusal(lambda: read(file))
    assert "it has time, Speed" in message
    assert "declare the columns" in message


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"chanels": {}}, "has no option 'chanels'"),
        ({"clock": "spline"}, "clock 'spline' is not one of: strict, interpolate"),
        ({"time": None}, "rate_hz must be given"),
        ({"time": None, "rate_hz": "fast"}, "dataset.rate_hz must be a number, not 'fast'"),
        ({"time": None, "rate_hz": -5}, "rate_hz must be a positive number, not -5"),
        ({"time": {"column": "t", "unit": "km/h"}}, "time: unit 'km/h' cannot be converted to 's'"),
        ({"channels": ["vx"]}, "dataset.channels must be a mapping"),
        ({"channels": {"vx": {"column": "a", "unit": "furlong"}}}, "unit 'furlong' is not known"),
        ({"gappy": ["vz"]}, "gappy names 'vz'"),
        ({"gappy": "vx"}, "dataset.gappy must be a list of channels, not 'vx'"),
        ({"gappy": ["ay"], "channels": {"vx": {"column": "a", "unit": "m/s"}}}, "gappy names 'ay'"),
        ({"kind": "reel"}, "kind 'reel' is not one of: real, simulated"),
        ({"delimiter": ";;"}, "delimiter must be one character"),
        ({"decimal": ""}, "decimal must be one character"),
        ({"encoding": "latin-x"}, "encoding 'latin-x' is not known"),
        ({"skip_rows": "two"}, "skip_rows must be a whole number"),
        ({"skip_rows": -1}, "skip_rows must be a whole number"),
        ({"files": "/data/*.csv"}, "files must be a pattern inside path"),
        ({"files": ""}, "files must be a pattern inside path"),
    ],
)
def test_a_misspelt_data_set_is_refused_before_any_file_is_read(tmp_path: Path, options: dict[str, object], said: str) -> None:
    message = refusal(lambda: source(tmp_path, **options), ConfigurationError)
    assert said in message
    assert "data set 'mine'" in message


# --- several runs in a table -----------------------------------------------------------------------------------------------------------


def runs_csv(tmp_path: Path, runs: list[object]) -> Path:
    """A row a run number, 100 Hz, vx counting the rows."""
    lines = [f"{row / 100:.2f},{row},{run}" for row, run in enumerate(runs)]
    return written(tmp_path, "time,vx,run_id\n" + "\n".join(lines) + "\n")


def source_of(file: Path, **options: Any) -> TabularSource:
    return TabularSource({"name": "mine", "source": "tabular", "path": str(file.parent), "time": TIME, "runs": "run_id", **options})


def test_each_run_becomes_a_recording_with_its_own_start(tmp_path: Path) -> None:
    source = source_of(runs_csv(tmp_path, [7] * 20 + [3] * 30 + [4] * 10))
    assert source.ids() == ["lap_run_7", "lap_run_3", "lap_run_4"]
    recordings = list(source.recordings())
    assert [recording.start_time for recording in recordings] == [0.0, 0.2, 0.5]
    np.testing.assert_array_equal(np.concatenate([recording["vx"] for recording in recordings]), np.arange(60))
    assert recordings[1].provenance["run"] == 3


def test_time_may_jump_between_runs_but_not_within_one(tmp_path: Path) -> None:
    file = written(
        tmp_path, "time,vx,run_id\n" + "".join(f"{t:.2f},1,{run}\n" for run, t0 in ((0, 5.0), (1, 0.0)) for t in t0 + np.arange(9) / 100)
    )
    assert [recording.start_time for recording in source_of(file).recordings()] == [5.0, 0.0]
    gap = written(tmp_path, "time,vx,run_id\n" + "".join(f"{t:.2f},1,{run}\n" for run in (0, 1) for t in (0.0, 0.01, 0.02, 0.5, 0.51)))
    message = refusal(lambda: source_of(gap).read("lap_run_1"))
    assert f"'{gap}', run 1" in message
    assert "1 gaps" in message


@pytest.mark.parametrize(
    ("runs", "said"),
    [
        ([1, 1, 2, 2, 1, 1], "run 1 begins again in data row 5"),
        ([1, 1, 1.5, 1.5], "column 'run_id' holds 1.5 in data row 3; runs are counted in whole numbers"),
        ([1, 1, "", ""], "column 'run_id' holds nan in data row 3"),
        ([1, 1, "two"], "column 'run_id' holds the text 'two' in data row 3"),
    ],
)
def test_runs_that_cannot_be_told_apart_are_refused(tmp_path: Path, runs: list[object], said: str) -> None:
    file = runs_csv(tmp_path, runs)
    message = refusal(lambda: source_of(file).ids())
    assert f"'{file}'" in message
    assert said in message


def test_a_table_without_the_column_of_runs_is_refused(tmp_path: Path) -> None:
    message = refusal(lambda: source_of(runs_csv(tmp_path, [0, 0]), runs="lap").ids())
    assert "no column 'lap' that counts its runs (it has time, vx, run_id)" in message


def test_a_single_file_must_hold_one_run(tmp_path: Path) -> None:
    assert len(source_of(runs_csv(tmp_path, [4] * 9)).read_file(tmp_path / "lap.csv")) == 9
    message = refusal(lambda: source_of(runs_csv(tmp_path, [4] * 9 + [5] * 9)).read_file(tmp_path / "lap.csv"))
    assert "holds 2 runs (4, 5); keep the rows of one" in message


def test_a_factor_brings_a_column_to_its_declared_unit(tmp_path: Path) -> None:
    file = written(tmp_path, "time,rim\n" + "".join(f"{row / 100:.2f},{row}\n" for row in range(9)))
    columns = {"motor_speed": {"column": "rim", "factor": 20.0, "unit": "rad/s"}}
    np.testing.assert_array_equal(read(file, channels=columns)["motor_speed"], 20.0 * np.arange(9))


@pytest.mark.parametrize("factor", [0, float("nan"), "two", True])
def test_a_factor_is_a_number_other_than_nought(tmp_path: Path, factor: object) -> None:
    columns = {"vx": {"column": "vx", "factor": factor, "unit": "m/s"}}
    with pytest.raises(ConfigurationError, match="channel 'vx': factor must be a number other than 0"):
        TabularSource({"name": "mine", "source": "tabular", "path": str(tmp_path), "time": TIME, "channels": columns})


# --- what asks for too much ------------------------------------------------------------------------------------------------------------


def test_pipes_devices_and_folders_are_no_tables(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "lap.csv")
    (tmp_path / "folder.csv").mkdir()
    for file, said in (
        (tmp_path / "lap.csv", "is a pipe, not a file"),
        (Path("/dev/zero"), "a device"),
        (tmp_path / "folder.csv", "a folder"),
    ):
        assert said in refusal(partial(source(tmp_path).read_file, file))


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_rows_are_counted_before_they_are_parsed(tmp_path: Path, ending: str) -> None:
    file = written(tmp_path, ("time,vx,ay\n" + rows(50)).replace("\n", ending))
    with use_limits(Limits(samples=50)):
        assert "has 51 rows or more, more than the limit of 50; if that is meant, raise it: limits.samples=NUMBER" in refusal(
            lambda: read(file)
        )
    with use_limits(Limits(memory=8 * 152)):
        assert "51 rows or more, 153 values, more than the limit of 1216; if that is meant, raise it: limits.memory=" in refusal(
            lambda: read(file)
        )
    with use_limits(Limits(samples=51, memory=8 * 153)):
        assert len(read(file)) == 50


def test_lines_are_counted_across_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(tmp_path, "a\r\nb\r\r\nc\n\nd")
    for block in range(1, 12):
        monkeypatch.setattr(text_tables, "BLOCK", block)
        with use_limits(Limits(samples=5)):
            check_size(file, 1, 100)
        with use_limits(Limits(samples=4)), pytest.raises(DataError, match="more than the limit of 4"):
            check_size(file, 1, 100)
        with pytest.raises(DataError, match="line 1 is longer than 1 bytes"):
            check_size(written(tmp_path, "abc\n", "long.csv"), 1, 1)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (HEADER + "a" * 3_000_000, "line 2 is longer than 1048576 bytes; is it a table of text?"),
        ("\0" * 3_000_000, "line 1 is longer than 1048576 bytes"),
        (
            "time,vx" + "," * 20_000 + "\n",
            "has 20002 columns, more than the limit of 10000; if that is meant, raise it: limits.columns=NUMBER",
        ),
        (HEADER + '0,"1\x1b[2J",2\n0.1,1,2\n', "holds the text '1\\x1b[2J' in data row 1"),
        (HEADER + rows(3) + '0.03,"' + "x,\n" * 10, "'"),
    ],
    ids=["endless line", "null bytes", "columns", "escape", "quote"],
)
def test_a_table_that_is_none_is_refused_in_one_line(tmp_path: Path, content: str, said: str) -> None:
    assert said in refusal(lambda: read(written(tmp_path, content)))


def test_a_packed_table_is_read_and_unpacks_to_no_more_than_it_may(tmp_path: Path) -> None:
    assert len(read(written(tmp_path, gzip.compress((HEADER + rows(50)).encode()), "lap.csv.gz"))) == 50
    bomb = written(tmp_path, gzip.compress(HEADER.encode() + (b"0,1,1" + b" " * 995 + b"\n") * 80_000, 9), "bomb.csv.gz")
    with use_limits(Limits(memory=10**7)):
        assert "beyond ten times its size, more than the limit of 10000000" in refusal(lambda: read(bomb))
    torn = written(tmp_path, bomb.read_bytes()[:-100], "torn.csv.gz")
    assert "cannot be read" in refusal(lambda: read(torn))


def test_encodings_that_are_none_of_text_are_refused(tmp_path: Path) -> None:
    for encoding in ("zlib", "hex", "rot13", "undefined"):
        assert f"encoding '{encoding}' is not known" in refusal(partial(source, tmp_path, encoding=encoding), ConfigurationError)


def test_text_far_down_is_found_and_named(tmp_path: Path) -> None:
    file = written(tmp_path, HEADER + rows(200_000) + "2000,x,1\n")
    assert "column 'vx' holds the text 'x' in data row 200001" in refusal(lambda: read(file))


@pytest.mark.parametrize("rate_hz", [1e300, 1e-300])
def test_a_rate_of_no_sensor_is_refused(tmp_path: Path, rate_hz: float) -> None:
    file = written(tmp_path, "vx\n1\n2\n")
    assert "the sampling rate must lie between 1e-06 and 1e+09 Hz" in refusal(lambda: read(file, time=None, rate_hz=rate_hz))


def test_a_limit_is_raised_on_the_command_line_and_from_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written(tmp_path, "time,vx\n" + "".join(f"{k / 100:.2f},{k % 7}\n" for k in range(50)))
    few = "limits.samples=10"
    for command in (("data", "check"), ("data", "show"), ("data", "align", "-e", "delay"), ("estimate",)):
        words = [*command[:2], str(file), few, *command[2:]]
        code, out, err = run_vehest(capsys, *words)
        assert code == 3
        assert "has 51 rows or more, more than the limit of 10" in out + err
    with pytest.raises(DataError, match="more than the limit of 10"):
        api.read_recording(file, [few])
    assert len(api.read_recording(file)) == 50
    with pytest.raises(ConfigurationError, match=r"limits\.samples must be a whole number"):
        api.read_recording(file, ["limits.samples=many"])


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_an_hour_at_1_khz_with_55_channels_passes_all_limits(tmp_path: Path, ending: str) -> None:
    """Written as a logger writes: columns of three decimals, of which vehest knows 20 by name."""
    names = sorted(name for name in CHANNELS if not name.endswith("_ref"))[:20]
    names += [f"signal_{k}" for k in range(55 - len(names))]
    generator, file = np.random.default_rng(0), tmp_path / f"lap.{ending}"
    with (
        pq.ParquetWriter(file, schema := pa.schema([(name, pa.float64()) for name in ("time", *names)]))
        if ending == "parquet"
        else (pc.CSVWriter(file, schema := pa.schema([(name, pa.float64()) for name in ("time", *names)]))) as writer
    ):
        for minute in range(60):
            time = np.round((60_000 * minute + np.arange(60_000)) / 1000.0, 3)
            writer.write_table(pa.table([time, *(np.round(generator.normal(0.0, 0.1, 60_000), 3) for _ in names)], schema=schema))
    declared = {name: {"column": column, "unit": CHANNELS[name].unit} for name, column in zip(CHANNELS, names * 2, strict=False)}
    recording = source(tmp_path, channels=declared).read_file(file)
    assert (len(recording), recording.rate_hz) == (3_600_000, 1000.0)
    assert checks_of_recording(recording) is not None


def test_a_held_value_that_stays_is_no_ramp() -> None:
    """10 Hz held at 100 Hz: at rest until 8 s, then rising; without a column that tells of updates, rest stays rest."""
    times = np.concatenate([[0.5, 0.6, 0.7, 0.8, 0.9, 1.0], np.arange(8.0, 10.0, 0.1)])
    samples = np.concatenate([[5.0, 4.0, 3.0, 2.0, 1.0, 0.0], np.arange(20) + 1.0])
    grid = np.array([1.5, 4.5, 7.8, 8.0, 8.05])
    np.testing.assert_allclose(between_samples(*with_repeats(samples, times), 0.0, grid), [0.0, 0.0, 0.0, 1.0, 1.5], atol=1e-9)


def test_a_reference_point_of_a_scaled_car_is_refused(tmp_path: Path) -> None:
    transforms = [{"name": "scale_to_wheelbase", "wheelbase": 0.3, "to": 2.4}]
    message = refusal(lambda: source(tmp_path, transforms=transforms, reference_point={"x": 0.1}), ConfigurationError)
    assert "by the transform reference_lever, before scale_to_wheelbase" in message
