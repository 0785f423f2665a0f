"""Fig. 6: every candidate on the two test sets, the car it learnt on against the other one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vehest.report.document import Figure
from vehest.report.style import DOUBLE_COLUMN, line_of, new_figure
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import chosen
from vehest_papers.ksnn.schemes import Scheme
from vehest_papers.ksnn.tables import SETS

METRICS = {"r2": "R²", "rmse_vy": "RMSE(v) [m/s]"}


def two_tests(schemes: Sequence[Scheme], caption: str) -> Figure:
    """R² above, RMSE of v below; one column a scheme, the car that was learnt on over the other one."""
    with new_figure(DOUBLE_COLUMN, 6.4) as figure:
        axes = figure.subplots(2, len(schemes), squeeze=False)
        for column, scheme in enumerate(schemes):
            for row, (metric, label) in enumerate(METRICS.items()):
                _draw(axes[row, column], scheme, metric)
                axes[row, column].set_xlabel(f"{label} on {SETS[scheme.other]}, car not trained on")
                axes[row, column].set_ylabel(f"{label} on {SETS[scheme.own]}, car trained on")
            axes[0, column].set_title(scheme.title)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return Figure("figure_6", caption, figure)


def _draw(axes: Any, scheme: Scheme, metric: str) -> None:
    groups = {
        name: scheme.runs[scheme.runs["category"] == name]
        for name in dict.fromkeys(scheme.runs["category"])
    }
    x = f"{metric}.{scheme.other}"
    y = f"{metric}.{scheme.own}"
    shown: list[float] = []
    for name in paper.CATEGORIES:
        if name not in groups:
            continue
        own = groups[name]
        first = groups[name].iloc[0]
        line = line_of(str(first["estimator"]), str(first["variant"]))
        axes.scatter(
            own[x],
            own[y],
            s=5,
            marker=line.marker,
            color=line.colour,
            alpha=0.25,
            linewidths=0,
            zorder=2,
        )
        picked = [chosen(runs) for _, runs in own.groupby(["estimator", "variant"], sort=False)]
        axes.scatter(
            [run[x] for run in picked],
            [run[y] for run in picked],
            s=20,
            marker=line.marker,
            color=line.colour,
            label=name,
            zorder=4,
        )
        shown += [value for run in picked for value in (run[x], run[y])]
        if name in scheme.published:
            theirs = scheme.published[name]
            point = [
                1.0 - theirs.fvu(test) if metric == "r2" else theirs.rmse(test)
                for test in (scheme.other, scheme.own)
            ]
            axes.scatter(
                *point,
                s=34,
                marker=line.marker,
                facecolors="none",
                edgecolors=line.colour,
                linewidths=1.0,
                zorder=3,
            )
            shown += point
    low = min(shown)
    high = max(shown)
    pad = 0.06 * (high - low)
    limits = (low - pad, high + pad)
    axes.plot(limits, limits, color="#444444", linewidth=0.6, linestyle="dashed", zorder=1)
    axes.set_xlim(limits)
    axes.set_ylim(limits)
    axes.set_aspect("equal")
