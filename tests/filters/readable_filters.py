"""Filters to compare compiled ones with: an extended filter as its equations stand, and a gate around any filter that has none."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.func import jacfwd

from vehest.estimators.rational_ekf import LOST, ROLLING, RationalFilter
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.nonlinear import NonlinearModel
from vehest.filters.sigma_points import SigmaRule


def extended_filter(model: NonlinearModel, measurements: Tensor, inputs: Tensor, initial: Gaussian[Tensor]) -> Filtered[Tensor]:
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
        fit = innovation @ torch.linalg.solve(S, innovation) + torch.logdet(S) + int(measured.sum()) * math.log(2.0 * math.pi)
        samples.append((*state, *posterior, innovation, S, measured, -0.5 * fit))
        state = posterior
    parts = [torch.stack(part) for part in zip(*samples, strict=True)]
    return Filtered(Gaussian(*parts[:2]), Gaussian(*parts[2:4]), *parts[4:])


def rational_model(estimator: RationalFilter) -> NonlinearModel:
    """The model of a `RationalFilter`; inputs are speed and steering angle, and a lost sideslip angle is that of a car that rolls."""
    track, bound = estimator.track(), torch.as_tensor(estimator.bounds())
    car, n_tyres, levels = estimator.car, len(estimator.adapted), estimator.values
    noise = torch.tensor([levels["yaw_rate"], levels["ay"]], dtype=torch.float64).square().diag()

    def adapts(yaw_rate: Tensor, inputs: Tensor) -> bool:
        return bool((inputs[0] * yaw_rate).abs() >= estimator.adapt_above)

    def process_noise(states: Tensor, inputs: Tensor) -> Tensor:
        tyres = levels["tyres"] if adapts(states[1] + track.step * states[3], inputs) else 0.0
        return track.process_noise(states, inputs, levels["steer"], tyres)

    def restart(state: Gaussian[Tensor], inputs: Tensor) -> Gaussian[Tensor]:
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


def gated(run: Callable[[Tensor], Filtered[Any]], measurements: Tensor, gate: Gate) -> Filtered[Any]:
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


def scaled_rule(n: int, alpha: float, beta: float = 2.0, kappa: float = 0.0) -> SigmaRule:
    """The scaled rule of van der Merwe 2004, whose weights of the mean point differ."""
    total = alpha**2 * (n + kappa)
    centre = 1.0 - n / total
    return SigmaRule(math.sqrt(total), centre, centre + 1.0 - alpha**2 + beta, 0.5 / total)
