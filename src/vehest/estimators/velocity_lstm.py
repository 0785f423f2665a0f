"""Long short-term memory with fed-back velocities, the robust LSTM of Bou Ghosn et al. 2023."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vehest.data.errors import ConfigurationError
from vehest.estimators.networks.velocity_recurrent import RecurrentVelocityEstimator, State, VelocityNetwork, VelocityNetworkSettings


@dataclass(frozen=True)
class VelocityLstmSettings(VelocityNetworkSettings):
    """Settings of the LSTM.

    Args:
        rate_hz: sampling rate [Hz].
        inputs: measured channels that the network sees.
        outputs: of ``vx``, ``vy`` and ``yaw_rate``, what it estimates.
        n_states: size of the hidden state; 64 is assumed.
        dropout: share of the hidden state that is hidden from the dense layers in training; that of the GRU is assumed.
        n_dense: neurons of the hidden dense layer; 64 is assumed.
    """

    dropout: float = 0.075
    n_dense: int = 64

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_dense < 1:
            raise ConfigurationError(f"estimator.n_dense must be at least 1, not {self.n_dense}")


class VelocityLstmNetwork(VelocityNetwork):
    """An LSTM over the sensors, and dense layers over its hidden state and the velocities estimated one sample before.

    h⁺, c⁺ = LSTM(h, c, x),  y⁺ = W₂ relu(W₁ [d(h⁺), y] + b₁) + b₂         x, y standardised, d dropout

    The structure is the paper's as Węgrzynowski et al. 2024 describe it; one hidden dense layer, its rectifier, dropout and all
    sizes are assumed.

    Source: Bou Ghosn et al., Robust LSTM-based vehicle velocity observer for regular and near-limits applications, IEEE IV 2023.
    """

    def __init__(self, settings: VelocityLstmSettings) -> None:
        super().__init__(settings)
        self.recurrent = nn.LSTM(len(settings.inputs), settings.n_states, batch_first=True)
        self.dense = nn.Linear(settings.n_states + len(settings.outputs), settings.n_dense)
        self.read_out = nn.Linear(settings.n_dense, len(settings.outputs))

    def start(self, velocities: Tensor) -> State:
        """Hidden state and cell of zero, and the velocities as the estimate before the first sample."""
        zeros = velocities.new_zeros(1, len(velocities), self.recurrent.hidden_size)
        return (zeros, zeros, (velocities - self.output_mean) / self.output_scale)

    def advance(self, inputs: Tensor, state: State, mask: Tensor | None) -> tuple[Tensor, State]:
        """Run over the samples."""
        hidden, (last, cell) = self.recurrent(inputs, (state[0], state[1]))
        n_states = self.recurrent.hidden_size
        driven = nn.functional.linear(hidden if mask is None else hidden * mask, self.dense.weight[:, :n_states], self.dense.bias)
        outputs = _feed_back(driven, state[2], self.dense.weight[:, n_states:].t(), self.read_out.weight.t(), self.read_out.bias)
        return outputs, (last, cell, outputs[:, -1])


def _feed_back(driven: Tensor, previous: Tensor, weight: Tensor, read_out: Tensor, bias: Tensor) -> Tensor:
    """y⁺ = read_out relu(driven + weight y) + bias, sample after sample: (B, T, D), (B, O), (O, D), (D, O), (O,) -> (B, T, O)."""
    outputs: list[Tensor] = []
    for step in driven.unbind(1):
        previous = torch.addmm(bias, torch.relu(torch.addmm(step, previous, weight)), read_out)
        outputs.append(previous)
    return torch.stack(outputs, dim=1)


class VelocityLstm(RecurrentVelocityEstimator):
    """Robust LSTM of Bou Ghosn et al. 2023; the previous estimate starts from ``initial_state``, else from measured velocities."""

    name = "velocity_lstm"
    title = "Velocity LSTM"
    settings_type = VelocityLstmSettings
    settings: VelocityLstmSettings

    def _new_network(self) -> VelocityLstmNetwork:
        return VelocityLstmNetwork(self.settings)


ESTIMATOR = VelocityLstm
