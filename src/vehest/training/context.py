"""Surroundings of a fit: checkpoints, stopping, progress; its record; and the settings of one that
learns nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vehest.data.errors import DataError

# largest number of halvings of the step size, each after a divergence; then the training ends with
# its best
MAX_HALVINGS = 3


@dataclass(frozen=True)
class Progress:
    """Progress of a fit after an epoch, for `FitContext.on_progress`."""

    epoch: int  # epochs finished
    max_epochs: int  # epochs allowed
    active: int  # members still training
    members: int  # members in all
    best_validation_loss: float  # lowest so far over the members


@dataclass(frozen=True)
class FitContext:
    """Arguments of a fit besides data and settings: checkpoints, stop request, progress."""

    # folder in which each member stores its checkpoints; empty: none are stored
    checkpoint_folders: Sequence[Path] = ()
    # asked after every batch; True ends the fit cleanly with the best so far
    should_stop: Callable[[], bool] = lambda: False
    on_progress: Callable[[Progress], None] = lambda progress: None  # called after every epoch


@dataclass(frozen=True)
class FitRecord:
    """Result of a fit besides the weights: its history and figures."""

    # column -> values, a row for each epoch or search; empty where a fit has no steps
    history: Mapping[str, Sequence[float]] = field(default_factory=dict)
    # figures such as ``epochs`` and ``train_seconds``
    metrics: Mapping[str, float] = field(default_factory=dict)
    interrupted: bool = False  # whether the fit was stopped before it was over


def record_of_epochs(
    train_loss: Sequence[float],
    validation_loss: Sequence[float],
    metrics: Mapping[str, float],
    interrupted: bool,
    **columns: Sequence[float],
) -> FitRecord:
    """Make the record of a fit with a row for each epoch: ``columns``, then epoch and losses.

    Parameters
    ----------
    train_loss, validation_loss : Sequence[float]
        One value an epoch.
    metrics : Mapping[str, float]
        Further figures; ``epochs`` is added.
    interrupted : bool
        Whether the fit was stopped before it was over.
    **columns : Sequence[float]
        Further columns of the history, of the same length.
    """
    epochs = len(train_loss)
    history = {
        **columns,
        "epoch": range(1, epochs + 1),
        "train_loss": train_loss,
        "validation_loss": validation_loss,
    }
    return FitRecord(
        {name: list(values) for name, values in history.items()},
        {"epochs": epochs, **metrics},
        interrupted,
    )


class DivergenceError(DataError):
    """Raised by a loss that finds that its training has diverged, so that the trainer returns to
    the best parameters so far.
    """


def divergence_metrics(halvings: int, has_diverged: bool) -> dict[str, float]:
    """Metrics of a fit that diverged, name -> value; empty for one that never did.

    ``step_size_halvings``: how often its step size was halved; ``ended_by_divergence``: 1 if it
    diverged again at the end.
    """
    if not halvings and not has_diverged:
        return {}
    return {"step_size_halvings": halvings, "ended_by_divergence": float(has_diverged)}


@dataclass(frozen=True)
class NoTraining:
    """Settings of a fit without any: the estimator's values are given, or follow from the data in
    closed form.
    """
