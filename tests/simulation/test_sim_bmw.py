"""The data set sim_bmw stands in for the recordings of Bertipaglia et al. 2024: mix, length,
splits, and the car.
"""

from collections import Counter
from functools import cache, partial
from pathlib import Path

import numpy as np
import yaml

from vehest.data.recording import Recording
from vehest.data.split_files import split_from_config
from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import vehicle_from_configuration
from vehest.sources.simulated import SimulatedSource

CONFIGURATIONS = Path(__file__).parents[2] / "conf"

# Section IV-A: "23 manoeuvres: two braking in the turn, two skidpad, five J-turn, four slalom, four
# lane change, two random steers, three spiral and one lap track".
TEST_MANOEUVRES = {
    "braking_in_turn": 2,
    "skidpad": 2,
    "j_turn": 5,
    "slalom": 4,
    "double_lane_change": 4,
}
TEST_MANOEUVRES |= {"random_steer": 2, "spiral": 3, "laps": 1}


def configuration(group, name):
    values = yaml.safe_load((CONFIGURATIONS / group / f"{name}.yaml").read_text(encoding="utf-8"))
    values.pop("defaults", None)
    return values


@cache
def source(dataset="sim_bmw"):
    return SimulatedSource(
        {**configuration("dataset", dataset), "vehicle": configuration("vehicle", "bmw_545i")}
    )


@cache
def plant():
    return MultiBodyPlant(vehicle_from_configuration(configuration("vehicle", "bmw_545i")))


def role_of(drive_id):
    return drive_id.split("_")[0]


def mix(role, dataset="sim_bmw"):
    return Counter(
        drive.manoeuvre["name"]
        for name, drive in source(dataset).drives.items()
        if role_of(name) == role
    )


def test_mix_of_manoeuvres_and_car_parameters_are_those_of_the_paper():
    roles = Counter(role_of(name) for name in source().drives)
    assert sum(roles.values()) == 216
    assert set(roles) == {"train", "validation", "test"}
    for role, share in {"train": 0.75, "validation": 0.15, "test": 0.10}.items():
        assert abs(roles[role] - 216 * share) <= 2, (
            role
        )  # 23 test manoeuvres are 10.6 % in the paper itself
    assert mix("test") == TEST_MANOEUVRES
    for role in ("train", "validation"):
        drives = mix(role)
        for name, count in TEST_MANOEUVRES.items():
            assert abs(drives[name] - count / 23 * drives.total()) < 1.0, (role, name)
    p = plant().parameters
    assert (p.m, p.I_z, p.a, p.b) == (1970.0, 3498.0, 1.47, 1.41)


def test_drives_of_all_roles_share_ranges_and_stability_control_and_no_seed():
    for name in TEST_MANOEUVRES:
        switched = [
            drive.stability_control
            for drive in source().drives.values()
            if drive.manoeuvre["name"] == name
        ]
        assert 0.3 < np.mean(switched) < 0.6, name
    assert {drive.surface or source().options.surface for drive in source().drives.values()} == {
        "dry"
    }

    def ranges(role):
        drives = [
            drive.manoeuvre for name, drive in source().drives.items() if role_of(name) == role
        ]
        return {
            str({key: value for key, value in drive.items() if key != "laps"}) for drive in drives
        }

    assert ranges("train") == ranges("validation") == ranges("test")
    assert len({source().seed_of(name) for name in source().drives}) == 216


def test_new_tests_and_splits_share_ranges_and_no_seed_and_test_on_none_that_chose():
    assert mix("unseen", "sim_bmw_unseen") == {
        name: 2 * count for name, count in TEST_MANOEUVRES.items()
    }
    new = source("sim_bmw_unseen").drives
    old = source().drives
    seeds = {source("sim_bmw_unseen").seed_of(name) for name in new}
    assert not seeds & {source().seed_of(name) for name in old}
    assert len(seeds) == len(new) == 94
    seeds_of = {
        str({key: value for key, value in drive.manoeuvre.items() if key != "laps"})
        for drive in old.values()
    }
    tested = {
        str({key: value for key, value in drive.manoeuvre.items() if key != "laps"})
        for name, drive in new.items()
        if "unseen" in name
    }
    assert tested == seeds_of
    full = split("sim_bmw_unseen")
    limited = split("sim_bmw_unseen_limited")
    assert full.train == split("sim_bmw").train
    assert limited.train == split("sim_bmw_limited").train
    assert set(split("sim_bmw").validation) < set(full.validation)
    roles = Counter(role_of(span.recording) for span in full.validation)
    assert roles == {"validation": 32, "select": 48}
    assert Counter(role_of(span.recording) for span in full.tests["test"]) == {"unseen": 46}
    assert limited.tests == full.tests


def five_seconds(name, channels):
    """A recording beyond 7 m/s² from 2.5 s on, and slower than 5 m/s from 4.5 s on."""
    sample = np.arange(500)
    columns = {"ay": np.where(sample < 250, -6.0, -8.0), "vx": np.where(sample < 450, 15.0, 4.0)}
    columns["sideslip_ref"] = np.where(sample < 400, 0.1, -0.5)
    return Recording(name, "bmw_545i", 100.0, 0.0, columns).select(channels)


@cache
def split(name):
    return split_from_config(
        configuration("split", name),
        lambda dataset: {
            recording_id: partial(five_seconds, recording_id)
            for recording_id in source(dataset).ids()
        },
    )


def test_splits_select_drives_by_name_and_the_limited_split_trains_below_7():
    for name in ("sim_bmw", "sim_bmw_limited"):
        parts = {
            "train": split(name).train,
            "validation": split(name).validation,
            "test": split(name).tests["test"],
        }
        for role, spans in parts.items():
            assert {span.recording for span in spans} == {
                drive for drive in source().ids() if role_of(drive) == role
            }
            assert {span.dataset for span in spans} == {"sim_bmw"}
    full = split("sim_bmw")
    limited = split("sim_bmw_limited")
    assert {span.stop for span in full.train + full.validation} == {4.0}  # a spin after that
    assert {span.stop for span in full.tests["test"]} == {4.5}  # below 5 m/s after that
    assert {span.stop for span in limited.train + limited.validation} == {
        2.5
    }  # beyond 7 m/s² after that
    assert limited.tests == full.tests
    assert len(limited.train) == 161


def test_sim_bmw_cars_has_125_manoeuvres_of_each_group_on_three_cars():
    drives = configuration("dataset", "sim_bmw_cars")["drives"]
    groups = Counter()
    cars = Counter()
    for drive in drives:
        groups[drive["manoeuvre"]["name"]] += drive["count"]
        cars[drive["id"].partition("_")[0]] += drive["count"]
    assert groups == dict.fromkeys(TEST_MANOEUVRES, 125)
    assert cars == {"standard": 336, "laden": 336, "soft": 328}
    assert {drive["vehicle"] for drive in drives if drive["id"].startswith("soft")} == {"soft"}
    assert all("payload" in drive for drive in drives if drive["id"].startswith("laden"))
    assert len({drive["id"] for drive in drives}) == len(drives)


def test_skids_are_trained_on_and_tests_are_of_sim_bmw_cars_alone():
    for name in ("sim_bmw_cars", "sim_bmw_cars_limited"):
        split_settings = configuration("split", name)
        learnt = [
            entry["keep"]["magnitude"]
            for entry in (*split_settings["train"], *split_settings["validation"])
        ]
        assert not any("sideslip_ref" in bounds for bounds in learnt)
        assert {entry["dataset"] for entry in split_settings["train"]} == {"sim_bmw"}
        assert {entry["dataset"] for entry in split_settings["tests"]["test"]} == {"sim_bmw_cars"}
