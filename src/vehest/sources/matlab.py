"""MAT-files of MATLAB as tables: which columns of numbers one has, and their samples.

They are read in a limited process (`vehest.sources.readers.mat`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from vehest.constants import FloatArray
from vehest.data.errors import DataError, printable
from vehest.data.files import regular_file
from vehest.sources.limited import read_limited

READER = "vehest.sources.readers.mat:read"


@dataclass(frozen=True)
class MatContents:
    """What a file holds, without the samples."""

    lengths: Mapping[str, int]  # name of a column -> its number of samples
    units: Mapping[str, str]  # name -> unit as the file writes it, where it does
    skipped: tuple[str, ...]  # what holds no column of numbers, with the reason

    @property
    def n_rows(self) -> int:
        """The number of samples that most columns have, the larger of two; 0 without a column."""
        counts = Counter(self.lengths.values())
        return max(counts, key=lambda length: (counts[length], length), default=0)


def is_matlab(file: Path) -> bool:
    """Whether a file is a MAT-file by its ending."""
    return file.suffix.lower() == ".mat"


def mat_contents(file: Path) -> MatContents:
    """Columns of a file, their lengths and units.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It is of another format, damaged or too large.
    """
    status = regular_file(file).stat()
    return _contents(file, status.st_size, status.st_mtime_ns)


@lru_cache(8)
def _contents(file: Path, size: int, changed: int) -> MatContents:
    """`mat_contents` of a file of that size [bytes] and time of its last change [ns]."""
    summary = read_limited(READER, file, selected=None).summary
    return MatContents(summary["lengths"], summary["units"], tuple(summary["skipped"]))


def read_mat(file: Path, selected: Sequence[str]) -> dict[str, FloatArray]:
    """Columns of a file.

    Parameters
    ----------
    file : Path
        The file.
    selected : sequence of str
        Names of columns that `mat_contents` has.

    Returns
    -------
    dict
        Name -> float64, (T,).

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It cannot be read, or the columns are not of one length.
    """
    lengths = mat_contents(file).lengths
    for name in selected[1:]:
        if lengths[name] != lengths[selected[0]]:
            raise DataError(
                f"'{file}': '{printable(selected[0])}' has {lengths[selected[0]]} samples, "
                f"'{printable(name)}' {lengths[name]}; resample them to one rate, for example in "
                "MATLAB by interp1, and save them so"
            )
    arrays = read_limited(READER, regular_file(file), selected=list(selected)).arrays
    return {name: arrays[name] for name in selected}
