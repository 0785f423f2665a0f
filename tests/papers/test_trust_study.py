"""Regions of the Stanford diagram, alarms, and how often 0.90 lies in the interval of a
coverage.
"""

import math

import numpy as np
import pytest
from scipy import stats

from vehest_papers.trust.integrity import (
    HAZARDOUS,
    MISLEADING,
    NOMINAL,
    UNAVAILABLE,
    false_alarms_per_hour,
    integrity_of,
)
from vehest_papers.trust.shuffled import Scores, share_if_shuffled, together


@pytest.mark.parametrize(
    ("error", "level", "flagged", "region"),
    [
        (0.5, 1.0, False, NOMINAL),
        (-0.5, 1.0, False, NOMINAL),
        (1.5, 1.0, False, MISLEADING),
        (-2.5, 1.0, False, HAZARDOUS),
        (2.5, 3.0, False, UNAVAILABLE),
        (5.0, 3.0, False, UNAVAILABLE),
        (2.5, 1.0, True, UNAVAILABLE),
    ],
)
def test_each_sample_lies_in_its_region(error, level, flagged, region):
    integrity = integrity_of(np.array([error]), np.array([level]), np.array([flagged]))
    assert integrity.shares()[region] == 1.0
    assert sum(integrity.shares().values()) == 1.0


def test_consecutive_alarms_count_once_and_samples_without_a_band_never():
    integrity = integrity_of(
        np.array([0.1, np.nan, 0.1]), np.array([1.0, 1.0, np.nan]), np.zeros(3, bool)
    )
    assert len(integrity.error) == 1
    rate = false_alarms_per_hour([alarmed(10, 20, 500, 501), alarmed(0, 5)], 10.0)
    assert (rate.alarms, rate.hours) == (3, 2.0)
    assert stats.poisson.sf(2, rate.low * 2.0) == pytest.approx(0.025)
    assert stats.poisson.cdf(3, rate.high * 2.0) == pytest.approx(0.025)
    quiet_rate = false_alarms_per_hour([np.zeros(54_000, bool)], 10.0)
    assert (quiet_rate.low, quiet_rate.high) == (0.0, pytest.approx(-math.log(0.025) / 1.5))


def alarmed(*edges):
    """An hour at 10 Hz that is flagged from each odd edge to the next one."""
    return np.searchsorted(edges, np.arange(36_000), side="right") % 2 == 1


def scores(manoeuvres, common_share, seed):
    """Sizes of Gaussian errors, of which a share of the variance is one number a manoeuvre."""
    generator = np.random.default_rng(seed)
    labels = np.repeat(np.arange(manoeuvres), 40)
    common = generator.standard_normal(manoeuvres)[labels]
    errors = np.sqrt(common_share) * common + np.sqrt(
        1.0 - common_share
    ) * generator.standard_normal(len(labels))
    return Scores(np.abs(errors), labels)


def test_few_manoeuvres_that_say_all_hold_less_often_than_many_that_say_nothing():
    coverage_of_many = np.mean(
        [
            share_if_shuffled(scores(150, 0.0, seed), scores(30, 0.0, 100 + seed), 60, seed)
            for seed in range(5)
        ]
    )
    coverage_of_few = np.mean(
        [
            share_if_shuffled(scores(9, 0.6, seed), scores(8, 0.6, 100 + seed), 60, seed)
            for seed in range(5)
        ]
    )
    assert coverage_of_many > 0.9
    assert coverage_of_few < coverage_of_many - 0.05


def test_draws_are_repeatable_and_pooled_tests_have_a_narrower_interval():
    calibration = scores(8, 0.4, 1)
    test = scores(8, 0.4, 2)
    louder = Scores(3.0 * test.values, test.manoeuvres)
    assert share_if_shuffled(calibration, test, 50) == share_if_shuffled(calibration, test, 50)
    assert share_if_shuffled(calibration, louder, 200) == pytest.approx(
        share_if_shuffled(louder, calibration, 200), abs=0.12
    )
    assert np.isnan(share_if_shuffled(scores(8, 0.4, 1), scores(2, 0.4, 2)))
    tests = [scores(10, 0.3, seed) for seed in range(5)]
    share = together(tests)[0]
    assert share == pytest.approx(
        np.mean([np.mean(test_scores.values <= 1.0) for test_scores in tests])
    )
    alone = together(tests[:1])
    fourfold = together(tests[:1] * 4)
    assert fourfold[0] == pytest.approx(alone[0])
    assert fourfold[2] - fourfold[1] < 0.55 * (alone[2] - alone[1])
