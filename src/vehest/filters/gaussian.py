"""Data types of all filters: Gaussian states, and the result of filtering a sequence."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", "Tensor", NDArray[np.float64])
"""A tensor where gradients are wanted, a NumPy array in compiled filters."""


class Gaussian(NamedTuple, Generic[Array]):
    """Normal distribution of a state, or of a state at each of several samples."""

    mean: Array  # mean, (..., n)
    covariance: Array  # covariance, (..., n, n), symmetric


class Filtered(NamedTuple, Generic[Array]):
    """Result of a filter over a sequence of T samples."""

    # state at each sample before its measurement; mean (..., T, n); the first is the initial state
    predicted: Gaussian[Array]
    filtered: Gaussian[Array]  # state at each sample after its measurement
    # measurement minus what was expected of it, (..., T, m); 0 where nothing was measured
    innovation: Array
    # covariance S of the innovation, (..., T, m, m); rows and columns of what was not measured are
    # those of the identity, so that eᵀS⁻¹e counts what was measured only
    innovation_covariance: Array
    measured: Tensor | NDArray[np.bool_]  # whether there was a measurement, bool, (..., T, m)
