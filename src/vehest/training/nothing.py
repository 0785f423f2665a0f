"""Training of estimators that learn nothing."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NoTraining:
    """Nothing to set: what the estimator needs is given, or read off the data as it is."""
