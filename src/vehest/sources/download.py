"""Downloads the files of a data set through pooch.

``download: {url: https://…, files: [a.csv], sha256: {a.csv: …}}`` -> `download_of` -> folder
``.download`` of the data set's ``path`` -> checksum compared, or recorded in ``checksums.txt``
(pooch's registry format) -> file
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote

from pydantic import AfterValidator, Field

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.files import remove_leftovers, sha256_of, writing_error, written_aside
from vehest.data.schema import validated
from vehest.data.text_files import first_line, read_text
from vehest.sources.base import Source, existing_folder
from vehest.version import __version__

CHECKSUMS = "checksums.txt"  # name of the record of checksums
UNDER_WAY = ".download"  # folder of files that are being downloaded
CHUNK = 1 << 15  # bytes that are received at a time
TIMEOUTS = (15.0, 60.0)  # s, longest times to connect and between two chunks
# text on what to do after a failed download
REMEDY = "correct download.url or put the file into the data set's folder by hand"
NAME = re.compile(r'[^./\\:*?"<>|\s-][^/\\:*?"<>|\x00-\x1f\x7f]*')  # matches valid names of files

# takes the file, bytes received, and bytes in all where the server states them
Progress = Callable[[str, int, int | None], None]


def _file_name(name: str) -> str:
    """The name itself; `ValueError` for one with a folder in it, or that of the record of
    checksums.
    """
    if not NAME.fullmatch(name) or name == CHECKSUMS:
        raise ValueError(f"{name!r} is not the name of a file in one folder, such as drive_1.csv")
    return name


FileName = Annotated[str, AfterValidator(_file_name)]  # name of a file without a folder
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-fA-F]{64}$")]  # checksum in hexadecimal digits


@dataclass(frozen=True)
class DownloadOptions:
    """Option ``download`` of a data set; without ``files`` the source names them."""

    url: Annotated[str, Field(pattern=r"^https?://[^\s/\[]\S*$")]  # address of the folder
    # names of the files; None: those that the source names
    files: tuple[FileName, ...] | None = None
    sha256: dict[FileName, Sha256] | None = None  # name of a file -> its checksum


@dataclass(frozen=True)
class Outcome:
    """Result of the download or check of one file."""

    name: str  # name of the file
    # matched its known checksum; was there and its checksum is recorded on first sight
    what: Literal["fetched", "matched", "recorded"]
    sha256: str  # checksum of the file
    size: int  # bytes


@dataclass(frozen=True)
class Download:
    """Files of a data set, the folder where they belong, and the address of the folder that they
    come from.

    A file counts as there if it is not empty. Its checksum is compared with that of ``sha256``, or
    else with the recorded one.
    """

    folder: Path  # folder of the data set
    url: str  # address of the folder from which they come
    files: tuple[str, ...]  # names of the files
    # name of a file -> checksum that is known beforehand
    sha256: Mapping[str, str] = field(default_factory=dict)

    def address(self, name: str) -> str:
        """Address of a file: its name, percent-encoded, below ``url``."""
        return f"{self.url.rstrip('/')}/{quote(name)}"

    def missing(self) -> list[str]:
        """Files that are not there; those that are there are checked. Writes nothing.

        Raises
        ------
        DataError
            One has another checksum than expected, or the record of checksums is damaged.
        """
        return [name for name in self.files if self._checked(name) is None]

    def fetch(self, progress: Progress | None = None) -> Iterator[Outcome]:
        """Download missing files one after another; a file takes its name once it is complete,
        checked and recorded.

        Parameters
        ----------
        progress : callable or None
            Called after each chunk with the file's name, the bytes received and the bytes in all,
            None where the server does not state them.

        Yields
        ------
        Outcome
            One a file, in the order of ``files``, as soon as it is there.

        Raises
        ------
        DataError
            A file that is there or that came has other bytes than recorded.
        MissingError
            The server cannot be reached or does not have it, the disk is full, or another process
            is fetching into the folder.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise writing_error(self.folder, error) from error
        with _locked(self.folder):
            remove_leftovers(self.folder)
            try:
                for name in self.files:
                    yield self._outcome(name, progress)
            finally:
                shutil.rmtree(self.folder / UNDER_WAY, ignore_errors=True)

    def _outcome(self, name: str, progress: Progress | None) -> Outcome:
        """Check a file that is there, or fetch it; its checksum is recorded before it takes its
        name.
        """
        import pooch

        path = self.folder / name
        recorded = name in _read_checksums(self.folder)
        checksum = self._checked(name)
        if checksum is not None:
            _record(self.folder, name, checksum)
            return Outcome(
                name, "matched" if recorded else "recorded", checksum, path.stat().st_size
            )
        address = self.address(name)
        downloader = partial(_download, report=partial(progress, name) if progress else None)
        pooch.get_logger().setLevel("WARNING")
        try:
            complete = pooch.retrieve(
                address,
                self._expected(name),
                name,
                self.folder / UNDER_WAY,
                downloader=downloader,
            )
            checksum = sha256_of(Path(complete))
            _record(self.folder, name, checksum)
            os.replace(complete, path)
        except OSError as error:
            if error.errno is not None:
                raise writing_error(path, error) from error
            cause = str(error)[-200:]  # which comes last
            raise MissingError(f"cannot fetch {address}: {cause}; {REMEDY}") from None
        except ValueError as error:  # of pooch, which has removed the file
            raise DataError(
                f"{address}: {error} (known by download.sha256 or {self.folder / CHECKSUMS})"
            ) from None
        return Outcome(name, "fetched", checksum, path.stat().st_size)

    def _checked(self, name: str) -> str | None:
        """Checksum of a file that is there and has the expected one; None where it is not there."""
        path = self.folder / name
        expected = self._expected(name)
        if not path.is_file() or not path.stat().st_size:
            return None
        checksum = sha256_of(path)
        if expected not in (None, checksum):
            raise DataError(
                f"'{path}' has the sha256 {checksum}, expected is {expected}: it was changed or "
                "is damaged; remove the file to fetch it again, or correct download.sha256 or "
                f"{CHECKSUMS} to accept it"
            )
        return checksum

    def _expected(self, name: str) -> str | None:
        """Known checksum of a file: the declared one, else the recorded one, else None."""
        return self.sha256.get(name) or _read_checksums(self.folder).get(name)


def _download(
    url: str,
    output_file: str,
    pooch: Any = None,
    report: Callable[[int, int | None], None] | None = None,
) -> None:
    """Download ``url`` into ``output_file``, as pooch calls it.

    Parameters
    ----------
    url, output_file : str
        Address and path; the file is written as chunks arrive.
    pooch : object
        The caller, which is not used.
    report : callable or None
        Called after each chunk with the bytes received and the length that the server states, or
        None.

    Raises
    ------
    MissingError
        The server refuses, sends a web page, or does not state a length.
    OSError
        It is out of reach or breaks off, or the disk is full.
    """
    import requests

    headers = {"Accept-Encoding": "identity", "User-Agent": f"vehest/{__version__}"}
    with requests.get(url, headers=headers, stream=True, timeout=TIMEOUTS) as response:
        length = response.headers.get("Content-Length", "")
        fault = ""
        if response.status_code != requests.codes.ok:
            fault = f"the server answers {response.status_code} {response.reason}"
        elif "html" in response.headers.get("Content-Type", ""):
            fault = "it is a web page, not a file"
        elif not length and not response.raw.chunked:
            fault = "the server does not state its length, so that a break would not show"
        if fault:
            raise MissingError(f"cannot fetch {url}: {fault}; {REMEDY}")
        with open(output_file, "wb") as stream:
            for chunk in response.iter_content(CHUNK):  # a short answer is a ConnectionError
                stream.write(chunk)
                if report is not None:
                    report(stream.tell(), int(length) if length else None)


def download_of(source: Source) -> Download:
    """Option ``download`` of a data set, with its folder.

    Parameters
    ----------
    source : Source
        The data set's source, which names the files where the option does not.

    Raises
    ------
    ConfigurationError
        The option is missing or wrong, or names no file, or one twice.
    MissingError
        No data root is set.
    """
    location = f"data set '{source.name}'"
    options = validated(
        DownloadOptions,
        source.dataset.get("download"),
        location,
        error=ConfigurationError,
        group="dataset.download",
    )
    try:
        files = (
            tuple(map(_file_name, source.file_names())) if options.files is None else options.files
        )
    except ValueError as error:
        raise ConfigurationError(f"{location}: {error}") from None
    if not files or len(set(files)) < len(files):
        raise ConfigurationError(
            f"{location}: download.files must list the names of files, each once, not {list(files)}"
        )
    path = str(source.dataset.get("path") or "None")
    has_root = path.split("/")[0] not in {"None", "null"}
    folder = Path(path).expanduser() if has_root else existing_folder(None, source.name)
    sha256 = {name: digest.lower() for name, digest in (options.sha256 or {}).items()}
    return Download(folder, options.url, files, sha256)


def _read_checksums(folder: Path) -> dict[str, str]:
    """Recorded checksums by name, empty if there is no record.

    Raises
    ------
    DataError
        The record is damaged.
    """
    import pooch

    file = folder / CHECKSUMS
    if not os.path.lexists(file):
        return {}
    read_text(file)  # which is bounded, and refuses pipes
    registry = pooch.create(folder, "")
    try:
        registry.load_registry(file)
    except (OSError, ValueError) as error:
        raise DataError(
            f"'{file}' is no record of checksums ({first_line(error)}); repair it, or remove it "
            "to record anew"
        ) from None
    return dict(registry.registry)


def _record(folder: Path, name: str, sha256: str) -> None:
    """Add a line to the record of checksums, unless it has one of that name."""
    if name not in _read_checksums(folder):
        file = folder / CHECKSUMS
        text = file.read_text(encoding="utf-8").rstrip("\n") + "\n" if file.exists() else ""
        with written_aside(file) as aside:
            aside.write_text(f"{text}{shlex.quote(name)} {sha256}\n", encoding="utf-8")


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Context in which no other process downloads into a folder.

    Folders on disks that know no locks are not held.

    Raises
    ------
    MissingError
        Another process holds it.
    """
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network disks know no locks
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise MissingError(
                    f"another process is fetching into '{folder}'; run again when it is done"
                ) from None
        yield
    finally:
        os.close(descriptor)
