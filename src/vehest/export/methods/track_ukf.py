"""Unscented filters of a single track on Dugoff's tyres in C, with networks and without."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.constants import GRAVITY
from vehest.estimators.cnn_ukf import CnnUkf
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.ensemble_ukf import LEAST_SPREAD, MOST_SIZE, EnsembleUkf
from vehest.estimators.filtering.track_filter import KAPPA, UNKNOWN
from vehest.estimators.network_ukf import LEAST_VARIANCE, NetworkUkf
from vehest.export.method import MethodTemplate
from vehest.export.methods.kalman import gate_values
from vehest.export.methods.sample_networks import network_values
from vehest.export.rendering import Precision
from vehest.filters.definiteness import MARGIN
from vehest.filters.sigma_points import symmetric_rule
from vehest.vehicle.dugoff import LARGEST_RATIO, LEAST_COSINE, LEAST_LOAD, LEAST_SHARE, TRACK_STATES


def dugoff_ukf(estimator: DugoffUkf, precision: Precision) -> MethodTemplate:
    """The filter alone."""
    needed = tuple(name for name in estimator.channels if name not in estimator.skippable)
    return MethodTemplate("track_ukf", {**_filter_values(estimator), "network": False}, needed, refuses_infinite=estimator.channels)


def ensemble_ukf(estimator: EnsembleUkf, precision: Precision) -> MethodTemplate:
    """The filter and its ensemble."""
    own = {"scaling": estimator.scaling, "mixture": estimator.settings.variance == "mixture"}
    return _with_network(estimator, own | {"least_spread": LEAST_SPREAD, "most_size": MOST_SIZE})


def cnn_ukf(estimator: CnnUkf, precision: Precision) -> MethodTemplate:
    """The filter and the network that was trained through it."""
    return _with_network(estimator, {})


def _with_network(estimator: NetworkUkf, own: dict[str, Any]) -> MethodTemplate:
    values = {**_filter_values(estimator.model), **network_values(estimator.network), **own}
    values |= {"network": True, "seen": estimator.inputs, "least_variance": LEAST_VARIANCE, "m": values["m"] + 1}
    return MethodTemplate("track_ukf", values, estimator.channels, refuses_infinite=estimator.channels)


def _filter_values(model: DugoffUkf) -> dict[str, Any]:
    s = model.settings
    car, forces = s.car, s.inputs == "full"
    wheelbase = car.cg_to_front_axle + car.cg_to_rear_axle
    process, sensors = model.noise_covariances(model.levels)
    measured = 4 if forces else 2  # forces that are never measured need no row
    return {
        **gate_values(model.gate()),
        "n": len(TRACK_STATES),
        "m": measured,
        "rule": symmetric_rule(len(TRACK_STATES), KAPPA),
        "lower": None,
        "repair": True,
        "margin": MARGIN,
        "forces": forces,
        "smooth": s.curve == "smooth",
        "car": car,
        "step": 1.0 / s.rate_hz,
        "transfer": car.cg_height / wheelbase,
        "load_front": GRAVITY * car.cg_to_rear_axle / wheelbase,
        "load_rear": GRAVITY * car.cg_to_front_axle / wheelbase,
        "minimum_speed": s.minimum_speed,
        "rolling": np.square(UNKNOWN),
        "process": process.diagonal().numpy(),
        "sensors": sensors.diagonal(dim1=-2, dim2=-1).numpy()[:, :measured],
        "front": model.tyres[:3],
        "rear": model.tyres[3:],
        "nonlinear_from": s.nonlinear_from,
        "linear_below": s.linear_below,
        "largest": LARGEST_RATIO[s.curve],
        "least_share": LEAST_SHARE,
        "least_load": LEAST_LOAD,
        "least_cosine": LEAST_COSINE,
    }
