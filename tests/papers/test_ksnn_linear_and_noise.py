"""A KS-NN's linear forms, sub-models and noise sensitivities against the network, Eqs. 11 and 12,
impulse responses and injected noise.
"""

import math

import numpy as np
import pytest
import torch
from refusals import refusal
from scipy import signal
from trained_ksnn import ksnn_with_weights

from conftest import planar_drive
from vehest.data.errors import DataError
from vehest.estimators.luenberger import Luenberger, observe
from vehest_papers.ksnn.linear_system import LocalModels, decomposed, decomposed_estimate
from vehest_papers.ksnn.noise_sensitivity import ksnn_sensitivity, luenberger_sensitivity

STRUCTURES = [(1, 0, True), (2, 0, False), (4, 0, True), (2, 2, False), (3, 3, True)]


def _constant_turn(yaw_rate, n_samples, seed=0):
    """Measurements (1, T, 4) at constant yaw rate; everything else wanders."""
    generator = np.random.default_rng(seed)
    speed = 25.0 + np.cumsum(0.1 * generator.standard_normal(n_samples))
    return np.stack(
        [np.full(n_samples, yaw_rate), speed, *generator.standard_normal((2, n_samples))], axis=-1
    )[None]


@pytest.mark.parametrize("structure", STRUCTURES)
def test_local_models_have_the_activations_and_feedback_of_the_network(structure):
    estimator = ksnn_with_weights(*structure)
    models = LocalModels.of(estimator)
    values = np.linspace(-1.0, 1.0, 41)
    with torch.no_grad():
        np.testing.assert_allclose(
            models.activations(values),
            estimator.network.activations(torch.as_tensor(values)).numpy(),
            atol=1e-14,
        )
        np.testing.assert_allclose(
            models.feedback(values),
            estimator.network.feedback(torch.as_tensor(values)).numpy(),
            atol=1e-14,
        )
    np.testing.assert_allclose(models.activations(values).sum(axis=-1), 1.0, atol=1e-14)


def test_gains_are_those_of_the_nearest_models_and_linearisation_the_tangent():
    model = LocalModels.of(ksnn_with_weights(3, 0, True)).linearised()
    for position, centre in enumerate(model.centres.tolist()):
        gains = model.gains(-centre)
        for gain, table in (
            (gains.gamma, model.gamma),
            (gains.beta, model.beta),
            (gains.weight, model.weight),
            (gains.bias, model.bias),
        ):
            np.testing.assert_allclose(gain, table[position], rtol=1e-12)
    np.testing.assert_allclose(
        model.gains(0.5 * model.centres[1]).gamma, model.gamma[:2].mean(axis=0), rtol=1e-12
    )
    np.testing.assert_array_equal(model.gains(2.0).beta, model.beta[-1])
    models = LocalModels.of(ksnn_with_weights(2, 2, True))
    tiny = 1e-6
    for at in (0.0, -0.4):
        rise = (models.feedback(np.array(at + tiny)) - models.feedback(np.array(at - tiny))) / (
            2 * tiny
        )
        model = models.linearised(at)
        np.testing.assert_allclose(model.weight, rise, atol=1e-8)
        np.testing.assert_allclose(
            model.weight * at + model.bias, models.feedback(np.array(at)), atol=1e-12
        )


def test_gain_in_force_is_the_slope_of_the_chord_from_zero():
    """It matters at e = 0 too, where the parts of e cancel and each of them is still fed back."""
    linear, nonlinear = (
        LocalModels.of(ksnn_with_weights(2, n_hidden, True)) for n_hidden in (0, 2)
    )
    np.testing.assert_allclose(
        linear.secant(np.array([0.0, 1e-9, -0.3])),
        np.broadcast_to(linear.weight, (3, 2, 2)),
        rtol=1e-9,
    )
    np.testing.assert_allclose(nonlinear.secant(np.array(0.0)), nonlinear.slope(np.array(0.0)))
    rise = nonlinear.feedback(np.array(0.5)) - nonlinear.feedback(np.array(0.0))
    np.testing.assert_allclose(nonlinear.secant(np.array(0.5)) * 0.5, rise)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_sub_models_add_up_to_the_network_along_a_drive(structure):
    estimator = ksnn_with_weights(*structure)
    drive = planar_drive(noise=0.2, seed=1)
    parts = decomposed_estimate(estimator, drive)
    expected = estimator.estimate([drive.without_references()])[0]["vy"]
    assert np.isnan(parts.total[:30]).all()
    np.testing.assert_allclose(parts.total[30:], expected[30:], rtol=0, atol=1e-9)
    share = [
        float(np.abs(contribution[30:]).max())
        for contribution in (parts.slip_rate, parts.pseudo_measurement, parts.speed)
    ]
    assert min(share) > 0.01
    assert bool(np.abs(parts.bias[30:]).max() > 0.0) is structure[2]


@pytest.mark.parametrize("yaw_rate", [0.25, -0.4])
def test_sub_models_at_constant_yaw_rate_are_the_terms_of_eq_11(yaw_rate):
    """Eqs. 11 and 12 filtered from rest, the bias as a step, and what the start at û = u_m adds to
    the second and third.
    """
    models = LocalModels.of(ksnn_with_weights(2, 0, True, window=200))
    gains = models.linearised().gains(yaw_rate)
    tau = models.step
    (g1, g2) = gains.gamma
    (b1, b2) = gains.beta
    (w1, w2) = gains.weight
    (bias_1, bias_2) = gains.bias
    measurements = _constant_turn(yaw_rate, 200)
    _, speed, ay, ax = measurements[0].T
    denominator = np.array([1.0, w2 - g1 - g2, w1 * b2 * tau * yaw_rate**2 - w2 * g1 + g1 * g2])

    def filtered(numerator, samples):
        """v at k = 0, 1, ... for a numerator a z² + b z + c over D."""
        return signal.lfilter(numerator, denominator, np.append(samples, 0.0))[1:]

    impulse = np.zeros(200)
    impulse[0] = 1.0
    start = filtered([0.0, -yaw_rate * w1 * speed[0], 0.0], impulse)
    first = filtered([0.0, tau * b1, tau * b1 * (w2 - g2)], ay - yaw_rate * speed)
    second = filtered([0.0, b2 * w1 * yaw_rate, -b2 * w1 * yaw_rate], speed) - filtered(
        [0.0, 0.0, tau * b2 * w1 * yaw_rate], ax
    )
    third = filtered([0.0, yaw_rate * w1 * (1.0 - b2), yaw_rate * w1 * (b2 - g2)], speed)
    bias = filtered(
        [0.0, -yaw_rate * bias_1, yaw_rate * (bias_2 * w1 - bias_1 * (w2 - g2))], np.ones(200)
    )
    parts = decomposed(models, measurements)
    np.testing.assert_allclose(parts.slip_rate[0], first, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.pseudo_measurement[0], second + b2 * start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.speed[0], third + (1.0 - b2) * start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.bias[0], bias, rtol=0, atol=1e-9)


def test_recording_at_another_rate_or_too_short_is_refused():
    estimator = ksnn_with_weights()
    with pytest.raises(DataError, match=r"100 Hz.*20 Hz"):
        decomposed_estimate(estimator, planar_drive(seconds=5.0, rate_hz=100.0))
    assert "30 samples" in refusal(
        lambda: decomposed_estimate(estimator, planar_drive(seconds=1.5))
    )


FREQUENCY = np.linspace(0.0, 10.0, 101)
AY = 2
AX = 3


def _luenberger(gain=7.0, threshold=0.05, rate_hz=100.0):
    estimator = Luenberger(Luenberger.settings_type(rate_hz=rate_hz))
    estimator.gain = gain
    estimator.threshold = threshold
    return estimator


def _turn(yaw_rate, n_samples):
    return np.tile([yaw_rate, 25.0, 25.0 * yaw_rate, 0.0], (n_samples, 1))


def _measured_impulse_response(estimator, yaw_rate, channel, n_window, size=1.0):
    """Lags 0 to N of the network itself: the impulse stands at each place of the window in turn."""
    windows = np.repeat(_turn(yaw_rate, n_window)[None], n_window + 1, axis=0)
    for lag in range(1, n_window + 1):
        windows[lag, n_window - lag, channel] += size
    with torch.no_grad():
        lateral = estimator.network(torch.as_tensor(windows)).numpy()
    return (lateral - lateral[0]) / size


def _transform(impulse_response, rate_hz):
    return (
        np.exp(-2j * np.pi * np.outer(FREQUENCY / rate_hz, np.arange(len(impulse_response))))
        @ impulse_response
    )


@pytest.mark.parametrize("yaw_rate", [0.2, -0.4])
@pytest.mark.parametrize("bias", [False, True])
def test_sensitivity_of_windows_is_the_transform_of_the_networks_impulse_response(yaw_rate, bias):
    estimator = ksnn_with_weights(2, 0, bias)
    closed = ksnn_sensitivity(LocalModels.of(estimator).linearised(), yaw_rate).truncated(30)
    for channel, response in zip((AY, AX), closed.response(FREQUENCY), strict=True):
        measured = _transform(_measured_impulse_response(estimator, yaw_rate, channel, 30), 20.0)
        assert np.abs(measured).max() > 1e-3
        np.testing.assert_allclose(response, measured, rtol=0, atol=1e-9)


def _state_matrix(model, yaw_rate):
    """A(ω) of the state (v, û - u_m)."""
    gains = model.gains(yaw_rate)
    return np.array(
        [
            [gains.gamma[0], -yaw_rate * gains.weight[0]],
            [gains.beta[1] * model.step * yaw_rate, gains.gamma[1] - gains.weight[1]],
        ]
    )


@pytest.mark.parametrize("yaw_rate", [0.2, -0.35])
def test_closed_form_of_the_ksnn_is_that_of_its_state_space(yaw_rate):
    model = LocalModels.of(ksnn_with_weights(3, 0, True)).linearised()
    inputs = np.diag(model.gains(yaw_rate).beta * model.step)
    z = np.exp(2j * np.pi * FREQUENCY / 20.0)
    expected = np.linalg.solve(
        z[:, None, None] * np.eye(2) - _state_matrix(model, yaw_rate), inputs.astype(complex)
    )[:, 0]
    sensitivity = ksnn_sensitivity(model, yaw_rate)
    np.testing.assert_allclose(
        np.stack(sensitivity.response(FREQUENCY), axis=1), expected, rtol=1e-9
    )
    np.testing.assert_allclose(
        np.sort_complex(np.roots(sensitivity.denominator)),
        np.sort_complex(np.linalg.eigvals(_state_matrix(model, yaw_rate))),
        rtol=1e-9,
    )


@pytest.mark.parametrize("yaw_rate", [0.2, -0.4])
@pytest.mark.parametrize("rate_hz", [100.0, 20.0])
def test_luenberger_sensitivity_is_the_transform_of_the_observers_impulse_response(
    yaw_rate, rate_hz
):
    estimator = _luenberger(rate_hz=rate_hz)
    closed = luenberger_sensitivity(estimator, yaw_rate)
    turn = _turn(yaw_rate, 3000)
    undisturbed = observe(turn, estimator.gain, estimator.threshold, 1.0 / rate_hz)[0]
    for channel, response in zip((AY, AX), closed.response(FREQUENCY), strict=True):
        struck = turn.copy()
        struck[0, channel] += 1.0
        measured = (
            observe(struck, estimator.gain, estimator.threshold, 1.0 / rate_hz)[0] - undisturbed
        )
        np.testing.assert_allclose(
            response, _transform(measured, rate_hz), rtol=0, atol=1e-8
        )  # 3000 rounded differences add up


def test_variance_is_the_band_integral_and_a_reset_observer_passes_nothing():
    model = LocalModels.of(ksnn_with_weights(2, 0, False)).linearised()
    for closed in (
        ksnn_sensitivity(model, 0.3),
        ksnn_sensitivity(model, 0.3).truncated(30),
        luenberger_sensitivity(_luenberger(), 0.3),
    ):
        band = closed.band_gains(closed.rate_hz / 2, n_lines=20_001)
        responses = closed.impulse_responses(20_000)
        for response, over_band in zip(responses, band, strict=True):
            gain = math.sqrt(np.square(response).sum())
            assert over_band / math.sqrt(closed.rate_hz / 2) == pytest.approx(gain, rel=1e-6)
    closed = luenberger_sensitivity(_luenberger(threshold=0.1), 0.05)
    assert np.abs(np.stack(closed.response(FREQUENCY))).max() == 0.0
    assert closed.band_gains(closed.rate_hz / 2) == (0.0, 0.0)
