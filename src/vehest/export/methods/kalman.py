"""The Kalman filter of the linear single track in C."""

from __future__ import annotations

import math
from typing import Any

from vehest.estimators.kalman import KalmanFilter
from vehest.export.method import MethodTemplate
from vehest.export.rendering import Precision
from vehest.filters.gating import Gate


def kalman(estimator: KalmanFilter, precision: Precision) -> MethodTemplate:
    """Its car, levels of noise, offsets and gate."""
    s = estimator.settings
    car, levels = s.car, estimator.levels
    kept = math.exp(-1.0 / (s.offsets.seconds * s.rate_hz))
    offsets = [
        {"name": name, "row": row, "initial": getattr(s.offsets, name), "wander": getattr(s.offsets, name) * math.sqrt(1.0 - kept**2)}
        for row, name in enumerate(s.offsets.given, 2)
    ]
    values = {
        **gate_values(Gate.of(s.gate, s.rate_hz)),
        "n": 2 + len(offsets),
        "columns": 4 + len(offsets) + (len(offsets) > 1),
        "offsets": offsets,
        "kept": kept,
        "car": car,
        "step": 1.0 / s.rate_hz,
        "sum": car.cornering_stiffness_front + car.cornering_stiffness_rear,
        "moment": car.cg_to_front_axle * car.cornering_stiffness_front - car.cg_to_rear_axle * car.cornering_stiffness_rear,
        "damping": car.cg_to_front_axle**2 * car.cornering_stiffness_front + car.cg_to_rear_axle**2 * car.cornering_stiffness_rear,
        "minimum_speed": s.minimum_speed,
        "steer_level": levels["steer"] * s.noise.steer_factor,
        "sensors": [levels["ay"], levels["yaw_rate"]],
        "initial": s.initial_deviation,
    }
    return MethodTemplate("kalman", values, ("vx", "steer"), refuses_infinite=estimator.channels)


def gate_values(gate: Gate | None) -> dict[str, Any]:
    """What templates need of a gate; patience is 0 without one."""
    return {"limit": 0.0 if gate is None else gate.deviations**2, "patience": 0 if gate is None else gate.patience}
