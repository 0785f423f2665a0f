"""All signals of a test set for the page of a report: what was measured, the reference, estimates
with bands and health, the course.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.evaluation.metrics import Scored, pieces_of, scored_range
from vehest.report.explorer import explorer_json, in_display_unit, reckoned_course
from vehest.report.style import Line, on_dark
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.runs import Name
from vehest.trust.health import health_rows
from vehest.trust.record import TRUST, read_trust

MAX_INPUTS = 16  # channels that the page can draw; further ones are left out
DRAWN_INPUTS = ("vx", "yaw_rate", "ay", "steer", "handwheel")  # those that are shown at first
# note of the page where the course is dead-reckoned
RECKONED = (
    "No positions were recorded: the course is integrated from speed, reference and yaw rate, and "
    "drifts with time."
)


def explorer_of(
    artefacts: PartArtefacts,
    test_set: str,
    candidates_drawn: Mapping[Name, tuple[EvaluatedModel, str, Line]],
    scored: Mapping[Name, Sequence[Scored]],
    axis: tuple[float, str, int, tuple[float, float]],
) -> str:
    """Content that the page draws of a test set, as `explorer_json`.

    Parameters
    ----------
    artefacts : PartArtefacts
        The comparison; recordings are read at the evaluation rate.
    test_set : str
        The test set.
    candidates_drawn : Mapping[Name, tuple[EvaluatedModel, str, Line]]
        (estimator, variant) -> model, title and looks, in the order of the board.
    scored : Mapping[Name, Sequence[Scored]]
        (estimator, variant) -> estimate and reference of each range, or sequence.
    axis : tuple[float, str, int, tuple[float, float]]
        First time [s], label of the time axis, samples between two ranges, and a range that
        deserves a button [s].

    Returns
    -------
    str
        JSON: times, inputs in display units, reference, estimates with bands and health, and the
        course, integrated from speed and yaw rate where one was measured. Missing values are gaps.
    """
    start, label, gap, zoom = axis
    spans = artefacts.split.tests[test_set]
    pieces = list(pieces_of(spans, artefacts.reference, artefacts.protocol))
    skip = artefacts.protocol.skip_seconds
    parts = [
        recording.cut(max(piece.start, recording.start_time) + skip, piece.stop)
        for recording, piece in pieces
    ]

    def measured(name: str) -> FloatArray:
        return chained(
            [part[name] if name in part else np.full(len(part), np.nan) for part in parts], gap
        )

    names = [
        name
        for name in CHANNELS
        if all(name in part for part in parts) and not CHANNELS[name].is_reference
    ]
    vx = measured("vx")
    vy_ref = measured("vy_ref")
    step = 1.0 / artefacts.protocol.rate_hz
    columns: dict[str, FloatArray | None] = {
        "vx": vx,
        "vy": vy_ref,
        "scored": chained(
            [part.is_sideslip_scored.astype(np.float64) for part in next(iter(scored.values()))],
            gap,
        ),
        "ay": measured("ay") if "ay" in names else None,
    }
    inputs = []
    candidates = []
    for i, name in enumerate(names[:MAX_INPUTS]):
        columns[f"input{i}"], unit = in_display_unit(name, measured(name))
        inputs.append({"label": name, "unit": unit, "drawn": name in DRAWN_INPUTS})
    for i, (candidate, (model, title, line)) in enumerate(candidates_drawn.items()):
        columns[f"vy{i}"] = chained([part.vy for part in scored[candidate]], gap)
        bands = [part.bands for part in scored[candidate]]
        band_vy, band_sideslip = (
            chained([half_widths[q] for half_widths in bands], gap)
            if all(q in half_widths for half_widths in bands)
            else None
            for q in _BANDS
        )
        columns |= {
            f"bandv{i}": band_vy,
            f"bandb{i}": None if band_sideslip is None else np.degrees(band_sideslip),
        }
        columns[f"health{i}"] = health_over(model, pieces, artefacts, gap)
        candidates.append(
            {"label": title, "colour": line.colour, "dark": on_dark(line.colour), "dash": line.dash}
        )
    turning = next(
        (name for name in ("yaw_rate_ref", "yaw_rate") if all(name in part for part in parts)), None
    )
    if turning is not None:
        columns["x"], columns["y"] = reckoned_course(vx, vy_ref, measured(turning), step)
    content = {
        "start": start,
        "step": step,
        "length": len(vx),
        "timeLabel": label,
        "zoom": list(zoom),
        "inputs": inputs,
    }
    return explorer_json({**content, "candidates": candidates, "courseNote": RECKONED}, columns)


_BANDS = ("vy", "sideslip")  # quantities with calibrated bands


def chained(pieces: Sequence[FloatArray], gap: int) -> FloatArray:
    """Concatenate pieces with a gap of NaN between two.

    Parameters
    ----------
    pieces : sequence of FloatArray
        One-dimensional, at least one.
    gap : int
        Samples between two pieces.
    """
    between = np.full(gap, np.nan)
    parts: list[FloatArray] = [part for piece in pieces for part in (piece, between)]
    return np.concatenate(parts[:-1])


def health_over(
    model: EvaluatedModel,
    pieces: Sequence[tuple[Recording, Span]],
    artefacts: PartArtefacts,
    gap: int,
) -> FloatArray | None:
    """Health status of a model over all ranges, by the channels that it reads: 0 valid, 1 degraded,
    2 invalid.

    None where the model has no health, or reads another rate than that of the evaluation.

    Parameters
    ----------
    model : EvaluatedModel
        Its trust.yaml contains the health, if it was calibrated.
    pieces : sequence of (Recording, Span)
        Recordings with the ranges that are scored.
    artefacts : PartArtefacts
        For the evaluation rate, warm-up and skipped seconds.
    gap : int
        Samples between two ranges, NaN in the result.

    Returns
    -------
    FloatArray or None
        (K,), over the scored samples; the health itself starts with the warm-up. Also None where a
        recording lacks a channel that the health reads.
    """
    if model.calibration_folder is None or not (model.calibration_folder / TRUST).is_file():
        return None
    health = read_trust(model.calibration_folder).health
    if health is None or health.rate_hz != artefacts.protocol.rate_hz:
        return None
    if not all(name in recording for recording, _ in pieces for name in health.channels):
        return None
    statuses = []
    for recording, piece in pieces:
        first, end = scored_range(recording, piece, artefacts.protocol)
        begin = recording.index_range(
            max(piece.start, recording.start_time) - artefacts.protocol.warm_up_seconds, piece.stop
        )[0]
        rows = np.ascontiguousarray(recording.stack(health.channels)[begin:end])
        statuses.append(
            health_rows(health.packed(), rows, np.isfinite(rows), health.start()).status[
                first - begin :
            ]
        )
    return chained(statuses, gap)
