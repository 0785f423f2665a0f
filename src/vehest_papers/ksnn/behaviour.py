"""Behaviour of trained candidates beside their errors: at little yaw rate, after the start of a window, with biases removed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.luenberger import Luenberger
from vehest.estimators.model_files import load_model
from vehest.estimators.networks.windowed import WindowedEstimator
from vehest.evaluation.blocks import Segments, segments_of
from vehest.evaluation.metrics import Scored, is_fast_enough, pieces_of, score
from vehest.studies.artefacts import EvaluatedModel
from vehest.training.members import prepare
from vehest_papers.kit.reading import recordings_of
from vehest_papers.kit.spectra import mean_bias
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.comparing import SegmentErrors, masked_segments, yaw_rates
from vehest_papers.ksnn.schemes import Scheme, segments_on

WINDOWS = (
    5,
    10,
    15,
    20,
    30,
    45,
    60,
    90,
)  # samples after the start at v = 0 at which errors are read
STRIDE = 4  # every so many samples of a test drive end windows
MOST_SEEDS = 3  # seeds of a candidate that are run again here
HIGHEST_SHARE = 0.999  # share of low yaw rates from which on nothing else is left


def luenberger_of(scheme: Scheme) -> Luenberger | None:
    """The fitted observer of a scheme."""
    model = scheme.model(paper.LUENBERGER)
    if model is None:
        return None
    estimator = load_model(model.model_folder)
    return estimator if isinstance(estimator, Luenberger) else None


def at_low_yaw_rate(
    scheme: Scheme, threshold: float, categories: Sequence[str], test: str
) -> tuple[SegmentErrors, float]:
    """SegmentErrors where |ω| lies below the observer's threshold [rad/s], and the share of such samples."""
    part = scheme.part
    rate = scheme.part.protocol.rate_hz
    recordings = [
        reference
        for reference, _ in pieces_of(
            part.split.tests[test], lambda span: _reference(scheme, span), part.protocol
        )
    ]
    segments: dict[str, list[Segments]] = {}
    share = math.nan
    for category in categories:
        for model in scheme.models(category)[: 2 * MOST_SEEDS]:
            scored = part.scored(model, test)
            masks: list[FloatArray] = [
                (np.abs(own) < threshold).astype(float) for own in yaw_rates(scored, recordings)
            ]
            share = float(np.concatenate(masks).mean())
            segments.setdefault(category, []).append(masked_segments(scored, masks, rate))
    return SegmentErrors(
        segments if 0.0 < share < HIGHEST_SHARE else {}, f"{test} at little yaw rate"
    ), share


def _reference(scheme: Scheme, span: Span) -> Recording:
    return read_recording(scheme.part.references[span.dataset, span.recording])


def after_start(scheme: Scheme, category: str, test: str) -> SegmentErrors:
    """Errors of a network by the length of its window: how far it has come so long after it started at v = 0, û = u_m.

    All windows end at the same samples. Candidates are called by the length, in samples.
    """
    segments: dict[str, list[Segments]] = {}
    spans = scheme.part.split.tests[test]
    recordings = recordings_of(scheme.part, spans)
    speeds = [scheme.part.protocol.min_sideslip_speed_on(span.dataset) for span in spans]
    for model in scheme.models(category)[:MOST_SEEDS]:
        estimator = load_model(model.model_folder)
        if (
            not isinstance(estimator, WindowedEstimator)
            or abs(estimator.settings.rate_hz - recordings[0].rate_hz) > 1e-9
        ):
            return SegmentErrors({}, test)
        for length in WINDOWS:
            parts = [
                own
                for recording, speed in zip(recordings, speeds, strict=True)
                if (own := _with_window(estimator, recording, length, speed)) is not None
            ]
            if parts:
                segments.setdefault(str(length), []).append(
                    segments_of(parts, recordings[0].rate_hz / STRIDE)
                )
    return SegmentErrors(segments, f"{test} after the start", same_models=True)


def _with_window(
    estimator: WindowedEstimator, recording: Recording, length: int, min_sideslip_speed: float
) -> Scored | None:
    """Estimates from windows of a length, every `STRIDE` samples from where the longest is full."""
    ends = np.arange(max(WINDOWS), len(recording), STRIDE)
    if not len(ends):
        return None
    network = estimator.network
    dtype = next(network.parameters()).dtype
    with torch.no_grad():
        series = prepare(network, torch.as_tensor(recording.stack(estimator.channels), dtype=dtype))
        windows = series.unfold(0, length, 1).transpose(1, 2)[ends - length]
        vy = network(windows).double().numpy().reshape(-1)
    speed, reference, ay = (recording[name][ends] for name in ("vx", "vy_ref", "ay"))
    return Scored(
        recording.time[ends],
        vy,
        reference,
        np.arctan2(vy, speed),
        np.arctan2(reference, speed),
        ay,
        is_fast_enough(speed, reference, min_sideslip_speed),
    )


def without_biases(
    scheme: Scheme, categories: Sequence[str], test: str
) -> tuple[SegmentErrors, dict[str, float]]:
    """Errors with the measured a_y and with each car's mean bias taken off (Section IX-A), and the biases of both cars [m/s²].

    The mean of v̇ - (a_y - ωu_m) over a car's training set, which takes the reference, is added to its a_y. Nothing is trained again: a
    network that can hold an offset (with biases, GRU, LSTM) has learnt that of its own car, so that the other's a_y is given the own car's.

    Args:
        scheme: a comparison whose validation range is a set of the car that ``test`` is of.
        test: the other car's test set.

    Returns:
        Candidates ``CATEGORY, as measured`` and ``CATEGORY, corrected``; biases by ``own`` and ``other``.
    """
    part = scheme.part
    biases = {
        "own": mean_bias(recordings_of(part, part.split.train)),
        "other": mean_bias(recordings_of(part, part.split.validation)),
    }
    segments: dict[str, list[Segments]] = {}
    for category in categories:
        for model in scheme.models(category)[:MOST_SEEDS]:
            segments.setdefault(f"{category}, as measured", []).append(segments_on(model, test))
            segments.setdefault(f"{category}, corrected", []).append(
                _corrected(scheme, model, biases, test)
            )
    return SegmentErrors(segments, f"{test} with and without biases", same_models=True), biases


def _corrected(
    scheme: Scheme, model: EvaluatedModel, biases: dict[str, float], test: str
) -> Segments:
    part = scheme.part
    estimator = load_model(model.model_folder)
    holds_offset = not (isinstance(estimator, Ksnn) and not estimator.settings.bias)
    shift = biases["other"] - (biases["own"] if holds_offset else 0.0)
    scored = []
    for reference, piece in pieces_of(
        part.split.tests[test], lambda span: _reference(scheme, span), part.protocol
    ):
        seen = reference.without_references()
        shifted = replace(seen, channels={**seen.channels, "ay": seen["ay"] + shift})
        scored.append(score(estimator.estimate([shifted])[0], reference, piece, part.protocol))
    return segments_of(scored, part.protocol.rate_hz)
