"""Base of networks over windows of past samples: fitting, estimating, running online, saving.

    recordings --windows_of--> windows, targets --train_members--> weights
    recording (T, C) --predict on all windows--> vy; the first N samples have no estimate

A window's prediction belongs to the sample after it, hence ``horizon_steps`` is 1: offline it is
written to that sample, online it is returned one interval ahead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.windows import window_starts, windows_of
from vehest.declared import MAX_WIDTH, setting
from vehest.estimators.base import FitData, FitRecord, Stepper, rate
from vehest.estimators.kernels.threads import threads_for_members
from vehest.estimators.model_files import load_model
from vehest.estimators.network import Network
from vehest.training.context import FitContext
from vehest.training.supervised_settings import SupervisedSettings

if TYPE_CHECKING:
    import torch
    from torch import nn

TARGET = "vy_ref"  # channel that networks are trained to predict


class WindowedEstimator(Network):
    """A memoryless network: N measurements r[k-N+1 … k] to the lateral velocity at k+1.

    Source: Da Lio et al. 2023, Fig. 1.

    The network is any ``nn.Module`` that maps windows (B, N, C) to (B,), in plain PyTorch; what it
    may have besides, a compiled recursion for example, is in `vehest.training.members`.
    """

    channels = ("yaw_rate", "vx", "ay", "ax")
    training_type = SupervisedSettings
    fits_seeds_together = True
    horizon_steps = 1  # a window predicts the velocity one sample after it
    rate_hz: float = rate(20.0)
    window: int = setting(30, "samples that it reads", least=1, most=MAX_WIDTH)

    def network_for(self, train: list[Recording]) -> nn.Module:
        """An untrained network with scales from the training recordings: means and standard
        deviations if it is a `StandardisedNetwork`.
        """
        from vehest.estimators.networks.standardised import StandardisedNetwork

        network = self.new_network()
        if isinstance(network, StandardisedNetwork):
            network.standardise(train, self.channels)
        return network

    @property
    def warm_up_steps(self) -> int:
        """Number of samples until the window is full."""
        return self.window - 1

    @classmethod
    def fit_members(
        cls, members: Sequence[Any], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Train members together (`train_members`).

        Raises
        ------
        DataError
            Recordings are too short or have gaps, the loss is no longer finite, or a model to start
            from is damaged.
        ConfigurationError
            The network cannot be trained so, or a model to start from is of another family or has
            other settings.
        """
        import torch

        from vehest.training.supervised import train_members

        first = members[0]
        dtype = getattr(torch, training.dtype)
        train, validation = (
            windows_of(part, first.channels, TARGET, first.window)
            for part in (data.train, data.validation)
        )
        started = (
            first.weights_of_model(Path(training.start_from))
            if training.start_from is not None
            else {}
        )
        for member in members:
            member.network = member.seeded_network(list(data.train), dtype)
            if started:
                member.network.load_state_dict(
                    {name: torch.as_tensor(values, dtype=dtype) for name, values in started.items()}
                )
        seeds = [member.fit_seed for member in members]
        compiled = training.compiled and hasattr(first.network, "compiled_descent")
        with threads_for_members() if compiled else nullcontext():
            return train_members(
                [member.network for member in members], seeds, train, validation, training, context
            )

    def seeded_network(self, train: list[Recording], dtype: torch.dtype) -> nn.Module:
        """The network of the drives ``train`` before its training, with initial weights drawn by
        the seed of this estimator, a member of a group that is trained together.
        """
        from torch import Generator

        from vehest.training.members import random_numbers

        with random_numbers(self.fit_seed):
            network = self.network_for(train)
        _check_state(network)
        network = network.to(dtype)
        reset = getattr(network, "reset", None)
        if reset is not None:
            reset(Generator().manual_seed(self.fit_seed))
        return network

    def weights_of_model(self, folder: Path) -> dict[str, np.ndarray[Any, Any]]:
        """Weights and scales of a stored model of the same family and settings, for fine-tuning."""
        start_model = load_model(folder)
        if (start_model.name, start_model.settings) != (self.name, self.settings):
            raise ConfigurationError(
                f"training.start_from: '{folder.name}' is {start_model.full_title} with "
                f"{asdict(start_model.settings)}; training starts from a model of the same family "
                f"and settings, here {self.full_title} with {asdict(self.settings)}"
            )
        return start_model.weights()

    def estimate_recording(
        self, recording: Recording, initial_state: Mapping[str, float] | None
    ) -> Estimate:
        """Estimate a checked recording; raises `ConfigurationError` for an initial state.

        The first ``window`` samples are NaN; so is all of a recording that is not longer than a
        window.
        """
        if initial_state is not None:
            raise ConfigurationError(
                f"estimator '{self.name}' has no state to start from: it reads a window of samples "
                "only; set evaluation.initial_state=false"
            )
        vy = np.full(len(recording), np.nan)
        starts = window_starts(len(recording), self.window)
        if len(starts):
            vy[self.window :] = self.predict(recording.stack(self.channels), starts)
        return self._wrapped(recording, vy)

    def predict(self, series: FloatArray, starts: NDArray[np.int64]) -> FloatArray:
        """Lateral velocity [m/s] one step after windows of measurements (T, C), (B,).

        ``starts``, (B,), are the first rows of the windows.
        """
        import torch

        from vehest.training.members import predict_members, prepare

        dtype = next(self.network.parameters()).dtype
        self.network.eval()
        with torch.no_grad():
            prepared = prepare(self.network, torch.as_tensor(series, dtype=dtype))
            parameters = {
                name: parameter.unsqueeze(0) for name, parameter in self.network.named_parameters()
            }
            rows = torch.as_tensor(starts).unsqueeze(0)
            result = predict_members(
                self.network, parameters, prepared, rows, self.window, compiled=True
            )
        return np.asarray(result[0].double().numpy())

    def online(self) -> WindowStepper:
        """A stepper with an empty window."""
        return WindowStepper(self)


class WindowStepper(Stepper):
    """Keeps the last N samples and predicts one step ahead of them."""

    horizon_steps = 1

    def __init__(self, estimator: WindowedEstimator) -> None:
        self._estimator = estimator
        self._window: deque[FloatArray] = deque(maxlen=estimator.window)

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s] one interval after the sample; NaN until the window is full."""
        self._window.append(self._estimator.checked_sample(sample))
        if len(self._window) < self._estimator.window:
            return {"vy": float("nan")}
        return {
            "vy": float(
                self._estimator.predict(np.array(self._window), np.zeros(1, dtype=np.int64))[0]
            )
        }


def _check_state(network: nn.Module) -> None:
    """Refuse a network whose state members cannot have, or model files cannot hold.

    Raises
    ------
    ConfigurationError
        It has no parameters, running statistics, or a persistent buffer that is no floating point.
    """
    kind = type(network).__name__
    if not any(parameter.requires_grad for parameter in network.parameters()):
        raise ConfigurationError(f"{kind} has no parameters to train")
    for name, module in network.named_modules():
        if getattr(module, "track_running_stats", False):
            raise ConfigurationError(
                f"{kind}: layer '{name}' ({type(module).__name__}) keeps running statistics, "
                "which batched trainings do not have; use LayerNorm, or track_running_stats=False"
            )
    for name, tensor in network.state_dict().items():
        if not tensor.is_floating_point():
            raise ConfigurationError(
                f"{kind}: buffer '{name}' is {tensor.dtype}, no floating point; register it with "
                "persistent=False"
            )
