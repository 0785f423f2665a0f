"""Looking at data sets and files: what `vehest data list | show | check | usable` print."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from vehest.alignment.checks import checks_of_recording
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.contents import Contents, contents_of, stored_contents
from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording import Recording
from vehest.data.store import read_recording
from vehest.run.artefacts import find
from vehest.run.config import Config, compose_config
from vehest.run.config_files import choices
from vehest.run.ingest import plan_ingest, recording_file
from vehest.run.printing import TerminalTable
from vehest.run.usable import HEADER, Missing, Usability, all_usabilities, borrowed_cars, remedies, table_row, unscored
from vehest.sources.base import kind_of, open_source, origin_in_words, read_single
from vehest.sources.unused import unused_columns

EARLIEST_UNIX, LATEST_UNIX = 6e8, 4e9  # s, 1989 to 2096: time stamps of recordings in between count from 1970
MOST_COLUMNS = 40  # of a table that are listed


def dataset_rows() -> list[dict[str, str]]:
    """A row a data set: name, kind, source, whether its files are here, title, licence, citation."""
    rows = []
    for name in choices("dataset"):
        dataset = compose_config("ingest", [f"dataset={name}"])["dataset"]
        rows.append(
            {
                "dataset": name,
                "kind": kind_of(dataset),
                "source": str(dataset.get("source", "")),
                "here": _is_here(dataset),
                "title": str(dataset.get("title", "")),
                "licence": " ".join(str(dataset.get("licence", "")).split()),
                "citation": " ".join(str(dataset.get("citation", "")).split()),
            }
        )
    return rows


def datasets_in_words(rows: Sequence[Mapping[str, str]]) -> list[str | TerminalTable]:
    """Data sets for a terminal, with their licences and what to cite."""
    shown = ("dataset", "kind", "source", "here", "title")
    table = TerminalTable("", ("data set", *shown[1:]), [[row[key] for key in shown] for row in rows])
    cited = [line for row in rows for line in (f"{row['dataset']}: {row['licence']}", f"  cite: {row['citation']}")]
    return [table, "", "licences and citations", *cited]


def recordings_in_words(described: Mapping[str, Any]) -> Iterator[str | TerminalTable]:
    """What `describe` found, for a terminal."""
    for recording in described["recordings"]:
        yield (
            f"{recording['id']}: {recording['kind']}, {recording['vehicle']}, {recording['rate_hz']:g} Hz, "
            f"{_stretch(recording['start'], recording['end'])}, {recording['samples']} samples"
        )
        yield from (f"  {line}" for line in recording["origin"])
        rows = [[c["name"], c["unit"], *(f"{c[key]:.4g}" for key in ("min", "mean", "max", "std"))] for c in recording["channels"]]
        yield TerminalTable("", ("channel", "unit", "min", "mean", "max", "std"), rows)


def _stretch(start: float, end: float) -> str:
    """When a recording begins and ends [s]; of unix time the date, and seconds from it on."""
    if not EARLIEST_UNIX < start < LATEST_UNIX:
        return f"{start:.6g} s to {end:.6g} s"
    return f"0 s to {end - start:.6g} s from {datetime.fromtimestamp(start, UTC):%Y-%m-%d %H:%M:%S} UTC on"


def finding_row_in_words(row: Mapping[str, str]) -> str:
    """A row of `check` as a line."""
    channel = f" {row['channel']}:" if row["channel"] else ""
    return f"{row['level']:<7} {row['recording']}:{channel} {row['message']}"


def describe(source: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Recordings of a data set or file, with ranges of their channels.

    Raises:
        VehestError: they cannot be read.
    """
    config = config_of(source, overrides)
    with use_limits(limits_from_config(config["limits"])):
        return {"source": source, "recordings": [_described(recording) for recording in _recordings(source, config)]}


def check(source: str, overrides: Sequence[str]) -> list[dict[str, str]]:
    """What the checks find, a row a finding; a recording that cannot be read is an error too."""
    config = config_of(source, overrides)
    with use_limits(limits_from_config(config["limits"])):
        return [row for recording in _recordings(source, config) for row in _finding_rows(recording)]


@dataclass(frozen=True)
class Examined:
    """What estimators could do with a data set or file.

    Args:
        source: its name.
        recordings: what they have; of a simulation that has not been ingested one alone.
        rows: an estimator each.
        unscored: channels by which every estimate is scored and that are missing.
        columns: of a table, that no channel uses.
    """

    source: str
    recordings: tuple[Contents, ...]
    rows: tuple[Usability, ...]
    unscored: tuple[Missing, ...]
    columns: tuple[str, ...]

    @property
    def rate_hz(self) -> float:
        """The lowest rate [Hz]."""
        return min(recording.rate_hz for recording in self.recordings)

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "source": self.source,
            "recordings": [recording.id for recording in self.recordings],
            "rate_hz": self.rate_hz,
            "missing_to_score": [missing.channel for missing in self.unscored],
            "unused_columns": list(self.columns),
            "estimators": [row.as_plain() for row in self.rows],
        }

    def in_words(self) -> list[str | TerminalTable]:
        """For a terminal."""
        lines: list[str | TerminalTable] = [TerminalTable("", HEADER, [table_row(row) for row in self.rows]), "", *remedies(self.rows)]
        if self.unscored:
            lines.append(f"every estimate is scored by {' and '.join(missing.channel for missing in self.unscored)}")
        if self.columns:
            names = ", ".join(self.columns[:MOST_COLUMNS]) + (", …" if len(self.columns) > MOST_COLUMNS else "")
            lines.append(
                f"columns that no channel uses: {names}; what is not in the log may be one of them, to be declared in conf/dataset"
            )
        borrowed = borrowed_cars(self.rows)
        return [*lines, borrowed] if borrowed else lines


def examine_usability(source: str, overrides: Sequence[str]) -> Examined:
    """Which estimators a data set or file can be used with, and what it lacks.

    Raises:
        VehestError: it cannot be read.
    """
    config = config_of(source, overrides)
    with use_limits(limits_from_config(config["limits"])):
        recordings = tuple(_contents(source, config))
        if not recordings:
            raise DataError(f"'{source}' holds no recordings")
        columns = unused_columns(config["dataset"], None if source in choices("dataset") else Path(source))
    return Examined(source, recordings, tuple(all_usabilities(recordings)), unscored(recordings), tuple(columns))


def _contents(source: str, config: Config) -> Iterator[Contents]:
    """What recordings have: from the store if they are there, else from what is read; of a slow source the first."""
    if source in choices("dataset"):
        ingested = find(plan_ingest(config))
        if ingested is not None:
            yield from (stored_contents(ingested.folder / file) for file in ingested.outputs)
            return
    slow = open_source(config["dataset"]).slow
    for recording in _recordings(source, config):
        if isinstance(recording, tuple):
            raise recording[1]
        yield contents_of(recording)
        if slow:
            return


def config_of(source: str, overrides: Sequence[str]) -> Config:
    """The configuration that reads a data set, or else a file.

    Raises:
        ConfigurationError: it is neither, or an override makes no sense.
    """
    if source in choices("dataset"):
        return compose_config("ingest", [f"dataset={source}", *overrides])
    if not os.path.lexists(source):  # which says no, too, where a name is too long or holds a null character
        raise ConfigurationError(f"'{source}' is neither a data set ({', '.join(choices('dataset'))}) nor a file")
    return compose_config("estimate", overrides)


def _spread(samples: FloatArray) -> dict[str, float]:
    """Smallest, mean and largest value and standard deviation of what was measured; NaN where nothing was."""
    functions: dict[str, Callable[[FloatArray], Any]] = {"min": np.min, "mean": np.mean, "max": np.max, "std": np.std}
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: float(function(samples)) if len(samples) else math.nan for name, function in functions.items()}


def _described(recording: Recording | tuple[str, VehestError]) -> dict[str, Any]:
    if isinstance(recording, tuple):
        raise recording[1]
    channels = [
        {
            "name": name,
            "unit": CHANNELS[name].unit,
            **_spread(samples[~np.isnan(samples)]),
        }
        for name, samples in recording.channels.items()
    ]
    return {
        "id": recording.id,
        "vehicle": recording.vehicle,
        "kind": recording.kind,
        "rate_hz": recording.rate_hz,
        "start": recording.start_time,
        "end": recording.end_time,
        "samples": len(recording),
        "channels": channels,
        "provenance": dict(recording.provenance),
        "origin": origin_in_words(recording),
    }


def _finding_rows(recording: Recording | tuple[str, VehestError]) -> list[dict[str, str]]:
    if isinstance(recording, tuple):
        name, error = recording
        return [{"level": "error", "recording": name, "check": "read", "channel": "", "message": str(error)}]
    return [
        {
            "level": finding.level,
            "recording": recording.id,
            "check": finding.check,
            "channel": finding.channel,
            "message": finding.message,
        }
        for finding in checks_of_recording(recording)
    ]


def _recordings(source: str, config: Config) -> Iterator[Recording | tuple[str, VehestError]]:
    """Recordings one after another; one that cannot be read comes as its name and the error."""
    if source not in choices("dataset"):
        file = Path(source)
        try:
            yield read_single(config["dataset"], file)
        except DataError as error:
            yield file.name, error
        return
    origin = open_source(config["dataset"])
    ingested = find(plan_ingest(config)) if origin.slow else None
    if ingested is not None:  # the same samples as the source would make again
        for recording_id in origin.ids():
            yield read_recording(ingested.folder / recording_file(recording_id))
        return
    for recording_id in origin.ids():
        try:
            yield origin.read(recording_id)
        except DataError as error:
            yield recording_id, error


def _is_here(dataset: dict[str, Any]) -> str:
    if dataset.get("source") == "simulated":
        return "yes"
    if not os.environ.get("VEHEST_DATA"):
        return "no root"
    try:
        open_source(dataset).inputs()
    except VehestError:
        return "no"
    return "yes"
