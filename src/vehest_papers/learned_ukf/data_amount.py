"""How the error of NNTF_UH falls with the minutes of training data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd
from scipy import stats

from vehest.report.document import Column, Table
from vehest.report.style import significant
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.kit.block_errors import BlockErrors, Key
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import Figure
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.appendix import minutes
from vehest_papers.learned_ukf.block_errors import candidate_name
from vehest_papers.learned_ukf.candidates import SETS

METRIC = "mse_weighted"
MIN_AMOUNTS = 3  # of training data, from which on errors are extrapolated


def data_table(
    parts: Mapping[str, PartArtefacts], blocks: Mapping[Key, BlockErrors], data: str
) -> Table:
    """A row a training: minutes it learnt from, and weighted MSE on both tyres; below them, from
    three amounts of data on, the MSE extrapolated to the paper's minutes.

    Parameters
    ----------
    parts
        Name -> part, the one with all training data among them.
    blocks
        Errors by sequence and seed.
    data
        What the recordings are, in words.
    """
    rows = sorted(_trainings(parts, blocks), key=lambda row: row["minutes"])
    frame = pd.DataFrame(rows)
    at = paper.MINUTES_LEARNT
    shown: list[dict[str, object]] = [
        {"minutes": row["minutes"], "seed": str(row["seed"])}
        | {test: significant(row[test]) for test in SETS}
        for row in rows
    ]
    caption = (
        f"{paper.NNTF_UH} trained on parts of the training data, with as many steps on each. "
        f"The paper has {paper.published('tyre_a', paper.NNTF_UH, 'mse_weighted'):g} on tyre A "
        f"with {at:.1f} min. Data: {data}."
    )
    if frame["minutes"].nunique() >= MIN_AMOUNTS:
        amounts = np.asarray(frame["minutes"])
        shown.append(
            {"minutes": at, "seed": "extrapolated"}
            | {
                test: figure_in_words(extrapolated(amounts, np.asarray(frame[test]), at))
                for test in SETS
            }
        )
        caption += (
            " Extrapolated: a straight line through the logarithms of minutes and MSE of the "
            "trainings, with its 95 % interval."
        )
    columns = {
        "minutes": Column("training data [min]", decimals=1),
        "seed": Column("seed"),
        **{test: Column(f"MSE (weighted), {tyre}") for test, tyre in SETS.items()},
    }
    return Table("minutes_of_data", caption, pd.DataFrame(shown), columns)


def _trainings(
    parts: Mapping[str, PartArtefacts], blocks: Mapping[Key, BlockErrors]
) -> Iterator[dict[str, float]]:
    """Minutes, seed and MSE on each tyre of every training."""
    for name, part in parts.items():
        candidate = candidate_name(name, paper.NNTF_UH)
        errors = {test: blocks[Key(name, candidate, test, METRIC)] for test in SETS}
        for place, seed in enumerate(next(iter(errors.values())).seeds):
            yield {"minutes": minutes(part, part.split.train), "seed": int(seed)} | {
                test: of_test.sums[place].sum() / of_test.sizes.sum()
                for test, of_test in errors.items()
            }


def extrapolated(x: np.ndarray, y: np.ndarray, at: float) -> Figure:
    """Value of the power law y = a x^b at another x, with the 95 % interval of the fitted line.

    Least squares of ln y on ln x; Student's t with n - 2 degrees of freedom.

    Parameters
    ----------
    x, y
        Positive, (n,), n at least 3, x not all alike.
    at
        Where the law is read.
    """
    line = stats.linregress(np.log(x / at), np.log(y))  # its intercept is ln y at ``at``
    half = float(stats.t.ppf(0.975, len(x) - 2)) * line.intercept_stderr
    return Figure(*(math.exp(line.intercept + shift) for shift in (0.0, -half, half)))
