"""Whether a training has to wait for compilation first."""

from __future__ import annotations

import importlib
from pathlib import Path

SLOW = {"learned_ukf": "vehest.estimators.kernels.planar_car"}
"""Estimators that compile for tens of seconds -> their slowest kernel."""


def has_to_compile(estimator: str) -> bool:
    """Whether an estimator's training compiles on this machine before it starts; later ones load the result."""
    if estimator not in SLOW:
        return False
    kernel = importlib.import_module(SLOW[estimator])
    if not hasattr(kernel._transition, "stats"):  # NUMBA_DISABLE_JIT
        return False
    folder = kernel._transition.stats.cache_path
    return folder is not None and not any(Path(folder).glob(f"{kernel.__name__.rpartition('.')[2]}._transition-*.nbi"))
