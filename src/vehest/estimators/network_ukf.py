"""What filters share that take a network's word for the sideslip angle: settings, identification, filtering, running online."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, FitData, FitRecord, Stepper
from vehest.estimators.dugoff_ukf import CHANNELS, MOST_TOGETHER, DugoffUkf, DugoffUkfSettings, samples_of
from vehest.estimators.filtering.single_track import checked_sample
from vehest.estimators.filtering.track_filter import Over, TrackFilter, error_over, groups_of, padded
from vehest.estimators.networks.sample_network import (
    INPUTS,
    NAMED,
    Normalisation,
    SampleNetwork,
    checked_layers,
    network_with_weights,
    require_normalisation,
)
from vehest.estimators.references import reference_sideslip
from vehest.filters.gating import Gate, in_words, suffix
from vehest.filters.gaussian import Gaussian
from vehest.training.context import FitContext
from vehest.vehicle.dugoff import TRACK_STATES

LEAST_VARIANCE = 1e-6
"""Added to the variance of a network's word [rad²], so that no filter takes it for the truth; ε of Bertipaglia et al. 2024, Eq. 6."""


@dataclass(frozen=True)
class NetworkUkfSettings(DugoffUkfSettings):
    """Settings of a filter with a network: those of the filter, and of the network.

    Args:
        hidden: widths of the network's hidden layers.
        dropout: share of hidden values that are hidden in training.
        normalisation: how inputs are scaled, see `SampleNetwork.scale`.

    Raises:
        ConfigurationError: a value that makes no sense.
    """

    hidden: tuple[int, int] = (250, 125)
    dropout: float = 0.2
    normalisation: Normalisation = "range"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "hidden", checked_layers(self.hidden, self.dropout))
        require_normalisation(self.normalisation)

    @property
    def of_filter(self) -> DugoffUkfSettings:
        """The filter's part of them."""
        return DugoffUkfSettings(**{entry.name: getattr(self, entry.name) for entry in fields(DugoffUkfSettings)})


class Word(NamedTuple):
    """What a network says of T samples.

    Attributes:
        sideslip: β_DD, (T,) [rad].
        variance: of the measurement that the filter takes it for, (T,) [rad²].
        process: variances of a step of lateral velocity and yaw rate, (T, 2) [m²/s², rad²/s²]; none: the filter's own.
    """

    sideslip: FloatArray
    variance: FloatArray
    process: FloatArray | None = None


class NetworkUkf(Estimator):
    """A `DugoffUkf` that also measures the sideslip angle that a network derives from the same sample (Bertipaglia et al. 2024, Eq. 4).

    Filter and network are fitted in one training: the filter first, as it would be alone with the same seed. A network cannot do without
    a sample, so that gaps are refused.
    """

    settings_type = NetworkUkfSettings
    channels: tuple[str, ...]  # type: ignore[misc]  # depends on the settings
    settings: NetworkUkfSettings

    def __init__(self, settings: NetworkUkfSettings) -> None:
        super().__init__(settings)
        self.inputs = INPUTS[settings.inputs]
        self.channels = tuple(dict.fromkeys((*CHANNELS[settings.inputs], *self.inputs)))
        self.model = DugoffUkf(settings.of_filter)
        self.network = self._new_network()
        self._seed = 0

    @abstractmethod
    def _new_network(self) -> SampleNetwork:
        """A network to train or to load weights into."""

    @abstractmethod
    def word(self, inputs: FloatArray) -> Word:
        """What the network says of measured inputs, (T, C) in the order of ``inputs``."""

    @abstractmethod
    def _fit_network(self, data: FitData, training: Any, context: FitContext, index: int) -> FitRecord:
        """Train the network, given the fitted filter."""

    @property
    def variant(self) -> str:
        """Which inputs it sees, and the gate."""
        return self.settings.inputs + suffix(self.settings.gate) + NAMED[self.settings.normalisation]

    @property
    def full_title(self) -> str:
        """With its inputs, and the gate."""
        return f"{self.title}, {'with' if self.settings.inputs == 'full' else 'without'} tyre forces{in_words(self.settings.gate)}"

    @property
    def n_parameters(self) -> int:
        """Weights and biases of the network, and what the filter's fit finds."""
        return self.model.n_parameters + sum(parameter.numel() for parameter in self.network.parameters())

    def seed(self, seed: int) -> None:
        """Seed of the filter's fit, of initial weights, of batches and of dropout."""
        self._seed = seed
        self.model.seed(seed)

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Fit members one after the other."""
        return [member._fit(data, training, context, index) for index, member in enumerate(members) if isinstance(member, NetworkUkf)]

    def _fit(self, data: FitData, training: Any, context: FitContext, index: int) -> FitRecord:
        of_filter = self.model.fit(data, training.identification, FitContext(should_stop=context.should_stop))
        if of_filter.interrupted:  # nothing learnt yet: the network must see the filter that the whole identification finds
            return FitRecord({}, {"best_epoch": 0}, True)
        record = self._fit_network(data, training, context, index)
        seconds = of_filter.metrics["train_seconds"]
        found = {name: value for name, value in of_filter.metrics.items() if name.startswith("noise_")}
        metrics = {**record.metrics, **found, "identification_seconds": seconds}
        metrics["train_seconds"] = record.metrics["train_seconds"] + seconds
        return FitRecord(record.history, metrics, record.interrupted)

    def track_filter(self) -> TrackFilter:
        """The filter, with a sideslip angle among its measurements."""
        return TrackFilter(self.model.track(sees_sideslip=True))

    def sensor_noise(self) -> tuple[Tensor, Tensor]:
        """Covariance of a step, (2, 2), and those of what sensors measure where the car is linear and where it is not, (2, 4, 4)."""
        return self.model.noise_covariances(self.model.levels)

    def taken(self, samples: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Samples (T, n) of ``channels`` as the filter takes them: measurements of sensors (T, 4), inputs (T, 3)."""
        return samples_of(samples[:, : len(CHANNELS[self.settings.inputs])])

    def trusts(self, ay: FloatArray, before: bool = False) -> NDArray[np.bool_]:
        """Where forces are trusted, (T,); see `in_nonlinear_range`."""
        return self.model.trusts_forces(ay, before)

    def seen(self, samples: FloatArray) -> FloatArray:
        """What the network sees of samples (T, n) of ``channels``, (T, C)."""
        return samples[:, [self.channels.index(name) for name in self.inputs]]

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        return self._estimate_all([recording], [initial_state])[0]

    def _estimate_all(self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]) -> list[Estimate]:
        """Recordings of similar length are filtered together."""
        estimates: dict[int, Estimate] = {}
        words = [self.word(self.seen(recording.stack(self.channels))) for recording in recordings]
        for rows, (mean, covariance, nis, dof) in self.filtered(recordings, words, states, self.model.gate()):
            for place, row in enumerate(rows):
                n = len(recordings[row])
                others = {"yaw_rate": mean[place, :n, 1].copy(), "nis": nis[place, :n].copy(), "nis_dof": dof[place, :n].copy()}
                estimates[row] = self._wrapped(
                    recordings[row], mean[place, :n, 0].copy(), covariance[place, :n].copy(), TRACK_STATES, **others
                )
        return [estimates[row] for row in range(len(recordings))]

    def filtered(
        self,
        recordings: Sequence[Recording],
        words: Sequence[Word],
        states: Sequence[Mapping[str, float] | None] | None = None,
        gate: Gate | None = None,
    ) -> Iterator[tuple[list[int], tuple[FloatArray, FloatArray, FloatArray, FloatArray]]]:
        """Filter recordings given what the network says of each; networks learn, and are judged meanwhile, without a gate.

        Returns:
            Rows of recordings, and their means (B, T, 2), covariances (B, T, 2, 2), normalised innovations squared (B, T) and how many
            numbers were measured (B, T), padded to the longest.
        """
        model = self.track_filter()
        process, sensors = self.sensor_noise()
        for rows in groups_of([len(recording) for recording in recordings], MOST_TOGETHER):
            parts = [self.taken(recordings[row].stack(self.channels)) for row in rows]
            said = [words[row] for row in rows]
            measurements = padded([np.column_stack([part[0], own.sideslip]) for part, own in zip(parts, said, strict=True)], np.nan)
            trusted = np.stack([self.trusts(part) for part in measurements[..., 0]])
            variance = padded([own.variance[:, None] for own in said], None)[..., 0]
            noise = observation_noise(sensors, torch.as_tensor(trusted), torch.as_tensor(variance))
            steps_noise = process
            if said[0].process is not None:
                steps_noise = torch.diag_embed(torch.as_tensor(padded([own.process for own in said], None)))  # type: ignore[misc]
            inputs = torch.as_tensor(padded([part[1] for part in parts], None))
            given = None if states is None else [states[row] for row in rows]
            with torch.no_grad():
                initial = model.start(inputs[:, 0], given)
                steps = model.filtered(torch.as_tensor(measurements), inputs, steps_noise, noise, initial, gate).steps
                nis = torch.linalg.solve_ex(steps.innovation_covariance, steps.innovation).result.mul(steps.innovation).sum(-1)
            outcome = (*steps.filtered, nis, steps.measured.sum(-1).double())
            yield rows, tuple(part.numpy() for part in outcome)  # type: ignore[misc]

    def mean_squared_error(
        self, recordings: Sequence[Recording], words: Sequence[Word], skip_seconds: float = 0.0, over: Over = "samples"
    ) -> float:
        """Of the filtered sideslip angle [rad²], over samples fast enough for the model; see `error_over`."""
        skip = round(skip_seconds * self.settings.rate_hz)
        sums: list[tuple[float, int]] = []
        for rows, (mean, *_) in self.filtered(recordings, words):
            for row, states in zip(rows, mean, strict=True):
                recording = recordings[row]
                vx = recording["vx"]
                error = np.arctan2(states[: len(vx), 0], vx) - reference_sideslip(recording)
                counted = vx >= self.settings.minimum_speed
                counted[:skip] = False
                sums.append((float(np.square(error[counted]).sum()), int(counted.sum())))
        return error_over(sums, over)

    def online(self) -> NetworkUkfStepper:
        """A stepper that starts from the first sample it sees."""
        return NetworkUkfStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Those of the filter and of the network."""
        of_network = {f"network.{name}": tensor.detach().numpy().copy() for name, tensor in self.network.state_dict().items()}
        return {**{f"filter.{name}": values for name, values in self.model.weights().items()}, **of_network}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take them back."""
        parts: dict[str, dict[str, np.ndarray[Any, Any]]] = {"filter": {}, "network": {}}
        for name, values in weights.items():
            part, _, own = name.partition(".")
            if part not in parts:
                raise DataError(f"weights of '{self.name}' do not fit its settings: '{name}' is unknown")
            parts[part][own] = values
        self.model.load_weights(parts["filter"])
        self.network = network_with_weights(self._new_network(), parts["network"], self.name)


class NetworkUkfStepper(Stepper):
    """Network and filter, one sample at a time."""

    def __init__(self, estimator: NetworkUkf) -> None:
        self._estimator = estimator
        self._filter = estimator.track_filter()
        self._process, self._sensors = estimator.sensor_noise()
        self._trusts = False
        self._before: tuple[Tensor, Tensor] | None = None
        self._state: Gaussian[Tensor] | None = None
        self._gate, self._refused = estimator.model.gate(), np.zeros((1, 5), np.int64)

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s] and yaw rate [rad/s] at the time of the sample."""
        estimator = self._estimator
        row = checked_sample(sample, estimator.channels, ())[None]
        word = estimator.word(estimator.seen(row))
        measurements, inputs = estimator.taken(row)
        trusts = bool(estimator.trusts(measurements[:, 0], self._trusts)[0])
        y = torch.as_tensor(np.column_stack([measurements, word.sideslip]))[None]
        u = torch.as_tensor(inputs)[None]
        noise = observation_noise(self._sensors, torch.tensor([trusts]), torch.as_tensor(word.variance))
        process = self._process if word.process is None else torch.as_tensor(word.process[0]).diag()
        if self._state is None or self._before is None:
            state, before = self._filter.start(u[:, 0]), process
        else:  # the last sample's measurements are part of the state already
            y, state = torch.cat([torch.full_like(y, torch.nan), y], 1), self._state
            u, before = torch.cat([self._before[0], u], 1), self._before[1]
        with torch.no_grad():
            refused = self._refused.copy()
            filtered = self._filter.filtered(y, u, before, noise, state, self._gate, refused).steps.filtered
        self._trusts, self._refused = trusts, refused
        self._before, self._state = (u[:, -1:], process), Gaussian(filtered.mean[:, -1], filtered.covariance[:, -1])
        found = dict(zip(TRACK_STATES, self._state.mean[0].tolist(), strict=True))
        return found | {"vy_variance": float(self._state.covariance[0, 0, 0])}


def observation_noise(sensors: Tensor, trusted: Tensor, variance: Tensor) -> Tensor:
    """Covariances of what sensors measure and the network says, (..., 5, 5), differentiable in the variance.

    Args:
        sensors: of the four measured numbers, where forces are not trusted and where they are, (2, 4, 4).
        trusted: bool (...).
        variance: of the network's word (...) [rad²].
    """
    of_sensors = sensors[trusted.long()].diagonal(dim1=-2, dim2=-1)
    return torch.diag_embed(torch.cat([of_sensors, variance.unsqueeze(-1)], -1))
