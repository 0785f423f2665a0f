"""Windows of past samples, addressed by index so that overlapping ones share memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.limits import check_limit
from vehest.data.recording import Recording


@dataclass(frozen=True, eq=False)
class WindowSet:
    """All windows of N samples of some recordings, each with the target one step after it.

    Window i is ``series[starts[i] : starts[i] + n_window]``; it never crosses from one recording
    into the next.
    """

    series: FloatArray  # channels as columns, recordings one after another, shape (T, C)
    targets: FloatArray  # target of each window, shape (W,)
    starts: NDArray[np.int64]  # first row of each window, shape (W,)
    n_window: int  # samples N in a window

    def __len__(self) -> int:
        return len(self.starts)


def windows_of(
    recordings: Sequence[Recording], channels: Sequence[str], target: str, n_window: int
) -> WindowSet:
    """Cut recordings into windows r[k-N+1 … k] with target[k+1] (Da Lio et al. 2023, Fig. 1).

    Raises
    ------
    DataError
        Gaps or no windows.
    """
    check_limit("filter_samples", n_window, f"a window of {n_window} samples is asked for")
    series = []
    targets = []
    starts = []
    offset = 0
    for recording in recordings:
        for name in (*channels, target):
            if name in recording.gappy and np.isnan(recording[name]).any():
                raise DataError(
                    f"recording '{recording.id}': channel '{name}' has gaps; windows need a value "
                    "at every sample"
                )
        first = window_starts(len(recording), n_window)
        series.append(recording.stack(channels))
        targets.append(recording[target][first + n_window])
        starts.append(first + offset)
        offset += len(recording)
    if not sum(len(first) for first in starts):
        lengths = ", ".join(f"'{r.id}' {len(r)}" for r in recordings)
        raise DataError(
            f"windows of {n_window} samples and a target need longer recordings than: {lengths}"
        )
    return WindowSet(
        np.concatenate(series), np.concatenate(targets), np.concatenate(starts), n_window
    )


def window_starts(n_samples: int, n_window: int) -> NDArray[np.int64]:
    """First indices of all windows that have a sample after them, shape (max(T - N, 0),)."""
    return np.arange(max(n_samples - n_window, 0), dtype=np.int64)
