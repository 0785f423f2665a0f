"""Measurements by asammdf's own writer; for tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vehest.data.recording import Recording
from vehest.sources.base import open_source

ONE = {"vx": {"column": "v", "unit": "m/s"}}


def write_mdf(file: Path, groups: Mapping[str, list[Any]], version: str = "4.10", clock: Any = None, **options: Any) -> Path:
    """Write groups of signals, each on its own clock; ``clock`` is the conversion of the first group's times."""
    import asammdf

    with asammdf.MDF(version=version) as measurement:
        for name, signals in groups.items():
            measurement.append(signals, acq_name=name, comment=name, common_timebase=True)
        if clock is not None:
            measurement.groups[0].channels[measurement.masters_db[0]].conversion = clock
        saved = Path(measurement.save(file, overwrite=True, **options))
    return saved.rename(file)  # the writer chooses the suffix


def read_mdf(file: Path, **options: Any) -> Recording:
    """Read a measurement as a data set of 100 Hz declares it, by default its signal v."""
    declared = {"name": "mine", "source": "mdf", "path": str(file.parent), "files": file.name, "rate_hz": 100, "channels": ONE}
    return open_source(declared | options).read(file.stem)
