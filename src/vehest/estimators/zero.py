"""The plainest baseline: the car does not slide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.base import EstimatorSettings
from vehest.estimators.baseline import Baseline


@dataclass(frozen=True)
class ZeroSettings(EstimatorSettings):
    """Nothing to choose but the rate."""


class Zero(Baseline):
    """v = 0 at all times: what an estimator is worth at all is what it takes away from this error."""

    name = "zero"
    title = "Zero (v = 0)"
    channels = ("vx",)
    settings_type = ZeroSettings

    def lateral_velocity(self, samples: Mapping[str, FloatArray], start: float = 0.0) -> FloatArray:
        """Zeros [m/s]."""
        return np.zeros(len(samples["vx"]))


ESTIMATOR = Zero
