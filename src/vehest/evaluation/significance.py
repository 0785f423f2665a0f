"""Whether one estimator is better than another: a paired block bootstrap of the difference of their mean losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from vehest.constants import FloatArray
from vehest.data.errors import DataError

Pair = tuple[FloatArray, FloatArray]

CONFIDENCE = 0.95
DRAWN_AT_ONCE = 2_000_000  # block counts of so many resamples are held at once


@dataclass(frozen=True)
class Interval:
    """A figure, or a difference first - second, and how well it is known."""

    value: float  # the figure; of a difference, negative where the first has the lower loss
    low: float  # lower end of the 95 % interval
    high: float  # its upper end
    p_value: float  # two-sided, of the hypothesis that there is no difference; below 0.05 exactly if the interval leaves 0 out
    error: float = 0.0  # standard error
    dof: float = np.inf  # degrees of freedom of Student's t

    def at(self, confidence: float) -> tuple[float, float]:
        """Both ends at another confidence than 95 %."""
        half = float(scipy.special.stdtrit(self.dof, 0.5 + confidence / 2.0)) * self.error
        return self.value - half, self.value + half


@dataclass(frozen=True)
class Difference:
    """How the losses of two estimators differ."""

    mean: Interval  # of their mean losses over all seeds and samples
    median: Interval  # of the medians over seeds of their mean losses over samples
    root: Interval  # of the square roots of their mean losses, RMSEs where losses are squared errors; NaN where a loss is negative


def difference_of_blocks(
    first: FloatArray, second: FloatArray, sizes: FloatArray, *, n_resamples: int = 10_000
) -> Difference:
    """`differences_of_blocks` of one pair."""
    return differences_of_blocks([(first, second)], sizes, n_resamples=n_resamples)[0]


def differences_of_blocks(
    pairs: Sequence[Pair], sizes: FloatArray, *, n_resamples: int = 10_000
) -> list[Difference]:
    """Compare pairs of estimators on the same samples; all pairs see the same draws.

    Each resample draws blocks with replacement, the same for both estimators, since what is difficult for one is for the other; and
    seeds of each estimator, independently, since they are different trainings. Of n blocks or seeds n - 1 are drawn, which makes the
    variance of a mean unbiased (Rao & Wu 1988); for a median of three seeds or more all n. The resamples give the standard error,
    Student's t the interval, with degrees of freedom from blocks and seeds by Welch and Satterthwaite: with 7 sequences and 3 seeds
    percentiles of the resamples would be too narrow.

    An estimator with one seed counts as if all its trainings had that outcome. Where errors are a seed's own in each sequence, and
    common neither to an estimator's seeds nor to its sequences, intervals are wider than need be (Owen 2007), never narrower.

    Args:
        pairs: sum of the losses of each seed over each block, shape (S, B) and (S', B).
        sizes: samples in each block, shape (B,).

    Raises:
        DataError: there are fewer than two blocks.

    Source: Künsch, The jackknife and the bootstrap for general stationary observations, Annals of Statistics 17 (3), 1989; Rao & Wu,
    Resampling inference with complex survey data, JASA 83 (401), 1988; Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1 (2),
    2007.
    """
    if len(sizes) < 2:
        raise DataError(f"there are {len(sizes)} blocks to resample, at least two are needed")
    found = []
    for pair, drawn in zip(pairs, _resampled(pairs, sizes, n_resamples), strict=True):
        means = [own.sum(axis=1) / sizes.sum() for own in pair]
        dof = _degrees_of_freedom(pair, sizes, means)
        with np.errstate(invalid="ignore"):
            root = float(np.sqrt(means[0].mean()) - np.sqrt(means[1].mean()))
        found.append(
            Difference(
                mean=_interval(float(means[0].mean() - means[1].mean()), drawn[0], dof),
                median=_interval(float(np.median(means[0]) - np.median(means[1])), drawn[1], dof),
                root=_interval(root, drawn[2], dof),
            )
        )
    return found


def root_interval(sums: FloatArray, sizes: FloatArray, *, n_resamples: int = 4000) -> Interval:
    """`root_intervals` of one estimator."""
    return root_intervals([sums], sizes, n_resamples=n_resamples)[0]


def root_intervals(
    candidates: Sequence[FloatArray], sizes: FloatArray, *, n_resamples: int = 4000
) -> list[Interval]:
    """The square root of a mean loss over blocks and seeds, an RMSE where losses are squared errors, with its interval.

    Blocks and seeds are drawn as in `differences_of_blocks`; the interval is symmetric on a logarithmic axis, on which the distribution of
    a root of few blocks is less skewed.

    Args:
        candidates: sum of the losses of each seed over each block, (S, B), none negative, of each estimator.
        sizes: samples in each block, (B,).
    """
    nothing = np.zeros((1, len(sizes)))
    pairs = [(sums, nothing) for sums in candidates]
    found = []
    for sums, drawn in zip(candidates, _resampled(pairs, sizes, n_resamples), strict=True):
        value = float(np.sqrt(sums.sum(axis=1).mean() / sizes.sum()))
        if value > 0:
            dof = _degrees_of_freedom(
                [sums, nothing], sizes, [sums.sum(axis=1) / sizes.sum(), np.zeros(1)]
            )
            found.append(_logarithmic(value, drawn[2], dof))
        else:
            found.append(Interval(value, value, value, 1.0))
    return found


def unexplained_interval(
    squared_error: FloatArray,
    error: FloatArray,
    squared: FloatArray,
    reference: FloatArray,
    sizes: FloatArray,
    *,
    n_resamples: int = 4000,
) -> Interval:
    """The fraction of variance unexplained with its interval, as `root_interval`; all arguments are sums over blocks, (B,).

    Args:
        squared_error: of (v̂ - v)².
        error: of v̂ - v.
        squared: of v².
        reference: of v.
        sizes: samples.
    """
    drawn = _counts(len(sizes), n_resamples, np.random.default_rng(0))

    def fraction(counts: FloatArray) -> FloatArray:
        n = counts @ sizes
        part: FloatArray = counts @ squared_error / n - np.square(counts @ error / n)
        return part / (counts @ squared / n - np.square(counts @ reference / n))

    value = float(fraction(np.ones((1, len(sizes))))[0])
    if not value > 0:
        return Interval(value, value, value, 1.0)
    return _logarithmic(value, fraction(drawn), len(sizes) - 1)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for their number: those below 0.05 hold together with an error of at most 5 %.

    Source: Holm, Scandinavian Journal of Statistics 6 (2), 1979.
    """
    order = np.argsort(p_values, kind="stable")
    adjusted = [1.0] * len(p_values)
    largest = 0.0
    for rank, position in enumerate(order):
        largest = max(largest, min((len(p_values) - rank) * p_values[position], 1.0))
        adjusted[int(position)] = largest
    return adjusted


def _counts(n_blocks: int, n: int, generator: np.random.Generator) -> FloatArray:
    """How often each block is drawn, (n, n_blocks): n_blocks - 1 draws with replacement."""
    counts: FloatArray = generator.multinomial(
        n_blocks - 1, np.full(n_blocks, 1.0 / n_blocks), size=n
    ).astype(np.float64)
    return counts


def _resampled(pairs: Sequence[Pair], sizes: FloatArray, n_resamples: int) -> FloatArray:
    """Differences of means, of medians over seeds, and of roots of means of each resample, (pairs, 3, n_resamples).

    Pairs of as many seeds share their draws, which are those of each pair alone.
    """
    at_once = max(DRAWN_AT_ONCE // len(sizes), 1)
    drawn = np.empty((len(pairs), 3, n_resamples))
    for numbers in dict.fromkeys((len(first), len(second)) for first, second in pairs):
        generator = np.random.default_rng(0)
        for begin in range(0, n_resamples, at_once):
            part = slice(begin, min(begin + at_once, n_resamples))
            counts = _counts(len(sizes), part.stop - begin, generator)
            seeds = [generator.integers(number, size=(len(counts), number)) for number in numbers]
            known: dict[tuple[int, int], tuple[FloatArray, FloatArray]] = {}
            for position, pair in enumerate(pairs):
                if (len(pair[0]), len(pair[1])) != numbers:
                    continue
                for side, own in enumerate(pair):
                    if (id(own), side) not in known:
                        losses = np.take_along_axis(
                            counts @ own.T / (counts @ sizes)[:, None], seeds[side], axis=1
                        )
                        fewer = losses[:, : max(len(own) - 1, 1)]
                        known[id(own), side] = (
                            fewer.mean(axis=1),
                            np.median(losses if len(own) > 2 else fewer, axis=1),
                        )
                (first, first_median), (second, second_median) = (
                    known[id(own), side] for side, own in enumerate(pair)
                )
                with np.errstate(invalid="ignore"):
                    drawn[position, :, part] = (
                        first - second,
                        first_median - second_median,
                        np.sqrt(first) - np.sqrt(second),
                    )
    return drawn


def _degrees_of_freedom(
    sums: Sequence[FloatArray], sizes: FloatArray, means: Sequence[FloatArray]
) -> float:
    """Welch-Satterthwaite over the variance between blocks and that between seeds of either estimator."""
    n_blocks = len(sizes)
    difference = means[0].mean() - means[1].mean()
    residuals = (sums[0].mean(axis=0) - sums[1].mean(axis=0) - difference * sizes) / sizes.mean()
    parts = [(float(residuals.var(ddof=1)) / n_blocks, n_blocks - 1)]
    parts += [(float(own.var(ddof=1)) / len(own), len(own) - 1) for own in means if len(own) > 1]
    spread = sum(variance**2 / free for variance, free in parts)
    return (
        sum(variance for variance, _ in parts) ** 2 / spread if spread > 0 else float(n_blocks - 1)
    )


def _interval(value: float, drawn: FloatArray, dof: float) -> Interval:
    error = float(np.std(drawn))
    half = float(scipy.special.stdtrit(dof, 0.5 + CONFIDENCE / 2.0)) * error
    ratio = abs(value) / error if error > 0 else (np.inf if value else 0.0)
    return Interval(
        value, value - half, value + half, 2.0 * float(scipy.special.stdtr(dof, -ratio)), error, dof
    )


def _logarithmic(value: float, drawn: FloatArray, dof: float) -> Interval:
    """Of a positive figure, symmetric on a logarithmic axis."""
    finite = drawn[np.isfinite(drawn) & (drawn > 0)]
    error = float(np.std(np.log(finite / value)))
    factor = float(np.exp(scipy.special.stdtrit(dof, 0.5 + CONFIDENCE / 2.0) * error))
    return Interval(value, value / factor, value * factor, np.nan, error * value, dof)
