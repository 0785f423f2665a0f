"""Data sets, read one recording at a time, to what the report has of each vehicle."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.studies.artefacts import StoredDataset
from vehest_papers.proving_ground.handling import (
    Characteristic,
    HandlingPoints,
    characteristic,
    vehicle_of,
    wheelbase_of,
)
from vehest_papers.proving_ground.papers import counterpart_of, profile_name, profile_of
from vehest_papers.proving_ground.tally import Tally, flags_of

REQUIRED = ("vx", "yaw_rate", "ax", "ay", "vy_ref")
CHANNELS = (*REQUIRED, "steer", "vx_ref", "sideslip_ref")
TRACED = ("vx", "steer", "yaw_rate", "ay", "sideslip_ref")
TRACE_SECONDS = 60.0
MAX_CHARACTERISTICS = 4
ROLES = ("train", "validation", "test")
ALL = "all"


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment of one drive."""

    recording: str  # its name
    manoeuvre: str
    time: FloatArray  # on the recording's clock (K,) [s]
    channels: Mapping[str, FloatArray]  # those of `TRACED` that it has (K,), SI units
    power: float  # mean square of the lateral acceleration [m²/s⁴]

    def busiest_part(self, seconds: float) -> Segment:
        """The part of a length with the largest mean square of the lateral acceleration.

        Parameters
        ----------
        seconds
            Length [s]; a shorter segment is returned whole.
        """
        rate_hz = (len(self.time) - 1) / float(self.time[-1] - self.time[0])
        n = min(round(seconds * rate_hz), len(self.time))
        power = np.convolve(np.square(self.channels["ay"]), np.full(n, 1.0 / n), mode="valid")
        first = int(power.argmax())
        part = slice(first, first + n)
        channels = {name: samples[part].copy() for name, samples in self.channels.items()}
        time = self.time[part]
        return replace(self, time=time, channels=channels, power=float(power[first]))


@dataclass(frozen=True)
class FlaggedDrive:
    """A drive that went wrong by accident."""

    dataset: str
    recording: str
    vehicle: str
    manoeuvre: str  # that was planned
    stability_control: bool  # whether it was switched on
    flags: Mapping[str, Any]  # how it went


@dataclass
class DatasetTally:
    """The recordings of one vehicle in one data set.

    `tallies` maps a set to its statistics: `ALL`, drives by their names without a counter,
    ``manoeuvre:NAME``, and the `ROLES` that the names of drives begin with.
    """

    dataset: StoredDataset
    tallies: dict[str, Tally] = field(default_factory=dict)

    def add(self, recording: Recording) -> None:
        """Count a prepared recording in."""
        for name in _sets_of(recording):
            self.tallies.setdefault(name, Tally()).add(recording)

    @property
    def all(self) -> Tally:
        """Every drive."""
        return self.tallies[ALL]


@dataclass
class VehicleData:
    """What tables and figures of a vehicle are made from."""

    name: str  # of its profile
    simulated: dict[str, DatasetTally] = field(default_factory=dict)  # by data set
    real: dict[str, DatasetTally] = field(default_factory=dict)  # of real recordings of the car
    handling: HandlingPoints | None = None  # of the simulated recordings
    real_handling: HandlingPoints | None = None
    # of the plant, one for each variant and surface
    characteristics: list[Characteristic] = field(default_factory=list)
    # manoeuvre -> of all drives that went as planned, that with the most lateral acceleration
    segments: dict[str, Segment] = field(default_factory=dict)
    flagged: list[FlaggedDrive] = field(default_factory=list)

    def merged(self, kind: str) -> Tally:
        """All recordings of a kind, ``simulated`` or ``real``, together."""
        total = Tally()
        for of_dataset in (self.simulated if kind == "simulated" else self.real).values():
            total.merge(of_dataset.all)
        return total


def survey(datasets: Sequence[StoredDataset]) -> dict[str, VehicleData]:
    """Name of a profile -> data of its vehicle, in the order of the recordings.

    Memory does not grow with the number of recordings.
    """
    vehicles: dict[str, VehicleData] = {}
    for dataset in sorted(datasets, key=lambda dataset: dataset.kind == "real"):
        for recording in dataset.recordings():
            _add(vehicles, dataset, _completed(recording))
    return vehicles


def _add(vehicles: dict[str, VehicleData], dataset: StoredDataset, recording: Recording) -> None:
    is_real = recording.kind == "real"
    counterpart = counterpart_of(dataset.name) if is_real else None
    name = counterpart or profile_name(recording.vehicle)
    vehicle = vehicles.setdefault(name, VehicleData(name))
    prepared = profile_of(name).prepared(recording)
    by_dataset = vehicle.real if is_real else vehicle.simulated
    by_dataset.setdefault(dataset.name, DatasetTally(dataset)).add(prepared)
    if is_real:
        _add_real(vehicle, prepared)
    else:
        _add_simulated(vehicle, dataset, prepared)


def _completed(recording: Recording) -> Recording:
    """The channels that are needed; sideslip from the velocities where it is not recorded."""
    vx_ref = recording.channels.get("vx_ref", recording["vx"])
    channels = {
        "vx_ref": vx_ref,
        "sideslip_ref": np.arctan2(recording["vy_ref"], vx_ref),
        **recording.channels,
    }
    optional = [name for name in CHANNELS if name in channels and name not in REQUIRED]
    return replace(recording, channels=channels).select([*REQUIRED, *optional])


def _add_real(vehicle: VehicleData, recording: Recording) -> None:
    """Count a real recording's steering where a simulated car gives the wheelbase."""
    if vehicle.handling is None or "steer" not in recording:
        return
    if vehicle.real_handling is None:
        vehicle.real_handling = HandlingPoints(vehicle.handling.wheelbase)
    vehicle.real_handling.add(recording)


def _add_simulated(vehicle: VehicleData, dataset: StoredDataset, recording: Recording) -> None:
    manoeuvre = manoeuvre_of(recording)
    if "parameter_set" in recording.provenance and "steer" in recording:  # by vehest's plant
        _add_handling(vehicle, recording)
    if is_accident(recording):
        is_controlled = bool(recording.provenance.get("stability_control"))
        vehicle.flagged.append(
            FlaggedDrive(
                dataset.name,
                recording.id,
                recording.vehicle,
                manoeuvre,
                is_controlled,
                flags_of(recording),
            )
        )
        return
    segment = busiest_segment(recording, TRACE_SECONDS)
    if manoeuvre not in vehicle.segments or segment.power > vehicle.segments[manoeuvre].power:
        vehicle.segments[manoeuvre] = segment


def _add_handling(vehicle: VehicleData, recording: Recording) -> None:
    surface = recording.provenance["surface"]
    variant = recording.vehicle.removeprefix(vehicle.name).strip("_") or "nominal"
    label = f"{variant}, {surface['name']} road"
    labels = {curve.label for curve in vehicle.characteristics}
    if len(labels) < MAX_CHARACTERISTICS and label not in labels:
        car = vehicle_of(recording.provenance, recording.vehicle)
        vehicle.handling = vehicle.handling or HandlingPoints(wheelbase_of(car))
        vehicle.characteristics.append(characteristic(car, float(surface["friction"]), label))
    assert vehicle.handling is not None
    vehicle.handling.add(recording)


def busiest_segment(recording: Recording, seconds: float) -> Segment:
    """The segment of a length [s] with the largest mean square of ay, or a shorter recording."""
    channels = {name: recording[name] for name in TRACED if name in recording}
    drive = Segment(recording.id, manoeuvre_of(recording), recording.time, channels, 0.0)
    return drive.busiest_part(seconds)


def manoeuvre_of(recording: Recording) -> str:
    """What was driven, ``drive`` where the recording has no name for it."""
    manoeuvre = recording.provenance.get("manoeuvre")
    return str(manoeuvre["name"]) if isinstance(manoeuvre, Mapping) else "drive"


def set_of(recording_id: str) -> str:
    """The name that drives of one entry of a data set share: without the counter at its end."""
    return re.sub(r"_\d{3,}$", "", recording_id)


def _sets_of(recording: Recording) -> list[str]:
    name = set_of(recording.id)
    sets = [ALL, name, f"manoeuvre:{manoeuvre_of(recording)}"]
    role = name.split("_")[0]
    return [*sets, role] if role in ROLES and role != name else sets


def is_accident(recording: Recording) -> bool:
    """Whether a simulated drive spun or left the road."""
    flags = flags_of(recording)
    return bool(flags.get("spun") or flags.get("left_road"))
