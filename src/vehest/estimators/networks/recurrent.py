"""Base of the GRU and LSTM benchmarks: gates with one bias each and a linear read-out."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from vehest.declared import MAX_WIDTH, setting
from vehest.estimators.base import Trial
from vehest.estimators.kernels.recurrent import loop
from vehest.estimators.kernels.recursion import Recursion
from vehest.estimators.network import Network
from vehest.estimators.networks.compiled import CompiledNetwork
from vehest.estimators.networks.standardised import StandardisedNetwork
from vehest.estimators.networks.windowed import WindowedEstimator

# entry of both benchmarks in the first comparison on a new car
TRIAL = Trial(
    7, "recurrent networks; minutes", "estimator.n_states=5 training.max_epochs=100 seed=range(2)"
)


class HiddenStateEstimator(Network):
    """A family that is named by the size of its hidden state."""

    n_states: int  # length of the hidden state
    network_type: ClassVar[Any]  # class of the network

    def new_network(self) -> Any:
        """An untrained network of the settings' sizes."""
        return self.network_type(self.settings)

    @property
    def variant(self) -> str:
        """Identifier by the size of the hidden state."""
        return f"states_{self.n_states}"

    @property
    def full_title(self) -> str:
        """Title with the number of states."""
        return f"{self.title}, {self.n_states} states"


class RecurrentNetwork(CompiledNetwork, StandardisedNetwork):
    """One recurrent layer, one bias a gate, and a linear read-out of the last hidden state.

    From standardised windows, (..., N, C), to the lateral velocity [m/s] one step after each,
    (...).
    """

    n_gates: ClassVar[int]  # number of gates of the cell

    def __init__(self, settings: Any) -> None:
        channels = len(RecurrentEstimator.channels)
        states = settings.n_states
        super().__init__(channels)
        self.settings = settings
        self.input_weight = nn.Parameter(torch.empty(self.n_gates, states, channels))
        self.state_weight = nn.Parameter(torch.empty(self.n_gates, states, states))
        self.gate_bias = nn.Parameter(torch.empty(self.n_gates, states))
        self.output_weight = nn.Parameter(torch.empty(states))
        self.output_bias = nn.Parameter(torch.empty(()))

    def reset(self, generator: torch.Generator) -> None:
        """Draw initial weights: Glorot uniform, biases zero."""
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                if name.endswith("bias"):
                    parameter.zero_()
                    continue
                fan_out, fan_in = (
                    parameter.shape[-2:] if parameter.dim() > 1 else (1, parameter.shape[0])
                )
                limit = (6.0 / (fan_in + fan_out)) ** 0.5
                draw = torch.rand(parameter.shape, generator=generator, dtype=torch.float64)
                parameter.copy_((2.0 * draw - 1.0) * limit)

    @abstractmethod
    def last_state(self, prepared_windows: Tensor) -> Tensor:
        """Hidden state after the window, (..., N, C) -> (..., H)."""

    def forward(self, prepared_windows: Tensor) -> Tensor:
        """Lateral velocity from the hidden state after the window.

        From standardised windows, (..., N, C), to (...) [m/s].
        """
        output = (self.last_state(prepared_windows) * self.output_weight).sum(-1) + self.output_bias
        return output * self.output_scale + self.output_mean

    def recursion(self) -> Recursion:
        """The compiled recursion."""
        gates = self.n_gates
        settings = self.settings
        mean = float(self.output_mean)
        scale = float(self.output_scale)
        return Recursion(
            loop,
            lambda number: (gates, settings.n_states, settings.window, number(mean), number(scale)),
        )


class RecurrentEstimator(HiddenStateEstimator, WindowedEstimator):
    """A recurrent benchmark as an estimator, with the inputs of the KS-NN."""

    n_states: int = setting(5, "size of the hidden state", least=1, most=MAX_WIDTH)
    template = "window_recurrent"

    def c_values(self) -> dict[str, Any]:
        """Weights and sizes of the network for the C template."""
        weights = {name: values.astype(np.float64) for name, values in self.weights().items()}
        gates, states, _ = weights["input_weight"].shape
        return {**weights, "window": self.settings.window, "gates": gates, "states": states}
