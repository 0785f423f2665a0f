"""Summaries of recordings, without their samples: channels, those with gaps, and the sampling
rate.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.data.parquet import parquet_file
from vehest.data.recording import Recording
from vehest.data.store import RecordingDescription, description_of


@dataclass(frozen=True)
class RecordingSummary:
    """Channels and rate of a recording."""

    id: str  # name, unique within its data set
    rate_hz: float  # sampling rate [Hz]
    channels: frozenset[str]  # names of the channels
    gappy: frozenset[str] = frozenset()  # those of them that were not measured throughout


def summary_of(recording: Recording) -> RecordingSummary:
    """Summary of a recording; ``gappy`` are those channels that do have gaps."""
    gappy = frozenset(name for name in recording.gappy if np.isnan(recording[name]).any())
    return RecordingSummary(recording.id, recording.rate_hz, frozenset(recording.channels), gappy)


def stored_summary(path: Path) -> RecordingSummary:
    """Summary of a stored recording, from its file's description; no samples are read.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It is damaged, or is no recording that vehest wrote.
    """
    with parquet_file(path) as file:
        schema = file.schema_arrow
    described = description_of(schema, path, RecordingDescription)
    channels = frozenset(schema.names)
    return RecordingSummary(described.id, described.rate_hz, channels, described.gappy & channels)


def common_channels(recordings: Iterable[RecordingSummary]) -> frozenset[str]:
    """Channels that all recordings have; none where there are no recordings."""
    channel_sets = [recording.channels for recording in recordings]
    return frozenset.intersection(*channel_sets) if channel_sets else frozenset()
