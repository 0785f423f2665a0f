"""What estimators over the linear single track share: settings, the model of a recording, estimates of (β, r)."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, EstimatorSettings, Stepper, required
from vehest.filters.gaussian import Gaussian
from vehest.training.context import NoTraining
from vehest.vehicle.parameters import FERRARI_250LM, SingleTrackParameters
from vehest.vehicle.single_track import forward_euler, lateral_acceleration, lateral_dynamics

KNOWN = 1e-6  # rad and rad/s, standard deviation of a state that a protocol hands over
STATE = ("vy", "yaw_rate")  # what an estimate's covariance is of


@dataclass(frozen=True)
class SingleTrackSettings(EstimatorSettings):
    """Settings of an estimator over the linear single track.

    Args:
        car: its parameters.
        minimum_speed: speed below which the model is held at this speed [m/s], since it has none at a standstill.
    """

    car: SingleTrackParameters = FERRARI_250LM
    minimum_speed: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.minimum_speed > 0:
            raise ConfigurationError(f"estimator.minimum_speed must be positive, not {self.minimum_speed}")


class SampledModel(NamedTuple):
    """The model at the times of T samples: x[k+1] = A[k] x[k] + B[k] δ[k],  a_y[k] = C[k] x[k] + D[k] δ[k].

    Attributes:
        A: (T, 2, 2).
        B: (T, 2).
        C: (T, 2).
        D: (T,).
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


class SingleTrackEstimator(Estimator):
    """Base of estimators whose state is sideslip angle β and yaw rate r of a linear single track."""

    channels = ("yaw_rate", "vx", "ay", "steer")
    skippable = ("yaw_rate", "ay")
    training_type: ClassVar[type] = NoTraining
    settings: SingleTrackSettings

    def seed(self, seed: int) -> None:
        """Nothing here is random."""

    def sampled_model(self, vx: FloatArray) -> SampledModel:
        """The model at forward speeds vx, (T,) [m/s], discretised by forward Euler."""
        speed = np.maximum(vx, self.settings.minimum_speed)
        dynamics = forward_euler(lateral_dynamics(self.settings.car, speed), 1.0 / self.settings.rate_hz)
        acceleration = lateral_acceleration(self.settings.car, speed)
        return SampledModel(*(part.numpy() for part in (*dynamics, *acceleration)))

    def first_state(  # type: ignore[override]
        self, vx: float, deviation: float, initial_state: Mapping[str, float] | None
    ) -> Gaussian[FloatArray]:
        """(β, r) before the first sample: 0 with a standard deviation, or what a protocol hands over (``vy``, ``yaw_rate``)."""
        given = dict(initial_state or {})
        mean = np.array([np.arctan2(given.get("vy", 0.0), max(vx, self.settings.minimum_speed)), given.get("yaw_rate", 0.0)])
        return Gaussian(mean, np.diag([KNOWN**2 if name in given else deviation**2 for name in STATE]))

    def wrapped_state(
        self, recording: Recording, states: FloatArray, covariance: FloatArray | None = None, **others: FloatArray
    ) -> Estimate:
        """The estimate that goes with states (β, r), (T, 2), and their covariances, (T, 2, 2): vy = vx tan β; and other quantities."""
        vx, tangent = recording["vx"], np.tan(states[:, 0])
        if covariance is not None:
            scale = np.stack([vx * (1.0 + tangent**2), np.ones_like(vx)], axis=1)
            covariance = covariance * scale[:, :, None] * scale[:, None, :]
        return self._wrapped(
            recording, vx * tangent, covariance, STATE if covariance is not None else (), yaw_rate=states[:, 1].copy(), **others
        )


class SingleTrackStepper(Stepper):
    """A filter of β, r and perhaps more, one sample at a time: each step filters the last sample and the new one."""

    def __init__(self, estimator: SingleTrackEstimator) -> None:
        self._estimator = estimator
        self._last: FloatArray | None = None
        self._state: Gaussian[FloatArray] | None = None
        self._refused = np.zeros(len(estimator.skippable), np.int64)

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s], yaw rate [rad/s] and what else the filter knows; NaN in yaw_rate or ay is skipped."""
        channels, skippable = self._estimator.channels, self._estimator.skippable
        row = checked_sample(sample, channels, skippable)
        if self._last is None or self._state is None:
            rows, state = row[None], self._first(row)
        else:  # the last sample's measurements are part of the state already
            rows, state = np.stack([self._last, row]), self._state
            rows[0, [channels.index(name) for name in skippable]] = np.nan
        refused = self._refused.copy()
        self._state, others = self._filtered(rows, state, refused)
        self._last, self._refused = row, refused
        tangent = math.tan(self._state.mean[0])
        variance = (row[1] * (1.0 + tangent**2)) ** 2 * self._state.covariance[0, 0]
        return {"vy": float(row[1] * tangent), "vy_variance": float(variance), "yaw_rate": float(self._state.mean[1]), **others}

    @abstractmethod
    def _first(self, row: FloatArray) -> Gaussian[FloatArray]:
        """State before the first sample, (4,)."""

    @abstractmethod
    def _filtered(
        self, rows: FloatArray, state: Gaussian[FloatArray], refused: NDArray[np.int64]
    ) -> tuple[Gaussian[FloatArray], dict[str, float]]:
        """State after the last of the samples, (N, 4), and other quantities at its time; ``refused`` is counted on, see `Gate`."""


def checked_sample(sample: Mapping[str, float], channels: Sequence[str], skippable: Sequence[str]) -> FloatArray:
    """Values of the channels in this order.

    Raises:
        DataError: one is missing, infinite, or NaN where the method cannot do without.
    """
    values = np.array(required(sample, channels))
    if np.isinf(values).any():
        raise DataError(f"the sample holds an infinite value: {dict(sample)}")
    for name, value in zip(channels, values, strict=True):
        if np.isnan(value) and name not in skippable:
            raise DataError(f"the sample's '{name}' is NaN; only {' and '.join(skippable)} may be missing")
    return values


def require_positive(group: str, values: Mapping[str, Any]) -> None:
    """See that all are positive numbers where they are given.

    Raises:
        ConfigurationError: one is not.
    """
    for name, value in values.items():
        if value is not None and not value > 0:
            raise ConfigurationError(f"{group}.{name} must be positive, not {value}")
