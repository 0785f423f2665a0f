"""Estimators that learn nothing: no training range is needed, recorded, or held against a test."""

import json
import math
from pathlib import Path

import pandas as pd
import pytest

NOISE_OF_RECORDING = ("estimator=kalman", "estimator.noise.read_from=recording", "tracking=none")


@pytest.fixture
def steered(place):
    """Two drives with a steering angle, a split with a test only, and one that trains on the other
    drive.
    """
    place.add_steered()
    tests = {"test": [{"recording": "second"}]}
    place.change(
        "conf/split/whole.yaml",
        name="whole",
        dataset="steered",
        train=[],
        validation=[],
        tests=tests,
    )
    parts = {"train": [{"recording": "first"}], "validation": [{"recording": "second", "stop": 10}]}
    place.change(
        "conf/split/cut.yaml",
        name="cut",
        dataset="steered",
        **parts,
        tests={"test": [{"recording": "second", "start": 10}]},
    )
    return place


def test_model_without_training_is_the_same_for_every_split(
    steered,
):
    folders = [
        steered.told("train", *NOISE_OF_RECORDING, f"split={split}")["model"]
        for split in ("whole", "cut")
    ]
    assert (
        folders[0],
        steered("eval", "--model", folders[0], "split=whole", "tracking=none")[0],
    ) == (folders[1], 0)
    cut_model = steered.told(
        "train", *NOISE_OF_RECORDING, "split=cut", "downsample.method=decimate"
    )["model"]
    assert cut_model != folders[0], "how recordings are prepared is part of a model"
    figures = steered.told("eval", *NOISE_OF_RECORDING, "split=whole")
    assert 0 < figures["rmse_sideslip.test"] < 5
    assert figures["n_parameters.test"] == 0
    assert "step_seconds.test" not in figures, "offline: there is no online step to time"
    rows = pd.read_csv(Path(figures["folder"]) / "metrics.csv", keep_default_na=False)
    assert set(zip(rows["trained_on"], rows["mode"], rows["test_set"], strict=True)) == {
        ("", "offline", "test")
    }


def test_filters_with_levels_from_training_are_not_tested_on_that_data(steered):
    arguments = ("estimator=kalman", "tracking=none", "split=cut")
    out, err = steered.done("train", *arguments, "--json")
    assert (json.loads(out)["n_parameters"], "3 parameters" in err) == (3, True)
    assert math.isfinite(steered.told("eval", *arguments)["step_seconds.test"])
    steered.refused(
        "eval",
        "--model",
        json.loads(out)["model"],
        "split=whole",
        "tracking=none",
        says="shares samples with",
    )
    message = "split 'whole' has nothing to train on, and estimator 'ksnn' learns"
    steered.refused("train", "estimator=ksnn", "split=whole", "tracking=none", says=message)


def test_study_without_training_reports_and_says_where_estimates_start(steered):
    evaluation = {"initial_state": True, "warm_up_seconds": 0}
    study = {
        "study": "given",
        "report": "drive",
        "split": "whole",
        "sweeps": [[*NOISE_OF_RECORDING[:2]]],
    }
    steered.change("pipelines/given.yaml", **study, evaluation=evaluation)
    outcome = steered.told("run", "given", "tracking=none")
    (row,) = outcome["leaderboard"]
    assert (row["estimator"], row["start"]) == ("kalman", "reference")
    report = (Path(outcome["report"]).parent / "report.md").read_text(encoding="utf-8")
    assert "Estimates start at the reference state" in report
    assert 0 < row["rmse_sideslip"] < 5
