"""Errors of trained candidates at little yaw rate, and with biases removed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.luenberger import Luenberger
from vehest.estimators.model_files import load_model
from vehest.evaluation.blocks import Segments, segments_of
from vehest.evaluation.metrics import pieces_of, score
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.kit.reading import recordings_of
from vehest_papers.kit.spectra import mean_bias
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.comparing import SegmentErrors, masked_segments, yaw_rates
from vehest_papers.ksnn.schemes import Scheme

AT_LOW_YAW_RATE = (
    paper.ZERO,
    paper.STATIC_MAP,
    paper.LUENBERGER,
    paper.GRU,
    paper.LSTM,
    *paper.STRUCTURED,
)
BIASED = (paper.LSTM, *paper.STRUCTURED)
MAX_SHARE = 0.999  # share of low yaw rates from which on nothing else is left


@dataclass(frozen=True, eq=False)
class Behaviour:
    """Errors of the candidates of a scheme on the other car under special conditions."""

    low_yaw_rate: SegmentErrors  # categories, where |ω| lies below it
    corrected: SegmentErrors  # categories, the mean bias of a_y removed

    @classmethod
    def of(cls, scheme: Scheme) -> Behaviour:
        """Run the networks of a scheme again."""
        observer = luenberger_of(scheme)
        test = scheme.other_test
        labels = scheme.labels.get(test)
        recordings = [span.recording for span in scheme.part.split.tests[test]]
        low: dict[str, list[Segments]] = {}
        if observer is not None:
            low, _ = at_low_yaw_rate(scheme, observer.threshold, AT_LOW_YAW_RATE, test)
        biases = mean_biases(scheme)
        corrected = {name: without_biases(scheme, name, biases, test) for name in BIASED}
        return cls(
            SegmentErrors(low, labels, _seeds(scheme, low), recordings),
            SegmentErrors(corrected, labels, _seeds(scheme, corrected), recordings),
        )


def _seeds(scheme: Scheme, categories: Iterable[str]) -> dict[str, list[int]]:
    return {name: [model.seed for model in scheme.models(name)] for name in categories}


def luenberger_of(scheme: Scheme) -> Luenberger | None:
    """The fitted observer of a scheme."""
    model = scheme.model(paper.LUENBERGER)
    if model is None:
        return None
    estimator = load_model(model.model_folder)
    return estimator if isinstance(estimator, Luenberger) else None


def at_low_yaw_rate(
    scheme: Scheme, threshold: float, categories: Sequence[str], test: str
) -> tuple[dict[str, list[Segments]], float]:
    """Segments of each category where |ω| lies below the observer's threshold [rad/s], and the
    share of such samples.

    None where the observer is reset never or (almost) always.
    """
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
        for model in scheme.models(category):
            scored = part.scored(model, test)
            masks: list[FloatArray] = [
                (np.abs(yaw_rate) < threshold).astype(float)
                for yaw_rate in yaw_rates(scored, recordings)
            ]
            share = float(np.concatenate(masks).mean())
            segments.setdefault(category, []).append(masked_segments(scored, masks, rate))
    return segments if 0.0 < share < MAX_SHARE else {}, share


def _reference(scheme: Scheme, span: Span) -> Recording:
    return read_recording(scheme.part.references[span.dataset, span.recording])


def mean_biases(scheme: Scheme) -> dict[str, float]:
    """Mean of v̇ - (a_y - ωu_m) over the training set of the ``own`` car and over the validation
    set, of the ``other`` [m/s²].
    """
    part = scheme.part
    return {
        "own": mean_bias(recordings_of(part, part.split.train)),
        "other": mean_bias(recordings_of(part, part.split.validation)),
    }


def without_biases(
    scheme: Scheme, category: str, biases: Mapping[str, float], test: str
) -> list[Segments]:
    """Segments of each seed of a category with the mean bias of a_y removed (Section IX-A), which
    takes the reference.

    Nothing is trained again: a network that can hold an offset (with biases, GRU, LSTM) has learnt
    that of its own car, so that the other's a_y is given the own car's.

    Parameters
    ----------
    scheme
        A comparison whose validation range is a set of the car that ``test`` is of.
    biases
        As `mean_biases` gives them.
    test
        The other car's test set.
    """
    return [_corrected(scheme, model, biases, test) for model in scheme.models(category)]


def _corrected(
    scheme: Scheme, model: EvaluatedModel, biases: Mapping[str, float], test: str
) -> Segments:
    part = scheme.part
    estimator = load_model(model.model_folder)
    holds_offset = not (isinstance(estimator, Ksnn) and not estimator.settings.bias)
    shift = biases["other"] - (biases["own"] if holds_offset else 0.0)
    scored = []
    for reference, piece in pieces_of(
        part.split.tests[test], lambda span: _reference(scheme, span), part.protocol
    ):
        measured = reference.without_references()
        shifted = replace(measured, channels={**measured.channels, "ay": measured["ay"] + shift})
        scored.append(score(estimator.estimate([shifted])[0], reference, piece, part.protocol))
    return segments_of(scored, part.protocol.rate_hz)
