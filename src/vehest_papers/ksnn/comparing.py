"""Errors of candidates on a test set, resampled together."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.evaluation.blocks import Segments, block_labels, block_sums, segments_of
from vehest.evaluation.metrics import Scored
from vehest.report.style import fixed
from vehest_papers.kit.reading import with_interval
from vehest_papers.kit.sampled import SampledErrors, resampled
from vehest_papers.kit.statements import Change, Measured

N_RESAMPLES = 2000
METRICS = ("fvu", "rmse_vy", "rmse_sideslip")


class SegmentErrors(SampledErrors):
    """Candidates on one test set, all on the same blocks and resamples.

    Args:
        segments: candidate -> sums over short segments of each of its seeds, all over the same samples; candidates with an error that is
            not finite are left out.
        name: of the test set; the resamples of tests of different names are independent.
        same_models: whether candidates are the same networks, in the same order, under other conditions: their seeds are drawn together.
    """

    def __init__(
        self, segments: Mapping[str, Sequence[Segments]], name: str, *, same_models: bool = False
    ) -> None:
        sums = ("squared_error_vy", "squared_error_sideslip")
        finite = {
            own: all(math.isfinite(getattr(part, name).sum()) for part in parts for name in sums)
            for own, parts in segments.items()
        }
        self.segments = {own: parts for own, parts in segments.items() if parts and finite[own]}
        super().__init__(self.segments, paired=same_models)
        self.measured: dict[tuple[str, str], Measured] = {}
        self.n_blocks = 0
        if self.segments:
            self._resample(name)

    def _resample(self, name: str) -> None:
        first = next(iter(self.segments.values()))[0]
        counted = np.maximum(first.samples, 1.0)
        labels = block_labels(
            first,
            np.stack(
                [
                    part.squared_error_vy / counted
                    for parts in self.segments.values()
                    for part in parts
                ]
            ),
        )
        sizes = block_sums(first.samples, labels)
        self.n_blocks = len(sizes)
        generator = np.random.default_rng(zlib.crc32(name.encode()))
        of_seeds = int(generator.integers(2**31))
        counts = resampled(self.n_blocks, N_RESAMPLES if self.n_blocks > 1 else 0, generator)
        total = np.maximum(counts @ sizes, 1.0)
        moving = np.maximum(counts @ block_sums(first.sideslip_samples, labels), 1.0)
        mean, square = (
            counts @ block_sums(getattr(first, own), labels) / total
            for own in ("vy_ref", "squared_vy_ref")
        )
        variance = square - np.square(mean)
        for candidate, parts in self.segments.items():
            vy, error, sideslip = (
                counts
                @ block_sums(np.stack([getattr(part, own) for part in parts]), labels).T
                / number[:, None]
                for own, number in (
                    ("squared_error_vy", total),
                    ("error_vy", total),
                    ("squared_error_sideslip", moving),
                )
            )
            fvu = (vy - np.square(error)) / np.maximum(variance, 1e-12)[:, None]
            for metric, values in zip(METRICS, (fvu, vy, sideslip), strict=True):
                drawing = np.random.default_rng(of_seeds) if self.paired else generator
                self.measured[candidate, metric] = self.figure(
                    values, len(sizes), drawing, root=metric != "fvu"
                )

    def get(self, candidate: str, metric: str) -> Measured | None:
        """A figure; none where the candidate is not there."""
        return self.measured.get((candidate, metric))

    def change(self, first: str, second: str, metric: str) -> Change | None:
        """From the second to the first; none where either is not there."""
        own = self.get(first, metric)
        other = self.get(second, metric)
        return Change.of(own, other) if own is not None and other is not None else None

    def value(self, candidate: str, metric: str) -> float:
        """A figure alone; NaN where the candidate is not there."""
        own = self.get(candidate, metric)
        return own.value if own is not None else math.nan

    def in_words(self, candidate: str, metric: str) -> str:
        """A figure with its interval: ``0.132 [0.110, 0.158]``."""
        own = self.get(candidate, metric)
        if own is None:
            return "–"
        low, high = own.interval
        return with_interval(own.value, low, high, 3) if math.isfinite(low) else fixed(own.value, 3)


def masked_segments(
    parts: Sequence[Scored], masks: Sequence[FloatArray], rate_hz: float
) -> Segments:
    """Sums over segments as `vehest.evaluation.blocks.segments_of` makes them at ``rate_hz`` [Hz], of samples where masks (K,) are 1."""
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
