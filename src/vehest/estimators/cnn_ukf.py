"""UKF-informed neural network.

A network and the unscented filter behind it, trained end to end (CNN-UKF).

    recordings --identify--> tyres, sensor levels, process noise
    samples --pre-training--> network (Eqs. 5 and 6)
    sequences --`EndToEnd`: network, then `TrackFilter`--> loss (Eq. 7) --gradient--> network

At each sample the network returns β_DD, σ_DD, σ_Vy and σ_ψ̇ (`NetworkOutput`). The filter measures
β_DD with the variance σ_DD² + ε beside the sensors, and its step has the process noise
diag(σ_Vy², σ_ψ̇²). Tyres and sensor levels are those of the identification and are not changed
afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.hooks import RemovableHandle

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.declared import Group, setting
from vehest.estimators.base import FitData, FitRecord, Trial
from vehest.estimators.filtering.dugoff_filter import PseudoMeasurement, with_variance
from vehest.estimators.filtering.track_filter import TrackFilter
from vehest.estimators.network_ukf import NetworkUkf
from vehest.estimators.networks.sample_network import (
    SampleNetwork,
    clip_sideslip,
    learnt_samples,
    reference_sideslip,
)
from vehest.filters.gaussian import Gaussian
from vehest.training.context import DivergenceError, FitContext
from vehest.training.noise_tuning import IdentificationSettings
from vehest.training.robust import robust_squares
from vehest.training.samples import Draw, Samples, sample_phase
from vehest.training.sequences import (
    Phase,
    PhaseSettings,
    drawn_starts,
    record_of_phases,
    train_phases,
)

# m/s and rad/s: standard deviations of v and yaw rate about the true state at which a training
# sequence starts
START = (
    0.1,
    0.02,
)
# m/s, rad/s, rad: largest standard deviation from which an output starts, and with which it is
# pre-trained; the middle of the logistic functions
MAX_NOISE = 0.5
SATURATED = 20.0  # argument at which the logistic function is 1 but for 2e-9
DISTRUST = 1  # index of the network's output for the deviation of its angle as a measurement
PROCESS = [2, 3]  # indices of the outputs for the process noise of both states
# share of the sequences of a batch beyond which training stops instead of going on without them
MAX_LOST_SHARE = 0.5


@dataclass(frozen=True)
class EndToEndSettings(Group):
    """Training of filter and network (Bertipaglia et al. 2024, Section III-C)."""

    group = "training"
    version: ClassVar[str] = "1"
    pre_training: PhaseSettings = setting(
        PhaseSettings(learning_rate=8e-4, max_epochs=30, patience=10),
        "the network alone, on samples in random order",
    )
    pre_training_batch: int = setting(256, "samples in a batch", least=1)
    end_to_end: PhaseSettings = setting(
        PhaseSettings(learning_rate=8e-4, max_epochs=200, patience=30),
        "network and filter, on sequences",
    )
    steps: int = setting(256, "samples of a training sequence", least=2)
    batch_size: int = setting(32, "sequences in a batch", least=1)
    loss_unit: Literal["rad", "deg"] = setting(
        "rad",
        "of the angles in the loss of Eq. 7; the optimum is the same, but gradients in rad² are "
        "about as small as the number that AdamW adds to their size, 1e-8, so that it takes "
        "steps far below its rate",
    )
    loss_limit: float = setting(
        0.0,
        "error of either angle beyond which its square in the loss of Eq. 7 is continued by its "
        "tangent (Huber's loss), so that skids do not decide the training; 0: none, as in the "
        "paper",
        unit="deg",
        least=0.0,
    )
    identification: IdentificationSettings = setting(IdentificationSettings(), "of the filter")
    dtype: Literal["float32", "float64"] = setting(
        "float32", "precision of the network; the filter computes in double precision"
    )
    checkpoint_seconds: float = setting(15.0, "time between two checkpoints", unit="s")


class NetworkOutput(NamedTuple):
    """The network's angle and noise levels for samples, differentiable, in double precision."""

    sideslip: Tensor  # β_DD (...) [rad]
    distrust: Tensor  # σ_DD, standard deviation of that angle as a measurement (...) [rad]
    process: Tensor  # σ_Vy and σ_ψ̇ (..., 2) [m/s, rad/s], of one sample's step
    least_variance: float  # ε [rad²]

    @property
    def variance(self) -> Tensor:
        """Variance of the sideslip angle as a measurement [rad²]."""
        return self.distrust.square() + self.least_variance


class Cuts(NamedTuple):
    """Training sequences of one length, cut from recordings."""

    inputs: Tensor  # scaled inputs of the network, (B, T, C)
    sideslip: Tensor  # reference sideslip, (B, T) [rad]
    measured: Tensor  # measurements of the filter's four sensors, (B, T, 4)
    driven: Tensor  # inputs of the filter, (B, T, 3)
    trusted: Tensor  # whether forces are trusted, bool (B, T)
    start: Tensor  # true state at the first sample, (B, 2)
    seeds: Tensor  # seed of dropout, int64 (1,)
    firsts: Tensor  # index of each sequence's first sample among all training samples, int64 (B,)


class CnnUkf(NetworkUkf):
    """Filter with a sideslip angle, its variance and process noise by a network, at each sample.

    Its 1x1 convolutions over time read one sample each, so it is a network of samples. σ_DD, σ_Vy
    and σ_ψ̇ come out of logistic functions; all three are standard deviations here, in pre-training
    too, where Eq. 6 has σ_DD as a variance: R = σ_DD² + ε, and ε is added rather than a bound, so
    that it has a gradient everywhere.

    Source: Bertipaglia, Alirezaei, Happee & Shyrokau, An unscented Kalman filter-informed neural
    network for vehicle sideslip angle estimation, IEEE Transactions on Vehicular Technology 73 (9),
    2024, Section III.
    """

    name = "cnn_ukf"
    title = "UKF-informed network"
    trials = (
        Trial(
            13,
            "network trained through its filter; ten minutes and more",
            "estimator.inputs=imu {car} training.identification.method=nelder_mead "
            "training.identification.grid=1 "
            "training.identification.max_evaluations=40 training.identification.tyres_from='*' "
            "training.identification.restarts=1 training.identification.generations=60 "
            "training.end_to_end.max_epochs=20",
            samples=256,
        ),
    )
    training_type = EndToEndSettings
    curve: Literal["plain", "smooth"] = setting(
        "smooth", "tyres of Eq. 9 (plain) or 10 (smooth), which gradients pass"
    )
    hidden: tuple[int, int] = setting((200, 100), "widths of the network's hidden layers")
    pseudo_measurement: bool = setting(
        True, "whether the filter measures the angle; otherwise σ_DD is held at 1 rad"
    )
    adaptive_distrust: bool = setting(
        True, "whether σ_DD changes from sample to sample; otherwise one value is trained"
    )
    adaptive_process: bool = setting(
        True, "whether σ_Vy and σ_ψ̇ do; otherwise they are held at the filter's levels"
    )

    @property
    def without(self) -> tuple[str, ...]:
        """Names of the settings that switch parts of the method off, for ablations."""
        parts = ("pseudo_measurement", "adaptive_distrust", "adaptive_process")
        return tuple(name for name in parts if not getattr(self, name))

    def new_network(self) -> SampleNetwork:
        """An untrained network from the inputs of a sample to four outputs: angle, its deviation,
        and the deviations of a step of both states.
        """
        return SampleNetwork(len(self.network_inputs), self.hidden, 4)

    @property
    def variant(self) -> str:
        """Name with tyres that are not smooth and with the parts that are switched off."""
        tyres = "" if self.curve == "smooth" else "_plain"
        return super().variant + tyres + "".join(f"_no_{name}" for name in self.without)

    def output_of(self, outputs: Tensor) -> NetworkOutput:
        """Convert outputs of the network, (..., 4), into angle and noise levels.

        The first is an angle in units of the network's ``unit`` [rad]; the others pass a logistic
        function, so that all deviations lie between 0 and 1 (σ_DD [rad], σ_Vy [m/s], σ_ψ̇ [rad/s]).
        """
        shares = torch.sigmoid(outputs[..., 1:].double())
        return NetworkOutput(
            outputs[..., 0].double() * self.network.unit.double(),
            shares[..., 0],
            shares[..., 1:],
            self.least_variance,
        )

    def pseudo_of(self, inputs: FloatArray) -> PseudoMeasurement:
        """Evaluate the network on its inputs (T, C): sideslip angle, its variance and the process
        noise for the filter.

        There are no gradients. The angle is clipped, so that its tangent is finite.
        """
        output = self.output_of(torch.as_tensor(self.network.outputs(inputs)[0]))
        return PseudoMeasurement(
            clip_sideslip(output.sideslip.numpy()),
            output.variance.numpy(),
            output.process.square().numpy(),
        )

    def fit_network(
        self, data: FitData, training: EndToEndSettings, context: FitContext, index: int
    ) -> FitRecord:
        """Train the network: alone first, then through the filter."""
        network, train, judged = self.prepare_network(
            data, training, [self.fit_seed], self.minimum_speed
        )
        levels = torch.tensor(
            [self.levels["process_vy"], self.levels["process_yaw_rate"]], dtype=torch.float64
        )
        # a logistic function that is to say 1 or more saturates, and learns no more
        levels = levels.clamp(max=MAX_NOISE)
        # logistic functions start where the filter alone has its levels, and as unsure as a network
        # that says 0
        with torch.no_grad():
            start = torch.cat([network.unit.double().reshape(1).clamp(max=MAX_NOISE), levels])
            network.get_parameter("bias_3")[0, 1:] = torch.logit(start).to(network.unit.dtype)
        handles = self._fix_heads(network)
        # sequences are cut from all that was driven
        driven = network.samples(*learnt_samples(data.train, self.network_inputs, self.name))
        end_to_end = EndToEnd(self, driven, data.train, training)
        phases = [
            self.pre_training_phase(train, judged, levels, training),
            Phase(
                "end_to_end",
                training.end_to_end,
                network,
                end_to_end.batches,
                end_to_end.loss,
                lambda: self.mean_squared_error(
                    data.validation,
                    over=training.identification.error,
                    pseudo=self.pseudo_measurements(data.validation),
                    limit=training.identification.error_limit,
                ),
            ),
        ]
        record = record_of_phases(
            train_phases(phases, self.fit_seed, context, index, training.checkpoint_seconds)
        )
        for handle in handles:
            handle.remove()
        return FitRecord(
            record.history,
            {**record.metrics, "lost_sequences": end_to_end.lost},
            record.interrupted,
        )

    def _fix_heads(self, network: SampleNetwork) -> list[RemovableHandle]:
        """Make outputs that settings switch off constant, and return the hooks that do.

        Their weights are 0 and have no gradient, so that the network keeps its shape.
        """
        s = self
        fixed_weights = []
        fixed_biases = []
        if not (s.adaptive_distrust and s.pseudo_measurement):
            fixed_weights.append(DISTRUST)
        if not s.pseudo_measurement:
            fixed_biases.append(DISTRUST)
        if not s.adaptive_process:
            fixed_weights += PROCESS
            fixed_biases += PROCESS
        handles = []
        for name, fixed in (("weight_3", fixed_weights), ("bias_3", fixed_biases)):
            if fixed:
                mask = torch.ones(4, dtype=network.unit.dtype)
                mask[fixed] = 0.0
                handles.append(
                    network.get_parameter(name).register_hook(
                        lambda gradient, mask=mask: gradient * mask
                    )
                )
        with torch.no_grad():
            network.get_parameter("weight_3")[..., fixed_weights] = 0.0
            if not s.pseudo_measurement:
                network.get_parameter("bias_3")[..., DISTRUST] = SATURATED
        return handles

    def pre_training_phase(
        self, train: Samples, judged: Samples, levels: Tensor, training: EndToEndSettings
    ) -> Phase:
        """The training phase of the network alone (Eqs. 5 and 6), validated on ``judged``.

        Its loss is ½ (ln R + e²/R) on average, with R = σ_DD² + ε and the error e of the angle
        [rad], plus the squared differences of σ_Vy and σ_ψ̇ to the filter's levels.
        """
        network = self.network
        dropout = self.dropout

        def loss_of(outputs: Tensor, targets: Tensor) -> Tensor:
            """Loss of outputs (1, N, 4) against scaled angles, one a member, (1,)."""
            output = self.output_of(outputs)
            error = output.sideslip - targets.double() * network.unit.double()
            likelihood = 0.5 * (output.variance.log() + error.square() / output.variance).mean(-1)
            return likelihood + (output.process - levels).square().sum(-1).mean(-1)

        def losses(draw: Draw) -> Tensor:
            return loss_of(
                network(train.inputs[draw.rows], draw.seeds, dropout), train.targets[draw.rows]
            )

        def judge() -> Tensor:
            return loss_of(network(judged.inputs.unsqueeze(0)), judged.targets)

        return sample_phase(
            "pre_training",
            network,
            training.pre_training,
            training.pre_training_batch,
            len(train.targets),
            1,
            losses,
            judge,
        )


class EndToEnd:
    """Sequences, loss and gradient of the training through network and filter (Eqs. 7 and 8).

    Parameters
    ----------
    estimator : CnnUkf
        With an identified filter; its network is trained.
    samples : Samples
        Scaled inputs (N, C) of the recordings, one after another, for the network.
    recordings : sequence of Recording
        Training recordings with ``vy_ref``.
    training : EndToEndSettings
        Length and number of sequences, unit and limit of the loss.

    Raises
    ------
    DataError
        No recording has as many samples as a sequence.
    """

    def __init__(
        self,
        estimator: CnnUkf,
        samples: Samples,
        recordings: Sequence[Recording],
        training: EndToEndSettings,
    ) -> None:
        self.estimator = estimator
        self.samples = samples
        self.recordings = recordings
        self.training = training
        self.filter = TrackFilter(estimator.track())
        self.sensors = estimator.noise_covariances(estimator.levels)[1]
        self.lengths = [len(recording) for recording in recordings]
        self.offsets = np.concatenate([[0], np.cumsum(self.lengths)])
        if max(self.lengths) < training.steps:
            raise DataError(
                f"no training recording is {training.steps} samples long, as a sequence for "
                f"training through the filter is (the longest has {max(self.lengths)}); lower "
                "training.steps"
            )
        split = [
            estimator.split_samples(recording.stack(estimator.channels)) for recording in recordings
        ]
        self.measured, self.driven = (
            torch.as_tensor(np.concatenate(part)) for part in zip(*split, strict=True)
        )
        self.trusted = torch.as_tensor(
            np.concatenate([estimator.trusts_forces(part[0][:, 0]) for part in split])
        )
        self.sideslip = torch.as_tensor(
            np.concatenate([reference_sideslip(recording) for recording in recordings])
        )
        motion = [
            np.stack([recording["vy_ref"], recording["yaw_rate"]], 1) for recording in recordings
        ]
        self.states = torch.as_tensor(np.concatenate(motion))
        self.lost = 0

    def batches(self, generator: torch.Generator) -> Iterator[Cuts]:
        """Yield the batches of one epoch: sequences of each recording from a random offset on, as
        many as fit, in random order.
        """
        for chosen in drawn_starts(self.lengths, self.training.steps, generator).split(
            self.training.batch_size
        ):
            seeds = torch.randint(2**62, (1,), generator=generator)
            yield self.cut(chosen, seeds)

    def cut(self, firsts: Tensor, seeds: Tensor) -> Cuts:
        """The sequences that begin at the samples ``firsts``, (B,), among all training samples."""
        rows = firsts.unsqueeze(1) + torch.arange(self.training.steps)
        of_sensors = (self.measured[rows], self.driven[rows], self.trusted[rows])
        return Cuts(
            self.samples.inputs[rows],
            self.sideslip[rows],
            *of_sensors,
            self.states[firsts],
            seeds,
            firsts,
        )

    def loss(self, batch: Cuts) -> Tensor:
        """Sum of the mean squared errors of the network's angle and of the filter's (Eq. 7).

        It is in rad², or in deg² if the settings say so.

        Beyond ``training.loss_limit`` squares are continued by their tangents (`robust_squares`).

        Cuts whose covariance or gradient is not finite are left out and counted.

        Raises
        ------
        DivergenceError
            That is more than half of the batch.
        """
        estimator = self.estimator
        count, steps = batch.sideslip.shape
        outputs = estimator.network(
            batch.inputs.reshape(1, count * steps, -1), batch.seeds, estimator.dropout
        )
        outputs = outputs.reshape(count, steps, -1).double()
        lost = torch.zeros(count, dtype=torch.bool)
        if outputs.requires_grad:
            outputs.register_hook(lambda gradient: self.finite_gradient(gradient, batch, lost))
        output = estimator.output_of(outputs)
        initial = Gaussian(batch.start, torch.tensor(START, dtype=torch.float64).square().diag())
        measurements = torch.cat([batch.measured, output.sideslip.unsqueeze(-1)], -1)
        process = torch.diag_embed(output.process.square())
        noise = with_variance(self.sensors[batch.trusted.long()], output.variance)
        filtered = self.filter.filtered(
            measurements, batch.driven, process, noise, initial
        ).steps.filtered
        sideslip = torch.atan2(filtered.mean[..., 0], batch.driven[..., 0])
        finite = torch.isfinite(
            filtered.covariance.detach().sum((-1, -2)) + filtered.mean.detach().sum(-1)
        )
        lost |= self._account(~finite, batch, "covariance")
        limit = math.radians(self.training.loss_limit)
        errors = [
            robust_squares((batch.sideslip - angle)[~lost], limit).mean()
            for angle in (output.sideslip, sideslip)
        ]
        return (errors[0] + errors[1]) * (
            math.degrees(1.0) ** 2 if self.training.loss_unit == "deg" else 1.0
        )

    def finite_gradient(self, gradient: Tensor, batch: Cuts, lost: Tensor) -> Tensor:
        """A gradient, (B, T, 4), that is zero for lost sequences and where it is not finite."""
        bad = ~torch.isfinite(gradient).all(-1)
        bad[lost] = False
        lost = lost | self._account(bad, batch, "gradient")
        return torch.where(lost[:, None, None], 0.0, gradient)

    def _account(self, bad: Tensor, batch: Cuts, quantity: str) -> Tensor:
        """Count the sequences with samples that are not finite, ``bad`` (B, T), and return which
        they are, (B,); raises `DivergenceError` beyond `MAX_LOST_SHARE`.
        """
        lost = bad.any(1)
        number = int(lost.sum())
        self.lost += number
        if number > MAX_LOST_SHARE * len(lost):
            row = int(lost.int().argmax())
            step = int(bad[row].int().argmax())
            raise DivergenceError(
                f"training: phase 'end_to_end': the filter's {quantity} is not finite at "
                f"{self.place(int(batch.firsts[row]) + step)} (step {step + 1} of a sequence), "
                f"nor in {number} of the batch's {len(lost)} sequences; lower "
                "training.end_to_end.learning_rate or check the data with 'vehest data check'"
            )
        return lost

    def place(self, sample: int) -> str:
        """Text of the recording and time of the training sample with this index, for messages."""
        number = int(np.searchsorted(self.offsets, sample, side="right")) - 1
        recording = self.recordings[number]
        time = recording.start_time + (sample - int(self.offsets[number])) / recording.rate_hz
        return f"{time:.2f} s of recording '{recording.id}'"


ESTIMATOR = CnnUkf  # class by which the registry finds the family
