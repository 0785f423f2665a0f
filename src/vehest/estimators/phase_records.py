"""What trainings in phases say of themselves, as a fit's record."""

from __future__ import annotations

from collections.abc import Sequence

from vehest.estimators.base import FitRecord
from vehest.training.sequences import PhaseRecord


def record_of_phases(phases: Sequence[PhaseRecord]) -> FitRecord:
    """History over the epochs of all phases, and the last phase's figures; epochs, skipped steps and seconds are those of all."""
    history: dict[str, list[float]] = {"phase": [], "epoch": [], "train_loss": [], "validation_loss": []}
    for number, phase in enumerate(phases):
        history["phase"] += [number] * phase.epochs
        history["epoch"] += range(len(history["epoch"]) + 1, len(history["epoch"]) + phase.epochs + 1)
        history["train_loss"] += phase.train_loss
        history["validation_loss"] += phase.validation_loss
    last = phases[-1]
    return FitRecord(
        history=history,
        metrics={
            "epochs": sum(phase.epochs for phase in phases),
            "best_epoch": last.best_epoch,
            "best_validation_loss": last.best_loss,
            "start_validation_loss": last.start_loss,
            "skipped_steps": sum(phase.skipped_steps for phase in phases),
            "train_seconds": sum(phase.seconds for phase in phases),
            **{f"{phase.name}_seconds": phase.seconds for phase in phases},
        },
        interrupted=last.interrupted,
    )
