"""Whether the order of a table of the paper is found again: paired differences and how sure they are."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehest.data.recording import FloatArray
from vehest.evaluation.significance import paired_difference
from vehest.report.document import Column, Table
from vehest.report.style import fixed
from vehest.studies.learned_ukf.paper import Published

AS_IN_THE_PAPER, TURNED, UNDECIDED = "as in the paper", "the other way round", "undecided"


def differences(
    losses: Mapping[str, FloatArray], sequence: NDArray[np.int64], published: Mapping[str, Published], rate_hz: float
) -> pd.DataFrame:
    """Every pair of candidates, the one with the lower MSE in the paper first.

    Args:
        losses: candidate -> loss of each seed at each sample, (S, K).
        sequence: of each sample, (K,); whole sequences are resampled.
        published: the paper's table; candidates that it does not have are left out.
        rate_hz: of the samples.

    Returns:
        Columns: first, second, neighbours (in the paper's order), paper (difference of MSE), mean, low, high, p_value (of means over
        seeds), median, median_low, median_high (of medians over seeds), verdict.

    Raises:
        DataError: there are fewer than two sequences, or a loss is not finite.
    """
    order = sorted((name for name in losses if name in published), key=lambda name: published[name].mse)
    rows = []
    for (place, first), (other, second) in itertools.combinations(enumerate(order), 2):
        own = paired_difference(losses[first], losses[second], sequence, rate_hz=rate_hz)
        verdict = AS_IN_THE_PAPER if own.mean.high < 0 else TURNED if own.mean.low > 0 else UNDECIDED
        rows.append(
            {
                "first": first,
                "second": second,
                "neighbours": other == place + 1,
                "paper": published[first].mse - published[second].mse,
                **{"mean": own.mean.value, "low": own.mean.low, "high": own.mean.high, "p_value": own.mean.p_value},
                **{"median": own.median.value, "median_low": own.median.low, "median_high": own.median.high},
                "verdict": verdict,
            }
        )
    return pd.DataFrame(rows)


def neighbours(pairs: pd.DataFrame, name: str, caption: str) -> Table:
    """The pairs that stand beside each other in the paper's order."""
    own = pairs[pairs["neighbours"]].copy()
    for kind, low, high in (("mean", "low", "high"), ("median", "median_low", "median_high")):
        own[f"{kind}_in_words"] = [f"{fixed(row[kind], 4)} [{fixed(row[low], 4)}, {fixed(row[high], 4)}]" for row in own.to_dict("records")]
    columns = {
        "first": Column("lower MSE in the paper"),
        "second": Column("the next"),
        "paper": Column("difference, paper", decimals=4),
        "mean_in_words": Column("difference of means over seeds [95 % interval]"),
        "median_in_words": Column("of medians over seeds [95 % interval]"),
        "verdict": Column("here"),
    }
    return Table(name, caption, own.drop(columns="neighbours"), columns)


def order_in_words(pairs: pd.DataFrame, medians: Mapping[str, float], tyre: str) -> str:
    """How many pairs are as in the paper, which are the other way round, and which of its neighbours cannot be told apart.

    Args:
        pairs: from `differences`.
        medians: candidate -> median over seeds of its MSE, of all that are compared.
        tyre: for people.
    """
    ours = sorted(medians, key=medians.__getitem__)
    words = f"Order on {tyre} by the median of seeds, best first: {', '.join(f'{name} ({fixed(medians[name], 4)})' for name in ours)}."
    if pairs.empty:
        return words
    counts = {verdict: int((pairs["verdict"] == verdict).sum()) for verdict in (AS_IN_THE_PAPER, TURNED, UNDECIDED)}
    words += (
        f" Of {len(pairs)} pairs that the paper ranks, the 95 % interval of the difference has {counts[AS_IN_THE_PAPER]} in its order, "
        f"{counts[TURNED]} the other way round, and includes zero for {counts[UNDECIDED]}."
    )
    turned = [f"{row['second']} before {row['first']}" for row in pairs[pairs["verdict"] == TURNED].to_dict("records")]
    if turned:
        words += f" The other way round: {'; '.join(turned)}."
    open_pairs = pairs[pairs["neighbours"] & (pairs["verdict"] == UNDECIDED)].to_dict("records")
    if open_pairs:
        named = "; ".join(f"{row['first']} and {row['second']}" for row in open_pairs)
        words += f" Neighbours in the paper that these tests do not tell apart: {named}."
    return words + " Each interval stands by itself; none is widened for the number of pairs."
