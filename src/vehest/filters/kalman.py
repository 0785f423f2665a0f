"""Linear models with Gaussian noise that vary in time, and the Rauch-Tung-Striebel smoother;
`kalman_scan` filters them.
"""

from __future__ import annotations

from typing import Generic, NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.filters.gaussian import Array, Filtered


class LinearModel(NamedTuple, Generic[Array]):
    """A linear model of T samples with Gaussian noise.

    x[k+1] = A[k] x[k] + b[k] + w[k],  w[k] ~ N(0, Q[k])
    y[k]   = C[k] x[k] + d[k] + v[k],  v[k] ~ N(0, diag(R[k]))

    Known inputs are part of b and d. What is constant over time needs no dimension for it.
    """

    transition: Array  # A, (T, n, n); A[k] leads from sample k to k+1, so the last one is not used
    transition_offset: Array  # b, (T, n)
    process_noise: Array  # Q, (T, n, n)
    observation: Array  # C, (T, m, n)
    observation_offset: Array  # d, (T, m)
    observation_noise: Array  # R, (T, m), variances; measurements err independently of each other


def smoothed_means(model: LinearModel[FloatArray], filtered: Filtered[FloatArray]) -> FloatArray:
    """Mean states given all measurements, earlier and later ones, (T, n).

        x̂_k = x_k + G_k (x̂_{k+1} - x⁻_{k+1}),   G_k = P_k A_kᵀ (P⁻_{k+1})⁻¹,   x̂_{T-1} = x_{T-1}

    with filtered x_k, P_k and predicted x⁻, P⁻. Smoothed covariances are not computed.

    Parameters
    ----------
    model : LinearModel[FloatArray]
        The model that `kalman_scan` received, its transitions with a dimension for time.
    filtered : Filtered[FloatArray]
        What it returned.

    Raises
    ------
    numpy.linalg.LinAlgError
        A predicted covariance is singular.

    Source: Rauch, Tung & Striebel 1965.
    """
    ahead = filtered.predicted
    gains = np.linalg.solve(
        ahead.covariance[1:], model.transition[:-1] @ filtered.filtered.covariance[:-1]
    ).transpose(0, 2, 1)
    means = filtered.filtered.mean.copy()
    for k in range(len(means) - 2, -1, -1):
        means[k] += gains[k] @ (means[k + 1] - ahead.mean[k + 1])
    return means
