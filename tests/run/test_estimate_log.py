"""`vehest estimate` gives a log back with the estimate as channels of its own."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mdf_log import write_mdf
from scipy.io import loadmat

from conftest import planar_drive
from vehest.run.estimate_tables import read_estimate_table

asammdf = pytest.importorskip(
    "asammdf", reason="the measurements of these tests are written by asammdf"
)
COLUMNS = ("vx", "yaw_rate", "ay", "ax")
DESCRIBED = "dataset=mine"


@pytest.fixture
def described(place):
    """A measurement of 30 s, its times from 5 s on, and a data set that describes it."""
    drive = planar_drive(30.0, 100.0, seed=4, noise=0.02)
    stamps = 5.0 + np.arange(len(drive)) / 100.0
    groups = {
        "bus": [asammdf.Signal(drive[name], stamps, name=f"Veh_{name}") for name in COLUMNS],
        "temperature": [asammdf.Signal(stamps, stamps, name="T")],
    }
    write_mdf(Path("my drive.mf4"), groups)
    units = {"vx": "m/s", "yaw_rate": "rad/s", "ay": "m/s²", "ax": "m/s²"}
    channels = {name: {"column": f"Veh_{name}", "unit": unit} for name, unit in units.items()}
    Path("conf/dataset/mine.yaml").unlink()
    place.change(
        "conf/dataset/mine.yaml", name="mine", source="mdf", rate_hz=100, channels=channels
    )
    return place, drive


def test_measurements_contain_the_estimate_in_a_separate_group(described):
    place, drive = described
    assert place("estimate", "my drive.mf4", DESCRIBED, "-o", "beta.mf4")[0] == 0
    assert place("estimate", "my drive.mf4", DESCRIBED, "-o", "beta.csv")[0] == 0
    assert place("estimate", "my drive.mf4", DESCRIBED, "-o", "beta.parquet")[0] == 0
    table = pd.read_parquet("beta.parquet")
    with asammdf.MDF("beta.mf4") as measurement:
        assert np.array_equal(measurement.get("Veh_ay").samples, drive["ay"])
        assert np.array_equal(measurement.get("T").samples, measurement.get("T").timestamps)
        vy = measurement.get("vehest_vy")
        words = measurement.get("vehest_health_reason")
        assert np.allclose(vy.timestamps, table["time"], atol=1e-9)
        assert np.array_equal(vy.samples, table["vy"], equal_nan=True)
        assert (vy.unit, measurement.get("vehest_sideslip").unit) == ("m/s", "rad")
        assert np.array_equal(measurement.get("vehest_health", raw=True).samples, table["health"])
        assert [text.decode().removeprefix("-") for text in words.samples] == pd.read_csv(
            "beta.csv"
        )["health_reason"].fillna("").tolist()


def test_mat_files_contain_log_and_estimate_on_the_same_clock(described):
    place, drive = described
    assert place("estimate", "my drive.mf4", DESCRIBED, "-o", "beta.mat")[0] == 0
    assert place("estimate", "my drive.mf4", DESCRIBED, "-o", "beta.csv")[0] == 0
    assert place("estimate", "my drive.mf4", DESCRIBED, "-o", "beta.parquet")[0] == 0
    content = loadmat("beta.mat", squeeze_me=True)
    table = pd.read_parquet("beta.parquet")
    assert np.allclose(content["ay"], drive["ay"])
    stride = round(100.0 * (table["time"][1] - table["time"][0]))
    assert np.array_equal(content["vehest_vy"][::stride][: len(table)], table["vy"], equal_nan=True)
    assert len(content["vehest_band_sideslip"]) == len(content["time"]) == len(drive)


def test_mat_files_of_estimates_are_compared_like_tables(described):
    place, drive = described
    assert place("estimate", "my drive.mf4", DESCRIBED, "-o", "beta.mat")[0] == 0
    content = loadmat("beta.mat", squeeze_me=True)
    estimate = read_estimate_table(Path("beta.mat"), drive)
    assert np.array_equal(estimate["vy"], content["vehest_vy"], equal_nan=True)
    assert estimate.time == pytest.approx(content["time"])


def test_tables_and_older_measurements_are_not_written_as_mdf_4(described):
    place, drive = described
    drive.to_pandas().to_csv("lap.csv")
    place.refused(
        "estimate",
        "lap.csv",
        "-o",
        "beta.mf4",
        code=2,
        says="'lap.csv' with further channels, which is no .mf4",
    )
    write_mdf(
        Path("old.mf4"),
        {"bus": [asammdf.Signal(drive[name], drive.time, name=f"Veh_{name}") for name in COLUMNS]},
        "3.30",
    )
    place.refused("estimate", "old.mf4", DESCRIBED, "-o", "beta.mf4", code=3, says="is of MDF 3.30")
    assert not Path("beta.mf4").exists()
