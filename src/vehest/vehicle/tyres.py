"""Tyre models of a single track: slips to forces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from vehest.vehicle.positive import PositiveParameters

STILL = 1e-6
"""Added to speeds that slips are divided by [m/s]."""


class Slips(NamedTuple):
    """How tyres slide.

    Attributes:
        front: slip angle of the front axle, positive where it slides to the left of where it points (...) [rad].
        rear: of the rear axle.
        ratio: longitudinal slip, positive where wheels drive, the same for both axles (...).
    """

    front: Tensor
    rear: Tensor
    ratio: Tensor


class TyreForces(NamedTuple):
    """Forces of both axles in the axes of their wheels (...) [N]."""

    front_x: Tensor
    front_y: Tensor
    rear_x: Tensor
    rear_y: Tensor


def slips_of(
    vx: Tensor, vy: Tensor, yaw_rate: Tensor, rim_speed: Tensor, steer: Tensor, front: Tensor | float, rear: Tensor | float
) -> Slips:
    """Slips of a single track.

    Args:
        vx, vy: velocity of the centre of gravity [m/s].
        yaw_rate: [rad/s].
        rim_speed: speed of the wheels' rims, as if they rolled [m/s].
        steer: angle of the front wheels [rad].
        front, rear: distances of the axles from the centre of gravity [m].

    Source: Węgrzynowski et al. 2024, and its authors' code.
    """
    along = vx + STILL
    return Slips(
        torch.atan((vy + front * yaw_rate) / along) - steer,
        torch.atan((vy - rear * yaw_rate) / along),
        (rim_speed - vx) / along,
    )


def magic_formula(slip: Tensor, stiffness: Tensor, shape: Tensor, curvature: Tensor | float = 0.0) -> Tensor:
    """Pacejka's curve for a peak of 1: sin(C atan(B s - E (B s - atan(B s)))).

    Args:
        slip: s, an angle [rad] or a ratio.
        stiffness: B [1/rad] or [1].
        shape: C.
        curvature: E; 0 leaves it out.

    Source: Pacejka & Bakker 1992.
    """
    steep = stiffness * slip
    return torch.sin(shape * torch.atan(steep - curvature * (steep - torch.atan(steep))))


class PacejkaTyres(nn.Module):
    """Pacejka's curves of both axles, without combined slip.

    F_x = μ D_x F_z sin(C_x atan(B_x κ …)), the same for both axles; F_y = -μ D_y F_z sin(C_y atan(B_y α …)), an axle each.

    Args:
        start: values to begin with of ``friction``, ``B_x``, ``C_x``, ``D_x``, and ``B``, ``C``, ``D`` with ``_front`` and ``_rear``.
        with_curvature: whether E is learnt too, from 0 on, for all three curves.

    Source: Węgrzynowski et al. 2024, Eq. 3, with the sign of a slip angle that is positive to the left.
    """

    def __init__(self, start: Mapping[str, float], *, with_curvature: bool = False) -> None:
        super().__init__()
        self.parameters_of = PositiveParameters(start)
        self.curvature = nn.Parameter(torch.zeros(3)) if with_curvature else None

    def forward(self, slips: Slips, loads: tuple[Tensor, Tensor], friction: Tensor | None = None) -> TyreForces:
        """Forces of both axles.

        Args:
            slips: see `Slips`.
            loads: on the front and the rear axle [N].
            friction: instead of the learnt one, where it is estimated.
        """
        p = self.parameters_of
        mu = p["friction"] if friction is None else friction
        ex, ef, er = (0.0, 0.0, 0.0) if self.curvature is None else self.curvature
        along = mu * p["D_x"] * magic_formula(slips.ratio, p["B_x"], p["C_x"], ex)
        front = -mu * p["D_front"] * magic_formula(slips.front, p["B_front"], p["C_front"], ef)
        rear = -mu * p["D_rear"] * magic_formula(slips.rear, p["B_rear"], p["C_rear"], er)
        return TyreForces(loads[0] * along, loads[0] * front, loads[1] * along, loads[1] * rear)
