"""Values by block and seed of two candidates, combined so that their mean over blocks is what a
claim states.
"""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray


def paired_seeds(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values of two candidates seed by seed, (S, B) and (S', B), in the order of their seeds.

    A candidate with a single seed goes with all seeds of the other; of more seeds than the other
    has the last are left out.
    """
    if len(first) > 1 and len(second) > 1:
        count = min(len(first), len(second))
        return first[:count], second[:count]
    count = max(len(first), len(second))
    shape = (count, first.shape[1])
    return np.broadcast_to(first, shape), np.broadcast_to(second, shape)


def linearised_ratio(first: FloatArray, second: FloatArray) -> FloatArray:
    """Contributions of seeds and blocks to the ratio of two means, (S, B).

    r + (a_sb - r b_sb) / mean b with r = mean a / mean b: their mean is r, and the variance of that
    mean is that of a ratio to first order (Cochran, Sampling techniques, 1977, section 6.4).

    Parameters
    ----------
    first, second
        Values by seed and block, (S, B) and (S', B); see `paired_seeds`.
    """
    a, b = paired_seeds(first, second)
    ratio = a.mean() / b.mean()
    return np.asarray(ratio + (a - ratio * b) / b.mean())
