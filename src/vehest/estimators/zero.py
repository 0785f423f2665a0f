"""Baseline: the car does not slide."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.base import Trial, rate
from vehest.estimators.recursive import Recursive


class Zero(Recursive):
    """v = 0 at all times."""

    name = "zero"
    title = "Zero (v = 0)"
    trials = (Trial(0, "baselines: v = 0, two numbers, leaky integration; seconds"),)
    channels = ("vx",)
    ignores_initial_state = True
    template = "static"
    rate_hz: float = rate(20.0)

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """v = 0 [m/s] at each sample; there is no state."""
        return {"vy": np.zeros(len(samples))}, state

    def c_values(self) -> dict[str, Any]:
        """The equation as a comment of the C template."""
        return {"about": "v = 0."}


ESTIMATOR = Zero  # class by which the registry finds the family
