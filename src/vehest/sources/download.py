"""Downloads the files of a data set through pooch.

``download: {url: https://…, files: [a.csv], sha256: {a.csv: …}}`` -> `download_of` -> folder ``.download`` of the data set's ``path`` ->
checksum compared, or recorded in ``checksums.txt`` (pooch's registry format) -> file
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.files import remove_leftovers, sha256_of, writing_error, written_aside
from vehest.data.schema import validated
from vehest.data.text_files import first_line, read_text
from vehest.sources.base import Source, existing_folder
from vehest.sources.resuming import Progress, ResumingDownloader

CHECKSUMS = "checksums.txt"
UNDER_WAY = ".download"
NAME = re.compile(r'[^./\\:*?"<>|\s-][^/\\:*?"<>|\x00-\x1f\x7f]*')
SHA256 = re.compile(r"[0-9a-fA-F]{64}")


@dataclass(frozen=True)
class DownloadOptions:
    """Option ``download`` of a data set; without ``files`` the source names them."""

    url: str
    files: tuple[str, ...] | None = None
    sha256: dict[str, str] | None = None


@dataclass(frozen=True)
class Outcome:
    """Result for one file.

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
    """Files of a data set, their address and their folder.

    Args:
        dataset: name of the data set.
        folder: where the files belong.
        url: address of the folder that they come from.
        files: their names.
        sha256: checksums known beforehand, by name.
    """

    dataset: str
    folder: Path
    url: str
    files: tuple[str, ...]
    sha256: Mapping[str, str] = field(default_factory=dict)

    def address(self, name: str) -> str:
        """Address of a file."""
        return f"{self.url.rstrip('/')}/{quote(name)}"

    def missing(self) -> list[str]:
        """Files that are not there; those that are there are checked. Writes nothing.

        Raises:
            DataError: a file, or the record of checksums, is damaged or another one.
        """
        known = self._known()
        return [name for name in self.files if self._checked(name, known) is None]

    def fetch(self, progress: Progress | None = None) -> Iterator[Outcome]:
        """Download missing files one after another; a file takes its name once it is complete, checked and recorded.

        Raises:
            DataError: a file that is there or that came has other bytes than recorded.
            MissingError: the server cannot be reached or does not have it, or the disk is full; what has arrived is kept.
        """
        under_way = self.folder / UNDER_WAY
        try:
            under_way.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise writing_error(under_way, error) from error
        with _locked(self.folder):
            remove_leftovers(self.folder)
            for name in self.files:
                yield self._outcome(name, progress)
            with suppress(OSError):  # parts of other files stay
                under_way.rmdir()

    def _outcome(self, name: str, progress: Progress | None) -> Outcome:
        import pooch

        path, known, record = self.folder / name, self._known(), self.folder / CHECKSUMS
        found = self._checked(name, known)
        if found is not None:
            recorded = name in _read_checksums(record)
            _record(record, name, found)
            return Outcome(name, "matched" if recorded else "recorded", found, path.stat().st_size)
        downloader = ResumingDownloader(self.folder / UNDER_WAY / f"{name}.part", progress)
        pooch.get_logger().setLevel("WARNING")
        try:
            complete = pooch.retrieve(self.address(name), known.get(name), name, self.folder / UNDER_WAY, downloader=downloader)
            found = sha256_of(Path(complete))
            _record(record, name, found)
            os.replace(complete, path)
        except OSError as error:
            if error.errno is not None:
                raise writing_error(path, error) from error
            reason = str(error).rsplit(": ", 1)[-1].split("', ")[0].rstrip("'\")")  # the innermost of the errors that requests reports
            trust = "no trusted connection, " if "SSLError" in str(error) else ""
            part = "; the same command goes on after what has arrived" if downloader.part.exists() else ""
            raise MissingError(f"cannot fetch {self.address(name)}: {trust}{reason[:160]}{part}") from None
        except ValueError as error:  # of pooch, which has removed the file
            raise DataError(f"{self.address(name)}: {error} {self._origin(name)}") from None
        return Outcome(name, "fetched", found, path.stat().st_size, downloader.resumed_at)

    def _checked(self, name: str, known: Mapping[str, str]) -> str | None:
        """Checksum of a file that is there and has the known one; None where it is not there."""
        path = self.folder / name
        if path.is_dir():
            raise DataError(f"'{path}' is a folder where a file belongs; remove it and run again")
        if not path.is_file() or not path.stat().st_size:
            return None
        found = sha256_of(path)
        if known.get(name, found) != found:
            raise DataError(
                f"'{path}' has the sha256 {found}, expected is {known[name]} {self._origin(name)}: it was changed or is damaged; "
                f"remove the file to fetch it again, or that line to accept it"
            )
        return found

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

    def _origin(self, name: str) -> str:
        return f"(download.sha256 of data set '{self.dataset}')" if name in self.sha256 else f"(recorded in '{self.folder / CHECKSUMS}')"


def download_of(source: Source) -> Download:
    """Option ``download`` of a data set.

    Raises:
        ConfigurationError: it is missing or makes no sense.
        MissingError: no data root is set.
    """
    where = f"data set '{source.name}'"
    options = validated(DownloadOptions, source.dataset.get("download"), where, error=ConfigurationError, group="dataset.download")
    if not re.fullmatch(r"https?://[^\s/\[]\S*", options.url):
        raise ConfigurationError(f"{where}: download.url must be an address such as https://example.org/folder, not '{options.url}'")
    files = tuple(source.file_names()) if options.files is None else options.files
    if not files or len(set(files)) < len(files):
        raise ConfigurationError(f"{where}: download.files must list the names of files, each once, not {list(files)}")
    sha256 = options.sha256 or {}
    for name in (*files, *sha256):
        if not NAME.fullmatch(name) or name == CHECKSUMS:
            raise ConfigurationError(f"{where}: download: {name!r} is not the name of a file in one folder, such as drive_1.csv")
    for name, digest in sha256.items():
        if not SHA256.fullmatch(digest):
            raise ConfigurationError(f"{where}: download.sha256 of '{name}' must be 64 hexadecimal digits, not '{digest}'")
    path = str(source.dataset.get("path") or "None")
    folder = existing_folder(None, source.name) if path.split("/")[0] in {"None", "null"} else Path(path).expanduser()
    return Download(source.name, folder, options.url, files, {name: digest.lower() for name, digest in sha256.items()})


def _read_checksums(file: Path) -> dict[str, str]:
    """Recorded checksums by name, empty if there is no record.

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
    except (OSError, ValueError) as error:
        raise DataError(f"'{file}' is no record of checksums ({first_line(error)}); repair it, or remove it to record anew") from None
    for name, digest in registry.registry.items():
        if not SHA256.fullmatch(digest):
            raise DataError(f"'{file}': the checksum of '{name}' must be 64 hexadecimal digits, not '{digest}'; repair or remove the line")
    return dict(registry.registry)


def _record(file: Path, name: str, sha256: str) -> None:
    """Add a line to the record of checksums, unless it has one of that name."""
    if name not in _read_checksums(file):
        text = file.read_text(encoding="utf-8").rstrip("\n") + "\n" if file.exists() else ""
        with written_aside(file) as aside:
            aside.write_text(f"{text}{shlex.quote(name)} {sha256}\n", encoding="utf-8")


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder, so that no other process downloads into it."""
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network disks know no locks
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise MissingError(f"another process is fetching into '{folder}'; run again when it is done") from None
        yield
    finally:
        os.close(descriptor)
