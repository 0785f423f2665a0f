"""CommonRoad's multi-body equations and a fixed-step Runge-Kutta method, compiled.

The library's functions are compiled as they are: each is bound again to compiled versions of the functions it calls,
and nothing of them is written here a second time. One evaluation then takes 1.6 µs instead of 16 µs in the interpreter.
"""

from __future__ import annotations

import importlib.metadata
import types
from collections.abc import Callable, Mapping
from typing import Any

import numba
import numpy as np
from vehiclemodels.utils import tire_model
from vehiclemodels.utils.acceleration_constraints import acceleration_constraints
from vehiclemodels.utils.steering_constraints import steering_constraints
from vehiclemodels.utils.vehicle_dynamics_ks_cog import vehicle_dynamics_ks_cog
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

LIBRARY = "commonroad-vehicle-models"
LIBRARY_VERSION = importlib.metadata.version(LIBRARY)


def _compile(function: Callable[..., Any]) -> Any:
    # As in NumPy, a division by zero gives an infinite value, which the plant reports with the time it happened at.
    return numba.njit(error_model="numpy")(function)


def _compile_bound(function: Callable[..., Any], names: Mapping[str, Any]) -> Any:
    """Compile a library function with some of the global names it uses bound to compiled objects."""
    bindings = {**function.__globals__, **names}  # type: ignore[attr-defined]
    return _compile(types.FunctionType(function.__code__, bindings, function.__name__))  # type: ignore[attr-defined]


def _compile_tyre_model() -> types.ModuleType:
    compiled = types.ModuleType("compiled_tyre_model")
    sign = _compile(tire_model.sign)
    for name in (
        "formula_longitudinal",
        "formula_lateral",
        "formula_longitudinal_comb",
        "formula_lateral_comb",
    ):
        setattr(compiled, name, _compile_bound(getattr(tire_model, name), {"sign": sign}))
    return compiled


def _compile_multi_body() -> Any:
    constraints = {
        "steering_constraints": _compile(steering_constraints),
        "acceleration_constraints": _compile(acceleration_constraints),
    }
    standstill = _compile_bound(vehicle_dynamics_ks_cog, constraints)
    names = {**constraints, "vehicle_dynamics_ks_cog": standstill, "tireModel": _compile_tyre_model()}
    return _compile_bound(vehicle_dynamics_mb, names)


_multi_body = _compile_multi_body()


def _derivative(state, inputs, parameters):  # type: ignore[no-untyped-def]
    return np.array(_multi_body(state.copy(), inputs, parameters))


def _advance(state, inputs, parameters, step, n_steps):  # type: ignore[no-untyped-def]
    size = state.size
    x = state.copy()
    stage = np.empty(size)
    for _ in range(n_steps):
        # The library sets a negative wheel speed to zero in the state it is given; that must reach x itself.
        k1 = _multi_body(x, inputs, parameters)
        for i in range(size):
            stage[i] = x[i] + 0.5 * step * k1[i]
        k2 = _multi_body(stage, inputs, parameters)
        for i in range(size):
            stage[i] = x[i] + 0.5 * step * k2[i]
        k3 = _multi_body(stage, inputs, parameters)
        for i in range(size):
            stage[i] = x[i] + step * k3[i]
        k4 = _multi_body(stage, inputs, parameters)
        for i in range(size):
            x[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
    return x


def _compile_kept(function: Callable[..., Any]) -> Any:
    """Compile a function of this module and keep the machine code on disk, where a writable place is found."""
    # numba looks code up by the name and file of the outermost function; the library's version is neither.
    function.__qualname__ = f"{function.__name__}_{LIBRARY_VERSION}"
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:
        return _compile(function)


derivative = _compile_kept(_derivative)
"""derivative(state (29,), inputs (2,), parameters) -> (29,): right-hand side of the multi-body equations."""

advance = _compile_kept(_advance)
"""advance(state (29,), inputs (2,), parameters, step, n_steps) -> (29,): classical fourth-order Runge-Kutta steps."""
