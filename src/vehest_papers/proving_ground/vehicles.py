"""Data sets, read one recording at a time, to what each vehicle's page shows."""

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
from vehest_papers.proving_ground.papers import counterpart_page, page_of, profile_of
from vehest_papers.proving_ground.tally import Tally, flags_of

NEEDED = ("vx", "yaw_rate", "ax", "ay", "vy_ref")
CHANNELS = (*NEEDED, "steer", "vx_ref", "sideslip_ref")
TRACED = ("vx", "steer", "yaw_rate", "ay", "sideslip_ref")
TRACE_SECONDS = 60.0
SHORTEST_TRACE = 8.0
MOST_CHARACTERISTICS = 4
ROLES = ("train", "validation", "test")
ALL = "all"


@dataclass(frozen=True, eq=False)
class Stretch:
    """A stretch of one drive."""

    recording: str  # its name
    manoeuvre: str  # what is driven
    time: FloatArray  # on the recording's own clock (K,) [s]
    channels: Mapping[str, FloatArray]  # those of `TRACED` that it has (K,), SI units
    power: float  # mean square of the lateral acceleration [m²/s⁴]


@dataclass(frozen=True)
class FlaggedDrive:
    """A drive that went wrong by accident."""

    dataset: str  # its data set
    recording: str  # its name
    vehicle: str  # its car
    manoeuvre: str  # what was to be driven
    stability_control: bool  # whether it was switched on
    flags: Mapping[str, Any]  # how it went


@dataclass
class DatasetTally:
    """One data set's recordings of one page."""

    dataset: StoredDataset  # whose
    # set -> its statistics: `ALL`, drives by their names without a counter, ``manoeuvre:NAME``, and the `ROLES` that drives have by the
    # beginning of their names
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
class VehiclePage:
    """What a vehicle's page is drawn from."""

    name: str  # of the page
    simulated: dict[str, DatasetTally] = field(default_factory=dict)  # by data set
    real: dict[str, DatasetTally] = field(
        default_factory=dict
    )  # the same of the real recordings that stand beside
    handling: HandlingPoints | None = None  # points of the simulated recordings
    real_handling: HandlingPoints | None = None  # of the real ones
    characteristics: list[Characteristic] = field(
        default_factory=list
    )  # of the plant, one a variant and surface
    # manoeuvre -> of all drives that went as planned, that with the most lateral acceleration
    stretches: dict[str, Stretch] = field(default_factory=dict)
    flagged: list[FlaggedDrive] = field(default_factory=list)  # drives that spun or left the road
    # one simulated and one real recording as they were recorded, to read noise from
    samples: dict[str, Recording] = field(default_factory=dict)

    def merged(self, kind: str) -> Tally:
        """All recordings of a kind together."""
        total = Tally()
        for own in (self.simulated if kind == "simulated" else self.real).values():
            total.merge(own.all)
        return total


def survey(datasets: Sequence[StoredDataset]) -> dict[str, VehiclePage]:
    """Name of the page -> what it shows, in the order in which vehicles are met.

    Memory does not grow with the number of recordings: one is held at a time, and one a page for its noise.
    """
    pages: dict[str, VehiclePage] = {}
    for dataset in sorted(datasets, key=lambda own: own.kind == "real"):
        for recording in dataset.recordings():
            _add(pages, dataset, recording)
    return pages


def _add(pages: dict[str, VehiclePage], dataset: StoredDataset, recording: Recording) -> None:
    recording = _completed(recording)
    real = recording.kind == "real"
    beside = counterpart_page(dataset.name) if real else None
    name = beside or page_of(recording.vehicle)
    page = pages.setdefault(name, VehiclePage(name))
    if real or not _accident(recording):
        page.samples.setdefault(recording.kind, recording)
    prepared = profile_of(name).prepared(recording)
    own = page.real if real else page.simulated
    own.setdefault(dataset.name, DatasetTally(dataset)).add(prepared)
    if real:
        _add_real(page, prepared)
    else:
        _add_simulated(page, dataset, prepared)


def _completed(recording: Recording) -> Recording:
    """The channels that are shown; sideslip from the velocities where it is not recorded."""
    vx_ref = recording.channels.get("vx_ref", recording["vx"])
    known = {
        "vx_ref": vx_ref,
        "sideslip_ref": np.arctan2(recording["vy_ref"], vx_ref),
        **recording.channels,
    }
    return replace(recording, channels=known).select(
        [*NEEDED, *(name for name in CHANNELS if name in known and name not in NEEDED)]
    )


def _add_real(page: VehiclePage, recording: Recording) -> None:
    if (
        page.handling is None or "steer" not in recording
    ):  # no simulated car whose wheelbase it shares
        return
    if page.real_handling is None:
        page.real_handling = HandlingPoints(page.handling.wheelbase)
    page.real_handling.add(recording)


def _add_simulated(page: VehiclePage, dataset: StoredDataset, recording: Recording) -> None:
    about = recording.provenance
    manoeuvre = manoeuvre_of(recording)
    if "parameter_set" in about and "steer" in recording:  # by vehest's own plant
        label = _variant(page.name, recording)
        if len(page.characteristics) < MOST_CHARACTERISTICS and label not in {
            known.label for known in page.characteristics
        }:
            vehicle = vehicle_of(about, recording.vehicle)
            page.handling = page.handling or HandlingPoints(wheelbase_of(vehicle))
            page.characteristics.append(
                characteristic(vehicle, float(about["surface"]["friction"]), label)
            )
        assert page.handling is not None
        page.handling.add(recording)
    if _accident(recording):
        on = bool(about.get("stability_control"))
        page.flagged.append(
            FlaggedDrive(
                dataset.name, recording.id, recording.vehicle, manoeuvre, on, flags_of(recording)
            )
        )
        return
    stretch = busiest_stretch(recording, TRACE_SECONDS)
    if manoeuvre not in page.stretches or stretch.power > page.stretches[manoeuvre].power:
        page.stretches[manoeuvre] = stretch


def busiest_stretch(recording: Recording, seconds: float) -> Stretch:
    """The stretch of a length with the largest mean square of the lateral acceleration; all of a shorter recording."""
    n = min(round(seconds * recording.rate_hz), len(recording))
    power = np.convolve(np.square(recording["ay"]), np.full(n, 1.0 / n), mode="valid")
    first = int(power.argmax())
    kept = slice(first, first + n)
    channels = {name: recording[name][kept].copy() for name in TRACED if name in recording}
    return Stretch(
        recording.id, manoeuvre_of(recording), recording.time[kept], channels, float(power[first])
    )


def manoeuvre_of(recording: Recording) -> str:
    """What was driven, ``drive`` where the recording has no name for it."""
    manoeuvre = recording.provenance.get("manoeuvre")
    return str(manoeuvre["name"]) if isinstance(manoeuvre, Mapping) else "drive"


def set_of(recording_id: str) -> str:
    """The name that drives of one entry of a data set share: without the counter at its end."""
    return re.sub(r"_\d{3,}$", "", recording_id)


def _sets_of(recording: Recording) -> list[str]:
    own = set_of(recording.id)
    sets = [ALL, own, f"manoeuvre:{manoeuvre_of(recording)}"]
    role = own.split("_")[0]
    return [*sets, role] if role in ROLES and role != own else sets


def _accident(recording: Recording) -> bool:
    flags = flags_of(recording)
    return bool(flags.get("spun") or flags.get("left_road"))


def _variant(page: str, recording: Recording) -> str:
    """What tells a car and its road from others on the same page."""
    variant = recording.vehicle.removeprefix(page).strip("_") or "nominal"
    return f"{variant}, {recording.provenance['surface']['name']} road"
