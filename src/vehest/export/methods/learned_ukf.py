"""The unscented filter with learnt dynamics and noise in C."""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vehest.constants import GRAVITY
from vehest.estimators.filtering.car_filter import LEAST_ENTROPY
from vehest.estimators.learned_ukf import INPUTS, MEASURED, UNKNOWN, LearnedUkf
from vehest.export.method import MethodTemplate
from vehest.export.methods.kalman import gate_values
from vehest.export.rendering import Precision
from vehest.filters.definiteness import MARGIN
from vehest.filters.noise_models import StateDependentNoise
from vehest.vehicle.dynamics import PACEJKA, PHYSICAL, STATES, TURN, UNSCALED, Perceptron, physical_of
from vehest.vehicle.tyres import STILL


def learned_ukf(estimator: LearnedUkf, precision: Precision) -> MethodTemplate:
    """Its dynamics, noise, car and gate."""
    s = estimator.settings
    own = deepcopy(estimator.filter).double()
    with torch.no_grad():
        process, observation = own.process_noise, own.observation_noise
        values = {
            **gate_values(estimator.gate()),
            **_dynamics(own.dynamics),
            "n": len(STATES),
            "m": len(MEASURED),
            "rule": own.rule,
            "lower": [value if math.isfinite(value) else None for value in own.lower],
            "repair": own.repair,
            "margin": MARGIN,
            "kind": s.dynamics,
            "dynamics": s.dynamics.replace("_", " "),
            "noise_kind": s.noise.replace("_", " "),
            "step": own.step,
            "radius": s.car.wheel_radius,
            "still": STILL,
            "turn": TURN,
            "unscaled": UNSCALED,
            "friction": s.friction if s.start_friction is None else s.start_friction,
            "initial": _numbers(own.initial_covariance()) + np.diag([*np.square(UNKNOWN), 0.0]),
            "process": _noise(process, LEAST_ENTROPY, own.noise_at()[0]),
            "observation": _noise(observation, None, own.noise_at()[1]),
        }
    return MethodTemplate("learned_ukf", values, refuses_infinite=(*MEASURED, *INPUTS))


def _dynamics(dynamics: nn.Module) -> dict[str, Any]:
    """Physical numbers, curves, and the network's layers, inputs first."""
    physical = physical_of(dynamics)  # type: ignore[arg-type]
    p = dict(zip((*PHYSICAL, *PACEJKA), physical.values.tolist(), strict=True))
    weight = physical.mass * GRAVITY / physical.wheelbase
    front_arm = physical.wheelbase - p["cg_to_rear_axle"]
    values: dict[str, Any] = {
        "p": p,
        "mass": physical.mass,
        "front_arm": front_arm,
        "front_load": weight * p["cg_to_rear_axle"],
        "rear_load": weight * front_arm,
        "curves": [[p[f"{letter}_{where}"] for letter in "BCD"] for where in ("x", "front", "rear")],
    }
    network = getattr(dynamics, "network", None)
    if isinstance(network, Perceptron):
        for number, (matrix, offset) in enumerate(network.layers(), 1):
            values |= {f"W{number}": _numbers(matrix.T), f"b{number}": _numbers(offset)}
    return values


def _noise(noise: nn.Module, least: float | None, at: Any) -> dict[str, Any]:
    """A covariance that is constant, or linear in the state by its factor; see `compiled_noise`."""
    if not isinstance(noise, StateDependentNoise):
        nothing = np.zeros((1, len(STATES)))
        return {"constant": at(nothing, nothing)[0], "weight": None}
    n = noise.constant.n
    unit = noise.unit[torch.tril_indices(n, n)[0]]
    return {
        "constant": _numbers(noise.constant(noise.state_unit, noise.state_unit)),
        "weight": _numbers(noise.weight / noise.state_unit * unit[:, None]),
        "offset": _numbers(noise.offset * unit),
        "scale": noise.scale,
        "least": least,
        "units": n * math.log(2.0 * math.pi * math.e),
        "size": n,
    }


def _numbers(values: Tensor) -> np.ndarray[Any, Any]:
    return values.detach().numpy().astype(np.float64)
