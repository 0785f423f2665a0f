"""Pairs of cars: errors raw and after the best gain, complete pairs, intervals and shares of the
sub-models.
"""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from trained_ksnn import ksnn_with_weights

from conftest import planar_drive
from place import write_drives
from vehest.data.recording import Recording
from vehest_papers.ksnn import pairs, paper
from vehest_papers.ksnn.candidates import category_of
from vehest_papers.ksnn.data_quality import PUBLISHED, velocity_ratio
from vehest_papers.ksnn.document import TEMPLATE
from vehest_papers.ksnn.sub_models import variance_shares

pytestmark = pytest.mark.apart


def test_residuals_are_those_of_a_hand_calculation():
    reference = np.array([1.0, -1.0, 2.0, -2.0])
    sums = pairs.residuals(0.5 * reference + 3.0, reference)
    assert sums["total"] == pytest.approx(10.0)
    assert sums["raw"] == pytest.approx(2.5)
    assert sums["best_gain"] == pytest.approx(0.0, abs=1e-12)
    assert sums["gain"] == pytest.approx(2.0)
    assert sums["squares"] == pytest.approx(4 * 9.0 + 2.5)


def test_best_gain_leaves_the_variance_unexplained_by_the_correlation():
    generator = np.random.default_rng(0)
    reference = generator.standard_normal(500)
    estimate = 0.3 * reference + generator.standard_normal(500)
    sums = pairs.residuals(estimate, reference)
    correlation = np.corrcoef(estimate, reference)[0, 1]
    assert sums["best_gain"] / sums["total"] == pytest.approx(1.0 - correlation**2)
    assert sums["best_gain"] <= sums["raw"]


def test_constant_estimate_leaves_all_of_the_variance_with_any_gain():
    sums = pairs.residuals(np.zeros(4), np.array([1.0, 2.0, 3.0, 4.0]))
    assert sums["raw"] == sums["best_gain"] == pytest.approx(sums["total"])


def errors_of(fvus, seeds=(0,)):
    """Rows of `pairs.pair_errors`: (pair, training, candidate) -> FVU on every test."""
    return pd.DataFrame(
        [
            {
                "pair": pair,
                "training": training,
                "test": test,
                "candidate": candidate,
                "seed": seed,
                "samples": 10.0,
                "total": 4.0,
                "raw": 4.0 * fvu,
                "best_gain": 2.0 * fvu,
                "gain": 1.0,
                "squares": 5.0 * fvu,
            }
            for (pair, training, candidate), fvu in fvus.items()
            for test in pairs.TESTS
            for seed in seeds
        ]
    )


CANDIDATES = (paper.NONLINEAR, paper.GRU)


def complete(n_pairs, ratio=2.0):
    return {
        (f"pair {number:02d}", training, candidate): 0.1
        * number
        * ratio ** (candidate == paper.GRU)
        for number in range(1, n_pairs + 1)
        for training in pairs.TRAININGS
        for candidate in CANDIDATES
    }


def test_pairs_without_all_trainings_and_seeds_of_some_pairs_are_left_out():
    fvus = complete(3)
    errors = pd.concat([errors_of(fvus), errors_of(complete(2)).assign(seed=1)])
    rows_of_complete_pairs = pairs.complete_pairs(errors)
    assert set(rows_of_complete_pairs["pair"]) == {"pair 01", "pair 02", "pair 03"}
    assert set(rows_of_complete_pairs["seed"]) == {0}
    del fvus["pair 03", "stop", paper.GRU]
    assert set(pairs.complete_pairs(errors_of(fvus))["pair"]) == {"pair 01", "pair 02"}


def test_ratio_over_pairs_equals_the_planted_ratio_with_power_from_the_spread():
    errors = errors_of(complete(8))
    table = pairs.ratios_table(errors).set_index("over")
    assert table.loc[paper.GRU, "other_stop_raw"].startswith("0.5 [") or table.loc[
        paper.GRU, "other_stop_raw"
    ].startswith("0.500 [")
    spread = np.array([-1.0, 1.0] * 10)
    expected = (2.093024 + 0.860951) * spread.std(ddof=1) / math.sqrt(20)  # t quantiles, 19 free
    assert math.log(pairs.detectable_ratio(spread)) == pytest.approx(expected, rel=1e-5)
    assert math.isnan(pairs.detectable_ratio(spread[:2]))


def test_geometric_mean_has_the_interval_of_the_pairs():
    logs = np.random.default_rng(3).normal(-0.5, 0.4, 20)
    figure = pairs.geometric_mean(logs)
    assert figure.value == pytest.approx(math.exp(logs.mean()))
    half = 1.96 * logs.std(ddof=1) / math.sqrt(20)
    assert math.log(figure.high / figure.low) == pytest.approx(2 * half, rel=0.1)


def test_rows_of_blocks_are_a_block_each_pair():
    rows = pairs.pair_rows(errors_of(complete(2)))
    row = next(
        block_row
        for block_row in rows
        if block_row.metric == "fvu_best_gain" and block_row.block == "pair 02"
    )
    assert (row.part, row.test_set, row.size) == ("pairs_stop", "own", 4.0)
    assert row.value == pytest.approx(2.0 * 0.2)
    assert {block_row.part for block_row in rows} == {"pairs_stop", "pairs_converged"}


def test_networks_with_kinematic_gains_are_a_separate_candidate():
    variant = "nonlinear_no_bias_p2_q2_kinematic_0.95"
    assert category_of("ksnn", variant) == paper.KINEMATIC_GAIN


@pytest.mark.parametrize(("n_hidden", "bias"), [(0, False), (2, True)])
def test_shares_of_the_sub_models_add_up_to_unity(n_hidden, bias):
    estimator = ksnn_with_weights(n_local=2, n_hidden=n_hidden, bias=bias)
    shares = variance_shares(estimator, [planar_drive(20.0, seed=1), planar_drive(20.0, seed=2)])
    assert sum(shares.values()) == pytest.approx(1.0)
    assert set(shares) == {"slip_rate", "pseudo_measurement", "third"}


def test_ratio_of_v_over_ay_is_that_of_the_quantiles():
    def drive(velocity):
        swing = np.linspace(-1.0, 1.0, 1001)
        channels = {"vx": np.full(1001, 20.0), "yaw_rate": swing}
        channels |= {"ay": 10.0 * swing, "vy_ref": velocity * swing}
        return Recording("drive", "car", 20.0, 0.0, channels, "simulated")

    assert velocity_ratio([drive(0.6)], [drive(1.2)]) == pytest.approx(0.5)
    published = {name: drive_set.velocity_over_ay for name, drive_set in PUBLISHED.items()}
    assert published["C-1"] / published["F-2"] == pytest.approx(0.66, abs=0.005)
    assert published["C-2"] / published["F-1"] == pytest.approx(0.71, abs=0.005)


def test_published_gates_on_the_ratio_are_met():
    table = pd.read_csv(
        Path(__file__).parents[2] / "results" / "ksnn" / "tables" / "velocity_ratios.csv"
    )
    assert len(table) == 2
    assert np.all(np.abs(table["ours"] / table["published"] - 1.0) <= 0.05)


def test_stated_leave_out_wins_equal_those_of_the_published_study():
    results = Path(__file__).parents[2] / "results"
    table = pd.read_csv(results / "leave_one_out" / "tables" / "overview.csv", index_col=0)
    row = table.loc[f"{paper.NONLINEAR}, P = 2, Q = 2"]
    stated = f"On {row['beats_both']:.0f} of {row['tests']} tests"
    assert stated in " ".join(TEMPLATE.read_text(encoding="utf-8").split())


def test_report_shows_complete_pairs_of_a_study_that_is_not_finished(place):
    write_drives(place.folder, 80.0)
    split = place.change("conf/split/mine.yaml")
    ranges = {
        "train": [{"recording": "one", "stop": 50}],
        "tests": {
            "own": [{"recording": "one", "start": 60}],
            "other": [{"recording": "two", "start": 50}],
            "third": [{"recording": "three"}],
        },
    }
    for name, validation in (
        ("converged", {"recording": "one", "start": 50, "stop": 60}),
        ("stop", {"recording": "two", "stop": 50}),
    ):
        pair_split = {"name": name, "validation": [validation], **ranges}
        place.change(f"conf/split/{name}.yaml", **split | pair_split)
    networks = [
        [
            "estimator=ksnn",
            "estimator.n_hidden=2",
            "training.max_epochs=2",
            "training.epoch_steps=2",
        ],
        [
            "estimator=gru",
            "estimator.n_states=2",
            "training.max_epochs=2",
            "training.epoch_steps=2",
        ],
    ]
    parts = {
        f"pair_0{number}_{training}": {
            "title": training,
            "split": training,
            "sweeps": [["estimator=zero,static_map"], *networks],
        }
        for number in (1, 2, 3)
        for training in pairs.TRAININGS
    }
    del parts["pair_03_stop"]
    place.change("pipelines/few.yaml", study="few", title="Few", report="ksnn", parts=parts)
    place.done("run", "few", "tracking=none")
    ((report,),) = [list(place.folder.glob("**/report/few-*"))]
    errors = pd.read_csv(report / "tables" / "pair_errors.csv")
    assert set(errors["pair"]) == {"pair 01", "pair 02"}
    assert set(errors["candidate"]) == {"zero", "static_map", paper.NONLINEAR, paper.GRU}
    text = (report / "report.md").read_text(encoding="utf-8")
    assert "On the other car of 2 pairs" in text
    shares = pd.read_csv(report / "tables" / "sub_models.csv")
    assert np.allclose(shares[["slip_rate", "pseudo_measurement", "third"]].sum(axis=1), 1.0)
    claims = pd.read_csv(report / "tables" / "claims.csv").set_index("id")
    assert claims.loc["nonlinear_below_luenberger_other_pairs", "verdict"] == "not assessed"
