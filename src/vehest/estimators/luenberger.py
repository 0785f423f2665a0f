"""Kinematic Luenberger observer with reset: Farrelly & Wellstead 1996, as in Da Lio et al. 2023, Appendix A."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from vehest.constants import FloatArray
from vehest.declared import fitted
from vehest.estimators.base import Trial
from vehest.estimators.kernels.luenberger import observe
from vehest.estimators.recursive import Recursive
from vehest.training.search import DirectSearchSettings


class Luenberger(Recursive):
    """Kinematic observer with both poles at -α|ω|, reset where the yaw rate is too small to observe anything.

    Source: Da Lio et al. 2023, Appendix A (gains in the order that its Appendix B implies).
    """

    name, title = "luenberger", "Luenberger"
    trials = (
        Trial(
            4,
            "observer; a minute",
            "training.grid=2 training.max_evaluations=100",
        ),
    )
    channels = ("yaw_rate", "vx", "ay", "ax")
    training_type = DirectSearchSettings
    template = "luenberger"
    gain: float = fitted("gain α", start=(3.0, 20.0), box=(0.0, 50.0))
    threshold: float = fitted(
        "yaw rate ω_th below which it is reset", unit="rad/s", start=(0.0, 0.3), box=(0.0, 0.5), of_largest="yaw_rate"
    )

    @classmethod
    def line_style(cls, variant: str) -> tuple[str, str, str]:
        """Grey."""
        return "#767676", "solid", "s"

    def first_state(self, sample: FloatArray, given: Mapping[str, float]) -> Any:
        """v = 0 and the measured speed, or what is given."""
        return given.get("vy", 0.0), given.get("vx", math.nan)

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """Lateral and forward velocity [m/s]."""
        vy, vx = observe(samples, self.gain, self.threshold, 1.0 / self.rate_hz, *state)
        return {"vy": vy, "vx": vx}, (float(vy[-1]), float(vx[-1]))

    def c_values(self) -> dict[str, Any]:
        """Its gain and threshold."""
        return {**self.values, "step": 1.0 / self.rate_hz}


ESTIMATOR = Luenberger
