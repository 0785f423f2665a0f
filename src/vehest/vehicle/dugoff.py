"""Dugoff's tyres under pure lateral slip, plain and smooth, and the single track on them, in torch.

State (v, r): lateral velocity [m/s] and yaw rate [rad/s]. Inputs (u, δ, a_x): forward speed [m/s],
road-wheel angle [rad], longitudinal acceleration [m/s²].

    v' = (F_F cos δ + F_R)/m - u r,   r' = (l_F F_F cos δ - l_R F_R)/I_zz          (Eq. 2)
    α_F = δ - atan((v + l_F r)/u),   α_R = -atan((v - l_R r)/u)
    F = C tan α f(λ),   λ = μ F_z/(2 C |tan α|),   μ = μ₀ (1 - e_r u |tan α|)      (Eq. 9 at κ = 0)
    f = λ (2 - λ) where λ ≤ 1, else 1                                              (Eq. 9)
    f = 2/(exp(-4λ) + 1) - 1 = tanh 2λ                                             (Eq. 10)
    F_zF = m (g l_R - a_x h)/L,   F_zR = m (g l_F + a_x h)/L

Flow: states and inputs -> slip tangents and axle loads -> `DugoffAxle.force` -> axle forces ->
`DugoffTrack.transition` (the next state) and `DugoffTrack.observation` (what sensors measure).

Inputs and rates are held over a sample of Δt: x⁺ = x + Δt f(x, u). In Eq. 10 as in Eq. 9, λ is
infinite at α = 0 and its gradient is not a number, though F is as smooth as C tan α there; λ is
kept below a largest value at which f is 1 to the last digit, and its gradient none.

Source: Bertipaglia, Alirezaei, Happee & Shyrokau, IEEE Transactions on Vehicular Technology 73 (9),
2024, Section III.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from vehest.constants import GRAVITY
from vehest.vehicle.parameters import check_parameters

TRACK_STATES = ("vy", "yaw_rate")  # names of the states
# names of the measurements
TRACK_MEASUREMENTS = ("ay", "yaw_rate", "fy_front", "fy_rear", "sideslip")
MAX_FORCE_RATIO = {"plain": 1.0, "smooth": 10.0}  # tyres -> λ from which on f is 1
MIN_FRICTION_SHARE = 0.2  # smallest share of the friction that remains while sliding
MIN_LOAD_SHARE = 0.1  # smallest load of an axle under longitudinal acceleration over that at rest
# smallest denominator of the tangent of the front slip angle, so that a tyre that slides sideways
# has a finite one
MIN_COSINE = 0.05

Tyres = Literal["plain", "smooth"]  # Eq. 9 or Eq. 10


@dataclass(frozen=True)
class LoadedCar:
    """A single-track car whose axle loads shift with a steady longitudinal acceleration; a BMW
    545i by default.

    Raises
    ------
    ValueError
        A number outside of `vehest.vehicle.parameters.RANGES`.

    Source: Bertipaglia et al. 2024, Eq. 2.
    """

    mass: float = 1970.0  # [kg]
    yaw_inertia: float = 3498.0  # about the vertical axis through the centre of gravity [kg m²]
    cg_to_front_axle: float = 1.47  # distance from the centre of gravity [m]
    cg_to_rear_axle: float = 1.41  # the same [m]
    # of the centre of gravity above the road [m]; the paper gives none, 0.52 is assumed
    cg_height: float = 0.52

    def __post_init__(self) -> None:
        """Check all values against `RANGES`."""
        check_parameters(self)

    def loads(self, ax: Tensor) -> tuple[Tensor, Tensor]:
        """Vertical force on both axles under a steady longitudinal acceleration.

        F_zF = m (g l_R - a_x h)/L and F_zR = m (g l_F + a_x h)/L, each at least `MIN_LOAD_SHARE` of
        its value at rest, so that no axle lifts off and no slip force changes its sign.

        Parameters
        ----------
        ax : Tensor
            Longitudinal acceleration, positive forwards, (...) [m/s²].

        Returns
        -------
        tuple[Tensor, Tensor]
            Load of the front and of the rear axle, (...) [N] each.
        """
        wheelbase = self.cg_to_front_axle + self.cg_to_rear_axle
        transfer = ax * (self.cg_height / wheelbase)
        front, rear = (
            GRAVITY * arm / wheelbase for arm in (self.cg_to_rear_axle, self.cg_to_front_axle)
        )
        return self.mass * (front - transfer).clamp(min=MIN_LOAD_SHARE * front), self.mass * (
            rear + transfer
        ).clamp(min=MIN_LOAD_SHARE * rear)


BMW_545I = LoadedCar()  # BMW 545i of Bertipaglia et al. 2024


class DugoffAxle(NamedTuple):
    """Parameters of an axle's tyres; tensors where many are tried at once."""

    cornering_stiffness: Any  # C [N/rad]
    friction: Any  # μ₀ of a tyre that hardly slides [1]
    reduction: Any  # e_r, share of the friction that is lost per m/s of sliding [s/m]

    def force(self, tangent: Tensor, load: Tensor, vx: Tensor, tyres: Tyres) -> Tensor:
        """Lateral force of the axle in the wheels' axes.

        It is differentiable everywhere, at a slip of zero too. All arguments broadcast.

        Parameters
        ----------
        tangent : Tensor
            tan α, positive where it makes a force to the left [1].
        load : Tensor
            Vertical force F_z on the axle [N].
        vx : Tensor
            Forward speed u, positive [m/s].
        tyres : Tyres
            ``plain`` (Eq. 9) or ``smooth`` (Eq. 10).

        Returns
        -------
        Tensor
            F = C tan α f(λ), positive to the left, (...) [N]. The friction that sliding leaves is
            at least `MIN_FRICTION_SHARE` of μ₀.
        """
        slide = tangent.abs()
        half = (
            self.friction
            * (1.0 - self.reduction * vx * slide).clamp(min=MIN_FRICTION_SHARE)
            * load
            / (2.0 * self.cornering_stiffness)
        )
        ratio = half / torch.maximum(slide, half.detach() / MAX_FORCE_RATIO[tyres])
        force_share = ratio * (2.0 - ratio) if tyres == "plain" else torch.tanh(2.0 * ratio)
        force: Tensor = self.cornering_stiffness * tangent * force_share
        return force


@dataclass(frozen=True)
class DugoffTrack:
    """The single track on Dugoff's tyres, as a filter takes it.

    Below the minimum speed wheels roll without slip, v = l_R u δ/L and r = u δ/L, whatever the
    state was.
    """

    car: LoadedCar  # the car
    front: DugoffAxle  # the front axle's tyres
    rear: DugoffAxle  # the rear axle's tyres
    step: float  # Δt [s]
    tyres: Tyres = "plain"  # ``plain`` (Eq. 9) or ``smooth`` (Eq. 10)
    minimum_speed: float = 3.0  # speed below which wheels roll without slip [m/s]

    def forces(self, states: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Axle forces across the body.

        Parameters
        ----------
        states : Tensor
            v [m/s] and r [rad/s], (..., 2).
        inputs : Tensor
            u [m/s], δ [rad], a_x [m/s²], (..., 3). A speed below the minimum counts as the minimum.

        Returns
        -------
        tuple[Tensor, Tensor]
            F_F cos δ and F_R, positive to the left, (...) [N] each.
        """
        vx = inputs[..., 0].clamp(min=self.minimum_speed)
        steer = inputs[..., 1]
        ax = inputs[..., 2]
        load_front, load_rear = self.car.loads(ax)
        course_front = (states[..., 0] + self.car.cg_to_front_axle * states[..., 1]) / vx
        course_rear = (states[..., 0] - self.car.cg_to_rear_axle * states[..., 1]) / vx
        turned = torch.tan(steer)
        front = (turned - course_front) / (1.0 + turned * course_front).clamp(min=MIN_COSINE)
        of_front = self.front.force(front, load_front, vx, self.tyres) * torch.cos(steer)
        return of_front, self.rear.force(-course_rear, load_rear, vx, self.tyres)

    def transition(self, states: Tensor, inputs: Tensor) -> Tensor:
        """States one step later, (..., 2) under inputs (..., 3), by forward Euler (Eq. 2).

        Below the minimum speed the result is `rolling`, whatever the states are.
        """
        front, rear = self.forces(states, inputs)
        car = self.car
        vx = inputs[..., 0]
        rates = torch.stack(
            [
                (front + rear) / car.mass - vx * states[..., 1],
                (car.cg_to_front_axle * front - car.cg_to_rear_axle * rear) / car.yaw_inertia,
            ],
            -1,
        )
        return torch.where(
            (vx < self.minimum_speed).unsqueeze(-1),
            self.rolling(inputs),
            states + self.step * rates,
        )

    def rolling(self, inputs: Tensor) -> Tensor:
        """State of a car whose wheels do not slip: v = l_R u δ/L, r = u δ/L, (..., 2) under
        inputs (..., 3).
        """
        turn = (
            inputs[..., 0] * inputs[..., 1] / (self.car.cg_to_front_axle + self.car.cg_to_rear_axle)
        )
        return torch.stack([self.car.cg_to_rear_axle * turn, turn], -1)

    def observation(self, states: Tensor, inputs: Tensor) -> Tensor:
        """Measurements that the model expects (Eq. 4).

        Parameters
        ----------
        states : Tensor
            v [m/s] and r [rad/s], (..., 2).
        inputs : Tensor
            u [m/s], δ [rad], a_x [m/s²], (..., 3).

        Returns
        -------
        Tensor
            (..., 5) in the order of `TRACK_MEASUREMENTS`: lateral acceleration [m/s²], yaw rate
            [rad/s], front and rear axle force [N], sideslip angle [rad]. Axle forces are those
            across the body, as the channels hold them; the paper's transducers turn with the
            wheels.
        """
        front, rear = self.forces(states, inputs)
        sideslip = torch.atan(states[..., 0] / inputs[..., 0].clamp(min=self.minimum_speed))
        return torch.stack(
            [
                (front + rear) / self.car.mass,
                states[..., 1] + torch.zeros_like(front),
                front,
                rear,
                sideslip,
            ],
            -1,
        )
