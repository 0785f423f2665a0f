"""The compiled extended filter against the readable one, the Kalman filter, and Jacobians by hand."""

import numba
import numpy as np
import pytest
import torch
from readable_filters import extended_filter
from test_filters_kalman import example
from test_filters_nonlinear import STEP, measured_pendulum, pendulum_with_radar

from vehest.filters.extended_scan import CompiledModel, extended_scan, with_jacobian
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman_scan import kalman_scan


@numba.njit
def swing(x, u, parameters):
    out = np.empty(3, x.dtype)
    out[0] = x[0] + STEP * x[1]
    out[1] = x[1] + STEP * (u[0] - parameters[0] * np.sin(x[0]) - x[2] * x[1])
    out[2] = x[2]
    return out


@numba.njit
def radar(x, u, parameters):
    out = np.empty(2, x.dtype)
    out[0] = 1.0 - np.cos(x[0])
    out[1] = np.sin(x[0]) * x[1]
    return out


def compiled_pendulum():
    readable, none = pendulum_with_radar(), torch.zeros(3, dtype=torch.float64)
    noises = (readable.process_noise(none, none).numpy(), readable.observation_noise(none, none).numpy())
    return CompiledModel(with_jacobian(swing), with_jacobian(radar), np.array([9.81]), *noises)


@numba.njit
def drift(x, u, parameters):
    matrix = parameters.reshape(len(x), len(x))
    return matrix @ x + u, matrix


@numba.njit
def direct(x, u, parameters):
    matrix = np.eye(len(x))[:2]
    return matrix @ x, matrix


def test_on_a_linear_model_it_is_the_kalman_filter_also_where_noise_changes_with_time_and_what_does_not_fit_is_refused():
    model, measurements, initial = example(30, missing=0.3)
    steps, n = 30, model.transition.shape[-1]
    A, C = np.broadcast_to(model.transition, (steps, n, n))[0].copy(), np.eye(n)[:2]
    offsets = np.broadcast_to(model.transition_offset, (steps, n)).copy()
    Q = np.broadcast_to(model.process_noise, (steps, n, n)) * np.linspace(0.5, 2.0, steps)[:, None, None]
    R = np.diag([0.2, 0.3]) * np.linspace(2.0, 0.5, steps)[:, None, None]
    y = measurements[:, :2]
    linear = type(model)(A, offsets, Q, C, np.zeros(2), R)
    theirs = kalman_scan(linear, y, initial)
    compiled = CompiledModel(drift, direct, A.ravel(), Q, R)
    ours = extended_scan(compiled, y, offsets, initial)
    assert np.abs(ours.filtered.mean - theirs.filtered.mean).max() < 1e-9
    assert np.abs(ours.filtered.covariance - theirs.filtered.covariance).max() < 1e-9
    assert np.abs(ours.innovation_covariance - theirs.innovation_covariance).max() < 1e-9
    with pytest.raises(ValueError, match=r"measurements must be of shape \(T, m\) with T > 0"):
        extended_scan(compiled, y[:0], offsets[:0], initial)
    with pytest.raises(ValueError, match=r"inputs of shape \(29, 3\) do not fit"):
        extended_scan(compiled, y, offsets[:29], initial)
    with pytest.raises(ValueError, match=r"observation_noise of shape \(3, 3\) does not fit \(30, 2, 2\)"):
        extended_scan(compiled._replace(observation_noise=np.eye(3)), y, offsets, initial)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite at sample 0"):
        extended_scan(compiled._replace(observation_noise=-1e3 * np.eye(2)), y, offsets, initial)


def test_on_a_nonlinear_model_it_is_the_readable_filter_through_gaps():
    measurements, inputs, initial = measured_pendulum(60)
    measurements[0, 5:9, 0] = measurements[0, 12:15] = measurements[0, 20:40] = torch.nan
    theirs = extended_filter(pendulum_with_radar(), measurements[0], inputs[0], initial)
    ours = extended_scan(compiled_pendulum(), measurements[0].numpy(), inputs[0].numpy(), Gaussian(*(part.numpy() for part in initial)))
    for found, expected in zip(ours.filtered, theirs.filtered, strict=True):
        assert np.abs(found - expected.numpy()).max() < 1e-9


@numba.njit
def several(x, u, parameters):
    out = np.empty(4, x.dtype)
    out[0] = parameters[0] * np.tanh(x[0] / u[0])
    out[1] = np.arctan((x[0] + parameters[1] * x[1]) / u[0])
    out[2] = np.exp(-x[1]) * np.sqrt(x[0])
    out[3] = x[0] ** 2 / x[1]
    return out


def test_jacobian_is_that_of_automatic_differentiation():
    x, u, parameters = np.array([0.7, 1.3]), np.array([2.0]), np.array([1.5, 0.4])

    def in_torch(state):
        a, b = state
        return torch.stack([1.5 * torch.tanh(a / 2.0), torch.atan((a + 0.4 * b) / 2.0), torch.exp(-b) * torch.sqrt(a), a**2 / b])

    value, slope = with_jacobian(several)(x, u, parameters)
    assert np.abs(value - in_torch(torch.from_numpy(x)).numpy()).max() < 1e-15
    assert np.abs(slope - torch.func.jacrev(in_torch)(torch.from_numpy(x)).numpy()).max() < 1e-14
