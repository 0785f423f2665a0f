"""Figures 3, 8 and 9: fitted tyre curves, and estimated tyre parameters over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.filtering.tyre_fit import TyreFit, axle_force
from vehest.report.document import Figure
from vehest.report.figures import decimated
from vehest.report.style import DOUBLE_COLUMN, new_figure
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.laps import POINTS
from vehest_papers.heavy_ekf.subjects import TYRE_COLOURS, TYRES
from vehest_papers.kit.legends import legend_above

DOTS = 1500
AXLES: tuple[Literal["front", "rear"], ...] = ("front", "rear")
QUANTITIES = {
    "cornering_stiffness_front": ("$c_{2F}$ [kN/rad]", 1e-3),
    "cornering_stiffness_rear": ("$c_{2R}$ [kN/rad]", 1e-3),
    "tyre_c1_front": ("$c_{1F}$ [rad²]", 1.0),
    "tyre_c1_rear": ("$c_{1R}$ [rad²]", 1.0),
}
"""Quantity of an estimate -> label of its axis, scale of it."""
LINEAR_LABELS = {
    "cornering_stiffness_front": "$C_F$ [kN/rad]",
    "cornering_stiffness_rear": "$C_R$ [kN/rad]",
}
FIGURE_3 = (
    "Rational tyres fitted to the nominal, level laps of three trucks (Figure 3 of the paper), "
    "SIMULATED, with the axle forces from lateral and yaw acceleration."
)


def figure_3(fit: TyreFit) -> Figure:
    """Forces over slip angles with the fitted curve and its 95 % band, front and rear."""
    generator = np.random.default_rng(0)
    chosen = np.sort(generator.permutation(fit.slip.shape[1])[:DOTS])
    with new_figure(DOUBLE_COLUMN, 2.7) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for row, (axes, axle) in enumerate(zip(panels, AXLES, strict=True)):
            slip = fit.slip[row]
            force = fit.force[row]
            reach = float(np.abs(slip).max())
            grid = np.linspace(-reach, reach, 201)
            dots = {"s": 2, "color": "#b5b9be", "linewidths": 0, "rasterized": True}
            axes.scatter(
                np.degrees(slip[chosen]), 1e-3 * force[chosen], label="from accelerations", **dots
            )
            low, high = _band(fit, axle, grid, row)
            axes.fill_between(
                np.degrees(grid),
                1e-3 * low,
                1e-3 * high,
                color="#4aa5e0",
                alpha=0.4,
                linewidth=0,
                label="95 %",
            )
            axes.plot(
                np.degrees(grid),
                1e-3 * fit.curve(axle, grid),
                color="#0b4f9c",
                label="fitted, Eq. 4",
            )
            axes.set_title(f"{axle} axle", loc="left")
            axes.set_xlabel(f"slip angle $\\alpha_{'F' if row == 0 else 'R'}$ [deg]")
        panels[0].set_ylabel("lateral force [kN]")
        legend_above(figure, panels[0])
    return Figure("figure_3", FIGURE_3, figure)


def _band(
    fit: TyreFit, axle: Literal["front", "rear"], grid: FloatArray, row: int
) -> tuple[FloatArray, FloatArray]:
    """Curve ± 1.96 standard deviations to first order in the parameters."""
    values = getattr(fit, axle)
    curve = fit.curve(axle, grid)
    nudged = values * (1.0 + 1e-4 * np.eye(len(values)))
    slopes = np.stack(
        [
            (axle_force(fit.kind, varied, grid) - curve) / (1e-4 * value)
            for varied, value in zip(nudged, values, strict=True)
        ]
    )
    half = 1.96 * np.sqrt(
        np.maximum(np.einsum("ig,ij,jg->g", slopes, fit.covariance[row], slopes), 0.0)
    )
    return curve - half, curve + half


def parameters_figure(
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Estimate],
    filter_name: str,
    name: str,
    caption: str,
) -> Figure:
    """Estimated tyre parameters over time, a line a kind of tyre: Figures 8 and 9."""
    is_linear = filter_name == paper.LINT
    quantities = list(LINEAR_LABELS) if is_linear else list(QUANTITIES)
    with new_figure(DOUBLE_COLUMN, 2.3 if is_linear else 3.8) as figure:
        panels = figure.subplots(1 if is_linear else 2, 2, sharex=True, squeeze=False)
        for axes, quantity in zip(panels.flat, quantities, strict=True):
            label, scale = QUANTITIES[quantity]
            for tyres, estimate in estimates.items():
                axes.plot(
                    *decimated(drives[tyres].time, scale * estimate[quantity], POINTS),
                    color=TYRE_COLOURS[tyres],
                    linewidth=1.0,
                    label=TYRES[tyres],
                )
            axes.set_ylabel(LINEAR_LABELS[quantity] if is_linear else label)
            axes.margins(x=0.0)
        for axes in panels[-1]:
            axes.set_xlabel("time [s]")
        legend_above(figure, *panels.flat, columns=3)
    return Figure(name, caption, figure)
