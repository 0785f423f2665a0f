"""The Kalman filter and the Rauch-Tung-Striebel smoother of time-varying linear models, batched and differentiable."""

from __future__ import annotations

import math
from typing import Generic, NamedTuple

import numpy as np
import torch
from torch import Tensor

from vehest.constants import FloatArray
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Array, Filtered, Gaussian, stacked, symmetric


class LinearModel(NamedTuple, Generic[Array]):
    """A linear model of T samples with Gaussian noise.

    x[k+1] = A[k] x[k] + b[k] + w[k],  w[k] ~ N(0, Q[k])
    y[k]   = C[k] x[k] + d[k] + v[k],  v[k] ~ N(0, R[k])

    Known inputs are part of b and d. Leading dimensions broadcast against those of the measurements, (..., T); what is
    constant over time or the same for all sequences needs no dimension for it.

    Attributes:
        transition: A, (..., T, n, n); A[k] leads from sample k to k+1, so the last one is not used.
        transition_offset: b, (..., T, n).
        process_noise: Q, (..., T, n, n).
        observation: C, (..., T, m, n).
        observation_offset: d, (..., T, m).
        observation_noise: R, (..., T, m, m), positive definite.
    """

    transition: Array
    transition_offset: Array
    process_noise: Array
    observation: Array
    observation_offset: Array
    observation_noise: Array


def kalman_filter(
    model: LinearModel[Tensor], measurements: Tensor, initial: Gaussian[Tensor], gate: Gate | None = None
) -> Filtered[Tensor]:
    """Filter sequences; what is NaN was not measured and is skipped, and gradients stay finite.

    Args:
        model: see `LinearModel`.
        measurements: y, (..., T, m).
        initial: state at the first sample before its measurement, mean (..., n).
        gate: which measurements are refused; none: all are taken.

    Raises:
        ValueError: shapes do not fit each other.
        torch.linalg.LinAlgError: an innovation covariance is not positive definite.

    Source: Kalman 1960; Joseph's form of the update (Bucy & Joseph 1968), with which covariances stay symmetric and positive.
    """
    model = _expanded(model, measurements)
    batch, n = measurements.shape[:-2], model.transition.shape[-1]
    state = Gaussian(_expand("initial.mean", initial.mean, (*batch, n)), _expand("initial.covariance", initial.covariance, (*batch, n, n)))
    predicted, updates, taken = [], [], []
    refused = torch.zeros_like(measurements[..., 0, :], dtype=torch.int64)
    for k in range(measurements.shape[-2]):
        if k > 0:
            state = predict(
                state,
                model.transition[..., k - 1, :, :],
                model.transition_offset[..., k - 1, :],
                model.process_noise[..., k - 1, :, :],
            )
        predicted.append(state)
        y = measurements[..., k, :]
        observation = model.observation[..., k, :, :]
        offset, noise = model.observation_offset[..., k, :], model.observation_noise[..., k, :, :]
        if gate is not None:
            variance = (observation @ state.covariance @ observation.mT + noise).diagonal(dim1=-2, dim2=-1)
            y, refused = gate.apply(y, _times(observation, state.mean) + offset, variance, refused)
        taken.append(y)
        update = condition_on(state, y, observation, offset, noise)
        updates.append(update)
        state = update.state
    axis = len(batch)
    return Filtered(
        stacked(predicted, axis),
        stacked([update.state for update in updates], axis),
        torch.stack([update.innovation for update in updates], axis),
        torch.stack([update.innovation_covariance for update in updates], axis),
        ~torch.isnan(torch.stack(taken, axis)),
        torch.stack([update.log_likelihood for update in updates], axis),
    )


class Update(NamedTuple):
    """A state after a measurement, and how the measurement compared with what was expected of it (see `Filtered`)."""

    state: Gaussian[Tensor]
    innovation: Tensor
    innovation_covariance: Tensor
    log_likelihood: Tensor


def predict(state: Gaussian[Tensor], transition: Tensor, offset: Tensor, noise: Tensor) -> Gaussian[Tensor]:
    """The state one sample later: A x + b, A P Aᵀ + Q.

    Args:
        state: mean (..., n).
        transition: A, (..., n, n).
        offset: b, (..., n).
        noise: Q, (..., n, n).
    """
    mean = _times(transition, state.mean) + offset
    return Gaussian(mean, symmetric(transition @ state.covariance @ transition.mT + noise))


def condition_on(state: Gaussian[Tensor], measurement: Tensor, observation: Tensor, offset: Tensor, noise: Tensor) -> Update:
    """The state given a measurement y = C x + d + v, v ~ N(0, R), whose NaN entries are skipped.

    They are masked before any arithmetic: a masked entry has no part in values or gradients.

    Args:
        state: mean (..., n).
        measurement: y, (..., m).
        observation: C, (..., m, n).
        offset: d, (..., m).
        noise: R, (..., m, m).
    """
    measured = ~torch.isnan(measurement)
    zero = torch.zeros((), dtype=measurement.dtype, device=measurement.device)
    identity = torch.eye(measurement.shape[-1], dtype=measurement.dtype, device=measurement.device)
    observation = torch.where(measured.unsqueeze(-1), observation, zero)
    noise = torch.where(measured.unsqueeze(-1) & measured.unsqueeze(-2), noise, identity)
    innovation = torch.where(measured, measurement, zero) - _times(observation, state.mean) - torch.where(measured, offset, zero)
    cross = observation @ state.covariance
    covariance = symmetric(cross @ observation.mT + noise)
    factor = torch.linalg.cholesky(covariance)
    gain = torch.cholesky_solve(cross, factor).mT
    kept = torch.eye(state.mean.shape[-1], dtype=measurement.dtype, device=measurement.device) - gain @ observation
    posterior = Gaussian(
        state.mean + _times(gain, innovation),
        symmetric(kept @ state.covariance @ kept.mT + gain @ noise @ gain.mT),
    )
    whitened = torch.linalg.solve_triangular(factor, innovation.unsqueeze(-1), upper=False).squeeze(-1)
    determinant = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    count = measured.sum(-1, dtype=measurement.dtype)
    likelihood = -0.5 * (whitened.square().sum(-1) + determinant + count * math.log(2.0 * math.pi))
    return Update(posterior, innovation, covariance, likelihood)


def smooth(model: LinearModel[Tensor], filtered: Filtered[Tensor]) -> Gaussian[Tensor]:
    """States given all measurements, earlier and later ones.

    Args:
        model: that `kalman_filter` was given.
        filtered: what it returned.

    Returns:
        Mean (..., T, n).

    Raises:
        torch.linalg.LinAlgError: a predicted covariance is not positive definite.

    Source: Rauch, Tung & Striebel 1965.
    """
    means, covariances = filtered.filtered
    transition = model.transition.expand(*means.shape, means.shape[-1])
    state = Gaussian(means[..., -1, :], covariances[..., -1, :, :])
    states = [state]
    for k in range(means.shape[-2] - 2, -1, -1):
        expected = Gaussian(filtered.predicted.mean[..., k + 1, :], filtered.predicted.covariance[..., k + 1, :, :])
        own = covariances[..., k, :, :]
        gain = torch.cholesky_solve(transition[..., k, :, :] @ own, torch.linalg.cholesky(expected.covariance)).mT
        state = Gaussian(
            means[..., k, :] + _times(gain, state.mean - expected.mean),
            symmetric(own + gain @ (state.covariance - expected.covariance) @ gain.mT),
        )
        states.append(state)
    return stacked(states[::-1], means.dim() - 2)


def smoothed_means(model: LinearModel[FloatArray], filtered: Filtered[FloatArray]) -> FloatArray:
    """Mean states given all measurements of one sequence, (T, n).

    Args:
        model: that `kalman_scan` was given, with all its dimensions.
        filtered: what it returned.

    Raises:
        numpy.linalg.LinAlgError: a predicted covariance is singular.

    Source: Rauch, Tung & Striebel 1965.
    """
    ahead = filtered.predicted
    gains = np.linalg.solve(ahead.covariance[1:], model.transition[:-1] @ filtered.filtered.covariance[:-1]).transpose(0, 2, 1)
    means = filtered.filtered.mean.copy()
    for k in range(len(means) - 2, -1, -1):
        means[k] += gains[k] @ (means[k + 1] - ahead.mean[k + 1])
    return means


def shapes_of(n: int, m: int) -> tuple[tuple[int, ...], ...]:
    """Shapes of a `LinearModel`'s parts at one sample, for n states and m measurements."""
    return (n, n), (n,), (n, n), (m, n), (m,), (m, m)


def _expanded(model: LinearModel[Tensor], measurements: Tensor) -> LinearModel[Tensor]:
    """The model with all dimensions, (..., T, ...), in every part."""
    if measurements.dim() < 2 or measurements.shape[-2] == 0:
        raise ValueError(f"measurements must be of shape (..., T, m) with T > 0, not {tuple(measurements.shape)}")
    samples = tuple(measurements.shape[:-1])
    shapes = shapes_of(model.transition.shape[-1], measurements.shape[-1])
    return LinearModel(
        *(_expand(name, part, (*samples, *shape)) for name, part, shape in zip(LinearModel._fields, model, shapes, strict=True))
    )


def _expand(name: str, part: Tensor, shape: tuple[int, ...]) -> Tensor:
    try:
        return part.expand(shape)
    except RuntimeError:
        raise ValueError(f"{name} of shape {tuple(part.shape)} does not fit {shape}") from None


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
