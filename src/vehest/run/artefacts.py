"""Artefacts: one folder a stage, with a manifest, complete or not there at all.

StagePlan -> `find`, or `make` under its lock -> Artefact

The folder's name ends in the stage's key: a hash of everything that determines the content, which is the stage's configuration, the digests
of its inputs and the version of its code. Commit, library versions, time and machine are provenance and not part of the key.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from vehest.data.errors import DataError, MissingError
from vehest.data.files import file_name, remove_leftovers, sha256_of, written_aside
from vehest.data.schema import check_format, validated
from vehest.data.text_files import read_json
from vehest.run.locks import Lock, Waiting, held
from vehest.version import __version__

CHECKOUT = Path(__file__).resolve().parents[3]
MANIFEST = "manifest.json"
TIMINGS = "timings.csv"  # what a stage took; no part of its content, since it is never the same twice
FORMAT = 1
DIGEST = re.compile(r"[0-9a-f]{64}")
Status = Literal["complete", "interrupted"]


@dataclass(frozen=True)
class StagePlan:
    """An artefact before it is made.

    Args:
        stage: name of the stage.
        label: start of the folder's name, for people.
        config: the part of the configuration that determines the content, plain values.
        inputs: input name -> digest.
        code: version of the stage's code.
        output: the output root.
    """

    stage: str
    label: str
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    code: str
    output: Path

    @property
    def content(self) -> dict[str, Any]:
        """What determines the content."""
        return {"stage": self.stage, "config": self.config, "inputs": dict(self.inputs), "code": self.code}

    @property
    def key(self) -> str:
        """Hash of what determines the content."""
        return hashlib.sha256(json.dumps(self.content, sort_keys=True, default=str).encode()).hexdigest()

    @property
    def folder(self) -> Path:
        """Where the artefact belongs."""
        return self.output / file_name(self.stage) / self._folder_name

    @property
    def lock(self) -> Lock:
        """Held by the process that makes the artefact."""
        return Lock(self.output, self.stage, self._folder_name)

    @property
    def checkpoint_folder(self) -> Path:
        """Where an unfinished run of this stage keeps its state."""
        return self.output / "checkpoints" / self._folder_name

    @property
    def _folder_name(self) -> str:
        return file_name(self.label, f"-{self.key[:12]}")


@dataclass(frozen=True)
class Artefact:
    """A folder that a stage has made.

    Args:
        folder: where it is.
        stage, label, key, config, inputs, code: of its `StagePlan`.
        status: ``complete``, or ``interrupted`` where a fit was stopped with its best so far.
        outputs: file -> sha256.
        provenance: time, seconds, versions, machine.
        skipped: whether it was there already.
    """

    folder: Path
    stage: str
    label: str
    key: str
    status: Status
    outputs: Mapping[str, str]
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    skipped: bool = False
    code: str = ""

    @property
    def digest(self) -> str:
        """Hash of the content, times aside, for the stages that build on it."""
        content = {name: digest for name, digest in self.outputs.items() if name != TIMINGS}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Output:
    """Digest and length of a file's bytes."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class Manifest:
    """Keys of manifest.json (docs/cli.md); a format of 0, where none is stated, is otherwise the same as 1."""

    stage: str
    label: str
    key: str
    status: Status
    config: dict[str, Any]
    inputs: dict[str, str]
    outputs: dict[str, Output]
    provenance: dict[str, Any]
    code: str = ""
    format: int = 0


def find(plan: StagePlan) -> Artefact | None:
    """The complete artefact of a plan; none where it is missing, damaged, interrupted or another's."""
    try:
        artefact = read_artefact(plan.folder)
    except (DataError, MissingError):
        return None
    return artefact if artefact.key == plan.key and artefact.status == "complete" else None


def read_artefact(folder: Path) -> Artefact:
    """Read a stage's folder.

    Raises:
        MissingError: there is no manifest.
        DataError: the manifest is damaged, or a file it names is gone or has another size.
    """
    path = folder / MANIFEST
    try:
        content = read_json(path)
    except MissingError:
        raise MissingError(f"'{folder}' is not something that vehest made: there is no {MANIFEST} in it") from None
    if not isinstance(content, dict):
        raise DataError(f"'{path}' is damaged (it is no mapping); remove the folder and run the stage again")
    check_format(content.get("format", 0), FORMAT, f"'{path}'", oldest=0)
    manifest = validated(Manifest, content, f"'{path}'")
    for name, entry in manifest.outputs.items():
        _check_output(folder, name, entry, manifest.stage)
    about = {**vars(manifest), "outputs": {name: entry.sha256 for name, entry in manifest.outputs.items()}}
    del about["format"]
    return Artefact(folder, skipped=True, **about)


def _check_output(folder: Path, name: str, entry: Output, stage: str) -> None:
    """Check that a file of a manifest has its size and lies in the folder itself.

    Raises:
        DataError: it does not.
    """
    manifest, again = f"'{folder / MANIFEST}'", f"run the stage '{stage}' again"
    parts = PurePosixPath(name).parts
    too_long = any(len(part.encode("utf-8", "surrogatepass")) > 255 for part in parts)
    if (
        not parts
        or too_long
        or PurePosixPath(*parts).as_posix() != name
        or parts[0] == "/"
        or ".." in parts
        or "\\" in name
        or "\0" in name
    ):
        raise DataError(f"{manifest}: outputs names {name[:80]!r}, which is no file inside the folder; {again}")
    if not DIGEST.fullmatch(entry.sha256):
        raise DataError(f"{manifest}: the digest of '{name}' is not 64 hexadecimal digits; {again}")
    path = folder.joinpath(*parts)
    if any(folder.joinpath(*parts[: n + 1]).is_symlink() for n in range(len(parts))):
        raise DataError(f"'{path}' is a link; an artefact holds its files itself: {again}")
    if not path.is_file() or path.stat().st_size != entry.bytes:
        raise DataError(f"'{path}' is gone or truncated; {again}")


def make(plan: StagePlan, write: Callable[[Path], Status | None]) -> Artefact:
    """Run a stage: ``write`` fills a folder aside, which gets its manifest and is then moved to its place.

    Args:
        plan: of the artefact.
        write: fills an empty folder; returns ``interrupted`` if it was stopped.

    Raises:
        MissingError: the disk is full or not writable.
        VehestError: of ``write``; nothing is left behind then.
    """
    started = time.monotonic()
    remove_leftovers(plan.folder.parent)
    with written_aside(plan.folder, replace_folder=True) as aside:
        aside.mkdir()
        status = write(aside) or "complete"
        files = sorted(file for file in aside.rglob("*") if file.is_file())
        manifest = {
            "format": FORMAT,
            "label": plan.label,
            "key": plan.key,
            "status": status,
            **plan.content,
            "outputs": {file.relative_to(aside).as_posix(): {"sha256": sha256_of(file), "bytes": file.stat().st_size} for file in files},
            "provenance": provenance(time.monotonic() - started),
        }
        (aside / MANIFEST).write_text(json.dumps(manifest, indent=1, default=str), encoding="utf-8")
    return replace(read_artefact(plan.folder), skipped=False)


def ensured(
    plan: StagePlan,
    write: Callable[[Path], Status | None],
    force: bool,
    should_stop: Callable[[], bool],
    on_wait: Callable[[Waiting], None],
) -> Artefact | None:
    """Make an artefact, or take the one that another process is making; none if ``should_stop`` ended the waiting for it.

    Raises:
        VehestError: as `make` does.
    """
    with held(plan.lock, should_stop, on_wait) as mine:
        if not mine:
            return None
        return (None if force else find(plan)) or make(plan, write)


def provenance(seconds: float) -> dict[str, Any]:
    """Circumstances that do not determine the content."""
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(seconds, 3),
        "vehest": __version__,
        "commit": commit(),
        "python": platform.python_version(),
        "libraries": library_versions(),
        "constraints": constraints(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
    }


@cache
def library_versions() -> dict[str, str]:
    """Versions of the libraries that numbers depend on."""
    names = ("torch", "numpy", "scipy", "numba", "pandas", "pyarrow", "hydra-core", "mlflow", "commonroad-vehicle-models")
    versions = {}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


@cache
def constraints() -> dict[str, str]:
    """Name and digest of the checkout's file of locked versions; empty without a checkout."""
    file = CHECKOUT / "constraints.txt"
    return {file.name: sha256_of(file)} if file.is_file() else {}


@cache
def commit() -> str:
    """Commit of the checkout that vehest runs from, marked if it has changes; empty without a checkout."""
    if not (CHECKOUT / ".git").exists():
        return ""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        result = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return result.stdout.strip()
