"""How a notebook shows recordings and estimates: one line, a table, a DataFrame."""

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from conftest import planar_drive
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.inference.tables import write_estimate_table


@pytest.fixture
def recording():
    channels = {"vx": np.array([20.0, 21.0, 22.0]), "ay": np.array([-1.5, np.nan, 2.0])}
    return Recording("lap <1>", "car", 50.0, 4.0, channels, gappy=frozenset({"ay"}))


def test_repr_has_size_and_channels_on_a_single_line(recording):
    assert repr(recording) == "<Recording 'lap <1>': 0.06 s at 50 Hz; vx, ay>"
    estimate = Estimate("lap", "zero", 50.0, 4.0, dict.fromkeys(("vy", "sideslip"), np.zeros(3)))
    assert repr(estimate) == ("<Estimate of 'lap' by zero: 0.06 s at 50 Hz; vy, sideslip>")
    all_channels = planar_drive(4.0)
    assert "\n" not in repr(all_channels)
    assert len(repr(all_channels)) <= 100
    assert repr(all_channels).endswith(f"and {len(all_channels.channels) - 4} more>")


def test_table_of_a_notebook_escapes_names_and_counts_missing_samples(recording):
    html = recording._repr_html_()
    assert "lap &lt;1&gt;" in html
    assert "<tr><td>ay</td><td>m/s²</td><td>-1.5</td><td>2</td><td>1</td></tr>" in html


def test_dataframe_has_the_samples_on_their_times_and_their_units(recording):
    frame = recording.to_pandas()
    expected = pd.DataFrame(
        {"vx": [20.0, 21.0, 22.0], "ay": [-1.5, np.nan, 2.0]},
        index=pd.Index([4.0, 4.02, 4.04], name="time"),
    )
    pd.testing.assert_frame_equal(frame, expected, check_exact=True)
    assert frame.attrs["units"] == {"time": "s", "vx": "m/s", "ay": "m/s²"}
    frame.loc[4.0, "vx"] = 0.0
    assert recording["vx"][0] == 20.0


def test_dataframe_of_an_estimate_is_the_table_that_is_written(tmp_path):
    angle = np.array([0.0, np.pi / 6.0, np.nan])
    estimate = Estimate(
        "lap",
        "kalman",
        50.0,
        4.0,
        {"vy": np.ones(3), "sideslip": angle, "band_sideslip": np.full(3, np.pi / 180.0)},
        covariance=np.array([np.diag([variance, 4.0]) for variance in (1.0, 2.0, 3.0)]),
        covariance_of=("vy", "yaw_rate"),
    )
    frame = estimate.to_pandas()
    assert frame.index.tolist() == [4.0, 4.02, 4.04]
    assert np.allclose(frame["sideslip_deg"], [0.0, 30.0, np.nan], equal_nan=True)
    assert np.allclose(frame["band_sideslip_deg"], 1.0)
    assert frame["covariance_0_0"].tolist() == [1.0, 2.0, 3.0]
    assert frame.attrs["units"]["sideslip_deg"] == "deg"
    assert frame.attrs["units"]["covariance_0_1"] == "m/s·rad/s"
    write_estimate_table([estimate], tmp_path / "out.parquet")
    table = pq.read_table(tmp_path / "out.parquet")
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    assert frame.attrs["units"] == units
    assert ["time", *frame.columns] == table.column_names
    for name in frame:
        np.testing.assert_array_equal(frame[name], table[name].to_numpy())
