"""Logs of a VBOX: columns as `vehest.sources.vbo` reads them."""

from __future__ import annotations

from pathlib import Path

from vehest.sources.surveys.log import Log, RawColumn, Stamps
from vehest.sources.vbo import read_log

DEGREES = {"heading": "deg"}
"""Units that the format has without saying so; the heading of satellites is a compass's, clockwise from north."""


def survey_vbo(file: Path) -> Log:
    """What a log holds.

    Raises:
        DataError: it is no such file, is damaged, or is more than the limits allow.
    """
    log = read_log(file)
    units = {**DEGREES, **log.units}
    columns = tuple(RawColumn(name, units.get(name, ""), samples, {"column": name}) for name, samples in log.columns.items())
    clock = Stamps("time", "s", "clock time of the format")
    return Log(file, "vbo", columns, {}, clock, log.seconds - log.seconds[0], (slice(0, len(log.seconds)),))
