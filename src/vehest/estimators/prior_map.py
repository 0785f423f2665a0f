"""Baseline: steady cornering with the priors of the self-calibrating filter, without a fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.declared import UNSET, setting
from vehest.estimators.base import Trial, rate
from vehest.estimators.filtering.self_calibrating_settings import (
    TYPICAL_REAR,
    TYPICAL_WHEELBASE,
    WHEELBASE_POWERS,
)
from vehest.estimators.recursive import Recursive


class PriorMap(Recursive):
    """v = r (b - C u²) with the prior means of b and C: the baseline for estimates of a car that
    nothing was trained on.


    It is the steady cornering of a linear single track (Mitschke & Wallentowitz, Dynamik der
    Kraftfahrzeuge), with the compliance C of a typical rear axle. `SelfCalibrating` starts from the
    same numbers; `StaticMap` fits its two to a reference.
    """

    name = "prior_map"
    title = "Prior map"
    trials = (
        Trial(
            1.2,
            "baseline: steady cornering of a typical car; nothing is fitted",
            "estimator.wheelbase={wheelbase}",
        ),
    )
    channels = ("vx", "yaw_rate")
    ignores_initial_state = True
    template = "static"
    rate_hz: float = rate(20.0)
    wheelbase: float = setting(TYPICAL_WHEELBASE, "wheelbase", unit="m", least=0.05, most=20.0)
    cg_to_rear_axle: float = setting(
        UNSET,
        "distance b from the rear axle to the point at which v is estimated; null: 0.48 wheelbases",
        unit="m",
    )
    compliance: float = setting(
        0.0045, "compliance C of a car of 2.7 m", unit="rad s²/m", positive=True
    )

    def check(self) -> None:
        """Raises `ConfigurationError`: a point outside of the wheelbase."""
        if self.cg_to_rear_axle is not None and not 0.0 < self.cg_to_rear_axle < self.wheelbase:
            raise ConfigurationError(
                "estimator.cg_to_rear_axle must lie between 0 and the wheelbase "
                f"({self.wheelbase} m), not at {self.cg_to_rear_axle}"
            )

    @property
    def b(self) -> float:
        """Distance from the rear axle to the point at which v is estimated [m], positive
        forwards.
        """
        return (
            TYPICAL_REAR * self.wheelbase
            if self.cg_to_rear_axle is None
            else float(self.cg_to_rear_axle)
        )

    @property
    def k(self) -> float:
        """Compliance of the car's rear axle [rad s²/m]: tyres of small cars slip more."""
        return (
            self.compliance * (self.wheelbase / TYPICAL_WHEELBASE) ** WHEELBASE_POWERS["compliance"]
        )

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """v = r (b - C u²) [m/s] at each sample; there is no state."""
        vx, yaw_rate = samples.T
        return {"vy": yaw_rate * (self.b - self.k * np.square(vx))}, state

    def c_values(self) -> dict[str, Any]:
        """The numbers b and k of the C template."""
        about = "Steady cornering of a linear single track with typical numbers."
        return {"about": about, "b": self.b, "k": self.k}


ESTIMATOR = PriorMap  # class by which the registry finds the family
