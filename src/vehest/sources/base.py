"""The interface of every source, and how a source is found by its name."""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

import vehest.sources as package
from vehest.data.car import CarValues
from vehest.data.derived import ScaleToWheelbase
from vehest.data.errors import ConfigurationError, DataError, MissingError, suggestion
from vehest.data.files import regular_file
from vehest.data.recording import Kind, Recording
from vehest.data.schema import validated
from vehest.data.splits import check_name
from vehest.data.transforms import ReferenceLever, transform_from_config
from vehest.sources.clocks import require_clock

NO_TABLES = (".vbo", ".mf4", ".mdf", ".dat", ".bag", ".db3", ".mcap")
SPREADSHEETS = (".xlsx", ".xls", ".xlsm", ".ods")
DERIVED = "derived"  # key of a recording's provenance: transforms of its data set, and where its channels were measured
SIMULATED = "simulated"  # name of the source whose recordings are never real


def kind_of(dataset: Mapping[str, Any]) -> Kind:
    """The kind of a data set's recordings."""
    return "simulated" if SIMULATED in (dataset.get("source"), dataset.get("kind")) else "real"


@dataclass(frozen=True)
class Point:
    """Where something was measured, from the centre of gravity [m]: ``x`` ahead, ``y`` to the left."""

    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True)
class CommonOptions:
    """Options of every data set; see docs/data.md."""

    source: str
    name: str = "unnamed"
    title: str = ""
    kind: Kind = "real"
    vehicle: str | dict[str, Any] | None = None
    car: Annotated[CarValues, "a mapping of wheelbase, mass and others"] | None = None
    licence: str = ""
    citation: str = ""
    accept: Annotated[tuple[str, ...], "a list of checks"] | None = None
    download: (
        Annotated[dict[str, Any], "a mapping of url and, if need be, files and sha256"] | None
    ) = None
    transforms: Annotated[tuple[dict[str, Any], ...], "a list of transforms"] | None = None
    reference_point: (
        Annotated[Point | Literal["unknown"], "{x: …, y: …} in metres, or unknown"] | None
    ) = None
    imu_point: (
        Annotated[Point | Literal["unknown"], "{x: …, y: …} in metres, or unknown"] | None
    ) = None


COMMON_KEYS = frozenset(field.name for field in fields(CommonOptions))


def origin_in_words(recording: Recording) -> list[str]:
    """Where a recording's channels were measured and which were derived, by its data set, a line each."""
    declared = recording.provenance.get(DERIVED) or {}
    lines = []
    if point := declared.get("reference_point"):
        moved = ", moved to it" if declared.get("moved_to_centre_of_gravity") else ""
        lines.append(f"reference measured {_point_in_words(point)}{moved}")
    if point := declared.get("imu_point"):
        lines.append(f"inertial unit {_point_in_words(point)}")
    if transforms := declared.get("transforms"):
        lines.append(f"derived by {', '.join(str(entry.get('name')) for entry in transforms)}")
    if held := recording.provenance.get("held"):
        lines.append(
            f"{', '.join(held['channels'])} sampled at {held['rate_hz']:.4g} Hz, straight lines in between"
        )
    return lines


def _point_in_words(point: Any) -> str:
    if point == "unknown":
        return "at a point that is not known"
    x = float(point.get("x", 0.0))
    y = float(point.get("y", 0.0))
    parts = [f"{abs(x):g} m {'ahead of' if x > 0 else 'behind'}"] if x else []
    parts += [f"{abs(y):g} m to the {'left' if y > 0 else 'right'} of"] if y else []
    return f"{' and '.join(parts) or 'at'} the centre of gravity"


Options = TypeVar("Options")


def car_of(dataset: Mapping[str, Any]) -> CarValues:
    """The values of the car that the recordings of a data set show.

    Parameters
    ----------
    dataset : mapping
        Configuration of a data set. Its option ``car`` describes the car as it was recorded; a transform
        ``scale_to_wheelbase`` scales it. Without ``car`` a simulated data set has the values of its
        vehicle.

    Returns
    -------
    CarValues
        None for each value that is not known, or not the same in all recordings.

    Raises
    ------
    ConfigurationError
        A value is not positive, or the data set makes no sense.
    """
    return open_source(dataset).car_in_recordings


class Source(ABC):
    """Reads one data set.

    Attributes:
        options_type: dataclass of its own options, with their types and defaults.
        options: the options of this data set.
        version: raised when the recordings that it makes change.

    Raises `ConfigurationError`: an unknown or missing option, or a value of the wrong type.
    """

    options_type: ClassVar[type]
    options: Any
    version: ClassVar[str] = "1"
    slow: ClassVar[bool] = (
        False  # whether a recording takes so long that each is kept as soon as it is made
    )

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        self.dataset = dict(dataset)
        self.name = str(dataset.get("name", "unnamed"))
        self.where = f"data set '{self.name}'"
        check_name(self.name, "data set")
        keys = {field.name for field in fields(self.options_type)}
        if unknown := sorted(set(dataset) - COMMON_KEYS - keys):
            what = f"source '{dataset.get('source')}' has no option '{unknown[0]}'"
            what += suggestion(unknown[0], keys | COMMON_KEYS, "dataset.") or ";"
            what += f" it has {', '.join(sorted(keys))}"
            raise ConfigurationError(f"{self.where}: {what}")
        common = self._validated(CommonOptions)
        self.reference_point = common.reference_point
        self.declared_car = common.car
        try:
            self.transforms = [transform_from_config(entry) for entry in common.transforms or ()]
        except ConfigurationError as error:
            raise ConfigurationError(f"{self.where}: {error}") from None
        if isinstance(self.reference_point, Point) and any(
            isinstance(transform, ScaleToWheelbase) for transform in self.transforms
        ):
            what = "reference_point does not go with scale_to_wheelbase; put the transform reference_lever before it instead"
            raise ConfigurationError(f"{self.where}: {what}")
        if dataset.get("source") == SIMULATED and dataset.get("kind", SIMULATED) != SIMULATED:
            raise ConfigurationError(
                f"{self.where}: source '{SIMULATED}' makes simulated recordings; leave kind out"
            )
        self.options = self._validated(self.options_type)

    def _validated(self, kind: type[Options]) -> Options:
        names = {field.name for field in fields(cast(Any, kind))}
        own = {key: value for key, value in self.dataset.items() if key in names}
        return validated(kind, own, self.where, error=ConfigurationError, group="dataset")

    @property
    def car(self) -> CarValues:
        """Values of the car as it was recorded, before any transform."""
        return self.declared_car or CarValues()

    @cached_property
    def car_in_recordings(self) -> CarValues:
        """Values of the car that recordings show, after the transforms; see `car_of`."""
        car = self.car
        for transform in self.transforms:
            if isinstance(transform, ScaleToWheelbase):
                car = car.scaled(transform.to / transform.wheelbase)
        return car

    @abstractmethod
    def inputs(self) -> dict[str, str | Path]:
        """Inputs of the recordings: name -> file, or a version where there is no file.

        Raises `MissingError`: a file or folder is not there.
        """

    @abstractmethod
    def ids(self) -> list[str]:
        """Names of the recordings, in order."""

    def read(self, recording_id: str) -> Recording:
        """One recording, with the channels that the data set derives and its reference at the centre of gravity.

        Raises `MissingError`: there is none of that name, or a file is missing. Raises `DataError`: its files cannot be used.
        """
        return self._prepared(self.read_raw(recording_id))

    def read_file(self, file: Path) -> Recording:
        """A recording of a file, or of a bag's folder, wherever it is, as `read` makes it.

        Raises `ConfigurationError`: this source reads no single files. Raises `MissingError`: the file is not there. Raises `DataError`: it
        cannot be used.
        """
        return self._prepared(self.read_raw_file(file))

    def file_parts(self, file: Path) -> Iterator[Recording]:
        """`read_file` in parts that follow one another, so that hours need little memory; all at once where the source knows no better."""
        yield self.read_file(file)

    def _prepared(self, recording: Recording) -> Recording:
        """A recording with the data set's car, after its transforms and with its reference at the centre of gravity.

        One that has been through the transforms is not transformed again.
        """
        if len(recording) > 1:
            require_clock(
                recording.time,
                f"{self.where}, recording '{recording.id}'",
                "correct time or rate_hz",
            )
        recording = replace(recording, car=self.car_in_recordings)
        if DERIVED in recording.provenance:
            return recording
        for transform in self.transforms:
            recording = transform(recording)
        point = self.reference_point
        moved = False
        if isinstance(point, Point) and (point.x or point.y) and "vy_ref" in recording:
            recording = ReferenceLever(point.x, point.y)(recording)
            moved = True
        declared = {
            key: self.dataset[key]
            for key in ("transforms", "reference_point", "imu_point")
            if self.dataset.get(key)
        }
        if not declared:
            return recording
        return replace(
            recording,
            provenance={
                **recording.provenance,
                DERIVED: {**declared, "moved_to_centre_of_gravity": moved},
            },
        )

    @abstractmethod
    def read_raw(self, recording_id: str) -> Recording:
        """One recording of its files as they are; raises as `read` does."""

    def read_raw_file(self, file: Path) -> Recording:
        """A recording of a file as it is; raises as `read_file` does."""
        raise ConfigurationError(
            f"{self.where}: source '{self.dataset.get('source')}' reads no single files"
        )

    def file_names(self) -> list[str]:
        """Files that the configuration alone names, which ``download`` fetches if it lists none."""
        return []

    def recordings(self) -> Iterator[Recording]:
        """All recordings, one after another."""
        for recording_id in self.ids():
            yield self.read(recording_id)


def open_source(dataset: Mapping[str, Any]) -> Source:
    """The source that a data set's configuration names; raises `ConfigurationError` for an unknown source or option."""
    return source_class(dataset)(dataset)


def read_single(dataset: Mapping[str, Any], file: Path) -> Recording:
    """A recording of a file wherever it is, read as a data set describes.

    Raises `ConfigurationError`: the file is of another format than the data set's, or its source reads no single files. Raises
    `MissingError`: it is not there. Raises `DataError`: it cannot be used as it is.
    """
    return source_of_file(dataset, file).read_file(file)


def source_of_file(dataset: Mapping[str, Any], file: Path) -> Source:
    """The source of a data set that a file wherever it is shall be read by; raises as `read_single` does."""
    require_no_spreadsheet(file)
    if dataset.get("source") == "tabular" and file.suffix.lower() in NO_TABLES:
        what = f"describe its signals once by 'vehest new NAME {file.name}', then add dataset=NAME"
        raise ConfigurationError(f"'{file}' is no table; {what}")
    return open_source(dataset)


def require_no_spreadsheet(file: Path) -> None:
    """Raises `DataError` for a spreadsheet's file, which no source reads."""
    if file.suffix.lower() in SPREADSHEETS:
        raise DataError(f"'{file}' is a spreadsheet; save it as CSV")


def source_class(dataset: Mapping[str, Any]) -> type[Source]:
    """The class of a data set's source: ``SOURCE`` of the module ``vehest.sources.NAME``; raises `ConfigurationError` without one."""
    name = str(dataset.get("source"))
    found: type[Source] | None = _source_of(name) if name in _modules() else None
    if found is None:
        raise ConfigurationError(
            f"data set '{dataset.get('name')}': source '{name}' is not one of: {', '.join(source_names())}"
        )
    return found


@cache
def source_names() -> list[str]:
    """Names of all sources."""
    return sorted(name for name in _modules() if _source_of(name) is not None)


def _modules() -> list[str]:
    return [module.name for module in pkgutil.iter_modules(package.__path__)]


def _source_of(module: str) -> type[Source] | None:
    return getattr(importlib.import_module(f"{package.__name__}.{module}"), "SOURCE", None)


def existing_folder(path: Any, dataset: str) -> Path:
    """A folder of raw data; raises `MissingError` where no root was given, or the folder is not there."""
    folder = Path(str(path)).expanduser()
    has_root = bool(path) and folder.parts[:1] not in {("None",), ("null",)}
    if not (has_root and folder.is_dir()):
        what = f"there is no folder '{folder}'" if has_root else "no data root is set"
        raise MissingError(f"data set '{dataset}': {what}; give root=FOLDER or set VEHEST_DATA")
    return folder


def require_files(files: Sequence[Path], dataset: str) -> None:
    """Refuse files that are missing or empty (`MissingError`), and pipes, devices and folders (`DataError`)."""
    for file in files:
        try:
            size = regular_file(file).stat().st_size
        except MissingError as error:
            raise MissingError(f"data set '{dataset}': {error}") from None
        if size == 0:
            raise MissingError(f"data set '{dataset}': file '{file}' is empty")
