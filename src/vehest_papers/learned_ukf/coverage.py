"""How much of the errors the filters' bands cover, with and without a likelihood term in their
training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.evaluation.metrics import COVERAGE, Scored, weighted_errors
from vehest.report.document import Column, Table
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.kit.block_errors import BlockErrors
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import Figure, value_of
from vehest_papers.learned_ukf.candidates import SETS, scored_of


def coverage_table(
    trained: Mapping[str, tuple[PartArtefacts, list[EvaluatedModel]]],
    candidate: str,
    name: str,
    data: str,
) -> Table:
    """A row a tyre and training: weighted MSE, and the share of vy's errors within one and two
    deviations, with 95 % intervals.
    """
    rows: list[dict[str, object]] = []
    for test, tyre in SETS.items():
        for words, (part, models) in trained.items():
            scored = [scored_of(part, model, test) for model in models]
            row: dict[str, object] = {
                "tyre": tyre,
                "training": words,
                "mse_words": figure_in_words(
                    _mean(
                        [
                            [weighted_errors(piece, np.square) for piece in of_seed]
                            for of_seed in scored
                        ]
                    )
                ),
            }
            for sigma, expected in COVERAGE.items():
                share = _mean([[_within(piece, sigma) for piece in of_seed] for of_seed in scored])
                row |= {
                    f"inside_{sigma}": share.value,
                    f"words_{sigma}": figure_in_words(share),
                    f"expected_{sigma}": expected,
                }
            row["width"] = float(
                np.mean(
                    [np.sqrt(_variance(piece)).mean() for of_seed in scored for piece in of_seed]
                )
            )
            rows.append(row)
    columns = {
        "tyre": Column("tyre"),
        "training": Column("training"),
        "mse_words": Column("MSE (weighted)"),
        **{
            f"words_{sigma}": Column(f"within {sigma}σ (Gaussian: {expected:.3f})")
            for sigma, expected in COVERAGE.items()
        },
        "width": Column("mean σ of vy [m/s]", decimals=3),
    }
    caption = (
        f"Bands of {candidate}: share of vy's errors within the filter's own deviations, 95 % "
        "intervals over sequences and seeds. Likelihood: a second term in the loss of the "
        f"training through the filter, not in the paper. Data: {data}."
    )
    return Table(f"coverage_{name}", caption, pd.DataFrame(rows), columns)


def _mean(values: Sequence[Sequence[FloatArray]]) -> Figure:
    """Mean of values by seed, sequence and sample, with its interval over sequences and seeds."""
    sums = np.array([[sequence.sum() for sequence in seed] for seed in values])
    sizes = np.array([float(len(sequence)) for sequence in values[0]])
    names = [tuple(str(number) for number in range(count)) for count in sums.shape]
    return value_of(BlockErrors(names[0], names[1], sums, sizes), "mean")[1]


def _variance(piece: Scored) -> np.ndarray:
    assert piece.covariance is not None
    place = piece.covariance_of.index("vy")
    return np.maximum(piece.covariance[:, place, place], 0.0)


def _within(piece: Scored, sigma: float) -> np.ndarray:
    return (np.square(piece.errors["vy"]) <= sigma**2 * _variance(piece)).astype(np.float64)
