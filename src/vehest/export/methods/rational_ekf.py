"""The extended Kalman filter with tyres that adapt in C."""

from __future__ import annotations

import math

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.estimators.rational_ekf import CURVES, LOST, ROLLING, RationalFilter
from vehest.export.method import MethodTemplate
from vehest.export.methods.kalman import gate_values
from vehest.export.rendering import Precision
from vehest.vehicle.tyre_track import TYRE_PARAMETERS


def rational_ekf(estimator: RationalFilter, precision: Precision) -> MethodTemplate:
    """Its car, curves, levels of noise and gate.

    Raises:
        ConfigurationError: its filter is unscented.
    """
    s = estimator.settings
    if s.filter != "extended":
        raise ConfigurationError("estimator 'rational_ekf' with estimator.filter=unscented has no C; train it with filter=extended")
    adapted = [_adapted(name) for name in s.adapted]
    step = 1.0 / s.rate_hz
    first = estimator.start(np.zeros(len(estimator.channels)))
    values = {
        **gate_values(estimator.gate()),
        "n": 4 + len(adapted),
        "columns": 4 + len(adapted) + max(2, 1 + len(adapted)),
        "linear": s.tyres == "linear",
        "adapted": adapted,
        "wanted": [part for part in ("c1", "friction") if any(part in tyre["slope"] for tyre in adapted)],
        "states": {name: row for row, name in enumerate(s.adapted, 4)},
        "curves": dict(zip(TYRE_PARAMETERS, [*estimator.curves.tolist(), 1.0], strict=True)),
        "car": s.car,
        "step": step,
        "minimum_speed": s.minimum_speed,
        "adapt_above": s.adapt_above,
        "sensors": [estimator.levels["yaw_rate"], estimator.levels["ay"]],
        "steer_spread": math.sqrt(step) * estimator.levels["steer"],
        "tyre_spread": math.sqrt(step) * estimator.levels["tyres"],
        "bounds": estimator.bounds(),
        "rolling": ROLLING,
        "largest_sideslip": s.largest_sideslip,
        "lost": LOST,
        "tyre_root": _root(first.covariance[4:, 4:]),
    }
    return MethodTemplate("rational_ekf", values, ("vx", "steer"), refuses_infinite=estimator.channels)


def _adapted(name: str) -> dict[str, str]:
    """A tyre parameter that is a state: the axle it is of, and the member of the axle's force that is its slope."""
    if name == "friction":
        return {"name": name, "axle": "both", "slope": "per_log_friction"}
    assert name in CURVES
    curve, axle = name.split("_")
    return {"name": name, "axle": axle, "slope": "force" if curve == "c2" else "per_log_c1"}


def _root(covariance: FloatArray) -> FloatArray:
    """Lower triangular L with L Lᵀ = covariance, which need not be definite."""
    values, vectors = np.linalg.eigh(covariance)
    upper = np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T)[1]
    return np.ascontiguousarray(upper.T)
