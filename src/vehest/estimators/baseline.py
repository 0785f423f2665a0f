"""What the baselines share: estimators so plain that whatever claims to be of use has to beat them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.estimators.base import FitData, FitRecord
from vehest.estimators.recursive import RecursiveEstimator
from vehest.training.context import FitContext


class Baseline(RecursiveEstimator):
    """An estimator with a handful of numbers in closed form, nothing random, and at most one state: the lateral velocity."""

    ignores_initial_state = True

    @abstractmethod
    def lateral_velocity(self, samples: Mapping[str, FloatArray], start: float = 0.0) -> FloatArray:
        """vy [m/s], shape (T,), from the channels, shape (T,) each; ``start`` is vy one sample before, where the method has a state."""

    def best_numbers(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """The numbers with the smallest mean squared error of vy, for baselines that have any.

        Raises:
            DataError: the recordings do not determine them.
        """
        raise NotImplementedError(f"{type(self).__name__} has numbers to determine, and no method 'best_numbers'")

    def fitted(self, data: FitData, training: Any, context: FitContext) -> tuple[dict[str, float], FitRecord]:
        """The best numbers and their errors."""
        self.values = self.best_numbers(data.train)
        losses = {"best_train_loss": data.train, "best_validation_loss": data.validation}
        return self.values, FitRecord(metrics={name: self.mean_squared_error(recordings) for name, recordings in losses.items()})

    def first_state(self, sample: FloatArray, given: Mapping[str, float]) -> float:
        """v = 0."""
        return 0.0

    def run(self, samples: FloatArray, state: float) -> tuple[dict[str, FloatArray], float]:
        """`lateral_velocity` from v one sample before."""
        vy = self.lateral_velocity(dict(zip(self.channels, samples.T, strict=True)), state)
        return {"vy": vy}, float(vy[-1])
