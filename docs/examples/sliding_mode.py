"""Sliding-mode observer of lateral velocity on the kinematics of the car: a compiled step and two fitted gains.

    dû/dt = a_x + v̂ω + ρ s,   dv̂/dt = a_y - ûω + λ sign(ω) ρ s,   s = sat((u_m - û)/φ)

Once û slides along u_m, the injection ρ s is ω(v - v̂) on average, so that the error of v̂ decays as d(v - v̂)/dt = -λ|ω|(v - v̂).
Where |ω| < ω_th nothing is observable, and v̂ is 0.

Sources: Slotine, Hedrick & Misawa, J. Dyn. Sys. Meas. Control 109 (3), 1987; Farrelly & Wellstead, IEEE CCA 1996.
"""

import numpy as np

from vehest.data.errors import ConfigurationError
from vehest.declared import fitted, setting
from vehest.estimators.recursive import Recursive, compiled
from vehest.training.search import DirectSearchSettings


class SlidingMode(Recursive):
    """λ and ω_th with the smallest mean squared error of vy on the training recordings, unless they are given."""

    name = "sliding_mode"
    title = "Sliding-mode observer"
    channels = ("yaw_rate", "vx", "ay", "ax")
    states = ("vy", "vx")
    training_type = DirectSearchSettings
    template = "sliding_mode"
    gain: float = fitted("correction gain λ", start=(1.0, 10.0), box=(0.0, 20.0))
    threshold: float = fitted(
        "yaw rate ω_th of a reset",
        unit="rad/s",
        start=(0.0, 0.3),
        box=(0.0, 0.5),
        of_largest="yaw_rate",
    )
    injection: float = setting(5.0, "injection ρ, more than |ω(v - v̂)|", unit="m/s²", positive=True)
    layer: float = setting(0.2, "width φ of the boundary layer", unit="m/s", positive=True)

    def check(self):
        """The injection must not cross the boundary layer within a sample."""
        if not self.injection < self.layer * self.rate_hz:
            raise ConfigurationError(
                f"estimator.injection must be less than layer * rate_hz, not {self.injection}"
            )

    @compiled
    def step(numbers, state, sample):
        """(v, u) after a sample."""
        (v, u) = state
        (yaw_rate, vx, ay, ax) = sample
        if abs(yaw_rate) < numbers.threshold:
            return 0.0, vx
        s = numbers.injection * min(max((vx - u) / numbers.layer, -1.0), 1.0)
        dv = ay - u * yaw_rate + numbers.gain * np.sign(yaw_rate) * s
        return v + numbers.dt * dv, u + numbers.dt * (ax + v * yaw_rate + s)

    def c_values(self):
        """Every number that the template names."""
        return self.numbers()._asdict()
