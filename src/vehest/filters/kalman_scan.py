"""The Kalman filter of one sequence, compiled."""

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

    Args:
        model: see `LinearModel`.
        measurements: y, (T, m).
        initial: state at the first sample before its measurement, mean (n,).
        gate: which measurements are refused; none: all are taken.
        refused: how often on end each measurement was before the first sample, (m,); after the last one on return. None: never.

    Raises:
        ValueError: shapes do not fit each other.
        numpy.linalg.LinAlgError: an innovation covariance is not positive definite.

    Source: Kalman 1960; Joseph's form of the update (Bucy & Joseph 1968), with which covariances stay symmetric and positive.
    """
    if measurements.ndim != 2 or len(measurements) == 0:
        raise ValueError(f"measurements must be of shape (T, m) with T > 0, not {measurements.shape}")
    (steps, m), n = measurements.shape, model.transition.shape[-1]
    shapes = ((n, n), (n,), (n, n), (m, n), (m,), (m, m))
    parts = [_contiguous(part, (steps, *shape), name) for name, part, shape in zip(LinearModel._fields, model, shapes, strict=True)]
    y = _contiguous(measurements, (steps, m), "measurements").copy()
    start = _contiguous(initial.mean, (n,), "initial.mean"), _contiguous(initial.covariance, (n, n), "initial.covariance")
    limit, patience = (math.inf, 0) if gate is None else (gate.deviations**2, gate.patience)
    predicted, filtered = (Gaussian(np.empty((steps, n)), np.empty((steps, n, n))) for _ in range(2))
    innovation, covariance = np.empty((steps, m)), np.empty((steps, m, m))
    gated = limit, patience, np.zeros(m, np.int64) if refused is None else refused
    failed = _scan(*parts, y, start, tuple(predicted), tuple(filtered), innovation, covariance, *gated)
    if failed >= 0:
        raise np.linalg.LinAlgError(f"the innovation covariance is not positive definite at sample {failed}")
    return Filtered(predicted, filtered, innovation, covariance, ~np.isnan(y))


def _contiguous(values: FloatArray, shape: tuple[int, ...], name: str) -> FloatArray:
    """An array in float64 that is of a shape or broadcasts to it; raises `ValueError`, which names it."""
    if values.shape == shape and values.dtype == np.float64:
        return np.ascontiguousarray(values)
    try:
        return np.ascontiguousarray(np.broadcast_to(np.asarray(values, dtype=np.float64), shape))
    except ValueError:
        raise ValueError(f"{name} of shape {np.shape(values)} does not fit {shape}") from None


@numba.njit(cache=True, error_model="numpy")
def _scan(A, b, Q, C, d, R, y, start, predicted, filtered, innovation, innovation_cov, limit, patience, refused):  # type: ignore[no-untyped-def]
    """Write states and innovations; returns the sample whose innovation covariance has no Cholesky factor, or -1.

    With a finite ``limit`` what the gate refuses becomes NaN in ``y``.
    """
    (steps, m), (mean, cov), (prior_mean, prior_cov), (post_mean, post_cov) = y.shape, start, predicted, filtered
    n = len(mean)
    seen, of_both = np.empty((m, n)), (np.empty((m, n)), np.empty((n, m)), np.empty((n, m)))
    room = of_both, (np.empty((n, n)), np.empty((n, n)), np.empty((n, n))), (np.empty((m, m)), np.empty((m, m)), np.empty(m))
    for k in range(steps):
        if k == 0:
            for i in range(n):  # a slice would double the time to compile
                prior_mean[0, i] = mean[i]
                for j in range(n):
                    prior_cov[0, i, j] = cov[i, j]
        else:
            _move(A[k - 1], post_cov[k - 1], Q[k - 1], prior_cov[k], room)
            for i in range(n):
                total = b[k - 1, i]
                for j in range(n):
                    total += A[k - 1, i, j] * post_mean[k - 1, j]
                prior_mean[k, i] = total
        if limit < math.inf:
            _gate(y[k], C[k], d[k], R[k], prior_mean[k], prior_cov[k], limit, patience, refused)
        for i in range(m):
            known = not math.isnan(y[k, i])
            error = y[k, i] - d[k, i] if known else 0.0
            for j in range(n):
                seen[i, j] = C[k, i, j] if known else 0.0
                error -= seen[i, j] * prior_mean[k, j]
            innovation[k, i] = error
        prior, post = (prior_mean[k], prior_cov[k]), (post_mean[k], post_cov[k])
        if not _update(prior, post, y[k], R[k], innovation[k], innovation_cov[k], seen, room):
            return k
    return -1


@numba.njit(inline="always")
def _move(slope, cov, noise, out, room):  # type: ignore[no-untyped-def]
    """F P Fᵀ + Q into ``out``."""
    left = room[1][0]
    _multiply(slope, cov, left)
    _multiply_transposed(left, slope, out)
    for i in range(len(out)):
        for j in range(len(out)):
            out[i, j] += noise[i, j]
    make_symmetric(out)


@numba.njit(inline="always")
def _update(prior, post, y, R, innovation, S, seen, room):  # type: ignore[no-untyped-def]
    """Write mean and covariance after a measurement, from those before, by Joseph's form, and S; False where S is not definite.

    What is NaN in ``y`` (m,) was not measured: its ``innovation`` and its row of ``seen``, H (m, n), are 0.
    """
    (mean, cov), (post_mean, post_cov), (of_both, of_states, of_measured) = prior, post, room
    (cross, gain, weighted), (kept, left, right), (noise, factor, whitened) = of_both, of_states, of_measured
    m, n, known = len(y), len(mean), True
    for i in range(m):
        known = known and not math.isnan(innovation[i])
        for j in range(m):
            noise[i, j] = R[i, j] if not math.isnan(y[i]) and not math.isnan(y[j]) else (1.0 if i == j else 0.0)
    _multiply(seen, cov, cross)
    _multiply_transposed(cross, seen, S)
    for i in range(m):
        for j in range(m):
            S[i, j] += noise[i, j]
    make_symmetric(S)
    if not (known and _cholesky(S, factor)):
        return False
    for j in range(n):  # gain = (S⁻¹ H P)ᵀ
        for i in range(m):
            whitened[i] = cross[i, j]
        _solve(factor, whitened)
        for i in range(m - 1, -1, -1):
            total = whitened[i]
            for c in range(i + 1, m):
                total -= factor[c, i] * gain[j, c]
            gain[j, i] = total / factor[i, i]
    for i in range(n):
        total = mean[i]
        for c in range(m):
            total += gain[i, c] * innovation[c]
        post_mean[i] = total
        for j in range(n):
            part = 1.0 if i == j else 0.0
            for c in range(m):
                part -= gain[i, c] * seen[c, j]
            kept[i, j] = part
    _multiply(kept, cov, left)
    _multiply_transposed(left, kept, post_cov)
    _multiply(gain, noise, weighted)
    _multiply_transposed(weighted, gain, right)
    for i in range(n):
        for j in range(n):
            post_cov[i, j] += right[i, j]
    make_symmetric(post_cov)
    return True


@numba.njit(inline="always")
def _gate(y, C, d, R, mean, cov, limit, patience, refused):  # type: ignore[no-untyped-def]
    n = len(mean)
    for i in range(len(y)):
        if math.isnan(y[i]):
            continue
        error, variance = y[i] - d[i], R[i, i]
        for j in range(n):
            error -= C[i, j] * mean[j]
            for c in range(n):
                variance += C[i, j] * cov[j, c] * C[i, c]
        if refuses(error, variance, limit, patience, refused, i):
            y[i] = math.nan


@numba.njit(inline="always")
def _multiply(a, b, out):  # type: ignore[no-untyped-def]
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for c in range(a.shape[1]):
                total += a[i, c] * b[c, j]
            out[i, j] = total


@numba.njit(inline="always")
def _multiply_transposed(a, b, out):  # type: ignore[no-untyped-def]
    """A Bᵀ."""
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            total = 0.0
            for c in range(a.shape[1]):
                total += a[i, c] * b[j, c]
            out[i, j] = total


@numba.njit(inline="always")
def make_symmetric(a):  # type: ignore[no-untyped-def]
    """The mean of a matrix and its transpose, in place."""
    for i in range(a.shape[0]):
        for j in range(i):
            a[i, j] = a[j, i] = 0.5 * (a[i, j] + a[j, i])


@numba.njit(inline="always")
def _cholesky(a, lower):  # type: ignore[no-untyped-def]
    """Lower factor of a symmetric matrix; False if it is not positive definite."""
    for i in range(a.shape[0]):
        for j in range(i + 1):
            total = a[i, j]
            for c in range(j):
                total -= lower[i, c] * lower[j, c]
            if i == j:
                if not total > 0.0:
                    return False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    return True


@numba.njit(inline="always")
def _solve(lower, vector):  # type: ignore[no-untyped-def]
    """L⁻¹ times a vector, in place."""
    for i in range(lower.shape[0]):
        total = vector[i]
        for c in range(i):
            total -= lower[i, c] * vector[c]
        vector[i] = total / lower[i, i]
