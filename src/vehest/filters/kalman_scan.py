"""The Kalman filter of one sequence, compiled.

    x⁻ = A x + b,  P⁻ = A P Aᵀ + Q                                   prediction
    e = y - C x⁻ - d,  S = C P⁻ Cᵀ + R,  K = P⁻ Cᵀ S⁻¹              for each measurement in turn
    x = x⁻ + K e,  P = (I - K C) P⁻ (I - K C)ᵀ + K R Kᵀ              Joseph's form

Flow: `LinearModel` and measurements (T, m) -> `kalman_scan` -> `Filtered`. Sums run over states in
the order of their index.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.filters.gating import Gate, refuses
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.kalman import LinearModel


def kalman_scan(
    model: LinearModel[FloatArray],
    measurements: FloatArray,
    initial: Gaussian[FloatArray],
    gate: Gate | None = None,
    refused: NDArray[np.int64] | None = None,
) -> Filtered[FloatArray]:
    """Filter one sequence in float64; what is NaN was not measured and is skipped.

    States and innovations are NaN from the sample on at which the filter breaks down: an innovation
    whose variance is not positive, or a state that is not a number.

    Parameters
    ----------
    model : LinearModel[FloatArray]
        See `LinearModel`.
    measurements : FloatArray
        y, (T, m).
    initial : Gaussian[FloatArray]
        State at the first sample before its measurement, mean (n,).
    gate : Gate | None, default None
        Which measurements are refused; none: all are taken.
    refused : NDArray[np.int64] | None, default None
        How often in a row each measurement was refused before the first sample, (m,); after the
        last one on return. None: never.

    Raises
    ------
    ValueError
        Shapes do not fit each other.

    Source: Kalman 1960; Joseph's form of the update (Bucy & Joseph 1968), with which covariances
    stay symmetric and positive, a measurement after the other (Bierman 1977).
    """
    if measurements.ndim != 2 or len(measurements) == 0:
        raise ValueError(
            f"measurements must be of shape (T, m) with T > 0, not {measurements.shape}"
        )
    (steps, m) = measurements.shape
    n = model.transition.shape[-1]
    shapes = {
        "transition": (n, n),
        "transition_offset": (n,),
        "process_noise": (n, n),
        "observation": (m, n),
        "observation_offset": (m,),
        "observation_noise": (m,),
    }
    parts = [
        _contiguous(getattr(model, name), (steps, *shape), name) for name, shape in shapes.items()
    ]
    y = _contiguous(measurements, (steps, m), "measurements").copy()
    start = (
        _contiguous(initial.mean, (n,), "initial.mean"),
        _contiguous(initial.covariance, (n, n), "initial.covariance"),
    )
    limit, patience = (math.inf, 0) if gate is None else (gate.deviations**2, gate.patience)
    predicted, filtered = (
        Gaussian(np.empty((steps, n)), np.empty((steps, n, n))) for _ in range(2)
    )
    innovation = np.empty((steps, m))
    covariance = np.empty((steps, m, m))
    gated = limit, patience, np.zeros(m, np.int64) if refused is None else refused
    failed = _scan(
        *parts, y, start, tuple(predicted), tuple(filtered), innovation, covariance, *gated
    )
    if failed >= 0:
        for part in (*predicted, *filtered, innovation, covariance):
            part[failed:] = math.nan
    return Filtered(predicted, filtered, innovation, covariance, ~np.isnan(y))


def _contiguous(values: FloatArray, shape: tuple[int, ...], name: str) -> FloatArray:
    """Array in float64 of a shape, from one that is of it or broadcasts to it. It can be written:
    for one that cannot, the loop would be compiled once more.

    Raises
    ------
    ValueError
        The shape does not broadcast; the message names the array.
    """
    if np.shape(values) != shape:
        try:
            values = np.broadcast_to(values, shape)
        except ValueError:
            raise ValueError(f"{name} of shape {np.shape(values)} does not fit {shape}") from None
    return np.require(values, np.float64, ("C", "W"))


@numba.njit(cache=True, error_model="numpy")
def _scan(  # type: ignore[no-untyped-def]
    A,
    b,
    Q,
    C,
    d,
    R,
    y,
    start,
    predicted,
    filtered,
    innovation,
    innovation_cov,
    limit,
    patience,
    refused,
):
    """Run the filter (see the module) and write states and innovations.

    For each sample k: prediction from k - 1 (x⁻, P⁻); innovations and S of all measurements
    together, for the caller; then one scalar update for each measurement, from the last to the
    first, each with the state that the one before it left:

        e = y_c - d_c - C_c x,  s = C_c P C_cᵀ + R_c,  g = P C_cᵀ/s
        x += g e,  P = (I - g C_c) P (I - g C_c)ᵀ + R_c g gᵀ

    Parameters
    ----------
    A, b, Q, C, d, R : array
        See `LinearModel`, each with a dimension for time.
    y : array
        (T, m); with a finite ``limit`` what the gate refuses becomes NaN in it.
    start : tuple
        Mean (n,) and covariance (n, n) at the first sample before its measurement.
    predicted, filtered : tuple
        Mean (T, n) and covariance (T, n, n), which are written.
    innovation, innovation_cov : array
        (T, m) and (T, m, m), which are written.
    limit, patience, refused
        See `refuses`; an infinite limit is no gate.

    Returns
    -------
    int
        Sample at which the variance of an innovation is not positive or a state is not a number,
        from which on nothing is written; -1 where there is none.
    """
    (prior_mean, prior_cov) = predicted
    (post_mean, post_cov) = filtered
    (steps, m) = y.shape
    n = A.shape[1]
    is_measured = np.empty(m, np.bool_)
    of_states = np.empty((m, n))
    product = np.empty((n, n))
    gain = np.empty(n)
    for k in range(steps):
        x = prior_mean[k]
        P = prior_cov[k]
        S = innovation_cov[k]
        for i in range(n):
            total = start[0][i] if k == 0 else b[k - 1, i]
            for j in range(n):
                if k > 0:
                    total += A[k - 1, i, j] * post_mean[k - 1, j]
                    product[i, j] = _row_times(A[k - 1], i, post_cov[k - 1], j)
            x[i] = total
            if math.isnan(total):
                return k
        for i in range(n):
            for j in range(n):
                P[i, j] = (
                    start[1][i, j]
                    if k == 0
                    else Q[k - 1, i, j] + _row_times(product, i, A[k - 1], j)
                )
        if k > 0:
            make_symmetric(P)
        for i in range(m):  # innovations given the samples before, all measurements together
            error = y[k, i] - d[k, i]
            variance = R[k, i]
            for j in range(n):
                of_states[i, j] = _row_times(C[k], i, P, j)
                error -= C[k, i, j] * x[j]
                variance += of_states[i, j] * C[k, i, j]
            is_measured[i] = not math.isnan(y[k, i])
            if (
                limit < math.inf
                and is_measured[i]
                and refuses(error, variance, limit, patience, refused, i)
            ):
                y[k, i] = math.nan
                is_measured[i] = False
            innovation[k, i], S[i, i] = (error, variance) if is_measured[i] else (0.0, 1.0)
            for j in range(i):
                S[i, j] = S[j, i] = (
                    _row_times(of_states, i, C[k], j) if is_measured[i] and is_measured[j] else 0.0
                )
        mean = post_mean[k]
        cov = post_cov[k]
        for i in range(n):
            mean[i] = x[i]
            for j in range(n):
                cov[i, j] = P[i, j]
        # One measurement after the other, since their noise is independent. The yaw rate before ay
        # keeps more digits.
        for c in range(m - 1, -1, -1):
            if not is_measured[c]:
                continue
            error = y[k, c] - d[k, c]
            variance = R[k, c]
            for i in range(n):
                gain[i] = _row_times(C[k], c, cov, i)
                error -= C[k, c, i] * mean[i]
                variance += C[k, c, i] * gain[i]
            if math.isnan(error) or not variance > 0.0:
                return k
            for i in range(n):
                for j in range(n):
                    product[i, j] = cov[i, j] - gain[i] * gain[j] / variance
            for i in range(n):
                gain[i] /= variance
                mean[i] += gain[i] * error
            for i in range(n):
                cross_covariance = _row_times(product, i, C[k], c)
                for j in range(n):
                    cov[i, j] = product[i, j] + (R[k, c] * gain[i] - cross_covariance) * gain[j]
            make_symmetric(cov)
    return -1


@numba.njit
def _row_times(a, i, b, j):  # type: ignore[no-untyped-def]
    """Row i of A times row j of B: an element of A Bᵀ, or of A B where B is symmetric."""
    total = 0.0
    for c in range(a.shape[1]):
        total += a[i, c] * b[j, c]
    return total


@numba.njit(inline="always")
def make_symmetric(a):  # type: ignore[no-untyped-def]
    """Replace a matrix by the mean of itself and its transpose, in place."""
    for i in range(a.shape[0]):
        for j in range(i):
            a[i, j] = a[j, i] = 0.5 * (a[i, j] + a[j, i])
