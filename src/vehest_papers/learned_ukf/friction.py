"""The friction over time from several starts, how long it takes to converge and to what, and what the start is worth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from vehest.constants import FloatArray
from vehest.estimators.learned_ukf import LearnedUkf
from vehest.evaluation.metrics import Protocol
from vehest.evaluation.significance import CONFIDENCE, Interval
from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, MISSING, fixed, new_figure
from vehest.training.through_filter import Drive
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.reading import with_interval
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.candidates import SETS
from vehest_papers.learned_ukf.claims import TOLERANCE
from vehest_papers.learned_ukf.filtering import filtered, squares_of, weighted
from vehest_papers.learned_ukf.prediction import over_sequences

STARTS = (0.3, 0.6, 0.9)
COLOURS = ("#0b4f9c", "#444444", "#b3122a")
TRAINED_FROM = 0.6
LOW = 0.4  # starts of NNTF_UH and NNTF_UH*
DEVIATIONS = (
    None,
    0.03,
    0.003,
)  # of the friction at the start: as learnt, and two smaller ones, the last that of the authors' code
LAST_SECONDS = 2.0
N_RESAMPLES = 2000


@dataclass(frozen=True)
class Tracks:
    """The friction of all seeds on all sequences of a test."""

    mean: FloatArray  # (S, B, T)
    deviation: FloatArray  # the filter's own, (S, B, T)
    rate_hz: float  # of the samples

    @property
    def final(self) -> FloatArray:
        """Mean over the last two seconds, (S, B)."""
        own: FloatArray = self.mean[..., -round(LAST_SECONDS * self.rate_hz) :].mean(axis=-1)
        return own

    def times(self) -> FloatArray:
        """After how many seconds it stays within `TOLERANCE` of its final value, (S, B)."""
        return settled(np.abs(self.mean - self.final[..., None]) > TOLERANCE, self.rate_hz)

    def apart(self, other: Tracks) -> FloatArray:
        """After how many seconds it stays within `TOLERANCE` of another start's, (S, B)."""
        return settled(np.abs(self.mean - other.mean) > TOLERANCE, self.rate_hz)


def settled(outside: np.ndarray, rate_hz: float) -> FloatArray:
    """Time after the last sample that is outside, (..., T) -> (...) [s]; 0 where none is."""
    steps = outside.shape[-1]
    last = steps - np.argmax(outside[..., ::-1], axis=-1)
    return np.where(outside.any(axis=-1), last, 0) / rate_hz


def tracks_of(filters: Sequence[LearnedUkf], drives: Drive, start: float) -> Tracks:
    """Filter all sequences with every seed from a friction."""
    parts = [filtered(own, drives, friction=start).steps.filtered for own in filters]
    means = np.stack([part.mean[..., -1].double().numpy() for part in parts])
    variances = np.stack([part.covariance[..., -1, -1].double().numpy() for part in parts])
    return Tracks(means, np.sqrt(np.maximum(variances, 0.0)), filters[0].settings.rate_hz)


def interval_of(values: FloatArray, statistic: Callable[[FloatArray], float]) -> Interval:
    """A statistic of values by seed and sequence (S, B), both resampled; Student's t with the degrees of freedom of the sequences."""
    rng = np.random.default_rng(0)
    seeds, n = values.shape
    drawn = [
        statistic(
            values[np.ix_(rng.integers(seeds, size=max(seeds - 1, 1)), rng.integers(n, size=n - 1))]
        )
        for _ in range(N_RESAMPLES)
    ]
    value = statistic(values)
    error = float(np.std(drawn))
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, n - 1)) * error
    return Interval(value, value - half, value + half, np.nan, error, n - 1)


def median(values: FloatArray) -> float:
    """Of all."""
    return float(np.median(values))


def mean(values: FloatArray) -> float:
    """Of all."""
    return float(np.mean(values))


def convergence_table(
    tracks: Mapping[str, Mapping[float, Tracks]], skip_seconds: float, name: str, data: str
) -> Table:
    """A row a tyre and start: time to converge, final value, and and the filter's own deviation."""
    rows = []
    for test, by_start in tracks.items():
        for start, own in by_start.items():
            times = own.times()
            time = interval_of(times, median)
            final = interval_of(own.final, mean)
            apart = interval_of(own.apart(by_start[TRAINED_FROM]), median)
            rows.append(
                {
                    "forgotten": apart.value,
                    "forgotten_words": MISSING
                    if start == TRAINED_FROM
                    else with_interval(apart.value, max(apart.low, 0.0), apart.high, 2),
                    "tyre": SETS[test],
                    "start": start,
                    "time": time.value,
                    "time_words": with_interval(time.value, max(time.low, 0.0), time.high, 2),
                    "within": 100.0 * float(np.mean(times <= skip_seconds)),
                    "final": final.value,
                    "final_words": with_interval(final.value, final.low, final.high, 3),
                    "spread": float(np.std(own.final)),
                    "deviation": float(own.deviation[..., -1].mean()),
                    "nominal": paper.NOMINAL_FRICTION[test],
                }
            )
    columns = {
        "tyre": Column("tyre"),
        "start": Column("start", decimals=1),
        "time_words": Column("median time to converge [s]"),
        "within": Column(f"converged within {skip_seconds:g} s [%]", decimals=0),
        "forgotten_words": Column(f"median time to the track from {TRAINED_FROM:g} [s]"),
        "final_words": Column("final value"),
        "deviation": Column("deviation that the filter gives", decimals=3),
        "nominal": Column("nominal, paper", decimals=2),
    }
    caption = (
        f"The friction of {paper.NNTF_UH} from three starts, {data}: 95 % intervals over sequences and seeds. Converged: stays within "
        f"{TOLERANCE:g} of its mean over the last {LAST_SECONDS:g} s. Time to the track from {TRAINED_FROM:g}: until it stays within "
        f"{TOLERANCE:g} of it, the effect of a wrong start; added after the tests had been seen, so it decides no claim."
    )
    return Table(f"friction_{name}", caption, pd.DataFrame(rows), columns)


def figure(
    tracks: Mapping[str, Mapping[float, Tracks]], skip_seconds: float, name: str, data: str
) -> Figure:
    """Mean over sequences and seeds from each start, with the 95 % interval of that mean."""
    with new_figure(DOUBLE_COLUMN, 2.8) as drawn:
        grid = drawn.subplots(1, len(tracks), sharey=True, squeeze=False)[0]
        for axes, (test, by_start) in zip(grid, tracks.items(), strict=True):
            for (start, own), colour in zip(by_start.items(), COLOURS, strict=True):
                time = np.arange(own.mean.shape[-1]) / own.rate_hz
                of_sequences = own.mean.mean(axis=0)
                middle = of_sequences.mean(axis=0)
                n = len(of_sequences)
                half = stats.t.ppf(0.975, n - 1) * of_sequences.std(axis=0, ddof=1) / np.sqrt(n)
                axes.fill_between(
                    time, middle - half, middle + half, color=colour, alpha=0.2, linewidth=0
                )
                axes.plot(time, middle, color=colour, linewidth=1.1, label=f"from {start:g}")
            axes.axhline(
                paper.NOMINAL_FRICTION[test],
                color="#444444",
                linewidth=0.8,
                linestyle="dotted",
                label="nominal, paper",
            )
            axes.axvspan(0.0, skip_seconds, color="#e8e8e8", zorder=0)
            axes.set_title(SETS[test], loc="left")
            axes.set_xlabel("time in the sequence [s]")
            axes.margins(x=0.0)
        grid[0].set_ylabel("friction [1]")
        legend_above(drawn, grid[0], columns=4)
    first = next(iter(next(iter(tracks.values())).values()))
    caption = (
        f"Friction of {paper.NNTF_UH} over time, mean of all sequences and {len(first.mean)} seeds; shaded: 95 % interval of the mean over "
        f"sequences. Grey: not scored. Data: {data}."
    )
    return Figure(f"friction_{name}", caption, drawn)


def start_table(
    filters: Sequence[LearnedUkf],
    drives: Mapping[str, Drive],
    protocol: Protocol,
    name: str,
    data: str,
) -> Table:
    """NNTF_UH* against NNTF_UH at several deviations of the friction at the start: errors and their difference with its interval."""
    skip = round(protocol.skip_seconds * protocol.rate_hz)
    learnt = float(
        np.mean([float(own.filter.initial_covariance()[-1, -1].detach()) ** 0.5 for own in filters])
    )
    rows = []
    for test, own in drives.items():
        for deviation in DEVIATIONS:
            squares = {
                start: np.stack(
                    [
                        weighted(
                            squares_of(
                                filtered(
                                    one, own, friction=start, deviation=deviation
                                ).steps.filtered.mean,
                                own,
                                skip,
                            )
                        )
                        for one in filters
                    ]
                )
                for start in (TRAINED_FROM, LOW)
            }
            # the same weights start from both frictions: seeds are paired, so their differences are what is resampled
            change = over_sequences(
                squares[LOW] - squares[TRAINED_FROM], np.zeros((1, squares[LOW].shape[1]))
            )
            rows.append(
                {
                    "tyre": SETS[test],
                    "deviation": learnt if deviation is None else deviation,
                    "which": "as learnt"
                    if deviation is None
                    else "the authors' code"
                    if deviation == DEVIATIONS[-1]
                    else "between",
                    "usual": float(squares[TRAINED_FROM].mean()),
                    "low": float(squares[LOW].mean()),
                    "change": change.value,
                    "change_words": with_interval(change.value, change.low, change.high, 4),
                }
            )
    columns = {
        "tyre": Column("tyre"),
        "deviation": Column("deviation at the start", decimals=3),
        "which": Column("which"),
        "usual": Column(f"MSE from {TRAINED_FROM:g} ({paper.NNTF_UH})", decimals=4),
        "low": Column(f"MSE from {LOW:g} ({paper.NNTF_UH_LOW})", decimals=4),
        "change_words": Column("difference [95 % interval]"),
    }
    caption = (
        f"What the start of the friction is worth: {paper.NNTF_UH_LOW} against {paper.NNTF_UH}, same weights, at several deviations of the "
        f"friction at the start. Deviations other than {fixed(learnt, 3)} are set in use, not learnt with. Data: {data}."
    )
    return Table(f"start_{name}", caption, pd.DataFrame(rows), columns)
