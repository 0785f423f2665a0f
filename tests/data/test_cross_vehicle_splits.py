"""The splits of Da Lio et al. 2023, on the official files and on simulated cars."""

import pytest

from vehest.data.split_files import split_from_config
from vehest.run.config import compose_config

SETS = {  # Table I
    "C-1": ("20130222_01_01_03", "20130222_01_02_03", "20130222_02_01_03"),
    "C-2": ("20130223_01_01_03", "20130223_01_02_03"),
    "F-1": ("20140221_03_02_03", "20140221_03_03_03", "20140221_04_01_03"),
    "F-2": ("20140222_01_01_03", "20140222_02_01_03"),
}
SCHEMES = {"cross_vehicle_1": ("C-1", "F-1"), "cross_vehicle_2": ("F-1", "C-1")}  # Table II: learn, stop


def split(name):
    return split_from_config(compose_config("train", [f"split={name}"])["split"])


def sets_of(spans):
    """Which of Table I's sets the recordings are, in alphabetical order of their names."""
    names = sorted(span.recording for span in spans)
    simulated = [f"{name[0].upper()}-{name[1]}" for name in names if name[2] == "_"]
    return simulated or [key for name in names for key, files in SETS.items() if name.rsplit("_", 1)[0] in files]


@pytest.mark.parametrize("place", ["", "_sim"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_schemes_learn_on_one_car_stop_on_the_other_and_test_on_both(scheme, place):
    found = split(scheme + place)
    learnt, stopped = SCHEMES[scheme]
    assert sets_of(found.train) == [learnt] * 3
    assert sets_of(found.validation) == [stopped] * 3
    third = {"j1": ["J-1"] * 2} if place else {}
    assert {name: sets_of(spans) for name, spans in found.tests.items()} == {"c2": ["C-2"] * 2, "f2": ["F-2"] * 2, **third}


@pytest.mark.parametrize("name", ["one_vehicle", "one_vehicle_sim"])
def test_without_cross_vehicle_regularisation_two_files_teach_and_the_third_stops(name):
    found = split(name)
    assert (sets_of(found.train), sets_of(found.validation)) == (["F-1"] * 2, ["F-1"])
    third = {"j1": ["J-1"] * 2} if name.endswith("_sim") else {}
    assert {name: sets_of(spans) for name, spans in found.tests.items()} == {"c2": ["C-2"] * 2, "f2": ["F-2"] * 2, **third}


@pytest.mark.parametrize("dataset", ["sim_two_cars", "sim_race_cars", "sim_race_cars_same_sensors"])
def test_simulated_sets_last_as_long_as_the_papers(dataset):
    drives = compose_config("ingest", [f"dataset={dataset}"])["dataset"]["drives"]
    minutes = {entry["id"]: entry["count"] * entry["manoeuvre"]["duration"] / 60.0 for entry in drives if entry["id"] != "j1"}
    assert minutes == pytest.approx({"c1": 19.0, "c2": 12.6, "f1": 25.7, "f2": 18.1}, abs=0.05)
