"""Baseline: steady cornering of a single track from what a data sheet says of the car; nothing is learnt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import EstimatorSettings
from vehest.estimators.baseline import Baseline


@dataclass(frozen=True)
class DataSheetSettings(EstimatorSettings):
    """What is known of the car.

    Args:
        wheelbase: [m]; has to be given.
        cg_to_rear_axle: distance of the centre of gravity from the rear axle [m]; half the wheelbase if none is given.
        cornering_coefficient: cornering stiffness of the rear axle over its load [1/rad].

    Raises:
        ConfigurationError: no wheelbase, or a value out of range.
    """

    wheelbase: float | None = None
    cg_to_rear_axle: float | None = None
    cornering_coefficient: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.wheelbase is None:
            raise ConfigurationError("estimator 'data_sheet' needs your car's wheelbase: estimator.wheelbase=2.7 [m]")
        for name in ("wheelbase", "cornering_coefficient"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"estimator.{name} must be positive, not {getattr(self, name)}")
        if self.cg_to_rear_axle is not None and not 0.0 < self.cg_to_rear_axle < self.wheelbase:
            raise ConfigurationError(
                f"estimator.cg_to_rear_axle must lie between 0 and the wheelbase ({self.wheelbase} m), not at {self.cg_to_rear_axle}"
            )


class DataSheet(Baseline):
    """v = r (l_r - u² / (c g)): the static map of a car on linear tyres whose stiffness is c times their load.

    From the steady cornering of a linear single track, v = r (l_r - m l_f u² / (l C_r)): the rear axle carries m g l_f / l, and with
    C_r = c m g l_f / l mass and load cancel. Tyres of road and race cars have c of 6 to 15 per rad (Milliken & Milliken, Race Car Vehicle
    Dynamics, 1995); 10 is assumed where nothing better is known.
    """

    name = "data_sheet"
    title = "Data sheet"
    channels = ("vx", "yaw_rate")
    settings_type = DataSheetSettings
    settings: DataSheetSettings

    def lateral_velocity(self, samples: Mapping[str, FloatArray], start: float = 0.0) -> FloatArray:
        """r (l_r - u² / (c g)) [m/s]."""
        s = self.settings
        assert s.wheelbase is not None
        rear = s.wheelbase / 2.0 if s.cg_to_rear_axle is None else s.cg_to_rear_axle
        return samples["yaw_rate"] * (rear - np.square(samples["vx"]) / (s.cornering_coefficient * GRAVITY))


ESTIMATOR = DataSheet
