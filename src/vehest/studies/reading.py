"""Recordings of a part, and what they are."""

from __future__ import annotations

from collections.abc import Iterable

from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.studies.artefacts import StudyArtefacts


def recordings_of(part: StudyArtefacts, spans: Iterable[Span]) -> list[Recording]:
    """Scored ranges at the evaluation rate, references included."""
    return [read_recording(part.references[span.dataset, span.recording]).cut(span.start, span.stop) for span in spans]


def words_of_kinds(part: StudyArtefacts) -> str:
    """``real``, ``simulated`` or both, of all that a part draws on."""
    return " and ".join(sorted({part.kinds[name] for name in part.split.datasets}))
