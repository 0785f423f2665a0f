"""Regimes of a drive against one whose every sample is known, and their errors against those of all
samples.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.evaluation.metrics import Protocol, accuracy, min_sideslip_speed, score
from vehest.evaluation.regimes import AY_BANDS, REGIMES, errors_by_regime, regimes_of, slope

RATE = 20.0
ALL = Protocol(RATE, 0.0, 0.0)


def stepped_drive():
    """Ten seconds straight ahead, ten in a circle at 3 m/s², ten at 7 m/s², with steep ramps of 1.2
    s and 1.5 s between.
    """
    time = np.arange(600) / RATE
    ay = np.interp(time, [0, 10, 11.2, 20, 21.5, 30], [0, 0, 3, 3, 7, 7])
    vy = 0.1 * np.sin(time)
    return Recording(
        "steps",
        "car",
        RATE,
        0.0,
        {"vx": np.full(600, 20.0), "yaw_rate": ay / 20.0, "ay": ay, "vy_ref": vy},
        "simulated",
    )


def estimate_with(recording, error):
    vy = recording["vy_ref"] + error
    return Estimate(
        recording.id, "test", RATE, 0.0, {"vy": vy, "sideslip": np.arctan2(vy, recording["vx"])}
    )


def test_regimes_are_detected_where_the_drive_has_them():
    masks = regimes_of(stepped_drive(), Span("d", "steps"), ALL)
    assert tuple(masks) == REGIMES
    for group in (("straight", "turning"), tuple(AY_BANDS), ("transient", "steady")):
        assert (np.sum([masks[name] for name in group], axis=0) == 1).all()
    time = stepped_drive().time
    assert masks["straight"][time < 10].all()
    assert masks["turning"][time > 10.5].all()
    assert masks["ay_2_4"][(time > 11) & (time < 20)].all()
    assert masks["ay_6_"][time > 21.5].all()
    assert masks["transient"][(time > 10.2) & (time < 10.8)].all()
    assert masks["transient"][(time > 20.2) & (time < 21.3)].all()
    assert masks["steady"][(time < 9.7) | ((time > 11.5) & (time < 19.7)) | (time > 21.8)].all()


def test_regimes_of_a_range_equal_those_of_the_full_drive():
    regimes = regimes_of(stepped_drive(), Span("d", "steps"), ALL)
    cut = regimes_of(stepped_drive(), Span("d", "steps", 5.0, 20.5), Protocol(RATE, 0.0, 1.5))
    for name, mask in cut.items():
        assert np.array_equal(mask, regimes[name][130:410]), name
    ramp = 3.0 * np.arange(200) / RATE
    assert np.allclose(slope(ramp, RATE), 3.0)
    ramp[50:60] = np.nan
    assert np.allclose(slope(ramp, RATE), 3.0)


def test_errors_of_regimes_make_up_the_error_of_all_samples():
    drive = stepped_drive()
    error = np.where(drive.time < 15, 0.1, 0.3)
    part = score(estimate_with(drive, error), drive, Span("d", "steps"), ALL)
    errors = errors_by_regime([part], [regimes_of(drive, Span("d", "steps"), ALL)], RATE)
    assert errors["straight"]["rmse_vy"] == pytest.approx(0.1)
    assert errors["ay_6_"]["rmse_vy"] == pytest.approx(0.3)
    overall = accuracy([part])
    for group in (("straight", "turning"), ("transient", "steady")):
        assert sum(errors[name]["share"] for name in group) == pytest.approx(1.0)
        for metric in ("rmse_vy", "rmse_sideslip"):
            together = sum(errors[name]["share"] * errors[name][metric] ** 2 for name in group)
            assert together == pytest.approx(overall[metric] ** 2)


def test_short_regimes_and_missing_channels_have_no_errors():
    drive = stepped_drive()
    part = score(estimate_with(drive, np.full(600, 0.1)), drive, Span("d", "steps"), ALL)
    masks = regimes_of(drive, Span("d", "steps"), ALL)
    assert 0 < masks["ay_4_6"].sum() < 2 * RATE
    assert set(errors_by_regime([part], [masks], RATE)) == set(REGIMES) - {"ay_4_6"}
    without_ay = regimes_of(drive.select(["vx", "yaw_rate", "vy_ref"]), Span("d", "steps"), ALL)
    assert set(without_ay) == {"straight", "turning", "transient", "steady"}
    without_yaw_rate = regimes_of(drive.select(["vx", "ay", "vy_ref"]), Span("d", "steps"), ALL)
    assert set(without_yaw_rate) == {*AY_BANDS, "transient", "steady"}
    assert regimes_of(drive.select(["vx", "vy_ref"]), Span("d", "steps"), ALL) == {}


def test_evaluation_writes_regimes_as_subsets_and_prints_figures_of_all_samples_only(place):
    run = ("estimator=static_map", "split=mine", "tracking=none")
    place.once("train", *run)
    printed = place.told("eval", *run)
    with open(Path(printed["folder"]) / "metrics.csv", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["test_set"] == "test"]
    by_subset = {
        subset: {row["metric"]: float(row["value"]) for row in rows if row["subset"] == subset}
        for subset in ("all", "turning")
    }
    assert printed["rmse_sideslip.test"] == by_subset["all"]["rmse_sideslip"]
    assert set(by_subset["turning"]) == {"rmse_vy", "rmse_sideslip", "share"}
    assert {"floor_reference", "floor_cramer_rao"} <= set(by_subset["all"])
    assert "share" not in by_subset["all"]


def test_min_sideslip_speed_follows_the_car_of_the_data_set(place):
    run = ("estimator=static_map", "split=mine", "tracking=none")
    place.once("train", *run)
    folders = []
    for wheelbase in (None, 0.1):
        if wheelbase is not None:
            place.change("conf/dataset/mine.yaml", car={"wheelbase": wheelbase})
        printed = place.told("eval", *run)
        folders.append(printed["folder"])
        config = json.loads((Path(printed["folder"]) / "manifest.json").read_text())["config"]
        speeds = config["protocol"]["min_sideslip_speed"]
        assert speeds == {"mine": pytest.approx(min_sideslip_speed(wheelbase))}
        assert "share_below_min_speed.test" in printed
    assert len(set(folders)) == 2
    refused = place.refused("eval", *run, "++evaluation.least_speed=0.1")[1]
    assert "evaluation.least_speed is now evaluation.min_sideslip_speed" in refused
