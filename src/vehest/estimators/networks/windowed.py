"""What networks over windows of past samples share: fitting, estimating, running online, saving."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.windows import window_starts, windows_of
from vehest.estimators.base import Estimator, EstimatorSettings, FitData, FitRecord, Stepper, required
from vehest.estimators.model_files import load_model
from vehest.training.context import FitContext
from vehest.training.members import predict_members, prepare, random_numbers
from vehest.training.supervised import SupervisedSettings, train_members

TARGET = "vy_ref"


@dataclass(frozen=True)
class WindowedSettings(EstimatorSettings):
    """Settings of a network that sees N past samples.

    Args:
        rate_hz: sampling rate [Hz].
        window: samples N it sees.
    """

    rate_hz: float = 20.0
    window: int = 30

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window < 1:
            raise ConfigurationError(f"estimator.window must be at least 1, not {self.window}")


class WindowedEstimator(Estimator):
    """A memoryless network: N measurements r[k-N+1 … k] to the lateral velocity at k+1 (Da Lio et al. 2023, Fig. 1).

    The network is any ``nn.Module`` that maps windows (B, N, C) to (B,), in plain PyTorch; what it may have besides, a compiled recursion
    for example, is in `vehest.training.members.WindowNetworkHooks`.
    """

    channels = ("yaw_rate", "vx", "ay", "ax")
    training_type = SupervisedSettings
    settings_type: ClassVar[type[WindowedSettings]]
    settings: WindowedSettings

    def __init__(self, settings: WindowedSettings) -> None:
        super().__init__(settings)
        with random_numbers(0):
            self.network: nn.Module = self.empty_network()
        self._seed = 0

    def new_network(self, train: list[Recording]) -> nn.Module:
        """A network that knows the ranges of the training recordings: means and deviations if it is a `StandardisedNetwork`."""
        network = self.empty_network()
        if isinstance(network, StandardisedNetwork):
            network.standardise(train, self.channels)
        return network

    @abstractmethod
    def empty_network(self) -> nn.Module:
        """A network as it is built, to load weights into."""

    @property
    def horizon_steps(self) -> int:
        """One: a window predicts the velocity one sample after it."""
        return WindowStepper.horizon_steps

    @property
    def warm_up_steps(self) -> int:
        """Until the window is full."""
        return self.settings.window - 1

    @property
    def n_parameters(self) -> int:
        """Numbers that training determines; ranges taken from the data do not count."""
        return sum(parameter.numel() for parameter in self.network.parameters() if parameter.requires_grad)

    def seed(self, seed: int) -> None:
        """Seed of the initial weights and of the order of the windows."""
        self._seed = seed

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Train members together (`train_members`).

        Raises:
            DataError: recordings are too short or have gaps, or the loss is no longer finite.
            ConfigurationError: the network cannot be trained so.
        """
        windowed = [member for member in members if isinstance(member, WindowedEstimator)]
        first = windowed[0]
        sets = [windows_of(part, first.channels, TARGET, first.settings.window) for part in (data.train, data.validation)]
        started = start_weights(first, Path(training.start_from)) if training.start_from is not None else None
        for member in windowed:
            member.network = member._seeded_network(list(data.train), getattr(torch, training.dtype))
            if started is not None:
                member.network.load_state_dict({name: tensor.to(getattr(torch, training.dtype)) for name, tensor in started.items()})
        networks = [member.network for member in windowed]
        records = train_members(networks, [member._seed for member in windowed], sets[0], sets[1], training, context)
        return [
            FitRecord(
                history={
                    "epoch": list(range(1, record.epochs + 1)),
                    "train_loss": record.train_loss,
                    "validation_loss": record.validation_loss,
                },
                metrics={
                    "epochs": record.epochs,
                    "best_epoch": record.best_epoch,
                    "best_validation_loss": record.best_validation_loss,
                    "train_seconds": record.seconds / len(records),
                },
                interrupted=record.interrupted,
            )
            for record in records
        ]

    def _seeded_network(self, train: list[Recording], dtype: torch.dtype) -> nn.Module:
        """A network to train, with initial weights from the member's seed."""
        with random_numbers(self._seed):
            network = self.new_network(train)
        _check_state(network)
        network = network.to(dtype)
        reset = getattr(network, "reset", None)
        if reset is not None:
            reset(torch.Generator().manual_seed(self._seed))
        return network

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        if initial_state is not None:
            raise ConfigurationError(
                f"estimator '{self.name}' has no state to start from: it sees a window of samples only; set evaluation.initial_state=false"
            )
        vy = np.full(len(recording), np.nan)
        starts = window_starts(len(recording), self.settings.window)
        if len(starts):
            vy[self.settings.window :] = self._predict(recording.stack(self.channels), starts)
        return self._wrapped(recording, vy)

    def _predict(self, series: np.ndarray[Any, Any], starts: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        dtype = next(self.network.parameters()).dtype
        self.network.eval()
        with torch.no_grad():
            prepared = prepare(self.network, torch.as_tensor(series, dtype=dtype))
            parameters = {name: parameter.unsqueeze(0) for name, parameter in self.network.named_parameters()}
            rows = torch.as_tensor(starts).unsqueeze(0)
            result = predict_members(self.network, parameters, prepared, rows, self.settings.window, compiled=True)
        return result[0].double().numpy()

    def online(self) -> WindowStepper:
        """A stepper with an empty window."""
        return WindowStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Parameters and ranges (persistent buffers) of the network."""
        return {name: tensor.detach().numpy().copy() for name, tensor in self.network.state_dict().items()}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take parameters and ranges back, in the precision they were trained in."""
        network = self.empty_network()
        tensors = {name: torch.from_numpy(np.array(values)) for name, values in weights.items()}
        expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
        found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if expected != found:
            raise DataError(f"weights of '{self.name}' do not fit its settings: expected {expected}, found {found}")
        network = network.to(next(iter(tensors.values())).dtype)
        network.load_state_dict(tensors)
        self.network = network


class WindowStepper(Stepper):
    """Keeps the last N samples and predicts one step ahead of them."""

    horizon_steps = 1

    def __init__(self, estimator: WindowedEstimator) -> None:
        self._estimator = estimator
        self._window: deque[list[float]] = deque(maxlen=estimator.settings.window)

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s] one interval after the sample; NaN until the window is full."""
        self._window.append(required(sample, self._estimator.channels))
        if len(self._window) < self._estimator.settings.window:
            return {"vy": float("nan")}
        return {"vy": float(self._estimator._predict(np.array(self._window), np.zeros(1, dtype=np.int64))[0])}


def start_weights(estimator: WindowedEstimator, folder: Path) -> dict[str, Tensor]:
    """Weights and ranges of another model, to start a training from (fine-tuning).

    Args:
        estimator: that is to be trained.
        folder: of a model of the same family and settings.

    Raises:
        ConfigurationError: it is of another family, or has other settings.
        MissingError: there is no model.
        DataError: its files are damaged.
    """
    other = load_model(folder)
    if (other.name, other.settings) != (estimator.name, estimator.settings) or not isinstance(other, WindowedEstimator):
        raise ConfigurationError(
            f"training.start_from: '{folder.name}' is {other.full_title} with {asdict(other.settings)}; "
            f"training starts from a model of the same family and settings, here {estimator.full_title} with {asdict(estimator.settings)}"
        )
    return {name: torch.from_numpy(values) for name, values in other.weights().items()}


def _check_state(network: nn.Module) -> None:
    """See that a network's state is what members can have and model files can hold.

    Raises:
        ConfigurationError: it has nothing to train, keeps running statistics, or holds other numbers than floating point.
    """
    kind = type(network).__name__
    if not any(parameter.requires_grad for parameter in network.parameters()):
        raise ConfigurationError(f"{kind} has no parameters to train")
    for name, module in network.named_modules():
        if getattr(module, "track_running_stats", False):
            raise ConfigurationError(
                f"{kind}: layer '{name}' ({type(module).__name__}) keeps running statistics, which members do not have; "
                f"use LayerNorm, or track_running_stats=False"
            )
    for name, tensor in network.state_dict().items():
        if not tensor.is_floating_point():
            raise ConfigurationError(f"{kind}: buffer '{name}' is {tensor.dtype}, no floating point; register it with persistent=False")


class StandardisedNetwork(nn.Module):
    """Base of networks that see standardised measurements and predict a standardised lateral velocity.

    Means and standard deviations are those of the training recordings; they are not parameters. `prepared` standardises what ``forward``
    sees; what it predicts goes back to m/s by ``output * self.output_scale + self.output_mean``.
    """

    input_mean: Tensor
    input_scale: Tensor
    output_mean: Tensor
    output_scale: Tensor

    def __init__(self, n_channels: int) -> None:
        super().__init__()
        self.register_buffer("input_mean", torch.zeros(n_channels))
        self.register_buffer("input_scale", torch.ones(n_channels))
        self.register_buffer("output_mean", torch.zeros(()))
        self.register_buffer("output_scale", torch.ones(()))

    def standardise(self, train: Sequence[Recording], channels: Sequence[str]) -> None:
        """Take means and standard deviations from recordings."""
        inputs = np.concatenate([recording.stack(channels) for recording in train])
        outputs = np.concatenate([recording[TARGET] for recording in train])
        for buffer, value in (
            (self.input_mean, inputs.mean(axis=0)),
            (self.input_scale, np.maximum(inputs.std(axis=0), 1e-6)),
            (self.output_mean, outputs.mean()),
            (self.output_scale, max(float(outputs.std()), 1e-6)),
        ):
            buffer.copy_(torch.as_tensor(value))

    def prepared(self, series: Tensor) -> Tensor:
        """Standardised measurements."""
        return (series - self.input_mean) / self.input_scale

    def constrain(self, parameters: Mapping[str, Tensor]) -> None:
        """Any weights are admissible."""
