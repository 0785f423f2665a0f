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
from vehest_papers.kit.statements import Change, Measured

N_RESAMPLES = 2000
METRICS = ("fvu", "rmse_vy", "rmse_sideslip")


class Errors:
    """Candidates on one test set, all on the same blocks and resamples.

    Args:
        segments: candidate -> sums over short segments of each of its seeds, all over the same samples; candidates with an error that is
            not finite are left out.
        name: of the test set; the resamples of tests of different names are independent.
        same_models: whether candidates are the same networks, in the same order, under other conditions: their seeds are drawn together.
    """

    def __init__(self, segments: Mapping[str, Sequence[Segments]], name: str, *, same_models: bool = False) -> None:
        self.same_models = same_models
        self.segments = {own: parts for own, parts in segments.items() if parts and all(_is_finite(part) for part in parts)}
        self.measured: dict[tuple[str, str], Measured] = {}
        self.n_blocks = 0
        if self.segments:
            self._resample(name)

    def _resample(self, name: str) -> None:
        first = next(iter(self.segments.values()))[0]
        counted = np.maximum(first.samples, 1.0)
        labels = block_labels(first, np.stack([part.squared_error_vy / counted for parts in self.segments.values() for part in parts]))
        sizes = block_sums(first.samples, labels)
        self.n_blocks = len(sizes)
        generator = np.random.default_rng(zlib.crc32(name.encode()))
        counts, of_seeds = np.ones((1, len(sizes))), int(generator.integers(2**31))
        if self.n_blocks > 1:
            drawn = generator.multinomial(len(sizes) - 1, np.full(len(sizes), 1.0 / len(sizes)), size=N_RESAMPLES)
            counts = np.concatenate([counts, drawn])  # the first row is the drive as it was
        total = np.maximum(counts @ sizes, 1.0)
        mean, square = (counts @ block_sums(getattr(first, own), labels) / total for own in ("vy_ref", "squared_vy_ref"))
        variance = square - np.square(mean)
        for candidate, parts in self.segments.items():
            vy, error, sideslip = (
                counts @ block_sums(np.stack([getattr(part, own) for part in parts]), labels).T / total[:, None]
                for own in ("squared_error_vy", "error_vy", "squared_error_sideslip")
            )
            fvu = (vy - np.square(error)) / np.maximum(variance, 1e-12)[:, None]
            for metric, values in zip(METRICS, (fvu, vy, sideslip), strict=True):
                drawing = np.random.default_rng(of_seeds) if self.same_models else generator
                found = _measured(values, len(sizes), drawing, root=metric != "fvu")
                self.measured[candidate, metric] = replace(found, paired=self.same_models)

    def __contains__(self, candidate: object) -> bool:
        return candidate in self.segments

    def get(self, candidate: str, metric: str) -> Measured | None:
        """A figure; none where the candidate is not there."""
        return self.measured.get((candidate, metric))

    def change(self, first: str, second: str, metric: str) -> Change | None:
        """From the second to the first; none where either is not there."""
        own, other = self.get(first, metric), self.get(second, metric)
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
        return f"{fixed(own.value, 3)} [{fixed(low, 3)}, {fixed(high, 3)}]" if math.isfinite(low) else fixed(own.value, 3)


def _measured(values: FloatArray, n_blocks: int, generator: np.random.Generator, *, root: bool) -> Measured:
    """Of values by resample and seed (n, S), the first resample being the drive itself."""
    n_seeds = values.shape[1]
    drawn = values
    if n_seeds > 1:
        picks = generator.integers(n_seeds, size=(len(values), n_seeds - 1))
        drawn = np.take_along_axis(values, picks, axis=1)
    power = 0.5 if root else 1.0
    floor = 1e-300
    means = np.log(np.maximum(drawn[1:].mean(axis=1), floor)) * power
    value = float(max(values[0].mean(), floor)) ** power
    return Measured(value, means, np.log(np.maximum(values[0], floor)) * power, n_blocks)


def _is_finite(part: Segments) -> bool:
    return math.isfinite(float(part.squared_error_vy.sum())) and math.isfinite(float(part.squared_error_sideslip.sum()))


def masked_segments(parts: Sequence[Scored], masks: Sequence[FloatArray], rate_hz: float) -> Segments:
    """Sums over segments as `vehest.evaluation.blocks.segments_of` makes them, of some of the scored samples alone.

    Args:
        parts: estimate and reference, in order.
        masks: of each, which samples count, (K,), 0 or 1.
        rate_hz: of the scored samples [Hz].
    """
    marked = list(zip(parts, masks, strict=True))
    chosen = segments_of(
        [
            replace(
                part, vy=part.vy * mask, vy_ref=part.vy_ref * mask, sideslip=part.sideslip * mask, sideslip_ref=part.sideslip_ref * mask
            )
            for part, mask in marked
        ],
        rate_hz,
    )
    counts = segments_of([replace(part, vy_ref=np.asarray(mask, dtype=np.float64)) for part, mask in marked], rate_hz).vy_ref
    return replace(chosen, samples=counts)


def yaw_rates(parts: Sequence[Scored], recordings: Sequence[Recording]) -> list[FloatArray]:
    """Yaw rate at the scored times of each range [rad/s]."""
    return [
        recording["yaw_rate"][np.round((part.time - recording.start_time) * recording.rate_hz).astype(int)]
        for part, recording in zip(parts, recordings, strict=True)
    ]
