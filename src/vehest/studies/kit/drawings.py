"""Signals of a test set end to end, and the figures that are drawn of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, listed
from vehest.estimators.registry import estimator_class
from vehest.evaluation.metrics import BoolArray, Scored
from vehest.report import figures
from vehest.report.comparison_figures import Cloud, agreement_figure, clouds_figure
from vehest.report.document import Figure
from vehest.report.figures import MIN_UNIX_SECONDS
from vehest.report.style import REFERENCE, REFERENCE_GREY, Line
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.explorer import chained, explorer_of
from vehest.studies.kit.runs import Name

ZOOM_SECONDS = 20.0  # s, length of the busiest part, which has a figure of its own
MAX_IN_ZOOM = 4  # estimates in the figure of the busiest seconds
TEST_COLOUR = "#0b4f9c"  # colour of the test set besides the training ranges in the g-g diagram


@dataclass(frozen=True, eq=False)
class DriveSignals:
    """Estimates and reference over all scored ranges of a test set, with a gap of NaN between two
    ranges.
    """

    artefacts: PartArtefacts  # the comparison
    test_set: str  # name of the test set
    # (estimator, variant) -> model, title and line, in the order in which they are drawn
    candidates: Mapping[Name, tuple[EvaluatedModel, str, Line]]
    ranges: Mapping[Name, Sequence[Scored]]  # signals of each candidate, one for each range
    joined: Mapping[Name, Scored]  # the ranges of each candidate end to end

    @property
    def reference(self) -> Scored:
        """Signals of the first candidate, whose time, reference and acceleration are those of
        all.
        """
        return next(iter(self.joined.values()))

    @property
    def step(self) -> float:
        """Time between two samples [s]."""
        return 1.0 / self.artefacts.protocol.rate_hz

    @property
    def has_ay(self) -> bool:
        """Whether the lateral acceleration was measured at every sample."""
        drive = self.reference
        return bool(np.isfinite(drive.ay[~np.isnan(drive.vy_ref)]).all())  # not in the gaps

    @property
    def time_label(self) -> str:
        """Label of the time axis."""
        ranges = next(iter(self.ranges.values()))
        return "time [s]" if len(ranges) == 1 else "time, ranges end to end [s]"

    @property
    def busiest(self) -> tuple[float, float]:
        """Start and end [s] of the `ZOOM_SECONDS` with the largest mean square of β."""
        return _busiest(next(iter(self.ranges.values())), self.reference.time, self.step)


def signals_of(
    artefacts: PartArtefacts,
    board: pd.DataFrame,
    test_set: str,
    lines: Mapping[Name, Line],
) -> DriveSignals:
    """Read the estimates and references of a test set for the models in the rows of a leaderboard.

    Parameters
    ----------
    artefacts : PartArtefacts
        The comparison.
    board : pd.DataFrame
        Rows of a leaderboard with estimator, variant, seed and title; their order is that of
        drawing.
    test_set : str
        The test set whose estimates are read.
    lines : mapping
        (estimator, variant) -> colour, dash and marker.

    Returns
    -------
    DriveSignals
        Estimates of all candidates at the evaluation rate.

    Raises
    ------
    DataError
        An estimate is damaged, or does not cover its range.
    """
    models = {(*model.name, model.seed): model for model in artefacts.models}
    candidates = {
        (row["estimator"], row["variant"]): (
            models[row["estimator"], row["variant"], row["seed"]],
            str(row["title"]),
            lines[row["estimator"], row["variant"]],
        )
        for row in board.to_dict("records")
    }
    ranges = {name: artefacts.scored(model, test_set) for name, (model, _, _) in candidates.items()}
    step = 1.0 / artefacts.protocol.rate_hz
    joined = {name: _joined(parts, step) for name, parts in ranges.items()}
    return DriveSignals(artefacts, test_set, candidates, ranges, joined)


def is_scored_somewhere(signals: DriveSignals) -> bool:
    """Whether sideslip is scored, and drawn, at any sample of the test set."""
    return bool(signals.reference.is_sideslip_drawn.any())


def traces_block(signals: DriveSignals, file: str) -> Figure:
    """Figure ``traces_FILE``: every estimate with the reference over the whole test set."""
    drive = signals.reference
    return Figure(
        f"traces_{file}",
        "Lateral velocity and sideslip over the whole test set. Grey: measured; coloured: "
        "estimated, of each estimator the seed chosen on validation.",
        figures.traces_figure(
            drive.time,
            _reference_trace(signals),
            _estimate_traces(signals),
            [figures.root_mean_square(error) for _, _, error in _errors(signals)],
            signals.time_label,
        ),
    )


def busiest_block(signals: DriveSignals, file: str) -> Figure:
    """Figure ``zoom_FILE``: the busiest `ZOOM_SECONDS`.

    On the page, all traces of the test set, which begin there.

    Parameters
    ----------
    signals : DriveSignals
        At most MAX_IN_ZOOM estimates are drawn, the first ones.
    file : str
        End of the figure's name.

    Returns
    -------
    Figure
        With the content of the page's interactive plot (`explorer_of`).
    """
    drive = signals.reference
    start, stop = signals.busiest
    inside = (drive.time >= start) & (drive.time <= stop)
    reference, *estimates = (
        figures.Traces(t.label, t.line, t.vy[inside], t.sideslip[inside])
        for t in (_reference_trace(signals), *_estimate_traces(signals)[:MAX_IN_ZOOM])
    )
    band = _band_of_first(signals, estimates[0], inside)
    return Figure(
        f"zoom_{file}",
        f"The {stop - start:.0f} s with the largest mean square of the measured sideslip. Sideslip"
        f"{f' with the calibrated 90 % band of {estimates[0].label}' if band else ''}, its error "
        "(estimate − measured), "
        f"lateral velocity{' and the measured lateral acceleration' * signals.has_ay}."
        f"{_trace_notes(signals)}",
        figures.zoom_figure(
            drive.time[inside],
            drive.ay[inside] if signals.has_ay else None,
            reference,
            estimates,
            signals.time_label,
            band,
        ),
        _explorer(signals),
    )


def _trace_notes(signals: DriveSignals) -> str:
    """Sentences of a caption, one for each family whose traces need an explanation."""
    titles: dict[str, list[str]] = {}
    for (name, _), (_, title, _) in signals.candidates.items():
        with suppress(ConfigurationError):  # a family of a package that is not installed here
            if note := estimator_class(name).trace_note:
                titles.setdefault(note, []).append(title)
    return "".join(f" {listed(names)}: {note}." for note, names in titles.items())


def _band_of_first(
    signals: DriveSignals, estimate: figures.Traces, inside: BoolArray
) -> figures.Band | None:
    """Bands of the first candidate at some samples; None where it has none."""
    parts = next(iter(signals.ranges.values()))
    if not all("vy" in part.bands and "sideslip" in part.bands for part in parts):
        return None
    gap = _gap_of(parts)
    half_vy = chained([part.bands["vy"] for part in parts], gap)
    half_sideslip = chained([part.bands["sideslip"] for part in parts], gap)
    return figures.Band(estimate, half_vy[inside], np.degrees(half_sideslip[inside]))


def behaviour_blocks(signals: DriveSignals, file: str) -> list[Figure]:
    """Figures ``agreement_FILE`` and, with lateral acceleration, ``over_ay_FILE``: estimate over
    reference, β over ay, g-g.
    """
    drive = signals.reference
    is_drawn = drive.is_sideslip_drawn
    reference = np.degrees(drive.sideslip_ref)[is_drawn]
    clouds = [
        Cloud(title, line.colour, reference, np.degrees(estimate.sideslip)[is_drawn])
        for (_, title, line), estimate in zip(
            signals.candidates.values(), signals.joined.values(), strict=True
        )
    ]
    agreement = Figure(
        f"agreement_{file}",
        "Estimated over measured sideslip at evenly spaced samples of the test set. On the line "
        "both are equal.",
        agreement_figure(reference, clouds),
    )
    if not signals.has_ay:
        return [agreement]
    ay = drive.ay[is_drawn]
    first = clouds[0]
    panels: list[tuple[list[Cloud], str, str, bool]] = [
        (
            [
                Cloud("measured", REFERENCE_GREY, ay, reference),
                Cloud(first.label, first.colour, ay, first.y),
            ],
            "$a_y$ [m/s²]",
            "sideslip [deg]",
            False,
        )
    ]
    accelerations = _accelerations(signals)
    if accelerations:
        panels.append((accelerations, "$a_y$ [m/s²]", "$a_x$ [m/s²]", True))
    caption = "Sideslip over lateral acceleration on the test set, measured and estimated."
    if accelerations:
        caption += " G-g diagram: longitudinal over lateral acceleration of training and test."
    return [agreement, Figure(f"over_ay_{file}", caption, clouds_figure(panels))]


def _accelerations(signals: DriveSignals) -> list[Cloud]:
    """Longitudinal over lateral acceleration of the training ranges and the test set.

    Empty where either was not measured.
    """
    part = signals.artefacts
    roles = {"training": part.split.train, "test": part.split.tests[signals.test_set]}
    colours = {"training": REFERENCE_GREY, "test": TEST_COLOUR}
    clouds = []
    for role, spans in roles.items():
        recordings = part.reference_ranges(spans)
        if not recordings:
            continue
        if not all("ax" in recording and "ay" in recording for recording in recordings):
            return []
        ay, ax = (
            np.concatenate([recording[name] for recording in recordings]) for name in ("ay", "ax")
        )
        clouds.append(Cloud(role, colours[role], ay, ax))
    return clouds


def histogram_block(signals: DriveSignals, file: str) -> Figure:
    """Figure ``errors_FILE``: distribution of the sideslip error."""
    return Figure(
        f"errors_{file}",
        "Distribution of the sideslip error. The few errors beyond the axis are counted in its "
        "outermost bins.",
        figures.error_histogram(_errors(signals)),
    )


def error_over_ay_block(signals: DriveSignals, file: str) -> Figure:
    """Figure ``errors_over_ay_FILE``: sideslip error in bins of the lateral acceleration."""
    drive = signals.reference
    return Figure(
        f"errors_over_ay_{file}",
        "RMSE of sideslip over the magnitude of the measured lateral acceleration. Bins of 1 m/s²; "
        f"those of fewer than {figures.MIN_SAMPLES_IN_BIN} samples show no error.",
        figures.error_over_ay(drive.ay[drive.is_sideslip_scored], _errors(signals)),
    )


def _explorer(signals: DriveSignals) -> str:
    """Content of the page's interactive plot of the test set (`explorer_of`); unix times are
    counted from the start.
    """
    start = float(signals.reference.time[0])
    begin, label = (
        (start, "time after the start [s]")
        if start >= MIN_UNIX_SECONDS
        else (0.0, signals.time_label)
    )
    zoom = signals.busiest
    gap = _gap_of(next(iter(signals.ranges.values())))
    axis = (start - begin, label, gap, (zoom[0] - begin, zoom[1] - begin))
    return explorer_of(
        signals.artefacts, signals.test_set, signals.candidates, signals.ranges, axis
    )


def _reference_trace(signals: DriveSignals) -> figures.Traces:
    """The reference as a trace, its sideslip NaN where it is not drawn."""
    drive = signals.reference
    return figures.Traces(
        "measured", REFERENCE, drive.vy_ref, _where_drawn(drive, drive.sideslip_ref)
    )


def _estimate_traces(signals: DriveSignals) -> list[figures.Traces]:
    """Estimates as traces, in the order of the candidates."""
    return [
        figures.Traces(title, line, drive.vy, _where_drawn(drive, drive.sideslip))
        for (_, title, line), drive in zip(
            signals.candidates.values(), signals.joined.values(), strict=True
        )
    ]


def _errors(signals: DriveSignals) -> list[figures.Errors]:
    """Title, line and sideslip error [deg] at the scored samples, (K,), of each candidate."""
    return [
        (title, line, np.degrees(drive.sideslip_error)[drive.is_sideslip_scored])
        for (_, title, line), drive in zip(
            signals.candidates.values(), signals.joined.values(), strict=True
        )
    ]


def _joined(parts: Sequence[Scored], step: float) -> Scored:
    """Ranges one after another; a single one keeps its times.

    Times of several ranges are replaced by equal steps from zero; samples of the gaps are NaN and
    not scored.
    """
    if len(parts) == 1:
        return parts[0]
    gap = _gap_of(parts)

    def over(name: str) -> FloatArray:
        return chained([getattr(part, name) for part in parts], gap)

    vy = over("vy")
    time: FloatArray = np.arange(len(vy), dtype=np.float64) * step
    is_scored = np.nan_to_num(over("is_sideslip_scored")).astype(np.bool_)
    return Scored(
        time, vy, over("vy_ref"), over("sideslip"), over("sideslip_ref"), over("ay"), is_scored
    )


def _where_drawn(part: Scored, sideslip: FloatArray) -> FloatArray:
    """Sideslip where it is drawn, else NaN, (K,) [deg]."""
    return np.where(part.is_sideslip_drawn, np.degrees(sideslip), np.nan)


def _gap_of(parts: Sequence[Scored]) -> int:
    """Number of NaN samples between two ranges, so that the gap is visible in a figure."""
    return max(sum(len(part.time) for part in parts) // 60, 1)


def _busiest(parts: Sequence[Scored], time: FloatArray, step: float) -> tuple[float, float]:
    """Start and end [s] of the `ZOOM_SECONDS` with the largest mean square of the reference
    sideslip, within one range.
    """
    best = -math.inf
    first = 0
    length = 1
    offset = 0
    for part in parts:
        n = min(round(ZOOM_SECONDS / step), len(part.time))
        sideslip = np.where(part.is_sideslip_drawn, part.sideslip_ref, 0.0)
        power = np.convolve(np.square(sideslip), np.full(n, 1.0 / n), mode="valid")
        if power.max() > best:
            best = float(power.max())
            first = offset + int(power.argmax())
            length = n
        offset += len(part.time) + _gap_of(parts)
    return float(time[first]), float(time[first + length - 1])
