"""Surroundings of a fit: checkpoints, stopping, progress; and the settings of one that learns nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path


def _never() -> bool:
    return False


def _silent(progress: Progress) -> None:
    return None


@dataclass(frozen=True)
class Progress:
    """Where a fit stands after an epoch.

    Args:
        epoch: epochs finished.
        max_epochs: epochs allowed.
        active: members still training.
        members: members in all.
        best_validation_loss: lowest so far over the members.
    """

    epoch: int
    max_epochs: int
    active: int
    members: int
    best_validation_loss: float


@dataclass(frozen=True)
class FitContext:
    """Surroundings of a fit.

    Args:
        checkpoint_folders: where each member keeps the state of its unfinished fit; empty if nothing is to be kept.
        should_stop: asked after every batch; True ends the fit cleanly with the best so far.
        on_progress: called after every epoch.
    """

    checkpoint_folders: Sequence[Path] = ()
    should_stop: Callable[[], bool] = field(default=_never)
    on_progress: Callable[[Progress], None] = field(default=_silent)


@dataclass(frozen=True)
class NoTraining:
    """Nothing to set: what the estimator needs is given, or read off the data as it is."""
