"""Bands, limits and health of a model, read from and written to trust.yaml."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from vehest.data.errors import DataError
from vehest.data.recording import UNNAMED_VEHICLE
from vehest.data.schema import check_format, validated
from vehest.data.text_files import read_yaml
from vehest.trust.bands import Bands
from vehest.trust.guard import GuardLimits
from vehest.trust.health import HealthModel

TRUST = "trust.yaml"
FORMAT = 1


@dataclass(frozen=True)
class About:
    """The model."""

    estimator: str  # name in the registry
    variant: str = ""  # what the paper calls it
    note: str = ""  # why something is missing, for people; empty where nothing is


@dataclass(frozen=True)
class Trust:
    """Bands, limits and health of a model; None if not learnt."""

    about: About  # whose it is
    bands: Bands | None = None  # calibrated half widths
    guard: GuardLimits | None = None  # limits of plausible samples
    health: HealthModel | None = None  # residuals and thresholds of the health flag


def is_other_vehicle(trust: Trust | None, vehicle: str, same_vehicle: bool | None = None) -> bool:
    """Whether a recording is of another vehicle than those that bands were calibrated on.

    Parameters
    ----------
    trust : Trust or None
        Calibration of the model; without bands the answer is False.
    vehicle : str
        Name of the recording's car. It is another one only if both it and the car of the calibration have names.
    same_vehicle : bool, optional
        Answer of the user, which comes first.
    """
    if trust is None or trust.bands is None:
        return False
    if same_vehicle is not None:
        return not same_vehicle
    return not trust.bands.are_of(vehicle)


def describe_band(trust: Trust | None, vehicle: str, same_vehicle: bool | None = None) -> str:
    """What calibrated the band of an estimate, and by which rule of `is_other_vehicle` it applies; empty without a band."""
    if trust is None or trust.bands is None:
        return ""
    bands = trust.bands
    datasets = ", ".join(bands.datasets)
    if not bands.vehicles and same_vehicle is None:
        return f"calibrated on drives of many cars ({datasets}): for any car"
    names = [f"'{name}'" for name in bands.vehicles if name != UNNAMED_VEHICLE]
    cars = ", ".join(names) or ("a car without a name" if bands.vehicles else "many cars")
    basis = f"calibrated on recordings of {cars} ({datasets})"
    if same_vehicle is not None:
        which = "the same car" if same_vehicle else "another car: band doubled"
        return f"{basis}; this one is of {which}, as same_vehicle says"
    if is_other_vehicle(trust, vehicle):
        remedy = "if it is the same, give same_vehicle=true, or its name as vehicle of the data set"
        return f"{basis}; this one is of '{vehicle}', another car: band doubled; {remedy}"
    if names and vehicle in bands.vehicles:
        return f"{basis}; this one is of the same car, by its name"
    remedy = "if it is another, give same_vehicle=false, which doubles the band"
    return f"{basis}; this one is assumed to be of the same car, as no names differ; {remedy}"


def write_trust(trust: Trust, folder: Path) -> None:
    """Write trust.yaml into an existing folder; raises `OSError` where it cannot be written."""
    content = json.loads(json.dumps({"format": FORMAT, **asdict(trust)}))  # tuples as lists
    (folder / TRUST).write_text(
        yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8"
    )


def read_trust(folder: Path) -> Trust:
    """Read trust.yaml of a folder back; raises `MissingError` where there is none, `DataError` where it is damaged or of another format."""
    path = folder / TRUST
    content = read_yaml(path)
    if not isinstance(content, dict) or "format" not in content:
        raise DataError(f"'{path}' does not say how far a model can be trusted; calibrate it again")
    check_format(content.pop("format"), FORMAT, f"'{path}'")
    try:
        return validated(Trust, content, f"'{path}'")
    except DataError as error:
        raise DataError(str(error) if str(path) in str(error) else f"'{path}': {error}") from None
