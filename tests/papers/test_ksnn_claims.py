"""Verdicts on the paper's statements: where our errors are the paper's own figures they come out, and where they are turned they do not."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from study_parts import metric_rows, part_of

from vehest.data.splits import Span, Split
from vehest.evaluation.blocks import Segments, segments_of, write_segments
from vehest.evaluation.metrics import Protocol, Scored
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.kit.statements import Change, Compared, Statement, counted, decided, outcomes
from vehest_papers.ksnn import claims, cost, paper
from vehest_papers.ksnn.causes import headline
from vehest_papers.ksnn.comparing import SegmentErrors, masked_segments
from vehest_papers.ksnn.schemes import Scheme

PUBLISHED = {
    "scheme_1": (paper.TABLE_IV, "c", "c2", "f2"),
    "scheme_2": (paper.TABLE_V, "f", "f2", "c2"),
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
N_PARAMETERS = {name: row.n_parameters for name, row in paper.TABLE_IV.items()} | {
    paper.ZERO: 0,
    paper.STATIC_MAP: 2,
}


def planted_segments(fvu, test, seed):
    """Segments of a drive in which so much of v is left, errors large where those of every other candidate are."""
    common = np.random.default_rng(len(test) + ord(test[0]))
    hard = common.lognormal(0.0, 0.4, SEGMENTS)
    own = np.random.default_rng(seed).lognormal(0.0, 0.1, SEGMENTS)
    variance = DEVIATION[test] ** 2
    share = hard * own / np.mean(hard * own)
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


def planted_part(folder, fvus, *, train, seeds=3, spread=0.02, tests=("c2", "f2")):
    """A comparison whose candidates leave this FVU, category -> test set -> FVU, whose logarithm has a spread from seed to seed."""
    generator = np.random.default_rng(1)
    rows = []
    models = []
    other = "f" if train == "c" else "c"
    for category, by_test in fvus.items():
        estimator, variant = NAMES[category]
        for seed in range(seeds if estimator in ("gru", "lstm", "ksnn") else 1):
            at = folder / f"{train}-{estimator}-{variant}-{seed}"
            at.mkdir(parents=True)
            own = {
                test: by_test[test] * math.exp(spread * generator.standard_normal())
                for test in tests
            }
            write_segments(
                at / "blocks.csv",
                {test: planted_segments(own[test], test, seed + 10) for test in tests},
            )
            models.append(EvaluatedModel(estimator, variant, category, seed, at, at))
            validation = own[f"{other}2"]
            values = {
                ("validation", "fvu"): validation,
                ("validation", "rmse_vy"): math.sqrt(validation),
            }
            for test in tests:
                values |= {
                    (test, "fvu"): own[test],
                    (test, "rmse_vy"): math.sqrt(own[test]) * DEVIATION[test],
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
        name: (Span("cars", f"{name}_001", -math.inf, math.inf),)
        for name in (f"{train}1", f"{other}1", *tests)
    }
    split = Split(
        "scheme", spans[f"{train}1"], spans[f"{other}1"], {test: spans[test] for test in tests}
    )
    return part_of(
        split, Protocol(), models, rows, kinds={"cars": "simulated"}, data_titles={"cars": "Cars"}
    )


def of_the_paper(table, static_map=0.6):
    """Every category with the FVU that the paper prints, and the baselines."""
    printed = {name: {"c2": row.c2_fvu, "f2": row.f2_fvu} for name, row in table.items()}
    return {
        paper.ZERO: {"c2": 1.0, "f2": 1.0},
        paper.STATIC_MAP: {"c2": static_map, "f2": static_map},
        **printed,
    }


def schemes(folder, fvus=None, **options):
    """Both schemes, with the paper's figures if no others are given."""
    made = []
    for name, (table, train, own, other) in PUBLISHED.items():
        part = planted_part(folder / name, (fvus or of_the_paper)(table), train=train, **options)
        made.append(Scheme(name, name.replace("_", " ").capitalize(), part, own, other, table))
    return made


def turned(table):
    """The paper's figures with networks without structure and those without biases exchanged."""
    own = of_the_paper(table)
    pairs = ((paper.GRU, paper.LINEAR), (paper.LSTM, paper.NONLINEAR))
    return own | {name: own[other] for pair in pairs for name, other in (pair, pair[::-1])}


def verdicts(made):
    return {claim.claim: claim.verdict for claim in decided(claims.on_accuracy(made))}


def test_the_papers_own_figures_give_the_papers_verdicts(tmp_path):
    found = verdicts(schemes(tmp_path))
    assert (
        found["Luenberger leaves about 25 % (20 to 30 %) of v's variance on either car"]
        == "reproduced"
    )
    for claim in (
        "and are worse than Luenberger on the other",
        "biases: lower FVU on the own car",
        "no biases: lower FVU on the other",
        "with biases below GRU, LSTM on the own car",
        "with biases below Luenberger on the other",
        "no biases: the cars further alike, FVU other over own",
        "nonlinear no bias: RMSE(v) on the other car below Luenberger's",
        "and below GRU's, LSTM's",
        "the same by FVU, Luenberger",
        "the same by FVU, GRU, LSTM",
        "not in the paper: below the static map",
        "all dots above the diagonal, scheme 1",
    ):
        assert found[claim] == "reproduced", claim
    assert found["GRU, LSTM explain over 90 % on the own car"] == "not reproduced", (
        "the paper's text rounds its Table IV"
    )
    assert found["all dots above the diagonal, scheme 2"] == "reproduced"
    assert (
        found[next(claim for claim in found if claim.startswith("a third car"))]
        == "not testable on this data"
    )


def test_turned_figures_turn_verdicts_and_the_headline(tmp_path):
    found = verdicts(schemes(tmp_path, turned))
    for claim in (
        "nonlinear no bias: RMSE(v) on the other car below Luenberger's",
        "and below GRU's, LSTM's",
        "the same by FVU, GRU, LSTM",
    ):
        assert found[claim] == "not reproduced", claim
    assert "comes out in both schemes" in headline(schemes(tmp_path / "as"), {})
    words = headline(schemes(tmp_path / "turned", turned), {})
    assert words.startswith(
        "**The paper's order of families does not come out** (scheme 1 and scheme 2)"
    )
    assert "static map" in words
    level = headline(
        schemes(
            tmp_path / "level",
            lambda table: {name: {"c2": 0.3, "f2": 0.3} for name in of_the_paper(table)},
            spread=0.0,
        ),
        {},
    )
    assert "is not decided here" in level


def test_regularisation_is_compared_on_the_same_structures(tmp_path):
    with_it = schemes(tmp_path / "with")[1]
    table = {paper.LSTM: {"c2": 0.84, "f2": 0.042}, paper.NONLINEAR: {"c2": 0.197, "f2": 0.059}}
    without = Scheme(
        "one_vehicle", "Without", planted_part(tmp_path / "without", table, train="f"), "f2", "c2"
    )
    found = decided(claims.on_regularisation(with_it, without))
    assert [claim.verdict for claim in found] == ["reproduced"] * 3
    assert "−57 %" in found[0].ours


def test_figures_are_those_of_the_samples_and_infinite_errors_left_out():
    segments = planted_segments(0.2, "c2", 3)
    errors = SegmentErrors({"one": [segments, segments]}, "c2")
    assert errors.value("one", "fvu") == pytest.approx(0.2)
    assert errors.value("one", "rmse_vy") == pytest.approx(math.sqrt(0.2) * DEVIATION["c2"])
    low, high = errors.get("one", "fvu").interval
    assert low < 0.2 < high
    broken = planted_segments(math.inf, "c2", 0)
    errors = SegmentErrors({"good": [planted_segments(0.1, "c2", 0)], "broken": [broken]}, "c2")
    assert "broken" not in errors
    assert errors.change("good", "broken", "fvu") is None
    assert errors.in_words("broken", "fvu") == "–"


def test_intervals_hold_the_true_ratio_as_often_as_they_say():
    generator = np.random.default_rng(0)
    inside = 0
    for trial in range(150):
        scale = generator.lognormal(0.0, 0.3, 40)
        parts = {}
        for name, level in (("first", 0.8), ("second", 1.0)):
            squares = [
                level
                * scale
                * generator.lognormal(0.0, 0.3, 40)
                * math.exp(0.1 * generator.standard_normal())
                for _ in range(4)
            ]
            parts[name] = [_of_pieces(own) for own in squares]
        change = SegmentErrors(parts, f"trial {trial}").change("first", "second", "rmse_vy")
        low, high = change.ends()
        inside += low < math.sqrt(0.8) < high
    assert stats.binomtest(inside, 150, 0.95).pvalue > 0.01, inside


def _of_pieces(squares):
    """Segments each in a piece of its own, so that each is a block."""
    zeros = np.zeros_like(squares)
    n = np.arange(len(squares), dtype=float)
    ones = np.ones_like(squares)
    return Segments(n, zeros, ones, squares, ones, squares, zeros, zeros, ones)


def test_masked_segments_without_a_mask_are_the_evaluations_own():
    generator = np.random.default_rng(2)
    time = np.arange(90) / 20.0
    vy = generator.normal(size=90)
    reference = generator.normal(size=90)
    is_scored = time >= 1.0
    part = Scored(time, vy, reference, vy / 20.0, reference / 20.0, np.zeros(90), is_scored)
    own = masked_segments([part], [np.ones(90)], 20.0)
    plain = segments_of([part], 20.0)
    assert all(np.allclose(getattr(own, name), getattr(plain, name)) for name in vars(plain))
    half = masked_segments([part], [(time < 2.0).astype(float)], 20.0)
    assert (half.samples.sum(), half.sideslip_samples.sum()) == (40, 20)
    assert half.squared_error_vy.sum() == pytest.approx(np.sum((vy - reference)[:40] ** 2))


def change(ratio, error):
    return Change(math.log(ratio), error, 30.0)


@pytest.mark.parametrize(
    ("ratios", "verdict"),
    [
        ((0.5, 0.6), "reproduced"),
        ((0.5, 0.99), "undecided"),
        ((0.5, 2.0), "not reproduced"),
        ((), "not testable on this data"),
    ],
)
def test_a_statement_is_reproduced_only_where_all_its_comparisons_are(ratios, verdict):
    statement = Statement(
        "claim", "paper", "simulated", [Compared(str(own), change(own, 0.05)) for own in ratios]
    )
    (claim,) = decided([statement])
    assert claim.verdict == verdict
    assert ("−50 % [" in claim.ours) == bool(ratios)


def test_many_comparisons_bounds_and_counts_are_judged_as_relative_changes():
    weak = Compared("", change(0.9, 0.045))
    assert outcomes([weak])[0][0] == "as claimed"
    assert {outcome for outcome, _ in outcomes([weak] * 10)} == {"not told apart"}
    _, confidence = outcomes([weak] * 10)[0]
    assert confidence == pytest.approx(1.0 - 0.05 / 10)
    within = Compared("", change(1.0, 0.005), beyond=0.02)
    assert outcomes([within])[0][0] == "as claimed"
    assert outcomes([Compared("", change(1.05, 0.005), beyond=0.02)])[0][0] == "the other way round"
    assert counted("c", "p", "o", "d", [True, True], "w").verdict == "reproduced"
    assert counted("c", "p", "o", "d", [True, False], "w").verdict == "undecided"
    assert counted("c", "p", "o", "d", [False], "w").verdict == "not reproduced"
    assert counted("c", "p", "o", "d", [], "w").verdict == "not testable on this data"


@pytest.mark.parametrize(
    ("n_hidden", "bias", "products_and_sums"),
    [(0, False, 36), (0, True, 40), (2, False, 60), (3, True, 88)],
)
def test_operations_of_a_ksnn_are_those_of_its_equations(n_hidden, bias, products_and_sums):
    """Counted by hand in Eqs. 7 to 9: 32 without the four f, and of each f 1, 1 more for a bias, 3 a neuron and 1 more for its bias."""
    assert cost.ksnn_operations(2, n_hidden, bias=bias) == (products_and_sums, 4 * n_hidden)
    assert cost.ksnn_operations(6, n_hidden, bias=bias) == (products_and_sums, 4 * n_hidden), (
        "two modules at most are active"
    )


def test_times_in_c_are_those_that_were_published():
    published = pd.read_csv(Path(__file__).parents[2] / "results" / "export" / "metrics.csv")
    for (estimator, variant), shown in cost.IN_C_US.items():
        own = published[
            (published["family"] == estimator)
            & (published["variant"] == variant)
            & (published["drive"] == "ferrari_250lm")
        ]
        measured = float(own[own["precision"] == "double"]["c_method_ns"].iloc[0]) / 1e3
        assert shown == pytest.approx(measured, rel=0.01)
