"""The paper's filters with one more state, the pull of a crossfall b = g sin φ: their outlook names
bank angles.
"""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.rational_ekf import RationalFilter
from vehest.filters.gaussian import Gaussian

DEVIATION = 0.2  # m/s², standard deviation of b at the start: 1.2° of crossfall
WANDER = 0.002  # m/s² √s⁻¹, by which it drifts: 0.1° in a minute


def filtered(
    estimator: RationalFilter,
    samples: FloatArray,
    deviation: float = DEVIATION,
    wander: float = WANDER,
) -> FloatArray:
    """States (β, r, β', r', θ…, b) after each sample, (T, n).

    Parameters
    ----------
    estimator
        Whose car, curves, levels of noise and bounds are taken.
    samples
        Of its channels, (T, 4).
    deviation
        Standard deviation of b at the start [m/s²].
    wander
        Of its drift [m/s² √s⁻¹].
    """
    mean, covariance = estimator.first_gaussian(samples[0], {})
    wider = np.pad(covariance, (0, 1))
    wider[-1, -1] = deviation**2
    return estimator.filter_samples(
        samples, Gaussian(np.append(mean, 0.0), wider), crossfall=wander
    ).mean
