"""Recognises a finished study or sweep without the libraries that made it.

After a run, a record in the output root holds the fingerprint of the command, the names, keys and digests of its artefacts, and the printed
summary. While the fingerprint, the raw files and all artefacts are the same, the next run prints that summary; otherwise it runs in full,
where keys decide what is up to date. The record decides nothing that keys do not decide.

command, files of conf/, pipelines/ and code, environment -> `RunCache.key` -> `load` -> Finished; outcome -> `save`
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from vehest.data.errors import JobsFailedError, VehestError
from vehest.data.files import file_name, remove_leftovers, written_aside
from vehest.data.schema import validated
from vehest.data.text_files import read_json, read_yaml
from vehest.run.artefacts import Artefact, library_versions, read_artefact
from vehest.run.config_files import conf_folders, find_pipeline, packaged_pipelines
from vehest.run.console import WARNING, Messages
from vehest.run.launchers.options import LauncherOptions
from vehest.run.publishing import Publication, publish_study
from vehest.run.terminal import TerminalSummary
from vehest.run.tracking import TRACKED_STAGES, Tracker

FINISHED = "finished"  # folder of the records in an output root
FORMAT = 2
MOST_FILES = 20_000  # below a data set's folder; beyond, looking at each takes longer than a run in full
ABSENT = "absent"
_ENVIRONMENT = re.compile(r"\$\{\s*oc\.env\s*:\s*([A-Za-z_]\w*)")
_RESOLVERS = re.compile(r"\$\{\s*([A-Za-z_][\w.]*)\s*:")

Line = tuple[str, str, str, str]


@dataclass(frozen=True)
class Made:
    """An artefact of a study: folder relative to the output root, key and digest of its content."""

    folder: str
    key: str
    digest: str


@dataclass(frozen=True)
class RawFolder:
    """Raw files of a data set: their folder as its configuration names it, and the stamp of all files below it (`stamp_of`)."""

    path: str
    stamp: str


@dataclass(frozen=True)
class Outcome:
    """A study that was run.

    Args:
        output: the output root.
        artefacts: all of them, the report last.
        lines: that were printed: status, stage, label, detail.
        summary: printed at the end.
        publication: what is published of it.
        tracking: ``tracking`` of the configuration.
        raw: raw files of each data set, from before they were read; none if they are too many.
    """

    output: Path
    artefacts: Sequence[Artefact]
    lines: Sequence[Line]
    summary: TerminalSummary
    publication: Publication | None
    tracking: Mapping[str, Any]
    raw: Mapping[str, RawFolder] | None


@dataclass(frozen=True)
class Record:
    """A finished study as it is kept; see `Outcome`."""

    format: int
    key: str
    raw: dict[str, RawFolder]
    made: tuple[Made, ...]
    lines: tuple[Line, ...]
    summary: TerminalSummary
    publication: Publication | None
    tracking: dict[str, Any]


@dataclass(frozen=True)
class Finished:
    """A study that is there whole: its record, and its report."""

    record: Record
    report: Artefact


@dataclass(frozen=True)
class RunOptions:
    """Options of a command that runs stages.

    Args:
        force: run although artefacts are there.
        dry_run: print what would run, run nothing.
        quiet: print warnings and results alone.
        jobs: processes; none for one a core.
        track: log runs.
        minutes: time for everything, report included; none for no limit.
        launcher: where trainings run; none for this machine.
    """

    force: bool = False
    dry_run: bool = False
    quiet: bool = False
    jobs: int | None = None
    track: bool = False
    minutes: float | None = None
    launcher: LauncherOptions | None = None


@dataclass(frozen=True)
class Ran:
    """A study or sweep that is done.

    Args:
        summary: to print.
        folder: of its report.
        skipped: whether the report was there already.
        published: folder in results/, if it was published.
        failed: error to end with.
    """

    summary: TerminalSummary
    folder: Path
    skipped: bool
    published: Path | None = None
    failed: JobsFailedError | None = None


class RunCache:
    """The record of one command.

    Args:
        words: of the command that determine the outcome.
        overrides: among them.
        pipeline: its name or path; empty for a sweep.

    Attributes:
        key: hash of the command and of all files and variables that determine its meaning, as they were when this was made; empty if files
            alone do not tell.
    """

    def __init__(self, words: Sequence[str], overrides: Sequence[str], pipeline: str = "") -> None:
        self._words, self._overrides, self._pipeline = tuple(words), tuple(overrides), pipeline
        self._folder = os.getcwd()
        self.key = self._key()

    @property
    def output(self) -> Path | None:
        """The output root, where overrides or the environment name it plainly."""
        named = [override.removeprefix("output=") for override in self._overrides if override.lstrip("+~").startswith("output")]
        root = named[-1] if named else os.environ.get("VEHEST_OUTPUT", "outputs")
        return None if not root or re.search(r"[\\'\"${},=()\[\]]", root) else Path(root)

    @property
    def file(self) -> Path | None:
        """Where the record is kept."""
        if self.output is None:
            return None
        name = hashlib.sha256(json.dumps(self._words).encode()).hexdigest()[:12]
        return self.output / FINISHED / f"{file_name(Path(self._pipeline).stem or 'sweep')}-{name}.json"

    def load(self) -> Finished | None:
        """The finished study, if nothing has changed since and all of it is there."""
        if self.file is None or not self.file.is_file() or not self.key:
            return None
        assert self.output is not None
        try:
            record = validated(Record, read_json(self.file), f"'{self.file}'")
            if (record.format, record.key) != (FORMAT, self.key) or any(stamp_of(raw.path) != raw.stamp for raw in record.raw.values()):
                return None
            artefacts = [read_artefact(self.output / made.folder) for made in record.made]
        except VehestError:
            return None
        tracker = Tracker(record.tracking, self.output, lambda _: None)
        for artefact, made in zip(artefacts, record.made, strict=True):
            if (artefact.key, artefact.digest, artefact.status) != (made.key, made.digest, "complete"):
                return None
            if artefact.stage in TRACKED_STAGES and not tracker.is_tracked(artefact):
                return None
        return Finished(record, artefacts[-1])

    def repeat(self, options: RunOptions) -> Ran | None:
        """The finished study, printed and published as the next run in full would; none where there is no valid record, or under force."""
        finished = None if options.force else self.load()
        if finished is None:
            return None
        messages = Messages(quiet=options.quiet)
        messages.again(finished.record.lines)
        published = None if options.dry_run else publish_study(finished.record.publication, finished.report, messages)
        return Ran(finished.record.summary, finished.report.folder, True, published)

    def save(self, outcome: Outcome, warn: Callable[[str], None]) -> None:
        """Keep a finished study, unless something changed meanwhile or the next run cannot tell whether it did.

        Args:
            outcome: of the run.
            warn: called if the record cannot be written.
        """
        if self.file is None or not self.key or outcome.output != self.output or outcome.raw is None or self._key() != self.key:
            return
        record = Record(
            format=FORMAT,
            key=self.key,
            raw=dict(outcome.raw),
            made=tuple(Made(own.folder.relative_to(self.output).as_posix(), own.key, own.digest) for own in outcome.artefacts),
            lines=tuple(_next_time(outcome)),
            summary=outcome.summary,
            publication=outcome.publication,
            tracking=dict(outcome.tracking),
        )
        try:
            remove_leftovers(self.file.parent)
            with written_aside(self.file) as aside:
                aside.write_text(json.dumps(asdict(record), indent=1, ensure_ascii=False), encoding="utf-8")
        except VehestError as error:
            warn(f"{error}; the next run looks at everything again")

    def _key(self) -> str:
        digest = hashlib.sha256(repr((FORMAT, sys.version_info[:2], self._words, self._folder, library_versions())).encode())
        texts = list(self._overrides)
        try:
            for name, file in [*_configuration(self._pipeline), *_code_files()]:
                content = file.read_bytes()
                digest.update(repr((name, hashlib.sha256(content).hexdigest())).encode("utf-8", "surrogateescape"))
                if file.suffix == ".yaml":
                    texts.append(content.decode("utf-8", "replace"))
        except (OSError, VehestError, ImportError, ValueError):
            return ""
        if any(resolver != "oc.env" for text in texts for resolver in _RESOLVERS.findall(text)):
            return ""  # its value may differ each time
        for variable in sorted({variable for text in texts for variable in _ENVIRONMENT.findall(text)}):
            digest.update(repr((variable, os.environ.get(variable))).encode("utf-8", "surrogateescape"))
        return digest.hexdigest()


def _next_time(outcome: Outcome) -> list[Line]:
    """The lines that the next run in full would print: artefacts are up to date, notes and warnings stay."""
    made = {(artefact.stage, artefact.label) for artefact in outcome.artefacts}
    lines: list[Line] = []
    for status, stage, label, detail in outcome.lines:
        if (stage, label) in made and status in ("done", "skip", "note"):
            lines.append(("skip", stage, label, "up to date"))
        elif (status in ("note", WARNING) and stage != "calibrate") or stage == "split":
            lines.append((status, stage, label, detail))
    return lines


def stamps_of(datasets: Mapping[str, Mapping[str, Any]]) -> dict[str, RawFolder] | None:
    """Stamps of the raw files of data sets; none if there are too many of them to look at each time.

    Args:
        datasets: name -> configuration.
    """
    raw = {}
    for name, dataset in datasets.items():
        if "path" not in dataset:
            continue
        stamp = stamp_of(str(dataset["path"]))
        if stamp is None:
            return None
        raw[name] = RawFolder(str(dataset["path"]), stamp)
    return raw


def stamp_of(path: str) -> str | None:
    """Hash of names, sizes, times and inodes of all files below a folder; ``absent`` if there is none, none if there are too many.

    The time of the last change of an inode is in it, so that a file that is replaced by one of the same size and date is seen.
    """
    top = Path(path).expanduser()
    if not top.is_dir():
        return ABSENT
    entries: list[tuple[str, int, int, int, int]] = []
    visited: set[tuple[int, int]] = set()
    waiting = [top]
    while waiting:
        folder = waiting.pop()
        about = folder.stat()
        if (about.st_dev, about.st_ino) in visited:
            continue
        visited.add((about.st_dev, about.st_ino))
        try:
            for entry in os.scandir(folder):
                if entry.is_dir():
                    waiting.append(Path(entry.path))
                found = os.stat(entry.path) if entry.is_file() else entry.stat(follow_symlinks=False)
                times = (0, 0) if entry.is_dir() else (found.st_mtime_ns, found.st_ctime_ns)
                entries.append((os.path.relpath(entry.path, top), 0 if entry.is_dir() else found.st_size, *times, found.st_ino))
        except OSError:
            return None
        if len(entries) > MOST_FILES:
            return None
    return hashlib.sha256(repr(sorted(entries)).encode("utf-8", "surrogateescape")).hexdigest()


def _configuration(pipeline: str) -> list[tuple[str, Path]]:
    """Name and file of the configuration and of the pipeline, with the one that it is based on.

    Raises:
        VehestError: the pipeline is not there or cannot be read.
    """
    files = [
        (f"{number}/{file.relative_to(folder).as_posix()}", file)
        for number, folder in enumerate([*conf_folders(), packaged_pipelines()])
        for file in sorted(folder.rglob("*.yaml"))
    ]
    own = find_pipeline(pipeline) if pipeline else None
    if own is not None:
        files.append(("pipeline", own))
        content = read_yaml(own)
        base = find_pipeline(str(content.get("based_on"))) if isinstance(content, dict) and "based_on" in content else None
        if base is not None:
            files.append(("base", base))
    return files


def _code_files() -> list[tuple[str, Path]]:
    """Name and file of the modules and templates of vehest and of every package that offers it estimators, sources or studies."""
    packages = {Path(__file__).resolve().parents[1]}
    found = metadata.entry_points()
    for group in sorted(group for group in found.groups if group.startswith("vehest.")):
        for point in found.select(group=group):
            spec = importlib.util.find_spec(point.module.partition(".")[0])
            packages |= (
                {Path(spec.origin).parent if spec.submodule_search_locations else Path(spec.origin)} if spec and spec.origin else set()
            )
    files: list[tuple[str, Path]] = []
    for package in sorted(packages):
        if package.is_file():
            files.append((package.name, package))
        for folder, folders, names in os.walk(package):
            folders[:] = sorted(name for name in folders if name not in ("__pycache__", "pretrained"))
            files += [(os.path.relpath(os.path.join(folder, name), package.parent), Path(folder, name)) for name in sorted(names)]
    return files
