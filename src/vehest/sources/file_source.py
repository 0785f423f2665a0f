"""Base of sources whose files are a recording each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import Source, existing_folder, kind_of
from vehest.sources.clocks import Clock
from vehest.sources.columns import Column, columns_from_config
from vehest.sources.tables import listed


class FileSource(Source):
    """Files that match the option ``files`` in the folder ``path``, a recording each; a file's stem is the recording's name.

    Attributes:
        gappy: channels in which NaN means "not measured".
    """

    gappy: frozenset[str] = frozenset()

    def ids(self) -> list[str]:
        """Names of the files, in alphabetical order."""
        return [self._id_of(file) for file in self._files()]

    def inputs(self) -> dict[str, str | Path]:
        """The files."""
        return {file.name: file for file in self._files()}

    def read_raw(self, recording_id: str) -> Recording:
        """Read one file by its name; raises `MissingError` where there is none, `DataError` where it cannot be used."""
        for file in self._files():
            if self._id_of(file) == recording_id:
                return self.read_raw_file(file)
        raise self._no_recording(recording_id)

    def _files(self) -> list[Path]:
        folder = existing_folder(self.dataset.get("path"), self.name)
        files = self._matching(folder)
        if not files:
            raise MissingError(f"{self.where}: no file in '{folder}' matches '{self.options.files}'")
        names = [self._id_of(file) for file in files]
        if doubled := sorted({name for name in names if names.count(name) > 1}):
            raise DataError(f"{self.where}: two files are called '{doubled[0]}', a recording's name must be unique")
        return files

    def _matching(self, folder: Path) -> list[Path]:
        return sorted(file for file in folder.glob(self.options.files) if file.is_file())

    def _id_of(self, file: Path) -> str:
        return file.stem

    def _no_recording(self, recording_id: str) -> MissingError:
        return MissingError(f"{self.where} has no recording '{recording_id}' (it has {listed(self.ids())})")

    def _require_pattern(self) -> None:
        """See that ``files`` is a pattern inside the folder."""
        pattern = self.options.files
        if not pattern or Path(pattern).is_absolute():
            raise ConfigurationError(f"{self.where}: files must be a pattern inside path, such as '*.csv', not '{pattern}'")

    def _recording(
        self, recording_id: str, where: str, clock: Clock, channels: Mapping[str, FloatArray], provenance: Mapping[str, Any]
    ) -> Recording:
        """A recording of this data set; raises `DataError` where its channels make none; ``where`` names the file."""
        try:
            return Recording(
                id=recording_id,
                vehicle=str(self.dataset.get("vehicle", "unknown")),
                rate_hz=clock.rate_hz,
                start_time=clock.start_time,
                channels=channels,
                kind=kind_of(self.dataset),
                gappy=self.gappy,
                provenance={"dataset": self.name, "source": self.dataset["source"], **provenance},
            )
        except DataError as error:
            raise DataError(f"{where}: {error}") from None

    def _declared(self, entries: Mapping[str, Any] | None, kind: type[Column] = Column) -> dict[str, Any]:
        """Channel -> its declaration, one at least; those that the option ``gappy`` names are `gappy`."""
        columns = columns_from_config(entries or {}, self.name, kind)
        if not columns:
            raise ConfigurationError(f"{self.where}: channels must map a channel to its column and unit")
        self.gappy = self._gappy_among(columns)
        return columns

    def _gappy_among(self, channels: Iterable[str]) -> frozenset[str]:
        """Channels that the option ``gappy`` names, which must be among the data set's."""
        gappy = frozenset(self.options.gappy or ())
        for name in sorted(gappy - set(channels)):
            raise ConfigurationError(f"{self.where}: gappy names '{name}', which is not one of its channels")
        return gappy
