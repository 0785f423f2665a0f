"""Opening a source by name, simulated drives, and the data sets that are shipped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from vehest.data.checks import checks_of_recording
from vehest.data.errors import ConfigurationError, MissingError
from vehest.sources.base import open_source, source_module, source_names
from vehest.sources.simulated import SimulatedSource

CONF = Path(__file__).parents[1] / "conf"
DATASETS = sorted((CONF / "dataset").glob("*.yaml"))
VEHICLE = yaml.safe_load((CONF / "vehicle" / "bmw_320i_low.yaml").read_text(encoding="utf-8"))


def simulated(**changes: object) -> dict[str, Any]:
    drives = [{"id": "a", "seed": 1, "duration": 3}, {"id": "b", "seed": 2, "duration": 2.5}]
    return {"name": "sim", "source": "simulated", "vehicle": VEHICLE, "rate_hz": 50, "drives": drives, **changes}


@pytest.mark.parametrize("file", DATASETS, ids=lambda file: file.stem)
def test_every_data_set_that_is_shipped_opens(file: Path, tmp_path: Path) -> None:
    config = yaml.safe_load(file.read_text(encoding="utf-8").replace("${root}", str(tmp_path)))
    if config.pop("defaults", None):
        config["vehicle"] = VEHICLE
    assert config["name"] == file.stem
    assert open_source(config).name == file.stem


def test_every_source_has_a_module_that_opens() -> None:
    assert set(source_names()) >= {"revs", "tabular", "simulated"}
    for name in source_names():
        with pytest.raises(ConfigurationError, match="has no option 'spam'"):
            open_source({"name": "x", "source": name, "spam": 1})


@pytest.mark.parametrize("name", ["revz", None, ""])
def test_an_unknown_source_is_refused_with_those_there_are(name: str | None) -> None:
    with pytest.raises(ConfigurationError, match="is not one of: mdf, revs, rosbag, simulated, tabular"):
        source_module({"name": "x", "source": name})


def test_a_simulated_drive_is_a_recording_of_the_asked_length_and_rate() -> None:
    source = open_source(simulated())
    assert source.ids() == ["a", "b"]
    recording = source.read("b")
    assert (recording.id, recording.kind, recording.rate_hz, len(recording)) == ("b", "simulated", 50.0, 125)
    assert {"vx", "yaw_rate", "ax", "ay", "vy_ref"} <= set(recording.channels)
    assert [finding for finding in checks_of_recording(recording) if finding.level == "error"] == []


def test_a_simulated_drive_is_the_same_every_time_and_another_with_another_seed() -> None:
    source = open_source(simulated())
    np.testing.assert_array_equal(source.read("b")["ay"], source.read("b")["ay"])
    other = open_source(simulated(drives=[{"id": "b", "seed": 3, "duration": 2.5}]))
    assert not np.array_equal(other.read("b")["ay"], source.read("b")["ay"])


def test_an_unknown_drive_is_missing_with_those_there_are() -> None:
    with pytest.raises(MissingError, match=r"no drive 'c' \(it has a, b\)"):
        open_source(simulated()).read("c")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"drives": [{"id": "a", "seed": 1}]}, "a drive has an id, a seed and a duration"),
        ({"drives": ["a"]}, "a drive has an id, a seed and a duration"),
        ({"drives": [{"id": "a", "seed": "one", "duration": 3}]}, "drive 'a' needs a whole number as seed"),
        ({"drives": [{"id": "a", "seed": 1, "duration": 0}]}, "drive 'a' needs a whole number as seed and a positive duration"),
        ({"drives": [{"id": "a", "seed": 1, "duration": 3}] * 2}, "two drives are called 'a'"),
        ({"sensors": "perfect"}, "sensors 'perfect' is not one of: default, ideal"),
        ({"sensor": "ideal"}, "has no option 'sensor'"),
    ],
)
def test_a_misspelt_simulation_is_refused_in_one_line(changes: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        SimulatedSource(simulated(**changes))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_simulation_without_a_vehicle_is_refused() -> None:
    config = simulated()
    del config["vehicle"]
    with pytest.raises(ConfigurationError, match="needs a vehicle from conf/vehicle"):
        SimulatedSource(config)
