"""Errors of an estimate summed over short segments of a drive, and segments joined into blocks that
are about independent of each other.

An evaluation keeps the segments, so that intervals need neither model nor estimate again.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.text_files import number_in, read_rows
from vehest.evaluation.metrics import Scored, wrap_to_half_turn
from vehest.evaluation.significance import root_intervals, unexplained_interval

SEGMENT_SECONDS = 1.0  # s, length of the segments over which errors are summed
# ranges or sequences from which on each is a block; of fewer, each is cut into blocks
MIN_PIECES_AS_BLOCKS = 8
MIN_BLOCKS = 3  # smallest number of blocks with which an interval is given


@dataclass(frozen=True, eq=False)
class Segments:
    """Sums of errors over the scored samples of each of K segments of a test set, (K,) each, from
    which metrics and their intervals follow without the samples.
    """

    piece: FloatArray  # number of the range, or sequence, that a segment belongs to
    start: FloatArray  # time of its first sample [s]
    samples: FloatArray  # number of its scored samples
    squared_error_vy: FloatArray  # sum of (v̂ - v)² [m²/s²]
    sideslip_samples: FloatArray  # number of these at which sideslip is scored
    squared_error_sideslip: FloatArray  # sum of (β̂ - β)² over these [deg²]
    error_vy: FloatArray  # sum of v̂ - v [m/s]
    vy_ref: FloatArray  # sum of v [m/s]
    squared_vy_ref: FloatArray  # sum of v² [m²/s²]

    def __len__(self) -> int:
        return len(self.piece)

    @property
    def is_finite(self) -> bool:
        """Whether every scored sideslip has a finite error."""
        return math.isfinite(float(self.squared_error_sideslip.sum()))

    @property
    def with_sideslip(self) -> Segments:
        """The segments in which sideslip is scored at one sample or more."""
        chosen = self.sideslip_samples > 0
        return Segments(**{name: getattr(self, name)[chosen] for name in COLUMNS})


# arrays of `Segments`, columns of its CSV
COLUMNS = tuple(field.name for field in fields(Segments))


def segments_of(parts: Sequence[Scored], rate_hz: float) -> Segments:
    """Cut ranges or sequences scored at ``rate_hz`` [Hz] into segments of `SEGMENT_SECONDS`; the
    last of a range may be shorter.
    """
    steps = max(round(SEGMENT_SECONDS * rate_hz), 1)
    columns: dict[str, list[FloatArray]] = {name: [] for name in COLUMNS}
    for position, part in enumerate(parts):
        starts = np.arange(0, len(part.time), steps)
        turn = wrap_to_half_turn(part.sideslip - part.sideslip_ref)
        error = part.vy - part.vy_ref
        summed = {
            "samples": np.ones_like(error),
            "squared_error_vy": np.square(error),
            "sideslip_samples": part.is_sideslip_scored.astype(np.float64),
            "squared_error_sideslip": np.where(
                part.is_sideslip_scored, np.square(np.degrees(turn)), 0.0
            ),
            "error_vy": error,
            "vy_ref": part.vy_ref,
            "squared_vy_ref": np.square(part.vy_ref),
        }
        columns["piece"].append(np.full(len(starts), float(position)))
        columns["start"].append(part.time[starts])
        for name, values in summed.items():
            columns[name].append(np.add.reduceat(values, starts))
    return Segments(**{name: np.concatenate(values) for name, values in columns.items()})


def joined(parts: Sequence[Segments]) -> Segments:
    """Concatenate the segments of several test sets; their pieces are numbered anew, so that each
    stays one.
    """
    first = 0.0
    columns = {name: [np.asarray(getattr(part, name)) for part in parts] for name in COLUMNS}
    for position, part in enumerate(parts):
        columns["piece"][position] = part.piece + first
        first += float(part.piece.max()) + 1.0
    return Segments(**{name: np.concatenate(values) for name, values in columns.items()})


def write_segments(path: Path, by_test_set: dict[str, Segments]) -> None:
    """Write the segments of every test set into one CSV file, floats to the last digit."""
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["test_set", *COLUMNS])
        for test_set, segments in by_test_set.items():
            for row in zip(*(getattr(segments, name).tolist() for name in COLUMNS), strict=True):
                writer.writerow([test_set, *(repr(value) for value in row)])


def read_segments(path: Path) -> dict[str, Segments]:
    """Read the segments of every test set, name -> segments, from the CSV of `write_segments`.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It is damaged.
    """
    rows: dict[str, list[list[float]]] = {}
    for row in read_rows(path, ("test_set", *COLUMNS)):
        rows.setdefault(row["test_set"], []).append(
            [number_in(row, name, path) for name in COLUMNS]
        )
    return {name: Segments(*np.array(values).T) for name, values in rows.items()}


def block_labels(segments: Segments, losses: FloatArray) -> NDArray[np.int64]:
    """Group segments into blocks that are about independent: each range or sequence is one, or,
    where these are few, parts of the Politis-White length of each.

    Parameters
    ----------
    segments : Segments
        K segments of a test set; only the range or sequence that they belong to is used.
    losses : FloatArray
        Loss of each segment, a row for every loss, (C, K); blocks are as long as the loss that
        needs the longest requires.

    Returns
    -------
    ndarray of int
        Number of each segment's block, (K,), from 0 on. From `MIN_PIECES_AS_BLOCKS` ranges or
        sequences on each is a block; no block reaches across two of them.
    """
    pieces = np.unique(segments.piece)
    if len(pieces) >= MIN_PIECES_AS_BLOCKS:
        return np.asarray(np.searchsorted(pieces, segments.piece), dtype=np.int64)
    runs = [losses[:, segments.piece == piece] for piece in pieces]
    length = max(
        math.ceil(politis_white_length([run[row] for run in runs])) for row in range(len(losses))
    )
    labels = np.empty(len(segments), dtype=np.int64)
    count = 0
    for piece in pieces:
        rows = np.flatnonzero(segments.piece == piece)
        n_blocks = max(
            len(rows) // length, 1
        )  # what is left over is shared out, so that no block is a stump
        labels[rows] = count + np.minimum(
            np.arange(len(rows)) * n_blocks // len(rows), n_blocks - 1
        )
        count += n_blocks
    return labels


def politis_white_length(runs: Sequence[FloatArray]) -> float:
    """Block length, in segments, that suits the bootstrap of a mean of dependent values.

    The rule for blocks of one length, with the autocovariance R pooled over uninterrupted runs: b =
    (2 G²/D)^(1/3) n^(1/3) with G = Σ λ(k/M)|k| R(k), D = 4/3 (Σ λ(k/M) R(k))², λ the flat-top
    window, and M twice the lag after which autocorrelations are no longer significant.

    Parameters
    ----------
    runs : Sequence[FloatArray]
        Values of each run, (T,) each.

    Returns
    -------
    float
        At least 1, at most a third of the number of values.

    Source: Politis & White, Econometric Reviews 23 (1), 2004, Section 3, with the correction of
    Patton, Politis & White, Econometric Reviews 28 (4), 2009.
    """
    covariances = _pooled_covariances(runs)
    n = sum(len(run) for run in runs)
    return (
        _length(covariances, _window(covariances, n), n)
        if len(covariances) > 1 and covariances[0] > 0
        else 1.0
    )


def _n_insignificant_lags(n: int) -> int:
    """Number of consecutive lags with insignificant autocorrelation by which the correlation has
    ended, for n values.
    """
    return max(5, int(math.sqrt(math.log10(max(n, 2)))))


def _pooled_covariances(runs: Sequence[FloatArray]) -> FloatArray:
    """Autocovariances from lag 0 on, (L + 1,), pooled over uninterrupted runs about their common
    mean.
    """
    n = sum(len(run) for run in runs)
    mean = float(np.concatenate(runs).mean())
    deviations = [run - mean for run in runs]
    longest = max(min(math.ceil(math.sqrt(n)) + _n_insignificant_lags(n), n - 1), 0)
    return np.array(
        [
            sum(float(run[lag:] @ run[: len(run) - lag]) for run in deviations if len(run) > lag)
            / n
            for lag in range(longest + 1)
        ]
    )


def _window(covariances: FloatArray, n: int) -> int:
    """M, twice the lag after which `_n_insignificant_lags` autocorrelations in a row are
    insignificant.
    """
    small = np.abs(covariances[1:] / covariances[0]) < 2.0 * math.sqrt(math.log10(n) / n)
    settled = [
        lag
        for lag in range(len(small) - _n_insignificant_lags(n) + 1)
        if small[lag : lag + _n_insignificant_lags(n)].all()
    ]
    longest = len(covariances) - 1
    return min(2 * max(settled[0], 1), longest) if settled else longest


def _length(covariances: FloatArray, window: int, n: int) -> float:
    """Block length of lag weights that are flat up to M/2 and fall to 0 at M, at least 1 and
    bounded.

    The bound is the lesser of 3 √n and n/3; ``covariances`` are those from lag 0 on, ``window`` is
    M.
    """
    lags = np.arange(1, window + 1)
    weights = np.clip(2.0 * (1.0 - lags / window), 0.0, 1.0)
    spread = 2.0 * float(np.sum(weights * lags * covariances[1 : window + 1]))
    level = float(covariances[0] + 2.0 * np.sum(weights * covariances[1 : window + 1]))
    bound = max(math.ceil(min(3.0 * math.sqrt(n), n / 3.0)), 1)
    if level == 0.0:
        return float(bound)
    length = (2.0 * spread**2 / (4.0 / 3.0 * level**2)) ** (1.0 / 3.0) * n ** (1.0 / 3.0)
    return float(min(max(length, 1.0), bound))


def block_sums(values: FloatArray, labels: NDArray[np.int64]) -> FloatArray:
    """Sums of segments' values over blocks: (…, K) to (…, B).

    Parameters
    ----------
    values : FloatArray
        One row or several of them, a value a segment.
    labels : ndarray of int
        Number of each segment's block, shape (K,), every one from 0 to B - 1.
    """
    rows = np.atleast_2d(values)
    summed: FloatArray = np.stack([np.bincount(labels, weights=row) for row in rows])
    return summed if values.ndim > 1 else np.asarray(summed[0])


def figure_intervals(segments: Segments) -> dict[str, tuple[float, float]]:
    """95 % intervals of the metrics of one training, over blocks of the drive: the range within
    which another drive of this kind would lie.

    Returns
    -------
    dict[str, tuple[float, float]]
        Metric -> lower and upper end, in the units of `accuracy`. A metric with fewer than
        `MIN_BLOCKS` blocks is left out, and so is ``mse_sideslip``, which counts all samples, where
        sideslip is not scored at some.
    """
    intervals = {}
    moving = segments.with_sideslip
    if len(moving):
        labels = block_labels(moving, _sideslip_loss(moving)[None])
        if labels.max() + 1 >= MIN_BLOCKS:
            sums = block_sums(moving.squared_error_sideslip[None], labels)
            (sideslip,) = root_intervals([sums], block_sums(moving.sideslip_samples, labels))
            intervals["rmse_sideslip"] = (sideslip.low, sideslip.high)
            if np.array_equal(segments.sideslip_samples, segments.samples):
                intervals["mse_sideslip"] = (sideslip.low**2, sideslip.high**2)
    labels = block_labels(segments, _sideslip_loss(segments)[None])
    if labels.max() + 1 < MIN_BLOCKS:
        return intervals
    sizes = block_sums(segments.samples, labels)
    summed = {
        name: block_sums(getattr(segments, name), labels)
        for name in ("squared_error_vy", "error_vy", "squared_vy_ref", "vy_ref")
    }
    (vy,) = root_intervals([summed["squared_error_vy"][None]], sizes)
    intervals["rmse_vy"] = (vy.low, vy.high)
    if summed["squared_vy_ref"].sum() > 0:
        fvu = unexplained_interval(
            summed["squared_error_vy"],
            summed["error_vy"],
            summed["squared_vy_ref"],
            summed["vy_ref"],
            sizes,
        )
        intervals |= {"fvu": (fvu.low, fvu.high), "r2": (1.0 - fvu.high, 1.0 - fvu.low)}
    return intervals


def _sideslip_loss(segments: Segments) -> FloatArray:
    """Mean squared error of β of each segment, (K,) [deg²]; 0 where none is scored."""
    samples = segments.sideslip_samples
    zeros = np.zeros_like(samples)
    loss: FloatArray = np.divide(
        segments.squared_error_sideslip, samples, out=zeros, where=samples > 0
    )
    return loss
