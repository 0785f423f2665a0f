"""Baseline: leaky integration of the lateral acceleration, with one time constant."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.estimators.base import EstimatorSettings
from vehest.estimators.baseline import Baseline

SHORTEST, LONGEST = 0.02, 200.0  # s, time constants that are looked at
N_STARTS = 25  # of a grid over them, in equal ratios, around the best of which the search goes on


@dataclass(frozen=True)
class KinematicSettings(EstimatorSettings):
    """Nothing to choose but the rate."""


class Kinematic(Baseline):
    """dv/dt = a_y - u r - v/T, with the time constant T that fits the training recordings best.

    Exact kinematics for T to infinity, where offsets and tilt of the acceleration add up without bound; the leak forgets them, and with
    them every slow slide. Between samples the acceleration is held.
    """

    name = "kinematic"
    title = "Kinematic integration"
    channels = ("vx", "yaw_rate", "ay")
    settings_type = KinematicSettings
    numbers = ("time_constant",)

    def best_numbers(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """T [s]: the best of a grid, then a search between its neighbours."""
        grid = np.geomspace(SHORTEST, LONGEST, N_STARTS)
        errors = [self._error_with(recordings, time_constant) for time_constant in grid]
        best = int(np.argmin(errors))
        bounds = (math.log(grid[max(best - 1, 0)]), math.log(grid[min(best + 1, N_STARTS - 1)]))
        found = minimize_scalar(lambda logarithm: self._error_with(recordings, math.exp(logarithm)), bounds=bounds, method="bounded")
        return {"time_constant": math.exp(found.x) if found.fun < errors[best] else float(grid[best])}

    def _error_with(self, recordings: Sequence[Recording], time_constant: float) -> float:
        self.values = {"time_constant": float(time_constant)}
        return self.mean_squared_error(recordings)

    def lateral_velocity(self, samples: Mapping[str, FloatArray], start: float = 0.0) -> FloatArray:
        """v [m/s] at each sample, from ``start`` one sample before."""
        time_constant = self.values["time_constant"]
        kept = math.exp(-1.0 / (self.settings.rate_hz * time_constant))
        rate = samples["ay"] - samples["vx"] * samples["yaw_rate"]
        integrated: FloatArray = lfilter([(1.0 - kept) * time_constant], [1.0, -kept], rate, zi=np.array([kept * start]))[0]
        return integrated


ESTIMATOR = Kinematic
