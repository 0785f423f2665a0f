"""The map over rear slip and stiffness error: where RATTE is significantly better, not different,
significantly worse.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pandas as pd

from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, MatplotlibFigure, fixed, new_figure
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.candidates import WITH_STATE
from vehest_papers.heavy_ekf.factorial import (
    ALL_ROADS,
    BETTER,
    GRIDS,
    MISMATCHES,
    NOT_DIFFERENT,
    SLIPS,
    WORSE,
    Cell,
    Change,
    Factorial,
    changes,
)

PAIRS = ((paper.RATTE, paper.RATT), (paper.RATTE, paper.LINT))
COLOURS = {BETTER: "#9ecae1", NOT_DIFFERENT: "#eeeeee", WORSE: "#fdae6b"}
MAP = (
    "Change of RATTE's RMSE(β) [%] against RATT (left) and LINT (right), SIMULATED, the paper's "
    "single-track model, level road, 20 seeds a cell, noise levels tuned on all roads and loads. "
    "Horizontal: largest rear slip. Vertical: error of the stiffness that the filters start from. "
    "Blue: RATTE is significantly better; orange: significantly worse; grey: no significant "
    "difference (Holm over the map)."
)
REGIONS = (
    "Cells of the map (of 49) in which RATTE is significantly better / not different / "
    "significantly worse, SIMULATED, and the lowest power of a cell to detect the paper's 44 % "
    "(RATT) and 65 % (LINT). With the crossfall state, both filters of a pair have it."
)
Changes = dict[tuple[int, tuple[str, str]], Change]


def map_figure(twin: Factorial) -> Figure:
    """Two panels, RATTE against RATT and against LINT."""
    cells = twin.grid()
    return Figure("twin_map", MAP, _drawn(cells, changes(cells, PAIRS)))


def _drawn(cells: Sequence[Cell], of_cells: Changes) -> MatplotlibFigure:
    from matplotlib.patches import Patch, Rectangle

    with new_figure(DOUBLE_COLUMN, 3.3) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, pair in zip(panels, PAIRS, strict=True):
            for position, cell in enumerate(cells):
                change = of_cells[position, pair]
                x = SLIPS.index(cell.slip)
                y = MISMATCHES.index(cell.mismatch)
                colour = COLOURS[change.outcome]
                axes.add_patch(
                    Rectangle((x - 0.5, y - 0.5), 1.0, 1.0, facecolor=colour, edgecolor="white")
                )
                percent = fixed(100.0 * (change.ratio - 1.0), 0)
                axes.text(x, y, percent, ha="center", va="center", fontsize=6.5, color="#111111")
            axes.set_title(f"{pair[0]} against {pair[1]}", loc="left")
            axes.set_xticks(range(len(SLIPS)), [f"{slip:g}" for slip in SLIPS])
            axes.set_xlabel("largest rear slip [deg]")
            axes.set_xlim(-0.5, len(SLIPS) - 0.5)
            axes.set_ylim(-0.5, len(MISMATCHES) - 0.5)
            axes.grid(visible=False)
            axes.tick_params(length=0)
            axes.spines[:].set_visible(False)
        labels = [fixed(100 * mismatch, 0) for mismatch in MISMATCHES]
        panels[0].set_yticks(range(len(MISMATCHES)), labels)
        panels[0].set_ylabel("error of the assumed stiffness [%]")
        patches = [Patch(facecolor=colour, label=name) for name, colour in COLOURS.items()]
        figure.legend(handles=patches, loc="outside upper center", ncols=3, frameon=False)
    return figure


def counts(of_cells: Changes, pair: tuple[str, str]) -> Counter[str]:
    """Outcome -> number of cells."""
    return Counter(change.outcome for (_, of_pair), change in of_cells.items() if of_pair == pair)


def regions_table(twin: Factorial) -> Table:
    """Counts of outcomes on other roads, with and without the crossfall state, and by tuning."""
    rows = []
    for road, tuned_on in GRIDS:
        cells = twin.grid(road, tuned_on)
        for state in ("", WITH_STATE) if tuned_on == ALL_ROADS else ("",):
            pairs = [(first + state, second + state) for first, second in PAIRS]
            of_cells = changes(cells, pairs)
            row: dict[str, object] = {
                "road": road,
                "state": "on" if state else "off",
                "tuned": tuned_on,
            }
            for pair, (_, title) in zip(pairs, PAIRS, strict=True):
                of_pair = counts(of_cells, pair)
                numbers = [of_pair[outcome] for outcome in (BETTER, NOT_DIFFERENT, WORSE)]
                row[title] = " / ".join(str(number) for number in numbers)
                powers = [change.power for (_, key), change in of_cells.items() if key == pair]
                row[f"power_{title}"] = 100.0 * min(powers)
            row["median"] = float(np.median([cell.rmse(paper.RATTE + state) for cell in cells]))
            rows.append(row)
    columns = {
        "road": Column("road"),
        "state": Column("crossfall state"),
        "tuned": Column("noise tuned on"),
        paper.RATT: Column("against RATT"),
        f"power_{paper.RATT}": Column("power [%]", decimals=0),
        paper.LINT: Column("against LINT"),
        f"power_{paper.LINT}": Column("power [%]", decimals=0),
        "median": Column("RATTE, median RMSE(β) [deg]", decimals=2),
    }
    return Table("twin_regions", REGIONS, pd.DataFrame(rows), columns)


def map_cells(twin: Factorial) -> pd.DataFrame:
    """A row a cell and pair of the map, with its interval, outcome and power."""
    cells = twin.grid()
    return pd.DataFrame(
        {
            "slip_deg": cells[position].slip,
            "mismatch_percent": 100.0 * cells[position].mismatch,
            "first": pair[0],
            "second": pair[1],
            "rmse_first_deg": cells[position].rmse(pair[0]),
            "rmse_second_deg": cells[position].rmse(pair[1]),
            "ratio": change.ratio,
            "low": change.low,
            "high": change.high,
            "outcome": change.outcome,
            "power": change.power,
        }
        for (position, pair), change in changes(cells, PAIRS).items()
    )
