"""Factor graph over the linear single track.

    samples (T, 4) --linear_model--> `LinearModel` --kalman_scan, smoothed_means--> β, r --> vy

Without a window one chain over the whole recording is solved, offline. With a window, each sample
solves the chain over the last N samples, whose first state has a Gaussian factor that the previous
window left, and the estimate is the newest state.

Source: the FG of Leanza et al. 2021, as in Table VI of Da Lio et al. 2023.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.declared import Group, setting
from vehest.estimators.base import Trial
from vehest.estimators.filtering.sideslip_filter import MEASURED, SideslipFilter
from vehest.filters.gating import refuses
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel, smoothed_means
from vehest.filters.kalman_scan import kalman_scan


@dataclass(frozen=True)
class FactorNoise(Group):
    """Standard deviations of the factors, per sample at 100 Hz; the same numbers at other rates."""

    group = "estimator.noise"
    model_sideslip: float = setting(
        4e-3, "of β one sample later, given β and r", unit="rad", positive=True
    )
    model_yaw_rate: float = setting(
        9e-3, "of r one sample later, given β and r", unit="rad/s", positive=True
    )
    measured_yaw_rate: float = setting(
        1e-2, "of r, given the gyroscope", unit="rad/s", positive=True
    )
    measured_ay: float = setting(
        7.0, "of a_y as the model has it, given the accelerometer", unit="m/s²", positive=True
    )
    first_state: float = setting(
        100.0, "of β and r before the first sample", unit="rad, rad/s", positive=True
    )
    window_start: float = setting(
        1.0,
        "of a window's first β and r, given their running estimate",
        unit="rad, rad/s",
        positive=True,
    )


class WindowState(NamedTuple):
    """State of the moving window between two samples."""

    # values of ``channels`` at the samples in the window, without the next one, (N, 4)
    samples: FloatArray
    start: Gaussian[FloatArray]  # (β, r) at the window's first sample, before its measurement
    refused: NDArray[np.int64]  # counters of the gate (`vehest.filters.gating`), (2,)


class FactorGraph(SideslipFilter):
    """Factor graph of sideslip angle and yaw rate, solved as a whole or over a moving window.

    At each sample a factor on a_y and one on r; between samples one factor for β and one for r.
    Given the speed the model is linear and the graph a chain, so a Kalman filter and a
    Rauch-Tung-Striebel smoother solve it exactly.

    Source: Leanza, Reina & Blanco-Claraco, Sensors 21 (16), 5409, 2021, and the authors' public
    code, from which the standard deviations are. The window's estimate here is that of its newest
    sample, with that sample's measurements.
    """

    name = "factor_graph"
    title = "Factor graph"
    trials = (
        Trial(
            10,
            "factor graph over half a second, causal; nothing is fitted",
            "estimator.window=0.5 {car}",
        ),
    )
    offline = (
        "a factor graph over a whole recording cannot run along with a drive; set "
        "estimator.window=0.05 [s]"
    )
    window: float | None = setting(
        None,
        "how far the graph of a causal estimate reaches back; null: one graph, offline",
        unit="s",
    )
    noise: FactorNoise = setting(
        FactorNoise(), "standard deviations of the factors a sample at 100 Hz, the authors'"
    )

    def check(self) -> None:
        """Raise `ConfigurationError` for a window below a sample, or a gate without a window."""
        if self.window is not None and self.intervals < 1:
            raise ConfigurationError(
                "estimator.window must be null or at least one sampling interval, "
                f"{1 / self.rate_hz:g} s, not {self.window} s"
            )
        if self.gate is not None and self.window is None:
            raise ConfigurationError(
                "estimator.gate needs estimator.window: one graph over a whole recording has no "
                "sample to predict"
            )

    @property
    def intervals(self) -> int:
        """Number of sampling intervals that the window spans; 0 without a window."""
        return round((self.window or 0.0) * self.rate_hz)

    @property
    def causal(self) -> bool:
        """Whether there is a window."""
        return self.window is not None

    @property
    def variant(self) -> str:
        """Identifier with the length of the window and the gate, or ``batch``."""
        return (
            f"factor_graph_lag_{self.window:g}s{self.gate_suffix}"
            if self.causal
            else "factor_graph_batch"
        )

    @property
    def full_title(self) -> str:
        """Title with how it is solved."""
        mode = f"fixed lag of {self.window:g} s{self.gate_title}" if self.causal else "batch"
        return f"{self.title}, {mode}"

    def first_gaussian(
        self, sample: FloatArray, initial_state: Mapping[str, float]
    ) -> Gaussian[FloatArray]:
        """Mean and covariance of (β, r) before the first sample: straight ahead with wide
        deviations, or a known initial state.

        Deviations of β [rad] and r [rad/s] are ``noise.first_state``; a known state
        counts as exact.
        """
        return self.first_motion(sample, np.full(2, self.noise.first_state), initial_state)

    def first_state(  # type: ignore[override]
        self, sample: FloatArray, initial_state: Mapping[str, float]
    ) -> WindowState:
        """An empty window."""
        return WindowState(
            np.empty((0, len(self.channels))),
            self.first_gaussian(sample, initial_state),
            np.zeros(2, np.int64),
        )

    def run(  # type: ignore[override]
        self, samples: FloatArray, state: WindowState
    ) -> tuple[dict[str, Any], WindowState]:
        """Estimate lateral velocity [m/s] and yaw rate [rad/s]: window by window, or, without a
        window, of all samples together.
        """
        rows = np.vstack([state.samples, samples])
        start = state.start
        refused = state.refused.copy()
        model = self.linear_model(rows)
        behind = len(state.samples)
        full = self.intervals + 1
        if self.causal:
            states = np.empty((len(samples), 2))
            for k in range(len(samples)):
                window = slice(max(0, behind + k + 1 - full), behind + k + 1)
                solved = self.solve_window(
                    LinearModel(*(part[window] for part in model)), rows[window], start, refused
                )
                states[k] = solved[-1]
                if len(solved) == full:
                    start = Gaussian(solved[1], self.noise.window_start**2 * np.eye(2))
        else:
            states = smoothed_means(model, kalman_scan(model, rows[:, MEASURED], start))
        values = {"vy": samples[:, 1] * np.tan(states[:, 0]), "yaw_rate": states[:, 1].copy()}
        return values, WindowState(rows[max(0, len(rows) - self.intervals) :], start, refused)

    def linear_model(self, samples: FloatArray) -> LinearModel[FloatArray]:
        """Model of samples of ``channels``, (T, 4); yaw rate and a_y are measured.

        The state is (β [rad], r [rad/s]); speeds below the minimum count as the minimum. Noise is
        constant over time; levels, stated per sample at 100 Hz, are not scaled to another rate.
        """
        _, vx, _, steer = samples.T
        A, B, C, D = self.sampled_model(vx)
        steps = len(samples)
        noise = self.noise
        observation = np.zeros((steps, 2, 2))
        observation[:, 0, 1] = 1.0
        observation[:, 1] = C
        offset = np.stack([np.zeros(steps), D * steer], axis=1)
        process = np.diag(np.square([noise.model_sideslip, noise.model_yaw_rate]))
        measured = np.square([noise.measured_yaw_rate, noise.measured_ay])
        process = np.broadcast_to(process, (steps, 2, 2))
        measured = np.broadcast_to(measured, (steps, 2))
        return LinearModel(A, B * steer[:, None], process, observation, offset, measured)

    def solve_window(
        self,
        model: LinearModel[FloatArray],
        samples: FloatArray,
        start: Gaussian[FloatArray],
        refused: NDArray[np.int64],
    ) -> FloatArray:
        """Smoothed states of a window's samples, (N, 2).

        Parameters
        ----------
        model : LinearModel
            Of the window's N samples.
        samples : array
            Of ``channels``, (N, 4). Measurements of the newest that the gate refuses become NaN in
            them.
        start : Gaussian
            The first state before its measurement.
        refused : array
            Counters of the gate, (2,), changed in place (see `Gate`).
        """
        filtered = kalman_scan(model, samples[:, MEASURED], start)
        gate = self.gate_in_use()
        if gate is not None:
            errors = filtered.innovation[-1]
            variances = filtered.innovation_covariance[-1].diagonal()
            for i, column in enumerate(MEASURED):
                if filtered.measured[-1, i] and refuses(
                    errors[i], variances[i], gate.deviations**2, gate.patience, refused, i
                ):
                    samples[-1, column] = np.nan
            filtered = kalman_scan(model, samples[:, MEASURED], start)
        return smoothed_means(model, filtered)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """No weights, since nothing is fitted."""
        return {}


ESTIMATOR = FactorGraph  # class by which the registry finds the family
