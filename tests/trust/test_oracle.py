"""The oracle against closed forms, and the autoregression against a planted one."""

import math

import numpy as np
import pytest
from measured_drive import CHANNELS, RATE, measured_drive
from refusals import refusal

from vehest.trust.autoregression import Autoregression, fit_autoregression, learn_noise_levels
from vehest_papers.trust.oracle import filtered, learn_oracle, levels_at, signature_test

COEFFICIENTS = np.array([[[0.6, 0.2], [-0.1, 0.5]], [[0.2, 0.0], [0.1, 0.3]]])
COVARIANCE = np.array([[1.0, 0.3], [0.3, 0.5]])


def planted(samples, seed=0):
    """Samples of an autoregression of order 2 around (3, -1)."""
    generator = np.random.default_rng(seed)
    noise = generator.multivariate_normal(np.zeros(2), COVARIANCE, samples)
    series = np.zeros((samples, 2))
    for k in range(2, samples):
        series[k] = COEFFICIENTS[0] @ series[k - 1] + COEFFICIENTS[1] @ series[k - 2] + noise[k]
    return series + np.array([3.0, -1.0])


def test_the_planted_autoregression_and_its_order_are_fitted_despite_outliers():
    model = fit_autoregression([planted(20_000, seed) for seed in range(2)], max_order=6)
    assert model.order == 2
    np.testing.assert_allclose(model.coefficients, COEFFICIENTS, atol=0.03)
    np.testing.assert_allclose(model.covariance, COVARIANCE, atol=0.03)
    np.testing.assert_allclose(
        np.linalg.solve(np.eye(2) - model.coefficients.sum(0), model.constant),
        [3.0, -1.0],
        atol=0.4,
    )
    samples = planted(20_000)
    samples[[500, 7000, 12_000], 0] += 500.0
    np.testing.assert_allclose(
        fit_autoregression([samples], max_order=4).coefficients[:2], COEFFICIENTS, atol=0.05
    )
    assert "too few for an autoregression of order 10 in 2 channels" in refusal(
        lambda: fit_autoregression([planted(60)], max_order=10)
    )


def test_innovations_move_by_the_filtered_signature():
    model = fit_autoregression([planted(5000)], max_order=4)
    healthy = planted(300, seed=5)
    signature = np.zeros((300, 2))
    signature[100:, 1] = np.linspace(0.0, 5.0, 200)
    moved = model.innovations(healthy + signature) - model.innovations(healthy)
    np.testing.assert_allclose(
        moved[model.order :], filtered(model, signature)[model.order :], atol=1e-9
    )
    model = Autoregression(np.zeros(1), np.array([[[0.5]], [[0.1]]]), np.ones((1, 1)))
    innovations = model.innovations(np.arange(5.0)[:, None])[:, 0]
    np.testing.assert_allclose(
        innovations[2:], [2 - 0.5 * 1 - 0.1 * 0, 3 - 0.5 * 2 - 0.1 * 1, 4 - 0.5 * 3 - 0.1 * 2]
    )
    assert np.isnan(innovations[:2]).all()


def test_noise_levels_that_grow_with_speed_are_recovered():
    generator = np.random.default_rng(0)
    speed = generator.uniform(10.0, 50.0, 50_000)
    levels = learn_noise_levels(
        (speed / 30.0 * generator.standard_normal(50_000))[:, None], np.ones((1, 1)), speed, 5
    )
    np.testing.assert_allclose(
        levels_at(levels, np.array([15.0, 30.0, 45.0]))[:, 0], [0.5, 1.0, 1.5], rtol=0.05
    )


def test_a_correlated_channel_shortens_the_delay_as_the_information_says():
    generator = np.random.default_rng(2)
    covariance = np.array([[1.0, 0.9], [0.9, 1.0]])
    signature = np.tile([0.1, 0.0], (6000, 1))
    power = float(signature[0] @ np.linalg.solve(covariance, signature[0]))
    test = signature_test(signature, covariance)
    delays = []
    for _ in range(200):
        above = (
            np.cumsum(
                test(generator.multivariate_normal(np.zeros(2), covariance, 6000) + signature)
            )
            > 6.0
        )
        delays.append(
            int(np.flatnonzero(above)[0]) + 1
        )  # samples from the onset of a known fault to its alarm
    delay_samples = np.array(delays, np.float64)
    assert abs(
        delay_samples.mean() - (12.0 / power + 0.583 * 2.0 / math.sqrt(power))
    ) < 3.0 * delay_samples.std() / math.sqrt(len(delay_samples))


def test_the_oracle_detects_larger_faults_sooner_and_lost_samples_at_once():
    oracle = learn_oracle(
        [measured_drive(0), measured_drive(1)], [measured_drive(2)], CHANNELS, RATE
    )
    drive = {name: np.array(measured_drive(3)[name]) for name in CHANNELS}
    ramp = np.maximum(np.arange(len(drive["ay"])) - 2000, 0) / RATE
    detections = [
        oracle.detects(drive, {**drive, "ay": drive["ay"] + slope * ramp}, 2000)
        for slope in (1e-4, 0.3, 1.0, 5.0)
    ]
    assert [detection.is_detectable for detection in detections] == [False, True, True, True]
    assert detections[1].delay > detections[2].delay > detections[3].delay > 0.0
    drive = {name: np.array(measured_drive(3)[name]) for name in CHANNELS}
    lost = np.array(drive["yaw_rate"])
    lost[2010:2020] = np.nan
    assert oracle.detects(drive, {**drive, "yaw_rate": lost}, 2000).delay == pytest.approx(
        11 / RATE
    )
