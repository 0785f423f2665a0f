"""Feed-forward network from the measurements of one instant to the sideslip angle.

Source: the data-driven method of Bertipaglia et al. 2024.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from vehest.constants import FloatArray
from vehest.declared import setting
from vehest.estimators.base import FitData, FitRecord, Trial
from vehest.estimators.kernels.sample_network import squared_error
from vehest.estimators.networks.sample_network import (
    INPUTS,
    NORMALISATION_SUFFIXES,
    SampleNetwork,
    SampleNetworkEstimator,
    clip_sideslip,
)
from vehest.training.context import FitContext
from vehest.training.samples import SampleSettings


class SideslipFfnn(SampleNetworkEstimator):
    """Network of two hidden layers with rectifiers and dropout.

    It is trained on the mean squared error of the sideslip angle with early stopping.

    Source: Bertipaglia, Alirezaei, Happee & Shyrokau, An unscented Kalman filter-informed neural
    network for vehicle sideslip angle estimation, IEEE Transactions on Vehicular Technology 73 (9),
    2024, Section IV-C.
    """

    name = "sideslip_ffnn"
    title = "Feed-forward network"
    trials = (
        Trial(
            8,
            "feed-forward network over single samples; a minute",
            "estimator.inputs=imu training.phase.max_epochs=100",
        ),
    )
    channels: tuple[str, ...]  # type: ignore[misc]  # depends on the settings
    training_type = SampleSettings
    ignores_initial_state = True
    template = "sideslip_ffnn"
    inputs: Literal["full", "imu"] = setting(
        "full", "full: with the forces of all tyres; imu: without"
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.channels = self.network_inputs = INPUTS[self.inputs]

    def new_network(self) -> SampleNetwork:
        """An untrained network from the inputs of a sample to its sideslip angle."""
        return SampleNetwork(len(self.channels), self.hidden, 1)

    @property
    def variant(self) -> str:
        """Identifier with the inputs and their normalisation."""
        return self.inputs + NORMALISATION_SUFFIXES[self.normalisation]

    @property
    def full_title(self) -> str:
        """Title with the inputs."""
        return f"{self.title}{', without tyre forces' if self.inputs == 'imu' else ''}"

    def fit_member(
        self, data: FitData, training: SampleSettings, context: FitContext, index: int
    ) -> FitRecord:
        """Train on samples in random order."""
        return self.fit_samples(data, training, squared_error, context, index, [self.fit_seed])

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, Any], Any]:
        """Estimate v = u tan β [m/s] for each sample by itself.

        Parameters
        ----------
        samples : array
            Of ``channels``, (T, C); there is no state.
        """
        sideslip = self.sideslip(samples)
        return {"vy": samples[:, self.channels.index("vx")] * np.tan(sideslip)}, None

    def sideslip(self, inputs: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Sideslip angle (T,) [rad] of measured inputs (T, C) in the order of ``channels``."""
        return clip_sideslip(self.network.outputs(inputs)[0, :, 0] * float(self.network.unit))

    def c_values(self) -> dict[str, Any]:
        """Values of the network for the C template."""
        return self.network.c_values()


ESTIMATOR = SideslipFfnn  # class by which the registry finds the family
