"""The extended and the unscented Kalman filter, batched and differentiable."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from vehest.filters.definiteness import factorised
from vehest.filters.gating import Gate
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
        repaired: bool, (..., T): a covariance had lost its definiteness at this sample, and was repaired or, with repair switched off,
            made everything from there on NaN.
    """

    steps: Filtered[Tensor]
    repaired: Tensor


class _Predicted(NamedTuple):
    state: Gaussian[Tensor]
    repaired: Tensor


class _Updated(NamedTuple):
    state: Gaussian[Tensor]
    innovation: Tensor
    innovation_covariance: Tensor
    log_likelihood: Tensor
    repaired: Tensor
    lost: Tensor


def unscented_filter(
    model: NonlinearModel,
    measurements: Tensor,
    inputs: Tensor,
    initial: Gaussian[Tensor],
    rule: SigmaRule,
    *,
    repair: bool = True,
    gate: Gate | None = None,
) -> NonlinearFiltered:
    """The unscented Kalman filter with additive noise; sigma points are drawn again before each update.

    Args:
        model: see `NonlinearModel`.
        measurements: y, (..., T, m); what is NaN was not measured and is skipped, and gradients stay finite.
        inputs: u, (..., T, p).
        initial: state at the first sample before its measurement, mean (..., n).
        rule: which sigma points.
        repair: whether covariances that are not positive definite are repaired; otherwise the sequence becomes NaN. Where a negative
            weight of the mean point is what takes the definiteness of an update, the update goes without it; everything else is lifted.
        gate: which measurements are refused; none: all are taken.

    Raises:
        ValueError: shapes do not fit each other.

    Source: Julier & Uhlmann 1997; van der Merwe 2004, Algorithm 3.1 with the points drawn again.
    """

    def predict(state: Gaussian[Tensor], u: Tensor) -> _Predicted:
        _, factor, repaired = factorised(state.covariance, repair=repair)
        points = model.possible(rule.points(state.mean, factor))
        after = model.transition(points, u.unsqueeze(-2))
        mean = rule.mean(after)
        deviations = after - mean.unsqueeze(-2)
        covariance = symmetric(rule.covariance(deviations, deviations) + model.process_noise(state.mean, u))
        return _Predicted(Gaussian(model.possible(mean), covariance), repaired)

    def foreseen(state: Gaussian[Tensor], u: Tensor) -> tuple[Tensor, Tensor]:
        points = model.possible(rule.points(state.mean, factorised(state.covariance, repair=repair)[1]))
        expected = model.observation(points, u.unsqueeze(-2))
        mean = rule.mean(expected)
        spread = expected - mean.unsqueeze(-2)
        return mean, rule.covariance(spread, spread).diagonal(dim1=-2, dim2=-1)

    def update(state: Gaussian[Tensor], y: Tensor, u: Tensor) -> _Updated:
        prior, factor, repaired = factorised(state.covariance, repair=repair)
        points = model.possible(rule.points(state.mean, factor))
        expected = model.observation(points, u.unsqueeze(-2))
        mean = rule.mean(expected)
        measured = ~torch.isnan(y)
        zero = torch.zeros((), dtype=y.dtype, device=y.device)
        spread = torch.where(measured.unsqueeze(-2), expected - mean.unsqueeze(-2), zero)
        deviations, known = points - state.mean.unsqueeze(-2), Gaussian(state.mean, prior)

        def conditioned(rule: SigmaRule) -> _Updated:
            own, cross = rule.covariance(spread, spread), rule.covariance(deviations, spread)
            return _conditioned(model, known, mean, own, cross, y, u, repaired, repair)

        updated = conditioned(rule)
        if not repair or rule.centre_covariance >= 0.0:
            return updated
        lost = updated.lost | factorised(updated.state.covariance).repaired
        if not bool(lost.any()):
            return updated
        return _either(lost, conditioned(replace(rule, centre_covariance=0.0)), updated)

    return _filtered(model, measurements, inputs, initial, predict, update, foreseen, gate)


def extended_filter(
    model: NonlinearModel,
    measurements: Tensor,
    inputs: Tensor,
    initial: Gaussian[Tensor],
    *,
    repair: bool = True,
    gate: Gate | None = None,
) -> NonlinearFiltered:
    """The extended Kalman filter; Jacobians by automatic differentiation.

    Args:
        model: see `NonlinearModel`; its functions must work on single states too.
        measurements: y, (..., T, m); what is NaN was not measured and is skipped.
        inputs: u, (..., T, p).
        initial: state at the first sample before its measurement, mean (..., n).
        repair: as for `unscented_filter`.
        gate: likewise.

    Raises:
        ValueError: shapes do not fit each other.

    Source: Jazwinski 1970, Chapter 8.
    """

    def predict(state: Gaussian[Tensor], u: Tensor) -> _Predicted:
        mean, slope = _linearised(model.transition, state.mean, u)
        covariance = symmetric(slope @ state.covariance @ slope.mT + model.process_noise(state.mean, u))
        return _Predicted(Gaussian(model.possible(mean), covariance), torch.zeros_like(mean[..., 0], dtype=torch.bool))

    def foreseen(state: Gaussian[Tensor], u: Tensor) -> tuple[Tensor, Tensor]:
        mean, slope = _linearised(model.observation, state.mean, u)
        return mean, (slope @ state.covariance @ slope.mT).diagonal(dim1=-2, dim2=-1)

    def update(state: Gaussian[Tensor], y: Tensor, u: Tensor) -> _Updated:
        mean, slope = _linearised(model.observation, state.mean, u)
        measured = ~torch.isnan(y)
        zero = torch.zeros((), dtype=y.dtype, device=y.device)
        slope = torch.where(measured.unsqueeze(-1), slope, zero)
        cross = state.covariance @ slope.mT
        nothing = torch.zeros_like(mean[..., 0], dtype=torch.bool)
        return _conditioned(model, state, mean, slope @ cross, cross, y, u, nothing, repair)

    return _filtered(model, measurements, inputs, initial, predict, update, foreseen, gate)


def _conditioned(
    model: NonlinearModel,
    state: Gaussian[Tensor],
    expected: Tensor,
    own: Tensor,
    cross: Tensor,
    y: Tensor,
    u: Tensor,
    repaired: Tensor,
    repair: bool,
) -> _Updated:
    """The state given a measurement of which mean, covariance without noise and cross covariance are known; NaN is skipped."""
    measured = ~torch.isnan(y)
    zero = torch.zeros((), dtype=y.dtype, device=y.device)
    identity = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
    noise = model.observation_noise(state.mean, u)
    noise = torch.where(measured.unsqueeze(-1) & measured.unsqueeze(-2), noise, identity)
    innovation = torch.where(measured, torch.where(measured, y, zero) - expected, zero)
    covariance, factor, lost = factorised(symmetric(own + noise), repair=repair)
    gain = torch.cholesky_solve(cross.mT, factor).mT
    reduction = gain @ covariance @ gain.mT
    if model.free is not None:
        gain = torch.where(model.free(state.mean, u).unsqueeze(-1), gain, zero)
        both = gain @ cross.mT
        reduction = both + both.mT - gain @ covariance @ gain.mT
    mean = model.possible(state.mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1))
    posterior = Gaussian(mean, symmetric(state.covariance - reduction))
    whitened = torch.linalg.solve_triangular(factor, innovation.unsqueeze(-1), upper=False).squeeze(-1)
    determinant = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    count = measured.sum(-1, dtype=y.dtype)
    likelihood = -0.5 * (whitened.square().sum(-1) + determinant + count * math.log(2.0 * math.pi))
    return _Updated(posterior, innovation, covariance, likelihood, repaired | lost, lost)


def _either(lost: Tensor, one: _Updated, other: _Updated) -> _Updated:
    """One update where something was lost, which counts as repaired, and the other elsewhere."""

    def chosen(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(lost.reshape(*lost.shape, *[1] * (a.dim() - lost.dim())), a, b)

    state = Gaussian(*(chosen(a, b) for a, b in zip(one.state, other.state, strict=True)))
    rest = [chosen(a, b) for a, b in zip(one[1:4], other[1:4], strict=True)]
    return _Updated(state, rest[0], rest[1], rest[2], other.repaired | lost, lost)


def _filtered(
    model: NonlinearModel,
    measurements: Tensor,
    inputs: Tensor,
    initial: Gaussian[Tensor],
    predict: Callable[[Gaussian[Tensor], Tensor], _Predicted],
    update: Callable[[Gaussian[Tensor], Tensor, Tensor], _Updated],
    foreseen: Callable[[Gaussian[Tensor], Tensor], tuple[Tensor, Tensor]],
    gate: Gate | None,
) -> NonlinearFiltered:
    """Go through sequences; ``foreseen`` gives what a gate needs: mean and variance, without noise, of what is expected."""
    if measurements.dim() < 2 or measurements.shape[-2] == 0:
        raise ValueError(f"measurements must be of shape (..., T, m) with T > 0, not {tuple(measurements.shape)}")
    if inputs.shape[:-1] != measurements.shape[:-1]:
        raise ValueError(f"inputs of shape {tuple(inputs.shape)} do not fit measurements of shape {tuple(measurements.shape)}")
    batch, n = measurements.shape[:-2], initial.mean.shape[-1]
    try:
        state = Gaussian(initial.mean.expand(*batch, n), initial.covariance.expand(*batch, n, n))
    except RuntimeError:
        raise ValueError(
            f"the initial state, mean {tuple(initial.mean.shape)} and covariance {tuple(initial.covariance.shape)}, does not fit "
            f"{tuple(batch)} sequences"
        ) from None
    predictions, updates, taken, lost = [], [], [], []
    refused = torch.zeros_like(measurements[..., 0, :], dtype=torch.int64)
    for k in range(measurements.shape[-2]):
        repaired = torch.zeros(batch, dtype=torch.bool, device=measurements.device)
        if k > 0:
            state, repaired = predict(state, inputs[..., k - 1, :])
            state = state if model.restart is None else model.restart(state, inputs[..., k, :])
        predictions.append(state)
        y, u = measurements[..., k, :], inputs[..., k, :]
        if gate is not None:
            expected, variance = foreseen(state, u)
            noise = model.observation_noise(state.mean, u).diagonal(dim1=-2, dim2=-1)
            y, refused = gate.apply(y, expected, variance.clamp(min=0.0) + noise, refused)
        taken.append(y)
        own = update(state, y, u)
        updates.append(own)
        lost.append(repaired | own.repaired)
        state = own.state
    axis = len(batch)
    steps = Filtered(
        stacked(predictions, axis),
        stacked([own.state for own in updates], axis),
        torch.stack([own.innovation for own in updates], axis),
        torch.stack([own.innovation_covariance for own in updates], axis),
        ~torch.isnan(torch.stack(taken, axis)),
        torch.stack([own.log_likelihood for own in updates], axis),
    )
    return NonlinearFiltered(steps, torch.stack(lost, axis))


def _linearised(function: Function, state: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Value and Jacobian with respect to the state, (..., m) and (..., m, n)."""
    flat_state, flat_u = state.reshape(-1, state.shape[-1]), u.expand(*state.shape[:-1], u.shape[-1]).reshape(-1, u.shape[-1])
    slope = torch.func.vmap(torch.func.jacfwd(function))(flat_state, flat_u)
    value = function(state, u)
    return value, slope.reshape(*value.shape, state.shape[-1])
