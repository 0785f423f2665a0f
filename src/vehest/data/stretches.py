"""Stretches of a recording in which a condition on its channels holds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vehest.data.recording import Recording
from vehest.data.runs import true_runs


@dataclass(frozen=True)
class Condition:
    """What must hold at every sample of a stretch, and how long for.

    Args:
        magnitude: channel -> smallest and largest magnitude, both included, in the channel's unit.
        at_least_seconds: shortest stretch [s].
    """

    magnitude: Mapping[str, tuple[float, float]]
    at_least_seconds: float = 0.0

    def describe(self) -> str:
        """For messages, for example ``0 <= |ay| <= 7, 2 s or longer``."""
        bounds = [f"{low:g} <= |{channel}| <= {high:g}" for channel, (low, high) in self.magnitude.items()]
        return ", ".join([*bounds, f"{self.at_least_seconds:g} s or longer"])


def stretches_where(recording: Recording, condition: Condition, first: int = 0, end: int | None = None) -> list[tuple[int, int]]:
    """Longest runs [first, end) of samples, as indices, that all meet a condition; a sample that was not measured does not.

    Args:
        recording: as it is, at its own rate and unfiltered.
        condition: what must hold.
        first, end: samples to look at; by default all.

    Raises:
        DataError: the recording lacks a channel of the condition.
    """
    end = len(recording) if end is None else end
    holds = np.ones(max(end - first, 0), dtype=bool)
    for channel, (low, high) in condition.magnitude.items():
        size = np.abs(recording[channel][first:end])
        holds &= (size >= low) & (size <= high)
    edges = true_runs(holds) + first
    shortest = max(math.ceil(condition.at_least_seconds * recording.rate_hz - 1e-9), 1)
    return [(begin, after) for begin, after in edges.tolist() if after - begin >= shortest]
