"""Base of networks that map the measurements of one instant to a sideslip angle.

Inputs, the network, its samples, its weights.

    recordings --learnt_samples--> inputs (N, C), sideslip (N,) --scale, samples--> `Samples`
    `Samples` --sample_phase, `losses_of`--> trained `SampleNetwork` --outputs--> (M, T, O)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.declared import MAX_WIDTH, setting
from vehest.estimators.base import FitData, FitRecord, require_learnable
from vehest.estimators.kernels.sample_network import Criterion, losses_of, outputs_of, squared_error
from vehest.estimators.network import Network
from vehest.training.context import FitContext
from vehest.training.robust import robust_criterion
from vehest.training.samples import Draw, Samples, SampleSettings, sample_phase
from vehest.training.sequences import record_of_phases, train_phases

CORNERS = ("fl", "fr", "rl", "rr")  # suffixes of the channels of the four wheels
IMU = ("ax", "ay", "vx", "steer", "yaw_rate")  # motion and steering, without tyre forces
INPUTS: dict[str, tuple[str, ...]] = {
    "full": (*IMU, *(f"f{axis}_{corner}" for axis in "xyz" for corner in CORNERS)),
    "imu": IMU,
}
"""Sets of inputs: with tyre forces (Bertipaglia et al. 2024, Section III-A, 17 of them), and
without.
"""

# scaling of inputs: to [0, 1], or to mean 0 and standard deviation 1
Normalisation = Literal["range", "standard"]
NORMALISATION_SUFFIXES: dict[str, str] = {"range": "", "standard": "_standard"}
"""Normalisation -> suffix of the variant's name."""

SAMPLES_TOGETHER = 50_000  # samples that are estimated at a time
MAX_SIDESLIP = 1.5  # rad, beyond which sideslip angles of a network are clipped


class SampleNetworkEstimator(Network):
    """An estimator with a `SampleNetwork`."""

    network: SampleNetwork  # the networks
    network_inputs: tuple[str, ...]  # measured channels that the network reads
    hidden: tuple[int, int] = setting((250, 125), "widths of the network's hidden layers")
    dropout: float = setting(
        0.2, "share of hidden values that are hidden in training", least=0.0, below=1.0
    )
    normalisation: Normalisation = setting(
        "range", "range: inputs in [0, 1]; standard: a mean of 0 and a deviation of 1"
    )

    def check(self) -> None:
        """Check the widths of the layers; raises `ConfigurationError`: none, or too many
        neurons.
        """
        super().check()
        if min(self.hidden) < 1 or max(self.hidden) > MAX_WIDTH:
            raise ConfigurationError(
                f"estimator.hidden must be the widths of two layers, at most {MAX_WIDTH}, such as "
                f"[250, 125], not {list(self.hidden)}"
            )

    def prepare_network(
        self, data: FitData, training: Any, seeds: Sequence[int], minimum_speed: float = -np.inf
    ) -> tuple[SampleNetwork, Samples, Samples]:
        """A new network with initial weights, one seed a member, and samples of training and
        validation as it takes them.

        Parameters
        ----------
        data : FitData
            Training and validation recordings with ``vy_ref``.
        training : any
            Settings, of which the precision is used.
        seeds : sequence of int
            One a member of the network.
        minimum_speed : float
            Slower samples are left out [m/s].
        """
        raw, judged = (
            learnt_samples(part, self.network_inputs, self.name, minimum_speed)
            for part in (data.train, data.validation)
        )
        network = self.network = self.new_network().to(getattr(torch, training.dtype))
        network.scale(*raw, self.normalisation)
        network.reset([torch.Generator().manual_seed(seed) for seed in seeds])
        return network, network.samples(*raw), network.samples(*judged)

    def fit_samples(
        self,
        data: FitData,
        training: SampleSettings,
        criterion: Criterion,
        context: FitContext,
        index: int,
        seeds: Sequence[int],
        minimum_speed: float = -np.inf,
    ) -> FitRecord:
        """Train members, each of a seed, on samples in random order.

        Squared errors are in rad², other losses in the network's units.

        Parameters
        ----------
        data : FitData
            Recordings at the estimator's rate.
        training : SampleSettings
            Step size, batch, limit of the loss.
        criterion : Criterion
            Loss of one member; a limit replaces it by `robust_criterion`.
        context : FitContext
            Checkpoints, progress, the wish to stop.
        index : int
            Place of this estimator among those of the fit.
        seeds : sequence of int
            One a member of the network.
        minimum_speed : float
            Slower samples are left out [m/s].
        """
        network, train, validation = self.prepare_network(data, training, seeds, minimum_speed)
        unit = network.unit**2 if criterion is squared_error else 1.0
        if training.loss_limit:
            criterion = robust_criterion(math.radians(training.loss_limit) / float(network.unit))
        phase = sample_phase(
            "samples",
            network,
            training.phase,
            training.batch_size,
            len(train.targets),
            len(seeds),
            lambda draw: network.losses(train, draw, self.dropout, criterion) * unit,
            lambda: network.validation_losses(validation, criterion) * unit,
        )
        return record_of_phases(
            train_phases([phase], self.fit_seed, context, index, training.checkpoint_seconds)
        )


class SampleNetwork(nn.Module):
    """M networks of two hidden layers with rectifiers and dropout, each sample by itself.

    1x1 convolutions over time.

    Inputs, C measured channels, are mapped to [0, 1] by their ranges in training, or to a mean of 0
    and a deviation of 1; a constant one becomes 0. Targets are divided by their root mean square in
    training. Both are kept with the weights and are not parameters. A network returns O numbers
    for a sample.

    Source: Bertipaglia et al. 2024, Section III-A.
    """

    input_low: Tensor  # offset of each input, (C,) [SI]: its smallest value or its mean
    input_span: Tensor  # scale of each input, (C,) [SI]: its range or its standard deviation
    unit: Tensor  # root mean square of the targets [rad], a scalar

    def __init__(
        self, n_inputs: int, hidden: tuple[int, int], n_outputs: int, members: int = 1
    ) -> None:
        super().__init__()
        self.members = members
        self.register_buffer("input_low", torch.zeros(n_inputs))
        self.register_buffer("input_span", torch.ones(n_inputs))
        self.register_buffer("unit", torch.ones(()))
        for layer, (before, after) in enumerate(pairwise((n_inputs, *hidden, n_outputs)), start=1):
            self.register_parameter(
                f"weight_{layer}", nn.Parameter(torch.zeros(members, before, after))
            )
            self.register_parameter(f"bias_{layer}", nn.Parameter(torch.zeros(members, after)))

    def reset(self, generators: Sequence[torch.Generator]) -> None:
        """Draw initial weights of each member: uniform ones of Glorot & Bengio 2010; biases 0."""
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                if name.startswith("bias"):
                    parameter.zero_()
                    continue
                limit = (6.0 / sum(parameter.shape[1:])) ** 0.5
                for member, generator in enumerate(generators):
                    draw = torch.rand(parameter.shape[1:], generator=generator, dtype=torch.float64)
                    parameter[member].copy_((2.0 * draw - 1.0) * limit)

    def scale(
        self, inputs: FloatArray, sideslip: FloatArray, normalisation: Normalisation = "range"
    ) -> None:
        """Take scales of inputs, (N, C), and the unit of targets, (N,) [rad], from training
        samples.

        ``range`` maps inputs to [0, 1] by their extremes, ``standard`` to a mean of 0 and a
        standard deviation of 1.
        """
        low = inputs.min(axis=0)
        span = np.ptp(inputs, axis=0)
        if normalisation == "standard":
            low = inputs.mean(axis=0)
            span = np.where(span > 0.0, inputs.std(axis=0), 0.0)
        self.input_low.copy_(torch.as_tensor(low))
        self.input_span.copy_(torch.as_tensor(np.where(span > 0.0, span, np.finfo(np.float32).max)))
        self.unit.copy_(torch.as_tensor(max(float(np.sqrt(np.mean(np.square(sideslip)))), 1e-6)))

    def scaled(self, inputs: Tensor) -> Tensor:
        """Scale measured inputs [SI], (..., C), for the network.

        With ``range`` those of training lie in 0 … 1. A channel that was constant in training has
        the largest float32 as its span, so that it stays near 0 whatever it becomes.
        """
        return (inputs - self.input_low) / self.input_span

    def samples(self, inputs: FloatArray, sideslip: FloatArray) -> Samples:
        """Scale measured inputs (N, C) and sideslip angles (N,) [rad] into samples for training."""
        measured_inputs, angles = (
            torch.as_tensor(values, dtype=self.unit.dtype) for values in (inputs, sideslip)
        )
        return Samples(self.scaled(measured_inputs).contiguous(), angles / self.unit)

    def forward(self, inputs: Tensor, seeds: Tensor | None = None, dropout: float = 0.0) -> Tensor:
        """Outputs (M, B, O) of scaled inputs, (M, B, C) or (1, B, C) for all members; see
        `outputs_of`.
        """
        return outputs_of(inputs, list(self.parameters()), seeds, dropout)

    def losses(self, samples: Samples, draw: Draw, dropout: float, criterion: Criterion) -> Tensor:
        """Losses of a batch, (M,); see `losses_of`."""
        return losses_of(
            *samples, draw.rows, list(self.parameters()), draw.seeds, dropout, criterion
        )

    def outputs(self, inputs: FloatArray) -> NDArray[Any]:
        """Outputs of measured inputs (T, C) without dropout, (M, T, O), in the network's units."""
        pieces = []
        with torch.no_grad():
            for first in range(0, len(inputs), SAMPLES_TOGETHER):
                piece = torch.as_tensor(
                    inputs[first : first + SAMPLES_TOGETHER], dtype=self.unit.dtype
                )
                pieces.append(self(self.scaled(piece).unsqueeze(0)).double().numpy())
        return np.concatenate(pieces, axis=1)

    def c_values(self) -> dict[str, Any]:
        """Weights and ranges, and the largest angle, for a C template."""
        return {
            name: tensor.detach().numpy().astype(np.float64)
            for name, tensor in self.state_dict().items()
        } | {"steepest": MAX_SIDESLIP}

    def validation_losses(self, samples: Samples, criterion: Criterion) -> Tensor:
        """Losses on samples without dropout, (M,).

        Samples are evaluated in parts of `SAMPLES_TOGETHER`; the mean is over all of them.
        """
        total = np.zeros(self.members)
        with torch.no_grad():
            for first in range(0, len(samples.targets), SAMPLES_TOGETHER):
                inputs, targets = (part[first : first + SAMPLES_TOGETHER] for part in samples)
                outputs = self(inputs.unsqueeze(0)).numpy()
                unused = np.empty_like(outputs[0])
                total += [
                    len(targets) * criterion(output, targets.numpy(), unused) for output in outputs
                ]
        return torch.from_numpy(total / len(samples.targets))


def learnt_samples(
    recordings: Sequence[Recording],
    channels: Sequence[str],
    estimator: str,
    minimum_speed: float = -np.inf,
) -> tuple[FloatArray, FloatArray]:
    """Inputs (N, C) and reference sideslip angles (`reference_sideslip`), (N,) [rad], to train a
    network on, recordings one after another.

    Samples slower than ``minimum_speed`` [m/s] are left out.

    Raises
    ------
    DataError
        A channel is missing or has gaps, or all samples are too slow.
    """
    hint = "; set estimator.inputs=imu for cars without measured tyre forces"
    hints = {name: hint for name in channels if name.startswith("f")}
    require_learnable(recordings, (*channels, "vy_ref"), estimator, hints=hints)
    fast = np.concatenate([recording["vx"] >= minimum_speed for recording in recordings])
    if not fast.any():
        raise DataError(
            f"no sample of the training of estimator '{estimator}' is faster than "
            f"{minimum_speed:g} m/s"
        )
    inputs = np.concatenate([recording.stack(channels) for recording in recordings])
    return inputs[fast], np.concatenate(
        [reference_sideslip(recording) for recording in recordings]
    )[fast]


def reference_sideslip(recording: Recording) -> FloatArray:
    """Reference of training and scores: atan2(vy_ref, vx) with the measured vx, (T,) [rad]."""
    return np.arctan2(recording["vy_ref"], recording["vx"])


def clip_sideslip(sideslip: FloatArray) -> FloatArray:
    """Sideslip angles [rad] clipped to ±`MAX_SIDESLIP`, since the lateral velocity is vx tan β."""
    return np.clip(sideslip, -MAX_SIDESLIP, MAX_SIDESLIP)
