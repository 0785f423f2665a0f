"""The extended Kalman filter of one sequence, compiled with any model."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np

from vehest.constants import FloatArray
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.kalman_scan import _contiguous, move, scratch, update

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
    if measurements.ndim != 2 or len(measurements) == 0:
        raise ValueError(f"measurements must be of shape (T, m) with T > 0, not {measurements.shape}")
    if inputs.ndim != 2 or len(inputs) != len(measurements):
        raise ValueError(f"inputs of shape {inputs.shape} do not fit measurements of shape {measurements.shape}")
    (steps, m), n = measurements.shape, len(initial.mean)
    predicted = Gaussian(np.empty((steps, n)), np.empty((steps, n, n)))
    filtered = Gaussian(np.empty((steps, n)), np.empty((steps, n, n)))
    innovation, covariance, likelihood = np.empty((steps, m)), np.empty((steps, m, m)), np.empty(steps)
    failed = _scan(
        model.transition,
        model.observation,
        _contiguous(model.parameters, np.shape(model.parameters), "parameters"),
        _contiguous(model.process_noise, (steps, n, n), "process_noise"),
        _contiguous(model.observation_noise, (steps, m, m), "observation_noise"),
        _contiguous(measurements, (steps, m), "measurements"),
        _contiguous(inputs, inputs.shape, "inputs"),
        _contiguous(initial.mean, (n,), "initial.mean"),
        _contiguous(initial.covariance, (n, n), "initial.covariance"),
        predicted,
        filtered,
        innovation,
        covariance,
        likelihood,
    )
    if failed >= 0:
        raise np.linalg.LinAlgError(f"the innovation covariance is not positive definite at sample {failed}")
    return Filtered(predicted, filtered, innovation, covariance, ~np.isnan(measurements), likelihood)


@numba.njit(error_model="numpy")
def _scan(  # type: ignore[no-untyped-def]
    transition, observation, parameters, Q, R, y, u, mean, cov, predicted, filtered, innovation, innovation_cov, likelihood
):
    """Write states, innovations and likelihoods; returns the sample whose innovation covariance has no Cholesky factor, or -1.

    This much is compiled for each model; the rest is loaded.
    """
    m, n = y.shape[1], len(mean)
    seen, room = np.empty((m, n)), scratch(m, n)
    for k in range(len(y)):
        prior, post = (predicted.mean[k], predicted.covariance[k]), (filtered.mean[k], filtered.covariance[k])
        if k == 0:
            prior[0][:], prior[1][:] = mean, cov
        else:
            prior[0][:], slope = transition(filtered.mean[k - 1], u[k - 1], parameters)
            move(slope, filtered.covariance[k - 1], Q[k - 1], prior[1], room)
        expected, slope = observation(prior[0], u[k], parameters)
        for i in range(m):
            known = not math.isnan(y[k, i])
            innovation[k, i] = y[k, i] - expected[i] if known else 0.0
            for j in range(n):
                seen[i, j] = slope[i, j] if known else 0.0
        likelihood[k] = update(prior, post, y[k], R[k], innovation[k], innovation_cov[k], seen, room)
        if math.isnan(likelihood[k]):
            return k
    return -1
