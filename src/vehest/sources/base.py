"""The interface of every source, and how a source is found by its name.

data set (a mapping from conf/dataset) -> `open_source` -> `Source.read_raw`, of the files as they
are -> transforms, reference moved to the centre of gravity -> `Recording`
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

import vehest.sources as package
from vehest.data.car import CarValues
from vehest.data.derived import ScaleToWheelbase
from vehest.data.errors import ConfigurationError, DataError, MissingError, printable, suggestion
from vehest.data.files import regular_file
from vehest.data.recording import DERIVED, Kind, Recording
from vehest.data.schema import validated
from vehest.data.splits import check_name
from vehest.data.text_files import first_line
from vehest.data.transforms import ReferenceLever, transform_from_config
from vehest.sources.clocks import require_clock

ENTRY_POINTS = "vehest.sources"  # group of the entry points by which other packages offer sources
# endings of files that are no tables
NO_TABLES = (".vbo", ".mf4", ".mdf", ".dat", ".bag", ".db3", ".mcap")
SPREADSHEETS = (".xlsx", ".xls", ".xlsm", ".ods")  # endings of files of spreadsheets
SIMULATED = "simulated"  # name of the source whose recordings are never real


def kind_of(dataset: Mapping[str, Any]) -> Kind:
    """The kind of a data set's recordings.

    They are simulated where its source is ``simulated`` or it declares that kind, and real
    otherwise.
    """
    return "simulated" if SIMULATED in (dataset.get("source"), dataset.get("kind")) else "real"


@dataclass(frozen=True)
class Point:
    """Position where something was measured, from the centre of gravity."""

    x: float = 0.0  # distance ahead of it [m]
    y: float = 0.0  # distance to the left of it [m]


# a point, or ``unknown``
Place = Annotated[Point | Literal["unknown"], "{x: …, y: …} in metres, or unknown"]


@dataclass(frozen=True)
class CommonOptions:
    """Options of every data set; see docs/data.md."""

    source: str  # name of the source that reads the data set
    name: str = "unnamed"  # name of the data set
    title: str = ""  # title for people
    kind: Kind = "real"  # whether recordings are real or simulated
    # name of the vehicle, or its configuration for a simulation
    vehicle: str | dict[str, Any] | None = None
    # values of the car as it was recorded
    car: Annotated[CarValues, "a mapping of wheelbase, mass and others"] | None = None
    licence: str = ""  # licence of the data
    citation: str = ""  # work to cite for the data
    # names of checks whose findings are accepted
    accept: Annotated[tuple[str, ...], "a list of checks"] | None = None
    # address, files and checksums of a download
    download: (
        Annotated[dict[str, Any], "a mapping of url and, if need be, files and sha256"] | None
    ) = None
    # transforms that are applied to each recording, in order
    transforms: Annotated[tuple[dict[str, Any], ...], "a list of transforms"] | None = None
    reference_point: Place | None = None  # position at which the reference was measured
    imu_point: Place | None = None  # position of the inertial unit


# names of the options of every data set
COMMON_KEYS = frozenset(field.name for field in fields(CommonOptions))


def origin_in_words(recording: Recording) -> list[str]:
    """Lines of text on where a recording's channels were measured and which were derived, by its
    data set.

    Returns
    -------
    list of str
        A line each of: where the reference was measured, and whether it was moved; where the
        inertial unit is; the transforms; the channels that were held. Empty where the data set
        declares none of them.
    """
    declared = recording.provenance.get(DERIVED) or {}
    lines = []
    if point := declared.get("reference_point"):
        moved = ", moved to it" if declared.get("moved_to_centre_of_gravity") else ""
        lines.append(f"reference measured {_point_in_words(point)}{moved}")
    if point := declared.get("imu_point"):
        lines.append(f"inertial unit {_point_in_words(point)}")
    if transforms := declared.get("transforms"):
        lines.append(f"derived by {', '.join(str(entry.get('name')) for entry in transforms)}")
    if sampled := recording.provenance.get("held"):
        lines.append(
            f"{', '.join(sampled['channels'])} sampled at {sampled['rate_hz']:.4g} Hz, straight "
            "lines in between"
        )
    return lines


def _point_in_words(point: Any) -> str:
    """Text of a declared point, ``{x: …, y: …}`` [m] or ``unknown``, as seen from the centre of
    gravity.
    """
    if point == "unknown":
        return "at a point that is not known"
    x = float(point.get("x", 0.0))
    y = float(point.get("y", 0.0))
    parts = [f"{abs(x):g} m {'ahead of' if x > 0 else 'behind'}"] if x else []
    parts += [f"{abs(y):g} m to the {'left' if y > 0 else 'right'} of"] if y else []
    return f"{' and '.join(parts) or 'at'} the centre of gravity"


Options = TypeVar("Options")  # dataclass of options


def car_of(dataset: Mapping[str, Any]) -> CarValues:
    """The values of the car that the recordings of a data set show.

    Parameters
    ----------
    dataset : mapping
        Configuration of a data set. Its option ``car`` describes the car as it was recorded; a
        transform ``scale_to_wheelbase`` scales it. Without ``car`` a simulated data set has the
        values of its vehicle.

    Returns
    -------
    CarValues
        None for each value that is not known, or not the same in all recordings.

    Raises
    ------
    ConfigurationError
        A value is not positive, or the data set makes no sense.
    """
    return open_source(dataset).car_after_transforms


class Source(ABC):
    """Reads one data set.

    Parameters
    ----------
    dataset : mapping
        Its configuration: the keys of `CommonOptions` and those of ``options_type``.

    Attributes
    ----------
    options_type : type
        Dataclass of the source's own options, with their types and defaults.
    options : object
        The options of this data set, an instance of ``options_type``.
    version : str
        Raised when the recordings that it makes change.
    transforms : list
        Transforms that the data set declares, in the order in which they are applied.

    Raises
    ------
    ConfigurationError
        An unknown or missing option, a value of the wrong type, a reference point together with a
        transform that scales the car, or a simulated source that is declared real.
    """

    options_type: ClassVar[type]
    options: Any
    version: ClassVar[str] = "1"
    # whether a recording takes so long that each is kept as soon as it is made
    slow: ClassVar[bool] = False

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        self.dataset = dict(dataset)
        self.name = str(dataset.get("name", "unnamed"))
        self.location = f"data set '{self.name}'"
        check_name(self.name, "data set")
        keys = {field.name for field in fields(self.options_type)}
        if unknown := sorted(set(dataset) - COMMON_KEYS - keys):
            problem = f"source '{dataset.get('source')}' has no option '{unknown[0]}'"
            problem += suggestion(unknown[0], keys | COMMON_KEYS, "dataset.") or ";"
            problem += f" it has {', '.join(sorted(keys))}"
            raise ConfigurationError(f"{self.location}: {problem}")
        common = self._validated(CommonOptions)
        self.reference_point = common.reference_point
        self.declared_car = common.car
        try:
            self.transforms = [transform_from_config(entry) for entry in common.transforms or ()]
        except ConfigurationError as error:
            raise ConfigurationError(f"{self.location}: {error}") from None
        if isinstance(self.reference_point, Point) and any(
            isinstance(transform, ScaleToWheelbase) for transform in self.transforms
        ):
            raise ConfigurationError(
                f"{self.location}: reference_point does not go with scale_to_wheelbase; put the "
                "transform reference_lever before it instead"
            )
        if dataset.get("source") == SIMULATED and dataset.get("kind", SIMULATED) != SIMULATED:
            raise ConfigurationError(
                f"{self.location}: source '{SIMULATED}' makes simulated recordings; leave kind out"
            )
        self.options = self._validated(self.options_type)

    def _validated(self, kind: type[Options]) -> Options:
        """The data set's values of the fields of ``kind``; keys that it lacks take their
        defaults.
        """
        names = {field.name for field in fields(cast(Any, kind))}
        options = {key: value for key, value in self.dataset.items() if key in names}
        return validated(kind, options, self.location, error=ConfigurationError, group="dataset")

    @property
    def car(self) -> CarValues:
        """Values of the car as it was recorded, before any transform."""
        return self.declared_car or CarValues()

    @cached_property
    def car_after_transforms(self) -> CarValues:
        """Configured values of the car, scaled as the transforms scale it; see `car_of`."""
        car = self.car
        for transform in self.transforms:
            if isinstance(transform, ScaleToWheelbase):
                car = car.scaled(transform.to / transform.wheelbase)
        return car

    @abstractmethod
    def inputs(self) -> dict[str, str | Path]:
        """Inputs of the recordings.

        Returns
        -------
        dict
            Name -> file, or a version where there is no file; a cached recording is made again when
            one of them changes.

        Raises
        ------
        MissingError
            A file or folder is not there.
        """

    @abstractmethod
    def ids(self) -> list[str]:
        """Names of the recordings, in order."""

    def read(self, recording_id: str) -> Recording:
        """One recording, with the channels that the data set derives and its reference at the
        centre of gravity.

        Parameters
        ----------
        recording_id : str
            One of `ids`.

        Raises
        ------
        MissingError
            There is none of that name, or a file is missing.
        DataError
            Its files cannot be used, or its times are no clock.
        """
        return self._prepared(self.read_raw(recording_id))

    def read_file(self, file: Path) -> Recording:
        """A recording of a file, or of a bag's folder, wherever it is, as `read` makes it.

        Raises
        ------
        ConfigurationError
            This source reads no single files.
        MissingError
            The file is not there.
        DataError
            It cannot be used.
        """
        return self._prepared(self.read_raw_file(file))

    def file_parts(self, file: Path) -> Iterator[Recording]:
        """`read_file` in parts that follow one another, so that hours need little memory.

        All at once where the source knows no better; then there is one part. Raises as `read_file`
        does, when a part is asked for.
        """
        yield self.read_file(file)

    def _prepared(self, recording: Recording) -> Recording:
        """A recording with the data set's car, after its transforms and with its reference at the
        centre of gravity.

        One that has been through the transforms is not transformed again.
        """
        if len(recording) > 1:
            require_clock(
                recording.time,
                f"{self.location}, recording '{recording.id}'",
                "correct time or rate_hz",
            )
        recording = replace(recording, car=self.car_after_transforms)
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
            f"{self.location}: source '{self.dataset.get('source')}' reads no single files"
        )

    def file_names(self) -> list[str]:
        """Files that the configuration alone names; ``download`` without ``files`` fetches them."""
        return []

    def recordings(self) -> Iterator[Recording]:
        """Recordings of the data set, one after another."""
        for recording_id in self.ids():
            yield self.read(recording_id)


def open_source(dataset: Mapping[str, Any]) -> Source:
    """The source that a data set's configuration names, made with its options.

    No file is opened: that happens when a recording is read.

    Raises
    ------
    ConfigurationError
        The source, or one of its options, is unknown or wrong.
    """
    return source_class(dataset)(dataset)


def read_single(dataset: Mapping[str, Any], file: Path) -> Recording:
    """A recording of a file wherever it is, read as a data set describes.

    Parameters
    ----------
    dataset : mapping
        Configuration of the data set whose options hold for the file; its own files are not looked
        at.
    file : Path
        The file, or a bag's folder.

    Raises
    ------
    ConfigurationError
        The file is of another format than the data set's, or its source reads no single files.
    MissingError
        It is not there.
    DataError
        It cannot be used as it is.
    """
    return source_of_file(dataset, file).read_file(file)


def source_of_file(dataset: Mapping[str, Any], file: Path) -> Source:
    """The source of a data set that a file wherever it is shall be read by.

    Raises
    ------
    ConfigurationError
        The data set reads tables and the file is, by its ending, a log of another format, or the
        data set is wrong.
    DataError
        The file is a spreadsheet.
    """
    require_no_spreadsheet(file)
    if dataset.get("source") == "tabular" and file.suffix.lower() in NO_TABLES:
        raise ConfigurationError(
            f"'{file}' is no table; describe its signals once by 'vehest new NAME {file.name}', "
            "then add dataset=NAME"
        )
    return open_source(dataset)


def require_no_spreadsheet(file: Path) -> None:
    """Raises `DataError` for a spreadsheet's file, by its ending, which no source reads."""
    if file.suffix.lower() in SPREADSHEETS:
        raise DataError(f"'{file}' is a spreadsheet; save it as CSV")


def source_class(dataset: Mapping[str, Any]) -> type[Source]:
    """The class of a data set's source.

    It is ``SOURCE`` of the module ``vehest.sources.NAME``, or what another package offers by an
    entry point NAME in the group ``vehest.sources``.

    Raises
    ------
    ConfigurationError
        There is no such source, or that of another package cannot be loaded.
    """
    name = str(dataset.get("source"))
    location = f"data set '{dataset.get('name')}': source '{name}'"
    if name in _modules() and (module_class := _class_of(name)):
        return module_class
    for point in entry_points(group=ENTRY_POINTS, name=name):
        try:
            loaded = point.load()
        except Exception as error:  # a package may raise anything when it is imported
            raise ConfigurationError(
                f"{location} of another package cannot be loaded ({type(error).__name__}: "
                f"{printable(first_line(error))}); repair or remove it"
            ) from error
        if not (isinstance(loaded, type) and issubclass(loaded, Source)):
            raise ConfigurationError(
                f"{location} of another package is no class derived from Source"
            )
        return loaded
    raise ConfigurationError(f"{location} is not one of: {', '.join(source_names())}")


@cache
def source_names() -> list[str]:
    """Names of all sources: vehest's own, then those of other packages."""
    names = sorted(name for name in _modules() if _class_of(name))
    plugin_names = {point.name for point in entry_points(group=ENTRY_POINTS)}
    return [*names, *sorted(plugin_names.difference(names))]


def _modules() -> list[str]:
    """Names of the modules and packages in ``vehest.sources``, whether they are sources or not."""
    return [module.name for module in pkgutil.iter_modules(package.__path__)]


def _class_of(module: str) -> type[Source] | None:
    """``SOURCE`` of a module of ``vehest.sources``, which is imported for it; None of one
    without.
    """
    return getattr(importlib.import_module(f"{package.__name__}.{module}"), "SOURCE", None)


def existing_folder(path: Any, dataset: str) -> Path:
    """A folder of raw data, ``~`` expanded.

    Parameters
    ----------
    path : object
        The option ``path`` of a data set; empty, or beginning with ``None`` or ``null`` where its
        root is not set.
    dataset : str
        Name of the data set, for messages.

    Raises
    ------
    MissingError
        No root was given, or the folder is not there.
    """
    folder = Path(str(path)).expanduser()
    has_root = bool(path) and folder.parts[:1] not in {("None",), ("null",)}
    if not (has_root and folder.is_dir()):
        problem = f"there is no folder '{folder}'" if has_root else "no data root is set"
        raise MissingError(f"data set '{dataset}': {problem}; give root=FOLDER or set VEHEST_DATA")
    return folder


def require_files(files: Sequence[Path], dataset: str) -> None:
    """Refuse files that cannot be read as recordings.

    Parameters
    ----------
    files : sequence of Path
        Looked at in order; the first that is refused is named.
    dataset : str
        Name of the data set, for messages.

    Raises
    ------
    MissingError
        One is missing or empty.
    DataError
        One is a pipe, a device or a folder.
    """
    for file in files:
        try:
            size = regular_file(file).stat().st_size
        except MissingError as error:
            raise MissingError(f"data set '{dataset}': {error}") from None
        if size == 0:
            raise MissingError(f"data set '{dataset}': file '{file}' is empty")
