"""Values that the C template of the extended filter on rational tyres is filled with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.filtering.rational_model import (
    MAX_SIDESLIP_DEVIATION,
    ROLLING,
    RationalModel,
)
from vehest.vehicle.tyre_track import TYRE_PARAMETERS


def rational_c_values(
    model: RationalModel, levels: Mapping[str, float], *, is_linear: bool
) -> dict[str, Any]:
    """Values of a model and its noise levels, by their names in the template.

    Parameters
    ----------
    model : RationalModel
        At the curves that the filter starts with.
    levels : mapping
        Noise levels by name, `LEVELS`.
    is_linear : bool
        Whether tyres are linear, so that the template has no bend.
    """
    adapted = [_tyre_state(name) for name in model.adapted]
    n = 4 + len(adapted)
    return {
        "n": n,
        "columns": n + max(2, 1 + len(adapted)),
        "linear": is_linear,
        "adapted": adapted,
        "wanted": [
            slope
            for slope in ("c1", "friction")
            if any(slope in state["slope"] for state in adapted)
        ],
        "states": {name: row for row, name in enumerate(model.adapted, 4)},
        "curves": dict(zip(TYRE_PARAMETERS, model.nominal.tolist(), strict=True)),
        "car": model.car,
        "step": model.step,
        "minimum_speed": model.minimum_speed,
        "adapt_above": model.adapt_above,
        "sensors": [levels["yaw_rate"], levels["ay"]],
        "steer_spread": math.sqrt(model.step) * levels["steer"],
        "tyre_spread": math.sqrt(model.step) * levels["tyres"],
        "bounds": model.bounds,
        "rolling": ROLLING,
        "largest_sideslip": model.largest_sideslip,
        "lost": MAX_SIDESLIP_DEVIATION,
        "tyre_root": _square_root(model.start_tyre_covariance),
    }


def _tyre_state(name: str) -> dict[str, str]:
    """Template values of a tyre parameter that is a state: its name, its axle, and the field of the
    axle's force that has the derivative by it.
    """
    if name == "friction":
        return {"name": name, "axle": "both", "slope": "per_log_friction"}
    parameter, axle = name.split("_")
    return {"name": name, "axle": axle, "slope": "force" if parameter == "c2" else "per_log_c1"}


def _square_root(covariance: FloatArray) -> FloatArray:
    """Lower triangular L with L Lᵀ = covariance, which need not be definite.

    By eigenvalues, of which negative ones count as 0, and a QR decomposition.
    """
    eigenvalues, vectors = np.linalg.eigh(covariance)
    upper = np.linalg.qr((vectors * np.sqrt(np.maximum(eigenvalues, 0.0))).T)[1]
    return np.ascontiguousarray(upper.T)
