"""Reliability diagram: how often bands hold the error, over how often they say they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray
from vehest.report.style import REFERENCE, SINGLE_COLUMN, Line, MatplotlibFigure, new_figure

LABEL_STEP = 0.05  # least distance of two labels, as a part of the axis
SIDESTEP = 0.005  # of intervals that would cover each other


@dataclass(frozen=True, eq=False)
class Reliability:
    """Coverages of one estimator's bands, each of shape (L,); NaN where not known."""

    label: str  # name of the estimator
    line: Line
    coverage: FloatArray  # fraction of errors inside
    low: FloatArray  # lower end of its interval
    high: FloatArray  # upper end


def reliability_figure(levels: Sequence[float], rows: Sequence[Reliability]) -> MatplotlibFigure:
    """Coverage over nominal level, one line an estimator with its name at the end; on the diagonal bands say what they hold."""
    nominal = np.array(levels)
    with new_figure(SINGLE_COLUMN * 1.55, 3.2) as figure:
        axes = figure.add_subplot()
        axes.plot([0.0, 1.0], [0.0, 1.0], color=REFERENCE.colour, linewidth=0.7)
        for position, row in enumerate(rows):
            at = nominal + _aside(position, len(rows))
            axes.vlines(at, row.low, row.high, color=row.line.colour, linewidth=0.8, alpha=0.6)
            axes.plot(at, row.coverage, color=row.line.colour, linestyle=row.line.dash, marker=row.line.marker)
        lowest = float(np.nanmin([[row.coverage.min(), np.nanmin(row.low, initial=1.0)] for row in rows]))
        bottom = max(min(lowest, float(nominal[0])) - 0.05, 0.0)
        axes.set_xlim(nominal[0] - 0.05, 1.0)
        axes.set_ylim(bottom, 1.01)
        axes.set_xticks(nominal, [f"{100 * level:.0f}" for level in levels])
        axes.set_yticks(ticks := np.arange(np.ceil(10 * bottom) / 10, 1.01, 0.1), [f"{100 * tick:.0f}" for tick in ticks])
        axes.set_xlabel("nominal level [%]")
        axes.set_ylabel("errors of β inside [%]")
        heights = _apart([float(row.coverage[-1]) for row in rows], LABEL_STEP * (1.01 - bottom), 1.0)
        for position, (row, height) in enumerate(zip(rows, heights, strict=True)):
            axes.annotate(
                row.label,
                (float(nominal[-1]) + _aside(position, len(rows)), float(row.coverage[-1])),
                (1.02, height),
                color=row.line.colour,
                fontsize=6.5,
                va="center",
                annotation_clip=False,
                arrowprops={"arrowstyle": "-", "color": row.line.colour, "linewidth": 0.4, "shrinkA": 1, "shrinkB": 2, "relpos": (0, 0.5)},
            )
    return figure


def _aside(position: int, count: int) -> float:
    return SIDESTEP * (position - 0.5 * (count - 1))


def _apart(heights: Sequence[float], step: float, top: float) -> list[float]:
    """Heights moved down as far as needed to stand a step apart below ``top``, in their order."""
    placed, last = [0.0] * len(heights), top + step
    for position in np.argsort([-height for height in heights], kind="stable"):
        last = min(heights[position], last - step)
        placed[int(position)] = last
    return placed
