"""The extended Kalman filter of one sequence, compiled with any model."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np

from vehest.constants import FloatArray
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.kalman_scan import contiguous, filtered_by, move, require_samples, scratch, update

Compiled = Callable[..., Any]
"""A function that numba has compiled."""

_STEP = 1e-30
"""Of a complex step: nothing is subtracted, so that it may be as small as it likes."""


class CompiledModel(NamedTuple):
    """A nonlinear model with Gaussian noise: x[k+1] = f(x[k], u[k]) + w[k], y[k] = h(x[k], u[k]) + v[k].

    Attributes:
        transition: compiled, (x (n,), u (p,), parameters) -> f (n,) and its Jacobian (n, n); see `with_jacobian`.
        observation: compiled, likewise -> h (m,) and its Jacobian (m, n).
        parameters: what both are given besides, (K,).
        process_noise: Q, (n, n) or one a sample, (T, n, n), from each sample to the next.
        observation_noise: R, (m, m) or (T, m, m).
    """

    transition: Compiled
    observation: Compiled
    parameters: FloatArray
    process_noise: FloatArray
    observation_noise: FloatArray


def with_jacobian(function: Compiled) -> Compiled:
    """A function that also returns its Jacobian with respect to the state, exact to rounding.

    Args:
        function: (x (n,), u (p,), parameters) -> (m,), compiled or for numba to compile; of complex states too (``np.empty(m, x.dtype)``),
            and analytic in them: no comparison, absolute value or maximum of the state.

    Source: Squire & Trapp, SIAM Review 40 (1), 1998 (complex step).
    """

    compiled = function if hasattr(function, "py_func") else numba.njit(function)

    @numba.njit
    def both(state, inputs, parameters):  # type: ignore[no-untyped-def]
        value = compiled(state, inputs, parameters)
        slope = np.empty((len(value), len(state)))
        moved = np.empty(len(state), np.complex128)
        for j in range(len(state)):
            for i in range(len(state)):
                moved[i] = complex(state[i], _STEP if i == j else 0.0)
            changed = compiled(moved, inputs, parameters)
            for i in range(len(value)):
                slope[i, j] = changed[i].imag / _STEP
        return value, slope

    return both  # type: ignore[no-any-return]


def extended_scan(
    model: CompiledModel, measurements: FloatArray, inputs: FloatArray, initial: Gaussian[FloatArray]
) -> Filtered[FloatArray]:
    """Filter one sequence in float64; what is NaN was not measured and is skipped.

    A model compiles once a process, for some seconds.

    Args:
        model: see `CompiledModel`.
        measurements: y, (T, m).
        inputs: u, (T, p).
        initial: state at the first sample before its measurement, mean (n,).

    Raises:
        ValueError: shapes do not fit each other.
        numpy.linalg.LinAlgError: an innovation covariance is not positive definite.

    Source: Jazwinski 1970, Chapter 8.
    """
    require_samples(measurements)
    if inputs.ndim != 2 or len(inputs) != len(measurements):
        raise ValueError(f"inputs of shape {inputs.shape} do not fit measurements of shape {measurements.shape}")
    (steps, m), n = measurements.shape, len(initial.mean)
    given = (
        contiguous(model.parameters, np.shape(model.parameters), "parameters"),
        contiguous(model.process_noise, (steps, n, n), "process_noise"),
        contiguous(model.observation_noise, (steps, m, m), "observation_noise"),
        contiguous(inputs, inputs.shape, "inputs"),
    )
    return filtered_by(_scan, (model.transition, model.observation, *given), contiguous(measurements, (steps, m), "measurements"), initial)


@numba.njit(error_model="numpy")
def _scan(transition, observation, parameters, Q, R, u, y, start, predicted, filtered, innovation, innovation_cov):  # type: ignore[no-untyped-def]
    """Write states and innovations; returns the sample whose innovation covariance has no Cholesky factor, or -1.

    This much is compiled for each model; the rest is loaded.
    """
    m, n, (prior_mean, prior_cov), (post_mean, post_cov) = y.shape[1], len(start[0]), predicted, filtered
    seen, room = np.empty((m, n)), scratch(m, n)
    for k in range(len(y)):
        prior, post = (prior_mean[k], prior_cov[k]), (post_mean[k], post_cov[k])
        if k == 0:
            prior[0][:], prior[1][:] = start
        else:
            prior[0][:], slope = transition(post_mean[k - 1], u[k - 1], parameters)
            move(slope, post_cov[k - 1], Q[k - 1], prior[1], room)
        expected, slope = observation(prior[0], u[k], parameters)
        for i in range(m):
            known = not math.isnan(y[k, i])
            innovation[k, i] = y[k, i] - expected[i] if known else 0.0
            for j in range(n):
                seen[i, j] = slope[i, j] if known else 0.0
        if not update(prior, post, y[k], R[k], innovation[k], innovation_cov[k], seen, room):
            return k
    return -1
