"""Unpacking an archive that nobody vouches for: looked at as a whole first, into a temporary folder, within limits."""

from __future__ import annotations

import errno
import io
import lzma
import os
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath
from typing import Any, BinaryIO

from vehest.data.errors import DataError, MissingError
from vehest.data.files import regular_file, writing_error
from vehest.data.limits import check_limit

MOST_BYTES = 8 * 10**9
MOST_FILES = 10_000
SMALL, MOST_EXPANSION = 64 * 2**20, 250  # bytes, and times its size that a larger archive may unpack to
DEEPEST = 60  # folders
BLOCK = 1 << 20
LONGEST_NAME = 255  # bytes, of a file or a folder

_UNSOUND = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, RuntimeError, ValueError, OverflowError, MemoryError)


class _Archive(io.FileIO):
    """A file that is not read at once where that takes more than the limit; the list of an archive's entries is as long as it says."""

    def read(self, size: int | None = -1, /) -> Any:
        asked = os.fstat(self.fileno()).st_size - self.tell() if size is None or size < 0 else size
        check_limit("text_bytes", asked, f"'{os.fsdecode(str(self.name))}' holds a list of entries of {asked} bytes")
        return super().read(size)


@contextmanager
def unpacked(file: Path, *, most_bytes: int = MOST_BYTES, most_files: int = MOST_FILES) -> Iterator[Path]:
    """Yield a temporary folder with the contents of a zip archive; it is removed afterwards, whatever happens.

    Nothing is written before every entry has been looked at. Refused are names that climb out of the folder or are absolute,
    symbolic links and special files, encrypted entries, two entries of one name, and more bytes or files than the limits. What an archive
    says of its sizes is not believed: no entry is unpacked beyond what it says. Archives inside are files like any other.

    Args:
        file: the archive.
        most_bytes: limit of the unpacked files together [bytes]; 8 GB.
        most_files: limit of their number, folders included.

    Raises:
        DataError: the archive is refused, truncated or corrupt.
        MissingError: the archive cannot be opened, or there is no room to unpack it.
    """
    with _temporary_folder(file) as folder:
        try:
            with _Archive(regular_file(file)) as stream, zipfile.ZipFile(stream) as archive:
                targets = _targets(file, archive.infolist(), most_bytes, most_files)
                left = most_bytes
                for entry, parts in targets:
                    left -= _unpack(file, archive, entry, folder.joinpath(*parts), left)
        except _UNSOUND as error:
            raise DataError(f"'{file}' is not a sound zip archive ({_first_line(error)}); fetch it again") from None
        except OSError as error:
            if error.errno == errno.EINVAL:  # an offset before the beginning
                raise DataError(f"'{file}' is not a sound zip archive (an entry lies outside of it); fetch it again") from None
            raise MissingError(f"cannot read '{file}' ({error.strerror or error}); check the disk and its permissions") from None
        yield folder


@contextmanager
def _temporary_folder(file: Path) -> Iterator[Path]:
    try:
        kept = tempfile.TemporaryDirectory(prefix="vehest-", ignore_cleanup_errors=True)
    except OSError as error:
        raise MissingError(f"there is no temporary folder to unpack '{file}' into ({error.strerror}); set TMPDIR to one") from None
    with kept as name:
        yield Path(name)


def _targets(file: Path, entries: list[zipfile.ZipInfo], most_bytes: int, most_files: int) -> list[tuple[zipfile.ZipInfo, tuple[str, ...]]]:
    """Every file to unpack with the parts of its path, once all entries are known to be harmless."""
    if len(entries) > most_files:
        raise DataError(f"'{file}' holds {len(entries)} entries, more than the limit of {most_files}; unpack it by hand if you trust it")
    size = sum(entry.file_size for entry in entries)
    if size > most_bytes:
        raise DataError(
            f"'{file}' would unpack to {size / 1e9:.3g} GB, more than the limit of {most_bytes / 1e9:.3g} GB; "
            f"unpack it by hand if you trust it"
        )
    if size > max(SMALL, MOST_EXPANSION * file.stat().st_size):
        raise DataError(f"'{file}' would unpack to more than {MOST_EXPANSION} times its size; unpack it by hand if you trust it")
    targets: dict[tuple[str, ...], zipfile.ZipInfo] = {}
    for entry in entries:
        parts = _harmless_path(file, entry)
        if entry.is_dir():
            continue
        if parts in targets:
            raise DataError(f"'{file}' holds two entries called {entry.filename!r}; pack it again")
        targets[parts] = entry
    for parts, entry in targets.items():
        if any(parts[:depth] in targets for depth in range(1, len(parts))):
            raise DataError(f"'{file}': a folder on the way to {entry.filename!r} is a file, too; pack it again")
    return [(entry, parts) for parts, entry in targets.items()]


def _harmless_path(file: Path, entry: zipfile.ZipInfo) -> tuple[str, ...]:
    name = entry.filename
    parts = tuple(part for part in name.replace("\\", "/").split("/") if part not in ("", "."))
    if name.startswith(("/", "\\")) or PureWindowsPath(name).drive or ".." in parts or not parts or any(ord(c) < 32 for c in name):
        raise DataError(f"'{file}': entry {name!r} would be written outside of the folder it belongs in; do not trust this archive")
    if len(parts) > DEEPEST or any(len(part.encode("utf-8", "surrogateescape")) > LONGEST_NAME for part in parts):
        raise DataError(f"'{file}': entry {name[:60]!r}… has too long a name, or lies in too many folders; pack it again")
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise DataError(f"'{file}': entry {name!r} is a symbolic link, which could lead anywhere; pack the file itself")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise DataError(f"'{file}': entry {name!r} is neither a file nor a folder; pack it again without")
    if entry.flag_bits & 1:
        raise DataError(f"'{file}': entry {name!r} is encrypted; unpack it by hand")
    return parts


def _unpack(file: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path, most_bytes: int) -> int:
    """Write one file; the bytes are counted, since an archive may lie about them."""
    written = 0
    with archive.open(entry) as packed, _new_file(target) as plain:
        while block := packed.read(BLOCK):
            written += len(block)
            if written > most_bytes:
                raise DataError(f"'{file}': entry {entry.filename!r} unpacks to more than the archive says; do not trust it")
            try:
                plain.write(block)
                plain.flush()
            except OSError as error:
                raise writing_error(target, error) from None
    return written


def _new_file(target: Path) -> BinaryIO:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        return open(target, "xb")
    except OSError as error:
        raise writing_error(target, error) from None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:160]
