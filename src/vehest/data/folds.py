"""Blocked cross-validation: folds of recordings, laps or segments of time that follow one
another.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from vehest.data.errors import ConfigurationError
from vehest.data.laps import laps_of
from vehest.data.recording import Recording
from vehest.data.splits import Span

# smallest number of folds: one to test, one for early stopping, the rest to learn from
MIN_FOLDS = 3


@dataclass(frozen=True)
class FoldsFile:
    """Settings of the cross-validation of a split."""

    number: Annotated[int, Field(ge=MIN_FOLDS)] = 5  # number of folds, three or more
    # unit that is never cut in two; seconds: ``block_seconds`` of driving
    of: Literal["recordings", "laps", "seconds"] = "laps"
    recordings: str = "*"  # pattern of the names of the recordings that take part
    block_seconds: PositiveFloat = 30.0  # length of a block for ``of: seconds`` [s]
    # time that is removed from training and validation where they border on another role [s]
    gap_seconds: NonNegativeFloat = 2.0


def blocks_of(folds: FoldsFile, recordings: Iterable[tuple[Span, Recording]]) -> list[Span]:
    """The blocks of recordings, each with the span that names it, in order.

    Parameters
    ----------
    folds : FoldsFile
        What a block is: a recording, a lap or so many seconds. What is left before the first or
        after the last lap belongs to that lap, a rest of less than half a block of seconds to the
        one before.
    recordings : iterable of tuple
        Span that names a recording, and the recording.

    Returns
    -------
    list of Span
        They cover every recording without gaps.

    Raises
    ------
    DataError
        Laps need a speed or yaw rate that a recording does not have.
    """
    blocks = []
    for span, recording in recordings:
        bounds = [recording.start_time, recording.end_time]
        if folds.of == "laps":  # the rest before the first or after the last belongs to that lap
            bounds += [stop for _, stop in laps_of(recording)[:-1]]
        elif folds.of == "seconds":  # a rest of less than half a block belongs to the one before
            number = max(round(recording.duration / folds.block_seconds), 1)
            bounds += [
                recording.start_time + block * folds.block_seconds for block in range(1, number)
            ]
        edges = sorted(set(bounds))
        blocks += [replace(span, start=start, stop=stop) for start, stop in pairwise(edges)]
    return blocks


def fold_of(
    blocks: Sequence[Span], folds: FoldsFile, fold: int, subject: str
) -> tuple[tuple[Span, ...], tuple[Span, ...], tuple[Span, ...]]:
    """Training, validation and test of the fold, from 0, that is tested: blocks stay in order and
    folds last about equally long.

    The fold after the tested one (the first after the last) is the one to stop on.

    Raises
    ------
    ConfigurationError
        There is no such fold, or too few blocks to fill them.
    """
    if not 0 <= fold < folds.number:
        raise ConfigurationError(f"{subject}: fold {fold} is not one of 0 to {folds.number - 1}")
    lengths = np.array([block.stop - block.start for block in blocks])
    middles = np.cumsum(lengths) - 0.5 * lengths
    dealt = np.minimum((middles / lengths.sum() * folds.number).astype(np.int64), folds.number - 1)
    empty = sorted(set(range(folds.number)) - set(dealt.tolist()))
    if empty:
        raise ConfigurationError(
            f"{subject}: {len(blocks)} blocks ({folds.of}) do not fill {folds.number} folds, "
            f"number {empty[0]} stays empty; take fewer folds, or of: seconds with a shorter "
            "block_seconds"
        )
    roles = np.where(dealt == fold, 2, np.where(dealt == (fold + 1) % folds.number, 1, 0)).tolist()
    train, validation, test = (
        _joined(blocks, roles, role, 0.0 if role == 2 else folds.gap_seconds) for role in range(3)
    )
    if not (train and validation):
        raise ConfigurationError(
            f"{subject}: gaps of {folds.gap_seconds:g} s leave fold {fold} nothing to train on; "
            "set folds.gap_seconds lower"
        )
    return train, validation, test


def _joined(
    blocks: Sequence[Span], roles: Sequence[int], role: int, gap: float
) -> tuple[Span, ...]:
    """Ranges of the blocks of one role: neighbours are joined, and shortened by the gap [s] where
    they border on a block of another role; a range that is no longer than its gaps is dropped.

    Dropped where that is all.
    """
    joined: list[tuple[Span, int]] = []
    for block, block_role in zip(blocks, roles, strict=True):
        if joined and block_role == joined[-1][1] and _touch(joined[-1][0], block):
            joined[-1] = (replace(joined[-1][0], stop=block.stop), block_role)
        else:
            joined.append((block, block_role))
    spans: list[Span] = []
    for place, (span, block_role) in enumerate(joined):
        before = place > 0 and _touch(joined[place - 1][0], span)
        after = place + 1 < len(joined) and _touch(span, joined[place + 1][0])
        start = span.start + gap * before
        stop = span.stop - gap * after
        if block_role == role and start < stop:
            spans.append(replace(span, start=start, stop=stop))
    return tuple(spans)


def _touch(first: Span, second: Span) -> bool:
    """Whether the second range begins where the first ends, in the same recording."""
    return (first.dataset, first.recording) == (second.dataset, second.recording) and math.isclose(
        first.stop, second.start
    )
