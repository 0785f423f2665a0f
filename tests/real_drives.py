"""Drives of real cars, each read once."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from vehest.data.recording import Recording
from vehest.run.config import compose_config
from vehest.sources.base import Source, open_source

FERRARI = "20140222_01_01_03_250lm"


@cache
def source_of(data_root: Path, dataset: str = "ferrari_250lm") -> Source:
    return open_source(compose_config("ingest", [f"dataset={dataset}", f"root={data_root}"])["dataset"])


@cache
def real_drive(data_root: Path, recording: str = FERRARI, dataset: str = "ferrari_250lm") -> Recording:
    return source_of(data_root, dataset).read(recording)
