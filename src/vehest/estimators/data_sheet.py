"""Baseline: steady cornering of a single track from a data sheet; nothing is fitted."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError
from vehest.declared import UNSET, setting
from vehest.estimators.base import Trial, rate
from vehest.estimators.recursive import Recursive


class DataSheet(Recursive):
    """v = r (l_r - u² / (c g)), for a car on linear tyres whose stiffness is c times their load.

    From the steady cornering of a linear single track, v = r (l_r - m l_f u² / (l C_r)): the rear
    axle carries m g l_f / l, and with C_r = c m g l_f / l mass and load cancel. Tyres of road and
    race cars have c of 6 to 15 per rad (Milliken & Milliken, Race Car Vehicle Dynamics, 1995); 10
    is assumed where nothing better is known.

    u is the forward speed and r the yaw rate, positive to the left, as is v at the centre of
    gravity.
    """

    name = "data_sheet"
    title = "Data sheet"
    trials = (
        Trial(
            1,
            "baseline: steady cornering from the data sheet",
            "estimator.wheelbase={wheelbase}",
        ),
    )
    channels = ("vx", "yaw_rate")
    ignores_initial_state = True
    template = "static"
    rate_hz: float = rate(20.0)
    wheelbase: float = setting(UNSET, "wheelbase; has to be given", unit="m", least=0.05, most=20.0)
    cg_to_rear_axle: float = setting(
        UNSET,
        "distance of the centre of gravity from the rear axle; null: half the wheelbase",
        unit="m",
    )
    cornering_coefficient: float = setting(
        10.0,
        "cornering stiffness of the rear axle over its load; assumed",
        unit="1/rad",
        positive=True,
    )

    def check(self) -> None:
        """Raises `ConfigurationError`: no wheelbase, or a centre of gravity outside of it."""
        if self.wheelbase is None:
            raise ConfigurationError(
                "estimator 'data_sheet' needs your car's wheelbase: estimator.wheelbase=2.7 [m]"
            )
        if self.cg_to_rear_axle is not None and not 0.0 < self.cg_to_rear_axle < self.wheelbase:
            raise ConfigurationError(
                "estimator.cg_to_rear_axle must lie between 0 and the wheelbase "
                f"({self.wheelbase} m), not at {self.cg_to_rear_axle}"
            )

    @property
    def rear(self) -> float:
        """Distance of the centre of gravity from the rear axle [m]."""
        return self.wheelbase / 2.0 if self.cg_to_rear_axle is None else self.cg_to_rear_axle

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, FloatArray], Any]:
        """v = r (l_r - u² / (c g)) [m/s] at each sample; there is no state."""
        vx, yaw_rate = samples.T
        return {
            "vy": yaw_rate * (self.rear - np.square(vx) / (self.cornering_coefficient * GRAVITY))
        }, state

    def c_values(self) -> dict[str, Any]:
        """Numbers of the data sheet for the C template."""
        about = "Steady cornering of a linear single track from a data sheet."
        return {
            "about": about,
            "rear": self.rear,
            "stiffness": self.cornering_coefficient * GRAVITY,
        }


ESTIMATOR = DataSheet  # class by which the registry finds the family
