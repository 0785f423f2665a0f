"""Kalman filter and smoother against the dense posterior, the Riccati equation, closed forms, autograd; the compiled scan against both."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag, solve_discrete_are
from scipy.stats import multivariate_normal

from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel, condition_on, kalman_filter, predict, smooth
from vehest.filters.kalman_scan import kalman_scan

N, M = 3, 2


def spread(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Random covariance matrices, well away from singular."""
    root = torch.randn(*shape, shape[-1], generator=generator, dtype=torch.float64)
    return root @ root.mT + 0.3 * torch.eye(shape[-1], dtype=torch.float64)


def example(*samples: int, seed: int = 0, missing: float = 0.0) -> tuple[LinearModel, torch.Tensor, Gaussian]:
    """A time-varying model, measurements of which some are missing, and a first state."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    model = LinearModel(
        0.7 * torch.eye(N, dtype=torch.float64) + 0.15 * normal(*samples, N, N),
        normal(*samples, N),
        spread(generator, *samples, N),
        normal(*samples, M, N),
        normal(*samples, M),
        spread(generator, *samples, M),
    )
    measurements = 3.0 * normal(*samples, M)
    gone = torch.rand(*samples, M, generator=generator) < missing
    return model, torch.where(gone, torch.nan, measurements), Gaussian(normal(N), spread(generator, N))


def arrays(parts):
    return type(parts)(*(part.numpy() for part in parts))


def dense_posterior(model: LinearModel, measurements: np.ndarray, initial: Gaussian, seen: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and covariance of all states at once, given the measurements of the first samples; and their log-density.

    Written down as one normal distribution of x[0], w[0], w[1], … and v[0], v[1], …: no recursion.
    """
    A, b, Q, C, d, R = (part.numpy() for part in model)
    steps = len(measurements)
    base = block_diag(initial.covariance.numpy(), *Q[: steps - 1])
    maps, offsets = [np.eye(N, N * steps)], [initial.mean.numpy()]
    for k in range(steps - 1):
        enter = np.zeros((N, N * steps))
        enter[:, N * (k + 1) : N * (k + 2)] = np.eye(N)
        maps.append(A[k] @ maps[-1] + enter)
        offsets.append(A[k] @ offsets[-1] + b[k])
    F, f = np.concatenate(maps), np.concatenate(offsets)
    prior = F @ base @ F.T
    H = block_diag(*C)
    y_mean = H @ f + d.ravel()
    y_cov = H @ prior @ H.T + block_diag(*R)
    known = ~np.isnan(measurements)
    known[seen:] = False
    rows = np.flatnonzero(known.ravel())
    S, cross = y_cov[np.ix_(rows, rows)], (prior @ H.T)[:, rows]
    error = measurements.ravel()[rows] - y_mean[rows]
    mean = f + cross @ np.linalg.solve(S, error)
    covariance = prior - cross @ np.linalg.solve(S, cross.T)
    density = multivariate_normal(y_mean[rows], S).logpdf(measurements.ravel()[rows]) if len(rows) else 0.0
    return mean.reshape(steps, N), covariance.reshape(steps, N, steps, N).diagonal(axis1=0, axis2=2).transpose(2, 0, 1), density


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("seed", [0, 1])
def test_filter_and_smoother_are_the_posterior_of_all_states_at_once(missing, seed):
    model, measurements, initial = example(6, seed=seed, missing=missing)
    result = kalman_filter(model, measurements, initial)
    for k in range(6):
        mean, covariance, density = dense_posterior(model, measurements.numpy(), initial, k + 1)
        assert np.abs(result.filtered.mean[k].numpy() - mean[k]).max() < 1e-10
        assert np.abs(result.filtered.covariance[k].numpy() - covariance[k]).max() < 1e-10
        assert abs(float(result.log_likelihood[: k + 1].sum()) - density) < 1e-9
        mean, covariance, _ = dense_posterior(model, measurements.numpy(), initial, k)
        assert np.abs(result.predicted.mean[k].numpy() - mean[k]).max() < 1e-10
    states = smooth(model, result)
    mean, covariance, _ = dense_posterior(model, measurements.numpy(), initial, 6)
    assert np.abs(states.mean.numpy() - mean).max() < 1e-10
    assert np.abs(states.covariance.numpy() - covariance).max() < 1e-10


def test_covariance_settles_at_the_solution_of_the_riccati_equation():
    model, _, initial = example(1, seed=3)
    constant = LinearModel(*(part[0] for part in model))
    result = kalman_filter(constant, torch.zeros(200, M, dtype=torch.float64), initial)
    A, Q, C, R = (getattr(constant, name).numpy() for name in ("transition", "process_noise", "observation", "observation_noise"))
    settled = solve_discrete_are(A.T, C.T, Q, R)
    assert np.allclose(result.predicted.covariance[-1].numpy(), settled, rtol=1e-9, atol=1e-12)
    gain = settled @ C.T @ np.linalg.inv(C @ settled @ C.T + R)
    last = result.filtered.mean[-1] - result.predicted.mean[-1]
    assert np.allclose(last.numpy(), gain @ result.innovation[-1].numpy(), rtol=1e-9, atol=1e-12)


def test_repeated_measurements_of_a_constant_average():
    """1/P = 1/P₀ + N/R; the mean weighs the first guess like P₀⁻¹ and each measurement like R⁻¹."""
    one = torch.ones(1, 1, dtype=torch.float64)
    values = torch.tensor([[1.0], [2.0], [float("nan")], [6.0]], dtype=torch.float64)
    model = LinearModel(one, torch.zeros(1, dtype=torch.float64), 0.0 * one, one, torch.zeros(1, dtype=torch.float64), 0.5 * one)
    last = kalman_filter(model, values, Gaussian(torch.full((1,), 10.0, dtype=torch.float64), 2.0 * one)).filtered
    assert float(last.covariance[-1]) == pytest.approx(1.0 / (1 / 2.0 + 3 / 0.5))
    assert float(last.mean[-1]) == pytest.approx((10.0 / 2.0 + 9.0 / 0.5) / (1 / 2.0 + 3 / 0.5))


def test_sequences_of_a_batch_are_filtered_as_if_alone():
    model, measurements, initial = example(2, 4, 5, seed=4, missing=0.2)
    together = kalman_filter(model, measurements, initial)
    states = smooth(model, together)
    assert together.filtered.covariance.shape == (2, 4, 5, N, N)
    alone_model = LinearModel(*(part[1, 2] for part in model))
    alone = kalman_filter(alone_model, measurements[1, 2], initial)
    assert torch.allclose(together.filtered.mean[1, 2], alone.filtered.mean, rtol=0, atol=1e-12)
    assert torch.allclose(together.log_likelihood[1, 2], alone.log_likelihood, rtol=0, atol=1e-12)
    assert torch.allclose(states.covariance[1, 2], smooth(alone_model, alone).covariance, rtol=0, atol=1e-12)


@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_gradients_are_those_of_finite_differences(missing):
    model, measurements, initial = example(4, seed=5, missing=missing)
    missing_there = torch.isnan(measurements)
    parts = [part.clone().requires_grad_() for part in (*model, torch.nan_to_num(measurements), *initial)]

    def outcome(*parts):
        symmetric = [part + part.mT if part.shape[-2:] in {(N, N), (M, M)} and i in (2, 5, 8) else part for i, part in enumerate(parts)]
        own = LinearModel(*symmetric[:6])
        result = kalman_filter(own, torch.where(missing_there, torch.nan, symmetric[6]), Gaussian(*symmetric[7:]))
        return result.log_likelihood.sum(), smooth(own, result).mean

    assert torch.autograd.gradcheck(outcome, parts, atol=1e-6)


def test_what_is_missing_has_no_part_in_gradients_and_leaves_them_finite():
    model, measurements, initial = example(5, seed=6)
    measurements[2] = torch.nan
    measurements[3, 0] = torch.nan
    parts = [part.clone().requires_grad_() for part in (*model, measurements)]
    result = kalman_filter(LinearModel(*parts[:6]), parts[6], initial)
    (result.log_likelihood.sum() + result.filtered.mean.sum() + result.filtered.covariance.sum()).backward()
    assert all(torch.isfinite(part.grad).all() for part in parts)
    gone = torch.isnan(measurements)
    for part in (parts[3], parts[4], parts[6]):
        assert (part.grad[gone] == 0).all()
        assert (part.grad[~gone] != 0).any()
    assert (parts[5].grad[2] == 0).all()
    assert result.log_likelihood[2] == 0
    assert torch.equal(result.filtered.mean[2], result.predicted.mean[2])
    assert torch.equal(result.innovation_covariance[2], torch.eye(M, dtype=torch.float64))


def test_steps_are_those_of_the_whole():
    model, measurements, initial = example(2, seed=7)
    result = kalman_filter(model, measurements, initial)
    state = condition_on(initial, measurements[0], model.observation[0], model.observation_offset[0], model.observation_noise[0]).state
    state = predict(state, model.transition[0], model.transition_offset[0], model.process_noise[0])
    assert torch.equal(state.covariance, result.predicted.covariance[1])


def test_covariances_stay_symmetric_and_positive_in_single_precision():
    """From a first variance of 1e4 down to 1e-3; the short form of the update, (I - KC)P, turns negative on the way."""
    model, measurements, _ = example(300, seed=8)
    model = model._replace(process_noise=0.01 * model.process_noise, observation_noise=0.01 * model.observation_noise)
    initial = Gaussian(torch.zeros(N, dtype=torch.float64), 1e4 * torch.eye(N, dtype=torch.float64))
    single, start = LinearModel(*(part.float() for part in model)), Gaussian(*(part.float() for part in initial))
    result = kalman_filter(single, measurements.float(), start).filtered.covariance
    assert torch.equal(result, result.mT)
    exact = kalman_filter(model, measurements, initial).filtered.covariance
    assert float(torch.linalg.eigvalsh(result.double()).min()) == pytest.approx(float(torch.linalg.eigvalsh(exact).min()), rel=1e-3)
    assert torch.allclose(result[-1].double(), exact[-1], rtol=0, atol=1e-5 * float(exact[-1].abs().max()))
    short, lowest = start.covariance, 0.0
    for A, _, Q, C, _, R in zip(*single, strict=True):
        gain = short @ C.mT @ torch.linalg.inv(C @ short @ C.mT + R)
        short = (torch.eye(N) - gain @ C) @ short
        lowest = min(lowest, float(torch.linalg.eigvalsh((short + short.mT).double()).min()))
        short = A @ short @ A.mT + Q
    assert lowest < 0, "otherwise this example would show nothing"


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_compiled_scan_gives_the_numbers_of_the_readable_filter(missing):
    model, measurements, initial = example(400, seed=9, missing=missing)
    plain = kalman_filter(model, measurements, initial)
    scanned = kalman_scan(arrays(model), measurements.numpy(), arrays(initial))
    pairs = [
        *zip(plain.predicted, scanned.predicted, strict=True),
        *zip(plain.filtered, scanned.filtered, strict=True),
        (plain.innovation, scanned.innovation),
        (plain.innovation_covariance, scanned.innovation_covariance),
        (plain.log_likelihood, scanned.log_likelihood),
    ]
    assert all(np.abs(one.numpy() - other).max() < 1e-9 for one, other in pairs)
    assert np.array_equal(plain.measured.numpy(), scanned.measured)


def test_scan_of_a_long_recording_takes_well_under_a_second():
    model, _, initial = example(1, seed=10)
    constant = LinearModel(*(part[0].numpy() for part in model))
    measurements = np.random.default_rng(0).standard_normal((55_000, M))
    kalman_scan(constant, measurements[:2], arrays(initial))
    started = time.perf_counter()
    kalman_scan(constant, measurements, arrays(initial))
    assert time.perf_counter() - started < 1.0  # 0.05 s on the machine it was written on


def test_shapes_that_do_not_fit_are_refused():
    model, measurements, initial = example(4)
    wrong = model._replace(observation=model.observation[..., :2])
    with pytest.raises(ValueError, match=r"observation of shape \(4, 2, 2\) does not fit \(4, 2, 3\)"):
        kalman_filter(wrong, measurements, initial)
    with pytest.raises(ValueError, match=r"observation of shape \(4, 2, 2\) does not fit \(4, 2, 3\)"):
        kalman_scan(arrays(wrong), measurements.numpy(), arrays(initial))
    with pytest.raises(ValueError, match=r"initial\.mean of shape \(2,\)"):
        kalman_filter(model, measurements, Gaussian(initial.mean[:2], initial.covariance))
    for empty in (measurements[:0], measurements[0]):
        with pytest.raises(ValueError, match="with T > 0"):
            kalman_filter(model, empty, initial)
        with pytest.raises(ValueError, match="with T > 0"):
            kalman_scan(arrays(model), empty.numpy(), arrays(initial))


def test_noise_that_is_not_positive_is_refused():
    model, measurements, initial = example(4)
    noise = model.observation_noise.clone()
    noise[2] = -1e3 * torch.eye(M, dtype=torch.float64)
    wrong = model._replace(observation_noise=noise)
    with pytest.raises(torch.linalg.LinAlgError):
        kalman_filter(wrong, measurements, initial)
    with pytest.raises(np.linalg.LinAlgError, match="at sample 2"):
        kalman_scan(arrays(wrong), measurements.numpy(), arrays(initial))
