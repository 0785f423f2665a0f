"""Unscented filter of a single track with a network's sideslip angle among its measurements.

Base of such methods.

    sample --network--> β_DD, its variance (and process noise) --`with_pseudo`--> measurement m + 1
    recordings --pseudo_measurements--> (T,) each --`DugoffFilter.filtered`--> states

A subclass says what the network returns (`pseudo_of`) and how it is trained (`fit_network`), given
the filter that `DugoffUkf.identify` has fitted.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.declared import setting
from vehest.estimators.base import FitData, FitRecord
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.filtering.dugoff_filter import CHANNELS, PseudoMeasurement
from vehest.estimators.networks.sample_network import (
    INPUTS,
    NORMALISATION_SUFFIXES,
    SampleNetworkEstimator,
)
from vehest.training.context import FitContext

MIN_VARIANCE = 1e-6
"""Usual ε of Bertipaglia et al. 2024, Eq. 6 [rad²]: a deviation of 0.057°."""


class NetworkUkf(SampleNetworkEstimator, DugoffUkf):
    """A `DugoffUkf` that also measures a network's sideslip angle of the same sample.

    Source: Bertipaglia et al. 2024, Eq. 4.

    Filter and network are fitted in one training: the filter first, as it would be alone with the
    same seed. A network needs every sample, so that gaps are refused.
    """

    skippable = ()
    least_variance: float = setting(
        MIN_VARIANCE,
        "added to the variance of the network's angle, so that no filter assumes it to be exact; "
        "ε of Eq. 6",
        unit="rad²",
        positive=True,
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.network_inputs = INPUTS[self.inputs]
        self.channels = tuple(dict.fromkeys((*CHANNELS[self.inputs], *self.network_inputs)))

    @abstractmethod
    def pseudo_of(self, inputs: FloatArray) -> PseudoMeasurement:
        """Evaluate the network: sideslip angle, its variance and process noise for T samples.

        Parameters
        ----------
        inputs : array
            Of ``network_inputs``, as measured (T, C).
        """

    @abstractmethod
    def fit_network(
        self, data: FitData, training: Any, context: FitContext, index: int
    ) -> FitRecord:
        """Train the network, given the fitted filter."""

    @property
    def variant(self) -> str:
        """Identifier with the inputs, the gate and the normalisation of the network's inputs."""
        return self.inputs + self.gate_suffix + NORMALISATION_SUFFIXES[self.normalisation]

    @property
    def n_parameters(self) -> int:
        """Number of weights and biases of the network and of values that the filter's fit finds."""
        return super().n_parameters + self.n_identified

    def fit_member(
        self, data: FitData, training: Any, context: FitContext, index: int
    ) -> FitRecord:
        """Fit the filter, then the network."""
        of_filter = self.identify(
            data, training.identification, FitContext(should_stop=context.should_stop)
        )
        # the network must see the filter that the whole identification finds
        if of_filter.interrupted:
            return FitRecord({}, {"best_epoch": 0}, True)
        record = self.fit_network(data, training, context, index)
        seconds = of_filter.metrics["train_seconds"]
        levels = {
            name: value for name, value in of_filter.metrics.items() if name.startswith("noise_")
        }
        metrics = {**record.metrics, **levels, "identification_seconds": seconds}
        metrics["train_seconds"] = record.metrics["train_seconds"] + seconds
        return FitRecord(record.history, metrics, record.interrupted)

    def network_samples(self, samples: FloatArray) -> FloatArray:
        """Columns of samples (T, n) of ``channels`` that the network reads, (T, C)."""
        return samples[:, [self.channels.index(name) for name in self.network_inputs]]

    def pseudo_measurements(self, recordings: Sequence[Recording]) -> list[PseudoMeasurement]:
        """Evaluate the network on each recording."""
        return [
            self.pseudo_of(self.network_samples(recording.stack(self.channels)))
            for recording in recordings
        ]

    def with_pseudo(
        self, sample: FloatArray, measurement: FloatArray, noise: FloatArray, memory: dict[str, Any]
    ) -> tuple[FloatArray, FloatArray]:
        """Add the network's angle and its variance; its process noise is that of the next step.

        Parameters
        ----------
        sample : array
            Of ``channels``, (n,).
        measurement, noise : array
            Of the sensors, (4,) and (4, 4).
        memory : dict
            Its ``noise`` becomes the network's process noise (2, 2), where there is one.

        Returns
        -------
        tuple
            Measurement (5,) and covariance (5, 5), diagonal.
        """
        added = self.pseudo_of(self.network_samples(sample[None]))
        if added.process is not None:
            memory["noise"] = np.diag(added.process[0])
        return np.append(measurement, added.sideslip), np.diag(
            np.append(np.diagonal(noise), added.variance)
        )

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Weights of the filter, ``filter.…``, and of the network, ``network.…``."""
        parts = {"filter": DugoffUkf.weights(self), "network": SampleNetworkEstimator.weights(self)}
        return {
            f"{part}.{name}": values
            for part, weights_of_part in parts.items()
            for name, values in weights_of_part.items()
        }

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set weights of the filter and of the network."""
        parts: dict[str, dict[str, np.ndarray[Any, Any]]] = {"filter": {}, "network": {}}
        for name, values in weights.items():
            part, _, weight_name = name.partition(".")
            if part not in parts:
                raise DataError(
                    f"weights of '{self.name}' do not fit its settings: '{name}' is unknown"
                )
            parts[part][weight_name] = values
        DugoffUkf.load_weights(self, parts["filter"])
        SampleNetworkEstimator.load_weights(self, parts["network"])

    def references(self, training: Any, channels: Collection[str]) -> tuple[str, ...]:
        """Reference channels that the fit reads: those of the network."""
        return self.learns_from

    def unmatched_patterns(self, training: Any, recordings: Collection[str]) -> tuple[str, ...]:
        """Overrides that the filter's identification needs."""
        patterns = super().unmatched_patterns(training.identification, recordings)
        return tuple(
            pattern.replace("training.", "training.identification.", 1) for pattern in patterns
        )

    def c_values(self) -> dict[str, Any]:
        """Values of filter and network for the C template."""
        values = {**super().c_values(), **self.network.c_values()}
        return values | {
            "network": True,
            "seen": self.network_inputs,
            "least_variance": self.least_variance,
            "m": values["m"] + 1,
        }
