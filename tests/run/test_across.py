"""Studies across folds and across vehicles, run from the command line on a small data set."""

import json
import math

import numpy as np
import pandas as pd
import pytest

from place import DATASET, write_drives
from vehest.data.store import read_estimate, read_recording

pytestmark = pytest.mark.apart

PLAIN = ["estimator=zero,static_map,kinematic"]
LUENBERGER = ["estimator=luenberger", "training.grid=1", "training.max_evaluations=20"]
UNUSABLE = ["estimator=kalman"]  # there is no steering angle


@pytest.fixture
def across(place):
    """A place with a split in three folds, two vehicles, and a pipeline of either kind."""
    write_drives(place.folder, 60.0)
    place.change(
        "conf/split/folded.yaml",
        name="folded",
        dataset="mine",
        folds={"number": 3, "of": "recordings"},
    )
    for name, train, test in (("forth", "one", "three"), ("back", "three", "one")):
        ranges = {
            "train": [{"recording": train}],
            "validation": [{"recording": "two"}],
            "tests": {"unseen": [{"recording": test}]},
        }
        place.change(f"conf/split/{name}.yaml", name=name, dataset="mine", **ranges)
    folds = {
        "study": "folds_of_mine",
        "report": "folds",
        "split": "folded",
        "publish": True,
        "sweeps": [PLAIN, LUENBERGER],
    }
    place.change("pipelines/folds_of_mine.yaml", **folds)
    place.change(
        "pipelines/vehicles.yaml",
        study="vehicles",
        report="transfer",
        parts=parts_of(PLAIN, LUENBERGER, UNUSABLE),
    )
    return place


def parts_of(*sweeps):
    return {
        name: {"title": name, "split": name, "sweeps": list(sweeps)} for name in ("forth", "back")
    }


def rmse_by_hand(output, models, protocol_skip=1.5):
    """RMSE(β) over the tested recordings of all folds from the stored estimates and recordings
    [deg], with NumPy alone.
    """
    errors = []
    folders = sorted((output / "evaluate").glob(f"{models}-on-folded_fold_*"))
    assert len(folders) == 3
    for folder in folders:
        estimate = read_estimate(folder / "test" / "0.parquet")
        file = (
            next((output / "downsample").glob("mine-20hz-*")) / f"{estimate.recording_id}.parquet"
        )
        recording = read_recording(file)
        late = recording.time >= recording.start_time + protocol_skip - 1e-9
        vy = estimate.held_at(recording.time[late], "vy")
        truth = np.arctan2(recording["vy_ref"][late], recording["vx"][late])
        errors.append(np.degrees(np.arctan2(vy, recording["vx"][late]) - truth))
    return float(np.sqrt(np.mean(np.square(np.concatenate(errors)))))


def test_errors_of_all_folds_count_together(across):
    rows = {
        row["title"]: row
        for row in across.told("run", "folds_of_mine", "tracking=none", "output=out")["overview"]
    }
    assert len(rows) == 4
    output = across.folder / "out"
    for title, models in (
        ("Luenberger", "luenberger-luenberger-seed0"),
        ("Static map", "static_map-static_map-seed0"),
    ):
        row = rows[title]
        assert row["rmse_sideslip"] == pytest.approx(rmse_by_hand(output, models), rel=1e-9)
        assert row["rmse_sideslip_low"] < row["rmse_sideslip"] < row["rmse_sideslip_high"]
        folds = [row[f"fold_{fold}"] for fold in (1, 2, 3)]
        assert min(folds) <= row["rmse_sideslip"] <= max(folds)
    report = (across.folder / "results" / "folds_of_mine" / "report.md").read_text(encoding="utf-8")
    assert (
        "all 3 folds (simulated data), each estimated by models that were not trained on it"
        in report
    )
    metrics = pd.read_csv(across.folder / "results" / "folds_of_mine" / "metrics.csv")
    assert {name.split("/")[1] for name in metrics["trained_on"].unique()} == {
        "fold_1",
        "fold_2",
        "fold_3",
    }


def test_vehicles_are_listed_side_by_side_including_failed_ones(across):
    code, out, err = across("run", "vehicles", "tracking=none", "output=out", "--json")
    assert code == 5, err
    assert "steer" in err
    outcome = json.loads(out)
    titles = [row["estimator"] for row in outcome["overview"]]
    assert titles[:2] == ["Zero (v = 0)", "Static map"]
    assert "Luenberger" in titles
    assert any("kalman" in name for name in outcome["failed"])
    report = next((across.folder / "out" / "report").glob("vehicles-*")) / "report.md"
    text = report.read_text(encoding="utf-8")
    assert "None on each of 2 tests." in text or "On each of 2 tests:" in text
    assert all(words in text for words in ("kalman", "is left out of forth"))
    tables = report.parent / "tables"
    board = pd.read_csv(tables / "leaderboard_forth.csv")
    assert math.isclose(
        board.loc[board["estimator"] == "zero", "rmse_sideslip"].item(),
        board["rmse_sideslip"].max(),
        rel_tol=0.2,
    )
    boards = pd.concat(
        pd.read_csv(tables / f"leaderboard_{part}.csv") for part in ("forth", "back")
    )
    is_luenberger = boards["estimator"] == "luenberger"
    beats_both = (boards["beats_zero"] == "yes") & (boards["beats_static_map"] == "yes")
    (row,) = (row for row in outcome["overview"] if row["estimator"] == "Luenberger")
    assert row["tests"] == 2
    assert row["beats_both"] == (is_luenberger & beats_both).sum()
    zero = boards.loc[boards["estimator"] == "zero", "rmse_sideslip"].to_numpy()
    ratios = boards.loc[is_luenberger, "rmse_sideslip"].to_numpy() / zero
    assert row["median_ratio"] == pytest.approx(np.median(ratios))
    assert row["max_ratio"] == pytest.approx(ratios.max())
    assert set(pd.read_csv(tables / "ranges.csv")["part"]) == {"forth", "back"}
    assert list(pd.read_csv(tables / "tests.csv")["part"]) == ["forth", "back"]


def test_bands_and_faults_are_listed_by_car(across):
    across.change(
        "conf/dataset/other.yaml", **DATASET | {"name": "other", "vehicle": "another car"}
    )
    across.change(
        "conf/split/back.yaml", tests={"unseen": [{"dataset": "other", "recording": "one"}]}
    )
    across.change(
        "pipelines/trusted.yaml", study="trusted", report="trust", parts=parts_of(PLAIN, LUENBERGER)
    )
    rows = across.told("run", "trusted", "tracking=none", "output=out")["overview"]
    assert [row["part"] for row in rows] == ["forth", "all"]
    assert all(0.0 <= row["coverage_90"] <= 100.0 and row["width_90"] > 0.0 for row in rows)
    folder = next((across.folder / "out" / "report").glob("trusted-*"))
    trained = pd.read_csv(folder / "tables" / "bands_trained.csv")
    assert set(trained["title"]) == {"forth"}
    assert rows[1]["contained"] == (trained["contained"] == "yes").sum()
    assert rows[1]["coverage_90"] == pytest.approx(100 * trained["coverage_90"].median())
    elsewhere = pd.read_csv(folder / "tables" / "bands_other.csv")
    assert set(elsewhere["title"]) == {"back"}
    assert (elsewhere["without_widening"] <= elsewhere["coverage_90"]).all()
    faults = pd.read_csv(folder / "tables" / "faults.csv")
    assert set(faults["part"]) == {"forth"}, "faults are tried on the car of the training"
    assert set(faults["channel"]) == {"yaw_rate", "vx", "ay", "ax"}
    assert faults.groupby(["fault", "channel"])["severity"].nunique().eq(3).all()
    in_time = faults[faults["in_time"]]
    assert (in_time["delay"] <= 2.0 * in_time["test_delay"] + 0.5).all()
    severe = faults[
        (faults["severity"] == "severe") & faults["fault"].isin(["bias", "nan", "inf", "huge"])
    ]
    assert severe["detectable"].all()
    assert severe["flagged"].mean() > 0.7
    by_part = pd.read_csv(folder / "tables" / "faults_by_part.csv")
    assert by_part["in_time"].item() == faults["in_time"].sum()
    text = (folder / "report.md").read_text(encoding="utf-8")
    assert "the median coverage is" in text
    in_time_percent = 100 * faults.loc[faults["detectable"], "in_time"].mean()
    assert f"Health flags {in_time_percent:.1f} % of the detectable faults" in text


def test_minutes_of_reference_are_columns_of_a_single_table(across):
    parts = {
        f"forth_{minutes}": {
            "title": "My car",
            "split": "forth",
            "overrides": [f"++split.minutes={minutes}"],
            "sweeps": [["estimator=zero,static_map"], LUENBERGER],
        }
        for minutes in (0.5, 1)
    }
    across.change(
        "pipelines/minutes.yaml", study="minutes", report="reference_minutes", parts=parts
    )
    rows = across.told("run", "minutes", "tracking=none", "output=out")["overview"]
    by_title = {row["title"]: row for row in rows}
    assert set(by_title) == {"Static map", "Luenberger"}
    folder = next((across.folder / "out" / "report").glob("minutes-*"))
    points = pd.read_csv(folder / "tables" / "points.csv").set_index(["title", "minutes"])
    metrics = pd.read_csv(folder / "metrics.csv")
    for title, estimator in (("Static map", "static_map"), ("Luenberger", "luenberger")):
        values = metrics.loc[
            (metrics["estimator"] == estimator)
            & (metrics["metric"] == "rmse_sideslip")
            & (metrics["test_set"] == "unseen"),
            "value",
        ]
        errors = [by_title[title][f"minutes_{minutes}"] for minutes in ("0.5", "1")]
        assert errors == pytest.approx(list(values))
        assert errors == pytest.approx([points.loc[(title, m), "rmse_sideslip"] for m in (0.5, 1)])
        assert by_title[title]["longest"] == 1.0
    text = (folder / "report.md").read_text(encoding="utf-8")
    lowest = min(by_title.values(), key=lambda row: row["minutes_0.5"])
    assert f"- My car, unseen: {lowest['minutes_0.5']:.2f}° with 0.5 min, " in text
    assert text.count("![") == 1


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (
            {"report": "folds", "split": "mine", "sweeps": [PLAIN]},
            "split 'mine' says no folds: {number: 5, of: laps}",
        ),
        (
            {"report": "drive", "parts": {"one": {"split": "mine", "sweeps": [PLAIN]}}},
            "draws its report from split and sweeps",
        ),
        (
            {"report": "folds", "parts": {"one": {"split": "folded", "sweeps": [PLAIN]}}},
            "split and sweeps, where the split has folds",
        ),
    ],
    ids=str,
)
def test_unsuitable_reports_are_refused_in_a_single_line(across, content, says):
    across.change("pipelines/odd.yaml", study="odd", **content)
    across.refused("run", "odd", code=2, says=says)
