"""Base of sources whose files are a recording each, or one for each uninterrupted run in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, MissingError, printable
from vehest.data.recording import UNNAMED_VEHICLE, Recording
from vehest.sources.base import Source, existing_folder, kind_of
from vehest.sources.clocks import Clock
from vehest.sources.columns import Column, columns_from_config
from vehest.sources.table_rows import Runs
from vehest.sources.tables import listed


class FileSource(Source):
    """Files that match the option ``files`` in the folder ``path``.

    A file's stem is the recording's name, ``STEM_run_N`` that of a run.

    Attributes
    ----------
    gappy : frozenset of str
        Channels in which NaN means "not measured".
    """

    gappy: frozenset[str] = frozenset()

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self._runs_of = cache(self._selected_runs)

    def ids(self) -> list[str]:
        """Names of the recordings, in alphabetical order of the files and in that of a file's
        runs.
        """
        return list(self._recordings_by_name())

    def inputs(self) -> dict[str, str | Path]:
        """The files that match, by their names without the folder.

        Raises
        ------
        MissingError
            The folder is not there, or nothing in it matches.
        DataError
            Two files make one name of a recording.
        """
        return {file.name: file for file in self.data_files()}

    def read_raw(self, recording_id: str) -> Recording:
        """Read one recording by its name, without transforms.

        Raises
        ------
        MissingError
            There is none of that name.
        DataError
            It cannot be used.
        """
        by_name = self._recordings_by_name()
        if recording_id not in by_name:
            raise MissingError(
                f"{self.location} has no recording '{recording_id}' (it has "
                f"{listed(list(by_name))})"
            )
        return self._read(*by_name[recording_id])

    def read_raw_file(self, file: Path) -> Recording:
        """Read a file wherever it is, without transforms.

        Raises
        ------
        MissingError
            The file is not there.
        DataError
            It cannot be used, or holds several runs of which the option ``run`` names none.
        """
        runs = list(self._runs_of(file))
        if len(runs) > 1:
            raise DataError(
                f"'{file}' holds {len(runs)} runs ({listed([str(run) for run in runs])}); name "
                f"one by +dataset.run={runs[0]}"
            )
        return self._read(file, runs[0])

    def _read(self, file: Path, run: int | None) -> Recording:
        """A file, or one run of it."""
        return super().read_raw_file(file)

    def _recordings_by_name(self) -> dict[str, tuple[Path, int | None]]:
        """Name of each recording -> its file and run."""
        return {
            self._name_of(file, run): (file, run)
            for file in self.data_files()
            for run in self._runs_of(file)
        }

    def runs_in(self, file: Path) -> Runs:
        """Number of each run in a file -> its rows.

        All rows under None where runs are not distinguished.
        """
        return {None: slice(None)}

    def _selected_runs(self, file: Path) -> Runs:
        """Runs of a file: all, or the one that the option ``run`` names.

        A source has them in the cache ``_runs_of``.

        Raises
        ------
        DataError
            The file holds no run, or none of that number.
        """
        runs = self.runs_in(file)
        number = getattr(self.options, "run", None)
        if not runs or (number is not None and number not in runs):
            named = "between its pauses" if number is None else number
            raise DataError(f"'{file}' holds no run {named} ({listed([str(run) for run in runs])})")
        return runs if number is None else {number: runs[number]}

    def data_files(self) -> list[Path]:
        """The files that match, sorted; see `inputs` for what is raised."""
        folder = existing_folder(self.dataset.get("path"), self.name)
        files = self._matching(folder)
        if not files:
            raise MissingError(
                f"{self.location}: no file in '{folder}' matches '{self.options.files}'"
            )
        names = [self._id_of(file) for file in files]
        if doubled := sorted({name for name in names if names.count(name) > 1}):
            raise DataError(
                f"{self.location}: two files are called '{doubled[0]}', a recording's name must "
                "be unique"
            )
        return files

    def _matching(self, folder: Path) -> list[Path]:
        """Files in a folder that the pattern ``files`` matches, sorted by path; folders do not
        count.
        """
        return sorted(file for file in folder.glob(self.options.files) if file.is_file())

    def _id_of(self, file: Path) -> str:
        """Name of a file's recording: its stem."""
        return file.stem

    def _name_of(self, file: Path, run: int | None) -> str:
        """Name of a recording: that of the file, and the number of the run where runs are
        distinguished.
        """
        return self._id_of(file) if run is None else f"{self._id_of(file)}_run_{run}"

    def _require_pattern(self) -> None:
        """Raise an error unless ``files`` is a pattern inside the folder."""
        pattern = self.options.files
        unclear = any("**" in part and part != "**" for part in Path(pattern).parts)
        if not Path(pattern).parts or Path(pattern).is_absolute() or unclear or "\0" in pattern:
            raise ConfigurationError(
                f"{self.location}: files must be a pattern inside path, such as '*.csv' or "
                f"'**/*.csv', not '{printable(pattern)}'"
            )

    def _recording(
        self,
        recording_id: str,
        location: str,
        clock: Clock,
        channels: Mapping[str, FloatArray],
        provenance: Mapping[str, Any],
    ) -> Recording:
        """A recording of this data set.

        Parameters
        ----------
        recording_id : str
            Its name.
        location : str
            The file, for messages.
        clock : Clock
            Rate and start of the samples.
        channels : mapping
            Channel -> samples in its SI unit, one a tick of the clock, shape (T,).
        provenance : mapping
            What the source adds to the names of data set and source.

        Raises
        ------
        DataError
            The channels make no recording.
        """
        try:
            return Recording(
                id=recording_id,
                vehicle=str(self.dataset.get("vehicle", UNNAMED_VEHICLE)),
                rate_hz=clock.rate_hz,
                start_time=clock.start_time,
                channels=channels,
                kind=kind_of(self.dataset),
                gappy=self.gappy,
                provenance={"dataset": self.name, "source": self.dataset["source"], **provenance},
            )
        except DataError as error:
            raise DataError(f"{location}: {error}") from None

    def _declared(
        self, entries: Mapping[str, Any] | None, kind: type[Column] = Column
    ) -> dict[str, Any]:
        """Channel -> its declaration, one at least; those that the option ``gappy`` names are
        `gappy`.

        Raises
        ------
        ConfigurationError
            None is declared, one is wrong, or ``gappy`` names another channel.
        """
        columns = columns_from_config(entries or {}, self.name, kind)
        if not columns:
            raise ConfigurationError(
                f"{self.location}: channels must map a channel to its column and unit"
            )
        self.gappy = self._gappy_among(columns)
        return columns

    def _gappy_among(self, channels: Iterable[str]) -> frozenset[str]:
        """Channels that the option ``gappy`` names, which must be among the data set's."""
        gappy = frozenset(getattr(self.options, "gappy", None) or ())
        for name in sorted(gappy - set(channels)):
            raise ConfigurationError(
                f"{self.location}: gappy names '{name}', which is not one of its channels"
            )
        return gappy
