"""What the factorial twin shows: the map of slip and stiffness, rows of all candidates, what else moves the region, what RATTE absorbs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, MatplotlibFigure, fixed, new_figure
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.candidates import (
    DATA_SHEET,
    DRAWN,
    FILTERS,
    ORACLE,
    REFINED,
    STATIC_MAP,
    WITH_STATE,
    ZERO,
    table_of,
)
from vehest_papers.heavy_ekf.factorial import (
    LOST_DEGREES,
    MISMATCHES,
    ONCE,
    PAIRS,
    PLAIN,
    PLAIN_ONLY,
    PLANTS,
    SEEDS,
    SLIPS,
    Cell,
    Change,
    Factorial,
    absorbed,
    changes,
    interval,
)
from vehest_papers.heavy_ekf.twin import CG_HEIGHT, NOISE, SECONDS, TRACK, Plant
from vehest_papers.kit.reading import with_interval

DATA = "SIMULATED, the paper's single track"
LIMIT = 100.0  # %, where the colours end
CLAIMED = ((paper.RATTE, paper.RATT), (paper.RATTE, paper.LINT))
SHOWN = (
    (2.0, -0.2),
    (5.0, -0.2),
    (8.0, -0.2),
    (5.0, 0.0),
)  # slip and mismatch of the cells whose rows are shown
ROWS = (ZERO, STATIC_MAP, DATA_SHEET, *FILTERS, ORACLE)
Changes = dict[tuple[int, tuple[str, str]], Change]

ASKED_BEFOREHAND = (
    "**Asked before the twin was run: could it come out the other way?** Yes. At small slip a rational tyre is a linear one, and RATTE has "
    "two more parameters that nothing shows: it may lose to LINT. With the right stiffness RATT is the oracle, and RATTE can only lose to "
    "it. With levels of noise that let LINT's stiffness follow the secant of the curve, LINT may do without the curve. A crossfall, which "
    "no filter of the paper knows, looks like tyres. Each of these would show as a cell that is not blue."
)


def twin_blocks(
    own: Factorial,
) -> tuple[list[Block], dict[str, pd.DataFrame], list[Block]]:
    """What stands in front, tables that are written alone, and the appendix."""
    cells = _flat(own.grid())
    found = changes(cells, PAIRS)
    absorbed_table, absorbed_words = _absorbed_blocks(own)
    front: list[Block] = [
        "## Where RATTE beats RATT and LINT",
        ASKED_BEFOREHAND,
        _map(cells, found, "twin_map", ONCE),
        _in_words(found),
        _crossfall_in_words(own),
        absorbed_words,
        _rows(own),
    ]
    plain = _flat(own.grid(PLAIN, PLAIN_ONLY))
    appendix: list[Block] = [
        "## Appendix: the twin",
        _plant_in_words(own),
        _regions(own),
        absorbed_table,
        _tuning(own),
        _map(plain, changes(plain, PAIRS), "twin_map_plain", PLAIN_ONLY),
    ]
    data = {"twin_map_cells": _map_cells(cells, found)}
    return front, data, appendix


def _flat(grid: Sequence[Sequence[Cell]]) -> list[Cell]:
    return [cell for row in grid for cell in row]


def _map_cells(cells: Sequence[Cell], found: Changes) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "slip_deg": cells[at].conditions.slip,
            "mismatch_percent": 100.0 * cells[at].mismatch,
            "first": pair[0],
            "second": pair[1],
            "rmse_first_deg": cells[at].rmse(pair[0]),
            "rmse_second_deg": cells[at].rmse(pair[1]),
            "change_percent": change.percent,
            "low": change.low,
            "high": change.high,
            "told_apart": change.told_apart,
        }
        for (at, pair), change in found.items()
    )


def _map(cells: Sequence[Cell], found: Changes, name: str, tuned_on: str) -> Figure:
    """Two panels: change of RATTE's RMSE(β) against RATT's and against LINT's over slip and mismatch."""
    shape = (len(MISMATCHES), len(SLIPS))
    values = {
        pair: np.array([found[at, pair].percent for at in range(len(cells))]).reshape(shape)
        for pair in CLAIMED
    }
    apart = {
        pair: np.array([found[at, pair].told_apart for at in range(len(cells))]).reshape(shape)
        for pair in CLAIMED
    }
    figure = _drawn(values, apart)
    caption = (
        f"Change of RATTE's RMSE(β) against RATT (left) and LINT (right), {DATA}, {SEEDS} seeds a cell; dry, flat, without payload. "
        "Horizontal: largest rear slip; vertical: by how much the filters' cornering stiffnesses differ from the plant's at the start. "
        "Blue: RATTE is better. Hatched: not told apart (paired over seeds, Holm over all cells and pairs of the map). Lines: the paper's "
        f"−44 % and −65 %; where there is none, no cell reaches it. Colours end at ±{LIMIT:.0f} %. Levels of noise tuned once on: "
        f"{tuned_on}."
    )
    return Figure(name, caption, figure)


def _drawn(
    values: dict[tuple[str, str], FloatArray], apart: dict[tuple[str, str], Any]
) -> MatplotlibFigure:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle

    with new_figure(DOUBLE_COLUMN, 3.1) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        colours: Any = ScalarMappable(Normalize(-LIMIT, LIMIT), "RdBu_r")
        for axes, pair in zip(panels, CLAIMED, strict=True):
            for (row, column), value in np.ndenumerate(values[pair]):
                colour = colours.to_rgba(float(np.clip(value, -LIMIT, LIMIT)))
                box = Rectangle(
                    (column - 0.5, row - 0.5),
                    1.0,
                    1.0,
                    facecolor=colour,
                    edgecolor="white",
                    linewidth=0.8,
                )
                if not apart[pair][row, column]:
                    box.set(hatch="////", edgecolor="#333333", linewidth=0.0)
                axes.add_patch(box)
                ink = "white" if abs(value) > 65.0 else "#111111"
                axes.text(
                    column,
                    row,
                    fixed(float(value), 0),
                    ha="center",
                    va="center",
                    fontsize=6.5,
                    color=ink,
                )
            level = -paper.GAINS[pair]
            if values[pair].min() < level < values[pair].max():
                lines = axes.contour(values[pair], levels=[level], colors="black", linewidths=1.4)
                axes.clabel(lines, fmt=lambda at: f"{at:.0f} %", fontsize=6.5)
            axes.set_title(
                f"{pair[0]} against {pair[1]}; paper −{paper.GAINS[pair]:.0f} %", loc="left"
            )
            axes.set_xticks(range(len(SLIPS)), [f"{slip:g}" for slip in SLIPS])
            axes.set_xlabel("largest rear slip [deg]")
            axes.set_xlim(-0.5, len(SLIPS) - 0.5)
            axes.set_ylim(-0.5, len(MISMATCHES) - 0.5)
            axes.grid(visible=False)
            axes.tick_params(length=0)
            axes.spines[:].set_visible(False)
        panels[0].set_yticks(
            range(len(MISMATCHES)), [f"{100 * mismatch:+.0f}" for mismatch in MISMATCHES]
        )
        panels[0].set_ylabel("filters' stiffness [%]")
        figure.colorbar(
            colours, ax=list(panels), label="change of RMSE(β) [%]", pad=0.02, aspect=25
        ).outline.set_visible(False)
    return figure


def _counts(found: Changes, pair: tuple[str, str]) -> tuple[int, int, int]:
    """Cells in which the first is better, worse, and better by as much as in the paper; each by more than chance."""
    own = [change for (_, of), change in found.items() if of == pair]
    better, worse = (
        sum(change.told_apart and sign * change.percent > 0.0 for change in own)
        for sign in (-1.0, 1.0)
    )
    return (
        better,
        worse,
        sum(
            change.told_apart and change.percent <= -paper.GAINS.get(pair, math.inf)
            for change in own
        ),
    )


def _in_words(found: Changes) -> str:
    sentences = []
    for pair in CLAIMED:
        own = [found[at, pair] for at in range(len(SLIPS) * len(MISMATCHES))]
        better, worse, claimed = _counts(found, pair)
        low = min(change.percent for change in own)
        high = max(change.percent for change in own)
        sentences.append(
            f"**{pair[0]} lies below {pair[1]} in {better} of {len(own)} cells and above it in {worse}**, by more than chance; in "
            f"{claimed} by the paper's {paper.GAINS[pair]:.0f} % or more (changes from {fixed(low, 0)} to {fixed(high, 0)} %)."
        )
    return " ".join(sentences) + " All figures of the map: [CSV](tables/twin_map_cells.csv)."


def _rows(own: Factorial) -> Table:
    grid = own.grid()
    cells = [grid[MISMATCHES.index(mismatch)][SLIPS.index(slip)] for slip, mismatch in SHOWN]
    rows = []
    for name in ROWS:
        row: dict[str, object] = {"candidate": name}
        for at, cell in enumerate(cells):
            row[f"cell_{at}"] = with_interval(cell.rmse(name), *interval(cell, name), 2)
        rows.append(row)
    columns = {"candidate": Column("candidate")}
    columns |= {
        f"cell_{at}": Column(f"{slip:g}°, {100 * mismatch:+.0f} % [deg]")
        for at, (slip, mismatch) in enumerate(SHOWN)
    }
    caption = (
        f"RMSE(β) with 95 % intervals over {SEEDS} seeds in four cells of the map, {DATA}. {ORACLE.capitalize()}: RATT with the plant's "
        "own curves; static map: fitted on the tuning drives; data sheet: wheelbase and centre of gravity; "
        f"`{WITH_STATE.removeprefix(', ')}`: one more state, beyond the paper."
    )
    return Table("twin_rows", caption, pd.DataFrame(rows), columns)


def _regions(own: Factorial) -> Table:
    """How the region moves with payload, friction and crossfall, with and without a state of crossfall."""
    rows = []
    for tuned_on, plants in ((ONCE, PLANTS), (PLAIN_ONLY, (PLAIN,))):
        for plant in plants:
            cells = _flat(own.grid(plant, tuned_on))
            for state in ("", WITH_STATE):
                pairs = [(first + state, second + state) for first, second in CLAIMED]
                found = changes(cells, pairs)
                row: dict[str, object] = {
                    "plant": _plant_name(plant),
                    "state": "yes" if state else "no",
                    "tuned": tuned_on,
                }
                for pair, (_, title) in zip(pairs, CLAIMED, strict=True):
                    row[title] = "{} / {}".format(*_counts(found, pair))
                for key, name in (
                    ("median", paper.RATTE + state),
                    ("median_lint", paper.LINT + state),
                    ("oracle", ORACLE),
                ):
                    row[key] = _median(cells, name)
                row["lost"] = 100.0 * float(
                    np.mean([cell.lost[paper.RATTE + state] for cell in cells])
                )
                rows.append(row)
    columns = {
        "plant": Column("plant and road"),
        "state": Column("crossfall state"),
        "tuned": Column("noise tuned on"),
        paper.RATT: Column("RATTE below / above RATT"),
        paper.LINT: Column("RATTE below / above LINT"),
        "median": Column("RATTE, median RMSE(β) [deg]", decimals=2),
        "median_lint": Column("LINT, median [deg]", decimals=2),
        "oracle": Column(f"{ORACLE}, median [deg]", decimals=2),
        "lost": Column(f"drives with RATTE {LOST_DEGREES:.0f}° off [%]", decimals=1),
    }
    caption = (
        f"In how many of {len(SLIPS) * len(MISMATCHES)} cells RATTE lies below or above the others by more than chance (Holm within each "
        f"row), {DATA}. No filter knows of the payload; the oracle knows the tyres under it and the friction, not the mass."
    )
    return Table("twin_regions", caption, pd.DataFrame(rows), columns)


def _median(cells: Sequence[Cell], name: str) -> float:
    return float(np.median([cell.rmse(name) for cell in cells]))


def _plant_name(plant: tuple[bool, bool, bool]) -> str:
    payload, wet, crossfall = plant
    return ", ".join(
        [
            "wet patches" if wet else "dry",
            "1° crossfall" if crossfall else "flat",
            *(["payload"] if payload else []),
        ]
    )


def _crossfall_in_words(own: Factorial) -> str:
    """Where the region goes with the road, and what a state of crossfall does."""
    moved = []
    for plant in ((False, False, True), (False, True, False), (True, False, False)):
        cells = _flat(own.grid(plant))
        found = changes(cells, CLAIMED)
        better = [_counts(found, pair)[:2] for pair in CLAIMED]
        moved.append(
            f"{_plant_name(plant)}: {better[0][0]} and {better[1][0]} (above in {better[0][1]} and {better[1][1]})"
        )
    parts = []
    for plant in ((False, False, True), (True, True, True)):
        cells = _flat(own.grid(plant))
        medians = [
            _median(cells, name)
            for name in (paper.RATTE, f"{paper.RATTE}{WITH_STATE}", f"{paper.LINT}{WITH_STATE}")
        ]
        parts.append(
            f"{_plant_name(plant)}: RATTE {fixed(medians[0], 2)}°, with the state {fixed(medians[1], 2)}°, LINT with the state "
            f"{fixed(medians[2], 2)}°"
        )
    return (
        f"Cells of {len(SLIPS) * len(MISMATCHES)} in which RATTE lies below RATT and below LINT on other roads: "
        + "; ".join(moved)
        + ". "
        "One state for the pull of the crossfall does more than the curve of the tyre: medians of RMSE(β) over the cells, "
        + "; ".join(parts)
        + "."
    )


def _absorbed_blocks(own: Factorial) -> tuple[Table, str]:
    levels = {name: tuned.levels for name, tuned in own.tuned[ONCE].items()}
    frame = absorbed(levels)
    frame["interval"] = [
        with_interval(row["change"], row["low"], row["high"], 0) for row in frame.to_dict("records")
    ]
    columns = {
        "mistake": Column("what is wrong"),
        paper.LINT: Column("LINT [deg]", decimals=3),
        paper.RATT: Column("RATT [deg]", decimals=3),
        paper.RATTE: Column("RATTE [deg]", decimals=3),
        "interval": Column("RATTE against RATT [%]"),
        "fit_front": Column("c2F of the fit [%]", decimals=0),
        "fit_rear": Column("c2R of the fit [%]", decimals=0),
        "end_front": Column("c2F at the end [%]", decimals=0),
        "end_rear": Column("c2R at the end [%]", decimals=0),
    }
    caption = (
        f"Tyres that are right, something else that is wrong: RMSE(β) against the truth at 5° of rear slip, {DATA}, {SEEDS} seeds, and "
        "by how much RATTE's stiffnesses "
        "differ from the plant's in the fit that it starts from and in the last 20 s. Intervals: Holm within the table."
    )
    rows = frame.to_dict("records")
    usual = float(rows[0]["change"])  # of the row in which nothing is wrong
    absorbing = [
        str(row["mistake"])
        for row in rows[1:]
        if row["high"] < min(usual, 0.0) and max(abs(row["end_front"]), abs(row["end_rear"])) > 5.0
    ]
    harmed = [str(row["mistake"]) for row in rows if row["low"] > 0.0]
    words = ""
    if absorbing:
        words = (
            "Absorbed, by more than chance beyond what RATTE gains where nothing is wrong, with stiffnesses that end more than 5 % off: "
            + "; ".join(absorbing)
            + ". "
        )
    if harmed:
        words += "Adapting harms under: " + "; ".join(harmed) + "."
    return Table("twin_absorbed", caption, frame, columns), "**What RATTE absorbs.** " + (
        words or "Neither gain nor harm is told apart."
    )


def _plant_in_words(own: Factorial) -> str:
    empty = Plant.of(payload=False)
    laden = Plant.of(payload=True)
    largest = max(cell.reached[2] for cell in own.cells)
    lifts = 9.80665 * TRACK / (2.0 * largest)
    noise = f"{math.degrees(NOISE['yaw_rate']):.2g}°/s, {NOISE['ay']:g} m/s², {math.degrees(NOISE['steer']):.2g}° and {NOISE['vx']:g} m/s"
    reached = sorted(
        {(cell.conditions.slip, round(cell.reached[0], 1)) for cell in _flat(own.grid())}
    )
    return (
        f"The plant is Equations 1, 2, 4 to 6 with Table 1's curves, by Runge and Kutta at 400 Hz; drives of {SECONDS:g} s at 10.5 to 28 "
        f"m/s, sampled at 20 Hz; white noise of {noise} on yaw rate, a_y, steering and speed, assumed. A driver holds the rear slip of "
        "bends to either side, drawn by the seed, by countersteering where it must; reached are "
        f"{', '.join(f'{value:g}° for {slip:g}°' for slip, value in reached)} (means over seeds). **No cell rolls over**: inner wheels "
        f"lift at a_y = g t/(2h) = {empty.roll_over:.1f} m/s² (track {TRACK:g} m, centre of gravity at {CG_HEIGHT:g} m, both assumed) and "
        f"{laden.roll_over:.1f} with the payload (h {laden.cg_height:.2f} m), while the axles cannot make more than (39.0 + 38.6) kN over "
        f"7.9 t, {empty.slides_at:.1f} m/s²: it slides first. The largest a_y of all drives is {largest:.1f} m/s², so the bound holds for "
        f"a centre of gravity below {lifts:.2f} m; a higher one rolls before the rear slip of the steeper cells. Payload: a quarter of the "
        "mass, 1 m behind the centre of gravity and 1.4 m above the road; axle curves grow with the load (Eq. 4). Wet patches: friction "
        "0.6 for 12 to 25 s at a time. Every cell of the twin, with and without a crossfall state: [CSV](tables/twin_cells.csv)."
    )


def _tuning(own: Factorial) -> Table:
    frame = pd.DataFrame(
        [
            {"tuned": tuned_on, **row}
            for tuned_on, found in own.tuned.items()
            for row in table_of(found)
        ]
    )
    columns = {
        "tuned": Column("tuned on"),
        "filter": Column("filter"),
        "ay": Column("σ_ay [m/s²]", each=True),
        "steer": Column("σ_δ [° √s]", each=True),
        "tyres": Column("wander of tyres [1/√s]", each=True),
        "cost": Column("geometric mean of RMSE(β) [deg]", decimals=3),
        "evaluations": Column("evaluations", decimals=0),
        "at_limits": Column("levels that ended on a limit"),
    }
    caption = (
        "Levels of noise, tuned once for all cells: smallest geometric mean of RMSE(β) over 18 drives of 60 s whose slips (2.5, 4.5, "
        f"6.5°), stiffnesses (−25, −5, +15 %) and seeds no scored cell has; {DRAWN} points of a box of 8 to 10 decades a level, the best "
        f"{REFINED} refined by Nelder and Mead. The gyroscope's level is its data sheet's. Logarithms of tyre parameters start with a "
        "deviation of 0.26, the spread of the cells. A level that ended on a limit is given with what a decade inwards changes: nothing "
        "where it is switched off."
    )
    return Table("twin_tuning", caption, frame, columns)
