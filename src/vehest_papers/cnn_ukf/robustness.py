"""Figure 14: what becomes of the errors where the filters' cornering stiffnesses are off."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator
from vehest.estimators.filtering.dugoff_fit import DUGOFF_PARAMETERS
from vehest.estimators.model_files import load_model
from vehest.evaluation.manoeuvres import kpis, manoeuvres_of
from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, fixed, legend_above, new_figure, paper_style
from vehest.studies.kit.reading import median_and_range
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.subjects import LINES, TEST, Prepared, Runs, filter_of

STEPS = (-paper.STIFFNESS_STEP, 0.0, paper.STIFFNESS_STEP)
COMBINATIONS = tuple(itertools.product(STEPS, STEPS))
"""Shares by which the front and the rear axle's cornering stiffness are off."""
NOMINAL = COMBINATIONS.index((0.0, 0.0))

WITHOUT_FILTER = (paper.DATA,)


def with_stiffness(fitted: Estimator, front: float, rear: float) -> Estimator:
    """A copy of a filter whose cornering stiffnesses are off by shares of their values.

    Raises:
        DataError: it has none.
    """
    changed = copy.deepcopy(fitted)
    of_filter = filter_of(changed)
    if of_filter is None:
        raise DataError(f"estimator '{fitted.name}' has no cornering stiffness")
    of_filter.tyres[[0, len(DUGOFF_PARAMETERS)]] *= 1.0 + np.array([front, rear])
    return changed


def errors(runs: Runs, prepared: Prepared) -> pd.DataFrame:
    """MSE and MSE_nl of every run with every combination; a network alone has the same with all.

    Returns:
        Columns: candidate, seed, front, rear, mse, mse_nonlinear.
    """
    drives = prepared.seen(TEST)
    rows = []
    for candidate, own in runs.items():
        for run in own:
            fitted = None if candidate in WITHOUT_FILTER else load_model(run.model.model_folder)
            for front, rear in COMBINATIONS:
                found = run.kpis
                if fitted is not None and (front, rear) != (0.0, 0.0):
                    parts = prepared.score(_estimates(with_stiffness(fitted, front, rear), drives), TEST)
                    found = kpis(manoeuvres_of(prepared.spans(TEST), parts))
                row = {"candidate": candidate, "seed": run.model.seed, "front": front, "rear": rear}
                rows.append(row | {"mse": found.mse, "mse_nonlinear": found.mse_nonlinear})
    return pd.DataFrame(rows)


def _estimates(estimator: Estimator, drives: Sequence[Recording]) -> list[Estimate]:
    return estimator.estimate(list(drives))


def figure_14(table: pd.DataFrame, data: str) -> Figure:
    """MSE and MSE_nl over the combinations, medians of seeds with their range."""
    labels = [f"{100 * front:+.0f}\n{100 * rear:+.0f}" for front, rear in COMBINATIONS]
    with paper_style():
        figure = new_figure(DOUBLE_COLUMN, 3.0)
        panels = figure.subplots(1, 2)
        for axes, column, label in zip(panels, ("mse", "mse_nonlinear"), ("MSE [deg²]", "MSE$_{nl}$ [deg²]"), strict=True):
            for candidate in dict.fromkeys(table["candidate"]):
                line = LINES[candidate]
                seeds = _by_combination(table, candidate, column)
                middle, low, high = (function(seeds, axis=1) for function in (np.median, np.min, np.max))
                at = np.arange(len(COMBINATIONS))
                axes.fill_between(at, low, high, color=line.colour, alpha=0.15, linewidth=0)
                axes.plot(at, middle, color=line.colour, linestyle=line.dash, marker=line.marker, label=candidate)
            axes.set_xticks(range(len(labels)), labels)
            axes.set_xlabel("front (above) and rear stiffness off by [%]")
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
        legend_above(figure, panels[0], columns=5)
    caption = (
        "Errors of the test where cornering stiffnesses of the axles in the filters are off by 10 % (Figure 14 of the paper): medians of "
        f"seeds, bands from the lowest to the highest. Nothing is trained again. Data: {data}."
    )
    return Figure("figure_14", caption, figure)


def sensitivity_table(table: pd.DataFrame, data: str) -> Table:
    """How far errors move over the combinations: as identified, best, worst, and the worst one.

    Args:
        table: from `errors`.
        data: real or simulated.
    """
    rows = []
    for candidate in dict.fromkeys(table["candidate"]):
        row: dict[str, object] = {"candidate": candidate}
        for column in ("mse", "mse_nonlinear"):
            seeds = _by_combination(table, candidate, column)
            nominal = seeds[NOMINAL]
            row |= {f"{column}_nominal": median_and_range(nominal, 3), f"{column}_worst": median_and_range(seeds.max(axis=0), 3)}
            row[f"{column}_range"] = float(np.median(np.ptp(seeds, axis=0)))
            row[f"{column}_ratio"] = float(np.median(seeds.max(axis=0) / nominal))
            worst = int(np.median(seeds, axis=1).argmax())
            row[f"{column}_where"] = " / ".join(f"{100 * share:+.0f} %" for share in COMBINATIONS[worst])
        rows.append(row)
    columns = {"candidate": Column("method")}
    for column, header in (("mse", "MSE"), ("mse_nonlinear", "MSE_nl")):
        columns |= {
            f"{column}_nominal": Column(f"{header}, as identified [deg²]"),
            f"{column}_worst": Column("worst combination [deg²]"),
            f"{column}_where": Column("which, front / rear"),
            f"{column}_range": Column("worst - best [deg²]", decimals=3),
            f"{column}_ratio": Column("worst over as identified", decimals=2),
        }
    caption = f"How errors move where cornering stiffnesses are off: medians of seeds, lowest and highest. Data: {data}."
    return Table("sensitivity", caption, pd.DataFrame(rows), columns)


def in_words(table: pd.DataFrame) -> str:
    """Whether hybrids depend on the tyres less than the model does, and CNN-UKF stays below DE-UKF, as in the paper."""
    names = [name for name in (paper.MODEL, paper.SMOOTH, paper.DEEP, paper.CNN) if name in set(table["candidate"])]
    sentences = []
    for column, header in (("mse", "MSE"), ("mse_nonlinear", "MSE_nl")):
        found = {name: _by_combination(table, name, column) for name in names}
        shown = ", ".join(
            f"{name} {fixed(float(np.median(np.ptp(own, axis=0))), 3)} deg² ({fixed(float(np.median(own.max(axis=0) / own[NOMINAL])), 2)})"
            for name, own in found.items()
        )
        sentences.append(f"Worst less best {header} over the nine combinations, and worst over that as identified in brackets: {shown}.")
        if paper.DEEP in found and paper.CNN in found:
            below = int((np.median(found[paper.CNN], axis=1) < np.median(found[paper.DEEP], axis=1)).sum())
            known = "all" if column == "mse_nonlinear" else "all but that with both axles 10 % stiffer"
            sentences.append(f"CNN-UKF lies below DE-UKF in {below} of {len(COMBINATIONS)} combinations (paper: in {known}).")
    words = " ".join(sentences)
    return f"The paper's hybrids depend on the tyres less than its model does, its DE-UKF least. Here, medians of seeds: {words}"


def _by_combination(table: pd.DataFrame, candidate: str, column: str) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Of the combinations by seeds, (9, S)."""
    own = table[table["candidate"] == candidate].pivot(index=["front", "rear"], columns="seed", values=column)
    return own.loc[list(COMBINATIONS)].to_numpy(dtype=np.float64)
