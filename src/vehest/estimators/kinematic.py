"""Baseline: leaky integration of the lateral acceleration, with one time constant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.declared import fitted
from vehest.estimators.base import Trial, rate
from vehest.estimators.recursive import Recursive

MIN_TIME_CONSTANT = 0.02  # s, first time constant of the grid from which the search starts
MAX_TIME_CONSTANT = 200.0  # s, its last one
N_STARTS = 25  # time constants of the grid, in equal ratios; the search goes on around the best


class Kinematic(Recursive):
    """dv/dt = a_y - u r - v/T, with the time constant T that fits the training recordings best.

    Exact kinematics for T to infinity, where offsets and tilt of the acceleration add up without
    bound; the leak forgets them, and with them every slow slide. Between samples the acceleration
    is held.
    """

    name = "kinematic"
    title = "Kinematic integration"
    trials = (Trial(0.2, "baselines: v = 0, two numbers, leaky integration; seconds"),)
    channels = ("vx", "yaw_rate", "ay")
    ignores_initial_state = True
    template = "kinematic"
    rate_hz: float = rate(20.0)
    time_constant: float = fitted("time constant of the leak", unit="s", positive=True)

    def closed_form(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """T [s]: the best of a grid, then a search between its neighbours.

        The error is not convex in T; the grid of 25 values from 0.02 to 200 s finds the right
        valley.
        """
        grid = np.geomspace(MIN_TIME_CONSTANT, MAX_TIME_CONSTANT, N_STARTS)
        errors = [self._error_with(recordings, time_constant) for time_constant in grid]
        best = int(np.argmin(errors))
        bounds = (math.log(grid[max(best - 1, 0)]), math.log(grid[min(best + 1, N_STARTS - 1)]))
        solution = scipy.optimize.minimize_scalar(
            lambda logarithm: self._error_with(recordings, math.exp(logarithm)),
            bounds=bounds,
            method="bounded",
        )
        return {
            "time_constant": math.exp(solution.x)
            if solution.fun < errors[best]
            else float(grid[best])
        }

    def _error_with(self, recordings: Sequence[Recording], time_constant: float) -> float:
        """Mean squared error of vy with a time constant [m²/s²]; the time constant stays set."""
        self.time_constant = time_constant
        return self.mean_squared_error(recordings)

    @property
    def decay(self) -> float:
        """Factor exp(-τ/T) by which v decays over a sample."""
        return math.exp(-1.0 / (self.rate_hz * self.time_constant))

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """v [m/s] at each sample, from that one sample before.

        v⁺ = d v + (1 - d) T (a_y - u r) with d = exp(-τ/T), the exact solution for an acceleration
        that is held over the sample.

        Parameters
        ----------
        samples : array
            vx [m/s], yaw rate [rad/s] and ay [m/s²], (T, 3).
        state : tuple
            v before the first sample [m/s].
        """
        vx, yaw_rate, ay = samples.T
        gain = (1.0 - self.decay) * self.time_constant
        (start,) = state
        vy = scipy.signal.lfilter(
            [gain], [1.0, -self.decay], ay - vx * yaw_rate, zi=np.array([self.decay * start])
        )[0]
        return {"vy": vy}, (float(vy[-1]),)

    def c_values(self) -> dict[str, Any]:
        """Time constant, decay and gain for the C template."""
        return {
            "time_constant": self.time_constant,
            "kept": self.decay,
            "gain": (1.0 - self.decay) * self.time_constant,
        }


ESTIMATOR = Kinematic  # class by which the registry finds the family
