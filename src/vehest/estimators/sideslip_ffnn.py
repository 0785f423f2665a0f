"""Feed-forward network from the measurements of one instant to the sideslip angle: the data-driven method of Bertipaglia et al. 2024."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, FitData, FitRecord, Stepper, required
from vehest.estimators.kernels.sample_network import squared_error
from vehest.estimators.networks.sample_network import (
    NAMED,
    SampleNetwork,
    SampleNetworkSettings,
    believed,
    learnt_samples,
    network_with_weights,
)
from vehest.estimators.phase_records import record_of_phases
from vehest.training.context import FitContext
from vehest.training.samples import SampleSettings, sample_phase
from vehest.training.sequences import train_phases


class SideslipFfnn(Estimator):
    """Two hidden layers with rectifiers and dropout, trained on the mean squared error of the sideslip angle with early stopping.

    Source: Bertipaglia, Alirezaei, Happee & Shyrokau, An unscented Kalman filter-informed neural network for vehicle sideslip angle
    estimation, IEEE Transactions on Vehicular Technology 73 (9), 2024, Section IV-C.
    """

    name = "sideslip_ffnn"
    title = "Feed-forward network"
    channels: tuple[str, ...]  # type: ignore[misc]  # depends on the settings
    settings_type = SampleNetworkSettings
    training_type = SampleSettings
    ignores_initial_state = True
    settings: SampleNetworkSettings

    def __init__(self, settings: SampleNetworkSettings) -> None:
        super().__init__(settings)
        self.channels = settings.channels
        self.network = self._new_network()
        self._seed = 0

    def _new_network(self) -> SampleNetwork:
        return SampleNetwork(len(self.channels), self.settings.hidden, 1)

    @property
    def variant(self) -> str:
        """Which inputs it sees, and how they are scaled."""
        return self.settings.inputs + NAMED[self.settings.normalisation]

    @property
    def full_title(self) -> str:
        """With its inputs."""
        return f"{self.title}{', without tyre forces' if self.settings.inputs == 'imu' else ''}"

    @property
    def n_parameters(self) -> int:
        """Weights and biases; ranges taken from the data do not count."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    def seed(self, seed: int) -> None:
        """Seed of the initial weights, of the order of samples and of dropout."""
        self._seed = seed

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Train members one after the other."""
        return [member._fit(data, training, context, index) for index, member in enumerate(members) if isinstance(member, SideslipFfnn)]

    def _fit(self, data: FitData, training: SampleSettings, context: FitContext, index: int) -> FitRecord:
        raw, judged = (learnt_samples(part, self.channels, self.name) for part in (data.train, data.validation))
        network = self.network = self._new_network().to(getattr(torch, training.dtype))
        network.scale(*raw, self.settings.normalisation)
        network.reset([torch.Generator().manual_seed(self._seed)])
        train, validation = network.samples(*raw), network.samples(*judged)
        phase = sample_phase(
            "samples",
            network,
            training.phase,
            training.batch_size,
            len(train.targets),
            1,
            lambda draw: network.losses(train, draw, self.settings.dropout, squared_error) * network.unit**2,
            lambda: network.judged(validation, squared_error) * network.unit**2,
        )
        (record,) = train_phases([phase], self._seed, context, index, training.checkpoint_seconds)
        return record_of_phases([record])

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        return self._wrapped(recording, recording["vx"] * np.tan(self.sideslip(recording.stack(self.channels))))

    def sideslip(self, inputs: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Of measured inputs (T, C) in the order of ``channels``: (T,) [rad]."""
        return believed(self.network.said(inputs)[0, :, 0] * float(self.network.unit))

    def online(self) -> SideslipFfnnStepper:
        """A stepper; it has no state."""
        return SideslipFfnnStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Parameters and ranges of the network."""
        return {name: tensor.detach().numpy().copy() for name, tensor in self.network.state_dict().items()}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take parameters and ranges back."""
        self.network = network_with_weights(self._new_network(), weights, self.name)


class SideslipFfnnStepper(Stepper):
    """Each sample by itself."""

    def __init__(self, estimator: SideslipFfnn) -> None:
        self._estimator = estimator

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s] and sideslip angle [rad] at the time of the sample."""
        estimator = self._estimator
        values = np.array([required(sample, estimator.channels)])
        sideslip = float(estimator.sideslip(values)[0])
        return {"vy": float(values[0, estimator.channels.index("vx")]) * float(np.tan(sideslip)), "sideslip": sideslip}


ESTIMATOR = SideslipFfnn
