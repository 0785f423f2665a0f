"""Filters to compare compiled ones with: unscented and extended as their equations stand, in torch,
and a gate around any filter.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacfwd

from vehest.estimators.filtering.rational_model import MAX_SIDESLIP_DEVIATION, ROLLING
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.sigma_points import SigmaRule
from vehest.filters.unscented_scan import MIN_EIGENVALUE_SHARE, Function, NonlinearFiltered


def sigma_points(rule, mean, factor):
    """Points of N(mean, L Lᵀ), the mean first, (2n + 1, n), of a mean (n,) and L, lower triangular,
    (n, n).
    """
    offsets = rule.spread * factor.mT
    return torch.cat([mean[None], mean + offsets, mean - offsets])


def mean_of(rule, values):
    """Weighted mean of values at the points, (2n + 1, m) -> (m,)."""
    return rule.centre_mean * values[0] + rule.outer_weight * values[1:].sum(0)


def covariance_of(rule, deviations, second_deviations):
    """Weighted Σ w d eᵀ of deviations from the mean, (2n + 1, m) and (2n + 1, k) -> (m, k)."""
    return rule.centre_covariance * torch.outer(
        deviations[0], second_deviations[0]
    ) + rule.outer_weight * (deviations[1:].mT @ second_deviations[1:])


def symmetric(matrix):
    """The symmetric part, which rounding has left a little."""
    return 0.5 * (matrix + matrix.mT)


def factorised(covariance):
    """A covariance, its Cholesky factor L, and whether it was lifted first since it was not
    positive definite.

    Lifting adds the same to every eigenvalue, so that the smallest is `MIN_EIGENVALUE_SHARE` of the
    largest; what is added counts as a constant in gradients.
    """
    factor, lost = torch.linalg.cholesky_ex(covariance)
    if not lost:
        return covariance, factor, False
    with torch.no_grad():
        eigenvalues = torch.linalg.eigvalsh(covariance)
        lift = MIN_EIGENVALUE_SHARE * eigenvalues.abs().max() - eigenvalues[0]
    lifted = covariance + lift * torch.eye(len(covariance), dtype=covariance.dtype)
    return lifted, torch.linalg.cholesky(lifted), True


@dataclass(frozen=True)
class NonlinearModel:
    """A nonlinear model with Gaussian noise.

    x[k+1] = f(x[k], u[k]) + w[k],  w[k] ~ N(0, Q(x[k], u[k]))
    y[k]   = h(x[k], u[k]) + v[k],  v[k] ~ N(0, R(x[k], u[k]))

    ``constrain`` puts a state back into what is possible; ``restart`` says what is known after a
    prediction that leaves too little known; ``free`` (..., n) is which states a measurement may
    change: what is held keeps its variance (Schmidt's consider state).
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


def log_likelihood(steps):
    """Of each sample's measurements given those before, (..., T), by innovations and their
    covariances; 0 where nothing was measured.
    """
    errors, covariances, measured = (
        torch.as_tensor(part)
        for part in (steps.innovation, steps.innovation_covariance, steps.measured)
    )
    squared = torch.linalg.solve(covariances, errors).mul(errors).sum(-1)
    return -0.5 * (
        squared
        + torch.logdet(covariances)
        + measured.sum(-1, dtype=errors.dtype) * math.log(2.0 * math.pi)
    )


def unscented_filter(model, measurements, inputs, initial, rule):
    """The unscented Kalman filter with additive noise of one sequence, (T, m) and (T, p), or of
    several, each by itself.

    Sigma points are drawn again before each update. Covariances that are not positive definite are
    repaired. Where a negative weight of the mean point is what takes the definiteness of an update,
    the update goes without it; everything else is lifted. Measurements that are NaN are skipped,
    and gradients stay finite; ``initial`` is the state before the first of them.

    Source: Julier & Uhlmann 1997; van der Merwe 2004, Algorithm 3.1 with the points drawn again.
    """
    if measurements.dim() == 3:
        several = len(measurements)
        n = initial.mean.shape[-1]
        sequences = zip(
            measurements,
            inputs,
            initial.mean.expand(several, n),
            initial.covariance.expand(several, n, n),
            strict=True,
        )
        filtered = [
            unscented_filter(model, y, u, Gaussian(*first), rule) for y, u, *first in sequences
        ]
        rows = [(*steps.predicted, *steps.filtered, *steps[2:]) for steps, _ in filtered]
        return NonlinearFiltered(
            filtered_of(rows), torch.stack([repaired for _, repaired in filtered])
        )
    state = initial
    rows = []
    repaired = torch.zeros(len(measurements), dtype=torch.bool)
    for k, (y, u) in enumerate(zip(measurements, inputs, strict=True)):
        if k > 0:
            _, factor, repaired[k] = factorised(state.covariance)
            after = model.transition(
                model.possible(sigma_points(rule, state.mean, factor)), inputs[k - 1 : k]
            )
            mean = mean_of(rule, after)
            covariance = covariance_of(rule, after - mean, after - mean) + model.process_noise(
                state.mean, inputs[k - 1]
            )
            state = Gaussian(model.possible(mean), symmetric(covariance))
        prior, factor, lifted = factorised(state.covariance)
        posterior, *update, lost = _updated(model, Gaussian(state.mean, prior), factor, y, u, rule)
        rows.append((*state, *posterior, *update))
        repaired[k] |= lifted or lost
        state = posterior
    return NonlinearFiltered(filtered_of(rows), repaired)


def filtered_of(rows):
    """What a filter leaves of rows of predicted and filtered state, innovation, its covariance and
    what was measured.
    """
    parts = [torch.stack(part) for part in zip(*rows, strict=True)]
    return Filtered(Gaussian(*parts[:2]), Gaussian(*parts[2:4]), *parts[4:])


def _updated(model, state, factor, y, u, rule):
    """The state given a measurement, of which NaN is skipped.

    Innovation, its covariance, what was measured, whether it was repaired.
    """
    drawn = model.possible(sigma_points(rule, state.mean, factor))
    expected = model.observation(drawn, u[None])
    mean = mean_of(rule, expected)
    measured = ~torch.isnan(y)
    spread = torch.where(measured, expected - mean, 0.0)
    noise = torch.where(
        measured[:, None] & measured,
        model.observation_noise(state.mean, u),
        torch.eye(len(y), dtype=y.dtype),
    )
    innovation = torch.where(measured, torch.where(measured, y, 0.0) - mean, 0.0)

    def conditioned(rule):
        covariance, factor, lost = factorised(
            symmetric(covariance_of(rule, spread, spread) + noise)
        )
        gain = torch.cholesky_solve(covariance_of(rule, drawn - state.mean, spread).mT, factor).mT
        left = symmetric(state.covariance - gain @ covariance @ gain.mT)
        return Gaussian(model.possible(state.mean + gain @ innovation), left), covariance, lost

    posterior, covariance, lost = conditioned(rule)
    if rule.centre_covariance < 0.0 and (lost or factorised(posterior.covariance)[2]):
        (posterior, covariance, _) = conditioned(rule._replace(centre_covariance=0.0))
        lost = True
    return posterior, innovation, covariance, measured, lost


def extended_filter(model, measurements, inputs, initial):
    """The extended Kalman filter of one sequence, (T, m) and (T, p).

    Jacobians by automatic differentiation, NaN is skipped.

    Source: Jazwinski 1970, Chapter 8; the update holds for any gain, also that of a consider state
    (Schmidt).
    """
    state = initial
    rows = []
    for k, (y, u) in enumerate(zip(measurements, inputs, strict=True)):
        if k > 0:
            before = state.mean
            pushed = inputs[k - 1]
            slope = jacfwd(model.transition)(before, pushed)
            covariance = slope @ state.covariance @ slope.mT + model.process_noise(before, pushed)
            state = Gaussian(
                model.possible(model.transition(before, pushed)), 0.5 * (covariance + covariance.mT)
            )
            state = state if model.restart is None else model.restart(state, u)
        measured = ~torch.isnan(y)
        H = torch.where(measured[:, None], jacfwd(model.observation)(state.mean, u), 0.0)
        R = torch.where(
            measured[:, None] & measured,
            model.observation_noise(state.mean, u),
            torch.eye(len(y), dtype=y.dtype),
        )
        innovation = torch.where(measured, y - model.observation(state.mean, u), 0.0)
        S = H @ state.covariance @ H.mT + R
        cross = state.covariance @ H.mT
        gain = torch.linalg.solve(S, cross.mT).mT
        if model.free is not None:
            gain = torch.where(model.free(state.mean, u)[:, None], gain, 0.0)
        covariance = state.covariance - gain @ cross.mT - cross @ gain.mT + gain @ S @ gain.mT
        posterior = Gaussian(
            model.possible(state.mean + gain @ innovation), 0.5 * (covariance + covariance.mT)
        )
        rows.append((*state, *posterior, innovation, S, measured))
        state = posterior
    return filtered_of(rows)


def rational_model(estimator):
    """The model of a `RationalFilter`.

    Inputs are speed and steering angle, and a lost sideslip angle is that of a car that rolls.
    """
    track = estimator.track()
    bound = torch.as_tensor(estimator.model().bounds)
    car = estimator.car
    n_tyres = len(estimator.adapted)
    levels = estimator.values
    noise = torch.tensor([levels["yaw_rate"], levels["ay"]], dtype=torch.float64).square().diag()

    def adapts(yaw_rate, inputs):
        return bool((inputs[0] * yaw_rate).abs() >= estimator.adapt_above)

    def process_noise(states, inputs):
        tyres = levels["tyres"] if adapts(states[1] + track.step * states[3], inputs) else 0.0
        return track.process_noise(states, inputs, levels["steer"], tyres)

    def restart(state, inputs):
        diverged = not bool(state.mean[0].abs() < estimator.largest_sideslip)
        if not diverged and bool(state.covariance[0, 0] < MAX_SIDESLIP_DEVIATION**2):
            return state
        turn = inputs[1] / (car.cg_to_front_axle + car.cg_to_rear_axle)
        motion = torch.stack([car.cg_to_rear_axle * turn, inputs[0] * turn, 0.0 * turn, 0.0 * turn])
        tyres = 0.0 * state.mean[4:] if diverged else state.mean[4:]
        spread = (
            torch.as_tensor(estimator.model().start_tyre_covariance)
            if diverged
            else state.covariance[4:, 4:]
        )
        return Gaussian(
            torch.cat([motion, tyres]),
            torch.block_diag(torch.tensor(ROLLING, dtype=torch.float64).square().diag(), spread),
        )

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
    """What a filter without a gate, of one sequence (T, m), gives behind one: sample by sample,
    what is refused becomes NaN.
    """
    y = measurements.clone()
    refused = [0] * measurements.shape[-1]
    steps = run(y)
    for k in range(len(y)):
        left = y[k].clone()
        for i in range(len(left)):
            if math.isnan(left[i]):
                continue
            if (
                steps.innovation[k, i] ** 2
                > gate.deviations**2 * steps.innovation_covariance[k, i, i]
            ):
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
