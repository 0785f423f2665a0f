"""Rows of tables/blocks.csv and tables/training.csv, from which claims are judged without models or
recordings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import number_of

BLOCKS = "blocks"
TRAINING = "training"
SEEDS_PLANNED = "seeds_planned"  # optional column of training.csv
BASELINE_NAMES: Mapping[str, str] = {
    "zero": "zero",
    "static map": "static_map",
}  # name in a report -> name in blocks.csv
MAX_IMPROVEMENT = 0.03  # by doubled epochs, up to which a training was long enough

TrainingState = Literal[
    "not trained", "insufficient", "not checked", "sufficient", "not applicable"
]


@dataclass(frozen=True)
class BlockRow:
    """One error: of a seed of a candidate on a block of a test set."""

    part: str  # of the study's pipeline
    candidate: str
    seed: int
    test_set: str
    metric: str
    block: str = ""  # a name that is unique within the test set
    value: float = 0.0  # sum of the loss over the block; squared errors where the metric is a root
    size: float = 0.0  # samples in the sum


@dataclass(frozen=True)
class TrainingRow:
    """How far a candidate was trained."""

    candidate: str
    epochs: str  # of each phase
    epochs_paper: str
    training: TrainingState
    reason: str
    seeds_planned: int = 0  # 0: all that are planned are trained


def name_in_blocks(title: str) -> str:
    """Name in blocks.csv of a candidate as the report calls it."""
    return BASELINE_NAMES.get(title, title)


def block_rows(
    row: BlockRow, blocks: Sequence[str], values: FloatArray, sizes: FloatArray | float
) -> list[BlockRow]:
    """Rows of one seed, a row for each block.

    Parameters
    ----------
    row
        Part, candidate, seed, test set and metric; its block, value and size are replaced.
    blocks
        Names of the blocks, B of them.
    values, sizes
        Sum of the loss over each block and samples in it, (B,); one size for all blocks of equal
        length.
    """
    head = (row.part, row.candidate, row.seed, row.test_set, row.metric)
    of_blocks = zip(
        blocks, values.tolist(), np.broadcast_to(sizes, len(blocks)).tolist(), strict=True
    )
    return [BlockRow(*head, *of_block) for of_block in of_blocks]


def seed_rows(
    row: BlockRow,
    seeds: Iterable[int],
    blocks: Sequence[str],
    values: FloatArray,
    sizes: FloatArray | float = 1,
) -> list[BlockRow]:
    """Rows of all seeds, a row for each block and seed.

    Parameters
    ----------
    row
        As of `block_rows`; its seed is replaced as well.
    seeds
        S of them.
    blocks
        Names of the blocks, B of them.
    values
        Sum of the loss, or a measured value, (S, B). A block of which no seed has a value (NaN)
        gets the size 0.
    sizes
        Samples in each block, (B,).
    """
    is_absent = np.isnan(values).all(axis=0)
    sizes = np.where(is_absent, 0, np.broadcast_to(sizes, len(blocks)))
    values = np.where(is_absent, 0.0, values)
    return [
        block_row
        for seed, of_seed in zip(seeds, values, strict=True)
        for block_row in block_rows(replace(row, seed=seed), blocks, of_seed, sizes)
    ]


def columns_of(row_type: type[Any]) -> tuple[str, ...]:
    """Columns of a table of rows, in order."""
    return tuple(field.name for field in fields(row_type))


def frame(rows: Sequence[BlockRow] | Sequence[TrainingRow], row_type: type[Any]) -> pd.DataFrame:
    """Rows as a table with the columns of their type; one without `SEEDS_PLANNED` where it is 0 in
    all rows.
    """
    table = pd.DataFrame([astuple(row) for row in rows], columns=columns_of(row_type))
    if SEEDS_PLANNED in table and not table[SEEDS_PLANNED].any():
        return table.drop(columns=SEEDS_PLANNED)
    return table


def checked_training(
    candidate: str,
    epochs: str,
    epochs_paper: str,
    validation: Mapping[int, float],
    doubled: Mapping[int, float],
) -> TrainingRow:
    """Whether a training was long enough, by the validation error that twice its epochs reach.

    Parameters
    ----------
    candidate, epochs, epochs_paper
        Of the row.
    validation, doubled
        Seed -> error on the validation range after the epochs of the tables, and after twice as
        many; compared over the seeds that both have.
    """
    seeds = sorted(validation.keys() & doubled.keys())
    if not seeds:
        return TrainingRow(
            candidate, epochs, epochs_paper, "not checked", "not trained with twice the epochs"
        )
    before, after = (
        float(np.mean([errors[seed] for seed in seeds])) for errors in (validation, doubled)
    )
    state: TrainingState = (
        "sufficient" if after >= (1.0 - MAX_IMPROVEMENT) * before else "insufficient"
    )
    words = (
        f"twice the epochs change the validation error by {100.0 * (after / before - 1.0):+.1f} %"
    )
    basis = f"{words}, {number_of(len(seeds), 'seed')}"
    return TrainingRow(candidate, epochs, epochs_paper, state, basis)


def names_of_blocks(
    labels: NDArray[np.int64], recordings: Sequence[str], starts: FloatArray
) -> list[str]:
    """Name of each block: recording and time [s] of its first segment.

    Parameters
    ----------
    labels, recordings, starts
        Number of the block, recording and first time of each segment, (K,).
    """
    firsts = [int(np.flatnonzero(labels == label)[0]) for label in range(int(labels.max()) + 1)]
    return [f"{recordings[first]} {starts[first]:.2f} s" for first in firsts]
