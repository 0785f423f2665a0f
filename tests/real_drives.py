"""Drives of real cars, each read once."""

from functools import cache

from vehest.configuration.composition import compose_config
from vehest.sources.base import open_source

FERRARI = "20140222_01_01_03_250lm"


@cache
def source_of(data_root, dataset="ferrari_250lm"):
    """Source of a real data set."""
    return open_source(
        compose_config("ingest", [f"dataset={dataset}", f"root={data_root}"])["dataset"]
    )


@cache
def real_drive(data_root, recording=FERRARI, dataset="ferrari_250lm"):
    """A real recording, read once."""
    return source_of(data_root, dataset).read(recording)
