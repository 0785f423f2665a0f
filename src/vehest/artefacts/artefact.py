"""Artefacts: one folder a stage, with a manifest; a folder is complete, or it does not exist.

    StagePlan --`find`, or `make` under its lock--> Artefact
    folder, key --`valid_artefact`--> Artefact or None

The folder's name ends in the stage's key: a hash of everything that determines the content, which
is the stage's configuration (`keys`), the digests of its inputs and the version of its code.
Commit, library versions, time and machine are provenance and not part of the key.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from vehest.artefacts.keys import hash_of
from vehest.artefacts.locks import Lock, Waiting, held
from vehest.data.errors import DataError, MissingError
from vehest.data.files import file_name, remove, remove_leftovers, sha256_of, written_aside
from vehest.data.schema import check_format, validated
from vehest.data.text_files import read_json
from vehest.version import __version__

CHECKOUT = Path(__file__).resolve().parents[3]  # root of the repository, if vehest runs from one
MANIFEST = "manifest.json"  # name of the file that describes a folder and its files
TIMINGS = "timings.csv"  # durations, which differ each time and are no part of the content
FORMAT = 1  # version of the manifest
Status = Literal["complete", "interrupted"]  # whether a stage ran to its end
Write = Callable[[Path], Status | None]
"""Fills an empty folder, which then becomes an artefact; ``interrupted`` if it was stopped."""


@dataclass(frozen=True)
class StagePlan:
    """An artefact before it is made."""

    stage: str  # name of the stage, such as ``train``
    label: str  # start of the folder's name
    # the part of the configuration that determines the content, plain values
    config: Mapping[str, Any]
    inputs: Mapping[str, str]  # name -> digest
    code: str  # version of the stage's code
    output: Path  # output root
    # the part of ``config`` that enters the key; None: all of it
    key_config: Mapping[str, Any] | None = None

    @property
    def content(self) -> dict[str, Any]:
        """Everything that determines the content, defaults included, as the manifest records it."""
        return {
            "stage": self.stage,
            "config": self.config,
            "inputs": dict(self.inputs),
            "code": self.code,
        }

    @property
    def keyed_content(self) -> dict[str, Any]:
        """Everything that determines the content, without options that have their defaults."""
        config = self.config if self.key_config is None else self.key_config
        return {**self.content, "config": config}

    @property
    def key(self) -> str:
        """Hash of what determines the content."""
        return hash_of(self.keyed_content)

    @property
    def folder(self) -> Path:
        """Folder of the artefact."""
        return self.output / file_name(self.stage) / file_name(self.label, f"-{self.key[:12]}")

    @property
    def lock(self) -> Lock:
        """Lock that the process holds which makes the artefact."""
        return Lock(self.output, self.stage, self.folder.name)

    @property
    def checkpoint_folder(self) -> Path:
        """Folder for the state of an unfinished run of this stage."""
        return self.output / "checkpoints" / self.folder.name

    def drop(self, unfinished: Path) -> None:
        """Remove what an unfinished run left in a folder, unless a process runs the stage."""
        if unfinished.exists():
            with held(self.lock) as free:
                if free:
                    remove(unfinished)


@dataclass(frozen=True)
class Artefact:
    """A folder that a stage has made from its `StagePlan`."""

    folder: Path  # folder of its files
    stage: str  # name of the stage
    label: str  # start of the folder's name
    key: str  # hash of what determines the content
    status: Status  # ``interrupted`` where a fit was stopped with its best so far
    outputs: Mapping[str, str]  # file -> sha256
    config: Mapping[str, Any]  # the part of the configuration that determines the content
    inputs: Mapping[str, str]  # name -> digest
    provenance: Mapping[str, Any] = field(default_factory=dict)  # time, seconds, versions, machine
    skipped: bool = False  # whether it existed already, so that the stage was not run
    code: str = ""  # version of the stage's code

    @property
    def digest(self) -> str:
        """Hash of the content without times, an input of later stages."""
        content = {name: digest for name, digest in self.outputs.items() if name != TIMINGS}
        return hash_of(content)


@dataclass(frozen=True)
class Output:
    """Digest and length of a file's bytes."""

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]  # digest in hexadecimal digits
    bytes: int  # length of the file


@dataclass(frozen=True)
class Manifest:
    """Keys of manifest.json (docs/cli.md) beside its format.

    A manifest that states no format has format 0, which is otherwise the same as 1.
    """

    stage: str  # name of the stage
    label: str  # start of the folder's name
    key: str  # hash of what determines the content
    status: Status  # ``interrupted`` where a fit was stopped with its best so far
    config: dict[str, Any]  # the part of the configuration that determines the content
    inputs: dict[str, str]  # name of an input -> digest
    outputs: dict[str, Output]  # file -> its digest and length
    provenance: dict[str, Any]  # time, seconds, versions and machine
    code: str = ""  # version of the stage's code


def find(plan: StagePlan, warn: Callable[[str], None] = lambda text: None) -> Artefact | None:
    """The valid artefact of a plan, if its folder holds one; None as in `valid_artefact`."""
    return valid_artefact(plan.folder, plan.key, warn)


def valid_artefact(
    folder: Path,
    key: str,
    warn: Callable[[str], None] = lambda text: None,
    *,
    hash_files: bool = True,
) -> Artefact | None:
    """The artefact of a folder, if it is valid for a key; there is no other check of that.

    None where it is missing, damaged (which ``warn`` is told), interrupted or of another key.
    ``hash_files`` is that of `read_artefact`.

    Parameters
    ----------
    folder : Path
        Of the artefact.
    key : str
        That it must have, all 64 digits.
    warn : callable
        Takes one line.
    hash_files : bool
        Whether to compare digests too.
    """
    try:
        artefact = read_artefact(folder, hash_files=hash_files)
    except MissingError:
        return None
    except DataError as error:
        warn(f"damaged, and not used: {error}")
        return None
    return artefact if artefact.key == key and artefact.status == "complete" else None


def read_artefact(folder: Path, *, hash_files: bool = True) -> Artefact:
    """Read a stage's folder and compare its files with the manifest.

    Parameters
    ----------
    folder : Path
        Of the artefact.
    hash_files : bool
        Whether digests are compared too, and not lengths alone: for every use of what a file holds.

    Raises
    ------
    MissingError
        There is no manifest.
    DataError
        The manifest is damaged, or a file differs from it.
    """
    path = folder / MANIFEST
    manifest = read_manifest(folder)
    files = {file.relative_to(folder).as_posix(): file.stat().st_size for file in _files(folder)}
    for name, output in manifest.outputs.items():
        if files.get(name) != output.bytes:
            raise DataError(
                f"'{path}': {name[:80]!r} is gone or truncated, or is a link; run the stage "
                f"'{manifest.stage}' again"
            )
        if hash_files and _digest_of(folder / name) != output.sha256:
            raise DataError(
                f"'{folder / name}' was changed after it was made (its digest is not that in "
                f"{MANIFEST}); remove '{folder}', and the stage '{manifest.stage}' makes it again"
            )
    outputs = {name: output.sha256 for name, output in manifest.outputs.items()}
    return Artefact(folder, skipped=True, **{**vars(manifest), "outputs": outputs})


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a stage's folder; its files are not checked. Raises as `read_artefact`."""
    path = folder / MANIFEST
    try:
        content = read_json(path)
    except MissingError:
        raise MissingError(
            f"'{folder}' is not something that vehest made: there is no {MANIFEST} in it"
        ) from None
    if not isinstance(content, dict):
        raise DataError(
            f"'{path}' is damaged (it is no mapping); remove the folder and run the stage again"
        )
    check_format(content.pop("format", 0), FORMAT, f"'{path}'", oldest=0)
    return validated(Manifest, content, f"'{path}'")


def _digest_of(path: Path) -> str:
    """SHA-256 of a file, computed once in a process as long as its length and time stamp stay."""
    stat = path.stat()
    state = (stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
    if _DIGESTS.get(path, (None, ""))[0] != state:
        _DIGESTS[path] = (state, sha256_of(path))
    return _DIGESTS[path][1]


_DIGESTS: dict[Path, tuple[tuple[int, ...], str]] = {}
"""File -> its state when it was hashed, and its digest."""


def _files(folder: Path) -> list[Path]:
    """Files inside a folder; links are neither followed nor listed."""
    files = [Path(parent, name) for parent, _, names in os.walk(folder) for name in names]
    return sorted(file for file in files if file.is_file() and not file.is_symlink())


def make(plan: StagePlan, write: Write) -> Artefact:
    """Run a stage and return its artefact.

    Parameters
    ----------
    plan : StagePlan
        Stage, label, configuration and inputs, which determine the key.
    write : callable
        Fills an empty folder, which then gets its manifest and its final name; returns
        ``interrupted`` if it was stopped.

    Raises
    ------
    MissingError
        The disk is full or not writable. After this error, and after those that ``write``
        raises, no file remains.
    """
    started = time.monotonic()
    remove_leftovers(plan.folder.parent)
    with written_aside(plan.folder, replace_folder=True) as aside:
        aside.mkdir()
        status = write(aside) or "complete"
        files = _files(aside)
        manifest = {
            "format": FORMAT,
            "label": plan.label,
            "key": plan.key,
            "status": status,
            **plan.content,
            "outputs": {
                file.relative_to(aside).as_posix(): {
                    "sha256": sha256_of(file),
                    "bytes": file.stat().st_size,
                }
                for file in files
            },
            "provenance": provenance() | {"seconds": round(time.monotonic() - started, 3)},
        }
        (aside / MANIFEST).write_text(json.dumps(manifest, indent=1, default=str), encoding="utf-8")
    return replace(read_artefact(plan.folder, hash_files=False), skipped=False)


def ensured(
    plan: StagePlan,
    write: Write,
    force: bool,
    should_stop: Callable[[], bool],
    on_wait: Callable[[Waiting], None],
) -> Artefact | None:
    """Make an artefact under its lock, or take the one that another process made meanwhile.

    None if ``should_stop`` ended the wait for that process; raises as `make` does.

    Parameters
    ----------
    plan : StagePlan
        What is to be made.
    write : callable
        Fills the folder, as of `make`.
    force : bool
        Make it anew although it is there.
    should_stop : callable
        Whether to end the wait for another process.
    on_wait : callable
        Takes who holds the lock.
    """
    with held(plan.lock, should_stop, on_wait) as mine:
        if not mine:
            return None
        return (None if force else find(plan)) or make(plan, write)


def provenance() -> dict[str, Any]:
    """Circumstances that do not determine the content: time, machine, commit, library versions.

    In a checkout, the digest of its file of locked versions is among them.
    """
    lock = CHECKOUT / "constraints.txt"
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "vehest": __version__,
        "commit": commit(),
        "python": platform.python_version(),
        "libraries": library_versions(),
        "constraints": {lock.name: sha256_of(lock)} if lock.is_file() else {},
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
    }


@cache
def library_versions() -> dict[str, str]:
    """Versions of the libraries that numbers depend on."""
    names = (
        "torch",
        "numpy",
        "scipy",
        "numba",
        "pandas",
        "pyarrow",
        "hydra-core",
        "mlflow",
        "commonroad-vehicle-models",
    )
    versions = {}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


@cache
def commit() -> str:
    """Commit of the checkout that vehest runs from, marked if it has changes; else empty.

    Changes in results/ do not count: a command that writes tables there would mark its own record.
    """
    if not (CHECKOUT / ".git").exists():
        return ""
    head = ["git", "rev-parse", "--short=12", "HEAD"]
    changes = ["git", "status", "--porcelain", "--untracked-files=no", "--", ":(exclude)results"]
    try:
        name, changed = (
            subprocess.run(
                command, cwd=CHECKOUT, capture_output=True, text=True, timeout=10, check=True
            ).stdout.strip()
            for command in (head, changes)
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return f"{name}-dirty" if changed else name
