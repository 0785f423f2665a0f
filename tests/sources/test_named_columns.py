"""A recording of a DataFrame: columns that a user names, units, times, and one clear error for each
mistake.
"""

import numpy as np
import pandas as pd
import pytest
from refusals import refusal

from vehest.data.errors import ConfigurationError, DataError
from vehest.sources.named_columns import read_frame

TABLE = {"source": "tabular", "name": "mine", "time": {"column": "time", "unit": "s"}}
COLUMNS = {"time": "Clock:ms", "vx": "Speed:km/h", "yaw_rate": "Gyro [deg/s]", "ay": "-AccY:g"}


@pytest.fixture
def log():
    return pd.DataFrame(
        {
            "Clock": [0.0, 10.0, 20.0, 30.0],
            "Speed": [36.0, 72.0, 72.0, 72.0],
            "Gyro [deg/s]": [0.0, 180.0, 90.0, 0.0],
            "AccY": [1.0, 0.0, -1.0, 0.5],
            "Note": list("abcd"),
        }
    )


def test_named_columns_become_channels_in_si_units_and_signs(log):
    recording = read_frame(log, TABLE, COLUMNS)
    assert (recording.rate_hz, recording.start_time) == (100.0, 0.0)
    np.testing.assert_allclose(recording["vx"], [10.0, 20.0, 20.0, 20.0], rtol=1e-15)
    np.testing.assert_allclose(recording["yaw_rate"], [0.0, np.pi, np.pi / 2, 0.0], rtol=1e-15)
    np.testing.assert_allclose(recording["ay"], [-9.80665, 0.0, 9.80665, -4.903325], rtol=1e-15)


@pytest.mark.parametrize(
    "index",
    [
        pd.Index([5.0, 5.01, 5.02, 5.03], name="timestamps"),
        pd.to_timedelta([5.0, 5.01, 5.02, 5.03], unit="s"),
        pd.Timestamp("1970-01-01T00:00:05") + pd.to_timedelta([0, 10, 20, 30], unit="ms"),
    ],
)
def test_times_may_be_the_index(log, index):
    columns = {name: text for name, text in COLUMNS.items() if name != "time"}
    recording = read_frame(log.drop(columns="Clock").set_index(index), TABLE, columns)
    assert recording.start_time == pytest.approx(5.0, abs=1e-9)
    assert recording.rate_hz == pytest.approx(100.0)


def test_a_recording_comes_back_from_its_own_dataframe(log):
    recording = read_frame(log, TABLE, COLUMNS)
    again = read_frame(recording.to_pandas(), TABLE, {})
    assert again.channels.keys() == recording.channels.keys()
    for name, samples in recording.channels.items():
        assert np.array_equal(again[name], samples)


def test_units_of_the_attributes_count_and_those_after_the_column_precede_them(log):
    log.attrs["units"] = {"Speed": "mph", "AccY": "g"}
    columns = {**COLUMNS, "vx": "Speed", "ay": "-AccY:m/s²"}
    recording = read_frame(log, TABLE, columns)
    assert recording["vx"][0] == pytest.approx(36.0 * 0.44704)
    assert recording["ay"][0] == -1.0


@pytest.mark.parametrize(
    ("changed", "error", "says"),
    [
        (
            {"vx": "Speed"},
            ConfigurationError,
            "the unit of column 'Speed' is not known; write 'Speed:m/s'",
        ),
        ({"vx": "Sped:km/h"}, ConfigurationError, "no such column; did you mean 'Speed'?"),
        ({"vy": "Speed:m/s"}, ConfigurationError, "there is no channel 'vy'"),
        ({"vx": "Speed:deg"}, ConfigurationError, "unit 'deg' cannot be converted to 'm/s'"),
        ({"vx": "Note:m/s"}, DataError, "column 'Note' contains text; numbers are needed"),
        ({"time": None}, DataError, "no columns 'time' (it has Clock, Speed"),
    ],
)
def test_each_mistake_is_one_clear_error(log, changed, error, says):
    columns = {name: text for name, text in {**COLUMNS, **changed}.items() if text is not None}
    message = refusal(lambda: read_frame(log, TABLE, columns), error)
    assert says in message
    assert "\n" not in message


def test_a_column_that_is_there_twice_is_refused(log):
    twice = pd.concat([log, log[["Speed"]]], axis=1)
    assert "2 columns 'Speed'" in refusal(lambda: read_frame(twice, TABLE, COLUMNS), DataError)


def test_a_table_without_channels_names_the_remedy(log):
    message = refusal(lambda: read_frame(log, TABLE, {}), DataError)
    assert "no column is named like a channel" in message
    assert "columns={'vx': 'Speed:km/h'" in message


def test_runs_of_a_data_set_are_refused(log):
    dataset = {**TABLE, "runs": "Clock"}
    assert "is one run" in refusal(lambda: read_frame(log, dataset, COLUMNS), ConfigurationError)
