"""Whether one estimator is better than another on samples in sequences: losses by sample to sums over blocks."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.evaluation.significance import Difference, difference_of_blocks


def paired_difference(
    first: FloatArray,
    second: FloatArray,
    sequence: NDArray[np.int64],
    *,
    rate_hz: float,
    block_seconds: float | None = None,
    n_resamples: int = 10_000,
) -> Difference:
    """Compare two estimators on the same samples, as `differences_of_blocks` does on blocks.

    Args:
        first: loss of each seed at each sample, shape (S, K), S not necessarily that of ``second``.
        second: shape (S', K).
        sequence: which uninterrupted sequence a sample belongs to, shape (K,); a sequence's samples stand together, in order.
        rate_hz: of the samples [Hz].
        block_seconds: length of a block within a sequence [s], longer than errors are correlated; None takes whole sequences.

    Raises:
        DataError: shapes do not fit, a loss is not finite, or there are fewer than two blocks.
    """
    for name, losses in (("first", first), ("second", second)):
        if losses.ndim != 2 or losses.shape[0] == 0 or losses.shape[1] != len(sequence):
            raise DataError(
                f"losses of the {name} estimator must be of shape (seeds, {len(sequence)}), not {losses.shape}"
            )
        if not np.isfinite(losses).all():
            raise DataError(
                f"losses of the {name} estimator hold {int((~np.isfinite(losses)).sum())} values that are not finite"
            )
    starts = _block_starts(
        sequence, None if block_seconds is None else max(round(block_seconds * rate_hz), 1)
    )
    if len(starts) < 2:
        raise DataError(
            f"there are {len(starts)} blocks to resample, at least two are needed; give more sequences or a shorter block_seconds"
        )
    sizes = np.diff([*starts, len(sequence)]).astype(np.float64)
    return difference_of_blocks(
        np.add.reduceat(first, starts, axis=1),
        np.add.reduceat(second, starts, axis=1),
        sizes,
        n_resamples=n_resamples,
    )


def sequence_labels(lengths: Sequence[int]) -> NDArray[np.int64]:
    """Number of the sequence that each sample belongs to, for sequences of these lengths one after another, (sum of lengths,)."""
    return np.repeat(np.arange(len(lengths), dtype=np.int64), lengths)


def _block_starts(sequence: NDArray[np.int64], block: int | None) -> NDArray[np.int64]:
    """First sample of each block; a sequence's last block may be shorter."""
    bounds = np.flatnonzero(np.diff(sequence)) + 1
    edges = [0, *bounds.tolist(), len(sequence)]
    starts = [
        np.arange(begin, end, block or max(end - begin, 1))
        for begin, end in itertools.pairwise(edges)
    ]
    return np.concatenate(starts).astype(np.int64)
