"""Closed-form noise sensitivities against impulse responses of the estimators, their state-space forms, and injected noise."""

import math

import numpy as np
import pytest
import torch
from trained_ksnn import ksnn_with_weights

from vehest.estimators.kernels.luenberger import observe
from vehest.estimators.luenberger import Luenberger
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.noise_sensitivity import ksnn_sensitivity, luenberger_sensitivity

FREQUENCY = np.linspace(0.0, 10.0, 101)
AY, AX = 2, 3


def _luenberger(gain=7.0, threshold=0.05, rate_hz=100.0):
    estimator = Luenberger(Luenberger.settings_type(rate_hz=rate_hz))
    estimator.gain, estimator.threshold = gain, threshold
    return estimator


def _turn(yaw_rate, n_samples):
    return np.tile([yaw_rate, 25.0, 25.0 * yaw_rate, 0.0], (n_samples, 1))


def _run(estimator, windows):
    with torch.no_grad():
        return estimator.network(torch.as_tensor(windows)).numpy()


def _measured_impulse_response(estimator, yaw_rate, channel, n_window, size=1.0):
    """Lags 0 to N of the network itself: the impulse stands at each place of the window in turn."""
    windows = np.repeat(_turn(yaw_rate, n_window)[None], n_window + 1, axis=0)
    for lag in range(1, n_window + 1):
        windows[lag, n_window - lag, channel] += size
    lateral = _run(estimator, windows)
    return (lateral - lateral[0]) / size


def _transform(impulse_response, rate_hz):
    return np.exp(-2j * np.pi * np.outer(FREQUENCY / rate_hz, np.arange(len(impulse_response)))) @ impulse_response


@pytest.mark.parametrize("yaw_rate", [0.2, -0.4])
@pytest.mark.parametrize("bias", [False, True])
def test_sensitivity_of_windows_is_the_transform_of_the_networks_impulse_response(yaw_rate, bias):
    estimator = ksnn_with_weights(2, 0, bias)
    closed = ksnn_sensitivity(LocalModels.of(estimator).linearised(), yaw_rate).truncated(30)
    for channel, response in zip((AY, AX), closed.response(FREQUENCY), strict=True):
        measured = _transform(_measured_impulse_response(estimator, yaw_rate, channel, 30), 20.0)
        assert np.abs(measured).max() > 1e-3
        np.testing.assert_allclose(response, measured, rtol=0, atol=1e-9)


def test_closed_form_is_the_transform_of_the_recursion_that_never_forgets():
    """A window of 600 samples, in which every pole dies out, in the place of none; the sign of each sensitivity is tested too."""
    estimator, yaw_rate = ksnn_with_weights(2, 0, False, window=600), 0.3
    closed = ksnn_sensitivity(LocalModels.of(estimator).linearised(), yaw_rate)
    assert np.abs(closed.poles[0]) < 0.96
    for channel, response in zip((AY, AX), closed.response(FREQUENCY), strict=True):
        np.testing.assert_allclose(response, _transform(_measured_impulse_response(estimator, yaw_rate, channel, 600), 20.0), atol=1e-9)
    assert closed.impulse_responses(3)[0][1] > 0.0  # ay pushes v up at once, and
    assert closed.impulse_responses(3)[1][2] < 0.0  # ax, which raises û, pushes it down in a left turn


@pytest.mark.parametrize("yaw_rate", [0.2, -0.35])
def test_closed_form_of_the_ksnn_is_that_of_its_state_space(yaw_rate):
    model = LocalModels.of(ksnn_with_weights(3, 0, True)).linearised()
    inputs = np.diag(model.gains(yaw_rate).beta * model.step)
    z = np.exp(2j * np.pi * FREQUENCY / 20.0)
    expected = np.linalg.solve(z[:, None, None] * np.eye(2) - model.state_matrix(yaw_rate), inputs.astype(complex))[:, 0]
    found = ksnn_sensitivity(model, yaw_rate)
    np.testing.assert_allclose(np.stack(found.response(FREQUENCY), axis=1), expected, rtol=1e-9)
    np.testing.assert_allclose(np.sort_complex(found.poles), np.sort_complex(np.linalg.eigvals(model.state_matrix(yaw_rate))), rtol=1e-9)


@pytest.mark.parametrize("yaw_rate", [0.2, -0.4])
@pytest.mark.parametrize("rate_hz", [100.0, 20.0])
def test_luenberger_sensitivity_is_the_transform_of_the_observers_impulse_response(yaw_rate, rate_hz):
    estimator = _luenberger(rate_hz=rate_hz)
    closed, turn = luenberger_sensitivity(estimator, yaw_rate), _turn(yaw_rate, 3000)
    still = observe(turn, estimator.gain, estimator.threshold, 1.0 / rate_hz)[0]
    for channel, response in zip((AY, AX), closed.response(FREQUENCY), strict=True):
        struck = turn.copy()
        struck[0, channel] += 1.0
        measured = observe(struck, estimator.gain, estimator.threshold, 1.0 / rate_hz)[0] - still
        np.testing.assert_allclose(response, _transform(measured, rate_hz), rtol=0, atol=1e-8)  # 3000 rounded differences add up


def test_printed_order_of_the_luenberger_gains_disagrees_with_appendix_b():
    """With f₁ = 2α|ω|e and f₂ = (α² - 1)ωe, as Eq. 17 prints them, the denominator is another one than that of Eq. 18."""
    gain, omega, tau = 7.0, 0.3, 0.01
    of_paper = luenberger_sensitivity(_luenberger(gain), omega).denominator
    corrected = np.array([[0.0, -omega - (gain**2 - 1.0) * omega], [omega, -2.0 * gain * omega]])
    printed = np.array([[0.0, -omega - 2.0 * gain * omega], [omega, -(gain**2 - 1.0) * omega]])
    characteristic = [
        np.linalg.det(np.eye(2) - tau * matrix) * np.poly(np.linalg.inv(np.eye(2) - tau * matrix)) for matrix in (corrected, printed)
    ]
    np.testing.assert_allclose(characteristic[0], of_paper, rtol=1e-9)
    assert np.abs(characteristic[1] - of_paper).max() > 0.01


def test_observer_that_is_reset_passes_no_noise():
    closed = luenberger_sensitivity(_luenberger(threshold=0.1), 0.05)
    assert np.abs(np.stack(closed.response(FREQUENCY))).max() == 0.0
    assert closed.white_noise_gains() == (0.0, 0.0)


def test_constant_errors_come_through_as_their_kinematics_say():
    """At 0 Hz: δv = 2 δa_y/(α|ω|) and -δa_x/ω for the Luenberger observer, whatever its step."""
    for yaw_rate in (0.2, -0.4):
        to_ay, to_ax = luenberger_sensitivity(_luenberger(gain=5.0), yaw_rate).response(np.zeros(1))
        assert to_ay[0] == pytest.approx(2.0 / (5.0 * abs(yaw_rate)))
        assert to_ax[0] == pytest.approx(-1.0 / yaw_rate)


@pytest.mark.parametrize("channel", [AY, AX])
def test_white_noise_on_the_networks_windows_has_the_variance_of_the_closed_form(channel):
    """20,000 windows with noise of their own: the standard deviation of a standard deviation is 1/sqrt(2n) = 0.5 %; four of those."""
    estimator, n_windows = ksnn_with_weights(2, 0, False), 20_000
    windows = np.repeat(_turn(0.3, 30)[None], n_windows, axis=0)
    clean = _run(estimator, windows[:1])
    windows[..., channel] += 0.5 * np.random.default_rng(channel).standard_normal((n_windows, 30))
    spread = np.sqrt(np.mean((_run(estimator, windows) - clean) ** 2))
    closed = ksnn_sensitivity(LocalModels.of(estimator).linearised(), 0.3).truncated(30).white_noise_gains()[channel - AY]
    assert spread == pytest.approx(0.5 * closed, rel=4 / math.sqrt(2 * n_windows))


@pytest.mark.parametrize("channel", [AY, AX])
def test_white_noise_on_the_luenberger_observer_has_the_variance_of_the_closed_form(channel):
    """Successive outputs are correlated: n samples count as n/Σρ² independent ones; four standard deviations."""
    estimator, n_samples = _luenberger(), 200_000
    turn = _turn(0.3, n_samples)
    clean = observe(turn, estimator.gain, estimator.threshold, 0.01)[0]
    turn[:, channel] += np.random.default_rng(channel).standard_normal(n_samples)
    noise = (observe(turn, estimator.gain, estimator.threshold, 0.01)[0] - clean)[2000:]
    closed = luenberger_sensitivity(estimator, 0.3)
    response = closed.whole_impulse_responses()[channel - AY]
    correlation = np.correlate(response, response, mode="full") / np.sum(response**2)
    tolerance = 4 * math.sqrt(np.sum(correlation**2) / (2 * len(noise)))
    assert tolerance < 0.1
    assert noise.std() == pytest.approx(closed.white_noise_gains()[channel - AY], rel=tolerance)


def test_variance_is_the_integral_of_the_squared_magnitude():
    model = LocalModels.of(ksnn_with_weights(2, 0, False)).linearised()
    for closed in (ksnn_sensitivity(model, 0.3), ksnn_sensitivity(model, 0.3).truncated(30), luenberger_sensitivity(_luenberger(), 0.3)):
        band = closed.band_gains(closed.rate_hz / 2, n_lines=20_001)
        for gain, over_band in zip(closed.white_noise_gains(), band, strict=True):
            assert over_band / math.sqrt(closed.rate_hz / 2) == pytest.approx(gain, rel=1e-6)


def test_small_noise_on_nonlinear_feedback_follows_its_linearisation():
    estimator = ksnn_with_weights(2, 2, False)
    closed = ksnn_sensitivity(LocalModels.of(estimator).linearised(), 0.3).truncated(30)
    # a turn in which û stays at u_m: γ₂û has to be made up for by ax, so the state starts and stays at e = 0
    own = LocalModels.of(estimator).linearised().gains(0.3)
    assert not np.isclose(own.gamma[1], 1.0)
    turn = _turn(0.3, 30)
    turn[:, AY] = 25.0 * 0.3
    turn[:, AX] = (1.0 - own.gamma[1]) * 25.0 / (own.beta[1] * 0.05)
    windows = np.repeat(turn[None], 31, axis=0)
    for lag in range(1, 31):
        windows[lag, 30 - lag, AY] += 1e-4
    lateral = _run(estimator, windows)
    np.testing.assert_allclose((lateral - lateral[0]) / 1e-4, closed.impulse_responses(31)[0], rtol=0, atol=1e-6)
