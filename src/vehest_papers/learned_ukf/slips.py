"""Figure 3: how the slip angle of the rear axle is distributed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.report.document import Figure
from vehest.report.style import DOUBLE_COLUMN, OTHER_COLOURS, new_figure
from vehest_papers.kit.legends import legend_above
from vehest_papers.learned_ukf import paper

MIN_SPEED = 0.5  # [m/s] below which a slip angle is noise
LIMIT = 90.0  # [deg] of the axis; what lies beyond counts in the outermost bins
WIDTH = 2.0  # [deg] of a bin
PERCENTILES = (50, 90, 99)


def rear_slip(recordings: Sequence[Recording], cg_to_rear_axle: float) -> FloatArray:
    """Slip angle of the rear axle by the references, atan2(vy - l_r r, vx), where the car moves;
    (K,) [deg].

    Parameters
    ----------
    recordings
        With ``vx_ref``, ``vy_ref``, ``yaw_rate_ref``.
    cg_to_rear_axle
        l_r [m].

    Source: Węgrzynowski et al. 2024, Section III-B.2.
    """
    parts = []
    for recording in recordings:
        vx, vy, yaw_rate = (recording[name] for name in ("vx_ref", "vy_ref", "yaw_rate_ref"))
        moving = vx >= MIN_SPEED
        parts.append(np.degrees(np.arctan2(vy - cg_to_rear_axle * yaw_rate, vx))[moving])
    return np.concatenate(parts)


def distribution(
    slips: Mapping[str, FloatArray], name: str, data: str, note: str
) -> tuple[Figure, pd.DataFrame, pd.DataFrame]:
    """Density of each set's slip angle [deg], its percentiles, and the drawn values."""
    edges = np.arange(-LIMIT, LIMIT + WIDTH, WIDTH)
    drawn = pd.DataFrame({"from_deg": edges[:-1], "to_deg": edges[1:]})
    with new_figure(DOUBLE_COLUMN * 0.8, 2.9) as figure:
        axes = figure.add_subplot()
        for (label, values), colour, dash in zip(
            slips.items(), OTHER_COLOURS, ("solid", "dashed", "dashdot"), strict=False
        ):
            counts, _ = np.histogram(np.clip(values, -LIMIT, LIMIT), edges)
            drawn[label] = counts / len(values) / WIDTH
            axes.stairs(
                drawn[label], edges, color=colour, linestyle=dash, linewidth=1.2, label=label
            )
        for side in (-1.0, 1.0):
            label_of_limit = (
                "the paper's 99th percentile, all its data" if side > 0 else "_nolegend_"
            )
            axes.axvline(
                side * paper.SLIP_99,
                color="#767676",
                linewidth=0.8,
                linestyle="dotted",
                label=label_of_limit,
            )
        axes.set_yscale("log")
        axes.set_xlim(-LIMIT, LIMIT)
        axes.set_xlabel("slip angle of the rear axle [deg]")
        axes.set_ylabel("density [1/deg]")
        legend_above(figure, axes)
    caption = (
        "Distribution of the slip angle of the rear axle, Figure 3 of the paper; logarithmic. "
        f"Data: {data}. Samples with v_x of {MIN_SPEED:g} m/s and more. {note}"
    )
    rows = [
        {
            "set": label,
            "samples": len(values),
            **{f"p{p}": float(np.percentile(np.abs(values), p)) for p in PERCENTILES},
        }
        for label, values in slips.items()
    ]
    return Figure(f"figure_3_{name}", caption, figure), pd.DataFrame(rows), drawn
