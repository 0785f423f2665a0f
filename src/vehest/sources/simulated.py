"""Drives simulated on the spot: a plant, a driver, manoeuvres, surfaces and sensors."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vehest.data.car import CarValues
from vehest.data.errors import ConfigurationError, MissingError, abbreviated
from vehest.data.limits import check_limit
from vehest.data.recording import Recording
from vehest.data.splits import check_name
from vehest.simulation.plant.planar_car import PLANAR, planar_car_from_configuration
from vehest.simulation.plant.wear import Stint
from vehest.sources.base import Source

# whole number, zero or positive
Natural = Annotated[int, Field(ge=0), "a whole number, zero or positive"]
# a surface's name or parameters
SurfaceFile = Annotated[
    str | dict[str, Any], "one of dry, wet, patchy, or a mapping such as {friction: 0.6}"
]


@dataclass(frozen=True)
class Payload:
    """A payload: a mass and its position from the centre of gravity."""

    mass: float  # mass [kg]
    forward: float = 0.0  # distance forward of the centre of gravity [m]
    up: float = 0.0  # distance above the centre of gravity [m]


@dataclass(frozen=True)
class Drive:
    """One of ``drives`` as a data set declares it, or ``count`` of them.

    For None the data set's own value holds.
    """

    id: str | int  # name of the drive
    # name of the manoeuvre and its parameters
    manoeuvre: Annotated[dict[str, Any], "a mapping with a name, such as {name: laps}"]
    # number of drives, called ID_001, ID_002 and so on
    count: Annotated[int, Field(ge=0), "a whole number of drives"] | None = None
    # seed of the drive; None: one that follows from the data set's and the drive's name
    seed: Natural | None = None
    # name of one of the vehicles
    vehicle: Annotated[str | int, "the name of one of the vehicles"] | None = None
    surface: SurfaceFile | None = None  # surface of the road
    stability_control: bool | None = None  # whether stability control acts
    # preset of the sensors, or what differs from one
    sensors: (
        Annotated[str | dict[str, Any], "a preset, or a mapping of what differs from one"] | None
    ) = None
    payload: Payload | None = None  # payload of the vehicle
    # loss of grip over the drive
    tyres: Annotated[Stint, "a mapping such as {cold: 0.06, wear: 0.04}"] | None = None


@dataclass(frozen=True)
class SimulatedOptions:
    """Options of the source; docs/sources/simulated.md describes them."""

    vehicles: dict[str, Any] | None = None  # name of a vehicle -> its configuration
    drives: tuple[Drive, ...] | None = None  # drives of the data set
    seed: Natural = 0  # seed from which the drives' own follow
    # rate of the recordings [Hz]
    rate_hz: Annotated[float, Field(ge=1.0, le=1000.0), "a number between 1 and 1000"] = 100.0
    sensors: str | dict[str, Any] | None = None  # preset of the sensors, or what differs from one
    surface: SurfaceFile | None = None  # surface of drives that name none
    stability_control: bool = False  # whether stability control acts
    # parameters of the vehicle that are scaled for every drive, and their ranges
    vary: Annotated[list[dict[str, Any]], "a list of {parameters, factor}"] | None = None
    vary_sensors: dict[str, Any] | None = None  # kind of a sensor's error -> range of its scale


class SimulatedSource(Source):
    """Simulated drives, a recording each."""

    options_type = SimulatedOptions
    options: SimulatedOptions
    slow = True

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        from vehest.simulation.fleet import SensorVariation, variations_from_config
        from vehest.simulation.sensors.config import sensor_levels_from_config

        super().__init__(dataset)
        options = self.options
        rate_hz = options.rate_hz
        self.vehicles = self._vehicles()
        self.drives = self._drives()
        try:
            self.variations = variations_from_config(options.vary or [])
            for vehicle in self.vehicles.values():
                _simulator_of(vehicle, self.variations, 0)
            self.sensors = sensor_levels_from_config(options.sensors)
            self.sensor_variation = SensorVariation.from_config(options.vary_sensors or {})
            for drive_id in self.drives:
                longest = self._simulation(drive_id, ()).keywords["manoeuvre"].longest
                fault = (
                    f"drive '{drive_id}' may last {longest:g} s, {longest * rate_hz:.6g} "
                    f"samples at {rate_hz:g} Hz"
                )
                check_limit("samples", longest * rate_hz, fault, ConfigurationError)
        except ConfigurationError as error:
            raise ConfigurationError(f"{self.location}: {error}") from None

    @property
    def car(self) -> CarValues:
        """Declared values, or those of the vehicles.

        None where drives differ by vehicle, payload or variation.
        """
        if self.declared_car is not None:
            return self.declared_car
        varied = {name for entry in self.options.vary or () for name in entry["parameters"]}
        first, *others = (_car_values(vehicle, varied) for vehicle in self.vehicles.values())
        common = {
            name: value if all(car[name] == value for car in others) else None
            for name, value in first.items()
        }
        if any(drive.payload for drive in self.drives.values()):
            common |= {"mass": None, "cg_to_rear_axle": None}
        return CarValues(**common)

    def inputs(self) -> dict[str, str | Path]:
        """The multi-body plant's library and its version, where a vehicle is driven by it.

        There are no files.
        """
        if all(vehicle.get("plant") == PLANAR for vehicle in self.vehicles.values()):
            return {}
        return {"commonroad-vehicle-models": metadata.version("commonroad-vehicle-models")}

    def ids(self) -> list[str]:
        """Names of the drives."""
        return list(self.drives)

    def read_raw(self, recording_id: str) -> Recording:
        """Simulate one drive, with the data set's variations of vehicle and sensors.

        The same drive, seed and options make the same recording, whatever other drives there are.

        Raises
        ------
        MissingError
            The data set has no drive of that name.
        """
        if recording_id not in self.drives:
            raise MissingError(
                f"{self.location} has no drive '{recording_id}' (it has "
                f"{abbreviated(list(self.drives), 12)})"
            )
        return self._simulation(recording_id, self.variations)()

    def seed_of(self, drive_id: str) -> int:
        """Seed of a drive: its own, or one that follows from the data set's and the drive's name,
        whatever other drives there are.
        """
        drive_seed = self.drives[drive_id].seed
        if drive_seed is not None:
            return drive_seed
        sequence = np.random.SeedSequence([self.options.seed, zlib.crc32(drive_id.encode())])
        return int(sequence.generate_state(1)[0])

    def _simulation(self, drive_id: str, variations: Sequence[Any]) -> partial[Recording]:
        """The call that simulates a drive; ``variations`` are those of the vehicle's parameters.

        Raises
        ------
        ConfigurationError
            The drive names an unknown vehicle, or its manoeuvre, sensors or surface is wrong.
        """
        from vehest.simulation.driving.manoeuvres import MANOEUVRES, manoeuvre_from_config
        from vehest.simulation.planar_drive import PLANAR_MANOEUVRES
        from vehest.simulation.road.surface import surface_from_config
        from vehest.simulation.sensors.config import sensor_levels_from_config

        drive = self.drives[drive_id]
        seed = self.seed_of(drive_id)
        name = (
            next(iter(self.vehicles))
            if drive.vehicle is None and len(self.vehicles) == 1
            else str(drive.vehicle)
        )
        if name not in self.vehicles:
            raise ConfigurationError(
                f"drive '{drive.id}': vehicle '{name}' is not one of: {', '.join(self.vehicles)}"
            )
        vehicle = self.vehicles[name]
        stability_control = (
            self.options.stability_control
            if drive.stability_control is None
            else drive.stability_control
        )
        sensors = (
            self.sensors if drive.sensors is None else sensor_levels_from_config(drive.sensors)
        )
        manoeuvres: Mapping[str, Any] = (
            PLANAR_MANOEUVRES if vehicle.get("plant") == PLANAR else MANOEUVRES
        )
        return partial(
            _simulator_of(vehicle, variations, seed, drive, stability_control),
            id=drive_id,
            manoeuvre=manoeuvre_from_config(drive.manoeuvre, manoeuvres),
            seed=seed,
            rate_hz=self.options.rate_hz,
            sensors=self.sensor_variation.applied(sensors, seed),
            surface=surface_from_config(
                self.options.surface if drive.surface is None else drive.surface
            ),
        )

    def _vehicles(self) -> dict[str, Mapping[str, Any]]:
        """Name -> configuration of each vehicle; the name is empty where it declares a single
        ``vehicle``.
        """
        vehicle = self.dataset.get("vehicle")
        several = self.options.vehicles
        if isinstance(vehicle, Mapping) and not several:
            return {"": vehicle}
        if (
            vehicle is None
            and several
            and all(isinstance(entry, Mapping) for entry in several.values())
        ):
            return several
        raise ConfigurationError(
            f"{self.location}: a simulated data set needs a vehicle from conf/vehicle, or "
            "vehicles, a mapping of several"
        )

    def _drives(self) -> dict[str, Drive]:
        """Name of each drive -> its declaration; an entry with ``count`` makes as many names."""
        drives: dict[str, Drive] = {}
        for entry in self.options.drives or ():
            location = f"{self.location}: drive '{entry.id}'"
            name = str(entry.id)
            if not 0 < len(name) <= 100:
                raise ConfigurationError(f"{location}: an id is a name of 1 to 100 characters")
            check_name(name, f"{location}: id")
            if entry.seed is not None and entry.count is not None:
                raise ConfigurationError(
                    f"{location}: give seed for a single drive, or count, not both"
                )
            n_drives = len(drives) + (entry.count or 0)
            check_limit(
                "jobs",
                n_drives,
                f"{location}: the data set would have {n_drives} drives",
                ConfigurationError,
            )
            drive_ids = [name]
            if entry.count is not None:
                drive_ids = [f"{name}_{number:03d}" for number in range(1, entry.count + 1)]
            if doubled := [drive_id for drive_id in drive_ids if drive_id in drives]:
                raise ConfigurationError(
                    f"{self.location}: two drives are called '{doubled[0]}', names must differ"
                )
            drives |= dict.fromkeys(drive_ids, entry)
        return drives


def _simulator_of(
    vehicle: Mapping[str, Any],
    variations: Sequence[Any],
    seed: int,
    drive: Drive | None = None,
    stability_control: bool = False,
) -> partial[Recording]:
    """The simulator of a vehicle, varied by the seed of a drive, with the drive's payload and tyres
    that age.
    """
    from vehest.simulation.drive import simulate_drive
    from vehest.simulation.fleet import varied, varied_planar
    from vehest.simulation.planar_drive import simulate_planar_drive
    from vehest.simulation.plant.parameters import loaded, vehicle_from_configuration

    payload, tyres = (drive.payload, drive.tyres) if drive else (None, None)
    if vehicle.get("plant") == PLANAR:
        if payload or tyres:
            raise ConfigurationError(
                f"vehicle '{vehicle.get('name')}': payload and tyres are of the multi-body plant "
                "only; leave them out"
            )
        if stability_control:
            raise ConfigurationError(
                f"vehicle '{vehicle.get('name')}' has no stability control; leave "
                "stability_control out"
            )
        car = varied_planar(planar_car_from_configuration(vehicle), variations, seed)
        return partial(simulate_planar_drive, car=car)
    parameters = varied(vehicle_from_configuration(vehicle), variations, seed)
    if payload:
        parameters = loaded(parameters, payload.mass, payload.forward, payload.up)
    return partial(
        simulate_drive, vehicle=parameters, stint=tyres, stability_control=stability_control
    )


def _car_values(vehicle: Mapping[str, Any], varied_parameters: Set[str]) -> dict[str, float | None]:
    """Wheelbase [m], mass [kg] and distance of the centre of gravity from the rear axle [m] of a
    vehicle; None where varied.
    """
    from vehest.simulation.plant.parameters import library_parameters, vehicle_from_configuration

    if vehicle.get("plant") == PLANAR:
        front, rear, mass = "cg_to_front_axle", "cg_to_rear_axle", "mass"
        parameters: Any = planar_car_from_configuration(vehicle)
    else:
        front, rear, mass = "a", "b", "m"
        parameters = library_parameters(vehicle_from_configuration(vehicle))
    lengths = [float(getattr(parameters, name)) for name in (front, rear)]
    return {
        "wheelbase": None if {front, rear} & varied_parameters else round(sum(lengths), 9),
        "mass": None if mass in varied_parameters else float(getattr(parameters, mass)),
        "cg_to_rear_axle": None if rear in varied_parameters else lengths[1],
    }


SOURCE = SimulatedSource
