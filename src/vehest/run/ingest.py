"""First stage: raw files, or a simulation, to recordings in the store.

data set -> its files, fetched where they are missing -> source -> recording -> checks -> one
Parquet file each
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from vehest.alignment.checks import refuse_errors
from vehest.artefacts.artefact import Artefact, StagePlan
from vehest.configuration.composition import Config, compose_config, key_of, missing_keys
from vehest.configuration.files import choices
from vehest.data.errors import ConfigurationError, DataError, printable
from vehest.data.files import remove_leftovers, sha256_of
from vehest.data.store import read_recording, write_recording
from vehest.estimators.kernels.compiling import has_to_compile
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.launchers.local import launch
from vehest.run.next_commands import command_line
from vehest.run.signals import DryRunStop, StopSignals
from vehest.run.versions import code_of
from vehest.sources.base import SIMULATED, Source, open_source
from vehest.trust.health import SLOW_KERNEL, compile_health

STAGE = "ingest"  # name of the stage
PARTS_PREFIX = ".parts-"  # start of the name of a folder with recordings of an unfinished ingest
MAX_ID_BYTES = 200  # bytes of a recording's id, at most, since it is the name of a file
MAX_NAMES = 6  # recordings that an error names, at most
Report = Callable[
    [int, int, str], None
]  # recordings done, recordings in all, name of one that was begun
# keys of a data set's configuration on which samples do not depend
PROSE = frozenset({"path", "title", "licence", "citation", "download", "car"})


def plan_ingest(config: Config) -> StagePlan:
    """Plan the artefact of a data set's recordings.

    Parameters
    ----------
    config : Config
        As composed for ``ingest``.

    Returns
    -------
    StagePlan
        Its key holds the configuration but for `PROSE`, digests of raw files and the source's
        version.

    Raises
    ------
    VehestError
        Raw files are missing or the data set's configuration makes no sense.
    """
    dataset: Mapping[str, Any] = config["dataset"]
    if missing := missing_keys(dataset):
        raise ConfigurationError(
            f"data set '{dataset.get('name')}': dataset.{missing[0]} is not set"
        )
    source = open_source(dataset)
    if not source.ids():
        raise ConfigurationError(f"data set '{source.name}' names no recordings")
    for recording_id in source.ids():
        recording_file(recording_id)
    content = {key: value for key, value in dataset.items() if key not in PROSE}
    inputs = {
        name: sha256_of(origin) if isinstance(origin, Path) else str(origin)
        for name, origin in source.inputs().items()
    }
    return StagePlan(
        STAGE,
        source.name,
        content,
        inputs,
        code_of(STAGE, str(dataset["source"])),
        Path(config["output"]),
    )


def write_ingest(
    config: Config, plan: StagePlan, folder: Path, jobs: int, stop: StopSignals, report: Report
) -> None:
    """Read every recording, check it, and write it into ``folder``.

    Recordings of slow sources are made side by side and kept beside the artefacts until all are
    done: an interrupted run goes on.

    Parameters
    ----------
    config : Config
        As composed for ``ingest``.
    plan : StagePlan
        Of the artefact; names the folder of parts.
    folder : Path
        Of the artefact, while it is made.
    jobs : int
        Processes of a slow source.
    stop : StopSignals
        Asked between recordings.
    report : callable
        Takes the progress.

    Raises
    ------
    DataError
        A recording cannot be read, or a check finds an error that is not accepted.
    Stopped
        A signal came.
    """
    source = open_source(config["dataset"])
    ids = source.ids()
    if not source.slow:
        for position, recording_id in enumerate(ids):
            report(position, len(ids), recording_id)
            _make(source, recording_id, folder)
        return
    parts = parts_of(plan)
    parts.mkdir(parents=True, exist_ok=True)
    remove_leftovers(parts)
    missing = [
        recording_id for recording_id in ids if not (parts / recording_file(recording_id)).is_file()
    ]
    description = json.dumps(config["dataset"])
    tasks: list[Callable[..., None]] = [
        partial(make_part, description, recording_id, parts) for recording_id in missing
    ]
    if min(jobs, len(tasks)) > 1 and has_to_compile(
        SLOW_KERNEL
    ):  # while the first process compiles the plant, for which others wait
        tasks.insert(1, compile_health)
        missing.insert(1, "")
    done = len(ids) - len(missing) + missing.count("")
    failures: list[tuple[str, Failure]] = []  # with the recordings that were not made

    def begun(at: int, _: object) -> None:
        report(done, len(ids), missing[at])

    for end in launch(tasks, jobs, stop, begun):
        if isinstance(end.outcome, Failure) and missing[end.position]:
            failures.append((missing[end.position], end.outcome))
        else:
            done += missing[end.position] != ""
            report(done, len(ids), "")
    with suppress(OSError):
        parts.rmdir()  # unless something was made
    stop.raise_if_requested()
    if failures:
        raise _error_of(source.name, failures)
    for recording_id in ids:
        file = recording_file(recording_id)
        try:
            os.link(parts / file, folder / file)
        except OSError:  # not every file system has links
            shutil.copyfile(parts / file, folder / file)


def _error_of(dataset: str, failures: Sequence[tuple[str, Failure]]) -> DataError:
    """Error of an ingest: the first failure with its recording and exit code, and the names of
    other recordings that failed.
    """
    (recording_id, first), *further_failures = failures
    place = f"data set '{dataset}', recording '{recording_id}'"
    message = first.message if first.message.startswith(place) else f"{place}: {first.message}"
    if further_failures:
        names = [f"'{name}'" for name, _ in further_failures[:MAX_NAMES]]
        more = ", …" if len(further_failures) > MAX_NAMES else ""
        message += f" (and {len(further_failures)} more: {', '.join(names)}{more})"
    error = DataError(message)
    error.exit_code = first.exit_code
    return error


def make_part(description: str, recording_id: str, parts: Path, *_: object) -> None:
    """Make one recording in a worker process, in which the source is opened once."""
    _make(_opened(description), recording_id, parts)


@lru_cache(maxsize=1)
def _opened(description: str) -> Source:
    """The source of a data set, opened once in a process: it checks all drives of the data set."""
    return open_source(json.loads(description))


def _make(source: Source, recording_id: str, folder: Path) -> None:
    """Read, check and write a recording.

    Raises `DataError` where a check finds an error that the data set does not accept.
    """
    recording = source.read(recording_id)
    refuse_errors(
        recording,
        source.dataset.get("accept") or (),
        f"data set '{source.name}', recording '{recording.id}'",
    )
    write_recording(recording, folder / recording_file(recording_id))


def parts_of(plan: StagePlan) -> Path:
    """Folder of the finished recordings of an ingest while others are missing, beside the
    artefact's folder.
    """
    return plan.folder.with_name(f"{PARTS_PREFIX}{plan.folder.name}")


def recording_file(recording_id: str) -> str:
    """File name ``ID.parquet`` of a recording in the store, by its id.

    Raises
    ------
    DataError
        That cannot be a file's name or would lead elsewhere.
    """
    if (
        not re.fullmatch(r"[^/\\\x00-\x1f.][^/\\\x00-\x1f]*", recording_id)
        or len(os.fsencode(recording_id)) > MAX_ID_BYTES
    ):
        raise DataError(
            f"a recording cannot be called '{printable(recording_id[:60])}': its name is a file's "
            f"name in the store, of up to {MAX_ID_BYTES} bytes, without '/', '\\' and control "
            "characters, and no hidden one"
        )
    return f"{recording_id}.parquet"


def simulation_config(dataset: str, overrides: Sequence[str]) -> Config:
    """Configuration of a simulated data set's ingest.

    Override ``seed=1`` is short for ``dataset.seed=1``.

    Raises
    ------
    ConfigurationError
        There is no such data set, it is not simulated, or an override is wrong.
    """
    spelt_out = [
        f"dataset.{override.lstrip('+')}" if key_of(override).lstrip("+") == "seed" else override
        for override in overrides
    ]
    config = compose_config("ingest", [f"dataset={dataset}", *spelt_out])
    if config["dataset"].get("source") != SIMULATED:
        raise ConfigurationError(
            f"data set '{dataset}' is not simulated but read from files; "
            f"run '{command_line('ingest', [dataset, *overrides])}'"
        )
    return config


def outcome_of(ingested: Artefact) -> dict[str, Any]:
    """Number and hours of drives of a simulated data set, and names of those that span, left the
    road or ended before their manoeuvre did.

    Raises `DataError`.

    Returns
    -------
    dict
        ``drives``, ``hours``, and names under ``spun``, ``left_road`` and ``not_completed``.
    """
    drives = [read_recording(ingested.folder / name, ["vx"]) for name in sorted(ingested.outputs)]
    flags = {drive.id: drive.provenance["flags"] for drive in drives}
    return {
        "drives": len(drives),
        "hours": sum(len(drive) / drive.rate_hz for drive in drives) / 3600.0,
        "spun": [name for name, flag in flags.items() if flag["spun"]],
        "left_road": [name for name, flag in flags.items() if flag["left_road"]],
        "not_completed": [name for name, flag in flags.items() if not flag["completed"]],
    }


def _datasets_with_download() -> list[str]:
    """Names of the data sets whose files can be downloaded; those whose configuration cannot be
    read are left out.
    """
    names = []
    for name in choices("dataset"):
        with suppress(ConfigurationError):
            if compose_config("ingest", [f"dataset={name}"])["dataset"].get("download"):
                names.append(name)
    return names


def download_files(config: Config, messages: Messages, *, dry_run: bool) -> None:
    """Download a data set's missing files, and record or compare the checksums of the others.

    Raises as `Download.fetch`, or `ConfigurationError`.

    Parameters
    ----------
    config : Config
        As composed for ``ingest``.
    messages : Messages
        Prints a line a file.
    dry_run : bool
        Only print what would be fetched.

    Raises
    ------
    DryRunStop
        In a dry run with missing files.
    """
    from vehest.sources.download import download_of

    source = open_source(config["dataset"])
    if source.dataset.get("download") is None:
        downloadable = ", ".join(_datasets_with_download()) or "none"
        raise ConfigurationError(
            f"data set '{source.name}' does not say where its files can be fetched from "
            "(download); put them into its folder by hand, or declare download in its file; data "
            f"sets that do: {downloadable}"
        )
    download = download_of(source)
    if dry_run:
        for name in download.missing():
            messages.line(
                "plan", "download", name, f"from {download.address(name)} into {download.folder}"
            )
        if download.missing():
            messages.line("plan", "ingest", source.name, "then")
            raise DryRunStop
        return
    with messages.bars() as bars:

        def progress(name: str, done: int, total: int | None) -> None:
            bars.step(f"download {name}", done // 1000, (total or done) // 1000, "kB")

        for file in download.fetch(progress):
            words = {
                "matched": "is there, with the recorded checksum",
                "recorded": f"was there; its checksum is now recorded: sha256 {file.sha256}",
                "fetched": f"{file.size / 1e6:.1f} MB, sha256 {file.sha256}",
            }
            bars.close(f"download {file.name}")
            messages.line(
                "note" if file.what == "matched" else "done",
                "download",
                file.name,
                words[file.what],
            )
