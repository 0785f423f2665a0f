"""Losses of all methods on a test, and how they compare: means, ratios and percentiles with intervals over sequences and seeds."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vehest.constants import FloatArray
from vehest.evaluation.metrics import WEIGHTS
from vehest.evaluation.significance import CONFIDENCE, Interval
from vehest_papers.kit.paired import paired_difference
from vehest_papers.learned_ukf import paper

N_RESAMPLES = 500
SAME_WEIGHTS = {paper.NNTF_UH, paper.NNTF_UH_LOW}


@dataclass(frozen=True)
class Losses:
    """What the methods lose on a test, sample by sample."""

    squared: dict[
        str, FloatArray
    ]  # method -> weighted squared error of each seed at each scored sample, (S, K)
    absolute: dict[str, FloatArray]  # method -> weighted absolute error, (S, K)
    sequence: NDArray[np.int64]  # of each sample, (K,)
    rate_hz: float  # of the samples

    def add(self, method: str, errors: FloatArray) -> None:
        """Take in one more method of one seed: its errors of vx, vy and yaw rate, (K, 3)."""
        weights = np.array(list(WEIGHTS.values()))
        self.squared[method] = (np.square(errors) @ weights)[None]
        self.absolute[method] = (np.abs(errors) @ weights)[None]

    def difference(self, first: FloatArray, second: FloatArray) -> Interval:
        """Of mean losses (S, K), over sequences and seeds."""
        return paired_difference(first, second, self.sequence, rate_hz=self.rate_hz).mean

    def of_pair(self, first: str, second: str) -> Interval:
        """Difference of the mean squared losses of two methods; seed by seed where both have the same weights."""
        one = self.squared[first]
        other = self.squared[second]
        if {first, second} == SAME_WEIGHTS:
            return self.mean(one - other)
        return self.difference(one, other)

    def mean(self, losses: FloatArray) -> Interval:
        """Of losses (S, K), over sequences and seeds."""
        return self.difference(losses, np.zeros((1, losses.shape[1])))

    def ratio(self, first: str, second: str) -> tuple[float, float, float]:
        """Of mean losses, with its 95 % interval: the factors c for which first - c second is not told apart from zero (Fieller)."""
        one = self.squared[first]
        other = self.squared[second]
        value = float(one.mean() / other.mean())

        def apart(factor: float) -> bool:
            own = self.difference(one, factor * other)
            return own.low > 0.0 or own.high < 0.0

        return value, _edge(apart, value, 0.0), _edge(apart, value, 20.0 * value)

    def percentile(self, first: str, second: str) -> Interval:
        """Difference of the 99th percentiles of absolute errors, means over seeds; sequences and seeds are resampled."""
        rng = np.random.default_rng(zlib.crc32(f"{first} {second}".encode()))
        both = [self.absolute[first], self.absolute[second]]
        n = int(self.sequence.max()) + 1
        length = len(self.sequence) // n
        pieces = [own.reshape(len(own), n, length) for own in both]
        drawn = np.empty(N_RESAMPLES)
        for k in range(len(drawn)):
            rows = rng.integers(n, size=n - 1)
            values = []
            for own in pieces:
                seeds = rng.integers(len(own), size=max(len(own) - 1, 1))
                values.append(
                    np.percentile(own[seeds][:, rows].reshape(len(seeds), -1), 99.0, axis=1).mean()
                )
            drawn[k] = values[0] - values[1]
        value = float(
            np.mean(np.percentile(both[0], 99.0, axis=1))
            - np.mean(np.percentile(both[1], 99.0, axis=1))
        )
        error = float(np.std(drawn))
        half = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, n - 1)) * error
        return Interval(
            value,
            value - half,
            value + half,
            2.0 * float(stats.t.sf(abs(value) / error, n - 1)),
            error,
            n - 1,
        )


def _edge(apart: Callable[[float], bool], inside: float, outside: float) -> float:
    """Where ``apart`` turns true on the way from ``inside`` to ``outside``; infinite or zero if it never does."""
    if not apart(outside):
        return outside if outside == 0.0 else float("inf")
    for _ in range(14):
        middle = 0.5 * (inside + outside)
        inside, outside = (inside, middle) if apart(middle) else (middle, outside)
    return 0.5 * (inside + outside)
