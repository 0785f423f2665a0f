"""Scores of bands, covariances, innovations, delays and misses of detections against closed forms
and simulations.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from single_track_drive import NOISE, linear_drive
from vehest.data.splits import Span
from vehest.estimators.registry import estimator_class
from vehest.evaluation.bands import (
    band_figures,
    coverage_intervals,
    crps_of_levels,
    figures_by_regime,
    interval_score,
    proportion_interval,
    scored_bands,
)
from vehest.evaluation.metrics import (
    COVERAGE,
    UNITS,
    Protocol,
    Scored,
    accuracy,
    coverage,
    normalised_error_squared,
    normalised_innovation_squared,
    score,
)
from vehest.evaluation.under_fault import detection_delay, error_while_undetected
from vehest.trust.bands import LEVELS, Bands, Quantity, intraclass_correlation

GAUSSIAN = stats.norm.ppf([0.5 + 0.5 * level for level in LEVELS])
UNIT = Quantity({"one": 1.0}, 0.01, tuple(GAUSSIAN.tolist()), (False,) * 4, 9.0)
BANDS = Bands(("car",), ("mine",), (), ("two (all)",), "turn", 9, 100.0, ("vx",), 0, {}, UNIT, UNIT)


def part_of(rng, seconds=100.0, deviation=0.1):
    """White Gaussian errors of v at 20 m/s, and true 90 % bands."""
    n = round(20.0 * seconds)
    vy = rng.standard_normal(n)
    vx = np.full(n, 20.0)
    error = deviation * rng.standard_normal(n)
    half = np.full(n, deviation * GAUSSIAN[2])
    angles = np.arctan2(vy + error, vx), np.arctan2(vy, vx)
    bands = {"vy": half, "sideslip": np.arctan2(half, vx)}
    return Scored(
        np.arange(n) / 20.0,
        vy + error,
        vy,
        *angles,
        rng.uniform(0.0, 5.0, n),
        np.ones(n, dtype=bool),
        bands=bands,
    )


def test_interval_score_of_a_gaussian_matches_its_closed_form():
    """E = 2σ(z + (2/α)(φ(z) - z(1 - Φ(z)))) for the central interval of half width zσ.

    Each side misses with the same.
    """
    errors = np.random.default_rng(0).standard_normal(400_000)
    for level in (0.5, 0.9):
        z = stats.norm.ppf(0.5 + 0.5 * level)
        expected = 2.0 * z + 2.0 / (1.0 - level) * 2.0 * (stats.norm.pdf(z) - z * stats.norm.sf(z))
        score = interval_score(errors, np.full_like(errors, z), level)
        assert score.mean() == pytest.approx(
            expected, abs=4.0 * score.std() / math.sqrt(len(score))
        )
    errors = np.random.default_rng(1).standard_normal(100_000)
    scores = [
        interval_score(errors, np.full_like(errors, width * GAUSSIAN[2]), 0.9).mean()
        for width in (0.7, 1.0, 1.4)
    ]
    assert scores[1] == min(scores)


def crps_of_gaussian(z):
    """σ(z(2Φ(z) - 1) + 2φ(z) - 1/√π) at σ = 1 (Gneiting & Raftery 2007, Eq. 21)."""
    return z * (2.0 * stats.norm.cdf(z) - 1.0) + 2.0 * stats.norm.pdf(z) - 1.0 / math.sqrt(math.pi)


def test_crps_of_levels_is_that_of_a_gaussian_or_a_little_below():
    z = np.linspace(-5.0, 5.0, 2001)
    exact = crps_of_gaussian(z)
    scores = crps_of_levels(z, np.tile(GAUSSIAN, (len(z), 1)), LEVELS)
    np.testing.assert_allclose(scores[np.abs(z) < 2.0], exact[np.abs(z) < 2.0], atol=0.045)
    weight = stats.norm.pdf(z) / stats.norm.pdf(z).sum()
    assert weight @ exact == pytest.approx(1.0 / math.sqrt(math.pi), rel=1e-3)
    assert weight @ scores == pytest.approx((weight @ exact) * (1.0 - 0.026), rel=1e-3)
    levels = np.arange(0.002, 0.9999, 0.002)
    z = np.linspace(-2.0, 2.0, 41)
    exact = crps_of_gaussian(z)
    half = np.tile(stats.norm.ppf(0.5 + 0.5 * levels), (len(z), 1))
    np.testing.assert_allclose(crps_of_levels(z, half, levels.tolist()), exact, atol=1e-3)


def test_intraclass_correlation_of_planted_variances():
    rng = np.random.default_rng(2)
    labels = np.repeat(np.arange(3000), rng.integers(5, 15, 3000))
    values = math.sqrt(0.3) * rng.standard_normal(3000)[labels] + math.sqrt(
        0.7
    ) * rng.standard_normal(len(labels))
    assert intraclass_correlation(values, labels) == pytest.approx(0.3, abs=0.03)
    assert intraclass_correlation(labels.astype(float), labels) == pytest.approx(1.0)
    assert math.isnan(intraclass_correlation(values, np.zeros(len(values), dtype=int)))


def test_coverage_intervals_contain_the_truth_with_correlated_blocks():
    """2000 test sets of 12 blocks with coverage drawn from a beta distribution of mean 0.9.

    Three standard errors are 0.015.
    """
    rng = np.random.default_rng(3)
    n_covered = 0
    for _ in range(2000):
        sizes = rng.integers(50, 150, 12).astype(float)
        sums = rng.binomial(sizes.astype(int), rng.beta(4.5, 0.5, 12)).astype(float)
        low, high = proportion_interval(sums, sizes)
        n_covered += low <= 0.9 <= high
    assert n_covered / 2000 >= 0.95 - 0.015


def test_interval_of_full_coverage_matches_single_sample_blocks_and_counts_edges():
    low, high = proportion_interval(np.full(10, 50.0), np.full(10, 50.0))
    assert low == pytest.approx(0.025 ** (1.0 / 10.0))  # Clopper & Pearson for 10 of 10
    assert high == 1.0
    nis = np.array([0.0, 3.0, 1.0])
    dof = np.array([0.0, 4.0, 2.0])
    assert normalised_innovation_squared(nis, dof) == pytest.approx((0.75 + 0.5) / 2)
    assert math.isnan(normalised_innovation_squared(nis[:1], dof[:1]))
    assert coverage(np.array([0.1, -2.0, 2.0, 3.0]), np.ones(4), 2.0) == 0.75


def test_true_bands_have_their_nominal_coverage():
    rng = np.random.default_rng(4)
    parts = [part_of(rng), part_of(rng)]
    banded_errors = scored_bands(parts, BANDS)
    turns = [np.sin(part.time) for part in parts]
    figures = band_figures(banded_errors, parts, turns, 20.0)
    assert set(figures) <= set(UNITS)
    for suffix in ("", "_vy"):
        for level in LEVELS:
            assert figures[f"coverage_{100 * level:.0f}{suffix}"] == pytest.approx(level, abs=0.03)
        assert figures[f"coverage_90_p10{suffix}"] < 0.9 < figures[f"coverage_90_p90{suffix}"]
        assert abs(figures[f"error_icc{suffix}"]) < 0.02
    assert figures["width_90_vy"] == pytest.approx(2.0 * 0.1 * GAUSSIAN[2])
    assert figures["width_90"] == pytest.approx(
        math.degrees(figures["width_90_vy"] / 20.0), rel=1e-3
    )
    assert figures["crps_vy"] == pytest.approx(0.1 / math.sqrt(math.pi), rel=0.05)
    intervals = coverage_intervals(banded_errors, parts, 20.0)
    assert set(intervals) == {
        f"coverage_{100 * level:.0f}{suffix}" for level in LEVELS for suffix in ("", "_vy")
    }
    low, high = intervals["coverage_90"]
    assert low < figures["coverage_90"] < high


def test_bands_of_sideslip_are_judged_where_it_is_scored_alone():
    """The second half stands still, with errors far outside of the bands."""
    part = part_of(np.random.default_rng(3), seconds=800.0)
    half = len(part.time) // 2
    is_scored = np.arange(len(part.time)) < half
    sideslip = np.where(is_scored, part.sideslip, 3.0)
    stopping = replace(part, sideslip=sideslip, is_sideslip_scored=is_scored)
    moving = replace(part.at(slice(half)), bands={q: b[:half] for q, b in part.bands.items()})
    figures_of_parts = []
    for drive in (moving, stopping):
        within = scored_bands([drive], BANDS)
        figures = band_figures(within, [drive], [None], 20.0)
        figures_of_parts.append((figures, coverage_intervals(within, [drive], 20.0)))
    for name in ("coverage_90", "width_90", "interval_score", "crps"):
        assert figures_of_parts[1][0][name] == pytest.approx(
            figures_of_parts[0][0][name], rel=1e-12
        )
    assert figures_of_parts[1][0]["coverage_90"] == pytest.approx(0.9, abs=0.03)
    assert figures_of_parts[1][1]["coverage_90"] == pytest.approx(
        figures_of_parts[0][1]["coverage_90"], rel=1e-12
    )
    assert figures_of_parts[1][0]["width_90_vy"] == pytest.approx(
        2.0 * 0.1 * GAUSSIAN[2], rel=1e-12
    )
    nothing = replace(part, is_sideslip_scored=np.zeros(len(part.time), dtype=bool))
    within = scored_bands([nothing], BANDS)
    assert set(band_figures(within, [nothing], [None], 20.0)) == {
        name for name in figures_of_parts[0][0] if name.endswith("_vy")
    }


def test_figures_by_lateral_acceleration_omit_rare_ranges():
    part = part_of(np.random.default_rng(5))
    names = {
        "ay_0_2": (0.0, 2.0),
        "ay_2_4": (2.0, 4.0),
        "ay_4_6": (4.0, 6.0),
        "ay_6_": (6.0, math.inf),
    }
    masks = {name: (part.ay >= low) & (part.ay < high) for name, (low, high) in names.items()}
    figures = figures_by_regime(scored_bands([part], BANDS), [masks], 20.0)
    assert set(figures) == {"ay_0_2", "ay_2_4", "ay_4_6"}
    assert figures["ay_0_2"]["coverage_90"] == pytest.approx(0.9, abs=0.05)


def flags(length, *spans):
    flagged = np.zeros(length, bool)
    for begin, end in spans:
        flagged[begin:end] = True
    return flagged


def test_delays_and_errors_of_detections_count_from_the_fault_to_the_flag():
    assert detection_delay(flags(100, (5, 8), (30, 40)), 20, 100, 10.0) == pytest.approx(1.1)
    assert detection_delay(flags(100, (5, 8)), 20, 100, 10.0) == math.inf
    error = np.array([9.0, 9.0, 3.0, -4.0, 9.0, 9.0])
    assert error_while_undetected(error, flags(6, (4, 6)), 2, 6) == 4.0
    assert error_while_undetected(error, flags(6, (2, 6)), 2, 6) == 0.0


DRIVES = [linear_drive(60.0, seed=seed)[0] for seed in range(3)]


def figures_of_kalman(factor):
    """Metrics of a Kalman filter on drives of its own model, which believes noise to be ``factor``
    times what it is.
    """
    noise = {name: factor * level for name, level in NOISE.items()} | {"steer_factor": 1.0}
    estimator = estimator_class("kalman").from_config({"noise": noise})
    estimates = estimator.estimate([drive.without_references() for drive in DRIVES])
    parts = [
        score(estimate, drive, Span("d", drive.id), Protocol(100.0, 0.0, 2.0))
        for estimate, drive in zip(estimates, DRIVES, strict=True)
    ]
    assert parts[0].covariance_of == ("vy", "yaw_rate")
    return accuracy(parts)


def test_kalman_filter_is_consistent_with_true_but_not_with_half_the_noise():
    right = figures_of_kalman(1.0)
    sure = figures_of_kalman(0.5)
    assert right["nees"] == pytest.approx(1.0, abs=0.1)
    assert right["nis"] == pytest.approx(1.0, abs=0.05)
    assert right["coverage_1sigma"] == pytest.approx(COVERAGE[1], abs=0.05)
    assert right["coverage_2sigma"] == pytest.approx(COVERAGE[2], abs=0.03)
    assert sure["rmse_vy"] == pytest.approx(right["rmse_vy"]), (
        "the gain depends on ratios of noise only"
    )
    assert sure["nees"] == pytest.approx(4.0 * right["nees"])
    assert sure["nis"] == pytest.approx(4.0 * right["nis"])
    assert sure["coverage_2sigma"] == pytest.approx(right["coverage_1sigma"])


def test_normalised_errors_match_a_hand_calculation():
    errors = np.array([[1.0, 2.0], [3.0, 0.0]])
    covariance = np.array([[[2.0, 1.0], [1.0, 3.0]], [[1e-12, 0.0], [0.0, 1e6]]])
    expected = [errors[0] @ np.linalg.inv(covariance[0]) @ errors[0] / 2.0, 9e12 / 2.0]
    np.testing.assert_allclose(normalised_error_squared(errors, covariance), expected, rtol=1e-9)
    improper = np.array(
        [
            [[0.0, 0.0], [0.0, 1.0]],
            [[1.0, 2.0], [2.0, 1.0]],
            [[-1.0, 0.0], [0.0, 1.0]],
            [[1.0, 0.0], [0.0, 1.0]],
        ]
    )
    squared = normalised_error_squared(np.full((4, 2), 0.5), improper)
    assert np.isinf(squared[:3]).all()
    assert squared[3] == pytest.approx(0.25)
