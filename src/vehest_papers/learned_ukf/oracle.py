"""The oracle: NNTF_UH, trained on through the filter on the very sequences that it is tested on."""

from __future__ import annotations

from dataclasses import replace

import torch

from vehest.estimators.learned_ukf import WEIGHTS, LearnedUkf
from vehest.training.context import FitContext
from vehest.training.sequences import PhaseSettings, train_phases
from vehest.training.through_filter import Drive, ThroughFilterSettings, Weights, filter_phases

EPOCHS = 15
TRAINING = ThroughFilterSettings(
    through=PhaseSettings(
        learning_rate=2e-3, max_epochs=EPOCHS, validate_every=5, schedule="cosine"
    ),
    batch_size=2,
    mirrored=0.0,
    start_noise="given",  # that of the filter as it is
)


def train_on(
    estimator: LearnedUkf, drives: Drive, skip: int, training: ThroughFilterSettings = TRAINING
) -> LearnedUkf:
    """Train a filter further, in place, on a test's own sequences (B, T, ...), and stop on them too; its friction is free."""
    length = drives.states.shape[1]
    training = replace(
        training,
        steps=min(training.steps, length),
        validation_steps=length,
        validation_drop_steps=skip,
    )
    own = [Drive(*(part[row] for part in drives)) for row in range(len(drives.states))]
    weights = torch.tensor(WEIGHTS, dtype=drives.states.dtype)
    nothing = torch.zeros(1, dtype=drives.states.dtype)
    every = torch.cat([weights, nothing])
    judged = torch.cat([weights[:3], nothing, nothing])
    phases = filter_phases(
        estimator.filter,
        own,
        own,
        Weights(every, every, judged),
        training,
        training.through,
        lambda name: True,
        "oracle",
    )
    train_phases(phases, 0, FitContext())
    return estimator
