"""Filters to compare compiled ones with: unscented and extended as their equations stand, in torch, and a gate around any filter."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.func import jacfwd

from vehest.estimators.rational_ekf import LOST, ROLLING
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.sigma_points import SigmaRule
from vehest.filters.unscented_scan import MARGIN, Function, NonlinearFiltered


def sigma_points(rule, mean, factor):
    """Points of N(mean, L Lᵀ), the mean first, (..., 2n + 1, n), of a mean (..., n) and L, lower triangular, (..., n, n)."""
    offsets = rule.spread * factor.mT
    centre = mean.unsqueeze(-2)
    return torch.cat([centre, centre + offsets, centre - offsets], dim=-2)


def mean_of(rule, values):
    """Weighted mean of values at the points, (..., 2n + 1, m) -> (..., m)."""
    return rule.centre_mean * values[..., 0, :] + rule.other * values[..., 1:, :].sum(-2)


def covariance_of(rule, deviations, others):
    """Weighted Σ w d eᵀ of deviations from the mean, (..., 2n + 1, m) and (..., 2n + 1, k) -> (..., m, k)."""
    centre = deviations[..., 0, :].unsqueeze(-1) * others[..., 0, :].unsqueeze(-2)
    return rule.centre_covariance * centre + rule.other * (deviations[..., 1:, :].mT @ others[..., 1:, :])


def stacked(states, axis):
    """States of successive samples as one, with the samples along an axis of the means."""
    return Gaussian(torch.stack([state.mean for state in states], axis), torch.stack([state.covariance for state in states], axis))


def symmetric(matrix):
    """The symmetric part, which rounding has left a little (..., n, n)."""
    return 0.5 * (matrix + matrix.mT)


class Factor(NamedTuple):
    """A covariance, NaN where it could not be repaired, L with L Lᵀ = covariance, both (..., n, n), and whether it was repaired, (...)."""

    covariance: Tensor
    factor: Tensor
    repaired: Tensor


def factorised(covariance):
    """Cholesky factor of a covariance, lifted first where it is not positive definite.

    Lifting adds the same to every eigenvalue, as much as is needed for a margin of `MARGIN`; what is added counts as a constant in
    gradients. Covariances that are not finite stay NaN, each for itself: the others of a batch go on.
    """
    finite = torch.isfinite(covariance).all(-1).all(-1)
    identity = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    safe = torch.where(finite[..., None, None], covariance, identity)
    factor, info = torch.linalg.cholesky_ex(safe)
    lost = info > 0
    if bool(lost.any()):
        with torch.no_grad():
            eigenvalues = torch.linalg.eigvalsh(safe)
            lift = MARGIN * eigenvalues.abs().amax(-1) - eigenvalues[..., 0]
        safe = safe + torch.where(lost, lift, 0.0)[..., None, None] * identity
        factor, info = torch.linalg.cholesky_ex(safe)
    whole = (finite & (info == 0))[..., None, None]
    return Factor(torch.where(whole, safe, torch.nan), torch.where(whole, factor, torch.nan), lost & finite)


@dataclass(frozen=True)
class NonlinearModel:
    """A nonlinear model with Gaussian noise.

    x[k+1] = f(x[k], u[k]) + w[k],  w[k] ~ N(0, Q(x[k], u[k]))
    y[k]   = h(x[k], u[k]) + v[k],  v[k] ~ N(0, R(x[k], u[k]))

    ``constrain`` puts a state back into what is possible; ``restart`` says what is known after a prediction that leaves too little known;
    ``free`` (..., n) is which states a measurement may change: what is held keeps its variance (Schmidt's consider state).
    """

    transition: Function
    observation: Function
    process_noise: Function
    observation_noise: Function
    constrain: Callable[[Tensor], Tensor] | None = None
    restart: Callable[[Gaussian[Tensor], Tensor], Gaussian[Tensor]] | None = None
    free: Function | None = None

    def possible(self, state):
        """States that `constrain` allows."""
        return state if self.constrain is None else self.constrain(state)


class _Updated(NamedTuple):
    state: Gaussian[Tensor]
    innovation: Tensor
    innovation_covariance: Tensor
    lost: Tensor


def log_likelihood(steps):
    """Of each sample's measurements given those before, (..., T), by innovations and their covariances; 0 where nothing was measured."""
    errors, covariances, measured = (torch.as_tensor(part) for part in (steps.innovation, steps.innovation_covariance, steps.measured))
    squared = torch.linalg.solve(covariances, errors).mul(errors).sum(-1)
    return -0.5 * (squared + torch.logdet(covariances) + measured.sum(-1, dtype=errors.dtype) * math.log(2.0 * math.pi))


def unscented_filter(model, measurements, inputs, initial, rule):
    """The unscented Kalman filter with additive noise; sigma points are drawn again before each update.

    Covariances that are not positive definite are repaired. Where a negative weight of the mean point is what takes the definiteness of an
    update, the update goes without it; everything else is lifted.
    Measurements (..., T, m) that are NaN are skipped, and gradients stay finite; ``initial`` is the state before the first of them.

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
    )
    return NonlinearFiltered(steps, torch.stack(lost, axis))


def _predicted(model, state, u, rule):
    """The state one sample later, and whether its covariance had to be repaired."""
    _, factor, repaired = factorised(state.covariance)
    drawn = model.possible(sigma_points(rule, state.mean, factor))
    after = model.transition(drawn, u.unsqueeze(-2))
    mean = mean_of(rule, after)
    deviations = after - mean.unsqueeze(-2)
    covariance = symmetric(covariance_of(rule, deviations, deviations) + model.process_noise(state.mean, u))
    return Gaussian(model.possible(mean), covariance), repaired


def _updated(model, state, factor, y, u, rule):
    """The state given a measurement, of which NaN is skipped."""
    drawn = model.possible(sigma_points(rule, state.mean, factor))
    expected = model.observation(drawn, u.unsqueeze(-2))
    mean = mean_of(rule, expected)
    measured = ~torch.isnan(y)
    zero = torch.zeros((), dtype=y.dtype, device=y.device)
    identity = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
    spread = torch.where(measured.unsqueeze(-2), expected - mean.unsqueeze(-2), zero)
    deviations = drawn - state.mean.unsqueeze(-2)
    noise = torch.where(measured.unsqueeze(-1) & measured.unsqueeze(-2), model.observation_noise(state.mean, u), identity)
    innovation = torch.where(measured, torch.where(measured, y, zero) - mean, zero)

    def conditioned(rule):
        covariance, factor, lost = factorised(symmetric(covariance_of(rule, spread, spread) + noise))
        cross = covariance_of(rule, deviations, spread)
        gain = torch.cholesky_solve(cross.mT, factor).mT
        reduction = gain @ covariance @ gain.mT
        if model.free is not None:
            gain = torch.where(model.free(state.mean, u).unsqueeze(-1), gain, zero)
            both = gain @ cross.mT
            reduction = both + both.mT - gain @ covariance @ gain.mT
        posterior = model.possible(state.mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1))
        return _Updated(Gaussian(posterior, symmetric(state.covariance - reduction)), innovation, covariance, lost)

    updated = conditioned(rule)
    if rule.centre_covariance >= 0.0:
        return updated
    lost = updated.lost | factorised(updated.state.covariance).repaired
    if not bool(lost.any()):
        return updated
    without = conditioned(replace(rule, centre_covariance=0.0))

    def chosen(one, other):
        return torch.where(lost.reshape(*lost.shape, *[1] * (one.dim() - lost.dim())), one, other)

    return _Updated(
        Gaussian(*map(chosen, without.state, updated.state)),
        innovation,
        chosen(without.innovation_covariance, updated.innovation_covariance),
        lost,
    )


def extended_filter(model, measurements, inputs, initial):
    """The extended Kalman filter of one sequence, (T, m) and (T, p); Jacobians by automatic differentiation, NaN is skipped.

    Source: Jazwinski 1970, Chapter 8; the update holds for any gain, also that of a consider state (Schmidt).
    """
    state, samples = initial, []
    for k, (y, u) in enumerate(zip(measurements, inputs, strict=True)):
        if k > 0:
            before, pushed = state.mean, inputs[k - 1]
            slope = jacfwd(model.transition)(before, pushed)
            covariance = slope @ state.covariance @ slope.mT + model.process_noise(before, pushed)
            state = Gaussian(model.possible(model.transition(before, pushed)), 0.5 * (covariance + covariance.mT))
            state = state if model.restart is None else model.restart(state, u)
        measured = ~torch.isnan(y)
        H = torch.where(measured[:, None], jacfwd(model.observation)(state.mean, u), 0.0)
        R = torch.where(measured[:, None] & measured, model.observation_noise(state.mean, u), torch.eye(len(y), dtype=y.dtype))
        innovation = torch.where(measured, y - model.observation(state.mean, u), 0.0)
        S, cross = H @ state.covariance @ H.mT + R, state.covariance @ H.mT
        gain = torch.linalg.solve(S, cross.mT).mT
        if model.free is not None:
            gain = torch.where(model.free(state.mean, u)[:, None], gain, 0.0)
        covariance = state.covariance - gain @ cross.mT - cross @ gain.mT + gain @ S @ gain.mT
        posterior = Gaussian(model.possible(state.mean + gain @ innovation), 0.5 * (covariance + covariance.mT))
        samples.append((*state, *posterior, innovation, S, measured))
        state = posterior
    parts = [torch.stack(part) for part in zip(*samples, strict=True)]
    return Filtered(Gaussian(*parts[:2]), Gaussian(*parts[2:4]), *parts[4:])


def rational_model(estimator):
    """The model of a `RationalFilter`; inputs are speed and steering angle, and a lost sideslip angle is that of a car that rolls."""
    track, bound = estimator.track(), torch.as_tensor(estimator.bounds())
    car, n_tyres, levels = estimator.car, len(estimator.adapted), estimator.values
    noise = torch.tensor([levels["yaw_rate"], levels["ay"]], dtype=torch.float64).square().diag()

    def adapts(yaw_rate, inputs):
        return bool((inputs[0] * yaw_rate).abs() >= estimator.adapt_above)

    def process_noise(states, inputs):
        tyres = levels["tyres"] if adapts(states[1] + track.step * states[3], inputs) else 0.0
        return track.process_noise(states, inputs, levels["steer"], tyres)

    def restart(state, inputs):
        diverged = not bool(state.mean[0].abs() < estimator.largest_sideslip)
        if not diverged and bool(state.covariance[0, 0] < LOST**2):
            return state
        turn = inputs[1] / (car.cg_to_front_axle + car.cg_to_rear_axle)
        motion = torch.stack([car.cg_to_rear_axle * turn, inputs[0] * turn, 0.0 * turn, 0.0 * turn])
        tyres = 0.0 * state.mean[4:] if diverged else state.mean[4:]
        spread = torch.as_tensor(estimator.start_tyres()) if diverged else state.covariance[4:, 4:]
        return Gaussian(torch.cat([motion, tyres]), torch.block_diag(torch.tensor(ROLLING, dtype=torch.float64).square().diag(), spread))

    return NonlinearModel(
        track.transition,
        track.observation,
        process_noise,
        lambda states, inputs: noise,
        lambda states: torch.maximum(torch.minimum(states, bound), -bound),
        restart,
        lambda states, inputs: torch.tensor([True] * 4 + [adapts(states[1], inputs)] * n_tyres),
    )


def gated(run, measurements, gate):
    """What a filter without a gate, of one sequence (T, m), gives behind one: sample by sample, what is refused becomes NaN."""
    y, refused = measurements.clone(), [0] * measurements.shape[-1]
    steps = run(y)
    for k in range(len(y)):
        left = y[k].clone()
        for i in range(len(left)):
            if math.isnan(left[i]):
                continue
            if steps.innovation[k, i] ** 2 > gate.deviations**2 * steps.innovation_covariance[k, i, i]:
                refused[i] = min(refused[i] + 1, 2 * gate.patience)
                if refused[i] <= gate.patience:
                    left[i] = torch.nan
            else:
                refused[i] = refused[i] - 1 if refused[i] > gate.patience else 0
        if not torch.equal(torch.isnan(left), torch.isnan(y[k])):
            y[k] = left
            steps = run(y)
    return steps


def scaled_rule(n, alpha, beta=2.0, kappa=0.0):
    """The scaled rule of van der Merwe 2004, whose weights of the mean point differ."""
    total = alpha**2 * (n + kappa)
    centre = 1.0 - n / total
    return SigmaRule(math.sqrt(total), centre, centre + 1.0 - alpha**2 + beta, 0.5 / total)
