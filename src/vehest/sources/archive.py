"""Unpacks a zip archive of unknown origin into a temporary folder, within limits.

archive -> every entry's path, kind, method and stated size checked -> entries copied out ->
folder, removed when the caller is done
"""

from __future__ import annotations

import io
import os
import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from vehest.data.errors import DataError, MissingError
from vehest.data.files import no_room, regular_file, writing_error
from vehest.data.limits import check_limit
from vehest.data.text_files import first_line

MOST_BYTES = 8 * 10**9  # bytes to which no archive may unpack, unless a caller allows more
# bytes to which an archive may unpack however well it is packed: no protection is needed below
ALLOWED_BYTES = 64 * 2**20
# largest ratio of unpacked to packed size of an archive that unpacks to more than `ALLOWED_BYTES`
MOST_EXPANSION = 250
MOST_FILES = 10_000  # entries of an archive; one with more is refused
# methods of compression that are read; without LZMA, which takes as much memory as an entry asks
# for, up to 4 GiB
METHODS = (
    zipfile.ZIP_STORED,
    zipfile.ZIP_DEFLATED,
    zipfile.ZIP_BZIP2,
)

# exceptions of zipfile and zlib for a damaged archive
_UNSOUND = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    RuntimeError,
    ValueError,
    OverflowError,
    MemoryError,
)


class _Archive(io.FileIO):
    """File of which no more is read at once than the limit.

    Zipfile reads the whole list of entries.
    """

    def read(self, size: int | None = -1, /) -> Any:
        """Bytes as of a file; `DataError` for more at once than ``limits.text_bytes``."""
        n_bytes = (
            os.fstat(self.fileno()).st_size - self.tell() if size is None or size < 0 else size
        )
        check_limit(
            "text_bytes",
            n_bytes,
            f"'{os.fsdecode(str(self.name))}' holds a list of entries of {n_bytes} bytes",
        )
        return super().read(size)


def unpacked_limit(packed: int, most_bytes: int = MOST_BYTES) -> int:
    """Largest size to which an archive of ``packed`` bytes may unpack on disk [bytes].

    It is `MOST_EXPANSION` times the packed size, at least `ALLOWED_BYTES` and at most
    ``most_bytes``.
    """
    return min(most_bytes, max(ALLOWED_BYTES, MOST_EXPANSION * packed))


@contextmanager
def unpacked(file: Path, *, most_bytes: int = MOST_BYTES) -> Iterator[Path]:
    """Yield a temporary folder with the contents of a zip archive; it is removed afterwards.

    All entries are checked before anything is written: no path outside the folder, no links or
    special files, no more bytes or files than the limits. zipfile unpacks no entry beyond its
    stated size, and checks its checksum. Archives inside stay packed.

    Parameters
    ----------
    file : Path
        The archive; entries may be stored, or packed by deflate or bzip2.
    most_bytes : int
        Upper bound of the limit of `unpacked_limit` [bytes].

    Yields
    ------
    Path
        The folder, in which entries have the paths that the archive gives them.

    Raises
    ------
    DataError
        It is no sound archive, is packed by another method, holds more than the limits or an entry
        that is no file inside the folder, or cannot be unpacked.
    MissingError
        There is no such file, or no room to unpack it.
    """
    with temporary_folder(file) as folder:
        try:
            with _Archive(regular_file(file)) as stream, zipfile.ZipFile(stream) as archive:
                entries = archive.infolist()
                size = sum(entry.file_size for entry in entries)
                max_bytes = unpacked_limit(file.stat().st_size, most_bytes)
                if len(entries) > MOST_FILES or size > max_bytes:
                    raise DataError(
                        f"'{file}' holds {len(entries)} entries, {size / 1e9:.3g} GB unpacked, "
                        f"more than the limit of {MOST_FILES} entries and {max_bytes / 1e9:.3g} "
                        "GB; unpack it by hand"
                    )
                for entry in entries:
                    if entry.compress_type not in METHODS:
                        raise DataError(
                            f"'{file}' is packed by another method than deflate; unpack it by hand"
                        )
                targets = {
                    entry: folder / _checked_path(file, entry)
                    for entry in entries
                    if not entry.is_dir()
                }
                for entry, target in targets.items():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    with archive.open(entry) as packed, open(target, "xb") as plain:
                        shutil.copyfileobj(packed, plain)
        except _UNSOUND as error:
            raise DataError(
                f"'{file}' is not a sound zip archive ({first_line(error)}); fetch it again"
            ) from None
        except OSError as error:
            if no_room(error) is not None:
                raise writing_error(folder, error) from None
            raise DataError(
                f"'{file}' cannot be unpacked ({error.strerror or error}); fetch it again"
            ) from None
        yield folder


@contextmanager
def temporary_folder(file: Path) -> Iterator[Path]:
    """Yield a folder to unpack a file into, which is removed afterwards with all that it holds.

    Parameters
    ----------
    file : Path
        What shall be unpacked, for messages.

    Raises
    ------
    MissingError
        There is no room for a folder, or no permission to make one; the message names ``TMPDIR``.
    """
    try:
        temporary = tempfile.TemporaryDirectory(prefix="vehest-", ignore_cleanup_errors=True)
    except OSError as error:
        raise MissingError(
            f"there is no temporary folder to unpack '{file}' into ({error.strerror}); set TMPDIR "
            "to one"
        ) from None
    with temporary as name:
        yield Path(name)


def _checked_path(file: Path, entry: zipfile.ZipInfo) -> PurePosixPath:
    """Path of an entry inside the folder; `DataError` for one that leaves it, a link or special
    file.

    Backslashes count as slashes; an entry without Unix permissions counts as a plain file.
    """
    name = entry.filename
    kind = stat.S_IFMT(entry.external_attr >> 16)
    path = PurePosixPath(name.replace("\\", "/"))
    leaves = (
        path.is_absolute()
        or PureWindowsPath(name).drive
        or ".." in path.parts
        or not path.parts
        or not name.isprintable()
    )
    if leaves or kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise DataError(
            f"'{file}': entry {name!r} is no file inside the folder, but a link or elsewhere; do "
            "not trust this archive"
        )
    return path
