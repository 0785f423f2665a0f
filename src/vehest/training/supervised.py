"""Supervised training of windowed networks: Adam on the mean squared error, with early stopping.

    windows -> `_Prepared` -> batches -> `MemberBatch.descend` or `MemberBatch.step` -> validation
        -> `_Member`

Members (networks of one shape) train as one batch. `MemberBatch` has the weights, their average and
Adam's moments of those that still train, one row each; a `_Member` has what does not depend on the
batch: best weights, losses, the order of windows. A member trains to the same bits as it would
alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn

from vehest.data.errors import DataError
from vehest.data.windows import WindowSet
from vehest.training.adam import Adam
from vehest.training.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from vehest.training.context import (
    MAX_HALVINGS,
    FitContext,
    FitRecord,
    Progress,
    divergence_metrics,
    record_of_epochs,
)
from vehest.training.members import (
    FlatParameters,
    constrain,
    fixed_state,
    is_plain,
    predict_members,
    prepare,
)
from vehest.training.supervised_settings import SupervisedSettings

BATCHES = 64  # batches of compiled networks between two checks whether a training should stop


def train_members(
    networks: Sequence[nn.Module],
    seeds: Sequence[int],
    train: WindowSet,
    validation: WindowSet,
    settings: SupervisedSettings,
    context: FitContext,
) -> list[FitRecord]:
    """Train networks of one shape together; each ends with its own best weights, as if it had been
    trained alone.

    Every member draws its own order of the windows from its own seed, stops on its own, and leaves
    the batch then.

    A member whose validation loss is not finite has diverged: it leaves the batch, and goes on
    alone afterwards from its best weights (those it began with, where no epoch was better) with
    half the step size and new moments, at most `MAX_HALVINGS` times. After that it ends with its
    best weights.

    Parameters
    ----------
    networks : Sequence[nn.Module]
        M networks of one shape and preparation; changed in place, and in evaluation mode
        afterwards.
    seeds : Sequence[int]
        Their seeds.
    train : WindowSet
        Windows to learn from.
    validation : WindowSet
        Windows that decide when to stop and which weights to keep.
    settings : SupervisedSettings
        See `SupervisedSettings`.
    context : FitContext
        Checkpoints, progress and the wish to stop.

    Returns
    -------
    list[FitRecord]
        M records, with mean squared errors [m²/s²] over the batches of each epoch and on the
        validation windows after it. A best epoch of 0: none was finished. Seconds are wall time by
        member, not counting earlier runs that a checkpoint continues.

    Raises
    ------
    DataError
        A member diverged in its first epoch and with every smaller step size.
    ConfigurationError
        A network does not return one number a window.

    Source: Da Lio et al. 2023, Section VI-B; Kingma & Ba, Adam, 2015, Section 7.2 for the averaging
    of the weights.
    """
    run = MemberTraining(networks, seeds, train, validation, settings, context)
    run.resume()
    run.train_batch()
    while run.diverged and not run.interrupted:
        run.go_on_alone(next(iter(run.diverged)))
        run.train_batch()
    return run.finish()


@dataclass(eq=False)
class _Member:
    """Best weights, losses and random numbers of one member, over all batches of a training."""

    best: Tensor  # weights with the lowest validation loss so far, (K,)
    generator: torch.Generator  # random generator of the order of windows, and of seeds of dropout
    best_loss: float = math.inf  # validation loss of the best weights
    best_epoch: int = 0  # number of the best epoch, from 1; 0: no epoch was better than the start
    halvings: int = 0  # number of halvings of the step size, one at each divergence
    returned_at: int = 0  # epoch of the last divergence
    has_diverged: bool = False  # whether the smallest step size diverged too
    train_loss: list[float] = field(default_factory=list)  # training loss of each epoch [m²/s²]
    validation_loss: list[float] = field(default_factory=list)  # after each epoch [m²/s²]

    def patience_start(self) -> int:
        """Epoch from which the patience counts."""
        return max(self.best_epoch, self.returned_at)

    def checkpoint(self, state: dict[str, Tensor], is_finished: bool) -> Checkpoint:
        """A checkpoint with these parameters and moments, empty where the training is over."""
        tensors = {"best": self.best.clone(), **state}
        if not is_finished:
            tensors["generator"] = self.generator.get_state()
        values = {
            "finished": is_finished,
            "halvings": self.halvings,
            "returned_at": self.returned_at,
            "has_diverged": self.has_diverged,
            "epoch": len(self.validation_loss),
            "best_epoch": self.best_epoch,
            "best_loss": self.best_loss,
            "train_loss": list(self.train_loss),
            "validation_loss": list(self.validation_loss),
        }
        return Checkpoint(tensors, values)

    def load(self, checkpoint: Checkpoint) -> dict[str, Tensor]:
        """Continue from a checkpoint; returns its parameters and moments."""
        state = dict(checkpoint.tensors)
        values = checkpoint.values
        self.best = state.pop("best")
        self.best_loss = values["best_loss"]
        self.best_epoch = values["best_epoch"]
        self.halvings = values.get("halvings", 0)
        self.returned_at = values.get("returned_at", 0)
        self.has_diverged = values.get("has_diverged", False)
        self.train_loss = values["train_loss"]
        self.validation_loss = values["validation_loss"]
        if not values["finished"]:
            self.generator.set_state(state.pop("generator"))
        return state

    def record(self, seconds: float, is_interrupted: bool) -> FitRecord:
        """The record of the member's fit, which took ``seconds`` of wall time."""
        metrics = {
            "best_epoch": self.best_epoch,
            "best_validation_loss": min(
                filter(math.isfinite, self.validation_loss), default=math.nan
            ),
            **divergence_metrics(self.halvings, self.has_diverged),
            "train_seconds": seconds,
        }
        return record_of_epochs(self.train_loss, self.validation_loss, metrics, is_interrupted)


class MemberBatch:
    """Weights that train together with Adam's moments and their running average, one row a member.

    Parameters
    ----------
    network : nn.Module
        Whose forward, or compiled recursion, all rows use.
    state : dict[str, Tensor]
        ``parameters`` (M, K), and perhaps ``step``, ``exp_avg``, ``exp_avg_sq`` and ``average``.
        There is no average before the first step, and none without averaging.
    fixed : Mapping[str, Tensor]
        Buffers, and parameters that are not trained, (M, ...).
    generators : Sequence[torch.Generator]
        Random generator of each member.
    step_size : float
        Step size of Adam.
    """

    def __init__(
        self,
        network: nn.Module,
        state: dict[str, Tensor],
        fixed: Mapping[str, Tensor],
        generators: Sequence[torch.Generator],
        step_size: float,
        settings: SupervisedSettings,
    ) -> None:
        self.network = network
        self.layout = FlatParameters(network)
        self.fixed = fixed
        self.generators = generators
        self.settings = settings
        self.average = state.pop("average", None)
        self.weights = nn.Parameter(state.pop("parameters").clone())
        self.adam = Adam([self.weights], step_size)
        if state:
            self.adam.state[self.weights] = state

    def rows(self, rows: Tensor | int) -> dict[str, Tensor]:
        """Copies of weights, average and moments of the members with these indices, by name as in
        ``state``; Adam's step is that of all.
        """
        state = {"parameters": self.weights.detach(), **self.adam.state.get(self.weights, {})}
        if self.average is not None:
            state["average"] = self.average
        return {
            name: (values[rows] if values.dim() else values).clone()
            for name, values in state.items()
        }

    def averaged(self) -> Tensor:
        """The average of the weights where there is one, otherwise the weights, (M, K)."""
        return self.weights.detach() if self.average is None else self.average

    def predict(
        self, weights: Tensor, data: _Prepared, starts: Tensor, seeds: Sequence[int] = ()
    ) -> Tensor:
        """Predictions of all members on their own windows.

        Parameters
        ----------
        weights : Tensor
            (M, K); the current weights or their average.
        data : _Prepared
            Prepared series.
        starts : Tensor
            First rows of windows, (M, B).
        seeds : Sequence[int], default ()
            Seed of each member for layers that draw random numbers.

        Returns
        -------
        Tensor
            (M, B) [m/s].
        """
        return predict_members(
            self.network,
            {**self.layout.views(weights), **self.fixed},
            data.series,
            starts,
            data.n_window,
            compiled=self.settings.compiled,
            seeds=seeds,
        )

    def step(self, data: _Prepared, windows: Tensor) -> Tensor:
        """Take one step of Adam on one batch.

        The loss of a member is its mean squared error; losses are added over members, so that each
        row of the gradient is that of one member. Parameters are constrained afterwards, then
        averaged.

        Parameters
        ----------
        data : _Prepared
            Training windows.
        windows : Tensor
            Indices of windows, (M, B).

        Returns
        -------
        Tensor
            Sum of squared errors of each member before the step, (M,), float64 [m²/s²].
        """
        self.adam.zero_grad()
        prediction = self.predict(self.weights, data, data.starts[windows], self._dropout_seeds())
        losses = (prediction - data.targets[windows]).square().mean(dim=1)
        losses.sum().backward()
        self.adam.step()
        with torch.no_grad():
            constrain(self.network, self.layout.views(self.weights.detach()))
        if self.settings.averaging:
            self._update_average()
        return losses.detach().double() * windows.shape[1]

    def descend(self, data: _Prepared, windows: Tensor) -> Tensor:
        """Take steps on several batches by compiled code; arguments and result are those of `step`.

        Bounds of parameters are found by constraining rows of -∞ and ∞ once. Adam's moments and the
        average are changed in place.
        """
        settings = self.settings
        weights = self.weights.detach()
        state = self.adam.state[self.weights]
        if not state:
            state |= {
                "step": torch.tensor(0.0),
                "exp_avg": torch.zeros_like(weights),
                "exp_avg_sq": torch.zeros_like(weights),
            }
        if settings.averaging and self.average is None:
            self.average = torch.zeros_like(weights)
        bounds = weights.new_tensor([[-math.inf], [math.inf]]).repeat(1, weights.shape[1])
        constrain(self.network, self.layout.views(bounds))
        losses: Tensor = self.network.compiled_descent(  # type: ignore[operator]
            weights,
            state | ({"average": self.average} if settings.averaging else {}),
            data.series,
            data.starts[windows],
            data.targets[windows],
            settings.batch_size,
            self.adam.learning_rate,
            bounds,
            settings.averaging,
        )
        return losses

    def _update_average(self) -> None:
        """Add the weights after step t to their average.

        θ̄ₜ = (1 - a)/(1 - aᵗ) Σᵢ aᵗ⁻ⁱ θᵢ, i = 1 … t. The factor makes the weights of the sum add up
        to one from the first step on.
        """
        if self.average is None:
            self.average = self.weights.detach().clone()
            return
        decay = self.settings.averaging
        step = float(self.adam.state[self.weights]["step"])
        self.average.lerp_(self.weights.detach(), (1.0 - decay) / (1.0 - decay**step))

    def _dropout_seeds(self) -> list[int]:
        """One seed a member for random layers of plain networks; compiled networks draw nothing."""
        if not is_plain(self.network):
            return []
        return [
            int(torch.randint(2**63 - 1, (), generator=generator)) for generator in self.generators
        ]


@dataclass
class MemberTraining:
    """State of a training of several members, which `train_members` runs.

    Attributes
    ----------
    active : list[int]
        Indices of the members that train in ``batch``, in the order of its rows.
    batch : MemberBatch
        Their weights and Adam's moments.
    epoch : int
        Finished epochs of the active members.
    """

    networks: Sequence[nn.Module]  # networks of the members
    seeds: Sequence[int]  # seed of each member
    train_windows: WindowSet  # windows to learn from
    validation_windows: WindowSet  # windows for early stopping
    settings: SupervisedSettings  # settings of the training
    context: FitContext  # checkpoints, stop request and progress

    def __post_init__(self) -> None:
        """Prepare both window sets, and activate all members with the networks' present weights."""
        self.network = self.networks[0]
        self.fixed = fixed_state(self.networks) if is_plain(self.network) else {}
        self.train = _Prepared(self.network, self.train_windows, self.settings)
        self.validation = _Prepared(self.network, self.validation_windows, self.settings)
        weights = FlatParameters(self.network).pack(self.networks)
        self.members = [
            _Member(start.clone(), torch.Generator().manual_seed(shuffle_seed(seed)))
            for start, seed in zip(weights, self.seeds, strict=True)
        ]
        # members that continue alone later, in their order, with the state that they continue from;
        # an empty state stands for their best weights
        self.diverged: dict[int, dict[str, Tensor]] = {}
        self.epoch = 0  # of the members still active
        self.interrupted = False
        self.started = time.monotonic()
        self.saved = self.started
        self._activate(list(range(len(self.members))), {"parameters": weights})

    def _activate(self, members: list[int], state: dict[str, Tensor]) -> None:
        """Make these members the active batch, from a ``state`` as of `MemberBatch`."""
        self.active = members
        # active members never diverged, or there is a single one
        halvings = self.members[members[0]].halvings if members else 0
        self.batch = MemberBatch(
            self.network,
            state,
            {name: values[members] for name, values in self.fixed.items()},
            [self.members[index].generator for index in members],
            self.settings.learning_rate * 0.5**halvings,
            self.settings,
        )

    def train_batch(self) -> None:
        """Train the active members until each is over, or until a stop."""
        while self.active and self.epoch < self.settings.max_epochs:
            self.train_epoch()
            if self.interrupted:
                return

    def go_on_alone(self, member: int) -> None:
        """Let a member that has diverged be the only active one."""
        state = self.diverged.pop(member)
        self.epoch = len(self.members[member].validation_loss)
        self._activate([member], state or {"parameters": self.members[member].best.unsqueeze(0)})

    def train_epoch(self) -> None:
        """Train the active members for one epoch, then validate them."""
        before = self._checkpoints()
        n_windows = self._epoch_windows()
        order = torch.stack(
            [
                torch.randperm(len(self.train), generator=self.members[index].generator)[:n_windows]
                for index in self.active
            ]
        )
        total = torch.zeros(len(self.active), dtype=torch.float64)
        self.network.train()
        compiled = self.settings.compiled and hasattr(self.network, "compiled_descent")
        train = self.batch.descend if compiled else self.batch.step
        for windows in order.split(self.settings.batch_size * (BATCHES if compiled else 1), dim=1):
            if self.context.should_stop():
                self.interrupted = True
                self._save(before)
                return
            total += train(self.train, windows)
        self.epoch += 1
        self._judge(total / n_windows)

    def _epoch_windows(self) -> int:
        """Number of training windows in an epoch."""
        n_windows = self.settings.epoch_steps * self.settings.batch_size
        return min(n_windows or len(self.train), len(self.train))

    def _judge(self, train_loss: Tensor) -> None:
        """Validate the weights or their average; members that are over leave the batch."""
        weights = self.batch.averaged()
        self.network.eval()
        with torch.no_grad():
            starts = self.validation.starts.expand(len(self.active), -1)
            prediction = self.batch.predict(weights, self.validation, starts)
            loss = (prediction.double() - self.validation.targets.double()).square().mean(dim=1)
        is_training = [
            self._record_losses(index, *values)
            for index, *values in zip(
                self.active, weights, train_loss.tolist(), loss.tolist(), strict=True
            )
        ]
        if not all(is_training):
            remaining = [row for row, goes_on in enumerate(is_training) if goes_on]
            self._activate(
                [self.active[row] for row in remaining],
                self.batch.rows(torch.tensor(remaining, dtype=torch.int64)),
            )
        self.context.on_progress(
            Progress(
                self.epoch,
                self.settings.max_epochs,
                len(self.active),
                len(self.networks),
                min(member.best_loss for member in self.members),
            )
        )
        if time.monotonic() - self.saved > self.settings.checkpoint_seconds:
            self._save(self._checkpoints())

    def _record_losses(
        self, index: int, weights: Tensor, train_loss: float, validation_loss: float
    ) -> bool:
        """Note the losses of an epoch; return whether the member trains on in this batch.

        A member that diverged continues alone from its best weights, unless this was its last epoch
        or its step size was halved `MAX_HALVINGS` times. Raises `DataError`: no epoch was finite.
        """
        member = self.members[index]
        member.train_loss.append(train_loss)
        member.validation_loss.append(validation_loss)
        if math.isfinite(validation_loss):
            if validation_loss < member.best_loss:
                member.best = weights.clone()
                member.best_loss = validation_loss
                member.best_epoch = self.epoch
            return self.epoch - member.patience_start() < self.settings.patience
        if member.halvings < MAX_HALVINGS and self.epoch < self.settings.max_epochs:
            member.halvings += 1
            member.returned_at = self.epoch
            self.diverged[index] = {}
            return False
        if not member.best_epoch:
            raise DataError(
                f"training: the validation loss of training {index} is {validation_loss} after "
                f"epoch {self.epoch}; lower training.learning_rate or check the data with 'vehest "
                "data check'"
            )
        member.has_diverged = True
        return False

    def _checkpoints(self) -> list[Checkpoint]:
        """A checkpoint of each member by itself, finished ones included, so that any of them can
        continue without the others.
        """
        row_of = {index: row for row, index in enumerate(self.active)}
        checkpoints = []
        for index, member in enumerate(self.members):
            state: dict[str, Tensor] = {}
            if index in row_of:
                state = self.batch.rows(row_of[index])
            elif index in self.diverged:
                state = {
                    name: row if row.dim() == 0 else row[0]
                    for name, row in self.diverged[index].items()
                }
            is_finished = index not in row_of and index not in self.diverged
            checkpoints.append(member.checkpoint(state, is_finished))
        return checkpoints

    def _save(self, checkpoints: Sequence[Checkpoint]) -> None:
        """Store one checkpoint for each member that has a folder."""
        self.saved = time.monotonic()
        for folder, checkpoint in zip(self.context.checkpoint_folders, checkpoints, strict=False):
            save_checkpoint(folder, checkpoint)

    def resume(self) -> None:
        """Go on from the members' checkpoints, if all have one and those that are not finished
        agree in the epoch.

        Members that never diverged continue as one batch; each that did continues alone later.
        Otherwise all start anew.
        """
        loaded = [load_checkpoint(folder) for folder in self.context.checkpoint_folders]
        checkpoints = [checkpoint for checkpoint in loaded if checkpoint is not None]
        if len(checkpoints) < len(self.networks) or any(
            c.tensors["best"].shape != self.members[0].best.shape for c in checkpoints
        ):
            return
        unfinished = [
            member
            for member, checkpoint in enumerate(checkpoints)
            if not checkpoint.values["finished"]
        ]
        together = [m for m in unfinished if not checkpoints[m].values.get("halvings", 0)]
        epochs = {checkpoints[member].values["epoch"] for member in together}
        if len(epochs) > 1:
            return
        states = [
            member.load(checkpoint)
            for member, checkpoint in zip(self.members, checkpoints, strict=True)
        ]
        self.active = together
        self.epoch = (
            epochs.pop()
            if epochs
            else max(checkpoint.values["epoch"] for checkpoint in checkpoints)
        )
        if together:
            self._activate(together, _stacked([states[member] for member in together]))
        for member in unfinished:
            if member not in together:
                self.diverged[member] = _stacked([states[member]])

    def finish(self) -> list[FitRecord]:
        """Copy the best weights into the networks, set these to evaluation mode, and return the
        records.

        A member counts as interrupted only if the training was stopped before that member was over.
        """
        seconds = (time.monotonic() - self.started) / len(self.networks)
        unfinished = {*self.active, *self.diverged} if self.interrupted else set()
        layout = FlatParameters(self.network)
        for network, member in zip(self.networks, self.members, strict=True):
            layout.unpack(member.best, network.eval())
        return [
            member.record(seconds, index in unfinished) for index, member in enumerate(self.members)
        ]


def _stacked(states: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Stack the states of members that continue together, by name; Adam's step is that of all."""
    rows = {name: torch.stack([state[name] for state in states]) for name in states[0]}
    return rows | ({"step": states[0]["step"]} if "step" in rows else {})


class _Prepared:
    """A window set as tensors, scaled once.

    Parameters
    ----------
    network : nn.Module
        Whose ``prepared`` the series passes.
    windows : WindowSet
        Series (T, C), first rows of windows, and targets [m/s].
    settings : SupervisedSettings
        Of which the precision is used.

    Attributes
    ----------
    series : Tensor
        (T, C), contiguous.
    targets : Tensor
        Lateral velocity of each window (W,) [m/s].
    starts : Tensor
        First row of each window (W,), int64.
    n_window : int
        Samples in a window.
    """

    def __init__(
        self, network: nn.Module, windows: WindowSet, settings: SupervisedSettings
    ) -> None:
        dtype = getattr(torch, settings.dtype)
        with torch.no_grad():
            self.series: Tensor = prepare(
                network, torch.as_tensor(windows.series, dtype=dtype)
            ).contiguous()
        self.targets = torch.as_tensor(windows.targets, dtype=dtype)
        self.starts = torch.as_tensor(windows.starts)
        self.n_window = windows.n_window

    def __len__(self) -> int:
        return len(self.starts)


def shuffle_seed(seed: int) -> int:
    """Seed of the order of windows, independent of the stream from which initial weights were
    drawn.
    """
    return int(np.random.SeedSequence([seed, 1]).generate_state(1, np.uint64)[0] >> np.uint64(1))
