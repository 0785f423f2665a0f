"""What a recording has, without its samples: channels, those with gaps, and the sampling rate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.data.errors import DataError
from vehest.data.parquet import parquet_file
from vehest.data.recording import Recording
from vehest.data.schema import validated
from vehest.data.store import RecordingDescription
from vehest.data.text_files import parse_json

METADATA_KEY = b"vehest"


@dataclass(frozen=True)
class Contents:
    """What a recording has.

    Args:
        id: name, unique within its data set.
        rate_hz: sampling rate [Hz].
        channels: that it has.
        gappy: those of them that were not measured throughout.
    """

    id: str
    rate_hz: float
    channels: frozenset[str]
    gappy: frozenset[str] = frozenset()


def contents_of(recording: Recording) -> Contents:
    """What a recording at hand has; ``gappy`` are those channels that do have gaps."""
    gappy = frozenset(name for name in recording.gappy if np.isnan(recording[name]).any())
    return Contents(recording.id, recording.rate_hz, frozenset(recording.channels), gappy)


def stored_contents(path: Path) -> Contents:
    """What a recording in the store has, from the description in its file; ``gappy`` are those channels that may have gaps.

    Raises:
        MissingError: there is no such file.
        DataError: the file is damaged, or not a recording.
    """
    with parquet_file(path) as file:
        schema = file.schema_arrow
    told = parse_json((schema.metadata or {}).get(METADATA_KEY, b"{}"), f"'{path}': the description beside the table")
    if not isinstance(told, dict) or told.get("content") != "recording":
        raise DataError(f"'{path}' is a Parquet file, but not a recording that vehest wrote")
    described = validated(RecordingDescription, told, f"'{path}'")
    channels = frozenset(schema.names)
    return Contents(described.id, described.rate_hz, channels, described.gappy & channels)


def common_channels(recordings: Iterable[Contents]) -> frozenset[str]:
    """Channels that all recordings have; none where there are no recordings."""
    held = [recording.channels for recording in recordings]
    return frozenset.intersection(*held) if held else frozenset()
