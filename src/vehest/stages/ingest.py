"""First stage: raw files, or a simulation, to recordings in the store."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vehest.data.checks import checks_of_recording
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.files import sha256_of
from vehest.data.recording import Recording
from vehest.data.store import write_recording
from vehest.sources.base import Source, open_source, source_module
from vehest.stages.artefacts import StagePlan
from vehest.stages.code_version import code_version
from vehest.stages.config import Config, missing_keys

STAGE = "ingest"
PROSE = frozenset({"path", "title", "licence", "citation", "download"})  # of a data set's configuration; says nothing about its samples


def plan_ingest(config: Config) -> StagePlan:
    """What an ingest would make.

    Args:
        config: as composed for ``ingest``.

    Raises:
        MissingError: the raw files are not there.
        ConfigurationError: the data set's configuration makes no sense.
    """
    dataset: Mapping[str, Any] = config["dataset"]
    missing = missing_keys(dict(dataset))
    if missing:
        raise ConfigurationError(f"data set '{dataset.get('name')}': dataset.{missing[0]} is not set")
    source = open_source(dataset)
    if not source.ids():
        raise ConfigurationError(f"data set '{source.name}' names no recordings")
    inputs = {name: sha256_of(origin) if isinstance(origin, Path) else str(origin) for name, origin in source.inputs().items()}
    return StagePlan(
        stage=STAGE,
        label=source.name,
        config={key: value for key, value in dataset.items() if key not in PROSE},
        inputs=inputs,
        code=code_version([source_module(dataset), "vehest.data.store", "vehest.data.checks"], own=[__name__]),
        output=Path(config["output"]),
    )


def write_ingest(config: Config, folder: Path, report: Any = None) -> None:
    """Read every recording, check it, and write it into ``folder``.

    Args:
        config: as composed for ``ingest``.
        folder: empty.
        report: called with (recordings done, recordings in all, name of the next) before each.

    Raises:
        DataError: a recording cannot be used as it is.
    """
    source = open_source(config["dataset"])
    ids = source.ids()
    for position, recording_id in enumerate(ids):
        if report is not None:
            report(position, len(ids), recording_id)
        recording = source.read(recording_id)
        refuse_unusable(recording, source)
        write_recording(recording, folder / f"{_file_name(recording_id)}.parquet")


def refuse_unusable(recording: Recording, source: Source) -> None:
    """Stop where a check finds an error that the data set does not accept.

    Raises:
        DataError: what was found.
    """
    accepted = set(source.dataset.get("accept") or [])
    for finding in checks_of_recording(recording):
        if finding.level == "error" and finding.check not in accepted:
            raise DataError(
                f"data set '{source.name}', recording '{recording.id}': channel '{finding.channel}': {finding.message} "
                f"(or accept: [{finding.check}])"
            )


def _file_name(recording_id: str) -> str:
    if not recording_id or recording_id.startswith(".") or any(character in recording_id for character in "/\\\0"):
        raise DataError(f"a recording cannot be called '{recording_id}': its name is a file's name in the store")
    return recording_id
