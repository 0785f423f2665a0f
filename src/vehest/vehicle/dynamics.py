"""Planar cars that differ in what of them is a network: x = (vx, vy, yaw rate, rim speed,
friction), u = (steering angle, motor current).

All cars share the interface of `Dynamics`: `motion` returns rates and accelerations, from which
`transition` (Runge-Kutta) and `observation` follow. They differ in who computes the rates:

| class | rates |
|---|---|
| `PacejkaCar` | `PlanarCar` on Pacejka's curves |
| `ResidualCar` | the same plus a network's output |
| `TyreNetworkCar` | `PlanarCar` on tyre forces of a network |
| `NeuralCar` | a network's output |

Source: Węgrzynowski et al. 2024, Section III-B.2; sizes, inputs and start values as in its authors'
code.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from vehest.vehicle.planar import F1TENTH, FIXED_PARAMETERS, LEARNT, Motion, PlanarCar
from vehest.vehicle.tyres import PacejkaTyres, Slips, TyreForces

STATES = ("vx", "vy", "yaw_rate", "rim_speed", "friction")  # names of the states

PACEJKA: Mapping[str, float] = {
    "friction": 0.8916,
    **{"B_x": 2.8, "C_x": 1.2, "D_x": 0.8095},
    **{
        f"{name}_{axle}": value
        for axle in ("front", "rear")
        for name, value in (("B", 5.948), ("C", 2.2754), ("D", 0.8095))
    },
}
"""Initial values of the learnt parameters of Pacejka's curves, for the F1TENTH car; the same
source.
"""

TURN = 100.0  # [1/rad] steepness with which a lateral force changes its sign
UNSCALED = 0.4  # factor of the forces of a tyre network that does not know the friction


class Perceptron(nn.Sequential):
    """Fully connected layers with sigmoids between them; inputs are divided and outputs multiplied
    by fixed scales, 1 to begin with.

    Parameters
    ----------
    *sizes : int
        Inputs, units of each hidden layer, outputs. No sigmoid follows the last layer.

    Attributes
    ----------
    input_scale, output_scale : Tensor
        (inputs,) and (outputs,); buffers, which are stored with the model and not learnt.
    """

    input_scale: Tensor
    output_scale: Tensor

    def __init__(self, *sizes: int) -> None:
        layers: list[nn.Module] = []
        for before, after in pairwise(sizes):
            layers += [nn.Linear(before, after), nn.Sigmoid()]
        super().__init__(*layers[:-1])
        self.register_buffer("input_scale", torch.ones(sizes[0]))
        self.register_buffer("output_scale", torch.ones(sizes[-1]))

    def forward(self, values: Tensor) -> Tensor:
        """Outputs (..., outputs) of the network for inputs (..., inputs)."""
        scaled: Tensor = super().forward(values / self.input_scale)  # type: ignore[no-untyped-call]
        return scaled * self.output_scale

    def reset(self, generator: torch.Generator) -> None:
        """Draw weights and biases anew, uniform within ±1/√n for a layer of n inputs, as torch
        does.
        """
        with torch.no_grad():
            for layer in self:
                if isinstance(layer, nn.Linear):
                    bound = layer.in_features**-0.5
                    for parameter in (layer.weight, layer.bias):
                        parameter.copy_(
                            bound * (2.0 * torch.rand(parameter.shape, generator=generator) - 1.0)
                        )

    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Weight and bias of each layer, with the scales of inputs and outputs in them.

        Returns
        -------
        list[tuple[Tensor, Tensor]]
            For each layer W, (out, in), and b, (out,). The input scale is divided into the first
            weight and the output scale multiplied into the last layer, so that a caller computes W
            x + b and sigmoids alone.
        """
        linear = [layer for layer in self if isinstance(layer, nn.Linear)]
        pairs: list[tuple[Tensor, Tensor]] = [(layer.weight, layer.bias) for layer in linear]
        pairs[0] = (pairs[0][0] / self.input_scale, pairs[0][1])
        pairs[-1] = (
            pairs[-1][0] * self.output_scale.unsqueeze(-1),
            pairs[-1][1] * self.output_scale,
        )
        return pairs


def rk4(
    derivative: Callable[[Tensor, Tensor], Tensor], state: Tensor, inputs: Tensor, step: float
) -> Tensor:
    """Integrate one step by the classical Runge-Kutta method, inputs held over it.

    x⁺ = x + τ/6 (k₁ + 2 k₂ + 2 k₃ + k₄), with k₁ = f(x), k₂ = f(x + τ/2 k₁), k₃ = f(x + τ/2 k₂) and
    k₄ = f(x + τ k₃).

    Parameters
    ----------
    derivative : Callable[[Tensor, Tensor], Tensor]
        f: states (..., n) and inputs (..., p) to rates (..., n), in units of the state per second.
    state : Tensor
        x, (..., n).
    inputs : Tensor
        (..., p).
    step : float
        τ [s].

    Source: Kutta 1901.
    """
    first = derivative(state, inputs)
    second = derivative(state + 0.5 * step * first, inputs)
    third = derivative(state + 0.5 * step * second, inputs)
    fourth = derivative(state + step * third, inputs)
    return state + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)


class Dynamics(nn.Module):
    """Base of planar cars: rates of the state, from which transition and observation follow; the
    friction is constant.
    """

    @abstractmethod
    def motion(self, state: Tensor, inputs: Tensor) -> Motion:
        """Rates of vx, vy, yaw rate and rim speed, and what an accelerometer reads.

        Parameters
        ----------
        state : Tensor
            (..., 5) in the order of `STATES`: vx, vy [m/s], yaw rate [rad/s], rim speed [m/s],
            friction [1].
        inputs : Tensor
            (..., 2): steering angle [rad], positive to the left, and motor current [A].

        Returns
        -------
        Motion
            Rates (..., 4) of all states but the friction; accelerations at the centre of gravity.
        """

    def rates(self, state: Tensor, inputs: Tensor) -> Tensor:
        """dx/dt, (..., 5), of states (..., 5) under inputs (..., 2); that of the friction is 0."""
        moving = self.motion(state, inputs).rates
        return torch.cat([moving, torch.zeros_like(moving[..., :1])], -1)

    def transition(self, state: Tensor, inputs: Tensor, step: float) -> Tensor:
        """The state one step [s] later, by the Runge-Kutta method, (..., 5).

        State (..., 5) and inputs (..., 2) may broadcast against each other.
        """
        state, inputs = _broadcast(state, inputs)
        return rk4(self.rates, state, inputs, step)

    def observation(self, state: Tensor, inputs: Tensor) -> Tensor:
        """Measurements that sensors show: ax, ay [m/s²], yaw rate [rad/s], rim speed [m/s], (...,
        4).

        Yaw rate and rim speed are those of the state itself.
        """
        state, inputs = _broadcast(state, inputs)
        motion = self.motion(state, inputs)
        return torch.cat([motion.ax.unsqueeze(-1), motion.ay.unsqueeze(-1), state[..., 2:4]], -1)

    def reset(self, generator: torch.Generator) -> None:
        """Draw the weights of networks anew; physical parameters keep their values."""
        for module in self.modules():
            if isinstance(module, Perceptron):
                module.reset(generator)


class PacejkaCar(Dynamics):
    """PC: single track with Pacejka's curves (Eqs. 2 and 3). Its friction is learnt once and not
    the state's.

    Parameters
    ----------
    car : Mapping[str, float], default F1TENTH
        Values that learning starts from, as `F1TENTH`.
    with_curvature : bool, default False
        Whether the curvature E of all curves is learnt too.
    """

    def __init__(self, car: Mapping[str, float] = F1TENTH, *, with_curvature: bool = False) -> None:
        super().__init__()
        self.car = PlanarCar(car)
        self.tyres = PacejkaTyres(PACEJKA, with_curvature=with_curvature)

    def motion(self, state: Tensor, inputs: Tensor) -> Motion:
        """Rates and accelerations by Pacejka's curves; see `Dynamics.motion`."""
        return self.car.motion(
            state, inputs, self.tyres(self.car.slips(state, inputs), self.car.loads())
        )


class ResidualCar(PacejkaCar):
    """PCR: `PacejkaCar` with a network that adds to its rates.

    The network receives vx, vy, yaw rate, rim speed, steering angle and current, and adds to all
    four rates. Accelerations follow from the corrected rates by kinematics, a_x = vx' - vy r and
    a_y = vy' + vx r, so that they stay consistent with the motion.

    Parameters
    ----------
    hidden : Sequence[int], default (256, 256)
        Units of each hidden layer.
    """

    def __init__(
        self, car: Mapping[str, float] = F1TENTH, *, hidden: Sequence[int] = (256, 256)
    ) -> None:
        super().__init__(car)
        self.network = Perceptron(6, *hidden, 4)

    def motion(self, state: Tensor, inputs: Tensor) -> Motion:
        """Rates and accelerations by Pacejka's curves and the network; see `Dynamics.motion`."""
        return _kinematic(
            state,
            super().motion(state, inputs).rates
            + self.network(torch.cat([state[..., :4], inputs], -1)),
        )


class NeuralCar(Dynamics):
    """NN: the rates are a network's (Eq. 4).

    It has no physical parameters, and its inputs are those of `ResidualCar`'s network.

    Parameters
    ----------
    hidden : Sequence[int], default (256, 256)
        Units of each hidden layer.
    """

    def __init__(self, hidden: Sequence[int] = (256, 256)) -> None:
        super().__init__()
        self.network = Perceptron(6, *hidden, 4)

    def motion(self, state: Tensor, inputs: Tensor) -> Motion:
        """Rates and accelerations by the network; see `Dynamics.motion`."""
        return _kinematic(state, self.network(torch.cat([state[..., :4], inputs], -1)))


class TyreNetworkCar(Dynamics):
    """NNTF and NNT: single track with a network for the tyres (Eqs. 6 and 5).

    NNTF: F_x = μ o, F_y = -μ softplus(o) tanh(100 α); the network receives vx, vy, yaw rate, rim
    speed, friction, steering angle and slips. NNT: forces are 0.4 o, and it receives the motor's
    current too.

    Parameters
    ----------
    friction_scaled : bool, default True
        Whether forces are scaled by friction (NNTF).
    """

    def __init__(
        self,
        car: Mapping[str, float] = F1TENTH,
        *,
        friction_scaled: bool = True,
        hidden: Sequence[int] = (64, 64),
    ) -> None:
        super().__init__()
        self.car = PlanarCar(car)
        self.friction_scaled = friction_scaled
        self.network = Perceptron(9 if friction_scaled else 10, *hidden, 4)

    def forces(self, state: Tensor, inputs: Tensor, slips: Slips) -> TyreForces:
        """Forces of both axles in the wheels' axes [N], by the network.

        Parameters
        ----------
        state : Tensor
            (..., 5), see `Dynamics.motion`.
        inputs : Tensor
            (..., 2).
        slips : Slips
            Of these states.

        Returns
        -------
        TyreForces
            NNTF: lateral forces oppose the slip angle, since softplus is positive; longitudinal
            ones may have either sign. NNT: the network's outputs, with any sign.
        """
        steer, current = inputs.unbind(-1)
        features = [*state.unbind(-1), steer, slips.front, slips.rear, slips.ratio]
        if not self.friction_scaled:
            rear_x, front_x, rear_y, front_y = (
                UNSCALED * self.network(torch.stack([*features, current], -1))
            ).unbind(-1)
            return TyreForces(front_x, front_y, rear_x, rear_y)
        rear_x, front_x, rear_y, front_y = self.network(torch.stack(features, -1)).unbind(-1)
        mu = state[..., 4]
        return TyreForces(
            mu * front_x,
            -mu * nn.functional.softplus(front_y) * torch.tanh(TURN * slips.front),
            mu * rear_x,
            -mu * nn.functional.softplus(rear_y) * torch.tanh(TURN * slips.rear),
        )

    def motion(self, state: Tensor, inputs: Tensor) -> Motion:
        """Rates and accelerations by tyre forces of the network; see `Dynamics.motion`."""
        return self.car.motion(
            state, inputs, self.forces(state, inputs, self.car.slips(state, inputs))
        )


def physical_of(dynamics: Dynamics) -> tuple[Tensor, tuple[float, ...]]:
    """Learnt values in the order of `LEARNT` and `PACEJKA`, differentiable, and fixed ones as
    `FIXED_PARAMETERS`; 0 and 1 where a car has none.

    Returns
    -------
    tuple[Tensor, tuple[float, ...]]
        (len(LEARNT) + len(PACEJKA),) in SI units, and mass [kg], wheelbase [m] and wheel radius
        [m].
    """
    car = getattr(dynamics, "car", None)
    tyres = getattr(dynamics, "tyres", None)
    if not isinstance(car, PlanarCar):
        return torch.zeros(len(LEARNT) + len(PACEJKA)), (1.0,) * len(FIXED_PARAMETERS)
    learnt = torch.stack([car.learnt[name] for name in LEARNT])
    curves = (
        torch.stack([tyres.parameters_of[name] for name in PACEJKA])
        if isinstance(tyres, PacejkaTyres)
        else learnt.new_zeros(len(PACEJKA))
    )
    return torch.cat([learnt, curves]), (car.mass, car.wheelbase, car.wheel_radius)


def _kinematic(state: Tensor, rates: Tensor) -> Motion:
    """Motion of given rates: ax = dvx/dt - vy r, ay = dvy/dt + vx r."""
    vx = state[..., 0]
    vy = state[..., 1]
    yaw_rate = state[..., 2]
    return Motion(rates, rates[..., 0] - vy * yaw_rate, rates[..., 1] + vx * yaw_rate)


def _broadcast(state: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Expand leading dimensions of a state and of inputs to their common shape."""
    shape = torch.broadcast_shapes(state.shape[:-1], inputs.shape[:-1])
    return state.expand(*shape, state.shape[-1]), inputs.expand(*shape, inputs.shape[-1])
