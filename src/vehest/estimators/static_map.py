"""Baseline: lateral velocity as a static function of speed and yaw rate, with two numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.declared import fitted
from vehest.estimators.base import Trial, rate
from vehest.estimators.recursive import Recursive

# largest condition number of the regressors; beyond it, speed hardly changes and the two numbers
# cannot be identified
MAX_CONDITION_NUMBER = 1e8


class StaticMap(Recursive):
    """v = r (b - k u²), with b and k by least squares on the training recordings.

    It is the steady cornering of a linear single track: b is the distance of the rear axle from the
    point where v holds, k the slip of the rear axle per lateral acceleration, m l_f / (l C_r)
    (Mitschke & Wallentowitz, Dynamik der Kraftfahrzeuge, steady-state cornering). Dynamics, and
    tyres beyond their linear range, are left out.
    """

    name = "static_map"
    title = "Static map"
    trials = (Trial(0.1, "baselines: v = 0, two numbers, leaky integration; seconds"),)
    channels = ("vx", "yaw_rate")
    ignores_initial_state = True
    template = "static"
    rate_hz: float = rate(20.0)
    b: float = fitted("distance from the rear axle to the point at which v is estimated", unit="m")
    k: float = fitted("slip of the rear axle per lateral acceleration", unit="s²/m")

    def closed_form(self, recordings: Sequence[Recording]) -> dict[str, float]:
        """b [m] and k [s²/m] by least squares, by name; raises `DataError`: the car hardly turns,
        or always at one speed.


        Columns r and -r u² are scaled to a mean square of 1 first; their condition number decides
        whether both numbers can be identified. A number that is given is subtracted.
        """
        yaw_rate, vx, vy = (
            np.concatenate([recording[name] for recording in recordings])
            for name in ("yaw_rate", "vx", "vy_ref")
        )
        columns = {"b": yaw_rate, "k": -yaw_rate * np.square(vx)}
        for name in set(columns) - set(self.unknown):
            vy = vy - self.values[name] * columns[name]
        design = np.stack([columns[name] for name in self.unknown], axis=1)
        scale = np.sqrt(np.mean(np.square(design), axis=0))
        if not (scale > 0).all() or np.linalg.cond(design / scale) > MAX_CONDITION_NUMBER:
            raise DataError(
                "the training recordings do not determine a static map: the car hardly turns, or "
                "always at the same speed"
            )
        return dict(
            zip(
                self.unknown,
                (np.linalg.lstsq(design / scale, vy, rcond=None)[0] / scale).tolist(),
                strict=True,
            )
        )

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """v = r (b - k u²) [m/s] at each sample; there is no state."""
        vx, yaw_rate = samples.T
        return {"vy": yaw_rate * (self.b - self.k * np.square(vx))}, state

    def c_values(self) -> dict[str, Any]:
        """The numbers b and k of the C template."""
        return {
            "about": "Steady cornering of a linear single track, its two numbers by least squares.",
            **self.values,
        }


ESTIMATOR = StaticMap  # class by which the registry finds the family
