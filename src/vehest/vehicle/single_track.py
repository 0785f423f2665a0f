"""The linear single track: sideslip and yaw rate of a car with tyres in their linear range.

State (β, r): sideslip angle [rad] and yaw rate [rad/s]; input δ: road-wheel angle [rad]. Forward speed u is known at every time.

    dβ/dt = -(Cf + Cr)/(m u) β - (1 + (lf Cf - lr Cr)/(m u²)) r + Cf/(m u) δ
    dr/dt = -(lf Cf - lr Cr)/J β - (lf² Cf + lr² Cr)/(J u) r + lf Cf/J δ
    a_y   = -(Cf + Cr)/m β - (lf Cf - lr Cr)/(m u) r + Cf/m δ

Small angles, no load transfer, no banking. Source: Riekert & Schunck 1940, in the form of Leanza, Reina & Blanco-Claraco 2021.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.vehicle.parameters import SingleTrackParameters


class LateralDynamics(NamedTuple):
    """dx/dt = A x + B δ, or x⁺ = A x + B δ where it was discretised.

    Attributes:
        A: (..., 2, 2).
        B: (..., 2).
    """

    A: Tensor
    B: Tensor


class LateralAcceleration(NamedTuple):
    """a_y = C x + D δ [m/s²].

    Attributes:
        C: (..., 2).
        D: (...).
    """

    C: Tensor
    D: Tensor


def lateral_dynamics(car: SingleTrackParameters, vx: Tensor | NDArray[np.float64]) -> LateralDynamics:
    """The differential equation of (β, r).

    Args:
        car: its parameters; tensors must broadcast against vx.
        vx: forward speed u, positive (...) [m/s].
    """
    u = torch.as_tensor(vx)
    front, rear, lf, lr = car.cornering_stiffness_front, car.cornering_stiffness_rear, car.cg_to_front_axle, car.cg_to_rear_axle
    moment = lf * front - lr * rear
    same = torch.zeros_like(u)  # for entries that do not depend on the speed
    A = [
        -(front + rear) / (car.mass * u),
        -(1.0 + moment / (car.mass * u * u)),
        same - moment / car.yaw_inertia,
        -(lf * lf * front + lr * lr * rear) / (car.yaw_inertia * u),
    ]
    B = [front / (car.mass * u), same + lf * front / car.yaw_inertia]
    return LateralDynamics(torch.stack(A, -1).unflatten(-1, (2, 2)), torch.stack(B, -1))


def lateral_acceleration(car: SingleTrackParameters, vx: Tensor | NDArray[np.float64]) -> LateralAcceleration:
    """What an accelerometer at the centre of gravity reads.

    Args:
        car: its parameters; tensors must broadcast against vx.
        vx: forward speed u, positive (...) [m/s].
    """
    u = torch.as_tensor(vx)
    front, rear = car.cornering_stiffness_front, car.cornering_stiffness_rear
    same = torch.zeros_like(u)
    moment = car.cg_to_front_axle * front - car.cg_to_rear_axle * rear
    return LateralAcceleration(torch.stack([same - (front + rear) / car.mass, -moment / (car.mass * u)], -1), same + front / car.mass)


def forward_euler(dynamics: LateralDynamics, step: float) -> LateralDynamics:
    """The same in steps: x⁺ = (I + τA) x + τB δ.

    Args:
        dynamics: continuous.
        step: sampling time τ [s]; stable while τ(Cf + Cr)/(m u) and τ(lf² Cf + lr² Cr)/(J u) stay below about 2.
    """
    identity = torch.eye(2, dtype=dynamics.A.dtype, device=dynamics.A.device)
    return LateralDynamics(identity + step * dynamics.A, step * dynamics.B)
