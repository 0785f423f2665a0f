"""How often the interval of a coverage contains 0.90 if calibration and test are exchangeable.

A band of few manoeuvres covers 90 % on average, but seldom on a single test: mostly more, at times
much less. How often an interval over the few manoeuvres of the test then contains 0.90 depends on
their number. Manoeuvres of calibration and test are shuffled here, many times, with the numbers
unchanged, which makes both exchangeable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.store import read_recording
from vehest.evaluation.bands import proportion_interval
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.runs import by_name
from vehest.trust.bands import CHANNEL_LEVEL, block_labels, pooled_quantile
from vehest_papers.trust.band_tables import TRAINED, contains_level

DRAWS = 100
MIN_MANOEUVRES = 3
"""Of calibration and test, for an interval."""
TOGETHER_COLUMNS = [
    "drive",
    "estimator_title",
    "tests",
    "manoeuvres",
    "coverage",
    "low",
    "high",
    "contained",
]


@dataclass(frozen=True)
class Scores:
    """Errors of β over the half width of the 90 % band, of all samples of several ranges."""

    values: FloatArray  # (N,), 1 where an error equals the half width
    manoeuvres: NDArray[np.int64]  # manoeuvre of each sample, (N,), counted from 0

    @property
    def n_manoeuvres(self) -> int:
        """Number of manoeuvres."""
        return int(self.manoeuvres.max(initial=-1)) + 1


def scores_of(part: PartArtefacts, model: EvaluatedModel, test_set: str) -> Scores | None:
    """Scores of a model on a test set, or on ``validation``; none without bands.

    Manoeuvres are those that bands are calibrated by.
    """
    spans = part.split.validation if test_set == "validation" else part.split.tests[test_set]
    parts = part.scored(model, test_set)
    yaw_rates: list[FloatArray | None] = [None] * len(parts)
    values = []
    for position, scored in enumerate(parts):
        if "sideslip" not in scored.bands:
            return None
        error = np.remainder(scored.sideslip - scored.sideslip_ref + np.pi, 2.0 * np.pi) - np.pi
        values.append(np.abs(error) / scored.bands["sideslip"])
        if len(parts) == len(spans):  # else each sequence of a range is a manoeuvre
            reference = read_recording(
                part.references[spans[position].dataset, spans[position].recording]
            )
            yaw_rates[position] = (
                np.interp(scored.time, reference.time, reference["yaw_rate"])
                if "yaw_rate" in reference
                else None
            )
    rate_hz = part.protocol.rate_hz
    labels, _ = block_labels(yaw_rates, [len(part) for part in values], rate_hz)
    joined = np.concatenate(values)
    is_finite = np.isfinite(joined)
    if not is_finite.any():
        return None
    manoeuvres = np.unique(np.concatenate(labels)[is_finite], return_inverse=True)[1]
    return Scores(joined[is_finite], manoeuvres)


def covers_level(inside: NDArray[np.bool_], manoeuvres: NDArray[np.int64]) -> bool:
    """Whether 0.90 lies in the 95 % interval of a share, by manoeuvres counted from 0, (N,)."""
    low, high = _interval(inside, manoeuvres)
    return low <= CHANNEL_LEVEL <= high


def share_if_shuffled(
    calibration: Scores, test: Scores, draws: int = DRAWS, seed: int = 0
) -> float:
    """Share of draws in which the interval of the test contains 0.90, with shuffled manoeuvres.

    In each draw the manoeuvres of both are dealt anew, as many to the calibration as it has. The
    factor of the band is their `pooled_quantile`, and the coverage of the others is tested.

    Parameters
    ----------
    calibration, test
        Errors over half widths on the range that bands are calibrated on, and on the test.
    draws, seed
        Number of draws, and seed of their random numbers.

    Returns
    -------
    float
        NaN with fewer than `MIN_MANOEUVRES` on either side.
    """
    if min(calibration.n_manoeuvres, test.n_manoeuvres) < MIN_MANOEUVRES:
        return float("nan")
    generator = np.random.default_rng(seed)
    values = np.concatenate([calibration.values, test.values])
    labels = np.concatenate([calibration.manoeuvres, test.manoeuvres + calibration.n_manoeuvres])
    n_contained = 0
    for _ in range(draws):
        order = generator.permutation(calibration.n_manoeuvres + test.n_manoeuvres)
        calibrates = (order < calibration.n_manoeuvres)[labels]
        factor, _ = pooled_quantile(values[calibrates], labels[calibrates], CHANNEL_LEVEL)
        manoeuvres = np.unique(labels[~calibrates], return_inverse=True)[1]
        n_contained += covers_level(values[~calibrates] <= factor, manoeuvres)
    return n_contained / draws


def together(tests: Sequence[Scores]) -> tuple[float, float, float]:
    """Coverage over several test sets, each with its model and band, and its 95 % interval."""
    inside = np.concatenate([scores.values <= 1.0 for scores in tests])
    starts = np.cumsum([0, *(scores.n_manoeuvres for scores in tests)])
    manoeuvres = np.concatenate(
        [scores.manoeuvres + start for scores, start in zip(tests, starts[:-1], strict=True)]
    )
    low, high = _interval(inside, manoeuvres)
    return float(inside.mean()), low, high


def _interval(inside: NDArray[np.bool_], manoeuvres: NDArray[np.int64]) -> tuple[float, float]:
    sizes = np.bincount(manoeuvres).astype(np.float64)
    hits = np.asarray(np.bincount(manoeuvres, weights=inside.astype(np.float64)), dtype=np.float64)
    return proportion_interval(hits, sizes)


def scores_of_rows(parts: Mapping[str, PartArtefacts], board: pd.DataFrame) -> list[Scores | None]:
    """Scores of each row of the board; none on cars that bands were not calibrated on."""
    return [
        scores_of(parts[row["part"]], _model_of(parts[row["part"]], row), row["test_set"])
        if row["car"] == TRAINED
        else None
        for _, row in board.iterrows()
    ]


def _model_of(part: PartArtefacts, row: pd.Series) -> EvaluatedModel:
    return by_name(part.models)[row["estimator"], row["variant"]][0]


def shares_if_shuffled(
    parts: Mapping[str, PartArtefacts], board: pd.DataFrame, scores: Sequence[Scores | None]
) -> list[float]:
    """`share_if_shuffled` of each row of the board [%]; NaN on other cars."""
    shares = []
    for (_, row), test in zip(board.iterrows(), scores, strict=True):
        share = math.nan
        if test is not None:
            part = parts[row["part"]]
            calibration = scores_of(part, _model_of(part, row), "validation")
            if calibration is not None:
                share = 100 * share_if_shuffled(calibration, test)
        shares.append(share)
    return shares


def coverage_over_parts(board: pd.DataFrame, scores: Sequence[Scores | None]) -> pd.DataFrame:
    """Coverage over all parts that test on the same drive, each with its model and band.

    Parts of a drive have titles such as ``Real Ferrari, lap 1``.
    """
    rows = []
    drives = [title.rpartition(", ")[0] or title for title in board["title"]]
    board = board.reset_index(drop=True)
    for (drive, title), group in board.groupby([drives, "estimator_title"], sort=False):
        tests = [test for test in (scores[row] for row in group.index) if test is not None]
        if len(tests) < 2 or group["part"].nunique() < len(group):
            continue
        coverage, low, high = together(tests)
        n_manoeuvres = sum(test.n_manoeuvres for test in tests)
        contained = contains_level(low, high)
        rows.append((drive, title, len(tests), n_manoeuvres, coverage, low, high, contained))
    return pd.DataFrame(rows, columns=TOGETHER_COLUMNS)
