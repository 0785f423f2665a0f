"""Measurements by asammdf's own writer; for tests."""

from pathlib import Path

from vehest.sources.base import open_source

ONE = {"vx": {"column": "v", "unit": "m/s"}}


def write_mdf(file, groups, version="4.10", clock=None, **options):
    """Write groups of signals, each on its own clock.

    ``clock`` is the conversion of the first group's times.
    """
    import asammdf

    with asammdf.MDF(version=version) as measurement:
        for name, signals in groups.items():
            measurement.append(signals, acq_name=name, comment=name, common_timebase=True)
        if clock is not None:
            measurement.groups[0].channels[measurement.masters_db[0]].conversion = clock
        saved = Path(measurement.save(file, overwrite=True, **options))
    return saved.rename(file)  # the writer chooses the suffix


def read_mdf(file, **options):
    """Read a measurement as a data set of 100 Hz declares it, by default its signal v."""
    declared = {
        "name": "mine",
        "source": "mdf",
        "path": str(file.parent),
        "files": file.name,
        "rate_hz": 100,
        "channels": ONE,
    }
    name = file.stem if options.get("run") is None else f"{file.stem}_run_{options['run']}"
    return open_source(declared | options).read(name)
