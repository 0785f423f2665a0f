"""Each verdict of the engine, on errors whose statistics are worked out by scipy or by hand."""

import math

import numpy as np
import pytest
from scipy import stats

from vehest.data.errors import DataError
from vehest_papers.kit.block_errors import BlockErrors, Key, Training
from vehest_papers.kit.claim_files import Claim, Paper, Row, Table
from vehest_papers.kit.verdicts import judge_paper, judge_row, least_training

N = 12
LEVELS = np.exp(np.linspace(-1.0, 1.0, N))  # what is difficult for one is for the other
SPREAD = np.tile([-0.1, 0.1, 0.0, 0.2, -0.2, 0.0], 2)  # of the log ratio over blocks, mean 0


def errors_of(sums, sizes=None):
    sums = np.atleast_2d(np.asarray(sums, float))
    return BlockErrors(
        tuple(str(seed) for seed in range(len(sums))),
        tuple(str(block) for block in range(sums.shape[1])),
        sums,
        np.full(sums.shape[1], 100.0) if sizes is None else np.asarray(sizes, float),
    )


def studied(metric="mse", **candidates):
    return {
        Key("real", name, "test", metric): value
        if isinstance(value, BlockErrors)
        else errors_of(value)
        for name, value in candidates.items()
    }


def claim_of(kind="order", **changes):
    fields = {
        "id": "it",
        "claim": "a is better than b",
        "source": "Table I",
        "kind": kind,
        "candidate": "a",
        "part": "real",
        "test_set": "test",
        "metric": "mse",
    }
    if kind == "order":
        fields |= {"other": "b", "direction": "lower"}
    return Claim(**(fields | changes))


def judged(claim, blocks, training=None, *more):
    paper = Paper("", "", "", "", "", {}, {}, {}, [claim, *more], [])
    return judge_paper(paper, blocks, training or {})[claim.id]


def ratio(value, spread=SPREAD):
    return LEVELS * value * np.exp(spread)


def test_order_is_student_s_test_of_log_ratios_over_blocks():
    verdict = judged(claim_of(ratio=0.6), studied(a=ratio(0.6), b=LEVELS))
    expected = stats.ttest_1samp(math.log(0.6) + SPREAD, 0.0)
    assert verdict.p_value == pytest.approx(expected.pvalue, rel=1e-9)
    low, high = expected.confidence_interval(0.95)
    assert verdict.order.value == pytest.approx(0.6)
    assert verdict.order.low == pytest.approx(math.exp(low), rel=1e-9)
    assert verdict.order.high == pytest.approx(math.exp(high), rel=1e-9)
    assert verdict.verdict == "reproduced"
    assert verdict.size.value == pytest.approx(ratio(0.6).sum() / LEVELS.sum())


def test_root_metrics_have_the_root_of_both_ratios():
    squares = judged(claim_of(ratio=0.6), studied(a=ratio(0.6), b=LEVELS))
    roots = judged(
        claim_of(metric="rmse_vy", ratio=0.77), studied("rmse_vy", a=ratio(0.6), b=LEVELS)
    )
    assert roots.order.value == pytest.approx(math.sqrt(squares.order.value))
    assert roots.size.low == pytest.approx(math.sqrt(squares.size.low))
    assert roots.values["a"].value == pytest.approx(math.sqrt(ratio(0.6).sum() / (100.0 * N)))


def test_size_of_the_paper_outside_the_interval_is_direction_only():
    blocks = studied(a=ratio(0.6), b=LEVELS)
    assert judged(claim_of(ratio=0.2), blocks).verdict == "direction only"
    assert judged(claim_of(), blocks).verdict == "reproduced"  # no size is stated
    published = {"a": 1.0, "b": 5.0}  # the size that two tabulated values give
    assert judged(claim_of(published=published), blocks).verdict == "direction only"


def test_significant_in_the_other_direction_is_contradicted():
    blocks = studied(a=ratio(1.5), b=LEVELS)
    assert judged(claim_of(), blocks).verdict == "contradicted"
    assert judged(claim_of(direction="higher"), blocks).verdict == "reproduced"


def test_no_significant_difference_states_power_and_blocks_needed():
    spread = 8.0 * SPREAD
    verdict = judged(claim_of(ratio=0.6), studied(a=ratio(0.9, spread), b=LEVELS))
    assert verdict.verdict == "no significant difference"
    error = spread.std(ddof=1) / math.sqrt(N)
    critical = stats.t.ppf(0.975, N - 1)
    noncentrality = abs(math.log(0.6)) / error
    assert verdict.power == pytest.approx(stats.nct.sf(critical, N - 1, noncentrality), rel=1e-6)

    def power_with(n):
        shift = abs(math.log(0.6)) / (spread.std(ddof=1) / math.sqrt(n))
        return stats.nct.sf(stats.t.ppf(0.975, n - 1), n - 1, shift)

    assert power_with(verdict.blocks_needed) >= 0.8 > power_with(verdict.blocks_needed - 1)


def test_more_blocks_cannot_compensate_for_seeds_that_differ():
    rng = np.random.default_rng(0)
    seeds = np.exp(np.array([[-1.0], [1.0]]) + 0.01 * rng.normal(size=(2, N))) * LEVELS
    verdict = judged(claim_of(ratio=0.8), studied(a=seeds, b=LEVELS))
    assert verdict.verdict == "no significant difference"
    assert verdict.blocks_needed is None
    assert "more seeds" in verdict.reason


def test_blocks_and_pooled_errors_that_disagree_are_no_significant_difference():
    sums = LEVELS * 0.7
    sums[-1] = 100.0 * LEVELS[-1]
    values = np.log(sums / LEVELS)
    values[:-1] += 0.001 * np.arange(N - 1)
    block_errors = np.concatenate([np.exp(values)[:-1].repeat(4), [60.0]])
    verdict = judged(claim_of(), studied(a=block_errors, b=np.ones(len(block_errors))))
    assert stats.ttest_1samp(np.log(block_errors), 0.0).pvalue < 0.05
    assert verdict.order.value < 1.0 < verdict.size.value
    assert verdict.verdict == "no significant difference"


def test_claim_that_zero_meets_too_is_met_by_a_trivial_baseline():
    blocks = studied(a=ratio(0.5), b=LEVELS, zero=ratio(0.7))
    verdict = judged(claim_of(ratio=0.5), blocks)
    assert verdict.verdict == "met by a trivial baseline"
    assert "zero" in verdict.reason
    worse = studied(a=ratio(0.5), b=LEVELS, zero=ratio(1.3), static_map=ratio(1.0))
    assert judged(claim_of(ratio=0.5), worse).verdict == "reproduced"


def test_weakness_that_a_baseline_does_not_share_is_reproduced():
    """ "b has a higher error than a" is on b: that zero is better than b, too, confirms it."""
    blocks = studied(a=ratio(0.5), b=LEVELS, zero=ratio(0.7))
    weakness = claim_of(candidate="b", other="a", direction="higher", ratio=2.0)
    assert judged(weakness, blocks).verdict == "reproduced"


def test_not_testable_comes_before_everything():
    claim = Claim("it", "", "Table I", not_testable="recordings of tyre C are not public")
    assert judged(claim, None).verdict == "not testable"
    assert judged(claim_of(), None).verdict == "not assessed"
    assert judged(claim_of(other="absent"), studied(a=LEVELS)).verdict == "not assessed"


def test_holm_corrects_within_a_family_only():
    spread = 2.0 * SPREAD
    shift = 1.05 * stats.t.ppf(0.975, N - 1) * spread.std(ddof=1) / math.sqrt(N)  # p about 0.04
    blocks = studied(
        a=ratio(math.exp(-shift), spread), b=LEVELS, c=ratio(math.exp(shift), spread[::-1])
    )
    alone = judged(claim_of(family="x"), blocks, None, claim_of(id="2", other="c", family="y"))
    together = judged(
        claim_of(family="x"), blocks, None, claim_of(id="2", candidate="b", other="c", family="x")
    )
    assert alone.verdict == "reproduced"
    assert together.verdict == "no significant difference"
    assert together.p_value == pytest.approx(2.0 * alone.p_value)


@pytest.mark.parametrize(
    ("value", "spread", "verdict"),
    [(1.02, 0.1, "reproduced"), (1.4, 1.0, "contradicted"), (1.05, 2.0, "inconclusive")],
)
def test_equality_by_its_90_percent_interval(value, spread, verdict):
    blocks = studied(a=ratio(value, spread * SPREAD), b=LEVELS)
    judgement = judged(claim_of("equal", other="b"), blocks)
    assert judgement.verdict == verdict
    assert (judgement.blocks_needed is not None) == (verdict == "inconclusive")


@pytest.mark.parametrize(
    ("limit", "verdict"), [(1.5, "reproduced"), (1.0, "inconclusive"), (0.5, "contradicted")]
)
def test_limit_by_the_95_percent_interval_of_the_value(limit, verdict):
    sums = 100.0 * ratio(1.0, 0.0 * SPREAD) / LEVELS.mean()
    claim = claim_of("limit", direction="lower", limit=limit)
    judgement = judged(claim, studied(a=sums))
    assert judgement.values["a"].value == pytest.approx(1.0)
    relative = LEVELS / LEVELS.mean()
    # by the delta method: error of the logarithm of a mean is its relative error
    half = stats.t.ppf(0.975, N - 1) * relative.std(ddof=1) / math.sqrt(N)
    assert judgement.values["a"].high == pytest.approx(math.exp(half), rel=0.02)
    assert judgement.verdict == verdict
    trivial = judged(claim, studied(a=sums, zero=0.9 * sums))
    assert trivial.verdict == (verdict if limit < 1.5 else "met by a trivial baseline")


def test_equality_to_a_value_and_value_of_a_table():
    blocks = studied(a=100.0 * np.exp(SPREAD / 4.0))
    claim = claim_of("equal", limit=1.0, margin=0.2)
    assert judged(claim, blocks).verdict == "reproduced"
    table = Table("Table I", "real", "test", [])
    for published, verdict in ((1.0, "reproduced"), (2.0, "contradicted"), (1.105, "inconclusive")):
        assert judge_row(Row("a", "mse", published, "1"), table, blocks, {}).verdict == verdict
    assert judge_row(Row("a", "mse", 1.0, "1"), table, None, {}).verdict == "not assessed"


def test_measured_values_are_judged_by_student_s_interval_of_their_mean():
    values = 1.5 + SPREAD
    sums = errors_of(values, np.ones(N))
    blocks = studied("it", a=sums)
    claim = claim_of("measured", metric="", direction="lower", limit=2.0, measure="m:f", unit="s")
    judgement = judged(claim, blocks)
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert (judgement.values["a"].low, judgement.values["a"].high) == pytest.approx((low, high))
    assert judgement.verdict == "reproduced"
    for limit, verdict in ((1.0, "contradicted"), (1.5, "inconclusive")):
        turned = claim_of("measured", metric="", direction="lower", limit=limit, measure="m:f")
        assert judged(turned, blocks).verdict == verdict
    assert judged(claim, studied("other", a=sums)).verdict == "not assessed"


def test_diverged_blocks_are_left_out_and_counted():
    first = np.stack([ratio(0.5), ratio(0.5)])
    second = np.stack([LEVELS, LEVELS])
    second[1, 3] = np.inf
    verdict = judged(claim_of(), studied(a=first, b=second))
    assert verdict.verdict == "reproduced"
    assert verdict.n_blocks == N - 1
    assert verdict.diverged == {"a": 0, "b": 1}
    assert "b diverged in 1 of the pairs" in verdict.reason
    # whoever wins where it survives, but diverges more often, has not won
    first[0, :2] = np.nan
    verdict = judged(claim_of(), studied(a=first, b=second))
    assert verdict.verdict == "no significant difference"
    assert "diverges in more" in verdict.reason


def test_a_single_block_gives_values_but_no_significance_test():
    blocks = studied(a=[[1.0]], b=[[2.0]])
    verdict = judged(claim_of(), blocks)
    assert verdict.verdict == "no significant difference"
    assert "1 block" in verdict.reason
    assert verdict.values["a"].value == pytest.approx(0.01)
    assert math.isnan(verdict.values["a"].low)
    limit = claim_of("limit", direction="lower", limit=1.0)
    assert judged(limit, blocks).verdict == "inconclusive"


def test_candidate_that_was_trained_once_gets_no_verdict():
    trained = {
        "a": Training("10", "1000", "insufficient", ""),
        "b": Training("", "", "not applicable", ""),
    }
    verdict = judged(claim_of(), studied(a=ratio(0.5), b=LEVELS), trained)
    assert verdict.verdict == "no significant difference"
    assert "a has one seed" in verdict.reason
    twice = studied(a=[ratio(0.5), ratio(0.5)], b=LEVELS)
    assert judged(claim_of(), twice, trained).verdict == "reproduced"
    limit = claim_of("limit", direction="lower", limit=1.0)
    assert judged(limit, studied(a=LEVELS), trained).verdict == "inconclusive"
    assert judged(limit, studied(a=LEVELS), {}).verdict == "reproduced"


def test_untrained_candidates_are_named_and_missing_seeds_counted():
    trained = {
        "a": Training("10", "1000", "not checked", "", 5),
        "b": Training("", "1000", "not trained", "", 5),
    }
    twice = studied(a=[ratio(0.5), ratio(0.5)])
    verdict = judged(claim_of(), twice, trained)
    assert (verdict.verdict, verdict.reason) == ("not assessed", "b is not trained")
    assert judged(claim_of(), {}, trained).reason == "b is not trained"
    trained["b"] = Training("10", "1000", "not checked", "", 0)
    verdict = judged(claim_of(), studied(a=[ratio(0.5), ratio(0.5)], b=[LEVELS] * 5), trained)
    assert verdict.verdict == "reproduced"
    assert verdict.reason.endswith("; a with 2 of 5 seeds")
    assert "no per-block errors of b" in judged(claim_of(), twice, {}).reason


def test_a_claim_has_the_training_of_its_least_trained_candidate():
    trained = {
        "a": Training("10", "1000", "insufficient", ""),
        "b": Training("1000", "1000", "sufficient", ""),
    }
    assert least_training(claim_of(), trained) == ("a", trained["a"])
    assert least_training(claim_of(), {"b": trained["b"]})[1].state == "not checked"


def test_same_trainings_are_compared_seed_by_seed():
    level = np.exp([[-0.5], [0.0], [0.5]])
    noise = np.exp(0.02 * np.random.default_rng(1).normal(size=(3, N)))
    blocks = studied(a=0.9 * level * LEVELS * noise, b=level * LEVELS)
    assert judged(claim_of(), blocks).verdict == "no significant difference"
    assert judged(claim_of(same_trainings=True), blocks).verdict == "reproduced"


def test_blocks_that_do_not_match_are_refused():
    blocks = studied(a=LEVELS, b=errors_of(LEVELS[:-1]))
    with pytest.raises(DataError, match=r"claim .it.: .*different blocks"):
        judged(claim_of(), blocks)
    blocks = studied(a=LEVELS, b=errors_of(LEVELS, np.full(N, 50.0)))
    with pytest.raises(DataError, match="different sizes"):
        judged(claim_of(), blocks)


def test_measured_weights_have_an_interval_over_their_trainings():
    """A value a seed and one block: Student's t over seeds; with two seeds there is no interval."""
    values = np.array([0.80, 0.84, 0.79, 0.83, 0.81])
    claim = claim_of(
        "measured", id="leak", metric="", direction="lower", limit=1.0, measure="weights:leak"
    )
    blocks = {Key("real", "a", "test", "leak"): errors_of(values[:, None], [1.0])}
    verdict = judged(claim, blocks)
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert verdict.verdict == "reproduced"
    assert (verdict.values["a"].low, verdict.values["a"].high) == pytest.approx((low, high))
    two_trainings = {Key("real", "a", "test", "leak"): errors_of(values[:2, None], [1.0])}
    assert judged(claim, two_trainings).verdict == "inconclusive"
