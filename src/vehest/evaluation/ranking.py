"""Which of several estimators may be called best: paired intervals of their differences, corrected
for their number.

    segments of each seed --rank--> blocks -> RMSE, paired differences -> Holm's correction ->
    `Ranking`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vehest.constants import FloatArray
from vehest.evaluation.blocks import MIN_BLOCKS, Segments, block_labels, block_sums
from vehest.evaluation.significance import (
    CONFIDENCE,
    Pair,
    differences_of_blocks,
    holm,
    root_intervals,
)
from vehest.trust.bands import effective_blocks

Name = tuple[str, str]  # estimator and variant
# whether the RMSE of the first of two estimators is significantly lower or higher
Verdict = Literal["lower", "higher", "no significant difference"]
BASELINES = ("zero", "static_map")  # estimators that a recommended one has to beat


@dataclass(frozen=True)
class Comparison:
    """RMSE(β) of a first estimator less that of a second, over all seeds of both."""

    difference: float  # first - second, in the unit of the RMSE
    low: float  # lower end of its interval, corrected by Holm over all comparisons of the table
    high: float  # upper end of the interval
    p_value: float  # two-sided, corrected likewise
    verdict: Verdict  # whether the first lies significantly lower or higher than the second

    @property
    def reversed(self) -> Comparison:
        """The comparison with first and second swapped."""
        swapped: dict[Verdict, Verdict] = {"lower": "higher", "higher": "lower"}
        verdict = swapped.get(self.verdict, self.verdict)
        return Comparison(-self.difference, -self.high, -self.low, self.p_value, verdict)


@dataclass(frozen=True)
class Ranking:
    """Order of several estimators on a test set by RMSE(β) [deg], with the comparisons of pairs."""

    order: Sequence[Name]  # names by RMSE over all seeds, the lowest first
    rmse: Mapping[Name, float]  # RMSE(β) over all seeds of each [deg]
    # 95 % interval of the RMSE over blocks and seeds [deg]
    intervals: Mapping[Name, tuple[float, float]]
    # (first, second) -> comparison, of every pair that was compared, either way round
    pairs: Mapping[tuple[Name, Name], Comparison]
    n_blocks: int  # number of blocks; below `MIN_BLOCKS` there are no intervals and comparisons
    block_seconds: float  # mean time in a block at which sideslip is scored [s]
    # Kish's effective number of blocks, by the squared error of the best estimator
    effective_blocks: float

    @property
    def missing_baselines(self) -> list[str]:
        """Those of `BASELINES` that were not compared."""
        compared = {name[0] for name in self.order}
        return [baseline for baseline in BASELINES if baseline not in compared]

    def beats(self, name: Name, baseline: str) -> bool | None:
        """Whether a candidate's RMSE lies significantly below a baseline's; None without a
        significant difference or a comparison.
        """
        comparisons = [
            comparison
            for (candidate, against), comparison in self.pairs.items()
            if candidate == name and against[0] == baseline
        ]
        if not comparisons or comparisons[0].verdict == "no significant difference":
            return None
        return comparisons[0].verdict == "lower"

    @property
    def winner(self) -> Name | None:
        """The estimator with an RMSE significantly below that of every other and of both baselines;
        None if there is none, a baseline was not compared, or blocks are too few.
        """
        if (
            self.n_blocks < MIN_BLOCKS
            or not self.order
            or self.missing_baselines
            or self.order[0][0] in BASELINES
        ):
            return None
        beaten = all(
            self.pairs[self.order[0], candidate].verdict == "lower" for candidate in self.order[1:]
        )
        return (
            self.order[0]
            if beaten and all(self.beats(self.order[0], baseline) for baseline in BASELINES)
            else None
        )

    @property
    def recommendable(self) -> list[Name]:
        """The estimator with the lowest RMSE and those without a significant difference to it,
        except those that do not beat every baseline significantly.
        """
        if not self.order:
            return []
        return [
            name
            for name in (self.order[0], *self.tied_with_best)
            if all(self.beats(name, baseline) for baseline in BASELINES)
        ]

    @property
    def tied_with_best(self) -> list[Name]:
        """Estimators, in order, without a significant difference to the one with the lowest
        RMSE.
        """
        comparisons = [(name, self.pairs.get((self.order[0], name))) for name in self.order[1:]]
        return [
            name
            for name, comparison in comparisons
            if comparison is not None and comparison.verdict == "no significant difference"
        ]


def rank(
    segments: Mapping[Name, Sequence[Segments]],
    rate_hz: float,
    claimed_pairs: Sequence[tuple[Name, Name]] = (),
) -> Ranking:
    """Compare estimators on one test set by RMSE(β). Where sideslip is scored at no sample, the
    ranking has no order, and NaN as RMSE.

    Every pair is compared on the same blocks, drawn together, with the seeds of each drawn on their
    own (`differences_of_blocks`). Corrected together by Holm are: the best against every other,
    every candidate against each baseline, and the claimed pairs.

    Parameters
    ----------
    segments : Mapping[Name, Sequence[Segments]]
        Estimator and variant -> segments of each seed, all over the same samples.
    rate_hz : float
        Rate of these samples [Hz].
    claimed_pairs : Sequence[tuple[Name, Name]], default ()
        Further pairs to compare, such as those whose order a paper claims; left out where one of
        the two is missing.
    """
    reference_segments = next(iter(segments.values()))[0].with_sideslip
    if not len(reference_segments):
        return Ranking([], dict.fromkeys(segments, np.nan), {}, {}, 0, 0.0, 0.0)
    losses = {
        name: np.stack([seed.with_sideslip.squared_error_sideslip for seed in seeds])
        for name, seeds in segments.items()
    }
    per_sample = np.concatenate(
        [loss / reference_segments.sideslip_samples for loss in losses.values()]
    )
    labels = block_labels(reference_segments, per_sample)
    sizes = block_sums(reference_segments.sideslip_samples, labels)
    sums = {name: block_sums(loss, labels) for name, loss in losses.items()}
    rmse = {
        name: float(np.sqrt(values.sum(axis=1).mean() / sizes.sum()))
        for name, values in sums.items()
    }
    order = sorted(rmse, key=lambda name: rmse[name])
    enough = len(sizes) >= MIN_BLOCKS
    pairs = _pairs(order, claimed_pairs) if enough else []
    compared = dict(
        zip(
            pairs,
            _corrected([(sums[first], sums[second]) for first, second in pairs], sizes),
            strict=True,
        )
    )
    intervals = root_intervals([sums[name] for name in order], sizes) if enough else []
    return Ranking(
        order=order,
        rmse=rmse,
        intervals={
            name: (interval.low, interval.high)
            for name, interval in zip(order, intervals, strict=True)
        }
        if enough
        else {},
        pairs={
            key: comparison
            for (first, second), value in compared.items()
            for key, comparison in (((first, second), value), ((second, first), value.reversed))
        },
        n_blocks=len(sizes),
        block_seconds=float(sizes.mean()) / rate_hz,
        effective_blocks=effective_blocks(sums[order[0]].mean(axis=0)),
    )


def _pairs(
    order: Sequence[Name], claimed_pairs: Sequence[tuple[Name, Name]]
) -> list[tuple[Name, Name]]:
    """Pairs to compare: the best with every other, every candidate with every baseline, and the
    claimed pairs; each pair once.
    """
    pairs = [(order[0], second) for second in order[1:]]
    pairs += [
        (name, second)
        for name in order
        for second in order
        if second[0] in BASELINES and name[0] not in BASELINES
    ]
    for first, second in claimed_pairs:
        if first in order and second in order and (second, first) not in pairs:
            pairs.append((first, second))
    return list(dict.fromkeys(pairs))


def _corrected(pairs: Sequence[Pair], sizes: FloatArray) -> list[Comparison]:
    """Comparisons of pairs of losses (`differences_of_blocks`) with Holm's correction: each
    interval is at the level at which its hypothesis is tested.
    """
    differences = differences_of_blocks(pairs, sizes)
    adjusted = holm([difference.p_value for difference in differences])
    comparisons = []
    for difference, p_value in zip(differences, adjusted, strict=True):
        factor = (
            max(p_value / difference.p_value, 1.0) if difference.p_value > 0 else float(len(pairs))
        )
        low, high = difference.at(1.0 - (1.0 - CONFIDENCE) / factor)
        verdict: Verdict = (
            "no significant difference"
            if p_value >= 1.0 - CONFIDENCE
            else ("lower" if difference.value < 0 else "higher")
        )
        comparisons.append(Comparison(difference.value, low, high, p_value, verdict))
    return comparisons
