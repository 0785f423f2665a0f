"""Long short-term memory, the benchmark of Kong et al. 2022 with the inputs of the KS-NN."""

from __future__ import annotations

import torch
from torch import Tensor

from vehest.estimators.networks.recurrent import TRIAL, RecurrentEstimator, RecurrentNetwork


class LstmNetwork(RecurrentNetwork):
    """Long short-term memory with one bias a gate.

    i, f, o = σ(W x + U h + b),  g = tanh(W_g x + U_g h + b_g)
    c⁺ = f ∘ c + i ∘ g,  h⁺ = o ∘ tanh(c⁺)

    Source: Hochreiter & Schmidhuber 1997; Kong et al., World Electr. Veh. J. 13 (1), 2022.
    """

    n_gates = 4  # number of gates of the cell

    def last_state(self, prepared_windows: Tensor) -> Tensor:
        """Hidden state after the window, from zero.

        Parameters
        ----------
        prepared_windows : Tensor
            Scaled windows (..., N, C).

        Returns
        -------
        Tensor
            (..., H). The cell starts from zero too; gates are in the order i, f, o, g.
        """
        driven = (
            torch.einsum("...c,ghc->...gh", prepared_windows, self.input_weight) + self.gate_bias
        )
        state = torch.zeros_like(driven[..., 0, 0, :])
        cell = torch.zeros_like(state)
        for k in range(prepared_windows.shape[-2]):
            gates = driven[..., k, :, :] + torch.einsum("...i,ghi->...gh", state, self.state_weight)
            admit, keep, show = torch.sigmoid(gates[..., :3, :]).unbind(-2)
            cell = keep * cell + admit * torch.tanh(gates[..., 3, :])
            state = show * torch.tanh(cell)
        return state


class Lstm(RecurrentEstimator):
    """LSTM benchmark."""

    name = "lstm"
    title = "LSTM"
    trials = (TRIAL,)
    network_type = LstmNetwork
    style = "#c792dd", "dashed", "v"


ESTIMATOR = Lstm  # class by which the registry finds the family
