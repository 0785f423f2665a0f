"""Channels that an estimator lacks in a recording: to estimate from, and to learn from."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from vehest.estimators.base import Estimator


def lacking_to_estimate(estimator: Estimator, channels: Collection[str]) -> tuple[str, ...]:
    """Channels that an estimator reads and a recording does not have."""
    return tuple(name for name in estimator.channels if name not in channels)


def lacking_to_train(estimator: Estimator, training: Any, channels: Collection[str]) -> tuple[str, ...]:
    """Channels that a fit reads and a recording does not have; none where nothing is learnt.

    Args:
        estimator: not fitted, with its settings.
        training: of its ``training_type``.
        channels: of the recording.
    """
    if not estimator.learns:
        return ()
    wanted = dict.fromkeys((*estimator.channels, *estimator.references(training, channels)))
    return tuple(name for name in wanted if name not in channels)


def gaps_that_matter(estimator: Estimator, gappy: Collection[str]) -> tuple[str, ...]:
    """Channels that an estimator reads, cannot do without a sample of, and that have gaps."""
    return tuple(name for name in estimator.channels if name in gappy and name not in estimator.skippable)
