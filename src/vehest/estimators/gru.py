"""Gated recurrent unit with the inputs of the KS-NN.

Source: the benchmark E1 of Gräber et al. 2019.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vehest.estimators.networks.recurrent import TRIAL, RecurrentEstimator, RecurrentNetwork


class GruNetwork(RecurrentNetwork):
    """Gated recurrent unit with one bias a gate.

    r = σ(W_r x + U_r h + b_r),  z = σ(W_z x + U_z h + b_z)
    n = tanh(W_n x + r ∘ (U_n h) + b_n),  h⁺ = (1 - z) ∘ n + z ∘ h

    Source: Cho et al. 2014; Gräber et al., IEEE T-IV 4 (1), 2019.
    """

    n_gates = 3  # number of gates of the cell

    def last_state(self, prepared_windows: Tensor) -> Tensor:
        """Hidden state after the window, from zero.

        Parameters
        ----------
        prepared_windows : Tensor
            Scaled windows (..., N, C).

        Returns
        -------
        Tensor
            (..., H). The input's part of all gates is computed for all samples at once; gates are
            in the order r, z, n.
        """
        driven = (
            torch.einsum("...c,ghc->...gh", prepared_windows, self.input_weight) + self.gate_bias
        )
        state = torch.zeros_like(driven[..., 0, 0, :])
        for k in range(prepared_windows.shape[-2]):
            recurrent = torch.einsum("...i,ghi->...gh", state, self.state_weight)
            step = driven[..., k, :, :]
            reset = torch.sigmoid(step[..., 0, :] + recurrent[..., 0, :])
            update = torch.sigmoid(step[..., 1, :] + recurrent[..., 1, :])
            candidate = torch.tanh(step[..., 2, :] + reset * recurrent[..., 2, :])
            state = candidate + update * (state - candidate)
        return state


class Gru(RecurrentEstimator):
    """GRU benchmark."""

    name = "gru"
    title = "GRU"
    trials = (TRIAL,)
    network_type = GruNetwork
    style = "#8e24aa", "solid", "D"


ESTIMATOR = Gru  # class by which the registry finds the family
