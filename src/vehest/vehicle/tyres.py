"""Tyre models of a single track: slips to forces."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

SLIP_SPEED_OFFSET = 1e-6  # added to speeds that slips are divided by [m/s]


class Slips(NamedTuple):
    """Slip angles and longitudinal slip of the tyres."""

    # slip angle of the front axle [rad], (...), positive where it slides to the left of where it
    # points
    front: Tensor
    rear: Tensor  # slip angle of the rear axle, likewise
    ratio: Tensor  # longitudinal slip, positive where wheels drive, the same for both axles (...)


class TyreForces(NamedTuple):
    """Forces of both axles in the axes of their wheels (...) [N]."""

    front_x: Tensor  # longitudinal force of the front axle
    front_y: Tensor  # lateral force of the front axle
    rear_x: Tensor  # longitudinal force of the rear axle
    rear_y: Tensor  # lateral force of the rear axle


class PositiveParameters(nn.Module):
    """Named positive numbers, learnt from values as their logarithms.

    Parameters
    ----------
    values : Mapping[str, float]
        Start values by name, positive; each becomes the parameter ``log_NAME``, a scalar.

    Source: Węgrzynowski et al. 2024, Section III-B.4.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        super().__init__()
        for name, value in values.items():
            self.register_parameter(f"log_{name}", nn.Parameter(torch.tensor(math.log(value))))

    def __getitem__(self, name: str) -> Tensor:
        """Value of a parameter, positive, scalar; gradients pass to its logarithm."""
        logarithm: Tensor = getattr(self, f"log_{name}")
        return logarithm.exp()


def magic_formula(
    slip: Tensor, stiffness: Tensor, shape: Tensor, curvature: Tensor | float = 0.0
) -> Tensor:
    """Pacejka's curve for a peak of 1: sin(C atan(B s - E (B s - atan(B s)))).

    Parameters
    ----------
    slip : Tensor
        s, an angle [rad] or a ratio [1], (...).
    stiffness : Tensor
        B [1/rad] or [1].
    shape : Tensor
        C [1].
    curvature : Tensor | float, default 0.0
        E [1]; 0: the paper's curve without it.

    Returns
    -------
    Tensor
        (...), with the sign of the slip near zero; multiplied by the peak force it is a force.

    Source: Pacejka & Bakker 1992.
    """
    steep = stiffness * slip
    return torch.sin(shape * torch.atan(steep - curvature * (steep - torch.atan(steep))))


class PacejkaTyres(nn.Module):
    """Pacejka's curves of both axles, without combined slip.

    F_x = μ D_x F_z sin(C_x atan(B_x κ …)), the same for both axles; F_y = -μ D_y F_z sin(C_y
    atan(B_y α …)), an axle each.

    Parameters
    ----------
    start : Mapping[str, float]
        Values to begin with of ``friction``, ``B_x``, ``C_x``, ``D_x``, and ``B``, ``C``, ``D``
        with ``_front`` and ``_rear``.
    with_curvature : bool, default False
        Whether E is learnt too, from 0 on, for all three curves.

    Source: Węgrzynowski et al. 2024, Eq. 3, with the sign of a slip angle that is positive to the
    left.
    """

    def __init__(self, start: Mapping[str, float], *, with_curvature: bool = False) -> None:
        super().__init__()
        self.parameters_of = PositiveParameters(start)
        self.curvature = nn.Parameter(torch.zeros(3)) if with_curvature else None

    def forward(self, slips: Slips, loads: tuple[Tensor, Tensor]) -> TyreForces:
        """Forces of both axles.

        Parameters
        ----------
        slips : Slips
            (...), slip angles positive to the left.
        loads : tuple[Tensor, Tensor]
            Vertical force on the front and on the rear axle [N].

        Returns
        -------
        TyreForces
            In the wheels' axes, (...) [N]; lateral forces oppose the slip angles.
        """
        p = self.parameters_of
        mu = p["friction"]
        ex, ef, er = (0.0, 0.0, 0.0) if self.curvature is None else self.curvature
        along = mu * p["D_x"] * magic_formula(slips.ratio, p["B_x"], p["C_x"], ex)
        front = -mu * p["D_front"] * magic_formula(slips.front, p["B_front"], p["C_front"], ef)
        rear = -mu * p["D_rear"] * magic_formula(slips.rear, p["B_rear"], p["C_rear"], er)
        return TyreForces(loads[0] * along, loads[0] * front, loads[1] * along, loads[1] * rear)
