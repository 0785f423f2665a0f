"""Error of v on other tyres, by the friction that a filter estimates, which widens its band.

A filter corrects v until its tyre model explains a_y. On other tyres v is then wrong, and neither
innovations nor covariance show it. The estimated friction μ does: the further it lies from that of
the training μ₀, the less certain is the slip angle at which the model places a force. The mean
squared error of v

    x = (c u ln(μ/μ₀))²

widens the band: its half width at 90 % is that without the check and 1.645 √x, added in squares.
The estimate stays as it is. Tyres that differ in stiffness alone are not detected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.base import Estimator
from vehest.estimators.kernels.compiling import entry
from vehest.trust.checks import check_number, check_numbers

FRICTION_SLIP = 0.05
"""c, standard deviation of the slip angle's error where the friction is e times as large [rad].

Chosen on simulated tyres (docs/learned_ukf.md, "Bands on other tyres").
"""
GAUSSIAN_90 = 1.6448536269514722  # half width of 90 % of a Gaussian, in standard deviations
# largest weight of the tyre term in the squared scales; larger ones are cut off, or refused in a
# file
MAX_WEIGHT = 1e12


@dataclass(frozen=True)
class TyreCheck:
    """Constants of the check of one model."""

    friction: float  # μ₀, that of the training [1]
    # weights of x in the squared scales of v and β: (1.645/q)², so that after multiplication by
    # the factor q of 90 % the half width is 1.645 √x
    weights: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Raise `DataError` for a friction or weights out of range."""
        check_number("tyre_check.friction", self.friction, 1e-3, 1e2)
        check_numbers("tyre_check.weights", self.weights, 0.0, MAX_WEIGHT)

    def scaled_by(self, factors: Sequence[float]) -> TyreCheck:
        """The check with the weights for bands whose factors of the 90 % level, for v and β, are
        ``factors`` without it.
        """
        vy, sideslip = (
            min((GAUSSIAN_90 / max(factor, 1e-6)) ** 2, MAX_WEIGHT) for factor in factors
        )
        return replace(self, weights=(vy, sideslip))

    def squared_errors(self, vx: FloatArray, friction: FloatArray) -> FloatArray:
        """Mean squared errors x of v [m²/s²] by estimated speeds [m/s] and frictions, (T,) each.

        x = (c u ln(μ/μ₀))²; 0 where the friction is NaN or not positive.
        """
        squared = np.empty(len(vx))
        squared_error_rows(vx, friction, self.friction, squared)
        return squared


def tyre_check_of(estimator: Estimator) -> TyreCheck | None:
    """The check of an estimator that estimates a friction; None of any other."""
    friction = estimator.training_friction
    return None if friction is None else TyreCheck(friction)


@entry(nogil=True)
def squared_error_rows(vx, friction, training_friction, squared):  # type: ignore[no-untyped-def]
    """Write x = (c u ln(μ/μ₀))².

    Parameters
    ----------
    vx, friction : array
        Estimated speed [m/s] and friction μ [1], (T,).
    training_friction : float
        μ₀ [1].
    squared : array
        Output, (T,) [m²/s²]; 0 where there is no estimate.
    """
    for k in range(len(vx)):
        squared[k] = 0.0
        if friction[k] > 0.0:
            error = FRICTION_SLIP * vx[k] * math.log(friction[k] / training_friction)
            if math.isfinite(error):
                squared[k] = error * error
