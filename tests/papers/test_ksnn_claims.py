"""Errors by block and verdicts on the paper's claims: where our errors are the paper's own figures
they come out.
"""

import math
from dataclasses import replace

import ksnn_tables
import numpy as np
import pytest
from study_parts import metric_rows, part_of

from vehest.data.splits import Span, Split
from vehest.evaluation.blocks import Segments, segments_of, write_segments
from vehest.evaluation.metrics import Protocol, Scored
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.kit.block_errors import blocks_of, training_of
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.verdicts import judge_paper
from vehest_papers.ksnn import block_errors, cost, measures, paper
from vehest_papers.ksnn.comparing import SegmentErrors, masked_segments
from vehest_papers.ksnn.schemes import Scheme, with_common_blocks

PUBLISHED = {
    "scheme_1": (ksnn_tables.TABLE_IV, "c", "c2", "f2"),
    "scheme_2": (ksnn_tables.TABLE_V, "f", "f2", "c2"),
}
SEGMENTS = 600
SAMPLES = 20
DEVIATION = {"c2": 0.49, "f2": 0.70}
"""Standard deviation of v on each test [m/s], about those of the paper's cars."""

NAMES = {
    paper.ZERO: ("zero", "zero"),
    paper.STATIC_MAP: ("static_map", "static_map"),
    paper.LUENBERGER: ("luenberger", "luenberger"),
    paper.GRU: ("gru", "states_5"),
    paper.LSTM: ("lstm", "states_5"),
    paper.LINEAR_BIAS: ("ksnn", "linear_bias_p2"),
    paper.NONLINEAR_BIAS: ("ksnn", "nonlinear_bias_p2_q3"),
    paper.LINEAR: ("ksnn", "linear_no_bias_p2"),
    paper.NONLINEAR: ("ksnn", "nonlinear_no_bias_p2_q3"),
}
N_PARAMETERS = {name: row.n_parameters for name, row in ksnn_tables.TABLE_IV.items()} | {
    paper.ZERO: 0,
    paper.STATIC_MAP: 2,
}


def planted_segments(fvu, test, seed):
    """Segments of a drive in which so much of v is left, errors large where those of every other
    candidate are.
    """
    common = np.random.default_rng(len(test) + ord(test[0]))
    hard = common.lognormal(0.0, 0.4, SEGMENTS)
    noise = np.random.default_rng(seed).lognormal(0.0, 0.1, SEGMENTS)
    variance = DEVIATION[test] ** 2
    share = hard * noise / np.mean(hard * noise)
    return Segments(
        piece=np.repeat([0.0, 1.0], SEGMENTS // 2),
        start=np.tile(np.arange(SEGMENTS // 2, dtype=float), 2),
        samples=np.full(SEGMENTS, float(SAMPLES)),
        squared_error_vy=fvu * variance * SAMPLES * share,
        sideslip_samples=np.full(SEGMENTS, float(SAMPLES)),
        squared_error_sideslip=fvu * variance * SAMPLES * share * 4.0,
        error_vy=np.zeros(SEGMENTS),
        vy_ref=np.zeros(SEGMENTS),
        squared_vy_ref=np.full(SEGMENTS, variance * SAMPLES),
    )


def planted_part(folder, fvus, *, train, seeds=3, spread=0.02, tests=("c2", "f2"), names=NAMES):
    """A comparison whose candidates leave this FVU, category -> test set -> FVU, whose logarithm
    has a spread from seed to seed.
    """
    generator = np.random.default_rng(1)
    rows = []
    models = []
    other_car = "f" if train == "c" else "c"
    for category, by_test in fvus.items():
        estimator, variant = names[category]
        for seed in range(seeds if estimator in ("gru", "lstm", "ksnn") else 1):
            at = folder / f"{train}-{estimator}-{variant}-{seed}"
            at.mkdir(parents=True)
            seed_fvus = {
                test: by_test[test] * math.exp(spread * generator.standard_normal())
                for test in tests
            }
            write_segments(
                at / "blocks.csv",
                {test: planted_segments(seed_fvus[test], test, seed + 10) for test in tests},
            )
            trained = {"max_epochs": 1000} if estimator in ("gru", "lstm", "ksnn") else {}
            models.append(EvaluatedModel(estimator, variant, category, seed, at, at, trained))
            validation = seed_fvus[f"{other_car}2"]
            values = {
                ("validation", "fvu"): validation,
                ("validation", "rmse_vy"): math.sqrt(validation),
            }
            for test in tests:
                values |= {
                    (test, "fvu"): seed_fvus[test],
                    (test, "rmse_vy"): math.sqrt(seed_fvus[test]) * DEVIATION[test],
                }
                values |= {(test, "n_parameters"): N_PARAMETERS[category], (test, "epochs"): 10}
            for test in ("validation", *tests):
                values |= {
                    (test, "r2"): 1.0 - values[test, "fvu"],
                    (test, "rmse_sideslip"): 2.0 * values[test, "rmse_vy"],
                }
            rows += [
                row
                for (test, metric), value in values.items()
                for row in metric_rows(models[-1], test, {metric: value})
            ]
    spans = {
        name: tuple(Span("cars", f"{name}_{place}", -math.inf, math.inf) for place in (1, 2))
        for name in (f"{train}1", f"{other_car}1", *tests)
    }
    split = Split(
        "scheme", spans[f"{train}1"], spans[f"{other_car}1"], {test: spans[test] for test in tests}
    )
    return part_of(
        split, Protocol(), models, rows, kinds={"cars": "simulated"}, data_titles={"cars": "Cars"}
    )


def of_the_paper(table):
    """Every category with the FVU that the paper prints, and the baselines."""
    printed = {name: {"c2": row.c2_fvu, "f2": row.f2_fvu} for name, row in table.items()}
    return {
        paper.ZERO: {"c2": 1.0, "f2": 1.0},
        paper.STATIC_MAP: {"c2": 0.6, "f2": 0.6},
        **printed,
    }


def schemes(folder):
    """Both schemes, with the paper's figures."""
    scheme_list = []
    for name, (table, train, same_car_test, other_test) in PUBLISHED.items():
        part = planted_part(folder / name, of_the_paper(table), train=train)
        scheme_list.append(
            Scheme(name, name.replace("_", " ").capitalize(), part, same_car_test, other_test)
        )
    return scheme_list


def judged(parts):
    """Verdicts of the engine on the errors by block of some parts, without networks to run
    again.
    """
    claimed = claims_of("ksnn")
    parts = with_common_blocks({scheme.name: scheme for scheme in parts})
    without_estimates = [
        claim for claim in claimed.claims if not claim.metric.startswith("band_power")
    ]
    rows = block_errors.error_rows(replace(claimed, claims=without_estimates), parts, {})
    of_errors = {"smallest_car_ratio", "relative_car_ratios", "parameter_rank_correlations"}
    of_errors |= {"specialised_over_others", "regularisation_loss_ratios", "operation_ratios"}
    of_errors |= {"stopping_epochs"}
    chosen = [
        claim
        for claim in claimed.claims
        if claim.measure
        and claim.measure.rpartition(":")[2] in of_errors
        and (claim.part in parts or "scheme_1" in parts)
    ]
    rows += block_errors.measured_rows(replace(claimed, claims=chosen), parts)
    artefacts = {name: scheme.part for name, scheme in parts.items()}
    training = block_errors.training_rows(claimed, artefacts, parts)
    return judge_paper(claimed, blocks_of(rows), training_of(training)), rows, training


def test_the_published_figures_give_the_papers_verdicts(tmp_path):
    verdicts, rows, _ = judged(schemes(tmp_path))
    for claim in (
        "luenberger_about_a_quarter_own_scheme_1",
        "gru_above_luenberger_other_scheme_2",
        "linear_bias_below_linear_own_scheme_1",
        "nonlinear_below_nonlinear_bias_other_scheme_2",
        "all_structures_above_diagonal_scheme_1",
        "all_structures_above_diagonal_scheme_2",
        "no_bias_cars_more_alike_linear_scheme_1",
        "no_bias_cars_more_alike_nonlinear_scheme_2",
        "linear_12_parameters_below_gru_other_scheme_1",
        "most_specialised_is_nonlinear_bias",
        "few_operations",
    ):
        assert verdicts[claim].verdict == "reproduced", (claim, verdicts[claim])
    # the paper's text rounds its Table IV
    assert verdicts["gru_explains_over_90_percent_own_scheme_1"].verdict == "contradicted"
    assert verdicts["early_stopping_at_about_200_epochs_scheme_1"].verdict == "contradicted"
    assert verdicts["nonlinear_below_gru_f1tenth_dart"].verdict == "not assessed"
    alikeness = verdicts["no_bias_cars_more_alike_linear_scheme_1"].values["KS-NN linear no bias"]
    assert alikeness.value == pytest.approx((0.152 / 0.133) / (0.241 / 0.082), rel=0.05)
    smallest_ratio = verdicts["all_structures_above_diagonal_scheme_1"].values["measured"]
    assert smallest_ratio.value == pytest.approx(0.253 / 0.235, rel=0.05), "Luenberger's"
    luenberger = verdicts["luenberger_about_a_quarter_own_scheme_1"].values["Luenberger"]
    assert luenberger.value == pytest.approx(0.235, rel=0.05)
    assert {row.candidate for row in rows if row.metric == "fvu"} >= {"zero", "static_map", "GRU"}


def test_networks_that_were_not_checked_are_reported_as_such(tmp_path):
    _, _, training = judged(schemes(tmp_path))
    rows = {row.candidate: row for row in training}
    assert rows["Luenberger"].training == rows["zero"].training == "not applicable"
    gru = rows["GRU"]
    assert (gru.epochs, gru.training) == ("1000 at most, 10 to 10 by early stopping", "not checked")
    assert gru.epochs_paper.startswith("1000 at most")
    assert "LSTM, 5 states" not in rows, "no claim names it"
    assert rows["KS-NN linear no bias, P = 2"].epochs == gru.epochs


def test_regularisation_is_compared_on_the_same_structures_and_blocks(tmp_path):
    names = {
        **NAMES,
        paper.LSTM: ("lstm", "states_2"),
        paper.NONLINEAR: ("ksnn", "nonlinear_no_bias_p2_q2"),
    }
    with_it = planted_part(
        tmp_path / "with", of_the_paper(ksnn_tables.TABLE_V), train="f", names=names
    )
    table = {paper.LSTM: {"c2": 0.84, "f2": 0.042}, paper.NONLINEAR: {"c2": 0.197, "f2": 0.059}}
    without = planted_part(tmp_path / "without", table, train="f", names=names)
    verdicts, rows, _ = judged(
        [
            Scheme("scheme_2", "With", with_it, "f2", "c2"),
            Scheme("one_vehicle", "Without", without, "f2", "c2"),
        ]
    )
    for claim in (
        "lstm_without_regularisation_lower_own",
        "nonlinear_loses_less_without_regularisation",
    ):
        assert verdicts[claim].verdict == "reproduced", (claim, verdicts[claim])
    higher = verdicts["lstm_without_regularisation_higher_other"]
    assert higher.size.value == pytest.approx(0.84 / 0.483, rel=0.05)
    assert higher.verdict == "reproduced", "a weakness is not checked against baselines"
    assert verdicts["lstm_without_regularisation_lower_own"].size.value == pytest.approx(
        0.042 / 0.098, rel=0.05
    )
    blocks = {
        part: [
            row.block
            for row in rows
            if (row.part, row.seed, row.test_set, row.metric, row.candidate)
            == (part, 0, "c2", "fvu", "LSTM, 2 states")
        ]
        for part in ("scheme_2", "one_vehicle")
    }
    assert blocks["scheme_2"] == blocks["one_vehicle"]
    assert len(blocks["scheme_2"]) > 5


def test_linearised_logarithms_have_the_ratio_as_their_mean_and_its_spread():
    """Against the jackknife, which leaves each block out in turn."""
    rng = np.random.default_rng(0)
    sums = rng.lognormal(0.0, 0.3, (2, 60))
    sizes = rng.lognormal(0.0, 0.3, 60)
    logs = measures.log_values(sums, sizes)
    log_rmse = np.log(sums.sum(axis=1) / sizes.sum())
    assert logs.mean(axis=1) == pytest.approx(log_rmse)
    left_out = np.log((sums.sum(axis=1, keepdims=True) - sums) / (sizes.sum() - sizes))
    jackknife = 59 / 60 * np.square(left_out - left_out.mean(axis=1, keepdims=True)).sum(axis=1)
    assert logs.var(axis=1, ddof=1) / 60 == pytest.approx(jackknife, rel=0.05)
    ratio = measures.as_ratio(logs)
    assert ratio.mean() == pytest.approx(np.exp(log_rmse.mean()))


def test_stretches_of_two_tests_have_the_variance_of_both(tmp_path):
    """With the ratio of the FVUs on both cars as their mean."""
    scheme = with_common_blocks({"scheme_1": schemes(tmp_path)[0]})["scheme_1"]
    claim = next(
        claim
        for claim in claims_of("ksnn").claims
        if claim.id == "all_structures_above_diagonal_scheme_1"
    )
    values = measures.smallest_car_ratio(claim, {"scheme_1": scheme}).values
    c2_errors, f2_errors = (
        scheme.errors(test).block_errors("luenberger/luenberger", "fvu") for test in ("c2", "f2")
    )
    expected = (f2_errors.sums.sum() / f2_errors.sizes.sum()) / (
        c2_errors.sums.sum() / c2_errors.sizes.sum()
    )
    assert values.mean() == pytest.approx(expected, rel=1e-6)


def test_segments_give_the_fvu_about_the_errors_mean():
    rng = np.random.default_rng(0)
    time = np.arange(800) / 20.0
    truth = np.sin(time)
    estimate = truth + 0.3 + 0.1 * rng.standard_normal(800)
    zeros = np.zeros(800)
    scored = Scored(time, estimate, truth, zeros, zeros, zeros, np.ones(800, dtype=bool))
    errors = SegmentErrors({"one": [segments_of([scored], 20.0)]}, recordings=["drive"])
    error = estimate - truth
    assert errors.value("one", "fvu") == pytest.approx(error.var() / truth.var())
    assert errors.names[0] == "drive 0.00 s"


def test_figures_are_those_of_the_samples_and_infinite_errors_left_out():
    segments = planted_segments(0.2, "c2", 3)
    errors = SegmentErrors({"one": [segments, segments]})
    assert errors.value("one", "fvu") == pytest.approx(0.2)
    assert errors.value("one", "rmse_vy") == pytest.approx(math.sqrt(0.2) * DEVIATION["c2"])
    figure = errors.figure("one", "fvu")
    assert figure.low < 0.2 < figure.high
    broken = planted_segments(math.inf, "c2", 0)
    errors = SegmentErrors({"good": [planted_segments(0.1, "c2", 0)], "broken": [broken]})
    assert "broken" not in errors
    assert math.isnan(errors.value("broken", "fvu"))
    assert not np.isfinite(errors.block_errors("broken", "rmse_vy").sums).all()
    assert errors.in_words("broken", "fvu") == "–"


def test_masked_segments_without_a_mask_equal_the_evaluations_segments():
    generator = np.random.default_rng(2)
    time = np.arange(90) / 20.0
    vy = generator.normal(size=90)
    reference = generator.normal(size=90)
    is_scored = time >= 1.0
    part = Scored(time, vy, reference, vy / 20.0, reference / 20.0, np.zeros(90), is_scored)
    unmasked = masked_segments([part], [np.ones(90)], 20.0)
    plain = segments_of([part], 20.0)
    assert all(np.allclose(getattr(unmasked, name), getattr(plain, name)) for name in vars(plain))
    half = masked_segments([part], [(time < 2.0).astype(float)], 20.0)
    assert (half.samples.sum(), half.sideslip_samples.sum()) == (40, 20)
    assert half.squared_error_vy.sum() == pytest.approx(np.sum((vy - reference)[:40] ** 2))


@pytest.mark.parametrize(
    ("n_hidden", "bias", "products_and_sums"),
    [(0, False, 36), (0, True, 40), (2, False, 60), (3, True, 88)],
)
def test_operations_of_a_ksnn_are_those_of_its_equations(n_hidden, bias, products_and_sums):
    """Counted by hand in Eqs. 7 to 9: 32 without the four f, and of each f 1, 1 more for a bias, 3
    a neuron and 1 more for its bias.
    """
    assert cost.ksnn_operations(2, n_hidden, bias=bias) == (products_and_sums, 4 * n_hidden)
    assert cost.ksnn_operations(6, n_hidden, bias=bias) == (products_and_sums, 4 * n_hidden), (
        "two modules at most are active"
    )
