"""First stage: raw files, or a simulation, to recordings in the store."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from vehest.alignment.checks import checks_of_recording
from vehest.data.errors import ConfigurationError, DataError, printable
from vehest.data.files import remove, remove_leftovers, sha256_of
from vehest.data.recording import Recording
from vehest.data.store import write_recording
from vehest.run.artefacts import StagePlan
from vehest.run.config import Config, missing_keys
from vehest.run.failures import Failure
from vehest.run.launchers.local import launch
from vehest.run.locks import held
from vehest.run.signals import StopSignals
from vehest.sources.base import Source, open_source, source_class
from vehest.training.context import Progress

STAGE = "ingest"
VERSION = "1"
PARTS_PREFIX = ".parts-"
LONGEST_ID = 200  # bytes
Report = Callable[[int, int, str], None]
PROSE = frozenset({"path", "title", "licence", "citation", "download"})  # of a data set's configuration; says nothing about its samples


def plan_ingest(config: Config) -> StagePlan:
    """What an ingest would make.

    Args:
        config: as composed for ``ingest``.

    Raises:
        MissingError: the raw files are not there.
        ConfigurationError: the data set's configuration makes no sense.
        DataError: a recording's name cannot be a file's.
    """
    dataset: Mapping[str, Any] = config["dataset"]
    missing = missing_keys(dict(dataset))
    if missing:
        raise ConfigurationError(f"data set '{dataset.get('name')}': dataset.{missing[0]} is not set")
    source = open_source(dataset)
    if not source.ids():
        raise ConfigurationError(f"data set '{source.name}' names no recordings")
    for recording_id in source.ids():
        recording_file(recording_id)
    inputs = {name: sha256_of(origin) if isinstance(origin, Path) else str(origin) for name, origin in source.inputs().items()}
    return StagePlan(
        stage=STAGE,
        label=source.name,
        config={key: value for key, value in dataset.items() if key not in PROSE},
        inputs=inputs,
        code=code_of_ingest(dataset),
        output=Path(config["output"]),
    )


def code_of_ingest(dataset: Mapping[str, Any]) -> str:
    """Version of what an ingest runs.

    Args:
        dataset: its configuration.
    """
    return f"ingest={VERSION} {dataset['source']}={source_class(dataset).version}"


def write_ingest(config: Config, plan: StagePlan, folder: Path, jobs: int, stop: StopSignals, report: Report) -> None:
    """Read every recording, check it, and write it into ``folder``.

    Where recordings take long to make, they are made side by side, and those that are done are kept beside the artefacts until all
    are: a run that was interrupted goes on with the missing ones.

    Args:
        config: as composed for ``ingest``.
        plan: of this ingest.
        folder: empty.
        jobs: processes.
        stop: when a signal came, no other recording is begun.
        report: called with (recordings done, recordings in all, name of one that was begun).

    Raises:
        DataError: a recording cannot be used as it is.
        Stopped: a signal came.
    """
    source = open_source(config["dataset"])
    ids = source.ids()
    if source.slow:
        _make_side_by_side(config["dataset"], ids, plan, folder, jobs, stop, report)
        return
    for position, recording_id in enumerate(ids):
        report(position, len(ids), recording_id)
        _make(source, recording_id, folder)


def _make_side_by_side(
    dataset: Mapping[str, Any], ids: Sequence[str], plan: StagePlan, folder: Path, jobs: int, stop: StopSignals, report: Report
) -> None:
    parts = _parts_of(plan)
    parts.mkdir(parents=True, exist_ok=True)
    remove_leftovers(parts)
    missing = [recording_id for recording_id in ids if not (parts / recording_file(recording_id)).is_file()]
    tasks = [partial(_make_part, dict(dataset), recording_id, parts) for recording_id in missing]
    made, failures = [recording_id for recording_id in ids if recording_id not in missing], []
    for end in launch(tasks, jobs, stop, lambda at, _: report(len(made), len(ids), missing[at])):
        if isinstance(end.outcome, Failure):
            failures.append(end.outcome)
        else:
            made.append(end.outcome)
            report(len(made), len(ids), "")
    if not any(parts.iterdir() if parts.is_dir() else ()):
        remove(parts)
    stop.raise_if_requested()
    if failures:
        error = DataError(failures[0].message + (f" (and {len(failures) - 1} more)" if len(failures) > 1 else ""))
        error.exit_code = failures[0].exit_code
        raise error
    for recording_id in ids:
        _link(parts / recording_file(recording_id), folder / recording_file(recording_id))


def drop_parts(plan: StagePlan) -> None:
    """Remove what was kept for an ingest that is finished, unless somebody makes it once more."""
    if _parts_of(plan).exists():
        with held(plan.lock) as free:
            if free:
                remove(_parts_of(plan))


def _parts_of(plan: StagePlan) -> Path:
    return plan.folder.with_name(f"{PARTS_PREFIX}{plan.folder.name}")


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # not every file system has links
        shutil.copyfile(source, target)


def _make_part(
    dataset: Mapping[str, Any], recording_id: str, parts: Path, should_stop: Callable[[], bool], on_progress: Callable[[Progress], None]
) -> str:
    _make(open_source(dataset), recording_id, parts)
    return recording_id


def _make(source: Source, recording_id: str, folder: Path) -> None:
    recording = source.read(recording_id)
    refuse_unusable(recording, source)
    write_recording(recording, folder / recording_file(recording_id))


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


def recording_file(recording_id: str) -> str:
    """The name of a recording's file in the store: the id itself, since splits and later stages find recordings by it.

    Raises:
        DataError: the id cannot be a file's name, or would lead elsewhere.
    """
    odd = any(character in "/\\" or ord(character) < 32 for character in recording_id)
    if odd or not recording_id or recording_id.startswith(".") or len(os.fsencode(recording_id)) > LONGEST_ID:
        raise DataError(
            f"a recording cannot be called '{printable(recording_id[:60])}': its name is a file's name in the store, "
            f"of up to {LONGEST_ID} bytes, without '/', '\\' and control characters, and no hidden one"
        )
    return f"{recording_id}.parquet"
