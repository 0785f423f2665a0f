"""Kinematic Luenberger observer with reset: Farrelly & Wellstead 1996, as in Da Lio et al. 2023, Appendix A."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, EstimatorSettings, FitData, FitRecord, Stepper, required
from vehest.training.context import FitContext
from vehest.training.search import DirectSearchSettings, nelder_mead_over_grid

GAIN_BOX = (0.0, 50.0)
GAIN_STARTS = (3.0, 20.0)
THRESHOLD_BOX = (0.0, 0.5)  # times the largest |yaw rate|
THRESHOLD_STARTS = (0.0, 0.3)


@dataclass(frozen=True)
class LuenbergerSettings(EstimatorSettings):
    """The observer has no structure to choose, only the rate it runs at."""


class Luenberger(Estimator):
    """Kinematic observer with both poles at -α|ω|, reset where the yaw rate is too small to observe anything.

    Two parameters, the gain α and the threshold ω_th [rad/s], found by Nelder-Mead on the training recordings' mean
    squared error of vy.

    Source: Da Lio et al. 2023, Appendix A (gains in the order that its Appendix B implies).
    """

    name = "luenberger"
    title = "Luenberger"
    channels = ("yaw_rate", "vx", "ay", "ax")
    settings_type = LuenbergerSettings
    training_type = DirectSearchSettings

    def __init__(self, settings: EstimatorSettings) -> None:
        super().__init__(settings)
        self.gain = math.nan
        self.threshold = math.nan

    @property
    def n_parameters(self) -> int:
        """α and ω_th."""
        return 2

    def seed(self, seed: int) -> None:
        """Nothing here is random."""

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Fit one; the others, which could not differ, get the same."""
        started = time.monotonic()
        first = members[0]
        step = 1.0 / first.settings.rate_hz
        for recording in (*data.train, *data.validation):
            for name in (*cls.channels, "vy_ref"):
                if np.isnan(recording[name]).any():
                    raise DataError(
                        f"recording '{recording.id}': channel '{name}' has gaps, which estimator 'luenberger' cannot learn from"
                    )
        pairs = [(r.stack(cls.channels), r["vy_ref"]) for r in data.train]
        largest = max(float(np.abs(measurements[:, 0]).max()) for measurements, _ in pairs)

        def cost(parameters: FloatArray) -> float:
            return _mean_squared_error(pairs, parameters, step)

        search = nelder_mead_over_grid(
            cost,
            [GAIN_BOX, (THRESHOLD_BOX[0] * largest, THRESHOLD_BOX[1] * largest)],
            [GAIN_STARTS, (THRESHOLD_STARTS[0] * largest, THRESHOLD_STARTS[1] * largest)],
            training,
            context,
        )
        validation = [(r.stack(cls.channels), r["vy_ref"]) for r in data.validation]
        columns = ("start_gain", "start_threshold", "gain", "threshold", "train_loss")
        record = FitRecord(
            history={name: search.starts[:, column].tolist() for column, name in enumerate(columns)},
            metrics={
                "epochs": 0,
                "evaluations": search.evaluations,
                "best_train_loss": search.cost,
                "best_validation_loss": _mean_squared_error(validation, search.best, step),
                "train_seconds": time.monotonic() - started,
            },
            interrupted=search.interrupted,
        )
        for member in members:
            assert isinstance(member, Luenberger)
            member.gain, member.threshold = search.best.tolist()
        return [record] * len(members)

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        from vehest.estimators.kernels.luenberger import observe

        start = dict(initial_state or {})
        vy, vx = observe(
            recording.stack(self.channels),
            self.gain,
            self.threshold,
            1.0 / recording.rate_hz,
            start.get("vy", 0.0),
            start.get("vx", math.nan),
        )
        return self._wrapped(recording, vy, vx=vx)

    def online(self) -> LuenbergerStepper:
        """A stepper that starts from vy = 0."""
        if math.isnan(self.gain):
            raise ConfigurationError("the Luenberger observer has no gain yet; fit or load it first")
        return LuenbergerStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Gain and threshold."""
        return {"gain": np.array([self.gain]), "threshold": np.array([self.threshold])}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take gain and threshold back."""
        try:
            self.gain, self.threshold = float(weights["gain"][0]), float(weights["threshold"][0])
        except (KeyError, IndexError):
            raise DataError(f"weights of 'luenberger' must be gain and threshold, not {', '.join(weights)}") from None


class LuenbergerStepper(Stepper):
    """The observer, one sample at a time."""

    def __init__(self, estimator: Luenberger) -> None:
        self._estimator = estimator
        self._v, self._u = 0.0, math.nan

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral and forward velocity [m/s] at the time of the sample."""
        from vehest.estimators.kernels.luenberger import observe

        row = np.array([required(sample, self._estimator.channels)])
        step = 1.0 / self._estimator.settings.rate_hz
        vy, vx = observe(row, self._estimator.gain, self._estimator.threshold, step, self._v, self._u)
        self._v, self._u = float(vy[0]), float(vx[0])
        return {"vy": self._v, "vx": self._u}


def _mean_squared_error(pairs: Sequence[tuple[FloatArray, FloatArray]], parameters: FloatArray, step: float) -> float:
    from vehest.estimators.kernels.luenberger import observe

    total, count = 0.0, 0
    for measurements, reference in pairs:
        vy, _ = observe(measurements, parameters[0], parameters[1], step)
        total += float(np.square(vy - reference).sum())
        count += len(reference)
    return total / count


ESTIMATOR = Luenberger
