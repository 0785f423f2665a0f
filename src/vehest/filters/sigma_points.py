"""Rules by which an unscented filter represents a normal distribution by a few points."""

from __future__ import annotations

import math
from typing import NamedTuple


class SigmaRule(NamedTuple):
    """Symmetric points: the mean, and mean ± spread · columns of the Cholesky factor of P."""

    spread: float  # distance in columns of the factor, positive
    centre_mean: float  # weight of the mean point in means
    centre_covariance: float  # weight of the centre in covariances
    outer_weight: float  # weight of each of the 2n other points, in both


def symmetric_rule(n: int, kappa: float) -> SigmaRule:
    """The rule of Julier & Uhlmann 1997; n + κ = 3 meets the fourth moments of a normal
    distribution.

    n + κ is positive. With κ < 0 the mean has a negative weight, and covariances may lose their
    definiteness; κ = 0 is the cubature rule of Arasaratnam & Haykin 2009, with no point at the
    mean.

    Parameters
    ----------
    n : int
        Number of states.
    kappa : float
        κ, above -n.

    Returns
    -------
    SigmaRule
        Spread √(n + κ), κ/(n + κ) for the mean point and 1/(2(n + κ)) for each other one. All
        weights together are 1.
    """
    total = n + kappa
    return SigmaRule(math.sqrt(total), kappa / total, kappa / total, 0.5 / total)
