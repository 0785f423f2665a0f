"""A sweep: all combinations over their seeds, intervals, a choice on validation alone, heat maps.

And what is skipped or fails.
"""

import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from scipy import stats

from vehest.artefacts.artefact import StagePlan
from vehest.data.errors import ConfigurationError
from vehest.data.splits import Span, Split
from vehest.evaluation.metrics import Protocol
from vehest.run.study import sweep_of
from vehest.run.train import TrainJob
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.sweep import SweepArtefacts, build, heat_map, heat_maps, interval, table_of

pytestmark = pytest.mark.apart

QUICK = (
    "split=mine",
    "estimator=ksnn",
    "training.max_epochs=1",
    "training.batch_size=256",
    "tracking=none",
)
GRID = (*QUICK, "estimator.n_local=2,3", "estimator.n_hidden=0,1", "seed=range(2)")


def jobs_of(scores, keys):
    """A table of jobs from settings -> set -> RMSE(β) of each seed."""
    rows = []
    for number, (values, sets) in enumerate(scores.items()):
        for seed in range(len(next(iter(sets.values())))):
            figures = {f"rmse_sideslip.{name}": by_seed[seed] for name, by_seed in sets.items()}
            settings = dict(zip(keys, values, strict=True))
            rows.append(
                {
                    "combination": number,
                    "title": f"combination {number}",
                    **settings,
                    "seed": seed,
                    "status": "done",
                    **figures,
                }
            )
    return pd.DataFrame(rows).assign(error="", n_parameters=12, epochs=5.0)


def artefacts_of(jobs, keys, kind="simulated"):
    spans = {name: Span("mine", name, -math.inf, math.inf) for name in ("one", "two", "three")}
    split = Split("mine", (spans["one"],), (spans["two"],), {"test": (spans["three"],)})
    protocol = Protocol(20.0, 10.0, 1.5)
    titles = {"mine": "My car"}
    none = pd.DataFrame()
    part = PartArtefacts(
        "s",
        "s",
        "",
        "vehest sweep",
        split,
        protocol,
        {"mine": kind},
        titles,
        none,
        [],
        {},
        ["facts"],
    )
    return SweepArtefacts(part, keys, jobs)


def test_interval_is_that_of_students_t_and_a_lost_seed_is_not_dropped():
    for n in (2, 3, 10):
        values = np.random.default_rng(n).normal(0.4, 0.1, n)
        mean, half = interval(values)
        low, high = stats.t.interval(0.95, n - 1, loc=values.mean(), scale=stats.sem(values))
        assert (mean - half, mean + half) == pytest.approx((low, high), rel=1e-12)
    assert interval(np.array([0.3])) == pytest.approx((0.3, math.nan), nan_ok=True)
    assert all(
        map(math.isnan, (*interval(np.array([0.3, math.inf, 0.2])), *interval(np.array([]))))
    )


KEYS = ("estimator.n_local",)


def test_best_combination_is_chosen_on_validation_without_failed_seeds():
    scores = {
        (2,): ([0.4, 0.5], [0.1, 0.1]),
        (3,): ([0.3, 0.4], [0.8, 0.9]),
        (4,): ([math.nan, 0.1], [0.1, 0.1]),
    }
    jobs = jobs_of(
        {values: {"validation": score, "test": test} for values, (score, test) in scores.items()},
        KEYS,
    )
    table = artefacts_of(jobs, KEYS).table
    assert table["chosen"].tolist() == [False, True, False]
    assert table["rmse_sideslip.test"].tolist() == pytest.approx([0.1, 0.85, 0.1])
    header, rows = table_of(artefacts_of(jobs, KEYS))
    assert header == ["", "n_local", "parameters", "seeds", "validation", "test"]
    assert ([row[0] for row in rows], rows[1][4]) == (["", "*", ""], "0.350 ± 0.635")
    swapped = jobs.rename(
        columns={
            "rmse_sideslip.validation": "rmse_sideslip.test",
            "rmse_sideslip.test": "rmse_sideslip.validation",
        }
    )
    unvalidated = artefacts_of(swapped, KEYS)
    unvalidated = replace(
        unvalidated,
        part=replace(
            unvalidated.part, split=replace(unvalidated.part.split, train=(), validation=())
        ),
    )
    assert not unvalidated.table["chosen"].any(), "nothing is chosen without a validation range"
    jobs.loc[3, ["status", "rmse_sideslip.validation", "rmse_sideslip.test"]] = [
        "failed",
        math.nan,
        math.nan,
    ]
    table = artefacts_of(jobs, KEYS).table
    assert (table["chosen"].tolist(), table["n_seeds"].tolist()[:2]) == (
        [True, False, False],
        [2, 1],
    )
    failed_row = table_of(artefacts_of(jobs, KEYS))[1][1]
    assert failed_row[3:5] == ["1 (1 failed)", "0.300"], "no interval of a single seed"


def test_heat_maps_need_two_numeric_keys_and_have_a_panel_a_boolean():
    def score(value):
        return {"validation": [value, value + 0.1], "test": [2 * value, 2 * value]}

    keys = (*KEYS, "estimator.n_hidden", "estimator.bias")
    grid = {
        (p, q, bias): score(0.1 * p + 0.01 * q + bias)
        for p in (3, 2)
        for q in (0, 1, 2)
        for bias in (True, False)
    }
    jobs = jobs_of(grid, keys)
    figures = heat_maps(artefacts_of(jobs, keys))
    assert [figure.name for figure in figures] == ["heat_map_validation", "heat_map_test"]
    axes = [axes for axes in figures[0].static.axes if axes.get_xlabel() == "n_local"]
    assert [axes.get_title(loc="left") for axes in axes] == ["bias = true", "bias = false"]
    assert [tick.get_text() for tick in axes[0].get_xticklabels()] == ["2", "3"], (
        "sorted, though typed otherwise"
    )
    texts = {text.get_position(): text.get_text() for text in axes[1].texts}
    half = stats.t.ppf(0.975, 1) * 0.05
    assert texts[1, 2] == f"0.370\n±{half:.3f}"
    without = jobs_of({(p, q): score(p + q) for p in (2, 3) for q in (0, 1)}, keys[:2])
    assert len(heat_maps(artefacts_of(without, keys[:2]))) == 2
    for values, names in (
        ({(2,): score(0.1), (3,): score(0.2)}, ("estimator.n_local",)),
        ({(2, "gru"): score(0.1), (3, "lstm"): score(0.2)}, ("estimator.n_local", "estimator")),
        ({(2, "gru", 1): score(0.1), (3, "lstm", 2): score(0.2)}, ("a.n", "estimator", "b.n")),
        ({(2, 1, 1): score(0.1), (3, 2, 2): score(0.2)}, ("a.n", "b.n", "c.n")),
    ):
        fixed_names = jobs_of(values, names)
        assert heat_maps(artefacts_of(fixed_names, names)) == []


def test_darker_is_larger_and_a_missing_cell_is_grey():
    panel = ("", np.array([[0.1, 0.4, np.nan]]), np.full((1, 3), np.nan), [[0, 0]])
    figure = heat_map([panel], ["2", "3", "4"], ["0"], "P", "Q", "RMSE")
    mesh = figure.axes[0].collections[0]
    mesh.update_scalarmappable()
    first, second, missing = mesh.get_facecolor()
    assert sum(first[:3]) > sum(second[:3])
    assert missing[3] == 0.0
    assert [text.get_text() for text in figure.axes[0].texts] == ["0.100", "0.400", "–"]
    red, green, blue, _ = figure.axes[0].get_facecolor()
    assert red == green == blue


def test_report_of_a_sweep_names_command_budget_split_and_kind():
    scores = {
        (2,): [0.4, 0.5],
        (3,): [0.9, 0.9],
        (4,): [2.0, 2.1],
        (5,): [1.0, 1.1],
    }  # half interval of the first: 12.7 times 0.05
    jobs = jobs_of(
        {values: {"validation": score, "test": score} for values, score in scores.items()}, KEYS
    )
    for kind, banner in (("simulated", "**Simulated data:**"), ("real", "**Real data:**")):
        text = "\n".join(
            block
            for block in build(artefacts_of(jobs, KEYS, kind)).blocks
            if isinstance(block, str)
        )
        assert text.startswith(banner)
        for words in (
            "Command: `vehest sweep`",
            "Budget: 4 combinations, seeds 0, 1: 8 of 8 jobs done; training took 5 epochs",
            "Student's t",
            "2 of the other 3 combinations have a mean on the validation range within its interval",
        ):
            assert words in text


def test_a_sweep_makes_tables_and_heat_maps_and_then_skips(place, drawn):
    outcome = place.told("sweep", *GRID)
    folder = Path(outcome["folder"])
    assert folder.parent == Path("outputs/sweep")
    assert folder.name.startswith("ksnn-mine-")
    jobs = pd.read_csv(folder / "sweep.csv")
    table = pd.read_csv(folder / "summary.csv")
    assert (len(jobs), len(table), set(jobs["status"])) == (8, 4, {"done"})
    selected = jobs[(jobs["estimator.n_local"] == 3) & (jobs["estimator.n_hidden"] == 1)][
        "rmse_sideslip.test"
    ]
    row = table[(table["estimator.n_local"] == 3) & (table["estimator.n_hidden"] == 1)].iloc[0]
    assert row["rmse_sideslip.test"] == pytest.approx(selected.mean(), rel=1e-12)
    assert row["rmse_sideslip_half.test"] == pytest.approx(
        stats.t.ppf(0.975, 1) * selected.std() / math.sqrt(2), rel=1e-12
    )
    assert outcome["chosen"]["combination"] == int(table["rmse_sideslip.validation"].idxmin())
    for name in ("validation", "test"):
        with Image.open(folder / "figures" / f"heat_map_{name}.png") as image:
            assert image.width > 400
        ElementTree.parse(folder / "figures" / f"heat_map_{name}.svg")
    assert "**Simulated data:**" in (folder / "report.md").read_text()

    by_hand = place.told("eval", *QUICK, "estimator.n_local=3", "estimator.n_hidden=1", "seed=1")
    assert by_hand["rmse_sideslip.test"] == selected.tolist()[1], (
        "a job is what train and eval make"
    )

    files = place.files()
    again, err = place.done("sweep", *GRID, "--json")
    assert (json.loads(again), place.files()) == ({**outcome, "skipped": True}, files)
    assert [line.split()[0] for line in err.splitlines()] == ["reused"]

    out, err = place.done("sweep", *GRID[:-1], "seed=range(3)", "--name", "more")
    assert sum(line.startswith("done") and " train " in line for line in err.splitlines()) == 4, (
        "only the third seeds were missing"
    )
    assert all(words in out for words in ("± ", "outputs/sweep/more-"))


def test_failing_combinations_are_named_and_the_others_go_on(place):
    arguments = (
        *QUICK,
        "estimator.n_hidden=-1,0,0.5",
        "training.learning_rate=0.001,1e6",
        "training.max_epochs=2",
        "seed=range(2)",
    )
    arguments = tuple(word for word in arguments if word != "training.max_epochs=1")
    code, out, err = place("sweep", *arguments, "--json")
    assert code == 5
    last = err.splitlines()[-1]
    assert last.startswith("error: 10 of 12 jobs failed, the others are kept; ")
    assert all(
        words in last
        for words in (
            "n_hidden=-1, learning_rate=0.001",
            "estimator.n_hidden must lie between 0 and 4096, not at -1",
        )
    )
    assert "Traceback" not in err
    outcome = json.loads(out)
    named = {entry["jobs"]: entry["message"] for entry in outcome["failed"]}
    assert "validation loss" in named["n_hidden=0, learning_rate=1000000.0 seeds 0, 1"]
    assert outcome["chosen"]["training.learning_rate"] == 0.001
    jobs = pd.read_csv(Path(outcome["folder"]) / "sweep.csv")
    assert (jobs["status"] == "done").sum() == 2
    assert jobs.loc[jobs["status"] == "failed", "error"].notna().all()
    assert "## What failed" in (Path(outcome["folder"]) / "report.md").read_text()


def test_dry_run_tells_and_makes_nothing_and_the_same_training_twice_is_refused(place):
    out, err = place.done("sweep", *GRID, "--dry-run")
    assert all(
        words in err
        for words in ("n_local=3, n_hidden=1 seeds 0, 1", "would   sweep      ksnn-mine")
    )
    assert (out, place.files()) == ("", set())
    code, _, err = place(
        "sweep", *QUICK, "training.checkpoint_seconds=10,20", "estimator.n_hidden=0"
    )
    message = "checkpoint_seconds=20 seed 0: it is the same training as checkpoint_seconds=10"
    assert (code, message in err.splitlines()[-1]) == (5, True)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("split=mine,quickstart",), "'split' takes one value in a sweep"),
        (("evaluation.rate_hz=10,20",), "'evaluation.rate_hz' takes one value"),
        (("seed=1", "seed=2"), "'seed' is named twice"),
        (("estimator=gru", "estimator.n_states=0,-1"), "estimator.n_states must lie"),
    ],
)
def test_sweeps_that_make_no_sense_are_refused(place, overrides, message):
    with pytest.raises(ConfigurationError, match=message):
        sweep_of(
            ["split=mine" if not overrides[0].startswith("split") else "tracking=none", *overrides]
        )


def test_jobs_group_by_training_settings_that_come_in_groups():
    def job(rate, seed=0, **estimator):
        split = Split("any", (), (), {"test": (Span("any", "one", -math.inf, math.inf),)})
        plan = StagePlan("train", "any", {}, {}, "", Path())
        return TrainJob(
            plan,
            {"name": "ksnn", **estimator},
            {"name": "sequences", "phase": {"learning_rate": rate}},
            split,
            seed,
            {},
        )

    assert hash(job(1e-3).group) == hash(job(1e-3).group)
    assert job(1e-3).group == job(1e-3).group != job(2e-3).group
    assert job(1e-3, seed=1).group == job(1e-3).group, "seeds of a windowed network are one batch"
    for name in ("learned_ukf", "velocity_gru"):
        first = job(1e-3, name=name).group
        assert job(1e-3, seed=1, name=name).group != first, "each seed ends and is published alone"
    lower = job(1e-3, name="learned_ukf", start_friction=0.4).group
    assert lower == job(1e-3, name="learned_ukf").group, "the same weights in other use"
