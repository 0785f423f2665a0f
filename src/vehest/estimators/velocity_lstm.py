"""Long short-term memory with fed-back velocities, the robust LSTM of Bou Ghosn et al. 2023."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from vehest.declared import MAX_WIDTH, setting
from vehest.estimators.networks.velocity_recurrent import (
    TRIAL,
    RecurrentVelocityEstimator,
    State,
    VelocityNetwork,
)


class VelocityLstmNetwork(VelocityNetwork):
    """An LSTM over the sensors, and dense layers over its hidden state and the last velocities.

    h⁺, c⁺ = LSTM(h, c, x),  y⁺ = W₂ relu(W₁ [d(h⁺), y] + b₁) + b₂
    with x, y standardised, d dropout

    The structure is the paper's as Węgrzynowski et al. 2024 describe it; one hidden dense layer,
    its rectifier, dropout and all sizes are assumed.

    Source: Bou Ghosn et al., Robust LSTM-based vehicle velocity observer for regular and
    near-limits applications, IEEE IV 2023.
    """

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.recurrent = nn.LSTM(len(settings.inputs), settings.n_states, batch_first=True)
        self.dense = nn.Linear(settings.n_states + len(settings.outputs), settings.n_dense)
        self.read_out = nn.Linear(settings.n_dense, len(settings.outputs))

    def start(self, velocities: Tensor) -> State:
        """Hidden state and cell of zero, and the velocities as the estimate before."""
        zeros = velocities.new_zeros(1, len(velocities), self.recurrent.hidden_size)
        return (zeros, zeros, (velocities - self.output_mean) / self.output_scale)

    def advance(self, inputs: Tensor, state: State, mask: Tensor | None) -> tuple[Tensor, State]:
        """Run over the samples.

        The LSTM does not depend on the velocities, hence it runs over the whole sequence first;
        only the dense layers, which do, are computed sample by sample.

        Parameters
        ----------
        inputs : Tensor
            Standardised, (B, T, C).
        state : State
            Hidden state and cell (1, B, H) before the first sample, and the velocities estimated
            for the sample before, standardised (B, outputs).
        mask : Tensor | None
            Dropout's factors of the hidden state before the dense layer; None: no dropout.

        Returns
        -------
        tuple
            Standardised velocities (B, T, outputs), and the state after the last sample.
        """
        hidden, (last, cell) = self.recurrent(inputs, (state[0], state[1]))
        n_states = self.recurrent.hidden_size
        driven = nn.functional.linear(
            hidden if mask is None else hidden * mask,
            self.dense.weight[:, :n_states],
            self.dense.bias,
        )
        by_previous = self.dense.weight[:, n_states:].t()
        read_out = self.read_out.weight.t()
        bias = self.read_out.bias
        previous = state[2]
        outputs = []
        for step in driven.unbind(1):
            previous = torch.addmm(
                bias, torch.relu(torch.addmm(step, previous, by_previous)), read_out
            )
            outputs.append(previous)
        return torch.stack(outputs, dim=1), (last, cell, previous)


class VelocityLstm(RecurrentVelocityEstimator):
    """Robust LSTM of Bou Ghosn et al. 2023.

    The previous estimate starts from ``initial_state``, else from measured velocities.
    """

    name = "velocity_lstm"
    title = "Velocity LSTM"
    trials = (TRIAL,)
    network_type = VelocityLstmNetwork
    n_states: int = setting(64, "size of the hidden state; assumed", least=1, most=MAX_WIDTH)
    dropout: float = setting(
        0.075,
        "share of the hidden state that is hidden from the dense layers in training; assumed",
        least=0.0,
        below=1.0,
    )
    n_dense: int = setting(
        64, "neurons of the hidden dense layer; assumed", least=1, most=MAX_WIDTH
    )


ESTIMATOR = VelocityLstm  # class by which the registry finds the family
