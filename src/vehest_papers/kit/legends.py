"""Legends of the papers' figures."""

from __future__ import annotations

from typing import Any

from vehest.report.style import MatplotlibFigure


def legend_above(figure: MatplotlibFigure, *axes: Any, columns: int = 4) -> None:
    """One legend over the figure with every label of some axes once."""
    entries: dict[str, Any] = {}
    for panel in axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside upper left",
        ncols=columns,
        columnspacing=1.3,
        handlelength=2.6,
    )
