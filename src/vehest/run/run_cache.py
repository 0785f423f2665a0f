"""Remembers the keys of a finished study or sweep, so that it is recognised without the libraries
that compute them.

command, environment, files that determine keys -> `RunCache.load` -> Record -> printed; finished
run -> `RunCache.save`

A record in the output root holds a hash of these inputs, the key of each artefact and the printed
summary. Inputs that are unchanged have unchanged keys, and `valid_artefact` decides by them;
otherwise the study runs in full, which computes the keys.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from vehest.artefacts.artefact import Artefact, library_versions, valid_artefact
from vehest.configuration.files import conf_folders, find_pipeline, packaged
from vehest.data.errors import JobsFailedError, VehestError
from vehest.data.files import (
    file_name,
    regular_file,
    remove_leftovers,
    stamp_of,
    written_aside,
)
from vehest.data.schema import validated
from vehest.data.text_files import read_json, read_yaml, write_json
from vehest.run.console import REUSED, WARNING, Messages
from vehest.run.launchers.base import RunOptions
from vehest.run.printing import TerminalSummary
from vehest.run.publishing import Publication, publish_study

if TYPE_CHECKING:
    from vehest.run.runner import Runner

FINISHED = "finished"  # folder of the records in an output root
FORMAT = 5  # version of the records, a part of their keys
# matches references ``${RESOLVER:NAME}`` of OmegaConf in a configuration
_RESOLVED = re.compile(r"\$\{\s*([A-Za-z_][\w.]*)\s*:\s*(\w*)")


@dataclass(frozen=True)
class Ran:
    """Outcome of a study or sweep that was run."""

    summary: TerminalSummary  # text that is printed
    folder: Path  # folder of its report
    skipped: bool  # whether the report existed already
    published: Path | None = None  # folder in results/
    failed: JobsFailedError | None = None  # error with which the command ends; None: none


@dataclass(frozen=True)
class Record:
    """Record of a finished study, by which it is recognised as up to date."""

    inputs: str  # hash of what determines its keys, `RunCache.inputs`
    raw: dict[str, str]  # folder of raw files -> `stamp_of`
    # folder in the output root, key and digest of each artefact; the report last
    made: tuple[tuple[str, str, str], ...]
    # lines that a run in full would print too: status, stage, label, detail
    notes: tuple[tuple[str, str, str, str], ...]
    summary: TerminalSummary  # text that is printed
    publication: Publication | None  # publication of the report; None: it is not published
    store: str  # MLflow's local store in the output root; empty where there is none


class RunCache:
    """The record of one command.

    Parameters
    ----------
    name : str
        Of the pipeline, or its path; of the sweep, if it was given.

    Attributes
    ----------
    file
        Of the record; none where the output root depends on more than overrides and environment.
    inputs
        Hash of the command, files and variables that determine keys, but raw files; empty if these
        are not all that does.
    """

    def __init__(self, command: str, name: str, overrides: Sequence[str]) -> None:
        self._words = (command, name, *overrides)
        self._overrides = overrides
        self._pipeline = name if command == "run" else ""
        named = [
            override.removeprefix("output=")
            for override in overrides
            if override.lstrip("+~").startswith("output")
        ]
        root = named[-1] if named else os.environ.get("VEHEST_OUTPUT", "outputs")
        plain = root and not re.search(r"[\\'\"${},=()\[\]]", root)
        digest = hashlib.sha256(json.dumps(self._words).encode()).hexdigest()[:12]
        self.file = (
            Path(root, FINISHED, f"{file_name(Path(self._pipeline).stem or 'sweep')}-{digest}.json")
            if plain
            else None
        )
        self.inputs = self._inputs()

    def load(self) -> tuple[Record, list[Artefact]] | None:
        """The record of a finished study and its artefacts, if nothing has changed since and all of
        them exist; else None.

        Returns
        -------
        tuple or None
            Record, and the artefacts in the order in which they were made, the report last.
            Manifests are compared, files are not hashed again.
        """
        if self.file is None or not self.file.is_file():
            return None
        output = self.file.parents[1]
        try:
            record = validated(Record, read_json(self.file), f"'{self.file}'")
            if record.inputs != self.inputs or any(
                stamp_of(Path(path).expanduser()) != stamp for path, stamp in record.raw.items()
            ):
                return None
        except VehestError:
            return None
        artefacts = [
            artefact
            for folder, key, digest in record.made
            if (artefact := valid_artefact(output / folder, key, hash_files=False)) is not None
            and artefact.digest == digest
        ]
        is_complete = len(artefacts) == len(record.made) and (output / record.store).exists()
        return (record, artefacts) if is_complete else None

    def repeat(self, options: RunOptions) -> Ran | None:
        """Print and publish a finished study as a run in full would, from its record.

        Returns None without a valid record, or under ``force``.

        Parameters
        ----------
        options : RunOptions
            Under ``dry_run`` nothing is published.
        """
        finished = None if options.force else self.load()
        if finished is None:
            return None
        (record, (*artefacts, report)) = finished
        messages = Messages(quiet=options.quiet)
        for line in (
            *record.notes,
            *(
                (REUSED, artefact.stage, artefact.label, "up to date")
                for artefact in (*artefacts, report)
            ),
        ):
            messages.line(*line)
        published = None if options.dry_run else publish_study(record.publication, report, messages)
        messages.print_reused()
        return Ran(record.summary, report.folder, True, published)

    def save(
        self,
        runner: Runner,
        report: Artefact,
        summary: TerminalSummary,
        raw: dict[str, str],
        publication: Publication | None,
    ) -> None:
        """Record a finished study, unless runs are left to track or files changed meanwhile.

        ``raw``: stamps from before reading.

        Parameters
        ----------
        runner : Runner
            With all artefacts of the run.
        report : Artefact
            Of the study.
        summary : TerminalSummary
            What was printed.
        raw : dict
            Folder of raw files -> stamp.
        publication : Publication or None
            If the study is published.
        """
        tracker = runner.tracker
        output = runner.output
        if (
            self.file is None
            or not self.inputs
            or output != self.file.parents[1]
            or not tracker.complete
            or self._inputs() != self.inputs
        ):
            return
        artefacts = [
            *(
                artefact
                for artefact in runner.artefacts.values()
                if artefact.folder != report.folder
            ),
            report,
        ]
        record = Record(
            inputs=self.inputs,
            raw=raw,
            made=tuple(
                (artefact.folder.relative_to(output).as_posix(), artefact.key, artefact.digest)
                for artefact in artefacts
            ),
            notes=tuple(
                line
                for line in runner.messages.printed
                if line[0] in ("note", WARNING) and line[1] != "calibrate"
            ),
            summary=summary,
            publication=publication,
            store=tracker.store,
        )
        try:
            remove_leftovers(self.file.parent)
            with written_aside(self.file) as aside:
                write_json(aside, asdict(record))
        except VehestError as error:
            runner.messages.warn(f"{error}; the next run looks at everything again")

    def _inputs(self) -> str:
        """Hash of everything that determines keys except raw files; empty where something else may
        determine them, such as a resolver other than ``oc.env``.
        """
        try:
            texts = {
                str(file): regular_file(file).read_bytes().decode("utf-8", "replace")
                for file in _configuration(self._pipeline)
            }
            code = stamp_of(*_code())
        except (OSError, VehestError, ImportError, ValueError):
            return ""
        references = {
            reference
            for text in (*self._overrides, *texts.values())
            for reference in _RESOLVED.findall(text)
        }
        if any(resolver != "oc.env" for resolver, _ in references):
            return ""  # its value may differ each time
        variables = {name: os.environ.get(name) for _, name in sorted(references)}
        libraries = (sys.version_info[:2], library_versions())
        content = (FORMAT, libraries, self._words, os.getcwd(), texts, variables, code)
        return hashlib.sha256(repr(content).encode("utf-8", "surrogateescape")).hexdigest()


def _configuration(pipeline: str) -> Iterator[Path]:
    """Yield the files of the configuration and of a pipeline, with the one that it is based on."""
    for folder in [*conf_folders(), packaged("pipelines")]:
        yield from sorted(folder.rglob("*.yaml"))
    pipeline_file = find_pipeline(pipeline) if pipeline else None
    if pipeline_file is not None:
        content = read_yaml(pipeline_file)
        base = find_pipeline(str(content.get("based_on"))) if isinstance(content, dict) else None
        yield from (file for file in (pipeline_file, base) if file is not None)


def _code() -> Iterator[Path]:
    """Yield the folders or files of the code of vehest and of every package that provides
    estimators, sources or studies.
    """
    points = metadata.entry_points()
    packages = {
        point.module.partition(".")[0]
        for group in points.groups
        if group.startswith("vehest.")
        for point in points.select(group=group)
    }
    for package in sorted({"vehest", *packages}):
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.submodule_search_locations:
            yield from map(Path, spec.submodule_search_locations)
        elif spec is not None and spec.origin:
            yield Path(spec.origin)
