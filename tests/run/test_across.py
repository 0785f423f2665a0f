"""Studies across folds and across vehicles, run from the command line on a small data set."""

import json
import math

import numpy as np
import pandas as pd
import pytest

from place import DATASET, write_drives
from vehest.data.store import read_estimate, read_recording
from vehest.run.study import read_study

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
    before = {
        file: file.read_bytes() for file in (across.folder / "results").rglob("*") if file.is_file()
    }
    assert across("run", "folds_of_mine", "tracking=none", "output=out")[0] == 0
    assert before == {
        file: file.read_bytes() for file in (across.folder / "results").rglob("*") if file.is_file()
    }


def test_vehicles_are_listed_side_by_side_including_failed_ones(across):
    code, out, err = across("run", "vehicles", "tracking=none", "output=out", "--json")
    assert code == 5, err
    assert "steer" in err
    result = json.loads(out)
    titles = [row["estimator"] for row in result["overview"]]
    assert titles[:2] == ["Zero (v = 0)", "Static map"]
    assert "Luenberger" in titles
    assert any("kalman" in name for name in result["failed"])
    report = next((across.folder / "out" / "report").glob("vehicles-*")) / "report.md"
    text = report.read_text(encoding="utf-8")
    assert all(words in text for words in ("kalman", "is left out"))
    board = pd.read_csv(report.parent / "tables" / "leaderboard_forth.csv")
    assert math.isclose(
        board.loc[board["estimator"] == "zero", "rmse_sideslip"].item(),
        board["rmse_sideslip"].max(),
        rel_tol=0.2,
    )


def test_bands_and_faults_are_separate_per_car(across):
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
    assert {row["where"] for row in rows} == {"forth, unseen"}
    assert all(0.0 <= row["coverage_90"] <= 100.0 and row["width_90"] > 0.0 for row in rows)
    folder = next((across.folder / "out" / "report").glob("trusted-*"))
    elsewhere = pd.read_csv(folder / "tables" / "bands_elsewhere.csv")
    assert set(elsewhere["title"]) == {"back"}
    assert (elsewhere["without_widening"] <= elsewhere["coverage_90"]).all()
    faults = pd.read_csv(folder / "tables" / "faults.csv")
    assert set(faults["part"]) == {"forth"}, "faults are tried on the car that was learnt on"
    assert set(faults["channel"]) == {"yaw_rate", "vx", "ay", "ax"}
    assert faults.groupby(["fault", "channel"])["severity"].nunique().eq(3).all()
    assert (
        faults.loc[faults["in_time"], "delay"]
        <= 2.0 * faults.loc[faults["in_time"], "oracle_delay"] + 0.5
    ).all()
    severe = faults[
        (faults["severity"] == "severe") & faults["fault"].isin(["bias", "nan", "inf", "huge"])
    ]
    assert severe["visible"].all()
    assert severe["flagged"].mean() > 0.7


def test_a_pipeline_of_folds_has_a_part_a_fold(across):
    parts = read_study("folds_of_mine").parts
    assert [(name, part.overrides) for name, part in parts.items()] == [
        (f"fold_{k + 1}", (f"++split.fold={k}",)) for k in range(3)
    ]


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
