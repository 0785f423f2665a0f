"""Drives simulated on the spot: a plant, a driver, manoeuvres, surfaces and sensors."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.limits import check_limit
from vehest.data.recording import Recording
from vehest.data.schema import validated
from vehest.data.splits import check_name
from vehest.sources.base import Source


@dataclass(frozen=True)
class Drive:
    """One simulated drive of a data set.

    Args:
        seed: of everything that is drawn.
        vehicle: its configuration.
        manoeuvre: its configuration.
        surface: name or configuration.
        stability_control: whether it is switched on.
        sensors: levels of its sensors, or a preset's name; none: the data set's.
        payload: mass [kg] and its place forward and up of the centre of gravity [m]; none: empty.
        tyres: what they lose over the drive; none: nothing.
    """

    seed: int
    vehicle: Mapping[str, Any]
    manoeuvre: Mapping[str, Any]
    surface: Any
    stability_control: bool
    sensors: Any = None
    payload: Mapping[str, float] | None = None
    tyres: Mapping[str, float] | None = None


Seed = Annotated[int, "a whole number, zero or positive"]
SurfaceFile = Annotated[str | dict[str, Any], "one of dry, wet, patchy, or a mapping such as {friction: 0.6}"]


@dataclass(frozen=True)
class DriveFile:
    """One of ``drives`` as a data set names it, or ``count`` of them; what is None is the data set's own."""

    id: str | int
    manoeuvre: Annotated[dict[str, Any], "a mapping with a name, such as {name: laps}"]
    count: Annotated[int, "a whole number of drives"] | None = None
    seed: Seed | None = None
    vehicle: Annotated[str | int, "the name of one of the vehicles"] | None = None
    surface: SurfaceFile | None = None
    stability_control: bool | None = None
    sensors: Annotated[str | dict[str, Any], "a preset, or a mapping of what differs from one"] | None = None
    payload: Annotated[dict[str, float], "a mapping such as {mass: 60, forward: -0.4, up: 0.1}"] | None = None
    tyres: Annotated[dict[str, float], "a mapping such as {cold: 0.06, wear: 0.04}"] | None = None


@dataclass(frozen=True)
class SimulatedOptions:
    """Options of the source, by type; what is None is not said."""

    vehicles: dict[str, Any] | None = None
    drives: tuple[DriveFile, ...] | None = None
    seed: Seed = 0
    rate_hz: Annotated[float, "a number between 1 and 1000"] = 100.0
    sensors: str | dict[str, Any] | None = None
    surface: SurfaceFile | None = None
    stability_control: bool = False
    vary: Annotated[list[dict[str, Any]], "a list of {parameters, factor}"] | None = None
    vary_sensors: dict[str, Any] | None = None


class SimulatedSource(Source):
    """Simulated drives, a recording each.

    Options: ``vehicle`` (from conf/vehicle) or ``vehicles`` (several, by name), ``drives`` (a list of id, manoeuvre and, if need be, count,
    seed, vehicle, surface, stability_control, sensors, payload, tyres), ``seed``, ``rate_hz``, ``sensors``, ``surface``,
    ``stability_control``, ``vary`` and
    ``vary_sensors``.
    """

    options_type = SimulatedOptions
    keys = frozenset({"vehicles", "drives", "seed", "rate_hz", "sensors", "surface", "stability_control", "vary", "vary_sensors"})
    slow = True

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        from vehest.simulation.fleet import SensorVariation, variations_from_config
        from vehest.simulation.road.surface import surface_from_config
        from vehest.simulation.sensors.recording import sensor_levels_from_config

        super().__init__(dataset)
        self.seed = _whole_number(dataset.get("seed", 0), f"data set '{self.name}': seed")
        rate = dataset.get("rate_hz", 100.0)
        if not 1.0 <= rate <= 1000.0:
            raise ConfigurationError(f"data set '{self.name}': rate_hz must be a number between 1 and 1000, not {rate!r}")
        self.rate_hz = float(rate)
        self.vehicles = self._vehicles()
        self.drives = self._drives()
        try:
            self.variations = variations_from_config(dataset.get("vary") or [])
            for vehicle in self.vehicles.values():
                _simulator_of(vehicle, self.variations, 0)
            self.sensors = sensor_levels_from_config(dataset.get("sensors"))
            self.sensor_variation = SensorVariation.from_config(dataset.get("vary_sensors") or {})
            for drive_id, drive in self.drives.items():
                sensor_levels_from_config(drive.sensors)
                _simulator_of(drive.vehicle, (), drive.seed, drive.payload, drive.tyres)
                longest = _manoeuvre_of(drive).longest
                n_samples = longest * self.rate_hz
                what = f"drive '{drive_id}' may last {longest:g} s, {n_samples:.6g} samples at {self.rate_hz:g} Hz"
                check_limit("samples", n_samples, what, ConfigurationError)
                surface_from_config(drive.surface)
        except ConfigurationError as error:
            raise ConfigurationError(f"data set '{self.name}': {error}") from None

    def inputs(self) -> dict[str, str | Path]:
        """The multi-body plant's library and its version, where a vehicle is driven by it; there are no files."""
        if all(_is_planar(vehicle) for vehicle in self.vehicles.values()):
            return {}
        return {"commonroad-vehicle-models": metadata.version("commonroad-vehicle-models")}

    def ids(self) -> list[str]:
        """Names of the drives."""
        return list(self.drives)

    def read_raw(self, recording_id: str) -> Recording:
        """Simulate one drive."""
        from vehest.simulation.road.surface import surface_from_config
        from vehest.simulation.sensors.recording import sensor_levels_from_config

        if recording_id not in self.drives:
            raise MissingError(f"data set '{self.name}' has no drive '{recording_id}' (it has {', '.join(list(self.drives)[:12])}, …)")
        drive = self.drives[recording_id]
        own = self.sensors if drive.sensors is None else sensor_levels_from_config(drive.sensors)
        return _simulator_of(drive.vehicle, self.variations, drive.seed, drive.payload, drive.tyres)(
            id=recording_id,
            manoeuvre=_manoeuvre_of(drive),
            seed=drive.seed,
            rate_hz=self.rate_hz,
            sensors=self.sensor_variation.applied(own, drive.seed),
            stability_control=drive.stability_control,
            surface=surface_from_config(drive.surface),
        )

    def _vehicles(self) -> dict[str, Mapping[str, Any]]:
        one, several = self.dataset.get("vehicle"), self.dataset.get("vehicles")
        if isinstance(one, Mapping) and not several:
            return {"": one}
        if one is None and isinstance(several, Mapping) and several and all(isinstance(entry, Mapping) for entry in several.values()):
            return {str(name): entry for name, entry in several.items()}
        raise ConfigurationError(
            f"data set '{self.name}': a simulated data set needs a vehicle from conf/vehicle, or vehicles, a mapping of several"
        )

    def _drives(self) -> dict[str, Drive]:
        drives: dict[str, Drive] = {}
        options = validated(
            SimulatedOptions,
            {key: value for key, value in self.dataset.items() if key in self.keys},
            f"data set '{self.name}'",
            error=ConfigurationError,
            group="dataset",
        )
        for entry in options.drives or ():
            where = f"data set '{self.name}': drive '{entry.id}'"
            if not 0 < len(str(entry.id)) <= 100:
                raise ConfigurationError(f"{where}: an id is a name of 1 to 100 characters")
            check_name(str(entry.id), f"{where}: id")
            for drive_id in _ids_of(entry, where, len(drives)):
                if drive_id in drives:
                    raise ConfigurationError(f"data set '{self.name}': two drives are called '{drive_id}', names must differ")
                drives[drive_id] = Drive(
                    seed=self._seed_of(entry, drive_id, where),
                    vehicle=self._vehicle_of(entry, where),
                    manoeuvre=entry.manoeuvre,
                    surface=options.surface if entry.surface is None else entry.surface,
                    stability_control=options.stability_control if entry.stability_control is None else entry.stability_control,
                    sensors=entry.sensors,
                    payload=entry.payload,
                    tyres=entry.tyres,
                )
        return drives

    def _seed_of(self, entry: DriveFile, drive_id: str, where: str) -> int:
        """The drive's own seed, or one that follows from the data set's and the drive's name, whatever other drives there are."""
        if entry.seed is not None:
            if entry.count is not None:
                raise ConfigurationError(f"{where}: give seed for a single drive, or count, not both")
            return _whole_number(entry.seed, f"{where}: seed")
        return int(np.random.SeedSequence([self.seed, zlib.crc32(drive_id.encode())]).generate_state(1)[0])

    def _vehicle_of(self, entry: DriveFile, where: str) -> Mapping[str, Any]:
        name = entry.vehicle
        if name is None and len(self.vehicles) == 1:
            name = next(iter(self.vehicles))
        if name is None or str(name) not in self.vehicles:
            raise ConfigurationError(f"{where}: vehicle '{name}' is not one of: {', '.join(self.vehicles)}")
        return self.vehicles[str(name)]


def _is_planar(vehicle: Mapping[str, Any]) -> bool:
    from vehest.simulation.plant.planar_car import PLANAR

    return vehicle.get("plant") == PLANAR


def _simulator_of(
    vehicle: Mapping[str, Any],
    variations: Sequence[Any],
    seed: int,
    payload: Mapping[str, float] | None = None,
    tyres: Mapping[str, float] | None = None,
) -> Callable[..., Recording]:
    """What simulates drives of a vehicle, varied as the seed of a drive draws it, with a payload and with tyres that age."""
    from vehest.simulation.drive import simulate_drive
    from vehest.simulation.fleet import varied, varied_planar
    from vehest.simulation.planar_drive import simulate_planar_drive
    from vehest.simulation.plant.parameters import loaded, vehicle_from_configuration
    from vehest.simulation.plant.planar_car import planar_car_from_configuration
    from vehest.simulation.plant.wear import stint_from_config

    if _is_planar(vehicle):
        if payload or tyres:
            raise ConfigurationError(f"vehicle '{vehicle.get('name')}': payload and tyres are of the multi-body plant only; leave them out")
        return partial(simulate_planar_drive, car=varied_planar(planar_car_from_configuration(vehicle), variations, seed))
    own = varied(vehicle_from_configuration(vehicle), variations, seed)
    if payload:
        unknown = set(payload) - {"mass", "forward", "up"}
        if unknown or "mass" not in payload:
            raise ConfigurationError(f"payload is a mapping {{mass, forward, up}}, not {dict(payload)}")
        own = loaded(own, **payload)
    stint = stint_from_config(tyres) if tyres else None
    return partial(simulate_drive, vehicle=own, stint=stint)


def _manoeuvre_of(drive: Drive) -> Any:
    """The manoeuvre, among those of the vehicle's plant."""
    from vehest.simulation.driving.manoeuvres import manoeuvre_from_config, one_of
    from vehest.simulation.planar_drive import PLANAR_MANOEUVRES

    planar = _is_planar(drive.vehicle)
    if planar and drive.stability_control:
        raise ConfigurationError(f"vehicle '{drive.vehicle.get('name')}' has no stability control; leave stability_control out")
    return one_of(drive.manoeuvre, PLANAR_MANOEUVRES) if planar else manoeuvre_from_config(drive.manoeuvre)


def _ids_of(entry: DriveFile, where: str, n_before: int) -> list[str]:
    if entry.count is None:
        return [str(entry.id)]
    if entry.count < 0:
        raise ConfigurationError(f"{where}: count must be a whole number of drives, not {entry.count}")
    n_drives = n_before + entry.count
    check_limit("jobs", n_drives, f"{where}: the data set would have {n_drives} drives", ConfigurationError)
    return [f"{entry.id}_{position:03d}" for position in range(1, entry.count + 1)]


def _whole_number(value: int, where: str) -> int:
    if value < 0:
        raise ConfigurationError(f"{where} must be a whole number, zero or positive, not {value}")
    return value


SOURCE = SimulatedSource
