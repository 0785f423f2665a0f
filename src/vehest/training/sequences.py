"""Training by gradient descent in consecutive phases, on sequences or on pairs of samples.

    Phase (module, batches, loss, validation) --train_phases--> PhaseRecord
                                                                best parameters in the module

Within a phase: batches of an epoch -> loss -> gradient -> clipping -> AdamW -> validation -> best
parameters. The state is stored as a `Checkpoint`, from which a killed run continues to the same
result.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from vehest.data.errors import ConfigurationError, DataError
from vehest.declared import Group, setting
from vehest.training.adam import Adam
from vehest.training.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from vehest.training.context import (
    MAX_HALVINGS,
    DivergenceError,
    FitContext,
    FitRecord,
    Progress,
    divergence_metrics,
    record_of_epochs,
)

SKIPS_ALLOWED = 20  # steps in a row without a finite loss and gradient that count as divergence


@dataclass(frozen=True)
class PhaseSettings(Group):
    """One phase of training by gradient on sequences or pairs (`vehest.training.sequences`)."""

    group = "training: phase"
    learning_rate: float = setting(5e-4, "AdamW's step size", positive=True)
    max_epochs: int = setting(
        1000, "epochs after which the phase ends in any case; 0 leaves it out", least=0
    )
    patience: int = setting(
        0,
        "epochs without a better validation loss after which it ends; 0 never ends it early",
        least=0,
    )
    validate_every: int = setting(
        1, "epochs between two validations; the last epoch is always validated", least=1
    )
    clip: float = setting(
        1e3, "bound on the magnitude of each element of the gradient; 0 for none", least=0.0
    )
    weight_decay: float = setting(0.0, "AdamW's decoupled weight decay", least=0.0)
    schedule: Literal["constant", "cosine"] = setting(
        "constant", "step size: constant, or a cosine to zero over max_epochs"
    )


@dataclass(frozen=True)
class Phase:
    """A phase of a training: the module that is trained, its batches, its loss and its validation.

    Phases may be of one module or of several that share parameters; what an earlier phase learnt is
    where a later one starts. The module is never asked for random numbers: what is random about an
    epoch (order, offsets, masks of dropout) is drawn by ``batches``.
    """

    name: str  # name in messages and in the checkpoint; unique among the phases of a training
    settings: PhaseSettings  # step size, epochs, patience, clipping
    module: nn.Module  # module whose parameters are changed in place
    # returns the batches of one epoch; draws random numbers from the generator and from no other
    batches: Callable[[torch.Generator], Iterable[Any]]
    loss: Callable[[Any], Tensor]  # returns the loss of a batch, a scalar with a gradient
    # returns the loss on the validation data with the present parameters, without gradients
    validation: Callable[[], float]
    # whether a parameter of this name learns, while the others are frozen; None: all learn
    trainable: Callable[[str], bool] | None = None
    # called once before the first validation; may set parameters that this phase starts from
    prepare: Callable[[], None] | None = None


@dataclass
class PhaseRecord:
    """Progress and losses of a phase, as plain values, which a checkpoint stores."""

    name: str  # name of the phase
    # epoch (from 1) whose parameters were kept; 0 if none was better than the start
    best_epoch: int = 0
    best_loss: float = math.inf  # validation loss of the parameters that were kept
    # validation loss before the first epoch; NaN if it was stopped before
    start_loss: float = math.nan
    # training loss of each epoch: mean over its batches, skipped ones left out
    train_loss: list[float] = field(default_factory=list)
    # validation loss after each epoch; NaN where not validated
    validation_loss: list[float] = field(default_factory=list)
    seconds: float = 0.0  # wall time, earlier runs that a checkpoint continues included [s]
    skipped_steps: int = 0  # batches whose loss or gradient was not finite
    skipped_in_a_row: int = 0  # consecutive batches that were skipped, up to the last one
    validated: bool = False  # whether the validation before the first epoch is done
    interrupted: bool = False  # whether the phase was stopped before it was over
    # number of divergences after which it continued from its best with half the step size
    halvings: int = 0
    returned_at: int = 0  # epochs finished at the last of these, from which its patience counts
    # whether the phase ended because the smallest step size diverged too
    has_diverged: bool = False
    problem: str = ""  # error message of the last divergence; empty: it never diverged

    @property
    def epochs(self) -> int:
        """Number of finished epochs."""
        return len(self.train_loss)

    def is_over(self, settings: PhaseSettings) -> bool:
        """Whether the phase ends here: it diverged, ran all epochs, or its patience is over."""
        if self.has_diverged or self.epochs >= settings.max_epochs:
            return True
        is_validated = self.epochs % settings.validate_every == 0
        waited = self.epochs - max(self.best_epoch, self.returned_at) if is_validated else 0
        return 0 < settings.patience <= waited


def record_of_phases(phases: Sequence[PhaseRecord]) -> FitRecord:
    """The record of a fit in phases: history over the epochs of all phases, and metrics of the last
    phase; epochs, skipped steps and seconds are those of all phases.
    """
    last = phases[-1]
    metrics = {
        "best_epoch": last.best_epoch,
        "best_validation_loss": last.best_loss,
        "start_validation_loss": last.start_loss,
        "skipped_steps": sum(phase.skipped_steps for phase in phases),
        "train_seconds": sum(phase.seconds for phase in phases),
        **{f"{phase.name}_seconds": phase.seconds for phase in phases},
        **divergence_of_phases(phases),
    }
    train_loss = [loss for phase in phases for loss in phase.train_loss]
    validation_loss = [loss for phase in phases for loss in phase.validation_loss]
    numbers = [number for number, phase in enumerate(phases) for _ in phase.train_loss]
    return record_of_epochs(train_loss, validation_loss, metrics, last.interrupted, phase=numbers)


def divergence_of_phases(phases: Sequence[PhaseRecord]) -> dict[str, float]:
    """`divergence_metrics` of a training in phases, over all of them."""
    return divergence_metrics(
        sum(phase.halvings for phase in phases), any(phase.has_diverged for phase in phases)
    )


def train_phases(
    phases: Sequence[Phase],
    seed: int,
    context: FitContext,
    folder_index: int = 0,
    checkpoint_seconds: float = 15.0,
    twins: Sequence[int] = (),
) -> list[PhaseRecord]:
    """Train one member through its phases by AdamW; each phase ends with the parameters of its best
    validation.

    The start of a phase counts as a candidate. A step whose loss or gradient is not finite is
    skipped and counted. Gradients are clipped element by element. Each phase draws from a stream of
    its own of ``seed``, so that its batches do not depend on the length of the phases before it.

    Where `SKIPS_ALLOWED` steps in a row are not finite, or a loss raises `DivergenceError`, the
    phase returns to its best parameters and goes on with half the step size and new moments, at
    most `MAX_HALVINGS` times. After that it ends with its best parameters, and later phases go on
    from them.

    A stop ends within the current epoch, which the next run does again; the phase's best parameters
    so far are in its module then.

    Parameters
    ----------
    phases : Sequence[Phase]
        In their order; names differ.
    seed : int
        Seed of the batches.
    context : FitContext
        Folders of checkpoints, stop request (polled before every batch), and progress callback.
    folder_index : int, default 0
        Which of ``context.checkpoint_folders`` is this member's, where several train one after the
        other.
    checkpoint_seconds : float, default 15.0
        Time between two checkpoints [s].
    twins : Sequence[int], default ()
        Other members' folders that keep the same checkpoint, since they get the same weights.

    Returns
    -------
    list[PhaseRecord]
        One record for every phase that was begun.

    Raises
    ------
    DataError
        A phase diverged before anything was learnt, or all of its validations were not finite.
    ConfigurationError
        Phases of equal names, or nothing to learn in one.

    Source: Loshchilov & Hutter, Decoupled weight decay regularization, 2019 (AdamW); Węgrzynowski
    et al. 2024 train in such phases.
    """
    if len({phase.name for phase in phases}) != len(phases):
        raise ConfigurationError(
            "training: phases must have different names, not "
            f"{', '.join(phase.name for phase in phases)}"
        )
    folders = [
        context.checkpoint_folders[i]
        for i in (folder_index, *twins)
        if i < len(context.checkpoint_folders)
    ]
    run = PhaseTraining(phases, seed, context, folder_index, checkpoint_seconds, folders)
    run.resume()
    while run.position < len(phases) and not run.current.interrupted:
        run.train_phase()
    return run.records


@dataclass
class PhaseTraining:
    """State of a training through its phases, which `train_phases` runs.

    ``records`` has one entry for each phase begun. Of the current phase there are the parameters
    (``state``), the best of them, Adam's moments and the random generator.
    """

    phases: Sequence[Phase]  # phases of the training, in order
    seed: int  # seed of its random numbers
    context: FitContext  # checkpoints, stop request and progress
    folder_index: int  # index of its folder of checkpoints in the context
    checkpoint_seconds: float  # shortest time between two checkpoints [s]
    # folders in which the checkpoint is kept: the member's own and those of its twins
    folders: Sequence[Path]

    def __post_init__(self) -> None:
        self.state = _shared_state(self.phases)
        self.records: list[PhaseRecord] = []
        self.saved = time.monotonic()
        self._begin(0)

    @property
    def current(self) -> PhaseRecord:
        """The record of the current phase."""
        return self.records[-1]

    def _begin(self, position: int) -> None:
        """Set the state to the start of the phase with this index, or to the end of all phases."""
        self.position = position
        self.best = _copies(self.state)
        if position == len(self.phases):
            return
        phase = self.phase = self.phases[position]
        self.records.append(PhaseRecord(phase.name))
        self.generator = torch.Generator().manual_seed(_stream(self.seed, position))
        named = phase.module.named_parameters()
        self.learning = {
            name: value for name, value in named if phase.trainable is None or phase.trainable(name)
        }
        if not self.learning:
            raise ConfigurationError(
                f"training: phase '{phase.name}' has no parameters to learn; correct which of them "
                "are trainable"
            )
        self.adam = self._new_adam()

    def _new_adam(self) -> Adam:
        """Adam for the parameters that the current phase learns, without moments yet."""
        return Adam(self.learning.values(), self._step_size(), self.phase.settings.weight_decay)

    def _step_size(self) -> float:
        """Step size of the current epoch, halved once for each divergence of the phase."""
        settings = self.phase.settings
        size = settings.learning_rate
        if settings.schedule == "cosine":
            progress = self.current.epochs / max(settings.max_epochs, 1)  # 0: a phase left out
            size = size * 0.5 * (1.0 + math.cos(math.pi * progress))
        return size * 0.5**self.current.halvings

    def train_phase(self) -> None:
        """Train the current phase from its present state to its end, or until a stop."""
        phase = self.phase
        requires_grad = {
            name: value.requires_grad for name, value in phase.module.named_parameters()
        }
        started = time.monotonic() - self.current.seconds
        try:
            for name, value in phase.module.named_parameters():
                value.requires_grad_(name in self.learning)
            while not self.current.is_over(phase.settings) and not self.current.interrupted:
                self._train_epoch(started)
        finally:
            for name, value in phase.module.named_parameters():
                value.requires_grad_(requires_grad[name])
                value.grad = None
        now = self.current
        if now.epochs and not math.isfinite(now.best_loss) and not now.interrupted:
            raise DataError(
                now.problem
                or f"training: phase '{phase.name}' had no finite validation loss in {now.epochs} "
                "epochs; lower its learning_rate or check the data with 'vehest data check'"
            )
        is_trained = any(record.best_epoch for record in self.records)
        if now.problem and not is_trained and not now.interrupted:
            raise DataError(now.problem)
        _restore(self.state, self.best)
        if not now.interrupted:
            self._begin(self.position + 1)
            self._save_now_and_then(self.position == len(self.phases))

    def _train_epoch(self, started: float) -> None:
        """Train on all batches of an epoch, then validate; an epoch that is stopped is undone, so
        that the checkpoint before it stays.
        """
        phase = self.phase
        settings = self.phase.settings
        now = self.current
        if not now.validated:
            if self.context.should_stop():
                self._stop(self._checkpoint())
                return
            if phase.prepare is not None:
                with torch.no_grad():
                    phase.prepare()
            now.start_loss = self._validate()
            now.validated = True
        before = self._checkpoint()
        self.adam.learning_rate = self._step_size()
        total = 0.0
        finite_steps = 0
        for number, batch in enumerate(phase.batches(self.generator), start=1):
            if self.context.should_stop():
                self._stop(before)
                return
            loss = self._step(batch, f"epoch {now.epochs + 1}, step {number}")
            if now.has_diverged:
                return
            if loss is not None:
                total = total + loss
                finite_steps = finite_steps + 1
        now.train_loss.append(total / finite_steps if finite_steps else math.nan)
        judged = now.epochs % settings.validate_every == 0 or now.epochs == settings.max_epochs
        now.validation_loss.append(self._validate() if judged else math.nan)
        now.seconds = time.monotonic() - started
        done = sum(record.epochs for record in self.records)
        allowed = (
            done
            - now.epochs
            + sum(phase.settings.max_epochs for phase in self.phases[self.position :])
        )
        members = max(len(self.context.checkpoint_folders), self.folder_index + 1)
        self.context.on_progress(
            Progress(done, allowed, members - self.folder_index, members, now.best_loss)
        )
        self._save_now_and_then()

    def _stop(self, before: Checkpoint) -> None:
        """Interrupt the training in the state of ``before``."""
        self._save(before)
        self.records[-1] = PhaseRecord(**before.values["phases"][-1])
        self.current.interrupted = True

    def _step(self, batch: Any, place: str) -> float | None:
        """Take one step of AdamW on a batch; returns the loss, or None if it or its gradient is not
        finite, in which case nothing is changed.
        """
        self.adam.zero_grad()
        now = self.current
        try:
            loss = self.phase.loss(batch)
            value = float(loss.detach())
            if math.isfinite(value):
                loss.backward()
        except DivergenceError as error:
            self._return_to_best(str(error))
            return None
        gradients = [
            parameter.grad for parameter in self.learning.values() if parameter.grad is not None
        ]
        if math.isfinite(value) and all(
            np.isfinite(gradient.numpy()).all() for gradient in gradients
        ):
            if self.phase.settings.clip:
                nn.utils.clip_grad_value_(self.learning.values(), self.phase.settings.clip)
            self.adam.step()
            now.skipped_in_a_row = 0
            return value
        now.skipped_steps += 1
        now.skipped_in_a_row += 1
        if now.skipped_in_a_row >= SKIPS_ALLOWED:
            self._return_to_best(
                f"training: phase '{now.name}', {place}: loss ({value:g}) or gradient not finite "
                f"{SKIPS_ALLOWED} times in a row; lower its learning_rate or check the data with "
                "'vehest data check'"
            )
        return None

    def _return_to_best(self, problem: str) -> None:
        """Go on from the phase's best parameters with half the step size, or end the phase after
        `MAX_HALVINGS` of them.
        """
        now = self.current
        now.problem = problem
        if now.halvings == MAX_HALVINGS:
            now.has_diverged = True
            return
        _restore(self.state, self.best)
        now.halvings += 1
        now.skipped_in_a_row = 0
        now.returned_at = now.epochs
        self.adam = self._new_adam()

    def _validate(self) -> float:
        """Compute the validation loss, and store the parameters if it is the lowest so far."""
        with torch.no_grad():
            loss = float(self.phase.validation())
        if loss < self.current.best_loss:
            self.current.best_loss = loss
            self.current.best_epoch = self.current.epochs
            self.best = _copies(self.state)
        return loss

    def _checkpoint(self) -> Checkpoint:
        """A checkpoint with copies of the present state."""
        finished = self.position == len(self.phases)
        epoch = sum(record.epochs for record in self.records)
        values = {
            "finished": finished,
            "epoch": epoch,
            "phases": [asdict(record) for record in self.records],
        }
        tensors = {f"best.{name}": value for name, value in self.best.items()}
        if not finished:
            tensors |= {f"now.{name}": value for name, value in _copies(self.state).items()}
            tensors["generator"] = self.generator.get_state()
            for number, parameter in enumerate(self.learning.values()):
                tensors |= {
                    f"adam.{number}.{name}": value.clone()
                    for name, value in self.adam.state.get(parameter, {}).items()
                }
        return Checkpoint(tensors, values)

    def _save_now_and_then(self, in_any_case: bool = False) -> None:
        """Store a checkpoint in any case, or if the last is older than ``checkpoint_seconds``."""
        if in_any_case or time.monotonic() - self.saved > self.checkpoint_seconds:
            self._save(self._checkpoint())

    def _save(self, checkpoint: Checkpoint) -> None:
        """Store a checkpoint in the folder of this member and in those of its twins."""
        self.saved = time.monotonic()
        for folder in self.folders:
            save_checkpoint(folder, checkpoint)

    def resume(self) -> None:
        """Go on from the checkpoint, if there is one and it is of these phases and modules."""
        checkpoint = load_checkpoint(self.folders[0]) if self.folders else None
        if checkpoint is None or not _is_of(checkpoint, self.phases, self.state):
            return
        finished = checkpoint.values["finished"]
        records = [PhaseRecord(**record) for record in checkpoint.values["phases"]]
        best = _tensors_below(checkpoint, "best.")
        _restore(self.state, best if finished else _tensors_below(checkpoint, "now."))
        self._begin(len(records) if finished else len(records) - 1)
        self.records = records
        if not finished:
            self.adam = self._new_adam()
            self.best = best
            self.generator.set_state(checkpoint.tensors["generator"])
            for number, parameter in enumerate(self.learning.values()):
                self.adam.state[parameter] = _tensors_below(checkpoint, f"adam.{number}.")


def _is_of(checkpoint: Checkpoint, phases: Sequence[Phase], state: Mapping[str, Tensor]) -> bool:
    """Whether a checkpoint is of these phases and of tensors with the shapes of ``state``."""
    names = [record["name"] for record in checkpoint.values.get("phases", ())]
    phase_names = [phase.name for phase in phases]
    shapes = {name: value.shape for name, value in _tensors_below(checkpoint, "best.").items()}
    has_phases = len(names) == len(phase_names) if checkpoint.values["finished"] else bool(names)
    return (
        has_phases
        and names == phase_names[: len(names)]
        and shapes == {name: value.shape for name, value in state.items()}
    )


def drawn_starts(lengths: Sequence[int], steps: int, generator: torch.Generator) -> Tensor:
    """First rows of training sequences, drawn anew for each epoch.

    As many sequences of ``steps`` samples as fit into a drive follow one another without overlap,
    from an offset that is drawn; the sequences of all drives are then shuffled.

    Parameters
    ----------
    lengths : Sequence[int]
        Samples of each drive; drives lie one after another in one series. A drive that is shorter
        than a sequence is left out.
    steps : int
        Samples of a sequence.
    generator : torch.Generator
        Source of the offsets and of the order.

    Returns
    -------
    Tensor
        Rows of the series, int64, (number of sequences,).
    """
    firsts: list[int] = []
    offset = 0
    for length in lengths:
        used_samples = length // steps * steps
        if used_samples:
            shift = offset + int(torch.randint(length - used_samples + 1, (), generator=generator))
            firsts += range(shift, shift + used_samples, steps)
        offset += length
    return torch.tensor(firsts)[torch.randperm(len(firsts), generator=generator)]


def _shared_state(phases: Sequence[Phase]) -> dict[str, Tensor]:
    """Parameters and buffers of all phases by name, each once, under the first phase that has
    it.
    """
    state: dict[str, Tensor] = {}
    collected_ids: set[int] = set()
    for position, phase in enumerate(phases):
        for name, value in phase.module.state_dict(keep_vars=True).items():
            if id(value) not in collected_ids:
                collected_ids.add(id(value))
                state[f"{position}.{name}"] = value
    return state


def _copies(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Copies of tensors without their gradients."""
    return {name: value.detach().clone() for name, value in tensors.items()}


def _restore(state: Mapping[str, Tensor], values: Mapping[str, Tensor]) -> None:
    """Copy values into the tensors of a state, in place."""
    with torch.no_grad():
        for name, value in state.items():
            value.copy_(values[name])


def _tensors_below(checkpoint: Checkpoint, prefix: str) -> dict[str, Tensor]:
    """Tensors of a checkpoint whose names begin with a prefix, without it."""
    return {
        name.removeprefix(prefix): value
        for name, value in checkpoint.tensors.items()
        if name.startswith(prefix)
    }


def _stream(seed: int, position: int) -> int:
    """Seed of the batches of a phase.

    It is derived from the training's seed by ``SeedSequence``, so that it is independent of the
    stream from which the initial weights were drawn and of those of other phases.
    """
    return int(
        np.random.SeedSequence([seed, 1, position]).generate_state(1, np.uint64)[0] >> np.uint64(1)
    )
