"""Segments of a recording in which a condition on its channels holds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat

from vehest.data.channels import CHANNELS
from vehest.data.recording import Recording
from vehest.data.runs import true_runs


@dataclass(frozen=True)
class Bounds:
    """Smallest and largest magnitude of a channel, both included, in its unit.

    Raises
    ------
    ValueError
        No magnitude lies between them.
    """

    at_least: float = 0.0  # smallest magnitude
    at_most: float = math.inf  # largest magnitude

    def __post_init__(self) -> None:
        if not 0.0 <= self.at_least <= self.at_most:
            raise ValueError(f"no magnitude lies between {self.at_least:g} and {self.at_most:g}")


@dataclass(frozen=True)
class Condition:
    """Condition on every sample of a segment, and the shortest length of a segment.

    Raises
    ------
    ValueError
        There is no channel, or an unknown one.
    """

    magnitude: dict[str, Bounds]  # channel -> bounds of its magnitude
    at_least_seconds: NonNegativeFloat = 0.0  # shortest segment [s]

    def __post_init__(self) -> None:
        if not self.magnitude:
            raise ValueError("magnitude maps channels to {at_least, at_most}, and names none")
        for channel in self.magnitude.keys() - CHANNELS.keys():
            raise ValueError(f"there is no channel '{channel}'; see 'vehest data channels'")

    def describe(self) -> str:
        """Text for messages, for example ``0 <= |ay| <= 7, 2 s or longer``."""
        bounds = [
            f"{bounds.at_least:g} <= |{channel}| <= {bounds.at_most:g}"
            for channel, bounds in self.magnitude.items()
        ]
        return ", ".join([*bounds, f"{self.at_least_seconds:g} s or longer"])


def stretches_where(
    recording: Recording, condition: Condition, first: int, end: int
) -> list[tuple[int, int]]:
    """Longest runs [first, end) of sample indices that meet a condition.

    Unmeasured ones do not.

    Raises
    ------
    DataError
        A channel of the condition is missing.
    """
    holds = np.ones(max(end - first, 0), dtype=bool)
    for channel, bounds in condition.magnitude.items():
        size = np.abs(recording[channel][first:end])
        holds &= (size >= bounds.at_least) & (size <= bounds.at_most)
    edges = true_runs(holds) + first
    shortest = max(math.ceil(condition.at_least_seconds * recording.rate_hz - 1e-9), 1)
    return [(begin, after) for begin, after in edges.tolist() if after - begin >= shortest]
