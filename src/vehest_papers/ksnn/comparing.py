"""Errors of candidates on a test set, resampled together, and relative changes from one to another with their intervals."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.evaluation.blocks import LEAST_BLOCKS, Segments, block_labels, block_sums, segments_of
from vehest.evaluation.metrics import Scored
from vehest.report.style import fixed

CONFIDENCE = 0.95
N_RESAMPLES = 2000
METRICS = ("fvu", "rmse_vy", "rmse_sideslip")


@dataclass(frozen=True, eq=False)
class Measured:
    """A figure of one candidate over all its seeds.

    Args:
        value: FVU, or RMSE [m/s, deg].
        draws: logarithm of it in each resample, blocks and seeds drawn anew, (n,).
        of_each: its logarithm for each seed alone, (S,).
        n_blocks: blocks of the drive that were resampled.
        paired: whether the seeds are the very networks of the others it is compared with, and were drawn together with theirs.
    """

    value: float
    draws: FloatArray
    of_each: FloatArray
    n_blocks: int
    paired: bool = False

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval, symmetric on a logarithmic axis; NaN where the test has too few blocks."""
        return Change.of(self, None).ends()


@dataclass(frozen=True)
class Change:
    """How a figure stands to another one, or to a limit, as a ratio.

    Args:
        log_ratio: its logarithm.
        error: standard error of that.
        dof: degrees of freedom of Student's t, by Welch and Satterthwaite from blocks and seeds.
    """

    log_ratio: float
    error: float
    dof: float

    @classmethod
    def of(cls, first: Measured, second: Measured | None, limit: float = 1.0) -> Change:
        """Of one figure to another on the same or on another test, or to a limit.

        Figures of one `Errors` are paired, since they share their resamples; those of two tests are not.
        """
        draws = first.draws - (second.draws if second is not None else 0.0)
        parts = [own for own in (first, second) if own is not None]
        error = float(np.std(draws)) if min(own.n_blocks for own in parts) >= LEAST_BLOCKS else math.nan
        apart = [own.of_each for own in parts]
        if second is not None and first.paired and second.paired:
            apart = [first.of_each - second.of_each]
        of_seeds = [(float(np.var(own, ddof=1)) / len(own), len(own) - 1) for own in apart if len(own) > 1]
        of_blocks = max(error**2 - sum(variance for variance, _ in of_seeds), 0.0)
        terms = [(of_blocks, min(own.n_blocks for own in parts) - 1), *of_seeds]
        spread = sum(variance**2 / max(free, 1) for variance, free in terms)
        dof = sum(variance for variance, _ in terms) ** 2 / spread if spread > 0 else math.inf
        ratio = first.value / (second.value if second is not None else 1.0) / limit
        return cls(math.log(ratio) if ratio > 0 else math.nan, error, dof)

    def p_value(self, beyond: float = 0.0) -> float:
        """Two-sided, of the hypothesis that the relative change is ``beyond``; NaN where nothing is known of it."""
        distance = abs(self.log_ratio - math.log1p(beyond))
        return 2.0 * float(stats.t.sf(distance / self.error, self.dof)) if self.error > 0 else math.nan

    def ends(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Ends of the interval of the ratio."""
        half = float(stats.t.ppf(0.5 + confidence / 2.0, self.dof)) * self.error
        return math.exp(self.log_ratio - half), math.exp(self.log_ratio + half)

    def in_percent(self, confidence: float = CONFIDENCE) -> str:
        """In words: ``−24 % [−31, −16]``."""
        low, high = self.ends(confidence)
        value = percent(math.exp(self.log_ratio))
        return f"{value} % [{percent(low)}, {percent(high)}]" if math.isfinite(low) else f"{value} %"

    def as_ratio(self, confidence: float = CONFIDENCE) -> str:
        """The ratio in words: ``2.1 [1.7, 2.6]``."""
        low, high = self.ends(confidence)
        value = math.exp(self.log_ratio)
        return f"{short(value)} [{short(low)}, {short(high)}]" if math.isfinite(low) else short(value)

    def in_decibels(self, confidence: float = CONFIDENCE) -> str:
        """The ratio of two powers in words: ``7.1 dB [5.2, 9.0]``."""
        value, low, high = (10.0 * math.log10(own) for own in (math.exp(self.log_ratio), *self.ends(confidence)))
        return f"{fixed(value, 1)} dB [{fixed(low, 1)}, {fixed(high, 1)}]" if math.isfinite(low) else f"{fixed(value, 1)} dB"

    def over(self, other: Change) -> Change:
        """The ratio of two ratios that share no resamples."""
        error = math.hypot(self.error, other.error)
        return Change(self.log_ratio - other.log_ratio, error, min(self.dof, other.dof))


def percent(ratio: float) -> str:
    """A ratio as a change in whole per cent, with its sign: ``−24``, ``+3``."""
    change = 100.0 * (ratio - 1.0)
    return f"{'+' if round(change) > 0 else ''}{fixed(change, 0)}" if round(change) else "0"


def short(value: float) -> str:
    """A positive number in as few digits as tell it apart: two decimals, three below 0.1."""
    return fixed(value, 3 if abs(value) < 0.1 else 2 if abs(value) < 10 else 0)


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
