"""Base of recurrent networks that estimate a car's velocities from all samples so far.

It trains them on sequences, estimates, and runs them online.

    recordings --`DriveTensors`--> tensors (N, C) --cut, padded--> `SequenceBatch`
        --`VelocityNetwork`--> loss
    recording --run, SAMPLES_TOGETHER at a time, the state carried on--> velocities

Without ``truncate_steps`` an epoch has sequences of one length at random places. With it, drives
are cut whole, and a step of the optimiser follows each segment of a batch, whose hidden state the
next one continues.
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.declared import MAX_WIDTH, Group, setting
from vehest.estimators.base import FitData, FitRecord, Trial, require_learnable
from vehest.estimators.networks.recurrent import HiddenStateEstimator
from vehest.estimators.networks.standardised import StandardisedNetwork
from vehest.training.context import FitContext, record_of_epochs
from vehest.training.robust import robust_squares
from vehest.training.sequences import (
    Phase,
    PhaseSettings,
    divergence_of_phases,
    drawn_starts,
    train_phases,
)

# output -> channel that it is trained on
REFERENCES = {"vx": "vx_ref", "vy": "vy_ref", "yaw_rate": "yaw_rate_ref"}
ODD = ("vy", "yaw_rate", "ay", "steer", "roll_rate", "roll")
"""Channels and outputs that change sign in a mirror, left for right; the others stay."""
SAMPLES_TOGETHER = 10_000  # samples that are estimated at a time

# trial of both networks in the first comparison on a new car
TRIAL = Trial(
    11,
    "recurrent networks over all samples so far; minutes",
    "estimator.inputs=[yaw_rate,ax,ay,vx,steer] estimator.outputs=[vy] estimator.rate_hz=20 "
    "training.phase.max_epochs=100",
    samples=300,
)

State = tuple[Tensor, ...]  # hidden state of a network, and whatever else it carries on


@dataclass(frozen=True)
class SequenceSettings(Group):
    """Training of recurrent networks on sequences cut from recordings.

    Source: Węgrzynowski et al. 2024, Section IV.
    """

    group = "training"
    version: ClassVar[str] = "1"
    phase: PhaseSettings = setting(PhaseSettings(patience=100), "the one phase of the training")
    sequence_steps: int = setting(300, "samples in a training sequence, the dropped ones included")
    validation_steps: int = setting(
        1000, "samples in a validation sequence, the dropped ones included"
    )
    dropped_steps: int = setting(
        200,
        "first samples of every sequence, on which the hidden state settles, without loss",
        least=0,
    )
    validation_dropped_steps: int | None = setting(
        None, "the same of validation sequences; null: as in training", least=0
    )
    truncate_steps: int = setting(
        0,
        "samples that gradients reach back: drives are then cut whole into sequences of "
        "sequence_steps and less, with a step after every so many samples, the hidden state "
        "carried on; 0: to the start of the sequence, and remainders are left out",
        least=0,
    )
    mirrored: float = setting(
        0.0,
        "share of training sequences that are mirrored, left for right; papers: none",
        least=0.0,
        most=1.0,
    )
    batch_size: int = setting(4, "sequences in a batch", least=1)
    loss_limit: float = setting(
        0.0,
        "error of each output beyond which its square is continued by its tangent (Huber's "
        "loss), in the output's unit; 0: none",
        least=0.0,
    )
    weight_vx: float = setting(0.2225, "of the squared error of vx in the loss", least=0.0)
    weight_vy: float = setting(0.5064, "of the squared error of vy in the loss", least=0.0)
    weight_yaw_rate: float = setting(
        0.1566, "of the squared error of the yaw rate in the loss", least=0.0
    )
    dtype: Literal["float32", "float64"] = setting("float32", "precision of the weights")
    checkpoint_seconds: float = setting(15.0, "time between two checkpoints", unit="s")

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for sequences that are not longer than what is dropped of
        them.
        """
        super().__post_init__()
        for name, dropped in (
            ("sequence_steps", self.dropped_steps),
            ("validation_steps", self.settling_steps),
        ):
            if getattr(self, name) <= dropped:
                raise ConfigurationError(
                    f"training.{name} must be more than dropped_steps ({dropped}), not "
                    f"{getattr(self, name)}"
                )

    @property
    def settling_steps(self) -> int:
        """Number of first samples of a validation sequence that do not count."""
        return (
            self.dropped_steps
            if self.validation_dropped_steps is None
            else self.validation_dropped_steps
        )


class VelocityNetwork(StandardisedNetwork):
    """Base of recurrent networks from standardised measurements to standardised velocities.

    Parameters
    ----------
    settings : Any
        Channels and sizes.
    """

    def __init__(self, settings: Any) -> None:
        super().__init__(len(settings.inputs), (len(settings.outputs),))

    def reset(self, generator: torch.Generator) -> None:
        """Draw initial weights.

        Uniform within 1/√n, n the size of what feeds a layer, the hidden state for gates; biases
        alike.
        """
        with torch.no_grad():
            for module in self.modules():
                n = (
                    module.hidden_size
                    if isinstance(module, nn.RNNBase)
                    else module.in_features
                    if isinstance(module, nn.Linear)
                    else 0
                )
                for parameter in module.parameters(recurse=False):
                    draw = torch.rand(parameter.shape, generator=generator, dtype=torch.float64)
                    parameter.copy_((2.0 * draw - 1.0) / math.sqrt(n))

    def forward(
        self, measured: Tensor, state: State, mask: Tensor | None = None
    ) -> tuple[Tensor, State]:
        """Velocities (B, T, O) [m/s, rad/s] of measurements (B, T, C) [SI], and the last state.

        The state is that before the first sample, of `start` or of an earlier call; ``mask``, (B,
        T, H), is what the hidden state is multiplied by on its way out, none outside training.
        """
        outputs, state = self.advance(self.prepared(measured), state, mask)
        return outputs * self.output_scale + self.output_mean, state

    @abstractmethod
    def start(self, velocities: Tensor) -> State:
        """The state before the first sample.

        Parameters
        ----------
        velocities : Tensor
            (B, O) at that time [m/s, rad/s], given or measured.
        """

    @abstractmethod
    def advance(self, inputs: Tensor, state: State, mask: Tensor | None) -> tuple[Tensor, State]:
        """`forward` on standardised quantities.

        Parameters
        ----------
        inputs : Tensor
            (B, T, C).
        state : State
            Before the first sample.
        mask : Tensor or None
            (B, T, H).

        Returns
        -------
        tuple
            Standardised velocities (B, T, O), and the state after the last sample.
        """


class RecurrentVelocityEstimator(HiddenStateEstimator):
    """A recurrent network run over all samples of a drive, its hidden state starting from zero.

    The measured vx is read for sideslip = atan2(vy, vx), and to start networks that need a velocity
    to start from; the network receives it only if it is among ``inputs``. The loss is that of
    Węgrzynowski et al. 2024: squared errors, each output with its weight, over sequences without
    their first samples.
    """

    channels: tuple[str, ...]  # type: ignore[misc]  # depends on the settings
    training_type = SequenceSettings
    template = "velocity_recurrent"
    network: VelocityNetwork  # the network
    inputs: tuple[str, ...] = setting(
        ("yaw_rate", "ax", "ay", "motor_speed", "motor_current", "steer"),
        "measured channels that the network reads",
    )
    outputs: tuple[str, ...] = setting(
        ("vx", "vy", "yaw_rate"), "what it estimates, each trained on its _ref channel"
    )
    n_states: int = setting(64, "size of the hidden state", least=1, most=MAX_WIDTH)
    dropout: float = setting(
        0.0,
        "share of the hidden state that is hidden from later layers in training",
        least=0.0,
        below=1.0,
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.channels = tuple(dict.fromkeys(("vx", *self.inputs)))
        self.learns_from = tuple(REFERENCES[name] for name in self.outputs)
        self._columns = np.array([self.channels.index(name) for name in self.inputs])

    def check(self) -> None:
        """Check inputs and outputs.

        Raises
        ------
        ConfigurationError
            Inputs or outputs that repeat or are unknown, or a reference among the inputs.
        """
        for name in ("inputs", "outputs"):
            if len(set(getattr(self, name))) != len(getattr(self, name)) or not getattr(self, name):
                raise ConfigurationError(
                    f"estimator.{name} must be a list of different channels, not "
                    f"{getattr(self, name)!r}"
                )
        for name in self.inputs:
            try:
                reference = channel(name).is_reference
            except DataError as error:
                raise ConfigurationError(f"estimator.inputs: {error}") from None
            if reference:
                raise ConfigurationError(
                    f"estimator.inputs: '{name}' comes from a reference sensor, which no "
                    "estimator may read"
                )
        if "vy" not in self.outputs or not set(self.outputs) <= set(REFERENCES):
            raise ConfigurationError(
                f"estimator.outputs must be of {', '.join(REFERENCES)}, vy among them, not "
                f"{', '.join(self.outputs)}"
            )

    def fit_member(
        self, data: FitData, training: SequenceSettings, context: FitContext, index: int
    ) -> FitRecord:
        """Train on sequences."""
        train, validation = (
            DriveTensors(self, part, getattr(torch, training.dtype))
            for part in (data.train, data.validation)
        )
        network = self.network = self.new_network().to(getattr(torch, training.dtype))
        network.standardise(data.train, self.inputs, self.learns_from)
        network.reset(torch.Generator().manual_seed(self.fit_seed))
        phase = sequence_phase(network, self.settings, training, train, validation)
        (record,) = train_phases(
            [phase], self.fit_seed, context, index, training.checkpoint_seconds
        )
        metrics = {
            "best_epoch": record.best_epoch,
            "best_validation_loss": record.best_loss,
            "skipped_steps": record.skipped_steps,
            "train_seconds": record.seconds,
            **divergence_of_phases([record]),
        }
        return record_of_epochs(
            record.train_loss, record.validation_loss, metrics, record.interrupted
        )

    def measured_velocities(self, channels: Mapping[str, FloatArray]) -> FloatArray:
        """Velocities from which sequences start, by measured channels, (T, O) [m/s, rad/s]: vx, the
        yaw rate where it is read, else 0, and 0 for the lateral velocity.
        """
        n = len(channels["vx"])
        columns = [
            channels[name] if name in self.channels and name != "vy" else np.zeros(n)
            for name in self.outputs
        ]
        return np.stack(columns, axis=1)

    def first_state(self, sample: FloatArray, initial_state: Mapping[str, float]) -> State:
        """State of the network before the first sample, from known velocities, else measured
        ones.
        """
        measured = self.measured_velocities(
            {
                name: np.array([value])
                for name, value in zip(self.channels, sample.tolist(), strict=True)
            }
        )
        values = [
            initial_state.get(name, measured_value)
            for name, measured_value in zip(self.outputs, measured[0], strict=True)
        ]
        with torch.no_grad():
            return self.network.start(torch.tensor([values], dtype=self.network.input_mean.dtype))

    def run(self, samples: FloatArray, state: State) -> tuple[dict[str, Any], State]:
        """Estimate the velocities ``outputs`` [m/s, rad/s] at each sample.

        Parameters
        ----------
        samples : array
            Of ``channels``, (T, C).
        state : tuple of Tensor
            As `first_state` or an earlier call returned it.
        """
        inputs = torch.from_numpy(samples.take(self._columns, 1)).to(self.network.input_mean.dtype)[
            None
        ]
        pieces = []
        with torch.no_grad():
            for first in range(0, len(samples), SAMPLES_TOGETHER):
                values, state = self.network(inputs[:, first : first + SAMPLES_TOGETHER], state)
                pieces.append(values[0].numpy())
        return dict(zip(self.outputs, np.concatenate(pieces, dtype=float).T, strict=True)), state

    def c_values(self) -> dict[str, Any]:
        """Weights, sizes and start values for the C template."""
        s = self.settings
        weights = {name: array.astype(np.float64) for name, array in self.weights().items()}
        return {
            **{name.replace(".", "_"): array for name, array in weights.items()},
            "states": s.n_states,
            "gates": len(weights["recurrent.weight_ih_l0"]) // s.n_states,
            "slope": getattr(s, "negative_slope", 0.0),
            "dense": getattr(s, "n_dense", 0),
            "inputs": s.inputs,
            "outputs": s.outputs,
            "starts": [
                name if name in self.channels and name != "vy" else None for name in s.outputs
            ],
        }


class SequenceBatch(NamedTuple):
    """Sequences side by side, B sequences of T samples with C channels and O outputs."""

    starts: Tensor  # velocities to start from, (B, O)
    inputs: Tensor  # measurements, (B, T, C)
    targets: Tensor  # references, (B, T, O)
    mask: Tensor | None = None  # factors of dropout, (B, T, H)
    # weight 0 or 1 of each sample in the loss, (B, T); None: all but the first, dropped ones count
    counted: Tensor | None = None
    # whether the batch continues the one before, whose hidden state it starts from
    goes_on: bool = False

    def stretch(self, first: int, end: int) -> SequenceBatch:
        """The batch restricted to samples ``first`` to ``end``."""
        parts = {name: getattr(self, name) for name in ("inputs", "targets", "mask", "counted")}
        return self._replace(
            goes_on=first > 0,
            **{name: part[:, first:end] for name, part in parts.items() if part is not None},
        )

    def scaled(self, input_factors: Tensor, output_factors: Tensor) -> SequenceBatch:
        """The batch with inputs times factors, (B, C), and starts and targets times factors, (B,
        O), such as the signs of a mirrored drive.
        """
        return self._replace(
            inputs=self.inputs * input_factors.unsqueeze(1),
            targets=self.targets * output_factors.unsqueeze(1),
            starts=self.starts * output_factors,
        )


class DriveTensors:
    """Recordings one after another as tensors, from which sequences are cut.

    Attributes
    ----------
    names, lengths : list
        Id and number of samples of each recording.
    starts, targets : Tensor
        Measured velocities to start from and references, (N, O) [m/s, rad/s].
    inputs : Tensor
        Measurements, (N, C) [SI].
    """

    def __init__(
        self,
        estimator: RecurrentVelocityEstimator,
        recordings: Sequence[Recording],
        dtype: torch.dtype,
    ) -> None:
        require_learnable(recordings, (*estimator.channels, *estimator.learns_from), estimator.name)
        self.names = [recording.id for recording in recordings]
        self.lengths = [len(recording) for recording in recordings]
        parts = (
            [estimator.measured_velocities(recording.channels) for recording in recordings],
            [recording.stack(estimator.inputs) for recording in recordings],
            [recording.stack(estimator.learns_from) for recording in recordings],
        )
        self.starts, self.inputs, self.targets = (
            torch.as_tensor(np.concatenate(part), dtype=dtype) for part in parts
        )

    def cut(
        self,
        firsts: Tensor,
        places: Tensor,
        mask: Tensor | None = None,
        counted: Tensor | None = None,
    ) -> SequenceBatch:
        """Sequences of the samples at offsets ``places``, (T,) or (B, T), from the rows ``firsts``,
        (B,).
        """
        rows = firsts.unsqueeze(1) + places
        return SequenceBatch(
            self.starts[firsts], self.inputs[rows], self.targets[rows], mask, counted
        )

    def pieces(self, steps: int, generator: torch.Generator) -> Tensor:
        """Cut all drives completely, at random places, into pieces of ``steps`` samples and less.

        Returns first row and length of each piece, (N, 2). The first piece of a drive may be
        shorter than ``steps``, and so may the last.
        """
        spans = []
        offset = 0
        for length in self.lengths:
            shift = int(torch.randint(steps, (), generator=generator))
            edges = sorted({0, *range(shift, length, steps), length})
            spans += [(offset + first, end - first) for first, end in itertools.pairwise(edges)]
            offset += length
        return torch.tensor(spans)

    def padded(self, pieces: Tensor, dropped: int, mask: Tensor | None = None) -> SequenceBatch:
        """Pieces of different lengths side by side, as long as the longest.

        What is beyond a piece's end does not count.
        """
        firsts, lengths = pieces.unbind(1)
        places = torch.arange(int(lengths.max()))
        ends = lengths.unsqueeze(1)
        counted = ((places >= dropped) & (places < ends)).to(self.inputs.dtype)
        return self.cut(firsts, torch.minimum(places, ends - 1), mask, counted)

    def for_validation(self, training: SequenceSettings) -> list[SequenceBatch]:
        """Batches of validation sequences, without overlap from the start of each recording; a
        recording that is too short is one sequence.
        """
        batches = []
        offset = 0
        for name, length in zip(self.names, self.lengths, strict=True):
            steps = min(length, training.validation_steps)
            if steps <= training.settling_steps:
                raise DataError(
                    f"recording '{name}' is {length} samples long: too short to validate on with "
                    f"training.dropped_steps {training.settling_steps}; choose a longer range in "
                    "conf/split"
                )
            batches.append(
                self.cut(offset + steps * torch.arange(length // steps), torch.arange(steps))
            )
            offset += length
        return batches


def sequence_phase(
    network: VelocityNetwork,
    settings: Any,
    training: SequenceSettings,
    train: DriveTensors,
    validation: DriveTensors,
) -> Phase:
    """The training phase of a recurrent network: weighted squared errors over sequences at random
    places of the drives.

    The loss of a batch is the mean, over its counted samples, of Σ_o w_o ρ(v̂_o - v_o), with the
    weights of the settings and `robust_squares` ρ. Dropout masks, mirroring and places are drawn
    with the batches.

    Raises
    ------
    DataError
        No training recording is as long as a sequence, or one for validation is too short.
    """
    steps = training.sequence_steps
    truncated = training.truncate_steps
    dtype = train.inputs.dtype
    if max(train.lengths) < steps:
        lengths = ", ".join(
            f"'{name}' {length}" for name, length in zip(train.names, train.lengths, strict=True)
        )
        raise DataError(
            f"training.sequence_steps is {steps}, but no training recording is as long: "
            f"{lengths}; lower it"
        )
    judged = validation.for_validation(training)
    weights = torch.tensor(
        [getattr(training, f"weight_{name}") for name in settings.outputs], dtype=dtype
    )
    signs = [
        torch.tensor([-1.0 if name in ODD else 1.0 for name in names], dtype=dtype)
        for names in (settings.inputs, settings.outputs)
    ]
    carried: list[State] = []

    def errors(batch: SequenceBatch, dropped: int) -> Tensor:
        """Weighted squared errors (B, T - dropped); remembers the last state for the next
        stretch.
        """
        outputs, state = network(
            batch.inputs, carried[0] if batch.goes_on else network.start(batch.starts), batch.mask
        )
        carried[:] = [tuple(part.detach() for part in state)]
        weighted: Tensor = (
            robust_squares((outputs - batch.targets)[:, dropped:], training.loss_limit) @ weights
        )
        return weighted

    def mask_of(sequences: int, length: int, generator: torch.Generator) -> Tensor | None:
        """Dropout's factors of the hidden state (B, T, H), with a mean of 1; None without
        dropout.
        """
        if not settings.dropout:
            return None
        is_active = (
            torch.rand(sequences, length, settings.n_states, generator=generator)
            >= settings.dropout
        )
        return is_active.to(dtype) / (1.0 - settings.dropout)

    def mirrored(batch: SequenceBatch, generator: torch.Generator) -> SequenceBatch:
        """A batch in which each sequence is mirrored with the probability of the settings."""
        if not training.mirrored:
            return batch
        turned = torch.rand(len(batch.starts), 1, generator=generator) < training.mirrored
        inputs, outputs = (torch.where(turned, sign, 1.0) for sign in signs)
        return batch.scaled(inputs, outputs)

    def batches(generator: torch.Generator) -> Iterator[SequenceBatch]:
        """Batches of sequences of one length, each starting from measured velocities."""
        for chosen in drawn_starts(train.lengths, steps, generator).split(training.batch_size):
            yield mirrored(
                train.cut(chosen, torch.arange(steps), mask_of(len(chosen), steps, generator)),
                generator,
            )

    def stretches(generator: torch.Generator) -> Iterator[SequenceBatch]:
        """Batches of pieces, each yielded in parts of ``truncated`` samples that continue each
        other.
        """
        pieces = train.pieces(steps, generator)
        for chosen in pieces[torch.randperm(len(pieces), generator=generator)].split(
            training.batch_size
        ):
            longest = int(chosen[:, 1].max())
            batch = mirrored(
                train.padded(
                    chosen, training.dropped_steps, mask_of(len(chosen), longest, generator)
                ),
                generator,
            )
            for first in range(0, longest, truncated):
                yield batch.stretch(first, first + truncated)

    def loss(batch: SequenceBatch) -> Tensor:
        """Mean weighted squared error over the samples that count."""
        if batch.counted is None:
            return errors(batch, training.dropped_steps).mean()
        return (errors(batch, 0) * batch.counted).sum() / batch.counted.sum().clamp(min=1.0)

    def validate() -> float:
        """Mean weighted squared error over all validation sequences."""
        samples = torch.cat(
            [errors(batch, training.settling_steps).reshape(-1) for batch in judged]
        )
        return float(samples.double().mean())

    return Phase(
        "sequences", training.phase, network, stretches if truncated else batches, loss, validate
    )
