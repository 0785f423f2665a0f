"""Which part of the gain is whose: tyre curve x process noise x hybrid; and the floor ε of the
angle's variance (Eq. 6).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.evaluation.blocks import MIN_BLOCKS
from vehest.evaluation.significance import mean_contrast
from vehest.report.document import Column, Table
from vehest_papers.cnn_ukf import measures, paper
from vehest_papers.cnn_ukf.indicators import MSE_NL, ManoeuvreErrors
from vehest_papers.cnn_ukf.networks import Outputs
from vehest_papers.cnn_ukf.subjects import name_in
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import Figure

NOT_TRAINED = "not trained yet"
HYBRIDS = {"none": paper.MODEL, "ensemble": paper.DEEP, "end to end": paper.CNN}
CURVES = ("plain", "smooth")
NOISES = {"paper": "paper's", "free": "free"}
Cell = tuple[str, str, str]  # tyre curve, process noise, hybrid
EFFECTS: Mapping[str, tuple[int, str, str]] = {
    "smooth over plain tyres": (0, "smooth", "plain"),
    "free over the paper's process noise": (1, "free", "paper"),
    "ensemble over no network": (2, "ensemble", "none"),
    "end to end over no network": (2, "end to end", "none"),
    "end to end over ensemble": (2, "end to end", "ensemble"),
}
"""Effect -> factor, and the two levels whose errors are compared."""
FLOORS = ("1e-6", "1e-7", "1e-8")  # rad²


def cell_name(cell: Cell) -> str:
    """Name of a cell's candidate among those of all parts."""
    curve, noise, hybrid = cell
    return name_in(f"factorial_{curve}_{noise}", HYBRIDS[hybrid])


def factorial_table(comparison: ManoeuvreErrors, data: str) -> Table:
    """MSE_nl of every cell, a row for tyre curve and process noise."""
    rows = []
    for curve in CURVES:
        for noise, words in NOISES.items():
            names = {hybrid: cell_name((curve, noise, hybrid)) for hybrid in HYBRIDS}
            row = {
                hybrid: comparison.text(name, MSE_NL) if name in comparison else NOT_TRAINED
                for hybrid, name in names.items()
            }
            rows.append({"curve": curve, "noise": words, **row})
    columns = {"curve": Column("tyres"), "noise": Column("process noise")}
    columns |= {hybrid: Column(f"network: {hybrid}") for hybrid in HYBRIDS}
    caption = f"MSE_nl [deg²] of the factorial, end to end with 60 epochs, one seed. Data: {data}."
    return Table("factorial", caption, pd.DataFrame(rows), columns)


def effects_table(comparison: ManoeuvreErrors, data: str) -> Table:
    """Ratio of MSE_nl between two levels of each factor, averaged over the cells of the others:
    table ``effects``, a row for each of `EFFECTS`.
    """
    rows = [
        {"effect": name, "ratio": figure_in_words(figure) if cells else NOT_TRAINED, "cells": cells}
        for name, (figure, cells) in effects_of(comparison).items()
    ]
    columns = {
        "effect": Column("effect"),
        "ratio": Column("ratio of MSE_nl"),
        "cells": Column("pairs of cells", decimals=0),
    }
    caption = (
        "Effects: geometric means over manoeuvres and the other factors, 95 % intervals. Data: "
        f"{data}."
    )
    return Table("effects", caption, pd.DataFrame(rows), columns)


def effects_of(comparison: ManoeuvreErrors) -> dict[str, tuple[Figure, int]]:
    """Effect -> its ratio, and how many pairs of cells it rests on.

    A pair are two cells that differ in the levels of one factor only. Pairs of which a cell is not
    trained yet are left out; an effect without pairs has the ratio NaN.
    """
    cells = [
        (curve, noise, hybrid)
        for curve in CURVES
        for noise in NOISES
        for hybrid in HYBRIDS
        if cell_name((curve, noise, hybrid)) in comparison
    ]
    effects = {}
    for name, (factor, first, second) in EFFECTS.items():
        pairs = [
            (cell, _with_level(cell, factor, second))
            for cell in cells
            if cell[factor] == first and _with_level(cell, factor, second) in cells
        ]
        effects[name] = _mean_ratio(comparison, pairs), len(pairs)
    return effects


def _with_level(cell: Cell, factor: int, level: str) -> Cell:
    levels = list(cell)
    levels[factor] = level
    return levels[0], levels[1], levels[2]


def _mean_ratio(comparison: ManoeuvreErrors, pairs: Sequence[tuple[Cell, Cell]]) -> Figure:
    """Geometric mean over pairs of cells and manoeuvres of the ratio of MSE_nl.

    Errors are means over seeds. Manoeuvres in which an error is 0 are left out. Logarithms are
    averaged over pairs first, so that the 95 % interval is that of the mean over manoeuvres;
    without `MIN_BLOCKS` of them there is none.
    """
    if not pairs:
        return Figure(math.nan, math.nan, math.nan)
    sums = [
        [comparison.errors(cell_name(cell), MSE_NL).sums.mean(axis=0) for cell in pair]
        for pair in pairs
    ]
    errors: FloatArray = np.array(sums)  # (pairs, 2, manoeuvres)
    logarithms = np.log(errors[:, :, (errors > 0.0).all(axis=(0, 1))]).mean(axis=0)
    if logarithms.shape[1] < MIN_BLOCKS:
        return Figure(math.exp(float(np.subtract(*logarithms).mean())), math.nan, math.nan)
    contrast = mean_contrast(*logarithms[:, None, :])
    low, high = contrast.interval()
    return Figure(math.exp(contrast.value), math.exp(low), math.exp(high))


def floor_table(
    comparison: ManoeuvreErrors,
    outputs: Mapping[str, Sequence[Sequence[Outputs]]],
    active: pd.DataFrame,
    data: str,
) -> Table:
    """Errors of both hybrids, quantiles of σ_DD and its rank correlation with the network's error,
    by ε (Eq. 6).

    Parameters
    ----------
    comparison
        Candidates of all parts on the test.
    outputs
        Candidate -> outputs of its network, seed by seed, manoeuvre by manoeuvre; candidates that
        are not in it are listed as not trained.
    active
        A row a candidate, with the quantiles of its σ_DD in words in ``distrust``.
    data
        Data sets, for the caption.
    """
    rows = []
    for hybrid in paper.HYBRIDS:
        for floor in FLOORS:
            candidate = _candidate_at(hybrid, floor)
            row: dict[str, object] = {"candidate": hybrid, "floor": floor}
            if candidate not in outputs:
                rows.append({**row, MSE_NL: NOT_TRAINED})
                continue
            distrust = str(active.set_index("candidate").loc[candidate, "distrust"])
            correlation = float(measures.distrust_correlations(outputs[candidate]).mean())
            error = comparison.text(candidate, MSE_NL)
            rows.append({**row, MSE_NL: error, "distrust": distrust, "correlation": correlation})
    columns = {
        "candidate": Column("method"),
        "floor": Column("ε [rad²]"),
        MSE_NL: Column("MSE_nl [deg²]"),
        "distrust": Column("σ_DD, 5 / 50 / 95 % [deg]"),
        "correlation": Column("rank correlation with the error", decimals=2),
    }
    caption = f"Floor ε of the variance; CNN-UKF with 60 epochs through the filter. Data: {data}."
    frame = pd.DataFrame(rows, columns=list(columns))
    return Table("floor", caption, frame, columns)


def _candidate_at(hybrid: str, floor: str) -> str:
    """The candidate with this ε whose training is alike in all else."""
    if floor != FLOORS[0]:
        return name_in(f"floor_{floor}", hybrid)
    return cell_name(("smooth", "paper", "end to end")) if hybrid == paper.CNN else hybrid
