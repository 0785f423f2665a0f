"""A single track with a powertrain, in the plane: x = (vx, vy, yaw rate, rim speed), u = (steering
angle, motor current).

    dvx/dt = (F_xr + F_xf cos δ - F_yf sin δ - F_drag)/m + vy r
    dvy/dt = (F_xf sin δ + F_yr + F_yf cos δ)/m - vx r
    dr/dt  = ((F_xf sin δ + F_yf cos δ) lf - F_yr lr)/Iz
    dω/dt  = R/Ie (kφ Iq - R (F_xf + F_xr) - b1 ω - b0 sign ω)

Source: Węgrzynowski et al. 2024, Eq. 2; drag and powertrain as in its authors' code.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from vehest.constants import GRAVITY
from vehest.vehicle.tyres import SLIP_SPEED_OFFSET, PositiveParameters, Slips, TyreForces

F1TENTH: Mapping[str, float] = {
    "mass": 5.1,
    "wheelbase": 0.33,
    "wheel_radius": 0.05,
    "cg_to_rear_axle": 0.115,
    "yaw_inertia": 0.46,
    "drag_constant": 0.1,
    "drag_linear": 0.01,
    "drag_quadratic": 0.1,
    "powertrain_inertia": 0.2,
    "torque_constant": 0.90064745,
    "friction_viscous": 0.304115174,
    "friction_coulomb": 0.50421894,
}
"""A car: fixed parameters, and start values of the learnt ones; as in the public code of
Węgrzynowski et al. 2024, whose paper has 4.5 kg.
"""
# names of the parameters that are not learnt [kg, m, m]
FIXED_PARAMETERS = ("mass", "wheelbase", "wheel_radius")
# names of the learnt parameters
LEARNT = tuple(name for name in F1TENTH if name not in FIXED_PARAMETERS)


class Motion(NamedTuple):
    """Rates and accelerations of a planar car."""

    rates: Tensor  # rates of vx, vy, yaw rate and rim speed, (..., 4)
    # longitudinal acceleration that a sensor at the centre of gravity reads (...) [m/s²]
    ax: Tensor
    ay: Tensor  # lateral acceleration that it reads (...) [m/s²]


class PlanarCar(nn.Module):
    """The car without its tyres.

    Parameters
    ----------
    car : Mapping[str, float], default F1TENTH
        Values by name, as `F1TENTH`.

    Attributes
    ----------
    mass, wheelbase, wheel_radius : float
        [kg], [m], [m]; not learnt.
    learnt : PositiveParameters
        The values of `LEARNT`, in SI units.
    """

    def __init__(self, car: Mapping[str, float] = F1TENTH) -> None:
        super().__init__()
        self.mass, self.wheelbase, self.wheel_radius = (car[name] for name in FIXED_PARAMETERS)
        self.learnt = PositiveParameters(
            {name: value for name, value in car.items() if name not in FIXED_PARAMETERS}
        )

    @property
    def to_front_axle(self) -> Tensor:
        """Distance of the front axle from the centre of gravity [m]."""
        return self.wheelbase - self.learnt["cg_to_rear_axle"]

    def slips(self, state: Tensor, inputs: Tensor) -> Slips:
        """Slip angles and longitudinal slip of the tyres, as in the authors' code.

        α_F = atan((vy + l_F r)/vx) - δ, α_R = atan((vy - l_R r)/vx), κ = (ω - vx)/vx with the rim
        speed ω; `SLIP_SPEED_OFFSET` is added to every vx in a denominator. Slip angles are positive
        where a wheel slides to the left, hence the lateral forces of a tyre have the opposite sign.

        Parameters
        ----------
        state : Tensor
            vx, vy [m/s], yaw rate [rad/s], rim speed [m/s] and whatever follows, (..., 4 or more).
        inputs : Tensor
            Steering angle [rad] first, (..., 2).
        """
        vx, vy, yaw_rate, rim_speed = state[..., :4].unbind(-1)
        vx_safe = vx + SLIP_SPEED_OFFSET
        return Slips(
            torch.atan((vy + self.to_front_axle * yaw_rate) / vx_safe) - inputs[..., 0],
            torch.atan((vy - self.learnt["cg_to_rear_axle"] * yaw_rate) / vx_safe),
            (rim_speed - vx) / vx_safe,
        )

    def loads(self) -> tuple[Tensor, Tensor]:
        """Static load of the front and the rear axle [N]."""
        weight = self.mass * GRAVITY / self.wheelbase
        return weight * self.learnt["cg_to_rear_axle"], weight * self.to_front_axle

    def motion(self, state: Tensor, inputs: Tensor, forces: TyreForces) -> Motion:
        """Rates under given tyre forces (Eq. 2, see the module).

        Parameters
        ----------
        state : Tensor
            vx, vy [m/s], yaw rate [rad/s], rim speed [m/s] and whatever follows, (..., 4 or more).
        inputs : Tensor
            Steering angle [rad] and motor current [A], (..., 2).
        forces : TyreForces
            In the wheels' axes [N].

        Returns
        -------
        Motion
            Rates (..., 4) and accelerations at the centre of gravity. Drag and Coulomb friction
            have no sign at standstill, where they are 0.
        """
        p = self.learnt
        vx, vy, yaw_rate, rim_speed = state[..., :4].unbind(-1)
        steer, current = inputs.unbind(-1)
        sine = torch.sin(steer)
        cosine = torch.cos(steer)
        drag = (
            p["drag_constant"] * torch.sign(vx)
            + p["drag_linear"] * vx
            + p["drag_quadratic"] * vx.square()
        )
        sideways = forces.front_x * sine + forces.front_y * cosine
        ax = (forces.rear_x + forces.front_x * cosine - forces.front_y * sine - drag) / self.mass
        ay = (sideways + forces.rear_y) / self.mass
        turning = (sideways * self.to_front_axle - forces.rear_y * p["cg_to_rear_axle"]) / p[
            "yaw_inertia"
        ]
        resistance = p["friction_viscous"] * rim_speed + p["friction_coulomb"] * torch.sign(
            rim_speed
        )
        torque = (
            p["torque_constant"] * current
            - self.wheel_radius * (forces.front_x + forces.rear_x)
            - resistance
        )
        spinning = self.wheel_radius / p["powertrain_inertia"] * torque
        return Motion(
            torch.stack([ax + vy * yaw_rate, ay - vx * yaw_rate, turning, spinning], -1), ax, ay
        )
