"""A part of a study that searches: candidates are tried, validation chooses, and the published
outcome is not searched for again.
"""

import shutil

import pandas as pd
import pytest

from place import write_drives
from vehest.run import searches
from vehest.run.study import jobs_of, read_study

pytestmark = pytest.mark.apart

GRU = ["estimator=gru", "estimator.n_states=2", "training.max_epochs=2"]
RATES = "training.learning_rate=0.001,0.01"
RUN = ("run", "tuned", "tracking=none", "--jobs", "1")
SEARCHES = "results/tuned/searches.csv"


@pytest.fixture
def tuned(place):
    """A place with a study of a search over two step sizes, and a part that states the first of
    them.
    """
    write_drives(place.folder, 60.0)
    place.change(
        "conf/split/forth.yaml",
        name="forth",
        dataset="mine",
        train=[{"recording": "one"}],
        validation=[{"recording": "two"}],
        tests={"unseen": [{"recording": "three"}]},
    )
    search = {"metric": "rmse_vy", "candidates": [[RATES]]}
    parts = {
        "pace": {"split": "forth", "search": search, "sweeps": [[*GRU, "seed=9"]]},
        "forth": {"split": "forth", "sweeps": [[*GRU, "training.learning_rate=0.001", "seed=0"]]},
    }
    place.change(
        "pipelines/tuned.yaml", study="tuned", report="transfer", publish=True, parts=parts
    )
    return place


def change_part(place, name, **changes):
    """Write the pipeline anew with other keys of a part."""
    parts = place.change("pipelines/tuned.yaml")["parts"]
    parts[name] |= changes
    place.change("pipelines/tuned.yaml", parts=parts)


def contents(folder):
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.name != "provenance.json"
    }


def n_trained(err):
    return err.count("epochs,")


def test_part_that_ignores_the_chosen_value_is_named(tuned):
    _, err = tuned.once(*RUN)
    remark = (
        "part 'forth' does not use what the search 'pace' chose by rmse_vy on validation: "
        "training.learning_rate=0.01"
    )
    assert remark in " ".join(err.split())
    trials = pd.read_csv(SEARCHES)
    assert list(trials["name"]) == ["pace_1", "pace_2"]
    assert list(trials["options"]) == RATES.replace(",", " training.learning_rate=").split()
    by_hand = {}
    for folder in (tuned.folder / "outputs/evaluate").glob("gru-*-seed9-*"):
        table = pd.read_csv(folder / "metrics.csv").query(
            "metric == 'rmse_vy' and test_set == 'validation' and subset == 'all'"
        )
        by_hand[table["value"].item()] = folder
    assert sorted(trials["validation"]) == pytest.approx(sorted(by_hand), rel=1e-5)
    assert trials.set_index("chosen").loc[True, "validation"] == trials["validation"].min()
    assert list(trials["chosen"]) == [False, True]
    metrics = pd.read_csv("results/tuned/metrics.csv")
    assert set(metrics["trained_on"]) == {"mine/forth"}
    change_part(tuned, "forth", sweeps=[[*GRU, "training.learning_rate=0.01", "seed=0"]])
    _, err = tuned.done(*RUN)
    assert "does not use" not in err
    change_part(
        tuned, "forth", sweeps=[[*GRU[:2], "training.max_epochs=1", "training.learning_rate=0.1"]]
    )
    _, err = tuned.done(*RUN)  # it is not what was searched for
    assert "does not use" not in err


def test_a_published_search_is_not_repeated_elsewhere_and_gives_the_same_results(tuned):
    _, err = tuned.once(*RUN)
    assert n_trained(err) == 3
    before = contents(tuned.folder / "results")
    for again in ((), ("--force",)):
        shutil.rmtree("outputs")
        _, err = tuned.done(*RUN, *again)
        message = " ".join(err.split())
        is_reused = "2 of 2 trials taken from results/tuned/searches.csv" in message
        assert (is_reused, n_trained(err)) == ((False, 3) if again else (True, 0))
        assert contents(tuned.folder / "results") == before
    shutil.rmtree("outputs")
    _, err = tuned.done(*RUN, "--retrain")
    assert n_trained(err) == 3
    assert contents(tuned.folder / "results") == before


@pytest.mark.parametrize("change", ["training", "metric", "lost"])
def test_a_search_is_repeated_where_a_trial_or_the_metric_is_another(tuned, change):
    tuned.once(*RUN)
    if change == "lost":
        table = pd.read_csv(SEARCHES)
        table.head(1).to_csv(SEARCHES, index=False)
    elif change == "metric":
        search = {"metric": "rmse_sideslip", "candidates": [[RATES]]}
        change_part(tuned, "pace", search=search)
    else:
        change_part(tuned, "pace", sweeps=[[*GRU[:2], "training.max_epochs=1", "seed=9"]])
    (tuned.folder / "results/tuned/weights.safetensors").unlink()
    shutil.rmtree("outputs")
    _, err = tuned.done(*RUN)
    assert ("taken from results/tuned/searches.csv" in " ".join(err.split()), n_trained(err)) == (
        False,
        3,
    )
    assert len(pd.read_csv(SEARCHES)) == 2


def test_damaged_search_files_are_a_single_line(tuned):
    tuned.once(*RUN)
    table = pd.read_csv(SEARCHES)
    table.assign(validation="low").to_csv(SEARCHES, index=False)
    shutil.rmtree("outputs")
    tuned.refused(*RUN, code=3, says="searches.csv': column 'validation' holds 'low'")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"search": {"candidates": [[RATES]], "metric": "beauty"}}, "which is no metric"),
        ({"search": {"candidates": [["training.patience=3"]]}}, "needs candidates"),
        ({"sweeps": [[*GRU, "seed=0,1"]]}, "for one training"),
        ({"sweeps": [[*GRU, "training.learning_rate=1.0"]]}, "which its sweeps state too"),
        ({"search": {"values": [1]}}, "values"),
    ],
)
def test_invalid_searches_are_refused(tuned, changes, says):
    change_part(tuned, "pace", **changes)
    tuned.refused(*RUN, code=2, says=says)


@pytest.mark.parametrize(
    ("name", "number", "longer"),
    [
        ("trial_filter", 3, ()),
        ("trial_gru", 1, ("training.phase.max_epochs",)),  # 1,000 epochs tried, 2,000 in tables
        ("trial_lstm", 2, ()),
    ],
)
def test_searches_of_papers_cover_the_trainings_of_their_parts(name, number, longer):
    study = read_study("learned_ukf")
    jobs = jobs_of(study, [])
    (trial,) = jobs[f"{name}_{number}"]
    stated = [searches.settings_to_compare(job.config, longer) for job in jobs["real"]]
    assert searches.settings_to_compare(trial.config, longer) in stated


def test_searches_of_the_learned_ukf_have_their_trials():
    study = read_study("learned_ukf")
    assert {name: len(trials) for name, trials in study.searches.items()} == {
        "trial_filter": 4,
        "trial_gru": 3,
        "trial_lstm": 3,
    }
