"""An unscented filter of a planar car whose dynamics and noise can be learnt.

    `Dynamics` --point_model--> compiled or torch `PointModel`
    measurements (B, T, 4), inputs (B, T, 2) --filtered: unscented_scan--> states (B, T, 5)

In training, noise that depends on the state is evaluated at the true states of a drive, so that it
has gradients; in use it is evaluated at the estimate by compiled code (`noise_at`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor, nn

from vehest.data.errors import DataError
from vehest.estimators.kernels.planar_car import CompiledPlanarCar, is_compilable
from vehest.estimators.kernels.threads import over_members
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.noise_models import (
    ConstantNoise,
    StateDependentNoise,
    compiled_noise,
    with_entropy,
)
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import (
    NonlinearFiltered,
    PointModel,
    StepNoise,
    TorchModel,
    moved,
    unscented_scan,
)
from vehest.training.through_filter import Drive
from vehest.vehicle.dynamics import STATES, Dynamics

# kind of the covariances of process and measurement
NoiseKind = Literal["constant", "state_dependent"]
# initial variances, before training: of vx, vy, yaw rate and rim speed over one sample's step
PROCESS = (1e-3, 1e-3, 1e-2, 1e-2)
# `NoiseKind` -> variance of the friction's step [1]
FRICTION = {"constant": 1e-4, "state_dependent": 1e-5}
# initial variances of ax, ay [m²/s⁴], yaw rate [rad²/s²] and rim speed [m²/s²] as measurements
OBSERVATION = (50.0, 50.0, 0.1, 0.1)
# variances of vx, vy, yaw rate and rim speed at a known first state
INITIAL = (1e-3, 1e-3, 1e-3, 1e-3)
PACE = 10.0  # factor by which noise learns faster than in units of its deviations
# added to variances: the rim speed is measured, and is its own reference
OBSERVED_EXACTLY = (
    0.0,
    0.0,
    0.0,
    1e-3,
)
KAPPA = -2.0  # κ of the symmetric sigma points
MIN_ENTROPY = -9.0  # [nat] of the process noise


class CarFilter(nn.Module):
    """States vx, vy, yaw rate, rim speed and friction; measured are ax, ay, yaw rate and rim speed.

    Covariances of noise are constant or depend on the state, and are ``correlated`` or diagonal.
    The step is in s, ``lower`` the smallest possible vx [m/s] and friction; ``repair``: lost
    definiteness is repaired.

    Source: Węgrzynowski et al. 2024, Section III-B; start values as in its authors' code.
    """

    process_noise: Any  # model of the covariance of the process noise
    observation_noise: Any  # model of the covariance of the measurements
    mirror = (  # signs of states, inputs and measurements, left for right
        (1.0, -1.0, -1.0, 1.0, 1.0),
        (-1.0, 1.0),
        (1.0, -1.0, -1.0, 1.0),
    )

    def __init__(
        self,
        dynamics: Dynamics,
        noise: NoiseKind,
        *,
        step: float,
        lower: tuple[float, float],
        correlated: bool = True,
        repair: bool = True,
    ) -> None:
        super().__init__()
        self.dynamics = dynamics
        self.constant = noise == "constant"
        n = len(STATES)
        self.process_noise, self.observation_noise = (
            ConstantNoise(variances, correlated)
            if self.constant
            else StateDependentNoise(variances, n, correlated=correlated)
            for variances in ((*PROCESS, FRICTION[noise]), OBSERVATION)
        )
        self.initial_noise = ConstantNoise((*INITIAL, FRICTION[noise]))
        self.step = step
        self.repair = repair
        self.lower = (lower[0], *[-torch.inf] * 3, lower[1])
        self.rule = symmetric_rule(n, KAPPA)

    def reset(self, generator: torch.Generator) -> None:
        """Draw the initial weights of dynamics and noise anew."""
        self.dynamics.reset(generator)
        for noise in (self.process_noise, self.observation_noise):
            if isinstance(noise, StateDependentNoise):
                noise.reset(generator)

    def moved(self, states: Tensor, inputs: Tensor) -> Tensor:
        """States one sample after ``states``, (B, 5), by the dynamics."""
        return moved(self.point_model(), states, inputs)

    def point_model(self) -> PointModel:
        """The dynamics as functions of sigma points for the filter: compiled where possible."""
        dtype = next(self.parameters()).dtype
        if is_compilable(self.dynamics):
            return CompiledPlanarCar(self.dynamics, self.step, self.lower, dtype)
        return TorchModel(
            lambda points, inputs: self.dynamics.transition(points, inputs, self.step),
            self.dynamics.observation,
            list(self.dynamics.parameters()),
            self.lower,
        )

    def initial_covariance(self) -> Tensor:
        """Covariance of an initial state that is known, (5, 5)."""
        covariance: Tensor = self.initial_noise(
            self.initial_noise.unit.new_zeros(len(STATES)), torch.zeros(0)
        )
        return covariance

    def filtered(
        self,
        measurements: Tensor,
        inputs: Tensor,
        initial: Gaussian[Tensor],
        states: Tensor | None = None,
        model: PointModel | None = None,
        gate: Gate | None = None,
    ) -> NonlinearFiltered:
        """Filter B sequences of T samples.

        Parameters
        ----------
        measurements : Tensor
            (B, T, 4), NaN where nothing was measured.
        inputs : Tensor
            (B, T, 2).
        initial : Gaussian[Tensor]
            At the first sample, mean (B, 5).
        states : Tensor | None, default None
            True ones, (B, T, 5), that the noise then depends on; none: it depends on the estimate,
            and has no gradients.
        model : PointModel | None, default None
            What `point_model` returned, to use it again.
        gate : Gate | None, default None
            Which measurements are refused; none: all are taken.

        Returns
        -------
        NonlinearFiltered
            Differentiable in dynamics, noise and initial state, unless noise depends on the
            estimate.
        """
        if states is not None or self.constant:
            at = initial.mean.new_zeros(1, 1, len(STATES)) if states is None else states
            process = with_entropy(self.process_noise(at, inputs), MIN_ENTROPY)
            observation = self.observation_noise(at, inputs)
        else:
            process, observation = self.noise_at()  # type: ignore[assignment]
        return unscented_scan(
            model or self.point_model(),
            measurements,
            inputs,
            initial,
            process,
            observation,
            self.rule,
            repair=self.repair,
            share=partial(over_members, pieces=1),
            gate=gate,
        )

    def noise_at(self) -> tuple[StepNoise, StepNoise]:
        """Process and observation noise for filters in use, without gradients.

        Constant covariances are arrays (1, 5, 5) and (1, 4, 4); those that depend on the state are
        `CompiledNoise`. The process noise has at least the entropy `MIN_ENTROPY`.
        """
        if not self.constant:
            return compiled_noise(self.process_noise, MIN_ENTROPY), compiled_noise(
                self.observation_noise
            )
        zero_state = self.initial_noise.unit.new_zeros(1, len(STATES))
        with torch.no_grad():
            process = with_entropy(self.process_noise(zero_state, zero_state), MIN_ENTROPY)
            return process.numpy(), self.observation_noise(zero_state, zero_state).numpy()

    def begin_noise(self, drives: Sequence[Drive], start_spread: float) -> None:
        """Initialise the noise from one-step and measurement residuals at the true states of
        drives.

        The friction, which the true states hold as a constant, and the initial state keep the
        variances that they have, but for a friction that may start anywhere within a spread: it has
        the variance of that.

        Parameters
        ----------
        drives : sequence of Drive
            True states (T, 5), inputs (T, 2) and measurements (T, 4), without gaps.
        start_spread : float
            Half width of the uniform distribution of the friction that a training sequence starts
            from.

        Raises
        ------
        DataError
            The residuals have no positive definite covariance.
        """
        with torch.no_grad():
            steps = torch.cat(
                [self.moved(d.states[:-1], d.inputs[:-1]) - d.states[1:] for d in drives]
            )
            expected = torch.cat(
                [d.measurements - self.dynamics.observation(d.states, d.inputs) for d in drives]
            )
            size = torch.cat([drive.states for drive in drives]).square().mean(0).sqrt()
            process = steps.T @ steps / len(steps)
            observation = expected.T @ expected / len(expected)
            friction = len(STATES) - 1
            process[friction, friction] = FRICTION[
                "constant" if self.constant else "state_dependent"
            ]
            observation += observation.new_tensor(OBSERVED_EXACTLY).diag()
        for noise, covariance in (
            (self.process_noise, process),
            (self.observation_noise, observation),
        ):
            if torch.linalg.cholesky_ex(covariance).info:
                raise DataError(
                    "training.start_noise=residuals: the training recordings do not move each of "
                    "the car's states, so that no covariance follows from them; train on other "
                    "drives, or set training.start_noise=given"
                )
            noise.begin(covariance, PACE, size)
        initial = self.initial_covariance().detach().clone()
        initial[friction, friction] = torch.clamp(
            initial[friction, friction], min=start_spread**2 / 3.0
        )
        self.initial_noise.begin(initial, PACE)

    def estimated(self, drives: Drive, start: Tensor, steps: int | None) -> tuple[Tensor, Tensor]:
        """States and covariances of training sequences that start from ``start``, (B, 5).

        Covariances are (B, T, 5, 5); both are differentiable. Gradients reach back ``steps``
        samples; none: all.
        """
        total = drives.states.shape[1]
        initial = Gaussian(start, self.initial_covariance())
        model = self.point_model()
        means = []
        covariances = []
        for first in range(0, total, steps or total):
            # a later stretch starts with the last sample of the one before, which is not measured
            # twice
            begin = max(first - 1, 0)
            end = min(first + (steps or total), total)
            measurements = drives.measurements[:, begin:end]
            if first:
                measurements = torch.cat(
                    [torch.full_like(measurements[:, :1], torch.nan), measurements[:, 1:]], 1
                )
            states = None if self.constant else drives.states[:, begin:end]
            filtered = self.filtered(
                measurements, drives.inputs[:, begin:end], initial, states, model
            ).steps.filtered
            means.append(filtered.mean[:, first - begin :])
            covariances.append(filtered.covariance[:, first - begin :])
            initial = Gaussian(filtered.mean[:, -1].detach(), filtered.covariance[:, -1].detach())
        return torch.cat(means, 1), torch.cat(covariances, 1)

    def estimate_for_validation(self, drives: Drive) -> Tensor:
        """Estimated states, (B, T, 5), as in use: without gradients, and without any true state but
        the first.
        """
        with torch.no_grad():
            initial = Gaussian(drives.states[:, 0], self.initial_covariance())
            return self.filtered(drives.measurements, drives.inputs, initial).steps.filtered.mean
