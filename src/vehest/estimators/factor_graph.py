"""Factor graph over the linear single track: the FG of Leanza et al. 2021, as in Table VI of Da Lio et al. 2023."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, FitData, FitRecord, Stepper
from vehest.estimators.filtering.single_track import SingleTrackEstimator, SingleTrackSettings, checked_sample, require_positive
from vehest.filters.gating import Gate, in_words, refuses, suffix
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel, smoothed_means
from vehest.filters.kalman_scan import kalman_scan
from vehest.training.context import FitContext

MEASURED = [0, 2]
"""Yaw rate and a_y among the channels."""


@dataclass(frozen=True)
class FactorNoise:
    """Standard deviations of the factors, per sample at 100 Hz.

    Args:
        model_sideslip: of β one sample later, given β and r [rad].
        model_yaw_rate: of r one sample later, given β and r [rad/s].
        measured_yaw_rate: of r, given the gyroscope [rad/s].
        measured_ay: of a_y as the model has it, given the accelerometer [m/s²].
        first_state: of β and r before the first sample [rad, rad/s].
        window_start: of a window's first β and r, given the running estimate of them [rad, rad/s].
    """

    model_sideslip: float = 4e-3
    model_yaw_rate: float = 9e-3
    measured_yaw_rate: float = 1e-2
    measured_ay: float = 7.0
    first_state: float = 100.0
    window_start: float = 1.0

    def __post_init__(self) -> None:
        require_positive("estimator.noise", asdict(self))


@dataclass(frozen=True)
class FactorGraphSettings(SingleTrackSettings):
    """Settings of the factor graph.

    Args:
        window: how far the graph behind a causal estimate reaches back [s]; none for one graph over the whole recording, offline.
        noise: standard deviations of the factors.
        gate: standard deviations of an innovation beyond which a measurement gets no factor; none: all get one. Only with a window; see
            `Gate`.
    """

    window: float | None = None
    noise: FactorNoise = FactorNoise()
    gate: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window is not None and not round(self.window * self.rate_hz) >= 1:
            raise ConfigurationError(
                f"estimator.window must be null or at least one sampling interval, {1 / self.rate_hz:g} s, not {self.window} s"
            )
        require_positive("estimator", {"gate": self.gate})
        if self.gate is not None and self.window is None:
            raise ConfigurationError("estimator.gate needs estimator.window: one graph over a whole recording has no sample to predict")

    @property
    def intervals(self) -> int:
        """Sampling intervals that the window spans."""
        return round((self.window or 0.0) * self.rate_hz)


class FactorGraph(SingleTrackEstimator):
    """Factor graph of sideslip angle and yaw rate, solved as a whole or over a window that moves along.

    At each sample a factor on a_y and one on r; between samples one factor for β and one for r. Given the speed the model is linear and
    the graph a chain, so a Kalman filter and a Rauch-Tung-Striebel smoother solve it exactly.

    Source: Leanza, Reina & Blanco-Claraco, Sensors 21 (16), 5409, 2021, and the authors' public code, from which the standard
    deviations are. The window's estimate here is that of its newest sample, with that sample's measurements.
    """

    name = "factor_graph"
    title = "Factor graph"
    settings_type = FactorGraphSettings
    settings: FactorGraphSettings

    @property
    def causal(self) -> bool:
        """With a window."""
        return self.settings.window is not None

    @property
    def learns(self) -> bool:
        """Everything is given."""
        return False

    @property
    def variant(self) -> str:
        """Batch, or how long the window is and its gate."""
        return f"factor_graph_lag_{self.settings.window:g}s{suffix(self.settings.gate)}" if self.causal else "factor_graph_batch"

    @property
    def full_title(self) -> str:
        """Title with how it is solved."""
        own = f"fixed lag of {self.settings.window:g} s{in_words(self.settings.gate)}" if self.causal else "batch"
        return f"{self.title}, {own}"

    @property
    def n_parameters(self) -> int:
        """Nothing is fitted."""
        return 0

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Fit nothing."""
        return [FitRecord(metrics={"epochs": 0, "train_seconds": 0.0}) for _ in members]

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        samples = recording.stack(self.channels)
        model = self.linear_model(samples)
        start = self.first_state(samples[0, 1], self.settings.noise.first_state, initial_state)
        if not self.causal:
            return self.wrapped_state(recording, smoothed_means(model, kalman_scan(model, samples[:, MEASURED], start)))
        states, refused = np.empty((len(samples), 2)), np.zeros(2, np.int64)
        for k in range(len(samples)):
            window = slice(max(0, k - self.settings.intervals), k + 1)
            solved = self.solve_window(LinearModel(*(part[window] for part in model)), samples[window], start, refused)
            states[k] = solved[-1]
            if k >= self.settings.intervals:
                start = self.restart(solved)
        return self.wrapped_state(recording, states)

    def linear_model(self, samples: FloatArray) -> LinearModel[FloatArray]:
        """Model of samples of ``channels``, (T, 4); yaw rate and a_y are measured."""
        _, vx, _, steer = samples.T
        A, B, C, D = self.sampled_model(vx)
        steps, noise = len(samples), self.settings.noise
        observation = np.zeros((steps, 2, 2))
        observation[:, 0, 1], observation[:, 1] = 1.0, C
        offset = np.stack([np.zeros(steps), D * steer], axis=1)
        process = np.diag(np.square([noise.model_sideslip, noise.model_yaw_rate]))
        measured = np.diag(np.square([noise.measured_yaw_rate, noise.measured_ay]))
        process, measured = (np.broadcast_to(covariance, (steps, 2, 2)) for covariance in (process, measured))
        return LinearModel(A, B * steer[:, None], process, observation, offset, measured)

    def solve_window(
        self, model: LinearModel[FloatArray], samples: FloatArray, start: Gaussian[FloatArray], refused: NDArray[np.int64]
    ) -> FloatArray:
        """States of a window's samples given all of them, (N, 2); measurements of the newest that the gate refuses become NaN.

        Args:
            model: of these samples.
            samples: of ``channels``, (N, 4), of which the newest is changed in place.
            start: the first state before its measurement.
            refused: see `Gate`, changed in place.
        """
        filtered = kalman_scan(model, samples[:, MEASURED], start)
        gate = Gate.of(self.settings.gate, self.settings.rate_hz)
        if gate is not None:
            errors, variances = filtered.innovation[-1], filtered.innovation_covariance[-1].diagonal()
            for i, column in enumerate(MEASURED):
                if filtered.measured[-1, i] and refuses(errors[i], variances[i], gate.deviations**2, gate.patience, refused, i):
                    samples[-1, column] = np.nan
            filtered = kalman_scan(model, samples[:, MEASURED], start)
        return smoothed_means(model, filtered)

    def restart(self, solved: FloatArray) -> Gaussian[FloatArray]:
        """First state of the next window, from the states of a full one: its second sample becomes the first."""
        return Gaussian(solved[1], self.settings.noise.window_start**2 * np.eye(2))

    def online(self) -> FactorGraphStepper:
        """A stepper with an empty window."""
        if not self.causal:
            raise ConfigurationError("a factor graph over a whole recording cannot run along with a drive; set estimator.window=0.05 [s]")
        return FactorGraphStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """There are none."""
        return {}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """See that there are none."""
        if weights:
            raise DataError(f"'factor_graph' has no weights, not {', '.join(weights)}")


class FactorGraphStepper(Stepper):
    """The graph over a moving window, one sample at a time; a sample that fails changes nothing."""

    def __init__(self, estimator: FactorGraph) -> None:
        self._estimator = estimator
        self._samples = np.empty((0, 4))
        self._start: Gaussian[FloatArray] | None = None
        self._refused = np.zeros(2, np.int64)

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s] and yaw rate [rad/s] at the time of the sample; NaN in yaw_rate or ay is skipped."""
        estimator = self._estimator
        row = checked_sample(sample, estimator.channels, estimator.skippable)
        full = estimator.settings.intervals + 1
        samples, refused = np.vstack([self._samples, row])[-full:], self._refused.copy()
        start = self._start or estimator.first_state(row[1], estimator.settings.noise.first_state, None)
        solved = estimator.solve_window(estimator.linear_model(samples), samples, start, refused)
        self._samples, self._refused = samples, refused
        self._start = estimator.restart(solved) if len(solved) == full else start
        sideslip, yaw_rate = solved[-1]
        return {"vy": float(row[1] * math.tan(sideslip)), "yaw_rate": float(yaw_rate)}


ESTIMATOR = FactorGraph
