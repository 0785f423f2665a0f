"""Drives simulated on the spot: a plant, a driver, manoeuvres, surfaces and sensors."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import Source

OPTIONS_OF_A_DRIVE = frozenset({"id", "count", "seed", "vehicle", "manoeuvre", "surface", "stability_control"})


@dataclass(frozen=True)
class Drive:
    """One simulated drive of a data set.

    Args:
        seed: of everything that is drawn.
        vehicle: its configuration.
        manoeuvre: its configuration.
        surface: name or configuration.
        stability_control: whether it is switched on.
    """

    seed: int
    vehicle: Mapping[str, Any]
    manoeuvre: Mapping[str, Any]
    surface: Any
    stability_control: bool


class SimulatedSource(Source):
    """Simulated drives, a recording each.

    Options: ``vehicle`` (from conf/vehicle) or ``vehicles`` (several, by name), ``drives`` (a list of id, manoeuvre and, if need be, count,
    seed, vehicle, surface, stability_control), ``seed``, ``rate_hz``, ``sensors``, ``surface``, ``stability_control``, ``vary`` and
    ``vary_sensors``.
    """

    keys = frozenset({"vehicles", "drives", "seed", "rate_hz", "sensors", "surface", "stability_control", "vary", "vary_sensors"})
    slow = True

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        from vehest.simulation.fleet import SensorVariation, variations_from_config
        from vehest.simulation.sensors import sensor_levels_from_config
        from vehest.simulation.surface import surface_from_config

        super().__init__(dataset)
        self.seed = _whole_number(dataset.get("seed", 0), f"data set '{self.name}': seed")
        rate = dataset.get("rate_hz", 100.0)
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not 1.0 <= rate <= 1000.0:
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
            for drive in self.drives.values():
                _manoeuvre_of(drive)
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

    def read(self, recording_id: str) -> Recording:
        """Simulate one drive."""
        from vehest.simulation.surface import surface_from_config

        if recording_id not in self.drives:
            raise MissingError(f"data set '{self.name}' has no drive '{recording_id}' (it has {', '.join(list(self.drives)[:12])}, …)")
        drive = self.drives[recording_id]
        return _simulator_of(drive.vehicle, self.variations, drive.seed)(
            id=recording_id,
            manoeuvre=_manoeuvre_of(drive),
            seed=drive.seed,
            rate_hz=self.rate_hz,
            sensors=self.sensor_variation.applied(self.sensors, drive.seed),
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
        entries = self.dataset.get("drives") or []
        if isinstance(entries, str) or not isinstance(entries, Sequence):
            raise ConfigurationError(f"data set '{self.name}': drives is a list of mappings with an id and a manoeuvre, not {entries!r}")
        for entry in entries:
            if not isinstance(entry, Mapping) or not {"id", "manoeuvre"} <= set(entry) or set(entry) - OPTIONS_OF_A_DRIVE:
                known = ", ".join(sorted(OPTIONS_OF_A_DRIVE - {"id", "manoeuvre"}))
                raise ConfigurationError(f"data set '{self.name}': a drive has an id, a manoeuvre and, if need be, {known}; not {entry}")
            where = f"data set '{self.name}': drive '{entry['id']}'"
            if not isinstance(entry["id"], str | int) or isinstance(entry["id"], bool) or not 0 < len(str(entry["id"])) <= 100:
                raise ConfigurationError(f"{where}: an id is a name of 1 to 100 characters")
            if not isinstance(entry["manoeuvre"], Mapping):
                raise ConfigurationError(f"{where}: manoeuvre is a mapping with a name, such as {{name: laps}}, not {entry['manoeuvre']}")
            for drive_id in _ids_of(entry, where):
                if drive_id in drives:
                    raise ConfigurationError(f"data set '{self.name}': two drives are called '{drive_id}', names must differ")
                drives[drive_id] = Drive(
                    seed=self._seed_of(entry, drive_id, where),
                    vehicle=self._vehicle_of(entry, where),
                    manoeuvre=dict(entry["manoeuvre"]),
                    surface=entry.get("surface", self.dataset.get("surface")),
                    stability_control=_switch(entry.get("stability_control", self.dataset.get("stability_control", False)), where),
                )
        return drives

    def _seed_of(self, entry: Mapping[str, Any], drive_id: str, where: str) -> int:
        """The drive's own seed, or one that follows from the data set's and the drive's name, whatever other drives there are."""
        if "seed" in entry:
            if "count" in entry:
                raise ConfigurationError(f"{where}: give seed for a single drive, or count, not both")
            return _whole_number(entry["seed"], f"{where}: seed")
        return int(np.random.SeedSequence([self.seed, zlib.crc32(drive_id.encode())]).generate_state(1)[0])

    def _vehicle_of(self, entry: Mapping[str, Any], where: str) -> Mapping[str, Any]:
        name = entry.get("vehicle", next(iter(self.vehicles)) if len(self.vehicles) == 1 else None)
        if not isinstance(name, str | int) or str(name) not in self.vehicles:
            raise ConfigurationError(f"{where}: vehicle '{name}' is not one of: {', '.join(self.vehicles)}")
        return self.vehicles[str(name)]


def _is_planar(vehicle: Mapping[str, Any]) -> bool:
    from vehest.simulation.planar_car import PLANAR

    return vehicle.get("plant") == PLANAR


def _simulator_of(vehicle: Mapping[str, Any], variations: Sequence[Any], seed: int) -> Callable[..., Recording]:
    """What simulates drives of a vehicle, varied as the seed of a drive draws it."""
    from vehest.simulation.drive import simulate_drive
    from vehest.simulation.fleet import varied, varied_planar
    from vehest.simulation.parameters import vehicle_from_configuration
    from vehest.simulation.planar_car import planar_car_from_configuration
    from vehest.simulation.planar_drive import simulate_planar_drive

    if _is_planar(vehicle):
        return partial(simulate_planar_drive, car=varied_planar(planar_car_from_configuration(vehicle), variations, seed))
    return partial(simulate_drive, vehicle=varied(vehicle_from_configuration(vehicle), variations, seed))


def _manoeuvre_of(drive: Drive) -> Any:
    """The manoeuvre, among those of the vehicle's plant."""
    from vehest.simulation.manoeuvres import manoeuvre_from_config, one_of
    from vehest.simulation.planar_drive import PLANAR_MANOEUVRES

    planar = _is_planar(drive.vehicle)
    if planar and drive.stability_control:
        raise ConfigurationError(f"vehicle '{drive.vehicle.get('name')}' has no stability control; leave stability_control out")
    return one_of(drive.manoeuvre, PLANAR_MANOEUVRES) if planar else manoeuvre_from_config(drive.manoeuvre)


def _ids_of(entry: Mapping[str, Any], where: str) -> list[str]:
    if "count" not in entry:
        return [str(entry["id"])]
    count = entry["count"]
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise ConfigurationError(f"{where}: count must be a whole number of drives, not {count}")
    return [f"{entry['id']}_{position:03d}" for position in range(1, count + 1)]


def _whole_number(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ConfigurationError(f"{where} must be a whole number, zero or positive, not {value}")
    return value


def _switch(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise ConfigurationError(f"{where}: stability_control must be true or false, not {value}")
    return value


SOURCE = SimulatedSource
