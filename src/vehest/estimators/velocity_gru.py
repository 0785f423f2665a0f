"""Gated recurrent unit for velocities from all samples so far: Srinivasan et al. 2020."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn
from torch.nn import functional

from vehest.declared import setting
from vehest.estimators.networks.velocity_recurrent import (
    TRIAL,
    RecurrentVelocityEstimator,
    State,
    VelocityNetwork,
)


class VelocityGruNetwork(VelocityNetwork):
    """One layer of gated recurrent units, a dense read-out, a leaky rectifier.

    h⁺ = GRU(h, x),  y = leaky_relu(W d(h⁺) + b)         x, y standardised, d dropout

    Source: Srinivasan et al., End-to-end velocity estimation for autonomous racing, IEEE RA-L 5
    (4), 2020.
    """

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.negative_slope = settings.negative_slope
        self.recurrent = nn.GRU(len(settings.inputs), settings.n_states, batch_first=True)
        self.read_out = nn.Linear(settings.n_states, len(settings.outputs))

    def start(self, velocities: Tensor) -> State:
        """A hidden state of zero; the network has no use for velocities to start from."""
        return (velocities.new_zeros(1, len(velocities), self.recurrent.hidden_size),)

    def advance(self, inputs: Tensor, state: State, mask: Tensor | None) -> tuple[Tensor, State]:
        """Run over the samples.

        Parameters
        ----------
        inputs : Tensor
            Standardised, (B, T, C).
        state : State
            Hidden state before the first sample, (1, B, H).
        mask : Tensor | None
            Dropout's factors of the hidden state before the read-out; None: no dropout.

        Returns
        -------
        tuple
            Standardised velocities (B, T, outputs), and the state after the last sample.
        """
        hidden, last = self.recurrent(inputs, state[0])
        outputs = self.read_out(hidden if mask is None else hidden * mask)
        return functional.leaky_relu(outputs, self.negative_slope), (last,)


class VelocityGru(RecurrentVelocityEstimator):
    """GRU of Srinivasan et al. 2020.

    A known ``initial_state`` is ignored, since no part of the network's state is a velocity.
    """

    name = "velocity_gru"
    title = "Velocity GRU"
    trials = (TRIAL,)
    network_type = VelocityGruNetwork
    dropout: float = setting(
        0.075,
        "share of the hidden state that is hidden from the read-out in training",
        least=0.0,
        below=1.0,
    )
    negative_slope: float = setting(
        0.3,
        "of the leaky rectifier after the read-out; assumed (the default of Keras)",
        above=0.0,
        most=1.0,
    )


ESTIMATOR = VelocityGru  # class by which the registry finds the family
