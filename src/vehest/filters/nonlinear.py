"""The unscented Kalman filter, batched and differentiable, of models written in torch."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from vehest.filters.definiteness import factorised
from vehest.filters.gaussian import Filtered, Gaussian, stacked, symmetric
from vehest.filters.sigma_points import SigmaRule

Function = Callable[[Tensor, Tensor], Tensor]
"""Of states (..., n) and inputs (..., p); leading dimensions of both are equal or broadcast."""


@dataclass(frozen=True)
class NonlinearModel:
    """A nonlinear model with Gaussian noise.

    x[k+1] = f(x[k], u[k]) + w[k],  w[k] ~ N(0, Q(x[k], u[k]))
    y[k]   = h(x[k], u[k]) + v[k],  v[k] ~ N(0, R(x[k], u[k]))

    Args:
        transition: f, (..., n).
        observation: h, (..., m).
        process_noise: Q of the estimated state, (..., n, n).
        observation_noise: R of the predicted state, (..., m, m).
        constrain: puts a state back into what is possible, such as a friction above 0; none: everything is.
        restart: what is known instead after a prediction that leaves too little known, of state and u[k]; none: nothing else.
        free: bool, which states a measurement may change, (..., n), of the predicted state; none: all. What is held keeps its variance
            (Schmidt's consider state).
    """

    transition: Function
    observation: Function
    process_noise: Function
    observation_noise: Function
    constrain: Callable[[Tensor], Tensor] | None = None
    restart: Callable[[Gaussian[Tensor], Tensor], Gaussian[Tensor]] | None = None
    free: Function | None = None

    def possible(self, state: Tensor) -> Tensor:
        """States that `constrain` allows."""
        return state if self.constrain is None else self.constrain(state)


class NonlinearFiltered(NamedTuple):
    """What a nonlinear filter knows after a sequence.

    Attributes:
        steps: see `Filtered`.
        repaired: bool, (..., T): a covariance had lost its definiteness at this sample, and was repaired or, in a scan without repair,
            made everything from there on NaN.
    """

    steps: Filtered[Tensor]
    repaired: Tensor


class _Updated(NamedTuple):
    state: Gaussian[Tensor]
    innovation: Tensor
    innovation_covariance: Tensor
    log_likelihood: Tensor
    lost: Tensor


def unscented_filter(
    model: NonlinearModel, measurements: Tensor, inputs: Tensor, initial: Gaussian[Tensor], rule: SigmaRule
) -> NonlinearFiltered:
    """The unscented Kalman filter with additive noise; sigma points are drawn again before each update.

    Covariances that are not positive definite are repaired. Where a negative weight of the mean point is what takes the definiteness of an
    update, the update goes without it; everything else is lifted.

    Args:
        model: see `NonlinearModel`.
        measurements: y, (..., T, m); what is NaN was not measured and is skipped, and gradients stay finite.
        inputs: u, (..., T, p).
        initial: state at the first sample before its measurement, mean (..., n).
        rule: which sigma points.

    Source: Julier & Uhlmann 1997; van der Merwe 2004, Algorithm 3.1 with the points drawn again.
    """
    batch, n = measurements.shape[:-2], initial.mean.shape[-1]
    state = Gaussian(initial.mean.expand(*batch, n), initial.covariance.expand(*batch, n, n))
    predictions, updates, lost = [], [], []
    for k in range(measurements.shape[-2]):
        repaired = torch.zeros(batch, dtype=torch.bool, device=measurements.device)
        if k > 0:
            state, repaired = _predicted(model, state, inputs[..., k - 1, :], rule)
            state = state if model.restart is None else model.restart(state, inputs[..., k, :])
        predictions.append(state)
        prior, factor, again = factorised(state.covariance)
        update = _updated(model, Gaussian(state.mean, prior), factor, measurements[..., k, :], inputs[..., k, :], rule)
        updates.append(update)
        lost.append(repaired | again | update.lost)
        state = update.state
    axis = len(batch)
    steps = Filtered(
        stacked(predictions, axis),
        stacked([update.state for update in updates], axis),
        torch.stack([update.innovation for update in updates], axis),
        torch.stack([update.innovation_covariance for update in updates], axis),
        ~torch.isnan(measurements),
        torch.stack([update.log_likelihood for update in updates], axis),
    )
    return NonlinearFiltered(steps, torch.stack(lost, axis))


def _predicted(model: NonlinearModel, state: Gaussian[Tensor], u: Tensor, rule: SigmaRule) -> tuple[Gaussian[Tensor], Tensor]:
    """The state one sample later, and whether its covariance had to be repaired."""
    _, factor, repaired = factorised(state.covariance)
    points = model.possible(rule.points(state.mean, factor))
    after = model.transition(points, u.unsqueeze(-2))
    mean = rule.mean(after)
    deviations = after - mean.unsqueeze(-2)
    covariance = symmetric(rule.covariance(deviations, deviations) + model.process_noise(state.mean, u))
    return Gaussian(model.possible(mean), covariance), repaired


def _updated(model: NonlinearModel, state: Gaussian[Tensor], factor: Tensor, y: Tensor, u: Tensor, rule: SigmaRule) -> _Updated:
    """The state given a measurement, of which NaN is skipped."""
    points = model.possible(rule.points(state.mean, factor))
    expected = model.observation(points, u.unsqueeze(-2))
    mean = rule.mean(expected)
    measured = ~torch.isnan(y)
    zero = torch.zeros((), dtype=y.dtype, device=y.device)
    identity = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
    spread = torch.where(measured.unsqueeze(-2), expected - mean.unsqueeze(-2), zero)
    deviations = points - state.mean.unsqueeze(-2)
    noise = torch.where(measured.unsqueeze(-1) & measured.unsqueeze(-2), model.observation_noise(state.mean, u), identity)
    innovation = torch.where(measured, torch.where(measured, y, zero) - mean, zero)

    def conditioned(rule: SigmaRule) -> _Updated:
        covariance, factor, lost = factorised(symmetric(rule.covariance(spread, spread) + noise))
        cross = rule.covariance(deviations, spread)
        gain = torch.cholesky_solve(cross.mT, factor).mT
        reduction = gain @ covariance @ gain.mT
        if model.free is not None:
            gain = torch.where(model.free(state.mean, u).unsqueeze(-1), gain, zero)
            both = gain @ cross.mT
            reduction = both + both.mT - gain @ covariance @ gain.mT
        posterior = model.possible(state.mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1))
        whitened = torch.linalg.solve_triangular(factor, innovation.unsqueeze(-1), upper=False).squeeze(-1)
        determinant = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        count = measured.sum(-1, dtype=y.dtype)
        likelihood = -0.5 * (whitened.square().sum(-1) + determinant + count * math.log(2.0 * math.pi))
        return _Updated(Gaussian(posterior, symmetric(state.covariance - reduction)), innovation, covariance, likelihood, lost)

    updated = conditioned(rule)
    if rule.centre_covariance >= 0.0:
        return updated
    lost = updated.lost | factorised(updated.state.covariance).repaired
    if not bool(lost.any()):
        return updated
    without = conditioned(replace(rule, centre_covariance=0.0))

    def chosen(one: Tensor, other: Tensor) -> Tensor:
        return torch.where(lost.reshape(*lost.shape, *[1] * (one.dim() - lost.dim())), one, other)

    return _Updated(
        Gaussian(*map(chosen, without.state, updated.state)),
        innovation,
        chosen(without.innovation_covariance, updated.innovation_covariance),
        chosen(without.log_likelihood, updated.log_likelihood),
        lost,
    )
