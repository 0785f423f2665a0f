"""Estimators that learn nothing: no training range is needed, recorded, or held against a test."""

import csv
import json
import math
from pathlib import Path

import pytest
import yaml

OWN_NOISE = ("estimator=kalman", "estimator.noise.read_from=recording", "tracking=none")


@pytest.fixture
def steered(place):
    """Two drives with a steering angle, a split with a test only, and one that trains on the other drive."""
    place.add_steered()
    whole = {"name": "whole", "dataset": "steered", "train": [], "validation": [], "tests": {"test": [{"recording": "second"}]}}
    cut = whole | {
        "name": "cut",
        "train": [{"recording": "first"}],
        "validation": [{"recording": "second", "stop": 10}],
        "tests": {"test": [{"recording": "second", "start": 10}]},
    }
    for split in (whole, cut):
        (Path("conf") / "split" / f"{split['name']}.yaml").write_text(yaml.safe_dump(split))
    return place


def figures_of(out):
    return {name: value for name, value in json.loads(out).items() if name.endswith(".test")}


def test_whole_recording_is_a_test_without_training(steered):
    assert steered("train", *OWN_NOISE, "split=whole")[0] == 0
    out, _ = steered.done("eval", *OWN_NOISE, "split=whole", "--json")
    figures = figures_of(out)
    assert 0 < figures["rmse_sideslip.test"] < 5
    assert figures["n_parameters.test"] == 0
    assert "step_seconds.test" not in figures, "offline: there is no online step to time"
    with open(Path(json.loads(out)["folder"]) / "metrics.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert {(row["trained_on"], row["mode"], row["test_set"]) for row in rows} == {("", "offline", "test")}


def test_model_that_learnt_nothing_is_the_same_for_every_split_and_may_be_tested_on_any(steered):
    folders = [steered.told("train", *OWN_NOISE, f"split={split}")["model"] for split in ("whole", "cut")]
    assert (folders[0], steered("eval", "--model", folders[0], "split=whole", "tracking=none")[0]) == (folders[1], 0)
    other = steered.told("train", *OWN_NOISE, "split=cut", "downsample.method=decimate")["model"]
    assert other != folders[0], "how recordings are prepared is part of a model"


def test_filter_with_levels_from_training_is_kept_from_testing_on_them(steered):
    arguments = ("estimator=kalman", "tracking=none", "--json")
    out, err = steered.done("train", *arguments, "split=cut")
    assert json.loads(out)["n_parameters"] == 3
    assert "3 parameters" in err
    figures = figures_of(steered("eval", *arguments, "split=cut")[1])
    assert math.isfinite(figures["step_seconds.test"])
    folder = json.loads(out)["model"]
    assert "shares samples with" in steered.refused("eval", "--model", folder, "split=whole", "tracking=none")[1]


def test_estimator_that_learns_is_refused_where_there_is_nothing_to_learn_from(steered):
    line = steered.refused("train", "estimator=ksnn", "split=whole", "tracking=none")[1]
    assert "split 'whole' has nothing to train on, and estimator 'ksnn' learns" in line


def test_study_without_training_reports_and_says_where_estimates_start(steered):
    evaluation = {"initial_state": True, "warm_up_seconds": 0}
    pipeline = {"study": "given", "report": "drive", "split": "whole", "evaluation": evaluation, "sweeps": [[*OWN_NOISE[:2]]]}
    (Path("pipelines") / "given.yaml").write_text(yaml.safe_dump(pipeline))
    outcome = steered.told("run", "given", "tracking=none")
    (row,) = outcome["leaderboard"]
    assert (row["estimator"], row["start"]) == ("kalman", "reference")
    report = (Path(outcome["report"]).parent / "report.md").read_text(encoding="utf-8")
    assert "Estimates start at the reference state" in report
    assert 0 < row["rmse_sideslip"] < 5
