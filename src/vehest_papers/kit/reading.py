"""Recordings and metrics of a part of a study, and figures in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.evaluation.metrics import Scored
from vehest.report.document import as_text
from vehest.report.style import MISSING, fixed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, nominal_rows

MAX_RANGES_NAMED = 12


def recordings_of(part: PartArtefacts, spans: Iterable[Span]) -> list[Recording]:
    """Scored ranges at the evaluation rate, references included."""
    return [
        read_recording(part.references[span.dataset, span.recording]).cut(span.start, span.stop)
        for span in spans
    ]


def lengths_of(part: PartArtefacts, spans: Iterable[Span]) -> list[int]:
    """Samples of each range at the evaluation rate."""
    return [len(recording) for recording in recordings_of(part, spans)]


def models_by_candidate(
    part: PartArtefacts, candidate_of: Callable[[EvaluatedModel], str], order: Sequence[str]
) -> dict[str, list[EvaluatedModel]]:
    """Candidate -> its seeds, candidates in a given order; others come last.

    Raises
    ------
    DataError
        Two models of one candidate have the same seed.
    """
    groups: dict[str, list[EvaluatedModel]] = {}
    for model in part.models:
        groups.setdefault(candidate_of(model), []).append(model)
    for name, models in groups.items():
        if len({model.seed for model in models}) != len(models):
            raise DataError(
                f"study '{part.study}': candidate {name} was trained twice with one seed; give "
                "each variant a part of its own"
            )
    names = [
        *(name for name in order if name in groups),
        *(name for name in groups if name not in order),
    ]
    return {name: sorted(groups[name], key=lambda model: model.seed) for name in names}


def words_of_kinds(part: PartArtefacts) -> str:
    """``real``, ``simulated`` or both, of all that a part draws on."""
    return " and ".join(sorted({part.kinds[name] for name in part.split.datasets}))


def spans_in_words(spans: Sequence[Span]) -> str:
    """Recordings, with their times where they are not used whole; many of them are counted."""
    if not spans:
        return MISSING
    words = []
    for span in spans:
        is_complete = span.start == -math.inf and span.stop == math.inf
        words.append(
            as_text(span.recording)
            if is_complete
            else f"{as_text(span.recording)} ({_times(span)})"
        )
    return (
        ", ".join(words)
        if len(words) <= MAX_RANGES_NAMED
        else f"{len(words)} ranges of {len({span.recording for span in spans})} recordings"
    )


def _times(span: Span) -> str:
    if span.start == -math.inf:
        return f"up to {span.stop:g} s"
    return (
        f"from {span.start:g} s" if span.stop == math.inf else f"{span.start:g} to {span.stop:g} s"
    )


def sideslip_error(part: Scored) -> FloatArray:
    """Estimate - reference, (K,) [deg], within a half turn."""
    return np.degrees(np.remainder(part.sideslip - part.sideslip_ref + np.pi, 2.0 * np.pi) - np.pi)


def metric_values(part: PartArtefacts) -> dict[tuple[str, str, int, str, str], float]:
    """Values over all samples under nominal conditions.

    Returns
    -------
    dict
        (estimator, variant, seed, test set, metric) -> value.
    """
    return {
        (
            str(row["estimator"]),
            str(row["variant"]),
            int(row["seed"]),
            str(row["test_set"]),
            str(row["metric"]),
        ): float(row["value"])
        for row in nominal_rows(part.metrics).to_dict("records")
    }


def median_and_range(values: FloatArray, decimals: int) -> str:
    """Median and range of some seeds: ``0.0135 [0.0130, 0.0141]``; a single value alone."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return MISSING
    median = float(np.median(finite))
    if len(finite) == 1:
        return fixed(median, decimals)
    return with_interval(median, float(finite.min()), float(finite.max()), decimals)


def with_interval(value: float, low: float, high: float, decimals: int, unit: str = "") -> str:
    """A figure with its interval: ``0.0086 [0.0071, 0.0101]``, or with a unit ``0.12° [0.10,
    0.15]``.
    """
    return f"{fixed(value, decimals)}{unit} [{fixed(low, decimals)}, {fixed(high, decimals)}]"
