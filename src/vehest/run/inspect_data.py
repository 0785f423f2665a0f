"""Output of `vehest data list | show | check | usable`: data set or file -> recordings -> rows, and
lines for a terminal.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vehest.alignment.checks import checks_of_recording
from vehest.artefacts.artefact import find
from vehest.configuration.composition import Config, compose_config
from vehest.configuration.files import choices
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording import Recording
from vehest.data.recording_summary import RecordingSummary, stored_summary, summary_of
from vehest.data.store import read_recording
from vehest.run.ingest import plan_ingest, recording_file
from vehest.run.named_files import require_dataset_or_file
from vehest.run.printing import TerminalTable
from vehest.run.usable import SCORED, absent_channels, all_usabilities, usability_lines
from vehest.sources.base import kind_of, open_source, origin_in_words, read_single
from vehest.sources.tabular import unused_columns

# Time stamps between these count from 1970.
MIN_UNIX_SECONDS = 6e8  # s, in 1989
MAX_UNIX_SECONDS = 4e9  # s, in 2096
MAX_LISTED_COLUMNS = 40  # largest number of columns of a table that are listed
SPREAD = ("min", "mean", "max", "std")  # statistics of a channel that are listed

Lines = list[str | TerminalTable]  # lines and tables for a terminal


def list_datasets() -> tuple[list[dict[str, str]], Lines, list[str]]:
    """Data sets with their files' presence, licences and citations, for JSON and for a terminal,
    and why others cannot be listed.

    Returns
    -------
    tuple
        Rows with ``dataset``, ``kind``, ``source``, ``here``, ``title``, ``licence`` and
        ``citation``; lines and tables; errors, a line each.
    """
    rows = []
    errors = []
    for name in choices("dataset"):
        try:
            dataset = compose_config("ingest", [f"dataset={name}"])["dataset"]
        except ConfigurationError as error:
            errors.append(f"data set '{name}': {error}")
            continue
        row = {
            "dataset": name,
            "kind": kind_of(dataset),
            "source": str(dataset.get("source", "")),
            "here": _is_here(dataset),
        }
        rows.append(
            row
            | {
                key: " ".join(str(dataset.get(key, "")).split())
                for key in ("title", "licence", "citation")
            }
        )
    keys = ("dataset", "kind", "source", "here", "title")
    table = TerminalTable(("data set", *keys[1:]), [[row[key] for key in keys] for row in rows])
    cited = [
        line
        for row in rows
        for line in (f"{row['dataset']}: {row['licence']}", f"  cite: {row['citation']}")
    ]
    return rows, [table, "", "licences and citations", *cited], errors


def describe(source: str, overrides: Sequence[str]) -> tuple[dict[str, Any], Lines]:
    """Describe the recordings of a data set or file, with statistics of their channels: plain
    values for JSON, and lines for a terminal.

    Raises `VehestError`.

    Parameters
    ----------
    source : str
        Name of a data set, or path of a file.
    overrides : sequence of str
        Of conf/ingest.yaml or conf/estimate.yaml.
    """
    with reading(source, overrides) as config:
        recordings = [_plain_summary(read()) for _, read in _readers(source, config)]
    lines: Lines = []
    for recording in recordings:
        period = _describe_time_range(recording["start"], recording["end"])
        about = (
            f"{recording['id']}: {recording['kind']}, {recording['vehicle']}, "
            f"{recording['rate_hz']:g} Hz, {period}"
        )
        rows = [
            [channel["name"], channel["unit"], *(f"{channel[key]:.4g}" for key in SPREAD)]
            for channel in recording["channels"]
        ]
        lines += [
            f"{about}, {recording['samples']} samples",
            *(f"  {line}" for line in recording["origin"]),
        ]
        lines.append(TerminalTable(("channel", "unit", *SPREAD), rows))
    return {"source": source, "recordings": recordings}, lines


def check(source: str, overrides: Sequence[str]) -> tuple[list[dict[str, str]], Lines]:
    """Run the checks on all recordings of a data set or file: rows for JSON, and lines for a
    terminal.

    A recording that cannot be read is an error too.

    Returns
    -------
    tuple
        Rows with ``level``, ``recording``, ``check``, ``channel`` and ``message``, and lines.
    """
    rows: list[dict[str, str]] = []
    with reading(source, overrides) as config:
        for name, read in _readers(source, config):
            try:
                recording = read()
            except DataError as error:
                rows.append(
                    {
                        "level": "error",
                        "recording": name,
                        "check": "read",
                        "channel": "",
                        "message": str(error),
                    }
                )
            else:
                findings = checks_of_recording(recording)
                rows += [{"recording": recording.id, **asdict(finding)} for finding in findings]
    lines: Lines = []
    for row in rows:
        channel = f" {row['channel']}:" if row["channel"] else ""
        lines.append(f"{row['level']:<7} {row['recording']}:{channel} {row['message']}")
    return rows, lines or ["no findings"]


def examine_usability(source: str, overrides: Sequence[str]) -> tuple[dict[str, Any], Lines]:
    """Estimators that a data set or file can be used with, and missing channels: for JSON and for a
    terminal.

    Raises `VehestError`.

    Returns
    -------
    tuple
        Missing channels, unused columns and a row an estimator (`Usability.as_plain`); and lines
        and tables.
    """
    with reading(source, overrides) as config:
        recordings = _contents(source, config)
        columns = unused_columns(
            config["dataset"], None if source in choices("dataset") else Path(source)
        )
    if not recordings:
        raise DataError(f"'{source}' contains no recordings")
    rows = all_usabilities(recordings, config["dataset"])
    missing = absent_channels(SCORED, recordings).to_estimate
    lines = usability_lines(rows)
    if missing:
        lines.append(f"missing channels that every score requires: {' and '.join(missing)}")
    if columns:
        names = ", ".join(columns[:MAX_LISTED_COLUMNS]) + (
            ", …" if len(columns) > MAX_LISTED_COLUMNS else ""
        )
        lines.append(
            f"columns without a channel: {names}; if one of them is a missing channel, declare it "
            "in conf/dataset"
        )
    plain = {
        "source": source,
        "recordings": [recording.id for recording in recordings],
        "rate_hz": min(recording.rate_hz for recording in recordings),
        "missing_to_score": missing,
        "unused_columns": columns,
        "estimators": [row.as_plain() for row in rows],
    }
    return plain, lines


@contextmanager
def reading(source: str, overrides: Sequence[str]) -> Iterator[Config]:
    """Context with the configuration that reads a data set or a file, and with its limits in
    effect.

    Yields
    ------
    Config
        As composed for ``ingest`` or, of a file, for ``estimate``.

    Raises
    ------
    VehestError
        It is neither (`require_dataset_or_file`).
    """
    require_dataset_or_file(source)
    if source in choices("dataset"):
        config = compose_config("ingest", [f"dataset={source}", *overrides])
    else:
        config = compose_config("estimate", overrides)
    with use_limits(limits_from_config(config["limits"])):
        yield config


def _contents(source: str, config: Config) -> list[RecordingSummary]:
    """Summaries of the recordings, from the store where they are ingested; of a slow source only of
    the first.
    """
    ingested = find(plan_ingest(config)) if source in choices("dataset") else None
    if ingested is not None:
        return [stored_summary(ingested.folder / file) for file in ingested.outputs]
    first = 1 if open_source(config["dataset"]).slow else None
    return [summary_of(read()) for _, read in islice(_readers(source, config), first)]


def _readers(source: str, config: Config) -> Iterator[tuple[str, Callable[[], Recording]]]:
    """Names of the recordings and functions that read them, from the store where a slow source is
    ingested.
    """
    if source not in choices("dataset"):
        yield Path(source).name, partial(read_single, config["dataset"], Path(source))
        return
    origin = open_source(config["dataset"])
    ingested = find(plan_ingest(config)) if origin.slow else None
    for name in origin.ids():
        yield (
            name,
            partial(origin.read, name)
            if ingested is None
            else partial(read_recording, ingested.folder / recording_file(name)),
        )


def _plain_summary(recording: Recording) -> dict[str, Any]:
    """Rate, start, end, channels with their statistics, provenance and origin of a recording, as
    plain values.
    """
    return {
        "id": recording.id,
        "vehicle": recording.vehicle,
        "kind": recording.kind,
        "rate_hz": recording.rate_hz,
        "start": recording.start_time,
        "end": recording.end_time,
        "samples": len(recording),
        "channels": [
            {"name": name, "unit": CHANNELS[name].unit, **_spread(samples)}
            for name, samples in recording.channels.items()
        ],
        "provenance": dict(recording.provenance),
        "origin": origin_in_words(recording),
    }


def _spread(samples: FloatArray) -> dict[str, float]:
    """Range, mean and standard deviation of the measured samples; NaN where there are none."""
    measured = samples[~np.isnan(samples)]
    with np.errstate(over="ignore", invalid="ignore"):
        return {
            name: float(getattr(measured, name)()) if len(measured) else math.nan for name in SPREAD
        }


def _describe_time_range(start: float, end: float) -> str:
    """Text of start and end of a recording [s]; for unix time the date, and seconds from it on."""
    if not MIN_UNIX_SECONDS < start < MAX_UNIX_SECONDS:
        return f"{start:.6g} s to {end:.6g} s"
    return (
        f"0 s to {end - start:.6g} s from {datetime.fromtimestamp(start, UTC):%Y-%m-%d %H:%M:%S} "
        "UTC on"
    )


def _is_here(dataset: dict[str, Any]) -> str:
    """Whether the files of a data set are available: ``yes``, ``no``, or ``no root`` where
    VEHEST_DATA is not set; simulated data always are.
    """
    if dataset.get("source") == "simulated":
        return "yes"
    if not os.environ.get("VEHEST_DATA"):
        return "no root"
    try:
        open_source(dataset).inputs()
    except VehestError:
        return "no"
    return "yes"
