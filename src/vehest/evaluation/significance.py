"""Whether one estimator is better than another: a paired block bootstrap of the difference of their
mean losses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError

# sums of losses of two estimators that are compared, (S, B) and (S', B): a row for each seed, a
# column for each block
Pair = tuple[FloatArray, FloatArray]

CONFIDENCE = 0.95  # level of all intervals; 1 - CONFIDENCE is that of tests
# bootstrap resamples for the standard error of a ratio of pooled losses
N_RESAMPLES_OF_RATIOS = 4000
MAX_BLOCKS = 100_000  # blocks up to which a needed number is searched
DRAWN_AT_ONCE = 2_000_000  # block counts of resamples that are in memory at once


@dataclass(frozen=True)
class Interval:
    """A figure, or a difference first - second, with its interval and test."""

    value: float  # the figure; of a difference, negative where the first has the lower loss
    low: float  # lower end of the 95 % interval
    high: float  # upper end
    p_value: float  # two-sided, of no difference; below 0.05 where the interval excludes 0
    error: float = 0.0  # standard error
    dof: float = np.inf  # degrees of freedom of Student's t

    def at(self, confidence: float) -> tuple[float, float]:
        """Lower and upper end of the interval at another confidence than 95 %."""
        return _ends(self.value, self.error, self.dof, confidence)


def _ends(value: float, error: float, dof: float, confidence: float) -> tuple[float, float]:
    """Lower and upper end of the interval of a value by Student's distribution."""
    half = float(scipy.special.stdtrit(dof, 0.5 + confidence / 2.0)) * error
    return value - half, value + half


def differences_of_blocks(
    pairs: Sequence[Pair], sizes: FloatArray, *, n_resamples: int = 10_000
) -> list[Interval]:
    """Compare pairs of estimators on the same samples by the roots of their mean losses over all
    seeds and samples, an RMSE where losses are squared errors; all pairs see the same draws.

    Each resample draws blocks with replacement, the same for both estimators, since what is
    difficult for one is for the other; and seeds of each estimator, independently, since they are
    different trainings. Of n blocks or seeds n - 1 are drawn, which makes the variance of a mean
    unbiased (Rao & Wu 1988). The resamples give the standard error, Student's t the interval, with
    degrees of freedom from blocks and seeds by Welch and Satterthwaite: with 7 sequences and 3
    seeds percentiles of the resamples would be too narrow.

    An estimator with one seed counts as if all its trainings had that outcome. Where errors are a
    seed's own in each sequence, and common neither to an estimator's seeds nor to its sequences,
    intervals are wider than need be (Owen 2007), never narrower.

    Parameters
    ----------
    pairs : Sequence[Pair]
        Two estimators each: sum of the losses of each seed over each block, (S, B) and (S', B),
        none negative.
    sizes : FloatArray
        Samples in each block, shape (B,).

    Raises
    ------
    DataError
        There are fewer than two blocks.

    Source: Künsch, The jackknife and the bootstrap for general stationary observations, Annals of
    Statistics 17 (3), 1989; Rao & Wu, Resampling inference with complex survey data, JASA 83 (401),
    1988; Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1 (2), 2007.
    """
    if len(sizes) < 2:
        raise DataError(f"there are {len(sizes)} blocks to resample, at least two are needed")
    differences = []
    for pair, drawn in zip(pairs, _resampled(pairs, sizes, n_resamples), strict=True):
        first, second = ((sums.sum(axis=1) / sizes.sum()).mean() for sums in pair)
        value = float(np.sqrt(first) - np.sqrt(second))
        differences.append(_interval(value, drawn, _degrees_of_freedom(pair, sizes)))
    return differences


def root_intervals(
    candidates: Sequence[FloatArray], sizes: FloatArray, *, n_resamples: int = 4000
) -> list[Interval]:
    """The square root of each estimator's mean loss over blocks and seeds, an RMSE where losses are
    squared errors, with its interval.

    Blocks and seeds are drawn as in `differences_of_blocks`; the interval is symmetric on a
    logarithmic axis, on which the distribution of a root of few blocks is less skewed.

    Parameters
    ----------
    candidates : Sequence[FloatArray]
        Sum of the losses of each seed over each block, (S, B), none negative, of each estimator.
    sizes : FloatArray
        Samples in each block, (B,).
    """
    no_losses = np.zeros((1, len(sizes)))
    pairs = [(sums, no_losses) for sums in candidates]
    intervals = []
    for sums, drawn in zip(candidates, _resampled(pairs, sizes, n_resamples), strict=True):
        value = float(np.sqrt(sums.sum(axis=1).mean() / sizes.sum()))
        if value > 0:
            dof = _degrees_of_freedom((sums, no_losses), sizes)
            intervals.append(_logarithmic(value, drawn, dof))
        else:
            intervals.append(Interval(value, value, value, 1.0))
    return intervals


def unexplained_interval(
    squared_error: FloatArray,
    error: FloatArray,
    squared: FloatArray,
    reference: FloatArray,
    sizes: FloatArray,
    *,
    n_resamples: int = 4000,
) -> Interval:
    """The fraction of variance unexplained with its interval, as `root_intervals`; all arguments
    are sums over the samples of each block, (B,).

    Parameters
    ----------
    squared_error : FloatArray
        Sums of (v̂ - v)².
    error : FloatArray
        Sums of v̂ - v.
    squared : FloatArray
        Sums of v².
    reference : FloatArray
        Sums of v.
    sizes : FloatArray
        Numbers of samples.
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


@dataclass(frozen=True)
class Contrast:
    """A mean or a difference of means over blocks and seeds, with the parts of its variance.

    Attributes
    ----------
    value : float
        The mean or difference; a logarithm where ratios are compared.
    parts : tuple of (float, float)
        Variance of ``value`` and degrees of freedom of that variance: first what drawing other
        blocks would change, then what training other seeds of each estimator would change.
    n_blocks : int
        Blocks that it rests on.

    Source: Satterthwaite, An approximate distribution of estimates of variance components,
    Biometrics Bulletin 2 (6), 1946, for the degrees of freedom of a sum of variances.
    """

    value: float
    parts: tuple[tuple[float, float], ...]
    n_blocks: int

    @property
    def error(self) -> float:
        """Standard error."""
        return math.sqrt(sum(variance for variance, _ in self.parts))

    @property
    def dof(self) -> float:
        """Degrees of freedom of Student's t."""
        spread = sum(variance**2 / free for variance, free in self.parts)
        total = sum(variance for variance, _ in self.parts)
        if spread == 0:
            return float(self.parts[0][1])
        # below 1 by chance where the seeds' variance is small: two seeds alone have 1
        return max(total**2 / spread, 1.0)

    def interval(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Lower and upper end of the interval of ``value`` at a confidence."""
        return _ends(self.value, self.error, self.dof, confidence)

    @property
    def p_value(self) -> float:
        """Two-sided p-value of the hypothesis that the true value is zero."""
        if self.error == 0:
            return 0.0 if self.value else 1.0
        return 2.0 * float(scipy.special.stdtr(self.dof, -abs(self.value) / self.error))

    def power(self, true_value: float, level: float = 1.0 - CONFIDENCE) -> float:
        """Probability that the two-sided test at ``level`` rejects zero in the right direction if
        the true value is ``true_value``.

        From the noncentral t distribution (Johnson, Kotz & Balakrishnan, Continuous univariate
        distributions 2, 1995, chapter 31).
        """
        if self.error == 0:
            return 1.0
        critical = float(scipy.special.stdtrit(self.dof, 1.0 - level / 2.0))
        noncentrality = abs(true_value) / self.error
        return 1.0 - float(scipy.special.nctdtr(self.dof, noncentrality, critical))

    def with_blocks(self, n_blocks: int) -> Contrast:
        """The contrast that ``n_blocks`` blocks of this kind would give: the same value, with the
        variance by blocks scaled.
        """
        (variance, _), *of_seeds = self.parts
        of_blocks = (variance * self.n_blocks / n_blocks, n_blocks - 1.0)
        return Contrast(self.value, (of_blocks, *of_seeds), n_blocks)

    def blocks_needed(
        self, true_value: float, power: float, level: float = 1.0 - CONFIDENCE
    ) -> int | None:
        """Smallest number of blocks with which the test at ``level`` detects ``true_value`` with
        the probability ``power``.

        Returns
        -------
        int or None
            None where `MAX_BLOCKS` do not suffice: then the seeds' variance limits the power.
        """

        def suffices(n_blocks: int) -> bool:
            return self.with_blocks(n_blocks).power(true_value, level) >= power

        # by doubling, since with many blocks the seeds' few degrees of freedom can lower the power
        enough = 2
        while not suffices(enough):
            enough *= 2
            if enough > MAX_BLOCKS:
                return None
        too_few = enough // 2
        while enough - too_few > 1:
            middle = (too_few + enough) // 2
            too_few, enough = (too_few, middle) if suffices(middle) else (middle, enough)
        return enough


def mean_contrast(
    first: FloatArray, second: FloatArray | None = None, *, has_paired_seeds: bool = False
) -> Contrast:
    """Mean over blocks and seeds, or the difference of two such means over the same blocks.

    The value of seed s and block b is modelled as mu + a_s + b_b + e_sb. The variance of the mean
    over blocks has the parts of b and e in it, that of the mean over seeds the parts of a and e:
    the latter is reduced by the mean square of e, so that e is not counted twice.

    Parameters
    ----------
    first, second : array, shape (S, B) and (S', B)
        A value of each seed and block; all blocks count alike.
    has_paired_seeds : bool
        The two are the same trainings, row by row; otherwise their seeds are independent. Seeds
        of an estimator with one seed are taken to have all the same outcome.

    Raises
    ------
    DataError
        There are fewer than two blocks.

    Source: Scheffé, The analysis of variance, 1959, section 7.4 (two crossed random factors);
    Student's t for one seed.
    """
    n_blocks = first.shape[1]
    if n_blocks < 2:
        raise DataError(f"there are {n_blocks} blocks, a variance needs at least two")
    sides = [first]
    if second is not None:
        sides = [first - second] if has_paired_seeds else [first, -second]
    of_blocks = np.sum([side.mean(axis=0) for side in sides], axis=0)
    parts = [(float(of_blocks.var(ddof=1)) / n_blocks, n_blocks - 1.0)]
    parts += [part for side in sides for part in _variance_of_seeds(side)]
    return Contrast(float(of_blocks.mean()), tuple(parts), n_blocks)


def log_ratio_of_pooled(
    first: FloatArray,
    second: FloatArray,
    *,
    has_paired_seeds: bool = False,
) -> Contrast:
    """Logarithm of the ratio of two sums over blocks, each the mean over its seeds.

    Blocks and seeds are drawn as in `differences_of_blocks`; the resamples give the standard error,
    and the mean's influences of blocks and seeds its parts. With samples in each block, (1, B), in
    place of ``second`` it is the logarithm of a mean loss.

    Parameters
    ----------
    first, second : array, shape (S, B) and (S', B)
        Sum of the losses of each seed over each block; their totals are above zero.
    has_paired_seeds : bool
        The two are the same trainings, row by row.

    Source: Künsch 1989, Rao & Wu 1988, as in `differences_of_blocks`.
    """
    generator = np.random.default_rng(1)
    counts = _counts_of_ratios(first.shape[1])
    drawn = np.zeros(N_RESAMPLES_OF_RATIOS)
    rows: NDArray[np.int64] | None = None
    for sign, side in ((1.0, first), (-1.0, second)):
        if rows is None or not has_paired_seeds:
            rows = generator.integers(
                len(side), size=(N_RESAMPLES_OF_RATIOS, max(len(side) - 1, 1))
            )
        with np.errstate(divide="ignore"):
            drawn += sign * np.log(np.take_along_axis(counts @ side.T, rows, axis=1).mean(axis=1))
    variance = float(np.var(drawn[np.isfinite(drawn)]))
    totals = [float(side.sum(axis=1).mean()) for side in (first, second)]
    influences = mean_contrast(
        *(
            side * first.shape[1] / total
            for side, total in zip((first, second), totals, strict=True)
        ),
        has_paired_seeds=has_paired_seeds,
    )
    scale = variance / influences.error**2 if influences.error > 0 else 0.0
    parts = tuple((scale * part, free) for part, free in influences.parts)
    return Contrast(math.log(totals[0] / totals[1]), parts, first.shape[1])


@lru_cache(maxsize=4)
def _counts_of_ratios(n_blocks: int) -> FloatArray:
    """`_counts` of the resamples for `log_ratio_of_pooled`, cached, since they are the same for all
    ratios over as many blocks.
    """
    return _counts(n_blocks, N_RESAMPLES_OF_RATIOS, np.random.default_rng(0))


def _variance_of_seeds(values: FloatArray) -> list[tuple[float, float]]:
    """Part of the variance of the mean of ``values`` (S, B) that is due to the seeds alone, with
    its degrees of freedom; empty for one seed, or where single values explain all of it.
    """
    n_seeds, n_blocks = values.shape
    if n_seeds < 2:
        return []
    of_seeds = values.mean(axis=1)
    residuals = values - of_seeds[:, None] - values.mean(axis=0) + values.mean()
    n_free = (n_seeds - 1.0) * (n_blocks - 1.0)
    total = float(of_seeds.var(ddof=1)) / n_seeds
    single = float(np.sum(np.square(residuals))) / n_free / (n_seeds * n_blocks)
    if total <= single:
        return []
    spread = total**2 / (n_seeds - 1.0) + single**2 / n_free
    return [(total - single, (total - single) ** 2 / spread)]


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for their number by Holm's method: with a probability of 95 % or more none
    of the hypotheses rejected at 0.05 is true.

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
    """Number of times that each block is drawn, (n, n_blocks): n_blocks - 1 draws with
    replacement.
    """
    counts: FloatArray = generator.multinomial(
        n_blocks - 1, np.full(n_blocks, 1.0 / n_blocks), size=n
    ).astype(np.float64)
    return counts


def _resampled(pairs: Sequence[Pair], sizes: FloatArray, n_resamples: int) -> FloatArray:
    """Differences of the roots of mean losses, first - second, of each resample, (pairs,
    n_resamples).

    Pairs with the same numbers of seeds share their draws, so that the result of a pair does not
    depend on the others.
    """
    at_once = max(DRAWN_AT_ONCE // len(sizes), 1)
    drawn = np.empty((len(pairs), n_resamples))
    for numbers in dict.fromkeys((len(first), len(second)) for first, second in pairs):
        generator = np.random.default_rng(0)
        for begin in range(0, n_resamples, at_once):
            part = slice(begin, min(begin + at_once, n_resamples))
            counts = _counts(len(sizes), part.stop - begin, generator)
            seeds = [generator.integers(number, size=(len(counts), number)) for number in numbers]
            roots: dict[tuple[int, int], FloatArray] = {}
            for position, pair in enumerate(pairs):
                if (len(pair[0]), len(pair[1])) != numbers:
                    continue
                for side, sums in enumerate(pair):
                    if (id(sums), side) not in roots:
                        losses = np.take_along_axis(
                            counts @ sums.T / (counts @ sizes)[:, None], seeds[side], axis=1
                        )
                        fewer = losses[:, : max(len(sums) - 1, 1)]
                        roots[id(sums), side] = np.sqrt(fewer.mean(axis=1))
                drawn[position, part] = roots[id(pair[0]), 0] - roots[id(pair[1]), 1]
    return drawn


def _degrees_of_freedom(pair: Pair, sizes: FloatArray) -> float:
    """Degrees of freedom of a difference by Welch and Satterthwaite, from the variance between
    blocks and that between seeds of either estimator.
    """
    means = [sums.sum(axis=1) / sizes.sum() for sums in pair]
    n_blocks = len(sizes)
    difference = means[0].mean() - means[1].mean()
    residuals = (pair[0].mean(axis=0) - pair[1].mean(axis=0) - difference * sizes) / sizes.mean()
    parts = [(float(residuals.var(ddof=1)) / n_blocks, n_blocks - 1)]
    parts += [
        (float(seed_means.var(ddof=1)) / len(seed_means), len(seed_means) - 1)
        for seed_means in means
        if len(seed_means) > 1
    ]
    spread = sum(variance**2 / free for variance, free in parts)
    return (
        sum(variance for variance, _ in parts) ** 2 / spread if spread > 0 else float(n_blocks - 1)
    )


def _interval(value: float, drawn: FloatArray, dof: float) -> Interval:
    """A value's interval and p-value by Student's distribution, the standard error being the spread
    of the values that were drawn.
    """
    error = float(np.std(drawn))
    ratio = abs(value) / error if error > 0 else (np.inf if value else 0.0)
    p_value = 2.0 * float(scipy.special.stdtr(dof, -ratio))
    return Interval(value, *_ends(value, error, dof, CONFIDENCE), p_value, error, dof)


def _logarithmic(value: float, drawn: FloatArray, dof: float) -> Interval:
    """Interval of a positive figure that is symmetric on a logarithmic axis, from the spread of the
    values that were drawn; without a p-value (NaN).
    """
    finite = drawn[np.isfinite(drawn) & (drawn > 0)]
    error = float(np.std(np.log(finite / value)))
    factor = float(np.exp(scipy.special.stdtrit(dof, 0.5 + CONFIDENCE / 2.0) * error))
    return Interval(value, value / factor, value * factor, np.nan, error * value, dof)
