"""Candidates of the KS-NN study, from metrics made by the test, and the paper's figures."""

import math
from pathlib import Path

import ksnn_tables
import pytest
from refusals import refusal
from study_parts import metric_rows, part_of

from vehest.data.splits import Span, Split
from vehest.evaluation.metrics import Protocol
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import (
    category_of,
    chosen,
    chosen_by_category,
    runs_of,
    structure_of,
)

SPLIT = Split(
    "scheme",
    (Span("cars", "c1", -math.inf, math.inf),),
    (Span("cars", "f1", -math.inf, math.inf),),
    {
        "c2": (Span("cars", "c2", -math.inf, math.inf),),
        "f2": (Span("cars", "f2", -math.inf, math.inf),),
    },
)

# (estimator, variant, seed) -> RMSE of v on validation, FVU on c2, FVU on f2
FIGURES = {
    ("luenberger", "luenberger", 0): (0.30, 0.20, 0.21),
    ("gru", "states_2", 0): (0.20, 0.15, 0.30),
    ("gru", "states_3", 0): (0.19, 0.14, 0.29),
    ("gru", "states_3", 1): (0.25, 0.01, 0.01),
    ("ksnn", "linear_no_bias_p2", 0): (0.12, 0.10, 0.12),
    ("ksnn", "linear_no_bias_p2", 1): (0.11, 0.11, 0.13),
    ("ksnn", "linear_no_bias_p3", 0): (0.15, 0.02, 0.02),
    ("ksnn", "nonlinear_bias_p2_q3", 0): (0.14, 0.05, 0.40),
}


def part(figures=FIGURES, drop=""):
    rows = []
    models = []
    for (estimator, variant, seed), (validation, *fvus) in figures.items():
        values = {("validation", "rmse_vy"): validation, ("validation", "fvu"): validation**2}
        for test, fvu in zip(("c2", "f2"), fvus, strict=True):
            values |= {(test, "fvu"): fvu, (test, "rmse_vy"): 0.5 * math.sqrt(fvu)}
            values |= {
                (test, "n_parameters"): 2 + seed * 0,
                (test, "epochs"): 10 * (seed + 1) * (estimator != "luenberger"),
            }
        for test in ("validation", "c2", "f2"):
            values |= {
                (test, "r2"): 1 - values[test, "fvu"],
                (test, "rmse_sideslip"): 2.0 * values[test, "rmse_vy"],
            }
        models.append(
            EvaluatedModel(estimator, variant, f"{estimator} {variant}", seed, Path("m"), Path("e"))
        )
        rows += [
            row
            for (test, metric), value in values.items()
            if metric != drop
            for row in metric_rows(models[-1], test, {metric: value})
        ]
    return part_of(
        SPLIT, Protocol(), models, rows, kinds={"cars": "simulated"}, data_titles={"cars": "Cars"}
    )


def test_runs_have_a_row_per_model_and_missing_metrics_are_named():
    runs = runs_of(part())
    assert len(runs) == len(FIGURES)
    row = runs[(runs["variant"] == "states_3") & (runs["seed"] == 1)].iloc[0]
    assert (row["category"], row["structure"], row["epochs"]) == (paper.GRU, "3 states", 20)
    assert (row["rmse_vy.validation"], row["fvu.c2"], row["r2.f2"]) == (0.25, 0.01, 0.99)
    assert "luenberger-luenberger-seed0 has no r2.validation; evaluate it again" in refusal(
        lambda: runs_of(part(drop="r2"))
    )


@pytest.mark.parametrize(
    ("estimator", "variant", "category", "structure"),
    [
        ("luenberger", "luenberger", paper.LUENBERGER, "–"),
        ("lstm", "states_6", paper.LSTM, "6 states"),
        ("ksnn", "linear_no_bias_p4", paper.LINEAR, "P = 4"),
        ("ksnn", "linear_bias_p4", paper.LINEAR_BIAS, "P = 4"),
        ("ksnn", "nonlinear_no_bias_p2_q1", paper.NONLINEAR, "P = 2, Q = 1"),
        ("ksnn", "nonlinear_bias_p12_q3", paper.NONLINEAR_BIAS, "P = 12, Q = 3"),
        ("kalman", "kalman_own_noise", paper.KALMAN, "–"),
        ("factor_graph", "factor_graph_batch", paper.FACTOR_GRAPH, "–"),
        ("factor_graph", "factor_graph_lag_0.05s", "Factor graph (FG), fixed lag of 0.05 s", "–"),
        ("somebodys", "own_p2", "somebodys", "P = 2"),
    ],
)
def test_candidates_fall_into_the_papers_categories(estimator, variant, category, structure):
    assert (category_of(estimator, variant), structure_of(variant)) == (category, structure)


def test_validation_chooses_and_neither_tests_nor_diverged_runs_do():
    picked = chosen_by_category(runs_of(part()))
    assert list(picked) == [paper.LUENBERGER, paper.GRU, paper.NONLINEAR_BIAS, paper.LINEAR]
    assert (picked[paper.GRU]["variant"], picked[paper.GRU]["seed"]) == ("states_3", 0), (
        "seed 1 is far better on both tests"
    )
    assert (picked[paper.LINEAR]["variant"], picked[paper.LINEAR]["seed"]) == (
        "linear_no_bias_p2",
        1,
    )
    figures = {
        ("gru", "states_2", 0): (math.nan, 0.1, 0.1),
        ("gru", "states_2", 1): (0.3, 0.2, 0.2),
    }
    assert chosen(runs_of(part(figures)))["seed"] == 1


def test_published_figures_agree_with_each_other():
    """R² and RMSE of the same rows imply one variance of v a test set, as they must."""
    for table in (ksnn_tables.TABLE_IV, ksnn_tables.TABLE_V):
        for test in ("c2", "f2"):
            deviations = [row.rmse(test) / math.sqrt(row.fvu(test)) for row in table.values()]
            assert max(deviations) / min(deviations) < 1.06, (test, deviations)
    assert ksnn_tables.TABLE_VII[paper.LSTM, True] == ksnn_tables.TABLE_V[paper.LSTM]
    assert sum(row.variants for row in ksnn_tables.TABLE_III.values()) == 39
