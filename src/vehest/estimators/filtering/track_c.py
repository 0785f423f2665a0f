"""Values that the C template of the unscented filter on Dugoff's tyres is filled with."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.constants import GRAVITY
from vehest.estimators.filtering.dugoff_filter import DugoffFilter
from vehest.estimators.filtering.track_filter import KAPPA, UNKNOWN_MOTION
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import MIN_EIGENVALUE_SHARE
from vehest.vehicle.dugoff import (
    MAX_FORCE_RATIO,
    MIN_COSINE,
    MIN_FRICTION_SHARE,
    MIN_LOAD_SHARE,
    TRACK_STATES,
)


def track_c_values(estimator: DugoffFilter) -> dict[str, Any]:
    """Values of a fitted filter without a network, by their names in the template."""
    car = estimator.car
    has_forces = estimator.inputs == "full"
    wheelbase = car.cg_to_front_axle + car.cg_to_rear_axle
    process, sensors = estimator.noise_covariances(estimator.levels)
    measured = 4 if has_forces else 2  # forces that are never measured need no row
    return {
        "n": len(TRACK_STATES),
        "m": measured,
        "rule": symmetric_rule(len(TRACK_STATES), KAPPA),
        "lower": None,
        "repair": True,
        "margin": MIN_EIGENVALUE_SHARE,
        "forces": has_forces,
        "smooth": estimator.curve == "smooth",
        "car": car,
        "step": 1.0 / estimator.rate_hz,
        "transfer": car.cg_height / wheelbase,
        "load_front": GRAVITY * car.cg_to_rear_axle / wheelbase,
        "load_rear": GRAVITY * car.cg_to_front_axle / wheelbase,
        "minimum_speed": estimator.minimum_speed,
        "rolling": np.square(UNKNOWN_MOTION),
        "process": process.diagonal().numpy(),
        "sensors": sensors.diagonal(dim1=-2, dim2=-1).numpy()[:, :measured],
        "front": estimator.axle_tyres[:3],
        "rear": estimator.axle_tyres[3:],
        "nonlinear_from": estimator.nonlinear_from,
        "linear_below": estimator.linear_below,
        "largest": MAX_FORCE_RATIO[estimator.curve],
        "least_share": MIN_FRICTION_SHARE,
        "least_load": MIN_LOAD_SHARE,
        "least_cosine": MIN_COSINE,
    }
