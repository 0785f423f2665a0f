"""The friction over time from several starts, how long until they agree, and what the start
changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from vehest.constants import FloatArray
from vehest.data.errors import number_of
from vehest.estimators.learned_ukf import LearnedUkf
from vehest.evaluation.metrics import Protocol
from vehest.evaluation.significance import mean_contrast
from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, fixed, new_figure
from vehest.training.through_filter import Drive
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.reading import with_interval
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import Pair, ratio_of
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.candidates import SETS
from vehest_papers.learned_ukf.filtering import filtered, squares_of, weighted

STARTS = (0.3, 0.6, 0.9)
COLOURS = ("#0b4f9c", "#444444", "#b3122a")
TRAINED_FROM = 0.6
LOW = 0.4  # starts of NNTF_UH and NNTF_UH*
DEVIATIONS = (None, 0.03, 0.003)
"""Deviation of the friction at the start: as trained, a smaller one, that of the authors' code."""

LAST_SECONDS = 2.0
AGREEMENT = 0.05  # of the friction


@dataclass(frozen=True)
class Tracks:
    """The friction of all seeds on all sequences of a test."""

    mean: FloatArray  # (S, B, T)
    deviation: FloatArray  # the filter's own, (S, B, T)
    rate_hz: float  # of the samples

    @property
    def final(self) -> FloatArray:
        """Mean over the last two seconds, (S, B)."""
        friction: FloatArray = self.mean[..., -round(LAST_SECONDS * self.rate_hz) :].mean(axis=-1)
        return friction

    def covered(self, nominal: float, skip_seconds: float) -> FloatArray:
        """Share of the samples after ``skip_seconds`` whose distance from a friction is within the
        filter's deviation, (S, B).
        """
        first = round(skip_seconds * self.rate_hz)
        distance = np.abs(self.mean[..., first:] - nominal)
        is_within = distance <= self.deviation[..., first:]
        return np.asarray(is_within.mean(axis=-1))


def settled(outside: np.ndarray, rate_hz: float) -> FloatArray:
    """Time from which nothing is outside any more.

    Parameters
    ----------
    outside : array, shape (..., T)
        Whether each sample is outside.
    rate_hz
        Of the samples [Hz].

    Returns
    -------
    array, shape (...)
        Time after the last sample that is outside [s]; 0 where none is.
    """
    steps = outside.shape[-1]
    last = steps - np.argmax(outside[..., ::-1], axis=-1)
    return np.where(outside.any(axis=-1), last, 0) / rate_hz


def tracks_of(filters: Sequence[LearnedUkf], drives: Drive, start: float) -> Tracks:
    """Filter all sequences with every seed, started from a friction.

    Parameters
    ----------
    filters
        One for each of S seeds, with the friction as their last state.
    drives
        B sequences of T samples.
    start
        Friction at the first sample [1].
    """
    parts = [filtered(estimator, drives, friction=start).steps.filtered for estimator in filters]
    means = np.stack([part.mean[..., -1].double().numpy() for part in parts])
    variances = np.stack([part.covariance[..., -1, -1].double().numpy() for part in parts])
    return Tracks(means, np.sqrt(np.maximum(variances, 0.0)), filters[0].settings.rate_hz)


def convergence_table(
    tracks: Mapping[str, Mapping[float, Tracks]],
    times: Mapping[str, Sequence[FloatArray]],
    skip_seconds: float,
    name: str,
    data: str,
) -> Table:
    """A row for each tyre: how long until the starts agree, and the final value with the filter's
    deviation.

    Parameters
    ----------
    tracks
        Test set -> friction at the start -> tracks.
    times
        Test set -> both times of agreement [s], (S, B) each.
    skip_seconds
        At the start of each sequence, which are not counted in the coverage [s].
    name, data
        Part and data, for the caption.
    """
    rows = []
    for test, by_start in tracks.items():
        final = by_start[TRAINED_FROM]
        absolute, relative = times[test]
        rows.append(
            {
                "tyre": SETS[test],
                "agreement": _text(absolute, 2),
                "agreement_in_deviations": _text(relative, 2),
                "final": _text(final.final, 3),
                "deviation": float(final.deviation[..., -1].mean()),
                "nominal": paper.NOMINAL_FRICTION[test],
                "covered": _text(final.covered(paper.NOMINAL_FRICTION[test], skip_seconds), 2),
            }
        )
    columns = {
        "tyre": Column("tyre"),
        "agreement": Column(f"agree within {AGREEMENT:g} after [s]"),
        "agreement_in_deviations": Column("agree within one deviation after [s]"),
        "final": Column("final value"),
        "deviation": Column("deviation that the filter gives", decimals=3),
        "nominal": Column("nominal, paper", decimals=2),
        "covered": Column("nominal within one deviation (Gaussian: 0.68)"),
    }
    starts = ", ".join(f"{start:g}" for start in STARTS)
    caption = (
        f"The friction of {paper.NNTF_UH} started from {starts}: time until the three estimates "
        f"agree and stay so, and mean over the last {LAST_SECONDS:g} s from {TRAINED_FROM:g}; "
        f"means with 95 % intervals over sequences and seeds. Data: {data}."
    )
    return Table(f"friction_{name}", caption, pd.DataFrame(rows), columns)


def _text(values: FloatArray, decimals: int) -> str:
    """Mean with its interval of values by seed and sequence."""
    contrast = mean_contrast(values)
    return with_interval(contrast.value, *contrast.interval(), decimals)


def figure(
    tracks: Mapping[str, Mapping[float, Tracks]], skip_seconds: float, name: str, data: str
) -> Figure:
    """Mean over sequences and seeds from each start, with the 95 % interval of that mean."""
    with new_figure(DOUBLE_COLUMN, 2.8) as drawn:
        grid = drawn.subplots(1, len(tracks), sharey=True, squeeze=False)[0]
        for axes, (test, by_start) in zip(grid, tracks.items(), strict=True):
            for (start, of_start), colour in zip(by_start.items(), COLOURS, strict=True):
                time = np.arange(of_start.mean.shape[-1]) / of_start.rate_hz
                of_sequences = of_start.mean.mean(axis=0)
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
    seeds = number_of(len(first.mean), "seed")
    caption = (
        f"Friction of {paper.NNTF_UH} over time, mean of all sequences and {seeds}; shaded: 95 % "
        f"interval of the mean over sequences. Grey: not scored. Data: {data}."
    )
    return Figure(f"friction_{name}", caption, drawn)


def start_table(
    filters: Sequence[LearnedUkf],
    drives: Mapping[str, Drive],
    protocol: Protocol,
    name: str,
    data: str,
) -> Table:
    """NNTF_UH* against NNTF_UH at several deviations of the friction at the start: errors and their
    ratio with its interval.
    """
    skip = round(protocol.skip_seconds * protocol.rate_hz)
    trained = float(
        np.mean(
            [
                float(of_test.filter.initial_covariance()[-1, -1].detach()) ** 0.5
                for of_test in filters
            ]
        )
    )
    rows = []
    for test, of_test in drives.items():
        for deviation in DEVIATIONS:
            squares = {
                start: np.stack(
                    [
                        weighted(
                            squares_of(
                                filtered(
                                    estimator, of_test, friction=start, deviation=deviation
                                ).steps.filtered.mean,
                                of_test,
                                skip,
                            )
                        )
                        for estimator in filters
                    ]
                )
                for start in (TRAINED_FROM, LOW)
            }
            # the same weights start from both frictions, so that seeds are paired
            pair = Pair(
                squares[LOW],
                squares[TRAINED_FROM],
                np.ones(squares[LOW].shape[1]),
                (0, 0),
                exponent=1.0,
                has_paired_seeds=True,
            )
            rows.append(
                {
                    "tyre": SETS[test],
                    "deviation": trained if deviation is None else deviation,
                    "which": "as trained"
                    if deviation is None
                    else "the authors' code"
                    if deviation == DEVIATIONS[-1]
                    else "between",
                    "usual": float(squares[TRAINED_FROM].mean()),
                    "low": float(squares[LOW].mean()),
                    "ratio": figure_in_words(ratio_of(pair)),
                }
            )
    columns = {
        "tyre": Column("tyre"),
        "deviation": Column("deviation at the start", decimals=3),
        "which": Column("which"),
        "usual": Column(f"MSE from {TRAINED_FROM:g} ({paper.NNTF_UH})", decimals=4),
        "low": Column(f"MSE from {LOW:g} ({paper.NNTF_UH_LOW})", decimals=4),
        "ratio": Column("ratio [95 % interval]"),
    }
    caption = (
        f"Effect of the friction at the start: {paper.NNTF_UH_LOW} against {paper.NNTF_UH}, same "
        "weights, at several deviations of the friction at the start. Deviations other than "
        f"{fixed(trained, 3)} are set in use, not trained with. Data: {data}."
    )
    return Table(f"start_{name}", caption, pd.DataFrame(rows), columns)
