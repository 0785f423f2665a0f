"""What recursions with a state and a handful of fitted numbers need besides: fitting, estimating, running online, saving."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, EstimatorSettings, FitData, FitRecord, Stepper, required
from vehest.training.context import FitContext, NoTraining


class RecursiveEstimator(Estimator):
    """An observer or filter: it goes through samples in order and carries a state; its fit, if any, determines a few numbers.

    Nothing in it is random. `run` is called with all samples of a recording, or online with one at a time.

    Attributes:
        numbers: names of what the fit determines, each one number.
        values: those numbers; NaN before the fit.
    """

    training_type = NoTraining
    numbers: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: EstimatorSettings) -> None:
        super().__init__(settings)
        self.values = dict.fromkeys(self.numbers, math.nan)

    @abstractmethod
    def first_state(self, sample: FloatArray, given: Mapping[str, float]) -> Any:
        """The state before the first sample.

        Args:
            sample: values of ``channels``, (C,).
            given: what a protocol hands over of ``vy``, ``vx`` [m/s] and ``yaw_rate`` [rad/s]; empty otherwise.
        """

    @abstractmethod
    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """Go on from a state.

        Args:
            samples: values of ``channels``, (T, C), T ≥ 1.
            state: that before the first of them.

        Returns:
            Quantities of an `Estimate` at the time of each sample, (T,), ``vy`` [m/s] among them, and the state after the last.
        """

    def fitted(self, data: FitData, training: Any, context: FitContext) -> tuple[Mapping[str, float], FitRecord]:
        """What is best for `numbers`, and how it was found; for estimators that have any.

        Args:
            data: recordings with ``vy_ref``, without gaps but in channels that are skippable.
            training: of ``training_type``.
            context: progress and the wish to stop.
        """
        raise NotImplementedError(f"{type(self).__name__} has numbers to determine, and no method 'fitted'")

    @property
    def n_parameters(self) -> int:
        """As many as `numbers` has names."""
        return len(self.numbers)

    @property
    def learns(self) -> bool:
        """Whether there is any number to determine."""
        return bool(self.numbers)

    def seed(self, seed: int) -> None:
        """Nothing here is random."""

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Fit one; the others, which could not differ, get the same.

        Raises:
            DataError: a channel or the reference is missing or has gaps.
        """
        started = time.monotonic()
        own = [member for member in members if isinstance(member, RecursiveEstimator)]
        values: Mapping[str, float] = {}
        record = FitRecord()
        if cls.numbers:
            for recording in (*data.train, *data.validation):
                cls._check_complete(recording)
            values, record = own[0].fitted(data, training, context)
        for member in own:
            member.values = {name: float(values[name]) for name in cls.numbers}
        metrics = {"epochs": 0, **record.metrics, "train_seconds": time.monotonic() - started}
        return [replace(record, metrics=metrics)] * len(members)

    @classmethod
    def _check_complete(cls, recording: Recording) -> None:
        for name in (*cls.channels, "vy_ref"):
            if name not in recording:
                raise DataError(f"recording '{recording.id}' has no channel '{name}', which the fit of '{cls.name}' needs")
            if name not in cls.skippable and np.isnan(recording[name]).any():
                raise DataError(f"recording '{recording.id}': channel '{name}' has gaps, which estimator '{cls.name}' cannot learn from")

    def mean_squared_error(self, recordings: Sequence[Recording]) -> float:
        """Of vy against ``vy_ref`` with the present `values` [m²/s²]; NaN without recordings."""
        errors = []
        for recording in recordings:
            samples = recording.stack(self.channels)
            errors.append(self.run(samples, self.first_state(samples[0], {}))[0]["vy"] - recording["vy_ref"])
        return float(np.mean(np.square(np.concatenate(errors)))) if errors else math.nan

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        self._check_fitted()
        samples = recording.stack(self.channels)
        found, _ = self.run(samples, self.first_state(samples[0], dict(initial_state or {})))
        others = {name: values for name, values in found.items() if name != "vy"}
        return self._wrapped(recording, found["vy"], **others)  # type: ignore[arg-type]

    def online(self) -> Stepper:
        """A stepper without a state yet.

        Raises:
            ConfigurationError: it has not been fitted.
        """
        self._check_fitted()
        return RecursiveStepper(self)

    def _check_fitted(self) -> None:
        if any(math.isnan(value) for value in self.values.values()):
            raise ConfigurationError(f"estimator '{self.name}' has not been fitted yet; fit or load it first")

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Each number as an array of one; without any, one that says that there is none."""
        return {name: np.array([value]) for name, value in self.values.items()} or {"none": np.zeros(1)}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take the numbers back.

        Raises:
            DataError: one is missing.
        """
        try:
            self.values = {name: float(weights[name][0]) for name in self.numbers}
        except (KeyError, IndexError):
            raise DataError(f"weights of '{self.name}' must be {', '.join(self.numbers)}, not {', '.join(weights)}") from None


class RecursiveStepper(Stepper):
    """A recursion, one sample at a time."""

    def __init__(self, estimator: RecursiveEstimator) -> None:
        self._estimator = estimator
        self._state: Any = None
        self._started = False

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Every quantity at the time of the sample, ``vy`` [m/s] among them; NaN in skippable channels was not measured."""
        row = np.array(required(sample, self._estimator.channels))
        for name, value in zip(self._estimator.channels, row, strict=True):
            if math.isnan(value) and name not in self._estimator.skippable:
                raise DataError(f"the sample's '{name}' is NaN, which estimator '{self._estimator.name}' cannot skip")
        state = self._state if self._started else self._estimator.first_state(row, {})
        found, self._state = self._estimator.run(row[None], state)
        self._started = True
        return {name: float(values[0]) for name, values in found.items()}
