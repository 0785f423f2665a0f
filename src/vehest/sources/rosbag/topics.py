"""A ROS 2 bag's topics: its files, unpacked where they are packed, then read by rosbags in a
limited process.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError, MissingError, VehestError
from vehest.data.files import regular_file, writing_error
from vehest.data.text_files import first_line, read_text
from vehest.sources.archive import MOST_BYTES, temporary_folder, unpacked, unpacked_limit
from vehest.sources.limited import Reading, read_limited, require_package

METADATA = "metadata.yaml"  # name of the file that describes a bag
STORAGES = (".db3", ".mcap")  # endings of the files of messages
PACKED = ".zstd"  # ending of a file that ROS has compressed as a whole


def read_bag(path: Path, function: str, most_bytes: int = MOST_BYTES, **request: Any) -> Reading:
    """Topics of a bag, read in a limited process.

    Parameters
    ----------
    path : Path
        A bag's folder, one of its ``.db3`` or ``.mcap`` files, or a zip archive that holds one bag.
    function : str
        ``read_topics`` or ``survey_topics`` of `vehest.sources.readers.bags`, which describe the
        request and the result.
    most_bytes : int
        Limit of what is unpacked [bytes].
    **request : object
        Further arguments of the function.

    Raises
    ------
    MissingError
        There is no bag, or rosbags is not installed.
    ConfigurationError
        A layout, type or field is wrong.
    DataError
        The bag is damaged, or is none. Messages name ``path``, wherever it was unpacked.
    """
    require_package("rosbags", "ros", "reading ROS 2 bags")
    bag_files(path)
    with _unpacked_bag(path, most_bytes) as bag:
        try:
            reader = f"vehest.sources.readers.bags:{function}"
            return read_limited(reader, bag, packed=path, **request)
        except VehestError as error:
            raise type(error)(str(error).replace(str(bag), str(path))) from None


def bag_files(path: Path) -> list[Path]:
    """The files that a bag is made of: the archive or file itself, or what its folder holds.

    Returns
    -------
    list of Path
        Sorted: metadata, storages and those that ROS has compressed as a whole.

    Raises
    ------
    MissingError
        There is no such path, the folder holds none of them or cannot be read.
    """
    if not path.is_dir():
        return [regular_file(path)]
    try:
        entries = sorted(path.iterdir())
    except OSError as error:
        raise MissingError(
            f"cannot read '{path}' ({error.strerror}); check its permissions"
        ) from None
    files = [
        file
        for file in entries
        if file.name == METADATA or file.suffix.lower() in (*STORAGES, PACKED)
    ]
    if not files:
        endings = [file.suffix for file in entries if file.suffix] or [".csv"]
        example = path / f"*{max(endings, key=endings.count)}"
        raise MissingError(
            f"'{path}' holds no bag: neither {METADATA} nor a file ending in "
            f"{' or '.join(STORAGES)}; of other logs name the files, such as {example}"
        )
    return files


@contextmanager
def _unpacked_bag(path: Path, most_bytes: int) -> Iterator[Path]:
    """The bag itself, or what was packed, in a temporary folder, which is removed afterwards.

    Raises
    ------
    DataError
        An archive holds no bag or several, a folder has no metadata, or what is packed is damaged
        or too large.
    """
    with ExitStack() as stack:
        bag = path
        if path.is_file() and path.suffix.lower() not in STORAGES:
            folder = stack.enter_context(unpacked(path, most_bytes=most_bytes))
            bags = [file.parent for file in folder.rglob(METADATA)]
            if len(bags) != 1:
                raise DataError(
                    f"'{path}' holds {len(bags) or 'no'} bags (folders with a {METADATA}); one is "
                    "needed; unpack logs of other kinds"
                )
            bag = bags[0]
        if bag.is_dir():
            if not (bag / METADATA).is_file():
                raise DataError(
                    f"'{path}' has no {METADATA}, without which a folder is no bag; make one with "
                    "'ros2 bag reindex'"
                )
            if packed := sorted(bag.glob(f"*{PACKED}")):
                folder = stack.enter_context(temporary_folder(path))
                _decompress(path, packed, folder, most_bytes)
                described = re.sub(r"(compression_mode:).*", r"\1 ''", read_text(bag / METADATA))
                (folder / METADATA).write_text(described, encoding="utf-8")
                bag = folder
        yield bag


def _decompress(path: Path, packed: Sequence[Path], folder: Path, most_bytes: int) -> None:
    """Unpack files that ROS has compressed as a whole, under their names, into ``folder``.

    Raises
    ------
    DataError
        One is damaged, or all together unpack to more than the limit.
    MissingError
        There is no room for them.
    """
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    max_unpacked = unpacked_limit(sum(file.stat().st_size for file in packed), most_bytes)
    n_bytes = 0
    for file in packed:
        try:
            with zstd.open(file) as stream, open(folder / file.name, "xb") as plain:
                while block := stream.read(1 << 20):
                    n_bytes += len(block)
                    if n_bytes > max_unpacked:
                        is_limited = max_unpacked == most_bytes
                        remedy = "raise unpacked_limit" if is_limited else "unpack it by hand"
                        raise DataError(
                            f"'{path}' would unpack to more than the limit of "
                            f"{max_unpacked / 1e9:.3g} GB; {remedy}"
                        )
                    plain.write(block)
        except (zstd.ZstdError, EOFError) as error:
            raise DataError(
                f"'{path}': '{file.name}' is truncated or damaged ({first_line(error)}); fetch it "
                "again"
            ) from None
        except OSError as error:
            raise writing_error(folder, error) from None
