"""The factorial experiment on the twin: every filter over rear slip, stiffness error and crossfall,
20 seeds a cell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.evaluation.significance import CONFIDENCE, Contrast, holm, mean_contrast
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.candidates import (
    FILTERS,
    WITH_STATE,
    MeasuredDrive,
    Tuned,
    baselines,
    measured_drive,
    mistaken,
    sideslip_of,
    tuned,
    tuning_drives,
)
from vehest_papers.heavy_ekf.twin import Conditions, drive

SLIPS = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)  # deg
MISMATCHES = (-0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2)
SEEDS = 20
ALL_ROADS = "all roads and loads"
TESTED_ROAD = "the road tested"
LEVEL = "level"
CROSSFALL = "1° crossfall"
GRIDS = ((LEVEL, ALL_ROADS), (LEVEL, TESTED_ROAD), (CROSSFALL, ALL_ROADS))
"""Road and what the noise levels are tuned on, of every map."""
BETTER = "better"
WORSE = "worse"
NOT_DIFFERENT = "not significantly different"


@dataclass(frozen=True, eq=False)
class Cell:
    """Errors of all candidates in a cell, seed by seed."""

    road: str
    tuned_on: str  # what the noise levels are tuned on
    slip: float  # largest rear slip that the driver is to hold [deg]
    mismatch: float  # of the filters' stiffnesses
    squared: Mapping[str, FloatArray]  # candidate -> mean squared error of β of each seed [deg²]
    largest_slip: float  # that the driver reaches [deg], mean over seeds

    def rmse(self, name: str) -> float:
        """RMSE(β) over all seeds [deg]."""
        return math.sqrt(float(self.squared[name].mean()))


@dataclass(frozen=True)
class Change:
    """Ratio of the first filter's RMSE(β) to the second's in a cell."""

    ratio: float  # geometric mean over seeds
    low: float  # of its interval, corrected by Holm over the map
    high: float
    outcome: str  # `BETTER`, `WORSE` or `NOT_DIFFERENT`
    power: float  # to detect the paper's ratio at the level that Holm's correction asks at most


@dataclass(frozen=True, eq=False)
class Factorial:
    """Tuned noise levels and the cells of all maps."""

    tuned: Mapping[str, Mapping[str, Tuned]]  # what they are tuned on -> filter -> outcome
    cells: Sequence[Cell]

    def grid(self, road: str = LEVEL, tuned_on: str = ALL_ROADS) -> list[Cell]:
        """Cells of one map, by mismatch, then by slip."""
        cells = [cell for cell in self.cells if (cell.road, cell.tuned_on) == (road, tuned_on)]
        return sorted(cells, key=lambda cell: (cell.mismatch, cell.slip))


@cache
def factorial() -> Factorial:
    """Tune the filters and run them in every cell; minutes, once a process."""
    tuned_by_roads = {
        ALL_ROADS: {name: tuned(name, tuning_drives()) for name in FILTERS},
        TESTED_ROAD: {name: tuned(name, tuning_drives(plain=True)) for name in paper.ORDER},
    }
    cells = []
    for road in (LEVEL, CROSSFALL):
        tunings = [tuned_on for grid_road, tuned_on in GRIDS if grid_road == road]
        for slip in SLIPS:
            cells += _cells({name: tuned_by_roads[name] for name in tunings}, road, slip)
    return Factorial(tuned_by_roads, cells)


def _cells(tunings: Mapping[str, Mapping[str, Tuned]], road: str, slip: float) -> list[Cell]:
    """Cells of one road and slip: all mismatches, for each tuning."""
    conditions = Conditions(slip, crossfall=road == CROSSFALL)
    drives = [drive(conditions, seed) for seed in range(SEEDS)]
    recordings = [of_seed.recording for of_seed in drives]
    largest_slip = float(
        np.degrees(np.mean([np.abs(of_seed.rear_slip).max() for of_seed in drives]))
    )
    cells = []
    for mismatch in MISMATCHES:
        curves = mistaken(mismatch)
        measured = [measured_drive(recording, curves) for recording in recordings]
        of_baselines = {
            name: _squared_errors(measured, [estimate(drive) for drive in measured])
            for name, estimate in _baselines().items()
        }
        for tuned_on, levels in tunings.items():
            squared = {
                name: _squared_errors(
                    measured, [sideslip_of(name, of_filter.levels, drive) for drive in measured]
                )
                for name, of_filter in levels.items()
            }
            cells.append(Cell(road, tuned_on, slip, mismatch, squared | of_baselines, largest_slip))
    return cells


def _squared_errors(drives: Sequence[MeasuredDrive], estimates: Sequence[FloatArray]) -> FloatArray:
    """Mean squared error of β of each drive [deg²], (S,)."""
    return np.array(
        [drive.rmse(sideslip) ** 2 for drive, sideslip in zip(drives, estimates, strict=True)]
    )


@cache
def _baselines():  # type: ignore[no-untyped-def]
    seeds = range(3000, 3003)
    return baselines([drive(Conditions(slip), seed).recording for seed in seeds for slip in SLIPS])


def changes(
    cells: Sequence[Cell], pairs: Sequence[tuple[str, str]]
) -> dict[tuple[int, tuple[str, str]], Change]:
    """Change of the RMSE(β) in each cell for each pair of filters, paired over seeds.

    Parameters
    ----------
    cells
        Of one map.
    pairs
        First and second filter; their p-values in all cells are one family of Holm's correction.

    Returns
    -------
    dict
        (position of the cell, pair) -> change.
    """
    keys = [(position, pair) for position in range(len(cells)) for pair in pairs]
    contrasts = [
        mean_contrast(
            0.5 * np.log(cells[position].squared[first])[None],
            0.5 * np.log(cells[position].squared[second])[None],
        )
        for position, (first, second) in keys
    ]
    corrected = holm([contrast.p_value for contrast in contrasts])
    level = (1.0 - CONFIDENCE) / len(keys)
    return {
        key: _change(contrast, p_value, level, key[1])
        for key, contrast, p_value in zip(keys, contrasts, corrected, strict=True)
    }


def _change(contrast: Contrast, p_value: float, level: float, pair: tuple[str, str]) -> Change:
    """A contrast of logarithms with Holm's correction as a change.

    The interval has the confidence that the correction leaves this cell; the power is that of
    detecting the paper's ratio at ``level``, that of Bonferroni.
    """
    factor = max(p_value / contrast.p_value, 1.0) if contrast.p_value > 0 else 0.05 / level
    low, high = contrast.interval(1.0 - (1.0 - CONFIDENCE) / factor)
    outcome = NOT_DIFFERENT
    if p_value < 1.0 - CONFIDENCE:
        outcome = BETTER if contrast.value < 0 else WORSE
    first, second = (name.removesuffix(WITH_STATE) for name in pair)
    effect = math.log(1.0 - paper.GAINS[first, second] / 100.0)
    ratio, low, high = (math.exp(value) for value in (contrast.value, low, high))
    return Change(ratio, low, high, outcome, contrast.power(effect, level))


def every_cell(twin: Factorial) -> pd.DataFrame:
    """A row a cell: its conditions and RMSE(β) of every candidate [deg]."""
    return pd.DataFrame(
        {
            "road": cell.road,
            "tuned_on": cell.tuned_on,
            "slip_deg": cell.slip,
            "slip_reached_deg": cell.largest_slip,
            "mismatch_percent": 100.0 * cell.mismatch,
        }
        | {f"rmse_{column(name)}": cell.rmse(name) for name in cell.squared}
        for cell in twin.cells
    )


def column(name: str) -> str:
    """A candidate's name as part of a column's."""
    return name.lower().replace(WITH_STATE, "_crossfall_state").replace(" ", "_")
