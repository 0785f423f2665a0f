"""Sizes of sideslip angle and lateral acceleration in each data set."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehest.report.style import DOUBLE_COLUMN, MatplotlibFigure, new_figure
from vehest_papers.real_cars.statistics import Statistics

COLOURS = {"sideslip": "#b8480b", "ay": "#0b4f9c"}


def distributions(rows: Sequence[tuple[str, str, Statistics]]) -> MatplotlibFigure:
    """Quantiles of |β| and |ay| while driving, a row a data set, on logarithmic axes."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    with new_figure(DOUBLE_COLUMN, 0.6 + 0.3 * max(len(rows), 2)) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, name, label in ((left, "sideslip", "|β| [deg]"), (right, "ay", "|a_y| [m/s²]")):
            colour = COLOURS[name]
            for height, (_, kind, statistics) in enumerate(rows):
                values = np.array(getattr(statistics, name))
                if not np.isfinite(values).all():
                    axes.annotate(
                        "not measured",
                        (0.02, height),
                        xycoords=("axes fraction", "data"),
                        va="center",
                        color="#767676",
                        fontsize=6.5,
                    )
                    continue
                axes.plot(values[[0, -1]], [height, height], color=colour, linewidth=1.0)
                for value, marker in zip(values, ("|", "o", "D"), strict=True):
                    axes.plot(
                        value,
                        height,
                        marker=marker,
                        color=colour,
                        markersize=4.5,
                        markerfacecolor="white" if kind != "real" else colour,
                    )
                axes.annotate(
                    f"{values[-1]:.2g}",
                    (values[-1], height),
                    xytext=(5, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=6.5,
                )
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.set_xlabel(label)
            axes.margins(x=0.12)
        left.set_yticks(range(len(rows)), [title for title, _, _ in rows])
        left.set_ylim(len(rows) - 0.5, -0.5)
    return figure
