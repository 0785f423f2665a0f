"""What a count of intervals that hold 90 % could come to at best, with as many manoeuvres as there are.

A band of few manoeuvres holds 90 % on average, but seldom just that: mostly more, at times much less. How often an interval over the test's
few manoeuvres then has 0.90 in it is a matter of their number, even if test and calibration are alike in everything. Manoeuvres of both
are shuffled here, many times, with the numbers kept: that makes them alike, and what is missing then is not the bands' fault.
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
from vehest.report.document import Block, Column, Table
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.runs import by_name
from vehest.trust.bands import CHANNEL_LEVEL, block_labels, pooled_quantile

LEARNT = "learnt on"  # in the board's column "car"
DRAWS = 100
LEAST_MANOEUVRES = 3  # of a test, for an interval


@dataclass(frozen=True)
class Scores:
    """Errors of β over the half width of the 90 % band, of all samples of some ranges."""

    values: FloatArray  # (N,), 1 where an error ends on the band
    manoeuvres: NDArray[np.int64]  # which each sample belongs to, (N,), counted from 0

    @property
    def number(self) -> int:
        """Of manoeuvres."""
        return int(self.manoeuvres.max(initial=-1)) + 1


def scores_of(part: PartArtefacts, model: EvaluatedModel, test_set: str) -> Scores | None:
    """Scores of a model on a test set, or on ``validation``, by the manoeuvres that bands are calibrated by; none without bands."""
    spans = part.split.validation if test_set == "validation" else part.split.tests[test_set]
    parts = part.scored(model, test_set)
    turns: list[FloatArray | None] = [None] * len(parts)
    values = []
    for position, scored in enumerate(parts):
        if "sideslip" not in scored.bands:
            return None
        turned = np.remainder(scored.sideslip - scored.sideslip_ref + np.pi, 2.0 * np.pi) - np.pi
        values.append(np.abs(turned) / scored.bands["sideslip"])
        if len(parts) == len(spans):  # else each sequence of a range is a manoeuvre
            reference = read_recording(
                part.references[spans[position].dataset, spans[position].recording]
            )
            turns[position] = (
                np.interp(scored.time, reference.time, reference["yaw_rate"])
                if "yaw_rate" in reference
                else None
            )
    labels, _ = block_labels(turns, [len(own) for own in values], part.protocol.rate_hz)
    together = np.concatenate(values)
    known = np.concatenate(labels)
    finite = np.isfinite(together)
    return (
        Scores(together[finite], np.unique(known[finite], return_inverse=True)[1])
        if finite.any()
        else None
    )


def holds_level(inside: NDArray[np.bool_], manoeuvres: NDArray[np.int64]) -> bool:
    """Whether 0.90 lies in the 95 % interval of a share, by manoeuvres counted from 0, (N,)."""
    low, high = _interval(inside, manoeuvres)
    return low <= CHANNEL_LEVEL <= high


def share_if_shuffled(
    calibration: Scores, test: Scores, draws: int = DRAWS, seed: int = 0
) -> float:
    """In which share of draws 0.90 lies in the test's interval, if manoeuvres are shuffled between calibration and test; NaN if too few."""
    if min(calibration.number, test.number) < LEAST_MANOEUVRES:
        return float("nan")
    generator = np.random.default_rng(seed)
    values = np.concatenate([calibration.values, test.values])
    labels = np.concatenate([calibration.manoeuvres, test.manoeuvres + calibration.number])
    held = 0
    for _ in range(draws):
        order = generator.permutation(calibration.number + test.number)
        learnt = (order < calibration.number)[labels]
        factor, _ = pooled_quantile(values[learnt], labels[learnt], CHANNEL_LEVEL)
        manoeuvres = np.unique(labels[~learnt], return_inverse=True)[1]
        held += holds_level(values[~learnt] <= factor, manoeuvres)
    return held / draws


def together(tests: Sequence[Scores]) -> tuple[float, float, float]:
    """Share of errors inside their bands over several test sets, each by a model and a band of its own, and its 95 % interval."""
    inside = np.concatenate([own.values <= 1.0 for own in tests])
    starts = np.cumsum([0, *(own.number for own in tests)])
    manoeuvres = np.concatenate(
        [own.manoeuvres + start for own, start in zip(tests, starts[:-1], strict=True)]
    )
    low, high = _interval(inside, manoeuvres)
    return float(inside.mean()), low, high


def _interval(inside: NDArray[np.bool_], manoeuvres: NDArray[np.int64]) -> tuple[float, float]:
    sizes = np.bincount(manoeuvres).astype(np.float64)
    hits = np.asarray(np.bincount(manoeuvres, weights=inside.astype(np.float64)), dtype=np.float64)
    return proportion_interval(hits, sizes)


# In the report


def in_words(low: float, high: float) -> str:
    """Whether 0.90 lies in an interval."""
    return (
        "no interval"
        if math.isnan(low)
        else "yes"
        if low <= 0.9 <= high
        else "too wide"
        if low > 0.9
        else "too narrow"
    )


def scores_learnt(parts: Mapping[str, PartArtefacts], board: pd.DataFrame) -> list[Scores | None]:
    """Of each row of the board, the errors over the band; none off the cars that were learnt on."""
    return [
        scores_of(parts[row["part"]], _model_of(parts[row["part"]], row), row["test_set"])
        if row["car"] == LEARNT
        else None
        for _, row in board.iterrows()
    ]


def _model_of(part: PartArtefacts, row: pd.Series) -> EvaluatedModel:
    return by_name(part.models)[row["estimator"], row["variant"]][0]


def if_shuffled(
    parts: Mapping[str, PartArtefacts], board: pd.DataFrame, scores: Sequence[Scores | None]
) -> list[float]:
    """`share_if_shuffled` of each row of the board [%]; NaN off the cars that were learnt on."""
    found = []
    for (_, row), test in zip(board.iterrows(), scores, strict=True):
        part = parts[row["part"]]
        calibration = None if test is None else scores_of(part, _model_of(part, row), "validation")
        found.append(
            math.nan
            if calibration is None or test is None
            else 100 * share_if_shuffled(calibration, test)
        )
    return found


def shuffled_in_words(board: pd.DataFrame) -> str:
    """How many of the intervals could hold 0.90 if test and calibration were alike."""
    own = board[(board["inside"] != "no interval") & board["if_shuffled"].notna()]
    if own.empty:
        return ""
    by_title = "; ".join(
        f"{title} {shares.mean():.0f} %"
        for title, shares in own.groupby("title", sort=False)["if_shuffled"]
    )
    held = 100 * float((own["inside"] == "yes").mean())
    chance = float(own["if_shuffled"].mean())
    return (
        f"Of these {len(own)}, {held:.0f} % hold it. **With manoeuvres shuffled {DRAWS} times between calibration and test, which "
        f"makes the two alike, {chance:.0f} % do** ({by_title}): a band of so few manoeuvres seldom holds just 90 %. "
        "Added after the tests had been seen; nothing was chosen by it."
    )


def over_parts(board: pd.DataFrame, scores: Sequence[Scores | None]) -> list[Block]:
    """Coverage over all parts that test on the same data, each by its own model and band."""
    rows = []
    drives = [title.rpartition(", ")[0] or title for title in board["title"]]
    for (drive, title), own in board.reset_index(drop=True).groupby(
        [drives, "estimator_title"], sort=False
    ):
        tests = [test for test in (scores[position] for position in own.index) if test is not None]
        if len(tests) > 1 and own["part"].nunique() == len(own):
            share, low, high = together(tests)
            row = {
                "where": drive,
                "estimator_title": title,
                "tests": len(tests),
                "manoeuvres": sum(test.number for test in tests),
            }
            rows.append(
                {
                    **row,
                    "share": 100 * share,
                    "interval": f"{100 * low:.0f} … {100 * high:.0f}",
                    "inside": in_words(low, high),
                }
            )
    if not rows:
        return []
    frame = pd.DataFrame(rows)
    caption = (
        "The same over all parts of a drive together, each test by the model and the band that had not seen it: 0.90 lies in "
        f"{int((frame['inside'] == 'yes').sum())} of {len(frame)} intervals, over manoeuvres. Added after the tests had been seen."
    )
    columns = {
        "where": Column("drive"),
        "estimator_title": Column("estimator"),
        "tests": Column("tests", decimals=0),
        "manoeuvres": Column("manoeuvres", decimals=0),
        "share": Column("inside [%]", decimals=1),
        "interval": Column("95 % interval [%]"),
        "inside": Column("0.90 in it"),
    }
    return [Table("bands_together", caption, frame, columns)]
