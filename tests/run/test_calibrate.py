"""Calibration as a stage: between training and evaluation, found by its model, and left out where
there is nothing to calibrate by.
"""

import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from conftest import planar_drive
from vehest.artefacts.artefact import read_artefact
from vehest.data.errors import DataError
from vehest.data.store import read_estimate
from vehest.inference.models import calibration_of, trust_of
from vehest.run.calibrate import STAGE
from vehest.trust.bands import LEVELS
from vehest.trust.record import About, Trust, write_trust

pytestmark = pytest.mark.apart

TRAIN = (
    "estimator=luenberger",
    "split=mine",
    "training.grid=1",
    "training.max_evaluations=5",
    "tracking=none",
)


def metrics_of(folder):
    """(test set, subset, metric) -> row."""
    table = pd.read_csv(folder / "metrics.csv")
    return (
        table[table["condition"] == "nominal"]
        .set_index(["test_set", "subset", "metric"])
        .to_dict("index")
    )


def without_validation(place):
    tests = {"test": [{"recording": "three"}]}
    place.change(
        "conf/split/blind.yaml", name="blind", dataset="mine", train=[], validation=[], tests=tests
    )


@pytest.fixture
def evaluated(place):
    """A place, a model and its evaluation."""
    out, err = place.once("train", *TRAIN, "--json")
    assert "calibrate  luenberger-luenberger-seed0-trust bands by" in err
    return (
        place,
        Path(json.loads(out)["model"]),
        Path(json.loads(place.once("eval", *TRAIN, "--json")[0])["folder"]),
    )


def test_training_alone_calibrates_and_evaluation_takes_it(evaluated):
    place, model, evaluation = evaluated
    outputs = place.folder / "outputs"
    calibration = calibration_of(model, outputs)
    assert [folder.name for folder in (outputs / STAGE).iterdir()] == [calibration.folder.name]
    assert calibration.inputs["model"] == read_artefact(model).digest
    assert read_artefact(evaluation).inputs["calibration"] == calibration.digest
    trust = trust_of(model, outputs)
    assert (trust.bands.vehicles, trust.bands.calibrated_on) == (("my car",), ("two (all)",))
    assert trust.bands.scaled_on == ("one (all)",)


def test_a_model_by_its_path_has_its_calibration_whatever_the_output_root(evaluated, tmp_path):
    place, model, _ = evaluated
    lap = place.folder / "lap.csv"
    out = tmp_path / "estimate.csv"
    drive = planar_drive(20.0, 100.0).without_references()
    drive.to_pandas().to_csv(lap)
    for name, folder in (
        ("here", place.folder / model),
        ("away", shutil.copytree(place.folder / model, tmp_path / "away")),
    ):
        output, _ = place.done(
            "estimate",
            str(folder),
            str(lap),
            "-o",
            str(out),
            f"output={tmp_path / 'other'}",
            "--json",
        )
        with open(out, encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        has_band = any(row.get("band_sideslip") for row in rows)
        assert has_band == (name == "here")
        assert ("this model has no calibration" in json.loads(output)["verdict"]) != has_band


def test_bands_are_twice_as_wide_on_a_test_elsewhere(
    evaluated,
):
    place, model, evaluation = evaluated
    estimate = read_estimate(evaluation / "test" / "0.parquet")
    assert np.array_equal(np.isfinite(estimate["band_vy"]), np.isfinite(estimate["vy"]))
    floors = trust_of(model, place.folder / "outputs").bands
    level = LEVELS.index(0.9)
    assert estimate["band_vy"].min() >= floors.vy.factors[level] * floors.vy.floor
    assert estimate["band_sideslip"].max() <= math.pi
    place, _, evaluation = evaluated
    out = place("eval", *TRAIN, "evaluation.elsewhere='other, test'", "--json")[1]
    at_home, elsewhere = (
        read_estimate(folder / "test" / "0.parquet")
        for folder in (evaluation, Path(json.loads(out)["folder"]))
    )
    np.testing.assert_allclose(elsewhere["band_vy"], 2.0 * at_home["band_vy"])


def test_metrics_say_coverage_width_and_scores_with_intervals_and_by_acceleration(evaluated):
    rows = metrics_of(evaluated[2])
    for metric in ("coverage_50", "coverage_68", "coverage_90", "coverage_95"):
        for suffix in ("", "_vy"):
            row = rows["test", "all", metric + suffix]
            assert 0.0 <= row["low"] <= row["value"] <= row["high"] <= 1.0
    shares = [rows["test", "all", f"coverage_{level}"]["value"] for level in (50, 68, 90, 95)]
    assert shares == sorted(shares)
    assert (
        rows["test", "all", "interval_score"]["value"] >= rows["test", "all", "width_90"]["value"]
    )
    assert ("test", "ay_2_4", "coverage_90") in rows
    assert ("validation", "all", "coverage_90") in rows


def test_a_run_calibrates_each_model_once_and_shows_it(place):
    _, err = place.once("run", "small", "tracking=none")
    assert [line.split()[0] for line in err.splitlines() if line.split()[1] == STAGE] == [
        "done"
    ] * 4
    [report] = (place.folder / "outputs" / "report").iterdir()
    assert (report / "tables" / "bands_test.csv").is_file()
    assert "reliability_test" in (report / "report.md").read_text()
    err = place("run", "small", "tracking=none")[2]
    [line] = err.splitlines()
    assert f" 4 {STAGE}" in line


def test_missing_calibration_is_recomputed(evaluated, tmp_path):
    place, model, evaluation = evaluated
    calibration = calibration_of(model, place.folder / "outputs")
    (calibration.folder / "trust.yaml").unlink()
    before = (model / "manifest.json").stat().st_mtime_ns
    outcome = place.told("eval", *TRAIN)
    assert outcome | {"skipped": True} == outcome, (
        "the same calibration leaves the evaluation up to date"
    )
    assert (Path(outcome["folder"]), (model / "manifest.json").stat().st_mtime_ns) == (
        evaluation,
        before,
    )
    place, model, _ = evaluated
    write_trust(Trust(About("luenberger", note="mine")), model)
    remarks = []
    assert trust_of(model, place.folder / "outputs", remarks.append).about.note == "mine"
    assert "does not say which model" in remarks[0]
    assert trust_of(tmp_path / "nothing", tmp_path) is None


def _truncate(file):
    file.write_bytes(file.read_bytes()[:-5])


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("trust.yaml", Path.unlink),
        ("trust.yaml", lambda file: file.write_text(file.read_text().replace("0", "1"))),
        ("manifest.json", Path.unlink),
        ("manifest.json", _truncate),
    ],
)
def test_a_damaged_calibration_is_an_error_and_not_a_model_without_bands(evaluated, name, damage):
    place, model, _ = evaluated
    calibration = calibration_of(model, place.folder / "outputs").folder
    damage(calibration / name)
    drive = planar_drive(20.0, 100.0).without_references()
    drive.to_pandas().to_csv("lap.csv")
    place.refused("estimate", str(model), "lap.csv", "-o", "out.csv", says=str(calibration))
    assert not Path("out.csv").exists()
    calibration.rename(calibration.with_name(f"another-{calibration.name}"))
    if name == "manifest.json":
        assert trust_of(model, place.folder / "outputs") is None, "of another model, by its name"


def test_damaged_models_are_distinct_from_uncalibrated_models(evaluated):
    place, model, _ = evaluated
    (model / "manifest.json").write_text("{")
    with pytest.raises(DataError, match=r"manifest\.json"):
        calibration_of(model, place.folder / "outputs")


def test_evaluation_of_a_named_model_on_another_split_takes_its_calibration_along(evaluated):
    place, model, _ = evaluated
    without_validation(place)
    folder = Path(
        place.told("eval", "--model", str(model), "split=blind", "tracking=none")["folder"]
    )
    assert (
        read_artefact(folder).inputs["calibration"]
        == calibration_of(model, place.folder / "outputs").digest
    )


def test_without_a_validation_range_there_are_no_bands_and_a_note_says_so(place):
    without_validation(place)
    zero = ("estimator=zero", "split=blind", "tracking=none")
    assert place("train", *zero)[0] == 0
    out, err = place.done("eval", *zero, "--json")
    assert (
        "note    calibrate  zero-zero-seed0 has no calibration, so its estimates have no bands"
        in err
    )
    folder = Path(json.loads(out)["folder"])
    assert ("test", "all", "coverage_90") not in metrics_of(folder)
    assert "band_vy" not in read_estimate(folder / "test" / "0.parquet").channels
    assert not (place.folder / "outputs" / STAGE).exists()


def test_model_without_training_uses_no_calibration_of_its_test(
    place,
):
    place.change(
        "conf/split/mine.yaml",
        validation=[{"recording": "three"}],
        tests={"test": [{"recording": "two"}]},
    )
    without_validation(place)
    model = place.told("train", "estimator=zero", "split=mine", "tracking=none")["model"]
    assert calibration_of(Path(model), place.folder / "outputs") is not None
    outcome = place.told("eval", "--model", model, "split=blind", "tracking=none")
    assert "calibration" not in read_artefact(Path(outcome["folder"])).inputs
