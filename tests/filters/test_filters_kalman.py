"""Kalman filter and smoother against the dense posterior, the Riccati equation and closed forms."""

import numpy as np
import pytest
import torch
from numba.core.event import install_recorder
from readable_filters import log_likelihood
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel, smoothed_means
from vehest.filters.kalman_scan import kalman_scan

N = 3
M = 2


def spread(generator, *shape):
    """Random covariance matrices, well away from singular."""
    root = torch.randn(*shape, shape[-1], generator=generator, dtype=torch.float64)
    return root @ root.mT + 0.3 * torch.eye(shape[-1], dtype=torch.float64)


def example(steps, seed=0, missing=0.0):
    """A time-varying model, measurements of which some are missing, and a first state."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    model = LinearModel(
        0.7 * torch.eye(N, dtype=torch.float64) + 0.15 * normal(steps, N, N),
        normal(steps, N),
        spread(generator, steps, N),
        normal(steps, M, N),
        normal(steps, M),
        0.3 + normal(steps, M).square(),
    )
    measurements = 3.0 * normal(steps, M)
    measurements[torch.rand(steps, M, generator=generator) < missing] = torch.nan
    return arrays(model), measurements.numpy(), arrays(Gaussian(normal(N), spread(generator, N)))


def arrays(parts):
    return type(parts)(*(part.numpy() for part in parts))


def tensors(parts):
    return type(parts)(*map(torch.from_numpy, parts))


def dense_posterior(model, measurements, initial, n_measured):
    """Mean and covariance of all states at once, given the measurements of the first samples.

    And their log-density.

    Written down as one normal distribution of x[0], w[0], w[1], … and v[0], v[1], …: no recursion.
    """
    A, b, Q, C, d, R = model
    steps = len(measurements)
    base = block_diag(initial.covariance, *Q[: steps - 1])
    maps = [np.eye(N, N * steps)]
    offsets = [initial.mean]
    for k in range(steps - 1):
        enter = np.zeros((N, N * steps))
        enter[:, N * (k + 1) : N * (k + 2)] = np.eye(N)
        maps.append(A[k] @ maps[-1] + enter)
        offsets.append(A[k] @ offsets[-1] + b[k])
    F = np.concatenate(maps)
    f = np.concatenate(offsets)
    prior = F @ base @ F.T
    H = block_diag(*C)
    y_mean = H @ f + d.ravel()
    y_cov = H @ prior @ H.T + np.diag(R.ravel())
    is_measured = ~np.isnan(measurements)
    is_measured[n_measured:] = False
    rows = np.flatnonzero(is_measured.ravel())
    S = y_cov[np.ix_(rows, rows)]
    cross = (prior @ H.T)[:, rows]
    error = measurements.ravel()[rows] - y_mean[rows]
    mean = f + cross @ np.linalg.solve(S, error)
    covariance = prior - cross @ np.linalg.solve(S, cross.T)
    density = (
        multivariate_normal(y_mean[rows], S).logpdf(measurements.ravel()[rows])
        if len(rows)
        else 0.0
    )
    return (
        mean.reshape(steps, N),
        covariance.reshape(steps, N, steps, N).diagonal(axis1=0, axis2=2).transpose(2, 0, 1),
        density,
    )


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("seed", [0, 1])
def test_filter_and_smoother_are_the_posterior_of_all_states_at_once(missing, seed):
    model, measurements, initial = example(6, seed=seed, missing=missing)
    result = kalman_scan(model, measurements, initial)
    for k in range(6):
        mean, covariance, density = dense_posterior(model, measurements, initial, k + 1)
        assert np.abs(result.filtered.mean[k] - mean[k]).max() < 1e-10
        assert np.abs(result.filtered.covariance[k] - covariance[k]).max() < 1e-10
        assert abs(float(log_likelihood(result)[: k + 1].sum()) - density) < 1e-9
        mean, covariance, _ = dense_posterior(model, measurements, initial, k)
        assert np.abs(result.predicted.mean[k] - mean[k]).max() < 1e-10
        assert np.abs(result.predicted.covariance[k] - covariance[k]).max() < 1e-10
    mean, _, _ = dense_posterior(model, measurements, initial, 6)
    assert np.abs(smoothed_means(model, result) - mean).max() < 1e-10


def test_unmeasured_samples_keep_the_prediction():
    model, measurements, initial = example(5, seed=6)
    measurements[2] = np.nan
    result = kalman_scan(model, measurements, initial)
    assert not result.measured[2].any()
    assert (result.innovation[2] == 0).all()
    assert np.array_equal(result.filtered.mean[2], result.predicted.mean[2])
    assert np.array_equal(result.innovation_covariance[2], np.eye(M))


def test_covariances_stay_symmetric_and_positive():
    """From a first variance of 1e10 down to 1e-6.

    The short form of the update, (I - KC)P, turns negative on the way.
    """
    model, measurements, _ = example(300, seed=8)
    A, b, Q, C, d, R = model
    model = LinearModel(A, b, 1e-6 * Q, C, d, 1e-6 * R)
    start = Gaussian(np.zeros(N), 1e10 * np.eye(N))
    result = kalman_scan(model, measurements, start).filtered.covariance
    assert np.array_equal(result, result.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(result).min() > 0
    short = start.covariance
    lowest = 0.0
    for A, _, Q, C, _, R in zip(*model, strict=True):
        gain = short @ C.T @ np.linalg.inv(C @ short @ C.T + np.diag(R))
        short = (np.eye(N) - gain @ C) @ short
        lowest = min(lowest, np.linalg.eigvalsh(short + short.T).min())
        short = A @ short @ A.T + Q
    assert lowest < 0, "otherwise this example would show nothing"


def test_the_loop_is_compiled_once_for_varying_constant_and_fixed_models():
    model, measurements, initial = example(4)
    kalman_scan(model, measurements, initial)
    constant = LinearModel(*(part[0] for part in model))
    for part in initial:
        part.flags.writeable = False
    with install_recorder("numba:compile") as recorder:
        kalman_scan(constant, measurements, initial)
        kalman_scan(constant, measurements[:1], initial)
    assert not recorder.buffer


def test_shapes_that_do_not_fit_are_refused():
    model, measurements, initial = example(4)
    A, b, Q, C, d, R = model
    wrong = LinearModel(A, b, Q, C[..., :2], d, R)
    with pytest.raises(
        ValueError, match=r"observation of shape \(4, 2, 2\) does not fit \(4, 2, 3\)"
    ):
        kalman_scan(wrong, measurements, initial)
    for empty in (measurements[:0], measurements[0]):
        with pytest.raises(ValueError, match="with T > 0"):
            kalman_scan(model, empty, initial)


def test_a_filter_is_nan_from_the_sample_on_at_which_it_breaks_down():
    model, measurements, initial = example(4)
    sound = kalman_scan(model, measurements, initial)
    model.observation_noise[2] = -1e3
    broken = kalman_scan(model, measurements, initial)
    for state, expected in zip(broken.filtered, sound.filtered, strict=True):
        np.testing.assert_array_equal(state[:2], expected[:2])
        assert np.isnan(state[2:]).all()
    assert np.isnan(broken.innovation[2:]).all()
