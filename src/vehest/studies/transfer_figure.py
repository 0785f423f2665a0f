"""The figure of several vehicles: errors of every estimator on every test, over that of knowing nothing."""

from __future__ import annotations

import math
import textwrap

import pandas as pd

from vehest.report.style import DOUBLE_COLUMN, MatplotlibFigure, lines_of, new_figure

COLUMNS = 4
TITLE_WIDTH = 24
ROW = 0.16  # in, height of an estimator


def transfer_figure(board: pd.DataFrame) -> MatplotlibFigure:
    """A panel a test, a row an estimator: RMSE(β) over that of v = 0 with its interval, and the static map as a vertical line."""
    places = list(dict.fromkeys(zip(board["part"], board["test_set"], strict=True)))
    names = list(dict.fromkeys(zip(board["estimator"], board["variant"], board["estimator_title"], strict=True)))
    names = [name for name in names if name[0] != "zero"]
    lines = lines_of([name[:2] for name in names])
    columns = min(COLUMNS, len(places))
    rows = -(-len(places) // columns)
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    with new_figure(DOUBLE_COLUMN, rows * (0.75 + ROW * len(names))) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(places) :]:
            axes.set_visible(False)
        for axes, (part, test_set) in zip(grid.flat, places, strict=False):
            own = board[(board["part"] == part) & (board["test_set"] == test_set)].set_index(["estimator", "variant"])
            nothing = _first(own, "zero")
            for height, name in enumerate(names):
                if name[:2] not in own.index or not math.isfinite(own.loc[name[:2], "rmse_sideslip"]):
                    continue
                value, low, high = (float(own.loc[name[:2], f"rmse_sideslip{end}"]) / nothing for end in ("", "_low", "_high"))
                colour = lines[name[:2]].colour
                if math.isfinite(low):
                    axes.plot([low, high], [height, height], color=colour, linewidth=1.4, solid_capstyle="butt")
                axes.plot(value, height, marker="o", color=colour, markersize=3.0)
            axes.axvline(1.0, color="black", linewidth=0.7)
            static = _first(own, "static_map") / nothing
            if math.isfinite(static):
                axes.axvline(static, color="#999999", linewidth=0.7, linestyle=(0, (3, 2)))
            title = str(own["title"].iloc[0])
            several = board[board["part"] == part]["test_set"].nunique() > 1
            lines_of_title = [*textwrap.wrap(title, TITLE_WIDTH), *([test_set.replace("_", " ")] if several else [])]
            axes.set_title("\n".join(lines_of_title), fontsize=6.5, loc="left")
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        for axes in grid[:, 0]:
            axes.set_yticks(range(len(names)), [name[2] for name in names])
            axes.set_ylim(len(names) - 0.5, -0.5)
        figure.supxlabel("RMSE(β) over that of v = 0", fontsize=7.5)
    return figure


def _first(own: pd.DataFrame, estimator: str) -> float:
    found = own[own.index.get_level_values("estimator") == estimator]["rmse_sideslip"]
    return float(found.iloc[0]) if len(found) else math.nan
