"""Base of families that filter by `vehest.filters.unscented_scan`, and their stepper."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from vehest.constants import FloatArray
from vehest.estimators.base import Stepper
from vehest.estimators.filtering.gated import GatedFilter
from vehest.filters.gaussian import Filtered
from vehest.filters.unscented_scan import StepNoise, UnscentedStepper


class FilterStep(NamedTuple):
    """A sample in the form that `UnscentedStepper.step` takes."""

    measurement: FloatArray  # measured values, (m,), NaN where nothing was measured
    inputs: FloatArray  # inputs of the model, (p,)
    process_noise: StepNoise  # covariance of the step that led to the sample
    observation_noise: StepNoise  # covariance of the measurement


class SigmaPointEstimator(GatedFilter):
    """An estimator by an unscented filter."""

    states: ClassVar[tuple[str, ...]]  # names of the filter's states, ``vy`` among them

    @abstractmethod
    def filter_step(self, sample: FloatArray, memory: dict[str, Any]) -> FilterStep:
        """Convert a sample of ``channels``, (C,), into the filter's measurement, inputs and noise.

        ``memory`` is a dictionary that keeps values from sample to sample; it is empty at first.
        """

    @abstractmethod
    def new_filter(self, first: FilterStep) -> UnscentedStepper:
        """The filter before its first sample.

        Raises
        ------
        ConfigurationError
            It has not been fitted.
        """

    def online(self) -> Stepper:
        """A stepper that starts from the first sample that it receives."""
        self.require_fitted()
        return SigmaPointStepper(self)


def normalised_innovations(steps: Filtered[Tensor]) -> tuple[FloatArray, FloatArray]:
    """Normalised innovation squared eᵀS⁻¹e, and number of measured values, (B, T) each.

    Parameters
    ----------
    steps : Filtered
        Innovations e (B, T, m), their covariances S (B, T, m, m), and what was measured.
    """
    whitened = torch.linalg.solve_ex(steps.innovation_covariance, steps.innovation).result
    nis = whitened.mul(steps.innovation).sum(-1)
    dof = torch.as_tensor(steps.measured).sum(-1)
    return nis.double().numpy(), dof.double().numpy()


class SigmaPointStepper(Stepper):
    """Runs the filter of a `SigmaPointEstimator` one sample at a time.

    Attributes
    ----------
    filter : UnscentedStepper or None
        The filter with its state; None before the first sample.
    """

    def __init__(self, estimator: SigmaPointEstimator) -> None:
        self._estimator = estimator
        self.filter: UnscentedStepper | None = None
        self._memory: dict[str, Any] = {}

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """States at the time of the sample, name -> value [SI], and ``vy_variance`` [m²/s²].

        The filter starts from the first sample; a sample's inputs act until the next one.
        """
        estimator = self._estimator
        step = estimator.filter_step(estimator.checked_sample(sample), self._memory)
        if self.filter is None:
            self.filter = estimator.new_filter(step)
        dtype = self.filter.state.mean.dtype
        of_vy = estimator.states.index("vy")
        mean = self.filter.step(
            step.measurement.astype(dtype),
            step.inputs.astype(dtype),
            step.process_noise,
            step.observation_noise,
        )
        return dict(zip(estimator.states, mean.tolist(), strict=True)) | {
            "vy_variance": float(self.filter.state.covariance[of_vy, of_vy])
        }
