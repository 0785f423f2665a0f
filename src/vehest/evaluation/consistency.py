"""Whether a filter knows how wrong it is: errors and innovations measured by the covariances that it gives them."""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray

COVERAGE = {1: 0.6827, 2: 0.9545}  # number of standard deviations -> fraction of Gaussian errors within them


def normalised_error_squared(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised estimation error squared of each sample over its dimension, eᵀP⁻¹e / n.

    Its mean is 1 for a consistent filter, above 1 for one that is too sure of itself. Infinite where P is not positive definite.

    Args:
        errors: estimate - reference, shape (K, n).
        covariance: shape (K, n, n).

    Returns:
        Shape (K,).

    Source: Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, Section 5.4.2.
    """
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    proper = np.all(variances > 0, axis=1)
    deviations = np.sqrt(np.where(proper[:, None], variances, 1.0))
    correlation = covariance / (deviations[:, :, None] * deviations[:, None, :])
    eigenvalues, vectors = np.linalg.eigh(np.where(proper[:, None, None], correlation, np.eye(errors.shape[1])))
    definite = proper & np.all(eigenvalues > 0, axis=1)
    whitened = np.einsum("kij,ki->kj", vectors, errors / deviations)
    squared = np.sum(np.square(whitened) / np.where(definite[:, None], eigenvalues, 1.0), axis=1)
    return np.where(definite, squared / errors.shape[1], np.inf)


def normalised_innovation_squared(nis: FloatArray, dof: FloatArray) -> float:
    """Mean of a filter's normalised innovation squared over the numbers that were measured; 1 for a consistent filter.

    Args:
        nis: eᵀS⁻¹e of each update, shape (K,).
        dof: numbers measured at each, shape (K,); samples with none do not count.

    Returns:
        NaN if nothing was measured at any sample.

    Source: Bar-Shalom, Li & Kirubarajan 2001, Section 5.4.2.
    """
    measured = dof > 0
    return float(np.mean(nis[measured] / dof[measured])) if measured.any() else float("nan")


def coverage(errors: FloatArray, variance: FloatArray, n_sigma: float) -> float:
    """Fraction of errors, (K,) like ``variance``, within ``n_sigma`` standard deviations; `COVERAGE` says what is expected of Gaussians."""
    return float(np.mean(np.square(errors) <= n_sigma**2 * variance))
