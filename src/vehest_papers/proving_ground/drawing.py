"""Figures of each vehicle: traces, handling diagram and distributions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.report.figures import decimated
from vehest.report.style import (
    DOUBLE_COLUMN,
    LINEAR_BLUES,
    NONLINEAR_ORANGES,
    OTHER_COLOURS,
    MatplotlibFigure,
    new_figure,
)
from vehest_papers.proving_ground.handling import ANGLE_EDGES, AY_EDGES
from vehest_papers.proving_ground.papers import Profile
from vehest_papers.proving_ground.vehicles import TRACE_SECONDS, Segment, VehicleData

POINTS = 1200
GREYS = 12
MAX_ANGLE = 6.0  # deg, to which a characteristic is drawn beyond the samples
GAP_SHARE = 0.012  # of the time axis, between two segments
MAX_SEGMENTS = 8
MIN_TRACE_SECONDS = 8.0
MAX_SIDESLIP = 20.0
"""Sideslip angle to which distributions are drawn [deg], so that cars that spin do not compress the
others.
"""

SOURCES = {"simulated": (LINEAR_BLUES[1], "solid"), "real": (NONLINEAR_ORANGES[1], "dashed")}
_CURVES = (
    (LINEAR_BLUES[1], "solid"),
    (NONLINEAR_ORANGES[0], "dashed"),
    (OTHER_COLOURS[0], "dashdot"),
    (OTHER_COLOURS[2], "dotted"),
)
QUANTITIES = {
    "vx": ("vx [m/s]", 1.0),
    "steer": ("steer [deg]", 180.0 / np.pi),
    "yaw_rate": ("yaw rate [rad/s]", 1.0),
    "ay": ("$a_y$ [m/s²]", 1.0),
    "sideslip_ref": ("β [deg]", 180.0 / np.pi),
}


@dataclass(frozen=True, eq=False)
class Distribution:
    """Counts in bins."""

    kind: str  # ``real`` or ``simulated``
    edges: FloatArray  # (B + 1,)
    counts: NDArray[np.int64]  # (B,)


def shortened(segments: Mapping[str, Segment]) -> list[Segment]:
    """At most `MAX_SEGMENTS`, cut to their busiest parts, together about `TRACE_SECONDS` long."""
    drawn = list(segments.values())[:MAX_SEGMENTS]
    seconds = max(TRACE_SECONDS / len(drawn), MIN_TRACE_SECONDS)
    return [segment.busiest_part(seconds) for segment in drawn]


def traces(segments: Sequence[Segment]) -> MatplotlibFigure:
    """Speed, steering, yaw rate, lateral acceleration and sideslip of segments on one time axis."""
    quantities = {name: QUANTITIES[name] for name in QUANTITIES if name in segments[0].channels}
    total = sum(float(trace.time[-1] - trace.time[0]) for trace in segments)
    with new_figure(DOUBLE_COLUMN, 0.6 + 0.85 * len(quantities)) as figure:
        rows = figure.subplots(len(quantities), 1, sharex=True)
        offset = 0.0
        for trace in segments:
            at = offset + trace.time - trace.time[0]
            points = max(round(POINTS * (at[-1] - at[0]) / total), 60)
            for axes, (name, (_, factor)) in zip(rows, quantities.items(), strict=True):
                axes.plot(
                    *decimated(at, factor * trace.channels[name], points),
                    color=SOURCES["simulated"][0],
                    linewidth=0.9,
                )
            rows[0].annotate(
                trace.manoeuvre.replace("_", " "),
                (at[0], 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(1, 3 + 8 * (segments.index(trace) % 2 if len(segments) > 4 else 0)),
                textcoords="offset points",
                fontsize=6.5,
            )
            offset = float(at[-1]) + GAP_SHARE * total
            if trace is not segments[-1]:
                for axes in rows:
                    axes.axvline(offset - 0.5 * GAP_SHARE * total, color="#b5b9be", linewidth=0.8)
        for axes, (label, _) in zip(rows, quantities.values(), strict=True):
            axes.set_ylabel(label)
            axes.set_xlim(-0.005 * total, offset)
            axes.margins(y=0.08)
            if axes.get_ylim()[0] < 0 < axes.get_ylim()[1]:
                axes.axhline(0.0, color="#888888", linewidth=0.5)
        rows[-1].set_xlabel("time [s]" if len(segments) == 1 else "time, segments end to end [s]")
        figure.align_ylabels()
    return figure


def handling(vehicle: VehicleData) -> MatplotlibFigure:
    """Understeer angle over centripetal acceleration.

    All samples in grey, medians of steady turns, and the characteristics of the plant.
    """
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    assert vehicle.handling is not None
    edges = (AY_EDGES, ANGLE_EDGES)
    counts = vehicle.handling.moving
    curves = vehicle.characteristics
    sources = {
        "simulated": vehicle.handling,
        **({"real": vehicle.real_handling} if vehicle.real_handling is not None else {}),
    }
    with new_figure(DOUBLE_COLUMN, 3.6) as figure:
        axes = figure.add_subplot()
        greys = LinearSegmentedColormap.from_list("greys", ["#ececec", "#7d7d7d"], N=GREYS)
        occupied = np.ma.masked_equal(counts.T, 0)
        mesh = axes.pcolormesh(
            *edges,
            occupied,
            cmap=greys,
            norm=LogNorm(1, max(int(counts.max()), 10)),
            rasterized=True,
            zorder=1,
        )
        for (colour, dash), curve in zip(_CURVES, curves, strict=False):
            axes.plot(
                curve.ay,
                curve.angle,
                color=colour,
                linestyle=dash,
                linewidth=1.5,
                label=f"plant, {curve.label}",
                zorder=4,
            )
        for (colour, _), curve in zip(_CURVES, curves, strict=False):
            if curve.gradient not in [drawn.gradient for drawn in curves[: curves.index(curve)]]:
                ends = np.array([-6.0, 6.0])
                gradient = f"{curve.gradient:.3f}°/(m/s²)".replace("-", "\N{MINUS SIGN}")
                label = f"linear single track, {curve.label.split(',')[0]}: {gradient}"
                axes.plot(
                    ends,
                    curve.gradient * ends,
                    color=colour,
                    linewidth=0.7,
                    linestyle=(0, (6, 2)),
                    label=label,
                    zorder=3,
                )
        for kind, points in sources.items():
            filled = SOURCES[kind][0] if kind == "real" else "white"
            marker = "D" if kind == "real" else "o"
            label = f"median of steady turns, {kind}"
            looks: dict[str, Any] = {
                "markeredgecolor": "black",
                "markerfacecolor": filled,
                "markeredgewidth": 0.7,
                "markersize": 3.6,
            }
            axes.plot(
                *points.medians(), linestyle="none", marker=marker, label=label, zorder=5, **looks
            )
        axes.set_xlim(*_reach(edges[0], counts.sum(axis=1), [curve.ay for curve in curves]))
        clipped = [np.clip(curve.angle, -MAX_ANGLE, MAX_ANGLE) for curve in curves]
        axes.set_ylim(*_reach(edges[1], counts.sum(axis=0), clipped, share=0.001))
        axes.set_xlabel("speed × yaw rate [m/s²], positive in a left turn")
        axes.set_ylabel("steer \N{MINUS SIGN} arctan(L·yaw rate/speed) [deg]")
        bar = figure.colorbar(mesh, ax=axes, pad=0.01, aspect=30)
        bar.set_label("samples a bin")
        bar.outline.set_visible(False)
        figure.legend(
            *axes.get_legend_handles_labels(),
            loc="outside upper left",
            ncols=2,
            columnspacing=1.4,
            handlelength=2.8,
        )
    return figure


def share_beyond(distributions: Sequence[Distribution], limit: float) -> float:
    """Share of all samples in bins beyond ±limit [%]."""
    total = sum(int(of_kind.counts.sum()) for of_kind in distributions)
    outside = 0
    for of_kind in distributions:
        is_outside = (of_kind.edges[1:] <= -limit) | (of_kind.edges[:-1] >= limit)
        outside += int(of_kind.counts[is_outside].sum())
    return 100.0 * outside / max(total, 1)


def distributions(vehicle: VehicleData, profile: Profile) -> MatplotlibFigure:
    """Shares of samples in bins of 1° of sideslip and of 1 m/s² of lateral acceleration.

    Logarithmic, with the limits of the profile.
    """
    from matplotlib.ticker import FuncFormatter

    kinds = [*(["simulated"] if vehicle.simulated else []), *(["real"] if vehicle.real else [])]
    sideslip, ay = (
        [Distribution(kind, *vehicle.merged(kind).histogram(name, 1.0)) for kind in kinds]
        for name in ("sideslip", "ay")
    )
    with new_figure(DOUBLE_COLUMN, 2.7) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        lowest = 1.0
        for axes, counted, limit in (
            (left, sideslip, profile.sideslip_limit),
            (right, ay, profile.ay_limit),
        ):
            reach = 1.0
            for of_kind in counted:
                shares = 100.0 * of_kind.counts / max(int(of_kind.counts.sum()), 1)
                (colour, dash) = SOURCES[of_kind.kind]
                filled = of_kind.kind == "simulated"
                axes.stairs(
                    shares,
                    of_kind.edges,
                    color=colour,
                    fill=filled,
                    alpha=0.25 if filled else 1.0,
                    linewidth=0,
                )
                axes.stairs(
                    shares,
                    of_kind.edges,
                    color=colour,
                    linestyle=dash,
                    linewidth=1.2,
                    label=of_kind.kind,
                )
                occupied = np.flatnonzero(of_kind.counts)
                if len(occupied):
                    reach = max(
                        reach, abs(of_kind.edges[occupied[0]]), abs(of_kind.edges[occupied[-1] + 1])
                    )
                    lowest = min(lowest, float(shares[shares > 0].min()))
            if limit is not None:
                for side in (-1, 1):
                    label = profile.limit_label if side > 0 else None
                    axes.axvline(
                        side * limit, color="black", linestyle="dotted", linewidth=1.0, label=label
                    )
            axes.set_yscale("log")
            limit_drawn = min(reach, MAX_SIDESLIP) if counted is sideslip else reach
            axes.set_xlim(-1.03 * limit_drawn, 1.03 * limit_drawn)
            if limit_drawn < reach:
                axes.set_title(
                    f"not drawn: {share_beyond(counted, limit_drawn):.2g} % of samples beyond "
                    f"±{limit_drawn:g}°",
                    fontsize="small",
                )
        left.set_ylim(bottom=0.6 * lowest, top=100.0)
        left.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        left.set_ylabel("share of samples [%]")
        left.set_xlabel("sideslip angle, bins of 1° [deg]")
        right.set_xlabel("lateral acceleration, bins of 1 m/s² [m/s²]")
        handles, labels = right.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper left", ncols=len(labels), columnspacing=1.4
        )
    return figure


def _reach(
    edges: FloatArray, counts: NDArray[np.int64], curves: Sequence[FloatArray], share: float = 0.0
) -> tuple[float, float]:
    """Limits of an axis that show the curves and all but a share of the samples at either end, the
    same to both sides of zero.
    """
    total = int(counts.sum())
    reach = 1.0
    if total:
        inside = np.flatnonzero(
            (np.cumsum(counts) > share * total) & (np.cumsum(counts[::-1])[::-1] > share * total)
        )
        reach = max(abs(float(edges[inside[0]])), abs(float(edges[inside[-1] + 1])))
    reach = max([reach, *(float(np.abs(curve).max()) for curve in curves)])
    return -1.04 * reach, 1.04 * reach
