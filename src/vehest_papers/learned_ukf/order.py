"""Whether the order of a table of the paper is found again: paired differences and how sure they are."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.report.document import Column, Table
from vehest.report.style import fixed
from vehest_papers.kit.paired import paired_difference

AS_IN_THE_PAPER = "as in the paper"
TURNED = "the other way round"
UNDECIDED = "undecided"
LEVEL = "level in the paper, not told apart here"
APART = "level in the paper, told apart here"
DECIMALS = 4


def differences(
    losses: Mapping[str, FloatArray],
    sequence: NDArray[np.int64],
    published: Mapping[str, float],
    rate_hz: float,
) -> pd.DataFrame:
    """Every pair of candidates, the one with the lower mean loss in the paper first; of equal ones the first of `losses`.

    Args:
        losses: candidate -> loss of each seed at each sample, (S, K).
        sequence: of each sample, (K,); whole sequences are resampled.
        published: candidate -> mean loss in the paper; candidates that it does not have are left out.
        rate_hz: of the samples.

    Returns:
        Columns: first, second, neighbours (no third value of the paper lies between), paper (difference of mean losses),
        mean, low, high, p_value (of means over seeds), median, median_low, median_high (of medians over seeds), verdict.

    Raises:
        DataError: there are fewer than two sequences, or a loss is not finite.
    """
    order = sorted((name for name in losses if name in published), key=published.__getitem__)
    places = {
        value: place for place, value in enumerate(sorted({published[name] for name in order}))
    }
    rows = []
    for first, second in itertools.combinations(order, 2):
        own = paired_difference(losses[first], losses[second], sequence, rate_hz=rate_hz)
        verdict = (
            AS_IN_THE_PAPER if own.mean.high < 0 else TURNED if own.mean.low > 0 else UNDECIDED
        )
        if published[first] == published[second]:
            verdict = LEVEL if own.mean.low <= 0.0 <= own.mean.high else APART
        rows.append(
            {
                "first": first,
                "second": second,
                "neighbours": places[published[second]] == places[published[first]] + 1,
                "paper": published[first] - published[second],
                **{
                    "mean": own.mean.value,
                    "low": own.mean.low,
                    "high": own.mean.high,
                    "p_value": own.mean.p_value,
                },
                **{
                    "median": own.median.value,
                    "median_low": own.median.low,
                    "median_high": own.median.high,
                },
                "verdict": verdict,
            }
        )
    return pd.DataFrame(rows)


def pairs_table(pairs: pd.DataFrame, name: str, caption: str) -> Table:
    """Pairs of `differences`, in words."""
    own = pairs.copy()
    for kind, low, high in (("mean", "low", "high"), ("median", "median_low", "median_high")):
        own[f"{kind}_in_words"] = [
            f"{fixed(row[kind], DECIMALS)} [{fixed(row[low], DECIMALS)}, {fixed(row[high], DECIMALS)}]"
            for row in own.to_dict("records")
        ]
    columns = {
        "first": Column("lower in the paper"),
        "second": Column("higher"),
        "paper": Column("difference, paper", decimals=DECIMALS),
        "mean_in_words": Column("difference of means over seeds [95 % interval]"),
        "median_in_words": Column("of medians over seeds [95 % interval]"),
        "verdict": Column("here"),
    }
    return Table(name, caption, own.drop(columns="neighbours"), columns)


def order_in_words(pairs: pd.DataFrame, medians: Mapping[str, float], where: str) -> str:
    """How many pairs are as in the paper, which are the other way round, and which of its neighbours cannot be told apart."""
    ours = sorted(medians, key=medians.__getitem__)
    shown = ", ".join(f"{name} ({fixed(medians[name], DECIMALS)})" for name in ours)
    words = f"Order {where} by the median of seeds, best first: {shown}."
    if pairs.empty:
        return words
    counts = {
        verdict: int((pairs["verdict"] == verdict).sum())
        for verdict in (AS_IN_THE_PAPER, TURNED, UNDECIDED)
    }
    words += (
        f" Of {sum(counts.values())} pairs that the paper ranks, the 95 % interval of the difference has {counts[AS_IN_THE_PAPER]} in its "
        f"order, {counts[TURNED]} the other way round, and includes zero for {counts[UNDECIDED]}."
    )
    level = [
        f"{row['first']} and {row['second']}"
        for row in pairs[pairs["verdict"].isin((LEVEL, APART))].to_dict("records")
    ]
    if level:
        apart = [
            f"{row['first']} and {row['second']}"
            for row in pairs[pairs["verdict"] == APART].to_dict("records")
        ]
        words += f" Level in the paper: {'; '.join(level)}; told apart here: {'; '.join(apart) or 'none'}."
    turned = [
        f"{row['second']} before {row['first']}"
        for row in pairs[pairs["verdict"] == TURNED].to_dict("records")
    ]
    if turned:
        words += f" The other way round: {'; '.join(turned)}."
    open_pairs = pairs[pairs["neighbours"] & (pairs["verdict"] == UNDECIDED)].to_dict("records")
    if open_pairs:
        named = "; ".join(f"{row['first']} and {row['second']}" for row in open_pairs)
        words += f" Neighbours in the paper that these tests do not tell apart: {named}."
    return words + " Each interval stands by itself; none is widened for the number of pairs."
