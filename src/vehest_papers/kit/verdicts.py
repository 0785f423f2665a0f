"""Verdicts on the claims of a paper: one engine for all papers, on errors by block and seed.

An order ("A has a lower error than B") is tested on the logarithm of the ratio of both errors in
each block, whose mean over blocks and seeds all blocks enter alike. Its size is the ratio of the
errors pooled over all blocks. The two may disagree where few blocks hold most of the error: then
there is no significant difference. Verdicts, in this precedence:

==========================  ======================================================================
not testable                data that are not public would be needed
not assessed                no errors by block are published of a candidate
met by a trivial baseline   met, and would be with ``zero`` or ``static_map`` in the candidate's
                            place; not of a claim that the candidate's error is higher
reproduced                  met, and our interval contains the paper's size, or it states none
direction only              met, but the interval of our size excludes the paper's
contradicted                significant in the other direction; an interval off the claimed range
no significant difference   of an order; with the power to detect the paper's size
inconclusive                of a limit or an equality: the interval contains its boundary
==========================  ======================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError, number_of
from vehest.evaluation.blocks import MIN_BLOCKS
from vehest.evaluation.significance import (
    CONFIDENCE,
    Contrast,
    holm,
    log_ratio_of_pooled,
    mean_contrast,
)
from vehest_papers.kit.block_errors import TRAINING_STATES, BlockErrors, Key, Training
from vehest_papers.kit.claim_files import BASELINES, Claim, Paper, Row, Table

Verdict = Literal[
    "not testable",
    "not assessed",
    "met by a trivial baseline",
    "reproduced",
    "direction only",
    "contradicted",
    "no significant difference",
    "inconclusive",
]
VERDICTS: tuple[Verdict, ...] = (
    "reproduced",
    "direction only",
    "met by a trivial baseline",
    "contradicted",
    "no significant difference",
    "inconclusive",
    "not testable",
    "not assessed",
)
ALPHA = 1.0 - CONFIDENCE
EQUALITY_CONFIDENCE = 0.90  # two one-sided tests at 5 % (Schuirmann 1987)
DEFAULT_MARGIN = 0.1
TARGET_POWER = 0.8
MET = ("reproduced", "direction only")  # verdicts on a claim that is met
NOT_PUBLISHED = "per-block errors of this study are not published yet"


@dataclass(frozen=True)
class Figure:
    """A value, or a ratio, with its interval; NaN ends where there are too few blocks."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Judgement:
    """What became of a claim or of a value of a table."""

    verdict: Verdict
    reason: str
    values: Mapping[str, Figure]  # candidate -> its error, or what was measured
    order: Figure | None = None  # geometric mean over blocks of candidate / other
    size: Figure | None = None  # candidate / other, of pooled errors
    p_value: float = math.nan  # of the order, corrected by Holm
    n_blocks: int = 0
    n_seeds: Mapping[str, int] | None = None
    diverged: Mapping[str, int] | None = None  # candidate -> pairs of block and seed
    power: float = math.nan  # to detect the paper's size
    blocks_needed: int | None = None  # for a power of 80 %


@dataclass(frozen=True, eq=False)
class Pair:
    """Errors of two candidates in the blocks in which both are finite."""

    first: FloatArray  # (S, B)
    second: FloatArray  # (S', B)
    sizes: FloatArray  # (B,)
    n_diverged: tuple[int, int]  # pairs of block and seed that were left out, of either
    exponent: float  # 1/2 for a root of pooled squares
    has_paired_seeds: bool = False

    @property
    def n_blocks(self) -> int:
        """Blocks in which both are finite."""
        return len(self.sizes)

    @property
    def has_logarithms(self) -> NDArray[np.bool_]:
        """Whether both errors of a block are above zero, (B,)."""
        return np.asarray((self.first > 0).all(axis=0) & (self.second > 0).all(axis=0))

    def order(self) -> Contrast:
        """Mean over blocks and seeds of the logarithm of first / second.

        Blocks without any error of either have no logarithm and are left out.
        """
        positive = self.has_logarithms
        return _scaled(
            mean_contrast(
                np.log(self.first[:, positive]),
                np.log(self.second[:, positive]),
                has_paired_seeds=self.has_paired_seeds,
            ),
            self.exponent,
        )

    def size(self) -> Contrast:
        """Logarithm of the ratio of the pooled errors."""
        contrast = log_ratio_of_pooled(
            self.first, self.second, has_paired_seeds=self.has_paired_seeds
        )
        return _scaled(contrast, self.exponent)

    @property
    def is_testable(self) -> bool:
        """Whether there are blocks enough, with errors above zero, for an interval."""
        return int(self.has_logarithms.sum()) >= MIN_BLOCKS


@dataclass(frozen=True)
class Ordered:
    """The two statistics of an order, with what Holm's correction makes of the first."""

    order: Contrast
    size: Contrast
    p_value: float  # corrected
    level: float  # at which the order's own p-value is tested

    def is_significant(self, is_lower: bool) -> bool:
        """Whether the first is significantly lower (or higher), by the order and by the size."""
        sign = -1.0 if is_lower else 1.0
        return (
            self.order.p_value < self.level
            and sign * self.order.value > 0
            and sign * self.size.value > 0
        )


def exponent_of(metric: str) -> float:
    """1/2 for a root mean square, whose blocks hold squares; else 1."""
    return 0.5 if "rmse" in metric else 1.0


def paired_errors(first: BlockErrors, second: BlockErrors, metric: str, test_set: str) -> Pair:
    """Errors of two candidates in the blocks that both have samples in, and in which both are
    finite.

    Parameters
    ----------
    first, second
        On the same blocks, in any order.
    metric
        Of both.
    test_set
        What an error message names.

    Raises
    ------
    DataError
        The blocks are not the same, or not of the same size.
    """
    if set(first.blocks) != set(second.blocks):
        raise DataError(
            f"{test_set}: the two candidates have different blocks; write the same blocks"
        )
    second = second.of_blocks(first.blocks)
    if not np.allclose(first.sizes, second.sizes, rtol=1e-6):
        raise DataError(f"{test_set}: the two candidates' blocks have different sizes")
    scored = first.sizes > 0
    is_finite = [np.isfinite(side.sums).all(axis=0) for side in (first, second)]
    chosen = scored & is_finite[0] & is_finite[1]
    n_first, n_second = (
        int((~np.isfinite(side.sums[:, scored])).sum()) for side in (first, second)
    )
    return Pair(
        first.sums[:, chosen],
        second.sums[:, chosen],
        first.sizes[chosen],
        (n_first, n_second),
        exponent_of(metric),
    )


def value_of(errors: BlockErrors, metric: str) -> tuple[Contrast | None, Figure]:
    """An error pooled over blocks and seeds, and its logarithm for tests.

    Parameters
    ----------
    errors
        Of one candidate; blocks in which a seed is not finite are left out.
    metric
        Its name, which says whether the error is a root of pooled squares (`exponent_of`).

    Returns
    -------
    contrast : Contrast or None
        Logarithm of the error; None with too few blocks for an interval, or an error of 0.
    figure : Figure
        The error with its 95 % interval, in its unit.
    """
    chosen = np.isfinite(errors.sums).all(axis=0) & (errors.sizes > 0)
    sums = errors.sums[:, chosen]
    sizes = errors.sizes[chosen]
    if not len(sizes):
        return None, Figure(math.nan, math.nan, math.nan)
    value = float(sums.sum(axis=1).mean() / sizes.sum())
    exponent = exponent_of(metric)
    if len(sizes) < MIN_BLOCKS or not value > 0:
        error = value**exponent if value >= 0 else math.nan
        return None, Figure(error, math.nan, math.nan)
    contrast = _scaled(log_ratio_of_pooled(sums, sizes[None]), exponent)
    return contrast, _exponential(contrast)


def ratio_of(pair: Pair) -> Figure:
    """Ratio of the pooled errors with its 95 % interval; without one where there are too few
    blocks.
    """
    if pair.is_testable:
        return _exponential(pair.size())
    ratio = pair.first.mean(axis=0).sum() / pair.second.mean(axis=0).sum()
    return Figure(float(ratio) ** pair.exponent, math.nan, math.nan)


def judge_paper(
    paper: Paper, blocks: Mapping[Key, BlockErrors] | None, training: Mapping[str, Training]
) -> dict[str, Judgement]:
    """Verdicts on all claims; p-values of orders are corrected within families.

    Parameters
    ----------
    paper
        Its claims.
    blocks : mapping or None
        Errors by block and seed; None where the study has no blocks.csv.
    training
        Candidate -> how far it was trained.

    Returns
    -------
    dict
        id of the claim -> judgement.
    """
    ordered = _orders_of(paper, blocks or {})
    return {
        claim.id: _judge(claim, blocks, training, ordered.get(claim.id)) for claim in paper.claims
    }


def judge_row(
    row: Row,
    table: Table,
    blocks: Mapping[Key, BlockErrors] | None,
    training: Mapping[str, Training],
) -> Judgement:
    """A value of a table, as a claim that ours equals it within `DEFAULT_MARGIN`."""
    claim = Claim(
        "row",
        "",
        table.table,
        kind="equal",
        candidate=row.candidate,
        limit=row.published,
        part=table.part,
        test_set=table.test_set,
        metric=row.metric,
    )
    if blocks is None:
        return Judgement("not assessed", NOT_PUBLISHED, {})
    return _with_remarks(_judge_pooled(claim, blocks, with_baselines=False), claim, training)


def least_training(claim: Claim, training: Mapping[str, Training]) -> tuple[str, Training | None]:
    """The least trained of a claim's candidates; none where the claim names no candidate."""
    states = [
        (name, training.get(name, Training("", "", "not checked", "not in training.csv")))
        for name in claim.names
    ]
    if not states:
        return "", None
    return min(states, key=lambda entry: TRAINING_STATES.index(entry[1].state))


def _orders_of(paper: Paper, blocks: Mapping[Key, BlockErrors]) -> dict[str, Ordered]:
    """Statistics of all orders that can be tested, corrected by Holm within their families."""
    statistics: dict[str, tuple[Contrast, Contrast]] = {}
    families: dict[str, list[str]] = {}
    for claim in paper.claims:
        pair = _pair_of(claim, blocks) if claim.kind == "order" else None
        if pair is not None and pair.is_testable:
            statistics[claim.id] = pair.order(), pair.size()
            families.setdefault(claim.family or f"claim {claim.id}", []).append(claim.id)
    ordered = {}
    for ids in families.values():
        raw = [statistics[name][0].p_value for name in ids]
        for name, p_value, corrected in zip(ids, raw, holm(raw), strict=True):
            # where the smallest p-values of a family underflow, their ranks are unknown
            factor = corrected / p_value if p_value > 0 else float(len(ids))
            level = ALPHA / max(factor, 1.0) if corrected < 1.0 else ALPHA / len(ids)
            ordered[name] = Ordered(*statistics[name], corrected, level)
    return ordered


def keys_of(claim: Claim) -> list[Key]:
    """Keys of the errors of the candidates that a claim compares, the other in its own part."""
    parts = (claim.part, claim.other_part or claim.part)
    return [
        Key(part, name, claim.test_set, claim.metric)
        for part, name in zip(parts, claim.names, strict=False)
    ]


def _pair_of(claim: Claim, blocks: Mapping[Key, BlockErrors]) -> Pair | None:
    """Errors of a claim's two candidates; None where those of one are not published."""
    first, second = (blocks.get(key) for key in keys_of(claim))
    if first is None or second is None:
        return None
    pair = paired_errors(first, second, claim.metric, f"claim {claim.id!r}")
    return replace(pair, has_paired_seeds=claim.same_trainings and first.seeds == second.seeds)


def _judge(
    claim: Claim,
    blocks: Mapping[Key, BlockErrors] | None,
    training: Mapping[str, Training],
    ordered: Ordered | None,
) -> Judgement:
    if claim.not_testable is not None:
        return Judgement("not testable", claim.not_testable, {})
    if blocks is None:
        return Judgement("not assessed", NOT_PUBLISHED, {})
    if claim.kind == "measured":
        judgement = _judge_measured(claim, blocks)
    elif claim.kind == "order":
        judgement = _judge_order(claim, blocks, ordered)
    else:
        judgement = _judge_pooled(claim, blocks)
    return _with_remarks(judgement, claim, training)


def _with_remarks(
    judgement: Judgement, claim: Claim, training: Mapping[str, Training]
) -> Judgement:
    """A judgement with what its errors and trainings lack, which may withdraw its verdict."""
    judgement = _without_single_trainings(_with_divergence(judgement), claim, training)
    return _with_missing_trainings(judgement, claim, training)


def _with_missing_trainings(
    judgement: Judgement, claim: Claim, training: Mapping[str, Training]
) -> Judgement:
    """Names candidates of a claim that are not trained, or with fewer seeds than planned."""
    states = {name: training[name] for name in claim.names if name in training}
    if judgement.verdict == "not assessed":
        not_trained = [name for name, state in states.items() if state.state == "not trained"]
        if not not_trained:
            return judgement
        verb = "is" if len(not_trained) == 1 else "are"
        return replace(judgement, reason=f"{' and '.join(not_trained)} {verb} not trained")
    counts = judgement.n_seeds or {}
    fewer = [
        f"{name} with {counts[name]} of {state.seeds_planned} seeds"
        for name, state in states.items()
        if counts.get(name, state.seeds_planned) < state.seeds_planned
    ]
    return replace(judgement, reason="; ".join([judgement.reason, *fewer]))


def _with_divergence(judgement: Judgement) -> Judgement:
    """Adds to the reason which candidates diverged, and how often."""
    words = [
        f"; {name} diverged in {number} of the pairs of block and seed, left out here"
        for name, number in (judgement.diverged or {}).items()
        if number
    ]
    return replace(judgement, reason=judgement.reason + "".join(words))


def _without_single_trainings(
    judgement: Judgement, claim: Claim, training: Mapping[str, Training]
) -> Judgement:
    """A verdict that rests on one training of a candidate is withdrawn: other seeds may differ.

    With one seed the interval does not contain what another seed would change: of 1,000 simulated
    studies without any effect 7 to 14 % then had a significant one
    (results/scorecard/planted_truth.csv).
    """
    names = [
        name
        for name, number in zip(claim.names, (judgement.n_seeds or {}).values(), strict=False)
        if number == 1 and name in training and training[name].state != "not applicable"
    ]
    if not names:
        return judgement
    verdict = judgement.verdict
    if verdict in (*MET, "contradicted", "met by a trivial baseline"):
        verdict = "no significant difference" if claim.kind == "order" else "inconclusive"
    verb = "has" if len(names) == 1 else "have"
    words = f"{' and '.join(names)} {verb} one seed; at least two are needed"
    return replace(judgement, verdict=verdict, reason=f"{judgement.reason}; {words}")


def _not_assessed(claim: Claim, blocks: Mapping[Key, BlockErrors]) -> Judgement:
    missing = [key.candidate for key in keys_of(claim) if key not in blocks]
    reason = f"no per-block errors of {' and '.join(missing)} in this metric are published"
    return Judgement("not assessed", reason, {})


def _judge_order(
    claim: Claim, blocks: Mapping[Key, BlockErrors], ordered: Ordered | None
) -> Judgement:
    pair = _pair_of(claim, blocks)
    if pair is None:
        return _not_assessed(claim, blocks)
    judgement = _described(claim, pair, blocks)
    if ordered is None:
        reason = f"{number_of(pair.n_blocks, 'block')} with finite errors above zero: no test"
        return replace(judgement, verdict="no significant difference", reason=reason)
    verdict, reason = _verdict_of_order(claim, pair, ordered, blocks)
    judgement = replace(
        judgement,
        verdict=verdict,
        reason=reason,
        order=_exponential(ordered.order),
        size=_exponential(ordered.size),
        p_value=ordered.p_value,
    )
    if verdict == "no significant difference":
        return _with_power(judgement, claim, ordered)
    return judgement


def _verdict_of_order(
    claim: Claim, pair: Pair, ordered: Ordered, blocks: Mapping[Key, BlockErrors]
) -> tuple[Verdict, str]:
    """Verdict on an order whose statistics are there, and what decided."""
    expects_lower = claim.direction == "lower"
    if ordered.order.p_value >= ordered.level:
        return "no significant difference", f"p = {_short_p(ordered.p_value)}"
    if ordered.order.value * ordered.size.value <= 0:
        return (
            "no significant difference",
            "most blocks and the pooled errors favour different candidates",
        )
    is_lower = ordered.order.value < 0
    # where an estimator diverges its error is infinite, and so is that of all blocks pooled
    n_winner, n_loser = pair.n_diverged if is_lower else pair.n_diverged[::-1]
    if n_winner > n_loser:
        winner = claim.candidate if is_lower else claim.other
        return (
            "no significant difference",
            f"{winner} is better in the blocks that it survives, but diverges in more of them",
        )
    if is_lower != expects_lower:
        return "contradicted", "significant in the other direction"
    if baseline := _baseline_in_place(claim, ordered.level, blocks):
        return "met by a trivial baseline", f"{baseline} in its place would meet the claim too"
    return _verdict_of_size(claim, ordered.size)


def _verdict_of_size(claim: Claim, size: Contrast) -> tuple[Verdict, str]:
    """Of a claim that is met: whether the paper's size lies in the interval of ours."""
    ratio = claim.published_ratio
    if ratio is None:
        return "reproduced", "significant; the paper states no size"
    low, high = size.interval()
    if low <= math.log(ratio) <= high:
        return "reproduced", f"significant; the interval contains the paper's {ratio:.3g}"
    return "direction only", f"significant; the interval excludes the paper's {ratio:.3g}"


def _baseline_in_place(claim: Claim, level: float, blocks: Mapping[Key, BlockErrors]) -> str:
    """The baseline that is significantly lower too, in the candidate's place; empty if none is.

    A claim that the candidate's error is higher is on a weakness of it, which a baseline with a
    lower error confirms.
    """
    if claim.direction == "higher":
        return ""
    key, key_of_other = keys_of(claim)
    for name in BASELINES:
        errors = blocks.get(Key(key.part, name, key.test_set, key.metric))
        if name in claim.names or errors is None:
            continue
        subject = f"claim {claim.id!r}, baseline {name}"
        pair = paired_errors(errors, blocks[key_of_other], claim.metric, subject)
        if pair.n_diverged[0] == 0 and pair.is_testable:
            statistics = Ordered(pair.order(), pair.size(), math.nan, level)
            if statistics.is_significant(is_lower=True):
                return name
    return ""


def _with_power(judgement: Judgement, claim: Claim, ordered: Ordered) -> Judgement:
    """Power of the order's test to detect the paper's size, and the blocks that 80 % would need."""
    ratio = claim.published_ratio
    if ratio is None or ratio == 1.0:
        return replace(
            judgement, reason=judgement.reason + "; the paper states no size to be detected"
        )
    effect = math.log(ratio)
    power = ordered.order.power(effect, ordered.level)
    reason = f"{judgement.reason}; power {100 * power:.0f} % to detect the paper's {ratio:.3g}"
    judgement = replace(judgement, power=power, reason=reason)
    if power >= TARGET_POWER:
        return judgement
    return _with_blocks_needed(
        judgement, ordered.order.blocks_needed(effect, TARGET_POWER, ordered.level)
    )


def _judge_pooled(
    claim: Claim, blocks: Mapping[Key, BlockErrors], *, with_baselines: bool = True
) -> Judgement:
    """Limits and equalities, of an error or of the ratio of two."""
    assert claim.candidate is not None
    if claim.other is not None:
        pair = _pair_of(claim, blocks)
        if pair is None:
            return _not_assessed(claim, blocks)
        judgement = _described(claim, pair, blocks)
        contrast = pair.size() if pair.is_testable else None
        size = _exponential(contrast) if contrast else None
        order = _exponential(pair.order()) if contrast else None
        judgement = replace(judgement, size=size, order=order)
    else:
        errors = blocks.get(keys_of(claim)[0])
        if errors is None:
            return _not_assessed(claim, blocks)
        contrast, figure = value_of(errors, claim.metric)
        judgement = _described_single(claim, errors, figure)
    if contrast is None:
        reason = (
            f"{number_of(judgement.n_blocks, 'block')} with finite errors above zero: no interval"
        )
        return replace(judgement, verdict="inconclusive", reason=reason)
    verdict, reason = _verdict_of_range(claim, contrast)
    if verdict in MET and with_baselines:
        for name in BASELINES:
            if name not in claim.names and _is_met_by(name, claim, blocks):
                reason = f"{name} in its place would meet the claim too"
                verdict = "met by a trivial baseline"
                break
    return _with_needed_blocks(replace(judgement, verdict=verdict, reason=reason), claim, contrast)


def _verdict_of_range(claim: Claim, contrast: Contrast) -> tuple[Verdict, str]:
    """Verdict on a logarithm that is claimed to lie in a range."""
    low, high = _log_range(claim)
    is_equality = claim.direction is None
    confidence = EQUALITY_CONFIDENCE if is_equality else CONFIDENCE
    begin, end = contrast.interval(confidence)
    words = f"{100 * confidence:.0f} % interval"
    if low <= begin and end <= high:
        if is_equality:
            return "reproduced", f"{words} within the margin"
        if claim.ratio is None or claim.ratio == claim.limit:
            return "reproduced", f"{words} on the claimed side"
        return _verdict_of_size(claim, contrast)
    if end < low or begin > high:
        side = "outside the margin" if is_equality else "on the other side of the limit"
        return "contradicted", f"{words} wholly {side}"
    return "inconclusive", f"{words} contains {'a margin' if is_equality else 'the limit'}"


def _log_range(claim: Claim) -> tuple[float, float]:
    """Logarithms of the ends of the claimed range."""
    if claim.direction is not None:
        assert claim.limit is not None
        return _one_sided(claim, math.log(claim.limit))
    margin = claim.margin if claim.margin is not None else DEFAULT_MARGIN
    middle = math.log(claim.limit) if claim.limit is not None else 0.0
    return middle + math.log1p(-margin), middle + math.log1p(margin)


def _one_sided(claim: Claim, edge: float) -> tuple[float, float]:
    """Ends of the range on the claimed side of an edge."""
    return (-math.inf, edge) if claim.direction == "lower" else (edge, math.inf)


def _is_met_by(name: str, claim: Claim, blocks: Mapping[Key, BlockErrors]) -> bool:
    """Whether a baseline in the candidate's place meets a limit or an equality."""
    swapped = replace(claim, candidate=name)
    errors = blocks.get(keys_of(swapped)[0])
    if errors is None or not np.isfinite(errors.sums).all():
        return False
    if claim.other is not None:
        pair = _pair_of(swapped, blocks)
        contrast = pair.size() if pair is not None and pair.is_testable else None
    else:
        contrast, _ = value_of(errors, claim.metric)
    return contrast is not None and _verdict_of_range(swapped, contrast)[0] in MET


def _with_needed_blocks(judgement: Judgement, claim: Claim, contrast: Contrast) -> Judgement:
    """Of what is inconclusive, the blocks with which it would be decided in four of five cases, if
    our value is the true one.
    """
    if judgement.verdict != "inconclusive":
        return judgement
    low, high = _log_range(claim)
    distance = min(abs(contrast.value - edge) for edge in (low, high) if math.isfinite(edge))
    level = ALPHA if claim.direction is not None else 1.0 - EQUALITY_CONFIDENCE
    blocks_needed = contrast.blocks_needed(distance, TARGET_POWER, level) if distance > 0 else None
    return _with_blocks_needed(judgement, blocks_needed)


@dataclass(frozen=True)
class Measured:
    """What a special measurement gave, over blocks and seeds."""

    contrast: Contrast | None  # of logarithms where ratios are averaged; None: too few blocks
    is_ratio: bool
    figure: Figure
    n_blocks: int
    n_seeds: int
    n_diverged: int


def _measure(claim: Claim, errors: BlockErrors) -> Measured:
    """Mean over blocks and seeds of a claim's measured values; a geometric one where ``other``
    makes them ratios.

    Of values with a single block the seeds take the place of blocks.
    """
    assert claim.limit is not None
    scored = errors.sizes > 0
    values = errors.sums[:, scored] / errors.sizes[scored]
    n_diverged = int((~np.isfinite(values)).sum())
    values = values[:, _finite_columns(values)]
    n_seeds, n_blocks = values.shape
    is_ratio = claim.other is not None and claim.limit > 0 and bool((values > 0).all())
    # what is measured of the trained weights alone has one block: its trainings are what varies
    units = values.T if n_blocks == 1 else values
    if units.shape[1] < MIN_BLOCKS:
        mean = float(values.mean()) if values.size else math.nan
        figure = Figure(mean, math.nan, math.nan)
        return Measured(None, is_ratio, figure, n_blocks, n_seeds, n_diverged)
    contrast = mean_contrast(np.log(units) if is_ratio else units)
    figure = Figure(contrast.value, *contrast.interval())
    if is_ratio:
        figure = _exponential(contrast)
    return Measured(contrast, is_ratio, figure, n_blocks, n_seeds, n_diverged)


def _judge_measured(claim: Claim, blocks: Mapping[Key, BlockErrors]) -> Judgement:
    """A special measurement, one value for each block and seed, against its limit.

    Its rows in blocks.csv have the claim's id as metric.
    """
    rows = {
        key.candidate: errors
        for key, errors in blocks.items()
        if (key.part, key.test_set, key.metric) == (claim.part, claim.test_set, claim.id)
    }
    errors_of_claim = next((errors for name, errors in rows.items() if name not in BASELINES), None)
    if errors_of_claim is None:
        return Judgement("not assessed", "the measured values are not published yet", {})
    measured = _measure(claim, errors_of_claim)
    name = claim.candidate or "measured"
    judgement = Judgement(
        "inconclusive",
        f"{number_of(measured.n_blocks, 'block')} with finite values: no interval",
        {name: measured.figure},
        n_blocks=measured.n_blocks,
        n_seeds={name: measured.n_seeds},
        diverged={name: measured.n_diverged},
    )
    if measured.contrast is None:
        return judgement
    verdict, reason = _verdict_of_measured(claim, measured.contrast, measured.is_ratio)
    if verdict in MET:
        for baseline in BASELINES:
            trivial = _measure(claim, rows[baseline]) if baseline in rows else None
            if trivial is None or trivial.contrast is None or baseline == claim.candidate:
                continue
            met, _ = _verdict_of_measured(claim, trivial.contrast, trivial.is_ratio)
            if met in MET:
                verdict = "met by a trivial baseline"
                reason = f"{baseline} in its place would meet the claim too"
                break
    return replace(judgement, verdict=verdict, reason=reason)


def _verdict_of_measured(claim: Claim, contrast: Contrast, is_ratio: bool) -> tuple[Verdict, str]:
    if is_ratio:
        return _verdict_of_range(claim, contrast)
    assert claim.limit is not None
    is_equality = claim.direction is None
    low, high = contrast.interval(EQUALITY_CONFIDENCE if is_equality else CONFIDENCE)
    begin, end = _one_sided(claim, claim.limit)
    if is_equality:
        half = abs(claim.limit) * (claim.margin or DEFAULT_MARGIN)
        begin = claim.limit - half
        end = claim.limit + half
    if contrast.error == 0 and contrast.value == claim.limit and not is_equality:
        return "contradicted", "exactly the limit in every block"
    if begin <= low and high <= end:
        if claim.ratio is not None and not low <= claim.ratio <= high:
            return (
                "direction only",
                f"on the claimed side; the interval excludes the paper's {claim.ratio:.3g}",
            )
        return "reproduced", "interval within the claimed range"
    if high < begin or low > end:
        return "contradicted", "interval wholly outside the claimed range"
    return "inconclusive", "interval contains a limit of the claimed range"


def _described(claim: Claim, pair: Pair, blocks: Mapping[Key, BlockErrors]) -> Judgement:
    """Values, counts and divergence of a claim on two candidates, without a verdict yet."""
    keys = keys_of(claim)
    labels = list(claim.names)
    if labels[0] == labels[1]:
        labels = [f"{key.candidate} ({key.part})" for key in keys]
    sides = {label: blocks[key] for label, key in zip(labels, keys, strict=True)}
    return Judgement(
        "inconclusive",
        "",
        {label: value_of(side, claim.metric)[1] for label, side in sides.items()},
        n_blocks=pair.n_blocks,
        n_seeds={label: len(side.seeds) for label, side in sides.items()},
        diverged=dict(zip(labels, pair.n_diverged, strict=True)),
    )


def _described_single(claim: Claim, errors: BlockErrors, figure: Figure) -> Judgement:
    assert claim.candidate is not None
    scored = errors.sizes > 0
    return Judgement(
        "inconclusive",
        "",
        {claim.candidate: figure},
        n_blocks=int((_finite_columns(errors.sums) & scored).sum()),
        n_seeds={claim.candidate: len(errors.seeds)},
        diverged={claim.candidate: int((~np.isfinite(errors.sums[:, scored])).sum())},
    )


def _finite_columns(values: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(values).all(axis=0))


def _scaled(contrast: Contrast, factor: float) -> Contrast:
    parts = tuple((factor**2 * variance, free) for variance, free in contrast.parts)
    return Contrast(factor * contrast.value, parts, contrast.n_blocks)


def _exponential(contrast: Contrast) -> Figure:
    """A logarithm with its 95 % interval as a ratio or an error."""
    low, high = contrast.interval()
    return Figure(math.exp(contrast.value), math.exp(low), math.exp(high))


def _with_blocks_needed(judgement: Judgement, number: int | None) -> Judgement:
    """A judgement with the number of blocks that 80 % would need; None where none is enough."""
    needed = (
        "no number of blocks reaches 80 %: more seeds are needed"
        if number is None
        else f"{number_of(number, 'block')} needed for 80 %"
    )
    return replace(judgement, blocks_needed=number, reason=f"{judgement.reason}; {needed}")


def _short_p(p_value: float) -> str:
    return f"{p_value:.2g}" if p_value >= 0.001 else "below 0.001"
