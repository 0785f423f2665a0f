"""Huber's loss: squared errors of bounded influence, for training data with a few large errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vehest.constants import FloatArray


def robust_squares(errors: Tensor, limit: float) -> Tensor:
    """Squared errors up to a limit, and their tangent beyond it, elementwise.

    ρ(e) = e² for |e| ≤ c, else c (2|e| - c); its derivative is bounded by 2c.

    Parameters
    ----------
    errors : Tensor
        e, of any shape and unit.
    limit : float
        c, in the same unit; 0: plain squares.

    Returns
    -------
    Tensor
        ρ(e) in the shape of the errors and the square of their unit; NaN stays NaN.

    Source: Huber, Robust estimation of a location parameter, Annals of Mathematical Statistics 35
    (1), 1964.
    """
    if not limit:
        return errors.square()
    size = errors.abs()
    inner = size.clamp(max=limit)
    return inner * (2.0 * size - inner)


def robust_squares_of_array(errors: FloatArray, limit: float) -> FloatArray:
    """`robust_squares` for a NumPy array, without gradients."""
    if not limit:
        return np.square(errors)
    size = np.abs(errors)
    inner = np.minimum(size, limit)
    return np.asarray(inner * (2.0 * size - inner))


def robust_criterion(
    limit: float,
) -> Callable[[NDArray[Any], NDArray[Any], NDArray[Any]], float]:
    """Mean of `robust_squares` as a `Criterion` of a network with one output.

    Parameters
    ----------
    limit : float
        c, in the units of the network's output.

    Returns
    -------
    Callable
        Function of outputs (N, 1), targets (N,) and a gradient (N, 1), which it writes:
        ∂/∂o_n = 2/N · clip(o_n - t_n, -c, c). It returns the mean over the samples.
    """

    def criterion(outputs: NDArray[Any], targets: NDArray[Any], gradient: NDArray[Any]) -> float:
        errors = outputs[:, 0] - targets
        gradient[:, 0] = 2.0 / len(targets) * np.clip(errors, -limit, limit)
        return float(robust_squares_of_array(errors, limit).mean())

    return criterion
