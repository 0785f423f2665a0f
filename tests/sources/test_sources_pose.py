"""Tables with poses, held channels, rows that do not count and time that restarts, written with a
motion in closed form.
"""

import numpy as np
import pandas as pd
import pytest
from refusals import refusal

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.sources.base import origin_in_words
from vehest.sources.tabular import TabularSource

RATE = 100.0
SPEED = 2.0  # m/s
RADIUS = 1.5  # m
SLIP = 0.2  # rad, by which the car points out of the circle's tangent
POSE = {
    "x": {"column": "px", "unit": "m"},
    "y": {"column": "py", "unit": "m"},
    "yaw": {"column": "yaw", "unit": "rad"},
    "window": 5,
}
TIME = {"column": "t", "unit": "s"}


def circle(seconds=10.0, lever=(0.0, 0.0), turned=0.0):
    """A car on a circle to the left.

    Poses are those of a body ``lever`` ahead and to the left of it, turned by ``turned``.
    """
    time = np.arange(round(seconds * RATE)) / RATE
    course = SPEED / RADIUS * time
    yaw = course + np.pi / 2 - SLIP
    x = RADIUS * np.cos(course) + np.cos(yaw) * lever[0] - np.sin(yaw) * lever[1]
    y = RADIUS * np.sin(course) + np.sin(yaw) * lever[0] + np.cos(yaw) * lever[1]
    wrapped = np.angle(np.exp(1j * (yaw + turned)))
    return pd.DataFrame({"t": time, "px": x, "py": y, "yaw": wrapped, "vx": SPEED * np.cos(SLIP)})


def source(folder, **options):
    channels = {"vx": {"column": "vx", "unit": "m/s"}}
    declared = {
        "name": "mine",
        "source": "tabular",
        "path": str(folder),
        "files": "*.csv",
        "time": TIME,
        "channels": channels,
    }
    return TabularSource({**declared, **options})


def read(table, folder, **options):
    table.to_csv(folder / "lap.csv", index=False)
    return source(folder, **options).read("lap")


def test_a_pose_on_a_circle_gives_the_velocities_of_its_closed_form(tmp_path):
    recording = read(circle(), tmp_path, pose=POSE)
    inner = slice(5, -5)
    assert recording["vx_ref"][inner] == pytest.approx(SPEED * np.cos(SLIP), abs=1e-3)
    assert recording["vy_ref"][inner] == pytest.approx(SPEED * np.sin(SLIP), abs=1e-3)
    assert recording["sideslip_ref"][inner] == pytest.approx(SLIP, abs=1e-3)
    assert recording["yaw_rate_ref"] == pytest.approx(SPEED / RADIUS, abs=1e-9)


def test_lever_and_turn_of_the_body_are_taken_off(tmp_path):
    table = circle(lever=(0.115, -0.01), turned=0.05)
    pose = POSE | {
        "yaw_offset": -0.05,
        "lever_x": -0.115,
        "lever_y": 0.01,
        "channels": ["vx_ref", "vy_ref"],
    }
    recording = read(table, tmp_path, pose=pose)
    assert recording["vy_ref"][5:-5] == pytest.approx(SPEED * np.sin(SLIP), abs=1e-3)
    assert recording["vx_ref"][5:-5] == pytest.approx(SPEED * np.cos(SLIP), abs=1e-3)
    assert set(recording.channels) == {"vx", "vx_ref", "vy_ref"}
    away = read(table, tmp_path, pose=POSE | {"yaw_offset": -0.05})
    assert (away["vy_ref"] - recording["vy_ref"])[5:-5] == pytest.approx(
        0.115 * SPEED / RADIUS, abs=1e-3
    )


def test_late_stamps_of_even_rows_do_no_harm(tmp_path):
    table = circle()
    table["t"] = 1.7e9 + table["t"] + np.random.default_rng(0).exponential(1e-3, len(table))
    even = read(table, tmp_path, pose=POSE, clock="uniform")
    stamped = read(table, tmp_path, pose=POSE, clock="interpolate")
    errors = [
        np.abs(recording["vy_ref"][5:-5] - SPEED * np.sin(SLIP)).max()
        for recording in (even, stamped)
    ]
    assert errors[0] < 1e-3
    assert errors[1] > 20 * errors[0]
    assert even.rate_hz == RATE
    for lost in (3, 20):
        with pytest.raises(
            DataError,
            match=r"samples are missing.*; leave rows out by drop_rows or set "
            r"dataset.clock=interpolate",
        ):
            read(table.drop(index=range(500, 500 + lost)), tmp_path, clock="uniform")


HELD_CHANNELS = {
    "vx": {"column": "vx", "unit": "m/s"},
    "yaw_rate": {"column": "r", "unit": "rad/s"},
}


@pytest.mark.parametrize("updated", ["sensor", None])
def test_held_samples_are_taken_once_and_where_they_were_measured(tmp_path, updated):
    """A yaw rate that its sensor samples in every tenth row and that arrives four later, with the
    sensor's own clock beside it.
    """
    time = np.arange(1000) / RATE
    source_samples = (np.arange(1000) - 4) // 10 * 10
    truth = np.sin(2 * np.pi * 0.5 * time)
    values = np.where(source_samples >= 0, truth[np.maximum(source_samples, 0)], 0.0)
    stamps = np.where(source_samples >= 0, 300.0 + source_samples / RATE, 0.0)
    table = pd.DataFrame({"t": time, "vx": 3.0 + time, "r": values, "sensor": stamps})
    hold_options = {"channels": ["yaw_rate"], "updated": updated, "delay": 0.04}
    recording = read(table, tmp_path, channels=HELD_CHANNELS, held=hold_options)
    at = np.rint(recording.time * RATE).astype(int)
    np.testing.assert_allclose(
        recording["yaw_rate"][at % 10 == 0], truth[at][at % 10 == 0], atol=1e-9
    )
    bound = (np.pi**2 * 0.1**2) / 8  # of a straight line over 0.1 s, by the largest curvature
    assert np.abs(recording["yaw_rate"] - truth[at]).max() < 1.001 * bound
    np.testing.assert_allclose(recording["vx"], 3.0 + recording.time, atol=1e-9)
    assert recording.time[0] == pytest.approx(0.0 if updated else 0.1, abs=0.011)
    assert recording.provenance["held"] == {
        "channels": ["yaw_rate"],
        "rate_hz": pytest.approx(10.0),
        "delay": {"yaw_rate": 0.04},
    }
    plain = read(table, tmp_path, channels=HELD_CHANNELS)
    steps = plain["yaw_rate"][at] - truth[at]
    assert np.abs(steps).max() > 10 * bound


def test_time_that_restarts_begins_a_run_and_declared_rows_do_not_count(tmp_path):
    table = pd.concat([circle(2.0), circle(3.0), circle(1.0)], ignore_index=True)
    table.loc[[200, 500], "vx"] = 5596.0
    table.to_csv(tmp_path / "laps.csv", index=False)
    restarted_source = source(tmp_path, time_restarts=True, drop_rows={"laps": [201, "501-"]})
    recordings = list(restarted_source.recordings())
    assert [recording.id for recording in recordings] == ["laps_run_0", "laps_run_1"]
    assert [len(recording) for recording in recordings] == [200, 299]
    assert recordings[1].start_time == pytest.approx(0.01)
    assert max(recording["vx"].max() for recording in recordings) < SPEED
    assert recordings[1].provenance["dropped_rows"] == [201, "501-"]


def test_a_pause_begins_a_run_and_one_of_several_can_be_chosen(tmp_path):
    table = pd.concat([circle(2.0), circle(0.5), circle(3.0)], ignore_index=True)
    table["t"] += np.repeat([0.0, 10.0, 20.0], [200, 50, 300])
    table.to_csv(tmp_path / "laps.csv", index=False)
    recordings = list(source(tmp_path, max_gap=1.0).recordings())
    assert [(recording.id, len(recording), recording.start_time) for recording in recordings] == [
        ("laps_run_0", 200, 0.0),
        ("laps_run_1", 300, 20.0),
    ]
    assert source(tmp_path, max_gap=1.0, run=1).read_file(tmp_path / "laps.csv").start_time == 20.0
    message = "holds no run 2 (0, 1)"
    assert message in refusal(
        lambda: source(tmp_path, max_gap=1.0, run=2).read_file(tmp_path / "laps.csv")
    )


def test_excluded_files_are_no_recordings(tmp_path):
    for name in ("lap_1", "lap_2", "still"):
        circle(1.0).to_csv(tmp_path / f"{name}.csv", index=False)
    assert source(tmp_path, exclude=["still"]).ids() == ["lap_1", "lap_2"]
    assert list(source(tmp_path, exclude=["lap_*"]).inputs()) == ["still.csv"]
    with_held_channels = {"channels": HELD_CHANNELS}
    with_held_speed = {"channels": ["vx"], "delay": {"yaw_rate": 0.1}}
    for options, kind, message in (
        ({"exclude": ["lap"]}, MissingError, "exclude names 'lap', which no file is called"),
        ({"exclude": ["*"]}, MissingError, "exclude leaves none"),
        (
            {"drop_rows": {"lap2": [1]}},
            MissingError,
            "drop_rows names 'lap2', which no file is called",
        ),
        ({"pose": POSE | {"window": 4}}, ConfigurationError, "window must be an odd number"),
        (
            with_held_channels | {"held": {"channels": ["ay"]}},
            ConfigurationError,
            "names 'ay', which is not one of the data set's channels",
        ),
        (
            with_held_channels | {"held": with_held_speed},
            ConfigurationError,
            "delay names 'yaw_rate'",
        ),
    ):
        assert message in refusal(lambda options=options: source(tmp_path, **options).ids(), kind)
    assert "has 1000 data rows, and drop_rows names row 1001" in refusal(
        lambda: read(circle(), tmp_path, drop_rows={"lap": [1001]})
    )


def test_where_channels_were_measured_is_said_in_words(tmp_path):
    centre = {"x": 0.0, "y": 0.0}
    for options, message in (
        ({"reference_point": "unknown"}, "reference measured at a point that is not known"),
        (
            {"reference_point": centre, "imu_point": {"x": -0.2, "y": 0.0}},
            "reference measured at the centre of gravity; inertial unit 0.2 m behind the centre "
            "of gravity",
        ),
        (
            {"reference_point": {"x": 0.4, "y": -0.1}},
            "reference measured 0.4 m ahead of and 0.1 m to the right of the centre of gravity, "
            "moved to it",
        ),
    ):
        assert "; ".join(origin_in_words(read(circle(), tmp_path, pose=POSE, **options))) == message
