"""Figures 7 to 10, 12 and 13: single manoeuvres, as estimated, with the outputs of the hybrids'
networks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.splits import Span
from vehest.estimators.filtering.dugoff_filter import PseudoMeasurement
from vehest.evaluation.metrics import Scored
from vehest.report.document import Figure, as_code
from vehest.report.style import DOUBLE_COLUMN, REFERENCE, new_figure
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.manoeuvres import group_of
from vehest_papers.cnn_ukf.networks import pseudo_measurements_of
from vehest_papers.cnn_ukf.subjects import TEST, Prepared, Run, line_of
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.reading import sideslip_error

WIDE = 5.0  # ratio from which deviations stand on a logarithmic axis
LAP_SECONDS = 32.0  # what Fig. 10 shows of a lap


def manoeuvre_of(part: PartArtefacts, prepared: Prepared, group: str) -> Span:
    """The test manoeuvre of a group with the largest sideslip angle among those in which the car
    did not spin.

    Parameters
    ----------
    group
        One of the names in `vehest_papers.cnn_ukf.manoeuvres.GROUPS`.

    Raises
    ------
    DataError
        The test set has no manoeuvre of the group without a spin.
    """
    peaks = {}
    for span in part.split.tests[TEST]:
        drive = prepared.recording(span.dataset, span.recording)
        if group_of(span.recording) == group and not dict(drive.provenance.get("flags") or {}).get(
            "spun"
        ):
            piece = drive.cut(span.start, span.stop)
            peaks[span] = float(np.abs(np.arctan2(piece["vy_ref"], piece["vx"])).max())
    if not peaks:
        raise DataError(f"study '{part.study}': no test manoeuvre is a {group} without a spin")
    return max(peaks, key=peaks.__getitem__)


def compared(runs: Mapping[str, Run], span: Span, number: int, subject: str, data: str) -> Figure:
    """Reference and all estimates of one manoeuvre, and their errors below (Figures 7, 9 and 12).

    Parameters
    ----------
    runs
        Candidate -> the run that is drawn.
    span
        The manoeuvre.
    number
        Of the paper's figure.
    subject, data
        Manoeuvre in words, and data sets, for the caption.
    """
    parts = {candidate: run.test[span.recording][0] for candidate, run in runs.items()}
    with new_figure(DOUBLE_COLUMN, 3.9) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
        _angles(upper, parts)
        for candidate, part in parts.items():
            line = line_of(candidate)
            lower.plot(
                _from_start(part),
                sideslip_error(part),
                color=line.colour,
                linestyle=line.dash,
                linewidth=0.9,
            )
        lower.set_ylabel("error [deg]")
        lower.set_xlabel("time [s]")
        for axes in (upper, lower):
            axes.margins(x=0.0)
        legend_above(figure, upper, columns=4)
    caption = f"{subject} (Figure {number} of the paper), {as_code(span.recording)}. Data: {data}."
    return Figure(f"figure_{number}", caption, figure)


def inner_life(
    runs: Mapping[str, Run],
    prepared: Prepared,
    warm_up: float,
    span: Span,
    constant: FloatArray,
    data: str,
) -> Figure:
    """Outputs of the hybrids' networks in one manoeuvre (Figure 8): β_DD beside β, both deviations
    of the process noise, distrust.

    Parameters
    ----------
    runs
        Candidate -> the run that is drawn; only hybrids are.
    prepared
        Recordings, from which the networks' outputs are computed again.
    warm_up
        Of the estimates, before the first scored sample [s].
    span
        The manoeuvre.
    constant : array, shape (2,)
        Deviations of the filter's process noise where no network gives them [m/s, rad/s].
    data
        Data sets, for the caption.
    """
    hybrids = {candidate: run for candidate, run in runs.items() if candidate in paper.HYBRIDS}
    outputs = _network_outputs(hybrids, prepared, warm_up, span)
    parts = {candidate: run.test[span.recording][0] for candidate, run in hybrids.items()}
    with new_figure(DOUBLE_COLUMN, 4.4) as figure:
        grid = figure.subplots(2, 2, sharex=True)
        _angles(grid[0, 0], parts)
        for candidate, (time, output) in outputs.items():
            line = line_of(candidate)
            label = f"{candidate}, its network's"
            grid[0, 0].plot(
                time,
                np.degrees(output.sideslip),
                color=line.colour,
                linewidth=0.7,
                alpha=0.55,
                label=label,
            )
            grid[1, 0].plot(
                time,
                np.degrees(np.sqrt(output.variance)),
                color=line.colour,
                linestyle=line.dash,
                linewidth=1.0,
            )
            if output.process is not None:
                for axes, deviation in zip(grid[:, 1], np.sqrt(output.process).T, strict=True):
                    axes.plot(
                        time, deviation, color=line.colour, linestyle=line.dash, linewidth=1.0
                    )
        for axes, level in zip(grid[:, 1], constant.tolist(), strict=True):
            axes.axhline(
                level,
                color=line_of(paper.DEEP).colour,
                linestyle=line_of(paper.DEEP).dash,
                linewidth=1.0,
            )
        labels = (
            "β [deg]",
            r"$\sigma_{V_y}$ [m/s]",
            r"$\sigma_{DD}$ [deg]",
            r"$\sigma_{\dot\psi}$ [rad/s]",
        )
        for axes, label, letter in zip(grid.flat, labels, "abcd", strict=True):
            axes.set_ylabel(label)
            axes.set_title(f"({letter})", loc="left")
            axes.margins(x=0.0)
            if letter != "a":
                _deviations(axes)
        for axes in grid[1]:
            axes.set_xlabel("time [s]")
        legend_above(figure, grid[0, 0], columns=3)
    caption = (
        f"Networks of the hybrids in the slalom of Figure 1 (Figure 8 of the paper). Data: {data}."
    )
    return Figure("figure_8", caption, figure)


def angles_of_networks(
    runs: Mapping[str, Run], prepared: Prepared, warm_up: float, span: Span, data: str
) -> Figure:
    """β of both hybrids and β_DD of their networks in one manoeuvre (Figure 13); parameters as of
    `inner_life`.
    """
    with new_figure(DOUBLE_COLUMN, 2.7) as figure:
        axes = figure.subplots()
        _angles(axes, {candidate: run.test[span.recording][0] for candidate, run in runs.items()})
        for candidate, (time, output) in _network_outputs(runs, prepared, warm_up, span).items():
            label = f"{candidate}, its network's"
            axes.plot(
                time,
                np.degrees(output.sideslip),
                color=line_of(candidate).colour,
                linewidth=0.8,
                alpha=0.6,
                label=label,
            )
        axes.set_xlabel("time [s]")
        axes.margins(x=0.0)
        legend_above(figure, axes, columns=5)
    return Figure(
        "figure_13",
        f"Networks of the hybrids in the same J-turn (Figure 13 of the paper). Data: {data}.",
        figure,
    )


def lap(
    runs: Mapping[str, Run], prepared: Prepared, warm_up: float, span: Span, data: str
) -> Figure:
    """Angles, accelerations and distrust in the part of a lap with the largest mean |ay| (Figure
    10).

    The part lasts `LAP_SECONDS`, or as long as the lap. Parameters are as of `inner_life`.
    """
    scored_lap = next(iter(runs.values())).test[span.recording][0]
    length = min(
        round(LAP_SECONDS / float(scored_lap.time[1] - scored_lap.time[0])), len(scored_lap.time)
    )
    first = int(np.convolve(np.abs(scored_lap.ay), np.ones(length), "valid").argmax())
    window = (float(scored_lap.time[first]), float(scored_lap.time[first + length - 1]))
    parts = {
        candidate: _within(run.test[span.recording][0], window) for candidate, run in runs.items()
    }
    drive = prepared.recording(span.dataset, span.recording).cut(*window)
    hybrids = {candidate: run for candidate, run in runs.items() if candidate in paper.HYBRIDS}
    with new_figure(DOUBLE_COLUMN, 4.9) as figure:
        grid = figure.subplots(3, 1, sharex=True, height_ratios=(1.6, 1.0, 1.0))
        _angles(grid[0], parts)
        time = drive.time - window[0]
        grid[1].plot(time, drive["ay"], color="#444444", label="$a_y$")
        grid[1].plot(time, drive["ax"], color="#999999", linestyle="dashed", label="$a_x$")
        grid[1].set_ylabel("acceleration [m/s²]")
        for candidate, (at, output) in _network_outputs(
            hybrids, prepared, warm_up, span, window
        ).items():
            line = line_of(candidate)
            grid[2].plot(
                at,
                np.degrees(np.sqrt(output.variance)),
                color=line.colour,
                linestyle=line.dash,
                linewidth=1.0,
            )
        _deviations(grid[2])
        grid[2].set_ylabel(r"$\sigma_{DD}$ [deg]")
        grid[2].set_xlabel("time [s]")
        for axes in grid:
            axes.margins(x=0.0)
        legend_above(figure, grid[0], grid[1], columns=5)
    caption = f"Part of a lap (Figure 10 of the paper), {as_code(span.recording)}. Data: {data}."
    return Figure("figure_10", caption, figure)


def _network_outputs(
    hybrids: Mapping[str, Run],
    prepared: Prepared,
    warm_up: float,
    span: Span,
    window: tuple[float, float] | None = None,
) -> dict[str, tuple[FloatArray, PseudoMeasurement]]:
    """Candidate -> times from the start of what is scored [s], and its network's outputs there."""
    drive = (
        prepared.recording(span.dataset, span.recording)
        .cut(span.start - warm_up, span.stop)
        .without_references()
    )
    outputs = {}
    for candidate, run in hybrids.items():
        scored = _within(run.test[span.recording][0], window)
        (output,) = pseudo_measurements_of(run, [drive])
        is_scored = (drive.time >= scored.time[0] - 1e-9) & (drive.time <= scored.time[-1] + 1e-9)
        process = None if output.process is None else output.process[is_scored]
        outputs[candidate] = (
            drive.time[is_scored] - scored.time[0],
            PseudoMeasurement(output.sideslip[is_scored], output.variance[is_scored], process),
        )
    return outputs


def _within(part: Scored, window: tuple[float, float] | None) -> Scored:
    if window is None:
        return part
    return part.at((part.time >= window[0]) & (part.time <= window[1]))


def _from_start(part: Scored) -> FloatArray:
    return part.time - part.time[0]


def _angles(axes: Any, parts: Mapping[str, Scored]) -> None:
    """Draw the reference and each estimate of β over the time from the first scored sample
    [deg].
    """
    first = next(iter(parts.values()))
    axes.plot(
        _from_start(first),
        np.degrees(first.sideslip_ref),
        color=REFERENCE.colour,
        linewidth=1.5,
        label="reference",
    )
    for candidate, part in parts.items():
        line = line_of(candidate)
        axes.plot(
            _from_start(part),
            np.degrees(part.sideslip),
            color=line.colour,
            linestyle=line.dash,
            linewidth=1.0,
            label=candidate,
        )
    axes.set_ylabel("sideslip angle [deg]")


def _deviations(axes: Any) -> None:
    """A vertical axis of standard deviations: logarithmic where they span a factor of five and
    more; plain numbers at the ticks.
    """
    low, high = axes.dataLim.intervaly
    if high < WIDE * low:
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
