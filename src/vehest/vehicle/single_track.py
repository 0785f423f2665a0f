"""The linear single track: sideslip and yaw rate of a car with tyres in their linear range.

State (β, r): sideslip angle [rad] and yaw rate [rad/s]; input δ: road-wheel angle [rad]. Forward
speed u is known at every time.

    dβ/dt = -(Cf + Cr)/(m u) β - (1 + (lf Cf - lr Cr)/(m u²)) r + Cf/(m u) δ
    dr/dt = -(lf Cf - lr Cr)/J β - (lf² Cf + lr² Cr)/(J u) r + lf Cf/J δ
    a_y   = -(Cf + Cr)/m β - (lf Cf - lr Cr)/(m u) r + Cf/m δ

Small angles, no load transfer, no banking. Source: Riekert & Schunck 1940, in the form of Leanza,
Reina & Blanco-Claraco 2021.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.vehicle.parameters import SingleTrackParameters


class LateralModel(NamedTuple):
    """dx/dt = A x + B δ, or x⁺ = A x + B δ in steps, and a_y = C x + D δ [m/s²]."""

    A: FloatArray  # state matrix, (..., 2, 2)
    B: FloatArray  # input vector, (..., 2)
    C: FloatArray  # output vector of a_y, (..., 2)
    D: FloatArray  # feedthrough of δ to a_y, (...)

    def in_steps(self, step: float) -> LateralModel:
        """Discretise by forward Euler, x⁺ = (I + τA) x + τB δ; C and D stay.

        It is stable while τ(Cf + Cr)/(m u) and τ(lf² Cf + lr² Cr)/(J u) stay below about 2.

        Parameters
        ----------
        step : float
            τ [s].
        """
        return self._replace(A=np.eye(2) + step * self.A, B=step * self.B)


def lateral_model(car: SingleTrackParameters, vx: FloatArray) -> LateralModel:
    """Continuous model at forward speeds.

    Parameters
    ----------
    car : SingleTrackParameters
        Masses, lengths and cornering stiffnesses of whole axles.
    vx : FloatArray
        Forward speed u, positive, of any shape (...) [m/s]; at 0 the model has infinite entries.

    Returns
    -------
    LateralModel
        Matrices with the leading dimensions (...), for the state (β [rad], r [rad/s]) and the input
        δ [rad].
    """
    u = np.asarray(vx, np.float64)
    front = car.cornering_stiffness_front
    rear = car.cornering_stiffness_rear
    lf = car.cg_to_front_axle
    lr = car.cg_to_rear_axle
    moment = lf * front - lr * rear
    ones = np.ones_like(u)
    per_momentum = 1.0 / (car.mass * u)
    A = [
        -(front + rear) * per_momentum,
        -(1.0 + moment * (1.0 / (car.mass * u * u))),
        -moment / car.yaw_inertia * ones,
        -(lf * lf * front + lr * lr * rear) * (1.0 / (car.yaw_inertia * u)),
    ]
    B = [front * per_momentum, lf * front / car.yaw_inertia * ones]
    C = [-(front + rear) / car.mass * ones, -moment * per_momentum]
    return LateralModel(
        np.stack(A, -1).reshape(*u.shape, 2, 2),
        np.stack(B, -1),
        np.stack(C, -1),
        front / car.mass * ones,
    )
