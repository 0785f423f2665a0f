"""Studies that are finished, recognised without the libraries that made them.

After a study is done, a record in the output root says what it was made from and what is shown of it. The next run compares: the words of
the command, every file of conf/ and pipelines/, the environment variables they read, vehest's own files, those of other packages that
hold estimators and studies, and size and times of the raw files. If all are as they were and every artefact is there whole, the
same lines and tables are printed. Whatever differs, be it a comment, the whole way is gone, which skips what is up to date and writes the
record anew: the record decides nothing that keys do not decide, it only saves composing them again.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from vehest.data.errors import VehestError
from vehest.data.files import file_name, remove_leftovers, sha256_of, written_aside
from vehest.data.schema import validated
from vehest.data.text_files import read_json, read_yaml
from vehest.run.artefacts import Artefact, read_artefact
from vehest.run.config_files import find_pipeline, local_conf, packaged_conf, packaged_pipelines
from vehest.run.console import WARNING
from vehest.run.publishing import Publication
from vehest.run.shown import Shown
from vehest.run.tracking import Tracker

FINISHED = "finished"  # folder of the records in an output root
FORMAT = 1
MOST_FILES = 20_000  # below a data set's folder; beyond, looking at each takes longer than the whole way
ABSENT = "absent"
TRACKED_STAGES = ("train", "calibrate", "evaluate")
_ENVIRONMENT = re.compile(r"\$\{\s*oc\.env\s*:\s*([A-Za-z_]\w*)")
_RESOLVERS = re.compile(r"\$\{\s*([A-Za-z_][\w.]*)\s*:")


@dataclass(frozen=True)
class Made:
    """An artefact that a study consists of.

    Args:
        folder: relative to the output root.
        key: of its content.
        digest: of its content.
    """

    folder: str
    key: str
    digest: str


@dataclass(frozen=True)
class RawFolder:
    """Raw files of a data set.

    Args:
        path: as its configuration names it.
        stamp: of all files below it, see `stamp_of`.
    """

    path: str
    stamp: str


@dataclass(frozen=True)
class Record:
    """What a finished study was made from, and what is shown of it.

    Args:
        format: of this record.
        fingerprint: of what was asked for, see `Asked`.
        outside: loaded modules of packages that extend vehest -> digest of their files.
        plugs: digest of the entry points of other packages, where there are such modules.
        libraries: version of those that data sets are simulated with.
        raw: raw files of each data set.
        made: its artefacts, the report last.
        said: lines that the whole way would say.
        shown: what it prints.
        publication: what is published of it.
        tracking: ``tracking`` of the configuration.
    """

    format: int
    fingerprint: str
    outside: dict[str, str]
    plugs: str
    libraries: dict[str, str]
    raw: dict[str, RawFolder]
    made: tuple[Made, ...]
    said: tuple[tuple[str, str, str, str], ...]
    shown: Shown
    publication: Publication | None
    tracking: dict[str, Any]


@dataclass(frozen=True)
class Asked:
    """What was asked for, as it stood when it was asked.

    Args:
        words: of the command that determine the outcome.
        overrides: among them.
        pipeline: its name or path; none for a sweep.

    Attributes:
        cwd: the current folder.
        fingerprint: hash of the command and of all files and variables that say what it means, as they stood when this was made; empty if
            that cannot be told from files alone.
    """

    words: tuple[str, ...]
    overrides: tuple[str, ...]
    pipeline: str = ""
    cwd: str = field(default_factory=os.getcwd)
    fingerprint: str = field(init=False, default="")

    def __post_init__(self) -> None:
        object.__setattr__(self, "fingerprint", _fingerprint(self))

    @property
    def output(self) -> Path | None:
        """The output root, where overrides or the environment name it plainly."""
        named = [override.removeprefix("output=") for override in self.overrides if override.lstrip("+~").startswith("output")]
        root = named[-1] if named else os.environ.get("VEHEST_OUTPUT", "outputs")
        return None if not root or re.search(r"[\\'\"${},=()\[\]]", root) else Path(root)

    @property
    def file(self) -> Path | None:
        """Where the record is, or is to be."""
        if self.output is None:
            return None
        name = hashlib.sha256(json.dumps(self.words).encode()).hexdigest()[:12]
        stem = Path(self.pipeline).stem or "sweep"
        return self.output / FINISHED / f"{file_name(stem)}-{name}.json"


@dataclass(frozen=True)
class Finished:
    """A study that is there whole.

    Args:
        record: what was written down of it.
        artefacts: all of them, the report last.
    """

    record: Record
    artefacts: Sequence[Artefact]

    @property
    def report(self) -> Artefact:
        """The artefact that shows the others."""
        return self.artefacts[-1]


def recall(asked: Asked) -> Finished | None:
    """The finished study that was asked for, if nothing has changed since and all of it is there."""
    if asked.file is None or not asked.file.is_file():
        return None
    try:
        record = validated(Record, read_json(asked.file), f"'{asked.file}'")
        if record.format != FORMAT or not asked.fingerprint or record.fingerprint != asked.fingerprint:
            return None
        if not _is_same_world(record):
            return None
        assert asked.output is not None
        artefacts = [read_artefact(asked.output / made.folder) for made in record.made]
    except VehestError:
        return None
    for artefact, made in zip(artefacts, record.made, strict=True):
        if (artefact.key, artefact.digest, artefact.status) != (made.key, made.digest, "complete"):
            return None
    tracker = Tracker(record.tracking, asked.output, lambda _: None)
    if not all(tracker.is_tracked(artefact) for artefact in artefacts if artefact.stage in TRACKED_STAGES):
        return None
    return Finished(record, artefacts)


@dataclass(frozen=True)
class Outcome:
    """A study that was done the whole way.

    Args:
        output: the output root.
        report: the artefact that shows the others.
        artefacts: all of them.
        said: lines that were said.
        shown: what is printed.
        publication: what is published of it.
        tracking: ``tracking`` of the configuration.
        raw: raw files of each data set, from before they were read.
    """

    output: Path
    report: Artefact
    artefacts: Sequence[Artefact]
    said: Sequence[tuple[str, str, str, str]]
    shown: Shown
    publication: Publication | None
    tracking: Mapping[str, Any]
    raw: Mapping[str, RawFolder] | None


def remember(asked: Asked, outcome: Outcome, again: Callable[[], Outcome | None], warn: Callable[[str], None]) -> None:
    """Write a record of a study that is done, unless something changed meanwhile or the next run cannot tell whether it did.

    Args:
        asked: before it was begun.
        outcome: what came of it.
        again: goes the whole way without making anything; none if something would have to be made.
        warn: told if the record cannot be written.
    """
    if asked.file is None or not asked.fingerprint or outcome.output != asked.output:
        return
    try:
        seen: Outcome | None = outcome
        if outcome.raw is None or any(status not in ("skip", WARNING) for status, *_ in outcome.said):
            seen = again()
        record = None if seen is None or seen.report.key != outcome.report.key else _record(asked, seen)
    except VehestError:
        return
    if record is None or _fingerprint(asked) != asked.fingerprint:
        return
    try:
        remove_leftovers(asked.file.parent)
        with written_aside(asked.file) as aside:
            aside.write_text(json.dumps(asdict(record), indent=1, ensure_ascii=False), encoding="utf-8")
    except VehestError as error:
        warn(f"{error}; the next run looks at everything again")


def _record(asked: Asked, seen: Outcome) -> Record | None:
    libraries = _libraries(seen.artefacts)
    if seen.raw is None or libraries is None:
        return None
    outside = _outside()
    artefacts = [*(artefact for artefact in seen.artefacts if artefact.folder != seen.report.folder), seen.report]
    return Record(
        format=FORMAT,
        fingerprint=asked.fingerprint,
        outside=outside,
        plugs=_entry_points() if outside else "",
        libraries=libraries,
        raw=dict(seen.raw),
        made=tuple(Made(made.folder.relative_to(seen.output).as_posix(), made.key, made.digest) for made in artefacts),
        said=tuple(seen.said),
        shown=seen.shown,
        publication=seen.publication,
        tracking=dict(seen.tracking),
    )


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


def _is_same_world(record: Record) -> bool:
    """Whether raw files, libraries and modules of other packages are those that a study was made from."""
    if any(stamp_of(folder.path) != folder.stamp for folder in record.raw.values()):
        return False
    if any(_version(name) != version for name, version in record.libraries.items()):
        return False
    for name, digest in record.outside.items():
        file = file_of(name)
        if file is None or sha256_of(file) != digest:
            return False
    return not record.outside or _entry_points() == record.plugs


def _outside() -> dict[str, str]:
    """Loaded modules of packages that extend vehest -> digest of their files."""
    packages = {value.split(":")[0].split(".")[0] for _, points in _extensions() for _, value in points} - {"vehest"}
    files = {name: file_of(name) for name in sorted(sys.modules) if name.split(".")[0] in packages}
    return {name: sha256_of(file) for name, file in files.items() if file is not None}


def file_of(module: str) -> Path | None:
    """The file of a module of another package, found without importing anything; none where there is no such module."""
    first, *rest = module.split(".")
    try:
        spec = importlib.util.find_spec(first)
    except (ImportError, AttributeError, ValueError):
        return None
    if spec is None:
        return None
    if not rest:
        return Path(spec.origin) if spec.origin and spec.origin.endswith(".py") else None
    for base in spec.submodule_search_locations or ():
        place = Path(base).joinpath(*rest)
        for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
            if path.is_file():
                return path
    return None


def _libraries(artefacts: Iterable[Artefact]) -> dict[str, str] | None:
    """Inputs of ingests that are libraries rather than files; none if one is neither."""
    found: dict[str, str] = {}
    for artefact in artefacts:
        if artefact.stage == "ingest":
            found |= {name: text for name, text in artefact.inputs.items() if not re.fullmatch(r"[0-9a-f]{64}", text)}
    return found if all(_version(name) == text for name, text in found.items()) else None


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except (metadata.PackageNotFoundError, ValueError):
        return ""


def _entry_points() -> str:
    """Digest of what other packages offer to vehest."""
    return hashlib.sha256(repr(_extensions()).encode()).hexdigest()


def _extensions() -> list[tuple[str, list[tuple[str, str]]]]:
    """Groups of entry points -> names and values, of all packages that extend vehest."""
    found = metadata.entry_points()
    groups = sorted(group for group in found.groups if group.startswith("vehest."))
    return [(group, sorted((point.name, point.value) for point in found.select(group=group))) for group in groups]


def _fingerprint(asked: Asked) -> str:
    """See `Asked`."""
    digest = hashlib.sha256(repr((FORMAT, sys.version_info[:2], asked.words, asked.cwd)).encode("utf-8", "surrogateescape"))
    texts = list(asked.overrides)
    try:
        for name, file in _described_by(asked):
            content = file.read_bytes()
            texts.append(content.decode("utf-8", "replace"))
            digest.update(repr((name, hashlib.sha256(content).hexdigest())).encode("utf-8", "surrogateescape"))
        for name, file in own_files():
            digest.update(repr((name, hashlib.sha256(file.read_bytes()).hexdigest())).encode())
    except (OSError, VehestError):
        return ""
    if any(resolver != "oc.env" for text in texts for resolver in _RESOLVERS.findall(text)):
        return ""  # it may say something else each time
    for variable in sorted({variable for text in texts for variable in _ENVIRONMENT.findall(text)}):
        digest.update(repr((variable, os.environ.get(variable))).encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _described_by(asked: Asked) -> list[tuple[str, Path]]:
    """Name and file of all that describes what is asked for.

    Raises:
        VehestError: the pipeline is not there or cannot be read.
    """
    folders = {"conf": packaged_conf(), "local conf": local_conf(), "pipelines": packaged_pipelines()}
    files = [
        (f"{name}/{file.relative_to(folder).as_posix()}", file)
        for name, folder in folders.items()
        if folder is not None
        for file in sorted(folder.rglob("*.yaml"))
    ]
    own = find_pipeline(asked.pipeline) if asked.pipeline else None
    if own is not None:
        files.append(("pipeline", own))
        content = read_yaml(own)
        base = find_pipeline(str(content.get("based_on"))) if isinstance(content, dict) and "based_on" in content else None
        if base is not None:
            files.append(("base", base))
    return files


def own_files() -> list[tuple[str, Path]]:
    """Vehest's own modules and templates, each with its name."""
    root = Path(__file__).resolve().parents[1]
    files: list[tuple[str, Path]] = []
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if name not in ("__pycache__", "conf", "pipelines", "pretrained"))
        files += [(os.path.relpath(os.path.join(folder, name), root), Path(folder, name)) for name in sorted(names)]
    return files
