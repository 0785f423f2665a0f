"""Fetching a data set's files: checksums recorded on first sight, resumed after a break, nothing wrong under a final name.

A data set says where its files are: ``download: {url: https://…, files: [a.csv], sha256: {a.csv: …}}``. They go into its ``path``, through
pooch, with a downloader of our own that goes on where an earlier one broke off. Beside them, ``checksums.txt`` (pooch's registry
format: a name and its SHA-256 a line) remembers every file; what is under way lies in the folder ``.download``.
"""

from __future__ import annotations

import logging
import os
import re
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, urlsplit

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.files import remove, remove_leftovers, sha256_of, writing_error, written_aside
from vehest.data.text_files import read_text
from vehest.sources.base import Source, existing_folder
from vehest.sources.resuming import Patience, Progress, ResumingDownloader

CHECKSUMS = "checksums.txt"
UNDER_WAY = ".download"


@dataclass(frozen=True)
class Outcome:
    """What became of one file.

    Args:
        name: of the file.
        what: ``fetched``; ``matched`` its recorded checksum; or was there and its checksum ``recorded`` on first sight.
        sha256: of its bytes.
        size: bytes.
        resumed_at: bytes that an earlier attempt had left, 0 for a file in one go.
    """

    name: str
    what: Literal["fetched", "matched", "recorded"]
    sha256: str
    size: int
    resumed_at: int = 0


@dataclass(frozen=True)
class Download:
    """The files of a data set, where they come from and where they belong.

    Args:
        dataset: name of the data set.
        folder: where the files belong.
        url: address of the folder that they come from.
        files: their names.
        sha256: checksums known beforehand, by name.
        patience: with the server.
    """

    dataset: str
    folder: Path
    url: str
    files: tuple[str, ...]
    sha256: Mapping[str, str] = field(default_factory=dict)
    patience: Patience = field(default_factory=Patience)

    def address(self, name: str) -> str:
        """Where a file comes from."""
        return f"{self.url.rstrip('/')}/{quote(name)}"

    def missing(self) -> list[str]:
        """Files that are not there; those that are there are checked. Writes nothing.

        Raises:
            DataError: a file, or the record of checksums, is not what it should be.
        """
        known = self._known()
        for name in self.files:
            if self._is_there(name):
                self._check(name, known.get(name), sha256_of(self.folder / name))
        return [name for name in self.files if not self._is_there(name)]

    def fetch(self, progress: Progress | None = None) -> Iterator[Outcome]:
        """Fetch what is missing, one file after another; each is recorded before it takes its name.

        Raises:
            DataError: a file that is there or that came has other bytes than recorded.
            MissingError: the server cannot be reached or does not have it, or the disk is full; what has arrived is kept.
        """
        under_way = self.folder / UNDER_WAY
        try:
            under_way.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise writing_error(under_way, error) from error
        with self._alone():
            _remove_temporary_files(under_way)
            remove_leftovers(self.folder)
            try:
                for name in self.files:
                    yield self._outcome(name, self._known().get(name), progress)
            finally:
                with suppress(OSError):  # what is under way stays
                    under_way.rmdir()

    def _outcome(self, name: str, known: str | None, progress: Progress | None) -> Outcome:
        path = self.folder / name
        if self._is_there(name):
            found = sha256_of(path)
            self._check(name, known, found)
            recorded = name in _read_checksums(self.folder / CHECKSUMS)
            if not recorded:
                _record(self.folder / CHECKSUMS, name, found)
            return Outcome(name, "matched" if recorded else "recorded", found, path.stat().st_size)
        downloader = ResumingDownloader(path.name, self.folder / UNDER_WAY, known is not None, self.patience, progress)
        try:
            complete = _retrieve(self.address(name), known, path, downloader)
        except ValueError:  # pooch's, who has dropped the file
            raise DataError(
                f"'{path}': what {self.address(name)} sends has the sha256 {downloader.sha256}, expected is {known} "
                f"({self._origin(name)}); it was dropped. If the publisher has changed the file, remove its line there and run again"
            ) from None
        except OSError as error:
            if error.errno is None:  # not of the disk: requests raises it for certificates that are not there
                raise MissingError(f"cannot fetch {self.address(name)}: {error}") from None
            raise writing_error(path, error) from error
        found = downloader.sha256 or sha256_of(complete)
        _record(self.folder / CHECKSUMS, name, found)
        try:
            os.replace(complete, path)
        except OSError as error:
            raise writing_error(path, error) from error
        return Outcome(name, "fetched", found, path.stat().st_size, downloader.resumed_at)

    def _is_there(self, name: str) -> bool:
        path = self.folder / name
        if path.is_dir():
            raise DataError(f"'{path}' is a folder where a file belongs; remove it and run again")
        return path.is_file() and path.stat().st_size > 0

    def _known(self) -> dict[str, str]:
        """Checksums by name, the declared and the recorded ones."""
        recorded = _read_checksums(self.folder / CHECKSUMS)
        for name, declared in self.sha256.items():
            if recorded.get(name, declared) != declared:
                raise DataError(
                    f"'{self.folder / CHECKSUMS}' records the sha256 {recorded[name]} for '{name}', download.sha256 of data set "
                    f"'{self.dataset}' declares {declared}; remove the one that is wrong"
                )
        return {**recorded, **self.sha256}

    def _check(self, name: str, known: str | None, found: str) -> None:
        if known is not None and found != known:
            raise DataError(
                f"'{self.folder / name}' has the sha256 {found}, expected is {known} ({self._origin(name)}): it was changed or is damaged; "
                f"remove the file to fetch it again, or that line to accept it"
            )

    def _origin(self, name: str) -> str:
        return f"download.sha256 of data set '{self.dataset}'" if name in self.sha256 else f"recorded in '{self.folder / CHECKSUMS}'"

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Hold the folder, so that no other process fetches into it."""
        import fcntl

        descriptor = os.open(self.folder, os.O_RDONLY)
        try:
            with suppress(OSError):  # some network disks know no locks
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise MissingError(f"another process is fetching into '{self.folder}'; run again when it is done") from None
            yield
        finally:
            os.close(descriptor)


def _is_web_address(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:  # an open bracket, which only addresses of IPv6 have
        return False


def download_of(source: Source) -> Download:
    """What the configuration of a data set says about fetching its files.

    Raises:
        ConfigurationError: it says nothing, or something that makes no sense.
        MissingError: no data root is set.
    """
    where, entry = f"data set '{source.name}': download", source.dataset.get("download")
    if not isinstance(entry, Mapping) or not {"url"} <= set(entry) <= {"url", "files", "sha256"}:
        raise ConfigurationError(f"{where} must say url and, if need be, files and sha256, not {entry}")
    url = str(entry["url"])
    if not _is_web_address(url):
        raise ConfigurationError(f"{where}: url must be an address such as https://example.org/folder, not '{url}'")
    files = source.file_names() if entry.get("files") is None else entry["files"]
    if not isinstance(files, list | tuple):
        raise ConfigurationError(f"{where}: files must list the names of files, not {files}")
    if not files:
        raise ConfigurationError(f"{where}: files must list the names of files, since the data set names no recordings that tell them")
    for name in files:
        _require_plain_name(name, where)
    if len(set(files)) < len(files):
        raise ConfigurationError(f"{where}: files names '{next(name for name in files if files.count(name) > 1)}' twice")
    sha256 = entry.get("sha256") or {}
    if not isinstance(sha256, Mapping):
        raise ConfigurationError(f"{where}: sha256 must map a file to its checksum, not {sha256}")
    for name, digest in sha256.items():
        _require_plain_name(name, where)
        if not _is_sha256(str(digest)):
            raise ConfigurationError(f"{where}: sha256 of '{name}' must be 64 hexadecimal digits, not '{digest}'")
    return Download(source.name, _folder(source), url, tuple(files), {name: str(digest).lower() for name, digest in sha256.items()})


def _retrieve(url: str, known: str | None, path: Path, downloader: ResumingDownloader) -> Path:
    """Let pooch fetch a file into the folder of what is under way, checked where its checksum is known."""
    import pooch

    logger = pooch.get_logger()
    level = logger.level
    logger.setLevel(logging.WARNING)  # what pooch tells about checksums is said in our own words
    try:
        return Path(pooch.retrieve(url, known, path.name, path.parent / UNDER_WAY, downloader=downloader))
    finally:
        logger.setLevel(level)


def _read_checksums(file: Path) -> dict[str, str]:
    """The record of checksums beside the files, empty if there is none.

    Raises:
        DataError: it is damaged.
    """
    import pooch

    if not os.path.lexists(file):
        return {}
    read_text(file)  # which is bounded, and refuses pipes
    registry = pooch.create(file.parent, "")
    try:
        registry.load_registry(file)
    except (OSError, ValueError) as error:  # UnicodeDecodeError is a ValueError
        raise DataError(f"'{file}' cannot be read as a record of checksums ({error}); repair it, or remove it to record anew") from None
    for name, digest in registry.registry.items():
        if not _is_sha256(digest):
            raise DataError(f"'{file}': the checksum of '{name}' must be 64 hexadecimal digits, not '{digest}'; repair or remove the line")
    return dict(registry.registry)


def _record(file: Path, name: str, sha256: str) -> None:
    """Add a line to the record of checksums, in one step; an equal one stays."""
    if name in _read_checksums(file):
        return
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    with written_aside(file) as aside:
        aside.write_text(f"{text}{'' if text.endswith(chr(10)) or not text else chr(10)}{shlex.quote(name)} {sha256}\n", encoding="utf-8")


def _folder(source: Source) -> Path:
    """The data set's folder, which need not be there yet."""
    path = str(source.dataset.get("path") or "None")
    return existing_folder(None, source.name) if path.split("/")[0] in {"None", "null"} else Path(path).expanduser()


def _require_plain_name(name: Any, where: str) -> None:
    plain = isinstance(name, str) and name.isprintable() and not name.startswith((".", "-")) and not set(name) & set('/\\:*?"<>|')
    if not plain or not name.strip() or name == CHECKSUMS:
        raise ConfigurationError(f"{where}: {name!r} is not the name of a file in one folder; give names such as drive_1.csv")


def _remove_temporary_files(folder: Path) -> None:
    """Remove what killed processes left beside what is under way; pooch's file is an empty one."""
    remove_leftovers(folder)
    for file in folder.glob("tmp????????"):
        if file.is_file():
            remove(file)


def _is_sha256(text: str) -> bool:
    return re.fullmatch(r"[0-9a-fA-F]{64}", text) is not None
