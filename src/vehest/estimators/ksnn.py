"""KS-NN: the kinematics-structured neural network of Da Lio, Piccinini & Biral, IEEE T-ITS 2023.

The method is patented by its authors (PCT/IT2023/050058).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vehest.data.recording import Recording
from vehest.declared import setting
from vehest.estimators.base import Trial
from vehest.estimators.kernels import ksnn as kernel
from vehest.estimators.kernels.recursion import CompiledNetwork, Recursion
from vehest.estimators.networks.windowed import WindowedEstimator
from vehest.training.members import FlatParameters

GAMMA_START = 0.98
GAMMA_SPREAD = 0.01
SMALL = 0.1


class KinematicsStructuredNetwork(CompiledNetwork, nn.Module):
    """Bank of Luenberger-like observers blended by yaw rate (KS-NN).

    v⁺ = γ₁v + β₁τ(a_y - u_m ω) - ω f₁(û - u_m)        (Da Lio et al. 2023, Eq. 7a)
    û⁺ = γ₂û + β₂τ(a_x + vω) - f₂(û - u_m)             (Eq. 7b)
    f(e) = w₁e + b₁ + Σⱼ w₃ⱼ tanh(w₂ⱼe + b₂ⱼ) + b₃      (Eq. 8, and the second layer's own bias)

    Args:
        settings: structure.
        yaw_rate_max: centre of the last local model [rad/s]; the others are spaced evenly from 0 (Fig. 3).

    Shapes:
        measurements: (..., N, 4), channels yaw_rate [rad/s], vx [m/s], ay, ax [m/s²].
        returns: (...) lateral velocity [m/s] one step after the window.
    """

    yaw_rate_max: Tensor

    def __init__(self, settings: Any, yaw_rate_max: float = 1.0) -> None:
        super().__init__()
        local, hidden = settings.n_local, settings.n_hidden
        self.settings = settings
        self.step = 1.0 / settings.rate_hz
        self.register_buffer("yaw_rate_max", torch.tensor(float(yaw_rate_max)))
        self.gamma = nn.Parameter(torch.empty(local, 2))
        self.beta = nn.Parameter(torch.empty(local, 2))
        self.linear_weight = nn.Parameter(torch.empty(local, 2))
        if settings.bias:
            self.linear_bias = nn.Parameter(torch.zeros(local, 2))
        if hidden:
            self.hidden_weight = nn.Parameter(torch.empty(local, 2, hidden))
            self.output_weight = nn.Parameter(torch.empty(local, 2, hidden))
            if settings.bias:
                self.hidden_bias = nn.Parameter(torch.zeros(local, 2, hidden))
                self.output_bias = nn.Parameter(torch.zeros(local, 2))

    def reset(self, generator: torch.Generator) -> None:
        """Draw initial weights near the kinematic observer: γ ≈ 0.98, β ≈ 1, small feedback."""
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64).to(parameter.dtype)
                if name == "gamma":
                    parameter.copy_((GAMMA_START + GAMMA_SPREAD * noise).clamp(max=1.0))
                elif name == "beta":
                    parameter.copy_(1.0 + SMALL * noise)
                elif name == "hidden_weight":
                    parameter.copy_(noise)
                elif name == "linear_weight":
                    parameter.copy_(SMALL * noise.abs())
                elif name == "output_weight":
                    parameter.copy_(SMALL * noise)
                else:
                    parameter.copy_(0.01 * noise)

    def constrain(self, parameters: Mapping[str, Tensor]) -> None:
        """Keep γ₁ in (0, 1] (Section IV-A2)."""
        parameters["gamma"][..., 0].clamp_(min=1e-3, max=1.0)

    def activations(self, yaw_rate: Tensor) -> Tensor:
        """Weights φ of the local models (Fig. 3), (...) -> (..., P); beyond the last centre the last one alone."""
        position = (yaw_rate.abs() / self.yaw_rate_max * (self.settings.n_local - 1)).clamp(max=self.settings.n_local - 1)
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
        """Run the recursion from v = 0, û = u_m over the window (Fig. 1)."""
        yaw_rate, speed, ay, ax = measurements.unbind(-1)
        weights = self.activations(yaw_rate)
        v, u = torch.zeros_like(speed[..., 0]), speed[..., 0]
        for k in range(measurements.shape[-2]):
            omega, phi = yaw_rate[..., k], weights[..., k, :]
            f = self.feedback(u - speed[..., k])
            slip = self.step * (ay[..., k] - speed[..., k] * omega)
            thrust = self.step * (ax[..., k] + v * omega)
            v_local = self.gamma[:, 0] * v[..., None] + self.beta[:, 0] * slip[..., None] - omega[..., None] * f[..., 0]
            u_local = self.gamma[:, 1] * u[..., None] + self.beta[:, 1] * thrust[..., None] - f[..., 1]
            v, u = (phi * v_local).sum(-1), (phi * u_local).sum(-1)
        return v

    def recursion(self) -> Recursion:
        """The compiled recursion."""
        layout, own = FlatParameters(self), self.settings
        slots = self._packed(layout.views(torch.eye(layout.size))).flatten(1).argmax(1).numpy()
        per_width = (own.n_local - 1) / float(self.yaw_rate_max)
        return Recursion(kernel.loop, lambda number: (slots, own.n_local, own.n_hidden, own.window, number(self.step), number(per_width)))

    def _packed(self, parameters: Mapping[str, Tensor]) -> Tensor:
        gamma = parameters["gamma"]
        bias = parameters.get("linear_bias", torch.zeros_like(gamma))
        if self.settings.n_hidden and self.settings.bias:
            bias = bias + parameters["output_bias"]
        pieces = [gamma, parameters["beta"], torch.stack([parameters["linear_weight"], bias], dim=-1).flatten(-2)]
        if self.settings.n_hidden:
            weight = parameters["hidden_weight"]
            neurons = [weight, parameters.get("hidden_bias", torch.zeros_like(weight)), parameters["output_weight"]]
            pieces.append(torch.stack(neurons, dim=-1).flatten(-3))
        return torch.cat(pieces, dim=-1)


class Ksnn(WindowedEstimator):
    """KS-NN as an estimator: windows of N measurements, lateral velocity one step after.

    Source: Da Lio et al. 2023; patented (PCT/IT2023/050058).
    """

    name, title = "ksnn", "KS-NN"
    trials = (
        Trial(
            2,
            "the network that comes with vehest, trained on; half a minute",
            "estimator.n_local=2 estimator.n_hidden=2 training.start_from=pretrained training.max_epochs=100 seed=range(2)",
        ),
        Trial(
            3,
            "the same family from scratch; a minute",
            "estimator.n_hidden=0,2 estimator.bias=true training.max_epochs=100 seed=range(2)",
        ),
    )
    template = "ksnn"
    notice = (
        "The KS-NN is patented by its authors (PCT/IT2023/050058). Using it in a product may need their licence;",
        "the licence of this software grants none.",
    )
    n_local: int = setting(2, "local models P along |yaw rate|", least=1)
    n_hidden: int = setting(2, "neurons Q of each feedback function; 0: linear", least=0)
    bias: bool = setting(False, "whether feedback functions may learn sensor offsets")

    @classmethod
    def line_style(cls, variant: str) -> tuple[str, str, str]:
        """Blue with linear feedback, orange with nonlinear; darker and solid with biases (Da Lio et al. 2023, Fig. 6)."""
        nonlinear, bias = "nonlinear" in variant, "bias" in variant and "no_bias" not in variant
        shades = ("#f59a23", "#b8480b") if nonlinear else ("#4aa5e0", "#0b4f9c")
        return shades[bias], "solid" if bias else "dashed", "^" if nonlinear else "o"

    @property
    def kind(self) -> str:
        """Of the feedback functions."""
        return "nonlinear" if self.n_hidden else "linear"

    @property
    def variant(self) -> str:
        """Name of the structure as in Table III."""
        return f"{self.kind}_{'bias' if self.bias else 'no_bias'}_p{self.n_local}" + (f"_q{self.n_hidden}" if self.n_hidden else "")

    @property
    def full_title(self) -> str:
        """Structure in words, for example ``KS-NN linear + bias, P = 2``."""
        neurons = f", Q = {self.n_hidden}" if self.n_hidden else ""
        return f"{self.title} {self.kind} {'+ bias' if self.bias else 'no bias'}, P = {self.n_local}{neurons}"

    def network_for(self, train: list[Recording]) -> KinematicsStructuredNetwork:
        """A network whose local models span the yaw rates of the training recordings."""
        return KinematicsStructuredNetwork(self.settings, max(float(np.abs(r["yaw_rate"]).max()) for r in train))

    def new_network(self) -> KinematicsStructuredNetwork:
        """A network to load weights into."""
        return KinematicsStructuredNetwork(self.settings)

    def c_values(self) -> dict[str, Any]:
        """Its local models and their neurons."""
        s, w = self.settings, {name: values.astype(np.float64) for name, values in self.weights().items()}
        parts = [w["gamma"], w["beta"], w["linear_weight"]]
        if s.bias:
            parts.append(w["linear_bias"] + (w["output_bias"] if s.n_hidden else 0.0))
        neurons = [w["hidden_weight"], w["output_weight"], *([w["hidden_bias"]] if s.bias else [])] if s.n_hidden else []
        return {
            "window": s.window,
            "local": s.n_local,
            "active": min(s.n_local, 2),
            "hidden": s.n_hidden,
            "bias": s.bias,
            "step": 1.0 / s.rate_hz,
            "per_width": (s.n_local - 1) / float(w["yaw_rate_max"]),
            "linear": np.concatenate(parts, axis=1),
            "neurons": np.stack(neurons, axis=-1) if neurons else None,
        }


ESTIMATOR = Ksnn
