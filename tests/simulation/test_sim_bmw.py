"""The data set sim_bmw stands in for the recordings of Bertipaglia et al. 2024: mix, length, splits, and the car."""

from collections import Counter
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import yaml

from vehest.data.recording import Recording
from vehest.data.split_files import split_from_config
from vehest.simulation.plant.handling import ramp_steer
from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import vehicle_from_configuration
from vehest.sources.simulated import SimulatedSource
from vehest_papers.proving_ground.handling import understeer_angle

CONFIGURATIONS = Path(__file__).parents[2] / "conf"

# Section IV-A: "23 manoeuvres: two braking in the turn, two skidpad, five J-turn, four slalom, four lane change, two random steers, three
# spiral and one lap track".
TEST_MANOEUVRES = {
    "braking_in_turn": 2,
    "skidpad": 2,
    "j_turn": 5,
    "slalom": 4,
    "double_lane_change": 4,
    "random_steer": 2,
    "spiral": 3,
    "laps": 1,
}


def configuration(group, name):
    values = yaml.safe_load((CONFIGURATIONS / group / f"{name}.yaml").read_text(encoding="utf-8"))
    values.pop("defaults", None)
    return values


@cache
def source(dataset="sim_bmw"):
    return SimulatedSource({**configuration("dataset", dataset), "vehicle": configuration("vehicle", "bmw_545i")})


@cache
def plant():
    return MultiBodyPlant(vehicle_from_configuration(configuration("vehicle", "bmw_545i")))


def role_of(drive_id):
    return drive_id.split("_")[0]


def mix(role, dataset="sim_bmw"):
    return Counter(drive.manoeuvre["name"] for name, drive in source(dataset).drives.items() if role_of(name) == role)


def test_manoeuvres_and_their_mix_are_the_papers():
    roles = Counter(role_of(name) for name in source().drives)
    assert sum(roles.values()) == 216
    assert set(roles) == {"train", "validation", "test"}
    for role, share in {"train": 0.75, "validation": 0.15, "test": 0.10}.items():
        assert abs(roles[role] - 216 * share) <= 2, role  # 23 test manoeuvres are 10.6 % in the paper itself
    assert mix("test") == TEST_MANOEUVRES
    for role in ("train", "validation"):
        drives = mix(role)
        for name, count in TEST_MANOEUVRES.items():
            assert abs(drives[name] - count / 23 * drives.total()) < 1.0, (role, name)


def test_drives_of_all_roles_share_ranges_and_stability_control_and_no_seed():
    for name in TEST_MANOEUVRES:
        switched = [drive.stability_control for drive in source().drives.values() if drive.manoeuvre["name"] == name]
        assert 0.3 < np.mean(switched) < 0.6, name
    assert {drive.surface or source().options.surface for drive in source().drives.values()} == {"dry"}

    def ranges(role):
        drives = [drive.manoeuvre for name, drive in source().drives.items() if role_of(name) == role]
        return {str({key: value for key, value in drive.items() if key != "laps"}) for drive in drives}

    assert ranges("train") == ranges("validation") == ranges("test")
    assert len({source().seed_of(name) for name in source().drives}) == 216


def test_the_new_test_is_twice_the_papers_from_the_ranges_of_training_and_shares_no_seed():
    assert mix("unseen", "sim_bmw_unseen") == {name: 2 * count for name, count in TEST_MANOEUVRES.items()}
    new, old = source("sim_bmw_unseen").drives, source().drives
    seeds = {source("sim_bmw_unseen").seed_of(name) for name in new}
    assert not seeds & {source().seed_of(name) for name in old}
    assert len(seeds) == len(new) == 94
    known = {str({key: value for key, value in drive.manoeuvre.items() if key != "laps"}) for drive in old.values()}
    tested = {
        str({key: value for key, value in drive.manoeuvre.items() if key != "laps"}) for name, drive in new.items() if "unseen" in name
    }
    assert tested == known


def five_seconds(name, channels):
    """A recording beyond 7 m/s² from 2.5 s on, and slower than 5 m/s from 4.5 s on."""
    sample = np.arange(500)
    made = {"ay": np.where(sample < 250, -6.0, -8.0), "vx": np.where(sample < 450, 15.0, 4.0)}
    made["sideslip_ref"] = np.where(sample < 400, 0.1, -0.5)
    return Recording(name, "bmw_545i", 100.0, 0.0, made).select(channels)


def catalogue(dataset):
    return {name: partial(five_seconds, name) for name in source(dataset).ids()}


@cache
def split(name):
    return split_from_config(configuration("split", name), catalogue)


def test_splits_take_the_drives_by_their_names_and_the_limited_one_learns_below_7():
    for name in ("sim_bmw", "sim_bmw_limited"):
        parts = {"train": split(name).train, "validation": split(name).validation, "test": split(name).tests["test"]}
        for role, spans in parts.items():
            assert {span.recording for span in spans} == {drive for drive in source().ids() if role_of(drive) == role}
            assert {span.dataset for span in spans} == {"sim_bmw"}
    full, limited = split("sim_bmw"), split("sim_bmw_limited")
    assert {span.stop for span in full.train + full.validation} == {4.0}  # a spin after that
    assert {span.stop for span in full.tests["test"]} == {4.5}  # below 5 m/s after that
    assert {span.stop for span in limited.train + limited.validation} == {2.5}  # beyond 7 m/s² after that
    assert limited.tests == full.tests
    assert limited.kept["train"].seconds == pytest.approx(161 * 2.5)


def test_the_new_splits_learn_on_the_same_drives_and_test_on_none_that_chose():
    full, limited = split("sim_bmw_unseen"), split("sim_bmw_unseen_limited")
    assert full.train == split("sim_bmw").train
    assert limited.train == split("sim_bmw_limited").train
    assert set(split("sim_bmw").validation) < set(full.validation)
    roles = Counter(role_of(span.recording) for span in full.validation)
    assert roles == {"validation": 32, "select": 48}
    assert Counter(role_of(span.recording) for span in full.tests["test"]) == {"unseen": 46}
    assert limited.tests == full.tests


def test_the_cars_mass_inertia_and_axle_distances_are_the_papers():
    p = plant().parameters
    assert (p.m, p.I_z, p.a, p.b) == (1970.0, 3498.0, 1.47, 1.41)


@pytest.mark.parametrize("speed", [15.0, 25.0, 40.0])
def test_the_car_is_a_mildly_understeering_road_car_with_a_limit_of_nearly_one_g(speed):
    ramp = ramp_steer(plant(), speed)
    limit, linear = int(np.argmax(ramp.ay)), (ramp.ay > 1.0) & (ramp.ay < 3.0)
    assert 9.3 < ramp.ay[limit] < 9.8
    understeer = np.polyfit(ramp.ay[linear], np.degrees(understeer_angle(ramp, plant().wheelbase))[linear], 1)[0]
    assert 0.8 < understeer * 9.81 < 1.5
    rear = np.degrees((plant().parameters.b * ramp.yaw_rate - ramp.vy) / ramp.vx)
    front = np.degrees(ramp.steer - (plant().parameters.a * ramp.yaw_rate + ramp.vy) / ramp.vx)
    assert 4.0 < rear[limit] < 6.0
    assert front[limit] > rear[limit] + 2.0
    # Without its geometric part, the sideslip's gradient is that of the rear axle's slip: one over its stiffness per load.
    gradient = -np.polyfit(ramp.ay[linear], np.degrees(ramp.sideslip[linear]), 1)[0] + np.degrees(plant().parameters.b / speed**2)
    assert gradient * 9.81 == pytest.approx(np.degrees(1.0 / 18.0), rel=0.08)  # camber takes 5 %
