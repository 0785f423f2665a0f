"""Scores of calibrated bands: how often they contain the error, how wide they are, and both in
one score.

A band is meant for v and β each: figures of β are in degrees, those of v have the suffix ``_vy``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from vehest.constants import FloatArray
from vehest.evaluation.blocks import MIN_BLOCKS, block_labels, block_sums, segments_of
from vehest.evaluation.metrics import BoolArray, Scored, wrap_to_half_turn
from vehest.evaluation.regimes import AY_BANDS, Mask, is_long_enough, is_represented
from vehest.trust.bands import (
    CHANNEL_LEVEL,
    LEVELS,
    Bands,
    effective_blocks,
    intraclass_correlation,
)
from vehest.trust.bands import block_labels as manoeuvre_labels

CONFIDENCE = 0.95  # level of the interval of a coverage
REGIME_METRICS = ("coverage_90", "width_90", "interval_score")  # figures that are split by regime
SUFFIXES = {"sideslip": "", "vy": "_vy"}  # quantity -> what its figures' names end in


class ScoredBand(NamedTuple):
    """Errors of a quantity and its bands at the samples of all ranges at which it is scored."""

    errors: FloatArray  # estimate - reference, (N,) [deg for β, m/s for v]
    half: FloatArray  # half widths in the same unit, (N, L), a column for each of `LEVELS`
    # whether each of the K samples of all ranges is scored, (K,); N of them are
    is_scored: BoolArray

    @property
    def half_width_90(self) -> FloatArray:
        """Half widths of the bands at 90 %, (N,)."""
        return self.half[:, LEVELS.index(CHANNEL_LEVEL)]


def scored_bands(parts: Sequence[Scored], bands: Bands) -> dict[str, ScoredBand]:
    """Errors and bands of ``vy`` [m/s], at all samples, and ``sideslip`` [deg], at those at which
    it is scored.

    The half widths of all levels are proportional to that at 90 %.

    Parameters
    ----------
    parts : sequence of Scored
        Ranges or sequences of a test set, with the half widths of the bands at 90 % [m/s, rad].
    bands : Bands
        Their calibration, which has the half widths of the other levels.

    Returns
    -------
    dict
        ``vy`` and ``sideslip`` -> `ScoredBand`.
    """
    whole = Scored.joined(parts)
    errors = {
        "vy": whole.vy - whole.vy_ref,
        "sideslip": np.degrees(wrap_to_half_turn(whole.sideslip - whole.sideslip_ref)),
    }
    scale = {"vy": 1.0, "sideslip": np.degrees(1.0)}
    is_scored = {
        "vy": np.ones_like(whole.is_sideslip_scored),
        "sideslip": whole.is_sideslip_scored,
    }
    banded_errors = {}
    for name, mask in is_scored.items():
        half_width_90 = np.concatenate([part.bands[name] for part in parts])[:, None]
        half = scale[name] * half_width_90 * getattr(bands, name).ratios_to(CHANNEL_LEVEL)
        banded_errors[name] = ScoredBand(errors[name][mask], half[mask], mask)
    return banded_errors


def band_figures(
    banded_errors: Mapping[str, ScoredBand],
    parts: Sequence[Scored],
    turns: Sequence[FloatArray | None],
    rate_hz: float,
) -> dict[str, float]:
    """Metrics of the bands of a test set: name -> value, for β [deg] and, with the suffix ``_vy``,
    for v [m/s].

    ``coverage_…`` is the fraction of errors inside the band; ``width_90`` the mean full width;
    ``interval_score`` and ``crps`` are those of `interval_score` and `crps_of_levels`;
    ``coverage_90_p10`` and ``…_p90`` are the 10 and 90 % quantiles of the coverage over manoeuvres,
    which are the blocks that bands are calibrated by; ``error_icc`` is the intraclass correlation
    of squared normalised errors within them, and ``band_blocks`` their effective number
    (`effective_blocks`). A quantity that is scored at no sample has no figures.

    Parameters
    ----------
    banded_errors : mapping
        Result of `scored_bands` for ``parts``.
    parts : sequence of Scored
        Ranges or sequences of the test set.
    turns : sequence of FloatArray or None
        Yaw rate of each part at its scored samples [rad/s]; None where it was not measured.
    rate_hz : float
        Rate of the samples [Hz].
    """
    manoeuvres = np.concatenate(
        manoeuvre_labels(turns, [len(part.time) for part in parts], rate_hz)[0]
    )
    figures: dict[str, float] = {}
    for name, suffix in SUFFIXES.items():
        errors, half, is_scored = banded_errors[name]
        if not len(errors):
            continue
        labels = np.unique(manoeuvres[is_scored], return_inverse=True)[1]
        half_width_90 = banded_errors[name].half_width_90
        inside = np.abs(errors)[:, None] <= half
        by_block = block_sums(
            inside[:, LEVELS.index(CHANNEL_LEVEL)].astype(np.float64), labels
        ) / np.bincount(labels)
        normalised = np.square(
            np.divide(errors, half_width_90, out=np.zeros_like(errors), where=half_width_90 > 0)
        )
        values = {
            f"coverage_{100 * level:.0f}": float(inside[:, k].mean())
            for k, level in enumerate(LEVELS)
        }
        values |= {
            "coverage_90_p10": float(np.quantile(by_block, 0.1)),
            "coverage_90_p90": float(np.quantile(by_block, 0.9)),
            "width_90": float(2.0 * half_width_90.mean()),
            "interval_score": float(interval_score(errors, half_width_90, CHANNEL_LEVEL).mean()),
            "crps": float(crps_of_levels(errors, half, LEVELS).mean()),
            "error_icc": intraclass_correlation(normalised, labels),
            "band_blocks": effective_blocks(block_sums(normalised, labels)),
        }
        figures |= {f"{metric}{suffix}": value for metric, value in values.items()}
    return figures


def coverage_intervals(
    banded_errors: Mapping[str, ScoredBand], parts: Sequence[Scored], rate_hz: float
) -> dict[str, tuple[float, float]]:
    """95 % intervals of coverages, by the blocks of `evaluation.blocks`; none where there are fewer
    than `MIN_BLOCKS`.

    Returns
    -------
    dict
        Name of a coverage, such as ``coverage_90_vy`` -> lower and upper end of its interval, as
        fractions.
    """
    all_segments = segments_of(parts, rate_hz)
    intervals = {}
    segment_of = np.repeat(np.arange(len(all_segments)), all_segments.samples.astype(np.int64))
    for name, suffix in SUFFIXES.items():
        errors, half, is_scored = banded_errors[name]
        if not len(errors):
            continue
        segments = all_segments if name == "vy" else all_segments.with_sideslip
        places = np.unique(segment_of[is_scored], return_inverse=True)[1]
        samples = np.bincount(places).astype(np.float64)
        for k, level in enumerate(LEVELS):
            inside = np.bincount(places, weights=np.abs(errors) <= half[:, k])
            labels = block_labels(segments, (1.0 - inside / samples)[None])
            if labels.max() + 1 >= MIN_BLOCKS:
                sums = block_sums(np.stack([inside, samples]), labels)
                intervals[f"coverage_{100 * level:.0f}{suffix}"] = proportion_interval(*sums)
    return intervals


def figures_by_regime(
    banded_errors: Mapping[str, ScoredBand], masks: Sequence[Mapping[str, Mask]], rate_hz: float
) -> dict[str, dict[str, float]]:
    """Figures of the bands by lateral acceleration: name in `AY_BANDS` -> metric -> value, for
    `REGIME_METRICS` of β [deg] and v (``_vy``) [m/s].

    ``masks`` are the regimes of each range (`regimes_of`). A quantity is left out where fewer than
    `MIN_REGIME_SECONDS` of samples are scored.
    """
    figures: dict[str, dict[str, float]] = {}
    for regime in (regime for regime in AY_BANDS if is_represented(regime, masks, rate_hz)):
        figures[regime] = {}
        inside = np.concatenate([mask[regime] for mask in masks])
        for name, suffix in SUFFIXES.items():
            chosen = inside[banded_errors[name].is_scored]
            if not is_long_enough([chosen], rate_hz):
                continue
            errors = banded_errors[name].errors[chosen]
            half_width_90 = banded_errors[name].half_width_90[chosen]
            values = (
                np.mean(np.abs(errors) <= half_width_90),
                2.0 * half_width_90.mean(),
                interval_score(errors, half_width_90, CHANNEL_LEVEL).mean(),
            )
            figures[regime] |= {
                f"{metric}{suffix}": float(value)
                for metric, value in zip(REGIME_METRICS, values, strict=True)
            }
    return figures


def interval_score(errors: FloatArray, half: FloatArray, level: float) -> FloatArray:
    """Interval score of each sample, (N,): the width of its interval, plus 2/α times the distance
    by which the interval misses the error. On average the true central interval has the lowest
    score.

    Parameters
    ----------
    errors, half : FloatArray
        (N,), in the unit of the score; half widths of the intervals.
    level : float
        1 - α.

    Source: Gneiting & Raftery, Strictly proper scoring rules, prediction, and estimation, JASA 102
    (477), 2007, Eq. 43.
    """
    return 2.0 * half + 2.0 / (1.0 - level) * np.maximum(np.abs(errors) - half, 0.0)


def crps_of_levels(errors: FloatArray, half: FloatArray, levels: Sequence[float]) -> FloatArray:
    """Continuous ranked probability score of each sample, (N,), from the quantiles at the ends of
    central intervals, and the estimate as the median.

    CRPS = 2 ∫ ρ_τ dτ with the pinball loss ρ_τ, where each known τ represents all that are nearest
    to it. Of a Gaussian, at levels 50, 68, 90 and 95 %, that is 2.6 % too low on average, and
    within 2 σ off by up to 0.045 σ: the tails beyond 97.5 % count as their end.

    Parameters
    ----------
    errors : FloatArray
        Estimate - reference, (N,).
    half : FloatArray
        Half widths, (N, L).
    levels : Sequence[float]
        Coverage of the intervals in each column of ``half``, ascending.

    Source: Laio & Tamea, Verification tools for probabilistic forecasts of continuous hydrological
    variables, Hydrology and Earth System Sciences 11, 2007, for the integral; Gneiting & Raftery
    2007, Section 4.2.
    """
    orders = np.sort(
        [0.5, *(0.5 - 0.5 * level for level in levels), *(0.5 + 0.5 * level for level in levels)]
    )
    quantiles = np.concatenate([-half[:, ::-1], np.zeros((len(errors), 1)), half], axis=1)
    shares = np.diff([0.0, *(0.5 * (orders[1:] + orders[:-1])), 1.0])
    missed = -errors[:, None] - quantiles  # reference - quantile, both less the estimate
    pinball = missed * (orders - (missed < 0.0))
    return np.asarray(2.0 * pinball @ shares)


def proportion_interval(sums: FloatArray, sizes: FloatArray) -> tuple[float, float]:
    """95 % interval of a proportion whose samples are dependent within blocks: the exact binomial
    interval for the effective number of samples.

    That number has the variance that the blocks show, and is reduced because few blocks determine
    the variance poorly; where all samples are inside, or none, each block counts as one.

    Parameters
    ----------
    sums : FloatArray
        Samples inside, of each block, (B,), B ≥ 2.
    sizes : FloatArray
        Samples of each block, (B,).

    Source: Korn & Graubard, Confidence intervals for proportions with small expected number of
    positive counts estimated from survey data, Survey Methodology 24 (2), 1998.
    """
    n_blocks = len(sizes)
    share = float(sums.sum() / sizes.sum())
    variance = (
        n_blocks
        / (n_blocks - 1)
        * float(np.sum(np.square(sums - share * sizes)))
        / float(sizes.sum()) ** 2
    )
    independent = float(n_blocks)
    if 0.0 < share < 1.0 and variance > 0.0:
        tail = 0.5 + CONFIDENCE / 2.0
        fewer = float(scipy.special.ndtri(tail) / scipy.special.stdtrit(n_blocks - 1, tail)) ** 2
        independent = min(share * (1.0 - share) / variance * fewer, float(sizes.sum()))
    hits = share * independent
    misses = (1.0 - share) * independent
    outside = (1.0 - CONFIDENCE) / 2.0
    low = float(scipy.special.betaincinv(hits, misses + 1.0, outside)) if hits > 0 else 0.0
    high = float(scipy.special.betaincinv(hits + 1.0, misses, 1.0 - outside)) if misses > 0 else 1.0
    return low, high
