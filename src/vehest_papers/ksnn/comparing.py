"""Errors of candidates on a test set by block and seed, all on the same blocks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.evaluation.blocks import Segments, block_labels, block_sums, segments_of
from vehest.evaluation.metrics import Scored
from vehest_papers.kit.block_errors import BlockErrors
from vehest_papers.kit.block_rows import names_of_blocks
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import Figure, value_of

METRICS = ("fvu", "rmse_vy", "rmse_sideslip")
MISSING_FIGURE = Figure(math.nan, math.nan, math.nan)


class SegmentErrors:
    """Candidates on one test set.

    Parameters
    ----------
    segments
        Candidate -> sums over short segments of each of its seeds, all over the same samples.
    labels
        Number of each segment's block, (K,); left out: the longest blocks that any seed's errors
        ask for.
    seeds
        Candidate -> its seeds, by which rows of blocks.csv are called; left out: counted.
    recordings
        Name of the recording of each piece; left out: numbers.
    """

    def __init__(
        self,
        segments: Mapping[str, Sequence[Segments]],
        labels: NDArray[np.int64] | None = None,
        seeds: Mapping[str, Sequence[int]] | None = None,
        recordings: Sequence[str] | None = None,
    ) -> None:
        self.segments = {name: parts for name, parts in segments.items() if parts}
        self.seeds = seeds or {name: range(len(parts)) for name, parts in self.segments.items()}
        all_segments = [part for parts in self.segments.values() for part in parts]
        self.labels = common_labels(all_segments) if labels is None and all_segments else labels
        self.names: list[str] = []
        if self.labels is not None and all_segments:
            pieces = all_segments[0].piece.astype(int).tolist()
            names = [str(piece) if recordings is None else recordings[piece] for piece in pieces]
            self.names = names_of_blocks(self.labels, names, all_segments[0].start)

    def __contains__(self, candidate: object) -> bool:
        """Whether it is there and all of its errors are finite."""
        return candidate in self.segments and all(
            math.isfinite(part.squared_error_vy.sum() + part.squared_error_sideslip.sum())
            for part in self.segments[str(candidate)]
        )

    def block_errors(self, candidate: str, metric: str) -> BlockErrors:
        """Errors by seed and block, as blocks.csv has them.

        Parameters
        ----------
        metric
            ``fvu``, ``rmse_sideslip``, or one that begins with ``rmse_vy``.
        """
        assert self.labels is not None
        labels = self.labels
        parts = self.segments[candidate]

        def summed(name: str) -> FloatArray:
            return block_sums(np.stack([getattr(part, name) for part in parts]), labels)

        samples = summed("samples")[0]
        if metric == "rmse_sideslip":
            sums, sizes = summed("squared_error_sideslip"), summed("sideslip_samples")[0]
        elif metric == "fvu":
            sums = _about_mean(summed("squared_error_vy"), summed("error_vy"), samples)
            sizes = _about_mean(summed("squared_vy_ref"), summed("vy_ref"), samples)[0]
        else:
            sums, sizes = summed("squared_error_vy"), samples
        seeds = tuple(str(seed) for seed in self.seeds[candidate])
        return BlockErrors(seeds, tuple(self.names), sums, sizes)

    def figure(self, candidate: str, metric: str) -> Figure:
        """An error over all seeds with its 95 % interval; NaN where the candidate is not there or
        not finite.
        """
        if candidate not in self:
            return MISSING_FIGURE
        return value_of(self.block_errors(candidate, metric), metric)[1]

    def value(self, candidate: str, metric: str) -> float:
        """An error alone."""
        return self.figure(candidate, metric).value

    def in_words(self, candidate: str, metric: str) -> str:
        """An error with its interval: ``0.132 [0.110, 0.158]``."""
        return figure_in_words(self.figure(candidate, metric))


def common_labels(segments: Sequence[Segments]) -> NDArray[np.int64]:
    """Number of each segment's block, (K,): the longest blocks that the finite errors of any of
    them ask for.
    """
    counted = np.maximum(segments[0].samples, 1.0)
    losses = np.stack([part.squared_error_vy / counted for part in segments])
    finite = losses[np.isfinite(losses).all(axis=1)]
    return block_labels(segments[0], finite if len(finite) else np.zeros_like(losses[:1]))


def _about_mean(squares: FloatArray, sums: FloatArray, samples: FloatArray) -> FloatArray:
    """Sums of squares about the mean over all blocks, (S, B)."""
    mean = sums.sum(axis=1, keepdims=True) / samples.sum()
    about: FloatArray = np.maximum(squares - 2.0 * mean * sums + mean**2 * samples, 0.0)
    return about


def masked_segments(
    parts: Sequence[Scored], masks: Sequence[FloatArray], rate_hz: float
) -> Segments:
    """Sums over segments as `vehest.evaluation.blocks.segments_of` makes them at ``rate_hz`` [Hz],
    of samples where masks (K,) are 1.
    """
    marked = list(zip(parts, masks, strict=True))
    fields = ("vy", "vy_ref", "sideslip", "sideslip_ref")
    chosen = segments_of(
        [
            replace(
                part,
                **{name: getattr(part, name) * mask for name in fields},
                is_sideslip_scored=part.is_sideslip_scored & (mask > 0),
            )
            for part, mask in marked
        ],
        rate_hz,
    )
    counts = segments_of(
        [replace(part, vy_ref=np.asarray(mask, dtype=np.float64)) for part, mask in marked], rate_hz
    ).vy_ref
    return replace(chosen, samples=counts)


def yaw_rates(parts: Sequence[Scored], recordings: Sequence[Recording]) -> list[FloatArray]:
    """Yaw rate at the scored times of each range [rad/s]."""
    return [
        recording["yaw_rate"][
            np.round((part.time - recording.start_time) * recording.rate_hz).astype(int)
        ]
        for part, recording in zip(parts, recordings, strict=True)
    ]
