"""The learned UKF with what its paper leaves out or its authors' code does: diagonal noise, and Pacejka's curves with curvature."""

from __future__ import annotations

from dataclasses import dataclass

from vehest.data.errors import ConfigurationError
from vehest.estimators.filtering.car_filter import FRICTION, OBSERVATION, PROCESS, CarFilter
from vehest.estimators.learned_ukf import LearnedUkf, LearnedUkfSettings
from vehest.filters.diagonal_noise import DiagonalNoise, DiagonalStateDependentNoise
from vehest.vehicle.dynamics import STATES, Dynamics, PacejkaCar


@dataclass(frozen=True)
class LearnedUkfVariantSettings(LearnedUkfSettings):
    """Settings of the learned filter, and how it differs from the paper's.

    Args:
        correlated_noise: whether the covariances of process and measurements have entries off their diagonals, as in the paper.
        curvature: whether Pacejka's curves have the E terms of Eq. 3, learnt from 0 on; of `pacejka` alone.
    """

    correlated_noise: bool = True
    curvature: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.curvature and self.dynamics != "pacejka":
            raise ConfigurationError(f"estimator.curvature is of estimator.dynamics=pacejka, not of {self.dynamics}")


class LearnedUkfVariant(LearnedUkf):
    """`LearnedUkf` with diagonal noise or with the curvature of Pacejka's curves; without either it is the same to the bit.

    It stands apart so that the settings of the learned filter are those that its paper compares.

    Source: Węgrzynowski et al. 2024, Sections III-B.2 (Eq. 3) and III-B.3.
    """

    name = "learned_ukf_variant"
    title = "Learned UKF, variant"
    settings_type = LearnedUkfVariantSettings
    settings: LearnedUkfVariantSettings

    @property
    def variant(self) -> str:
        """The paper's name, with what is different."""
        return super().variant + ("" if self.settings.correlated_noise else "_diagonal") + ("_curved" if self.settings.curvature else "")

    @property
    def full_title(self) -> str:
        """Title with what is different."""
        how = [] if self.settings.correlated_noise else ["diagonal noise"]
        how += ["curvature"] * self.settings.curvature
        return ", ".join([super().full_title, *how])

    @property
    def n_parameters(self) -> int:
        """Those that can change: without entries off the diagonals of diagonal noise."""
        held = 0
        for noise in (self.filter.process_noise, self.filter.observation_noise):
            if isinstance(noise, DiagonalNoise):
                held += noise.factor.numel() - noise.n
            elif isinstance(noise, DiagonalStateDependentNoise):
                entries = noise.constant.factor.numel()
                held += (entries - noise.constant.n) * (2 + noise.weight.shape[1])
        return super().n_parameters - held

    def _new_filter(self, repair: bool | None = None) -> CarFilter:
        made = super()._new_filter(repair)
        if self.settings.correlated_noise:
            return made
        process = (*PROCESS, FRICTION[self.settings.noise])
        if self.settings.noise == "constant":
            made.process_noise, made.observation_noise = DiagonalNoise(process), DiagonalNoise(OBSERVATION)
        else:
            made.process_noise = DiagonalStateDependentNoise(process, len(STATES))
            made.observation_noise = DiagonalStateDependentNoise(OBSERVATION, len(STATES))
        return made

    def _new_dynamics(self) -> Dynamics:
        car = self.settings.car
        return PacejkaCar(car.chassis, car.start, with_curvature=True) if self.settings.curvature else super()._new_dynamics()


ESTIMATOR = LearnedUkfVariant
