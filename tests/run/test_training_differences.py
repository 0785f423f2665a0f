"""Trainings of one variant that differ in an option are candidates of their own in a study."""

import pandas as pd
import pytest

SWEEPS = [
    ["estimator=zero"],
    ["estimator=gru", "estimator.n_states=2", "training.max_epochs=1,2", "seed=0,1"],
]


@pytest.fixture
def study(place):
    place.change("pipelines/small.yaml", sweeps=SWEEPS)
    place.done("run", "small", "tracking=none", "--jobs", "1")
    return place


def test_each_training_is_a_candidate_that_names_the_option_in_which_it_differs(study):
    (report,) = (study.folder / "outputs" / "report").iterdir()
    metrics = pd.read_csv(report / "metrics.csv")
    rows = metrics[(metrics["estimator"] == "gru") & (metrics["metric"] == "epochs")]
    rows = rows[rows["test_set"] == "test"].sort_values(["variant", "seed"])
    assert list(zip(rows["variant"], rows["seed"], rows["value"], strict=True)) == [
        ("states_2_max_epochs_1", 0, 1),
        ("states_2_max_epochs_1", 1, 1),
        ("states_2_max_epochs_2", 0, 2),
        ("states_2_max_epochs_2", 1, 2),
    ]
    leaderboard = pd.read_csv(report / "tables" / "leaderboard_test.csv")
    assert sorted(leaderboard["title"]) == [
        "GRU, 2 states, max_epochs 1",
        "GRU, 2 states, max_epochs 2",
        "Zero (v = 0)",
    ]
