"""A KS-NN's linear forms and sub-models against the network itself and against Eqs. 11 and 12 filtered literally."""

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal
from trained_ksnn import ksnn_with_weights

from conftest import planar_drive
from vehest.data.errors import DataError
from vehest_papers.ksnn.linear_system import LocalModels, decomposed, decomposed_estimate

STRUCTURES = [(1, 0, True), (2, 0, False), (4, 0, True), (2, 2, False), (3, 3, True)]
LINEAR = [structure for structure in STRUCTURES if structure[1] == 0]


def _windows(drive, channels, n_window=30):
    return np.moveaxis(sliding_window_view(drive.stack(channels), n_window, axis=0), 1, 2)


def _noisy_drive(**options):
    return planar_drive(noise=0.2, **options)


def _constant_turn(yaw_rate, n_samples, seed=0):
    """Measurements (1, T, 4) at constant yaw rate; everything else wanders."""
    generator = np.random.default_rng(seed)
    speed = 25.0 + np.cumsum(0.1 * generator.standard_normal(n_samples))
    return np.stack([np.full(n_samples, yaw_rate), speed, *generator.standard_normal((2, n_samples))], axis=-1)[None]


def simulated(model, measurements):
    """v̂ of Eq. 14 from v = 0, û = u_m, one interval after each sample of yaw_rate, vx, ay and ax, (..., N, 4) -> (..., N)."""
    omega, speed, ay, ax = np.moveaxis(measurements, -1, 0)
    own = model.gains(omega)
    v, u = np.zeros_like(speed[..., 0]), speed[..., 0]
    lateral = np.empty_like(speed)
    for k in range(speed.shape[-1]):
        now = np.s_[..., k]
        feedback = own.weight[..., k, :] * (u - speed[now])[..., None] + own.bias[..., k, :]
        slip, thrust = model.step * (ay[now] - omega[now] * speed[now]), model.step * (ax[now] + omega[now] * v)
        v, u = (
            own.gamma[..., k, 0] * v + own.beta[..., k, 0] * slip - omega[now] * feedback[..., 0],
            own.gamma[..., k, 1] * u + own.beta[..., k, 1] * thrust - feedback[..., 1],
        )
        lateral[now] = v
    return lateral


@pytest.mark.parametrize("structure", LINEAR)
def test_lpv_model_equals_the_network(structure):
    estimator = ksnn_with_weights(*structure)
    windows = _windows(_noisy_drive(), estimator.channels)
    lateral = simulated(LocalModels.of(estimator).linearised(), windows)
    with torch.no_grad():
        expected = estimator.network(torch.as_tensor(windows.copy())).numpy()
    assert np.abs(expected).max() > 0.5
    np.testing.assert_allclose(lateral[:, -1], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_local_models_have_the_activations_and_feedback_of_the_network(structure):
    estimator = ksnn_with_weights(*structure)
    models, values = LocalModels.of(estimator), np.linspace(-1.0, 1.0, 41)
    with torch.no_grad():
        np.testing.assert_allclose(models.activations(values), estimator.network.activations(torch.as_tensor(values)).numpy(), atol=1e-14)
        np.testing.assert_allclose(models.feedback(values), estimator.network.feedback(torch.as_tensor(values)).numpy(), atol=1e-14)
    np.testing.assert_allclose(models.activations(values).sum(axis=-1), 1.0, atol=1e-14)


def test_gains_are_those_of_the_nearest_models_and_linearisation_the_tangent():
    model = LocalModels.of(ksnn_with_weights(3, 0, True)).linearised()
    for position, centre in enumerate(model.centres.tolist()):
        own = model.gains(-centre)
        for found, table in ((own.gamma, model.gamma), (own.beta, model.beta), (own.weight, model.weight), (own.bias, model.bias)):
            np.testing.assert_allclose(found, table[position], rtol=1e-12)
    np.testing.assert_allclose(model.gains(0.5 * model.centres[1]).gamma, model.gamma[:2].mean(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(model.gains(2.0).beta, model.beta[-1])
    models, tiny = LocalModels.of(ksnn_with_weights(2, 2, True)), 1e-6
    for at in (0.0, -0.4):
        rise = (models.feedback(np.array(at + tiny)) - models.feedback(np.array(at - tiny))) / (2 * tiny)
        model = models.linearised(at)
        np.testing.assert_allclose(model.weight, rise, atol=1e-8)
        np.testing.assert_allclose(model.weight * at + model.bias, models.feedback(np.array(at)), atol=1e-12)


def test_gain_in_force_is_the_slope_of_the_chord_from_zero():
    """It matters at e = 0 too, where the parts of e cancel and each of them is still fed back."""
    linear, nonlinear = (LocalModels.of(ksnn_with_weights(2, n_hidden, True)) for n_hidden in (0, 2))
    np.testing.assert_allclose(linear.secant(np.array([0.0, 1e-9, -0.3])), np.broadcast_to(linear.weight, (3, 2, 2)), rtol=1e-9)
    np.testing.assert_allclose(nonlinear.secant(np.array(0.0)), nonlinear.slope(np.array(0.0)))
    rise = nonlinear.feedback(np.array(0.5)) - nonlinear.feedback(np.array(0.0))
    np.testing.assert_allclose(nonlinear.secant(np.array(0.5)) * 0.5, rise)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_sub_models_add_up_to_the_network_along_a_drive(structure):
    estimator = ksnn_with_weights(*structure)
    drive = _noisy_drive(seed=1)
    parts, expected = decomposed_estimate(estimator, drive), estimator.estimate([drive.without_references()])[0]["vy"]
    assert np.isnan(parts.total[:30]).all()
    np.testing.assert_allclose(parts.total[30:], expected[30:], rtol=0, atol=1e-9)
    share = [float(np.abs(own[30:]).max()) for own in (parts.slip_rate, parts.pseudo_measurement, parts.speed)]
    assert min(share) > 0.01
    assert bool(np.abs(parts.bias[30:]).max() > 0.0) is structure[2]


@pytest.mark.parametrize("yaw_rate", [0.25, -0.4])
def test_sub_models_at_constant_yaw_rate_are_the_terms_of_eq_11(yaw_rate):
    """Eqs. 11 and 12 filtered from rest, the bias as a step, and what the start at û = u_m adds to the second and third."""
    models = LocalModels.of(ksnn_with_weights(2, 0, True, window=200))
    own, tau = models.linearised().gains(yaw_rate), models.step
    (g1, g2), (b1, b2), (w1, w2), (bias_1, bias_2) = own.gamma, own.beta, own.weight, own.bias
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
    second = filtered([0.0, b2 * w1 * yaw_rate, -b2 * w1 * yaw_rate], speed) - filtered([0.0, 0.0, tau * b2 * w1 * yaw_rate], ax)
    third = filtered([0.0, yaw_rate * w1 * (1.0 - b2), yaw_rate * w1 * (b2 - g2)], speed)
    bias = filtered([0.0, -yaw_rate * bias_1, yaw_rate * (bias_2 * w1 - bias_1 * (w2 - g2))], np.ones(200))
    parts = decomposed(models, measurements)
    np.testing.assert_allclose(parts.slip_rate[0], first, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.pseudo_measurement[0], second + b2 * start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.speed[0], third + (1.0 - b2) * start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.bias[0], bias, rtol=0, atol=1e-9)
    lateral = simulated(models.linearised(), measurements)
    np.testing.assert_allclose(first + second + third + bias + start, lateral[0], rtol=0, atol=1e-9)


def test_start_is_all_that_keeps_the_speed_from_entering_as_a_step():
    """With γ₂ = β₂ = 1 a constant speed says nothing of v: second and third sub-model stay zero."""
    models = LocalModels.of(ksnn_with_weights(1, 0, False))
    models.gamma[:, 1] = models.beta[:, 1] = 1.0
    measurements = np.tile([0.3, 25.0, 7.0, 0.0], (1, 30, 1))
    parts = decomposed(models, measurements)
    np.testing.assert_allclose(parts.pseudo_measurement, 0.0, atol=1e-12)
    np.testing.assert_allclose(parts.third, 0.0, atol=1e-12)


def test_recording_at_another_rate_or_too_short_is_refused():
    estimator = ksnn_with_weights()
    with pytest.raises(DataError, match=r"100 Hz.*20 Hz"):
        decomposed_estimate(estimator, planar_drive(seconds=5.0, rate_hz=100.0))
    with pytest.raises(DataError, match="30 samples"):
        decomposed_estimate(estimator, planar_drive(seconds=1.5))
