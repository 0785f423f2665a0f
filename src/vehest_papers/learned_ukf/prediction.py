"""Figures 5 and 6: what learning through the filter changes about the model, and in which half of
the filter that matters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.estimators.learned_ukf import LearnedUkf
from vehest.evaluation.metrics import Protocol
from vehest.report.document import Figure
from vehest.report.style import DOUBLE_COLUMN, new_figure
from vehest.training.through_filter import Drive
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.candidates import SETS
from vehest_papers.learned_ukf.filtering import (
    MOVING,
    filtered,
    one_step_squares,
    squares_of,
    swapped,
    weighted,
)

BEFORE = paper.NNTF
AFTER = paper.NNTF_U
PLAIN_BLUE = "#0b4f9c"
THROUGH_RED = "#b3122a"
TASKS = {"one_step": "one-step prediction", "estimation": "estimation"}

Pair = tuple[LearnedUkf, LearnedUkf]  # NNTF and NNTF_U of one seed


@dataclass(frozen=True)
class Compared:
    """NNTF and NNTF_U on a test set."""

    # of both, mean squared errors as predictors by seed, sequence and state, (2, S, B, 4)
    one_step: FloatArray
    estimation: FloatArray  # the same of their filters
    swaps: Mapping[
        tuple[int, int], FloatArray
    ]  # (which predicts, which observes) -> weighted MSE by seed and sequence, (S, B); 0 is NNTF


def compared(
    pairs: Mapping[int, Pair], drives: Mapping[str, Drive], protocol: Protocol
) -> dict[str, Compared]:
    """Losses of both models as predictors and in their filters, and of all four filters that can be
    put together of them.

    Parameters
    ----------
    pairs
        Seed -> NNTF and NNTF_U of that seed.
    drives
        Test set -> its sequences.
    protocol
        Of which the seconds that are not scored are used; one-step predictions are scored from the
        first sample on.
    """
    skip = round(protocol.skip_seconds * protocol.rate_hz)
    by_test = {}
    for test, sequences in drives.items():
        predicted = np.array(
            [[one_step_squares(pair[k], sequences) for pair in pairs.values()] for k in (0, 1)]
        )
        estimated: dict[tuple[int, int], list[FloatArray]] = {}
        for pair in pairs.values():
            results = {(0, 0): filtered(pair[0], sequences), (1, 1): filtered(pair[1], sequences)}
            results |= {(a, b): swapped(pair[a], pair[b], sequences) for a, b in ((0, 1), (1, 0))}
            for key, result in results.items():
                estimated.setdefault(key, []).append(
                    squares_of(result.steps.filtered.mean, sequences, skip)
                )
        estimation = np.array([estimated[0, 0], estimated[1, 1]])
        by_test[test] = Compared(
            predicted,
            estimation,
            {key: weighted(np.array(squares)) for key, squares in estimated.items()},
        )
    return by_test


def frames(
    by_test: Mapping[str, Compared], seeds: Sequence[int]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The values behind Figures 5 and 6.

    Returns
    -------
    states : DataFrame
        One row a test set, seed, state and task: ``before`` and ``after``, the mean squared errors
        of NNTF and NNTF_U, and ``decrease`` [%].
    swaps : DataFrame
        One row a test set, seed, ``predicts`` and ``observes``: ``mse`` (weighted).
    """
    names = (BEFORE, AFTER)
    states = []
    swaps = []
    for test, of_test in by_test.items():
        for place, seed in enumerate(seeds):
            for task in TASKS:
                before, after = (part[place].mean(axis=0) for part in getattr(of_test, task))
                for state, first, second in zip(MOVING, before, after, strict=True):
                    row = {
                        "test_set": test,
                        "seed": seed,
                        "task": task,
                        "state": state,
                        "before": first,
                        "after": second,
                    }
                    states.append(row | {"decrease": 100.0 * (1.0 - second / first)})
            swaps += [
                {
                    "test_set": test,
                    "seed": seed,
                    "predicts": names[a],
                    "observes": names[b],
                    "mse": float(mse[place].mean()),
                }
                for (a, b), mse in of_test.swaps.items()
            ]
    return pd.DataFrame(states), pd.DataFrame(swaps)


def figure_5(states: pd.DataFrame, name: str, data: str) -> Figure:
    """By how much learning through the filter lowers each state's error, as a predictor and as an
    estimator.
    """
    tests = list(dict.fromkeys(states["test_set"]))
    with new_figure(DOUBLE_COLUMN, 2.7) as figure:
        grid = figure.subplots(1, len(tests), sharey=True, squeeze=False)[0]
        for axes, test in zip(grid, tests, strict=True):
            for offset, (task, label), colour in zip(
                (-0.2, 0.2), TASKS.items(), (PLAIN_BLUE, THROUGH_RED), strict=True
            ):
                of_task = states[(states["test_set"] == test) & (states["task"] == task)]
                for place, state in enumerate(MOVING):
                    values = of_task[of_task["state"] == state]["decrease"].to_numpy()
                    axes.bar(
                        place + offset,
                        np.median(values),
                        0.36,
                        color=colour,
                        alpha=0.75,
                        label=label if not place else None,
                    )
                    axes.scatter(
                        np.full(len(values), place + offset),
                        values,
                        s=7,
                        color="black",
                        zorder=3,
                        linewidths=0,
                    )
            axes.axhline(0.0, color="#444444", linewidth=0.7)
            axes.set_xticks(range(len(MOVING)), ["$v_x$", "$v_y$", "yaw rate", "rim speed"])
            axes.set_title(SETS[test], loc="left")
            axes.grid(visible=False, axis="x")
            if states["decrease"].min() < -100.0:
                axes.set_yscale("symlog", linthresh=100.0)
                axes.set_yticks(_ticks(states["decrease"].to_numpy()))
                axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}".replace("-", "−"))
                axes.minorticks_off()
        grid[0].set_ylabel(f"decrease of the MSE, {BEFORE} to {AFTER} [%]")
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    caption = (
        f"By how much the mean squared error is lower with {AFTER} than with {BEFORE}, Figure 5 "
        "of the paper; negative: higher. Prediction of the next sample from the true state, and "
        "estimation by the filter. Bars: median of seeds, dots: seeds; where values go below "
        "−100 %, the axis is logarithmic beyond. The paper draws differences; here they are "
        f"divided by the error of {BEFORE}. Data: {data}."
    )
    return Figure(f"figure_5_{name}", caption, figure)


def figure_6(swaps: pd.DataFrame, name: str, data: str) -> Figure:
    """MSE of the four filters that can be put together of two models."""
    tests = list(dict.fromkeys(swaps["test_set"]))
    combinations = [(a, b) for a in (BEFORE, AFTER) for b in (BEFORE, AFTER)]
    with new_figure(DOUBLE_COLUMN, 2.8) as figure:
        grid = figure.subplots(1, len(tests), squeeze=False)[0]
        for axes, test in zip(grid, tests, strict=True):
            for place, (predicts, observes) in enumerate(combinations):
                values = _of(swaps, test, predicts, observes)
                border, hatch = (
                    PLAIN_BLUE if role == BEFORE else THROUGH_RED for role in (predicts, observes)
                )
                axes.bar(
                    place,
                    np.median(values),
                    0.66,
                    facecolor="none",
                    edgecolor=hatch,
                    hatch="////",
                    linewidth=0,
                )
                axes.bar(
                    place,
                    np.median(values),
                    0.66,
                    facecolor="none",
                    edgecolor=border,
                    linewidth=1.8,
                )
                axes.scatter(
                    np.full(len(values), place), values, s=9, color="black", zorder=3, linewidths=0
                )
            axes.set_xticks(range(4), [f"{a}\n{b}" for a, b in combinations], linespacing=1.5)
            axes.set_title(SETS[test], loc="left")
            axes.grid(visible=False, axis="x")
            axes.set_ylabel("MSE (weighted)")
            axes.set_ylim(bottom=0.0)
        figure.supxlabel(
            "above: the model that predicts, and its noise; below: the model that observes",
            fontsize=7.5,
        )
    caption = (
        "MSE (weighted) of filters that predict with one model and observe with another, Figure "
        "6 of the paper: border, the model of the prediction step; hatching, that of the "
        f"observation; blue {BEFORE}, red {AFTER}, of one seed each. Noise is that of the filter "
        f"whose model predicts. Bars: median of seeds, dots: seeds. Data: {data}."
    )
    return Figure(f"figure_6_{name}", caption, figure)


def _of(
    swaps: pd.DataFrame, test: str, predicts: str, observes: str
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    rows = swaps[
        (swaps["test_set"] == test)
        & (swaps["predicts"] == predicts)
        & (swaps["observes"] == observes)
    ]
    return rows["mse"].to_numpy(dtype=np.float64)


def _ticks(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> list[float]:
    """Marks of an axis that is linear to 100 and logarithmic beyond."""
    low = float(np.min(values, initial=0.0))
    decades = [-(10.0**power) for power in range(3, 9) if -(10.0**power) >= 10.0 * low]
    return [*reversed(decades), -100.0, -50.0, 0.0, 50.0, 100.0]
