"""Baseline: lateral velocity as a static function of speed and yaw rate, with two numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.base import EstimatorSettings
from vehest.estimators.baseline import Baseline

CONDITION = 1e8  # of the least squares; beyond it, speed hardly changes and the two numbers cannot be told apart


@dataclass(frozen=True)
class StaticMapSettings(EstimatorSettings):
    """Nothing to choose but the rate."""


class StaticMap(Baseline):
    """v = r (b - k u²), with b and k by least squares on the training recordings.

    It is the steady cornering of a linear single track: b is the distance of the rear axle from the point where v holds, k the slip of
    the rear axle per lateral acceleration, m l_f / (l C_r) (Mitschke & Wallentowitz, Dynamik der Kraftfahrzeuge, steady-state cornering).
    Nothing of it is dynamic, and nothing knows of tyres beyond their linear range.
    """

    name = "static_map"
    title = "Static map"
    channels = ("vx", "yaw_rate")
    settings_type = StaticMapSettings
    numbers = ("b", "k")

    def best_numbers(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """b [m] and k [s²/m].

        Raises:
            DataError: the car hardly turns, or always at one speed.
        """
        yaw_rate, vx, vy = (np.concatenate([recording[name] for recording in recordings]) for name in ("yaw_rate", "vx", "vy_ref"))
        design = np.stack([yaw_rate, -yaw_rate * np.square(vx)], axis=1)
        scale = np.sqrt(np.mean(np.square(design), axis=0))
        if not (scale > 0).all() or np.linalg.cond(design / scale) > CONDITION:
            raise DataError("the training recordings do not determine a static map: the car hardly turns, or always at the same speed")
        b, k = np.linalg.lstsq(design / scale, vy, rcond=None)[0] / scale
        return {"b": float(b), "k": float(k)}

    def lateral_velocity(self, samples: Mapping[str, FloatArray], start: float = 0.0) -> FloatArray:
        """r (b - k u²) [m/s]."""
        return samples["yaw_rate"] * (self.values["b"] - self.values["k"] * np.square(samples["vx"]))


ESTIMATOR = StaticMap
