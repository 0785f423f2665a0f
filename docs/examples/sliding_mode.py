"""Sliding-mode observer of lateral velocity on the kinematics of the car: a compiled recursion and a direct search.

    dû/dt = a_x + v̂ω + ρ s,   dv̂/dt = a_y - ûω + λ sign(ω) ρ s,   s = sat((u_m - û)/φ)

Once û slides along u_m, the injection ρ s is ω(v - v̂) on average, so that the error of v̂ decays as d(v - v̂)/dt = -λ|ω|(v - v̂).
Where |ω| < ω_th nothing is observable, and v̂ is 0.

Sources: observer of Slotine, Hedrick & Misawa, J. Dyn. Sys. Meas. Control 109 (3), 1987, with its boundary layer φ; kinematics and reset of
Farrelly & Wellstead, IEEE CCA 1996.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from vehest.data.errors import ConfigurationError
from vehest.estimators.base import EstimatorSettings, FitRecord
from vehest.estimators.recursive import RecursiveEstimator
from vehest.training.search import DirectSearchSettings, nelder_mead_over_grid


@dataclass(frozen=True)
class SlidingModeSettings(EstimatorSettings):
    """Injection ρ [m/s²], which has to exceed |ω(v - v̂)|, and boundary layer φ [m/s]."""

    injection: float = 5.0
    layer: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.injection < self.layer * self.rate_hz:
            raise ConfigurationError(f"estimator.injection must lie between 0 and layer * rate_hz, not at {self.injection}")


@njit
def observe(samples, gain, threshold, injection, layer, step, v, u):
    """Lateral velocity (T,) at each row of yaw_rate, vx, ay, ax, and v, u after the last."""
    vy = np.empty(len(samples))
    for k in range(len(samples)):
        yaw_rate, vx, ay, ax = samples[k, 0], samples[k, 1], samples[k, 2], samples[k, 3]
        if abs(yaw_rate) < threshold:
            v, u = 0.0, vx
        else:
            s = injection * min(max((vx - u) / layer, -1.0), 1.0)
            v, u = v + step * (ay - u * yaw_rate + gain * np.sign(yaw_rate) * s), u + step * (ax + v * yaw_rate + s)
        vy[k] = v
    return vy, (v, u)


class SlidingMode(RecursiveEstimator):
    """λ and ω_th [rad/s] with the smallest mean squared error of vy on the training recordings."""

    name, title = "sliding_mode", "Sliding-mode observer"
    channels = ("yaw_rate", "vx", "ay", "ax")
    numbers = ("gain", "threshold")
    settings_type, training_type = SlidingModeSettings, DirectSearchSettings
    settings: SlidingModeSettings

    def first_state(self, sample, given):
        """v = 0 and the measured speed, or what a protocol hands over."""
        return given.get("vy", 0.0), given.get("vx", sample[1])

    def run(self, samples, state):
        """Lateral velocity from a state (v, u)."""
        own = self.settings
        vy, state = observe(samples, *self.values.values(), own.injection, own.layer, 1.0 / own.rate_hz, *state)
        return {"vy": vy}, state

    def fitted(self, data, training, context):
        """Nelder-Mead from a grid of starts, λ in 1 … 10 and ω_th in 0 … 0.3 of the largest |ω|."""

        def cost(numbers):
            self.values = dict(zip(self.numbers, numbers.tolist(), strict=True))
            return self.mean_squared_error(data.train)

        fastest = max(float(np.abs(recording["yaw_rate"]).max()) for recording in data.train)
        search = nelder_mead_over_grid(cost, [(0, 20), (0, 0.5 * fastest)], [(1, 10), (0, 0.3 * fastest)], training, context)
        metrics = {"best_train_loss": search.cost, "evaluations": search.evaluations}
        return dict(zip(self.numbers, search.best, strict=True)), FitRecord(metrics=metrics, interrupted=search.interrupted)
