"""Errors of a study's candidates by block and seed, and how far they were trained:
tables/blocks.csv and tables/training.csv.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.text_files import number_in, read_rows
from vehest_papers.kit.block_rows import (
    SEEDS_PLANNED,
    BlockRow,
    TrainingRow,
    TrainingState,
    columns_of,
)

TRAINING_STATES: tuple[TrainingState, ...] = get_args(TrainingState)  # from the least trained on


class Key(NamedTuple):
    """Which errors."""

    part: str
    candidate: str
    test_set: str
    metric: str


@dataclass(frozen=True, eq=False)
class BlockErrors:
    """Errors of one candidate on one test set."""

    seeds: tuple[str, ...]
    blocks: tuple[str, ...]
    sums: FloatArray  # sum of the loss over each block, (S, B); not finite where it diverged
    sizes: FloatArray  # samples in each block, (B,)

    def of_blocks(self, blocks: tuple[str, ...]) -> BlockErrors:
        """The same for some of the blocks, in a given order."""
        columns = [self.blocks.index(name) for name in blocks]
        return BlockErrors(self.seeds, blocks, self.sums[:, columns], self.sizes[columns])


@dataclass(frozen=True)
class Training:
    """How far a candidate was trained."""

    epochs: str
    epochs_paper: str
    state: TrainingState
    reason: str
    seeds_planned: int = 0  # 0: all that are planned are trained


def read_blocks(path: Path) -> dict[Key, BlockErrors]:
    """Read blocks.csv, a row for each block and seed; an empty value is one that is not finite.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        As `blocks_of`, or a value is not a number.
    """
    rows = (
        BlockRow(
            row["part"],
            row["candidate"],
            int(number_in(row, "seed", path)),
            row["test_set"],
            row["metric"],
            row["block"],
            number_in(row, "value", path) if row["value"] else np.nan,
            number_in(row, "size", path),
        )
        for row in read_rows(path, columns_of(BlockRow))
    )
    return blocks_of(rows, f"'{path}'")


def blocks_of(rows: Iterable[BlockRow], source: str = "errors by block") -> dict[Key, BlockErrors]:
    """Arrange rows by part, candidate, test set and metric.

    Parameters
    ----------
    source
        What an error names: the file that the rows are from.

    Raises
    ------
    DataError
        A block of a seed occurs twice or is missing, a size is not a number of samples, or the
        size of a block differs between seeds.
    """
    cells: dict[Key, dict[tuple[str, str], tuple[float, float]]] = {}
    for row in rows:
        key = Key(row.part, row.candidate, row.test_set, row.metric)
        cell = (str(row.seed), row.block)
        of_key = cells.setdefault(key, {})
        if cell in of_key:
            raise DataError(f"{source}: {_named(key, *cell)} occurs twice; write one row for it")
        if not (np.isfinite(row.size) and row.size >= 0):
            raise DataError(
                f"{source}: {_named(key, *cell)} has size {row.size:g}; write its samples"
            )
        of_key[cell] = (row.value, row.size)
    return {key: _arranged(key, of_key, source) for key, of_key in cells.items()}


def read_training(path: Path) -> dict[str, Training]:
    """Read training.csv: candidate -> epochs, the paper's, whether they suffice."""
    trained = {}
    columns = [name for name in columns_of(TrainingRow) if name != SEEDS_PLANNED]
    for row in read_rows(path, columns):
        state = row["training"]
        if state not in TRAINING_STATES:
            raise DataError(
                f"'{path}': candidate {row['candidate']!r} has training {state!r}, "
                f"which is not one of: {', '.join(TRAINING_STATES)}"
            )
        trained[row["candidate"]] = Training(
            row["epochs"],
            row["epochs_paper"],
            state,
            row["reason"],
            int(number_in(row, SEEDS_PLANNED, path)) if SEEDS_PLANNED in row else 0,
        )
    return trained


def training_of(rows: Iterable[TrainingRow]) -> dict[str, Training]:
    """Candidate -> how far it was trained."""
    return {
        row.candidate: Training(
            row.epochs, row.epochs_paper, row.training, row.reason, row.seeds_planned
        )
        for row in rows
    }


def _named(key: Key, seed: str, block: str) -> str:
    return (
        f"block {block!r} of seed {seed} of {key.candidate!r} "
        f"(part {key.part}, test set {key.test_set}, metric {key.metric})"
    )


def _arranged(
    key: Key, cells: Mapping[tuple[str, str], tuple[float, float]], source: str
) -> BlockErrors:
    seeds = tuple(dict.fromkeys(seed for seed, _ in cells))
    blocks = tuple(dict.fromkeys(block for _, block in cells))
    for seed in seeds:
        for block in blocks:
            if (seed, block) not in cells:
                raise DataError(
                    f"{source}: {_named(key, seed, block)} is missing; "
                    "write inf as its value where the estimator diverged"
                )
    table = np.array([[cells[seed, block] for block in blocks] for seed in seeds])
    sizes = table[:, :, 1]
    if not np.allclose(sizes, sizes[0], rtol=1e-6):
        position = int(np.flatnonzero((~np.isclose(sizes, sizes[0], rtol=1e-6)).any(axis=0))[0])
        raise DataError(
            f"{source}: {_named(key, seeds[0], blocks[position])} has another size than with "
            "other seeds; the seeds must be scored on the same samples"
        )
    return BlockErrors(seeds, blocks, table[:, :, 0], sizes[0])
