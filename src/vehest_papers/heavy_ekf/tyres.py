"""Figures 3, 8 and 9: curves fitted to drives, estimated tyre parameters beside the plant's own, and how soon they get there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.filtering.tyre_fit import (
    AxleMotion,
    TyreFit,
    axle_force,
    axle_motion,
    fit_motion,
)
from vehest.report.document import Column, Figure, Table
from vehest.report.figures import decimated
from vehest.report.style import DOUBLE_COLUMN, MISSING, fixed, new_figure, significant
from vehest.vehicle.parameters import SingleTrackParameters
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.laps import POINTS
from vehest_papers.heavy_ekf.subjects import TYRE_COLOURS, TYRES
from vehest_papers.kit.legends import legend_above

BAND = 0.10  # of the plant's own value, within which a parameter counts as found
DOTS = 1500
AXLES: tuple[Literal["front", "rear"], ...] = ("front", "rear")
QUANTITIES = {
    "cornering_stiffness_front": ("c2_front", "$c_{2F}$ [kN/rad]", 1e-3),
    "cornering_stiffness_rear": ("c2_rear", "$c_{2R}$ [kN/rad]", 1e-3),
    "tyre_c1_front": ("c1_front", "$c_{1F}$ [rad²]", 1.0),
    "tyre_c1_rear": ("c1_rear", "$c_{1R}$ [rad²]", 1.0),
}
"""Quantity of an estimate -> parameter of a curve, label of its axis, scale of it."""
LINEAR_LABELS = {
    "cornering_stiffness_front": "$C_F$ [kN/rad]",
    "cornering_stiffness_rear": "$C_R$ [kN/rad]",
}


@dataclass(frozen=True, eq=False)
class OwnCurves:
    """Curves of the plant itself, from its tyre forces."""

    rational: TyreFit  # fit of rational curves
    linear: TyreFit  # fit of straight lines
    # recording -> slip angle of the front and of the rear axle by its sensors where the axle makes no force, (2,) [rad]
    offsets: Mapping[str, FloatArray]

    @classmethod
    def of(
        cls, drives: Sequence[Recording], car: SingleTrackParameters, minimum_speed: float
    ) -> OwnCurves:
        """Both fits to drives on the same tyres, which hold their forces; each drive's offsets of slip are taken off before."""
        motions = []
        offsets = {}
        for number, drive in enumerate(drives):
            motion = axle_motion([drive], car, minimum_speed, measured_forces=True)
            offsets[drive.id] = np.array(
                [
                    _no_force(slip, force)
                    for slip, force in zip(motion.slip, motion.force, strict=True)
                ]
            )
            motions.append(
                motion._replace(
                    slip=motion.slip - offsets[drive.id][:, None],
                    block=motion.block + 10_000 * number,
                )
            )
        together = AxleMotion(
            *(np.concatenate(parts, axis=-1) for parts in zip(*motions, strict=True))
        )
        return cls(fit_motion(together, "rational"), fit_motion(together, "linear"), offsets)

    def value(self, quantity: str, name: str) -> float:
        """What a quantity of an estimate of this filter should be."""
        if name == paper.LINT:
            return float((self.linear.front if quantity.endswith("front") else self.linear.rear)[0])
        axle = self.rational.front if quantity.endswith("front") else self.rational.rear
        return float(axle[0 if "c1" in quantity else 1])


def _no_force(slip: FloatArray, force: FloatArray) -> float:
    """Slip angle at which a straight line through small forces is zero [rad]."""
    small = np.abs(force) < 0.4 * np.abs(force).max()
    slope, offset = np.polyfit(slip[small], force[small], 1)
    return float(-offset / slope)


def figure_3(fit: TyreFit, own: OwnCurves | None, name: str, data: str) -> Figure:
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
            if own is not None:
                axes.plot(
                    np.degrees(grid),
                    1e-3 * own.rational.curve(axle, grid),
                    color="#b8480b",
                    linestyle="dashed",
                    label="plant's own",
                )
            axes.set_title(f"{axle} axle", loc="left")
            axes.set_xlabel(f"slip angle $\\alpha_{'F' if row == 0 else 'R'}$ [deg]")
        panels[0].set_ylabel("lateral force [kN]")
        legend_above(figure, panels[0])
    left = " and ".join(f"{significant(1e-3 * float(rms), 2)} kN" for rms in fit.residual_rms)
    caption = (
        f"Rational tyres fitted to the training drives (Figure 3 of the paper), {data}, and the axle forces of the validation drives, from "
        f"lateral and yaw acceleration, over slip angles from the reference: {fit.slip.shape[1]} samples, {len(chosen)} of them drawn. "
        f"What is left in them has an rms of {left}."
    )
    if own is not None:
        caption += (
            " Dashed: rational curves fitted to the plant's own tyre forces in the test drives on nominal tyres, the sensors' offsets of "
            "slip taken off."
        )
    return Figure(name, caption, figure)


def _band(
    fit: TyreFit, axle: Literal["front", "rear"], grid: FloatArray, row: int
) -> tuple[FloatArray, FloatArray]:
    """Curve ± 1.96 standard deviations to first order in the parameters."""
    values = getattr(fit, axle)
    curve = fit.curve(axle, grid)
    nudged = values * (1.0 + 1e-4 * np.eye(len(values)))
    slopes = np.stack(
        [
            (axle_force(fit.kind, own, grid) - curve) / (1e-4 * value)
            for own, value in zip(nudged, values, strict=True)
        ]
    )
    half = 1.96 * np.sqrt(
        np.maximum(np.einsum("ig,ij,jg->g", slopes, fit.covariance[row], slopes), 0.0)
    )
    return curve - half, curve + half


def table_1(fit: TyreFit, own: OwnCurves | None, name: str, data: str) -> Table:
    """c₁ and c₂ of both axles: paper, fitted with 95 % intervals, and the plant's own."""
    rows = []
    for axle, values, interval in (
        ("front", fit.front, fit.interval[0]),
        ("rear", fit.rear, fit.interval[1]),
    ):
        for position, (parameter, unit) in enumerate((("c1", "rad²"), ("c2", "N/rad"))):
            row: dict[str, object] = {"parameter": f"{parameter}, {axle}", "unit": unit}
            if own is not None:
                row["paper"] = paper.CURVES[f"{parameter}_{axle}"]
            row |= {"fitted": float(values[position]), "interval": float(interval[position])}
            if own is not None:
                row["own"] = float(
                    (own.rational.front if axle == "front" else own.rational.rear)[position]
                )
                row["own_interval"] = float(
                    own.rational.interval[0 if axle == "front" else 1][position]
                )
            rows.append(row)
    columns = {
        "parameter": Column("parameter"),
        "unit": Column("unit"),
        "paper": Column("paper", each=True),
        "fitted": Column("ours, from accelerations", each=True),
        "interval": Column("± (95 %)", each=True, digits=2),
        "own": Column("ours, from the plant's forces", each=True),
        "own_interval": Column("± (95 %)", each=True, digits=2),
    }
    frame = pd.DataFrame(rows)
    caption = f"Parameters of the rational tyre at friction 1 (Table 1 of the paper), ours fitted to the training drives, {data}."
    return Table(
        name, caption, frame, {key: column for key, column in columns.items() if key in frame}
    )


def parameters_figure(
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Estimate],
    own: Mapping[str, OwnCurves],
    filter_name: str,
    name: str,
    caption: str,
) -> Figure:
    """Estimated tyre parameters over time, a line a kind of tyre, with the plant's own, where they are known, dashed: Figures 8 and 9."""
    linear = filter_name == paper.LINT
    quantities = list(LINEAR_LABELS) if linear else list(QUANTITIES)
    with new_figure(DOUBLE_COLUMN, 2.3 if linear else 3.8) as figure:
        panels = figure.subplots(1 if linear else 2, 2, sharex=True, squeeze=False)
        for axes, quantity in zip(panels.flat, quantities, strict=True):
            _, label, scale = QUANTITIES[quantity]
            values = []
            for tyres, estimate in estimates.items():
                colour = TYRE_COLOURS.get(tyres, "#0b4f9c")
                title = TYRES.get(tyres, tyres)
                axes.plot(
                    *decimated(drives[tyres].time, scale * estimate[quantity], POINTS),
                    color=colour,
                    linewidth=1.0,
                    label=title,
                )
                values.append(scale * estimate[quantity])
                if tyres in own:
                    truth = scale * own[tyres].value(quantity, filter_name)
                    if "c1" not in quantity or truth < 3.0 * float(np.max(values[-1])):
                        axes.axhline(
                            truth,
                            color=colour,
                            linewidth=0.9,
                            linestyle="dashed",
                            label=f"plant's own, {title}",
                        )
            axes.set_ylabel(LINEAR_LABELS[quantity] if linear else label)
            axes.margins(x=0.0)
        for axes in panels[-1]:
            axes.set_xlabel("time [s]")
        legend_above(figure, *panels.flat, columns=3)
    return Figure(name, caption, figure)


def convergence_time(time: FloatArray, values: FloatArray, target: float) -> float:
    """From when on the values stay within `BAND` of the target [s after the start]; infinite if they are outside at the end."""
    outside = np.flatnonzero(np.abs(values - target) > BAND * abs(target))
    if not len(outside):
        return 0.0
    return math.inf if outside[-1] == len(values) - 1 else float(time[outside[-1] + 1] - time[0])


def convergence_table(
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Mapping[str, Estimate]],
    own: Mapping[str, OwnCurves],
    names: Sequence[str],
) -> Table:
    """Start, end and the plant's own value of every estimated parameter, and from when on it stays near."""
    rows = []
    for test, drive in drives.items():
        tyres = test.split("_")[0]
        for name in names:
            for quantity, (parameter, _, _) in QUANTITIES.items():
                estimate = estimates[test][name]
                if quantity not in estimate.channels or (name == paper.LINT and "c1" in quantity):
                    continue
                values = estimate[quantity]
                target = own[tyres].value(quantity, name)
                took = convergence_time(drive.time, values, target)
                rows.append(
                    {
                        "test": test.replace("_", ", "),
                        "filter": name,
                        "parameter": parameter.replace("c2", "C")
                        if name == paper.LINT
                        else parameter,
                        "start": float(values[0]),
                        "end": float(np.mean(values[-round(20 * drive.rate_hz) :])),
                        "own": target,
                        "seconds": fixed(took, 0) if math.isfinite(took) else MISSING,
                    }
                )
    columns = {
        "test": Column("drive"),
        "filter": Column("filter"),
        "parameter": Column("parameter"),
        "start": Column("at the start", each=True),
        "end": Column("mean of the last 20 s", each=True),
        "own": Column("plant's own", each=True),
        "seconds": Column(f"within {100 * BAND:.0f} % of it from [s]"),
    }
    caption = (
        f"Estimated tyre parameters beside the plant's own, the rational (for LINT the linear) curve that fits the plant's tyre forces in "
        f"the drives on the same tyres; c1 [rad²], c2 and C [N/rad]. `{MISSING}`: outside at the end."
    )
    return Table("convergence", caption, pd.DataFrame(rows), columns)
