"""Values that the C template of a `CarFilter` is filled with."""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vehest.constants import GRAVITY, FloatArray
from vehest.estimators.filtering.car_filter import CarFilter
from vehest.filters.unscented_scan import MIN_EIGENVALUE_SHARE, CompiledNoise, StepNoise
from vehest.vehicle.dynamics import (
    PACEJKA,
    STATES,
    TURN,
    UNSCALED,
    Dynamics,
    Perceptron,
    physical_of,
)
from vehest.vehicle.planar import LEARNT
from vehest.vehicle.tyres import SLIP_SPEED_OFFSET


def car_filter_in_c(car_filter: CarFilter) -> dict[str, Any]:
    """Dynamics, noise and sigma points of a trained filter, by their names in the template.

    Everything is converted to double first, whatever the filter was trained in. Infinite bounds
    become None, which a template leaves out.
    """
    model = deepcopy(car_filter).double()
    with torch.no_grad():
        process, observation = model.noise_at()
        return {
            **_dynamics_in_c(model.dynamics),
            "n": len(STATES),
            "rule": model.rule,
            "lower": [value if math.isfinite(value) else None for value in model.lower],
            "repair": model.repair,
            "margin": MIN_EIGENVALUE_SHARE,
            "step": model.step,
            "still": SLIP_SPEED_OFFSET,
            "turn": TURN,
            "unscaled": UNSCALED,
            "initial": _numbers(model.initial_covariance()),
            "process": _noise_in_c(process),
            "observation": _noise_in_c(observation),
        }


def _dynamics_in_c(dynamics: Dynamics) -> dict[str, Any]:
    """Physical numbers, tyre curves and the network's layers, from the inputs on, for the
    template.
    """
    values, (mass, wheelbase, _) = physical_of(dynamics)
    p = dict(zip((*LEARNT, *PACEJKA), values.tolist(), strict=True))
    weight = mass * GRAVITY / wheelbase
    front_arm = wheelbase - p["cg_to_rear_axle"]
    values_in_c: dict[str, Any] = {
        "p": p,
        "mass": mass,
        "front_arm": front_arm,
        "front_load": weight * p["cg_to_rear_axle"],
        "rear_load": weight * front_arm,
        "curves": [[p[f"{letter}_{axle}"] for letter in "BCD"] for axle in ("x", "front", "rear")],
    }
    network = getattr(dynamics, "network", None)
    if isinstance(network, Perceptron):
        for number, (matrix, offset) in enumerate(network.layers(), 1):
            values_in_c |= {f"W{number}": _numbers(matrix.T), f"b{number}": _numbers(offset)}
    return values_in_c


def _noise_in_c(noise: StepNoise) -> dict[str, Any]:
    """A noise covariance for the template: a constant one, or the factor of one that depends
    linearly on the state (`compiled_noise`).
    """
    if not isinstance(noise, CompiledNoise):
        return {"constant": noise[0], "weight": None}
    constant, weight, offset, *numbers = noise.car
    scale, lower = map(float, numbers)
    n = len(constant)
    return {
        "constant": constant,
        "weight": weight,
        "offset": offset,
        "scale": scale,
        "least": lower if math.isfinite(lower) else None,
        "units": n * math.log(2.0 * math.pi * math.e),
        "size": n,
    }


def _numbers(values: Tensor) -> FloatArray:
    """Values of a tensor as float64."""
    return values.detach().numpy().astype(np.float64)
