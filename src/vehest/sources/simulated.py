"""Drives simulated on the spot: CommonRoad's multi-body plant, a driver, a course and sensors."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import Source


class SimulatedSource(Source):
    """Simulated drives, a recording each.

    Options: ``vehicle`` (from conf/vehicle), ``course``, ``rate_hz``, ``drives`` (a list of id, seed and duration) and ``sensors``
    (``default`` or ``ideal``).
    """

    keys = frozenset({"course", "rate_hz", "drives", "sensors"})

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self.drives: dict[str, Mapping[str, Any]] = {}
        for drive in dataset.get("drives") or []:
            if not isinstance(drive, Mapping) or set(drive) != {"id", "seed", "duration"}:
                raise ConfigurationError(f"data set '{self.name}': a drive has an id, a seed and a duration, not {drive}")
            if not isinstance(drive["seed"], int) or not isinstance(drive["duration"], int | float) or drive["duration"] <= 0:
                raise ConfigurationError(
                    f"data set '{self.name}': drive '{drive['id']}' needs a whole number as seed and a positive duration [s], "
                    f"not {drive['seed']} and {drive['duration']}"
                )
            if str(drive["id"]) in self.drives:
                raise ConfigurationError(f"data set '{self.name}': two drives are called '{drive['id']}', names must differ")
            self.drives[str(drive["id"])] = drive
        if "vehicle" not in dataset:
            raise ConfigurationError(f"data set '{self.name}': a simulated data set needs a vehicle from conf/vehicle")
        if dataset.get("sensors", "default") not in ("default", "ideal"):
            raise ConfigurationError(f"data set '{self.name}': sensors '{dataset['sensors']}' is not one of: default, ideal")

    def inputs(self) -> dict[str, str | Path]:
        """The plant's library and its version; there are no files."""
        return {"commonroad-vehicle-models": metadata.version("commonroad-vehicle-models")}

    def ids(self) -> list[str]:
        """Names of the drives."""
        return list(self.drives)

    def read(self, recording_id: str) -> Recording:
        """Simulate one drive."""
        from vehest.simulation.course import course_by_name
        from vehest.simulation.drive import simulate_drive
        from vehest.simulation.parameters import vehicle_from_configuration
        from vehest.simulation.sensors import SensorLevels, ideal_sensors

        if recording_id not in self.drives:
            raise MissingError(f"data set '{self.name}' has no drive '{recording_id}' (it has {', '.join(self.drives)})")
        drive = self.drives[recording_id]
        return simulate_drive(
            id=recording_id,
            vehicle=vehicle_from_configuration(self.dataset["vehicle"]),
            course=course_by_name(str(self.dataset.get("course", "handling"))),
            duration=float(drive["duration"]),
            seed=int(drive["seed"]),
            rate_hz=float(self.dataset.get("rate_hz", 100.0)),
            sensors=ideal_sensors() if self.dataset.get("sensors") == "ideal" else SensorLevels(),
        )


SOURCE = SimulatedSource
