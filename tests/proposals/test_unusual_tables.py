"""Tables that loggers write with odd headers, cells, times and layouts: read right, or refused with
the way out.
"""

import datetime
import gzip
import json
from zipfile import ZipFile

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mdf_log import write_mdf
from planted_logs import G, drive, examine, inspected, usual, write

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.run.own_car.dataset import draft
from vehest.run.own_car.questions import ask, questions_of
from vehest.sources.base import open_source
from vehest.sources.clock_times import seconds_of_text
from vehest.sources.not_measured import codes_of_not_measured, marks_not_measured
from vehest.sources.surveys import survey
from vehest.sources.surveys.tables import survey_table


@pytest.fixture
def d():
    """Motion of a known car: name -> (T,), in SI units."""
    return drive()


@pytest.fixture
def table(d):
    """Its log under usual names and units."""
    return usual(d)


def read_back(file):
    """The data set's draft, and the recording that its source reads by it."""
    log_draft = draft(inspected(file))
    return log_draft, open_source(log_draft.dataset).read(file.stem)


def text_file(tmp_path, *lines):
    file = tmp_path / "lap.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    return file


def assert_yaw_rate_is(recording, table):
    np.testing.assert_allclose(recording["yaw_rate"], np.radians(table["Gyro"]), atol=1e-6)


def lines_of(table):
    return table.round(5).to_csv(index=False).splitlines()


def test_rows_of_names_units_and_sources_and_a_name_that_stands_twice(tmp_path, d):
    names = "t,speed,lateral_acc,speed,y_acc,z_rate"
    head = [
        "A lap timer",
        "Format,3",
        "",
        names,
        "s,m/s,G,m/s,G,deg/s",
        ",100: gps,calc,calc,101,102",
    ]
    product = d["vx"] * d["r"] / G  # computed, and not measured
    columns = (d["t"], d["vx"], product, d["vx"] + 0.01, d["ay"] / G, np.degrees(d["r"]))
    rows = [",".join(f"{value:.5f}" for value in row) for row in zip(*columns, strict=True)]
    file = text_file(tmp_path, *head, *rows)
    log_draft, recording = read_back(file)
    channels = {name: entry["column"] for name, entry in log_draft.dataset["channels"].items()}
    assert {channels.pop("vx"), channels.pop("vx_ref")} == {"speed #2", "speed #4"}
    assert channels == {"yaw_rate": "z_rate", "ay": "y_acc"}
    np.testing.assert_allclose(recording["ay"], d["ay"], atol=1e-4)
    assert recording.rate_hz == 50.0


def test_a_row_of_types_between_names_and_units_holds_no_names(tmp_path, table):
    names, *rows = lines_of(table)
    types = ",".join(["f8"] * len(table.columns))
    file = text_file(tmp_path, "ASCII record", names, types, "s,km/h,deg/s,g,g,deg,deg", *rows)
    assert_yaw_rate_is(read_back(file)[1], table)
    assert set(inspected(file).log.by_name) == {*table.columns} - {"Time [s]"}


@pytest.mark.parametrize(
    ("of_names", "of_rows"), [(",", ""), ("", ","), ("", ",,"), (",", ",,"), (",,", "")]
)
def test_delimiters_at_the_end_of_the_names_or_of_the_rows(tmp_path, of_names, of_rows, table):
    lines = lines_of(table)
    lines = [lines[0] + of_names, *(row + of_rows for row in lines[1:])]
    file = text_file(tmp_path, *lines)
    assert_yaw_rate_is(read_back(file)[1], table)


@pytest.mark.parametrize("cell", ["1.#INF", "-1.#IND", "#VALUE!", "SNA", "not available", "bad!"])
def test_one_odd_cell_is_a_missing_sample_that_is_bridged(tmp_path, cell, table):
    table = table.round(5)
    lines = [line.split(",") for line in lines_of(table)]
    lines[701][2] = cell
    file = text_file(tmp_path, *map(",".join, lines))
    log_draft, recording = read_back(file)
    assert log_draft.dataset.get("missing", [cell]) == [cell]
    table.loc[700, "Gyro"] = 0.5 * (table.loc[699, "Gyro"] + table.loc[701, "Gyro"])
    assert_yaw_rate_is(recording, table)
    named = [note for note in log_draft.notes if "'bad!' in data row 701 of column 'Gyro'" in note]
    assert len(named) == (cell == "bad!")


def test_names_that_are_repeated_in_the_file_are_left_out(tmp_path, table):
    lines = lines_of(table)
    file = text_file(tmp_path, *lines[:500], lines[0], *lines[500:])
    log_draft, recording = read_back(file)
    assert log_draft.dataset["drop_rows"] == {"lap": [500]}
    assert_yaw_rate_is(recording, table)


HEAD = ["A logger", "Time,Speed,Gyro,LatAcc,LongAcc,Steer,Beta", "s,km/h,deg/s,g,g,deg,deg"]


def test_files_that_were_joined_with_their_headers_are_recordings_of_their_own(tmp_path, table):
    table.loc[4000:, "Time [s]"] -= 75.0
    rows = lines_of(table)[1:]
    file = text_file(tmp_path, *HEAD, *rows[:4000], *HEAD, *rows[4000:])
    log_draft = draft(inspected(file))
    assert log_draft.dataset["drop_rows"] == {"lap": [4001, 4002]}
    source = open_source(log_draft.dataset)
    assert source.ids() == ["lap_run_0", "lap_run_1"]
    parts = [source.read(name) for name in source.ids()]
    assert [len(part) for part in parts] == [4000, 2000]
    yaw_rate = np.concatenate([part["yaw_rate"] for part in parts])
    np.testing.assert_allclose(yaw_rate, np.radians(table["Gyro"]), atol=1e-6)


@pytest.mark.parametrize(
    ("line", "old", "new"), [(1, "Gyro,LatAcc", "LatAcc,Gyro"), (2, "km/h", "mph")]
)
def test_files_that_were_joined_with_other_names_or_units_are_refused(tmp_path, line, old, new):
    rows = lines_of(usual(drive()))[1:]
    second = list(HEAD)
    second[line] = second[line].replace(old, new)
    file = text_file(tmp_path, *HEAD, *rows[:4000], *second, *rows[4000:])
    message = rf"data row 400{line} holds other names or units .* '{new.split(',')[0]}'; save the"
    with pytest.raises(DataError, match=message):
        inspected(file)


def test_rows_of_marks_of_missing_samples_alone_stay(tmp_path, table):
    table = table.drop(columns="Time [s]")
    lines = lines_of(table)
    lines[500] = ",".join(["SNA"] * 6)
    log = survey_table(text_file(tmp_path, *lines))
    assert log.repeated_names == ()
    assert len(log.by_name["Gyro"].values) == len(table)


def test_statistics_above_the_numbers_are_left_out(tmp_path, table):
    statistics = [
        ",".join([name, *map(str, getattr(table.iloc[:, 1:], name)().round(3))])
        for name in ("min", "max", "mean")
    ]
    rows = lines_of(table)[1:]
    log_draft, recording = read_back(text_file(tmp_path, *HEAD, *statistics, *rows))
    assert log_draft.dataset["drop_rows"] == {"lap": [1, 2, 3]}
    assert recording.rate_hz == 50.0
    assert_yaw_rate_is(recording, table)


def test_a_table_that_gzip_compressed_is_read_once_its_name_says_so(tmp_path, table):
    file = write(tmp_path / "lap.csv", table)
    file.write_bytes(gzip.compress(file.read_bytes()))
    with pytest.raises(DataError, match=r"by gzip; let its name end in '\.csv\.gz'"):
        inspected(file)
    log_draft = draft(inspected(file.rename(tmp_path / "lap.csv.gz")))
    assert_yaw_rate_is(open_source(log_draft.dataset).read("lap.csv"), table)


@pytest.mark.parametrize("time", ["Time [s]", "t [s]"])
def test_two_files_of_one_drive_are_refused_with_the_command_that_joins_them(
    tmp_path, monkeypatch, time, table
):
    slow = table[["Time [s]", "Speed"]][::5].rename(columns={"Time [s]": time})
    write(tmp_path / "gnss.csv", slow)
    write(tmp_path / "imu.csv", table.drop(columns="Speed"))
    with pytest.raises(DataError, match="if the files are of one drive") as refused:
        inspected(tmp_path / "imu.csv", tmp_path / "gnss.csv")
    monkeypatch.chdir(tmp_path)
    command = str(refused.value).partition("by pandas: ")[2]
    eval(command, {"merge": pd.merge, "read_csv": pd.read_csv})
    _, recording = read_back(tmp_path / "joined.csv")
    assert recording.rate_hz == 50.0
    assert_yaw_rate_is(recording, table[: len(recording)])
    np.testing.assert_allclose(recording["vx"], table["Speed"][: len(recording)] / 3.6, atol=0.1)


@pytest.mark.parametrize("below", [["End of measurement", "# EOF"], ["Mean" + ",1.0" * 6, "Max,9"]])
def test_text_between_and_below_the_rows_is_left_out_and_named(tmp_path, below, table):
    lines = lines_of(table)
    below = [line + ",9" * (6 - line.count(",")) if "," in line else line for line in below]
    file = text_file(tmp_path, *lines[:500], "# marker: lap 2", *lines[500:], *below, "")
    log_draft, recording = read_back(file)
    assert "not read: line '# marker: lap 2'" in log_draft.notes
    assert log_draft.dataset.get("drop_rows", {}) == (
        {"lap": [6001, 6002]} if "," in below[0] else {}
    )
    assert len(recording) == 6000
    assert_yaw_rate_is(recording, table)


def test_a_row_of_numbers_that_is_cut_off_within_the_table_is_an_error(tmp_path):
    lines = lines_of(usual(drive()))
    for row in ("bad,1.0,2.0", lines[500][:-30]):
        file = text_file(tmp_path, *lines[:500], row, *lines[500:])
        with pytest.raises(DataError, match="Expected 7 columns"):
            inspected(file)


def test_a_unit_of_time_that_the_steps_contradict_is_asked_with_the_one_that_fits(tmp_path, table):
    table = table.rename(columns={"Time [s]": "tow(msec)"})
    clock = examine(tmp_path, table).log.clock
    assert (clock.column, clock.unit, clock.asked) == ("tow(msec)", "s", True)
    assert "50 Hz if in s, 50000 Hz in ms, as the header says" in clock.evidence


def clock_texts(written):
    start = datetime.datetime(2025, 5, 31, 23, 59, 0)
    return [written(start + datetime.timedelta(milliseconds=20 * k)) for k in range(6000)]


TIMES = {
    "12 hours": lambda at: at.strftime("%m/%d/%Y %I:%M:%S.%f %p"),
    "day first": lambda at: at.strftime("%d/%m/%Y %H:%M:%S.%f"),
    "milliseconds by a colon": lambda at: at.strftime("%H:%M:%S:") + at.strftime("%f")[:3],
    "timedelta": lambda at: f"{at.day % 31} days {at:%H:%M:%S.%f}",
    "month by name": lambda at: at.strftime("%d-%b-%Y %H:%M:%S.%f"),
    "year of two digits": lambda at: at.strftime("%m/%d/%y %I:%M:%S.%f%p"),
    "ISO without marks": lambda at: at.strftime("%Y%m%dT%H%M%S.%fZ"),
    "underscore": lambda at: at.strftime("%Y-%m-%d_%H:%M:%S.%f"),
    "day of the year": lambda at: at.strftime("%j:%H:%M:%S.%f"),
    "year and its day": lambda at: at.strftime("%Y-%j-%H:%M:%S.%f"),
    "hhmmss": lambda at: at.strftime("%H%M%S.%f"),
    "date and time in digits": lambda at: at.strftime("%Y%m%d%H%M%S%f")[:-3],
}


@pytest.mark.parametrize(
    ("unit", "seconds"), [("h", 3600.0), ("min", 60.0), ("1/100 s", 0.01), ("秒", 1.0)]
)
def test_a_unit_of_time_is_read_where_the_header_states_it(tmp_path, unit, seconds, table):
    table["Time [s]"] /= seconds
    file = exact(tmp_path, table.rename(columns={"Time [s]": f"time [{unit}]"}))
    clock = inspected(file).log.clock
    assert (clock.asked, read_back(file)[1].rate_hz) == (False, 50.0)


@pytest.mark.parametrize(
    ("mark", "units"),
    [("", "[s],[km/h],[°/s],[g],[g],[°],[°]"), ("# ", "s,km/h,deg/s,g,g,deg,deg")],
)
def test_a_row_of_units_in_brackets_or_in_a_comment_has_the_unit_of_time(tmp_path, mark, units):
    names, *rows = lines_of(usual(drive()).rename(columns={"Time [s]": "Time"}))
    clock = survey_table(text_file(tmp_path, mark + names, mark + units, *rows)).clock
    assert (clock.unit, clock.asked) == ("s", False)


def test_fixes_of_a_receiver_of_1_hz_are_bridged_though_they_jitter(tmp_path):
    table = usual(drive(60.0))
    fixes = np.arange(0, len(table), 50) + np.random.default_rng(0).integers(0, 3, 60)
    has_none = ~np.isin(np.arange(len(table)), fixes)
    table.loc[has_none, "Speed"] = np.nan
    log_draft, recording = read_back(write(tmp_path / "lap.csv", table))
    assert "drop_rows" not in log_draft.dataset
    assert recording.duration > 58.0


@pytest.mark.parametrize("times", ["fewer", "others"])
def test_a_column_of_times_for_each_channel_is_refused(tmp_path, times, table):
    table = table.rename(columns={"Time [s]": "Time_v [s]"})
    lateral = table[["Gyro", "LatAcc"]].assign(**{"Time_r [ms]": 1e3 * table["Time_v [s]"]})
    if times == "fewer":
        lateral = lateral[::5].reset_index(drop=True)
    else:
        lateral["Time_r [ms]"] = 120e3 * np.linspace(0.0, 1.0, 6000) ** 1.1
    table = pd.concat([table.drop(columns=["Gyro", "LatAcc"]), lateral], axis=1)
    with pytest.raises(DataError, match=r"of times, Time_v \[s\], Time_r \[ms\], which differ"):
        examine(tmp_path, table)


def test_further_columns_of_times_that_agree_or_count_otherwise_are_read(tmp_path, table):
    seconds = table["Time [s]"]
    table = table.assign(
        **{
            "t_received [s]": seconds + 0.1 * np.sin(seconds),
            "UTC [s]": 43_200.0 + seconds,
            "Lap Time [s]": seconds % 70.0,
            "time_cam [s]": seconds.where(seconds < 60.0),
            "GNSS time [s]": seconds.where(np.arange(6000) % 10 == 0),
            "timestamp": 1e3 * seconds,
        }
    )
    assert_yaw_rate_is(read_back(write(tmp_path / "lap.csv", table))[1], table)


DURATIONS = {
    "ISO 8601": lambda seconds: f"PT{seconds:.2f}S",
    "ISO 8601 with minutes": lambda s: (
        f"PT{s // 60:.0f}M{s % 60:.2f}S" if s % 60 else f"PT{s / 60:.0f}M"
    ),
    "unit in each cell": lambda seconds: f"{seconds:.2f} s",
}


@pytest.mark.parametrize("name", DURATIONS)
def test_durations_are_times(tmp_path, name, table):
    table["Time [s]"] = table["Time [s]"].map(DURATIONS[name])
    _, recording = read_back(
        write(tmp_path / "lap.csv", table.rename(columns={"Time [s]": "Elapsed"}))
    )
    assert (recording.rate_hz, recording.start_time) == (50.0, 0.0)
    assert_yaw_rate_is(recording, table)


@pytest.mark.parametrize("name", TIMES)
def test_times_of_a_clock_in_other_forms_go_on_past_midnight(tmp_path, name, table):
    table["Time [s]"] = clock_texts(TIMES[name])
    table = table.rename(columns={"Time [s]": "Time"})
    log_draft, recording = read_back(write(tmp_path / "lap.csv", table))
    assert (log_draft.dataset["time"]["unit"], recording.rate_hz) == ("clock", 50.0)
    assert_yaw_rate_is(recording, table)


def test_text_that_is_no_time_is_none():
    for text in ("12:61 h", "31/31/2025 10:00:00", "first 10:00:00"):
        assert seconds_of_text(pa.chunked_array([[text, text]])) is None


def test_durations_of_parquet_are_times_and_columns_that_are_not_read_are_named(tmp_path, table):
    stored = table.assign(ok=True, note="x")
    stored["Time [s]"] = pd.to_timedelta(table["Time [s]"], unit="s")
    file = tmp_path / "lap.parquet"
    pq.write_table(pa.Table.from_pandas(stored), file)
    log_draft, recording = read_back(file)
    assert log_draft.dataset["time"] == {"column": "Time [s]", "unit": "ns"}
    assert_yaw_rate_is(recording, table)
    assert [note for note in log_draft.notes if note.startswith("not read: column 'ok' holds bool")]


def long_format(header="time,lap,telemetry_name,telemetry_value", n_rows=200):
    rows = ((k, name, k % 7) for k in range(n_rows) for name in ("speed", "accy_can"))
    if n_rows > 600:  # one quantity after the other
        rows = sorted(rows, key=lambda row: row[1])
    return f"{header}\n" + "".join(f"{0.1 * k:.1f},2,{name},{value}\n" for k, name, value in rows)


def test_a_trace_of_pcan_is_named_as_a_log_of_a_bus(tmp_path):
    (tmp_path / "lap.trc").write_text(";$FILEVERSION=1.1\n 1) 0.0 Rx 0101 1 D8\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"is a log of a CAN bus.*vehest new my_car lap.trc"):
        inspected(tmp_path / "lap.trc")


@pytest.mark.parametrize("has_pauses", [False, True])
def test_the_rate_by_times_that_repeat_is_that_of_the_rows_between_pauses(tmp_path, has_pauses):
    """Each time stands in two to five rows of 100 Hz."""
    table = usual(drive(60.0, rate_hz=100.0)).drop(columns="LongAcc")
    times = table["Time [s]"].to_numpy()
    firsts = np.cumsum(np.random.default_rng(0).integers(2, 6, len(times)))
    table["Time [s]"] = times[np.r_[0, firsts[firsts < len(times)]]][
        np.searchsorted(firsts, np.arange(len(times)), side="right")
    ].round(2)
    is_paused = ((times > 10.0) & (times < 18.0)) | ((times > 40.0) & (times < 43.0))
    write(tmp_path / "lap.csv", table[~is_paused] if has_pauses else table)
    examined = inspected(tmp_path / "lap.csv")
    assert examined.rate_hz == 100.0
    assert "rate" in [question.key for question in questions_of(examined)]
    is_named = any("2 pauses of 'Time" in note for note in examined.proposals.notes)
    assert is_named == has_pauses


def test_a_table_that_writes_its_rows_several_times_is_refused_with_the_way_out(tmp_path):
    table = usual(drive(60.0, rate_hz=20.0))
    n_times = np.random.default_rng(0).integers(2, 6, len(table))
    file = write(tmp_path / "lap.csv", table.loc[np.repeat(table.index, n_times)])
    with pytest.raises(DataError, match=r"repeats 3\d\d\d of its .* rows.*drop_duplicates"):
        inspected(file)
    write(file, pd.read_csv(file).drop_duplicates())
    assert inspected(file).log.rate_hz is None
    assert read_back(file)[1].rate_hz == 20.0


UNSUITED = {
    "long format": (long_format(), "'telemetry_name' names the quantity, 'telemetry_value' holds"),
    "names of a database": (long_format("_time,lap,_field,_value"), "'_field' names the quantity"),
    "one quantity after the other": (long_format(n_rows=700), "'telemetry_name' names the"),
    "raw frames": (
        "Time,ID,DLC,Data\n" + "".join(f"{k},1A{k % 9},2,00 {k % 256:02X}\n" for k in range(99)),
        "raw frames of a CAN bus; decode them by the bus's DBC",
    ),
    "candump": (
        "".join(f"(1436509052.{k:06d}) can0 1A{k % 9}#2A36{k % 256:02X}\n" for k in range(99)),
        "raw frames of a CAN bus as candump writes them",
    ),
    "German names": (
        long_format("Zeit,Runde,Messgröße,Messwert"),
        "'Messgröße' names the quantity, 'Messwert' holds",
    ),
    "a German measuring system": (
        long_format("Zeitstempel,Runde,Messkanal,Messwert"),
        "'Messkanal' names the quantity, 'Messwert' holds",
    ),
    "an OBD logger": (long_format("time,lap,PID,Data"), "'PID' names the quantity, 'Data' holds"),
    "annotated CSV": (
        "#group,false,false,true,true,false,false,true,true\n"
        ",result,table,_start,_stop,_time,_value,_field,_measurement\n"
        + "".join(f",,0,2024-03-01,2024-03-02,{0.1 * k:.1f},{k},speed,car\n" for k in range(99)),
        "'_field' names the quantity, '_value' holds",
    ),
    "line protocol": (
        "".join(f"car,lap=2 speed={k},ay={k % 7} {1_700_000_000_000 + k}\n" for k in range(99)),
        "InfluxDB's line protocol; export a table with a column of each field",
    ),
    "candump with dates": (
        "".join(
            f" (2024-03-01 10:00:00.{k:06d})  can0  1A0   [2]  00 {k:02X}\n" for k in range(99)
        ),
        "raw frames of a CAN bus as candump writes them",
    ),
    "frames in base64": (
        "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
        + "".join(f"{k},0x1a0,0,0,0,8,ChssAAD/{k % 10}AA=\n" for k in range(99)),
        "raw frames of a CAN bus; decode them by the bus's DBC",
    ),
    "an array of JSON": (
        json.dumps([{"utime": k, "vel": [k, 0.0], "rotation_rate": [0.0, k]} for k in range(99)]),
        "is JSON; save a table with a row for each time",
    ),
    "an indented object of JSON": (
        json.dumps({"vehicle_speed": {"values": [[k, 2 * k] for k in range(99)]}}, indent=1),
        "is JSON; save a table with a row for each time",
    ),
    "a trace of OpenXC": (
        "".join(f'13327941{k}.31: {{"name":"speed","value":{k}.5}}\n' for k in range(10, 99)),
        "is JSON; save a table with a row for each time",
    ),
    "messages of a receiver": (
        "".join(
            f"#INSPVAXA,COM1,0,73.5,FINE,1695,{k}.0,0;INS_SOLUTION_GOOD,48.1,11.5*e877c178\n"
            for k in range(99)
        ),
        "messages of a satellite receiver",
    ),
    "a row for each signal": (
        usual(drive(10.0)).round(4).T.to_csv(header=False),
        "has a row for each signal; transpose it",
    ),
    "quoted rows": (
        "".join(f'"{line}"\n' for line in lines_of(usual(drive(10.0)))),
        "each row in one pair of quotes; remove them",
    ),
}


@pytest.mark.parametrize("name", UNSUITED)
def test_a_file_without_a_column_a_signal_is_named_with_the_way_out(tmp_path, name):
    text, message_part = UNSUITED[name]
    with pytest.raises(DataError) as refused:
        inspected(text_file(tmp_path, text))
    assert message_part in str(refused.value)


def test_long_format_in_parquet_is_named_too(tmp_path):
    long = usual(drive(10.0)).melt("Time [s]", var_name="signal", value_name="value")
    long.to_parquet(tmp_path / "lap.parquet")
    with pytest.raises(DataError, match="'signal' names the quantity, 'value' holds it"):
        inspected(tmp_path / "lap.parquet")


def test_decimal_commas_in_quotes_between_commas_are_read(tmp_path, table):
    lines = [[f'"{cell}"' for cell in line.split(",")] for line in lines_of(table)]
    text = "\n".join(",".join(cells).replace(".", ",") for cells in lines)
    assert_yaw_rate_is(read_back(text_file(tmp_path, text))[1], table)


def test_a_column_of_names_beside_columns_of_signals_is_no_long_format(tmp_path, table):
    table = table.assign(name="lap", value=np.arange(6000) % 50)
    assert examine(tmp_path, table).proposals.by_channel["ay"]


def test_a_sideslip_angle_without_meaning_at_crawl_is_taken_as_zero_there(tmp_path, d):
    ramp = np.clip((d["t"] - 5.0) / 10.0, 0.0, 1.0)
    random = np.random.default_rng(0)
    d |= {name: ramp * d[name] for name in ("vx", "r", "vy")}
    d["ay"] = np.gradient(d["vy"], d["t"]) + d["vx"] * d["r"] + 0.05 * random.standard_normal(6000)
    crawls = d["vx"] < 0.6
    d["sideslip"] = np.where(
        crawls, random.uniform(-np.pi, np.pi, 6000), np.arctan2(d["vy"], np.maximum(d["vx"], 0.1))
    )
    log_draft, recording = read_back(write(tmp_path / "lap.csv", usual(d)))
    assert {"name": "velocity_from_sideslip", "min_speed": 1.0} in log_draft.dataset["transforms"]
    slow = recording["vx"] < 1.0
    assert np.abs(recording["vy_ref"][slow]).max() == 0.0
    np.testing.assert_allclose(recording["vy_ref"][~slow], d["vy"][~slow], atol=1e-2)


@pytest.mark.parametrize("code", [-9999.0, 1e20, 327.67, 3.4028e38, 409.5, -128.0])
def test_numbers_that_loggers_write_for_nothing_are_missing_samples(tmp_path, code, table):
    expected = np.radians(table["Gyro"].copy())
    for first in (300, 900, 1500):
        table.loc[first : first + 5, ["Gyro", "Speed"]] = code
    log_draft, recording = read_back(write(tmp_path / "lap.csv", table))
    assert log_draft.dataset["channels"]["yaw_rate"]["invalid"] == pytest.approx([code], rel=1e-12)
    assert any(f"{code:.9g} in 18 samples of 'Gyro'" in note for note in log_draft.notes)
    assert np.abs(recording["yaw_rate"] - expected[: len(recording)]).max() < 0.02


def test_a_value_within_the_range_of_the_others_is_no_code():
    heading = np.linspace(0.0, 359.0, 1000)
    heading[[100, 101]] = 327.67
    saturated = np.minimum(np.linspace(0.0, 500.0, 1000), 327.67)
    spike = np.r_[np.linspace(0.0, 1.0, 1000), 9999.0]
    for samples in (heading, saturated, spike, np.zeros(100), np.full(100, np.nan)):
        assert codes_of_not_measured(samples) == []
    assert codes_of_not_measured(np.r_[np.linspace(0.0, 1.0, 100), -9999, -9999, 65535, 65535]) == [
        65535.0,
        -9999.0,
    ]


def exact(folder, table):
    """A table of text with all digits."""
    file = folder / "lap.csv"
    table.to_csv(file, index=False)
    return file


def test_days_of_a_spreadsheet_are_a_clock(tmp_path, table):
    name = table.columns[0]
    table[name] = 45000.5 + table[name] / 86_400.0
    log_draft, recording = read_back(exact(tmp_path, table.rename(columns={name: "Timestamp"})))
    assert log_draft.dataset["time"] == {"column": "Timestamp", "unit": "d"}
    assert recording.rate_hz == 50.0


def test_stamps_that_no_unit_of_time_explains_are_no_clock(tmp_path, table):
    name = table.columns[0]
    table[name] = 1e-8 * table[name]
    log = survey_table(exact(tmp_path, table.rename(columns={name: "time"})))
    assert log.clock is None


@pytest.mark.parametrize(
    ("cell", "message_part"),
    [
        (lambda v: f'"{1e3 * v:,.1f}"', "a separator of thousands, such as '"),
        (lambda v: f"{v:.3f}".replace("-", "−"), "another minus sign, such as '−"),
        (lambda v: f"{v:.3f} deg/s", "a unit, such as '"),
        (lambda v: f"{v:.4E}".replace("E", "D"), "another mark of the exponent, such as '"),
        (lambda v: f"({abs(v):.3f})" if v < 0.0 else f"{v:.3f}", "parentheses for a minus sign,"),
        (lambda v: f"[{v:.4f} 0.02 -1e-05]", "brackets around several of them, such as '["),
    ],
)
def test_numbers_that_are_no_numbers_for_a_program_are_named(tmp_path, cell, message_part, table):
    lines = [",".join(table.columns)]
    for row in table.itertuples(index=False):
        cells = [f"{value:.5f}" for value in row]
        at = list(table.columns).index("Gyro")
        cells[at] = cell(100.0 + row[at]) if "thousand" in message_part else cell(row[at])
        lines.append(",".join(cells))
    file = text_file(tmp_path, *lines)
    (reason,) = (reason for reason in survey_table(file).skipped if "'Gyro'" in reason)
    assert reason.startswith(f"column 'Gyro' holds numbers with {message_part}")


def test_a_decimal_mark_that_other_columns_do_not_have_is_named(tmp_path):
    rows = (f"{t:.2f};{3 * t:.3f};{-t:.4f}".replace(".", ",", 2) for t in np.arange(50) / 50.0)
    (reason,) = survey_table(text_file(tmp_path, "t [s];v;r", *rows)).skipped
    assert reason.startswith("column 'r' holds numbers with the other decimal mark, such as '-0.0")


def test_a_line_of_names_without_that_of_the_index_is_named_with_the_remedy(tmp_path):
    file = text_file(tmp_path, "time,v,r", *(f"{k},{0.02 * k:.2f},{k % 7},0.1" for k in range(50)))
    with pytest.raises(DataError, match=r"begin it with a name of the first column, .* 'row,'"):
        survey_table(file)


def test_units_that_vehest_does_not_know_are_no_names(tmp_path):
    file = text_file(
        tmp_path, "Tempo;Gier;Quer;T", "uu/a;vv/a;ww/a;s", *["1;2;3;0.5", "2;3;4;0.6"] * 9
    )
    assert [column.name for column in survey_table(file).columns] == [
        "Tempo",
        "Gier",
        "Quer",
        "T",
    ]


@pytest.mark.parametrize("name", ["lap.feather", "lap.arrow"])
def test_tables_of_arrow_and_archives_of_tables_are_refused_with_the_way_out(tmp_path, name):
    table = pa.table({"t": [0.0, 0.1]})
    new_file = pa.ipc.new_file if name == "lap.feather" else pa.ipc.new_stream
    with new_file(str(tmp_path / name), table.schema) as writer:
        writer.write_table(table)
    remedy = {"lap.feather": "pandas: read_feather", "lap.arrow": "pyarrow: ipc.open_stream"}
    with pytest.raises(DataError, match=remedy[name]):
        survey(tmp_path / name)
    with ZipFile(tmp_path / "lap.zip", "w") as archive:
        archive.write(tmp_path / name)
    with pytest.raises(DataError, match=r"holds no bags .*; unpack logs of other kinds"):
        survey(tmp_path / "lap.zip")


def test_nested_columns_of_parquet_are_named_with_the_way_out(tmp_path):
    table = {"t": [0.0, 0.1], "imu": [{"ax": 1.0}] * 2, "gyro": [[1.0, 2.0]] * 2}
    pq.write_table(pa.table(table), tmp_path / "lap.parquet")
    skipped = survey_table(tmp_path / "lap.parquet").skipped
    assert [reason.split("; ")[1][:33] for reason in skipped[:2]] == [
        "make a column of each of its fiel",
        "make a column of each of its elem",
    ]


def test_columns_that_are_aligned_by_blanks_are_named_with_the_way_out(tmp_path, table):
    file = tmp_path / "lap.txt"
    file.write_text(table.round(4).to_string(index=False), encoding="utf-8")
    with pytest.raises(
        DataError, match=r"aligned by blanks; .* sed -E 's/\^ \+//; s/ \+/;/g' lap.txt"
    ):
        survey_table(file)


def test_decimals_of_parquet_are_numbers(tmp_path, table):
    stored = pa.Table.from_pandas(table, preserve_index=False)
    at = stored.column_names.index("Gyro")
    gyro = pa.array(np.round(table["Gyro"].to_numpy(), 4)).cast(pa.decimal128(12, 4))
    file = tmp_path / "lap.parquet"
    pq.write_table(stored.set_column(at, "Gyro", gyro), file)
    assert_yaw_rate_is(read_back(file)[1], table)


def test_a_folder_of_tables_is_refused_with_the_names_of_its_files(tmp_path):
    for number in range(2):
        (tmp_path / f"part-{number}.parquet").touch()
    (tmp_path / "_SUCCESS").touch()
    with pytest.raises(MissingError, match=r"such as .*\*\.parquet"):
        inspected(tmp_path)


def test_minutes_and_seconds_are_times():
    texts = pa.chunked_array([["59:59.98", "60:00.00", "60:00,02"]])
    np.testing.assert_allclose(seconds_of_text(texts), [3599.98, 3600.0, 3600.02], atol=1e-9)
    assert seconds_of_text(pa.chunked_array([["59:59", "60:00"]])) is None


@pytest.mark.parametrize(
    ("units", "factors"),
    [
        (("m/s", "mdeg/s", "m/s²"), (1.0, np.radians(1e-3), 1.0)),
        (("knots", "deg/min", "mg"), (1852.0 / 3600.0, np.radians(1.0 / 60.0), G * 1e-3)),
        (("cm/s", "mrad/s", "milli-g"), (0.01, 1e-3, G * 1e-3)),
        (("ft/s", "0.01 °/s", "cm/s²"), (0.3048, np.radians(0.01), 0.01)),
        (("kn", "gradi/s", "ft/s^2"), (1852.0 / 3600.0, np.radians(1.0), 0.3048)),
        (("0.005 m/s", "0.0625 deg/s", "5e-4*g"), (0.005, np.radians(0.0625), 5e-4 * G)),
        (("1/100 km/h", "1/100°/s", "1/1000 g"), (0.01 / 3.6, np.radians(0.01), 1e-3 * G)),
    ],
)
def test_units_of_loggers_that_write_whole_numbers(tmp_path, units, factors, d):
    channels = {"vx": ("Speed", d["vx"]), "yaw_rate": ("Yaw Rate", d["r"])}
    channels["ay"] = ("Lat Acc", d["ay"])
    table = {"time [s]": d["t"]}
    for (label, samples), unit, factor in zip(channels.values(), units, factors, strict=True):
        table[f"{label} [{unit}]"] = samples / factor
    _, recording = read_back(write(tmp_path / "lap.csv", pd.DataFrame(table)))
    for channel, (_, samples) in channels.items():
        np.testing.assert_allclose(recording[channel], samples, atol=1e-3)


def test_a_yaw_rate_in_thousandths_of_a_degree_is_found_without_a_unit(tmp_path, d):
    table = pd.DataFrame(
        {"t": d["t"], "speed": d["vx"], "yaw_rate": np.degrees(d["r"]) * 1e3, "ay": d["ay"]}
    )
    channels = examine(tmp_path, table).proposals.by_channel
    assert channels["yaw_rate"].unit == "mdeg/s"
    assert channels["vx"].unit == "m/s"


@pytest.mark.parametrize(
    ("name", "factor", "step", "unit", "is_asked"),
    [
        ("timestamp_100us", 1e4, 0.04, "0.1*ms", False),
        ("time (10ms)", 100.0, 0.04, "cs", False),
        ("time [s]", 1.0, 0.5, "s", False),  # a slow logger
        ("t", 1.0, 0.5, "s", True),  # not in ms
        ("time [ticks]", 100.0, 0.02, "ms", True),
    ],
)
def test_the_unit_of_time_is_as_the_header_states_or_asked_where_it_states_none(
    tmp_path, name, factor, step, unit, is_asked
):
    table = usual(drive(60.0)).iloc[:: round(50 * step)]
    table = table.rename(columns={"Time [s]": name}).assign(**{name: factor * table["Time [s]"]})
    clock = survey_table(write(tmp_path / "lap.csv", table)).clock
    assert (clock.unit, clock.asked) == (unit, is_asked)


@pytest.mark.parametrize(
    ("name", "ticks_per_second", "start", "unit"),
    [
        ("SampleTimeFine", 1e4, 1234567, "0.1*ms"),
        ("Ticks", 1e7, 133_591_643_700_000_000, "0.1*us"),  # since 1601
        ("time", 1e7, 0, "0.1*us"),
    ],
)
def test_a_unit_of_time_that_the_motion_contradicts_is_asked_with_the_one_that_fits(
    tmp_path, name, ticks_per_second, start, unit, table
):
    ticks = start + np.rint(ticks_per_second * table["Time [s]"]).astype(np.int64)
    table = table.drop(columns="Time [s]").assign(**{name: ticks})
    log_draft, recording = read_back(exact(tmp_path, table))
    assert log_draft.examined.log.clock.asked
    assert log_draft.dataset["time"] == {"column": name, "unit": unit}
    assert recording.rate_hz == pytest.approx(50.0, rel=1e-6)


@pytest.mark.parametrize(
    "line",
    [
        "// Update Rate: 100.0Hz",
        '"Sample Rate","100.000","Hz",,"End Time","199.980","s"',
        "Abtastrate;100 Hz",
        "# dt=0.01",
        "Sample interval [ms]: 10",
        "Sampling rate 0.1 kHz",
        "# Sampling frequency [kHz]: 0.1",
        "# fs = 100 Hz",
        "Fréquence d'échantillonnage : 100 Hz",
    ],
)
def test_the_rate_that_a_line_above_the_names_states_decides_the_unit_of_time(tmp_path, line, d):
    table = pd.DataFrame(
        {"Ticks": 1e4 * d["t"] * 0.5, "Gyr_Z": d["r"], "Acc_Y": d["ay"], "Acc_X": d["ax"]}
    )
    examined = inspected(text_file(tmp_path, line, *lines_of(table)))
    assert (examined.log.clock.unit, examined.log.clock.asked) == ("0.1*ms", True)
    without_times = lines_of(table.drop(columns="Ticks"))
    assert inspected(text_file(tmp_path, line, *without_times)).rate_hz == 100.0


@pytest.mark.parametrize(
    "line",
    [
        "Update Rate: 0 Hz",
        "dt: 5 section",
        "Sample rate: 1,000 Hz",
        "Log rate: 1e9 Hz",
        "Sampling rate 9 kHz",
        "fs: 16 g",
        "Gyro FS = 250",
    ],
)
def test_a_line_that_states_no_rate_of_a_logger_changes_nothing(tmp_path, line):
    file = text_file(tmp_path, line, *lines_of(usual(drive())))
    assert survey_table(file).rate_hz is None


@pytest.mark.parametrize(
    ("name", "resolution", "mean_hz"),
    [("Time", 0.024, 50.0), ("Time [ms]", 24.0, 50.0), ("", 0.02, 50.0)],
)
def test_times_that_are_no_clock_give_the_rate_with_a_note(
    tmp_path, name, resolution, mean_hz, table
):
    scale = 1e3 if "ms" in name else 1.0
    times = np.round(scale * table["Time [s]"] / resolution) * resolution
    table = table.rename(columns={"Time [s]": name}).assign(**{name: times})
    examined = examine(tmp_path, table)
    assert (examined.log.clock, examined.rate_hz) == (None, mean_hz)
    (question,) = (question for question in questions_of(examined) if question.key == "rate")
    assert question.evidence == ("by the times of a column that is not read, on average",)
    expected = "as the time: it repeats 1000 times" if name else "and grows as times do; name it"
    assert any(expected in reason for reason in examined.log.skipped)


@pytest.mark.parametrize(
    "times",
    [
        np.arange(600.0),  # numbers of rows
        np.zeros(600),
        np.repeat(np.arange(20.0), 30),  # whole seconds
        np.where(np.arange(600) < 300, 0.0, 90.0) + np.round(np.arange(600) / 60.0) * 0.024,
        np.full(600, np.nan),
        np.repeat(np.arange(300.0), 2) * 1e300,
    ],
)
def test_a_column_that_is_no_clock_gives_no_rate_unless_it_grows_with_the_rows(tmp_path, times):
    table = usual(drive(12.0)).drop(columns="Time [s]")
    table.insert(0, "", times)
    assert survey_table(write(tmp_path / "lap.csv", table)).rate_hz is None
    table = table.rename(columns={"": "time"})
    if (np.diff(times) == 0.0).mean() > 0.2:
        assert survey_table(write(tmp_path / "lap.csv", table)).rate_hz is None


def test_times_that_are_no_numbers_for_a_program_are_refused(tmp_path, table):
    table = table.rename(columns={"Time [s]": "Time [ms]"})
    table["Time [ms]"] = [f"{1e3 * seconds:,.1f}" for seconds in table["Time [ms]"]]
    with pytest.raises(DataError, match=r"column 'Time \[ms\]' holds numbers with a separator of"):
        survey_table(write(tmp_path / "lap.csv", table))


def test_recordings_of_a_full_minute_are_no_counter_that_wraps(tmp_path, table):
    table["Time [s]"] %= 60.0
    log = survey_table(write(tmp_path / "lap.csv", table))
    assert [run.stop - run.start for run in log.runs] == [3000, 3000]


def test_units_may_stand_above_the_names_and_descriptions_below(tmp_path):
    lines = lines_of(usual(drive()))
    units = "s,km/h,deg/s,g,g,deg,deg"
    words = "elapsed time,speed over ground,rotation about z,lateral,longitudinal,angle,slip angle"
    for head in ([units, lines[0]], [units, lines[0], words]):
        log = survey_table(text_file(tmp_path, *head, *lines[1:]))
        assert log.by_name["Gyro"].unit == "deg/s"
        assert log.by_name["LatAcc"].unit == "g"
    letters = ["t,v,r,a,ax,d,b", words]  # of which v, a are known units
    assert "r" in survey_table(text_file(tmp_path, letters[0], *lines[1:])).by_name


@pytest.mark.parametrize(
    ("whole", "part", "scale"),
    [("Time", "Millisecond", 1000), ("sec", "usec", 10**6), ("stamp.sec", "stamp.nanosec", 10**9)],
)
def test_parts_of_seconds_beside_whole_ones_are_the_clock(tmp_path, whole, part, scale, table):
    ticks = np.round(table.pop("Time [s]") * scale).astype(int)
    seconds = ticks // scale
    if whole == "Time":
        seconds = [f"10:{59 - (120 - s) // 60:02}:{s % 60:02}" for s in seconds]
    table = table.assign(**{whole: seconds, part: ticks % scale})
    file = write(tmp_path / "lap.csv", table)
    log_draft, recording = read_back(file)
    assert log_draft.dataset["time"]["column"] == part
    assert recording.rate_hz == 50.0
    assert_yaw_rate_is(recording, table)


def test_an_error_without_a_sure_channel_names_the_quantities_that_no_column_looks_like(tmp_path):
    d = drive(100.0)
    fixes = pd.DataFrame({"time": 10**18 + 10**9 * np.arange(100), "speed": d["vx"][::50]})
    odometry = pd.DataFrame({"t": d["t"], "twist.linear.x": d["vx"], "twist.angular.z": d["r"]})
    for table, lacking in (
        (fixes, r"a yaw rate \(yaw_rate\) or a lateral acceleration \(ay\)$"),
        (odometry, r"a lateral acceleration \(ay\)$"),
    ):
        examined = examine(tmp_path, table)
        with pytest.raises(ConfigurationError, match=f"; no column looks like {lacking}"):
            ask(examined, [], interactive=False)


def test_an_error_without_a_sure_channel_names_what_was_not_read(tmp_path):
    d = drive(60.0)
    table = pd.DataFrame({"t": d["t"], "v": [f"{v:.3f} m/s" for v in d["vx"]], "r": d["r"]})
    examined = examine(tmp_path, table.assign(ay=d["ay"]))
    with pytest.raises(ConfigurationError, match="column 'v' holds numbers with a unit"):
        ask(examined, [], interactive=False)


@pytest.mark.parametrize(
    "text",
    [
        *("SNA", "VS_SNA", "Signal Not Available", "Not Available or Not Installed"),
        *("SignalNotDefined", "SignalError", "Out of range", "not received", "1.#INF"),
        *("Fehlerwert", "Signal_nicht_verfuegbar", "Wert ungültig", "kein Wert"),
    ],
)
def test_names_of_values_that_mark_a_missing_sample(text):
    assert marks_not_measured(text)


@pytest.mark.parametrize(
    "text", ["no error", "no", "N", "kein Fehler", "in range", "init ok", "none active", "low", "0"]
)
def test_names_of_values_that_are_measured(text):
    assert not marks_not_measured(text)


def test_codes_of_j1939_are_not_measured():
    kilometres_an_hour = np.linspace(20.0, 90.0, 100)
    code = 0xFFFF / 256.0
    assert codes_of_not_measured(np.r_[kilometres_an_hour, code, code]) == [code]
    assert codes_of_not_measured(np.r_[kilometres_an_hour, 200.25, 200.25]) == []


@pytest.mark.parametrize(
    ("code", "largest"),
    [
        (0xFFFF / 8192.0 - 3.92, 0.6),  # rad/s
        (np.degrees(0xFEFF / 8192.0 - 3.92), 30.0),
        (0xFFFF / 2048.0 - 15.687, 9.0),  # m/s²
        (round((0xFE00 / 2048.0 - 15.687) / 9.80665, 4), 0.9),  # g, at a table's digits
        (0xFF / 10.0 - 12.5, 7.0),  # m/s²
        (0xFFFF / 1024.0 - 31.374, 8.0),  # rad
    ],
)
def test_codes_of_j1939_signals_with_an_offset_are_not_measured(code, largest):
    measured = np.linspace(-largest, largest, 100)
    assert codes_of_not_measured(np.r_[measured, code, code]) == [code]
    assert codes_of_not_measured(np.r_[measured, code]) == []  # a spike
    assert codes_of_not_measured(np.r_[measured, 1.01 * code, 1.01 * code]) == []
    assert codes_of_not_measured(np.r_[np.linspace(-code, 0.98 * code, 100), code, code]) == []


def test_a_measurement_of_raw_frames_is_refused_with_the_way_to_decode_them(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    stamps = np.arange(100) / 50.0
    identifiers = asammdf.Signal(np.full(100, 0x123), stamps, name="CAN_DataFrame.ID")
    file = write_mdf(tmp_path / "bus.mf4", {"CAN": [identifiers]})
    with pytest.raises(DataError, match=r"raw frames of a CAN bus.*extract_bus_logging"):
        survey(file)


def signed_elsewhere(table):
    """The table with the yaw rate as a column of magnitudes and one of signs, 1 where negative."""
    yaw_rate = table["Gyro"]
    signed = {"ESP_Gierrate": yaw_rate.abs(), "ESP_VZ_Gierrate": (yaw_rate < 0).astype(int)}
    return table.drop(columns="Gyro").assign(**signed)


@pytest.mark.parametrize("kind", ["table", "mdf"])
def test_a_column_of_the_sign_beside_a_magnitude_gives_the_signed_value(tmp_path, kind, table):
    yaw_rate = table["Gyro"].to_numpy()
    signed = signed_elsewhere(table)
    file = tmp_path / "lap.csv"
    if kind == "table":
        write(file, signed)
    else:
        asammdf = pytest.importorskip("asammdf")
        stamps = signed.iloc[:, 0].to_numpy()
        units = {"ESP_Gierrate": "deg/s"}
        signals = [
            asammdf.Signal(signed[name].to_numpy(), stamps, units.get(name, ""), name)
            for name in signed.columns[1:]
        ]
        file = write_mdf(tmp_path / "lap.mf4", {"ESP": signals})
    log_draft, recording = read_back(file)
    entry = log_draft.dataset["channels"]["yaw_rate"]
    assert (entry["column"], entry["sign_column"]) == ("ESP_Gierrate", "ESP_VZ_Gierrate")
    assert "'ESP_Gierrate' is negative where 'ESP_VZ_Gierrate' is 1" in log_draft.notes
    np.testing.assert_allclose(recording["yaw_rate"], np.radians(yaw_rate), atol=1e-5)


def test_a_declared_sign_of_another_value_is_named_with_its_file_and_remedy(tmp_path, table):
    signed = signed_elsewhere(table)
    log_draft, _ = read_back(write(tmp_path / "lap.csv", signed))
    signed["ESP_VZ_Gierrate"] *= -1
    file = write(tmp_path / "lap.csv", signed)
    message = rf"'{file}': column 'ESP_VZ_Gierrate'.*holds -1; .*signed value to one column"
    with pytest.raises(DataError, match=message):
        open_source(log_draft.dataset).read("lap")


def test_a_sign_of_other_values_than_0_and_1_is_left_out_with_its_magnitude(tmp_path, table):
    steering = 16.0 * np.degrees(drive()["r"])
    signed = table.assign(
        LWI_Lenkradwinkel=np.abs(steering), LWI_VZ_Lenkradwinkel=np.sign(steering)
    )
    proposals = examine(tmp_path, signed).proposals
    columns = {channel.column for channel in proposals.channels}
    assert not {"LWI_Lenkradwinkel", "LWI_VZ_Lenkradwinkel"} & columns
    (note,) = [note for note in proposals.notes if "'LWI_VZ_Lenkradwinkel' holds its sign" in note]
    assert note.startswith("'LWI_Lenkradwinkel' is left out: it is never negative")
