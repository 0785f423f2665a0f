"""Covariances and innovations against the errors that they speak of."""

import math

import numpy as np
import pytest

from single_track_drive import NOISE, linear_drive
from vehest.data.splits import Span
from vehest.estimators.registry import estimator_class
from vehest.evaluation.consistency import COVERAGE, coverage, normalised_error_squared, normalised_innovation_squared
from vehest.evaluation.metrics import Protocol, accuracy, score

DRIVES = [linear_drive(60.0, seed=seed)[0] for seed in range(3)]


def figures_of_kalman(factor):
    """Metrics of a Kalman filter on drives of its own model, which believes noise to be ``factor`` times what it is."""
    noise = {name: factor * level for name, level in NOISE.items()} | {"steer_factor": 1.0}
    estimator = estimator_class("kalman").from_config({"noise": noise})
    estimates = estimator.estimate([drive.without_references() for drive in DRIVES])
    parts = [
        score(estimate, drive, Span("d", drive.id), Protocol(100.0, 0.0, 2.0)) for estimate, drive in zip(estimates, DRIVES, strict=True)
    ]
    assert parts[0].covariance_of == ("vy", "yaw_rate")
    return accuracy(parts)


def test_a_kalman_filter_is_consistent_on_its_own_model_and_not_with_half_the_noise():
    right, sure = figures_of_kalman(1.0), figures_of_kalman(0.5)
    assert right["nees"] == pytest.approx(1.0, abs=0.1)
    assert right["nis"] == pytest.approx(1.0, abs=0.05)
    assert right["coverage_1sigma"] == pytest.approx(COVERAGE[1], abs=0.05)
    assert right["coverage_2sigma"] == pytest.approx(COVERAGE[2], abs=0.03)
    assert sure["rmse_vy"] == pytest.approx(right["rmse_vy"]), "the gain depends on ratios of noise only"
    assert sure["nees"] == pytest.approx(4.0 * right["nees"])
    assert sure["nis"] == pytest.approx(4.0 * right["nis"])
    assert sure["coverage_2sigma"] == pytest.approx(right["coverage_1sigma"])


def test_normalised_error_squared_is_that_of_a_hand_calculation():
    errors = np.array([[1.0, 2.0], [3.0, 0.0]])
    covariance = np.array([[[2.0, 1.0], [1.0, 3.0]], [[1e-12, 0.0], [0.0, 1e6]]])
    expected = [errors[0] @ np.linalg.inv(covariance[0]) @ errors[0] / 2.0, 9e12 / 2.0]
    np.testing.assert_allclose(normalised_error_squared(errors, covariance), expected, rtol=1e-9)


def test_a_covariance_that_is_none_makes_the_error_infinite():
    improper = np.array([[[0.0, 0.0], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]]])
    squared = normalised_error_squared(np.full((4, 2), 0.5), improper)
    assert np.isinf(squared[:3]).all()
    assert squared[3] == pytest.approx(0.25)


def test_updates_without_measurements_do_not_count():
    nis, dof = np.array([0.0, 3.0, 1.0]), np.array([0.0, 4.0, 2.0])
    assert normalised_innovation_squared(nis, dof) == pytest.approx((0.75 + 0.5) / 2)
    assert math.isnan(normalised_innovation_squared(nis[:1], dof[:1]))


def test_errors_on_the_edge_of_a_band_are_inside_it():
    assert coverage(np.array([0.1, -2.0, 2.0, 3.0]), np.ones(4), 2.0) == 0.75
