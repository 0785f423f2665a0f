"""A car's record: found on drives of a car whose numbers are known, written, read back and started
from.
"""

import json
import math
import re

import numpy as np
import pandas as pd
import pytest
import yaml
from refusals import refusal
from test_self_calibrating import RATE, drive

from vehest.configuration.composition import compose_config
from vehest.data.recording import Recording
from vehest.estimators.model_files import load_model
from vehest.inference.car_values import LIMITS, Number, calibrated, read_car, with_settings
from vehest.inference.models import pretrained_folder
from vehest.run.estimate import findings_of, wheelbase_findings
from vehest.run.identify import (
    YAW_RATE_LATENESS_SECONDS,
    Normal,
    posterior_of,
    prior_of,
    record_of,
    together,
    without_prior,
)
from vehest.sources.base import open_source

PLANTED = {"leakage": -0.06, "rear_axle": 1.25, "compliance": 0.0051}


def lap(seed, seconds=120.0, angle=1.0):
    samples, vy = drive(
        seconds,
        seed,
        PLANTED["compliance"],
        PLANTED["rear_axle"],
        PLANTED["leakage"],
        0.2,
        angle=angle,
    )
    return dict(zip(("yaw_rate", "vx", "ay", "ax"), samples.T, strict=True)), vy


def recording(name, channels):
    return Recording(name, "car", RATE, 0.0, channels)


@pytest.fixture(scope="module")
def model():
    return with_settings(
        load_model(pretrained_folder("self_calibrating")),
        {"wheelbase": 2.7, "cg_to_rear_axle": 1.25},
    )


def test_identified_values_of_a_car_reduce_the_error(model):
    record = record_of(
        model,
        {
            name: posterior_of(model, recording(name, lap(seed)[0]))
            for name, seed in (("one", 0), ("two", 1))
        },
    )
    for name, truth in PLANTED.items():
        number = getattr(record, name)
        assert number.identified_on == ("one", "two")
        assert abs(number.value - truth) < 2.0 * number.deviation
    for offsets in record.offsets.values():
        assert abs(offsets["ay"].value - 0.2) < offsets["ay"].deviation
    channels, vy = lap(2, 20.0)
    errors = [
        np.mean((estimator.estimate([recording("lap", channels)])[0]["vy"] - vy) ** 2)
        for estimator in (model, calibrated(model, record))
    ]
    assert errors[1] < 0.7 * errors[0]


def test_a_number_identified_on_no_drive_is_marked_and_not_started_from(model):
    standstill = recording(
        "still",
        {
            "yaw_rate": np.zeros(600),
            "vx": np.full(600, 30.0),
            "ay": np.full(600, 0.1),
            "ax": np.zeros(600),
        },
    )
    record = record_of(model, {"still": posterior_of(model, standstill)})
    assert not any(getattr(record, name).identified_on for name in LIMITS)
    assert calibrated(model, record).settings == model.settings


def test_a_drive_that_steady_cornering_explains_better_than_the_bank_tells_nothing(model):
    steady = with_settings(model, {"steady_odds": 1e12})
    calibrated_posterior, posterior = (
        record_of(model, {"one": posterior_of(estimator, recording("one", lap(0)[0]))})
        for estimator in (model, steady)
    )
    assert calibrated_posterior.leakage.identified_on
    assert [getattr(posterior, name) for name in ("leakage", "rear_axle", "compliance")] == [
        Number(*prior_of(model)[name][:2]) for name in ("leakage", "rear_axle", "compliance")
    ]
    assert posterior.offsets["one"]["ay"].identified_on
    assert calibrated(model, posterior).settings == model.settings


def test_drives_weigh_by_their_information_and_contradictions_widen_intervals():
    prior = Normal(1.0, 2.0)
    likelihoods = {"a": (3.0, 1.0), "b": (3.2, 0.5)}
    posteriors = {}
    for name, (mean, deviation) in likelihoods.items():
        variance = 1.0 / (1.0 / prior[1] ** 2 + 1.0 / deviation**2)
        posteriors[name] = Normal(
            variance * (prior.mean / prior.deviation**2 + mean / deviation**2), math.sqrt(variance)
        )
        assert without_prior(prior, posteriors[name]) == pytest.approx((mean, deviation))
    combined = together(prior, posteriors)
    precision = 1.0 / 4.0 + 1.0 + 4.0
    assert (combined.value, combined.deviation) == pytest.approx(
        ((0.25 + 3.0 + 4.0 * 3.2) / precision, precision**-0.5)
    )
    assert combined.identified_on == ("a", "b")
    contradicted = together(prior, posteriors | {"c": Normal(-1.0, 0.4)})
    assert contradicted.deviation > 2.0 * combined.deviation
    assert contradicted.identified_on == ()  # of three that do not agree none is right
    assert together(prior, {"d": prior}) == Number(prior.mean, prior.deviation)


def test_delays_widen_affected_intervals_independent_of_the_number_of_drives():
    prior = Normal(0.0, 1.0)
    sure = Normal(0.2, 1e-3, 0.5)
    for drives in ({"a": sure}, dict.fromkeys("abcd", sure)):
        combined = together(prior, drives)
        assert (combined.value, combined.deviation) == pytest.approx((0.2, 0.5), rel=1e-4)
        assert combined.identified_on == tuple(drives)
    assert together(prior, {"a": sure._replace(of_lateness=0.8)}).identified_on == ()


def test_numbers_of_a_drive_whose_yaw_rate_is_late_keep_within_their_deviations(model):
    channels, _ = lap(3)
    late = channels | {
        "yaw_rate": np.interp(
            np.arange(len(channels["vx"])) - 0.04 * RATE,
            np.arange(len(channels["vx"])),
            channels["yaw_rate"],
        )
    }
    on_time, delayed = (
        posterior_of(model, recording("lap", samples)) for samples in (channels, late)
    )
    for name in ("compliance", "rear_axle"):
        moved = delayed[name].mean - on_time[name].mean
        assert moved == pytest.approx(
            0.04 / YAW_RATE_LATENESS_SECONDS * on_time[name].of_lateness, rel=0.4
        )
        assert (
            abs(getattr(record_of(model, {"lap": delayed}), name).value - PLANTED[name])
            < 1.645 * getattr(record_of(model, {"lap": delayed}), name).deviation
        )


def test_identify_writes_a_record_from_which_estimate_starts(place):
    for name, seed in (("one", 0), ("two", 1), ("three", 2)):
        channels, _ = lap(seed, 40.0)
        pd.DataFrame({"time": np.arange(len(channels["vx"])) / RATE, **channels}).to_csv(
            f"{name}.csv", index=False
        )
    settings = ("estimator.wheelbase=2.7", "estimator.cg_to_rear_axle=1.25")
    code, out, err = place("identify", "one.csv", "two.csv", *settings, "-o", "car.yaml", "--json")
    assert code == 0, err
    result = json.loads(out)
    record = read_car(place.folder / "car.yaml")
    assert (
        result["leakage"]["value"]
        == record.leakage.value
        == pytest.approx(PLANTED["leakage"], abs=0.03)
    )
    code, out, err = place("identify", "one.csv", "-o", "again.yaml")
    assert "identified on" in out
    assert place("estimate", "three.csv", "-o", "cold.csv")[0] == 0
    code, out, err = place("estimate", "three.csv", "--car", "car.yaml", "-o", "warm.csv", "--json")
    assert code == 0, err
    assert json.loads(out)["car"] == "car.yaml"
    assert np.abs(pd.read_csv("warm.csv")["vy"] - pd.read_csv("cold.csv")["vy"]).max() > 0.01
    assert (
        "leave the model out"
        in place.refused("estimate", "pretrained", "three.csv", "--car", "car.yaml")[1]
    )
    smooth = place.told(
        "estimate", "three.csv", *settings, "estimator.smoothed=true", "-o", "smooth.csv"
    )
    assert smooth["samples"] > 0
    assert np.abs(pd.read_csv("smooth.csv")["vy"] - pd.read_csv("cold.csv")["vy"]).max() > 0.01
    assert "estimator.smooth" in place.refused("estimate", "three.csv", "estimator.smooth=true")[1]
    pd.read_csv("three.csv").drop(columns="ax").to_csv("no_ax.csv", index=False)
    assert (
        place.told("estimate", "no_ax.csv", "estimator.measured_ax=false", "-o", "no_ax.parquet")[
            "samples"
        ]
        > 0
    )
    (place.folder / "other.yaml").write_text("precious: 1\n")
    assert "other.yaml" in place.refused("identify", "one.csv", "-o", "other.yaml")[1]
    assert "must end in .yaml" in place.refused("identify", "one.csv", "-o", "car.txt")[1]
    assert "called 'one'" in place.refused("identify", "one.csv", "one.csv", "-o", "twice.yaml")[1]
    pd.DataFrame(
        {
            "time": [0.0, 0.01],
            "yaw_rate": [0.1, 0.11],
            "vx": [10.0, 10.1],
            "ay": [1.0, 1.1],
            "ax": [0.0, 0.1],
        }
    ).to_csv("short.csv", index=False)
    assert "too short" in place.refused("identify", "short.csv", "-o", "twice.yaml")[1]
    assert not (place.folder / "twice.yaml").exists()
    assert (
        prior_of(calibrated(load_model(pretrained_folder("self_calibrating")), record))["leakage"][
            0
        ]
        == record.leakage.value
    )


@pytest.mark.parametrize(
    ("scale", "wheelbase", "words"),
    [
        (1.0, 2.7, None),
        (0.1, 0.27, None),
        (0.1, 2.7, "does not turn within 1.* m"),
        (1.0, 0.1, "does not reach 25 m/s"),
    ],
)
def test_wheelbases_excluded_by_the_drive_are_reported(scale, wheelbase, words):
    """A drive up to 25 m/s with bends of 11 m, and the same at a tenth of the size: speeds go with
    its root, yaw rates against it.
    """
    time = np.arange(0.0, 60.0, 1.0 / RATE)
    speed = np.interp(time, [0.0, 30.0, 60.0], [5.0, 5.0, 25.0])
    curvature = np.where(time < 20.0, 0.09, 0.01)
    channels = {
        "yaw_rate": speed * curvature * scale**-0.5,
        "vx": speed * scale**0.5,
        "ay": speed**2 * curvature,
        "ax": 0.0 * time,
    }
    sized = with_settings(
        load_model(pretrained_folder("self_calibrating")), {"wheelbase": wheelbase}
    )
    findings = [
        finding
        for finding in findings_of(recording("lap", channels), sized, ["sign", "unit"])
        if finding.check == "wheelbase"
    ]
    assert len(findings) == (words is not None)
    assert words is None or re.search(words, findings[0].message)


@pytest.mark.parametrize(
    ("dataset", "wheelbase"),
    [
        ("dart", 0.175),
        ("roboracer", 0.33),
        ("f1tenth", 0.33),
        ("ferrari_250lm", 2.4),
        ("s90", 2.941),
        ("tum", 3.0),
        ("av21", 3.0),
    ],
)
def test_wheelbases_of_real_cars_are_accepted_and_small_cars_are_not_large_ones(
    data_root, dataset, wheelbase
):
    config = compose_config("ingest", [f"dataset={dataset}", f"root={data_root}"])["dataset"]
    moving = [
        drive for drive in open_source(config).recordings() if np.mean(drive["vx"] > 1.0) > 0.2
    ]
    assert moving
    assert not any(wheelbase_findings(drive, wheelbase) for drive in moving)
    assert wheelbase > 1.0 or all(wheelbase_findings(drive, 2.7) for drive in moving)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"leakage": {"value": 0.9, "deviation": 0.01}}, "leakage must lie between -0.3 and 0.3"),
        ({"compliance": {"value": 0.005, "deviation": 0.0}}, "compliance.deviation"),
        ({"wheelbase": 2000.0}, "wheelbase"),
        ({"grip": None}, "grip"),
        ({"mass": 1500.0}, "mass"),
        ({"format": 2}, "newer vehest"),
        ("!!python/object/apply:os.system [touch MARK]", "cannot be read as YAML"),
        ("just text", "no record of a car"),
    ],
)
def test_damaged_records_of_a_car_are_refused_in_a_single_line(elsewhere, change, words):
    number = {"value": 0.01, "deviation": 0.01}
    numbers = {
        "leakage": number,
        "rear_axle": number,
        "compliance": number,
        "grip": {"value": 9.0, "deviation": 1.0},
    }
    honest = {"format": 1, "wheelbase": 2.7, "cg_to_rear_axle": None, **numbers, "offsets": {}}
    file = elsewhere / "car.yaml"
    file.write_text(yaml.safe_dump(honest))
    assert read_car(file).wheelbase == 2.7
    file.write_text(change if isinstance(change, str) else yaml.safe_dump(honest | change))
    assert words in refusal(lambda: read_car(file))
    assert list(elsewhere.iterdir()) == [file]
