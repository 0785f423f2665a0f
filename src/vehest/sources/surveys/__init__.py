"""What a log holds before anybody has said what its columns are: names, units as written, numbers, and what looks like a clock.

Nothing is made a channel here; ``vehest.alignment.proposals`` says what speaks for which.
"""

from __future__ import annotations

from pathlib import Path

from vehest.data.errors import DataError, MissingError
from vehest.data.store import is_stored_recording
from vehest.sources.surveys.log import Log, RawColumn, Stamps
from vehest.sources.surveys.tables import survey_table

__all__ = ["Log", "RawColumn", "Stamps", "survey"]

MDF, VBO, BAGS = (".mf4", ".mdf", ".dat"), (".vbo",), (".db3", ".mcap", ".zip", ".bag")


def survey(path: Path) -> Log:
    """What one file, or a bag's folder, holds.

    Raises:
        MissingError: it is not there or empty, or a package is missing that its format needs.
        DataError: it is of no format that is read, damaged, or holds no numbers.
    """
    if not path.exists():
        raise MissingError(f"there is no file '{path}'")
    ending = path.suffix.lower()
    if path.is_dir() or ending in BAGS:
        from vehest.sources.surveys.bags import survey_bag

        if ending == ".bag":
            raise DataError(f"'{path}' is a bag of ROS 1; convert it by 'rosbags-convert --src {path.name} --dst {path.stem}'")
        log = survey_bag(path)
    elif path.stat().st_size == 0:
        raise MissingError(f"file '{path}' is empty")
    elif ending in MDF and _begins_as_mdf(path):
        from vehest.sources.surveys.mdf import survey_mdf

        log = survey_mdf(path)
    elif ending in VBO:
        from vehest.sources.surveys.vbo import survey_vbo

        log = survey_vbo(path)
    elif is_stored_recording(path):
        raise DataError(f"'{path}' is a recording of vehest's own already, with channels; try 'vehest data usable {path}'")
    else:
        log = survey_table(path)
    if not log.columns:
        raise DataError(f"'{path}' holds no column of numbers")
    return log


def _begins_as_mdf(path: Path) -> bool:
    if path.suffix.lower() != ".dat":
        return True
    with open(path, "rb") as stream:
        return stream.read(8) in (b"MDF     ", b"UnFinMF ")
