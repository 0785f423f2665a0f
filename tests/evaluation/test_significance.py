"""Intervals and p-values of the paired block bootstrap, on losses whose differences are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats

from vehest.data.errors import DataError
from vehest.evaluation.significance import (
    Contrast,
    _degrees_of_freedom,
    differences_of_blocks,
    log_ratio_of_pooled,
    mean_contrast,
    root_intervals,
)

N_SEQUENCES = 16
LENGTH = 100
LEVEL = 1e6  # added to losses, so that roots are defined and linear in what is added to them


def losses(generator, n_seeds, seed_level=0.0):
    """Autocorrelated noise (0.95 from one sample to the next), common to the seeds,
    and a level of each seed.
    """
    white = generator.standard_normal((N_SEQUENCES, LENGTH))
    noise = signal.lfilter([1.0], [1.0, -0.95], white)
    return noise.ravel() + seed_level * generator.standard_normal((n_seeds, 1))


def compared(first, second, lengths=(LENGTH,) * N_SEQUENCES, n_resamples=400):
    """Difference of the mean losses over blocks of these lengths."""
    starts = np.cumsum([0, *lengths[:-1]])
    pair = [np.add.reduceat(losses + LEVEL, starts, axis=1) for losses in (first, second)]
    sizes = np.array(lengths, dtype=float)
    (root,) = differences_of_blocks([pair], sizes, n_resamples=n_resamples)
    scale = 2.0 * math.sqrt(LEVEL)
    return replace(root, value=scale * root.value, low=scale * root.low, high=scale * root.high)


@pytest.mark.parametrize(("n_seeds", "seed_level"), [((1, 1), 0.0), ((3, 3), 0.5), ((3, 5), 1.5)])
def test_intervals_of_equal_estimators_cover_zero_at_about_the_nominal_rate(n_seeds, seed_level):
    generator = np.random.default_rng(0)
    trials = [compared(*(losses(generator, n, seed_level) for n in n_seeds)) for _ in range(300)]
    assert 0.92 <= np.mean([trial.low <= 0.0 <= trial.high for trial in trials]) <= 0.98


def test_shift_is_significant_and_a_single_lucky_training_is_not():
    generator = np.random.default_rng(2)
    hard = np.repeat(20.0 * generator.random(N_SEQUENCES), LENGTH)
    first, second = (hard + losses(generator, 3, 0.1) for _ in range(2))
    result = compared(first - 4.0, second)
    assert result.low < -4.0 < result.high < 0.0
    assert result.p_value < 1e-3
    generator = np.random.default_rng(4)
    first = losses(generator, 3) * 0.01
    second = losses(generator, 1) * 0.01
    first[0] -= 1.0
    assert compared(first, second).p_value > 0.2
    assert compared(first[:1], second).p_value < 0.01, "but one training alone is as good as it is"


def test_single_seed_and_white_noise_give_a_paired_t_test():
    generator = np.random.default_rng(3)
    first, second = generator.standard_normal((2, 1, 60))
    first += 0.3
    result = compared(first, second, [1] * 60, n_resamples=40_000)
    expected = stats.ttest_rel(first[0], second[0])
    low, high = expected.confidence_interval()
    assert result.dof == pytest.approx(59.0)
    assert result.value == pytest.approx(first.mean() - second.mean())
    assert (result.low, result.high) == (
        pytest.approx(low, abs=0.01),
        pytest.approx(high, abs=0.01),
    )
    assert result.p_value == pytest.approx(expected.pvalue, rel=0.1)


def test_equal_losses_do_not_differ_and_a_single_block_is_refused():
    losses_of_both = np.arange(10.0)[None]
    result = compared(losses_of_both, losses_of_both, [2, 1, 2, 2, 2, 1])
    assert result.dof == 6 - 1
    assert (result.value, result.p_value) == (0.0, 1.0)
    with pytest.raises(DataError, match="1 blocks to resample"):
        compared(losses_of_both, losses_of_both, [10])


def test_pairs_compared_together_see_the_draws_that_each_sees_alone(monkeypatch):
    monkeypatch.setattr("vehest.evaluation.significance.DRAWN_AT_ONCE", 1000)  # several turns
    generator = np.random.default_rng(2)
    sizes = generator.uniform(20.0, 40.0, 12)
    sums = [sizes * generator.gamma(2.0, 1.0, (seeds, 12)) for seeds in (3, 3, 1, 2)]
    pairs = [(sums[0], second) for second in (*sums[1:], 1.1 * sums[0])]
    assert differences_of_blocks(pairs, sizes, n_resamples=400) == [
        differences_of_blocks([pair], sizes, n_resamples=400)[0] for pair in pairs
    ]
    assert root_intervals(sums, sizes) == [
        root_intervals([candidate], sizes)[0] for candidate in sums
    ]


def test_degrees_of_freedom_are_those_of_blocks_or_of_seeds():
    """Welch-Satterthwaite of one part of the variance: its own degrees of freedom.

    Of two equal ones: their sum.
    """
    sizes = np.ones(40)
    even = np.zeros((3, 40))
    of_seeds = np.array([[-1.0], [0.0], [1.0]])
    unlike_seeds = (of_seeds * sizes, of_seeds * sizes)
    assert _degrees_of_freedom(unlike_seeds, sizes) == pytest.approx(4.0)
    blocks = np.tile(np.tile([-1.0, 1.0], 20), (3, 1))
    assert _degrees_of_freedom((blocks, even), sizes) == pytest.approx(39.0)
    generator = np.random.default_rng(1)
    sizes = generator.uniform(0.5, 1.5, 40)
    first, second = generator.standard_normal((2, 40))
    first -= first.sum() / sizes.sum() * sizes
    second -= second.sum() / sizes.sum() * sizes
    a = float(np.var((first - second) / sizes.mean(), ddof=1)) / 40.0
    b = 1.0 / 3.0
    pair = (first + (of_seeds + 2.0) * sizes, second + of_seeds * sizes)
    expected = (a + 2.0 * b) ** 2 / (a**2 / 39.0 + 2.0 * b**2 / 2.0)
    assert _degrees_of_freedom(pair, sizes) == pytest.approx(expected)


def test_variance_of_a_mean_over_blocks_and_seeds_is_that_of_crossed_factors():
    """Expected squared error of the mean, worked out from the variances that the values are drawn
    with.
    """
    rng = np.random.default_rng(2)
    deviations = {"blocks": 0.5, "seeds": 0.3, "single": 0.8}
    n_seeds = 4
    n_blocks = 10
    variances = []
    covered = 0
    for _ in range(2000):
        values = (
            deviations["seeds"] * rng.normal(size=(n_seeds, 1))
            + deviations["blocks"] * rng.normal(size=n_blocks)
            + deviations["single"] * rng.normal(size=(n_seeds, n_blocks))
        )
        contrast = mean_contrast(values)
        variances.append(contrast.error**2)
        low, high = contrast.interval()
        covered += low <= 0.0 <= high
    true = 0.25 / n_blocks + 0.09 / n_seeds + 0.64 / (n_seeds * n_blocks)
    assert np.mean(variances) == pytest.approx(true, rel=0.15)
    assert 0.92 < covered / 2000 < 0.98


def test_mean_of_a_single_seed_has_the_student_interval():
    values = np.random.default_rng(3).normal(size=(1, 9))
    contrast = mean_contrast(values)
    test = stats.ttest_1samp(values[0], 0.0)
    assert contrast.p_value == pytest.approx(test.pvalue)
    assert contrast.interval(0.9) == pytest.approx(tuple(test.confidence_interval(0.9)))
    paired = mean_contrast(values + 1.0, values[:, ::-1])
    expected = stats.ttest_rel(values[0] + 1.0, values[0, ::-1])
    assert paired.p_value == pytest.approx(expected.pvalue)


def test_paired_seeds_cancel_the_shared_variation():
    rng = np.random.default_rng(4)
    shared = rng.normal(size=(3, 1))
    first = shared + 0.1 * rng.normal(size=(3, 20))
    second = shared + 0.1 * rng.normal(size=(3, 20))
    independent = mean_contrast(first, second)
    paired = mean_contrast(first, second, has_paired_seeds=True)
    assert paired.value == pytest.approx(independent.value)
    assert paired.error < 0.3 * independent.error


def test_log_ratio_of_pooled_sums_has_the_error_of_the_delta_method():
    rng = np.random.default_rng(5)
    first = rng.gamma(4.0, size=(1, 400))
    second = first * rng.gamma(20.0, 0.1, size=(1, 400))
    contrast = log_ratio_of_pooled(first, second)
    influence = (first / first.mean() - second / second.mean())[0]
    assert contrast.value == pytest.approx(math.log(first.sum() / second.sum()))
    assert contrast.error == pytest.approx(influence.std(ddof=1) / 20.0, rel=0.03)
    assert contrast.dof == pytest.approx(399.0)


def test_power_is_that_of_the_noncentral_t_and_grows_with_blocks():
    contrast = Contrast(0.3, ((0.04, 11.0), (0.004, 2.0)), 12)
    assert contrast.dof == pytest.approx(0.044**2 / (0.04**2 / 11.0 + 0.004**2 / 2.0))
    expected = stats.nct.sf(stats.t.ppf(0.975, contrast.dof), contrast.dof, 0.5 / math.sqrt(0.044))
    assert contrast.power(-0.5) == pytest.approx(expected)
    n_blocks = contrast.blocks_needed(0.5, 0.8)
    assert contrast.with_blocks(n_blocks).power(0.5) >= 0.8
    assert contrast.with_blocks(n_blocks - 1).power(0.5) < 0.8
    assert contrast.blocks_needed(0.1, 0.8) is None  # the seeds' variance alone is too large


def test_degrees_of_freedom_are_at_least_those_of_two_seeds():
    """Seeds that add nothing beyond chance must not make the interval endless."""
    rng = np.random.default_rng(0)
    contrasts = [mean_contrast(rng.normal(size=(3, 14))) for _ in range(300)]
    assert min(contrast.dof for contrast in contrasts) == 1.0
    covered = [
        low <= 0.0 <= high for low, high in (candidate.interval() for candidate in contrasts)
    ]
    assert 0.93 < np.mean(covered) <= 1.0
