"""Supervised training of windowed networks: Adam on the mean squared error, early stopping, members side by side."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

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

BATCHES = 64  # that compiled networks take before a training looks whether it should stop


def train_members(
    networks: Sequence[nn.Module],
    seeds: Sequence[int],
    train: WindowSet,
    validation: WindowSet,
    settings: SupervisedSettings,
    context: FitContext,
) -> list[FitRecord]:
    """Train networks of one shape together; each ends with its own best weights, as if it had been trained alone.

    Every member draws its own order of the windows from its own seed, stops on its own, and leaves the batch then.

    A member whose validation loss is not finite has diverged: it leaves the batch, and goes on alone afterwards from its best weights (those it
    began with, where no epoch was better) with half the step size and new moments, at most `MAX_HALVINGS` times. After that it ends with its
    best weights.

    Args:
        networks: M networks of one shape and preparation; changed in place, and in evaluation mode afterwards.
        seeds: their seeds.
        train: windows to learn from.
        validation: windows that decide when to stop and which weights to keep.
        settings: see `SupervisedSettings`.
        context: checkpoints, progress and the wish to stop.

    Returns:
        M records, with mean squared errors [m²/s²] over the batches of each epoch and on the validation windows after it. A best epoch of
        0: none was finished. Seconds are wall time by member, not counting earlier runs that a checkpoint continues.

    Raises:
        DataError: a member diverged in its first epoch and with every smaller step size.
        ConfigurationError: a network does not return one number a window.

    Source:
        Da Lio et al. 2023, Section VI-B; Kingma & Ba, Adam, 2015, Section 7.2 for the averaging of the weights.
    """
    run = _Run(networks, seeds, train, validation, settings, context)
    run.resume()
    run.train_batch()
    while run.diverged and not run.interrupted:
        run.go_on_alone(next(iter(run.diverged)))
        run.train_batch()
    return run.finish()


@dataclass
class _Run:
    """State of one training; rows of ``flat``, of its average and of Adam's moments belong to the members in ``active``."""

    networks: Sequence[nn.Module]
    seeds: Sequence[int]
    train_windows: WindowSet
    validation_windows: WindowSet
    settings: SupervisedSettings
    context: FitContext

    def __post_init__(self) -> None:
        members = len(self.networks)
        self.network = self.networks[0]
        self.layout = FlatParameters(self.network)
        self.fixed = fixed_state(self.networks) if is_plain(self.network) else {}
        self.train, self.validation = (
            _Prepared(self.network, own, self.settings)
            for own in (self.train_windows, self.validation_windows)
        )
        flat = self.layout.pack(self.networks)
        self.best = flat.clone()
        self.best_loss = torch.full((members,), math.inf, dtype=torch.float64)
        self.best_epoch = torch.zeros(members, dtype=torch.int64)
        self.halvings = [0] * members  # of the step size, one at each divergence
        self.returned_at = torch.zeros(members, dtype=torch.int64)  # epoch of the last of them
        self.has_diverged = [False] * members  # whether the smallest step size diverged too
        # members that go on alone later, in their order, with the state of `_rows` that they go on
        # from; an empty state is their best weights
        self.diverged: dict[int, dict[str, Tensor]] = {}
        self.active = torch.arange(members)
        self.generators = [
            torch.Generator().manual_seed(_shuffle_seed(seed)) for seed in self.seeds
        ]
        self.history: list[tuple[list[float], list[float]]] = [([], []) for _ in self.networks]
        self.epoch = 0  # of the members still active
        self.interrupted = False
        self.started = self.saved = time.monotonic()
        self._go_on_with({"parameters": flat})

    def _rows(self, rows: Tensor | int) -> dict[str, Tensor]:
        """Copies of parameters, their average and Adam's moments of some active members; Adam's step is that of all."""
        held = {"parameters": self.flat.detach(), **self.adam.state.get(self.flat, {})}
        if self.average is not None:
            held["average"] = self.average
        return {
            name: (values[rows] if values.dim() else values).clone()
            for name, values in held.items()
        }

    def _go_on_with(self, rows: dict[str, Tensor]) -> None:
        """Take back what `_rows` gave; there is no average before the first step, and none without averaging."""
        self.average = rows.pop("average", None)
        self.flat = nn.Parameter(rows.pop("parameters").clone())
        self.adam = Adam([self.flat], self._step_size())
        if rows:
            self.adam.state[self.flat] = rows

    def _step_size(self) -> float:
        """That of the active members, which are those that never diverged, or a single one."""
        halvings = self.halvings[int(self.active[0])] if len(self.active) else 0
        return self.settings.learning_rate * 0.5**halvings

    def train_batch(self) -> None:
        """Train the active members until each is over, or until a stop."""
        while self.active.numel() and self.epoch < self.settings.max_epochs:
            self.train_epoch()
            if self.interrupted:
                return

    def go_on_alone(self, member: int) -> None:
        """Let a member that has diverged be the only active one."""
        rows = self.diverged.pop(member)
        self.active = torch.tensor([member])
        self.epoch = len(self.history[member][1])
        self._go_on_with(rows or {"parameters": self.best[[member]]})

    def train_epoch(self) -> None:
        """One pass over the training windows, then the validation loss and the decisions that hang on it."""
        before = self._checkpoints()
        order = torch.stack(
            [
                torch.randperm(len(self.train), generator=self.generators[m])
                for m in self.active.tolist()
            ]
        )
        total = torch.zeros(len(self.active), dtype=torch.float64)
        self.network.train()
        compiled = self.settings.compiled and hasattr(self.network, "compiled_descent")
        for batches in order.split(self.settings.batch_size * (BATCHES if compiled else 1), dim=1):
            if self.context.should_stop():
                self.interrupted = True
                self._save(before)
                return
            total += self._descend(batches) if compiled else self._step(batches)
        self.epoch += 1
        self._judge(total / len(self.train))

    def _step(self, batch: Tensor) -> Tensor:
        """One step of Adam; sums of squared errors of the members, (M,)."""
        self.adam.zero_grad()
        views = self.layout.views(self.flat)
        error = (
            self._predict(views, self.train, self.train.starts[batch], self._batch_seeds())
            - self.train.targets[batch]
        )
        losses = error.square().mean(dim=1)
        losses.sum().backward()
        self.adam.step()
        with torch.no_grad():
            constrain(self.network, self.layout.views(self.flat.detach()))
        if self.settings.averaging:
            self._average()
        return losses.detach().double() * batch.shape[1]

    def _descend(self, batches: Tensor) -> Tensor:
        """The same for several batches by compiled code."""
        own = self.settings
        flat = self.flat.detach()
        state = self.adam.state[self.flat]
        if not state:
            state |= {
                "step": torch.tensor(0.0),
                "exp_avg": torch.zeros_like(flat),
                "exp_avg_sq": torch.zeros_like(flat),
            }
        if own.averaging and self.average is None:
            self.average = torch.zeros_like(flat)
        moments = state | ({"average": self.average} if own.averaging else {})
        bounds = flat.new_tensor([[-math.inf], [math.inf]]).repeat(1, flat.shape[1])
        constrain(self.network, self.layout.views(bounds))
        starts = self.train.starts[batches]
        targets = self.train.targets[batches]
        numbers = own.batch_size, self._step_size(), bounds, own.averaging
        losses: Tensor = self.network.compiled_descent(
            flat, moments, self.train.series, starts, targets, *numbers
        )  # type: ignore[operator]
        return losses

    def _average(self) -> None:
        """Take the weights after this step into their average, θ̄ₜ = (1 − a)/(1 − aᵗ)·Σᵢ aᵗ⁻ⁱ θᵢ over the steps i = 1 … t.

        The factor in front, with which the weights add up to one from the first step on, is in the step's share of the recursion.
        """
        if self.average is None:
            self.average = self.flat.detach().clone()
            return
        decay = self.settings.averaging
        step = float(self.adam.state[self.flat]["step"])
        self.average.lerp_(self.flat.detach(), (1.0 - decay) / (1.0 - decay**step))

    def _batch_seeds(self) -> list[int]:
        """What plain networks draw from for one batch (dropout), one seed an active member; compiled ones draw nothing."""
        if not is_plain(self.network):
            return []
        return [
            int(torch.randint(2**63 - 1, (), generator=self.generators[member]))
            for member in self.active.tolist()
        ]

    def _predict(
        self,
        parameters: dict[str, Tensor],
        data: _Prepared,
        starts: Tensor,
        seeds: Sequence[int] = (),
    ) -> Tensor:
        state = parameters | {name: values[self.active] for name, values in self.fixed.items()}
        compiled = self.settings.compiled
        return predict_members(
            self.network, state, data.series, starts, data.n_window, compiled=compiled, seeds=seeds
        )

    def _judge(self, train_loss: Tensor) -> None:
        """Validate the weights, or their average where there is one; keep the best, and let members leave whose patience is over."""
        judged = self.flat.detach() if self.average is None else self.average
        self.network.eval()
        with torch.no_grad():
            starts = self.validation.starts.expand(len(self.active), -1)
            prediction = self._predict(self.layout.views(judged), self.validation, starts)
            loss = (prediction.double() - self.validation.targets.double()).square().mean(dim=1)
        for member, *losses in zip(
            self.active.tolist(), train_loss.tolist(), loss.tolist(), strict=True
        ):
            for values, value in zip(self.history[member], losses, strict=True):
                values.append(value)
            if not math.isfinite(losses[1]):
                self._return_to_best(member, losses[1])
        better = loss < self.best_loss[self.active]
        improved = self.active[better]
        self.best[improved] = judged[better]
        self.best_loss[improved] = loss[better]
        self.best_epoch[improved] = self.epoch
        waited_from = torch.maximum(self.best_epoch, self.returned_at)[self.active]
        going_on = self.epoch - waited_from < self.settings.patience
        going_on &= torch.isfinite(loss)
        if not bool(going_on.all()):
            self.active = self.active[going_on]
            self._go_on_with(self._rows(going_on))
        self.context.on_progress(
            Progress(
                self.epoch,
                self.settings.max_epochs,
                len(self.active),
                len(self.networks),
                float(self.best_loss.min()),
            )
        )
        if time.monotonic() - self.saved > self.settings.checkpoint_seconds:
            self._save(self._checkpoints())

    def _return_to_best(self, member: int, loss: float) -> None:
        """Note that a member goes on alone from its best weights, or that it is over: in its last epoch, or
        after `MAX_HALVINGS` halvings.

        Raises `DataError`: it is over and no epoch of it was finite.
        """
        if self.halvings[member] < MAX_HALVINGS and self.epoch < self.settings.max_epochs:
            self.halvings[member] += 1
            self.returned_at[member] = self.epoch
            self.diverged[member] = {}
            return
        if not self.best_epoch[member]:
            raise DataError(
                f"training: the validation loss of member {member} is {loss} after epoch {self.epoch}; "
                f"lower training.learning_rate or check the data with 'vehest data check'"
            )
        self.has_diverged[member] = True

    def _checkpoints(self) -> list[Checkpoint]:
        """The state of every member, each by itself, so that any of them can go on without the others."""
        row_of = {member: row for row, member in enumerate(self.active.tolist())}
        checkpoints = []
        for member, (train_loss, validation_loss) in enumerate(self.history):
            tensors = {"best": self.best[member].clone()}
            if member in row_of:
                tensors |= {
                    "generator": self.generators[member].get_state(),
                    **self._rows(row_of[member]),
                }
            if member in self.diverged:
                rows = {
                    name: row if row.dim() == 0 else row[0]
                    for name, row in self.diverged[member].items()
                }
                tensors |= {"generator": self.generators[member].get_state(), **rows}
            values = {
                "finished": member not in row_of and member not in self.diverged,
                "halvings": self.halvings[member],
                "returned_at": int(self.returned_at[member]),
                "has_diverged": self.has_diverged[member],
                "epoch": len(validation_loss),
                "best_epoch": int(self.best_epoch[member]),
                "best_loss": float(self.best_loss[member]),
                "train_loss": list(train_loss),
                "validation_loss": list(validation_loss),
            }
            checkpoints.append(Checkpoint(tensors, values))
        return checkpoints

    def _save(self, checkpoints: Sequence[Checkpoint]) -> None:
        self.saved = time.monotonic()
        for folder, checkpoint in zip(self.context.checkpoint_folders, checkpoints, strict=False):
            save_checkpoint(folder, checkpoint)

    def resume(self) -> None:
        """Go on from the members' checkpoints, if all have one and those that are not finished agree in the epoch."""
        loaded = [load_checkpoint(folder) for folder in self.context.checkpoint_folders]
        checkpoints = [checkpoint for checkpoint in loaded if checkpoint is not None]
        if len(checkpoints) < len(self.networks) or any(
            c.tensors["best"].shape != self.best[0].shape for c in checkpoints
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
        for member, (tensors, values) in enumerate(checkpoints):
            self.best[member] = tensors["best"]
            self.best_loss[member] = values["best_loss"]
            self.best_epoch[member] = values["best_epoch"]
            self.halvings[member] = values.get("halvings", 0)
            self.returned_at[member] = values.get("returned_at", 0)
            self.has_diverged[member] = values.get("has_diverged", False)
            self.history[member] = (values["train_loss"], values["validation_loss"])
        self.active = torch.tensor(together, dtype=torch.int64)
        self.epoch = (
            epochs.pop()
            if epochs
            else max(checkpoint.values["epoch"] for checkpoint in checkpoints)
        )
        states = {member: dict(checkpoints[member].tensors) for member in unfinished}
        for member, state in states.items():
            self.generators[member].set_state(state.pop("generator"))
            del state["best"]
        if together:
            self._go_on_with(_stacked([states[member] for member in together]))
        for member in unfinished:
            if member not in together:
                self.diverged[member] = _stacked([states[member]])

    def finish(self) -> list[FitRecord]:
        """Put the best weights into the networks."""
        seconds = (time.monotonic() - self.started) / len(self.networks)
        records = []
        for member, (network, losses) in enumerate(zip(self.networks, self.history, strict=True)):
            self.layout.unpack(self.best[member], network.eval())
            figures = {
                "best_epoch": int(self.best_epoch[member]),
                "best_validation_loss": min(filter(math.isfinite, losses[1]), default=math.nan),
                **divergence_metrics(self.halvings[member], self.has_diverged[member]),
            }
            is_unfinished = member in self.active.tolist() or member in self.diverged
            unfinished = self.interrupted and is_unfinished
            records.append(
                record_of_epochs(*losses, {**figures, "train_seconds": seconds}, unfinished)
            )
        return records


def _stacked(states: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Rows of members that go on together; Adam's step is that of all."""
    rows = {name: torch.stack([state[name] for state in states]) for name in states[0]}
    return rows | ({"step": states[0]["step"]} if "step" in rows else {})


class _Prepared:
    """A window set as tensors, scaled once."""

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


def _shuffle_seed(seed: int) -> int:
    """A stream for shuffling that has nothing to do with the one the initial weights were drawn from."""
    return int(np.random.SeedSequence([seed, 1]).generate_state(1, np.uint64)[0] >> np.uint64(1))
