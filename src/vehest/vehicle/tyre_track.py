"""The single track of tyres that adapt: state, motion and measurements of the filters of Di Biase,
Lenzo & Timpone 2020, in torch.

State (β, r, β', r', θ…): sideslip angle [rad], yaw rate [rad/s], their rates, and logarithms of
tyre parameters over nominal ones. Inputs (u, δ): forward speed [m/s] and road-wheel angle [rad]. In
steps of Δt (Eqs. 22 to 25, 47, 48), forward Euler:

    β⁺ = β + Δt β',   r⁺ = r + Δt r',   θ⁺ = θ
    β'⁺ = (F_F + F_R)/(M u) - r,   r'⁺ = (a_F F_F - a_R F_R)/J
    α_F = δ - β - a_F r/u,   α_R = -β + a_R r/u
    measured: r and a_y = u (β' + r)

Logarithms keep parameters positive and put them all on one scale; the paper has the parameters
themselves as states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from vehest.vehicle.parameters import SingleTrackParameters
from vehest.vehicle.rational_tyres import AxleForce, rational_axle

# names of the first four states
MOTION = ("sideslip", "yaw_rate", "sideslip_rate", "yaw_acceleration")
# names of the tyre parameters, in their order
TYRE_PARAMETERS = ("c1_front", "c2_front", "c1_rear", "c2_rear", "friction")


@dataclass(frozen=True)
class TyreTrack:
    """A single track whose tyre parameters may be part of its state."""

    # mass, inertia and the places of the axles; its cornering stiffnesses are not used
    car: SingleTrackParameters
    # c₁ and c₂ of the front, then of the rear axle, and the friction, in the order of
    # `TYRE_PARAMETERS`
    nominal: tuple[float, float, float, float, float]
    adapted: Sequence[int]  # indices of the parameters that are states, in `TYRE_PARAMETERS`
    step: float  # Δt [s]

    def parameters(self, states: Tensor) -> list[Tensor]:
        """Tyre parameters of states, in the order of `TYRE_PARAMETERS`.

        Parameters
        ----------
        states : Tensor
            (..., n); columns from `MOTION` on are logarithms of adapted parameters over nominal
            ones.

        Returns
        -------
        list[Tensor]
            c₁ [rad²] and c₂ [N/rad] of the front axle, of the rear axle, friction [1]: five of
            shape (...). Those that are not adapted have their nominal values.
        """
        values = [states.new_full(states.shape[:-1], value) for value in self.nominal]
        for column, index in enumerate(self.adapted, len(MOTION)):
            values[index] = values[index] * torch.exp(states[..., column])
        return values

    def axles(self, states: Tensor, inputs: Tensor) -> tuple[AxleForce, AxleForce]:
        """Axle forces of states (..., n) under inputs (u [m/s], δ [rad]), (..., 2).

        α_F = δ - β - a_F r/u, α_R = -β + a_R r/u. The speed must be positive.

        Returns
        -------
        tuple[AxleForce, AxleForce]
            Force and derivatives of the front and of the rear axle, positive to the left.
        """
        c1_front, c2_front, c1_rear, c2_rear, friction = self.parameters(states)
        sideslip = states[..., 0]
        turn = states[..., 1] / inputs[..., 0]
        front = inputs[..., 1] - sideslip - self.car.cg_to_front_axle * turn
        rear = -sideslip + self.car.cg_to_rear_axle * turn
        return rational_axle(front, c1_front, c2_front, friction), rational_axle(
            rear, c1_rear, c2_rear, friction
        )

    def transition(self, states: Tensor, inputs: Tensor) -> Tensor:
        """States one step later, (..., n) under inputs (..., 2) (Eqs. 22 to 25, 47, 48).

        β and r move by their rates; the rates are replaced by those that the forces give, without
        the step's length; adapted logarithms stay.
        """
        front, rear = self.axles(states, inputs)
        car = self.car
        rates = [
            (front.force + rear.force) / (car.mass * inputs[..., 0]) - states[..., 1],
            (car.cg_to_front_axle * front.force - car.cg_to_rear_axle * rear.force)
            / car.yaw_inertia,
        ]
        moved = states[..., :2] + self.step * states[..., 2:4]
        return torch.cat([moved, torch.stack(rates, -1), states[..., 4:]], -1)

    def observation(self, states: Tensor, inputs: Tensor) -> Tensor:
        """Yaw rate [rad/s] and lateral acceleration [m/s²] of states (..., n) under inputs (...,
        2): (..., 2).

        a_y = u (β' + r) (Eqs. 38 to 40).
        """
        return torch.stack([states[..., 1], inputs[..., 0] * (states[..., 2] + states[..., 1])], -1)

    def process_noise(self, states: Tensor, inputs: Tensor, steer: float, tyres: float) -> Tensor:
        """Covariance of the process noise of one step, Q = Δt B Λ Bᵀ (Eqs. 41 to 45).

        The steering angle changes the next state by the first column of B (Eqs. 52, 60): rates of
        sideslip and yaw by the slope of the front axle's force. Logarithms of adapted parameters
        wander independently of each other.

        Parameters
        ----------
        states : Tensor
            (..., n), where the slope is taken.
        inputs : Tensor
            u [m/s] and δ [rad], (..., 2).
        steer : float
            Standard deviation of the steering angle for a second's step [rad/√s].
        tyres : float
            Standard deviation of the adapted logarithms [1/√s].

        Returns
        -------
        Tensor
            (..., n, n), symmetric, of rank 1 in the first four states.
        """
        front, _ = self.axles(states, inputs)
        slope = torch.zeros_like(states)
        slope[..., 2] = steer * (front.per_slip / (self.car.mass * inputs[..., 0]))
        slope[..., 3] = steer * (self.car.cg_to_front_axle * front.per_slip / self.car.yaw_inertia)
        wander = (
            torch.tensor([0.0] * len(MOTION) + [tyres] * len(self.adapted), dtype=states.dtype)
            .square()
            .diag()
        )
        return self.step * (slope.unsqueeze(-1) * slope.unsqueeze(-2) + wander)
