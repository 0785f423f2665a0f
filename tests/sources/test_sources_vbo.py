"""Logs of a VBOX: what is read, in which units and on which clock.

What is left out, found and refused.
"""

import re

import numpy as np
import pytest
from refusals import refusal
from vbo_log import COLUMNS, UNITS, dataset, drive, write_log

from vehest.data.errors import DataError
from vehest.run.own_car.inspect import inspect
from vehest.sources.base import open_source
from vehest.sources.clock_times import past_midnight
from vehest.sources.surveys import survey
from vehest.sources.vbo import read_log, require_slip_offsets


def read(folder, **more):
    return next(open_source(dataset(folder, **more)).recordings())


def write_rows(folder, change):
    """Write a log whose rows are others."""
    write_log(folder / "lap.vbo")
    head, mark, rows = (folder / "lap.vbo").read_bytes().partition(b"[data]\r\n")
    lines = change(rows.splitlines(keepends=True))
    (folder / "lap.vbo").write_bytes(b"".join([head, mark, *lines]))


def test_channels_are_in_si_units_and_iso_axes_on_the_clock_of_the_day(tmp_path):
    write_log(tmp_path / "lap.vbo")
    recording = read(tmp_path)
    true = drive()
    assert (recording.id, recording.rate_hz, len(recording)) == ("lap", 100.0, 1000)
    assert recording.start_time == pytest.approx(38_870.45)
    for name, column in (
        ("vx", "vx"),
        ("yaw_rate", "yaw_rate"),
        ("ax", "ax"),
        ("ay", "ay"),
        ("vy_ref", "vy"),
    ):
        assert np.allclose(
            recording[name], true[column], rtol=0, atol=1e-4 if name == "vx" else 1e-7
        ), name
    about = recording.provenance
    assert about["slip_offsets_lateral_longitudinal_m"] == {
        "FL": [0.031, 1.79],
        "RL": [0.031, -1.06],
    }
    assert (about["created"], about["rows_dropped_at_the_end"]) == (
        "File created on 12/09/2018 @ 12:47",
        0,
    )


@pytest.mark.parametrize(("unit", "read_as"), [("kmh", "km/h"), ("mph", "mph"), ("knots", "knots")])
def test_the_header_states_the_unit_of_the_speed(tmp_path, unit, read_as):
    write_log(tmp_path / "lap.vbo", speed=unit)
    channels = dataset(tmp_path)["channels"] | {"vx": {"column": "velocity", "unit": read_as}}
    assert np.allclose(read(tmp_path, channels=channels)["vx"], drive()["vx"], rtol=0, atol=1e-3)
    assert inspect("my_car", [tmp_path / "lap.vbo"]).proposals.by_channel["vx"].unit == read_as
    if unit != "kmh":
        assert f"'velocity', for channel 'vx', is in '{unit}' by the file" in refusal(
            lambda: read(tmp_path)
        )
    write_log(tmp_path / "lap.vbo", speed=unit, swapped=True)
    with pytest.raises(DataError, match="changed places"):
        require_slip_offsets(read_log(tmp_path / "lap.vbo"), "lap")


@pytest.mark.parametrize(
    ("first", "end", "dropped"),
    [(86_395.0, "", 0), (38_870.45, "053 104", 1), (38_870.45, "053 104900.000" + " +0.0" * 16, 1)],
)
def test_time_goes_on_past_midnight_and_a_last_row_that_is_cut_off_or_late_is_left_out_and_counted(
    tmp_path, first, end, dropped
):
    write_log(tmp_path / "lap.VBO", first, end=end)
    recording = read(tmp_path)
    assert (recording.start_time, recording.rate_hz, len(recording)) == (
        pytest.approx(first),
        100.0,
        1000,
    )
    assert recording.provenance["rows_dropped_at_the_end"] == dropped


def test_a_row_that_repeats_the_time_before_is_left_out_and_counted(tmp_path):
    write_log(tmp_path / "lap.vbo")
    expected = read(tmp_path)
    write_rows(tmp_path, lambda lines: [*lines[:400], *lines[399:]])
    recording = read(tmp_path)
    assert recording.provenance["rows_dropped_with_repeated_times"] == 1
    assert np.array_equal(recording["ay"], expected["ay"])


@pytest.mark.parametrize(
    "change",
    [
        lambda head, rows: head + rows.replace(b".", b","),
        lambda head, rows: head.replace(b"[comments]", b"[comments]\r\nsee [data] of run 3") + rows,
    ],
    ids=["decimal commas", "a comment that names the section"],
)
def test_decimal_commas_and_any_comment_are_read(tmp_path, change):
    write_log(tmp_path / "lap.vbo")
    expected = read(tmp_path)
    content = (tmp_path / "lap.vbo").read_bytes()
    begin = content.index(b"[data]")
    (tmp_path / "lap.vbo").write_bytes(change(content[:begin], content[begin:]))
    assert read(tmp_path).channels.keys() == expected.channels.keys()
    for name, samples in read(tmp_path).channels.items():
        assert np.array_equal(samples, expected[name])


def test_a_pause_ends_a_recording_where_max_gap_says_so_and_a_run_can_be_named(tmp_path):
    write_rows(tmp_path, lambda lines: [*lines[:400], *lines[650:]])
    assert "1 gap, the longest of 2.51 s" in refusal(lambda: read(tmp_path))
    first, second = open_source(dataset(tmp_path, max_gap=1.0)).recordings()
    assert (first.id, second.id, second.provenance["run"], second.start_time) == (
        "lap_run_0",
        "lap_run_1",
        1,
        pytest.approx(38_876.95),
    )
    np.testing.assert_allclose(
        np.concatenate([first["yaw_rate"], second["yaw_rate"]]),
        np.delete(drive()["yaw_rate"], np.s_[400:650]),
    )
    alone = open_source(dataset(tmp_path, max_gap=1.0, run=1)).read_file(tmp_path / "lap.vbo")
    assert (len(alone), alone.start_time) == (350, second.start_time)
    assert "name one by +dataset.run=0" in refusal(
        lambda: open_source(dataset(tmp_path, max_gap=1.0)).read_file(tmp_path / "lap.vbo")
    )
    assert "no run between its pauses" in refusal(lambda: read(tmp_path, max_gap=100.0))
    assert survey(tmp_path / "lap.vbo").runs == (slice(0, 400), slice(400, 750))


def test_missing_samples_end_a_recording_where_max_gap_says_so(tmp_path):

    def without_samples(lines):
        for k in [*range(200, 203), *range(400, 500)]:
            cells = lines[k].split(b" ")
            lines[k] = b" ".join([*cells[:2], *[b"nan"] * (len(cells) - 3), b"\r\n"])
        return lines

    write_rows(tmp_path, without_samples)
    first, second = open_source(dataset(tmp_path, max_gap=0.5)).recordings()
    assert (len(first), len(second)) == (400, 500)
    at = np.delete(np.arange(1000), np.s_[400:500])
    speed = np.concatenate([first["vx"], second["vx"]])
    np.testing.assert_allclose(speed, drive()["vx"][at], atol=1e-4)


def test_zeros_of_rows_without_satellites_are_missing_samples_and_no_standstill(tmp_path):
    def without_fix(lines):
        for k in [*range(200, 203), *range(400, 500)]:
            cells = lines[k].split(b" ")
            cells[0], cells[4] = b"064", b"000.0000"  # a trigger, and no satellite
            lines[k] = b" ".join(cells)
        return lines

    write_rows(tmp_path, without_fix)
    first, second = open_source(dataset(tmp_path, max_gap=0.5)).recordings()
    assert (len(first), len(second)) == (400, 500)
    speed = np.concatenate([first["vx"], second["vx"]])
    at = np.delete(np.arange(1000), np.s_[400:500])
    np.testing.assert_allclose(speed, drive()["vx"][at], atol=1e-4)
    assert "max_gap" in refusal(lambda: read(tmp_path))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("sats", [b"000", b"nan", b"-01", b"1e30"])
def test_satellites_that_are_never_counted_say_nothing(tmp_path, sats):
    write_rows(tmp_path, lambda lines: [line.replace(b"053", sats, 1) for line in lines])
    np.testing.assert_allclose(read(tmp_path)["vx"], drive()["vx"], atol=1e-4)


def test_units_belong_to_the_last_columns_and_must_not_contradict_the_declaration(tmp_path):
    write_log(tmp_path / "lap.vbo")
    units = {"velocity": "km/h", "vert-vel": "km/h", "Longacc": "g", "Latacc": "g"}
    assert read_log(tmp_path / "lap.vbo").units == units | dict(
        zip(COLUMNS.split()[-7:], UNITS, strict=True)
    )
    write_log(tmp_path / "lap.vbo", units=("rad", "km/h", "rad/s", "g", "g", "°", "°"))
    message = "column 'YawRate', for channel 'yaw_rate', is in 'rad/s' by the file and in 'deg/s'"
    assert message in refusal(lambda: read(tmp_path))


def test_slip_whose_offsets_changed_places_is_found_and_right_slip_is_not(tmp_path):
    write_log(tmp_path / "lap.vbo", swapped=True)
    channels = dataset(tmp_path)["channels"] | {
        "sideslip_ref": {"column": "Slip_FL", "unit": "deg"}
    }
    with pytest.raises(
        DataError, match=r"slip at the front and the rear left wheel differs by .* changed places"
    ) as refused:
        read(tmp_path, channels=channels)
    assert "accept: [slip_offsets]" in str(refused.value)
    assert "sideslip_ref" in read(tmp_path, channels=channels, accept=["slip_offsets"])
    assert "vy_ref" in read(tmp_path)  # Lat._Vel. holds at the antenna
    log = survey(tmp_path / "lap.vbo")
    assert not any(column.name.startswith("Slip_F") for column in log.columns)
    assert "changed places" in log.skipped[0]


def test_columns_of_a_bus_are_the_car_s_own(tmp_path):
    write_log(tmp_path / "lap.vbo")
    assert {column.device for column in survey(tmp_path / "lap.vbo").columns} == {""}
    content = (tmp_path / "lap.vbo").read_bytes()
    modules = ["026524 - CAN02 - 1 3", *["030003 - Internal Slip Module - 1 1"] * 6]
    section = "\r\n".join(["[module Information]", *modules, "", "", "[column names]"]).encode()
    (tmp_path / "lap.vbo").write_bytes(content.replace(b"[column names]", section))
    devices = {column.name: column.device for column in survey(tmp_path / "lap.vbo").columns}
    last_column = COLUMNS.split()[-7]
    assert devices == {name: "car" if name == last_column else "reference" for name in devices}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"[data]", b"[rows]", r"has no section \[data\]"),
        (b"[column names]", b"[columns]", r"has no section \[column names\]"),
        (b" Y_Accel ", b" X_Accel ", "has 2 columns called 'X_Accel'"),
        (b"053 104751.450", b"053 109951.450", "is no clock time hhmmss"),
        (b"053 104751.450 ", b"053 ", r"Row #101: Expected 18 columns, got 17"),
    ],
)
def test_a_damaged_log_is_one_clear_line(tmp_path, old, new, message):
    write_log(tmp_path / "lap.vbo")
    content = (tmp_path / "lap.vbo").read_bytes()
    assert old in content
    (tmp_path / "lap.vbo").write_bytes(content.replace(old, new, 1))
    message_part = refusal(lambda: read(tmp_path))
    assert "lap.vbo" in message_part
    assert re.search(message, message_part)


def test_a_stray_time_of_day_is_no_midnight():
    late = np.array([86_399.98, 86_399.99, 0.0, 0.01])
    np.testing.assert_allclose(past_midnight(late), [86_399.98, 86_399.99, 86_400.0, 86_400.01])
    stray = np.array([38_870.0, 86_399.99, 38_870.02, 38_870.03])
    np.testing.assert_array_equal(past_midnight(stray), stray)
