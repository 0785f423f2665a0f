"""Signals of ASAM MDF files, each with the times of its group."""

from __future__ import annotations

from pathlib import Path

from vehest.sources.mdf import read_measurement
from vehest.sources.surveys.log import Log, RawColumn


def survey_mdf(file: Path) -> Log:
    """What a measurement holds: every signal of numbers whose group has times; raises `MissingError` or, if damaged, `DataError`."""
    signals, skipped, about = read_measurement(file, None)
    columns = []
    for key, signal in signals.items():
        place = about["signals"][key]
        entry = {"column": place["name"]} | ({} if key == place["name"] else {"group": place["group"]})
        columns.append(RawColumn(key, signal.unit, signal.values, entry, signal.stamps))
    return Log(file, "mdf", tuple(columns), skipped=tuple(skipped))
