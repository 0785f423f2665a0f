"""The network of the KS-NN in PyTorch, its readable definition.

The compiled recursion is `vehest.estimators.kernels.ksnn`, differentiable here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from vehest.estimators.kernels import ksnn as kernel
from vehest.estimators.kernels.recursion import Recursion
from vehest.estimators.networks.compiled import CompiledNetwork

GAMMA_START = 0.98  # mean of the initial γ
GAMMA_SPREAD = 0.01  # standard deviation of the initial γ, which are 1 at most
# standard deviation of the initial β from 1, and of linear and output weights from 0
INITIAL_DEVIATION = 0.1


class KinematicsStructuredNetwork(CompiledNetwork, nn.Module):
    """Bank of Luenberger-like observers blended by yaw rate (KS-NN).

    v⁺ = γ₁v + β₁τ(a_y - u_m ω) - ω f₁(û - u_m)        (Da Lio et al. 2023, Eq. 7a)
    û⁺ = γ₂û + β₂τ(a_x + vω) - f₂(û - u_m)             (Eq. 7b)
    f(e) = w₁e + b₁ + Σⱼ w₃ⱼ tanh(w₂ⱼe + b₂ⱼ) + b₃      (Eq. 8, and the second layer's own bias)

    Parameters
    ----------
    settings : Any
        Structure.
    yaw_rate_max : float, default 1.0
        Centre of the last local model [rad/s]; the others are spaced evenly from 0 (Fig. 3).
    """

    yaw_rate_max: Tensor
    gamma: nn.Parameter  # γ₁ and γ₂ of each local model, (P, 2)
    beta: nn.Parameter  # β₁ and β₂ of each local model, (P, 2)
    linear_weight: nn.Parameter  # w₁ of f₁ and f₂, (P, 2)
    linear_bias: nn.Parameter  # b₁ of f₁ and f₂, (P, 2), if there are biases
    hidden_weight: nn.Parameter  # w₂ of Q neurons of f₁ and f₂, (P, 2, Q)
    output_weight: nn.Parameter  # w₃ of Q neurons of f₁ and f₂, (P, 2, Q)
    hidden_bias: nn.Parameter  # b₂ of Q neurons of f₁ and f₂, (P, 2, Q), if there are biases
    output_bias: nn.Parameter  # b₃ of f₁ and f₂, (P, 2), if there are biases

    def __init__(self, settings: Any, yaw_rate_max: float = 1.0) -> None:
        super().__init__()
        self.settings = settings
        self.step = 1.0 / settings.rate_hz
        self.register_buffer("yaw_rate_max", torch.tensor(float(yaw_rate_max)))
        for name, shape in kernel.shapes_of(
            settings.n_local, settings.n_hidden, bias=settings.bias
        ).items():
            self.register_parameter(name, nn.Parameter(torch.zeros(shape)))

    def reset(self, generator: torch.Generator) -> None:
        """Draw initial weights near the kinematic observer: γ ≈ 0.98, β ≈ 1, small feedback.

        Weights are drawn in float64 and rounded, so that a seed gives the same ones in both
        precisions.
        """
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64).to(
                    parameter.dtype
                )
                if name == "gamma":
                    parameter.copy_((GAMMA_START + GAMMA_SPREAD * noise).clamp(max=1.0))
                elif name == "beta":
                    parameter.copy_(1.0 + INITIAL_DEVIATION * noise)
                elif name == "hidden_weight":
                    parameter.copy_(noise)
                elif name == "linear_weight":
                    parameter.copy_(INITIAL_DEVIATION * noise.abs())
                elif name == "output_weight":
                    parameter.copy_(INITIAL_DEVIATION * noise)
                else:
                    parameter.copy_(0.01 * noise)

    def constrain(self, parameters: Mapping[str, Tensor]) -> None:
        """Keep γ₁ in (0, 1] (Section IV-A2), or both gains of the slip rate near one.

        Without ``kinematic_gain`` the bound is the paper's. With it, which is not in the paper, γ₁
        and β₁ of every local model are so near one that the estimate integrates a_y - ωu_m.
        """
        bound = self.settings.kinematic_gain
        parameters["gamma"][..., 0].clamp_(min=max(bound, 1e-3), max=1.0)
        if bound:
            parameters["beta"][..., 0].clamp_(min=bound, max=2.0 - bound)

    def activations(self, yaw_rate: Tensor) -> Tensor:
        """Weights φ of the local models (Fig. 3), (...) -> (..., P).

        Beyond the last centre the last one alone.

        φ_p is a triangle of height 1 around the centre of model p, so that two neighbours share
        each yaw rate and their weights add up to 1.
        """
        position = (yaw_rate.abs() / self.yaw_rate_max * (self.settings.n_local - 1)).clamp(
            max=self.settings.n_local - 1
        )
        centres = torch.arange(self.settings.n_local, dtype=yaw_rate.dtype)
        return (1.0 - (position.unsqueeze(-1) - centres).abs()).clamp(min=0.0)

    def feedback(self, error: Tensor) -> Tensor:
        """f₁ and f₂ of every local model (Eq. 8), (...) -> (..., P, 2)."""
        error = error[..., None, None]
        value = self.linear_weight * error
        if self.settings.bias:
            value = value + self.linear_bias
        if self.settings.n_hidden:
            inner = self.hidden_weight * error.unsqueeze(-1)
            if self.settings.bias:
                inner = inner + self.hidden_bias
            value = value + (self.output_weight * torch.tanh(inner)).sum(-1)
            if self.settings.bias:
                value = value + self.output_bias
        return value

    def forward(self, measurements: Tensor) -> Tensor:
        """Run the recursion from v = 0, û = u_m over the window (Fig. 1).

        Parameters
        ----------
        measurements : Tensor
            Windows (..., N, 4) of yaw_rate [rad/s], vx [m/s], ay, ax [m/s²].

        Returns
        -------
        Tensor
            Lateral velocity one step after each window, (...) [m/s].
        """
        yaw_rate, speed, ay, ax = measurements.unbind(-1)
        weights = self.activations(yaw_rate)
        v = torch.zeros_like(speed[..., 0])
        u = speed[..., 0]
        for k in range(measurements.shape[-2]):
            omega = yaw_rate[..., k]
            phi = weights[..., k, :]
            f = self.feedback(u - speed[..., k])
            slip = self.step * (ay[..., k] - speed[..., k] * omega)
            thrust = self.step * (ax[..., k] + v * omega)
            v_local = (
                self.gamma[:, 0] * v[..., None]
                + self.beta[:, 0] * slip[..., None]
                - omega[..., None] * f[..., 0]
            )
            u_local = (
                self.gamma[:, 1] * u[..., None] + self.beta[:, 1] * thrust[..., None] - f[..., 1]
            )
            v = (phi * v_local).sum(-1)
            u = (phi * u_local).sum(-1)
        return v

    def recursion(self) -> Recursion:
        """The compiled recursion."""
        return kernel.recursion_of(self.settings, float(self.yaw_rate_max))
