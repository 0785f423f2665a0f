"""Errors of candidates on one test under resampling: blocks of the test are drawn together, seeds of each candidate on their own.

Source: Rao & Wu, Journal of the American Statistical Association 83 (401), 1988: one block, or seed, less is drawn than there are.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from vehest.constants import FloatArray
from vehest_papers.kit.statements import Measured

SMALLEST = 1e-300


class SampledErrors:
    """Candidates on one test, all on the same resamples.

    Args:
        paired: whether candidates are the same networks under other conditions, whose seeds are drawn together.
    """

    def __init__(self, candidates: Collection[str], *, paired: bool) -> None:
        self.candidates = candidates
        self.paired = paired

    def __contains__(self, candidate: object) -> bool:
        return candidate in self.candidates

    def figure(
        self,
        values: FloatArray,
        n_blocks: int,
        generator: np.random.Generator,
        *,
        root: bool = False,
    ) -> Measured:
        """Mean over seeds, or the root of it, of values by resample and seed (n + 1, S), of which the first row is the test itself."""
        drawn = values
        n_seeds = values.shape[1]
        power = 0.5 if root else 1.0
        if n_seeds > 1:
            drawn = np.take_along_axis(
                values, generator.integers(n_seeds, size=(len(values), n_seeds - 1)), axis=1
            )
        logs, of_each = (
            power * np.log(np.maximum(own, SMALLEST)) for own in (drawn[1:].mean(axis=1), values[0])
        )
        return Measured(
            float(max(values[0].mean(), SMALLEST)) ** power, logs, of_each, n_blocks, self.paired
        )


def resampled(n_blocks: int, n: int, generator: np.random.Generator) -> FloatArray:
    """How often each block counts in the test itself and in n resamples of it, (n + 1, B)."""
    drawn = generator.multinomial(n_blocks - 1, np.full(n_blocks, 1.0 / n_blocks), size=n)
    return np.concatenate([np.ones((1, n_blocks)), drawn])
