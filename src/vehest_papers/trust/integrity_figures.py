"""The Stanford diagram: error against protection level, with the share of samples in each region."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vehest.report.style import (
    DOUBLE_COLUMN,
    LINEAR_BLUES,
    NONLINEAR_ORANGES,
    REFERENCE,
    MatplotlibFigure,
    new_figure,
)
from vehest_papers.trust.integrity import HAZARDOUS, MISLEADING, NOMINAL, UNAVAILABLE, Integrity

BINS = 60
COLUMNS = 3
REACH = 2.0  # alert limits that the axes span
_BEHIND = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
LABELS = {
    NOMINAL: (0.25, 0.75),
    MISLEADING: (0.72, 0.42),
    HAZARDOUS: (1.5, 0.5),
    UNAVAILABLE: (1.0, 1.8),
}
"""Region -> where its share is written, in alert limits."""


def stanford_figure(families: Mapping[str, Integrity]) -> MatplotlibFigure:
    """A panel an estimate: how many samples have which error and protection level, on a logarithmic scale of grey.

    Samples beyond the axes are drawn at their ends. Where an estimate was flagged as invalid its level counts as beyond the axes.

    """
    from matplotlib.colors import LogNorm

    columns = min(len(families), COLUMNS)
    rows = -(-len(families) // columns)
    with new_figure(DOUBLE_COLUMN * columns / COLUMNS, 0.35 + 2.3 * rows) as figure:
        panels = np.atleast_1d(
            figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        ).ravel()
        for axes, (title, own) in zip(panels, families.items(), strict=False):
            end = REACH * own.alert_limit
            level = np.where(own.flagged | ~np.isfinite(own.level), np.inf, own.level)
            edges = np.linspace(0.0, end, BINS + 1)
            across, up = (np.clip(values, 0.0, end * (1.0 - 1e-9)) for values in (own.error, level))
            counts = np.histogram2d(across, up, bins=[edges, edges])[0]
            shown = np.ma.masked_equal(counts.T, 0)
            axes.pcolormesh(
                edges,
                edges,
                shown,
                cmap="Greys",
                norm=LogNorm(1, max(counts.max(), 2.0)),
                rasterized=True,
            )
            _draw_regions(axes, own)
            axes.set_title(title)
            axes.set_aspect("equal")
        for axes in panels[len(families) :]:
            axes.set_visible(False)
        for axes in panels[-columns:]:
            axes.set_xlabel("error of sideslip [deg]")
        for axes in panels[::columns]:
            axes.set_ylabel("protection level [deg]")
    return figure


def _draw_regions(axes: Any, own: Integrity) -> None:
    """Limits between regions, and the share of the samples in each."""
    limit = own.alert_limit
    end = REACH * own.alert_limit
    axes.fill(
        [0.0, limit, limit], [0.0, 0.0, limit], color=NONLINEAR_ORANGES[0], alpha=0.15, linewidth=0
    )
    axes.fill(
        [limit, end, end, limit],
        [0.0, 0.0, limit, limit],
        color=NONLINEAR_ORANGES[1],
        alpha=0.25,
        linewidth=0,
    )
    axes.fill(
        [0.0, end, end, 0.0],
        [limit, limit, end, end],
        color=LINEAR_BLUES[0],
        alpha=0.12,
        linewidth=0,
    )
    axes.plot([0.0, end], [0.0, end], color=REFERENCE.colour, linewidth=0.7)
    axes.plot([0.0, end], [limit, limit], color=REFERENCE.colour, linewidth=0.7, linestyle="dashed")
    axes.plot(
        [limit, limit], [0.0, limit], color=REFERENCE.colour, linewidth=0.7, linestyle="dashed"
    )
    shares = own.shares()
    for region, (across, up) in LABELS.items():
        words = f"{region.replace(' ', chr(10))}\n{100.0 * shares[region]:.3g} %"
        axes.text(
            across * limit, up * limit, words, ha="center", va="center", fontsize=5.5, bbox=_BEHIND
        )
    axes.set_xlim(0.0, end)
    axes.set_ylim(0.0, end)
