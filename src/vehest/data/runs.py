"""Runs of samples: where flags hold, where values stay the same, and lines over gaps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray


def true_runs(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """First sample of each run of true flags (T,) and the one after it, (N, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def equal_runs(samples: NDArray[Any]) -> NDArray[np.int64]:
    """First sample of each run of equal values (T,) and the one after it, (N, 2).

    Every sample lies in one, NaN each in its own.
    """
    changes = np.flatnonzero(samples[1:] != samples[:-1]) + 1
    edges = np.concatenate([[0], changes, [len(samples)]])
    return np.stack([edges[:-1], edges[1:]], axis=1)[: len(samples)]


def filled(samples: FloatArray) -> FloatArray:
    """Samples (T,) with straight lines over gaps (NaN); zeros where no sample is finite."""
    is_finite = np.isfinite(samples)
    if is_finite.all():
        return samples
    if not is_finite.any():
        return np.zeros_like(samples)
    at = np.arange(len(samples))
    return np.interp(at, at[is_finite], samples[is_finite])
